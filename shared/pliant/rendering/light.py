"""Light that falls on a surface: lamps with soft shadows, and light from everywhere."""

import math

import numpy as np

from pliant.algorithms.arrays import F32, F64
from pliant.compiler.kernel import kernel
from pliant.rendering.intersect import hit_solid
from pliant.rendering.solids import SolidArrays

_LAMP_RADIUS_M = 0.25
_LAMP_SAMPLES = 12
_SKY_SAMPLES = 24
_SKY_REACH_M = 0.7  # solids farther away do not darken a corner
_LAMP_REACH_M = 2.2  # distance at which a lamp has lost half of its strength
_LIFT_M = 1e-3  # start of a shadow ray above its own surface


def lamp_points(lights: F64) -> F64:
    """(N * samples, 3) points on small spheres about (N, 3) lamps."""
    i = np.arange(_LAMP_SAMPLES)
    z = 1.0 - (2.0 * i + 1.0) / _LAMP_SAMPLES
    angle = i * math.pi * (3.0 - math.sqrt(5.0))
    ring = np.sqrt(1.0 - z * z)
    ball = np.stack([ring * np.cos(angle), ring * np.sin(angle), z], axis=1) * _LAMP_RADIUS_M
    return (lights[:, None, :] + ball[None]).reshape(-1, 3)


def sky_directions() -> F64:
    """(M, 3) directions about z with cosine density."""
    i = np.arange(_SKY_SAMPLES)
    radius = np.sqrt((i + 0.5) / _SKY_SAMPLES)
    angle = i * math.pi * (3.0 - math.sqrt(5.0))
    z = np.sqrt(1.0 - radius**2)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)


@kernel
def _blocked(
    solids: SolidArrays,
    p: tuple[float, float, float],
    d: tuple[float, float, float],
    reach: float,
) -> bool:
    """Whether a solid other than the room lies on the way from p within ``reach`` times d."""
    kind, half, W, C = solids.kind, solids.half, solids.rotation, solids.centre
    px, py, pz = p
    dx, dy, dz = d
    for s in range(len(kind)):
        if kind[s] == 0:
            continue
        qx, qy, qz = px - C[s, 0], py - C[s, 1], pz - C[s, 2]
        t = hit_solid(
            kind[s],
            W[s, 0, 0] * qx + W[s, 1, 0] * qy + W[s, 2, 0] * qz,
            W[s, 0, 1] * qx + W[s, 1, 1] * qy + W[s, 2, 1] * qz,
            W[s, 0, 2] * qx + W[s, 1, 2] * qy + W[s, 2, 2] * qz,
            W[s, 0, 0] * dx + W[s, 1, 0] * dy + W[s, 2, 0] * dz,
            W[s, 0, 1] * dx + W[s, 1, 1] * dy + W[s, 2, 1] * dz,
            W[s, 0, 2] * dx + W[s, 1, 2] * dy + W[s, 2, 2] * dz,
            half[s, 0],
            half[s, 1],
            half[s, 2],
        )
        if 0.0 < t < reach:
            return True
    return False


@kernel
def _light_kernel(
    solids: SolidArrays,
    points: F64,
    normals: F64,
    lamps: F64,
    sky: F64,
    ambient: float,
    out: F32,
) -> None:
    for n in range(len(points)):
        nx, ny, nz = normals[n, 0], normals[n, 1], normals[n, 2]
        px, py, pz = points[n, 0], points[n, 1], points[n, 2]
        px, py, pz = px + _LIFT_M * nx, py + _LIFT_M * ny, pz + _LIFT_M * nz
        # Two tangents, chosen without a jump over a flat face.
        if abs(nx) < 0.8:
            ax, ay, az = 0.0, nz, -ny
        else:
            ax, ay, az = -nz, 0.0, nx
        norm = math.sqrt(ax * ax + ay * ay + az * az)
        ax, ay, az = ax / norm, ay / norm, az / norm
        bx, by, bz = ny * az - nz * ay, nz * ax - nx * az, nx * ay - ny * ax
        open_sky = 0
        for k in range(len(sky)):
            i, j, up = sky[k, 0], sky[k, 1], sky[k, 2]
            dx, dy, dz = (
                i * ax + j * bx + up * nx,
                i * ay + j * by + up * ny,
                i * az + j * bz + up * nz,
            )
            if not _blocked(solids, (px, py, pz), (dx, dy, dz), _SKY_REACH_M):
                open_sky += 1
        direct = 0.0
        for k in range(len(lamps)):
            dx, dy, dz = lamps[k, 0] - px, lamps[k, 1] - py, lamps[k, 2] - pz
            square = dx * dx + dy * dy + dz * dz
            cosine = (dx * nx + dy * ny + dz * nz) / math.sqrt(square)
            if cosine > 0.0 and not _blocked(solids, (px, py, pz), (dx, dy, dz), 1.0):
                direct += cosine / (1.0 + square / (_LAMP_REACH_M * _LAMP_REACH_M))
        direct *= 1.6 * (1.0 - ambient) / _LAMP_SAMPLES
        out[n] = ambient * (0.3 + 0.7 * open_sky / len(sky)) + direct


def light_at(solids: SolidArrays, points: F64, normals: F64, lights: F64, ambient: float) -> F32:
    """Light on (N, 3) points with (N, 3) unit normals, world frame: (N,) factors about 1."""
    out = np.zeros(len(points), np.float32)
    _light_kernel(solids, points, normals, lamp_points(lights), sky_directions(), ambient, out)
    return out
