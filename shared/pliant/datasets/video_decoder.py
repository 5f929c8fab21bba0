"""The pictures of a video file, one by one: of the stream that is meant, each in its own size.

One thread decodes: with several, FFmpeg makes other pixels of a damaged stream with every run,
by their timing.
"""

import contextlib
import os
from collections.abc import Generator, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any, Protocol, cast

import cv2

from pliant.algorithms.arrays import U8
from pliant.algorithms.image.fields import is_combed, one_field
from pliant.datasets import matroska, mp4_boxes
from pliant.datasets.packet_decoder import PacketDecoder, codec_of, decodes
from pliant.datasets.video_streams import ChosenStream, Container, PatchedFile, choose
from pliant.errors import DatasetError

_AVI = b"RIFF"
"""AVI has one size for all its frames, and no times of them but their order of decoding."""
_DEFAULT_FPS = 30.0
_MOST_LINES = 1088
"""Maximum lines of interlaced video."""
_LOOKED_AT = 8
"""Pictures by which a stream counts as interlaced or not."""
_SAME_ASPECT = 0.01
FIELDS = "interlaced: one field of each frame is used, and the lines between are interpolated"
_COLOURS = "HDR or wide-gamut video: colours stay as they are coded"
_LIKELY_ASPECTS = (Fraction(1, 4), Fraction(4))


class Capture(Protocol):
    """The part of ``cv2.VideoCapture`` that is used."""

    def grab(self) -> bool: ...
    def retrieve(self) -> tuple[bool, U8 | None]: ...
    def get(self, property_id: int, /) -> float: ...
    def set(self, property_id: int, value: float, /) -> bool: ...
    def release(self) -> None: ...


def streams_of(file: Path) -> Container:
    """The video streams of an MP4, MOV, Matroska or WebM file; none of any other.

    Raises OSError if the file cannot be read.
    """
    with file.open("rb") as source:
        size = source.seek(0, os.SEEK_END)
        for kind in (mp4_boxes, matroska):
            source.seek(0)
            if kind.recognises(source.read(kind.MAGIC_BYTES)):
                return kind.video_streams(source, size)
        source.seek(0)
        return Container(may_change=source.read(len(_AVI)) != _AVI)


class VideoDecoder:
    """A decoder at the first picture of a stream.

    stream: its description in the container.     notes: changes to its pictures, for users.
    rate_hz: frames a second, or a usual rate where that of the container is unlikely.
    count: how many pictures it has, according to the container; None: unlikely there.
    aspect: width over height of its pixels.     codec: as OpenCV calls it.
    combed: whether a picture that was read had two fields, though the stream is none of these.
    """

    def __init__(
        self, capture: Capture, chosen: ChosenStream, aspect: Fraction, notes: Sequence[str]
    ) -> None:
        self._capture = capture
        self._size: tuple[int, int] | None = None
        self.combed = False
        self.stream = chosen.stream
        self.notes = tuple(notes)
        self.aspect = aspect
        self.codec = codec_of(capture)
        stated = capture.get(cv2.CAP_PROP_FPS)
        likely = 0.1 < stated < 1e4
        self.rate_hz = stated if likely else _DEFAULT_FPS
        known = chosen.stream.frames if chosen.stream is not None else None
        count = int(capture.get(cv2.CAP_PROP_FRAME_COUNT)) if likely else 0
        self.count = known or (count if count > 0 else None)

    @property
    def stamp_ns(self) -> int:
        """When the picture at hand is shown, after the first one."""
        return round(self._capture.get(cv2.CAP_PROP_POS_MSEC) * 1e6)

    def grab(self) -> bool:
        """Decode the next picture; False at the end, and where it is damaged."""
        return self._capture.grab()

    def read(self) -> U8 | None:
        """The next picture, (H, W, 3) BGR; None at the end, and where it is damaged.

        One of another size is made as large as the first, unless its aspect is another, too.
        """
        if not self._capture.grab():
            return None
        read, pixels = self._capture.retrieve()
        if not read or pixels is None:
            return None
        if is_combed(pixels):
            self.combed, pixels = True, one_field(pixels)
        size = (pixels.shape[1], pixels.shape[0])
        self._size = self._size or size
        if size != self._size and _same_aspect(size, self._size):
            return cast(U8, cv2.resize(pixels, self._size, interpolation=cv2.INTER_AREA))
        return pixels

    def seek_frame(self, number: int) -> bool:
        """Go near a picture by its number; where that leads is no promise."""
        return self._capture.set(cv2.CAP_PROP_POS_FRAMES, number)

    def seek_ns(self, stamp_ns: int) -> bool:
        """Go near a picture by its time."""
        return self.seek_frame(round(1e-9 * stamp_ns * self.rate_hz))


@contextlib.contextmanager
def opened(file: Path) -> Generator[VideoDecoder, None, None]:
    """The decoder of the stream that is meant.  Raises DatasetError if a file has none."""
    try:
        chosen = choose(streams_of(file))
    except OSError as error:
        raise DatasetError(f"{file}: cannot be read: {error.strerror}") from None
    with contextlib.ExitStack() as held:
        capture = _start(file, chosen, held)
        if capture is None:
            raise DatasetError(f"{file}: {_why_not(file)}")
        notes = [chosen.note] if chosen.note else []
        rotation = int(capture.get(cv2.CAP_PROP_ORIENTATION_META))
        aspect = _aspect(capture, rotation)
        special = _special(_packets(file, chosen, capture, held))
        notes += special
        wanted = special or chosen.may_change
        packets = _packets(file, chosen, capture, held) if wanted else None
        decoder = capture if packets is None else PacketDecoder(packets, rotation)
        yield VideoDecoder(cast(Capture, decoder), chosen, aspect, notes)


@contextlib.contextmanager
def quiet_opencv() -> Generator[None, None, None]:
    """Keep OpenCV and FFmpeg from writing to the terminal: our own message reports the fault."""
    logging: Any = cv2.utils.logging
    before = logging.getLogLevel()
    logging.setLogLevel(logging.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        logging.setLogLevel(before)


def _start(
    file: Path, chosen: ChosenStream, held: contextlib.ExitStack, *, raw: bool = False
) -> cv2.VideoCapture | None:
    """OpenCV's reader at the first picture, or at the first packet; None if there is none.

    A name with a colon is none of a protocol, and one that is not UTF-8 never comes to OpenCV.
    """
    source: Any = f"file:{file}"
    if chosen.patches or not _is_utf8(source):
        source = held.enter_context(contextlib.closing(PatchedFile(file, chosen.patches)))
    options = [cv2.CAP_PROP_FORMAT, -1] if raw else [cv2.CAP_PROP_N_THREADS, 1]
    with quiet_opencv():
        capture = cv2.VideoCapture(source, cv2.CAP_FFMPEG, options)
    held.callback(capture.release)
    return capture if capture.isOpened() else None


def _is_utf8(name: str) -> bool:
    try:
        name.encode()
    except UnicodeEncodeError:
        return False
    return True


def _packets(
    file: Path, chosen: ChosenStream, capture: cv2.VideoCapture, held: contextlib.ExitStack
) -> cv2.VideoCapture | None:
    """The packets of a stream, if they can be decoded one by one.

    If the container is unknown, they are those of FFmpeg's choice of the best stream.
    """
    if not decodes(codec_of(capture)):
        return None
    packets = _start(file, chosen, held, raw=True)
    return packets if packets is not None and decodes(codec_of(packets)) else None


def _special(packets: cv2.VideoCapture | None) -> list[str]:
    """Notes for the user on a stream, by its first pictures."""
    if packets is None:
        return []
    sides = packets.get(cv2.CAP_PROP_FRAME_WIDTH), packets.get(cv2.CAP_PROP_FRAME_HEIGHT)
    decoder = PacketDecoder(packets)
    kinds = [decoder.grab() and (decoder.interlaced, decoder.wide_gamut)]
    if min(sides) <= _MOST_LINES:
        kinds += [decoder.grab() and (decoder.interlaced, False) for _ in range(_LOOKED_AT)]
    found = [any(kind) for kind in zip(*filter(None, kinds), strict=True)]
    return [note for note, here in zip((FIELDS, _COLOURS), found, strict=False) if here]


def _aspect(capture: cv2.VideoCapture, rotation_deg: int) -> Fraction:
    """Width over height of a pixel, as it is stored; 1 where that of the file is unlikely."""
    above, below = (int(capture.get(each)) for each in (cv2.CAP_PROP_SAR_NUM, cv2.CAP_PROP_SAR_DEN))
    if above <= 0 or below <= 0:
        return Fraction(1)
    aspect = Fraction(above, below)
    if not _LIKELY_ASPECTS[0] <= aspect <= _LIKELY_ASPECTS[1]:
        return Fraction(1)
    return 1 / aspect if rotation_deg % 180 else aspect


def _same_aspect(size: tuple[int, int], other: tuple[int, int]) -> bool:
    across, down = size[0] * other[1], size[1] * other[0]
    return abs(across - down) <= _SAME_ASPECT * max(across, down)


def file_version(file: Path) -> tuple[int, ...]:
    """Identity of a file's content: distinguishes it from another file of its name, and from
    earlier content; () without a file.
    """
    try:
        status = file.stat()
    except OSError:
        return ()
    return status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns


def _why_not(file: Path) -> str:
    if file_version(file) and not file.stat().st_size:
        return "is empty (0 bytes): copy it again"
    return (
        "not a video that OpenCV can read: without images, truncated, or in an unsupported "
        "format (then convert it, e.g. to MP4)"
    )
