"""Error of too few rays: the change that more rays might make to probabilities and peaks.

If powers add, the power of the bin that is detected is a mean over the beam, P = sum_b w_b g_b; g_b
is its power if all light went where beamlet b goes. A hexagonal lattice of whole shells is exact
for everything odd about the beam's axis and for squares of the places, and nearly exact for smooth
ground. So g is made even, and its best polynomial is subtracted, of the second degree for few rays
and the fourth for more. The rest tells how rough the ground is between the beamlets: the share of
the beam about each beamlet is taken to be off by as much as it differs from its neighbours, each
independently,

    (dP)^2 = sum w_a w_b (r_a - r_b)^2    over the pairs of neighbours.

The lattice ends at a radius, and is stretched so that squares stay exact: its weights w_b are not
the beam's density about the beamlets, u_b. With what lies beyond taken from the outermost shell,
the power changes by

    sum (u_b - w_b) g_b + (1 - sum u_b) mean of g in the outermost shell,

0.5 % for 19 rays whose lines fill some bins, and less for more, whose lattices are wider. Its size
is added to dP.

Like the error itself dP falls about as one over the number of rays. It knows nothing of what no ray
has hit, and takes smooth ground for rougher than it is, for 19 rays most of all. It was checked on
shots off by more than 1e-6, powers adding, against 8,017 or 16,021 rays: 1,000 of each of scan
pattern comparison, gale crater descent, forest scan and square high descent. It is below half of
the error for one in a thousand of the forest's shots, whatever the number of rays, and for no
others. Its median is 7 to 60 times the error for 19 rays, 2 to 10 from 61 on.
"""

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from sweep.kernel_cache import njit
from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.footprint import beamlets, lattice_radius
from sweep.model.ground import Footprints
from sweep.model.preparation import Shots
from sweep.model.window import samples

_SIGNS = 1.0, 0.0, -1.0
"""Of the segments' chirps."""

_REACH, _STEPS, _SAMPLES = 4, 1024, 1024
"""Bins of fs/L up to which a line's power is known, steps of each, samples of the window."""

_NEIGHBOURS = 1.3
"""Largest distance between neighbours, over the nearest; the next but one are 1.7 away."""

_QUARTIC = 37
"""Rays from which on the polynomials are of the fourth degree, and leave enough to tell from."""

_FAR = 15.0
"""Standard deviations from the threshold at which nothing changes: e^-112."""

_NOTHING = 1e-9
"""Change of a probability that is not looked for."""


class Rule(NamedTuple):
    """A lattice of whole shells folded about its middle: h places, each with the one opposite."""

    first: np.ndarray
    """(h,) int64: beamlet."""
    second: np.ndarray
    """(h,) int64: the one opposite; the middle is its own."""
    per_share: np.ndarray
    """(h,): 1 over the power fraction of the two."""
    smooth: np.ndarray
    """(k, h): even polynomials of the places, orthonormal by the power fractions."""
    weighted: np.ndarray
    """(k, h): these times the power fractions."""
    density: np.ndarray
    """(h,): change of the mean power per power of the two, by the beam's density about them."""
    pairs: np.ndarray
    """(m, 2) int64: places that are neighbours."""
    pair_weight: np.ndarray
    """(m,): sum of the products of their beamlets' power fractions, made larger for what the
    polynomials have taken of the roughness too: k of h."""


def ray_error(
    shots: Shots, footprints: Footprints, bins: np.ndarray, magnitude: np.ndarray
) -> np.ndarray:
    """Change that more rays may make, (n,), 0..1.

    The larger of two errors: that of the probabilities of detection, summed over the segments, and
    that of a peak's magnitude relative to itself, or to sigma where that is larger.

    Powers of the shots add. The footprints are what their rays have hit, a hexagonal lattice of
    whole shells, all of it even where the effect of its spread on the lines is left out. `bins` and
    `magnitude` (n, 3) are each segment's peak, -1 or nan for none, and |X| there.
    """
    threshold, deviation = shots.threshold, shots.line_deviation
    change, largest = np.zeros((2, shots.size))
    rule = folded(footprints.echo.shape[1])
    for s in range(3):
        there = bins[:, s] >= 0 if shots.segments[s] else np.zeros(shots.size, bool)
        a, b = magnitude[:, s] / deviation, np.broadcast_to(threshold / deviation, shots.size)
        a, b = a * shots.looks.sharper, shots.looks.scaled(b)
        # The down-chirp's lines lie as those of the up-chirp, and Doppler's closer together,
        # which makes them smoother: one magnitude tells of all.
        tells = there if s == 0 else there & ~(bins[:, 0] >= 0)
        matters = (tells & (_in_magnitude(a, 1.0) >= _NOTHING)) | (_change(a, b, 1.0) >= _NOTHING)
        some = np.flatnonzero(there & matters)
        relative = np.empty(some.size)
        _roughness(_in_bin(shots, footprints, s, some, bins[some, s]), rule, relative)
        change[some] += _change(a[some], b[some], relative)
        largest[some] = np.maximum(
            largest[some], np.where(tells[some], _in_magnitude(a[some], relative), 0.0)
        )
    return np.minimum(np.maximum(change, largest), 1.0)


def _change(a: np.ndarray, b: np.ndarray, relative: np.ndarray | float) -> np.ndarray:
    """Most that Q_1(a, b) changes as a's square changes by a share of itself.

    dQ_1/d ln a <= sqrt(a b / (2 pi)) exp(-(a - b)^2 / 2), at the nearest to b that a comes.
    """
    away = np.maximum(np.abs(a - b) - 0.5 * relative * a, 0.0)
    most = 0.5 * relative * np.sqrt(a * b / (2 * math.pi)) * np.exp(-0.5 * away**2)
    return np.where(away > _FAR, 0.0, np.minimum(most, 1.0))


def _in_magnitude(a: np.ndarray, relative: np.ndarray | float) -> np.ndarray:
    """Change of a over itself, or 1 if that is larger, as its square changes by a share."""
    return np.asarray(0.5 * relative * np.minimum(a, 1.0))


def _in_bin(
    shots: Shots, footprints: Footprints, s: int, some: np.ndarray, k: np.ndarray
) -> np.ndarray:
    """Powers, in one scale, that bins k (m,) of a segment have of some shots' lines, (m, b)."""
    segment = shots.waveform[s]
    columns = (
        shots.range - segment.nearer, segment.beta, shots.chirp_rate, shots.sample_rate,
        segment.carrier, shots.detector_bandwidth, shots.amplifier_bandwidth,
    )  # fmt: skip
    far, beta, rate, sample_rate, carrier, detector, amplifier = (
        np.broadcast_to(column, shots.size)[some, None] for column in columns
    )
    row = footprints.row[some]
    offset, doppler = footprints.offset[row], footprints.doppler[row]
    # to the bin's precision: phases, which need far more, are none of a power's
    metres = far * (1 + offset)
    beat = carrier * (beta + doppler)
    beat -= _SIGNS[s] * rate * (2 / SPEED_OF_LIGHT) * metres * (1 + beta + doppler)
    size = shots.fft_size
    place = beat * (size / sample_rate)
    axis = carrier * beta - _SIGNS[s] * rate * (2 / SPEED_OF_LIGHT) * far * (1 + beta)
    axis = axis * (size / sample_rate)
    turns = np.floor(axis / size + 0.5) * size
    place = np.abs(np.where(axis < turns, -1.0, 1.0) * (place - turns) - k[:, None])
    lobe = _lobe(shots.window.name)
    place *= shots.window.length / size * _STEPS
    low = np.minimum(place, lobe.size - 2.0).astype(np.int64)
    part = np.minimum(place - low, 1.0)
    power = footprints.echo[row] * (lobe[low] + (lobe[low + 1] - lobe[low]) * part)
    p, q = 1 - beat * beat / (detector * amplifier), beat * (1 / detector + 1 / amplifier)
    return np.asarray(power / (p * p + q * q))


@lru_cache(maxsize=16)
def folded(number: int) -> Rule:
    """Fold the lattice of ``number`` beamlets, whole shells of them."""
    from scipy.spatial import cKDTree  # which takes longer to import than all else

    offsets, weight = beamlets(number)
    places = offsets.T
    tree = cKDTree(places)
    reach = _NEIGHBOURS * tree.query(places[0], 2)[0][1]
    opposite = tree.query(-places)[1]
    first = np.flatnonzero(np.arange(number) <= opposite)
    place = np.empty(number, np.int64)
    place[first] = place[opposite[first]] = np.arange(first.size)
    share = np.where(opposite[first] == first, 1.0, 2.0) * weight[first]
    near = tree.query_pairs(reach, output_type="ndarray")
    near = near[np.lexsort(near.T)]  # whatever order the tree has them in
    both = np.sort(place[near], axis=1)
    key, which = np.unique(both[:, 0] * number + both[:, 1], return_inverse=True)
    pairs = np.stack([key // number, key % number], axis=1)
    product: np.ndarray = np.bincount(which.ravel(), weight[near[:, 0]] * weight[near[:, 1]])
    smooth = _smooth(offsets[:, first], share, 4 if number >= _QUARTIC else 2)
    product = product * (first.size / (first.size - len(smooth)))
    density = _density_change(offsets, weight)[first] / weight[first]
    return Rule(first, opposite[first], 1 / share, smooth, share * smooth, density, pairs, product)


def _density_change(offsets: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Return the beam's power in each beamlet's cell less its weight, (number,); sums to 0.

    ``offsets`` (2, number) are in standard deviations of the beam; ``weight`` (number,) sums to 1.
    The beam is Gaussian, and cells have equal areas. Beamlets at the largest radius
    share the power outside of all cells.
    """
    squared = (offsets**2).sum(axis=0)
    # Weights are exp(-r^2 / 2) at the radius r before the lattice was stretched.
    middle = int(np.argmin(squared))
    stretch = squared.max() / (-2 * np.log(weight.min() / weight[middle]))
    cell = stretch * lattice_radius(weight.size) ** 2 / (2 * weight.size)  # over 2 pi
    power = cell * np.exp(-0.5 * squared)
    outermost = squared > squared.max() * (1 - 1e-9)
    power[outermost] += (1 - power.sum()) / np.count_nonzero(outermost)
    return np.asarray(power - weight)


def _smooth(offsets: np.ndarray, share: np.ndarray, degree: int) -> np.ndarray:
    """Even polynomials up to a degree, orthonormal, (k, h)."""
    x, y = offsets
    powers = [(total - k, k) for total in range(0, degree + 1, 2) for k in range(total + 1)]
    root = np.sqrt(share)
    orthogonal, _ = np.linalg.qr(np.stack([root * x**i * y**k for i, k in powers], axis=1))
    return np.ascontiguousarray(orthogonal.T / root)


@lru_cache(maxsize=32)
def _lobe(window_name: str) -> np.ndarray:
    """|W(y)|^2 over its peak's at even steps of y >= 0, of the length that makes no difference."""
    w = samples(window_name, _SAMPLES)
    transform = np.abs(np.fft.rfft(w, _SAMPLES * _STEPS)[: _REACH * _STEPS + 1])
    transform[-1] = 0.0  # and nothing beyond
    return np.asarray((transform / w.sum()) ** 2)


@njit(cache=True, nogil=True, error_model="numpy")
def _roughness(power, rule, out):
    """Errors (m,) of sums of powers (m, b), over the sums, no more than 1: see the module."""
    first, second, per_share, smooth, weighted, density, pairs, pair_weight = rule
    rest = np.empty(first.size)
    for i in range(out.size):
        whole = bias = 0.0
        for f in range(first.size):
            both = power[i, first[f]]
            if second[f] != first[f]:
                both += power[i, second[f]]
            whole += both
            bias += density[f] * both
            rest[f] = both * per_share[f]
        for j in range(smooth.shape[0]):  # orthonormal: one after the other is all at once
            part = 0.0
            for f in range(first.size):
                part += weighted[j, f] * rest[f]
            for f in range(first.size):
                rest[f] -= part * smooth[j, f]
        total = 0.0
        for k in range(pair_weight.size):
            apart = rest[pairs[k, 0]] - rest[pairs[k, 1]]
            total += pair_weight[k] * apart * apart
        out[i] = min((math.sqrt(total) + abs(bias)) / whole, 1.0) if whole > 0.0 else 1.0
