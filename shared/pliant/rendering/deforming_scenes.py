"""The built-in deforming scenes.  At rest they are 0.6 m before the camera, which is the world."""

from collections.abc import Callable
from dataclasses import replace
from typing import Literal, NamedTuple

import numpy as np
from pydantic import Field

from pliant.algorithms.arrays import F64
from pliant.algorithms.geometry import so3_exp
from pliant.rendering.film import FilmOptions
from pliant.rendering.paths import CameraPath, SplinePath
from pliant.rendering.sheets import DeformingScene, Lamp, Sheet
from pliant.rendering.solids import Material

_DEPTH_M = 0.6
_CELL_M = 0.01
_TAU = 2.0 * np.pi

_TISSUE = Material(brightness=125, contrast=34, noise=7, coverage=0.25)
_OTHER_TISSUE = Material(brightness=105, contrast=34, noise=8, coverage=0.25)
_PRINT = Material(brightness=112, contrast=42, noise=5, coverage=0.2, writing=0.4)
_SHIRT = Material(brightness=105, contrast=30, noise=7, coverage=0.22)
_BOARD = Material(brightness=125, contrast=40, noise=4, coverage=0.2, writing=0.3)
_WALL = Material(brightness=95, contrast=25, noise=5, coverage=0.2)
_STEEL = Material(brightness=70, contrast=25, noise=6, coverage=0.2, stretch=4.0)
# A static camera: a path of one point.
_STILL = SplinePath(
    [(0.0, 0.0, 0.0)] * 2,
    [(0.0, 0.0, 1.0)] * 2,
    1.0,
    tremble_m=0.0,
    tremble_rad=0.0,
    up=np.array([0.0, -1.0, 0.0]),
)
_LEAD_S = 0.1  # the shutter of the first frame opens before its middle
_TOOL_PERIOD_S = 2.4
_DROP_EVERY = 20  # frames


class DeformingOptions(FilmOptions):
    """Options after the name of every deforming sequence."""

    exposure: float = Field(
        default=0.0, ge=0.0, lt=1.0, description="Swing of the exposure; 0.2: 20 %."
    )
    light: float = Field(
        default=0.0,
        ge=0.0,
        lt=1.0,
        description="Lighting change: the lamp's strength swings by this share either way, and "
        "its place by as many metres.",
    )
    lamp: Literal["fixed", "camera"] = Field(
        default="fixed",
        description="camera: the lamp is at the camera, as an endoscope's, and the only light.",
    )
    gloss: float = Field(
        default=0.0, ge=0.0, le=4.0, description="Specular spots; 1: as bright as white."
    )
    tool: bool = Field(default=False, description="An instrument passes in front.")
    drop: int = Field(default=0, ge=0, lt=_DROP_EVERY, description="Frames missing after each 20.")


class PaperOptions(DeformingOptions):
    """Options of the Kinect paper."""

    tracks: str | None = Field(
        default=None, description="mdh_23frames_301pts.npz: the true points of the paper."
    )


class StretchingOptions(DeformingOptions):
    """Options of the stretching sheet."""

    stretch: float = Field(
        default=0.2, ge=0.0, le=0.5, description="Greatest strain along x: 0.2 is 20 %."
    )
    poisson: float = Field(
        default=0.5,
        ge=-1.0,
        le=1.0,
        description="It narrows by (1 + strain) ** -poisson; 0.5: rubber, 1: its area is kept.",
    )
    held: bool = Field(
        default=False,
        description="Its ends are held: what one part gains in length another part gives.",
    )


class BreathingOptions(DeformingOptions):
    """Options of the breathing surface before a moving camera."""

    amplitude: float = Field(
        default=0.03,
        ge=0.0,
        le=0.2,
        description="Of the motion, as a share of the depth; 0: rigid.",
    )
    seconds: float = Field(
        default=4.0, ge=1.0, le=60.0, description="How long it is, and the way of the camera."
    )
    travel: float = Field(
        default=0.0,
        ge=0.0,
        le=0.25,
        description="The camera goes so far to one side, to the other and back, metres: a third "
        "of the first view is 0.25.",
    )


class BoardOptions(DeformingOptions):
    """Options of the shaken board."""

    shift: float = Field(
        default=0.02, ge=0.0, le=0.2, description="From frame to frame, metres; any direction."
    )
    turn: float = Field(
        default=1.0, ge=0.0, le=20.0, description="From frame to frame, degrees; about any axis."
    )


class Builder(NamedTuple):
    """How a scene is made."""

    options: type[DeformingOptions]
    build: Callable[[DeformingOptions, F64 | None], DeformingScene]


def deforming_scene(
    name: str, options: DeformingOptions, tracks_m: F64 | None = None
) -> DeformingScene:
    """A scene with its lamp and its tool, by the options.

    tracks_m: (23, 301, 3) true points, for the Kinect paper alone.
    """
    scene = DEFORMING[name].build(options, tracks_m)
    lamp = Lamp(
        wander_m=options.light, gloss=255.0 * options.gloss, at_camera=options.lamp == "camera"
    )
    sheets = scene.sheets
    if options.tool:
        sheets = (*sheets, _tool(scene.path))
    return replace(scene, sheets=sheets, lamp=lamp)


def frame_numbers(count: int, drop: int) -> list[int]:
    """Which frames of 30 a second are there: after each 20 ``drop`` are missing."""
    return [i for i in range(count) if i < _DROP_EVERY or i % _DROP_EVERY >= drop]


def _grid(width: float, height: float, cell: float = _CELL_M) -> tuple[F64, F64]:
    """Material coordinates (R, C) x and y, metres, about the middle."""
    columns, rows = round(width / cell) + 1, round(height / cell) + 1
    x = np.linspace(-0.5 * width, 0.5 * width, columns)
    y = np.linspace(-0.5 * height, 0.5 * height, rows)
    grid_x, grid_y = np.meshgrid(x, y)
    return grid_x, grid_y


def _relief(x: F64, y: F64) -> F64:
    """A hilly surface, metres about 0."""
    return 0.012 * np.cos(_TAU * x / 0.47 + 0.4) * np.cos(_TAU * y / 0.39) + 0.004 * np.sin(
        _TAU * x / 0.23 + 1.1
    ) * np.sin(_TAU * y / 0.27 + 0.3)


def _wall() -> Sheet:
    """Out of the sensor's reach: it has texture, and no depth."""
    x, y = _grid(5.0, 4.0, 1.0)
    flat = np.stack([x, y, np.full_like(x, 3.0)], axis=2)
    return Sheet("wall", _WALL, 5.0, 4.0, lambda _time: flat, texels_per_metre=250.0)


def _paper(_options: DeformingOptions, tracks_m: F64 | None) -> DeformingScene:
    """The real motion of a sheet of paper (Kinect paper), with a texture of ours."""
    if tracks_m is None:
        raise ValueError("the Kinect paper needs its tracks")
    from pliant.rendering.paper_motion import paper_shape  # it has kernels

    width, height, shape = paper_shape(tracks_m)
    sheets = (Sheet("paper", _PRINT, width, height, shape), _wall())
    return DeformingScene("kinect-paper", sheets, _STILL, frames=8 * (len(tracks_m) - 1) + 1)


def _sliding(_options: DeformingOptions, _tracks: F64 | None) -> DeformingScene:
    """A sheet slides over another one, both breathe; between them is an edge of 2 cm."""
    x, y = _grid(1.0, 0.8)
    u, v = _grid(0.5, 0.8)
    u, v = u - 0.25 + 0.02 * np.sin(_TAU * v / 0.35) * (u + 0.25) / 0.5, v

    def rear(time_s: float) -> F64:
        phase = _TAU * time_s / 2.0
        z = _DEPTH_M + _relief(x, y) + 0.006 * np.sin(phase) * np.cos(_TAU * (x - 0.1) / 0.6)
        return np.stack([x - 0.01 * np.sin(0.5 * phase), y, z], axis=2)

    def front(time_s: float) -> F64:
        phase = _TAU * time_s / 2.0
        z = _DEPTH_M - 0.02 + 0.7 * _relief(u, v) + 0.006 * np.sin(phase + 0.8) * np.cos(9.0 * v)
        forward = 0.02 * (1.0 - np.cos(phase))
        return np.stack([u + forward, v + 0.012 * np.sin(phase), z], axis=2)

    sheets = (
        Sheet("front", _TISSUE, 0.5, 0.8, front),
        Sheet("rear", _OTHER_TISSUE, 1.0, 0.8, rear),
    )
    return DeformingScene("sliding", sheets, _STILL, frames=120)


def _stretching(options: DeformingOptions, _tracks: F64 | None) -> DeformingScene:
    """A curved sheet is stretched along x and let go again, once in 4 s."""
    assert isinstance(options, StretchingOptions)
    x, y = _grid(0.5, 0.4)

    def shape(time_s: float) -> F64:
        strain = options.stretch * 0.5 * (1.0 - np.cos(_TAU * time_s / 4.0))
        if options.held:
            along = 1.0 + strain * np.cos(_TAU * x / 0.5)
            wide = x + strain * 0.5 / _TAU * np.sin(_TAU * x / 0.5)
        else:
            along, wide = np.full_like(x, 1.0 + strain), x * (1.0 + strain)
        z = _DEPTH_M + 1.5 * _relief(x, y)
        return np.stack([wide, y * along**-options.poisson, z], axis=2)

    sheets = (Sheet("sheet", _TISSUE, 0.5, 0.4, shape), _wall())
    return DeformingScene("stretching", sheets, _STILL, frames=120)


def _breathing(options: DeformingOptions, _tracks: F64 | None) -> DeformingScene:
    """A hilly surface whose middle rises and falls, before a camera on a lively path."""
    assert isinstance(options, BreathingOptions)
    x, y = _grid(1.5, 1.2)
    z = _DEPTH_M + 1.5 * _relief(x, y)
    hill = np.exp(-0.5 * ((x / 0.17) ** 2 + (y / 0.14) ** 2))

    def shape(time_s: float) -> F64:
        rise = options.amplitude * _DEPTH_M * np.sin(_TAU * time_s / 2.0)
        return np.stack([x, y, z - rise * hill], axis=2)

    rng = np.random.default_rng(3)
    stations = round(13 * options.seconds / 4.0)
    points = rng.uniform(-1.0, 1.0, (2, stations, 3)) * np.array(
        [[[0.09, 0.07, 0.06]], [[0.07, 0.05, 0.0]]]
    )
    points[:, :, 0] += options.travel * np.sin(np.linspace(0.0, _TAU, stations))
    targets = points[1] + np.array([0.0, 0.0, _DEPTH_M])
    path = SplinePath(
        [(float(a), float(b), float(c)) for a, b, c in points[0]],
        [(float(a), float(b), float(c)) for a, b, c in targets],
        duration_s=options.seconds,
        up=np.array([0.0, -1.0, 0.0]),
        lead_s=_LEAD_S,
    )
    sheets = (Sheet("surface", _TISSUE, 1.5, 1.2, shape),)
    return DeformingScene("breathing", sheets, path, frames=round(30.0 * options.seconds))


def _objects(_options: DeformingOptions, _tracks: F64 | None) -> DeformingScene:
    """A sheet of paper that bends, a shirt in the wind, and a board that is moved about."""
    x, y = _grid(0.27, 0.21)
    u, v = _grid(0.34, 0.26)
    p, q = _grid(0.25, 0.21)

    def paper(time_s: float) -> F64:
        # A cylinder whose curvature changes: nothing is stretched.
        curvature = 1e-3 + 4.0 * np.sin(_TAU * time_s / 2.6)
        across, height = np.sin(curvature * x) / curvature, (1 - np.cos(curvature * x)) / curvature
        sway = 0.01 * np.sin(_TAU * time_s / 1.7)
        return np.stack([across - 0.17 + sway, y - 0.13, height + 0.57], axis=2)

    def shirt(time_s: float) -> F64:
        wave = _TAU * (u / 0.17 + 0.35 * v / 0.17 - time_s / 2.1)
        z = 0.65 + 0.006 * np.sin(wave) + 0.015 * np.sin(_TAU * time_s / 2.9) * (v / 0.13)
        return np.stack([u + 0.15, v + 0.12, z], axis=2)

    def board(time_s: float) -> F64:
        turn, tip = 0.2 * np.sin(_TAU * time_s / 3.1), 0.12 * np.sin(_TAU * time_s / 2.2)
        shift = 0.015 * np.sin(_TAU * time_s / 1.9)
        flat = np.stack([p, q, np.zeros_like(p)], axis=2) @ so3_exp(np.array([tip, turn, 0.0])).T
        return flat + np.array([0.18 + shift, -0.14 - shift, 0.62])

    sheets = (
        Sheet("paper", _PRINT, 0.27, 0.21, paper),
        Sheet("shirt", _SHIRT, 0.34, 0.26, shirt),
        Sheet("board", _BOARD, 0.25, 0.21, board),
        _wall(),
    )
    return DeformingScene("objects", sheets, _STILL, frames=120)


def _board(options: DeformingOptions, _tracks: F64 | None) -> DeformingScene:
    """A slanted board 1 m away goes somewhere by every odd frame, and is back by the even ones."""
    assert isinstance(options, BoardOptions)
    x, y = _grid(2.4, 1.9, 0.1)
    flat = np.stack([x, y, np.zeros_like(x)], axis=2) @ so3_exp(np.array([0.1, 0.3, 0.0])).T
    directions = np.random.default_rng(11).standard_normal((2, 64, 3))
    directions /= np.linalg.norm(directions, axis=2, keepdims=True)

    def shape(time_s: float) -> F64:
        number = time_s * 30.0
        out = 1.0 - abs((number % 2.0) - 1.0)
        shift, axis = directions[:, int(number // 2.0) % 64]
        R = so3_exp(out * np.deg2rad(options.turn) * axis)
        return flat @ R.T + out * options.shift * shift + np.array([0.0, 0.0, 1.0])

    sheets = (Sheet("board", _TISSUE, 2.4, 1.9, shape, texels_per_metre=800.0),)
    return DeformingScene("board", sheets, _STILL, frames=120)


def _tool(path: CameraPath) -> Sheet:
    """A rod of 16 mm that comes in from the right, sweeps about in front and leaves again."""
    angle, along = np.meshgrid(np.linspace(0.0, _TAU, 25), np.linspace(0.0, 0.5, 26))
    # The first rows close the tip.
    radius = 0.008 * np.minimum(1.0, np.sqrt(along / 0.02))
    rod = np.stack([along, radius * np.cos(angle), radius * np.sin(angle)], axis=2)
    c, s = np.cos(0.5), np.sin(0.5)
    rod = rod @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])

    def shape(time_s: float) -> F64:
        phase = (time_s % _TOOL_PERIOD_S) / _TOOL_PERIOD_S
        inside = np.clip(np.sin(_TAU * (phase - 0.1)), 0.0, None) if phase > 0.1 else 0.0
        tip = np.array([0.36 - 0.42 * inside, 0.1 - 0.08 * np.sin(3.0 * phase), 0.42])
        T = path.T_world_camera(time_s)
        return (rod + tip) @ T[:3, :3].T + T[:3, 3]

    return Sheet("tool", _STEEL, 0.5, 0.05, shape)


DEFORMING: dict[str, Builder] = {
    "kinect-paper": Builder(PaperOptions, _paper),
    "sliding": Builder(DeformingOptions, _sliding),
    "stretching": Builder(StretchingOptions, _stretching),
    "breathing": Builder(BreathingOptions, _breathing),
    "objects": Builder(DeformingOptions, _objects),
    "board": Builder(BoardOptions, _board),
}
"""The deforming scenes by name."""
