"""Detection in one segment's spectrum: threshold, echoes, and bins exempt from false alarms."""

import math
from typing import NamedTuple

import numpy as np

from sweep.kernel_cache import njit
from sweep.model.hoyt import ANGLES, COSINES, bin_share, hoyt_pair
from sweep.model.marcum import marcum_q1, marcum_q1_pair
from sweep.model.speckle_modes import ModeTable, interpolated, lean_of, modes_of

RAYLEIGH_DEVIATION = math.sqrt(2 - math.pi / 2)
"""Standard deviation of |X| in a noise-only bin, in units of sigma (per quadrature)."""


def threshold(*, tnr: np.ndarray, bin_deviation: np.ndarray) -> np.ndarray:
    """Compute the threshold on |X|: TNR standard deviations of a noise-only bin's magnitude.

    The only reading of [T]'s threshold-to-noise ratio that gives its Table 4.2 (PHYSICS section
    6): a noise-only bin crosses with probability exp(-(4 - pi)/4 TNR^2).
    """
    return tnr * bin_deviation * RAYLEIGH_DEVIATION


def quiet_below(*, chance: np.ndarray, level: np.ndarray, bins: int) -> np.ndarray:
    """Return the signal amplitude [sigma] below which bins may count as noise alone, (n,).

    Parameters
    ----------
    chance
        (n,): probability of leakage that all these bins together may add.
    level
        (n,): threshold b [sigma].
    bins
        Number of bins.

    Notes
    -----
    With x = a^2/2 and y = b^2/2 a bin of amplitude a [sigma] adds at most

        x y e^-y / (1 - e^-y) e^(a^2 b^2 / 8)

    to the leakage (:mod:`sweep.model.leakage`). The last factor is taken at a b = 1, the largest
    product that is returned.
    """
    y = 0.5 * np.square(level)
    with np.errstate(divide="ignore", over="ignore", under="ignore", invalid="ignore"):
        each = np.where(y > 0, y / np.expm1(y), 1.0)
        return np.minimum(np.sqrt(2 * chance / (bins * math.exp(1 / 8) * each)), 1 / level)


class DetectionRule(NamedTuple):
    """Rule by which the bins of an echo detect it; common to all points."""

    ends: int
    """FFT size N if the noise in bins 0 and N/2 is real, else 0."""
    beside: int
    """Half-width of the main lobe [bins] if any bin of an echo may detect it; 0 if only its
    largest."""
    pairs: np.ndarray
    """(3, k): quadrature for the joint crossing of two bins,
    :func:`sweep.model.alarms.pair_nodes`."""
    fades: float
    """Correlation of neighbouring bins' noise if echoes are in developed speckle, else -1."""
    half: int
    """Nyquist bin N/2 of a real record whose echoes are in developed speckle, else 0."""
    noise_quadratures: np.ndarray
    """(bins,): pseudo-variance ratio of the noise, by bins from the nearer of DC and Nyquist."""
    modes: ModeTable
    """Speckle modes of echoes that any bin may detect."""
    correlation: float = 0.0
    """Correlation of the noise of neighbouring bins."""
    sidelobe_correlation: float = 0.0
    """Correlation of their noise in phase with a line's sidelobes, which change sign from one to
    the next, -1..1."""


class PedestalShape(NamedTuple):
    """Shape of the pedestal of phase noise about the lines of an echo.

    Of light that is mixed with itself after a delay tau, whose phase has a line width dnu: with
    Gamma = 2 pi dnu, at a frequency omega from the line

        [1 - e^(-Gamma tau) (cos omega tau + Gamma / omega sin omega tau)] / (1 + omega^2 / Gamma^2)

    over its value under the line [Richter et al., IEEE J. Quantum Electron. 22, 2070, 1986].
    """

    reach: float
    """Bins on either side of lines that the echo has by its pedestal: up to the last in which this
    has at least the power of the noise. 0 where these are no more than it has by its lines."""
    width: float
    """Line width dnu of the laser [bins of fs/N]."""
    delay: float
    """Delay tau, or the record's duration if that is shorter [N/fs]."""


NO_PEDESTAL = PedestalShape(0.0, 0.0, 0.0)


class BinLevels(NamedTuple):
    """Threshold on |X|, and noise per quadrature, in an echo's bins [V, summed over the record]."""

    line: float
    """Noise in bins that the lines fill, with that part of the phase-noise pedestal that changes
    |X|."""
    threshold: float
    quiet: float
    """Noise without the pedestal."""
    beside: float
    """Noise in bins beside the lines, with the whole pedestal."""
    pedestal: PedestalShape = NO_PEDESTAL
    """Shape of the pedestal about the lines."""


class BinSpeckle(NamedTuple):
    """Speckle parameters of the bins of one point's segment."""

    spread: float
    """Deviation of the footprint's lines [bins of fs/N]."""
    quadratures: np.ndarray
    """(bins,): pseudo-variance ratio of the signal, by bins from the nearer of DC and Nyquist;
    empty if the echo lies far from both."""


STEADY = BinSpeckle(0.0, np.empty(0))
"""Parameters of echoes that do not fade, or have circular amplitudes in all bins."""


class SpeckleTable(NamedTuple):
    """Speckle parameters of the bins of all points, by segment."""

    spread: np.ndarray
    """(segments, n): :attr:`BinSpeckle.spread`."""
    row: np.ndarray
    """(segments, n) int64: row of ``quadratures``; 0 of echoes far from DC and Nyquist."""
    quadratures: np.ndarray
    """(rows, bins)"""
    factors: np.ndarray
    """(rows, angles): :attr:`sweep.model.quadratures.SignalQuadratures.factors`."""

    def at(self, segment: int, points: np.ndarray) -> "SpeckleTable":
        """Select one segment of some points."""
        spread, row = (values[[segment]][:, points] for values in (self.spread, self.row))
        return SpeckleTable(spread, row, self.quadratures, self.factors)


@njit(cache=True, error_model="numpy", borrows=True)
def levels_of(table, i):
    """Return the :class:`BinLevels` of point i from an array (7, n)."""
    shape = PedestalShape(table[4, i], table[5, i], table[6, i])
    return BinLevels(table[0, i], table[1, i], table[2, i], table[3, i], shape)


@njit(cache=True, error_model="numpy", borrows=True)
def pedestal_density(shape, bins):
    """Return the pedestal's power ``bins`` bins from its line, over that under the line."""
    gamma, delay = 2.0 * math.pi * shape.width, shape.delay
    lost, omega = math.exp(-gamma * delay), 2.0 * math.pi * bins
    if not bins > 0.0 or not gamma * delay > 1e-5:
        return 1.0
    ripple = math.cos(omega * delay) + gamma / omega * math.sin(omega * delay)
    under_line = 1.0 - lost * (1.0 + gamma * delay)
    return (1.0 - lost * ripple) / (under_line * (1.0 + (omega / gamma) ** 2))


@njit(cache=True, error_model="numpy")
def pedestal_reaches(ratio, width, delay, most):
    """Distance of the last bin in which a pedestal has at least the power of the noise, (n,).

    ``ratio`` (n,) is the power of the pedestal under the line over that of the noise; ``width`` and
    ``delay`` (n,) are those of :class:`PedestalShape`. No result exceeds ``most``.
    """
    reaches = np.zeros(ratio.size)
    for i in range(ratio.size):
        gamma = 2.0 * math.pi * width[i]
        if not ratio[i] >= 1.0 or not gamma * delay[i] > 1e-5:
            continue
        shape = PedestalShape(0.0, width[i], delay[i])
        lost = math.exp(-gamma * delay[i])
        # From omega = Gamma on the ripple is at most sqrt(2).
        peak = ratio[i] * (1.0 + 1.5 * lost) / (1.0 - lost * (1.0 + gamma * delay[i]))
        k = math.ceil(min(width[i] * max(math.sqrt(peak), 1.0), float(most)))
        while k > 0 and ratio[i] * pedestal_density(shape, float(k)) < 1.0:
            k -= 1
        reaches[i] = k
    return reaches


@njit(cache=True, error_model="numpy", borrows=True)
def pedestal_of_bins(magnitude, echo, levels, pedestal):
    """Put the power of the pedestal in bins of an echo, over that of the noise, to ``pedestal``.

    Bins of half the largest magnitude hold lines; of the pedestal in others all counts as noise.
    """
    largest, noise = 0.0, levels.quiet * levels.quiet
    for i in range(magnitude.size):
        largest = max(largest, magnitude[i] if echo[i] else 0.0)
    under_lines = levels.line * levels.line / noise - 1.0
    beside = levels.beside * levels.beside / noise - 1.0
    apart = float(magnitude.size)
    for i in range(magnitude.size):
        apart = 0.0 if echo[i] and magnitude[i] >= 0.5 * largest else apart + 1.0
        pedestal[i] = apart
    for i in range(magnitude.size - 1, -1, -1):
        apart = min(pedestal[i], apart + 1.0)
        pedestal[i] = under_lines
        if apart > 0.0:
            pedestal[i] = beside
            if levels.pedestal.reach > 0.0:
                pedestal[i] *= pedestal_density(levels.pedestal, apart)


@njit(cache=True, error_model="numpy")
def speckle_of(table, segment, i):
    """:class:`BinSpeckle` of a point's segment, from a :class:`SpeckleTable`."""
    row = table.row[segment, i]
    bins = table.quadratures.shape[1] if row > 0 else 0
    return BinSpeckle(table.spread[segment, i], table.quadratures[row, :bins])


class Fading(NamedTuple):
    """Complex correlations of an echo's amplitudes between segments in speckle, (n,) each."""

    next: np.ndarray
    """Between up and Doppler segment, |.| <= 1."""
    over: np.ndarray
    """Between up and down segment."""
    last: np.ndarray
    """Between Doppler and down segment."""

    def mixing(self) -> np.ndarray:
        """Return the Cholesky factors of the segments' correlation matrix, (6, n).

        The amplitudes are A_up = z_0, A_doppler = m z_0 + sqrt(1 - m^2) z_1 and A_down = o z_0 + c
        z_1 + d z_2, with independent circular z of unit power. Phases that do not change joint
        magnitudes are removed. Rows: m, sqrt(1 - m^2), o, Re c, Im c, d.
        """
        near, far, last = (np.minimum(np.abs(one), 1.0) for one in self)
        turned = last * np.exp(1j * np.angle(self.next * self.last * np.conj(self.over)))
        own = np.sqrt(1 - near**2)
        with np.errstate(divide="ignore", invalid="ignore"):
            cross = np.where(own > 1e-7, (turned - near * far) / own, 0.0)
        rest = np.sqrt(np.maximum(1 - far**2 - np.abs(cross) ** 2, 0.0))
        return np.array([near, own, far, cross.real, cross.imag, rest])


def fading_together(
    one: np.ndarray,
    other: np.ndarray,
    level: np.ndarray,
    alike: np.ndarray,
    number: np.ndarray | float = 1.0,
) -> np.ndarray:
    """Return the probability that two segments in developed speckle are both detected.

    Parameters
    ----------
    one, other
        Probabilities that each segment is detected, (..., n); nan where it does not exist.
    level
        Threshold over the noise per quadrature, (n,).
    alike
        Magnitude of the correlation of the echoes' amplitudes, (n,).
    number
        Number of independent bins as which each echo counts, :func:`independent_bins`.

    Returns
    -------
    numpy.ndarray
        (..., n); nan where either is nan.

    Notes
    -----
    Of one bin these are two correlated Rayleigh magnitudes [Schwartz, Bennett and Stein,
    Communication Systems and Techniques, 1966, appendix A]. A, B are Th^2 over the mean powers, so
    that the segments are detected with e^-A and e^-B. r is the squared correlation of signal and
    noise: ``alike``^2 times the product of SNR / (1 + SNR). Then both are detected with

        J = e^-A (1 - Q_1(sqrt(2 B / (1-r)), sqrt(2 r A / (1-r))))
            + e^-B Q_1(sqrt(2 r B / (1-r)), sqrt(2 A / (1-r)))

    An echo that any of its bins detects counts as M independent bins, each of which is detected
    with q = 1 - (1 - p)^(1/M) and sees in the other segment the one that matches it. Both are
    missed with (1 - q_1 - q_2 + J(q_1, q_2))^M, so that both are detected with

        p_1 p_2 + (1 - p_1) (1 - p_2) ((1 + (J - q_1 q_2) / ((1 - q_1) (1 - q_2)))^M - 1)
    """
    there, y = np.isfinite(one) & np.isfinite(other), 0.5 * level**2
    with np.errstate(divide="ignore"):
        bins = [np.where(there, p, 1.0) for p in (one, other)]
        bins = [np.where(number > 1, -np.expm1(np.log1p(-p) / number), p) for p in bins]
        a, b = (np.minimum(-np.log(p), 700.0) for p in bins)
    shares = np.maximum(1 - a / y, 0.0) * np.maximum(1 - b / y, 0.0)  # SNR / (1 + SNR)
    square = np.minimum(alike**2 * shares, 1 - 1e-12)
    rest = 1 / (1 - square)
    both = np.exp(-a) * marcum_q1(np.sqrt(2 * b * rest), np.sqrt(2 * square * a * rest)).p
    both += np.exp(-b) * marcum_q1(np.sqrt(2 * square * b * rest), np.sqrt(2 * a * rest)).q
    missed = np.maximum((1 - bins[0]) * (1 - bins[1]), 1e-300)
    alone = (1 - one) * (1 - other)
    with np.errstate(over="ignore", invalid="ignore"):
        more = np.expm1(number * np.log1p(np.maximum(both - bins[0] * bins[1], 0.0) / missed))
        of_many = one * other + np.where(alone > 0, alone * more, 0.0)
    both = np.where(number > 1, np.minimum(of_many, np.minimum(one, other)), both)
    return np.where(there, both, np.nan)


INDEPENDENT_BINS_MAX = 1e3
"""Largest number of independent bins as which an echo counts."""


def independent_bins(pd: np.ndarray, strongest: np.ndarray, level: np.ndarray) -> np.ndarray:
    """Return the number M of independent bins like the strongest that detect as often as an echo.

    Parameters
    ----------
    pd
        Probability that any bin of the echo is detected.
    strongest, level
        |X| of its strongest bin, and threshold Th, both over the noise per quadrature sigma.

    Returns
    -------
    numpy.ndarray
        M, not a whole number, from 1 to :data:`INDEPENDENT_BINS_MAX`; 1 where pd is nan, or where
        pd and q both round to 1.

    Notes
    -----
    The strongest bin alone is detected with q = exp(-Th^2 / (2 sigma^2 (1 + SNR))), SNR = |X|^2 /
    (2 sigma^2), and 1 - pd = (1 - q)^M. A lone line has M = 1, as all its bins fade together.
    """
    single = np.exp(-0.5 * np.square(level) / (1 + 0.5 * np.square(strongest)))
    with np.errstate(divide="ignore", invalid="ignore"):
        number = np.log1p(-np.minimum(pd, 1 - 1e-15)) / np.log1p(-np.minimum(single, 1 - 1e-15))
    return np.clip(np.nan_to_num(number, nan=1.0), 1.0, INDEPENDENT_BINS_MAX)


def any_two(chances: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return the probability that at least two of three independent events happen.

    ``chances`` and ``others`` (3, ...) are the events' probabilities and their complements, which
    are passed separately to keep precision in both tails.

    >>> round(float(any_two(np.array([0.9, 0.8, 0.5]), np.array([0.1, 0.2, 0.5]))), 6)
    0.85
    """
    (a, b, c), (no_a, no_b, no_c) = chances, others
    return np.asarray(a * b * c + a * b * no_c + a * no_b * c + no_a * b * c)


@njit(cache=True, error_model="numpy", borrows=True)
def mark(magnitude, count, level, exempt, beside):
    """Find the strongest bin of a run, and mark the bins that cannot raise a false alarm.

    Adjacent bins at or above the threshold form a group, and its largest bin is the detection.
    Exempt are the bins of each group and the two next to it, and the strongest bin and its
    neighbours, group or not. If any bin of the echo may detect it (``beside`` > 0, half-width of
    the main lobe), bins within a main lobe of a bin of at least half the largest magnitude are
    exempt as well.

    Parameters
    ----------
    magnitude
        |X|, at least ``count`` bins.
    level
        Threshold on |X|.
    exempt
        Result, bool: bins that cannot raise a false alarm.
    beside
        Half-width of the main lobe [bins], or 0.

    Returns
    -------
    peak, exempted
        Index of the largest bin; number of exempt bins.
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


@njit(cache=True, error_model="numpy", borrows=True)
def is_end(bin_, ends):
    """Return whether a bin is DC or Nyquist of a real record, where noise is real.

    ``ends`` is the FFT size N, or 0 if noise is circular in all bins.
    """
    return ends > 0 and (bin_ == 0 or 2 * bin_ == ends)


@njit(cache=True, error_model="numpy", borrows=True)
def crossing_pair(a, b, real):
    """Return P(|X| >= b) and P(|X| < b) of a bin with a steady signal a, both over sigma.

    Q_1(a, b) and its complement. If the noise is ``real``, it has the power of both quadratures in
    one, a variance of 2 sigma^2: P(|a + n| >= b).
    """
    if not real:
        return marcum_q1_pair(a, b)
    above = 0.5 * (math.erfc(0.5 * (b - a)) + math.erfc(0.5 * (b + a)))
    if a < b:
        return above, 0.5 * (math.erf(0.5 * (b - a)) + math.erf(0.5 * (b + a)))
    return above, 0.5 * (math.erfc(0.5 * (a - b)) - math.erfc(0.5 * (a + b)))


@njit(cache=True, error_model="numpy", borrows=True)
def found_pair(magnitude, echo, peak, low, rule, levels, speckle):
    """Return the probabilities that an echo is detected, and that it is missed.

    The echo is detected by any of its bins (``rule.beside`` > 0, :func:`any_pair`) or by the
    largest bin of the run alone. The pedestal of phase noise is light of the echo and fades with
    it.

    Parameters
    ----------
    magnitude
        (bins,): |X| of the run without noise [V].
    echo
        (bins,) bool: bins of the echo.
    peak, low
        Index of the largest bin, and number of the run's first bin.
    rule, levels, speckle
        :class:`DetectionRule`, :class:`BinLevels` and :class:`BinSpeckle`.
    """
    deviation, level = levels.line, levels.threshold
    if rule.fades >= 0.0:
        if rule.beside > 0:
            return any_faded(magnitude, echo, low, rule, levels, speckle)
        if deviation > levels.quiet:
            return _peak_on_pedestal(magnitude[peak], low + peak, rule, levels, speckle)
        signal, noise = magnitude[peak] * magnitude[peak], 2.0 * deviation * deviation
        share = 0.0
        if speckle.quadratures.size > 0:
            share = signal * bin_share(low + peak, rule.half, speckle.quadratures)
            share += noise * bin_share(low + peak, rule.half, rule.noise_quadratures)
            share /= signal + noise
        return hoyt_pair(signal + noise, share, level)
    if rule.beside > 0:
        if levels.pedestal.reach > 0.0:
            return _any_on_pedestal(magnitude, echo, low, rule, levels)
        return any_pair(magnitude, echo, low, rule.ends, levels, rule.pairs)
    real = is_end(low + peak, rule.ends)
    return crossing_pair(magnitude[peak] / deviation, level / deviation, real)


@njit(cache=True, error_model="numpy")
def _peak_on_pedestal(magnitude, bin_, rule, levels, speckle):
    """Return pd and 1 - pd of a bin in developed speckle, by itself, whose pedestal fades too."""
    steady = np.zeros((4, 1))
    steady[0, 0], steady[1, 0] = magnitude / levels.quiet, levels.threshold / levels.quiet
    steady[3, 0] = (levels.line / levels.quiet) ** 2 - 1.0
    return _mean_over_phases(steady, np.ones(1, np.bool_), bin_, rule, speckle)


@njit(cache=True, error_model="numpy", borrows=True)
def any_pair(magnitude, echo, low, ends, levels, pairs):
    """Return the probabilities that any bin of an echo reaches the threshold, and that none does.

    Each bin by itself crosses with :func:`crossing_pair`. The noise of neighbours is correlated, in
    phase with a signal that is in step from bin to bin, as in a main lobe. The joint probability of
    two neighbours is that of correlated normal numbers with the same probabilities: their product
    plus

        1 / (2 pi) int_0^{asin rho} exp(-(s^2 + t^2 - 2 s t sin u) / (2 cos^2 u)) du

    [Owen, Ann. Math. Statist. 27, 1956], with the normal deviates s and t, by the quadrature
    ``pairs`` (:func:`sweep.model.alarms.pair_nodes`). Bins are treated as a first-order Markov
    chain.
    """
    found, missed, before, t_before, largest = 0.0, 1.0, -1.0, 0.0, 0.0
    level = levels.threshold
    for i in range(magnitude.size):
        largest = max(largest, magnitude[i] if echo[i] else 0.0)
    for i in range(magnitude.size):
        if not echo[i]:
            before = -1.0
            continue
        deviation = levels.line if magnitude[i] >= 0.5 * largest else levels.beside
        real = is_end(low + i, ends)
        crosses, stays = crossing_pair(magnitude[i] / deviation, level / deviation, real)
        if not stays > 0.0:
            return 1.0, 0.0
        chance, rest, t = _after_neighbour((crosses, stays), before, t_before, pairs)
        found += missed * chance
        missed *= rest
        before, t_before = stays, t
    return (found if found < 0.5 else 1.0 - missed), missed


@njit(cache=True, error_model="numpy")
def _any_on_pedestal(magnitude, echo, low, rule, levels):
    """:func:`any_pair` of an echo whose pedestal detects too."""
    bins = magnitude.size
    pedestal, steady = np.empty(bins), np.empty((4, bins))
    pedestal_of_bins(magnitude, echo, levels, pedestal)
    for k in range(bins):
        deviation = levels.quiet * math.sqrt(1.0 + pedestal[k])
        steady[0, k], steady[1, k] = magnitude[k] / deviation, levels.threshold / deviation
        steady[2, k], steady[3, k] = rule.correlation, 0.0
    return _any_steady(steady, 1.0, echo, low, rule.ends, np.inf, 0.0)


@njit(cache=True, error_model="numpy", borrows=True)
def _after_neighbour(chances, before, t_before, pairs):
    """Probabilities that a bin crosses, and that it does not, where the bin before has not.

    ``chances`` are those of the bin by itself, ``before`` and ``t_before`` the probability that the
    bin before does not cross and the normal deviate of that; below 0 where there is none before.
    Returns the deviate of this bin as well.
    """
    crosses, stays = chances
    t = _deviate(crosses) if crosses < stays else -_deviate(stays)
    if not before > 0.0:
        return crosses, stays, t
    joint = 0.0
    for k in range(pairs.shape[1]):
        square = t * t + t_before * t_before - 2.0 * t * t_before * pairs[0, k]
        joint += pairs[1, k] * math.exp(-square * pairs[2, k])
    joint = min(joint / before, crosses)
    return crosses - joint, stays + joint, t


@njit(cache=True, error_model="numpy", borrows=True)
def any_neighbour(chances, count, pairs):
    """Return the probability that any of ``count`` adjacent bins crosses, given each bin's own.

    Neighbours are correlated as in :func:`any_pair`; bins that cross with less than 1e-4 count as
    independent.
    """
    found, missed, before, t_before = 0.0, 1.0, -1.0, 0.0
    for i in range(count):
        crosses = min(max(chances[i], 0.0), 1.0)
        stays = 1.0 - crosses
        if not stays > 0.0:
            return 1.0
        if crosses < 1e-4:
            found, missed, before = found + missed * crosses, missed * stays, -1.0
            continue
        chance, rest, t = _after_neighbour((crosses, stays), before, t_before, pairs)
        found += missed * chance
        missed *= rest
        before, t_before = stays, t
    return found


@njit(cache=True, error_model="numpy", borrows=True)
def free_images(magnitude, exempt, low, size, gain):
    """Clear the exemption of bins dominated by an I/Q image; return the number still exempt.

    The image of ``gain`` times the line's |X| stands at the opposite frequency. It dominates a bin
    where it makes at least half of |X|. ``low`` is the number of the first bin, ``size`` the FFT
    size N.
    """
    exempted = 0
    for k in range(magnitude.size):
        opposite = (-2 * low - k) % size
        if exempt[k] and opposite < magnitude.size:
            line = magnitude[opposite]
            if line > magnitude[k] and gain * line >= 0.5 * magnitude[k]:
                exempt[k] = False
        exempted += exempt[k]
    return exempted


@njit(cache=True, error_model="numpy", borrows=True)
def any_faded(magnitude, echo, low, rule, levels, speckle):
    """Return the probabilities that any, and that no, bin of an echo in developed speckle crosses.

    The strongest speckle mode (:mod:`sweep.model.speckle_modes`) is one complex Gaussian number z
    for all bins. Given z, bin k has the steady signal u_k z, and the other modes add to its noise,
    with their own variance and correlation. The result is the mean over |z|^2, which is
    exponential. A single line has all its power in this mode, and its sidelobes fade with it. Near
    DC and Nyquist the mode's power depends on the phase of z as 1 + q_k cos t, with the
    pseudo-variance ratio q_k of bin k and t uniform (:mod:`sweep.model.quadratures`).

    Stretches of bins of half the largest magnitude are echoes by themselves; weaker stretches
    belong to the one below. Errors: docs/physics.md.
    """
    largest = 0.0
    for i in range(magnitude.size):
        largest = max(largest, magnitude[i] if echo[i] else 0.0)
    found, missed, begin, i, parts = 0.0, 1.0, 0, 0, 0
    while i < magnitude.size:
        start, strong = i, False
        while i < magnitude.size and echo[i]:
            strong |= magnitude[i] >= 0.5 * largest
            i += 1
        if strong:
            if parts > 0:
                one = _stretch_faded(magnitude, echo, (begin, start), low, rule, levels, speckle)
                found, missed, begin = found + missed * one[0], missed * one[1], start
            parts += 1
        i += 1
    end = magnitude.size
    one = _stretch_faded(magnitude, echo, (begin, end), low, rule, levels, speckle)
    return found + missed * one[0], missed * one[1]


_ORDER = 7
_REACH = 4.5
_Z_MAX = 6.0
_RARE = 1e-6
_NEGLIGIBLE, _NEGLIGIBLE_PART = 1e-8, 1e-6
"""Probability, and part of pd and of 1 - pd, below which what a bin adds may be left out."""
_NODE, _WEIGHT = np.polynomial.legendre.leggauss(_ORDER)
_PAIR_NODE, _PAIR_WEIGHT = np.polynomial.legendre.leggauss(4)


@njit(cache=True, error_model="numpy")
def _stretch_faded(magnitude, echo, bounds, low, rule, levels, speckle):
    """Return pd and 1 - pd of one echo in developed speckle, bins bounds[0] .. bounds[1] - 1.

    As of :func:`any_faded`.
    """
    begin, end = bounds
    while begin < end - 1 and not echo[begin]:
        begin += 1
    while end > begin + 1 and not echo[end - 1]:
        end -= 1
    nearest = begin
    for i in range(begin, end):
        if echo[i] and not (echo[nearest] and magnitude[i] <= magnitude[nearest]):
            nearest = i
    below = magnitude[nearest - 1] if nearest > 0 else 0.0
    above = magnitude[nearest + 1] if nearest + 1 < magnitude.size else 0.0
    if rule.half > 0 and (low + nearest == 0 or low + nearest == rule.half):
        below = above = max(below, above)  # bins mirror there
    lean = lean_of(below, magnitude[nearest], above)
    at, modes = modes_of(rule.modes, speckle.spread, lean), rule.modes
    noise = 2.0 * levels.quiet * levels.quiet
    # Over the noise per quadrature that the other modes make with the receiver's: the strongest
    # mode, the threshold; the correlation of this noise with that of the bin below; the pedestal
    # that fades with the mode, as a power.
    steady, bins = np.empty((6, end - begin)), end - begin
    share_before = 0.0
    pedestals = np.empty(bins)
    pedestal_of_bins(magnitude[begin:end], echo[begin:end], levels, pedestals)
    for k in range(bins):
        i = begin + k
        power, pedestal = magnitude[i] * magnitude[i], noise * pedestals[k]
        # A pedestal has the light of all lines, as the bins amid them.
        is_near = abs(i - nearest) <= rule.beside or not levels.pedestal.reach > 0.0
        share = interpolated(modes.share, at, i - nearest if is_near else 0)
        other = (1.0 - share) * (power + pedestal) + noise
        scale = math.sqrt(2.0 / other)
        steady[3, k] = share * pedestal / other
        steady[0, k], steady[1, k] = scale * math.sqrt(share * power), scale * levels.threshold
        steady[2, k] = 0.0
        if k > 0 and echo[i] and echo[i - 1]:
            alike = interpolated(modes.coherence, at, i - nearest)
            own = (abs(alike) - math.sqrt(share * share_before)) * magnitude[i] * magnitude[i - 1]
            own += noise * math.copysign(rule.fades, alike)
            steady[2, k] = min(max(0.5 * own * scale * steady[4, k - 1], -0.999), 0.999)
        steady[4, k], steady[5, k], share_before = scale, share, share
    for k in range(bins):
        # Of bins near an end, but these, the other modes go with the phase too.
        bin_ = low + begin + k
        others = (1.0 - steady[5, k]) * magnitude[begin + k] ** 2
        steady[4, k] = 0.0
        if bin_ != 0 and bin_ != rule.half:
            steady[4, k] = others / (others + noise)
    return _mean_over_phases(steady, echo[begin:end], low + begin, rule, speckle)


@njit(cache=True, error_model="numpy", borrows=True)
def _mean_over_phases(steady, echo, low, rule, speckle):
    """Average :func:`_mean_over_mode` over the phase of the mode, where bins are noncircular.

    An optional fifth row of ``steady`` is the fraction of the noise that is echo as well.
    """
    if speckle.quadratures.size == 0:
        return _mean_over_mode(steady, echo, low, rule.ends)
    return _mean_over_angles(steady, echo, low, rule, speckle)


@njit(cache=True, error_model="numpy")
def _mean_over_angles(steady, echo, low, rule, speckle):
    """Average as :func:`_mean_over_phases` does, for noncircular bins."""
    found, missed = 0.0, 0.0
    turned = steady.copy()
    for angle in range(ANGLES):
        for k in range(echo.size):
            share = bin_share(low + k, rule.half, speckle.quadratures)
            factor = max(1.0 + share * COSINES[angle], 0.0)
            scale = 1.0
            if steady.shape[0] > 4:
                scale = 1.0 / math.sqrt(1.0 + (factor - 1.0) * steady[4, k])
            turned[0, k] = steady[0, k] * math.sqrt(factor) * scale
            turned[1, k] = steady[1, k] * scale
            turned[3, k] = steady[3, k] * factor * scale * scale
        one = _mean_over_mode(turned, echo, low, rule.ends)
        found, missed = found + one[0] / ANGLES, missed + one[1] / ANGLES
    return found, missed


@njit(cache=True, error_model="numpy", borrows=True)
def _mean_over_mode(steady, echo, low, ends):
    """Return the probabilities that any, and that no, bin crosses, averaged over the mode's power.

    ``steady`` (>= 4, bins): root mean square signal of the mode over the noise; threshold over the
    noise; noise correlation with the bin below; mean power of the noise that fades with the mode,
    over that of the rest. Given z the signal is z times row 0. The average is over |z| with the
    density 2 z e^(-z^2).
    """
    first, last, middle, pedestal, strongest = _Z_MAX, _Z_MAX, _Z_MAX, 0.0, -1
    for k in range(echo.size):
        pedestal = max(pedestal, steady[3, k])
        if echo[k] and steady[0, k] > 0.0:
            wide = _REACH * math.sqrt(steady[3, k])
            if steady[1, k] < middle * steady[0, k]:
                middle, strongest = steady[1, k] / steady[0, k], k
            first = min(first, max(steady[1, k] - _REACH, 0.0) / (steady[0, k] + wide))
            if steady[0, k] > wide:
                last = min(last, (steady[1, k] + _REACH) / (steady[0, k] - wide))
    last = min(last, math.sqrt(middle * middle + 10.0))  # what is beyond is 5e-5 of it all
    ends_of_pieces = (first, last, last)
    if pedestal > 0.0:
        # Where a pedestal fades they rise about the middle, or slowly all the way.
        last = max(first, min(last, 4.5))  # what is beyond is 2e-9
        half_way = middle if first < middle < last else 0.5 * (first + last)
        ends_of_pieces = (first, half_way, last)
    is_real = is_end(low + strongest, ends)
    # From the largest |z| on, so that bins that add nothing to what there is can be left out.
    found, missed, faintest = math.exp(-last * last), 0.0, -math.expm1(-first * first)
    for piece in range(1, -1, -1):
        half = 0.5 * (ends_of_pieces[piece + 1] - ends_of_pieces[piece])
        for j in range(_ORDER - 1 if half > 0.0 else -1, -1, -1):
            z = ends_of_pieces[piece] + half * (_NODE[j] + 1.0)
            weight = half * _WEIGHT[j] * 2.0 * z * math.exp(-z * z)
            counts = min(_NEGLIGIBLE, _NEGLIGIBLE_PART * min(found, missed + faintest)) / weight
            reach = math.inf if pedestal > 0.0 else _reach_at(z, steady, strongest, is_real, counts)
            one = _any_steady(steady, z, echo, low, ends, reach, counts)
            found, missed = found + weight * one[0], missed + weight * one[1]
    if first > 0.0:
        counts = min(_NEGLIGIBLE, _NEGLIGIBLE_PART * min(found, faintest)) / faintest
        reach = (
            math.inf
            if pedestal > 0.0
            else _reach_at(0.6 * first, steady, strongest, is_real, counts)
        )
        one = _any_steady(steady, 0.6 * first, echo, low, ends, reach, counts)
        found, missed = found + faintest * one[0], missed + faintest * one[1]
    whole = found + missed  # 1 but for the quadrature
    return found / whole, missed / whole


@njit(cache=True, error_model="numpy", borrows=True)
def _reach_at(z, steady, strongest, is_real, counts):
    """Return the squared distance below the threshold from which on bins do not count, given z.

    A bin adds at most e^(-(b - a)^2 / 2) to what the strongest one leaves, which is missed with
    less than e^(-(a - b)^2 / 2), or the root of it where noise is real. Bins that add less than
    ``counts`` do not count.
    """
    if not counts > 0.0 or strongest < 0:
        return math.inf
    above = max(steady[0, strongest] * z - steady[1, strongest], 0.0)
    return -2.0 * math.log(counts) - above * above * (0.5 if is_real else 1.0)


@njit(cache=True, error_model="numpy", borrows=True)
def _any_steady(steady, z, echo, low, ends, reach, counts):
    """Return the probabilities that any, and that no, bin crosses, given the mode's magnitude z.

    As :func:`any_pair`, with a noise correlation r of each pair of neighbours. Their powers then
    have the correlation

        (r^2 + r a b) / sqrt((1 + a^2) (1 + b^2)),

    with their signals a and b over the noise: r^2 for noise alone, r for strong signals.

    Bins that are further below the threshold than the root of ``reach`` are left out. Bins that add
    less than ``counts`` to the probability count as independent of their neighbours.
    """
    found, missed, before, t_before, a_before = 0.0, 1.0, -1.0, 0.0, 0.0
    for k in range(echo.size):
        if not echo[k]:
            before = -1.0
            continue
        scale = 1.0 / math.sqrt(1.0 + steady[3, k] * z * z)
        a = steady[0, k] * z * scale
        below = steady[1, k] * scale - a
        real = is_end(low + k, ends)
        if below > 0.0 and below * below > (2.0 * reach if real else reach):
            before = -1.0
            continue
        crosses, stays = crossing_pair(a, steady[1, k] * scale, real)
        if not stays > 0.0:
            return 1.0, 0.0
        if crosses < _RARE or missed * crosses < counts:  # so is that both of a pair cross
            found, missed, before = found + missed * crosses, missed * stays, -1.0
            continue
        t = _deviate(crosses) if crosses < stays else -_deviate(stays)
        chance, rest = crosses, stays
        r = steady[2, k]
        if before > 0.0 and r != 0.0:
            r = (r * r + r * a * a_before) / math.sqrt((1.0 + a * a) * (1.0 + a_before * a_before))
            joint, half = 0.0, 0.5 * math.asin(r)
            for j in range(_PAIR_NODE.size):
                sine = math.sin(half * (_PAIR_NODE[j] + 1.0))
                square = t * t + t_before * t_before - 2.0 * t * t_before * sine
                joint += _PAIR_WEIGHT[j] * math.exp(-square / (2.0 * (1.0 - sine * sine)))
            joint *= half / (2.0 * math.pi)
            joint = max(min(joint / before, crosses), -stays)
            chance, rest = crosses - joint, stays + joint
        found += missed * chance
        missed *= rest
        before, t_before, a_before = stays, t, a
    return (found if found < 0.5 else 1.0 - missed), missed


@njit(cache=True, error_model="numpy", borrows=True)
def _deviate(chance):
    """Return the normal deviate exceeded with probability ``chance`` <= 1/2, to about 1e-4."""
    if chance < 1e-300:
        return 37.0
    s = math.sqrt(-2.0 * math.log(chance))
    t = s - (2.30753 + 0.27061 * s) / (1.0 + s * (0.99229 + 0.04481 * s))
    tail = 0.5 * math.erfc(t * math.sqrt(0.5))
    slope = math.exp(-0.5 * t * t) / math.sqrt(2.0 * math.pi)
    return t + math.log(tail / chance) * tail / slope


@njit(cache=True, error_model="numpy", borrows=True)
def echo_of(magnitude, first, last, level, beside):
    """Return the first and last bin of the echo around a group of bins first .. last.

    The echo has the adjacent bins of at least half the group's largest magnitude, and a main lobe's
    half-width ``beside`` on either side, up to the next group. With ``beside`` 0 it is the group.
    """
    if beside == 0:
        return first, last
    largest = magnitude[first]
    for k in range(first + 1, last + 1):
        largest = max(largest, magnitude[k])
    floor = 0.5 * largest
    while first > 0 and floor <= magnitude[first - 1] < level:
        first -= 1
    while last < magnitude.size - 1 and floor <= magnitude[last + 1] < level:
        last += 1
    for _ in range(beside):
        first -= 1 if first > 0 and magnitude[first - 1] < level else 0
        last += 1 if last < magnitude.size - 1 and magnitude[last + 1] < level else 0
    return first, last


@njit(cache=True, error_model="numpy", borrows=True)
def _survey(magnitude, level):
    """Return the largest magnitude, and the number of bins at or above a level."""
    largest, above = magnitude[0], 0
    for i in range(magnitude.size):
        largest = magnitude[i] if magnitude[i] > largest else largest
        above += magnitude[i] >= level
    return largest, above


@njit(cache=True, error_model="numpy", borrows=True)
def _exempt(first, last, count, exempt):
    """Mark the bins first .. last and their two neighbours as exempt; return their number."""
    first, last = max(first - 1, 0), min(last + 1, count - 1)
    exempt[first : last + 1] = True
    return last - first + 1


@njit(cache=True, error_model="numpy")
def detect_rows(magnitude, first, bins, rule, levels, speckle, out):
    """Detect in runs of noiseless spectra, one per point.

    Its rows are those of :data:`sweep.model.segments.SEGMENT_FIELDS`; no leakage. ``bins`` are the
    last bin of the spectrum and the bin width [Hz]; bins outside 0..N/2 are passed over.
    ``levels`` (7, m) are those of :class:`BinLevels`; ``speckle`` is a :class:`SpeckleTable`,
    (1, m).
    """
    half, width = bins
    exempt = np.empty(magnitude.shape[1], np.bool_)
    for i in range(magnitude.shape[0]):
        low = max(-first[i], 0)
        high = min(half + 1 - first[i], magnitude.shape[1])
        run = magnitude[i, low:high]
        beside = max(rule.beside, int(levels[4, i]))
        peak, exempted = mark(run, run.size, levels[1, i], exempt, beside)
        found, missed = found_pair(
            run, exempt[: run.size], peak, first[i] + low, rule, levels_of(levels, i),
            speckle_of(speckle, 0, i),
        )  # fmt: skip
        out[0, i], out[1, i], out[2, i] = found, missed, run[peak]
        out[3, i] = (first[i] + low + peak) * width
        out[4, i], out[5, i] = exempted, 0.0
