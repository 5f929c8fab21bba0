"""Compiles every kernel of meshing by meshing a small synthetic keyframe and fusing it."""

import numpy as np

from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.meshing.keyframe_surface import KeyframeSurfaces, SeenPoints
from pliant.algorithms.meshing.parameters import SurfaceParameters, TsdfParameters
from pliant.algorithms.meshing.tsdf_volume import TsdfVolume

_POINTS, _VOXEL = 100, 0.1


def warm_up() -> None:
    """Run every kernel once, with the types of the real work."""
    camera = PinholeCamera(width=64, height=48, fx=60.0, fy=60.0, cx=31.5, cy=23.5)
    generator = np.random.default_rng(0)
    points_px = generator.uniform((0.0, 0.0), (64.0, 48.0), (_POINTS, 2)).astype(np.float32)
    rays = np.concatenate([camera.normalise(points_px), np.ones((_POINTS, 1))], axis=1)
    points = SeenPoints(
        ids=np.arange(_POINTS, dtype=np.int64),
        points_px=points_px,
        points_world=rays * generator.uniform(2.0, 2.1, (_POINTS, 1)),
        sigmas=np.full(_POINTS, 0.01, np.float32),
        keyframes=np.full(_POINTS, 9, np.int32),
    )
    surfaces = KeyframeSurfaces(camera, SurfaceParameters())
    surfaces.surface(np.eye(4), points)
    found = surfaces.surface(np.eye(4), points).depth_map  # it starts from the first
    assert found is not None
    volume, pose = TsdfVolume(_VOXEL, TsdfParameters()), np.eye(4)
    colour = np.zeros((camera.height, camera.width, 3), np.uint8)
    done = volume.integrate(found.depths, found.weights, colour, camera, pose)
    volume.extract_all()
    keys = volume.remove(done.serial, found.depths, found.weights, colour, camera, pose)
    volume.extract(volume.affected(keys))
