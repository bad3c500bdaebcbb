"""Catalogue of all effects, in the order of their application, and their flags in a store."""

from typing import Any

import numpy as np

from sweep.model import beam, waveform
from sweep.model.detection import looks
from sweep.model.effects import (
    amplifier,
    atmosphere,
    circulator_leak,
    doppler,
    footprint,
    image_and_leakage,
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
    speckle,
)
from sweep.model.effects.effect import Effect, Parameter
from sweep.model.shot_settings import RECORD_TYPE_PATH

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
    image_and_leakage.IMAGE,
    image_and_leakage.LEAKAGE,
    speckle.FADING,
    pointing_jitter.POINTING_JITTER,
    speckle.SPECKLE,
    scintillation.SCINTILLATION,
)
"""All effects, in the order in which they are applied to shots. Effect number i is bit i of the
flags in a store."""

EFFECT_NAMES = tuple(effect.name for effect in EFFECTS)
"""Names of all effects, in the order in which they are applied to shots."""

EFFECT_PARAMETERS: tuple[Parameter, ...] = tuple(
    parameter for effect in EFFECTS for parameter in effect.parameters
)
"""All fields that effects add to a spec, effect by effect."""

EFFECT_CATEGORY_KEY_PATHS = tuple(
    parameter.path for parameter in EFFECT_PARAMETERS if parameter.is_category_key
)
"""Dotted paths of the effects' numeric parameters that must be equal in all points that are
computed together."""

PARAMETER_DEFAULTS: dict[str, float | int | str | np.ndarray] = (
    beam.BEAM_DEFAULTS
    | waveform.WAVEFORM_DEFAULTS
    | looks.LOOKS_DEFAULTS
    | {RECORD_TYPE_PATH: "real"}
    | {parameter.path: parameter.default for parameter in EFFECT_PARAMETERS}
)
"""Default values of parameters of beam, waveform, looks, record and effects, by dotted path."""

DEFAULT_EFFECTS = (
    "footprint", "footprint_phase", "several_returns", "doppler", "doppler_spread",
    "signal_shot_noise", "solar_background", "image", "leakage",
)  # fmt: skip
"""Names of the effects that the model's functions simulate by default. Together they make
ideal lines and the lines' noise."""

SEPARATE_BATCHES_MASK = np.uint32(
    sum(1 << k for k, effect in enumerate(EFFECTS) if effect.needs_separate_batches)
)
"""Bit mask of the effects that need separate batches (bit i for effect number i). Points with such
an effect and points without it are computed separately."""


def pack_effect_flags(is_kept: np.ndarray) -> np.ndarray:
    """Return the bit masks (m,) uint32 of the effects that are kept at m points or tiles.

    ``is_kept`` (effects, m) is True for kept effects, in the order of EFFECTS. Effect number i has
    bit i.
    """
    flag_masks = np.uint32(1) << np.arange(is_kept.shape[0], dtype=np.uint32)
    return np.bitwise_or.reduce(np.where(is_kept, flag_masks[:, None], np.uint32(0)), axis=0)


def effect_names_in_flags(flags: int) -> tuple[str, ...]:
    """Return the names of the effects whose bits are set in a mask of :func:`pack_effect_flags`."""
    return tuple(name for k, name in enumerate(EFFECT_NAMES) if flags >> k & 1)


def effect_flag_attributes() -> dict[str, Any]:
    """Return the attributes of a store's variable of effect flags, which name the flags' bits.

    The attributes follow the CF conventions.
    """
    return {
        "units": "1",
        "long_name": "effects that were simulated",
        "flag_masks": [1 << k for k in range(len(EFFECT_NAMES))],
        "flag_meanings": " ".join(EFFECT_NAMES),
    }
