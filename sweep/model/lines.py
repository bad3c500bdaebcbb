"""The lines of one segment: where each beamlet's beat lies, how strong, in what phase.

A beamlet's beat is a tone of nu bins of fs/N. It is seen at nu less whole FFT lengths, within -N/2
.. N/2; a real record shows the line and its image at the opposite frequency. Close lines are
replaced by few. As a function of a line's place the spectrum is band-limited, so lines within +-h
bins are equivalent to J lines at Chebyshev nodes, J = 8 + some 1.3 pi h. The error of a series of J
terms in a sample of the record at t, -1 .. 1, is some 2 J_J(pi h t): next to nothing but at the
record's ends, where most windows are small; the window weighs it.
"""

import math
from functools import lru_cache

import numpy as np
from scipy.special import gammaln

from sweep.kernel_cache import njit
from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.elementary import (
    fraction_of_cycle,
    product_fraction,
    quotient,
    sincos_cycles,
)

AMPLITUDE_TOLERANCES = (
    1e-13, 3e-13, 1e-12, 3e-12, 1e-11, 3e-11, 1e-10, 3e-10, 1e-9, 3e-9, 1e-8, 3e-8, 1e-7, 3e-7,
    1e-6, 3e-6, 1e-5, 3e-5, 1e-4, 3e-4, 1e-3, 3e-3, 1e-2,
)  # fmt: skip
"""Errors of an equivalent sum of amplitudes, relative to the sum of their magnitudes."""

POWER_TOLERANCES = (
    1e-18, 1e-15, 1e-13, 1e-12, 1e-11, 1e-10, 1e-9, 1e-8, 1e-7, 1e-6, 1e-5, 1e-4, 1e-3
)  # fmt: skip
"""The same of powers: the root of the first is what a null of |X| shows."""

MOST_NODES = 128
"""Equivalent lines at the most; wider bundles are left as they are."""

PLACE, RE, IM, X, BLOCK, MOMENT_RE, MOMENT_IM = np.arange(7)
"""Rows of scratch: places [bins from the origin] and C_b (powers: |C_b|^2 and 0); places of nodes;
blocks of lines; moments. They are NumPy's integers, as numba compiles a function anew for each of
Python's that is written in a call."""

BLOCK_SIZE = 128
"""Nodes that are done together; constant, so that compiled loops need no tests of what overlaps."""

TOGETHER = 32
"""Lines that are summed together: many echoes have few."""

_X, _EVEN, _ODD, _RE, _IM, _LANES = (BLOCK_SIZE * k for k in range(6))

LEAST_WIDTH = 6 * BLOCK_SIZE
"""Of scratch."""

COMMON = 21
"""Numbers of a point that its segments share; of each segment OWN follow."""

OWN = 6
"""Signed chirp rate [Hz/s]; carrier [Hz]; gain of the whitened spectrum; range by which it is
nearer [m]; Doppler ratio; start [s]."""

CHEBYSHEV = np.zeros((MOST_NODES + 1, MOST_NODES))
for _n in range(1, MOST_NODES + 1):
    CHEBYSHEV[_n, :_n] = np.cos(np.pi * (np.arange(_n) + 0.5) / _n)


@lru_cache(maxsize=32)
def node_limits(weights: tuple[float, ...], tolerances: tuple[float, ...]) -> np.ndarray:
    """Largest pi h that J equivalent lines serve to each tolerance, (tolerances, MOST_NODES + 1).

    From J = 1; the tolerances, rising, at J = 0. The weights, of sum 1, are those of places evenly
    spaced from the middle of the band to its end, both included.
    """
    nodes, wanted = np.arange(1, MOST_NODES + 1), np.array(tolerances)[:, None]
    low, high = np.full((len(tolerances), nodes.size), -60.0), np.log(2.0 * nodes) + 0 * wanted
    for _ in range(24):  # to 4e-6, on the side that serves
        middle = (low + high) / 2
        serves = _left_out(middle, nodes, np.array(weights)) < wanted
        low, high = np.where(serves, middle, low), np.where(serves, high, middle)
    return np.concatenate([wanted, np.exp(low)], axis=1)


def _left_out(log_z: np.ndarray, order: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Bound on what the first J terms of a Chebyshev series leave out, (n, J), for ln z < ln 2 J.

    2 sum_{m >= J} |J_m(z t)|, the mean over t, from J_m(x) <= (x/2)^m / m! exp(-x^2 / (4 m + 4)).
    """
    z, total = np.exp(log_z), np.zeros(log_z.shape)
    for t, weight in zip(np.linspace(0, 1, weights.size), weights, strict=True):
        total += weight * t**order * np.exp(-((z * t) ** 2) / (4 * order + 4))
    first = math.log(2) + order * (log_z - math.log(2)) - gammaln(order + 1)
    return np.asarray(np.exp(first) * total / (1 - z / (2 * order + 2)))


@njit(cache=True, error_model="numpy", borrows=True)
def place_lines(p, segment, footprint, row, sizes, room):
    """Lines of a segment: places and complex weights C_b, into rows PLACE, RE and IM.

    C_b is half the amplitude, with the receiver's gain and the phase in the record's middle, in a
    spectrum whose noise is white. Returns the origin: the bin nearest to the beam's centre, -N/2 ..
    N/2. ``p`` is a column of :meth:`sweep.model.preparation.Shots.point_table`, ``footprint`` and
    ``row`` of :attr:`~sweep.model.preparation.Shots.footprint`.
    """
    power, fft_size, length = sizes[4] != 0, sizes[0], sizes[1]
    own, start = COMMON + OWN * segment, p[7]
    rate, carrier, scale, nearer = p[own], p[own + 1], p[3] * p[own + 2], p[own + 3]
    range_0, beta, drifted = p[0] - nearer, p[own + 4], 0.5 * SPEED_OF_LIGHT * p[own + 5]
    bins = fft_size / p[6]
    per_metre = rate * (2.0 / SPEED_OF_LIGHT)
    centre_frequency = carrier * beta - per_metre * (1.0 + beta) * range_0
    centre = centre_frequency * bins
    turns = math.floor(centre / fft_size + 0.5) * fft_size
    origin = math.floor(centre - turns + 0.5)
    delta_0 = centre - turns - origin
    square_pole, sum_pole = 1.0 / (p[4] * p[5]), 1.0 / p[4] + 1.0 / p[5]
    high, low = quotient(2.0 * carrier, SPEED_OF_LIGHT)
    phase_0 = -product_fraction(high, low, p[0]) + fraction_of_cycle(centre_frequency * start)
    phase_0 += product_fraction(high, low, nearer)
    half_ratio = 0.5 * (length / fft_size)
    turn_0 = (length * origin % (2 * fft_size)) / (2.0 * fft_size)
    n = footprint.shape[2]
    for b in range(n):  # bins from the origin; the receiver's gain is 1 / (X + i BLOCK)
        doppler = footprint[1, row, b]
        further = p[0] * footprint[0, row, b] - drifted * doppler
        shift = (1.0 + beta) * further + (range_0 + further) * doppler
        beat = carrier * doppler - per_metre * shift
        frequency = centre_frequency + beat
        room[PLACE, b] = delta_0 + beat * bins
        room[X, b] = 1.0 - frequency * frequency * square_pole
        room[BLOCK, b] = frequency * sum_pole
    if power:
        for b in range(n):
            weight, one, other = 0.5 * scale * footprint[2, row, b], room[X, b], room[BLOCK, b]
            room[RE, b] = weight * weight / (one * one + other * other)
            room[IM, b] = 0.0
        return origin
    square, per_bin = 0.5 * rate, start / bins
    for b in range(n):
        further = p[0] * footprint[0, row, b] - drifted * footprint[1, row, b]
        delay = (range_0 + further) * (2.0 / SPEED_OF_LIGHT)
        phase = phase_0 - product_fraction(high, low, further)
        phase += fraction_of_cycle(square * delay * delay)
        room[RE, b] = phase + (room[PLACE, b] - delta_0) * per_bin + half_ratio * room[PLACE, b]
    if footprint.shape[0] > 3:
        for b in range(n):
            room[RE, b] += footprint[3 + segment, row, b]
    for b in range(n):
        sine, cosine = sincos_cycles(room[RE, b] + turn_0)
        one, other = room[X, b], room[BLOCK, b]
        weight = 0.5 * scale * footprint[2, row, b] / (one * one + other * other)
        room[RE, b] = weight * (cosine * one + sine * other)
        room[IM, b] = weight * (sine * one - cosine * other)
    return origin


@njit(cache=True, error_model="numpy", borrows=True)
def add_images(room, n, origin, gain, power):
    """Add the lines' images at negative frequencies, scaled by ``gain``; return the new count."""
    for b in range(n):
        room[PLACE, n + b] = -2.0 * origin - room[PLACE, b]
        room[RE, n + b] = room[RE, b] * (gain * gain if power else gain)
        room[IM, n + b] = -room[IM, b] * gain
    return 2 * n


@njit(cache=True, error_model="numpy", borrows=True)
def fold_lines(room, n, sizes):
    """Move n lines by whole FFT lengths to within half of one from the origin."""
    for b in range(n):
        turns = math.floor(room[PLACE, b] / sizes[0] + 0.5)
        room[PLACE, b] -= turns * sizes[0]
        if turns & 1 and sizes[1] & 1 and not sizes[4]:  # phases count from the record's middle
            room[RE, b], room[IM, b] = -room[RE, b], -room[IM, b]


@njit(cache=True, error_model="numpy", borrows=True)
def survey(room, n, power):
    """Sum of n lines' magnitudes, or a little more, and of their squares; the ends of their places.

    Of amplitudes the sum is root n times the root of their squares, of powers their own.
    """
    lowest, highest, total, squares = room[PLACE, 0], room[PLACE, 0], 0.0, 0.0
    for start in range(0, n, TOGETHER):
        number = min(TOGETHER, n - start)
        for i in range(number):
            re, im = room[RE, start + i], room[IM, start + i]
            room[BLOCK, _X + i], room[BLOCK, _RE + i] = room[PLACE, start + i], re * re + im * im
            room[BLOCK, _IM + i] = abs(re) + abs(im)
        for i in range(number, TOGETHER):
            room[BLOCK, _X + i] = room[PLACE, start]
            room[BLOCK, _RE + i], room[BLOCK, _IM + i] = 0.0, 0.0
        for i in range(8):  # eight side by side, in an order that no machine changes
            a, b = 0.0, 0.0
            for k in range(TOGETHER // 8):
                a += room[BLOCK, _IM + 8 * k + i]
                b += room[BLOCK, _RE + 8 * k + i]
            room[BLOCK, _LANES + i], room[BLOCK, _LANES + 8 + i] = a, b
        for i in range(8):
            total += room[BLOCK, _LANES + i]
            squares += room[BLOCK, _LANES + 8 + i]
        for i in range(8):
            c, d = room[BLOCK, _X + i], room[BLOCK, _X + i]
            for k in range(TOGETHER // 8):
                c = min(c, room[BLOCK, _X + 8 * k + i])
                d = max(d, room[BLOCK, _X + 8 * k + i])
            room[BLOCK, _LANES + 16 + i], room[BLOCK, _LANES + 24 + i] = c, d
        for i in range(8):
            lowest = min(lowest, room[BLOCK, _LANES + 16 + i])
            highest = max(highest, room[BLOCK, _LANES + 24 + i])
    if not power and squares > 1e-250:  # else too small to be squared
        total = math.sqrt(n * squares)
    return total, squares, lowest, highest


@njit(cache=True, error_model="numpy", borrows=True)
def relative_error(total, squares, n, power, window_sum, allowed, level):
    """Error that few lines for n may make, over what the peak of all of them may come to.

    Of powers the peak is at most the root of n times their squares, some 1.3 times the sum of a
    beam's profile. Amplitudes add as their phases have it: three times the root of their squares
    is exceeded by one random sum of 10^4, and lines in phase stay within a tenth of their sum.

    ``total`` and ``squares`` are of :func:`survey`; ``allowed`` is the error of a bin, ``level``
    the threshold. Powers of bins at the threshold, or of half the largest there can be where that
    is less, are as far off as makes this much of the bin. Those of larger bins may be further off,
    and in smaller ones nothing is decided.
    """
    in_phase = math.sqrt(n)
    weight = total
    if squares > 1e-250:  # else too small to be squared
        together = in_phase if power else min(in_phase, max(3.0, 0.1 * in_phase))
        weight = math.sqrt(squares) * together
    if not power:
        return allowed / max(window_sum * weight, 1e-300)
    whole = max(window_sum * window_sum * weight, 1e-300)
    return allowed * min(level, 0.5 * math.sqrt(whole)) / whole


@njit(cache=True, error_model="numpy", borrows=True)
def nodes_for(turn, tolerance, limits):
    """Nodes that serve lines within +-``turn`` radians of the band, or one more than any.

    ``limits`` are :func:`node_limits`; the least tolerance is taken where all are larger.
    """
    level = limits.shape[0] - 1
    while level > 0 and limits[level, 0] > tolerance:
        level -= 1
    nodes = 1
    while nodes < limits.shape[1] and limits[level, nodes] < turn:
        nodes += 1
    return nodes


@njit(cache=True, error_model="numpy", borrows=True)
def put_on_nodes(room, re_row, im_row, n, nodes, span, out_re, out_im):
    """Move n weights onto Chebyshev nodes ``middle`` +- ``half`` (``span``), if these are fewer.

    Places are in row PLACE, weights in rows ``re_row`` and ``im_row``; the nodes' go to row X,
    ``out_re`` and ``out_im``. Returns the number of nodes, or n with the weights themselves.
    """
    if nodes >= n or nodes > MOST_NODES:
        for b in range(n):
            room[X, b] = room[PLACE, b]
            room[out_re, b], room[out_im, b] = room[re_row, b], room[im_row, b]
        return n
    middle, half = span
    inverse = 1.0 / half if half > 0.0 else 0.0
    for j in range(nodes + 1):
        room[MOMENT_RE, j], room[MOMENT_IM, j] = 0.0, 0.0
    for start in range(0, n, TOGETHER):
        number = min(TOGETHER, n - start)
        for i in range(number):
            room[BLOCK, _X + i] = (room[PLACE, start + i] - middle) * inverse
            room[BLOCK, _RE + i] = room[re_row, start + i]
            room[BLOCK, _IM + i] = room[im_row, start + i]
        for i in range(number, TOGETHER):
            room[BLOCK, _X + i], room[BLOCK, _RE + i], room[BLOCK, _IM + i] = 0.0, 0.0, 0.0
        _add_moments(room, nodes)
    for i in range(nodes):
        room[BLOCK, _X + i] = CHEBYSHEV[nodes, i]
        room[BLOCK, _EVEN + i], room[BLOCK, _ODD + i] = 1.0, CHEBYSHEV[nodes, i]
        room[BLOCK, _RE + i], room[BLOCK, _IM + i] = 0.0, 0.0
    for j in range(nodes):
        share = (1.0 if j == 0 else 2.0) / nodes
        one, other = share * room[MOMENT_RE, j], share * room[MOMENT_IM, j]
        for i in range(nodes):
            now, after = room[BLOCK, _EVEN + i], room[BLOCK, _ODD + i]
            room[BLOCK, _RE + i] += now * one
            room[BLOCK, _IM + i] += now * other
            room[BLOCK, _EVEN + i] = after
            room[BLOCK, _ODD + i] = 2.0 * room[BLOCK, _X + i] * after - now
    for i in range(nodes):
        room[X, i] = middle + half * room[BLOCK, _X + i]
        room[out_re, i], room[out_im, i] = room[BLOCK, _RE + i], room[BLOCK, _IM + i]
    return nodes


@njit(cache=True, error_model="numpy", borrows=True)
def _add_moments(room, nodes):
    """Add sums over a block of lines of their weights times T_0(x) .. T_nodes(x)."""
    for i in range(TOGETHER):
        room[BLOCK, _EVEN + i] = 1.0
        room[BLOCK, _ODD + i] = room[BLOCK, _X + i]
    for j in range(0, nodes, 2):
        for i in range(8):  # eight sums side by side, in an order that no machine changes
            a, b, c, d = 0.0, 0.0, 0.0, 0.0
            for k in range(TOGETHER // 8):
                re, im = room[BLOCK, _RE + 8 * k + i], room[BLOCK, _IM + 8 * k + i]
                even, odd = room[BLOCK, _EVEN + 8 * k + i], room[BLOCK, _ODD + 8 * k + i]
                a += re * even
                b += re * odd
                c += im * even
                d += im * odd
            room[BLOCK, _LANES + i], room[BLOCK, _LANES + 8 + i] = a, b
            room[BLOCK, _LANES + 16 + i], room[BLOCK, _LANES + 24 + i] = c, d
        a, b, c, d = 0.0, 0.0, 0.0, 0.0
        for i in range(8):
            a += room[BLOCK, _LANES + i]
            b += room[BLOCK, _LANES + 8 + i]
            c += room[BLOCK, _LANES + 16 + i]
            d += room[BLOCK, _LANES + 24 + i]
        room[MOMENT_RE, j] += a
        room[MOMENT_RE, j + 1] += b
        room[MOMENT_IM, j] += c
        room[MOMENT_IM, j + 1] += d
        for i in range(TOGETHER):
            twice = 2.0 * room[BLOCK, _X + i]
            even = twice * room[BLOCK, _ODD + i] - room[BLOCK, _EVEN + i]
            room[BLOCK, _EVEN + i] = even
            room[BLOCK, _ODD + i] = twice * even - room[BLOCK, _ODD + i]
