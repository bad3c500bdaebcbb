"""Amplitudes of lines with a phase error of their own, as few lines: by way of moments.

A line at d bins holds exp(i pi r d t) over the record, t = -1..1, r = L/N; a phase error in modes
(:mod:`sweep.model.effects.line_modes`) makes of it sum_k a_k T_k(t) times that. A factor t of the
record is the derivative D / (i pi r) by the line's place. Lines are known by their moments, the
sums of C T_m(x), x their places over H, through which any spectrum sees them: the moments of
their derivative are

    m -> 2 m sum_{n < m, m - n odd} moment_n / e_n,    e_0 = 2, else 1

over H, as those are Chebyshev's coefficients of a function's derivative. So T_k(t) is a recurrence
over some fifteen numbers, however many lines there are.

What moments from the J-th on leave out is what few lines for many leave out
(:func:`sweep.model.equivalent.node_limits`), as many times as derivatives magnify it: by about
T_k(y), where the J-th moment grows y-fold by each, y = J / (z s), z = pi r H, s = sqrt(1 - x^2) at
the outermost line. So H takes in a little beside the lines, and there are as many moments as leave
out sum_k |a_k| T_k(y) times less than is allowed. With y that of :data:`MORE` moments more, of
:data:`LEAST_GROWTH` at the least, this bounds each mode, line, window and tolerance of a dense grid
(tests/model/test_phase_moments.py); as all is linear in a_k and C, it bounds their sums.
"""

import math

from sweep.model.bundles import DELTA, STRENGTH_IM, STRENGTH_RE, extent, relative_error
from sweep.model.compiling import borrowing
from sweep.model.effects.line_modes import CENTRE, EVENS, IM, NUMBER, RE
from sweep.model.equivalent import MOST_NODES, chebyshev_moments, nodes_for, put_moments_on_nodes

LEAST, DEGREE, MOST = 0.5, 1 / 64, 12.0
"""Bins of fs/L beside lines that H takes in: at the least, by the square of the modes' degree, at
the most."""

LEAST_GROWTH, MORE = 1.02, 4
"""The least y there is; moments by which it is that of a later one."""

LARGEST = 100.0
"""To which derivatives may magnify, by this bound, until H takes in the most: strengths grow as
well, and kernels are as exact as these are large."""

FLOOR = 1e-10
"""Error below which none is asked for, as modes make up a phase error to 1e-9."""

ALONE = 72
"""Lines at the most that take the place of one: at the most beside it, to the least tolerance."""

STRIDE = 2 * MOST_NODES
"""Numbers of a row of scratch that hold a vector of moments."""


@borrowing()
def take_phases(n, numbers, constant, fold, allowed, kernel, room):
    """Puts few lines with a phase error in the place of n lines without; how many there are.

    Parameters
    ----------
    n : int
        Lines in rows DELTA ..
    numbers, constant : (NUMBERS,), (>= 2,) float64
        The phase error in modes; cosine and sine of its middle.
    fold : float
        -1 where the lines are seen as their images, which conjugates phases.
    allowed
        As of :func:`sweep.model.bundles.relative_error`.
    kernel, room
        As of :func:`sweep.model.segments.segment_spectrum`.
    """
    fft_size, length = kernel[0]
    band, bins = math.pi * length / fft_size, fft_size / length
    if _degree_of(numbers) == 0:
        return _shift(n, numbers, constant, fold, fold * bins, room)
    tolerance = max(relative_error(n, False, allowed, kernel, room), FLOOR)
    lowest, highest = extent(room[DELTA], n)
    middle, half = 0.5 * (lowest + highest), 0.5 * (highest - lowest)
    apart = bins * fold * numbers[CENTRE]
    nodes, beside = nodes_beside(band * half, numbers, tolerance, kernel[3])
    alone, near = nodes, beside
    if nodes > min(MOST_NODES, n):
        alone, near = nodes_beside(0.0, numbers, tolerance, kernel[3])
    lines = room[12], room[13], room[14]
    if nodes <= min(MOST_NODES, n * alone):
        half += beside / band
        _moments(0, n, middle, half, nodes, room)
        _turn(nodes, numbers, constant, fold, 1.0 / (band * half), room)
        _put(0, nodes, middle + apart, half, lines, room)
        n = nodes
    else:
        for b in range(n):
            middle = room[DELTA, b]
            _moments(b, 1, middle, near / band, alone, room)
            _turn(alone, numbers, constant, fold, 1.0 / near, room)
            _put(b * alone, alone, middle + apart, near / band, lines, room)
        n *= alone
    for j in range(n):
        room[DELTA, j], room[STRENGTH_RE, j] = lines[0][j], lines[1][j]
        room[STRENGTH_IM, j] = lines[2][j]
    return n


@borrowing()
def _shift(n, numbers, constant, fold, bins, room):
    """Moves and turns n lines, which is all that a phase of even slope does."""
    apart = bins * numbers[CENTRE]
    a, b = numbers[RE], fold * numbers[IM]
    cosine, sine = constant[0], fold * constant[1]
    a, b = cosine * a - sine * b, cosine * b + sine * a
    delta, re, im = room[DELTA], room[STRENGTH_RE], room[STRENGTH_IM]
    for j in range(n):
        delta[j] += apart
        one, other = re[j], im[j]
        re[j], im[j] = a * one - b * other, a * other + b * one
    return n


@borrowing()
def nodes_beside(own, numbers, tolerance, limits):
    """Moments that serve lines with a phase error; what H takes in beside the lines.

    Parameters
    ----------
    own : float
        Half of what the lines spread over, times the band [rad].
    numbers : (NUMBERS,) float64
        The phase error in modes.
    tolerance : float
        Error allowed, relative to the sum of the lines' magnitudes.
    limits
        As of :func:`sweep.model.equivalent.nodes_for`.

    Returns
    -------
    nodes, beside
        More nodes than there can be where lines spread too wide; radians.
    """
    degree = _degree_of(numbers)
    beside = math.pi * max(LEAST, DEGREE * degree * degree)
    while True:
        turn = own + beside
        scale = math.sqrt(beside * (own + turn))
        nodes, more = 0, nodes_for(turn, tolerance, limits)
        while nodes < more <= MOST_NODES:
            nodes = more
            magnified = _magnified(numbers, max(LEAST_GROWTH, (nodes + MORE) / scale))
            if magnified > LARGEST and beside < math.pi * MOST:
                more = 0
            else:
                more = max(nodes_for(turn, tolerance / magnified, limits), nodes)
        if more > 0:
            return more, beside
        beside = min(1.5 * beside, math.pi * MOST)


@borrowing()
def _magnified(numbers, growth):
    """sum_k |a_k| T_k(growth)."""
    total, now, after = 0.0, 1.0, growth
    for k in range(_degree_of(numbers) + 1):
        at = k // 2 + (EVENS if k & 1 else 0)
        total += math.sqrt(numbers[RE + at] ** 2 + numbers[IM + at] ** 2) * now
        now, after = after, 2.0 * growth * after - now
    return total


@borrowing()
def _degree_of(numbers):
    """Highest degree among the modes that count."""
    return max(2 * int(numbers[NUMBER]) - 2, 2 * int(numbers[NUMBER + 1]) - 1)


@borrowing()
def _moments(first, n, middle, half, nodes, room):
    """Moments of n lines from ``first`` on, into rows 7 and 8."""
    x, re, im = room[4], room[STRENGTH_RE, first:], room[STRENGTH_IM, first:]
    for b in range(n):
        x[b] = (room[DELTA, first + b] - middle) / half
    chebyshev_moments(x, re, im, n, nodes, False, room[5], room[6], room[7], room[8])


@borrowing()
def _turn(nodes, numbers, constant, fold, scale, room):
    """sum_k a_k T_k(t) and the constant, put to the moments in rows 7 and 8."""
    degree = _degree_of(numbers)
    before, now, work = room[9], room[10], room[11]
    total_re, total_im = room[5], room[6]
    for m in range(nodes):
        now[m], now[STRIDE + m] = room[7, m], room[8, m]
        total_re[m], total_im[m] = 0.0, 0.0
    for k in range(degree + 1):
        at = k // 2 + (EVENS if k & 1 else 0)
        a, b = numbers[RE + at], fold * numbers[IM + at]
        for m in range(nodes):
            re, im = now[m], now[STRIDE + m]
            total_re[m] += a * re - b * im
            total_im[m] += a * im + b * re
        if k < degree:
            twice = scale if k == 0 else 2.0 * scale
            _times_t(now, nodes, twice, work)
            for m in range(nodes):
                for j in (m, STRIDE + m):
                    after = work[j] - (before[j] if k > 0 else 0.0)
                    before[j], now[j] = now[j], after
    cosine, sine = constant[0], fold * constant[1]
    for m in range(nodes):
        re, im = total_re[m], total_im[m]
        room[7, m], room[8, m] = cosine * re - sine * im, cosine * im + sine * re


@borrowing()
def _times_t(moments, nodes, scale, out):
    """Moments of lines whose record is multiplied by t, and a factor: D over i."""
    sums_re, other_re, sums_im, other_im = 0.0, 0.0, 0.0, 0.0
    for m in range(nodes):
        out[m], out[STRIDE + m] = 2.0 * m * scale * sums_im, -2.0 * m * scale * sums_re
        share = 0.5 if m == 0 else 1.0
        sums_re, other_re = other_re + share * moments[m], sums_re
        sums_im, other_im = other_im + share * moments[STRIDE + m], sums_im


@borrowing()
def _put(first, nodes, middle, half, lines, room):
    """Lines of the moments in rows 7 and 8, into ``lines`` from ``first`` on."""
    place, re, im = lines
    put_moments_on_nodes(
        nodes, middle, half, room[7], room[8], place[first:], re[first:], im[first:],
        room[9], room[10],
    )  # fmt: skip
