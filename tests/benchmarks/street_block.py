"""A street about a block of houses, rendered: a loop of 203 m out of doors, under a bare sky.

Facades with windows and doors, asphalt, kerbs, parked cars, trees and lamp posts; the camera rides
once around at the speed of a bicycle and comes 15 m over where it began.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from pliant.algorithms.arrays import F32, F64
from pliant.datasets.sequence_files import render_threads, write_sequence
from pliant.rendering.face_textures import FaceTexture, face_frame, mip_pyramid
from pliant.rendering.film import CameraOptions
from pliant.rendering.lens import pixel_rays
from pliant.rendering.paths import SplinePath
from pliant.rendering.render import Renderer, SceneGeometry
from pliant.rendering.solids import Kind, Material, Scene, Solid, face_sizes
from pliant.rendering.textures import make_texture

CAMERA = CameraOptions(focal=320.0, fps=30.0)
"""90 degrees wide."""

BLOCK_M = (20.0, 15.0)
"""Half the extent of the block, along x and y."""
_STREET_M, _PAVEMENT_M = 12.0, 2.0
_LANE_M = 0.8
"""The camera keeps so far to the right of the street's middle."""
_CORNER_M = 4.0
_HEIGHT_M, _AHEAD_M = 1.5, 5.0
_FAST, _SLOW = 5.0, 3.2
"""Metres a second: straight on, and about a corner."""
_AGAIN_M = 15.0
"""Ridden over once more in the end."""
_STEP_S = 0.15
"""Between control points of the path."""

_DEPTH_SCALE = 1e-3
"""Sixteen bits end at 65 m: the sky is nothing."""
_LOOK_EVERY, _LOOK_STRIDE = 5, 8
_SUN = np.array([0.5, -0.35, 0.79])
_SHADE = 0.7
"""Share of the light that comes from everywhere."""
_BARE = {"contrast": 0.0, "noise": 0.0, "coverage": 0.0, "writing": 0.0}

_SKY = Material(brightness=225, contrast=0, noise=0, coverage=0.0)
_ASPHALT = Material(brightness=95, contrast=14, noise=3, coverage=0.12)
_SLABS = Material(brightness=140, contrast=20, noise=4, coverage=0.15)
_GLASS = Material(brightness=55, contrast=14, noise=3, coverage=0.1)
_SILL = Material(brightness=185, contrast=12, noise=3, coverage=0.1)
_BARK = Material(brightness=80, contrast=25, noise=6, coverage=0.2)
_LEAVES = Material(brightness=95, contrast=38, noise=8, coverage=0.3)
_STEEL = Material(brightness=90, contrast=15, noise=3, coverage=0.15)
_WALLS = (
    Material(brightness=160, contrast=16, noise=4, coverage=0.1),
    Material(brightness=120, contrast=24, noise=6, coverage=0.2, stretch=4),
    Material(brightness=140, contrast=28, noise=5, coverage=0.16),
    Material(brightness=185, contrast=14, noise=3, coverage=0.08),
    Material(brightness=105, contrast=30, noise=6, coverage=0.2),
)
_DOORS = (
    Material(brightness=75, contrast=22, noise=5, coverage=0.12, stretch=5),
    Material(brightness=150, contrast=35, noise=4, coverage=0.15, writing=0.4),
)
_PAINTS = tuple(Material(brightness=b, contrast=9, noise=2, coverage=0.06) for b in (60, 120, 190))


class _Row(NamedTuple):
    """One side of a street.

    yaw: quarters of a turn from the side along x to it.   front: where its facades are, metres from
    the block's middle.   facing: 1 towards the block, -1 away from it.   half: of its length.
    """

    yaw: int
    front: float
    facing: int
    half: float

    def solid(
        self, name: str, at: tuple[float, float, float], size: tuple[float, float, float],
        material: Material, texels: float, kind: Kind = "box",
    ) -> Solid:  # fmt: skip
        """at: of its middle, along the row, before its facades, and up.   size: likewise."""
        along, before, up = at
        out = self.front - self.facing * before
        cos, sin = ((1, 0), (0, 1), (-1, 0), (0, -1))[self.yaw]
        centre = (cos * along + sin * out, sin * along - cos * out, up)
        return Solid(
            name=name, kind=kind, centre=centre, size=size, material=material,
            rotation=(0.0, 0.0, 0.5 * np.pi * self.yaw), texels_per_metre=texels,
        )  # fmt: skip


def street_block(block_m: tuple[float, float] = BLOCK_M) -> Scene:
    """The houses of the block and those across the street, with all that stands before them."""
    x, y = block_m
    wide, deep = x + _STREET_M, y + _STREET_M
    rng = np.random.default_rng(17)
    solids = [
        Solid(name="sky", kind="room", centre=(0, 0, 40), size=(300, 300, 90), material=_SKY,
              texels_per_metre=0.5),
        Solid(name="road", kind="box", centre=(0, 0, -0.5), size=(2 * wide, 2 * deep, 1.0),
              material=_ASPHALT, texels_per_metre=60.0),
        Solid(name="pavement", kind="box", centre=(0, 0, 0.0), material=_SLABS,
              size=(2 * (x + _PAVEMENT_M), 2 * (y + _PAVEMENT_M), 0.24), texels_per_metre=70.0),
    ]  # fmt: skip
    for yaw in range(4):
        front, half = ((y, x), (x, y))[yaw % 2]
        solids += _side(_Row(yaw, front, -1, half), rng)
        across = _Row(yaw, front + _STREET_M, 1, half + _STREET_M)
        slabs = (2.0 * across.half, _PAVEMENT_M, 0.24)
        at = (0.0, 0.5 * _PAVEMENT_M, 0.0)
        solids += [across.solid("pavement", at, slabs, _SLABS, 70.0), *_side(across, rng)]
    return Scene(
        name="street block", solids=tuple(solids), lights=(), depth_scale=_DEPTH_SCALE, seed=53
    )


def _side(row: _Row, rng: np.random.Generator) -> list[Solid]:
    """Houses from end to end; cars, trees and posts, but for the corners."""
    solids, along = list[Solid](), -row.half
    while along < row.half - 0.1:
        width = float(rng.uniform(6.0, 10.0))
        if row.half - along - width < 5.0:
            width = row.half - along
        solids += _house(row, along + 0.5 * width, width, rng)
        along += width
    free = row.half - (2.0 if row.facing < 0 else _STREET_M + 2.0)
    for at in np.arange(-free + 2.5, free - 2.0, 6.0):
        if rng.random() < 0.6:
            solids += _car(row, float(at + rng.uniform(-0.4, 0.4)), rng)
    edge = _PAVEMENT_M - 0.35
    for number, at in enumerate(np.arange(-free, free, 9.0)):
        if number % 2:
            post = (0.14, 0.14, 5.2)
            solids.append(row.solid("post", (at, edge, 2.6), post, _STEEL, 120, "cylinder"))
        else:
            size = float(rng.uniform(1.6, 2.6))
            trunk, crown = (at, edge, 1.6), (at, edge - 0.3, 4.2)
            solids += [
                row.solid("trunk", trunk, (0.25, 0.25, 3.2), _BARK, 150, "cylinder"),
                row.solid("crown", crown, (size, size, size), _LEAVES, 80, "sphere"),
            ]
    return solids


def _house(row: _Row, middle: float, width: float, rng: np.random.Generator) -> list[Solid]:
    """Two or three storeys of windows with sills; one on the ground is a door."""
    storeys, out = int(rng.integers(2, 4)), float(rng.uniform(0.0, 0.3))
    high = 3.1 * storeys + float(rng.uniform(0.2, 1.2))
    wall = _WALLS[int(rng.integers(len(_WALLS)))]
    solids = [row.solid("house", (middle, out - 2.5, 0.5 * high), (width, 5.0, high), wall, 70)]
    count = int(width // 2.3)
    door, pane = int(rng.integers(count)), rng.uniform((0.9, 1.2), (1.3, 1.7))
    for storey in range(storeys):
        for i in range(count):
            at = middle + ((i + 0.5) / count - 0.5) * width
            if storey == 0 and i == door:
                paint = _DOORS[int(rng.integers(len(_DOORS)))]
                solids.append(row.solid("door", (at, out, 1.2), (1.1, 0.12, 2.4), paint, 120))
                continue
            low = 3.1 * storey + 1.0
            size = (float(pane[0]), 0.06, float(pane[1]))
            solids += [
                row.solid("pane", (at, out, low + 0.5 * size[2]), size, _GLASS, 90),
                row.solid("sill", (at, out, low - 0.05), (size[0] + 0.2, 0.3, 0.1), _SILL, 90),
            ]
    return solids


def _car(row: _Row, at: float, rng: np.random.Generator) -> list[Solid]:
    """At the kerb."""
    paint = _PAINTS[int(rng.integers(len(_PAINTS)))]
    before, long = _PAVEMENT_M + 0.95, float(rng.uniform(3.6, 4.6))
    return [
        row.solid("car", (at, before, 0.6), (long, 1.7, 0.8), paint, 100),
        row.solid("cabin", (at - 0.2, before, 1.25), (0.5 * long, 1.5, 0.55), _GLASS, 100),
    ]


def ride(block_m: tuple[float, float] = BLOCK_M) -> SplinePath:
    """Once around and on, slower about the corners."""
    half = np.array(block_m) + 0.5 * _STREET_M + _LANE_M
    outline = _rounded(half, _CORNER_M)
    lengths = np.linalg.norm(np.diff(outline, axis=0), axis=1)
    marks = np.concatenate([[0.0], np.cumsum(lengths)])

    def on_lane(s: F64) -> F64:
        part = s % marks[-1]
        return np.column_stack([np.interp(part, marks, column) for column in outline.T])

    at, s = [0.0], 0.0
    while s < marks[-1] + _AGAIN_M:
        before, after = np.diff(on_lane(s + np.array([-3.2, -2.8, 2.8, 3.2])), axis=0)[::2]
        cosine = before @ after / (np.linalg.norm(before) * np.linalg.norm(after))
        turn = np.arccos(np.clip(cosine, -1.0, 1.0))
        s += _STEP_S * (_FAST - (_FAST - _SLOW) * float(turn) / (0.5 * np.pi))
        at.append(s)
    s_at = np.array(at)
    here, there = on_lane(s_at), on_lane(s_at + _AHEAD_M)
    up = _HEIGHT_M + 0.04 * np.sin(0.9 * s_at)
    return SplinePath(
        [(float(x), float(y), float(z)) for (x, y), z in zip(here, up, strict=True)],
        [(float(x), float(y), _HEIGHT_M + 0.2) for x, y in there],
        duration_s=_STEP_S * (len(at) - 1), tremble_m=0.01,
    )  # fmt: skip


def _rounded(half: F64, radius: float) -> F64:
    """(N, 2) points of a rectangle with round corners, from the middle of its lower side on."""
    points = [np.array([[0.0, -half[1]]])]
    for quarter, corner in enumerate(((1, -1), (1, 1), (-1, 1), (-1, -1))):
        angle = 0.5 * np.pi * (quarter - 1 + np.linspace(0.0, 1.0, 16))
        arc = radius * np.column_stack([np.cos(angle), np.sin(angle)])
        points.append((half - radius) * corner + arc)
    return np.concatenate([*points, points[0]])


def render(
    folder: Path, *, frames: int | None = None, camera: CameraOptions = CAMERA,
    block_m: tuple[float, float] = BLOCK_M,
) -> None:  # fmt: skip
    """Make a folder with the ride: images, true poses and depths.   frames: the first of it only.

    Raises FileExistsError where it is there already.
    """
    scene, path = street_block(block_m), ride(block_m)
    count = round(path.duration_s * camera.fps)
    stamps_ns = [round(1e9 * n / camera.fps) for n in range(min(count, frames or count))]
    geometry = SceneGeometry(scene)
    folder.mkdir(parents=True)
    with render_threads() as executor:
        textures = _paint(geometry, path, camera, [1e-9 * stamp for stamp in stamps_ns])
        renderer = Renderer(geometry, textures, path, camera)
        write_sequence(
            folder, scene.name, lambda n: renderer.frame(n, 1e-9 * stamps_ns[n]), stamps_ns,
            camera, scene.depth_scale, executor, lambda _what, _done, _total: None,
        )  # fmt: skip


def _paint(
    geometry: SceneGeometry, path: SplinePath, camera: CameraOptions, times_s: list[float]
) -> list[FaceTexture]:
    """The textures of all faces; those that the ride does not show are bare."""
    seen = _seen_faces(geometry, path, camera, times_s)
    seed = geometry.scene.seed
    textures: list[FaceTexture] = []
    for number, (solid, width, height) in enumerate(face_sizes(geometry.scene)):
        light, material = _daylight(geometry, number), solid.material
        density = solid.texels_per_metre
        if number not in seen:
            material, density = material.model_copy(update=_BARE), 1.0

        def paint(
            rows: int, columns: int, *, number: int = number, light: float = light,
            material: Material = material,
        ) -> F32:  # fmt: skip
            rng = np.random.default_rng([seed, number])
            return make_texture(rng, rows, columns, material) * np.float32(light)

        textures.append(mip_pyramid(width, height, density, paint))
    return textures


def _seen_faces(
    geometry: SceneGeometry, path: SplinePath, camera: CameraOptions, times_s: list[float]
) -> set[int]:
    """Faces that a coarse look along the path sees."""
    rays = pixel_rays(camera.pinhole(), camera.distortion)[::_LOOK_STRIDE, ::_LOOK_STRIDE]
    rays, seen = np.ascontiguousarray(rays), set[int]()
    for time in times_s[::_LOOK_EVERY]:
        faces = geometry.surface(path.T_world_camera(time), rays).faces
        seen.update(np.unique(faces).tolist())
    return seen


def _daylight(geometry: SceneGeometry, number: int) -> float:
    """How bright a face is, by where it faces alone: nothing casts a shadow."""
    solids = geometry.solids
    owner = int(np.searchsorted(solids.first_face, number, side="right")) - 1
    if geometry.scene.solids[owner].kind != "box":
        return 1.0
    face, middle = number - int(solids.first_face[owner]), np.zeros(1)
    _, normal = face_frame(1, face, solids.half[owner], middle, middle)
    towards = float(normal[0] @ solids.rotation[owner].T @ _SUN)
    return _SHADE + (1.0 - _SHADE) * max(towards, 0.0)
