"""A mesh against true depth maps: how much it covers, how well, and its surface and normals."""

from dataclasses import dataclass, field
from functools import cached_property

import cv2
import numpy as np

from pliant.algorithms.arrays import F32, F64, BoolArray
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.meshing.mesh_blocks import TriangleMesh
from pliant.algorithms.meshing.rendering import view_mesh
from pliant.evaluation.criteria import Similarity
from pliant.evaluation.surface_columns import SurfaceFigures, surface_columns
from pliant.evaluation.surface_distance import nearest, sample_surface, share_within, thin_out
from pliant.evaluation.visible_depth import DepthView

DEPTH_LIMIT = 0.05
SURFACE_LIMIT = 0.01
"""Share of the scene's diameter within which two surfaces are the same, for the F-score."""
_SPACING = 0.25
"""Distance of the samples of a surface, as a share of the limit."""
_PLANE_SHARE = 1 / 128
"""Of the width: how far the window reaches to each side whose plane is a smooth true normal."""
_PLANE_KNOWN = 0.9
"""Minimum share of such a window that is on one surface."""


@dataclass(frozen=True, kw_only=True)
class MeshTruth:
    """Figures of a mesh.  Pixels are those of all views together; NaN where there is nothing.

    covered: share of the true depth's pixels where the mesh has depth.    median_error: of the
    covered ones, relative.    within: share of the covered ones within 5 %.
    fitted_scale: the scale that makes depths fit best, over that of the trajectory; 1 is best.
    fitted_median_error, fitted_within: as above, with that scale.
    normal_deg: median angle to the true normal, away from jumps in depth.    plane_normal_deg: to
    that of planes fitted to the true depth.    truth_noise_deg: between these two, the noise of a
    depth camera, without which ``normal_deg`` means nothing.
    diameter_m: diagonal of the box about the true surface.    precision, recall, f_score: at 1 %
    of it, against the true surface that the views see.
    closed_covered, closed_median_error, closed_within: as above, with the scale that fits, of what
    closes holes alone; 0 where none is closed.
    """

    views: int
    triangles: int
    covered: float
    median_error: float
    within: float
    fitted_scale: float
    fitted_median_error: float
    fitted_within: float
    normal_deg: float
    plane_normal_deg: float
    truth_noise_deg: float
    diameter_m: float
    precision: float
    recall: float
    f_score: float
    closed_covered: float
    closed_median_error: float
    closed_within: float


@dataclass
class MeshEvaluation:
    """Compares view by view.

    alignment: from the world of the estimate to the true one; depths take its scale alone, as a
    view's own pose errors are those of the trajectory.    camera: of the true depth maps.
    """

    mesh: TriangleMesh
    alignment: Similarity
    camera: PinholeCamera
    _ratios: list[F32] = field(default_factory=list[F32])
    _closing: list[BoolArray] = field(default_factory=list[BoolArray])
    _angles: list[F32] = field(default_factory=list[F32])
    _plane_angles: list[F32] = field(default_factory=list[F32])
    _noise: list[F32] = field(default_factory=list[F32])
    _surface: list[F64] = field(default_factory=list[F64])
    _floor: list[F64] = field(default_factory=list[F64])
    _known: int = 0
    _views: int = 0

    def add(self, depth_m: F64, T_true: F64, T_estimate: F64) -> None:
        """One view: true depth (H, W), 0 where unknown, and T_world_camera in both worlds."""
        self._views += 1
        view = DepthView.of(self.camera, T_true, depth_m)
        seen = view_mesh(self.mesh.positions, self.mesh.triangles, self.camera, T_estimate)
        known = view.inverse_depth > 0.0
        both = known & (seen.depths > 0.0)
        depths = seen.depths * self.alignment.scale * view.inverse_depth
        self._ratios.append(depths[both].astype(np.float32))
        self._closing.append(self._closes_holes[seen.triangles[both]])
        self._known += int(known.sum())
        normals = seen.interpolate(self.mesh.triangles, self.mesh.normals) @ T_estimate[:3, :3]
        true, smooth = _true_normals(view)
        planes, flat = _plane_normals(view)
        for angles, a, b, where in (
            (self._angles, normals, true, smooth & both),
            (self._plane_angles, normals, planes, flat & both),
            (self._noise, planes, true, flat & smooth),
        ):
            angles.append(_angles_deg(a[where], b[where]))
        v, u = np.nonzero(known)
        rays = self.camera.normalise(np.stack([u, v], axis=1).astype(np.float64))
        points = np.concatenate([rays, np.ones((len(rays), 1))], axis=1)
        points /= view.inverse_depth[v, u][:, None]
        # Thinned at once: millions of pixels see the same surface.
        spacing = 1e-3 * float(np.median(1.0 / view.inverse_depth[v, u])) if len(v) else 1.0
        T_ours = self.alignment.apply_poses(T_estimate[None])[0]
        for kept, T in ((self._surface, T_true), (self._floor, T_ours)):
            kept.append(thin_out(points @ T[:3, :3].T + T[:3, 3], spacing))

    @cached_property
    def _closes_holes(self) -> BoolArray:
        """(F,) faces with a corner that closes a hole."""
        marked = np.zeros(len(self.mesh.positions), np.bool_)
        marked[self.mesh.closed] = True
        return np.asarray(marked[self.mesh.triangles].any(axis=1), np.bool_)

    def result(self) -> MeshTruth:
        """The figures over all views."""
        nan = float("nan")
        ratios = np.concatenate([np.zeros(0, np.float32), *self._ratios])
        scale = 1.0 / float(np.median(ratios)) if len(ratios) else nan
        errors, fitted = np.abs(ratios - 1.0), np.abs(ratios * scale - 1.0)
        closing = fitted[np.concatenate([np.zeros(0, np.bool_), *self._closing])]
        surface, diameter = self._true_surface()
        precision, recall = self._surfaces(surface, SURFACE_LIMIT * diameter)
        both = precision + recall
        return MeshTruth(
            views=self._views,
            triangles=len(self.mesh.triangles),
            covered=len(ratios) / self._known if self._known else nan,
            median_error=float(np.median(errors)) if len(errors) else nan,
            within=float(np.mean(errors <= DEPTH_LIMIT)) if len(errors) else nan,
            fitted_scale=scale,
            fitted_median_error=float(np.median(fitted)) if len(fitted) else nan,
            fitted_within=float(np.mean(fitted <= DEPTH_LIMIT)) if len(fitted) else nan,
            normal_deg=_median_of(self._angles),
            plane_normal_deg=_median_of(self._plane_angles),
            truth_noise_deg=_median_of(self._noise),
            diameter_m=diameter,
            precision=precision,
            recall=recall,
            f_score=2.0 * precision * recall / both if both > 0.0 else 0.0,
            closed_covered=len(closing) / self._known if self._known else 0.0,
            closed_median_error=float(np.median(closing)) if len(closing) else 0.0,
            closed_within=float(np.mean(closing <= DEPTH_LIMIT)) if len(closing) else 0.0,
        )

    def columns(self) -> dict[str, SurfaceFigures]:
        """The surface in the form that benchmarks compare; empty without one."""
        surface, diameter = self._true_surface()
        if len(surface) == 0 or len(self.mesh.triangles) == 0:
            return {}
        spacing = _SPACING * SURFACE_LIMIT * diameter
        samples, floor = self._samples(spacing), np.concatenate(self._floor)
        samples, floor, true = (thin_out(each, spacing) for each in (samples, floor, surface))
        return surface_columns(samples, floor, true, diameter)

    def distances(self, most: float) -> tuple[F64, float]:
        """(V,) of the vertices to the true surface, infinite beyond a share ``most`` of the
        diameter; and the diameter, metres."""
        surface, diameter = self._true_surface()
        if len(surface) == 0:
            return np.full(len(self.mesh.positions), np.inf), diameter
        true = thin_out(surface, _SPACING * SURFACE_LIMIT * diameter)
        return nearest(self._placed(), true, most * diameter)[1], diameter

    def _true_surface(self) -> tuple[F64, float]:
        """(N, 3) and its diameter."""
        surface = np.concatenate([np.zeros((0, 3)), *self._surface])
        extent = float(np.linalg.norm(np.ptp(surface, axis=0))) if len(surface) else float("nan")
        return surface, extent

    def _placed(self) -> F64:
        return self.alignment.apply(self.mesh.positions.astype(np.float64))

    def _samples(self, spacing: float) -> F64:
        return sample_surface(self._placed(), self.mesh.triangles, spacing)

    def _surfaces(self, true: F64, limit: float) -> tuple[float, float]:
        if len(true) == 0 or len(self.mesh.triangles) == 0:
            return 0.0, 0.0
        spacing = _SPACING * limit
        samples, true = self._samples(spacing), thin_out(true, spacing)
        precision = share_within(samples, true, limit)
        return precision, share_within(true, thin_out(samples, spacing), limit)


def format_mesh(truth: MeshTruth) -> str:
    """Four lines, ready to print, and one more where holes were closed."""
    t = truth
    closed = (
        f"\nclosed holes: {100 * t.closed_covered:.1f} % of the true depth; scaled to fit best: "
        f"median {100 * t.closed_median_error:.2f} %, {100 * t.closed_within:.1f} % within 5 %"
    )
    return (
        f"mesh in {t.views} keyframes: {100 * t.covered:.1f} % of the true depth covered, "
        f"{t.triangles} triangles\n"
        f"relative error of depth: median {100 * t.median_error:.2f} %, "
        f"{100 * t.within:.1f} % within 5 %; with depths scaled by {t.fitted_scale:.4f} to fit "
        f"best: median {100 * t.fitted_median_error:.2f} %, {100 * t.fitted_within:.1f} %\n"
        f"normals: median angle to ground truth {t.normal_deg:.1f} deg; to its planes "
        f"{t.plane_normal_deg:.1f} deg, from which ground truth itself is {t.truth_noise_deg:.1f} "
        "deg off\n"
        f"surface within 1 % of the diameter ({t.diameter_m:.2f} m): F-score {t.f_score:.3f}, "
        f"precision {t.precision:.3f}, recall {t.recall:.3f}"
        + (closed if t.closed_covered > 0.0 else "")
    )


def _unit(vectors: F32 | F64) -> F64:
    lengths = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(vectors / np.maximum(lengths, 1e-12), np.float64)


def _angles_deg(a: F64, b: F64) -> F32:
    """(N,) between vectors (N, 3) and unit vectors (N, 3), degrees."""
    cosines = np.clip((_unit(a) * b).sum(axis=1), -1.0, 1.0)
    return np.degrees(np.arccos(cosines)).astype(np.float32)


def _median_of(angles: list[F32]) -> float:
    """NaN where there are none."""
    every = np.concatenate([np.zeros(0, np.float32), *angles])
    return float(np.median(every)) if len(every) else float("nan")


def _true_normals(view: DepthView) -> tuple[F64, BoolArray]:
    """(H, W, 3) normals in the camera, towards it, and where they are defined.

    Inverse depth is affine on a plane: w = n . ray, so its differences are n_u / fx and n_v / fy.
    """
    w, camera = view.inverse_depth, view.camera
    normals = np.zeros((*w.shape, 3))
    normals[:, 1:-1, 0] = 0.5 * (w[:, 2:] - w[:, :-2]) * camera.fx
    normals[1:-1, :, 1] = 0.5 * (w[2:] - w[:-2]) * camera.fy
    x = (np.arange(camera.width) - camera.cx) / camera.fx
    y = (np.arange(camera.height) - camera.cy) / camera.fy
    normals[..., 2] = w - normals[..., 0] * x - normals[..., 1] * y[:, None]
    defined = ~view.broken
    defined[[0, -1]] = False
    defined[:, [0, -1]] = False
    return -_unit(normals), defined


def _plane_normals(view: DepthView) -> tuple[F64, BoolArray]:
    """(H, W, 3) likewise, of planes fitted to windows of inverse depth by least squares.

    Depth cameras have steps and noise that slopes between pixels side by side magnify.
    """
    w, camera = view.inverse_depth, view.camera
    height, width = w.shape
    reach = max(2, round(_PLANE_SHARE * width))
    side, known = 2 * reach + 1, (~view.broken).astype(np.float64)

    def sums(values: F64) -> F64:
        filtered = cv2.boxFilter(
            values * known, -1, (side, side), normalize=False, borderType=cv2.BORDER_CONSTANT
        )
        return np.asarray(filtered, np.float64)

    u = np.tile(np.arange(width) - 0.5 * width, (height, 1))
    v = np.tile(np.arange(height)[:, None] - 0.5 * height, (1, width))
    count = sums(np.ones_like(w))
    n = np.maximum(count, 1.0)
    mean_u, mean_v, mean_w = sums(u) / n, sums(v) / n, sums(w) / n
    uu, uv, vv = (sums(a * b) / n for a, b in ((u, u), (u, v), (v, v)))
    uu, uv, vv = uu - mean_u * mean_u, uv - mean_u * mean_v, vv - mean_v * mean_v
    uw, vw = sums(u * w) / n - mean_u * mean_w, sums(v * w) / n - mean_v * mean_w
    determinant = uu * vv - uv * uv
    defined = ~view.broken & (count >= _PLANE_KNOWN * side * side) & (determinant > 0.0)
    determinant = np.where(defined, determinant, 1.0)
    across, down = (uw * vv - vw * uv) / determinant, (vw * uu - uw * uv) / determinant
    here = mean_w + across * (u - mean_u) + down * (v - mean_v)
    x = (np.arange(width) - camera.cx) / camera.fx
    y = (np.arange(height) - camera.cy) / camera.fy
    normals = np.stack([across * camera.fx, down * camera.fy, np.zeros_like(w)], axis=-1)
    normals[..., 2] = here - normals[..., 0] * x - normals[..., 1] * y[:, None]
    return -_unit(normals), defined
