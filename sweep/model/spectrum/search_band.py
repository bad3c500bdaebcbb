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
from typing import Any, NamedTuple

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


class SearchBand(NamedTuple):
    """Bins that are searched for echoes, by segment and point: (3, n) arrays.

    Compiled functions take the band of one segment of one point, of which all fields are scalars.
    """

    first_bin: Any
    """(3, n) int64: number of the first searched bin, 0 .. N/2, or -N/2 .. N/2 - 1 of a complex
    record. N is the FFT size."""
    n_bins: Any
    """(3, n) int64: number of searched bins."""
    period_bins: int
    """FFT size N of a complex record, whose spectrum is periodic; 0 of a real record."""

    def select_points(self, point_indices: np.ndarray) -> "SearchBand":
        """Return the band of some points (m,), in arrays (3, m) in C order."""
        first_bin, n_bins = (
            np.ascontiguousarray(values[:, point_indices])
            for values in (self.first_bin, self.n_bins)
        )
        return SearchBand(first_bin, n_bins, self.period_bins)

    def contains(self, bins: np.ndarray) -> np.ndarray:
        """Return whether bins, whose numbers broadcast against the fields, are searched."""
        distance = bins - self.first_bin
        if self.period_bins:
            distance %= self.period_bins
        return np.asarray((distance >= 0) & (distance < self.n_bins))


def search_band_of_points(
    parameters: Mapping[str, Any],
    waveform: WaveformSettings,
    record: RecordSettings,
    n_points: int | None = None,
) -> SearchBand | None:
    """Return the bins that are searched at each point, or None if all bins are.

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
    SearchBand or None
        (3, n_points) in each array, by segment (up, Doppler, down). Without ``n_points``, the last
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
    band_by_segment = [
        _bins_of_beat_interval(
            corner_beats.min(axis=0), corner_beats.max(axis=0), record.fft_size, record.is_complex
        )
        for corner_beats in beats_by_segment
    ]
    first_bin, n_bins = (
        np.array(values, np.int64)
        for values in (
            [band.first_bin for band in band_by_segment],
            [band.n_bins for band in band_by_segment],
        )
    )
    if n_points is not None:
        first_bin, n_bins = (
            np.broadcast_to(values.T, (n_points, len(SEGMENT_NAMES))).T
            for values in (first_bin, n_bins)
        )
    return SearchBand(first_bin, n_bins, record.fft_size if record.is_complex else 0)


def _bins_of_beat_interval(
    beat_min: np.ndarray, beat_max: np.ndarray, fft_size: int, is_complex: bool
) -> SearchBand:
    """Return the :class:`SearchBand` of the bins nearest to the beats in an interval.

    Its first bin and its number of bins are whole floating-point numbers; its third field is the
    FFT size of a complex record, or 0. The interval is ``beat_min`` to ``beat_max`` [bins].
    ``is_complex`` is true for complex records, whose bins have signed frequencies.
    """
    if is_complex:
        first_bin, last_bin = np.floor(beat_min + 0.5), np.floor(beat_max + 0.5)
        first_bin, n_bins = (
            (first_bin + fft_size // 2) % fft_size - fft_size // 2,
            np.minimum(last_bin - first_bin + 1, fft_size),
        )
        return SearchBand(first_bin, n_bins, fft_size)
    folded_ends = fold_frequency(np.array([beat_min, beat_max]), np.asarray(float(fft_size)))
    bin_min = np.where(
        np.floor(beat_max / fft_size) * fft_size >= beat_min, 0.0, folded_ends.min(axis=0)
    )
    nyquist_multiple = (np.floor(beat_max / fft_size - 0.5) + 0.5) * fft_size
    bin_max = np.where(nyquist_multiple >= beat_min, 0.5 * fft_size, folded_ends.max(axis=0))
    first_bin, last_bin = (
        np.minimum(np.floor(value + 0.5), fft_size // 2) for value in (bin_min, bin_max)
    )
    return SearchBand(first_bin, last_bin - first_bin + 1, 0)


def n_alarm_bins(search_band: SearchBand, fft_size: int, first_alarm_bin: int) -> np.ndarray:
    """Return the number of bins of a search band that may raise a false alarm, by segment.

    Parameters
    ----------
    search_band : SearchBand
        Searched bins of each segment.
    fft_size : int
        FFT size.
    first_alarm_bin : int
        Distance from DC and from Nyquist from which on bins of a real record raise alarms [bins].
        All bins of a complex record may raise alarms.

    Returns
    -------
    ndarray (3, ...)
        Number of bins, 0 or more.
    """
    if search_band.period_bins:
        return np.asarray(search_band.n_bins.astype(float))
    first_bin = np.maximum(search_band.first_bin, first_alarm_bin)
    last_bin = np.minimum(
        search_band.first_bin + search_band.n_bins - 1, fft_size // 2 - first_alarm_bin
    )
    return np.maximum(last_bin - first_bin + 1.0, 0.0)


def is_searched(shots: Any, segment: int, point: int, bins: ArrayLike) -> np.ndarray:
    """Return True for bins that are in the search band of one segment of one point.

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
    band = shots.detection_settings.search_band
    if band is None:
        return np.ones(np.shape(bins), bool)
    point_band = SearchBand(
        band.first_bin[segment, point], band.n_bins[segment, point], band.period_bins
    )
    return point_band.contains(np.asarray(bins))
