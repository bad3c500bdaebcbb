"""Scenes over the whole reachable range, as points and as tiles around them, and the measure."""

import numpy as np

from sweep.model.chain import prepare
from sweep.model.effects import leakage
from sweep.model.effects.block import Block
from sweep.model.effects.catalogue import CORE, DEFAULTS, EFFECTS
from sweep.model.effects.change import Change
from sweep.model.effects.probability_bounds import within_changes
from sweep.model.effects.span import Span
from sweep.model.shot import find

SIZES = (2**12, 2**13, 2**14, 2**15, 2**16, 2**17, 2**18)
CLOSED = ("hamming", "hann", "rectangular", "flattop")
WINDOWS = (*CLOSED, "kaiser(8.6)")

ACROSS = "target.transverse_velocity"
WIDENED = {
    "target.range": 0.3, "target.grazing_angle": 0.1, "instrument.laser.beam_divergence": 0.1,
    "target.radial_velocity": 0.3, "instrument.laser.power": 0.3, "instrument.processing.tnr": 0.1,
    ACROSS: 0.3,
}  # fmt: skip
"""Parameters that tiles extend over, and how far at the most, relatively."""


def scene(table, number, seed, **fixed):
    """Random points of one category: parameters by path."""
    rng = np.random.default_rng((71, seed))
    values = {
        "range": 10 ** rng.uniform(0, 4, number),
        "grazing_angle": np.radians(rng.choice([1, 90], number) * 1.0),
        "beam_divergence": 10 ** rng.uniform(-5, np.log10(2e-3), number),
        "radial_velocity": rng.choice([-1, 1], number) * 10 ** rng.uniform(-3, 3, number),
        "power": 10 ** rng.uniform(-4, 1, number),
        "tnr": rng.uniform(2, 12, number),
        "fft_size": int(rng.choice(SIZES)),
        "window": str(rng.choice(WINDOWS)),
        "reflectance_law": str(rng.choice(["thesis", "lambert", "lommel_seeliger"])),
        "phases": "incoherent",
        "beamlets": int(rng.choice([3, 7, 19, 61, 109])),
        "duration": float(rng.choice([500e-6, 200e-6])),
    }
    across = 10 ** rng.uniform(-1, 3, number)
    slanted = rng.random(number) < 0.8
    values["grazing_angle"] = np.where(
        slanted, np.radians(rng.uniform(1, 90, number)), values["grazing_angle"]
    )
    across = fixed.pop("across", across)
    return DEFAULTS | table(**values | fixed) | {ACROSS: across}


def small(seed):
    """Sizes that many spectra can be had of."""
    return 2 ** int(np.random.default_rng(seed).integers(12, 16))


def point_block(parameters):
    """Every point a tile of its own."""
    return Block.of_plane(
        {
            path: str(value) if np.asarray(value).dtype.kind in "UO" else Span.of(value)
            for path, value in (DEFAULTS | dict(parameters)).items()
        }
    )


def tile_block(parameters, seed):
    """Tiles that hold the points, each as wide as chance has it, and points from within."""
    rng = np.random.default_rng((72, seed))
    spans, inner = {}, dict(parameters)
    number = max(np.size(value) for value in parameters.values())
    wide = 10 ** rng.uniform(-7, 0, number)
    for path, value in (DEFAULTS | dict(parameters)).items():
        if path not in WIDENED:
            words = np.asarray(value).dtype.kind in "UO"
            spans[path] = str(value) if words else Span.of(value)
            continue
        middle = np.broadcast_to(np.asarray(value, float), (number,))
        reach = abs(middle) * WIDENED[path] * wide * rng.choice([0, 1], number, p=[0.3, 0.7])
        below, above = rng.random((2, number)) * reach
        low, high = middle - below, middle + above
        if path == "target.grazing_angle":
            high = np.minimum(high, np.pi / 2)
            low = np.minimum(low, high)
        spans[path] = Span(low, high)
        place = rng.random(number)
        place = np.where(rng.random(number) < 0.3, np.rint(place), place)
        inner[path] = np.clip(low + place * (high - low), low, high)
    return Block.of_plane(spans), inner


def shots_of(parameters, effects):
    """Shots of points of one category."""
    ((_, shots),) = prepare(parameters, effects)
    return shots


def found(parameters, effects):
    """What the spectra of the points hold, :func:`sweep.model.shot.find`."""
    return find(shots_of(parameters, effects))


def magnitudes(parameters, effects):
    """Largest bin's |X| of each segment, (3, n)."""
    return found(parameters, effects)[:, 2]


def leakage_bound(block):
    """Bound on what leaks, (3, tiles), whichever of the core's effects are there."""
    asked = (effect.bound(block) for effect in EFFECTS if effect.name in CORE)
    changes = [bound for bound in asked if isinstance(bound, Change)]
    amplitude, threshold = within_changes(
        changes, amplitude=block.amplitude, threshold=block.threshold
    )
    return leakage.bound(block).change(amplitude, threshold)


ROUNDING = 1e-9
"""Of a magnitude: the spectrum's own 1e-12, and the phase of lines 1e8 wavelengths away."""


def held(change, with_effect, without):
    """Whether the true factor lies within the interval, and interval / change in logs."""
    low, high = (np.broadcast_to(end, without.shape) for end in change.signal)
    factor = with_effect / without
    inside = (factor >= low * (1 - ROUNDING)) & (factor <= high * (1 + ROUNDING))
    with np.errstate(divide="ignore"):
        length = np.log(high) - np.log(low)
        moved = abs(np.log(factor))
    noticed = moved > 1e-7
    return inside, (length[noticed] / moved[noticed])
