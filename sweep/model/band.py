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
from sweep.model.waveform import RANGES, VELOCITIES


def band_of(p: Mapping[str, Any], points: int | None = None) -> np.ndarray | None:
    """First bin and number of bins that are searched, (3, 2, points) int64; None for all.

    By segment: up, Doppler, down. Bins are 0..N/2, of a complex record -N/2 .. N/2 - 1. Points
    share their words and sizes, and have all or none of :data:`ENDS`. Without ``points``: (3, 2,
    ...).
    """
    if RANGES[0] not in p:
        return None
    slopes, carriers = waveform.slopes_of(p), waveform.carriers_of(p)
    size = int(np.max(p["instrument.processing.fft_size"]))
    width = p["instrument.processing.sample_rate"] / size
    rate = p["instrument.chirp.bandwidth"] / p["instrument.chirp.duration"]
    is_signed = str(p.get("instrument.receiver.record", "real")) == "complex"
    bands = []
    for slope, carrier in zip(slopes, carriers, strict=True):
        corners = [
            waveform.beat_frequency(
                slope, carrier=carrier, chirp_rate=rate, range=np.asarray(p[far], float),
                radial_velocity=np.asarray(p[fast], float),
            ) / width
            for far in RANGES for fast in VELOCITIES
        ]  # fmt: skip
        beats = np.array(np.broadcast_arrays(*corners))
        bands.append(_bins(beats.min(axis=0), beats.max(axis=0), size, is_signed))
    found = np.array(bands)
    return found if points is None else np.broadcast_to(found.T, (points, 2, 3)).T


def _bins(low: np.ndarray, high: np.ndarray, size: int, is_signed: bool) -> np.ndarray:
    """First bin and number of bins, (2, ...), nearest to beats from ``low`` to ``high`` [bins]."""
    if is_signed:
        first, last = np.floor(low + 0.5), np.floor(high + 0.5)
        first, number = (first + size // 2) % size - size // 2, np.minimum(last - first + 1, size)
        return np.array([first, number], np.int64)
    ends = waveform.fold(np.array([low, high]), np.asarray(float(size)))
    least = np.where(np.floor(high / size) * size >= low, 0.0, ends.min(axis=0))
    odd = (np.floor(high / size - 0.5) + 0.5) * size
    most = np.where(odd >= low, 0.5 * size, ends.max(axis=0))
    first, last = (np.minimum(np.floor(v + 0.5), size // 2) for v in (least, most))
    return np.array([first, last - first + 1], np.int64)


def number_of(band: np.ndarray, size: int, first: int, *, is_signed: bool) -> np.ndarray:
    """Count the bins of a band (3, 2, ...) that may raise an alarm, (3, ...).

    Of a real record those from ``first`` on, counted from DC and from Nyquist.
    """
    if is_signed:
        return band[:, 1].astype(float)
    low, high = np.maximum(band[:, 0], first), np.minimum(band.sum(axis=1) - 1, size // 2 - first)
    return np.maximum(high - low + 1.0, 0.0)


def is_searched(shots: Any, segment: int, i: int, bins: ArrayLike) -> np.ndarray:
    """Tell which bins of a segment of point i are searched."""
    if shots.band is None:
        return np.ones(np.shape(bins), bool)
    first, number = shots.band[segment, :, i]
    apart = np.asarray(bins) - first
    if shots.complex_record:
        apart %= shots.fft_size
    return np.asarray((apart >= 0) & (apart < number))
