"""Files that something has damaged, or somebody has crafted: each is a result or one line."""

from collections.abc import Callable
from itertools import islice
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from recorded_messages import Ros, usual, write_foxglove_mcap, write_ros1_bag, write_ros_mcap

from pliant.datasets import open_source
from pliant.datasets.calibration_files import read_calibration
from pliant.errors import PliantError
from pliant.formats.ply import read_ply, write_ply
from pliant.formats.trajectory_files import read_trajectory
from pliant.recording.reader import Recording
from pliant.recording.recover import recover
from pliant.recording.summary import summarise

SEEDS = 25
NEAR_AN_END = 512
"""Headers and indices lie there."""
LONGEST_LINE = 600
REFERENCE = Path(__file__).parents[1] / "data" / "reference" / "reference.mcap"
CALIBRATION = "width: 640\nheight: 480\nfx: 500\nfy: 500\ncx: 319.5\ncy: 239.5\nk1: 0.01\n"


def mutated(whole: bytes, rng: Any) -> bytes:
    """With one to three places flipped, filled, cut off or doubled."""
    data = bytearray(whole)
    for _ in range(int(rng.integers(1, 4))):
        near = min(len(data), NEAR_AN_END)
        at = [rng.integers(len(data)), rng.integers(near), len(data) - 1 - rng.integers(near)]
        where, size = int(at[rng.integers(3)]), int(rng.integers(1, 9))
        match rng.integers(6):
            case 0:
                data[where] ^= 1 << int(rng.integers(8))
            case 1:
                data[where : where + size] = b"\xff" * size
            case 2:
                data[where : where + size] = bytes(size)
            case 3:
                data[where : where + size] = rng.bytes(size)
            case 4:
                del data[max(where, 1) :]
            case _:
                data[where:where] = data[where : where + 4 * size]
    return bytes(data)


def frames_of(file: Path) -> None:
    for frame in islice(open_source(str(file)), 4):
        assert frame.called


def messages_of(file: Path) -> None:
    summarise(file)
    for message in Recording(file).messages():
        message.decode()


def recovered(file: Path) -> None:
    recover(file, file.with_name("recovered.mcap"))


def write_video(file: Path, code: str) -> None:
    writer = cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*code), 30.0, (64, 48))
    for index in range(6):
        pixels = np.random.default_rng(index).integers(0, 255, (12, 16, 3), np.uint8)
        writer.write(np.kron(pixels, np.ones((4, 4, 1), np.uint8)))
    writer.release()


def write_points(file: Path) -> None:
    rng = np.random.default_rng(0)
    write_ply(file, rng.random((20, 3), np.float32), rng.integers(0, 255, (20, 3), np.uint8))


def write_poses(file: Path) -> None:
    file.write_text("".join(f"{0.1 * k:.1f} {k} 2 3 0 0 0 1\n" for k in range(20)))


def write_bag(file: Path) -> None:
    write_ros1_bag(file, Ros(1), usual(Ros(1)))


def write_ros(file: Path) -> None:
    write_ros_mcap(file, Ros(2), usual(Ros(2)))


def copy(file: Path) -> None:
    file.write_bytes(REFERENCE.read_bytes())


@pytest.mark.parametrize(
    ("name", "write", "read"),
    [
        ("points.ply", write_points, read_ply),
        ("poses.txt", write_poses, read_trajectory),
        ("calibration.yaml", lambda file: file.write_text(CALIBRATION), read_calibration),
        ("video.mp4", lambda file: write_video(file, "mp4v"), frames_of),
        ("video.avi", lambda file: write_video(file, "MJPG"), frames_of),
        ("video.webm", lambda file: write_video(file, "VP80"), frames_of),
        ("images.bag", write_bag, frames_of),
        ("ros.mcap", write_ros, frames_of),
        ("images.mcap", lambda f: write_foxglove_mcap(f, raw=True, encoding="json"), frames_of),
        ("source.mcap", copy, frames_of),
        ("recording.mcap", copy, messages_of),
        ("damaged.mcap", copy, recovered),
    ],
    ids=lambda each: each if isinstance(each, str) else "",
)  # fmt: skip
def test_what_is_read_of_it_is_a_result_or_one_line(
    name: str, write: Callable[[Path], object], read: Callable[[Path], object], tmp_path: Path
) -> None:
    whole = tmp_path / name
    write(whole)
    data = whole.read_bytes()
    for seed in range(SEEDS):
        folder = tmp_path / str(seed)
        folder.mkdir()
        file = folder / name
        file.write_bytes(mutated(data, np.random.default_rng(seed)))
        said = ""
        try:
            read(file)
        except PliantError as error:
            said = str(error)
        assert "\n" not in said, seed
        assert len(said) < LONGEST_LINE + len(str(file)), seed
