"""What the effects of plain scenes may change of tiles of shots: their bounds, in compiled code.

Each is the bound of an effect's own module, of its own compiled formulas, and the same to the last
bit: what is left out is the way from one to the next, which takes longer than they do.
"""

from functools import partial
from typing import NamedTuple

import numpy as np
from numba import njit

from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.effects.footprint_phase import put_sum_changes, put_sums_added
from sweep.model.effects.image import put_alarms, put_bounds, put_moved_bins
from sweep.model.effects.line_powers import put_moved_changes, put_power_ranges
from sweep.model.effects.line_spread import (
    BETA,
    NOT_AWAY,
    RANGE,
    put_lines,
    put_shifts,
    put_spreads,
    widen,
)
from sweep.model.effects.phase_formulas import put_error_changes, put_over_record
from sweep.model.effects.probability_bounds import (
    ADDED,
    ALARMS,
    CHANGE_FIELDS,
    DOWN,
    OF_NONE,
    SHARE,
    SHIFT,
    STRONG,
    UP,
    WEAK,
)
from sweep.model.effects.range_walk import put_drifts
from sweep.model.effects.several_returns import put_changes

FOOTPRINT, PHASE, SEVERAL, DOPPLER, SPREAD, NOISE, WALK, IMAGE, LEAKAGE = range(9)
"""Effects, as of :data:`.plain_scene.PLAIN`."""
SEGMENTS = 3

_SQUARE = np.array([2])

compiled = partial(njit, cache=True, error_model="numpy")


class Found(NamedTuple):
    """What beams meet, by tile: ends (2, tiles), or what is largest (tiles,)."""

    range: np.ndarray
    """[m]"""
    velocity: np.ndarray
    """On the axis [m/s]."""
    light: np.ndarray
    """Echo [W] of 1/sr at 1 m."""
    echo: np.ndarray
    """Of the bare line [1/sr]."""
    ratio: np.ndarray
    """All echo over the bare line's."""
    gain: np.ndarray
    """Of :class:`.tile_geometry.Geometry`."""
    moments: np.ndarray
    """(9, tiles): of ranges, of those on the axis's surface, of velocities [m/s]."""
    beside: np.ndarray
    """Share of the echo from other surfaces than the axis's."""
    apart: np.ndarray
    """How far off these are, over the range."""


class Tiles(NamedTuple):
    """What the formulas look at, by cells: a segment's tiles, then the next one's."""

    found: Found
    axis: np.ndarray
    """(9, cells): :attr:`.block.Block.axis`."""
    resting: np.ndarray
    """(6, cells): lines on the axis without the Doppler effect."""
    spreads: np.ndarray
    """(12, cells): moments of ranges, of those on the axis's surface, of velocities, of both."""
    apart: np.ndarray
    """(cells,): distances of lines of other surfaces than the axis's [bins]."""
    shifts: np.ndarray
    """(cells,): :attr:`.block.Block.doppler_shift`."""
    peak: np.ndarray
    """(2, tiles): :attr:`.block.Block.peak`."""
    noise: np.ndarray
    """(2, tiles): variance of the echo's shot noise over that of all other."""
    in_phase: np.ndarray
    most: np.ndarray
    lean: np.ndarray
    """(cells,) each: of :func:`.footprint_sum.footprint_sum`."""


@compiled
def tiles_of(found, scene):
    """All that the formulas look at."""
    number = found.beside.size
    cells = SEGMENTS * number
    axis, resting, shifts = np.empty((9, cells)), np.empty((6, cells)), np.empty(cells)
    spreads, apart = np.empty((12, cells)), np.empty((12, cells))
    lines, beside = _lines_of(found, scene), found.moments.copy()
    _put_axis(lines, scene.fft_size / 2, axis[:6], resting, shifts)
    put_spreads(lines, found.moments, spreads.reshape(12, SEGMENTS, number))
    axis[6:] = spreads[9:]
    beside[5] = found.apart
    put_spreads(lines, beside, apart.reshape(12, SEGMENTS, number))
    peak, noise = _light(found, scene.link)
    in_phase, lean = np.empty(cells), np.zeros(cells)
    for i in range(cells):
        t = i % number
        in_phase[i] = np.sqrt(np.maximum(found.ratio[1, t], 1.0))
        if scene.amplitudes:
            in_phase[i] *= found.gain[1, t]
            lean[i] = in_phase[i] * np.fmin(axis[8, i], scene.fft_size)
    return Tiles(
        found, axis, resting, spreads, apart[5], shifts, peak, noise, in_phase, in_phase.copy(),
        lean,
    )  # fmt: skip


@compiled
def _lines_of(found, scene):
    """What lines follow from, :func:`.line_spread.axis_ends`."""
    number = found.beside.size
    ends = np.empty((9, 2, number))
    ends[:] = scene.ends
    for end in range(2):
        for t in range(number):
            ends[BETA, end, t] = found.velocity[end, t] * 2 / SPEED_OF_LIGHT
            ends[RANGE, end, t] = found.range[end, t]
    return ends


@compiled
def _put_axis(ends, half, lines, resting, shifts):
    """Lines on the axis, with and without the Doppler effect, and its shifts."""
    number = ends.shape[2]
    found, bins = np.empty((6, SEGMENTS, number)), np.empty((SEGMENTS, number))
    put_shifts(ends, bins)
    either = ends.copy()
    widen(either[BETA], bins)
    put_lines(either, half, found)
    lines[:], shifts[:] = found.reshape(lines.shape), bins.reshape(shifts.shape)
    either[BETA] = 0.0
    put_lines(either, half, found)
    resting[:] = found.reshape(lines.shape)


@compiled
def _light(found, link):
    """The bare line's peak over sigma, and the echo's shot noise over all other, (2, tiles)."""
    oscillator, beat, transimpedance, window, deviation, shot, others = link
    peak, noise = np.empty(found.echo.shape), np.empty(found.echo.shape)
    for t in range(peak.shape[1]):
        for end in range(2):
            far, echo = found.range[1 - end, t], found.echo[end, t]
            power = found.light[end, t] / (far * far)
            voltage = beat * np.sqrt(oscillator * power) * transimpedance
            peak[end, t] = voltage * 0.5 * np.sqrt(echo) * window / deviation
            ratio = found.ratio[end, t]
            more = np.minimum(ratio, 1.0) if end == 0 else np.maximum(ratio, 1.0)
            noise[end, t] = power * echo * more * shot / others
    return peak, noise


@compiled
def is_there(effect, tiles, scene):
    """Whether a scene has anything of an effect."""
    if effect == FOOTPRINT:
        return scene.beamlets > 1
    if effect == PHASE:
        return scene.amplitudes
    if effect == SEVERAL:
        return np.any(tiles.found.beside > 0.0)
    if effect in (DOPPLER, WALK):
        return np.any(tiles.found.velocity != 0.0)
    if effect == SPREAD:
        return np.any(tiles.spreads[8] > 0.0)
    return True


@compiled
def changes(tiles, scene):
    """What effects may change of bins, (effects, fields, cells), leakage left out."""
    table = np.empty((LEAKAGE, CHANGE_FIELDS, tiles.axis.shape[1]))
    for k in range(CHANGE_FIELDS):
        table[:, k] = OF_NONE[k]
    if is_there(FOOTPRINT, tiles, scene):
        _put_footprint(tiles, scene, table[FOOTPRINT])
    if is_there(PHASE, tiles, scene):
        _put_phase(tiles, scene, table[PHASE])
    if is_there(SEVERAL, tiles, scene):
        _put_several(tiles, scene, table[SEVERAL])
    if is_there(DOPPLER, tiles, scene):
        _put_doppler(tiles, scene, table[DOPPLER])
    if is_there(SPREAD, tiles, scene):
        _put_doppler_spread(tiles, scene, table[SPREAD])
    _put_noise(tiles, table[NOISE])
    if is_there(WALK, tiles, scene):
        _put_range_walk(tiles, scene, table[WALK])
    _put_image(tiles, scene, table[IMAGE])
    return table


@compiled
def _put_moves(shift, added, present, still, tiles, scene, entry):
    """Factors of :func:`.line_spread.moved_change`: moments of three rows that are added."""
    table = np.empty((19, shift.size))
    table[0], table[1:4], table[4:7] = shift, added, present
    table[7:13], table[13:] = tiles.axis[:6], still
    put_moved_changes(table, scene.beamlets, scene.tables, scene.lobe, entry[: STRONG + 1])


@compiled
def _put_sums(bins, tiles, scene, entry):
    """What moving lines whose amplitudes add can change: :func:`.footprint_phase.sum_added`."""
    table = np.empty((4, bins.size))
    table[0], table[1], table[2], table[3] = (
        tiles.axis[5], tiles.axis[8], bins, np.full(bins.size, scene.turn_of_bin),
    )  # fmt: skip
    put_sums_added(table, np.sqrt(scene.lobe[1]), scene.worst, entry[ADDED])


@compiled
def _put_footprint(tiles, scene, entry):
    """:func:`.footprint.bound`."""
    none, number = np.zeros((3, tiles.axis.shape[1])), tiles.found.beside.size
    _put_moves(none[0], tiles.spreads[3:6], none, tiles.axis[:6], tiles, scene, entry)
    for i in range(tiles.axis.shape[1]):
        entry[WEAK, i] *= np.sqrt(tiles.found.ratio[0, i % number])
        entry[STRONG, i] *= np.sqrt(tiles.found.ratio[1, i % number])


@compiled
def _put_phase(tiles, scene, entry):
    """:func:`.footprint_phase.bound`."""
    found, axis, number = tiles.found, tiles.axis, tiles.found.beside.size
    table = np.empty((7, axis.shape[1]))
    for i in range(axis.shape[1]):
        t = i % number
        further = scene.turns[i // number, 0] * (found.range[1, t] * found.moments[2, t])
        table[0, i], table[1, i], table[2, i] = axis[2, i], axis[5, i], axis[8, i]
        table[3, i] = further + tiles.spreads[8, i] * scene.turn_of_bin
        table[4, i], table[5, i], table[6, i] = found.gain[0, t], found.gain[1, t], np.inf
    _, curvature, margin, _ = scene.lobe
    sizes = curvature, margin, scene.worst
    put_sum_changes(table, sizes, scene.tails, float(scene.beamlets), entry[: STRONG + 1])


@compiled
def _put_several(tiles, scene, entry):
    """:func:`.several_returns.bound`."""
    axis, cells, number = tiles.axis, tiles.axis.shape[1], tiles.found.beside.size
    given, found = np.zeros((7, cells)), np.empty((4, cells))
    given[0], given[1], given[2], given[3] = axis[0], axis[1], axis[2], axis[5]
    put_power_ranges(given, scene.beamlets, scene.tables, scene.lobe, found[:2])
    given[4:] = tiles.spreads[3:6]
    put_power_ranges(given, scene.beamlets, scene.tables, scene.lobe, found[2:])
    table = np.empty((7, cells))
    for i in range(cells):
        table[0, i], table[1, i] = tiles.found.beside[i % number], tiles.apart[i]
        table[2, i], table[3, i] = found[2, i], found[1, i]
        table[4, i], table[5, i], table[6, i] = axis[2, i], axis[4, i], axis[5, i]
    _, lowest = scene.tables
    put_changes(table, scene.lobe[2], lowest, scene.amplitudes, entry[: STRONG + 1])


@compiled
def _put_doppler(tiles, scene, entry):
    """:func:`.doppler.bound`."""
    shifts, cells, number = tiles.shifts, tiles.axis.shape[1], tiles.found.beside.size
    none, moved = np.zeros((3, cells)), np.empty((2, cells))
    _put_moves(shifts, none, tiles.spreads[9:], tiles.resting, tiles, scene, moved)
    if scene.amplitudes:
        _put_sums(shifts * (1 + tiles.axis[8]), tiles, scene, entry)
    for i in range(cells):
        away = False
        for s in range(SEGMENTS):
            away |= shifts[s * number + i % number] > NOT_AWAY
        if away:
            entry[SHIFT, i], entry[ADDED, i] = 1.0, 0.0
        else:
            entry[SHIFT, i] = shifts[i]
            entry[WEAK, i], entry[STRONG, i] = 1 / moved[1, i], 1 / moved[0, i]


@compiled
def _put_doppler_spread(tiles, scene, entry):
    """:func:`.doppler_spread.bound`."""
    none, ranges, velocities = np.zeros(tiles.axis.shape[1]), tiles.spreads[:3], tiles.spreads[6:9]
    _put_moves(none, velocities, ranges, tiles.axis[:6], tiles, scene, entry)
    if scene.amplitudes:
        _put_sums(velocities[2], tiles, scene, entry)


@compiled
def _put_noise(tiles, entry):
    """:func:`.signal_shot_noise.bound`."""
    for i in range(tiles.axis.shape[1]):
        t = i % tiles.found.beside.size
        entry[DOWN, i], entry[UP, i] = 1 + tiles.noise[0, t], 1 + tiles.noise[1, t]
        entry[SHARE, i] = 0.0


@compiled
def _put_range_walk(tiles, scene, entry):
    """:func:`.range_walk.bound`."""
    cells, number = tiles.axis.shape[1], tiles.found.beside.size
    given, drifts, walk = np.empty((4, number)), np.empty((2, number)), np.empty((5, number))
    for t in range(number):
        given[0, t], given[1, t] = scene.rate, scene.rate
        given[2, t] = tiles.found.velocity[0, t] * 2 / SPEED_OF_LIGHT
        given[3, t] = tiles.found.velocity[1, t] * 2 / SPEED_OF_LIGHT
    put_drifts(given, drifts)
    over = np.empty((17, number))
    for k in range(15):
        over[k] = scene.times[k]
    over[15:] = drifts
    put_over_record(over, _SQUARE, walk)
    table, found = np.zeros((13, cells)), np.empty((4, cells))
    for i in range(cells):
        for k in range(5 if i // number != 1 else 0):
            table[k if k else 6, i] = walk[k, i % number]
    flags = False, scene.beamlets == 1, scene.amplitudes
    lobe = scene.tables, scene.lobe
    put_error_changes(
        tiles.axis, table, scene.beamlets, lobe, scene.record, scene.window, flags, found
    )  # fmt: skip
    entry[WEAK], entry[STRONG], entry[ADDED], entry[SHIFT] = found[0], found[1], found[2], found[3]


@compiled
def _put_image(tiles, scene, entry):
    """:func:`.image.bound`."""
    axis, cells, number = tiles.axis, tiles.axis.shape[1], tiles.found.beside.size
    found = np.empty((2, cells))
    put_bounds(axis, scene.beamlets, scene.tables, scene.lobe, scene.tails, found)
    entry[STRONG] = found[0]
    if scene.amplitudes:
        entry[ADDED] = found[1]
    if not scene.counts:
        return
    half, table = scene.fft_size / 2, np.empty((3, SEGMENTS, number))
    moved, alarms = np.empty((2, number)), np.empty(number)
    for i in range(cells):
        s, t = i // number, i % number
        table[0, s, t], table[1, s, t], table[2, s, t] = (
            tiles.in_phase[i], tiles.peak[1, t], scene.threshold,
        )  # fmt: skip
    lines = axis.reshape(9, SEGMENTS, number)
    put_moved_bins(lines, table, half, scene.tails, scene.amplitudes, moved)
    put_alarms(moved[0], moved[1], half, alarms)
    for i in range(cells):
        entry[ALARMS, i] = alarms[i % number]
