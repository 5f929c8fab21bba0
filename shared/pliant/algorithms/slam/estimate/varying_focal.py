"""A focal length that changes between cameras: one more unknown for each of them.

Zoom, focus breathing and cropped stabilisation change it during a clip.  Camera m projects with
``fx e^(s + z_m)``, where s is that of the shared calibration and z_m its own.  Two priors hold z: a
random walk in time and a spread about 0,

    z_(m+1) - z_m ~ N(0, rate^2 dt)      z_m ~ N(0, spread^2).

The Jacobian by z_m is that by s (``calibration``), for the observations of camera m alone.  Six of
these unknowns share one block of the reduced system, like one more camera, with the blocks of all
six cameras.  Separate kernels add them to the system of ``normal_equations``, so that a system with
one focal length is unchanged.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pliant.algorithms.arrays import F32, F64, I32, I64, BoolArray
from pliant.algorithms.slam.estimate.calibration import camera_moves
from pliant.algorithms.slam.estimate.dense_layout import BLOCK
from pliant.algorithms.slam.estimate.normal_equations import (
    RECORD,
    CameraSystem,
    Linearised,
    Scratch,
)
from pliant.algorithms.slam.estimate.packed_layout import PackedLayout, Slots
from pliant.algorithms.slam.estimate.problem import SHARED
from pliant.algorithms.slam.estimate.projection import (
    Cameras,
    apply_metric,
    couple,
    motion_of,
    point_rows,
)
from pliant.algorithms.slam.estimate.reduced import subtract_product3
from pliant.compiler.kernel import fast_kernel, kernel

PER_BLOCK = 6
_LEAST_GAP_S = 1e-3


@dataclass(frozen=True, kw_only=True)
class FocalWalk:
    """Prior of the log focal lengths z of the cameras, relative to the shared one.

    gaps_s: (M - 1,) between the cameras, inf where unknown.   rate: standard deviation of the
    change of z in one second, growing with the square root of time.   spread: standard deviation of
    each z.   start: (M,) z to begin from.
    """

    gaps_s: F64
    rate: float
    spread: float
    start: F64

    def precision(self, prior_px: float) -> tuple[F64, F64]:
        """(M,) of each z about 0, and (M - 1,) of each change, px^2."""
        return (
            np.full(len(self.start), (prior_px / self.spread) ** 2),
            prior_px**2 / (self.rate**2 * np.maximum(self.gaps_s, _LEAST_GAP_S)),
        )


class FocalBlocks(NamedTuple):
    """The blocks of the focal lengths in one state.

    own: (M, 6 R) of each z and the shared calibration; the first is its own H_zz, too.
    gradient: (M,) -g_z.   cameras: (M, 6) H_zc.   points: (O + 1, 3) H_zp of each place.
    """

    own: F64
    gradient: F64
    cameras: F64
    points: F64


class VaryingFocal:
    """The focal lengths of one problem: their initial values, their prior, their part of the
    system.

    position: (G,) of each block of six in the order of elimination.
    """

    def __init__(self, layout: PackedLayout, walk: FocalWalk, prior_px: float) -> None:
        self.layout = layout
        self.start = walk.start.copy()
        self.spread, self.walk = walk.precision(prior_px)
        self.position: I32 = np.zeros(0, np.int32)
        self._blocks: FocalBlocks | None = None

    def meetings(self, met: BoolArray, moving: I64) -> BoolArray:
        """(F + G, F + G) of the movable cameras and the blocks, from (M, M) of all cameras."""
        group = np.arange(len(met)) // PER_BLOCK
        G, F = int(group[-1]) + 1, len(moving)
        of_group = np.zeros((G, len(met)), np.bool_)
        for m, g in enumerate(group):
            of_group[g] |= met[m]
        both = np.zeros((F + G, F + G), np.bool_)
        both[:F, :F] = met[np.ix_(moving, moving)]
        both[F:, :F] = of_group[:, moving]
        both[:F, F:] = of_group[:, moving].T
        for g in range(G):
            both[F + g, F:] = [of_group[g, group == k].any() for k in range(G)]
        near = np.abs(np.subtract.outer(np.arange(G), np.arange(G))) <= 1
        both[F:, F:] |= near
        return both

    def scaled(self, cameras: Cameras, z: F64) -> Cameras:
        """Cameras of the shared calibration, each with its own focal length."""
        given = self.layout.cameras.pinhole
        pinhole = cameras.pinhole.copy()
        factor = np.exp(z)
        pinhole[:, :2] *= factor[:, None]
        pinhole[:, 2:] = given[:, 2:] + (pinhole[:, 2:] - given[:, 2:]) * factor[:, None]
        return cameras._replace(pinhole=pinhole)

    def prior_cost(self, z: F64) -> float:
        """Cost of the priors, px^2."""
        return 0.5 * float(self.spread @ z**2 + self.walk @ np.diff(z) ** 2)

    def linearise(self, cameras: Cameras, records: F64, unknown: BoolArray, principal: F64) -> None:
        """Linearise the blocks at the state of the records.   unknown: (SHARED,) of the
        calibration.
        """
        layout, M = self.layout, len(self.start)
        width = 6 * (1 + int(unknown[6]))
        blocks = FocalBlocks(
            np.zeros((M, width)), np.zeros(M), np.zeros((M, 6)), np.zeros((len(records), 3))
        )
        _add_focal(cameras, layout.slots, layout.flow, unknown, principal, records, blocks)
        self._blocks = blocks

    def add_to(
        self, system: CameraSystem, linearised: Linearised, scratch: Scratch, factors: F64,
        diagonal: F64, z: F64,
    ) -> None:  # fmt: skip
        """Add the focal lengths to a system from which the points have been eliminated.

        diagonal: (N, 6) of H without damping.   z: (M,) of the state.
        """
        assert self._blocks is not None
        eliminate_focal(linearised, self._blocks.points, self.position, system, scratch, factors)
        pull = -self.spread * z
        change = self.walk * np.diff(z)
        pull[:-1] += change
        pull[1:] -= change
        _assemble(self._blocks, self.spread, self.walk, pull, self.position, system, diagonal)

    def steps(self, solution: F64) -> F64:
        """(M,) of the solution (N, 6) of the reduced system."""
        return solution[self.position].reshape(-1)[: len(self.start)]

    def substitute(self, linearised: Linearised, steps: F64, factors: F64, moved: F64) -> None:
        """Move the points (3, P) by the steps of the focal lengths."""
        assert self._blocks is not None
        substitute_focal(linearised, self._blocks.points, steps, factors, moved)


@fast_kernel
def _add_focal(
    cameras: Cameras,
    slots: Slots,
    flow: F32,
    unknown: BoolArray,
    principal: F64,
    records: F64,
    blocks: FocalBlocks,
) -> None:
    local = np.empty(RECORD * BLOCK)
    A = np.zeros(2 * SHARED * BLOCK)
    for b in range(slots.camera.size):
        m = slots.camera[b]
        for i in range(BLOCK):
            at = np.uint32(slots.place[b, i])
            for k in range(RECORD):
                local[k * BLOCK + i] = records[at, k]
        camera_moves(cameras, m, b, principal, local, flow, unknown[3], A)
        _add_own(local, A, unknown, m, blocks)
        T = motion_of(cameras, m)
        for i in range(BLOCK):
            at = np.uint32(slots.place[b, i])
            m00, m01, m11 = local[3 * BLOCK + i], local[4 * BLOCK + i], local[5 * BLOCK + i]
            p0, p1, p2, q0, q1, q2 = point_rows(T, local[i], local[BLOCK + i], local[2 * BLOCK + i])
            a, c = apply_metric(m00, (m01,), m11, A[i], A[BLOCK + i])
            blocks.points[at, 0] = a * p0 + c * q0
            blocks.points[at, 1] = a * p1 + c * q1
            blocks.points[at, 2] = a * p2 + c * q2


@fast_kernel
def _add_own(local: F64, A: F64, unknown: BoolArray, m: int, blocks: FocalBlocks) -> None:
    g = t0 = t1 = t2 = t3 = t4 = t5 = 0.0
    for i in range(BLOCK):
        x, y, iz = local[i], local[BLOCK + i], local[2 * BLOCK + i]
        m00, m01, m11 = local[3 * BLOCK + i], local[4 * BLOCK + i], local[5 * BLOCK + i]
        g += A[i] * local[6 * BLOCK + i] + A[BLOCK + i] * local[7 * BLOCK + i]
        a, c = apply_metric(m00, (m01,), m11, A[i], A[BLOCK + i])
        d0, d1, d2, d3, d4, d5 = couple(x, y, iz, a, c)
        t0 += d0
        t1 += d1
        t2 += d2
        t3 += d3
        t4 += d4
        t5 += d5
        for q in range(SHARED):
            if unknown[q] or q == 0:
                blocks.own[m, q] += A[2 * q * BLOCK + i] * a + A[(2 * q + 1) * BLOCK + i] * c
    blocks.gradient[m] += g
    sums = (t0, t1, t2, t3, t4, t5)
    for k in range(6):
        blocks.cameras[m, k] += sums[k]


@fast_kernel
def eliminate_focal(
    state: Linearised,
    of_focal: F64,
    position: I32,
    system: CameraSystem,
    scratch: Scratch,
    factors: F64,
) -> None:
    """Eliminate the points from the rows of the focal lengths: to S ``- U U^T`` is added, to b ``-
    U y``, for all pairs with a block of focal lengths.

    of_focal: (O + 1, 3) H_zp of each place.   position: (G,) of the blocks.   factors: of the
    points, see ``eliminate_points``.
    """
    records, shared, places, motion = state.records, state.shared, state.places, state.motion
    free, block, S, b = system.position, system.block, system.S, system.b
    U, rows = scratch.U, scratch.rows
    for point in range(places.start.size):
        n = np.uintp(point)
        i00, l10, i11 = factors[n, 0], factors[n, 1], factors[n, 2]
        l20, l21, i22 = factors[n, 3], factors[n, 4], factors[n, 5]
        if i00 == 0.0:
            continue
        count = 0
        for o in range(places.start[n], places.stop[n]):  # blocks of focal lengths first
            m = places.camera[o]
            row = position[m // PER_BLOCK]
            if count == 0 or rows[count - 1] != row:
                rows[count] = row
                for k in range(18):
                    U[count, k] = 0.0
                count += 1
            e0 = of_focal[o, 0] * i00
            e1 = (of_focal[o, 1] - l10 * e0) * i11
            e2 = (of_focal[o, 2] - l20 * e0 - l21 * e1) * i22
            r = m % PER_BLOCK
            U[count - 1, r], U[count - 1, 6 + r], U[count - 1, 12 + r] = e0, e1, e2
            b[row, r] -= e0 * factors[n, 6] + e1 * factors[n, 7] + e2 * factors[n, 8]
        focal = count
        for o in range(places.start[n], places.stop[n]):
            m = places.camera[o]
            if free[m] < 0:
                continue
            x, y, iz = records[o, 0], records[o, 1], records[o, 2]
            m00, m01, m11 = records[o, 3], records[o, 4], records[o, 5]
            p0, p1, p2, q0, q1, q2 = point_rows(motion[m], x, y, iz)
            a0, c0 = apply_metric(m00, (m01,), m11, p0, q0)
            a1, c1 = apply_metric(m00, (m01,), m11, p1, q1)
            a2, c2 = apply_metric(m00, (m01,), m11, p2, q2)
            a0, c0 = a0 * i00, c0 * i00
            a1, c1 = (a1 - l10 * a0) * i11, (c1 - l10 * c0) * i11
            a2, c2 = (a2 - l20 * a0 - l21 * a1) * i22, (c2 - l20 * c0 - l21 * c1) * i22
            a = count
            U[a, 0], U[a, 1], U[a, 2], U[a, 3], U[a, 4], U[a, 5] = couple(x, y, iz, a0, c0)
            U[a, 6], U[a, 7], U[a, 8], U[a, 9], U[a, 10], U[a, 11] = couple(x, y, iz, a1, c1)
            U[a, 12], U[a, 13], U[a, 14], U[a, 15], U[a, 16], U[a, 17] = couple(x, y, iz, a2, c2)
            rows[a] = free[m]
            count += 1
        borders = shared.shape[1] // 18
        for q in range(6 * borders):
            e0 = shared[n, 3 * q] * i00
            e1 = (shared[n, 3 * q + 1] - l10 * e0) * i11
            e2 = (shared[n, 3 * q + 2] - l20 * e0 - l21 * e1) * i22
            a, r = count + q // 6, q % 6
            U[a, r], U[a, 6 + r], U[a, 12 + r] = e0, e1, e2
        for border in range(borders):
            rows[count] = b.shape[0] - borders + border
            count += 1
        for first in range(focal):
            f, row = np.uintp(first), rows[first]
            for second in range(first, count):
                c = np.uintp(second)
                if row >= rows[c]:
                    subtract_product3(S, np.uintp(block[row, rows[c]]), U, f, c)
                else:
                    subtract_product3(S, np.uintp(block[rows[c], row]), U, c, f)


@kernel
def _assemble(
    blocks: FocalBlocks,
    spread: F64,
    walk: F64,
    pull: F64,
    position: I32,
    system: CameraSystem,
    diagonal: F64,
) -> None:
    """Add the focal lengths' own blocks of H, and their prior."""
    free, block, S, b = system.position, system.block, system.S, system.b
    first = b.shape[0] - blocks.own.shape[1] // 6
    for m in range(pull.size):
        at, r = position[m // PER_BLOCK], m % PER_BLOCK
        own = blocks.own[m, 0] + spread[m]
        if m > 0:
            own += walk[m - 1]
        if m < walk.size:
            own += walk[m]
        S[block[at, at], 7 * r] += own
        diagonal[at, r] = own
        b[at, r] += blocks.gradient[m] + pull[m]
        for q in range(blocks.own.shape[1]):
            S[block[first + q // 6, at], 6 * (q % 6) + r] += blocks.own[m, q]
        camera = free[m]
        for k in range(6 if camera >= 0 else 0):
            if at > camera:
                S[block[at, camera], 6 * r + k] += blocks.cameras[m, k]
            else:
                S[block[camera, at], 6 * k + r] += blocks.cameras[m, k]
        if m < walk.size:
            to, c = position[(m + 1) // PER_BLOCK], (m + 1) % PER_BLOCK
            if to >= at:
                S[block[to, at], 6 * c + r] -= walk[m]
            else:
                S[block[at, to], 6 * r + c] -= walk[m]


@fast_kernel
def substitute_focal(
    state: Linearised, of_focal: F64, steps: F64, factors: F64, moved: F64
) -> None:
    """Move the points (3, P) further by the steps of the focal lengths.   steps: (M,) of z."""
    places = state.places
    for n in range(places.start.size):
        t0 = t1 = t2 = 0.0
        for o in range(places.start[n], places.stop[n]):
            d = steps[places.camera[o]]
            t0 += of_focal[o, 0] * d
            t1 += of_focal[o, 1] * d
            t2 += of_focal[o, 2] * d
        f = factors[n]
        s0 = t0 * f[0]
        s1 = (t1 - f[1] * s0) * f[2]
        s2 = (t2 - f[3] * s0 - f[4] * s1) * f[5]
        h2 = s2 * f[5]
        h1 = (s1 - f[4] * h2) * f[2]
        moved[0, n] -= (s0 - f[1] * h1 - f[3] * h2) * f[0]
        moved[1, n] -= h1
        moved[2, n] -= h2
