"""Spectra of single shots by the fast path: to look at, and to hold against the truth."""

import numpy as np

from sweep.model import segments
from sweep.model.equivalent import MOST_NODES
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
    width = max(shots.offset.shape[1], MOST_NODES, shots.fft_size // 2 + 1)
    room = np.empty((segments.ROOM, width))
    low, count = segments.segment_spectrum(
        segment, shots.point_table()[:, i].copy(), shots.footprint, shots.row[i], level,
        shots.incoherent, shots.kernel(), room,
    )  # fmt: skip
    return np.arange(low, low + count), room[0, :count].copy()
