"""Videos with GoPro's metadata inside: gyro, accelerometer and GPS of the camera itself."""

from collections.abc import Iterator
from pathlib import Path

from pliant.datasets import mp4_boxes
from pliant.datasets.measured.base import NOTHING, Measurements
from pliant.datasets.measured.gpmf import Payload, read_gpmf
from pliant.errors import DatasetError

_KIND = b"gpmd"
_MOST_BYTES = 1 << 22
"""Maximum size of a payload, which lasts a second: 300 times as much as cameras write."""


def read_gopro(file: Path) -> Measurements:
    """The samples of a video, from its first picture on; nothing if it has none.

    Raises DatasetError if it cannot be read.
    """
    payloads = list(_payloads(file))
    return read_gpmf(payloads, f"{file.name} (GPMF)") if payloads else NOTHING


def _payloads(file: Path) -> Iterator[Payload]:
    try:
        with file.open("rb") as opened:
            size = file.stat().st_size
            if not mp4_boxes.recognises(opened.read(mp4_boxes.MAGIC_BYTES)):
                return
            for sample in mp4_boxes.metadata_samples(opened, size, _KIND):
                opened.seek(sample.offset)
                data = opened.read(min(sample.size, _MOST_BYTES))
                yield Payload(data, sample.begin_ns, sample.end_ns)
    except OSError as error:
        raise DatasetError(f"{file}: cannot be read: {error.strerror}") from None
