"""The live mesh of a viewer: in groups of blocks, of which changed ones are drawn.

A single block would be an entity of a hundred triangles, and thousands of them are slow to draw.
The cost of drawing the whole mesh with each keyframe would grow with the map and not with the
change.
"""

import numpy as np

from pliant.algorithms.arrays import I32
from pliant.algorithms.meshing.mesh_blocks import BlockMesh, TriangleMesh, pack, unwelded
from pliant.messages.types import MeshUpdate

GROUP_BLOCKS = 4
"""Along the side of a group.  A surface meets some 16 to 30 of its 64 blocks."""


class MeshGroups:
    """The live mesh of one segment.  Memory: the blocks that are held."""

    def __init__(self) -> None:
        self.held = BlockMesh()
        self._members: dict[str, set[int]] = {}
        self._changed: set[str] = set()

    def take(self, update: MeshUpdate) -> None:
        """Add blocks; unchanged ones have no effect."""
        new = self.held.changes(update)
        self.held.apply(new)
        here, gone = new.keys[new.triangle_counts > 0], new.keys[new.triangle_counts == 0]
        for name, key in _named(here):
            self._members.setdefault(name, set()).add(key)
            self._changed.add(name)
        cleared = self.held.clear_span(update.keys, update.first_key, update.last_key)
        for name, key in _named(np.concatenate([gone, cleared])):
            self._members.get(name, set()).discard(key)
            self._changed.add(name)

    def take_changed(self) -> list[str]:
        """Names of the groups that changed since the last call, in order."""
        changed, self._changed = sorted(self._changed), set()
        return changed

    def names(self) -> list[str]:
        """Names of the groups that have triangles, in order."""
        return sorted(name for name, keys in self._members.items() if keys)

    def group(self, name: str) -> TriangleMesh:
        """The triangles of a group.

        Blocks stay unwelded: what a viewer holds need not be of one time.
        """
        return unwelded(self.held.blocks(sorted(self._members.get(name, ()))))


def _named(keys: I32) -> list[tuple[str, int]]:
    """The name of the group of each block, and its packed key."""
    groups = (keys // GROUP_BLOCKS).tolist()
    return [
        ("_".join(map(str, group)), key)
        for group, key in zip(groups, pack(keys).tolist(), strict=True)
    ]
