"""Cramer-Rao bound: how well any unbiased estimate can know a beat, a range and a velocity.

A tone A cos(2 pi f n / fs + phi) in L samples with white Gaussian noise of variance s^2, all of A,
f and phi unknown: with cnr = A^2 / (2 s^2), the tone's power over the noise's before the FFT,

    var(f) >= 12 / (cnr L (L^2 - 1)) (fs / 2 pi)^2

[Rife and Boorstyn, IEEE Trans. Inf. Theory 20, 591, 1974; Kay, Fundamentals of Statistical Signal
Processing: Estimation Theory, 1993, section 3.11]. For a tone some bins away from DC and Nyquist,
where the bound does not depend on its phase. It is that of the whole record: a window throws away
what it tapers off, and the largest value of a windowed spectrum knows the tone less well
(:func:`windowed_deviation`), unless the window is taken back first.

Three segments know two unknowns: the Fisher information of independent beats adds, weighted with
what range and velocity change in each (:mod:`sweep.model.waveform`). The record of a segment is
taken to tell of its beat's frequency only; its phase, 4 pi R / lambda, is known modulo 2 pi.

Below some SNR estimates are not unbiased and the bound says nothing: noise elsewhere in the
spectrum is taken for the tone (the threshold effect).
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.waveform import SIGNS
from sweep.model.window import Window, samples


class Deviation(NamedTuple):
    """Least standard deviations of what three beats are resolved into."""

    range: np.ndarray
    """[m]"""
    radial_velocity: np.ndarray
    """[m/s]"""


def carrier_to_noise_ratio(*, snr: ArrayLike, window: Window) -> np.ndarray:
    """Power of a tone over that of the noise before the FFT.

    Parameters
    ----------
    snr : array_like
        |X|^2 of the tone on a bin over the mean noise power of a bin; a tone between bins has its
        scalloping loss more than its strongest bin shows.
    window : Window
        |X| = A sum(w) / 2 on a bin, noise power sum(w^2) s^2.
    """
    return np.asarray(snr, float) * 2 * window.energy / window.sum**2


def beat_deviation(*, cnr: ArrayLike, samples: ArrayLike, sample_rate: ArrayLike) -> np.ndarray:
    """Least standard deviation [Hz] of a tone's frequency.

    Parameters
    ----------
    cnr : array_like
        Power of the tone over that of the noise, before the FFT; 0 gives inf.
    samples : array_like
        Length of the record L, 2 or more; zeros appended to it do not count.
    sample_rate : array_like
        [Hz]
    """
    number = np.asarray(samples, float)
    with np.errstate(divide="ignore"):
        variance = 12 / (np.asarray(cnr, float) * number * (number**2 - 1))
    return np.sqrt(variance) * np.asarray(sample_rate) / (2 * math.pi)


def windowed_deviation(*, cnr: ArrayLike, window: Window, sample_rate: ArrayLike) -> np.ndarray:
    """Standard deviation [Hz] of the place of the largest |X(f)| of a windowed record.

    To first order in the noise, with m = n less the middle of the record,

        var(f) = sum(w^2 m^2) / (cnr sum(w m^2)^2) (fs / 2 pi)^2

    which is the bound for the rectangular window and more for every other: the expansion of the
    periodogram about its maximum [Rife and Vincent, Bell Syst. Tech. J. 49, 197, 1970].

    Parameters
    ----------
    cnr, sample_rate : array_like
        As of :func:`beat_deviation`.
    window : Window
        The window.
    """
    w = samples(window.name, window.length)
    place = np.arange(window.length) - (w * np.arange(window.length)).sum() / w.sum()
    spread = ((w * place) ** 2).sum() / (w * place**2).sum() ** 2
    with np.errstate(divide="ignore"):
        return np.sqrt(spread / np.asarray(cnr, float)) * np.asarray(sample_rate) / (2 * math.pi)


def resolved_deviation(
    *,
    up: ArrayLike,
    doppler: ArrayLike,
    down: ArrayLike,
    carriers: tuple[ArrayLike, ArrayLike, ArrayLike],
    chirp_rate: ArrayLike,
    range: ArrayLike,
    radial_velocity: ArrayLike,
) -> Deviation:
    """Least standard deviations of range and radial velocity, of the beats' own.

    Parameters
    ----------
    up, doppler, down : array_like
        Standard deviations of the three beats [Hz]; inf for one that is not used.
        :func:`sweep.model.waveform.resolve` takes no more from the Doppler beat than which
        reading of the others is right: the bound of what it reports has ``doppler=np.inf``.
    carriers : tuple of array_like
        Carrier of each segment [Hz].
    chirp_rate, range, radial_velocity : array_like
        S [Hz/s]; where the target is [m], and how fast it closes [m/s].
    """
    per_metre = 2 / SPEED_OF_LIGHT
    delay, beta = per_metre * np.asarray(range, float), per_metre * np.asarray(radial_velocity)
    rate = np.asarray(chirp_rate, float)
    along_range = [-sign * rate * per_metre * (1 + beta) for sign in SIGNS]
    along_velocity = [
        per_metre * (np.asarray(carrier) - sign * rate * delay)
        for sign, carrier in zip(SIGNS, carriers, strict=True)
    ]
    with np.errstate(divide="ignore"):
        weight = [1 / np.asarray(deviation, float) ** 2 for deviation in (up, doppler, down)]
    # The determinant of a sum of squares as squares again (Cauchy and Binet): nothing cancels.
    determinant = sum(
        weight[i] * weight[j]
        * (along_range[i] * along_velocity[j] - along_range[j] * along_velocity[i]) ** 2
        for i, j in ((0, 1), (0, 2), (1, 2))
    )  # fmt: skip
    about_range = sum(w * a**2 for w, a in zip(weight, along_range, strict=True))
    about_velocity = sum(w * a**2 for w, a in zip(weight, along_velocity, strict=True))
    known = np.asarray(determinant) > 0
    safe = np.where(known, determinant, 1.0)
    return Deviation(
        np.where(known, np.sqrt(about_velocity / safe), np.inf),
        np.where(known, np.sqrt(about_range / safe), np.inf),
    )
