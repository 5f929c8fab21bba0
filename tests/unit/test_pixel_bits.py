"""Bits of pixels against an array of booleans."""

import numpy as np

from pliant.algorithms.tracking.upkeep import get_bit, no_bits, set_bit, set_square

HEIGHT, WIDTH = 37, 71


def test_squares_and_bits_equal_an_array() -> None:
    rng = np.random.default_rng(0)
    bits, plain = no_bits(HEIGHT, WIDTH), np.zeros((HEIGHT, WIDTH), np.bool_)
    for reach in (0, 1, 2, 20, 31):
        bits[:], plain[:] = 0, False
        for x, y in rng.integers(0, [WIDTH, HEIGHT], (12, 2)).tolist():
            set_square(bits, x, y, reach, HEIGHT, WIDTH)
            plain[max(y - reach, 0) : y + reach + 1, max(x - reach, 0) : x + reach + 1] = True
            set_bit(bits, (y * WIDTH + 3 * x) % (HEIGHT * WIDTH))
            plain.ravel()[(y * WIDTH + 3 * x) % (HEIGHT * WIDTH)] = True
        read = [get_bit(bits, at) for at in range(HEIGHT * WIDTH)]
        np.testing.assert_array_equal(read, plain.ravel())
