"""CPU time of surfels per frame and stage, beside OpenCV's pyramidal LK on the same points."""

import time
from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import cv2
import numpy as np

from benchmarks.painting import paint_faces
from benchmarks.stopwatch import Stopwatch
from benchmarks.table import markdown
from pliant.algorithms.arrays import F32, F64, U8
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import matrix_to_pose, so3_exp
from pliant.algorithms.surfels.parameters import SurfelParameters
from pliant.algorithms.surfels.surfel_frame import SurfelState
from pliant.algorithms.surfels.surfel_tracker import SurfelTracker
from pliant.datasets import open_source
from pliant.datasets.depth import DepthRectifier
from pliant.datasets.rectifier import Rectifier
from pliant.datasets.source_spec import SourceSpec
from pliant.errors import DatasetError
from pliant.rendering.film import CameraOptions
from pliant.rendering.paths import SampledPath
from pliant.rendering.render import Renderer, SceneGeometry
from pliant.rendering.solids import Material, Scene, Solid

KINDS: dict[str, dict[str, Any]] = {
    "static camera, each on its own": {"neighbours": 0},
    "static camera, neighbours": {},
    "moving camera": {"camera": "moving"},
}
_LK: dict[str, Any] = {"winSize": (23, 23), "maxLevel": 2}
_STEPS_OF_A_ROUND = 18
_STEP_S = 1.0 / 30.0


def measure(source: str | None, frames: int, surfels: int) -> Iterator[str]:
    """Medians of CPU time over ``frames`` frames, one core, kernels compiled before.

    source: a folder with depth, or None for a board that moves 2 cm and 1 deg a frame.  Raises
    DatasetError where the first frame has no depth.
    """
    images, depth, camera = _board(frames + 1) if source is None else _film(source, frames + 1)
    rows: list[list[str]] = []
    stages: list[str] = []
    for kind, changes in KINDS.items():
        parameters = SurfelParameters(max_surfels=surfels, **changes)
        watch, spent, reference, counts = _run(parameters, images, depth, camera)
        total, lk = 1e3 * float(np.median(spent)), 1e3 * float(np.median(reference))
        rows.append([kind, f"{total:.1f}", f"{lk:.1f}", f"{lk / total:.2f}", f"{counts:.0f}"])
        parts = ", ".join(f"{stage} {watch.median_ms(stage):.1f}" for stage in watch.stages)
        stages.append(f"{kind}: {parts}")
    name = source or "a board at 1 m that moves 2 cm and 1 deg a frame"
    yield f"{name}, {camera.width}x{camera.height}, {len(images) - 1} frames, CPU time, one core:"
    header = ["surfels", "ms a frame", "LK 23x23, two ways, ms", "LK / surfels", "tracked"]
    yield markdown(header, rows)
    yield "stages, ms:"
    yield from stages


def _run(
    parameters: SurfelParameters, images: list[U8], depth: F64, camera: PinholeCamera
) -> tuple[Stopwatch, list[float], list[float], float]:
    warm = SurfelTracker(parameters)
    warm.start(images[0], depth, camera)
    warm.track(images[0], _STEP_S)
    tracker, watch = SurfelTracker(parameters), Stopwatch(time.process_time)
    last = tracker.start(images[0], depth, camera)
    spent: list[float] = []
    reference: list[float] = []
    counts: list[int] = []
    for before, image in pairwise(images):
        reference.append(_lucas_kanade_s(before, image, last.points_px))
        start = time.process_time()
        last = tracker.track(image, _STEP_S, timer=watch)
        spent.append(time.process_time() - start)
        watch.lap()
        counts.append(int(np.count_nonzero(last.state == SurfelState.TRACKED)))
    return watch, spent, reference, float(np.median(counts))


def _lucas_kanade_s(before: U8, after: U8, points: F32) -> float:
    start = time.process_time()
    there, _, _ = cv2.calcOpticalFlowPyrLK(before, after, points, None, **_LK)  # type: ignore[call-overload]
    cv2.calcOpticalFlowPyrLK(after, before, there, None, **_LK)  # type: ignore[call-overload]
    return time.process_time() - start


def _board(count: int) -> tuple[list[U8], F64, PinholeCamera]:
    """A rendered board; its relative motion goes round and round."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    for k in range(count):
        angle = 2.0 * np.pi * k / _STEPS_OF_A_ROUND
        turn = np.deg2rad(3.0) * np.array([np.sin(angle), np.cos(angle) - 1.0, 0.0])
        poses[k, :3, :3] = so3_exp(turn)
        shift = np.sin(angle), 0.25 * np.sin(2.0 * angle), np.cos(angle) - 1.0
        poses[k, :3, 3] = 0.06 * np.array(shift)
    board = Solid(
        name="board",
        kind="box",
        centre=(0.0, 0.0, 1.05),
        size=(3.0, 3.0, 0.1),
        rotation=(0.0, 0.3, 0.0),
        material=Material(brightness=120, contrast=40, noise=6, coverage=0.25, writing=0.3),
        texels_per_metre=400.0,
    )
    geometry = SceneGeometry(Scene(name="board", solids=(board,), lights=((0.3, -0.5, -0.5),)))
    options = CameraOptions(blur=0.0, exposure=0.0)
    path = SampledPath(times_s=np.arange(count, dtype=np.float64), poses=matrix_to_pose(poses))
    renderer = Renderer(geometry, paint_faces(geometry), path, options)
    film = [renderer.frame(number, float(number)) for number in range(count)]
    return [frame.image for frame in film], film[0].depth_m, options.pinhole()


def _film(source: str, count: int) -> tuple[list[U8], F64, PinholeCamera]:
    dataset = open_source(SourceSpec(location=source, depth="first"))
    rectifier, depths = Rectifier(dataset.calibration), DepthRectifier(dataset.calibration)
    images: list[U8] = []
    depth: F64 | None = None
    for frame in dataset:
        if len(images) == count:
            break
        if depth is None:
            if not frame.depth:
                raise DatasetError(f"{source}: its first frame has no depth map")
            depth = depths.rectify(frame.index, frame.depth)
        images.append(rectifier.rectify(frame)[0])
    if depth is None or len(images) < 2:
        raise DatasetError(f"{source}: fewer than two frames")
    return images, depth, rectifier.camera
