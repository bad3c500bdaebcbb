"""Marcum's Q and chances among many: laws that they obey.

Digits are held by `tests/stability/hard_marcum.py` and `hard_chances.py`.
"""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import i0e

from sweep.model.detection.marcum import (
    at_least_one_probability,
    log_at_least_one_probability,
    marcum_q1,
    marcum_q1_excess,
    marcum_q1_tails,
)

ACCURACY = 2e-15  # what the docstrings promise
without_deadline = settings(deadline=None)  # the first call may compile
amplitudes = st.floats(0.0, 60.0)


@given(amplitudes, amplitudes)
@without_deadline
def test_both_tails_are_probabilities_that_sum_to_one(a, b):
    q, p = marcum_q1_tails(a, b)
    assert 0.0 <= q <= 1.0
    assert 0.0 <= p <= 1.0
    assert abs(q + p - 1.0) <= 2.3e-16


@given(amplitudes, amplitudes, amplitudes)
@without_deadline
def test_crossing_grows_with_the_signal_and_shrinks_with_the_threshold(a, b, c):
    low, high = sorted((a, c))
    slack = 2 * ACCURACY
    weak, strong = marcum_q1_tails(low, b), marcum_q1_tails(high, b)
    assert strong[0] >= weak[0] * (1 - slack)
    assert strong[1] <= weak[1] * (1 + slack)
    low, high = sorted((b, c))
    lax, strict = marcum_q1_tails(a, low), marcum_q1_tails(a, high)
    assert strict[0] <= lax[0] * (1 + slack)
    assert strict[1] >= lax[1] * (1 - slack)


@given(amplitudes, amplitudes)
@settings(deadline=None, max_examples=300)
def test_exchange_of_signal_and_threshold_gives_the_bessel_function(a, b):
    # Q1(a,b) + Q1(b,a) = 1 + exp(-(a^2+b^2)/2) I0(ab), with 1 - Q1(b,a) taken to the right. The
    # right side is only as good as exp(-(a-b)^2/2) with a rounded square, and i0e.
    a, b = sorted((a, b))
    q = marcum_q1_tails(a, b)[0]
    p = marcum_q1_tails(b, a)[1]
    half = 0.5 * (b - a) ** 2
    right = math.exp(-half) * i0e(a * b)
    assert abs((q - p) - right) <= (2 * ACCURACY + 3e-16 * half) * (q + right) + 1e-307


def test_limits_at_zero_and_infinity():
    assert marcum_q1_tails(5.0, 0.0) == (1.0, 0.0)
    assert marcum_q1_tails(math.inf, 5.0) == (1.0, 0.0)
    assert marcum_q1_tails(math.inf, 0.0) == (1.0, 0.0)
    assert marcum_q1_tails(5.0, math.inf) == (0.0, 1.0)
    assert marcum_q1_tails(0.0, math.inf) == (0.0, 1.0)
    assert marcum_q1_excess(0.0, math.inf) == 0.0
    assert marcum_q1_excess(math.inf, 3.0) == pytest.approx(-math.expm1(-4.5), rel=1e-15)


def test_huge_arguments_neither_overflow_nor_lose_the_half():
    assert marcum_q1_tails(1e200, 1e200) == (0.5, 0.5)
    assert marcum_q1_tails(1e200, 1.1e200) == (0.0, 1.0)
    assert marcum_q1_tails(1e150, 1e-150) == (1.0, 0.0)
    assert marcum_q1_tails(1e-300, 1e300) == (0.0, 1.0)


@pytest.mark.parametrize(("a", "b"), [(-1.0, 1.0), (1.0, -1e-9), (math.nan, 1.0), (1.0, math.nan)])
def test_arguments_outside_the_domain_give_nan(a, b):
    assert all(math.isnan(value) for value in marcum_q1_tails(a, b))
    assert math.isnan(marcum_q1_excess(a, b))


def test_two_infinite_arguments_give_nan():
    assert math.isnan(marcum_q1_tails(math.inf, math.inf)[0])


def test_arrays_broadcast_and_equal_the_scalar_forms():
    a, b = np.linspace(0.0, 12.0, 7)[:, None], np.linspace(0.1, 9.0, 5)
    values = marcum_q1(a, b)
    assert values.q.shape == (7, 5)
    assert marcum_q1(1.0, 2.0).p.shape == ()
    for i in range(7):
        for j in range(5):
            assert tuple(v[i, j] for v in values) == marcum_q1_tails(a[i, 0], b[j])


# At least one among many


def test_certainty_impossibility_and_no_tries():
    assert at_least_one_probability([0.0, 1.0, 1.0, 0.5], [5, 3, 0, 0]).tolist() == [
        0.0,
        1.0,
        0.0,
        0.0,
    ]
    log_probability = log_at_least_one_probability([-math.inf, 0.0, 0.0, -1.0], [5, 3, 0, 0])
    assert log_probability.tolist() == [-math.inf, 0.0, -math.inf, -math.inf]


def test_arrays_broadcast():
    p, n = np.array([[1e-20], [0.1]]), np.array([1.0, 2.0, 3.0])
    chance, log_chance = at_least_one_probability(p, n), log_at_least_one_probability(np.log(p), n)
    assert chance.shape == log_chance.shape == (2, 3)
    np.testing.assert_allclose(chance[0], [1e-20, 2e-20, 3e-20], rtol=1e-15)
    np.testing.assert_allclose(chance[1], [0.1, 0.19, 0.271], rtol=1e-15)
    np.testing.assert_allclose(log_chance, np.log(chance), rtol=1e-14)
