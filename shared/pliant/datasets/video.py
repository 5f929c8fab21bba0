"""Video files: any that OpenCV reads, with a calibration file or a field of view.

A file of the same name with the ending .yaml beside it is taken as its calibration.  Times are
those of the container; where it has none, or they repeat, frames follow each other at its rate.
A frame that does not decode is one without data, and those behind it come all the same.  Frames
that an edit list excludes are decoded, because others depend on them, and skipped.
Frames are published as they leave the decoder, as raw BGR pixels.
"""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from pliant.algorithms.arrays import U8
from pliant.datasets.base import SourceFrame
from pliant.datasets.calibration import Calibration
from pliant.datasets.images import choose_calibration
from pliant.datasets.source_spec import SourceSpec
from pliant.datasets.video_decoder import FIELDS, VideoDecoder, file_version, opened
from pliant.datasets.video_streams import VideoStream
from pliant.errors import DatasetError

GIVE_UP = 600
"""Frames that do not decode, one behind the other, before nothing more is expected."""
_LOOKED_AT = 15
"""Frames that tell whether they are combs of two fields, though the file is not marked so."""
_ROUNDED_NS = 1_000
"""More than what times lose as OpenCV gives them, milliseconds in a float."""


class VideoFile:
    """The frames of a video file.

    frame_count: the container's word, not a promise.   notes: what is done to it, for people.
    """

    is_live = False
    ground_truth_path: Path | None = None

    def __init__(self, file: Path, spec: SourceSpec) -> None:
        """Raises DatasetError if it holds no video, CalibrationError for its calibration."""
        self.name = file.stem
        self.file = file
        self._version = file_version(file)
        with opened(file) as decoder:
            first = next(filter(_is_there, (decoder.read() for _ in range(GIVE_UP))), None)
            if first is None:
                raise DatasetError(
                    f"{file}: OpenCV decodes none of its frames ({decoder.codec}): convert it, "
                    "e.g. to H.264"
                )
            first_ns = decoder.stamp_ns
            for _ in range(_LOOKED_AT):
                if decoder.combed or decoder.read() is None:
                    break
            self.notes, self.rate_hz = [*decoder.notes], decoder.rate_hz
            self.notes += [FIELDS] if decoder.combed else []
            aspect = decoder.aspect
            self._count = decoder.count
            self.frame_count = shown_frames(decoder.stream, decoder.count, first_ns)
        height, width = first.shape[:2]
        self.calibration: Calibration = choose_calibration(
            spec,
            (width, height),
            found=file.with_suffix(".yaml"),
            where=str(file),
            pixel_aspect=float(aspect),
        )
        if aspect != 1 and self.calibration.focal_sigma > 0.0:
            self.notes.append(f"pixel aspect ratio {float(aspect):.3g}")

    def reaches(self, time_s: float) -> bool:
        """Whether a frame is found there by seeking; otherwise only reading shows."""
        with opened(self.file) as decoder:
            if decoder.stream is not None and decoder.stream.shown_ns:
                return False
            decoder.seek_ns(round(1e9 * time_s))
            return decoder.grab() and 1e-9 * decoder.stamp_ns >= time_s - 1.0 / self.rate_hz

    def __iter__(self) -> Iterator[SourceFrame]:
        """Raises DatasetError if it is another file by now, or was written to meanwhile.

        A file that has lost its name while it is read is there until its end.
        """
        with opened(self.file) as decoder:
            if file_version(self.file) != self._version:
                raise DatasetError(f"{self.file}: was replaced after it was opened: run it again")
            index = first_ns = 0
            for frame in self._decoded(decoder):
                if _is_shown(decoder.stream, frame.stamp_ns):
                    first_ns = first_ns if index else frame.stamp_ns
                    yield replace(frame, index=index, stamp_ns=frame.stamp_ns - first_ns)
                    index += 1
        self.check_unwritten()

    def check_unwritten(self) -> None:
        """Raise DatasetError if it was written to since it was opened."""
        now = file_version(self.file)
        if now != self._version and now[:2] == self._version[:2]:
            raise DatasetError(
                f"{self.file}: was modified during the run, and its frames may come from two "
                "videos: run it again"
            )

    def _decoded(self, decoder: VideoDecoder) -> Iterator[SourceFrame]:
        """Every frame that the stream has, shown or not."""
        step_ns = round(1e9 / decoder.rate_hz)
        index, previous_ns, broken = 0, -step_ns, 0
        while True:
            pixels = decoder.read()
            if pixels is None:  # at its end, or a frame that is damaged: then the next may be whole
                broken += 1
                if broken > GIVE_UP or index + broken >= (self._count or 0):
                    return
                continue
            stamp_ns = decoder.stamp_ns
            if stamp_ns <= previous_ns:
                stamp_ns = previous_ns + (broken + 1) * step_ns
            between_ns = (stamp_ns - previous_ns) // (broken + 1)
            for number in range(broken):
                yield _damaged(index + number, previous_ns + (number + 1) * between_ns)
            index, broken = index + broken, 0
            yield replace(raw_frame(pixels, index, stamp_ns), clip_frame=index)
            index, previous_ns = index + 1, stamp_ns


def _is_there(pixels: U8 | None) -> bool:
    return pixels is not None


def shown_frames(stream: VideoStream | None, count: int | None, first_ns: int) -> int | None:
    """How many frames come; first_ns: when the first that decodes does.  Those before it
    depend on frames that a cut has removed."""
    if stream is None or not stream.stamps_ns:
        return count
    first_ns += stream.origin_ns - _ROUNDED_NS
    return sum(stream.shows(each) for each in stream.stamps_ns if each >= first_ns)


def _is_shown(stream: VideoStream | None, stamp_ns: int) -> bool:
    """Whether the edit list shows a frame, by its time after the first one of all."""
    if stream is None or not stream.shown_ns:
        return True
    return stream.shows(stamp_ns + stream.origin_ns + _ROUNDED_NS)


def raw_frame(pixels: U8, index: int, stamp_ns: int) -> SourceFrame:
    """A decoded frame, (H, W) grey or (H, W, 3) BGR, as raw bytes."""
    height, width = pixels.shape[:2]
    return SourceFrame(
        index=index,
        stamp_ns=stamp_ns,
        encoding="mono8" if pixels.ndim == 2 else "bgr8",
        data=pixels.tobytes(),
        width=width,
        height=height,
    )


def _damaged(index: int, stamp_ns: int) -> SourceFrame:
    return SourceFrame(
        index=index, stamp_ns=stamp_ns, encoding="unknown", data=b"", width=0, height=0
    )
