"""The similarity between two cameras' coordinates of paired points, most of which may be wrong.

Three pairs give one in closed form (Umeyama, PAMI 1991).  RANSAC (Fischler and Bolles 1981) selects
the one under which most points project to their observations in both cameras.  ORB-SLAM does the
same for loops (Mur-Artal et al., T-RO 2015, section VII.B).  Depths of a map are far less certain
than directions, so errors are counted, and then minimised, in the images and not in space.  Two
cameras at the same position do not determine the scale by their images, so the depths of both maps
contribute with a small weight.
"""

from dataclasses import dataclass

import numpy as np

from pliant.algorithms.arrays import F64, BoolArray
from pliant.compiler.kernel import kernel

_ROUNDS = 10
_MOST = 1.0
"""Maximum rotation and change of the log scale within one round."""

_SETTLED = 1e-10
_SMALL_RAD = 1e-6
_MIN_DEPTH = 1e-6

_FLAT = 1e-9
"""Ratio of the singular values of three points below which they are collinear."""

_DEPTH_SIGMA = 0.1
"""Relative difference of a point's distance between two maps.  Any parallax between the keyframes
outweighs it: with a tenth of the depth, a pixel of 500 determines it to 2 %.
"""


@dataclass(frozen=True, kw_only=True)
class Pairs:
    """Points that may be the same, in the coordinates of two cameras.

    xyz_a, xyz_b: (N, 3) in the frame of the camera, whose maps differ in scale.   seen_a, seen_b:
    (N, 2) their observations, on the plane z = 1.
    """

    xyz_a: F64
    xyz_b: F64
    seen_a: F64
    seen_b: F64

    def of(self, rows: BoolArray) -> "Pairs":
        """Select some of them."""
        return Pairs(
            xyz_a=self.xyz_a[rows], xyz_b=self.xyz_b[rows], seen_a=self.seen_a[rows],
            seen_b=self.seen_b[rows],
        )  # fmt: skip


def similarity_by_ransac(
    pairs: Pairs, generator: np.random.Generator, *, gate: float, samples: int
) -> tuple[F64, BoolArray] | None:
    """Return S_a_b (4, 4), ``xyz_a ~ S_a_b xyz_b``, and which pairs agree with it; None for fewer
    than four pairs, or if fewer than four agree.

    gate: largest error of a pair in either image, on the plane z = 1.
    """
    count = len(pairs.xyz_a)
    if count < 4:
        return None
    triples = generator.integers(0, count, (samples, 3))
    S = closed_form(pairs.xyz_b[triples], pairs.xyz_a[triples])
    if not len(S):
        return None
    best = S[_least_cost(S, pairs.xyz_a, pairs.xyz_b, pairs.seen_a, pairs.seen_b, gate * gate)]
    for _ in range(2):  # the second round uses the agreeing pairs
        agreeing = _squared(best, pairs) < gate * gate
        if agreeing.sum() < 4:
            return None
        best = refine_similarity(best, pairs.of(agreeing), scale=gate)
    agreeing = _squared(best, pairs) < gate * gate
    return (best, agreeing) if agreeing.sum() >= 4 else None


def refine_similarity(S_a_b: F64, pairs: Pairs, *, scale: float) -> F64:
    """Minimise the errors in both images and of distances by Gauss-Newton, with Geman-McClure
    weights.

    scale: of the kernel, on the plane z = 1.
    """
    found = S_a_b.copy()
    _refine(found, pairs.xyz_a, pairs.xyz_b, pairs.seen_a, pairs.seen_b, scale)
    return found


@kernel
def _refine(S: F64, xyz_a: F64, xyz_b: F64, seen_a: F64, seen_b: F64, scale: float) -> None:
    """Overwrites S (4, 4)."""
    residuals, J = np.empty((len(xyz_a), 5)), np.empty((len(xyz_a), 5, 7))
    step, R = np.empty(7), np.empty((3, 3))
    for _ in range(_ROUNDS):
        _linearise(S, xyz_a, xyz_b, seen_a, seen_b, residuals, J)
        H, g = _normal_equations(residuals, J, scale, scale / _DEPTH_SIGMA)
        _solve(H, g, step)
        largest = abs(step[6])
        for k in range(3):
            largest = max(largest, abs(step[k]))
        if not largest < _MOST:
            break  # undetermined
        _move(S, step, R)
        if np.abs(step).max() < _SETTLED:
            break


def moved(S: F64, step: F64) -> F64:
    """S (4, 4) after a step (omega, tau, sigma): ``X -> e^sigma exp(omega) X + tau``."""
    after = S.copy()
    _move(after, step, np.empty((3, 3)))
    return after


@kernel
def _move(S: F64, step: F64, R: F64) -> None:
    """As ``moved``, in place.   R: (3, 3) is overwritten by ``e^sigma exp(omega)`` (Rodrigues)."""
    x, y, z = step[0], step[1], step[2]
    squared = x * x + y * y + z * z
    angle = np.sqrt(squared)
    a, b = 1.0 - squared / 6.0, 0.5 - squared / 24.0
    if angle > _SMALL_RAD:
        a, b = np.sin(angle) / angle, (1.0 - np.cos(angle)) / squared
    scale = np.exp(step[6])
    for r in range(3):
        for c in range(3):
            R[r, c] = b * step[r] * step[c]
        R[r, r] += 1.0 - b * squared
    R[0, 1], R[1, 0] = R[0, 1] - a * z, R[1, 0] + a * z
    R[0, 2], R[2, 0] = R[0, 2] + a * y, R[2, 0] - a * y
    R[1, 2], R[2, 1] = R[1, 2] - a * x, R[2, 1] + a * x
    for c in range(4):
        s0, s1, s2 = S[0, c], S[1, c], S[2, c]
        for r in range(3):
            S[r, c] = scale * (R[r, 0] * s0 + R[r, 1] * s1 + R[r, 2] * s2)
    for r in range(3):
        S[r, 3] += step[3 + r]


def residuals_of(S_a_b: F64, pairs: Pairs) -> tuple[F64, F64]:
    """(N, 5) errors in the image of a, in that of b, and of the logarithm of the distance from a;
    (N, 5, 7) derivatives by ``moved``.

    With Y = S X_b: ``dY = -[Y] domega + dtau + Y dsigma``; S^-1 X_a moves with the opposite step;
    ``d log |Y| = Y . dY / |Y|^2``.
    """
    count = len(pairs.xyz_a)
    residuals, J = np.empty((count, 5)), np.empty((count, 5, 7))
    _linearise(S_a_b, pairs.xyz_a, pairs.xyz_b, pairs.seen_a, pairs.seen_b, residuals, J)
    return residuals, J


@kernel
def _linearise(
    S: F64, xyz_a: F64, xyz_b: F64, seen_a: F64, seen_b: F64, residuals: F64, J: F64
) -> None:
    Y, Z, dY, dZ = np.empty(3), np.empty(3), np.empty((3, 7)), np.empty((3, 7))
    back = np.empty((3, 4))
    squared_scale = S[0, 0] ** 2 + S[0, 1] ** 2 + S[0, 2] ** 2
    for r in range(3):
        back[r, 3] = 0.0
        for c in range(3):
            back[r, c] = S[c, r] / squared_scale
            back[r, 3] -= back[r, c] * S[c, 3]
    for n in range(len(xyz_a)):
        X, far = xyz_a[n], 0.0
        for r in range(3):
            Y[r], Z[r] = S[r, 3], back[r, 3]
            for c in range(3):
                Y[r] += S[r, c] * xyz_b[n, c]
                Z[r] += back[r, c] * X[c]
            far += Y[r] * Y[r]
        _derivatives(Y, dY)
        _derivatives(X, J[n, :3])  # of X_a, which S^-1 then takes to b
        for r in range(3):
            for k in range(7):
                dZ[r, k] = 0.0
                for c in range(3):
                    dZ[r, k] -= back[r, c] * J[n, c, k]
        _project_into(Y, dY, seen_a[n], residuals[n, :2], J[n, :2])
        _project_into(Z, dZ, seen_b[n], residuals[n, 2:4], J[n, 2:4])
        residuals[n, 4] = 0.5 * np.log(far / (X[0] * X[0] + X[1] * X[1] + X[2] * X[2]))
        for k in range(7):
            J[n, 4, k] = (Y[0] * dY[0, k] + Y[1] * dY[1, k] + Y[2] * dY[2, k]) / far


@kernel
def _derivatives(X: F64, dX: F64) -> None:
    """(3, 7) derivatives of a point by ``moved``."""
    dX[:] = 0.0
    dX[0, 1], dX[0, 2], dX[1, 2] = X[2], -X[1], X[0]
    dX[1, 0], dX[2, 0], dX[2, 1] = -X[2], X[1], -X[0]
    for r in range(3):
        dX[r, 3 + r], dX[r, 6] = 1.0, X[r]


@kernel
def _project_into(X: F64, dX: F64, seen: F64, error: F64, J: F64) -> None:
    """Error (2,) of the projection, and its derivatives (2, 7)."""
    z = _MIN_DEPTH if abs(X[2]) < _MIN_DEPTH else X[2]
    for r in range(2):
        error[r] = X[r] / z - seen[r]
        for k in range(7):
            J[r, k] = (dX[r, k] - X[r] / z * dX[2, k]) / z


@kernel
def _normal_equations(residuals: F64, J: F64, scale: float, as_image: float) -> tuple[F64, F64]:
    """(7, 7), its lower half, and (7,) with Geman-McClure weights.   as_image: scale of the
    distance errors.
    """
    H, g = np.zeros((7, 7)), np.zeros(7)
    for n in range(len(residuals)):
        r = residuals[n]
        image = r[0] * r[0] + r[1] * r[1] + r[2] * r[2] + r[3] * r[3]
        for k in range(5):
            times = as_image * as_image if k == 4 else 1.0
            squared = times * r[4] * r[4] if k == 4 else image
            weight = times / (1.0 + squared / scale**2) ** 2
            for i in range(7):
                g[i] += weight * J[n, k, i] * r[k]
                for j in range(i + 1):
                    H[i, j] += weight * J[n, k, i] * J[n, k, j]
    return H, g


@kernel
def _solve(H: F64, g: F64, step: F64) -> None:
    """Solve ``H step = -g`` for 7 unknowns by Cholesky; only the lower half of H is read, and
    overwritten. Undetermined unknowns do not move far.
    """
    trace = 0.0
    for i in range(7):
        trace += H[i, i]
    for i in range(7):
        H[i, i] += 1e-12 * trace
        step[i] = -g[i]
        for j in range(i + 1):
            value = H[i, j]
            for k in range(j):
                value -= H[i, k] * H[j, k]
            H[i, j] = np.sqrt(max(value, 1e-15 * trace)) if i == j else value / H[j, j]
        for k in range(i):
            step[i] -= H[i, k] * step[k]
        step[i] /= H[i, i]
    for i in range(6, -1, -1):
        for k in range(i + 1, 7):
            step[i] -= H[k, i] * step[k]
        step[i] /= H[i, i]


def _project(X: F64) -> F64:
    z = np.where(np.abs(X[..., 2:]) < _MIN_DEPTH, _MIN_DEPTH, X[..., 2:])
    return X[..., :2] / z


def _squared(S_a_b: F64, pairs: Pairs) -> F64:
    """(N,) the larger squared error of each pair in the two images under a similarity (4, 4);
    infinite behind a camera."""
    A, t = S_a_b[:3, :3].T, S_a_b[None, :3, 3]
    Y = pairs.xyz_b @ A + t
    Z = (pairs.xyz_a - t) @ np.linalg.inv(A)
    a = ((_project(Y) - pairs.seen_a) ** 2).sum(axis=-1)
    b = ((_project(Z) - pairs.seen_b) ** 2).sum(axis=-1)
    front = (Y[..., 2] > 0.0) & (Z[..., 2] > 0.0)
    return np.where(front, np.maximum(a, b), np.inf)


@kernel
def _least_cost(S: F64, xyz_a: F64, xyz_b: F64, seen_a: F64, seen_b: F64, most: float) -> int:
    """Return which of the similarities (n, 4, 4) has the smallest sum of truncated errors of
    ``_squared``. A sum that exceeds the smallest one is abandoned.
    """
    best, least = 0, np.inf
    for s in range(len(S)):
        A, t = S[s, :3, :3], S[s, :3, 3]
        back = 1.0 / (A[0, 0] ** 2 + A[0, 1] ** 2 + A[0, 2] ** 2)  # A^-1 = A^T / scale^2
        cost = 0.0
        for n in range(len(xyz_a)):
            there = _error(
                A[0, 0] * xyz_b[n, 0] + A[0, 1] * xyz_b[n, 1] + A[0, 2] * xyz_b[n, 2] + t[0],
                A[1, 0] * xyz_b[n, 0] + A[1, 1] * xyz_b[n, 1] + A[1, 2] * xyz_b[n, 2] + t[1],
                A[2, 0] * xyz_b[n, 0] + A[2, 1] * xyz_b[n, 1] + A[2, 2] * xyz_b[n, 2] + t[2],
                seen_a[n],
            )  # fmt: skip
            x, y, z = xyz_a[n, 0] - t[0], xyz_a[n, 1] - t[1], xyz_a[n, 2] - t[2]
            here = _error(
                back * (A[0, 0] * x + A[1, 0] * y + A[2, 0] * z),
                back * (A[0, 1] * x + A[1, 1] * y + A[2, 1] * z),
                back * (A[0, 2] * x + A[1, 2] * y + A[2, 2] * z),
                seen_b[n],
            )
            cost += min(max(there, here), most)
            if cost >= least:
                break
        if cost < least:
            best, least = s, cost
    return best


@kernel
def _error(x: float, y: float, z: float, seen: F64) -> float:
    """Squared error of a point in a camera; infinite behind it."""
    if z <= 0.0:
        return np.inf
    z = max(z, _MIN_DEPTH)
    return (x / z - seen[0]) ** 2 + (y / z - seen[1]) ** 2


def closed_form(source: F64, target: F64) -> F64:
    """(S, 4, 4) similarities that take source (S, 3, 3) rows to target; degenerate triples, among
    them those with a repeated point, are left out.

    Umeyama's for three points: both triples lie in planes, so one plane is rotated into the other
    and then in itself (Horn, "Closed-form solution of absolute orientation using unit quaternions",
    JOSA A 1987, section 5), which takes a twentieth of the time of singular values.
    """
    S, good = np.zeros((len(source), 4, 4)), np.zeros(len(source), np.bool_)
    _of_triples(source, target, S, good)
    return S[good]


@kernel
def _of_triples(source: F64, target: F64, S: F64, good: BoolArray) -> None:
    s, t = np.empty((3, 3)), np.empty((3, 3))
    axes_s, axes_t = np.empty((3, 3)), np.empty((3, 3))
    mean_s, mean_t = np.empty(3), np.empty(3)
    for n in range(len(source)):
        _centre(source[n], s, mean_s)
        _centre(target[n], t, mean_t)
        if not (_axes_of(s, axes_s) and _axes_of(t, axes_t)):
            continue
        # In the planes, target (bx, by) of source (ax, ay).
        xx = xy = yx = yy = extent = 0.0
        for k in range(3):
            ax, ay, bx, by = 0.0, 0.0, 0.0, 0.0
            for c in range(3):
                ax, ay = ax + s[k, c] * axes_s[0, c], ay + s[k, c] * axes_s[1, c]
                bx, by = bx + t[k, c] * axes_t[0, c], by + t[k, c] * axes_t[1, c]
                extent += s[k, c] * s[k, c]
            xx, xy, yx, yy = xx + bx * ax, xy + bx * ay, yx + by * ax, yy + by * ay
        along, across = xx + yy, yx - xy
        both = np.sqrt(along * along + across * across)  # sum of the singular values
        if not xx * yy - xy * yx > _FLAT * both * both:
            continue
        cos, sin, scale = along / both, across / both, both / extent
        good[n], S[n, 3, 3] = True, 1.0
        for r in range(3):
            x = cos * axes_t[0, r] + sin * axes_t[1, r]
            y = cos * axes_t[1, r] - sin * axes_t[0, r]
            for c in range(3):
                R = x * axes_s[0, c] + y * axes_s[1, c] + axes_t[2, r] * axes_s[2, c]
                S[n, r, c] = scale * R
        for r in range(3):
            S[n, r, 3] = mean_t[r]
            for c in range(3):
                S[n, r, 3] -= S[n, r, c] * mean_s[c]


@kernel
def _centre(X: F64, centred: F64, mean: F64) -> None:
    for c in range(3):
        mean[c] = (X[0, c] + X[1, c] + X[2, c]) / 3.0
        for k in range(3):
            centred[k, c] = X[k, c] - mean[c]


@kernel
def _axes_of(X: F64, axes: F64) -> bool:
    """Rows (3, 3): along the first of three centred points, at right angles to it in their plane,
    and out of it; False for collinear points.
    """
    a, b = X[0], X[1]
    for c in range(3):
        i, j = (c + 1) % 3, (c + 2) % 3
        axes[2, c] = a[i] * b[j] - a[j] * b[i]
    out = np.sqrt(axes[2, 0] ** 2 + axes[2, 1] ** 2 + axes[2, 2] ** 2)
    long = np.sqrt(a[0] ** 2 + a[1] ** 2 + a[2] ** 2)
    if not (out > 0.0 and long > 0.0):
        return False
    for c in range(3):
        axes[0, c], axes[2, c] = a[c] / long, axes[2, c] / out
    for c in range(3):
        i, j = (c + 1) % 3, (c + 2) % 3
        axes[1, c] = axes[2, i] * axes[0, j] - axes[2, j] * axes[0, i]
    return True
