"""The list of all effects, in the order in which they act."""

from sweep.model.effects import (
    acceleration,
    backscatter,
    chirp_nonlinearity,
    doppler,
    doppler_spread,
    extinction,
    footprint,
    footprint_phase,
    image,
    leakage,
    line_width,
    pointing_jitter,
    quantisation,
    range_walk,
    relative_intensity_noise,
    rotation,
    saturation,
    scintillation,
    several_returns,
    signal_shot_noise,
    solar_background,
    speckle,
)
from sweep.model.effects.effect import Effect, Parameter

EFFECTS: tuple[Effect, ...] = (
    footprint.EFFECT,
    footprint_phase.EFFECT,
    several_returns.EFFECT,
    doppler.EFFECT,
    doppler_spread.EFFECT,
    rotation.EFFECT,
    extinction.EFFECT,
    signal_shot_noise.EFFECT,
    solar_background.EFFECT,
    backscatter.EFFECT,
    relative_intensity_noise.EFFECT,
    quantisation.EFFECT,
    range_walk.EFFECT,
    acceleration.EFFECT,
    chirp_nonlinearity.EFFECT,
    line_width.EFFECT,
    saturation.EFFECT,
    image.EFFECT,
    leakage.EFFECT,
    pointing_jitter.EFFECT,
    speckle.EFFECT,
    scintillation.EFFECT,
)

NAMES = tuple(effect.name for effect in EFFECTS)

PARAMETERS: tuple[Parameter, ...] = tuple(
    parameter for effect in EFFECTS for parameter in effect.parameters
)
"""Fields that effects bring into a spec."""

DEFAULTS = {parameter.path: parameter.default for parameter in PARAMETERS}

CORE = (
    "footprint", "footprint_phase", "several_returns", "doppler", "doppler_spread",
    "signal_shot_noise", "solar_background", "image", "leakage",
)  # fmt: skip
"""Effects that the model's functions simulate if nothing is said: pure lines and their noise."""
