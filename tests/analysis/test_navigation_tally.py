"""Tallies of navigation errors: dropouts, and cells in which nothing is."""

import math
from itertools import pairwise

import numpy as np
import pytest

from sweep.analysis.scene_results.navigation_errors import ErrorTally, merge_tallies, tally_errors
from sweep.model.geometry.scanner import corner_directions
from sweep.model.pointcloud.navigation import solve_velocity

FIELDS = (
    "n_attempts", "n_solutions", "mean_error", "sum_of_squared_deviations", "mean_stated_variance",
)  # fmt: skip


def _draws(n, *, bias=(3.0, -2.0, 0.5), seed=1):
    rng = np.random.default_rng(seed)
    mixing = np.array([[1.0, 0.0, 0.0], [0.8, 0.5, 0.0], [-0.3, 0.2, 2.0]])
    error = rng.standard_normal((n, 3)) @ mixing.T + np.asarray(bias)
    covariance = (mixing @ mixing.T) * rng.uniform(0.5, 1.5, (n, 1, 1))
    return error, np.diagonal(covariance, axis1=-2, axis2=-1), rng.random(n) < 0.9


def _of_all(error, variance, available):
    """Tally of all solutions in one cell."""
    tally = tally_errors(error, variance, available, np.zeros(len(error), np.int64), 1)
    return ErrorTally(*(getattr(tally, name)[0] for name in FIELDS))


def _units(sizes):
    """Tallies of stretches of the same draws, and the draws."""
    error, variance, available = _draws(sum(sizes))
    ends = np.cumsum([0, *sizes])
    parts = [_of_all(error[a:b], variance[a:b], available[a:b]) for a, b in pairwise(ends)]
    return parts, (error, variance, available)


def _same_bits(one, other):
    return all(getattr(one, f).tobytes() == getattr(other, f).tobytes() for f in FIELDS)


def test_a_tally_says_what_numpy_says_of_all_draws():
    error, variance, available = _draws(5000)
    result = _of_all(error, variance, available)
    held = error[available]
    assert result.n_solutions == available.sum() and result.n_attempts == 5000
    assert result.availability == available.mean()
    np.testing.assert_allclose(result.bias, held.mean(axis=0), rtol=1e-12)
    np.testing.assert_allclose(result.variance, held.var(axis=0, ddof=1), rtol=1e-12)
    np.testing.assert_allclose(result.rmse, np.sqrt((held**2).mean(axis=0)), rtol=1e-12)
    np.testing.assert_allclose(result.stated_variance, variance[available].mean(axis=0), rtol=1e-12)


@pytest.mark.parametrize("sizes", [[2000, 3000], [1, 0, 999, 17, 2500, 1483], [500] * 10])
def test_merged_tallies_equal_one_pass(sizes):
    parts, (error, variance, available) = _units(sizes)
    merged_at_once, merged = _of_all(error, variance, available), merge_tallies(parts)
    assert (
        merged.n_attempts == merged_at_once.n_attempts
        and merged.n_solutions == merged_at_once.n_solutions
    )
    for name in FIELDS[2:]:
        np.testing.assert_allclose(getattr(merged, name), getattr(merged_at_once, name), rtol=1e-12)


def test_tallies_are_merged_in_a_fixed_tree():
    parts, _ = _units([311, 7, 1200, 44, 901, 3, 650])
    a, b, c, d, e, f, g = parts
    assert _same_bits(merge_tallies(parts), ((a + b) + (c + d)) + ((e + f) + g))
    arrived = {i: parts[i] for i in (4, 0, 6, 2, 5, 1, 3)}
    assert _same_bits(merge_tallies([arrived[i] for i in sorted(arrived)]), merge_tallies(parts))
    # another order is the same sum up to rounding only, which is why the order is fixed
    other = merge_tallies(parts[::-1])
    assert other.n_solutions == merge_tallies(parts).n_solutions
    np.testing.assert_allclose(
        other.sum_of_squared_deviations, merge_tallies(parts).sum_of_squared_deviations, rtol=1e-12
    )
    assert not _same_bits(other, merge_tallies(parts))


def test_cells_of_altitude_hold_their_own_draws():
    error, variance, available = _draws(3000)
    altitude = np.random.default_rng(2).uniform(0, 700, 3000)
    edges = np.array([100.0, 200.0, 400.0, 500.0])
    result = tally_errors(error, variance, available, np.digitize(altitude, edges) - 1, 3)
    assert result.n_attempts.shape == (3,) and result.variance.shape == (3, 3)
    for i in range(3):
        in_cell = (altitude >= edges[i]) & (altitude < edges[i + 1])
        tally_in_cell = _of_all(error[in_cell], variance[in_cell], available[in_cell])
        for name in FIELDS:
            np.testing.assert_allclose(
                getattr(result, name)[i], getattr(tally_in_cell, name), rtol=1e-12, err_msg=name
            )
    assert result.n_attempts.sum() == ((altitude >= 100) & (altitude < 500)).sum() < 3000


def test_what_is_not_there_is_nan_and_never_a_warning():
    error, variance, _ = _draws(4)
    error[1:] = np.nan
    is_available = np.array([True, False, False, False])
    with np.errstate(all="raise"):
        result = tally_errors(error, variance, is_available, np.array([0, 0, 1, 1]), 3)
        result = result + result
        assert result.availability[:2].tolist() == [0.5, 0.0] and np.isnan(result.availability[2])
        assert np.isfinite(result.bias[0]).all() and np.isnan(result.bias[1:]).all()
        assert np.isfinite(result.rmse[0]).all() and np.isnan(result.rmse[1:]).all()
        assert np.isnan(result.stated_variance[1:]).all()
        once = _of_all(error, variance, is_available)
        assert np.isnan(once.variance).all()  # one draw has no spread


def test_dropouts_give_the_availability_of_three_of_four_and_the_stated_variance():
    n, pd, moving = 20_000, 0.8, np.array([5.0, -3.0, -60.0])
    beams, rng = corner_directions(math.radians(22.5)), np.random.default_rng(3)
    measured = beams @ moving + rng.normal(0, 0.01, (n, 4))
    measured[rng.random((n, 4)) >= pd] = np.nan
    solution = solve_velocity(direction=beams, radial_velocity=measured, standard_error=0.01)
    stated_variance = np.diagonal(solution.covariance, axis1=-2, axis2=-1)
    result = _of_all(solution.estimate - moving, stated_variance, solution.is_available)
    expected = pd**4 + 4 * pd**3 * (1 - pd)
    assert abs(result.availability - expected) <= 5 * math.sqrt(expected * (1 - expected) / n)
    assert (np.abs(result.bias) <= 5 * np.sqrt(result.stated_variance / result.n_solutions)).all()
    # draws of three and of four beams mix, so the spread of squares is taken from themselves
    errors = solution.estimate[solution.is_available] - moving
    spread = np.std(errors**2, axis=0) / np.sqrt(result.n_solutions)
    assert (np.abs(result.variance - result.stated_variance) <= 5 * spread).all()
    assert (5 * spread < 0.07 * result.stated_variance).all()  # a variance 7 % off would show
    np.testing.assert_allclose(
        result.rmse**2, result.variance + result.bias**2, rtol=2 / result.n_solutions
    )


def test_no_tallies_can_not_be_merged():
    with pytest.raises(ValueError, match="no tally"):
        merge_tallies([])
