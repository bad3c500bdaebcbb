"""Error floor: errors of an instrument that do not depend on the strength of the echo.

There are five errors, normal with a mean of 0. Let u be a beam's direction, R and v_r the reported
range and radial velocity, v the instrument's velocity, and v_perp its component across the beam:

========== ============================= ================= ================== =================
error      standard deviation            of the range      of the velocity    independent
========== ============================= ================= ================== =================
clock      relative, of the sampling     R clock           v_r clock          no: common to
           clock                                                              all beams
wavelength relative, of the known                          v_r wavelength     no: common to
           wavelength                                                         all beams
pointing   of the known direction, on                      |v_perp| pointing  from beam to beam
           each of two axes [rad]
vibration  of the instrument's velocity                    vibration          from shot to shot
           along the beam [m/s]
range      of the range itself [m]       range noise                          from shot to shot
noise
========== ============================= ================= ================== =================

The range is measured along the true path of the light, whatever the known direction is. A point is
at this range along the known direction of the beam. Common errors are one random number in each
draw. Pointing errors are two numbers for each beam and draw, and rotate with the beam. Vibration
and range noise are one number each for each shot and draw. Common errors scale the velocity vector
and the altitude. They add the outer product of the velocity, times their variance, to its
covariance (:mod:`sweep.model.pointcloud.navigation`).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from sweep.model.sampling.philox import STREAM_ERROR_FLOOR, point_keys, to_normals_by_row, uniforms

if TYPE_CHECKING:
    from sweep.model.pointcloud.eyepoints import Eyepoints

ERROR_FLOOR_KEY_DOMAIN = "sweep.error_floor"
"""Text that is hashed into the random keys of errors that several shots share, so that these keys
differ from other keys."""

INSTRUMENT_KEY_NUMBER = -1.0
"""Number that replaces the number of a beam in the random key of errors common to all beams."""


class ErrorFloor(NamedTuple):
    """Standard deviations of an instrument's errors that do not depend on the echo.

    All are 0 for an instrument without such errors.

    >>> ErrorFloor(clock=0.03, wavelength=0.04).velocity_scale_error
    0.05
    """

    pointing: float = 0.0
    """Standard deviation of the error of a beam's known direction, on each of two axes [rad]."""
    clock: float = 0.0
    """Standard deviation of the relative error of the sampling clock's frequency [1]."""
    wavelength: float = 0.0
    """Standard deviation of the relative error of the known wavelength [1]."""
    vibration: float = 0.0
    """Standard deviation of the instrument's velocity along the beam due to its vibration [m/s].
    """
    range_noise: float = 0.0
    """Standard deviation of a random error that is added to each measured range [m]."""

    @property
    def velocity_scale_error(self) -> float:
        """Standard deviation of the relative error common to all radial velocities of a draw.

        It is the root of ``clock`` squared plus ``wavelength`` squared.
        """
        return float(np.hypot(self.clock, self.wavelength))

    def velocity_error(self, radial_velocity: np.ndarray, speed_across: np.ndarray) -> np.ndarray:
        """Return the standard errors of radial velocities [m/s] due to the instrument's errors.

        The squared error is

            v_r^2 (clock^2 + wavelength^2) + |v_perp|^2 pointing^2 + vibration^2.

        Parameters
        ----------
        radial_velocity : ndarray
            Measured radial velocity v_r [m/s]. Its sign does not matter.
        speed_across : ndarray
            Speed |v_perp| of the instrument across the beam [m/s], not negative. Both arrays
            broadcast.

        Returns
        -------
        ndarray
            Standard errors [m/s].

        Examples
        --------
        >>> ErrorFloor(pointing=1e-3, vibration=0.03).velocity_error(0.0, 40.0).round(12).item()
        0.05
        """
        common_error = self.velocity_scale_error * np.asarray(radial_velocity)
        independent_error = np.hypot(self.pointing * np.asarray(speed_across), self.vibration)
        return np.asarray(np.hypot(common_error, independent_error))


NO_ERROR_FLOOR = ErrorFloor()
""":class:`ErrorFloor` with all standard deviations 0: all errors of the instrument depend on the
echo."""


def apply_error_floor(
    points: Mapping[str, np.ndarray],
    eyepoints: Eyepoints,
    error_floor: ErrorFloor,
    *,
    keys: np.ndarray,
    seed: int,
    first_draw: int = 0,
) -> dict[str, np.ndarray]:
    """Add an instrument's random errors to measured points, and to their standard errors.

    Errors are added to ranges and radial velocities, computed from whole bins as well as from
    interpolated positions. Compensated velocities and positions change accordingly. True values are
    unchanged.

    Parameters
    ----------
    points
        Results (n, draws, ...) of :func:`sweep.model.pointcloud.point_cloud.simulate_cloud`.
    eyepoints
        Geometry of the n shots.
    error_floor
        Standard deviations of the errors.
    keys
        (n, 2) uint64: random key of each shot.
    seed
        Seed of the study, for errors that shots share.
    first_draw
        Number of the first draw in `points`.

    Returns
    -------
    dict of str to ndarray
        `points` with changed arrays.
    """
    n, draws = points["flags"].shape[:2]
    draw_numbers = np.arange(first_draw, first_draw + draws)
    (instrument_normals,) = _draw_normal_numbers_by_beam(
        np.array([INSTRUMENT_KEY_NUMBER]), draw_numbers, seed
    )
    clock, wavelength = instrument_normals.T
    beam_numbers, beam_index = np.unique(eyepoints.beam, return_inverse=True)
    pointing_errors = (
        error_floor.pointing
        * _draw_normal_numbers_by_beam(beam_numbers.astype(float), draw_numbers, seed)[beam_index]
    )
    uniform_numbers = uniforms(
        np.repeat(keys, draws, axis=0), np.tile(draw_numbers, n), STREAM_ERROR_FLOOR, 2
    )
    vibration, range_errors = to_normals_by_row(uniform_numbers).T.reshape(2, n, draws, 1)
    vibration_errors, range_errors = (
        error_floor.vibration * vibration,
        error_floor.range_noise * range_errors,
    )
    direction, velocity = eyepoints.direction[:, None], eyepoints.velocity[:, None]
    first_axis, second_axis = _transverse_axes(eyepoints.direction)
    direction_errors = (
        pointing_errors[..., :1] * first_axis[:, None]
        + pointing_errors[..., 1:] * second_axis[:, None]
    )
    speed_across = velocity - _scalar_product(velocity, direction) * direction
    speed_across = np.sqrt(_scalar_product(speed_across, speed_across))
    range_factor = (1.0 + error_floor.clock * clock)[:, None]
    velocity_factor = range_factor + error_floor.wavelength * wavelength[:, None]
    velocity_errors = vibration_errors - _scalar_product(direction_errors, velocity)
    results = dict(points)
    for suffix in ("", "_interpolated"):
        range_name, velocity_name = f"range{suffix}", f"radial_velocity{suffix}"
        results[range_name] = points[range_name] * range_factor + range_errors
        results[velocity_name] = points[velocity_name] * velocity_factor + velocity_errors
        range_error = np.hypot(
            error_floor.clock * np.abs(results[range_name]), error_floor.range_noise
        )
        errors = range_error, error_floor.velocity_error(results[velocity_name], speed_across)
        for name, error in zip((range_name, velocity_name), errors, strict=True):
            error_name = f"{name}_standard_error"
            results[error_name] = np.hypot(points[error_name], error)
    stated_direction = direction + direction_errors
    stated_direction /= np.sqrt(_scalar_product(stated_direction, stated_direction))
    displacement = results["range_interpolated"][..., None] * stated_direction[:, :, None]
    platform_velocity = eyepoints.platform_radial_velocity[:, None, None]
    results["radial_velocity_compensated"] = (
        results["radial_velocity_interpolated"] - platform_velocity
    )
    results["position"] = eyepoints.position[:, None, None] + displacement
    return results


def _draw_normal_numbers_by_beam(
    beam_numbers: np.ndarray, draw_numbers: np.ndarray, seed: int
) -> np.ndarray:
    """Draw two standard normal random numbers for each beam and draw, (beams, draws, 2).

    A beam's two numbers are the errors of its pointing about two axes, in standard deviations. The
    numbers for INSTRUMENT_KEY_NUMBER in place of a beam are the errors of clock and wavelength.
    """
    keys = np.repeat(
        point_keys(beam_numbers[:, None], domain=ERROR_FLOOR_KEY_DOMAIN, seed=seed),
        draw_numbers.size,
        axis=0,
    )
    normal_numbers = to_normals_by_row(
        uniforms(keys, np.tile(draw_numbers, beam_numbers.size), STREAM_ERROR_FLOOR, 2)
    )
    return normal_numbers.reshape(beam_numbers.size, draw_numbers.size, 2)


def _scalar_product(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return scalar products (..., 1) of vectors (..., 3), summed in the order of components."""
    return sum(first[..., k : k + 1] * second[..., k : k + 1] for k in range(3))  # type: ignore[return-value]


def _transverse_axes(direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return two unit vectors perpendicular to each direction and to each other.

    ``direction`` holds unit vectors (n, 3). The result is a pair of arrays (n, 3). Both vary
    continuously with the direction.

    References
    ----------
    .. [1] Duff et al., Building an Orthonormal Basis, Revisited, JCGT 6(1), 2017.
    """
    x, y, z = direction.T
    sign = np.copysign(1.0, z)
    a = -1.0 / (sign + z)
    b = x * y * a
    first_axis = np.stack([1.0 + sign * x * x * a, sign * b, -sign * x], axis=-1)
    return first_axis, np.stack([b, sign + y * y * a, -y], axis=-1)
