"""Runs services again on a recording: in one process, without a bus, at full speed.

Services run one after the other.  The output of one goes to the new recording, from which the next
one reads it.  So memory holds one message, and nothing depends on timing.
"""

import importlib
import time
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from functools import partial
from itertools import islice
from pathlib import Path
from threading import Event

from pliant.bus.replay_bus import ReplayBus
from pliant.config import Config
from pliant.datasets.calibration import calibration_from_yaml
from pliant.datasets.own_recording import recorded_frame
from pliant.datasets.recorded_images import RecordedImages
from pliant.datasets.rectifier import Rectifier, rectified
from pliant.errors import RecordingError
from pliant.messages import codec, topics
from pliant.messages.topics import Topic, by_key
from pliant.messages.types import CameraStream, Header, Image, StreamEnd
from pliant.recording.reader import Recording
from pliant.recording.summary import Summary
from pliant.recording.writer import RecordingWriter
from pliant_services.processes import PROCESSES, Process, outputs_of
from pliant_services.replay.ahead import Do, behind, quick_turns, read_ahead
from pliant_services.runtime.monitor import StatusMonitor


def replayable(names: Sequence[str]) -> tuple[Process, ...]:
    """The services in the order in which they read each other.  Raises RecordingError."""
    able = [p.name for p in PROCESSES if p.inputs and not p.observer]
    wrong = [name for name in names if name not in able]
    if wrong or not names:
        raise RecordingError(f"--services {','.join(names)}: choose from {', '.join(able)}")
    return tuple(process for process in PROCESSES if process.name in names)


def recorded_services(summary: Summary) -> list[str]:
    """Names of the services whose outputs the recording holds, but for the source."""
    return [
        p.name for p in PROCESSES if p.inputs and any(t.key in summary.topics for t in p.outputs)
    ]


def require_inputs(summary: Summary, services: Sequence[Process]) -> None:
    """Raise RecordingError if the recording lacks what services read of every frame."""
    needing = _lacking(summary, services, topics.IMAGE)
    if needing:
        raise RecordingError(
            f"{' and '.join(needing)} cannot be replayed: the recording is without "
            f"{topics.SOURCE.key} (made with --no-images?)"
        )
    made = _made_by(services)
    needed = {t: None for p in services for t in p.inputs if t.per_frame or t == topics.STREAM}
    for topic in [topic for topic in needed if topic not in made]:
        needing = _lacking(summary, services, topic)
        if needing:
            raise RecordingError(
                f"{' and '.join(needing)} cannot be replayed: the recording is without "
                f"{topic.key} (truncated, or one part of several? pass the folder of all parts)"
            )


def _made_by(services: Sequence[Process]) -> tuple[Topic, ...]:
    """The outputs of services: a replay of several makes them again, and does not read them."""
    return tuple(topic for process in services for topic in process.outputs)


def _lacking(summary: Summary, services: Sequence[Process], topic: Topic) -> list[str]:
    """Names of the services that read a topic, if the recording has nothing of it."""
    there = _recorded_as(topic).key in summary.topics
    return [] if there else [p.name for p in services if topic in p.inputs]


def _recorded_as(topic: Topic) -> Topic:
    """Rectified images are not recorded; they are made again from the source's."""
    return topics.SOURCE if topic == topics.IMAGE else topic


def gaps(summary: Summary, services: Sequence[Process]) -> list[str]:
    """Describe the missing inputs of the services."""
    read = {t for p in services for t in (*p.inputs, *p.optional)}.difference(_made_by(services))
    missing = {(key := _recorded_as(t).key): summary.missing_of(key) for t in read}
    return [
        f"{key} lacks {count} of its messages: the outputs will differ from those of the run"
        for key, count in sorted(missing.items())
        if count
    ]


class Replay:
    """One replay: from a recording into a new one."""

    def __init__(
        self, path: Path, summary: Summary, services: Sequence[Process], config: Config
    ) -> None:
        self._recorded = Recording(path)
        self._summary = summary
        self._services = services
        self._config = config
        self.made = _made_by(services)
        self.affected = affected(services)
        """Keys of the topics that are not taken over: they would be out of date."""

    def run(self, output: Path, metadata: Mapping[str, Mapping[str, str]]) -> None:
        """Write the new recording: what came before the services as it was, and what they make.

        Raises PliantError; KeyboardInterrupt leaves a recording that is closed and incomplete.
        """
        with RecordingWriter(output, metadata) as writer:
            for process in self._services:
                writer.sync()  # what was made so far is the input of this one
                made = Recording(output)
                inputs = {
                    topic: self.messages(topic, made if topic in self.made else self._recorded)
                    for topic in self._inputs_of(process)
                }
                first = process == self._services[0]  # it reads nothing of what is copied
                beside = partial(self._copy, writer) if first else None
                record(process, inputs, self._config, writer, beside)

    def messages(self, topic: Topic, recording: Recording | None = None) -> Iterator[Header]:
        """A topic as a service reads it; of a recording that was cut off, what all topics have."""
        if topic == topics.IMAGE:
            found = read_ahead(self._images())  # they take half as long as tracking
        else:
            found = (recording or self._recorded).decoded(topic)
        return islice(found, self._frames()) if topic.per_frame else found

    def _inputs_of(self, process: Process) -> tuple[Topic, ...]:
        """Its inputs: as in the run, and the outputs of other services of this replay."""
        recorded = self._summary.topics
        there = (t for t in process.optional if t in self.made or t.key in recorded)
        return (*process.inputs, *there)

    def _frames(self) -> int:
        """Numbers of the frames that all recorded inputs have."""
        wanted = {t for p in self._services for t in self._inputs_of(p) if t.per_frame}
        keys = {_recorded_as(topic).key for topic in wanted if topic not in self.made}
        found = self._summary.topics
        return min((found[key].messages if key in found else 0) for key in keys)

    def _images(self) -> Iterator[Image]:
        """The rectified images, made again from their bytes."""
        rectifier: Rectifier | None = None
        for stream in self._recorded.decoded(topics.STREAM):
            assert isinstance(stream, CameraStream)
            rectifier = Rectifier(calibration_from_yaml(stream.calibration))
        if rectifier is None:
            raise RecordingError("the recording has no camera: it stopped before its first frame")
        for source in RecordedImages(self._recorded):
            frame = recorded_frame(source)
            yield rectified(frame, rectifier, unmapped=source.unmapped, unplaced=source.unplaced)

    def _copy(self, writer: RecordingWriter, failed: Event) -> None:
        """The inputs of the recording, copied, so that the new one can be replayed."""
        copied(self._recorded, self._summary, self.affected, writer, failed.is_set)


def copied(
    recording: Recording,
    summary: Summary,
    stale: Container[str],
    writer: RecordingWriter,
    stopped: Callable[[], bool] = lambda: False,
) -> None:
    """Write all topics of a recording, with their ends, but for those with stale keys."""
    found = (by_key(key) for key in summary.topics if key not in stale)
    wanted = [topics.STREAM_END, *(topic for topic in found if topic is not None)]
    for message in recording.messages(*wanted):
        if stopped():  # failed, or interrupted
            return
        key = message.topic.key
        if message.topic == topics.STREAM_END:
            end = message.decode()
            assert isinstance(end, StreamEnd)
            key = end.topic
        if key not in stale:
            message.write_to(writer)


def run_on(
    process: Process,
    inputs: Mapping[Topic, Iterable[Header]],
    config: Config,
    on_publish: Callable[[Topic, Header], None],
) -> None:
    """Run a service on messages; ``on_publish`` is given what it makes."""
    bus = ReplayBus(inputs, through_codec=False, on_publish=on_publish)
    importlib.import_module(process.module).run(bus, config, StatusMonitor(bus, process.name))


def record(
    process: Process,
    inputs: Mapping[Topic, Iterable[Header]],
    config: Config,
    writer: RecordingWriter,
    beside: Callable[[Event], None] | None = None,
) -> None:
    """Run a service on messages; its output is recorded, numbered and closed as on the bus.

    beside: run by the writing thread before it writes, and notified if the service has failed.
    """
    failed = Event()
    with quick_turns(), behind() as do:
        if beside is not None:
            do(partial(beside, failed))
        sink = _Sink(writer, outputs_of(process.name), do)
        complete = False
        try:
            run_on(process, inputs, config, sink.publish)
            complete = True
        finally:
            if not complete:
                failed.set()
            sink.end(complete=complete)


class _Sink:
    """Writes what a service publishes, numbered as on the bus."""

    def __init__(self, writer: RecordingWriter, outputs: Iterable[Topic], do: Do) -> None:
        self._writer = writer
        self._do = do
        self._sent = dict.fromkeys(outputs, 0)

    def publish(self, topic: Topic, message: Header) -> None:
        self._write(topic, topic, message)

    def end(self, *, complete: bool) -> None:
        for topic, sent in list(self._sent.items()):
            closing = StreamEnd(
                frame=sent, stamp_ns=0, frame_id="",
                topic=topic.key, messages=sent, complete=complete,
            )  # fmt: skip
            self._write(topic, topics.STREAM_END, closing)

    def _write(self, of: Topic, topic: Topic, message: Header) -> None:
        write = partial(
            self._writer.write,
            topic,
            codec.encode(message),  # now: the service may go on with the arrays
            sequence=self._sent[of],
            log_time_ns=time.time_ns(),
            publish_time_ns=message.stamp_ns,
        )
        self._do(write)
        self._sent[of] += 1


def affected(services: Sequence[Process]) -> set[str]:
    """Topics of the services, and of all that read what these make: they would be out of date."""
    stale: set[Topic] = set()
    affected: set[str] = set()
    for process in PROCESSES:  # in the order in which they read each other
        if process in services or stale & {*process.inputs, *process.optional}:
            stale |= set(process.outputs)
            affected |= {topic.key for topic in outputs_of(process.name)}
    return affected
