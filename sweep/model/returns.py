"""Returns: what a footprint with several surfaces reports, draw by draw.

:func:`groups` finds in the noiseless spectra of a shot's segments the groups of adjacent bins at
or above the threshold, each a target (PHYSICS section 6). :func:`draw_returns` draws which of
them are detected, adds false peaks, pairs the peaks (:mod:`sweep.model.pairing`) and reports
range and radial velocity, by whole bins and interpolated between them.

The two ways to draw are those of :mod:`sweep.model.draws`, with the same random numbers: the
strongest group is detected, and a false alarm raised, in the very draws that are counted there.

- ``probabilities``: a uniform number against the pd of each group, one against the probability of
  a false alarm (noise and leakage). Peaks stay in their noiseless bins; the interpolated position
  has a normal error of the standard error that is reported.
- ``noise``: complex Gaussian noise in the strongest bin of each group and its two neighbours, so
  that the largest of the three may change, and in the bins of leaked signal; the largest of all
  other bins by its order statistic. Within the three bins noise is correlated as the window does;
  otherwise bins are independent, as in the closed forms.

The interpolated range is put right for what range walk moves it by, v_r (T_w + 2 t_0), by the
velocity that is measured with it.

Standard errors are those of noise and, in quadrature, what the lines in a group make by their
spread, of which the instrument is taken to know the size (:func:`interpolation.spread_error`).

A segment and draw has one false peak at most, the largest; it is placed uniformly over bins
1..N/2 outside the listed groups (a leaking bin in its own place). Groups beyond the ``most``
strongest are neither detected nor false alarms.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.draws import METHODS
from sweep.model.groups import FIRST, LAST, Groups, groups
from sweep.model.interpolation import interpolator, spread_error
from sweep.model.modulation import choices, stretches
from sweep.model.pairing import (
    FALSE_ALARM,
    MISPAIRED,
    MISREAD,
    SIDELOBE,
    TOLERANCE,
    TRUE,
    UNCONFIRMED,
    beamlet_lines,
    common_beamlet,
    pair_peaks,
)
from sweep.model.pairing import workspace as pairing_workspace
from sweep.model.peaks import (
    ABSENT,
    ERROR,
    FALSE,
    FINE,
    RATIO,
    STREAMS,
    WHOLE,
    alarm_chance,
    draw_by_chance,
    draw_in_noise,
)
from sweep.model.preparation import Shots
from sweep.model.readings import resolve_reading
from sweep.model.segments import inspect_bins, workspace

__all__ = ["Groups", "Returns", "draw_returns", "groups"]


class Returns(NamedTuple):
    """Up to ``most`` returns of each shot and draw, each (n, draws, most); nan where there is none.

    Confirmed returns come before unconfirmed ones, stronger up peaks before weaker ones, a false
    up peak last. ``_interpolated`` goes with peaks placed between bins, no suffix with whole bins.
    """

    range: np.ndarray
    """[m]"""
    range_interpolated: np.ndarray
    """[m]"""
    radial_velocity: np.ndarray
    """[m/s], positive when closing."""
    radial_velocity_interpolated: np.ndarray
    """[m/s]"""
    range_standard_error: np.ndarray
    """Standard error [m]: of the interpolated range, and of rounding to bins (1/sqrt(12))."""
    range_interpolated_standard_error: np.ndarray
    """Standard error [m] under noise, with what the spread of the groups' own lines adds."""
    radial_velocity_standard_error: np.ndarray
    """[m/s], as for the range."""
    radial_velocity_interpolated_standard_error: np.ndarray
    """[m/s], as for the range."""
    snr: np.ndarray
    """Power of the weaker of up and down peak as found over the mean noise power of a bin."""
    pd: np.ndarray
    """Probability that up and down peak are both detected; nan with a false peak."""
    flags: np.ndarray
    """uint8: bits of :data:`sweep.model.pairing.FLAGS`; 0 where there is no return."""
    beamlet: np.ndarray
    """int32: beamlet that a true or misread return has seen, -1 otherwise."""
    group: np.ndarray
    """(n, draws, most, 3) int8: number of the up, Doppler and down group; -1 none or false."""


def draw_returns(
    shots: Shots,
    found: Groups,
    *,
    keys: np.ndarray,
    first_draw: int = 0,
    draws: int = 1,
    method: str = "probabilities",
    tolerance: float = TOLERANCE,
) -> Returns:
    """Returns of every shot, draw by draw.

    Parameters
    ----------
    shots : Shots
        n prepared points.
    found : Groups
        Theirs, by :func:`groups`.
    keys : (n, 2) uint64
        Random key of each.
    first_draw, draws : int
        Number of the first draw, number of draws; any stretch of draws can be had alone.
    method : str
        ``probabilities`` or ``noise``.
    tolerance : float
        Of :func:`sweep.model.pairing.pair_peaks` [bins].

    Raises
    ------
    ValueError
        `method` is neither of the two.
    """
    if method not in METHODS:
        raise ValueError(f"no way to draw called {method!r}: choose from {', '.join(METHODS)}")
    n, _, most = found.bin.shape
    values = np.full((n, draws, most, 10), np.nan)
    flags, beamlet = np.zeros((n, draws, most), np.uint8), np.full((n, draws, most), -1, np.int32)
    group = np.full((n, draws, most, 3), -1, np.int8)
    bins = np.stack([found.bin, found.first, found.last])
    chirp = np.array(np.broadcast_arrays(shots.bandwidth, shots.duration, shots.range)[:2], float)
    counted = float(shots.counted_bins(np.zeros(()))), shots.bins_counted != "all"
    for stretch in stretches(shots):
        part = stretch.part
        _draw(
            keys[part], int(first_draw), (stretch.points, chirp[:, part].copy(), stretch.row),
            stretch.scene, (shots.segments, choices(shots), method == "noise", float(tolerance)),
            counted, shots.kernel(), tuple(interpolator(shots.window, shots.fft_size)),
            (bins[:, part].copy(), found.pd[part], found.neighbours[part], found.exempted[part],
             found.leakage[part]),
            STREAMS, (np.empty((most + 1, 4), np.int64), pairing_workspace(most + 1)),
            workspace(stretch.lines, shots.fft_size),
            (values[part], flags[part], beamlet[part], group[part]),
        )  # fmt: skip
    # What the ground came nearer by within the record, which the measured velocity tells.
    walk = np.broadcast_to(shots.walk, n)[:, None, None]
    values[..., FINE] += values[..., 2 + FINE] * walk
    columns = [values[..., k] for k in range(values.shape[-1])]
    return Returns._make([*columns, flags, beamlet, group])


_inlined = njit(cache=True, error_model="numpy", inline="always")
"""Written into its caller: a call would count each of its many arrays in and out, draw by draw."""


@njit(cache=True, nogil=True, error_model="numpy")
def _draw(
    keys, first_draw, shots, scene, how, counted, kernel, tables, found, streams, work, spectra, out
):  # fmt: skip
    """All draws of all points: peaks of the three segments, then what they report."""
    points, chirp, row = shots
    footprint = scene[0]
    segments, choices, noisy, tolerance = how
    power = choices[0]
    half, beamlets = kernel[0][0] // 2, footprint[0].shape[1]
    draws, most = out[1].shape[1], out[1].shape[2]
    room, exempt, _ = spectra
    peaks = np.zeros((3, draws, most + 1, 4))
    which, number = np.empty((3, draws, most + 1), np.int64), np.empty((3, draws), np.int64)
    lines, spread = np.empty((3, beamlets)), np.empty(most)
    for i in range(points.shape[1]):
        p = points[:, i].copy()
        beamlet_lines(p, 2 * half, footprint, row[i], lines)
        for s in range(3):
            if not segments[s]:
                number[s], which[s, :, 0] = 1, ABSENT
                continue
            listed = found[0][:, i, s], found[1][i, s], found[2][i, s]
            others = counted[0] - (found[3][i, s] if counted[1] else 0.0)
            run = 0, room[0, :0], exempt, p[12]
            if noisy:
                run = _run(s, p, scene, (row[i], i), choices, kernel, room, exempt)
            _draw_segment(
                (keys[i], first_draw, streams[s]), listed,
                (p[10], p[11] / p[10], p[13] / p[10]), others,
                found[4][i, s], noisy, run, tables, half, peaks[s], which[s], number[s],
            )  # fmt: skip
            _spread_lines(listed[0], lines[s], footprint[2][row[i]], spread)
            _widen(peaks[s], which[s], number[s], spread, power or not segments[1], tables)
        optics = p[8], chirp[0, i], chirp[1, i], p[6], p[6] / (2 * half)
        aims = p[0], p[1], footprint[0][row[i]], footprint[1][row[i]], footprint[2][row[i]], lines
        for d in range(draws):
            _report(
                peaks[:, d], which[:, d], number[:, d], found[0][:, i], found[1][i], half, optics,
                aims, tolerance, work, out[0][i, d], out[1][i, d], out[2][i, d], out[3][i, d],
            )  # fmt: skip


@_inlined
def _run(segment, p, scene, at, choices, kernel, room, exempt):
    """Bins that hold a segment's signal, as :func:`sweep.model.peaks.draw_in_noise` takes them."""
    low, count, _, _, _ = inspect_bins(segment, p, scene, at, choices, kernel, room, exempt)
    floor = p[12] if choices[2] else np.inf  # no bin but the groups is looked at
    return low, room[0, :count] / p[10], exempt, floor


@_inlined
def _draw_segment(
    source, listed, noise, others, leakage, noisy, run, tables, half, peaks, which, number
):
    """A segment's peaks in all draws of a point."""
    key, first_draw, streams = source
    alarm = alarm_chance(noise[1], others, leakage)
    for d in range(number.size):
        address = key[0], key[1], first_draw + d
        if noisy:
            number[d] = draw_in_noise(
                address, streams, listed, noise, others, run, tables, half, peaks[d], which[d]
            )
        else:
            number[d] = draw_by_chance(
                address, streams, listed, noise, others, alarm, tables, half, peaks[d], which[d]
            )


@_inlined
def _spread_lines(bins, lines, amplitude, spread):
    """Standard deviation [bins] of the lines in each group of a segment, weighted by power."""
    for g in range(spread.size):
        total = first = second = 0.0
        for b in range(lines.size):
            apart = lines[b] - bins[0, g]
            if bins[FIRST, g] - 1.0 <= lines[b] <= bins[LAST, g] + 1.0:
                weight = amplitude[b] * amplitude[b]
                total += weight
                first += weight * apart
                second += weight * apart * apart
        mean = first / total if total > 0.0 else 0.0
        spread[g] = math.sqrt(max(second / total - mean * mean, 0.0)) if total > 0.0 else 0.0


@_inlined
def _widen(peaks, which, number, spread, power, tables):
    """Adds to the errors of a segment's true peaks, in all draws, what the lines' spread does."""
    for d in range(number.size):
        for k in range(number[d]):
            if which[d, k] >= 0:
                peak = peaks[d, k]
                delta = peak[FINE] - peak[WHOLE]
                error = spread_error(delta, spread[which[d, k]], power, tables)
                peak[ERROR] = math.hypot(peak[ERROR], error)


@_inlined
def _report(
    peaks, which, number, bins, pd, half, optics, aims, tolerance, work,
    values, flags, beamlet, group,
):  # fmt: skip
    """Pairs one draw's peaks; values, flags, beamlets and groups of its returns."""
    pairs, scratch = work
    fine = peaks[:, :, FINE]
    confirmed, count = pair_peaks(
        fine[0, : number[0]], fine[1, : number[1]], fine[2, : number[2]],
        optics[0] / (optics[0] + optics[1] / 2.0), 2.0 * half, tolerance, pairs, scratch,
    )  # fmt: skip
    for r in range(min(count, flags.size)):
        u, k, d, code = pairs[r]
        up, down = peaks[0, u], peaks[2, d]
        _measure(up, down, code, optics, values[r])
        group[r, 0], group[r, 2] = which[0, u], which[2, d]
        group[r, 1] = which[1, k] if k >= 0 else ABSENT
        if group[r, 0] >= 0 and group[r, 2] >= 0:
            values[r, 9] = pd[0, group[r, 0]] * pd[2, group[r, 2]]
        flags[r], beamlet[r] = _judge(
            group[r], (up[FINE], fine[1, max(k, 0)], down[FINE]), bins, optics, aims, values[r]
        )
        if r >= confirmed:
            flags[r] |= UNCONFIRMED
        for s in range(3):
            group[r, s] = max(group[r, s], -1)


@_inlined
def _measure(up, down, code, optics, values):
    """Range and velocity by whole and by fine positions, their standard errors, and the SNR."""
    carrier, bandwidth, duration, sample_rate, bin_width = optics
    for field in (WHOLE, FINE):
        values[field], values[2 + field] = resolve_reading(
            code, up[field] * bin_width, down[field] * bin_width, carrier, bandwidth, duration,
            sample_rate,
        )  # fmt: skip
    variance = up[ERROR] ** 2 + down[ERROR] ** 2
    metre = SPEED_OF_LIGHT / 4.0 * bin_width / (bandwidth / duration)
    speed = SPEED_OF_LIGHT / 4.0 * bin_width / (carrier + bandwidth / 2.0)
    values[4], values[5] = metre * math.sqrt(variance + 1.0 / 6.0), metre * math.sqrt(variance)
    values[6], values[7] = speed * math.sqrt(variance + 1.0 / 6.0), speed * math.sqrt(variance)
    values[8] = min(up[RATIO], down[RATIO]) ** 2 / 2.0


@_inlined
def _judge(group, centres, bins, optics, aims, values):
    """What a return is in truth, and the beamlet that it has seen."""
    if group[0] == FALSE or group[1] == FALSE or group[2] == FALSE:
        return FALSE_ALARM, -1
    range_0, beta, offset, doppler, amplitude, lines = aims
    carrier, bandwidth, duration, _, bin_width = optics
    spans = np.empty((3, 2))
    width = 4.0
    for s in range(3):
        spans[s, 0], spans[s, 1] = -np.inf, np.inf
        if group[s] >= 0:
            spans[s, 0], spans[s, 1] = bins[FIRST, s, group[s]], bins[LAST, s, group[s]]
            width += spans[s, 1] - spans[s, 0]
    b, filled = common_beamlet(spans, centres, lines, amplitude)
    if not filled:
        return SIDELOBE, -1
    if b < 0:
        return MISPAIRED, -1
    metre = SPEED_OF_LIGHT / 2.0 * bin_width / (bandwidth / duration)
    speed = SPEED_OF_LIGHT / 2.0 * bin_width / (carrier + bandwidth / 2.0)
    near = abs(values[1] - range_0 * (1.0 + offset[b])) <= width * metre
    alike = abs(values[3] - SPEED_OF_LIGHT / 2.0 * (beta + doppler[b])) <= width * speed
    return TRUE if near and alike else MISREAD, b
