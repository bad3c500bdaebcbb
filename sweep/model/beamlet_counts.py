"""Number of a footprint's beamlets, derived from the accuracy.

``footprint.beamlets`` 0 leaves the number to ``accuracy.tolerance``. If powers add, the number is
such that the relative error of the largest bin's magnitude r changes pd by at most a quarter of the
tolerance. With a = r over sigma, and b the threshold over sigma,

    |d Q_1(a, b) / d ln a| <= sqrt(a b / (2 pi)),   a (a - b) = 1/2 at its largest,

in each of three segments. Most of the rest of the tolerance is for skipped effects
(:mod:`.effects.planning`). If amplitudes add over a smooth plane, no number is enough, as the sum
almost cancels. The number of [T], 109, is then used.

In a flight each beamlet is a ray, and nothing is known of the ground before rays are cast. A few
rays are cast (:func:`initial_ray_count`), and their error is estimated from what they hit
(:mod:`sweep.model.pointcloud.ray_error`). Shots whose error is too large are cast again with more
rays (:func:`next_ray_counts`).

If beamlets add as powers, the mean power of a bin is that of |W(k - f)|^2 over the beam, where f is
nearly proportional to one coordinate along the slope. The function |W|^2 is band-limited. Let r be
the window's autocorrelation over lags of -1..1 records, normalised to sum 1, and s the standard
deviation of f in bins of fs/L. A rule of nodes x_j and weights w_j errs by at most

    integral |r(tau)| |sum_j w_j cos(2 pi s tau x_j) - exp(-(2 pi s tau)^2 / 2)| dtau

in units of the power of one line on a bin. The error is thus that of the rule for cosines up to 2
pi s. Gauss-Hermite quadrature is best for narrow spreads. Evenly spaced nodes are best for wide
spreads, as they are almost exact up to the frequency where they alias.

To second order the range rises with the square of the distance from the axis, across the slope as
along it. So f = s y + c (x^2 + y^2), where E exp(i t c x^2) = 1 / sqrt(1 - 2 i t c). A row of
nodes at x = 1 has the mean of x^2, and errs by (t c)^2 at most. More rows lie at the positive
nodes of a rule of twice as many:

    x ^      .  .  .  .  .      3 rows of 5 nodes, weighted by the Gaussians of x and y;
      |      .  .  .  .  .      as f is even in x, their mirror images are not needed
      |      .  .  .  .  .
      +-----------------------> y, along the slope
"""

import math
from collections.abc import Collection, Iterator, Mapping
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from sweep.model import beam, ground, waveform
from sweep.model.beamlets import (
    GAUSS_HERMITE_NODES_MAX,
    UNIFORM_QUADRATURE_RADIUS_SIGMA,
    bins_per_velocity,
    normal_distribution_quadrature,
    plane_offset_moment_bounds,
)
from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.error_budget import ErrorBudget
from sweep.model.link_budget import LASER_PREFIX, LinkBudget
from sweep.model.preparation import BEAMLETS_ERROR_PATH, Parameters, split_by_category
from sweep.model.shot_settings import doppler_ratio
from sweep.model.window import window_samples
from sweep.model.window_response import WindowResponse, window_response

BEAMLETS_PATH = "footprint.beamlets"
"""Parameter path of the number of beamlets of a footprint; a value of 0 means that the number
follows from the tolerance."""
PATTERN_PATH = "footprint.pattern"
"""Parameter path of the name of the pattern in which a footprint's beamlets are arranged."""

_RAY_GROWTH_MIN, _RAY_GROWTH_MAX = 2, 10
"""Smallest and largest factor by which a shot's number of rays increases when it is cast again."""

_UNRELIABLE_ERROR_RAY_COUNT_MAX = 19
"""Largest number of rays per shot at which the estimated error is unreliable. So few rays make
smooth ground look far rougher than it is."""

_N_SEGMENTS = 3
"""Number of segments of a shot; errors of the detection probability are summed over them."""

NODE_COUNTS_ALONG_SLOPE = np.array([
    2, 3, 4, 5, 6, 7, 9, 11, 15, 22, 33, 49, 73, 109, 163, 244, 366, 549, 823, 1234, 1851, 2776,
    4096,
])  # fmt: skip
"""Possible numbers of quadrature nodes (beamlets) along the slope. Steps are wide, because points
with different numbers are computed separately."""

NODE_COUNTS_ACROSS_SLOPE = np.array([1, 2, 3, 5, 7, 11, 16, 24, 32])
"""Possible numbers of parallel rows of quadrature nodes, side by side across the slope."""

_UNIFORM_QUADRATURE_ERROR = 1e-10
"""Relative error of a quadrature with evenly spaced nodes. Its cause is the part of the Gaussian
outside the outermost nodes."""
_N_TABLE_WINDOW_SAMPLES = 1024
"""Number of samples of the windows from which tables of quadrature errors are computed."""
_N_LAGS = 4096
"""Number of lags of a window's autocorrelation in the table of quadrature errors by the spread of
line frequencies."""
_N_LAGS_OF_CURVATURE_TABLE = 512
"""Number of lags of a window's autocorrelation in the table of quadrature errors by curvature."""
_TABULATED_CURVATURES = np.geomspace(1e-6, 100.0, 97)
"""Curvatures c for which quadrature errors are tabulated [bins of fs/L, sample rate over number of
samples]. A beamlet's line is shifted by c x^2, with its position x in the beam [standard
deviations]."""
_TABULATED_QUADRATIC_PHASES = np.geomspace(1e-6, 1e3, 512)
"""Coefficients t for which quadrature errors of the mean of exp(i t x^2) are tabulated [rad]. x is
the position in the beam [standard deviations]."""
_TABULATED_SPREAD_RATIOS = np.geomspace(1e-6, 1e3, 97)
"""Ratios c / s for which quadrature errors are tabulated. c is the quadratic and s the linear
spread of line frequencies over the beam."""
_CHEBYSHEV_DISTANCES_SIGMA = np.array([1.4, 1.8, 2.5, 4.0, 8.0])[:, None]
"""Distances from the mean [standard deviations] at which Chebyshev's inequality gives a bound; the
best bound is used."""


class LineSpreadCoefficients(NamedTuple):
    """Spread of the frequencies of a footprint's lines, s y + c (x^2 + y^2) [bins of fs/L].

    x and y are the two coordinates in the beam, in its standard deviations, y along the slope. s is
    the linear and c the quadratic spread. fs is the sample rate, L the number of samples.
    """

    line_deviation: np.ndarray
    """(n,): standard deviation of a footprint's line frequencies [bins of fs/L], the largest of all
    segments."""
    linear_spread: np.ndarray
    """(rows, n): magnitude of the linear spread s [bins of fs/L], one row for each segment. If the
    target has a roughness, one more row holds twice the spread of the phase difference between
    segments [cycles]."""
    quadratic_spread: np.ndarray
    """(rows, n): magnitude of the quadratic spread c [bins of fs/L], in the same rows as
    `linear_spread`."""

    @property
    def smoothing_deviation(self) -> np.ndarray:
        """Deviation of the Gaussian by which the linear spread reduces errors across the slope.

        The array is (rows, n), with the rows of `linear_spread`. With the linear spread s, the
        quadratic spread c and |t| <= 2 pi, the mean over the beam is bounded:
        |E exp(i t (s y + c y^2))| <= exp(-(t s)^2 / 2 / (1 + (2 t c)^2)).
        """
        return np.asarray(
            self.linear_spread / np.sqrt(1 + (4 * np.pi * self.quadratic_spread) ** 2)
        )


def split_by_category_and_beamlet_count(
    parameters: Parameters, effects: Collection[str], further_paths: Collection[str] = ()
) -> Iterator[tuple[np.ndarray, dict[str, np.ndarray]]]:
    """Split points into categories, with a number of beamlets for each category.

    Points of a category share text parameters and array sizes. A number of beamlets that is not
    stated follows from the tolerance.

    Parameters
    ----------
    parameters : mapping
        Parameters by dotted path, scalars or (n,) arrays.
    effects : collection of str
        Names of the effects to simulate; without ``footprint`` one beamlet is enough.
    further_paths : collection of str
        Paths of additional numeric parameters that points of a category must share, as in
        :func:`sweep.model.preparation.split_by_category`.

    Yields
    ------
    indices : ndarray (m,)
        Indices of the points of a category.
    category_parameters : dict
        Parameters of these points, with number, pattern and error of the beamlets.
    """
    for indices, category_parameters in split_by_category(parameters, further_paths):
        if int(category_parameters[BEAMLETS_PATH]) > 0:
            yield indices, category_parameters
            continue
        n_beamlets, pattern, beamlets_error = np.asarray(1), np.asarray("line"), np.asarray(0.0)
        if "footprint" in effects:
            if beamlets_converge(category_parameters):
                n_beamlets, pattern, beamlets_error = required_beamlet_count_and_pattern(
                    category_parameters, indices.size
                )
            else:
                n_beamlets, pattern = map(
                    np.asarray, largest_beamlet_count_and_pattern(category_parameters)
                )
                beamlets_error = np.asarray(np.nan)  # no estimate for sums of amplitudes
        beamlet_parameters = {
            BEAMLETS_PATH: n_beamlets,
            PATTERN_PATH: pattern,
            BEAMLETS_ERROR_PATH: beamlets_error,
        }
        for subset, subset_parameters in split_by_category(
            category_parameters | beamlet_parameters, further_paths
        ):
            yield indices[subset], subset_parameters


def largest_beamlet_count_and_pattern(parameters: Mapping[str, Any]) -> tuple[int, str]:
    """Return the largest number of beamlets that a point has, and the name of its pattern.

    All points share text parameters and array sizes.
    """
    if beamlets_converge(parameters):
        return ErrorBudget.beamlets_max, "line"
    return ErrorBudget.thesis_beamlet_count, ground.beamlet_pattern(parameters)


def initial_ray_count(parameters: Mapping[str, Any], error_budget: ErrorBudget) -> int:
    """Return the number of rays per shot in the first cast of a flight.

    The number is used if the number of rays follows from the tolerance. Later casts repeat some of
    the shots with more rays.

    Parameters
    ----------
    parameters : mapping
        Parameters by dotted path; all points share text parameters.
    error_budget : ErrorBudget
        Accuracy of the study (:class:`sweep.model.error_budget.ErrorBudget`), with one tolerance
        for all points.

    Returns
    -------
    int
        Number of rays, from `ErrorBudget.min_rays_by_tolerance`. If errors do not fall to 0 as the
        number of beamlets increases, it is `ErrorBudget.thesis_beamlet_count`.
    """
    if not beamlets_converge(parameters):
        return error_budget.thesis_beamlet_count
    tolerance = float(np.asarray(error_budget.tolerance))
    return next(
        n_rays
        for tolerance_min, n_rays in error_budget.min_rays_by_tolerance
        if tolerance >= tolerance_min
    )


def next_ray_counts(n_rays: int, error: np.ndarray, error_budget: ErrorBudget) -> np.ndarray:
    """Return the number of rays for the next cast of each shot, from its estimated error.

    Parameters
    ----------
    n_rays : int
        Number of rays of the last cast, one of `ErrorBudget.ray_counts`.
    error : ndarray (n,)
        Estimated error, as in :func:`sweep.model.pointcloud.ray_error.estimate_ray_error`; nan for
        shots that hit nothing. The error is about proportional to 1 / number of rays.
    error_budget : ErrorBudget
        Accuracy of the study.

    Returns
    -------
    ndarray (n,) int64
        Number of rays; 0 for shots that need no more rays.
    """
    larger_counts = np.array(
        [n for n in error_budget.ray_counts if n > _RAY_GROWTH_MIN * n_rays], np.int64
    )
    error_ratio = np.asarray(error, float) / error_budget.allowed_rays_error
    if not larger_counts.size:
        return np.zeros(error_ratio.shape, np.int64)
    wanted_counts = n_rays * np.minimum(
        error_ratio, _RAY_GROWTH_MAX if n_rays > _UNRELIABLE_ERROR_RAY_COUNT_MAX else 1
    )
    count_index = np.minimum(np.searchsorted(larger_counts, wanted_counts), larger_counts.size - 1)
    return np.where(error_ratio > 1, larger_counts[count_index], 0)


def effects_tolerance(parameters: Mapping[str, Any], n_beamlets: int) -> float:
    """Return the tolerated error of probabilities due to all effects that are not simulated.

    Parameters
    ----------
    parameters : mapping
        Parameters by dotted path; all points share text parameters and the tolerance.
    n_beamlets : int
        Stated number of beamlets, or of rays of a shot; 0 if it follows from the tolerance.

    Returns
    -------
    float
        (`ErrorBudget.effects_fraction` - b) times the tolerance. b is
        `ErrorBudget.beamlets_fraction` if the number of beamlets follows from the tolerance, else
        0.
    """
    counts_beamlets = n_beamlets == 0 and beamlets_converge(parameters)
    return float(
        ErrorBudget.from_parameters(parameters).allowed_effects_error(
            counts_beamlets=counts_beamlets
        )
    )


def has_numerics_set_by_tolerance(parameters: Mapping[str, Any]) -> np.ndarray:
    """Return where the tolerance determines the number of beamlets or an error of lines or leakage.

    The result is (n,) bool or a scalar: False where all these are stated.
    """
    counts_beamlets = ~(parameters[BEAMLETS_PATH] > np.asarray(0))
    return counts_beamlets | ErrorBudget.from_parameters(parameters).has_errors_set_by_tolerance


def beamlets_converge(parameters: Mapping[str, Any]) -> bool:
    """Return True if the error due to the number of beamlets falls to 0 as that number increases.

    All points share text parameters.
    """
    return ground.beamlets_add_as_powers(parameters) and str(parameters[PATTERN_PATH]) not in (
        "hexagonal",
        "sunflower",
    )


def required_beamlet_count_and_pattern(
    parameters: Mapping[str, np.ndarray], n_points: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute the number of beamlets that keeps the tolerance, where the beamlets' powers add.

    Parameters
    ----------
    parameters : mapping
        Parameters by dotted path, as arrays; all points share text parameters and array sizes.
    n_points : int
        Number of points n.

    Returns
    -------
    number : ndarray (n,)
        Number of beamlets.
    pattern : ndarray (n,)
        Name of the pattern: ``line``, or parallel lines such as ``3 lines``.
    error : ndarray (n,)
        Remaining error of the probabilities of detection, summed over the segments.
    """
    budget, error_budget = LinkBudget(parameters), ErrorBudget.from_parameters(parameters)
    pd_change_per_power = _pd_change_per_relative_power(budget) + np.zeros(n_points)
    power_tolerance = error_budget.allowed_beamlets_error / pd_change_per_power
    window_name = budget.record.window.name
    spread = _line_spread_coefficients(budget, n_points, error_budget.beamlets_max)
    n_rows, n_nodes, error = required_node_counts(
        window_name, spread, power_tolerance, error_budget
    )
    pattern = np.where(n_rows == 1, "line", np.char.add(n_rows.astype(str), " lines"))
    return n_rows * n_nodes, pattern, np.minimum(error * pd_change_per_power, 1.0)


def _pd_change_per_relative_power(budget: LinkBudget) -> np.ndarray:
    """Return a bound on the change of pd per relative change of a bin's power, (n,).

    pd is the probability of detection of a segment. Its changes are summed over all segments.
    """
    b = budget.looks.amplitude_gain_max * budget.threshold_ratio
    a = 0.5 * (b + np.sqrt(b * b + 2))
    slope_max = np.maximum(np.sqrt(a * b / (2 * np.pi)), 1.0)
    return np.asarray(_N_SEGMENTS * slope_max / 2)


def _line_spread_coefficients(
    budget: LinkBudget, n_points: int, beamlets_max: int
) -> LineSpreadCoefficients:
    """Compute the :class:`LineSpreadCoefficients` of the footprints of n points.

    `beamlets_max` is the largest number of beamlets, which sets the largest distance of a beamlet
    from the axis.
    """
    parameters = budget.parameters
    grazing_angle, radial_velocity = (
        parameters["target.grazing_angle"],
        np.asarray(parameters["target.radial_velocity"], float),
    )
    position_spread_angles, direction_spread_angles = beam.footprint_full_angles(parameters)
    transverse_velocity = np.asarray(parameters["target.transverse_velocity"], float)
    position_sigma, slope, direction_sigma = (
        position_spread_angles / 4,
        position_spread_angles / 4 / np.tan(grazing_angle),
        direction_spread_angles / 4,
    )
    bin_width = budget.record.sample_rate / budget.record.window.length
    chirp_rate = budget.waveform.chirp_rate
    range_moments, velocity_moments = plane_offset_moment_bounds(
        transverse_velocity=transverse_velocity,
        radial_velocity=radial_velocity,
        grazing_angle=grazing_angle,
        beam_divergence=position_spread_angles,
        n_beamlets=beamlets_max,
        pattern="line",
        direction_spread_angle=direction_spread_angles,
    )
    # Beyond the horizon the moments of ranges have no bound; the first-order slope is used there.
    range_rms = np.where(np.isfinite(range_moments.rms), range_moments.rms, slope)
    beat_per_metre = (
        2
        / SPEED_OF_LIGHT
        * np.asarray(chirp_rate, float)
        * (1 + np.abs(doppler_ratio(radial_velocity)))
    )
    bins_per_range = beat_per_metre * parameters["target.range"] / bin_width
    # At least every segment's carrier, whatever the chirp slopes, and the optical one even with
    # direct detection: counts of beamlets thus stay the same.
    carrier = (
        SPEED_OF_LIGHT / parameters[LASER_PREFIX + "wavelength"] + budget.waveform.chirp_bandwidth
    )
    bins_per_speed = bins_per_velocity(
        range=parameters["target.range"],
        carrier=carrier,
        chirp_rate=chirp_rate,
        bin_width=bin_width,
    )
    # Chirp slopes weight the contribution of ranges to the beats.
    chirp_rate_ratios, zeros = (
        np.array(waveform.chirp_rate_ratios(parameters))[:, None],
        np.zeros(n_points),
    )
    spread = LineSpreadCoefficients(
        line_deviation=abs(chirp_rate_ratios).max() * bins_per_range * range_rms
        + bins_per_speed * velocity_moments.rms
        + zeros,
        linear_spread=abs(
            bins_per_speed * transverse_velocity * direction_sigma
            + chirp_rate_ratios * bins_per_range * slope
        )
        + zeros,
        quadratic_spread=abs(
            bins_per_speed * radial_velocity * (direction_sigma / position_sigma) ** 2
            + chirp_rate_ratios * bins_per_range
        )
        * (position_sigma**2 / 2)
        + zeros,
    )
    if "target.roughness" not in parameters or not np.any(parameters["target.roughness"]):
        return spread
    # Drawn amplitudes rotate relative to each other from segment to segment: by Doppler shifts and,
    # as segments differ in optical frequency, by ranges.
    last_start_bins = np.maximum.reduce(budget.waveform.segment_starts) * bin_width
    carrier_difference_cycles = _carrier_difference_max(budget) * budget.target.delay
    # The factor 2 is for sums over records, in which the ends hardly count.
    slope = np.vstack(
        [
            spread.linear_spread,
            2 * (last_start_bins * spread.linear_spread[1] + carrier_difference_cycles * slope),
        ]
    )
    quadratic = np.vstack(
        [
            spread.quadratic_spread,
            2
            * (
                last_start_bins * spread.quadratic_spread[1]
                + carrier_difference_cycles * position_sigma**2 / 2
            ),
        ]
    )
    phase_deviation = (
        2
        * (
            last_start_bins * bins_per_speed * velocity_moments.rms
            + carrier_difference_cycles * range_rms
        )
        + zeros
    )
    return LineSpreadCoefficients(
        np.maximum(spread.line_deviation, phase_deviation), slope, quadratic
    )


def _carrier_difference_max(budget: LinkBudget) -> np.ndarray:
    """Return the largest difference between segments' optical frequencies in mid-record [Hz].

    See equation (1) of :mod:`sweep.model.detection.speckle_correlation`.
    """
    settings = budget.waveform
    record_middle = budget.record.acquisition_delay + budget.record.duration / 2
    time_since_echo = record_middle - budget.target.delay
    frequencies = [
        carrier + chirp_rate_ratio * settings.chirp_rate * time_since_echo
        for carrier, chirp_rate_ratio in zip(
            settings.carriers, settings.chirp_rate_ratios, strict=True
        )
    ]
    return np.max(frequencies, axis=0) - np.min(frequencies, axis=0)


def required_node_counts(
    window_name: str,
    spread: LineSpreadCoefficients,
    tolerance: np.ndarray,
    error_budget: ErrorBudget,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Choose numbers of quadrature nodes, in parallel rows, that keep a tolerance.

    A node is a beamlet. A row of nodes runs along the slope. The tolerance is that of the largest
    bin's power.

    Parameters
    ----------
    window_name : str
        Name of the window.
    spread : LineSpreadCoefficients
        Spread of the frequencies of the footprint's lines.
    tolerance : ndarray (n,)
        Tolerated relative error of the largest bin's power, at any position of the lines between
        bins.
    error_budget : ErrorBudget
        Accuracy of the study.

    Returns
    -------
    n_rows : ndarray (n,)
        Number of parallel rows of nodes, 1 for most points.
    n_nodes : ndarray (n,)
        Number of nodes of each row, at least 2. If no number meets the tolerance, it is that of
        least error.
    error : ndarray (n,)
        Upper bound on the relative error of the largest bin's power; 1 if no bound is known.
    """
    tabulated_spreads, tabulated_errors, largest_bin_powers = _quadrature_errors_by_spread(
        window_name
    )
    table_index = np.searchsorted(tabulated_spreads, spread.line_deviation)  # of the next wider
    single_row_error = _single_node_row_error(window_name, spread) / largest_bin_powers[table_index]
    counts = NODE_COUNTS_ALONG_SLOPE[
        : np.searchsorted(NODE_COUNTS_ALONG_SLOPE, error_budget.beamlets_max, "right")
    ]
    total_error = tabulated_errors[: counts.size, table_index] + single_row_error
    count_index, error = _choose_cheapest_within_tolerance(total_error, counts[:, None], tolerance)
    n_rows = np.ones(count_index.shape, np.int64)
    needs_rows = (error > tolerance) & (
        single_row_error > error_budget.single_row_error_fraction * tolerance
    )
    if needs_rows.any():
        spread_subset = LineSpreadCoefficients(
            *(np.asarray(values)[..., needs_rows] for values in spread)
        )
        rows_count_index, row_counts, row_errors = _choose_node_rows(
            window_name, spread_subset, tolerance[needs_rows], error_budget.beamlets_max
        )
        is_better = row_errors < np.minimum(error[needs_rows], 1.0)
        improved = np.flatnonzero(needs_rows)[is_better]
        count_index[improved], n_rows[improved], error[improved] = (
            rows_count_index[is_better],
            row_counts[is_better],
            row_errors[is_better],
        )
    return n_rows, NODE_COUNTS_ALONG_SLOPE[count_index], np.minimum(error, 1.0)


def _choose_cheapest_within_tolerance(
    error: np.ndarray, cost: np.ndarray, tolerance: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Choose the cheapest alternative whose error is within the tolerance, for each of n points.

    Parameters
    ----------
    error, cost : ndarray (rows, n)
        Error and cost of each alternative, one row for each; costs broadcast.
    tolerance : ndarray (n,)
        Tolerated error.

    Returns
    -------
    row : ndarray (n,)
        Index of the chosen alternative; that of least error if none is within the tolerance.
    error : ndarray (n,)
        Error of the chosen alternative.
    """
    allowed_cost = np.where(error <= tolerance, cost, np.inf)
    row = np.where(
        np.isfinite(allowed_cost).any(axis=0), allowed_cost.argmin(axis=0), error.argmin(axis=0)
    )
    return row, np.take_along_axis(error, row[None], axis=0)[0]


def _choose_node_rows(
    window_name: str, spread: LineSpreadCoefficients, tolerance: np.ndarray, beamlets_max: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Choose numbers of rows and nodes for points at which one row of nodes is too inaccurate.

    A node is a beamlet. A row of nodes runs along the slope. The parameters are those of
    :func:`required_node_counts`.

    Returns
    -------
    count_index : ndarray (n,)
        Index in NODE_COUNTS_ALONG_SLOPE of the number of nodes of each row.
    n_rows : ndarray (n,)
        Number of parallel rows of nodes.
    error : ndarray (n,)
        Upper bound on the relative error of the largest bin's power.
    """
    tabulated_spreads, tabulated_errors, largest_bin_powers = _quadrature_errors_by_spread(
        window_name
    )
    errors_along, errors_across = _quadrature_errors_by_curvature(window_name)
    quadratic_max, linear_max = (
        spread.quadratic_spread.max(axis=0),
        spread.linear_spread.max(axis=0),
    )
    # If curvature alone spreads the lines, only the rules' error for squares counts.
    linear_deviation = spread.line_deviation * np.minimum(linear_max / quadratic_max, 1.0)
    largest_bin_power = largest_bin_powers[
        np.searchsorted(tabulated_spreads, spread.line_deviation)
    ]
    curvature_index = np.searchsorted(_TABULATED_CURVATURES, quadratic_max)
    error_along = (
        tabulated_errors[:, np.searchsorted(tabulated_spreads, linear_deviation)]
        + errors_along[:, curvature_index] / largest_bin_power
    )
    error_across = np.zeros((NODE_COUNTS_ACROSS_SLOPE.size, quadratic_max.size))
    for s, c in zip(spread.smoothing_deviation, spread.quadratic_spread, strict=True):
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = np.searchsorted(_TABULATED_SPREAD_RATIOS, np.where(s > 0, c / s, np.inf))
            smoothed_error = _smoothed_quadrature_errors()[:, ratio] * (
                _autocorrelation_peak_density(window_name) / (2 * np.pi * s)
            )
        segment_error = np.fmin(
            errors_across[:, np.searchsorted(_TABULATED_CURVATURES, c)], smoothed_error
        )
        error_across = np.maximum(error_across, segment_error / largest_bin_power)
    total_error = error_along[:, None] + error_across
    cost = NODE_COUNTS_ALONG_SLOPE[:, None] * NODE_COUNTS_ACROSS_SLOPE
    total_error = np.where((cost <= beamlets_max)[..., None], total_error, np.inf).reshape(
        -1, quadratic_max.size
    )
    best, error = _choose_cheapest_within_tolerance(total_error, cost.reshape(-1, 1), tolerance)
    return (
        best // NODE_COUNTS_ACROSS_SLOPE.size,
        NODE_COUNTS_ACROSS_SLOPE[best % NODE_COUNTS_ACROSS_SLOPE.size],
        error,
    )


def _single_node_row_error(window_name: str, spread: LineSpreadCoefficients) -> np.ndarray:
    """Return a bound on the error of a single row of nodes along the slope due to curvature, (n,).

    The error is in units of the power of a bin on which a spectral line is centred. The bound is
    twice the error across the slope: the error along it is at most as large.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        density = _autocorrelation_peak_density(window_name) / (
            2 * np.pi * spread.smoothing_deviation
        )
        smoothed_error = (
            density
            * math.sqrt(np.pi / 2)
            * (spread.quadratic_spread / spread.smoothing_deviation) ** 2
        )
    lobe_shape = window_response(window_name, _N_TABLE_WINDOW_SAMPLES, _N_TABLE_WINDOW_SAMPLES)
    return np.asarray(
        2
        * np.fmin(lobe_shape.power_curvature_max * spread.quadratic_spread**2, smoothed_error).max(
            axis=0
        )
    )


@lru_cache(maxsize=32)
def _quadrature_errors_by_spread(window_name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Tabulate the quadrature error of each number of nodes by the spread of line frequencies.

    Numbers of nodes are NODE_COUNTS_ALONG_SLOPE. fs is the sample rate, L the number of samples.

    Returns
    -------
    spreads : ndarray (m,)
        Standard deviations of line frequencies [bins of fs/L].
    errors : ndarray (counts, m + 1)
        Largest error up to each standard deviation, relative to the power of the largest bin. The
        last column is for standard deviations above all of `spreads`.
    largest_bin_powers : ndarray (m + 1,)
        Power of the largest bin at each standard deviation, relative to the power with all lines
        centred on one bin.
    """
    spreads = np.geomspace(1e-3, 400.0, 96)
    largest_bin_powers = _largest_bin_power(
        window_response(window_name, _N_TABLE_WINDOW_SAMPLES, _N_TABLE_WINDOW_SAMPLES), spreads
    )
    lag = (np.arange(_N_LAGS) + 0.5) / _N_LAGS
    weight = _normalised_autocorrelation(window_name, lag)
    errors = np.empty((NODE_COUNTS_ALONG_SLOPE.size, spreads.size + 1))
    for row, n_nodes in zip(errors, NODE_COUNTS_ALONG_SLOPE.tolist(), strict=True):
        row[:] = np.append(_substitute_for_unbounded_error(spreads, n_nodes), np.inf)
        for i, spread in enumerate(spreads.tolist()):
            rule_error = (
                weight * _quadrature_error_for_cosine(n_nodes, 2 * np.pi * spread * lag)
            ).sum() / largest_bin_powers[i]
            if rule_error > 1:
                break  # wider spreads have larger errors
            row[i] = rule_error
        row[-1] = _substitute_for_unbounded_error(1e3, n_nodes)
    return (
        spreads,
        np.maximum.accumulate(errors, axis=1),
        np.append(largest_bin_powers, largest_bin_powers[-1]),
    )


def _substitute_for_unbounded_error(spread: ArrayLike, n_nodes: int) -> np.ndarray:
    """Return a number, at least 1, that stands for a quadrature's error where no bound is known.

    ``spread`` is the standard deviation or curvature of the lines [bins of fs/L]. The number is the
    distance between nodes [bins], if ``n_nodes`` nodes are spread evenly over the lines. It falls
    as nodes are added, so that a choice of least error prefers more nodes.
    """
    return np.maximum(1.0, 2 * UNIFORM_QUADRATURE_RADIUS_SIGMA * np.asarray(spread) / n_nodes)


@lru_cache(maxsize=32)
def _quadrature_errors_by_curvature(window_name: str) -> tuple[np.ndarray, np.ndarray]:
    """Tabulate the quadrature error of each number of nodes and of node rows by curvature.

    Curvatures are _TABULATED_CURVATURES; the last column is for all larger ones. Errors are
    relative to the power of a bin on which a spectral line is centred.

    Returns
    -------
    along : ndarray (counts, m + 1)
        Errors along the slope of each number in NODE_COUNTS_ALONG_SLOPE.
    across : ndarray (rows, m + 1)
        Errors across the slope of each number in NODE_COUNTS_ACROSS_SLOPE.
    """
    lag = (np.arange(_N_LAGS_OF_CURVATURE_TABLE) + 0.5) / _N_LAGS_OF_CURVATURE_TABLE
    weight = _normalised_autocorrelation(window_name, lag)
    phase = 2 * np.pi * lag * _TABULATED_CURVATURES[:, None]

    def errors_of_rule(n_nodes: int) -> np.ndarray:
        """Return the errors of a quadrature with `n_nodes` nodes, (m + 1,).

        The errors are those at _TABULATED_CURVATURES; the last one is for larger curvatures.
        """
        rule_errors = (
            weight
            * np.interp(
                phase, _TABULATED_QUADRATIC_PHASES, _quadrature_error_for_quadratic_phase(n_nodes)
            )
        ).sum(axis=1)
        return np.append(
            np.where(
                rule_errors < 1,
                rule_errors,
                _substitute_for_unbounded_error(_TABULATED_CURVATURES, n_nodes),
            ),
            1e3,
        )

    along, across = NODE_COUNTS_ALONG_SLOPE.tolist(), (2 * NODE_COUNTS_ACROSS_SLOPE).tolist()
    return np.array([errors_of_rule(number) for number in along]), np.array(
        [errors_of_rule(number) for number in across]
    )


@lru_cache(maxsize=1)
def _smoothed_quadrature_errors() -> np.ndarray:
    """Tabulate the quadrature error across the slope where line frequencies also spread linearly.

    The linear spread along the slope reduces (smooths) the error. Array rows belong to
    NODE_COUNTS_ACROSS_SLOPE. Columns belong to _TABULATED_SPREAD_RATIOS, the quadratic over the
    linear spread; the last column, for larger ratios, is inf. Each value is the integral over
    t > 0 of exp(-t^2 / 2) times the error at the quadratic phase t times the ratio.
    """
    phase = np.linspace(0.0, 8.0, 801)[1:]
    weight = np.exp(-0.5 * phase**2) * (phase[1] - phase[0])
    errors = np.full((NODE_COUNTS_ACROSS_SLOPE.size, _TABULATED_SPREAD_RATIOS.size + 1), np.inf)
    for row, lines in zip(errors, NODE_COUNTS_ACROSS_SLOPE.tolist(), strict=True):
        rule_errors = np.interp(
            phase * _TABULATED_SPREAD_RATIOS[:, None],
            _TABULATED_QUADRATIC_PHASES,
            _quadrature_error_for_quadratic_phase(2 * lines),
        )
        row[:-1] = (weight * rule_errors).sum(axis=1)
    return errors


@lru_cache(maxsize=64)
def _quadrature_error_for_quadratic_phase(n_nodes: int) -> np.ndarray:
    """Return the error of a quadrature's mean of exp(i t x^2) for normal x, (phases,).

    The phases t are _TABULATED_QUADRATIC_PHASES. The result is the largest error up to each phase.
    The exact mean is 1 / sqrt(1 - 2 i t).
    """
    x, w = normal_distribution_quadrature(n_nodes)
    rule_mean = np.array(
        [(w * np.exp(1j * phase * x**2)).sum() for phase in _TABULATED_QUADRATIC_PHASES.tolist()]
    )
    return np.maximum.accumulate(
        np.abs(rule_mean - 1 / np.sqrt(1 - 2j * _TABULATED_QUADRATIC_PHASES))
    )


def _largest_bin_power(lobe_shape: WindowResponse, deviation: np.ndarray) -> np.ndarray:
    """Return a lower bound on the power of the largest bin of a footprint's lines.

    The power is relative to that with all lines at the bin's centre. `deviation` is the standard
    deviation of line frequencies [bins of fs/L]. See
    :meth:`sweep.model.effects.planner_inputs.PlannerInputs.peak_power_bounds_for_spread`.
    """
    narrow = lobe_shape.scalloping_gain_min**2 - 0.5 * lobe_shape.power_curvature_max * deviation**2
    wide = (1 - 1 / _CHEBYSHEV_DISTANCES_SIGMA**2) * lobe_shape.central_energy_min
    return np.maximum(
        narrow,
        (
            wide / (2 * _CHEBYSHEV_DISTANCES_SIGMA * deviation + 2 * lobe_shape.padding_factor + 1)
        ).max(axis=0),
    )


def _normalised_autocorrelation(window_name: str, lag: np.ndarray) -> np.ndarray:
    """Return the magnitude of a window's autocorrelation at lags [record lengths], like `lag`.

    The magnitudes are divided by the sum of the signed autocorrelation over these lags.
    """
    w = window_samples(window_name, _N_TABLE_WINDOW_SAMPLES)
    r = np.fft.irfft(np.abs(np.fft.rfft(w, 2 * _N_TABLE_WINDOW_SAMPLES)) ** 2)[
        : _N_TABLE_WINDOW_SAMPLES + 1
    ]
    at_lags = np.interp(lag * _N_TABLE_WINDOW_SAMPLES, np.arange(_N_TABLE_WINDOW_SAMPLES + 1), r)
    return np.asarray(np.abs(at_lags) / at_lags.sum())


@lru_cache(maxsize=32)
def _autocorrelation_peak_density(window_name: str) -> float:
    """Return the largest density of a window's autocorrelation over lags [1/record length].

    The density has the integral 1 over lags of 0..1 record length.
    """
    lag = (np.arange(_N_LAGS) + 0.5) / _N_LAGS
    return float(_normalised_autocorrelation(window_name, lag).max()) * _N_LAGS


def _quadrature_error_for_cosine(n_nodes: int, phase: np.ndarray) -> np.ndarray:
    """Return the error of a quadrature's mean of cos(phase x) for normal x, (phases,).

    `phase` is (phases,) [rad]. The exact mean is exp(-phase^2 / 2).
    """
    if n_nodes <= GAUSS_HERMITE_NODES_MAX:
        x, w = normal_distribution_quadrature(n_nodes)
        rule_mean = (w * np.cos(phase[:, None] * x)).sum(axis=1)
        return np.asarray(np.abs(rule_mean - np.exp(-0.5 * phase**2)))
    step = 2 * UNIFORM_QUADRATURE_RADIUS_SIGMA / (n_nodes - 1)
    excess_phase = phase - 2 * np.pi / step  # evenly spaced nodes alias there
    return np.asarray(
        np.where(excess_phase < 0, np.exp(-0.5 * excess_phase**2), 1.0) + _UNIFORM_QUADRATURE_ERROR
    )
