"""Speckle: what a rough surface does to the amplitude that each beamlet sends back.

A patch whose heights scatter by more than lambda/(4 pi) about their mean returns the sum of many
waves of unrelated phase: a circular complex Gaussian amplitude [Goodman, Speckle Phenomena in
Optics, ch. 2]. A beamlet's patch here takes the factor

    g_b = sqrt(kappa) u_b + sqrt(1 - kappa) z_b,     z_b complex normal with E|z_b|^2 = 1,

whose mean power is 1. kappa = exp(-(4 pi sigma_h / lambda)^2) is the share of power that stays
coherent when the round trip has normal phases of deviation 4 pi sigma_h / lambda; u_b is 1 where
the footprint's phases follow its geometry, and a random phase where they do not. kappa = 0 is a
Swerling-1 target, any other a Rician one.

The three segments of a shot see the same heights, and frequencies that differ by B at the most, so
that one g_b serves all three: amplitudes at frequencies df apart have the correlation
exp(-(4 pi sigma_h df / c)^2 / 2), 1 to 1e-6 for 1 GHz and heights of 10 um (the roughness matters
up to lambda or so, beyond which kappa is 0). Depth beyond roughness lies in the beamlets' ranges,
and what it does between the segments in their lines' phases. What moves across the beam turns the
beamlets against each other from one segment to the next, see :func:`turns`.

It acts on the lines' amplitudes alone, before their spectrum; the mean echo, and so its shot
noise, stays.
"""

import math

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from sweep.model import philox
from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.effects.change import Change
from sweep.model.marcum import marcum_q1

RARE = 1e-6
"""Chance of a draw in which the amplitude changes by more than :func:`bound` says."""


def coherent_share(*, roughness: ArrayLike, wavelength: ArrayLike) -> np.ndarray:
    """Share kappa of the mean echo power that keeps its phase, 0..1.

    Parameters
    ----------
    roughness : array_like
        Standard deviation of the surface's height along the line of sight [m], >= 0: of a plane,
        that of the height across it times the sine of the grazing angle. Infinite: all speckle.
    wavelength : array_like
        [m]
    """
    phase = 4 * math.pi * np.asarray(roughness, float) / np.asarray(wavelength, float)
    return np.asarray(np.exp(-(phase**2)))


def segment_coherence(*, roughness: ArrayLike, bandwidth: ArrayLike) -> np.ndarray:
    """Correlation of a patch's amplitudes at optical frequencies ``bandwidth`` [Hz] apart, 0..1.

    The mean of exp(2 i dk h) over normal heights h, dk = 2 pi bandwidth / c. One draw for all
    segments, as done here, takes it as 1.
    """
    phase = 4 * math.pi * np.asarray(bandwidth, float) / SPEED_OF_LIGHT
    return np.asarray(np.exp(-0.5 * (phase * np.asarray(roughness, float)) ** 2))


def amplitudes(
    *,
    keys: np.ndarray,
    first_draw: int,
    draws: int,
    beamlets: int,
    coherent_share: ArrayLike = 0.0,
    random_phases: bool = False,
) -> np.ndarray:
    """Factors g_b on the beamlets' amplitudes, (n, draws, beamlets) complex.

    Parameters
    ----------
    keys : (n, 2) uint64
        Random key of each point.
    first_draw, draws, beamlets : int
        A factor depends on key, number of the draw and number of the beamlet, on nothing else.
    coherent_share : array_like
        kappa of each point, (n,) or a scalar, 0..1.
    random_phases : bool
        Whether the coherent share has an independent uniform phase in each beamlet.
    """
    keys = np.asarray(keys, np.uint64)
    shares = np.broadcast_to(np.asarray(coherent_share, float), len(keys))
    factors = np.empty((len(keys), draws, beamlets), complex)
    for key, share, values in zip(keys, shares, factors, strict=True):
        steady, diffuse = parts(key, first_draw, draws, beamlets, float(share), random_phases)
        np.add(steady, diffuse, out=values)
    return factors


def parts(
    key: np.ndarray, first_draw: int, draws: int, beamlets: int, share: float, random: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Coherent and diffuse part of one point's factors: (draws or 1, beamlets), (draws, beamlets).

    Streams: ``STREAM_SPECKLE`` pair b of a draw is z_b, ``STREAM_FOOTPRINT_PHASE`` number b the
    phase of u_b.
    """
    steady = np.full((draws if random and share > 0 else 1, beamlets), math.sqrt(share), complex)
    diffuse = np.empty((draws, beamlets), complex)
    if steady.shape[0] == draws and random and share > 0:
        _random_phases(key[0], key[1], first_draw, philox.STREAM_FOOTPRINT_PHASE, steady)
    scale = math.sqrt((1 - share) / 2)
    _diffuse(key[0], key[1], first_draw, philox.STREAM_SPECKLE, scale, diffuse)
    return steady, diffuse


@njit(cache=True, nogil=True)
def _diffuse(key0, key1, first_draw, stream, scale, out):
    """Circular complex normal numbers of standard deviation ``scale`` in each part."""
    for d in range(out.shape[0]):
        for b in range(out.shape[1]):
            re, im = philox.normal_pair(key0, key1, first_draw + d, stream, b)
            out[d, b] = complex(scale * re, scale * im)


@njit(cache=True, nogil=True)
def _random_phases(key0, key1, first_draw, stream, out):
    """Turns each number by a uniform phase."""
    for d in range(out.shape[0]):
        for b in range(out.shape[1]):
            angle = 2.0 * math.pi * philox.uniform(key0, key1, first_draw + d, stream, b)
            out[d, b] *= complex(math.cos(angle), math.sin(angle))


def turns(*, carrier: ArrayLike, doppler: np.ndarray, interval: ArrayLike) -> np.ndarray:
    """Phases [cycles] by which beamlets turn against the beam's centre from segment to segment.

    A segment begins ``interval`` [s] after the one before it. With the instrument moving across
    the beam, the Doppler shifts differ over the footprint, and the pattern that their speckles
    make has changed by then. All segments begin at the same range: what all beamlets share is
    left out.

    Parameters
    ----------
    carrier : array_like
        Optical frequency [Hz].
    doppler : (beamlets,) ndarray
        beta_b - beta_0, beta = 2 v_r / c.
    interval : array_like
        [s]

    Returns
    -------
    (3, beamlets) ndarray
        For the up, the Doppler and the down segment; the first is 0.
    """
    step = np.asarray(carrier, float) * np.asarray(doppler, float) * np.asarray(interval, float)
    return np.asarray(np.arange(3.0)[:, None] * step)


def fixed_bin_detection(
    *, steady: ArrayLike, diffuse_power: ArrayLike, bin_deviation: ArrayLike, threshold: ArrayLike
) -> np.ndarray:
    """Mean over speckle and noise of the chance that one given bin crosses the threshold, 0..1.

    Steady signal m, diffuse signal of mean power P and noise of sigma a quadrature add up to a
    Rice-distributed magnitude, so that it is Q_1(|m|/s, Th/s) with s^2 = sigma^2 + P/2; without
    m it is Swerling's first case, exp(-Th^2 / (2 sigma^2 (1 + SNR))), SNR = P / (2 sigma^2).

    Parameters
    ----------
    steady : array_like
        |m|, magnitude of the coherent part.
    diffuse_power : array_like
        P, mean of |X|^2 of the diffuse part.
    bin_deviation, threshold : array_like
        sigma and Th.
    """
    s = np.sqrt(np.asarray(bin_deviation, float) ** 2 + np.asarray(diffuse_power, float) / 2)
    return marcum_q1(np.asarray(steady, float) / s, np.asarray(threshold, float) / s).q


def joint_detection(
    *,
    powers: tuple[ArrayLike, ArrayLike],
    covariance: ArrayLike,
    bin_deviation: ArrayLike,
    threshold: ArrayLike,
) -> np.ndarray:
    """Mean chance that two given bins of different segments both cross, all signal diffuse, 0..1.

    Both are circular complex normal with the total powers T_1, T_2 (signal and noise), their
    noises independent. With u_i = Th^2 / T_i, r^2 = |covariance|^2 / (T_1 T_2), s = 1 - r^2,
    the bivariate Rayleigh distribution [Simon and Alouini, Digital Communication over Fading
    Channels, 6.1] gives

        e^{-u_1} [1 - Q_1(sqrt(2 u_2/s), r sqrt(2 u_1/s))] + e^{-u_2} Q_1(r sqrt(2 u_2/s),
        sqrt(2 u_1/s))

    Parameters
    ----------
    powers : (array_like, array_like)
        Mean |X|^2 of the diffuse signal in each bin.
    covariance : array_like
        |E X_1 X_2*| of the signals.
    bin_deviation, threshold : array_like
        sigma and Th, the same in both.
    """
    noise = 2 * np.asarray(bin_deviation, float) ** 2
    first, second = (np.asarray(power, float) + noise for power in powers)
    square = np.asarray(threshold, float) ** 2
    u, v = square / first, square / second
    r2 = np.abs(covariance) ** 2 / (first * second)
    far_u, far_v, r = np.sqrt(2 * u / (1 - r2)), np.sqrt(2 * v / (1 - r2)), np.sqrt(r2)
    return np.asarray(
        np.exp(-u) * marcum_q1(far_v, r * far_u).p + np.exp(-v) * marcum_q1(r * far_v, far_u).q
    )


def bound(*, coherent_share: ArrayLike, diffuse_over_found: ArrayLike, bins: ArrayLike) -> Change:
    """What speckle can change in the magnitude of the detecting bin, in all draws but few.

    A bin of magnitude |X| becomes sqrt(kappa) X + D with D complex normal of power (1 - kappa) P.
    |D| exceeds t sqrt((1 - kappa) P) with probability exp(-t^2), and no more often than
    sqrt(2 pi t^2) times that if it is a sum of beamlets of random phase (whose moments are at
    most the normal ones). So the strongest of some ``bins`` lies within
    sqrt(kappa) +- t sqrt((1 - kappa) P / |X|^2), t about 4.2, in all draws but a share ``RARE``.
    Between smooth and rough, 4 pi sigma_h << lambda, that is 1 +- t 4 pi sigma_h / lambda.

    Parameters
    ----------
    coherent_share : array_like
        kappa, 0..1; 0 for incoherent footprints of several beamlets, whose coherent share is one
        of random phases.
    diffuse_over_found : array_like
        P / |X|^2, the largest mean power of a bin over all its speckles, by the power of the
        detecting bin without speckle: 1 for one beamlet and for incoherent phases; the whole
        echo's SNR over that of the bin (or 1 / share of the power in the bin) otherwise.
    bins : array_like
        Bins among which the largest may be: those of the footprint and of the window's main lobe.
    """
    kappa = np.asarray(coherent_share, float)
    square = np.log(np.asarray(bins, float) / RARE)
    t = np.sqrt(square + 0.5 * np.log(2 * math.pi * (square + 3)))
    reach = t * np.sqrt((1 - kappa) * np.asarray(diffuse_over_found, float))
    steady = np.sqrt(kappa)
    return Change(signal=(np.maximum(steady - reach, 0.0), steady + reach))
