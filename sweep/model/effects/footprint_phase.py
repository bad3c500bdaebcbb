"""Footprint phase: beamlets of a smooth surface add as amplitudes, with the phases of its shape.

The round trip to beamlet b differs by 4 pi/lambda (R_b - R_0) in phase. Where that is not small
against 1 the sum may be anything from nothing to sqrt(N) times (Cauchy and Schwarz) what the
powers make; where it is, beamlets add in phase to g = sum a_b / sqrt(sum a_b^2) times that, less

    1 - |sum a_b e^{i phi_b}| / sum a_b <= max phi_b^2 / 2.

It acts on the sum of the lines: without it their powers add.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.effects.change import Change
from sweep.model.effects.line_spread import Line, Moments
from sweep.model.preparation import Shots


def phase_reach(
    *,
    carrier: ArrayLike,
    bandwidth: ArrayLike,
    range: ArrayLike,
    ranges: Moments,
    velocity_bins: Moments,
    record_ratio: ArrayLike,
) -> np.ndarray:
    """Largest phase of a beamlet against the axis's at the record's middle [rad], (n,).

    2 pi f tau_b with f the optical frequency then, which is between the carrier and a bandwidth
    from it; pi for each bin of the window's by which its velocity moves its line.

    Parameters
    ----------
    carrier, bandwidth, range : array_like
        [Hz], [Hz], [m].
    ranges : Moments
        Of (R_b - R_0) / R_0.
    velocity_bins : Moments
        Bins by which velocities put the lines off the axis's.
    record_ratio : array_like
        Bins from there to cycles: (t_0 + L / (2 fs)) fs / N, at L = N and no delay 1/2.
    """
    highest = np.asarray(carrier, float) + 2 * np.asarray(bandwidth, float)
    away = np.asarray(range, float) * np.asarray(ranges.extreme, float)
    further = 4 * np.pi * highest / SPEED_OF_LIGHT * away
    return np.asarray(further + 2 * np.pi * np.multiply(velocity_bins.extreme, record_ratio))


def bound(
    line: Line,
    *,
    phase: ArrayLike,
    gain: ArrayLike,
    spread: Moments,
    beamlets: int,
) -> Change:
    """What phases can change in the largest bin of a segment.

    Parameters
    ----------
    line : Line
        Of the axis.
    phase : array_like
        :func:`phase_reach` [rad].
    gain : array_like
        g, of the footprint: 1..sqrt(N).
    spread : Moments
        Bins by which ranges and velocities put the lines off the axis's.
    beamlets : int
        N.
    """
    phase, g = np.asarray(phase, float), np.asarray(gain, float)
    f, extreme = line.lobe, np.asarray(spread.extreme, float)
    apart = line.edge - extreme
    near = 2 * apart < 8 * f.margin
    worst = f.least(np.asarray(0.5))
    image = f.tail(2 * apart - 1) / worst
    with np.errstate(invalid="ignore", over="ignore"):
        # by how much a bin may differ from line to line
        tilt = np.sqrt(f.curvature) * extreme / worst + line.tilt * extreme
        low = g * (1 - phase**2 / 2) * (1 - tilt) - g * image
        high = g * ((1 + tilt) / (1 - tilt) + image)
    tight = ~near & (tilt < 0.5)
    most = np.sqrt(beamlets * np.where(near, 2.0, 1.01))
    low = np.where(tight & (low > 0), low, 0.0)
    return Change(signal=(low, np.where(tight, np.fmin(high, most), most)))


def gain(shots: Shots) -> np.ndarray:
    """Gain g of each footprint, (n,): worked out once a row of the geometry."""
    echo = shots.amplitude
    with np.errstate(invalid="ignore"):
        rows = echo.sum(axis=1) / np.sqrt((echo**2).sum(axis=1))
    return np.asarray(np.where(rows > 0, rows, 1.0)[shots.row])


def without(shots: Shots) -> Shots:
    """The same points with beamlets that add as powers.

    Raises
    ------
    ValueError
        For direct detection, whose beats are of one radio frequency and add in any case.
    """
    if shots.architecture == "direct":
        raise ValueError("direct detection adds beats, not powers: its phases cannot be left out")
    return replace(shots, incoherent=True)
