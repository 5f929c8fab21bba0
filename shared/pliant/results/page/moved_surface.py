"""The surface of a deforming scene at the end of a run, coloured by its motion."""

from dataclasses import dataclass, field

import cv2
import numpy as np

from pliant.algorithms.arrays import F64, U8
from pliant.algorithms.meshing.mesh_blocks import TriangleMesh
from pliant.algorithms.surfels.surface import surface_of
from pliant.algorithms.surfels.surfel_frame import SurfelState
from pliant.messages.types import Surfels
from pliant.results.page.scene import Scene, make_scene

_NEARLY_ALL = 0.95


@dataclass
class Surface:
    """Folds the frames of one segment after the other; what is left is of the last."""

    last: Surfels | None = None
    _born: dict[int, F64] = field(default_factory=dict[int, F64])
    _path: list[F64] = field(default_factory=list[F64])

    def take(self, surfels: Surfels) -> None:
        """A frame whose surfels were followed."""
        if not (surfels.state == SurfelState.TRACKED).any():
            return
        if self.last is not None and self.last.segment != surfels.segment:
            self._born.clear()
            self._path.clear()
        self.last = surfels
        self._path.append(surfels.T_world_camera)
        for number, position in zip(surfels.ids.tolist(), surfels.positions, strict=True):
            self._born.setdefault(number, position)

    def scene(self) -> Scene:
        """The surface that report.html can rotate.  Some frame was taken."""
        assert self.last is not None
        rows, normals, triangles = surface_of(self.last)
        positions = self.last.positions[rows]
        colours = self._colours(positions, self.last.ids[rows].tolist())
        # Seen from both sides: a cloth has no inside.
        both = np.concatenate([triangles, triangles[:, ::-1] + len(rows)]).astype(np.int32)
        mesh = TriangleMesh(
            positions=np.tile(positions, (2, 1)).astype(np.float32),
            normals=np.concatenate([normals, -normals]),
            colours=np.tile(colours, (2, 1)),
            triangles=both,
        )
        return make_scene(positions, colours, np.array(self._path), mesh, frame_path=False)

    def _colours(self, positions: F64, ids: list[int]) -> U8:
        """(N, 3) RGB."""
        moved = np.linalg.norm(
            positions - np.array([self._born[number] for number in ids]).reshape(-1, 3), axis=1
        )
        most = float(np.quantile(moved, _NEARLY_ALL)) if len(moved) else 0.0
        shades = np.round(40.0 + 215.0 * np.clip(moved / max(most, 1e-12), 0.0, 1.0))
        tints = cv2.applyColorMap(shades.astype(np.uint8)[:, None], cv2.COLORMAP_TURBO)
        return np.asarray(tints.reshape(-1, 3)[:, ::-1], np.uint8)
