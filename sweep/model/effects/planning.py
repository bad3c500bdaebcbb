"""Which effects are simulated where: in each tile those that pass the tolerance together.

Effects' bounds are intervals on one magnitude. When several effects are left out and others kept,
the magnitude from which one of them counts lies anywhere in the product of all the others'
intervals, each with 1 in it (:mod:`sweep.model.effects.probability_bounds`). What is left out then
changes pd, log10 of a false alarm's probability and the magnitude by no more than the sum of these
changes, whichever of the others are there.
"""

from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numba import njit

from sweep.model.effects.block import Block
from sweep.model.effects.catalogue import EFFECTS
from sweep.model.effects.change import Bound
from sweep.model.effects.effect import MODES, Effect
from sweep.model.effects.probability_bounds import probability_changes


class Plan(NamedTuple):
    """What is simulated in each tile, effect by effect."""

    names: tuple[str, ...]
    """Effects in the order in which they act."""
    kept: np.ndarray
    """(effects, tiles) bool: whether it is simulated."""
    change: np.ndarray
    """(effects, tiles): largest change that it may make, 0..1."""
    error: np.ndarray
    """(tiles,): sum of what is left out may change; above the tolerance only by what is off."""

    def effects(self, tile: int) -> tuple[str, ...]:
        """Effects that are simulated in a tile."""
        return tuple(
            name for name, kept in zip(self.names, self.kept[:, tile], strict=True) if kept
        )


def plan(
    block: Block,
    modes: Mapping[str, str] | None = None,
    tolerance: float = 0.0,
    effects: Sequence[Effect] = EFFECTS,
) -> Plan:
    """Effects to be simulated in each of a block's tiles.

    Parameters
    ----------
    block : Block
        The tiles.
    modes : mapping, optional
        Name to ``auto`` (by default), ``on`` or ``off``. An effect that the scene has nothing of
        is left out, even if it is on. With one that is off go those that are within it.
    tolerance : float
        On the sum of the changes by all that is left out, 0..1: of pd in the three segments
        together, of log10 of a false alarm's probability, of a relative magnitude.
    effects : sequence of Effect, optional
        Those to choose from, all by default.

    Raises
    ------
    ValueError
        For a mode that is none of these, a name that is no effect's, or an effect that is on
        within one that is off.
    """
    rules = rules_of(tuple(effects), tuple((modes or {}).items()))
    rest = block.at_rest() if rules.at_rest else block
    bounds = _bounds(effects, block, rest)
    change = np.zeros((len(effects), block.size))
    if bounds:
        change[list(bounds)] = probability_changes(
            list(bounds.values()),
            amplitude=rest.amplitude,
            threshold=block.threshold,
            **_leaking(list(bounds), rules),
        )
    there = np.zeros(len(effects), np.bool_)
    there[list(bounds)] = True
    kept, error = np.zeros(change.shape, np.bool_), np.empty(block.size)
    choose(change, there, rules.choice, tolerance, kept, error)
    return Plan(rules.names, kept, change, error)


def _bounds(effects: Sequence[Effect], block: Block, rest: Block) -> dict[int, Bound]:
    """Bounds of the effects that the scene has; all but Doppler's from lines as they are left."""
    asked: dict[int, Bound] = {}
    for row, effect in enumerate(effects):
        bound = effect.bound(block if effect.name == "doppler" else rest)
        if bound is not None:
            asked[row] = bound
    return asked


def _leaking(rows: Sequence[int], rules: "Rules") -> dict[str, Any]:
    """What of :func:`probability_changes` is told where a study asks for leakage.

    Bins that leak are so much smaller than the largest that next to nothing of that is much of
    them: it takes nearly all effects to tell leakage, and most studies look at detection.
    """
    if not rules.asks_for_leakage or rules.leakage not in rows:
        return {}
    return {"leakage": rows.index(rules.leakage), "spreads": rules.spreading[list(rows)]}


class Choice(NamedTuple):
    """What modes say of effects as compiled code takes it, by row."""

    open: np.ndarray
    """Whether it is neither on nor off, (effects,) bool."""
    free: np.ndarray
    """Tell whether it costs nothing, as a number added to the noise does, (effects,) bool."""
    parents: np.ndarray
    """Of each, what it is within; -1 for none."""
    on: np.ndarray
    off: np.ndarray
    """Those that are on, and off, int64."""
    needs: np.ndarray
    """(m, 2) int64: effects, and what each is simulated with."""


class Rules(NamedTuple):
    """What modes say of effects, whatever the bounds do."""

    names: tuple[str, ...]
    choice: Choice
    spreading: np.ndarray
    """Those that move light from bins to others, (effects,) bool."""
    leakage: int
    """Row of the leakage; -1 for none."""
    asks_for_leakage: bool
    """Whether it is on."""
    at_rest: bool
    """Whether the Doppler effect is off."""


@lru_cache(maxsize=16)
def rules_of(effects: tuple[Effect, ...], modes: tuple[tuple[str, str], ...]) -> Rules:
    """What modes say, the same for all blocks of a study."""
    names = tuple(effect.name for effect in effects)
    within = {effect.name: effect.within for effect in effects if effect.within in names}
    decided = _decided(names, dict(modes), within)
    parents = np.full(len(names), -1)
    for child, parent in within.items():
        parents[names.index(child)] = names.index(parent)
    needs = [
        (row, names.index(need))
        for row, effect in enumerate(effects)
        for need in effect.needs
        if need in names and decided.get(need) != "off"
    ]
    rows = {mode: [names.index(n) for n, m in decided.items() if m == mode] for mode in MODES}
    choice = Choice(
        open=np.array([name not in decided for name in names], np.bool_),
        free=np.array([effect.stage == "noise" for effect in effects], np.bool_),
        parents=parents,
        on=np.array(rows["on"], np.int64),
        off=np.array(rows["off"], np.int64),
        needs=np.array(needs, np.int64).reshape(-1, 2),
    )
    moving = ("lines", "record", "spectrum")
    return Rules(
        names=names,
        choice=choice,
        spreading=np.array([effect.stage in moving for effect in effects], np.bool_),
        leakage=names.index("leakage") if "leakage" in names else -1,
        asks_for_leakage=decided.get("leakage") == "on",
        at_rest=decided.get("doppler") == "off",
    )


def _decided(
    names: Sequence[str], modes: Mapping[str, str], within: Mapping[str, str]
) -> dict[str, str]:
    """Effects that are on or off whatever the bounds say, and what these take with them."""
    if unknown := sorted(set(modes) - set(names)):
        raise ValueError(f"no effect {', '.join(unknown)}: choose from {', '.join(names)}")
    for name, mode in modes.items():
        if mode not in MODES:
            raise ValueError(f"{name}: no mode {mode!r}: choose from {', '.join(MODES)}")
    decided = {name: mode for name, mode in modes.items() if mode != "auto"}
    for name in names:  # an effect follows in the list what it is within
        if decided.get(within.get(name, "")) == "off":
            if decided.get(name) == "on":
                raise ValueError(f"{name} cannot be on within {within[name]}, which is off")
            decided[name] = "off"
    for name in reversed(names):
        if decided.get(name) == "on" and name in within:
            decided[within[name]] = "on"
    return decided


@njit(cache=True, error_model="numpy")
def choose(change, there, choice, tolerance, kept, error):
    """Mark effects to keep, (effects, tiles) bool; sum what those that are not change, (tiles,).

    The smallest are left out first, as long as their sum is within what the tolerance leaves; an
    effect never before those within it, last ones first where they are alike. Those that cost
    nothing are never left out. ``there`` says of which effects the scene has anything.
    """
    choosable, free, parents, on, off, needs = choice
    key, order = np.empty(len(change)), np.empty(len(change), np.int64)
    for t in range(change.shape[1]):
        room = 0.0
        for row in off:
            room += change[row, t]
        room = np.maximum(tolerance - room, 0.0)
        number = _put_in_order(change[:, t], there & choosable, parents, key, order)
        _keep(change[:, t], order[:number], free, room, kept[:, t])
        for row in on:
            kept[row, t] = there[row]
        for m in range(len(needs)):
            kept[needs[m, 1], t] |= kept[needs[m, 0], t]
        error[t] = 0.0
        for row in range(len(change)):
            error[t] += 0.0 if kept[row, t] else change[row, t]


@njit(cache=True, error_model="numpy")
def _put_in_order(change, rows, parents, key, order):
    """Sort rows that are marked by what they change with all within them; how many these are."""
    key[:] = change
    number = 0
    for row in range(len(change) - 1, -1, -1):
        if rows[row] and parents[row] >= 0:
            key[parents[row]] = np.maximum(key[parents[row]], key[row])
    for row in range(len(change) - 1, -1, -1):
        if rows[row]:
            place = number
            while place > 0 and _is_less(key[row], key[order[place - 1]]):
                order[place] = order[place - 1]
                place -= 1
            order[place] = row
            number += 1
    return number


@njit(cache=True, error_model="numpy")
def _keep(change, order, free, room, kept):
    """Mark all but the smallest of some rows that fit into the room."""
    total = 0.0
    for row in order:
        total += 0.0 if free[row] else change[row]
        kept[row] = free[row] or not total <= room


@njit(cache=True, error_model="numpy")
def _is_less(one, other):
    return one < other or (np.isnan(other) and not np.isnan(one))
