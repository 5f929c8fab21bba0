"""Interlaced pictures: even rows are of one time, odd rows of another."""

import numpy as np

from pliant.algorithms.arrays import U8

_LINES = 1088
"""Maximum lines of interlaced video."""
_COLUMNS = 8
_COMBED = 1.25
"""How much lines differ from the next over how much from the next but one.  Images of cameras have
0.5 to 0.8, rendered ones up to 0.95, noise 1; of two fields while the camera moves 2."""


def is_combed(image: U8) -> bool:
    """Whether the rows of an (H, W, 3) image are of two times, marked so or not."""
    if not 2 < image.shape[0] <= _LINES:
        return False
    rows = image[:, ::_COLUMNS, 1].astype(np.int16)
    next_one = np.abs(rows[1:-1] - rows[:-2]).mean()
    return bool(next_one > _COMBED * np.abs(rows[2:] - rows[:-2]).mean() + 1.0)


def one_field(image: U8) -> U8:
    """An (H, W, 3) image of its even rows alone; each odd row is the mean of its neighbours."""
    made, field = image.copy(), image[::2].astype(np.uint16)
    between = made[1::2]
    below = field[1:][: len(between)]
    between[: len(below)] = (field[: len(below)] + below + 1) >> 1
    between[len(below) :] = image[::2][len(below) : len(between)]
    return made
