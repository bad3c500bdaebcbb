"""Statistics of values that are read piece by piece, against those of all of them at once."""

import math
from fractions import Fraction

import numpy as np
import pytest
import xarray as xr
from hypothesis import given, settings
from hypothesis import strategies as st

from sweep.analysis.selection import (
    Points,
    Search,
    Tally,
    for_median,
    median,
    pieces,
    search,
    tallied,
)

floats = st.floats(allow_nan=False, allow_infinity=False)
some = st.lists(st.one_of(floats, st.sampled_from([0.0, -0.0, 1.0, 5e-324])), min_size=1)


def searched(one, values, weights=None, cut=3):
    """A search over values in pieces."""
    edges = range(0, len(values), cut)

    def read():
        for k in edges:
            yield one, values[k : k + cut], None if weights is None else weights[k : k + cut]

    search([one], read)
    return one


@given(values=some, cut=st.integers(1, 9))
def test_a_mean_is_the_exact_one_rounded_once(values, cut):
    tally = Tally()
    for k in range(0, len(values), cut):
        tally.add(np.array(values[k : k + cut]))
    assert tally.total == sum(map(Fraction, values))
    assert tally.mean == float(sum(map(Fraction, values)) / len(values))
    assert (tally.least, tally.largest) == (min(values), max(values))


def test_values_that_are_not_finite_count_for_nothing():
    tally = Tally()
    tally.add(np.array([np.nan, 2.0, np.inf, -np.inf]))
    assert (tally.number, tally.mean, tally.least, tally.largest) == (1, 2.0, 2.0, 2.0)
    assert math.isnan(Tally().mean)


@given(values=some, cut=st.integers(1, 9))
def test_a_median_is_that_of_all_values_to_the_last_digit(values, cut):
    ordered = sorted(values)
    middle = ordered[(len(values) - 1) // 2], ordered[len(values) // 2]
    one = searched(for_median(len(values)), np.array(values), cut=cut)
    assert tuple(one.values) == middle
    assert median(one) == (middle[0] + middle[1]) / 2
    assert math.isnan(median(for_median(0)))


def test_a_search_by_weight_ends_at_the_value_that_reaches_it():
    values = np.array([3.0, -1.0, 2.0, -1.0, 7.0])
    weights = np.array([1.0, 4.0, 2.0, 4.0, 8.0])
    for weight, expected in ((1.0, -1.0), (8.0, -1.0), (8.5, 2.0), (11.0, 3.0), (19.0, 7.0)):
        assert searched(Search([weight]), values, weights).values == [expected]


@settings(max_examples=20)
@given(chunks=st.tuples(st.integers(1, 7), st.integers(1, 9)), seed=st.integers(0, 99))
def test_groups_hold_their_own_points_whatever_the_pieces(chunks, seed):
    rng = np.random.default_rng(seed)
    values = np.where(rng.random((7, 9)) < 0.1, np.nan, rng.normal(size=(7, 9)))
    along = rng.integers(0, 3, 7)
    dataset = xr.Dataset({"v": (("y", "x"), values)}, {"kind": ("y", along)})
    cut = dataset.chunk(dict(zip("yx", chunks, strict=True)))
    groups = [part for _, part in Points.of(cut).where("x", [1, 2, 5, 8]).apart("kind")]
    for (kind, part), tally in zip(
        Points.of(dataset).apart("kind"), tallied(groups, "v"), strict=True
    ):
        own = values[along == kind][:, [1, 2, 5, 8]]
        assert tally.number == np.isfinite(own).sum()
        assert tally.mean == pytest.approx(np.nanmean(own), rel=1e-14)
        assert part.size == 9 * (along == kind).sum()
    read = [(part.spread("kind"), found["v"]) for _, part, found in pieces(groups, ["v"])]
    for kind, own in ((k, v) for kinds, found in read for k, v in zip(kinds, found, strict=True)):
        assert np.isnan(own) or own in values[along == kind]
