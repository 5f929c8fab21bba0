"""The scale of a map from a length that is known, and from depth maps that came with the source."""

from collections.abc import Sequence

import numpy as np

from pliant.algorithms.arrays import F64
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import inverse, pose_to_matrix, transform
from pliant.algorithms.rectification import rectified_camera
from pliant.datasets import open_source
from pliant.datasets.base import BrokenFrame
from pliant.datasets.depth import DepthRectifier
from pliant.datasets.source_spec import SourceSpec
from pliant.errors import ResultError
from pliant.export.images import camera_of
from pliant.recording.reader import Recording
from pliant.results.known_scale import Scale
from pliant.results.mesh_files import mesh_of
from pliant.results.run import Run, seen_by_keyframes
from pliant.wording import counted

_LEAST_DEPTHS = 100
_TO_SIGMA = 1.4826
"""Standard deviation of a normal distribution by its median absolute deviation."""
_FAR = 0.1
"""From all of the map, as a share of the spread of its points: no place of it."""


def from_points(run: Run, a: Sequence[float], b: Sequence[float], metres: float) -> Scale:
    """By two points of the map, in its units, that are so far apart.  Raises ResultError.

    Who picked them knows how well: the sigma is 0.
    """
    apart = float(np.linalg.norm(np.subtract(a, b)))
    if not 0.0 < apart < np.inf:
        raise ResultError("--points: the two points are identical: choose others")
    if not 0.0 < metres < np.inf:
        raise ResultError(f"{metres:g} metres: expected a positive length")
    _check_mapped(run, a, b)
    text = f"two points {metres:g} m apart"
    return Scale(metres_per_unit=metres / apart, sigma=0.0, source=text)


def _check_mapped(run: Run, *places: Sequence[float]) -> None:
    """Raise ResultError for a place that is near no point of the map and no vertex of its mesh,
    which report.html picks, too: where there is little texture, it is far from all points."""
    longest = run.history.longest_segment()
    mapped: F64 = np.asarray(run.history.points_in(longest).positions, np.float64)
    spread = float(np.linalg.norm(mapped.std(axis=0)))
    mesh = mesh_of(run.mesh, longest)
    if mesh is not None:
        mapped = np.concatenate([mapped, mesh.positions.astype(np.float64)])
    for place in places:
        off = float(np.linalg.norm(mapped - np.asarray(place), axis=1).min(initial=np.inf))
        if off > _FAR * spread:
            text = ",".join(f"{value:g}" for value in place)
            raise ResultError(
                f"--points: {text} is outside of the map, whose nearest point is {off:.3g} away: "
                "pick both in report.html"
            )


def from_depth(recording: Recording, run: Run, source: str) -> Scale:
    """By the depth maps of the run's source, or of another with the same images and stamps.

    Each keyframe gives a ratio, the median of measured depth by that of the map over the points
    that it sees; the scale is the median of these, its sigma their spread, as all share the errors
    of a sensor.  Raises PliantError.
    """
    dataset = open_source(SourceSpec(location=source, depth="all"))
    depths, camera = DepthRectifier(dataset.calibration), rectified_camera(dataset.calibration.lens)
    stream = camera_of(recording)
    history, longest = run.history, run.history.longest_segment()
    frames = {
        history.stamps_ns[keyframe.frame]: number
        for number, keyframe in history.keyframes.items()
        if keyframe.segment == longest and keyframe.frame in history.stamps_ns
    }
    seen = seen_by_keyframes(recording, set(frames.values()))
    ratios: list[float] = []
    for frame in dataset:
        number = frames.get(frame.stamp_ns, -1)
        if number not in seen or not frame.depth:
            continue
        try:
            depth = depths.rectify(frame.index, frame.depth)
        except BrokenFrame:
            continue
        rows, points = history.points_of(seen[number].point_ids)
        T_camera_world = inverse(pose_to_matrix(history.keyframes[number].pose_world_camera))
        z = transform(T_camera_world, points.positions)[:, 2]
        rays = stream.camera.normalise(np.asarray(seen[number].points_px[rows], np.float64))
        ratio = _ratio(depth, camera, rays, z)
        if ratio is not None:
            ratios.append(ratio)
    if not ratios:
        raise ResultError(f"{source}: no depth map covers the points of a keyframe")
    logs = np.log(ratios)
    middle = float(np.median(logs))
    sigma = _TO_SIGMA * float(np.median(np.abs(logs - middle)))
    text = f"depth maps of {counted(len(logs), 'keyframe')}"
    return Scale(metres_per_unit=float(np.exp(middle)), sigma=sigma, source=text)


def _ratio(depth: F64, camera: PinholeCamera, rays: F64, z: F64) -> float | None:
    """Measured depths (H, W) by those of points (N,) on rays (N, 2), where enough were measured."""
    pixels = camera.project(np.column_stack([rays, np.ones(len(z))]))
    u, v = np.rint(pixels).astype(np.int64).T
    shown = (z > 0.0) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    measured = depth[v[shown], u[shown]]
    if np.count_nonzero(measured) < _LEAST_DEPTHS:
        return None
    return float(np.median((measured / z[shown])[measured > 0.0]))
