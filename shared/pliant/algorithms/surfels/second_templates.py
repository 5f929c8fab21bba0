"""A second, recent template of each surfel, guarded by that of its birth (not in the paper).

DSDT never changes the texture of Eq. 5.  Highlights on wet tissue change as it tilts, so the
texture of a surfel changes in place.  A surfel whose ZNCC falls therefore gets a template of the
current frame.  Such templates drift, so the birth template is aligned again:

- in every frame from the current position, tied to the neighbours as in ``relocate``;
- every few frames from the position predicted by confirmed neighbours, also if it is missing.

Where the birth template fits, it is in use again and the surfel is confirmed: its drift is gone.
"""

import numpy as np

from pliant.algorithms.arrays import F32, F64, I32, I64, BoolArray
from pliant.algorithms.surfels.births import MIN_TEMPLATE, fill_texture
from pliant.algorithms.surfels.patch_sampling import (
    BIAS,
    GAIN,
    INVALID,
    Grid,
    Level,
    homography,
    make_grid,
    sample_patch,
)
from pliant.algorithms.surfels.photometric import first_inner, make_features
from pliant.algorithms.surfels.surfel_alignment import Templates
from pliant.compiler.kernel import fast_kernel

_FAR = 0.5 * INVALID
_NEAREST = 8
_FEWEST = 4
"""Confirmed neighbours: an affine motion of a plane has three points."""
_FLAT = 0.1
"""Singular values below this share of the largest are noise: neighbours lie nearly in a plane."""


def renew(
    poses: F64, rows: I64, pyramid: list[Level], highlight: float, birth: list[Templates],
    used: list[Templates],
) -> None:  # fmt: skip
    """Make the templates in use of some surfels from this frame.

    poses: (N, POSE_FLOATS) in the camera frame; the bias of the rows is set for the new mean.
    Grey levels are kept in those of birth, gain times frame plus bias, so that gain and bias
    (Eq. 5) still compare with birth.  Samples that the birth template lacks stay out.  A level with
    too little of the patch in the image keeps its birth template.
    """
    light = birth_bias(poses, used[0].means)
    for level, first, now in zip(pyramid, birth, used, strict=True):
        _renew(
            poses, rows, level, make_grid(level.side + 2), highlight, light, MIN_TEMPLATE, first,
            now, make_features(level.side),
        )  # fmt: skip
    poses[rows, BIAS] = light[rows] - used[0].means[rows] * (1.0 - poses[rows, GAIN])


def birth_bias(poses: F64, means: F64) -> F64:
    """(N,) beta of Eq. 5, DN: within, grey levels have lost the mean of the template in use."""
    return poses[:, BIAS] + means * (1.0 - poses[:, GAIN])


@fast_kernel
def _renew(
    poses: F64, rows: I64, level: Level, wide: Grid, highlight: float, light: F64,
    min_share: float, birth: Templates, used: Templates, scratch: F32,
) -> None:  # fmt: skip
    h = np.empty(9)
    at, side = first_inner(wide), wide.side - 2
    for s in rows:
        texture = birth.images[s, 0]
        good = birth.usable[s] > 0 and homography(poses[s], level, h)
        if good and sample_patch(h, level, wide, highlight):
            gain, bias = np.float32(poses[s, GAIN]), np.float32(light[s])
            for k in range(len(wide.values)):
                if wide.values[k] < _FAR:
                    wide.values[k] = gain * wide.values[k] + bias
            for n in range(len(texture)):
                if n % wide.side < side and not texture[n] < _FAR:
                    wide.values[at + n] = np.float32(INVALID)
            if fill_texture(s, wide, min_share, used, scratch) and used.usable[s]:
                continue
        _copy_row(birth, used, s)


@fast_kernel
def _copy_row(source: Templates, target: Templates, s: int) -> None:
    target.images[s] = source.images[s]
    target.means[s], target.counts[s] = source.means[s], source.counts[s]
    target.matrices[s] = source.matrices[s]
    target.usable[s] = source.usable[s]


def restore(rows: I64, birth: list[Templates], used: list[Templates]) -> None:
    """Put the birth templates of some surfels in use again."""
    for first, now in zip(birth, used, strict=True):
        for source, target in zip(first, now, strict=True):
            target[rows] = source[rows]


def carried_by_neighbours(
    wanted: BoolArray, confirmed: BoolArray, born: I32, rest: F64, points: F64
) -> tuple[I64, F64, I64]:
    """Return the wanted rows with confirmed neighbours, the positions that these predict, and the
    nearest of them.

    born: (N,) frame of birth: only surfels of one batch have been at ``rest`` together.  rest,
    points: (N, 3) positions at birth and now, world.  The displacements of the nearest are fitted
    by an affine one, with minimum norm if they lie in a plane.
    """
    found: list[int] = []
    nearest: list[int] = []
    moves: list[F64] = []
    for row in np.flatnonzero(wanted):
        others = np.flatnonzero(confirmed & (born == born[row]) & (np.arange(len(born)) != row))
        if len(others) < _FEWEST:
            continue
        offsets = rest[others] - rest[row]
        distances = np.einsum("nk,nk->n", offsets, offsets)
        near = np.argsort(distances, kind="stable")[:_NEAREST]
        scale = np.sqrt(distances[near].mean())
        design = np.column_stack([np.ones(len(near)), offsets[near] / max(scale, 1e-12)])
        weights = np.linalg.pinv(design, rcond=_FLAT)[0]
        found.append(int(row))
        nearest.append(int(others[near[0]]))
        moves.append(rest[row] + weights @ (points[others[near]] - rest[others[near]]))
    places = np.array(moves).reshape(-1, 3)
    return np.array(found, np.int64), places, np.array(nearest, np.int64)
