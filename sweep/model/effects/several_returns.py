"""Several returns: a footprint on more than one surface, each with its own group of bins.

Called for where an edge lies in the footprint. It acts on the lines' positions: without it the
beamlets beside the axis's surface send their power back from the axis's own range.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from sweep.model.effects.change import Change
from sweep.model.effects.line_spread import (
    NO_SPREAD,
    Line,
    Moments,
    image_factor,
    power_range,
)
from sweep.model.preparation import Shots


def bound(
    line: Line, *, share: ArrayLike, apart: ArrayLike, spread: Moments, beamlets: int
) -> Change:
    """What the other surfaces' ranges can change in the largest bin of a segment, as powers.

    With a power share f beside the axis's surface, whose own lines put a in their largest bin:
    with the effect that bin holds a at the least, and no bin more than a + f; without it the
    largest holds a at the least, and a and f's line on the axis at the most.

    Parameters
    ----------
    line : Line
        Of the axis.
    share : array_like
        f, 0..1, of the echo power of the footprint.
    apart : array_like
        Largest distance of other surfaces' lines from the axis's [bins].
    spread : Moments
        Of the offsets on the axis's surface [bins].
    beamlets : int
        Their number.
    """
    f, apart = np.clip(np.asarray(share, float), 0.0, 1.0), np.asarray(apart, float)
    own = (1 - f) * power_range(line, spread, beamlets)[0]
    _, on_axis = power_range(line, NO_SPREAD, beamlets)
    elsewhere = np.fmin(np.exp(np.minimum(line.tilt * apart, 50.0)), line.transfer**-2.0)
    elsewhere = elsewhere * image_factor(line, apart)
    with np.errstate(divide="ignore", invalid="ignore"):
        less, more = own / (own + f * on_axis), 1 + f * elsewhere / own
    there = (f > 0) & (apart > 0)
    return Change(signal=(np.sqrt(np.where(there, less, 1.0)), np.sqrt(np.where(there, more, 1.0))))


def without(shots: Shots, others: np.ndarray) -> Shots:
    """The same points with the beamlets on other surfaces at the axis's range and velocity.

    Parameters
    ----------
    others : (rows, beamlets) bool ndarray
        Those that do not lie on the axis's surface.
    """
    return replace(
        shots,
        offset=np.where(others, 0.0, shots.offset),
        doppler=np.where(others, 0.0, shots.doppler),
    )
