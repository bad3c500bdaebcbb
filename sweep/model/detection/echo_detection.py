"""Detection of an echo in the spectrum of one segment, and bins exempt from false alarms.

:func:`pd_and_miss` gives the probability of detection of an echo in a single record. It takes the
noiseless |X| of the echo's bins, the detection rule and the threshold. The laws of several looks
(records of each segment) and of whole shots are listed in
:mod:`sweep.model.detection.detection_probability`.
"""

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
    JointTailQuadrature,
    joint_tail_excess,
    joint_tail_excess_by_four_nodes,
)
from sweep.model.detection.marcum import Tails, marcum_q1, marcum_q1_tails
from sweep.model.detection.speckle_modes import (
    ModeTable,
    interpolate_mode_table,
    locate_in_mode_table,
    power_asymmetry,
)
from sweep.model.kernel_integers import INTEGER_ONE, INTEGER_ZERO, NO_INDEX

RAYLEIGH_DEVIATION = math.sqrt(2 - math.pi / 2)
"""Standard deviation of |X| in a bin of noise alone, in units of the noise deviation per
quadrature."""


def threshold_from_tnr(*, tnr: np.ndarray, bin_deviation: np.ndarray) -> np.ndarray:
    """Compute the threshold on |X| from the threshold-to-noise ratio.

    Parameters
    ----------
    tnr
        Threshold over the standard deviation of |X| in a bin of noise alone.
    bin_deviation
        Standard deviation sigma of the bin's noise per quadrature [V].

    Returns
    -------
    numpy.ndarray
        Threshold [V], of the broadcast shape.

    Notes
    -----
    A bin of noise alone crosses with the probability exp(-(4 - pi)/4 ``tnr``^2). No other
    definition of the threshold-to-noise ratio of [T] gives its Table 4.2 (PHYSICS section 6).
    """
    return tnr * bin_deviation * RAYLEIGH_DEVIATION


def negligible_signal_ratio(
    *, leakage_probability: np.ndarray, threshold_ratio: np.ndarray, n_bins: int
) -> np.ndarray:
    """Return the signal amplitude [sigma] below which bins may count as noise alone, (n,).

    Parameters
    ----------
    leakage_probability
        (n,): tolerated error of the probability of a false peak due to leaked signal, summed over
        all bins that count as noise alone.
    threshold_ratio
        (n,): threshold b [sigma].
    n_bins
        Number of bins of the spectrum.

    Returns
    -------
    numpy.ndarray
        (n,): amplitude over sigma, the noise per quadrature.

    Notes
    -----
    Let a bin have the amplitude a [sigma], with x = a^2/2 and y = b^2/2. It adds at most

        x y e^-y / (1 - e^-y) e^(a^2 b^2 / 8)

    to the probability of a false peak due to leaked signal (:mod:`sweep.model.spectrum.leakage`).
    The last factor is set to its value at a b = 1, and no amplitude above 1/b is returned.
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
    """Rule of detection from the bins of an echo in one record; common to all points."""

    detects_by_any_bin: bool
    """True if an echo is detected once any of its bins crosses the threshold; False if only its
    strongest bin counts."""
    lobe_half_width: int
    """Half-width of the window's main lobe [FFT bins], rounded up. 0 unless
    ``detects_by_any_bin`` is true."""
    has_real_noise_at_ends: bool
    """True if the noise in bins 0 and N/2 is real, as in a real record."""
    fft_size: int
    """FFT size N, including zero padding."""
    in_speckle: bool
    """True if echoes are in developed speckle."""
    neighbour_noise_correlation: float
    """Modulus of the correlation of the noise of neighbouring bins, 0..1."""
    is_real_record_in_speckle: bool
    """True for echoes in developed speckle in a real record. Near DC and Nyquist the quadratures of
    their amplitudes have unequal variances."""
    neighbour_crossing_quadrature: JointTailQuadrature
    """Quadrature for the probability that two neighbouring bins both cross the threshold."""
    noise_pseudo_variance_ratio: np.ndarray
    """(bins,): ratio E[n^2] / E[|n|^2] of the noise n, 0 if circular, by distance [bins] from the
    nearer of DC and Nyquist. Empty unless ``has_real_noise_at_ends`` and ``in_speckle``."""
    mode_table: ModeTable
    """Table of the strongest speckle mode, the part of an echo that fades with one amplitude in all
    its bins. ``NO_MODES`` unless ``detects_by_any_bin`` and ``in_speckle``."""
    sidelobe_neighbour_noise_correlation: float = 0.0
    """Correlation, -1..1, of two neighbouring bins' noise components in phase with a line's
    sidelobes. Sidelobes alternate in sign from bin to bin."""


class EchoBins(NamedTuple):
    """|X| without noise in adjacent bins, and the bins that belong to the echo."""

    magnitude: np.ndarray
    """(bins,): |X| without noise [V, summed over the record]."""
    is_echo: np.ndarray
    """(bins,) bool: True in bins of the echo."""
    first_bin: int
    """Bin number in the spectrum of the first element of the arrays."""


class EchoSpans(NamedTuple):
    """|X| without noise in the bins around echoes, one span for each segment of m points.

    A span is a range of adjacent bins around an echo.
    """

    first_bin: np.ndarray
    """(segments, m) int64: bin number in the spectrum of the span's first bin."""
    n_bins: np.ndarray
    """(segments, m) int64: number of bins of the span; 0 if it is empty."""
    peak_index: np.ndarray
    """(segments, m) int64: index of the echo's strongest bin, counted from the span's first bin."""
    span_start: np.ndarray
    """(segments, m) int64: index of the span's first bin in ``magnitudes`` and ``is_exempt``."""
    magnitudes: np.ndarray
    """(bins,): |X| of all spans, one after the other [V, summed over the record]."""
    is_exempt: np.ndarray
    """(bins,) bool: True in bins that belong to an echo, and so can raise no false alarm."""


class BinsGivenMode(NamedTuple):
    """Parameters of an echo's bins, given the amplitude of the echo's strongest speckle mode.

    A speckle mode is a part of the echo that fades with one amplitude in all bins. The noise of a
    bin here is the receiver noise plus all speckle modes but the strongest.
    """

    signal_ratio: np.ndarray
    """(bins,): root mean square |X| of the strongest speckle mode over the noise per quadrature."""
    threshold_ratio: np.ndarray
    """(bins,): threshold on |X| over the noise per quadrature."""
    neighbour_noise_correlation: np.ndarray
    """(bins,): correlation of the bin's noise with the noise of the bin below it, -1..1."""
    pedestal_power_ratio: np.ndarray
    """(bins,): mean power of the laser's phase-noise pedestal over the noise power. Only the part
    that fades with the strongest speckle mode counts."""
    other_modes_noise_fraction: np.ndarray
    """(bins,): fraction, 0..1, of the noise power that is due to all speckle modes but the
    strongest. Near DC and Nyquist this part of the noise changes with the phase of the strongest
    mode."""


class PdAndMiss(NamedTuple):
    """Probabilities that an echo is detected and that it is missed.

    Both are computed separately to keep precision in both tails.
    """

    pd: float
    """Probability that the echo is detected, 0..1."""
    miss: float
    """Probability that the echo is missed, 1 - pd."""


class PedestalShape(NamedTuple):
    """Spectral shape of the pedestal that laser phase noise leaves about the lines of an echo.

    Notes
    -----
    Light of the line width dnu (FWHM) is mixed with itself after a delay tau. Let Gamma be 2 pi
    dnu. The power density at the angular frequency omega from the line is proportional to [1]_

        [1 - e^(-Gamma tau) (cos omega tau + Gamma / omega sin omega tau)] / (1 + omega^2 / Gamma^2)

    References
    ----------
    .. [1] L. E. Richter et al., "Linewidth determination from self-heterodyne measurements with
       subcoherence delay times," IEEE J. Quantum Electron. 22, 2070, 1986.
    """

    reach_bins: float
    """Distance [bins] from a line up to which the pedestal has at least the power of the noise, and
    bins belong to the echo. 0 if this distance does not exceed the half-width of the main lobe."""
    line_width_bins: float
    """Width (FWHM) of the laser's line [FFT bins]."""
    delay_bin_width_product: float
    """Delay of the echo, at most the record's duration, in units of one over the bin width."""


NO_PEDESTAL = PedestalShape(0.0, 0.0, 0.0)
"""Pedestal shape of a laser without phase noise: no pedestal."""


class BinThreshold(NamedTuple):
    """Threshold on |X| and noise in the bins of one echo [V, summed over the record].

    Noise is the standard deviation per quadrature. The pedestal is the noise that the laser's phase
    noise leaves around a line.
    """

    line_noise_sigma: float
    """Noise per quadrature [V] in bins that hold lines. It includes the part of the phase-noise
    pedestal that changes |X| in these bins."""
    threshold: float
    """Threshold on |X| [V]."""
    noise_sigma_without_pedestal: float
    """Noise per quadrature [V] of the receiver alone, without the laser's phase noise."""
    noise_sigma_next_to_lines: float
    """Noise per quadrature [V] in bins next to the lines. It includes the whole phase-noise
    pedestal."""
    pedestal: PedestalShape = NO_PEDESTAL
    """Shape of the phase-noise pedestal about the lines."""


class BinThresholds(NamedTuple):
    """Threshold on |X| and noise of n points: arrays (n,) of fields of :class:`BinThreshold`."""

    line_noise_sigma: np.ndarray
    """(n,): noise per quadrature [V] in bins with lines, :attr:`BinThreshold.line_noise_sigma`."""
    threshold: np.ndarray
    """(n,): threshold on |X| [V], :attr:`BinThreshold.threshold`."""
    noise_sigma_without_pedestal: np.ndarray
    """(n,): receiver noise [V], :attr:`BinThreshold.noise_sigma_without_pedestal`."""
    noise_sigma_next_to_lines: np.ndarray
    """(n,): noise per quadrature [V] in bins next to lines,
    :attr:`BinThreshold.noise_sigma_next_to_lines`."""
    pedestal_reach_bins: np.ndarray
    """(n,): distance from a line [bins] up to which bins of the phase-noise pedestal belong to the
    echo, :attr:`PedestalShape.reach_bins`."""
    pedestal_line_width_bins: np.ndarray
    """(n,): laser line width [FFT bins], :attr:`PedestalShape.line_width_bins`."""
    pedestal_delay_bin_width_product: np.ndarray
    """(n,): delay of the echo [one over the bin width],
    :attr:`PedestalShape.delay_bin_width_product`."""

    def select(self, points: np.ndarray) -> "BinThresholds":
        """Return the thresholds and noise of some points, given by their indices."""
        return BinThresholds(*(values[points] for values in self))


class BinSpeckle(NamedTuple):
    """Speckle parameters of the echo in one segment of one point."""

    line_deviation_bins: float
    """Standard deviation [FFT bins] of the frequencies of the lines of a footprint."""
    pseudo_variance_ratio: np.ndarray
    """(bins,): ratio E[X^2] / E[|X|^2] of the signal X, by distance [bins] from the nearer of DC
    and Nyquist. Empty if the echo lies far from both, where the ratio is 0."""


NO_SPECKLE = BinSpeckle(0.0, np.empty(0))
"""Parameters of an echo without speckle, or of a single line far from DC and Nyquist."""


class SpeckleTable(NamedTuple):
    """Speckle parameters of the echoes of n points, by segment."""

    line_deviation_bins: np.ndarray
    """(segments, n): standard deviation [FFT bins] of the frequencies of an echo's lines."""
    pseudo_variance_row: np.ndarray
    """(segments, n) int64: row of ``pseudo_variance_ratio`` for each echo. Row 0 is for echoes far
    from DC and Nyquist."""
    pseudo_variance_ratio: np.ndarray
    """(rows, bins): ratio E[X^2] / E[|X|^2] of the signal X, by distance [bins] from the nearer of
    DC and Nyquist."""
    relative_power_by_phase: np.ndarray
    """(rows, phases): power of the echo's strongest bin at each phase of the speckle, over the mean
    over phases
    (:attr:`sweep.model.detection.pseudo_variance.SignalPseudoVariance.relative_power_by_phase`)."""

    def select(self, segment: int, points: np.ndarray) -> "SpeckleTable":
        """Return the table of one segment at selected points.

        Parameters
        ----------
        segment : int
            Index of the segment, the row of the arrays (segments, n).
        points : ndarray (m,) int64
            Indices of the points.

        Returns
        -------
        SpeckleTable
            Table of one segment and m points. ``pseudo_variance_ratio`` and
            ``relative_power_by_phase`` keep all their rows.
        """
        line_deviation_bins, pseudo_variance_row = (
            values[[segment]][:, points]
            for values in (self.line_deviation_bins, self.pseudo_variance_row)
        )
        return SpeckleTable(
            line_deviation_bins,
            pseudo_variance_row,
            self.pseudo_variance_ratio,
            self.relative_power_by_phase,
        )


@njit(cache=True, error_model="numpy", borrows=True, forceinline=True)
def bin_threshold_of_point(bin_thresholds, point):
    """Return the threshold and the noise of one point.

    Parameters
    ----------
    bin_thresholds : BinThresholds
        Threshold and noise of n points [V, summed over the record].
    point : int
        Index of the point, 0 .. n - 1.

    Returns
    -------
    BinThreshold
        Threshold and noise of the point [V, summed over the record], and shape of its pedestal.
    """
    return BinThreshold(
        bin_thresholds.line_noise_sigma[point],
        bin_thresholds.threshold[point],
        bin_thresholds.noise_sigma_without_pedestal[point],
        bin_thresholds.noise_sigma_next_to_lines[point],
        PedestalShape(
            bin_thresholds.pedestal_reach_bins[point],
            bin_thresholds.pedestal_line_width_bins[point],
            bin_thresholds.pedestal_delay_bin_width_product[point],
        ),
    )


@njit(cache=True, error_model="numpy", borrows=True, forceinline=True)
def echo_half_width(rule, pedestal_reach_bins):
    """Return the half-width [bins] by which an echo extends on either side of its lines.

    Parameters
    ----------
    rule : DetectionRule
        Rule of detection; its ``lobe_half_width`` is the half-width of the main lobe [FFT bins].
    pedestal_reach_bins : float
        Distance from a line [FFT bins], >= 0, up to which bins of the phase-noise pedestal belong
        to the echo (:attr:`PedestalShape.reach_bins`).

    Returns
    -------
    int
        Larger of the two half-widths.
    """
    return max(rule.lobe_half_width, int(pedestal_reach_bins))


@njit(cache=True, error_model="numpy", borrows=True)
def pedestal_power_ratio(pedestal, distance):
    """Return the power density of a phase-noise pedestal, over its density under the line.

    Parameters
    ----------
    pedestal : PedestalShape
        Width of the laser's line, and delay of the echo.
    distance : float
        Distance from the line [FFT bins], >= 0.

    Returns
    -------
    float
        Ratio of the densities. It is 1 on the line.

    Notes
    -----
    Let Gamma be 2 pi times the line width (FWHM), tau the delay, and omega 2 pi times the distance.
    With C = e^(-Gamma tau) the ratio is

        [1 - C (cos omega tau + Gamma / omega sin omega tau)]
        / [(1 - C (1 + Gamma tau)) (1 + omega^2 / Gamma^2)].

    This is the density of :class:`PedestalShape` [Richter et al., IEEE J. Quantum Electron. 22,
    2070, 1986], divided by its limit at omega = 0. For Gamma tau <= 1e-5 the ratio is set to 1: the
    phase noise of the echo then almost cancels that of the local oscillator.
    """
    gamma, delay = 2.0 * math.pi * pedestal.line_width_bins, pedestal.delay_bin_width_product
    coherence, omega = math.exp(-gamma * delay), 2.0 * math.pi * distance
    if not distance > 0.0 or not gamma * delay > 1e-5:
        return 1.0
    ripple = math.cos(omega * delay) + gamma / omega * math.sin(omega * delay)
    under_line = 1.0 - coherence * (1.0 + gamma * delay)
    return (1.0 - coherence * ripple) / (under_line * (1.0 + (omega / gamma) ** 2))


@njit(cache=True, error_model="numpy")
def pedestal_reach_bins(pedestal_to_noise, line_width_bins, delay, reach_max):
    """Return the distance from a line [bins] up to which the pedestal exceeds the noise, (n,).

    The pedestal is the noise around a line due to the laser's phase noise.

    Parameters
    ----------
    pedestal_to_noise
        (n,): power of the pedestal under the line over the power of the noise.
    line_width_bins, delay
        (n,): fields of :class:`PedestalShape`.
    reach_max
        Largest result [bins].
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
    """Fill ``pedestal_ratios`` with the phase-noise pedestal's power over the receiver noise power.

    Bins of at least half the largest magnitude count as bins with lines. The power in bins with
    lines is only that of the part of the pedestal that changes |X|. In all other bins it is that of
    the whole pedestal.

    Parameters
    ----------
    magnitude, is_echo
        Fields of :class:`EchoBins`.
    bin_threshold
        :class:`BinThreshold`.
    pedestal_ratios
        (bins,): output array.
    """
    largest = 0.0
    noise_power = (
        bin_threshold.noise_sigma_without_pedestal * bin_threshold.noise_sigma_without_pedestal
    )
    for i in range(magnitude.size):
        largest = max(largest, magnitude[i] if is_echo[i] else 0.0)
    ratio_under_lines = (
        bin_threshold.line_noise_sigma * bin_threshold.line_noise_sigma / noise_power - 1.0
    )
    ratio_beside_lines = (
        bin_threshold.noise_sigma_next_to_lines
        * bin_threshold.noise_sigma_next_to_lines
        / noise_power
        - 1.0
    )
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
def bin_speckle_of_point(speckle_table, segment, point):
    """Return the :class:`BinSpeckle` of one segment of one point.

    Parameters
    ----------
    speckle_table : SpeckleTable
        Speckle parameters of all segments and points.
    segment, point : int
        Indices of the segment (up, Doppler, down) and of the point.
    """
    pseudo_variance_row = speckle_table.pseudo_variance_row[segment, point]
    n_bins = speckle_table.pseudo_variance_ratio.shape[1] if pseudo_variance_row > 0 else 0
    return BinSpeckle(
        speckle_table.line_deviation_bins[segment, point],
        speckle_table.pseudo_variance_ratio[pseudo_variance_row, :n_bins],
    )


class SpeckleMixing(NamedTuple):
    """Coefficients that mix independent amplitudes into an echo's amplitudes in three segments.

    With independent circular complex Gaussian z of unit power, the amplitudes are

        A_up      = z_0
        A_doppler = doppler_from_up z_0 + doppler_from_independent z_1
        A_down    = down_from_up z_0 + down_from_doppler z_1 + down_from_independent z_2

    The coefficients are the Cholesky factor of the correlation matrix of the amplitudes. Fields are
    (n,) for n points. In kernels they are scalars (:func:`speckle_mixing_of_point`).
    Without speckle, fields are (0,) or zero.
    """

    doppler_from_up: np.ndarray
    """Weight of z_0, the up segment's amplitude, in the Doppler segment's amplitude, 0..1."""
    doppler_from_independent: np.ndarray
    """Weight of the independent z_1 in the Doppler segment's amplitude, 0..1."""
    down_from_up: np.ndarray
    """Weight of z_0, the up segment's amplitude, in the down segment's amplitude, 0..1."""
    down_from_doppler_re: np.ndarray
    """Real part of the weight of z_1 in the down segment's amplitude."""
    down_from_doppler_im: np.ndarray
    """Imaginary part of the weight of z_1 in the down segment's amplitude."""
    down_from_independent: np.ndarray
    """Weight of the independent z_2 in the down segment's amplitude, 0..1."""

    def broadcast(self, n_points: int) -> "SpeckleMixing":
        """Return the coefficients of n points as contiguous arrays (n,) that can be written to."""
        return SpeckleMixing(*(np.array(np.broadcast_to(field, n_points)) for field in self))

    def select(self, indices: np.ndarray) -> "SpeckleMixing":
        """Return the coefficients of the points with the given indices."""
        return SpeckleMixing(*(field[indices] for field in self))


@njit(cache=True, error_model="numpy", borrows=True)
def speckle_mixing_of_point(mixing, point):
    """Return the :class:`SpeckleMixing` of one point, of scalars.

    Parameters
    ----------
    mixing : SpeckleMixing
        Coefficients of n points, (n,) each.
    point : int
        Index of the point.
    """
    return SpeckleMixing(
        mixing.doppler_from_up[point],
        mixing.doppler_from_independent[point],
        mixing.down_from_up[point],
        mixing.down_from_doppler_re[point],
        mixing.down_from_doppler_im[point],
        mixing.down_from_independent[point],
    )


class SegmentCorrelations(NamedTuple):
    """Complex correlations (n,) between segments of an echo's amplitudes in developed speckle."""

    up_doppler: np.ndarray
    """(n,): complex correlation of the amplitudes in up and Doppler segment, |.| <= 1."""
    up_down: np.ndarray
    """(n,): complex correlation of the amplitudes in up and down segment, |.| <= 1."""
    doppler_down: np.ndarray
    """(n,): complex correlation of the amplitudes in Doppler and down segment, |.| <= 1."""

    def speckle_mixing(self) -> SpeckleMixing:
        """Return the coefficients that give independent amplitudes these correlations, (n,) each.

        Notes
        -----
        The coefficients are the Cholesky factor of the segments' correlation matrix. Phases that do
        not change the joint law of the magnitudes are removed.
        """
        up_doppler, up_down, doppler_down = (
            np.minimum(np.abs(correlation), 1.0) for correlation in self
        )
        rotated_doppler_down = doppler_down * np.exp(
            1j * np.angle(self.up_doppler * self.doppler_down * np.conj(self.up_down))
        )
        doppler_from_independent = np.sqrt(1 - up_doppler**2)
        with np.errstate(divide="ignore", invalid="ignore"):
            down_from_doppler = np.where(
                doppler_from_independent > 1e-7,
                (rotated_doppler_down - up_doppler * up_down) / doppler_from_independent,
                0.0,
            )
        down_from_independent = np.sqrt(
            np.maximum(1 - up_down**2 - np.abs(down_from_doppler) ** 2, 0.0)
        )
        return SpeckleMixing(
            doppler_from_up=up_doppler,
            doppler_from_independent=doppler_from_independent,
            down_from_up=up_down,
            down_from_doppler_re=down_from_doppler.real,
            down_from_doppler_im=down_from_doppler.imag,
            down_from_independent=down_from_independent,
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
        (..., n): probability of detection of each segment; nan where it does not exist.
    threshold_ratio
        (n,): threshold over the noise per quadrature.
    correlation
        (n,): modulus of the correlation of the two segments' echo amplitudes.
    n_independent_bins
        Number M of independent bins that represent each echo, :func:`n_detection_equivalent_bins`.

    Returns
    -------
    numpy.ndarray
        (..., n); nan where either probability is nan.

    Notes
    -----
    With one bin per segment, |X| of the two bins are correlated Rayleigh magnitudes [1]_. Let A be
    the squared threshold over the mean power of signal plus noise in the first segment, and B that
    in the second. The segments are detected with the probabilities e^-A and e^-B. The squared
    correlation of signal plus noise is r = ``correlation``^2 times SNR / (1 + SNR) of both
    segments. With Marcum's Q_1, both segments are detected with the probability

        J = e^-A (1 - Q_1(sqrt(2 B / (1-r)), sqrt(2 r A / (1-r))))
            + e^-B Q_1(sqrt(2 r B / (1-r)), sqrt(2 A / (1-r)))

    An echo that any of its bins may detect is represented by M independent bins. Let p be the
    probability of detection of a segment. Each bin is detected with the probability q = 1 - (1 -
    p)^(1/M), and is correlated with one bin of the other segment. Both segments are missed with the
    probability (1 - q_1 - q_2 + J(q_1, q_2))^M. Both segments are thus detected with the
    probability

        p_1 p_2 + (1 - p_1) (1 - p_2) ((1 + (J - q_1 q_2) / ((1 - q_1) (1 - q_2)))^M - 1)

    References
    ----------
    .. [1] M. Schwartz, W. R. Bennett and S. Stein, Communication Systems and Techniques, 1966,
       appendix A.
    """
    is_defined, half_square_threshold = (
        np.isfinite(pd_first) & np.isfinite(pd_second),
        0.5 * threshold_ratio**2,
    )
    with np.errstate(divide="ignore"):
        bin_pds = [np.where(is_defined, p, 1.0) for p in (pd_first, pd_second)]
        bin_pd_first, bin_pd_second = (
            np.where(n_independent_bins > 1, pd_of_one_independent_bin(p, n_independent_bins), p)
            for p in bin_pds
        )
        a, b = (np.minimum(-np.log(p), 700.0) for p in (bin_pd_first, bin_pd_second))
    echo_fraction_product = np.maximum(1 - a / half_square_threshold, 0.0) * np.maximum(
        1 - b / half_square_threshold, 0.0
    )  # of SNR / (1 + SNR)
    squared_correlation = np.minimum(correlation**2 * echo_fraction_product, 1 - 1e-12)
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
    bin_miss_product = np.maximum((1 - bin_pd_first) * (1 - bin_pd_second), 1e-300)
    miss_product = (1 - pd_first) * (1 - pd_second)
    with np.errstate(over="ignore", invalid="ignore"):
        excess = np.expm1(
            n_independent_bins
            * np.log1p(np.maximum(p_both - bin_pd_first * bin_pd_second, 0.0) / bin_miss_product)
        )
        p_both_of_many = pd_first * pd_second + np.where(
            miss_product > 0, miss_product * excess, 0.0
        )
    p_both = np.where(
        n_independent_bins > 1, np.minimum(p_both_of_many, np.minimum(pd_first, pd_second)), p_both
    )
    return np.where(is_defined, p_both, np.nan)


N_INDEPENDENT_BINS_MAX = 1e3
"""Upper limit of the number of independent bins that represent an echo of several bins, as
:func:`n_detection_equivalent_bins` returns it."""


def n_detection_equivalent_bins(
    pd: np.ndarray, peak_ratio: np.ndarray, threshold_ratio: np.ndarray
) -> np.ndarray:
    """Return the number M of independent bins of which any is detected as often as an echo.

    Each of the M bins has the magnitude of the echo's strongest bin.

    Parameters
    ----------
    pd
        Probability that any bin of the echo is detected.
    peak_ratio
        |X| of the echo's strongest bin over the noise per quadrature sigma.
    threshold_ratio
        Threshold Th over sigma.

    Returns
    -------
    numpy.ndarray
        M, in general not an integer, from 1 to :data:`N_INDEPENDENT_BINS_MAX`. It is 1 where pd is
        nan, or where pd and q (see below) both round to 1.

    Notes
    -----
    The strongest bin alone is detected with q = exp(-Th^2 / (2 sigma^2 (1 + SNR))), SNR = |X|^2 /
    (2 sigma^2). M solves 1 - pd = (1 - q)^M. A single line has M = 1: all its bins fade together.
    """
    single_bin_pd = np.exp(-0.5 * np.square(threshold_ratio) / (1 + 0.5 * np.square(peak_ratio)))
    with np.errstate(divide="ignore", invalid="ignore"):
        n_bins = np.log1p(-np.minimum(pd, 1 - 1e-15)) / np.log1p(
            -np.minimum(single_bin_pd, 1 - 1e-15)
        )
    return np.clip(np.nan_to_num(n_bins, nan=1.0), 1.0, N_INDEPENDENT_BINS_MAX)


def pd_of_one_independent_bin(
    pd: np.ndarray | float, n_independent_bins: np.ndarray | float
) -> np.ndarray | float:
    """Return the probability of detection of each of M equal and independent bins of an echo.

    Parameters
    ----------
    pd
        Probability that any of the bins is detected.
    n_independent_bins
        M, not necessarily an integer.

    Returns
    -------
    ndarray or float
        1 - (1 - pd)^(1/M), precise also where it is small.

    Examples
    --------
    >>> round(float(pd_of_one_independent_bin(0.75, 2.0)), 6)
    0.5
    """
    return -np.expm1(np.log1p(-pd) / n_independent_bins)


pd_of_one_independent_bin_kernel = njit(cache=True, error_model="numpy", borrows=True)(
    pd_of_one_independent_bin
)
""":func:`pd_of_one_independent_bin` of single numbers, compiled for calls from kernels."""


@njit(cache=True, error_model="numpy", borrows=True)
def pd_of_any_independent_bin(bin_pd, n_bins):
    """Return the probability that any of M equal and independent bins is detected.

    This is the inverse of :func:`pd_of_one_independent_bin`.

    Parameters
    ----------
    bin_pd : float
        Probability q that one bin is detected, 0..1.
    n_bins : float
        Number M >= 0 of bins, not necessarily an integer.

    Returns
    -------
    float
        1 - (1 - q)^M, precise also where it is small.
    """
    return -math.expm1(n_bins * math.log1p(-bin_pd))


def at_least_two_of_three_probability(
    probabilities: np.ndarray, complements: np.ndarray
) -> np.ndarray:
    """Return the probability that at least two of three independent events happen, (...).

    Parameters
    ----------
    probabilities, complements
        (3, ...): probability of each event, and one minus it. They are separate arguments to keep
        precision in both tails.

    Examples
    --------
    >>> p = np.array([0.9, 0.8, 0.5])
    >>> round(float(at_least_two_of_three_probability(p, 1 - p)), 6)
    0.85
    """
    (a, b, c), (no_a, no_b, no_c) = probabilities, complements
    probability = a * b * c + a * b * no_c + a * no_b * c + no_a * b * c
    return np.minimum(probability, 1.0)  # rounding may exceed 1


@njit(cache=True, error_model="numpy", borrows=True)
def mark_exempt_bins(magnitude, n_bins, threshold, is_exempt, lobe_half_width):
    """Find the strongest of adjacent bins, and mark the bins that belong to an echo.

    Bins of an echo are exempt: they cannot raise a false alarm.

    Parameters
    ----------
    magnitude
        |X| without noise, at least ``n_bins`` bins.
    n_bins
        Number of bins.
    threshold
        Threshold on |X|.
    is_exempt
        Output array, bool: True in bins that belong to an echo, and so can raise no false alarm.
    lobe_half_width
        Half-width [bins] of an echo about its lines if any bin of the echo may detect it, else 0.

    Returns
    -------
    peak, n_exempt
        Index of the strongest bin; number of exempt bins.

    Notes
    -----
    Adjacent bins at or above the threshold form a group. Three kinds of bins are exempt: those of
    each group and one more on either side; the strongest bin and its two neighbours; and bins
    within ``lobe_half_width`` of a bin of at least half the largest magnitude.
    """
    largest, n_above = _largest_and_n_above(magnitude[:n_bins], threshold)
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
    n_exempt = _mark_group_exempt(first, last, n_bins, is_exempt)
    if n_above > last - first + 1 or lobe_half_width > 0:
        n_exempt = 0
        for i in range(n_bins):
            if magnitude[i] >= threshold:
                _mark_group_exempt(i, i, n_bins, is_exempt)
        for i in range(n_bins):
            n_exempt += is_exempt[i]
    return peak, n_exempt


@njit(cache=True, error_model="numpy", borrows=True)
def is_real_bin(bin_, has_real_noise_at_ends, fft_size):
    """Test if the noise of a bin is real, as at DC and Nyquist of a real record.

    Parameters
    ----------
    bin_ : int
        Number of the bin.
    has_real_noise_at_ends : bool
        True if the noise at DC and Nyquist is real (:attr:`DetectionRule.has_real_noise_at_ends`).
    fft_size : int
        FFT size.
    """
    return has_real_noise_at_ends and (bin_ == 0 or 2 * bin_ == fft_size)


@njit(cache=True, error_model="numpy", borrows=True)
def bin_crossing_tails(signal_ratio, threshold_ratio, is_real):
    """Return the probabilities that a bin with a steady signal crosses the threshold, or not.

    Parameters
    ----------
    signal_ratio, threshold_ratio
        |X| without noise, a, and threshold, b, both over the noise per quadrature sigma.
    is_real
        True if the noise n is real. It then has the variance 2 sigma^2.

    Returns
    -------
    Tails
        Marcum's Q_1(a, b) and 1 - Q_1(a, b); for real noise P(|a + n| >= b) and its complement.
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
    """Return the probabilities that an echo is detected in one record, and that it is missed.

    Parameters
    ----------
    echo
        :class:`EchoBins` of adjacent bins around the echo's lines.
    peak_index
        Index of the strongest of these bins.
    rule, bin_threshold, bin_speckle
        :class:`DetectionRule`, :class:`BinThreshold` and :class:`BinSpeckle`.

    Returns
    -------
    PdAndMiss

    Notes
    -----
    If ``rule.detects_by_any_bin`` is true, any bin of the echo may detect it
    (:func:`pd_and_miss_any_bin`, or :func:`pd_and_miss_in_speckle`). Otherwise only the strongest
    bin counts. The pedestal that the laser's phase noise leaves around a line is light of the echo
    and fades with it.
    """
    if rule.in_speckle:
        if rule.detects_by_any_bin:
            return pd_and_miss_in_speckle(echo, rule, bin_threshold, bin_speckle)
        if bin_threshold.line_noise_sigma > bin_threshold.noise_sigma_without_pedestal:
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
    if rule.detects_by_any_bin:
        if bin_threshold.pedestal.reach_bins > 0.0:
            return _pd_and_miss_on_pedestal(echo, rule, bin_threshold)
        return pd_and_miss_any_bin(echo, rule, bin_threshold)
    line_noise_sigma = bin_threshold.line_noise_sigma
    tails = bin_crossing_tails(
        echo.magnitude[peak_index] / line_noise_sigma,
        bin_threshold.threshold / line_noise_sigma,
        is_real_bin(echo.first_bin + peak_index, rule.has_real_noise_at_ends, rule.fft_size),
    )
    return PdAndMiss(tails.above, tails.below)


@njit(cache=True, error_model="numpy", borrows=True)
def _pd_and_miss_of_peak_in_speckle(magnitude, bin_, rule, bin_threshold, bin_speckle):
    """Return the :class:`PdAndMiss` by one bin in developed speckle, without laser phase noise.

    Parameters
    ----------
    magnitude : float
        Root mean square |X| of the bin's signal [V, summed over the record].
    bin_ : int
        Number of the bin in the spectrum.
    rule : DetectionRule
        Rule of detection.
    bin_threshold : BinThreshold
        Threshold Th on |X|, and noise per quadrature [V, summed over the record].
    bin_speckle : BinSpeckle
        Speckle parameters of the echo.

    Returns
    -------
    PdAndMiss
        Probabilities that |X| with noise is at or above Th, and that it is below.

    Notes
    -----
    The mean of |X|^2 is P = S + 2 sigma^2, with the signal's mean power S = ``magnitude``^2 and the
    noise sigma per quadrature. Far from DC and Nyquist, X is a circular complex Gaussian number,
    and

        pd = exp(-Th^2 / P)

    as for a Swerling 1 target. Near DC and Nyquist of a real record, X has the pseudo-variance
    ratio q = (S q_s + 2 sigma^2 q_n) / P, with the ratios q_s of the signal and q_n of the noise,
    and |X| has a Hoyt distribution (:func:`sweep.model.detection.hoyt.hoyt_tails`).
    """
    signal_power = magnitude * magnitude
    noise_power = 2.0 * bin_threshold.line_noise_sigma * bin_threshold.line_noise_sigma
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
    return PdAndMiss(tails.above, tails.below)


@njit(cache=True, error_model="numpy")
def _pd_and_miss_of_peak_on_pedestal(magnitude, bin_, rule, bin_threshold, bin_speckle):
    """Return the :class:`PdAndMiss` by one bin in developed speckle, with laser phase noise.

    The phase noise leaves a pedestal around the line, which fades with it.

    Parameters
    ----------
    magnitude : float
        Root mean square |X| of the bin's signal [V, summed over the record].
    bin_ : int
        Number of the bin in the spectrum.
    rule : DetectionRule
        Rule of detection.
    bin_threshold : BinThreshold
        Threshold Th on |X|, and noise per quadrature [V, summed over the record].
    bin_speckle : BinSpeckle
        Speckle parameters of the echo.

    Returns
    -------
    PdAndMiss
        Probabilities that |X| with noise is at or above Th, and that it is below.

    Notes
    -----
    Let z be the amplitude of the speckle, E|z|^2 = 1, and sigma_0 the noise per quadrature without
    the pedestal. Given z, the bin has the steady signal |z| ``magnitude`` in noise of the variance
    sigma_0^2 + |z|^2 (sigma^2 - sigma_0^2) per quadrature. sigma is
    :attr:`BinThreshold.line_noise_sigma`. The result is the mean over |z|^2, which is exponential.
    Near DC and Nyquist of a real record it is also the mean over the phase of z.
    """
    noise = bin_threshold.noise_sigma_without_pedestal
    bins_given_mode = _allocate_bins_given_mode(INTEGER_ONE)
    bins_given_mode.signal_ratio[:] = magnitude / noise
    bins_given_mode.threshold_ratio[:] = bin_threshold.threshold / noise
    bins_given_mode.pedestal_power_ratio[:] = (bin_threshold.line_noise_sigma / noise) ** 2 - 1.0
    echo = EchoBins(np.full(1, magnitude), np.ones(1, np.bool_), bin_)
    return _mean_pd_and_miss_over_mode_phase(bins_given_mode, echo, rule, bin_speckle)


@njit(cache=True, error_model="numpy", borrows=True)
def pd_and_miss_any_bin(echo, rule, bin_threshold):
    """Return the probabilities that any bin of a steady echo crosses the threshold, and none does.

    Parameters
    ----------
    echo, rule, bin_threshold
        :class:`EchoBins`, :class:`DetectionRule` and :class:`BinThreshold`.

    Returns
    -------
    PdAndMiss

    Notes
    -----
    A single bin crosses with :func:`bin_crossing_tails`. The noise of neighbouring bins has the
    correlation rho in phase with the signal, if the signal keeps its phase from bin to bin as in a
    main lobe. Two neighbours are taken to cross jointly like two correlated normal numbers that
    exceed s and t with the same probabilities. The joint probability is the product of the two plus
    [1]_

        1 / (2 pi) int_0^{asin rho} exp(-(s^2 + t^2 - 2 s t sin u) / (2 cos^2 u)) du

    by the quadrature ``rule.neighbour_crossing_quadrature``. Bins are treated as a first-order
    Markov chain.

    References
    ----------
    .. [1] D. B. Owen, "Tables for computing bivariate normal probabilities," Ann. Math. Statist.
       27, 1956.
    """
    magnitude, is_echo = echo.magnitude, echo.is_echo
    pd, miss, previous_p_stay, previous_quantile, largest = 0.0, 1.0, -1.0, 0.0, 0.0
    threshold = bin_threshold.threshold
    for i in range(magnitude.size):
        largest = max(largest, magnitude[i] if is_echo[i] else 0.0)
    for i in range(magnitude.size):
        if not is_echo[i]:
            previous_p_stay = -1.0
            continue
        noise = (
            bin_threshold.line_noise_sigma
            if magnitude[i] >= 0.5 * largest
            else bin_threshold.noise_sigma_next_to_lines
        )
        is_real = is_real_bin(echo.first_bin + i, rule.has_real_noise_at_ends, rule.fft_size)
        tails = bin_crossing_tails(magnitude[i] / noise, threshold / noise, is_real)
        if not tails.below > 0.0:
            return PdAndMiss(1.0, 0.0)
        given_neighbour, quantile = _crossing_given_previous_bin_stays(
            tails, previous_p_stay, previous_quantile, rule.neighbour_crossing_quadrature
        )
        pd += miss * given_neighbour.above
        miss *= given_neighbour.below
        previous_p_stay, previous_quantile = tails.below, quantile
    return PdAndMiss(pd if pd < 0.5 else 1.0 - miss, miss)


@njit(cache=True, error_model="numpy")
def _pd_and_miss_on_pedestal(echo, rule, bin_threshold):
    """Compute :func:`pd_and_miss_any_bin` for a steady echo of a laser with phase noise.

    The laser's phase noise leaves a pedestal around each line, and some bins of the echo hold only
    pedestal. :func:`fill_pedestal_ratios` gives the power that it adds to the noise of each bin.
    """
    n_bins = echo.magnitude.size
    pedestal_ratios, bins_given_mode = np.empty(n_bins), _allocate_bins_given_mode(n_bins)
    fill_pedestal_ratios(echo.magnitude, echo.is_echo, bin_threshold, pedestal_ratios)
    for k in range(n_bins):
        noise = bin_threshold.noise_sigma_without_pedestal * math.sqrt(1.0 + pedestal_ratios[k])
        bins_given_mode.signal_ratio[k] = echo.magnitude[k] / noise
        bins_given_mode.threshold_ratio[k] = bin_threshold.threshold / noise
        bins_given_mode.neighbour_noise_correlation[k] = rule.neighbour_noise_correlation
    return _pd_and_miss_given_mode(
        bins_given_mode, 1.0, echo, rule.has_real_noise_at_ends, rule.fft_size, np.inf, 0.0
    )


@njit(cache=True, error_model="numpy")
def _allocate_bins_given_mode(n_bins):
    """Return a :class:`BinsGivenMode` for ``n_bins`` bins, all of whose fields are zero."""
    rows = np.zeros((5, n_bins))  # one allocation instead of five
    return BinsGivenMode(
        signal_ratio=rows[0],
        threshold_ratio=rows[1],
        neighbour_noise_correlation=rows[2],
        pedestal_power_ratio=rows[3],
        other_modes_noise_fraction=rows[4],
    )


@njit(cache=True, error_model="numpy", borrows=True)
def _crossing_given_previous_bin_stays(
    tails, previous_p_stay, previous_quantile, neighbour_crossing_quadrature
):
    """Return a bin's crossing probability given that the bin below does not cross.

    Parameters
    ----------
    tails
        Unconditional :class:`.Tails` of the bin.
    previous_p_stay, previous_quantile
        Probability that the bin below does not cross, and the number that a standard normal
        variable exceeds as often as that bin crosses. The probability is negative if no bin of the
        echo lies below.
    neighbour_crossing_quadrature
        :class:`sweep.model.detection.joint_tail.JointTailQuadrature` of the noise of neighbours.

    Returns
    -------
    given_neighbour, quantile
        Conditional :class:`.Tails`, and the number that a standard normal variable exceeds with the
        probability ``tails.above``.
    """
    quantile = _upper_normal_quantile_of_tails(tails)
    if not previous_p_stay > 0.0:
        return tails, quantile
    p_joint = joint_tail_excess(quantile, previous_quantile, neighbour_crossing_quadrature)
    p_joint = min(p_joint / previous_p_stay, tails.above)
    return Tails(tails.above - p_joint, tails.below + p_joint), quantile


@njit(cache=True, error_model="numpy", borrows=True)
def any_crossing_probability_in_chain(probabilities, n_bins, neighbour_crossing_quadrature):
    """Return the probability that any bin of a run crosses, from the probability of each bin.

    The bins of the run are adjacent, and neighbours are correlated as in
    :func:`pd_and_miss_any_bin`. Bins that cross with a probability below 1e-4 count as independent.

    Parameters
    ----------
    probabilities
        Crossing probability of each bin, at least ``n_bins`` of them.
    n_bins
        Number of bins.
    neighbour_crossing_quadrature
        :class:`sweep.model.detection.joint_tail.JointTailQuadrature` of the noise of neighbours.
    """
    p_any, p_none, previous_p_stay, previous_quantile = 0.0, 1.0, -1.0, 0.0
    for i in range(n_bins):
        p_cross = min(max(probabilities[i], 0.0), 1.0)
        p_stay = 1.0 - p_cross
        if not p_stay > 0.0:
            return 1.0
        if p_cross < 1e-4:
            p_any, p_none, previous_p_stay = p_any + p_none * p_cross, p_none * p_stay, -1.0
            continue
        given_neighbour, quantile = _crossing_given_previous_bin_stays(
            Tails(p_cross, p_stay),
            previous_p_stay,
            previous_quantile,
            neighbour_crossing_quadrature,
        )
        p_any += p_none * given_neighbour.above
        p_none *= given_neighbour.below
        previous_p_stay, previous_quantile = p_stay, quantile
    return p_any


@njit(cache=True, error_model="numpy", borrows=True)
def clear_image_exemptions(magnitude, is_exempt, first_bin, fft_size, image_gain):
    """Clear the exemption of bins that an I/Q image dominates; return the number of exempt bins.

    Exempt bins belong to an echo and raise no false alarm. An image lies at the opposite frequency
    of its line and has ``image_gain`` times the line's |X|. It dominates a bin if it makes at least
    half of the bin's |X|.

    Parameters
    ----------
    magnitude
        (bins,): |X| without noise of adjacent bins.
    is_exempt
        (bins,) bool: exempt bins; changed in place.
    first_bin
        Number of the first bin.
    fft_size
        FFT size N.
    image_gain
        |X| of an image over |X| of its line.
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
    """Return the probabilities that any bin of an echo in developed speckle crosses, and none does.

    Parameters
    ----------
    echo, rule, bin_threshold, bin_speckle
        :class:`EchoBins`, :class:`DetectionRule`, :class:`BinThreshold` and :class:`BinSpeckle`.

    Returns
    -------
    PdAndMiss

    Notes
    -----
    The strongest speckle mode (:mod:`sweep.model.detection.speckle_modes`) is one complex Gaussian
    number z for all bins. Given z, bin k has the steady signal u_k z, where u_k is the root mean
    square |X| of the mode in bin k. The other modes add to the noise of the bin, with their own
    variance and correlation. The result is the mean over |z|^2, which is exponential. A single line
    has all its power in the strongest mode, and the line's sidelobes fade with it. Near DC and
    Nyquist the mode's power depends on the phase of z as 1 + q_k cos t, with the pseudo-variance
    ratio q_k of bin k and t uniform (:mod:`sweep.model.detection.pseudo_variance`).

    Runs of adjacent echo bins fade independently of each other if they hold a bin of at least half
    the largest magnitude. A weaker run fades with the strong run below it. docs/physics.md states
    the errors of these approximations.
    """
    magnitude, is_echo = echo.magnitude, echo.is_echo
    largest = 0.0
    for i in range(magnitude.size):
        largest = max(largest, magnitude[i] if is_echo[i] else 0.0)
    pd, miss, run_begin, i, n_runs = 0.0, 1.0, INTEGER_ZERO, INTEGER_ZERO, 0
    while i < magnitude.size:
        echo_begin, has_strong_bin = i, False
        while i < magnitude.size and is_echo[i]:
            has_strong_bin |= magnitude[i] >= 0.5 * largest
            i += 1
        if has_strong_bin:
            if n_runs > 0:
                bin_run = _pd_and_miss_of_adjacent_bins(
                    echo, run_begin, echo_begin, rule, bin_threshold, bin_speckle
                )
                pd, miss, run_begin = (
                    pd + miss * bin_run.pd,
                    miss * bin_run.miss,
                    echo_begin,
                )
            n_runs += 1
        i += 1
    bin_run = _pd_and_miss_of_adjacent_bins(
        echo, run_begin, magnitude.size, rule, bin_threshold, bin_speckle
    )
    return PdAndMiss(pd + miss * bin_run.pd, miss * bin_run.miss)


_N_GAUSS_NODES = 6
"""Number of nodes, in each interval, of the Gauss-Legendre quadrature over the magnitude of the
strongest speckle mode."""
_IMPOSSIBLE_BELOW_SIGMA, _CERTAIN_ABOVE_SIGMA = 4.5, 2.7
"""Distances of the noiseless |X| below and above the threshold beyond which the quadrature ends, in
units of the noise per quadrature. A bin misses with a probability of 3e-3 at the upper end, and
crosses with 3e-5 or less at the lower one, as small pd require. The error of pd is at most 2e-3,
and mostly 1e-4."""
_SPECKLE_MODE_MAGNITUDE_MAX = 6.0
"""Upper end of the quadrature over the magnitude of the strongest speckle mode, in units of its
root mean square."""
_RARE_CROSSING_PROBABILITY_MAX = 1e-5
"""Crossing probability below which a bin counts as independent of its neighbours."""
_NEGLIGIBLE_PROBABILITY, _NEGLIGIBLE_FRACTION = 1e-6, 1e-4
"""Largest contribution of a bin to the probability of detection pd that may be neglected. The first
is absolute, the second relative to the smaller of pd and 1 - pd."""
_GAUSS_NODES, _GAUSS_WEIGHTS = np.polynomial.legendre.leggauss(_N_GAUSS_NODES)


@njit(cache=True, error_model="numpy")
def _pd_and_miss_of_adjacent_bins(echo, begin, end, rule, bin_threshold, bin_speckle):
    """Return the :class:`PdAndMiss` of a run of bins of an echo in developed speckle.

    The adjacent bins of the run fade together.

    Parameters
    ----------
    echo : EchoBins
        Root mean square |X| without noise [V, summed over the record] of adjacent bins.
    begin, end : int
        Indices in ``echo`` of the run's first bin, and of the bin after its last. Bins at both ends
        of the run that do not belong to the echo are left out.
    rule : DetectionRule
        Rule of detection, with the table of the strongest speckle mode.
    bin_threshold : BinThreshold
        Threshold on |X|, and noise per quadrature [V, summed over the record].
    bin_speckle : BinSpeckle
        Speckle parameters of the echo.

    Returns
    -------
    PdAndMiss
        Probabilities that any bin of the run crosses the threshold, and that none does.

    Notes
    -----
    Given the amplitude z of the strongest speckle mode, E|z|^2 = 1, bin k has the steady signal u_k
    z, where u_k is the root mean square |X| of the mode in bin k. The other modes add to the noise
    of the bin (:func:`pd_and_miss_in_speckle`). A bin's fraction of power in the strongest mode is
    interpolated in ``rule.mode_table``. If the echo has a phase-noise pedestal, bins outside the
    main lobe of the strongest bin have the fraction of the strongest bin.
    """
    magnitude, is_echo = echo.magnitude, echo.is_echo
    nyquist_bin = rule.fft_size // 2 if rule.is_real_record_in_speckle else 0
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
    if rule.is_real_record_in_speckle and (
        echo.first_bin + strongest == 0 or echo.first_bin + strongest == nyquist_bin
    ):
        below = above = max(below, above)  # bins mirror there
    asymmetry = power_asymmetry(below, magnitude[strongest], above)
    mode_table = rule.mode_table
    cell = locate_in_mode_table(mode_table, bin_speckle.line_deviation_bins, asymmetry)
    noise_power = (
        2.0
        * bin_threshold.noise_sigma_without_pedestal
        * bin_threshold.noise_sigma_without_pedestal
    )
    n_bins = end - begin
    bin_run = EchoBins(magnitude[begin:end], is_echo[begin:end], echo.first_bin + begin)
    # Not by _allocate_bins_given_mode: a call and zeros cost 6 % of the time of an echo.
    rows, pedestal_ratios = np.empty((5, n_bins)), np.empty(n_bins)
    bins_given_mode = BinsGivenMode(
        signal_ratio=rows[0],
        threshold_ratio=rows[1],
        neighbour_noise_correlation=rows[2],
        pedestal_power_ratio=rows[3],
        other_modes_noise_fraction=rows[4],
    )
    previous_fraction, previous_inverse_noise = 0.0, 0.0
    fill_pedestal_ratios(bin_run.magnitude, bin_run.is_echo, bin_threshold, pedestal_ratios)
    for k in range(n_bins):
        i = begin + k
        signal_power, pedestal_power = magnitude[i] * magnitude[i], noise_power * pedestal_ratios[k]
        # A pedestal holds the light of all lines, as the bins between them do.
        is_near = (
            abs(i - strongest) <= rule.lobe_half_width
            or not bin_threshold.pedestal.reach_bins > 0.0
        )
        mode_fraction = interpolate_mode_table(
            mode_table.power_fraction, cell, i - strongest if is_near else 0
        )
        other_power = (1.0 - mode_fraction) * (signal_power + pedestal_power) + noise_power
        inverse_noise = math.sqrt(2.0 / other_power)
        bins_given_mode.pedestal_power_ratio[k] = mode_fraction * pedestal_power / other_power
        bins_given_mode.signal_ratio[k] = inverse_noise * math.sqrt(mode_fraction * signal_power)
        bins_given_mode.threshold_ratio[k] = inverse_noise * bin_threshold.threshold
        bins_given_mode.neighbour_noise_correlation[k] = 0.0
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
                rule.neighbour_noise_correlation, neighbour_correlation
            )
            bins_given_mode.neighbour_noise_correlation[k] = min(
                max(0.5 * noise_covariance * inverse_noise * previous_inverse_noise, -0.999), 0.999
            )
        previous_fraction, previous_inverse_noise = mode_fraction, inverse_noise
        # The power of the other modes depends on the phase too, except in bins 0 and N/2.
        bin_, other_modes_power = bin_run.first_bin + k, (1.0 - mode_fraction) * magnitude[i] ** 2
        bins_given_mode.other_modes_noise_fraction[k] = 0.0
        if bin_ != 0 and bin_ != nyquist_bin:
            bins_given_mode.other_modes_noise_fraction[k] = other_modes_power / (
                other_modes_power + noise_power
            )
    return _mean_pd_and_miss_over_mode_phase(bins_given_mode, bin_run, rule, bin_speckle)


@njit(cache=True, error_model="numpy", borrows=True)
def _mean_pd_and_miss_over_mode_phase(bins_given_mode, echo, rule, bin_speckle):
    """Return the mean :class:`PdAndMiss` over the power of the strongest speckle mode.

    Near DC and Nyquist of a real record it is also the mean over the mode's phase.
    """
    if bin_speckle.pseudo_variance_ratio.size == 0:
        return _mean_pd_and_miss_over_mode_power(
            bins_given_mode, echo, rule.has_real_noise_at_ends, rule.fft_size
        )
    return _mean_pd_and_miss_over_noncircular_mode_phase(bins_given_mode, echo, rule, bin_speckle)


@njit(cache=True, error_model="numpy")
def _mean_pd_and_miss_over_noncircular_mode_phase(bins_given_mode, echo, rule, bin_speckle):
    """Return the mean :class:`PdAndMiss` over power and phase t of the strongest speckle mode.

    The result applies to bins near DC and Nyquist. Let q be the ratio E[X^2] / E[|X|^2] of a bin X.
    At the phase t the power of all modes in the bin is 1 + q cos t times the mean over t.
    """
    pd, miss, n_bins = 0.0, 0.0, echo.is_echo.size
    given_phase = BinsGivenMode(
        np.empty(n_bins),
        np.empty(n_bins),
        bins_given_mode.neighbour_noise_correlation,
        np.empty(n_bins),
        bins_given_mode.other_modes_noise_fraction,
    )
    for node in range(N_PHASE_NODES):
        for k in range(n_bins):
            ratio = pseudo_variance_ratio_at(
                echo.first_bin + k, rule.fft_size // 2, bin_speckle.pseudo_variance_ratio
            )
            power_factor = max(1.0 + ratio * PHASE_COSINES[node], 0.0)
            inverse_noise = 1.0 / math.sqrt(
                1.0 + (power_factor - 1.0) * bins_given_mode.other_modes_noise_fraction[k]
            )
            given_phase.signal_ratio[k] = (
                bins_given_mode.signal_ratio[k] * math.sqrt(power_factor) * inverse_noise
            )
            given_phase.threshold_ratio[k] = bins_given_mode.threshold_ratio[k] * inverse_noise
            given_phase.pedestal_power_ratio[k] = (
                bins_given_mode.pedestal_power_ratio[k]
                * power_factor
                * inverse_noise
                * inverse_noise
            )
        at_phase = _mean_pd_and_miss_over_mode_power(
            given_phase, echo, rule.has_real_noise_at_ends, rule.fft_size
        )
        pd, miss = pd + at_phase.pd / N_PHASE_NODES, miss + at_phase.miss / N_PHASE_NODES
    return PdAndMiss(pd, miss)


@njit(cache=True, error_model="numpy", borrows=True)
def _mean_pd_and_miss_over_mode_power(bins_given_mode, echo, has_real_noise_at_ends, fft_size):
    """Return the mean :class:`PdAndMiss` over the power of the strongest speckle mode.

    The mode has the amplitude z in all bins. The signal of a bin is |z| times
    ``bins_given_mode.signal_ratio``. The density of |z| at z is 2 z e^(-z^2).

    Parameters
    ----------
    bins_given_mode, echo
        :class:`BinsGivenMode` and :class:`EchoBins`.
    has_real_noise_at_ends, fft_size
        Fields of :class:`DetectionRule`.
    """
    is_echo = echo.is_echo
    z_first = z_last = z_middle = _SPECKLE_MODE_MAGNITUDE_MAX
    pedestal_ratio_max, strongest_index = 0.0, NO_INDEX
    for k in range(is_echo.size):
        pedestal_ratio_max = max(pedestal_ratio_max, bins_given_mode.pedestal_power_ratio[k])
        if is_echo[k] and bins_given_mode.signal_ratio[k] > 0.0:
            pedestal_deviation = math.sqrt(bins_given_mode.pedestal_power_ratio[k])
            if bins_given_mode.threshold_ratio[k] < z_middle * bins_given_mode.signal_ratio[k]:
                z_middle, strongest_index = (
                    bins_given_mode.threshold_ratio[k] / bins_given_mode.signal_ratio[k],
                    k,
                )
            z_first = min(
                z_first,
                max(bins_given_mode.threshold_ratio[k] - _IMPOSSIBLE_BELOW_SIGMA, 0.0)
                / (bins_given_mode.signal_ratio[k] + _IMPOSSIBLE_BELOW_SIGMA * pedestal_deviation),
            )
            signal_over_pedestal = (
                bins_given_mode.signal_ratio[k] - _CERTAIN_ABOVE_SIGMA * pedestal_deviation
            )
            if signal_over_pedestal > 0.0:
                z_last = min(
                    z_last,
                    (bins_given_mode.threshold_ratio[k] + _CERTAIN_ABOVE_SIGMA)
                    / signal_over_pedestal,
                )
    z_last = min(z_last, math.sqrt(z_middle * z_middle + 10.0))  # 5e-5 of the mean lies beyond
    interval_ends = (z_first, z_last, z_last)
    if pedestal_ratio_max > 0.0:
        # With a fading pedestal pd rises about the middle, or slowly over the whole interval.
        z_last = max(z_first, min(z_last, 4.5))  # |z| is larger with a probability of 2e-9
        z_between = z_middle if z_first < z_middle < z_last else 0.5 * (z_first + z_last)
        interval_ends = (z_first, z_between, z_last)
    is_real = is_real_bin(echo.first_bin + strongest_index, has_real_noise_at_ends, fft_size)
    # From the largest |z| down: bins that hardly add to the sum so far can then be left out.
    pd, miss, p_below_first = math.exp(-z_last * z_last), 0.0, -math.expm1(-z_first * z_first)
    for interval in range(1, -1, -1):
        half_width = 0.5 * (interval_ends[interval + 1] - interval_ends[interval])
        for j in range(_N_GAUSS_NODES - 1 if half_width > 0.0 else -1, -1, -1):
            z = interval_ends[interval] + half_width * (_GAUSS_NODES[j] + 1.0)
            weight = half_width * _GAUSS_WEIGHTS[j] * 2.0 * z * math.exp(-z * z)
            negligible_probability = (
                min(_NEGLIGIBLE_PROBABILITY, _NEGLIGIBLE_FRACTION * min(pd, miss + p_below_first))
                / weight
            )
            squared_distance_max = (
                math.inf
                if pedestal_ratio_max > 0.0
                else _negligible_squared_distance(
                    z, bins_given_mode, strongest_index, is_real, negligible_probability
                )
            )
            at_z = _pd_and_miss_given_mode(
                bins_given_mode,
                z,
                echo,
                has_real_noise_at_ends,
                fft_size,
                squared_distance_max,
                negligible_probability,
            )
            pd, miss = pd + weight * at_z.pd, miss + weight * at_z.miss
    if z_first > 0.0:
        negligible_probability = (
            min(_NEGLIGIBLE_PROBABILITY, _NEGLIGIBLE_FRACTION * min(pd, p_below_first))
            / p_below_first
        )
        squared_distance_max = (
            math.inf
            if pedestal_ratio_max > 0.0
            else _negligible_squared_distance(
                0.6 * z_first, bins_given_mode, strongest_index, is_real, negligible_probability
            )
        )
        at_z = _pd_and_miss_given_mode(
            bins_given_mode,
            0.6 * z_first,
            echo,
            has_real_noise_at_ends,
            fft_size,
            squared_distance_max,
            negligible_probability,
        )
        pd, miss = pd + p_below_first * at_z.pd, miss + p_below_first * at_z.miss
    total = pd + miss  # 1 but for the quadrature
    return PdAndMiss(pd / total, miss / total)


@njit(cache=True, error_model="numpy", borrows=True)
def _negligible_squared_distance(
    z, bins_given_mode, strongest_index, is_real, negligible_probability
):
    """Return the squared distance below the threshold beyond which bins are negligible [sigma^2].

    The threshold b and signals are in units of sigma, the noise per quadrature. A bin of signal a <
    b adds at most e^(-(b - a)^2 / 2) times the miss probability of the strongest bin to pd. If the
    strongest bin's signal A exceeds b, its miss probability is less than e^(-(A - b)^2 / 2), or for
    real noise less than the square root of this.

    Parameters
    ----------
    z
        Magnitude of the strongest speckle mode.
    bins_given_mode
        :class:`BinsGivenMode`.
    strongest_index
        Index of the bin that crosses at the smallest z; negative if there is none.
    is_real
        True if the noise of this bin is real.
    negligible_probability
        Largest contribution to pd that may be neglected.
    """
    if not negligible_probability > 0.0 or strongest_index < 0:
        return math.inf
    excess_ratio = max(
        bins_given_mode.signal_ratio[strongest_index] * z
        - bins_given_mode.threshold_ratio[strongest_index],
        0.0,
    )
    return -2.0 * math.log(negligible_probability) - excess_ratio * excess_ratio * (
        0.5 if is_real else 1.0
    )


@njit(cache=True, error_model="numpy", borrows=True)
def _pd_and_miss_given_mode(
    bins_given_mode,
    z,
    echo,
    has_real_noise_at_ends,
    fft_size,
    squared_distance_max,
    negligible_probability,
):
    """Return the :class:`PdAndMiss` by any bin given the magnitude z of the strongest speckle mode.

    The law is that of :func:`pd_and_miss_any_bin`, with a noise correlation r of each pair of
    neighbours. The powers of two neighbours, with signals a and b over the noise, are correlated by

        (r^2 + r a b) / sqrt((1 + a^2) (1 + b^2)),

    which is r^2 for noise alone and r for strong signals.

    Parameters
    ----------
    bins_given_mode, z, echo
        :class:`BinsGivenMode`, magnitude of the mode, and :class:`EchoBins`.
    has_real_noise_at_ends, fft_size
        Fields of :class:`DetectionRule`.
    squared_distance_max
        Squared distance [sigma^2] below the threshold beyond which bins are left out.
    negligible_probability
        Contribution to pd below which a bin counts as independent of its neighbours.
    """
    is_echo = echo.is_echo
    pd, miss, previous_p_stay, previous_quantile, previous_signal = 0.0, 1.0, -1.0, 0.0, 0.0
    for k in range(is_echo.size):
        if not is_echo[k]:
            previous_p_stay = -1.0
            continue
        scale = 1.0 / math.sqrt(1.0 + bins_given_mode.pedestal_power_ratio[k] * z * z)
        signal = bins_given_mode.signal_ratio[k] * z * scale
        distance_below = bins_given_mode.threshold_ratio[k] * scale - signal
        is_real = is_real_bin(echo.first_bin + k, has_real_noise_at_ends, fft_size)
        if distance_below > 0.0 and distance_below * distance_below > (
            2.0 * squared_distance_max if is_real else squared_distance_max
        ):
            previous_p_stay = -1.0
            continue
        tails = bin_crossing_tails(signal, bins_given_mode.threshold_ratio[k] * scale, is_real)
        p_cross, p_stay = tails.above, tails.below
        if not p_stay > 0.0:
            return PdAndMiss(1.0, 0.0)
        if p_cross < _RARE_CROSSING_PROBABILITY_MAX or miss * p_cross < negligible_probability:
            # That both of a pair cross is at most as likely.
            pd, miss, previous_p_stay = pd + miss * p_cross, miss * p_stay, -1.0
            continue
        quantile = _rough_upper_normal_quantile(tails)
        conditional_cross, conditional_stay = p_cross, p_stay
        correlation = bins_given_mode.neighbour_noise_correlation[k]
        if previous_p_stay > 0.0 and correlation != 0.0:
            correlation = (
                correlation * correlation + correlation * signal * previous_signal
            ) / math.sqrt((1.0 + signal * signal) * (1.0 + previous_signal * previous_signal))
            p_joint = joint_tail_excess_by_four_nodes(quantile, previous_quantile, correlation)
            p_joint = max(min(p_joint / previous_p_stay, p_cross), -p_stay)
            conditional_cross, conditional_stay = p_cross - p_joint, p_stay + p_joint
        pd += miss * conditional_cross
        miss *= conditional_stay
        previous_p_stay, previous_quantile, previous_signal = p_stay, quantile, signal
    return PdAndMiss(pd if pd < 0.5 else 1.0 - miss, miss)


@njit(cache=True, error_model="numpy", borrows=True)
def _upper_normal_quantile_of_tails(tails):
    """Return the number that a standard normal variable exceeds with the probability ``above``.

    ``above`` is a field of ``tails``, a :class:`.Tails`. The result is computed from the smaller of
    the two tails, for precision.
    """
    if tails.above < tails.below:
        return _upper_normal_quantile(tails.above)
    return -_upper_normal_quantile(tails.below)


@njit(cache=True, error_model="numpy", borrows=True)
def _upper_normal_quantile(probability):
    """Return the number that a standard normal variable exceeds with a probability <= 1/2.

    The returned number errs by about 1e-4.
    """
    if probability < 1e-300:
        return 37.0
    s = math.sqrt(-2.0 * math.log(probability))
    t = s - (2.30753 + 0.27061 * s) / (1.0 + s * (0.99229 + 0.04481 * s))
    tail = 0.5 * math.erfc(t * math.sqrt(0.5))
    slope = math.exp(-0.5 * t * t) / math.sqrt(2.0 * math.pi)
    return t + math.log(tail / probability) * tail / slope


@njit(cache=True, error_model="numpy", borrows=True)
def _rough_upper_normal_quantile(tails):
    """Compute :func:`_upper_normal_quantile_of_tails` with an error of at most 4.5e-4.

    Notes
    -----
    The approximation [1]_ costs a third of :func:`_upper_normal_quantile`. The quadrature over a
    speckle mode makes many calls.

    References
    ----------
    .. [1] M. Abramowitz, I. A. Stegun, "Handbook of Mathematical Functions," 26.2.23, 1964.
    """
    probability = min(tails.above, tails.below)
    if probability < 1e-300:
        quantile = 37.0
    else:
        s = math.sqrt(-2.0 * math.log(probability))
        quantile = s - (2.515517 + s * (0.802853 + s * 0.010328)) / (
            1.0 + s * (1.432788 + s * (0.189269 + s * 0.001308))
        )
    return quantile if tails.above < tails.below else -quantile


@njit(cache=True, error_model="numpy", borrows=True)
def echo_bin_bounds(magnitude, first, last, threshold, lobe_half_width):
    """Return the indices of the first and last bin of the echo around a group of bins.

    A group is a run of adjacent bins at or above the threshold.

    Parameters
    ----------
    magnitude
        (bins,): |X| without noise of adjacent bins.
    first, last
        Indices of the group's first and last bin, which are at or above the threshold.
    threshold
        Threshold on |X|.
    lobe_half_width
        Half-width [bins] of an echo about its lines. With 0 the echo is the group itself.

    Notes
    -----
    The echo has the adjacent bins of at least half the group's largest magnitude, and on either
    side ``lobe_half_width`` more bins, but no bin of another group.
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
def _largest_and_n_above(magnitude, threshold):
    """Return the largest |X| of the bins, and the number of bins at or above the threshold."""
    largest, n_above = magnitude[0], 0
    for i in range(magnitude.size):
        largest = magnitude[i] if magnitude[i] > largest else largest
        n_above += magnitude[i] >= threshold
    return largest, n_above


@njit(cache=True, error_model="numpy", borrows=True)
def _mark_group_exempt(first, last, n_bins, is_exempt):
    """Mark the bins first - 1 .. last + 1 as exempt, clipped to the array; return their number.

    Exempt bins belong to an echo and raise no false alarm. ``n_bins`` is the number of all bins.
    """
    first, last = max(first - 1, 0), min(last + 1, n_bins - 1)
    is_exempt[first : last + 1] = True
    return last - first + 1


class SpectrumDetections(NamedTuple):
    """Results of detection in the noiseless spectra of m points, arrays (m,)."""

    pd: np.ndarray
    """(m,): probability that the echo is detected, 0..1."""
    miss: np.ndarray
    """(m,): probability that the echo is missed, 1 - pd, 0..1."""
    magnitude: np.ndarray
    """(m,): |X| of the strongest bin without noise [V, summed over the record]."""
    frequency: np.ndarray
    """(m,): frequency of the strongest bin [Hz]."""
    n_exempt: np.ndarray
    """(m,): number of bins that belong to the echo and so can raise no false alarm."""
    leakage_probability: np.ndarray
    """(m,): zeros. The probability of a false peak due to leaked signal is not evaluated for these
    spectra."""


@njit(cache=True, error_model="numpy")
def detect_in_spectra(
    magnitude, first_bins, last_bin, bin_width, rule, bin_thresholds, speckle_table
):
    """Compute the detection of the echo in noiseless spectra, one per point, without leakage.

    Parameters
    ----------
    magnitude
        (m, bins): |X| without noise of adjacent bins [V].
    first_bins
        (m,): number of each spectrum's first bin. Bins outside 0 .. ``last_bin`` are ignored.
    last_bin
        Number of the last bin of the spectrum.
    bin_width
        Width of a bin [Hz].
    rule, bin_thresholds, speckle_table
        :class:`DetectionRule`, :class:`BinThresholds` (m,), and a :class:`SpeckleTable` (1, m).

    Returns
    -------
    SpectrumDetections
    """
    n_points = magnitude.shape[0]
    detections = SpectrumDetections(
        np.empty(n_points),
        np.empty(n_points),
        np.empty(n_points),
        np.empty(n_points),
        np.empty(n_points),
        np.zeros(n_points),
    )
    is_exempt = np.empty(magnitude.shape[1], np.bool_)
    for i in range(n_points):
        low = max(-first_bins[i], 0)
        high = min(last_bin + 1 - first_bins[i], magnitude.shape[1])
        searched = magnitude[i, low:high]
        bin_threshold = bin_threshold_of_point(bin_thresholds, i)
        peak, n_exempt = mark_exempt_bins(
            searched,
            searched.size,
            bin_threshold.threshold,
            is_exempt,
            echo_half_width(rule, bin_threshold.pedestal.reach_bins),
        )
        detection = pd_and_miss(
            EchoBins(searched, is_exempt[: searched.size], first_bins[i] + low),
            peak,
            rule,
            bin_threshold,
            bin_speckle_of_point(speckle_table, 0, i),
        )
        detections.pd[i], detections.miss[i] = detection.pd, detection.miss
        detections.magnitude[i] = searched[peak]
        detections.frequency[i] = (first_bins[i] + low + peak) * bin_width
        detections.n_exempt[i] = n_exempt
    return detections
