"""A kept map in Python: where an image was taken."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pliant.algorithms.arrays import F64, U8, BoolArray
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.image.masks import clearance_in, filled
from pliant.algorithms.slam.localiser import Localiser
from pliant.algorithms.tracking.maxima import maxima_of
from pliant.api.images import calibration_of, source_frame
from pliant.config import load_config
from pliant.datasets.calibration import Calibration, calibration_from_yaml
from pliant.datasets.rectifier import Rectifier
from pliant.messages.types import MapKeyframe
from pliant.recording.map_file import MapFile


@dataclass(frozen=True, kw_only=True)
class Located:
    """Where an image was taken.

    T_world_camera: (4, 4), in the world of the segment of the map.   inliers: points of the map
    that prove it.
    """

    T_world_camera: F64
    segment: int
    inliers: int


class KnownMap:
    """A saved map.

    calibration: of the camera of its last session.   keyframes: (N, 4, 4) T_world_camera of them.
    points: (P, 3).   colours: (P, 3) RGB.   segments: (P,) of the points: each is a world of its
    own.
    """

    def __init__(self, path: str | Path) -> None:
        """path: a result folder or its ``map.pliant``.  Raises MapError."""
        file = MapFile(Path(path))
        self._kept: list[MapKeyframe] = list(file.keyframes())
        self.calibration = calibration_from_yaml(file.header.calibration)
        self.keyframes = np.array([each.T_world_camera for each in self._kept])
        self.points = np.concatenate([each.points_world for each in self._kept])
        self.colours = np.concatenate([each.point_colours for each in self._kept])
        counts = [len(each.point_ids) for each in self._kept]
        self.segments = np.repeat([each.segment for each in self._kept], counts)
        self._config = load_config()
        self._finder: tuple[Calibration, Rectifier, Localiser] | None = None

    def localise(
        self,
        image: U8,
        camera: Calibration | PinholeCamera | None = None,
        mask: U8 | BoolArray | None = None,
    ) -> Located | None:
        """Where an image was taken; None if the map is not recognised in it.

        image: (H, W) grey or (H, W, 3) RGB, uint8, as the camera took it.    camera: its own, where
        it is not that of the map's last session.    mask: (H, W), 0 where the image is ignored.
        Raises DatasetError for an image that is none of the camera's.
        """
        calibration, rectifier, localiser = self._finder_for(camera)
        frame = source_frame(image, calibration, mask=mask)
        grey, _ = rectifier.rectify(frame)
        grey = filled(grey, clearance_in(rectifier.mask(frame)))
        ideal = localiser.calibration.view.image(grey)
        # Its own generator: the answer does not depend on earlier images.
        found = localiser.recognise(
            maxima_of(ideal, self._config.tracking), ideal, np.random.default_rng(self._config.seed)
        )
        if found is None:
            return None
        return Located(
            T_world_camera=found.T_world_camera,
            segment=found.keyframe.segment,
            inliers=found.inliers,
        )

    def _finder_for(
        self, camera: Calibration | PinholeCamera | None
    ) -> tuple[Calibration, Rectifier, Localiser]:
        """The localiser of images of a camera, kept for the next one."""
        calibration = self.calibration if camera is None else calibration_of(camera)
        if self._finder is None or self._finder[0] != calibration:
            rectifier, parameters = Rectifier(calibration), self._config.bundle_adjustment
            seed = self._config.seed
            localiser = Localiser(rectifier.camera, parameters, seed, known=self._kept)
            self._finder = calibration, rectifier, localiser
        return self._finder


def load_map(path: str | Path) -> KnownMap:
    """The map that a run has left::

        office = pliant.load_map("results/office")
        found = office.localise(image)  # None if it is not recognised
        found.T_world_camera

    path: a result folder or its ``map.pliant``.  Raises MapError.
    """
    return KnownMap(path)
