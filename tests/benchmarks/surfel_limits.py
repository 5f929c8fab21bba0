"""What a surfel can do from one frame to the next: how it converges, and how near to the bound."""

from collections.abc import Iterator

import numpy as np

from benchmarks.surfel_sequences import Sequence, load
from benchmarks.table import markdown
from pliant.algorithms.surfels.parameters import SurfelParameters
from pliant.algorithms.surfels.surfel_frame import SurfelState
from pliant.algorithms.surfels.surfel_tracker import SurfelTracker

_PAIRS = 8
_RIGHT = 0.01
_SHAKEN = ("shift=0.01&turn=0.5", "shift=0.02&turn=1", "shift=0.03&turn=1.5", "shift=0.04&turn=2")


def measure_limits(surfels: int) -> Iterator[str]:
    """Pairs of frames of a rigid board 1 m away; each surfel on its own."""
    alone = SurfelParameters(max_surfels=surfels, neighbours=0)
    yield f"\nlimits, {_PAIRS} pairs of frames of built-in:board, no neighbours"
    yield markdown(("motion in one frame", "converged (3D error below 1 %)"), [])
    for motion in _SHAKEN:
        for blur in ("0", "0.3"):
            sequence = load(f"built-in:board?{motion}&blur={blur}", 2 * _PAIRS, all_depths=True)
            right, asked, _ = _pairs(sequence, alone)
            yield f"| {motion.replace('&', ' ')} blur={blur} | {right / max(1, asked):.1%} |"
    yield ""
    yield markdown(("patch, still board, noise 2 DN", "depth RMSE %", "by the bound"), [])
    sequence = load("built-in:board?shift=0&turn=0&blur=0", 2 * _PAIRS, all_depths=True)
    for side in (11, 15, 23, 31, 45):
        _, _, errors = _pairs(sequence, alone.model_copy(update={"patch_px": side}))
        depth, bound = np.sqrt((errors**2).mean(axis=0))
        yield f"| {side} px | {100.0 * depth:.2f} | {depth / bound:.2f} |"


def _pairs(sequence: Sequence, parameters: SurfelParameters) -> tuple[int, int, np.ndarray]:
    """Surfels that converged, all that stayed in view, and (N, 2) error of the depth and its bound.

    The bound is the Cramer-Rao bound of each surfel: its own normal equations with the variance of
    its residuals, to which the noise of texture and frame both contribute.
    """
    truth = sequence.truth
    assert truth is not None
    right = asked = 0
    errors: list[np.ndarray] = []
    for first in range(0, 2 * _PAIRS, 2):
        tracker = SurfelTracker(parameters)
        born = tracker.start(sequence.images[first], sequence.depths[first], sequence.camera)
        found = tracker.track(sequence.images[first + 1], sequence.interval_s(first + 1))
        points = truth.at_pixels(first, np.rint(born.points_px).astype(np.float64))
        exact = truth.positions(points, first + 1)
        kept = truth.visible(points, first + 1, 0.5 * parameters.patch_px + 1.0)
        good = found.state == SurfelState.TRACKED
        off = np.linalg.norm(found.positions - exact, axis=1) / exact[:, 2]
        right += int((good & kept & (off < _RIGHT)).sum())
        asked += int(kept.sum())
        chosen = good & kept & (off < 5.0 * _RIGHT)
        depth = (found.positions - born.positions - (exact - truth.positions(points, first)))[:, 2]
        both = np.stack([depth / exact[:, 2], found.sigma / exact[:, 2]], axis=1)
        errors.append(both[chosen])
    return right, asked, np.concatenate(errors)
