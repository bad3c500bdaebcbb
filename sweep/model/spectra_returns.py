"""Returns of a flight's shots that a detector and an estimator find in whole spectra, draw by draw.

Spectra are those of :mod:`sweep.model.noisy_spectra`, as grids have them: a shot is a point, with
the echoes of all the surfaces that it sees. Flagged bins that are adjacent make a peak, placed by
the estimator; the strongest of them are paired, judged and measured as all others of a flight
(:mod:`sweep.model.returns`). A peak belongs to an echo whose bins it touches. These are the bins
from the first to the last of half the echo's largest magnitude, and a main lobe's half-width to
either side (by ``peak_bin`` the strongest alone). An echo has one peak, the strongest. All others
are false, as many as there are, but those that touch bins of a signal at or above a fixed
threshold, or their neighbours: closed forms exempt these from false alarms, too.

A draw is looked at by itself, so that a user's function answers the same however draws are cut.

Standard errors are those of three bins' interpolation, whatever the estimator, which an instrument
does not know better; those of ``peak_bin`` count its rounding.
"""

import math
from collections.abc import Sequence

import numpy as np

from sweep.model.detectors import main_lobe
from sweep.model.estimators import DEFAULTS, ESTIMATOR, PEAK_BIN
from sweep.model.groups import Groups
from sweep.model.interpolation import interpolator, sub_bin_error
from sweep.model.noisy_spectra import (
    Methods,
    Signal,
    View,
    flagged,
    index_of_zero,
    placed,
    spectra_of,
    turn_of,
    unrolled,
    view_of,
)
from sweep.model.own_motion import OwnMotion
from sweep.model.pairing import FALSE
from sweep.model.preparation import Parameters, Shots
from sweep.model.returns import Drawn, How, Returns, Workspace, known_of, measured, put, report
from sweep.model.waveform import STRONGEST


def spectra_returns(
    shots: Shots,
    found: Groups,
    *,
    keys: np.ndarray,
    parameters: Parameters,
    methods: Methods,
    first_draw: int = 0,
    draws: int = 1,
    motion: OwnMotion | None = None,
) -> Returns:
    """Draw returns as :func:`sweep.model.returns.draw_returns` does, by the methods of these names.

    `parameters` are scalars; :data:`sweep.model.estimators.DEFAULTS` stand for any not given.
    """
    p, most = {**DEFAULTS, **parameters}, found.bin.shape[2]
    known, drawn = known_of(shots, found, motion), Drawn.nothing(found, draws)
    how, tables = How.of(shots, first_draw, True), interpolator(shots.window, shots.fft_size)
    peaks, which = np.zeros((3, most + 1, 4)), np.empty((3, most + 1), np.int64)
    pairs, looks = np.empty((most + 1, 4), np.int64), math.sqrt(shots.looks.number)
    work = Workspace.of(0, most)
    zero, kept = index_of_zero(shots), 1 if shots.peaks == STRONGEST else most + 1
    rounded = math.sqrt(1 / 12) if str(p[ESTIMATOR + "kind"]) == PEAK_BIN else 0.0
    for i in range(shots.size):
        view = view_of(shots, i, p, keys[i], methods, found.bin[i], known.fan)
        sigma, _, under_lines = known.levels[i]
        echoes = [_bins_of(view, s, signal) for s, signal in enumerate(view.signals)]
        for d in range(draws):
            number = np.zeros(3, np.int64)
            for s, signal in enumerate(view.signals):
                if signal is None:
                    continue
                spectra = list(spectra_of(view, s, np.array([first_draw + d])))
                power, bins, groups = peaks_of(spectra, signal, echoes[s], view, kept)
                alike = [np.repeat(each, bins.size, axis=0) for each in spectra]
                places = placed(alike, bins, view) if bins.size else np.empty(0)
                for k, (bin_, place) in enumerate(zip(bins.tolist(), places.tolist(), strict=True)):
                    ratio = math.sqrt(power[bin_]) / sigma
                    delta = min(max(place - bin_, -0.5), 0.5)
                    error = sub_bin_error(delta, ratio / under_lines, tables) / looks
                    wide = known.spread[i, s, groups[k]] if groups[k] >= 0 else 0.0
                    error = math.hypot(error, rounded)
                    at = bin_ - zero, place - zero
                    put(peaks[s, k], *at, error, ratio, wide, how, tables)
                    which[s, k] = groups[k]
                number[s] = bins.size
            report((i, d), how, known, (peaks, which, number), pairs, work, drawn)
    return measured(shots, known, drawn, motion, from_three_bins=False)


def _bins_of(view: View, segment: int, signal: Signal | None) -> np.ndarray:
    """First and last bin of each echo in a segment, where :func:`unrolled` puts them, (echoes, 2).

    The strongest of all stands in the middle of a complex record's bins.
    """
    places = view.echoes_of(segment)
    if signal is None or not places.size:
        return np.empty((0, 2), np.int64)
    shots, setting = view.shots, view.setting
    turn = turn_of(shots, signal.strongest)
    if shots.complex_record:
        places = (places + turn - 1) % shots.fft_size + 1
    if shots.detection != "any_bin":
        return np.stack([places, places], axis=1)
    if places.size == 1:
        return np.array([[signal.first + turn, signal.last + turn]])
    magnitude = unrolled(shots, np.abs(signal.spectrum), signal.strongest)
    beside = math.ceil(main_lobe(setting.window) * setting.fft_size / setting.window.length)
    found = []
    for place in places:
        low = np.flatnonzero(magnitude < 0.5 * magnitude[place])
        after = int(np.searchsorted(low, place))
        first = low[after - 1] + 1 if after else 0
        last = low[after] - 1 if after < low.size else magnitude.size - 1
        found.append((first - beside, last + beside))
    return np.array(found)


def peaks_of(
    spectra: Sequence[np.ndarray], signal: Signal, echoes: np.ndarray, view: View, most: int
) -> tuple[np.ndarray, np.ndarray, list[int]]:
    """Power (bins,) of one draw of a segment, and the peaks in it, strongest first.

    Of each the strongest bin, and the echo whose bins it touches, or FALSE. ``spectra``: (1, bins)
    each, of one or several looks; ``echoes``: of :func:`_bins_of`.
    """
    (whole,), (flags,) = flagged(spectra, view, signal.segment)
    shots, turn = view.shots, turn_of(view.shots, signal.strongest)
    power, flags = (unrolled(shots, each, signal.strongest) for each in (whole, flags))
    half = power.size - 1
    if view.shots.real_ends and signal.last >= signal.first:  # an echo on DC or Nyquist
        # No group holds these bins: where they are flagged, the next one stands for them.
        for end, beside in ((0, 1), (half, half - 1)):
            if flags[end] and end in (signal.first, signal.last):
                flags[beside] = True
                echoes = np.where(echoes == end, beside, echoes)
    flags[[0, -1]] = False
    assert signal.exempt is not None
    exempt = unrolled(shots, signal.exempt, signal.strongest)
    edges = np.diff(flags.astype(np.int8))
    starts, ends = np.flatnonzero(edges > 0) + 1, np.flatnonzero(edges < 0) + 1
    bins: list[int] = []
    groups: list[int] = []
    least = view.shots.searched_from
    strength = [power[start:end].max() for start, end in zip(starts, ends, strict=True)]
    for run in np.argsort(-np.array(strength), kind="stable"):
        start, end = int(starts[run]), int(ends[run])
        own = np.flatnonzero((echoes[:, 0] < end) & (start <= echoes[:, 1]))
        group = int(own[0]) if own.size else FALSE
        if group == FALSE and (start > half - least or end <= least):
            continue
        if group == FALSE and exempt[start:end].any():
            continue
        if group != FALSE and group in groups:
            continue
        bins.append((start + int(power[start:end].argmax()) - turn) % whole.size)
        groups.append(group)
        if len(bins) == most:
            break
    return whole, np.array(bins, np.int64), groups
