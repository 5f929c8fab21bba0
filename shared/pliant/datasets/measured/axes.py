"""Orders of axes as letters: in "YxZ" the first number is along Y, the second along -X."""

import numpy as np

from pliant.algorithms.arrays import F64


def axis_order(letters: str) -> F64:
    """(3, 3): numbers in the order of the letters to x, y and z; the identity if they are none."""
    if sorted(letters.lower()) != ["x", "y", "z"]:
        return np.eye(3)
    order = np.zeros((3, 3))
    for column, letter in enumerate(letters):
        order["xyz".index(letter.lower()), column] = 1.0 if letter.isupper() else -1.0
    return order
