"""Measured frequency error of a sweep: a table, the series that stands for it, and its integral.

The series is that of Chebyshev, fitted by least squares, of the least degree that leaves no more
than :data:`RESIDUAL_MAX_OVER_SPAN` of the span of the table's values.
"""

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np

RESIDUAL_MAX_OVER_SPAN = 1e-3
"""Largest residual of a table's Chebyshev series, over the span of the table's values."""
CHEBYSHEV_DEGREE_MAX = 64
"""Degree of that series at the most."""


class SweepErrorTable(NamedTuple):
    """Measured frequency error of the sweep, by the time in the up-chirp."""

    first_time: float
    last_time: float
    """Times of the first and the last row [s]."""
    chebyshev_coefficients: np.ndarray
    """Chebyshev coefficients of the error [Hz] over those times."""

    def frequency_error(self, position: np.ndarray | float) -> np.ndarray:
        """Error [Hz] at places -1..1 over the table's times."""
        return np.asarray(np.polynomial.chebyshev.chebval(position, self.chebyshev_coefficients))

    def integrate_error(self, start: np.ndarray, end: np.ndarray) -> np.ndarray:
        """Integral of the error between two times [cycles]; held beyond the table's ends.

        Gauss's rule is exact for the series, and cancels nothing where the times are close.
        """
        half_span = (self.last_time - self.first_time) / 2
        start_position, end_position = (
            (time - self.first_time) / half_span - 1 for time in (start, end)
        )
        inner_start, inner_end = np.clip(start_position, -1, 1), np.clip(end_position, -1, 1)
        middle, half_step = (inner_start + inner_end) / 2, (inner_end - inner_start) / 2
        first_error, last_error = self.frequency_error(-1.0), self.frequency_error(1.0)
        integral_before_first = first_error * (
            np.minimum(end_position + 1, 0) - np.minimum(start_position + 1, 0)
        )
        total = integral_before_first + last_error * (
            np.maximum(end_position - 1, 0) - np.maximum(start_position - 1, 0)
        )
        nodes, weights = np.polynomial.legendre.leggauss(self.chebyshev_coefficients.size // 2 + 1)
        for node, weight in zip(nodes, weights, strict=True):
            total = total + weight * half_step * self.frequency_error(middle + half_step * node)
        return np.asarray(half_span * total)


@lru_cache(maxsize=16)
def fit_sweep_error(table_text: str) -> SweepErrorTable:
    """Fit a table of rows ``time error`` [s, Hz], separated by commas, by least squares.

    A ValueError where no series whose degree suits the number of rows leaves so little as
    :data:`RESIDUAL_MAX_OVER_SPAN`. Degrees above twice the root of the number would swing between
    rows.

    >>> sweep_table("0.0 0.0, 1.0 1.0, 2.0 2.0").series.round(12).tolist()  # a straight line
    [1.0, 1.0]
    """
    time, error = np.array([row.split() for row in table_text.split(",")], float).T
    position = (2 * time - time[0] - time[-1]) / (time[-1] - time[0])
    degree_max = min(CHEBYSHEV_DEGREE_MAX, time.size // 2, int(2 * math.sqrt(time.size)))
    orthogonal_basis, triangular_factor = np.linalg.qr(
        np.polynomial.chebyshev.chebvander(position, degree_max)
    )
    projection = orthogonal_basis.T @ error
    span, residual = np.ptp(error), error.copy()
    for degree in range(degree_max + 1):
        residual = residual - orthogonal_basis[:, degree] * projection[degree]
        if np.abs(residual).max() <= RESIDUAL_MAX_OVER_SPAN * span + 1e-12 * np.abs(error).max():
            used_terms = slice(0, degree + 1)
            return SweepErrorTable(
                time[0],
                time[-1],
                np.linalg.solve(triangular_factor[used_terms, used_terms], projection[used_terms]),
            )
    raise ValueError(
        f"is not smooth: a Chebyshev series of degree {degree_max}, the most for {time.size} rows, "
        f"leaves {np.abs(residual).max() / span:.2g} of its span, more than "
        f"{RESIDUAL_MAX_OVER_SPAN:g}"
    )
