"""Detection and leakage of a segment, with all bins accounted for but few evaluated.

Bins in a run around the lines are evaluated one by one: all that may cross the threshold, and as
many more as it takes for the leaked signal to become smooth. Beyond the run, down to DC and up to
Nyquist, the probabilities that leaked signal adds are summed as an integral, with an error below
1e-6 of the leakage. The integral is left out where the envelope of the line shape bounds it below
the accuracy asked for.

Without padding the factor e^{i pi k} is a sign, so |X| far from the lines is a smooth function of
k. Its sum over bins is then an integral plus corrections at its near end (Euler-Maclaurin, in
central differences). As |X|^2 is even about DC and Nyquist, the far end needs no correction but
half the value there. In v = cot(pi q / N), with the distance q from the lines, the integrand is
nearly a polynomial: some thirty Gauss points represent sixty thousand bins.

In developed speckle the leaked signal fades with its echo. If the speckle's power is u, of mean 1,
bins of power u |X|^2 leak with the probability 1 - exp(-R(u)), and the mean is

    P = int_0^inf e^{-u} (1 - exp(-R(u))) du.

ln R is computed at powers an octave or half of one apart and interpolated by a monotone cubic
(:func:`fading_mean`). Bins that are exempt at the mean power are exempt at any power.

Bins that cross next to an echo whose outermost bin crosses are part of the echo
(:func:`sweep.model.crossings.leave_out_joined`), and no leakage.
"""

import math

import numpy as np

from sweep.kernel_cache import njit
from sweep.model.crossings import (
    JOINED_CHANCE_MIN,
    added_crossings,
    any_crossing,
    largest,
    leave_out_joined,
    silence,
    weighted_silence,
)
from sweep.model.detection import mark
from sweep.model.faded_rates import (
    FINER_POWERS,
    LOUDEST,
    OCTAVES,
    POWERS,
    SPECKLE_POWERS,
    add_rates,
    brightest_rate,
)
from sweep.model.marcum import excess_crossing
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
"""Bins on either side of the integral's near end that its end corrections use."""

SMOOTHNESS = 1e-7
"""Largest last term of the end corrections, relative to the whole leakage."""

MOST_POINTS = 200
"""Maximum number of Gauss points on one side of the lines."""

WHOLE, HALF = np.bool_(False), np.bool_(True)
"""Arguments of :func:`_cotangent`: at a bin, or half a bin beyond. NumPy booleans, because numba
would compile the function anew for Python's."""

BRIGHTEST_MAX = 0.5
"""Leakage of the brightest speckle up to which one power an octave is enough."""
FAINTEST_RATE = 1e-30
"""Rate R below which leakage is taken to be 0."""
SURE_RATE = 34.5
"""Rate R from which on leakage is certain."""

_SPECKLE_STEPS = 160
_ROOT = np.arange(1, _SPECKLE_STEPS + 1) / _SPECKLE_STEPS
_POWER = np.concatenate([[0.0], LOUDEST * _ROOT**2])
"""Nodes of the mean over speckle: closer together where powers are small."""
_OCTAVE = -2 * np.log2(_ROOT)
"""Octaves from LOUDEST down to these nodes but the first."""
_SPECKLE_WEIGHT = (
    np.exp(-_POWER[1:]) * 0.5 * np.append(_POWER[2:] - _POWER[:-2], np.diff(_POWER[-2:]))
)

_END_TERMS = 1.0 / 24.0, -17.0 / 5760.0, 367.0 / 967680.0
"""Factors of the first, third and fifth difference in the correction of an integral's near end."""

_LARGEST_ORDER = 12
_GAUSS = np.zeros((2, _LARGEST_ORDER + 1, _LARGEST_ORDER))
for _n in range(1, _LARGEST_ORDER + 1):
    _GAUSS[:, _n, :_n] = np.polynomial.legendre.leggauss(_n)


@njit(cache=True, error_model="numpy")
def inspect(origin, lines, noise, table, form, sizes, tangent, room, exempt, series, rates):
    """Evaluate a segment: a run of bins around its lines, detection, and leakage of all bins.

    Parameters and results are those of :func:`sweep.model.spectrum.detect`, with these differences.

    Parameters
    ----------
    noise
        Noise per quadrature sigma; threshold on |X|; probability of leakage that may be neglected;
        LOUDEST if the echo is in developed speckle, else 1; and the correlation of neighbours'
        noise in phase with the signal.
    series
        :func:`sweep.model.crossings.crossing_series` of the threshold over sigma.
    rates
        :class:`sweep.model.faded_rates.FadedRates` of it if the echo is in developed speckle.

    Returns
    -------
    low, count, peak, exempted, leakage
        First bin and length of the run; index of the largest bin; number of exempt bins;
        probability that leaked signal raises at least one false alarm.
    """
    n, lowest, highest, total, faint = lines
    sigma, level, tolerance, loudest, correlation = noise
    noise = sigma, level, tolerance, correlation
    # Bounds are those of the brightest speckle.
    dark = 1.0 / math.sqrt(loudest)
    bright = sigma * dark, level * dark, tolerance, correlation
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
            if loudest > 1.0:
                chance = _faded_bins(count, noise, room, exempt, rates)
            else:
                chance = _any_further(count, noise, room, exempt, series)
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
            rates, loudest,
        )  # fmt: skip
        if settled:
            return low, count, peak, exempted, leakage
        reach *= 2


@njit(cache=True, error_model="numpy")
def of_bins(count, noise, floor, room, exempt, series):
    """Return the leakage of those bins of a run that exceed ``floor`` [sigma], bin by bin.

    Magnitudes of the others become 0. ``noise`` is as of :func:`inspect` without what fades.
    """
    _leave_out_faint(count, noise[0], floor, room, exempt)
    return _any_further(count, noise, room, exempt, series)


@njit(cache=True, error_model="numpy")
def of_fading_bins(count, noise, floor, room, exempt, rates):
    """Return the mean of :func:`of_bins` over developed speckle.

    ``rates``: :class:`sweep.model.faded_rates.FadedRates` of the threshold.
    """
    _leave_out_faint(count, noise[0], floor, room, exempt)
    return _faded_bins(count, noise, room, exempt, rates)


@njit(cache=True, error_model="numpy")
def _leave_out_faint(count, sigma, floor, room, exempt):
    """Set bins of a run that are of no echo and below ``floor`` [sigma] to 0."""
    for i in range(count):
        if not exempt[i] and room[OUT, i] < floor * sigma:
            room[OUT, i] = 0.0


@njit(cache=True, error_model="numpy")
def _any_further(count, noise, room, exempt, series):
    """Return the probability of a further group in a run's bins; probabilities are in row CHANCE.

    ``noise``: sigma, threshold, tolerance, and correlation of neighbours' noise.
    """
    _chances(count, noise, room, exempt, series)
    leave_out_joined(room[CHANCE], ZERO, count, room[OUT], exempt, noise, noise[3])
    return any_crossing(room[CHANCE], ZERO, count)


@njit(cache=True, error_model="numpy")
def _faded_bins(count, noise, room, exempt, rates):
    """Return the mean leakage of a run's bins over developed speckle."""
    return _mean_leakage(ZERO, count, noise, room, exempt, rates, np.zeros(POWERS))


@njit(cache=True, error_model="numpy")
def _mean_leakage(first, last, noise, room, exempt, rates, beyond):
    """Return the mean leakage, over developed speckle, of bins first .. last - 1 and of others.

    ``noise``: sigma, threshold, tolerance, and correlation of neighbours' noise. ``beyond``: of the
    others the sum of rates at each speckle power, over this power.
    """
    sigma, level, _, correlation = noise
    joining = _mark_joining(first, last, sigma, room, exempt, rates)
    sums, scale = np.zeros(POWERS), 1.0 / (sigma * sigma)
    # Bins that may join an echo, the echo's bins next to them, and one for all that lie between.
    of_joining, chances = np.zeros((joining, POWERS)), np.zeros(joining)
    magnitude, is_echo = np.zeros(joining), np.zeros(joining, np.bool_)
    number, is_gap = 0, True
    for i in range(first, last):
        square = room[OUT, i] * room[OUT, i] * scale
        if exempt[i]:
            if (i > first and not exempt[i - 1]) or (i + 1 < last and not exempt[i + 1]):
                magnitude[number], is_echo[number] = room[OUT, i], True
                number, is_gap = number + 1, False
        elif room[CHANCE, i] > 0.0:
            add_rates(square, 1.0, rates, of_joining[number])
            magnitude[number], number, is_gap = room[OUT, i], number + 1, False
        else:
            add_rates(square, 1.0, rates, sums)
            if not is_gap:
                number, is_gap = number + 1, True
    brightest = sums[POWERS - 1] + max(beyond[POWERS - 1], 0.0)
    for i in range(number):
        brightest += of_joining[i, POWERS - 1]
    brightest *= LOUDEST
    if brightest < 1e-12:
        return 0.0
    per_octave = _powers_per_octave(brightest)
    every = FINER_POWERS // per_octave
    log_rates = np.empty(per_octave * OCTAVES + 1)
    for k in range(log_rates.size):
        j = POWERS - 1 - k * every
        power = SPECKLE_POWERS[j]
        rate = power * (sums[j] + max(beyond[j], 0.0))
        if number > 0:
            for i in range(number):
                chances[i] = -math.expm1(-power * of_joining[i, j])
            root = math.sqrt(power)
            faded = sigma / root, level / root
            leave_out_joined(chances, ZERO, number, magnitude, is_echo, faded, correlation)
            for i in range(number):
                rate += silence(chances[i])
        log_rates[k] = math.log(min(max(rate, FAINTEST_RATE), SURE_RATE))
    return fading_mean(log_rates, per_octave)


@njit(cache=True, error_model="numpy", borrows=True)
def _mark_joining(first, last, sigma, room, exempt, rates):
    """Mark bins first .. last - 1 that may join an echo in row CHANCE, by 1; others by 0.

    Return their number, with that of the bins next to them and of those that set them apart.
    """
    number, end = 0, first
    for i in range(first, last):
        room[CHANCE, i] = 0.0
    while end < last:
        begin = end
        while end < last and not exempt[end]:
            end += 1
        if end > begin and begin > first:
            number += 2 + _mark_row(begin, 1, end - begin, sigma, room, rates)
        if end > begin and end < last:
            number += 2 + _mark_row(end - 1, -1, end - begin, sigma, room, rates)
        end += 1
    return number


@njit(cache=True, error_model="numpy", borrows=True)
def _mark_row(begin, step, count, sigma, room, rates):
    """Mark bins from ``begin`` on as long as all of them may cross; return their number."""
    number, all_cross = 0, 1.0
    while number < count and all_cross > JOINED_CHANCE_MIN:
        i = begin + number * step
        ratio = room[OUT, i] / sigma
        if number > 0:
            all_cross *= -math.expm1(-brightest_rate(ratio * ratio, rates))
        room[CHANCE, i] = 1.0
        number += 1
    return number


@njit(cache=True, error_model="numpy")
def _powers_per_octave(brightest):
    """Return how many speckle powers an octave leakage is computed at, by the brightest's rate.

    Where runs of bins join the echo in bright speckle, leakage does not rise with the power.
    """
    return FINER_POWERS if -math.expm1(-brightest) > BRIGHTEST_MAX else 1


@njit(cache=True, error_model="numpy")
def _common_slope(one, other):
    """Return the harmonic mean of two slopes, or 0 if their signs differ."""
    return 2.0 * one * other / (one + other) if one * other > 0.0 else 0.0


@njit(cache=True, error_model="numpy")
def fading_mean(log_rates, per_octave):
    """Return int_0^inf e^-u (1 - exp(-R(u))) du, ln R given at powers from LOUDEST down.

    ``per_octave`` is the number of these in a factor of 2. Below the smallest of these powers R is
    proportional to u; above LOUDEST nothing is added.
    """
    last, mean, at = log_rates.size - 1, 0.0, -1
    low, high, rest = 0.0, 0.0, 0.0
    for i in range(_SPECKLE_STEPS - 1, -1, -1):
        place = per_octave * _OCTAVE[i]
        k = int(place)
        if k >= last:
            log_rate = log_rates[last] - (place - last) * math.log(2.0) / per_octave
        else:
            if k != at:
                # A monotone cubic [Fritsch and Butland, SIAM J. Sci. Stat. Comput. 5, 300, 1984].
                at, rest = k, log_rates[k + 1] - log_rates[k]
                before = log_rates[k] - log_rates[k - 1] if k > 0 else rest
                after = log_rates[k + 2] - log_rates[k + 1] if k + 2 <= last else rest
                low, high = _common_slope(before, rest), _common_slope(rest, after)
            x = place - k
            log_rate = log_rates[k] + x * (
                low + x * (3.0 * rest - 2.0 * low - high + x * (low + high - 2.0 * rest))
            )
        rate = math.exp(min(log_rate, 4.0))
        chance = rate * (1.0 - rate * (0.5 - rate / 6.0)) if rate < 1e-4 else -math.expm1(-rate)
        mean += _SPECKLE_WEIGHT[i] * chance
    return mean


@njit(cache=True, error_model="numpy")
def _all_beyond(weight, first, mirror, noise, form):
    """Bound the leakage of all bins that are ``first`` or more bins away from the lines.

    With x = a^2/2, y = b^2/2 and z = a b a single bin adds at most

        x dQ_1/dx = x y e^{-y} g,    g = I_1(z) / (z/2) <= e^{z^2/8}, 2 e^z / sqrt(2 pi z^3),

    so that all of them together add at most y e^{-y} g(nearest) times the sum of x. Images are no
    nearer to a bin than the lines, nor than ``mirror`` bins; inf if there are no images.
    ``weight``: summed magnitude of the lines; ``noise`` begins with sigma, threshold. Returns inf
    where the bound does not hold (z > 2 y).
    """
    sigma, level, _, _ = noise
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
    """Return the envelope of |G| at ``first`` bins, and half its squares' sum from there on."""
    place = envelope_from(first - 1.5, form)
    return form[1, place], form[1, place] * form[1, place] + form[2, place]


@njit(cache=True, error_model="numpy")
def _at_most(count, noise, exempt, room):
    """Bound the leakage of a run's bins from their magnitudes; inf where a bin is too strong.

    With x and y as in :func:`_all_beyond`, Q_1 is convex in x up to y - 2, because I_2(z) / I_1(z)
    >= z / (2 + sqrt(z^2 + 4)). Each bin then adds at most in proportion to the strongest one, and
    this at most e^{-(b - a)^2 / 2}; the factor 1.2 covers that noise alone stays below the
    threshold with a probability of at least 1 - e^-2.
    """
    sigma, level, _, _ = noise
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
    """Store in row CHANCE the crossing probability that signal adds in each bin of a run.

    Bins above the threshold, which bright speckle lifts over it, are no matter of the series.
    """
    sigma, level = noise[0], noise[1]
    beta, scale = level / sigma, 0.5 / (sigma * sigma)
    is_beyond = False
    for i in range(count):
        is_above = room[OUT, i] > level and not exempt[i]
        is_beyond |= is_above
        square = room[OUT, i] * room[OUT, i] * scale
        room[HALF_SQUARE, i] = 0.0 if exempt[i] or is_above else square
    added_crossings(room[HALF_SQUARE], count, beta, series, room[CHANCE])
    if is_beyond:
        stays = -math.expm1(-0.5 * beta * beta)
        for i in range(count):
            if room[OUT, i] > level and not exempt[i]:
                room[CHANCE, i] = min(excess_crossing(room[OUT, i] / sigma, beta) / stays, 1.0)


@njit(cache=True, error_model="numpy")
def _least_reach(weight, spread, noise, crossing, form, sizes):
    """Return how many bins beyond the near ones the run has to include before the integral begins.

    Heuristic: far enough for the threshold, for a smooth rate, and for 3/4 of the lines' spread;
    rounded up to a multiple of 8. :func:`inspect` doubles it until :func:`_leakage` is accurate.
    """
    sigma, level, _, _ = noise
    clearance = sizes[6]
    beside = form[1, clearance] * weight / sigma
    gentle = 4.0 + 1.5 * math.sqrt(beside * clearance * level / sigma)
    least = max(crossing, max(gentle, 0.75 * spread)) - clearance
    return int(min((max(math.ceil(least), 0.0) + 2 * APRON + 7) // 8 * 8, sizes[0] // 2))


@njit(cache=True, error_model="numpy")
def _leakage(
    run, lines, place, noise, form, sizes, tangent, room, exempt, series, rates, loudest
):  # fmt: skip
    """Return the leakage of the run and of all bins beyond it, and whether the run is long enough.

    If ``loudest`` is above 1 the echo fades, and the leakage is the mean over its speckle.
    """
    low, count, peak, origin = run
    sigma, level, _, correlation = noise
    fft_size, half = sizes[0], sizes[0] // 2
    beta, scale = level / sigma, 0.5 / (sigma * sigma)
    below, above = low > 0, low + count - 1 < half
    if not below and not above:
        if loudest > 1.0:
            return _faded_bins(count, noise, room, exempt, rates), True
        return _any_further(count, noise, room, exempt, series), True
    _chances(count, noise, room, exempt, series)
    centre = abs(math.floor(0.5 * (place[0] + place[1]) + 0.5))
    centre = fft_size - centre if centre > half else centre
    tail, rest, points = 0.0, 0.0, ZERO
    for side in (-1, 1):
        if not (below if side < 0 else above):
            continue
        correction, term, steepness, found = _near_end(side, count, room[CHANCE], exempt)
        if not found:
            return 0.0, False
        tail += correction
        rest += term
        end = centre - low - APRON if side < 0 else low + count - 1 - APRON - centre
        points = _points_beyond(side, end, centre, steepness, sizes, tangent, room, points)
    first, last = APRON if below else ZERO, count - APRON if above else count
    leave_out_joined(room[CHANCE], first, last, room[OUT], exempt, noise, correlation)
    some = any_crossing(room[CHANCE], first, last)
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
        return _faded(count, points, noise, below, above, room, exempt, rates), True
    return some - (1.0 - some) * math.expm1(-tail), True


@njit(cache=True, error_model="numpy")
def _faded(count, points, noise, below, above, room, exempt, rates):
    """Return the mean leakage, over developed speckle, of a run and of the integral beyond it."""
    beyond, scale = np.zeros(POWERS), 1.0 / (noise[0] * noise[0])
    for side in (-1, 1):
        if not (below if side < 0 else above):
            continue
        near = count - APRON - 1 if side > 0 else APRON  # the last bin before the integral
        for k in range(-2, 4):
            loud = room[OUT, near + side * k]
            add_rates(loud * loud * scale, _end_factor(k), rates, beyond)
    for i in range(points):
        add_rates(2.0 * room[AFAR, i], room[WEIGHT, i], rates, beyond)
    first, last = APRON if below else ZERO, count - APRON if above else count
    return _mean_leakage(first, last, noise, room, exempt, rates, beyond)


@njit(cache=True, error_model="numpy", borrows=True)
def _end_factor(k):
    """Return the factor of bin ``k`` in the correction of :func:`_near_end`, k = -2 .. 3."""
    one, three, five = _END_TERMS
    factors = one - 3.0 * three + 10.0 * five, three - 5.0 * five, five
    return factors[k - 1] if k > 0 else -factors[-k]


@njit(cache=True, error_model="numpy")
def _far_values(points, centre, origin, lines, digits, form, sizes, tangent, room):
    """Store |X|^2 at far points in row HALF_SQUARE, with a relative error of e^-digits.

    The points are given by tan(pi q / N), with their distance q from ``centre``, in row POINT.
    Lines that are too few for equivalent sources are summed exactly.
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
    """Compute the Euler-Maclaurin correction at the near end of one side's integral.

    Returns the correction, the size of its last term, the steepness -d ln f / dq [1/bin], and False
    if an exempt bin is too near for it.
    """
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
    """Append the Gauss points of one side's integral to rows POINT and WEIGHT; return their number.

    Rows hold cotangents of pi q / N and weights. The integral begins half a bin beyond ``last``, q
    counted from ``centre``. With images the spectrum is even about DC and Nyquist. Without them it
    goes on, and the integral, out to half a bin beyond the last bin, is corrected by the first
    difference.
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
    """Return cot(pi q / N) at q = ``whole`` bins, or half a bin farther, 0 < q <= N/2."""
    t = tangent[whole]
    if not half:
        return 1.0 / t
    small = 0.5 * math.pi / fft_size
    small *= 1.0 + small * small / 3.0
    return (1.0 - t * small) / (t + small)


@njit(cache=True, error_model="numpy")
def _order(steepness, share):
    """Return the number of Gauss points of a panel that begins at ``share`` times the near v."""
    order = 4 + int(0.6 * steepness * share)
    if share > 0.9:
        order += 5
    elif share > 0.06:
        order += 4
    elif share > 0.008:
        order += 2
    return min(order, _LARGEST_ORDER)
