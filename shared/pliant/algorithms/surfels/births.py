"""New surfels from an image and its depth (DSDT, section III).

They are created at points with texture in two directions (Shi and Tomasi), spread by non-maximum
suppression.
"""

import math
from dataclasses import dataclass

import numpy as np

from pliant.algorithms.arrays import F32, F64, I64, U8
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.surfels.deformation_models import identity_poses
from pliant.algorithms.surfels.depth_maps import fit_inverse_depth, tangent_jacobian
from pliant.algorithms.surfels.parameters import SurfelParameters
from pliant.algorithms.surfels.patch_sampling import (
    INVALID,
    A,
    B,
    Grid,
    Level,
    X,
    homography,
    make_grid,
    sample_patch,
)
from pliant.algorithms.surfels.photometric import (
    FEATURES,
    TEMPLATE_IMAGES,
    Comparison,
    feature_matrix,
    first_inner,
    make_features,
    padded,
)
from pliant.algorithms.surfels.surfel_alignment import Templates
from pliant.compiler.kernel import fast_kernel

_FAR = 0.5 * INVALID
_MIN_VARIANCE = 4.0  # DN^2: a patch with less contrast is noise
_CORNER_WINDOW_PX = 7
_TANGENT_RADIUS_PX = 11
_DEPTH_JUMP = 0.08
"""A larger relative step of depth is another surface."""
_DEPTH_NOISE = 5e-4
"""Minimum relative noise of a depth."""
_MIN_DEPTH_SHARE = 0.5
"""Minimum share of a tangent's window on the surface of its centre."""
_MAX_SLOPE = 4.0
"""Steepest surface: relative change of depth per unit of normalised coordinate."""
_MAX_OFF_PLANE = 0.03
"""Pixels off a surfel's plane by more than this share of its depth are not part of its texture."""
MIN_TEMPLATE = 0.6
"""Minimum share of a patch inside the image and on the surfel's plane."""


@dataclass(frozen=True)
class Births:
    """N new surfels in the camera frame."""

    poses: F64  # (N, POSE_FLOATS)
    templates: list[Templates]  # one for each level


def find_births(
    pyramid: list[Level],
    depth: F64,
    camera: PinholeCamera,
    parameters: SurfelParameters,
    occupied: F64,
    count: int,
    clearance_px: int,
) -> Births:
    """Return at most ``count`` new surfels at pixels with texture, depth and enough distance.

    pyramid: of the image.  depth: (H, W) metres, 0 or NaN for holes.  occupied: (M, 2) pixels near
    which, within the clearance, no surfel may be created.
    """
    p, level = parameters, pyramid[0]
    image = level.pixels
    allowed = _allowed(depth, image, occupied, clearance_px, p.highlight)
    corners = find_corners(
        image,
        allowed,
        window=_CORNER_WINDOW_PX,
        threshold=p.min_strength,
        radius=p.spacing_px,
        margin=p.patch_px // 2 + 1,
    )
    poses = place(corners[:, :2], depth, camera, p)
    templates = [
        make_templates(poses, each, p.highlight, MIN_TEMPLATE, depth, _MAX_OFF_PLANE)
        for each in pyramid
    ]
    rows = np.flatnonzero(templates[0].usable)[: max(count, 0)]
    return Births(poses[rows], [select(each, rows) for each in templates])


def _allowed(depth: F64, image: F32, occupied: F64, radius: int, highlight: float) -> U8:
    allowed = ((depth > 0.0) & (image <= highlight)).astype(np.uint8)
    height, width = depth.shape
    for column, row in np.rint(occupied).astype(np.int64):
        top, left = max(row - radius, 0), max(column - radius, 0)
        if row + radius >= 0 and column + radius >= 0 and top < height and left < width:
            allowed[top : row + radius + 1, left : column + radius + 1] = 0
    return allowed


def place(points_px: F64, depth: F64, camera: PinholeCamera, p: SurfelParameters) -> F64:
    """(M, POSE_FLOATS) surfels at those of (N, 2) pixels that have a surface (Eq. 3 and 4)."""
    fits, supported = np.zeros((len(points_px), 4)), np.zeros(len(points_px), np.bool_)
    for k, (column, row) in enumerate(points_px):
        share = fit_inverse_depth(
            depth, column, row, _TANGENT_RADIUS_PX, _DEPTH_JUMP, _DEPTH_NOISE, fits[k]
        )
        supported[k] = share >= _MIN_DEPTH_SHARE and fits[k, 3] <= p.max_depth_residual
    fits, points = fits[supported], points_px[supported]
    rays = camera.normalise(points)
    z = 1.0 / fits[:, 0]
    # dz/du = -z^2 d(1/z)/du, and a pixel is 1/f of a normalised coordinate.
    dz_dx, dz_dy = -(z**2) * fits[:, 1] * camera.fx, -(z**2) * fits[:, 2] * camera.fy
    facing = (z - rays[:, 0] * dz_dx - rays[:, 1] * dz_dy) > 0.0
    slope = np.hypot(dz_dx, dz_dy) / z
    good = facing & (slope <= _MAX_SLOPE) & np.isfinite(z)
    rays, z, dz_dx, dz_dy = rays[good], z[good], dz_dx[good], dz_dy[good]
    poses = identity_poses(len(z))
    poses[:, X : X + 2], poses[:, X + 2] = rays * z[:, None], z
    tangents = tangent_jacobian(rays[:, 0], rays[:, 1], z, dz_dx, dz_dy)
    poses[:, A : A + 3], poses[:, B : B + 3] = tangents[:, :, 0], tangents[:, :, 1]
    return poses


def make_templates(
    poses: F64, level: Level, highlight: float, min_share: float, depth: F64, max_off_plane: float
) -> Templates:  # fmt: skip
    """Textures on the surfels' own grids at one level, and their derivatives along the grid.

    depth: (H, W) metres of the full-size image.  Pixels off the surfel's own plane are left out: a
    static background would hold the patch, or pull it along the ray.
    """
    n, side = len(poses), level.side
    templates = Templates(
        np.zeros((n, TEMPLATE_IMAGES, padded(side)), np.float32),
        np.zeros(n),
        np.zeros(n),
        np.zeros((n, FEATURES, FEATURES)),
        np.zeros(n, np.uint8),
    )
    scratch = make_features(side)
    wide = make_grid(side + 2)
    _fill(poses, level, wide, highlight, min_share, depth, max_off_plane, templates, scratch)
    return templates


@fast_kernel
def _leave_out_other_surfaces(h: F64, level: Level, wide: Grid, depth: F64, bound: float) -> None:
    """Invalidate samples without depth, or off the plane by more than a share of ``bound``.

    A pixel of a coarse level covers several of the depth map: its centre and corners are tested.
    """
    height, width = depth.shape
    scale = width // level.width
    for k in range(len(wide.i)):
        z = h[6] * wide.i[k] + h[7] * wide.j[k] + h[8]
        u = (h[0] * wide.i[k] + h[1] * wide.j[k] + h[2]) / z
        v = (h[3] * wide.i[k] + h[4] * wide.j[k] + h[5]) / z
        for corner in range(5):
            du = 0.0 if corner == 4 else (0.5 if corner & 1 else -0.5)
            dv = 0.0 if corner == 4 else (0.5 if corner & 2 else -0.5)
            column = math.floor((u + du + 0.5) * scale)
            row = math.floor((v + dv + 0.5) * scale)
            column, row = min(max(column, 0), width - 1), min(max(row, 0), height - 1)
            if not abs(depth[row, column] - z) <= bound * z:
                wide.values[k] = np.float32(INVALID)


@fast_kernel
def _fill(
    poses: F64, level: Level, wide: Grid, highlight: float, min_share: float, depth: F64,
    max_off_plane: float, templates: Templates, scratch: F32,
) -> None:  # fmt: skip
    h = np.empty(9)
    for s in range(len(poses)):
        if not homography(poses[s], level, h) or not sample_patch(h, level, wide, highlight):
            continue
        _leave_out_other_surfaces(h, level, wide, depth, max_off_plane)
        fill_texture(s, wide, min_share, templates, scratch)


@fast_kernel
def fill_texture(s: int, wide: Grid, min_share: float, templates: Templates, scratch: F32) -> bool:
    """Make one surfel's template of the samples of its grid; INVALID ones take no part.

    Returns False where fewer than ``min_share`` of a patch are valid: nothing but the images is
    written then.
    """
    side = wide.side - 2
    images = templates.images[s]
    count, total, squares = 0, 0.0, 0.0
    for n in range(images.shape[1]):
        k = first_inner(wide) + n
        v = wide.values[k] if n % wide.side < side else np.float32(INVALID)
        images[0, n], images[1, n], images[2, n] = v, np.float32(0.0), np.float32(0.0)
        if not v < _FAR:
            continue
        vu = np.float32(0.5) * (wide.values[k + 1] - wide.values[k - 1])
        vv = np.float32(0.5) * (wide.values[k + wide.side] - wide.values[k - wide.side])
        # Samples without derivatives are not part of the texture.
        if abs(vu) < _FAR * 0.5 and abs(vv) < _FAR * 0.5:
            images[1, n], images[2, n] = vu, vv
        count, total, squares = count + 1, total + v, squares + v * v
    if count < min_share * side * side:
        return False
    mean = float(total / count)
    templates.means[s], templates.counts[s] = mean, count
    # A sample that the template lacks is saturated in every frame.
    for n in range(images.shape[1]):
        if images[0, n] < _FAR:
            images[0, n] -= np.float32(mean)
    plain = Comparison(mean, 1.0, 0.0, 1.0, 0.0)
    feature_matrix(images, wide, plain, scratch, templates.matrices[s])
    templates.usable[s] = 1 if squares / count - mean * mean > _MIN_VARIANCE else 0
    return True


def select(templates: Templates, rows: I64) -> Templates:
    """The templates of some surfels, copied."""
    t = templates
    return Templates(
        t.images[rows], t.means[rows], t.counts[rows], t.matrices[rows], t.usable[rows]
    )


def join(first: Templates, second: Templates) -> Templates:
    """The templates of two groups of surfels, one after the other."""
    return Templates(
        np.concatenate([first.images, second.images]),
        np.concatenate([first.means, second.means]),
        np.concatenate([first.counts, second.counts]),
        np.concatenate([first.matrices, second.matrices]),
        np.concatenate([first.usable, second.usable]),
    )


@fast_kernel
def smaller_eigenvalues(image: F32, radius: int) -> F32:
    """Smaller eigenvalue of the structure tensor, mean over a square window, DN^2 per px^2.

    image: (H, W).  radius: the window is 2 radius + 1 px wide.  Returns (H, W), zero in a border
    of radius + 1 px.
    """
    height, width = image.shape
    out = np.zeros((height, width), np.float32)
    size = 2 * radius + 1
    columns = np.zeros((3, width), np.float32)
    half = np.float32(0.5)
    area = np.float32(1.0 / (size * size))
    for row in range(1, height - 1):
        for sign in range(2):
            # The window moves down: its new row comes in, the one above it goes out.
            y = row if sign == 0 else row - size
            if y < 1:
                continue
            s = np.float32(1.0 if sign == 0 else -1.0)
            above, here, below = image[y - 1], image[y], image[y + 1]
            for x in range(1, width - 1):
                gx = half * (here[x + 1] - here[x - 1])
                gy = half * (below[x] - above[x])
                columns[0, x] += s * gx * gx
                columns[1, x] += s * gx * gy
                columns[2, x] += s * gy * gy
        if row < size:
            continue
        a = b = c = np.float32(0.0)
        target = out[row - radius]
        for x in range(1, width - 1):
            a, b, c = a + columns[0, x], b + columns[1, x], c + columns[2, x]
            if x > size:
                a -= columns[0, x - size]
                b -= columns[1, x - size]
                c -= columns[2, x - size]
            if x >= size:
                root = np.sqrt((a - c) * (a - c) + np.float32(4.0) * b * b)
                target[x - radius] = max(half * area * (a + c - root), np.float32(0.0))
    return out


@fast_kernel
def _peaks(strength: F32, threshold: float, radius: int, margin: int) -> F64:
    """(N, 3) rows (strength, column, row) of the maxima of their neighbourhood of ``radius`` px."""
    height, width = strength.shape
    out = np.empty((height * width // 4 + 1, 3))
    count = 0
    for row in range(margin, height - margin):
        for column in range(margin, width - margin):
            s = strength[row, column]
            if not s > threshold:
                continue
            greatest = True
            for y in range(max(row - radius, 0), min(row + radius + 1, height)):
                for x in range(max(column - radius, 0), min(column + radius + 1, width)):
                    # Of equal ones the first stays.
                    t = strength[y, x]
                    if t > s or (t == s and (y < row or (y == row and x < column))):
                        greatest = False
                        break
                if not greatest:
                    break
            if greatest:
                out[count, 0], out[count, 1], out[count, 2] = s, column, row
                count += 1
    return out[:count].copy()


def find_corners(
    image: F32, allowed: U8, *, window: int, threshold: float, radius: int, margin: int
) -> F64:
    """Corners of an image, strongest first.

    image: (H, W) grey levels.  allowed: (H, W), 0 where no corner may be.  window: side of the
    window of the structure tensor, px.  threshold: least smaller eigenvalue, DN^2 per px^2.
    radius: of the non-maximum suppression, px.  margin: border without corners, px.
    Returns (N, 3): column, row, strength.
    """
    strength = smaller_eigenvalues(image, window // 2)
    strength[allowed == 0] = 0.0
    peaks = _peaks(strength, threshold, radius, max(margin, 1))
    # Of equally strong ones the first in the image comes first: sorts are stable.
    order = np.argsort(-peaks[:, 0], kind="stable")
    return peaks[order][:, [1, 2, 0]]
