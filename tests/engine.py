"""Shots of one category, keys of points, and bins and lines as detection and leakage see them."""

from itertools import product

import numpy as np
import pytest

from sweep.model import line_shape, philox
from sweep.model.effects.catalogue import CORE
from sweep.model.lines import BLOCK, IM, PLACE, RE, place_lines
from sweep.model.segments import runs_of
from sweep.model.shot import prepare
from sweep.model.spectrum import IMAGED

DRAWS = 10_000
"""5 sigma of a proportion are at most 5 sqrt(1/4 / 10,000) = 0.025: an error of 5 % of pd shows.

A sample variance of as many is known to sqrt(2/10,000) = 1.4 %: at 5 sigma 7 % in a variance show.
"""


def every(step, *choices):
    """All combinations of some choices; all but every `step`-th of them are slow.

    With a step that has no divisor in common with their numbers, each choice is taken.
    """
    return [
        pytest.param(*case, marks=[pytest.mark.slow] * (k % step > 0))
        for k, case in enumerate(product(*choices))
    ]


def prepared(parameters, effects=CORE):
    """Shots of parameters that are all of one category."""
    ((_, shots),) = prepare(parameters, effects)
    return shots


def keys(n, seed=5):
    """Keys of n points."""
    return philox.point_keys(np.arange(float(n))[:, None], domain="tests", seed=seed)


def within_5_sigma(counts, chance, slack=0.0):
    """Counts of as many draws that a chance explains, True for each."""
    spread = np.sqrt(DRAWS * chance * (1 - chance))
    return np.abs(counts - DRAWS * chance) <= 5 * spread + slack + 1e-9


def by_vectors(distance, grazing, off):
    """Range and grazing angle of jittered rays that are followed down to the plane z = 0."""
    start = np.array([0.0, 0.0, distance * np.sin(grazing)])
    aim = np.array([np.cos(grazing), 0.0, -np.sin(grazing)])
    up, aside = np.array([np.sin(grazing), 0.0, np.cos(grazing)]), np.array([0.0, 1.0, 0.0])
    angle = np.hypot(*off.T)[:, None]
    across = off[:, :1] * up + off[:, 1:] * aside
    direction = aim * np.cos(angle) + across * np.sinc(angle / np.pi)
    far = -start[2] / direction[:, 2]
    return far, np.arcsin(-direction[:, 2]), direction


def run_of_bins(shots, segment):
    """First bin and |X| of those that are looked at one by one, of the first point."""
    (runs,) = runs_of(shots, points=np.zeros(1, np.int64))
    return int(runs.low[segment, 0]), runs.run(segment, 0).copy()


def difference(shots, fast, exact, peak=None):
    """Largest difference of |X|, over the peak.

    Where lines add as powers |X|^2 is the sum, to some roundings of its largest terms: 1e-13 of the
    peak's power count as no more than 1e-9 of the peak, which they exceed where |X| is 86 dB down.
    """
    peak = exact.max() if peak is None else peak
    found = np.abs(fast - exact) / peak
    if shots.incoherent:
        found = np.minimum(found, 1e4 * np.abs(fast**2 - exact**2) / peak**2)
    return found.max()


def lines_of(shots, i, segment):
    """Origin of a segment's lines, places beside it [bins], weights C_b."""
    n, row = shots.offset.shape[1], int(shots.row[i])
    room = np.empty((BLOCK + 1, n))
    sizes = np.array([shots.fft_size, shots.window.length, 0, 0, 0, 0])
    point = np.ascontiguousarray(shots.point_table()[:, i])
    origin = place_lines(point, segment, shots.footprint, row, sizes, room)
    return origin, room[PLACE], room[RE] + 1j * room[IM]


def shape_of(window, fft_size, *, power=False, phase=None, view=IMAGED):
    """Line shape of a window with a phase error [cycles], a function of x = -1 .. 1.

    Its table; envelope and ends, as `spectrum` takes them; sizes; shift of the line [bins]; and
    modes, 0 of a table of all bins.
    """
    phase, table, number = phase or np.zeros_like, None, 0
    for tier, (most, _, _) in enumerate(line_shape.TIERS):
        if not line_shape.has_modes(window, fft_size):
            break
        centre, modes = np.zeros((1, 1)), np.zeros((1, 1, 2, most))
        count = np.zeros((1, 1), np.int64)
        at = phase(line_shape.record_places(2 * most))[None, None]
        line_shape.find_modes(
            at, np.empty((0, 0, 0)), line_shape.to_modes(2 * most), centre, modes, count
        )
        number = int(count[0, 0])
        if number:
            shapes = line_shape.shapes(window, fft_size, power, tier)
            table = np.empty((2, line_shape.places_of(shapes.sizes)))
            form = np.zeros((7, shapes.reach.shape[1]))
            parts = centre, modes, count, np.empty((1, 2, 0))
            line_shape.build(0, (0, -1), parts, shapes, table, form)
            break
    if table is None:
        x = 2 * np.arange(window.length) / window.length - 1
        shapes, centre = line_shape.whole_shapes(window, fft_size, power, phase(x)[None]), None
        table, form = shapes.whole[0], np.zeros((7, shapes.reach.shape[1]))
        form[1:3] = shapes.outlines[0]
    form[0] = shapes.reach[0]
    shift = 0.0 if centre is None else centre[0, 0] * fft_size / window.length
    return table, form, np.append(shapes.sizes, (view, 0)), shift, number
