"""Bins into which the ranges and radial velocities of a search band put a beat.

A target of the band, range R0 .. R1 as a segment starts and velocity v0 .. v1, has its beat

    f_seg beta - s S (2 R / c) (1 + beta),    beta = 2 v / c

(:mod:`sweep.model.waveform`) between the least and the largest at the band's four corners, as it is
monotonic in R and in v. The bins searched are those nearest to all these beats; real records fold
this interval, complex ones take it round the circle of signed bins (docs/physics.md, *Search
band*). An echo is in the band where its strongest bin is, and is then detected by those of its bins
that are searched. Else it is not detected, and what it shows in searched bins is leakage.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from sweep.model import waveform
from sweep.model.waveform import SEARCH_RANGE_PATHS, SEARCH_VELOCITY_PATHS


def search_band_bins(
    parameters: Mapping[str, Any], n_points: int | None = None
) -> np.ndarray | None:
    """First bin and number of bins that are searched, (3, 2, points) int64; None for all.

    By segment: up, Doppler, down. Bins are 0..N/2, of a complex record -N/2 .. N/2 - 1. Points
    share their words and sizes, and have all or none of :data:`ENDS`. Without ``n_points``: (3, 2,
    ...).
    """
    if SEARCH_RANGE_PATHS[0] not in parameters:
        return None
    slopes, carriers = waveform.chirp_slopes(parameters), waveform.segment_carriers(parameters)
    fft_size = int(np.max(parameters["instrument.processing.fft_size"]))
    bin_width = parameters["instrument.processing.sample_rate"] / fft_size
    chirp_rate = parameters["instrument.chirp.bandwidth"] / parameters["instrument.chirp.duration"]
    is_signed = str(parameters.get("instrument.receiver.record", "real")) == "complex"
    bands = []
    for slope, carrier in zip(slopes, carriers, strict=True):
        corners = [
            waveform.beat_frequency(
                slope,
                carrier=carrier,
                chirp_rate=chirp_rate,
                range=np.asarray(parameters[range_path], float),
                radial_velocity=np.asarray(parameters[velocity_path], float),
            )
            / bin_width
            for range_path in SEARCH_RANGE_PATHS
            for velocity_path in SEARCH_VELOCITY_PATHS
        ]
        beats = np.array(np.broadcast_arrays(*corners))
        bands.append(_nearest_bins(beats.min(axis=0), beats.max(axis=0), fft_size, is_signed))
    band_bins = np.array(bands)
    return band_bins if n_points is None else np.broadcast_to(band_bins.T, (n_points, 2, 3)).T


def _nearest_bins(
    beat_min: np.ndarray, beat_max: np.ndarray, fft_size: int, is_signed: bool
) -> np.ndarray:
    """First bin and number of bins, (2, ...), of beats from ``beat_min`` to ``beat_max`` [bins]."""
    if is_signed:
        first_bin, last_bin = np.floor(beat_min + 0.5), np.floor(beat_max + 0.5)
        first_bin, n_bins = (
            (first_bin + fft_size // 2) % fft_size - fft_size // 2,
            np.minimum(last_bin - first_bin + 1, fft_size),
        )
        return np.array([first_bin, n_bins], np.int64)
    folded_ends = waveform.fold_frequency(
        np.array([beat_min, beat_max]), np.asarray(float(fft_size))
    )
    bin_min = np.where(
        np.floor(beat_max / fft_size) * fft_size >= beat_min, 0.0, folded_ends.min(axis=0)
    )
    nyquist_multiple = (np.floor(beat_max / fft_size - 0.5) + 0.5) * fft_size
    bin_max = np.where(nyquist_multiple >= beat_min, 0.5 * fft_size, folded_ends.max(axis=0))
    first_bin, last_bin = (
        np.minimum(np.floor(value + 0.5), fft_size // 2) for value in (bin_min, bin_max)
    )
    return np.array([first_bin, last_bin - first_bin + 1], np.int64)


def n_alarm_bins(
    band_bins: np.ndarray, fft_size: int, first_alarm_bin: int, *, is_signed: bool
) -> np.ndarray:
    """Count the bins of a band (3, 2, ...) that may raise an alarm, (3, ...).

    Of a real record those from ``first_alarm_bin`` on, counted from DC and from Nyquist.
    """
    if is_signed:
        return band_bins[:, 1].astype(float)
    first_bin, last_bin = (
        np.maximum(band_bins[:, 0], first_alarm_bin),
        np.minimum(band_bins.sum(axis=1) - 1, fft_size // 2 - first_alarm_bin),
    )
    return np.maximum(last_bin - first_bin + 1.0, 0.0)


def is_searched(shots: Any, segment: int, point: int, bins: ArrayLike) -> np.ndarray:
    """Tell which bins of a segment of point i are searched."""
    if shots.detection_settings.search_band is None:
        return np.ones(np.shape(bins), bool)
    first_bin, n_bins = shots.detection_settings.search_band[segment, :, point]
    distance = np.asarray(bins) - first_bin
    if shots.complex_record:
        distance %= shots.fft_size
    return np.asarray((distance >= 0) & (distance < n_bins))
