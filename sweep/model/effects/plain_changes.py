"""What the effects of plain scenes may change of tiles of shots: their bounds, in compiled code.

Each is the bound of an effect's own module, of its own compiled formulas, and the same to the last
bit: what is left out is the way from one to the next, which takes longer than they do.
"""

from typing import NamedTuple

import numpy as np

from sweep.model.compiling import borrowing, owning
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

ROOM = 28
"""Rows of as many numbers as there are cells, to work in."""


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


@owning()
def tiles_for(found):
    """Room for what the formulas look at of what was found."""
    number = found.beside.size
    cells = SEGMENTS * number
    return Tiles(
        found, np.empty((9, cells)), np.empty((6, cells)), np.empty((12, cells)), np.empty(cells),
        np.empty(cells), np.empty((2, number)), np.empty((2, number)), np.empty(cells),
        np.empty(cells), np.empty(cells),
    )  # fmt: skip


@borrowing()
def put_tiles(tiles, scene, room):
    """Fill in what the formulas look at."""
    found, axis = tiles.found, tiles.axis
    number = found.beside.size
    _put_lines(tiles, scene, room)
    _put_light(tiles, scene.link)
    for i in range(axis.shape[1]):
        t = i % number
        tiles.in_phase[i], tiles.lean[i] = np.sqrt(np.maximum(found.ratio[1, t], 1.0)), 0.0
        if scene.amplitudes:
            tiles.in_phase[i] *= found.gain[1, t]
            tiles.lean[i] = tiles.in_phase[i] * np.fmin(axis[8, i], scene.fft_size)
        tiles.most[i] = tiles.in_phase[i]


@borrowing()
def _put_lines(tiles, scene, room):
    """Lines on the axis, with and without the Doppler effect, its shifts, and their spread."""
    found, number = tiles.found, tiles.found.beside.size
    ends = room[:6].reshape(9, 2, number)
    for row in range(9):
        for end in range(2):
            for t in range(number):
                ends[row, end, t] = scene.ends[row, end, 0]
    for end in range(2):
        for t in range(number):
            ends[BETA, end, t] = found.velocity[end, t] * 2 / SPEED_OF_LIGHT
            ends[RANGE, end, t] = found.range[end, t]
    half, shifts = scene.fft_size / 2, tiles.shifts.reshape(SEGMENTS, number)
    moments, spreads = room[6:9].reshape(9, number), room[9:21].reshape(12, SEGMENTS, number)
    _copy(found.moments, moments)
    for t in range(number):
        moments[5, t] = found.apart[t]
    put_spreads(ends, moments, spreads)
    _copy(room[14:15], tiles.apart.reshape(1, -1))
    put_spreads(ends, found.moments, tiles.spreads.reshape(12, SEGMENTS, number))
    put_shifts(ends, shifts)
    widen(ends[BETA], shifts)
    put_lines(ends, half, tiles.axis[:6].reshape(6, SEGMENTS, number))
    _copy(tiles.spreads[9:], tiles.axis[6:])
    for end in range(2):
        for t in range(number):
            ends[BETA, end, t] = 0.0
    put_lines(ends, half, tiles.resting.reshape(6, SEGMENTS, number))


@borrowing()
def _copy(values, out):
    """Put rows of numbers elsewhere: by itself in less code than wherever it is done."""
    for k in range(values.shape[0]):
        for i in range(values.shape[1]):
            out[k, i] = values[k, i]


@borrowing()
def _put_light(tiles, link):
    """The bare line's peak over sigma, and the echo's shot noise over all other."""
    oscillator, beat, transimpedance, window, deviation, shot, others = link
    found = tiles.found
    for t in range(found.beside.size):
        for end in range(2):
            far, echo = found.range[1 - end, t], found.echo[end, t]
            power = found.light[end, t] / (far * far)
            voltage = beat * np.sqrt(oscillator * power) * transimpedance
            tiles.peak[end, t] = voltage * 0.5 * np.sqrt(echo) * window / deviation
            ratio = found.ratio[end, t]
            more = np.minimum(ratio, 1.0) if end == 0 else np.maximum(ratio, 1.0)
            tiles.noise[end, t] = power * echo * more * shot / others


@borrowing()
def is_there(effect, tiles, scene):
    """Whether a scene has anything of an effect."""
    if effect == FOOTPRINT:
        return scene.beamlets > 1
    if effect == PHASE:
        return scene.amplitudes
    if effect == SEVERAL:
        return _is_any(tiles.found.beside)
    if effect in (DOPPLER, WALK):
        return _is_any(tiles.found.velocity[0]) or _is_any(tiles.found.velocity[1])
    if effect == SPREAD:
        return _is_any(tiles.spreads[8])
    return True


@borrowing()
def _is_any(values):
    """Whether any of some numbers is not 0."""
    found = False
    for value in values:
        found |= value != 0.0
    return found


@borrowing()
def put_all_changes(tiles, scene, room, table):
    """What effects may change of bins, (effects, fields, cells), leakage left out."""
    for k in range(table.shape[0]):
        for m in range(CHANGE_FIELDS):
            for i in range(table.shape[2]):
                table[k, m, i] = OF_NONE[m]
    if is_there(FOOTPRINT, tiles, scene):
        _put_footprint(tiles, scene, room, table[FOOTPRINT])
    if is_there(PHASE, tiles, scene):
        _put_phase(tiles, scene, room, table[PHASE])
    if is_there(SEVERAL, tiles, scene):
        _put_several(tiles, scene, room, table[SEVERAL])
    if is_there(DOPPLER, tiles, scene):
        _put_doppler(tiles, scene, room, table[DOPPLER])
    if is_there(SPREAD, tiles, scene):
        _put_doppler_spread(tiles, scene, room, table[SPREAD])
    _put_noise(tiles, table[NOISE])
    if is_there(WALK, tiles, scene):
        _put_range_walk(tiles, scene, room, table[WALK])
    _put_image(tiles, scene, room, table[IMAGE])


@borrowing()
def _put_moves(moves, still, tiles, scene, entry):
    """Factors of :func:`.line_spread.moved_change`, of a table of its first seven rows.

    Those are a shift, and moments that are added and that are there.
    """
    _copy(tiles.axis[:6], moves[7:13])
    _copy(still, moves[13:])
    put_moved_changes(moves, scene.beamlets, scene.tables, scene.lobe, entry)


@borrowing()
def _put_sums(bins, tiles, scene, room, entry):
    """What moving lines whose amplitudes add can change: :func:`.footprint_phase.sum_added`."""
    table, axis = room[:4], tiles.axis
    for i in range(bins.size):
        table[0, i], table[1, i], table[2, i], table[3, i] = (
            axis[5, i], axis[8, i], bins[i], scene.turn_of_bin,
        )  # fmt: skip
    put_sums_added(table, np.sqrt(scene.lobe[1]), scene.worst, entry[ADDED])


@borrowing()
def _put_footprint(tiles, scene, room, entry):
    """:func:`.footprint.bound`."""
    moves, number = room[:19], tiles.found.beside.size
    for i in range(moves.shape[1]):
        moves[0, i] = 0.0
        for m in range(3):
            moves[1 + m, i], moves[4 + m, i] = tiles.spreads[3 + m, i], 0.0
    _put_moves(moves, tiles.axis[:6], tiles, scene, entry)
    for i in range(moves.shape[1]):
        entry[WEAK, i] *= np.sqrt(tiles.found.ratio[0, i % number])
        entry[STRONG, i] *= np.sqrt(tiles.found.ratio[1, i % number])


@borrowing()
def _put_phase(tiles, scene, room, entry):
    """:func:`.footprint_phase.bound`."""
    found, axis, number, table = tiles.found, tiles.axis, tiles.found.beside.size, room[:7]
    for i in range(axis.shape[1]):
        t = i % number
        further = scene.turns[i // number, 0] * (found.range[1, t] * found.moments[2, t])
        table[0, i], table[1, i], table[2, i] = axis[2, i], axis[5, i], axis[8, i]
        table[3, i] = further + tiles.spreads[8, i] * scene.turn_of_bin
        table[4, i], table[5, i], table[6, i] = found.gain[0, t], found.gain[1, t], np.inf
    sizes = scene.lobe[1], scene.lobe[2], scene.worst
    put_sum_changes(table, sizes, scene.tails, float(scene.beamlets), entry)


@borrowing()
def _put_several(tiles, scene, room, entry):
    """:func:`.several_returns.bound`."""
    axis, number, found = tiles.axis, tiles.found.beside.size, room[:4]
    given, table = room[4:11], room[11:18]
    for i in range(axis.shape[1]):
        given[0, i], given[1, i], given[2, i], given[3, i] = (
            axis[0, i], axis[1, i], axis[2, i], axis[5, i],
        )  # fmt: skip
        given[4, i], given[5, i], given[6, i] = 0.0, 0.0, 0.0
    put_power_ranges(given, scene.beamlets, scene.tables, scene.lobe, found[:2])
    _copy(tiles.spreads[3:6], given[4:])
    put_power_ranges(given, scene.beamlets, scene.tables, scene.lobe, found[2:])
    for i in range(axis.shape[1]):
        table[0, i], table[1, i] = tiles.found.beside[i % number], tiles.apart[i]
        table[2, i], table[3, i] = found[2, i], found[1, i]
        table[4, i], table[5, i], table[6, i] = axis[2, i], axis[4, i], axis[5, i]
    put_changes(table, scene.lobe[2], scene.tables[1], scene.amplitudes, entry)


@borrowing()
def _put_doppler(tiles, scene, room, entry):
    """:func:`.doppler.bound`."""
    shifts, number = tiles.shifts, tiles.found.beside.size
    moves, moved = room[:19], room[19:21]
    for i in range(shifts.size):
        moves[0, i] = shifts[i]
        for m in range(3):
            moves[1 + m, i], moves[4 + m, i] = 0.0, tiles.spreads[9 + m, i]
    _put_moves(moves, tiles.resting, tiles, scene, moved)
    if scene.amplitudes:
        bins = room[4]
        for i in range(shifts.size):
            bins[i] = shifts[i] * (1 + tiles.axis[8, i])
        _put_sums(bins, tiles, scene, room, entry)
    for i in range(shifts.size):
        away = False
        for s in range(SEGMENTS):
            away |= shifts[s * number + i % number] > NOT_AWAY
        if away:
            entry[SHIFT, i], entry[ADDED, i] = 1.0, 0.0
        else:
            entry[SHIFT, i] = shifts[i]
            entry[WEAK, i], entry[STRONG, i] = 1 / moved[1, i], 1 / moved[0, i]


@borrowing()
def _put_doppler_spread(tiles, scene, room, entry):
    """:func:`.doppler_spread.bound`."""
    moves = room[:19]
    for i in range(moves.shape[1]):
        moves[0, i] = 0.0
        for m in range(3):
            moves[1 + m, i], moves[4 + m, i] = tiles.spreads[6 + m, i], tiles.spreads[m, i]
    _put_moves(moves, tiles.axis[:6], tiles, scene, entry)
    if scene.amplitudes:
        _put_sums(tiles.spreads[8], tiles, scene, room, entry)


@borrowing()
def _put_noise(tiles, entry):
    """:func:`.signal_shot_noise.bound`."""
    number = tiles.found.beside.size
    for i in range(entry.shape[1]):
        t = i % number
        entry[DOWN, i], entry[UP, i] = 1 + tiles.noise[0, t], 1 + tiles.noise[1, t]
        entry[SHARE, i] = 0.0


@borrowing()
def _put_range_walk(tiles, scene, room, entry):
    """:func:`.range_walk.bound`."""
    cells, number = tiles.axis.shape[1], tiles.found.beside.size
    given, drifts = room[0:2].reshape(6, number)[:4], room[2:3].reshape(3, number)[:2]
    walk, over = room[3:5].reshape(6, number)[:5], room[5:11].reshape(18, number)[:17]
    for t in range(number):
        given[0, t], given[1, t] = scene.rate, scene.rate
        given[2, t] = tiles.found.velocity[0, t] * 2 / SPEED_OF_LIGHT
        given[3, t] = tiles.found.velocity[1, t] * 2 / SPEED_OF_LIGHT
    put_drifts(given, drifts)
    for t in range(number):
        for k in range(15):
            over[k, t] = scene.times[k]
        over[15, t], over[16, t] = drifts[0, t], drifts[1, t]
    put_over_record(over, _SQUARE, walk)
    table, found = room[11:24], room[24:28]
    for i in range(cells):
        for k in range(13):
            table[k, i] = 0.0
        for k in range(5 if i // number != 1 else 0):
            table[k if k else 6, i] = walk[k, i % number]
    flags, lobe = (False, scene.beamlets == 1, scene.amplitudes), (scene.tables, scene.lobe)
    put_error_changes(
        tiles.axis, table, scene.beamlets, lobe, scene.record, scene.window, flags, found
    )  # fmt: skip
    for i in range(cells):
        entry[WEAK, i], entry[STRONG, i] = found[0, i], found[1, i]
        entry[ADDED, i], entry[SHIFT, i] = found[2, i], found[3, i]


@borrowing()
def _put_image(tiles, scene, room, entry):
    """:func:`.image.bound`."""
    axis, cells, number = tiles.axis, tiles.axis.shape[1], tiles.found.beside.size
    found, half = room[:2], scene.fft_size / 2
    put_bounds(axis, scene.beamlets, scene.tables, scene.lobe, scene.tails, found)
    for i in range(cells):
        entry[STRONG, i] = found[0, i]
        if scene.amplitudes:
            entry[ADDED, i] = found[1, i]
    if not scene.counts:
        return
    table, moved = room[2:5], room[5:6].reshape(3, number)
    for i in range(cells):
        table[0, i], table[1, i], table[2, i] = (
            tiles.in_phase[i], tiles.peak[1, i % number], scene.threshold,
        )  # fmt: skip
    lines, sums = axis.reshape(9, SEGMENTS, number), table.reshape(3, SEGMENTS, number)
    put_moved_bins(lines, sums, half, scene.tails, scene.amplitudes, moved[:2])
    put_alarms(moved[0], moved[1], half, moved[2])
    for i in range(cells):
        entry[ALARMS, i] = moved[2, i % number]
