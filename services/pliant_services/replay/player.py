"""Plays a recording on the bus: to viewers and services it is the run that was recorded.

Each service of the run is impersonated by a bus of its own, with its name, sequence numbers, ends
and flow control.  Rectified images are not recorded; they are made again from the source's.
"""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace

from pliant.bus.base import Window
from pliant.bus.session import Identity
from pliant.bus.zenoh_bus import ZenohBus
from pliant.datasets.calibration import calibration_from_yaml
from pliant.datasets.own_recording import recorded_frame
from pliant.datasets.recorded_images import RecordedImages
from pliant.datasets.rectifier import Rectifier, rectified
from pliant.errors import RecordingError
from pliant.messages import codec, topics
from pliant.messages.topics import Topic
from pliant.messages.types import CameraStream, SourceImage, StreamEnd
from pliant.recording.playback import Playback
from pliant.recording.reader import Recorded, Recording
from pliant_services.processes import BY_NAME, PROCESSES, outputs_of


@dataclass(frozen=True, kw_only=True)
class Played:
    """The recording that is played.

    start_s, end_s: seconds of capture time.     lead_frames: map updates before the start, by
    which viewers learn the map.     topics: keys of those that are played, all if empty.
    readers: services that must get every message of what they read; what they publish is theirs.
    """

    start_s: float = 0.0
    end_s: float | None = None
    lead_frames: int = 0
    topics: Collection[str] = ()
    readers: Mapping[Topic, Sequence[str]]
    left_out: Collection[Topic] = ()


def senders(played: Collection[Topic]) -> dict[Topic, str]:
    """Which service published each topic."""
    found: dict[Topic, str] = {}
    for topic in sorted(played, key=lambda topic: topic.key):
        parent, _, service = topic.key.partition("/")
        makers = [p.name for p in PROCESSES if topic in outputs_of(p.name)]
        found[topic] = makers[0] if makers else service if parent == "status" else "player"
    return found


def chosen_topics(playback: Playback, what: Played) -> list[Topic]:
    """The topics that are played, in order of their keys.  Raises RecordingError."""
    there = set(playback.topics)
    if topics.SOURCE in there:
        there.add(topics.IMAGE)
    there -= {topics.CLIP, *what.left_out}  # images are played with their pixels
    unknown = sorted(set(what.topics) - {topic.key for topic in there})
    if unknown:
        keys = ", ".join(sorted(topic.key for topic in there))
        raise RecordingError(f"--topics {','.join(unknown)}: choose from {keys}")
    chosen = [topic for topic in there if not what.topics or topic.key in what.topics]
    return sorted(chosen, key=lambda topic: topic.key)


def play(
    playback: Playback,
    what: Played,
    *,
    endpoints: Sequence[str],
    session: str,
    window: int,
    windows: Mapping[str, Window],
    wait_until: Callable[[int], bool],
    again: Callable[[int], bool] | None = None,
    identity: Callable[[str], Identity | None] = lambda name: None,
) -> int:
    """Publish the recording, and its ends; returns the number of messages.

    wait_until: called with each message's capture time in nanoseconds from the start; returns when
    it is due, and False to stop.
    again: called with the number of published messages after each pass; returns whether to publish
    all once more in the same session.  None: once.
    identity: the certificate of an impersonated service, for tls/ endpoints.

    Raises RecordingError and BusError.
    """
    chosen = chosen_topics(playback, what)
    by_sender: dict[str, list[Topic]] = {}
    for topic, sender in senders(chosen).items():
        by_sender.setdefault(sender, []).append(topic)
    with ExitStack() as stack:
        buses: dict[str, ZenohBus] = {}
        for sender, outputs in sorted(by_sender.items()):
            if what.readers and sender in BY_NAME:  # who reads it waits for the end of each
                more = set(outputs_of(sender)) - {*outputs, *what.left_out}
                outputs += sorted(more, key=lambda topic: topic.key)
            bus = ZenohBus(
                endpoints=endpoints,
                session=session,
                service=sender,
                inputs={},
                outputs={topic: what.readers.get(topic, ()) for topic in outputs},
                window=window,
                windows=windows,
                identity=identity(sender),
            )
            stack.enter_context(bus)
            buses |= dict.fromkeys((topic.key for topic in outputs), bus)
        if again is None:
            return _publish(playback, what, chosen, buses, wait_until, closes=True)
        count = _publish(playback, what, chosen, buses, wait_until, closes=False)
        while again(count):
            count = _publish(playback, what, chosen, buses, wait_until, closes=False)
        for bus in dict.fromkeys(buses.values()):
            bus.end_all(complete=False)
        return count


def _publish(
    playback: Playback,
    what: Played,
    chosen: Sequence[Topic],
    buses: Mapping[str, ZenohBus],
    wait_until: Callable[[int], bool],
    *,
    closes: bool,
) -> int:
    """closes: topics are ended where they were, once and for all."""
    images = _Images(topics.IMAGE in chosen)
    count = 0
    complete = True
    start_ns = playback.first_ns + int(what.start_s * 1e9)
    for message in _read(playback, what, chosen):
        if message.topic == topics.STREAM_END:
            end = message.decode()
            assert isinstance(end, StreamEnd)
            if closes and end.topic in buses:
                buses[end.topic].end(_topic(chosen, end.topic), complete=end.complete)
            continue
        if message.topic.per_frame and not wait_until(message.publish_time_ns - start_ns):
            complete = False
            break
        if message.topic in chosen:
            buses[message.topic.key].publish_encoded(message.topic, message.data)
            count += 1
        count += images.follow(message, buses)
    if closes:
        for bus in dict.fromkeys(buses.values()):
            bus.end_all(complete=complete)
    return count


def _read(playback: Playback, what: Played, chosen: Sequence[Topic]) -> Iterator[Recorded]:
    wanted = set(chosen) - {topics.IMAGE}
    if topics.IMAGE in chosen:
        wanted |= {topics.SOURCE, topics.STREAM}
    images = RecordedImages(Recording(playback.path))
    for message in playback.messages(
        wanted & playback.topics,
        start_s=what.start_s,
        end_s=what.end_s,
        lead_frames=what.lead_frames,
    ):
        if message.topic == topics.SOURCE:
            image = message.decode()
            assert isinstance(image, SourceImage)
            if image.clip_frame >= 0:
                message = replace(message, data=codec.encode(images.whole(image)))
        yield message


def _topic(chosen: Sequence[Topic], key: str) -> Topic:
    return next(topic for topic in chosen if topic.key == key)


class _Images:
    """Publishes the rectified image of each source image that passes."""

    def __init__(self, wanted: bool) -> None:
        self._wanted = wanted
        self._rectifier: Rectifier | None = None

    def follow(self, message: Recorded, buses: Mapping[str, ZenohBus]) -> int:
        if not self._wanted or message.topic not in (topics.STREAM, topics.SOURCE):
            return 0
        decoded = message.decode()
        if isinstance(decoded, CameraStream):
            self._rectifier = Rectifier(calibration_from_yaml(decoded.calibration))
        if not isinstance(decoded, SourceImage) or self._rectifier is None:
            return 0
        frame = recorded_frame(decoded)
        image = rectified(
            frame, self._rectifier, unmapped=decoded.unmapped, unplaced=decoded.unplaced
        )
        buses[topics.IMAGE.key].publish(topics.IMAGE, image)
        return 1
