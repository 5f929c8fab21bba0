"""A recording read as one run: its frames, map, mesh and services."""

from collections import defaultdict
from collections.abc import Container, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from pliant.algorithms.arrays import F32, F64, I64
from pliant.algorithms.map_delta import MapDelta
from pliant.map_history import MapHistory
from pliant.messages import topics
from pliant.messages.topics import by_key
from pliant.messages.types import (
    CAPTURED,
    PASSED_OVER,
    REPORTED,
    CameraStream,
    Extrema,
    Keyframe,
    MapKeyframe,
    MapUpdate,
    MeshPiece,
    Status,
    StreamEnd,
)
from pliant.recording.reader import Recording
from pliant.recording.summary import Summary
from pliant.results.known_scale import MetricRecording, Scale

_LEFT_ALONE = (
    *(topics.SOURCE, topics.DEPTH, topics.KEYFRAME, topics.KEYFRAME_FINAL, topics.MESH_BLOCKS),
    *(topics.CLIP, topics.IMU, topics.GPS),
    topics.MAP_KEPT,  # it becomes a file of its own
    topics.MAP_KNOWN,  # see known_keyframes
    topics.SURFELS,  # see surfels.py
)
"""Topics that results do not need; most bytes are theirs."""


@dataclass
class Run:
    """The run of a recording: its map, statuses and metadata."""

    history: MapHistory = field(default_factory=MapHistory)
    stream: CameraStream | None = None
    tracks: dict[int, int] = field(default_factory=dict[int, int])
    missing: dict[int, str] = field(default_factory=dict[int, str])
    passed_over: list[int] = field(default_factory=list[int])
    inliers: dict[int, int] = field(default_factory=dict[int, int])
    map_points: dict[int, int] = field(default_factory=dict[int, int])
    seconds: dict[str, dict[str, list[float]]] = field(
        default_factory=lambda: defaultdict(lambda: defaultdict(list))
    )
    counters: dict[str, dict[str, float]] = field(default_factory=dict[str, dict[str, float]])
    cpu_seconds: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    captured_s: dict[int, float] = field(default_factory=dict[int, float])
    mapped_s: dict[int, float] = field(default_factory=dict[int, float])
    source_failure: str = ""
    corrections: dict[int, tuple[float, ...]] = field(default_factory=dict[int, tuple[float, ...]])
    calibration_sigmas: tuple[float, ...] = ()
    log_focals: dict[int, float] = field(default_factory=dict[int, float])
    mesh: list[MeshPiece] = field(default_factory=list[MeshPiece])
    ends: dict[str, StreamEnd] = field(default_factory=dict[str, StreamEnd])
    arrivals_ns: list[int] = field(default_factory=list[int])
    recorded: Summary = field(default_factory=Summary)
    known_segments: set[int] = field(default_factory=set[int])
    scale: Scale | None = None
    inertial_refusal: str = ""
    """Why inertial samples do not determine the scale."""
    gps_refusal: str = ""
    """Why satellite fixes do not determine it."""

    def correction_of(self, segment: int) -> tuple[float, ...]:
        """The error of the calibration by its last adjustment; () without one."""
        return self.corrections.get(segment, ())

    @property
    def calibration_correction(self) -> tuple[float, ...]:
        """The correction of the last segment with one, which includes the earlier ones."""
        return self.corrections[max(self.corrections)] if self.corrections else ()

    def take_calibration(self, update: MapDelta) -> None:
        """Take the calibration of a map update."""
        for gone, _ in update.joined.tolist():
            self.corrections.pop(gone, None)
        if update.calibration_correction:
            self.corrections[update.segment] = update.calibration_correction
            self.calibration_sigmas = update.calibration_sigmas
        if len(update.focal_keyframes):  # of all keyframes: zeros where an earlier change was none
            focal = zip(update.focal_keyframes.tolist(), update.log_focals.tolist(), strict=True)
            self.log_focals = dict(focal)

    @property
    def focal_range(self) -> tuple[float, float] | None:
        """The least and the greatest focal length, in units of the calibration that was found, but
        for a twentieth of the keyframes at each end; None if it does not change."""
        if not any(self.log_focals.values()):
            return None
        low, high = np.exp(np.percentile([*self.log_focals.values()], (5.0, 95.0))).tolist()
        return low, high

    @property
    def scale_is_metric(self) -> bool:
        """Whether lengths of the longest segment are metres: measured, or those of a known map."""
        if self.stream is None or not self.stream.scale_is_metric:
            return False
        return self.scale is not None or self.history.longest_segment() in self.known_segments

    @property
    def z_is_up(self) -> bool:
        """Whether z points against gravity: measured, or in a known map."""
        return self.scale_is_metric and self.stream is not None and self.stream.z_is_up

    @property
    def frames_per_second(self) -> float:
        """Rate at which map updates reached the recorder."""
        if len(self.arrivals_ns) < 2 or self.arrivals_ns[-1] <= self.arrivals_ns[0]:
            return 0.0
        return (len(self.arrivals_ns) - 1) * 1e9 / (self.arrivals_ns[-1] - self.arrivals_ns[0])

    @property
    def image_ages_ms(self) -> F64:
        """Ages of live images when their poses were published."""
        frames = [frame for frame in self.history.online if frame in self.captured_s]
        ages_s = [self.mapped_s[f] - self.captured_s[f] for f in frames if f in self.mapped_s]
        return 1e3 * np.array(ages_s, np.float64)

    @property
    def complete(self) -> bool:
        """Whether every topic was closed at the end of its source, not by an interruption.

        A topic of every frame without an end is that of a recording that was cut off itself.
        """
        framed = {key for key in self.recorded.topics if (by_key(key) or topics.STREAM).per_frame}
        whole = bool(self.ends) and framed <= self.ends.keys()
        return whole and all(end.complete for end in self.ends.values())


def read_run(path: Path, scale: Scale | None = None) -> Run:
    """Fold a recording, in metres where the scale is known.  scale: None: that beside it.

    Raises RecordingError for a file that is none.
    """
    recording = MetricRecording(path, scale)
    run = Run(scale=recording.scale)
    run.recorded.metadata = recording.metadata()
    for keyframe in known_keyframes(recording):
        run.history.know(keyframe)
        run.known_segments.add(keyframe.segment)
    for recorded in recording.messages():
        run.recorded.count(recorded)
        if recorded.topic in _LEFT_ALONE:
            continue
        message = recorded.decode()
        if isinstance(message, CameraStream):
            run.stream = message
        elif isinstance(message, Extrema):
            run.tracks[message.frame] = len(message.ids)
            if message.missing:
                run.missing[message.frame] = message.missing
        elif isinstance(message, MapUpdate):
            final = recorded.topic.key == topics.MAP_FINAL.key
            run.history.apply(message, frame=message.frame, stamp_ns=message.stamp_ns, final=final)
            run.take_calibration(message)
            if not final:
                run.inliers[message.frame] = message.inliers
                if message.reason == PASSED_OVER:
                    run.passed_over.append(message.frame)
                run.arrivals_ns.append(recorded.log_time_ns)
        elif isinstance(message, MeshPiece):
            run.mesh.append(message)
        elif isinstance(message, Status):
            _take_status(run, message)
        elif isinstance(message, StreamEnd):
            run.ends[message.topic] = message
    return run


def known_keyframes(recording: Recording) -> Iterator[MapKeyframe]:
    """The loaded map with which a run began: read before all else, because only the messages of
    one topic are in order."""
    for keyframe in recording.decoded(topics.MAP_KNOWN):
        assert isinstance(keyframe, MapKeyframe)
        yield keyframe


@dataclass(kw_only=True)
class SeenKeyframe:
    """The latest image and observations of a keyframe.

    jpeg: b"" without a recorded image.   mask: of that image; b"": the whole image is used.
    point_ids: (N,).   points_px: (N, 2).
    """

    jpeg: bytes = b""
    mask: bytes = b""
    point_ids: I64 = field(default_factory=lambda: np.zeros(0, np.int64))
    points_px: F32 = field(default_factory=lambda: np.zeros((0, 2), np.float32))


def seen_by_keyframes(recording: Recording, wanted: Container[int]) -> dict[int, SeenKeyframe]:
    """Return those of the wanted keyframes that a recording has, by id."""
    seen: dict[int, SeenKeyframe] = defaultdict(SeenKeyframe)
    for topic in (topics.KEYFRAME, topics.KEYFRAME_FINAL):
        for message in recording.decoded(topic):
            assert isinstance(message, Keyframe)
            masks = message.masks()
            for number, jpeg in message.images().items():
                if number in wanted:
                    seen[number].jpeg, seen[number].mask = jpeg, masks.get(number, b"")
            ends = np.cumsum(message.counts)
            for row, number in enumerate(message.keyframe_ids.tolist()):
                if number in wanted:
                    part = slice(int(ends[row] - message.counts[row]), int(ends[row]))
                    seen[number].point_ids = message.point_ids[part]
                    seen[number].points_px = message.points_px[part]
    return dict(seen)


def _take_status(run: Run, status: Status) -> None:
    for stage, seconds in zip(status.stages, status.seconds.tolist(), strict=True):
        run.seconds[status.service][stage].append(seconds)
    values = dict(zip(status.counters, status.values.tolist(), strict=True))
    captured_s, reported_s = values.pop(CAPTURED, None), values.pop(REPORTED, None)
    if captured_s is not None:
        run.captured_s[status.frame] = captured_s
    if status.service == "bundle_adjustment" and reported_s is not None:
        run.mapped_s.setdefault(status.frame, reported_s)  # the last frame has one more, of the end
    if "cpu_seconds" in values:
        run.cpu_seconds[status.service].append(values["cpu_seconds"])
    run.counters[status.service] = {**run.counters.get(status.service, {}), **values}
    if status.service == "ingest" and status.note:
        run.source_failure = status.note
    if status.service == "bundle_adjustment" and "points" in values:
        run.map_points[status.frame] = int(values["points"])


def folded_map(path: Path) -> MapHistory:
    """The map of a recording alone, in metres where the scale is known."""
    recording, history = MetricRecording(path), MapHistory()
    for keyframe in known_keyframes(recording):
        history.know(keyframe)
    for topic in (topics.MAP_UPDATE, topics.MAP_FINAL):
        for update in recording.decoded(topic):
            assert isinstance(update, MapUpdate)
            final = topic == topics.MAP_FINAL
            history.apply(update, frame=update.frame, stamp_ns=update.stamp_ns, final=final)
    return history
