"""Interlaced pictures: even rows are of one time, odd rows of another."""

import numpy as np

from pliant.algorithms.arrays import U8


def one_field(image: U8) -> U8:
    """An (H, W, 3) image of its even rows alone; each odd row is the mean of its neighbours."""
    made, field = image.copy(), image[::2].astype(np.uint16)
    between = made[1::2]
    below = field[1:][: len(between)]
    between[: len(below)] = (field[: len(below)] + below + 1) >> 1
    between[len(below) :] = image[::2][len(below) : len(between)]
    return made
