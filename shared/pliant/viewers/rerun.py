"""A run as Rerun entities: in its viewer, in a browser, or in an ``.rrd`` file.

    map/camera/image, .../tracks, .../surfels   the image with its tracks, at the camera
    map/world/points/N, path                    the map; each block by itself: little is sent
    map/world/places                            lines between keyframes that show one place
    map/world/mesh/live/X_Y_Z, mesh/final/N     the mesh, in groups of blocks while it grows
    map/world/surfels, .../surface              small quads, and the mesh between them
    curves/lag, milliseconds, rate, stages      how the services fare
    notes                                       lines for the user

The camera is outside the worlds of the map's segments.  So the image stays in its place when the
map is lost and the next world begins.

Time runs by "frame" and by "capture".  Needs Rerun: ``pip install 'pliant[view]'``.
"""

import importlib
import os
from contextlib import nullcontext
from pathlib import Path
from typing import Any, Literal

import numpy as np

from pliant.algorithms.arrays import F32, F64, I32
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import matrix_to_pose, pose_to_matrix
from pliant.algorithms.meshing.mesh_blocks import TriangleMesh
from pliant.errors import ResultError
from pliant.pictures.map import PLACES_COLOUR
from pliant.viewers.age_colours import track_colours
from pliant.viewers.canvas import Moment
from pliant.viewers.foxglove import LEVEL_XYZW, Z_UP_XYZW, world_name
from pliant.viewers.point_blocks import PointBlocks
from pliant.viewers.rerun_data import RerunData
from pliant.viewers.rerun_page import RerunPage
from pliant.viewers.rerun_program import RerunProgram, address_of, free_port, listens
from pliant.viewers.surfel_quads import SurfelPicture

Where = Literal["window", "web"] | Path
"""Rerun's own window, a browser, or a file."""

_PATH_COLOUR = (255, 160, 0)
_IMAGE_DISTANCE = 0.3  # of the frustum, in the map's arbitrary unit
_ANSWER_S = 1.0
_POINT_RADIUS = 1.0  # the mesh is seen between them
_SERVICE_COLOURS = ((80, 160, 255), (255, 160, 0), (90, 200, 110), (230, 90, 160), (200, 200, 90))
_SURFEL_RADIUS = 2.5
_OUTSIDE_IS_OPEN = "Front"  # a room is looked into from without
_MEMORY_LIMIT = 1 << 30
_WEB_PORT, _GRPC_PORT = 9090, 9876
_LAYOUT = "pliant-2"
"""Rerun keeps a user's layout by this name: to be counted up when entities or views change."""
_CAMERA = "map/camera"
_IMAGE = f"{_CAMERA}/image"


def load_rerun() -> Any:
    """The library, told to send nothing to its makers.  ResultError if it is missing."""
    # Read when the library is loaded, and by the viewer that it starts.
    for name in ("RERUN_ANALYTICS_ENABLED", "RERUN_ALLOW_UPDATE_CHECK"):
        os.environ[name] = "0"
    try:
        return importlib.import_module("rerun")
    except ImportError:
        raise ResultError("Rerun is not installed: pip install 'pliant[view]'") from None


class RerunCanvas:
    """A canvas that is a Rerun recording."""

    dims_masks = True

    def __init__(self, where: Where, *, name: str, web_port: int | None = None) -> None:
        """Open it.  Raises ResultError if Rerun is missing or the file cannot be written.

        web_port: where a browser finds it, by default Rerun's own, or where that is taken another
        that is free.
        """
        self._rr = rr = load_rerun()
        self._server: RerunProgram | None = None
        self._page: RerunPage | None = None
        self._data: RerunData | None = None
        self._stream: Any = rr.RecordingStream(_LAYOUT, recording_id=name)
        self._segment = 0
        self._turned_xyzw = Z_UP_XYZW
        self._is_window = False
        self._curves: set[str] = set()
        self._services: dict[str, int] = {}
        blueprint = self._blueprint(follows=not isinstance(where, Path))
        if isinstance(where, Path):
            try:
                where.open("wb").close()
            except OSError as error:
                raise ResultError(f"{where}: cannot be written ({error.strerror})") from None
            self._stream.save(where, default_blueprint=blueprint)
        elif where == "web":
            self._data = RerunData(self._stream, most_bytes=_MEMORY_LIMIT)
            with self._data.staying():
                self._stream.send_blueprint(blueprint)
            try:
                self.address = self._serve(web_port or free_port(_WEB_PORT), self._data)
            except ResultError:
                if web_port:
                    raise
                # Another viewer may have begun meanwhile, and has what was free.
                self.address = self._serve(free_port(), self._data)
        else:
            self._is_window = True
            if not listens(_GRPC_PORT):  # else one is open already
                RerunProgram([_GRPC_PORT], ["--hide-welcome-screen", "--memory-limit", "50%"])
            self._stream.connect_grpc(address_of(_GRPC_PORT), default_blueprint=blueprint)
        self._place_world(0)

    def _serve(self, web_port: int, data: RerunData) -> str:
        """Let browsers look on at this port.  Returns the address for them."""
        behind = free_port()
        serving = ["--serve-web", "--web-viewer-port", str(behind)]  # it has the page, and no data
        self._server = RerunProgram([free_port(), behind], serving)
        try:
            self._page = RerunPage(web_port, behind=behind, data=data)
        except ResultError:
            self._server.close()
            raise
        return self._page.address

    address = ""
    """Where a browser finds it."""

    @property
    def is_watched(self) -> bool:
        """False if a window was to be drawn in and is closed, or never opened."""
        if not self._is_window:
            return True
        return listens(_GRPC_PORT)

    def send(self) -> None:
        """Send what is left.

        What a window did not take before it was closed goes: Rerun would wait for it without end.
        """
        while self.is_watched:
            try:
                self._stream.flush(timeout_sec=_ANSWER_S)
                break
            except RuntimeError:  # not yet: it may be slow, or gone
                continue

    def close(self) -> None:
        """Send what is left, and finish a file; nothing can be seen in a browser any more."""
        self.send()
        if self._data is not None:
            self._data.close()
        self._stream.disconnect()
        if self._page is not None:
            self._page.close()
        if self._server is not None:
            self._server.close()

    # -- the canvas ----------------------------------------------------------------------------

    def camera(
        self, at: Moment, camera: PinholeCamera, lens: tuple[float, float] = (0.0, 0.0)
    ) -> None:
        """The pinhole, whose origin is the corner of the first pixel in Rerun; it has no lens."""
        pinhole = self._rr.Pinhole(
            resolution=(camera.width, camera.height),
            focal_length=(camera.fx, camera.fy),
            principal_point=(camera.cx + 0.5, camera.cy + 0.5),
            camera_xyz=self._rr.ViewCoordinates.RDF,
            image_plane_distance=_IMAGE_DISTANCE,
        )
        self._log_for_good(_IMAGE, pinhole)

    def level(self) -> None:
        """The worlds are turned as the map is."""
        self._turned_xyzw = LEVEL_XYZW

    def image(self, at: Moment, data: bytes, encoding: str) -> None:
        """The image as it is encoded."""
        image = self._rr.EncodedImage(contents=data, media_type=f"image/{encoding}")
        self._log(at, _IMAGE, image)

    def tracks(self, at: Moment, points_px: F32, ages: I32) -> None:
        """Tracks by age, blue to orange."""
        points = self._rr.Points2D(points_px + 0.5, colors=track_colours(ages), radii=1.5)
        self._log(at, f"{_IMAGE}/tracks", points)

    def pose(self, at: Moment, segment: int, pose_world_camera: F64) -> None:
        """Where the camera is."""
        if segment != self._segment:
            self._place_world(segment)
        T_map_world = pose_to_matrix(np.array([0.0, 0.0, 0.0, *self._turned_xyzw]))
        pose = matrix_to_pose(T_map_world @ pose_to_matrix(pose_world_camera))
        placed = self._rr.Transform3D(
            translation=pose[:3], quaternion=self._rr.Quaternion(xyzw=pose[3:])
        )
        self._log(at, _CAMERA, placed)

    def path(self, at: Moment, segment: int, positions: F64) -> None:
        """One line through the keyframes."""
        line = self._rr.LineStrips3D([positions], colors=[_PATH_COLOUR])
        self._log(at, f"{_world(segment)}/path", line)

    def places(self, at: Moment, segment: int, lines: F64) -> None:
        """A line for each pair."""
        strips = self._rr.LineStrips3D(lines, colors=[PLACES_COLOUR])
        self._log(at, f"{_world(segment)}/places", strips)

    def points(self, at: Moment, segment: int, points: PointBlocks, changed: list[int]) -> None:
        """The blocks that changed."""
        for number in changed:
            xyz, rgb = points.block(number)
            radius = self._rr.Radius.ui_points(_POINT_RADIUS)
            cloud = self._rr.Points3D(xyz, colors=rgb, radii=radius)
            self._log(at, f"{_world(segment)}/points/{number}", cloud)

    def whole_map(self, at: Moment, segment: int, points: PointBlocks) -> None:
        """Nothing: the blocks stay."""

    def mesh(self, at: Moment, segment: int, name: str, mesh: TriangleMesh) -> None:
        """A piece of surface."""
        self._log_mesh(at, f"{_world(segment)}/mesh/{name}", mesh, _OUTSIDE_IS_OPEN)

    def surfels(self, at: Moment, segment: int, surfels: SurfelPicture) -> None:
        """All quads as one mesh, and their centres on the image."""
        self._log_mesh(at, f"{_world(segment)}/surfels", surfels.quads, "DoubleSided")
        points = self._rr.Points2D(
            surfels.points_px + 0.5, colors=surfels.point_colours, radii=_SURFEL_RADIUS
        )
        self._log(at, f"{_IMAGE}/surfels", points)

    def surface(self, at: Moment, segment: int, mesh: TriangleMesh) -> None:
        """As one mesh."""
        self._log_mesh(at, f"{_world(segment)}/surface", mesh, "DoubleSided")

    def forget(self, at: Moment, segment: int) -> None:
        """Clear a world."""
        self._log(at, _world(segment), self._rr.Clear(recursive=True))

    def measure(self, at: Moment, name: str, value: float) -> None:
        """A point of a curve."""
        path = f"curves/{name.replace(' ', '_')}"
        _, service, *stage = name.split("/")
        if not stage and path not in self._curves:
            self._curves.add(path)
            order = self._services.setdefault(service, len(self._services))
            colour = _SERVICE_COLOURS[order % len(_SERVICE_COLOURS)]
            line = self._rr.SeriesLines(colors=[colour], names=[service])
            self._log_for_good(path, line)
        self._log(at, path, self._rr.Scalars(value))

    def note(self, at: Moment, text: str) -> None:
        """A line of the log."""
        self._log(at, "notes", self._rr.TextLog(text))

    # -- entities ------------------------------------------------------------------------------

    def _place_world(self, segment: int) -> None:
        self._segment = segment
        turned = self._rr.Transform3D(quaternion=self._rr.Quaternion(xyzw=self._turned_xyzw))
        self._log_for_good("map", self._rr.ViewCoordinates.RIGHT_HAND_Z_UP)
        self._log_for_good(_world(segment), turned)

    def _log_mesh(self, at: Moment, path: str, mesh: TriangleMesh, faces: str) -> None:
        if not len(mesh.triangles):
            self._log(at, path, self._rr.Clear(recursive=False))
            return
        surface = self._rr.Mesh3D(
            vertex_positions=mesh.positions,
            triangle_indices=mesh.triangles,
            vertex_normals=mesh.normals,
            vertex_colors=mesh.colours,
            face_rendering=faces,
        )
        self._log(at, path, surface)

    def _log_for_good(self, path: str, what: Any) -> None:
        with self._data.staying() if self._data else nullcontext():
            self._stream.log(path, what, static=True)

    def _log(self, at: Moment, path: str, what: Any) -> None:
        self._stream.set_time("frame", sequence=at.frame)
        self._stream.set_time("capture", duration=at.stamp_ns * 1e-9)
        self._stream.log(path, what)

    def _blueprint(self, *, follows: bool) -> Any:
        """follows: shows what is newest, instead of playing from the beginning."""
        rrb: Any = importlib.import_module("rerun.blueprint")
        no_legend = rrb.PlotLegend(visible=False)  # a service has one colour in all plots
        return rrb.Blueprint(
            rrb.Horizontal(
                rrb.Spatial3DView(origin="map", name="Map"),
                rrb.Vertical(
                    rrb.Spatial2DView(origin=_IMAGE, name="Image", contents="$origin/**"),
                    rrb.TimeSeriesView(
                        origin="curves/milliseconds",
                        name="Milliseconds per frame",
                        plot_legend=rrb.PlotLegend(corner="LeftTop"),
                    ),
                    rrb.Horizontal(
                        rrb.TimeSeriesView(
                            origin="curves/rate", name="Frames per second", plot_legend=no_legend
                        ),
                        rrb.TimeSeriesView(
                            origin="curves/lag",
                            name="Frames behind the source",
                            plot_legend=no_legend,
                        ),
                    ),
                    row_shares=[3, 1, 1],
                ),
                column_shares=[3, 2],
            ),
            rrb.TimePanel(state="collapsed", play_state="following" if follows else "playing"),
            collapse_panels=True,
        )


def _world(segment: int) -> str:
    return f"map/{world_name(segment)}"
