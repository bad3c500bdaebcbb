"""Statistics of values that are read piece by piece, against those of all of them at once."""

import math
from fractions import Fraction

import numpy as np
import pytest
import xarray as xr
from hypothesis import given, settings
from hypothesis import strategies as st

from sweep.analysis.selection import Points, Tally, medians, pieces, tallied

floats = st.floats(-1e300, 1e300, allow_nan=False)
some = st.lists(
    st.one_of(floats, st.sampled_from([0.0, -0.0, 1.0, 1e-300])), min_size=1, max_size=99
)


@given(values=some, cut=st.integers(1, 9))
def test_a_mean_is_the_exact_one_but_for_rounding(values, cut):
    tally = Tally()
    for k in range(0, len(values), cut):
        tally.add(np.array(values[k : k + cut]))
    exact, size = sum(map(Fraction, values)), sum(abs(Fraction(v)) for v in values)
    assert abs(Fraction(tally.mean) * len(values) - exact) <= size * len(values) * Fraction(
        1, 2**51
    )
    assert (tally.least, tally.largest) == (min(values), max(values))


def test_values_that_are_not_finite_count_for_nothing():
    tally = Tally()
    tally.add(np.array([np.nan, 2.0, np.inf, -np.inf]))
    assert (tally.number, tally.mean, tally.least, tally.largest) == (1, 2.0, 2.0, 2.0)
    assert math.isnan(Tally().mean)


@settings(max_examples=20)
@given(chunks=st.tuples(st.integers(1, 7), st.integers(1, 9)), seed=st.integers(0, 99))
def test_groups_hold_their_own_points_whatever_the_pieces(chunks, seed):
    rng = np.random.default_rng(seed)
    values = np.where(rng.random((7, 9)) < 0.1, np.nan, rng.normal(size=(7, 9)))
    along = rng.integers(0, 3, 7)
    dataset = xr.Dataset({"v": (("y", "x"), values)}, {"kind": ("y", along)})
    cut = dataset.chunk(dict(zip("yx", chunks, strict=True)))
    groups = [part for _, part in Points.of(cut).where("x", [1, 2, 5, 8]).apart("kind")]
    tallies = tallied(groups, "v")
    middles = medians(groups, "v", [tally.number for tally in tallies])
    for (kind, part), tally, middle in zip(
        Points.of(dataset).apart("kind"), tallies, middles, strict=True
    ):
        own = values[along == kind][:, [1, 2, 5, 8]]
        assert tally.number == np.isfinite(own).sum()
        assert tally.mean == pytest.approx(np.nanmean(own), rel=1e-14)
        assert middle == np.nanmedian(own)
        assert part.size == 9 * (along == kind).sum()
    read = [(part.spread("kind"), found["v"]) for _, part, found in pieces(groups, ["v"])]
    for kind, own in ((k, v) for kinds, found in read for k, v in zip(kinds, found, strict=True)):
        assert np.isnan(own) or own in values[along == kind]
