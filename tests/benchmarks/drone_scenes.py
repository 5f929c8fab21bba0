"""A machine hall and a room of the size of EuRoC's, filled with things that no flight runs into."""

import numpy as np

from pliant.algorithms.arrays import F64
from pliant.rendering.solids import Kind, Material, Scene, Solid

_MARGIN_M = 3.0
"""Walls stand this far around all flights of a hall; half as far in a room."""
_CLEARANCE_M = 0.6
"""Nothing comes nearer than this to a flight."""
_THINGS = 60

_MATERIALS = (
    Material(brightness=120, contrast=45, noise=5, coverage=0.2, writing=0.4),
    Material(brightness=165, contrast=48, noise=4, coverage=0.2, writing=0.5),
    Material(brightness=115, contrast=24, noise=6, coverage=0.1, stretch=6),
    Material(brightness=95, contrast=30, noise=5, coverage=0.2),
    Material(brightness=110, contrast=35, noise=7, coverage=0.25),
    Material(brightness=135, contrast=32, noise=8, coverage=0.22),
)
_WALL = Material(brightness=140, contrast=28, noise=6, coverage=0.18)


def drone_scene(name: str, positions: F64) -> Scene:
    """A scene about flights.  name: "MH..." becomes a hall.  positions: (N, 3) of all of them."""
    hall = name.startswith("MH")
    margin = _MARGIN_M if hall else 0.5 * _MARGIN_M
    low = positions.min(axis=0) - (margin, margin, 0.8)
    high = positions.max(axis=0) + margin
    size, centre = high - low, 0.5 * (low + high)
    texels = 90.0 if hall else 220.0
    rng = np.random.default_rng(sum(map(ord, name)))
    solids = [_solid("walls", "room", centre, size, _WALL, texels)]
    while len(solids) <= _THINGS:
        solid = _thing(len(solids), rng, low, high, hall=hall, texels=1.5 * texels)
        if _clear(solid, positions):
            solids.append(solid)
    lamps = [
        (float(x), float(centre[1]), float(high[2] - 0.4))
        for x in np.linspace(low[0], high[0], 5)[1:-1]
    ]
    return Scene(name=name, solids=tuple(solids), lights=tuple(lamps), ambient=0.6, seed=7)


def _thing(
    number: int, rng: np.random.Generator, low: F64, high: F64, *, hall: bool, texels: float
) -> Solid:
    """A box or a cylinder on the floor; every third one a panel on a wall."""
    material = _MATERIALS[int(rng.integers(len(_MATERIALS)))]
    scale = 1.0 if hall else 0.5
    size = scale * rng.uniform((0.4, 0.4, 0.4), (2.2, 2.2, 3.0))
    centre = rng.uniform(low, high)
    centre[2] = low[2] + 0.5 * size[2]
    kind: Kind = "cylinder" if number % 4 == 1 else "box"
    yaw = rng.uniform(0.0, np.pi)
    if number % 3 == 0:
        kind, yaw, axis = "box", 0.0, int(rng.integers(2))
        size[axis] = 0.1
        centre[axis] = (low, high)[int(rng.integers(2))][axis]
        centre[2] = rng.uniform(low[2] + 0.5, high[2] - 0.5)
    if kind == "cylinder":
        size[1] = size[0]
    return _solid(f"thing {number}", kind, centre, size, material, texels, float(yaw))


def _solid(
    name: str,
    kind: Kind,
    centre: F64,
    size: F64,
    material: Material,
    texels: float,
    yaw: float = 0.0,
) -> Solid:
    x, y, z = (float(v) for v in centre)
    a, b, c = (float(v) for v in size)
    return Solid(
        name=name, kind=kind, centre=(x, y, z), size=(a, b, c), rotation=(0.0, 0.0, yaw),
        material=material, texels_per_metre=texels,
    )  # fmt: skip


def _clear(solid: Solid, positions: F64) -> bool:
    """Whether every position keeps its distance."""
    cos, sin = np.cos(solid.rotation[2]), np.sin(solid.rotation[2])
    x, y, z = (positions - solid.centre).T
    own = np.column_stack([cos * x + sin * y, cos * y - sin * x, z])
    beyond = np.maximum(np.abs(own) - 0.5 * np.array(solid.size), 0.0)
    return bool((np.linalg.norm(beyond, axis=1) > _CLEARANCE_M).all())
