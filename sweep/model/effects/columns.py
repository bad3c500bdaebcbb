"""Values that broadcast against each other as a table: what compiled formulas take, row by row."""

import numpy as np
from numpy.typing import ArrayLike


def columns(*values: ArrayLike) -> tuple[np.ndarray, tuple[int, ...]]:
    """Values side by side, (values, n) float64, and the shape that their n entries have."""
    shape = np.broadcast(*values).shape
    table = np.empty((len(values), *shape))
    for k, value in enumerate(values):
        table[k] = value
    return table.reshape(len(values), -1), shape
