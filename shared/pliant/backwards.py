"""Reads a source backwards where its map was lost, and extends the map to earlier frames.

Tracking is usually lost on the way from a mapped place into a difficult stretch.  Backwards, the
camera enters this stretch from mapped frames: so frames before the first one of a map, or between
two segments, are mapped from later ones, and segments that see the same place are merged.
"""

from collections.abc import Iterator, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from pliant.algorithms.arrays import F32, I64
from pliant.algorithms.geometry import pose_to_matrix
from pliant.algorithms.image.masks import clearance_in, filled
from pliant.algorithms.inertial.samples import ImuSamples
from pliant.algorithms.map_delta import KeyframeDelta, MapDelta
from pliant.algorithms.slam.adjust.inertial_adjustment import CouplingOutcome
from pliant.algorithms.slam.adjust.segment import PlacedFrames
from pliant.algorithms.slam.calibration.self_calibration import widened
from pliant.algorithms.slam.frame import Frame
from pliant.algorithms.slam.map.kept_keyframe import KeptKeyframe
from pliant.algorithms.slam.mapper import Mapper
from pliant.algorithms.tracking.tracker import ExtremaTracker
from pliant.config import Config
from pliant.datasets.base import Dataset, SourceFrame
from pliant.datasets.rectifier import Rectifier, rectified
from pliant.errors import DatasetError
from pliant.map_history import MIN_INLIERS, MapHistory
from pliant.messages.types import Image

_LEAD_S, _LEAD_FRAMES = 1.0, 5
"""So much of what has poses is read on both sides of what has none: it takes a few keyframes to
find the way into the map, and to prove that two segments are one."""

_HELD_BYTES = 256 << 20
"""Images that are held at a time: a source cannot be read backwards, so that it is read once, up to
them, for each lot."""

_JPEG_QUALITY = 95
"""As that of other keyframes."""


@dataclass(frozen=True)
class Stretch:
    """Frames that are read backwards, from the last to the first."""

    first: int
    last: int


def lost_stretches(segments: Mapping[int, int], stamps_ns: Mapping[int, int]) -> list[Stretch]:
    """Where frames have no pose before one that has, or segments follow each other; latest first.

    segments: of the frames that have a pose.   stamps_ns: of all frames, which count from 0.
    """
    found: list[Stretch] = []
    end = len(stamps_ns)
    while end > 0:
        end -= 1
        here = segments.get(end)
        if here is None or end == 0 or segments.get(end - 1) == here:
            continue
        before = next((f for f in range(end - 1, -1, -1) if f in segments), -1)
        last = _beside(end, 1, segments, stamps_ns)
        first = 0 if before < 0 else _beside(before, -1, segments, stamps_ns)
        if found and last >= found[-1].first:
            found[-1] = Stretch(first, found[-1].last)
        else:
            found.append(Stretch(first, last))
    return found


def _beside(
    frame: int, step: int, segments: Mapping[int, int], stamps_ns: Mapping[int, int]
) -> int:
    """The last frame of those about one that follow it or go before it in its segment."""
    at, count = frame, 0
    while segments.get(at + step) == segments[frame]:
        away_s = 1e-9 * abs(stamps_ns[at + step] - stamps_ns[frame])
        count += 1
        if away_s > _LEAD_S and count > _LEAD_FRAMES:
            break
        at += step
    return at


@dataclass(kw_only=True)
class MadeKeyframe:
    """A keyframe that was made: its image, a JPEG, the mask of that, the points
    (N,) that it sees, by id, and where (N, 2) in the rectified image."""

    jpeg: bytes = b""
    mask: bytes = b""
    point_ids: I64 = field(default_factory=lambda: np.zeros(0, np.int64))
    points_px: F32 = field(default_factory=lambda: np.zeros((0, 2), np.float32))


@dataclass(kw_only=True)
class Reached:
    """The result of reading backwards, besides the history.

    kept: the whole map.   keyframes: new ones, by id.   joined: merged segments.
    last: the last update, with the calibration.   counters: of a mapper, what samples did.
    """

    kept: list[KeptKeyframe] = field(default_factory=list[KeptKeyframe])
    keyframes: dict[int, MadeKeyframe] = field(default_factory=dict[int, MadeKeyframe])
    joined: list[tuple[int, int]] = field(default_factory=list[tuple[int, int]])
    last: MapDelta | None = None
    counters: dict[str, float] = field(default_factory=dict[str, float])


def reach_back(
    dataset: Dataset,
    config: Config,
    known: Sequence[KeptKeyframe],
    stretches: Sequence[Stretch],
    history: MapHistory,
    samples: ImuSamples | None = None,
) -> Reached:
    """Read stretches of a source backwards, from which a map was made.

    known: that map.   history: of it, which becomes that of both: frames that have a pose keep it
    but for what moves the map.   samples: inertial, with which keyframes of both passes shall
    agree.   Raises DatasetError if the source has changed.
    """
    rectifier = Rectifier(dataset.calibration)
    camera = rectifier.camera
    parameters = widened(config.bundle_adjustment, dataset.calibration.focal_sigma)
    tracker = ExtremaTracker(camera.width, camera.height, config.tracking, config.seed)
    mapper = Mapper(camera, parameters, config.seed, known=[_reversed(each) for each in known])
    numbers = [n for each in stretches for n in range(each.last, each.first - 1, -1)]
    room = max(1, _HELD_BYTES // (4 * camera.width * camera.height))
    first_ns, found = history.stamps_ns[numbers[0]], Reached()
    collected = _Collected(history, numbers, found)
    for number, source in enumerate(_backwards(dataset, numbers, room)):
        if source.stamp_ns != history.stamps_ns[source.index]:
            raise DatasetError(f"{dataset.name}: has changed since the first pass")
        image = rectified(source, rectifier)
        if image.missing:
            collected.take(mapper.skip(number))
            continue
        stamp_ns, clearance = first_ns - image.stamp_ns, clearance_in(image.mask)
        tracks = tracker.track(image.grey, stamp_ns, clearance=clearance)
        colour = image.colour if image.colour.size else None
        grey = filled(image.grey, clearance)
        collected.take(mapper.process(Frame(number, stamp_ns, tracks, grey, colour)))
        collected.take_keyframes(mapper.publish_keyframes(), number, image, mapper.waiting_frames)
    collected.take(mapper.finish())
    collected.take_keyframes(mapper.publish_keyframes())
    if samples is not None and len(samples.stamps_ns):
        # Samples need the frames of both passes, relative to keyframes that are nearly final.
        with_samples = deepcopy(mapper)
        with_samples.add_samples(samples)
        delta = with_samples.finish(placed=collected.placed())
        found.counters = with_samples.counters
        if found.counters.get("coupling_outcome") == CouplingOutcome.MOVED:
            mapper = with_samples
            collected.take(delta)
            collected.take_keyframes(mapper.publish_keyframes())
    session = max(each.session for each in known)
    for each in map(_reversed, mapper.kept()):
        if each.session > session:  # it is of the same session as the first pass
            each = replace(each, session=session, source_frame=numbers[each.source_frame])
        found.kept.append(each)
    return found


class _Collected:
    """Collects the output of a mapper for frames that are numbered in reading order."""

    def __init__(self, history: MapHistory, numbers: Sequence[int], found: Reached) -> None:
        self._history, self._numbers, self._found = history, np.array(numbers, np.int64), found
        self._placed = np.array(sorted(history.final()), np.int64)
        self._keyframes = {keyframe.frame for keyframe in history.keyframes.values()}
        self._images: dict[int, tuple[bytes, bytes]] = {}
        self._made: dict[int, int] = {}

    def take(self, delta: MapDelta) -> None:
        """Take in an update."""
        history, frames = self._history, delta.keyframe_frames.copy()
        for row, (number, frame) in enumerate(
            zip(delta.keyframe_ids.tolist(), frames.tolist(), strict=True)
        ):
            if frame >= 0:
                self._made[number] = frame
                # Of two keyframes of one frame the first counts.
                made = int(self._numbers[frame])
                frames[row] = -1 if made in self._keyframes else made
            elif number in history.keyframes:
                frames[row] = history.keyframes[number].frame
        posed = self._numbers[delta.pose_frames]
        new = ~np.isin(posed, self._placed)
        delta = replace(
            delta, keyframe_frames=frames, pose_frames=posed[new],
            pose_segments=delta.pose_segments[new], pose_keyframes=delta.pose_keyframes[new],
            poses_keyframe_camera=delta.poses_keyframe_camera[new],
            pose_inliers=delta.pose_inliers[new],
        )  # fmt: skip
        history.apply(delta, frame=int(self._numbers[0]), stamp_ns=0, final=True)
        self._found.joined += [(gone, to) for gone, to in delta.joined.tolist()]
        self._found.last = delta

    def placed(self) -> PlacedFrames:
        """Frames with a pose, and the capture times of keyframes, of both passes."""
        history = self._history
        stamps_ns, keyframes = history.stamps_ns, history.keyframes
        own = {n: keyframe.frame for n, keyframe in keyframes.items() if keyframe.frame >= 0}
        own |= {n: int(self._numbers[read]) for n, read in self._made.items()}
        frames = sorted(
            (stamps_ns[frame], pose.keyframe, pose.pose_keyframe_camera)
            for frame, pose in history.frames.items()
            if pose.inliers >= MIN_INLIERS and pose.keyframe in keyframes
        )
        return PlacedFrames(
            keyframes_ns={n: stamps_ns[frame] for n, frame in own.items()},
            stamps_ns=np.array([stamp_ns for stamp_ns, _, _ in frames], np.int64),
            hosts=np.array([host for _, host, _ in frames], np.int64),
            T_host_frame=pose_to_matrix(np.array([pose for *_, pose in frames]).reshape(-1, 7)),
        )

    def take_keyframes(
        self,
        delta: KeyframeDelta,
        number: int = -1,
        image: Image | None = None,
        waiting: Sequence[int] = (),
    ) -> None:
        """Take the keyframe changes after a frame.   waiting: frames for a later start."""
        if image is not None:
            self._images[number] = _as_jpeg(image)
        made = {frame: keyframe for keyframe, frame in self._made.items()}
        for frame in [frame for frame in self._images if frame in made]:
            seen = self._found.keyframes.setdefault(made[frame], MadeKeyframe())
            seen.jpeg, seen.mask = self._images.pop(frame)
        self._images = {f: kept for f, kept in self._images.items() if f in waiting}
        ends = np.cumsum(delta.counts)
        for row, keyframe in enumerate(delta.keyframe_ids.tolist()):
            collected = slice(int(ends[row] - delta.counts[row]), int(ends[row]))
            seen = self._found.keyframes.setdefault(keyframe, MadeKeyframe())
            seen.point_ids, seen.points_px = delta.point_ids[collected], delta.points_px[collected]


def final_update(before: MapHistory, after: MapHistory, last: MapDelta) -> MapDelta:
    """Return the update that turns one history into another: its content, and its removals.

    last: has the calibration and the merged segments.
    """
    frames, keyframes, points = after.frames, after.keyframes, after.points()
    poses = [pose.pose_keyframe_camera for pose in frames.values()]
    correction = enumerate(last.calibration_correction)
    return replace(
        last,
        pose_frames=np.array(list(frames), np.int64),
        pose_segments=np.array([pose.segment for pose in frames.values()], np.int32),
        pose_keyframes=np.array([pose.keyframe for pose in frames.values()], np.int64),
        poses_keyframe_camera=np.array(poses).reshape(-1, 7),
        pose_inliers=np.array([pose.inliers for pose in frames.values()], np.int32),
        keyframe_ids=np.array(list(keyframes), np.int64),
        keyframe_frames=np.array([k.frame for k in keyframes.values()], np.int64),
        keyframe_segments=np.array([k.segment for k in keyframes.values()], np.int32),
        keyframe_poses=np.array([k.pose_world_camera for k in keyframes.values()]).reshape(-1, 7),
        point_ids=points.ids,
        point_segments=points.segments,
        points_world=points.positions,
        point_colours=points.colours,
        point_keyframes=points.keyframes,
        point_parallax_rad=points.parallax_rad,
        point_sigmas=points.sigmas,
        point_hosts=points.hosts,
        removed_point_ids=np.setdiff1d(before.points().ids, points.ids),
        moved_keyframes=np.zeros(0, np.int64),
        moves=np.zeros((0, 8)),
        same_places=np.array(after.same_places, np.int64).reshape(-1, 2),
        calibration_correction=tuple(-q if n == 3 else q for n, q in correction),
        snapshot=True,
    )


def _as_jpeg(image: Image) -> tuple[bytes, bytes]:
    pixels = image.colour[..., ::-1] if image.colour.size else image.grey
    quality = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
    return cv2.imencode(".jpg", pixels, quality)[1].tobytes(), image.mask


def _backwards(dataset: Dataset, numbers: Sequence[int], room: int) -> Iterator[SourceFrame]:
    """Frames by their numbers, which descend, ``room`` of them held at a time.

    Raises DatasetError if the source does not have them any more.
    """
    for begin in range(0, len(numbers), room):
        some = numbers[begin : begin + room]
        wanted, found = set(some), dict[int, SourceFrame]()
        for source in dataset:
            if source.index in wanted:
                found[source.index] = source
            if source.index >= some[0]:
                break
        if len(found) < len(some):
            raise DatasetError(f"{dataset.name}: has fewer frames than in the first pass")
        yield from (found[number] for number in some)


def _reversed(kept: KeptKeyframe) -> KeptKeyframe:
    """As a camera has it whose time runs backwards: it moves the other way, and the rows of its
    rolling shutter follow each other the other way."""
    correction = kept.correction.copy()
    correction[3] = -correction[3]
    return replace(kept, correction=correction, motion=-kept.motion)
