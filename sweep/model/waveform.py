"""The three-segment waveform: beats, their phases, and what a set of three peaks says.

Homodyne beat phase of a segment (PHYSICS section 2), tau(t) = tau_0 - beta t, beta = 2 v_r / c:

    psi(t) = 2 pi [ -f_seg tau(t) + s S ( tau(t)^2 / 2 - t tau(t) ) ],   s = +1, 0, -1

Its terms up to t give one line per segment:

    phase at t = 0   -f_seg tau_0 + s S tau_0^2 / 2          [cycles]
    beat             f_seg beta - s S tau_0 (1 + beta)       [Hz, signed]

f_seg is the optical frequency at the segment's start: c/lambda for the up-chirp and the Doppler
segment, c/lambda + B for the down-chirp. To leading order the beats are f_d - f_r, f_d and
f_d + f_r with f_d = 2 v_r / lambda and f_r = S 2 R / c [T 2.8]; what is kept beyond that moves
the down beat of Table 4.1 by 0.2 bins at 150 m/s. The terms in t^2 are range walk, an effect of
its own. Each segment starts with the target at range R: [T] does not move it in between.
"""

from typing import NamedTuple

import numpy as np

from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.readings import resolve_each

SEGMENTS = ("up", "doppler", "down")
SIGNS = (1, 0, -1)
"""Sign s of the chirp rate in each segment."""


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
    """Samples of the record that exist: the FFT's, or what the chirp leaves after the delay."""
    available = np.floor((duration - acquisition_delay) * sample_rate + 1e-6)
    return np.minimum(fft_size, available).astype(np.int64)


def fold(frequency: np.ndarray, sample_rate: np.ndarray) -> np.ndarray:
    """Where a signed frequency appears in the spectrum of a real record, 0..fs/2."""
    return np.abs(frequency - sample_rate * np.rint(frequency / sample_rate))


FOLD_PENALTY = 4.0
"""Bins of mismatch that a reading without folds may have before one with a fold is preferred."""


def resolve(
    *,
    up: np.ndarray,
    doppler: np.ndarray,
    down: np.ndarray,
    carrier: np.ndarray,
    bandwidth: np.ndarray,
    duration: np.ndarray,
    sample_rate: np.ndarray,
    bin_width: np.ndarray,
) -> Resolution:
    """Range and velocity from three unsigned, folded peak frequencies [Hz], (n,) each.

    Two unknowns and three peaks: every reading (each peak as it stands or folded at Nyquist,
    half sum or half difference being the Doppler frequency) predicts the third peak. The reading
    that predicts it best is taken, a fold counting as :data:`FOLD_PENALTY` bins of mismatch. The
    sign of down - up is the velocity's.

    PHYSICS section 2 gives the unfolded readings. That half sum and half difference belong to
    the carrier and to the range at mid-chirp is put right here.
    """
    values = (
        up, doppler, down, carrier, bandwidth, duration, sample_rate, FOLD_PENALTY * bin_width,
    )  # fmt: skip
    columns = np.empty((len(values), *np.broadcast(*values).shape))
    for number, value in enumerate(values):
        columns[number, ...] = value
    found = np.empty((2, *columns.shape[1:]))
    resolve_each(columns.reshape(len(values), -1), found.reshape(2, -1))
    return Resolution(*found)
