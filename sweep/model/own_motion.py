"""Motion of the instrument within a shot, as far as it knows it, and the errors that are left.

The beats of a shot tell range and radial velocity some milliseconds after its start, and tell them
wrong while the closing speed grows. Let the segments start at t_i, with optical frequencies f_i and
chirp rates r_i, and their records' middles lie t_c after. The beam sees scatterers that close at v
and accelerate at a, and ground that comes nearer along it at u. To first order the beats are

    f_i (2/c) (v + a (t_i + t_c)) - r_i (2/c) (R - u t_i - (v + u) t_c - a (t_i^2 + ...) / 2)

and the fit takes a = 0 and u = v. The rest of each beat,

    (2/c) f_i a (t_i + t_c)
    - (2/c) r_i [ (v - u) (t_i + t_c) - a (t_i^2 / 2 + 2 t_i t_c + 3/2 t_c^2) ],

moves range and velocity by the same fit, which is linear. For Table 4.1 11 m/s^2 move the range by
0.55 m, and so does a beam that turns by 20 deg/s, through a = V.d'.

**Known motion.** By inertial sensors and its scanner it knows its velocity V, its
acceleration V' and the rate d' at which the beam d turns: so it knows a = V'.d + V.d' for ground at
rest. It takes the ground to be level (:func:`own_motion`): then a beam that points down meets it at
a range that falls by u = (V + R d').z / d.z. A beam that points nowhere near the ground is taken to
meet a surface that faces it, along which nothing slides. Range and velocity are corrected for both.

**Unknown motion.** The instrument does not know the slope of the ground or the motion of a body
that is hit. The changes of range and velocity that these make are added to the standard errors in
quadrature, in their true size.

The angular acceleration is left out on both sides (:mod:`sweep.model.geometry.platform`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from sweep.model.eyepoints import Eyepoints

LEAST_DESCENT = 0.05
"""Sine of the angle below the horizon from which on a beam is taken to meet level ground."""


class OwnMotion(NamedTuple):
    """Motion of n shots' beams that the instrument knows; arrays (n,)."""

    acceleration: np.ndarray
    """Rate at which the closing speed of ground at rest grows [m/s^2]."""
    slip: np.ndarray
    """Closing speed less the speed at which the range of level ground falls, at range 0 [m/s]."""
    slip_by_range: np.ndarray
    """Growth of that difference with the range [1/s]."""

    def slip_at(self, distance: np.ndarray) -> np.ndarray:
        """Return the closing speed less the speed at which ranges (n, ...) [m] fall [m/s]."""
        dims = np.ndim(distance) - 1
        slip, by_range = (v.reshape(-1, *[1] * dims) for v in (self.slip, self.slip_by_range))
        return np.asarray(slip + by_range * distance)


def own_motion(eyepoints: Eyepoints) -> OwnMotion:
    """Motion along the commanded beams of n shots, over level ground.

    With the vertical z, u - V.d = V.z / d.z - V.d + R d'.z / d.z.
    """
    direction, velocity, turning = eyepoints.direction, eyepoints.velocity, eyepoints.turning
    grows = _dot(eyepoints.platform_acceleration, direction) + _dot(velocity, turning)
    down = direction[:, 2] < -LEAST_DESCENT
    sine = np.where(down, direction[:, 2], -1.0)
    slip = np.where(down, _dot(velocity, direction) - velocity[:, 2] / sine, 0.0)
    return OwnMotion(grows, slip, np.where(down, -turning[:, 2] / sine, 0.0))


def _dot(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    return np.asarray(one[:, 0] * other[:, 0] + one[:, 1] * other[:, 1] + one[:, 2] * other[:, 2])
