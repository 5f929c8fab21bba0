"""Everything that a user may change about meshing."""

from typing import Literal

from pydantic import Field

from pliant.algorithms.parameters import Parameters


class NltgvParameters(Parameters):
    """What a user may change about smoothing.  Weights have no unit; see the module."""

    data_weight: float = Field(
        default=0.5, gt=0.0, description="Weight of the data against the smoothness (lambda)."
    )
    slope_weight: float = Field(
        default=3.0, gt=0.0, description="Weight of changes of slope against those of depth."
    )
    huber_sigmas: float = Field(
        default=1.0, ge=0.0, description="Data deviate squared up to so many sigmas, then linearly."
    )
    edge_sigmas: float = Field(
        default=5.0,
        ge=0.0,
        description="An edge that misses the surface by so many sigmas weighs half.  0: all alike.",
    )
    data_sigmas: float = Field(
        default=5.0,
        ge=0.0,
        description="Data off the surface by so many sigmas weigh half.  0: all alike.",
    )
    reweightings: int = Field(
        default=2, ge=1, le=50, description="How often weights are taken from the residuals."
    )
    max_iterations: int = Field(
        default=200, ge=1, description="Most primal-dual iterations for one set of weights."
    )
    min_change_sigmas: float = Field(
        default=0.04,
        ge=0.0,
        description="Stop when an iteration changes inverse depth less (rms, in median sigmas).",
    )
    relaxation: float = Field(
        default=1.9, ge=1.0, lt=2.0, description="Over-relaxation of the iteration (rho)."
    )


class TriangleFilterParameters(Parameters):
    """What a user may change about which triangles are kept."""

    max_edge_px: float = Field(
        default=100.0, gt=0.0, description="Longest edge of a triangle in the image, px."
    )
    max_depth_ratio: float = Field(
        default=1.4,
        gt=1.0,
        description="Largest over smallest depth of a triangle's corners: more is a jump.",
    )
    max_slant_deg: float = Field(
        default=75.0,
        gt=0.0,
        le=90.0,
        description="Largest angle between a triangle's normal and the ray to its centre, degrees.",
    )
    max_relative_sigma: float = Field(
        default=0.1,
        gt=0.0,
        description="Corners whose inverse depth is less certain (sigma over itself) are not used.",
    )
    min_observations: int = Field(
        default=2, ge=1, description="Corners seen in fewer frames are not used."
    )


class SurfaceParameters(Parameters):
    """How the points of a keyframe become a surface."""

    smoothing: Literal["nltgv", "laplacian", "none"] = Field(
        default="nltgv", description="How inverse depth is smoothed; the others are to compare."
    )
    max_error_px: float = Field(
        default=2.0, gt=0.0, description="Points that project farther from where they are seen, px"
    )
    noise_px: float = Field(
        default=0.5,
        gt=0.0,
        description="Standard deviation of an observation, px: scales the uncertainty of points.",
    )
    nltgv: NltgvParameters = NltgvParameters(data_weight=1.0)
    triangles: TriangleFilterParameters = TriangleFilterParameters()


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
    dense_min_weight: float = Field(
        default=0.01,
        ge=0.0,
        description="The same for meshing.depth=dense, which fills with a weight of 0.01 what no "
        "keyframe has a surface of.",
    )
    free_space: bool = Field(
        default=True, description="What a keyframe sees through counts against surface there."
    )
    max_memory_mb: int = Field(
        default=1000,
        ge=1,
        description="Memory of one volume, MB.  What the final mesh needs beyond it is on disk, in "
        "TMPDIR or /var/tmp.  A voxel with which a single keyframe needs more is refused.",
    )


class MeshingParameters(Parameters):
    """From the points of keyframes to a mesh of the scene."""

    enabled: bool = Field(default=True, description="Make a mesh.")
    again_blocks: int = Field(
        default=64,
        ge=0,
        description="Blocks that have not changed and are told again with each change, in turn, "
        "for viewers that came late.",
    )
    corrections: Literal["settled", "moved"] = Field(
        default="moved",
        description="When a keyframe in the live mesh is put in again: as it leaves the window, "
        "or also where the whole map has moved it by a voxel since (the former is to compare).",
    )
    depth: Literal["dense", "points"] = Field(
        default="dense",
        description="What the final mesh is made from: every pixel whose depth the images tell, "
        "or the map's points alone, as the live mesh is.",
    )
    surface: SurfaceParameters = SurfaceParameters()
    tsdf: TsdfParameters = TsdfParameters()
