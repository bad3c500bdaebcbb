"""What the amplitudes of a footprint add up to, in tiles that are one point of a smooth plane.

Over a tile's ranges the phases of beamlets turn many times, and their sum may be anything up to
all in phase. At a single point it is known:

    S = |sum_b a_b e^{i phi_b}|,
    phi_b = 2 pi (-f_seg (tau_b - tau_0) + s S_c (tau_b^2 - tau_0^2) / 2 + f_b t),

t the middle of the record, f_b the beat less that of the axis, S_c the chirp rate. Were all lines
on the axis's, bins would have S |W|; as they lie X_b from it, by the mean value theorem bins differ
from that by no more than max |W'| sum_b a_b |X_b|.
"""

from collections.abc import Iterator, Mapping
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from sweep.model import reflectance, waveform
from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.effects.span import Span
from sweep.model.footprint import plane_footprint, velocity_offsets
from sweep.model.preparation import LASER

if TYPE_CHECKING:
    from sweep.model.effects.block import Block

_SHAPE = (
    "target.grazing_angle", LASER + "beam_divergence", "target.radial_velocity",
    "target.transverse_velocity",
)  # fmt: skip
_RANDOM = ("target.roughness", "target.pointing_jitter")
"""What turns beamlets' phases at random."""
_ROUNDING = 1e-15
"""Relative error of a phase."""


class Sum(NamedTuple):
    """Of a footprint's amplitudes over the bare line's, (3, tiles)."""

    in_phase: np.ndarray
    """What they add up to in phase; where powers add, the root of their sum."""
    most: np.ndarray
    """Most that they add up to, whichever of the core's effects are there."""
    lean: np.ndarray
    """sum_b a_b |X_b| [bins], at the most; 0 where powers add."""


@lru_cache(maxsize=2)
def footprint_sum(block: "Block") -> Sum:
    """Sums of the footprints of a block's tiles."""
    ratio, alone = np.maximum(block.echo_ratio.high, 1.0), np.empty((3, block.size))
    alone[:] = ratio if block.architecture == "direct" else np.sqrt(ratio)
    if not block.adds_amplitudes:
        return Sum(alone, alone, np.zeros_like(alone))
    in_phase = alone * block.gain.high
    lean = in_phase * np.fmin(block.spread.extreme, block.fft_size)
    if not _is_told(block) or not (points := _points(block)).any():
        return Sum(in_phase, in_phase, lean)
    most, (known, apart) = in_phase.copy(), _at_points(block, points)
    # without their phases, or a footprint, beamlets add as powers, or are one
    known = np.maximum(known, alone[:, points])
    most[:, points] = np.minimum(most[:, points], known)
    lean[:, points] = np.minimum(lean[:, points], apart)
    return Sum(in_phase, most, lean)


def _is_told(block: "Block") -> bool:
    """Whether the sum of a tile that is one point can be told."""
    if not block.coherent or block.architecture == "direct" or not block.geometry.flat:
        return False
    return block.number > 1 and not block.has(*_RANDOM)


def _points(block: "Block") -> np.ndarray:
    """Tiles that are one point, (tiles,) bool."""
    none = np.zeros(block.size, bool)
    spans = [block[path] for path in _SHAPE]
    spans += [block.range, block.chirp_rate, block.start, block.sample_rate, *block.carriers]
    return none | np.logical_and.reduce(
        np.broadcast_arrays(none, *(np.equal(span.low, span.high) for span in spans))[1:]
    )


def _at_points(block: "Block", points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sums and leans of tiles of one point each, whatever the velocities make of them."""

    def value(span: Span) -> np.ndarray:
        return np.broadcast_to(span.low, points.shape)[points][:, None]

    angle, divergence, along, across = (value(block[path])[:, 0] for path in _SHAPE)
    shape: dict[str, Any] = {
        "beam_divergence": divergence, "number": block.number, "pattern": block.pattern,
    }  # fmt: skip
    offset, cosine, weights = plane_footprint(grazing_angle=angle, **shape)
    law = block.word("target.reflectance_law")
    axis = reflectance.backscatter(law, np.sin(angle))[:, None]
    echo = weights * reflectance.backscatter(law, cosine) / (1 + offset) ** 2 / axis
    amplitude = np.sqrt(echo)
    closing = velocity_offsets(radial=np.where(across == 0, 0.0, along), transverse=across, **shape)
    spread = np.where(weights > 0, 2 * closing / SPEED_OF_LIGHT, 0.0)
    scene = {name: value(span) for name, span in _motion(block)}
    still = np.zeros_like(spread)
    most, lean = np.zeros((2, 3, angle.size))
    for doppler in (still, spread) if np.any(spread) else (still,):
        for s, sign in enumerate(waveform.SIGNS):
            carrier = value(block.carriers[s])
            turns, beat, error = _phases(sign, carrier, offset, doppler, scene)
            found = abs((amplitude * np.exp(2j * np.pi * turns)).sum(axis=1))
            most[s] = np.maximum(most[s], found + (amplitude * error).sum(axis=1))
            apart = (amplitude * abs(beat)).sum(axis=1) / scene["bin"][:, 0]
            lean[s] = np.maximum(lean[s], apart * (1 + abs(scene["beta"][:, 0])))
    # what the receiver's poles make of a beat's difference, in size and in phase
    poles = 2 * np.broadcast_to(block.lines.tilt, (3, block.size))[:, points] * lean
    return most + poles, lean


def _motion(block: "Block") -> Iterator[tuple[str, Span]]:
    """What the phases follow from, by name."""
    yield "range", block.range
    yield "rate", block.chirp_rate
    yield "middle", block.start + 0.5 * block.record_duration
    yield "bin", block.bin_width
    yield "beta", block.beta


def _phases(
    sign: int,
    carrier: np.ndarray,
    offset: np.ndarray,
    doppler: np.ndarray,
    scene: Mapping[str, np.ndarray],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Phases [cycles] of beamlets at the record's middle, beats [Hz], errors of phases [rad]."""
    delay = 2 / SPEED_OF_LIGHT * scene["range"]
    slope = sign * scene["rate"]
    beat = carrier * doppler - slope * delay * (offset + (1 + offset) * doppler)
    parts = (
        -carrier * delay * offset,
        0.5 * slope * delay**2 * offset * (2 + offset),
        beat * scene["middle"],
    )
    # with the Doppler effect a range's beat is stretched
    stretched = abs(scene["beta"] * slope * delay * offset * scene["middle"])
    error = 2 * np.pi * (stretched + _ROUNDING * sum(map(abs, parts)))
    return sum(parts), beat, error
