"""A recording in the order in which it was made, from any moment on."""

from collections.abc import Collection, Iterator, Sequence
from pathlib import Path

from pliant.errors import RecordingError
from pliant.messages import topics
from pliant.messages.topics import Topic
from pliant.messages.types import StreamEnd
from pliant.recording.chunk_index import Index, IndexedChunk
from pliant.recording.reader import Recorded

_MARGIN_NS = 200_000_000
"""Messages that are published at one time are recorded within this."""


class Playback:
    """Messages by their place in time: seconds of capture time since the first frame."""

    def __init__(self, path: Path) -> None:
        """Raises RecordingError if there is no recording that was closed, with frames in it."""
        self.path = path
        self._index = Index(path)
        framed = [topic for topic in self._index.topics if topic.per_frame]
        if not framed:
            raise RecordingError(f"{path}: no frames in it")
        # The source comes first of all; without images the tracks do.
        order = {topics.SOURCE: -2, topics.EXTREMA: -1}
        self._clock = min(framed, key=lambda topic: (order.get(topic, 0), topic.key))
        self._clock_chunks = self._index.with_topic(self._clock)
        self.first_ns = self._first(self._clock_chunks[0]).publish_time_ns

    @property
    def topics(self) -> frozenset[Topic]:
        """Topics that have messages, without their ends."""
        return self._index.topics - {topics.STREAM_END}

    def messages(
        self,
        wanted: Collection[Topic],
        *,
        start_s: float = 0.0,
        end_s: float | None = None,
        lead_frames: int = 0,
    ) -> Iterator[Recorded]:
        """Yield the recorded messages of these topics, from the first frame at ``start_s`` to
        ``end_s``.

        Every per-frame topic begins with the same frame, but map updates ``lead_frames`` before it,
        so that a new reader gets the map.  The camera always comes first.  Ends of topics are as
        recorded, if nothing is cut off.  Messages after the last frame (map/final) belong to the
        whole and are only part of it.
        Raises RecordingError at damage and if no message is left.
        """
        opening = self._opening(wanted)
        yield from opening
        others = sorted(set(wanted) - {topics.STREAM}, key=lambda topic: topic.key)
        if start_s <= 0.0:
            frame, from_ns, lead_frames = 0, 0, 0
        else:
            target = self.first_ns + int(start_s * 1e9)
            first = self._at(target)
            frame = first.decode().frame
            from_ns = first.log_time_ns - _MARGIN_NS
            if lead_frames and topics.MAP_UPDATE in others:
                yield from self._lead(first, frame, lead_frames)
        last_ns = None if end_s is None else self.first_ns + int(end_s * 1e9)
        yield from self._rest(others, from_ns, frame, last_ns)

    def _rest(
        self, wanted: Sequence[Topic], from_ns: int, frame: int, last_ns: int | None
    ) -> Iterator[Recorded]:
        going_on = {topic for topic in wanted if topic.per_frame and topic in self.topics}
        keys = {topic.key for topic in wanted}
        for message in self._index.messages([*wanted, topics.STREAM_END], from_ns=from_ns):
            if message.topic == topics.STREAM_END:
                end = message.decode()
                assert isinstance(end, StreamEnd)
                if end.topic in keys and last_ns is None:
                    yield message
                continue
            late = last_ns is not None and message.publish_time_ns > last_ns
            if message.topic == topics.MAP_FINAL and last_ns is not None:
                continue
            if not message.topic.per_frame:
                if not late and (frame == 0 or message.decode().frame >= frame):
                    yield message
                continue
            if late:
                going_on.discard(message.topic)
                if not going_on:
                    return
                continue
            if frame == 0 or message.decode().frame >= frame:
                yield message

    def _opening(self, wanted: Collection[Topic]) -> list[Recorded]:
        """The camera and the end of its topic."""
        if topics.STREAM not in wanted or topics.STREAM not in self._index.topics:
            return []
        chunks = self._index.with_topic(topics.STREAM)[:1]
        opening = list(self._index.messages([topics.STREAM], chunks=chunks))
        for message in self._index.messages([topics.STREAM_END]):
            end = message.decode()
            assert isinstance(end, StreamEnd)
            if end.topic == topics.STREAM.key:
                return [*opening, message]
        return opening

    def _lead(self, first: Recorded, frame: int, lead_frames: int) -> Iterator[Recorded]:
        """Map updates of the frames before ``frame``."""
        before = frame - lead_frames
        chunks = self._index.with_topic(topics.MAP_UPDATE)
        number = next(
            (n for n, chunk in enumerate(chunks) if chunk.end_ns >= first.log_time_ns), len(chunks)
        )
        while number > 0 and self._first_frame(chunks[number - 1], topics.MAP_UPDATE) > before:
            number -= 1
        for message in self._index.messages(
            [topics.MAP_UPDATE], chunks=chunks[max(0, number - 1) :]
        ):
            at = message.decode().frame
            if at >= frame:
                return
            if at >= before:
                yield message

    def _at(self, stamp_ns: int) -> Recorded:
        """The first message of the clock that was captured at ``stamp_ns`` or later."""
        low, high = 0, len(self._clock_chunks) - 1
        while low < high:  # the last chunk that begins at or before it
            middle = (low + high + 1) // 2
            if self._first(self._clock_chunks[middle]).publish_time_ns <= stamp_ns:
                low = middle
            else:
                high = middle - 1
        for message in self._index.messages(
            [self._clock], chunks=self._clock_chunks[low : low + 2]
        ):
            if message.publish_time_ns >= stamp_ns:
                return message
        seconds = (stamp_ns - self.first_ns) * 1e-9
        raise RecordingError(f"{self.path}: ends before {seconds:.3f} s")

    def _first_frame(self, chunk: IndexedChunk, topic: Topic) -> int:
        return self._first(chunk, topic).decode().frame

    def _first(self, chunk: IndexedChunk, topic: Topic | None = None) -> Recorded:
        found = next(self._index.messages([topic or self._clock], chunks=[chunk]), None)
        if found is None:
            raise RecordingError(
                f"{self.path}: its index is wrong: repair it with `pliant recover`"
            )
        return found
