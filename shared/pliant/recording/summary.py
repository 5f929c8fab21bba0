"""``pliant info``: the content of a recording, whether it is complete, and what is missing."""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from mcap.records import Metadata

from pliant.errors import MessageError
from pliant.messages import topics
from pliant.messages.types import ClipPiece, StreamEnd
from pliant.recording.reader import Recorded, Recording
from pliant.recording.scan import Closed, Damage
from pliant.wording import counted

SECOND_PASS = "second_pass"
"""The metadata record of a recording whose last messages of the map are of two passes."""

_SEQUENCES = 1 << 32  # MCAP counts with 32 bits


@dataclass
class TopicSummary:
    """One topic.  ``gaps``: (first, last) sequence numbers that are missing between others."""

    messages: int = 0
    size: int = 0
    first_ns: int = 0
    last_ns: int = 0
    following: int = 0
    repeated: int = 0
    gaps: list[tuple[int, int]] = field(default_factory=list[tuple[int, int]])
    end: StreamEnd | None = None

    @property
    def missing(self) -> int:
        """Messages that were sent and are not there, as far as numbers and ends tell."""
        inside = sum(last - first + 1 for first, last in self.gaps)
        return inside + (max(0, self.end.messages - self.following) if self.end else 0)

    @property
    def rate_hz(self) -> float:
        """Messages a second by arrival at the recorder; 0 where that means nothing."""
        span_ns = self.last_ns - self.first_ns
        return (self.messages - 1) * 1e9 / span_ns if span_ns > 0 else 0.0


@dataclass
class Summary:
    """A whole recording."""

    size: int = 0
    topics: dict[str, TopicSummary] = field(default_factory=dict[str, TopicSummary])
    metadata: dict[str, dict[str, str]] = field(default_factory=dict[str, dict[str, str]])
    damage: list[Damage] = field(default_factory=list[Damage])
    has_index: bool = False
    unchecked: int = 0
    clip: str = ""
    """Name of the video file that it holds, whose frames its images are; "" without."""

    @property
    def closed(self) -> bool:
        """Whether the file has its index and the end of every topic."""
        return self.has_index and bool(self.topics) and not self.open_topics

    @property
    def complete(self) -> bool:
        """Whether it is closed, whole, and its source ran to its end."""
        ends = [topic.end for topic in self.topics.values()]
        whole = self.closed and not (self.missing or self.repeated)
        return whole and all(end and end.complete for end in ends)

    @property
    def open_topics(self) -> list[str]:
        """Topics without an end."""
        return [key for key, topic in self.topics.items() if topic.end is None]

    @property
    def missing(self) -> int:
        """Messages that are known to be missing, over all topics."""
        return sum(topic.missing for topic in self.topics.values())

    def missing_of(self, key: str) -> int:
        """Messages that are known to be missing of one topic."""
        return self.topics[key].missing if key in self.topics else 0

    @property
    def repeated(self) -> int:
        """Number of duplicate messages in all topics."""
        return sum(topic.repeated for topic in self.topics.values())

    @property
    def duration_s(self) -> float:
        """From the first message to the last one, by arrival at the recorder."""
        spans = [(t.first_ns, t.last_ns) for t in self.topics.values() if t.messages]
        return (max(s[1] for s in spans) - min(s[0] for s in spans)) * 1e-9 if spans else 0.0

    def count(self, message: Recorded) -> None:
        """Take in one message, in the order of the file."""
        self.unchecked += not message.checked
        if message.topic == topics.STREAM_END:
            try:
                end = message.decode()
            except MessageError:
                return
            assert isinstance(end, StreamEnd)
            self.topics.setdefault(end.topic, TopicSummary()).end = end
            return
        topic = self.topics.setdefault(message.topic.key, TopicSummary())
        if message.topic == topics.CLIP and not self.clip and message.checked:
            with suppress(MessageError):
                piece = message.decode()
                assert isinstance(piece, ClipPiece)
                self.clip = piece.name
        if topic.messages == 0:
            topic.first_ns = message.log_time_ns
        skipped = (message.sequence - topic.following) % _SEQUENCES
        if skipped < _SEQUENCES // 2:
            if skipped:
                topic.gaps.append((topic.following, topic.following + skipped - 1))
            topic.following += skipped + 1
        else:
            topic.repeated += 1
        topic.messages += 1
        topic.size += len(message.data)
        topic.last_ns = message.log_time_ns


def summarise(path: Path) -> Summary:
    """Read a recording once.  Raises RecordingError for a file that is none."""
    summary = Summary()
    recording = Recording(path)
    for item in recording.everything():
        if isinstance(item, Recorded):
            summary.count(item)
        elif isinstance(item, Metadata):
            summary.metadata[item.name] = dict(item.metadata)
        elif isinstance(item, Damage):
            summary.damage.append(item)
        elif isinstance(item, Closed):
            summary.has_index = True
    summary.size = recording.size
    return summary


def describe(summary: Summary) -> Iterator[str]:
    """The summary as lines for people."""
    pliant = summary.metadata.get("pliant", {})
    yield (
        f"{in_words(summary.size)}, {summary.duration_s:.1f} s, "
        f"{counted(sum(t.messages for t in summary.topics.values()), 'message')}, {state(summary)}"
    )
    if pliant:
        written = f"pliant {pliant.get('version', '?')} {pliant.get('commit', '')[:12]}".strip()
        yield f"recorded by {written}, Python {pliant.get('python', '?')}"
        yield f"command: {pliant.get('command', '?')}"
    if summary.clip:
        size = in_words(summary.topics[topics.CLIP.key].size)
        yield f"images: frames of {summary.clip}, stored unchanged ({size})"
    packages = summary.metadata.get("packages", {})
    if packages:
        yield "packages: " + ", ".join(f"{name} {number}" for name, number in packages.items())
    if summary.topics:
        yield f"{'topic':<26}{'messages':>9}{'rate':>10}{'size':>12}  missing"
    for key, topic in sorted(summary.topics.items()):
        rate = f"{topic.rate_hz:.1f} Hz" if topic.rate_hz else ""
        yield f"{key:<26}{topic.messages:>9}{rate:>10}{in_words(topic.size):>12}  {_missing(topic)}"
    for damage in summary.damage:
        yield f"damage at byte {damage.offset}, {in_words(damage.size)}: {damage.what}"


def state(summary: Summary) -> str:
    """Whether the recording is whole, in one phrase."""
    if summary.complete and not summary.damage:
        return "closed, nothing missing"
    words: list[str] = []
    if not summary.has_index:
        words.append("not closed (repair it with `pliant recover`)")
    elif summary.open_topics:
        words.append(f"indexed, without the end of {counted(len(summary.open_topics), 'topic')}")
    else:
        interrupted = any(t.end and not t.end.complete for t in summary.topics.values())
        words.append("closed after an interruption" if interrupted else "closed")
    words.append(f"{counted(summary.missing, 'message')} missing" if summary.missing else "no gaps")
    if summary.repeated:
        words.append(f"{counted(summary.repeated, 'message')} repeated")
    if summary.damage and summary.has_index:
        words.append("damaged")
    return ", ".join(words)


def _missing(topic: TopicSummary) -> str:
    shown = ", ".join(f"{a}" if a == b else f"{a}-{b}" for a, b in topic.gaps[:5])
    more = f" and {counted(len(topic.gaps) - 5, 'more gap')}" if len(topic.gaps) > 5 else ""
    count = f"{topic.missing}{f' ({shown}{more})' if shown else ''}"
    return count if topic.end is not None else f"{count}, no end"


def in_words(count: int) -> str:
    """A number of bytes, with its unit."""
    if count < 1 << 10:
        return f"{count} B"
    return f"{count / (1 << 20):.1f} MiB" if count >= 1 << 20 else f"{count / (1 << 10):.1f} KiB"
