"""Saturation: a record beyond the ADC's full scale is clipped.

A beat of amplitude A with Gaussian noise of deviation s is cut at +-V. As a memoryless law on a
sine it leaves [Blachman, IRE Trans. Inf. Theory 10 (1964) 162, in the manner of Bussgang]

- the line, by the gain  2/A <m(A sin t) sin t>, where m(x) is the mean of x + n once clipped and
  < > the mean over the phase t;
- odd harmonics, amplitudes 2 <m(A sin t) sin(k t)>, folded at Nyquist, which are left out;
- noise, white still, by the mean of the clipped noise's variance over s^2.

For s -> 0 and r = V/A < 1 the gain is 2/pi (asin r + r sqrt(1 - r^2)) and noise passes for the
share 2/pi asin(r) of the time.

The record is taken for one sine of constant amplitude; a footprint that spreads over bins makes
an envelope that changes over the record, which clips less than its peak says.
"""

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import ndtr

from sweep.model import link, waveform
from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.effects import amplifier, atmosphere, circulator_leak, noise_sources
from sweep.model.effects.effect import Effect, Parameter, Scene, Size
from sweep.model.effects.points import Points
from sweep.model.preparation import PROCESSING, Shots
from sweep.model.unsupported import UnsupportedShot

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(32)
_CUTS = np.array([-8.0, 0.0, 8.0])
"""Point at which the quarter of a period is cut, in deviations of the noise off full scale: the
integrands are smooth in between.
"""
_SMALLEST = 1e-30
"""Stands for what is no more than positive."""
_NO_LIMIT = 1e100
_FAINTEST = 1e-5
"""Deviations of the noise below which beats are taken for that strong: their gain is the same to
the square of this, and could not be told from the rounding of 1."""


class Clipping(NamedTuple):
    """A sine with noise once it is clipped, (n,) each."""

    signal_gain: np.ndarray
    """Factor on the line's amplitude, 0..1."""
    noise_gain: np.ndarray
    """Factor on the noise variance, 0..1."""


def clipping(*, amplitude: ArrayLike, deviation: ArrayLike, full_scale: ArrayLike) -> Clipping:
    """Gain of line and noise by clipping, from voltages at the ADC [V], > 0, (n,) or scalars.

    They are the beat's amplitude, the noise's deviation, and the largest voltage that does not
    clip, to either side.
    """
    given = (np.asarray(value, float) for value in (amplitude, deviation, full_scale))
    a, s, v = (value[..., None] for value in np.broadcast_arrays(*given))
    a = np.maximum(a, _FAINTEST * s)
    phase, weight = _phases(a, s, v)
    sine = np.sin(phase)
    loss, spread = _lost(a * sine, s, v)
    taken = 2 * (weight * loss * sine).sum(axis=-1)  # off the line's amplitude
    return Clipping(
        signal_gain=1 - taken / a[..., 0],
        noise_gain=(weight * spread).sum(axis=-1) / s[..., 0] ** 2,
    )


def _phases(a: np.ndarray, s: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Phases in a quarter of a period and weights whose sum is 1, (n, nodes) each."""
    inner = np.arcsin(np.clip((v + _CUTS * s) / a, 0.0, 1.0))
    ends = np.zeros(a.shape)
    cuts = np.concatenate([ends, inner, ends + math.pi / 2], axis=-1)
    half = np.diff(cuts)[..., None] / 2
    phase = (cuts[..., :-1, None] + half) + half * _NODES
    weight = half * _WEIGHTS / (math.pi / 2)
    shape = (*a.shape[:-1], -1)
    return phase.reshape(shape), weight.reshape(shape)


def _lost(x: np.ndarray, s: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean of what clipping takes off x + n, x >= 0, and the variance of what it leaves.

    In units of s, with ends a = (V - x)/s and b = (-V - x)/s: clipped noise is a above a, b below
    b. What is cut off above has the mean f(a) - a Q(a), below likewise.
    """
    a, b = (v - x) / s, (-v - x) / s
    density = [np.exp(-0.5 * z * z) / math.sqrt(2 * math.pi) for z in (a, b)]
    above, below = ndtr(-a), ndtr(b)
    cut = (density[0] - a * above) - (density[1] + b * below)
    square = a * a * above + b * b * below + (ndtr(a) - below) + b * density[1] - a * density[0]
    return s * np.maximum(cut, 0.0), s * s * np.maximum(square - cut * cut, 0.0)


_FULL_SCALE = PROCESSING + "full_scale"

NOISE = (
    noise_sources.SOLAR_BACKGROUND, atmosphere.BACKSCATTER,
    noise_sources.RELATIVE_INTENSITY_NOISE, amplifier.SPONTANEOUS_EMISSION,
    circulator_leak.CIRCULATOR_LEAK, noise_sources.QUANTISATION,
)  # fmt: skip
"""Effects that add noise before the ADC clips, besides the shot noise of the echo."""

MOST_BEYOND = 1e6
"""Signal or noise over full scale; what clipping leaves has lost as many digits as this has."""


def act(shots: Shots, scene: Scene) -> Shots:
    """Line and noise as clipping leaves them.

    The record is taken for one sine with the power of all lines. An UnsupportedShot for records
    that exceed full scale more than :data:`MOST_BEYOND` times.
    """
    full_scale = np.asarray(scene.parameters[_FULL_SCALE], float)
    limited = full_scale > 0
    if not limited.any():
        return shots
    each = 0.5 if shots.complex_record else 1.0  # I and Q have half of the light each
    amplitude = np.maximum(beat_amplitude(shots) * each, _SMALLEST)
    deviation = np.sqrt(shots.noise_variance * each)
    limit = np.where(limited, full_scale, _NO_LIMIT)
    with np.errstate(over="ignore"):  # a denormal limit is exceeded endlessly
        beyond = float((np.maximum(amplitude, deviation) / limit).max())
    if beyond > MOST_BEYOND:
        raise UnsupportedShot(
            f"instrument.processing.full_scale is exceeded {beyond:.3g} times by signal or noise, "
            f"and {MOST_BEYOND:g} times can be simulated: raise it, or lower "
            "instrument.receiver.transimpedance"
        )
    left = clipping(amplitude=amplitude, deviation=deviation, full_scale=limit)
    return replace(
        shots,
        beat_scale=shots.beat_scale * left.signal_gain,
        noise_gain=shots.noise_gain * left.noise_gain,
    )


def beat_amplitude(shots: Shots) -> np.ndarray:
    """Amplitude at the ADC [V] of a sine with the power of all lines, (n,).

    In the segment that passes the receiver best, of those that there are: at its lowest frequency.
    """
    shape = {
        "chirp_rate": shots.chirp_rate, "range": shots.range,
        "radial_velocity": np.asarray(shots.beta * SPEED_OF_LIGHT / 2),
    }  # fmt: skip
    beats = [
        waveform.beat_frequency(shots.slopes[s], carrier=shots.carriers[s], **shape)
        for s in np.flatnonzero(shots.segments)
    ]
    lowest = np.min(np.abs(beats), axis=0)
    gain = link.transfer(
        lowest,
        detector_bandwidth=shots.detector_bandwidth,
        amplifier_bandwidth=shots.amplifier_bandwidth,
    )
    if shots.antialias:
        gain = gain * np.sqrt(link.antialias_power(lowest, **shots.antialias))
    echo = shots.relative_echo
    echo = echo if shots.architecture == "direct" else np.sqrt(echo)
    return np.asarray(shots.beat_scale * echo * np.abs(gain))


def size(points: Points) -> Size | None:
    """Change by leaving clipping out, whatever else is noise or dims the echo.

    Line and noise lose no more than the probability that the highest sample is clipped, as the mean
    slope of what is left is one less that probability; the threshold stays.
    """
    if not points.has(_FULL_SCALE):
        return None
    echo = np.maximum(points.footprint.echo_ratio, 1.0)
    together = echo if points.architecture == "direct" else np.sqrt(echo)
    amplitude = (points.beat * together * points.transfer).max(axis=0)
    louder = 1 + points.echo_noise
    for effect in NOISE:
        if (change := effect.size(points)) is not None:
            louder = louder + change.noise
    deviation = np.sqrt(points.noise_variance * louder)
    limit = points[_FULL_SCALE]
    v = np.where(limit > 0, limit, _NO_LIMIT)
    clipped = ndtr((amplitude - v) / deviation) + ndtr(-(amplitude + v) / deviation)
    return Size(
        magnitude=clipped, noise=-clipped * (2 - clipped) * (1 - 1e-9), threshold_follows=False
    )


SATURATION = Effect(
    name="saturation",
    about="clipping at the ADC's full scale",
    stage="record",
    size=size,
    act=act,
    parameters=(
        Parameter(
            path=_FULL_SCALE,
            about="Largest voltage, to either side, that the ADC takes; 0 V for no limit",
            example="1 V",
            limits=("0 V", "1e12 V"),
        ),
    ),
)
