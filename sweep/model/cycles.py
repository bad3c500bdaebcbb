"""Navigation from a point cloud: velocity and altitude of each measurement cycle and draw.

The instrument does not know which of its points are true. Of each shot it takes the first that a
Doppler peak confirms (:mod:`sweep.model.pairing`), which is the strongest of these, and nothing
of a shot without one: range and velocity of an unconfirmed point may be exchanged, in which case
neither is of use. False alarms that pass as confirmed, mispaired and misread points are used as
if they were true; the test for one false beam is there to find them.

Values are the interpolated ones with their standard errors. A point whose standard error is not a
number is left out; one under a millionth of a bin counts as that, to which the interpolation
itself is good.

The instrument is taken to know, from inertial sensors, how it is turned and how its place and
velocity have changed within a cycle: so the altitude is that at the cycle's first shot, over the
ground straight below it, and the velocity the mean over the cycle's shots, in the world's axes.

Of pointing jitter it knows the standard deviation. To first order a beam thrown off by sigma in
each of the two angles across it adds sigma |v_perp| to the standard error of its radial velocity,
v_perp the velocity across it (by a first solution without jitter), and sigma R tan(angle from
nadir) to that of its range, on level ground.
"""

from collections.abc import Mapping

import numpy as np

from sweep.model.navigation import LEAST_SINE, Altitude, Velocity, altitude, velocity
from sweep.model.outputs import NAVIGATION
from sweep.model.pairing import UNCONFIRMED

STRETCH = 1 << 16
"""Beams solved for at once."""

_INTERPOLATION = 1e-6
"""Least error of a place between bins, over that of a place by whole bins."""

_POSES = "platform_position", "platform_velocity", "beam_direction"

Arrays = Mapping[str, np.ndarray]


def solve(
    shots: Arrays,
    points: Arrays,
    *,
    shots_a_cycle: int,
    test_level: float | None = None,
    ground_slope: float = 0.0,
    relief: float = 0.0,
    jitter: float = 0.0,
) -> dict[str, np.ndarray]:
    """Velocity and altitude of every cycle and draw.

    Parameters
    ----------
    shots : mapping
        ``platform_position``, ``platform_velocity`` and ``beam_direction`` of
        :data:`sweep.model.outputs.SHOTS`, (n, 3).
    points : mapping
        Interpolated ranges and radial velocities, their standard errors and the flags of
        :data:`sweep.model.outputs.POINTS`, (n, draws, returns).
    shots_a_cycle : int
        Shots of a cycle, in the order of the arrays; n is a multiple of it.
    test_level : float or None
        Level of the test for one false beam, of :func:`sweep.model.navigation.velocity`; None or
        0: no test.
    ground_slope, relief : float
        Of :func:`sweep.model.navigation.altitude` [1], [m].
    jitter : float
        Standard deviation of the pointing jitter, of each angle [rad].

    Returns
    -------
    dict of ndarray
        By the names, units and types of :data:`sweep.model.outputs.NAVIGATION`, (cycles,
        draws[, 3[, 3]]); the numbers of beams are 0 where there is no solution.

    Raises
    ------
    ValueError
        n is no multiple of `shots_a_cycle`; a level, slope or relief is out of range.
    """
    n, draws = points["flags"].shape[:2]
    if shots_a_cycle < 1 or n % shots_a_cycle:
        raise ValueError(f"{n} shots are not whole cycles of {shots_a_cycle}")
    cycles = n // shots_a_cycle
    room = {"cycle": cycles, "draw": draws, "xyz": 3, "xyz_again": 3}
    results = {
        name: np.empty(tuple(room[dim] for dim in output.dims), output.dtype)
        for name, output in NAVIGATION.items()
    }
    step = max(1, STRETCH // max(1, shots_a_cycle * draws))
    for first in range(0, cycles, step):
        some = slice(first, min(first + step, cycles))
        part = slice(some.start * shots_a_cycle, some.stop * shots_a_cycle)
        beams = _beams(points, part, shots_a_cycle)
        found = _solved(
            {name: _by_cycle(shots[name][part], shots_a_cycle) for name in _POSES}, beams,
            {"level": test_level or None}, {"slope": ground_slope, "relief": relief}, jitter,
        )  # fmt: skip
        for name, values in found.items():
            results[name][some] = values
    return results


def _by_cycle(values: np.ndarray, each: int) -> np.ndarray:
    """(cycles, each, ...) of values (n, ...)."""
    return values.reshape(-1, each, *values.shape[1:])


def _beams(points: Arrays, part: slice, each: int) -> dict[str, np.ndarray]:
    """Values and standard errors of trusted points, (cycles, draws, each); nan without one."""
    flags = points["flags"][part]
    pairs = {
        name: (points[f"{name}_interpolated"][part], _standard_error(points, name, part))
        for name in ("range", "radial_velocity")
    }
    trusted = (flags != 0) & (flags & UNCONFIRMED == 0)
    for value, error in pairs.values():
        trusted &= np.isfinite(value) & np.isfinite(error) & (error > 0)
    first = trusted.argmax(axis=2)[..., None]
    lost = ~trusted.any(axis=2)
    beams = {}
    for name, (value, error) in pairs.items():
        for suffix, values in (("", value), ("_standard_error", error)):
            chosen = np.take_along_axis(values, first, axis=2)[..., 0]
            chosen[lost] = np.nan
            beams[name + suffix] = _by_cycle(chosen, each).swapaxes(1, 2)
    return beams


def _standard_error(points: Arrays, name: str, part: slice) -> np.ndarray:
    """Standard errors of interpolated values, none under what the interpolation is good to."""
    whole = points[f"{name}_standard_error"][part]
    return np.maximum(points[f"{name}_interpolated_standard_error"][part], _INTERPOLATION * whole)


def _solved(
    poses: Arrays, beams: dict[str, np.ndarray], test: dict, ground: dict, jitter: float
) -> dict[str, np.ndarray]:
    """Solutions of (cycles, draws) measurement cycles."""
    place, moving = poses["platform_position"], poses["platform_velocity"]
    direction = poses["beam_direction"]
    faster = np.einsum("cbi,cbi->cb", direction, moving - moving.mean(axis=1, keepdims=True))
    beams = beams | {"radial_velocity": beams["radial_velocity"] - faster[:, None]}
    if jitter > 0:
        beams = beams | _jittered(direction, beams, jitter)
    direction, offset = direction[:, None], (place - place[:, :1])[:, None]
    speed = velocity(
        direction=direction,
        radial_velocity=beams["radial_velocity"],
        standard_error=beams["radial_velocity_standard_error"],
        **test,
    )
    height = altitude(
        direction=direction,
        range=beams["range"],
        standard_error=beams["range_standard_error"],
        offset=offset,
        **ground,
        **test,
    )
    return {
        "velocity": speed.velocity,
        "velocity_covariance": speed.covariance,
        "velocity_status": speed.status,
        "velocity_beams": _number(speed),
        "altitude": height.altitude,
        "altitude_variance": height.variance,
        "altitude_status": height.status,
        "altitude_beams": _number(height),
    }


def _jittered(direction: np.ndarray, beams: Arrays, jitter: float) -> dict[str, np.ndarray]:
    """Standard errors with that of the pointing in them, (cycles, draws, each)."""
    closing, error = beams["radial_velocity"], beams["radial_velocity_standard_error"]
    first = velocity(
        direction=direction[:, None], radial_velocity=closing, standard_error=error
    ).velocity
    along = np.einsum("cbi,cdi->cdb", direction, first)
    square = np.sum(first**2, axis=2)[..., None] - along**2
    across = np.sqrt(np.maximum(np.nan_to_num(square), 0.0))
    level = np.linalg.norm(direction[..., :2], axis=2)
    slant = level / np.maximum(-direction[..., 2], LEAST_SINE)
    return {
        "radial_velocity_standard_error": np.hypot(error, jitter * across),
        "range_standard_error": np.hypot(
            beams["range_standard_error"], jitter * beams["range"] * slant[:, None]
        ),
    }


def _number(solution: Velocity | Altitude) -> np.ndarray:
    return np.where(solution.available, solution.used.sum(axis=-1), 0)
