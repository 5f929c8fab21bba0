"""Compiles every kernel of fusion by fusing a wall that two small keyframes see."""

import numpy as np

from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.meshing import DepthMap, TsdfParameters
from pliant.algorithms.stages import no_stages
from pliant.fusion.live_mesh import LiveMesh
from pliant.fusion.open3d_import import FusionError


def warm_up() -> None:
    """Put in, take out, and mesh, unless open3d cannot be imported: then there is no mesh."""
    camera = PinholeCamera(width=32, height=24, fx=30.0, fy=30.0, cx=15.5, cy=11.5)
    shape = (camera.height, camera.width)
    wall = DepthMap(np.full(shape, 2.0, np.float32), np.ones(shape, np.float32))
    colour = np.full((*shape, 3), 128, np.uint8)
    try:
        live = LiveMesh(0.1, camera, TsdfParameters(), again=4)
    except FusionError:
        return
    for keyframe in range(3):
        live.put(keyframe % 2, wall, colour, np.eye(4), settled=keyframe == 2)
    live.changes(no_stages)
    live.again()
    live.volume.extract_all()
