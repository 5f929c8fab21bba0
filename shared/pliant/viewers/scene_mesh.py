"""The meshes of a run on a canvas: the growing live mesh, then the final one."""

from pliant.algorithms.meshing.mesh_blocks import TriangleMesh, no_blocks, unwelded
from pliant.errors import MessageError
from pliant.messages.mesh_pieces import PIECE_TRIANGLES, joined
from pliant.messages.types import MeshPiece, MeshUpdate
from pliant.viewers.canvas import Canvas, Moment
from pliant.viewers.mesh_groups import MeshGroups

_RANK = {"coarse": 1, "fine": 2}
EMPTY = unwelded(no_blocks())


class SceneMesh:
    """The mesh of one segment of the map, the one that the camera is in; no other one is drawn.

    One surface is seen at a time: two of the same room would flicker through each other.  The
    final mesh takes the place of the live one; the fine one is shown, and the coarse one only where
    no fine one came (it may need more memory than it may have, or a slow viewer lost a piece).
    """

    def __init__(self, canvas: Canvas) -> None:
        self._canvas = canvas
        self.segment = -1
        self._newest = -1
        self._live = MeshGroups()
        self._pieces: list[MeshPiece] = []
        self._rank = 0
        self._drawn: list[str] = []

    @property
    def is_final(self) -> bool:
        """Whether a final mesh is shown."""
        return self._rank > 0

    def begin(self, at: Moment, segment: int) -> None:
        """A new world, or an earlier one again: remove what was drawn in the world before."""
        if segment == self.segment:
            return
        self._clear(at)
        self.segment, self._newest = segment, max(segment, self._newest)
        self._live, self._pieces, self._rank = MeshGroups(), [], 0

    def take_blocks(self, at: Moment, update: MeshUpdate) -> None:
        """Draw the groups that changed."""
        if update.segment > self._newest:
            self.begin(at, update.segment)
        if update.segment != self.segment or self.is_final:
            return
        self._live.take(update)
        for name in self._live.take_changed():
            self._canvas.mesh(at, self.segment, f"live/{name}", self._live.group(name))

    def take_piece(self, at: Moment, piece: MeshPiece) -> None:
        """Draw a final mesh once all its pieces are there."""
        if piece.segment > self._newest:
            self.begin(at, piece.segment)
        rank = _RANK.get(piece.level, 0)
        if piece.segment != self.segment or rank <= self._rank:
            return
        if piece.piece == 0 or (self._pieces and self._pieces[0].level != piece.level):
            self._pieces = []
        self._pieces.append(piece)
        if piece.piece != piece.pieces - 1:
            return
        pieces, self._pieces = self._pieces, []
        try:
            mesh = joined(pieces)
        except MessageError:  # one was lost on the way, or another level began
            return
        self.show(at, mesh, rank)

    def show(self, at: Moment, mesh: TriangleMesh, rank: int = max(_RANK.values())) -> None:
        """Draw a final mesh in the place of all else."""
        self._clear(at)
        self._rank = rank
        for part, first in enumerate(range(0, len(mesh.triangles), PIECE_TRIANGLES)):
            name = f"final/{part}"
            self._drawn.append(name)
            self._canvas.mesh(
                at,
                max(0, self.segment),
                name,
                mesh.of_triangles(slice(first, first + PIECE_TRIANGLES)),
            )

    def _clear(self, at: Moment) -> None:
        for name in (*self._drawn, *(f"live/{group}" for group in self._live.names())):
            self._canvas.mesh(at, max(0, self.segment), name, EMPTY)
        self._live, self._drawn = MeshGroups(), []
