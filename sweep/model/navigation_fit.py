"""Compiled least squares of measurement cycles: a velocity vector, or a plane of ground, from each.

Both are whitened (every row divided by its standard error) and solved by one-sided Jacobi
rotations. These turn the columns until they are orthogonal, which gives the singular values of
even a nearly degenerate geometry to full relative accuracy; normal equations would square its
condition number.
"""

import math

import numpy as np
from numba import njit

LEAST_SINE = 0.05
"""A beam that grazes the ground at less than about 3 deg is weighted as if at that angle."""

_ORTHOGONAL = 1e-15
_MOST_SWEEPS = 40  # about 5 are needed; a sweep that rounding keeps alive must end


@njit(cache=True, nogil=True)
def orthogonalise(columns, turn):
    """Right singular vectors of a matrix (b, m), which it turns into orthogonal columns.

    Parameters
    ----------
    columns : (b, m) ndarray
        Becomes columns @ turn; the norms of its columns are the singular values, unsorted.
    turn : (m, m) ndarray
        Written: orthogonal, its columns the right singular vectors.
    """
    m = columns.shape[1]
    for p in range(m):
        for q in range(m):
            turn[p, q] = 1.0 if p == q else 0.0
    for _ in range(_MOST_SWEEPS):
        done = True
        for p in range(m - 1):
            for q in range(p + 1, m):
                done &= _orthogonal_pair(columns, turn, p, q)
        if done:
            return


@njit(cache=True, nogil=True)
def _orthogonal_pair(columns, turn, p, q):
    """Whether two columns are orthogonal; if not, they are turned until they are."""
    alpha = beta = gamma = 0.0
    for i in range(columns.shape[0]):
        alpha += columns[i, p] * columns[i, p]
        beta += columns[i, q] * columns[i, q]
        gamma += columns[i, p] * columns[i, q]
    if abs(gamma) <= _ORTHOGONAL * math.sqrt(alpha) * math.sqrt(beta):
        return True
    zeta = (beta - alpha) / (2.0 * gamma)
    tangent = math.copysign(1.0 / (abs(zeta) + math.hypot(1.0, zeta)), zeta)
    cosine = 1.0 / math.hypot(1.0, tangent)
    _turn_pair(columns, p, q, cosine, cosine * tangent)
    _turn_pair(turn, p, q, cosine, cosine * tangent)
    return False


@njit(cache=True, nogil=True)
def _turn_pair(matrix, p, q, cosine, sine):
    for i in range(matrix.shape[0]):
        x, y = matrix[i, p], matrix[i, q]
        matrix[i, p], matrix[i, q] = cosine * x - sine * y, sine * x + cosine * y


@njit(cache=True, nogil=True)
def _sum_of_squares(values):
    total = 0.0
    for i in range(values.size):
        total += values[i] * values[i]
    return total


@njit(cache=True, nogil=True)
def _coordinate(columns, k, square, residual):
    """Coordinate of the residual along one orthogonal column, taken out of the residual."""
    coordinate = 0.0
    for i in range(residual.size):
        coordinate += columns[i, k] * residual[i] / square
    for i in range(residual.size):
        residual[i] -= coordinate * columns[i, k]
    return coordinate


@njit(cache=True, nogil=True)
def fit_velocities(directions, closing, errors, used, limit, velocity, covariance, condition, chi):
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
    columns, turn = np.empty((b, 3)), np.empty((3, 3))
    residual, coordinate, square = np.empty(b), np.empty(3), np.empty(3)
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
        orthogonalise(columns, turn)
        for k in range(3):
            square[k] = _sum_of_squares(columns[:, k])
        least = min(square[0], square[1], square[2])
        if least > 0.0:
            condition[i] = math.sqrt(max(square[0], square[1], square[2]) / least)
        if condition[i] > limit:
            continue
        for k in range(3):
            coordinate[k] = _coordinate(columns, k, square[k], residual)
        chi[i] = _sum_of_squares(residual)
        _assemble(turn, coordinate, square, velocity[i], covariance[i])


@njit(cache=True, nogil=True)
def _assemble(turn, coordinate, square, velocity, covariance):
    """Writes the solution (3,) and its covariance (3, 3) from singular vectors and values."""
    velocity[:] = 0.0
    covariance[:] = 0.0
    for k in range(3):
        for p in range(3):
            velocity[p] += turn[p, k] * coordinate[k]
            for q in range(3):
                covariance[p, q] += turn[p, k] * turn[q, k] / square[k]


@njit(cache=True, nogil=True)
def fit_planes(points, beams, errors, used, ground, altitude, variance, gradient, slopes, chi):
    """Planes through the ground points of n cycles of b beams; the last five are written.

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
    ground : (3,) ndarray
        Standard deviation of the slope known beforehand [1] (inf: unknown; 0: level), that of
        heights about the plane [m], and the spread of the points in plan over their distance
        under which an unknown slope is taken as level.
    altitude, variance : (n,) ndarray
        [m], [m^2]; written where any beam is used.
    gradient : (n, 2) ndarray
        Likewise, [1].
    slopes : (n,) integer ndarray
        Slopes that were fitted, 0..2.
    chi : (n,) ndarray
        Weighted sum of squared residuals, that of the slopes known beforehand with it.
    """
    n, b = errors.shape
    for i in range(n):
        if not used[i].any():
            continue
        weight = np.zeros(b)
        gradient[i, 0] = gradient[i, 1] = 0.0
        for _ in range(2):
            for j in range(b):
                if used[i, j]:
                    x, y, z = beams[i, j]
                    sine = gradient[i, 0] * x + gradient[i, 1] * y - z
                    moved = errors[i, j] * max(sine, LEAST_SINE)
                    weight[j] = 1.0 / math.hypot(moved, ground[1])
            altitude[i], variance[i], slopes[i], chi[i] = _fit_plane(
                points[i], weight, ground[0], ground[2], gradient[i]
            )


@njit(cache=True, nogil=True)
def _fit_plane(points, weight, slope, least_spread, gradient):
    """Altitude, its variance, number of slopes and chi-square; the gradient (2,) is written.

    About the weighted centre of the points, height and slopes do not correlate. Slopes known
    beforehand are two more observations of 0 with that standard deviation.
    """
    b, total = weight.size, _sum_of_squares(weight)
    centre, columns, residual = np.zeros(3), np.zeros((b + 2, 2)), np.zeros(b + 2)
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
    turn = np.empty((2, 2))
    orthogonalise(columns, turn)
    height, variance, slopes = centre[2], 1.0 / total, 0
    gradient[0] = gradient[1] = 0.0
    least = least_spread * math.sqrt(_sum_of_squares(centre) * total)
    for k in range(2):
        square = _sum_of_squares(columns[:, k])
        if known or (slope > 0.0 and math.sqrt(square) > least):
            slopes += 1
            coordinate = _coordinate(columns, k, square, residual)
            gradient[0] += turn[0, k] * coordinate
            gradient[1] += turn[1, k] * coordinate
            along = centre[0] * turn[0, k] + centre[1] * turn[1, k]
            height -= along * coordinate
            variance += along * along / square
    return -height, variance, slopes, _sum_of_squares(residual)
