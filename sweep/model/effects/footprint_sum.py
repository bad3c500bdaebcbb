"""What the amplitudes of a footprint add up to, in tiles that are one point of a smooth plane.

Over a tile's ranges the phases of beamlets turn many times, and their sum may be anything up to
all in phase. At a single point it is known:

    S = |sum_b a_b e^{i phi_b}|,
    phi_b = 2 pi (-f_seg (tau_b - tau_0) + s S_c (tau_b^2 - tau_0^2) / 2 + f_b t),

t the middle of the record, f_b the beat less that of the axis, S_c the chirp rate. Were all lines
on the axis's, bins would have S |W|; as they lie X_b from it, by the mean value theorem bins differ
from that by no more than max |W'| sum_b a_b |X_b|.
"""

import math
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numba import njit

from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.effects.columns import columns
from sweep.model.elementary import sincos_cycles
from sweep.model.footprint import beamlets
from sweep.model.preparation import LASER
from sweep.model.reflectance import LAWS, backscatter_of

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
    start, duration = block.start, block.record_duration
    spans = [block[path] for path in _SHAPE]
    spans += [block.range, block.chirp_rate, start + 0.5 * duration, block.bin_width, block.beta]
    values = [span.low for span in (*spans, *block.carriers)]
    table, _ = columns(
        np.zeros(block.size), *values, *np.broadcast_to(block.lines.tilt, (3, block.size))
    )
    found = np.empty((2, 3, int(points.sum())))
    law = LAWS.index(block.word("target.reflectance_law"))
    (across, along), share = beamlets(block.number, block.pattern)
    put_at_points(table[1:, points], (across, along, share), law, found)
    return found[0], found[1]


@njit(cache=True, error_model="numpy")
def put_at_points(table, beam, law, out):
    """Sums of amplitudes and leans of points on smooth planes, (2, 3, n).

    Each the larger of those with the beamlets' own velocities and without.

    Parameters
    ----------
    table : (15, n) float64
        Grazing angle, divergence [rad], radial and transverse velocity [m/s], range [m], chirp
        rate [Hz/s], middle of the record [s], width of a bin [Hz], Doppler ratio; carriers [Hz]
        and tilts of the three segments.
    beam : tuple of (beamlets,) ndarray
        Angles across the slope and along it in standard deviations, power fractions.
    law : int
        Place of the reflectance law in :data:`sweep.model.reflectance.LAWS`.
    """
    rays, terms = np.empty((3, beam[2].size)), np.empty((4, beam[2].size))
    for i in range(table.shape[1]):
        point = table[:, i]
        out[:, :, i] = 0.0
        for moving in range(2 if point[2] != 0.0 or point[3] != 0.0 else 1):
            _put_rays(point, beam, law, moving == 1, rays)
            for s in range(3):
                _put_terms(1.0 - s, point, point[9 + s], rays, terms)
                real, imaginary, unsure, apart = _sums(terms)
                out[0, s, i] = np.maximum(out[0, s, i], np.hypot(real, imaginary) + unsure)
                lean = apart / point[7] * (1 + abs(point[8]))
                out[1, s, i] = np.maximum(out[1, s, i], lean)
        for s in range(3):
            # what the receiver's poles make of a beat's difference, in size and in phase
            out[0, s, i] += 2 * point[12 + s] * out[1, s, i]


@njit(cache=True, error_model="numpy")
def _put_rays(point, beam, law, moving, out):
    """Amplitudes, (R_b - R_0) / R_0 and Doppler ratios of beamlets, 0 over the horizon."""
    angle, divergence, closing, sideways = point[0], point[1], point[2], point[3]
    (across, along, share), sigma = beam, divergence / 4
    sine, cosine = np.sin(angle), np.cos(angle)
    axis = backscatter_of(law, sine)
    for b in range(share.size):
        x, y = across[b] * sigma, along[b] * sigma
        square = x * x + y * y
        stretch = square / (1 + np.sqrt(1 + square))  # |d| - 1
        height = sine + y * cosine
        hits = height > 0
        over = height if hits else 1.0
        offset = (stretch * sine - y * cosine) / over
        echo = share[b] * backscatter_of(law, over / (1 + stretch)) / ((1 + offset) * (1 + offset))
        speed = (sideways * y - closing * stretch) / (1 + stretch) if moving else 0.0
        out[0, b] = np.sqrt(echo / axis) if hits else 0.0
        out[1, b] = offset if hits else 0.0
        out[2, b] = 2 * speed / SPEED_OF_LIGHT if hits else 0.0


@njit(cache=True, error_model="numpy")
def _put_terms(sign, point, carrier, rays, out):
    """Beamlets' parts of the sum, what they may be off by, and sizes of their beats [Hz].

    By phases [cycles] at the record's middle.
    """
    delay, slope, middle = 2 / SPEED_OF_LIGHT * point[4], sign * point[5], point[6]
    stretch = abs(point[8] * slope * delay * middle)
    for b in range(rays.shape[1]):
        amplitude, offset, doppler = rays[0, b], rays[1, b], rays[2, b]
        beat = carrier * doppler - slope * delay * (offset + (1 + offset) * doppler)
        far = -carrier * delay * offset
        bent = 0.5 * slope * delay * delay * offset * (2 + offset)
        turned = beat * middle
        sine, cosine = sincos_cycles(far + bent + turned)
        out[0, b], out[1, b] = amplitude * cosine, amplitude * sine
        # with the Doppler effect a range's beat is stretched
        unsure = stretch * abs(offset) + _ROUNDING * (abs(far) + abs(bent) + abs(turned))
        out[2, b], out[3, b] = amplitude * (2 * math.pi * unsure), amplitude * abs(beat)


@njit(cache=True, error_model="numpy")
def _sums(terms):
    """Sums of four rows, in order."""
    a, b, c, d = 0.0, 0.0, 0.0, 0.0
    for k in range(terms.shape[1]):
        a, b, c, d = a + terms[0, k], b + terms[1, k], c + terms[2, k], d + terms[3, k]
    return a, b, c, d
