"""Velocity and altitude of each measurement cycle and draw, with their uncertainties.

Each beam measures the platform's velocity along itself, ``v_r = u . v`` (closing is positive),
and a point of the ground, ``R u``. Weighted least squares over the beams that returned gives the
velocity; a plane through the ground points gives the altitude. Standard errors are those of
single beams, uncorrelated; covariances follow by linear propagation.

The instrument does not know which of its points are true. Of each shot it takes the first, and
strongest, that a Doppler peak confirms (:mod:`sweep.model.pairing`). False alarms that pass as
confirmed, mispaired and misread points are used as if they were true; the test for one false beam
is there to find them.

The residuals of a solution may contradict the errors of its points: a chi-square that true errors
exceed once in a thousand, over unstated relief or with a false point. Its covariance is then that
which the residuals tell.

A point whose standard error is not a number is left out; one under a millionth of a bin counts as
that, to which the interpolation itself is good.

The instrument is taken to know, from inertial sensors, how it is turned and how its place and
velocity have changed within a cycle. So the altitude is that at the cycle's first shot, over the
ground straight below it, and the velocity the mean over the cycle's shots, in the world's axes.

Of pointing jitter it knows the standard deviation. To first order a beam thrown off by sigma in
each of the two angles across it adds sigma |v_perp| to the standard error of its radial velocity.
Here v_perp is the velocity across it (by a first solution without jitter). It adds sigma R
tan(angle from nadir) to that of its range, on level ground.

Of the floor of its errors (:mod:`sweep.model.error_floor`) it knows the standard deviations too.
Those of pointing and vibration are independent from beam to beam: they weigh, and they show in the
residuals. Clock and wavelength scale all beams alike, which no residual shows. They are taken out
of the weights. Of a relative error of s the solution's covariance has s^2 v v^T more, the
altitude's variance s^2 h^2. The altitude is that of the points where pointing has put them, and its
variance counts the pointing as it counts jitter.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from sweep.model.error_floor import NO_FLOOR, ErrorFloor
from sweep.model.outputs import NAVIGATION
from sweep.model.pairing import UNCONFIRMED

STRETCH = 1 << 14
"""Beams solved for at once: so many that what is made of them stays at hand."""

LEAST_SINE = 0.05
"""A beam that grazes the ground at less than about 3 deg is weighted as if at that angle."""

_LARGEST_CONDITION = 1e6
"""Condition number above which beams count as in a plane; covariances tell weak geometries."""

_INTERPOLATION = 1e-6
"""Least error of a place between bins, over that of a place by whole bins."""

_SCALED_AT = 1e-3
"""Probability of larger residuals from which on they tell the errors, and not what is stated."""

SOLVED = 0
"""All valid beams are in the solution."""
EXCLUDED = 1
"""All but one, which contradicts the others."""
WITHHELD = 2
"""The beams contradict each other and it can not be told which one is false: no solution."""
UNDETERMINED = 3
"""Too few beams, or too near to a plane: no solution."""

Arrays = Mapping[str, np.ndarray]

Fit = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
"""First four fields of :class:`Solution`, of n cycles."""


class Solution(NamedTuple):
    """Velocities in the frame of the directions, or altitudes; nan where not available."""

    value: np.ndarray
    """(..., 3): velocity of the platform relative to the ground [m/s]; or (...,): height above
    the ground's plane along the vertical [m]."""
    covariance: np.ndarray
    """(..., 3, 3) [m^2/s^2] or (...,) [m^2]: of its error."""
    chi_square: np.ndarray
    """(...,): weighted sum of squared residuals; of all valid beams where withheld."""
    degrees: np.ndarray
    """(...,) int64: observations beyond what the solution needs, the chi-square's expectation; 0
    where undetermined."""
    used: np.ndarray
    """(..., b) bool: beams in the solution."""
    status: np.ndarray
    """(...,) int8: SOLVED, EXCLUDED, WITHHELD or UNDETERMINED."""

    @property
    def available(self) -> np.ndarray:
        """(...,) bool: there is a solution."""
        return self.status <= EXCLUDED


def velocity(
    *,
    direction: np.ndarray,
    radial_velocity: np.ndarray,
    standard_error: np.ndarray,
    level: float | None = None,
) -> Solution:
    """Velocity vector and covariance of each cycle of b beams.

    Directions (..., b, 3) are unit vectors from the instrument. Velocities along them, positive
    when closing and not finite for a beam that has not returned, and their errors are (..., b).
    Leading dimensions broadcast. `level` is that of the test for one false beam, None for no test:
    it needs five beams to find it; with four it withholds the solution.
    """
    u, closing, error, shape = _flat_cycles(direction, radial_velocity, standard_error)

    def fit(index: np.ndarray, used: np.ndarray) -> Fit:
        with np.errstate(divide="ignore", invalid="ignore"):
            columns = np.where(used[..., None], u[index] / error[index, :, None], 0.0)
            residual = np.where(used, closing[index] / error[index], 0.0)
            turn, square, coordinate = _least_squares(columns, residual)
            condition = np.sqrt(square.max(axis=1) / square.min(axis=1))
            solved = (used.sum(axis=1) >= 3) & (condition <= _LARGEST_CONDITION)
            value = sum(turn[:, :, k] * coordinate[:, k, None] for k in range(3))
            covariance = sum(
                turn[:, :, None, k] * turn[:, None, :, k] / square[:, k, None, None]
                for k in range(3)
            )
        chi = np.where(solved, sum(residual.T**2), np.nan)
        degrees = np.where(solved, used.sum(axis=1) - 3, 0)
        scale = _covariance_scale(chi, degrees, degrees)
        return value, covariance * scale[:, None, None], chi, degrees

    return _screened(fit, np.isfinite(closing), level, shape)


def altitude(
    *,
    direction: np.ndarray,
    range: np.ndarray,
    standard_error: np.ndarray,
    slope: float,
    offset: np.ndarray | None = None,
    relief: float = 0.0,
    level: float | None = None,
) -> Solution:
    """Altitude above the plane through each cycle's ground points, and its variance.

    Arrays and `level` are as for :func:`velocity`, z up. `offset` (..., b, 3) is the place of the
    instrument when each beam fires, from that whose altitude is asked [m].

    The ground's slope, known beforehand to be 0 with the standard deviation `slope`, is weighed
    against the points, whatever their number. 0 states level ground; then every second beam is a
    check on the first, and three are enough to find a false one. `relief` is the standard deviation
    of heights about the plane [m], which adds to the errors of range. Real ground fails the test
    for a false beam without it.
    """
    u, distance, error, shape = _flat_cycles(direction, range, standard_error)
    points = u * distance[..., None]
    if offset is not None:
        moved = np.broadcast_to(np.asarray(offset, float), (*shape, *u.shape[1:]))
        points += moved.reshape(u.shape)
    # Beams first, cycles last: NumPy is fast along the last.
    points, u, error = (np.ascontiguousarray(each.T) for each in (points, u, error))

    def fit(index: np.ndarray, used: np.ndarray) -> Fit:
        mask = np.ascontiguousarray(used.T)
        some = np.where(mask, points[..., index], 0.0), u[..., index], error[:, index], mask
        with np.errstate(divide="ignore", invalid="ignore"):
            gradient = _plane(*some, np.zeros((2, index.size)), slope, relief)[3]
            height, variance, chi, _, slopes = _plane(*some, gradient, slope, relief)
        count = used.sum(axis=1)
        chi, degrees = np.where(count > 0, chi, np.nan), np.maximum(count - 1, 0)
        variance = variance * _covariance_scale(chi, degrees, count - 1 - slopes)
        return height, variance, chi, degrees

    return _screened(fit, np.isfinite(distance), level, shape)


def _covariance_scale(
    chi_square: np.ndarray, degrees: np.ndarray, residual_degrees: np.ndarray
) -> np.ndarray:
    """Return the factor on the covariance of solutions whose residuals exceed the stated errors.

    Residuals that true errors reach with :data:`_SCALED_AT` or less tell their size themselves: it
    is the chi-square over the degrees of freedom that the residuals have, at least one.
    """
    limit = chdtri(np.maximum(degrees, 1), _SCALED_AT)
    exceeds = (degrees > 0) & (chi_square > limit)
    return np.where(exceeds, chi_square / np.maximum(residual_degrees, 1), 1.0)


def _plane(
    points: np.ndarray, beams: np.ndarray, errors: np.ndarray, used: np.ndarray,
    gradient: np.ndarray, slope: float, relief: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """Altitudes, variances, chi-squares and gradients of planes through n cycles' ground points.

    Last come the slopes that the points tell, and not what is known beforehand: 0 to 2 of them.

    The plane is z = -altitude + gradient . (x, y) with the platform at the zero. An error of range
    moves a point off the plane by the error times ``gradient . (u_x, u_y) - u_z``, so the weights
    need a gradient beforehand. Points and beams are (3, b, n), gradients (2, n).
    """
    b, n = used.shape
    sine = gradient[0] * beams[0] + gradient[1] * beams[1] - beams[2]
    moved = errors * np.maximum(sine, LEAST_SINE)
    weight = np.where(used, 1.0 / np.hypot(moved, relief), 0.0)
    total = np.asarray(sum(weight**2))  # one beam after the other: NumPy's order would go by n
    share = weight**2 / np.where(total > 0, total, 1.0)
    centre = np.asarray(sum((points * share).swapaxes(0, 1)))
    apart = weight * (points - centre[:, None])
    residual = np.zeros((n, b + 2))
    residual[:, :b] = apart[2].T
    height, variance, gradient = -centre[2], 1.0 / total, np.zeros((2, n))
    slopes = np.zeros(n)
    if slope > 0:
        columns = np.zeros((n, b + 2, 2))
        columns[:, :b] = apart[:2].T
        columns[:, b, 0] = columns[:, b + 1, 1] = 1.0 / slope
        turn, square, coordinate = _least_squares(columns, residual)
        turn, square, coordinate = turn.T, square.T, coordinate.T  # cycles last
        for k in range(2):
            along = centre[0] * turn[k, 0] + centre[1] * turn[k, 1]
            height = height + along * coordinate[k]
            variance = variance + along**2 / square[k]
            gradient = gradient + turn[k] * coordinate[k]
            slopes = slopes + 1.0 - 1.0 / (slope**2 * square[k])
    return height, variance, sum(residual.T**2), gradient, slopes


def _flat_cycles(
    direction: np.ndarray, value: np.ndarray, standard_error: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, tuple[int, ...]]:
    """Directions (n, b, 3), values and errors (n, b), and the shape that n stands for."""
    u, value, error = (np.asarray(a, float) for a in (direction, value, standard_error))
    shape = np.broadcast_shapes(u.shape[:-1], value.shape, error.shape)
    u = np.broadcast_to(u, (*shape, 3)).reshape(-1, shape[-1], 3)
    value, error = (np.broadcast_to(a, shape).reshape(-1, shape[-1]) for a in (value, error))
    return u, value, error, shape[:-1]


def _least_squares(
    columns: np.ndarray, residual: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Right singular vectors (n, m, m), squares of singular values and coordinates (n, m).

    The unknowns of problem i are ``turn[i] @ coordinate[i]``; `residual` (n, b) becomes what they
    leave of itself by columns (n, b, m). Normal equations would square the condition number.
    """
    n, b, m = columns.shape
    wide = np.pad(columns, ((0, 0), (0, max(m - b, 0)), (0, 0)))
    left, size, right = np.linalg.svd(wide, full_matrices=False)
    coordinate = np.empty((n, m))
    for k in range(m):
        each = left[:, :b, k]
        along = np.asarray(sum((each * residual).T))  # one beam after the other, as above
        residual -= along[:, None] * each
        coordinate[:, k] = along / size[:, k]
    return right.mT, size**2, coordinate


def _screened(
    fit: Callable[[np.ndarray, np.ndarray], Fit], valid: np.ndarray, level: float | None,
    shape: tuple[int, ...],
) -> Solution:  # fmt: skip
    """Solutions of n cycles of b beams, with a beam that contradicts the others left out.

    A cycle is suspect where its chi-square is larger than it is with probability `level` when all
    beams are true. Then each beam is left out in turn: where exactly one such fit passes the same
    test, that beam is false and that fit is the solution; else the solution is withheld. With one
    degree of freedom every exclusion leaves an exact fit: a false alarm is noticed, never found.

    `fit` takes the cycles' index (k,) and a mask of beams (k, b); its chi-square is nan without a
    solution. `valid` (n, b) beams have returned; n stands for `shape`.
    """
    used, b = valid.copy(), valid.shape[1]
    fitted = fit(np.arange(len(valid)), used)
    value, covariance, chi, degrees = fitted
    status = np.where(np.isnan(chi), UNDETERMINED, SOLVED).astype(np.int8)
    if level is not None:
        most = np.concatenate([[np.inf], chdtri(np.arange(1, b + 1), level)])
        suspect = np.flatnonzero(chi > most[degrees])
        passes = np.zeros((suspect.size, b), bool)
        for beam in range(b):
            _, _, trial, left = fit(suspect, used[suspect] & (np.arange(b) != beam))
            passes[:, beam] = trial <= most[left]
        one = passes.sum(axis=1) == 1
        status[suspect] = np.where(one, EXCLUDED, WITHHELD)
        found = suspect[one]
        used[found, passes[one].argmax(axis=1)] = False
        for whole, part in zip(fitted, fit(found, used[found]), strict=True):
            whole[found] = part
    value[status > EXCLUDED] = covariance[status > EXCLUDED] = np.nan
    return Solution(*(a.reshape(shape + a.shape[1:]) for a in (*fitted, used, status)))


def solve(
    shots: Arrays,
    points: Arrays,
    *,
    shots_a_cycle: int,
    ground_slope: float,
    test_level: float | None = None,
    relief: float = 0.0,
    jitter: float = 0.0,
    floor: ErrorFloor = NO_FLOOR,
) -> dict[str, np.ndarray]:
    """Velocity and altitude of every cycle and draw: :data:`sweep.model.outputs.NAVIGATION`.

    `shots` and `points` are arrays of :data:`sweep.model.outputs.SHOTS` and POINTS, cycle by cycle;
    positions of points are used where the floor has an error of pointing. The ground's slope and
    relief and the level are those of :func:`altitude`, level None or 0 for no test. `jitter` is the
    standard deviation of each angle of the pointing [rad], and `floor` has those of the
    instrument's other errors. Numbers of beams are 0 where there is no solution.
    """
    n, draws = points["flags"].shape[:2]
    cycles = n // shots_a_cycle
    room = {"cycle": cycles, "draw": draws, "xyz": 3, "xyz_again": 3}
    results = {name: output.empty(room) for name, output in NAVIGATION.items()}
    step = max(1, STRETCH // max(1, shots_a_cycle * draws))
    for first in range(0, cycles, step):
        some = slice(first, min(first + step, cycles))
        part = slice(some.start * shots_a_cycle, some.stop * shots_a_cycle)
        poses = [
            shots[name][part].reshape(-1, shots_a_cycle, 3)
            for name in ("platform_position", "platform_velocity", "beam_direction")
        ]
        found = _solved(
            poses, _beams(points, part, shots_a_cycle, floor), {"level": test_level or None},
            {"slope": ground_slope, "relief": relief}, jitter, floor,
        )  # fmt: skip
        for quantity, spread, solution in found:
            beams = np.where(solution.available, solution.used.sum(axis=-1), 0)
            results[quantity][some] = solution.value
            results[f"{quantity}_{spread}"][some] = solution.covariance
            results[f"{quantity}_status"][some] = solution.status
            results[f"{quantity}_beams"][some] = beams
    return results


def _beams(points: Arrays, part: slice, each: int, floor: ErrorFloor) -> dict[str, np.ndarray]:
    """Values and errors of trusted points, (cycles, draws, each), nan without one; positions too.

    The errors are without what all beams have in common.
    """
    flags = points["flags"][part]
    pairs: dict[str, np.ndarray] = {}
    trusted = (flags != 0) & (flags & UNCONFIRMED == 0)
    for name, common in (("range", floor.clock), ("radial_velocity", floor.scale)):
        value, error = (
            points[f"{name}_interpolated{suffix}"][part] for suffix in ("", "_standard_error")
        )
        if common > 0:
            error = np.sqrt(np.maximum(error**2 - (common * value) ** 2, 0.0))
        error = np.maximum(error, _INTERPOLATION * points[f"{name}_standard_error"][part])
        trusted &= np.isfinite(value) & np.isfinite(error) & (error > 0)
        pairs |= {name: value, f"{name}_standard_error": error}
    first, lost = trusted.argmax(axis=2)[..., None], ~trusted.any(axis=2)
    beams = {}
    if floor.pointing > 0:
        chosen = np.take_along_axis(points["position"][part], first[..., None], axis=2)[:, :, 0]
        beams["position"] = chosen.reshape(-1, each, *chosen.shape[1:]).swapaxes(1, 2)
    for name, values in pairs.items():
        chosen = np.take_along_axis(values, first, axis=2)[..., 0]
        chosen[lost] = np.nan
        beams[name] = chosen.reshape(-1, each, chosen.shape[1]).swapaxes(1, 2)
    return beams


def _solved(
    poses: Sequence[np.ndarray], beams: dict[str, np.ndarray], test: dict, ground: dict,
    jitter: float, floor: ErrorFloor,
) -> list[tuple[str, str, Solution]]:  # fmt: skip
    """Solutions of (cycles, draws) measurement cycles, with what they and their spread are."""
    place, moving, direction = poses
    faster = np.einsum("cbi,cbi->cb", direction, moving - moving.mean(axis=1, keepdims=True))
    beams = beams | {"radial_velocity": beams["radial_velocity"] - faster[:, None]}
    if jitter > 0 or floor.pointing > 0:
        beams = beams | _jittered(direction, beams, jitter, floor.pointing)
    direction, offset = direction[:, None], (place - place[:, :1])[:, None]
    known = direction
    if floor.pointing > 0:
        known = (beams["position"] - place[:, None]) / beams["range"][..., None]
    speed = velocity(
        direction=direction,
        radial_velocity=beams["radial_velocity"],
        standard_error=beams["radial_velocity_standard_error"],
        **test,
    )
    height = altitude(
        direction=known,
        range=beams["range"],
        standard_error=beams["range_standard_error"],
        offset=offset,
        **ground,
        **test,
    )
    if floor.scale > 0:
        common = floor.scale**2 * speed.value[..., None] * speed.value[..., None, :]
        speed = speed._replace(covariance=speed.covariance + common)
    if floor.clock > 0:
        common = (floor.clock * height.value) ** 2
        height = height._replace(covariance=height.covariance + common)
    return [("velocity", "covariance", speed), ("altitude", "variance", height)]


def _jittered(
    direction: np.ndarray, beams: Arrays, jitter: float, pointing: float
) -> dict[str, np.ndarray]:
    """Add the pointing's error to standard errors (cycles, draws, each); velocities have it."""
    closing, error = beams["radial_velocity"], beams["radial_velocity_standard_error"]
    first = velocity(
        direction=direction[:, None], radial_velocity=closing, standard_error=error
    ).value
    along = np.einsum("cbi,cdi->cdb", direction, first)
    square = np.sum(first**2, axis=2)[..., None] - along**2
    across = np.sqrt(np.maximum(np.nan_to_num(square), 0.0))
    level = np.linalg.norm(direction[..., :2], axis=2)
    slant = level / np.maximum(-direction[..., 2], LEAST_SINE)
    return {
        "radial_velocity_standard_error": np.hypot(error, jitter * across),
        "range_standard_error": np.hypot(
            beams["range_standard_error"],
            np.hypot(jitter, pointing) * beams["range"] * slant[:, None],
        ),
    }
