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
from typing import NamedTuple

import numpy as np

from sweep.model.navigation_fit import fit_planes, fit_velocities
from sweep.model.navigation_screening import EXCLUDED, Fit, screen


def flat_cycles(
    direction: np.ndarray,
    value: np.ndarray,
    standard_error: np.ndarray,
    valid: np.ndarray | None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, tuple[int, ...]]:
    """Directions (n, b, 3), values, errors and mask (n, b), and the shape that n stands for."""
    u, value, error = (np.asarray(a, float) for a in (direction, value, standard_error))
    if u.shape[-1:] != (3,):
        raise ValueError(f"directions have three components: (..., b, 3), not {u.shape}")
    mask = np.isfinite(value) if valid is None else np.asarray(valid, bool)
    shape = np.broadcast_shapes(u.shape[:-1], value.shape, error.shape, mask.shape)
    if not shape:
        raise ValueError("a cycle of beams has a dimension for them, the last: (..., b)")
    u = np.ascontiguousarray(np.broadcast_to(u, (*shape, 3))).reshape(-1, shape[-1], 3)
    value, error, mask = (
        np.ascontiguousarray(np.broadcast_to(a, shape)).reshape(-1, shape[-1])
        for a in (value, error, mask)
    )
    if not np.isfinite(value[mask]).all():
        raise ValueError("a valid beam has a value that is not finite")
    if not (np.isfinite(error[mask]) & (error[mask] > 0)).all():
        raise ValueError("a valid beam has a standard error that is not positive and finite")
    if not (np.abs(np.linalg.norm(u[mask], axis=-1) - 1) < 1e-6).all():
        raise ValueError("a valid beam has a direction whose length is not 1")
    return u, value, error, mask, shape[:-1]


def level_frame(up: np.ndarray | tuple[float, float, float]) -> np.ndarray:
    """Two horizontal unit vectors and the vertical as rows, (..., 3, 3).

    x, y, z themselves for an upward z. Without a singular direction, after Duff et al. (2017),
    "Building an orthonormal basis, revisited".
    """
    z = np.asarray(up, float)
    if z.shape[-1:] != (3,) or not (np.abs(np.linalg.norm(z, axis=-1) - 1) < 1e-6).all():
        raise ValueError("the vertical is a unit vector (..., 3)")
    sign = np.copysign(1.0, z[..., 2])
    a = -1 / (sign + z[..., 2])
    b = z[..., 0] * z[..., 1] * a
    x = np.stack([1 + sign * z[..., 0] ** 2 * a, sign * b, -sign * z[..., 0]], axis=-1)
    y = np.stack([b, sign + z[..., 1] ** 2 * a, -z[..., 1]], axis=-1)
    return np.stack([x, y, z], axis=-2)


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
    """(...,) int8: SOLVED, EXCLUDED, WITHHELD or UNDETERMINED of navigation_screening."""

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
    """(...,) int8: SOLVED, EXCLUDED, WITHHELD or UNDETERMINED of navigation_screening."""

    @property
    def available(self) -> np.ndarray:
        """(...,) bool: whether there is a solution."""
        return self.status <= EXCLUDED


def velocity(
    *,
    direction: np.ndarray,
    radial_velocity: np.ndarray,
    standard_error: np.ndarray,
    valid: np.ndarray | None = None,
    level: float | None = None,
    largest_condition: float = 1e6,
) -> Velocity:
    """Velocity vector and covariance of each cycle of b beams.

    Parameters
    ----------
    direction : (..., b, 3) array_like
        Unit vectors from the instrument; their frame is that of the result.
    radial_velocity, standard_error : (..., b) array_like
        Closing velocity along each beam and its standard error > 0 [m/s].
    valid : (..., b) array_like of bool or None
        Beams that returned; what stands in the others is not looked at. None: those of finite
        radial velocity.
    level : float or None
        Level of the test for one false beam (:func:`navigation_screening.screen`), which needs
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
    u, closing, error, mask, shape = flat_cycles(direction, radial_velocity, standard_error, valid)

    def fit(index: np.ndarray, used: np.ndarray) -> Fit:
        n = index.size
        solution, condition, chi = np.full((n, 3), np.nan), np.empty(n), np.full(n, np.nan)
        covariance = np.full((n, 3, 3), np.nan)
        fit_velocities(
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
    valid: np.ndarray | None = None,
    up: np.ndarray | tuple[float, float, float] = (0.0, 0.0, 1.0),
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
        Unit vectors from the instrument.
    range, standard_error : (..., b) array_like
        Range along each beam and its standard error > 0 [m].
    valid : (..., b) array_like of bool or None
        Beams that returned; None: those of finite range.
    up : (..., 3) array_like
        Unit vector of the vertical in the frame of the directions; one for each cycle if need be.
    offset : (..., b, 3) array_like or None
        Place of the instrument when each beam fires, from that whose altitude is asked [m].
    slope : float
        Standard deviation of the ground's slope along any horizontal [1], 0..inf.
    relief : float
        Standard deviation of heights about the plane [m], which adds to the errors of range. Real
        ground fails the test for a false beam without it.
    level : float or None
        Level of the test for one false beam (:func:`navigation_screening.screen`); None: no test.
    least_spread : float
        Points whose spread in plan (rms) is less than this many times their distance do not
        determine a slope in that direction; only for a `slope` of inf.

    Raises
    ------
    ValueError
        As for :func:`velocity`; `up` is not of length 1; `slope` or `relief` is negative or nan.
    """
    if not slope >= 0 or not 0 <= relief < math.inf:
        raise ValueError("the ground's slope and relief are not negative")
    u, distance, error, mask, shape = flat_cycles(direction, range, standard_error, valid)
    frame = np.broadcast_to(level_frame(up), (*shape, 3, 3)).reshape(-1, 3, 3)
    beams = u @ frame.swapaxes(-1, -2)
    points = beams * distance[..., None]
    if offset is not None:
        moved = np.broadcast_to(np.asarray(offset, float), (*shape, *u.shape[1:])).reshape(u.shape)
        points += moved @ frame.swapaxes(-1, -2)
    ground = np.array([slope, relief, least_spread])

    def fit(index: np.ndarray, used: np.ndarray) -> Fit:
        n = index.size
        height, variance, chi = np.full((3, n), np.nan)
        gradient, slopes = np.full((n, 2), np.nan), np.zeros(n, np.int8)
        fit_planes(
            points[index], beams[index], error[index], used, ground,
            height, variance, gradient, slopes, chi,
        )  # fmt: skip
        solved, needed = np.isfinite(chi), 1 + (0 if math.isfinite(slope) else slopes)
        degrees = np.where(solved, used.sum(axis=1) - needed, 0)
        return Fit(solved, chi, degrees, (height, variance, gradient, slopes))

    found, used, status = screen(fit, mask, level)
    height, variance, gradient, slopes = found.quantities
    height[status > EXCLUDED] = variance[status > EXCLUDED] = np.nan
    gradient[status > EXCLUDED] = np.nan
    normal = np.concatenate([-gradient, np.ones((len(gradient), 1))], axis=1)
    normal = ((normal / np.linalg.norm(normal, axis=1)[:, None])[:, None] @ frame)[:, 0]
    arrays = (height, variance, normal, slopes, found.chi_square, found.degrees, used, status)
    return Altitude(*(a.reshape(shape + a.shape[1:]) for a in arrays))
