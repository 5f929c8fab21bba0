"""The pose graph of loop closing: similarities between keyframes distribute the drift.

Strasdat, Montiel and Davison, Scale Drift-Aware Large Scale Monocular SLAM (RSS 2010): poses with a
scale of their own, ``S_i = [s R | t]`` from camera i to the world, and edges that measure the
relative similarity of two poses, ``Z_ij ~ S_i^-1 S_j``.  The residual of an edge,

    E = Z_ij^-1 S_i^-1 S_j = [s_E R_E | t_E],      r = (log R_E, t_E, log s_E),

is zero if all agree.  A step d = (omega, upsilon, sigma) moves ``S <- S D``,
``D = [e^sigma exp(omega) | upsilon]``.  With ``A = S_i^-1 S_j = Z_ij E`` and J the inverse of the
right Jacobian of SO(3) at log R_E, to first order

    step of j:  E D              ->  (J omega,              s_E R_E upsilon,           sigma)
    step of i:  Z^-1 D^-1 A      ->  (-J R_A^T omega,  (R_Z^T / s_Z) (t_A x omega - upsilon
                                                                      - sigma t_A),   -sigma).

Edges that may be false, because two rooms can look alike, have Geman and McClure's weight
``(c^2 / (c^2 + chi^2))^2``.  That cost has many minima, so c begins so wide that every edge counts,
and shrinks (graduated non-convexity: Yang, Antonante, Tzoumas and Carlone, RA-L 2020, Eq. 9-12).
An edge is rejected only if the others still contradict it in the end.
"""

from dataclasses import dataclass

import numpy as np

from pliant.algorithms.arrays import F64, I32, BoolArray
from pliant.algorithms.geometry import hat, so3_exp, so3_log
from pliant.algorithms.slam.estimate.reduced import Pattern, find_pattern, solve_reduced

_N = 7

_CHI2 = 24.3
"""c^2 of edges that may be false: 99.9 % of a chi-square distribution with seven degrees of
freedom.
"""

_NARROWING = 1.4
_MOST_STEPS = 100
_SETTLED = 1e-6
_DAMPING = 1e-6
_MAX_DAMPING = 1e8


@dataclass(frozen=True, kw_only=True)
class Edges:
    """Measurements between pairs of poses.

    i, j: (E,) of the poses.    Z: (E, 4, 4) similarity from j to i.
    sigmas: (E, 7) standard deviations of rotation, translation (in units of j) and log scale.
    doubtful: (E,) those that may be false.
    """

    i: I32
    j: I32
    Z: F64
    sigmas: F64
    doubtful: BoolArray


def optimise_pose_graph(S: F64, edges: Edges, fixed: BoolArray) -> tuple[F64, F64]:
    """Return the similarities (M, 4, 4) that fit the edges best, by Levenberg-Marquardt.

    S: (M, 4, 4) initial values.    fixed: (M,) fixed poses; at least one. Also returns the weights
    (E,) of the edges: 1, except for doubtful ones that are contradicted.
    """
    free = np.cumsum(~fixed, dtype=np.int32) - 1
    free[fixed] = -1
    if not (~fixed).any() or len(edges.i) == 0:
        return S, np.ones(len(edges.i))
    met = np.eye(int((~fixed).sum()), dtype=np.bool_)
    both = (free[edges.i] >= 0) & (free[edges.j] >= 0)
    met[free[edges.i[both]], free[edges.j[both]]] = True
    pattern = find_pattern(met | met.T, borders=0)
    position = np.where(fixed, -1, pattern.position[free])
    found, chi2 = S, np.square(residuals(S, edges) / edges.sigmas).sum(axis=1)
    widening = 1.0
    if edges.doubtful.any():
        widening = max(1.0, 2.0 * float(chi2[edges.doubtful].max()) / _CHI2)
    damping, growth = _DAMPING, 2.0
    weights = _weights(chi2, edges, widening)
    for _ in range(_MOST_STEPS):
        cost = float(weights @ chi2)
        trial = _step(found, edges, weights, pattern, position, damping)
        after = np.square(residuals(trial, edges) / edges.sigmas).sum(axis=1)
        fall = cost - float(weights @ after)
        if fall >= 0.0:
            found, chi2 = trial, after
            damping, growth = max(0.1 * damping, _DAMPING), 2.0
        else:
            damping, growth = damping * growth, 2.0 * growth
        # The kernel shrinks only after convergence.
        if 0.0 <= fall <= 0.01 * cost and widening > 1.0:
            widening = max(1.0, widening / _NARROWING)
            fall = np.inf
        weights = _weights(chi2, edges, widening)
        if 0.0 <= fall <= _SETTLED * cost or damping > _MAX_DAMPING:
            break
    return found, weights


def residuals(S: F64, edges: Edges) -> F64:
    """(E, 7) residual of each edge."""
    E = _inverse(edges.Z) @ _inverse(S[edges.i]) @ S[edges.j]
    R, scale = _parts(E)
    return np.column_stack([so3_log(R), E[:, :3, 3], np.log(scale)])


def jacobians(S: F64, edges: Edges) -> tuple[F64, F64]:
    """(E, 7, 7) each, of the residuals by steps of i and of j."""
    A = _inverse(S[edges.i]) @ S[edges.j]
    E = _inverse(edges.Z) @ A
    R, scale = _parts(E)
    J = _inverse_right_jacobian(so3_log(R))
    R_A, _ = _parts(A)
    R_Z, scale_Z = _parts(edges.Z)
    back = np.swapaxes(R_Z, 1, 2) / scale_Z[:, None, None]
    of_i, of_j = np.zeros((2, len(A), _N, _N))
    of_j[:, :3, :3] = J
    of_j[:, 3:6, 3:6] = scale[:, None, None] * R
    of_j[:, 6, 6] = 1.0
    of_i[:, :3, :3] = -J @ np.swapaxes(R_A, 1, 2)
    of_i[:, 3:6, :3] = back @ hat(A[:, :3, 3])
    of_i[:, 3:6, 3:6] = -back
    of_i[:, 3:6, 6] = -(back @ A[:, :3, 3, None])[:, :, 0]
    of_i[:, 6, 6] = -1.0
    return of_i, of_j


def step_by(S: F64, steps: F64) -> F64:
    """Similarities (M, 4, 4) after steps (M, 7)."""
    D = np.zeros_like(S)
    D[:, :3, :3] = np.exp(steps[:, 6])[:, None, None] * so3_exp(steps[:, :3])
    D[:, :3, 3] = steps[:, 3:6]
    D[:, 3, 3] = 1.0
    return S @ D


def _weights(chi2: F64, edges: Edges, widening: float) -> F64:
    wide = widening * _CHI2
    return np.where(edges.doubtful, np.square(wide / (wide + chi2)), 1.0)


def _step(
    S: F64, edges: Edges, weights: F64, pattern: Pattern, position: I32, damping: float
) -> F64:
    """The similarities after one damped Gauss-Newton step; NaN without a solution."""
    whitening = np.sqrt(weights)[:, None] / edges.sigmas
    r = whitening * residuals(S, edges)
    of_i, of_j = (whitening[:, :, None] * of for of in jacobians(S, edges))
    N = len(pattern.start) - 1
    H = np.zeros((len(pattern.row), _N, _N))
    b = np.zeros((N, _N))
    at_i, at_j = position[edges.i], position[edges.j]
    for at, of in ((at_i, of_i), (at_j, of_j)):
        some, own = at >= 0, np.swapaxes(of, 1, 2)
        np.add.at(H, pattern.start[at[some]], (own @ of)[some])
        np.add.at(b, at[some], -(own @ r[:, :, None])[some, :, 0])
    both = (at_i >= 0) & (at_j >= 0)
    cross = np.swapaxes(of_j, 1, 2) @ of_i  # rows of j, columns of i
    below = at_j > at_i
    cross[~below] = np.swapaxes(cross[~below], 1, 2)
    block = pattern.block[np.maximum(at_i, at_j), np.minimum(at_i, at_j)]
    np.add.at(H, block[both], cross[both])
    diagonal = np.einsum("nii->ni", H[pattern.start[:-1]])
    found = solve_reduced(pattern, H.reshape(-1, _N * _N), b, damping * diagonal + 1e-12)
    steps = np.zeros((len(S), _N))
    steps[position >= 0] = np.nan if found is None else found[position[position >= 0]]
    return step_by(S, steps)


def _parts(S: F64) -> tuple[F64, F64]:
    """Rotations (N, 3, 3) and scales (N,) of similarities."""
    scale = np.cbrt(np.linalg.det(S[:, :3, :3]))
    return S[:, :3, :3] / scale[:, None, None], scale


def _inverse(S: F64) -> F64:
    """Invert similarities (N, 4, 4)."""
    R, scale = _parts(S)
    out = np.zeros_like(S)
    out[:, :3, :3] = np.swapaxes(R, 1, 2) / scale[:, None, None]
    out[:, :3, 3] = -(out[:, :3, :3] @ S[:, :3, 3, None])[:, :, 0]
    out[:, 3, 3] = 1.0
    return out


def _inverse_right_jacobian(r: F64) -> F64:
    """(E, 3, 3) with ``log(exp(r) exp(d)) ~ r + J d``: ``I + r^/2 + (1/a^2 - cot(a/2)/2a) r^ r^``,
    a = |r|."""
    angle = np.linalg.norm(r, axis=1)
    safe = np.where(angle < 1e-4, 1.0, angle)
    k = np.where(angle < 1e-4, 1.0 / 12.0, 1.0 / safe**2 - 0.5 / (safe * np.tan(0.5 * safe)))
    W = hat(r)
    return np.eye(3) + 0.5 * W + k[:, None, None] * (W @ W)
