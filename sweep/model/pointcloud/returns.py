"""Returns of footprints with several surfaces, draw by draw.

:func:`draw_returns` draws which groups of bins (:mod:`sweep.model.pointcloud.bin_groups`) are
detected. It adds false peaks, pairs the peaks (:mod:`sweep.model.pointcloud.pairing`), and reports
range and radial velocity, by whole bins and interpolated between bins.

The two methods of drawing are those of :mod:`sweep.model.sampling.draws`, with the same random
numbers. The strongest group is detected in exactly the draws that are counted there, and so are
false alarms of noise. With ``probabilities`` peaks stay in their noiseless bins, and the
interpolated position has a normal error of the reported standard error. ``noise`` is added to all
bins of a group's echo, or, if only the strongest bin detects, to that bin and its two neighbours. A
neighbour may then be the largest bin.

Ranges and velocities are those at the shot's start, as the truth is. Motion within a record (range
walk) shifts the interpolated range. Motion between segments shifts range and velocity. The measured
velocity corrects both. The beats contain no information on the acceleration, or on ground that
slides under the beam. The instrument's known motion corrects the points for both
(:mod:`sweep.model.pointcloud.ego_motion`). If segments have slopes other than 1, 0 and -1, a return
is the fit of all its peaks.

Echoes in developed speckle have the amplitudes that the lines of their footprint make in a draw, in
the bins about a group's strongest bin of all three segments
(:mod:`sweep.model.sampling.speckle_lines`). Their positions wander with the speckle. Both methods
add noise to the bins, and the peak follows from the sum. With ``noise`` the bins detect by their
magnitudes. With ``probabilities`` the strongest bin's amplitude is compared with the level that it
exceeds with the group's probability. All three segments are drawn together, by the same law as
grids' closed forms. Draws of grids have other speckle.

Standard errors are the root sum of squares of two errors. The first is that of noise. The second is
that by the spread of the lines in a group
(:func:`sweep.model.detection.sub_bin_interpolation.line_spread_error`), or, in developed speckle,
by the speckle (:func:`sweep.model.sampling.speckle_lines.position_error_moments`). If both chirps
have the same speckle, it shifts their beats as a change of range does, and hardly changes
velocities.

Noise alone makes at most one false peak in a segment and draw, the largest. Its bin is any of the
searched bins outside the listed groups, with equal probability. False peaks of leaked signal are in
the bins of that signal; if there are many, only the strongest count. They are drawn by the noise of
the bins, or with ``probabilities`` by the bins' probabilities
(:mod:`sweep.model.pointcloud.leaked_peaks`). Groups too weak to be listed are neither detected nor
false alarms.
"""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from sweep.kernel_cache import njit
from sweep.model import waveform
from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.detection.bin_noise import noise_filter
from sweep.model.detection.detection_probability import (
    down_pd_given_up_result,
    joint_detection_probability,
    mean_n_detection_equivalent_bins,
)
from sweep.model.detection.echo_detection import (
    BinThresholds,
    SpeckleMixing,
    bin_threshold_of_point,
    echo_bin_bounds,
    fill_pedestal_ratios,
    is_real_bin,
    pd_of_any_independent_bin,
    pd_of_one_independent_bin,
    pd_of_one_independent_bin_kernel,
    speckle_mixing_of_point,
)
from sweep.model.detection.estimators import RangeVelocityDeviation, range_velocity_deviation
from sweep.model.detection.hoyt import hoyt_tails, pseudo_variance_ratio_at
from sweep.model.detection.looks import COMBINE_BINARY
from sweep.model.detection.marcum import at_least_one_probability
from sweep.model.detection.pseudo_variance import noise_pseudo_variance_ratio
from sweep.model.detection.sub_bin_interpolation import (
    drift_error,
    estimate_sub_bin_offset,
    interpolator,
    late_echo_correction,
    line_spread_error,
    sub_bin_standard_error,
)
from sweep.model.evaluation import fit_range_velocity_to_peaks
from sweep.model.kernel_integers import INTEGER_ZERO, NO_INDEX, THREE_BINS
from sweep.model.pointcloud.bin_groups import BinGroups
from sweep.model.pointcloud.ego_motion import EgoMotion
from sweep.model.pointcloud.leaked_peaks import (
    LeakageBins,
    bins_without_noise_peaks,
    draw_leaked_peaks,
    find_leaking_points,
    find_segments_with_raised_bins,
    insert_peak,
    iter_leakage_bins,
)
from sweep.model.pointcloud.pairing import (
    CONFIRMATION_TOLERANCE_BINS,
    FALSE_PEAK_GROUP,
    MISREAD_FLAG,
    NO_PEAK_GROUP,
    TRUE_RETURN_FLAG,
    UNCONFIRMED_FLAG,
    DopplerPrediction,
    PeakPairs,
    compare_return_with_truth,
    pair_peaks,
)
from sweep.model.preparation import Shots
from sweep.model.sampling import philox
from sweep.model.sampling.draws import (
    ECHO_NOISE_FIRST_RANDOM_INDEX,
    NoiseFilter,
    NoiselessSpectra,
    NoiseScratch,
    draw_bin_noise,
    draw_bin_noise_by_root,
    iter_noiseless_spectra,
    make_echo_noise_filter,
    noise_covariance_root,
    noise_maximum_at_probability,
    speckle_amplitudes,
    threshold_and_line_noise_ratios,
)
from sweep.model.sampling.speckle_lines import (
    CHIRP_PAIRS_WITH_SELF,
    FACTORED_BINS_MAX,
    LOOK_DRAW_STRIDE,
    SEGMENT_PAIRS_WITH_SELF,
    SpeckleLineGrid,
    SpecklePeaks,
    draw_bin_amplitudes,
    draw_factored_amplitudes,
    factor_bin_covariance,
    fill_mean_bin_powers,
    folding_signs,
    interpolate_transform,
    position_error_moments,
    speckle_line_grid,
)
from sweep.model.spectrum.search_restriction import beamlet_line_positions

DRAWN_INDEPENDENT_BINS_MAX = 32.0
"""Largest equivalent number of independent bins that is used to draw an echo in developed speckle.
Larger numbers are replaced by it."""

BIN_ROUNDING_VARIANCE = 1 / 12
"""Variance [bins^2] of the error of a position that is rounded to whole bins."""

CORRELATED_LOOKS_MAX = 32
"""Largest number of looks (records of a segment) for which partly correlated speckle is drawn in
each look. With more looks, one drawn amplitude is compared with the probability of detection."""


class Peak(NamedTuple):
    """Peak of one segment in one draw."""

    bin: float
    """Number of the peak's largest bin; nan for no peak."""
    position: float
    """Position of the peak, interpolated between bins [bins]."""
    position_error: float
    """Standard error of ``position`` due to noise and to the spread of the footprint's lines
    [bins]."""
    magnitude_ratio: float
    """|X| of the largest bin over sigma, the noise of a bin per quadrature."""


UNDETECTED_PEAK = Peak(math.nan, math.nan, math.nan, math.nan)
""":class:`Peak` that stands for an undetected echo."""


class Peaks(NamedTuple):
    """Peaks of segments in arrays of equal shape; nan for no peak."""

    bin: np.ndarray
    """(...): number of each peak's largest bin; nan for no peak."""
    position: np.ndarray
    """(...): position of each peak, interpolated between bins [bins]."""
    position_error: np.ndarray
    """(...): standard error of ``position`` due to noise and to the spread of the footprint's lines
    [bins]."""
    magnitude_ratio: np.ndarray
    """(...): |X| of each peak's largest bin over sigma, the noise of a bin per quadrature."""

    @classmethod
    def empty(cls, shape: tuple[int, ...]) -> "Peaks":
        """Return a record of a given shape whose values (nan) mark no peaks."""
        return cls(*(np.full(shape, np.nan) for _ in cls._fields))

    def select(self, indices: np.ndarray) -> "Peaks":
        """Return the record of the peaks with the given indices, or where a mask is True."""
        return Peaks(*(values[indices] for values in self))

    @property
    def offset(self) -> np.ndarray:
        """Return ``position`` minus ``bin``, (...) [bins]."""
        return self.position - self.bin


class PeakLists(NamedTuple):
    """Peaks of the three segments in one draw, as they are detected."""

    peaks: Peaks
    """Peaks by segment. Each field of :class:`Peaks` is (3, peaks): up, Doppler, down."""
    group: np.ndarray
    """(3, peaks) int64: index of the echo (group of adjacent bins) to which each peak belongs, or
    FALSE_PEAK_GROUP."""
    n_peaks: np.ndarray
    """(3,) int64: number of listed peaks of the up, Doppler and down segment."""

    @classmethod
    def allocate(cls, peaks_max: int) -> "PeakLists":
        """Return empty lists with room for ``peaks_max`` peaks of each segment."""
        return cls(
            Peaks.empty((3, peaks_max)),
            np.empty((3, peaks_max), np.int64),
            np.zeros(3, np.int64),
        )


class Returns(NamedTuple):
    """Returns (measured points) of each shot and draw, (n, draws, returns); nan without a return.

    Confirmed returns come before unconfirmed ones, stronger up peaks before weaker ones, and a
    false up peak last. Units are those of :data:`sweep.model.outputs.POINT_CLOUD_VARIABLES`. Fields
    with ``_interpolated`` follow from positions between bins. Their errors are those of noise and
    of the spread of the groups' lines. Fields without it follow from whole bins, and their
    errors include rounding, 1/sqrt(12) bin.
    """

    range: np.ndarray
    """Range computed from the whole bins of the peaks [m]."""
    range_interpolated: np.ndarray
    """Range computed from positions of the peaks that are interpolated between bins [m]."""
    radial_velocity: np.ndarray
    """Radial velocity computed from the whole bins of the peaks [m/s], positive when closing."""
    radial_velocity_interpolated: np.ndarray
    """Radial velocity computed from positions of the peaks that are interpolated between bins
    [m/s], positive when closing."""
    range_standard_error: np.ndarray
    """Standard error of ``range`` [m]."""
    range_interpolated_standard_error: np.ndarray
    """Standard error of ``range_interpolated`` [m]."""
    radial_velocity_standard_error: np.ndarray
    """Standard error of ``radial_velocity`` [m/s]."""
    radial_velocity_interpolated_standard_error: np.ndarray
    """Standard error of ``radial_velocity_interpolated`` [m/s]."""
    snr: np.ndarray
    """Measured power of the weaker of the up and down peak, divided by the mean noise power of a
    bin."""
    pd: np.ndarray
    """Probability that the up and the down segment both detect the echo of the return; nan if a
    peak of the return is a false alarm."""
    flags: np.ndarray
    """uint8: bits that compare the return with the truth
    (:data:`sweep.model.pointcloud.pairing.FLAG_BITS`); 0 without a return."""
    beamlet: np.ndarray
    """(n, draws, returns) int32: index of the beamlet that made the peaks of a true or misread
    return (:data:`sweep.model.pointcloud.pairing.FLAG_BITS`); -1 for a return of another kind, and
    without a return."""
    group: np.ndarray
    """(n, draws, returns, 3) int8: index of the echo (group of adjacent bins above the threshold)
    that made the up, Doppler and down peak; -1 for no peak or a false peak."""
    range_per_slip: np.ndarray
    """Derivative of ``range_interpolated`` with respect to the slip [m/(m/s)]. The slip is the
    closing speed minus the speed at which the range falls."""
    radial_velocity_per_slip: np.ndarray
    """Derivative of ``radial_velocity_interpolated`` with respect to the slip [1]. The slip is the
    closing speed minus the speed at which the range falls."""

    @classmethod
    def empty(cls, shape: tuple[int, ...]) -> "Returns":
        """Return a record of arrays (n, draws, returns) whose values mark no returns."""
        arrays: dict[str, np.ndarray] = {
            "flags": np.zeros(shape, np.uint8),
            "beamlet": np.full(shape, -1, np.int32),
            "group": np.full((*shape, 3), FALSE_PEAK_GROUP, np.int8),
        }
        return cls(
            **{
                name: arrays[name] if name in arrays else np.full(shape, np.nan)
                for name in cls._fields
            }
        )


def draw_returns(
    shots: Shots,
    bin_groups: BinGroups,
    *,
    keys: np.ndarray,
    first_draw: int = 0,
    draws: int = 1,
    method: str = "probabilities",
    motion: EgoMotion | None = None,
    known_leakage_bins: Sequence[tuple[np.ndarray, LeakageBins]] | None = None,
) -> Returns:
    """Draw the returns (measured points) of n prepared shots from their noiseless echoes.

    Parameters
    ----------
    shots
        Prepared shots.
    bin_groups
        Groups (runs of adjacent bins above the threshold) in the noiseless spectra of the shots.
    keys
        (n, 2) uint64: random key of each shot.
    first_draw, draws
        Number of the first draw, and number of draws; any range of draws can be computed alone.
    method
        ``probabilities`` or ``noise``.
    motion
        Known motion of the instrument, which corrects range and velocity; None to correct nothing.
    known_leakage_bins
        Results of :func:`iter_leakage_bins` for all points that may leak, if already computed.
    """
    adds_noise = method == "noise"
    inputs, drawn_peaks = (
        make_draw_inputs(shots, bin_groups, motion),
        DrawnPeaks.empty(bin_groups, draws),
    )
    pfa_bin = np.exp(shots.looks.log_pfa(inputs.threshold_ratio[:, None]))
    config, interpolation = (
        DrawConfig.from_shots(shots, first_draw, adds_noise),
        interpolator(shots.window, shots.fft_size),
    )
    window_bins = int(2 * inputs.line_grid.peak_search_half_width.max(initial=0) + 1)
    _, _, groups_max = bin_groups.strongest_bin.shape
    noise_roots: dict[int, np.ndarray] = {}
    for indices, spectra, part_leakage_bins in _iter_spectra_and_leakage_bins(
        shots,
        bin_groups,
        adds_noise,
        known_leakage_bins,
        keys,
        range(first_draw, first_draw + draws),
    ):
        part_inputs = inputs.select(indices)
        part_inputs = part_inputs._replace(
            pfa_noise=at_least_one_probability(pfa_bin[indices], spectra.n_noise_bins)
        )
        filter_rule = make_echo_noise_filter(shots, spectra, 0 if adds_noise else window_bins)
        n_noise_bins = len(filter_rule.weights)
        if n_noise_bins not in noise_roots:
            noise_roots[n_noise_bins] = noise_covariance_root(filter_rule)
        part_config = config._replace(
            noise_filter=filter_rule, noise_covariance_root=noise_roots[n_noise_bins]
        )
        if (
            shots.fft_size_if_end_bins_real
            and shots.speckle.segment_correlations is not None
            and (shots.speckle_table.pseudo_variance_row > 0).any()
        ):
            noise_ratio = noise_pseudo_variance_ratio(shots.window, shots.fft_size)
            n_near_bins = 1 + int(
                np.flatnonzero(np.abs(noise_ratio) > _CIRCULAR_PSEUDO_VARIANCE_RATIO_MAX)[-1]
            )
            n_filter_bins = 2 * (n_near_bins + window_bins + int(spectra.n_bins.max(initial=0)))
            end_filter = NoiseFilter(
                *noise_filter(shots.window, shots.fft_size, n_filter_bins),
                shots.fft_size_if_end_bins_real,
            )
            part_config = part_config._replace(
                spectrum_end_noise_filter=end_filter,
                noise_pseudo_variance_ratio=np.ascontiguousarray(noise_ratio[:n_near_bins]),
            )
        n_filter_bins = max(
            window_bins,
            len(part_config.spectrum_end_noise_filter.weights),
            int(spectra.n_bins.max(initial=0)),
        )
        workspace = DrawWorkspace.allocate(n_filter_bins, groups_max)
        _draw_returns_of_points(
            keys[indices],
            np.ascontiguousarray(indices, np.int64),
            part_config,
            part_inputs,
            spectra,
            part_leakage_bins,
            interpolation,
            workspace,
            PeakLists.allocate(groups_max + 1),
            PeakPairs.allocate(groups_max + 1),
            drawn_peaks,
        )
    return measure_returns(shots, inputs, drawn_peaks, motion)


_CIRCULAR_PSEUDO_VARIANCE_RATIO_MAX = 1e-3
"""Largest ratio of |E[X^2]|, the pseudo-variance of a bin's complex noise X, to its power E[|X|^2],
for which the noise counts as circular."""


def _iter_spectra_and_leakage_bins(
    shots: Shots,
    bin_groups: BinGroups,
    adds_noise: bool,
    known_leakage_bins: Sequence[tuple[np.ndarray, LeakageBins]] | None,
    keys: np.ndarray,
    draw_range: range,
) -> Iterator[tuple[np.ndarray, NoiselessSpectra, LeakageBins]]:
    """Yield, for batches of points, their indices, noiseless spectra and bins of leaked signal.

    The arguments are those of :func:`draw_returns`, and the numbers of the draws.
    """
    if adds_noise:
        for indices, spectra in iter_noiseless_spectra(shots):
            yield indices, spectra, bins_without_noise_peaks(shots, bin_groups, indices, spectra)
        return
    n_noise_bins = np.nan_to_num(shots.n_alarm_equivalent_bins(bin_groups.n_exempt_bins.T).T)
    leaking_indices = find_leaking_points(bin_groups)
    has_raised_bin = None
    if known_leakage_bins is None:
        has_raised_bin = find_segments_with_raised_bins(
            bin_groups, leaking_indices, keys, draw_range.start, len(draw_range)
        )
        leaking_indices = np.flatnonzero(has_raised_bin.any(axis=1))
    is_leaking_point = np.zeros(shots.size, bool)
    is_leaking_point[leaking_indices] = True
    leakage_bins_by_part: Iterable[tuple[np.ndarray, LeakageBins]] = iter_leakage_bins(
        shots, bin_groups, leaking_indices, has_raised_bin
    )
    if known_leakage_bins is not None:
        leakage_bins_by_part = (
            (indices, leakage_bins)
            if is_leaking.all()
            else (indices[is_leaking], leakage_bins.select_points(is_leaking))
            for indices, leakage_bins in known_leakage_bins
            if (is_leaking := is_leaking_point[indices]).any()
        )
    for indices, leakage_bins in leakage_bins_by_part:
        yield (
            indices,
            NoiselessSpectra.empty(indices.size)._replace(n_noise_bins=n_noise_bins[indices]),
            leakage_bins,
        )
    other_indices = np.flatnonzero(~is_leaking_point)
    if not other_indices.size:
        return
    empty_spectra = NoiselessSpectra.empty(other_indices.size)._replace(
        n_noise_bins=n_noise_bins[other_indices]
    )
    yield other_indices, empty_spectra, LeakageBins.empty(other_indices.size)


class DrawConfig(NamedTuple):
    """Settings for draws of peaks that are common to all points."""

    first_draw: int
    """Number of the first draw."""
    adds_noise: bool
    """True if noise is added to the bins of an echo and the sum is compared with the threshold;
    False if random numbers are compared with probabilities of detection."""
    adds_powers: bool
    """True if the powers of beamlets' lines are added, False if their amplitudes are."""
    has_doppler_segment: bool
    """True if shots have a Doppler segment, in which the frequency is constant."""
    nyquist_bin: int
    """Number of the bin at the Nyquist frequency: N/2, with N the FFT size."""
    down_beat_sign: float
    """Sign by which a complex record, with bins -N/2..N/2 - 1, tells range from velocity: 1 if the
    down beat minus the up beat rises with the range, -1 if it falls. It is 0 for a real record,
    with bins 1..N/2. N is the FFT size."""
    two_beat_reading: int
    """Number of the reading (way to interpret an up and a down beat as range and velocity) that is
    used if no Doppler peak confirms the pair."""
    fft_size_if_end_bins_real: int
    """FFT size N if noise in the bins at frequency 0 and at Nyquist is real; 0 if it counts as
    complex."""
    lobe_half_width: int
    """Half-width of the main lobe of a line [bins] if any bin of an echo may detect it; 0 if only
    its strongest bin may."""
    noise_filter: NoiseFilter
    """Filter that makes the correlated noise of an echo's bins from independent random numbers."""
    noise_covariance_root: np.ndarray
    """Matrix (k, k) that makes the noise of k adjacent bins from k independent random numbers
    (:func:`sweep.model.sampling.draws.noise_covariance_root`)."""
    spectrum_end_noise_filter: NoiseFilter
    """Filter that makes the noise of bins near frequency 0 or Nyquist. It has no bins if no echo in
    developed speckle is near either."""
    noise_pseudo_variance_ratio: np.ndarray
    """(bins,): ratio E[X^2] / E[|X|^2] of a bin's complex noise X. Element i is for the bin i bins
    from frequency 0 or Nyquist, and the last element for the last bin with non-circular noise. The
    array is empty if no echo in developed speckle is near either."""
    n_looks: int
    """Number of looks (records of a segment) whose powers are averaged or whose detections are
    votes; 1 if the amplitudes of looks are added."""
    has_independent_speckle: bool
    """True if the speckle differs between looks (records of a segment), whether independent or
    partly correlated."""
    votes_needed: int
    """Number of looks (records of a segment) that must detect an echo. It is 0 if the mean power of
    the looks is compared with the threshold. It is -1 if more than CORRELATED_LOOKS_MAX looks have
    partly correlated speckle; in this case one amplitude is compared with the probability of
    detection."""

    @classmethod
    def from_shots(cls, shots: Shots, first_draw: int, adds_noise: bool) -> "DrawConfig":
        """Return the settings for draws of prepared shots.

        Parameters
        ----------
        shots : Shots
            Prepared shots.
        first_draw : int
            Number of the first draw that is made.
        adds_noise : bool
            True to add noise to the bins of an echo; False to compare random numbers with
            probabilities of detection.
        """
        two_beat_reading = (
            waveform.FAST_TARGET_READING
            if shots.detection_settings.two_beat_assumption == waveform.FAST_TARGET
            else waveform.FAR_TARGET_READING
        )
        down_beat_sign = 0.0
        _, has_doppler_segment, _ = shots.has_segment
        _, _, down_slope = shots.waveform.chirp_rate_ratios
        if shots.complex_record:
            two_beat_reading, down_beat_sign = (
                waveform.SIGNED_BEATS_READING,
                math.copysign(1.0, 1.0 - down_slope),
            )
        votes = shots.looks.votes_needed if shots.looks.combine_kind == COMBINE_BINARY else 0
        if shots.speckle.look_speckle is not None and shots.looks.number > CORRELATED_LOOKS_MAX:
            votes = -1
        return cls(
            int(first_draw),
            adds_noise,
            shots.footprint.adds_powers,
            bool(has_doppler_segment),
            shots.fft_size // 2,
            down_beat_sign,
            two_beat_reading,
            shots.fft_size_if_end_bins_real,
            shots.detection_rule.lobe_half_width,
            make_echo_noise_filter(shots, NoiselessSpectra.empty(0)),
            np.zeros((0, 0)),
            make_echo_noise_filter(shots, NoiselessSpectra.empty(0)),
            np.empty(0),
            shots.looks.number if shots.looks.is_noncoherent else 1,
            shots.looks.has_independent_speckle
            or (shots.speckle.look_speckle is not None and votes >= 0),
            votes,
        )


class DrawInputs(NamedTuple):
    """Quantities of n points on which draws of their peaks depend.

    Segments are up, Doppler and down. A group is a run of adjacent bins above the threshold without
    noise. sigma is the noise of a bin per quadrature.
    """

    strongest_bin: np.ndarray
    """(n, 3, groups) int64: number of the group's strongest bin; -1 for no group."""
    first_bin: np.ndarray
    """(n, 3, groups) int64: number of the group's first (lowest) bin; -1 for no group."""
    last_bin: np.ndarray
    """(n, 3, groups) int64: number of the group's last (highest) bin; -1 for no group."""
    pd: np.ndarray
    """(n, 3, groups): probability that a segment detects the echo (group of adjacent bins above the
    threshold)."""
    magnitude_below: np.ndarray
    """(n, 3, groups): noiseless |X| of the bin below the group's strongest bin [V]."""
    magnitude: np.ndarray
    """(n, 3, groups): noiseless |X| of the group's strongest bin [V]."""
    magnitude_above: np.ndarray
    """(n, 3, groups): noiseless |X| of the bin above the group's strongest bin [V]."""
    line_deviation_bins: np.ndarray
    """(n, 3, groups): standard deviation, weighted by power, of the positions of the beamlets'
    lines in each group of adjacent bins [bins]."""
    line_positions: np.ndarray
    """(n, 3, beamlets): position of each beamlet's line [bins], 0..N/2 with N the FFT size. For a
    complex record it is signed, and shifted by a multiple of N to be nearest to the strongest
    group."""
    beamlet_amplitude: np.ndarray
    """(n, beamlets): amplitude of each beamlet's echo, up to a factor common to the beamlets of a
    point."""
    noise_sigma: np.ndarray
    """(n,): sigma, the standard deviation of a bin's noise per quadrature [V]."""
    threshold_ratio: np.ndarray
    """(n,): threshold divided by sigma, the noise of a bin per quadrature."""
    line_noise_ratio: np.ndarray
    """(n,): noise per quadrature of bins that hold lines of the echo, divided by sigma, the noise
    per quadrature of bins without signal."""
    bin_thresholds: BinThresholds
    """Record with (n,) in each field: threshold on |X|, and noise, of each point's bins
    (:attr:`sweep.model.preparation.Shots.bin_thresholds`)."""
    pfa_noise: np.ndarray
    """(n, 3): probability that noise alone raises a false alarm in a segment."""
    doppler_prediction: DopplerPrediction
    """Record with (n,) in each field: coefficients that predict the Doppler beat from the up and
    down beat."""
    down_pd_if_up_missed: np.ndarray
    """(n, groups): probability that the down segment detects echo i, if the up segment misses echo
    i. i is the index along the second axis."""
    down_pd_if_up_detected: np.ndarray
    """(n, groups): probability that the down segment detects echo i, if the up segment detects echo
    i. i is the index along the second axis."""
    first_searched_bin: np.ndarray
    """(n, 3) int64: number of the first bin in which a false peak of noise alone may be drawn."""
    last_searched_bin: np.ndarray
    """(n, 3) int64: number of the last bin in which a false peak of noise alone may be drawn."""
    line_grid: SpeckleLineGrid
    """Lines that represent each point's footprint in developed speckle. Without developed speckle
    it has no points."""
    line_centre: np.ndarray
    """(n, 3, groups): mean position [bins] of the beamlets' lines in each group of adjacent bins.
    """
    echo_fraction: np.ndarray
    """(n, 3, groups): fraction, 0..1, of the echo in the mean power of echo plus noise, for the
    random amplitude that decides on the detection of a group in developed speckle."""
    n_independent_bins: np.ndarray
    """(n, 3, groups): equivalent number of independent bins, each of which may detect a group in
    developed speckle."""
    speckle_mixing: SpeckleMixing
    """Record with (n,) in each field: coefficients by which independent random amplitudes are mixed
    into the speckle of the three segments; 0 without speckle."""
    look_covariance_root: np.ndarray
    """(n, 3, looks, sets) complex: coefficients by which independent sets of speckle amplitudes are
    mixed into the partly correlated speckle of looks (records of a segment). Without partly
    correlated speckle, or with more than CORRELATED_LOOKS_MAX looks, it is empty (sets = 0)."""

    def select(self, indices: np.ndarray) -> "DrawInputs":
        """Return the record of the points with the given indices."""
        return DrawInputs(
            *(
                v.select(indices)
                if isinstance(v, (SpeckleLineGrid, BinThresholds, DopplerPrediction, SpeckleMixing))
                else v[indices]
                for v in self
            )  # type: ignore[arg-type]
        )


class DrawWorkspace(NamedTuple):
    """Arrays that compiled code writes to within a draw, allocated once for all draws."""

    noise: NoiseScratch
    """Scratch for the noise of an echo's bins over sigma, the noise of a bin per quadrature."""
    bin_magnitude_ratio: np.ndarray
    """(bins,): |X| of an echo's bins in a draw over sigma, the noise of a bin per quadrature."""
    bin_power: np.ndarray
    """(bins,): |X|^2 of an echo's bins in a draw over sigma^2, the noise power of a bin per
    quadrature."""
    pedestal_power: np.ndarray
    """(bins,): power of the phase-noise pedestal in an echo's bins, divided by the power of noise.
    """
    all_bins_are_echo: np.ndarray
    """(bins,) bool: mask of True in all elements, for functions that need a mask of the bins of an
    echo."""
    false_peak_bins: np.ndarray
    """(groups + 1,) int64: numbers of the bins of a segment's false peaks."""
    false_peak_magnitude_ratios: np.ndarray
    """(groups + 1,): |X| of a segment's false peaks over sigma, the noise of a bin per quadrature.
    """
    peak_positions: np.ndarray
    """(3,): positions of the up, Doppler and down peak of a return [bins]."""

    @classmethod
    def allocate(cls, n_bins: int, groups_max: int) -> "DrawWorkspace":
        """Allocate arrays for a given number of bins of an echo, and of echoes of a segment.

        Parameters
        ----------
        n_bins : int
            Largest number of bins of an echo.
        groups_max : int
            Largest number of echoes of a segment.

        Returns
        -------
        DrawWorkspace
            Arrays whose values are undefined, except ``all_bins_are_echo``.
        """
        return cls(
            NoiseScratch.allocate(n_bins),
            np.empty(n_bins),
            np.empty(n_bins),
            np.empty(n_bins),
            np.ones(n_bins, np.bool_),
            np.empty(groups_max + 1, np.int64),
            np.empty(groups_max + 1),
            np.empty(3),
        )


class DrawnPeaks(NamedTuple):
    """Peaks of n points, drawn and paired into returns (measured points)."""

    peaks: Peaks
    """Record with (n, draws, returns, 3) in each field: up, Doppler and down peak of each return;
    nan for none."""
    reading: np.ndarray
    """(n, draws, returns) int64: number of the reading (way to interpret the beats) that gives
    range and velocity, as in :func:`sweep.model.waveform.doppler_and_range_beat`; -1 without a
    return."""
    group: np.ndarray
    """(n, draws, returns, 3) int8: index of the echo (group of adjacent bins) that made the up,
    Doppler and down peak, or FALSE_PEAK_GROUP or NO_PEAK_GROUP."""
    flags: np.ndarray
    """(n, draws, returns) uint8: bits that compare each return with the truth
    (:data:`sweep.model.pointcloud.pairing.FLAG_BITS`); 0 without a return."""
    beamlet: np.ndarray
    """(n, draws, returns) int32: index of the beamlet that made the peaks of a return that is true
    or misread (:data:`sweep.model.pointcloud.pairing.FLAG_BITS`); else -1."""

    @classmethod
    def empty(cls, bin_groups: BinGroups, draws: int) -> "DrawnPeaks":
        """Return a record for n shots whose values mark no returns (measured points).

        Parameters
        ----------
        bin_groups : BinGroups
            Groups of bins of n shots (:class:`sweep.model.pointcloud.bin_groups.BinGroups`). The
            number of groups for which there is room is the largest number of returns.
        draws : int
            Number of draws of each shot.

        Returns
        -------
        DrawnPeaks
            Arrays (n, draws, returns, ..), with the values that mark no return.
        """
        n, _, groups_max = bin_groups.strongest_bin.shape
        return cls(
            Peaks.empty((n, draws, groups_max, 3)),
            np.full((n, draws, groups_max), -1),
            np.full((n, draws, groups_max, 3), NO_PEAK_GROUP, np.int8),
            np.zeros((n, draws, groups_max), np.uint8),
            np.full((n, draws, groups_max), -1, np.int32),
        )


class ListedReturns(NamedTuple):
    """Returns (measured points) of all shots and draws in one list of length m."""

    point: np.ndarray
    """(m,) int64: index of the shot to which each of m returns belongs."""
    peaks: Peaks
    """Record with (m, 3) in each field: up, Doppler and down peak of each return; nan for none."""
    reading: np.ndarray
    """(m,) int64: number of the reading (way to interpret the beats) that gives range and velocity,
    as in :func:`sweep.model.waveform.doppler_and_range_beat`."""
    group: np.ndarray
    """(m, 3) int8: index of the echo (group of adjacent bins) that made the up, Doppler and down
    peak, or FALSE_PEAK_GROUP or NO_PEAK_GROUP."""
    flags: np.ndarray
    """(m,) uint8: bits that compare each return with the truth
    (:data:`sweep.model.pointcloud.pairing.FLAG_BITS`)."""
    beamlet: np.ndarray
    """(m,) int32: index of the beamlet that made the peaks of a return that is true or misread
    (:data:`sweep.model.pointcloud.pairing.FLAG_BITS`); else -1."""

    @classmethod
    def from_drawn_peaks(cls, drawn_peaks: DrawnPeaks) -> "ListedReturns":
        """Return the list of all returns in ``drawn_peaks``, ordered by point, then draw."""
        is_return = drawn_peaks.flags > 0
        point, _, _ = np.nonzero(is_return)
        return cls(
            point=point,
            peaks=drawn_peaks.peaks.select(is_return),
            reading=drawn_peaks.reading[is_return],
            group=drawn_peaks.group[is_return],
            flags=drawn_peaks.flags[is_return],
            beamlet=drawn_peaks.beamlet[is_return],
        )


def make_draw_inputs(
    shots: Shots, bin_groups: BinGroups, motion: EgoMotion | None = None
) -> DrawInputs:
    """Return the quantities of shots from which their peaks are drawn.

    Parameters
    ----------
    shots : Shots
        Prepared shots of n points.
    bin_groups : BinGroups
        Groups of adjacent bins above the threshold in the shots' noiseless spectra.
    motion : EgoMotion, optional
        Known motion of the instrument, which corrects range and velocity; None to correct nothing.

    Returns
    -------
    DrawInputs
        Quantities of the n points. They have as many groups as the segment with the most.
    """
    bin_groups = bin_groups.without_unused_groups()
    line_positions, beamlet_amplitude = (
        beamlet_line_positions(shots),
        shots.footprint.relative_amplitude[shots.footprint.row_of_point],
    )
    if shots.complex_record:
        offset_cycles = (line_positions - bin_groups.strongest_bin[:, :, :1]) / shots.fft_size
        line_positions = line_positions - shots.fft_size * np.floor(offset_cycles + 0.5)
    line_offset = line_positions[:, :, None] - bin_groups.strongest_bin[..., None]
    is_in_group = (line_positions[:, :, None] >= bin_groups.first_bin[..., None] - 1) & (
        line_positions[:, :, None] <= bin_groups.last_bin[..., None] + 1
    )
    weight = np.where(is_in_group, beamlet_amplitude[:, None, None] ** 2, 0.0)
    total = weight.sum(axis=-1)
    total[total == 0] = 1.0
    pd_up, pd_down = bin_groups.pd[:, 0], bin_groups.pd[:, 2]
    pd_both = joint_detection_probability(
        shots, pd_up.T, pd_down.T, (bin_groups.magnitude[:, 0].T, bin_groups.magnitude[:, 2].T)
    ).T
    down_pd = down_pd_given_up_result(pd_up, pd_down, pd_both)
    magnitude_below, magnitude, magnitude_above = np.ascontiguousarray(
        np.moveaxis(bin_groups.peak_and_neighbour_magnitudes, -1, 0)
    )
    first_searched_bin, last_searched_bin = _searched_bins(shots)
    echo_fraction, n_independent_bins = _speckle_draw_inputs(shots, bin_groups)
    threshold_ratio, line_noise_ratio = threshold_and_line_noise_ratios(shots)
    mean_offset = (weight * line_offset).sum(axis=-1) / total
    mean_square = (weight * line_offset**2).sum(axis=-1) / total
    line_deviation = np.sqrt(np.maximum(mean_square - mean_offset**2, 0.0))
    if shots.speckle.segment_correlations is not None:  # drawn lines include their spread
        line_deviation *= 0.0
    return DrawInputs(
        strongest_bin=bin_groups.strongest_bin,
        first_bin=bin_groups.first_bin,
        last_bin=bin_groups.last_bin,
        pd=bin_groups.pd,
        magnitude_below=magnitude_below,
        magnitude=magnitude,
        magnitude_above=magnitude_above,
        line_deviation_bins=line_deviation,
        line_positions=line_positions,
        beamlet_amplitude=beamlet_amplitude,
        noise_sigma=np.array(np.broadcast_to(shots.bin_noise_sigma, shots.size)),
        threshold_ratio=threshold_ratio,
        line_noise_ratio=line_noise_ratio,
        bin_thresholds=shots.bin_thresholds,
        pfa_noise=np.zeros(bin_groups.leakage_probability.shape),
        doppler_prediction=DopplerPrediction(
            *(np.array(np.broadcast_to(v, shots.size)) for v in _doppler_prediction(shots, motion))
        ),
        down_pd_if_up_missed=np.ascontiguousarray(down_pd.pd_if_condition_fails),
        down_pd_if_up_detected=np.ascontiguousarray(down_pd.pd_if_condition_holds),
        first_searched_bin=first_searched_bin,
        last_searched_bin=last_searched_bin,
        line_grid=speckle_line_grid(shots),
        line_centre=np.where(
            bin_groups.strongest_bin < 0, np.nan, bin_groups.strongest_bin + mean_offset
        ),
        echo_fraction=echo_fraction,
        n_independent_bins=n_independent_bins,
        speckle_mixing=_speckle_mixing(shots),
        look_covariance_root=_look_covariance_roots(shots),
    )


def _speckle_mixing(shots: Shots) -> SpeckleMixing:
    """Return the coefficients that mix independent amplitudes into the speckle of three segments.

    The fields of the result are (n,) for n shots; 0 without speckle.
    """
    if shots.speckle.segment_correlations is None:
        return SpeckleMixing(*np.zeros((6, shots.size)))
    return shots.speckle.segment_correlations.speckle_mixing().broadcast(shots.size)


def _look_covariance_roots(shots: Shots) -> np.ndarray:
    """Return coefficients that mix independent sets of speckle into the speckle of each look.

    The result is (n, 3, looks, sets). A look is a record of a segment. The result is empty (sets =
    0) without partly correlated speckle, and with more than CORRELATED_LOOKS_MAX looks.
    """
    n_looks = shots.looks.number
    if shots.speckle.look_speckle is None or n_looks > CORRELATED_LOOKS_MAX:
        return np.zeros((shots.size, 3, 1, 0), complex)
    return np.ascontiguousarray(np.moveaxis(shots.speckle.look_speckle.covariance_roots(), 0, 1))


def _n_independent_bins(
    shots: Shots, bin_groups: BinGroups, has_noncircular_bins: np.ndarray
) -> np.ndarray:
    """Return the equivalent number of independent bins that may detect each echo, (n, 3, groups).

    In the up and down segment it is the number that :func:`joint_detection_probability` uses. It is
    1 for an echo near frequency 0 or Nyquist, and if only the strongest bin may detect.
    """
    n_independent = np.ones(bin_groups.pd.shape)
    if shots.detection_settings.echo_bin_rule == "peak_bin":
        return n_independent
    for segments in ((0, 2), (1,)):
        pd_by_segment = tuple(bin_groups.pd[:, s].T for s in segments)
        magnitudes_by_segment = tuple(bin_groups.magnitude[:, s].T for s in segments)
        n_equivalent = np.asarray(
            mean_n_detection_equivalent_bins(shots, pd_by_segment, magnitudes_by_segment)
        ).T
        for s in segments:
            n_independent[:, s] = n_equivalent
    return np.where(
        has_noncircular_bins, 1.0, np.clip(n_independent, 1.0, DRAWN_INDEPENDENT_BINS_MAX)
    )


def _speckle_draw_inputs(shots: Shots, bin_groups: BinGroups) -> tuple[np.ndarray, np.ndarray]:
    """Return the fields ``echo_fraction`` and ``n_independent_bins`` of :class:`DrawInputs`."""
    line_sigma, threshold = (
        np.broadcast_to(v, shots.size)[:, None, None]
        for v in (shots.line_noise_sigma, shots.threshold)
    )
    if shots.speckle.line_gradients is None:
        return np.zeros(bin_groups.pd.shape), np.ones(bin_groups.pd.shape)
    has_noncircular_bins = (shots.speckle_table.pseudo_variance_row.T > 0)[:, :, None] & (
        shots.fft_size_if_end_bins_real > 0
    )
    n_independent = _n_independent_bins(shots, bin_groups, has_noncircular_bins)
    with np.errstate(divide="ignore", invalid="ignore"):
        # Fraction for one bin of equal probability, as in `joint_pd_in_speckle`.
        single_bin_pd = pd_of_one_independent_bin(bin_groups.pd, n_independent)
        echo_fraction = (
            1
            + np.log(np.where(n_independent > 1, single_bin_pd, bin_groups.pd))
            * 2
            * (line_sigma / threshold) ** 2
        )
        signal_power = np.square(bin_groups.magnitude / line_sigma)
        echo_fraction = np.where(
            has_noncircular_bins, signal_power / (2 + signal_power), echo_fraction
        )
    return np.clip(np.nan_to_num(echo_fraction), 0.0, 1.0), n_independent


def _doppler_prediction(shots: Shots, motion: EgoMotion | None = None) -> DopplerPrediction:
    """Return the coefficients that predict the Doppler beat from the up and the down beat.

    ``motion_shift_max_bins`` of the result follows from the known ``motion`` of the instrument. It
    is 0 if ``motion`` is None.
    """
    _, doppler, down = shots.waveform.chirp_rate_ratios
    up_carrier, at_doppler, at_down = (np.asarray(carrier) for carrier in shots.waveform.carriers)
    determinant = at_down - down * up_carrier
    up_share = (doppler * at_down - down * at_doppler) / determinant
    down_share = (at_doppler - doppler * up_carrier) / determinant
    if motion is None:
        return DopplerPrediction(up_share, down_share, np.zeros(()))
    known_motion = (motion.closing_acceleration, motion.slip_at(shots.range))
    mismatch = sum(
        abs((up_share * up_beat + down_share * down_beat - doppler_beat) * known_value)
        for (up_beat, doppler_beat, down_beat), known_value in zip(
            _beat_shifts_by_motion(shots), known_motion, strict=True
        )
    )
    return DopplerPrediction(
        up_share, down_share, np.asarray(mismatch * shots.fft_size / shots.sample_rate)
    )


def _searched_bins(shots: Shots) -> tuple[np.ndarray, np.ndarray]:
    """Return the first and the last bin in which noise alone may raise a false peak, (n, 3) each.

    For a complex record these are bins 0 and N - 1, with N the FFT size. For a real record they
    bound the bins whose noise is circular: all but a few next to frequency 0 and Nyquist, or 1..N/2
    if noise counts as circular in all bins. A search band narrows the range.
    """
    first_searched, nyquist_bin = shots.first_searched_bin, shots.fft_size // 2
    last_searched = nyquist_bin - first_searched if shots.fft_size_if_end_bins_real else nyquist_bin
    first_bins, last_bins = np.empty((2, shots.size, 3), np.int64)
    first_bins[:], last_bins[:] = (
        (0, shots.fft_size - 1) if shots.complex_record else (first_searched, last_searched)
    )
    band = shots.detection_settings.search_band
    if band is not None:
        band_first_bin, band_last_bin = band.first_bin.T, (band.first_bin + band.n_bins - 1).T
        if shots.complex_record:
            first_bins[:], last_bins[:] = band_first_bin, band_last_bin
        else:
            first_bins[:] = np.maximum(band_first_bin, first_searched)
            last_bins[:] = np.minimum(band_last_bin, nyquist_bin - first_searched)
    return first_bins, last_bins


class MeasuredValues(NamedTuple):
    """Range and radial velocity of m returns, with errors."""

    range: np.ndarray
    """(m,): range of each return [m]."""
    radial_velocity: np.ndarray
    """(m,): radial velocity of each return [m/s]."""
    range_standard_error: np.ndarray
    """(m,): standard error of ``range`` due to noise [m]."""
    radial_velocity_standard_error: np.ndarray
    """(m,): standard error of ``radial_velocity`` due to noise [m/s]."""


class Measurements(NamedTuple):
    """Range and radial velocity of m returns, by whole bins and by positions between bins."""

    by_whole_bins: MeasuredValues
    """Record with (m,) in each field: values computed from the whole bins of the peaks."""
    interpolated: MeasuredValues
    """Record with (m,) in each field: values computed from interpolated positions of the peaks."""
    range_per_half_bin: np.ndarray
    """(m,): change of range that shifts the beats of the chirps by half a bin [m]."""
    velocity_per_half_bin: np.ndarray
    """(m,): change of radial velocity that shifts the beats of the chirps by half a bin [m/s]."""
    range_bias: np.ndarray | float
    """(m,): measured range minus the range at the start of the shot, due to motion during the shot
    [m]."""


def measure_returns(
    shots: Shots,
    inputs: DrawInputs,
    drawn_peaks: DrawnPeaks,
    motion: EgoMotion | None = None,
    *,
    from_three_bins: bool = True,
) -> Returns:
    """Compute range and velocity of returns from paired peaks, and flag wrong conversions.

    A return is misread if its peaks belong to one beamlet, but range or velocity is not that of
    this beamlet.

    Parameters
    ----------
    shots
        Prepared shots.
    inputs
        Quantities of the shots that draws depend on.
    drawn_peaks
        Paired peaks of the draws.
    motion
        Known motion, as in :func:`draw_returns`.
    from_three_bins
        True if positions between bins are those of
        :mod:`sweep.model.detection.sub_bin_interpolation`; False for another estimator's.
    """
    is_return = drawn_peaks.flags > 0  # few of the entries
    returns = Returns.empty(is_return.shape)
    if is_return.any():
        listed_returns = ListedReturns.from_drawn_peaks(drawn_peaks)
        measured_columns = _measure_listed_returns(
            shots, inputs, listed_returns, motion, from_three_bins
        )
        for column, values in zip(returns, measured_columns, strict=True):
            column[is_return] = values
    return returns


def _measure_listed_returns(
    shots: Shots,
    inputs: DrawInputs,
    listed_returns: ListedReturns,
    motion: EgoMotion | None,
    from_three_bins: bool,
) -> Returns:
    """Compute range and velocity of m listed returns, and flag wrong conversions.

    The result is that of :func:`measure_returns`, with the fields (m,).
    """
    uses_fit = shots.waveform.chirp_rate_ratios != waveform.DEFAULT_CHIRP_RATE_RATIOS
    point, at_returns = (
        listed_returns.point,
        partial(_values_of_points, shots, listed_returns.point),
    )
    listed_returns = _add_drift_errors(shots, listed_returns, motion)
    measure = _measure_by_fit if uses_fit else _measure_by_reading
    # Errors by noise alone.
    if from_three_bins and shots.echo_record.n_samples_before_echo is not None:
        listed_returns = _correct_late_echoes(
            shots, listed_returns, measure(shots, listed_returns, None)
        )
    wander_covariance = _wander_covariance(shots, inputs, listed_returns, from_three_bins)
    if wander_covariance is not None:
        wander_variance = np.diagonal(wander_covariance, axis1=-2, axis2=-1)
        listed_returns = listed_returns._replace(
            peaks=listed_returns.peaks._replace(
                position_error=np.sqrt(listed_returns.peaks.position_error**2 + wander_variance)
            )
        )
    measurements = measure(shots, listed_returns, wander_covariance)
    group = np.maximum(listed_returns.group, 0)
    group_widths = (inputs.last_bin - inputs.first_bin)[point[:, None], np.arange(3), group]
    tolerance_half_bins = 2 * (
        4 + np.where(listed_returns.group >= 0, group_widths, 0).sum(axis=-1)
    )  # number of half bins
    beamlet = np.maximum(listed_returns.beamlet, 0)
    footprint_row = shots.footprint.row_of_point[point]
    true_range = at_returns(shots.range) * (
        1 + shots.footprint.relative_range_offset[footprint_row, beamlet]
    )
    true_velocity = (
        at_returns(shots.target.radial_velocity)
        + SPEED_OF_LIGHT / 2 * shots.footprint.doppler_ratio_offset[footprint_row, beamlet]
    )
    by_whole_bins, interpolated = measurements.by_whole_bins, measurements.interpolated
    range_error = interpolated.range - measurements.range_bias - true_range
    is_right = abs(range_error) <= tolerance_half_bins * measurements.range_per_half_bin
    is_right &= (
        abs(interpolated.radial_velocity - true_velocity)
        <= tolerance_half_bins * measurements.velocity_per_half_bin
    )
    up_group, doppler_group, down_group = listed_returns.group.T
    is_signal = (up_group >= 0) & (down_group >= 0) & (doppler_group != FALSE_PEAK_GROUP)
    up_index, _, down_index = group.T
    pd = inputs.pd[point, 0, up_index] * inputs.down_pd_if_up_detected[point, down_index]
    is_misread = (listed_returns.flags & TRUE_RETURN_FLAG > 0) & ~is_right
    up_ratio, _, down_ratio = listed_returns.peaks.magnitude_ratio.T
    uncorrected = interpolated
    if not uses_fit:  # refer to the shot's start by the measured velocity
        velocity = interpolated.radial_velocity * (
            1 + at_returns(shots.motion.velocity_bias_fraction)
        )
        interpolated = interpolated._replace(
            radial_velocity=velocity,
            range=interpolated.range + velocity * at_returns(shots.motion.range_reference_time),
        )
    per_slip = ShiftsByMotion(np.zeros(()), np.zeros(()))
    if motion is not None:
        by_whole_bins, interpolated, per_slip = _correct_for_motion(
            shots, listed_returns, by_whole_bins, interpolated, motion
        )
    return Returns(
        range=by_whole_bins.range,
        range_interpolated=interpolated.range,
        radial_velocity=by_whole_bins.radial_velocity,
        radial_velocity_interpolated=interpolated.radial_velocity,
        # Values by whole bins stay uncorrected; the correction is added to their errors.
        range_standard_error=np.hypot(
            by_whole_bins.range_standard_error, interpolated.range - uncorrected.range
        ),
        range_interpolated_standard_error=interpolated.range_standard_error,
        radial_velocity_standard_error=np.hypot(
            by_whole_bins.radial_velocity_standard_error,
            interpolated.radial_velocity - uncorrected.radial_velocity,
        ),
        radial_velocity_interpolated_standard_error=interpolated.radial_velocity_standard_error,
        snr=np.minimum(up_ratio, down_ratio) ** 2 / 2,
        pd=np.where(is_signal, pd, np.nan),
        flags=np.where(
            is_misread,
            listed_returns.flags ^ (TRUE_RETURN_FLAG | MISREAD_FLAG),
            listed_returns.flags,
        ),
        beamlet=listed_returns.beamlet,
        group=np.maximum(listed_returns.group, FALSE_PEAK_GROUP),
        range_per_slip=np.broadcast_to(per_slip.range, point.shape),
        radial_velocity_per_slip=np.broadcast_to(per_slip.radial_velocity, point.shape),
    )


def _values_of_points(shots: Shots, point: np.ndarray, values: np.ndarray | float) -> np.ndarray:
    """Return the values (m,) at the indices ``point`` (m,).

    The values are an array (n,), or one number for all points.
    """
    return np.broadcast_to(values, shots.size)[point]


def _wander_covariance(
    shots: Shots, inputs: DrawInputs, listed_returns: ListedReturns, from_three_bins: bool
) -> np.ndarray | None:
    """Return the covariance [bins^2], due to speckle, of the position errors of a return's peaks.

    It is (m, 3, 3) by segment, with the signs of the beats; None for shots without speckle.
    """
    line_gradients = shots.speckle.line_gradients
    if line_gradients is None:
        return None
    covariance = np.zeros((*listed_returns.group.shape, 3))
    is_echo = np.asarray((listed_returns.group >= 0).any(axis=-1))
    point, group, peaks = (
        listed_returns.point[is_echo],
        listed_returns.group[is_echo],
        listed_returns.peaks.select(is_echo),
    )
    segment, point_column = np.arange(3), point[:, None]
    present = np.where(group >= 0, 1.0, np.nan)
    group_index = np.maximum(group, 0)
    noise_sigma, line_sigma = (
        np.broadcast_to(v, shots.size)[point_column]
        for v in (shots.bin_noise_sigma, shots.line_noise_sigma)
    )
    signal_power = (inputs.magnitude[point_column, segment, group_index] / noise_sigma) ** 2
    mean_power = signal_power + 2 * (line_sigma / noise_sigma) ** 2
    offset = peaks.offset
    if (
        shots.detection_settings.echo_bin_rule == "peak_bin"
    ):  # the position is relative to the group's strongest bin
        bin_shift = peaks.bin - inputs.strongest_bin[point_column, segment, group_index]
        if shots.complex_record:
            bin_shift = bin_shift - shots.fft_size * np.rint(bin_shift / shots.fft_size)
        offset = offset + np.where(np.abs(bin_shift) <= 1, bin_shift, 0.0)
    relative_power = present * peaks.magnitude_ratio**2 / mean_power
    speckle_peaks = SpecklePeaks(
        offset, folding_signs(shots)[point], relative_power, signal_power / mean_power
    )
    segment_pairs = (
        CHIRP_PAIRS_WITH_SELF
        if shots.waveform.chirp_rate_ratios == waveform.DEFAULT_CHIRP_RATE_RATIOS
        else SEGMENT_PAIRS_WITH_SELF
    )
    covariance[is_echo] = position_error_moments(
        line_gradients.select(point),
        speckle_peaks,
        shots,
        segment_pairs,
        from_three_bins=from_three_bins,
    )
    return covariance


def _add_drift_errors(
    shots: Shots, listed_returns: ListedReturns, motion: EgoMotion | None
) -> ListedReturns:
    """Return the list of returns, with the drift of lines within the record in standard errors.

    Lines drift because range and velocity change within the record. The drift is that of the known
    motion, or of the true motion of the shots if ``motion`` is None.
    """
    if motion is not None:
        shots = replace(
            shots,
            target=replace(
                shots.target,
                acceleration=motion.closing_acceleration,
                approach_speed=motion.approach_speed_at(shots.range),
            ),
        )
    bins_per_rate = shots.record.duration * shots.fft_size / shots.sample_rate
    drift_bins = np.array(
        [
            np.broadcast_to(abs(rate) * bins_per_rate, shots.size)
            for rate in shots.frequency_drift_rates
        ]
    )
    offset, position_error = (
        listed_returns.peaks.offset,
        listed_returns.peaks.position_error.copy(),
    )
    has_peak = np.isfinite(offset)
    drift_of_peak = drift_bins.T[listed_returns.point][has_peak]
    drift_errors = drift_error(offset[has_peak], drift_of_peak, shots.window, shots.fft_size)
    position_error[has_peak] = np.hypot(position_error[has_peak], drift_errors)
    return listed_returns._replace(
        peaks=listed_returns.peaks._replace(position_error=position_error)
    )


_POSITION_ERROR_MAX_BINS = 0.5
"""Upper limit of the standard error of a peak's position [bins] that is corrected for a late echo.
"""


def _correct_late_echoes(
    shots: Shots, listed_returns: ListedReturns, measurements: Measurements
) -> ListedReturns:
    """Return the list of returns, with peak positions corrected for echoes that arrive late.

    The first samples of a record lack a late echo. The instrument knows their number from the range
    by whole bins. Standard errors of the positions are limited to half a bin.
    """
    at_returns = partial(_values_of_points, shots, listed_returns.point)
    delay = 2 / SPEED_OF_LIGHT * np.nan_to_num(measurements.by_whole_bins.range)
    beta = 2 / SPEED_OF_LIGHT * np.nan_to_num(measurements.by_whole_bins.radial_velocity)
    n_missing = waveform.count_samples_before_echo(
        delay=delay, doppler_ratio=beta, record_start=at_returns(shots.record.acquisition_delay),
        sample_rate=at_returns(shots.sample_rate), length=shots.window.length,
    )  # fmt: skip
    peaks = listed_returns.peaks
    offset = np.nan_to_num(peaks.offset)
    correction = late_echo_correction(offset, n_missing[:, None], shots.window, shots.fft_size)
    widened_errors = np.minimum(
        peaks.position_error * correction.error_factor, _POSITION_ERROR_MAX_BINS
    )
    position_error = np.where(
        correction.error_factor > 1,
        np.maximum(widened_errors, peaks.position_error),
        widened_errors,
    )
    return listed_returns._replace(
        peaks=peaks._replace(
            position=peaks.position + correction.shift, position_error=position_error
        )
    )


class ShiftsByMotion(NamedTuple):
    """Shifts of measured range and velocity by motion that the beats do not show."""

    range: np.ndarray
    """(m,): shift of the measured range [m] by one unit of the motion (1 m/s or 1 m/s^2)."""
    radial_velocity: np.ndarray
    """(m,): shift of the measured radial velocity [m/s] by one unit of the motion (1 m/s or 1
    m/s^2)."""


class MotionCorrection(NamedTuple):
    """Measured values of m returns after the correction for the instrument's known motion."""

    by_whole_bins: MeasuredValues
    """Record with (m,) in each field: values computed from whole bins. The correction changes their
    standard errors only."""
    interpolated: MeasuredValues
    """Record with (m,) in each field: corrected values computed from interpolated positions."""
    shifts_per_slip: ShiftsByMotion
    """Record with (m,) in each field: shifts of range and velocity by a slip of 1 m/s. The slip is
    the closing speed minus the speed at which the range falls."""


def _correct_for_motion(
    shots: Shots,
    listed_returns: ListedReturns,
    by_whole_bins: MeasuredValues,
    interpolated: MeasuredValues,
    motion: EgoMotion,
) -> MotionCorrection:
    """Correct interpolated ranges and velocities for the instrument's known motion.

    The error due to unknown motion is added to the standard errors
    (:mod:`sweep.model.pointcloud.ego_motion`). The result is a :class:`MotionCorrection`.
    """
    motion = motion.select(listed_returns.point)
    per_acceleration, per_slip = _measurement_shifts_by_motion(shots, listed_returns)
    known_slip = motion.slip_at(interpolated.range)
    interpolated = interpolated._replace(
        range=interpolated.range
        - (per_slip.range * known_slip + per_acceleration.range * motion.closing_acceleration),
        radial_velocity=interpolated.radial_velocity
        - (
            per_slip.radial_velocity * known_slip
            + per_acceleration.radial_velocity * motion.closing_acceleration
        ),
    )
    slip_error = motion.slip_standard_error(interpolated.range)
    unknown_range, unknown_velocity = (
        np.hypot(by_slip * slip_error, by_acceleration * motion.acceleration_standard_error)
        for by_slip, by_acceleration in zip(per_slip, per_acceleration, strict=True)
    )
    by_whole_bins, interpolated = (
        values._replace(
            range_standard_error=np.hypot(values.range_standard_error, unknown_range),
            radial_velocity_standard_error=np.hypot(
                values.radial_velocity_standard_error, unknown_velocity
            ),
        )
        for values in (by_whole_bins, interpolated)
    )
    return MotionCorrection(by_whole_bins, interpolated, per_slip)


def _measurement_shifts_by_motion(
    shots: Shots, listed_returns: ListedReturns
) -> tuple[ShiftsByMotion, ShiftsByMotion]:
    """Return the shifts of measured range and velocity by motion that the beats do not show.

    The result is two :class:`ShiftsByMotion`: by an acceleration of 1 m/s^2, and by a slip of 1
    m/s. The slip is the radial velocity minus the speed at which the range falls.
    """
    coefficients = shots.beat_coefficients
    by_acceleration, by_slip = _beat_shifts_by_motion(shots)
    point = listed_returns.point
    point_index: np.ndarray | slice = point
    if (
        shots.waveform.chirp_rate_ratios == waveform.DEFAULT_CHIRP_RATE_RATIOS
    ):  # half sum and half difference of up and down beat, which all returns of a point share
        point_index = slice(None)
        weights = np.array([[1.0], [0.0], [1.0]]) + 0 * coefficients.chirp_rate
    else:
        peak_errors = listed_returns.peaks.position_error.T
        weights = np.where(np.isfinite(peak_errors), 1 / peak_errors**2, 0.0)
    coefficients = coefficients.select_points(point_index)
    per_acceleration, per_slip = (
        ShiftsByMotion(
            *(
                responses[point] if isinstance(point_index, slice) else responses
                for responses in waveform.range_velocity_response(
                    beats[:, point_index],
                    weights=weights,
                    carriers=coefficients.carrier,
                    chirp_rates=coefficients.chirp_rate,
                )
            )
        )
        for beats in (by_acceleration, by_slip)
    )
    return per_acceleration, per_slip


def _beat_shifts_by_motion(shots: Shots) -> tuple[np.ndarray, np.ndarray]:
    """Return the shifts of the beats [Hz] by an acceleration of 1 m/s^2, and by a slip of 1 m/s.

    Each of the two results is (3, n), by segment. The slip is the radial velocity minus the speed
    at which the range falls.
    """
    chirp_rates = shots.beat_coefficients.chirp_rate
    starts = np.array([np.broadcast_to(start, shots.size) for start in shots.motion.segment_starts])
    middle_time = shots.record_middle_time
    two_over_c = 2 / SPEED_OF_LIGHT
    carriers = np.array(
        [np.broadcast_to(carrier, shots.size) for carrier in shots.waveform.carriers]
    )
    range_terms = (
        starts**2 / 2
        + 2 * starts * middle_time
        + 1.5 * middle_time * shots.motion.velocity_drift_time
    )
    by_acceleration = two_over_c * (
        carriers * (starts + shots.motion.velocity_drift_time) + chirp_rates * range_terms
    )
    return by_acceleration, -two_over_c * chirp_rates * (starts + middle_time)


def _measure_by_reading(
    shots: Shots, listed_returns: ListedReturns, wander_covariance: np.ndarray | None
) -> Measurements:
    """Compute range and velocity at mid-chirp from the up and down peak of each return.

    The reading of a return says how its beats are interpreted: far or fast target, folded at
    Nyquist or not. Speckle common to both peaks makes their errors correlated. The covariance
    reduces the variance of the range, and adds to the variance of the velocity.
    """
    at_returns = partial(_values_of_points, shots, listed_returns.point)
    up_carrier, _, _ = shots.waveform.carriers
    carrier, bandwidth, duration, sample_rate, bin_width = (
        at_returns(values)
        for values in (
            up_carrier,
            shots.waveform.chirp_bandwidth,
            shots.waveform.chirp_duration,
            shots.sample_rate,
            shots.record.bin_width,
        )
    )
    chirp_rate = bandwidth / duration

    def convert_peaks(peak_positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Convert the peaks of returns, at ``peak_positions`` (m, 3), to range and velocity."""
        up, _, down = peak_positions.T * bin_width
        f_d, f_r = np.full((2, up.size), np.nan)
        for reading in np.unique(listed_returns.reading):
            has_reading = listed_returns.reading == reading
            f_d[has_reading], f_r[has_reading] = waveform.doppler_and_range_beat(
                reading, up[has_reading], down[has_reading], sample_rate[has_reading]
            )
        measured_range, measured_velocity = waveform.range_velocity_of_beats(
            f_d, f_r, carrier, bandwidth, duration
        )
        return measured_range, measured_velocity

    range_per_half_bin = SPEED_OF_LIGHT / 4 * bin_width / chirp_rate
    velocity_per_half_bin = SPEED_OF_LIGHT / 4 * bin_width / (carrier + bandwidth / 2)
    up_error, _, down_error = listed_returns.peaks.position_error.T
    variance = up_error**2 + down_error**2
    covariance = 0.0 if wander_covariance is None else 2 * wander_covariance[:, 0, 2]
    range_variance, velocity_variance = (
        np.maximum(variance + v, 0.0) for v in (-covariance, covariance)
    )
    by_whole_bins, interpolated = (
        MeasuredValues(
            *convert_peaks(peak_positions),
            range_standard_error=range_per_half_bin * np.sqrt(range_variance + rounding_variance),
            radial_velocity_standard_error=velocity_per_half_bin
            * np.sqrt(velocity_variance + rounding_variance),
        )
        for peak_positions, rounding_variance in (
            (listed_returns.peaks.bin, 2 * BIN_ROUNDING_VARIANCE),
            (listed_returns.peaks.position, 0.0),
        )
    )
    # Up and down beat give the range at the mean of their starts, plus a term by acceleration.
    up_start, down_start = (at_returns(shots.motion.segment_starts[s]) for s in (0, 2))
    range_bias = carrier / chirp_rate * at_returns(shots.target.acceleration)
    range_bias = 0.5 * (down_start - up_start) * range_bias
    range_bias -= 0.5 * (down_start + up_start) * at_returns(shots.target.approach_speed)
    return Measurements(
        by_whole_bins, interpolated, range_per_half_bin, velocity_per_half_bin, range_bias
    )


def _measure_by_fit(
    shots: Shots, listed_returns: ListedReturns, wander_covariance: np.ndarray | None
) -> Measurements:
    """Compute range and velocity at the start of the shot by a fit to each return's peaks."""
    point = listed_returns.point
    bin_width = np.broadcast_to(shots.record.bin_width, shots.size)
    carriers = [np.broadcast_to(carrier, shots.size) for carrier in shots.waveform.carriers]
    chirp_rate = np.broadcast_to(shots.waveform.chirp_rate, shots.size)
    position_error = listed_returns.peaks.position_error.T
    is_finite = np.isfinite(position_error)

    def deviations_by_errors(errors: np.ndarray, points: np.ndarray) -> RangeVelocityDeviation:
        """Return the standard deviations of range and velocity by the errors of beats.

        Parameters
        ----------
        errors : ndarray (3, m)
            Standard error of each segment's beat [bins], in the order up, Doppler, down; inf for a
            beat that is not used.
        points : ndarray (m,) int64
            Index of the point to which each column belongs.

        Returns
        -------
        RangeVelocityDeviation
            (m,) in each field: standard deviations of range [m] and radial velocity [m/s], by
            :func:`sweep.model.detection.estimators.range_velocity_deviation`.
        """
        up, doppler, down = errors * bin_width[points]
        return range_velocity_deviation(
            up=up,
            doppler=doppler,
            down=down,
            carriers=tuple(carrier[points] for carrier in carriers),
            chirp_rate=chirp_rate[points],
            slopes=shots.waveform.chirp_rate_ratios,
            range=shots.range[points],
            radial_velocity=shots.target.radial_velocity[points],
        )

    def fit_peak_positions(peak_positions: np.ndarray, rounding_variance: float) -> MeasuredValues:
        """Fit range and velocity to the peaks of returns, with weights 1 over the squared errors.

        Parameters
        ----------
        peak_positions : ndarray (m, 3)
            Positions of the up, Doppler and down peak [bins].
        rounding_variance : float
            Variance of the rounding of positions to whole bins [bins^2]; 0 for positions between
            bins. It is added to the squared standard error of each position.

        Returns
        -------
        MeasuredValues
            (m,) in each field: range [m] and radial velocity [m/s] at the shot's start, with
            standard errors. The errors include the wander of beats due to speckle.
        """
        errors = np.where(is_finite, position_error, np.inf)
        errors = np.hypot(errors, math.sqrt(rounding_variance))
        fitted = fit_range_velocity_to_peaks(
            shots, peak_positions.T * bin_width[point], 1 / errors**2, point
        )
        deviations = deviations_by_errors(errors, point)
        if wander_covariance is not None:
            beat_covariance = wander_covariance * (bin_width[point] ** 2)[:, None, None]
            deviations = _add_wander_covariance(
                shots, deviations, beat_covariance, 1 / errors**2, point
            )
        return MeasuredValues(*fitted, *deviations)

    segments = np.array(shots.has_segment)[:, None]
    half_bin_deviation = deviations_by_errors(
        np.where(segments, np.sqrt(0.5), np.inf) + 0 * bin_width, np.arange(shots.size)
    )
    return Measurements(
        by_whole_bins=fit_peak_positions(listed_returns.peaks.bin, BIN_ROUNDING_VARIANCE),
        interpolated=fit_peak_positions(listed_returns.peaks.position, 0.0),
        range_per_half_bin=half_bin_deviation.range[point],
        velocity_per_half_bin=half_bin_deviation.radial_velocity[point],
        range_bias=0.0,
    )


def _add_wander_covariance(
    shots: Shots,
    deviations: RangeVelocityDeviation,
    beat_covariance: np.ndarray,
    weights: np.ndarray,
    point_index: np.ndarray,
) -> RangeVelocityDeviation:
    """Add the variance due to speckle to the standard errors of range and velocity.

    ``beat_covariance`` (m, 3, 3) [Hz^2] is the covariance of the beats of the three segments due to
    speckle.
    """
    coefficients = shots.beat_coefficients.select_points(point_index)
    responses = []
    for unit in np.eye(3):
        beats = unit[:, None] + np.zeros(point_index.size)
        responses.append(
            waveform.range_velocity_response(
                beats,
                weights=weights,
                carriers=coefficients.carrier,
                chirp_rates=coefficients.chirp_rate,
            )
        )
    response_by_beat = np.array(responses)  # (beat, range or velocity, return)
    widened = []
    for value, gains_by_beat in zip(deviations, response_by_beat.swapaxes(0, 1), strict=True):
        covariance_term = sum(
            gains_by_beat[i] * gains_by_beat[j] * beat_covariance[:, i, j]
            for i, j in ((0, 1), (0, 2), (1, 2))
        )
        with np.errstate(invalid="ignore"):
            widened.append(np.sqrt(np.maximum(value**2 + 2 * covariance_term, 0.0)))
    return RangeVelocityDeviation(*widened)


@njit(cache=True, nogil=True, error_model="numpy")
def _draw_returns_of_points(
    keys,
    rows,
    config,
    inputs,
    spectra,
    leakage_bins,
    interpolation,
    workspace,
    peak_lists,
    pairs,
    drawn_peaks,
):
    """Draw the peaks of all segments, draws and points, and pair them into returns.

    Parameters
    ----------
    keys
        (m, 2) uint64: random key of each point.
    rows
        (m,) int64: index of each point in ``drawn_peaks``.
    config, inputs, spectra, leakage_bins
        Settings, and quantities, noiseless spectra and bins of leaked signal of the m points.
    interpolation
        Interpolator of the window.
    workspace, peak_lists, pairs
        Scratch: :class:`DrawWorkspace`, :class:`PeakLists` and
        :class:`sweep.model.pointcloud.pairing.PeakPairs`.
    drawn_peaks
        :class:`DrawnPeaks` of these and other points, the result.
    """
    _, draws, returns_max = drawn_peaks.flags.shape
    is_up_detected, speckle_factors = np.zeros(returns_max, np.bool_), np.ones((returns_max, 3))
    in_speckle = len(inputs.line_grid.line_shift_gradient) > 0
    speckle = empty_group_speckle(returns_max)
    for i in range(rows.size):
        if in_speckle:
            speckle = prepare_group_speckle(i, config, inputs, spectra)
        for d in range(draws):
            address = philox.DrawAddress(keys[i, 0], keys[i, 1], config.first_draw + d)
            if in_speckle:
                draw_group_speckle(address, i, inputs, speckle, speckle_factors)
            for s in range(3):
                if s != 1 or config.has_doppler_segment:
                    draw_segment_peaks(
                        address,
                        i,
                        s,
                        config,
                        inputs,
                        spectra,
                        leakage_bins,
                        speckle_factors,
                        speckle,
                        interpolation,
                        workspace,
                        peak_lists,
                        is_up_detected,
                    )
            pair_into_returns(
                i, rows[i], d, config, inputs, peak_lists, pairs, workspace, drawn_peaks
            )


class GroupSpeckle(NamedTuple):
    """Bins of a point's groups by segment, and their speckle in a draw.

    A group is a run of adjacent bins above the threshold without noise: an echo.
    """

    first_bin: np.ndarray
    """(groups, 3) int64: number of the first bin of each echo (group of adjacent bins), by segment.
    """
    n_bins: np.ndarray
    """(groups, 3) int64: number of bins of each echo; 0 for a segment without the echo."""
    mean_power: np.ndarray
    """(groups, 3, bins): mean over speckle of each bin's power, if all lines of the footprint
    together have the power 1."""
    pseudo_variance_ratio: np.ndarray
    """(groups, 3, bins): pseudo-variance E[A^2] of a bin's complex amplitude A over its mean power
    E[|A|^2]."""
    rms_magnitude_ratio: np.ndarray
    """(groups, 3, bins): root mean square over speckle of the echo's |X| in each bin, over sigma,
    the noise of a bin per quadrature."""
    amplitudes: np.ndarray
    """(groups, looks, 3 segments, bins) complex: speckle, of mean power 1, by which each bin of an
    echo is multiplied in each look (record of a segment). If all looks have the same speckle, the
    axis has one look."""
    covariance_factor_rank: np.ndarray
    """(groups,) int64: number of rows of ``covariance_factor`` in use; 0 if the speckle of the echo
    is not drawn by the factor, but summed over the lines of the footprint."""
    covariance_factor: np.ndarray
    """(groups, rows, 3, bins) complex: factor of the covariance of the bins' speckle. It makes the
    speckle from few random numbers, one for each row."""
    independent_amplitudes: np.ndarray
    """(sets, 3 segments, bins) complex: independent sets of speckle in one draw. They are
    mixed into the partly correlated speckle of the looks (records of a segment)."""
    detection_amplitude_weights: np.ndarray
    """(groups, 3, bins): weights that sum the bins' speckle to one amplitude of mean power 1. This
    amplitude is compared with the probability of detection."""


@njit(cache=True, error_model="numpy")
def empty_group_speckle(groups_max):
    """Return a :class:`GroupSpeckle` for a point whose echoes do not fade."""
    bins = np.zeros((groups_max, 3), np.int64)
    no_amplitudes = np.zeros((groups_max, 1, 3, 0), np.complex128)
    powers = np.zeros((groups_max, 3, 0))
    no_independent = np.zeros((0, 3, 0), np.complex128)
    covariance_factor_rank = np.zeros(groups_max, np.int64)
    return GroupSpeckle(
        first_bin=bins,
        n_bins=bins,
        mean_power=powers,
        pseudo_variance_ratio=powers,
        rms_magnitude_ratio=powers,
        amplitudes=no_amplitudes,
        covariance_factor_rank=covariance_factor_rank,
        covariance_factor=no_amplitudes,
        independent_amplitudes=no_independent,
        detection_amplitude_weights=powers,
    )


@njit(cache=True, error_model="numpy")
def prepare_group_speckle(point, config, inputs, spectra):
    """Return the bins of a point's echoes in which speckle is drawn, with their mean powers.

    Parameters
    ----------
    point : int
        Index of the point.
    config : DrawConfig
        Settings common to all points.
    inputs : DrawInputs
        Quantities of all points.
    spectra : NoiselessSpectra
        Magnitudes, over sigma, of the bins around the lines of all points. sigma is the noise of a
        bin per quadrature.

    Returns
    -------
    GroupSpeckle
        Bins and mean powers of the echoes; its amplitudes are set in each draw.
    """
    (_, _, groups_max), n_bins_max = inputs.strongest_bin.shape, 0
    first_bin, n_bins = np.zeros((groups_max, 3), np.int64), np.zeros((groups_max, 3), np.int64)
    for g in range(groups_max):
        for s in range(3):
            strongest_bin = inputs.strongest_bin[point, s, g]
            if strongest_bin < 0:
                continue
            if config.adds_noise and config.lobe_half_width > 0:
                span_first_bin, span_start = (
                    spectra.first_bin[point, s],
                    spectra.bins_start[point, s],
                )
                span_ratios = spectra.bin_magnitude_ratios[
                    span_start : span_start + spectra.n_bins[point, s]
                ]
                lobe_half_width = max(
                    config.lobe_half_width, int(inputs.bin_thresholds.pedestal_reach_bins[point])
                )
                begin, end = echo_bin_bounds(
                    span_ratios,
                    inputs.first_bin[point, s, g] - span_first_bin,
                    inputs.last_bin[point, s, g] - span_first_bin,
                    inputs.threshold_ratio[point],
                    lobe_half_width,
                )
                first_bin[g, s], n_bins[g, s] = span_first_bin + begin, end - begin + 1
            else:
                first_bin[g, s] = strongest_bin - inputs.line_grid.peak_search_half_width[point]
                n_bins[g, s] = 2 * inputs.line_grid.peak_search_half_width[point] + 1
            n_bins_max = max(n_bins_max, n_bins[g, s])
    mean_power, pseudo_variance_ratio = (
        np.zeros((groups_max, 3, n_bins_max)),
        np.zeros((groups_max, 3, n_bins_max)),
    )
    n_looks = config.n_looks if config.has_independent_speckle else 1
    rows_max = 3 * n_bins_max if 3 * n_bins_max <= FACTORED_BINS_MAX else 0
    covariance_factor_rank, covariance_factor = (
        np.zeros(groups_max, np.int64),
        np.empty((groups_max, rows_max, 3, n_bins_max), np.complex128),
    )
    for g in range(groups_max):
        if n_bins[g].max() == 0:
            continue
        has_images = fill_mean_bin_powers(
            inputs.line_grid,
            point,
            inputs.line_centre[point, :, g],
            first_bin[g],
            mean_power[g],
            pseudo_variance_ratio[g],
        )
        if rows_max > 0 and not has_images:
            covariance_factor_rank[g] = factor_bin_covariance(
                inputs.line_grid,
                point,
                inputs.line_centre[point, :, g],
                first_bin[g],
                mean_power[g],
                covariance_factor[g],
            )
    amplitudes = np.zeros((groups_max, n_looks, 3, n_bins_max), np.complex128)
    _, _, _, n_independent_sets = inputs.look_covariance_root.shape
    independent_amplitudes = np.zeros((n_independent_sets, 3, n_bins_max), np.complex128)
    rms_magnitude_ratio, detection_amplitude_weights = (
        np.zeros((groups_max, 3, n_bins_max)),
        np.zeros((groups_max, 3, n_bins_max)),
    )
    for g in range(groups_max):
        for s in range(3):
            if n_bins[g, s] == 0 or config.adds_noise:
                continue
            fill_detection_amplitude_weights(
                point,
                s,
                g,
                config,
                inputs,
                first_bin,
                mean_power,
                covariance_factor_rank,
                covariance_factor,
                detection_amplitude_weights[g, s],
            )
            strongest_index, noise_sigma = (
                inputs.strongest_bin[point, s, g] - first_bin[g, s],
                inputs.noise_sigma[point],
            )
            for k in range(n_bins[g, s]):
                magnitude = inputs.magnitude[point, s, g]
                if k == strongest_index - 1:
                    magnitude = inputs.magnitude_below[point, s, g]
                elif k == strongest_index + 1:
                    magnitude = inputs.magnitude_above[point, s, g]
                rms_magnitude_ratio[g, s, k] = magnitude / noise_sigma
                if abs(k - strongest_index) > 1:
                    relative_power = mean_power[g, s, k] / mean_power[g, s, strongest_index]
                    rms_magnitude_ratio[g, s, k] *= math.sqrt(relative_power)
    return GroupSpeckle(
        first_bin=first_bin,
        n_bins=n_bins,
        mean_power=mean_power,
        pseudo_variance_ratio=pseudo_variance_ratio,
        rms_magnitude_ratio=rms_magnitude_ratio,
        amplitudes=amplitudes,
        covariance_factor_rank=covariance_factor_rank,
        covariance_factor=covariance_factor,
        independent_amplitudes=independent_amplitudes,
        detection_amplitude_weights=detection_amplitude_weights,
    )


@njit(cache=True, error_model="numpy", borrows=True)
def fill_detection_amplitude_weights(
    point,
    segment,
    group,
    config,
    inputs,
    first_bin,
    mean_power,
    covariance_factor_rank,
    covariance_factor,
    weights,
):
    """Compute the weights of an echo's bins in the amplitude that decides on its detection.

    If any bin may detect, a bin's weight is proportional to the window's transform, for a single
    line in the middle of the echo, times the root of the bin's mean power. The amplitudes of two
    segments then have the same correlation as in the middle of the echo. If only the strongest bin
    may detect, or ``covariance_factor_rank`` is 0, only the strongest bin has a weight.

    Parameters
    ----------
    point, segment, group : int
        Indices of the point, of its segment (up, Doppler, down) and of the echo. An echo is a group
        of adjacent bins.
    config : DrawConfig
        Settings common to all points.
    inputs : DrawInputs
        Quantities of all points.
    first_bin : ndarray (groups, 3) int64
        Number of each echo's first bin, by segment.
    mean_power : ndarray (groups, 3, bins)
        Mean power of each bin over speckle, for lines of the total power 1.
    covariance_factor_rank : ndarray (groups,) int64
        Number of rows of ``covariance_factor`` in use; 0 if speckle is not drawn by the factor, but
        summed over lines.
    covariance_factor : ndarray (groups, rows, 3, bins) complex
        Factor of the covariance of the bins' speckle.
    weights : ndarray (bins,)
        Result: weight of each bin's speckle, such that the amplitude has the mean power 1.
    """
    weights[:] = 0.0
    weights[inputs.strongest_bin[point, segment, group] - first_bin[group, segment]] = 1.0
    if config.lobe_half_width == 0 or covariance_factor_rank[group] == 0:
        return
    weighted_power = 0.0
    for k in range(weights.size):
        distance = first_bin[group, segment] + k - inputs.line_centre[point, segment, group]
        weights[k] = interpolate_transform(distance, inputs.line_grid) * math.sqrt(
            mean_power[group, segment, k]
        )
    for factor_row in range(covariance_factor_rank[group]):
        mode_amplitude = complex(0.0, 0.0)
        for k in range(weights.size):
            mode_amplitude += weights[k] * covariance_factor[group, factor_row, segment, k]
        weighted_power += 2.0 * abs(mode_amplitude) ** 2
    weights /= math.sqrt(weighted_power)


@njit(cache=True, error_model="numpy", borrows=True, forceinline=True)
def draw_group_speckle(address, point, inputs, speckle, speckle_factors):
    """Draw the speckle of a point's echoes, and compute the factors on their magnitudes.

    Parameters
    ----------
    address : DrawAddress
        Keys and number of the draw (:class:`sweep.model.sampling.philox.DrawAddress`).
    point : int
        Index of the point.
    inputs : DrawInputs
        Quantities of all points.
    speckle : GroupSpeckle
        Bins of the point's echoes; the complex ``amplitudes`` are set.
    speckle_factors : ndarray (groups, 3)
        Result: factor on the magnitude of each echo (group of adjacent bins) in each segment.
    """
    n_groups, n_looks, _, _ = speckle.amplitudes.shape
    n_independent_sets = len(speckle.independent_amplitudes)
    for g in range(n_groups):
        speckle_factors[g] = 1.0
        if speckle.n_bins[g].max() == 0:
            continue
        for look in range(n_independent_sets if n_independent_sets > 0 else n_looks):
            look_address = philox.DrawAddress(
                address.key_0, address.key_1, address.draw + look * LOOK_DRAW_STRIDE
            )
            amplitudes = (
                speckle.independent_amplitudes[look]
                if n_independent_sets > 0
                else speckle.amplitudes[g, look]
            )
            if speckle.covariance_factor_rank[g] > 0:
                draw_factored_amplitudes(
                    look_address,
                    g,
                    speckle.covariance_factor[g],
                    speckle.covariance_factor_rank[g],
                    amplitudes,
                )
            else:
                draw_bin_amplitudes(
                    look_address, g, inputs.line_grid, point, inputs.line_centre[point, :, g],
                    speckle.first_bin[g], speckle.mean_power[g], amplitudes,
                )  # fmt: skip
        if n_independent_sets > 0:
            mix_look_amplitudes(
                inputs.look_covariance_root[point],
                speckle.independent_amplitudes,
                speckle.amplitudes[g],
            )
        for s in range(3):
            if speckle.n_bins[g, s] == 0:
                continue
            strongest_index, power_sum = (
                inputs.strongest_bin[point, s, g] - speckle.first_bin[g, s],
                0.0,
            )
            for look in range(n_looks):
                amplitudes = speckle.amplitudes[g, look, s]
                strongest_amplitude = amplitudes[strongest_index]
                for k in range(speckle.n_bins[g, s]):
                    if not speckle.mean_power[g, s, k] > 0.0:  # no line reaches it
                        amplitudes[k] = strongest_amplitude
                power_sum += strongest_amplitude.real**2 + strongest_amplitude.imag**2
            speckle_factors[g, s] = math.sqrt(power_sum / n_looks)


@njit(cache=True, error_model="numpy", borrows=True)
def mix_look_amplitudes(covariance_root, independent_amplitudes, look_amplitudes):
    """Mix independent speckle into the correlated speckle of looks (records of each segment).

    Parameters
    ----------
    covariance_root : ndarray (3, looks, sets) complex
        Coefficients of each independent set in each look, by segment.
    independent_amplitudes : ndarray (sets, 3 segments, bins) complex
        Independent sets of speckle, of mean power 1.
    look_amplitudes : ndarray (looks, 3 segments, bins) complex
        Result: speckle in each look.
    """
    look_amplitudes[:] = 0.0
    n_sets, _, n_bins = independent_amplitudes.shape
    for look in range(len(look_amplitudes)):
        for s in range(3):
            for set_index in range(n_sets):
                for bin_ in range(n_bins):
                    look_amplitudes[look, s, bin_] += (
                        covariance_root[s, look, set_index]
                        * independent_amplitudes[set_index, s, bin_]
                    )


@njit(cache=True, error_model="numpy", borrows=True, forceinline=True)
def pair_into_returns(point, row, draw, config, inputs, peak_lists, pairs, workspace, drawn_peaks):
    """Pair the peaks of one point and draw into returns, and compare each return with the truth.

    Parameters
    ----------
    point
        Index of the point in ``inputs``.
    row, draw
        Index of the point, and index of the draw, in ``drawn_peaks``.
    config, inputs
        Settings, and quantities of the points.
    peak_lists
        :class:`PeakLists` of the draw.
    pairs
        :class:`sweep.model.pointcloud.pairing.PeakPairs`: scratch.
    workspace
        Scratch.
    drawn_peaks
        Result.
    """
    peaks = peak_lists.peaks
    n_up, n_doppler, n_down = (
        peak_lists.n_peaks[0],
        peak_lists.n_peaks[1],
        peak_lists.n_peaks[2],
    )
    if config.has_doppler_segment:
        n_confirmed, n_pairs = pair_peaks(
            peaks.position[0, :n_up],
            peaks.position[1, :n_doppler],
            peaks.position[2, :n_down],
            DopplerPrediction(
                inputs.doppler_prediction.up_coefficient[point],
                inputs.doppler_prediction.down_coefficient[point],
                inputs.doppler_prediction.motion_shift_max_bins[point],
            ),
            2.0 * config.nyquist_bin,
            config.down_beat_sign,
            config.two_beat_reading,
            CONFIRMATION_TOLERANCE_BINS,
            pairs,
        )
    else:
        n_confirmed = n_pairs = min(n_up, n_down)
        for r in range(n_pairs):
            pairs.up_index[r], pairs.doppler_index[r], pairs.down_index[r] = r, -1, r
            pairs.reading[r] = config.two_beat_reading
    _, _, returns_max = drawn_peaks.flags.shape
    for r in range(min(n_pairs, returns_max)):
        drawn_peaks.reading[row, draw, r] = pairs.reading[r]
        group, positions = drawn_peaks.group[row, draw, r], workspace.peak_positions
        peak_of_segment = pairs.up_index[r], pairs.doppler_index[r], pairs.down_index[r]
        for s in range(3):
            k = peak_of_segment[s]
            if k < 0:  # no Doppler peak
                positions[s] = 0.0
                continue
            group[s], positions[s] = peak_lists.group[s, k], peaks.position[s, k]
            drawn_peaks.peaks.bin[row, draw, r, s] = peaks.bin[s, k]
            drawn_peaks.peaks.position[row, draw, r, s] = peaks.position[s, k]
            drawn_peaks.peaks.position_error[row, draw, r, s] = peaks.position_error[s, k]
            drawn_peaks.peaks.magnitude_ratio[row, draw, r, s] = peaks.magnitude_ratio[s, k]
            if group[s] < 0:
                continue
            # Without the echo's wander by speckle.
            if len(inputs.line_grid.line_shift_gradient) > 0:
                positions[s] = inputs.line_centre[point, s, group[s]]
            if config.down_beat_sign != 0.0:  # groups may be multiples of N from their peaks
                bin_distance = inputs.strongest_bin[point, s, group[s]] - positions[s]
                positions[s] += (
                    2
                    * config.nyquist_bin
                    * math.floor(bin_distance / (2 * config.nyquist_bin) + 0.5)
                )
        flag, drawn_peaks.beamlet[row, draw, r] = compare_return_with_truth(
            group,
            positions,
            inputs.first_bin[point],
            inputs.last_bin[point],
            inputs.line_positions[point],
            inputs.beamlet_amplitude[point],
        )
        drawn_peaks.flags[row, draw, r] = flag | (UNCONFIRMED_FLAG if r >= n_confirmed else 0)


@njit(cache=True, error_model="numpy", borrows=True, forceinline=True)
def draw_segment_peaks(
    address,
    point,
    segment,
    config,
    inputs,
    spectra,
    leakage_bins,
    speckle_factors,
    speckle,
    interpolation,
    workspace,
    peak_lists,
    is_up_detected,
):
    """Draw the peaks of one segment in one draw.

    Parameters
    ----------
    address
        Address of the draw (:class:`sweep.model.sampling.philox.DrawAddress`).
    point, segment
        Index of the point, and segment.
    config, inputs, spectra, leakage_bins
        Settings, quantities of the points, noiseless spectra, and bins of leaked signal.
    speckle_factors
        (groups, 3): factors, due to speckle, on the groups' magnitudes.
    speckle
        Speckle in the bins of the point's groups.
    interpolation
        Interpolator of the window.
    workspace
        Scratch.
    peak_lists
        :class:`PeakLists`, the result: those of this segment are set.
    is_up_detected
        (groups,) bool: True for groups detected in the up segment. The up segment is drawn first
        and sets this array.
    """
    key_0, key_1, draw = address
    noise_sigma, threshold_ratio = inputs.noise_sigma[point], inputs.threshold_ratio[point]
    line_noise_ratio, strongest_bins = (
        inputs.line_noise_ratio[point],
        inputs.strongest_bin[point, segment],
    )
    n_peaks = INTEGER_ZERO
    for g in range(strongest_bins.size):
        if strongest_bins[g] < 0:
            break
        if config.adds_noise and config.lobe_half_width > 0:
            is_detected, peak = detect_by_any_bin(
                address,
                point,
                segment,
                g,
                config,
                inputs,
                spectra,
                speckle,
                interpolation,
                workspace,
            )
        elif config.adds_noise:
            is_detected, peak = detect_by_peak_bin(
                address,
                point,
                segment,
                g,
                config,
                inputs,
                spectra,
                speckle,
                interpolation,
                workspace,
            )
        elif speckle.n_bins[g, segment] > 0:
            is_detected, peak = detect_in_speckle(
                address, point, segment, g, config, inputs, speckle, interpolation, workspace
            )
        else:
            pd = inputs.pd[point, segment, g]
            if segment == 2 and is_up_detected[g]:
                pd = inputs.down_pd_if_up_detected[point, g]
            elif segment == 2:
                pd = inputs.down_pd_if_up_missed[point, g]
            uniform = philox.uniform(key_0, key_1, draw, philox.STREAM_DETECTION[segment], g)
            is_detected, peak = uniform < pd, UNDETECTED_PEAK
            if is_detected:
                offset, ratio = (
                    estimate_sub_bin_offset(
                        inputs.magnitude_below[point, segment, g],
                        inputs.magnitude[point, segment, g],
                        inputs.magnitude_above[point, segment, g],
                        interpolation,
                    ),
                    inputs.magnitude[point, segment, g] / noise_sigma,
                )
                error = sub_bin_standard_error(
                    offset, ratio / line_noise_ratio, interpolation
                ) / math.sqrt(config.n_looks)
                # Add the power of the pedestal under the lines.
                ratio = math.sqrt(ratio * ratio + 2.0 * (line_noise_ratio * line_noise_ratio - 1.0))
                normal, _ = philox.normal_pair(key_0, key_1, draw, philox.STREAM_NOISE[segment], g)
                peak = fold_peak(
                    strongest_bins[g],
                    strongest_bins[g] + offset + error * normal,
                    error,
                    ratio,
                    inputs.line_deviation_bins[point, segment, g],
                    config,
                    interpolation,
                )
        if segment == 0:
            is_up_detected[g] = is_detected
        if is_detected:
            store_peak(peak, g, segment, n_peaks, peak_lists)
            n_peaks += 1
    _, n_peaks_max = peak_lists.group.shape
    n_free = n_peaks_max - n_peaks
    false_peak_bins, false_peak_magnitude_ratios, n_false = (
        workspace.false_peak_bins[:n_free],
        workspace.false_peak_magnitude_ratios[:n_free],
        0,
    )
    false_peak_magnitude_ratios[:] = 0.0
    if config.adds_noise:
        n_false = list_noisy_leaked_peaks(
            address,
            point,
            segment,
            spectra,
            leakage_bins,
            speckle_factors[:, segment],
            threshold_ratio,
            interpolation,
            false_peak_bins,
            false_peak_magnitude_ratios,
        )
    else:
        n_false = draw_leaked_peaks(
            address,
            point,
            segment,
            leakage_bins,
            speckle_factors,
            threshold_ratio,
            config.n_looks,
            interpolation,
            false_peak_bins,
            false_peak_magnitude_ratios,
        )
    stream = (
        philox.STREAM_NOISE_MAXIMUM[segment]
        if config.adds_noise
        else philox.STREAM_FALSE_ALARM[segment]
    )
    alarm_word, bin_word, _, _ = philox.four_words(
        key_0, key_1, draw, stream, philox.FIRST_BLOCK_NUMBER
    )
    uniform = philox.to_uniform(alarm_word)
    if uniform < inputs.pfa_noise[point, segment]:
        ratio = max(
            noise_maximum_at_probability(
                spectra.n_noise_bins[point, segment], uniform, config.n_looks
            ),
            threshold_ratio,
        )
        no_noise_peak_bins = leakage_bins.no_noise_peak_bins[
            leakage_bins.no_noise_peak_begin[point, segment] : leakage_bins.no_noise_peak_end[
                point, segment
            ]
        ]
        false_bin = draw_false_peak_bin(
            philox.to_uniform(bin_word),
            strongest_bins,
            inputs.first_bin[point, segment],
            inputs.last_bin[point, segment],
            no_noise_peak_bins,
            inputs.first_searched_bin[point, segment],
            inputs.last_searched_bin[point, segment],
            2 * config.nyquist_bin,
            config.down_beat_sign,
        )
        n_false = insert_peak(
            false_bin, ratio, false_peak_bins, false_peak_magnitude_ratios, n_false
        )
    for n in range(n_false):
        error = sub_bin_standard_error(
            0.0, false_peak_magnitude_ratios[n], interpolation
        ) / math.sqrt(config.n_looks)
        peak = fold_peak(
            false_peak_bins[n],
            float(false_peak_bins[n]),
            error,
            false_peak_magnitude_ratios[n],
            0.0,
            config,
            interpolation,
        )
        store_peak(peak, FALSE_PEAK_GROUP, segment, n_peaks, peak_lists)
        n_peaks += 1
    peak_lists.n_peaks[segment] = n_peaks


@njit(cache=True, error_model="numpy", borrows=True)
def list_noisy_leaked_peaks(
    address,
    point,
    segment,
    spectra,
    leakage_bins,
    speckle_factors,
    threshold_ratio,
    interpolation,
    bins,
    ratios,
):
    """List the strongest peaks of bins of leaked signal with their noise.

    Adjacent bins that reach the threshold make one peak, in the largest bin. They belong to the
    echo, and are not listed, if they are adjacent to a crossing bin of the echo.

    Parameters
    ----------
    address : DrawAddress
        Keys and number of the draw (:class:`sweep.model.sampling.philox.DrawAddress`).
    point, segment : int
        Indices of the point and of its segment (up, Doppler, down).
    spectra : NoiselessSpectra
        Bins of leaked signal of all points, with |X| / sigma. sigma is the noise of a bin per
        quadrature.
    leakage_bins : LeakageBins
        Bins of leaked signal; ``fading_group`` is the echo whose speckle makes each bin fade.
    speckle_factors : ndarray (groups,)
        Factors, due to speckle, on the magnitudes of the point's echoes in this segment.
    threshold_ratio : float
        Threshold over sigma.
    interpolation : Interpolator
        Interpolator of the window; it has the noise correlation of adjacent bins.
    bins, ratios : ndarray (groups + 1,)
        Results: bin number, and |X| / sigma, of each peak, the strongest first.

    Returns
    -------
    int
        Number of peaks.
    """
    key_0, key_1, draw = address
    n_peaks, previous_bin, peak, largest = INTEGER_ZERO, np.int64(-2), NO_INDEX, 0.0
    correlation, is_echo = interpolation.sidelobe_neighbour_noise_correlation, False
    independent_part = math.sqrt(1.0 - correlation * correlation)
    for n in range(spectra.leaked_begin[point, segment], spectra.leaked_end[point, segment]):
        re, im = philox.normal_pair(
            key_0, key_1, draw, philox.STREAM_NOISE[segment], spectra.leaked_index[n]
        )
        speckle_factor = speckle_factors[leakage_bins.fading_group[n]]
        ratio = math.hypot(spectra.leaked_magnitude_ratio[n] * speckle_factor + re, im)
        if ratio < threshold_ratio:
            continue
        bin_number = spectra.first_bin[point, segment] + spectra.leaked_index[n]
        if bin_number != previous_bin + 1:
            n_peaks = insert_peak(NO_INDEX if is_echo else peak, largest, bins, ratios, n_peaks)
            peak, largest, is_echo = NO_INDEX, 0.0, False
        previous_bin = bin_number
        if ratio > largest:
            peak, largest = bin_number, ratio
        if spectra.exempt_neighbour_magnitude_ratio[n] > 0.0:
            neighbour_index = spectra.leaked_index[n] + spectra.side_of_adjacent_echo_bin[n]
            re_own, im_own = philox.normal_pair(
                key_0, key_1, draw, philox.STREAM_NOISE[segment], neighbour_index
            )
            in_phase = (
                spectra.exempt_neighbour_magnitude_ratio[n] * speckle_factor
                + correlation * re
                + independent_part * re_own
            )
            is_echo |= (
                math.hypot(in_phase, correlation * im + independent_part * im_own)
                >= threshold_ratio
            )
    return insert_peak(NO_INDEX if is_echo else peak, largest, bins, ratios, n_peaks)


@njit(cache=True, error_model="numpy", borrows=True, forceinline=True)
def detect_by_peak_bin(
    address, point, segment, group, config, inputs, spectra, speckle, interpolation, workspace
):
    """Add noise to an echo's strongest bin, and detect the echo if its sum reaches the threshold.

    Parameters
    ----------
    address : DrawAddress
        Keys and number of the draw (:class:`sweep.model.sampling.philox.DrawAddress`).
    point, segment, group : int
        Indices of the point, of its segment (up, Doppler, down) and of the echo. An echo is a group
        of adjacent bins.
    config : DrawConfig
        Settings common to all points.
    inputs : DrawInputs
        Quantities of all points.
    spectra : NoiselessSpectra
        Magnitudes, over sigma, of the bins around the lines of all points. sigma is the noise of a
        bin per quadrature.
    speckle : GroupSpeckle
        Speckle of this draw in the bins of the point's echoes.
    interpolation : Interpolator
        Interpolator of the window, for the position between bins.
    workspace : DrawWorkspace
        Scratch arrays.

    Returns
    -------
    is_detected : bool
        True if the echo is detected.
    peak : Peak
        Its peak; UNDETECTED_PEAK if it is not detected.
    """
    key_0, key_1, draw = address
    noise_sigma, threshold_ratio = inputs.noise_sigma[point], inputs.threshold_ratio[point]
    line_noise_ratio = inputs.line_noise_ratio[point]
    strongest_bin, stream = (
        inputs.strongest_bin[point, segment, group],
        philox.STREAM_NOISE[segment],
    )
    k = strongest_bin - spectra.first_bin[point, segment]
    re, im = philox.normal_pair(key_0, key_1, draw, stream, k)
    is_real = is_real_bin(
        strongest_bin, config.fft_size_if_end_bins_real > 0, config.fft_size_if_end_bins_real
    )
    if is_real:
        re, im = math.sqrt(2.0) * re, 0.0
    re, im = re * line_noise_ratio, im * line_noise_ratio
    near_end = speckle.n_bins[group, segment] > 0 and is_near_spectrum_end(
        strongest_bin - 1, THREE_BINS, config
    )
    noise = workspace.noise
    if near_end:
        draw_noise_near_spectrum_end(
            address,
            stream,
            ECHO_NOISE_FIRST_RANDOM_INDEX * (1 + group),
            strongest_bin - 1,
            THREE_BINS,
            config,
            noise,
        )
        re, im = line_noise_ratio * noise.in_phase[1], line_noise_ratio * noise.in_quadrature[1]
    amplitude = speckled_amplitude(
        inputs.magnitude[point, segment, group] / noise_sigma, speckle, group, segment, 1
    )
    if (amplitude.real + re) ** 2 + (amplitude.imag + im) ** 2 < threshold_ratio * threshold_ratio:
        return False, UNDETECTED_PEAK
    # Neighbours are exempt from false alarms, so the random numbers of their bins are unused.
    re_below, im_below = philox.normal_pair(key_0, key_1, draw, stream, k - 1 if k > 0 else k + 2)
    re_above, im_above = philox.normal_pair(key_0, key_1, draw, stream, k + 1)
    re_below, im_below = re_below * line_noise_ratio, im_below * line_noise_ratio
    re_above, im_above = re_above * line_noise_ratio, im_above * line_noise_ratio
    from_centre, above_from_independent, below_from_above, below_from_independent = (
        interpolation.noise_mixing
    )
    amplitude_below = speckled_amplitude(
        inputs.magnitude_below[point, segment, group] / noise_sigma, speckle, group, segment, 0
    )
    amplitude_above = speckled_amplitude(
        inputs.magnitude_above[point, segment, group] / noise_sigma, speckle, group, segment, 2
    )
    below_ratio = math.hypot(
        amplitude_below.real
        + (from_centre * re + below_from_above * re_above + below_from_independent * re_below),
        amplitude_below.imag
        + (from_centre * im + below_from_above * im_above + below_from_independent * im_below),
    )
    centre_ratio = math.hypot(amplitude.real + re, amplitude.imag + im)
    above_ratio = math.hypot(
        amplitude_above.real + (from_centre * re + above_from_independent * re_above),
        amplitude_above.imag + (from_centre * im + above_from_independent * im_above),
    )
    if near_end:
        below_ratio = abs(
            amplitude_below + line_noise_ratio * complex(noise.in_phase[0], noise.in_quadrature[0])
        )
        above_ratio = abs(
            amplitude_above + line_noise_ratio * complex(noise.in_phase[2], noise.in_quadrature[2])
        )
    offset = estimate_sub_bin_offset(below_ratio, centre_ratio, above_ratio, interpolation)
    peak_shift = 0
    if max(below_ratio, above_ratio) > centre_ratio:
        peak_shift = 1 if above_ratio > below_ratio else -1
    error, ratio = (
        sub_bin_standard_error(offset, centre_ratio / line_noise_ratio, interpolation),
        max(below_ratio, centre_ratio, above_ratio),
    )
    return True, fold_peak(
        strongest_bin + peak_shift,
        strongest_bin + offset,
        error,
        ratio,
        inputs.line_deviation_bins[point, segment, group],
        config,
        interpolation,
    )


@njit(cache=True, error_model="numpy", borrows=True)
def speckled_amplitude(magnitude, speckle, group, segment, bin_index):
    """Return the complex amplitude of a bin of an echo in a draw: rms magnitude times speckle.

    Parameters
    ----------
    magnitude : float
        Root mean square magnitude of the bin over speckle, in any unit.
    speckle : GroupSpeckle
        Speckle of the draw.
    group, segment : int
        Indices of the echo (group of adjacent bins) and of the segment.
    bin_index : int
        Index of the bin, counted from the echo's first bin.
    """
    if speckle.n_bins[group, segment] == 0:
        return complex(magnitude, 0.0)
    return magnitude * speckle.amplitudes[group, 0, segment, bin_index]


@njit(cache=True, error_model="numpy", borrows=True, forceinline=True)
def detect_in_speckle(
    address, point, segment, group, config, inputs, speckle, interpolation, workspace
):
    """Draw an echo in developed speckle; it is detected with its probability of detection.

    Parameters
    ----------
    address : DrawAddress
        Keys and number of the draw (:class:`sweep.model.sampling.philox.DrawAddress`).
    point, segment, group : int
        Indices of the point, of its segment (up, Doppler, down) and of the echo. An echo is a group
        of adjacent bins.
    config : DrawConfig
        Settings common to all points.
    inputs : DrawInputs
        Quantities of all points.
    speckle : GroupSpeckle
        Speckle of this draw in the bins of the point's echoes.
    interpolation : Interpolator
        Interpolator of the window, for the position between bins.
    workspace : DrawWorkspace
        Scratch arrays.

    Returns
    -------
    is_detected : bool
        True if the echo is detected.
    peak : Peak
        Its peak; UNDETECTED_PEAK if it is not detected.

    Notes
    -----
    The group's amplitude is a complex Gaussian number: echo plus noise, with ``echo_fraction`` of
    the mean power in the echo. The group is detected if its power exceeds the level that is
    exceeded with the group's probability of detection. So segments are detected together as two
    correlated Rayleigh magnitudes with these probabilities, by
    :func:`sweep.model.detection.echo_detection.joint_pd_in_speckle`. An echo that counts as several
    independent bins is detected by any of as many amplitudes, the first of which is the drawn one.
    Several looks detect by the powers of their strongest bins.
    """
    threshold_ratio, line_noise_ratio = (
        inputs.threshold_ratio[point],
        inputs.line_noise_ratio[point],
    )
    strongest_bin, first_bin = (
        inputs.strongest_bin[point, segment, group],
        speckle.first_bin[group, segment],
    )
    strongest_index, n_bins, pd = (
        strongest_bin - first_bin,
        speckle.n_bins[group, segment],
        inputs.pd[point, segment, group],
    )
    n_independent_bins = inputs.n_independent_bins[point, segment, group]
    if n_independent_bins > 1.0:
        pd = pd_of_one_independent_bin_kernel(pd, n_independent_bins)
    echo_fraction, is_noncircular = (
        inputs.echo_fraction[point, segment, group],
        is_near_spectrum_end(first_bin, n_bins, config),
    )
    if not pd > 0.0:
        return False, UNDETECTED_PEAK
    _, n_speckle_looks, _, _ = speckle.amplitudes.shape
    power, noise = workspace.bin_power[:n_bins], workspace.noise
    power[:] = 0.0
    in_phase, in_quadrature, n_votes = 0.0, 0.0, 0
    echo_weight, noise_weight = math.sqrt(echo_fraction), math.sqrt(0.5 * (1.0 - echo_fraction))
    for look in range(config.n_looks):
        look_address = philox.DrawAddress(
            address.key_0, address.key_1, address.draw + look * LOOK_DRAW_STRIDE
        )
        if n_bins == 3 and not is_noncircular:
            draw_three_bin_noise(
                look_address, philox.STREAM_NOISE[segment], 3 * group, interpolation, noise
            )
        else:
            draw_adjacent_bin_noise(
                look_address,
                philox.STREAM_NOISE[segment],
                ECHO_NOISE_FIRST_RANDOM_INDEX * (1 + group),
                first_bin,
                n_bins,
                config,
                noise,
            )
        bin_amplitudes = speckle.amplitudes[group, look if n_speckle_looks > 1 else 0, segment]
        for k in range(n_bins):
            magnitude_ratio, bin_weight = (
                speckle.rms_magnitude_ratio[group, segment, k],
                echo_weight * speckle.detection_amplitude_weights[group, segment, k],
            )
            re = magnitude_ratio * bin_amplitudes[k].real + line_noise_ratio * noise.in_phase[k]
            im = (
                magnitude_ratio * bin_amplitudes[k].imag + line_noise_ratio * noise.in_quadrature[k]
            )
            if look == 0:
                in_phase, in_quadrature = (
                    in_phase + bin_weight * bin_amplitudes[k].real,
                    in_quadrature + bin_weight * bin_amplitudes[k].imag,
                )
            if k == strongest_index and look == 0:
                in_phase, in_quadrature = (
                    in_phase + noise_weight * noise.in_phase[k],
                    in_quadrature + noise_weight * noise.in_quadrature[k],
                )
            if k == strongest_index:
                n_votes += re * re + im * im >= threshold_ratio * threshold_ratio
            power[k] += (re * re + im * im) / config.n_looks
    if config.n_looks > 1 and config.votes_needed >= 0:
        is_detected = (
            n_votes >= config.votes_needed
            if config.votes_needed > 0
            else power[strongest_index] >= threshold_ratio * threshold_ratio
        )
    elif is_noncircular:
        mean_pseudo_variance = (
            echo_fraction * speckle.pseudo_variance_ratio[group, segment, strongest_index]
        )
        mean_pseudo_variance += (1.0 - echo_fraction) * pseudo_variance_ratio_at(
            abs(strongest_bin), config.nyquist_bin, config.noise_pseudo_variance_ratio
        )
        is_detected = (
            hoyt_tails(1.0, mean_pseudo_variance, math.hypot(in_phase, in_quadrature)).above < pd
        )
    else:
        is_detected = math.exp(-(in_phase * in_phase + in_quadrature * in_quadrature)) < pd
        if not is_detected and n_independent_bins > 1.0:
            is_detected = is_detected_by_other_bin(address, point, segment, group, inputs, pd)
    if not is_detected:
        return False, UNDETECTED_PEAK
    peak_index = strongest_index
    if n_bins > 3:
        for k in range(1, n_bins - 1):
            peak_index = k if power[k] > power[peak_index] else peak_index
    below, peak_magnitude, above = (
        math.sqrt(power[peak_index - 1]),
        math.sqrt(power[peak_index]),
        math.sqrt(power[peak_index + 1]),
    )
    offset, peak_shift = estimate_sub_bin_offset(below, peak_magnitude, above, interpolation), 0
    if max(below, above) > peak_magnitude:
        peak_shift = 1 if above > below else -1
    error = sub_bin_standard_error(
        offset, peak_magnitude / line_noise_ratio, interpolation
    ) / math.sqrt(config.n_looks)
    ratio = max(below, peak_magnitude, above, threshold_ratio)
    return True, fold_peak(
        first_bin + peak_index + peak_shift,
        first_bin + peak_index + offset,
        error,
        ratio,
        0.0,
        config,
        interpolation,
    )


_OTHER_BINS_FIRST_RANDOM_INDEX = 1 << 22
"""Index, in the stream, of the first random number used for the independent bins of echo 0 without
its strongest bin. Later echoes use later ranges of indices."""


@njit(cache=True, error_model="numpy", borrows=True)
def is_detected_by_other_bin(address, point, segment, group, inputs, single_bin_pd):
    """Return True if an independent bin of an echo, not its strongest, detects the echo.

    Parameters
    ----------
    address : DrawAddress
        Keys and number of the draw (:class:`sweep.model.sampling.philox.DrawAddress`).
    point, segment, group : int
        Indices of the point, of its segment (up, Doppler, down) and of the echo. An echo is a group
        of adjacent bins.
    inputs : DrawInputs
        Quantities of all points. ``n_independent_bins`` is the number of bins; its fractional part
        counts as that fraction of a bin.
    single_bin_pd : float
        Probability of detection of one bin, 0..1.
    """
    key_0, key_1, draw = address
    n_bins_left, echo_fraction = (
        inputs.n_independent_bins[point, segment, group] - 1.0,
        inputs.echo_fraction[point, segment, group],
    )
    random_index = _OTHER_BINS_FIRST_RANDOM_INDEX + group * int(DRAWN_INDEPENDENT_BINS_MAX)
    while n_bins_left > 1e-6:
        speckle_amplitude = speckle_amplitudes(
            address, random_index, speckle_mixing_of_point(inputs.speckle_mixing, point)
        )[segment]
        re, im = philox.normal_pair(key_0, key_1, draw, philox.STREAM_NOISE[segment], random_index)
        noise_weight, echo_weight = math.sqrt(0.5 * (1.0 - echo_fraction)), math.sqrt(echo_fraction)
        power = (echo_weight * speckle_amplitude.real + noise_weight * re) ** 2 + (
            echo_weight * speckle_amplitude.imag + noise_weight * im
        ) ** 2
        if math.exp(-power) < (
            single_bin_pd
            if n_bins_left >= 1.0
            else pd_of_any_independent_bin(single_bin_pd, n_bins_left)
        ):
            return True
        n_bins_left, random_index = n_bins_left - 1.0, random_index + 1
    return False


@njit(cache=True, error_model="numpy", borrows=True)
def draw_adjacent_bin_noise(address, stream, first_index, first_bin, n_bins, config, noise):
    """Draw the noise of adjacent bins, in units of sigma, into ``noise``.

    sigma is the standard deviation of a bin's noise per quadrature.

    Parameters
    ----------
    address, stream
        Address of the draw (:class:`sweep.model.sampling.philox.DrawAddress`), and stream.
    first_index
        Stream index of the first pair of independent numbers.
    first_bin, n_bins
        First bin, and number of bins.
    config
        Settings with the filters.
    noise
        :class:`sweep.model.sampling.draws.NoiseScratch`, the result. It has at least as many bins;
        for bins near DC or Nyquist as many as ``config.spectrum_end_noise_filter``.
    """
    touches_end = config.fft_size_if_end_bins_real > 0 and (
        first_bin == 0 or 2 * (first_bin + n_bins - 1) == config.fft_size_if_end_bins_real
    )
    if is_near_spectrum_end(first_bin, n_bins, config):
        draw_noise_near_spectrum_end(address, stream, first_index, first_bin, n_bins, config, noise)
    elif n_bins <= len(config.noise_covariance_root) and not touches_end:
        draw_bin_noise_by_root(
            address, stream, first_index, n_bins, config.noise_covariance_root, noise
        )
    else:
        draw_bin_noise(address, stream, first_index, first_bin, n_bins, config.noise_filter, noise)


@njit(cache=True, error_model="numpy", borrows=True, forceinline=True)
def is_near_spectrum_end(first_bin, n_bins, config):
    """Return True if any of the adjacent bins has non-circular noise, near frequency 0 or Nyquist.

    Parameters
    ----------
    first_bin, n_bins : int
        First bin, and number of bins.
    config : DrawConfig
        Settings; ``noise_pseudo_variance_ratio`` has one value for each bin with such noise.
    """
    n_near_bins = config.noise_pseudo_variance_ratio.size
    return n_near_bins > 0 and (
        first_bin < n_near_bins or first_bin + n_bins - 1 > config.nyquist_bin - n_near_bins
    )


@njit(cache=True, error_model="numpy", borrows=True)
def draw_noise_near_spectrum_end(address, stream, first_index, first_bin, n_bins, config, noise):
    """Draw the noise of adjacent bins near frequency 0 (DC) or Nyquist, in units of sigma.

    sigma is the standard deviation of a bin's noise per quadrature. Bins beyond frequency 0 or
    Nyquist are complex conjugates of their mirror images.

    Parameters
    ----------
    address : DrawAddress
        Keys and number of the draw (:class:`sweep.model.sampling.philox.DrawAddress`).
    stream : int
        Number of the random stream.
    first_index : int
        Index in the stream of the first pair of independent numbers.
    first_bin : int
        First bin, which may be negative.
    n_bins : int
        Number of bins.
    config : DrawConfig
        Settings; ``spectrum_end_noise_filter`` is the filter for these bins.
    noise : NoiseScratch
        Result: noise of each bin in both quadratures, over its standard deviation per quadrature.
        It has at least as many bins as ``spectrum_end_noise_filter``.
    """
    last_bin = first_bin + n_bins - 1
    drawn_first, drawn_last = 0, max(last_bin, -first_bin)
    if first_bin >= config.noise_pseudo_variance_ratio.size:
        drawn_first, drawn_last = (
            min(first_bin, 2 * config.nyquist_bin - last_bin),
            config.nyquist_bin,
        )
    draw_bin_noise(
        address,
        stream,
        first_index,
        drawn_first,
        drawn_last - drawn_first + 1,
        config.spectrum_end_noise_filter,
        noise,
    )
    # The independent numbers are no longer needed.
    drawn_re, drawn_im = noise.independent_in_phase, noise.independent_in_quadrature
    for k in range(drawn_last - drawn_first + 1):
        drawn_re[k], drawn_im[k] = noise.in_phase[k], noise.in_quadrature[k]
    for k in range(n_bins):
        bin_ = abs(first_bin + k)
        sign = -1.0 if first_bin + k < 0 or bin_ > config.nyquist_bin else 1.0
        bin_ = min(bin_, 2 * config.nyquist_bin - bin_) - drawn_first
        noise.in_phase[k], noise.in_quadrature[k] = drawn_re[bin_], sign * drawn_im[bin_]


@njit(cache=True, error_model="numpy", borrows=True)
def draw_three_bin_noise(address, stream, first_index, interpolation, noise):
    """Draw the noise of three adjacent bins, in units of sigma, into ``noise``.

    sigma is the standard deviation of a bin's noise per quadrature.

    Parameters
    ----------
    address, stream
        Address of the draw (:class:`sweep.model.sampling.philox.DrawAddress`), and stream.
    first_index
        Stream index of the first pair of independent numbers.
    interpolation
        Interpolator of the window.
    noise
        :class:`sweep.model.sampling.draws.NoiseScratch`, the result.
    """
    noise_re, noise_im = noise.in_phase, noise.in_quadrature
    from_centre, above_from_independent, below_from_above, below_from_independent = (
        interpolation.noise_mixing
    )
    key_0, key_1, draw = address
    block = first_index >> 1
    # Each block of four words makes two pairs, of which the first has an even index.
    even_radius, even_angle, odd_radius, odd_angle = philox.four_words(
        key_0, key_1, draw, stream, block
    )
    next_even_radius, next_even_angle, next_odd_radius, next_odd_angle = philox.four_words(
        key_0, key_1, draw, stream, block + 1
    )
    if first_index & 1:
        re, im = philox.to_normals(odd_radius, odd_angle)
        re_above, im_above = philox.to_normals(next_even_radius, next_even_angle)
        re_below, im_below = philox.to_normals(next_odd_radius, next_odd_angle)
    else:
        re, im = philox.to_normals(even_radius, even_angle)
        re_above, im_above = philox.to_normals(odd_radius, odd_angle)
        re_below, im_below = philox.to_normals(next_even_radius, next_even_angle)
    noise_re[0] = from_centre * re + below_from_above * re_above + below_from_independent * re_below
    noise_im[0] = from_centre * im + below_from_above * im_above + below_from_independent * im_below
    noise_re[1], noise_im[1] = re, im
    noise_re[2], noise_im[2] = (
        from_centre * re + above_from_independent * re_above,
        from_centre * im + above_from_independent * im_above,
    )


@njit(cache=True, error_model="numpy", borrows=True, forceinline=True)
def detect_by_any_bin(
    address, point, segment, group, config, inputs, spectra, speckle, interpolation, workspace
):
    """Add noise to all bins of an echo, and detect the echo if any reaches the threshold.

    The peak is the largest of these bins.

    Parameters
    ----------
    address : DrawAddress
        Keys and number of the draw (:class:`sweep.model.sampling.philox.DrawAddress`).
    point, segment, group : int
        Indices of the point, of its segment (up, Doppler, down) and of the echo. An echo is a group
        of adjacent bins.
    config : DrawConfig
        Settings common to all points.
    inputs : DrawInputs
        Quantities of all points.
    spectra : NoiselessSpectra
        Magnitudes, over sigma, of the bins around the lines of all points. sigma is the noise of a
        bin per quadrature.
    speckle : GroupSpeckle
        Speckle of this draw in the bins of the point's echoes.
    interpolation : Interpolator
        Interpolator of the window, for the position between bins.
    workspace : DrawWorkspace
        Scratch arrays.

    Returns
    -------
    is_detected : bool
        True if the echo is detected.
    peak : Peak
        Its peak; UNDETECTED_PEAK if it is not detected.
    """
    noise_sigma, threshold_ratio = inputs.noise_sigma[point], inputs.threshold_ratio[point]
    line_noise_ratio = inputs.line_noise_ratio[point]
    span_first_bin, span_start = (
        spectra.first_bin[point, segment],
        spectra.bins_start[point, segment],
    )
    span_ratios = spectra.bin_magnitude_ratios[
        span_start : span_start + spectra.n_bins[point, segment]
    ]
    first_index, last_index = (
        inputs.first_bin[point, segment, group] - span_first_bin,
        inputs.last_bin[point, segment, group] - span_first_bin,
    )
    first_index, last_index = echo_bin_bounds(
        span_ratios,
        first_index,
        last_index,
        threshold_ratio,
        max(config.lobe_half_width, int(inputs.bin_thresholds.pedestal_reach_bins[point])),
    )
    n_bins, peak_index = last_index - first_index + 1, 0
    pedestal_power, noise = workspace.pedestal_power[:n_bins], workspace.noise
    ratios = workspace.bin_magnitude_ratio
    pedestal_power[:] = 0.0
    if line_noise_ratio > 1.0:
        magnitudes = workspace.bin_power[:n_bins]
        for k in range(n_bins):
            magnitudes[k] = noise_sigma * span_ratios[first_index + k]
        bin_threshold = bin_threshold_of_point(inputs.bin_thresholds, point)
        fill_pedestal_ratios(
            magnitudes, workspace.all_bins_are_echo[:n_bins], bin_threshold, pedestal_power
        )
    stream, first_number = philox.STREAM_NOISE[segment], ECHO_NOISE_FIRST_RANDOM_INDEX * (1 + group)
    if speckle.n_bins[group, segment] > 0:
        draw_adjacent_bin_noise(
            address, stream, first_number, span_first_bin + first_index, n_bins, config, noise
        )
    else:
        draw_bin_noise(
            address,
            stream,
            first_number,
            span_first_bin + first_index,
            n_bins,
            config.noise_filter,
            noise,
        )
    for k in range(n_bins):
        amplitude, noise_deviation = (
            speckled_amplitude(span_ratios[first_index + k], speckle, group, segment, k),
            1.0,
        )
        if pedestal_power[k] > 0.0:  # the pedestal fades as the lines do
            power = (
                pedestal_power[k] * abs(speckled_amplitude(1.0, speckle, group, segment, k)) ** 2
            )
            noise_deviation = math.sqrt(1.0 + power)
        re, im = (
            amplitude.real + noise_deviation * noise.in_phase[k],
            amplitude.imag + noise_deviation * noise.in_quadrature[k],
        )
        ratios[k] = math.hypot(re, im)
        peak_index = k if ratios[k] > ratios[peak_index] else peak_index
    peak_ratio = ratios[peak_index]
    if peak_ratio < threshold_ratio:
        return False, UNDETECTED_PEAK
    below_ratio = ratios[peak_index - 1] if peak_index > 0 else 0.0
    above_ratio = ratios[peak_index + 1] if peak_index + 1 < n_bins else 0.0
    offset, peak_bin = (
        estimate_sub_bin_offset(below_ratio, peak_ratio, above_ratio, interpolation),
        span_first_bin + first_index + peak_index,
    )
    error = sub_bin_standard_error(offset, peak_ratio / line_noise_ratio, interpolation)
    return True, fold_peak(
        peak_bin,
        peak_bin + offset,
        error,
        peak_ratio,
        inputs.line_deviation_bins[point, segment, group],
        config,
        interpolation,
    )


@njit(cache=True, error_model="numpy", borrows=True)
def fold_peak(bin_number, position, noise_error, ratio, line_deviation, config, interpolation):
    """Return a peak, mirrored into 0..N/2 if its bin is beyond frequency 0 or Nyquist.

    N is the FFT size. A peak of a complex record is not mirrored: its bin wraps from N/2 to -N/2.

    Parameters
    ----------
    bin_number : int
        Number of the peak's largest bin, which may lie beyond DC or Nyquist.
    position : float
        Position between bins [bins].
    noise_error : float
        Standard error of the position due to noise [bins].
    ratio : float
        |X| of the largest bin over sigma, the noise of a bin per quadrature.
    line_deviation : float
        Standard deviation of the positions of the footprint's lines [bins].
    config : DrawConfig
        Settings common to all points.
    interpolation : Interpolator
        Interpolator of the window.

    Returns
    -------
    Peak
        Largest bin, position, standard error (due to noise and the spread of lines) and ratio.
    """
    fft_size = 2 * config.nyquist_bin
    if config.down_beat_sign:
        wrap_shift = fft_size * math.floor((bin_number + config.nyquist_bin) / fft_size)
        folded_bin, folded_position = float(bin_number - wrap_shift), position - wrap_shift
    else:
        folded_bin, folded_position = float(abs(bin_number)), abs(position)
        if folded_bin > config.nyquist_bin:
            folded_bin = fft_size - folded_bin
        if folded_position > config.nyquist_bin:
            folded_position = fft_size - folded_position
    line_error = line_spread_error(
        folded_position - folded_bin,
        line_deviation,
        config.adds_powers or not config.has_doppler_segment,
        interpolation,
    )
    return Peak(folded_bin, folded_position, math.hypot(noise_error, line_error), ratio)


@njit(cache=True, error_model="numpy", borrows=True, forceinline=True)
def store_peak(peak, group, segment, index, peak_lists):
    """Write a peak into the list of a segment, in place.

    Parameters
    ----------
    peak : Peak
        Peak of a group of adjacent bins, or a false one.
    group : int
        Index of the group, or FALSE_PEAK_GROUP.
    segment : int
        Index of the segment (up, Doppler, down).
    index : int
        Index in the list.
    peak_lists : PeakLists
        Lists of the three segments, of which one element is set.
    """
    peaks = peak_lists.peaks
    peaks.bin[segment, index], peaks.position[segment, index] = peak.bin, peak.position
    peaks.position_error[segment, index] = peak.position_error
    peaks.magnitude_ratio[segment, index] = peak.magnitude_ratio
    peak_lists.group[segment, index] = group


@njit(cache=True, error_model="numpy")
def draw_false_peak_bin(
    uniform_number,
    strongest_bins,
    first_bins,
    last_bins,
    no_noise_peak_bins,
    first_searched_bin,
    last_searched_bin,
    fft_size,
    down_beat_sign,
):
    """Return the bin of a false peak of noise, uniform over the searched bins outside all echoes.

    Parameters
    ----------
    uniform_number
        Random number, 0..1.
    strongest_bins, first_bins, last_bins
        (groups,) int64: strongest, first and last bin of each echo (group of adjacent bins). An
        echo includes one bin on either side. Groups end at the first negative strongest bin.
    no_noise_peak_bins
        (excluded,) int64: bins outside the echoes that are not drawn either.
    first_searched_bin, last_searched_bin
        First and last bin that may be drawn.
    fft_size
        FFT size N.
    down_beat_sign
        0 for a real record. Other values are for a complex record, whose bins are periodic in N.
    """
    first, last, n_groups = first_searched_bin, last_searched_bin, 0
    while n_groups < strongest_bins.size and strongest_bins[n_groups] >= 0:
        n_groups += 1
    begins, ends = np.empty(n_groups, np.int64), np.empty(n_groups, np.int64)
    n_free, span_end = last - first + 1, first
    for g in range(n_groups):  # insert into disjoint spans in rising order
        wrap_shift = (strongest_bins[g] - first) // fft_size * fft_size if down_beat_sign else 0
        k = g
        while k > 0 and begins[k - 1] > first_bins[g] - wrap_shift:
            begins[k], ends[k] = begins[k - 1], ends[k - 1]
            k -= 1
        begins[k], ends[k] = first_bins[g] - wrap_shift, last_bins[g] - wrap_shift
    for g in range(n_groups):
        begins[g] = max(begins[g] - 1, span_end)
        span_end = max(min(ends[g] + 2, last + 1), begins[g])
        ends[g], n_free = span_end, n_free - (span_end - begins[g])
    excluded_elsewhere = np.empty(
        no_noise_peak_bins.size, np.int64
    )  # excluded bins that are searched and in no group
    n_excluded = 0
    for k in range(no_noise_peak_bins.size):
        bin_number = (
            first + (no_noise_peak_bins[k] - first) % fft_size
            if down_beat_sign
            else no_noise_peak_bins[k]
        )
        is_skipped = bin_number < first or bin_number > last
        for g in range(n_groups):
            is_skipped |= begins[g] <= bin_number < ends[g]
        if not is_skipped:
            excluded_elsewhere[n_excluded] = bin_number
            n_excluded += 1
    rank = int(uniform_number * max(n_free - n_excluded, 1))
    n_passed_before, bin_number = -1, first + rank
    n_passed = 0
    while n_passed != n_passed_before:  # until no more excluded bins lie below
        n_passed_before, bin_number = n_passed, first + rank + n_passed
        for g in range(n_groups):
            if bin_number >= begins[g]:
                bin_number += ends[g] - begins[g]
        n_passed = 0
        for k in range(n_excluded):
            n_passed += excluded_elsewhere[k] <= bin_number
    return min(bin_number, last)
