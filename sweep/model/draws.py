"""Random draws of shots: detections and false alarms counted, batch by batch.

Two ways that agree in the mean. ``probabilities`` is [T 3.3.2]'s: uniform numbers against pd and
the probability of a false alarm (noise and leakage together). ``noise`` adds complex Gaussian
noise to the bins that hold signal and looks; over the other bins, which hold noise alone, the
largest magnitude is drawn exactly from its order statistic. Both take the bins' noise as
independent, as the closed forms do.

Every number is addressed by point, draw, cause and index (:mod:`sweep.model.philox`).
"""

import math
from collections.abc import Mapping, Sequence

import numpy as np
from numba import njit

from sweep.model import chances, philox
from sweep.model.detection import assess
from sweep.model.equivalent import MOST_NODES
from sweep.model.outputs import DRAW_OUTPUTS
from sweep.model.preparation import Parameters, Shots, prepare
from sweep.model.segments import ROOM, segment_spectrum

METHODS = ("probabilities", "noise")

_DETECTION = np.array(
    [philox.STREAM_DETECTION_UP, philox.STREAM_DETECTION_DOPPLER, philox.STREAM_DETECTION_DOWN]
)
_FALSE_ALARM = np.array(
    [
        philox.STREAM_FALSE_ALARM_UP,
        philox.STREAM_FALSE_ALARM_DOPPLER,
        philox.STREAM_FALSE_ALARM_DOWN,
    ]
)
_NOISE = np.array([philox.STREAM_NOISE_UP, philox.STREAM_NOISE_DOPPLER, philox.STREAM_NOISE_DOWN])
_MAXIMUM = np.array(
    [
        philox.STREAM_NOISE_MAXIMUM_UP,
        philox.STREAM_NOISE_MAXIMUM_DOPPLER,
        philox.STREAM_NOISE_MAXIMUM_DOWN,
    ]
)


def draw(
    parameters: Parameters,
    outputs: Mapping[str, np.ndarray],
    *,
    keys: np.ndarray,
    first_draw: int,
    batch_sizes: Sequence[int],
    method: str,
) -> dict[str, np.ndarray]:
    """Counts of detections and false alarms over batches of draws.

    Parameters
    ----------
    parameters : mapping
        As for :func:`sweep.model.shot.evaluate`.
    outputs : mapping
        What that gave, (n,) each.
    keys : (n, 2) uint64
        Random key of each point.
    first_draw : int
        Number of the first draw; draws are numbered through all batches.
    batch_sizes : sequence of int
        Draws in each batch.
    method : str
        ``probabilities`` or ``noise``.

    Returns
    -------
    dict of (n, batches) int64 ndarray
        By the names of :data:`sweep.model.outputs.DRAW_OUTPUTS`.
    """
    ends = first_draw + np.cumsum([0, *batch_sizes])
    counts = np.zeros((len(DRAW_OUTPUTS), len(keys), len(batch_sizes)), np.int64)
    if method == "probabilities":
        _draw_probabilities(keys, ends, *_chances(outputs), _DETECTION, _FALSE_ALARM, counts)
    elif method == "noise":
        for index, shots in prepare(parameters):
            group = np.zeros((len(DRAW_OUTPUTS), index.size, len(batch_sizes)), np.int64)
            _draw_noise(
                keys[index], ends, shots.point_table(), shots.row, shots.footprint,
                shots.segments, shots.incoherent, _base_count(shots), shots.kernel(), _NOISE,
                _MAXIMUM, group,
            )  # fmt: skip
            counts[:, index] = group
    else:
        raise ValueError(f"no way to draw called {method!r}: choose from {', '.join(METHODS)}")
    return dict(zip(DRAW_OUTPUTS, counts, strict=True))


def _chances(outputs: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Probabilities of detection and of a false alarm by segment (up, Doppler, down), (3, n)."""
    found = np.stack([outputs["pd_up"], outputs["pd_doppler"], outputs["pd_down"]])
    noise_up = outputs["pfa_segment"]
    both, one = outputs["log10_pfa_shot"], outputs["log10_pfa_segment"]
    some = np.isfinite(one)  # else the detection occupies every bin
    noise_down = np.where(some, 10 ** (both - np.where(some, one, 0.0)), 0.0)
    up = 1 - (1 - noise_up) * (1 - outputs["p_leakage_up"])
    down = 1 - (1 - noise_down) * (1 - outputs["p_leakage_down"])
    return np.nan_to_num(found), np.stack([up, np.zeros_like(up), down])


def _base_count(shots: Shots) -> tuple[float, bool]:
    """Bins counted before exemption, and whether exempt bins are taken off."""
    return float(shots.counted_bins(np.zeros(()))), shots.bins_counted != "all"


@njit(cache=True)
def _tally(counts, i, batch, found, alarm):
    """Adds one draw to the counts, in the order of DRAW_OUTPUTS."""
    counts[0, i, batch] += found[0]
    counts[1, i, batch] += found[2]
    counts[2, i, batch] += found[1]
    counts[3, i, batch] += found[0] & found[2]
    counts[4, i, batch] += alarm[0]
    counts[5, i, batch] += alarm[2]
    counts[6, i, batch] += alarm[0] & alarm[2]


@njit(cache=True, nogil=True)
def _draw_probabilities(keys, ends, found, alarm, found_stream, alarm_stream, counts):
    """Uniform numbers against the probabilities of each segment."""
    hit, false = np.zeros(3, np.int64), np.zeros(3, np.int64)
    for i in range(keys.shape[0]):
        a, b = keys[i]
        for batch in range(ends.size - 1):
            for number in range(ends[batch], ends[batch + 1]):
                for s in range(3):
                    hit[s] = philox.uniform(a, b, number, found_stream[s], 0) < found[s, i]
                    false[s] = philox.uniform(a, b, number, alarm_stream[s], 0) < alarm[s, i]
                _tally(counts, i, batch, hit, false)


@njit(cache=True, nogil=True, error_model="numpy")
def _draw_noise(
    keys, ends, points, row, footprint, segments, power, counted, kernel, noise, maximum,
    counts,
):  # fmt: skip
    """Noise in every bin: drawn where signal is, by its largest value elsewhere."""
    fft_size = kernel[0][0]
    room = np.empty((ROOM, max(footprint[0].shape[1], MOST_NODES, fft_size // 2 + 1)))
    exempt = np.empty(fft_size // 2 + 1, np.bool_)
    draws = ends[-1] - ends[0]
    hit, false = np.zeros((draws, 3), np.int64), np.zeros((draws, 3), np.int64)
    for i in range(points.shape[1]):
        p = points[:, i].copy()
        sigma, level, floor = p[10], p[11], p[12]
        for s in range(3):
            if not segments[s]:
                continue
            _, count = segment_spectrum(s, p, footprint, row[i], floor * sigma, power, kernel, room)
            peak, exempted, _ = assess(room[0], count, sigma, level, floor, exempt)
            others = counted[0] - (exempted if counted[1] else 0.0)
            signals = room[0, :count] / sigma
            for d in range(draws):
                hit[d, s], false[d, s] = _look(
                    keys[i], ends[0] + d, noise[s], maximum[s], signals, exempt, peak, floor,
                    level / sigma, others,
                )  # fmt: skip
        for batch in range(ends.size - 1):
            for d in range(ends[batch] - ends[0], ends[batch + 1] - ends[0]):
                _tally(counts, i, batch, hit[d], false[d])


@njit(cache=True, error_model="numpy")
def _look(key, number, stream, maximum_stream, signals, exempt, peak, floor, beta, others):
    """Whether one draw of noise lifts the peak over the threshold, and any other bin."""
    a, b = key
    found, alarm = False, False
    for i in range(signals.size):
        if i != peak and (exempt[i] or signals[i] < floor):
            continue
        re, im = philox.normal_pair(a, b, number, stream, i)
        crosses = (signals[i] + re) ** 2 + im**2 >= beta * beta
        if i == peak:
            found = crosses
        else:
            alarm |= crosses
            others -= 1.0
    quiet = chances.at_least_one_scalar(math.exp(-0.5 * beta * beta), max(others, 0.0))
    alarm |= philox.uniform(a, b, number, maximum_stream, 0) < quiet
    return found, alarm
