"""Time of tracking per frame and stage, beside OpenCV's pyramidal LK on the same points."""

import time
from collections.abc import Iterator

import cv2
import numpy as np

from benchmarks.stopwatch import Stopwatch
from benchmarks.table import markdown
from pliant.algorithms.tracking.tracker import ExtremaTracker
from pliant.config import Config
from pliant.datasets import open_source
from pliant.datasets.rectifier import Rectifier, rectified

_WARM_FRAMES = 15
_LK = {"winSize": (21, 21), "maxLevel": 3}


def measure(source: str, config: Config, frames: int) -> Iterator[str]:
    """Track ``frames`` frames on one core and print medians."""
    dataset = open_source(source)
    rectifier = Rectifier(dataset.calibration)
    camera = rectifier.camera
    tracker = ExtremaTracker(camera.width, camera.height, config.tracking, config.seed)
    watch = Stopwatch()
    totals: list[float] = []
    lk_ms: list[float] = []
    counts: list[int] = []
    previous, points = None, np.zeros((0, 2), np.float32)
    for number, frame in enumerate(dataset):
        if number >= frames + _WARM_FRAMES:
            break
        image = rectified(frame, rectifier)
        if image.missing:
            continue
        warm = number >= _WARM_FRAMES
        start = time.perf_counter()
        tracks = tracker.track(image.grey, image.stamp_ns, watch)
        spent = time.perf_counter() - start
        if warm:
            totals.append(spent)
            counts.append(len(tracks.ids))
            watch.lap()
            lk_ms.append(_lucas_kanade_ms(previous, image.grey, points))
        else:
            watch.lap()
            watch.laps.clear()
        previous, points = image.grey, tracks.points_px
    total = 1e3 * float(np.median(totals))
    rows = [[stage, f"{watch.median_ms(stage):.2f}"] for stage in watch.stages]
    rows += [
        ["**tracking, all**", f"**{total:.2f}**"],
        ["OpenCV pyramidal LK 21x21, forward and backward", f"{np.median(lk_ms):.1f}"],
    ]
    yield f"{source}, {camera.width}x{camera.height}, median of {len(totals)} frames, one core:"
    yield f"{np.median(counts):.0f} tracks, {len(tracks.maxima)} maxima in the last frame"
    yield markdown(["stage", "ms a frame"], rows)
    yield f"ratio LK / tracking: {np.median(lk_ms) / total:.1f}"


def _lucas_kanade_ms(before: np.ndarray | None, after: np.ndarray, points: np.ndarray) -> float:
    start = time.perf_counter()
    there, _, _ = cv2.calcOpticalFlowPyrLK(before, after, points, None, **_LK)
    cv2.calcOpticalFlowPyrLK(after, before, there, None, **_LK)
    return 1e3 * (time.perf_counter() - start)
