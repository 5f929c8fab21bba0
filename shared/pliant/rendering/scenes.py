"""The built-in scenes and the paths through them."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from pliant.rendering.paths import CameraPath, SplinePath
from pliant.rendering.solids import Kind, Material, Scene, Solid, Vector


@dataclass(frozen=True)
class BuiltinScene:
    """A scene, its path, and how many frames the path has at 30 frames per second.

    colour: whether it is filmed in colour by default.
    """

    scene: Scene
    path: CameraPath
    frames: int
    width: int = 640
    colour: bool = True


def _solid(
    name: str,
    kind: Kind,
    centre: Vector,
    size: Vector,
    material: Material,
    *,
    yaw_deg: float = 0.0,
    texels: float = 600.0,
) -> Solid:
    return Solid(
        name=name,
        kind=kind,
        centre=centre,
        size=size,
        rotation=(0.0, 0.0, float(np.deg2rad(yaw_deg))),
        material=material,
        texels_per_metre=texels,
    )


# Red, green and blue: of their brightness only the grey values decide.
_ORANGE, _YELLOW, _RED = (1.7, 0.8, 0.4), (1.3, 1.05, 0.4), (1.8, 0.7, 0.65)
_BLUE, _TEAL, _LEAF = (0.5, 0.95, 1.8), (0.5, 1.15, 1.15), (0.75, 1.2, 0.5)
_VIOLET, _WHITE = (1.15, 0.8, 1.5), (1.02, 1.0, 0.94)

_PLASTER = Material(
    brightness=150, contrast=22, noise=4, coverage=0.12, tint=(1.13, 1.0, 0.76),
    hues=((1.2, 0.98, 0.66), (1.03, 1.01, 0.9)),
)  # fmt: skip
_WOOD = Material(
    brightness=115, contrast=24, noise=6, coverage=0.1, stretch=6, tint=(1.36, 0.92, 0.58),
    hues=((1.45, 0.88, 0.5), (1.25, 0.95, 0.7)),
)  # fmt: skip
_PALE_WOOD = Material(
    brightness=150, contrast=26, noise=6, coverage=0.12, stretch=5, tint=(1.24, 0.98, 0.62),
    hues=((1.3, 0.96, 0.5), (1.15, 1.0, 0.75)),
)  # fmt: skip
_CLOTH = Material(
    brightness=105, contrast=28, noise=6, coverage=0.22, tint=(0.6, 0.98, 1.55),
    hues=(_BLUE, _TEAL, (0.8, 1.0, 1.3)),
)  # fmt: skip
_RUG = Material(
    brightness=120, contrast=38, noise=5, coverage=0.25, tint=(1.7, 0.75, 0.65),
    hues=(_ORANGE, _YELLOW, _RED, _VIOLET),
)  # fmt: skip
_POSTER = Material(
    brightness=165, contrast=48, noise=4, coverage=0.2, writing=0.5, tint=(0.92, 1.01, 1.12),
    hues=(_ORANGE, _YELLOW, _RED, _BLUE, _TEAL, _LEAF),
)  # fmt: skip
_PAPER = Material(
    brightness=195, contrast=25, noise=3, coverage=0.06, writing=0.9, tint=_WHITE,
    hues=(_BLUE, _ORANGE),
)  # fmt: skip
_PRINT = Material(
    brightness=120, contrast=45, noise=5, coverage=0.2, writing=0.4, tint=(1.45, 0.88, 0.62),
    hues=(_YELLOW, _TEAL, _BLUE, _WHITE, _RED),
)  # fmt: skip
_GREEN = Material(
    brightness=110, contrast=35, noise=7, coverage=0.25, tint=(0.7, 1.22, 0.5),
    hues=(_LEAF, _TEAL, _YELLOW),
)  # fmt: skip
_STONE = Material(
    brightness=135, contrast=32, noise=8, coverage=0.22, tint=(1.02, 1.0, 0.95),
    hues=((1.1, 0.98, 0.85), (0.92, 1.01, 1.1)),
)  # fmt: skip
_METAL = Material(
    brightness=95, contrast=30, noise=5, coverage=0.2, tint=(0.62, 1.08, 1.2),
    hues=(_TEAL, (0.8, 1.05, 1.1), _BLUE),
)  # fmt: skip


def _room() -> BuiltinScene:
    """A living room of 5 x 4 x 2.6 m with a table in its middle."""
    s = _solid
    solids = [
        s("walls", "room", (2.5, 2.0, 1.3), (5.0, 4.0, 2.6), _PLASTER, texels=450),
        s("floor boards", "box", (2.5, 2.0, 0.005), (4.998, 3.998, 0.01), _WOOD, texels=400),
        s("rug", "box", (2.5, 1.9, 0.015), (2.8, 2.0, 0.012), _RUG, yaw_deg=4, texels=450),
        # The table and what stands on it.
        s("table top", "box", (2.5, 1.95, 0.73), (1.4, 0.8, 0.04), _PALE_WOOD, yaw_deg=8),
        s("leg 1", "cylinder", (1.96, 1.56, 0.365), (0.06, 0.06, 0.69), _WOOD),
        s("leg 2", "cylinder", (3.12, 1.72, 0.365), (0.06, 0.06, 0.69), _WOOD),
        s("leg 3", "cylinder", (1.88, 2.18, 0.365), (0.06, 0.06, 0.69), _WOOD),
        s("leg 4", "cylinder", (3.04, 2.34, 0.365), (0.06, 0.06, 0.69), _WOOD),
        s("globe", "sphere", (2.25, 2.05, 0.90), (0.30, 0.30, 0.30), _GREEN),
        s("parcel", "box", (2.85, 2.1, 0.85), (0.34, 0.22, 0.20), _PRINT, yaw_deg=-25),
        s("book", "box", (2.45, 1.72, 0.77), (0.30, 0.21, 0.04), _PAPER, yaw_deg=35),
        s("book on top", "box", (2.46, 1.72, 0.805), (0.24, 0.17, 0.03), _POSTER, yaw_deg=15),
        s("jar", "cylinder", (2.95, 1.78, 0.84), (0.16, 0.16, 0.18), _STONE),
        s("tin", "cylinder", (2.02, 1.80, 0.81), (0.10, 0.10, 0.12), _POSTER),
        # Along the wall x = 5.
        s("cupboard", "box", (4.75, 2.6, 0.9), (0.5, 1.1, 1.8), _WOOD, texels=450),
        s("stack", "box", (4.74, 2.5, 1.92), (0.3, 0.45, 0.24), _PRINT, yaw_deg=12),
        s("crate", "box", (4.55, 1.3, 0.25), (0.6, 0.7, 0.5), _PRINT, yaw_deg=-14, texels=450),
        s("ball", "sphere", (4.5, 1.25, 0.68), (0.36, 0.36, 0.36), _RUG),
        s("picture x5", "box", (4.985, 1.15, 1.6), (0.03, 1.1, 0.75), _POSTER),
        # Along the wall y = 4.
        s("sofa seat", "box", (2.2, 3.55, 0.22), (1.9, 0.8, 0.44), _CLOTH, texels=450),
        s("sofa back", "box", (2.2, 3.87, 0.6), (1.9, 0.22, 0.5), _CLOTH, texels=450),
        s("arm 1", "box", (1.17, 3.55, 0.32), (0.2, 0.8, 0.64), _CLOTH, texels=450),
        s("arm 2", "box", (3.23, 3.55, 0.32), (0.2, 0.8, 0.64), _CLOTH, texels=450),
        s("cushion", "box", (1.7, 3.62, 0.62), (0.45, 0.16, 0.4), _RUG, yaw_deg=20),
        s("picture y4", "box", (2.3, 3.985, 1.65), (1.3, 0.03, 0.8), _POSTER),
        s("column", "cylinder", (3.9, 3.65, 1.3), (0.4, 0.4, 2.6), _STONE, texels=450),
        # Along the walls x = 0 and y = 0.
        s("shelf", "box", (0.2, 2.3, 1.0), (0.4, 1.5, 2.0), _PALE_WOOD, texels=450),
        s("notice", "box", (0.412, 2.3, 1.3), (0.02, 1.2, 1.1), _PAPER),
        s("plant pot", "cylinder", (0.45, 3.5, 0.2), (0.42, 0.42, 0.4), _STONE),
        s("plant", "sphere", (0.45, 3.5, 0.75), (0.75, 0.75, 0.75), _GREEN),
        s("chest", "box", (1.2, 0.28, 0.4), (1.2, 0.5, 0.8), _METAL, texels=450),
        s("vase", "cylinder", (0.9, 0.3, 0.98), (0.2, 0.2, 0.36), _STONE),
        s("radio", "box", (1.45, 0.28, 0.93), (0.4, 0.2, 0.26), _PRINT, yaw_deg=-8),
        s("picture y0", "box", (1.3, 0.015, 1.7), (1.2, 0.03, 0.7), _POSTER),
        s("picture x0", "box", (0.015, 0.8, 1.6), (0.03, 0.8, 0.9), _POSTER),
        s("picture y0 far", "box", (3.4, 0.015, 1.5), (1.4, 0.03, 1.0), _PRINT, texels=450),
    ]
    scene = Scene(
        name="room", solids=tuple(solids), lights=((1.6, 1.4, 2.3), (3.6, 2.7, 2.3)), seed=11
    )
    path = SplinePath(
        positions=(
            (1.05, 1.15, 1.45),
            (1.2, 1.0, 1.43),
            (1.55, 0.82, 1.4),
            (2.1, 0.72, 1.32),
            (2.7, 0.7, 1.28),
            (3.3, 0.85, 1.32),
            (3.75, 1.3, 1.4),
            (3.9, 1.85, 1.48),
            (3.8, 2.4, 1.5),
            (3.6, 2.75, 1.46),
            (3.5, 2.8, 1.42),
            (3.6, 2.5, 1.4),
            (3.75, 2.0, 1.4),
            (3.75, 1.6, 1.4),
        ),
        targets=(
            (3.6, 2.3, 0.85),
            (3.5, 2.3, 0.8),
            (3.2, 2.3, 0.8),
            (2.9, 2.4, 0.8),
            (2.6, 2.5, 0.8),
            (2.4, 2.4, 0.85),
            (2.2, 2.4, 0.85),
            (1.9, 2.2, 0.85),
            (1.5, 1.8, 0.9),
            (1.3, 1.5, 0.95),
            (1.5, 1.6, 0.95),
            (1.8, 2.4, 0.9),
            (2.2, 3.0, 0.85),
            (2.5, 3.2, 0.8),
        ),
        duration_s=10.0,
    )
    return BuiltinScene(scene, path, frames=300)


def _tabletop(name: str, *, frames: int, width: int, texels: float) -> BuiltinScene:
    """Objects on a table; the camera circles a good third of the way around them."""
    s = _solid
    solids = [
        s("surroundings", "room", (0, 0, 0.9), (5.0, 5.0, 3.3), _PLASTER, texels=0.3 * texels),
        s("table", "cylinder", (0, 0, -0.025), (1.5, 1.5, 0.05), _PALE_WOOD, texels=texels),
        s("foot", "cylinder", (0, 0, -0.4), (0.2, 0.2, 0.69), _METAL, texels=0.5 * texels),
        s("globe", "sphere", (0.05, 0.18, 0.15), (0.3, 0.3, 0.3), _GREEN, texels=texels),
        s("box", "box", (-0.25, -0.05, 0.11), (0.26, 0.18, 0.22), _PRINT, yaw_deg=25),
        s("book", "box", (0.22, -0.2, 0.025), (0.3, 0.22, 0.05), _PAPER, yaw_deg=-20),
        s("tin", "cylinder", (0.32, 0.12, 0.08), (0.12, 0.12, 0.16), _POSTER, texels=texels),
        s("jar", "cylinder", (-0.08, -0.32, 0.07), (0.16, 0.16, 0.14), _STONE, texels=texels),
        s("ball", "sphere", (0.24, -0.2, 0.11), (0.12, 0.12, 0.12), _RUG, texels=texels),
    ]
    scene = Scene(
        name=name,
        solids=tuple(solids),
        lights=((1.2, 0.8, 2.2), (-1.4, -0.6, 2.3)),
        depth_scale=1e-4,
        seed=23,
    )
    turn = np.deg2rad(0.55) * frames
    angles = np.linspace(-0.5 * turn, 0.5 * turn, 12)
    radius = 1.15 + 0.12 * np.sin(3.0 * angles)
    height = 0.62 + 0.12 * np.cos(2.0 * angles)
    rows = zip(radius * np.cos(angles), radius * np.sin(angles), height, strict=True)
    positions = [(float(x), float(y), float(z)) for x, y, z in rows]
    path = SplinePath(positions, [(0.0, 0.0, 0.08)] * 12, duration_s=frames / 30.0)
    return BuiltinScene(scene, path, frames=frames, width=width)


def _corridor() -> BuiltinScene:
    """A corridor of 24 m, flown through straight ahead; doors, boxes and pillars on its sides."""
    rng = np.random.default_rng(5)
    solids = [
        _solid("walls", "room", (11.0, 0.0, 1.25), (26.0, 2.4, 2.5), _STONE, texels=250),
        _solid("floor", "box", (11.0, 0.0, 0.005), (25.99, 2.39, 0.01), _WOOD, texels=250),
    ]
    materials = [_PRINT, _POSTER, _WOOD, _PAPER, _CLOTH, _METAL, _GREEN]
    for i in range(22):
        side = 1.0 if i % 2 else -1.0
        x, material = 1.5 + i * 1.0 + 0.3 * rng.random(), materials[int(rng.integers(7))]
        depth, width, height = 0.12 + 0.25 * rng.random(), 0.3 + 0.5 * rng.random(), rng.random()
        if i % 5 == 4:
            size = (0.3, 0.3, 2.5)
            solids.append(
                _solid(f"pillar {i}", "cylinder", (x, 1.05 * side, 1.25), size, _STONE, texels=300)
            )
            continue
        low = 0.0 if i % 3 else 1.0
        size = (width, depth, 0.4 + height)
        centre = (x, side * (1.2 - 0.5 * depth), low + 0.5 * size[2])
        solids.append(_solid(f"box {i}", "box", centre, size, material, texels=350))
    lights = tuple((float(x), 0.0, 2.3) for x in (0.0, 4.5, 9.0, 13.5, 18.0, 22.0))
    scene = Scene(
        name="corridor", solids=tuple(solids), lights=lights, depth_scale=5e-4, ambient=0.6, seed=37
    )
    x = np.linspace(-1.0, 17.0, 16)
    positions = [(float(v), float(0.25 * np.sin(0.9 * v)), float(1.3 + 0.1 * np.sin(v))) for v in x]
    targets = [(p[0] + 4.0, 0.8 * p[1] + 0.25 * float(np.sin(0.5 * p[0])), 1.2) for p in positions]
    path = SplinePath(positions, targets, duration_s=12.0, tremble_m=0.006)
    return BuiltinScene(scene, path, frames=360)


def _court() -> BuiltinScene:
    """Four corridors about a court, flown through once around, 104 m, and 8 m on."""
    side, width = 26.0, 2.4  # of the square in the middle of the corridors; of a corridor
    half, rng = 0.5 * side, np.random.default_rng(9)
    outer, inner = side + width, side - width
    solids = [
        _solid("walls", "room", (0, 0, 1.25), (outer, outer, 2.5), _STONE, texels=140),
        _solid("court", "box", (0, 0, 1.25), (inner, inner, 2.499), _PLASTER, texels=140),
    ]
    materials = [_PRINT, _POSTER, _WOOD, _PAPER, _CLOTH, _METAL, _GREEN]
    for i in range(100):
        material = materials[int(rng.integers(7))]
        along = -half - 0.5 + (i % 25 + rng.random()) * (side + 1.0) / 25
        across = 1.0 if i % 2 else -1.0
        depth, length, height = 0.1 + 0.2 * rng.random(), 0.3 + 0.5 * rng.random(), rng.random()
        if across < 0.0:  # not where the corridor turns about the court
            along = float(np.clip(along, -half + 1.8, half - 1.8))
        low = 0.0 if i % 3 else 1.0
        tall = 0.4 + height
        x, y = along, half + across * 0.5 * (width - depth)
        yaw = 90.0 * (i // 25)
        cos, sin = round(np.cos(np.deg2rad(yaw))), round(np.sin(np.deg2rad(yaw)))
        centre = (cos * x - sin * y, sin * x + cos * y, low + 0.5 * tall)
        size = (length, depth, tall)
        solids.append(_solid(f"thing {i}", "box", centre, size, material, yaw_deg=yaw, texels=300))
    lights = tuple(
        (float(x), float(y), 2.3)
        for x in np.linspace(-half, half, 5)
        for y in np.linspace(-half, half, 5)
        if max(abs(x), abs(y)) == half
    )
    scene = Scene(
        name="court", solids=tuple(solids), lights=lights, depth_scale=5e-4, ambient=0.7, seed=41
    )
    # Half a metre between control points; a B-spline of them cuts the corners.
    s = np.arange(0.0, 4.0 * side + 14.0, 0.5)
    at = np.array([_on_square(float(each), side) for each in s])
    sway = 0.15 * np.sin(0.7 * s)
    positions = [
        (float(x), float(y), float(1.3 + 0.08 * np.sin(each)))
        for (x, y), each in zip(at + 0.5 * sway[:, None], s, strict=True)
    ]
    ahead = [_on_square(float(each) + 3.0, side) for each in s]
    targets = [(x, y, 1.2) for x, y in ahead]
    keep = round((4.0 * side + 8.0) / 0.5)
    path = SplinePath(positions[:keep], targets[:keep], duration_s=36.0, tremble_m=0.006)
    return BuiltinScene(scene, path, frames=1080)


def _on_square(along: float, side: float) -> tuple[float, float]:
    """A place on the outline of a square about (0, 0), from the middle of one side on."""
    part = (along / side + 0.5) % 4.0
    across = (part % 1.0 - 0.5) * side
    return [
        (across, -0.5 * side), (0.5 * side, across), (-across, 0.5 * side), (-0.5 * side, -across)
    ][int(part)]  # fmt: skip


def _tabletop_full() -> BuiltinScene:
    return _tabletop("tabletop", frames=240, width=640, texels=800.0)


def _tiny() -> BuiltinScene:
    """A small and short table top, for tests."""
    return replace(_tabletop("tiny", frames=40, width=320, texels=400.0), colour=False)


SCENES: dict[str, Callable[[], BuiltinScene]] = {
    "room": _room,
    "tabletop": _tabletop_full,
    "corridor": _corridor,
    "court": _court,
    "tiny": _tiny,
}
