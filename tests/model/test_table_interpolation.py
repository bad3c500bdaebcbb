"""Interpolated tables, against scipy's interpolator on regular grids."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import RegularGridInterpolator

from sweep.model.table_interpolation import interpolate_tables


@given(seed=st.integers(0, 2**32 - 1), sizes=st.lists(st.integers(2, 9), min_size=1, max_size=4))
@settings(max_examples=40, deadline=None)
def test_tables_are_interpolated_as_by_scipy_and_hold_their_ends(seed, sizes):
    rng = np.random.default_rng(seed)
    grids = [np.cumsum(rng.uniform(0.1, 2.0, size)) for size in sizes]
    tables = rng.normal(size=(2, *sizes))
    positions = [rng.uniform(grid[0] - 1, grid[-1] + 1, (5, 7)) for grid in grids]
    clipped = [np.clip(p, grid[0], grid[-1]) for p, grid in zip(positions, grids, strict=True)]
    interpolated = interpolate_tables(grids, tables, positions)
    for values, table in zip(interpolated, tables, strict=True):
        expected = RegularGridInterpolator(grids, table)(np.stack(clipped, axis=-1))
        np.testing.assert_allclose(values, expected, rtol=0, atol=1e-12)


def test_an_unknown_coordinate_gives_an_unknown_value():
    grids = np.array([0.0, 1.0]), np.array([0.0, 2.0])
    (values,) = interpolate_tables(
        grids, [np.ones((2, 2))], ([0.5, np.nan, 0.1], [1.0, 1.0, np.nan])
    )
    assert values == pytest.approx([1.0, np.nan, np.nan], nan_ok=True)


def test_a_single_point_has_a_value_without_axes():
    (value,) = interpolate_tables([np.array([0.0, 2.0])], [np.array([1.0, 3.0])], [0.5])
    assert value.shape == () and value == 1.5


def test_tables_of_whole_numbers_are_interpolated_between_them():
    (values,) = interpolate_tables([np.arange(3.0)], [np.array([0, 1, 2])], [[0.5, 1.5]])
    assert values.tolist() == [0.5, 1.5]
