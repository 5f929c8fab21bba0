"""Rendered boards and smooth images for the tests of surfels."""

import numpy as np
from benchmarks.painting import paint_faces

from pliant.algorithms.arrays import F32, F64
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import matrix_to_pose, so3_exp
from pliant.algorithms.surfels.deformation_models import identity_poses
from pliant.algorithms.surfels.depth_maps import tangent_jacobian
from pliant.algorithms.surfels.patch_sampling import A, B, Level, X, make_level
from pliant.rendering.film import CameraOptions, RenderedFrame
from pliant.rendering.paths import SampledPath
from pliant.rendering.render import Renderer, SceneGeometry
from pliant.rendering.solids import Material, Scene, Solid

WIDTH, HEIGHT = 320, 240

STEP_S = 1.0 / 30.0
"""From a frame to the next."""

EVERYWHERE = np.ones((120, 160))
"""Depth for the templates of ``waves``, with a bound that is infinite."""


def board_renderer(
    motions: list[F64], *, noise: float = 0.0, tilt_rad: float = 0.3, exposure: float = 0.0
) -> tuple[Renderer, PinholeCamera]:
    """A textured board 1 m away, seen from the (4, 4) T_world_camera of ``motions``."""
    board = Solid(
        name="board",
        kind="box",
        centre=(0.0, 0.0, 1.05),
        size=(3.0, 3.0, 0.1),
        rotation=(0.0, tilt_rad, 0.0),
        material=Material(brightness=120, contrast=40, noise=6, coverage=0.25, writing=0.3),
        texels_per_metre=400.0,
    )
    scene = Scene(name="board", solids=(board,), lights=((0.3, -0.5, -0.5),))
    geometry = SceneGeometry(scene)
    camera = CameraOptions(
        width=WIDTH, height=HEIGHT, noise=noise, blur=0.0, exposure=exposure, seed=3
    )
    poses = matrix_to_pose(
        np.array([motions[0], *motions]) if len(motions) == 1 else np.array(motions)
    )
    path = SampledPath(times_s=np.arange(len(poses), dtype=np.float64), poses=poses)
    return Renderer(geometry, paint_faces(geometry), path, camera), camera.pinhole()


def motion(rotation: tuple[float, float, float], shift: tuple[float, float, float]) -> F64:
    """(4, 4) rigid motion from a rotation vector (rad) and a translation (m)."""
    T = np.eye(4)
    T[:3, :3] = so3_exp(np.array(rotation))
    T[:3, 3] = shift
    return T


def film(renderer: Renderer, count: int) -> list[RenderedFrame]:
    return [renderer.frame(number, float(number)) for number in range(count)]


def waves(width: int = 160, height: int = 120) -> F32:
    """A smooth image: nothing in it is finer than 25 px."""
    v, u = np.mgrid[0:height, 0:width].astype(np.float64)
    image = 40.0 * np.sin(0.11 * u + 0.05 * v) + 35.0 * np.cos(0.10 * v - 0.07 * u + 1.0)
    return (125.0 + image + 15.0 * np.sin(0.12 * (u + v))).astype(np.float32)


def level_of(image: F32, focal: float = 200.0, side: int = 23, stride: int = 1) -> Level:
    height, width = image.shape
    middle = 0.5 * (width - 1), 0.5 * (height - 1)
    return make_level(np.ascontiguousarray(image), focal, focal, *middle, side, stride)


def slanted_surfels(count: int = 1, seed: int = 0) -> F64:
    """Surfels about 1 m away near the axis, with slanted tangents."""
    rng = np.random.default_rng(seed)
    poses = identity_poses(count)
    xy = rng.uniform(-0.12, 0.12, (count, 2))
    z = rng.uniform(0.8, 1.2, count)
    slopes = rng.uniform(-0.5, 0.5, (count, 2)) * z[:, None]
    poses[:, X : X + 2], poses[:, X + 2] = xy * z[:, None], z
    tangents = tangent_jacobian(xy[:, 0], xy[:, 1], z, slopes[:, 0], slopes[:, 1])
    poses[:, A : A + 3], poses[:, B : B + 3] = tangents[:, :, 0], tangents[:, :, 1]
    return poses
