"""Complex spectra of a shot with noise in every bin, draw by draw.

Noise is drawn as the receiver makes it: white Gaussian in the record, which is windowed, padded and
transformed; so bins are alike as far as window and padding make them, and DC and Nyquist are what
they are. Every sample is addressed by point, draw, segment and place (:mod:`sweep.model.philox`).

The signal has the magnitudes that :func:`sweep.model.spectra.segment_spectrum` gives, with all
effects. Where beamlets add as powers these are root mean squares, and have no phases: the signal
is then given those of a lone tone at its place, bin by bin. For footprints of less than a bin that
is what the spectrum is; in wider ones estimators see a smoother peak than speckle would make.
A phase common to all bins makes no difference to circular noise and is left out.
"""

import math
from typing import NamedTuple

import numpy as np
from scipy import fft

from sweep.model.cramer_rao import beat_deviation
from sweep.model.interpolation import interpolator, sub_bin
from sweep.model.philox import STREAM_RECORD, normals
from sweep.model.preparation import Shots
from sweep.model.processing import Setting, main_lobe, taper
from sweep.model.spectra import segment_spectrum


class Signal(NamedTuple):
    """A segment's spectrum without noise, and what is true of it."""

    spectrum: np.ndarray
    """(N/2 + 1,) complex [V]."""
    strongest: int
    """Largest bin, 1..N/2 - 1."""
    first: int
    """First of the bins that the signal occupies: those from the first to the last of half its
    largest magnitude, and a main lobe's half-width to either side. What is detected elsewhere is
    a false alarm, leaked signal or not."""
    last: int
    """Last of them; below ``first`` where there is no echo."""
    frequency: float
    """Where a lone tone of these magnitudes about the largest bin stands [bins]."""
    cnr: float
    """Power of the signal over that of the noise in the record, before the FFT."""


def setting_of(
    shots: Shots, i: int, *, training: int, guard: int, rank: int, pfa: float
) -> Setting:
    """What a detector and an estimator are told of point i; rank 0 for three quarters."""
    return Setting(
        fft_size=shots.fft_size,
        sample_rate=float(shots.sample_rate[i]),
        window=shots.window,
        noise_power=float(shots.window.energy * shots.quiet_variance[i]),
        threshold=float(shots.threshold[i]),
        training=training,
        guard=guard,
        rank=rank or math.ceil(0.75 * training),
        pfa=pfa,
    )


def signal_of(shots: Shots, i: int, segment: int) -> Signal:
    """Spectrum of point i's segment without noise: 0 up, 1 Doppler, 2 down."""
    _, magnitude = segment_spectrum(shots, i, segment)
    half, window = shots.fft_size // 2, shots.window
    k = int(np.clip(np.argmax(magnitude), 1, half - 1))
    if not magnitude[k] > 0:
        return Signal(magnitude.astype(complex), k, 1, 0, float(k), 0.0)
    tables = interpolator(window, shots.fft_size)
    place = k + sub_bin(magnitude[k - 1], magnitude[k], magnitude[k + 1], tables)
    high = np.flatnonzero(magnitude >= 0.5 * magnitude[k])
    beside = math.ceil(main_lobe(window) * shots.fft_size / window.length)
    total = 2 * (magnitude**2).sum() - magnitude[0] ** 2 - magnitude[half] ** 2
    power = total / (shots.fft_size * window.energy)
    return Signal(
        spectrum=magnitude * _tone_phases(place, shots),
        strongest=k,
        first=max(int(high[0]) - beside, 1),
        last=min(int(high[-1]) + beside, half - 1),
        frequency=place,
        cnr=float(power / shots.noise_variance[i]),
    )


def _tone_phases(place: float, shots: Shots) -> np.ndarray:
    """Phase factors (N/2 + 1,) of a lone tone at a place [bins]; 1 where it vanishes."""
    turns = np.arange(shots.window.length) * (place / shots.fft_size)
    tone = fft.rfft(taper(shots.window) * np.cos(2 * np.pi * turns), shots.fft_size)
    magnitude = np.abs(tone)
    return np.where(magnitude > 0, tone / np.where(magnitude > 0, magnitude, 1.0), 1.0)


def beat_bound(shots: Shots, i: int, cnr: np.ndarray) -> np.ndarray:
    """Cramer-Rao bound of a beat's standard deviation [Hz] for lone tones of some cnr."""
    return beat_deviation(
        cnr=cnr, samples=shots.window.length, sample_rate=float(shots.sample_rate[i])
    )


def noise_of(
    shots: Shots, i: int, segment: int, signal: Signal, key: np.ndarray, draw: int
) -> np.ndarray:
    """Noise (N/2 + 1,) complex of one draw of point i's segment [V].

    Where noise stands under the lines only (:attr:`Shots.pedestal`), the bins that the signal
    occupies have more of it.
    """
    record = normals(key, draw, STREAM_RECORD[segment], shots.window.length)
    record *= math.sqrt(float(shots.noise_variance[i])) * taper(shots.window)
    # A transform at a time: bits do not depend on how many there are.
    noise = np.asarray(fft.rfft(record, shots.fft_size))
    more = float(shots.line_deviation[i] / shots.bin_deviation[i])
    if more != 1.0:
        noise[signal.first : signal.last + 1] *= more
    return noise


def noisy_spectra(
    shots: Shots, i: int, segment: int, signal: Signal, *, key: np.ndarray, draws: np.ndarray
) -> np.ndarray:
    """Spectra (m, N/2 + 1) complex of some draws of point i's segment, by their numbers [V]."""
    spectra = np.empty((draws.size, shots.fft_size // 2 + 1), complex)
    for row, draw in enumerate(draws):
        spectra[row] = signal.spectrum + noise_of(shots, i, segment, signal, key, int(draw))
    return spectra
