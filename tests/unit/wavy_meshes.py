"""Small meshes: a grid, and waves."""

import numpy as np

from pliant.algorithms.arrays import F32, I32


def grid(side: int) -> tuple[F32, I32]:
    """A plane of 2 (side - 1)^2 triangles from (0, 0) to (1, 1), anticlockwise from above."""
    x, y = np.meshgrid(np.linspace(0, 1, side), np.linspace(0, 1, side), indexing="ij")
    positions = np.stack([x, y, 0.0 * x], axis=-1).reshape(-1, 3).astype(np.float32)
    a = (np.arange(side - 1)[:, None] * side + np.arange(side - 1)).ravel()
    lower = np.stack([a, a + side, a + 1], axis=1)
    upper = np.stack([a + 1, a + side, a + side + 1], axis=1)
    return positions, np.concatenate([lower, upper]).astype(np.int32)


def grey(positions: F32) -> np.ndarray:
    return np.full((len(positions), 3), 100, np.uint8)


def waves(side: int) -> tuple[F32, I32]:
    positions, triangles = grid(side)
    positions[:, 2] = height(positions)
    return positions, triangles


def height(positions: F32) -> F32:
    return np.float32(0.05) * np.sin(12.0 * positions[:, 0]) * np.cos(9.0 * positions[:, 1])
