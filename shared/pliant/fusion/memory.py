"""What a volume needs: at the least, from the camera alone before anything is fused; and in all.

Voxels are shares of the scene's median depth, so the scale of the scene does not matter: a keyframe
sees, at the median depth 1, an area of (width / fx) x (height / fy), and surface takes the blocks
of SIDE voxels through the band of the truncation.
"""

import math

from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.meshing.mesh_blocks import BLOCK_BYTES, SIDE
from pliant.algorithms.meshing.parameters import TsdfParameters
from pliant.errors import PliantError

_GROWTH = 0.6
"""Blocks of a surface grow with one over the voxel squared; at its borders more slowly."""
_MARGIN = 1.05
"""On a voxel that is proposed as fitting."""
SCENE_VIEWS = 20
"""Views' worth of blocks of a scene: the built-in ones and RedKitchen take 9 to 20."""


class VoxelSizeError(PliantError):
    """A voxel size that one keyframe's view alone cannot have within the memory limit."""


def view_bytes(voxel: float, camera: PinholeCamera, parameters: TsdfParameters) -> float:
    """Bytes of a volume that holds one view of a surface at the median depth, face on."""
    return _layers(parameters) * BLOCK_BYTES * _columns(voxel, camera)


def voxel_for(limit_bytes: float, camera: PinholeCamera, parameters: TsdfParameters) -> float:
    """The voxel, as a share of the median depth, with which SCENE_VIEWS views take the limit."""
    columns = limit_bytes / (SCENE_VIEWS * BLOCK_BYTES * _layers(parameters))
    return math.sqrt(_columns(1.0, camera) / columns)


def check_voxel_sizes(camera: PinholeCamera, parameters: TsdfParameters) -> None:
    """Raise VoxelSizeError for a size that is sure to need more than ``max_memory_mb``.

    A size that passes may still need too much in the end, for a scene is more than one view; what
    is fused is counted exactly.
    """
    limit = parameters.max_memory_mb * 1e6
    for name in ("fine_voxel", "coarse_voxel"):
        voxel: float = getattr(parameters, name)
        needed = view_bytes(voxel, camera, parameters)
        if needed > limit:
            fitting = _rounded_up(voxel_for(limit, camera, parameters))
            raise VoxelSizeError(
                f"meshing.tsdf.{name}={voxel:g} needs {needed / 1e6:.0f} MB for one keyframe "
                f"alone, the limit is {parameters.max_memory_mb} MB "
                f"(meshing.tsdf.max_memory_mb): {fitting:g} would fit, also for a scene of "
                f"{SCENE_VIEWS} such views"
            )


def too_fine(
    level: str, parameters: TsdfParameters, needed_bytes: int, what: str,
    room_bytes: int | None = None,
) -> str:  # fmt: skip
    """One line: voxels of that level, "fine" or "coarse", need more for ``what`` than there is.

    room_bytes: in memory and on disk; None: the limit of memory.
    """
    voxel: float = getattr(parameters, f"{level}_voxel")
    most = parameters.max_memory_mb * 1e6 if room_bytes is None else room_bytes
    limit = f"the limit is {parameters.max_memory_mb} MB (meshing.tsdf.max_memory_mb)"
    if room_bytes is not None:
        limit = f"memory and half of the free disk have room for {most / 1e6:.0f} MB"
    fitting = _rounded_up(_MARGIN * voxel * (needed_bytes / most) ** _GROWTH)
    return (
        f"meshing.tsdf.{level}_voxel={voxel:.4g} needs {needed_bytes / 1e6:.0f} MB for {what}, "
        f"{limit}: about {fitting:g} would fit"
    )


def _columns(voxel: float, camera: PinholeCamera) -> float:
    """Blocks side by side over what the camera sees at depth 1."""
    return camera.width / camera.fx * camera.height / camera.fy / (SIDE * voxel) ** 2


def _layers(parameters: TsdfParameters) -> float:
    """Blocks behind each other that a band of twice the truncation meets, on average."""
    return 1.0 + 2.0 * parameters.truncation_voxels / SIDE


def _rounded_up(size: float) -> float:
    """With two digits, so that what is typed in fits."""
    unit = 10.0 ** (math.floor(math.log10(size)) - 1)
    return math.ceil(size / unit - 1e-9) * unit
