"""Maps image by image in this process, without bus or files, with the same results."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from pliant.algorithms.arrays import F32, F64, I64, U8, BoolArray
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import pose_to_matrix
from pliant.api.images import calibration_of, source_frame
from pliant.api.mapped import Mapped
from pliant.config import Settings, load_config, overrides_of
from pliant.datasets import open_source
from pliant.datasets.base import SourceFrame
from pliant.datasets.calibration import Calibration, calibration_from_fov
from pliant.datasets.source_spec import SourceSpec
from pliant.errors import CalibrationError, DatasetError
from pliant.map_history import MapHistory
from pliant.offline import Pipeline

_FPS = 30.0
"""Frames per second of images without a time."""


class Slam(Mapped):
    """Maps a sequence of images and localises each of them::

        slam = pliant.Slam(fov=70)
        for image, stamp in ...:
            T_world_camera = slam.track(image, stamp)
        slam.finish()
        slam.trajectory.positions, slam.points

    It runs in this process and records nothing.
    """

    def __init__(
        self,
        camera: Calibration | PinholeCamera | None = None,
        *,
        fov: float | None = None,
        settings: Settings = None,
        seed: int | None = None,
    ) -> None:
        """camera: of the images; without one it is estimated from them, starting with a horizontal
        field of view of ``fov`` degrees.    settings: ``{"tracking.max_tracks": 5000}`` or
        ``["tracking.max_tracks=5000"]``.

        Raises ConfigError for an unknown setting, CalibrationError.
        """
        if camera is not None and fov is not None:
            raise CalibrationError("camera and fov exclude each other: pass only one")
        self._camera = None if camera is None else calibration_of(camera)
        self._fov = fov
        self._config = load_config(None, overrides_of(settings), seed=seed)
        self._history = MapHistory()
        self._pipeline: Pipeline | None = None
        self._next = SourceFrame(index=0, stamp_ns=-1, encoding="", data=b"")
        self._finished = False

    @property
    def history(self) -> MapHistory:
        """The map after all images so far."""
        return self._history

    def track(
        self, image: U8, stamp: float | None = None, mask: U8 | BoolArray | None = None
    ) -> F64 | None:
        """Return T_world_camera (4, 4) of the next image; None if it has no pose, or none yet.

        image: (H, W) grey or (H, W, 3) RGB, all of one size.    stamp: capture time in seconds,
        increasing; without it, 30 images per second.    mask: (H, W), 0 where the image is ignored.

        The map starts once the camera has moved; earlier images get their poses then, see
        ``trajectory``.  Raises DatasetError for an invalid image or time.
        """
        return self.take(image, stamp, mask).T_world_camera

    def take(
        self, image: U8, stamp: float | None = None, mask: U8 | BoolArray | None = None
    ) -> "Tracked":
        """As ``track``; returns the tracks and the reason for a missing pose as well."""
        number, last_ns = self._next.index, self._next.stamp_ns
        stamp_ns = round(1e9 * (number / _FPS if stamp is None else stamp))
        if stamp_ns <= last_ns:
            raise DatasetError(
                f"image {number}: its time {1e-09 * stamp_ns:.6f} s is not after the previous "
                f"time {1e-09 * last_ns:.6f} s"
            )
        source = source_frame(image, self._camera, number=number, stamp_ns=stamp_ns, mask=mask)
        if self._camera is None:
            self._camera = calibration_from_fov(source.width, source.height, self._fov)
        return self._step(source)

    def finish(self) -> "Slam":
        """Adjust the whole map, when no more images come.  Returns this object."""
        if self._pipeline is not None and not self._finished:
            self._pipeline.finish()
        self._finished = True
        return self

    def _step(self, source: SourceFrame) -> "Tracked":
        if self._finished:
            raise DatasetError(
                "the map is finished and accepts no more images: create another Slam"
            )
        if self._pipeline is None:
            assert self._camera is not None
            self._pipeline = Pipeline(self._camera, self._config, self._history)
        frame = self._pipeline.take(source)
        self._next = SourceFrame(
            index=source.index + 1, stamp_ns=source.stamp_ns, encoding="", data=b""
        )
        known = self._history.online.get(source.index)
        image = frame.image
        return Tracked(
            number=image.frame,
            stamp_ns=image.stamp_ns,
            image=image.colour if image.colour.size else image.grey,
            T_world_camera=None if known is None else pose_to_matrix(known[1]),
            segment=frame.delta.segment,
            inliers=frame.delta.inliers,
            reason=image.missing or frame.delta.reason,
            track_ids=frame.tracks.ids,
            points_px=frame.tracks.points_px,
            slam=self,
        )


@dataclass(frozen=True, kw_only=True)
class Tracked:
    """A frame with its pose and tracks.

    number: from 0.    stamp_ns: capture time.    image: (H, W) or (H, W, 3) RGB, rectified; of
    size 0 if it was broken.    T_world_camera: (4, 4), None without a pose.    segment: of the
    map.    inliers: points that support the pose.    reason: why there is no pose, or why it is
    doubtful; "" otherwise.    track_ids: (N,).    points_px: (N, 2) rectified pixels of the tracks.
    slam: the ``Slam`` that processed the frame.
    """

    number: int
    stamp_ns: int
    image: U8
    T_world_camera: F64 | None
    segment: int
    inliers: int
    reason: str
    track_ids: I64
    points_px: F32
    slam: Slam


def follow(
    source: str | Path,
    *,
    calibration: str | Path | None = None,
    fov: float | None = None,
    mask: str | Path | None = None,
    settings: Settings = None,
    seed: int | None = None,
) -> Iterator[Tracked]:
    """Map a source that ``pliant run`` opens, frame by frame, in this process::

        for frame in pliant.follow("clip.mp4", fov=70):
            print(frame.number, frame.T_world_camera)
        frame.slam.trajectory

    Raises DatasetError, CalibrationError, ConfigError.
    """
    config = load_config(None, overrides_of(settings), seed=seed)
    spec = SourceSpec(
        location=str(source),
        calibration=None if calibration is None else Path(calibration),
        fov_deg=fov,
        mask=None if mask is None else Path(mask),
    )
    dataset = open_source(spec, config.ingest)
    slam = Slam(dataset.calibration, settings=settings, seed=seed)
    for frame in dataset:
        yield slam._step(frame)  # pyright: ignore[reportPrivateUsage]
    slam.finish()
