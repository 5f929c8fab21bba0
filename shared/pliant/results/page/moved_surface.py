"""The surface of a deforming scene over time, coloured by its strain."""

from dataclasses import dataclass, field, replace

import numpy as np

from pliant.algorithms.arrays import F64, I32, U8
from pliant.algorithms.surfels.surface_over_time import surface_over_time
from pliant.algorithms.surfels.surface_strain import at_vertices, strains
from pliant.algorithms.surfels.surfel_frame import SurfelState
from pliant.messages.types import Surfels
from pliant.pictures.strain_colours import strain_colours, strain_scale
from pliant.results.page.scene import MovingMesh, Scene, make_scene

_MOST_KEYS, _LEAST_KEYS = 100, 25
_BYTES = 1_500_000
"""Most bytes of all key frames; the page has four thirds of them, as text."""
_VERTEX_BYTES, _TRIANGLE_BYTES = 9, 12


@dataclass
class Surface:
    """Folds the frames of one segment after the other; what is left is of the last."""

    last: Surfels | None = None
    _keys: list[Surfels] = field(default_factory=list[Surfels])
    _every: int = 1
    _taken: int = 0
    _path: list[F64] = field(default_factory=list[F64])

    def take(self, surfels: Surfels) -> None:
        """A frame whose surfels were followed."""
        if not (surfels.state == SurfelState.TRACKED).any():
            return
        if self.last is not None and self.last.segment != surfels.segment:
            self._keys, self._every, self._taken, self._path = [], 1, 0, []
        self.last = surfels
        self._path.append(surfels.T_world_camera)
        if self._taken % self._every == 0:
            self._keys.append(surfels)
            if len(self._keys) > _MOST_KEYS:
                self._keys, self._every = self._keys[::2], 2 * self._every
        self._taken += 1

    def scene(self) -> tuple[Scene, float]:
        """The surface that report.html can rotate and play, and the strain of its full colour.

        Some frame was taken.
        """
        assert self.last is not None
        keys = self._keys if self._keys[-1] is self.last else [*self._keys, self.last]
        mesh, full = moving_mesh(_affordable(keys))
        seen = self.last.positions[self.last.state == SurfelState.TRACKED]
        colours = strain_colours(np.zeros(len(seen)), full)
        path = np.array(self._path)
        return make_scene(seen, colours, path, mesh, frame_path=False), full


def _affordable(keys: list[Surfels]) -> list[Surfels]:
    """Fewer key frames, and then fewer surfels, where there are too many for a page.

    Between surfels there are hardly more than twice as many triangles.
    """
    each = _VERTEX_BYTES + 2 * _TRIANGLE_BYTES
    tracked = [int((frame.state == SurfelState.TRACKED).sum()) for frame in keys]
    while each * sum(tracked) > _BYTES and len(keys) > 2 * _LEAST_KEYS:
        keys, tracked = keys[::-1][::2][::-1], tracked[::-1][::2][::-1]
    share = -(-each * sum(tracked) // _BYTES)
    if share <= 1:
        return keys
    return [
        replace(frame, state=np.where(frame.ids % share, np.uint8(SurfelState.LOST), frame.state))
        for frame in keys
    ]


def moving_mesh(keys: list[Surfels]) -> tuple[MovingMesh, float]:
    """The surface in key frames of one segment, and the strain that has the full colour."""
    surface = surface_over_time(keys)
    changes = strains(surface)
    positions: list[F64] = []
    values: list[F64] = []
    triangles: list[I32] = []
    vertices = 0
    for places, shown, change in zip(surface.positions, surface.shown, changes, strict=True):
        mine = surface.triangles[shown]
        rows, own = np.unique(mine, return_inverse=True)
        own = own.reshape(-1, 3).astype(np.int32)
        positions.append(places[rows])
        values.append(at_vertices(own, change[shown], len(rows)))
        triangles.append(own + np.int32(vertices))
        vertices += len(rows)
    full = strain_scale(np.concatenate(values))
    colours: U8 = strain_colours(np.concatenate(values), full)
    lengths = [[len(each) for each in some] for some in (positions, triangles)]
    first_vertices, first_triangles = (np.cumsum([0, *some[:-1]]) for some in lengths)
    mesh = MovingMesh(
        positions=np.concatenate(positions),
        colours=colours,
        triangles=np.concatenate(triangles),
        first_vertices=first_vertices,
        first_triangles=first_triangles,
        names=[f"frame {frame.frame}" for frame in keys],
        times_s=[(frame.stamp_ns - keys[0].stamp_ns) / 1e9 for frame in keys],
    )
    return mesh, full
