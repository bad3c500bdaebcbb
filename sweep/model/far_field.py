"""Unpadded spectra of cosine-sum windows, near their lines and far from all of them.

The record and the FFT being of one length N, sin(pi (k - nu)) is (-1)^k sin(-pi nu), and the DFT at
bin k of lines C_b at nu_b (:mod:`sweep.model.spectrum`, :mod:`sweep.model.window`) is, but for a
sign that alternates from bin to bin and shows in no magnitude,

    X[k] = - sum_b C_b sin(pi nu_b) [ K(tan(pi (k - nu_b) / N)) + i w_0 ]

and the like of the images: a smooth function of k, whose poles are the lines. Three things follow.

- What a line adds to a run of bins is a rational function of their distances from it; the zero of
  the sine and the pole that it cancels both keep their digits, so it serves next to the line too.
- Seen from afar any bundle is equivalent to J sources at Chebyshev nodes, with an error of
  4 rho^-J, where the bundle and the distance set rho.
- A sum over bins of a smooth function of |X|^2 is an integral and corrections at its near end
  (Euler's and Maclaurin's, in central differences): as |X|^2 is even about DC and about Nyquist,
  there is none at the far end but half the value there. In v = cot(pi q / N), q the distance from
  the lines, the integrand is nearly a polynomial from the near end to the far one: some thirty
  Gauss points stand for sixty thousand bins.
"""

import math

import numpy as np

from sweep.model.compiling import borrowing
from sweep.model.elementary import fma, sincos_cycles
from sweep.model.equivalent import put_on_nodes
from sweep.model.spectrum import fraction

CLEARANCE = 9
"""Bins between the outermost pole of a line's kernel and what counts as far from it."""

SOURCE_DIGITS = 21.0, 3.5
"""ln of the accuracy of the far field: for one pole on either side, and for each one more.

Windows of more terms leak less: their kernel falls by so much from the poles to its sidelobes.
"""

REMOTE = 2e9
"""Cube of the distance [bins] over the square of a bundle's half width from which on two sources
stand for its images, to 1e-11 of the line's peak."""

LARGEST_ANGLE = 0.06
"""pi q / N up to which the tangent's series serves next to a line, to 1e-14."""

MOST_POINTS = 200
"""Gauss points on one side of the lines, at the most."""

_TILE = (0,) * 24
"""Bins of the near field that are done together: a tuple, whose length is known when compiling."""

_LARGEST_ORDER = 12
_GAUSS = np.zeros((2, _LARGEST_ORDER + 1, _LARGEST_ORDER))
for _n in range(1, _LARGEST_ORDER + 1):
    _GAUSS[:, _n, :_n] = np.polynomial.legendre.leggauss(_n)


@borrowing(fastmath={"nnan"})
def strengths(delta, re, im, n, power, sines):
    """Turns C_b of n lines into C_b sin(pi delta_b), |C_b|^2 into |C_b|^2 sin^2(pi delta_b).

    Lines on a bin, or as good as on it, are moved off it by the last digit of their place, so that
    both sine and pole are left, and their squares; ``delta`` is changed. ``sines`` is scratch.

    Returns
    -------
    total, lowest, highest : float
        Sum of the strengths' magnitudes; range of positions.
    """
    total, lowest, highest = 0.0, delta[0], delta[0]
    for b in range(n):  # simple loops one after the other, as each of them vectorises
        on_bin = delta[b] == math.floor(delta[b]) or abs(delta[b]) < 1e-30
        delta[b] += max(3e-16 * abs(delta[b]), 1e-30) if on_bin else 0.0
    for b in range(n):
        sines[b] = sincos_cycles(0.5 * delta[b])[0]
    for b in range(n):
        lowest = delta[b] if delta[b] < lowest else lowest
        highest = delta[b] if delta[b] > highest else highest
    if power:
        for b in range(n):
            re[b] *= sines[b] * sines[b]
        for b in range(n):
            total += re[b]
    else:
        for b in range(n):
            re[b] *= sines[b]
            im[b] *= sines[b]
        for b in range(n):
            total += math.sqrt(re[b] * re[b] + im[b] * im[b])
    return total, lowest, highest


@borrowing()
def _tangent(z, square):
    """tan(pi z / N) N / pi for small angles, ``square`` (pi / N)^2."""
    w = square * z * z
    series = fma(w, fma(w, fma(w, 62.0 / 2835.0, 17.0 / 315.0), 2.0 / 15.0), 1.0 / 3.0)
    return fma(z * w, series, z)


@borrowing()
def kernel_beside(q, delta, coefficients, square):
    """K pi / N at q - delta bins: c_0 cot + sum (-1)^m c_m / 2 (cot + cot, m bins off each side).

    Distances are formed from whole numbers first, so that a pole's keeps its digits.
    """
    below = _tangent(float(q) - delta, square)
    above = coefficients[0]
    half = -0.5
    for m in range(1, len(coefficients)):
        one = _tangent(float(q - m) - delta, square)
        other = _tangent(float(q + m) - delta, square)
        both = one * other
        above = fma(above, both, half * coefficients[m] * below * (one + other))
        below *= both
        half = -half
    return above / below


@borrowing()
def _add_tile(tile, first, delta, re, im, n, image, fft_size, coefficients, power, out_re, out_im):
    """Adds the kernels of n lines, or images, to the bins of one tile: as many as it is long."""
    square = (math.pi / fft_size) ** 2
    scale = fft_size / math.pi
    for j in range(n):
        d, b = delta[j], -im[j] * scale
        if power:
            a = re[j] * scale * scale
            for i in range(len(tile)):
                k = kernel_beside(first + i, d, coefficients, square)
                out_re[i] = fma(a * k, k, out_re[i])
        else:
            a = re[j] * scale if image else -re[j] * scale
            for i in range(len(tile)):
                k = kernel_beside(first + i, d, coefficients, square)
                out_re[i] = fma(a, k, out_re[i])
                out_im[i] = fma(b, k, out_im[i])


@borrowing()
def add_near_field(
    first, delta, re, im, n, image, fft_size, coefficients, power, tile, out_re, out_im
):
    """Adds the kernels of n lines to bins first, first + 1 .. of X, one by one.

    Parameters
    ----------
    first : int
        First bin, counted from where ``delta`` counts.
    delta, re, im : (>= n,) float64
        Positions and strengths (:func:`strengths`).
    image : bool
        They are images, at the places given.
    fft_size : int
    coefficients : tuple
        c_m of the window.
    power : bool
        Beamlets add as powers.
    tile : (2, >= 24) float64
        Scratch.
    out_re, out_im : (count,) float64
        Result.
    """
    count = out_re.size
    if count <= len(_TILE) - 8:
        size = (count + 7) // 8 * 8  # whole vectors
        sum_re, sum_im = tile[0, :size], tile[1, :size]
        _clear(sum_re, sum_im)
        _add_tile(
            sum_re, first, delta, re, im, n, image, fft_size, coefficients, power, sum_re, sum_im
        )
        for i in range(count):
            out_re[i] += sum_re[i]
            out_im[i] += sum_im[i]
        return
    sum_re, sum_im = tile[0, : len(_TILE)], tile[1, : len(_TILE)]
    for start in range(0, count, len(_TILE)):
        _clear(sum_re, sum_im)
        _add_tile(
            _TILE, first + start, delta, re, im, n, image, fft_size, coefficients, power, sum_re,
            sum_im,
        )  # fmt: skip
        for i in range(min(len(_TILE), count - start)):
            out_re[start + i] += sum_re[i]
            out_im[start + i] += sum_im[i]


@borrowing()
def _clear(re, im):
    re[:] = 0.0
    im[:] = 0.0


@borrowing()
def far_sources(
    delta, re, im, n, spread, centre, offset, fft_size, poles, power, tangent, out, work
):
    """Sources that stand for n lines, and for their images, seen from beyond the clearance.

    Parameters
    ----------
    delta, re, im : (n,) float64
        Positions [bins from a common origin] and strengths.
    spread : (float, float)
        Lowest and highest position.
    centre, offset : int
        Bin that distances q count from, 0..N/2, and its distance from the origin.
    fft_size, poles, power
        N; poles of the window on either side of a line; whether beamlets add as powers.
    tangent : (N // 2 + 1,) float64
        :func:`sweep.model.spectrum.tangents`.
    out : (6, >= max(n, MOST_NODES)) float64
        Result: tan of the sources' places and their strengths; the same of the images.
    work : (6, as `out`) float64
        Scratch.

    Returns
    -------
    lines, images : int
        Number of sources.
    """
    middle, half = 0.5 * (spread[0] + spread[1]), 0.5 * (spread[1] - spread[0])
    needed = sources_needed(half, n, poles)
    lines = put_on_nodes(
        delta, re, im, n, power, middle, half, needed, work[5], out[1], out[2], work
    )  # fmt: skip
    images = lines
    if lines > 2 and min(centre, fft_size // 2 - centre) ** 3 > REMOTE * half * half:
        images = _two_sources(work[5], out[1], out[2], lines, middle, half, out[3:6])
    else:
        for j in range(lines):
            out[3, j], out[4, j], out[5, j] = work[5, j], out[1, j], out[2, j]
    for j in range(lines):
        out[1, j] = out[1, j] if power else -out[1, j]
        out[2, j] = -out[2, j]
    for j in range(images):
        out[5, j] = -out[5, j]
    seen_at(work[5], lines, centre, offset, fft_size, tangent, out[0], work[4])
    seen_at(out[3], images, centre, offset, fft_size, tangent, work[4], out[3])
    return lines, images


@borrowing()
def seen_at(places, n, centre, offset, fft_size, tangent, out, mirrored):
    """Tan of n places as bins see them, and of their images; as of :func:`far_sources`.

    ``mirrored`` may be the places themselves.
    """
    twice = 2 * centre
    mirror = tangent[twice] if 2 * twice <= fft_size else -tangent[fft_size - twice]
    step = math.pi / fft_size
    for j in range(n):
        small = step * _tangent(places[j] - offset, step * step)
        out[j] = -small
        mirrored[j] = (mirror + small) / (1.0 - mirror * small)


@borrowing()
def sources_needed(half, n, poles):
    """Sources that serve from the clearance on, for a bundle of this half width [bins]."""
    if half <= 0.0:
        return 1
    z = 1.0 + CLEARANCE / half
    rate = math.log(z + math.sqrt(z * z - 1.0))
    digits = SOURCE_DIGITS[0] + SOURCE_DIGITS[1] * (poles - 1)
    return min(n, 1 + int(digits / rate))


@borrowing()
def _two_sources(delta, re, im, n, middle, half, out):
    """Two sources at Chebyshev nodes with the sum and the first moment of n."""
    place = half * math.sqrt(0.5)
    sum_re, sum_im, moment_re, moment_im = 0.0, 0.0, 0.0, 0.0
    for j in range(n):
        off = (delta[j] - middle) / place
        sum_re += re[j]
        sum_im += im[j]
        moment_re += re[j] * off
        moment_im += im[j] * off
    out[0, 0], out[0, 1] = middle - place, middle + place
    out[1, 0], out[1, 1] = 0.5 * (sum_re - moment_re), 0.5 * (sum_re + moment_re)
    out[2, 0], out[2, 1] = 0.5 * (sum_im - moment_im), 0.5 * (sum_im + moment_im)
    return 2


@borrowing()
def add_far_field(t, sources, number, numerator, poles, power, out_re, out_im):
    """Adds the kernels of sources, or of images, at points; t is tan(pi q / N) there."""
    for j in range(number):
        offset, a, b = sources[0, j], sources[1, j], sources[2, j]
        if power:
            for i in range(t.size):
                k = fraction(t[i], offset, numerator, poles)
                out_re[i] = fma(a * k, k, out_re[i])
        else:
            for i in range(t.size):
                k = fraction(t[i], offset, numerator, poles)
                out_re[i] = fma(a, k, out_re[i])
                out_im[i] = fma(b, k, out_im[i])


@borrowing()
def edge_field(strength, n, edge, power):
    """What the window's first sample adds to every bin, of lines and images: real.

    Of the strengths, the imaginary parts for amplitudes.
    """
    total = 0.0
    for j in range(n):
        total += strength[j]
    return 2.0 * edge * total * (edge if power else 1.0)


@borrowing()
def half_bin_cotangent(whole, half, fft_size, tangent):
    """cot(pi q / N) for q = whole, or half a bin more, 0 < q <= N/2."""
    t = tangent[whole]
    if not half:
        return 1.0 / t
    small = 0.5 * math.pi / fft_size
    small *= 1.0 + small * small / 3.0
    return (1.0 - t * small) / (t + small)


@borrowing()
def far_points(side, near, far, steepness, v, weight, first):
    """Gauss points and weights of a sum over bins out to DC or Nyquist.

    Parameters
    ----------
    side : float
        -1 towards DC, +1 towards Nyquist.
    near, far : float
        cot(pi q / N) half-way between the last bin before and the first one, and at DC or Nyquist.
    steepness : float
        Bound on d ln f / d ln q at the near end, f what is summed.
    v, weight : (>= first + MOST_POINTS,) float64
        Result: cot(pi q / N) and weight, from element ``first`` on.
    first : int

    Returns
    -------
    int
        One past the last element filled.
    """
    start, least = near, max(far, 0.5)
    while start > far:
        if start > 8.0 * least:
            end = start * (0.125 if start > 32.0 * least else 0.25)
        else:
            end = 0.5 * start if start > 2.2 * least else far
        order = _order(steepness, start / near)
        middle, half = 0.5 * (start + end), 0.5 * (start - end)
        for i in range(order):
            v[first] = side * (middle + half * _GAUSS[0, order, i])
            weight[first] = half * _GAUSS[1, order, i]
            first += 1
        start = end
    return first


@borrowing()
def points_to_bins(v, weight, fft_size):
    """Turns cotangents and weights into tangents and weights [bins]."""
    scale = fft_size / math.pi
    for i in range(v.size):
        weight[i] *= scale / (1.0 + v[i] * v[i])
        v[i] = 1.0 / v[i]


@borrowing()
def _order(steepness, share):
    """Gauss points of a stretch that begins at a share of the near end's v."""
    order = 4 + int(0.6 * steepness * share)
    if share > 0.9:
        order += 5
    elif share > 0.06:
        order += 4
    elif share > 0.008:
        order += 2
    return min(order, _LARGEST_ORDER)
