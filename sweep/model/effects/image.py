"""Image and folding: the real record's line at -f, which reaches the bins of f near DC and Nyquist.

X[k] has W(k - nu) and, conjugated, W(k + nu); past Nyquist the line that is seen is the image of
one that is not. Without the effect only the kernel of the folded line itself is summed, where it
is seen. It acts on the spectrum. Its size follows from the envelope E of the window's sidelobes:
with all light of a line, wherever footprint and record put it, e bins from the edge (DC or Nyquist)
or further, bins within e/2 have images at most E(3/2 e) high, and all others at most E(e/2) + E(e)
altogether.

A bin at the threshold, far down the lines' sidelobes, is smaller than the largest by far, and moved
by an image that the largest does not feel. It then belongs to the detection, or does no more, and
of the bins that may raise a false alarm there is one fewer or more. With lines d bins away such a
bin has images at 2 e - d; if these move it by a share x of the threshold, it must lie that near,
and bins whose sidelobes fall no slower than 1/d lie there with a chance of x d.
"""

import math
from dataclasses import replace

import numpy as np

from sweep.model.effects.effect import Effect, Scene, Size
from sweep.model.effects.points import Points
from sweep.model.preparation import PROCESSING, Shots

_LN_10 = math.log(10)
_SELDOM = 1e-4
"""Expected bins at the threshold of a shot that are not reckoned with."""


def size(points: Points) -> Size:
    """What images change in the largest bin.

    Where amplitudes add, the sum may be anything, and what images add to any bin of 0..N/2 is at
    most E(e) of all lines in phase.
    """
    alarms = alarm_change(points)
    if points.adds_amplitudes:
        return Size(added=points.image, alarms=alarms)
    form, apart = points.lobe, points.apart
    least = points.powers[0] / (1 + 2 * points.smeared / points.margin)
    outside = form.tail(apart)
    inside, beside = form.tail(1.5 * apart), form.tail(0.5 * apart)
    far = beside * beside + outside * outside
    power = np.maximum(inside * inside, np.maximum(far - least, 0.0)) / least
    return Size(magnitude=np.sqrt(1 + power) - 1, alarms=alarms)


def alarm_change(points: Points) -> np.ndarray | float:
    """Change of log10 pfa of a shot by the bins that images move across the threshold.

    That of one bin, or of as many as are to be expected were lines anywhere between two bins; 0
    where fewer than ``_SELDOM`` are.
    """
    if points.word(PROCESSING + "bins_counted") == "all":
        return 0.0
    form, half = points.lobe, points.fft_size / 2
    chirps = slice(None, None, 2) if len(points.signs) == 3 else slice(None)
    extreme = np.minimum(points.spread.extreme + points.smeared, half)
    whole = np.maximum(points.level * points.footprint.gain, 1e-300)
    away = np.minimum(form.within(points.threshold / whole), half)
    moved: np.ndarray | float = 0.0
    for distance in (np.maximum(2 * points.apart - away, points.apart), 2 * points.apart + away):
        share = np.minimum(whole * form.tail(distance) / points.threshold, 1.0)
        moved = moved + (share if points.adds_amplitudes else share * share / 2)
    reach = away + extreme
    bins = (moved * reach)[chirps].sum(axis=0)
    left = np.maximum(half - 2 * reach[chirps].max(axis=0) - 4, 1.0)
    return np.where(bins > _SELDOM, np.maximum(bins, 1.0) / (_LN_10 * left), 0.0)


def act(shots: Shots, scene: Scene) -> Shots:
    """Images summed with the lines."""
    return replace(shots, image=True)


EFFECT = Effect(
    name="image",
    about="lines at negative frequencies, near DC and Nyquist",
    stage="spectrum",
    size=size,
    act=act,
)
