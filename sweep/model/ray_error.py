"""What too few rays leave: how much more of them might change a shot's probabilities and peaks.

Where powers add, the power of the bin that is detected is a mean over the beam, P = sum_b w_b g_b,
with g_b what it would be if all light went where beamlet b goes. By its weights and places a
hexagonal lattice of whole shells is right for all that is odd about the beam's axis, for what goes
with the square of the places, and all but right for smooth ground. So g is made even, its best
polynomial is taken off, of the second degree for few rays and the fourth for more, and what is left
tells how rough the ground is between the beamlets: the share of the beam about each is taken to be
off by as much as its beamlet differs from its neighbours, each for itself,

    (dP)^2 = sum w_a w_b (r_a - r_b)^2    over the pairs of neighbours.

Like the error itself it falls about as one over the number of rays. It knows nothing of what no
ray has hit, and takes smooth ground for rougher than it is, for 19 rays most of all. Of shots that
are off by more than 1e-6 (scan pattern comparison, gale crater descent, forest scan and square high
descent, powers adding, 1,000 shots or more of each, against 8,017 or 16,021 rays) it is less than
half of that in the forest alone, for one in a thousand, whatever the number of rays; its median is
7 to 60 times as much for 19 rays, 2 to 10 times from 61 on. It takes 0.4, 0.7 and 2 us a shot for
19, 37 and 109 rays.
"""

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from sweep.model.compiling import inlined, owning
from sweep.model.elementary import borrowed
from sweep.model.footprint import beamlets
from sweep.model.ground import Footprints
from sweep.model.lanes import dot
from sweep.model.lines import segment_lines
from sweep.model.preparation import Shots
from sweep.model.segments import SIGNS
from sweep.model.window import samples

_REACH, _STEPS, _SAMPLES = 4, 1024, 1024
"""Bins of fs/L up to which a line's power is known, steps of each, samples of the window."""

_NEIGHBOURS = 1.3
"""How far neighbours may be from each other, over the nearest; the next but one are 1.7 away."""

_QUARTIC = 37
"""Rays from which on the polynomials are of the fourth degree, and leave enough to tell from."""

_FEW = 20
"""Places up to which the roughness is a product with one matrix."""

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
    pairs: np.ndarray
    """(m, 2) int64: places that are neighbours."""
    pair_weight: np.ndarray
    """(m,): sum of the products of their beamlets' power fractions, made larger for what the
    polynomials have taken of the roughness too: k of h."""
    at_once: np.ndarray
    """(h, m): all of that for few places as one matrix, from them to what pairs add; or empty."""


def ray_error(
    shots: Shots, footprints: Footprints, bins: np.ndarray, magnitude: np.ndarray
) -> np.ndarray:
    """Change that more rays may make, (n,), 0..1.

    That of the probabilities of detection, summed over the segments, or that of a peak's magnitude
    relative to itself, or to sigma where that is larger: whichever is most.

    Parameters
    ----------
    shots : Shots
        n shots whose powers add.
    footprints : Footprints
        What their rays have hit: a hexagonal lattice of whole shells. All of it is looked at, even
        where the effect of its spread on the lines is left out.
    bins, magnitude : (n, 3) ndarray
        Bin of each segment's peak, -1 or nan for none, and |X| there.
    """
    out = np.empty(shots.size)
    _errors(
        shots.point_table(), (shots.fft_size, shots.window.length), shots.segments,
        footprints.row, (footprints.offset, footprints.doppler, footprints.echo),
        (bins, magnitude), _lobe(shots.window.name),
        folded(footprints.echo.shape[1]), out,
    )  # fmt: skip
    return out


@lru_cache(maxsize=16)
def folded(number: int) -> Rule:
    """The lattice of so many beamlets, whole shells of them, folded."""
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
    rule = Rule(
        first, opposite[first], 1 / share, smooth, share * smooth, pairs, product, np.empty((0, 0))
    )
    return rule._replace(at_once=_at_once(rule)) if first.size <= _FEW else rule


def _at_once(rule: Rule) -> np.ndarray:
    """The steps of :func:`_roughness` on each place alone, (h, m)."""
    rest = np.eye(rule.first.size)
    for smooth, weighted in zip(rule.smooth, rule.weighted, strict=True):
        rest -= (rest * weighted).sum(axis=1)[:, None] * smooth
    apart = rest[:, rule.pairs[:, 0]] - rest[:, rule.pairs[:, 1]]
    return np.ascontiguousarray(apart * np.sqrt(rule.pair_weight))


def _smooth(offsets: np.ndarray, share: np.ndarray, degree: int) -> np.ndarray:
    """Even polynomials up to a degree, orthonormal, (k, h)."""
    x, y = offsets
    found: list[np.ndarray] = []
    for total in range(0, degree + 1, 2):
        for power in range(total + 1):
            rest = x ** (total - power) * y**power
            for _ in range(2):  # once more takes off what rounding has left
                for other in found:
                    rest = rest - (share * other * rest).sum() * other
            found.append(rest / math.sqrt((share * rest * rest).sum()))
    return np.array(found)


@lru_cache(maxsize=32)
def _lobe(window_name: str) -> np.ndarray:
    """|W(y)|^2 over its peak's at even steps of y >= 0, of the length that makes no difference."""
    w = samples(window_name, _SAMPLES)
    transform = np.abs(np.fft.rfft(w, _SAMPLES * _STEPS)[: _REACH * _STEPS + 1])
    transform[-1] = 0.0  # and nothing beyond
    return np.asarray((transform / w.sum()) ** 2)


@owning(nogil=True)
def _errors(points, sizes, segments, row, footprint, peaks, lobe, rule, out):
    """Errors of all points, (n,)."""
    offset, doppler, echo = (
        borrowed(footprint[0]), borrowed(footprint[1]), borrowed(footprint[2])
    )  # fmt: skip
    bins, magnitude = peaks
    lobe = borrowed(lobe)
    rule = (
        borrowed(rule[0]), borrowed(rule[1]), borrowed(rule[2]), borrowed(rule[3]),
        borrowed(rule[4]), borrowed(rule[5]), borrowed(rule[6]), borrowed(rule[7]),
    )  # fmt: skip
    delta, power, nothing = np.empty((3, echo.shape[1]))
    ones, apart = np.ones(echo.shape[1]), np.empty(rule[6].size)
    rest, p, no_phases = np.empty(rule[0].size), np.empty(points.shape[0]), np.empty(0)
    for i in range(out.size):
        p[:] = points[:, i]
        at, total, largest = row[i], 0.0, 0.0
        for s in range(3):
            if not (segments[s] and bins[i, s] >= 0):
                continue
            a, b = magnitude[i, s] / p[13], p[11] / p[13]
            # The down-chirp's lines lie as those of the up-chirp, and Doppler's closer together,
            # which makes them smoother: one magnitude tells of all.
            of_magnitude = _in_magnitude(a, 1.0) if s == 0 or not bins[i, 0] >= 0 else 0.0
            if of_magnitude < _NOTHING and _change(a, b, 1.0) < _NOTHING:
                continue
            origin = segment_lines(
                (SIGNS[s], p[9] if s == 2 else p[8]), (p[2], p[0], p[1], p[3]), (p[4], p[5]),
                (p[6], sizes[0], sizes[1], p[7]), offset[at], doppler[at], ones, no_phases,
                delta, power, nothing, True,
            )  # fmt: skip
            _in_bin(delta, bins[i, s] - origin, sizes[1] / sizes[0], lobe, echo[at], power)
            relative = min(_roughness(power, rule, rest, apart), 1.0)
            total += _change(a, b, relative)
            largest = max(largest, _in_magnitude(a, relative))
        out[i] = min(max(total, largest), 1.0)


@inlined()
def _change(a, b, relative):
    """Most that Q_1(a, b) changes as a's square changes by a share of itself.

    dQ_1/d ln a <= sqrt(a b / (2 pi)) exp(-(a - b)^2 / 2), at the nearest to b that a comes.
    """
    away = max(abs(a - b) - 0.5 * relative * a, 0.0)
    if away > _FAR:
        return 0.0
    return min(0.5 * relative * math.sqrt(a * b / (2 * math.pi)) * math.exp(-0.5 * away**2), 1.0)


@inlined()
def _in_magnitude(a, relative):
    """Change of a over itself, or 1 if that is larger, as its square changes by a share."""
    return 0.5 * relative * min(a, 1.0)


@inlined()
def _in_bin(delta, k, ratio, lobe, echo, power):
    """Powers of lines, as a bin has them, from those of lines of an echo of 1."""
    for b in range(delta.size):
        place = abs(delta[b] - k) * ratio * _STEPS
        low = int(min(place, lobe.size - 2.0))
        part = min(place - low, 1.0)
        power[b] *= echo[b] * (lobe[low] + (lobe[low + 1] - lobe[low]) * part)


@inlined()
def _roughness(power, rule, rest, apart):
    """Error of the sum of powers, over the sum: see the module."""
    first, second, per_share, smooth, weighted, pairs, pair_weight, at_once = rule
    whole = 0.0
    for f in range(first.size):
        both = power[first[f]] + (power[second[f]] if second[f] != first[f] else 0.0)
        whole += both
        rest[f] = both * per_share[f]
    if not whole > 0.0:
        return 1.0
    if at_once.shape[0]:
        apart[:] = 0.0
        for f in range(first.size):
            for k in range(apart.size):
                apart[k] += at_once[f, k] * rest[f]
        return math.sqrt(dot(apart, apart, apart.size)) / whole
    per_whole = 1.0 / whole
    for f in range(first.size):
        rest[f] *= per_whole
    for j in range(smooth.shape[0]):  # orthonormal: one after the other is all at once
        part = dot(weighted[j], rest, first.size)
        for f in range(first.size):
            rest[f] -= part * smooth[j, f]
    for k in range(pair_weight.size):
        apart[k] = rest[pairs[k, 0]] - rest[pairs[k, 1]]
    for k in range(pair_weight.size):
        apart[k] *= apart[k]
    return math.sqrt(dot(pair_weight, apart, pair_weight.size))
