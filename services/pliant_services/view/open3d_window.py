"""A result in Open3D's window: points, mesh, the camera's path, lines between matched places."""

import ctypes
import os
import sys
from typing import Any

import numpy as np

from pliant.algorithms.arrays import F64, I64
from pliant.api.result import Result
from pliant.errors import ResultError
from pliant.open3d_library import load_open3d
from pliant.pictures.map import BACKGROUND, FOCAL, PATH_COLOUR, PLACES_COLOUR, choose_view

_NO_WINDOW = "Open3D cannot open a window: check $DISPLAY"
_SIZE = (1280, 960)
_POINT_SIZE_PX = 2.0


def show(result: Result) -> None:
    """Show it until the window is closed.  Raises PliantError."""
    window = opened(result)
    try:
        window.run()
    finally:
        window.destroy_window()


def opened(result: Result) -> Any:
    """The window, with everything in it.

    Raises Open3dError if Open3D cannot be loaded, ResultError if there is no map, or no
    window can be opened.
    """
    if result.is_deformable or not len(result.trajectory):
        raise ResultError(f"{result.path}: has no map: use `pliant view` without --open3d")
    open3d = load_open3d()
    if not _display_answers():
        raise ResultError(_NO_WINDOW)
    shown = _shown(open3d, result)
    window = open3d.visualization.Visualizer()
    with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
        name = f"{result.path.name}: Pliant"
        if not window.create_window(window_name=name, width=_SIZE[0], height=_SIZE[1]):
            raise ResultError(_NO_WINDOW)
    options = window.get_render_option()
    options.background_color = np.array(BACKGROUND) / 255.0
    options.point_size = _POINT_SIZE_PX
    for each in shown:
        window.add_geometry(each)
    view = choose_view(np.asarray(result.points), result.trajectory.T_world_camera)
    camera = open3d.camera.PinholeCameraParameters()
    width, height = _SIZE
    focal, centre = FOCAL * height, (0.5 * width - 0.5, 0.5 * height - 0.5)
    camera.intrinsic = open3d.camera.PinholeCameraIntrinsic(width, height, focal, focal, *centre)
    camera.extrinsic = np.linalg.inv(view.T_world_view)
    window.get_view_control().convert_from_pinhole_camera_parameters(camera, True)
    return window


def _display_answers() -> bool:
    """Whether X has a display, if needed: without one Open3D draws into an invisible window."""
    if sys.platform != "linux" or os.environ.get("WAYLAND_DISPLAY"):
        return True
    x11: Any = ctypes.CDLL("libX11.so.6")
    x11.XOpenDisplay.restype = ctypes.c_void_p
    x11.XCloseDisplay.argtypes = [ctypes.c_void_p]
    display = x11.XOpenDisplay(None)
    if display:
        x11.XCloseDisplay(display)
    return bool(display)


def _shown(open3d: Any, result: Result) -> list[Any]:
    path = result.trajectory.positions
    steps = np.arange(len(path) - 1)
    parts = [
        result.points.to_open3d(),
        _lines(open3d, path, np.stack([steps, steps + 1], axis=1), PATH_COLOUR),
    ]
    places = result.history.same_places_in(result.history.longest_segment()).reshape(-1, 3)
    if len(places):
        parts.append(_lines(open3d, places, np.arange(len(places)).reshape(-1, 2), PLACES_COLOUR))
    if result.mesh is not None and len(result.mesh.triangles):
        parts.append(result.mesh.to_open3d())
    return parts


def _lines(open3d: Any, places: F64, pairs: I64, colour: tuple[int, int, int]) -> Any:
    lines = open3d.geometry.LineSet(
        open3d.utility.Vector3dVector(np.ascontiguousarray(places, np.float64)),
        open3d.utility.Vector2iVector(pairs.astype(np.int32)),
    )
    lines.paint_uniform_color(np.array(colour) / 255.0)
    return lines
