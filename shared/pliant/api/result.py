"""A run's results as arrays, read from its recording on demand."""

import base64
import html
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from pliant.algorithms.arrays import F32, F64, I64, U8
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import pose_to_matrix
from pliant.algorithms.slam.calibration.corrected_view import corrected_view
from pliant.algorithms.surfels.surface import surface_of
from pliant.api.mapped import Mapped
from pliant.api.open3d_types import Mesh, Surface
from pliant.datasets.calibration import Calibration, calibration_from_yaml
from pliant.datasets.own_recording import recorded_frame
from pliant.datasets.recorded_images import RecordedImages
from pliant.datasets.rectifier import Rectifier
from pliant.errors import ResultError
from pliant.export.surface_meshes import colours_at
from pliant.map_history import MapHistory
from pliant.messages import topics
from pliant.messages.topics import Topic
from pliant.messages.types import CameraStream, Extrema, Header, SourceImage, Surfels
from pliant.pictures.map import choose_view, render_map
from pliant.recording import parts
from pliant.recording.reader import Recording
from pliant.results.calibration import found_calibration
from pliant.results.folder import DEFORMING_MAP_NAME, RECORDING_NAME
from pliant.results.mesh_files import mesh_of
from pliant.results.report import rigid_report
from pliant.results.run import Run, read_run, seen_by_keyframes
from pliant.results.surfel_frames import corrector, final_surfels, has_surfels
from pliant.results.surfels import surfel_report, surfel_trajectory
from pliant.results.verdict import summary
from pliant.trajectory import Trajectory

_GREY = 128


@dataclass(frozen=True, kw_only=True)
class Keyframe:
    """A keyframe of the longest segment.

    id: unique in the run.    frame: number of its frame.    T_world_camera: (4, 4).
    point_ids: (N,) observed points of the map.    points_px: (N, 2) their rectified pixels.
    """

    id: int
    frame: int
    T_world_camera: F64
    point_ids: I64
    points_px: F32
    _jpeg: bytes = field(repr=False)

    @property
    def image(self) -> U8:
        """(H, W, 3) RGB, rectified; (0, 0, 3) if it was not recorded."""
        if not self._jpeg:
            return np.zeros((0, 0, 3), np.uint8)
        data = np.frombuffer(self._jpeg, np.uint8)
        return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR_RGB), np.uint8)


class Result(Mapped):
    """A result folder, or only its recording::

        result = pliant.open("results/clip")
        result.trajectory.positions, result.points, result.mesh.positions
        result.keyframes[3].image, result.tracks(120).points_px

    Everything is read when it is first used, and kept in memory.
    """

    def __init__(self, path: str | Path) -> None:
        """Raises RecordingError if there is no recording."""
        self.path = Path(path)
        inside = self.path / RECORDING_NAME
        self._recording = Recording(inside if parts.exists(inside) else self.path)

    @cached_property
    def _run(self) -> Run:
        return read_run(self._recording.path)

    @property
    def history(self) -> MapHistory:
        """All segments of the map and their history."""
        return self._run.history

    @cached_property
    def is_deformable(self) -> bool:
        """Whether the run tracked a deforming scene with surfels."""
        return has_surfels(self._recording.path)

    @cached_property
    def report(self) -> dict[str, Any]:
        """The content of report.json: verdict, frames, times."""
        if self.is_deformable:
            return surfel_report(self._recording.path)
        return rigid_report(self._run, self.history.final())

    @property
    def trajectory(self) -> Trajectory:
        """Final camera poses T_world_camera, after all corrections."""
        if self.is_deformable:
            return surfel_trajectory(self._recording.path)
        return super().trajectory

    @cached_property
    def mesh(self) -> Mesh | None:
        """The fine mesh of the longest segment, in its world frame; None without one."""
        found = mesh_of(self._run.mesh, self.history.longest_segment())
        return None if found is None else Mesh(**vars(found))

    @cached_property
    def calibration(self) -> Calibration | None:
        """The calibration as estimated by the run: the content of calibration.yaml."""
        return found_calibration(self._run)

    @cached_property
    def camera(self) -> PinholeCamera:
        """The camera of the map: landmarks project to the pixels of ``keyframes`` and ``tracks``,
        except for the estimated distortion.
        """
        stream, longest = self._stream, self.history.longest_segment()
        return corrected_view(stream.camera, self._run.correction_of(longest)).camera

    @cached_property
    def keyframes(self) -> list[Keyframe]:
        """The keyframes of the longest segment, in order of time."""
        longest = self.history.longest_segment()
        here = {n: k for n, k in self.history.keyframes.items() if k.segment == longest}
        own = {number: keyframe for number, keyframe in here.items() if keyframe.frame >= 0}
        seen = seen_by_keyframes(self._recording, own)
        found = [
            Keyframe(
                id=number,
                frame=keyframe.frame,
                T_world_camera=pose_to_matrix(keyframe.pose_world_camera),
                point_ids=seen[number].point_ids,
                points_px=seen[number].points_px,
                _jpeg=seen[number].jpeg,
            )
            for number, keyframe in own.items()
            if number in seen
        ]
        return sorted(found, key=lambda keyframe: keyframe.frame)

    def tracks(self, frame: int) -> Extrema:
        """The tracks of a frame: ``ids`` (N,), ``points_px`` (N, 2) rectified, ``ages`` (N,)."""
        message = self._message(topics.EXTREMA, frame)
        assert isinstance(message, Extrema)
        return message

    def image(self, frame: int) -> U8:
        """The rectified image of a frame: (H, W) grey or (H, W, 3) RGB.

        Raises ResultError if images were not recorded, BrokenFrame if the frame has no pixels.
        """
        message = self._message(topics.SOURCE, frame)
        assert isinstance(message, SourceImage)
        grey, colour = self._rectifier.rectify(recorded_frame(self._images.whole(message)))
        return grey if colour is None else colour

    def surfels(self) -> Iterator[Surfels]:
        """The surfels of a deforming scene, in every frame, by the final map if there is one."""
        return final_surfels(self._recording.path)

    def surface(self, frame: int) -> Surface:
        """The surface of a deforming scene in a frame: a mesh of its tracked surfels, in the world
        frame of its segment.  It is grey if images were not recorded.

        Raises ResultError if the frame was not recorded or has no surfels.
        """
        surfels = self._message(topics.SURFELS, frame)
        assert isinstance(surfels, Surfels)
        if surfels.missing:
            raise ResultError(f"{self.path}: frame {frame} has no surfels: {surfels.missing}")
        surfels = self._final(surfels)
        rows, normals, triangles = surface_of(surfels)
        colours = np.full((len(rows), 3), _GREY, np.uint8)
        if next(self._recording.messages(topics.SOURCE), None) is not None:
            colours = colours_at(self.image(frame), surfels.points_px[rows])
        return Surface(
            positions=surfels.positions[rows].astype(np.float32),
            normals=normals,
            colours=colours,
            triangles=np.ascontiguousarray(triangles[:, ::-1]),  # seen from the camera
            ids=surfels.ids[rows],
        )

    def picture(self, width: int = 960, height: int = 720) -> U8:
        """Draw the points, the camera path, and lines between keyframes that show the same place:
        (height, width, 3) RGB."""
        poses = self.trajectory.T_world_camera
        if not len(poses):
            raise ResultError(f"{self.path}: the run has no map to draw")
        view = choose_view(self.points, poses)
        places = self.history.same_places_in(self.history.longest_segment())
        return render_map(
            self.points, self.colours, poses, view=view, size=(width, height), places=places
        )

    def __repr__(self) -> str:
        return f"<pliant.Result {str(self.path)!r}: {len(self.trajectory)} poses>"

    def _repr_html_(self) -> str:
        """Show the verdict and a picture in a notebook."""
        lines = summary(self.report, has_map=not self.is_deformable)
        text = "".join(f"<div>{html.escape(line)}</div>" for line in lines)
        if self.is_deformable or not len(self.trajectory):
            return text
        _, data = cv2.imencode(".png", np.ascontiguousarray(self.picture(640, 480)[..., ::-1]))
        encoded = base64.b64encode(data.tobytes()).decode()
        return f'{text}<img alt="the map" src="data:image/png;base64,{encoded}">'

    @cached_property
    def _stream(self) -> CameraStream:
        for message in self._recording.decoded(topics.STREAM):
            assert isinstance(message, CameraStream)
            return message
        raise ResultError(f"{self.path}: no camera: the run stopped before its first frame")

    @cached_property
    def _rectifier(self) -> Rectifier:
        return Rectifier(calibration_from_yaml(self._stream.calibration))

    @cached_property
    def _final(self) -> Callable[[Surfels], Surfels]:
        return corrector(self._recording.path.parent / DEFORMING_MAP_NAME)

    @cached_property
    def _images(self) -> RecordedImages:
        return RecordedImages(self._recording)

    def _message(self, topic: Topic, frame: int) -> Header:
        """The message of a frame; there is one for each."""
        found = next(islice(self._recording.messages(topic), max(frame, 0), None), None)
        if found is None or frame < 0:
            raise ResultError(f"{self.path}: {topic.key} of frame {frame} was not recorded")
        return found.decode()


def open(path: str | Path) -> Result:
    """The result of a run, from its folder or from a recording.  Raises RecordingError."""
    return Result(path)
