"""Everything that a user may change about meshing."""

from typing import Literal

from pydantic import Field

from pliant.algorithms.meshing.keyframe_surface import SurfaceParameters
from pliant.algorithms.meshing.tsdf_parameters import TsdfParameters
from pliant.algorithms.parameters import Parameters


class MeshingParameters(Parameters):
    """From the points of keyframes to a mesh of the scene."""

    enabled: bool = Field(default=True, description="Make a mesh; needs open3d.")
    again_blocks: int = Field(
        default=64,
        ge=0,
        description="Blocks that have not changed and are told again with each change, in turn, "
        "for viewers that came late.",
    )
    corrections: Literal["settled", "moved"] = Field(
        default="settled",
        description="When a keyframe in the live mesh is put in again: once, as it leaves the "
        "window, or also whenever it has moved by a voxel (to compare).",
    )
    surface: SurfaceParameters = SurfaceParameters()
    tsdf: TsdfParameters = TsdfParameters()
