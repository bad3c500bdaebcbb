"""Velocity vector and altitude from one measurement cycle, with what they are uncertain by.

Each beam measures the platform's velocity along itself, ``v_r = u . v`` (closing is positive),
and a point of the ground, ``R u``. Weighted least squares over the beams that returned gives the
velocity; a plane through the ground points gives the altitude. Standard errors are those of
single beams, uncorrelated; covariances follow by linear propagation.

Every function takes any number of cycles and draws at once: the leading dimensions "..." of its
arrays broadcast, so that directions (cycles, 1, b, 3) serve velocities (cycles, draws, b).
Arrays are expanded to their common shape: pass flights in blocks.

Beams fire one after another. That belongs in the directions (each at its own attitude) and, for
the altitude, in `offset`; the velocity is that which fits the cycle as a whole.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numba import njit
from scipy.special import chdtri

LEAST_SINE = 0.05
"""A beam that grazes the ground at less than about 3 deg is weighted as if at that angle."""

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
"""Too few beams, or too near to a plane or a line of them: no solution."""


def _flat_cycles(
    direction: np.ndarray,
    value: np.ndarray,
    standard_error: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, tuple[int, ...]]:
    """Directions (n, b, 3), values, errors and mask (n, b), and the shape that n stands for."""
    u, value, error = (np.asarray(a, float) for a in (direction, value, standard_error))
    if u.shape[-1:] != (3,):
        raise ValueError(f"directions have three components: (..., b, 3), not {u.shape}")
    mask = np.isfinite(value)
    shape = np.broadcast_shapes(u.shape[:-1], value.shape, error.shape, mask.shape)
    if not shape:
        raise ValueError("a cycle of beams has a dimension for them, the last: (..., b)")
    u = np.ascontiguousarray(np.broadcast_to(u, (*shape, 3))).reshape(-1, shape[-1], 3)
    value, error, mask = (
        np.ascontiguousarray(np.broadcast_to(a, shape)).reshape(-1, shape[-1])
        for a in (value, error, mask)
    )
    if not (np.isfinite(error[mask]) & (error[mask] > 0)).all():
        raise ValueError("a valid beam has a standard error that is not positive and finite")
    if not (np.abs(np.linalg.norm(u[mask], axis=-1) - 1) < 1e-6).all():
        raise ValueError("a valid beam has a direction whose length is not 1")
    return u, value, error, mask, shape[:-1]


class Fit(NamedTuple):
    """Least squares of n cycles."""

    solved: np.ndarray
    """(n,) bool: whether there is a solution."""
    chi_square: np.ndarray
    """(n,): weighted sum of squared residuals."""
    degrees: np.ndarray
    """(n,) int64: observations beyond what the solution needs; its expectation."""
    quantities: tuple[np.ndarray, ...]
    """What is solved for, (n, ...) each."""


class Velocity(NamedTuple):
    """Velocity vectors, in the frame of the directions; nan where not available."""

    velocity: np.ndarray
    """(..., 3): of the platform relative to the ground [m/s]."""
    covariance: np.ndarray
    """(..., 3, 3): of its error [m^2/s^2]."""
    condition: np.ndarray
    """(...,): standard error of the worst known direction of velocity over that of the best known,
    1..inf: the condition number of the directions, each over its standard error. Given where
    the velocity is not, too; inf with fewer than three beams."""
    chi_square: np.ndarray
    """(...,): weighted sum of squared residuals; of all valid beams where withheld."""
    degrees: np.ndarray
    """(...,) int64: beams more than three, the chi-square's expectation; 0 where undetermined."""
    used: np.ndarray
    """(..., b) bool: beams in the solution."""
    status: np.ndarray
    """(...,) int8: SOLVED, EXCLUDED, WITHHELD or UNDETERMINED."""

    @property
    def available(self) -> np.ndarray:
        """(...,) bool: whether there is a solution."""
        return self.status <= EXCLUDED


class Altitude(NamedTuple):
    """Altitudes above a locally flat ground; nan where not available."""

    altitude: np.ndarray
    """(...,): from the plane to the platform along the vertical [m]."""
    variance: np.ndarray
    """(...,): of its error [m^2]."""
    normal: np.ndarray
    """(..., 3): the plane's upward unit normal, in the frame of the directions."""
    slopes: np.ndarray
    """(...,) int8: slopes of the plane that were fitted, 0..2; ground is level along others."""
    chi_square: np.ndarray
    """(...,): weighted sum of squared residuals; of all valid beams where withheld."""
    degrees: np.ndarray
    """(...,) int64: the chi-square's expectation; 0 where undetermined."""
    used: np.ndarray
    """(..., b) bool: beams in the solution."""
    status: np.ndarray
    """(...,) int8: SOLVED, EXCLUDED, WITHHELD or UNDETERMINED."""

    @property
    def available(self) -> np.ndarray:
        """(...,) bool: whether there is a solution."""
        return self.status <= EXCLUDED


def velocity(
    *,
    direction: np.ndarray,
    radial_velocity: np.ndarray,
    standard_error: np.ndarray,
    level: float | None = None,
    largest_condition: float = 1e6,
) -> Velocity:
    """Velocity vector and covariance of each cycle of b beams.

    Parameters
    ----------
    direction : (..., b, 3) array_like
        Unit vectors from the instrument; their frame is that of the result.
    radial_velocity, standard_error : (..., b) array_like
        Closing velocity along each beam, not finite where it has not returned, and its standard
        error > 0 [m/s].
    level : float or None
        Level of the test for one false beam (:func:`screen`), which needs
        five beams to find it; with four it withholds the solution. None: no test.
    largest_condition : float
        Condition number above which beams count as lying in a plane. The default only refuses
        what rounding would spoil; the covariance tells a weak geometry.

    Raises
    ------
    ValueError
        Shapes do not fit; a valid beam has no finite number, no positive standard error or a
        direction whose length is not 1; `level` is out of range.
    """
    u, closing, error, mask, shape = _flat_cycles(direction, radial_velocity, standard_error)

    def fit(index: np.ndarray, used: np.ndarray) -> Fit:
        n = index.size
        solution, condition, chi = np.full((n, 3), np.nan), np.empty(n), np.full(n, np.nan)
        covariance = np.full((n, 3, 3), np.nan)
        _fit_velocities(
            u[index], closing[index], error[index], used, largest_condition,
            solution, covariance, condition, chi,
        )  # fmt: skip
        solved = np.isfinite(chi)
        degrees = np.where(solved, used.sum(axis=1) - 3, 0)
        return Fit(solved, chi, degrees, (solution, covariance, condition))

    found, used, status = screen(fit, mask, level)
    solution, covariance, condition = found.quantities
    solution[status > EXCLUDED] = covariance[status > EXCLUDED] = np.nan
    arrays = (solution, covariance, condition, found.chi_square, found.degrees, used, status)
    return Velocity(*(a.reshape(shape + a.shape[1:]) for a in arrays))


def altitude(
    *,
    direction: np.ndarray,
    range: np.ndarray,
    standard_error: np.ndarray,
    offset: np.ndarray | None = None,
    slope: float = math.inf,
    relief: float = 0.0,
    level: float | None = None,
    least_spread: float = 1e-3,
) -> Altitude:
    """Altitude above the plane through each cycle's ground points, and its variance.

    With `slope` inf the plane is free. Three points that are not in line in plan determine it.
    From two, or from more in line, the ground slopes along that line and is taken as level
    across it; from one it is level. The variance does not count what such a guess may miss. A
    finite `slope` does: it weighs the ground's slope, known beforehand to be 0 with that standard
    deviation, against the points, whatever their number. 0 states level ground; then every
    second beam is a check on the first, and three are enough to find a false one.

    Parameters
    ----------
    direction : (..., b, 3) array_like
        Unit vectors from the instrument, z up.
    range, standard_error : (..., b) array_like
        Range along each beam, likewise [m].
    offset : (..., b, 3) array_like or None
        Place of the instrument when each beam fires, from that whose altitude is asked [m].
    slope : float
        Standard deviation of the ground's slope along any horizontal [1], 0..inf.
    relief : float
        Standard deviation of heights about the plane [m], which adds to the errors of range. Real
        ground fails the test for a false beam without it.
    level : float or None
        Level of the test for one false beam (:func:`screen`); None: no test.
    least_spread : float
        Points whose spread in plan (rms) is less than this many times their distance do not
        determine a slope in that direction; only for a `slope` of inf.

    Raises
    ------
    ValueError
        As for :func:`velocity`; `slope` or `relief` is negative or nan.
    """
    if not slope >= 0 or not 0 <= relief < math.inf:
        raise ValueError("the ground's slope and relief are not negative")
    u, distance, error, mask, shape = _flat_cycles(direction, range, standard_error)
    points = u * distance[..., None]
    if offset is not None:
        moved = np.broadcast_to(np.asarray(offset, float), (*shape, *u.shape[1:]))
        points += moved.reshape(u.shape)
    ground = slope, relief, least_spread

    def fit(index: np.ndarray, used: np.ndarray) -> Fit:
        n = index.size
        solution, chi, slopes = np.full((n, 4), np.nan), np.full(n, np.nan), np.zeros(n, np.int8)
        _fit_planes(points[index], u[index], error[index], used, ground, solution, slopes, chi)
        solved, needed = np.isfinite(chi), 1 + (0 if math.isfinite(slope) else slopes)
        degrees = np.where(solved, used.sum(axis=1) - needed, 0)
        return Fit(solved, chi, degrees, (*solution.T[:2], solution[:, 2:], slopes))

    found, used, status = screen(fit, mask, level)
    height, variance, gradient, slopes = found.quantities
    height[status > EXCLUDED] = variance[status > EXCLUDED] = np.nan
    gradient[status > EXCLUDED] = np.nan
    normal = np.concatenate([-gradient, np.ones((len(gradient), 1))], axis=1)
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    arrays = (height, variance, normal, slopes, found.chi_square, found.degrees, used, status)
    return Altitude(*(a.reshape(shape + a.shape[1:]) for a in arrays))


@njit(cache=True, nogil=True, error_model="numpy")
def _orthogonalise(columns, turn, square):
    """Turn a matrix (b, m) by Jacobi's rotations until its columns are orthogonal.

    This gives the singular values of even a nearly degenerate geometry to full relative accuracy;
    normal equations would square its condition number.

    Parameters
    ----------
    columns : (b, m) ndarray
        Becomes columns @ turn.
    turn : (m, m) ndarray
        Written: orthogonal, its columns the right singular vectors.
    square : (m,) ndarray
        Written: squares of the singular values, unsorted.
    """
    m = square.size
    for p in range(m):
        for q in range(m):
            turn[p, q] = 1.0 if p == q else 0.0
    done = False
    for _ in range(_MOST_SWEEPS):
        if done:
            break
        done = True
        for pair in range(m * (m - 1) // 2):  # first and second, first and third, second and third
            p, q = (0, pair + 1) if pair < m - 1 else (1, 2)
            alpha = beta = gamma = 0.0
            for i in range(columns.shape[0]):
                alpha += columns[i, p] * columns[i, p]
                beta += columns[i, q] * columns[i, q]
                gamma += columns[i, p] * columns[i, q]
            if abs(gamma) <= _ORTHOGONAL * math.sqrt(alpha) * math.sqrt(beta):
                continue
            done = False
            zeta = (beta - alpha) / (2.0 * gamma)
            tangent = math.copysign(1.0 / (abs(zeta) + math.hypot(1.0, zeta)), zeta)
            cosine = 1.0 / math.hypot(1.0, tangent)
            sine = cosine * tangent
            for matrix in (columns, turn):
                for i in range(matrix.shape[0]):
                    x, y = matrix[i, p], matrix[i, q]
                    matrix[i, p], matrix[i, q] = cosine * x - sine * y, sine * x + cosine * y
    for k in range(m):
        square[k] = 0.0
        for i in range(columns.shape[0]):
            square[k] += columns[i, k] * columns[i, k]


@njit(cache=True, nogil=True, error_model="numpy")
def _coordinate(columns, k, square, residual):
    """Coordinate of the residual along one orthogonal column, taken out of the residual."""
    coordinate = 0.0
    for i in range(residual.size):
        coordinate += columns[i, k] * residual[i] / square
    for i in range(residual.size):
        residual[i] -= coordinate * columns[i, k]
    return coordinate


@njit(cache=True, nogil=True, error_model="numpy")
def _fit_velocities(
    directions, closing, errors, used, limit, velocity, covariance, condition, chi
):  # fmt: skip
    """Velocity vectors of n cycles of b beams by weighted least squares; the last four are written.

    Parameters
    ----------
    directions : (n, b, 3) ndarray
        Unit vectors.
    closing, errors : (n, b) ndarray
        Radial velocities and their standard errors [m/s].
    used : (n, b) bool ndarray
        Beams that count; what stands in the others is not looked at.
    limit : float
        Condition number above which no solution is given.
    velocity, covariance : (n, 3), (n, 3, 3) ndarray
        Written where there is a solution [m/s], [m^2/s^2].
    condition : (n,) ndarray
        Ratio of the largest to the smallest singular value; inf with fewer than three beams.
    chi : (n,) ndarray
        Sum of the squared residuals over their variances; written where there is a solution.
    """
    n, b = closing.shape
    columns, turn, square, residual = np.empty((b, 3)), np.empty((3, 3)), np.empty(3), np.empty(b)
    for i in range(n):
        count = 0
        for j in range(b):
            count += used[i, j]
            residual[j] = closing[i, j] / errors[i, j] if used[i, j] else 0.0
            for k in range(3):
                columns[j, k] = directions[i, j, k] / errors[i, j] if used[i, j] else 0.0
        condition[i] = math.inf
        if count < 3:
            continue
        _orthogonalise(columns, turn, square)
        least = min(square[0], square[1], square[2])
        if least > 0.0:
            condition[i] = math.sqrt(max(square[0], square[1], square[2]) / least)
        if condition[i] > limit:
            continue
        chi[i] = 0.0
        for k in range(3):
            coordinate = _coordinate(columns, k, square[k], residual)
            for p in range(3):
                velocity[i, p] = turn[p, k] * coordinate + (velocity[i, p] if k else 0.0)
                for q in range(3):
                    further = turn[p, k] * turn[q, k] / square[k]
                    covariance[i, p, q] = further + (covariance[i, p, q] if k else 0.0)
        for j in range(b):
            chi[i] += residual[j] * residual[j]


@njit(cache=True, nogil=True, error_model="numpy")
def _fit_planes(points, beams, errors, used, ground, solution, slopes, chi):
    """Planes through the ground points of n cycles of b beams; the last three are written.

    The plane is z = -altitude + gradient . (x, y) with the platform at the zero. Heights are
    fitted at the points' measured places. An error of range moves a point off the plane by
    the error times ``gradient . (u_x, u_y) - u_z``, so the weights need the plane: a first fit
    takes level ground for them.

    Parameters
    ----------
    points, beams : (n, b, 3) ndarray
        Ground points from the platform [m] and unit vectors of the beams; z up.
    errors : (n, b) ndarray
        Standard errors of the ranges [m].
    used : (n, b) bool ndarray
        Beams that count.
    ground : (float, float, float)
        Standard deviation of the slope known beforehand [1] (inf: unknown; 0: level), that of
        heights about the plane [m], and the spread of the points in plan over their distance
        under which an unknown slope is taken as level.
    solution : (n, 4) ndarray
        Altitude, its variance and gradient [m], [m^2], [1]; written where any beam is used.
    slopes, chi : (n,) ndarray
        Likewise: slopes that were fitted, 0..2, and the weighted sum of squared residuals, that
        of the slopes known beforehand with it.
    """
    weight = np.empty(errors.shape[1])
    for i in range(errors.shape[0]):
        count = 0
        solution[i, 2] = solution[i, 3] = 0.0
        for _ in range(2):
            for j in range(weight.size):
                sine = solution[i, 2] * beams[i, j, 0] + solution[i, 3] * beams[i, j, 1]
                moved = errors[i, j] * max(sine - beams[i, j, 2], LEAST_SINE)
                weight[j] = 1.0 / math.hypot(moved, ground[1]) if used[i, j] else 0.0
                count += used[i, j]
            if count:
                slopes[i], chi[i] = _fit_plane(points[i], weight, ground[0], ground[2], solution[i])


@njit(cache=True, nogil=True, error_model="numpy")
def _fit_plane(points, weight, slope, least_spread, solution):
    """Number of slopes and chi-square of one plane; the solution (4,) is written.

    About the weighted centre of the points, height and slopes do not correlate. Slopes known
    beforehand are two more observations of 0 with that standard deviation.
    """
    b, total, centre = weight.size, 0.0, np.zeros(3)
    for j in range(b):
        total += weight[j] * weight[j]
    columns, residual = np.zeros((b + 2, 2)), np.zeros(b + 2)
    for j in range(b):
        for k in range(3):
            if weight[j] > 0.0:
                centre[k] += points[j, k] * (weight[j] * weight[j] / total)
    for j in range(b):
        if weight[j] > 0.0:
            residual[j] = weight[j] * (points[j, 2] - centre[2])
            for k in range(2):
                columns[j, k] = weight[j] * (points[j, k] - centre[k]) if slope > 0.0 else 0.0
    known = 0.0 < slope < math.inf
    if known:
        columns[b, 0] = columns[b + 1, 1] = 1.0 / slope
    turn, square = np.empty((2, 2)), np.empty(2)
    _orthogonalise(columns, turn, square)
    solution[0], solution[1], solution[2], solution[3] = -centre[2], 1.0 / total, 0.0, 0.0
    far = centre[0] * centre[0] + centre[1] * centre[1] + centre[2] * centre[2]
    slopes, chi = 0, 0.0
    for k in range(2):
        if known or (slope > 0.0 and math.sqrt(square[k]) > least_spread * math.sqrt(far * total)):
            slopes += 1
            coordinate = _coordinate(columns, k, square[k], residual)
            along = centre[0] * turn[0, k] + centre[1] * turn[1, k]
            solution[0] += along * coordinate
            solution[1] += along * along / square[k]
            solution[2] += turn[0, k] * coordinate
            solution[3] += turn[1, k] * coordinate
    for j in range(b + 2):
        chi += residual[j] * residual[j]
    return slopes, chi


def screen(
    fit: Callable[[np.ndarray, np.ndarray], Fit], valid: np.ndarray, level: float | None
) -> tuple[Fit, np.ndarray, np.ndarray]:
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
        Fit of the cycles of index (k,) by the beams of a mask (k, b).
    valid : (n, b) bool ndarray
        Beams that returned anything.
    level : float or None
        Probability that a cycle of true beams is suspect, 0 < . < 1; None: no test.

    Returns
    -------
    Fit, (n, b) bool ndarray, (n,) int8 ndarray
        The solutions, the beams in them and the status.

    Raises
    ------
    ValueError
        `level` is out of range.
    """
    n, b = valid.shape
    used = valid.copy()
    fitted = fit(np.arange(n), used)
    status = np.where(fitted.solved, SOLVED, UNDETERMINED).astype(np.int8)
    if level is None:
        return fitted, used, status
    if not 0 < level < 1:
        raise ValueError(f"the test's level lies between 0 and 1, not {level}")
    most = np.concatenate([[np.inf], chdtri(np.arange(1, b + 1), level)])
    suspect = np.flatnonzero(fitted.solved & (fitted.chi_square > most[fitted.degrees]))
    passes = np.zeros((suspect.size, b), bool)
    for beam in range(b):
        trial = fit(suspect, _without(used[suspect], beam))
        passes[:, beam] = trial.solved & (trial.chi_square <= most[trial.degrees])
    one = passes.sum(axis=1) == 1
    status[suspect] = np.where(one, EXCLUDED, WITHHELD)
    found, culprit = suspect[one], passes[one].argmax(axis=1)
    used[found, culprit] = False
    _replace(fitted, found, fit(found, used[found]))
    return fitted, used, status


def _without(used: np.ndarray, beam: int) -> np.ndarray:
    used = used.copy()
    used[:, beam] = False
    return used


def _replace(whole: Fit, rows: np.ndarray, part: Fit) -> None:
    """Writes some cycles' fits over those of the whole."""
    for old, new in zip((*whole[:3], *whole[3]), (*part[:3], *part[3]), strict=True):
        old[rows] = new
