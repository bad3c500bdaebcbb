"""Every knob of accuracy: what it does, its default, and what turning it costs.

The first six are a study's (``accuracy`` and ``draws.interval`` in a spec); the others divide the
tolerance among the sources of error, or limit the work. They are the same for every study.

    tolerance ─┬─ 0.80 or 0.55   effects that are left out (0.55 where beamlets are counted by it)
               ├─ 0.25           number of beamlets
               ├─ 1.0            few lines in place of many   } bounds with lines and bins at their
               └─ 0.5            leakage not looked for       } worst, so that they hardly add

Try ``tolerance`` first: everything else follows from it.

Below are intervals of a probability that draws estimate, as counts or as means of conditional
probabilities. The promise bounds the error of the estimate: :func:`half_width` is the
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
class Accuracy:
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
    `lines_share` of the tolerance. A smaller one takes more lines a segment, slowly."""

    leakage_error: ArrayLike = AUTOMATIC
    """Probability of leakage, of all bins far from the lines, that is not looked for. By default
    `leakage_share` of the tolerance. A smaller one looks at more bins."""

    leakage_floor: ArrayLike = AUTOMATIC
    """Bins with less leaked signal than so many sigmas count as noise alone, where bins are looked
    at one by one. By default as `leakage_error` allows. A lower one looks at more bins."""

    interval: str = "clopper_pearson"
    """Interval of a counted share, one of :data:`COUNTED`. Clopper and
    Pearson's covers at least as often as it says; Wilson's takes fewer draws and covers about as
    often."""

    growth: float = 1.25
    """Draws at which half-widths are looked at, over those at the look before. Nearer 1 wastes
    fewer draws past the last look, and looks more often, which costs coverage."""

    effects_share: float = 0.8
    """Share of the tolerance for effects that are left out, number of beamlets included. More of it
    leaves more effects out, and nothing for the lines."""

    beamlets_share: float = 0.25
    """Share of the tolerance for the number of beamlets, where that is left to the tolerance; it is
    taken from that of effects. Half of it is one more step of `COUNTS` at most points."""

    lines_share: float = 1.0
    """Share of the tolerance for `line_error`: all, as its bounds have lines and bins at their
    worst."""

    leakage_share: float = 0.5
    """Share of the tolerance for `leakage_error`."""

    one_line_share: float = 0.1
    """Share of the beamlets' tolerance that one line of nodes may miss across the slope before
    several lines are tried. A smaller one tries them at more points, to the same end."""

    most_beamlets: int = 4096
    """Beamlets of a plane's footprint at the most. Points that need more are computed with those
    that err least, and their ``beamlets_error`` says by how much."""

    thesis_beamlets: int = 109
    """Beamlets of [T 3.3.1], taken where no number is enough: amplitudes that add over a smooth
    plane all but cancel."""

    fewest_rays: tuple[tuple[float, int], ...] = ((1e-2, 19), (1e-5, 37), (0.0, 109))
    """Rays that every shot of a flight has, from a tolerance on. What none of them hits no estimate
    knows of: fewer miss small objects unseen."""

    rays: tuple[int, ...] = (19, 37, 109, 439, 2029, 8017, 31987, 127999)
    """Rays that may be cast for a shot: whole shells of the lattice, as only these are alike on
    opposite sides, which makes smooth ground a hundred times more exact. The fewest are those whose
    error can be told from themselves; each costs some 80 ns."""

    least_rays_tolerance: float = 1e-6
    """Tighter tolerances call for no more rays than this one."""

    @classmethod
    def of(cls, parameters: Mapping[str, Any], **further: Any) -> "Accuracy":
        """Accuracy that parameters by dotted path ask for."""
        paths = ("tolerance", "confidence", "line_error", "leakage_error", "leakage_floor")
        asked = {name: parameters[f"accuracy.{name}"] for name in paths
                 if f"accuracy.{name}" in parameters}  # fmt: skip
        return cls(**asked, **further)

    def at(self, points: np.ndarray, size: int) -> "Accuracy":
        """Tolerance and confidence of some of `size` points."""
        tolerance, confidence = (
            np.broadcast_to(values, (size,))[points] for values in (self.tolerance, self.confidence)
        )
        return replace(self, tolerance=tolerance, confidence=confidence)

    @property
    def for_lines(self) -> np.ndarray:
        """Error of a bin over sigma by few lines for many."""
        return self._or_share(self.line_error, self.lines_share)

    @property
    def for_leakage(self) -> np.ndarray:
        """Probability of leakage that need not be looked for."""
        return self._or_share(self.leakage_error, self.leakage_share)

    @property
    def for_beamlets(self) -> np.ndarray:
        """Error of pd by the number of beamlets."""
        return self.beamlets_share * np.asarray(self.tolerance, float)

    def for_effects(self, *, counts_beamlets: bool) -> np.ndarray:
        """Change of a probability by all effects that are left out."""
        taken = self.beamlets_share if counts_beamlets else 0.0
        return (self.effects_share - taken) * np.asarray(self.tolerance, float)

    @property
    def for_rays(self) -> float:
        """Error of pd by the number of rays of a flight's shot."""
        return max(float(np.asarray(self.tolerance)), self.least_rays_tolerance)

    @property
    def follows_tolerance(self) -> np.ndarray:
        """True where errors of lines or leakage follow from the tolerance."""
        errors = (np.asarray(self.line_error), np.asarray(self.leakage_error))
        return np.logical_or(*(error == AUTOMATIC for error in errors))

    def _or_share(self, given: ArrayLike, share: float) -> np.ndarray:
        allowed = share * np.asarray(self.tolerance, float)
        return np.where(np.asarray(given, float) == AUTOMATIC, allowed, given)


class Interval(NamedTuple):
    """Ends, within 0..1, of the broadcast shape of what they are intervals of."""

    low: np.ndarray
    high: np.ndarray


def wilson(*, successes: ArrayLike, trials: ArrayLike, confidence: ArrayLike) -> Interval:
    """Score interval of the probability of a success, from counts; both sides together."""
    k, n = np.asarray(successes, float), np.asarray(trials, float)
    z = _deviations(confidence)
    mean, square = k / n, z * z
    centre = (k + square / 2) / (n + square)
    reach = z * np.sqrt(k * (1 - mean) + square / 4) / (n + square)
    # At 0 and n the two terms cancel exactly only on paper.
    return _within(np.where(k > 0, centre - reach, 0.0), np.where(k < n, centre + reach, 1.0))


def clopper_pearson(*, successes: ArrayLike, trials: ArrayLike, confidence: ArrayLike) -> Interval:
    """Interval beyond whose ends counts, or more extreme ones, have (1 - confidence) / 2 each."""
    k, n, c = np.broadcast_arrays(
        np.asarray(successes, float), np.asarray(trials, float), np.asarray(confidence, float)
    )
    below, missed = (1 - c) / 2, n - k
    low = np.where(k > 0, betaincinv(np.maximum(k, 1.0), missed + 1, below), 0.0)
    high = np.where(missed > 0, betaincinv(k + 1, np.maximum(missed, 1.0), 1 - below), 1.0)
    return _within(low, high)


COUNTED: dict[str, Callable[..., Interval]] = {
    "clopper_pearson": clopper_pearson,
    "wilson": wilson,
}
"""Intervals of counted shares."""


def bounded_mean(
    *, mean: ArrayLike, variance: ArrayLike, number: ArrayLike, confidence: ArrayLike
) -> Interval:
    """Interval of the expectation of values within 0..1, from the mean of independent ones.

    The variance is that of a single value, unbiased; anything, where there is one value only.
    """
    m, n = np.asarray(mean, float), np.asarray(number, float)
    z = _deviations(confidence)
    spread = z * z * n * np.where(n > 1, variance, 0.0)

    def reach(room: np.ndarray) -> np.ndarray:
        lean = room * z * z / 2
        return (lean + np.sqrt(spread + lean * lean)) / n

    return _within(m - reach(m), m + reach(1 - m))


def half_width(estimate: ArrayLike, interval: Interval) -> np.ndarray:
    """Distance from estimates to the farther end of their intervals."""
    estimate = np.asarray(estimate, float)
    return np.maximum(interval.high - estimate, estimate - interval.low)


def _deviations(confidence: ArrayLike) -> np.ndarray:
    """Return the z for which a standard normal |Z| <= z with probability `confidence`."""
    return np.asarray(ndtri(0.5 + np.asarray(confidence, float) / 2))


def _within(low: np.ndarray, high: np.ndarray) -> Interval:
    return Interval(np.clip(low, 0.0, 1.0), np.clip(high, 0.0, 1.0))
