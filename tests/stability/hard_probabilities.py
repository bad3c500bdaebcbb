"""Many small chances: false alarms somewhere in a spectrum."""

import mpmath as mp
import numpy as np
from hard_cases import EPS, Family

from sweep.model.detection.added_crossings import any_crossing_probability
from sweep.model.detection.marcum import at_least_one_probability, log_at_least_one_probability

FAMILY = Family(
    "Many small chances",
    "1 - (1-p)^n, of which the plain formula returns 0 below p = 1e-16, and its logarithm. If np "
    "is small the probability is np, without condition; near 1 the probability of none matters.",
)
DIGITS_FOR_TINY_PROBABILITIES = 700
"""1 - p needs as many as p is small, twice over."""


def at_least_one_exactly(p: mp.mpf, n: float) -> mp.mpf:
    """1 - (1-p)^n by the plain formula, in as many digits as that takes."""
    return 1 - (1 - p) ** mp.mpf(n)


def relative_error(value: float, exact_value: mp.mpf) -> float:
    return float(abs(mp.mpf(float(value)) / exact_value - 1))


@FAMILY.case(
    "p from 1e-300 to 0.5, n from 1 to 2^30",
    reference="the plain formula, 700 digits",
    measure="chance",
    allowed=1e-15,
    limit=EPS,
    because="log1p, a product, expm1, rounded",
)
def small_probabilities() -> float:
    with mp.workdps(DIGITS_FOR_TINY_PROBABILITIES):
        return max(
            relative_error(at_least_one_probability(p, n), at_least_one_exactly(mp.mpf(p), n))
            for p in (1e-300, 1e-100, 1.1e-16, 1e-12, 4.79e-10, 1e-9, 1e-3, 0.47, 0.5)
            for n in (1, 2, 65536, 2**30)
        )


@FAMILY.case(
    "p denormal, n to 2^30",
    reference="np, exact to 300 digits",
    measure="steps of 5e-324",
    allowed=0.0,
    limit=0.0,
    because="the product of whole steps is exact",
)
def denormal_probabilities() -> float:
    step = 5e-324
    return max(
        abs(float(at_least_one_probability(k * step, n)) / step - k * n)
        for k in (1, 7, 1000)
        for n in (1, 3, 65536, 2**20)
    )


@FAMILY.case(
    "ln p from -1e6 to -1, n to 2^30",
    reference="the plain formula of exp(ln p), 700 digits; ln p + ln n below",
    measure="logarithm",
    allowed=1e-15,
    limit=EPS,
    because="logarithms of 1 to 1e6, rounded",
)
def log_probabilities() -> float:
    largest = 0.0
    with mp.workdps(DIGITS_FOR_TINY_PROBABILITIES):
        for log_p in (-1e6, -1500.0, -601.0, -599.0, -300.0, -47.3, -21.46):
            for n in (1, 65536, 2**30):
                log = mp.mpf(log_p)
                exact_value = (
                    mp.log(n) + log
                    if log_p < -650
                    else mp.log(at_least_one_exactly(mp.exp(log), n))
                )
                largest = max(
                    largest, relative_error(log_at_least_one_probability(log_p, n), exact_value)
                )
    return largest


@FAMILY.case(
    "all but certain: p up to 1 - 1e-16, many tries",
    reference="the plain formula, 700 digits",
    measure="chance of none, over its condition 2 + np/(1-p)",
    allowed=5e-16,
    limit=EPS,
    because="ln p itself, rounded, moves the chance of none by np/(1-p)",
)
def nearly_certain_probabilities() -> float:
    largest = 0.0
    with mp.workdps(DIGITS_FOR_TINY_PROBABILITIES):
        for log_p, n in ((-1e-3, 1), (-1e-9, 1), (-1e-16, 1), (-0.5, 7), (-1e-3, 4), (-3.0, 600)):
            p = mp.exp(mp.mpf(log_p))
            probability_of_none = (1 - p) ** n
            computed_none = -mp.expm1(mp.mpf(float(log_at_least_one_probability(log_p, n))))
            largest = max(
                largest, float(abs(computed_none / probability_of_none - 1) / (2 + n * p / (1 - p)))
            )
    return largest


@FAMILY.case(
    "the union of 10,000 chances from 1e-300 to 1e-3, one after the other",
    reference="sum of ln(1-p), 60 digits",
    measure="chance",
    allowed=2e-15,
    limit=1e4**0.5 * EPS / 2,
    because="10,000 additions of one rounding each",
)
def union_of_probabilities() -> float:
    probabilities = 10 ** np.random.default_rng(5).uniform(-300, -3, 10_000)
    with mp.workdps(60):
        exact_value = -mp.expm1(mp.fsum(mp.log1p(-mp.mpf(float(p))) for p in probabilities))
        return relative_error(
            any_crossing_probability(probabilities, 0, probabilities.size), exact_value
        )
