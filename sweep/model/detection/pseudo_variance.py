"""Developed speckle in bins near DC and Nyquist of a real record, where it is noncircular.

A real record holds each line A e^(i phase) and its image, the complex conjugate at the opposite
frequency. With phases relative to the record's middle, the window's transform G is real and even.
Bin k of lines at the positions nu is

    X = sum_b (A_b G(k - nu_b) + conj(A_b) G(k + nu_b)) + noise.

With circular complex Gaussian amplitudes A_b of mean power P_b it is a Gaussian number. The mean
power is S + 2 sigma^2, with the signal's power S and the noise per quadrature sigma. The
pseudo-variance is

    E[X^2] = 2 sum_b P_b G(k - nu_b) G(k + nu_b) + 2 sigma^2 W2(2k) / W2(0),

with the transform W2 of the squared window. The pseudo-variance is real, so the quadratures are
independent. Their variances are (1 +- q) / 2 of the mean power, with q = E[X^2] / E[|X|^2]. At DC
and Nyquist q is 1, and X is real. Some bins away q is 0, and X is circular.

The law of |X|^2 is in :mod:`sweep.model.detection.hoyt`.

Two effects on G are neglected here: phase errors within the record, which widen a line, and missing
samples of an echo that arrives late. Neither changes q at DC, where it is 1.
"""

import math
from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from sweep.model.detection.detectors import main_lobe_half_width
from sweep.model.detection.hoyt import N_PHASE_NODES, PHASE_COSINES, hoyt_tails
from sweep.model.detection.look_speckle import (
    gamma_sum_tails,
    speckle_lattice_amplitudes,
    vote_probability_given_speckle,
)
from sweep.model.detection.looks import COMBINE_POWER, Looks, PdAndMissArrays
from sweep.model.detection.speckle_correlation import window_transform
from sweep.model.spectrum.search_restriction import axis_line_positions, beamlet_line_positions
from sweep.model.window import Window, window_samples

PSEUDO_VARIANCE_RATIO_MIN = 0.05
"""Value of |E[X^2]| / E[|X|^2] of a bin X in speckle below which X is treated as circular. The
probability of detection then errs by less than 2e-4."""


class SignalPseudoVariance(NamedTuple):
    """Pseudo-variance ratio q of echoes near DC and Nyquist, where lines overlap their images.

    A bin X has q = E[X^2] / E[|X|^2], which is 0 for circular X.
    """

    pseudo_variance_row: np.ndarray
    """(segments, n) int64: row of ``pseudo_variance_ratio`` and ``relative_power_by_phase`` for
    each echo. Row 0, in which the ratio is 0, is for echoes far from DC and Nyquist."""
    pseudo_variance_ratio: np.ndarray
    """(rows, bins): pseudo-variance ratio E[X^2] / E[|X|^2] of a bin X, by distance [bins] from the
    nearer of DC and Nyquist."""
    relative_power_by_phase: np.ndarray
    """(rows, N_PHASE_NODES): echo power at each phase t of the speckle over the mean over t. It is
    1 + q cos t, with the pseudo-variance ratio q of the strongest bin. With ``any_bin`` detection
    the numerator is the power of the bin that is strongest at that phase."""


def signal_pseudo_variance(shots: Any) -> SignalPseudoVariance:
    """Compute the pseudo-variance ratios of the echoes of prepared shots with real records."""
    fft_size, padding_factor = shots.fft_size, shots.fft_size / shots.window.length
    n_bins = n_pseudo_variance_bins(shots.window, fft_size)
    pseudo_variance_row = np.zeros((len(shots.waveform_segments), shots.size), np.int64)
    ratio_rows, factor_rows = [np.zeros((1, n_bins))], [np.ones((1, N_PHASE_NODES))]
    near_end = lines_overlap_images(shots)
    for s in np.flatnonzero(shots.has_segment):
        points = np.flatnonzero(near_end[s])
        if not points.size:
            continue
        line_positions = beamlet_line_positions(shots, points)[:, s]
        # About Nyquist lines and images mirror as about DC.
        is_near_nyquist = line_positions.mean(axis=1) > fft_size / 4
        line_positions = (
            np.where(is_near_nyquist[:, None], fft_size / 2 - line_positions, line_positions)
            / padding_factor
        )
        line_power = shots.footprint.relative_amplitude[shots.footprint.row_of_point[points]] ** 2
        bin_positions = np.arange(n_bins) / padding_factor
        line_transform = window_transform(shots.window, bin_positions - line_positions[..., None])
        image_transform = window_transform(shots.window, bin_positions + line_positions[..., None])
        mean_power = (
            line_power[..., None]
            * (line_transform * line_transform + image_transform * image_transform)
        ).sum(axis=1)
        pseudo_variance = (line_power[..., None] * 2 * line_transform * image_transform).sum(axis=1)
        pseudo_variance_row[s, points] = sum(map(len, ratio_rows)) + np.arange(points.size)
        ratio_rows.append(
            np.where(mean_power > 1e-12 * mean_power.max(axis=1)[:, None], pseudo_variance, 0.0)
        )
        ratio_rows[-1] /= np.maximum(mean_power, 1e-300)
        ratio_rows[-1][:, 0] = 1.0
        power_by_phase = mean_power[..., None] * (1 + ratio_rows[-1][..., None] * PHASE_COSINES)
        peak_power = np.take_along_axis(
            power_by_phase, mean_power.argmax(axis=1)[:, None, None], axis=1
        )[:, 0]
        phase_power = (
            peak_power
            if shots.detection_settings.echo_bin_rule == "peak_bin"
            else power_by_phase.max(axis=1)
        )
        peak_mean_power = mean_power.max(axis=1)[:, None]
        factor_rows.append(
            np.where(peak_mean_power > 0, phase_power / np.maximum(peak_mean_power, 1e-300), 1.0)
        )
    return SignalPseudoVariance(
        pseudo_variance_row, np.concatenate(ratio_rows), np.concatenate(factor_rows)
    )


def mean_joint_pd_over_phases(
    relative_power_by_phase: np.ndarray,
    pd_by_segment: tuple[np.ndarray, ...],
    joint_pd_function: Callable[..., tuple[np.ndarray, ...]],
) -> tuple[np.ndarray, ...]:
    """Average a joint probability of detection over the phases of the segments' noncircular echoes.

    Parameters
    ----------
    relative_power_by_phase
        (segments, n, N_PHASE_NODES): relative echo power at the phase nodes, as in
        :class:`SignalPseudoVariance`.
    pd_by_segment
        (..., n) for each segment: probability that it is detected.
    joint_pd_function
        Function of the segments' probabilities, one argument (..., n) each, for circular echoes. It
        returns a tuple of arrays (..., n).

    Returns
    -------
    tuple of numpy.ndarray
        Mean over the phases of each result of ``joint_pd_function``, (..., n).

    Notes
    -----
    The echo's power at the phase t is f = 1 + q cos t times its mean, with the pseudo-variance
    ratio q. The bin is detected with exp(-A / f), like a circular number of this power. A is such
    that the mean over t is the given probability. Phases of different segments are independent.
    """
    pd_at_phases = [
        _pd_at_phases(*arguments)
        for arguments in zip(pd_by_segment, relative_power_by_phase, strict=True)
    ]
    sums: list[np.ndarray] = []
    for j in range(N_PHASE_NODES):
        # No two segments have the same order of phases.
        results = joint_pd_function(
            *(
                segment_pd[(1 + 2 * s) * j % N_PHASE_NODES]
                for s, segment_pd in enumerate(pd_at_phases)
            )
        )
        sums = [a + b for a, b in zip(sums, results, strict=True)] if sums else list(results)
    return tuple(value / N_PHASE_NODES for value in sums)


def _pd_at_phases(mean_pd: np.ndarray, relative_power_by_phase: np.ndarray) -> np.ndarray:
    """Return probabilities of detection at all speckle phases, (N_PHASE_NODES, ..., n).

    The probabilities are exp(-A / f), with the relative echo power f at each phase. A is found by
    bisection so that the mean over the phases is ``mean_pd`` (..., n).
    """
    relative_power_by_phase = relative_power_by_phase.T.reshape(
        N_PHASE_NODES, *[1] * (mean_pd.ndim - 1), -1
    )
    is_defined = np.isfinite(mean_pd)
    target_pd = np.where(is_defined, mean_pd, 0.5)
    low, high = np.zeros(mean_pd.shape), np.full(mean_pd.shape, 700.0)
    for _ in range(50):
        exponent = 0.5 * (low + high)
        is_above_target = np.exp(-exponent / relative_power_by_phase).mean(axis=0) > target_pd
        low, high = (
            np.where(is_above_target, exponent, low),
            np.where(is_above_target, high, exponent),
        )
    return np.where(is_defined, np.exp(-0.5 * (low + high) / relative_power_by_phase), np.nan)


def lines_overlap_images(shots: Any) -> np.ndarray:
    """Test if the lines of echoes overlap their images at DC or Nyquist, (segments, n) bool."""
    overlap_distance = _image_reach(shots.window) * shots.fft_size / shots.window.length
    position = axis_line_positions(shots)
    distance_from_end = np.minimum(position, shots.fft_size / 2 - position)
    return np.asarray(distance_from_end - 3 * shots.speckle.line_deviation_bins < overlap_distance)


@lru_cache(maxsize=64)
def n_pseudo_variance_bins(window: Window, fft_size: int) -> int:
    """Return the number of bins next to DC or Nyquist with a tabulated pseudo-variance.

    Parameters
    ----------
    window : Window
        Window of the record, of L samples (:class:`sweep.model.window.Window`).
    fft_size : int
        FFT size N >= L.

    Returns
    -------
    int
        Number of bins, including the one at DC or Nyquist; at most floor(N/4) + 1.

    Notes
    -----
    The farthest bin is r + h + 1 from DC, in units of the sample rate over L. r is the distance of
    a line from DC beyond which the line's image is negligible. h is the half-width of the window's
    main lobe.
    """
    last_bin = (_image_reach(window) + main_lobe_half_width(window) + 1) * fft_size / window.length
    return min(math.ceil(last_bin) + 1, fft_size // 4 + 1)


@lru_cache(maxsize=64)
def noise_pseudo_variance_ratio(window: Window, fft_size: int) -> np.ndarray:
    """Return the pseudo-variance ratio E[n^2] / E[|n|^2] of white noise n by bin, (bins,).

    Parameters
    ----------
    window : Window
        Window of the record, of L samples (:class:`sweep.model.window.Window`).
    fft_size : int
        FFT size N >= L.

    Returns
    -------
    ndarray (bins,)
        Ratio, -1..1, in bins k = 0, 1, .. from DC or Nyquist. The number of bins is that of
        :func:`n_pseudo_variance_bins`.

    Notes
    -----
    The ratio is W2(2k) / W2(0), with the transform W2 of the squared window about the middle of the
    record. Ratios up to 1e-12 in modulus are set to 0.
    """
    squared_window = window_samples(window.name, window.length) ** 2
    record_position = (np.arange(window.length) - window.length / 2) / fft_size
    bin_numbers = np.arange(n_pseudo_variance_bins(window, fft_size))
    ratios = [
        (squared_window * np.cos(4 * np.pi * k * record_position)).sum() / squared_window.sum()
        for k in bin_numbers
    ]
    return np.where(np.abs(ratios) > 1e-12, ratios, 0.0)


def _image_reach(window: Window) -> float:
    """Return the distance of a line from DC beyond which its image is negligible.

    The unit is the sample rate over the number of samples in the record. The image is the line's
    mirror at the opposite frequency.
    """
    distance = window.envelope_distances[
        np.argmax(window.sidelobe_envelope < PSEUDO_VARIANCE_RATIO_MIN / 2)
    ]
    return 0.5 * min(float(distance), 12.0)


_EIGENVALUE_FRACTION_MIN = 1e-7
"""Fraction of the total power of all looks below which an eigenvalue of the covariance of the
looks' echo amplitudes is dropped."""


def multilook_pd_and_miss_near_ends(
    looks: Looks,
    signal: np.ndarray,
    threshold_ratio: np.ndarray,
    signal_pseudo_variance: np.ndarray,
    noise_pseudo_variance: np.ndarray,
    look_covariance: np.ndarray,
) -> PdAndMissArrays:
    """Return probabilities of detection and of a miss in several looks of bins near DC or Nyquist.

    Echoes are in developed speckle. Each of m echoes is represented by one bin.

    Parameters
    ----------
    looks : Looks
        Number of looks (records of each segment) and how they are combined.
    signal, threshold_ratio : ndarray (m,)
        Root mean square |X| and threshold over the noise per quadrature of one look.
    signal_pseudo_variance, noise_pseudo_variance : ndarray (m,)
        Pseudo-variance ratio q of the signal, and of the noise.
    look_covariance : ndarray (m, k, k) complex
        Covariance of the echo amplitudes of k looks, of mean power 1, including the rotation of the
        line's phase from look to look. k looks represent all N.

    Notes
    -----
    Let g_k be the echo's amplitude in look k. Bin X_k = u_k + i v_k has the quadratures
    ``u = sqrt(1 + q) Re g``, ``v = sqrt(1 - q) Im g`` times the root of the signal's power, as the
    line and its image have the phases of g and of its conjugate. All 2N quadratures are Gaussian.
    The sum of all |X_k|^2 is thus one of independent squared Gaussian variables, whose variances
    are the eigenvalues of the quadratures' covariance matrix.

    The probability of enough votes given the amplitudes is averaged over a fixed lattice, as for
    looks far from DC. For noise with a pseudo-variance ratio between 0 and 1, the probabilities for
    circular and for real noise are averaged.
    """
    signal_power = np.square(signal)
    if looks.combine_kind == COMBINE_POWER:
        quadrature_scales = np.stack(
            [
                np.sqrt(1 + signal_pseudo_variance),
                np.sqrt(np.maximum(1 - signal_pseudo_variance, 0.0)),
            ],
            axis=1,
        )
        n_kept = look_covariance.shape[-1]
        real_part, imaginary_part = look_covariance.real, look_covariance.imag
        quadrature_covariance = np.block(
            [[real_part, -imaginary_part], [imaginary_part, real_part]]
        )
        amplitude_scales = np.repeat(quadrature_scales, n_kept, axis=1)
        amplitude_scales *= np.sqrt(0.5 * signal_power * looks.number / n_kept)[:, None]
        noise_power = np.stack([1 + noise_pseudo_variance, 1 - noise_pseudo_variance], axis=1)
        covariance_matrix = (
            amplitude_scales[:, :, None] * amplitude_scales[:, None, :] * quadrature_covariance
        )
        covariance_matrix += np.repeat(noise_power, n_kept, axis=1)[:, :, None] * np.eye(2 * n_kept)
        eigenvalues = np.concatenate([np.linalg.eigvalsh(covariance_matrix), noise_power], axis=1)
        gamma_shape = np.full(eigenvalues.shape, 0.5)
        gamma_shape[:, 2 * n_kept :] = 0.5 * (
            looks.number - n_kept
        )  # looks that others represent: noise
        gamma_scale = 2 * np.maximum(eigenvalues, 0.0)
        return PdAndMissArrays(
            *gamma_sum_tails(gamma_shape, gamma_scale, looks.number * np.square(threshold_ratio))
        )
    pd = np.empty(signal.shape)
    for bin_index, covariance_matrix in enumerate(look_covariance):
        n_represented = covariance_matrix.shape[-1]

        def mean_vote_probability(amplitudes: np.ndarray, bin_index: int = bin_index) -> float:
            """Return the probability that enough looks cross, averaged over m speckle draws.

            Parameters
            ----------
            amplitudes : ndarray (m, k) complex
                Echo amplitudes of the k looks in these draws, of mean power 1.
            bin_index : int
                Index of the echo, 0 .. number of echoes - 1.

            Returns
            -------
            float
                Mean probability that at least ``looks.votes_needed`` looks cross the threshold.
            """
            magnitudes = np.hypot(
                math.sqrt(1 + signal_pseudo_variance[bin_index]) * amplitudes.real,
                math.sqrt(max(1 - signal_pseudo_variance[bin_index], 0.0)) * amplitudes.imag,
            )
            real_fraction = abs(float(noise_pseudo_variance[bin_index]))
            mean_probability = 0.0
            for is_real, weight in ((True, real_fraction), (False, 1 - real_fraction)):
                if weight > 0:
                    vote_probabilities = vote_probability_given_speckle(
                        signal[bin_index],
                        threshold_ratio[bin_index],
                        looks.votes_needed,
                        magnitudes,
                        is_real,
                    )
                    mean_probability += weight * float(vote_probabilities.mean())
            return mean_probability

        q = (
            signal_power[bin_index] * signal_pseudo_variance[bin_index]
            + 2 * noise_pseudo_variance[bin_index]
        ) / (signal_power[bin_index] + 2)
        record_tails = hoyt_tails(signal_power[bin_index] + 2, abs(q), threshold_ratio[bin_index])
        pd[bin_index] = looks.vote_probabilities(*np.array(record_tails)).pd
        independence = (n_represented**2 / np.square(np.abs(covariance_matrix)).sum() - 1) / max(
            n_represented - 1, 1
        )
        if independence < 1 - 1e-9:
            look_eigenvalues, look_eigenvectors = np.linalg.eigh(covariance_matrix)
            is_used = look_eigenvalues > _EIGENVALUE_FRACTION_MIN * n_represented
            covariance_root = look_eigenvectors[:, is_used] * np.sqrt(look_eigenvalues[is_used])
            # Less the lattice's error for independent looks, in proportion.
            lattice_error = pd[bin_index] - mean_vote_probability(
                speckle_lattice_amplitudes(n_represented)
            )
            lattice_pd = mean_vote_probability(
                speckle_lattice_amplitudes(int(is_used.sum())) @ covariance_root.T
            )
            pd[bin_index] = lattice_pd + independence * lattice_error
    pd = np.clip(pd, 0.0, 1.0)
    return PdAndMissArrays(pd, 1 - pd)
