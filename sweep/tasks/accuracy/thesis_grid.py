"""The thesis's way to a spectrum: lines put on an oversampled grid, the window by an FFT.

[T 3.3.1] convolves "the spectra of the mixed signals" with the window's transform "with much
higher sampling rate in the frequency domain than the FFT bin spacing", by an FFT "typically of
size 2^11 or 2^12", and samples what comes out at the bins. Here: a grid of 16 cells a bin around
the beam's centre, each beamlet's line put into the nearest cell, one FFT, a product with the
transform of the window's own, and back.

It can be done better, which is here too. Where powers add, the grid holds real numbers, and half of
their transforms is enough (`real`). Only the bins are asked for, so that a transform of one
sixteenth of the size is enough for the way back (`folded`). And a line in the nearest cell is up
to 1/32 bin off: 2e-2 of the peak at worst. Shared out among ten cells by Lagrange's polynomial of
degree 9 it is where it belongs, to 1e-12 for a window that falls off to its ends.

It is here to be compared with (`sweep accuracy`), and is as fast as it can fairly be made. What
befalls lines within a record (range walk, line width) it leaves out, and leakage beyond the grid.
"""

from functools import lru_cache

import numpy as np
from numba import njit
from scipy import fft

from sweep.model import window as windows
from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.detection import detect_rows
from sweep.model.lines import BLOCK, IM, PLACE, RE, place_lines
from sweep.model.preparation import Shots

CELLS = 16
"""Cells of the grid in a bin of the FFT."""

SIZE = 1 << 12
"""Cells of the grid, where the footprint's lines leave enough room beside them."""

ROOM = 16
"""Bins beside the lines that must be free of what comes round the grid's ends."""

_ROWS = 32
"""Spectra that are transformed together: as many as the processor's cache holds."""


def find(
    shots: Shots, *, degree: int = 0, size: int = SIZE, real: bool = False, folded: bool = False
) -> np.ndarray:
    """Largest bins of each segment's spectrum, as :func:`sweep.model.shot.find`; no leakage.

    Parameters
    ----------
    shots : Shots
        n points.
    degree : int
        Of the polynomial that shares a line out: 0, to the nearest cell, or 9, among ten.
    size : int
        Cells of the grid at the least, a power of two; points whose lines spread too far for it
        get a larger one.
    real, folded : bool
        Whether powers are transformed as the real numbers that they are; whether the way back is to
        the bins alone.

    Returns
    -------
    (3, 6, n) ndarray
        By segment and :data:`sweep.model.segments.SEGMENT_FIELDS`.
    """
    found = np.full((3, 6, shots.size), np.nan)
    table, sizes = shots.point_table(), grid_sizes(shots, size)
    for cells in np.unique(sizes):
        for segment in np.flatnonzero(shots.segments):
            members = np.flatnonzero(sizes == cells)
            for index in np.split(members, range(_ROWS, members.size, _ROWS)):
                low, magnitude = magnitudes(
                    shots, table, index, int(segment), int(cells), (degree, real, folded)
                )
                out = np.empty((6, index.size))
                bins = shots.fft_size // 2, 1.0 / shots.fft_size
                levels = table[13, index], table[11, index]
                detect_rows(magnitude, low, bins, shots.echo_rule, *levels, out)
                out[3] *= table[6, index]
                found[segment][:, index] = out
    return found


def grid_sizes(shots: Shots, least: int = SIZE) -> np.ndarray:
    """Cells of each point's grid, (n,) int64: the lines in its middle, and room beside them."""
    per_ratio = 2 * np.abs(shots.chirp_rate) * shots.range / SPEED_OF_LIGHT
    carrier = np.max([np.max(c) for c in shots.carriers])
    offset = np.abs(shots.offset).max(axis=1)[shots.row]
    doppler = np.abs(shots.doppler).max(axis=1)[shots.row]
    spread = per_ratio * (offset + doppler) + carrier * doppler
    bins = spread * shots.fft_size / shots.sample_rate
    needed = np.ceil(np.log2(4 * CELLS * (bins + ROOM)))
    return np.maximum(least, 2 ** needed.astype(np.int64))


def magnitudes(
    shots: Shots,
    table: np.ndarray,
    index: np.ndarray,
    segment: int,
    cells: int,
    how: tuple[int, bool, bool],
) -> tuple[np.ndarray, np.ndarray]:
    """First bin (m,) and |X| (m, cells / CELLS) of some points' spectra around their lines.

    ``how``: `degree`, `real` and `folded` of :func:`find`.
    """
    degree, real, folded = how
    power, length = shots.incoherent, shots.window.length
    real = real and power
    grid = np.zeros((index.size, cells), float if real else complex)
    origin = np.empty(index.size, np.int64)
    _deposit(
        np.ascontiguousarray(table[:, index]), shots.row[index], shots.footprint, segment,
        np.array([shots.fft_size, length, 0, 0, power, 0]), shots.image, _weights(degree), origin,
        grid.view(float).reshape(index.size, cells, -1),
    )  # fmt: skip
    kernel = _kernel(shots.window.name, length, shots.fft_size, cells, power, real)
    convolved = (_real_bins if real else _complex_bins)(grid, kernel, folded)
    # Rounding takes a sum of squares that is all but nothing below it.
    magnitude = np.sqrt(np.maximum(convolved.real, 0.0)) if power else np.abs(convolved)
    return origin - cells // (2 * CELLS), magnitude


def _complex_bins(grid: np.ndarray, kernel: np.ndarray, folded: bool) -> np.ndarray:
    """The convolution of amplitudes at every sixteenth cell."""
    transform = fft.fft(grid, axis=1, overwrite_x=True)
    transform *= kernel
    if not folded:
        return np.asarray(fft.ifft(transform, axis=1, overwrite_x=True)[:, ::CELLS])
    transform = transform.reshape(len(grid), CELLS, -1).sum(axis=1)
    return np.asarray(fft.ifft(transform, axis=1, overwrite_x=True)) / CELLS


def _real_bins(grid: np.ndarray, kernel: np.ndarray, folded: bool) -> np.ndarray:
    """The same of powers, by half of their transforms."""
    half = fft.rfft(grid, axis=1)
    half *= kernel
    if not folded:
        return np.asarray(fft.irfft(half, grid.shape[1], axis=1, overwrite_x=True)[:, ::CELLS])
    rows, bins = len(grid), grid.shape[1] // CELLS
    above = half[:, :-1].reshape(rows, CELLS // 2, bins)[:, :, : bins // 2 + 1].sum(axis=1)
    below = half[:, 1:].reshape(rows, CELLS // 2, bins)[:, :, : bins // 2 - 2 : -1].sum(axis=1)
    return np.asarray(fft.irfft(above + below.conj(), bins, axis=1)) / CELLS


@lru_cache(maxsize=32)
def _kernel(
    name: str, length: int, fft_size: int, cells: int, power: bool, real: bool
) -> np.ndarray:
    """Transform of the window's own transform, that of mid-record, on a grid of cells.

    From the FFT of its samples with sixteen times as many: no closed form is used.
    """
    place = np.concatenate([np.arange(cells // 2), np.arange(-cells // 2, 0)])
    transform = fft.fft(windows.samples(name, length), CELLS * fft_size)[place]
    transform *= np.exp(1j * np.pi * place * (length / fft_size / CELLS))
    if power:
        transform = np.abs(transform) ** 2
    return np.asarray(fft.rfft(transform) if real else fft.fft(transform))


def _weights(degree: int) -> np.ndarray:
    """Barycentric weights of degree + 1 cells in a row."""
    node = np.arange(degree + 1.0)
    return np.array([1 / np.prod(np.delete(node[j] - node, j)) for j in range(node.size)])


@njit(cache=True, error_model="numpy")
def _lines(i, p, row, footprint, segment, sizes, room):
    """Lines of one point's segment where they are seen, at 0 .. N/2; their origin."""
    origin = place_lines(p[:, i].copy(), segment, footprint, row[i], sizes, room)
    if origin < 0:
        for b in range(footprint.shape[2]):
            room[PLACE, b], room[IM, b] = -room[PLACE, b], -room[IM, b]
    return abs(origin)


@njit(cache=True, error_model="numpy")
def _image(origin, delta, re, im, sizes, centre):
    """Cell and weight of a line's image about DC or Nyquist, whichever is nearer."""
    place, sign = -2.0 * origin - delta, 1.0
    if 4 * origin > sizes[0]:
        place += sizes[0]
        sign = -1.0 if sizes[1] & 1 else 1.0
    return centre + CELLS * place, sign * re, -sign * im


@njit(cache=True, error_model="numpy")
def _deposit(p, row, footprint, segment, sizes, image, weights, origin, grid):
    """Lines of m points, each shared out among as many cells of its grid, (m, cells, 2 or 1)."""
    n, cells, power = footprint.shape[2], grid.shape[1], sizes[4] != 0
    room = np.empty((BLOCK + 1, n))
    delta, re, im = room[PLACE], room[RE], room[IM]
    centre, share = cells // 2, np.empty(weights.size)
    low, high = (-0.5, cells - 1.0) if weights.size == 1 else (5.0, cells - 6.0)
    for i in range(row.size):
        origin[i] = _lines(i, p, row, footprint, segment, sizes, room)
        for b in range(n):
            _share_out(grid, i, centre + CELLS * delta[b], re[b], im[b], weights, share)
            if image:
                at, a, c = _image(origin[i], delta[b], re[b], im[b], sizes, centre)
                if low < at < high:
                    _share_out(grid, i, at, abs(a) if power else a, c, weights, share)


@njit(cache=True, error_model="numpy")
def _share_out(grid, i, at, re, im, weights, share):
    """Adds a line to the nearest cell, or to ten by Lagrange's polynomial amid them."""
    if weights.size == 1:
        _add(grid, i, int(np.rint(at)), re, im)
        return
    first = int(np.floor(at)) - 4
    t = at - first
    total = 0.0
    for j in range(weights.size):
        if t == j:
            _add(grid, i, first + j, re, im)
            return
        share[j] = weights[j] / (t - j)
        total += share[j]
    for j in range(weights.size):
        _add(grid, i, first + j, re * share[j] / total, im * share[j] / total)


@njit(inline="always")
def _add(grid, i, cell, re, im):
    grid[i, cell, 0] += re
    if grid.shape[2] > 1:
        grid[i, cell, 1] += im
