"""What compiled formulas take: values that broadcast as a table, row by row, and spans' ends."""

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

_MOST = 32
"""Values that numpy broadcasts at once."""


def columns(*values: ArrayLike) -> tuple[np.ndarray, tuple[int, ...]]:
    """Values side by side, (values, n) float64, and the shape that their n entries have."""
    shape = np.broadcast(*values[:_MOST]).shape
    for k in range(_MOST, len(values), _MOST - 1):
        shape = np.broadcast(np.empty(shape), *values[k : k + _MOST - 1]).shape
    table = np.empty((len(values), *shape))
    for k, value in enumerate(values):
        table[k] = value
    return table.reshape(len(values), -1), shape


@njit(cache=True, error_model="numpy")
def product_of(one, other):
    """Product of two spans."""
    a, b, c, d = one[0] * other[0], one[0] * other[1], one[1] * other[0], one[1] * other[1]
    return min(min(a, b), min(c, d)), max(max(a, b), max(c, d))


@njit(cache=True, error_model="numpy")
def quotient_of(one, other):
    """Quotient of two spans, of which the other is positive."""
    a, b, c, d = one[0] / other[0], one[0] / other[1], one[1] / other[0], one[1] / other[1]
    return min(min(a, b), min(c, d)), max(max(a, b), max(c, d))
