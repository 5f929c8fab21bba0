"""A map that deforms (``deforming_map.npz``) compared with exact ground truth.

Each landmark is judged by the material point at its pixel in the first keyframe that tracks it, in
every keyframe that tracks it.  World and unit are those of the first keyframe: its camera, and the
median of the true depths of its landmarks.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pliant.algorithms.arrays import F64
from pliant.algorithms.geometry import inverse, transform
from pliant.algorithms.meshing.delaunay import triangulate
from pliant.algorithms.meshing.rendering import render_depth
from pliant.evaluation.surface_truth import MaterialPoints, SurfaceTruth
from pliant.evaluation.surfel_truth import rmse

_VIEW = 0.7
"""Half side of the view whose landmarks make the mesh, in sides of the image."""
_STEP_PX = 8
"""Between the pixels at which the mesh is compared."""


@dataclass(frozen=True)
class DeformingMapErrors:
    """Shares of the depth.

    whole, median: of landmarks in the world.    in_camera: RMSE in the frame of the camera.
    rest: RMSE in the world if each landmark stayed at its rest place.
    camera: RMSE of its position.    covered: share of the image within the mesh of the landmarks.
    surface: median error of that mesh along the rays of the pixels.
    """

    keyframes: int
    landmarks: int
    whole: float
    median: float
    in_camera: float
    rest: float
    camera: float
    covered: float
    surface: float


def judge_deforming_map(file: Path, truth: SurfaceTruth) -> DeformingMapErrors:
    """Errors over all keyframes."""
    with np.load(file, allow_pickle=False) as content:
        found = {name: content[name] for name in content.files}
    frames, pixels = found["frames"].tolist(), found["points_px"].astype(np.float64)
    tracked = np.isfinite(pixels).all(axis=2)
    points = _material(truth, frames, pixels, tracked)
    T, T_true = found["T_world_camera"], truth.T_world_camera[frames]
    moved = found["displacements"][:, found["carriers"]]
    positions = found["rest"] + np.einsum("lj,kljc->klc", found["weights"], moved)
    exact = np.stack([truth.positions(points, frame) for frame in frames])
    exact_camera = np.stack([transform(inverse(T_true[k]), exact[k]) for k in range(len(frames))])
    in_camera = np.stack([transform(inverse(T[k]), positions[k]) for k in range(len(frames))])
    tracked &= np.isfinite(exact).all(axis=2)
    depth = exact_camera[:, :, 2:3]
    first = tracked[0]
    unit = float(np.median(depth[0, first, 0] / in_camera[0, first, 2]))
    # World to the true world, by the first camera.
    R = T_true[0, :3, :3] @ T[0, :3, :3].T

    def in_world(points: F64) -> F64:
        return unit * (points - T[0, :3, 3]) @ R.T + T_true[0, :3, 3]

    errors = ((in_world(positions) - exact) / depth)[tracked]
    still = ((in_world(found["rest"])[None] - exact) / depth)[tracked]
    camera = in_world(T[:, :3, 3]) - T_true[:, :3, 3]
    surface = [_mesh_errors(truth, frame, unit * in_camera[k]) for k, frame in enumerate(frames)]
    return DeformingMapErrors(
        keyframes=len(frames),
        landmarks=len(found["rest"]),
        whole=rmse(errors),
        median=float(np.median(np.linalg.norm(errors, axis=1))),
        in_camera=rmse(((unit * in_camera - exact_camera) / depth)[tracked]),
        rest=rmse(still),
        camera=rmse(camera) / float(depth[tracked].mean()),
        covered=float(np.mean([len(errors) / count for errors, count in surface])),
        surface=float(np.median(np.concatenate([errors for errors, _ in surface]))),
    )


def format_deforming_map(errors: DeformingMapErrors) -> str:
    """One line."""
    e = errors
    return (
        f"final map: {e.landmarks} landmarks in {e.keyframes} keyframes; RMSE {e.whole:.2%} of the "
        f"depth in the world (median {e.median:.2%}; at rest {e.rest:.2%}), {e.in_camera:.2%} in "
        f"the frame of the camera; camera {e.camera:.2%}; mesh over {e.covered:.1%} of the image, "
        f"median error {e.surface:.2%}"
    )


def _material(
    truth: SurfaceTruth, frames: list[int], pixels: F64, tracked: np.ndarray
) -> MaterialPoints:
    """Where each landmark was tracked first."""
    first = np.argmax(tracked, axis=0)
    sheet, where = np.full(len(first), -1, np.int32), np.zeros((len(first), 2))
    for k, frame in enumerate(frames):
        mine = first == k
        found = truth.at_pixels(frame, pixels[k, mine])
        sheet[mine], where[mine] = found.sheet, found.where
    return MaterialPoints(sheet, where)


def _mesh_errors(truth: SurfaceTruth, frame: int, in_camera: F64) -> tuple[F64, int]:
    """Relative errors of depth where a Delaunay mesh covers the pixels, and the count of pixels.

    in_camera: (L, 3) landmarks.  Those in view, also a little outside of the image, tracked or not,
    are joined.
    """
    camera = truth.camera
    front = in_camera[in_camera[:, 2] > 0.0]
    points_px, depths = camera.project(front), front[:, 2]
    size = np.array([camera.width, camera.height])
    near = (np.abs(points_px - 0.5 * size) < _VIEW * size).all(axis=1)
    points_px, depths = points_px[near], depths[near]
    found = triangulate(points_px)
    triangles = found.vertices[found.triangles].astype(np.int32)
    at, inverse_depths = points_px.astype(np.float32), (1.0 / depths).astype(np.float32)
    whole = render_depth(triangles, at, inverse_depths, np.zeros_like(inverse_depths), camera)
    rendered = whole.depths[::_STEP_PX, ::_STEP_PX]
    rows, columns = np.mgrid[0 : camera.height : _STEP_PX, 0 : camera.width : _STEP_PX]
    grid = np.stack([columns.ravel(), rows.ravel()], axis=1).astype(np.float64)
    exact = truth.depths(frame, grid)
    covered = (rendered.ravel() > 0.0) & (exact > 0.0)
    return np.abs(rendered.ravel()[covered] / exact[covered] - 1.0), len(grid)
