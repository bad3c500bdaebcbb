"""Intervals: their defining equations, scipy's slow ones, and their coverage, exact if possible.

A count moves in steps, and whether one more of them belongs to the likely ones changes coverage by
its probability: intervals that are right on the average may fall short by as much, a step.
"""

import numpy as np
import pytest
from scipy import stats

from sweep.model.detection.marcum import marcum_q1
from sweep.model.error_budget import (
    COUNT_INTERVAL_FUNCTIONS,
    bounded_mean_interval,
    clopper_pearson_interval,
    interval_half_width,
    wilson_interval,
)

CONFIDENCE = 0.95
Z = stats.norm.ppf(0.975)
CHANCES = np.array([0, 1e-4, 1e-3, 0.01, 0.03, 0.1, 0.3, 0.5])
CHANCES = np.concatenate([CHANCES, 1 - CHANCES[-2::-1]])
NUMBERS = (1, 2, 5, 10, 100, 1000, 10_000)


@pytest.mark.parametrize("n", [1, 7, 1000, 10**6])
@pytest.mark.parametrize("confidence", [0.5, 0.95, 0.9999])
def test_beyond_clopper_and_pearsons_ends_the_counts_have_half_the_rest_each(n, confidence):
    k = np.unique([0, 1, 2, n // 3, n - 1, n])
    k = k[k <= n]
    low, high = clopper_pearson_interval(successes=k, trials=n, confidence=confidence)
    below = (1 - confidence) / 2
    inner = k > 0
    np.testing.assert_allclose(stats.binom.sf(k[inner] - 1, n, low[inner]), below, rtol=1e-6)
    inner = k < n
    np.testing.assert_allclose(stats.binom.cdf(k[inner], n, high[inner]), below, rtol=1e-6)
    assert low[0] == 0 and high[-1] == 1


def test_no_success_and_nothing_but_success_in_very_many_trials():
    n = np.array([1.0, 1e6, 1e12])
    unseen = -np.expm1(np.log(0.025) / n)
    for k, ends in ((0 * n, (0, unseen)), (n, (1 - unseen, 1))):
        bounds = clopper_pearson_interval(successes=k, trials=n, confidence=CONFIDENCE)
        for end, expected in zip(bounds, ends, strict=True):
            np.testing.assert_allclose(end, expected + 0 * n, rtol=1e-12)


@pytest.mark.parametrize("n", [1, 7, 1000, 10**6])
def test_wilsons_ends_are_as_likely_as_their_own_variance_says(n):
    k = np.unique([0, 1, n // 3, n - 1, n])
    low, high = wilson_interval(successes=k, trials=n, confidence=CONFIDENCE)
    for end in (low, high):
        residual = (k / n - end) ** 2 - Z**2 * end * (1 - end) / n
        np.testing.assert_allclose(residual, 0, atol=1e-14)
    assert (low < high).all() and low[0] == 0 and high[-1] == 1
    assert high[0] == pytest.approx(Z**2 / (n + Z**2), rel=1e-12)


def coverage(estimate, interval, weight, truth):
    """Probability that estimate +- half-width holds the truth; the largest step near its ends."""
    within = abs(estimate - truth) <= interval_half_width(estimate, interval) + 1e-15
    edges = np.flatnonzero(np.diff(within.astype(int), prepend=0, append=0))
    near = np.unique(np.clip(np.concatenate([edges - 1, edges]), 0, weight.size - 1))
    return weight[within].sum(), weight[near].max()


@pytest.mark.parametrize("n", NUMBERS)
@pytest.mark.parametrize("name", COUNT_INTERVAL_FUNCTIONS)
def test_counts_are_as_sure_as_promised(name, n):
    k = np.arange(n + 1)
    interval = COUNT_INTERVAL_FUNCTIONS[name](successes=k, trials=n, confidence=CONFIDENCE)
    for p in CHANCES:
        coverage_share, step = coverage(k / n, interval, stats.binom.pmf(k, n, p), p)
        assert coverage_share >= CONFIDENCE - (step if name == "wilson" else 1e-12), p


def test_on_the_average_wilsons_own_interval_is_right_and_clopper_and_pearsons_wider():
    k, n = np.arange(101), 100
    p = (np.arange(2000) + 0.5) / 2000
    weight = stats.binom.pmf(k, n, p[:, None])
    means = {}
    for name, interval in COUNT_INTERVAL_FUNCTIONS.items():
        low, high = interval(successes=k, trials=n, confidence=CONFIDENCE)
        means[name] = (weight * ((low <= p[:, None]) & (p[:, None] <= high))).sum(axis=1).mean()
    assert means["wilson"] == pytest.approx(CONFIDENCE, abs=0.004)
    assert means["clopper_pearson"] > 0.96


@pytest.mark.parametrize("n", [2, 10, 100, 1000, 10_000])
@pytest.mark.parametrize("pair", [(0, 1), (0, 0.5), (0, 0.1), (0.3, 1), (0.5, 0.6), (0, 0.01)])
def test_means_of_two_values_are_as_sure_as_promised(pair, n):
    """Rare flashes over a steady level, and fades: all of them may have gone unseen."""
    (u, v), k = pair, np.arange(n + 1)
    mean = u + (v - u) * k / n
    variance = (v - u) ** 2 * k * (1 - k / n) / (n - 1)
    interval = bounded_mean_interval(
        mean=mean, variance=variance, n_values=n, confidence=CONFIDENCE
    )
    for p in CHANCES:
        coverage_share, step = coverage(mean, interval, stats.binom.pmf(k, n, p), u + (v - u) * p)
        assert coverage_share >= CONFIDENCE - step, p


AMPLITUDE = np.linspace(0, 20, 20_001)
DETECTED = marcum_q1(AMPLITUDE, 6.5).q


def speckled(pd, shape, random):
    """Conditional pd over an exponential power, of mean exp(-Th^2 / 2 (1 + SNR))."""
    snr = 6.5**2 / (2 * np.log(1 / pd)) - 1
    power = random.standard_exponential(shape)
    return np.interp(np.sqrt(2 * snr * power), AMPLITUDE, DETECTED)


def powers(pd, shape, random):
    return random.random(shape) ** (1 / pd - 1)


@pytest.mark.parametrize("n", [3, 30, 300])
@pytest.mark.parametrize("values", [speckled, powers])
def test_means_of_skewed_values_are_as_sure_as_promised(values, n):
    """5 sigma of 2000 trials are 2.4 %."""
    random, trials = np.random.default_rng(3), 2000
    for pd in CHANCES[(CHANCES > 0) & (CHANCES < 1)]:
        drawn = values(pd, (trials, n), random)
        mean = drawn.mean(axis=1)
        interval = bounded_mean_interval(
            mean=mean, variance=drawn.var(axis=1, ddof=1), n_values=n, confidence=CONFIDENCE
        )
        coverage_share = (abs(mean - pd) <= interval_half_width(mean, interval)).mean()
        sigma = np.sqrt(CONFIDENCE * (1 - CONFIDENCE) / trials)
        assert coverage_share >= CONFIDENCE - 5 * sigma, pd


def test_draws_all_alike_promise_no_more_than_so_many_draws_can():
    n = np.array([1, 100, 10_000])
    for mean, half_width_max in ((0.0, 1.0), (1.0, 1.0), (0.3, 0.7)):
        interval = bounded_mean_interval(mean=mean, variance=0.0, n_values=n, confidence=CONFIDENCE)
        width = interval_half_width(mean, interval)
        np.testing.assert_allclose(width, np.minimum(Z**2 / n, 1) * half_width_max, rtol=1e-12)
        # What 19 of 20 samples of so many miss has a probability of 3 / n, and adds as much.
        assert (width >= half_width_max * -np.expm1(np.log(0.05) / n)).all()


def test_with_many_draws_only_their_variance_counts():
    interval = bounded_mean_interval(
        mean=0.4, variance=0.09, n_values=10**10, confidence=CONFIDENCE
    )
    assert interval_half_width(0.4, interval) == pytest.approx(Z * 0.3 / 1e5, rel=1e-4)
    assert interval_half_width(0.4, interval) > Z * 0.3 / 1e5
