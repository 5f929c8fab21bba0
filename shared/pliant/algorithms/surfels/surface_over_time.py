"""One set of vertices and triangles for the surface between surfels in several frames."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from pliant.algorithms.arrays import F64, I32, I64, BoolArray, Shape
from pliant.algorithms.surfels.surface import surface_of
from pliant.algorithms.surfels.surfel_frame import SurfelFrame, SurfelState


@dataclass(frozen=True)
class SurfaceOverTime:
    """N surfels and T triangles in K frames of one segment.

    ids: ascending.    positions: world, NaN where a surfel is not tracked.
    triangles: indices into ``ids``.    shown: frames in which a triangle is part of the surface.
    """

    ids: Annotated[I64, Shape("N")]
    positions: Annotated[F64, Shape("K", "N", 3)]
    triangles: Annotated[I32, Shape("T", 3)]
    shown: Annotated[BoolArray, Shape("K", "T")]


def surface_over_time(frames: Sequence[SurfelFrame]) -> SurfaceOverTime:
    """All triangles of ``surface_of`` in frames of one segment, each shown where it is one of them.

    Triangles that are kept while their surfels are tracked were tried instead: few are saved, and
    surfels that come back, or are born later, find no place between those that have stayed.
    """
    tracked = [frame.state == SurfelState.TRACKED for frame in frames]
    ids = np.unique(np.concatenate([f.ids[t] for f, t in zip(frames, tracked, strict=True)]))
    positions = np.full((len(frames), len(ids), 3), np.nan)
    members: list[I64] = []
    for frame, now, places in zip(frames, tracked, positions, strict=True):
        places[np.searchsorted(ids, frame.ids[now])] = frame.positions[now]
        rows, _, triangles = surface_of(frame)
        corners = np.searchsorted(ids, frame.ids[rows])[triangles]
        first = corners.argmin(axis=1)[:, None]  # the same direction from any corner
        members.append(np.take_along_axis(corners, (first + np.arange(3)) % 3, axis=1))
    triangles, which = np.unique(np.concatenate(members), axis=0, return_inverse=True)
    shown = np.zeros((len(frames), len(triangles)), bool)
    shown[np.repeat(np.arange(len(frames)), [len(each) for each in members]), which.ravel()] = True
    return SurfaceOverTime(ids, positions, triangles.astype(np.int32), shown)
