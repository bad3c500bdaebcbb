"""Spectra of single shots by the fast path: to look at, and to hold against the truth."""

import numpy as np

from sweep.model import modulation, segments
from sweep.model.preparation import Shots


def segment_spectrum(
    shots: Shots, i: int, segment: int, *, level: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Bins of a segment in which the signal stands above a level, and |X| there, without noise.

    Parameters
    ----------
    shots : Shots
        Prepared points.
    i, segment : int
        Point; 0 up, 1 Doppler, 2 down.
    level : float
        Magnitude [V, summed over the record] below which bins may be left out; 0 gives 0..N/2.

    Returns
    -------
    bins : (m,) int ndarray
    magnitude : (m,) ndarray
    """
    point = modulation.single(shots, i)
    room, _, _ = segments.workspace(point.lines, shots.fft_size)
    low, count = segments.segment_spectrum(
        segment, point.points[:, 0].copy(), point.scene, (int(point.row[0]), 0), level,
        modulation.choices(shots), shots.kernel(), room,
    )  # fmt: skip
    half = shots.fft_size // 2
    if level <= 0 and count <= half:  # nothing comes back: no line has any bins of its own
        return np.arange(half + 1), np.zeros(half + 1)
    return np.arange(low, low + count), room[0, :count].copy()
