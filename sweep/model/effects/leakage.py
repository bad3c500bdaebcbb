"""Leakage: extra groups raised by the signal's own bins below the threshold.

It changes no detecting bin, and so no detection probability; it is what ``p_leakage`` holds. It
acts on the detection: without it no bin beside the groups need be looked at. By the union bound

    p_leakage <= sum_k (Q_1(a_k, b) - Q_1(0, b)) / (1 - Q_1(0, b)),   a_k <= min(A E_k, b),

over the bins that may leak, with A the magnitude of all lines together, E_k the largest |W| at
the distances that lines may have from bin k, and b the threshold, all over sigma. Not among them
are the detecting bin and those that surely reach the threshold, and all their neighbours; so A is
in the main lobe at most what leaves the bin before k below the threshold. Bins amid lines that add
as powers have what Parseval's theorem gives them together. Images are no nearer to a bin than the
lines are, nor than these are to DC and Nyquist.

Amplitudes may cancel. With S the most that they add up to (:mod:`.footprint_sum`), their lines x_b
from the axis's, bins have S |W| to sum a_b |x_b| max |W'|, and no more than A E_k. Either the
largest is next to the axis's line, or their sum is so small that this leaves it open, and then
every bin may leak, none with more than that makes of it.
"""

import math
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numba import njit

from sweep.model.effects.change import Mean
from sweep.model.effects.columns import columns
from sweep.model.effects.effect import Effect, Scene
from sweep.model.effects.footprint_sum import footprint_sum
from sweep.model.effects.line_powers import uphill_of
from sweep.model.effects.lobes import lobe, lobe_tail
from sweep.model.effects.sidelobes import CELLS, LEVELS, STEEPEST, sidelobes
from sweep.model.effects.span import Span
from sweep.model.marcum import excess_crossing
from sweep.model.preparation import Shots

if TYPE_CHECKING:
    from sweep.model.effects.block import Block


_STEPS = 24
_ROUNDING = 1e-6
"""Bins by which a line's place may be off."""
_NEGLIGIBLE = 1e-14
"""Chance that needs no closer look."""
_HIGHER = 1.25
"""How much more leaks, at the most, with a higher threshold than one of 2 sigma or more: only bins
that reach the threshold, whose chance to cross then rises from 0.468 to 0.556."""
_STAR = 1.3
"""How much more than in proportion to a^2 <= b^2 the chance to cross may fall, at the most."""


def bound(block: "Block") -> Mean:
    """Bound on the chance that leaked signal raises an extra group."""

    def change(amplitude: Span, threshold: Span) -> np.ndarray:
        return probability_bound(block, amplitude=amplitude, threshold=threshold)

    return Mean(change)


def probability_bound(block: "Block", *, amplitude: Span, threshold: Span) -> np.ndarray:
    """Bound on the chance that leaked signal raises an extra group in a segment, (3, tiles), 0..1.

    Parameters
    ----------
    block : Block
        The tiles.
    amplitude : Span
        Magnitude of the detecting bin over sigma, (3, tiles), whatever the effects make of it.
    threshold : Span
        Threshold over sigma, likewise.
    """
    main, shape = block.lines.lobe, block.window
    table, ratio = sidelobes(shape.name, shape.length), shape.length / block.fft_size
    given, size = columns(
        *footprint_sum(block), block.peak.high, amplitude.low, threshold.low, threshold.high
    )
    found = unions(
        block.axis, given, (main.reach, main.envelope),
        (table.highest, table.lowest, table.steepest),
        far_steps(shape.name, shape.length, block.fft_size),
        (ratio, block.fft_size / 2, shape.equivalent_noise_bandwidth),
        not block.adds_amplitudes,
    ).reshape(size)  # fmt: skip
    if not block.segment_exists[1]:
        found[1] = 0.0
    return found


@lru_cache(maxsize=32)
def far_steps(name: str, length: int, fft_size: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Distances [bins] from the table's end on, between which sidelobes are taken to be even.

    Returns
    -------
    (m,) ndarray, (m,) ndarray, (m,) ndarray
        Bins from each to the next; largest magnitude and slope from each on.
    """
    ratio, form = length / fft_size, lobe(name, length, fft_size)
    first = sidelobes(name, length).lowest.size / CELLS / ratio
    steps = np.geomspace(first, max(fft_size / 2, first) + 1, _STEPS)
    begin = steps[:-1]
    return np.diff(steps), form.tail(begin), STEEPEST * form.tail(begin - 1 / ratio)


@njit(cache=True, error_model="numpy")
def unions(axis, given, lobe, table, far, sizes, powers):
    """Largest sum of the chances of all bins that may leak, (n,)."""
    out, column = np.empty(given.shape[1]), np.empty(12)
    for i in range(out.size):
        _put_column(axis[:, i], given[:, i], lobe, table[2][LEVELS, 0], sizes, column)
        together, b, upper = column[1], column[3], column[4]
        if not b > 0.0:  # where other effects may drown the threshold, any bin may cross it
            out[i] = 1.0
            continue
        first, second, limit, sure = _starts(column, table, sizes[0])
        total = 0.0
        if limit < together:
            total = _sum(together, first, second, column, table, far, sizes, powers)
        if not sure:
            other = min(together, limit)
            total = max(total, _sum(other, 0.0, 1.0, column, table, far, sizes, powers))
        higher = (upper / b) ** 4
        higher = min(higher, _HIGHER) if b > 2.0 else higher
        out[i] = min(higher * min(total / -math.expm1(-0.5 * b * b), 1.0), 1.0)
    return out


@njit(cache=True, error_model="numpy")
def _put_column(axis, given, lobe, steepest, sizes, out):
    """What a segment's bins follow from: sums of lines, ends of what they may be, sidelobes."""
    offset, offset_least, edge, transfer, _, tilt, _, _, extreme = axis
    in_phase, most, lean, peak, low, b, upper = given
    (reach, envelope), (ratio, half, _) = lobe, sizes
    extreme = np.fmin(extreme, 2.0 * half)
    peak *= np.minimum(transfer * uphill_of(tilt, extreme), 1.0)
    in_phase, most, lean = peak * in_phase, peak * most, peak * lean
    image = lobe_tail(reach, envelope, edge - extreme)
    sloping = STEEPEST * lobe_tail(reach, envelope, edge - extreme - 1 / ratio)
    askew = np.minimum(lean * sloping * ratio, in_phase * image)
    out[0], out[1], out[2], out[3], out[4], out[5] = in_phase, most, low, b, upper, extreme
    out[6], out[7], out[8] = offset_least, offset, image
    out[9] = np.minimum(most * image + askew, in_phase * image)
    out[10] = askew + np.minimum(lean * ratio * steepest, 2 * in_phase)
    out[11] = lean * ratio


@njit(cache=True, error_model="numpy")
def _starts(column, table, ratio):
    """First bins that may leak on either side, from the nearest (0) up and from the next (1) up.

    Returns
    -------
    first, second : float
    limit : float
        The sum of all lines below which any bin may be the largest.
    sure : bool
        Whether the sum is above it.
    """
    _, _, peak, b, _, extreme, least, most, image, _, askew, _ = column
    beyond, lowest = table[0][LEVELS], table[1]
    nearest = _read(beyond, (least - extreme) * ratio)
    sum_ = max(peak - askew, 0.0) / (nearest + image)
    near = _read(lowest, (most + extreme) * ratio) - 2.0 * image
    first, second = 2.0, 2.0
    gap = near - _read(beyond, (1.0 - most - extreme) * ratio)
    if gap < 0.1 and sum_ * gap <= 2.0 * askew:
        first = 1.0
        gap = near - _read(beyond, (1.0 + least - extreme) * ratio)
    limit = 2.0 * askew / gap if gap > 0.0 else math.inf
    # the furthest that bins are sure to reach the threshold
    weakest = (b + askew) / sum_ + image
    reach = np.searchsorted(-lowest, -weakest, "right") / CELLS / ratio - extreme
    if reach > most:
        first = max(first, math.floor(reach - most) + 2.0)
        second = max(second, math.floor(reach + least) + 2.0)
    return first, second, limit, sum_ > limit


@njit(cache=True, error_model="numpy")
def _sum(whole, first, second, column, table, far, sizes, powers):
    """Sum of the chances of the bins from the first two on, of lines that add up to ``whole``."""
    a, _, _, b, upper, extreme, least, most, tail, image, askew, lean = column
    ratio, half, noise_bandwidth = sizes
    stride = max(int(1.0 / ratio), 1)
    width = (most - least + 2.0 * extreme + stride - 1.0) * ratio + 2.0 * _ROUNDING
    level = min(math.ceil(math.log2(math.floor(CELLS * min(width, 1.0)) + 2.0)) - 1, LEVELS)
    row, lowest, slope = table[0][level], table[1], table[2][level]
    beyond, steepest = table[0][LEVELS], table[2][LEVELS]
    total = 0.0
    for side in range(2):
        start = second if side else first
        # bins of this side lie at k + nearest or further from the nearest line
        nearest, furthest = (-most, -least) if side else (least, most)
        nearest -= extreme
        inside = min(max(math.ceil(-nearest) - start, 0.0), half + 1.0)
        amid = min(a, whole + lean * table[2][LEVELS, 0])
        total += _inside(inside, amid, b, image, noise_bandwidth / ratio, powers)
        k = start + inside
        j = int(CELLS * ((k + nearest) * ratio - _ROUNDING))
        while j < row.size and total <= 1.0 and k <= half:
            # where the bin before reaches the threshold this one does not leak
            before = max(k + stride - 2.0 + furthest, most) + extreme
            least_before = _read(lowest, before * ratio)
            most_whole = min(whole, (upper + askew) / max(least_before - tail, 1e-300))
            beside = min(most_whole * row[j] + lean * slope[j], a * row[j])
            mirrored = min(min(whole * beyond[j] + lean * steepest[j], a * beyond[j]), image)
            beside = math.hypot(beside, mirrored) if powers else beside + mirrored
            total += stride * excess_crossing(min(beside, b), b)
            k += stride
            j = int(CELLS * ((k + nearest) * ratio - _ROUNDING))
    for j in range(far[0].size):
        beside = min(whole * far[1][j] + lean * far[2][j], a * far[1][j])
        mirrored = min(beside, image)
        both = math.hypot(beside, mirrored) if powers else beside + mirrored
        chance = excess_crossing(min(both, b), b)
        if chance * half < _NEGLIGIBLE or total > 1.0:
            total += 2.0 * half * chance
            break
        total += (2.0 * far[0][j] + 2.0) * chance
    return total


@njit(cache=True, error_model="numpy")
def _inside(number, a, b, image, energy, powers):
    """Sum of the chances of so many bins within the spread of lines."""
    if number <= 0.0:
        return 0.0
    at = min(math.hypot(a, image) if powers else a + image, b)
    if powers:
        energy += 2.0 * (image / a) ** 2
        number = min(number, max(_STAR * energy * (a / at) ** 2, 1.0))
    return number * excess_crossing(at, b)


@njit(cache=True, error_model="numpy")
def _read(table, place):
    j = int(CELLS * max(place, 0.0))
    return table[j] if j < table.size else table[-1]


def act(shots: Shots, scene: Scene) -> Shots:
    """Bins beside the detection looked at too."""
    return replace(shots, leakage=True)


EFFECT = Effect(
    name="leakage",
    about="further groups raised by sidelobes below the threshold",
    stage="detection",
    bound=bound,
    act=act,
)
