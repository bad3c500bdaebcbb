"""Image and folding: the real record's line at -f, which reaches the bins of f near DC and Nyquist.

X[k] has W(k - nu) and, conjugated, W(k + nu); past Nyquist the line that is seen is the image of
one that is not. Without the effect only the kernel of the folded line itself is summed, where it
is seen. It acts on the spectrum. Bound by the envelope E of the window's sidelobes: with a
footprint that keeps e bins from the edge (DC or Nyquist), bins within e/2 of its lines have
images at most E(3/2 e) high, and all others at most E(e/2) + E(e) altogether.
"""

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from sweep.model.effects.change import Change
from sweep.model.effects.effect import Effect, Scene
from sweep.model.effects.line_spread import power_range
from sweep.model.preparation import Shots

if TYPE_CHECKING:
    from sweep.model.effects.block import Block


def bound(block: "Block") -> Change:
    """What images can change in the largest bin.

    Where amplitudes add, the sum may be anything, and what images add to any bin of 0..N/2 is at
    most E(e) of all lines in phase.
    """
    line, spread = block.lines, block.spread
    apart = line.edge - np.asarray(spread.extreme, float)
    inside, beside, outside = (line.lobe.tail(m * apart) for m in (1.5, 0.5, 1.0))
    least_power, _ = power_range(line, spread, block.number)
    with np.errstate(divide="ignore", over="ignore"):
        far = (beside**2 + outside**2) / least_power
        high = np.sqrt(np.maximum(1 + inside**2 / least_power, far))
    if not block.adds_amplitudes:
        return Change(signal=(1.0, high))
    uphill = np.exp(np.minimum(line.tilt * np.asarray(spread.extreme), 50.0))
    added = uphill * outside / line.lobe.least(line.bin_offset)
    return Change(signal=(1.0, 1.0 if block.architecture == "direct" else high), added=added)


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
