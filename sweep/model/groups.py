"""Groups of adjacent bins at or above the threshold in noiseless spectra (PHYSICS section 6)."""

from typing import NamedTuple

import numpy as np

from sweep.kernel_cache import njit
from sweep.model.detection import echo_of, found_pair, levels_of, speckle_of
from sweep.model.preparation import Shots
from sweep.model.segments import Runs, runs_of

BIN, FIRST, LAST = range(3)
"""Bins of a group: the strongest, the first and the last."""


class Groups(NamedTuple):
    """Groups of adjacent bins at or above the threshold in noiseless spectra: up, Doppler, down.

    Each is a target or a strong one's sidelobe. Strongest first; bin -1 and nan where there is
    none. If no bin crosses the threshold the strongest is listed, as noise may lift it. Echoes that
    are not searched for, or arrive after the record, have no group, but |X| of a strongest bin.
    """

    bin: np.ndarray
    """(n, 3, most) int64: strongest bin, 0..N/2; of a complex record any of its run."""
    first: np.ndarray
    """(n, 3, most) int64: first bin of the group."""
    last: np.ndarray
    """(n, 3, most) int64: last bin of the group."""
    neighbours: np.ndarray
    """(n, 3, most, 3): |X| [V, summed over the record] below, at and above the strongest bin."""
    pd: np.ndarray
    """(n, 3, most): probability of detection."""
    exempted: np.ndarray
    """(n, 3): bins that cannot raise a false alarm."""
    leakage: np.ndarray
    """(n, 3): probability that leaked signal raises a further group, over noise alone."""

    @property
    def magnitude(self) -> np.ndarray:
        """|X| of the strongest bin, (n, 3, most)."""
        return self.neighbours[..., 1]


def groups(shots: Shots, *, most: int = 4, every_bin: bool = False, leakage: bool = True) -> Groups:
    """Find the groups of each segment's spectrum without noise, the ``most`` strongest of them.

    ``every_bin`` as of :func:`sweep.model.shot.find`. Without ``leakage`` its probability is 0.
    """
    bins, found = room_for_groups(shots.size, most)
    for runs in runs_of(shots, every_bin=every_bin, leakage=leakage, chances=False):
        add_groups(shots, runs, bins, found)
    return found


def room_for_groups(points: int, most: int) -> tuple[np.ndarray, Groups]:
    """Return no groups of ``points`` points, and the array of which their bins are parts.

    This is (3, points, 3, most), by BIN, FIRST and LAST.
    """
    bins = np.full((3, points, 3, most), -1, np.int64)
    return bins, Groups(
        bins[BIN], bins[FIRST], bins[LAST], np.full((points, 3, most, 3), np.nan),
        np.full((points, 3, most), np.nan), *np.full((2, points, 3), np.nan),
    )  # fmt: skip


def add_groups(shots: Shots, runs: Runs, bins: np.ndarray, found: Groups) -> None:
    """Find the groups of some points by the runs of their bins.

    ``bins`` and ``found``, those of :func:`room_for_groups`, take them.
    """
    pd = found.pd
    mirror = 0 if shots.complex_record else shots.fft_size // 2
    count, magnitudes = (runs.bins, runs.magnitudes) if shots.band is None else _echoes(runs)
    _find_groups(
        runs.part, (runs.low, count, runs.peak, runs.start), (magnitudes, runs.exempt),
        shots.bin_levels, (mirror, shots.echo_rule, shots.speckle_table), bins, found.neighbours,
        pd,
    )  # fmt: skip
    if shots.looks.several:
        seen, middle = found.bin[runs.part], found.magnitude[runs.part]
        chances = shots.detected(middle.T, seen.T, runs.part)[0]
        pd[runs.part] = chances.T
    no_group = (found.bin[runs.part, :, 0] < 0) & shots.segments
    strongest = found.neighbours[runs.part, :, 0, 1]
    found.neighbours[runs.part, :, 0, 1] = np.where(no_group, runs.magnitude.T, strongest)
    pd[runs.part, :, 0] = np.where(runs.inside.T | (count.T > 0), pd[runs.part, :, 0], 0.0)
    some = np.where((runs.bins > 0) | ~runs.inside, runs.exempted, np.nan)
    found.exempted[runs.part], found.leakage[runs.part] = some.T, runs.leakage.T


def _echoes(runs: Runs) -> tuple[np.ndarray, np.ndarray]:
    """Numbers of bins of runs, and |X|, with nothing but echoes where the largest is not searched.

    Sidelobes of what is not searched are no groups, and leak.
    """
    count, magnitudes = runs.bins.copy(), runs.magnitudes.copy()
    for s, j in np.argwhere(~runs.inside):
        start, end = runs.start[s, j] + np.array([0, runs.bins[s, j]])
        exempt = runs.exempt[start:end]
        magnitudes[start:end][~exempt] = 0.0
        if not exempt.any():
            count[s, j] = 0
    return count, magnitudes


@njit(cache=True, nogil=True, error_model="numpy")
def _find_groups(part, runs, of_bins, levels, how, bins, neighbours, pd):
    """Find the groups of every run, into arrays of the shapes of :class:`Groups`.

    ``of_bins`` are |X| [V] of all runs, and whether bins are of echoes: other groups are leaked
    signal.
    ``how``: N/2, or 0 of complex records, :attr:`sweep.model.preparation.Shots.echo_rule`, and
    :attr:`~sweep.model.preparation.Shots.speckle_table`.
    """
    (low, count, peak, start), (half, rule, speckle) = runs, how
    magnitudes, exempts = of_bins
    for j in range(part.size):
        i = part[j]
        level = levels[1, i]
        for s in range(3):
            if count[s, j] == 0:
                continue
            magnitude = magnitudes[start[s, j] : start[s, j] + count[s, j]]
            exempt = exempts[start[s, j] : start[s, j] + (count[s, j] if half == 0 else 0)]
            found = _list_groups(magnitude, exempt, peak[s, j], level, bins[:, i, s])
            for g in range(found):
                k = bins[BIN, i, s, g]
                beside = max(rule.beside, int(levels[4, i]))
                first, last = echo_of(
                    magnitude, bins[FIRST, i, s, g], bins[LAST, i, s, g], level, beside
                )
                echo = np.ones(last - first + 1, np.bool_)
                pd[i, s, g] = found_pair(
                    magnitude[first : last + 1], echo, k - first, low[s, j] + first, rule,
                    levels_of(levels, i), speckle_of(speckle, s, i),
                )[0]  # fmt: skip
                for side in range(3):
                    neighbours[i, s, g, side] = _beside(magnitude, low[s, j], k + side - 1, half)
                for field in range(3):
                    bins[field, i, s, g] += low[s, j]


@njit(cache=True, error_model="numpy", borrows=True)
def _beside(magnitude, low, k, half):
    """Magnitude k of a run that starts at bin ``low``; mirrored at DC and Nyquist, 0 past it."""
    if half > 0:
        bin_ = abs(low + k)
        k = (2 * half - bin_ if bin_ > half else bin_) - low
    return magnitude[k] if 0 <= k < magnitude.size else 0.0


@njit(cache=True, error_model="numpy", borrows=True)
def _list_groups(magnitude, exempt, peak, level, bins):
    """List the strongest groups of a run in bins (3, most), as indices; return their number.

    Groups of bins that are not ``exempt`` are leaked signal; of no size all may be echoes.
    """
    if not magnitude[peak] >= level:
        bins[:, 0] = peak
        return 1
    most, found, k = bins.shape[1], 0, 0
    while k < magnitude.size:
        if not magnitude[k] >= level:  # true of nan too, which would end no loop
            k += 1
            continue
        best = first = k
        while k < magnitude.size and magnitude[k] >= level:
            best = k if magnitude[k] > magnitude[best] else best
            k += 1
        if exempt.size > 0 and not exempt[best] and best != peak:
            continue
        g = found
        while g > 0 and magnitude[bins[BIN, g - 1]] < magnitude[best]:
            g -= 1
        found = min(found + 1, most)
        for h in range(found - 1, g, -1):
            for field in range(3):
                bins[field, h] = bins[field, h - 1]
        if g < most:
            bins[BIN, g], bins[FIRST, g], bins[LAST, g] = best, first, k - 1
    return found
