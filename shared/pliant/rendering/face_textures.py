"""The textures of a scene: painted, lit, and shrunk into mip pyramids."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from pliant.algorithms.arrays import F32, F64, U8
from pliant.compiler.kernel import kernel
from pliant.rendering.colours import LEAST
from pliant.rendering.light import light_at
from pliant.rendering.raycast import SHARE, Atlas, ColourAtlas
from pliant.rendering.solids import Scene, SolidArrays, face_sizes
from pliant.rendering.textures import make_colours, make_texture, shrink

LEVELS = 6
_BLOCK = 1 << (LEVELS - 1)  # sizes at level 0 are multiples of this
_LIGHT_CELL_M = 0.06
_COARSER = 3
"""Texels of light, each way, that share a colour: eyes see these less sharply, too."""


class FaceTexture(NamedTuple):
    """The texture of one face."""

    width: int  # texels at level 0
    height: int
    density: float  # texels per metre at level 0
    texels: U8  # LEVELS levels, finest first, row by row


class FaceColours(NamedTuple):
    """The colours of one face, less fine than its texture: ``raycast.ColourAtlas`` has them."""

    red: FaceTexture
    blue: FaceTexture


def face_frame(kind: int, face: int, half: F64, u: F64, v: F64) -> tuple[F64, F64]:
    """Points and outer normals, solid frame, at texture coordinates (N,) u, v in metres.

    The inverse of ``raycast.face_point``.
    """
    hx, _, hz = half
    one, zero = np.ones_like(u), np.zeros_like(u)
    if kind == 3:
        if face == 0:
            angle = u / hx - np.pi
            normal = np.stack([np.cos(angle), np.sin(angle), zero], axis=1)
            return normal * hx + np.stack([zero, zero, hz - v], axis=1), normal
        sign = 1.0 if face == 1 else -1.0
        point = np.stack([u - hx, v - hx, sign * hz * one], axis=1)
        return point, np.stack([zero, zero, sign * one], axis=1)
    axis, sign = face // 2, 1.0 if face % 2 == 1 else -1.0
    others = [(1, 2), (0, 2), (0, 1)][axis]
    point = np.zeros((len(u), 3))
    if kind == 2:
        point[:, axis] = sign
        point[:, others[0]] = np.tan(u / hx - 0.25 * np.pi)
        point[:, others[1]] = np.tan(0.25 * np.pi - v / hx)
        normal = point / np.linalg.norm(point, axis=1, keepdims=True)
        return normal * hx, normal
    point[:, axis] = sign * half[axis]
    point[:, others[0]] = u - half[others[0]]
    point[:, others[1]] = v - half[1] if axis == 2 else half[2] - v
    normal = np.zeros_like(point)
    normal[:, axis] = -sign if kind == 0 else sign
    return point, normal


@kernel
def _apply_light(image: F32, light: F32, scale_x: float, scale_y: float) -> None:
    """Multiply by a coarse map of the light, interpolated between its points."""
    height, width = image.shape
    rows, cols = light.shape
    for row in range(height):
        y = min(row * scale_y, rows - 1.001)
        j = int(y)
        q = y - j
        for col in range(width):
            x = min(col * scale_x, cols - 1.001)
            i = int(x)
            p = x - i
            top = light[j, i] + p * (light[j, i + 1] - light[j, i])
            bottom = light[j + 1, i] + p * (light[j + 1, i + 1] - light[j + 1, i])
            image[row, col] *= top + q * (bottom - top)


def _light_map(
    scene: Scene, solids: SolidArrays, number: int, face: int, width: float, height: float
) -> F32:
    cols, rows = (max(int(size / _LIGHT_CELL_M) + 1, 2) for size in (width, height))
    # Not quite to the rim: there a face touches its neighbours and all light is shut out.
    edge = 0.02
    u = width * np.linspace(edge, 1.0 - edge, cols)
    v = height * np.linspace(edge, 1.0 - edge, rows)
    grid_u, grid_v = (axis.ravel() for axis in np.meshgrid(u, v))
    kind, half = int(solids.kind[number]), solids.half[number]
    points, normals = face_frame(kind, face, half, grid_u, grid_v)
    R = solids.rotation[number]
    points, normals = points @ R.T + solids.centre[number], normals @ R.T
    lights = np.array(scene.lights, np.float64)
    return light_at(solids, points, normals, lights, scene.ambient).reshape(rows, cols)


def make_face(
    scene: Scene, solids: SolidArrays, number: int, *, detail: float = 1.0
) -> FaceTexture:
    """Paint face ``number`` (counted over all solids).

    detail: share of the material's texels per metre; little for faces that hardly anybody sees.
    """
    solid, width_m, height_m = face_sizes(scene)[number]
    density = detail * solid.texels_per_metre
    owner = int(np.searchsorted(solids.first_face, number, side="right")) - 1
    face = number - int(solids.first_face[owner])
    rng = np.random.default_rng([scene.seed, number])

    def paint(height: int, width: int) -> F32:
        image = make_texture(rng, height, width, solid.material)
        light = _light_map(scene, solids, owner, face, width_m, height_m)
        scale_x = (light.shape[1] - 1) / (density * width_m)
        scale_y = (light.shape[0] - 1) / (density * height_m)
        _apply_light(image, light, scale_x, scale_y)
        return image

    return mip_pyramid(width_m, height_m, density, paint)


def make_face_colours(
    scene: Scene, solids: SolidArrays, number: int, *, detail: float = 1.0
) -> FaceColours:
    """The colours of the face that ``make_face`` paints with the same arguments."""
    solid, width_m, height_m = face_sizes(scene)[number]
    density = detail * solid.texels_per_metre
    owner = int(np.searchsorted(solids.first_face, number, side="right")) - 1
    images = make_colours(
        np.random.default_rng([scene.seed, number]),
        np.random.default_rng([scene.seed, owner, 1]),
        *_texels(width_m, height_m, density),
        solid.material,
        _COARSER,
    )
    steps = (images - LEAST) * SHARE

    def pyramid(image: F32) -> FaceTexture:
        def paint(height: int, width: int) -> F32:
            more = ((0, max(height - len(image), 0)), (0, max(width - image.shape[1], 0)))
            return np.ascontiguousarray(np.pad(image, more, mode="edge")[:height, :width])

        return mip_pyramid(width_m, height_m, density / _COARSER, paint)

    return FaceColours(*(pyramid(image) for image in steps))


def _texels(width_m: float, height_m: float, density: float) -> tuple[int, int]:
    """Rows and columns of a texture of that size in metres."""
    # One block more than the surface needs, so that its far edge never meets the texture's end.
    width, height = (
        int(np.ceil((size * density + 1.0) / _BLOCK)) * _BLOCK for size in (width_m, height_m)
    )
    return height, width


def mip_pyramid(
    width_m: float, height_m: float, density: float, paint: Callable[[int, int], F32]
) -> FaceTexture:
    """A texture of that size in metres.  paint: makes (height, width) texels, float32."""
    height, width = _texels(width_m, height_m, density)
    levels = [paint(height, width)]
    while len(levels) < LEVELS:
        levels.append(shrink(levels[-1]))
    texels = np.concatenate([level.ravel() for level in levels])
    texels = np.clip(np.rint(texels), 0.0, 255.0).astype(np.uint8)
    return FaceTexture(width, height, density, texels)


def pack_atlas(faces: list[FaceTexture]) -> Atlas:
    """Lay the pyramids of all faces, in their order, into one array."""
    sizes = np.array([face.width * face.height for face in faces], np.int64)
    of_level = sizes[:, None] >> (2 * np.arange(LEVELS))
    ends = np.cumsum(of_level).reshape(of_level.shape)
    return Atlas(
        texels=np.concatenate([np.zeros(0, np.uint8), *(face.texels for face in faces)]),
        offset=ends - of_level,
        width=np.array([face.width for face in faces], np.int32),
        height=np.array([face.height for face in faces], np.int32),
        density=np.array([face.density for face in faces], np.float64),
    )


def pack_colours(faces: list[FaceColours]) -> ColourAtlas:
    """Lay the colours of all faces, in their order, side by side."""
    red, blue = (pack_atlas([face[i] for face in faces]) for i in range(2))
    return ColourAtlas(red, blue.texels)
