"""Videos that hold no map: every one of them runs to its end and says why, in one line."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from benchmarks.in_process import process
from running import NO_MESH, in_this_process, write_sequence

from pliant.config import load_config
from pliant.datasets import open_source
from pliant.errors import DatasetError
from pliant.map_history import MapHistory

pytestmark = pytest.mark.system

WIDTH, HEIGHT = 160, 120
SHAPE = (HEIGHT, WIDTH)


def texture(width: int, height: int) -> np.ndarray:
    """Structure at all scales, float."""
    random = np.random.default_rng(0)
    image = np.full((height, width), 128.0, np.float32)
    for size in (1, 2, 4, 8, 16, 32):
        coarse = random.normal(size=(height // size + 2, width // size + 2)).astype(np.float32)
        layer = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
        image += 12.0 * size**0.7 * layer
    return np.clip(image, 0.0, 255.0)


STILL = texture(WIDTH, HEIGHT)


def with_noise(image: np.ndarray, frames: int) -> list[np.ndarray]:
    random = np.random.default_rng(1)
    noisy = [image + random.normal(scale=3.0, size=image.shape) for _ in range(frames)]
    return [np.clip(frame, 0, 255).astype(np.uint8) for frame in noisy]


def sliding(width: int, height: int, frames: int) -> list[np.ndarray]:
    wide = texture(width + 2 * frames, height).astype(np.uint8)
    return [np.ascontiguousarray(wide[:, 2 * i : 2 * i + width]) for i in range(frames)]


def turning(frames: int) -> list[np.ndarray]:
    """What a camera sees that only turns: homographies of one picture, half a degree a frame."""
    focal = 0.9 * WIDTH
    K = np.array([[focal, 0, WIDTH / 2], [0, focal, HEIGHT / 2], [0, 0, 1.0]])
    picture = texture(3 * WIDTH, 2 * HEIGHT)
    K_picture = np.array([[focal, 0, WIDTH / 2], [0, focal, HEIGHT], [0, 0, 1.0]])
    images: list[np.ndarray] = []
    for i in range(frames):
        angle = np.radians(0.5 * i)
        c, s = np.cos(angle), np.sin(angle)
        R = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
        H = K @ R.T @ np.linalg.inv(K_picture)
        images.append(cv2.warpPerspective(picture, H, (WIDTH, HEIGHT)).astype(np.uint8))
    return images


VIDEOS: dict[str, Callable[[], list[Any]]] = {
    "constant": lambda: [np.full(SHAPE, 100, np.uint8)] * 12,
    "black": lambda: [np.zeros(SHAPE, np.uint8)] * 12,
    "saturated": lambda: [np.full(SHAPE, 255, np.uint8)] * 12,
    "pure noise": lambda: list(np.random.default_rng(2).integers(0, 256, (12, *SHAPE), np.uint8)),
    "still": lambda: [STILL.astype(np.uint8)] * 30,
    "still with noise": lambda: with_noise(STILL, 40),
    "pure rotation": lambda: turning(30),
    "one frame": lambda: [STILL.astype(np.uint8)],
    "two frames": lambda: sliding(WIDTH, HEIGHT, 2),
    "32x24": lambda: sliding(32, 24, 12),
    "4k": lambda: sliding(3840, 2160, 3),
    "16 bit": lambda: [(STILL * 256).astype(np.uint16)] * 6,
    "transparent": lambda: [np.dstack([STILL] * 4).astype(np.uint8)] * 6,
    "broken but for the first": lambda: [STILL.astype(np.uint8), *[b"\x89PNG\r\n\x1a\n"] * 6],
}


@pytest.mark.parametrize("name", VIDEOS)
def test_a_video_without_a_map_has_the_reason(name: str, tmp_path: Path) -> None:
    """The services' algorithms in one process; what the processes add is tested below."""
    source = write_sequence(tmp_path / "video", VIDEOS[name]())
    history = MapHistory()
    reason = run(source, history)
    assert history.final() == {}
    assert reason
    assert len(reason.splitlines()) == 1


@pytest.mark.parametrize("size", [(8, 8), (2, 2), (8, 320), (320, 8)])
def test_images_that_are_too_narrow_to_track_in_are_refused(
    size: tuple[int, int], tmp_path: Path
) -> None:
    source = write_sequence(tmp_path / "video", sliding(*size, 12))
    with pytest.raises(DatasetError, match="too narrow for tracking") as refused:
        open_source(str(source))
    assert len(str(refused.value).splitlines()) == 1


def test_a_static_camera_starts_no_map(rigid_data: Path) -> None:
    history = MapHistory()
    reason = run(rigid_data / "euroc_v101_still30", history)
    assert history.final() == {}
    assert "parallax" in reason


def run(source: Path, history: MapHistory) -> str:
    dataset = open_source(str(source))
    reasons = [frame.delta.reason for frame in process(dataset, load_config(), history)]
    assert len(reasons) == dataset.frame_count
    return reasons[-1]


def test_a_run_without_a_map_ends_with_code_3_and_the_reason(tmp_path: Path) -> None:
    """Of one frame, so that the stream ends where it begins."""
    source = write_sequence(tmp_path / "video", VIDEOS["one frame"]())
    done = in_this_process("run", source, *NO_MESH, "--output", tmp_path / "result")
    assert done.returncode == 3, done.stderr
    assert "Traceback" not in done.stderr
    (line,) = [line for line in done.stdout.splitlines() if "no map could start" in line]
    report = json.loads((tmp_path / "result" / "report.json").read_text())
    assert report["last_reason"]
    assert line.endswith(report["last_reason"])
    assert report["frames"] == 1
    assert report["complete"]
    assert (tmp_path / "result" / "trajectory.txt").read_text() == ""


def test_an_image_too_small_for_a_camera_is_one_line(tmp_path: Path) -> None:
    source = write_sequence(tmp_path / "video", [np.zeros((1, 1), np.uint8)], fx=1.0, fy=1.0)
    done = in_this_process("run", source, cwd=tmp_path)
    assert done.returncode == 1
    assert "width is 1: expected 2 to" in done.stderr
