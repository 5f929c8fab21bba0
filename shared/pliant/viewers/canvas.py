"""The drawing interface that every viewer implements."""

from dataclasses import dataclass
from typing import Protocol

from pliant.algorithms.arrays import F32, F64, I32
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.meshing.mesh_blocks import TriangleMesh
from pliant.viewers.point_blocks import PointBlocks
from pliant.viewers.surfel_quads import SurfelPicture


@dataclass(frozen=True)
class Moment:
    """The frame that a drawing belongs to, and its capture time."""

    frame: int
    stamp_ns: int


class Canvas(Protocol):
    """Draws.  Worlds are numbered by map segment; each has a place and a scale of its own."""

    dims_masks: bool
    """Whether images are for the eye, and show dark what their masks leave out."""

    def camera(
        self, at: Moment, camera: PinholeCamera, lens: tuple[float, float] = (0.0, 0.0)
    ) -> None:
        """The camera of all images; comes first, and again when a better one was found.

        lens: k1 and k2 of what rectification left: ``u = fx (1 + k1 r^2 + k2 r^4) x + cx``.
        """
        ...

    def level(self) -> None:
        """The z axes of all worlds are up; else a camera that began one saw it upright."""
        ...

    def image(self, at: Moment, data: bytes, encoding: str) -> None:
        """A rectified image as the bytes of a file, "jpeg" or "png"."""
        ...

    def tracks(self, at: Moment, points_px: F32, ages: I32) -> None:
        """(N, 2) tracks on the image, (0, 0) at the centre of the top-left pixel; (N,) ages."""
        ...

    def pose(self, at: Moment, segment: int, pose_world_camera: F64) -> None:
        """Where the camera is: (x, y, z, qx, qy, qz, qw)."""
        ...

    def path(self, at: Moment, segment: int, positions: F64) -> None:
        """(N, 3) positions of the keyframes in order of time."""
        ...

    def places(self, at: Moment, segment: int, lines: F64) -> None:
        """(L, 2, 3) lines between keyframes that show one place, in place of those before."""
        ...

    def points(self, at: Moment, segment: int, points: PointBlocks, changed: list[int]) -> None:
        """The map's points; ``changed`` names the blocks that differ from the last time."""
        ...

    def whole_map(self, at: Moment, segment: int, points: PointBlocks) -> None:
        """The points after the last update."""
        ...

    def mesh(self, at: Moment, segment: int, name: str, mesh: TriangleMesh) -> None:
        """A piece of surface, in place of what had this name; without triangles it goes."""
        ...

    def surfels(self, at: Moment, segment: int, surfels: SurfelPicture) -> None:
        """All surfels, in the world and on the image, in place of those before."""
        ...

    def surface(self, at: Moment, segment: int, mesh: TriangleMesh) -> None:
        """The mesh between surfels, seen from both sides, in place of that before."""
        ...

    def forget(self, at: Moment, segment: int) -> None:
        """A world has ended: the map was lost and another one has begun."""
        ...

    def measure(self, at: Moment, name: str, value: float) -> None:
        """One value of a curve, such as "rate/tracking"."""
        ...

    def note(self, at: Moment, text: str) -> None:
        """A line for the user."""
        ...
