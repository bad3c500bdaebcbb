"""Values that broadcast against each other as a table: what compiled formulas take, row by row."""

import numpy as np
from numpy.typing import ArrayLike

_MOST = 32
"""Values that numpy broadcasts at once."""


def columns(*values: ArrayLike) -> tuple[np.ndarray, tuple[int, ...]]:
    """Values side by side, (values, n) float64, and the shape that their n entries have."""
    few = len(values) <= _MOST
    shape = np.broadcast(*values).shape if few else np.broadcast_shapes(*map(np.shape, values))
    table = np.empty((len(values), *shape))
    for k, value in enumerate(values):
        table[k] = value
    return table.reshape(len(values), -1), shape
