"""Light far from its line: images at negative frequencies, and leakage into further bins.

**Images**: the real record's line at -f, which reaches the bins of f near DC and Nyquist.

X[k] has W(k - nu) and, conjugated, W(k + nu); past Nyquist the line that is seen is the image of
one that is not. Without the effect only the kernel of the folded line itself is summed, where it is
seen. It acts on the spectrum. Its size follows from the envelope E of the window's sidelobes. Let
all light of a line, wherever footprint and record put it, be e bins from the edge (DC or Nyquist)
or further. Then bins within e/2 have images at most E(3/2 e) high, and all others at most E(e/2) +
E(e) altogether.

A bin at the threshold, far down the lines' sidelobes, is smaller than the largest by far, and moved
by an image that the largest does not feel. It then belongs to the detection, or does no more, and
of the bins that may raise a false alarm there is one fewer or more. With lines d bins away such a
bin has images at 2 e - d; if these move it by a share x of the threshold, it must lie that near.
Bins whose sidelobes fall no slower than 1/d lie there with a probability of x d.

**Leakage**: extra groups raised by the signal's own bins below the threshold.

It changes no detecting bin, and so no detection probability; it is what ``p_leakage`` holds. It
acts on the detection: without it only bins of the groups are evaluated. By the union bound

    p_leakage <= sum_k (Q_1(a_k, b) - Q_1(0, b)) / (1 - Q_1(0, b)),   a_k <= min(A E_k, b),

over the bins that may leak, with A the magnitude of all lines together, E_k the largest |W| at
the distances that light may have from bin k, and b the threshold, all over sigma. Not among them
are the detecting bin and its neighbours. By Parseval's theorem the bins have no more power together
than ENBW times A^2, and the probability rises faster than a^2. So the sum is at most ENBW times
that of one bin of A, or A^2 / b^2 times that of one at the threshold.
"""

import math
from dataclasses import replace
from functools import lru_cache

import numpy as np

from sweep.model.effects.effect import Effect, Scene, Size
from sweep.model.effects.lobes import lobe
from sweep.model.effects.points import Points
from sweep.model.looks import ONE, Looks
from sweep.model.preparation import PROCESSING, RECORD, Shots
from sweep.model.window import window

_LN_10 = math.log(10)
_HUGE = 1e12
_SELDOM = 1e-4
"""Expected bins at the threshold of a shot that are not reckoned with."""


def image_size(points: Points) -> Size | None:
    """Change of the largest bin by images; complex records have none.

    If amplitudes add, the sum may be anything, and what images add to any bin of 0..N/2 is at
    most E(e) of all lines in phase.
    """
    if points.word(RECORD) == "complex":
        return None
    alarms, apart = _alarm_change(points), points.apart
    beside = _beside(points)
    if points.adds_amplitudes:
        return Size(added=points.image, alarms=alarms, beside=beside)
    least = points.left_of(points.powers[0] / (1 + 2 * points.smeared / points.margin))
    outside = points.tail(apart)
    inside, further = points.tail(1.5 * apart), points.tail(0.5 * apart)
    far = further * further + outside * outside
    power = np.maximum(inside * inside, np.maximum(far - least, 0.0)) / least
    return Size(magnitude=np.sqrt(1 + power) - 1, alarms=alarms, beside=beside)


def _beside(points: Points) -> np.ndarray:
    """Change of leakage by images that add as powers: of a bin at the threshold, or of all bins.

    These cross with probabilities of y e^-y a^2 / 2 where a is small, y = b^2 / 2. Images fall no
    slower than 1 / k from ``apart`` on, so all bins have ``apart`` times the nearest's a^2.
    """
    image = points.level * points.footprint.gain * points.tail(points.apart)
    square, b = np.minimum(image, _HUGE) ** 2, points.threshold
    y = 0.5 * b * b
    alone = np.minimum(square / b, np.sqrt(square))
    return np.maximum(alone, 0.5 * square * points.apart * np.minimum(y / np.expm1(y), 1.0))


def _alarm_change(points: Points) -> np.ndarray | float:
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
    if points.missing is not None:  # sidelobes of an echo that begins with a step
        step = np.maximum(whole * points.missing.step, 1e-300)
        edge = lobe("rectangular", points.window.length, points.fft_size)
        away = np.minimum(
            np.maximum(
                form.within(0.5 * points.threshold / whole),
                edge.within(0.5 * points.threshold / step) + points.margin,
            ),
            half,
        )
    moved: np.ndarray | float = 0.0
    for distance in (np.maximum(2 * points.apart - away, points.apart), 2 * points.apart + away):
        share = np.minimum(whole * points.tail(distance) / points.threshold, 1.0)
        moved = moved + (share if points.adds_amplitudes else share * share / 2)
    reach = away + extreme
    bins = (moved * reach)[chirps].sum(axis=0)
    left = np.maximum(half - 2 * reach[chirps].max(axis=0) - 4, 1.0)
    return np.where(bins > _SELDOM, np.maximum(bins, 1.0) / (_LN_10 * left), 0.0)


def add_images(shots: Shots, scene: Scene) -> Shots:
    """Images summed with the lines, where the record is real."""
    return replace(shots, image=not shots.complex_record)


IMAGE = Effect(
    name="image",
    about="lines at negative frequencies, near DC and Nyquist",
    stage="spectrum",
    size=image_size,
    act=add_images,
)


_REACHES = (0.0, 0.25, 0.5, 1.0, 2.0, 4.0, 16.0)
"""Bins that light may be moved by, up to which there is a table each."""
_OCTAVES, _FAINTEST, _STRONGEST = 2, -8, 30
"""Rows an octave of A over the threshold, and where they begin and end."""
_LEVELS = 1.04
"""Thresholds have the table of the next lower of some, so far apart."""
_NEAR, _FAR = 48, 24
"""Bins that are looked at one by one, and stretches beyond."""
_IMAGES = 1.1
"""Factor that images may put to sidelobes far from the edge; near it twice as much."""


def leakage_size(points: Points) -> Size:
    """Probability that leaked signal raises an extra group, in all segments together."""
    b, near = points.threshold, points.near_image
    over = points.level * points.footprint.gain * np.where(near, 2.0, _IMAGES) / b
    over = np.where(np.isnan(over), np.inf, over)
    reach = np.where(near, np.inf, points.spread.extreme + points.smeared)
    if points.missing is None:
        return Size(chance=_chance(points, points.window.name, over, reach))
    # Sidelobes of two kinds, of which one is the larger in any bin.
    late = 2 * over * points.missing.step
    chance = _chance(points, points.window.name, 2 * over, reach)
    return Size(chance=chance + _chance(points, "rectangular", late, reach + points.margin))


def _chance(points: Points, window_name: str, over: np.ndarray, reach: np.ndarray) -> np.ndarray:
    """Probability in all segments together, of sidelobes of a window.

    By their lines' magnitude over the threshold, and the bins that light may be moved by.
    """
    b, row = points.threshold, np.searchsorted(_REACHES, reach)
    octave = np.clip(np.log2(over), _FAINTEST, _STRONGEST)
    place = np.minimum((octave - _FAINTEST) * _OCTAVES + 1, (_STRONGEST - _FAINTEST) * _OCTAVES)
    place = place.astype(np.int64)
    step = np.floor(np.log(np.clip(b, 1e-3, 1e4)) / math.log(_LEVELS))
    steps, which = np.unique(step, return_inverse=True)
    length = points.window.length
    tables = np.array([
        table(window_name, length, points.fft_size, _LEVELS**float(v), points.looks)
        for v in steps
    ])  # fmt: skip
    chance = tables[which.reshape(np.shape(b)), row, place]
    faint = np.minimum(over / 2.0**_FAINTEST, 1.0) ** 2
    return np.asarray((chance * faint).sum(axis=0))


@lru_cache(maxsize=256)
def table(name: str, length: int, fft_size: int, level: float, looks: Looks = ONE) -> np.ndarray:
    """Probabilities by reach and octaves of A over the threshold, the last row by Parseval."""
    form, rows = lobe(name, length, fft_size), (_STRONGEST - _FAINTEST) * _OCTAVES + 1
    together = level * 2.0 ** (np.arange(rows) / _OCTAVES + _FAINTEST)
    quiet = looks.steady(np.zeros(1), np.array([level]))[0][0]
    enough = _crossing(np.minimum(together, level), level, quiet, looks)
    energy = window(name, length).equivalent_noise_bandwidth * form.margin
    parseval = enough * np.maximum(together / level, 1.0) ** 2 * energy
    half = fft_size / 2
    edges = np.unique(np.round(np.geomspace(_NEAR, max(half, _NEAR + 1), _FAR)))
    distance = np.concatenate([np.arange(2.0, _NEAR), edges[:-1]])
    number = np.concatenate([np.ones(_NEAR - 2), np.diff(edges)])
    found = [
        2 * (_crossing(np.minimum(together[:, None] * form.tail(distance - 0.5 - reach), level),
                       level, quiet, looks) * number).sum(axis=1)
        for reach in _REACHES
    ]  # fmt: skip
    return np.minimum(np.minimum([*found, parseval], parseval), 1.0)


def _crossing(signal: np.ndarray, level: float, quiet: float, looks: Looks) -> np.ndarray:
    """Probability to cross the threshold that a bin of some signal has more than one without."""
    chance = looks.steady(signal, np.full(signal.shape, level))[0]
    return np.maximum(chance - quiet, 0.0) / max(1 - quiet, 1e-12)


def look_beside(shots: Shots, scene: Scene) -> Shots:
    """Bins evaluated on either side of the detection."""
    return replace(shots, leakage=True)


LEAKAGE = Effect(
    name="leakage",
    about="further groups raised by sidelobes below the threshold",
    stage="detection",
    size=leakage_size,
    act=look_beside,
)
