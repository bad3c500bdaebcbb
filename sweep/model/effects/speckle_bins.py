"""Bins around the lines of a shot as linear functions of the beamlets' amplitudes.

With a factor f_b on the amplitude of each beamlet, bin k of a segment is (PHYSICS section 5)

    X[k] = sum_b [ C_b f_b W(k - nu_b) + C_b* f_b* W(k + nu_b) ]

up to a phase that is common to all beamlets. Where folding shows a line's image, its phase is
conjugated, and so is f_b. The bins looked at are those within ``margin`` of a line; in any other
no line stands higher than the window's envelope there.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.lines import folded_origin, segment_lines
from sweep.model.preparation import Shots
from sweep.model.waveform import SIGNS
from sweep.model.window import OVERSAMPLING, Window

SIDELOBE = 0.01
"""Bins in which a line stands below this share of its peak are left out."""

_TABLE_PAD = 8
_ORDER = 10


class Response(NamedTuple):
    """One segment's bins as linear in real and imaginary part of the beamlets' factors."""

    bins: np.ndarray
    """(k,) int64, rising; 0..N/2."""
    real: np.ndarray
    """(beamlets, k) complex: X for f_b = 1."""
    imaginary: np.ndarray
    """(beamlets, k) complex: X for f_b = i."""
    strength: np.ndarray
    """(beamlets,): |C_b| sum(w), the magnitude of a beamlet's line at its peak."""
    outside: float
    """Largest share of its peak at which a line, with its image, stands in any other bin."""

    def spectrum(self, factors: np.ndarray) -> np.ndarray:
        """X of the bins for factors (..., beamlets): (..., k) complex."""
        return np.asarray(
            np.einsum("...b,bk->...k", factors.real, self.real)
            + np.einsum("...b,bk->...k", factors.imag, self.imaginary)
        )

    def covariance(self) -> np.ndarray:
        """E X_k X_l* for independent circular f_b of mean power 1, (k, k)."""
        pairs = [np.einsum("bk,bl->kl", v, v.conj()) for v in (self.real, self.imaginary)]
        return np.asarray((pairs[0] + pairs[1]) / 2)


def margin(window: Window, sidelobe: float = SIDELOBE) -> float:
    """Distance [bins of fs/L] from which on a line stays below a share of its peak."""
    below = np.flatnonzero(window.envelope <= sidelobe)
    return float(window.reach[below[0]]) if below.size else float(window.reach[-1])


def response(shots: Shots, i: int, segment: int, *, margin_bins: float) -> Response:
    """Bins of a segment of point i, 0 up, 1 Doppler, 2 down.

    Parameters
    ----------
    margin_bins : float
        Bins of fs/L around each line that are looked at; of :func:`margin`.
    """
    row, size, length = shots.row[i], shots.fft_size, shots.window.length
    delta = np.empty((3, shots.offset.shape[1]))
    origin, fold = _lines(
        segment, _point(shots, i), (size, length), shots.offset[row], shots.doppler[row],
        shots.amplitude[row], delta,
    )  # fmt: skip
    weight = delta[1] + 1j * delta[2]
    reach = margin_bins * size / length
    bins = _bins(origin + delta[0], reach, size)
    ratio = length / size
    apart = (bins - origin)[None] - delta[0][:, None]
    line = weight[:, None] * _kernel(shots.window, apart * ratio)
    beyond = (bins + origin)[None] + delta[0][:, None]
    image = weight.conj()[:, None] * _kernel(shots.window, beyond * ratio)
    alone = _image_distance(origin + delta[0], size) * ratio
    outside = _envelope(shots.window, margin_bins) + _envelope(
        shots.window, max(alone, margin_bins)
    )
    return Response(
        bins, line + image, 1j * fold * (line - image), abs(weight) * shots.window.sum, outside
    )


def _point(shots: Shots, i: int) -> np.ndarray:
    """What the lines of point i need, as the first ten columns of the table of points."""
    columns = (
        shots.range, shots.beta, shots.chirp_rate, shots.beat_scale, shots.detector_bandwidth,
        shots.amplifier_bandwidth, shots.sample_rate, shots.acquisition_delay, shots.carriers[0],
        shots.carriers[2],
    )  # fmt: skip
    values = [np.asarray(column) for column in columns]
    return np.array([v[i] if v.ndim and v.size > 1 else v.ravel()[0] for v in values])


@njit(cache=True, error_model="numpy")
def _lines(segment, p, sizes, offset, doppler, amplitude, lines):
    """A segment's lines into (delta, re C, im C); their origin, and -1 where they are folded."""
    fft_size, length = sizes
    carrier = p[9] if segment == 2 else p[8]
    per_metre = SIGNS[segment] * p[2] * (2.0 / SPEED_OF_LIGHT)
    centre = (carrier * p[1] - per_metre * (1.0 + p[1]) * p[0]) * (fft_size / p[6])
    _, _, fold = folded_origin(centre, fft_size)
    origin = segment_lines(
        (SIGNS[segment], carrier), (p[2], p[0], p[1], p[3]), (p[4], p[5]),
        (p[6], fft_size, length, p[7]), offset, doppler, amplitude, lines[0], lines[1], lines[2],
    )  # fmt: skip
    return origin, fold


def _bins(positions: np.ndarray, reach: float, size: int) -> np.ndarray:
    """Bins 0..N/2 within a reach of any line or of its images beyond DC and Nyquist."""
    span = np.arange(math.ceil(2 * reach) + 2)
    bins = np.unique(np.floor(positions - reach)[:, None] + span)
    bins = np.abs(bins.astype(np.int64)) % size
    return np.unique(np.minimum(bins, size - bins))


def _image_distance(positions: np.ndarray, size: int) -> float:
    """Least distance [bins] from a bin 0..N/2 to the image of a line, 0 if lines lie beyond."""
    return float(max(0.0, min(positions.min(), size / 2 - positions.max())))


def _envelope(window: Window, distance: float) -> float:
    """Largest share of its peak that a line has at a distance [bins of fs/L] and beyond."""
    place = int(np.searchsorted(window.reach, distance, side="right")) - 1
    return float(window.envelope[place]) if place >= 0 else 1.0


def _kernel(window: Window, y: np.ndarray) -> np.ndarray:
    """W(y) e^{i pi y} = S(y) + i w[0] sin(pi y) of :mod:`sweep.model.window`, complex."""
    length = window.length
    rounds = np.rint(y / length)
    y = y - rounds * length
    sine = np.where(np.rint(y) % 2 == 0, 1.0, -1.0) * np.sin(np.pi * (y - np.rint(y)))
    real = _tabulated(window.table, y) if window.table.size else _closed(window, y, sine)
    parity = np.where((rounds * length) % 2 == 0, 1.0, -1.0)
    return np.asarray(parity * (real + 1j * window.edge * sine))


def _closed(window: Window, y: np.ndarray, sine: np.ndarray) -> np.ndarray:
    """S(y) of a cosine sum: sum_m c_m/2 [D(y - m) + D(y + m)], D(z) = sin(pi z) cot(pi z / L)."""
    total = np.zeros_like(y)
    for m, coefficient in enumerate(window.coefficients):
        for z in (y - m, y + m):
            there = z == 0
            tangent = np.tan(np.pi * np.where(there, 0.5, z) / window.length)
            term = np.where(there, float(window.length), (-1) ** m * sine / tangent)
            total += 0.5 * coefficient * term
    return total


def _tabulated(table: np.ndarray, y: np.ndarray) -> np.ndarray:
    """S(y) by Lagrange's polynomial through the ten entries of the table around y."""
    position = np.abs(y) * OVERSAMPLING
    index = np.floor(position).astype(np.int64)
    t = position - index
    top, bottom = np.zeros_like(t), np.zeros_like(t)
    start = index + _TABLE_PAD - 4
    for j in range(_ORDER):
        away = t + 4 - j
        weight = (-1) ** j * math.comb(_ORDER - 1, j) / np.where(away == 0, 1.0, away)
        top += np.where(t == 0, 0.0, weight) * table[start + j]
        bottom += np.where(t == 0, 0.0, weight)
    return np.where(t == 0, table[start + 4], top / np.where(t == 0, 1.0, bottom))
