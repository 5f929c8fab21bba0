"""Renders the frames of a deforming sequence: image, exact depth, and the visible material
points.
"""

from dataclasses import dataclass

import numpy as np

from pliant.algorithms.arrays import F32, F64, I32
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import inverse
from pliant.rendering.face_textures import FaceTexture, mip_pyramid, pack_atlas
from pliant.rendering.film import CameraOptions, RenderedFrame
from pliant.rendering.lens import NO_DISTORTION, pixel_rays
from pliant.rendering.photometry import exposure_gain, sensor_image
from pliant.rendering.render import FOOTPRINT, SUB_PIXELS
from pliant.rendering.sheet_kernels import (
    NEAR_M,
    Gloss,
    Surface,
    empty_buffers,
    pick,
    rasterise,
    shade,
)
from pliant.rendering.sheets import DeformingScene, vertex_normals
from pliant.rendering.textures import make_texture

_LAMP_REACH_M = 2.2  # as in the rigid scenes
_LAMP_AT_CAMERA_M = 0.6  # distance at which a lamp at the camera gives a light of 1


@dataclass(frozen=True)
class Sight:
    """The sheets at the pixels of a camera."""

    depth_m: F64  # (H, W), 0 where nothing is seen
    sheet: I32  # (H, W) number of the sheet, -1 where nothing is seen
    where: F32  # (H, W, 2) column and row in the grid of its vertices


def look(
    sheets: list[F64], T_world_camera: F64, camera: PinholeCamera,
    offset_px: tuple[float, float] = (0.0, 0.0),
) -> Sight:  # fmt: skip
    """Return the visible points at ``offset_px`` from the pixels' centres.

    sheets: (R, C, 3) vertices of each, metres, world.
    """
    nearness, seen, where = empty_buffers(camera.height, camera.width)
    for number, vertices in enumerate(sheets):
        points = _project(vertices, T_world_camera, camera)
        rasterise(points, number, *offset_px, nearness, seen, where)
    depth = np.where(seen >= 0, 1.0 / np.where(seen >= 0, nearness, 1.0), 0.0)
    return Sight(depth, seen, where)


def look_at_pixels(
    sheets: list[F64], T_world_camera: F64, camera: PinholeCamera, pixels: F64
) -> tuple[I32, F64, F64]:
    """Return the visible points at any (N, 2) pixels: number of the sheet (-1: none), (N, 2) column
    and row in the grid of its vertices, and depth (0: none).
    """
    n = len(pixels)
    nearness, seen, where = np.zeros(n), np.full(n, -1, np.int32), np.zeros((n, 2))
    pixels = np.ascontiguousarray(pixels, np.float64)
    for number, vertices in enumerate(sheets):
        points = _project(vertices, T_world_camera, camera)
        pick(points, number, pixels, nearness, seen, where)
    return seen, where, np.where(seen >= 0, 1.0 / np.where(seen >= 0, nearness, 1.0), 0.0)


def _project(vertices: F64, T_world_camera: F64, camera: PinholeCamera) -> F64:
    """(R, C, 3) pixels and 1 / z of (R, C, 3) vertices; 0 behind the camera."""
    T_camera_world = inverse(T_world_camera)
    points = vertices @ T_camera_world[:3, :3].T + T_camera_world[:3, 3]
    front = points[:, :, 2] > NEAR_M
    w = np.where(front, 1.0 / np.where(front, points[:, :, 2], 1.0), 0.0)
    u = points[:, :, 0] * w * camera.fx + camera.cx
    v = points[:, :, 1] * w * camera.fy + camera.cy
    return np.ascontiguousarray(np.stack([u, v, w], axis=2))


def paint_sheet(scene: DeformingScene, number: int) -> FaceTexture:
    """The texture of a sheet, without light: that changes with the shape."""
    sheet = scene.sheets[number]
    density = sheet.texels_per_metre
    rng = np.random.default_rng([scene.seed, number])
    return mip_pyramid(
        sheet.width_m,
        sheet.height_m,
        density,
        lambda height, width: make_texture(rng, height, width, sheet.material),
    )


class SheetRenderer:
    """Films a deforming scene.  Frames are independent of each other and of their order."""

    def __init__(
        self, scene: DeformingScene, textures: list[FaceTexture], camera: CameraOptions
    ) -> None:
        """textures: one for each sheet, from ``paint_sheet``.  The camera is grey."""
        self._scene, self._options = scene, camera
        self._atlas = pack_atlas(textures)
        self._camera = camera.pinhole()
        self._rays = [
            pixel_rays(self._camera, NO_DISTORTION, (x / 6.0, y / 6.0)).astype(np.float32)
            for x, y in SUB_PIXELS
        ]

    def frame(self, number: int, time_s: float) -> RenderedFrame:
        """Film the frame whose exposure has its middle at ``time_s``."""
        scene, options = self._scene, self._options
        T_world_camera = scene.path.T_world_camera(time_s)
        sheets = [sheet.shape(time_s) for sheet in scene.sheets]
        depth = look(sheets, T_world_camera, self._camera).depth_m
        rng = np.random.default_rng([options.seed, number])
        gain = exposure_gain(time_s, options.exposure)
        light = self._expose(time_s)[:, :, None]
        image = sensor_image(light, gain=gain, noise=options.noise, rng=rng)
        return RenderedFrame(
            time_s=time_s,
            T_world_camera=T_world_camera,
            image=np.ascontiguousarray(image[:, :, 0]),
            depth_m=np.where(depth <= scene.reach_m, depth, 0.0),
        )

    def _expose(self, time_s: float) -> F32:
        """(H, W) light, mean of the sub-exposures while the shutter is open."""
        camera, scene, n = self._camera, self._scene, len(SUB_PIXELS)
        light = np.zeros((camera.height, camera.width), np.float32)
        for i, (x, y) in enumerate(SUB_PIXELS):
            time = time_s + ((i + 0.5) / n - 0.5) * self._options.blur / self._options.fps
            sheets = [sheet.shape(time) for sheet in scene.sheets]
            T_world_camera = scene.path.T_world_camera(time)
            sight = look(sheets, T_world_camera, camera, (x / 6.0, y / 6.0))
            for number, vertices in enumerate(sheets):
                self._shade(sight, self._rays[i], number, vertices, T_world_camera, time, light)
        return light

    def _shade(
        self, sight: Sight, rays: F32, number: int, vertices: F64, T_world_camera: F64, time: float,
        out: F32,
    ) -> None:  # fmt: skip
        lamp, sheet = self._scene.lamp, self._scene.sheets[number]
        place, strength = lamp.at(time)
        normals, eye = vertex_normals(vertices), T_world_camera[:3, 3]
        if lamp.at_camera:
            place = eye
            light = _from_camera(vertices, normals, eye, strength)
        else:
            light = _diffuse(vertices, normals, place, eye, lamp.ambient, strength)
        R_camera_world = T_world_camera[:3, :3].T
        rows, columns = vertices.shape[:2]
        surface = Surface(
            number, light.astype(np.float32),
            np.ascontiguousarray(normals @ R_camera_world.T, np.float32),
            sheet.width_m / (columns - 1), sheet.height_m / (rows - 1),
        )  # fmt: skip
        toward = (R_camera_world @ (place - eye)).astype(np.float32)
        shade(
            sight.depth_m, sight.sheet, sight.where, rays, surface, self._atlas,
            FOOTPRINT / self._camera.fx, Gloss(toward, lamp.gloss), 1.0 / len(SUB_PIXELS), out,
        )  # fmt: skip


def _diffuse(
    vertices: F64, normals: F64, lamp: F64, eye: F64, ambient: float, strength: float
) -> F64:
    """(R, C) light on the side of a sheet that the camera sees; the lamp casts no shadows."""
    way = lamp - vertices
    square = (way**2).sum(axis=2)
    side = np.sign((normals * (eye - vertices)).sum(axis=2))
    cosine = side * (normals * way).sum(axis=2) / np.sqrt(square)
    direct = np.maximum(cosine, 0.0) / (1.0 + square / _LAMP_REACH_M**2)
    return ambient + 1.6 * (1.0 - ambient) * strength * direct


def _from_camera(vertices: F64, normals: F64, eye: F64, strength: float) -> F64:
    """(R, C) light of a lamp at the camera: cos / d^2, 1 at ``_LAMP_AT_CAMERA_M``."""
    way = eye - vertices
    square = (way**2).sum(axis=2)
    cosine = np.abs((normals * way).sum(axis=2)) / np.sqrt(square)
    return strength * cosine * _LAMP_AT_CAMERA_M**2 / square
