"""Videos written here, and cameras that are simulated: there may be none on this machine."""

import os
import re
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from mp4_patches import spaced, ticks_a_second, turned

from pliant.config import IngestParameters
from pliant.datasets import open_source
from pliant.datasets.base import BrokenFrame
from pliant.datasets.calibration import UNSAID_SIGMA, calibration_from_yaml, calibration_yaml
from pliant.datasets.camera_device import CameraDevice, camera_index
from pliant.datasets.rectifier import Rectifier, decode
from pliant.datasets.source_spec import SourceSpec
from pliant.datasets.video_decoder import quiet_opencv
from pliant.errors import CalibrationError, DatasetError

WIDTH, HEIGHT = 64, 48
CALIBRATION = {"width": WIDTH, "height": HEIGHT, "fx": 60, "fy": 60, "cx": 31.5, "cy": 23.5}


def video(folder: Path, frames: int = 6, name: str = "clip.avi") -> Path:
    file = folder / name
    with quiet_opencv():  # OpenCV decides at its first video whether FFmpeg may write to stderr
        writer = cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*"MJPG"), 25.0, (WIDTH, HEIGHT))
    if not writer.isOpened():
        pytest.skip("OpenCV cannot write a video here")
    for number in range(frames):
        writer.write(np.full((HEIGHT, WIDTH, 3), 20 * number, np.uint8))
    writer.release()
    return file


def test_video(tmp_path: Path) -> None:
    file = video(tmp_path)
    dataset = open_source(SourceSpec(location=str(file), fov_deg=60.0))
    assert (dataset.name, dataset.frame_count, dataset.is_live) == ("clip", 6, False)
    for _ in range(2):  # again from the start
        frames = list(dataset)
        assert [frame.index for frame in frames] == list(range(6))
        assert [frame.stamp_ns for frame in frames] == [i * 40_000_000 for i in range(6)]
    rectifier = Rectifier(dataset.calibration)
    for number, frame in enumerate(frames):
        assert (frame.encoding, frame.width, frame.height) == ("bgr8", WIDTH, HEIGHT)
        grey, rgb = rectifier.rectify(frame)
        assert abs(float(grey.mean()) - 20 * number) < 5.0
        assert rgb is not None


def test_a_telephone_that_was_held_upright_and_frames_at_unequal_times(tmp_path: Path) -> None:
    """The matrix and the times of the container are those of the frames."""
    lying = tmp_path / "clip.mp4"
    code = cv2.VideoWriter.fourcc(*"mp4v")
    with quiet_opencv():
        writer = cv2.VideoWriter(str(lying), code, 10.0, (WIDTH, HEIGHT))
    image = np.full((HEIGHT, WIDTH, 3), 60, np.uint8)
    image[: HEIGHT // 2, : WIDTH // 2] = 220
    for _ in range(6):
        writer.write(image)
    writer.release()
    content = lying.read_bytes()
    tenth = ticks_a_second(content) // 10
    stamps_ms = {"equal": [0, 100, 200, 300, 400, 500], "unequal": [0, 50, 200, 300, 350, 500]}
    unequal = spaced(content, [tenth // 2, 3 * tenth // 2, tenth] * 2)
    for times, file in (("equal", content), ("unequal", unequal)):
        for quarters, degrees in enumerate((0, 90, 180, 270)):
            lying.write_bytes(turned(file, degrees) if degrees else file)
            dataset = open_source(SourceSpec(location=str(lying), fov_deg=60.0))
            size = (HEIGHT, WIDTH) if quarters % 2 else (WIDTH, HEIGHT)
            assert (dataset.calibration.width, dataset.calibration.height) == size
            frames = list(dataset)
            assert [round(1e-6 * frame.stamp_ns) for frame in frames] == stamps_ms[times]
            expected = np.rot90(image, -quarters).astype(int)  # clockwise
            for frame in frames:
                assert np.abs(decode(frame).astype(int) - expected).mean() < 5.0


def test_a_damaged_frame_is_named_and_ends_nothing(tmp_path: Path) -> None:
    file = video(tmp_path, 12, "clip.mp4")
    content = file.read_bytes()
    starts = [found.start() for found in re.finditer(b"\xff\xd8\xff", content)]
    assert len(starts) == 12
    for first, last in ((5, 6), (5, 8), (5, 12)):
        end = starts[last] if last < 12 else content.index(b"\xff\xd9", starts[-1]) + 2
        damaged = bytearray(content)
        damaged[starts[first] : end] = bytes(end - starts[first])
        file.write_bytes(damaged)
        dataset = open_source(SourceSpec(location=str(file), fov_deg=60.0))
        frames = list(dataset)
        count = 12 if last < 12 else first  # behind the last whole one there is nothing
        assert [frame.index for frame in frames] == list(range(count))
        assert [frame.stamp_ns for frame in frames] == [i * 40_000_000 for i in range(count)]
        if last == 12:
            continue
        assert [f.index for f in frames if not f.data] == list(range(first, last))
        with pytest.raises(BrokenFrame, match=r"frame 5: empty: .* the video is damaged"):
            Rectifier(dataset.calibration).rectify(frames[5])


def test_calibration_of_a_video(tmp_path: Path) -> None:
    file = video(tmp_path)
    guess = open_source(str(file)).calibration
    assert guess.focal_sigma == UNSAID_SIGMA
    assert calibration_from_yaml(calibration_yaml(guess)) == guess
    (tmp_path / "clip.yaml").write_text(yaml.safe_dump(CALIBRATION))
    assert open_source(str(file)).calibration.fx == 60.0
    assert open_source(str(file)).calibration.focal_sigma == 0.0
    other = tmp_path / "other.yaml"
    other.write_text(yaml.safe_dump({**CALIBRATION, "width": 128}))
    with pytest.raises(CalibrationError, match="128x48"):
        open_source(SourceSpec(location=str(file), calibration=other))


def test_files_that_are_no_video(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "junk.mp4").write_bytes(b"not a video" * 100)
    with pytest.raises(DatasetError, match=r"junk.mp4: not a video that OpenCV can read"):
        open_source(SourceSpec(location=str(tmp_path / "junk.mp4"), fov_deg=60.0))
    (tmp_path / "empty.mp4").touch()
    with pytest.raises(DatasetError, match=r"empty.mp4: is empty \(0 bytes\)"):
        open_source(SourceSpec(location=str(tmp_path / "empty.mp4"), fov_deg=60.0))
    with pytest.raises(DatasetError, match=r"contains several: .* `pliant batch"):
        open_source(str(tmp_path))
    (tmp_path / "image.png").write_bytes(b"")
    with pytest.raises(DatasetError, match="pass its folder"):
        open_source(SourceSpec(location=str(tmp_path / "image.png"), fov_deg=60.0))
    assert capfd.readouterr().err == ""  # one line is enough, and that is ours


class SimulatedCapture:
    """A camera of 64x48 px that stops after some frames."""

    def __init__(self, frames: int = 4, *, plugged_in: bool = True) -> None:
        self.frames = frames
        self.plugged_in = plugged_in
        self.released = False
        self.asked: dict[int, float] = {}

    def isOpened(self) -> bool:
        return self.plugged_in

    def read(self) -> tuple[bool, np.ndarray | None]:
        self.frames -= 1
        if self.frames < 0:
            return False, None
        return True, np.full((HEIGHT, WIDTH, 3), self.frames, np.uint8)

    def set(self, property_id: int, value: float) -> bool:
        self.asked[property_id] = value
        return True

    def release(self) -> None:
        self.released = True


def test_camera() -> None:
    captures: list[SimulatedCapture] = []

    def open_device(index: int) -> SimulatedCapture:
        assert index == 3
        captures.append(SimulatedCapture())
        return captures[-1]

    clock = iter([100, 100, 90, 300, 400])
    camera = CameraDevice(
        3,
        SourceSpec(location="camera:0", fov_deg=90.0),
        open_device=open_device,
        clock_ns=lambda: next(clock),
    )
    assert (camera.name, camera.is_live, camera.frame_count) == ("camera:3", True, None)
    assert captures[0].released  # so that the process that streams can open it
    assert camera.calibration.fx == pytest.approx(32.0)
    stream = iter(camera)
    frames = list(islice(stream, 3))
    assert [frame.index for frame in frames] == [0, 1, 2]
    assert [frame.stamp_ns for frame in frames] == [100, 101, 102]
    next(stream)
    with pytest.raises(DatasetError, match="camera:3: delivers no more images"):
        next(stream)
    assert captures[1].released


def test_camera_is_released_without_readers() -> None:
    captures: list[SimulatedCapture] = []

    def open_device(_: int) -> SimulatedCapture:
        captures.append(SimulatedCapture())
        return captures[-1]

    camera = CameraDevice(0, SourceSpec(location="camera:0", fov_deg=90.0), open_device=open_device)
    stream = iter(camera)
    next(stream)
    stream.close()  # type: ignore[attr-defined]
    assert captures[-1].released


def test_camera_opens_with_the_size_of_its_calibration(tmp_path: Path) -> None:
    capture = SimulatedCapture()
    file = tmp_path / "calib.yaml"
    file.write_text(yaml.safe_dump({**CALIBRATION, "width": 128, "height": 96}))
    with pytest.raises(CalibrationError, match="128x96 px, but they have 64x48"):
        CameraDevice(
            0, SourceSpec(location="camera:0", calibration=file), open_device=lambda _: capture
        )
    assert capture.asked == {cv2.CAP_PROP_FRAME_WIDTH: 128, cv2.CAP_PROP_FRAME_HEIGHT: 96}


def test_camera_that_is_not_there(capfd: pytest.CaptureFixture[str]) -> None:
    missing = SimulatedCapture(plugged_in=False)
    with pytest.raises(DatasetError, match="camera:5: no such camera"):
        CameraDevice(
            5, SourceSpec(location="camera:0", fov_deg=60.0), open_device=lambda _: missing
        )
    silent = SimulatedCapture(frames=0)
    with pytest.raises(DatasetError, match="no more images"):
        CameraDevice(5, SourceSpec(location="camera:0", fov_deg=60.0), open_device=lambda _: silent)
    assert silent.released
    with pytest.raises(DatasetError, match="camera:99: no such camera"):
        open_source(SourceSpec(location="camera:99", fov_deg=60.0))
    assert capfd.readouterr().err == ""


def test_names_of_cameras() -> None:
    assert [camera_index(name) for name in ("0", "camera:12", "camera:", "a0", "-1", "0.5")] == [
        0,
        12,
        None,
        None,
        None,
        None,
    ]


def test_a_video_that_is_replaced_after_it_was_opened_is_not_read_as_what_it_was(
    tmp_path: Path,
) -> None:
    file, other = video(tmp_path), video(tmp_path, 9, "other.avi")
    dataset = open_source(SourceSpec(location=str(file), fov_deg=60.0))
    other.replace(file)
    with pytest.raises(DatasetError, match=r"clip.avi: was replaced after it was opened"):
        next(iter(dataset))


def test_a_video_written_to_while_it_is_read_is_reported_and_a_deleted_one_is_none(
    tmp_path: Path,
) -> None:
    file = video(tmp_path)
    content = file.read_bytes()
    frames = iter(open_source(SourceSpec(location=str(file), fov_deg=60.0)))
    next(frames)
    file.write_bytes(content[: len(content) // 2])
    with pytest.raises(DatasetError, match=r"clip.avi: was modified during the run"):
        list(frames)
    file.write_bytes(content)
    frames = iter(open_source(SourceSpec(location=str(file), fov_deg=60.0)))
    next(frames)
    file.unlink()
    assert len(list(frames)) == 5


def test_a_video_written_to_while_a_part_is_read_is_reported(tmp_path: Path) -> None:
    file = video(tmp_path)
    content = file.read_bytes()
    for time, mask in enumerate((None, _white(tmp_path / "mask.png"))):
        part = IngestParameters(end_s=0.1)
        frames = iter(open_source(SourceSpec(location=str(file), fov_deg=60.0, mask=mask), part))
        next(frames)
        file.write_bytes(content)
        os.utime(file, (time, time))
        with pytest.raises(DatasetError, match=r"clip.avi: was modified during the run"):
            list(frames)


def _white(file: Path) -> Path:
    cv2.imwrite(str(file), np.full((48, 64), 255, np.uint8))
    return file
