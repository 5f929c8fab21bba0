"""The calibration that a run writes: the source's, with the run's estimate."""

import math
from dataclasses import replace
from typing import Any

import numpy as np

from pliant.algorithms.arrays import F64
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import pose_to_matrix, so3_log
from pliant.algorithms.slam.calibration.corrected_view import corrected_view, parts_of
from pliant.algorithms.slam.estimate.problem import CalibrationUncertainty
from pliant.datasets.calibration import Calibration, calibration_from_yaml
from pliant.datasets.working_size import at_size
from pliant.errors import CalibrationError
from pliant.results.run import Run

FOUND = "estimated focal length"
"""The beginning of a reason that requires no action by the user."""

_GRID = 24
"""Points across the image to which a lens is fitted."""

_FITS = 10
"""Gauss-Newton steps of that fit: it starts within a few percent."""

_KNOWN = 0.05
"""Standard deviation of the log focal length above which it counts as unknown."""

_MODEL = 0.007
"""Standard deviation of the log focal length by errors that leave no residual: common to all
tracks, or of the lens model.  `scripts/bench coverage`."""

_CONTRADICTED = 2.0
"""Standard deviations of the calibration's prior above which the images contradict it."""

_BENDS = 0.1
"""Correction of the log focal length above which a map may stay bent, because it started with the
wrong one (two standard deviations of the corrections that contradict the given one)."""

_SURE = 3.0
"""Minimum difference between the given and the estimated focal length, in standard deviations of
the estimate."""

_OFF_CENTRE = 0.03
"""Error of the principal point, as a share of the focal length, above which the images contradict
the calibration."""

_FAR_OFF_CENTRE = 0.05
"""As ``_BENDS`` of the principal point: online poses are wrong until it is found."""

_NOT_SQUARE, _FAR_FROM_SQUARE = 0.01, 0.03
"""As the two above, of the logarithm of the aspect ratio."""

_FORWARD = math.cos(math.radians(15.0))
_TURN_DEG = 20.0
"""Motion that leaves the focal length uncertain: along the axis, or with less rotation than
this."""


def found_calibration(run: Run) -> Calibration | None:
    """The calibration of the source, at the size of its images, with the correction of the last
    segment; None without a stream.

    ``focal_sigma`` includes the difference between the given and the estimated focal length: a
    map that started with a wrong one is bent.  If the focal length changes during the clip, the
    calibration has the middle of its range, and half of the range as uncertainty.
    """
    if run.stream is None or not run.stream.calibration:
        return None
    given, stream = calibration_from_yaml(run.stream.calibration), run.stream
    size = stream.source_width or given.width, stream.source_height or given.height
    correction = run.calibration_correction
    if len(correction) < 3:
        return at_size(given, *size)
    found = _corrected(given, run.stream.camera, correction)
    sigma = focal_sigma(run)
    sigma = max(sigma, abs(correction[0])) if _is_contradicted(run) else sigma
    usual = CalibrationUncertainty().focal
    if run.focal_range is not None:
        low, high = run.focal_range
        middle = math.sqrt(low * high)
        found = replace(found, fx=middle * found.fx, fy=middle * found.fy)
        sigma = max(sigma, 0.5 * math.log(high / low))
    found = at_size(found, *size)
    return replace(found, focal_sigma=min(sigma, 1.0) if sigma > usual else 0.0)


def focal_sigma(run: Run) -> float:
    """Standard deviation of the estimated log focal length; 0 without an estimate."""
    formal = run.calibration_sigmas[0] if run.calibration_sigmas else 0.0
    return with_model_error(formal) if formal > 0.0 else 0.0


def with_model_error(formal: float) -> float:
    """Add the model error to the standard deviation of a log focal length by an adjustment."""
    return math.hypot(formal, _MODEL)


def _corrected(
    given: Calibration, camera: PinholeCamera, correction: tuple[float, ...]
) -> Calibration:
    """camera: the rectified one, to which the correction applies.

    Only the focal length, if no lens of the source's model is near the estimate.
    """
    s, k1, k2, a, b, t = parts_of(correction)
    fx, fy = given.fx * math.exp(s), given.fy * math.exp(s + t)
    scaled = replace(given, fx=fx, fy=fy, cx=given.cx + fx * a, cy=given.cy + fy * b)
    if k1 == 0.0 and k2 == 0.0 and not given.lens.distorts:
        return scaled
    try:
        if given.model == "pinhole":
            return replace(scaled, model="pinhole-radtan", distortion=(k1, k2, 0.0, 0.0, 0.0))
        return _fitted(scaled, given, camera, correction)
    except CalibrationError:
        return scaled


def _fitted(
    start: Calibration, given: Calibration, camera: PinholeCamera, correction: tuple[float, ...]
) -> Calibration:
    """Fit focal lengths and coefficients by least squares: two lenses in sequence are no lens of
    the model."""
    u, v = np.meshgrid(
        np.linspace(0.0, camera.width - 1.0, _GRID), np.linspace(0.0, camera.height - 1.0, _GRID)
    )
    px = np.stack([u.ravel(), v.ravel()], axis=1).astype(np.float32)
    view = corrected_view(camera, correction)
    plane = view.camera.normalise(view.pixels(px).astype(np.float64))
    wanted = given.lens.project(camera.normalise(px.astype(np.float64)))
    pinhole = [start.fx, start.fy, start.cx, start.cy]
    unit = np.array([*pinhole, *np.ones(len(start.distortion))])
    values = np.array([*pinhole, *start.distortion]) / unit

    def lens(values: F64) -> F64:
        fx, fy, cx, cy, *coefficients = (values * unit).tolist()
        changed = replace(start.lens, fx=fx, fy=fy, cx=cx, cy=cy, coefficients=tuple(coefficients))
        return changed.project(plane).ravel()

    for _ in range(_FITS):
        now = lens(values)
        J = np.stack([(lens(values + 1e-6 * e) - now) * 1e6 for e in np.eye(len(values))], axis=1)
        values = values + np.linalg.lstsq(J, wanted.ravel() - now, rcond=1e-10)[0]
    fx, fy, cx, cy, *coefficients = (values * unit).tolist()
    return replace(start, fx=fx, fy=fy, cx=cx, cy=cy, distortion=tuple(coefficients))


def calibration_verdict(run: Run, final: dict[int, Any]) -> str:
    """One line for the user on the calibration; "" if the given one was confirmed."""
    correction, sigmas = run.calibration_correction, run.calibration_sigmas
    if run.stream is None or len(correction) < 3 or len(sigmas) < 3:
        return ""
    camera = run.stream.camera
    focal = camera.fx * math.exp(correction[0])
    fov = math.degrees(2.0 * math.atan(0.5 * camera.width / focal))
    changes = focal_changes(run)
    if changes:
        return changes
    sure = f"+-{100.0 * focal_sigma(run):.1f} %"
    known = f"{fov:.1f} degrees across, {sure}"
    if run.stream.focal_sigma > 0.0:
        if sigmas[0] > _KNOWN:
            return f"unknown focal length ({known}){_why(final)}: pass --calibration"
        return f"{FOUND} ({known}): pass calibration.yaml to the next run"
    if not _is_contradicted(run):
        return ""
    _, _, _, a, b, t = parts_of(correction)
    point = f"principal point {focal * a:+.0f}, {focal * b:+.0f} px, " if a or b else ""
    point += f"fy / fx {math.exp(t):.3f} times the given one, " if t else ""
    return (
        f"the images contradict the calibration: focal length {math.exp(correction[0]):.3f} times "
        f"the given one ({sure}), k1 {correction[1]:+.3f}, {point}"
        f"{_corner_px(camera, correction):.0f} px at the corner; "
        "run again with --calibration calibration.yaml"
    )


def focal_changes(run: Run) -> str:
    """How the focal length changes during the clip; "" if it does not."""
    if run.stream is None or run.focal_range is None or not run.calibration_correction:
        return ""
    focal = run.stream.camera.fx * math.exp(run.calibration_correction[0])
    low, high = (focal * each for each in run.focal_range)
    return (
        f"the focal length changes during the clip ({low:.0f} to {high:.0f} px): zoom, focus "
        "breathing or stabilisation; lock zoom and focus, switch stabilisation off, and film "
        "again"
    )


def calibration_doubt(run: Run, final: dict[int, Any]) -> str:
    """As ``calibration_verdict`` if the uncertainty of the camera bends the map, as far as the run
    knows; otherwise ""."""
    correction, sigmas = run.calibration_correction, run.calibration_sigmas
    if run.stream is None or len(correction) < 3 or len(sigmas) < 3:
        return ""
    guessed = run.stream.focal_sigma > 0.0
    far = abs(correction[0]) > _BENDS or _off_centre(correction) > _FAR_OFF_CENTRE
    far = far or abs(parts_of(correction)[-1]) > _FAR_FROM_SQUARE
    bent = sigmas[0] > _KNOWN if guessed else far and _is_contradicted(run)
    return calibration_verdict(run, final) if bent else ""


def _is_contradicted(run: Run) -> bool:
    """Whether the images contradict a calibration that was not a guess."""
    correction, sigmas = run.calibration_correction, run.calibration_sigmas
    if run.stream is None or run.stream.focal_sigma > 0.0 or len(sigmas) < 2:
        return False
    priors = CalibrationUncertainty().sigmas[:2].tolist()
    off = _off_centre(correction) > _OFF_CENTRE or abs(parts_of(correction)[-1]) > _NOT_SQUARE
    return off or any(
        abs(q) > max(_CONTRADICTED * prior, _SURE * sigma)
        for q, prior, sigma in zip(correction[:2], priors, sigmas[:2], strict=True)
    )


def _off_centre(correction: tuple[float, ...]) -> float:
    """How far the principal point is from the given one, as a share of the focal length."""
    _, _, _, a, b, _ = parts_of(correction)
    return math.hypot(a, b)


def _corner_px(camera: PinholeCamera, correction: tuple[float, ...]) -> float:
    """How far, in px, a point moves that the given camera sees in its farthest corner."""
    corners = np.array(
        [(u, v) for u in (0.0, camera.width - 1.0) for v in (0.0, camera.height - 1.0)], np.float32
    )
    view = corrected_view(camera, correction)
    plane = camera.normalise(corners.astype(np.float64))
    own = view.camera
    seen = view.seen((plane * (own.fx, own.fy) + (own.cx, own.cy)).astype(np.float32))
    return float(np.linalg.norm(seen - corners, axis=1).max())


def _why(final: dict[int, Any]) -> str:
    """Why the motion of the frames leaves the focal length uncertain, in words."""
    poses = [pose_to_matrix(pose) for _, (_, pose) in sorted(final.items())]
    if len(poses) < 2:
        return ""
    T = np.array(poses)
    turns = np.degrees(
        np.linalg.norm([so3_log(T[0, :3, :3].T @ each[:3, :3]) for each in T], axis=1)
    )
    steps = np.diff(T[:, :3, 3], axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    along = np.abs(np.einsum("nk,nk->n", steps, T[:-1, :3, 2]))
    reasons: list[str] = []
    if lengths.sum() > 0.0 and along.sum() > _FORWARD * lengths.sum():
        reasons.append("the camera moves straight ahead")
    if turns.max() < _TURN_DEG:
        reasons.append(f"it rotates by only {turns.max():.0f} degrees")
    return ", as " + " and ".join(reasons) if reasons else ""
