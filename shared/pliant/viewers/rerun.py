"""A run as Rerun entities: in its viewer, in a browser, or in an ``.rrd`` file.

    map/world/camera/image, .../tracks   the image with its tracks, at the camera in space
    map/world/points/N, path, mesh/N     the map; each block by itself, so that little is sent
    curves/lag, curves/milliseconds      how the services fare
    notes                                lines for the user

Time runs by "frame" and by "capture".  Needs Rerun: ``pip install 'pliant[view]'``.
"""

import importlib
import os
from pathlib import Path
from typing import Any, Literal

from pliant.algorithms.arrays import F32, F64, I32, U8
from pliant.algorithms.camera import PinholeCamera
from pliant.errors import ResultError
from pliant.viewers.age_colours import track_colours
from pliant.viewers.canvas import Moment
from pliant.viewers.foxglove import Z_UP_XYZW, world_name
from pliant.viewers.point_blocks import PointBlocks

Where = Literal["window", "web"] | Path
"""Rerun's own window, a browser, or a file."""

_PATH_COLOUR = (255, 160, 0)
_IMAGE_DISTANCE = 0.3  # of the frustum, in the map's arbitrary unit
_MEMORY_LIMIT = "1GiB"
_WEB_PORT, _GRPC_PORT = 9090, 9876


def load_rerun() -> Any:
    """The library, told to send nothing to its makers.  ResultError where it is missing."""
    # Read when the library is loaded, and by the viewer that it starts.
    for name in ("RERUN_ANALYTICS_ENABLED", "RERUN_ALLOW_UPDATE_CHECK"):
        os.environ[name] = "0"
    try:
        return importlib.import_module("rerun")
    except ImportError:
        raise ResultError("Rerun is not installed: pip install 'pliant[view]'") from None


class RerunCanvas:
    """A canvas that is a Rerun recording."""

    def __init__(
        self, where: Where, *, name: str, web_port: int = _WEB_PORT, grpc_port: int = _GRPC_PORT
    ) -> None:
        """Open it.  Raises ResultError where Rerun is missing or the file cannot be written."""
        self._rr = rr = load_rerun()
        self._stream: Any = rr.RecordingStream("pliant", recording_id=name)
        self._segment = 0
        blueprint = self._blueprint()
        if isinstance(where, Path):
            try:
                where.open("wb").close()
            except OSError as error:
                raise ResultError(f"{where}: cannot be written ({error.strerror})") from None
            self._stream.save(where, default_blueprint=blueprint)
        elif where == "web":
            address = self._stream.serve_grpc(
                grpc_port=grpc_port, default_blueprint=blueprint, server_memory_limit=_MEMORY_LIMIT
            )
            rr.serve_web_viewer(web_port=web_port, open_browser=False, connect_to=address)
            self.address = f"http://localhost:{web_port}/?url={address}"
        else:
            self._stream.spawn(
                default_blueprint=blueprint, memory_limit="50%", hide_welcome_screen=True
            )
        self._place_world(0)

    address = ""
    """Where a browser finds it."""

    def close(self) -> None:
        """Send what is left, and finish a file."""
        self._stream.flush()
        self._stream.disconnect()

    # -- the canvas ----------------------------------------------------------------------------

    def camera(self, camera: PinholeCamera) -> None:
        """The pinhole, whose origin is the corner of the first pixel in Rerun."""
        self._camera = camera
        self._place_camera()

    def image(self, at: Moment, data: bytes, encoding: str) -> None:
        """The image as it is encoded."""
        image = self._rr.EncodedImage(contents=data, media_type=f"image/{encoding}")
        self._log(at, f"{self._camera_path}/image", image)

    def tracks(self, at: Moment, points_px: F32, ages: I32) -> None:
        """Tracks by age, blue to orange."""
        points = self._rr.Points2D(points_px + 0.5, colors=track_colours(ages), radii=1.5)
        self._log(at, f"{self._camera_path}/image/tracks", points)

    def pose(self, at: Moment, segment: int, pose_world_camera: F64) -> None:
        """Where the camera is."""
        if segment != self._segment:
            self._place_world(segment)
        placed = self._rr.Transform3D(
            translation=pose_world_camera[:3],
            quaternion=self._rr.Quaternion(xyzw=pose_world_camera[3:]),
        )
        self._log(at, self._camera_path, placed)

    def path(self, at: Moment, segment: int, positions: F64) -> None:
        """One line through the keyframes."""
        line = self._rr.LineStrips3D([positions], colors=[_PATH_COLOUR])
        self._log(at, f"{_world(segment)}/path", line)

    def points(self, at: Moment, segment: int, points: PointBlocks, changed: list[int]) -> None:
        """The blocks that changed."""
        for number in changed:
            xyz, rgb = points.block(number)
            radius = self._rr.Radius.ui_points(1.5)
            cloud = self._rr.Points3D(xyz, colors=rgb, radii=radius)
            self._log(at, f"{_world(segment)}/points/{number}", cloud)

    def whole_map(self, at: Moment, segment: int, points: PointBlocks) -> None:
        """Nothing: the blocks stay."""

    def mesh(
        self, at: Moment, segment: int, name: str, vertices: F32, faces: I32, colours: U8 | None
    ) -> None:
        """A piece of surface."""
        path = f"{_world(segment)}/mesh/{name}"
        if not len(faces):
            self._log(at, path, self._rr.Clear(recursive=False))
            return
        surface = self._rr.Mesh3D(
            vertex_positions=vertices, triangle_indices=faces, vertex_colors=colours
        )
        self._log(at, path, surface)

    def forget(self, at: Moment, segment: int) -> None:
        """Clear a world."""
        self._log(at, _world(segment), self._rr.Clear(recursive=True))

    def measure(self, at: Moment, name: str, value: float) -> None:
        """A point of a curve."""
        self._log(at, f"curves/{name.replace(' ', '_')}", self._rr.Scalars(value))

    def note(self, at: Moment, text: str) -> None:
        """A line of the log."""
        self._log(at, "notes", self._rr.TextLog(text))

    # -- entities ------------------------------------------------------------------------------

    _camera: PinholeCamera | None = None

    @property
    def _camera_path(self) -> str:
        return f"{_world(self._segment)}/camera"

    def _place_world(self, segment: int) -> None:
        self._segment = segment
        turned = self._rr.Transform3D(quaternion=self._rr.Quaternion(xyzw=Z_UP_XYZW))
        self._stream.log("map", self._rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        self._stream.log(_world(segment), turned, static=True)
        self._place_camera()

    def _place_camera(self) -> None:
        if self._camera is None:
            return
        c = self._camera
        pinhole = self._rr.Pinhole(
            resolution=(c.width, c.height),
            focal_length=(c.fx, c.fy),
            principal_point=(c.cx + 0.5, c.cy + 0.5),
            camera_xyz=self._rr.ViewCoordinates.RDF,
            image_plane_distance=_IMAGE_DISTANCE,
        )
        self._stream.log(f"{self._camera_path}/image", pinhole, static=True)

    def _log(self, at: Moment, path: str, what: Any) -> None:
        self._stream.set_time("frame", sequence=at.frame)
        self._stream.set_time("capture", duration=at.stamp_ns * 1e-9)
        self._stream.log(path, what)

    def _blueprint(self) -> Any:
        rrb: Any = importlib.import_module("rerun.blueprint")
        return rrb.Blueprint(
            rrb.Horizontal(
                rrb.Spatial3DView(origin="map", name="Map"),
                rrb.Vertical(
                    rrb.Spatial2DView(
                        origin=f"{_world(0)}/camera/image", name="Image", contents="$origin/**"
                    ),
                    rrb.TimeSeriesView(
                        origin="curves/milliseconds", name="Milliseconds a frame by stage"
                    ),
                    rrb.TimeSeriesView(origin="curves/lag", name="Frames behind the source"),
                    row_shares=[3, 1, 1],
                ),
                column_shares=[3, 2],
            ),
            collapse_panels=True,
        )


def _world(segment: int) -> str:
    return f"map/{world_name(segment)}"
