"""Tallies of navigation errors: dropouts, and cells in which nothing is."""

import math

import numpy as np

from sweep.analysis.scenes.navigation import Tally, tally
from sweep.model.geometry.scanner import corners
from sweep.model.navigation import velocity

FIELDS = ("attempts", "count", "mean", "deviation", "predicted")


def _draws(n, *, bias=(3.0, -2.0, 0.5), seed=1):
    rng = np.random.default_rng(seed)
    mixing = np.array([[1.0, 0.0, 0.0], [0.8, 0.5, 0.0], [-0.3, 0.2, 2.0]])
    error = rng.standard_normal((n, 3)) @ mixing.T + np.asarray(bias)
    covariance = (mixing @ mixing.T) * rng.uniform(0.5, 1.5, (n, 1, 1))
    return error, np.diagonal(covariance, axis1=-2, axis2=-1), rng.random(n) < 0.9


def _of_all(error, variance, available):
    """Tally of all solutions in one cell."""
    found = tally(error, variance, available, np.zeros(len(error), np.int64), 1)
    return Tally(*(getattr(found, name)[0] for name in FIELDS))


def test_what_is_not_there_is_nan_and_never_a_warning():
    error, variance, _ = _draws(4)
    error[1:] = np.nan
    here = np.array([True, False, False, False])
    with np.errstate(all="raise"):
        result = tally(error, variance, here, np.array([0, 0, 1, 1]), 3)
        result = result + result
        assert result.availability[:2].tolist() == [0.5, 0.0] and np.isnan(result.availability[2])
        assert np.isfinite(result.bias[0]).all() and np.isnan(result.bias[1:]).all()
        assert np.isfinite(result.rmse[0]).all() and np.isnan(result.rmse[1:]).all()
        assert np.isnan(result.stated[1:]).all()
        once = _of_all(error, variance, here)
        assert np.isnan(once.variance).all()  # one draw has no spread


def test_dropouts_give_the_availability_of_three_of_four_and_the_stated_variance():
    n, pd, moving = 20_000, 0.8, np.array([5.0, -3.0, -60.0])
    beams, rng = corners(math.radians(22.5)), np.random.default_rng(3)
    measured = beams @ moving + rng.normal(0, 0.01, (n, 4))
    measured[rng.random((n, 4)) >= pd] = np.nan
    found = velocity(direction=beams, radial_velocity=measured, standard_error=0.01)
    stated = np.diagonal(found.covariance, axis1=-2, axis2=-1)
    result = _of_all(found.value - moving, stated, found.available)
    expected = pd**4 + 4 * pd**3 * (1 - pd)
    assert abs(result.availability - expected) <= 5 * math.sqrt(expected * (1 - expected) / n)
    assert (np.abs(result.bias) <= 5 * np.sqrt(result.stated / result.count)).all()
    # draws of three and of four beams mix, so the spread of squares is taken from themselves
    off = found.value[found.available] - moving
    spread = np.std(off**2, axis=0) / np.sqrt(result.count)
    assert (np.abs(result.variance - result.stated) <= 5 * spread).all()
    assert (5 * spread < 0.07 * result.stated).all()  # a variance 7 % off would show
    np.testing.assert_allclose(
        result.rmse**2, result.variance + result.bias**2, rtol=2 / result.count
    )
