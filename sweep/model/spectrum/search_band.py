"""Bins in which targets of a search band, given by ranges and radial velocities, may appear.

A target of the band, of range R0 .. R1 at the start of a segment and velocity v0 .. v1, has a beat

    f_seg beta - s S (2 R / c) (1 + beta),    beta = 2 v / c

(:mod:`sweep.model.waveform`). The beat is monotonic in R and in v, so it lies between the least and
the largest beat at the four corners of the band. The bins nearest to all these beats are searched.
Real records fold this interval, complex records wrap it around the circle of signed bins
(docs/physics.md, *Search band*). An echo is in the band if its strongest bin is. It is then
detected by those of its bins that are searched. Otherwise it is not detected, and its signal in
searched bins is leakage.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from sweep.model.shot_settings import RecordSettings, WaveformSettings
from sweep.model.waveform import (
    SEARCH_RANGE_LIMIT_PATHS,
    SEARCH_VELOCITY_LIMIT_PATHS,
    SEGMENT_NAMES,
    beat_frequency,
    fold_frequency,
)


def search_band_start_and_size(
    parameters: Mapping[str, Any],
    waveform: WaveformSettings,
    record: RecordSettings,
    n_points: int | None = None,
) -> np.ndarray | None:
    """Return the first bin and the number of bins that are searched, or None if all bins are.

    Parameters
    ----------
    parameters
        Parameters by path, with all or none of the search band's limits.
    waveform
        Waveform of the points' shots.
    record
        Record of each segment.
    n_points
        Number of points to which the result is broadcast.

    Returns
    -------
    numpy.ndarray
        (3, 2, n_points) int64: by segment (up, Doppler, down), first bin and number of bins. Bins
        are 0 .. N/2, or -N/2 .. N/2 - 1 of a complex record. Without ``n_points``, the last
        dimensions are those of the parameters.
    """
    if SEARCH_RANGE_LIMIT_PATHS[0] not in parameters:
        return None
    beats = [
        beat_frequency(
            slope,
            carrier=carrier,
            chirp_rate=waveform.chirp_rate,
            range=np.asarray(parameters[range_path], float),
            radial_velocity=np.asarray(parameters[velocity_path], float),
        )
        / record.bin_width
        for slope, carrier in zip(waveform.chirp_rate_ratios, waveform.carriers, strict=True)
        for range_path in SEARCH_RANGE_LIMIT_PATHS
        for velocity_path in SEARCH_VELOCITY_LIMIT_PATHS
    ]
    beats_by_segment = np.split(np.array(np.broadcast_arrays(*beats)), len(SEGMENT_NAMES))
    band_bins = np.array(
        [
            _bins_of_beat_interval(
                corner_beats.min(axis=0), corner_beats.max(axis=0), record.fft_size,
                record.is_complex,
            )
            for corner_beats in beats_by_segment
        ]
    )  # fmt: skip
    return band_bins if n_points is None else np.broadcast_to(band_bins.T, (n_points, 2, 3)).T


def _bins_of_beat_interval(
    beat_min: np.ndarray, beat_max: np.ndarray, fft_size: int, is_signed: bool
) -> np.ndarray:
    """Return the first bin and the number of bins nearest to beats in an interval, (2, ...).

    The interval is ``beat_min`` to ``beat_max`` [bins]. ``is_signed`` is true for complex records,
    whose bins have signed frequencies.
    """
    if is_signed:
        first_bin, last_bin = np.floor(beat_min + 0.5), np.floor(beat_max + 0.5)
        first_bin, n_bins = (
            (first_bin + fft_size // 2) % fft_size - fft_size // 2,
            np.minimum(last_bin - first_bin + 1, fft_size),
        )
        return np.array([first_bin, n_bins], np.int64)
    folded_ends = fold_frequency(np.array([beat_min, beat_max]), np.asarray(float(fft_size)))
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
    """Return the number of bins of a search band that may raise a false alarm, by segment.

    Parameters
    ----------
    band_bins : ndarray (3, 2, ...) int64
        First bin and number of bins of each segment (:func:`search_band_start_and_size`).
    fft_size : int
        FFT size.
    first_alarm_bin : int
        Distance from DC and from Nyquist from which on bins of a real record raise alarms [bins].
    is_signed : bool
        True for complex records, in which all bins may raise alarms.

    Returns
    -------
    ndarray (3, ...)
        Number of bins, 0 or more.
    """
    if is_signed:
        return band_bins[:, 1].astype(float)
    first_bin, last_bin = (
        np.maximum(band_bins[:, 0], first_alarm_bin),
        np.minimum(band_bins.sum(axis=1) - 1, fft_size // 2 - first_alarm_bin),
    )
    return np.maximum(last_bin - first_bin + 1.0, 0.0)


def is_searched(shots: Any, segment: int, point: int, bins: ArrayLike) -> np.ndarray:
    """Return whether bins are in the search band of one segment of one point.

    Parameters
    ----------
    shots : Shots
        Prepared shots.
    segment, point : int
        Indices of the segment (up, Doppler, down) and of the point.
    bins : array_like of int
        Numbers of the bins.

    Returns
    -------
    ndarray of bool
        True for searched bins. Without a search band all bins are searched.
    """
    if shots.detection_settings.search_band is None:
        return np.ones(np.shape(bins), bool)
    first_bin, n_bins = shots.detection_settings.search_band[segment, :, point]
    distance = np.asarray(bins) - first_bin
    if shots.complex_record:
        distance %= shots.fft_size
    return np.asarray((distance >= 0) & (distance < n_bins))
