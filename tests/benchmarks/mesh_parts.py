"""The parts of meshing on one synthetic keyframe: time beside the paper's, and what NLTGV gains."""

import time
from collections.abc import Callable, Iterator
from typing import TypeVar

import numpy as np

from benchmarks.smoothing_scene import Scene, make_scene, rmse
from benchmarks.table import markdown
from pliant.algorithms.arrays import F32, F64
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.meshing.delaunay import triangulate
from pliant.algorithms.meshing.keyframe_surface import filter_triangles
from pliant.algorithms.meshing.mesh_blocks import BlockMesh
from pliant.algorithms.meshing.nltgv import NltgvResult, smooth
from pliant.algorithms.meshing.parameters import (
    NltgvParameters,
    TriangleFilterParameters,
    TsdfParameters,
)
from pliant.algorithms.meshing.rendering import DepthMap, render_depth
from pliant.algorithms.meshing.tsdf_volume import TsdfVolume
from pliant_services.nodes.meshing import warm_up

_CAMERA = PinholeCamera(width=640, height=480, fx=525.0, fy=525.0, cx=319.5, cy=239.5)
_MANY_SEEN = 9
_NEAR_PX = 3.0
_BASELINE = 0.02
"""Between two keyframes, in median depths."""
_Result = TypeVar("_Result")


def measure(vertices: int = 10_000, repeats: int = 10, seeds: int = 8) -> Iterator[str]:
    """Least CPU time of all threads over the repeats, then errors over the seeds."""
    warm_up()
    scene = make_scene(vertices, 0)
    delaunay, _ = _least_ms(lambda: triangulate(scene.points_px), repeats)
    nltgv, smoothed = _least_ms(lambda: _smooth(scene), repeats)
    camera, count = _CAMERA, np.full(len(scene.data), _MANY_SEEN, np.int32)

    def render() -> DepthMap:
        kept = filter_triangles(
            scene.mesh.triangles, scene.points_px, smoothed.inverse_depths, scene.sigmas, count,
            camera, TriangleFilterParameters(),
        )  # fmt: skip
        return render_depth(
            scene.mesh.triangles[kept], scene.points_px, smoothed.inverse_depths, scene.sigmas,
            camera,
        )  # fmt: skip

    rendering, depth_map = _least_ms(render, repeats)
    rows = [
        ["Delaunay", f"{delaunay:.1f}", ""],
        [f"NLTGV, {smoothed.iterations} iterations", f"{nltgv:.1f}", ""],
        ["Delaunay + NLTGV", f"{delaunay + nltgv:.1f}", "45"],
        ["depth map", f"{rendering:.1f}", ""],
    ]
    rows += _volumes(depth_map, 1.0 / float(np.median(scene.true)), repeats)
    header = [f"640x480, {len(scene.data)} vertices, CPU ms", "ours", "paper"]
    yield markdown(header, rows)
    yield ""
    yield from _gains(vertices, seeds)


def _smooth(scene: Scene) -> NltgvResult:
    return smooth(scene.points_px, scene.data, scene.sigmas, scene.mesh.edges, NltgvParameters())


def _volumes(depth_map: DepthMap, median_depth: float, repeats: int) -> Iterator[list[str]]:
    """Rows of both resolutions: keyframes side by side, the first not counted.

    Every keyframe is taken in and what it changed is meshed again.
    """
    parameters = TsdfParameters()
    colour = np.full((*depth_map.depths.shape, 3), 128, np.uint8)
    sizes = (("coarse", parameters.coarse_voxel, "175"), ("fine", parameters.fine_voxel, "4000"))
    for name, size, paper in sizes:
        volume = TsdfVolume(size * median_depth, parameters)
        held = BlockMesh()
        update, extraction = [], []
        for k in range(repeats + 1):
            pose = np.eye(4)
            pose[0, 3] = k * _BASELINE * median_depth
            start = time.process_time()
            sight = volume.integrate(depth_map.depths, depth_map.weights, colour, _CAMERA, pose)
            middle = time.process_time()
            held.apply(held.changes(volume.extract(volume.affected(sight.keys))))
            update.append(1e3 * (middle - start))
            extraction.append(1e3 * (time.process_time() - middle))
        both = min(np.add(update, extraction)[1:])
        yield [f"{name} TSDF: update", f"{min(update[1:]):.1f}", ""]
        yield [f"{name} TSDF: marching cubes, changes", f"{min(extraction[1:]):.1f}", ""]
        yield [f"{name} TSDF: both", f"{both:.1f}", paper]


def _gains(vertices: int, seeds: int) -> Iterator[str]:
    """Errors of inverse depth with 10 % outliers, medians over scenes."""
    kinds: dict[str, Callable[[Scene], F32]] = {
        "none": lambda scene: scene.data,
        "NLTGV": lambda scene: _smooth(scene).inverse_depths,
    }
    scenes = [make_scene(vertices, seed) for seed in range(seeds)]
    raw = [rmse(scene.data - scene.true) for scene in scenes]
    rows = []
    for name, smoothed in kinds.items():
        errors = [smoothed(scene) - scene.true for scene in scenes]
        gain = np.divide(raw, [rmse(error) for error in errors])
        at_steps = [_at_steps(scene, error) for scene, error in zip(scenes, errors, strict=True)]
        median, high = np.median(at_steps, axis=0)
        rows.append([
            name, f"{np.median([rmse(error) for error in errors]):.4f}", f"{np.median(gain):.2f}",
            f"{gain.min():.2f}", f"{median:.2f}", f"{high:.2f}",
        ])  # fmt: skip
    yield markdown(
        ["smoothing", "RMSE", "times smaller", "the least", "median at steps", "95 % at steps"],
        rows,
    )
    yield (
        f"{seeds} scenes, 10 % outliers; at steps: the error within {_NEAR_PX:.0f} px of a step "
        "over that elsewhere, the median of all and the 95th percentile of those with good data"
    )


def _at_steps(scene: Scene, error: F64) -> tuple[float, float]:
    near, size, good = scene.distance_px < _NEAR_PX, np.abs(error), ~scene.outliers
    high = np.quantile(size[near & good], 0.95) / np.quantile(size[~near & good], 0.95)
    return float(np.median(size[near]) / np.median(size[~near])), float(high)


def _least_ms(function: Callable[[], _Result], repeats: int) -> tuple[float, _Result]:
    result, times = function(), []
    for _ in range(repeats):
        start = time.process_time()
        result = function()
        times.append(time.process_time() - start)
    return 1e3 * min(times), result
