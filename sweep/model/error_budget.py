"""Every knob of accuracy: what it does, its default, and what turning it costs.

The first six are a study's (``accuracy`` and ``draws.interval`` in a spec); the others divide the
tolerance among the sources of error, or limit the work. They are the same for every study.

    tolerance ─┬─ 0.80 or 0.55   effects that are left out (0.55 where beamlets are counted by it)
               ├─ 0.25           number of beamlets
               ├─ 1.0            few lines in place of many   } bounds with lines and bins at their
               └─ 0.5            leakage not looked for       } worst, so that they hardly add

Try ``tolerance`` first: everything else follows from it.

Below are intervals of a probability that draws estimate, as counts or as means of conditional
probabilities. The promise bounds the error of the estimate: :func:`interval_half_width` is the
distance from it to the farther end of its interval. Near 0 and 1, where intervals lie to one side
of the estimate, that is up to twice half their length.

Of counts: Wilson's score interval [J. Am. Stat. Assoc. 22, 209, 1927], right on the average over
probabilities, and Clopper and Pearson's [Biometrika 26, 404, 1934], at least right at every one.

Of a mean m of n values within 0..1 with the variance s^2 of their own, rare values that no draw has
shown may add any amount; s^2 = 0 after n equal values proves nothing. But a mean that lies d above
m by rare values between m and 1 has a variance that is larger too, by at most (1 - m) d. One that
lies d below, by values down to 0, by at most m d. The interval holds all means that such a variance
makes likely, as the score interval does:

    n d^2 = z^2 (s^2 + q d),    q = 1 - m above, m below,
    d = (q z^2 / 2 + sqrt(n s^2 z^2 + q^2 z^4 / 4)) / n.

With s^2 = 0 it is q z^2 / n (3.8 q / n for 95 %), as wide as what n draws can miss; with many
draws it is z s / sqrt(n). Values of only 0 and 1 make it the score interval, but for terms of
z^2 / n of its width.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import betaincinv, ndtri

AUTOMATIC = -1.0
"""Stands for an error that follows from the tolerance."""


@dataclass(frozen=True)
class ErrorBudget:
    """Accuracy with which points are computed; the first five are scalars or one a point."""

    tolerance: ArrayLike = 1e-3
    """Largest error of a probability of detection, of log10 of one of false alarm, or of a relative
    magnitude. If a point is drawn until it is known, the half-width of its interval. 0 leaves
    nothing out. A tenth of it rarely doubles the time of a point; where draws decide, it takes a
    hundred times as many."""

    confidence: ArrayLike = 0.95
    """Confidence of the intervals of what is drawn. Draws grow with the square of the normal
    quantile: 0.99 takes 1.7 times those of 0.95."""

    line_error: ArrayLike = AUTOMATIC
    """Error of a bin, in noise sigmas, by few lines in place of many beamlets. By default
    `lines_fraction` of the tolerance. A smaller one takes more lines a segment, slowly."""

    leakage_error: ArrayLike = AUTOMATIC
    """Probability of leakage, of all bins far from the lines, that is not looked for. By default
    `leakage_fraction` of the tolerance. A smaller one looks at more bins."""

    leakage_floor: ArrayLike = AUTOMATIC
    """Bins with less leaked signal than so many sigmas count as noise alone, where bins are looked
    at one by one. By default as `leakage_error` allows. A lower one looks at more bins."""

    interval: str = "clopper_pearson"
    """Interval of a counted share, one of :data:`COUNT_INTERVALS`. Clopper and
    Pearson's covers at least as often as it says; Wilson's takes fewer draws and covers about as
    often."""

    stopping_check_growth: float = 1.25
    """Draws at which half-widths are looked at, over those at the look before. Nearer 1 wastes
    fewer draws past the last look, and looks more often, which costs coverage."""

    effects_fraction: float = 0.8
    """Share of the tolerance for effects that are left out, number of beamlets included. More of it
    leaves more effects out, and nothing for the lines."""

    beamlets_fraction: float = 0.25
    """Share of the tolerance for the number of beamlets, where that is left to the tolerance; it is
    taken from that of effects. Half of it is one more step of `COUNTS` at most points."""

    lines_fraction: float = 1.0
    """Share of the tolerance for `line_error`: all, as its bounds have lines and bins at their
    worst."""

    leakage_fraction: float = 0.5
    """Share of the tolerance for `leakage_error`."""

    single_line_fraction: float = 0.1
    """Share of the beamlets' tolerance that one line of nodes may miss across the slope before
    several lines are tried. A smaller one tries them at more points, to the same end."""

    beamlets_max: int = 4096
    """Beamlets of a plane's footprint at the most. Points that need more are computed with those
    that err least, and their ``beamlets_error`` says by how much."""

    thesis_beamlet_count: int = 109
    """Beamlets of [T 3.3.1], taken where no number is enough: amplitudes that add over a smooth
    plane all but cancel."""

    min_rays_by_tolerance: tuple[tuple[float, int], ...] = ((1e-2, 19), (1e-5, 37), (0.0, 109))
    """Rays that every shot of a flight has, from a tolerance on. What none of them hits no estimate
    knows of: fewer miss small objects unseen."""

    ray_counts: tuple[int, ...] = (19, 37, 109, 439, 2029, 8017, 31987, 127999)
    """Rays that may be cast for a shot: whole shells of the lattice, as only these are alike on
    opposite sides, which makes smooth ground a hundred times more exact. The fewest are those whose
    error can be told from themselves; each costs some 80 ns."""

    rays_tolerance_min: float = 1e-6
    """Tighter tolerances call for no more rays than this one."""

    @classmethod
    def from_parameters(cls, parameters: Mapping[str, Any], **overrides: Any) -> "ErrorBudget":
        """Accuracy that parameters by dotted path ask for."""
        names = ("tolerance", "confidence", "line_error", "leakage_error", "leakage_floor")
        stated_values = {name: parameters[f"accuracy.{name}"] for name in names
                 if f"accuracy.{name}" in parameters}  # fmt: skip
        return cls(**stated_values, **overrides)

    def select(self, point_indices: np.ndarray, n_points: int) -> "ErrorBudget":
        """Tolerance and confidence of some of `n_points` points."""
        tolerance, confidence = (
            np.broadcast_to(values, (n_points,))[point_indices]
            for values in (self.tolerance, self.confidence)
        )
        return replace(self, tolerance=tolerance, confidence=confidence)

    @property
    def allowed_line_error(self) -> np.ndarray:
        """Error of a bin over sigma by few lines for many."""
        return self._stated_or_fraction(self.line_error, self.lines_fraction)

    @property
    def allowed_leakage(self) -> np.ndarray:
        """Probability of leakage that need not be looked for."""
        return self._stated_or_fraction(self.leakage_error, self.leakage_fraction)

    @property
    def allowed_beamlets_error(self) -> np.ndarray:
        """Error of pd by the number of beamlets."""
        return self.beamlets_fraction * np.asarray(self.tolerance, float)

    def allowed_effects_error(self, *, counts_beamlets: bool) -> np.ndarray:
        """Change of a probability by all effects that are left out."""
        beamlets_part = self.beamlets_fraction if counts_beamlets else 0.0
        return (self.effects_fraction - beamlets_part) * np.asarray(self.tolerance, float)

    @property
    def allowed_rays_error(self) -> float:
        """Error of pd by the number of rays of a flight's shot."""
        return max(float(np.asarray(self.tolerance)), self.rays_tolerance_min)

    @property
    def has_automatic_errors(self) -> np.ndarray:
        """True where errors of lines or leakage follow from the tolerance."""
        errors = (np.asarray(self.line_error), np.asarray(self.leakage_error))
        return np.logical_or(*(error == AUTOMATIC for error in errors))

    def _stated_or_fraction(self, stated: ArrayLike, fraction: float) -> np.ndarray:
        allowed = fraction * np.asarray(self.tolerance, float)
        return np.where(np.asarray(stated, float) == AUTOMATIC, allowed, stated)


class ConfidenceInterval(NamedTuple):
    """Ends, within 0..1, of the broadcast shape of what they are intervals of."""

    low: np.ndarray
    high: np.ndarray


def wilson_interval(
    *, successes: ArrayLike, trials: ArrayLike, confidence: ArrayLike
) -> ConfidenceInterval:
    """Score interval of the probability of a success, from counts; both sides together."""
    k, n = np.asarray(successes, float), np.asarray(trials, float)
    z = _normal_quantile(confidence)
    mean, squared_z = k / n, z * z
    centre = (k + squared_z / 2) / (n + squared_z)
    half_length = z * np.sqrt(k * (1 - mean) + squared_z / 4) / (n + squared_z)
    # At 0 and n the two terms cancel exactly only on paper.
    return _clip_interval(
        np.where(k > 0, centre - half_length, 0.0), np.where(k < n, centre + half_length, 1.0)
    )


def clopper_pearson_interval(
    *, successes: ArrayLike, trials: ArrayLike, confidence: ArrayLike
) -> ConfidenceInterval:
    """Interval beyond whose ends counts, or more extreme ones, have (1 - confidence) / 2 each."""
    k, n, c = np.broadcast_arrays(
        np.asarray(successes, float), np.asarray(trials, float), np.asarray(confidence, float)
    )
    tail_probability, failures = (1 - c) / 2, n - k
    low = np.where(k > 0, betaincinv(np.maximum(k, 1.0), failures + 1, tail_probability), 0.0)
    high = np.where(
        failures > 0, betaincinv(k + 1, np.maximum(failures, 1.0), 1 - tail_probability), 1.0
    )
    return _clip_interval(low, high)


COUNT_INTERVALS: dict[str, Callable[..., ConfidenceInterval]] = {
    "clopper_pearson": clopper_pearson_interval,
    "wilson": wilson_interval,
}
"""Intervals of counted shares."""


def bounded_mean_interval(
    *, mean: ArrayLike, variance: ArrayLike, n_values: ArrayLike, confidence: ArrayLike
) -> ConfidenceInterval:
    """Interval of the expectation of values within 0..1, from the mean of independent ones.

    The variance is that of a single value, unbiased; anything, where there is one value only.
    """
    m, n = np.asarray(mean, float), np.asarray(n_values, float)
    z = _normal_quantile(confidence)
    variance_term = z * z * n * np.where(n > 1, variance, 0.0)

    def half_length(distance_to_end: np.ndarray) -> np.ndarray:
        linear_term = distance_to_end * z * z / 2
        return (linear_term + np.sqrt(variance_term + linear_term * linear_term)) / n

    return _clip_interval(m - half_length(m), m + half_length(1 - m))


def interval_half_width(estimate: ArrayLike, interval: ConfidenceInterval) -> np.ndarray:
    """Distance from estimates to the farther end of their intervals."""
    estimate = np.asarray(estimate, float)
    return np.maximum(interval.high - estimate, estimate - interval.low)


def _normal_quantile(confidence: ArrayLike) -> np.ndarray:
    """Return the z for which a standard normal |Z| <= z with probability `confidence`."""
    return np.asarray(ndtri(0.5 + np.asarray(confidence, float) / 2))


def _clip_interval(low: np.ndarray, high: np.ndarray) -> ConfidenceInterval:
    return ConfidenceInterval(np.clip(low, 0.0, 1.0), np.clip(high, 0.0, 1.0))
