"""Which surfels were found: ZNCC, visibility and uncertainty (DSDT, sections IV and VI-A)."""

import math

import numpy as np

from pliant.algorithms.arrays import F64, U8
from pliant.algorithms.kernel import fast_kernel
from pliant.algorithms.surfels import motion
from pliant.algorithms.surfels.align import Limits, Templates, Workspace
from pliant.algorithms.surfels.damped import factorise, inverse_diagonal
from pliant.algorithms.surfels.sampling import BIAS, GAIN, Grid, Level, homography, sample_patch
from pliant.algorithms.surfels.sums import correlation

FRONT, INSIDE, SEEN, CORRELATION, SIGMA, U, V, VERDICTS = 0, 1, 2, 3, 4, 5, 6, 7
"""Columns of a verdict: in front of the camera (0 or 1), shares of the texture inside of the image
and seen, ZNCC, standard deviation of the position (metres), pixel of the centre."""

_MIN_NOISE = 0.5  # DN: quantisation alone makes this much of a difference of two images
_MAX_SIGMA = 1e3
_FAR = 1e6


@fast_kernel
def judge_all(
    poses: F64, active: U8, level: Level, templates: Templates, limits: Limits, grid: Grid,
    work: Workspace, out: F64,
) -> None:  # fmt: skip
    """Fill a row of ``out`` (N, VERDICTS) for every active surfel.

    grid: of the side of the templates.  The pixel is left alone where a surfel is not in front.
    """
    parameters = motion.parameter_count(limits.model)
    for s in range(len(poses)):
        if not active[s]:
            continue
        pose, verdict = poses[s], out[s]
        verdict[FRONT] = verdict[INSIDE] = verdict[SEEN] = verdict[CORRELATION] = 0.0
        if not homography(pose, level, work.h):
            continue
        if not sample_patch(work.h, level, grid, limits.highlight):
            continue
        verdict[FRONT] = 1.0
        verdict[U], verdict[V] = work.h[2] / work.h[8], work.h[5] / work.h[8]
        images, m = templates.images[s], templates.means[s]
        gain, bias = pose[GAIN], pose[BIAS]
        inside = seen = squares = 0.0
        count = templates.counts[s]
        for k in range(len(grid.i)):
            r = gain * (grid.values[k] - m) + bias - images[0, k]
            good = abs(r) < limits.tau
            inside += grid.valid[k] if images[0, k] < _FAR else 0.0
            seen += 1.0 if good else 0.0
            squares += r * r if good else 0.0
        verdict[INSIDE], verdict[SEEN] = inside / count, seen / count
        verdict[CORRELATION], _ = correlation(images[0], grid.values)
        if seen < parameters:
            continue
        motion.mixing(pose, level, limits.model, True, work.mix)
        motion.normal_equations(
            templates.matrices[s], work.sums, work.mix, parameters, work.product, work.H, work.g
        )
        # What is covered tells nothing: the information shrinks with the share that is seen.
        work.g[:] = 0.0
        motion.add_deformation_energy(pose, limits.model, limits.omega_i, work.H, work.g)
        noise = max(squares / seen, _MIN_NOISE * _MIN_NOISE) / verdict[SEEN]
        if factorise(work.H, parameters, 0, 0.0, work.L, work.scale):
            trace = inverse_diagonal(work.L, work.scale, parameters, 3, work.step)
            verdict[SIGMA] = min(math.sqrt(noise * trace), _MAX_SIGMA)


def new_verdicts(count: int) -> F64:
    """Rows of zeros for ``judge_all``."""
    return np.zeros((count, VERDICTS))
