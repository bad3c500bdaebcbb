"""Saturation: a record beyond the ADC's full scale is clipped.

A beat of amplitude A with Gaussian noise of standard deviation s is clipped at +-V. As a memoryless
nonlinearity on a sine, clipping leaves [1]_, in the manner of Bussgang,

- the line, with the gain  2/A <m(A sin t) sin t>, where m(x) is the mean of x + n after clipping
  and < > the mean over the phase t;
- odd harmonics of amplitudes 2 <m(A sin t) sin(k t)>, folded at Nyquist, which are neglected;
- noise, still white, by the mean of the clipped noise's variance over s^2.

For s -> 0 and r = V/A < 1 the gain is 2/pi (asin r + r sqrt(1 - r^2)), and noise passes during the
fraction 2/pi asin(r) of the time.

The record is taken as one sine of constant amplitude. A footprint that spreads over bins has an
envelope that varies over the record, which clips less than its peak indicates.

References
----------
.. [1] Blachman, IRE Trans. Inf. Theory 10 (1964) 162.
"""

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import ndtr

from sweep.model import waveform
from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.effects.effect import Effect, EffectContext, Parameter
from sweep.model.effects.error_bounds import ErrorBound
from sweep.model.effects.planner_inputs import PlannerInputs
from sweep.model.link_budget import PROCESSING_PREFIX
from sweep.model.preparation import Shots
from sweep.model.unsupported_shot import UnsupportedShotError

_GAUSS_NODES, _GAUSS_WEIGHTS = np.polynomial.legendre.leggauss(32)
_INTEGRAL_SPLIT_DEVIATIONS = np.array([-8.0, 0.0, 8.0])
"""Voltages minus full scale [standard deviations of the noise] at which integrals over a quarter
period of the sine are split. Between these voltages the integrands are smooth."""
_ZERO_AMPLITUDE_SUBSTITUTE_VOLTS = 1e-30
"""Positive voltage [V] that replaces an amplitude of 0 where a positive number is needed."""
_UNLIMITED_VOLTAGE = 1e100
"""Full-scale voltage [V] of an ADC that never clips."""
_AMPLITUDE_MIN_SIGMA = 1e-5
"""Smallest beat amplitude for which the gain is computed, in standard deviations of the noise.
Weaker beats have the same gain, with a relative error of the square of this number."""


class ClippingGains(NamedTuple):
    """Factors by which clipping reduces a sine and the noise added to it, (n,) each."""

    signal_gain: np.ndarray
    """Factor, 0..1, by which clipping multiplies the amplitude of the line."""
    noise_gain: np.ndarray
    """Factor, 0..1, by which clipping multiplies the variance of the noise."""


def clipping_gains(
    *, amplitude: ArrayLike, deviation: ArrayLike, full_scale: ArrayLike
) -> ClippingGains:
    """Compute the factors by which clipping reduces a line and the noise.

    Parameters
    ----------
    amplitude : array_like
        Amplitude A of the beat at the ADC [V], > 0.
    deviation : array_like
        Standard deviation s of the noise at the ADC [V], > 0.
    full_scale : array_like
        Largest voltage V to either side that does not clip [V], > 0.

    Returns
    -------
    ClippingGains
        Factors on line and noise, by the equations of the module's description.
    """
    voltages = (np.asarray(value, float) for value in (amplitude, deviation, full_scale))
    a, s, v = (value[..., None] for value in np.broadcast_arrays(*voltages))
    a = np.maximum(a, _AMPLITUDE_MIN_SIGMA * s)
    phase, weight = _phase_quadrature(a, s, v)
    sine = np.sin(phase)
    voltage_loss, variance_left = _clipping_loss_and_variance(a * sine, s, v)
    amplitude_loss = 2 * (weight * voltage_loss * sine).sum(axis=-1)  # loss of the line's amplitude
    return ClippingGains(
        signal_gain=1 - amplitude_loss / a[..., 0],
        noise_gain=(weight * variance_left).sum(axis=-1) / s[..., 0] ** 2,
    )


def _phase_quadrature(a: np.ndarray, s: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return quadrature phases [rad] in a quarter period of a sine, and weights of sum 1.

    Both are (n, nodes). The arguments, (n, 1) each, are the amplitude ``a`` of the sine, the noise
    sigma ``s`` and the full scale ``v`` [V].
    """
    split_phases = np.arcsin(np.clip((v + _INTEGRAL_SPLIT_DEVIATIONS * s) / a, 0.0, 1.0))
    zeros = np.zeros(a.shape)
    cuts = np.concatenate([zeros, split_phases, zeros + math.pi / 2], axis=-1)
    half_width = np.diff(cuts)[..., None] / 2
    phase = (cuts[..., :-1, None] + half_width) + half_width * _GAUSS_NODES
    weight = half_width * _GAUSS_WEIGHTS / (math.pi / 2)
    flat_shape = (*a.shape[:-1], -1)
    return phase.reshape(flat_shape), weight.reshape(flat_shape)


def _clipping_loss_and_variance(
    x: np.ndarray, s: np.ndarray, v: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean loss of a noisy voltage by clipping, and the variance of the clipped voltage.

    Parameters
    ----------
    x
        Voltage without noise, >= 0 [V].
    s
        Standard deviation of the Gaussian noise n that is added to it [V].
    v
        Full scale V: the sum x + n is clipped at -V and V [V].

    Returns
    -------
    mean_loss
        Mean of x + n minus its mean after clipping [V], at least 0.
    variance
        Variance of the clipped voltage [V^2].

    Notes
    -----
    Clipping limits n/s to b = (-V - x)/s .. a = (V - x)/s. The mean loss over s is
    f(a) - a Q(a) at the upper limit, with the standard normal density f and its upper tail
    probability Q. The gain at the lower limit, f(b) + b Q(-b), is subtracted.
    """
    a, b = (v - x) / s, (-v - x) / s
    density_above, density_below = (np.exp(-0.5 * z * z) / math.sqrt(2 * math.pi) for z in (a, b))
    probability_above, probability_below = ndtr(-a), ndtr(b)
    mean_loss = (density_above - a * probability_above) - (density_below + b * probability_below)
    mean_square = (
        a * a * probability_above
        + b * b * probability_below
        + (ndtr(a) - probability_below)
        + b * density_below
        - a * density_above
    )
    return s * np.maximum(mean_loss, 0.0), s * s * np.maximum(
        mean_square - mean_loss * mean_loss, 0.0
    )


_FULL_SCALE_PATH = PROCESSING_PREFIX + "full_scale"

FULL_SCALE_EXCESS_MAX = 1e6
"""Largest allowed ratio of signal or noise to the ADC's full scale. The gains of clipping lose as
many significant digits as the ratio has."""


def apply(shots: Shots, context: EffectContext) -> Shots:
    """Reduce line and noise by clipping at the ADC's full scale.

    Parameters
    ----------
    shots : Shots
        Prepared shots of n points (:class:`sweep.model.preparation.Shots`).
    context : EffectContext
        Full scale of the ADC [V], 0 for no limit; the ground is not used
        (:class:`sweep.model.effects.effect.EffectContext`).

    Returns
    -------
    Shots
        Shots with the gains of clipping on the amplitude of lines and on the noise variance, or
        unchanged if no point has a limit.

    Raises
    ------
    UnsupportedShotError
        If a record exceeds full scale more than :data:`FULL_SCALE_EXCESS_MAX` times.

    Notes
    -----
    The record is taken as one sine with the power of all lines, and :func:`clipping_gains` gives
    the gains of line and noise. In a complex record I and Q have half of the sine's amplitude and
    half of the noise variance each.
    """
    full_scale = np.asarray(context.parameters[_FULL_SCALE_PATH], float)
    is_limited = full_scale > 0
    if not is_limited.any():
        return shots
    light_fraction = 0.5 if shots.complex_record else 1.0  # I and Q have half of the light each
    amplitude = np.maximum(
        total_beat_amplitude(shots) * light_fraction, _ZERO_AMPLITUDE_SUBSTITUTE_VOLTS
    )
    deviation = np.sqrt(shots.noise_variance * light_fraction)
    voltage_limit = np.where(is_limited, full_scale, _UNLIMITED_VOLTAGE)
    with np.errstate(over="ignore"):  # a denormal limit overflows the ratio
        excess = float((np.maximum(amplitude, deviation) / voltage_limit).max())
    if excess > FULL_SCALE_EXCESS_MAX:
        raise UnsupportedShotError(
            f"instrument.processing.full_scale is exceeded {excess:.3g} times by signal or noise, "
            f"and {FULL_SCALE_EXCESS_MAX:g} times can be simulated: raise it, or lower "
            "instrument.receiver.transimpedance"
        )
    gains = clipping_gains(amplitude=amplitude, deviation=deviation, full_scale=voltage_limit)
    return replace(
        shots,
        echo_scales=shots.echo_scales.with_scaled_echo(amplitude_factor=gains.signal_gain),
        noise=replace(shots.noise, variance_factor=shots.noise.variance_factor * gains.noise_gain),
    )


def total_beat_amplitude(shots: Shots) -> np.ndarray:
    """Return the amplitude at the ADC [V] of a sine with the power of all lines, (n,).

    The amplitude is that of the existing segment with the lowest beat frequency, which passes the
    receiver best.
    """
    beat_inputs = {
        "chirp_rate": shots.waveform.chirp_rate, "range": shots.range,
        "radial_velocity": np.asarray(shots.motion.doppler_ratio * SPEED_OF_LIGHT / 2),
    }  # fmt: skip
    beat_frequencies = [
        waveform.beat_frequency(
            shots.waveform.chirp_rate_ratios[segment_index],
            carrier=shots.waveform.carriers[segment_index],
            **beat_inputs,
        )
        for segment_index in np.flatnonzero(shots.has_segment)
    ]
    lowest_beat = np.min(np.abs(beat_frequencies), axis=0)
    gain = shots.receiver_filter.amplitude_gain(lowest_beat)
    echo = shots.total_relative_echo
    echo = echo if shots.waveform.architecture == "direct" else np.sqrt(echo)
    return np.asarray(shots.echo_scales.beat_amplitude_scale * echo * gain)


def error_bound(points: PlannerInputs) -> ErrorBound | None:
    """Return a bound on the change of results if clipping is omitted.

    The bound holds whichever of the effects are simulated.

    Notes
    -----
    Let p be the probability that the highest sample is clipped. Line and noise lose at most the
    fraction p, because the mean slope of the clipped signal is 1 - p. The threshold does not
    follow.
    """
    if not points.any_nonzero(_FULL_SCALE_PATH):
        return None
    echo_ratio = np.maximum(points.footprint_extent.total_to_axis_echo_ratio, 1.0)
    amplitude_ratio = (
        echo_ratio if points.waveform.architecture == "direct" else np.sqrt(echo_ratio)
    )
    amplitude = (points.beat_amplitude * amplitude_ratio * points.transfer_gain).max(axis=0)
    noise_factor: np.ndarray | float = 1.0
    for bound in points.noise_bounds.values():
        noise_factor = noise_factor + bound.noise_variance_change
    deviation = np.sqrt(points.noise.variance_without_echo * noise_factor)
    full_scale = points[_FULL_SCALE_PATH]
    voltage_limit = np.where(full_scale > 0, full_scale, _UNLIMITED_VOLTAGE)
    clip_probability = ndtr((amplitude - voltage_limit) / deviation) + ndtr(
        -(amplitude + voltage_limit) / deviation
    )
    return ErrorBound(
        magnitude_change=clip_probability,
        noise_variance_change=-clip_probability * (2 - clip_probability) * (1 - 1e-9),
        threshold_follows_noise=False,
    )


SATURATION = Effect(
    name="saturation",
    description="clipping at the ADC's full scale",
    stage="record",
    error_bound=error_bound,
    apply=apply,
    parameters=(
        Parameter(
            path=_FULL_SCALE_PATH,
            description="Largest voltage, to either side, that the ADC takes; 0 V for no limit",
            example="1 V",
            limits=("0 V", "1e12 V"),
        ),
    ),
)
"""Effect that clips records at the ADC's full scale."""
