"""Procedural textures with structure at all scales and no repeating pattern.

Octaves of value noise of equal amplitude make the shading; on top lie random marks (discs,
rectangles, rings, bars, half discs) whose sizes follow a power law, so that every octave covers
the same share of the surface.  The spectrum is that of natural images, about 1/f, with sharp edges.
"""

import math

import numpy as np

from pliant.algorithms.arrays import F32, F64
from pliant.compiler.kernel import kernel
from pliant.rendering.colours import shares
from pliant.rendering.solids import Material

# Smallest radius of a mark, texels: smaller ones would vanish at the texture's own resolution.
_MIN_RADIUS = 1.3
# Each octave of marks covers this share of what the next larger one covers.
_FEWER = 0.93
_WRITING_PITCH = 20  # texels from line to line of the smallest writing


@kernel
def add_noise(image: F32, grid: F64, cell_x: float, cell_y: float, amplitude: float) -> None:
    """Add smoothly interpolated noise: one random number of ``grid`` per cell of texels."""
    height, width = image.shape
    for row in range(height):
        y = row / cell_y
        j = int(y)
        q = y - j
        q = q * q * (3.0 - 2.0 * q)
        for i in range(int((width - 1) / cell_x) + 1):
            left = grid[j, i] + q * (grid[j + 1, i] - grid[j, i])
            right = grid[j, i + 1] + q * (grid[j + 1, i + 1] - grid[j, i + 1])
            first, last = math.ceil(i * cell_x), min(math.ceil((i + 1) * cell_x), width)
            for col in range(first, last):
                p = col / cell_x - i
                p = p * p * (3.0 - 2.0 * p)
                image[row, col] += amplitude * (left + p * (right - left))


@kernel
def paint(image: F32, marks: F64) -> None:
    """Draw marks one over the other, with smooth edges one texel wide.

    marks: (N, 8) columns x, y, half length, half width (texels), angle (rad), grey value, opacity,
    shape (0 disc, 1 rectangle, 2 ring, 3 bar with round ends, 4 half disc).
    """
    height, width = image.shape
    for n in range(len(marks)):
        cx, cy, rx, ry = marks[n, 0], marks[n, 1], marks[n, 2], marks[n, 3]
        c, s = math.cos(marks[n, 4]), math.sin(marks[n, 4])
        value, opacity, shape = marks[n, 5], marks[n, 6], int(marks[n, 7])
        ex = math.sqrt((rx * c) ** 2 + (ry * s) ** 2)
        ey = math.sqrt((rx * s) ** 2 + (ry * c) ** 2)
        if shape == 1 or shape == 3:
            ex, ey = abs(rx * c) + abs(ry * s), abs(rx * s) + abs(ry * c)
        small = min(rx, ry)
        for row in range(max(int(cy - ey - 1.0), 0), min(int(cy + ey + 2.0), height)):
            for col in range(max(int(cx - ex - 1.0), 0), min(int(cx + ex + 2.0), width)):
                dx, dy = col - cx, row - cy
                a, b = abs(c * dx + s * dy), abs(c * dy - s * dx)
                if shape == 1:
                    distance = max(a - rx, b - ry)
                elif shape == 3:
                    a = max(a - (rx - small), 0.0)
                    b = max(b - (ry - small), 0.0)
                    distance = math.sqrt(a * a + b * b) - small
                else:
                    a, b = a / rx, b / ry
                    distance = (math.sqrt(a * a + b * b) - 1.0) * small
                    if shape == 2:
                        distance = abs(distance + 0.3 * small) - 0.3 * small
                    elif shape == 4:
                        distance = max(distance, c * dy - s * dx)
                cover = min(max(0.5 - distance, 0.0), 1.0) * opacity
                image[row, col] += cover * (value - image[row, col])


@kernel
def shrink(image: F32) -> F32:
    """Half the size by the mean of 2 x 2 texels.  image: (2 H, 2 W) float32."""
    height, width = image.shape[0] // 2, image.shape[1] // 2
    out = np.empty((height, width), np.float32)
    for row in range(height):
        for col in range(width):
            a = image[2 * row, 2 * col] + image[2 * row, 2 * col + 1]
            b = image[2 * row + 1, 2 * col] + image[2 * row + 1, 2 * col + 1]
            out[row, col] = 0.25 * (a + b)
    return out


def _marks(rng: np.random.Generator, height: int, width: int, material: Material) -> F64:
    """Marks of all sizes, large ones first, (N, 8)."""
    out: list[F64] = []
    radius = min(height, width) / 5.0
    coverage = material.coverage
    # Some places are richer than others, as everywhere outside of laboratories.
    richness = rng.random((7, 7))
    while radius > _MIN_RADIUS:
        # Mean area of a mark of this octave, radii uniform in log scale from radius / 2 on.
        area = math.pi * (0.7 * radius) ** 2 * 0.7
        n = int(rng.poisson(coverage * height * width / area))
        r = np.maximum(radius * 2.0 ** -rng.random(n), _MIN_RADIUS)
        aspect = 0.35 + 0.65 * rng.random(n)
        shape = rng.integers(0, 5, n)
        aspect = np.where(shape == 3, 0.15 + 0.2 * rng.random(n), aspect)
        ry = np.maximum(r * aspect, 0.8)
        value = material.brightness + material.contrast * rng.standard_normal(n)
        x, y = rng.random(n), rng.random(n)
        rich = rng.random(n) < 0.15 + 1.2 * _interpolate(richness, 6.0 * y, 6.0 * x)
        columns = [
            x * width,
            y * height,
            r,
            ry,
            rng.random(n) * 2.0 * math.pi,
            np.clip(value, 8.0, 235.0),
            0.35 + 0.6 * rng.random(n),
            shape.astype(np.float64),
        ]
        out.append(np.stack(columns, axis=1)[rich])
        radius /= 2.0
        coverage *= _FEWER
    return np.concatenate(out) if out else np.zeros((0, 8))


def _interpolate(grid: F64, row: F64, col: F64) -> F64:
    """Bilinear values of a coarse grid at (N,) positions inside it."""
    j, i = row.astype(np.int64), col.astype(np.int64)
    q, p = row - j, col - i
    top = grid[j, i] + p * (grid[j, i + 1] - grid[j, i])
    bottom = grid[j + 1, i] + p * (grid[j + 1, i + 1] - grid[j + 1, i])
    return top + q * (bottom - top)


def _writing(rng: np.random.Generator, height: int, width: int, material: Material) -> F64:
    """Lines of made-up letters of two to four strokes each, in several sizes, (N, 8)."""
    strokes: list[F64] = []
    row = 0.5 * _WRITING_PITCH
    while row < height:
        size = _WRITING_PITCH * 2.0 ** (2.0 * rng.random() ** 2)
        row += size
        if rng.random() > material.writing:
            continue
        letters = int(width / (0.45 * size))
        column = (np.arange(letters) + rng.random()) * 0.45 * size
        # Words: a letter in six is a gap; a line begins and ends where it likes.
        start, stop = np.sort(rng.random(2)) * width
        written = (rng.random(letters) > 0.17) & (column > start) & (column < stop)
        value = np.clip(material.brightness + rng.choice([-90.0, 90.0]), 10.0, 240.0)
        for x in column[written]:
            n = int(rng.integers(2, 5))
            vertical = rng.random(n) < 0.5
            angle = np.where(vertical, 0.5 * math.pi, 0.0) + 0.35 * rng.standard_normal(n)
            strokes.append(
                np.stack(
                    [
                        x + 0.13 * size * rng.standard_normal(n),
                        row - 0.3 * size + 0.13 * size * rng.standard_normal(n),
                        np.where(vertical, 0.27, 0.15) * size,
                        np.full(n, 0.05 * size),
                        angle,
                        np.full(n, value),
                        np.full(n, 0.9),
                        np.full(n, 3.0),
                    ],
                    axis=1,
                )
            )
    return np.concatenate(strokes) if strokes else np.zeros((0, 8))


def make_texture(rng: np.random.Generator, height: int, width: int, material: Material) -> F32:
    """Paint a texture of (height, width) texels: grey values in full light, float32."""
    image = np.full((height, width), material.brightness, np.float32)
    noise, marks, writing = _drawn(rng, height, width, material)
    for grid, cell_x, cell_y in noise:
        add_noise(image, grid, cell_x, cell_y, material.noise)
    paint(image, marks)
    paint(image, writing)
    return np.clip(image, 4.0, 250.0, out=image)


def make_colours(
    rng: np.random.Generator, hue_rng: np.random.Generator, height: int, width: int,
    material: Material, coarser: int,
) -> F32:  # fmt: skip
    """The colours of what ``make_texture`` paints with the same ``rng``, height and width.

    hue_rng: chooses the colours of the marks.    coarser: texels that share a colour, each way.
    Returns (2, height / coarser, width / coarser): shares of red and blue, as in ``colours``.
    """
    _, marks, _ = _drawn(rng, height, width, material)
    shown = marks[np.minimum(marks[:, 2], marks[:, 3]) > 0.5 * coarser]
    shown[:, :4] /= coarser
    base = shares(material.tint)
    hues = np.array([base, *(shares(hue) for hue in material.hues)])
    chosen = hue_rng.integers(0, len(hues), len(shown))
    images = np.empty((2, height // coarser, width // coarser), np.float32)
    for image, share, choices in zip(images, base, hues.T, strict=True):
        image[:] = share
        shown[:, 5] = choices[chosen]
        paint(image, shown)
    return images


def _drawn(
    rng: np.random.Generator, height: int, width: int, material: Material
) -> tuple[list[tuple[F64, float, float]], F64, F64]:
    """The random parts of a texture: octaves of noise (grid, width and height of a cell), marks,
    and the strokes of its writing."""
    noise: list[tuple[F64, float, float]] = []
    cell = max(height, width) / 2.0
    while cell >= 3.0:
        cell_x, cell_y = max(cell * material.stretch, 3.0), cell
        shape = (int(height / cell_y) + 2, int(width / cell_x) + 2)
        noise.append((rng.standard_normal(shape), cell_x, cell_y))
        cell /= 2.0
    marks = _marks(rng, height, width, material)
    written = material.writing > 0.0
    return noise, marks, _writing(rng, height, width, material) if written else marks[:0]
