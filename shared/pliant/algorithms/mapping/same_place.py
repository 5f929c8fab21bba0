"""Two keyframes that look alike: whether they show one place, and how their maps lie to each other.

For loops and for segments that meet.  Corners propose a similarity; the map's own points count.

Of pairs of points most may be wrong.  Three pairs give a similarity in closed form (Umeyama, PAMI
1991); RANSAC (Fischler and Bolles 1981) takes the one under which most points are seen where both
cameras saw them, as ORB-SLAM does for loops (Mur-Artal et al., T-RO 2015, section VII.B).  Depths
of a map are far less certain than directions, so errors are counted, and then minimised, in the
images and not in space.  Where both cameras stand at one place images say nothing of the scale,
so that what both maps say of depths has a little say, too.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from pliant.algorithms.arrays import F32, F64, I32, BoolArray
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import inverse, so3_exp, transform
from pliant.algorithms.mapping.map_store import MAPPED, PointRows
from pliant.algorithms.mapping.parameters import MappingParameters
from pliant.algorithms.mapping.point_patches import look_alike
from pliant.algorithms.mapping.reacquisition import MaximaGrid
from pliant.algorithms.mapping.relocalisation import Place, corners_in_map, repeats
from pliant.algorithms.places import match
from pliant.compiler.kernel import kernel

_ROUNDS = 10
_MOST = 1.0
"""Turn and change of the log scale within one round."""

_MIN_DEPTH = 1e-6

_DEPTH_SIGMA = 0.1
"""By what share two maps differ in the distance of a point.  Whatever parallax there is between
the keyframes says more: of a tenth of the depth, a pixel of 500 tells it to 2 %."""


@dataclass(frozen=True, kw_only=True)
class Pairs:
    """Points that may be the same, as each of two cameras has them.

    xyz_a, xyz_b: (N, 3) in the frame of the camera, whose maps differ in scale.   seen_a, seen_b:
    (N, 2) where it saw them, on the plane z = 1.
    """

    xyz_a: F64
    xyz_b: F64
    seen_a: F64
    seen_b: F64

    def of(self, rows: BoolArray) -> "Pairs":
        """Some of them."""
        return Pairs(
            xyz_a=self.xyz_a[rows], xyz_b=self.xyz_b[rows], seen_a=self.seen_a[rows],
            seen_b=self.seen_b[rows],
        )  # fmt: skip


def similarity_by_ransac(
    pairs: Pairs, generator: np.random.Generator, *, gate: float, samples: int
) -> tuple[F64, BoolArray] | None:
    """S_a_b (4, 4), ``xyz_a ~ S_a_b xyz_b``, and which pairs agree with it; None for fewer than
    four pairs, or where fewer than four agree.

    gate: largest error of a pair in either image, on the plane z = 1.
    """
    count = len(pairs.xyz_a)
    if count < 4:
        return None
    triples = generator.integers(0, count, (samples, 3))
    S = _closed_form(pairs.xyz_b[triples], pairs.xyz_a[triples])
    if not len(S):
        return None
    best = S[_least_cost(S, pairs.xyz_a, pairs.xyz_b, pairs.seen_a, pairs.seen_b, gate * gate)]
    for _ in range(2):  # with those that agree after the first round
        agreeing = _squared(best, pairs) < gate * gate
        if agreeing.sum() < 4:
            return None
        best = refine_similarity(best, pairs.of(agreeing), scale=gate)
    agreeing = _squared(best, pairs) < gate * gate
    return (best, agreeing) if agreeing.sum() >= 4 else None


def refine_similarity(S_a_b: F64, pairs: Pairs, *, scale: float) -> F64:
    """Gauss-Newton on the errors in both images and of distances, with Geman-McClure weights.

    scale: of these, on the plane z = 1.
    """
    for _ in range(_ROUNDS):
        H, g = _normal_equations(*residuals_of(S_a_b, pairs), scale, scale / _DEPTH_SIGMA)
        step = -np.linalg.solve(H + 1e-12 * np.trace(H) * np.eye(7), g)
        if not np.abs(step[[0, 1, 2, 6]]).max() < _MOST:
            break  # nothing holds it
        S_a_b = moved(S_a_b, step)
        if np.abs(step).max() < 1e-10:
            break
    return S_a_b


def moved(S: F64, step: F64) -> F64:
    """S (4, 4) after a step (omega, tau, sigma): ``X -> e^sigma exp(omega) X + tau``."""
    after = np.eye(4)
    after[:3, :3] = np.exp(step[6]) * so3_exp(step[:3])
    after[:3, 3] = step[3:6]
    return after @ S


def residuals_of(S_a_b: F64, pairs: Pairs) -> tuple[F64, F64]:
    """(N, 5) errors in the image of a, in that of b, and of the logarithm of the distance from a;
    (N, 5, 7) derivatives by ``moved``.

    With Y = S X_b: ``dY = -[Y] domega + dtau + Y dsigma``; S^-1 X_a turns with the opposite step;
    ``d log |Y| = Y . dY / |Y|^2``.
    """
    back = np.asarray(np.linalg.inv(S_a_b), np.float64)
    count = len(pairs.xyz_a)
    residuals, J = np.empty((count, 5)), np.empty((count, 5, 7))
    _linearise(
        S_a_b, back, pairs.xyz_a, pairs.xyz_b, pairs.seen_a, pairs.seen_b, residuals, J
    )  # fmt: skip
    return residuals, J


@kernel
def _linearise(
    S: F64, back: F64, xyz_a: F64, xyz_b: F64, seen_a: F64, seen_b: F64, residuals: F64, J: F64
) -> None:
    Y, Z, dY, dZ = np.empty(3), np.empty(3), np.empty((3, 7)), np.empty((3, 7))
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
    """(3, 7) of a point by ``moved``."""
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
    """(7, 7) and (7,) with Geman-McClure weights.   as_image: what distances count as."""
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
                for j in range(7):
                    H[i, j] += weight * J[n, k, i] * J[n, k, j]
    return H, g


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
    """Which of the similarities (n, 4, 4) has the least sum of the errors of ``_squared``, each at
    most so much.  A similarity is given up once its sum is no less than the least."""
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
    """Squared, of a point before a camera where it saw it; infinite behind."""
    if z <= 0.0:
        return np.inf
    z = max(z, _MIN_DEPTH)
    return (x / z - seen[0]) ** 2 + (y / z - seen[1]) ** 2


def _closed_form(source: F64, target: F64) -> F64:
    """(S, 4, 4) similarities that take source (S, 3, 3) rows to target; those of triples without
    extent, among them triples that have a point twice, are left out."""
    mean_source, mean_target = source.mean(axis=1), target.mean(axis=1)
    s, t = source - mean_source[:, None], target - mean_target[:, None]
    U, D, Vt = np.linalg.svd(np.swapaxes(t, 1, 2) @ s)
    signs = np.ones((len(source), 3))
    signs[:, 2] = np.sign(np.linalg.det(U) * np.linalg.det(Vt))
    extent = (s**2).sum(axis=(1, 2))
    good = D[:, 1] > 1e-9 * np.maximum(D[:, 0], 1e-300)
    R = (U * signs[:, None]) @ Vt
    scale = (D * signs).sum(axis=1) / np.where(extent > 0.0, extent, 1.0)
    S = np.broadcast_to(np.eye(4), (len(source), 4, 4)).copy()
    S[:, :3, :3] = scale[:, None, None] * R
    S[:, :3, 3] = mean_target - (S[:, :3, :3] @ mean_source[:, :, None])[:, :, 0]
    return S[good & (scale > 0.0)]


@dataclass(frozen=True, kw_only=True)
class SamePlace:
    """What two keyframes both saw.

    S_old_new: (4, 4) similarity, ``X_old = S_old_new X_new``, between the worlds of their segments;
    of one segment: how far what is new has drifted.
    rows: (n, 2) rows of points that are the same, old and new; a row at most once in each column.
    """

    S_old_new: F64
    rows: I32


Refusal = Literal["few_corners", "few_points", "one_spot", "repeated"]
"""Why it is not proved that two keyframes show one place: too few corners agree on a similarity,
too few points of the two maps, all that agrees lies in one spot of the image, or is seen again a
step aside."""


def same_place(
    old: Place,
    new: Place,
    points: PointRows,
    camera: PinholeCamera,
    parameters: MappingParameters,
    generator: np.random.Generator,
) -> SamePlace | Refusal:
    """What proves that both keyframes show one place, or why it is not proved.

    In both images, corners and points of both maps that look alike must agree on the similarity,
    as many as a pose needs, and not in one spot.
    """
    limits = parameters.localisation
    alike = match(old.features, new.features)
    corners: list[tuple[F64, F64]] = []
    known = np.ones(len(alike), np.bool_)
    for place, column in ((old, 0), (new, 1)):
        xyz, deep = corners_in_map(place.keyframe, place.features, points, camera)
        here = transform(inverse(place.keyframe.T_world_camera), xyz)[alike[:, column]]
        seen = camera.normalise(place.features.points_px[alike[:, column]].astype(np.float64))
        corners.append((here, seen))
        known &= deep[alike[:, column]]
    (xyz_a, seen_a), (xyz_b, seen_b) = corners
    if np.count_nonzero(known) < parameters.recovery.min_agreeing:
        return "few_corners"
    pairs = Pairs(xyz_a=xyz_a, xyz_b=xyz_b, seen_a=seen_a, seen_b=seen_b).of(known)
    found = similarity_by_ransac(
        pairs, generator, gate=limits.ransac_gate_px / camera.fx,
        samples=parameters.recovery.ransac_samples,
    )  # fmt: skip
    if found is None or found[1].sum() < parameters.recovery.min_agreeing:
        return "few_corners"
    S_a_b, agreeing = found
    rows, points_px = np.zeros((0, 2), np.int32), np.zeros((0, 2), np.float32)
    for gate_px in (limits.ransac_gate_px, limits.inlier_px):
        rows, guided, points_px = _guided(
            S_a_b, old, new, points, camera, gate_px, parameters.reacquisition.min_zncc
        )
        if len(rows) < limits.min_inliers:
            return "few_points"
        S_a_b = refine_similarity(S_a_b, guided, scale=gate_px / camera.fx)
    spread = (points_px.std(axis=0) / np.array([camera.width, camera.height])).min()
    if spread < parameters.support.min_spread:
        return "one_spot"
    agreeing_corners = alike[known][agreeing, 1]
    if repeats(new.features, agreeing_corners, pairs.xyz_b[agreeing], camera, parameters):
        return "repeated"
    return SamePlace(S_old_new=_between_worlds(S_a_b, old, new), rows=rows)


def _between_worlds(S_a_b: F64, old: Place, new: Place) -> F64:
    """A similarity between two keyframes as one between their worlds."""
    return old.keyframe.T_world_camera @ S_a_b @ inverse(new.keyframe.T_world_camera)


def _guided(
    S_a_b: F64,
    old: Place,
    new: Place,
    points: PointRows,
    camera: PinholeCamera,
    gate_px: float,
    min_zncc: float,
) -> tuple[I32, Pairs, F32]:
    """Points of the old keyframe and of the new that each shows where the other one saw its own,
    and that look alike: where two dense maps only have the same surfaces, many lie near another.

    Returns their rows (n, 2), themselves, and where the old keyframe saw them."""
    rows: list[I32] = []
    places: list[F32] = []
    here: list[F64] = []
    for place in (old, new):
        mapped = points.state[place.keyframe.rows] == MAPPED
        rows.append(place.keyframe.rows[mapped])
        places.append(place.keyframe.points_px[mapped])
        here.append(transform(inverse(place.keyframe.T_world_camera), points.xyz[rows[-1]]))
    to_new = transform(np.asarray(np.linalg.inv(S_a_b), np.float64), here[0])
    to_old = transform(S_a_b, here[1])
    nearest = _nearest(to_new, places[1], camera, gate_px)
    back = _nearest(to_old, places[0], camera, gate_px)
    a = np.flatnonzero(nearest >= 0)
    a = a[back[nearest[a]] == a]
    a = a[points.kappas[rows[0][a]] * points.kappas[rows[1][nearest[a]]] > 0.0]
    S_old_new = _between_worlds(S_a_b, old, new)
    paired = np.column_stack([rows[0][a], rows[1][nearest[a]]])
    a = a[look_alike(S_old_new, paired, old.segment, new.segment, points, min_zncc)]
    b = nearest[a]
    seen = [camera.normalise(px.astype(np.float64)) for px in (places[0][a], places[1][b])]
    pairs = Pairs(xyz_a=here[0][a], xyz_b=here[1][b], seen_a=seen[0], seen_b=seen[1])
    return np.column_stack([rows[0][a], rows[1][b]]), pairs, places[0][a]


def _nearest(points_camera: F64, points_px: F32, camera: PinholeCamera, gate_px: float) -> I32:
    """(N,) which of the pixels is nearest to where a camera has a point, -1 without one."""
    seen = np.column_stack([points_px, np.zeros(len(points_px), np.float32)])
    grid = MaximaGrid.build(seen, camera.width, camera.height, gate_px)
    front = points_camera[:, 2] > 0.0
    ahead = np.where(front[:, None], points_camera, np.array([0.0, 0.0, 1.0]))
    places = camera.project(ahead)
    inside = front & (places >= 0.0).all(axis=1)
    inside &= (places < (camera.width, camera.height)).all(axis=1)
    nearest = grid.nearest(np.where(inside[:, None], places, 0.0).astype(np.float32), gate_px)
    return np.where(inside, nearest, -1).astype(np.int32)
