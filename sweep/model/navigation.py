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
exceed once in ten thousand, over unstated relief or with a false point. Its covariance is then that
which the residuals tell, widened as Student's t is for so many degrees of freedom, so that 68 % of
the errors are within it. The beams of one cycle tell no more: errors beyond two such deviations are
more frequent than normal ones.

A point whose standard error is not a number is left out; one under a millionth of a bin counts as
that, to which the interpolation itself is good.

The instrument is taken to know, from inertial sensors, how it is turned and how its place and
velocity have changed within a cycle. So the altitude is that at the cycle's first shot, over the
ground straight below it, and the velocity the mean over the cycle's shots, in the world's axes.

The beats tell the range that the beam has some time after the shot's start: d range / d slip of a
point (``range_per_slip``). A point's range is referred to the start by the speed u at which that of
level ground falls (:mod:`sweep.model.own_motion`). Here that is undone: the ground point is where
the instrument, moved on by V t, sees it along the beam, turned on by d' t, at the range R - u t. It
lies on the ground whatever the slope, and the error for an unknown slope is left out. The radial
velocity depends on the slip a little, and is corrected by the slope of the plane. Its error for
other slopes under the beams counts if `relief`, or the residuals, say that the ground is no plane.

Of pointing jitter it knows the standard deviation. To first order a beam thrown off by sigma in
each of the two angles across it adds sigma |v_perp| to the standard error of its radial velocity.
Here v_perp is the velocity across it (by a first solution without jitter). It adds sigma R
tan(angle of incidence) to that of its range, on the plane of a first solution.

Of the floor of its errors (:mod:`sweep.model.error_floor`) it knows the standard deviations too.
Those of pointing and vibration are independent from beam to beam: they weigh, and they show in the
residuals. Clock and wavelength scale all beams alike, which no residual shows. They are taken out
of the weights. Of a relative error of s the solution's covariance has s^2 v v^T more, the
altitude's variance s^2 h^2. The altitude is that of the points where pointing has put them, and its
variance counts the pointing as it counts jitter.
"""

import math
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri, stdtrit

from sweep.model.error_floor import NO_FLOOR, ErrorFloor
from sweep.model.outputs import NAVIGATION
from sweep.model.own_motion import LEAST_DESCENT, MotionPriors, OwnMotion, motion_of_beams
from sweep.model.pairing import UNCONFIRMED

STRETCH = 1 << 14
"""Beams solved for at once: so many that what is made of them stays at hand."""

LEAST_SINE = 0.05
"""A beam that grazes the ground at less than about 3 deg is weighted as if at that angle."""

_LARGEST_CONDITION = 1e6
"""Condition number above which beams count as in a plane; covariances tell weak geometries."""

_INTERPOLATION = 1e-6
"""Least error of a place between bins, over that of a place by whole bins."""

_ONE_SIGMA = 0.8413447460685429
"""Probability that a normal error is below one standard deviation."""

_ROUNDING = 1e-14
"""Relative error of numbers that are subtracted from each other."""

_SCALED_AT = 1e-4
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
    for a false beam without it. If the residuals tell that the ground is no plane, the variance
    counts that the ground straight below is off the plane as the points are.
    """
    points, u, error, shape = _ground_points(direction, range, standard_error, offset)

    def fit(index: np.ndarray, used: np.ndarray) -> Fit:
        mask = np.ascontiguousarray(used.T)
        some = np.where(mask, points[..., index], 0.0), u[..., index], error[:, index], mask
        with np.errstate(divide="ignore", invalid="ignore"):
            level_plane = _plane(*some, np.zeros((2, index.size)), slope, relief)
            plane = _plane(*some, level_plane.gradient, slope, relief)
        count = used.sum(axis=1)
        chi, degrees = np.where(count > 0, plane.chi_square, np.nan), np.maximum(count - 1, 0)
        scale = _covariance_scale(chi, degrees, count - 1 - plane.slopes)
        below = count * np.where(scale > 1, plane.point_variance, 0.0)
        return plane.height, scale * (plane.variance + below), chi, degrees

    return _screened(fit, np.isfinite(points[0]).T, level, shape)


def ground_gradient(
    *,
    direction: np.ndarray,
    range: np.ndarray,
    standard_error: np.ndarray,
    used: np.ndarray,
    slope: float,
    offset: np.ndarray | None = None,
    relief: float = 0.0,
) -> np.ndarray:
    """Gradient (..., 2) of the plane through the ground points of some beams of each cycle.

    Arguments are those of :func:`altitude`, and `used` (..., b) the beams of its solution; 0 of a
    cycle that uses none.
    """
    points, u, error, shape = _ground_points(direction, range, standard_error, offset)
    mask = np.ascontiguousarray(used.reshape(-1, used.shape[-1]).T)
    some, gradient = (np.where(mask, points, 0.0), u, error, mask), np.zeros((2, mask.shape[1]))
    with np.errstate(divide="ignore", invalid="ignore"):
        for _ in (1, 2):
            gradient = _plane(*some, gradient, slope, relief).gradient
    gradient = np.where(mask.any(axis=0), gradient, 0.0)
    return np.ascontiguousarray(gradient.T).reshape(*shape, 2)


def _ground_points(
    direction: np.ndarray, distance: np.ndarray, standard_error: np.ndarray,
    offset: np.ndarray | None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, tuple[int, ...]]:  # fmt: skip
    """Ground points and directions (3, b, n), errors of range (b, n), and the shape n stands for.

    Beams come first and cycles last: NumPy is fast along the last.
    """
    u, distance, error, shape = _flat_cycles(direction, distance, standard_error)
    points = u * distance[..., None]
    if offset is not None:
        moved = np.broadcast_to(np.asarray(offset, float), (*shape, *u.shape[1:]))
        points += moved.reshape(u.shape)
    points, u, error = (np.ascontiguousarray(values.T) for values in (points, u, error))
    return points, u, error, shape


def _covariance_scale(
    chi_square: np.ndarray, degrees: np.ndarray, residual_degrees: np.ndarray
) -> np.ndarray:
    """Return the factor on the covariance of solutions whose residuals exceed the stated errors.

    Residuals that true errors reach with :data:`_SCALED_AT` or less tell their size themselves: it
    is the chi-square over the degrees of freedom that the residuals have, at least one. The error
    over a deviation so estimated follows Student's t, whose central 68 % the scaled deviation has.
    """
    number = np.maximum(residual_degrees, 1)
    scale = chi_square / number * stdtrit(number, _ONE_SIGMA) ** 2
    return np.where(_contradicts(chi_square, degrees), scale, 1.0)


def _contradicts(chi_square: np.ndarray, degrees: np.ndarray) -> np.ndarray:
    """Return true where residuals contradict the stated errors."""
    return (degrees > 0) & (chi_square > chdtri(np.maximum(degrees, 1), _SCALED_AT))


class _Plane(NamedTuple):
    """Plane through the ground points of n cycles; arrays (n,) unless said otherwise."""

    height: np.ndarray
    """Height of the platform above it [m]."""
    variance: np.ndarray
    """Of that height [m^2]."""
    chi_square: np.ndarray
    gradient: np.ndarray
    """(2, n): along x and y."""
    slopes: np.ndarray
    """Slopes that the points tell, and not what is known beforehand: 0 to 2 of them."""
    point_variance: np.ndarray
    """Harmonic mean of the variances of the points' heights, over the number of points [m^2]."""


def _plane(
    points: np.ndarray, beams: np.ndarray, errors: np.ndarray, used: np.ndarray,
    gradient: np.ndarray, slope: float, relief: float,
) -> _Plane:  # fmt: skip
    """Planes through n cycles' ground points, by weighted least squares.

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
    chi_square = np.asarray(sum(residual.T**2))
    return _Plane(height, variance, chi_square, gradient, slopes, 1.0 / total)


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
    priors: MotionPriors = MotionPriors(),  # noqa: B008  # a tuple
) -> dict[str, np.ndarray]:
    """Velocity and altitude of every cycle and draw: :data:`sweep.model.outputs.NAVIGATION`.

    `shots` and `points` are arrays of :data:`sweep.model.outputs.SHOTS` and POINTS, cycle by cycle;
    positions of points are used where the floor has an error of pointing. The ground's slope and
    relief and the level are those of :func:`altitude`, level None or 0 for no test. `jitter` is the
    standard deviation of each angle of the pointing [rad], and `floor` has those of the
    instrument's other errors. `priors` are those that the points' errors have. Numbers of beams are
    0 where there is no solution.
    """
    n, draws = points["flags"].shape[:2]
    cycles = n // shots_a_cycle
    room = {"cycle": cycles, "draw": draws, "xyz": 3, "xyz_again": 3}
    results = {name: output.empty(room) for name, output in NAVIGATION.items()}
    step = max(1, STRETCH // max(1, shots_a_cycle * draws))
    for first in range(0, cycles, step):
        some = slice(first, min(first + step, cycles))
        part = slice(some.start * shots_a_cycle, some.stop * shots_a_cycle)
        poses = Poses(*(shots[name][part] for name in _POSES))
        motion = motion_of_beams(
            poses.direction, poses.velocity, poses.turning, poses.acceleration, priors
        )
        found = _solved(
            poses.by_cycle(shots_a_cycle), _beams(points, part, shots_a_cycle, floor, motion),
            {"level": test_level or None}, {"slope": ground_slope, "relief": relief}, jitter, floor,
        )  # fmt: skip
        for quantity, spread, solution in found:
            beams = np.where(solution.available, solution.used.sum(axis=-1), 0)
            results[quantity][some] = solution.value
            results[f"{quantity}_{spread}"][some] = solution.covariance
            results[f"{quantity}_status"][some] = solution.status
            results[f"{quantity}_beams"][some] = beams
    return results


_POSES = (
    "platform_position", "platform_velocity", "beam_direction", "beam_turning",
    "platform_acceleration",
)  # fmt: skip


class Poses(NamedTuple):
    """Motion of shots' beams as the instrument knows it: fields (..., 3), in the world's axes."""

    position: np.ndarray
    velocity: np.ndarray
    direction: np.ndarray
    turning: np.ndarray
    """Rate of change of the direction [1/s]."""
    acceleration: np.ndarray

    def by_cycle(self, beams: int) -> "Poses":
        """Return poses (n / beams, beams, 3) of n shots."""
        return Poses(*(values.reshape(-1, beams, 3) for values in self))


def _beams(
    points: Arrays, part: slice, each: int, floor: ErrorFloor, motion: OwnMotion
) -> dict[str, np.ndarray]:
    """Values and errors of trusted points, (cycles, draws, each), nan without one; positions too.

    The errors are without what all beams have in common, and without that of an unknown slip, which
    is ``radial_velocity_slip_error`` of the velocity. ``delay`` is the time from the shot's start
    to that of the range [s], and ``range_then`` the range at that time.
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
        by_slip = points[f"{name}_per_slip"][part]
        slip_error = abs(by_slip) * motion.slip_error(points["range_interpolated"][part])
        # The slip's error goes by the range, and so is known no better than the clock.
        least = 2 * math.sqrt(floor.clock + _ROUNDING) * slip_error
        error = np.sqrt(np.maximum(error**2 - slip_error**2, least**2))
        if name == "range":
            far = value - by_slip * motion.approach_at(value)
            pairs |= {"delay": by_slip, "range_then": far}
        else:
            pairs |= {"velocity_per_slip": by_slip, "radial_velocity_slip_error": slip_error}
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
    poses: Poses, beams: dict[str, np.ndarray], test: dict, ground: dict,
    jitter: float, floor: ErrorFloor,
) -> list[tuple[str, str, Solution]]:  # fmt: skip
    """Solutions of (cycles, draws) measurement cycles, with what they and their spread are."""
    place, moving, direction, turning, _ = poses
    faster = np.einsum("cbi,cbi->cb", direction, moving - moving.mean(axis=1, keepdims=True))
    beams = beams | {"radial_velocity": beams["radial_velocity"] - faster[:, None]}
    if jitter > 0 or floor.pointing > 0:
        offset = (place - place[:, :1])[:, None]
        beams = beams | _jittered(direction, offset, beams, ground, jitter, floor.pointing)
    known, delay = direction[:, None], beams["delay"][..., None]
    if floor.pointing > 0:
        known = (beams["position"] - place[:, None]) / beams["range"][..., None]
    ground_points = ground | {
        "direction": known + delay * turning[:, None],
        "range": beams["range_then"],
        "standard_error": beams["range_standard_error"],
        "offset": (place - place[:, :1])[:, None] + delay * moving[:, None],
    }
    height = altitude(**ground_points, **test)
    used = height.used & height.available[..., None]
    gradient = ground_gradient(**ground_points, used=used)
    missing_slip = _missing_slip(poses, beams["range"], gradient)
    unknown_slip = beams["radial_velocity_slip_error"]
    if ground["relief"] == 0:
        is_plane = height.available & ~_contradicts(height.chi_square, height.degrees)
        unknown_slip = np.where(is_plane[..., None], 0.0, unknown_slip)
    speed = velocity(
        direction=direction[:, None],
        radial_velocity=beams["radial_velocity"] - beams["velocity_per_slip"] * missing_slip,
        standard_error=np.hypot(beams["radial_velocity_standard_error"], unknown_slip),
        **test,
    )
    if floor.scale > 0:
        common = floor.scale**2 * speed.value[..., None] * speed.value[..., None, :]
        speed = speed._replace(covariance=speed.covariance + common)
    if floor.clock > 0:
        common = (floor.clock * height.value) ** 2
        height = height._replace(covariance=height.covariance + common)
    # The ground straight below is off the plane, too.
    height = height._replace(covariance=height.covariance + ground["relief"] ** 2)
    return [("velocity", "covariance", speed), ("altitude", "variance", height)]


def _missing_slip(poses: Poses, distance: np.ndarray, gradient: np.ndarray) -> np.ndarray:
    """Slip over a plane less that over level ground [m/s], (cycles, draws, each).

    Ranges `distance` (cycles, draws, each), gradients (cycles, draws, 2). With W = V + R d' and the
    normal n of the plane it is W.z / d.z - W.n / d.n; 0 along beams that do not point down at both.
    """
    _, velocity, direction, turning, _ = poses
    d = [direction[:, None, :, k] for k in range(3)]
    w = [velocity[:, None, :, k] + distance * turning[:, None, :, k] for k in range(3)]
    x, y = gradient[..., :1], gradient[..., 1:]
    sine = d[2] - x * d[0] - y * d[1]
    down = (d[2] < -LEAST_DESCENT) & (sine < -LEAST_DESCENT)
    slip = w[2] / np.where(down, d[2], -1.0)
    slip = slip - (w[2] - x * w[0] - y * w[1]) / np.where(down, sine, -1.0)
    return np.where(down, slip, 0.0)


def _jittered(
    direction: np.ndarray, offset: np.ndarray, beams: Arrays, ground: dict, jitter: float,
    pointing: float,
) -> dict[str, np.ndarray]:  # fmt: skip
    """Add the pointing's error to standard errors (cycles, draws, each); velocities have it."""
    closing, error = beams["radial_velocity"], beams["radial_velocity_standard_error"]
    first = velocity(
        direction=direction[:, None], radial_velocity=closing, standard_error=error
    ).value
    along = np.einsum("cbi,cdi->cdb", direction, first)
    square = np.sum(first**2, axis=2)[..., None] - along**2
    across = np.sqrt(np.maximum(np.nan_to_num(square), 0.0))
    gradient = ground_gradient(
        direction=direction[:, None], range=beams["range"], offset=offset,
        standard_error=beams["range_standard_error"], used=np.isfinite(beams["range"]), **ground,
    )  # fmt: skip
    x, y = gradient[..., :1], gradient[..., 1:]
    d = [direction[:, None, :, k] for k in range(3)]
    sine = d[2] - x * d[0] - y * d[1]  # d.n for the normal n = (-x, -y, 1)
    slant = np.sqrt(np.maximum(1 + x**2 + y**2 - sine**2, 0.0)) / np.maximum(-sine, LEAST_SINE)
    return {
        "radial_velocity_standard_error": np.hypot(error, jitter * across),
        "range_standard_error": np.hypot(
            beams["range_standard_error"],
            np.hypot(jitter, pointing) * beams["range"] * slant,
        ),
    }
