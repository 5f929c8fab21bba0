"""Parts of a scene: solids, their materials and the lights.  Metres, world z up."""

from typing import Literal, NamedTuple

import numpy as np
from pydantic import Field

from pliant.algorithms.arrays import F64, I32
from pliant.algorithms.parameters import Parameters

Kind = Literal["room", "box", "sphere", "cylinder"]
KINDS: tuple[Kind, ...] = ("room", "box", "sphere", "cylinder")
FACES_OF_KIND: dict[Kind, int] = {"room": 6, "box": 6, "sphere": 6, "cylinder": 3}
Vector = tuple[float, float, float]


class Material(Parameters):
    """How the surfaces of a solid look.  Grey values are those of a surface in full light."""

    brightness: float = Field(default=130.0, description="Mean grey value (0 to 255).")
    contrast: float = Field(default=30.0, description="Deviation of the marks' grey values.")
    noise: float = Field(default=5.0, description="Amplitude of each octave of noise, grey values.")
    coverage: float = Field(
        default=0.2, description="Share of the surface that each octave of marks covers."
    )
    writing: float = Field(
        default=0.0, description="Share of the lines of a text that are written (0: none)."
    )
    stretch: float = Field(default=1.0, description="Length over width of the noise, as in wood.")
    tint: Vector = Field(
        default=(1.0, 1.0, 1.0), description="Red, green and blue for colour images."
    )
    hues: tuple[Vector, ...] = Field(
        default=(), description="Red, green and blue that marks may have instead."
    )


class Solid(Parameters):
    """One convex solid; ``room`` is a box seen from its inside."""

    name: str = Field(description="For people; the texture does not depend on it.")
    kind: Kind = Field(description="Shape.")
    centre: Vector = Field(description="Middle of the solid in the world, metres.")
    size: Vector = Field(description="Extent along the own axes, metres; a cylinder is along z.")
    rotation: Vector = Field(
        default=(0.0, 0.0, 0.0), description="Rotation vector, own axes to world, rad."
    )
    material: Material = Field(default=Material(), description="How its surfaces look.")
    texels_per_metre: float = Field(
        default=500.0, gt=0.0, description="Resolution of its textures."
    )


class Scene(Parameters):
    """Solids and lights: everything that determines a picture but the camera."""

    name: str = Field(description="Name of the scene.")
    solids: tuple[Solid, ...] = Field(description="Solids; a room, if any, comes first.")
    lights: tuple[Vector, ...] = Field(description="Positions of the lamps, metres.")
    ambient: float = Field(
        default=0.55, description="Share of the full light that comes from everywhere."
    )
    depth_scale: float = Field(
        default=1.25e-4, description="Metres per step of the 16 bit depth images."
    )
    seed: int = Field(default=0, description="Seed of the textures.")


class SolidArrays(NamedTuple):
    """The geometry of a scene as kernels read it, S solids."""

    kind: I32  # (S,) index into KINDS
    half: F64  # (S, 3) half extents, metres
    rotation: F64  # (S, 3, 3) R_world_solid
    centre: F64  # (S, 3) metres, world
    first_face: I32  # (S,) number of the solid's first face


def solid_arrays(scene: Scene, rotations: F64) -> SolidArrays:
    """Pack a scene.  rotations: (S, 3, 3) R_world_solid."""
    counts = [FACES_OF_KIND[solid.kind] for solid in scene.solids]
    return SolidArrays(
        kind=np.array([KINDS.index(solid.kind) for solid in scene.solids], np.int32),
        half=np.array([solid.size for solid in scene.solids], np.float64) / 2.0,
        rotation=np.ascontiguousarray(rotations),
        centre=np.array([solid.centre for solid in scene.solids], np.float64),
        first_face=np.concatenate([[0], np.cumsum(counts)[:-1]]).astype(np.int32),
    )


def face_sizes(scene: Scene) -> list[tuple[Solid, float, float]]:
    """The faces of all solids in order: (solid, width, height) of the texture in metres."""
    out: list[tuple[Solid, float, float]] = []
    for solid in scene.solids:
        x, y, z = solid.size
        if solid.kind == "sphere":
            # A cube map with equal angles: a face spans a quarter of the circumference.
            out += [(solid, x * np.pi / 4.0, x * np.pi / 4.0)] * 6
        elif solid.kind == "cylinder":
            out += [(solid, x * np.pi, z), (solid, x, x), (solid, x, x)]
        else:
            out += [(solid, y, z)] * 2 + [(solid, x, z)] * 2 + [(solid, x, y)] * 2
    return out
