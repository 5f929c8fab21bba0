"""Scenes that look the same in more than one place, rendered: rooms, doors, a chequered floor.

What is alike has the very same texture, light included; noise of the sensor alone differs.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from pliant.algorithms.arrays import F32, F64, U8
from pliant.rendering.face_textures import FaceTexture, make_face, mip_pyramid
from pliant.rendering.film import CameraOptions
from pliant.rendering.paths import SplinePath
from pliant.rendering.render import Renderer, SceneGeometry
from pliant.rendering.solids import Material, Scene, Solid, Vector, face_sizes

CAMERA = CameraOptions(width=320, height=240)
_STEP_M = 0.06
"""From frame to frame."""

_PLASTER = Material(brightness=150, contrast=26, noise=5, coverage=0.16)
_BARE = Material(brightness=150, contrast=0, noise=0, coverage=0.0)
_WOOD = Material(brightness=115, contrast=28, noise=6, coverage=0.15, stretch=4)
_PICTURE = Material(brightness=165, contrast=48, noise=4, coverage=0.25, writing=0.4)
_THING = Material(brightness=110, contrast=40, noise=6, coverage=0.25)


Way = list[tuple[Vector, Vector]]
"""Control points of where the camera is, and of what it looks at."""


@dataclass(frozen=True)
class Deceiver:
    """A scene, the way by which it is mapped, and others that begin after the dark, by name.

    twins: of solids, by name, the name of the one whose look they have.   chequers_m: side of the
    checks on the floor, 0: none.   apart_m: what looks alike is farther apart than twice this.
    moved_m: by which solids, by name, are to the right of where they were, after the dark.
    """

    solids: list[Solid]
    twins: dict[str, str]
    there: Way
    again: dict[str, Way]
    apart_m: float
    chequers_m: float = 0.0
    moved_m: dict[str, float] = field(default_factory=dict[str, float])

    def after_the_dark(self) -> "Deceiver":
        """What the camera comes back to."""

        def place(solid: Solid) -> Solid:
            x, y, z = solid.centre
            centre = (x + self.moved_m.get(solid.name, 0.0), y, z)
            return solid.model_copy(update={"centre": centre})

        return replace(self, solids=[place(solid) for solid in self.solids])


def _box(name: str, low: Vector, high: Vector, material: Material, texels: float = 160.0) -> Solid:
    a, b = np.array(low), np.array(high)
    (x, y, z), (w, d, h) = (0.5 * (a + b)).tolist(), (b - a).tolist()
    return Solid(
        name=name, kind="box", centre=(x, y, z), size=(w, d, h), material=material,
        texels_per_metre=texels,
    )  # fmt: skip


_ROOM_APART = 6.0


def _room(name: str, x: float, rng: np.random.Generator) -> list[Solid]:
    """4 m wide and 3.4 m deep, with a door in the middle of its front, and things along its back.

    x: of its left wall."""
    s = [
        _box(f"{name} floor", (x, 0.0, -0.1), (x + 4.0, 3.4, 0.0), _WOOD),
        _box(f"{name} left", (x - 0.1, 0.0, 0.0), (x, 3.4, 2.5), _PLASTER),
        _box(f"{name} right", (x + 4.0, 0.0, 0.0), (x + 4.1, 3.4, 2.5), _PLASTER),
        _box(f"{name} back", (x, 3.4, 0.0), (x + 4.0, 3.5, 2.5), _PLASTER),
    ]
    for i in range(6):
        at, deep = x + 0.1 + 0.65 * i + 0.1 * rng.random(), 0.3 + 0.4 * rng.random()
        tall = 0.35 + 0.6 * rng.random()
        low = (at, 3.4 - deep, 0.0)
        s.append(_box(f"{name} thing {i}", low, (at + 0.5, 3.4, tall), _THING))
    for i in range(2):
        low = (x + 0.2 + 2.4 * i, 3.36, 1.2 + 0.2 * rng.random())
        high = (low[0] + 0.9, 3.4, low[2] + 0.7)
        s.append(_box(f"{name} poster {i}", low, high, _PICTURE))
    s.append(_box(f"{name} picture", (x + 1.4, 3.35, 1.1), (x + 2.4, 3.4, 2.0), _PICTURE))
    return s


def _inside(x: float) -> Way:
    about = [(1.2, 1.3), (2.8, 1.1), (2.0, 0.9)]
    return [((x + u, v, 1.4), (x + 2.0 + 0.5 * (u - 2.0), 3.4, 1.2)) for u, v in about]


def rooms(seed: int, *, both: bool, other: Sequence[str] = ("picture",)) -> Deceiver:
    """Two rooms that are alike but for a picture, on one passage.

    both: are mapped; else the first alone.   other: what in the second room looks otherwise.
    """
    first = _room("first", 0.0, np.random.default_rng([seed, 1]))
    second = _room("second", _ROOM_APART, np.random.default_rng([seed, 1]))
    same = {b.name: a.name for a, b in zip(first, second, strict=True)}
    twins = {b: a for b, a in same.items() if b.removeprefix("second ") not in other}
    end = _ROOM_APART + 4.0
    passage = [
        _box("wall before", (-2.0, -0.1, 0.0), (1.4, 0.0, 2.5), _PLASTER),
        _box("wall between", (2.6, -0.1, 0.0), (_ROOM_APART + 1.4, 0.0, 2.5), _PLASTER),
        _box("wall behind", (_ROOM_APART + 2.6, -0.1, 0.0), (end + 2.0, 0.0, 2.5), _PLASTER),
        _box("floor", (-2.0, -3.0, -0.1), (end + 2.0, 0.0, 0.0), _WOOD),
    ]
    for i in range(3):
        low = (3.0 + 1.5 * i, -0.13, 1.0)
        passage.append(_box(f"notice {i}", low, (low[0] + 0.8, -0.1, 1.8), _PICTURE))

    def aside(x: float) -> Way:
        return [((x + 3.0, v, 1.4), (x + 3.7, 3.4, 1.0)) for v in (1.7, 1.5, 1.3)]

    def outside(x: float) -> Way:
        return [((x + 2.0, -1.6, 1.4), (x + 2.0, 3.4, 1.2))]

    there, x = _inside(0.0), _ROOM_APART
    again = {"the second, never seen before": _inside(x)}
    if both:
        there += [*outside(0.0), *outside(x), *_inside(x)[::-1]]
        again = {
            "the first": _inside(0.0)[::-1],
            "the second": _inside(x)[::-1],
            "the second, its picture not in view at first": aside(x) + _inside(x)[::-1],
        }
    return Deceiver([*first, *second, *passage], twins, there, again, apart_m=1.0)


_MOVED_M = 0.4


def furniture() -> list[str]:
    """Names of what stands and hangs in a room."""
    names = [solid.name for solid in _room("", 0.0, np.random.default_rng(0))]
    return [
        name.strip() for name in names if name.strip() not in ("floor", "left", "right", "back")
    ]


def room_with(seed: int, *moved: str) -> Deceiver:
    """A room in which some things hang or stand elsewhere after the dark."""
    solids = _room("first", 0.0, np.random.default_rng([seed, 1]))
    beside = [(0.8, 0.8), (1.6, 0.6), (0.8, 1.0), (1.6, 0.8), (1.0, 1.0), (2.0, 1.1), (2.8, 1.1)]
    at = [(4.0, 0.4), (4.0, 0.9), (4.0, 1.6), (4.0, 2.6), (3.6, 3.4), (2.6, 3.4), (2.4, 3.4)]
    turning: Way = [((*a, 1.4), (*b, 1.2)) for a, b in zip(beside, at, strict=True)]
    again = {"the room again": _inside(0.0)[::-1], "first a wall beside": turning}
    return Deceiver(
        solids, {}, _inside(0.0), again, apart_m=0.5 * _MOVED_M,
        moved_m={f"first {name}": _MOVED_M for name in moved},
    )  # fmt: skip


_DOORS, _DOOR_APART = 20, 1.2


def doors(seed: int, *, bare: bool) -> Deceiver:
    """A corridor with the same door twenty times, of which half are mapped.

    bare: there is nothing else on the wall.
    """
    length = _DOORS * _DOOR_APART
    wall = _BARE if bare else _PLASTER
    solids = [_box("wall", (-4.0, 0.0, 0.0), (length + 4.0, 0.1, 2.5), wall)]
    solids.append(_box("floor", (-4.0, -3.0, -0.1), (length + 4.0, 0.0, 0.0), wall))
    twins: dict[str, str] = {}
    for i in range(_DOORS):
        x = _DOOR_APART * i
        for part, low, high in (
            ("frame", (x, -0.06, 0.0), (x + 0.8, 0.0, 2.1)),
            ("handle", (x + 0.65, -0.14, 0.9), (x + 0.75, -0.06, 1.05)),
            ("plate", (x + 0.25, -0.09, 1.4), (x + 0.55, -0.06, 1.6)),
            ("chair", (x + 0.85, -0.5, 0.0), (x + 1.15, -0.2, 0.6)),
        ):
            material = _WOOD if part == "frame" else _PICTURE
            solids.append(_box(f"{part} {i}", low, high, material, texels=250.0))
            if i:
                twins[f"{part} {i}"] = f"{part} 0"
    rng = np.random.default_rng([seed, 2])

    def along(first: float, last: float) -> Way:
        count = 2 + round(abs(last - first) / 0.5)
        return [
            ((x, -1.7 - 0.15 * float(np.sin(1.3 * x)), 1.35), (x + 1.6, 0.0, 0.9))
            for x in np.linspace(first, last, count).tolist()
        ]

    begin, middle = _DOOR_APART * rng.random(), 0.5 * length
    back, beyond = middle - 4.0 - 2.0 * rng.random(), middle + 2.0 + 2.0 * rng.random()
    again = {
        "doors seen before": along(back, back - 2.0),
        "others": along(beyond, beyond + 2.0),
    }
    there = along(begin, middle)
    return Deceiver(solids, twins, there, again, apart_m=0.5 * _DOOR_APART)


_CHECK_M = 0.4


def floor(seed: int) -> Deceiver:
    """A chequered floor with a few things on it."""
    rng = np.random.default_rng([seed, 3])
    solids = [_box("floor", (-6.0, -6.0, -0.1), (6.0, 6.0, 0.0), _BARE)]
    solids += [
        _box(f"thing {i}", (x, y, 0.0), (x + 0.3, y + 0.3, 0.3), _THING)
        for i, (x, y) in enumerate([(-2.6, 0.3), (2.2, 2.7), (0.1, 4.2)])
    ]

    def over(*places: tuple[float, float]) -> Way:
        return [((x, y, 1.3), (x + 0.1, y + 1.6, 0.0)) for x, y in places]

    a, b = rng.uniform(-0.2, 0.2, 2).tolist()
    there = over((-2.5, -1.5), (-0.5 + a, -2.0), (1.5, -1.5), (2.0, b), (0.0, 0.4), (-2.0, -0.4))
    again = {
        "what was seen before": over((-1.0 + a, -1.8), (1.0, -1.7 + b)),
        "another part": over((-3.5 + a, -4.2), (-1.5, -4.4 + b)),
    }
    return Deceiver(solids, {}, there, again, apart_m=0.25, chequers_m=_CHECK_M)


class Film:
    """Films a deceiver, painted with this seed, way after way.   geometry: what there is."""

    def __init__(self, deceiver: Deceiver, seed: int) -> None:
        self._seed = seed
        self.geometry, self._textures = _paint(deceiver, seed)

    def along(self, way: Way, first: int = 0) -> Iterator[tuple[U8, F64]]:
        """Images (H, W) and true T_world_camera.  first: number of the first frame."""
        positions, targets = [at for at, _ in way], [target for _, target in way]
        steps = np.linalg.norm(np.diff(positions, axis=0), axis=1).sum() / _STEP_M
        path = SplinePath(positions, targets, duration_s=float(steps) / CAMERA.fps)
        options = CAMERA.model_copy(update={"seed": self._seed})
        renderer = Renderer(self.geometry, self._textures, path, options)
        for k in range(int(steps)):
            frame = renderer.frame(first + k, k / CAMERA.fps)
            yield frame.image, frame.T_world_camera


def _paint(deceiver: Deceiver, seed: int) -> tuple[SceneGeometry, list[FaceTexture]]:
    """The textures of all faces; twins have one."""
    lights = tuple((float(x), -1.5, 2.4) for x in np.linspace(-2.0, 24.0, 9))
    solids = tuple(deceiver.solids)
    scene = Scene(name="deceiver", solids=solids, lights=lights, ambient=0.8, seed=seed)
    geometry = SceneGeometry(scene)
    names = [solid.name for solid in solids]
    first = dict(zip(names, geometry.solids.first_face.tolist(), strict=True))
    textures: list[FaceTexture] = []
    for face, (solid, width, height) in enumerate(face_sizes(scene)):
        twin = deceiver.twins.get(solid.name, solid.name)
        density = solid.texels_per_metre
        if twin != solid.name:
            textures.append(textures[face - first[solid.name] + first[twin]])
        elif deceiver.chequers_m and solid.name == "floor":
            checks = partial(_chequers, deceiver.chequers_m * density)
            textures.append(mip_pyramid(width, height, density, checks))
        else:
            textures.append(make_face(scene, geometry.solids, face))
    return geometry, textures


def _chequers(side: float, height: int, width: int) -> F32:
    """Grey values of a chequered board whose checks have so many texels a side."""
    odd = (np.arange(height)[:, None] // side + np.arange(width) // side) % 2.0
    return (60.0 + 130.0 * odd).astype(np.float32)
