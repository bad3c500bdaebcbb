"""Random draws of shots: detections and false alarms counted, batch by batch.

Two ways that agree in the mean. ``probabilities`` is [T 3.3.2]'s: uniform numbers against pd and
the probability of a false alarm (noise and leakage together). ``noise`` adds complex Gaussian
noise to the bins that hold signal and looks; over the other bins, which hold noise alone, the
largest magnitude is drawn exactly from its order statistic. Both take the bins' noise as
independent, as the closed forms do. Where effects are random, each draw has a spectrum and
probabilities of its own, and its noise with them: see :mod:`sweep.model.sampling`, which also says
when to stop.

Every number is addressed by point, draw, cause and index (:mod:`sweep.model.philox`).
"""

import math
from collections.abc import Collection, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numba import njit

from sweep.model import chances, philox
from sweep.model.chain import prepare
from sweep.model.effects.catalogue import CORE
from sweep.model.modulation import choices, stretches
from sweep.model.outputs import DRAW_OUTPUTS
from sweep.model.preparation import Parameters, Shots
from sweep.model.segments import inspect_bins, workspace

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


class Rows(NamedTuple):
    """Spectra, (m,) each, that a stretch of draws is taken of."""

    point: np.ndarray
    """int64: the point whose counts they add to."""
    keys: np.ndarray
    """(m, 2) uint64: random key of that point."""
    first: np.ndarray
    """int64: number of the first draw."""
    last: np.ndarray
    """int64: number after the last."""


def draw(
    parameters: Parameters,
    outputs: Mapping[str, np.ndarray],
    *,
    keys: np.ndarray,
    first_draw: int,
    batch_sizes: Sequence[int],
    method: str,
    effects: Collection[str] = CORE,
) -> dict[str, np.ndarray]:
    """Counts of detections and false alarms over batches of draws, nothing but noise random.

    Parameters
    ----------
    parameters, effects
        As for :func:`sweep.model.shot.evaluate`; random effects have no effect here.
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
    counts = no_counts(len(keys), len(batch_sizes), method)
    if method == "probabilities":
        count_by_chance(_all_draws(np.arange(len(keys)), keys, ends), ends, outputs, counts)
    else:
        for index, shots in prepare(parameters, effects):
            count_in_noise(_all_draws(index, keys[index], ends), ends, shots, counts)
    return dict(zip(DRAW_OUTPUTS, counts, strict=True))


def no_counts(points: int, batches: int, method: str) -> np.ndarray:
    """Counts of 0, (names, points, batches), in the order of DRAW_OUTPUTS.

    Raises
    ------
    ValueError
        There is no way to draw of that name.
    """
    if method not in METHODS:
        raise ValueError(f"no way to draw called {method!r}: choose from {', '.join(METHODS)}")
    return np.zeros((len(DRAW_OUTPUTS), points, batches), np.int64)


def _all_draws(point: np.ndarray, keys: np.ndarray, ends: np.ndarray) -> Rows:
    """Each point's one spectrum for all of its draws."""
    return Rows(point, keys, np.full(point.size, ends[0]), np.full(point.size, ends[-1]))


def count_by_chance(
    rows: Rows, ends: np.ndarray, outputs: Mapping[str, np.ndarray], counts: np.ndarray
) -> None:
    """Add the draws of some rows, held against their outputs, to the counts.

    Parameters
    ----------
    rows : Rows
        Draws within the batches.
    ends : (batches + 1,) ndarray
        Numbers of draws between batches.
    outputs : mapping
        Of each row.
    counts : (names, points, batches) ndarray
        As of :func:`no_counts`.
    """
    _draw_probabilities(rows, ends, *_chances(outputs), _DETECTION, _FALSE_ALARM, counts)


def count_in_noise(rows: Rows, ends: np.ndarray, shots: Shots, counts: np.ndarray) -> None:
    """Add the draws of some rows, in the noise of their shots, to the counts.

    Parameters are those of :func:`count_by_chance`.
    """
    for stretch in stretches(shots):
        _draw_noise(
            Rows(*(column[stretch.part] for column in rows)), ends, stretch.points, stretch.row,
            stretch.scene, shots.segments, choices(shots), _base_count(shots), shots.kernel(),
            workspace(stretch.lines, shots.fft_size), _NOISE, _MAXIMUM, counts,
        )  # fmt: skip


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
def _draw_probabilities(rows, ends, found, alarm, found_stream, alarm_stream, counts):
    """Uniform numbers against the probabilities of each segment."""
    hit, false = np.zeros(3, np.int64), np.zeros(3, np.int64)
    for j in range(rows.point.size):
        a, b = rows.keys[j]
        batch = 0
        for number in range(rows.first[j], rows.last[j]):
            while number >= ends[batch + 1]:
                batch += 1
            for s in range(3):
                hit[s] = philox.uniform(a, b, number, found_stream[s], 0) < found[s, j]
                false[s] = philox.uniform(a, b, number, alarm_stream[s], 0) < alarm[s, j]
            _tally(counts, rows.point[j], batch, hit, false)


@njit(cache=True, nogil=True, error_model="numpy")
def _draw_noise(
    rows, ends, points, row, scene, segments, choices, counted, kernel, work, noise, maximum,
    counts,
):  # fmt: skip
    """Noise in every bin: drawn where signal is, by its largest value elsewhere."""
    room, exempt, _ = work
    draws = (rows.last - rows.first).max()
    hit, false = np.zeros((draws, 3), np.int64), np.zeros((draws, 3), np.int64)
    for j in range(points.shape[1]):
        p, first = points[:, j].copy(), rows.first[j]
        sigma, level = p[10], p[11]
        floor = p[12] if choices[2] else np.inf  # no bin but the detection is looked at
        for s in range(3):
            if not segments[s]:
                continue
            _, count, peak, exempted, _ = inspect_bins(
                s, p, scene, (row[j], j), choices, kernel, room, exempt
            )
            others = counted[0] - (exempted if counted[1] else 0.0)
            signals = room[0, :count] / sigma
            for d in range(rows.last[j] - first):
                hit[d, s], false[d, s] = _look(
                    rows.keys[j], first + d, noise[s], maximum[s], signals, exempt, peak, floor,
                    (level / sigma, p[13] / sigma), others,
                )  # fmt: skip
        batch = 0
        for d in range(rows.last[j] - first):
            while first + d >= ends[batch + 1]:
                batch += 1
            _tally(counts, rows.point[j], batch, hit[d], false[d])


@njit(cache=True, error_model="numpy")
def _look(key, number, stream, maximum_stream, signals, exempt, peak, floor, levels, others):
    """Whether one draw of noise lifts the peak over the threshold, and any other bin.

    ``levels`` are the threshold and the noise under the lines, over the noise of any other bin.
    """
    a, b = key
    beta, under_lines = levels
    found, alarm = False, False
    for i in range(signals.size):
        if i != peak and (exempt[i] or signals[i] < floor):
            continue
        re, im = philox.normal_pair(a, b, number, stream, i)
        if i == peak:
            re, im = re * under_lines, im * under_lines
        crosses = (signals[i] + re) ** 2 + im**2 >= beta * beta
        if i == peak:
            found = crosses
        else:
            alarm |= crosses
            others -= 1.0
    quiet = chances.at_least_one_scalar(math.exp(-0.5 * beta * beta), max(others, 0.0))
    alarm |= philox.uniform(a, b, number, maximum_stream, 0) < quiet
    return found, alarm
