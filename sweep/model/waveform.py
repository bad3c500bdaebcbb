"""The waveform and its segments: beats, their phases, and what a set of peaks says.

Homodyne beat phase of a segment (PHYSICS section 2), tau(t) = tau_0 - beta t, beta = 2 v_r / c:

    psi(t) = 2 pi [ -f_seg tau(t) + s S ( tau(t)^2 / 2 - t tau(t) ) ],   s = +1, 0, -1

Its terms up to t give one line per segment:

    phase at t = 0   -f_seg tau_0 + s S tau_0^2 / 2          [cycles]
    beat             f_seg beta - s S tau_0 (1 + beta)       [Hz, signed]

f_seg is the optical frequency at the segment's start: c/lambda for the up-chirp and the Doppler
segment, c/lambda + B for the down-chirp. To leading order the beats are f_d - f_r, f_d and f_d +
f_r with f_d = 2 v_r / lambda and f_r = S 2 R / c [T 2.8]. The further terms move the down beat of
Table 4.1 by 0.2 bins at 150 m/s. The terms in t^2 are range walk, an effect of its own. By [T] each
segment starts with the target at range R; that it moves on in between is an effect too.

A shot has an up- and a down-chirp, in any order, and may have a Doppler segment before, between or
behind them. All last as long, with equal gaps. Two beats of real records tell both unknowns by an
assumption (docs/physics.md, *A segment that is missed*); complex records keep the sign of each.
"""

from collections.abc import Mapping, Sequence
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from sweep.model.constants import SPEED_OF_LIGHT

SEGMENTS = ("up", "doppler", "down")
ORDER, GAP = "instrument.chirp.segments", "instrument.chirp.gap"
ORDERS = (
    "up doppler down", "up down", "down up", "down doppler up", "doppler up down",
    "doppler down up", "up down doppler", "down up doppler",
)  # fmt: skip
"""Segments of a shot in the order of time."""
DOPPLER_SLOPE, DOWN_SLOPE = "instrument.chirp.doppler_slope", "instrument.chirp.down_slope"
SHOT_DETECTION = "instrument.processing.shot_detection"
BOTH_CHIRPS, ANY_TWO = SHOT_DETECTIONS = ("both_chirps", "any_two")
TWO_BEATS = "instrument.processing.two_beats"
PEAKS = "instrument.processing.peaks"
ALL, STRONGEST = REPORTED_PEAKS = ("all", "strongest")
FAR_TARGET, FAST_TARGET = ASSUMPTIONS = ("far", "fast")
SIGNS = (1, 0, -1)
"""Chirp rate of up, Doppler and down segment over the up-chirp's, by default."""
DEFAULTS: dict[str, float | int | str | np.ndarray] = {
    ORDER: ORDERS[0], GAP: 0.0, DOPPLER_SLOPE: 0.0, DOWN_SLOPE: -1.0,
    SHOT_DETECTION: BOTH_CHIRPS, TWO_BEATS: FAR_TARGET, PEAKS: ALL,
}  # fmt: skip

SEARCH = "instrument.processing.search."
RANGES = SEARCH + "min_range", SEARCH + "max_range"
VELOCITIES = SEARCH + "min_radial_velocity", SEARCH + "max_radial_velocity"
ENDS = RANGES + VELOCITIES
"""Parameters of which a search band (:mod:`sweep.model.search`) has all four."""


class Segment(NamedTuple):
    """One part of a waveform, in which the frequency rises or falls evenly or stands still."""

    name: str
    slope: float
    """Chirp rate over the up-chirp's, signed: 1, 0 and -1 by default."""
    chirp_rate: np.ndarray
    """[Hz/s], signed, (n,) or scalar."""
    carrier: np.ndarray
    """Frequency that the delay turns into phase [Hz], (n,) or scalar."""
    leaks: bool
    """Tell whether leakage in it is looked at."""
    nearer: np.ndarray | float
    """Range by which the target has come nearer since the shot's start [m], (n,) or scalar."""
    beta: np.ndarray | float
    """Doppler ratio 2 v_r / c of the line on the axis, (n,) or scalar."""
    start: np.ndarray | float
    """Time since the shot's start [s]; 0 where the target stands still between segments."""


class Resolution(NamedTuple):
    """Range and radial velocity that the peaks of a shot report, (n,) each."""

    range: np.ndarray
    radial_velocity: np.ndarray


def carrier_frequencies(
    architecture: str, *, wavelength: np.ndarray, start_frequency: np.ndarray,
    bandwidth: np.ndarray, slopes: Sequence[ArrayLike] = SIGNS,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """Frequency f_seg [Hz] that the delay turns into phase, for up, Doppler and down segment.

    The wavelength is that at the start of the up-chirp, the lowest of a segment's: one that falls
    starts above it by its own bandwidth. Direct detection chirps the light's power, so that there
    the radio frequency takes the optical one's place.
    """
    start = start_frequency if architecture == "direct" else SPEED_OF_LIGHT / np.asarray(wavelength)
    up, doppler, down = (
        start + bandwidth * np.maximum(np.negative(s), 0.0) if np.any(np.less(s, 0)) else start
        for s in slopes
    )
    return up, doppler, down


def slopes_of(p: Mapping[str, Any]) -> tuple[float, ...]:
    """Chirp rate of each segment over the up-chirp's, of points that share them."""
    doppler, down = (float(np.ravel(p.get(x, DEFAULTS[x]))[0]) for x in (DOPPLER_SLOPE, DOWN_SLOPE))
    return 1.0, doppler, down


def carriers_of(p: Mapping[str, Any]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute the frequencies of :func:`carrier_frequencies` from parameters by dotted path."""
    return carrier_frequencies(
        str(p["instrument.receiver.architecture"]),
        wavelength=p["instrument.laser.wavelength"],
        start_frequency=p["instrument.chirp.start_frequency"],
        bandwidth=p["instrument.chirp.bandwidth"],
        slopes=slopes_of(p),
    )


def order_of(architecture: str, segments: str) -> tuple[str, ...]:
    """Names of the segments of a shot, of :data:`ORDERS`, in the order of time.

    Direct detection has no optical Doppler segment.
    """
    names = segments.split()
    return tuple(name for name in names if name != "doppler" or architecture != "direct")


def segment_starts(
    order: tuple[str, ...], *, duration: np.ndarray, gap: np.ndarray | float = 0.0
) -> tuple[np.ndarray, ...]:
    """Return times [s] from the shot's start to each segment's: up, Doppler, down; 0 for none."""
    step = np.asarray(duration, float) + gap
    return tuple(step * (order.index(name) if name in order else 0) for name in SEGMENTS)


def beat_frequency(
    slope: float | np.ndarray,
    *,
    carrier: np.ndarray,
    chirp_rate: np.ndarray,
    range: np.ndarray,
    radial_velocity: np.ndarray,
) -> np.ndarray:
    """Signed beat [Hz] of a segment whose chirp rate is the slope times B/T [Hz/s]."""
    beta = 2 * radial_velocity / SPEED_OF_LIGHT
    return carrier * beta - slope * chirp_rate * (2 * range / SPEED_OF_LIGHT) * (1 + beta)


SAMPLE_SLACK = 1e-6
"""Share of a sample by which one on a limit of time counts as within."""


def record_length(p: Mapping[str, Any]) -> np.ndarray:
    """Return the record's length [samples]: the FFT's, or what the chirp leaves after the delay."""
    left = p["instrument.chirp.duration"] - p["instrument.processing.acquisition_delay"]
    available = np.floor(left * p["instrument.processing.sample_rate"] + SAMPLE_SLACK)
    return np.minimum(p["instrument.processing.fft_size"], available).astype(np.int64)


def samples_before_echo(
    *, delay: np.ndarray, beta: np.ndarray | float, start: np.ndarray,
    sample_rate: np.ndarray, length: int,
) -> np.ndarray:  # fmt: skip
    """Count the samples of a record, 0 to all ``length``, that are taken before the echo arrives.

    The delay tau_0 at a segment's start [s] changes as tau(t) = tau_0 - beta t; the record begins
    at ``start`` [s]. The sample at t has an echo where t >= tau(t).
    """
    late = (np.asarray(delay) / (1 + np.asarray(beta)) - start) * sample_rate
    return np.clip(np.ceil(late - SAMPLE_SLACK), 0, length).astype(np.int64)


def fold(frequency: np.ndarray, sample_rate: np.ndarray) -> np.ndarray:
    """Fold a signed frequency into the spectrum of a real record, 0..fs/2."""
    return np.abs(frequency - sample_rate * np.rint(frequency / sample_rate))


FOLD_PENALTY = 4.0
"""Bins of mismatch that a reading without folds may have before one with a fold is preferred."""

READINGS = 16

FAR = 1
"""Reading without folds in which the half difference is the Doppler frequency: |f_d| < f_r."""

FAST = 0
"""Reading without folds in which the half sum is the Doppler frequency: |f_d| > f_r."""


SIGNED = 16
"""Reading of peaks of a complex record, which keep their signs: 2 f_r = d - u, f_d = u + f_r, each
up to whole sample rates; range beats up to half of it, Doppler shifts to half of either sign."""

BELOW = 1 / 64
"""Share of the sample rate by which 2 f_r may be below 0, as that of peaks rounded to bins."""


def reading(code, up, down, sample_rate):  # type: ignore[no-untyped-def]  # of arrays, or compiled
    """(f_d, f_r): signed Doppler and range beat by one of the readings, in the unit given.

    The bits of ``code`` are, from the highest, folds of up, Doppler and down peak, and whether
    half sum and half difference are exchanged: in the order in which readings are tried. Or
    :data:`SIGNED`, of peaks -N/2 .. N/2.
    """
    if code == SIGNED:
        turns = (down - up) / sample_rate
        f_r = (turns - np.floor(turns + BELOW)) * sample_rate / 2.0
        turns = (up + f_r) / sample_rate
        return (turns - np.floor(turns + 0.5)) * sample_rate, f_r
    u = sample_rate - up if code & 8 else up
    d = sample_rate - down if code & 2 else down
    half_sum, half_difference = (u + d) / 2.0, abs(d - u) / 2.0
    shift, beat = (half_difference, half_sum) if code & 1 else (half_sum, half_difference)
    return np.copysign(shift, d - u), beat


def measured(  # type: ignore[no-untyped-def]  # of arrays, or compiled
    f_d, f_r, carrier, bandwidth, duration
):
    """(range [m], radial velocity [m/s]) of a Doppler frequency and a range beat [Hz]."""
    beta = f_d / (carrier + bandwidth / 2.0)
    delay = (f_r - bandwidth * beta / 2.0) / (bandwidth / duration * (1.0 + beta))
    return SPEED_OF_LIGHT * delay / 2.0, SPEED_OF_LIGHT * beta / 2.0


def resolve(
    *,
    up: np.ndarray,
    doppler: np.ndarray | None,
    down: np.ndarray,
    carrier: np.ndarray,
    bandwidth: np.ndarray,
    duration: np.ndarray,
    sample_rate: np.ndarray,
    bin_width: np.ndarray,
    signed: bool = False,
    assumed: str = FAR_TARGET,
) -> Resolution:
    """Range and velocity from unsigned, folded peak frequencies [Hz], (n,) each.

    Frequencies with signs (``signed``), of complex records, are read by :data:`SIGNED`. Without a
    Doppler segment, ``doppler=None``, others are read by :data:`FAR`, or by :data:`FAST` where a
    fast target is ``assumed``. With it there are two unknowns and three peaks: every reading (each
    peak as it stands or folded at Nyquist, half sum or half difference being the Doppler frequency)
    predicts the third peak. The reading that predicts it best is taken, a fold counting as
    :data:`FOLD_PENALTY` bins of mismatch. The sign of down - up is the velocity's.

    PHYSICS section 2 gives the unfolded readings. Half sum and half difference belong to the
    carrier and to the range at mid-chirp; this is corrected here.
    """
    if signed or doppler is None:
        code = SIGNED if signed else FAST if assumed == FAST_TARGET else FAR
        f_d, f_r = reading(code, up, down, sample_rate)
        return Resolution(*measured(f_d, f_r, carrier, bandwidth, duration))
    at_start = carrier / (carrier + bandwidth / 2)  # the Doppler segment's carrier is lower
    least, f_d, f_r = np.array(np.inf), np.zeros(()), np.zeros(())
    for code in range(READINGS):
        shift, beat = reading(code, up, down, sample_rate)
        peak = sample_rate - doppler if code & 4 else doppler
        folds = (code >> 3 & 1) + (code >> 2 & 1) + (code >> 1 & 1)
        cost = abs(abs(shift) * at_start - peak) + folds * (FOLD_PENALTY * bin_width)
        better = cost < least
        least, f_d, f_r = (
            np.where(better, new, old) for new, old in ((cost, least), (shift, f_d), (beat, f_r))
        )
    return Resolution(*measured(f_d, f_r, carrier, bandwidth, duration))


def fit(
    peaks: np.ndarray,
    *,
    weights: np.ndarray,
    carriers: np.ndarray,
    rates: np.ndarray,
    sample_rate: np.ndarray,
    bin_width: np.ndarray,
    signed: bool = False,
    assumed: str = FAR_TARGET,
) -> Resolution:
    """Range and velocity by weighted least squares over the peaks of two or more segments.

    A segment's beat is linear in the Doppler ratio beta and in x = tau (1 + beta),

        f_i = carrier_i beta - rate_i x,

    and every assignment of signs (and folds at Nyquist) to the peaks gives a fit. Of three peaks or
    more that of the least misfit is taken, of those whose range is not negative, a fold counting as
    :data:`FOLD_PENALTY` bins. Two peaks fit whatever their signs, and an assumption decides:

    - ``far``: the range beat exceeds the Doppler shift in every chirp, so that a beat has the
      sign opposite to its chirp rate; that of a segment without a chirp is positive (closing);
    - ``fast``: the Doppler shift exceeds every range beat, so that all beats have one sign, that
      which makes the range positive.

    Peaks with signs (``signed``), of complex records, are known but for whole sample rates. The two
    segments of rates furthest apart give the least range that is not negative, and a Doppler shift
    within half the sample rate.

    Peaks [Hz], inverse variances in any unit (``weights``, 0 for a segment that is not detected),
    carriers [Hz] and signed chirp rates [Hz/s] are (k, n). To refer results to the start of the
    shot, add to a carrier its rate times the time of its record. nan where segments of less than
    two different chirp rates are detected.
    """
    shape = np.shape(peaks)
    carriers, rates, weights = (np.broadcast_to(v, shape) for v in (carriers, rates, weights))
    sample_rate, bin_width = (np.broadcast_to(v, shape[1:]) for v in (sample_rate, bin_width))
    found = np.full((2, *shape[1:]), np.nan)
    used = (weights > 0) & np.isfinite(peaks)
    kinds, which = np.unique(used, axis=1, return_inverse=True)
    for number, kind in enumerate(kinds.T):
        here = np.ravel(which) == number
        p, w, c, s = (v[np.ix_(kind, here)] for v in (peaks, weights, carriers, rates))
        if kind.sum() < 2 or not np.all(np.ptp(s, axis=0) > 0):
            continue
        w = w / w.max(axis=0)  # products of two do not vanish
        signs = _by_turns if signed else _by_signs
        found[:, here] = signs(p, w, c, s, sample_rate[here], bin_width[here], assumed)
    beta, x = found
    return Resolution(SPEED_OF_LIGHT * x / (2 * (1 + beta)), SPEED_OF_LIGHT * beta / 2)


def _least_squares(
    beats: np.ndarray, weights: np.ndarray, carriers: np.ndarray, rates: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Doppler ratio beta and x [s] of signed beats (k, n)."""
    # The determinant of the normal equations as a sum over pairs: nothing cancels.
    pairs = [(i, j) for i in range(len(beats)) for j in range(i)]
    both = [weights[i] * weights[j] for i, j in pairs]
    minors = [carriers[j] * rates[i] - carriers[i] * rates[j] for i, j in pairs]
    of_beta = [beats[j] * rates[i] - beats[i] * rates[j] for i, j in pairs]
    of_x = [carriers[i] * beats[j] - carriers[j] * beats[i] for i, j in pairs]
    whole = sum(w * m * m for w, m in zip(both, minors, strict=True))
    with np.errstate(invalid="ignore"):  # carriers of 0 tell no velocity
        beta, x = (
            sum(w * m * v for w, m, v in zip(both, minors, own, strict=True)) / whole
            for own in (of_beta, of_x)
        )
    return beta, x


def response(
    beats: np.ndarray, *, weights: np.ndarray, carriers: np.ndarray, rates: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Change of range [m] and radial velocity [m/s] that :func:`fit` makes of a change of beats.

    Changes of the signed beats [Hz] and the rest are (k, n), as of :func:`fit`; 0 where beats tell
    nothing.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        beta, x = _least_squares(beats, weights, carriers, rates)
    ranges, velocities = (
        np.where(np.isfinite(value), SPEED_OF_LIGHT / 2 * value, 0.0) for value in (x, beta)
    )
    return ranges, velocities


def _by_signs(  # type: ignore[no-untyped-def]  # seven arrays and a word
    peaks, weights, carriers, rates, sample_rate, bin_width, assumed
):
    """(beta, x) of unsigned, folded peaks, by the assignment of signs that fits best."""
    number = len(peaks)
    least, found = np.full(peaks.shape[1:], np.inf), np.full((2, *peaks.shape[1:]), np.nan)
    nearest = -bin_width / np.abs(rates).max(axis=0)  # a range of less than 0 by rounding
    for signs in product((1, -1), repeat=number):
        for folds in product((0, 1), repeat=number) if number > 2 else ((0,) * number,):
            sign, fold = np.reshape(signs, (-1, 1)), np.reshape(folds, (-1, 1))
            beats = sign * np.where(fold == 1, sample_rate - peaks, peaks)
            beta, x = _least_squares(beats, weights, carriers, rates)
            misfit = carriers * beta - rates * x - beats
            cost = np.sqrt((weights * misfit**2).sum(axis=0) / weights.sum(axis=0)) / bin_width
            cost = np.where(x < nearest, np.inf, cost + FOLD_PENALTY * sum(folds))
            if number == 2:
                # Where none keeps to what is assumed the first that does but for its range.
                far = (sign == np.where(rates == 0, 1, -np.sign(rates))).all(axis=0)
                kept = far if assumed == FAR_TARGET else np.full(far.shape, len({*signs}) == 1)
                cost = np.where(kept, np.where(x < nearest, 1e300, 0.0), np.inf)
            better = cost < least
            least = np.where(better, cost, least)
            found = np.where(better, (beta, x), found)
    return found


def _by_turns(  # type: ignore[no-untyped-def]  # seven arrays and a word
    peaks, weights, carriers, rates, sample_rate, bin_width, assumed
):
    """(beta, x) of peaks with signs, known but for whole sample rates."""
    column = np.arange(peaks.shape[1])
    low, high = rates.argmin(axis=0), rates.argmax(axis=0)
    apart = (peaks[low, column] - peaks[high, column]) / sample_rate
    apart = (apart - np.floor(apart + BELOW)) * sample_rate
    x = apart / (rates[high, column] - rates[low, column])
    turns = (peaks[high, column] + rates[high, column] * x) / sample_rate
    shift = (turns - np.floor(turns + 0.5)) * sample_rate
    whole = np.rint((shift - rates * x - peaks) / sample_rate)
    return _least_squares(peaks + whole * sample_rate, weights, carriers, rates)
