"""Image and folding: the real record's line at -f, which reaches the bins of f near DC and Nyquist.

X[k] has W(k - nu) and, conjugated, W(k + nu); past Nyquist the line that is seen is the image of
one that is not. Without the effect only the kernel of the folded line itself is summed, where it
is seen. It acts on the spectrum. Bound by the envelope E of the window's sidelobes: with a
footprint that keeps e bins from the edge (DC or Nyquist), bins within e/2 of its lines have
images at most E(3/2 e) high, and all others at most E(e/2) + E(e) altogether.

A bin at the threshold, far down the lines' sidelobes, is smaller than the largest by far, and moved
by an image that the largest does not feel. It then belongs to the detection, or does no more, and
of the bins that may raise a false alarm there is one fewer or more. With lines d bins away such a
bin has images at 2 e - d; if these move it by a share x of the threshold, it must lie that near,
and bins whose sidelobes fall no slower than 1/d lie there with a chance of x d.
"""

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numba import njit

from sweep.model.effects.change import Change
from sweep.model.effects.columns import columns
from sweep.model.effects.effect import Effect, Scene
from sweep.model.effects.footprint_sum import footprint_sum
from sweep.model.effects.line_powers import extremes_of, power_range_of, uphill_of
from sweep.model.effects.line_spread import sizes_of
from sweep.model.effects.lobes import lobe_least, lobe_tail, lobe_within
from sweep.model.preparation import PROCESSING, Shots

if TYPE_CHECKING:
    from sweep.model.effects.block import Block

_LN_10 = math.log(10)
_SELDOM = 1e-4
"""Expected bins at the threshold of a shot that are not reckoned with."""


def bound(block: "Block") -> Change:
    """What images can change in the largest bin.

    Where amplitudes add, the sum may be anything, and what images add to any bin of 0..N/2 is at
    most E(e) of all lines in phase.
    """
    found, lobe = np.empty((2, 3, block.size)), block.lines.lobe
    put_bounds(
        block.axis, block.number, *sizes_of(lobe), (lobe.reach, lobe.envelope),
        found.reshape(2, -1),
    )  # fmt: skip
    high, added = found
    alarms = alarm_change(block)
    if not block.adds_amplitudes:
        return Change(signal=(1.0, high), alarms=alarms)
    most = 1.0 if block.architecture == "direct" else high
    return Change(signal=(1.0, most), added=added, alarms=alarms)


@njit(cache=True, error_model="numpy")
def put_bounds(axis, beamlets, tables, sizes, lobe, out):
    """Largest factor on the largest bin's magnitude, and what is added to a sum, (2, n)."""
    bounds, (reach, envelope) = extremes_of(beamlets, tables), lobe
    for i in range(axis.shape[1]):
        offset, offset_least, edge, _, _, tilt, mean, rms, extreme = axis[:, i]
        line, spread = (offset, offset_least, edge, tilt), (mean, rms, extreme)
        least_power, _ = power_range_of(line, spread, bounds, tables, sizes)
        apart = edge - extreme
        inside = lobe_tail(reach, envelope, 1.5 * apart)
        beside = lobe_tail(reach, envelope, 0.5 * apart)
        outside = lobe_tail(reach, envelope, 1.0 * apart)
        far = (beside * beside + outside * outside) / least_power
        out[0, i] = np.sqrt(np.maximum(1 + inside * inside / least_power, far))
        out[1, i] = uphill_of(tilt, extreme) * outside / lobe_least(tables[1], offset)


def alarm_change(block: "Block") -> np.ndarray:
    """Change of log10 pfa of a shot by the bins that images move across the threshold, (tiles,).

    That of one bin, or of as many as are to be expected; 0 where fewer than ``_SELDOM`` are.
    """
    if block.word(PROCESSING + "bins_counted") == "all":
        return np.zeros(block.size)
    found = np.empty(block.size)
    put_alarms(*moved_bins(block), block.fft_size / 2, found)
    return found


@njit(cache=True, error_model="numpy")
def put_alarms(bins, taken, half, out):
    """Changes of log10 pfa (tiles,)."""
    for t in range(out.size):
        left = np.maximum(half - taken[t], 1.0)
        out[t] = np.maximum(bins[t], 1.0) / (_LN_10 * left) if bins[t] > _SELDOM else 0.0


def moved_bins(block: "Block") -> tuple[np.ndarray, np.ndarray]:
    """Bins of a shot that images move across the threshold, and most that a detection takes.

    Returns
    -------
    (tiles,), (tiles,) ndarray
        Expected number, were lines anywhere between two bins, of both chirps together; bins of
        one.
    """
    lobe, found = block.lines.lobe, np.empty((2, block.size))
    table, shape = columns(footprint_sum(block).in_phase, block.peak.high, block.threshold.low)
    put_moved_bins(
        block.axis.reshape(-1, *shape), table.reshape(-1, *shape), block.fft_size / 2,
        (lobe.reach, lobe.envelope), block.adds_amplitudes, found,
    )  # fmt: skip
    return found[0], found[1]


@njit(cache=True, error_model="numpy")
def put_moved_bins(axis, table, half, lobe, amplitudes, out):
    """Expected bins that both chirps' images move, and most that a detection takes, (2, tiles)."""
    reach, envelope = lobe
    for t in range(out.shape[1]):
        bins, furthest = 0.0, -np.inf
        for s in (0, 2):
            _, _, edge, transfer, _, tilt, _, _, extreme = axis[:, s, t]
            in_phase, peak, level = table[:, s, t]
            extreme = np.fmin(extreme, half)
            transfer = np.minimum(transfer * uphill_of(tilt, extreme), 1.0)
            whole = np.maximum(peak * transfer * in_phase, 1e-300)
            away = np.minimum(lobe_within(reach, envelope, level / whole), half)
            apart = edge - extreme
            moved = 0.0
            for distance in (np.maximum(2 * apart - away, apart), 2 * apart + away):
                share = np.minimum(whole * lobe_tail(reach, envelope, distance) / level, 1.0)
                moved += share if amplitudes else share * share / 2
            bins += moved * (away + extreme)
            furthest = np.maximum(furthest, away + extreme)
        out[0, t], out[1, t] = bins, 2 * furthest + 4


def act(shots: Shots, scene: Scene) -> Shots:
    """Images summed with the lines."""
    return replace(shots, image=True)


EFFECT = Effect(
    name="image",
    about="lines at negative frequencies, near DC and Nyquist",
    stage="spectrum",
    bound=bound,
    act=act,
)
