"""Measured frequency error of a sweep: a table, its Chebyshev series, and the series' integral.

The Chebyshev series is fitted by least squares. Its degree is the smallest that leaves a residual
of at most :data:`RESIDUAL_MAX_OVER_SPAN` of the span of the table's values.
"""

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np

RESIDUAL_MAX_OVER_SPAN = 1e-3
"""Largest allowed departure of a Chebyshev series from the table that it fits, as a fraction
of the table's span (largest minus smallest value)."""
CHEBYSHEV_DEGREE_MAX = 64
"""Largest degree of the Chebyshev series that is fitted to a table of frequency errors."""


class SweepFrequencyError(NamedTuple):
    """Measured frequency error of the sweep over the time in the up-chirp."""

    first_time: float
    """Time in the up-chirp of the table's first row [s]."""
    last_time: float
    """Time in the up-chirp of the table's last row [s]."""
    chebyshev_coefficients: np.ndarray
    """Chebyshev coefficients [Hz] of the frequency error from the table's first to its last
    time."""

    def frequency_error(self, position: np.ndarray | float) -> np.ndarray:
        """Return the frequency error [Hz] at positions between first (-1) and last time (1)."""
        return np.asarray(np.polynomial.chebyshev.chebval(position, self.chebyshev_coefficients))

    def integrate_error(self, start: np.ndarray, end: np.ndarray) -> np.ndarray:
        """Return the integral of the frequency error between two times.

        Parameters
        ----------
        start, end : ndarray
            Times in the up-chirp [s]; beyond the table's ends the error is constant.

        Returns
        -------
        ndarray
            Integral [cycles], in the shape to which the times broadcast.

        Notes
        -----
        Gauss-Legendre quadrature is exact for the Chebyshev series. Its result keeps its relative
        precision if the two times are close.
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
def fit_sweep_frequency_error(table_text: str) -> SweepFrequencyError:
    """Fit a Chebyshev series to a table of frequency errors by least squares.

    Parameters
    ----------
    table_text : str
        Rows ``time error`` [s, Hz], separated by commas.

    Returns
    -------
    SweepFrequencyError

    Raises
    ------
    ValueError
        If no series of a degree suitable for the number of rows has a residual below
        :data:`RESIDUAL_MAX_OVER_SPAN`. Degrees above twice the root of that number would oscillate
        between rows.

    Examples
    --------
    >>> table = fit_sweep_frequency_error("0.0 0.0, 1.0 1.0, 2.0 2.0")  # a straight line
    >>> table.chebyshev_coefficients.round(12).tolist()
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
            return SweepFrequencyError(
                time[0],
                time[-1],
                np.linalg.solve(triangular_factor[used_terms, used_terms], projection[used_terms]),
            )
    raise ValueError(
        f"is not smooth: a Chebyshev series of degree {degree_max}, the most for {time.size} rows, "
        f"leaves {np.abs(residual).max() / span:.2g} of its span, more than "
        f"{RESIDUAL_MAX_OVER_SPAN:g}"
    )
