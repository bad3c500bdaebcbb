"""Groups: the targets that stand in the noiseless spectra of a shot's three segments.

Adjacent bins at or above the threshold form a group, its largest bin the detection; several
groups are several targets (PHYSICS section 6). Strong targets raise groups of sidelobes as well,
which nothing here tells from targets; :mod:`sweep.model.pairing` flags what comes of them.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from sweep.model.crossings import crossing_series
from sweep.model.elementary import borrowed
from sweep.model.lending import lend
from sweep.model.marcum import marcum_q1_pair
from sweep.model.modulation import Stretch, choices, stretches
from sweep.model.preparation import Shots
from sweep.model.segments import inspect_segment, lent, workspace

BIN, FIRST, LAST = range(3)


class Groups(NamedTuple):
    """Groups of bins in the noiseless spectra of n shots; segments up, Doppler, down.

    Strongest first; bin -1 and nan where there is none. Where no bin crosses the threshold the
    strongest bin is listed, as noise may lift it.
    """

    bin: np.ndarray
    """(n, 3, most) int64: strongest bin, 0..N/2."""
    first: np.ndarray
    """(n, 3, most) int64: first bin of the group."""
    last: np.ndarray
    """(n, 3, most) int64: last bin of the group."""
    neighbours: np.ndarray
    """(n, 3, most, 3): |X| [V, summed over the record] below, at and above the strongest bin."""
    pd: np.ndarray
    """(n, 3, most): probability that noise leaves the strongest bin above the threshold."""
    exempted: np.ndarray
    """(n, 3): bins that cannot raise a false alarm."""
    leakage: np.ndarray
    """(n, 3): probability that leaked signal raises a further group, over noise alone."""

    @property
    def magnitude(self) -> np.ndarray:
        """|X| of the strongest bin, (n, 3, most)."""
        return self.neighbours[..., 1]


def groups(shots: Shots, *, most: int = 4, every_bin: bool = False) -> Groups:
    """Groups of each segment's spectrum without noise, the ``most`` strongest of them.

    ``every_bin`` as of :func:`sweep.model.shot.find`.
    """
    found = [_of_stretch(shots, stretch, most, every_bin) for stretch in stretches(shots)]
    if len(found) == 1:
        return found[0]
    return Groups(*(np.concatenate(fields) for fields in zip(*found, strict=True)))


def _of_stretch(shots: Shots, stretch: Stretch, most: int, every_bin: bool) -> Groups:
    n = stretch.row.size
    bins = np.full((3, n, 3, most), -1, np.int64)
    neighbours, pd = np.full((n, 3, most, 3), np.nan), np.full((n, 3, most), np.nan)
    exempted, leakage = np.full((n, 3), np.nan), np.full((n, 3), np.nan)
    _find_groups(
        stretch.points, stretch.row, stretch.scene, shots.segments,
        choices(shots, every_bin=every_bin), shots.kernel(),
        workspace(stretch.lines, shots.fft_size), bins, neighbours, pd, exempted, leakage,
    )  # fmt: skip
    return Groups(bins[BIN], bins[FIRST], bins[LAST], neighbours, pd, exempted, leakage)


@njit(cache=True, nogil=True, error_model="numpy")
def _find_groups(
    points, row, scene, segments, choices, kernel, work, bins, neighbours, pd, exempted, leakage
):
    """Groups of every point and segment, into arrays of the shapes of :class:`Groups`."""
    half = kernel[0][0] // 2
    seen, known, (room, exempt, series) = lent(scene, kernel, work)
    scene, kernel = lend(seen), lend(known)
    bins = borrowed(bins)
    p = np.empty(points.shape[0])
    for i in range(points.shape[1]):
        p[:] = points[:, i]
        sigma, level = p[10], p[11]
        if choices[2]:
            crossing_series(level / sigma, series)
        for s in range(3):
            if not segments[s]:
                continue
            low, count, peak, exempted[i, s], leakage[i, s] = inspect_segment(
                s, p, scene, (row[i], i), choices, kernel, room, exempt, series
            )
            magnitude = room[0, :count]
            found = _list_groups(magnitude, peak, level, bins[:, i, s])
            for g in range(found):
                k = bins[BIN, i, s, g]
                pd[i, s, g] = marcum_q1_pair(magnitude[k] / p[13], level / p[13])[0]
                for side in range(3):
                    neighbours[i, s, g, side] = _beside(magnitude, low, k + side - 1, half)
                bins[:, i, s, g] += low


@njit(cache=True, error_model="numpy")
def _beside(magnitude, low, k, half):
    """Magnitude k of a run that starts at bin ``low``; mirrored at DC and Nyquist, 0 past it."""
    bin_ = abs(low + k)
    k = (2 * half - bin_ if bin_ > half else bin_) - low
    return magnitude[k] if 0 <= k < magnitude.size else 0.0


@njit(cache=True, error_model="numpy")
def _list_groups(magnitude, peak, level, bins):
    """Strongest groups of a run into bins (3, most), as indices; returns how many there are."""
    if magnitude[peak] < level:
        bins[:, 0] = peak
        return 1
    found, k = 0, 0
    while k < magnitude.size:
        if magnitude[k] < level:
            k += 1
            continue
        first, best = k, k
        while k < magnitude.size and magnitude[k] >= level:
            best = k if magnitude[k] > magnitude[best] else best
            k += 1
        found = _insert(magnitude, best, first, k - 1, bins, found)
    return found


@njit(cache=True, error_model="numpy")
def _insert(magnitude, best, first, last, bins, found):
    """Puts a group in its place by strength; the weakest falls out where there is no room."""
    place = found
    while place > 0 and magnitude[best] > magnitude[bins[BIN, place - 1]]:
        place -= 1
    if place == bins.shape[1]:
        return found
    found = min(found + 1, bins.shape[1])
    for g in range(found - 1, place, -1):
        bins[:, g] = bins[:, g - 1]
    bins[BIN, place], bins[FIRST, place], bins[LAST, place] = best, first, last
    return found
