"""Errors of range and radial velocity because the places of peaks wander with speckle."""

import numpy as np
from scipy.special import exp1

from sweep.model import waveform
from sweep.model.preparation import Shots
from sweep.model.speckle_lines import Peaks, directions, place_errors

LOG_PD_MAX = 700.0
"""-ln of the least probability of detection that differs from 0."""


def resolved_wander(shots: Shots, point: np.ndarray, peaks: Peaks, used: np.ndarray) -> np.ndarray:
    """Mean square errors of range [m^2] and radial velocity [m^2/s^2] by speckle, (2, m).

    Parameters
    ----------
    point
        (m,): points of the shots that the peaks are of.
    used
        (3, m): true for segments that are detected. The Doppler segment's beat is used if slopes
        are not the default ones or any two segments detect a shot.
    """
    if shots.speckle_lines is None:
        return np.zeros((2, point.size))
    common = place_errors(shots.speckle_lines.of(point), peaks, shots)
    resolved = np.array([True, shots.slopes != waveform.SIGNS or shots.any_two, True])
    carriers, rates = (values[:, point] for values in shots.beats_by_motion)
    given = {"weights": 1.0 * (used & resolved[:, None]), "carriers": carriers, "rates": rates}
    width = np.broadcast_to(shots.sample_rate, shots.size)[point] / shots.fft_size
    gains = np.array([
        waveform.response(unit[:, None] * width, **given) for unit in np.eye(3)
    ])  # fmt: skip
    return np.einsum("iam,mij,jam->am", gains, common, gains)


def mean_wander(shots: Shots, pd: np.ndarray, snr: np.ndarray) -> np.ndarray:
    """Mean square errors as of :func:`resolved_wander` over the echoes that are detected, (2, n).

    Parameters
    ----------
    pd, snr
        (3, n): probability of detection and SNR of each segment; nan where there is none.

    Notes
    -----
    The power q^2 of a detected peak, in units of its mean, is exponential beyond A = -ln pd. The
    mean of 1 / q^2, with which the wander goes, is e^A E_1(A) with the exponential integral E_1.
    """
    there = np.isfinite(pd) & np.isfinite(snr) & (pd > 0)
    with np.errstate(divide="ignore"):
        least = np.clip(-np.log(np.where(there, pd, 1.0)), 1e-6, LOG_PD_MAX)
    inverse = np.exp(least) * exp1(least)
    power = np.where(there, 1 / np.maximum(inverse, 1e-300), np.nan).T
    share = np.where(there, snr / (1 + snr), np.nan).T
    point = np.arange(shots.size)
    peaks = Peaks(np.zeros(power.shape), directions(shots), power, share)
    return resolved_wander(shots, point, peaks, there)
