"""A source cut in two: the second half localised in the map of the first, and extending it."""

import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.table import markdown_header, markdown_row
from pliant.algorithms.arrays import F64, I64
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import align_umeyama, inverse, pose_to_matrix, so3_log, transform
from pliant.algorithms.slam.frame import Frame
from pliant.algorithms.slam.localiser import Localiser
from pliant.algorithms.slam.map.kept_keyframe import KeptKeyframe
from pliant.algorithms.slam.mapper import Mapper
from pliant.algorithms.tracking.tracker import ExtremaTracker
from pliant.config import Config
from pliant.datasets import open_source
from pliant.datasets.rectifier import Rectifier, rectified
from pliant.formats.trajectory_files import read_trajectory
from pliant.map_history import MapHistory
from pliant.messages.types import Header, MapKeyframe
from pliant.recording.map_file import MAP_NAME, MapFile, MapHeader, write_map
from pliant.trajectory import associate

_SHARE, _TURN_DEG = 0.5, 30.0
_HEADER = (
    *("source", "keyframes", "kB each", "load, ms each", "second half localised", "in view"),
    *("median error", "of the map itself", "ms: track, localise, map", "ATE uncut", "ATE of both"),
)


@dataclass
class _Half:
    """poses: T_world_camera by frame, of one segment."""

    history: MapHistory
    mapper: Mapper | Localiser
    track_ms: float
    map_ms: float

    def poses(self, segment: int) -> dict[int, F64]:
        final = self.history.final().items()
        return {f: pose_to_matrix(pose) for f, (s, pose) in final if s == segment}


class Source:
    """A sequence with its truth."""

    def __init__(self, name: str, config: Config) -> None:
        self._config, self._dataset = config, open_source(name)
        self._rectifier = Rectifier(self._dataset.calibration)
        self.camera: PinholeCamera = self._rectifier.camera
        self.stamps_ns = [frame.stamp_ns for frame in self._dataset]
        assert self._dataset.ground_truth_path is not None
        self._truth = read_trajectory(Path(self._dataset.ground_truth_path))

    def run(
        self, frames: range, known: Sequence[KeptKeyframe] = (), *, only: bool = False
    ) -> _Half:
        """Map some of the frames, or only localise them."""
        config, camera = self._config, self.camera
        tracker = ExtremaTracker(camera.width, camera.height, config.tracking, config.seed)
        kind = Localiser if only else Mapper
        mapper = kind(camera, config.bundle_adjustment, config.seed, known=known)
        history, spent, last = MapHistory(), [0.0, 0.0], frames[0]
        for source in self._dataset:
            if source.index not in frames:
                continue
            image = rectified(source, self._rectifier)
            begin = time.process_time()
            tracks = tracker.track(image.grey, image.stamp_ns)
            tracked = time.process_time()
            last, colour = image.frame, image.colour if image.colour.size else None
            delta = mapper.process(Frame(last, image.stamp_ns, tracks, image.grey, colour))
            mapper.publish_keyframes()
            spent[0] += tracked - begin
            spent[1] += time.process_time() - tracked
            history.apply(delta, frame=last, stamp_ns=image.stamp_ns)
        history.apply(mapper.finish(), frame=last, stamp_ns=0, final=True)
        each = [1e3 * seconds / len(frames) for seconds in spent]
        return _Half(history, mapper, *each)

    def truth_of(self, poses: dict[int, F64]) -> tuple[list[int], F64]:
        """Frames that have a true pose, and those (n, 4, 4)."""
        frames = sorted(poses)
        stamps = np.array([self.stamps_ns[frame] for frame in frames], np.int64)
        mine, true = associate(stamps, self._truth.stamps_ns)
        return [frames[i] for i in mine.tolist()], self._truth.T_world_camera[true]

    def ate_mm(self, poses: list[tuple[int, F64]]) -> float:
        """Of frames, each maybe several times, with their poses (4, 4), in one world: the Sim(3)
        that aligns their positions leaves so much."""
        known, truth = self.truth_of(dict(poses))
        at = dict(zip(known, truth[:, :3, 3], strict=True))
        mine = np.array([pose[:3, 3] for frame, pose in poses if frame in at])
        true = np.array([at[frame] for frame, _ in poses if frame in at])
        scale, R, t = align_umeyama(mine, true, with_scale=True)
        return 1e3 * float(np.sqrt(((scale * mine @ R.T + t - true) ** 2).sum(axis=1).mean()))


def measure(sources: list[str], config: Config) -> Iterator[str]:
    """A row for each source, whose frames have true poses."""
    yield markdown_header(_HEADER)
    for name in sources:
        yield markdown_row(_row(name, Source(name, config)))


def _row(name: str, source: Source) -> tuple[str, ...]:
    count = len(source.stamps_ns)
    first, second = range(count // 2), range(count // 2, count)
    mapped = source.run(first)
    assert isinstance(mapped.mapper, Mapper)
    size, load_ms, kept = through_file(mapped.mapper)
    segment = mapped.history.longest_segment()
    scale, R, t = _alignment(source, mapped.poses(segment))
    localised = source.run(second, kept, only=True)
    poses = localised.poses(segment)
    # Of all frames, where the truth says that the camera was.
    frames, truth = source.truth_of(dict.fromkeys(second, np.eye(4)))
    in_map = truth.copy()
    in_map[:, :3, :3] = R.T @ truth[:, :3, :3]
    in_map[:, :3, 3] = (truth[:, :3, 3] - t) @ R / scale
    ids = np.concatenate([keyframe.point_ids for keyframe in kept])
    order = np.argsort(ids)
    points = np.concatenate([keyframe.points_world for keyframe in kept])[order]
    visible = [_in_view(T, kept, ids[order], points, source.camera) for T in in_map]
    found = sum(f in poses for f, seen in zip(frames, visible, strict=True) if seen)
    gone_on = source.run(second, kept)
    both = mapped.poses(segment) | gone_on.poses(segment)
    uncut = source.run(range(count))
    whole = uncut.poses(uncut.history.longest_segment())
    times = localised.track_ms, localised.map_ms, gone_on.map_ms
    return (
        name,
        str(len(kept)),
        f"{size / 1e3 / len(kept):.0f}",
        f"{load_ms / len(kept):.1f}",
        f"{len(poses)} of {len(second)}",
        f"{found} of {sum(visible)}",
        _median_error(source, poses, (scale, R, t)),
        _median_error(source, mapped.poses(segment), (scale, R, t)),
        ", ".join(f"{ms:.0f}" for ms in times),
        f"{source.ate_mm(list(whole.items())):.2f} mm",
        f"{source.ate_mm(list(both.items())):.2f} mm of {len(both)} frames",
    )


def through_file(mapper: Mapper) -> tuple[int, float, list[MapKeyframe]]:
    """Bytes of the file, ms to read it, and the map."""
    with tempfile.TemporaryDirectory() as folder:
        headers = (Header(frame=n, stamp_ns=0, frame_id="") for n in range(1 << 30))
        kept = (MapKeyframe.of(h, k) for h, k in zip(headers, mapper.kept(), strict=False))
        write_map(Path(folder) / MAP_NAME, MapHeader(), kept)
        begin = time.process_time()
        read = list(MapFile(Path(folder)).keyframes())
        spent = time.process_time() - begin
        return (Path(folder) / MAP_NAME).stat().st_size, 1e3 * spent, read


def _alignment(source: Source, poses: dict[int, F64]) -> tuple[float, F64, F64]:
    frames, truth = source.truth_of(poses)
    mine = np.array([poses[frame][:3, 3] for frame in frames])
    return align_umeyama(mine, truth[:, :3, 3], with_scale=True)


def _median_error(source: Source, poses: dict[int, F64], alignment: tuple[float, F64, F64]) -> str:
    """Of positions and orientations to the truth, under the alignment of the map's positions."""
    scale, R, t = alignment
    frames, truth = source.truth_of(poses)
    off = [
        (
            100.0 * float(np.linalg.norm(scale * R @ poses[f][:3, 3] + t - T[:3, 3])),
            float(np.degrees(np.linalg.norm(so3_log((R @ poses[f][:3, :3]).T @ T[:3, :3])))),
        )
        for f, T in zip(frames, truth, strict=True)
    ]
    centimetres, degrees = np.median(np.array(off), axis=0)
    return f"{centimetres:.2f} cm, {degrees:.2f} deg"


def _in_view(
    T_world_camera: F64, kept: list[MapKeyframe], ids: I64, points: F64, camera: PinholeCamera
) -> bool:
    """Whether some keyframe shows half of the surface, from not far aside."""
    size = (camera.width, camera.height)
    for keyframe in kept:
        turn = so3_log(keyframe.T_world_camera[:3, :3].T @ T_world_camera[:3, :3])
        if np.degrees(np.linalg.norm(turn)) > _TURN_DEG:
            continue
        xyz = points[np.searchsorted(ids, keyframe.seen_ids)]
        seen = transform(inverse(T_world_camera), xyz)
        front = seen[:, 2] > 0.0
        px = camera.project(np.where(front[:, None], seen, 1.0))
        inside = front & (px >= 0.0).all(axis=1) & (px < size).all(axis=1)
        if len(xyz) and inside.mean() >= _SHARE:
            return True
    return False
