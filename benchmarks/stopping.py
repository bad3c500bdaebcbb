"""Coverage and bias of drawing until a tolerance is met, by simulation.

Run with `make stopping`, two minutes on one core: points of known pd, many of each, are drawn
until their half-width is within the tolerance, by the shipped rule (sweep.model.sampling) and by
looking after every batch. Writes the table in docs/draws.md.
"""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from rich.progress import track
from shared import put, table

from sweep.model.accuracy import COUNTED, Accuracy, Interval, bounded_mean, half_width
from sweep.model.marcum import marcum_q1
from sweep.model.sampling import PIECE, looks, settle

CONFIDENCE, BATCH, LIMIT = 0.95, 100, 10**7
TOLERANCES = (0.1, 0.03, 0.01)
THRESHOLD = 6.5
"""Threshold over the noise of a bin: a TNR of 10."""
TRIALS = {"counts": 40_000, "means": 4_000}
VALUES = 1 << 21
"""Values that are drawn at once."""

Sampler = Callable[[tuple[int, int]], np.ndarray]


def chances(tolerance: float) -> np.ndarray:
    """True pd: where nothing and all is seen, where a miss begins to count, and between."""
    low = np.array([1e-4, 1e-3, 0.3 * tolerance, tolerance, 1.3 * tolerance, 2 * tolerance])
    half = np.unique(np.append(low, [0.1, 0.3]).clip(1e-4, 0.4))
    return np.concatenate([[0.0], half, [0.5], 1 - half[::-1], [1.0]])


def coins(pd: float, random: np.random.Generator) -> Sampler:
    """Detections."""
    return lambda shape: (random.random(shape) < pd).astype(float)


def speckled(pd: float, random: np.random.Generator) -> Sampler:
    """Conditional pd of a Swerling-1 target, whose mean is exp(-Th^2 / 2 (1 + SNR))."""
    if pd in (0.0, 1.0):
        return lambda shape: np.full(shape, pd)
    snr = THRESHOLD**2 / (2 * np.log(1 / pd)) - 1
    amplitude = np.linspace(0.0, 20.0, 20_001)
    table = marcum_q1(amplitude, THRESHOLD).q
    return lambda shape: np.interp(
        np.sqrt(2 * snr * random.standard_exponential(shape)), amplitude, table
    )


def skewed(pd: float, random: np.random.Generator) -> Sampler:
    """Powers of a uniform number: fades, or flashes, of any depth."""
    if pd in (0.0, 1.0):
        return lambda shape: np.full(shape, pd)
    if pd > 0.5:
        mirrored = skewed(1 - pd, random)
        return lambda shape: 1 - mirrored(shape)
    return lambda shape: random.random(shape) ** (1 / pd - 1)


class Trials:
    """The same point many times: its values summed, as a sample keeps them."""

    def __init__(self, number: int, values: Sampler, method: str) -> None:
        self._values, self._method = values, method
        self.number = np.zeros(number, np.int64)
        self.mean, self.spread = np.zeros(number), np.zeros(number)

    def at_once(self, points: int) -> int:
        """Draws of each of so many points that one `take` is for."""
        return PIECE

    def take(self, points: np.ndarray, more: int) -> None:
        """Draw on, a stretch of points at a time [Chan, Golub, LeVeque, Am. Stat. 37, 1983]."""
        for some in np.array_split(points, -(-points.size * more // VALUES)):
            values = self._values((some.size, more))
            mean, had = values.mean(axis=1), self.number[some]
            apart = mean - self.mean[some]
            self.spread[some] += ((values - mean[:, None]) ** 2).sum(axis=1)
            self.spread[some] += apart**2 * had * more / (had + more)
            self.mean[some] += apart * more / (had + more)
            self.number[some] += more

    def half_widths(self, points: np.ndarray) -> np.ndarray:
        """Half-widths of some of the points."""
        mean, n = self.mean[points], self.number[points]
        interval: Interval
        if self._method == "means":
            variance = self.spread[points] / np.maximum(n - 1, 1)
            interval = bounded_mean(mean=mean, variance=variance, number=n, confidence=CONFIDENCE)
        else:
            successes = np.rint(mean * n)
            interval = COUNTED[self._method](successes=successes, trials=n, confidence=CONFIDENCE)
        return half_width(mean, interval)

    def missed(self, points: np.ndarray, accuracy: Accuracy) -> np.ndarray:
        """By how much the tolerance is missed."""
        return np.maximum(self.half_widths(points) - accuracy.tolerance, 0.0)


class Cell(NamedTuple):
    """Result of one pd."""

    pd: float
    coverage: float
    bias: float
    draws: float


def measured(pd: float, sampler: Sampler, method: str, tolerance: float, ends: str) -> Cell:
    """Coverage, bias and mean number of draws of one pd."""
    number = TRIALS["means" if method == "means" else "counts"]
    trials, points = Trials(number, sampler, method), np.arange(number)
    rounds = looks(BATCH, LIMIT) if ends == "shipped" else range(BATCH, LIMIT, BATCH)
    settle(trials, points, rounds, Accuracy(tolerance, CONFIDENCE))
    within = abs(trials.mean - pd) <= trials.half_widths(points)
    return Cell(pd, within.mean(), trials.mean.mean() - pd, trials.number.mean())


KINDS = {
    "counts, Clopper-Pearson": (coins, "clopper_pearson"),
    "counts, Wilson": (coins, "wilson"),
    "means, of 0 and 1": (coins, "means"),
    "means, speckle": (speckled, "means"),
    "means, powers of a uniform number": (skewed, "means"),
}


def rows() -> Iterator[list[str]]:
    """Rows of the table."""
    cases = [(k, t, e) for k in KINDS for t in TOLERANCES for e in ("shipped", "every batch")]
    for kind, tolerance, ends in track(cases, description="simulating"):
        build, method = KINDS[kind]
        random = np.random.default_rng(7)
        cells = [
            measured(pd, build(float(pd), random), method, tolerance, ends)
            for pd in chances(tolerance)
        ]
        worst = min(cells, key=lambda c: c.coverage)
        biased = max(cells, key=lambda c: abs(c.bias))
        yield [
            kind, f"{tolerance:g}", ends, f"{100 * worst.coverage:.1f} % at {worst.pd:.4g}",
            f"{biased.bias / tolerance:+.3f} at {biased.pd:.4g}",
            f"{max(c.draws for c in cells):,.0f}",
        ]  # fmt: skip


if __name__ == "__main__":
    head = ["drawn", "tolerance", "looks", "least coverage", "largest bias / tolerance", "draws"]
    put("draws.md", "stopping", table(head, rows()))
