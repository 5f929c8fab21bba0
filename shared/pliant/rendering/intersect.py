"""Where rays meet solids: one ray and one solid, and all rays of a tile with all it may show.

A ray is ``(x, y, 1)`` in the camera frame, so that its parameter t is the depth z.  Each solid is
met in its own frame: a box by slabs, a sphere and a cylinder by their quadratics.
"""

import math
from typing import Any, TypeAlias

import numpy as np

from pliant.algorithms.arrays import F64, I32
from pliant.compiler.kernel import fast_kernel
from pliant.rendering.visible_tiles import NEAR_M, TILE_PX, TILE_RAYS, Reals

Scalar: TypeAlias = Any  # a number of any width inside a kernel


@fast_kernel
def _box(
    lx: Scalar,
    ly: Scalar,
    lz: Scalar,
    hx: Scalar,
    hy: Scalar,
    hz: Scalar,
    dx: Scalar,
    dy: Scalar,
    dz: Scalar,
    inside: bool,
) -> Scalar:
    """Depth at which a ray along d enters a box, or leaves it where it is seen from inside.

    l, h: from the start of the ray to the lower and to the upper faces.
    """
    ix, iy, iz = 1.0 / dx, 1.0 / dy, 1.0 / dz
    ax, bx = lx * ix, hx * ix
    ay, by = ly * iy, hy * iy
    az, bz = lz * iz, hz * iz
    near = max(min(ax, bx), max(min(ay, by), min(az, bz)))
    far = min(max(ax, bx), min(max(ay, by), max(az, bz)))
    if inside:
        return far
    return near if near <= far else np.inf


@fast_kernel
def _sphere(
    ox: Scalar,
    oy: Scalar,
    oz: Scalar,
    dx: Scalar,
    dy: Scalar,
    dz: Scalar,
    radius: Scalar,
) -> Scalar:
    a = dx * dx + dy * dy + dz * dz
    b = ox * dx + oy * dy + oz * dz
    c = ox * ox + oy * oy + oz * oz - radius * radius
    root = b * b - a * c
    return (-b - math.sqrt(root)) / a if root >= 0.0 else np.inf


@fast_kernel
def _cylinder(
    ox: Scalar,
    oy: Scalar,
    oz: Scalar,
    dx: Scalar,
    dy: Scalar,
    dz: Scalar,
    radius: Scalar,
    half: Scalar,
) -> Scalar:
    a = dx * dx + dy * dy
    b = ox * dx + oy * dy
    root = b * b - a * (ox * ox + oy * oy - radius * radius)
    if root < 0.0:
        return np.inf
    side = (-b - math.sqrt(root)) / a
    if abs(oz + side * dz) <= half:
        return side
    # The end that the ray can enter: the upper one when it points down.
    cap = ((half if dz < 0.0 else -half) - oz) / dz
    x, y = ox + cap * dx, oy + cap * dy
    return cap if x * x + y * y <= radius * radius else np.inf


@fast_kernel
def hit_solid(
    kind: Scalar,
    ox: Scalar,
    oy: Scalar,
    oz: Scalar,
    dx: Scalar,
    dy: Scalar,
    dz: Scalar,
    hx: Scalar,
    hy: Scalar,
    hz: Scalar,
) -> Scalar:
    """Depth at which a ray from o along d, in the frame of a solid, meets it; inf: not at all."""
    if kind <= 1:
        return _box(-hx - ox, -hy - oy, -hz - oz, hx - ox, hy - oy, hz - oz, dx, dy, dz, kind == 0)
    if kind == 2:
        return _sphere(ox, oy, oz, dx, dy, dz, hx)
    return _cylinder(ox, oy, oz, dx, dy, dz, hx, hz)


@fast_kernel
def _offer_box(
    s: Scalar,
    inside: bool,
    o: Reals,
    R: Reals,
    h: Reals,
    x: Reals,
    y: Reals,
    best: Reals,
    solid: I32,
) -> None:
    """Offer box s to all rays of a tile: no branches and one number type, so that it vectorises."""
    one, least = x.dtype.type(1.0), x.dtype.type(NEAR_M)
    lx, ly, lz = -h[s, 0] - o[s, 0], -h[s, 1] - o[s, 1], -h[s, 2] - o[s, 2]
    hx, hy, hz = h[s, 0] - o[s, 0], h[s, 1] - o[s, 1], h[s, 2] - o[s, 2]
    a, b, c = R[s, 0, 0], R[s, 0, 1], R[s, 0, 2]
    d, e, f = R[s, 1, 0], R[s, 1, 1], R[s, 1, 2]
    g, k, m = R[s, 2, 0], R[s, 2, 1], R[s, 2, 2]
    for i in range(TILE_RAYS):
        ix = one / (a * x[i] + b * y[i] + c)
        iy = one / (d * x[i] + e * y[i] + f)
        iz = one / (g * x[i] + k * y[i] + m)
        ax, bx, ay, by, az, bz = lx * ix, hx * ix, ly * iy, hy * iy, lz * iz, hz * iz
        nx, fx = (ax, bx) if ax < bx else (bx, ax)
        ny, fy = (ay, by) if ay < by else (by, ay)
        nz, fz = (az, bz) if az < bz else (bz, az)
        near = nx if nx > ny else ny
        near = near if near > nz else nz
        far = fx if fx < fy else fy
        far = far if far < fz else fz
        t = far if inside else near
        taken = (near <= far) & (t > least) & (t < best[i])
        best[i] = t if taken else best[i]
        solid[i] = s if taken else solid[i]


@fast_kernel
def _offer_round(
    s: Scalar,
    kind: Scalar,
    o: Reals,
    R: Reals,
    h: Reals,
    x: Reals,
    y: Reals,
    best: Reals,
    solid: I32,
) -> None:
    """Offer sphere or cylinder s to all rays of a tile."""
    for i in range(TILE_RAYS):
        t = hit_solid(
            kind,
            o[s, 0],
            o[s, 1],
            o[s, 2],
            R[s, 0, 0] * x[i] + R[s, 0, 1] * y[i] + R[s, 0, 2],
            R[s, 1, 0] * x[i] + R[s, 1, 1] * y[i] + R[s, 1, 2],
            R[s, 2, 0] * x[i] + R[s, 2, 1] * y[i] + R[s, 2, 2],
            h[s, 0],
            h[s, 1],
            h[s, 2],
        )
        if NEAR_M < t < best[i]:
            best[i], solid[i] = t, s


@fast_kernel
def meet_tile(
    kind: I32,
    half: Reals,
    o: Reals,
    R: Reals,
    start: I32,
    listed: I32,
    bound: F64,
    tile: Scalar,
    x: Reals,
    y: Reals,
    best: Reals,
    solid: I32,
) -> None:
    """Depth and solid of the first surface on each of a tile's rays (x, y, 1); (inf, -1): none.

    x, y, best, solid: (TILE_RAYS,).  The arrays of SolidArrays, View and Tiles come one by one,
    because taking them out of a tuple inside a loop costs more than the geometry.
    """
    best[:], solid[:] = np.inf, -1
    farthest = np.inf
    for j in range(start[tile], start[tile + 1]):
        s = listed[j]
        if bound[s] > farthest:
            continue
        if kind[s] <= 1:
            _offer_box(s, kind[s] == 0, o, R, half, x, y, best, solid)
        else:
            _offer_round(s, kind[s], o, R, half, x, y, best, solid)
        farthest = best.max()


@fast_kernel
def load_tile(rays: Reals, tile: Scalar, x: Reals, y: Reals) -> tuple[int, int, int, int]:
    """Copy the rays of a tile, row by row; beyond the image's edge the edge is repeated."""
    height, width = rays.shape[:2]
    across = (width + TILE_PX - 1) // TILE_PX
    top, left = (tile // across) * TILE_PX, (tile % across) * TILE_PX
    for i in range(TILE_RAYS):
        row, col = min(top + i // TILE_PX, height - 1), min(left + i % TILE_PX, width - 1)
        x[i], y[i] = rays[row, col, 0], rays[row, col, 1]
    return top, left, min(TILE_PX, height - top), min(TILE_PX, width - left)


@fast_kernel
def face_point(
    kind: Scalar, x: Scalar, y: Scalar, z: Scalar, hx: Scalar, hy: Scalar, hz: Scalar
) -> tuple[Scalar, Scalar, Scalar, Scalar, Scalar, Scalar]:
    """Face, texture coordinates in metres and outer normal at a point of a solid, own frame."""
    if kind == 3:
        # 10 um: a ray found in single precision must not miss the end that it met.
        if abs(z) < hz - 1e-5:
            return 0, (math.atan2(y, x) + math.pi) * hx, hz - z, x / hx, y / hx, 0.0
        return (1 if z > 0.0 else 2), x + hx, y + hx, 0.0, 0.0, (1.0 if z > 0.0 else -1.0)
    ax, ay, az = abs(x) / hx, abs(y) / hy, abs(z) / hz
    if kind == 2:
        quarter = 0.25 * math.pi
        if ax >= ay and ax >= az:
            face, u, v = (1 if x > 0.0 else 0), math.atan(y / abs(x)), math.atan(z / abs(x))
        elif ay >= az:
            face, u, v = (3 if y > 0.0 else 2), math.atan(x / abs(y)), math.atan(z / abs(y))
        else:
            face, u, v = (5 if z > 0.0 else 4), math.atan(x / abs(z)), math.atan(y / abs(z))
        return face, (u + quarter) * hx, (quarter - v) * hx, x / hx, y / hx, z / hx
    flip = -1.0 if kind == 0 else 1.0
    # Rows of a texture run downwards, so that writing on a wall stands upright.
    if ax >= ay and ax >= az:
        return (1 if x > 0.0 else 0), y + hy, hz - z, (flip if x > 0.0 else -flip), 0.0, 0.0
    if ay >= az:
        return (3 if y > 0.0 else 2), x + hx, hz - z, 0.0, (flip if y > 0.0 else -flip), 0.0
    return (5 if z > 0.0 else 4), x + hx, y + hy, 0.0, 0.0, (flip if z > 0.0 else -flip)
