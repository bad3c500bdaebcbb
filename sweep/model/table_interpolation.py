"""Linear interpolation of tables that share coordinates."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike


def interpolate_tables(
    grids: Sequence[np.ndarray], tables: Sequence[np.ndarray], positions: Sequence[ArrayLike]
) -> tuple[np.ndarray, ...]:
    """Return the values of several tables at points, interpolated linearly along each axis.

    Parameters
    ----------
    grids : sequence of ndarray
        Increasing coordinates of the tables' nodes, one array for each axis.
    tables : sequence of ndarray
        Tables of equal shape, one axis for each array of `grids`.
    positions : sequence of array_like
        Coordinates of the points, one array for each axis; the arrays broadcast. Points beyond a
        grid take the value at its end.

    Returns
    -------
    tuple of ndarray
        Value of each table at the points; nan where a coordinate is nan.

    Examples
    --------
    >>> grids = np.array([0.0, 1.0, 4.0]), np.array([0.0, 1.0])
    >>> table = np.add.outer(grids[0], 10 * grids[1])
    >>> interpolate_tables(grids, [table], [[2.0, 9.0], 0.5])
    (array([7., 9.]),)
    """
    from scipy.ndimage import map_coordinates  # slow to import

    indices = np.array(
        np.broadcast_arrays(
            *(
                np.interp(np.asarray(position, float), grid, np.arange(grid.size))
                for position, grid in zip(positions, grids, strict=True)
            )
        )
    )
    is_defined = np.isfinite(indices).all(axis=0)
    flat_indices = np.where(is_defined, indices, 0.0).reshape(len(indices), -1)
    values_of_tables = (
        map_coordinates(np.asarray(table, float), flat_indices, order=1, mode="nearest").reshape(
            is_defined.shape
        )
        for table in tables
    )
    return tuple(np.where(is_defined, values, np.nan) for values in values_of_tables)
