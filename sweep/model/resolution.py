"""Number of a footprint's beamlets: as many as the accuracy asked for needs.

``footprint.beamlets`` 0 leaves their number to ``accuracy.tolerance``. If powers add, the
largest bin's magnitude r is then within a share of itself such that pd is within a quarter of the
tolerance: with b the threshold over sigma,

    |d Q_1(a, b) / d ln a| <= sqrt(a b / (2 pi)),   a (a - b) = 1/2 at its largest,

in each of three segments. Most of the rest is the effects' (:mod:`.effects.planning`).
If amplitudes add over a smooth plane no number is enough, as what is summed all but cancels:
what [T] takes, 109, is then taken.

In a flight each beamlet is a ray, and nothing is known of the ground before they are cast. Few are
(:func:`rays_needed`), what these leave is estimated from what they hit (:mod:`.ray_error`), and
shots of which that is too much are cast again with more (:func:`more_rays`).

If beamlets add as powers, the mean power of a bin is that of |W(k - f)|^2 over the beam, f being
nearly proportional to one coordinate along the slope. The function |W|^2 is band-limited. With r
the window's autocorrelation over lags of -1..1 records, normalised to sum 1, and s the deviation of
f in bins of fs/L, a rule of nodes x_j and weights w_j is off by

    integral |r(tau)| |sum_j w_j cos(2 pi s tau x_j) - exp(-(2 pi s tau)^2 / 2)| dtau

at most, in units of the power that one line on a bin has there: by what the rule makes of cosines
up to 2 pi s. Gauss and Hermite's rule is best for narrow spreads; for wide ones even steps are, as
they are all but exact up to where they alias.

To second order the range rises with the square of the distance from the axis, across the slope as
along it. So f = s y + c (x^2 + y^2), where E exp(i t c x^2) = 1 / sqrt(1 - 2 i t c). A line of
nodes at x = 1 has the mean of x^2, and misses (t c)^2 at the most. More lines lie at the positive
nodes of a rule of twice as many:

    x ^      .  .  .  .  .      3 lines of 5 nodes, weighted by the Gaussians of x and y;
      |      .  .  .  .  .      as f is even in x, there is no need of their mirror images
      |      .  .  .  .  .
      +-----------------------> y, along the slope
"""

import math
from collections.abc import Collection, Iterator, Mapping
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from sweep.model import beam, ground, waveform
from sweep.model.accuracy import Accuracy
from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.effects.lobes import Lobe, lobe
from sweep.model.footprint import (
    HERMITE,
    RULE_REACH,
    gaussian_rule,
    plane_moments,
    velocity_to_bins,
)
from sweep.model.looks import Looks
from sweep.model.preparation import (
    BEAMLETS_ERROR,
    CHIRP,
    LASER,
    PROCESSING,
    Parameters,
    categories,
    doppler_ratio,
)
from sweep.model.threshold import tnr_of
from sweep.model.window import canonical_name, samples

BEAMLETS = "footprint.beamlets"
PATTERN = "footprint.pattern"

_LEAST_STEP, _MOST_STEP = 2, 10
"""Times as many rays at the least, and at the most, as have told that they are too few."""

_UNSURE = 19
"""Rays up to which smooth ground is taken for far rougher than it is: how much is no measure."""

_SEGMENTS = 3

COUNTS = np.array([
    2, 3, 4, 5, 6, 7, 9, 11, 15, 22, 33, 49, 73, 109, 163, 244, 366, 549, 823, 1234, 1851, 2776,
    4096,
])  # fmt: skip
"""Numbers of nodes to choose from; wide steps, as points of different numbers go apart."""

LINES = np.array([1, 2, 3, 5, 7, 11, 16, 24, 32])
"""Numbers of parallel lines of nodes to choose from."""

_FLOOR = 1e-10
"""Error of even steps, for what lies beyond their reach."""
_SAMPLES, _LAGS = 1024, 4096
_CURVES = np.geomspace(1e-6, 100.0, 97)
_CURVED_LAGS, _CURVED_TURNS = 512, np.geomspace(1e-6, 1e3, 512)
_RATIOS = np.geomspace(1e-6, 1e3, 97)
_CHEBYSHEV = np.array([1.4, 1.8, 2.5, 4.0, 8.0])[:, None]


class Spread(NamedTuple):
    """Places of a footprint's lines, s y + c (x^2 + y^2), in bins of fs/L."""

    deviation: np.ndarray
    """(n,): most of |s|, steeper where the plane is, over the segments."""
    slope: np.ndarray
    """(rows, n): |s| of each segment, and of what turns from one to another."""
    curve: np.ndarray
    """(rows, n): |c| likewise."""

    @property
    def smoothing(self) -> np.ndarray:
        """Deviation that smooths what lines miss across the slope, (rows, n).

        |E exp(i t (s y + c y^2))| <= exp(-(t s)^2 / 2 / (1 + (2 t c)^2)), and t <= 2 pi.
        """
        return np.asarray(self.slope / np.sqrt(1 + (4 * np.pi * self.curve) ** 2))


def resolved_categories(
    parameters: Parameters, effects: Collection[str], further: Collection[str] = ()
) -> Iterator[tuple[np.ndarray, dict[str, np.ndarray]]]:
    """Points by category, as of :func:`sweep.model.preparation.categories`, with beamlets counted.

    They are counted where their number is left to the tolerance; without the effect of a footprint
    one beamlet is all.
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
                error = np.asarray(np.nan)  # of amplitudes that add nothing is estimated
        chosen = {BEAMLETS: number, PATTERN: pattern, BEAMLETS_ERROR: error}
        for some, q in categories(p | chosen, further):
            yield index[some], q


def finest(words: Mapping[str, Any]) -> tuple[int, str]:
    """Most beamlets that points with these words may be given, and their pattern."""
    if is_open(words):
        return Accuracy.most_beamlets, "line"
    return Accuracy.thesis_beamlets, ground.pattern(words)


def rays_needed(words: Mapping[str, Any], accuracy: Accuracy) -> int:
    """Rays that every shot of a flight has that leaves their number to the tolerance."""
    if not is_open(words):
        return accuracy.thesis_beamlets
    tolerance = float(np.asarray(accuracy.tolerance))
    return next(number for least, number in accuracy.fewest_rays if tolerance >= least)


def more_rays(rays: int, error: np.ndarray, accuracy: Accuracy) -> np.ndarray:
    """Rays that shots are to be cast with again, (n,) int64; 0 where they have enough.

    They have had `rays`, one of `accuracy.rays`, which leave `error` (n,)
    (:func:`sweep.model.ray_error.ray_error`), falling about as one over their number; nan where
    nothing is seen.
    """
    further = np.array([n for n in accuracy.rays if n > _LEAST_STEP * rays], np.int64)
    over = np.asarray(error, float) / accuracy.for_rays
    if not further.size:
        return np.zeros(over.shape, np.int64)
    wanted = rays * np.minimum(over, _MOST_STEP if rays > _UNSURE else 1)
    place = np.minimum(np.searchsorted(further, wanted), further.size - 1)
    return np.where(over > 1, further[place], 0)


def effects_tolerance(words: Mapping[str, Any], number: int) -> float:
    """Return the part of a study's tolerance that is for skipped effects."""
    counts_beamlets = number == 0 and is_open(words)
    return float(Accuracy.of(words).for_effects(counts_beamlets=counts_beamlets))


def by_tolerance(parameters: Mapping[str, Any]) -> np.ndarray:
    """Return true where the tolerance alone sets beamlets, lines or leakage; (n,) or scalar."""
    counts_beamlets = ~(parameters[BEAMLETS] > np.asarray(0))
    return counts_beamlets | Accuracy.of(parameters).follows_tolerance


def is_open(words: Mapping[str, Any]) -> bool:
    """Return true if there is a number of beamlets that is enough."""
    return ground.powers_add(words) and str(words[PATTERN]) not in ("hexagonal", "sunflower")


def beamlets_needed(
    p: Mapping[str, np.ndarray], size: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Beamlets of points whose powers add: number, pattern, and error that is left, (n,) each.

    The error is that of the probabilities of detection, summed over the segments.
    """
    per_power, accuracy = _pd_for_power(p) + np.zeros(size), Accuracy.of(p)
    allowed = accuracy.for_beamlets / per_power
    name = canonical_name(str(p[PROCESSING + "window"]))
    spread = _spread(p, size, accuracy.most_beamlets)
    lines, number, error = nodes_needed(name, spread, allowed, accuracy)
    pattern = np.where(lines == 1, "line", np.char.add(lines.astype(str), " lines"))
    return lines * number, pattern, np.minimum(error * per_power, 1.0)


def _pd_for_power(p: Mapping[str, np.ndarray]) -> np.ndarray:
    """Most that pd changes, summed over the segments, for the relative change of a bin's power."""
    from sweep.model import detection

    b = detection.threshold(tnr=tnr_of(p), bin_deviation=np.asarray(1.0))
    b = Looks.of(p).sharper * b
    a = 0.5 * (b + np.sqrt(b * b + 2))
    steepest = np.maximum(np.sqrt(a * b / (2 * np.pi)), 1.0)
    return np.asarray(_SEGMENTS * steepest / 2)


def _spread(p: Mapping[str, np.ndarray], size: int, most: int) -> Spread:
    """Spread of the lines of up, Doppler and down segment [bins of fs/L]."""
    angle, along = p["target.grazing_angle"], np.asarray(p["target.radial_velocity"], float)
    places, directions = beam.angles(p)
    across = np.asarray(p["target.transverse_velocity"], float)
    sigma, slope, turn = places / 4, places / 4 / np.tan(angle), directions / 4
    bins = p[PROCESSING + "sample_rate"] / p["record"]
    rate = p[CHIRP + "bandwidth"] / p[CHIRP + "duration"]
    ranges, velocities = plane_moments(
        across=across, along=along, grazing_angle=angle, beam_divergence=places, number=most,
        pattern="line", directions=directions,
    )  # fmt: skip
    # Beyond the horizon the ranges' have no bound: there the plain one has to do.
    rms = np.where(np.isfinite(ranges.rms), ranges.rms, slope)
    slopes = 2 / SPEED_OF_LIGHT * np.asarray(rate, float) * (1 + np.abs(doppler_ratio(along)))
    per_range = slopes * p["target.range"] / bins
    carrier = SPEED_OF_LIGHT / p[LASER + "wavelength"] + p[CHIRP + "bandwidth"]
    per_speed = velocity_to_bins(
        range=p["target.range"], carrier=carrier, chirp_rate=rate, bin_width=bins
    )
    # Of ranges in the beats.
    signs, nothing = np.array(waveform.slopes_of(p))[:, None], np.zeros(size)
    spread = Spread(
        deviation=abs(signs).max() * per_range * rms + per_speed * velocities.rms + nothing,
        slope=abs(per_speed * across * turn + signs * per_range * slope) + nothing,
        curve=abs(per_speed * along * (turn / sigma) ** 2 + signs * per_range) * (sigma**2 / 2)
        + nothing,
    )
    if "target.roughness" not in p or not np.any(p["target.roughness"]):
        return spread
    # Amplitudes that are drawn turn against each other from segment to segment, by Doppler shifts
    # and, as the echoes of segments differ in optical frequency, by ranges.
    starts = waveform.segment_starts(
        waveform.order_of("", str(p[waveform.ORDER])),
        duration=p[CHIRP + "duration"], gap=p[waveform.GAP],
    )  # fmt: skip
    later = np.maximum.reduce(starts) * bins
    delay = 2 / SPEED_OF_LIGHT * p["target.range"]
    apart = _carriers_apart(p) * delay
    # Each by twice as much, as sums over records hardly look at their ends.
    slope = np.vstack([spread.slope, 2 * (later * spread.slope[1] + apart * slope)])
    curve = np.vstack([spread.curve, 2 * (later * spread.curve[1] + apart * sigma**2 / 2)])
    moved = 2 * (later * per_speed * velocities.rms + apart * rms) + nothing
    return Spread(np.maximum(spread.deviation, moved), slope, curve)


def _carriers_apart(p: Mapping[str, np.ndarray]) -> np.ndarray:
    """Largest difference between two segments of the optical frequency in mid-record [Hz].

    Equation (1) of :mod:`sweep.model.speckle_correlation`.
    """
    rate = p[CHIRP + "bandwidth"] / p[CHIRP + "duration"]
    length = p["record"] / p[PROCESSING + "sample_rate"]
    middle = p[PROCESSING + "acquisition_delay"] + length / 2
    since = middle - 2 / SPEED_OF_LIGHT * p["target.range"]
    frequencies = [
        carrier + slope * rate * since
        for carrier, slope in zip(waveform.carriers_of(p), waveform.slopes_of(p), strict=True)
    ]
    return np.max(frequencies, axis=0) - np.min(frequencies, axis=0)


def nodes_needed(
    window_name: str, spread: Spread, tolerance: np.ndarray, accuracy: Accuracy
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Nodes with which the largest bin's power is within a tolerance, or as near as any are.

    The tolerance (n,) is on the largest bin's power, over that power itself, wherever the lines
    lie. Returns, (n,) each: parallel lines of nodes, 1 for most points; nodes of each line, 2 at
    least; what they may be off by, 1 where they say nothing.
    """
    spreads, errors, least = _errors(window_name)
    place = np.searchsorted(spreads, spread.deviation)  # of the next wider spread
    missed = _of_one_line(window_name, spread) / least[place]
    counts = COUNTS[: np.searchsorted(COUNTS, accuracy.most_beamlets, "right")]
    total = errors[: counts.size, place] + missed
    rung, error = _cheapest(total, counts[:, None], tolerance)
    lines = np.ones(rung.shape, np.int64)
    several = (error > tolerance) & (missed > accuracy.one_line_share * tolerance)
    if several.any():
        some = Spread(*(np.asarray(values)[..., several] for values in spread))
        rungs, further, left = _of_lines(
            window_name, some, tolerance[several], accuracy.most_beamlets
        )
        better = left < np.minimum(error[several], 1.0)
        some = np.flatnonzero(several)[better]
        rung[some], lines[some], error[some] = rungs[better], further[better], left[better]
    return lines, COUNTS[rung], np.minimum(error, 1.0)


def _cheapest(
    error: np.ndarray, cost: np.ndarray, tolerance: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Row of the cheapest (rows, n) whose error is tolerated, or of the least error; its error."""
    price = np.where(error <= tolerance, cost, np.inf)
    row = np.where(np.isfinite(price).any(axis=0), price.argmin(axis=0), error.argmin(axis=0))
    return row, np.take_along_axis(error, row[None], axis=0)[0]


def _of_lines(
    window_name: str, spread: Spread, tolerance: np.ndarray, most: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Row of :data:`COUNTS`, lines and error for spreads that one line of nodes misses."""
    spreads, errors, least = _errors(window_name)
    along, across = _curved_errors(window_name)
    curve, slope = spread.curve.max(axis=0), spread.slope.max(axis=0)
    # Where squares alone spread the lines, what the rules make of squares is all that counts.
    steep = spread.deviation * np.minimum(slope / curve, 1.0)
    largest = least[np.searchsorted(spreads, spread.deviation)]
    place = np.searchsorted(_CURVES, curve)
    off = errors[:, np.searchsorted(spreads, steep)] + along[:, place] / largest
    missed = np.zeros((LINES.size, curve.size))
    for s, c in zip(spread.smoothing, spread.curve, strict=True):
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = np.searchsorted(_RATIOS, np.where(s > 0, c / s, np.inf))
            smooth = _smoothed_errors()[:, ratio] * (_peak(window_name) / (2 * np.pi * s))
        here = np.fmin(across[:, np.searchsorted(_CURVES, c)], smooth)
        missed = np.maximum(missed, here / largest)
    total = off[:, None] + missed
    cost = COUNTS[:, None] * LINES
    total = np.where((cost <= most)[..., None], total, np.inf).reshape(-1, curve.size)
    best, error = _cheapest(total, cost.reshape(-1, 1), tolerance)
    return best // LINES.size, LINES[best % LINES.size], error


def _of_one_line(window_name: str, spread: Spread) -> np.ndarray:
    """Error of one line of nodes by squares, over the power of a line on a bin, (n,).

    As much again is for what the fewest nodes along the slope miss of them.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        density = _peak(window_name) / (2 * np.pi * spread.smoothing)
        smooth = density * math.sqrt(np.pi / 2) * (spread.curve / spread.smoothing) ** 2
    form = lobe(window_name, _SAMPLES, _SAMPLES)
    return np.asarray(2 * np.fmin(form.curvature * spread.curve**2, smooth).max(axis=0))


@lru_cache(maxsize=32)
def _errors(window_name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Errors of each count by deviation, over the largest bin's power; and that power.

    Deviations (m,), errors (counts, m + 1) up to each and beyond all, largest bins (m + 1,).
    """
    spreads = np.geomspace(1e-3, 400.0, 96)
    least = _largest_bin(lobe(window_name, _SAMPLES, _SAMPLES), spreads)
    lag = (np.arange(_LAGS) + 0.5) / _LAGS
    weight = _autocorrelation(window_name, lag)
    errors = np.empty((COUNTS.size, spreads.size + 1))
    for row, number in zip(errors, COUNTS.tolist(), strict=True):
        row[:] = np.append(_boundless(spreads, number), np.inf)
        for i, spread in enumerate(spreads.tolist()):
            off = (weight * _departure(number, 2 * np.pi * spread * lag)).sum() / least[i]
            if off > 1:
                break  # wider spreads are no better
            row[i] = off
        row[-1] = _boundless(1e3, number)
    return spreads, np.maximum.accumulate(errors, axis=1), np.append(least, least[-1])


def _boundless(spread: ArrayLike, number: int) -> np.ndarray:
    """Stand-in for errors without a bound, 1 or more: the nodes' distance [bins]."""
    return np.maximum(1.0, 2 * RULE_REACH * np.asarray(spread) / number)


@lru_cache(maxsize=32)
def _curved_errors(window_name: str) -> tuple[np.ndarray, np.ndarray]:
    """Errors by curve, over the power of a line on a bin: of counts along, of lines across."""
    lag = (np.arange(_CURVED_LAGS) + 0.5) / _CURVED_LAGS
    weight = _autocorrelation(window_name, lag)
    turn = 2 * np.pi * lag * _CURVES[:, None]

    def of(number: int) -> np.ndarray:
        off = (weight * np.interp(turn, _CURVED_TURNS, _curved_departure(number))).sum(axis=1)
        return np.append(np.where(off < 1, off, _boundless(_CURVES, number)), 1e3)

    along, across = COUNTS.tolist(), (2 * LINES).tolist()
    return np.array([of(number) for number in along]), np.array([of(number) for number in across])


@lru_cache(maxsize=1)
def _smoothed_errors() -> np.ndarray:
    """Mean of what lines miss of squares, over a Gaussian 1 / ratio wide, (lines, ratios + 1)."""
    turn = np.linspace(0.0, 8.0, 801)[1:]
    weight = np.exp(-0.5 * turn**2) * (turn[1] - turn[0])
    found = np.full((LINES.size, _RATIOS.size + 1), np.inf)
    for row, lines in zip(found, LINES.tolist(), strict=True):
        off = np.interp(turn * _RATIOS[:, None], _CURVED_TURNS, _curved_departure(2 * lines))
        row[:-1] = (weight * off).sum(axis=1)
    return found


@lru_cache(maxsize=64)
def _curved_departure(number: int) -> np.ndarray:
    """Largest error of a rule's mean of exp(i turn x^2), 1 / sqrt(1 - 2 i turn), up to turns."""
    x, w = gaussian_rule(number)
    mean = np.array([(w * np.exp(1j * turn * x**2)).sum() for turn in _CURVED_TURNS.tolist()])
    return np.maximum.accumulate(np.abs(mean - 1 / np.sqrt(1 - 2j * _CURVED_TURNS)))


def _largest_bin(shape: Lobe, deviation: np.ndarray) -> np.ndarray:
    """Least power of the largest bin, over that of all lines on a bin: as of `power_range`."""
    narrow = shape.worst**2 - 0.5 * shape.curvature * deviation**2
    wide = (1 - 1 / _CHEBYSHEV**2) * shape.energy
    return np.maximum(
        narrow, (wide / (2 * _CHEBYSHEV * deviation + 2 * shape.margin + 1)).max(axis=0)
    )


def _autocorrelation(window_name: str, lag: np.ndarray) -> np.ndarray:
    """|r| at lags [records] of both signs, in shares of their sum with sign."""
    w = samples(window_name, _SAMPLES)
    r = np.fft.irfft(np.abs(np.fft.rfft(w, 2 * _SAMPLES)) ** 2)[: _SAMPLES + 1]
    at_lags = np.interp(lag * _SAMPLES, np.arange(_SAMPLES + 1), r)
    return np.asarray(np.abs(at_lags) / at_lags.sum())


@lru_cache(maxsize=32)
def _peak(window_name: str) -> float:
    """Largest density of the autocorrelation over lags [1/record]."""
    lag = (np.arange(_LAGS) + 0.5) / _LAGS
    return float(_autocorrelation(window_name, lag).max()) * _LAGS


def _departure(number: int, turn: np.ndarray) -> np.ndarray:
    """Largest error of a rule's mean of cos(turn x), which is exp(-turn^2 / 2)."""
    if number <= HERMITE:
        x, w = gaussian_rule(number)
        mean = (w * np.cos(turn[:, None] * x)).sum(axis=1)
        return np.asarray(np.abs(mean - np.exp(-0.5 * turn**2)))
    step = 2 * RULE_REACH / (number - 1)
    past = turn - 2 * np.pi / step  # even steps repeat themselves there
    return np.asarray(np.where(past < 0, np.exp(-0.5 * past**2), 1.0) + _FLOOR)
