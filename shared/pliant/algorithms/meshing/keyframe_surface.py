"""The surface that one keyframe sees: from its points to a depth map (VITAMIN-E, section 4)."""

import math
from dataclasses import dataclass

import numpy as np

from pliant.algorithms.arrays import F32, F64, I32, I64, BoolArray
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import inverse
from pliant.algorithms.meshing.delaunay import Triangulation, triangulate
from pliant.algorithms.meshing.nltgv import NltgvResult, NltgvStart, carry_duals, smooth
from pliant.algorithms.meshing.parameters import SurfaceParameters, TriangleFilterParameters
from pliant.algorithms.meshing.rendering import DepthMap, DrawnTriangles
from pliant.algorithms.stages import StageTimer, no_stages
from pliant.compiler.kernel import kernel

_MAX_ERROR_PX = 2.0
"""Maximum reprojection error of a landmark that is used."""
_MAX_RELATIVE_SIGMA = 0.1
"""Of the inverse depth of a triangle's corner."""
_MIN_POINTS = 3
_MIN_SHARED = 0.3
"""Share of the vertices that must live on for the last surface to be worth starting from."""
_MAX_DIFFERENCE = 0.2
"""Share of the inverse depth by which the last surface may differ from a point that it meets."""


@dataclass(frozen=True, kw_only=True)
class SeenPoints:
    """The points that a keyframe observes, in ascending order of their ids.

    ids: (N,).    points_px: (N, 2) where they are seen.    points_world: (N, 3).
    sigmas: (N,) standard deviation along the ray for a noise of 1 px, as a share of the depth.
    keyframes: (N,) how many keyframes observe each.
    """

    ids: I64
    points_px: F32
    points_world: F64
    sigmas: F32
    keyframes: I32


@dataclass(frozen=True, kw_only=True)
class Surface:
    """A keyframe's depth map, or why there is none.

    drawn: what it shows.    problem: "" or one line.    vertices, triangles, iterations: of its
    mesh and of NLTGV.    median_depth: of its vertices, 0 without any.
    """

    depth_map: DepthMap | None
    drawn: DrawnTriangles | None = None
    problem: str = ""
    vertices: int = 0
    triangles: int = 0
    iterations: int = 0
    median_depth: float = 0.0


@dataclass(frozen=True)
class _Last:
    """The last surface.  planes: (M, 3) n with n . X = 1 in its camera, at each vertex."""

    ids: I64
    T_world_camera: F64
    planes: F64
    duals: F32
    edges: I32


class KeyframeSurfaces:
    """Makes surfaces one after the other, each starting from the last where points live on."""

    def __init__(self, camera: PinholeCamera, parameters: SurfaceParameters) -> None:
        self._camera = camera
        self._parameters = parameters
        self._last: _Last | None = None

    def surface(
        self,
        T_world_camera: F64,
        points: SeenPoints,
        timer: StageTimer = no_stages,
    ) -> Surface:
        """The surface of a keyframe at its pose."""
        if not np.isfinite(T_world_camera).all():
            return Surface(depth_map=None, problem="its pose is not finite")
        points, inverses = self._in_front(T_world_camera, points)
        if len(inverses) < _MIN_POINTS:
            return Surface(depth_map=None, problem=f"{len(inverses)} points with depth")
        with timer("triangulation"):
            mesh = triangulate(points.points_px)
        if len(mesh.triangles) == 0:
            return Surface(depth_map=None, problem="its points lie on one line")
        rows = mesh.vertices
        pixels, data = points.points_px[rows], inverses[rows]
        sigmas = points.sigmas[rows] * np.float32(self._parameters.noise_px) * data
        with timer("smoothing"):
            smoothed, iterations = self._smooth(
                T_world_camera, points.ids[rows], pixels, data, sigmas, mesh
            )
        with timer("rasterisation"):
            kept = filter_triangles(
                mesh.triangles, pixels, smoothed, sigmas, points.keyframes[rows],
                self._camera, self._parameters.triangles,
            )  # fmt: skip
            drawn = DrawnTriangles(mesh.triangles[kept], pixels, smoothed, sigmas)
            depth_map = drawn.depth_map(self._camera)
        count = int(np.count_nonzero(kept))
        return Surface(
            depth_map=depth_map if count else None,
            drawn=drawn if count else None,
            problem="" if count else "none of its triangles is surface",
            vertices=len(rows),
            triangles=count,
            iterations=iterations,
            median_depth=float(1.0 / np.median(data)),
        )

    def _in_front(self, T_world_camera: F64, points: SeenPoints) -> tuple[SeenPoints, F32]:
        """The points that can be where they are seen, and their inverse depths."""
        in_camera = (points.points_world - T_world_camera[:3, 3]) @ T_world_camera[:3, :3]
        with np.errstate(all="ignore"):
            inverses = 1.0 / in_camera[:, 2]
            error = self._camera.project(in_camera) - points.points_px
            good = (inverses > 0.0) & (np.square(error).sum(axis=1) < _MAX_ERROR_PX**2)
        good &= np.isfinite(inverses) & np.isfinite(points.sigmas) & (points.sigmas > 0.0)
        rows = np.flatnonzero(good)
        chosen = SeenPoints(
            ids=points.ids[rows],
            points_px=points.points_px[rows],
            points_world=points.points_world[rows],
            sigmas=points.sigmas[rows],
            keyframes=points.keyframes[rows],
        )
        return chosen, inverses[rows].astype(np.float32)

    def _smooth(
        self, T: F64, ids: I64, pixels: F32, data: F32, sigmas: F32, mesh: Triangulation
    ) -> tuple[F32, int]:
        begin = self._start(T, ids, pixels, data, mesh.edges)
        result = smooth(pixels, data, sigmas, mesh.edges, self._parameters.nltgv, begin)
        self._keep(ids, T, pixels, result, mesh.edges)
        return result.inverse_depths, result.iterations

    def _start(self, T: F64, ids: I64, pixels: F32, data: F32, edges: I32) -> NltgvStart | None:
        """The last surface where its vertices live on, as it looks from here."""
        if self._last is None:
            return None
        last = self._last
        _, new, old = np.intersect1d(ids, last.ids, assume_unique=True, return_indices=True)
        if len(new) < _MIN_SHARED * len(ids):
            return None
        T_last_new = inverse(last.T_world_camera) @ T
        with np.errstate(all="ignore"):
            share = 1.0 / (1.0 - last.planes[old] @ T_last_new[:3, 3])
        planes = last.planes[old] @ T_last_new[:3, :3] * share[:, None]
        rays = np.concatenate([self._camera.normalise(pixels[new]), np.ones((len(new), 1))], axis=1)
        values = np.full(len(ids), np.nan, np.float32)
        slopes = np.full((len(ids), 2), np.nan, np.float32)
        values[new] = (planes * rays).sum(axis=1)
        slopes[new] = planes[:, :2] / (self._camera.fx, self._camera.fy)
        # Seen from elsewhere a vertex may lie behind the camera, or far off its point.
        with np.errstate(invalid="ignore"):
            wrong = ~(np.abs(values - data) < _MAX_DIFFERENCE * data)
        values[wrong], slopes[wrong] = np.nan, np.nan
        duals = carry_duals(
            last.duals, last.edges, last.ids.astype(np.int32), edges, ids.astype(np.int32)
        )
        return NltgvStart(values, slopes, duals)

    def _keep(self, ids: I64, T: F64, pixels: F32, result: NltgvResult, edges: I32) -> None:
        """Remember a surface: at each vertex the plane n . X = 1 in its camera, so that it can be
        seen from another one."""
        camera = self._camera
        planes = np.empty((len(ids), 3))
        planes[:, 0] = result.slopes[:, 0] * camera.fx
        planes[:, 1] = result.slopes[:, 1] * camera.fy
        rays = camera.normalise(pixels)
        planes[:, 2] = result.inverse_depths - (planes[:, :2] * rays).sum(axis=1)
        self._last = _Last(ids, T, planes, result.duals, edges)


def filter_triangles(
    triangles: I32,
    points_px: F32,
    inverse_depths: F32,
    sigmas: F32,
    observations: I32,
    camera: PinholeCamera,
    parameters: TriangleFilterParameters,
) -> BoolArray:
    """Which of the (T, 3) triangles to keep.

    points_px: (M, 2) vertices.    inverse_depths, sigmas: (M,) inverse depth along z and its
    standard deviation; not finite or not positive: the vertex is not used.    observations: (M,)
    frames that saw the vertex.
    """
    usable = (
        np.isfinite(points_px).all(axis=1)
        & np.isfinite(inverse_depths)
        & (inverse_depths > 0.0)
        & (sigmas <= _MAX_RELATIVE_SIGMA * inverse_depths)
        & (observations >= parameters.min_observations)
    )
    rays = np.ones((len(points_px), 3))
    rays[:, 0] = (points_px[:, 0] - camera.cx) / camera.fx
    rays[:, 1] = (points_px[:, 1] - camera.cy) / camera.fy
    points = rays / np.where(usable, inverse_depths, 1.0)[:, None]
    min_cosine = math.cos(math.radians(parameters.max_slant_deg))
    return _kept(
        triangles, points_px, points, usable,
        parameters.max_edge_px, parameters.max_depth_ratio, min_cosine,
    )  # fmt: skip


@kernel
def _kept(
    triangles: I32, pixels: F32, points: F64, usable: BoolArray,
    max_edge_px: float, max_ratio: float, min_cosine: float,
) -> BoolArray:  # fmt: skip
    kept = np.zeros(len(triangles), np.bool_)
    for t in range(len(triangles)):
        a, b, c = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        if not (usable[a] and usable[b] and usable[c]):
            continue
        longest = 0.0
        for i, j in ((a, b), (b, c), (c, a)):
            du, dv = pixels[j, 0] - pixels[i, 0], pixels[j, 1] - pixels[i, 1]
            longest = max(longest, du * du + dv * dv)
        if longest > max_edge_px * max_edge_px:
            continue
        near = min(points[a, 2], points[b, 2], points[c, 2])
        far = max(points[a, 2], points[b, 2], points[c, 2])
        if far > max_ratio * near:
            continue
        p, q, r = points[a], points[b], points[c]
        e0, e1, e2 = q[0] - p[0], q[1] - p[1], q[2] - p[2]
        f0, f1, f2 = r[0] - p[0], r[1] - p[1], r[2] - p[2]
        n0, n1, n2 = e1 * f2 - e2 * f1, e2 * f0 - e0 * f2, e0 * f1 - e1 * f0
        m0, m1, m2 = p[0] + q[0] + r[0], p[1] + q[1] + r[1], p[2] + q[2] + r[2]
        dot = abs(n0 * m0 + n1 * m1 + n2 * m2)
        norms = math.sqrt((n0 * n0 + n1 * n1 + n2 * n2) * (m0 * m0 + m1 * m1 + m2 * m2))
        kept[t] = norms > 0.0 and dot >= min_cosine * norms
    return kept
