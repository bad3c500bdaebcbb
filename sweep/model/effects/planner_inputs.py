"""Inputs of the error bounds of effects: link budget, lines and footprints of many points at once.

The link budget is that of the shots, :class:`sweep.model.link_budget.LinkBudget`, for arrays that
broadcast over the points. This module adds bounds over the lines of a footprint.

Values are computed on first use. Arrays by segment have an additional first axis over the existing
segments. All points share text parameters, and the parameters that
:meth:`PlannerInputs.shared_integer` reads.
"""

from collections.abc import Collection, Mapping, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from sweep.model import beam, beamlet_counts, ground, waveform
from sweep.model.beamlets import (
    ZERO_OFFSET_MOMENTS,
    OffsetMoments,
    bins_per_velocity,
    place_beamlets,
    plane_echo_ratio_bound,
    plane_offset_moment_bounds,
)
from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.effects.error_bounds import NO_PHASE_ERROR, ErrorBound, PhaseErrorBound
from sweep.model.ground import FootprintExtent, backscatter
from sweep.model.link_budget import (
    ADC_NOISE_SOURCE,
    LinkBudget,
    adc_noise_variance,
    relative_amplitude,
)
from sweep.model.shot_settings import LineMotion
from sweep.model.waveform import WaveformSegment
from sweep.model.window import Window
from sweep.model.window_response import (
    MissingSampleBounds,
    WindowResponse,
    missing_sample_bounds,
    window_response,
)

_CHEBYSHEV_INEQUALITY_DEVIATIONS = (1.4, 2.5, 8.0)
"""Half-widths of intervals, in standard deviations of the lines' positions. For each interval,
Chebyshev's inequality bounds the power of the largest bin; the best bound is taken."""
_NEAR_IMAGE_WINDOW_BINS = 8.0
"""Distance of a line from its image beyond which the two cannot add up or cancel. The unit is the
sample rate over the number of samples. Beyond this distance the power of the image's sidelobes is
below 0.4 %, and its derivatives are below 5 %."""


class PeakPowerBounds(NamedTuple):
    """Bounds on the power of the largest bin.

    The bounds are relative to the power that all lines would have if they lay on one bin.
    """

    power_min: np.ndarray
    """(segments, n): lower bound of the largest bin's power without images, relative to the power
    that all lines would have on one bin."""
    power_max: np.ndarray
    """(segments, n): upper bound of the largest bin's power with images, relative to the power that
    all lines would have on one bin."""


class PlannerInputs(LinkBudget):
    """Link budget of points that share all text parameters, and their lines, for error bounds.

    The records of the link budget have the names of those of the prepared shots, such as
    ``points.target.radial_velocity`` and ``shots.target.radial_velocity``.

    Parameters
    ----------
    parameters : mapping
        Text, numbers or arrays by dotted path, including parameters of effects. Arrays broadcast
        against each other and have equal numbers of axes.
    extent : FootprintExtent, optional
        Extent of footprints found by ray tracing; by default that of a flat plane.
    has_rotating_body : bool
        True if any surface belongs to a rotating body.
    """

    def __init__(
        self,
        parameters: Mapping[str, np.ndarray | float | str],
        extent: FootprintExtent | None = None,
        *,
        has_rotating_body: bool = False,
    ) -> None:
        super().__init__({path: np.asarray(value) for path, value in parameters.items()})
        self.ndim = max((array.ndim for array in self.parameters.values()), default=0)
        self._given_extent, self.has_rotating_body = extent, has_rotating_body
        self.effects_off: Collection[str] = ()
        """Names of effects that are off at all points; bounds of others may rely on it."""
        self.phase_error_bounds: dict[str, PhaseErrorBound] = {}
        """Bounds of phase errors by name of the effect, known before any other bound."""
        self.noise_bounds: dict[str, ErrorBound] = {}
        """Error bounds of the effects of the stage ``noise`` by name, known before those of other
        stages."""
        n_beamlets = self.shared_integer(beamlet_counts.BEAMLETS_PATH)
        self.n_beamlets, self.beamlet_pattern = beamlet_counts.largest_beamlet_count_and_pattern(
            self.parameters
        )
        if n_beamlets:
            self.n_beamlets, self.beamlet_pattern = (
                n_beamlets,
                ground.beamlet_pattern(self.parameters),
            )
        self.existing_chirp_slopes = self.stack_segments(
            *self._select_existing_segments(self.waveform.chirp_rate_ratios)
        )
        """Signed chirp rate of each existing segment, relative to that of the up-chirp."""
        is_direct = self.waveform.architecture == "direct"
        is_coherent = self.shared_option("footprint.phases") == "coherent"
        self.adds_amplitudes = is_coherent or is_direct
        self.adds_field_amplitudes = is_coherent and not is_direct
        """True if beamlets add as optical amplitudes (roots of their echo powers), and not as
        powers."""

    def __getitem__(self, path: str) -> np.ndarray:
        """Return the values of the numeric parameter with a dotted path."""
        return self.parameters[path]

    def shared_option(self, path: str) -> str:
        """Return the chosen option of a text parameter, by dotted path; all points share it."""
        return str(self.parameters[path])

    def shared_integer(self, path: str) -> int:
        """Return the integer parameter with a dotted path; all points share it."""
        return int(self.parameters[path].flat[0])

    def any_nonzero(self, *paths: str) -> bool:
        """Return True if any of several numeric parameters is nonzero at any point."""
        return any(bool(self.parameters[path].any()) for path in paths)

    def _select_existing_segments(self, values_by_segment: Sequence[Any]) -> list[Any]:
        """Return the values of the segments that exist, from the values of up, Doppler and down."""
        named_values = zip(waveform.SEGMENT_NAMES, values_by_segment, strict=True)
        return [value for name, value in named_values if name in self.waveform.segment_order]

    def stack_segments(self, *values: np.ndarray | float) -> np.ndarray:
        """Return an array (segments, ...) of one value or array per segment, after broadcasting."""
        template = np.zeros((1,) * self.ndim)
        return np.stack(np.broadcast_arrays(template, *values)[1:]).astype(float)

    # The instrument

    @property
    def fft_size(self) -> int:
        """FFT size N, including zero padding."""
        return self.record.fft_size

    @property
    def sample_rate(self) -> np.ndarray:
        """Sample rate f_s [Hz]."""
        return self.record.sample_rate

    @property
    def window(self) -> Window:
        """Window of the record, whose length all points share."""
        return self.record.window

    @cached_property
    def window_response(self) -> WindowResponse:
        """Magnitude response of the window at FFT bins around a line."""
        return window_response(self.window.name, self.window.length, self.fft_size)

    @property
    def padding_factor(self) -> float:
        """FFT size over the number of samples in the record."""
        return self.window_response.padding_factor

    @cached_property
    def carriers(self) -> np.ndarray:
        """Carrier frequency [Hz], by segment: times the echo's delay, the beat's phase [cycles]."""
        return self.stack_segments(*self._select_existing_segments(self.waveform.carriers))

    @property
    def noise_maximum_over_sigma(self) -> float | None:
        """Level that the largest |X| of noise hardly ever exceeds, over the noise per quadrature.

        The probability that the noise of any bin exceeds the level is at most 0.001. The result is
        None if segments report all peaks that cross the threshold.
        """
        if self.shared_option(waveform.REPORTED_PEAKS_PATH) == waveform.ALL_PEAKS:
            return None
        return float(np.sqrt(2 * np.log(1e3 * self.fft_size)))

    # The target

    @property
    def range(self) -> np.ndarray:
        """Range of the target on the beam's axis [m]."""
        return self.target.range

    @cached_property
    def footprint_full_angles(self) -> beam.FootprintAngles:
        """Full 1/e^2 angles that the effective footprint subtends at the instrument [rad]."""
        return beam.footprint_full_angles(self.parameters)

    @cached_property
    def footprint_extent(self) -> FootprintExtent:
        """Extent of the footprint: that found by ray tracing if given, else that on a plane."""
        if (extent := self._given_extent) is not None:
            return extent if self.adds_field_amplitudes else extent._replace(amplitude_gain_max=1.0)
        grazing_angle = self["target.grazing_angle"]
        axis_echo = backscatter(self.shared_option("target.reflectance_law"), np.sin(grazing_angle))
        if self.n_beamlets == 1:
            return FootprintExtent(
                axis_echo, 1.0, ZERO_OFFSET_MOMENTS, ZERO_OFFSET_MOMENTS, ZERO_OFFSET_MOMENTS
            )
        geometry: dict[str, Any] = {
            "grazing_angle": grazing_angle,
            "beam_divergence": self.footprint_full_angles.position_spread_angle,
            "n_beamlets": self.n_beamlets, "pattern": self.beamlet_pattern,
        }  # fmt: skip
        range_moments, velocity_moments = plane_offset_moment_bounds(
            transverse_velocity=self["target.transverse_velocity"],
            radial_velocity=self.target.radial_velocity,
            direction_spread_angle=self.footprint_full_angles.direction_spread_angle,
            **geometry,
        )
        echo_ratio = plane_echo_ratio_bound(
            self.shared_option("target.reflectance_law"), **geometry
        )
        amplitude_gain = 1.0
        if self.adds_field_amplitudes:
            amplitude_gain = float(
                np.sqrt(place_beamlets(self.n_beamlets, self.beamlet_pattern)[1]).sum()
            )
        return FootprintExtent(
            axis_echo,
            echo_ratio,
            range_moments,
            range_moments,
            velocity_moments,
            amplitude_gain * np.sqrt(echo_ratio),
        )

    @cached_property
    def beat_amplitude(self) -> np.ndarray:
        """Amplitude of the beat of the line on the axis [V], before the receiver's poles."""
        return self.echo_scales.beat_amplitude_scale * relative_amplitude(
            self.waveform.architecture, self.footprint_extent.axis_echo
        )

    @cached_property
    def echo_shot_noise_ratio(self) -> np.ndarray:
        """Variance of the echo's shot noise over that of the receiver's noise."""
        total_echo = self.footprint_extent.axis_echo * np.maximum(
            self.footprint_extent.total_to_axis_echo_ratio, 1.0
        )
        return (
            self.echo_scales.echo_power_scale
            * total_echo
            * self.receiver_noise.shot_noise_variance_per_watt
            / self.noise.variance_without_echo
        )

    # Lines

    @property
    def middle_look_delay(self) -> np.ndarray | float:
        """Time from the first look (record of each segment) to the middle one [s]."""
        return self.waveform.middle_look_delay(self.looks)

    @cached_property
    def segment_starts(self) -> np.ndarray:
        """Time from the shot's start to each segment's start, of the middle look [s].

        These times hold whether or not the motion between segments is simulated.
        """
        starts = self.waveform.middle_look_starts(self.looks)
        return self.stack_segments(*self._select_existing_segments(starts))

    @cached_property
    def existing_segments(self) -> list[WaveformSegment]:
        """Existing segments of the shots' waveform.

        Each segment includes the target's motion, unless the effects ``doppler`` or
        ``segment_motion`` are switched off.
        """
        motion = LineMotion(
            doppler_ratio=0.0 if "doppler" in self.effects_off else self.target.doppler_ratio,
            segment_starts=(0.0, 0.0, 0.0)
            if "segment_motion" in self.effects_off
            else self.waveform.middle_look_starts(self.looks),
        )
        return self._select_existing_segments(self.waveform.segments(self.target, motion))

    @cached_property
    def beat_frequency(self) -> np.ndarray:
        """Signed beat of the line on the axis [Hz], by segment."""
        return self.stack_segments(*(s.beat_frequency(self.range) for s in self.existing_segments))

    @cached_property
    def missing_sample_bounds(self) -> MissingSampleBounds | None:
        """Bounds on the effect of samples that lack the echo; None if echoes fill all records."""
        if "overlap" in self.effects_off:
            return None
        delay = self.stack_segments(*(s.echo_delay(self.range) for s in self.existing_segments))
        n_missing = self.stack_segments(
            *(
                self.record.count_samples_before_echo(segment, self.range)
                for segment in self.existing_segments
            )
        ).astype(np.int64)
        latest_delay = delay * np.minimum(
            self.footprint_extent.range_offset_moments.largest_magnitude, 1e3
        )  # beyond the axis's
        latest_delay = (
            latest_delay
            + 2 / SPEED_OF_LIGHT * np.abs(self.target.approach_speed) * self.middle_look_delay
        )
        if not n_missing.any() and not (delay + latest_delay > self.record.acquisition_delay).any():
            return None
        return missing_sample_bounds(
            self.window, np.broadcast_to(n_missing, self.beat_frequency.shape)
        )

    def magnitude_max_beyond(self, distance: np.ndarray) -> np.ndarray:
        """Return the largest relative magnitude of a bin at least ``distance`` [bins] from a line.

        The magnitude is relative to the line's peak in a record that the echo fills.
        """
        response_max = self.window_response.magnitude_max_beyond(distance)
        if self.missing_sample_bounds is None:
            return response_max
        rectangular_response = window_response("rectangular", self.window.length, self.fft_size)
        step_sidelobe = (
            self.missing_sample_bounds.step_sidelobe_factor
            * rectangular_response.magnitude_max_beyond(distance - self.padding_factor)
        )
        return np.asarray(
            response_max + np.minimum(step_sidelobe, self.missing_sample_bounds.lost_fraction)
        )

    def peak_power_min_with_missing_samples(self, power: np.ndarray) -> np.ndarray:
        """Return a lower bound of the largest bin's power if the echo lacks samples of the record.

        ``power`` is the bound in a record that the echo fills. Both are relative to the power that
        all lines together would have on one bin.
        """
        if self.missing_sample_bounds is None:
            return power
        return np.asarray(
            np.maximum(np.sqrt(power) - self.missing_sample_bounds.lost_fraction, 0.0) ** 2
        )

    @cached_property
    def bin_offset(self) -> np.ndarray:
        """Distance of the line on the axis from the nearest bin [bins], 0..1/2, by segment."""
        bin_position = self.beat_frequency / self.record.bin_width
        return np.abs(bin_position - np.rint(bin_position))

    @cached_property
    def bins_from_line_to_edge(self) -> np.ndarray:
        """Distance [FFT bins] of the aliased line on the axis from the nearer of DC and Nyquist."""
        nyquist_bin = self.fft_size / 2
        nyquist_position = self.beat_frequency / (self.record.bin_width * nyquist_bin)
        return np.abs(nyquist_position - np.rint(nyquist_position)) * nyquist_bin

    @cached_property
    def transfer_gain(self) -> np.ndarray:
        """Amplitude gain of the receiver at the beat of the line on the axis, relative to DC."""
        return self.receiver_filter.amplitude_gain(self.beat_frequency)

    @cached_property
    def gain_slope_max(self) -> np.ndarray:
        """Upper bound on the relative change of the receiver's power gain per FFT bin [1/bin]."""
        receiver_filter = self.receiver_filter
        bandwidths = receiver_filter.detector_bandwidth, receiver_filter.amplifier_bandwidth
        return np.asarray(sum(1 / bandwidth for bandwidth in bandwidths) * self.record.bin_width)

    @cached_property
    def line_magnitude_over_sigma(self) -> np.ndarray:
        """|X| of the line on the beam's axis if it lay on a bin, over the noise per quadrature.

        There is a value for each segment.
        """
        receiver_filter, noise = self.receiver_filter, self.noise
        # Where an anti-alias filter passes almost no noise, the ADC's noise remains.
        if receiver_filter.antialias_parameters and receiver_filter.noise_shape != "white":
            noise = noise.with_sources(**{ADC_NOISE_SOURCE: adc_noise_variance(self.parameters)})
        sigma = self.record.bin_noise_sigma(noise.variance_without_echo, self.looks)
        gain = receiver_filter.pole_amplitude_gain(
            self.beat_frequency
        ) * receiver_filter.whitening_gain(self.beat_frequency, noise.adc_noise_fraction)
        return self.beat_amplitude * (0.5 * self.window.sum) / sigma * gain

    @cached_property
    def peak_magnitude_over_sigma(self) -> np.ndarray:
        """|X| in the largest bin of the line on the beam's axis, over the noise per quadrature.

        There is a value for each segment.
        """
        return self.line_magnitude_over_sigma * self.window_response.scalloping_gain(
            self.bin_offset
        )

    @cached_property
    def bins_per_relative_range(self) -> np.ndarray:
        """Shift of a line [FFT bins] per relative change of the target's range, by segment."""
        beat_per_relative_range = (
            self.waveform.chirp_rate * self.target.delay * (1 + np.abs(self.target.doppler_ratio))
        )
        return np.abs(self.existing_chirp_slopes) * (
            beat_per_relative_range / self.record.bin_width
        )

    @cached_property
    def bins_per_velocity(self) -> np.ndarray:
        """Shift of a line [FFT bins] per m/s of radial velocity, by segment."""
        return bins_per_velocity(
            range=self.range, carrier=self.carriers, chirp_rate=self.waveform.chirp_rate,
            bin_width=self.record.bin_width,
        )  # fmt: skip

    @cached_property
    def line_spread_by_range(self) -> OffsetMoments:
        """Moments of the offsets [FFT bins] of beamlets' lines from the line on the axis.

        These offsets are due to the beamlets' ranges.
        """
        return self.footprint_extent.range_offset_moments.scaled_by(self.bins_per_relative_range)

    @cached_property
    def line_spread_by_velocity(self) -> OffsetMoments:
        """Moments of the offsets [FFT bins] of beamlets' lines from the line on the axis.

        These offsets are due to the beamlets' radial velocities.
        """
        return self.footprint_extent.velocity_offset_moments.scaled_by(self.bins_per_velocity)

    @cached_property
    def line_spread(self) -> OffsetMoments:
        """Bounds on the moments of the offsets [FFT bins] of beamlets' lines from that on the axis.

        The offsets are sums of those due to range and those due to radial velocity.
        """
        return self.line_spread_by_range.bound_on_summed_offsets(self.line_spread_by_velocity)

    @cached_property
    def total_phase_error_bound(self) -> PhaseErrorBound:
        """Bound of the sum of all phase errors over the record."""
        total = NO_PHASE_ERROR
        for bound in self.phase_error_bounds.values():
            total = total.plus(bound)
        return total

    @cached_property
    def phase_error_shift_bins(self) -> np.ndarray | float:
        """Largest distance [FFT bins] by which phase errors shift light from its line."""
        return self.total_phase_error_bound.shift_window_bins * self.padding_factor

    @cached_property
    def bins_from_light_to_edge(self) -> np.ndarray:
        """Smallest distance [FFT bins] between the light of any line and DC or Nyquist.

        Light lies off the line on the axis by the beamlets' line offsets and by phase errors. A
        negative distance means that light may lie beyond DC or Nyquist.
        """
        return (
            self.bins_from_line_to_edge
            - self.line_spread.largest_magnitude
            - self.phase_error_shift_bins
        )

    @cached_property
    def is_near_image(self) -> np.ndarray:
        """True where lines and their images are so close that they may add up or cancel."""
        return ~(2 * self.bins_from_light_to_edge >= _NEAR_IMAGE_WINDOW_BINS * self.padding_factor)

    @cached_property
    def image_magnitude_bound(self) -> np.ndarray:
        """Largest |X| that images (at negative frequencies) can add to the largest bin.

        The result is relative to the |X| of all lines in phase.
        """
        smear_factor = 1 + 2 * self.phase_error_shift_bins / self.padding_factor
        gain_rise = np.exp(
            np.minimum(self.gain_slope_max * self.line_spread.largest_magnitude, 50.0)
        )
        image_response = self.magnitude_max_beyond(self.bins_from_light_to_edge) * np.sqrt(
            smear_factor
        )
        return np.asarray(
            gain_rise * image_response / self.window_response.scalloping_gain(self.bin_offset)
        )

    @property
    def amplitudes_may_add(self) -> bool:
        """True if beamlets add as amplitudes, always or in draws of speckle."""
        return self.adds_amplitudes or self.any_nonzero("target.roughness")

    @cached_property
    def amplitudes_may_cancel(self) -> np.ndarray:
        """True where amplitudes that add might nearly cancel."""
        if not self.amplitudes_may_add:
            return np.zeros_like(self.is_near_image)
        return self.is_near_image | (self.n_beamlets > 1)

    @cached_property
    def peak_power_bounds(self) -> PeakPowerBounds:
        """Bounds on the largest bin's power, for the offsets of all beamlets' lines."""
        return self.peak_power_bounds_for_spread(self.line_spread)

    def peak_power_bounds_for_spread(self, moments: OffsetMoments) -> PeakPowerBounds:
        """Return bounds on the largest bin's power for lines of a given spread.

        Parameters
        ----------
        moments : OffsetMoments
            Moments of the lines' offsets from the axis's line [bins].

        Returns
        -------
        PeakPowerBounds
            Bounds relative to the power of all lines if they lay on one bin.

        Notes
        -----
        The bounds follow from Taylor's series, the line of the strongest beamlet, and Chebyshev's
        inequality. A fraction 1 - 1/t^2 of the power lies within t standard deviations of the
        lines' offsets, and the largest bin in this interval holds at least the mean.
        """
        response, gain_slope, (mean, rms, extreme) = (
            self.window_response,
            self.gain_slope_max,
            moments,
        )
        axis_power = response.scalloping_gain(self.bin_offset) ** 2
        if moments is ZERO_OFFSET_MOMENTS or self.n_beamlets == 1:
            return PeakPowerBounds(axis_power, axis_power * np.where(self.is_near_image, 2.0, 1.01))
        curvature_loss = 0.5 * response.power_curvature_max * rms * rms
        power_min = (
            axis_power
            - np.minimum(response.power_slope_max, response.power_curvature_max * self.bin_offset)
            * mean
        )
        power_min = power_min - curvature_loss - gain_slope * rms
        power_min = np.maximum(
            power_min,
            np.exp(-gain_slope * extreme) * (response.scalloping_gain_min**2 / self.n_beamlets),
        )
        for t in _CHEBYSHEV_INEQUALITY_DEVIATIONS:
            half_width = t * rms
            power_max = (
                (1 - 1 / t**2)
                * response.central_energy_min
                / (2 * half_width + 2 * response.padding_factor + 1)
            )
            power_min = np.maximum(power_min, power_max * np.exp(-gain_slope * half_width))
        power_max = np.minimum(axis_power + response.power_slope_max * mean + curvature_loss, 1.0)
        gain_rise = np.exp(np.minimum(gain_slope * extreme, 50.0))
        power_max = power_max * np.where(self.is_near_image, 2.0, 1.01)
        power_max = power_max * (1 + gain_rise * np.minimum(gain_slope * rms, 50.0))
        return PeakPowerBounds(np.minimum(power_min, power_max), power_max)

    def peak_power_change_bound(
        self,
        added_moments: OffsetMoments,
        present_moments: OffsetMoments,
        shift_bins: np.ndarray | float = 0.0,
    ):
        """Return a bound on the relative change of the largest bin's power as lines move or spread.

        Parameters
        ----------
        added_moments : OffsetMoments
            Moments of the added offsets X [bins].
        present_moments : OffsetMoments
            Moments of the offsets x_b without the change [bins].
        shift_bins : ndarray or float
            Common shift of all lines [bins].

        Returns
        -------
        ndarray (segments, ...)
            Bound >= 0, relative to the power of the largest bin, by segment and point.

        Notes
        -----
        Bin k has the power P_k = sum_b p_b F(k - x_b), with the power p_b of beamlet b, and the
        power F of a line by distance. F1 and F2 are bounds on |F'| and |F''|. Added offsets X_b
        change P_k by

            |P_k(with) - P_k(without)| <= F1 |m| + F2 (S s + s^2 / 2) + c s

        Here m and s are the mean and the rms of X, and S is the rms of x. The factor c is due to
        the slope of the receiver's gain.
        """
        response, power_min = (
            self.window_response,
            self.peak_power_bounds_for_spread(present_moments).power_min,
        )
        power_change = response.power_slope_max * (added_moments.mean + shift_bins)
        power_change = power_change + response.power_curvature_max * (
            present_moments.rms * added_moments.rms + added_moments.rms**2 / 2
        )
        gain_exponent = self.gain_slope_max * (
            present_moments.largest_magnitude + added_moments.largest_magnitude + shift_bins
        )
        power_change = power_change + self.gain_slope_max * (added_moments.rms + shift_bins)
        image_factor = np.where(self.is_near_image, 2.0, 1.05)
        return image_factor * np.exp(np.minimum(gain_exponent, 50.0)) * power_change / power_min

    def coherent_sum_change_bound(self, shift_bins: np.ndarray | float) -> np.ndarray:
        """Return a bound on the relative change of a sum of amplitudes whose lines move.

        Lines move by ``shift_bins``. The change is relative to the sum in phase. Its bound follows
        from the derivatives of the window's transform and of the receiver's gain, and from the
        phases at mid-record of line and image.
        """
        phase_per_bin = (
            2
            * np.pi
            * (self.record.acquisition_delay + 0.5 * self.record.duration)
            * self.record.bin_width
        )
        line_change = (
            np.sqrt(self.window_response.power_curvature_max)
            + 2 * self.gain_slope_max
            + phase_per_bin
        ) * shift_bins
        gain_rise = np.exp(
            np.minimum(
                self.gain_slope_max * (self.line_spread.largest_magnitude + shift_bins), 50.0
            )
        )
        return (
            2 * gain_rise * np.minimum(line_change, 2.0) / self.window_response.scalloping_gain_min
        )
