"""The pose of a camera from points of the map: P3P inside RANSAC.

P3P follows Grunert's equations as Haralick et al. give them ("Review and Analysis of Solutions of
the Three Point Perspective Pose Estimation Problem", IJCV 1994, section 3.1); its quartic is solved
by Ferrari's method and polished by Newton steps.  RANSAC (Fischler and Bolles 1981) scores
hypotheses by the truncated squared error (MSAC, Torr and Zisserman 2000).
"""

import math

import numpy as np

from pliant.algorithms.arrays import F64, I64, BoolArray
from pliant.compiler.kernel import fast_kernel, kernel

_SMALL = 1e-12


@fast_kernel
def _largest_root_of_cubic(a: float, b: float, c: float) -> float:
    """The largest real root of x^3 + a x^2 + b x + c."""
    q = (a * a - 3.0 * b) / 9.0
    r = (2.0 * a * a * a - 9.0 * a * b + 27.0 * c) / 54.0
    if r * r < q * q * q:
        theta = math.acos(r / math.sqrt(q * q * q))
        # The three roots differ by a third of a turn; this one has the largest cosine.
        return -2.0 * math.sqrt(q) * math.cos((theta + 2.0 * math.pi) / 3.0) - a / 3.0
    size = (abs(r) + math.sqrt(max(r * r - q * q * q, 0.0))) ** (1.0 / 3.0)
    first = -size if r > 0.0 else size
    second = q / first if first != 0.0 else 0.0
    return first + second - a / 3.0


@fast_kernel
def _quartic_roots(A4: float, A3: float, A2: float, A1: float, A0: float, roots: F64) -> int:
    """Real roots of A4 x^4 + ... + A0 into ``roots`` (4,); returns how many."""
    if abs(A4) < _SMALL:
        return 0
    a, b, c, d = A3 / A4, A2 / A4, A1 / A4, A0 / A4
    # x = y - a / 4 leaves y^4 + p y^2 + q y + r.
    p = b - 0.375 * a * a
    q = c - 0.5 * a * b + 0.125 * a * a * a
    r = d - 0.25 * a * c + a * a * b / 16.0 - 3.0 * a**4 / 256.0
    count = 0
    m = _largest_root_of_cubic(p, 0.25 * p * p - r, -0.125 * q * q)
    if m > _SMALL:
        s = math.sqrt(2.0 * m)
        for sign in (1.0, -1.0):
            inner = -(2.0 * p + 2.0 * m + sign * 2.0 * q / s)
            # A slightly negative value is a double root blurred by rounding.
            if inner > -1e-9 * (1.0 + abs(p)):
                w = math.sqrt(max(inner, 0.0))
                roots[count] = 0.5 * (sign * s + w)
                roots[count + 1] = 0.5 * (sign * s - w)
                count += 2
    else:
        discriminant = 0.25 * p * p - r
        if discriminant >= 0.0:
            for sign in (1.0, -1.0):
                square = -0.5 * p + sign * math.sqrt(discriminant)
                if square >= 0.0:
                    roots[count] = math.sqrt(square)
                    roots[count + 1] = -math.sqrt(square)
                    count += 2
    for i in range(count):
        x = roots[i] - 0.25 * a
        for _ in range(3):
            slope = ((4.0 * x + 3.0 * a) * x + 2.0 * b) * x + c
            if abs(slope) > _SMALL:
                x -= ((((x + a) * x + b) * x + c) * x + d) / slope
        roots[i] = x
    return count


@fast_kernel
def _frame_of_triangle(x: F64, frame: F64) -> bool:
    """Orthonormal axes (columns of ``frame``) of the triangle with corners ``x`` (3, 3) rows."""
    ax, ay, az = x[1, 0] - x[0, 0], x[1, 1] - x[0, 1], x[1, 2] - x[0, 2]
    bx, by, bz = x[2, 0] - x[0, 0], x[2, 1] - x[0, 1], x[2, 2] - x[0, 2]
    nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    a = math.sqrt(ax * ax + ay * ay + az * az)
    n = math.sqrt(nx * nx + ny * ny + nz * nz)
    if a < _SMALL or n < 1e-9 * a * a:
        return False
    ax, ay, az, nx, ny, nz = ax / a, ay / a, az / a, nx / n, ny / n, nz / n
    frame[0, 0], frame[1, 0], frame[2, 0] = ax, ay, az
    frame[0, 1], frame[1, 1], frame[2, 1] = ny * az - nz * ay, nz * ax - nx * az, nx * ay - ny * ax
    frame[0, 2], frame[1, 2], frame[2, 2] = nx, ny, nz
    return True


@kernel
def p3p(points_world: F64, rays: F64, R_out: F64, t_out: F64) -> int:
    """Poses of a camera that sees three points along three unit rays.

    points_world: (3, 3) rows.  rays: (3, 3) unit rows.  R_out (4, 3, 3) and t_out (4, 3) receive
    the solutions as ``points_camera = R @ points_world + t``.  Returns how many there are, 0 for a
    degenerate triangle.
    """
    x, f = points_world, rays
    a2, b2, c2 = 0.0, 0.0, 0.0
    cos_a, cos_b, cos_c = 0.0, 0.0, 0.0
    for k in range(3):
        a2 += (x[1, k] - x[2, k]) ** 2
        b2 += (x[0, k] - x[2, k]) ** 2
        c2 += (x[0, k] - x[1, k]) ** 2
        cos_a += f[1, k] * f[2, k]
        cos_b += f[0, k] * f[2, k]
        cos_c += f[0, k] * f[1, k]
    frame_world = np.empty((3, 3))
    if b2 < _SMALL or not _frame_of_triangle(x, frame_world):
        return 0
    d, e, g, h = (a2 - c2) / b2, (a2 + c2) / b2, c2 / b2, a2 / b2
    A4 = (d - 1.0) ** 2 - 4.0 * g * cos_a**2
    A3 = 4.0 * (d * (1.0 - d) * cos_b - (1.0 - e) * cos_a * cos_c + 2.0 * g * cos_a * cos_a * cos_b)
    A2 = 2.0 * (
        d * d
        - 1.0
        + 2.0 * d * d * cos_b**2
        + 2.0 * (1.0 - g) * cos_a**2
        - 4.0 * e * cos_a * cos_b * cos_c
        + 2.0 * (1.0 - h) * cos_c**2
    )
    A1 = 4.0 * (
        -d * (1.0 + d) * cos_b + 2.0 * h * cos_c * cos_c * cos_b - (1.0 - e) * cos_a * cos_c
    )
    A0 = (1.0 + d) ** 2 - 4.0 * h * cos_c**2
    roots = np.empty(4)
    count = 0
    corners, frame_camera = np.empty((3, 3)), np.empty((3, 3))
    for i in range(_quartic_roots(A4, A3, A2, A1, A0, roots)):
        v = roots[i]
        below = 2.0 * (cos_c - v * cos_a)
        length2 = 1.0 + v * v - 2.0 * v * cos_b
        if v <= 0.0 or abs(below) < _SMALL or length2 < _SMALL:
            continue
        u = ((d - 1.0) * v * v - 2.0 * d * cos_b * v + 1.0 + d) / below
        if u <= 0.0:
            continue
        s = math.sqrt(b2 / length2)
        for k in range(3):
            corners[0, k], corners[1, k], corners[2, k] = (
                s * f[0, k],
                u * s * f[1, k],
                v * s * f[2, k],
            )
        if not _frame_of_triangle(corners, frame_camera):
            continue
        for r in range(3):
            for c in range(3):
                R_out[count, r, c] = (
                    frame_camera[r, 0] * frame_world[c, 0]
                    + frame_camera[r, 1] * frame_world[c, 1]
                    + frame_camera[r, 2] * frame_world[c, 2]
                )
        for r in range(3):
            t_out[count, r] = corners[0, r] - (
                R_out[count, r, 0] * x[0, 0]
                + R_out[count, r, 1] * x[0, 1]
                + R_out[count, r, 2] * x[0, 2]
            )
        count += 1
    return count


@kernel
def truncated_cost(R: F64, t: F64, points_world: F64, points_n: F64, gate: float) -> float:
    """Sum over points of min(squared error, gate^2); points behind the camera cost gate^2.

    R, t: ``points_camera = R @ points_world + t``.  points_n: (N, 2) on the plane z = 1, ``gate``
    in the same unit.
    """
    cost, limit = 0.0, gate * gate
    for i in range(points_world.shape[0]):
        X, Y, Z = points_world[i, 0], points_world[i, 1], points_world[i, 2]
        z = R[2, 0] * X + R[2, 1] * Y + R[2, 2] * Z + t[2]
        error = limit
        if z > 0.0:
            du = (R[0, 0] * X + R[0, 1] * Y + R[0, 2] * Z + t[0]) / z - points_n[i, 0]
            dv = (R[1, 0] * X + R[1, 1] * Y + R[1, 2] * Z + t[1]) / z - points_n[i, 1]
            error = min(limit, du * du + dv * dv)
        cost += error
    return cost


@kernel
def _ransac(
    points_world: F64, points_n: F64, rays: F64, triples: I64, gate: float, R_best: F64, t_best: F64
) -> float:
    best = np.inf
    R, t = np.empty((4, 3, 3)), np.empty((4, 3))
    x, f = np.empty((3, 3)), np.empty((3, 3))
    for s in range(triples.shape[0]):
        for k in range(3):
            x[k], f[k] = points_world[triples[s, k]], rays[triples[s, k]]
        for h in range(p3p(x, f, R, t)):
            cost = truncated_cost(R[h], t[h], points_world, points_n, gate)
            if cost < best:
                best = cost
                R_best[:], t_best[:] = R[h], t[h]
    return best


def pose_by_ransac(
    points_world: F64,
    points_n: F64,
    generator: np.random.Generator,
    *,
    gate: float,
    samples: int,
    scored: int = 400,
) -> tuple[F64, BoolArray] | None:
    """T_world_camera by P3P and RANSAC, not yet refined, and which points agree with it.

    points_world: (N, 3).  points_n: (N, 2) on the plane z = 1.  ``gate`` is the largest error of an
    inlier in the same unit; ``scored`` points judge each hypothesis, all judge the best.  Returns
    None where fewer than four points are given or none agree.
    """
    count = len(points_world)
    if count < 4:
        return None
    chosen = generator.permutation(count)[:scored]
    X, x = np.ascontiguousarray(points_world[chosen]), np.ascontiguousarray(points_n[chosen])
    rays = np.column_stack([x, np.ones(len(x))])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    triples = generator.integers(0, len(X), (samples, 3))
    R, t = np.eye(3), np.zeros(3)
    if not np.isfinite(_ransac(X, x, rays, triples, gate, R, t)):
        return None
    camera = points_world @ R.T + t
    with np.errstate(divide="ignore", invalid="ignore"):
        error = np.linalg.norm(camera[:, :2] / camera[:, 2:] - points_n, axis=1)
    inliers = (camera[:, 2] > 0.0) & (error < gate)
    if not inliers.any():
        return None
    T_world_camera = np.eye(4)
    T_world_camera[:3, :3] = R.T
    T_world_camera[:3, 3] = -R.T @ t
    return T_world_camera, inliers
