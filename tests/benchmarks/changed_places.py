"""How often a rendered room is recognised that has changed since it was mapped, by exact truth."""

from collections.abc import Callable, Iterator
from functools import partial

import numpy as np

from benchmarks.deceiving_scenes import CAMERA, Film, Way, furniture, room_with
from benchmarks.table import markdown_header, markdown_row
from pliant.algorithms.arrays import F64, U8
from pliant.algorithms.geometry import align_umeyama, inverse, so3_log, transform
from pliant.algorithms.slam.frame import Frame
from pliant.algorithms.slam.mapper import Mapper
from pliant.algorithms.tracking.maxima import maxima_of
from pliant.algorithms.tracking.tracker import ExtremaTracker
from pliant.config import Config
from pliant.rendering.lens import NO_DISTORTION, pixel_rays
from pliant.rendering.render import SceneGeometry

_SHARE, _TURN_DEG = 0.5, 30.0
_OFF_SHARE, _OFF_DEG = 0.1, 5.0
_STRIDE_PX = 16
_SAME_DEPTH = 0.05
_MOVED = 2
"""Of nine things."""
_HEADER = ("the room", "frames", "recognised, of those in view", "wrong")

Views = list[tuple[U8, F64]]
"""Images (H, W) with their true T_world_camera."""


class Mapped:
    """The map of a way through a scene."""

    def __init__(self, views: Views, geometry: SceneGeometry, config: Config) -> None:
        self._config, self._geometry, self._camera = config, geometry, CAMERA.pinhole()
        self._rays = pixel_rays(self._camera, NO_DISTORTION)[::_STRIDE_PX, ::_STRIDE_PX].copy()
        tracker = ExtremaTracker(CAMERA.width, CAMERA.height, config.tracking, config.seed)
        mapper = Mapper(self._camera, config.bundle_adjustment, config.seed)
        for k, (grey, _) in enumerate(views):
            stamp_ns = round(k * 1e9 / CAMERA.fps)
            mapper.process(Frame(k, stamp_ns, tracker.track(grey, stamp_ns), grey))
            mapper.publish_keyframes()
        mapper.finish()
        self._atlas = mapper.atlas
        assert self._atlas.active is not None
        keyframes = self._atlas.active.keyframes
        self._keyframes = [views[keyframe.frame][1] for keyframe in keyframes]
        mine = np.array([keyframe.T_world_camera[:3, 3] for keyframe in keyframes])
        true = np.array([T[:3, 3] for T in self._keyframes])
        self._alignment = align_umeyama(mine, true, with_scale=True)

    def ask(self, grey: U8) -> F64 | None:
        """T_world_camera in the true world of an image (H, W), as far as it is recognised."""
        maxima = maxima_of(grey, self._config.tracking)
        found = self._atlas.recognise(grey, maxima, np.random.default_rng(0))
        if found is None:
            return None
        scale, R, t = self._alignment
        pose = np.eye(4)
        pose[:3, :3] = R @ found.T_world_camera[:3, :3]
        pose[:3, 3] = scale * R @ found.T_world_camera[:3, 3] + t
        return pose

    def is_in_view(self, T_world_camera: F64) -> bool:
        """Whether the camera sees half of what some keyframe shows, from not far aside."""
        depth = self._geometry.depth(T_world_camera, self._rays)
        for keyframe in self._keyframes:
            if _turn_deg(keyframe, T_world_camera) > _TURN_DEG:
                continue
            shown = self._geometry.depth(keyframe, self._rays)
            rays = np.concatenate([self._rays, np.ones_like(shown)[..., None]], axis=-1)
            surface = transform(keyframe, (rays * shown[..., None])[shown > 0.0])
            seen = transform(inverse(T_world_camera), surface)
            px = self._camera.project(np.where(seen[:, 2:] > 0.0, seen, 1.0))
            cell = np.round(px / _STRIDE_PX).astype(np.int64)
            inside = (seen[:, 2] > 0.0) & (cell >= 0).all(axis=1)
            inside &= (cell < depth.shape[::-1]).all(axis=1)
            column, row = cell[inside].T
            # Not hidden: the grid is coarse, so that an edge beside it may count either way.
            before = depth[row, column] < (1.0 - _SAME_DEPTH) * seen[inside, 2]
            if np.count_nonzero(~before) >= _SHARE * len(surface):
                return True
        return False

    def is_right(self, found: F64, T_world_camera: F64) -> bool:
        """Whether a pose is that of the camera."""
        depth = self._geometry.depth(T_world_camera, self._rays)
        off = float(np.linalg.norm(found[:3, 3] - T_world_camera[:3, 3]))
        near = off < _OFF_SHARE * float(np.median(depth[depth > 0.0]))
        return near and _turn_deg(found, T_world_camera) < _OFF_DEG


def _turn_deg(a: F64, b: F64) -> float:
    return float(np.degrees(np.linalg.norm(so3_log(a[:3, :3].T @ b[:3, :3]))))


def half_the_light(grey: U8) -> U8:
    """Of an image."""
    return (0.5 * grey).astype(np.uint8)


def exposed(grey: U8, gain: float, gamma: float) -> U8:
    """As another exposure and another curve of the sensor make it."""
    light = np.minimum(gain * grey / 255.0, 1.0)
    return np.round(255.0 * light**gamma).astype(np.uint8)


_CHANGES: dict[str, Callable[[U8], U8]] = {
    "as it was": lambda grey: grey,
    "half the light": half_the_light,
    "1.6 times the exposure, gamma 0.7": partial(exposed, gain=1.6, gamma=0.7),
    "0.6 times the exposure, gamma 1.4": partial(exposed, gain=0.6, gamma=1.4),
}


def _beside(way: Way, times: float) -> Way:
    """A way somewhat beside another one, at so many times the distance from what it looks at."""

    def off(at: tuple[float, ...], to: tuple[float, ...]) -> tuple[float, float, float]:
        x, y, z = (t + times * (a - t) for a, t in zip(at, to, strict=True))
        return (x + 0.15, y + 0.1, z + 0.1)

    return [(off(at, to), to) for at, to in way]


def _asked(seed: int, film: Film, way: Way) -> Iterator[tuple[str, U8, F64]]:
    """What the room looks like afterwards, an image of it, and where that was taken."""
    near = list(film.along(_beside(way, 1.0), 1000))[::2]
    for how, change in _CHANGES.items():
        yield from ((how, change(grey), pose) for grey, pose in near)
    far = list(film.along(_beside(way, 2.0), 2000))[::4]
    yield from (("from twice the distance", *view) for view in far)
    things = np.random.default_rng([seed, 4]).choice(furniture(), _MOVED, replace=False).tolist()
    moved = Film(room_with(seed, *things).after_the_dark(), seed)
    elsewhere = list(moved.along(_beside(way, 1.0), 3000))[::2]
    yield from (("two of nine things elsewhere", *view) for view in elsewhere)


def measure(config: Config, seeds: int) -> Iterator[str]:
    """A row for each change, of so many rooms."""
    counts: dict[str, list[int]] = {}
    for seed in range(seeds):
        room = room_with(seed)
        film = Film(room, seed)
        map_of = Mapped(list(film.along(room.there)), film.geometry, config)
        for how, grey, pose in _asked(seed, film, room.there[::-1]):
            found, visible = map_of.ask(grey), map_of.is_in_view(pose)
            right = found is not None and map_of.is_right(found, pose)
            row = counts.setdefault(how, [0, 0, 0, 0])
            row[0] += 1
            row[1] += visible and right
            row[2] += visible
            row[3] += found is not None and not right
        other = Film(room_with(seed + seeds), seed + seeds)
        row = counts.setdefault("another room", [0, 0, 0, 0])
        for grey, _ in list(other.along(room.there))[::2]:
            row[0] += 1
            row[3] += map_of.ask(grey) is not None
    yield markdown_header(_HEADER)
    for how, (frames, right, visible, wrong) in counts.items():
        yield markdown_row((how, str(frames), f"{right} of {visible}", str(wrong)))
