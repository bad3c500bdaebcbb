"""Floor of errors: what an instrument gets wrong however strong the echo is.

Five errors, normal with a mean of 0. With u a beam's direction, R and v_r the range and the radial
velocity that it reports, v the instrument's velocity and v_perp the part of v across the beam:

========== ============================= ================= ================== =================
error      standard deviation            of the range      of the velocity    independent
========== ============================= ================= ================== =================
clock      relative, of the sampling     R clock           v_r clock          none: common to
           clock                                                              all beams
wavelength relative, as it is known                        v_r wavelength     none: common to
                                                                              all beams
pointing   of the known direction on                       |v_perp| pointing  from beam to beam
           each of two axes [rad]
vibration  of the instrument along the                     vibration          from shot to shot
           beam [m/s]
range      of the range itself [m]       range noise                          from shot to shot
noise
========== ============================= ================= ================== =================

A range is that along the light's own way, however it is known to run; the point lies there along
the direction that the beam is thought to have. Common errors are one number each of a draw; the
pointing's, two of each beam and draw, which turn with the beam; vibration's and the range's, one of
each shot and draw. Common errors scale the velocity's vector and the altitude, and add the outer
product of the velocity, times their variance, to its covariance (:mod:`sweep.model.navigation`).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from sweep.model.philox import STREAM_ERROR_FLOOR, normals, point_keys, uniforms

if TYPE_CHECKING:
    from sweep.model.eyepoints import Eyepoints

DOMAIN = "sweep.error_floor"
"""Domain of the keys of errors that shots have in common."""

INSTRUMENT = -1.0
"""Number in the place of a beam's for errors that all beams share."""


class ErrorFloor(NamedTuple):
    """Standard deviations of an instrument's errors; all 0 for an instrument without any.

    >>> ErrorFloor(clock=0.03, wavelength=0.04).scale
    0.05
    """

    pointing: float = 0.0
    """Of a beam's known direction, on each of two axes [rad]."""
    clock: float = 0.0
    """Of the sampling clock, relative."""
    wavelength: float = 0.0
    """Of the known wavelength, relative."""
    vibration: float = 0.0
    """Of the instrument's velocity along the beam [m/s]."""
    range_noise: float = 0.0
    """Of ranges [m]."""

    @property
    def scale(self) -> float:
        """Relative standard deviation that all velocities share."""
        return float(np.hypot(self.clock, self.wavelength))

    def velocity_error(self, radial_velocity: np.ndarray, across: np.ndarray) -> np.ndarray:
        """Return the standard error of radial velocities [m/s] at a speed across the beam [m/s].

        >>> ErrorFloor(pointing=1e-3, vibration=0.03).velocity_error(0.0, 40.0).round(12).item()
        0.05
        """
        common = self.scale * np.asarray(radial_velocity)
        own = np.hypot(self.pointing * np.asarray(across), self.vibration)
        return np.asarray(np.hypot(common, own))


NO_FLOOR = ErrorFloor()


def stray(
    points: Mapping[str, np.ndarray],
    eyepoints: Eyepoints,
    floor: ErrorFloor,
    *,
    keys: np.ndarray,
    seed: int,
    first_draw: int = 0,
) -> dict[str, np.ndarray]:
    """Points with the instrument's errors in their values, places and standard errors.

    `points` are results of :func:`sweep.model.clouds.cloud`, of the n shots of `eyepoints` and some
    draws, from `first_draw` on; `keys` (n, 2) the random key of each shot; `seed` the study's, for
    errors that shots share. New are range, radial velocity and their standard errors, by whole bins
    and interpolated, the compensated velocity, and position. The truth stays.
    """
    n, draws = points["flags"].shape[:2]
    number = np.arange(first_draw, first_draw + draws)
    clock, wavelength = _drawn(np.array([INSTRUMENT]), number, seed)[0].T
    every, whose = np.unique(eyepoints.beam, return_inverse=True)
    turned = floor.pointing * _drawn(every.astype(float), number, seed)[whose]
    drawn = uniforms(np.repeat(keys, draws, axis=0), np.tile(number, n), STREAM_ERROR_FLOOR, 2)
    vibration, noise = normals(drawn).T.reshape(2, n, draws, 1)
    shaken, noise = floor.vibration * vibration, floor.range_noise * noise
    direction, velocity = eyepoints.direction[:, None], eyepoints.velocity[:, None]
    first, second = _frame(eyepoints.direction)
    off = turned[..., :1] * first[:, None] + turned[..., 1:] * second[:, None]
    across = velocity - _dot(velocity, direction) * direction
    across = np.sqrt(_dot(across, across))
    stretched = (1.0 + floor.clock * clock)[:, None]
    scaled = stretched + floor.wavelength * wavelength[:, None]
    moved = shaken - _dot(off, velocity)
    new = dict(points)
    for suffix in ("", "_interpolated"):
        far, closing = f"range{suffix}", f"radial_velocity{suffix}"
        new[far] = points[far] * stretched + noise
        new[closing] = points[closing] * scaled + moved
        far_error = np.hypot(floor.clock * np.abs(new[far]), floor.range_noise)
        errors = far_error, floor.velocity_error(new[closing], across)
        for name, error in zip((far, closing), errors, strict=True):
            stated = f"{name}_standard_error"
            new[stated] = np.hypot(points[stated], error)
    known = direction + off
    known /= np.sqrt(_dot(known, known))
    reach = new["range_interpolated"][..., None] * known[:, :, None]
    own = eyepoints.own_velocity[:, None, None]
    new["radial_velocity_compensated"] = new["radial_velocity_interpolated"] - own
    new["position"] = eyepoints.position[:, None, None] + reach
    return new


def _drawn(beams: np.ndarray, draws: np.ndarray, seed: int) -> np.ndarray:
    """Two standard normal numbers of each beam in each draw, (beams, draws, 2)."""
    keys = np.repeat(point_keys(beams[:, None], domain=DOMAIN, seed=seed), draws.size, axis=0)
    found = normals(uniforms(keys, np.tile(draws, beams.size), STREAM_ERROR_FLOOR, 2))
    return found.reshape(beams.size, draws.size, 2)


def _dot(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Scalar products (..., 1) of vectors (..., 3), summed in the same order whatever the shape."""
    return sum(one[..., k : k + 1] * other[..., k : k + 1] for k in range(3))  # type: ignore[return-value]


def _frame(direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors (n, 3) across each direction (n, 3), which turn steadily with it.

    [Duff et al., Building an Orthonormal Basis, Revisited, JCGT 6(1), 2017]
    """
    x, y, z = direction.T
    sign = np.copysign(1.0, z)
    a = -1.0 / (sign + z)
    b = x * y * a
    first = np.stack([1.0 + sign * x * x * a, sign * b, -sign * x], axis=-1)
    return first, np.stack([b, sign + y * y * a, -y], axis=-1)
