"""A segment's detection and leakage, every bin accounted for without looking at each.

Bins within a run around the lines are evaluated one by one: all that may cross the threshold, and
as many as it takes for what leaks to become smooth. Beyond it, down to DC and up to Nyquist, the
probabilities that leaked signal adds are summed as an integral, to better than 1e-6 of the leakage.
They are left out where the shape's envelope says that they come to no more than the accuracy asked
for. The rest may serve for the bins within the run too.

Without padding e^{i pi k} is a sign. So |X| far from the lines is a smooth function of k, and a sum
over bins is an integral and corrections at its near end (Euler's and Maclaurin's, in central
differences). As |X|^2 is even about DC and about Nyquist, there is none at the far end but half the
value there. In v = cot(pi q / N), q the distance from the lines, the integrand is nearly a
polynomial: some thirty Gauss points stand for sixty thousand bins.

If the echo is in developed speckle, what leaks fades with it. Given the power u of the speckle, of
mean 1, bins of u |X|^2 leak with a probability 1 - exp(-R(u)), and the mean is

    P = int_0^inf e^{-u} (1 - exp(-R(u))) du.

ln R is computed at powers a factor of 2 apart, with a monotone cubic between
(:func:`fading_mean`). Bins that the mean echo leaves exempt stay so at any power.
"""

import math

import numpy as np

from sweep.kernels import njit
from sweep.model.crossings import (
    added_crossings,
    any_crossing,
    largest,
    silence,
    weighted_silence,
)
from sweep.model.detection import mark
from sweep.model.spectrum import (
    AFAR,
    CHANCE,
    F_IM,
    F_RE,
    FINER,
    HALF_SQUARE,
    IMAGED,
    OUT,
    POINT,
    SOURCE_DIGITS,
    SOURCES,
    TAN,
    TURN_IM,
    TURN_RE,
    WEIGHT,
    ZERO,
    add_far,
    envelope_from,
    is_turned,
    magnitudes,
    run_of,
    seen,
    stays_below,
    take_sources,
    tangent_of,
    weight_afar,
)

APRON = 3
"""Bins on either side of an integral's near end that its corrections look at."""

SMOOTHNESS = 1e-7
"""Largest last correction at the near end of an integral, relative to all that leaks."""

MOST_POINTS = 200
"""Gauss points on one side of the lines, at the most."""

WHOLE, HALF = np.bool_(False), np.bool_(True)
"""As arguments, of NumPy because Python's would compile what takes them once more."""

LOUDEST = 16.0
"""Power of speckle, of mean 1, up to which leakage is averaged: e^-16 of draws are brighter."""
SPECKLE_POWERS = LOUDEST * 2.0 ** -np.arange(10.0)
_SPECKLE_STEPS = 160
FAINTEST_RATE = 1e-30
"""R below which nothing leaks."""

_LARGEST_ORDER = 12
_GAUSS = np.zeros((2, _LARGEST_ORDER + 1, _LARGEST_ORDER))
for _n in range(1, _LARGEST_ORDER + 1):
    _GAUSS[:, _n, :_n] = np.polynomial.legendre.leggauss(_n)


@njit(cache=True, error_model="numpy")
def inspect(origin, lines, noise, table, form, sizes, tangent, room, exempt, series):
    """Run of bins, detection and leakage of a segment's lines; all bins are accounted for.

    Arguments and results as of :func:`sweep.model.spectrum.detect`, and the leakage last.
    ``noise``: sigma per quadrature; threshold; probability of leakage that may be left out; and
    LOUDEST where the echo fades, else 1.
    ``series``:
    :func:`sweep.model.crossings.crossing_series` of the threshold.
    """
    n, lowest, highest, total, faint = lines
    sigma, level, tolerance, loudest = noise
    noise = sigma, level, tolerance
    # Bounds are those of the brightest speckle.
    dark = 1.0 / math.sqrt(loudest)
    bright = sigma * dark, level * dark, tolerance
    half, beside, afar = sizes[0] // 2, sizes[6], total
    if sizes[8] > beside // 2:  # an echo whose pedestal reaches far
        beside += sizes[8]
    place = seen(origin, lowest, highest, sizes)
    mirror = max(min(place[0], half - place[1]), 0.0) if sizes[7] == IMAGED else math.inf
    least = crossing = max(stays_below(bright[1], total, place, form, sizes), float(beside))
    left = noise[2] - _all_beyond(afar, least, mirror, bright, form)
    if left < 0.0 or crossing > beside:
        sources = take_sources(n, lowest, highest, float(beside), SOURCE_DIGITS, sizes, room)
        afar = weight_afar(total, sources, sizes, room)
        crossing = max(stays_below(bright[1], afar, place, form, sizes), float(beside))
        least = min(crossing, float(beside + half))
        left = noise[2] - _all_beyond(afar, least, mirror, bright, form)
        while left < 0.0 and least < sizes[2]:  # bins that tables hold take less than an integral
            least = min(1.25 * least, float(sizes[2]))
            left = noise[2] - _all_beyond(afar, least, mirror, bright, form)
    known = n, lowest, highest, faint / max(total, 1e-300)
    if left >= 0.0:
        low, high = run_of(least, place, sizes)
        count = high - low + 1
        magnitudes(low, count, origin, known, room[:2, :0], table, form, sizes, tangent, room)
        peak, exempted = mark(room[OUT], count, noise[1], exempt, sizes[8])
        chance = 0.0
        if not (left > 0.0 and _at_most(count, bright, exempt, room) <= left):
            _chances(count, noise, room, exempt, series)
            chance = any_crossing(room[CHANCE], ZERO, count)
            if loudest > 1.0:
                chance = _faded_bins(count, noise, room, exempt, series)
        return low, count, peak, exempted, chance
    near_low, near_high = run_of(float(beside), place, sizes)
    reach = _least_reach(afar, highest - lowest, bright, crossing, form, sizes)
    while True:
        low, high = near_low - reach, near_high + reach
        low = 0 if low <= reach + APRON else low
        high = half if half - high <= reach + APRON else high
        count = high - low + 1
        magnitudes(low, count, origin, known, room[:2, :0], table, form, sizes, tangent, room)
        peak, exempted = mark(room[OUT], count, noise[1], exempt, sizes[8])
        run = low, count, peak, origin
        leakage, settled = _leakage(
            run, (n, lowest, highest), place, noise, form, sizes, tangent, room, exempt, series,
            loudest,
        )  # fmt: skip
        if settled:
            return low, count, peak, exempted, leakage
        reach *= 2


@njit(cache=True, error_model="numpy")
def of_bins(count, noise, floor, room, exempt, series):
    """Leakage of the bins of a run that stand above ``floor`` sigma, one by one."""
    for i in range(count):
        if room[OUT, i] < floor * noise[0]:
            exempt[i] = True
    _chances(count, noise, room, exempt, series)
    return any_crossing(room[CHANCE], ZERO, count)


@njit(cache=True, error_model="numpy")
def of_fading_bins(count, noise, floor, room, exempt, series):
    """Compute :func:`of_bins` for an echo in developed speckle."""
    for i in range(count):
        if room[OUT, i] < floor * noise[0]:
            exempt[i] = True
    return _faded_bins(count, noise, room, exempt, series)


@njit(cache=True, error_model="numpy")
def _faded_bins(count, noise, room, exempt, series):
    """Mean leakage of a run's bins over developed speckle."""
    log_rates = np.empty(SPECKLE_POWERS.size)
    for k in range(SPECKLE_POWERS.size):
        root = math.sqrt(SPECKLE_POWERS[k])
        _chances(count, (noise[0] / root, noise[1] / root), room, exempt, series)
        chance = any_crossing(room[CHANCE], ZERO, count)
        if k == 0 and chance < 1e-12:
            return 0.0
        log_rates[k] = _log_rate(chance)
    return fading_mean(log_rates)


@njit(cache=True, error_model="numpy")
def _log_rate(chance):
    """Logarithm of -ln(1 - chance)."""
    return math.log(max(silence(min(chance, 1.0 - 1e-15)), FAINTEST_RATE))


@njit(cache=True, error_model="numpy")
def _common_slope(one, other):
    """Harmonic mean of two slopes of one sign, or 0."""
    return 2.0 * one * other / (one + other) if one * other > 0.0 else 0.0


@njit(cache=True, error_model="numpy")
def fading_mean(log_rates):
    """Mean of 1 - exp(-R) over an exponential power, of ln R at SPECKLE_POWERS.

    Below the last of them R is proportional to the power.
    """
    last = log_rates.size - 1
    mean, before, chance_before = 0.0, 0.0, 0.0
    for i in range(1, _SPECKLE_STEPS + 1):
        # Places closer together where powers are small, up to LOUDEST.
        share = i / _SPECKLE_STEPS
        power = LOUDEST * share * share
        place = -math.log2(share * share)
        k = int(place)
        if k >= last:
            log_rate = log_rates[last] - (place - last) * math.log(2.0)
        else:
            x, rest = place - k, log_rates[k + 1] - log_rates[k]
            before_it = log_rates[k] - log_rates[k - 1] if k > 0 else rest
            after_it = log_rates[k + 2] - log_rates[k + 1] if k + 2 <= last else rest
            # A monotone cubic [Fritsch and Butland, SIAM J. Sci. Stat. Comput. 5, 300, 1984].
            low, high = _common_slope(before_it, rest), _common_slope(rest, after_it)
            log_rate = log_rates[k] + x * (
                low + x * (3.0 * rest - 2.0 * low - high + x * (low + high - 2.0 * rest))
            )
        chance = -math.expm1(-math.exp(min(log_rate, 4.0))) * math.exp(-power)
        mean += 0.5 * (chance + chance_before) * (power - before)
        before, chance_before = power, chance
    return mean


@njit(cache=True, error_model="numpy")
def _all_beyond(weight, first, mirror, noise, form):
    """Bound on the probability that any bin ``first`` or more bins from the lines adds to leakage.

    With x = a^2/2, y = b^2/2 and z = a b a bin's own is at most

        x dQ_1/dx = x y e^{-y} g,    g = I_1(z) / (z/2) <= e^{z^2/8}, 2 e^z / sqrt(2 pi z^3)

    so that all of them together have at most y e^{-y} g(nearest) times the sum of x. Images are no
    nearer to a bin than the lines, nor than ``mirror``; infinite where there are none.
    """
    sigma, level, _ = noise
    weight /= sigma
    b = level / sigma
    y = 0.5 * b * b
    nearest, squares = _envelope_beyond(first, form)
    if mirror < math.inf:
        image, image_squares = _envelope_beyond(max(first, mirror), form)
        image_squares += max(mirror - first, 0.0) * image * image
        nearest += image
        squares = (math.sqrt(squares) + math.sqrt(image_squares)) ** 2
    z = weight * nearest * b
    if z > 2.0 * y:
        return np.inf
    growth = z * z / 8.0
    if z > 1.0:
        growth = min(growth, z + math.log(2.0 / math.sqrt(2.0 * math.pi * z * z * z)))
    return weight * weight * squares * y * math.exp(growth - y) / -math.expm1(-y)


@njit(cache=True, error_model="numpy")
def _envelope_beyond(first, form):
    """Envelope ``first`` bins away; half the sum of its squares in all bins from there on."""
    place = envelope_from(first - 1.5, form)
    return form[1, place], form[1, place] * form[1, place] + form[2, place]


@njit(cache=True, error_model="numpy")
def _at_most(count, noise, exempt, room):
    """Bound on the probability that any bin of a run adds to leakage; infinite where it is large.

    With x and y as of :func:`_all_beyond`, Q_1 is convex in x up to y - 2, as I_2(z) / I_1(z) is at
    least z / (2 + sqrt(z^2 + 4)); there each bin adds no more than in proportion to the largest of
    them, and that at most e^{-(b - a)^2 / 2}, of the e^-2 and more below 1 that noise alone leaves.
    """
    sigma, level, _ = noise
    most, squares = 0.0, 0.0
    for i in range(count):
        loud = 0.0 if exempt[i] else room[OUT, i]
        most = max(most, loud)
        squares += loud * loud
    if not most > 0.0:
        return 0.0
    a, b = most / sigma, level / sigma
    if a * a > b * b - 4.0:
        return np.inf
    return 1.2 * squares / (most * most) * math.exp(-0.5 * (b - a) * (b - a))


@njit(cache=True, error_model="numpy")
def _chances(count, noise, room, exempt, series):
    """Compute the added crossing probabilities of a run of bins, into row CHANCE."""
    sigma, level = noise[0], noise[1]
    scale = 0.5 / (sigma * sigma)
    for i in range(count):
        room[HALF_SQUARE, i] = 0.0 if exempt[i] else room[OUT, i] * room[OUT, i] * scale
    added_crossings(room[HALF_SQUARE], count, level / sigma, series, room[CHANCE])


@njit(cache=True, error_model="numpy")
def _least_reach(weight, spread, noise, crossing, form, sizes):
    """Bins beyond the near ones that the run has to take in: see the module."""
    sigma, level, _ = noise
    clearance = sizes[6]
    beside = form[1, clearance] * weight / sigma
    gentle = 4.0 + 1.5 * math.sqrt(beside * clearance * level / sigma)
    least = max(crossing, max(gentle, 0.75 * spread)) - clearance
    return int(min((max(math.ceil(least), 0.0) + 2 * APRON + 7) // 8 * 8, sizes[0] // 2))


@njit(cache=True, error_model="numpy")
def _leakage(run, lines, place, noise, form, sizes, tangent, room, exempt, series, loudest):
    """Leakage of the run and of all beyond it; False where the run is too short to tell.

    If the echo fades (``loudest`` above 1) the mean over its speckle.
    """
    low, count, peak, origin = run
    sigma, level, _ = noise
    fft_size, half = sizes[0], sizes[0] // 2
    beta, scale = level / sigma, 0.5 / (sigma * sigma)
    _chances(count, noise, room, exempt, series)
    below, above = low > 0, low + count - 1 < half
    some = any_crossing(room[CHANCE], APRON if below else ZERO, count - APRON if above else count)
    if not below and not above:
        if loudest > 1.0:
            some = _faded_bins(count, noise, room, exempt, series)
        return some, True
    centre = abs(math.floor(0.5 * (place[0] + place[1]) + 0.5))
    centre = fft_size - centre if centre > half else centre
    tail, rest, points = 0.0, 0.0, ZERO
    for side in (-1, 1):
        if not (below if side < 0 else above):
            continue
        correction, last, steepness, found = _near_end(side, count, room[CHANCE], exempt)
        if not found:
            return 0.0, False
        tail += correction
        rest += last
        end = centre - low - APRON if side < 0 else low + count - 1 - APRON - centre
        points = _points_beyond(side, end, centre, steepness, sizes, tangent, room, points)
    while points % 8:  # whole vectors: what is left over costs as much as all of them
        room[POINT, points], room[WEIGHT, points] = room[POINT, points - 1], 0.0
        points += 1
    bins = fft_size / math.pi
    for i in range(points):
        room[WEIGHT, i] *= bins / (1.0 + room[POINT, i] * room[POINT, i])
        room[POINT, i] = 1.0 / room[POINT, i]
    digits = min(max(math.log(200.0 * beta * beta / max(noise[2], 1e-300)), 4.0), SOURCE_DIGITS)
    _far_values(points, centre, origin, lines, digits, form, sizes, tangent, room)
    for i in range(points):
        room[HALF_SQUARE, i] *= scale
        room[AFAR, i] = room[HALF_SQUARE, i]
    largest_beyond = largest(room[HALF_SQUARE, :points])
    added_crossings(room[HALF_SQUARE], points, beta, series, room[CHANCE])
    tail += weighted_silence(room[CHANCE, :points], room[WEIGHT, :points])
    most = min(0.45 * beta * beta, room[OUT, peak] * room[OUT, peak] * scale)
    if not (largest_beyond <= most and rest <= SMOOTHNESS * (some + tail)):
        return 0.0, False
    if loudest > 1.0:
        return _faded(run, points, noise, below, above, sizes, room, exempt, series), True
    return some - (1.0 - some) * math.expm1(-tail), True


@njit(cache=True, error_model="numpy")
def _faded(run, points, noise, below, above, sizes, room, exempt, series):
    """Mean over developed speckle of the leakage of a run and of the points beyond it."""
    count = run[1]
    sigma, level, _ = noise
    log_rates = np.empty(SPECKLE_POWERS.size)
    first, last = APRON if below else 0, count - APRON if above else count
    for k in range(SPECKLE_POWERS.size):
        power = SPECKLE_POWERS[k]
        root, tail = math.sqrt(power), 0.0
        _chances(count, (sigma / root, level / root), room, exempt, series)
        some = any_crossing(room[CHANCE], first, last)
        for side in (-1, 1):
            if below if side < 0 else above:
                tail += _near_end(side, count, room[CHANCE], exempt)[0]
        for i in range(points):
            room[HALF_SQUARE, i] = room[AFAR, i] * power
        added_crossings(room[HALF_SQUARE], points, level / sigma, series, room[CHANCE])
        tail += weighted_silence(room[CHANCE, :points], room[WEIGHT, :points])
        chance = some - (1.0 - some) * math.expm1(-max(tail, 0.0))
        if k == 0 and chance < 1e-12:
            return 0.0
        log_rates[k] = _log_rate(chance)
    return fading_mean(log_rates)


@njit(cache=True, error_model="numpy")
def _far_values(points, centre, origin, lines, digits, form, sizes, tangent, room):
    """|X|^2 at points whose tangents from ``centre`` are in row POINT, into row HALF_SQUARE.

    To e^-digits, but for lines so few that each stands for itself.
    """
    n, lowest, highest = lines
    power, way = sizes[4] != 0, -1 if is_turned(origin, lowest, highest, sizes[7]) else 1
    for turn in range(2 if sizes[7] == IMAGED else 1):
        towards = way if turn == 0 else -way
        shift = tangent_of(centre - towards * origin, sizes[0], tangent)
        for i in range(points):
            t = room[POINT, i]
            room[TAN, i] = towards * (t + shift) / (1.0 - t * shift)
            room[TURN_RE, i], room[TURN_IM, i] = 1.0, 0.0
            room[F_RE, i], room[F_IM, i] = 0.0, 0.0
        nearest = float(sizes[6])
        if turn == 1:  # images are as far from DC and Nyquist as the lines
            edge = min(centre, sizes[0] // 2 - centre) - 0.5 * (highest - lowest)
            nearest = max(nearest, edge - 2.0)
        sources = take_sources(n, lowest, highest, nearest, digits, sizes, room)
        for b in range(sources):
            add_far(ZERO, points, ZERO, SOURCES, b, digits + FINER, form, sizes, room)
        for i in range(points):
            re, im = room[F_RE, i], towards * room[F_IM, i]
            room[HALF_SQUARE, i] = re if turn == 0 else room[HALF_SQUARE, i] + re
            room[CHANCE, i] = im if turn == 0 else room[CHANCE, i] + im
    for i in range(points):
        re, im = room[HALF_SQUARE, i], room[CHANCE, i]
        room[HALF_SQUARE, i] = max(re, 0.0) if power else re * re + im * im


@njit(cache=True, error_model="numpy")
def _near_end(side, count, chance, exempt):
    """Correction of an integral at its near end, its last term's size, -d ln f / dq; if there."""
    step = 1 if side > 0 else -1
    i = count - APRON - 1 if side > 0 else APRON  # the last bin before the integral
    for k in range(-2, 4):
        if exempt[i + k * step]:
            return 0.0, 0.0, 0.0, False
    before, after = silence(chance[i]), silence(chance[i + step])
    first = after - before
    middle = silence(chance[i + 2 * step]) - silence(chance[i - step])
    third = middle - 3.0 * first
    fifth = silence(chance[i + 3 * step]) - silence(chance[i - 2 * step])
    fifth += 10.0 * first - 5.0 * middle
    terms = first / 24.0, -17.0 / 5760.0 * third, 367.0 / 967680.0 * fifth
    last = max(abs(terms[2]), abs(terms[1]) / 30.0)  # the fifth may cross zero
    steepness = abs(first) / max(after, 1e-300)
    return terms[0] + terms[1] + terms[2], last, steepness, True


@njit(cache=True, error_model="numpy")
def _points_beyond(side, last, centre, steepness, sizes, tangent, room, points):
    """Add cotangents and weights of one side's integral to rows POINT and WEIGHT.

    The integral begins half a bin beyond ``last``, counted from ``centre``. With images the
    spectrum is even about DC and Nyquist; without, it goes on, and the integral out to half a bin
    beyond is corrected by the first difference there.
    """
    fft_size, half_size = sizes[0], sizes[0] // 2
    far_bin = 0 if side < 0 else half_size
    half = side > 0 and 2 * half_size != fft_size
    last_bin = abs(far_bin - centre)
    goes_on = sizes[7] != IMAGED and last_bin < half_size
    half = half or goes_on
    far = max(_cotangent(last_bin, half, fft_size, tangent), 1e-9)
    near = _cotangent(last, HALF, fft_size, tangent)
    start, least = near, max(far, 0.5)
    while start > far:
        if start > 8.0 * least:
            end = start * (0.125 if start > 32.0 * least else 0.25)
        else:
            end = 0.5 * start if start > 2.2 * least else far
        order = _order(steepness * (last + 0.5), start / near)
        middle, width = 0.5 * (start + end), 0.5 * (start - end)
        for i in range(order):
            room[POINT, points] = side * (middle + width * _GAUSS[0, order, i])
            room[WEIGHT, points] = width * _GAUSS[1, order, i]
            points += 1
        start = end
    bin_ = math.pi / fft_size
    if goes_on:
        for k in range(2):
            at = _cotangent(last_bin + k, WHOLE, fft_size, tangent)
            room[POINT, points] = side * at
            room[WEIGHT, points] = (1.0 - 2.0 * k) / 24.0 * bin_ * (1.0 + at * at)
            points += 1
    elif not half:  # the far end is a bin: half of it lies beyond the integral
        room[POINT, points] = side * far
        room[WEIGHT, points] = 0.5 * bin_ * (1.0 + far * far)
        points += 1
    return points


@njit(cache=True, error_model="numpy")
def _cotangent(whole, half, fft_size, tangent):
    """cot(pi q / N) for q = whole, or half a bin more, 0 < q <= N/2."""
    t = tangent[whole]
    if not half:
        return 1.0 / t
    small = 0.5 * math.pi / fft_size
    small *= 1.0 + small * small / 3.0
    return (1.0 - t * small) / (t + small)


@njit(cache=True, error_model="numpy")
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
