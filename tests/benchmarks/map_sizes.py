"""The adjustment of a whole map: time and memory by its size."""

import resource
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context

import numpy as np

from benchmarks.table import markdown_header, markdown_row
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import inverse, so3_exp
from pliant.algorithms.slam.adjust.final_adjustment import ObservationList, adjust_list
from pliant.algorithms.slam.calibration.self_calibration import SelfCalibration
from pliant.algorithms.slam.parameters import MappingParameters

_CAMERA = PinholeCamera(width=640, height=480, fx=600.0, fy=600.0, cx=319.5, cy=239.5)


def measure(keyframes: Sequence[int], points: int, seen: int) -> Iterator[str]:
    """One row for each number of keyframes, each in a process of its own.

    points: new ones in each keyframe.   seen: keyframes that see each, from its first on.
    """
    yield markdown_header(
        (
            "keyframes",
            "points",
            "observations",
            "iterations",
            "CPU s",
            "peak MiB",
            "before",
        )
    )
    for count in keyframes:
        with ProcessPoolExecutor(1, get_context("spawn")) as alone:
            yield markdown_row(alone.submit(_row, count, points, seen).result())


def _row(keyframes: int, points: int, seen: int) -> tuple[str, ...]:
    parameters = MappingParameters()
    known = SelfCalibration.of(_CAMERA, parameters.calibration)
    whole = _map(keyframes, points, seen)

    def adjust(listed: ObservationList, iterations: int) -> int:
        found = adjust_list(listed, known, parameters, iterations=iterations, start=known.in_use)
        return found.iterations

    adjust(_map(10, points, seen), 2)  # compiles
    before, start = _peak_mib(), time.process_time()
    iterations = adjust(whole, parameters.window.final_iterations)
    spent = time.process_time() - start
    sizes = (str(keyframes), str(len(whole.rows)), str(len(whole.point)), str(iterations))
    return (*sizes, f"{spent:.1f}", f"{_peak_mib():.0f}", f"{before:.0f}")


def _peak_mib() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


def _map(keyframes: int, points: int, seen: int) -> ObservationList:
    """A camera goes sideways past points 2 to 8 units away, with noise of half a pixel; its scale
    has drifted by 5 %, and poses are off by 2 mrad."""
    generator = np.random.default_rng(0)
    index, count = np.arange(keyframes), keyframes * points
    T = np.tile(np.eye(4), (keyframes, 1, 1))
    turns = np.stack([0.01 * np.sin(index), 0.006 * np.sin(0.05 * index), 0.005 * np.sin(index)])
    T[:, :3, :3] = so3_exp(turns.T)
    T[:, 0, 3], T[:, 1, 3] = 0.1 * index, 0.02 * np.sin(index)
    first = np.repeat(index, points)
    depth = generator.uniform(2.0, 8.0, count)
    px = generator.uniform(0.0, 1.0, (count, 2)) * (_CAMERA.width, _CAMERA.height)
    rays = np.concatenate([_CAMERA.normalise(px), np.ones((count, 1))], axis=1) * depth[:, None]
    xyz = np.einsum("nij,nj->ni", T[first, :3, :3], rays) + T[first, :3, 3]
    listed = [np.arange(max(0, k - seen + 1) * points, (k + 1) * points) for k in index]
    camera = np.repeat(index, [len(some) for some in listed]).astype(np.int32)
    at = [
        _CAMERA.project(xyz[some] @ pose[:3, :3].T + pose[:3, 3])
        for some, pose in zip(listed, inverse(T), strict=True)
    ]
    seen_px = np.concatenate(at)
    seen_px += generator.normal(0.0, 0.5, seen_px.shape)
    drift = 1.0 + np.linspace(0.0, 0.05, keyframes)[:, None]
    start = T.copy()
    start[:, :3, 3] *= drift
    start[1:, :3, :3] @= so3_exp(generator.normal(0.0, 0.002, (keyframes - 1, 3)))
    found = ObservationList(
        rows=np.arange(count, dtype=np.int32),
        xyz=xyz * drift[first],
        T_world_camera=start,
        camera=camera,
        point=np.concatenate(listed).astype(np.int32),
        px=seen_px.astype(np.float32),
        weights=np.ones(len(camera), np.float32),
        fixed=index == 0,
    )
    return replace(found, flow=generator.normal(0.0, 1.0, found.px.shape).astype(np.float32))
