"""How far the lines of a footprint lie apart, and what their spread can do to the largest bin.

Beamlet b of power share p_b has its line X_b bins off the beam's axis; as powers they make

    P_k = sum_b p_b F(k - x_0 - X_b)

in bin k. With the mean m and the rms s of X, added to lines of rms S, Taylor's series says

    |P_k(with) - P_k(without)| <= F1 |m| + F2 (S s + s^2 / 2) + c s,

F1, F2 bounds on |F'| and |F''| (:mod:`sweep.model.effects.lobes`), c what the receiver's poles
make of a bin's difference in frequency. Wide spreads have another bound: by Chebyshev's
inequality a share 1 - 1/t^2 of the power lies within t s, hence its energy in the 2 t s + 2 m + 1
bins around, of which the largest holds the mean at least; and no footprint's largest bin holds
less than its strongest beamlet's line. No bin holds more than all power on the lobe's peak.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.effects.change import Change
from sweep.model.effects.columns import columns, product_of, quotient_of
from sweep.model.effects.line_powers import (
    put_image_factors,
    put_moved_changes,
    put_power_ranges,
)
from sweep.model.effects.lobes import Lobe, lobe
from sweep.model.effects.span import Span
from sweep.model.footprint import beamlets
from sweep.model.window import Window


class Line(NamedTuple):
    """The line on the beam's axis, over the points of each tile; arrays of one shape."""

    bin_offset: np.ndarray
    """Largest distance from the nearest bin [bins], 0..1/2."""
    bin_offset_least: np.ndarray
    """Least distance from it."""
    edge: np.ndarray
    """Least distance of the folded line from the nearer of DC and Nyquist [bins], >= 0."""
    transfer: np.ndarray
    """Largest |H| at the line over that at DC, 0..1."""
    transfer_least: np.ndarray
    """Least of it."""
    tilt: np.ndarray
    """Bound c on the relative change of |H|^2 a bin, near the line [1/bin]."""
    lobe: Lobe


class Moments(NamedTuple):
    """Bounds on the lines' offsets from the axis [bins], weighted by echo power, (n,) each."""

    mean: np.ndarray | float
    rms: np.ndarray | float
    extreme: np.ndarray | float


NO_SPREAD = Moments(0.0, 0.0, 0.0)

BETA, RANGE = 3, 5
NOT_AWAY = 0.1
"""Bins by which the Doppler effect may move lines and yet be left out; further, it counts whole."""


def instrument_ends(
    *,
    chirp_rate: Span,
    carriers: Sequence[Span],
    bin_width: Span,
    detector_bandwidth: Span,
    amplifier_bandwidth: Span,
) -> np.ndarray:
    """What :func:`axis_ends` takes of the instrument, (9, 2, tiles), or (9, 2, 1) for all tiles."""
    none = Span.of(0.0)
    spans = (
        *carriers, none, chirp_rate * (2 / SPEED_OF_LIGHT), none, bin_width,
        detector_bandwidth, amplifier_bandwidth,
    )  # fmt: skip
    table, _ = columns(*(end for span in spans for end in (span.low, span.high)))
    return table.reshape(len(spans), 2, -1)


def axis_ends(tiles: int, instrument: np.ndarray, *, range: Span, beta: Span) -> np.ndarray:
    """Ends of what the axis's line follows from, (9, 2, tiles): what the others here take.

    Carriers of the three segments, Doppler ratio, chirp rate times 2/c, range, bin width, and
    bandwidths of detector and amplifier.
    """
    ends = np.empty((9, 2, tiles))
    ends[:] = instrument
    for row, span in (BETA, beta), (RANGE, range):
        ends[row, 0], ends[row, 1] = span.low, span.high
    return ends


def axis_lines(ends: np.ndarray, *, window: Window, fft_size: int) -> Line:
    """The axis's line in up, Doppler and down segment, (3, tiles), as :mod:`sweep.model.lines`."""
    found = np.empty((6, 3, ends.shape[2]))
    put_lines(ends, fft_size / 2, found)
    offset, least, edge, transfer, transfer_least, tilt = found
    form = lobe(window.name, window.length, fft_size)
    return Line(offset, least, edge, transfer, transfer_least, tilt, form)


def doppler_shifts(ends: np.ndarray) -> np.ndarray:
    """Bins by which the Doppler effect moves lines at the most, >= 0 (unfolded), (3, tiles).

    f beta, and the S tau beta by which it stretches the beat of the range.
    """
    found = np.empty((3, ends.shape[2]))
    put_shifts(ends, found)
    return found


def with_and_without(ends: np.ndarray, shifts: np.ndarray) -> np.ndarray:
    """Ends with Doppler ratios down to none where these move some line so little."""
    either = ends.copy()
    widen(either[BETA], shifts)
    return either


@njit(cache=True, error_model="numpy")
def widen(beta, shifts):
    """Extend ratios (2, tiles) to none in tiles of which some line moves so little."""
    for t in range(shifts.shape[1]):
        slow = False
        for s in range(shifts.shape[0]):
            slow |= shifts[s, t] <= NOT_AWAY
        if slow and np.maximum(abs(beta[0, t]), abs(beta[1, t])) > 0.0:
            beta[0, t], beta[1, t] = np.minimum(beta[0, t], 0.0), np.maximum(beta[1, t], 0.0)


@njit(cache=True, error_model="numpy")
def put_shifts(ends, out):
    """Shifts (3, tiles)."""
    for t in range(out.shape[1]):
        size = np.maximum(abs(ends[BETA, 0, t]), abs(ends[BETA, 1, t]))
        beat = product_of((ends[4, 0, t], ends[4, 1, t]), (ends[5, 0, t], ends[5, 1, t]))
        width = ends[6, 0, t], ends[6, 1, t]
        for s in range(3):
            frequency = ends[s, 0, t] + beat[0], ends[s, 1, t] + beat[1]
            out[s, t] = size * quotient_of(frequency, width)[1]


@njit(cache=True, error_model="numpy")
def put_lines(given, half, out):
    """Fields of :class:`Line`, (6, 3, tiles), from the ends of nine spans, (9, 2, tiles)."""
    for t in range(given.shape[2]):
        ends = given[:, :, t]
        beta, width = (ends[3, 0], ends[3, 1]), (ends[6, 0], ends[6, 1])
        stretched = product_of((ends[4, 0], ends[4, 1]), (1.0 + beta[0], 1.0 + beta[1]))
        beat = product_of(stretched, (ends[5, 0], ends[5, 1]))
        tilt = (1.0 / ends[7, 0] + 1.0 / ends[8, 0]) * width[1]
        for s in range(3):
            low, high = product_of((ends[s, 0], ends[s, 1]), beta)
            if s == 0:
                low, high = low - beat[1], high - beat[0]
            elif s == 2:
                low, high = low + beat[0], high + beat[1]
            one, other = abs(low), abs(high)
            furthest = max(one, other)
            nearest = 0.0 if low <= 0.0 and high >= 0.0 else min(one, other)
            position = quotient_of((low, high), width)
            out[0, s, t], out[1, s, t] = _from_whole(position)
            out[2, s, t] = _from_edge(position, half)
            out[3, s, t] = 1.0 / (
                math.hypot(1.0, nearest / ends[7, 1]) * math.hypot(1.0, nearest / ends[8, 1])
            )
            out[4, s, t] = 1.0 / (
                math.hypot(1.0, furthest / ends[7, 0]) * math.hypot(1.0, furthest / ends[8, 0])
            )
            out[5, s, t] = tilt


@njit(cache=True, error_model="numpy")
def _from_whole(position):
    """Largest and least distance from a whole number."""
    low, high = position
    one, other = abs(low - np.rint(low)), abs(high - np.rint(high))
    least = 0.0 if math.floor(high) > math.floor(low) else min(one, other)
    most = 0.5 if math.floor(high + 0.5) > math.floor(low + 0.5) else max(one, other)
    return most, least


@njit(cache=True, error_model="numpy")
def _from_edge(position, half):
    """Least distance of the folded line from DC and Nyquist."""
    low, high = position[0] / half, position[1] / half
    if math.floor(high) > math.floor(low):
        return 0.0
    return min(abs(low - np.rint(low)), abs(high - np.rint(high))) * half


def reach_of(number: int, pattern: str) -> float:
    """Largest angle of a beamlet off the axis, in standard deviations."""
    points, _ = beamlets(number, pattern)
    return float(np.sqrt((points**2).sum(axis=0)).max())


def range_to_bins(
    *, range: ArrayLike, beta: ArrayLike, chirp_rate: ArrayLike, bin_width: ArrayLike
) -> np.ndarray:
    """Bins of a chirped segment for a relative difference of range of 1; 0 in the Doppler's."""
    slope = 2 / SPEED_OF_LIGHT * np.asarray(chirp_rate, float) * (1 + np.abs(beta))
    return np.asarray(slope * np.asarray(range, float) / np.asarray(bin_width))


def velocity_to_bins(
    *, range: ArrayLike, carrier: ArrayLike, chirp_rate: ArrayLike, bin_width: ArrayLike
) -> np.ndarray:
    """Bins for 1 m/s: 2/c times the carrier, and the range's beat that beta stretches."""
    beat = np.asarray(chirp_rate, float) * (4 / SPEED_OF_LIGHT) * np.asarray(range, float)
    return np.asarray((2 / SPEED_OF_LIGHT) * (np.asarray(carrier) + beat) / np.asarray(bin_width))


class Spreads(NamedTuple):
    """What puts lines off the axis's [bins], (3, tiles) at the most."""

    ranges: Moments
    own_ranges: Moments
    """Of beamlets on the axis's surface."""
    velocities: Moments
    both: Moments
    """Ranges and velocities."""


def spreads(
    ends: np.ndarray, *, ranges: Moments, own_ranges: Moments, velocities: Moments
) -> Spreads:
    """Moments in bins, by :func:`range_to_bins` and :func:`velocity_to_bins` at the ends.

    Parameters
    ----------
    ends : (9, 2, tiles) ndarray
        :func:`axis_ends`.
    ranges, own_ranges : Moments
        Of (R_b - R_0) / R_0.
    velocities : Moments
        Of radial velocities [m/s].
    """
    given = np.empty((9, ends.shape[2]))
    for k, value in enumerate((*ranges, *own_ranges, *velocities)):
        given[k] = value
    found = np.empty((12, 3, ends.shape[2]))
    put_spreads(ends, given, found)
    return Spreads(*(Moments(*found[k : k + 3]) for k in range(0, 12, 3)))


@njit(cache=True, error_model="numpy")
def put_spreads(ends, given, out):
    """Moments (12, 3, tiles); infinite ones of ranges as numbers that may be multiplied by 0."""
    for t in range(given.shape[1]):
        beta, rate, far, width = ends[BETA, :, t], ends[4, 1, t], ends[5, 1, t], ends[6, 0, t]
        bins = rate * (1.0 + max(abs(beta[0]), abs(beta[1]))) * far / width
        beat = 2.0 * rate * far
        for k in range(3):
            for s in range(3):
                chirped = s != 1 and bins > 0.0
                for row in (k, 3 + k):
                    out[row, s, t] = bins * np.minimum(given[row, t], 1e200) if chirped else 0.0
                factor = (2 / SPEED_OF_LIGHT) * (ends[s, 1, t] + beat) / width
                out[6 + k, s, t] = given[6 + k, t] * factor
                out[9 + k, s, t] = out[k, s, t] + out[6 + k, s, t]


def power_range(line: Line, spread: Moments, beamlets: int) -> tuple[np.ndarray, np.ndarray]:
    """Least and largest power of the largest bin, over that of all lines on a bin.

    ``spread`` is that of the lines in it; images are in it.
    """
    table, shape = columns(line.bin_offset, line.bin_offset_least, line.edge, line.tilt, *spread)
    found = np.empty((2, *shape))
    put_power_ranges(table, beamlets, *sizes_of(line.lobe), found.reshape(2, -1))
    return found[0], found[1]


def sizes_of(f: Lobe) -> tuple[tuple[np.ndarray, ...], tuple[float, ...]]:
    """What compiled formulas take of a lobe."""
    return (f.highest, f.lowest), (f.slope, f.curvature, f.margin, f.energy)


def image_factor(line: Line, extreme: ArrayLike) -> np.ndarray:
    """How much larger images can make powers: 2 near DC and Nyquist."""
    table, shape = columns(line.edge, extreme)
    found = np.empty(shape)
    put_image_factors(table, line.lobe.margin, found.reshape(-1))
    return found


def spread_change(line: Line, added: Moments, present: Moments, beamlets: int) -> Change:
    """What spreading lines further can change in the largest bin's magnitude, as powers.

    Parameters
    ----------
    line : Line
        The axis's.
    added, present : Moments
        Of the offsets that the effect adds, and of those that there are without it.
    beamlets : int
        Lines at the most.
    """
    return moved_change(line, line, 0.0, added, present, beamlets)


def moved_change(
    moved: Line,
    still: Line,
    shift: ArrayLike,
    added: Moments,
    present: Moments,
    beamlets: int,
) -> Change:
    """What moving the axis's line by a known shift, and spreading lines further, can change.

    Parameters
    ----------
    moved, still : Line
        The axis's, with the effect and without.
    shift : array_like
        Bins from one to the other, unfolded, >= 0.
    added, present, beamlets
        As for :func:`spread_change`.
    """
    lines = moved[:-1] if moved is still else (*moved[:-1], *still[:-1])
    table, shape = columns(shift, *added, *present, *lines)
    found = np.empty((2, *shape))
    put_moved_changes(table, beamlets, *sizes_of(still.lobe), found.reshape(2, -1))
    return Change(signal=(found[0], found[1]))
