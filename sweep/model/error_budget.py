"""Settings of accuracy: what each does, its default, and the cost of changing it.

The first five are a study's (``accuracy`` and ``draws.interval`` in a spec). The others divide the
tolerance among the sources of error, or limit the work, alike in every study.

    tolerance ─┬─ 0.80 or 0.55   effects that are skipped (0.55 if it also sets the beamlets)
               ├─ 0.25           number of beamlets
               ├─ 1.0            few lines in place of many   } worst-case bounds, so that they
               └─ 0.5            leakage that is neglected    } hardly add to the total

Change ``tolerance`` first: everything else follows from it.

The rest of the module computes intervals of a probability that is estimated by draws, from counts
or from means of conditional probabilities. The tolerance bounds the error of the estimate:
:func:`interval_half_width` is its distance to the farther end of the interval. Near 0 and 1, where
intervals lie on one side of the estimate, it is up to twice half their length.

For counts there are two intervals. Wilson's score interval [1]_ has the stated coverage on average
over probabilities. The interval of Clopper and Pearson [2]_ has at least the stated coverage at
every probability.

For means of n values within 0..1 the interval is as follows. Let m be the mean and s^2 the sample
variance. Rare values that no draw has shown may change both, so that s^2 = 0 after n equal values
proves nothing. If the true mean lies d above m, because of rare values between m and 1, the true
variance exceeds s^2 by at most (1 - m) d. If it lies d below m, because of rare values down to 0,
it exceeds s^2 by at most m d. The interval holds all means that are likely with such a variance, as
the score interval does:

    n d^2 = z^2 (s^2 + q d),    q = 1 - m above, m below,
    d = (q z^2 / 2 + sqrt(n s^2 z^2 + q^2 z^4 / 4)) / n.

With s^2 = 0 the half-width is q z^2 / n (3.8 q / n for 95 %), as wide as what n draws can miss.
With many draws it is z s / sqrt(n). For values of only 0 and 1 it is the score interval, except for
terms of z^2 / n of its width.

If draws come in groups of g that are spread evenly (:mod:`sweep.model.sampling.draw_groups`), the
means of groups vary less than those of independent draws. Let S^2 be g times the sample variance of
the means of R groups, and t the quantile of Student's distribution with R - 1 degrees of freedom.
S^2 takes the place of s^2 only if groups help much, as the lesser of two estimates of one variance
would be too small on average. So draws in whole groups count with the variance

    T^2 = t^2 S^2 / z^2    if that is less than s^2 / 4, else s^2.

Of n draws, n - R g are in a group that is not yet whole; they count with s^2. Rare values raise the
mean at single cells of a group, where the value may be as low as 0. The variance is then higher by
up to d. Hence

    n d^2 = z^2 (T^2 R g / n + s^2 (1 - R g / n) + d).

This half-width is at least z^2 / n. With fewer than two groups that of independent draws is used.

References
----------
.. [1] Wilson, J. Am. Stat. Assoc. 22, 209, 1927.
.. [2] Clopper and Pearson, Biometrika 26, 404, 1934.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import betaincinv, ndtri, stdtrit

SET_BY_TOLERANCE = -1.0
"""Value of an error setting in :class:`ErrorBudget` which means that the error follows from the
tolerance."""


THESIS_BEAMLET_COUNT = 109
"""Number of beamlets of a beam in the thesis [T 3.3.1]."""


@dataclass(frozen=True)
class ErrorBudget:
    """Error tolerance of a study, and its division among the sources of error.

    The first five fields are scalars, or arrays with one value for each point.
    """

    tolerance: ArrayLike = 1e-3
    """Largest error of a probability of detection, of log10 of a probability of false alarm, or of
    a relative magnitude. For points with draws the error is the half-width of the confidence
    interval. With a tolerance of 0 nothing is skipped. A ten times smaller tolerance rarely doubles
    the time of a point; with draws it takes a hundred times as many draws."""

    confidence: ArrayLike = 0.95
    """Confidence level, 0..1, of intervals for probabilities that are estimated by random draws.
    The number of draws is proportional to the square of the normal quantile: 0.99 takes 1.7 times
    the draws of 0.95."""

    line_error: ArrayLike = SET_BY_TOLERANCE
    """Tolerated error of a bin's magnitude, relative to the noise sigma, when few spectral lines
    represent all beamlets. By default it is `line_error_fraction` times the tolerance. A smaller
    error slowly increases the number of lines of a segment."""

    leakage_error: ArrayLike = SET_BY_TOLERANCE
    """Tolerated probability of a false peak due to the echo's signal in bins that are far from its
    lines and not evaluated. By default it is `leakage_error_fraction` times the tolerance. With a
    smaller value more bins are evaluated."""

    leakage_floor: ArrayLike = SET_BY_TOLERANCE
    """Magnitude of leaked signal in a bin, relative to the noise sigma, below which the bin counts
    as noise alone. It applies to bins that are evaluated one by one. By default it follows from
    `leakage_error`. With a lower value more bins are evaluated."""

    count_interval_name: str = "clopper_pearson"
    """Name of the confidence interval for a probability that is estimated by counting draws, one of
    :data:`COUNT_INTERVAL_FUNCTIONS`. The interval of Clopper and Pearson has at least the stated
    coverage. Wilson's needs fewer draws, and has the stated coverage on average."""

    stopping_check_growth: float = 1.25
    """Factor by which the number of draws grows from one check of the confidence intervals to the
    next. A factor nearer 1 wastes fewer draws, but more frequent checks reduce the coverage of the
    intervals."""

    effects_fraction: float = 0.8
    """Fraction of the tolerance for two errors together: effects that are not simulated, and the
    number of beamlets. With a larger fraction more effects can be skipped."""

    beamlets_fraction: float = 0.25
    """Fraction of the tolerance for the number of beamlets, if this number follows from the
    tolerance. The fraction is part of `effects_fraction`. Half of it costs most points one more
    step of `NODE_COUNTS_ALONG_SLOPE`."""

    line_error_fraction: float = 1.0
    """Default of `line_error`, as a fraction of the tolerance. It is 1, because bounds on this
    error are worst cases over lines and bins."""

    leakage_error_fraction: float = 0.5
    """Default of `leakage_error`, as a fraction of the tolerance."""

    single_row_error_fraction: float = 0.1
    """Fraction of the beamlets' tolerance up to which one row of beamlets along the slope is
    accepted. The error compared with it is that across the slope. If this error is larger, several
    parallel rows are tried. The fraction does not affect the accuracy."""

    beamlets_max: int = 4096
    """Largest number of beamlets of a footprint on a plane. Points that would need more use the
    number of least error, and their output ``beamlets_error`` states the error."""

    thesis_beamlet_count: int = THESIS_BEAMLET_COUNT
    """Number of beamlets of the thesis. It is used if amplitudes add over a smooth plane: their sum
    almost cancels, so that no number of beamlets is enough for the tolerance."""

    min_rays_by_tolerance: tuple[tuple[float, int], ...] = ((1e-2, 19), (1e-5, 37), (0.0, 109))
    """Pairs (tolerance, smallest number of rays per shot of a flight). A pair applies to tolerances
    at or above its own and below that of the previous pair; the first pair has no upper limit.
    Estimates of the error cannot include objects that no ray hits, and fewer rays miss more small
    objects."""

    ray_counts: tuple[int, ...] = (19, 37, 109, 439, 2029, 8017, 31987, 127999)
    """Possible numbers of rays per shot. They fill whole shells of the lattice, whose symmetry
    makes results on smooth ground a hundred times more exact. The first number is the smallest from
    which an error can be estimated. Each ray costs some 80 ns."""

    rays_tolerance_min: float = 1e-6
    """Smallest tolerance that affects the number of rays per shot. A lower tolerance has the same
    number."""

    @classmethod
    def from_parameters(cls, parameters: Mapping[str, Any], **overrides: Any) -> "ErrorBudget":
        """Return the budget from parameters by dotted path; those under ``accuracy.`` are used.

        `overrides` are values of fields that ``accuracy.`` does not state, by field name.
        """
        names = ("tolerance", "confidence", "line_error", "leakage_error", "leakage_floor")
        stated_values = {name: parameters[f"accuracy.{name}"] for name in names
                 if f"accuracy.{name}" in parameters}  # fmt: skip
        return cls(**stated_values, **overrides)

    def select_points(self, point_indices: np.ndarray, n_points: int) -> "ErrorBudget":
        """Return the budget of selected points.

        Parameters
        ----------
        point_indices : ndarray (m,) int64
            Indices of the selected points.
        n_points : int
            Number of points from which they are selected.

        Returns
        -------
        ErrorBudget
            Budget whose tolerance and confidence are arrays (m,). All other fields are unchanged,
            even if they have one value for each point.
        """
        tolerance, confidence = (
            np.broadcast_to(values, (n_points,))[point_indices]
            for values in (self.tolerance, self.confidence)
        )
        return replace(self, tolerance=tolerance, confidence=confidence)

    @property
    def allowed_line_error(self) -> np.ndarray:
        """Tolerated error of a bin's magnitude, relative to the noise sigma, due to few lines.

        A few spectral lines are computed in place of the lines of all beamlets.
        """
        return self._stated_or_default_error(self.line_error, self.line_error_fraction)

    @property
    def allowed_leakage_error(self) -> np.ndarray:
        """Tolerated probability of a false peak due to leaked signal that is not evaluated."""
        return self._stated_or_default_error(self.leakage_error, self.leakage_error_fraction)

    @property
    def allowed_beamlets_error(self) -> np.ndarray:
        """Tolerated error of the detection probability due to the finite number of beamlets."""
        return self.beamlets_fraction * np.asarray(self.tolerance, float)

    def allowed_effects_error(self, *, counts_beamlets: bool) -> np.ndarray:
        """Return the tolerated error of a probability due to all effects that are not simulated.

        `counts_beamlets` is True if the number of beamlets follows from the tolerance. The part of
        the tolerance for the number of beamlets is then subtracted.
        """
        beamlets_part = self.beamlets_fraction if counts_beamlets else 0.0
        return (self.effects_fraction - beamlets_part) * np.asarray(self.tolerance, float)

    @property
    def allowed_rays_error(self) -> float:
        """Tolerated error of the detection probability due to the number of rays per shot."""
        return max(float(np.asarray(self.tolerance)), self.rays_tolerance_min)

    @property
    def has_errors_set_by_tolerance(self) -> np.ndarray:
        """True where the tolerance determines the error of lines or leakage, (n,) or a scalar."""
        errors = (np.asarray(self.line_error), np.asarray(self.leakage_error))
        return np.logical_or(*(error == SET_BY_TOLERANCE for error in errors))

    def _stated_or_default_error(self, stated: ArrayLike, fraction: float) -> np.ndarray:
        """Return `stated`; where that is `SET_BY_TOLERANCE`, `fraction` times the tolerance."""
        allowed = fraction * np.asarray(self.tolerance, float)
        return np.where(np.asarray(stated, float) == SET_BY_TOLERANCE, allowed, stated)


class ConfidenceInterval(NamedTuple):
    """Lower and upper ends of probabilities' confidence intervals, shaped like the estimates."""

    low: np.ndarray
    """Lower end of each confidence interval, 0..1."""
    high: np.ndarray
    """Upper end of each confidence interval, 0..1."""


def wilson_interval(
    *, successes: ArrayLike, trials: ArrayLike, confidence: ArrayLike
) -> ConfidenceInterval:
    """Return Wilson's score interval for the probability of a success, from counts [1]_.

    Parameters
    ----------
    successes, trials : array_like
        Numbers of successes and of trials.
    confidence : array_like
        Confidence, two-sided, 0..1.

    References
    ----------
    .. [1] Wilson, J. Am. Stat. Assoc. 22, 209, 1927.
    """
    k, n = np.asarray(successes, float), np.asarray(trials, float)
    z = two_sided_normal_quantile(confidence)
    mean, squared_z = k / n, z * z
    centre = (k + squared_z / 2) / (n + squared_z)
    half_length = z * np.sqrt(k * (1 - mean) + squared_z / 4) / (n + squared_z)
    # At 0 and n the two terms cancel exactly, but not in floating point.
    return _clip_interval(
        np.where(k > 0, centre - half_length, 0.0), np.where(k < n, centre + half_length, 1.0)
    )


def clopper_pearson_interval(
    *, successes: ArrayLike, trials: ArrayLike, confidence: ArrayLike
) -> ConfidenceInterval:
    """Return Clopper and Pearson's interval for the probability of a success, from counts [1]_.

    Parameters
    ----------
    successes, trials : array_like
        Numbers of successes and of trials.
    confidence : array_like
        Confidence, two-sided, 0..1.

    Notes
    -----
    Each end is the probability at which the observed count, or one farther from the expected count,
    has the probability (1 - confidence) / 2.

    References
    ----------
    .. [1] Clopper and Pearson, Biometrika 26, 404, 1934.
    """
    k, n, c = np.broadcast_arrays(
        np.asarray(successes, float), np.asarray(trials, float), np.asarray(confidence, float)
    )
    tail_probability, failures = (1 - c) / 2, n - k
    low = np.where(k > 0, betaincinv(np.maximum(k, 1.0), failures + 1, tail_probability), 0.0)
    high = np.where(
        failures > 0, betaincinv(k + 1, np.maximum(failures, 1.0), 1 - tail_probability), 1.0
    )
    return _clip_interval(low, high)


COUNT_INTERVAL_FUNCTIONS: dict[str, Callable[..., ConfidenceInterval]] = {
    "clopper_pearson": clopper_pearson_interval,
    "wilson": wilson_interval,
}
"""Functions that compute a probability's confidence interval from counts of successes and trials,
by the interval's name."""


def bounded_mean_interval(
    *, mean: ArrayLike, variance: ArrayLike, n_values: ArrayLike, confidence: ArrayLike
) -> ConfidenceInterval:
    """Return a confidence interval for the expectation of values within 0..1, from their mean.

    Parameters
    ----------
    mean : array_like
        Mean of independent values.
    variance : array_like
        Unbiased estimate of the variance of a single value; ignored if there is only one value.
    n_values : array_like
        Number of values.
    confidence : array_like
        Confidence, two-sided, 0..1.

    Notes
    -----
    The module's description derives the interval.
    """
    m, n = np.asarray(mean, float), np.asarray(n_values, float)
    z = two_sided_normal_quantile(confidence)
    variance_term = z * z * n * np.where(n > 1, variance, 0.0)

    def half_length(distance_to_end: np.ndarray) -> np.ndarray:
        """Return the distance from the mean to one end of the confidence interval.

        `distance_to_end` is the distance from the mean to 0 or 1 on the same side (q in the
        module's equation).
        """
        linear_term = distance_to_end * z * z / 2
        return (linear_term + np.sqrt(variance_term + linear_term * linear_term)) / n

    return _clip_interval(m - half_length(m), m + half_length(1 - m))


def grouped_mean_half_width(
    *,
    variance: ArrayLike,
    n_values: ArrayLike,
    group_variance: ArrayLike,
    n_groups: ArrayLike,
    group_size: int,
    confidence: ArrayLike,
) -> np.ndarray:
    """Return the half-width of a confidence interval for a mean of values drawn in spread groups.

    Values within a group are spread evenly, so that means of groups vary less than those of
    independent values.

    Parameters
    ----------
    variance : array_like
        Unbiased variance of a single value within 0..1.
    n_values : array_like
        Number of all values, in complete groups and in the last, incomplete one.
    group_variance : array_like
        Unbiased estimate of the variance of a complete group's mean; ignored with fewer than two
        groups.
    n_groups : array_like
        Number of complete groups.
    group_size : int
        Number of values in a complete group.
    confidence : array_like
        Confidence, two-sided, 0..1.

    Notes
    -----
    The module's description derives the half-width.
    """
    n = np.asarray(n_values, float)
    z = two_sided_normal_quantile(confidence)
    own_variance = np.where(n > 1, variance, 0.0)
    grouped_variance = variance_of_grouped_draws(
        variance=own_variance,
        group_variance=group_variance,
        n_groups=n_groups,
        group_size=group_size,
        confidence=confidence,
    )
    n_grouped = np.asarray(n_groups, float) * group_size
    variance_sum = n_grouped * grouped_variance + (n - n_grouped) * own_variance
    return np.asarray((z * z / 2 + np.sqrt(z * z * variance_sum + z**4 / 4)) / n)


GROUPED_VARIANCE_RATIO_MAX = 0.25
"""Largest ratio of two estimates of the variance per draw at which the first is used: the one from
means of groups of draws, over that of independent draws. With a limit nearer 1, the lesser of both
estimates would be too small on average."""


def variance_of_grouped_draws(
    *,
    variance: ArrayLike,
    group_variance: ArrayLike,
    n_groups: ArrayLike,
    group_size: int,
    confidence: ArrayLike,
) -> np.ndarray:
    """Return the variance T^2 with which a draw in a complete group contributes to the total mean.

    Draws within a group are spread evenly, so that means of groups vary less than those of
    independent draws.

    Parameters
    ----------
    variance : array_like
        Unbiased variance s^2 of a single value.
    group_variance : array_like
        Unbiased estimate V of the variance of a complete group's mean; nan if it is not known.
    n_groups : array_like
        Number R of complete groups.
    group_size : int
        Number g of values in a complete group.
    confidence : array_like
        Confidence, two-sided, 0..1.

    Returns
    -------
    ndarray
        T^2 = t^2 g V / z^2, if that is less than
        :data:`GROUPED_VARIANCE_RATIO_MAX` times s^2, else s^2. t and z are the two-sided quantiles
        of Student's distribution with R - 1 degrees of freedom and of the normal distribution.
    """
    groups = np.asarray(n_groups, float)
    z = two_sided_normal_quantile(confidence)
    t = stdtrit(np.maximum(groups - 1, 1), 0.5 + np.asarray(confidence, float) / 2)
    of_groups = np.square(t / z) * group_size * np.asarray(group_variance, float)
    # A group variance that is not known is nan, and not less.
    groups_help = (groups > 1) & (of_groups < GROUPED_VARIANCE_RATIO_MAX * np.asarray(variance))
    return np.where(groups_help, of_groups, variance)


def interval_half_width(estimate: ArrayLike, interval: ConfidenceInterval) -> np.ndarray:
    """Return the distance from each estimate to the farther end of its confidence interval.

    Parameters
    ----------
    estimate : array_like
        Estimated probabilities, 0..1.
    interval : ConfidenceInterval
        Confidence intervals of the estimates.
    """
    estimate = np.asarray(estimate, float)
    return np.maximum(interval.high - estimate, estimate - interval.low)


def two_sided_normal_quantile(confidence: ArrayLike) -> np.ndarray:
    """Return z, such that a standard normal variable lies within -z..z with a given probability.

    ``confidence`` is this probability, 0..1.
    """
    return np.asarray(ndtri(0.5 + np.asarray(confidence, float) / 2))


def _clip_interval(low: np.ndarray, high: np.ndarray) -> ConfidenceInterval:
    """Return a confidence interval with the ends `low` and `high`, each clipped to 0..1."""
    return ConfidenceInterval(np.clip(low, 0.0, 1.0), np.clip(high, 0.0, 1.0))
