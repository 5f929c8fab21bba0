"""A part of a source: which frames it has, and that their times stay."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from pliant.config import IngestParameters
from pliant.datasets import check_start, open_source
from pliant.datasets.base import SourceFrame
from pliant.datasets.calibration import Calibration, calibration_from_fov
from pliant.datasets.excerpt import Excerpt
from pliant.datasets.rectifier import Rectifier, rectified
from pliant.datasets.source_spec import SourceSpec
from pliant.datasets.video_decoder import quiet_opencv
from pliant.errors import DatasetError

START_NS = 5_000_000_000


@dataclass
class Frames:
    """Ten frames a second; each third is sharp, but for one without pixels."""

    count: int = 30
    frame_count: int | None = 30
    name: str = "frames"
    is_live: bool = False
    ground_truth_path: Path | None = None

    @property
    def calibration(self) -> Calibration:
        return calibration_from_fov(512, 192, 60.0)

    def __iter__(self) -> Iterator[SourceFrame]:
        squares = np.random.default_rng(0).integers(0, 255, (12, 16), dtype=np.uint8)
        scene = np.pad(np.kron(squares, np.ones((16, 16), np.uint8)), ((0, 0), (0, 256)))
        for index in range(self.count):
            blurred = cv2.GaussianBlur(scene, (0, 0), 0.5 if index % 3 == 2 else 2.0)
            frame = SourceFrame(
                index=index, stamp_ns=START_NS + index * 100_000_000, encoding="mono8",
                data=blurred.tobytes(), width=512, height=192, depth=b"%d" % index,
            )  # fmt: skip
            yield frame.without_data() if index == 5 else frame


def taken(**part: object) -> list[int]:
    """Numbers, in the source, of the frames that are taken."""
    frames = list(Excerpt(Frames(), IngestParameters.model_validate(part)))
    assert [frame.index for frame in frames] == list(range(len(frames)))
    return [(frame.stamp_ns - START_NS) // 100_000_000 for frame in frames]


def test_times_are_seconds_after_the_first_frame() -> None:
    assert taken(start_s=0.5, end_s=0.9) == [5, 6, 7, 8]
    assert taken(start_s=2.75) == [28, 29]
    assert taken(end_s=0.05) == [0]


def test_one_of_several_is_the_first_or_the_sharpest() -> None:
    assert taken(every=7) == [0, 7, 14, 21, 28]
    assert taken(every=3, sharpest=True, end_s=1.0) == [2, 3, 8, 9]  # 5 has no pixels
    assert taken(every=3, start_s=0.1, end_s=0.8) == [1, 4, 7]


def test_the_number_of_frames_is_given_where_it_is_known() -> None:
    assert Excerpt(Frames(), IngestParameters(every=7)).frame_count == 5
    assert Excerpt(Frames(), IngestParameters(end_s=1.0)).frame_count is None
    assert Excerpt(Frames(frame_count=None), IngestParameters(every=2)).frame_count is None


def test_a_first_depth_map_is_that_of_the_first_frame_taken() -> None:
    part = IngestParameters(start_s=0.6, end_s=0.9)
    frames = list(Excerpt(Frames(), part, first_depth_only=True))
    assert [frame.depth for frame in frames] == [b"6", b"", b""]
    assert [frame.depth for frame in Excerpt(Frames(), part)] == [b"6", b"7", b"8"]


def test_nothing_left_is_one_line() -> None:
    with pytest.raises(DatasetError, match="--end 1: must be after --start 2"):
        Excerpt(Frames(), IngestParameters(start_s=2.0, end_s=1.0))
    with pytest.raises(DatasetError, match=r"no frame lies between --start 1.01 s and --end 1.09"):
        list(Excerpt(Frames(), IngestParameters(start_s=1.01, end_s=1.09)))
    beyond = Excerpt(Frames(), IngestParameters(start_s=99.0))
    for ask in (beyond.check_start, lambda: list(beyond)):
        with pytest.raises(DatasetError, match=r"is 2.90 s long: no frame comes at --start 99 s"):
            ask()
    Excerpt(Frames(), IngestParameters(start_s=2.9)).check_start()


def test_the_end_of_a_source_is_known_without_reading_it_all(tmp_path: Path) -> None:
    images = Excerpt(open_source("built-in:tiny"), IngestParameters(start_s=99.0))
    with pytest.raises(DatasetError, match=r"is 1.30 s long"):
        images.check_start()
    images = Excerpt(open_source("built-in:tiny"), IngestParameters(start_s=1.3))
    images.check_start()
    file = tmp_path / "clip.avi"
    with quiet_opencv():
        writer = cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*"MJPG"), 25.0, (64, 48))
    for number in range(50):
        writer.write(np.full((48, 64, 3), number, np.uint8))
    writer.release()
    open_source(SourceSpec(location=str(file), fov_deg=60.0), IngestParameters(start_s=1.9))
    for start_s, ends in ((1.9, False), (1.99, True), (2.5, True), (1e6, True)):
        video = open_source(
            SourceSpec(location=str(file), fov_deg=60.0), IngestParameters(start_s=start_s)
        )
        if not ends:
            check_start(video)
            continue
        with pytest.raises(DatasetError, match=r"clip: is 1.96 s long: no frame comes at --start"):
            check_start(video)


def test_a_broken_frame_is_called_as_the_source_counts_it() -> None:
    """And a part of that part, of a recording that has it, still is."""
    part = Excerpt(Frames(), IngestParameters(every=4))
    frame = list(part)[1]
    rectified_frame = rectified(replace(frame, data=b""), Rectifier(part.calibration))
    assert rectified_frame.missing.startswith("broken: frame 4 of the source: ")
    again = list(Excerpt(part, IngestParameters(every=2)))
    assert [(f.index, f.number) for f in again] == [(0, 0), (1, 8), (2, 16), (3, 24)]


def test_a_source_is_opened_in_part() -> None:
    whole = list(open_source("built-in:tiny"))
    part = IngestParameters(every=4)
    some = list(open_source("built-in:tiny", part))
    assert [f.number for f in some] == list(range(0, len(whole), 4))
    assert [replace(f, index=0, number=-1) for f in some] == [
        replace(f, index=0) for f in whole[::4]
    ]
    assert open_source("built-in:tiny", IngestParameters()).frame_count == len(whole)
