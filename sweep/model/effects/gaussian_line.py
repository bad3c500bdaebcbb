"""A Gaussian line: the shifts that stand for its width."""

import math
from typing import NamedTuple

import numpy as np

from sweep.model.unsupported import UnsupportedShot

DEVIATION_OF_FWHM = 1 / math.sqrt(8 * math.log(2))
"""Standard deviation of a Gaussian over its full width at half maximum."""

TOLERANCE = 1e-12
"""Error of a mean power from a sum over shifts, relative to the power at the line's peak."""

MOST_BINS = 500
"""Standard deviation of a Gaussian line [bins of fs/L] that shifts stand for."""


class Shifts(NamedTuple):
    """Frequencies over which |X|^2 is to be averaged."""

    offset: np.ndarray
    """(n, k): shifts of all lines [bins of fs/L]."""
    weight: np.ndarray
    """(n, k): weights of the powers, >= 0, sum 1."""


def gaussian_shifts(*, fwhm: np.ndarray, duration: np.ndarray) -> Shifts:
    """Shifts and weights whose weighted mean of |X|^2 is that under a Gaussian line.

    Parameters
    ----------
    fwhm : (n,) ndarray
        Full width at half maximum of the beat's line [Hz], >= 0.
    duration : (n,) ndarray
        Length of the record L/fs [s].

    Raises
    ------
    UnsupportedShot
        For a line of more than :data:`MOST_BINS` bins standard deviation.

    Notes
    -----
    One shift for no width, 19 for lines narrow against a bin, 15 more for each bin of standard
    deviation; weights of 0 fill rows with fewer than k. With
    step h the error is exp(-2 pi^2 s^2 (1/h - 1)^2) at the record's longest lag, by Poisson's
    summation formula; the Gaussian's tails are cut where they hold as much.
    """
    deviation = np.atleast_1d(DEVIATION_OF_FWHM * np.asarray(fwhm, float) * duration)
    if deviation.max(initial=0.0) > MOST_BINS:
        raise UnsupportedShot(
            f"instrument.laser.line_width makes a line of {deviation.max():.3g} bins standard "
            f"deviation, and {MOST_BINS} can be simulated: lower it, or shorten the record by "
            "instrument.processing.fft_size"
        )
    room = math.sqrt(math.log(2 / TOLERANCE) / 2) / math.pi
    per_deviation = deviation + room  # s / h
    reach = math.sqrt(2 * math.log(1 / TOLERANCE))
    most = int(np.ceil(reach * per_deviation.max(initial=0.0)))
    place = np.arange(-most, most + 1) / per_deviation[:, None]
    weight = np.where(
        np.abs(place) <= reach + 1 / per_deviation[:, None], np.exp(-(place**2) / 2), 0.0
    )
    weight[deviation == 0] = np.arange(-most, most + 1) == 0
    # One after the other, so that zeros beside them, and thus other rows, change no bit.
    weight /= np.cumsum(weight, axis=1)[:, -1:]
    return Shifts(deviation[:, None] * place, weight)
