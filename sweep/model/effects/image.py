"""Image and folding: the real record's line at -f, which reaches the bins of f near DC and Nyquist.

X[k] has W(k - nu) and, conjugated, W(k + nu); past Nyquist the line that is seen is the image of
one that is not. Without the effect only the kernel of the folded line itself is summed, where it
is seen. It acts on the spectrum. Bound by the envelope E of the window's sidelobes: with a
footprint that keeps e bins from the edge (DC or Nyquist), bins within e/2 of its lines have
images at most E(3/2 e) high, and all others at most E(e/2) + E(e) altogether.
"""

import numpy as np
from numpy.typing import ArrayLike

from sweep.model import segments
from sweep.model.effects.change import Change
from sweep.model.effects.line_spread import Line, Moments, power_range
from sweep.model.equivalent import MOST_NODES
from sweep.model.lines import segment_lines
from sweep.model.preparation import Shots
from sweep.model.window import transform


def bound(
    line: Line, *, spread: Moments, beamlets: int, powers: bool, least: ArrayLike | None = None
) -> Change:
    """What images can change in the largest bin of a segment.

    Parameters
    ----------
    line : Line
        Of the axis.
    spread : Moments
        Bins by which ranges and velocities put the lines off the axis's.
    beamlets : int
        Their number.
    powers : bool
        Whether lines and images add as powers.
    least : array_like, optional
        For amplitudes: least magnitude of the largest bin over that of all lines on a bin and in
        phase. 0 for a footprint whose phases may cancel, of which nothing can be said; by default
        that of one line.
    """
    apart = line.edge - np.asarray(spread.extreme, float)
    inside, beside, outside = (line.lobe.tail(m * apart) for m in (1.5, 0.5, 1.0))
    least_power, _ = power_range(line, spread, beamlets)
    with np.errstate(divide="ignore"):
        if powers:
            far = (beside**2 + outside**2) / least_power
            high = np.sqrt(np.maximum(1 + inside**2 / least_power, far))
            return Change(signal=(np.ones_like(high), high))
        one = line.lobe.least(line.bin_offset) if least is None else np.asarray(least, float)
        low = np.where(one > beside, 1 - np.fmin(inside / one, 1.0), 0.0)
        return Change(signal=(low, np.maximum(1 + inside / one, (beside + outside) / one)))


def without(shots: Shots, i: int, segment: int, bins: np.ndarray) -> np.ndarray:
    """|X| of some bins (m,) of a point's segment with the folded lines' own kernels only.

    Plain sums over the window, as slow as they are simple.
    """
    p = shots.point_table()[:, i].copy()
    offset, doppler, amplitude = (part[shots.row[i]] for part in shots.footprint)
    delta, re, im = np.empty((3, max(offset.size, MOST_NODES)))
    origin = segment_lines(
        (segments.SIGNS[segment], p[9] if segment == 2 else p[8]), (p[2], p[0], p[1], p[3]),
        (p[4], p[5]), (p[6], shots.fft_size, shots.window.length, p[7]),
        offset, doppler, amplitude, delta, re, im,
    )  # fmt: skip
    ratio = shots.window.length / shots.fft_size
    total = np.zeros(len(bins), complex)
    for b in range(offset.size):
        y = (np.asarray(bins) - origin - delta[b]) * ratio
        kernel = transform(shots.window, y) * (re[b] + 1j * im[b])
        # C_b holds half of the turn pi y already, bins and origin the other
        total += abs(kernel) ** 2 if shots.incoherent else kernel * np.exp(1j * np.pi * y)
    if shots.incoherent:
        return np.asarray(np.sqrt(total.real))
    return np.asarray(abs(total))
