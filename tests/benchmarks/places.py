"""How often a place of a map is recognised, and how often a wrong one."""

import time
from collections.abc import Callable, Iterator
from dataclasses import replace

import cv2
import numpy as np

from benchmarks.table import markdown
from pliant.algorithms.arrays import F32, F64, U8
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import inverse, pose_to_matrix, so3_log, transform
from pliant.algorithms.slam.frame import Frame
from pliant.algorithms.slam.locate.landmark_search import LandmarkSearch
from pliant.algorithms.slam.map.keyframe import Keyframe
from pliant.algorithms.slam.map.landmarks import MAPPED
from pliant.algorithms.slam.mapper import Mapper
from pliant.algorithms.slam.places.place_index import describe
from pliant.algorithms.slam.places.relocalisation import Recognised
from pliant.algorithms.tracking.tracker import ExtremaTracker
from pliant.config import Config
from pliant.datasets import open_source
from pliant.datasets.rectifier import Rectifier, rectified
from pliant.map_history import MapHistory

_EVERY = 10
_APART_S = 1.0
_SHARE, _TURN_DEG = 0.5, 30.0
_OFF_SHARE, _OFF_DEG = 0.1, 5.0


class _Run:
    """A map, and the frames that are asked for."""

    def __init__(self, source: str, config: Config) -> None:
        dataset = open_source(source)
        rectifier = Rectifier(dataset.calibration)
        self.camera: PinholeCamera = rectifier.camera
        self.config = config
        tracker = ExtremaTracker(
            self.camera.width, self.camera.height, config.tracking, config.seed
        )
        self.mapper = Mapper(self.camera, config.bundle_adjustment, config.seed)
        history = MapHistory()
        self.frames: dict[int, tuple[int, U8, F32]] = {}
        last = 0
        for frame in dataset:
            image = rectified(frame, rectifier)
            tracks = tracker.track(image.grey, image.stamp_ns)
            last = image.frame
            delta = self.mapper.process(Frame(last, image.stamp_ns, tracks, image.grey))
            self.mapper.publish_keyframes()
            history.apply(delta, frame=last, stamp_ns=image.stamp_ns)
            if last % _EVERY == 0:
                self.frames[last] = image.stamp_ns, image.grey, tracks.maxima
        history.apply(self.mapper.finish(), frame=last, stamp_ns=0, final=True)
        self.poses = {f: (s, pose_to_matrix(pose)) for f, (s, pose) in history.final().items()}
        self.stamps = history.stamps_ns

    @property
    def keyframes(self) -> list[Keyframe]:
        """Of the last segment."""
        active = self.mapper.atlas.active
        return [] if active is None else active.keyframes

    def ask(self, grey: U8, maxima: F32, stamp_ns: int | None) -> tuple[Recognised | None, float]:
        """What the map says to an image, and in how many ms the index.

        stamp_ns: of one of its own frames."""
        atlas = self.mapper.atlas
        begin = time.process_time()
        atlas.places.index.query(describe(grey))
        asked = time.process_time() - begin
        apart = [k for k in self.keyframes if self.is_apart(k, stamp_ns)]
        segments = [] if atlas.active is None else [replace(atlas.active.segment, keyframes=apart)]
        view = self.mapper.calibration.view
        search = LandmarkSearch(
            atlas.points, maxima, grey, view.camera, self.config.bundle_adjustment,
            np.random.default_rng(0),
        )  # fmt: skip
        found = atlas.places.recognise(search, segments, view)
        return found, 1e3 * asked

    def is_apart(self, keyframe: Keyframe, stamp_ns: int | None) -> bool:
        """Whether a keyframe is of another time."""
        return stamp_ns is None or abs(self.stamps[keyframe.frame] - stamp_ns) > 1e9 * _APART_S

    def is_in_view(self, T_world_camera: F64, stamp_ns: int) -> bool:
        """Whether some keyframe of another time shows half of the surface, from not far aside."""
        points = self.mapper.atlas.points
        for keyframe in self.keyframes:
            turn = so3_log(keyframe.T_world_camera[:3, :3].T @ T_world_camera[:3, :3])
            aside = np.degrees(np.linalg.norm(turn)) > _TURN_DEG
            if aside or not self.is_apart(keyframe, stamp_ns):
                continue
            rows = keyframe.rows[points.state[keyframe.rows] == MAPPED]
            seen = transform(inverse(T_world_camera), points.xyz[rows])
            front = seen[:, 2] > 0.0
            px = self.camera.project(np.where(front[:, None], seen, 1.0))
            size = (self.camera.width, self.camera.height)
            inside = front & (px >= 0.0).all(axis=1) & (px < size).all(axis=1)
            if len(rows) and inside.mean() >= _SHARE:
                return True
        return False

    def is_right(self, found: Recognised, T_world_camera: F64) -> bool:
        """Whether a pose is that of the frame."""
        points = self.mapper.atlas.points
        between = inverse(found.T_world_camera) @ T_world_camera
        rows = found.keyframe.rows[points.state[found.keyframe.rows] == MAPPED]
        depth = np.median(transform(inverse(T_world_camera), points.xyz[rows])[:, 2])
        turn = np.degrees(np.linalg.norm(so3_log(between[:3, :3])))
        return bool(turn < _OFF_DEG and np.linalg.norm(between[:3, 3]) < _OFF_SHARE * depth)


def _darker(grey: U8) -> U8:
    return (0.5 * grey).astype(np.uint8)


def _blurred(grey: U8) -> U8:
    return np.asarray(cv2.blur(grey, (9, 1)), np.uint8)


_CHANGES: dict[str, Callable[[U8], U8]] = {
    "as it is": lambda grey: grey,
    "half the light": _darker,
    "blur of 9 px": _blurred,
}
_HEADER = (
    *("map", "asked with", "frames", "recognised, of those in view", "wrong", "keyframes"),
    "to describe and look up, ms",
)


def measure(sources: list[str], config: Config) -> Iterator[str]:
    """Frames of each source in its own map, without the second about them, and in the others'."""
    runs = {source: _Run(source, config) for source in sources}
    rows: list[tuple[str, ...]] = []
    for name, run in runs.items():
        rows += [_own(name, how, run, change) for how, change in _CHANGES.items()]
        others = [other for other in runs if other != name]
        asked = [run.ask(*runs[o].frames[f][1:], None)[0] for o in others for f in runs[o].frames]
        wrong = sum(found is not None for found in asked)
        rows.append((name, "frames of the others", str(len(asked)), "-", str(wrong), "-", "-"))
    yield markdown(_HEADER, rows)


def _own(name: str, how: str, run: _Run, change: Callable[[U8], U8]) -> tuple[str, ...]:
    in_view = recognised = wrong = asked = 0
    times: list[float] = []
    for frame, (stamp_ns, grey, maxima) in run.frames.items():
        if frame not in run.poses or run.poses[frame][0] != run.keyframes[-1].segment:
            continue
        T_world_camera = run.poses[frame][1]
        found, ms = run.ask(change(grey), maxima, stamp_ns)
        visible = run.is_in_view(T_world_camera, stamp_ns)
        right = found is not None and run.is_right(found, T_world_camera)
        asked, in_view, recognised = asked + 1, in_view + visible, recognised + (visible and right)
        wrong += found is not None and not right
        times.append(ms)
    share = f"{recognised} of {in_view}"
    return (
        name,
        how,
        str(asked),
        share,
        str(wrong),
        str(len(run.keyframes)),
        f"{np.median(times):.1f}",
    )
