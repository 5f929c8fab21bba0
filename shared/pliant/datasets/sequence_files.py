"""Writes the folder of a rendered sequence: see ``builtin``."""

import os
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml

from pliant.algorithms.arrays import F64
from pliant.algorithms.geometry import matrix_to_pose
from pliant.rendering.film import CameraOptions, RenderedFrame
from pliant.rendering.lens import NO_DISTORTION

Progress = Callable[[str, int, int], None]
"""Called with what is being done, steps done, and steps in all."""


def write_sequence(
    folder: Path,
    name: str,
    frame_of: Callable[[int], RenderedFrame],
    stamps_ns: Sequence[int],
    camera: CameraOptions,
    depth_scale: float,
    executor: Executor,
    progress: Progress,
) -> None:
    """All frames of a sequence, rendered on the executor, with their lists and calibration.

    name: of the source.  frame_of: renders the frame of a number, from 0.
    """
    (folder / "images").mkdir()
    (folder / "depth").mkdir()

    def film(number: int) -> F64:
        frame = frame_of(number)
        _write_frame(folder, number, frame, depth_scale)
        return matrix_to_pose(frame.T_world_camera)

    poses: list[F64] = []
    for pose in executor.map(film, range(len(stamps_ns))):
        poses.append(pose)
        progress("rendering frames", len(poses), len(stamps_ns))
    _write_lists(folder, stamps_ns, poses)
    _write_calibration(folder, name, camera, depth_scale)


@contextmanager
def render_threads() -> Generator[Executor]:
    """Kernels release the interpreter, and so does the PNG encoder: threads are enough."""
    executor = ThreadPoolExecutor(max_workers=min(os.cpu_count() or 1, 8))
    try:
        yield executor
    finally:
        executor.shutdown(wait=True, cancel_futures=True)


def _write_frame(folder: Path, number: int, frame: RenderedFrame, depth_scale: float) -> None:
    """Its image and its depth map; ``images`` and ``depth`` must be there."""
    steps = np.rint(frame.depth_m / depth_scale)
    # 0 is "no depth", so depths beyond 16 bits become 0 as well.
    depth = np.where(steps <= 65535.0, steps, 0.0).astype(np.uint16)
    image = frame.image if frame.image.ndim == 2 else frame.image[:, :, ::-1]
    for kind, pixels in (("images", image), ("depth", depth)):
        # Level 1: noise hardly compresses, and reading must be quick.
        done, data = cv2.imencode(".png", pixels, [cv2.IMWRITE_PNG_COMPRESSION, 1])
        if not done:
            raise RuntimeError("OpenCV cannot encode PNG")
        (folder / kind / f"{number:06d}.png").write_bytes(data.tobytes())


def _write_lists(folder: Path, stamps_ns: Sequence[int], poses: Sequence[F64]) -> None:
    """rgb.txt, depth.txt and groundtruth.txt; poses: (7,) each."""
    times = [f"{stamp // 10**9}.{stamp % 10**9:09d}" for stamp in stamps_ns]
    for file, kind in (("rgb.txt", "images"), ("depth.txt", "depth")):
        lines = [f"{time} {kind}/{i:06d}.png" for i, time in enumerate(times)]
        (folder / file).write_text("\n".join(["# timestamp filename", *lines]) + "\n")
    header = "# timestamp tx ty tz qx qy qz qw  (T_world_camera)"
    lines = [
        f"{time} {' '.join(f'{value:.10f}' for value in pose)}"
        for time, pose in zip(times, poses, strict=True)
    ]
    (folder / "groundtruth.txt").write_text("\n".join([header, *lines]) + "\n")


def _write_calibration(folder: Path, name: str, options: CameraOptions, depth_scale: float) -> None:
    """calib.yaml.  name: of the source.  depth_scale: metres per step of the depth maps."""
    camera = options.pinhole()
    k1, k2, p1, p2 = options.distortion
    content: dict[str, Any] = {
        "camera": name,
        "model": "pinhole" if options.distortion == NO_DISTORTION else "pinhole-radtan",
        "width": camera.width,
        "height": camera.height,
        "fx": camera.fx,
        "fy": camera.fy,
        "cx": camera.cx,
        "cy": camera.cy,
        "k1": k1,
        "k2": k2,
        "p1": p1,
        "p2": p2,
        "fps": options.fps,
        "colour": "rgb png" if options.colour else "grey",
        "depth_scale": depth_scale,
        "depth_invalid": [0],
        "depth_fx": camera.fx,
        "depth_fy": camera.fy,
        "depth_cx": camera.cx,
        "depth_cy": camera.cy,
    }
    (folder / "calib.yaml").write_text(yaml.safe_dump(content, sort_keys=False))
