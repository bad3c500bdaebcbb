"""Imbalance of I and Q: a complex record shows an image of each line at its negative frequency.

I and Q are the two quadratures of a complex record. The ratio of their amplitudes is g, and the
departure of their phase from 90 degrees is p. With I = cos(w t) and Q = g sin(w t + p), the record
is

    I + i Q = (1 + g e^(i p)) / 2 e^(i w t) + (1 - g e^(-i p)) / 2 e^(-i w t),

so the image has |1 - g e^(i p)| / |1 + g e^(i p)| of the line's amplitude. The change of the line's
own gain applies to noise as well and is neglected. The effect acts on the lines: each has a second
one.

References
----------
docs/physics.md, *Complex records*, has the image in figures. The equation follows from I and Q by
Euler's formula.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from sweep.model.effects.effect import Effect, EffectContext, Parameter
from sweep.model.effects.error_bounds import ErrorBound
from sweep.model.effects.planner_inputs import PlannerInputs
from sweep.model.effects.requirements import ParameterRequirement, condition_equal_to
from sweep.model.link_budget import RECEIVER_PREFIX
from sweep.model.preparation import Shots
from sweep.model.shot_settings import RECORD_TYPE_PATH

GAIN_IMBALANCE_PATH, PHASE_IMBALANCE_PATH = (
    RECEIVER_PREFIX + "iq_gain_imbalance",
    RECEIVER_PREFIX + "iq_phase_imbalance",
)


def image_gain(*, gain: ArrayLike, phase: ArrayLike) -> np.ndarray:
    """Return the amplitude of the image over that of the line.

    Parameters
    ----------
    gain : array_like
        Power of Q over power of I, the square of their ratio g of amplitudes.
    phase : array_like
        Departure p of the phase between I and Q from 90 degrees [rad].

    Returns
    -------
    ndarray
        Ratio of amplitudes, 0..1, in the shape to which the arguments broadcast.

    Notes
    -----
    The ratio is |1 - g e^(i p)| / |1 + g e^(i p)|.

    Examples
    --------
    >>> leak = image_gain(gain=10**0.05, phase=0.0523598776)  # 0.5 dB and 3 deg
    >>> round(float(20 * np.log10(leak)), 1)
    -28.2
    """
    quadrature_phasor = np.sqrt(np.asarray(gain, float)) * np.exp(1j * np.asarray(phase, float))
    return np.asarray(np.abs(1 - quadrature_phasor) / np.abs(1 + quadrature_phasor))


def error_bound(points: PlannerInputs) -> ErrorBound | None:
    """Return a magnitude change of 1 where I and Q are unequal, 0 elsewhere; None if all are equal.

    A change of 1 keeps the effect, because the image of a line may be a peak of its own.
    """
    image_amplitude = image_gain(
        gain=points[GAIN_IMBALANCE_PATH], phase=points[PHASE_IMBALANCE_PATH]
    )
    return (
        ErrorBound(magnitude_change=np.where(image_amplitude > 0, 1.0, 0.0))
        if np.any(image_amplitude > 0)
        else None
    )


def apply(shots: Shots, context: EffectContext) -> Shots:
    """Add images of the lines at their negative frequencies, if the record is complex.

    Parameters
    ----------
    shots : Shots
        Prepared shots of n points (:class:`sweep.model.preparation.Shots`).
    context : EffectContext
        Power ratio of Q and I, and departure of their phase from 90 degrees [rad]
        (:class:`sweep.model.effects.effect.EffectContext`).

    Returns
    -------
    Shots
        Shots with the amplitude of images relative to their lines, 0..1, or unchanged if the record
        is real.

    Notes
    -----
    The image has |1 - g e^(i p)| / |1 + g e^(i p)| of the line's amplitude, with the ratio g of the
    amplitudes of Q and I, and the departure p of their phase from 90 degrees (:func:`image_gain`).
    """
    if not shots.complex_record:
        return shots
    image_amplitude = image_gain(
        gain=context.parameters[GAIN_IMBALANCE_PATH], phase=context.parameters[PHASE_IMBALANCE_PATH]
    )
    return replace(shots, line_images=shots.line_images._replace(iq_image_gain=image_amplitude))


_COMPLEX_RECORD_REQUIREMENT = ParameterRequirement(
    RECORD_TYPE_PATH,
    condition_equal_to("real"),
    "is one of I and Q, and the record is real",
    "set instrument.receiver.record: complex",
)


IQ_IMBALANCE = Effect(
    name="iq_imbalance",
    description="unequal I and Q: images at negative frequencies in a complex record",
    stage="record",
    error_bound=error_bound,
    apply=apply,
    parameters=(
        Parameter(
            path=GAIN_IMBALANCE_PATH,
            description="Gain of Q over that of I, of a record that is complex",
            default=1.0,
            example="0.5 dB",
            limits=("-60 dB", "60 dB"),
            requirements=(_COMPLEX_RECORD_REQUIREMENT,),
        ),
        Parameter(
            path=PHASE_IMBALANCE_PATH,
            description="Departure from 90 deg between I and Q, of a record that is complex",
            example="3 deg",
            limits=("-90 deg", "90 deg"),
            si_unit="rad",
            requirements=(_COMPLEX_RECORD_REQUIREMENT,),
        ),
    ),
)
"""Effect that adds images of lines at negative frequencies, due to unequal I and Q channels."""
