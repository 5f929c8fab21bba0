"""A camera that nobody describes, or wrongly: the lens that is found, and what its map is worth."""

import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from benchmarks.in_process import Mapped, run
from benchmarks.table import markdown_header, markdown_row
from pliant.algorithms.arrays import F64
from pliant.algorithms.geometry import so3_exp
from pliant.algorithms.rectification import distort
from pliant.algorithms.slam.calibration.corrected_view import CorrectedView, corrected_view
from pliant.datasets import Calibration, open_source
from pliant.datasets.calibration import calibration_from_fov

_SAID = (None, 1.67, 0.87, 0.51)
"""Focal lengths that are said, times the true one: 40, 70 and 100 degrees where 63 is true."""
_GRID, _FITS = 24, 5
_HEADER = (
    *("source", "said", "focal length", "told to be known to", "k1 and k2 at the corner"),
    *("the whole lens, px", "ATE, final / online", "times the calibrated one"),
)


def measure(sources: Sequence[str], frames: int | None, overrides: Sequence[str]) -> Iterator[str]:
    """A row for each source and what is said of its lens; frames: the first, None: all."""
    yield markdown_header(_HEADER)
    for name in sources:
        source = open_source(name)
        truth = source.calibration
        calibrated = run(source, overrides, frames=frames)
        yield markdown_row(
            [Path(name).name, "its calibration", "", "", "", "", calibrated.both, ""]
        )
        true_fov = 2.0 * math.degrees(math.atan(0.5 * truth.width / truth.fx))
        for factor in _SAID:
            size = truth.width, truth.height
            fov, said = None, f"nothing ({true_fov:.0f} deg is true)"
            if factor is not None:
                fov = round(2.0 * math.degrees(math.atan(0.5 * truth.width / (factor * truth.fx))))
                said = f"{fov} deg"
            guess = calibration_from_fov(*size, fov)
            found = run(source, overrides, frames=frames, calibration=guess)
            ratio = f"{found.ate_m / calibrated.ate_m:.2f}"
            lens = _lens_cells(guess, found, truth)
            yield markdown_row([Path(name).name, said, *lens, found.both, ratio])


def _lens_cells(guess: Calibration, found: Mapped, truth: Calibration) -> tuple[str, ...]:
    """How far focal length, radial distortion and all of it together are off."""
    if not found.correction:
        return "", "", "", ""
    view = corrected_view(guess.lens.pinhole, found.correction)
    focal, (k1, k2) = view.camera.fx, view.lens
    r = 0.5 * math.hypot(truth.width / truth.fx, truth.height / truth.fy)
    # Up and to the right, and down and to the left: what is tangential takes itself out.
    corner = r * np.array([[0.8, 0.6], [-0.8, -0.6]])
    true_px = truth.fx * (0.5 * np.linalg.norm(np.subtract(*distort(corner, truth.lens))) - r)
    found_px = focal * r * (k1 * r**2 + k2 * r**4)
    return (
        f"{100.0 * (focal / truth.fx - 1.0):+.2f} %",
        f"{100.0 * found.sigmas[0]:.2f} %",
        f"{found_px - true_px:+.1f} px",
        f"{_apart_px(view, truth):.2f}",
    )


def _apart_px(view: CorrectedView, truth: Calibration) -> float:
    """RMS over the image between where both see a point, beside the turn that none can tell."""
    u, v = np.meshgrid(
        np.linspace(0.0, truth.width - 1.0, _GRID), np.linspace(0.0, truth.height - 1.0, _GRID)
    )
    px = np.stack([u.ravel(), v.ravel()], axis=1)
    plane = view.camera.normalise(view.pixels(px.astype(np.float32)).astype(np.float64))
    rays = np.column_stack([plane, np.ones(len(plane))])

    def off(turn: F64) -> F64:
        turned = rays @ so3_exp(turn).T
        return (truth.lens.project(turned[:, :2] / turned[:, 2:]) - px).ravel()

    turn = np.zeros(3)
    for _ in range(_FITS):
        now = off(turn)
        J = np.stack([(off(turn + 1e-6 * axis) - now) * 1e6 for axis in np.eye(3)], axis=1)
        turn = turn - np.linalg.lstsq(J, now, rcond=None)[0]
    return float(np.sqrt((off(turn).reshape(-1, 2) ** 2).sum(axis=1).mean()))
