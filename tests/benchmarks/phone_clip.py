"""A clip as a telephone films it, through ``pliant run`` as a user types it: how long, how good.

15 s of 1920x1080 pixels, made of a sequence's first frames, enlarged and cropped, at 30 a second.
No calibration is given.
"""

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from benchmarks.colmap import children_s
from benchmarks.table import markdown_header, markdown_row
from pliant.datasets import open_source
from pliant.datasets.rectifier import decode
from pliant.datasets.video_decoder import quiet_opencv
from pliant.errors import PliantError
from pliant.evaluation.presentation import metres
from pliant.evaluation.run_evaluation import evaluate_trajectory
from pliant.formats.trajectory_files import read_trajectory
from pliant.formats.tum import read_tum
from pliant.recording.parts import parts_of
from pliant.trajectory import Trajectory

WIDTH, HEIGHT, FPS = 1920, 1080, 30.0
_HEADER = (
    *("clip of", "MB", "wall", "processor", "frames with a pose", "verdict", "ATE RMSE"),
    *("triangles", "recording, times the clip"),
)


def measure(sources: Sequence[str], seconds: float, keep: Path | None) -> Iterator[str]:
    """A row for each source, of so many seconds.  keep: a folder for clips and results."""
    yield markdown_header(_HEADER)
    with tempfile.TemporaryDirectory(prefix="pliant-phone-bench-") as made:
        for source in sources:
            folder = (keep or Path(made)) / Path(source).name.replace(":", "_")
            folder.mkdir(parents=True, exist_ok=True)
            clip = folder / "clip.mp4"
            stamps = phone_clip(source, clip, round(seconds * FPS))
            yield markdown_row([Path(source).name, *_row(source, clip, stamps)])


def phone_clip(source: str, file: Path, frames: int) -> list[int]:
    """Write the clip; returns the times of its frames in the source, ns."""
    stamps: list[int] = []
    with quiet_opencv():
        code = cv2.VideoWriter.fourcc(*"mp4v")
        writer = cv2.VideoWriter(str(file), code, FPS, (WIDTH, HEIGHT))
    for frame in islice(open_source(source), frames):
        pixels = decode(frame)
        pixels = cv2.cvtColor(pixels, cv2.COLOR_GRAY2BGR) if pixels.ndim == 2 else pixels[..., ::-1]
        scale = max(WIDTH / pixels.shape[1], HEIGHT / pixels.shape[0])
        size = round(pixels.shape[1] * scale), round(pixels.shape[0] * scale)
        large = cv2.resize(pixels, size, interpolation=cv2.INTER_CUBIC)
        left, top = (size[0] - WIDTH) // 2, (size[1] - HEIGHT) // 2
        writer.write(np.ascontiguousarray(large[top : top + HEIGHT, left : left + WIDTH]))
        stamps.append(frame.stamp_ns)
    writer.release()
    return stamps


def _row(source: str, clip: Path, stamps: Sequence[int]) -> list[str]:
    result = clip.with_name("result")
    command = [sys.executable, "-m", "pliant_services.cli", "run", str(clip), "--force"]
    began, spent = time.monotonic(), children_s()
    done = subprocess.run([*command, "--output", str(result)], capture_output=True, text=True)
    wall, cpu = time.monotonic() - began, children_s() - spent
    if done.returncode not in (0, 3):
        raise PliantError(f"{clip}: {done.stderr.strip()}")
    report: dict[str, Any] = json.loads((result / "report.json").read_text(encoding="utf-8"))
    size = clip.stat().st_size
    recorded = sum(part.stat().st_size for part in parts_of(result / "recording.mcap"))
    triangles = sum(mesh["triangles"] for mesh in report["mesh"] if mesh["level"] == "fine")
    return [
        f"{1e-6 * size:.1f}",
        f"{wall:.0f} s",
        f"{cpu:.0f} s",
        f"{report['frames_with_pose']} of {report['frames']}",
        report["verdict"],
        _ate(source, read_tum(result / "trajectory.txt", allow_empty=True), stamps),
        f"{triangles:,}",
        f"{recorded / size:.2f}",
    ]


def _ate(source: str, found: Trajectory, stamps: Sequence[int]) -> str:
    truth = open_source(source).ground_truth_path
    if truth is None:
        return "no truth"
    frames = np.rint(1e-9 * FPS * found.stamps_ns).astype(np.int64)
    named = Trajectory(
        stamps_ns=np.array(stamps, np.int64)[frames], T_world_camera=found.T_world_camera
    )
    told = evaluate_trajectory(named, read_trajectory(truth), frames=len(stamps))
    return metres(told.ate_m.rmse) if told.ate_m else told.reason
