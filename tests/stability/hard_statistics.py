"""Means, variances and tallies of few, equal, nearly equal and vanishing numbers."""

import math
from collections.abc import Callable, Sequence
from fractions import Fraction
from typing import Any

import mpmath as mp
import numpy as np
from hard_cases import EPS, Family
from table_4_1_shots import table_4_1_parameters

from sweep.analysis.scene_results.navigation_errors import ErrorTally, merge_tallies
from sweep.model.effects.catalogue import DEFAULT_EFFECTS
from sweep.model.outputs import GRID_OUTPUTS
from sweep.model.sampling.realisations import RunningMeans
from sweep.model.sampling.samplers import simulate_draws

FAMILY = Family(
    "Statistics",
    "Running means and sums of squared deviations, draw by draw [Welford]. A variance of n numbers "
    "whose mean is kappa times their deviation is known to kappa eps at the best from a mean that "
    "is a float. Deviations are squared: where they are below 1e-154 their standard error is 0. "
    "Tallies are merged as sums of parts.",
)
SAMPLE_SETS = {
    "one": [0.3],
    "two": [0.25, 0.75],
    "never": [0.0] * 1000,
    "always": [1.0] * 1000,
    "once": [0.0] * 999 + [1.0],
    "spread": list(np.random.default_rng(1).uniform(size=1000)),
    "tiny": list(1e-140 * np.random.default_rng(2).uniform(size=1000)),
    "huge": list(1e150 * np.random.default_rng(3).normal(size=1000)),
}


def means_in_pieces(values: Sequence[float], pieces: int = 7) -> dict[str, float]:
    """Results of :class:`RunningMeans` for draws of every output, added in pieces."""
    means = RunningMeans(1)
    for piece in np.array_split(np.asarray(values, float), pieces):
        outputs = dict.fromkeys(GRID_OUTPUTS, piece)
        means.add(np.zeros(piece.size, np.int64), outputs)
    return {name: float(value[0]) for name, value in means.results().items()}


def exact_mean_and_variance(values: Sequence[float]) -> tuple[Fraction, Fraction]:
    """Mean and squared standard error of it, in fractions."""
    exact = [Fraction(float(x)) for x in values]
    mean = sum(exact) / len(exact)
    squared_standard_error = sum((x - mean) ** 2 for x in exact)
    return mean, squared_standard_error / (len(exact) * max(len(exact) - 1, 1))


def moment_errors(values: Sequence[float]) -> tuple[float, float]:
    """Relative error of the mean, over the mean magnitude, and of the standard error."""
    computed, (mean, squared_standard_error) = (
        means_in_pieces(values),
        exact_mean_and_variance(values),
    )
    mean_magnitude = float(sum(map(abs, map(Fraction, map(float, values)))) / len(values)) or 1.0
    mean_error = abs(float(Fraction(computed["pd_up"]) - mean)) / mean_magnitude
    with mp.workdps(40):
        exact_standard_error = mp.sqrt(
            mp.mpf(squared_standard_error.numerator) / squared_standard_error.denominator
        )
        if len(values) == 1:
            return mean_error, 0.0 if math.isnan(computed["pd_up_error"]) else math.inf
        if not exact_standard_error:
            return mean_error, abs(computed["pd_up_error"])
        return mean_error, float(abs(computed["pd_up_error"] / exact_standard_error - 1))


@FAMILY.case(
    "one draw, two, no success, all successes, one in a thousand, 1e-140, 1e150",
    reference="fractions",
    measure="mean, and its standard error (of one draw: nan)",
    allowed=2e-14,
    limit=1000**0.5 * EPS,
    because="a thousand steps, rounded",
)
def means_of_sample_sets() -> float:
    return max(max(moment_errors(values)) for values in SAMPLE_SETS.values())


def nearly_equal_numbers(kappa: float, number: int = 1000) -> list[float]:
    """Numbers about 1 with a deviation of 1 / kappa."""
    return list(1.0 + np.random.default_rng(4).normal(size=number) / kappa)


@FAMILY.case(
    "variances of numbers equal to 3, 8, 12 and 14 digits",
    reference="fractions",
    measure="standard error, over kappa eps + 1000 eps",
    allowed=1.0,
    limit=1.0,
    because="the mean, rounded, against the deviation",
)
def variances_of_nearly_equal() -> float:
    return max(
        moment_errors(nearly_equal_numbers(10.0**digits))[1] / ((10.0**digits + 1000) * EPS)
        for digits in (3, 8, 12, 14)
    )


@FAMILY.case(
    "a million equal numbers, of 1/3, 0.1 and 1e-300",
    reference="the number, and no deviation",
    measure="mean; standard error in units of the number",
    allowed=0.0,
    limit=0.0,
    because="nothing is rounded",
    is_slow=True,
)
def equal_numbers() -> float:
    worst = 0.0
    for value in (1 / 3, 0.1, 1e-300):
        computed = means_in_pieces(np.full(10**6, value), 3)
        worst = max(worst, abs(computed["pd_up"] / value - 1), computed["pd_up_error"] / value)
    return worst


@FAMILY.case(
    "probabilities of 1 to 1000 steps of 5e-324",
    reference="fractions",
    measure="mean, in steps of 5e-324",
    allowed=10.0,
    limit=5.0,
    because="a hundred means, each rounded to whole steps, half of one by chance",
)
def denormal_means() -> float:
    step = 5e-324
    values = step * np.random.default_rng(5).integers(1, 1000, 100)
    computed, (mean, _) = means_in_pieces(values), exact_mean_and_variance(values)
    return float(abs(Fraction(computed["pd_up"]) - mean) / Fraction(step))


LOG_SETS = {
    "far below": [-1e5, -1e5 + 1, -2e5],
    "wide": [-3000.0, -0.1, -400.0, -20.0],
    "none": [-math.inf] * 5,
    "some": [-math.inf, -310.5, -math.inf, -310.25, -np.inf],
    "equal": [-10.0 / 3] * 1000,
    "many": list(-np.random.default_rng(6).uniform(0, 700, 1000)),
}


@FAMILY.case(
    "log10 of means of chances from 1 to 1e-200000, some of them 0",
    reference="sum of powers, 60 digits",
    measure="logarithm (as a chance where it is near 0)",
    allowed=1e-14,
    limit=1000**0.5 * EPS,
    because="a thousand additions, rounded",
)
def means_of_logarithms() -> float:
    worst = 0.0
    with mp.workdps(60):
        for values in LOG_SETS.values():
            computed = means_in_pieces(values)["log10_pfa_bin"]
            powers = [mp.mpf(10) ** mp.mpf(float(x)) for x in values if x > -math.inf]
            if not powers:
                worst = max(worst, 0.0 if computed == -math.inf else math.inf)
                continue
            exact = mp.log10(mp.fsum(powers) / len(values))
            worst = max(worst, float(abs(computed - exact) / max(1, abs(exact))))
    return worst


def simulated_counts(method: str, number: int, **changes: Any) -> dict[str, np.ndarray]:
    """Detections and false alarms of so many draws."""
    return simulate_draws(
        table_4_1_parameters(fft_size=1024, **changes),
        DEFAULT_EFFECTS,
        keys=np.array([[7, 11]], np.uint64),
        batch_sizes=[number],
        method=method,
    )


@FAMILY.case(
    "one draw and a thousand, of which all succeed, or none does",
    reference="the number of draws; none",
    measure="draws counted wrongly",
    allowed=0.0,
    limit=0.0,
    because="counts are whole",
)
def all_or_none() -> float:
    wrong = 0
    for method in ("probabilities", "noise"):
        for number in (1, 1000):
            bright = simulated_counts(method, number, power=1e3, range=100.0, tnr=20.0)
            dark = simulated_counts(method, number, reflectance=0.0, tnr=40.0)
            wrong += int(number - bright["n_detected_shot"].sum() + dark["n_detected_shot"].sum())
            wrong += int(sum(x["n_false_alarm_both_chirps"].sum() for x in (bright, dark)))
    return float(wrong)


def merged_tally(errors: np.ndarray) -> ErrorTally:
    """Tally of errors (n, m), one by one."""
    return merge_tallies([tally_of_one_error(error_vector) for error_vector in errors])


def tally_of_one_error(error: np.ndarray) -> ErrorTally:
    count_one, zeros = np.array(1), np.zeros(error.size)
    return ErrorTally(count_one, count_one, error, zeros, zeros)


@FAMILY.case(
    "tallies of single errors about a bias 1e6 times their deviation, merged one by one",
    reference="fractions",
    measure="variance, over kappa eps + 1000 eps",
    allowed=1.0,
    limit=1.0,
    because="the mean, rounded, against the deviation",
)
def merged_tallies() -> float:
    worst = 0.0
    for kappa in (1.0, 1e3, 1e6):
        errors = 1.0 + np.random.default_rng(8).normal(size=(500, 2)) / kappa
        computed_variance = merged_tally(errors).variance
        exact = [[Fraction(float(x)) for x in column] for column in errors.T]
        mean = [sum(column) / 500 for column in exact]
        for i in range(2):
            square = sum((x - mean[i]) ** 2 for x in exact[i]) / 499
            relative_difference = abs(float(Fraction(float(computed_variance[i])) / square - 1))
            worst = max(worst, relative_difference / ((kappa + 1000) * EPS))
    return worst


@FAMILY.case(
    "tallies without a solution, with one, and of both",
    reference="nan, the error itself, no variance",
    measure="what differs",
    allowed=0.0,
    limit=0.0,
    because="nothing is rounded",
)
def empty_tallies() -> float:
    zero = np.zeros(2)
    empty = ErrorTally(np.array(3), np.array(0), zero, zero, zero)
    single = tally_of_one_error(np.array([0.1, -3.0]))
    merged = empty + single
    is_equal: Callable[..., bool] = np.array_equal
    return float(
        (not np.isnan(empty.bias).all())
        + (not np.isnan(single.variance).all())
        + (not is_equal(merged.bias, single.bias))
        + (float(merged.availability) != 0.25)
        + (not is_equal(single.rmse, np.abs(single.bias)))
    )
