"""Detection in one segment's spectrum: threshold, groups, what may raise a false alarm."""

import math
from typing import NamedTuple

import numpy as np

from sweep.kernels import njit
from sweep.model.marcum import marcum_q1, marcum_q1_pair

RAYLEIGH_DEVIATION = math.sqrt(2 - math.pi / 2)
"""Standard deviation of |X| in a noise-only bin, in units of sigma (per quadrature)."""


def threshold(*, tnr: np.ndarray, bin_deviation: np.ndarray) -> np.ndarray:
    """Compute the threshold on |X|: TNR standard deviations of a noise-only bin's magnitude.

    The only reading of [T]'s threshold-to-noise ratio that gives its Table 4.2 (PHYSICS section
    6): a noise-only bin crosses with probability exp(-(4 - pi)/4 TNR^2).
    """
    return tnr * bin_deviation * RAYLEIGH_DEVIATION


def quiet_below(*, chance: np.ndarray, level: np.ndarray, bins: int) -> np.ndarray:
    """Signal [sigma] below which bins may count as noise alone, (n,).

    With x = a^2/2 and y = b^2/2 a bin of a sigma leaks with no more than

        x y e^-y / (1 - e^-y) e^(a^2 b^2 / 8)

    (:mod:`sweep.model.leakage`), here with a b <= 1; all of them together with ``chance`` (n,).
    """
    y = 0.5 * np.square(level)
    with np.errstate(divide="ignore", over="ignore", under="ignore", invalid="ignore"):
        each = np.where(y > 0, y / np.expm1(y), 1.0)
        return np.minimum(np.sqrt(2 * chance / (bins * math.exp(1 / 8) * each)), 1 / level)


class Fading(NamedTuple):
    """Correlations of a point's segments in developed speckle, (n,) each."""

    next: np.ndarray
    """complex: of amplitudes in up and Doppler segment, within the unit circle."""
    over: np.ndarray
    """complex: of those in up and down segment."""
    last: np.ndarray
    """complex: of those in Doppler and down segment."""

    def mixing(self) -> np.ndarray:
        """Numbers by which three standard normal amplitudes mix, (6, n).

        Segment by segment z_0, m z_0 + sqrt(1 - m^2) z_1 and o z_0 + c z_1 + d z_2, with phases
        turned away where they do not matter. Result: m, its complement, o, the two parts of c, and
        d.
        """
        near, far, last = (np.minimum(np.abs(one), 1.0) for one in self)
        turned = last * np.exp(1j * np.angle(self.next * self.last * np.conj(self.over)))
        own = np.sqrt(1 - near**2)
        with np.errstate(divide="ignore", invalid="ignore"):
            cross = np.where(own > 1e-7, (turned - near * far) / own, 0.0)
        rest = np.sqrt(np.maximum(1 - far**2 - np.abs(cross) ** 2, 0.0))
        return np.array([near, own, far, cross.real, cross.imag, rest])


def fading_together(
    one: np.ndarray, other: np.ndarray, level: np.ndarray, alike: np.ndarray
) -> np.ndarray:
    """Probability that two segments in developed speckle are both detected; nan where one lacks.

    Two correlated Rayleigh magnitudes [Schwartz, Bennett and Stein, Communication Systems and
    Techniques, 1966, appendix A]. With A, B = Th^2 over the mean powers, e^-A and e^-B the
    probabilities that either is detected, and r the square of the correlation that noise leaves of
    the signals' (``alike``),

        e^-A (1 - Q_1(sqrt(2 B / (1-r)), sqrt(2 r A / (1-r))))
            + e^-B Q_1(sqrt(2 r B / (1-r)), sqrt(2 A / (1-r)))

    An echo of many bins, any of which detects, counts as the one that is detected as often.
    """
    there, y = np.isfinite(one) & np.isfinite(other), 0.5 * level**2
    with np.errstate(divide="ignore"):
        a, b = (np.minimum(-np.log(np.where(there, p, 1.0)), 700.0) for p in (one, other))
    shares = np.maximum(1 - a / y, 0.0) * np.maximum(1 - b / y, 0.0)  # SNR / (1 + SNR)
    square = np.minimum(alike**2 * shares, 1 - 1e-12)
    rest = 1 / (1 - square)
    both = np.exp(-a) * marcum_q1(np.sqrt(2 * b * rest), np.sqrt(2 * square * a * rest)).p
    both += np.exp(-b) * marcum_q1(np.sqrt(2 * square * b * rest), np.sqrt(2 * a * rest)).q
    return np.where(there, both, np.nan)


def any_two(chances: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Probability that at least two of three independent events happen.

    Of the probabilities of each, and of its contrary, (3, ...).

    >>> round(float(any_two(np.array([0.9, 0.8, 0.5]), np.array([0.1, 0.2, 0.5]))), 6)
    0.85
    """
    (a, b, c), (no_a, no_b, no_c) = chances, others
    return np.asarray(a * b * c + a * b * no_c + a * no_b * c + no_a * b * c)


@njit(cache=True, error_model="numpy")
def mark(magnitude, count, level, exempt, beside):
    """Find the detection in a run of bins, and mark those that can't raise a false alarm.

    Adjacent bins at or above the threshold form a group; its largest bin is the detection. The bins
    of a group and the two next to it can't raise a false alarm, nor can the strongest bin and its
    neighbours, group or not. If any bin of the echo detects, bins within a main lobe (half of it
    ``beside``, else 0) of one that has half of the largest magnitude can't either. Returns the
    index of the largest bin, and the number of exempt bins.
    """
    largest, above = _survey(magnitude[:count], level)
    peak = 0
    while peak < count - 1 and magnitude[peak] < largest:
        peak += 1
    exempt[:count] = False
    if beside > 0:
        for i in range(count):
            if i == peak or (magnitude[i] >= 0.5 * largest and largest > 0.0):
                exempt[max(i - beside, 0) : min(i + beside + 1, count)] = True
    first, last = peak, peak
    while first > 0 and magnitude[first - 1] >= level:
        first -= 1
    while last < count - 1 and magnitude[last + 1] >= level:
        last += 1
    exempted = _exempt(first, last, count, exempt)
    if above > last - first + 1 or beside > 0:
        exempted = 0
        for i in range(count):
            if magnitude[i] >= level:
                _exempt(i, i, count, exempt)
        for i in range(count):
            exempted += exempt[i]
    return peak, exempted


@njit(cache=True, error_model="numpy")
def is_end(bin_, ends):
    """Return true for DC and Nyquist, where noise is real; ``ends`` is N, or 0 where none is."""
    return ends > 0 and (bin_ == 0 or 2 * bin_ == ends)


@njit(cache=True, error_model="numpy")
def crossing_pair(a, b, real):
    """Probabilities that a bin of signal a [sigma] reaches a threshold b, and that it does not.

    Q_1(a, b) and its complement. If the noise is real it has the power of both quadratures in
    one, a variance of 2 sigma^2: |a + n| >= b.
    """
    if not real:
        return marcum_q1_pair(a, b)
    above = 0.5 * (math.erfc(0.5 * (b - a)) + math.erfc(0.5 * (b + a)))
    if a < b:
        return above, 0.5 * (math.erf(0.5 * (b - a)) + math.erf(0.5 * (b + a)))
    return above, 0.5 * (math.erfc(0.5 * (a - b)) - math.erfc(0.5 * (a + b)))


@njit(cache=True, error_model="numpy")
def found_pair(magnitude, echo, peak, low, rule, levels):
    """Probabilities that an echo is detected, and that it is missed.

    By any of its bins (:func:`any_pair`), or by the peak of a run alone where half of a main lobe
    is 0. ``rule`` is :attr:`sweep.model.preparation.Shots.echo_rule`; ``levels`` are the noise per
    quadrature and the threshold.
    """
    (ends, beside, pairs, fades), (deviation, level) = rule, levels
    if fades >= 0.0:
        if beside > 0:
            return any_faded(magnitude, echo, beside, (deviation, level), fades)
        y = level * level / (2.0 * deviation * deviation + magnitude[peak] * magnitude[peak])
        return math.exp(-y), -math.expm1(-y)
    if beside > 0:
        return any_pair(magnitude, echo, low, ends, deviation, level, pairs)
    real = is_end(low + peak, ends)
    return crossing_pair(magnitude[peak] / deviation, level / deviation, real)


@njit(cache=True, error_model="numpy")
def any_pair(magnitude, echo, low, ends, deviation, level, pairs):
    """Probabilities that any bin of an echo reaches the threshold, and that none does.

    Each bin by itself crosses with :func:`crossing_pair`. Neighbours' noise is correlated, and in
    phase with a signal that is in step from bin to bin, as in a line's main lobe. Of each pair the
    joint probability is that of normal numbers with the bins' own probabilities, which add

        1 / (2 pi) int_0^{asin rho} exp(-(s^2 + t^2 - 2 s t sin u) / (2 cos^2 u)) du

    to the product [Owen, Ann. Math. Statist. 27, 1956], by the rule ``pairs`` of
    :func:`sweep.model.alarms.pair_nodes`; bins are a Markov chain of first order.
    """
    found, missed, before, t_before = 0.0, 1.0, -1.0, 0.0
    for i in range(magnitude.size):
        if not echo[i]:
            before = -1.0
            continue
        real = is_end(low + i, ends)
        crosses, stays = crossing_pair(magnitude[i] / deviation, level / deviation, real)
        if not stays > 0.0:
            return 1.0, 0.0
        t = _deviate(crosses) if crosses < stays else -_deviate(stays)
        chance, rest = crosses, stays
        if before > 0.0:
            joint = 0.0
            for k in range(pairs.shape[1]):
                square = t * t + t_before * t_before - 2.0 * t * t_before * pairs[0, k]
                joint += pairs[1, k] * math.exp(-square * pairs[2, k])
            joint = min(joint / before, crosses)
            chance, rest = crosses - joint, stays + joint
        found += missed * chance
        missed *= rest
        before, t_before = stays, t
    return (found if found < 0.5 else 1.0 - missed), missed


@njit(cache=True, error_model="numpy")
def any_faded(magnitude, echo, beside, levels, correlation):
    """Probabilities that any, and that no, bin of an echo in developed speckle crosses.

    Signal and noise of a bin are circular complex Gaussian. It crosses with Swerling's first
    probability, exp(-Th^2 / (2 sigma^2 (1 + SNR))), and neighbours as two correlated Rayleigh
    magnitudes; bins are a Markov chain of first order. ``correlation`` is that of neighbours'
    noise. Their signals have 1 where one line makes them, and that of noise where many far apart
    do. Between, for Gaussian windows and echoes of variance v [bins^2], ln m = ln rho (1 - v_1/v)
    with v_1 = 1 / (-8 ln rho) of one line. The variance is that of bins of half the largest
    magnitude with half of a main lobe (``beside``) on either side: sidelobes of one line, which may
    cross too, fade with it. It is within 0.02 of drawn echoes of any width; for rectangular
    windows, of lone lines within 0.005, of wider echoes up to 0.1 too low.
    """
    deviation, level = levels
    whole, mean, square, largest = 0.0, 0.0, 0.0, 0.0
    for i in range(magnitude.size):
        largest = max(largest, magnitude[i] if echo[i] else 0.0)
    first, last = 0, magnitude.size - 1
    while first < last and not (echo[first] and magnitude[first] >= 0.5 * largest):
        first += 1
    while last > first and not (echo[last] and magnitude[last] >= 0.5 * largest):
        last -= 1
    first, last = max(first - beside, 0), min(last + beside, magnitude.size - 1)
    for i in range(first, last + 1):
        if echo[i]:
            power = magnitude[i] * magnitude[i]
            whole, mean = whole + power, mean + power * i
    mean /= max(whole, 1e-300)
    for i in range(first, last + 1):
        if echo[i]:
            square += magnitude[i] * magnitude[i] * (i - mean) * (i - mean)
    rho = max(correlation, 0.05)
    line = max(-1.1 / (8.0 * math.log(rho)), 0.25 if correlation > 0.1 else 0.5)
    together = rho ** max(1.0 - line * whole / max(square, 1e-300), 0.0)
    noise = 2.0 * deviation * deviation
    found, missed, before, least_before, share_before = 0.0, 1.0, -1.0, 0.0, 0.0
    for i in range(magnitude.size):
        if not echo[i]:
            before = -1.0
            continue
        power = magnitude[i] * magnitude[i] + noise
        least, share = level * level / power, 1.0 - noise / power
        crosses, stays = math.exp(-least), -math.expm1(-least)
        chance, rest = crosses, stays
        if before > 0.0:
            alike = together * math.sqrt(share * share_before)
            alike += correlation * math.sqrt((1.0 - share) * (1.0 - share_before))
            r = min(alike * alike, 1.0 - 1e-9)
            scale = math.sqrt(2.0 / (1.0 - r))
            x, y, root = scale * math.sqrt(least), scale * math.sqrt(least_before), math.sqrt(r)
            # Both cross: e^-A (1 - Q_1(y, root x)) + e^-B Q_1(root y, x); this bin alone does not.
            joint = crosses * marcum_q1_pair(y, root * x)[1]
            joint += math.exp(-least_before) * marcum_q1_pair(root * y, x)[0]
            chance = min(max((crosses - joint) / before, 0.0), 1.0)
            rest = 1.0 - chance
        found += missed * chance
        missed *= rest
        before, least_before, share_before = stays, least, share
    return (found if found < 0.5 else 1.0 - missed), missed


@njit(cache=True, error_model="numpy")
def _deviate(chance):
    """Compute the normal deviate exceeded with a probability of at most 1/2; to about 1e-4."""
    if chance < 1e-300:
        return 37.0
    s = math.sqrt(-2.0 * math.log(chance))
    t = s - (2.30753 + 0.27061 * s) / (1.0 + s * (0.99229 + 0.04481 * s))
    tail = 0.5 * math.erfc(t * math.sqrt(0.5))
    slope = math.exp(-0.5 * t * t) / math.sqrt(2.0 * math.pi)
    return t + math.log(tail / chance) * tail / slope


@njit(cache=True, error_model="numpy")
def echo_of(magnitude, first, last, level, beside):
    """First and last bin of the echo about a group of bins first .. last of a run.

    Those of half the group's largest magnitude that join on to it, and a main lobe on either side,
    up to the next group; the group itself where ``beside`` is 0.
    """
    if beside == 0:
        return first, last
    floor = 0.5 * magnitude[first : last + 1].max()
    while first > 0 and floor <= magnitude[first - 1] < level:
        first -= 1
    while last < magnitude.size - 1 and floor <= magnitude[last + 1] < level:
        last += 1
    for _ in range(beside):
        first -= 1 if first > 0 and magnitude[first - 1] < level else 0
        last += 1 if last < magnitude.size - 1 and magnitude[last + 1] < level else 0
    return first, last


@njit(cache=True, error_model="numpy")
def _survey(magnitude, level):
    """Largest magnitude, and how many reach a level."""
    largest, above = magnitude[0], 0
    for i in range(magnitude.size):
        largest = magnitude[i] if magnitude[i] > largest else largest
        above += magnitude[i] >= level
    return largest, above


@njit(cache=True, error_model="numpy")
def _exempt(first, last, count, exempt):
    """Mark the bins of a group and the two beside it; return their number."""
    first, last = max(first - 1, 0), min(last + 1, count - 1)
    exempt[first : last + 1] = True
    return last - first + 1


@njit(cache=True, error_model="numpy")
def detect_rows(magnitude, first, bins, rule, deviation, level, out):
    """Detect in runs of spectra without noise, (m, count), into ``out`` (6, m).

    Its rows are those of :data:`sweep.model.segments.SEGMENT_FIELDS`; no leakage. ``bins`` are the
    last bin of the spectrum and the bin width [Hz]; bins outside 0..N/2 are passed over.
    """
    half, width = bins
    exempt = np.empty(magnitude.shape[1], np.bool_)
    for i in range(magnitude.shape[0]):
        low = max(-first[i], 0)
        high = min(half + 1 - first[i], magnitude.shape[1])
        run = magnitude[i, low:high]
        peak, exempted = mark(run, run.size, level[i], exempt, rule[1])
        found, missed = found_pair(
            run, exempt[: run.size], peak, first[i] + low, rule, (deviation[i], level[i])
        )
        out[0, i], out[1, i], out[2, i] = found, missed, run[peak]
        out[3, i] = (first[i] + low + peak) * width
        out[4, i], out[5, i] = exempted, 0.0
