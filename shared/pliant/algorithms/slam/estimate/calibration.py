"""A calibration that all cameras share as a further unknown of bundle adjustment.

The projection is

    u = fx e^s       ((1 + k1 r^2 + k2 r^4) x + a) + cx
    v = fy e^(s + t) ((1 + k1 r^2 + k2 r^4) y + b) + cy

with r^2 = x^2 + y^2 on the plane z = 1, and the unknowns are q = (s, k1, k2, readout, a, b, t),
where (a, b) is the error of the principal point, and t that of the aspect ratio fy / fx.  At (a, b)
= 0 the derivative by one of the first three is ``K (x, y)^T h_q`` with K = diag(fx e^s,
fy e^(s + t)) and

    h = (1 + k1 r^2 + k2 r^4,  r^2,  r^4)       for  s, k1, k2.

The Jacobian of the lens is ``F = K D`` with ``D = d I + e (x, y)^T (x, y)``, where d is h_s and
e = 2 k1 + 4 k2 r^2.  (x, y) is an eigenvector of D: ``D (x, y)^T = (d + e r^2) (x, y)^T``.
So a calibration unknown moves the point on the plane z = 1 as if by

    A_q = (x, y)^T rho_q,     rho_q = h_q / (1 + 3 k1 r^2 + 5 k2 r^4),     F A_q = d(u, v) / dq.

The fourth unknown is the readout of a rolling shutter, as a share of the frame interval: it moves
an observation by the readout times its flow, so that ``A = F^-1 flow``.  The next two move all
of them alike: ``A = D^-1 (1, 0)^T`` and ``D^-1 (0, 1)^T``; and where they are not 0, s moves by
``D^-1 (a, b)^T`` as well.  The last has dv/dt = v - cy, so that ``A = D^-1 (0, d y + b)^T``.  An
unknown enters the Hessian of Eq. 7 like a column of B (see ``projection``): with M and e of that
module its blocks are

    H_qq = sum A^T M A     H_qc = sum A^T M B     H_qp = sum A^T M P     - g_q = sum A^T e.

So the calibration is one more camera, which sees every point, and Eq. 9 becomes an arrow,

    (S_cc  S_qc^T) (dx_c)   (b_c)
    (S_qc  S_qq  ) (dx_q) = (b_q)     S = H + damping diag(H) - U U^T,  U_q = H_qp L^-T,

as sparse as before, with one row and one column of blocks that are full.  A block has six unknowns:
with a free aspect ratio there are two such cameras, the second with five empty unknowns.  A prior
at the given calibration adds its precision to H_qq and its gradient to b_q.
"""

from typing import Any, NamedTuple

import numpy as np

from pliant.algorithms.arrays import F32, F64, I32, BoolArray
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.slam.estimate.dense_layout import BLOCK
from pliant.algorithms.slam.estimate.normal_equations import RECORD
from pliant.algorithms.slam.estimate.packed_layout import PackedLayout, Slots
from pliant.algorithms.slam.estimate.problem import SHARED, CalibrationUncertainty
from pliant.algorithms.slam.estimate.projection import (
    Cameras,
    apply_metric,
    couple,
    motion_of,
    pinhole_of,
    point_rows,
)
from pliant.compiler.kernel import fast_kernel, kernel

_NEWTON_STEPS = 8
_SQUARES_TO_ROUNDING = 1e-8
"""A Newton step after which the error, about its square, is below rounding."""
_LEAST_SLOPE = 0.1
_FARTHEST = 4.0
"""Maximum ratio of corrected to observed radius: no lens within the model exceeds it."""


class SharedBlocks(NamedTuple):
    """The blocks of a shared calibration in one state.

    Of R blocks of six unknowns, those of q first.
    own: (6 R, 6 R) lower triangle of H_qq, without the prior.     gradient: (6 R,) -g_q.
    cameras: (M, 36 R) H_qc of each camera by rows.     points: (P, 18 R) H_qp by rows.
    """

    own: F64
    gradient: F64
    cameras: F64
    points: F64


def no_shared_blocks() -> SharedBlocks:
    """Return the blocks of a fixed calibration."""
    return SharedBlocks(np.zeros((0, 0)), np.zeros(0), np.zeros((0, 0)), np.zeros((0, 18)))


class SharedCalibration:
    """The calibration of one problem: its initial value, its prior, its effect on the layout.

    given: (SHARED,) mean of the prior.     start: (SHARED,) initial value.
    unknown: (SHARED,) which values are unknowns; the others are fixed.
    """

    def __init__(
        self,
        layout: PackedLayout,
        lens: F64,
        uncertainty: CalibrationUncertainty,
        start: F64 | None = None,
    ):
        """lens: (M, 2) k1, k2 as given.  start: (SHARED,), None: at the given calibration.

        Raises ValueError if cameras have different lenses.
        """
        if len(lens) == 0 or (lens != lens[0]).any():
            raise ValueError("an unknown calibration must be that of all cameras")
        sigmas = uncertainty.sigmas
        self.layout = layout
        self.given: F64 = np.zeros(SHARED)
        self.given[1:3] = lens[0]
        self.start: F64 = self.given if start is None else start.copy()
        self.unknown = sigmas > 0.0
        self.unknown[3] &= layout.flow.size > 0
        self.borders = 1 + int(self.unknown[6])
        self.precision: F64 = np.zeros(SHARED)
        self.precision[self.unknown] = (uncertainty.prior_px / sigmas[self.unknown]) ** 2

    def at(self, q: F64) -> tuple[Cameras, Slots]:
        """Return the cameras and observations for a calibration."""
        layout = self.layout
        pinhole = layout.cameras.pinhole.copy()
        pinhole[:, :2] *= np.exp(q[0])
        pinhole[:, 1] *= np.exp(q[6])
        pinhole[:, 2:] += pinhole[:, :2] * q[4:6]
        lens = np.tile(q[1:3], (len(pinhole), 1))
        cameras = layout.cameras._replace(pinhole=pinhole, lens=lens)
        if not self.unknown[3]:
            return cameras, layout.slots
        moved = np.float32(q[3]) * layout.flow
        slots = layout.slots
        return cameras, slots._replace(u=slots.u - moved[0], v=slots.v - moved[1])

    def prior_cost(self, q: F64) -> float:
        """Cost of the deviation from the given calibration, px^2."""
        return 0.5 * float(self.precision @ (q - self.given) ** 2)

    def linearise(self, cameras: Cameras, records: F64, q: F64) -> SharedBlocks:
        """The blocks in the state of the records, at a calibration."""
        layout, width = self.layout, 6 * self.borders
        blocks = SharedBlocks(
            own=np.zeros((width, width)),
            gradient=np.zeros(width),
            cameras=np.zeros((len(layout.free), 6 * width)),
            points=np.zeros((layout.points.shape[1], 3 * width)),
        )
        _add_shared(cameras, layout.slots, layout.flow, self.unknown, q[4:6], records, blocks)
        return blocks

    def padded(self, q: F64) -> F64:
        """(6 R,) of q (SHARED,): with the unknowns of its blocks that stay empty."""
        return np.concatenate([q, np.zeros(6 * self.borders)])[: 6 * self.borders]

    def change(self, solution: F64) -> F64:
        """(SHARED,) of the solution (N, 6) of the reduced system."""
        return np.concatenate([solution[-self.borders :].ravel(), np.zeros(SHARED)])[:SHARED]


@fast_kernel
def _add_shared(
    cameras: Cameras,
    slots: Slots,
    flow: F32,
    unknown: BoolArray,
    principal: F64,
    records: F64,
    blocks: SharedBlocks,
) -> None:
    """Add up the blocks.

    principal: (2,) a, b.    records: (O + 1, RECORD) of ``normal_equations``.
    """
    local = np.empty(RECORD * BLOCK)
    A = np.zeros(2 * SHARED * BLOCK)
    for b in range(slots.camera.size):
        m = slots.camera[b]
        for i in range(BLOCK):
            at = np.uint32(slots.place[b, i])
            for k in range(RECORD):
                local[k * BLOCK + i] = records[at, k]
        _moves(cameras, m, principal, local, A)
        if unknown[3]:
            _readout_moves(cameras, m, local, flow[0, b], flow[1, b], A)
        _add_own(local, A, unknown, blocks.own, blocks.gradient, blocks.cameras[m])
        _add_points(cameras, m, slots.point[b], local, A, unknown, blocks.points)


@fast_kernel
def _shares(n2: Any, k1: Any, k2: Any) -> Any:
    """rho of s, k1 and k2 at the squared radius n2."""
    inverse = 1.0 / (1.0 + n2 * (3.0 * k1 + 5.0 * k2 * n2))
    return (1.0 + n2 * (k1 + k2 * n2)) * inverse, n2 * inverse, n2 * n2 * inverse


@fast_kernel
def _inverse_of_lens(x: Any, y: Any, k1: Any, k2: Any) -> Any:
    """D^-1, which is symmetric, by Sherman and Morrison: (xx, xy, yy)."""
    n2 = x * x + y * y
    d, e = 1.0 + n2 * (k1 + k2 * n2), 2.0 * k1 + 4.0 * k2 * n2
    t = e / (d * (d + e * n2))
    return 1.0 / d - t * x * x, -t * x * y, 1.0 / d - t * y * y


@fast_kernel
def _moves(cameras: Cameras, m: int, principal: F64, local: F64, A: F64) -> None:
    """Write A (SHARED x 2 x BLOCK) of one camera and block but for the readout."""
    k1, k2 = cameras.lens[m, 0], cameras.lens[m, 1]
    a, c = principal[0], principal[1]
    for i in range(BLOCK):
        x, y = local[i], local[BLOCK + i]
        s0, s1, s2 = _shares(x * x + y * y, k1, k2)
        d0, d1, d2 = _inverse_of_lens(x, y, k1, k2)
        A[i], A[BLOCK + i] = s0 * x + d0 * a + d1 * c, s0 * y + d1 * a + d2 * c
        A[2 * BLOCK + i], A[3 * BLOCK + i] = s1 * x, s1 * y
        A[4 * BLOCK + i], A[5 * BLOCK + i] = s2 * x, s2 * y
        A[8 * BLOCK + i], A[9 * BLOCK + i] = d0, d1
        A[10 * BLOCK + i], A[11 * BLOCK + i] = d1, d2
        n2 = x * x + y * y
        below = (1.0 + n2 * (k1 + k2 * n2)) * y + c
        A[12 * BLOCK + i], A[13 * BLOCK + i] = d1 * below, d2 * below


@fast_kernel
def _readout_moves(cameras: Cameras, m: int, local: F64, fu: F32, fv: F32, A: F64) -> None:
    """``A = D^-1 K^-1 flow``."""
    K, k1, k2 = pinhole_of(cameras, m), cameras.lens[m, 0], cameras.lens[m, 1]
    for i in range(BLOCK):
        d0, d1, d2 = _inverse_of_lens(local[i], local[BLOCK + i], k1, k2)
        a, c = fu[i] / K[0], fv[i] / K[1]
        A[6 * BLOCK + i], A[7 * BLOCK + i] = d0 * a + d1 * c, d1 * a + d2 * c


@fast_kernel
def camera_moves(
    cameras: Cameras, m: int, b: int, principal: F64, local: F64, flow: F32, rolls: bool, A: F64
) -> None:
    """Write A (SHARED x 2 x BLOCK) of camera m and block b, for other modules."""
    _moves(cameras, m, principal, local, A)
    if rolls:
        _readout_moves(cameras, m, local, flow[0, b], flow[1, b], A)


@fast_kernel
def _add_own(local: F64, A: F64, unknown: BoolArray, own: F64, gradient: F64, cross: F64) -> None:
    """Add ``A^T M A``, ``A^T e`` and ``A^T M B`` (SHARED x 6 by rows)."""
    for q in range(SHARED):
        if not unknown[q]:
            continue
        Aq = A[2 * q * BLOCK :]
        for p in range(q + 1):
            if not unknown[p]:
                continue
            Ap = A[2 * p * BLOCK :]
            h = 0.0
            for i in range(BLOCK):
                m00, m01, m11 = local[3 * BLOCK + i], local[4 * BLOCK + i], local[5 * BLOCK + i]
                a, c = apply_metric(m00, (m01,), m11, Ap[i], Ap[BLOCK + i])
                h += Aq[i] * a + Aq[BLOCK + i] * c
            own[q, p] += h
        g = t0 = t1 = t2 = t3 = t4 = t5 = 0.0
        for i in range(BLOCK):
            x, y, iz = local[i], local[BLOCK + i], local[2 * BLOCK + i]
            m00, m01, m11 = local[3 * BLOCK + i], local[4 * BLOCK + i], local[5 * BLOCK + i]
            g += Aq[i] * local[6 * BLOCK + i] + Aq[BLOCK + i] * local[7 * BLOCK + i]
            a, c = apply_metric(m00, (m01,), m11, Aq[i], Aq[BLOCK + i])
            d0, d1, d2, d3, d4, d5 = couple(x, y, iz, a, c)
            t0 += d0
            t1 += d1
            t2 += d2
            t3 += d3
            t4 += d4
            t5 += d5
        gradient[q] += g
        sums = (t0, t1, t2, t3, t4, t5)
        for k in range(6):
            cross[6 * q + k] += sums[k]


@fast_kernel
def _add_points(
    cameras: Cameras, m: int, point: I32, local: F64, A: F64, unknown: BoolArray, points: F64
) -> None:
    """Add ``A^T M P`` (SHARED x 3 by rows) of one camera and block to its points."""
    T = motion_of(cameras, m)
    for i in range(BLOCK):
        n = np.uint32(point[i])
        m00, m01, m11 = local[3 * BLOCK + i], local[4 * BLOCK + i], local[5 * BLOCK + i]
        p0, p1, p2, q0, q1, q2 = point_rows(T, local[i], local[BLOCK + i], local[2 * BLOCK + i])
        for q in range(SHARED):
            if not unknown[q]:
                continue
            Aq = A[2 * q * BLOCK :]
            a, c = apply_metric(m00, (m01,), m11, Aq[i], Aq[BLOCK + i])
            points[n, 3 * q] += a * p0 + c * q0
            points[n, 3 * q + 1] += a * p1 + c * q1
            points[n, 3 * q + 2] += a * p2 + c * q2


def ideal_pixels(points_px: F32, camera: PinholeCamera, correction: F64) -> F32:
    """Move pixels (N, 2) of the image to where ``camera`` would see them if its calibration were
    correct.

    correction: (SHARED,) of ``solve_schur``; the readout is not removed here.  Newton's method on
    the radius, to rounding for corrections under which the radius grows with the angle; otherwise
    the nearest value that it reaches.
    """
    ideal = np.empty((len(points_px), 2), np.float32)
    K = camera.intrinsics
    s, t = correction[0], correction[6]
    _ideal_pixels(points_px, K, correction, (np.exp(-s), np.exp(-s - t)), ideal)
    return ideal


@kernel
def _ideal_pixels(
    points_px: F32, K: F64, correction: F64, shrunk: tuple[float, float], ideal: F32
) -> None:
    """In blocks: a step is SIMD code.  Each point stops once it has converged."""
    k1, k2, a, b = correction[1], correction[2], correction[4], correction[5]
    fx, fy, cx, cy = K
    x, y, wanted, r = np.empty((4, BLOCK))
    settled = np.empty(BLOCK, np.bool_)
    for first in range(0, points_px.shape[0], BLOCK):
        size = min(BLOCK, points_px.shape[0] - first)
        for i in range(size):
            x[i] = shrunk[0] / fx * (points_px[first + i, 0] - np.float32(cx)) - a
            y[i] = shrunk[1] / fy * (points_px[first + i, 1] - np.float32(cy)) - b
            wanted[i] = np.sqrt(x[i] * x[i] + y[i] * y[i])
        r[:], settled[:size], settled[size:] = wanted, False, True
        for _ in range(_NEWTON_STEPS):
            _newton_step(wanted, k1, k2, r, settled)
            if settled.all():
                break
        for i in range(size):
            share = r[i] / wanted[i] if wanted[i] > 0.0 else 1.0
            ideal[first + i, 0] = cx + fx * x[i] * share
            ideal[first + i, 1] = cy + fy * y[i] * share


@kernel
def _newton_step(wanted: F64, k1: float, k2: float, r: F64, settled: BoolArray) -> None:
    """Move the radii r (BLOCK,) that have not converged yet."""
    for i in range(BLOCK):
        before = r[i]
        r2 = before * before
        slope = max(1.0 + r2 * (3.0 * k1 + 5.0 * k2 * r2), _LEAST_SLOPE)
        after = before - (before * (1.0 + r2 * (k1 + k2 * r2)) - wanted[i]) / slope
        after = min(max(after, 0.0), _FARTHEST * wanted[i])
        r[i] = before if settled[i] else after
        settled[i] |= abs(after - before) <= _SQUARES_TO_ROUNDING * wanted[i]
