"""Velocity and altitude of each measurement cycle and draw, with their uncertainties.

Each beam measures the platform's velocity along the beam, ``v_r = u . v`` (closing is positive),
and a point of the ground, ``R u``. Weighted least squares over the beams with a return gives the
velocity. A plane through the ground points gives the altitude. Standard errors are those of single
beams, uncorrelated; covariances follow by linear propagation.

The instrument does not know which of its points are true. For each shot it uses the first, and
strongest, point that a Doppler peak confirms (:mod:`sweep.model.pointcloud.pairing`). False alarms
that are confirmed, and mispaired and misread points, are used as if they were true. The test for
one false beam may find them.

The residuals of a solution may contradict the errors of its points: their chi-square exceeds the
value that true errors exceed once in ten thousand. Causes are unstated relief, or a false point.
The covariance is then estimated from the residuals and widened as Student's t is for the number of
degrees of freedom, so that 68 % of the errors are within it. The beams of one cycle contain no more
information: errors beyond two such deviations are more frequent than for a normal distribution.

A point whose standard error is not finite is omitted. A standard error below a millionth of a bin
counts as a millionth, which is the accuracy of the interpolation.

The instrument knows, from inertial sensors, its attitude and the changes of its position and
velocity within a cycle. So the altitude is that at the cycle's first shot, above the ground
straight below it. The velocity is the mean over the cycle's shots, in the world's axes.

The beats give the range at some time after the shot's start, t = d range / d slip of a point
(``range_per_slip``). A point's range is referred to the start by the speed u at which the range to
level ground falls (:mod:`sweep.model.pointcloud.ego_motion`). Navigation undoes this. The ground
point is at the range R - u t from the instrument, which has moved by V t, along the beam, which has
turned by d' t. It is on the ground whatever the slope is, so the error for an unknown slope is
omitted. The radial velocity depends slightly on the slip, and is corrected by the slope of the
plane. Its error for other slopes under the beams counts if `relief`, or the residuals, show that
the ground is no plane.

The instrument knows the standard deviation sigma of its pointing jitter, in each of the two angles
across a beam. To first order, jitter adds sigma |v_perp| to the standard error of the radial
velocity. Here v_perp is the velocity across the beam, by a first solution without jitter. Jitter
adds sigma R tan(angle of incidence) to the standard error of the range, on the plane of a first
solution.

It also knows the standard deviations of the floor of its errors
(:mod:`sweep.model.pointcloud.error_floor`). Those of pointing and vibration are independent from
beam to beam: they enter the weights and show in the residuals. Clock and wavelength scale all beams
by the same factor, which no residual shows, and are removed from the weights. A relative error s
adds s^2 v v^T to the covariance of the velocity, and s^2 h^2 to the variance of the altitude. The
altitude is that of the points at their reported positions, which include the pointing errors. Its
variance includes the pointing as it includes jitter.
"""

import math
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri, stdtrit

from sweep.model.outputs import NAVIGATION_VARIABLES
from sweep.model.pointcloud.ego_motion import (
    DEPRESSION_SINE_MIN,
    EgoMotion,
    MotionPriors,
    assumed_motion_along_beams,
)
from sweep.model.pointcloud.error_floor import NO_ERROR_FLOOR, ErrorFloor
from sweep.model.pointcloud.pairing import UNCONFIRMED_FLAG

BEAMS_PER_BATCH = 1 << 14
"""Largest number of beams, summed over cycles and draws, that are solved together. Intermediate
arrays of this size fit into the processor's cache."""

GRAZING_SINE_MIN = 0.05
"""Smallest sine of the angle between beam and ground (some 3 deg) that is used for the weights of
ground points."""

_CONDITION_NUMBER_MAX = 1e6
"""Largest condition number of a cycle's least-squares equations. Beams of a cycle with a larger one
count as coplanar, and no velocity is computed."""

_INTERPOLATION_ERROR_RATIO_MIN = 1e-6
"""Smallest standard error of a value interpolated between bins, as a fraction of the standard error
of the value by whole bins."""

_BELOW_MEAN_PLUS_SIGMA_PROBABILITY = 0.8413447460685429
"""Probability that a normal random number is below its mean plus one standard deviation."""

_RELATIVE_VARIANCE_ROUNDING_ERROR = 1e-14
"""Relative rounding error of a squared standard error. It sets the smallest standard error that
remains after the error due to an unknown slip is subtracted."""

_CONTRADICTION_PROBABILITY_MAX = 1e-4
"""Probability, under the stated errors, of a chi-square at least as large as the observed one,
below which the residuals contradict the stated errors. The covariance is then scaled by the
residuals."""

STATUS_SOLVED = 0
"""Status of a cycle whose solution uses all beams with a return."""
STATUS_EXCLUDED = 1
"""Status of a cycle whose solution excludes one beam that contradicts all others."""
STATUS_WITHHELD = 2
"""Status of a cycle without a solution: its beams contradict each other, and the false beam cannot
be identified."""
STATUS_UNDETERMINED = 3
"""Status of a cycle without a solution: its beams are too few, or nearly coplanar."""

ArraysByName = Mapping[str, np.ndarray]
"""Mapping from names of output variables to their arrays."""


class FittedCycles(NamedTuple):
    """Velocities or altitudes fitted to n measurement cycles.

    The fields are the first fields of :class:`NavigationSolution`.
    """

    estimate: np.ndarray
    """(n, 3): velocity of the instrument [m/s]; or (n,): its altitude [m]. The record holds one of
    the two."""
    covariance: np.ndarray
    """(n, 3, 3): covariance of the velocity's error [m^2/s^2]; or (n,): variance of the altitude's
    error [m^2]."""
    chi_square: np.ndarray
    """(n,): sum of squared residuals, each divided by its variance; nan without a solution."""
    degrees_of_freedom: np.ndarray
    """(n,) int64: number of observations minus number of unknowns; 0 without a solution."""


class NavigationSolution(NamedTuple):
    """Velocities or altitudes of measurement cycles; nan for a cycle without a solution.

    Vectors have the axes of the beam directions that were passed to the solver.
    """

    estimate: np.ndarray
    """(..., 3): velocity of the platform relative to the ground [m/s]; or (...,): height above the
    ground's plane along the vertical [m]."""
    covariance: np.ndarray
    """(..., 3, 3): covariance of the velocity's error [m^2/s^2]; or (...,): variance of the
    altitude's error [m^2]."""
    chi_square: np.ndarray
    """(...,): sum of squared residuals, each divided by its variance. For a withheld solution it is
    the sum of the fit to all beams with a return."""
    degrees_of_freedom: np.ndarray
    """(...,) int64: number of observations minus number of unknowns; 0 for an undetermined cycle.
    It is the expectation of ``chi_square`` for true errors."""
    is_beam_used: np.ndarray
    """(..., b) bool: True for beams whose measurements the solution uses."""
    status: np.ndarray
    """(...,) int8: STATUS_SOLVED, STATUS_EXCLUDED, STATUS_WITHHELD or STATUS_UNDETERMINED."""

    @property
    def is_available(self) -> np.ndarray:
        """Mask (...,), True for cycles that have a solution."""
        return self.status <= STATUS_EXCLUDED


def solve_velocity(
    *,
    direction: np.ndarray,
    radial_velocity: np.ndarray,
    standard_error: np.ndarray,
    test_level: float | None = None,
) -> NavigationSolution:
    """Return the velocity vector of each cycle of b beams, with its covariance.

    Parameters
    ----------
    direction
        (..., b, 3): unit vectors from the instrument.
    radial_velocity
        (..., b): velocities along the directions [m/s], positive when closing; not finite for a
        beam without a return.
    standard_error
        (..., b): standard errors of the radial velocities [m/s].
    test_level
        Probability with which the test for one false beam rejects a cycle of true beams; None for
        no test. With five beams the test can identify a false beam; with four it withholds the
        solution.

    Notes
    -----
    Leading dimensions of the arguments broadcast.
    """
    u, closing_speed, error, leading_shape = _flatten_cycles(
        direction, radial_velocity, standard_error
    )

    def fit_cycles(cycles: np.ndarray, is_used: np.ndarray) -> FittedCycles:
        """Fit the velocities of k cycles by weighted least squares.

        The velocity V minimises the sum over beams of ((u . V - v) / e)^2, with the direction u,
        the measured radial velocity v and its standard error e. The covariance is the inverse of
        the sum of u u^T / e^2. It is scaled where residuals contradict the stated errors
        (:func:`_covariance_scale_factor`).

        Parameters
        ----------
        cycles : ndarray (k,) int64
            Indices of the cycles.
        is_used : ndarray (k, b) bool
            True for beams whose measurements are used.

        Returns
        -------
        FittedCycles
            Velocities, covariances and chi-squares. The chi-square is nan in a cycle with fewer
            than three beams, or with nearly coplanar ones.
        """
        with np.errstate(divide="ignore", invalid="ignore"):
            design = np.where(is_used[..., None], u[cycles] / error[cycles, :, None], 0.0)
            residual = np.where(is_used, closing_speed[cycles] / error[cycles], 0.0)
            right_vectors, squared_singular_values, coordinates = _least_squares(design, residual)
            condition = np.sqrt(
                squared_singular_values.max(axis=1) / squared_singular_values.min(axis=1)
            )
            is_solved = (is_used.sum(axis=1) >= 3) & (condition <= _CONDITION_NUMBER_MAX)
            value = sum(right_vectors[:, :, k] * coordinates[:, k, None] for k in range(3))
            covariance = sum(
                right_vectors[:, :, None, k]
                * right_vectors[:, None, :, k]
                / squared_singular_values[:, k, None, None]
                for k in range(3)
            )
        chi_square = np.where(is_solved, sum(residual.T**2), np.nan)
        degrees_of_freedom = np.where(is_solved, is_used.sum(axis=1) - 3, 0)
        scale = _covariance_scale_factor(chi_square, degrees_of_freedom, degrees_of_freedom)
        return FittedCycles(
            value, covariance * scale[:, None, None], chi_square, degrees_of_freedom
        )

    return _solve_without_false_beams(
        fit_cycles, np.isfinite(closing_speed), test_level, leading_shape
    )


def solve_altitude(
    *,
    direction: np.ndarray,
    range: np.ndarray,
    standard_error: np.ndarray,
    slope: float,
    offset: np.ndarray | None = None,
    relief: float = 0.0,
    test_level: float | None = None,
) -> NavigationSolution:
    """Return the altitude above the plane through each cycle's ground points, with its variance.

    Parameters
    ----------
    direction
        (..., b, 3): unit vectors from the instrument, z up.
    range
        (..., b): ranges along the directions [m]; not finite for a beam without a return.
    standard_error
        (..., b): standard errors of the ranges [m].
    slope
        Prior standard deviation of the ground's slope, whose mean is 0. The prior is an additional
        observation in the fit, whatever the number of points. 0 states level ground: two beams then
        check each other, and three are enough to identify a false one.
    offset
        (..., b, 3): position of the instrument when each beam fires, relative to the position whose
        altitude is solved for [m].
    relief
        Standard deviation of heights about the plane [m], which is added to the errors of range.
        Without it real ground fails the test for a false beam.
    test_level
        Probability with which the test for one false beam rejects a cycle of true beams; None for
        no test.

    Notes
    -----
    If the residuals show that the ground is no plane, the variance assumes that the ground straight
    below is as far off the plane as the points are.
    """
    ground_points, u, error, leading_shape = _ground_points(
        direction, range, standard_error, offset
    )

    def fit_cycles(cycles: np.ndarray, is_used: np.ndarray) -> FittedCycles:
        """Fit the altitudes of k cycles by weighted least squares.

        The plane is fitted twice, because the weights of the points depend on its gradient. The
        first fit takes the weights of level ground. The variance is larger where residuals
        contradict the stated errors.

        Parameters
        ----------
        cycles : ndarray (k,) int64
            Indices of the cycles.
        is_used : ndarray (k, b) bool
            True for beams whose ground points are used.

        Returns
        -------
        FittedCycles
            Altitudes, variances and chi-squares. The number of degrees of freedom is the number of
            beams minus 1: the prior of two slopes counts as two observations, and on level
            ground the altitude alone is unknown. The chi-square is nan in a cycle without beams.
        """
        is_used_by_beam = np.ascontiguousarray(is_used.T)
        plane_arguments = (
            np.where(is_used_by_beam, ground_points[..., cycles], 0.0),
            u[..., cycles],
            error[:, cycles],
            is_used_by_beam,
        )
        with np.errstate(divide="ignore", invalid="ignore"):
            level_plane = _fit_plane(*plane_arguments, np.zeros((2, cycles.size)), slope, relief)
            plane = _fit_plane(*plane_arguments, level_plane.gradient, slope, relief)
        n_used = is_used.sum(axis=1)
        chi_square, degrees_of_freedom = (
            np.where(n_used > 0, plane.chi_square, np.nan),
            np.maximum(n_used - 1, 0),
        )
        scale = _covariance_scale_factor(
            chi_square, degrees_of_freedom, n_used - 1 - plane.n_fitted_slopes
        )
        off_plane_variance = n_used * np.where(scale > 1, plane.centroid_height_variance, 0.0)
        return FittedCycles(
            plane.platform_height,
            scale * (plane.platform_height_variance + off_plane_variance),
            chi_square,
            degrees_of_freedom,
        )

    is_valid = np.isfinite(ground_points).all(axis=0).T
    return _solve_without_false_beams(fit_cycles, is_valid, test_level, leading_shape)


def ground_gradient(
    *,
    direction: np.ndarray,
    range: np.ndarray,
    standard_error: np.ndarray,
    is_used: np.ndarray,
    slope: float,
    offset: np.ndarray | None = None,
    relief: float = 0.0,
) -> np.ndarray:
    """Return the gradient (..., 2) along x and y of the plane through each cycle's ground points.

    Parameters
    ----------
    direction, range, standard_error, slope, offset, relief
        Arguments of :func:`solve_altitude`.
    is_used
        (..., b) bool: True for beams whose points determine the plane. The gradient of a cycle
        without such beams is 0.
    """
    ground_points, u, error, leading_shape = _ground_points(
        direction, range, standard_error, offset
    )
    is_used_by_beam = np.ascontiguousarray(is_used.reshape(-1, is_used.shape[-1]).T)
    plane_arguments, gradient = (
        (np.where(is_used_by_beam, ground_points, 0.0), u, error, is_used_by_beam),
        np.zeros((2, is_used_by_beam.shape[1])),
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        for _ in (1, 2):
            gradient = _fit_plane(*plane_arguments, gradient, slope, relief).gradient
    gradient = np.where(is_used_by_beam.any(axis=0), gradient, 0.0)
    return np.ascontiguousarray(gradient.T).reshape(*leading_shape, 2)


def _ground_points(
    direction: np.ndarray, distance: np.ndarray, standard_error: np.ndarray,
    offset: np.ndarray | None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, tuple[int, ...]]:  # fmt: skip
    """Return the ground points that b beams of each of n cycles measure.

    Parameters
    ----------
    direction, distance, standard_error, offset
        As `direction`, `range`, `standard_error` and `offset` of :func:`solve_altitude`.

    Returns
    -------
    ground_points : ndarray (3, b, n)
        Ground points [m]. Cycles lie along the last axis, along which NumPy is fast. Their number n
        is the product of the leading dimensions.
    directions : ndarray (3, b, n)
        Directions of the beams.
    errors : ndarray (b, n)
        Standard errors of the ranges [m].
    leading_shape : tuple of int
        Leading dimensions of the arguments.
    """
    u, distance, error, leading_shape = _flatten_cycles(direction, distance, standard_error)
    ground_points = u * distance[..., None]
    if offset is not None:
        offsets = np.broadcast_to(np.asarray(offset, float), (*leading_shape, *u.shape[1:]))
        ground_points += offsets.reshape(u.shape)
    ground_points, u, error = (
        np.ascontiguousarray(values.T) for values in (ground_points, u, error)
    )
    return ground_points, u, error, leading_shape


def _covariance_scale_factor(
    chi_square: np.ndarray, degrees_of_freedom: np.ndarray, residual_degrees: np.ndarray
) -> np.ndarray:
    """Return the factor (n,) by which the covariance of each solution is multiplied.

    The factor is 1 unless the residuals contradict the stated errors, that is, unless a chi-square
    at least as large has a probability below :data:`_CONTRADICTION_PROBABILITY_MAX`. In that case
    it is ``chi_square`` over ``residual_degrees`` (at least 1), times the square of Student's t at
    one standard deviation, because an error over a deviation estimated from residuals follows
    Student's t. The scaled deviation covers 68 % of the errors.

    Parameters
    ----------
    chi_square
        (n,): weighted sum of squared residuals.
    degrees_of_freedom
        (n,): expectation of `chi_square` for true errors.
    residual_degrees
        (n,): effective number of degrees of freedom of the residuals.
    """
    n_residual_degrees = np.maximum(residual_degrees, 1)
    scale = (
        chi_square
        / n_residual_degrees
        * stdtrit(n_residual_degrees, _BELOW_MEAN_PLUS_SIGMA_PROBABILITY) ** 2
    )
    return np.where(_residuals_contradict_errors(chi_square, degrees_of_freedom), scale, 1.0)


def _residuals_contradict_errors(
    chi_square: np.ndarray, degrees_of_freedom: np.ndarray
) -> np.ndarray:
    """Return a mask (...,), True for solutions whose residuals contradict the stated errors.

    For these the probability, under the stated errors, of a chi-square at least as large is below
    :data:`_CONTRADICTION_PROBABILITY_MAX`.
    """
    return (degrees_of_freedom > 0) & (
        chi_square > chdtri(np.maximum(degrees_of_freedom, 1), _CONTRADICTION_PROBABILITY_MAX)
    )


class _GroundPlane(NamedTuple):
    """Planes fitted to the ground points of n cycles; arrays are (n,) unless stated otherwise."""

    platform_height: np.ndarray
    """(n,): height of the platform above the plane [m]."""
    platform_height_variance: np.ndarray
    """(n,): variance of the error of ``platform_height`` [m^2]."""
    chi_square: np.ndarray
    """(n,): sum of squared residuals of the ground points, each divided by its variance."""
    gradient: np.ndarray
    """(2, n): gradient (rise over run) of the plane along x and y."""
    n_fitted_slopes: np.ndarray
    """(n,): effective number, 0..2, of the plane's two slopes that the ground points determine. The
    rest is determined by the prior of the slope."""
    centroid_height_variance: np.ndarray
    """(n,): variance of the height of the ground points' weighted mean [m^2]. It is 1 over the sum
    of the inverse variances of the points' heights."""


def _fit_plane(
    ground_points: np.ndarray, directions: np.ndarray, errors: np.ndarray, is_used: np.ndarray,
    gradient: np.ndarray, slope: float, relief: float,
) -> _GroundPlane:  # fmt: skip
    """Fit a plane to the ground points of each of n cycles by weighted least squares.

    Parameters
    ----------
    ground_points, directions, errors
        Results of :func:`_ground_points`.
    is_used
        (b, n) bool: beams whose points determine the plane.
    gradient
        (2, n): estimate of the plane's gradient, on which the weights depend.
    slope, relief
        As in :func:`solve_altitude`.

    Notes
    -----
    The plane is z = -altitude + gradient . (x, y) with the platform at the origin. An error of
    range moves a point off the plane by the error times ``gradient . (u_x, u_y) - u_z``.
    """
    n_beams, n_cycles = is_used.shape
    (gradient_x, gradient_y), (u_x, u_y, u_z) = gradient, directions
    incidence_sine = gradient_x * u_x + gradient_y * u_y - u_z
    height_errors = errors * np.maximum(incidence_sine, GRAZING_SINE_MIN)
    weights = np.where(is_used, 1.0 / np.hypot(height_errors, relief), 0.0)
    weight_sum = np.asarray(
        sum(weights**2)
    )  # beam by beam, as NumPy's order of summation would depend on n
    weight_fractions = weights**2 / np.where(weight_sum > 0, weight_sum, 1.0)
    centroid = np.asarray(sum((ground_points * weight_fractions).swapaxes(0, 1)))
    weighted_offsets = weights * (ground_points - centroid[:, None])
    *weighted_xy, weighted_z = weighted_offsets
    centroid_x, centroid_y, centroid_z = centroid
    residual = np.zeros((n_cycles, n_beams + 2))
    residual[:, :n_beams] = weighted_z.T
    height, variance, gradient = -centroid_z, 1.0 / weight_sum, np.zeros((2, n_cycles))
    n_fitted_slopes = np.zeros(n_cycles)
    if slope > 0:
        design = np.zeros((n_cycles, n_beams + 2, 2))
        design[:, :n_beams] = np.array(weighted_xy).T
        design[:, n_beams, 0] = design[:, n_beams + 1, 1] = 1.0 / slope
        right_vectors, squared_singular_values, coordinates = _least_squares(design, residual)
        right_vectors, squared_singular_values, coordinates = (
            right_vectors.T,
            squared_singular_values.T,
            coordinates.T,
        )  # cycles last
        for k in range(2):
            vector_x, vector_y = right_vectors[k]
            centroid_along = centroid_x * vector_x + centroid_y * vector_y
            height = height + centroid_along * coordinates[k]
            variance = variance + centroid_along**2 / squared_singular_values[k]
            gradient = gradient + right_vectors[k] * coordinates[k]
            n_fitted_slopes = n_fitted_slopes + 1.0 - 1.0 / (slope**2 * squared_singular_values[k])
    chi_square = np.asarray(sum(residual.T**2))
    return _GroundPlane(height, variance, chi_square, gradient, n_fitted_slopes, 1.0 / weight_sum)


def _flatten_cycles(
    direction: np.ndarray, value: np.ndarray, standard_error: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, tuple[int, ...]]:
    """Broadcast measurements of beams, and flatten their leading dimensions to n cycles.

    Parameters
    ----------
    direction
        (..., b, 3): unit vectors of the beams.
    value, standard_error
        (..., b): measured values and their standard errors.

    Returns
    -------
    tuple
        Directions (n, b, 3), values (n, b), errors (n, b), and the leading dimensions.
    """
    u, value, error = (np.asarray(a, float) for a in (direction, value, standard_error))
    leading_shape = np.broadcast_shapes(u.shape[:-1], value.shape, error.shape)
    u = np.broadcast_to(u, (*leading_shape, 3)).reshape(-1, leading_shape[-1], 3)
    value, error = (
        np.broadcast_to(a, leading_shape).reshape(-1, leading_shape[-1]) for a in (value, error)
    )
    return u, value, error, leading_shape[:-1]


def _least_squares(
    design: np.ndarray, residual: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Solve n linear least-squares problems by singular value decomposition.

    The condition number is not squared, as it would be by normal equations.

    Parameters
    ----------
    design
        (n, b, m): design matrices.
    residual
        (n, b): observations; replaced by the residuals.

    Returns
    -------
    tuple
        Right singular vectors (n, m, m), squared singular values and coordinates (n, m). The
        unknowns of problem i are ``right_vectors[i] @ coordinates[i]``.
    """
    n, b, m = design.shape
    padded_design = np.pad(design, ((0, 0), (0, max(m - b, 0)), (0, 0)))
    left_vectors, singular_values, right_vectors = np.linalg.svd(padded_design, full_matrices=False)
    coordinates = np.empty((n, m))
    for k in range(m):
        left_vector = left_vectors[:, :b, k]
        projection = np.asarray(sum((left_vector * residual).T))  # beam by beam, as in _fit_plane
        residual -= projection[:, None] * left_vector
        coordinates[:, k] = projection / singular_values[:, k]
    return right_vectors.mT, singular_values**2, coordinates


def _solve_without_false_beams(
    fit_cycles: Callable[[np.ndarray, np.ndarray], FittedCycles],
    is_valid: np.ndarray,
    test_level: float | None,
    leading_shape: tuple[int, ...],
) -> NavigationSolution:
    """Fit a velocity or altitude to each of n cycles, without a beam that contradicts the others.

    Parameters
    ----------
    fit_cycles
        Function of the indices (k,) of cycles, and of a mask (k, b) of the beams to use. It returns
        the fit of these cycles.
    is_valid
        (n, b) bool: beams with a return.
    test_level
        Probability with which the test for a false beam rejects a cycle of true beams; None for no
        test.
    leading_shape
        Dimensions into which the n cycles of the result are reshaped; their product is n.

    Notes
    -----
    A cycle is suspect if its chi-square exceeds the value that true beams exceed with the
    probability `test_level`. Each beam is then excluded in turn. If exactly one such fit passes the
    same test, that beam is false and that fit is the solution. Otherwise the solution is withheld.
    With one degree of freedom every exclusion leaves an exact fit: a contradiction is noticed, but
    the false beam is never identified.
    """
    is_used, n_beams = is_valid.copy(), is_valid.shape[1]
    fitted = fit_cycles(np.arange(len(is_valid)), is_used)
    value, covariance, chi_square, degrees_of_freedom = fitted
    status = np.where(np.isnan(chi_square), STATUS_UNDETERMINED, STATUS_SOLVED).astype(np.int8)
    if test_level is not None:
        chi_square_max = np.concatenate([[np.inf], chdtri(np.arange(1, n_beams + 1), test_level)])
        suspect_cycles = np.flatnonzero(chi_square > chi_square_max[degrees_of_freedom])
        passes_without = np.zeros((suspect_cycles.size, n_beams), bool)
        for beam in range(n_beams):
            trial = fit_cycles(
                suspect_cycles, is_used[suspect_cycles] & (np.arange(n_beams) != beam)
            )
            passes_without[:, beam] = trial.chi_square <= chi_square_max[trial.degrees_of_freedom]
        has_one_false = passes_without.sum(axis=1) == 1
        status[suspect_cycles] = np.where(has_one_false, STATUS_EXCLUDED, STATUS_WITHHELD)
        corrected_cycles = suspect_cycles[has_one_false]
        is_used[corrected_cycles, passes_without[has_one_false].argmax(axis=1)] = False
        for all_values, corrected_values in zip(
            fitted, fit_cycles(corrected_cycles, is_used[corrected_cycles]), strict=True
        ):
            all_values[corrected_cycles] = corrected_values
    value[status > STATUS_EXCLUDED] = covariance[status > STATUS_EXCLUDED] = np.nan
    return NavigationSolution(
        *(a.reshape(leading_shape + a.shape[1:]) for a in (*fitted, is_used, status))
    )


def solve_navigation(
    shot_arrays: ArraysByName,
    point_arrays: ArraysByName,
    *,
    shots_per_cycle: int,
    ground_slope: float,
    test_level: float | None = None,
    relief: float = 0.0,
    pointing_jitter: float = 0.0,
    error_floor: ErrorFloor = NO_ERROR_FLOOR,
    motion_priors: MotionPriors = MotionPriors(),  # noqa: B008  # a tuple
) -> dict[str, np.ndarray]:
    """Solve for the instrument's velocity and altitude in every measurement cycle and draw.

    Parameters
    ----------
    shot_arrays
        Arrays of :data:`sweep.model.outputs.SHOT_GEOMETRY_VARIABLES` by name, cycle by cycle.
    point_arrays
        Arrays of :data:`sweep.model.outputs.POINT_CLOUD_VARIABLES` by name, cycle by cycle.
        Positions are used if `error_floor` has an error of pointing.
    shots_per_cycle
        Number of shots in a cycle.
    ground_slope, relief
        Standard deviations of slope and relief of the ground, as in :func:`solve_altitude`.
    test_level
        Probability with which the test for one false beam rejects a cycle of true beams; None or 0
        for no test.
    pointing_jitter
        Standard deviation of the pointing jitter about each axis [rad].
    error_floor
        Standard deviations of the instrument's errors that do not depend on the echo.
    motion_priors
        Priors of unknown motion that the points' standard errors include.

    Returns
    -------
    dict of str to ndarray
        Arrays of :data:`sweep.model.outputs.NAVIGATION_VARIABLES` by name. A cycle without a
        solution has 0 as its number of beams.
    """
    n, draws = point_arrays["flags"].shape[:2]
    cycles = n // shots_per_cycle
    sizes = {"cycle": cycles, "draw": draws, "xyz": 3, "xyz_again": 3}
    results = {name: output.empty_array(sizes) for name, output in NAVIGATION_VARIABLES.items()}
    step = max(1, BEAMS_PER_BATCH // max(1, shots_per_cycle * draws))
    for first in range(0, cycles, step):
        cycle_slice = slice(first, min(first + step, cycles))
        shot_slice = slice(cycle_slice.start * shots_per_cycle, cycle_slice.stop * shots_per_cycle)
        beam_motion = BeamMotion(
            *(shot_arrays[name][shot_slice] for name in _BEAM_MOTION_VARIABLES)
        )
        known_motion = assumed_motion_along_beams(
            beam_motion.direction,
            beam_motion.platform_velocity,
            beam_motion.direction_rate,
            beam_motion.platform_acceleration,
            motion_priors,
        )
        solutions = _solve_cycles(
            beam_motion.reshape_by_cycle(shots_per_cycle),
            _select_points(point_arrays, shot_slice, shots_per_cycle, error_floor, known_motion),
            {"test_level": test_level or None},
            {"slope": ground_slope, "relief": relief},
            pointing_jitter,
            error_floor,
        )
        for quantity, spread_name, solution in solutions:
            n_beams = np.where(solution.is_available, solution.is_beam_used.sum(axis=-1), 0)
            results[quantity][cycle_slice] = solution.estimate
            results[f"{quantity}_{spread_name}"][cycle_slice] = solution.covariance
            results[f"{quantity}_status"][cycle_slice] = solution.status
            results[f"{quantity}_beams"][cycle_slice] = n_beams
    return results


_BEAM_MOTION_VARIABLES = (
    "platform_position", "platform_velocity", "beam_direction", "beam_turning",
    "platform_acceleration",
)  # fmt: skip
"""Names of the output variables that fill the fields of :class:`BeamMotion`, in the order of the
fields."""


class BeamMotion(NamedTuple):
    """Motion of the instrument and of its beam in each shot.

    Arrays are (..., 3), in the axes of the world frame.
    """

    platform_position: np.ndarray
    """(..., 3): position of the instrument in the world's frame [m]."""
    platform_velocity: np.ndarray
    """(..., 3): velocity of the instrument in the world's frame [m/s]."""
    direction: np.ndarray
    """(..., 3): unit vector along the beam, away from the instrument."""
    direction_rate: np.ndarray
    """(..., 3): time derivative of the beam's ``direction`` [1/s]."""
    platform_acceleration: np.ndarray
    """(..., 3): acceleration of the instrument in the world's frame [m/s^2]."""

    def reshape_by_cycle(self, beams_per_cycle: int) -> "BeamMotion":
        """Return the record with its arrays (n, 3) of n shots reshaped to (cycles, beams, 3)."""
        return BeamMotion(*(values.reshape(-1, beams_per_cycle, 3) for values in self))


def _select_points(
    point_arrays: ArraysByName,
    shot_slice: slice,
    shots_per_cycle: int,
    error_floor: ErrorFloor,
    known_motion: EgoMotion,
) -> dict[str, np.ndarray]:
    """Return, for each shot and draw, the point that navigation uses.

    It is the first point that a Doppler peak confirms and whose values and standard errors are
    finite.

    Parameters
    ----------
    point_arrays
        Arrays of :data:`sweep.model.outputs.POINT_CLOUD_VARIABLES` by name.
    shot_slice
        The shots, those of whole cycles.
    shots_per_cycle
        Number of shots in a cycle.
    error_floor
        Standard deviations of the instrument's errors that do not depend on the echo.
    known_motion
        Motion along the beams of these shots, as the instrument knows it.

    Returns
    -------
    dict of str to ndarray
        Arrays (cycles, draws, beams), nan for a shot without such a point. The slip is the closing
        speed minus the speed at which the range falls. Standard errors exclude errors common to all
        beams and errors due to an unknown slip. The names are ``range`` and ``radial_velocity``,
        and both with ``_standard_error``; ``radial_velocity_slip_error``, the error due to an
        unknown slip [m/s]; ``velocity_per_slip``; ``delay``, the time from the shot's start to that
        of the beats [s]; ``range_then``, the range at that time [m]. If pointing has an error,
        ``position`` (cycles, draws, beams, 3) [m].
    """
    flags = point_arrays["flags"][shot_slice]
    values_by_name: dict[str, np.ndarray] = {}
    is_trusted = (flags != 0) & (flags & UNCONFIRMED_FLAG == 0)
    for name, common_error in (
        ("range", error_floor.clock),
        ("radial_velocity", error_floor.velocity_scale_error),
    ):
        value, error = (
            point_arrays[f"{name}_interpolated{suffix}"][shot_slice]
            for suffix in ("", "_standard_error")
        )
        if common_error > 0:
            error = np.sqrt(np.maximum(error**2 - (common_error * value) ** 2, 0.0))
        per_slip = point_arrays[f"{name}_per_slip"][shot_slice]
        slip_error = abs(per_slip) * known_motion.slip_standard_error(
            point_arrays["range_interpolated"][shot_slice]
        )
        # The slip's error depends on the range, and so is known no better than the clock.
        error_min = (
            2 * math.sqrt(error_floor.clock + _RELATIVE_VARIANCE_ROUNDING_ERROR) * slip_error
        )
        error = np.sqrt(np.maximum(error**2 - slip_error**2, error_min**2))
        if name == "range":
            range_at_delay = value - per_slip * known_motion.approach_speed_at(value)
            values_by_name |= {"delay": per_slip, "range_then": range_at_delay}
        else:
            values_by_name |= {
                "velocity_per_slip": per_slip,
                "radial_velocity_slip_error": slip_error,
            }
        error = np.maximum(
            error,
            _INTERPOLATION_ERROR_RATIO_MIN * point_arrays[f"{name}_standard_error"][shot_slice],
        )
        is_trusted &= np.isfinite(value) & np.isfinite(error) & (error > 0)
        values_by_name |= {name: value, f"{name}_standard_error": error}
    first_return, has_none = is_trusted.argmax(axis=2)[..., None], ~is_trusted.any(axis=2)
    beams = {}
    if error_floor.pointing > 0:
        selected = np.take_along_axis(
            point_arrays["position"][shot_slice], first_return[..., None], axis=2
        )[:, :, 0]
        beams["position"] = selected.reshape(-1, shots_per_cycle, *selected.shape[1:]).swapaxes(
            1, 2
        )
    for name, values in values_by_name.items():
        selected = np.take_along_axis(values, first_return, axis=2)[..., 0]
        selected[has_none] = np.nan
        beams[name] = selected.reshape(-1, shots_per_cycle, selected.shape[1]).swapaxes(1, 2)
    return beams


def _solve_cycles(
    beam_motion: BeamMotion, beams: dict[str, np.ndarray], test_arguments: dict,
    ground_arguments: dict, pointing_jitter: float, error_floor: ErrorFloor,
) -> list[tuple[str, str, NavigationSolution]]:  # fmt: skip
    """Solve for the instrument's velocity and altitude in measurement cycles, in all draws.

    Parameters
    ----------
    beam_motion
        Motion of the instrument and its beams, (cycles, beams, 3).
    beams
        Measurements, as in :func:`_select_points`.
    test_arguments, ground_arguments
        Arguments ``test_level``, and ``slope`` and ``relief``, of :func:`solve_altitude`.
    pointing_jitter
        Standard deviation of the pointing jitter about each axis [rad].
    error_floor
        Standard deviations of the instrument's errors that do not depend on the echo.

    Returns
    -------
    list of tuple
        Name of the quantity, name of its spread (``covariance`` or ``variance``), and solution.
    """
    positions, velocities, direction, direction_rates, _ = beam_motion
    velocity_offset = np.einsum(
        "cbi,cbi->cb", direction, velocities - velocities.mean(axis=1, keepdims=True)
    )
    beams = beams | {"radial_velocity": beams["radial_velocity"] - velocity_offset[:, None]}
    if pointing_jitter > 0 or error_floor.pointing > 0:
        offset = (positions - positions[:, :1])[:, None]
        beams = beams | _add_pointing_errors(
            direction, offset, beams, ground_arguments, pointing_jitter, error_floor.pointing
        )
    known_directions, delay = direction[:, None], beams["delay"][..., None]
    if error_floor.pointing > 0:
        known_directions = (beams["position"] - positions[:, None]) / beams["range"][..., None]
    ground_points = ground_arguments | {
        "direction": known_directions + delay * direction_rates[:, None],
        "range": beams["range_then"],
        "standard_error": beams["range_standard_error"],
        "offset": (positions - positions[:, :1])[:, None] + delay * velocities[:, None],
    }
    altitude_solution = solve_altitude(**ground_points, **test_arguments)
    is_used = altitude_solution.is_beam_used & altitude_solution.is_available[..., None]
    gradient = ground_gradient(**ground_points, is_used=is_used)
    missing_slip = _slip_due_to_ground_gradient(beam_motion, beams["range"], gradient)
    unknown_slip = beams["radial_velocity_slip_error"]
    if ground_arguments["relief"] == 0:
        is_plane = altitude_solution.is_available & ~_residuals_contradict_errors(
            altitude_solution.chi_square, altitude_solution.degrees_of_freedom
        )
        unknown_slip = np.where(is_plane[..., None], 0.0, unknown_slip)
    velocity_solution = solve_velocity(
        direction=direction[:, None],
        radial_velocity=beams["radial_velocity"] - beams["velocity_per_slip"] * missing_slip,
        standard_error=np.hypot(beams["radial_velocity_standard_error"], unknown_slip),
        **test_arguments,
    )
    if error_floor.velocity_scale_error > 0:
        common_variance = (
            error_floor.velocity_scale_error**2
            * velocity_solution.estimate[..., None]
            * velocity_solution.estimate[..., None, :]
        )
        velocity_solution = velocity_solution._replace(
            covariance=velocity_solution.covariance + common_variance
        )
    if error_floor.clock > 0:
        common_variance = (error_floor.clock * altitude_solution.estimate) ** 2
        altitude_solution = altitude_solution._replace(
            covariance=altitude_solution.covariance + common_variance
        )
    # The ground straight below is also off the plane.
    altitude_solution = altitude_solution._replace(
        covariance=altitude_solution.covariance + ground_arguments["relief"] ** 2
    )
    return [
        ("velocity", "covariance", velocity_solution),
        ("altitude", "variance", altitude_solution),
    ]


def _slip_due_to_ground_gradient(
    beam_motion: BeamMotion, ranges: np.ndarray, gradient: np.ndarray
) -> np.ndarray:
    """Return the slip over a sloping plane minus the slip over level ground [m/s].

    The slip is the closing speed minus the speed at which the range falls. The result is (cycles,
    draws, beams).

    Parameters
    ----------
    beam_motion
        Motion of the instrument and its beams, (cycles, beams, 3).
    ranges
        (cycles, draws, beams): ranges R [m].
    gradient
        (cycles, draws, 2): gradient of the plane along x and y.

    Notes
    -----
    Let V be the instrument's velocity, d the beam's direction, d' its time derivative, z the
    vertical and n the normal of the plane. With W = V + R d' the result is W.z / d.z - W.n / d.n.
    It is 0 for beams that do not point down at both planes.
    """
    _, velocity, direction, direction_rates, _ = beam_motion
    d_x, d_y, d_z = (direction[:, None, :, k] for k in range(3))
    w_x, w_y, w_z = (
        velocity[:, None, :, k] + ranges * direction_rates[:, None, :, k] for k in range(3)
    )
    gradient_x, gradient_y = gradient[..., :1], gradient[..., 1:]
    plane_sine = d_z - gradient_x * d_x - gradient_y * d_y
    points_down = (d_z < -DEPRESSION_SINE_MIN) & (plane_sine < -DEPRESSION_SINE_MIN)
    slip = w_z / np.where(points_down, d_z, -1.0)
    slip = slip - (w_z - gradient_x * w_x - gradient_y * w_y) / np.where(
        points_down, plane_sine, -1.0
    )
    return np.where(points_down, slip, 0.0)


def _add_pointing_errors(
    direction: np.ndarray,
    offset: np.ndarray,
    beams: ArraysByName,
    ground_arguments: dict,
    pointing_jitter: float,
    pointing: float,
) -> dict[str, np.ndarray]:
    """Return the standard errors of range and radial velocity, with errors of pointing included.

    Parameters
    ----------
    direction
        (cycles, beams, 3): unit vectors of the beams.
    offset
        (cycles, 1, beams, 3): position of the instrument relative to that at the first shot [m].
    beams
        Measurements, as in :func:`_select_points`.
    ground_arguments
        Arguments ``slope`` and ``relief`` of :func:`ground_gradient`.
    pointing_jitter
        Standard deviation of the pointing jitter about each axis [rad]. It adds to both errors.
    pointing
        Standard deviation of a beam's known direction [rad]. It adds to the error of the range. The
        error of the velocity already includes it.

    Returns
    -------
    dict of str to ndarray
        ``radial_velocity_standard_error`` and ``range_standard_error``, (cycles, draws, beams).
    """
    closing_speed, error = beams["radial_velocity"], beams["radial_velocity_standard_error"]
    first_velocity = solve_velocity(
        direction=direction[:, None], radial_velocity=closing_speed, standard_error=error
    ).estimate
    along_beam = np.einsum("cbi,cdi->cdb", direction, first_velocity)
    squared_across = np.sum(first_velocity**2, axis=2)[..., None] - along_beam**2
    speed_across = np.sqrt(np.maximum(np.nan_to_num(squared_across), 0.0))
    gradient = ground_gradient(
        direction=direction[:, None],
        range=beams["range"],
        offset=offset,
        standard_error=beams["range_standard_error"],
        is_used=np.isfinite(beams["range"]),
        **ground_arguments,
    )
    x, y = gradient[..., :1], gradient[..., 1:]
    d_x, d_y, d_z = (direction[:, None, :, k] for k in range(3))
    plane_sine = d_z - x * d_x - y * d_y  # d.n for the normal n = (-x, -y, 1)
    incidence_tangent = np.sqrt(np.maximum(1 + x**2 + y**2 - plane_sine**2, 0.0)) / np.maximum(
        -plane_sine, GRAZING_SINE_MIN
    )
    return {
        "radial_velocity_standard_error": np.hypot(error, pointing_jitter * speed_across),
        "range_standard_error": np.hypot(
            beams["range_standard_error"],
            np.hypot(pointing_jitter, pointing) * beams["range"] * incidence_tangent,
        ),
    }
