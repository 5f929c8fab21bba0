"""What a user may change about the fusion of depth maps into a mesh."""

from pydantic import Field

from pliant.algorithms.parameters import Parameters


class TsdfParameters(Parameters):
    """Sizes are in units of the scene's median depth, as a monocular scale is arbitrary.

    The paper's voxels of 15 cm and 2.5 cm belong to EuRoC's rooms, whose median depth is about 3 m.
    """

    coarse_voxel: float = Field(
        default=1 / 20,
        gt=0.0,
        le=1.0,
        description="Voxel of the live mesh, as a share of the scene's median depth.",
    )
    fine_voxel: float = Field(
        default=1 / 120,
        gt=0.0,
        le=1.0,
        description="Voxel of the final mesh, as a share of the scene's median depth.",
    )
    truncation_voxels: float = Field(
        default=4.0,
        ge=2.0,
        le=16.0,
        description="Distances to the surface are kept up to so many voxels.",
    )
    min_weight: float = Field(
        default=0.1,
        ge=0.0,
        description="Voxels whose weights sum to less are not meshed: one sight, face on, weighs 1 "
        "where its depth is certain, 0.5 where it may be 1 % off, 0.1 where it may be 3 % off.",
    )
    free_space: bool = Field(
        default=True, description="What a keyframe sees through counts against surface there."
    )
    max_memory_mb: int = Field(
        default=2000, ge=1, description="Memory of one volume, MB: a finer voxel is refused."
    )
