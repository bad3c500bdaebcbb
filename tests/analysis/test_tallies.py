"""Statistics of values that are read piece by piece, against those of all of them at once."""

import math
from fractions import Fraction

import numpy as np
import pytest
import xarray as xr
from hypothesis import given, settings
from hypothesis import strategies as st

from sweep.analysis import selection
from sweep.analysis.selection import PointSelection, Statistics, compute_statistics

floats = st.floats(-1e300, 1e300, allow_nan=False)
float_lists = st.lists(
    st.one_of(floats, st.sampled_from([0.0, -0.0, 1.0, 1e-300])), min_size=1, max_size=99
)


@given(values=float_lists, cut=st.integers(1, 9))
def test_a_mean_is_the_exact_one_but_for_rounding(values, cut):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(selection, "PARTIAL_SUM_VALUES_MAX", cut)
        statistics = Statistics.from_values(np.array(values))
    exact, size = sum(map(Fraction, values)), sum(abs(Fraction(v)) for v in values)
    assert abs(Fraction(statistics.mean) * len(values) - exact) <= size * len(values) * Fraction(
        1, 2**51
    )
    assert (statistics.minimum, statistics.maximum) == (min(values), max(values))


def test_values_that_are_not_finite_count_for_nothing():
    values = xr.Dataset({"v": ("x", [np.nan, 2.0, np.inf, -np.inf])})
    (statistics,) = compute_statistics([PointSelection.from_dataset(values)], "v")
    assert (statistics.n_finite, statistics.mean, statistics.minimum, statistics.maximum) == (
        1,
        2.0,
        2.0,
        2.0,
    )
    assert math.isnan(Statistics.from_values(np.array([np.nan])).mean)


@settings(max_examples=20)
@given(chunks=st.tuples(st.integers(1, 7), st.integers(1, 9)), seed=st.integers(0, 99))
def test_groups_hold_their_own_points_whatever_the_pieces(chunks, seed):
    rng = np.random.default_rng(seed)
    values = np.where(rng.random((7, 9)) < 0.1, np.nan, rng.normal(size=(7, 9)))
    along = rng.integers(0, 3, 7)
    dataset = xr.Dataset({"v": (("y", "x"), values)}, {"kind": ("y", along)})
    cut = dataset.chunk(dict(zip("yx", chunks, strict=True)))
    groups = [
        part for _, part in PointSelection.from_dataset(cut).sel("x", [1, 2, 5, 8]).group_by("kind")
    ]
    for (kind, part), statistics in zip(
        PointSelection.from_dataset(dataset).group_by("kind"),
        compute_statistics(groups, "v"),
        strict=True,
    ):
        kind_values = values[along == kind][:, [1, 2, 5, 8]]
        assert statistics.n_finite == np.isfinite(kind_values).sum()
        rounding = 1e-14 * np.nanmean(np.abs(kind_values))  # a mean may be near 0
        assert statistics.mean == pytest.approx(np.nanmean(kind_values), rel=0, abs=rounding)
        assert statistics.median == np.nanmedian(kind_values)
        assert part.n_points == 9 * (along == kind).sum()
