"""Lines of one segment: frequency, strength and phase of each beamlet's beat.

The beat of a beamlet is a tone at nu bins of fs/N, the sample rate over the FFT size. Its line
appears at nu minus a whole number of FFT lengths, within -N/2 .. N/2. A real record shows the line
and its image at the opposite frequency.

Many close lines are replaced by a few. The spectrum is band-limited as a function of a line's
position. Lines within +-h bins are therefore equivalent to some number J of lines at Chebyshev
nodes, with J about 8 + 1.3 pi h. In the sample of the record at t, -1 .. 1, a series of J terms has
an error of about 2 J_J(pi h t). This is negligible except at the record's ends, where most windows
are small. The window weighs the error.
"""

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.special import gammaln

from sweep.kernel_cache import njit
from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.elementary_functions import (
    double_double_quotient,
    fraction_of_cycle,
    product_cycle_fraction,
    sincos_cycles,
)

AMPLITUDE_TOLERANCES = (
    1e-13, 3e-13, 1e-12, 3e-12, 1e-11, 3e-11, 1e-10, 3e-10, 1e-9, 3e-9, 1e-8, 3e-8, 1e-7, 3e-7,
    1e-6, 3e-6, 1e-5, 3e-5, 1e-4, 3e-4, 1e-3, 3e-3, 1e-2,
)  # fmt: skip
"""Errors for which the necessary number of equivalent lines is tabulated, if amplitudes add. Each
is the error of the lines' summed amplitude, relative to the sum of their magnitudes."""

POWER_TOLERANCES = (
    1e-18, 1e-15, 1e-13, 1e-12, 1e-11, 1e-10, 1e-9, 1e-8, 1e-7, 1e-6, 1e-5, 1e-4, 1e-3
)  # fmt: skip
"""Errors for which the necessary number of equivalent lines is tabulated, if powers add. Each is
the error of the lines' summed power, relative to the sum of their powers. Where the magnitude
should be zero, its error is the square root of the power's error."""

NODES_MAX = 128
"""Maximum number of equivalent lines that replace all lines. Lines that would need more are kept.
"""

NODES_PER_BATCH = 128
"""Size of each section of :attr:`LineScratch.batch`. It is constant, so that the compiler knows
that sections do not overlap."""

LINES_PER_BATCH = 32
"""Number of lines that are processed in one pass of a sum. It is small, because many echoes have
few lines."""

_X, _EVEN, _ODD, _RE, _IM, _LANES = (NODES_PER_BATCH * section for section in range(6))
"""Index of the first element of each section of :attr:`LineScratch.batch`. The sections hold
positions x of lines or nodes, -1 .. 1, and Chebyshev polynomials of even and of odd order at x.
Real and imaginary parts of weights follow, then partial sums."""

BATCH_SCRATCH_SIZE = 6 * NODES_PER_BATCH
"""Number of elements of :attr:`LineScratch.batch`."""

N_SUM_LANES = 8
"""Number of partial sums that are added in parallel. It is fixed, so that the order of additions
does not depend on the machine."""

CHEBYSHEV_NODES = np.zeros((NODES_MAX + 1, NODES_MAX))
"""Chebyshev nodes, -1 .. 1. Row n holds the n nodes of a series of n terms, then zeros."""
for _n in range(1, NODES_MAX + 1):
    CHEBYSHEV_NODES[_n, :_n] = np.cos(np.pi * (np.arange(_n) + 0.5) / _n)


REAL_WITHOUT_IMAGES, REAL_WITH_IMAGES, COMPLEX_RECORD = range(3)
"""Types of spectra. The first two are bins 0 .. N/2 of a real record, without or with the lines'
images at negative frequency. The third is all N bins of a complex record. Its bin numbers may
continue below 0 and above N, the FFT size."""


class SpectrumLayout(NamedTuple):
    """Sizes of a spectrum, and of the line-shape table from which the spectrum is computed."""

    fft_size: int
    """FFT size N, the number of samples after zero padding."""
    record_length: int
    """Number of samples of the record. For an echo that arrives late, it is the number of samples
    with the echo.
    """
    table_half_width_bins: int
    """Number of FFT bins that the line-shape table holds on each side of a line."""
    cells_per_bin: int
    """Number of line-shape table cells in an FFT bin."""
    adds_powers: bool
    """True if the beamlets' powers add in the spectrum, False if their amplitudes do."""
    holds_all_bins: bool
    """True if the line-shape table holds all bins of the spectrum."""
    clearance_bins: int
    """Distance from a line [FFT bins] beyond which the record's two ends determine the line's
    spectrum.
    """
    spectrum_type: int = REAL_WITH_IMAGES
    """Type of spectrum: REAL_WITHOUT_IMAGES, REAL_WITH_IMAGES or COMPLEX_RECORD."""


class LineArrays(NamedTuple):
    """Positions and complex weights of lines, one element per line; arrays may be longer."""

    position: np.ndarray
    """Frequency of each line [FFT bins from the origin bin]."""
    re: np.ndarray
    """Real part of the line's complex amplitude [V]; its squared magnitude if powers add."""
    im: np.ndarray
    """Imaginary part of the line's complex amplitude [V]; 0 if powers add."""


class LineScratch(NamedTuple):
    """Scratch arrays for sums over lines."""

    batch: np.ndarray
    """(BATCH_SCRATCH_SIZE,): sections for the lines of one pass, or for the Chebyshev nodes."""
    moment_re: np.ndarray
    """(NODES_MAX + 1,) or more: real part of sum_b C_b T_j(x_b), by order j of the Chebyshev
    polynomial T_j. Line b has the weight C_b and the position x_b.
    """
    moment_im: np.ndarray
    """(NODES_MAX + 1,) or more: imaginary part of sum_b C_b T_j(x_b), by order j of the Chebyshev
    polynomial T_j. Line b has the weight C_b and the position x_b.
    """


class LineSummary(NamedTuple):
    """Sums of the lines' weights, and their lowest and highest frequency."""

    magnitude_sum: float
    """Sum of the lines' amplitudes [V], or an upper bound of it; the sum of powers [V^2] if powers
    add."""
    power_sum: float
    """Sum of the lines' powers [V^2]; the sum of squared powers [V^4] if powers add."""
    lowest_position: float
    """Lowest line frequency [FFT bins from the origin bin]."""
    highest_position: float
    """Highest line frequency [FFT bins from the origin bin]."""


class BeamletArrays(NamedTuple):
    """Range, Doppler ratio and amplitude of all beamlets, relative to the beam's axis."""

    relative_range_offset: np.ndarray
    """(footprints, beamlets): range of the beamlet minus that on the axis, over the range on the
    axis."""
    doppler_ratio_offset: np.ndarray
    """(footprints, beamlets): Doppler ratio 2 v_r / c of the beamlet minus that on the axis."""
    relative_amplitude: np.ndarray
    """(footprints, beamlets): amplitude of the beamlet's beat, over that of a single line on the
    axis.
    """
    phase_cycles: np.ndarray
    """(segments, footprints, beamlets): random phase of each beamlet's beat [cycles]. The shape is
    (0, footprints, beamlets) if there are no random phases.
    """


class PointParameters(NamedTuple):
    """Parameters of points that all segments share, (n,) each."""

    range: np.ndarray
    """Range along the beam's axis at the start of the shot [m]."""
    doppler_ratio: np.ndarray
    """Doppler ratio 2 v_r / c at the start of the shot, with the radial velocity v_r."""
    chirp_rate: np.ndarray
    """Chirp rate of the up-chirp [Hz/s], positive."""
    beat_amplitude_scale: np.ndarray
    """Amplitude [V] of the beat at the ADC for a line of relative amplitude 1."""
    detector_bandwidth: np.ndarray
    """3 dB bandwidth of the detector's single-pole low-pass [Hz]."""
    amplifier_bandwidth: np.ndarray
    """3 dB bandwidth of the amplifier's single-pole low-pass [Hz]."""
    sample_rate: np.ndarray
    """Sample rate of the record [Hz]."""
    record_start: np.ndarray
    """Time from the start of a segment to the first sample of its record [s]."""
    up_carrier: np.ndarray
    """Optical frequency at the start of the up segment [Hz]. Times a delay, it gives the echo's
    phase [cycles]."""
    down_carrier: np.ndarray
    """Optical frequency at the start of the down segment [Hz]. Times a delay, it gives the echo's
    phase [cycles]."""
    noise_sigma: np.ndarray
    """Noise standard deviation per quadrature in a bin [V, summed over the record]."""
    threshold: np.ndarray
    """Detection threshold on a bin's magnitude [V, summed over the record]."""
    negligible_signal_ratio: np.ndarray
    """Signal magnitude over ``noise_sigma`` below which a bin counts as noise alone."""
    line_noise_sigma: np.ndarray
    """Noise standard deviation per quadrature in bins that contain lines [V, summed over the
    record]. It includes the part of the laser's phase-noise pedestal that changes the magnitude.
    """
    leakage_tolerance: np.ndarray
    """Leakage that may be neglected [probability of at least one false alarm]."""
    line_error_tolerance: np.ndarray
    """Largest allowed error of a bin's magnitude due to approximations of lines, over
    ``noise_sigma``."""
    image_gain: np.ndarray
    """Amplitude of the image that I/Q imbalance makes of a line, over that of the line; 0 if there
    is no image."""
    noise_sigma_next_to_lines: np.ndarray
    """Noise standard deviation per quadrature in bins next to the lines [V, summed over the
    record]. It includes the whole phase-noise pedestal of the laser.
    """
    pedestal_reach_bins: np.ndarray
    """Distance from the lines [FFT bins] up to which the laser's phase-noise pedestal counts as
    echo.
    """
    pedestal_line_width_bins: np.ndarray
    """Line width of the laser [FFT bins]."""
    pedestal_delay_bin_width_product: np.ndarray
    """Delay of the echo times the bin width fs/N, with the sample rate fs and the FFT size N.
    Delays longer than the record count as its duration."""


class SegmentParameters(NamedTuple):
    """Parameters of the segments of points, (segments, n) each."""

    chirp_rate: np.ndarray
    """Signed chirp rate of the segment [Hz/s]."""
    carrier: np.ndarray
    """Optical frequency at the segment's start [Hz]. Times a delay, it gives the echo's phase
    [cycles]."""
    whitening_gain: np.ndarray
    """Factor on the signal's amplitude in the spectrum whose noise is whitened."""
    range_decrease_since_shot_start: np.ndarray
    """Decrease of the range from the start of the shot to that of the segment [m]."""
    doppler_ratio: np.ndarray
    """Doppler ratio 2 v_r / c at the start of the segment, with the radial velocity v_r."""
    start_time: np.ndarray
    """Time from the start of the shot to that of the segment [s]."""


class BeatParameters(NamedTuple):
    """Parameters of one point and segment from which the beamlets' beats are computed."""

    range: float
    """Range along the beam's axis at the start of the shot [m]."""
    range_decrease_since_shot_start: float
    """Decrease of the range from the start of the shot to that of the segment [m]."""
    doppler_ratio: float
    """Doppler ratio 2 v_r / c at the start of the segment, with the radial velocity v_r."""
    start_time: float
    """Time from the start of the shot to that of the segment [s]."""
    chirp_rate: float
    """Signed chirp rate of the segment [Hz/s]."""
    carrier: float
    """Optical frequency at the segment's start [Hz]. Times a delay, it gives the echo's phase
    [cycles]."""
    amplitude: float
    """Amplitude [V] of the beat of a line of relative amplitude 1, in the whitened spectrum."""
    detector_bandwidth: float
    """3 dB bandwidth of the detector's single-pole low-pass [Hz]."""
    amplifier_bandwidth: float
    """3 dB bandwidth of the amplifier's single-pole low-pass [Hz]."""
    sample_rate: float
    """Sample rate of the record [Hz]."""
    record_start: float
    """Time from the start of the segment to the first sample that contains the echo [s]."""


@njit(cache=True, error_model="numpy", borrows=True, forceinline=True)
def beat_parameters_at(point_parameters, segment_parameters, segment, point):
    """Return the parameters of one segment of one point from which its beats are computed.

    Parameters
    ----------
    point_parameters : PointParameters
        Parameters of n points that all segments share (:class:`PointParameters`).
    segment_parameters : SegmentParameters
        Parameters (segments, n) of the points' segments (:class:`SegmentParameters`).
    segment : int
        Index of the segment: 0 up, 1 Doppler, 2 down.
    point : int
        Index of the point.

    Returns
    -------
    BeatParameters
        Parameters; the amplitude [V] is the beat's at the ADC times the whitening gain.
    """
    return BeatParameters(
        point_parameters.range[point],
        segment_parameters.range_decrease_since_shot_start[segment, point],
        segment_parameters.doppler_ratio[segment, point],
        segment_parameters.start_time[segment, point],
        segment_parameters.chirp_rate[segment, point],
        segment_parameters.carrier[segment, point],
        point_parameters.beat_amplitude_scale[point]
        * segment_parameters.whitening_gain[segment, point],
        point_parameters.detector_bandwidth[point],
        point_parameters.amplifier_bandwidth[point],
        point_parameters.sample_rate[point],
        point_parameters.record_start[point],
    )


@lru_cache(maxsize=32)
def phase_span_max_table(weights: tuple[float, ...], tolerances: tuple[float, ...]) -> np.ndarray:
    """Tabulate how wide a group of lines may be so that J equivalent lines meet each tolerance.

    The width is the half-width h [bins of fs/L] times pi, a phase [rad] at the record's end.

    Parameters
    ----------
    weights
        Weights, of sum 1, of equidistant positions t in the record, from its middle (0) to its
        end (1), both included.
    tolerances
        Errors of the sum over lines, relative to the sum of their magnitudes, in rising order.

    Returns
    -------
    numpy.ndarray
        (tolerances, NODES_MAX + 1): pi h by number of nodes J = 1 .. NODES_MAX. Column 0 holds the
        tolerances.
    """
    n_nodes, targets = np.arange(1, NODES_MAX + 1), np.array(tolerances)[:, None]
    low, high = np.full((len(tolerances), n_nodes.size), -60.0), np.log(2.0 * n_nodes) + 0 * targets
    for _ in range(24):  # to 4e-6, on the side that serves
        middle = (low + high) / 2
        is_sufficient = _chebyshev_truncation_bound(middle, n_nodes, np.array(weights)) < targets
        low, high = np.where(is_sufficient, middle, low), np.where(is_sufficient, high, middle)
    return np.concatenate([targets, np.exp(low)], axis=1)


def _chebyshev_truncation_bound(
    log_z: np.ndarray, n_terms: np.ndarray, weights: np.ndarray
) -> np.ndarray:
    """Return a bound on the remainder of a Chebyshev series of exp(i z x t) after J terms.

    x is the position of a line, -1 .. 1, and t the time in the record, 0 .. 1. The arguments are
    ``log_z`` = ln z, below ln 2 J, ``n_terms`` = J, and the weights of equidistant times. With the
    Bessel function J_m, the remainder is the weighted mean over t of 2 sum_{m >= J} |J_m(z t)|. Its
    bound follows from J_m(x) <= (x/2)^m / m! exp(-x^2 / (4 m + 4)). The result has the shape to
    which ``log_z`` and ``n_terms`` broadcast.
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
def compute_lines(
    beat, segment, beamlets, footprint_row, layout, lines, inverse_gain_re, inverse_gain_im
):
    """Compute the positions and the complex weights of a segment's lines.

    Parameters
    ----------
    beat
        :class:`BeatParameters` of the segment.
    segment
        Index of the segment: 0 up, 1 Doppler, 2 down.
    beamlets
        :class:`BeamletArrays`.
    footprint_row
        Row of the footprint in ``beamlets``.
    layout
        :class:`SpectrumLayout`.
    lines
        Output, :class:`LineArrays`.
    inverse_gain_re, inverse_gain_im
        Scratch arrays, (lines,): the receiver's gain is 1 / (re + i im).

    Returns
    -------
    origin_bin
        Bin nearest to the line on the beam's axis, -N/2 .. N/2, from which positions count.

    Notes
    -----
    A beamlet of range R and Doppler ratio beta has the beat

        f = carrier beta - S (2 R / c) (1 + beta)

    with the signed chirp rate S. The weight C_b of line b is half the amplitude of its beat, in a
    spectrum whose noise is white. It includes the two poles of the receiver, and the phase in the
    middle of the record. If powers add, the weight is |C_b|^2.
    """
    fft_size, record_length = layout.fft_size, layout.record_length
    range_0 = beat.range - beat.range_decrease_since_shot_start
    range_per_doppler = 0.5 * SPEED_OF_LIGHT * beat.start_time
    bins_per_hertz = fft_size / beat.sample_rate
    hertz_per_metre = beat.chirp_rate * (2.0 / SPEED_OF_LIGHT)
    centre_frequency = beat.carrier * beat.doppler_ratio - (
        hertz_per_metre * (1.0 + beat.doppler_ratio) * range_0
    )
    centre_position = centre_frequency * bins_per_hertz
    folding_shift = math.floor(centre_position / fft_size + 0.5) * fft_size
    origin_bin = math.floor(centre_position - folding_shift + 0.5)
    centre_offset = centre_position - folding_shift - origin_bin
    pole_product = 1.0 / (beat.detector_bandwidth * beat.amplifier_bandwidth)
    pole_sum = 1.0 / beat.detector_bandwidth + 1.0 / beat.amplifier_bandwidth
    cycles_per_metre_high, cycles_per_metre_low = double_double_quotient(
        2.0 * beat.carrier, SPEED_OF_LIGHT
    )
    axis_phase = -product_cycle_fraction(
        cycles_per_metre_high, cycles_per_metre_low, beat.range
    ) + fraction_of_cycle(centre_frequency * beat.record_start)
    axis_phase += product_cycle_fraction(
        cycles_per_metre_high, cycles_per_metre_low, beat.range_decrease_since_shot_start
    )
    half_record_ratio = 0.5 * (record_length / fft_size)
    origin_phase = (record_length * origin_bin % (2 * fft_size)) / (2.0 * fft_size)
    n_lines = beamlets.relative_range_offset.shape[1]
    for line in range(n_lines):
        doppler_offset = beamlets.doppler_ratio_offset[footprint_row, line]
        range_offset = (
            beat.range * beamlets.relative_range_offset[footprint_row, line]
            - range_per_doppler * doppler_offset
        )
        doppler_path = (1.0 + beat.doppler_ratio) * range_offset + (
            range_0 + range_offset
        ) * doppler_offset
        beat_offset = beat.carrier * doppler_offset - hertz_per_metre * doppler_path
        frequency = centre_frequency + beat_offset
        lines.position[line] = centre_offset + beat_offset * bins_per_hertz
        inverse_gain_re[line] = 1.0 - frequency * frequency * pole_product
        inverse_gain_im[line] = frequency * pole_sum
    if layout.adds_powers:
        for line in range(n_lines):
            gain_re, gain_im = inverse_gain_re[line], inverse_gain_im[line]
            weight = 0.5 * beat.amplitude * beamlets.relative_amplitude[footprint_row, line]
            lines.re[line] = weight * weight / (gain_re * gain_re + gain_im * gain_im)
            lines.im[line] = 0.0
        return origin_bin
    half_chirp_rate, cycles_per_bin = 0.5 * beat.chirp_rate, beat.record_start / bins_per_hertz
    for line in range(n_lines):  # phases in the middle of the record [cycles], stored in lines.re
        range_offset = (
            beat.range * beamlets.relative_range_offset[footprint_row, line]
            - range_per_doppler * beamlets.doppler_ratio_offset[footprint_row, line]
        )
        delay = (range_0 + range_offset) * (2.0 / SPEED_OF_LIGHT)
        phase = axis_phase - product_cycle_fraction(
            cycles_per_metre_high, cycles_per_metre_low, range_offset
        )
        phase += fraction_of_cycle(half_chirp_rate * delay * delay)
        lines.re[line] = (
            phase
            + (lines.position[line] - centre_offset) * cycles_per_bin
            + half_record_ratio * lines.position[line]
        )
    if beamlets.phase_cycles.shape[0] > 0:
        for line in range(n_lines):
            lines.re[line] += beamlets.phase_cycles[segment, footprint_row, line]
    for line in range(n_lines):
        sine, cosine = sincos_cycles(lines.re[line] + origin_phase)
        gain_re, gain_im = inverse_gain_re[line], inverse_gain_im[line]
        weight = (
            0.5
            * beat.amplitude
            * beamlets.relative_amplitude[footprint_row, line]
            / (gain_re * gain_re + gain_im * gain_im)
        )
        lines.re[line] = weight * (cosine * gain_re + sine * gain_im)
        lines.im[line] = weight * (sine * gain_re - cosine * gain_im)
    return origin_bin


@njit(cache=True, error_model="numpy", borrows=True)
def add_image_lines(lines, n_lines, origin_bin, image_gain, adds_powers):
    """Append images of lines at the opposite frequencies; return the number of lines and images.

    A line at the frequency f with the weight C has an image at -f with the weight g conj(C), for
    the image gain g. If powers add, the weight |C|^2 becomes g^2 |C|^2.

    Parameters
    ----------
    lines : LineArrays
        Lines, in arrays with room for twice as many (:class:`LineArrays`). Images follow the lines.
    n_lines : int
        Number of lines.
    origin_bin : int
        Bin from which positions are counted, -N/2 .. N/2 with the FFT size N.
    image_gain : float
        Amplitude g of an image over that of its line.
    adds_powers : bool
        True if powers of lines add, False if amplitudes do.

    Returns
    -------
    int
        Number of lines and images, 2 ``n_lines``.
    """
    for line in range(n_lines):
        lines.position[n_lines + line] = -2.0 * origin_bin - lines.position[line]
        lines.re[n_lines + line] = lines.re[line] * (
            image_gain * image_gain if adds_powers else image_gain
        )
        lines.im[n_lines + line] = -lines.im[line] * image_gain
    return 2 * n_lines


@njit(cache=True, error_model="numpy", borrows=True)
def fold_lines(lines, n_lines, layout):
    """Shift lines by whole FFT lengths, to positions within half an FFT length of the origin.

    Phases refer to the middle of the record. A shift by p FFT lengths therefore multiplies the
    weight by (-1)^(p L), with L samples in the record, unless powers add.

    Parameters
    ----------
    lines : LineArrays
        Lines, which are changed (:class:`LineArrays`).
    n_lines : int
        Number of lines.
    layout : SpectrumLayout
        Sizes of the spectrum (:class:`SpectrumLayout`).
    """
    for line in range(n_lines):
        n_folds = math.floor(lines.position[line] / layout.fft_size + 0.5)
        lines.position[line] -= n_folds * layout.fft_size
        # Phases count from the middle of the record.
        if n_folds & 1 and layout.record_length & 1 and not layout.adds_powers:
            lines.re[line], lines.im[line] = -lines.re[line], -lines.im[line]


@njit(cache=True, error_model="numpy", borrows=True)
def summarise_lines(lines, n_lines, adds_powers, batch):
    """Compute sums of the lines' weights, and their lowest and highest frequency.

    If amplitudes add, ``magnitude_sum`` is an upper bound by Cauchy and Schwarz of the sum of |C_b|
    over the n lines b of weights C_b: sqrt(n sum |C_b|^2). Where the sum of squares is below
    1e-250, the bound is the sum of |Re C_b| + |Im C_b|.

    Parameters
    ----------
    lines : LineArrays
        Lines (:class:`LineArrays`).
    n_lines : int
        Number n of lines, at least 1.
    adds_powers : bool
        True if powers of lines add, False if amplitudes do.
    batch : ndarray (BATCH_SCRATCH_SIZE,)
        Scratch, :attr:`LineScratch.batch`.

    Returns
    -------
    LineSummary
        Sums [V, V^2], or of powers and their squares [V^2, V^4] if powers add, and frequencies
        [bins].
    """
    lowest_position, highest_position = lines.position[0], lines.position[0]
    magnitude_sum, power_sum = 0.0, 0.0
    for start in range(0, n_lines, LINES_PER_BATCH):
        n_batch = min(LINES_PER_BATCH, n_lines - start)
        for i in range(n_batch):
            re, im = lines.re[start + i], lines.im[start + i]
            batch[_X + i], batch[_RE + i] = lines.position[start + i], re * re + im * im
            batch[_IM + i] = abs(re) + abs(im)
        for i in range(n_batch, LINES_PER_BATCH):
            batch[_X + i] = lines.position[start]
            batch[_RE + i], batch[_IM + i] = 0.0, 0.0
        for i in range(N_SUM_LANES):
            a, b = 0.0, 0.0
            for k in range(LINES_PER_BATCH // N_SUM_LANES):
                a += batch[_IM + N_SUM_LANES * k + i]
                b += batch[_RE + N_SUM_LANES * k + i]
            batch[_LANES + i], batch[_LANES + N_SUM_LANES + i] = a, b
        for i in range(N_SUM_LANES):
            magnitude_sum += batch[_LANES + i]
            power_sum += batch[_LANES + N_SUM_LANES + i]
        for i in range(N_SUM_LANES):
            c, d = batch[_X + i], batch[_X + i]
            for k in range(LINES_PER_BATCH // N_SUM_LANES):
                c = min(c, batch[_X + N_SUM_LANES * k + i])
                d = max(d, batch[_X + N_SUM_LANES * k + i])
            batch[_LANES + 2 * N_SUM_LANES + i], batch[_LANES + 3 * N_SUM_LANES + i] = c, d
        for i in range(N_SUM_LANES):
            lowest_position = min(lowest_position, batch[_LANES + 2 * N_SUM_LANES + i])
            highest_position = max(highest_position, batch[_LANES + 3 * N_SUM_LANES + i])
    if not adds_powers and power_sum > 1e-250:  # smaller sums lose their digits when squared
        magnitude_sum = math.sqrt(n_lines * power_sum)
    return LineSummary(magnitude_sum, power_sum, lowest_position, highest_position)


@njit(cache=True, error_model="numpy", borrows=True)
def allowed_relative_error(summary, n_lines, adds_powers, window_sum, bin_error_allowed, threshold):
    """Return the tolerated error of replacing lines, relative to the largest possible peak.

    Parameters
    ----------
    summary
        :class:`LineSummary` of the lines.
    n_lines
        Number n of lines.
    adds_powers
        True if powers of lines add, False if amplitudes do.
    window_sum
        Sum of the window's samples.
    bin_error_allowed
        Error allowed of |X| in a bin [V, summed over the record].
    threshold
        Threshold on |X| [V, summed over the record].

    Notes
    -----
    If powers add, the peak is at most sqrt(n sum |C_b|^4), which is about 1.3 times the sum of
    |C_b|^2 over the profile of a beam. If amplitudes add, the peak depends on their phases.
    3 sqrt(sum |C_b|^2) is exceeded by one of 10^4 random sums, and lines in phase exceed a tenth of
    their sum.

    If powers add, the error of |X|^2 follows from that of |X| in a bin at the threshold, or at half
    the largest possible |X| if that is less. Larger bins may have larger errors, and smaller bins
    decide nothing.
    """
    root_n_lines = math.sqrt(n_lines)
    line_sum = summary.magnitude_sum
    if summary.power_sum > 1e-250:  # smaller sums lose their digits when squared
        growth = root_n_lines if adds_powers else min(root_n_lines, max(3.0, 0.1 * root_n_lines))
        line_sum = math.sqrt(summary.power_sum) * growth
    if not adds_powers:
        return bin_error_allowed / max(window_sum * line_sum, 1e-300)
    peak_power = max(window_sum * window_sum * line_sum, 1e-300)
    return bin_error_allowed * min(threshold, 0.5 * math.sqrt(peak_power)) / peak_power


@njit(cache=True, error_model="numpy", borrows=True)
def n_required_nodes(phase_span, tolerance, phase_span_max_table):
    """Return the number of equivalent lines that represent a group of lines to a tolerance.

    Parameters
    ----------
    phase_span : float
        Phase of the outermost line at the record's end [rad]: pi h for lines within +-h bins of
        fs/L, with the sample rate fs and L samples; 2 pi h if powers add.
    tolerance : float
        Error of the sum over lines, relative to the sum of their magnitudes.
    phase_span_max_table : ndarray (tolerances, NODES_MAX + 1)
        Table of :func:`phase_span_max_table`. The row of the largest tolerance up to ``tolerance``
        is used, or the first row if all tolerances are larger.

    Returns
    -------
    int
        Number of equivalent lines, 1 .. NODES_MAX, or NODES_MAX + 1 if no number is sufficient.
    """
    limit_row = phase_span_max_table.shape[0] - 1
    while limit_row > 0 and phase_span_max_table[limit_row, 0] > tolerance:
        limit_row -= 1
    n_nodes = 1
    while (
        n_nodes < phase_span_max_table.shape[1]
        and phase_span_max_table[limit_row, n_nodes] < phase_span
    ):
        n_nodes += 1
    return n_nodes


@njit(cache=True, error_model="numpy", borrows=True)
def replace_lines_by_nodes(lines, n_lines, n_nodes, middle, half_width, scratch, nodes):
    """Replace lines by equivalent lines at Chebyshev nodes, if the nodes are fewer than the lines.

    Parameters
    ----------
    lines, n_lines
        :class:`LineArrays`, and the number of lines in it.
    n_nodes
        Number of nodes; with ``n_lines`` or more, or more than NODES_MAX, lines are copied as they
        are.
    middle, half_width
        Middle and half-width of the interval that contains the lines [bins].
    scratch
        :class:`LineScratch`.
    nodes
        Output, :class:`LineArrays`.

    Returns
    -------
    n_nodes
        Number of lines in ``nodes``.
    """
    if n_nodes >= n_lines or n_nodes > NODES_MAX:
        for line in range(n_lines):
            nodes.position[line] = lines.position[line]
            nodes.re[line], nodes.im[line] = lines.re[line], lines.im[line]
        return n_lines
    batch = scratch.batch
    inverse_half_width = 1.0 / half_width if half_width > 0.0 else 0.0
    for j in range(n_nodes + 1):
        scratch.moment_re[j], scratch.moment_im[j] = 0.0, 0.0
    for start in range(0, n_lines, LINES_PER_BATCH):
        n_batch = min(LINES_PER_BATCH, n_lines - start)
        for i in range(n_batch):
            batch[_X + i] = (lines.position[start + i] - middle) * inverse_half_width
            batch[_RE + i] = lines.re[start + i]
            batch[_IM + i] = lines.im[start + i]
        for i in range(n_batch, LINES_PER_BATCH):
            batch[_X + i], batch[_RE + i], batch[_IM + i] = 0.0, 0.0, 0.0
        _add_chebyshev_moments(scratch, n_nodes)
    for i in range(n_nodes):
        batch[_X + i] = CHEBYSHEV_NODES[n_nodes, i]
        batch[_EVEN + i], batch[_ODD + i] = 1.0, CHEBYSHEV_NODES[n_nodes, i]
        batch[_RE + i], batch[_IM + i] = 0.0, 0.0
    for j in range(n_nodes):
        factor = (1.0 if j == 0 else 2.0) / n_nodes
        moment_re, moment_im = factor * scratch.moment_re[j], factor * scratch.moment_im[j]
        for i in range(n_nodes):
            polynomial, next_polynomial = batch[_EVEN + i], batch[_ODD + i]
            batch[_RE + i] += polynomial * moment_re
            batch[_IM + i] += polynomial * moment_im
            batch[_EVEN + i] = next_polynomial
            batch[_ODD + i] = 2.0 * batch[_X + i] * next_polynomial - polynomial
    for i in range(n_nodes):
        nodes.position[i] = middle + half_width * batch[_X + i]
        nodes.re[i], nodes.im[i] = batch[_RE + i], batch[_IM + i]
    return n_nodes


@njit(cache=True, error_model="numpy", borrows=True)
def _add_chebyshev_moments(scratch, n_nodes):
    """Add the Chebyshev moments of one batch of lines to those in ``scratch``.

    The moments are sum_b C_b T_j(x_b), j = 0 .. n_nodes. Line b has the complex amplitude C_b, or
    the power, and the position x_b, -1..1 over the interval of the nodes. T_j is the Chebyshev
    polynomial of order j.
    """
    batch = scratch.batch
    for i in range(LINES_PER_BATCH):
        batch[_EVEN + i] = 1.0
        batch[_ODD + i] = batch[_X + i]
    for j in range(0, n_nodes, 2):
        for i in range(N_SUM_LANES):
            a, b, c, d = 0.0, 0.0, 0.0, 0.0
            for k in range(LINES_PER_BATCH // N_SUM_LANES):
                re, im = batch[_RE + N_SUM_LANES * k + i], batch[_IM + N_SUM_LANES * k + i]
                even, odd = batch[_EVEN + N_SUM_LANES * k + i], batch[_ODD + N_SUM_LANES * k + i]
                a += re * even
                b += re * odd
                c += im * even
                d += im * odd
            batch[_LANES + i], batch[_LANES + N_SUM_LANES + i] = a, b
            batch[_LANES + 2 * N_SUM_LANES + i], batch[_LANES + 3 * N_SUM_LANES + i] = c, d
        a, b, c, d = 0.0, 0.0, 0.0, 0.0
        for i in range(N_SUM_LANES):
            a += batch[_LANES + i]
            b += batch[_LANES + N_SUM_LANES + i]
            c += batch[_LANES + 2 * N_SUM_LANES + i]
            d += batch[_LANES + 3 * N_SUM_LANES + i]
        scratch.moment_re[j] += a
        scratch.moment_re[j + 1] += b
        scratch.moment_im[j] += c
        scratch.moment_im[j + 1] += d
        for i in range(LINES_PER_BATCH):
            twice = 2.0 * batch[_X + i]
            even = twice * batch[_ODD + i] - batch[_EVEN + i]
            batch[_EVEN + i] = even
            batch[_ODD + i] = twice * even - batch[_ODD + i]
