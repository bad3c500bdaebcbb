"""Simulate coverage and bias of drawing until a tolerance is met.

Run with `make stopping`, two minutes on one core. Many points of each known pd are drawn until
their half-width is within the tolerance, by the package's rule (sweep.model.sampling.samplers) and
by a check after every batch. Writes the table in docs/draws.md.
"""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from benchmark_helpers import markdown_table, replace_page_part
from rich.progress import track

from sweep.model.detection.marcum import marcum_q1
from sweep.model.error_budget import (
    COUNT_INTERVAL_FUNCTIONS,
    ConfidenceInterval,
    ErrorBudget,
    bounded_mean_interval,
    interval_half_width,
)
from sweep.model.sampling.samplers import (
    NOISE_DRAWS_PER_STEP,
    draw_until_accurate,
    stopping_check_draws,
)

CONFIDENCE_LEVEL, BATCH_DRAWS, DRAWS_MAX = 0.95, 100, 10**7
TOLERANCES = (0.1, 0.03, 0.01)
THRESHOLD_OVER_NOISE = 6.5
"""Threshold over the noise sigma per quadrature of a bin, for a TNR of 10."""
N_TRIALS_BY_METHOD = {"counts": 40_000, "means": 4_000}
VALUES_AT_ONCE = 1 << 21
"""Number of values that are drawn at once."""

Sampler = Callable[[tuple[int, int]], np.ndarray]


def true_pd_values(tolerance: float) -> np.ndarray:
    """Return the true pd to simulate: 0, 1, near the tolerance on both sides, and between."""
    low_pd = np.array([1e-4, 1e-3, 0.3 * tolerance, tolerance, 1.3 * tolerance, 2 * tolerance])
    lower_half = np.unique(np.append(low_pd, [0.1, 0.3]).clip(1e-4, 0.4))
    return np.concatenate([[0.0], lower_half, [0.5], 1 - lower_half[::-1], [1.0]])


def bernoulli_sampler(pd: float, rng: np.random.Generator) -> Sampler:
    """Return a function that draws detections, 0 or 1, of mean pd."""
    return lambda shape: (rng.random(shape) < pd).astype(float)


def speckle_pd_sampler(pd: float, rng: np.random.Generator) -> Sampler:
    """Return a function that draws the pd of a Swerling-1 target given its amplitude.

    The mean of these pd is exp(-Th^2 / (2 (1 + SNR))), which equals `pd`.
    """
    if pd in (0.0, 1.0):
        return lambda shape: np.full(shape, pd)
    snr = THRESHOLD_OVER_NOISE**2 / (2 * np.log(1 / pd)) - 1
    amplitude = np.linspace(0.0, 20.0, 20_001)
    pd_by_amplitude = marcum_q1(amplitude, THRESHOLD_OVER_NOISE).q
    return lambda shape: np.interp(
        np.sqrt(2 * snr * rng.standard_exponential(shape)), amplitude, pd_by_amplitude
    )


def power_law_sampler(pd: float, rng: np.random.Generator) -> Sampler:
    """Return a function that draws powers of a uniform random number, of mean pd."""
    if pd in (0.0, 1.0):
        return lambda shape: np.full(shape, pd)
    if pd > 0.5:
        mirrored = power_law_sampler(1 - pd, rng)
        return lambda shape: 1 - mirrored(shape)
    return lambda shape: rng.random(shape) ** (1 / pd - 1)


class RepeatedPoint:
    """Trials of one point: number, mean and squared deviations of the values of each trial."""

    def __init__(self, number: int, values: Sampler, method: str) -> None:
        self._values, self._method = values, method
        self.n_draws = np.zeros(number, np.int64)
        self.mean, self.squared_deviations = np.zeros(number), np.zeros(number)

    def draws_per_step(self, n_points: int) -> int:
        """Return the number of draws of each trial that `draw` should add at once."""
        return NOISE_DRAWS_PER_STEP

    def draw(self, points: np.ndarray, n_more: int) -> None:
        """Add draws to trials; update their moments [Chan, Golub, LeVeque, Am. Stat. 37, 1983]."""
        for batch in np.array_split(points, -(-points.size * n_more // VALUES_AT_ONCE)):
            values = self._values((batch.size, n_more))
            mean, n_before = values.mean(axis=1), self.n_draws[batch]
            mean_difference = mean - self.mean[batch]
            self.squared_deviations[batch] += ((values - mean[:, None]) ** 2).sum(axis=1)
            self.squared_deviations[batch] += (
                mean_difference**2 * n_before * n_more / (n_before + n_more)
            )
            self.mean[batch] += mean_difference * n_more / (n_before + n_more)
            self.n_draws[batch] += n_more

    def half_widths(self, points: np.ndarray) -> np.ndarray:
        """Return the half-widths of the intervals of some trials."""
        mean, n = self.mean[points], self.n_draws[points]
        interval: ConfidenceInterval
        if self._method == "means":
            variance = self.squared_deviations[points] / np.maximum(n - 1, 1)
            interval = bounded_mean_interval(
                mean=mean, variance=variance, n_values=n, confidence=CONFIDENCE_LEVEL
            )
        else:
            successes = np.rint(mean * n)
            interval = COUNT_INTERVAL_FUNCTIONS[self._method](
                successes=successes, trials=n, confidence=CONFIDENCE_LEVEL
            )
        return interval_half_width(mean, interval)

    def pd_half_width_excess(self, points: np.ndarray, error_budget: ErrorBudget) -> np.ndarray:
        """Return by how much the half-widths of trials exceed the tolerance; 0 if they do not."""
        return np.maximum(self.half_widths(points) - error_budget.tolerance, 0.0)


class StoppingResult(NamedTuple):
    """Coverage, bias and mean number of draws of one true pd."""

    pd: float
    coverage: float
    bias: float
    draws: float


def simulate_stopping(
    pd: float, sampler: Sampler, method: str, tolerance: float, stopping_times: str
) -> StoppingResult:
    """Simulate trials of one true pd; return coverage, bias and mean number of draws."""
    n_trials = N_TRIALS_BY_METHOD["means" if method == "means" else "counts"]
    trials, points = RepeatedPoint(n_trials, sampler, method), np.arange(n_trials)
    check_numbers = (
        stopping_check_draws(BATCH_DRAWS, DRAWS_MAX)
        if stopping_times == "shipped"
        else range(BATCH_DRAWS, DRAWS_MAX, BATCH_DRAWS)
    )
    draw_until_accurate(trials, points, check_numbers, ErrorBudget(tolerance, CONFIDENCE_LEVEL))
    is_within = abs(trials.mean - pd) <= trials.half_widths(points)
    return StoppingResult(pd, is_within.mean(), trials.mean.mean() - pd, trials.n_draws.mean())


SAMPLER_KINDS = {
    "counts, Clopper-Pearson": (bernoulli_sampler, "clopper_pearson"),
    "counts, Wilson": (bernoulli_sampler, "wilson"),
    "means, of 0 and 1": (bernoulli_sampler, "means"),
    "means, speckle": (speckle_pd_sampler, "means"),
    "means, powers of a uniform number": (power_law_sampler, "means"),
}


def table_rows() -> Iterator[list[str]]:
    """Yield the rows of the table."""
    cases = [
        (k, t, e) for k in SAMPLER_KINDS for t in TOLERANCES for e in ("shipped", "every batch")
    ]
    for kind, tolerance, ends in track(cases, description="simulating"):
        make_sampler, method = SAMPLER_KINDS[kind]
        rng = np.random.default_rng(7)
        cells = [
            simulate_stopping(pd, make_sampler(float(pd), rng), method, tolerance, ends)
            for pd in true_pd_values(tolerance)
        ]
        least_covered = min(cells, key=lambda result: result.coverage)
        most_biased = max(cells, key=lambda result: abs(result.bias))
        yield [
            kind,
            f"{tolerance:g}",
            ends,
            f"{100 * least_covered.coverage:.1f} % at {least_covered.pd:.4g}",
            f"{most_biased.bias / tolerance:+.3f} at {most_biased.pd:.4g}",
            f"{max(result.draws for result in cells):,.0f}",
        ]


if __name__ == "__main__":
    head = ["drawn", "tolerance", "looks", "least coverage", "largest bias / tolerance", "draws"]
    replace_page_part("draws.md", "stopping", markdown_table(head, table_rows()))
