"""All effects, in the order in which they act, and the flags that stand for them in a store."""

from typing import Any

import numpy as np

from sweep.model import beam, looks, waveform
from sweep.model.effects import (
    amplifier,
    atmosphere,
    circulator_leak,
    doppler,
    footprint,
    iq_imbalance,
    lag,
    line_width,
    noise_sources,
    overlap,
    phase_errors,
    pointing_jitter,
    saturation,
    scintillation,
    segment_motion,
    sidelobes,
    speckle,
)
from sweep.model.effects.effect import Effect, Parameter
from sweep.model.preparation import RECORD

EFFECTS: tuple[Effect, ...] = (
    footprint.FOOTPRINT,
    footprint.FOOTPRINT_PHASE,
    footprint.SEVERAL_RETURNS,
    doppler.DOPPLER,
    doppler.DOPPLER_SPREAD,
    doppler.ROTATION,
    segment_motion.SEGMENT_MOTION,
    lag.LAG,
    atmosphere.EXTINCTION,
    noise_sources.SIGNAL_SHOT_NOISE,
    noise_sources.SOLAR_BACKGROUND,
    atmosphere.BACKSCATTER,
    noise_sources.RELATIVE_INTENSITY_NOISE,
    amplifier.SPONTANEOUS_EMISSION,
    circulator_leak.CIRCULATOR_LEAK,
    noise_sources.QUANTISATION,
    overlap.OVERLAP,
    phase_errors.RANGE_WALK,
    phase_errors.ACCELERATION,
    phase_errors.CHIRP_NONLINEARITY,
    line_width.LINE_WIDTH,
    saturation.SATURATION,
    iq_imbalance.IQ_IMBALANCE,
    sidelobes.IMAGE,
    sidelobes.LEAKAGE,
    speckle.FADING,
    pointing_jitter.POINTING_JITTER,
    speckle.SPECKLE,
    scintillation.SCINTILLATION,
)

NAMES = tuple(effect.name for effect in EFFECTS)

PARAMETERS: tuple[Parameter, ...] = tuple(
    parameter for effect in EFFECTS for parameter in effect.parameters
)
"""Fields that effects bring into a spec."""

SHARED = tuple(parameter.path for parameter in PARAMETERS if parameter.category)
"""Numbers of effects that points must share to be prepared together."""

DEFAULTS: dict[str, float | int | str | np.ndarray] = (
    beam.DEFAULTS
    | waveform.DEFAULTS
    | looks.DEFAULTS
    | {RECORD: "real"}
    | {parameter.path: parameter.default for parameter in PARAMETERS}
)
"""Of the beams' parameters, the waveform's, the looks', the record's and the effects'."""

CORE = (
    "footprint", "footprint_phase", "several_returns", "doppler", "doppler_spread",
    "signal_shot_noise", "solar_background", "image", "leakage",
)  # fmt: skip
"""Effects that the model's functions simulate if nothing is said: pure lines and their noise."""

FLAGS_APART = np.uint32(sum(1 << k for k, effect in enumerate(EFFECTS) if effect.apart))
"""Flags of effects that points with and without them are computed apart by."""


def flags_of(kept: np.ndarray) -> np.ndarray:
    """Pack effects that are kept, (effects, m) bool in the catalogue's order, as (m,) uint32."""
    masks = np.uint32(1) << np.arange(kept.shape[0], dtype=np.uint32)
    return np.bitwise_or.reduce(np.where(kept, masks[:, None], np.uint32(0)), axis=0)


def names_of(flags: int) -> tuple[str, ...]:
    """Names of the effects that flags stand for."""
    return tuple(name for k, name in enumerate(NAMES) if flags >> k & 1)


def flag_attributes() -> dict[str, Any]:
    """Meaning of the flags in the words of the CF conventions."""
    return {
        "units": "1",
        "long_name": "effects that were simulated",
        "flag_masks": [1 << k for k in range(len(NAMES))],
        "flag_meanings": " ".join(NAMES),
    }
