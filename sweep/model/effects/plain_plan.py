"""Plans of flights in plain scenes: those of :func:`.planning.plan`, in one compiled pass."""

import numpy as np

from sweep.model.effects import tile_geometry
from sweep.model.effects.catalogue import NAMES
from sweep.model.effects.leakage import unions
from sweep.model.effects.line_powers import put_amplitudes
from sweep.model.effects.plain_changes import (
    LEAKAGE,
    SEGMENTS,
    changes,
    compiled,
    is_there,
    tiles_of,
)
from sweep.model.effects.plain_scene import PLAIN, PlainScene
from sweep.model.effects.planning import Plan, Rules, choose
from sweep.model.effects.probability_bounds import CHANGE_FIELDS, changes_of, finish, put_all

_ROWS = np.array([NAMES.index(name) for name in PLAIN])


def plain_plan(
    scene: PlainScene, found: np.ndarray, edges: np.ndarray, rules: Rules, tolerance: float
) -> Plan:
    """The plan of tiles of shots, as of :func:`.planning.plan`; Doppler must not be off.

    Parameters
    ----------
    scene : PlainScene
        What the shots' instrument is.
    found : (fields + 2, n) ndarray
        Of the shots' footprints; their ranges [m] and radial velocities [m/s].
    edges : (tiles + 1,) int ndarray
        Tile i holds the shots from ``edges[i]`` up to ``edges[i + 1]``, one at least.
    rules, tolerance
        Of modes; on the sum of what is left out.
    """
    spans = tile_geometry.over(found, edges)
    change = np.zeros((len(NAMES), edges.size - 1))
    kept, error = np.zeros(change.shape, np.bool_), np.empty(edges.size - 1)
    ends = np.asarray(spans.low), np.asarray(spans.high)
    leaks = rules.asks_for_leakage, rules.spreading
    # as a plain tuple, whose types are told at once
    _plan(ends, tuple(scene), leaks, tuple(rules.choice), tolerance, (change, kept, error))
    return Plan(rules.names, kept, change, error)


@compiled(nogil=True)
def _plan(ends, scene, leaks, choice, tolerance, out):
    """Changes and what is kept, (effects, tiles), and errors, (tiles,)."""
    (change, kept, error), scene = out, PlainScene(*scene)
    tiles = tiles_of(ends, scene)
    there, flat = np.zeros(len(change), np.bool_), changes(tiles, scene)
    number = len(error)
    table = flat.reshape(LEAKAGE, CHANGE_FIELDS, SEGMENTS, number)
    for k in range(LEAKAGE):
        there[_ROWS[k]] = is_there(k, tiles, scene)
    there[_ROWS[LEAKAGE]] = True
    finish(flat)
    without = _without(tiles, scene)
    leaked = _leaked(table, without, tiles, scene)
    leaking = np.zeros((LEAKAGE, number))
    asked, spreading = leaks
    for k in range(LEAKAGE):
        if asked and spreading[_ROWS[k]]:
            leaking[k] = leaked
    told = changes_of(table, without, leaking)
    for k in range(LEAKAGE):
        change[_ROWS[k]] = np.minimum(told[k], 1.0)
    change[_ROWS[LEAKAGE]] = np.minimum(leaked, 1.0)
    choose(change, there, choice, tolerance, kept, error)


@compiled
def _without(tiles, scene):
    """Ends of amplitude and threshold over sigma, (2, 2, 3, tiles): :attr:`.Block.amplitude`."""
    number, cells = tiles.low.shape[1], tiles.axis.shape[1]
    given, found = np.empty((6, cells)), np.empty((2, cells))
    for i in range(cells):
        given[0, i], given[1, i] = tiles.peak[0, i % number], tiles.peak[1, i % number]
        given[2, i], given[3, i] = tiles.axis[0, i], tiles.axis[1, i]
        given[4, i], given[5, i] = tiles.axis[3, i], tiles.axis[4, i]
    highest, lowest = scene.tables
    put_amplitudes(given, highest, lowest, found)
    ends = np.full((2, 2, SEGMENTS, number), scene.threshold)
    ends[0] = found.reshape(2, SEGMENTS, number)
    return ends


@compiled
def _leaked(changes, without, tiles, scene):
    """What leakage may change, (tiles,): :func:`.leakage.bound`."""
    number, cells = tiles.low.shape[1], tiles.axis.shape[1]
    left, given, found = np.empty(without.shape), np.empty((7, cells)), np.zeros(number)
    put_all(changes, without, left)
    for i in range(cells):
        s, t = i // number, i % number
        given[0, i], given[1, i], given[2, i] = tiles.in_phase[i], tiles.in_phase[i], tiles.lean[i]
        given[3, i], given[4, i] = tiles.peak[1, t], left[0, 0, s, t]
        given[5, i], given[6, i] = left[1, 0, s, t], left[1, 1, s, t]
    cell = unions(
        tiles.axis, given, scene.tails, scene.sidelobes, scene.far, scene.bins, not scene.amplitudes
    )
    for i in range(cells):
        found[i % number] += cell[i]
    return found
