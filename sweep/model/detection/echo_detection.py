"""Detection in one segment's spectrum: threshold, echoes, and bins exempt from false alarms."""

import math
from typing import NamedTuple

import numpy as np

from sweep.kernel_cache import njit
from sweep.model.detection.hoyt import (
    N_PHASE_NODES,
    PHASE_COSINES,
    hoyt_tails,
    pseudo_variance_ratio_at,
)
from sweep.model.detection.joint_tail import (
    JointTailRule,
    joint_tail_excess,
    joint_tail_excess_at,
)
from sweep.model.detection.marcum import Tails, marcum_q1, marcum_q1_tails
from sweep.model.detection.speckle_modes import (
    ModeTable,
    interpolate_mode_table,
    locate_in_mode_table,
    power_asymmetry,
)

RAYLEIGH_DEVIATION = math.sqrt(2 - math.pi / 2)
"""Standard deviation of |X| in a noise-only bin, in units of sigma (per quadrature)."""


def threshold_from_tnr(*, tnr: np.ndarray, bin_deviation: np.ndarray) -> np.ndarray:
    """Compute the threshold on |X|: TNR standard deviations of a noise-only bin's magnitude.

    The only reading of [T]'s threshold-to-noise ratio that gives its Table 4.2 (PHYSICS section
    6): a noise-only bin crosses with probability exp(-(4 - pi)/4 TNR^2).
    """
    return tnr * bin_deviation * RAYLEIGH_DEVIATION


def negligible_signal_ratio(
    *, leakage_probability: np.ndarray, threshold_ratio: np.ndarray, n_bins: int
) -> np.ndarray:
    """Return the signal amplitude [sigma] below which bins may count as noise alone, (n,).

    Parameters
    ----------
    leakage_probability
        (n,): probability of leakage that all these bins together may add.
    threshold_ratio
        (n,): threshold b [sigma].
    n_bins
        Number of bins.

    Notes
    -----
    With x = a^2/2 and y = b^2/2 a bin of amplitude a [sigma] adds at most

        x y e^-y / (1 - e^-y) e^(a^2 b^2 / 8)

    to the leakage (:mod:`sweep.model.spectrum.leakage`). The last factor is taken at a b = 1, the
    largest product that is returned.
    """
    y = 0.5 * np.square(threshold_ratio)
    with np.errstate(divide="ignore", over="ignore", under="ignore", invalid="ignore"):
        leakage_per_signal_power = np.where(y > 0, y / np.expm1(y), 1.0)
        return np.minimum(
            np.sqrt(
                2 * leakage_probability / (n_bins * math.exp(1 / 8) * leakage_per_signal_power)
            ),
            1 / threshold_ratio,
        )


class DetectionRule(NamedTuple):
    """Rule by which the bins of an echo detect it; common to all points."""

    any_bin: bool
    """True if any bin of an echo may detect it, False if only its strongest bin."""
    lobe_half_width: int
    """Half-width of a main lobe [bins of fs/N], rounded up; 0 unless ``any_bin``."""
    real_noise_at_ends: bool
    """True if the noise in bins 0 and N/2 is real, as that of a real record is."""
    fft_size: int
    """FFT size N."""
    in_speckle: bool
    """True if echoes are in developed speckle."""
    noise_correlation: float
    """Correlation of the noise of neighbouring bins, 0..1."""
    real_record_in_speckle: bool
    """True if echoes in developed speckle come from a real record. Their amplitudes are then
    noncircular near DC and Nyquist."""
    joint_tail_rule: JointTailRule
    """Quadrature for the joint crossing of neighbouring bins."""
    noise_pseudo_variance_ratio: np.ndarray
    """(bins,): pseudo-variance ratio of the noise, by bins from the nearer of DC and Nyquist; empty
    unless the noise is real there and echoes are in developed speckle."""
    mode_table: ModeTable
    """Speckle modes of an echo; ``NO_MODES`` unless ``any_bin`` and ``in_speckle``."""
    sidelobe_correlation: float = 0.0
    """Correlation of the noise of neighbouring bins in phase with the sidelobes of a line, -1..1.
    Sidelobes change sign from one to the next."""


class EchoBins(NamedTuple):
    """Noiseless magnitudes of a span of bins, and the bins that belong to the echo."""

    magnitude: np.ndarray
    """(bins,): |X| without noise [V, summed over the record]."""
    is_echo: np.ndarray
    """(bins,) bool: True in bins of the echo."""
    first_bin: int
    """Number of the first bin."""


class GivenMode(NamedTuple):
    """Parameters of an echo's bins given the amplitude z of its strongest speckle mode.

    All are over the noise of the bin: that of the receiver plus the other speckle modes.
    """

    signal: np.ndarray
    """(bins,): root mean square magnitude of the mode, over the noise per quadrature."""
    threshold: np.ndarray
    """(bins,): threshold, over the noise per quadrature."""
    correlation: np.ndarray
    """(bins,): correlation of the noise with that of the bin below."""
    pedestal: np.ndarray
    """(bins,): mean power of the phase-noise pedestal that fades with the mode, over the noise."""
    other_echo_fraction: np.ndarray
    """(bins,): part of the noise that is other modes, which turn with the mode's phase near DC and
    Nyquist."""


class Detection(NamedTuple):
    """Probabilities that an echo is detected and that it is missed; each keeps all its digits."""

    pd: float
    """Probability that the echo is detected, 0..1."""
    miss: float
    """Probability that the echo is missed, 1 - pd."""


class PedestalShape(NamedTuple):
    """Shape of the pedestal of phase noise about the lines of an echo.

    Of light that is mixed with itself after a delay tau, whose phase has a line width dnu: with
    Gamma = 2 pi dnu, at a frequency omega from the line

        [1 - e^(-Gamma tau) (cos omega tau + Gamma / omega sin omega tau)] / (1 + omega^2 / Gamma^2)

    over its value under the line [Richter et al., IEEE J. Quantum Electron. 22, 2070, 1986].
    """

    reach_bins: float
    """Bins on either side of lines that the echo has by its pedestal: up to the last in which this
    has at least the power of the noise. 0 where these are no more than it has by its lines."""
    line_width_bins: float
    """Line width dnu of the laser [bins of fs/N]."""
    delay: float
    """Delay tau, or the record's duration if that is shorter [N/fs]."""


NO_PEDESTAL = PedestalShape(0.0, 0.0, 0.0)


class BinThreshold(NamedTuple):
    """Threshold on |X|, and noise per quadrature, in an echo's bins [V, summed over the record]."""

    line_noise: float
    """Noise in bins that the lines fill, with that part of the phase-noise pedestal that changes
    |X|."""
    threshold: float
    noise_without_pedestal: float
    """Noise without the pedestal."""
    side_noise: float
    """Noise in bins beside the lines, with the whole pedestal."""
    pedestal: PedestalShape = NO_PEDESTAL
    """Shape of the pedestal about the lines."""


class BinSpeckle(NamedTuple):
    """Speckle parameters of the bins of one point's segment."""

    line_deviation_bins: float
    """Deviation of the footprint's lines [bins of fs/N]."""
    pseudo_variance_ratio: np.ndarray
    """(bins,): pseudo-variance ratio of the signal, by bins from the nearer of DC and Nyquist;
    empty if the echo lies far from both."""


NO_SPECKLE = BinSpeckle(0.0, np.empty(0))
"""Parameters of echoes that do not fade, or have circular amplitudes in all bins."""


class SpeckleTable(NamedTuple):
    """Speckle parameters of the bins of all points, by segment."""

    line_deviation_bins: np.ndarray
    """(segments, n): :attr:`BinSpeckle.line_deviation_bins`."""
    ratio_row: np.ndarray
    """(segments, n) int64: row of ``pseudo_variance_ratio``; 0 far from DC and Nyquist."""
    pseudo_variance_ratio: np.ndarray
    """(rows, bins)"""
    phase_factors: np.ndarray
    """(rows, angles): ``phase_factors`` of :mod:`sweep.model.detection.pseudo_variance`."""

    def select(self, segment: int, points: np.ndarray) -> "SpeckleTable":
        """Select one segment of some points."""
        line_deviation_bins, ratio_row = (
            values[[segment]][:, points] for values in (self.line_deviation_bins, self.ratio_row)
        )
        return SpeckleTable(
            line_deviation_bins, ratio_row, self.pseudo_variance_ratio, self.phase_factors
        )


@njit(cache=True, error_model="numpy", borrows=True)
def bin_threshold_at(rows, point):
    """Return the :class:`BinThreshold` of point i from an array (7, n)."""
    pedestal = PedestalShape(rows[4, point], rows[5, point], rows[6, point])
    return BinThreshold(rows[0, point], rows[1, point], rows[2, point], rows[3, point], pedestal)


@njit(cache=True, error_model="numpy", borrows=True)
def pedestal_power_ratio(pedestal, distance):
    """Return the pedestal's power ``distance`` bins from its line, over that under the line."""
    gamma, delay = 2.0 * math.pi * pedestal.line_width_bins, pedestal.delay
    coherence, omega = math.exp(-gamma * delay), 2.0 * math.pi * distance
    if not distance > 0.0 or not gamma * delay > 1e-5:
        return 1.0
    ripple = math.cos(omega * delay) + gamma / omega * math.sin(omega * delay)
    under_line = 1.0 - coherence * (1.0 + gamma * delay)
    return (1.0 - coherence * ripple) / (under_line * (1.0 + (omega / gamma) ** 2))


@njit(cache=True, error_model="numpy")
def pedestal_reach_bins(pedestal_to_noise, line_width_bins, delay, reach_max):
    """Distance of the last bin in which a pedestal has at least the power of the noise, (n,).

    ``pedestal_to_noise`` (n,) is the power of the pedestal under the line over that of the noise;
    ``line_width_bins`` and
    ``delay`` (n,) are those of :class:`PedestalShape`. No result exceeds ``reach_max``.
    """
    reaches = np.zeros(pedestal_to_noise.size)
    for i in range(pedestal_to_noise.size):
        gamma = 2.0 * math.pi * line_width_bins[i]
        if not pedestal_to_noise[i] >= 1.0 or not gamma * delay[i] > 1e-5:
            continue
        pedestal = PedestalShape(0.0, line_width_bins[i], delay[i])
        coherence = math.exp(-gamma * delay[i])
        # From omega = Gamma on the ripple is at most sqrt(2).
        ratio_max = (
            pedestal_to_noise[i]
            * (1.0 + 1.5 * coherence)
            / (1.0 - coherence * (1.0 + gamma * delay[i]))
        )
        k = math.ceil(min(line_width_bins[i] * max(math.sqrt(ratio_max), 1.0), float(reach_max)))
        while k > 0 and pedestal_to_noise[i] * pedestal_power_ratio(pedestal, float(k)) < 1.0:
            k -= 1
        reaches[i] = k
    return reaches


@njit(cache=True, error_model="numpy", borrows=True)
def fill_pedestal_ratios(magnitude, is_echo, bin_threshold, pedestal_ratios):
    """Fill ``pedestal_ratios`` with the pedestal's power over the noise's in the bins of an echo.

    Bins of half the largest magnitude hold lines; of the pedestal in others all counts as noise.
    """
    largest, noise_power = (
        0.0,
        bin_threshold.noise_without_pedestal * bin_threshold.noise_without_pedestal,
    )
    for i in range(magnitude.size):
        largest = max(largest, magnitude[i] if is_echo[i] else 0.0)
    ratio_under_lines = bin_threshold.line_noise * bin_threshold.line_noise / noise_power - 1.0
    ratio_beside_lines = bin_threshold.side_noise * bin_threshold.side_noise / noise_power - 1.0
    line_distance = float(magnitude.size)
    for i in range(magnitude.size):
        line_distance = 0.0 if is_echo[i] and magnitude[i] >= 0.5 * largest else line_distance + 1.0
        pedestal_ratios[i] = line_distance
    for i in range(magnitude.size - 1, -1, -1):
        line_distance = min(pedestal_ratios[i], line_distance + 1.0)
        pedestal_ratios[i] = ratio_under_lines
        if line_distance > 0.0:
            pedestal_ratios[i] = ratio_beside_lines
            if bin_threshold.pedestal.reach_bins > 0.0:
                pedestal_ratios[i] *= pedestal_power_ratio(bin_threshold.pedestal, line_distance)


@njit(cache=True, error_model="numpy")
def bin_speckle_at(speckle_table, segment, point):
    """:class:`BinSpeckle` of a point's segment, from a :class:`SpeckleTable`."""
    ratio_row = speckle_table.ratio_row[segment, point]
    n_bins = speckle_table.pseudo_variance_ratio.shape[1] if ratio_row > 0 else 0
    return BinSpeckle(
        speckle_table.line_deviation_bins[segment, point],
        speckle_table.pseudo_variance_ratio[ratio_row, :n_bins],
    )


class SegmentCorrelations(NamedTuple):
    """Complex correlations of an echo's amplitudes between segments in speckle, (n,) each."""

    up_doppler: np.ndarray
    """Between up and Doppler segment, |.| <= 1."""
    up_down: np.ndarray
    """Between up and down segment."""
    doppler_down: np.ndarray
    """Between Doppler and down segment."""

    def cholesky_factors(self) -> np.ndarray:
        """Return the Cholesky factors of the segments' correlation matrix, (6, n).

        The amplitudes are A_up = z_0, A_doppler = m z_0 + sqrt(1 - m^2) z_1 and A_down = o z_0 + c
        z_1 + d z_2, with independent circular z of unit power. Phases that do not change joint
        magnitudes are removed. Rows: m, sqrt(1 - m^2), o, Re c, Im c, d.
        """
        up_doppler, up_down, doppler_down = (
            np.minimum(np.abs(correlation), 1.0) for correlation in self
        )
        turned_doppler_down = doppler_down * np.exp(
            1j * np.angle(self.up_doppler * self.doppler_down * np.conj(self.up_down))
        )
        doppler_own = np.sqrt(1 - up_doppler**2)
        with np.errstate(divide="ignore", invalid="ignore"):
            down_from_doppler = np.where(
                doppler_own > 1e-7, (turned_doppler_down - up_doppler * up_down) / doppler_own, 0.0
            )
        down_own = np.sqrt(np.maximum(1 - up_down**2 - np.abs(down_from_doppler) ** 2, 0.0))
        return np.array(
            [
                up_doppler,
                doppler_own,
                up_down,
                down_from_doppler.real,
                down_from_doppler.imag,
                down_own,
            ]
        )


def joint_pd_in_speckle(
    pd_first: np.ndarray,
    pd_second: np.ndarray,
    threshold_ratio: np.ndarray,
    correlation: np.ndarray,
    n_independent_bins: np.ndarray | float = 1.0,
) -> np.ndarray:
    """Return the probability that two segments in developed speckle are both detected.

    Parameters
    ----------
    pd_first, pd_second
        Probabilities that each segment is detected, (..., n); nan where it does not exist.
    threshold_ratio
        Threshold over the noise per quadrature, (n,).
    correlation
        Magnitude of the correlation of the echoes' amplitudes, (n,).
    n_independent_bins
        Number of independent bins as which each echo counts, :func:`detection_equivalent_bins`.

    Returns
    -------
    numpy.ndarray
        (..., n); nan where either is nan.

    Notes
    -----
    Of one bin these are two correlated Rayleigh magnitudes [Schwartz, Bennett and Stein,
    Communication Systems and Techniques, 1966, appendix A]. A, B are Th^2 over the mean powers, so
    that the segments are detected with e^-A and e^-B. r is the squared correlation of signal and
    noise: ``correlation``^2 times the product of SNR / (1 + SNR). Then both are detected with

        J = e^-A (1 - Q_1(sqrt(2 B / (1-r)), sqrt(2 r A / (1-r))))
            + e^-B Q_1(sqrt(2 r B / (1-r)), sqrt(2 A / (1-r)))

    An echo that any of its bins detects counts as M independent bins, each of which is detected
    with q = 1 - (1 - p)^(1/M) and sees in the other segment the one that matches it. Both are
    missed with (1 - q_1 - q_2 + J(q_1, q_2))^M, so that both are detected with

        p_1 p_2 + (1 - p_1) (1 - p_2) ((1 + (J - q_1 q_2) / ((1 - q_1) (1 - q_2)))^M - 1)
    """
    is_defined, half_square_threshold = (
        np.isfinite(pd_first) & np.isfinite(pd_second),
        0.5 * threshold_ratio**2,
    )
    with np.errstate(divide="ignore"):
        bin_pds = [np.where(is_defined, p, 1.0) for p in (pd_first, pd_second)]
        bin_pds = [
            np.where(n_independent_bins > 1, -np.expm1(np.log1p(-p) / n_independent_bins), p)
            for p in bin_pds
        ]
        a, b = (np.minimum(-np.log(p), 700.0) for p in bin_pds)
    echo_fractions = np.maximum(1 - a / half_square_threshold, 0.0) * np.maximum(
        1 - b / half_square_threshold, 0.0
    )  # SNR / (1 + SNR)
    squared_correlation = np.minimum(correlation**2 * echo_fractions, 1 - 1e-12)
    inverse_remainder = 1 / (1 - squared_correlation)
    p_both = (
        np.exp(-a)
        * marcum_q1(
            np.sqrt(2 * b * inverse_remainder),
            np.sqrt(2 * squared_correlation * a * inverse_remainder),
        ).p
    )
    p_both += (
        np.exp(-b)
        * marcum_q1(
            np.sqrt(2 * squared_correlation * b * inverse_remainder),
            np.sqrt(2 * a * inverse_remainder),
        ).q
    )
    bin_misses = np.maximum((1 - bin_pds[0]) * (1 - bin_pds[1]), 1e-300)
    misses = (1 - pd_first) * (1 - pd_second)
    with np.errstate(over="ignore", invalid="ignore"):
        excess = np.expm1(
            n_independent_bins
            * np.log1p(np.maximum(p_both - bin_pds[0] * bin_pds[1], 0.0) / bin_misses)
        )
        p_both_of_many = pd_first * pd_second + np.where(misses > 0, misses * excess, 0.0)
    p_both = np.where(
        n_independent_bins > 1, np.minimum(p_both_of_many, np.minimum(pd_first, pd_second)), p_both
    )
    return np.where(is_defined, p_both, np.nan)


INDEPENDENT_BINS_MAX = 1e3
"""Largest number of independent bins as which an echo counts."""


def detection_equivalent_bins(
    pd: np.ndarray, peak_ratio: np.ndarray, threshold_ratio: np.ndarray
) -> np.ndarray:
    """Return the number M of independent bins like the strongest that detect as often as an echo.

    Parameters
    ----------
    pd
        Probability that any bin of the echo is detected.
    peak_ratio, threshold_ratio
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
    single_bin_pd = np.exp(-0.5 * np.square(threshold_ratio) / (1 + 0.5 * np.square(peak_ratio)))
    with np.errstate(divide="ignore", invalid="ignore"):
        n_bins = np.log1p(-np.minimum(pd, 1 - 1e-15)) / np.log1p(
            -np.minimum(single_bin_pd, 1 - 1e-15)
        )
    return np.clip(np.nan_to_num(n_bins, nan=1.0), 1.0, INDEPENDENT_BINS_MAX)


def at_least_two_of_three(probabilities: np.ndarray, complements: np.ndarray) -> np.ndarray:
    """Return the probability that at least two of three independent events happen.

    ``probabilities`` and ``complements`` (3, ...) are the events' probabilities and their
    complements, which are passed separately to keep precision in both tails.

    >>> round(float(at_least_two_of_three(np.array([0.9, 0.8, 0.5]), np.array([0.1, 0.2, 0.5]))), 6)
    0.85
    """
    (a, b, c), (no_a, no_b, no_c) = probabilities, complements
    return np.asarray(a * b * c + a * b * no_c + a * no_b * c + no_a * b * c)


@njit(cache=True, error_model="numpy", borrows=True)
def mark_exempt_bins(magnitude, n_bins, threshold, is_exempt, lobe_half_width):
    """Find the strongest bin of a run, and mark the bins that cannot raise a false alarm.

    Adjacent bins at or above the threshold form a group, and its largest bin is the detection.
    Exempt are the bins of each group and the two next to it, and the strongest bin and its
    neighbours, group or not. If any bin of the echo may detect it (``lobe_half_width`` > 0,
    half-width of
    the main lobe), bins within a main lobe of a bin of at least half the largest magnitude are
    exempt as well.

    Parameters
    ----------
    magnitude
        |X|, at least ``n_bins`` bins.
    threshold
        Threshold on |X|.
    is_exempt
        Result, bool: bins that cannot raise a false alarm.
    lobe_half_width
        Half-width of the main lobe [bins], or 0.

    Returns
    -------
    peak, n_exempt
        Index of the largest bin; number of exempt bins.
    """
    largest, n_above = _largest_and_count(magnitude[:n_bins], threshold)
    peak = 0
    while peak < n_bins - 1 and magnitude[peak] < largest:
        peak += 1
    is_exempt[:n_bins] = False
    if lobe_half_width > 0:
        for i in range(n_bins):
            if i == peak or (magnitude[i] >= 0.5 * largest and largest > 0.0):
                is_exempt[max(i - lobe_half_width, 0) : min(i + lobe_half_width + 1, n_bins)] = True
    first, last = peak, peak
    while first > 0 and magnitude[first - 1] >= threshold:
        first -= 1
    while last < n_bins - 1 and magnitude[last + 1] >= threshold:
        last += 1
    n_exempt = _exempt_group(first, last, n_bins, is_exempt)
    if n_above > last - first + 1 or lobe_half_width > 0:
        n_exempt = 0
        for i in range(n_bins):
            if magnitude[i] >= threshold:
                _exempt_group(i, i, n_bins, is_exempt)
        for i in range(n_bins):
            n_exempt += is_exempt[i]
    return peak, n_exempt


@njit(cache=True, error_model="numpy", borrows=True)
def is_real_bin(bin_, real_noise_at_ends, fft_size):
    """Return True if the noise of a bin is real: bins 0 and N/2 of a real record.

    ``real_noise_at_ends`` and ``fft_size`` are those of :class:`DetectionRule`.
    """
    return real_noise_at_ends and (bin_ == 0 or 2 * bin_ == fft_size)


@njit(cache=True, error_model="numpy", borrows=True)
def bin_crossing_tails(signal_ratio, threshold_ratio, is_real):
    """Return both :class:`.Tails` of |X| of a bin with a steady signal at the threshold.

    ``signal_ratio`` a and ``threshold_ratio`` b are over the noise per quadrature sigma. The tails
    are Q_1(a, b) and its complement. If the noise ``is_real``, it has the power of both quadratures
    in one, a variance of 2 sigma^2, and the upper tail is P(|a + n| >= b).
    """
    if not is_real:
        return marcum_q1_tails(signal_ratio, threshold_ratio)
    p_cross = 0.5 * (
        math.erfc(0.5 * (threshold_ratio - signal_ratio))
        + math.erfc(0.5 * (threshold_ratio + signal_ratio))
    )
    if signal_ratio < threshold_ratio:
        p_stay = 0.5 * (
            math.erf(0.5 * (threshold_ratio - signal_ratio))
            + math.erf(0.5 * (threshold_ratio + signal_ratio))
        )
    else:
        p_stay = 0.5 * (
            math.erfc(0.5 * (signal_ratio - threshold_ratio))
            - math.erfc(0.5 * (signal_ratio + threshold_ratio))
        )
    return Tails(p_cross, p_stay)


@njit(cache=True, error_model="numpy", borrows=True)
def pd_and_miss(echo, peak_index, rule, bin_threshold, bin_speckle):
    """Return the probabilities that an echo is detected and that it is missed.

    If ``rule.any_bin``, any bin of the echo detects it (:func:`pd_and_miss_any_bin`), else the
    largest bin of the span alone. The pedestal of phase noise is light of the echo and fades with
    it.

    Parameters
    ----------
    echo
        :class:`EchoBins` of the span.
    peak_index
        Index of the largest bin in the span.
    rule, bin_threshold, bin_speckle
        :class:`DetectionRule`, :class:`BinThreshold` and :class:`BinSpeckle`.

    Returns
    -------
    Detection
    """
    if rule.in_speckle:
        if rule.any_bin:
            return pd_and_miss_in_speckle(echo, rule, bin_threshold, bin_speckle)
        if bin_threshold.line_noise > bin_threshold.noise_without_pedestal:
            return _pd_and_miss_of_peak_on_pedestal(
                echo.magnitude[peak_index],
                echo.first_bin + peak_index,
                rule,
                bin_threshold,
                bin_speckle,
            )
        return _pd_and_miss_of_peak_in_speckle(
            echo.magnitude[peak_index],
            echo.first_bin + peak_index,
            rule,
            bin_threshold,
            bin_speckle,
        )
    if rule.any_bin:
        if bin_threshold.pedestal.reach_bins > 0.0:
            return _pd_and_miss_on_pedestal(echo, rule, bin_threshold)
        return pd_and_miss_any_bin(echo, rule, bin_threshold)
    line_noise = bin_threshold.line_noise
    tails = bin_crossing_tails(
        echo.magnitude[peak_index] / line_noise,
        bin_threshold.threshold / line_noise,
        is_real_bin(echo.first_bin + peak_index, rule.real_noise_at_ends, rule.fft_size),
    )
    return Detection(tails.above, tails.below)


@njit(cache=True, error_model="numpy", borrows=True)
def _pd_and_miss_of_peak_in_speckle(magnitude, bin_, rule, bin_threshold, bin_speckle):
    """Return pd and 1 - pd of a bin in developed speckle, by itself, without a pedestal.

    ``magnitude`` is the root mean square |X| of its signal [V].
    """
    signal_power = magnitude * magnitude
    noise_power = 2.0 * bin_threshold.line_noise * bin_threshold.line_noise
    ratio = 0.0
    if bin_speckle.pseudo_variance_ratio.size > 0:
        nyquist_bin = rule.fft_size // 2
        ratio = signal_power * pseudo_variance_ratio_at(
            bin_, nyquist_bin, bin_speckle.pseudo_variance_ratio
        )
        ratio += noise_power * pseudo_variance_ratio_at(
            bin_, nyquist_bin, rule.noise_pseudo_variance_ratio
        )
        ratio /= signal_power + noise_power
    tails = hoyt_tails(signal_power + noise_power, ratio, bin_threshold.threshold)
    return Detection(tails.above, tails.below)


@njit(cache=True, error_model="numpy")
def _pd_and_miss_of_peak_on_pedestal(magnitude, bin_, rule, bin_threshold, bin_speckle):
    """Return pd and 1 - pd of a bin in developed speckle, by itself, whose pedestal fades too."""
    noise = bin_threshold.noise_without_pedestal
    rows = np.zeros((5, 1))
    given_mode = GivenMode(rows[0], rows[1], rows[2], rows[3], rows[4])
    given_mode.signal[0] = magnitude / noise
    given_mode.threshold[0] = bin_threshold.threshold / noise
    given_mode.pedestal[0] = (bin_threshold.line_noise / noise) ** 2 - 1.0
    echo = EchoBins(np.full(1, magnitude), np.ones(1, np.bool_), bin_)
    return _mean_over_mode_phase(given_mode, echo, rule, bin_speckle)


@njit(cache=True, error_model="numpy", borrows=True)
def pd_and_miss_any_bin(echo, rule, bin_threshold):
    """Return the probabilities that any bin of an echo reaches the threshold, and that none does.

    Each bin by itself crosses with :func:`bin_crossing_tails`. The noise of neighbours is
    correlated, in phase with a signal that is in step from bin to bin, as in a main lobe. The joint
    probability of two neighbours is that of correlated normal numbers with the same probabilities:
    their product plus

        1 / (2 pi) int_0^{asin rho} exp(-(s^2 + t^2 - 2 s t sin u) / (2 cos^2 u)) du

    [Owen, Ann. Math. Statist. 27, 1956], with the normal deviates s and t, by the quadrature
    ``rule.joint_tail_rule`` (:class:`sweep.model.detection.joint_tail.JointTailRule`). Bins are
    treated as a first-order Markov chain.
    """
    magnitude, is_echo = echo.magnitude, echo.is_echo
    pd, miss, previous_p_stay, previous_deviate, largest = 0.0, 1.0, -1.0, 0.0, 0.0
    threshold = bin_threshold.threshold
    for i in range(magnitude.size):
        largest = max(largest, magnitude[i] if is_echo[i] else 0.0)
    for i in range(magnitude.size):
        if not is_echo[i]:
            previous_p_stay = -1.0
            continue
        noise = (
            bin_threshold.line_noise if magnitude[i] >= 0.5 * largest else bin_threshold.side_noise
        )
        is_real = is_real_bin(echo.first_bin + i, rule.real_noise_at_ends, rule.fft_size)
        tails = bin_crossing_tails(magnitude[i] / noise, threshold / noise, is_real)
        if not tails.below > 0.0:
            return Detection(1.0, 0.0)
        given_neighbour, deviate = _crossing_given_neighbour_below(
            tails, previous_p_stay, previous_deviate, rule.joint_tail_rule
        )
        pd += miss * given_neighbour.above
        miss *= given_neighbour.below
        previous_p_stay, previous_deviate = tails.below, deviate
    return Detection(pd if pd < 0.5 else 1.0 - miss, miss)


@njit(cache=True, error_model="numpy")
def _pd_and_miss_on_pedestal(echo, rule, bin_threshold):
    """Compute :func:`pd_and_miss_any_bin` for an echo whose pedestal detects too."""
    n_bins = echo.magnitude.size
    pedestal_ratios, rows = np.empty(n_bins), np.zeros((5, n_bins))
    given_mode = GivenMode(rows[0], rows[1], rows[2], rows[3], rows[4])
    fill_pedestal_ratios(echo.magnitude, echo.is_echo, bin_threshold, pedestal_ratios)
    for k in range(n_bins):
        noise = bin_threshold.noise_without_pedestal * math.sqrt(1.0 + pedestal_ratios[k])
        given_mode.signal[k] = echo.magnitude[k] / noise
        given_mode.threshold[k] = bin_threshold.threshold / noise
        given_mode.correlation[k] = rule.noise_correlation
    return _pd_and_miss_given_mode(
        given_mode, 1.0, echo, rule.real_noise_at_ends, rule.fft_size, np.inf, 0.0
    )


@njit(cache=True, error_model="numpy", borrows=True)
def _crossing_given_neighbour_below(tails, previous_p_stay, previous_deviate, joint_tail_rule):
    """Return the :class:`.Tails` of a bin if the bin below it does not cross.

    ``tails`` are those of the bin by itself. ``previous_p_stay`` is the probability that the bin
    below does not cross, ``previous_deviate`` its normal deviate; the probability is below 0 if no
    bin of the echo lies below. The second result is the normal deviate of this bin.
    """
    deviate = _normal_deviate_of_tails(tails)
    if not previous_p_stay > 0.0:
        return tails, deviate
    p_joint = joint_tail_excess(deviate, previous_deviate, joint_tail_rule)
    p_joint = min(p_joint / previous_p_stay, tails.above)
    return Tails(tails.above - p_joint, tails.below + p_joint), deviate


@njit(cache=True, error_model="numpy", borrows=True)
def any_crossing_of_chain(probabilities, n_bins, joint_tail_rule):
    """Return the probability that any of ``n_bins`` adjacent bins crosses, given each bin's own.

    Neighbours are correlated as in :func:`pd_and_miss_any_bin`; bins that cross with less than 1e-4
    count as independent.
    """
    p_any, p_none, previous_p_stay, previous_deviate = 0.0, 1.0, -1.0, 0.0
    for i in range(n_bins):
        p_cross = min(max(probabilities[i], 0.0), 1.0)
        p_stay = 1.0 - p_cross
        if not p_stay > 0.0:
            return 1.0
        if p_cross < 1e-4:
            p_any, p_none, previous_p_stay = p_any + p_none * p_cross, p_none * p_stay, -1.0
            continue
        given_neighbour, deviate = _crossing_given_neighbour_below(
            Tails(p_cross, p_stay), previous_p_stay, previous_deviate, joint_tail_rule
        )
        p_any += p_none * given_neighbour.above
        p_none *= given_neighbour.below
        previous_p_stay, previous_deviate = p_stay, deviate
    return p_any


@njit(cache=True, error_model="numpy", borrows=True)
def clear_image_exemptions(magnitude, is_exempt, first_bin, fft_size, image_gain):
    """Clear the exemption of bins dominated by an I/Q image; return the number still exempt.

    The image of ``image_gain`` times the line's |X| stands at the opposite frequency. It dominates
    a bin
    where it makes at least half of |X|. ``first_bin`` is the number of the first bin, ``fft_size``
    the FFT size N.
    """
    n_exempt = 0
    for k in range(magnitude.size):
        image_index = (-2 * first_bin - k) % fft_size
        if is_exempt[k] and image_index < magnitude.size:
            line_magnitude = magnitude[image_index]
            if line_magnitude > magnitude[k] and image_gain * line_magnitude >= 0.5 * magnitude[k]:
                is_exempt[k] = False
        n_exempt += is_exempt[k]
    return n_exempt


@njit(cache=True, error_model="numpy", borrows=True)
def pd_and_miss_in_speckle(echo, rule, bin_threshold, bin_speckle):
    """Return the probabilities that any, and that no, bin of an echo in developed speckle crosses.

    The strongest speckle mode (:mod:`sweep.model.detection.speckle_modes`) is one complex Gaussian
    number z for all bins. Given z, bin k has the steady signal u_k z. The other modes add to its
    noise, with their own variance and correlation. The result is the mean over |z|^2, which is
    exponential. A single line has all its power in this mode, and its sidelobes fade with it. Near
    DC and Nyquist the mode's power depends on the phase of z as 1 + q_k cos t, with the
    pseudo-variance ratio q_k of bin k and t uniform (:mod:`sweep.model.detection.pseudo_variance`).

    Stretches of bins of half the largest magnitude are echoes by themselves; weaker stretches
    belong to the one below. Errors: docs/physics.md.
    """
    magnitude, is_echo = echo.magnitude, echo.is_echo
    largest = 0.0
    for i in range(magnitude.size):
        largest = max(largest, magnitude[i] if is_echo[i] else 0.0)
    pd, miss, stretch_begin, i, n_stretches = 0.0, 1.0, 0, 0, 0
    while i < magnitude.size:
        echo_begin, has_strong_bin = i, False
        while i < magnitude.size and is_echo[i]:
            has_strong_bin |= magnitude[i] >= 0.5 * largest
            i += 1
        if has_strong_bin:
            if n_stretches > 0:
                stretch = _pd_and_miss_of_stretch(
                    echo, stretch_begin, echo_begin, rule, bin_threshold, bin_speckle
                )
                pd, miss, stretch_begin = (
                    pd + miss * stretch.pd,
                    miss * stretch.miss,
                    echo_begin,
                )
            n_stretches += 1
        i += 1
    stretch = _pd_and_miss_of_stretch(
        echo, stretch_begin, magnitude.size, rule, bin_threshold, bin_speckle
    )
    return Detection(pd + miss * stretch.pd, miss * stretch.miss)


_GAUSS_ORDER = 7
_THRESHOLD_REACH_SIGMA = 4.5
_MODE_MAGNITUDE_MAX = 6.0
_RARE_CROSSING_MAX = 1e-6
_NEGLIGIBLE_PROBABILITY, _NEGLIGIBLE_FRACTION = 1e-8, 1e-6
"""Probability, and part of pd and of 1 - pd, below which what a bin adds may be left out."""
_GAUSS_NODES, _GAUSS_WEIGHTS = np.polynomial.legendre.leggauss(_GAUSS_ORDER)


@njit(cache=True, error_model="numpy")
def _pd_and_miss_of_stretch(echo, begin, end, rule, bin_threshold, bin_speckle):
    """Return pd and 1 - pd of one stretch of :func:`pd_and_miss_in_speckle`.

    It is the bins of the indices begin .. end - 1 of the span ``echo``.
    """
    magnitude, is_echo = echo.magnitude, echo.is_echo
    nyquist_bin = rule.fft_size // 2 if rule.real_record_in_speckle else 0
    while begin < end - 1 and not is_echo[begin]:
        begin += 1
    while end > begin + 1 and not is_echo[end - 1]:
        end -= 1
    strongest = begin
    for i in range(begin, end):
        if is_echo[i] and not (is_echo[strongest] and magnitude[i] <= magnitude[strongest]):
            strongest = i
    below = magnitude[strongest - 1] if strongest > 0 else 0.0
    above = magnitude[strongest + 1] if strongest + 1 < magnitude.size else 0.0
    if rule.real_record_in_speckle and (
        echo.first_bin + strongest == 0 or echo.first_bin + strongest == nyquist_bin
    ):
        below = above = max(below, above)  # bins mirror there
    asymmetry = power_asymmetry(below, magnitude[strongest], above)
    cell, mode_table = (
        locate_in_mode_table(rule.mode_table, bin_speckle.line_deviation_bins, asymmetry),
        rule.mode_table,
    )
    noise_power = 2.0 * bin_threshold.noise_without_pedestal * bin_threshold.noise_without_pedestal
    n_bins = end - begin
    stretch = EchoBins(magnitude[begin:end], is_echo[begin:end], echo.first_bin + begin)
    rows, pedestal_ratios = np.empty((5, n_bins)), np.empty(n_bins)
    given_mode = GivenMode(rows[0], rows[1], rows[2], rows[3], rows[4])
    previous_fraction, previous_inverse_noise = 0.0, 0.0
    fill_pedestal_ratios(stretch.magnitude, stretch.is_echo, bin_threshold, pedestal_ratios)
    for k in range(n_bins):
        i = begin + k
        signal_power, pedestal_power = magnitude[i] * magnitude[i], noise_power * pedestal_ratios[k]
        # A pedestal has the light of all lines, as the bins amid them.
        is_near = (
            abs(i - strongest) <= rule.lobe_half_width
            or not bin_threshold.pedestal.reach_bins > 0.0
        )
        mode_fraction = interpolate_mode_table(
            mode_table.power_fraction, cell, i - strongest if is_near else 0
        )
        other_power = (1.0 - mode_fraction) * (signal_power + pedestal_power) + noise_power
        inverse_noise = math.sqrt(2.0 / other_power)
        given_mode.pedestal[k] = mode_fraction * pedestal_power / other_power
        given_mode.signal[k] = inverse_noise * math.sqrt(mode_fraction * signal_power)
        given_mode.threshold[k] = inverse_noise * bin_threshold.threshold
        given_mode.correlation[k] = 0.0
        if k > 0 and is_echo[i] and is_echo[i - 1]:
            neighbour_correlation = interpolate_mode_table(
                mode_table.neighbour_correlation, cell, i - strongest
            )
            noise_covariance = (
                (abs(neighbour_correlation) - math.sqrt(mode_fraction * previous_fraction))
                * magnitude[i]
                * magnitude[i - 1]
            )
            noise_covariance += noise_power * math.copysign(
                rule.noise_correlation, neighbour_correlation
            )
            given_mode.correlation[k] = min(
                max(0.5 * noise_covariance * inverse_noise * previous_inverse_noise, -0.999), 0.999
            )
        previous_fraction, previous_inverse_noise = mode_fraction, inverse_noise
        # The other modes turn with the phase too, except in the bins 0 and N/2 themselves.
        bin_, other_modes_power = stretch.first_bin + k, (1.0 - mode_fraction) * magnitude[i] ** 2
        given_mode.other_echo_fraction[k] = 0.0
        if bin_ != 0 and bin_ != nyquist_bin:
            given_mode.other_echo_fraction[k] = other_modes_power / (
                other_modes_power + noise_power
            )
    return _mean_over_mode_phase(given_mode, stretch, rule, bin_speckle)


@njit(cache=True, error_model="numpy", borrows=True)
def _mean_over_mode_phase(given_mode, echo, rule, bin_speckle):
    """Average :func:`_mean_over_mode_power` over the phase of the mode if bins are noncircular."""
    if bin_speckle.pseudo_variance_ratio.size == 0:
        return _mean_over_mode_power(given_mode, echo, rule.real_noise_at_ends, rule.fft_size)
    return _mean_over_noncircular_mode_phase(given_mode, echo, rule, bin_speckle)


@njit(cache=True, error_model="numpy")
def _mean_over_noncircular_mode_phase(given_mode, echo, rule, bin_speckle):
    """Average :func:`_mean_over_mode_power` over the phase t of the mode, for noncircular bins.

    At a phase the mode's power in a bin changes by the factor 1 + q cos t, with the pseudo-variance
    ratio q of the bin. So does the power of the other modes.
    """
    pd, miss, n_bins = 0.0, 0.0, echo.is_echo.size
    rows = np.empty((3, n_bins))
    given_phase = GivenMode(
        rows[0], rows[1], given_mode.correlation, rows[2], given_mode.other_echo_fraction
    )
    for node in range(N_PHASE_NODES):
        for k in range(n_bins):
            ratio = pseudo_variance_ratio_at(
                echo.first_bin + k, rule.fft_size // 2, bin_speckle.pseudo_variance_ratio
            )
            power_factor = max(1.0 + ratio * PHASE_COSINES[node], 0.0)
            inverse_noise = 1.0 / math.sqrt(
                1.0 + (power_factor - 1.0) * given_mode.other_echo_fraction[k]
            )
            given_phase.signal[k] = given_mode.signal[k] * math.sqrt(power_factor) * inverse_noise
            given_phase.threshold[k] = given_mode.threshold[k] * inverse_noise
            given_phase.pedestal[k] = (
                given_mode.pedestal[k] * power_factor * inverse_noise * inverse_noise
            )
        at_phase = _mean_over_mode_power(given_phase, echo, rule.real_noise_at_ends, rule.fft_size)
        pd, miss = pd + at_phase.pd / N_PHASE_NODES, miss + at_phase.miss / N_PHASE_NODES
    return Detection(pd, miss)


@njit(cache=True, error_model="numpy", borrows=True)
def _mean_over_mode_power(given_mode, echo, real_noise_at_ends, fft_size):
    """Return the probabilities that any, and that no, bin crosses, averaged over the mode's power.

    Given z the signal of a bin is |z| times ``given_mode.signal``, a :class:`GivenMode`. The
    average is over |z| with the density 2 z e^(-z^2). ``real_noise_at_ends`` and ``fft_size`` are
    those of :class:`DetectionRule`.
    """
    is_echo = echo.is_echo
    z_first, z_last, z_middle, pedestal_ratio_max, strongest_index = (
        _MODE_MAGNITUDE_MAX,
        _MODE_MAGNITUDE_MAX,
        _MODE_MAGNITUDE_MAX,
        0.0,
        -1,
    )
    for k in range(is_echo.size):
        pedestal_ratio_max = max(pedestal_ratio_max, given_mode.pedestal[k])
        if is_echo[k] and given_mode.signal[k] > 0.0:
            pedestal_reach = _THRESHOLD_REACH_SIGMA * math.sqrt(given_mode.pedestal[k])
            if given_mode.threshold[k] < z_middle * given_mode.signal[k]:
                z_middle, strongest_index = given_mode.threshold[k] / given_mode.signal[k], k
            z_first = min(
                z_first,
                max(given_mode.threshold[k] - _THRESHOLD_REACH_SIGMA, 0.0)
                / (given_mode.signal[k] + pedestal_reach),
            )
            if given_mode.signal[k] > pedestal_reach:
                z_last = min(
                    z_last,
                    (given_mode.threshold[k] + _THRESHOLD_REACH_SIGMA)
                    / (given_mode.signal[k] - pedestal_reach),
                )
    z_last = min(z_last, math.sqrt(z_middle * z_middle + 10.0))  # what is beyond is 5e-5 of it all
    interval_ends = (z_first, z_last, z_last)
    if pedestal_ratio_max > 0.0:
        # Where a pedestal fades they rise about the middle, or slowly all the way.
        z_last = max(z_first, min(z_last, 4.5))  # what is beyond is 2e-9
        z_between = z_middle if z_first < z_middle < z_last else 0.5 * (z_first + z_last)
        interval_ends = (z_first, z_between, z_last)
    is_real = is_real_bin(echo.first_bin + strongest_index, real_noise_at_ends, fft_size)
    # From the largest |z| on, so that bins that add nothing to what there is can be left out.
    pd, miss, p_below_first = math.exp(-z_last * z_last), 0.0, -math.expm1(-z_first * z_first)
    for interval in range(1, -1, -1):
        half_width = 0.5 * (interval_ends[interval + 1] - interval_ends[interval])
        for j in range(_GAUSS_ORDER - 1 if half_width > 0.0 else -1, -1, -1):
            z = interval_ends[interval] + half_width * (_GAUSS_NODES[j] + 1.0)
            weight = half_width * _GAUSS_WEIGHTS[j] * 2.0 * z * math.exp(-z * z)
            negligible_probability = (
                min(_NEGLIGIBLE_PROBABILITY, _NEGLIGIBLE_FRACTION * min(pd, miss + p_below_first))
                / weight
            )
            squared_reach = (
                math.inf
                if pedestal_ratio_max > 0.0
                else _squared_reach_given_mode(
                    z, given_mode, strongest_index, is_real, negligible_probability
                )
            )
            at_z = _pd_and_miss_given_mode(
                given_mode,
                z,
                echo,
                real_noise_at_ends,
                fft_size,
                squared_reach,
                negligible_probability,
            )
            pd, miss = pd + weight * at_z.pd, miss + weight * at_z.miss
    if z_first > 0.0:
        negligible_probability = (
            min(_NEGLIGIBLE_PROBABILITY, _NEGLIGIBLE_FRACTION * min(pd, p_below_first))
            / p_below_first
        )
        squared_reach = (
            math.inf
            if pedestal_ratio_max > 0.0
            else _squared_reach_given_mode(
                0.6 * z_first, given_mode, strongest_index, is_real, negligible_probability
            )
        )
        at_z = _pd_and_miss_given_mode(
            given_mode,
            0.6 * z_first,
            echo,
            real_noise_at_ends,
            fft_size,
            squared_reach,
            negligible_probability,
        )
        pd, miss = pd + p_below_first * at_z.pd, miss + p_below_first * at_z.miss
    total = pd + miss  # 1 but for the quadrature
    return Detection(pd / total, miss / total)


@njit(cache=True, error_model="numpy", borrows=True)
def _squared_reach_given_mode(z, given_mode, strongest_index, is_real, negligible_probability):
    """Return the squared distance below the threshold from which on bins do not count, given z.

    A bin adds at most e^(-(b - a)^2 / 2) to what the strongest one leaves, which is missed with
    less than e^(-(a - b)^2 / 2), or the root of it where noise is real. Bins that add less than
    ``negligible_probability`` do not count.
    """
    if not negligible_probability > 0.0 or strongest_index < 0:
        return math.inf
    excess_ratio = max(
        given_mode.signal[strongest_index] * z - given_mode.threshold[strongest_index], 0.0
    )
    return -2.0 * math.log(negligible_probability) - excess_ratio * excess_ratio * (
        0.5 if is_real else 1.0
    )


@njit(cache=True, error_model="numpy", borrows=True)
def _pd_and_miss_given_mode(
    given_mode, z, echo, real_noise_at_ends, fft_size, squared_reach, negligible_probability
):
    """Return the probabilities that any, and that no, bin crosses, given the mode's magnitude z.

    As :func:`pd_and_miss_any_bin`, with a noise correlation r of each pair of neighbours. Their
    powers then have the correlation

        (r^2 + r a b) / sqrt((1 + a^2) (1 + b^2)),

    with their signals a and b over the noise: r^2 for noise alone, r for strong signals.

    Bins that are further below the threshold than the root of ``squared_reach`` are left out. Bins
    that add less than ``negligible_probability`` to the probability count as independent of their
    neighbours.
    """
    is_echo = echo.is_echo
    pd, miss, previous_p_stay, previous_deviate, previous_signal = 0.0, 1.0, -1.0, 0.0, 0.0
    for k in range(is_echo.size):
        if not is_echo[k]:
            previous_p_stay = -1.0
            continue
        scale = 1.0 / math.sqrt(1.0 + given_mode.pedestal[k] * z * z)
        signal = given_mode.signal[k] * z * scale
        distance_below = given_mode.threshold[k] * scale - signal
        is_real = is_real_bin(echo.first_bin + k, real_noise_at_ends, fft_size)
        if distance_below > 0.0 and distance_below * distance_below > (
            2.0 * squared_reach if is_real else squared_reach
        ):
            previous_p_stay = -1.0
            continue
        tails = bin_crossing_tails(signal, given_mode.threshold[k] * scale, is_real)
        p_cross, p_stay = tails.above, tails.below
        if not p_stay > 0.0:
            return Detection(1.0, 0.0)
        if (
            p_cross < _RARE_CROSSING_MAX or miss * p_cross < negligible_probability
        ):  # so is that both of a pair cross
            pd, miss, previous_p_stay = pd + miss * p_cross, miss * p_stay, -1.0
            continue
        deviate = _normal_deviate_of_tails(tails)
        conditional_cross, conditional_stay = p_cross, p_stay
        correlation = given_mode.correlation[k]
        if previous_p_stay > 0.0 and correlation != 0.0:
            correlation = (
                correlation * correlation + correlation * signal * previous_signal
            ) / math.sqrt((1.0 + signal * signal) * (1.0 + previous_signal * previous_signal))
            p_joint = joint_tail_excess_at(deviate, previous_deviate, correlation)
            p_joint = max(min(p_joint / previous_p_stay, p_cross), -p_stay)
            conditional_cross, conditional_stay = p_cross - p_joint, p_stay + p_joint
        pd += miss * conditional_cross
        miss *= conditional_stay
        previous_p_stay, previous_deviate, previous_signal = p_stay, deviate, signal
    return Detection(pd if pd < 0.5 else 1.0 - miss, miss)


@njit(cache=True, error_model="numpy", borrows=True)
def _normal_deviate_of_tails(tails):
    """Return the normal deviate that a standard normal number exceeds with ``tails.above``."""
    if tails.above < tails.below:
        return _normal_deviate(tails.above)
    return -_normal_deviate(tails.below)


@njit(cache=True, error_model="numpy", borrows=True)
def _normal_deviate(probability):
    """Return the normal deviate exceeded with probability ``probability`` <= 1/2, to about 1e-4."""
    if probability < 1e-300:
        return 37.0
    s = math.sqrt(-2.0 * math.log(probability))
    t = s - (2.30753 + 0.27061 * s) / (1.0 + s * (0.99229 + 0.04481 * s))
    tail = 0.5 * math.erfc(t * math.sqrt(0.5))
    slope = math.exp(-0.5 * t * t) / math.sqrt(2.0 * math.pi)
    return t + math.log(tail / probability) * tail / slope


@njit(cache=True, error_model="numpy", borrows=True)
def echo_bounds(magnitude, first, last, threshold, lobe_half_width):
    """Return the first and last bin of the echo around a group of bins first .. last.

    The echo has the adjacent bins of at least half the group's largest magnitude, and a main lobe's
    half-width ``lobe_half_width`` on either side, up to the next group. With ``lobe_half_width`` 0
    it is the group.
    """
    if lobe_half_width == 0:
        return first, last
    largest = magnitude[first]
    for k in range(first + 1, last + 1):
        largest = max(largest, magnitude[k])
    magnitude_min = 0.5 * largest
    while first > 0 and magnitude_min <= magnitude[first - 1] < threshold:
        first -= 1
    while last < magnitude.size - 1 and magnitude_min <= magnitude[last + 1] < threshold:
        last += 1
    for _ in range(lobe_half_width):
        first -= 1 if first > 0 and magnitude[first - 1] < threshold else 0
        last += 1 if last < magnitude.size - 1 and magnitude[last + 1] < threshold else 0
    return first, last


@njit(cache=True, error_model="numpy", borrows=True)
def _largest_and_count(magnitude, threshold):
    """Return the largest magnitude, and the number of bins at or above a level."""
    largest, n_above = magnitude[0], 0
    for i in range(magnitude.size):
        largest = magnitude[i] if magnitude[i] > largest else largest
        n_above += magnitude[i] >= threshold
    return largest, n_above


@njit(cache=True, error_model="numpy", borrows=True)
def _exempt_group(first, last, n_bins, is_exempt):
    """Mark the bins first .. last and their two neighbours as exempt; return their number."""
    first, last = max(first - 1, 0), min(last + 1, n_bins - 1)
    is_exempt[first : last + 1] = True
    return last - first + 1


@njit(cache=True, error_model="numpy")
def detect_in_spectra(
    magnitude, first_bins, nyquist_bin_and_width, rule, threshold_rows, speckle_table, results
):
    """Detect in runs of noiseless spectra, one per point.

    Its rows are those of :data:`sweep.model.spectrum.segment_spectra.SEGMENT_FIELDS`; no leakage.
    ``nyquist_bin_and_width`` are the
    last bin of the spectrum and the bin width [Hz]; bins outside 0..N/2 are passed over.
    ``threshold_rows`` (7, m) are those of :class:`BinThreshold`; ``speckle_table`` is a
    :class:`SpeckleTable`, (1, m).
    """
    nyquist_bin, bin_width = nyquist_bin_and_width
    is_exempt = np.empty(magnitude.shape[1], np.bool_)
    for i in range(magnitude.shape[0]):
        low = max(-first_bins[i], 0)
        high = min(nyquist_bin + 1 - first_bins[i], magnitude.shape[1])
        searched = magnitude[i, low:high]
        lobe_half_width = max(rule.lobe_half_width, int(threshold_rows[4, i]))
        peak, n_exempt = mark_exempt_bins(
            searched, searched.size, threshold_rows[1, i], is_exempt, lobe_half_width
        )
        detection = pd_and_miss(
            EchoBins(searched, is_exempt[: searched.size], first_bins[i] + low),
            peak,
            rule,
            bin_threshold_at(threshold_rows, i),
            bin_speckle_at(speckle_table, 0, i),
        )
        results[0, i], results[1, i], results[2, i] = (
            detection.pd,
            detection.miss,
            searched[peak],
        )
        results[3, i] = (first_bins[i] + low + peak) * bin_width
        results[4, i], results[5, i] = n_exempt, 0.0
