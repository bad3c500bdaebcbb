"""Velocity and altitude of each measurement cycle and draw, with their uncertainties.

Each beam measures the platform's velocity along itself, ``v_r = u . v`` (closing is positive),
and a point of the ground, ``R u``. Weighted least squares over the beams that returned gives the
velocity; a plane through the ground points gives the altitude. Standard errors are those of
single beams, uncorrelated; covariances follow by linear propagation.

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

Of the floor of its errors (:mod:`sweep.model.error_floor`) it knows the standard deviations too,
which stand in those of the points. Those of pointing and vibration are independent from beam to
beam: they weigh, and they show in the residuals. Clock and wavelength scale all beams alike, which
no residual shows: they are taken out of the weights, and of a relative error of s the solution's
covariance has s^2 v v^T more, the altitude's variance s^2 h^2. The altitude is that of the points
where pointing has put them, and its variance counts the pointing as it counts jitter.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numba import njit
from scipy.special import chdtri

from sweep.model.error_floor import NO_FLOOR, ErrorFloor
from sweep.model.outputs import NAVIGATION
from sweep.model.pairing import UNCONFIRMED

STRETCH = 1 << 14
"""Beams solved for at once: so many that what is made of them stays at hand."""

LEAST_SINE = 0.05
"""A beam that grazes the ground at less than about 3 deg is weighted as if at that angle."""

_LARGEST_CONDITION = 1e6
"""Condition number above which beams count as lying in a plane: it only refuses what rounding
would spoil; the covariance tells a weak geometry."""

_INTERPOLATION = 1e-6
"""Least error of a place between bins, over that of a place by whole bins."""

_ORTHOGONAL = 1e-15
_MOST_SWEEPS = 40
"""Some 5 are needed; a sweep that rounding keeps alive must end."""

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

    Leading dimensions broadcast: directions (cycles, 1, b, 3) serve velocities (cycles, draws, b).

    Parameters
    ----------
    direction : (..., b, 3) array_like
        Unit vectors from the instrument; their frame is that of the result.
    radial_velocity, standard_error : (..., b) array_like
        Closing velocity along each beam, not finite where it has not returned, and its standard
        error > 0 [m/s].
    level : float or None
        Level of the test for one false beam (:func:`_screened`), which needs
        five beams to find it; with four it withholds the solution. None: no test.

    Raises
    ------
    ValueError
        Shapes do not fit; a valid beam has no positive standard error or a direction whose length
        is not 1; `level` is out of range.
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
        return value, covariance, chi, np.where(solved, used.sum(axis=1) - 3, 0)

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

    The ground's slope, known beforehand to be 0 with the standard deviation `slope`, is weighed
    against the points, whatever their number. 0 states level ground; then every second beam is a
    check on the first, and three are enough to find a false one.

    Parameters
    ----------
    direction : (..., b, 3) array_like
        Unit vectors from the instrument, z up.
    range, standard_error : (..., b) array_like
        Range along each beam, not finite where it has not returned, and its standard error [m].
    slope : float
        Standard deviation of the ground's slope along any horizontal [1], >= 0, finite.
    offset : (..., b, 3) array_like or None
        Place of the instrument when each beam fires, from that whose altitude is asked [m].
    relief : float
        Standard deviation of heights about the plane [m], which adds to the errors of range. Real
        ground fails the test for a false beam without it.
    level : float or None
        Level of the test for one false beam (:func:`_screened`); None: no test.

    Raises
    ------
    ValueError
        As for :func:`velocity`; `slope` or `relief` is negative or not finite.
    """
    if not (0 <= slope < math.inf and 0 <= relief < math.inf):
        raise ValueError("the ground's slope and relief are finite and not negative")
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
            height, variance, chi, _ = _plane(*some, gradient, slope, relief)
        count = used.sum(axis=1)
        return height, variance, np.where(count > 0, chi, np.nan), np.maximum(count - 1, 0)

    return _screened(fit, np.isfinite(distance), level, shape)


def _plane(
    points: np.ndarray, beams: np.ndarray, errors: np.ndarray, used: np.ndarray,
    gradient: np.ndarray, slope: float, relief: float,
) -> Fit:  # fmt: skip
    """Altitudes, variances, chi-squares and gradients of planes through n cycles' ground points.

    The plane is z = -altitude + gradient . (x, y) with the platform at the zero. Heights are
    fitted at the points' measured places. An error of range moves a point off the plane by
    the error times ``gradient . (u_x, u_y) - u_z``, so the weights need a gradient beforehand.

    About the weighted centre of the points, height and slopes do not correlate. Slopes known
    beforehand are two more observations of 0. Points and beams are (3, b, n), gradients (2, n).
    """
    b, n = used.shape
    sine = gradient[0] * beams[0] + gradient[1] * beams[1] - beams[2]
    moved = errors * np.maximum(sine, LEAST_SINE)
    weight = np.where(used, 1.0 / np.hypot(moved, relief), 0.0)
    total = sum(weight**2)  # one beam after the other: NumPy's order would go by n
    centre = sum((points * (weight**2 / total)).swapaxes(0, 1))
    apart = weight * (points - centre[:, None])
    residual = np.zeros((n, b + 2))
    residual[:, :b] = apart[2].T
    height, variance, gradient = -centre[2], 1.0 / total, np.zeros((2, n))
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
    return height, variance, sum(residual.T**2), gradient


def _flat_cycles(
    direction: np.ndarray, value: np.ndarray, standard_error: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, tuple[int, ...]]:
    """Directions (n, b, 3), values and errors (n, b), and the shape that n stands for."""
    u, value, error = (np.asarray(a, float) for a in (direction, value, standard_error))
    if u.shape[-1:] != (3,):
        raise ValueError(f"directions have three components: (..., b, 3), not {u.shape}")
    shape = np.broadcast_shapes(u.shape[:-1], value.shape, error.shape)
    u = np.broadcast_to(u, (*shape, 3)).reshape(-1, shape[-1], 3)
    value, error = (np.broadcast_to(a, shape).reshape(-1, shape[-1]) for a in (value, error))
    valid = np.isfinite(value)
    if not (np.isfinite(error[valid]) & (error[valid] > 0)).all():
        raise ValueError("a valid beam has a standard error that is not positive and finite")
    if not (np.abs(np.linalg.norm(u[valid], axis=-1) - 1) < 1e-6).all():
        raise ValueError("a valid beam has a direction whose length is not 1")
    return u, value, error, shape[:-1]


def _least_squares(
    columns: np.ndarray, residual: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Right singular vectors (n, m, m), squares of singular values and coordinates (n, m).

    The unknowns of problem i are ``turn[i] @ coordinate[i]``; `residual` (n, b) becomes what they
    leave, and columns (n, b, m) are turned until they are orthogonal.
    """
    n, _, m = columns.shape
    turn, square, coordinate = np.empty((n, m, m)), np.empty((n, m)), np.empty((n, m))
    _orthogonalise(columns, residual, turn, square, coordinate)
    return turn, square, coordinate


@njit(cache=True, nogil=True, error_model="numpy")
def _orthogonalise(every, residuals, turns, squares, coordinates):
    """Least squares by Jacobi's rotations, as of :func:`_least_squares`.

    This gives the singular values of even a nearly degenerate geometry to full relative accuracy;
    normal equations would square its condition number.
    """
    n, b, m = every.shape
    for i in range(n):
        columns, turn, residual = every[i], turns[i], residuals[i]
        for p in range(m):
            for q in range(m):
                turn[p, q] = 1.0 if p == q else 0.0
        done = False
        for _ in range(_MOST_SWEEPS):
            if done:
                break
            done = True
            for pair in range(m * (m - 1) // 2):  # first and second, first and third, the others
                p, q = (0, pair + 1) if pair < m - 1 else (1, 2)
                alpha = beta = gamma = 0.0
                for j in range(b):
                    alpha += columns[j, p] * columns[j, p]
                    beta += columns[j, q] * columns[j, q]
                    gamma += columns[j, p] * columns[j, q]
                if abs(gamma) <= _ORTHOGONAL * math.sqrt(alpha) * math.sqrt(beta):
                    continue
                done = False
                zeta = (beta - alpha) / (2.0 * gamma)
                tangent = math.copysign(1.0 / (abs(zeta) + math.hypot(1.0, zeta)), zeta)
                cosine = 1.0 / math.hypot(1.0, tangent)
                sine = cosine * tangent
                for matrix in (columns, turn):
                    for j in range(matrix.shape[0]):
                        x, y = matrix[j, p], matrix[j, q]
                        matrix[j, p], matrix[j, q] = cosine * x - sine * y, sine * x + cosine * y
        for k in range(m):
            square = coordinate = 0.0
            for j in range(b):
                square += columns[j, k] * columns[j, k]
            for j in range(b):
                coordinate += columns[j, k] * residual[j] / square
            for j in range(b):
                residual[j] -= coordinate * columns[j, k]
            squares[i, k], coordinates[i, k] = square, coordinate


def _screened(
    fit: Callable[[np.ndarray, np.ndarray], Fit], valid: np.ndarray, level: float | None,
    shape: tuple[int, ...],
) -> Solution:  # fmt: skip
    """Solutions of n cycles of b beams, with a beam that contradicts the others left out.

    A cycle is suspect where its chi-square exceeds the value that it exceeds with probability
    `level` when all beams are true. Then each beam is left out in turn. Where exactly one such
    fit passes the same test, that beam is false and that fit is the solution. Where several do,
    the false one can not be told and the solution is withheld, as where none does (two false
    beams, or a true one past the test). With one degree of freedom, as for the velocity from
    four beams, every exclusion leaves an exact fit: a false alarm can be noticed there but
    never found.

    Parameters
    ----------
    fit : callable
        Fit of the cycles of index (k,) by the beams of a mask (k, b); a chi-square of nan without
        a solution.
    valid : (n, b) bool ndarray
        Beams that returned anything.
    level : float or None
        Probability that a cycle of true beams is suspect, 0 < . < 1; None: no test.
    shape : tuple of int
        Dimensions that n stands for.
    """
    used, b = valid.copy(), valid.shape[1]
    fitted = fit(np.arange(len(valid)), used)
    value, covariance, chi, degrees = fitted
    status = np.where(np.isnan(chi), UNDETERMINED, SOLVED).astype(np.int8)
    if level is not None:
        if not 0 < level < 1:
            raise ValueError(f"the test's level lies between 0 and 1, not {level}")
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
    """Velocity and altitude of every cycle and draw.

    Parameters
    ----------
    shots : mapping
        ``platform_position``, ``platform_velocity`` and ``beam_direction`` of
        :data:`sweep.model.outputs.SHOTS`, (n, 3).
    points : mapping
        Interpolated ranges and radial velocities, their standard errors and the flags of
        :data:`sweep.model.outputs.POINTS`, (n, draws, returns); positions too, (..., 3), where
        the floor has an error of pointing.
    shots_a_cycle : int
        Shots of a cycle, in the order of the arrays; n is a multiple of it.
    ground_slope, relief : float
        Of :func:`altitude` [1], [m].
    test_level : float or None
        Level of the test for one false beam, of :func:`velocity`; None or 0: no test.
    jitter : float
        Standard deviation of the pointing jitter, of each angle [rad].
    floor : ErrorFloor
        Standard deviations of the instrument's errors that the points have
        (:func:`sweep.model.error_floor.stray`).

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
    """Values and standard errors of trusted points, (cycles, draws, each); nan without one.

    Standard errors without what all beams have in common. Positions, (..., 3), where pointing has
    an error.
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
    """Add the pointing's error to the standard errors of beams, (cycles, draws, each).

    Those of velocities already include `pointing`, the error floor's.
    """
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
