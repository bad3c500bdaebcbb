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
from sweep.model.elementary_functions import (
    exact_quotient,
    fraction_of_cycle,
    product_cycle_fraction,
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

NODES_MAX = 128
"""Equivalent lines at the most; wider bundles are left as they are."""

PLACE, RE, IM, X, BLOCK, MOMENT_RE, MOMENT_IM = np.arange(7)
"""Rows of scratch: places [bins from the origin] and C_b (powers: |C_b|^2 and 0); places of nodes;
blocks of lines; moments. They are NumPy's integers, as numba compiles a function anew for each of
Python's that is written in a call."""

NODES_PER_BATCH = 128
"""Nodes that are done together; constant, so that compiled loops need no tests of what overlaps."""

LINES_PER_BATCH = 32
"""Lines that are summed together: many echoes have few."""

_X, _EVEN, _ODD, _RE, _IM, _LANES = (NODES_PER_BATCH * k for k in range(6))

SCRATCH_WIDTH_MIN = 6 * NODES_PER_BATCH
"""Of scratch."""

N_SHARED_COLUMNS = 21
"""Numbers of a point that its segments share; of each segment OWN follow."""

N_SEGMENT_COLUMNS = 6
"""Signed chirp rate [Hz/s]; carrier [Hz]; gain of the whitened spectrum; range by which it is
nearer [m]; Doppler ratio; start [s]."""

CHEBYSHEV_NODES = np.zeros((NODES_MAX + 1, NODES_MAX))
for _n in range(1, NODES_MAX + 1):
    CHEBYSHEV_NODES[_n, :_n] = np.cos(np.pi * (np.arange(_n) + 0.5) / _n)


@lru_cache(maxsize=32)
def node_phase_limits(weights: tuple[float, ...], tolerances: tuple[float, ...]) -> np.ndarray:
    """Largest pi h that J equivalent lines serve to each tolerance, (tolerances, MOST_NODES + 1).

    From J = 1; the tolerances, rising, at J = 0. The weights, of sum 1, are those of places evenly
    spaced from the middle of the band to its end, both included.
    """
    n_nodes, targets = np.arange(1, NODES_MAX + 1), np.array(tolerances)[:, None]
    low, high = np.full((len(tolerances), n_nodes.size), -60.0), np.log(2.0 * n_nodes) + 0 * targets
    for _ in range(24):  # to 4e-6, on the side that serves
        middle = (low + high) / 2
        is_sufficient = _truncation_bound(middle, n_nodes, np.array(weights)) < targets
        low, high = np.where(is_sufficient, middle, low), np.where(is_sufficient, high, middle)
    return np.concatenate([targets, np.exp(low)], axis=1)


def _truncation_bound(log_z: np.ndarray, n_terms: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Bound on what the first J terms of a Chebyshev series leave out, (n, J), for ln z < ln 2 J.

    2 sum_{m >= J} |J_m(z t)|, the mean over t, from J_m(x) <= (x/2)^m / m! exp(-x^2 / (4 m + 4)).
    """
    phase_span, weighted_sum = np.exp(log_z), np.zeros(log_z.shape)
    for record_position, weight in zip(np.linspace(0, 1, weights.size), weights, strict=True):
        weighted_sum += (
            weight
            * record_position**n_terms
            * np.exp(-((phase_span * record_position) ** 2) / (4 * n_terms + 4))
        )
    first_term = math.log(2) + n_terms * (log_z - math.log(2)) - gammaln(n_terms + 1)
    return np.asarray(np.exp(first_term) * weighted_sum / (1 - phase_span / (2 * n_terms + 2)))


@njit(cache=True, error_model="numpy", borrows=True)
def compute_lines(point, segment, footprint, footprint_row, layout, scratch):
    """Lines of a segment: places and complex weights C_b, into rows PLACE, RE and IM.

    C_b is half the amplitude, with the receiver's gain and the phase in the record's middle, in a
    spectrum whose noise is white. Returns the origin: the bin nearest to the beam's centre, -N/2 ..
    N/2. ``point`` is a column of :meth:`sweep.model.preparation.Shots.point_parameter_table`,
    ``footprint`` and ``footprint_row`` of :attr:`~sweep.model.preparation.Shots.beamlet_table`.
    """
    adds_powers, fft_size, record_length = layout[4] != 0, layout[0], layout[1]
    segment_column, record_start = N_SHARED_COLUMNS + N_SEGMENT_COLUMNS * segment, point[7]
    chirp_rate, carrier, beat_scale, range_decrease = (
        point[segment_column],
        point[segment_column + 1],
        point[3] * point[segment_column + 2],
        point[segment_column + 3],
    )
    range_0, beta, range_per_doppler = (
        point[0] - range_decrease,
        point[segment_column + 4],
        0.5 * SPEED_OF_LIGHT * point[segment_column + 5],
    )
    bins_per_hertz = fft_size / point[6]
    hertz_per_metre = chirp_rate * (2.0 / SPEED_OF_LIGHT)
    centre_frequency = carrier * beta - hertz_per_metre * (1.0 + beta) * range_0
    centre_position = centre_frequency * bins_per_hertz
    folding_shift = math.floor(centre_position / fft_size + 0.5) * fft_size
    origin_bin = math.floor(centre_position - folding_shift + 0.5)
    centre_offset = centre_position - folding_shift - origin_bin
    pole_product, pole_sum = 1.0 / (point[4] * point[5]), 1.0 / point[4] + 1.0 / point[5]
    cycles_per_metre_high, cycles_per_metre_low = exact_quotient(2.0 * carrier, SPEED_OF_LIGHT)
    axis_phase = -product_cycle_fraction(
        cycles_per_metre_high, cycles_per_metre_low, point[0]
    ) + fraction_of_cycle(centre_frequency * record_start)
    axis_phase += product_cycle_fraction(
        cycles_per_metre_high, cycles_per_metre_low, range_decrease
    )
    half_record_ratio = 0.5 * (record_length / fft_size)
    origin_phase = (record_length * origin_bin % (2 * fft_size)) / (2.0 * fft_size)
    n_lines = footprint.shape[2]
    for line in range(n_lines):  # bins from the origin; the receiver's gain is 1 / (X + i BLOCK)
        doppler_offset = footprint[1, footprint_row, line]
        range_offset = (
            point[0] * footprint[0, footprint_row, line] - range_per_doppler * doppler_offset
        )
        doppler_path = (1.0 + beta) * range_offset + (range_0 + range_offset) * doppler_offset
        beat_offset = carrier * doppler_offset - hertz_per_metre * doppler_path
        frequency = centre_frequency + beat_offset
        scratch[PLACE, line] = centre_offset + beat_offset * bins_per_hertz
        scratch[X, line] = 1.0 - frequency * frequency * pole_product
        scratch[BLOCK, line] = frequency * pole_sum
    if adds_powers:
        for line in range(n_lines):
            weight, gain_re, gain_im = (
                0.5 * beat_scale * footprint[2, footprint_row, line],
                scratch[X, line],
                scratch[BLOCK, line],
            )
            scratch[RE, line] = weight * weight / (gain_re * gain_re + gain_im * gain_im)
            scratch[IM, line] = 0.0
        return origin_bin
    half_chirp_rate, cycles_per_bin = 0.5 * chirp_rate, record_start / bins_per_hertz
    for line in range(n_lines):
        range_offset = (
            point[0] * footprint[0, footprint_row, line]
            - range_per_doppler * footprint[1, footprint_row, line]
        )
        delay = (range_0 + range_offset) * (2.0 / SPEED_OF_LIGHT)
        phase = axis_phase - product_cycle_fraction(
            cycles_per_metre_high, cycles_per_metre_low, range_offset
        )
        phase += fraction_of_cycle(half_chirp_rate * delay * delay)
        scratch[RE, line] = (
            phase
            + (scratch[PLACE, line] - centre_offset) * cycles_per_bin
            + half_record_ratio * scratch[PLACE, line]
        )
    if footprint.shape[0] > 3:
        for line in range(n_lines):
            scratch[RE, line] += footprint[3 + segment, footprint_row, line]
    for line in range(n_lines):
        sine, cosine = sincos_cycles(scratch[RE, line] + origin_phase)
        gain_re, gain_im = scratch[X, line], scratch[BLOCK, line]
        weight = (
            0.5
            * beat_scale
            * footprint[2, footprint_row, line]
            / (gain_re * gain_re + gain_im * gain_im)
        )
        scratch[RE, line] = weight * (cosine * gain_re + sine * gain_im)
        scratch[IM, line] = weight * (sine * gain_re - cosine * gain_im)
    return origin_bin


@njit(cache=True, error_model="numpy", borrows=True)
def add_image_lines(scratch, n_lines, origin_bin, image_gain, adds_powers):
    """Add the lines' images at negative frequencies, times ``image_gain``. Return the new count."""
    for line in range(n_lines):
        scratch[PLACE, n_lines + line] = -2.0 * origin_bin - scratch[PLACE, line]
        scratch[RE, n_lines + line] = scratch[RE, line] * (
            image_gain * image_gain if adds_powers else image_gain
        )
        scratch[IM, n_lines + line] = -scratch[IM, line] * image_gain
    return 2 * n_lines


@njit(cache=True, error_model="numpy", borrows=True)
def fold_lines(scratch, n_lines, layout):
    """Move n lines by whole FFT lengths to within half of one from the origin."""
    for line in range(n_lines):
        n_folds = math.floor(scratch[PLACE, line] / layout[0] + 0.5)
        scratch[PLACE, line] -= n_folds * layout[0]
        if n_folds & 1 and layout[1] & 1 and not layout[4]:  # phases count from the record's middle
            scratch[RE, line], scratch[IM, line] = -scratch[RE, line], -scratch[IM, line]


@njit(cache=True, error_model="numpy", borrows=True)
def summarise_lines(scratch, n_lines, adds_powers):
    """Sum of n lines' magnitudes, or a little more, and of their squares; the ends of their places.

    Of amplitudes the sum is root n times the root of their squares, of powers their own.
    """
    lowest_position, highest_position, magnitude_sum, power_sum = (
        scratch[PLACE, 0],
        scratch[PLACE, 0],
        0.0,
        0.0,
    )
    for start in range(0, n_lines, LINES_PER_BATCH):
        n_batch = min(LINES_PER_BATCH, n_lines - start)
        for i in range(n_batch):
            re, im = scratch[RE, start + i], scratch[IM, start + i]
            scratch[BLOCK, _X + i], scratch[BLOCK, _RE + i] = (
                scratch[PLACE, start + i],
                re * re + im * im,
            )
            scratch[BLOCK, _IM + i] = abs(re) + abs(im)
        for i in range(n_batch, LINES_PER_BATCH):
            scratch[BLOCK, _X + i] = scratch[PLACE, start]
            scratch[BLOCK, _RE + i], scratch[BLOCK, _IM + i] = 0.0, 0.0
        for i in range(8):  # eight side by side, in an order that no machine changes
            a, b = 0.0, 0.0
            for k in range(LINES_PER_BATCH // 8):
                a += scratch[BLOCK, _IM + 8 * k + i]
                b += scratch[BLOCK, _RE + 8 * k + i]
            scratch[BLOCK, _LANES + i], scratch[BLOCK, _LANES + 8 + i] = a, b
        for i in range(8):
            magnitude_sum += scratch[BLOCK, _LANES + i]
            power_sum += scratch[BLOCK, _LANES + 8 + i]
        for i in range(8):
            c, d = scratch[BLOCK, _X + i], scratch[BLOCK, _X + i]
            for k in range(LINES_PER_BATCH // 8):
                c = min(c, scratch[BLOCK, _X + 8 * k + i])
                d = max(d, scratch[BLOCK, _X + 8 * k + i])
            scratch[BLOCK, _LANES + 16 + i], scratch[BLOCK, _LANES + 24 + i] = c, d
        for i in range(8):
            lowest_position = min(lowest_position, scratch[BLOCK, _LANES + 16 + i])
            highest_position = max(highest_position, scratch[BLOCK, _LANES + 24 + i])
    if not adds_powers and power_sum > 1e-250:  # else too small to be squared
        magnitude_sum = math.sqrt(n_lines * power_sum)
    return magnitude_sum, power_sum, lowest_position, highest_position


@njit(cache=True, error_model="numpy", borrows=True)
def allowed_relative_error(
    magnitude_sum, power_sum, n_lines, adds_powers, window_sum, bin_error_allowed, threshold
):
    """Error that few lines for n may make, over what the peak of all of them may come to.

    Of powers the peak is at most the root of n times their squares, some 1.3 times the sum of a
    beam's profile. Amplitudes add as their phases have it: three times the root of their squares
    is exceeded by one random sum of 10^4, and lines in phase stay within a tenth of their sum.

    ``magnitude_sum`` and ``power_sum`` are of :func:`summarise_lines`; ``bin_error_allowed`` is the
    error of a bin, ``threshold``
    the threshold. Powers of bins at the threshold, or of half the largest there can be where that
    is less, are as far off as makes this much of the bin. Those of larger bins may be further off,
    and in smaller ones nothing is decided.
    """
    root_n_lines = math.sqrt(n_lines)
    line_sum = magnitude_sum
    if power_sum > 1e-250:  # else too small to be squared
        growth = root_n_lines if adds_powers else min(root_n_lines, max(3.0, 0.1 * root_n_lines))
        line_sum = math.sqrt(power_sum) * growth
    if not adds_powers:
        return bin_error_allowed / max(window_sum * line_sum, 1e-300)
    peak_power = max(window_sum * window_sum * line_sum, 1e-300)
    return bin_error_allowed * min(threshold, 0.5 * math.sqrt(peak_power)) / peak_power


@njit(cache=True, error_model="numpy", borrows=True)
def count_nodes(phase_span, tolerance, phase_limits):
    """Nodes that serve lines within +-``phase_span`` radians of the band, or one more than any.

    ``phase_limits`` are :func:`node_phase_limits`; the least tolerance is taken where all are
    larger.
    """
    limit_row = phase_limits.shape[0] - 1
    while limit_row > 0 and phase_limits[limit_row, 0] > tolerance:
        limit_row -= 1
    n_nodes = 1
    while n_nodes < phase_limits.shape[1] and phase_limits[limit_row, n_nodes] < phase_span:
        n_nodes += 1
    return n_nodes


@njit(cache=True, error_model="numpy", borrows=True)
def replace_lines_by_nodes(
    scratch, re_row, im_row, n_lines, n_nodes, middle_and_half_width, out_re, out_im
):
    """Move n weights onto Chebyshev nodes of an interval, if these are fewer.

    Places are in row PLACE, weights in rows ``re_row`` and ``im_row``; the nodes' go to row X,
    ``out_re`` and ``out_im``. Returns the number of nodes, or n with the weights themselves.
    """
    if n_nodes >= n_lines or n_nodes > NODES_MAX:
        for line in range(n_lines):
            scratch[X, line] = scratch[PLACE, line]
            scratch[out_re, line], scratch[out_im, line] = (
                scratch[re_row, line],
                scratch[im_row, line],
            )
        return n_lines
    middle, half_width = middle_and_half_width
    inverse_half_width = 1.0 / half_width if half_width > 0.0 else 0.0
    for j in range(n_nodes + 1):
        scratch[MOMENT_RE, j], scratch[MOMENT_IM, j] = 0.0, 0.0
    for start in range(0, n_lines, LINES_PER_BATCH):
        n_batch = min(LINES_PER_BATCH, n_lines - start)
        for i in range(n_batch):
            scratch[BLOCK, _X + i] = (scratch[PLACE, start + i] - middle) * inverse_half_width
            scratch[BLOCK, _RE + i] = scratch[re_row, start + i]
            scratch[BLOCK, _IM + i] = scratch[im_row, start + i]
        for i in range(n_batch, LINES_PER_BATCH):
            scratch[BLOCK, _X + i], scratch[BLOCK, _RE + i], scratch[BLOCK, _IM + i] = 0.0, 0.0, 0.0
        _add_chebyshev_moments(scratch, n_nodes)
    for i in range(n_nodes):
        scratch[BLOCK, _X + i] = CHEBYSHEV_NODES[n_nodes, i]
        scratch[BLOCK, _EVEN + i], scratch[BLOCK, _ODD + i] = 1.0, CHEBYSHEV_NODES[n_nodes, i]
        scratch[BLOCK, _RE + i], scratch[BLOCK, _IM + i] = 0.0, 0.0
    for j in range(n_nodes):
        factor = (1.0 if j == 0 else 2.0) / n_nodes
        moment_re, moment_im = factor * scratch[MOMENT_RE, j], factor * scratch[MOMENT_IM, j]
        for i in range(n_nodes):
            polynomial, next_polynomial = scratch[BLOCK, _EVEN + i], scratch[BLOCK, _ODD + i]
            scratch[BLOCK, _RE + i] += polynomial * moment_re
            scratch[BLOCK, _IM + i] += polynomial * moment_im
            scratch[BLOCK, _EVEN + i] = next_polynomial
            scratch[BLOCK, _ODD + i] = 2.0 * scratch[BLOCK, _X + i] * next_polynomial - polynomial
    for i in range(n_nodes):
        scratch[X, i] = middle + half_width * scratch[BLOCK, _X + i]
        scratch[out_re, i], scratch[out_im, i] = scratch[BLOCK, _RE + i], scratch[BLOCK, _IM + i]
    return n_nodes


@njit(cache=True, error_model="numpy", borrows=True)
def _add_chebyshev_moments(scratch, n_nodes):
    """Add sums over a block of lines of their weights times T_0(x) .. T_nodes(x)."""
    for i in range(LINES_PER_BATCH):
        scratch[BLOCK, _EVEN + i] = 1.0
        scratch[BLOCK, _ODD + i] = scratch[BLOCK, _X + i]
    for j in range(0, n_nodes, 2):
        for i in range(8):  # eight sums side by side, in an order that no machine changes
            a, b, c, d = 0.0, 0.0, 0.0, 0.0
            for k in range(LINES_PER_BATCH // 8):
                re, im = scratch[BLOCK, _RE + 8 * k + i], scratch[BLOCK, _IM + 8 * k + i]
                even, odd = scratch[BLOCK, _EVEN + 8 * k + i], scratch[BLOCK, _ODD + 8 * k + i]
                a += re * even
                b += re * odd
                c += im * even
                d += im * odd
            scratch[BLOCK, _LANES + i], scratch[BLOCK, _LANES + 8 + i] = a, b
            scratch[BLOCK, _LANES + 16 + i], scratch[BLOCK, _LANES + 24 + i] = c, d
        a, b, c, d = 0.0, 0.0, 0.0, 0.0
        for i in range(8):
            a += scratch[BLOCK, _LANES + i]
            b += scratch[BLOCK, _LANES + 8 + i]
            c += scratch[BLOCK, _LANES + 16 + i]
            d += scratch[BLOCK, _LANES + 24 + i]
        scratch[MOMENT_RE, j] += a
        scratch[MOMENT_RE, j + 1] += b
        scratch[MOMENT_IM, j] += c
        scratch[MOMENT_IM, j + 1] += d
        for i in range(LINES_PER_BATCH):
            twice = 2.0 * scratch[BLOCK, _X + i]
            even = twice * scratch[BLOCK, _ODD + i] - scratch[BLOCK, _EVEN + i]
            scratch[BLOCK, _EVEN + i] = even
            scratch[BLOCK, _ODD + i] = twice * even - scratch[BLOCK, _ODD + i]
