"""Laser line width: a beat that is not a pure tone.

The models of a Gaussian and of a Lorentzian line, with their sources, are in
:mod:`sweep.model.laser_line`. A Gaussian line averages |X|^2 over frequency shifts. A Lorentzian
line takes power from the pure line, and adds a pedestal of noise that comes with the echo. An echo
that arrives within the record has the line and the pedestal of its own samples.

References
----------
The Gaussian line is the convolution of [T]. The Lorentzian line's pedestal is that of Richter et
al., IEEE J. Quantum Electron. 22, 2070, 1986; docs/physics.md, *Line width*.
"""

from dataclasses import replace

import numpy as np

from sweep.model.effects.effect import Effect, EffectContext, Parameter
from sweep.model.effects.error_bounds import (
    ErrorBound,
    PhaseErrorBound,
    magnitude_change_from_power,
)
from sweep.model.effects.phase_errors import coherent_sum_change, window_moments
from sweep.model.effects.planner_inputs import PlannerInputs
from sweep.model.laser_line import (
    DEVIATION_PER_FWHM,
    LaserLine,
    apparent_line_and_pedestal_power,
    pedestal_density_under_line,
    pedestal_power_under_line,
    pure_line_power_fraction,
)
from sweep.model.link_budget import LASER_PREFIX
from sweep.model.preparation import Shots, window_energy_from_sample
from sweep.model.unsupported_shot import UnsupportedShotError
from sweep.model.waveform import round_trip_delay
from sweep.model.window import zero_first_samples

_LINE_REACH_DEVIATIONS = 6.0
"""Distance from the centre of a Gaussian line beyond which its light is neglected, in standard
deviations of the line."""

_DENSEST_PEDESTAL_EXPONENT = 1.7932821329
"""Solution g of e^g = 1 + g + g^2. A phase-noise pedestal is densest under its line if 2 pi times
the line width (FWHM) times the delay of the echo equals g."""

_WIDTH_PATH, _SHAPE_PATH = LASER_PREFIX + "line_width", LASER_PREFIX + "line_shape"


def _line_deviation_window_bins(points: PlannerInputs) -> np.ndarray:
    """Return the standard deviation of a Gaussian laser line, in bins of fs/L.

    fs is the sample rate, and L the number of samples in the record.
    """
    return DEVIATION_PER_FWHM * points[_WIDTH_PATH] * points.record.duration


def phase_error_bound(points: PlannerInputs) -> PhaseErrorBound | None:
    """Return a bound whose shift is the distance to which a Gaussian laser line spreads light.

    The distance is _LINE_REACH_DEVIATIONS standard deviations of the line. The result is None for
    line shapes that are not Gaussian, and for lines without width.
    """
    if not points.any_nonzero(_WIDTH_PATH) or points.shared_option(_SHAPE_PATH) != "gaussian":
        return None
    return PhaseErrorBound(
        extra_shift_window_bins=_LINE_REACH_DEVIATIONS * _line_deviation_window_bins(points)
    )


def error_bound(points: PlannerInputs) -> ErrorBound | None:
    """Return a bound on the change of the detecting bins if the line width is omitted.

    Parameters
    ----------
    points
        Points for which the bound holds.

    Returns
    -------
    ErrorBound or None
        Bound at each point; None if all lines have the width 0.

    Notes
    -----
    Gaussian line: the mean power of a bin departs from |X|^2, that of a pure tone, by at most
    (2 pi s)^2 var_w (sum |w|)^2. Here w is the window, and s the standard deviation of the line
    [bins of fs/L]. The variance var_w is that of the position in the record, weighted by |w|.

    Lorentzian line of FWHM dnu: the pure line keeps the fraction exp(-g) of its power. Here g =
    Gamma min(tau, T_w), with Gamma = 2 pi dnu, the delay tau of the echo and the duration T_w of
    the record. The pedestal is noise that comes with the signal. No bin holds more of the pedestal
    than sum w^2 (fs S(0) + 1 - exp(-g)). Here fs is the sample rate, and S(0) is the density of the
    pedestal under the line [1/Hz], :func:`sweep.model.laser_line.pedestal_density_under_line`.
    """
    if not points.any_nonzero(_WIDTH_PATH):
        return None
    if points.shared_option(_SHAPE_PATH) == "lorentzian":
        return _lorentzian_error_bound(points)
    moments, line_deviation = window_moments(points.window), _line_deviation_window_bins(points)
    spread_loss = np.minimum((2 * np.pi * line_deviation) ** 2 * moments.position_variance, 1.0)
    smear_factor = 1 + 2 * points.phase_error_shift_bins / points.padding_factor
    power_min = points.peak_power_min_with_missing_samples(
        points.peak_power_bounds.power_min
        / np.where(points.is_near_image, 2.0, 1.01)
        / smear_factor
    )
    magnitude_change = magnitude_change_from_power(
        moments.magnitude_sum_ratio**2 * spread_loss / power_min
    )
    if not points.amplitudes_may_add:
        return ErrorBound(magnitude_change=magnitude_change)
    half_reach = 0.5 * _LINE_REACH_DEVIATIONS * line_deviation
    coherent_change = coherent_sum_change(
        points, PhaseErrorBound((half_reach, 0.0, 0.0, 0.0), mid_record_phase=half_reach)
    )
    return ErrorBound(
        magnitude_change=np.where(points.amplitudes_may_cancel, 0.0, magnitude_change),
        coherent_sum_change=coherent_change,
    )


def _lorentzian_error_bound(points: PlannerInputs) -> ErrorBound:
    """Return bounds on the changes if the width of a Lorentzian laser line is omitted.

    The changes are the power that the pure line loses, and the pedestal of noise around it.
    """
    line_width, delay = points[_WIDTH_PATH], np.minimum(points.target.delay, points.record.duration)
    coherent_fraction = pure_line_power_fraction(
        line_width=line_width, delay=delay, duration=np.asarray(np.inf)
    )
    densest_width = np.minimum(line_width, _DENSEST_PEDESTAL_EXPONENT / (2 * np.pi * delay))
    density = pedestal_density_under_line(line_width=densest_width, delay=delay)
    echo_ratio = points.footprint_extent.total_to_axis_echo_ratio
    beat_amplitude = points.beat_amplitude * (
        echo_ratio if points.waveform.architecture == "direct" else np.sqrt(echo_ratio)
    )
    cnr = beat_amplitude**2 / points.noise.variance_without_echo  # including its image
    return ErrorBound(
        magnitude_change=1 - np.sqrt(coherent_fraction),
        noise_variance_change=cnr * (points.sample_rate * density + (1 - coherent_fraction)),
        threshold_follows_noise=False,
    )


def _line_fraction_and_pedestal(
    shots: Shots, timing: dict[str, np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Return two results (n,) of apparent_line_and_pedestal_power in :mod:`sweep.model.laser_line`.

    The first is the fraction of power that a laser's pure line keeps. The second is the pedestal of
    phase noise. Both are for the samples of the record that hold the echo.
    """
    looks = shots.looks.n_coherent
    if shots.echo_record.n_samples_before_echo is None:
        return apparent_line_and_pedestal_power(window=shots.window, looks=looks, **timing)
    n_before_echo = shots.echo_record.n_samples_before_echo[0]
    windows = [zero_first_samples(shots.window, n_missing) for n_missing in n_before_echo.tolist()]
    line_fraction, in_phase_pedestal = np.empty((2, shots.size))
    timing = {name: np.broadcast_to(values, shots.size) for name, values in timing.items()}
    for window in dict.fromkeys(windows):
        has_window = np.array([window is other_window for other_window in windows])
        part_timing = {name: values[has_window] for name, values in timing.items()}
        line_fraction[has_window], in_phase_pedestal[has_window] = apparent_line_and_pedestal_power(
            window=window, looks=looks, **part_timing
        )
        in_phase_pedestal[has_window] *= (
            window_energy_from_sample(shots.window)[n_before_echo[has_window]] / window.energy
        )
    return line_fraction, in_phase_pedestal


def apply(shots: Shots, context: EffectContext) -> Shots:
    """Apply the laser's line: a Gaussian shape, or a weaker pure line and a pedestal of noise.

    Parameters
    ----------
    shots : Shots
        Prepared shots of n points (:class:`sweep.model.preparation.Shots`).
    context : EffectContext
        Shape of the line, and its full width at half maximum [Hz]: that of the beat if the shape is
        Gaussian, that of the laser if it is Lorentzian
        (:class:`sweep.model.effects.effect.EffectContext`).

    Returns
    -------
    Shots
        Shots with the Gaussian width; or with amplitudes reduced to those of the pure line, and
        with the pedestal as noise variances [V^2] under and beside the line.

    Raises
    ------
    UnsupportedShotError
        For coherently added looks of a Lorentzian laser, if an echo returns after the record's
        length.

    Notes
    -----
    Gaussian: |X|^2 is averaged over frequencies of the given FWHM. Lorentzian of width dnu: the
    pure line keeps exp(-2 pi dnu tau) of its power, for the delay tau or the record's length if
    that is shorter, and the rest is a pedestal of noise
    (:func:`sweep.model.laser_line.apparent_line_and_pedestal_power`).
    """
    line_width = np.asarray(context.parameters[_WIDTH_PATH], float)
    if str(context.parameters[_SHAPE_PATH]) == "gaussian":
        return replace(shots, laser_line=LaserLine(gaussian_fwhm=line_width + np.zeros(shots.size)))
    delay = round_trip_delay(shots.range)
    line_width = line_width + np.zeros(shots.size)
    timing = {"line_width": line_width, "delay": delay, "duration": shots.record.duration}
    if shots.looks.n_coherent > 1 and np.any(delay > shots.record.duration):
        raise UnsupportedShotError(
            f"{_WIDTH_PATH} leaves of looks that are added what their phases have in common, which "
            "is "
            f"known for echoes that come back within a record, of "
            f"{np.min(shots.record.duration):.3g} s, and this one takes {np.max(delay):.3g} s: "
            "raise instrument.processing.fft_size, or take instrument.looks.combine: power"
        )
    line_fraction, in_phase_pedestal = _line_fraction_and_pedestal(shots, timing)
    echo = shots.total_relative_echo  # with direct detection the beat's amplitude, else its power
    beat_power = echo**2 if shots.waveform.architecture == "direct" else echo
    line_power = (shots.echo_scales.beat_amplitude_scale / 2) ** 2 * beat_power
    side_pedestal = pedestal_power_under_line(window=shots.window, **timing)
    if shots.echo_record.n_samples_before_echo is not None:
        side_pedestal = (
            side_pedestal
            * window_energy_from_sample(shots.window)[shots.echo_record.n_samples_before_echo[0]]
            / shots.window.energy
        )
    return replace(
        shots,
        echo_scales=shots.echo_scales.with_scaled_echo(amplitude_factor=np.sqrt(line_fraction)),
        laser_line=LaserLine(
            lorentzian_fwhm=line_width,
            pedestal_variance_beside_line=line_power * side_pedestal / shots.window.energy,
            pedestal_variance_under_line=line_power * 2 * in_phase_pedestal / shots.window.energy,
        ),
    )


LINE_WIDTH = Effect(
    name="line_width",
    description="width of the laser's line",
    stage="record",
    error_bound=error_bound,
    phase_error_bound=phase_error_bound,
    apply=apply,
    is_in_time_domain_truth=False,
    parameters=(
        Parameter(
            path=_WIDTH_PATH,
            description="Full width at half maximum of the laser's line; Gaussian: of the beat's",
            example="10 kHz",
            limits=("0 Hz", "1e15 Hz"),
        ),
        Parameter(
            path=_SHAPE_PATH,
            description="Gaussian, slow against the record; or the Lorentzian of a laser mixed "
            "with "
            "itself after the echo's delay",
            default="gaussian",
            options=("gaussian", "lorentzian"),
        ),
    ),
)
"""Effect that spreads each beat over the spectrum by the width of the laser's line."""
