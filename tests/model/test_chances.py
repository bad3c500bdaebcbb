import math

import mpmath as mp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sweep.model.chances import (
    at_least_one,
    at_least_one_scalar,
    log_at_least_one,
    log_at_least_one_scalar,
)

ACCURACY = 1e-15
SMALLEST_STEP = 5e-324
without_deadline = settings(deadline=None)  # the first call may compile
tries = st.one_of(st.sampled_from([0.5, 1.0, 2.0, 65536.0, 131072.0]), st.floats(1e-3, 1e9))


def exact_log(p, n):
    """ln(1 - (1-p)^n), naively but with 400 digits, and the condition number of (1-p)^n in p."""
    none = (1 - p) ** mp.mpf(n)
    return mp.log(1 - none), n * p / (1 - p)


@given(st.floats(1e-300, 1.0), tries)
@without_deadline
def test_chance_of_one_among_many_keeps_its_digits_at_any_size(p, n):
    with mp.workdps(400):
        exact = 1 - (1 - mp.mpf(p)) ** mp.mpf(n)
        assert abs(at_least_one_scalar(p, n) - exact) <= ACCURACY * exact


@given(st.floats(-300.0, -1e-9), tries)
@without_deadline
def test_logarithm_agrees_with_400_naive_digits(log_p, n):
    with mp.workdps(400):
        exact, condition = exact_log(mp.exp(mp.mpf(log_p)), n)
        # Near certainty ln p itself determines the result no better than this.
        tolerance = ACCURACY if condition < 1 else (2 + condition) * 5e-16
        error = abs(log_at_least_one_scalar(log_p, n) - exact)
        assert error <= tolerance * abs(exact) + SMALLEST_STEP


@pytest.mark.parametrize("log_p", [-599.9, -600.1, -744.0, -750.0, -1e5, -1e9])
@pytest.mark.parametrize("n", [1, 3, 131072, 1e15])
def test_logarithm_of_chances_below_float64_is_right(log_p, n):
    # mpmath's exponents have no bounds, so the same definition is good here; p n < 1e-245.
    with mp.workdps(60):
        p = mp.exp(mp.mpf(log_p))
        exact = mp.log(-mp.expm1(n * mp.log1p(-p)))
        assert abs(log_at_least_one_scalar(log_p, n) - exact) <= ACCURACY * abs(exact)


@pytest.mark.parametrize("p", [1e-21, 1e-5, 0.3, 0.5, 0.8, 1 - 1e-12])
@pytest.mark.parametrize("n", [1, 2, 7])
def test_few_tries_agree_with_the_sum_over_how_many_succeed(p, n):
    binomial = math.fsum(math.comb(n, k) * p**k * (1 - p) ** (n - k) for k in range(1, n + 1))
    assert at_least_one_scalar(p, n) == pytest.approx(binomial, rel=4e-15)


@given(st.floats(-50.0, -1e-6))
@without_deadline
def test_one_try_changes_nothing(log_p):
    assert log_at_least_one_scalar(log_p, 1.0) == pytest.approx(log_p, rel=ACCURACY)


@given(st.floats(1e-25, 0.5), st.floats(1.0, 1e6), st.floats(1.0, 1e6))
@without_deadline
def test_tries_in_two_lots_are_the_tries_in_one(p, first, second):
    one, other = at_least_one_scalar(p, first), at_least_one_scalar(p, second)
    both = at_least_one_scalar(p, first + second)
    assert both == pytest.approx(one + other * (1 - one), rel=4 * ACCURACY)


def test_certainty_impossibility_and_no_tries():
    assert at_least_one([0.0, 1.0, 1.0, 0.5], [5, 3, 0, 0]).tolist() == [0.0, 1.0, 0.0, 0.0]
    found = log_at_least_one([-math.inf, 0.0, 0.0, -1.0], [5, 3, 0, 0])
    assert found.tolist() == [-math.inf, 0.0, -math.inf, -math.inf]


def test_arrays_broadcast():
    p, n = np.array([[1e-20], [0.1]]), np.array([1.0, 2.0, 3.0])
    chance, log_chance = at_least_one(p, n), log_at_least_one(np.log(p), n)
    assert chance.shape == log_chance.shape == (2, 3)
    np.testing.assert_allclose(chance[0], [1e-20, 2e-20, 3e-20], rtol=1e-15)
    np.testing.assert_allclose(chance[1], [0.1, 0.19, 0.271], rtol=1e-15)
    np.testing.assert_allclose(log_chance, np.log(chance), rtol=1e-14)


def test_impossible_arguments_are_refused():
    for p in (-1e-9, 1.1, math.nan):
        with pytest.raises(ValueError, match=r"within 0\.\.1"):
            at_least_one(p, 3)
    for log_p in (1e-9, math.nan):
        with pytest.raises(ValueError, match="at most 0"):
            log_at_least_one(log_p, 3)
    for n in (-1, math.inf, math.nan):
        with pytest.raises(ValueError, match="number of tries"):
            at_least_one(0.5, n)
        with pytest.raises(ValueError, match="number of tries"):
            log_at_least_one(-1.0, n)
