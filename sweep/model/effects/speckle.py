"""Speckle: random amplitudes that a rough surface returns from each beamlet.

A patch whose heights scatter by more than lambda/(4 pi) about their mean returns the sum of many
waves of unrelated phase: a circular complex Gaussian amplitude [1]_. A beamlet's patch has the
factor

    g_b = sqrt(kappa) u_b + sqrt(1 - kappa) z_b,     z_b complex normal with E|z_b|^2 = 1,

whose mean power is 1. The fraction of power that stays coherent is kappa = exp(-(4 pi sigma_h /
lambda)^2), if the round trip has normal phases of standard deviation 4 pi sigma_h / lambda. The
factor u_b is 1 if the footprint's phases follow its geometry, and a random phase otherwise. A
target with kappa = 0 is a Swerling-1 target, any other a Rician one.

The three segments of a shot see the same heights, so one g_b serves all three. Amplitudes at
frequencies df apart have the correlation exp(-(4 pi sigma_h df / c)^2 / 2), which is 1 to 1e-6 for
1 GHz and heights of 10 um. If the instrument moves across the beam, Doppler shifts differ over the
footprint, and beamlets turn against each other from one segment to the next. With the effect of
motion between segments, the lines' phases contain this rotation. Otherwise this effect applies it,
except to coherent footprints with a coherent part, whose segments are then more similar than in
reality.

The effect changes only the lines' amplitudes. The mean echo, and so its shot noise, stay.

**Fading**: developed speckle (kappa = 0) without draws, the default for surfaces. A sum of circular
complex Gaussian amplitudes is circular complex Gaussian in every bin. Its mean power is that of
beamlets that add as powers. A bin then crosses the threshold with the probability of Swerling's
first case, and two segments' bins as two correlated ones. Their correlation falls with the Doppler
shifts and ranges that differ over the beam (:mod:`sweep.model.detection.speckle_correlation`). It
is in closed form, because a number of beamlets that is enough for the power of a bin may be too
small for the correlation. The effect acts on the detection and on leakage. The leaked signal of an
echo fades with it, in closed form (:mod:`sweep.model.spectrum.leakage`) and in draws of false peaks
(:mod:`sweep.model.pointcloud.leaked_peaks`). With several looks, the probability is a mean over the
mean power of all.

References
----------
.. [1] Goodman, Speckle Phenomena in Optics, ch. 2.
"""

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from sweep.model.beam import ARCHITECTURE_PATH
from sweep.model.detection.speckle_correlation import (
    LINE_SHIFT_MIN_CELLS,
    SEGMENT_PAIRS,
    LineGradients,
    LinePairGradients,
    late_echo_centroid_shift,
    peak_bin_correlation,
    window_transform,
)
from sweep.model.effects.effect import DrawAddresses, Effect, EffectContext, Parameter
from sweep.model.effects.error_bounds import ErrorBound
from sweep.model.effects.planner_inputs import PlannerInputs
from sweep.model.effects.requirements import ParameterRequirement, condition_equal_to
from sweep.model.ground import BeamGradients, FlatGround, Ground, RayTracedGround
from sweep.model.preparation import Shots
from sweep.model.shot_records import EchoSpeckle
from sweep.model.waveform import round_trip_delay

_ROUGHNESS_PATH = "target.roughness"
_SPECKLE_PATH = "footprint.speckle"
_DIFFUSE_AMPLITUDE_RATIO_MAX = 5.0
"""Bound on the ratio of a bin's diffuse (random) amplitude to its root mean square. One of 1e6
draws exceeds the bound."""


def coherent_echo_fraction(*, roughness: ArrayLike, wavelength: ArrayLike) -> np.ndarray:
    """Return the fraction kappa of the mean echo power that keeps its phase.

    Parameters
    ----------
    roughness : array_like
        Standard deviation sigma_h of the surface's height along the line of sight [m]. For a plane
        it is the deviation of the height normal to the plane, times the sine of the grazing angle.
        It is infinite for developed speckle.
    wavelength : array_like
        Wavelength lambda [m].

    Returns
    -------
    ndarray
        kappa, 0..1, in the shape to which the arguments broadcast.

    Notes
    -----
    kappa = exp(-(4 pi sigma_h / lambda)^2).
    """
    phase = 4 * math.pi * np.asarray(roughness, float) / np.asarray(wavelength, float)
    return np.asarray(np.exp(-(phase**2)))


def draw_speckle_factors(
    draw_addresses: DrawAddresses,
    *,
    n_beamlets: int,
    coherent_fraction: np.ndarray,
    random_phases: bool,
) -> tuple[np.ndarray, np.ndarray]:
    """Draw the factors g_b = sqrt(kappa) u_b + sqrt(1 - kappa) z_b on beamlet amplitudes.

    Parameters
    ----------
    draw_addresses : DrawAddresses
        Random keys and draw numbers of n points.
    n_beamlets : int
        Number of beamlets.
    coherent_fraction : ndarray
        Coherent fraction kappa of the mean power, 0..1; (n,) or scalar.
    random_phases : bool
        True if the coherent part u_b, of modulus 1, has a uniform random phase; else u_b is 1.

    Returns
    -------
    magnitude, phase : ndarray (n, n_beamlets)
        |g_b|, and its phase [cycles].

    Notes
    -----
    The diffuse part z_b is complex normal, of mean power 1. A factor depends only on key, draw and
    beamlet b. Pair b of the random stream ``STREAM_SPECKLE`` makes z_b. Number b of
    ``STREAM_FOOTPRINT_PHASE`` makes the phase of u_b.
    """
    from sweep.model.sampling import philox

    point_fraction = np.asarray(coherent_fraction, float) + np.zeros(
        draw_addresses.draw_numbers.size
    )
    uniform_draws = draw_addresses.uniforms(philox.STREAM_SPECKLE, 2 * n_beamlets, are_polar=True)
    # Contiguous copies, so that bits do not depend on the number of draws.
    exceedance, cycles = (np.ascontiguousarray(uniform_draws[:, lane::2]) for lane in range(2))
    coherent_amplitude, diffuse_amplitude = (
        np.sqrt(point_fraction)[:, None],
        np.sqrt(1.0 - point_fraction)[:, None],
    )
    radius = diffuse_amplitude * np.sqrt(-np.log(exceedance))
    if not coherent_amplitude.any():
        return radius, cycles
    angle = np.zeros(())
    if random_phases:
        phases = draw_addresses.uniforms(philox.STREAM_FOOTPRINT_PHASE, n_beamlets)
        angle = 2.0 * np.pi * np.ascontiguousarray(phases)
    re = radius * np.cos(2.0 * np.pi * cycles) + coherent_amplitude * np.cos(angle)
    im = radius * np.sin(2.0 * np.pi * cycles) + coherent_amplitude * np.sin(angle)
    return (
        np.where(coherent_amplitude > 0, np.hypot(re, im), radius),
        np.where(coherent_amplitude > 0, np.arctan2(im, re) / (2.0 * np.pi), cycles),
    )


def speckle_error_bound(points: PlannerInputs) -> ErrorBound | None:
    """Return a bound on the change of results if speckle is omitted; None if it is absent.

    The bound holds in all draws but a fraction of 1e-6.

    Notes
    -----
    A bin of magnitude |X| becomes sqrt(kappa) X + D, with D complex normal of power
    (1 - kappa) |X|^2. Between smooth and rough, 4 pi sigma_h << lambda, the bin's magnitude over
    |X| lies within 1 +- 5 (4 pi sigma_h / lambda). In incoherent footprints the coherent part has
    random phases. If a sum of amplitudes may cancel, the bound is relative to the sum of powers.
    """
    if not points.any_nonzero(_ROUGHNESS_PATH):
        return None
    kappa = coherent_echo_fraction(
        roughness=points[_ROUGHNESS_PATH], wavelength=points["instrument.laser.wavelength"]
    )
    diffuse_change = _DIFFUSE_AMPLITUDE_RATIO_MAX * np.sqrt(1 - kappa)
    if not points.adds_amplitudes:
        is_near_image = points.is_near_image | (points.n_beamlets > 1)
        return ErrorBound(
            magnitude_change=np.where(
                is_near_image & (kappa < 1), 1.0, 1 - np.sqrt(kappa) + diffuse_change
            )
        )
    amplitudes_may_cancel = points.amplitudes_may_cancel
    return ErrorBound(
        magnitude_change=1 - np.sqrt(kappa) + np.where(amplitudes_may_cancel, 0.0, diffuse_change),
        coherent_sum_change=np.where(
            amplitudes_may_cancel,
            math.sqrt(2) * diffuse_change / points.window_response.scalloping_gain_min,
            0.0,
        ),
    )


_DECORRELATED_COHERENT_FRACTION_MAX = 1e-6
"""Fraction of the echo's power that keeps its phase, below which the speckle may differ between
segments. The limit is for footprints whose beamlets add as amplitudes."""
_ZERO_DIVISOR_SUBSTITUTE = 1e-300
"""Positive number that replaces a divisor of 0, such as the power of no light."""


def perturb_shots(shots: Shots, context: EffectContext, draw_addresses: DrawAddresses) -> Shots:
    """Draw the speckle of every beamlet, so that each point has a footprint of its own.

    Parameters
    ----------
    shots : Shots
        Prepared shots of n points, after all effects that are not random.
    context : EffectContext
        Parameters and ground of the points.
    draw_addresses : DrawAddresses
        Random key (n, 2) and draw number (n,) of each point. Equal addresses give equal shots.

    Returns
    -------
    Shots
        Shots with drawn amplitudes and phases of beamlets, (n, beamlets).

    Raises
    ------
    ValueError
        For direct detection, which sums the intensities of all speckles in the aperture: that is
        not a factor on each beamlet's echo.

    Notes
    -----
    The amplitude of beamlet b is multiplied by g_b = sqrt(kappa) u_b + sqrt(1 - kappa) z_b, with
    kappa = exp(-(4 pi sigma_h / lambda)^2), as the module's description states.
    """
    if shots.waveform.architecture == "direct":
        raise ValueError(
            "speckle is simulated for homodyne and heterodyne receivers: what direct detection "
            "sees depends on how many speckles its aperture averages, of which nothing is known"
        )
    coherent_fraction = coherent_echo_fraction(
        roughness=context.parameters[_ROUGHNESS_PATH],
        wavelength=context.parameters["instrument.laser.wavelength"],
    )
    magnitude, cycles = draw_speckle_factors(
        draw_addresses,
        n_beamlets=shots.footprint.n_beamlets,
        coherent_fraction=coherent_fraction,
        random_phases=shots.footprint.adds_powers and shots.footprint.n_beamlets > 1,
    )
    offset, doppler, mean_amplitude = (
        values[shots.footprint.row_of_point]
        for values in (
            shots.footprint.relative_range_offset,
            shots.footprint.doppler_ratio_offset,
            shots.footprint.relative_amplitude,
        )
    )
    amplitude = mean_amplitude * magnitude
    # The coherent part of a smooth surface has the same phase at the start of every segment.
    is_decorrelated = shots.footprint.adds_powers | (
        coherent_fraction < _DECORRELATED_COHERENT_FRACTION_MAX
    )
    is_decorrelated &= not shots.target_moves_between_segments  # else lines contain it
    phase = np.empty((3, *cycles.shape))
    for segment_index, (carrier, start) in enumerate(
        zip(shots.waveform.carriers, shots.waveform.segment_starts, strict=True)
    ):
        turned_cycles = np.where(
            is_decorrelated, np.asarray(carrier, float) * start, 0.0
        ) + np.zeros(shots.size)
        np.add(cycles, turned_cycles[:, None] * doppler, out=phase[segment_index])
    power_ratio = (amplitude**2).sum(axis=1) / np.maximum(
        (mean_amplitude**2).sum(axis=1), _ZERO_DIVISOR_SUBSTITUTE
    )
    return replace(
        shots,
        footprint=shots.footprint._replace(
            row_of_point=np.arange(shots.size),
            relative_range_offset=offset,
            doppler_ratio_offset=doppler,
            relative_amplitude=amplitude,
            phase_cycles=phase,
            adds_powers=False,
        ),
        laser_line=shots.laser_line.with_scaled_pedestal(power_ratio),
    )


def fading_error_bound(points: PlannerInputs) -> ErrorBound | None:
    """Return a magnitude change of 1 if developed speckle is selected; None if fading is absent.

    A change of 1 keeps the effect. Without the effect, the probability of detection would be that
    of a steady echo of the mean power.
    """
    is_smooth = points.adds_field_amplitudes or points.waveform.architecture == "direct"
    return (
        None
        if is_smooth or points.shared_option(_SPECKLE_PATH) == "none"
        else ErrorBound(magnitude_change=1.0)
    )


def apply_fading(shots: Shots, context: EffectContext) -> Shots:
    """Prepare detection in developed speckle, if the spec selects it and beamlets add as powers.

    Parameters
    ----------
    shots : Shots
        Prepared shots of n points (:class:`sweep.model.preparation.Shots`).
    context : EffectContext
        Parameter ``footprint.speckle``, and ground with the changes of range and velocity over the
        beam (:class:`sweep.model.effects.effect.EffectContext`).

    Returns
    -------
    Shots
        Shots with the speckle's correlations between segments, and the spread of lines [bins].
        Looks that are added in amplitude get a smaller amplitude. Shots without developed speckle
        are unchanged.

    Notes
    -----
    The amplitude of a bin is circular complex normal. With noise of sigma per quadrature, the mean
    power |X|^2 and the threshold Th, pd is exp(-Th^2 / (2 sigma^2 + |X|^2)), Swerling's
    first case. Two segments are detected jointly by the correlation of their amplitudes.
    """
    from sweep.model.detection.echo_detection import SegmentCorrelations

    speckle_law = str(context.parameters[_SPECKLE_PATH])
    if (
        speckle_law == "none"
        or shots.waveform.architecture == "direct"
        or not shots.footprint.adds_powers
    ):
        return shots
    beam_spread = _make_beam_spread(shots, context.ground)
    line_deviation = _line_deviation_bins(shots, beam_spread.beamlet_moments)
    correlations = [
        beam_spread.speckle_correlation(shots, pair, phase)
        for pair, phase in zip(SEGMENT_PAIRS, segment_phase_differences(shots), strict=True)
    ]
    line_gradients = _line_gradients(shots, context.ground)
    shots = replace(
        shots,
        speckle=EchoSpeckle(
            segment_correlations=SegmentCorrelations(*correlations),
            line_deviation_bins=line_deviation,
            line_gradients=line_gradients,
        ),
    )
    return shots if shots.looks.number == 1 else _set_look_speckle(shots, beam_spread)


def _line_deviation_bins(shots: Shots, moments: "BeamletMoments") -> np.ndarray:
    """Return the standard deviation of the frequencies of beamlets' lines [bins], (segments, n).

    Bins are those of the FFT.
    """
    bins_per_hertz = shots.fft_size / shots.sample_rate
    delay = round_trip_delay(shots.range)
    weights = np.array(
        [
            [
                bins_per_hertz * segment.carrier + 0 * delay,
                -bins_per_hertz * segment.chirp_rate * delay,
            ]
            for segment in shots.waveform_segments
        ]
    )
    variance = np.einsum("sin,ijn,sjn->sn", weights, moments.covariance, weights)
    return np.sqrt(np.maximum(variance, 0.0))


_N_LINE_NODES, _LINE_DEVIATIONS_MAX = 81, 4.0
"""Number of evenly spaced lines that represent the lines of a footprint, and distance of the
outermost ones from the centre, in standard deviations of the beam."""
_LOOK_DECORRELATION_MIN = 1e-9
"""Largest loss of correlation between looks (records of a segment) for which all looks count as
having the same speckle."""


def _set_look_speckle(shots: Shots, beam_spread: "BeamSpread") -> Shots:
    """Return shots with the correlation of the speckle between looks, from the motion between them.

    Looks that are added coherently get a smaller amplitude (``echo_scales``) instead.
    """
    looks = shots.looks
    n_looks, n_points = looks.number, shots.size
    echo_frequencies, _ = _mid_record_frequencies_and_times(shots)
    cycles_per_look = [
        np.broadcast_to(echo_frequency * shots.waveform.look_period, n_points)
        for echo_frequency in echo_frequencies
    ]
    if looks.is_noncoherent:
        phase_cycles_per_look = np.stack(cycles_per_look) * shots.motion.doppler_ratio
        speckle = shots.speckle._replace(phase_cycles_per_look=phase_cycles_per_look)
        shots = replace(shots, speckle=speckle)
    if not looks.has_moving_speckle:
        return shots
    zeros = np.zeros(n_points)
    correlation_by_lag = np.ones((3, n_points, n_looks), complex)
    for segment in map(int, np.flatnonzero(shots.has_segment)):
        for lag in range(1, n_looks):
            phase = PhaseDifference(cycles_per_look[segment] * lag, zeros)
            correlation_by_lag[segment, :, lag] = beam_spread.speckle_correlation(
                shots, (segment, segment), phase
            )
    if looks.n_coherent > 1:
        # The sum of amplitudes of different speckles has a smaller mean amplitude.
        lags = np.arange(1, n_looks)
        unwinding = np.exp(-1j * np.angle(correlation_by_lag[0, :, 1]))[:, None] ** lags
        squared_sum = (2 * (n_looks - lags) * (correlation_by_lag[0, :, 1:] * unwinding).real).sum(
            axis=1
        )
        gain = np.sqrt(np.maximum(n_looks + squared_sum, 0.0)) / n_looks
        return replace(shots, echo_scales=shots.echo_scales.with_scaled_echo(amplitude_factor=gain))
    look_power = _relative_look_powers(shots, beam_spread.beam_gradients)
    if (
        np.abs(correlation_by_lag - 1).max() < _LOOK_DECORRELATION_MIN
        and np.abs(look_power - 1).max() < _LOOK_DECORRELATION_MIN
    ):
        return shots
    segment_correlation = np.abs(np.array(shots.speckle.segment_correlations))
    lag_weight = n_looks - np.abs(np.arange(1 - n_looks, n_looks))
    squared_sum_by_segment = [
        (
            lag_weight
            * np.abs(
                np.concatenate(
                    [
                        correlation_by_lag[segment_index, :, :0:-1],
                        correlation_by_lag[segment_index],
                    ],
                    axis=1,
                )
            )
            ** 2
        ).sum(axis=1)
        for segment_index in range(3)
    ]
    for pair_index, (pair, phase) in enumerate(
        zip(SEGMENT_PAIRS, segment_phase_differences(shots), strict=True)
    ):
        first, second = pair
        if not shots.has_segment[list(pair)].all() or (
            pair_index != 1 and not shots.detects_by_any_two_segments
        ):
            continue
        squared_sum = zeros
        for lag in range(1 - n_looks, n_looks):
            turned_phase = PhaseDifference(
                phase.cycles_per_doppler_ratio + lag * cycles_per_look[second],
                phase.delay_cycles_per_relative_range,
            )
            squared_correlation = (
                np.abs(beam_spread.speckle_correlation(shots, pair, turned_phase)) ** 2
            )
            squared_sum = squared_sum + (n_looks - abs(lag)) * squared_correlation
        segment_correlation[pair_index] = (
            np.sqrt(squared_sum)
            / (squared_sum_by_segment[first] * squared_sum_by_segment[second]) ** 0.25
        )
    from sweep.model.detection.look_speckle import LookSpeckle  # imports kernels

    look_speckle = LookSpeckle.from_correlations(
        correlation_by_lag, look_power, np.minimum(segment_correlation, 1.0)
    )
    return replace(shots, speckle=shots.speckle._replace(look_speckle=look_speckle))


def _relative_look_powers(shots: Shots, beam_gradients: BeamGradients) -> np.ndarray:
    """Return the power of each look in the strongest bin, over the mean of all looks.

    The result is (3, n, looks), and 1 if lines do not drift.

    The power differs between looks because lines drift out of the bin.
    """
    n_looks = shots.looks.number
    look_power = np.ones((3, shots.size, n_looks))
    if not np.any(shots.motion.line_drift_per_look):
        return look_power
    zero_phase = PhaseDifference(np.zeros(shots.size), np.zeros(shots.size))
    padding_factor = shots.fft_size / shots.window.length
    looks_from_middle = np.arange(n_looks) - (n_looks - 1) / 2
    node = np.linspace(-_LINE_DEVIATIONS_MAX, _LINE_DEVIATIONS_MAX, _N_LINE_NODES)
    weight = np.exp(-0.5 * node * node)
    drift = (
        np.broadcast_to(
            shots.motion.line_drift_per_look, (len(shots.waveform_segments), shots.size)
        )
        / padding_factor
    )
    for segment in map(int, np.flatnonzero(shots.has_segment)):
        gradients = _line_pair_gradients(shots, (segment, segment), zero_phase, beam_gradients)
        line_position = (
            gradients.strongest_bin_offset[0][:, None] - drift[segment][:, None] * looks_from_middle
        )
        line_distance = line_position[..., None] - gradients.line_shift[0][:, None, None] * node
        look_power[segment] = (window_transform(shots.window, line_distance) ** 2 * weight).sum(
            axis=-1
        )
    return look_power / np.maximum(
        look_power.mean(axis=-1, keepdims=True), _ZERO_DIVISOR_SUBSTITUTE
    )


class BeamSpread(NamedTuple):
    """Spread of ranges and Doppler ratios (2 v / c) over the beam on the ground."""

    beam_gradients: BeamGradients
    """Gradients of range and Doppler ratio across the beam."""
    plane: FlatGround | None
    """Plane that the beam meets; None for ray-traced ground."""
    beamlet_moments: "BeamletMoments"
    """Power-weighted moments of the Doppler ratio and the relative range of the beam's rays."""

    def speckle_correlation(
        self, shots: Shots, pair: tuple[int, int], phase: "PhaseDifference"
    ) -> np.ndarray:
        """Return the correlation of the speckle in two records.

        Parameters
        ----------
        shots : Shots
            Prepared shots.
        pair : tuple of int
            Segments of the two records.
        phase : PhaseDifference
            Phase difference between the records.

        Returns
        -------
        ndarray (n,) complex
            Correlation of the echo's amplitudes, of a modulus up to 1.
        """
        if self.plane is not None:
            correlations = self.plane.mean_phasor(*phase).astype(complex)
            variance_across = np.zeros(shots.size)
        else:
            (mean,), (variance,) = _phase_moments(self.beamlet_moments, [phase])
            correlations = np.exp(1j * mean - 0.5 * variance)
            variance_across = np.maximum(
                variance - phase.phase_per_deviation(self.beam_gradients) ** 2, 0.0
            )
        gradients = _line_pair_gradients(shots, pair, phase, self.beam_gradients)
        wide_points = np.flatnonzero(gradients.line_shift_max > LINE_SHIFT_MIN_CELLS)
        if wide_points.size:
            bin_correlations = peak_bin_correlation(shots.window, gradients.select(wide_points))
            correlations[wide_points] = bin_correlations * np.exp(
                -0.5 * variance_across[wide_points]
            )
        return correlations


def _make_beam_spread(shots: Shots, ground: Ground) -> BeamSpread:
    """Return the spread of ranges and Doppler ratios over the beam, on a plane or ray-traced."""
    moments = _beamlet_moments(shots, ground)
    if isinstance(ground, FlatGround):
        return BeamSpread(ground.gradients, ground, moments)
    return BeamSpread(_ray_traced_gradients(moments), None, moments)


def _line_gradients(shots: Shots, ground: FlatGround | RayTracedGround) -> LineGradients:
    """Return gradients of line position and phase over the beam, along the slope and across it.

    Across the slope only Doppler ratios change. The gradients are set even where they are too small
    to change probabilities, because they also make the positions of peaks wander.
    """
    if isinstance(ground, FlatGround):
        beam_gradients, doppler_across = ground.gradients, np.zeros(shots.size)
    else:
        row, offset, doppler, echo = ground.beamlet_table
        moments = _moments_about_surface_means(
            power=echo,
            doppler_ratio=doppler,
            relative_range=offset,
            is_on_other_surface=ground.is_on_other_surface,
            row_of_point=row,
        )
        beam_gradients = _ray_traced_gradients(moments)
        variance_across = moments.doppler_ratio_variance - beam_gradients.doppler_ratio**2
        doppler_across = np.sqrt(np.maximum(variance_across, 0.0))
    bin_width = shots.record.bin_width
    line_shift = np.zeros((3, 2, shots.size))
    for segment_index, segment in enumerate(shots.waveform_segments):
        delay = segment.echo_delay(shots.range)
        shift_hertz = (
            segment.carrier * beam_gradients.doppler_ratio
            - segment.chirp_rate * delay * beam_gradients.relative_range
        )
        line_shift[segment_index] = (
            shift_hertz / bin_width,
            segment.carrier * doppler_across / bin_width,
        )
    phase_gradient = np.zeros((3, 2, shots.size))
    for (_, second), phase in zip(
        SEGMENT_PAIRS[:2], segment_phase_differences(shots)[:2], strict=True
    ):
        phase_gradient[second] = (
            phase.phase_per_deviation(beam_gradients),
            2 * np.pi * phase.cycles_per_doppler_ratio * doppler_across,
        )
    return LineGradients(np.moveaxis(line_shift, -1, 0), np.moveaxis(phase_gradient, -1, 0))


class PhaseDifference(NamedTuple):
    """Coefficients of a scatterer's phase difference between two segments, (n,) each.

    The phase difference is linear in the scatterer's Doppler ratio (2 v / c) and relative range.
    """

    cycles_per_doppler_ratio: np.ndarray
    """Phase difference between two segments [cycles] per unit of the Doppler ratio 2 v / c."""
    delay_cycles_per_relative_range: np.ndarray
    """Decrease of the phase difference between two segments [cycles] per unit of relative range."""

    def phase_per_deviation(self, beam_gradients: BeamGradients) -> np.ndarray:
        """Return the change of the phase difference [rad], (n,), over one beam deviation.

        A beam deviation is the standard deviation of the beam's profile.
        """
        return (
            2
            * np.pi
            * (
                self.cycles_per_doppler_ratio * beam_gradients.doppler_ratio
                - self.delay_cycles_per_relative_range * beam_gradients.relative_range
            )
        )


def segment_phase_differences(shots: Shots) -> list[PhaseDifference]:
    """Return the phase difference of each pair in SEGMENT_PAIRS, second segment less first.

    The result follows equation (1) of :mod:`sweep.model.detection.speckle_correlation`.
    """
    echo_frequencies, record_middles = _mid_record_frequencies_and_times(shots)
    delay = round_trip_delay(shots.range)
    phase_cycles = [
        frequency * (start + middle)
        for frequency, start, middle in zip(
            echo_frequencies, shots.waveform.segment_starts, record_middles, strict=True
        )
    ]
    return [
        PhaseDifference(
            np.broadcast_to(phase_cycles[second] - phase_cycles[first], shots.size),
            delay * (echo_frequencies[second] - echo_frequencies[first]),
        )
        for first, second in SEGMENT_PAIRS
    ]


def _mid_record_frequencies_and_times(shots: Shots) -> tuple[list[np.ndarray], np.ndarray]:
    """Return the echo's optical frequency [Hz] at mid-record, and the time of mid-record [s].

    Both are by segment; the time counts from the segment's start. Mid-record is the centroid of the
    window over the samples that hold the echo. At this time the phase of a bin equals that of the
    line, to first order in the distance between bin and line.
    """
    delay = round_trip_delay(shots.range)
    middle_shift = (
        0.0
        if shots.echo_record.n_samples_before_echo is None
        else late_echo_centroid_shift(shots.window)[shots.echo_record.n_samples_before_echo]
    )
    middle_shift = (
        np.broadcast_to(middle_shift, (len(shots.waveform.carriers), shots.size))
        / shots.sample_rate
    )
    record_middles = shots.record.acquisition_delay + shots.record.duration / 2 + middle_shift
    return [
        carrier + slope * shots.waveform.chirp_rate * (middle - delay)
        for carrier, slope, middle in zip(
            shots.waveform.carriers, shots.waveform.chirp_rate_ratios, record_middles, strict=True
        )
    ], record_middles


def _line_pair_gradients(
    shots: Shots, pair: tuple[int, int], phase: PhaseDifference, beam_gradients: BeamGradients
) -> LinePairGradients:
    """Return the gradients of a pair of segments' lines, and the distance of each strongest bin.

    The distance is that of the segment's strongest bin from the line on the beam's axis.
    """
    window_bin_width = shots.sample_rate / shots.window.length
    padding_factor = shots.fft_size / shots.window.length
    distances, line_shifts = [], []
    for segment in (shots.waveform_segments[segment_index] for segment_index in pair):
        delay = segment.echo_delay(shots.range)
        beat = segment.carrier * segment.doppler_ratio - segment.chirp_rate * delay * (
            1 + segment.doppler_ratio
        )
        bin_position = beat / window_bin_width * padding_factor
        # With any_bin, bins at the middles of two echoes represent all bins that may detect them.
        shift_hertz = (
            segment.carrier * beam_gradients.doppler_ratio
            - segment.chirp_rate * delay * beam_gradients.relative_range
        )
        line_shifts.append(np.broadcast_to(shift_hertz / window_bin_width, shots.size))
        bin_position = np.broadcast_to(bin_position, shots.size)
        nearest_bin = bin_position
        if shots.detection_settings.echo_bin_rule == "peak_bin":
            nearest_bin = _strongest_bins_with_images(
                shots, bin_position, line_shifts[-1] * padding_factor
            )
        distances.append((nearest_bin - bin_position) / padding_factor)
    return LinePairGradients(
        (distances[0], distances[1]),
        (line_shifts[0], line_shifts[1]),
        phase.phase_per_deviation(beam_gradients),
        np.broadcast_to(beam_gradients.relative_echo, shots.size),
    )


_IMAGE_REACH_FACTOR = 2.0
"""Reach of an echo's image [sum of padding factor and standard deviation of the lines, FFT bins].
The image of a line within this distance of DC or Nyquist may change which bin is the strongest."""


def _strongest_bins_with_images(
    shots: Shots, line_positions: np.ndarray, line_deviation_bins: np.ndarray
) -> np.ndarray:
    """Return the strongest bins of echoes at ``line_positions``, signed and unfolded [bins], (n,).

    The strongest bin is the one nearest to the line, with one exception: in a real record, a line
    near DC or Nyquist overlaps with its image. Near DC, for example, bin 0 holds light of the line
    and of the image, and may be stronger than a nearer bin 1. ``line_deviation_bins`` is the
    standard deviation of the lines.
    """
    nearest_bins = np.rint(line_positions)
    if not shots.fft_size_if_end_bins_real or not shots.line_images.are_summed:
        return nearest_bins
    nyquist_bin = shots.fft_size // 2
    spectrum_ends = np.rint(line_positions / nyquist_bin) * nyquist_bin
    padding_factor = shots.fft_size / shots.window.length
    near_end = np.flatnonzero(
        np.abs(line_positions - spectrum_ends)
        < _IMAGE_REACH_FACTOR * (padding_factor + np.abs(line_deviation_bins))
    )
    if not near_end.size:
        return nearest_bins
    line_positions, spectrum_ends = line_positions[near_end, None], spectrum_ends[near_end]
    node_deviations = np.linspace(-_LINE_DEVIATIONS_MAX, _LINE_DEVIATIONS_MAX, _N_LINE_NODES)
    node_weights, node_positions = (
        np.exp(-0.5 * node_deviations * node_deviations),
        line_positions + line_deviation_bins[near_end, None] * node_deviations,
    )
    inward_sign = np.where(line_positions[:, 0] < spectrum_ends, -1.0, 1.0)
    first_distance = np.maximum(inward_sign * (nearest_bins[near_end] - spectrum_ends) - 1, 0.0)
    powers = []
    for extra_distance in range(3):  # the nearest bin and its neighbours
        bin_ = (spectrum_ends + inward_sign * (first_distance + extra_distance))[:, None]
        line_transform = window_transform(shots.window, (bin_ - node_positions) / padding_factor)
        image_transform = window_transform(
            shots.window, (bin_ - 2 * spectrum_ends[:, None] + node_positions) / padding_factor
        )
        powers.append(((line_transform**2 + image_transform**2) * node_weights).sum(axis=-1))
    nearest_bins[near_end] = spectrum_ends + inward_sign * (
        first_distance + np.argmax(powers, axis=0)
    )
    return nearest_bins


class BeamletMoments(NamedTuple):
    """Power-weighted moments of the Doppler ratio and relative range of the rays of a beam."""

    mean: np.ndarray
    """(2, n): means of the Doppler ratio and of the relative range."""
    covariance: np.ndarray
    """(2, 2, n): covariance matrix of the Doppler ratio and the relative range, about the mean of
    each surface."""

    @property
    def doppler_ratio_variance(self) -> np.ndarray:
        """(n,): variance of the Doppler ratio."""
        return np.asarray(self.covariance[0, 0])

    @property
    def relative_range_variance(self) -> np.ndarray:
        """(n,): variance of the relative range."""
        return np.asarray(self.covariance[1, 1])

    @property
    def doppler_range_covariance(self) -> np.ndarray:
        """(n,): covariance of the Doppler ratio with the relative range."""
        return np.asarray(self.covariance[0, 1])


def _beamlet_moments(shots: Shots, ground: Ground) -> BeamletMoments:
    """Return the beamlets' moments of Doppler ratio and relative range.

    The covariance is about the mean of each surface. Surfaces at different ranges, such as a roof
    and the ground below, are separate echoes, which fade independently.
    """
    return _moments_about_surface_means(
        power=shots.footprint.relative_amplitude**2,
        doppler_ratio=shots.footprint.doppler_ratio_offset,
        relative_range=shots.footprint.relative_range_offset,
        is_on_other_surface=ground.is_on_other_surface,
        row_of_point=shots.footprint.row_of_point,
    )


def _moments_about_surface_means(
    *,
    power: np.ndarray,
    doppler_ratio: np.ndarray,
    relative_range: np.ndarray,
    is_on_other_surface: np.ndarray | None,
    row_of_point: np.ndarray,
) -> BeamletMoments:
    """Return power-weighted moments of beamlets (rows, beamlets), for points with the given rows.

    ``power``, ``doppler_ratio`` and ``relative_range`` are (rows, beamlets), and ``row_of_point``
    (n,) is the row of each point's footprint. ``is_on_other_surface`` (rows, beamlets) bool marks
    beamlets on a surface that the axis does not meet; None if all are on the axis's surface.
    """
    values = np.array([doppler_ratio, relative_range])
    power_fraction = power / np.maximum(power.sum(axis=1), _ZERO_DIVISOR_SUBSTITUTE)[:, None]
    mean = (power_fraction * values).sum(axis=-1)
    centred = values - mean[:, :, None]
    if is_on_other_surface is not None and is_on_other_surface.any():
        for surface in (is_on_other_surface, ~is_on_other_surface):
            weight = np.where(surface, power_fraction, 0.0)
            surface_power = np.maximum(weight.sum(axis=1), _ZERO_DIVISOR_SUBSTITUTE)
            surface_mean = (weight * values).sum(axis=-1) / surface_power
            centred = np.where(surface, values - surface_mean[:, :, None], centred)
    covariance = (power_fraction * centred[:, None] * centred[None]).sum(axis=-1)
    return BeamletMoments(mean[:, row_of_point], covariance[:, :, row_of_point])


def _phase_moments(
    moments: BeamletMoments, phases: list[PhaseDifference]
) -> tuple[np.ndarray, np.ndarray]:
    """Return mean [rad] and variance [rad^2] of the phase differences over ray-traced beamlets.

    Both are (len(phases), n). Ranges and Doppler ratios change linearly across a Gaussian beam, so
    the phase has a normal distribution, which mean and variance describe.
    """
    weights = (
        2
        * np.pi
        * np.array(
            [
                [phase.cycles_per_doppler_ratio, -phase.delay_cycles_per_relative_range]
                for phase in phases
            ]
        )
    )
    variance = np.einsum("pin,ijn,pjn->pn", weights, moments.covariance, weights)
    return (weights * moments.mean).sum(axis=1), variance


def _ray_traced_gradients(moments: BeamletMoments) -> BeamGradients:
    """Return the gradients of ray-traced ground in the direction of steepest range, (n,) each."""
    deviation = np.sqrt(moments.relative_range_variance)
    doppler_along = moments.doppler_range_covariance / np.maximum(
        deviation, _ZERO_DIVISOR_SUBSTITUTE
    )
    return BeamGradients(doppler_along, deviation, np.zeros(deviation.shape))


FADING = Effect(
    name="fading",
    description="developed speckle of a rough surface, in closed form",
    stage="detection",
    error_bound=fading_error_bound,
    apply=apply_fading,
    required_effects=("footprint", "doppler_spread"),
    parameters=(
        Parameter(
            path=_SPECKLE_PATH,
            description="Echo of surfaces that are rough against the wavelength: developed, it "
            "fades as "
            "speckle does, or none, it has its mean power. Coherent phases are those of a smooth "
            "surface and do not fade; where target.roughness says how rough, take none",
            default="developed",
            options=("developed", "none"),
        ),
    ),
)
"""Effect that computes detection of echoes in developed speckle in closed form, without draws."""


SPECKLE = Effect(
    name="speckle",
    description="amplitudes of a rough surface, at random",
    stage="draws",
    error_bound=speckle_error_bound,
    perturb_shots=perturb_shots,
    required_effects=("footprint", "doppler_spread"),  # these decorrelate the segments' speckle
    parameters=(
        Parameter(
            path=_ROUGHNESS_PATH,
            description="Standard deviation of the surface's height along the line of sight",
            example="10 um",
            limits=("0 m", "1 km"),
            requirements=(
                ParameterRequirement(
                    ARCHITECTURE_PATH,
                    condition_equal_to("direct"),
                    "makes speckle, and direct detection averages an unknown number of speckle "
                    "grains",
                    "take a coherent receiver",
                    applies_if_forced_on=True,
                ),
                ParameterRequirement(
                    _SPECKLE_PATH,
                    condition_equal_to("developed"),
                    "states the roughness of the target, which is unlimited in developed speckle",
                    "set footprint.speckle: none",
                ),
            ),
        ),
    ),
)
"""Effect that draws the random amplitudes that a rough surface returns from each beamlet."""
