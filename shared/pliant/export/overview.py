"""A run in one picture: tracks on the image, points, mesh; moving, or still."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from pliant.algorithms.arrays import F64, U8
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.meshing.mesh_blocks import TriangleMesh
from pliant.algorithms.tracks import FrameTracks
from pliant.map_history import MapHistory, Points
from pliant.messages.types import MapUpdate
from pliant.pictures.caption import with_caption
from pliant.pictures.map import choose_view, render_map, turned
from pliant.pictures.mesh import draw_mesh
from pliant.pictures.movie import GROUND, beside
from pliant.pictures.overlay import OverlayFrame, TrackPainter

FPS = 10.0
FRAMES = 30
"""Number of frames of the run that are shown."""
_SWING, _FADE = 36, 4
"""Pictures of the swing, and of the way from one kind of picture to the next."""
_SWING_DEG = 45.0
"""So far the eye goes to either side: behind what it looks at the camera has seen little."""
_WIDTH, _HEIGHT, _GAP = 960, 360, 4  # pixels
_WIDE = 2.0
"""Columns over rows from which an image is above the map, not beside it."""
_STILL = (640, 480)
"""Columns and rows of each part of a still picture."""


class Layout:
    """The places of the image and the map, or of two pictures.  image, map: (columns, rows)."""

    def __init__(self, columns: int, rows: int) -> None:
        """columns, rows: of the images."""
        self._above = columns > _WIDE * rows
        if self._above:
            self.image = (_WIDTH, round(_WIDTH * rows / columns))
            self.map = (_WIDTH, _HEIGHT)
        else:
            self.image = (round(_HEIGHT * columns / rows), _HEIGHT)
            self.map = (_WIDTH - _GAP - self.image[0], _HEIGHT)

    def join(self, image: U8, map_picture: U8) -> U8:
        """Both as one picture."""
        small = cv2.resize(image, self.image, interpolation=cv2.INTER_AREA)
        if not self._above:
            return beside(np.asarray(small, np.uint8), map_picture)
        gap = np.full((_GAP, _WIDTH, 3), GROUND, np.uint8)
        return np.concatenate([np.asarray(small, np.uint8), gap, map_picture])


@dataclass(frozen=True)
class ShownFrame:
    """A frame of the run.  shown: None if it is not to be seen, but its tracks continue."""

    update: MapUpdate
    tracks: FrameTracks
    shown: OverlayFrame | None


@dataclass(frozen=True)
class Made:
    """The map of a run: its longest segment.

    source: name.      points: of the map.      poses: (N, 4, 4) T_world_camera.
    mesh: None if there is none.
    """

    source: str
    points: Points
    poses: F64
    mesh: TriangleMesh | None


def overview_pictures(frames: Iterable[ShownFrame], layout: Layout, what: Made) -> Iterator[U8]:
    """(H, W, 3) RGB pictures, FPS of them a second.  frames: all of the run."""
    last: U8 | None = None
    for picture, words in _growing(frames, layout, what):
        last = picture
        yield with_caption(picture, words)
    if last is None or what.mesh is None:
        return
    words = _words(what, f"{len(what.mesh.triangles):,} triangles")
    for number, picture in enumerate(_swinging(what, what.mesh, layout)):
        for step in range(1, _FADE + 1) if number == 0 else ():
            # Slow at its end: of a jump codecs keep a trace.
            share = 1.0 - (1.0 - step / (_FADE + 1)) ** 2
            mixed = cv2.addWeighted(last, 1.0 - share, picture, share, 0.0)
            yield with_caption(np.asarray(mixed, np.uint8), words)
        yield with_caption(picture, words)


def still_picture(frames: Iterable[ShownFrame], camera: PinholeCamera, what: Made) -> U8:
    """(H, W, 3) RGB: the frame to show with its tracks, the points, and the mesh if there is one.

    frames: all of the run, one with something to show, if any has images.
    """
    painter, panels = TrackPainter(scale=1), list[U8]()
    for frame in frames:
        if frame.shown is None:
            painter.follow(frame.tracks)
            continue
        size = (round(_STILL[1] * camera.width / camera.height), _STILL[1])
        small = cv2.resize(painter.paint(frame.shown), size, interpolation=cv2.INTER_AREA)
        panels.append(np.asarray(small, np.uint8))
        break
    view = choose_view(what.points.positions, what.poses)
    panels.append(
        render_map(what.points.positions, what.points.colours, what.poses, view=view, size=_STILL)
    )
    words = _words(what)
    if what.mesh is not None:
        panels.append(draw_mesh(what.mesh, view, size=_STILL).colours)
        words = _words(what, f"{len(what.mesh.triangles):,} triangles")
    return with_caption(beside(*panels), words)


def _growing(frames: Iterable[ShownFrame], layout: Layout, what: Made) -> Iterator[tuple[U8, str]]:
    """The tracks on the image next to the points mapped so far, with the visible ones."""
    view = choose_view(what.points.positions, what.poses, aspect=layout.map[0] / layout.map[1])
    history, painter = MapHistory(), TrackPainter(scale=1)
    for frame in frames:
        history.apply(frame.update, frame=frame.update.frame, stamp_ns=frame.update.stamp_ns)
        if frame.shown is None:
            painter.follow(frame.tracks)
            continue
        points, path = longest_segment(history)
        drawn = render_map(points.positions, points.colours, path, view=view, size=layout.map)
        words = f"frame {frame.update.frame}   {len(frame.tracks.ids):,} tracks   "
        words += f"{len(points.positions):,} points"
        yield layout.join(painter.paint(frame.shown), drawn), f"{what.source}   {words}"


def _swinging(what: Made, mesh: TriangleMesh, layout: Layout) -> Iterator[U8]:
    """Points and mesh, from one side, from the other, and back."""
    points, sizes = what.points, (layout.image, layout.map)
    aspect = min(columns / rows for columns, rows in sizes)
    view = choose_view(points.positions, what.poses, aspect=aspect, swing_deg=_SWING_DEG)
    for phase in np.linspace(0.0, 2.0 * np.pi, _SWING, endpoint=False):
        eye = turned(view, _SWING_DEG * float(np.sin(phase)))
        cloud = render_map(points.positions, points.colours, what.poses, view=eye, size=sizes[0])
        yield layout.join(cloud, draw_mesh(mesh, eye, size=sizes[1]).colours)


def _words(what: Made, *more: str) -> str:
    return "   ".join([what.source, f"{len(what.points.positions):,} points", *more])


def longest_segment(history: MapHistory) -> tuple[Points, F64]:
    """Points and (N, 4, 4) poses of one map segment: those of others lie in worlds of their own."""
    longest = history.longest_segment()
    path = history.trajectory_in(longest, history.final())
    return history.points_in(longest), path.T_world_camera
