"""Parameters of meshing."""

from typing import Literal

from pydantic import Field

from pliant.algorithms.parameters import Parameters


class NltgvParameters(Parameters):
    """Parameters of smoothing.  Weights have no unit; see ``nltgv``."""

    data_weight: float = Field(
        default=0.5, gt=0.0, description="Weight of the data relative to the smoothness (lambda)."
    )
    slope_weight: float = Field(
        default=3.0, gt=0.0, description="Weight of slope changes relative to depth changes."
    )
    dense_slope_weight: float = Field(
        default=1.5,
        gt=0.0,
        description=(
            "The same for the final mesh with meshing.depth=dense.  Lower: creases stay sharper."
        ),
    )
    huber_sigmas: float = Field(
        default=1.0,
        ge=0.0,
        description="Data residuals cost quadratically up to this many sigmas, then linearly.",
    )
    edge_sigmas: float = Field(
        default=5.0,
        ge=0.0,
        description=(
            "An edge that misses the surface by this many sigmas has half the weight.  0: "
            "equal weights."
        ),
    )
    data_sigmas: float = Field(
        default=5.0,
        ge=0.0,
        description=(
            "Data off the surface by this many sigmas have half the weight.  0: equal weights."
        ),
    )
    reweightings: int = Field(
        default=2,
        ge=1,
        le=50,
        description="Number of times that weights are computed from the residuals.",
    )
    max_iterations: int = Field(
        default=200, ge=1, description="Maximum primal-dual iterations for one set of weights."
    )
    min_change_sigmas: float = Field(
        default=0.04,
        ge=0.0,
        description=(
            "Stop when an iteration changes the inverse depth by less than this (rms, in "
            "median sigmas)."
        ),
    )


class TriangleFilterParameters(Parameters):
    """Limits of the triangles that are kept."""

    max_edge_px: float = Field(
        default=100.0, gt=0.0, description="Maximum edge of a triangle in the image, px."
    )
    max_depth_ratio: float = Field(
        default=1.4,
        gt=1.0,
        description="Maximum ratio of depths of a triangle's corners: more is a discontinuity.",
    )
    max_slant_deg: float = Field(
        default=75.0,
        gt=0.0,
        le=90.0,
        description="Maximum angle between a triangle's normal and the ray to its centre, degrees.",
    )
    min_observations: int = Field(
        default=2, ge=1, description="Minimum frames that observe a corner."
    )


class SurfaceParameters(Parameters):
    """How the points of a keyframe become a surface."""

    noise_px: float = Field(
        default=0.5,
        gt=0.0,
        description="Standard deviation of an observation, px: scales their uncertainty.",
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
        description="Voxel size of the live mesh, as a share of the scene's median depth.",
    )
    fine_voxel: float = Field(
        default=1 / 120,
        gt=0.0,
        le=1.0,
        description="Voxel size of the final mesh, as a share of the scene's median depth.",
    )
    truncation_voxels: float = Field(
        default=4.0,
        ge=2.0,
        le=16.0,
        description="Truncation distance of the TSDF, voxels.",
    )
    min_weight: float = Field(
        default=0.1,
        ge=0.0,
        description=(
            "Minimum weight of a meshed voxel: one frontal view has 1 with certain depth, 0.5"
            " with a sigma of 1 %, 0.1 with 3 %."
        ),
    )
    dense_min_weight: float = Field(
        default=0.01,
        ge=0.0,
        description=(
            "The same for meshing.depth=dense, which fills areas without any surface with a "
            "weight of 0.01."
        ),
    )
    free_space: bool = Field(
        default=True,
        description="Space in front of a keyframe's surface counts against other surface there.",
    )
    max_memory_mb: int = Field(
        default=1000,
        ge=1,
        description=(
            "Memory of one volume, MB.  The final mesh stores more in a temporary file "
            "(TMPDIR or /var/tmp).  A voxel size with which a single keyframe exceeds it is "
            "refused."
        ),
    )


class MeshingParameters(Parameters):
    """From the points of keyframes to a mesh of the scene."""

    enabled: bool = Field(default=True, description="Make a mesh.")
    again_blocks: int = Field(
        default=64,
        ge=0,
        description="Unchanged blocks repeated with each change, in turn, for late viewers.",
    )
    depth: Literal["dense", "points"] = Field(
        default="dense",
        description=(
            "Source of the final mesh: all pixels with a depth from the images, or only the "
            "landmarks."
        ),
    )
    live_depth: Literal["points", "dense"] = Field(
        default="points",
        description=(
            "Source of the live mesh: only the landmarks, or also the pixels of keyframes that "
            "have left the window, at half the width and height of those of the final mesh."
        ),
    )
    finish: bool = Field(
        default=True,
        description="Close small holes of mesh.ply, leave out its small pieces and smooth its "
        "borders (with depth=dense).",
    )
    surface: SurfaceParameters = SurfaceParameters()
    tsdf: TsdfParameters = TsdfParameters()

    @property
    def final_surface(self) -> SurfaceParameters:
        """The surface of the final mesh."""
        if self.depth == "points":
            return self.surface
        nltgv = self.surface.nltgv
        nltgv = nltgv.model_copy(update={"slope_weight": nltgv.dense_slope_weight})
        return self.surface.model_copy(update={"nltgv": nltgv})
