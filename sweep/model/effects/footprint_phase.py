"""Footprint phase: beamlets of a smooth surface add as amplitudes, with the phases of its shape.

The round trip to beamlet b differs by 4 pi/lambda (R_b - R_0) in phase. Where that is not small
against 1 the sum may be anything from nothing to sqrt(N) times (Cauchy and Schwarz) what the
powers make; where it is, beamlets add in phase to g = sum a_b / sqrt(sum a_b^2) times that, less

    1 - |sum a_b e^{i phi_b}| / sum a_b <= max phi_b^2 / 2.

It acts on the sum of the lines: without it their powers add.
"""

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from sweep.model.effects.change import Change
from sweep.model.effects.columns import columns
from sweep.model.effects.effect import Effect, Scene
from sweep.model.effects.line_powers import uphill_of
from sweep.model.effects.line_spread import Line, Moments
from sweep.model.effects.lobes import lobe_tail
from sweep.model.effects.span import Span
from sweep.model.preparation import Shots

if TYPE_CHECKING:
    from sweep.model.effects.block import Block


def phase_reach(block: "Block", ranges: Moments, velocities: Moments) -> np.ndarray:
    """Largest phase of a beamlet against the axis's at the record's middle [rad], (3, tiles).

    2 pi f tau_b with f the optical frequency then, which is between the carrier and a bandwidth
    from it; pi for each bin of the window's by which its velocity moves its line.

    Parameters
    ----------
    block : Block
        The tiles.
    ranges : Moments
        Of (R_b - R_0) / R_0.
    velocities : Moments
        Bins by which velocities put the lines off the axis's.
    """
    away = block.range.high * np.asarray(ranges.extreme, float)
    further = block.most_turns * away
    return np.asarray(further + velocities.extreme * block.turn_of_bin)


def sum_change(
    line: Line,
    *,
    phase: np.ndarray,
    gain: Span,
    spread: Moments,
    most: ArrayLike = np.inf,
    beamlets: float = np.inf,
) -> Change:
    """What phases can change in the largest bin of amplitudes that add.

    Parameters
    ----------
    line : Line
        Of the axis.
    phase : ndarray
        :func:`phase_reach` [rad].
    gain : Span
        g, of the footprint: 1..sqrt(N).
    spread : Moments
        Bins by which ranges and velocities put the lines off the axis's.
    most : array_like
        What no phases can exceed.
    beamlets : float
        As many as there are, whose powers without phases, with their images, the sum is told by.
    """
    f = line.lobe
    table, shape = columns(
        line.edge, line.tilt, spread.extreme, phase, gain.low, gain.high, most
    )  # fmt: skip
    found = np.empty((2, *shape))
    sizes = f.curvature, f.margin, f.worst
    put_sum_changes(table, sizes, (f.reach, f.envelope), float(beamlets), found.reshape(2, -1))
    return Change(signal=(found[0], found[1]))


@njit(cache=True, error_model="numpy")
def put_sum_changes(table, sizes, lobe, beamlets, out):
    """Least and largest factor on magnitudes, (2, n)."""
    (curvature, margin, worst), (reach, envelope) = sizes, lobe
    for i in range(table.shape[1]):
        edge, poles, extreme, phase, less, more, most = table[:, i]
        apart = edge - extreme
        # by how much a bin may differ from line to line
        tilt = np.sqrt(curvature) * extreme / worst + poles * extreme
        near = 2 * apart < 8 * margin
        most = np.fmin(most, np.sqrt(beamlets * (2.0 if near else 1.01)))
        out[0, i], out[1, i] = 0.0, most
        if tilt < 0.5 and not near:
            image = lobe_tail(reach, envelope, 2 * apart - 1) / worst
            low = less * (1 - phase * phase / 2) * (1 - tilt) - more * image
            out[0, i] = low if low > 0 else 0.0
            out[1, i] = np.fmin(more * ((1 + tilt) / (1 - tilt) + image), most)


def sum_added(block: "Block", lines: Line, bins: ArrayLike) -> np.ndarray:
    """What moving lines whose amplitudes add can change at most, of their magnitude in phase.

    A line moved by some bins changes by these times |W'|, |H'| and the phase at the record's
    middle.

    Parameters
    ----------
    block : Block
        The tiles.
    lines : Line
        Of the axis, with or without the effect.
    bins : array_like
        Largest distance that it moves any line, (3, tiles).
    """
    table, shape = columns(lines.tilt, block.spread.extreme, bins, block.turn_of_bin)
    found, lobe = np.empty(shape), lines.lobe
    put_sums_added(table, math.sqrt(lobe.curvature), lobe.worst, found.reshape(-1))
    return found


@njit(cache=True, error_model="numpy")
def put_sums_added(table, steepest, worst, out):
    """Largest changes of sums, (n,)."""
    for i in range(out.size):
        tilt, extreme, bins, turn = table[:, i]
        out[i] = 0.0
        if bins > 0.0:
            each = (steepest + 2 * tilt + turn) * bins
            # with its image, as its magnitude may lie between two bins
            out[i] = 2 * uphill_of(tilt, extreme + bins) * np.minimum(each, 2.0) / worst


def bound(block: "Block") -> Change | None:
    """What phases can change in the largest bin."""
    if not block.coherent or block.architecture == "direct":
        return None
    return sum_change(
        block.lines,
        phase=phase_reach(block, block.ranges, block.spreads.velocities),
        gain=block.gain,
        spread=block.spread,
        beamlets=block.number,
    )


def act(shots: Shots, scene: Scene) -> Shots:
    """Beamlets that add as amplitudes, where the spec says that their phases follow the surface."""
    if str(scene.parameters["footprint.phases"]) != "coherent":
        return shots
    return replace(shots, incoherent=False)


EFFECT = Effect(
    name="footprint_phase",
    about="optical phases of a smooth surface",
    stage="lines",
    bound=bound,
    act=act,
    within="footprint",
)
