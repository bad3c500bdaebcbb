"""Imbalance of I and Q: a complex record shows each line's image at the negative frequency.

With I = cos(w t) and Q = g sin(w t + p), the record is

    I + i Q = (1 + g e^(i p)) / 2 e^(i w t) + (1 - g e^(-i p)) / 2 e^(-i w t),

so that the image's amplitude is |1 - g e^(i p)| / |1 + g e^(i p)| of the line's; what is lost of
the line itself is its gain's, and noise has it too. It acts on the lines: each has a second one.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from sweep.model.effects.effect import Effect, EffectContext, ErrorBound, Parameter
from sweep.model.effects.planner_inputs import PlannerInputs
from sweep.model.preparation import RECEIVER_PREFIX, Shots

GAIN_IMBALANCE_PATH, PHASE_IMBALANCE_PATH = (
    RECEIVER_PREFIX + "iq_gain_imbalance",
    RECEIVER_PREFIX + "iq_phase_imbalance",
)


def image_gain(*, gain: ArrayLike, phase: ArrayLike) -> np.ndarray:
    """Amplitude of the image over the line's, 0..1.

    By the power of Q over that of I, and their phase's departure from 90 degrees [rad].

    >>> leak = image_gain(gain=10**0.05, phase=0.0523598776)  # 0.5 dB and 3 deg
    >>> round(float(20 * np.log10(leak)), 1)
    -28.2
    """
    quadrature_phasor = np.sqrt(np.asarray(gain, float)) * np.exp(1j * np.asarray(phase, float))
    return np.asarray(np.abs(1 - quadrature_phasor) / np.abs(1 + quadrature_phasor))


def error_bound(points: PlannerInputs) -> ErrorBound | None:
    """Anything, where there is an image: it may be a peak of its own."""
    image_amplitude = image_gain(
        gain=points[GAIN_IMBALANCE_PATH], phase=points[PHASE_IMBALANCE_PATH]
    )
    return (
        ErrorBound(magnitude_change=np.where(image_amplitude > 0, 1.0, 0.0))
        if np.any(image_amplitude > 0)
        else None
    )


def apply(shots: Shots, context: EffectContext) -> Shots:
    """Images of the lines, where the record is complex."""
    if not shots.complex_record:
        return shots
    image_amplitude = image_gain(
        gain=context.parameters[GAIN_IMBALANCE_PATH], phase=context.parameters[PHASE_IMBALANCE_PATH]
    )
    return replace(shots, image_gain=image_amplitude)


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
        ),
        Parameter(
            path=PHASE_IMBALANCE_PATH,
            description="Departure from 90 deg between I and Q, of a record that is complex",
            example="3 deg",
            limits=("-90 deg", "90 deg"),
            si_unit="rad",
        ),
    ),
)
