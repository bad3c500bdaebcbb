"""Errors of range and radial velocity because peaks move with the speckle of the echo."""

from typing import NamedTuple

import numpy as np
from scipy.special import exp1

from sweep.model import waveform
from sweep.model.preparation import Shots
from sweep.model.sampling.speckle_lines import SpecklePeaks, folding_signs, position_error_moments

NEGATIVE_LOG_PD_MAX = 700.0
"""Upper limit of -ln(pd), with pd the probability of detection. A pd below e^-700 counts as e^-700.
"""


class MeanSquareErrors(NamedTuple):
    """Mean square errors of ranges and radial velocities."""

    range: np.ndarray
    """(m,): mean square error of the range [m^2]."""
    radial_velocity: np.ndarray
    """(m,): mean square error of the radial velocity [m^2/s^2]."""


def range_velocity_wander_variance(
    shots: Shots, point_indices: np.ndarray, peaks: SpecklePeaks, is_detected: np.ndarray
) -> MeanSquareErrors:
    """Return the mean square errors of m ranges and radial velocities due to speckle.

    Parameters
    ----------
    shots
        Prepared shots.
    point_indices
        (m,): index of the shot of each set of peaks.
    peaks
        Peaks of the three segments, (m, 3).
    is_detected
        (3, m): True for segments that are detected. The Doppler segment's beat is used only if the
        chirp slopes differ from the default or any two segments detect a shot.

    Returns
    -------
    MeanSquareErrors
        (m,) each; 0 without developed speckle.

    Notes
    -----
    The result is the diagonal of J M J'. M holds the second moments of the errors of the peaks'
    positions (:func:`position_error_moments`). J holds the derivatives of range and velocity by
    these positions, and J' is its transpose.
    """
    if shots.speckle.line_gradients is None:
        return MeanSquareErrors(np.zeros(point_indices.size), np.zeros(point_indices.size))
    beat_covariance_bins = position_error_moments(
        shots.speckle.line_gradients.select(point_indices), peaks, shots, from_three_bins=False
    )
    is_resolved = np.array(
        [
            True,
            shots.waveform.chirp_rate_ratios != waveform.DEFAULT_CHIRP_RATE_RATIOS
            or shots.detects_by_any_two_segments,
            True,
        ]
    )
    coefficients = shots.beat_coefficients.select_points(point_indices)
    response_arguments = {
        "weights": 1.0 * (is_detected & is_resolved[:, None]),
        "carriers": coefficients.carrier,
        "chirp_rates": coefficients.chirp_rate,
    }
    bin_width = np.broadcast_to(shots.sample_rate, shots.size)[point_indices] / shots.fft_size
    response_per_bin = np.array(
        [
            waveform.range_velocity_response(unit[:, None] * bin_width, **response_arguments)
            for unit in np.eye(3)
        ]
    )
    return MeanSquareErrors(
        *np.einsum("iam,mij,jam->am", response_per_bin, beat_covariance_bins, response_per_bin)
    )


def mean_range_velocity_wander_variance(
    shots: Shots, pd: np.ndarray, snr: np.ndarray
) -> MeanSquareErrors:
    """Return the mean square errors of range and radial velocity at n points due to speckle.

    Means are over draws in which the echo is detected.

    Parameters
    ----------
    shots
        Prepared shots of n points.
    pd, snr
        (3, n): probability of detection and SNR of each segment; nan for a segment that does not
        exist.

    Returns
    -------
    MeanSquareErrors
        (n,) each.

    Notes
    -----
    The power q^2 of a detected peak, in units of its mean, is exponential beyond A = -ln pd. The
    mean square error is proportional to 1 / q^2. The mean of 1 / q^2 is e^A E_1(A) with the
    exponential integral E_1.
    """
    is_present = np.isfinite(pd) & np.isfinite(snr) & (pd > 0)
    with np.errstate(divide="ignore"):
        detection_exponent = np.clip(
            -np.log(np.where(is_present, pd, 1.0)), 1e-6, NEGATIVE_LOG_PD_MAX
        )
    mean_inverse_power = np.exp(detection_exponent) * exp1(detection_exponent)
    relative_power = np.where(is_present, 1 / np.maximum(mean_inverse_power, 1e-300), np.nan).T
    echo_fraction = np.where(is_present, snr / (1 + snr), np.nan).T
    point_indices = np.arange(shots.size)
    peaks = SpecklePeaks(
        np.zeros(relative_power.shape), folding_signs(shots), relative_power, echo_fraction
    )
    return range_velocity_wander_variance(shots, point_indices, peaks, is_present)
