"""The waveform and its segments: beats, their phases, and what a set of peaks says.

Homodyne beat phase of a segment (PHYSICS section 2), tau(t) = tau_0 - beta t, beta = 2 v_r / c:

    psi(t) = 2 pi [ -f_seg tau(t) + s S ( tau(t)^2 / 2 - t tau(t) ) ],   s = +1, 0, -1

Its terms up to t give one line per segment:

    phase at t = 0   -f_seg tau_0 + s S tau_0^2 / 2          [cycles]
    beat             f_seg beta - s S tau_0 (1 + beta)       [Hz, signed]

f_seg is the optical frequency at the segment's start: c/lambda for the up-chirp and the Doppler
segment, c/lambda + B for the down-chirp. To leading order the beats are f_d - f_r, f_d and
f_d + f_r with f_d = 2 v_r / lambda and f_r = S 2 R / c [T 2.8]; what is kept beyond that moves
the down beat of Table 4.1 by 0.2 bins at 150 m/s. The terms in t^2 are range walk, an effect of
its own. By [T] each segment starts with the target at range R; that it moves on in between is an
effect too.

A shot has an up- and a down-chirp, in any order, and may have a Doppler segment before, between or
behind them: the lander's ``up doppler down``, the triangle ``up down`` of automotive lidars. All
last as long, with equal gaps. Without a Doppler segment two beats tell of two unknowns, and
half sum and half difference could be exchanged: the target is taken to be further away than
|v_r| c / (lambda S), so that |f_d| < f_r, and no beat to be folded. Complex records (I and Q) keep
the sign of each beat, and two tell both unknowns.
"""

from typing import NamedTuple

import numpy as np

from sweep.model.constants import SPEED_OF_LIGHT

SEGMENTS = ("up", "doppler", "down")
ORDER, GAP = "instrument.chirp.segments", "instrument.chirp.gap"
ORDERS = (
    "up doppler down", "up down", "down up", "down doppler up", "doppler up down",
    "doppler down up", "up down doppler", "down up doppler",
)  # fmt: skip
"""Segments of a shot in the order of time."""
DEFAULTS: dict[str, float | int | str | np.ndarray] = {ORDER: ORDERS[0], GAP: 0.0}
SIGNS = (1, 0, -1)
"""Sign s of the chirp rate in each segment."""


class Segment(NamedTuple):
    """One stretch of a waveform, in which the frequency rises or falls evenly or stands still."""

    name: str
    sign: int
    """Of the chirp rate: 1, 0 or -1."""
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
    """Range and radial velocity that three peaks report, (n,) each."""

    range: np.ndarray
    radial_velocity: np.ndarray


def carrier_frequencies(
    architecture: str, *, wavelength: np.ndarray, start_frequency: np.ndarray, bandwidth: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Frequency f_seg [Hz] that the delay turns into phase, for up, Doppler and down segment.

    The wavelength is that at the start of the chirp. Direct detection chirps the light's power,
    so that there the radio frequency takes the optical one's place.
    """
    start = start_frequency if architecture == "direct" else SPEED_OF_LIGHT / np.asarray(wavelength)
    return start, start, start + bandwidth


def order_of(architecture: str, segments: str) -> tuple[str, ...]:
    """Names of the segments of a shot, of :data:`ORDERS`, in the order of time.

    Direct detection has no optical Doppler segment.
    """
    names = segments.split()
    return tuple(name for name in names if name != "doppler" or architecture != "direct")


def segment_starts(
    order: tuple[str, ...], *, duration: np.ndarray, gap: np.ndarray | float = 0.0
) -> tuple[np.ndarray, ...]:
    """Return times [s] from the shot's start to that of up, Doppler and down segment; 0 for none.

    Parameters
    ----------
    order : tuple of str
        Of :func:`order_of`.
    duration, gap : (n,) ndarray or float
        Length of a segment, and time from its end to the next one's start [s], >= 0.

    Examples
    --------
    >>> [float(start) for start in segment_starts(("up", "down"), duration=32e-6, gap=1e-6)]
    [0.0, 0.0, 3.3e-05]
    """
    step = np.asarray(duration, float) + gap
    return tuple(step * (order.index(name) if name in order else 0) for name in SEGMENTS)


def beat_frequency(
    sign: int,
    *,
    carrier: np.ndarray,
    chirp_rate: np.ndarray,
    range: np.ndarray,
    radial_velocity: np.ndarray,
) -> np.ndarray:
    """Signed beat [Hz] of a segment whose chirp has the given sign; chirp rate B/T [Hz/s]."""
    beta = 2 * radial_velocity / SPEED_OF_LIGHT
    return carrier * beta - sign * chirp_rate * (2 * range / SPEED_OF_LIGHT) * (1 + beta)


def record_length(
    *,
    fft_size: np.ndarray,
    duration: np.ndarray,
    acquisition_delay: np.ndarray,
    sample_rate: np.ndarray,
) -> np.ndarray:
    """Return the record's length [samples]: the FFT's, or what the chirp leaves after the delay."""
    available = np.floor((duration - acquisition_delay) * sample_rate + 1e-6)
    return np.minimum(fft_size, available).astype(np.int64)


def fold(frequency: np.ndarray, sample_rate: np.ndarray) -> np.ndarray:
    """Fold a signed frequency into the spectrum of a real record, 0..fs/2."""
    return np.abs(frequency - sample_rate * np.rint(frequency / sample_rate))


FOLD_PENALTY = 4.0
"""Bins of mismatch that a reading without folds may have before one with a fold is preferred."""

READINGS = 16

FAR = 1
"""Reading without folds in which the half difference is the Doppler frequency: |f_d| < f_r."""


SIGNED = 16
"""Reading of peaks of a complex record, which keep their signs: 2 f_r = d - u, f_d = u + f_r, each
up to whole sample rates; range beats up to half of it, Doppler shifts to half of either sign."""

_BELOW = 1 / 64
"""Share of the sample rate by which 2 f_r may be below 0, as that of peaks rounded to bins."""


def reading(code, up, down, sample_rate):  # type: ignore[no-untyped-def]  # of arrays, or compiled
    """(f_d, f_r): signed Doppler and range beat by one of the readings, in the unit given.

    The bits of ``code`` are, from the highest, folds of up, Doppler and down peak, and whether
    half sum and half difference are exchanged: in the order in which readings are tried. Or
    :data:`SIGNED`, of peaks -N/2 .. N/2.
    """
    if code == SIGNED:
        turns = (down - up) / sample_rate
        f_r = (turns - np.floor(turns + _BELOW)) * sample_rate / 2.0
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
) -> Resolution:
    """Range and velocity from unsigned, folded peak frequencies [Hz], (n,) each.

    Frequencies with signs (``signed``), of complex records, are read by :data:`SIGNED`. Without a
    Doppler segment, ``doppler=None``, others are read by :data:`FAR`. With it there are two
    unknowns and three peaks: every reading (each peak as it stands or folded at Nyquist,
    half sum or half difference being the Doppler frequency) predicts the third peak. The reading
    that predicts it best is taken, a fold counting as :data:`FOLD_PENALTY` bins of mismatch. The
    sign of down - up is the velocity's.

    PHYSICS section 2 gives the unfolded readings. That half sum and half difference belong to
    the carrier and to the range at mid-chirp is put right here.
    """
    if signed or doppler is None:
        f_d, f_r = reading(SIGNED if signed else FAR, up, down, sample_rate)
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
