"""Spectrum of a sum of tones at the bins that matter, without the record or its FFT.

Each beamlet is a tone a cos(2 pi nu n / N + phi) of nu bins. With the window's transform W over
its L samples (:mod:`sweep.model.window`) and r = L/N, the DFT at bin k is

    X[k] = 1/2 sum_b a_b [ e^{i phi_b} W((k - nu_b) r) + e^{-i phi_b} W((k + nu_b) r) ]

(PHYSICS section 5). Three things make it fast without approximation that matters:

- The factor e^{-i pi k r} is common to all terms and is dropped; what depends on the line alone
  is taken out of the loop over bins, which leaves one real kernel value for a (line, bin) pair.
- Lines close to each other are replaced by few (:mod:`sweep.model.equivalent`).
- Next to a line the kernel is summed term by term from exact differences; elsewhere it is one
  fraction (the far sidelobes keep their digits).

Here C_b stands for 1/2 a_b e^{i (phi_b + pi nu_b r)}.
"""

import math
from functools import lru_cache

import numpy as np

from sweep.model.compiling import borrowing
from sweep.model.elementary import fma, sincos_cycles
from sweep.model.window import OVERSAMPLING

_TABLE_PAD = 8


@lru_cache(maxsize=4)
def tangents(fft_size: int) -> np.ndarray:
    """tan(pi q / N) for q = 0 .. N/2, (N // 2 + 1,): what the kernel's fraction is made of."""
    return np.tan(np.pi * np.arange(fft_size // 2 + 1) / fft_size)


@borrowing()
def _cotangent(theta):
    """cot(theta), by its series where that is exact to rounding."""
    if abs(theta) < 0.1:
        z = theta * theta
        series = z * (1.0 / 45.0 + z * (2.0 / 945.0 + z * (1.0 / 4725.0 + z * (2.0 / 93555.0))))
        return 1.0 / theta - theta * (1.0 / 3.0 + series)
    return 1.0 / math.tan(theta)


@borrowing()
def _closed_kernel(y, sine, length, coefficients):
    """S(y) term by term from exact differences: right next to the line, given sin(pi y)."""
    step = math.pi / length
    total = 0.0
    sign = 1.0
    for m in range(len(coefficients)):
        for z in (y - m, y + m):
            # sin(pi z) cot(pi z / L), the rectangular window's S, is L at z = 0
            term = sign * sine * _cotangent(step * z) if z != 0.0 else float(length)
            total += 0.5 * coefficients[m] * term
        sign = -sign
    return total


@borrowing()
def _table_kernel(y, table):
    """S(y) for |y| <= L/2 by a ten-point Lagrange polynomial through the table: about 4e-14."""
    position = abs(y) * OVERSAMPLING
    index = math.floor(position)
    t = position - index
    start = int(index) + _TABLE_PAD - 4
    if t < 1e-30:  # on it, or so close that the weight beside it would be past all numbers
        return table[start + 4]
    top, bottom, weight = 0.0, 0.0, 1.0
    for j in range(10):
        term = weight / (t + (4.0 - j))  # t alone where j is 4, however small
        top += term * table[start + j]
        bottom += term
        weight *= (j - 9.0) / (j + 1.0)
    return top / bottom


@borrowing()
def _near(first, count, delta, fft_size, margin):
    """Bins [low, high) of first .. first + count - 1 within a margin of q = -delta, modulo N."""
    turn = math.floor((first + 0.5 * count + delta) / fft_size + 0.5)
    centre = turn * fft_size - delta - first
    low = max(0, min(math.ceil(centre - margin), count))
    return low, max(low, min(math.floor(centre + margin) + 1, count))


@borrowing()
def _add_near(first, count, mirror, delta, re, im, n, sizes, margin, shape, power, out_re, out_im):
    """Adds n lines at q = -mirror delta to the bins near each, every kernel value by itself.

    Bin i is q = first + i. The argument is y = (q + mirror delta) r, brought into +-L/2;
    ``mirror`` -1 is the line itself, +1 its image. ``power`` adds |.|^2 to out_re instead.
    """
    fft_size, length = sizes
    coefficients, _, _, edge, table = shape
    ratio = length / fft_size
    odd = length & 1 == 1
    for j in range(n):
        low, high = 0, count
        if not table.size:
            low, high = _near(first, count, mirror * delta[j], fft_size, margin)
        a, b = re[j], -mirror * im[j]
        for i in range(low, high):
            turn = fft_size if 2 * (first + i) > fft_size else 0
            y = (first + i - turn + mirror * delta[j]) * ratio
            rounds = math.floor(y / length + 0.5)
            y -= rounds * length
            parity = -1.0 if odd and (turn > 0) != (int(rounds) & 1 == 1) else 1.0
            sine, _ = sincos_cycles(0.5 * y)
            if table.size:
                real = _table_kernel(y, table)
            else:
                real = _closed_kernel(y, sine, length, coefficients)
            imaginary = edge * sine
            if power:
                out_re[i] += a * (real * real + imaginary * imaginary)
            else:
                out_re[i] += parity * (a * real - b * imaginary)
                out_im[i] += parity * (b * real + a * imaginary)


@borrowing()
def fraction(tangent, offset, numerator, poles):
    """K at tan(a + b), given the two tangents, as one fraction (one division)."""
    n = tangent + offset
    d = fma(-tangent, offset, 1.0)
    n2, d2 = n * n, d * d
    scale = 1.0
    top = numerator[len(poles)]
    bottom = n
    for m in range(len(poles)):
        scale *= d2
        top = fma(top, n2, numerator[len(poles) - 1 - m] * scale)
        bottom *= fma(-poles[m], d2, n2)
    return d * top / bottom


@borrowing()
def _add_far(
    first, count, mirror, delta, re, im, n, sizes, margin, numerator, poles, edge, power,
    t, sine_q, cosine_q, out_re, out_im,
):  # fmt: skip
    """The same for all other bins, as loops over the bins that vectorise.

    sin(pi (q + delta) r) is split into what depends on q and on the line. Bins near the line,
    where the fraction has its poles, are computed and not taken: a select, not a branch.
    """
    fft_size, length = sizes
    for j in range(n):
        position = mirror * delta[j]
        low, high = _near(first, count, position, fft_size, margin)
        sine, cosine = sincos_cycles(0.5 * position / fft_size)
        tangent = sine / cosine
        sine, cosine = sincos_cycles(0.5 * position * (length / fft_size))
        a, b = re[j], -mirror * im[j]
        if power:
            for i in range(count):
                side = sine_q[i] * cosine + cosine_q[i] * sine
                kernel = fraction(t[i], tangent, numerator, poles)
                value = a * side * side * (kernel * kernel + edge * edge)
                out_re[i] += 0.0 if low <= i < high else value
        else:
            a_edge, b_edge = a * edge, b * edge
            for i in range(count):
                side = sine_q[i] * cosine + cosine_q[i] * sine
                kernel = side * fraction(t[i], tangent, numerator, poles)
                near = low <= i < high
                out_re[i] += 0.0 if near else a * kernel - b_edge * side
                out_im[i] += 0.0 if near else b * kernel + a_edge * side


@borrowing()
def set_tangents(first, count, fft_size, tangent, t):
    """tan(pi q / N) for q = first .. first + count - 1, from the table of :func:`tangents`."""
    if first >= -(fft_size // 2) and first + count <= tangent.size:
        below = min(max(-first, 0), count)
        for i in range(below):
            t[i] = -tangent[-first - i]
        for i in range(below, count):
            t[i] = tangent[first + i]
        return
    q = first % fft_size
    for i in range(count):
        t[i] = tangent[q] if 2 * q <= fft_size else -tangent[fft_size - q]
        q = q + 1 if q + 1 < fft_size else 0


@borrowing()
def _prepare_bins(first, count, sizes, tangent, t, sine_q, cosine_q):
    """tan(pi q / N), sin(pi q r), cos(pi q r) for q = first .. first + count - 1."""
    fft_size, length = sizes
    set_tangents(first, count, fft_size, tangent, t)
    sign = -1.0 if first & 1 else 1.0
    for i in range(count):
        sine_q[i] = 0.0
        cosine_q[i] = sign
        sign = -sign
    if length < fft_size:
        for i in range(count):
            turns = (first + i) * length % (2 * fft_size) / (2.0 * fft_size)
            sine_q[i], cosine_q[i] = sincos_cycles(turns)


@borrowing()
def bin_magnitudes(
    low, high, origin, delta, re, im, n, sizes, shape, power, tangent, out_re, out_im, work,
    image=True,
):  # fmt: skip
    """|X[k]| for k = low .. high (0 <= low, high <= N/2), lines and their images, into out_re.

    Parameters
    ----------
    low, high : int
        First and last bin.
    origin : int
        Bin from which delta counts; 0 <= origin <= N/2.
    delta, re, im : (>= n,) float64
        Positions of the lines [bins from origin] and C_b; for ``power`` re holds |C_b|^2.
    sizes : (int, int)
        FFT size N and window length L <= N.
    shape : tuple
        (coefficients, numerator, poles, edge, table) of the :class:`~sweep.model.window.Window`.
    power : bool
        False: beamlets add as amplitudes. True: they add as powers, and so do line and image,
        which is the mean over independent uniform phases.
    tangent : (N // 2 + 1,) float64
        :func:`tangents`.
    out_re, out_im : (>= high - low + 1,) float64
        Result; scratch.
    work : (3, >= high - low + 1) float64
        Scratch.
    image : bool
        Whether the lines' images are summed; if not, nothing of them is computed.

    Notes
    -----
    Within 1e-12 of the largest magnitude (Hann and Hamming, N = 2^17, tests/model).
    """
    count = high - low + 1
    for i in range(count):
        out_re[i] = 0.0
        out_im[i] = 0.0
    for mirror in (-1, 1):  # the lines, then their images
        if mirror < 0 or image:
            first = low + mirror * origin
            _prepare(first, count, sizes, shape, tangent, work)
            _add(
                first, count, mirror, delta, re, im, n, sizes, shape, power, work, out_re, out_im
            )  # fmt: skip
    for i in range(count):
        if power:
            out_re[i] = math.sqrt(max(out_re[i], 0.0))
        else:
            out_re[i] = math.sqrt(out_re[i] * out_re[i] + out_im[i] * out_im[i])


@borrowing()
def split_magnitudes(
    low, high, origin, delta, weight, n, parts, fold, sizes, shape, tangent, out, room, image
):
    """|X[k]| of lines that add as powers, each of them split into parts that add as amplitudes.

    Parameters
    ----------
    low, high, origin, sizes, shape, tangent, image
        As of :func:`bin_magnitudes`.
    delta, weight : (>= n,) float64
        Positions of the lines [bins from origin]; |C_b|^2.
    parts : tuple of (k,) float64
        Places from their line [bins of fs/N], real and imaginary weight.
    fold : float
        -1 to conjugate the weights.
    out : (>= high - low + 1,) float64
        Result.
    room : (7, >= max(k, high - low + 1)) float64
        Scratch.
    """
    count = high - low + 1
    place, other, re, im, work = room[0], room[1], room[2], room[3], room[4:7]
    for i in range(count):
        out[i] = 0.0
    for k in range(parts[0].size):
        other[k] = fold * parts[2][k]
    for mirror in (-1, 1):
        if mirror > 0 and not image:
            break
        first = low + mirror * origin
        _prepare(first, count, sizes, shape, tangent, work)
        for b in range(n):
            for k in range(parts[0].size):
                place[k] = delta[b] + parts[0][k]
            for i in range(count):
                re[i] = 0.0
                im[i] = 0.0
            _add(
                first, count, mirror, place, parts[1], other, parts[0].size, sizes, shape, False,
                work, re, im,
            )  # fmt: skip
            for i in range(count):
                out[i] += weight[b] * (re[i] * re[i] + im[i] * im[i])
    for i in range(count):
        out[i] = math.sqrt(max(out[i], 0.0))


@borrowing()
def _prepare(first, count, sizes, shape, tangent, work):
    """What far kernels need to know of bins; a tabulated window has none of them."""
    if not shape[4].size:
        _prepare_bins(first, count, sizes, tangent, work[0], work[1], work[2])


@borrowing()
def _add(first, count, mirror, delta, re, im, n, sizes, shape, power, work, out_re, out_im):
    """Adds n lines, or their images, to prepared bins."""
    _, numerator, poles, edge, table = shape
    margin = (len(poles) + 0.5) * sizes[0] / sizes[1]
    if not table.size:
        _add_far(
            first, count, mirror, delta, re, im, n, sizes, margin, numerator, poles, edge, power,
            work[0], work[1], work[2], out_re, out_im,
        )  # fmt: skip
    _add_near(first, count, mirror, delta, re, im, n, sizes, margin, shape, power, out_re, out_im)
