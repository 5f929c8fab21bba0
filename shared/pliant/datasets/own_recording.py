"""Our own recordings as a source: the frames as they came to the run that was recorded.

    recording.mcap, a folder of its parts, or the result folder of a run

The calibration is that of the run, unless another one is given.
"""

from collections.abc import Iterator
from itertools import chain, repeat
from pathlib import Path

from pliant.datasets.base import Dataset, SourceFrame
from pliant.datasets.calibration import calibration_from_yaml
from pliant.datasets.images import choose_calibration
from pliant.datasets.mcap_file import is_mcap
from pliant.datasets.measured.base import Measurements
from pliant.datasets.recorded_images import RecordedImages
from pliant.datasets.source_spec import SourceSpec
from pliant.errors import DatasetError
from pliant.messages import topics
from pliant.messages.types import CameraStream, Depth, SourceImage
from pliant.recording.measured import fixes_of, imu_of
from pliant.recording.parts import parts_of
from pliant.recording.reader import Recording

_PROFILE = b"pliant"
_PROFILE_AT = 8 + 9 + 4  # magic, opcode and length of the header, length of the profile


def is_own_recording(source: str) -> bool:
    """Whether it is a recording that Pliant made, or a folder with one."""
    files = parts_of(Path(source))
    if not files or not is_mcap(str(files[0])):
        return False
    with files[0].open("rb") as file:
        return file.read(_PROFILE_AT + len(_PROFILE))[_PROFILE_AT:] == _PROFILE


def open_own_recording(spec: SourceSpec) -> Dataset:
    """The frames of a recording.  Raises DatasetError, CalibrationError and RecordingError."""
    return RecordedFrames(Path(spec.location), spec)


def recorded_sensors(spec: SourceSpec) -> Measurements:
    """The samples of other sensors in a recording.  Raises RecordingError and MessageError."""
    recording = Recording(Path(spec.location))
    return Measurements(imu=imu_of(recording), gps=fixes_of(recording))


class RecordedFrames:
    """The frames of a recording.  A truncated one ends where it was truncated."""

    is_live = False
    ground_truth_path: Path | None = None

    def __init__(self, path: Path, spec: SourceSpec) -> None:
        """Raises DatasetError if it holds no images."""
        self._recording = Recording(path)
        self._depth = spec.depth
        streams = self._recording.decoded(topics.STREAM)
        stream = next((m for m in streams if isinstance(m, CameraStream)), None)
        first = next(self._recording.messages(topics.SOURCE), None)
        if stream is None or first is None:
            raise DatasetError(
                f"{path}: a recording without images (made with --no-images, or stopped before its "
                "first frame): run its source again"
            )
        calibration = calibration_from_yaml(stream.calibration)
        self.name = stream.source
        self.frame_count = stream.frames if stream.frames >= 0 else None
        self.calibration = choose_calibration(
            spec, (calibration.width, calibration.height), found=calibration, where=str(path)
        )

    def __iter__(self) -> Iterator[SourceFrame]:
        wanted = self._depth
        depths = self._recording.decoded(topics.DEPTH) if wanted != "none" else iter(())
        # Recordings of earlier versions are without depth.
        for image, depth in zip(
            RecordedImages(self._recording), chain(depths, repeat(None)), strict=False
        ):
            data = depth.data if isinstance(depth, Depth) and wanted != "none" else b""
            wanted = "none" if data and wanted == "first" else wanted
            yield recorded_frame(image, data)


def recorded_frame(image: SourceImage, depth: bytes = b"") -> SourceFrame:
    """The source's frame of an image with pixels (``RecordedImages``)."""
    assert image.data or image.clip_frame < 0, "an image whose pixels are still in its clip"
    return SourceFrame(
        index=image.frame,
        stamp_ns=image.stamp_ns,
        encoding=image.encoding,
        data=image.data,
        width=image.width,
        height=image.height,
        depth=depth,
        made_from="" if image.data else image.made_from,  # why there is none
        mask=image.mask,
        number=image.source_frame,
    )
