"""How finely a footprint on a plane is sampled: as many beamlets as the accuracy asked for needs.

``footprint.beamlets`` 0 leaves their number to ``accuracy.tolerance``. Where powers add, the
largest bin's magnitude r is then within a share of itself such that pd is within a quarter of the
tolerance: with b the threshold over sigma,

    |d Q_1(a, b) / d ln a| <= sqrt(a b / (2 pi)),   a (a - b) = 1/2 at its largest,

in each of three segments. Most of the rest is the effects' (:mod:`.effects.planning`).
Where amplitudes add over a smooth plane no number is enough, as what is summed all but cancels:
what [T] takes, 109, is then taken.

In a flight each beamlet is a ray, and nothing is known of the ground before they are cast: few are
(:func:`rays_needed`), what these leave is estimated from what they hit (:mod:`.ray_error`), and
shots of which that is too much are cast again with more (:func:`more_rays`).
"""

from collections.abc import Collection, Iterator, Mapping
from typing import Any

import numpy as np

from sweep.model import detection, ground, quadrature
from sweep.model.accuracy import Accuracy
from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.effects.spread import (
    plane_range_moments,
    plane_velocity_moments,
    range_to_bins,
    velocity_to_bins,
)
from sweep.model.preparation import (
    BEAMLETS_ERROR,
    CHIRP,
    LASER,
    PROCESSING,
    Parameters,
    categories,
    doppler_ratio,
)
from sweep.model.window import canonical_name

BEAMLETS = "footprint.beamlets"
PATTERN = "footprint.pattern"

_LEAST_STEP, _MOST_STEP = 2, 10
"""Times as many rays at the least, and at the most, as have told that they are too few."""

_UNSURE = 19
"""Rays up to which smooth ground is taken for far rougher than it is: how much is no measure."""

_SEGMENTS = 3


def resolved_categories(
    parameters: Parameters, effects: Collection[str], further: Collection[str] = ()
) -> Iterator[tuple[np.ndarray, dict[str, np.ndarray]]]:
    """Points by category, their beamlets counted where that is left to the tolerance.

    Parameters
    ----------
    parameters, further
        As of :func:`sweep.model.preparation.categories`, whose result this is like.
    effects : collection of str
        Names of the effects that are simulated; without a footprint one beamlet is all.
    """
    for index, p in categories(parameters, further):
        if int(p[BEAMLETS]) > 0:
            yield index, p
            continue
        number, pattern, error = np.asarray(1), np.asarray("line"), np.asarray(0.0)
        if "footprint" in effects:
            if is_open(p):
                number, pattern, error = beamlets_needed(p, index.size)
            else:
                number, pattern = map(np.asarray, finest(p))
        chosen = {BEAMLETS: number, PATTERN: pattern, BEAMLETS_ERROR: error}
        for some, q in categories(p | chosen, further):
            yield index[some], q


def finest(words: Mapping[str, Any]) -> tuple[int, str]:
    """Most beamlets that points with these words may be given, and their pattern."""
    if is_open(words):
        return Accuracy.most_beamlets, "line"
    return Accuracy.thesis_beamlets, ground.pattern(words)


def rays_needed(words: Mapping[str, Any], accuracy: Accuracy) -> int:
    """Rays that every shot of a flight has that leaves their number to the tolerance.

    Parameters
    ----------
    words : mapping
        Phases and pattern of the footprint, architecture of the receiver.
    accuracy : Accuracy
        Of the study.
    """
    if not is_open(words):
        return accuracy.thesis_beamlets
    tolerance = float(np.asarray(accuracy.tolerance))
    return next(number for least, number in accuracy.fewest_rays if tolerance >= least)


def more_rays(rays: int, error: np.ndarray, accuracy: Accuracy) -> np.ndarray:
    """Rays that shots are to be cast with again, (n,) int64; 0 where they have enough.

    Parameters
    ----------
    rays : int
        One of `accuracy.rays`, which shots have had.
    error : (n,) ndarray
        What these leave (:func:`sweep.model.ray_error.ray_error`), which falls about as one over
        their number; nan where nothing is seen.
    accuracy : Accuracy
        Of the study.
    """
    further = np.array([n for n in accuracy.rays if n > _LEAST_STEP * rays], np.int64)
    over = np.asarray(error, float) / accuracy.for_rays
    if not further.size:
        return np.zeros(over.shape, np.int64)
    wanted = rays * np.minimum(over, _MOST_STEP if rays > _UNSURE else 1)
    place = np.minimum(np.searchsorted(further, wanted), further.size - 1)
    return np.where(over > 1, further[place], 0)


def effects_tolerance(words: Mapping[str, Any], number: int) -> float:
    """What is left of a study's tolerance for the effects that are left out."""
    counts_beamlets = number == 0 and is_open(words)
    return float(Accuracy.of(words).for_effects(counts_beamlets=counts_beamlets))


def by_tolerance(parameters: Mapping[str, Any]) -> np.ndarray:
    """Where the tolerance alone says how finely points are computed, effects apart; or a scalar."""
    counts_beamlets = ~(parameters[BEAMLETS] > np.asarray(0))
    return counts_beamlets | Accuracy.of(parameters).follows_tolerance


def is_open(words: Mapping[str, Any]) -> bool:
    """Whether there is a number of beamlets that is enough."""
    return ground.powers_add(words) and str(words[PATTERN]) not in ("hexagonal", "sunflower")


def beamlets_needed(
    p: Mapping[str, np.ndarray], size: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Beamlets of points whose powers add: number, pattern, and error that is left, (n,) each.

    The error is that of the probabilities of detection, summed over the segments.
    """
    per_power, accuracy = _pd_for_power(p) + np.zeros(size), Accuracy.of(p)
    allowed = accuracy.for_beamlets / per_power
    lines, number, error = quadrature.nodes_needed(
        _window(p), _spread(p, size, accuracy.most_beamlets), allowed, accuracy
    )
    several = np.char.add(lines.astype(str), " lines")
    return (
        lines * number,
        np.where(lines == 1, "line", several),
        np.minimum(error * per_power, 1.0),
    )


def _pd_for_power(p: Mapping[str, np.ndarray]) -> np.ndarray:
    """Most that pd changes, summed over the segments, for the relative change of a bin's power."""
    b = detection.threshold(tnr=p[PROCESSING + "tnr"], bin_deviation=np.asarray(1.0))
    a = 0.5 * (b + np.sqrt(b * b + 2))
    steepest = np.maximum(np.sqrt(a * b / (2 * np.pi)), 1.0)
    return np.asarray(_SEGMENTS * steepest / 2)


def _spread(p: Mapping[str, np.ndarray], size: int, most: int) -> quadrature.Spread:
    """Spread of the lines of up, Doppler and down segment [bins of fs/L]."""
    angle, along = p["target.grazing_angle"], np.asarray(p["target.radial_velocity"], float)
    divergence = np.asarray(p[LASER + "beam_divergence"], float)
    across = np.asarray(p["target.transverse_velocity"], float)
    sigma, slope = divergence / 4, divergence / 4 / np.tan(angle)
    bins = p[PROCESSING + "sample_rate"] / p["record"]
    rate = p[CHIRP + "bandwidth"] / p[CHIRP + "duration"]
    shape: dict[str, Any] = {
        "grazing_angle": angle, "beam_divergence": divergence, "number": most, "pattern": "line",
    }  # fmt: skip
    # Beyond the horizon the moments have no bound: there the plain one has to do.
    rms = plane_range_moments(**shape).rms
    rms = np.where(np.isfinite(rms), rms, slope)
    velocity = plane_velocity_moments(across=across, along=along, **shape).rms
    per_range = range_to_bins(
        range=p["target.range"], beta=doppler_ratio(along), chirp_rate=rate, bin_width=bins
    )
    per_speed = velocity_to_bins(
        range=p["target.range"],
        carrier=SPEED_OF_LIGHT / p[LASER + "wavelength"] + p[CHIRP + "bandwidth"],
        chirp_rate=rate,
        bin_width=bins,
    )
    signs, nothing = np.array([[1.0], [0.0], [-1.0]]), np.zeros(size)  # of ranges in the beats
    return quadrature.Spread(
        deviation=per_range * rms + per_speed * velocity + nothing,
        slope=abs(per_speed * across * sigma + signs * per_range * slope) + nothing,
        curve=abs(per_speed * along + signs * per_range) * (sigma**2 / 2) + nothing,
    )


def _window(p: Mapping[str, np.ndarray]) -> str:
    return canonical_name(str(p[PROCESSING + "window"]))
