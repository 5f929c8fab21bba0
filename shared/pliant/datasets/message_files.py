"""Files of recorded messages: the choice of a topic, its frames, its camera."""

import re
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from pliant.datasets import image_messages
from pliant.datasets.base import BrokenFrame, SourceFrame
from pliant.datasets.bit_depth import bits_used, eight_bits, note_on
from pliant.datasets.calibration import Calibration
from pliant.datasets.frame_times import in_order
from pliant.datasets.image_messages import CALIBRATION_TYPES, IMAGE_TYPES, RecordedImage
from pliant.datasets.image_sizes import LOOKED_AT, most_frequent
from pliant.datasets.images import choose_calibration
from pliant.datasets.rectifier import decode
from pliant.datasets.source_spec import SourceSpec
from pliant.errors import CalibrationError, DatasetError
from pliant.wording import shortened

_TRIED_FOR_SIZE = 20


@dataclass(frozen=True)
class MessageTopic:
    """A topic of a file.  kind: its type as ``plain_type`` writes it.   count: -1 if unknown."""

    name: str
    kind: str
    count: int


class OpenMessages(Protocol):
    """A file of messages that is open."""

    topics: list[MessageTopic]

    def messages(self, topic: MessageTopic) -> Iterator[RecordedImage]:
        """The messages of one topic in order of time.  Raises DatasetError if they end badly."""
        ...


class MessageFile(Protocol):
    """A file of messages."""

    path: Path

    def open(self) -> AbstractContextManager[OpenMessages]:
        """Open it.  Raises DatasetError if it is damaged or a library is missing."""
        ...


class MessageImages:
    """The images of one topic of a file, as a source of frames."""

    is_live = False
    ground_truth_path: Path | None = None

    def __init__(self, file: MessageFile, spec: SourceSpec) -> None:
        """Raises DatasetError, which lists the topics where the choice is not clear."""
        self.name = file.path.resolve().stem
        self.notes: list[str] = []
        self._bits = 16
        self._file = file
        with file.open() as opened:
            self._topic = _choose(opened.topics, spec.topic, file.path)
            self.notes += _other_topics(opened.topics, self._topic, spec.topic)
            self._where = f"{file.path}: {self._topic.name}"
            size = self._look(opened)
            found = None
            if spec.calibration is None and spec.fov_deg is None:
                found = _calibration(opened, self._topic, self._where)
            self.calibration = choose_calibration(spec, size, found=found, where=self._where)
        self.frame_count = self._topic.count if self._topic.count >= 0 else None

    def __iter__(self) -> Iterator[SourceFrame]:
        """Raises DatasetError if the file is damaged or has fewer messages than it announces."""
        came = 0
        with self._file.open() as opened:
            for frame in in_order(self._frames(opened), ahead=not self.is_live):
                came = frame.index + 1
                yield frame
        if came < self._topic.count:
            raise DatasetError(
                f"{self._where}: holds {came} of the {self._topic.count} images of its index"
            )

    def _frames(self, opened: OpenMessages) -> Iterator[SourceFrame]:
        """One frame for each message, a broken one where it cannot be understood."""
        for index, image in enumerate(opened.messages(self._topic)):
            try:
                frame = image_messages.source_frame(self._topic.kind, image, index)
                yield eight_bits(frame, self._bits)
            except BrokenFrame as error:
                yield SourceFrame(
                    index=index, stamp_ns=image.log_time_ns, encoding="unknown", data=b"",
                    made_from=str(error),
                )  # fmt: skip

    def _look(self, opened: OpenMessages) -> tuple[int, int]:
        """(width, height) of most of the first images that decode, and the bits that they use."""
        faults, sizes, frames = list[str](), list[tuple[int, int]](), list[SourceFrame]()
        try:
            for frame in self._frames(opened):
                try:
                    height, width = decode(frame).shape[:2]
                    sizes.append((width, height))
                    frames.append(frame)
                except BrokenFrame as error:
                    faults.append(str(error).removeprefix(f"{frame.called}: "))
                enough = 1 if self.is_live else LOOKED_AT
                if len(sizes) == enough or len(faults) == _TRIED_FOR_SIZE:
                    break
        except DatasetError:
            if not sizes:  # else reported where the whole file is read
                raise
        if not sizes:
            what = f"no image decodes ({faults[0]})" if faults else "no messages"
            raise DatasetError(f"{self._where}: {what}; choose another --topic")
        self._bits = bits_used(frames)
        self.notes += note_on(self._bits)
        return most_frequent(sizes)


def _choose(topics: list[MessageTopic], wanted: str, path: Path) -> MessageTopic:
    images = [topic for topic in topics if topic.kind in IMAGE_TYPES]
    listed = ", ".join(f"{t.name} ({t.kind})" for t in sorted(images, key=lambda t: t.name))
    named = [topic for topic in topics if topic.name.strip("/") == wanted.strip("/")]
    if wanted and not named:
        raise DatasetError(f"{path}: no topic {wanted}; {_with_images(listed)}")
    if wanted and named[0] not in images:
        raise DatasetError(
            f"{path}: {named[0].name} carries {named[0].kind}, no images; {_with_images(listed)}"
        )
    if not images:
        names = ", ".join(sorted({t.kind for t in topics})) or "nothing"
        raise DatasetError(f"{path}: no topic with images; its topics: {names[:300]}")
    if not wanted and len(images) > 1:
        likely = _of_a_camera(images)
        if len(likely) == 1:
            return likely[0]
        raise DatasetError(f"{path}: several topics with images; choose one with --topic: {listed}")
    return named[0] if wanted else images[0]


_NO_CAMERA = re.compile(r"depth|disparity|mask|segment|label|confidence|theora", re.IGNORECASE)


def _of_a_camera(images: list[MessageTopic]) -> list[MessageTopic]:
    """Topics of images without depth maps, masks, empty topics, and the same images compressed."""
    found = [t for t in images if not _NO_CAMERA.search(t.name) and t.count != 0]
    names = {topic.name for topic in found}
    return [t for t in found if t.name.removesuffix("/compressed") not in names - {t.name}]


def _other_topics(topics: list[MessageTopic], chosen: MessageTopic, wanted: str) -> list[str]:
    """A note on the topics that were skipped without a request."""
    others = [t.name for t in topics if t.kind in IMAGE_TYPES and t.name != chosen.name]
    if wanted or not others:
        return []
    named = shortened(", ".join(sorted(others)), 120)
    return [f"using {chosen.name}, not {named} (choose with --topic)"]


def _with_images(listed: str) -> str:
    return f"images are in {listed}" if listed else "none of its topics carries images"


def _calibration(opened: OpenMessages, images: MessageTopic, where: str) -> Calibration | None:
    """The camera that belongs to a topic of images: that of the topic with the most similar name.

    /left/image_raw has /left/camera_info; where two are equally near, nothing is guessed.
    """

    def shared(name: str) -> int:
        ours, theirs = images.name.strip("/").split("/"), name.strip("/").split("/")
        different = [i for i, (a, b) in enumerate(zip(ours, theirs, strict=False)) if a != b]
        return different[0] if different else min(len(ours), len(theirs))

    able = [t for t in opened.topics if t.kind in CALIBRATION_TYPES and t.count != 0]
    nearest = max((shared(topic.name) for topic in able), default=0)
    able = [topic for topic in able if shared(topic.name) == nearest]
    others = sum(topic.kind in IMAGE_TYPES for topic in opened.topics) > 1
    if len(able) != 1 or (nearest == 0 and others and "/" in able[0].name.strip("/")):
        return None
    message = next((each for each in opened.messages(able[0]) if not each.fault), None)
    if message is None:
        return None
    rectified = any("rect" in part for part in images.name.split("/"))
    try:
        return image_messages.calibration(message.message, rectified=rectified)
    except (CalibrationError, *image_messages.FOREIGN) as error:
        raise CalibrationError(
            f"{where}: the calibration in {able[0].name}: {shortened(str(error), 200)}; pass "
            "--calibration FILE"
        ) from None


def recorded_image(time_ns: int, decode: Callable[[bytes], Any], data: bytes) -> RecordedImage:
    """A message as it is decoded; one that does not decode costs itself alone."""
    try:
        return RecordedImage(time_ns, decode(data))
    except Exception as error:  # of a foreign parser on foreign bytes
        reason = shortened(" ".join(str(error).split())) or type(error).__name__
        return RecordedImage(time_ns, None, fault=f"its message is damaged ({reason})")


def missing_library(path: Path, library: str) -> DatasetError:
    """The message for a missing optional library."""
    return DatasetError(f"{path}: reading this file needs {library}: pip install 'pliant[bags]'")


def damaged(path: Path, error: BaseException, hint: str) -> DatasetError:
    """One line for any error of a library about a broken file."""
    reason: Any = " ".join(str(error).split())[:120]
    return DatasetError(
        f"{path}: is truncated or damaged ({reason or type(error).__name__}); repair it with {hint}"
    )
