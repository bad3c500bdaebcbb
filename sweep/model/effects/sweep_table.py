"""Measured frequency error of a sweep: a table, the series that stands for it, and its integral.

The series is that of Chebyshev, fitted by least squares, of the least degree that leaves no more
than :data:`TABLE_RESIDUAL` of the span of the table's values.
"""

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np

TABLE_RESIDUAL = 1e-3
"""Largest residual of a table's Chebyshev series, over the span of the table's values."""
TABLE_DEGREE = 64
"""Degree of that series at the most."""


class SweepTable(NamedTuple):
    """Measured frequency error of the sweep, by the time in the up-chirp."""

    first: float
    last: float
    """Times of the first and the last row [s]."""
    series: np.ndarray
    """Chebyshev coefficients of the error [Hz] over those times."""

    def error(self, place: np.ndarray | float) -> np.ndarray:
        """Error [Hz] at places -1..1 over the table's times."""
        return np.asarray(np.polynomial.chebyshev.chebval(place, self.series))

    def integral(self, start: np.ndarray, end: np.ndarray) -> np.ndarray:
        """Integral of the error between two times [cycles]; held beyond the table's ends.

        Gauss's rule is exact for the series, and cancels nothing where the times are close.
        """
        half = (self.last - self.first) / 2
        a, b = ((t - self.first) / half - 1 for t in (start, end))
        inner_a, inner_b = np.clip(a, -1, 1), np.clip(b, -1, 1)
        middle, step = (inner_a + inner_b) / 2, (inner_b - inner_a) / 2
        low, high = self.error(-1.0), self.error(1.0)
        outside = low * (np.minimum(b + 1, 0) - np.minimum(a + 1, 0))
        total = outside + high * (np.maximum(b - 1, 0) - np.maximum(a - 1, 0))
        nodes, weights = np.polynomial.legendre.leggauss(self.series.size // 2 + 1)
        for node, weight in zip(nodes, weights, strict=True):
            total = total + weight * step * self.error(middle + step * node)
        return np.asarray(half * total)


@lru_cache(maxsize=16)
def sweep_table(text: str) -> SweepTable:
    """Fit a table of rows ``time error`` [s, Hz], separated by commas, by least squares.

    A ValueError where no series whose degree suits the number of rows leaves so little as
    :data:`TABLE_RESIDUAL`. Degrees above twice the root of the number would swing between rows.

    >>> sweep_table("0.0 0.0, 1.0 1.0, 2.0 2.0").series.round(12).tolist()  # a straight line
    [1.0, 1.0]
    """
    time, error = np.array([row.split() for row in text.split(",")], float).T
    place = (2 * time - time[0] - time[-1]) / (time[-1] - time[0])
    most = min(TABLE_DEGREE, time.size // 2, int(2 * math.sqrt(time.size)))
    orthogonal, triangle = np.linalg.qr(np.polynomial.chebyshev.chebvander(place, most))
    share = orthogonal.T @ error
    span, left = np.ptp(error), error.copy()
    for degree in range(most + 1):
        left = left - orthogonal[:, degree] * share[degree]
        if np.abs(left).max() <= TABLE_RESIDUAL * span + 1e-12 * np.abs(error).max():
            used = slice(0, degree + 1)
            return SweepTable(time[0], time[-1], np.linalg.solve(triangle[used, used], share[used]))
    raise ValueError(
        f"is not smooth: a Chebyshev series of degree {most}, the most for {time.size} rows, "
        f"leaves {np.abs(left).max() / span:.2g} of its span, more than {TABLE_RESIDUAL:g}"
    )
