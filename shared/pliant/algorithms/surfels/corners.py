"""Points with texture in two directions (Shi and Tomasi), spread by non-maximum suppression."""

import numpy as np

from pliant.algorithms.arrays import F32, F64, U8
from pliant.algorithms.kernel import fast_kernel


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
