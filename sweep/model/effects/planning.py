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

FREE_SHARE = 0.01
"""Share of the tolerance that what is left out of the noise may take: a number added to a shot's
variance costs nothing to simulate, so that leaving it out gains nothing but an error."""


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
        is left out in ``auto``. With one that is off go those that are within it.
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
    rules = _rules(tuple(effects), tuple((modes or {}).items()))
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
    kept = _kept(change, [row for row in bounds if row not in rules.decided], rules, tolerance)
    return Plan(rules.names, kept, change, _left_out(kept, change))


def _bounds(effects: Sequence[Effect], block: Block, rest: Block) -> dict[int, Bound]:
    """Bounds of the effects that the scene has; all but Doppler's from lines as they are left."""
    asked: dict[int, Bound] = {}
    for row, effect in enumerate(effects):
        bound = effect.bound(block if effect.name == "doppler" else rest)
        if bound is not None:
            asked[row] = bound
    return asked


def _leaking(rows: Sequence[int], rules: "_Rules") -> dict[str, Any]:
    """What of :func:`probability_changes` is told where a study asks for leakage.

    Bins that leak are so much smaller than the largest that next to nothing of that is much of
    them: it takes nearly all effects to tell leakage, and most studies look at detection.
    """
    if rules.leakage not in rules.on or rules.leakage not in rows:
        return {}
    return {
        "leakage": rows.index(rules.leakage), "spreads": [row in rules.spreading for row in rows]
    }  # fmt: skip


class _Rules(NamedTuple):
    """What modes say of effects, by row, whatever the bounds do."""

    names: tuple[str, ...]
    free: np.ndarray
    """Whether it costs nothing, (effects,) bool."""
    spreading: frozenset[int]
    """Those that move light from bins to others."""
    leakage: int
    """Row of the leakage; -1 for none."""
    decided: frozenset[int]
    """Those that are on or off."""
    on: list[int]
    off: list[int]
    parents: np.ndarray
    """Of each, what it is within; -1 for none."""
    needs: tuple[tuple[int, int], ...]
    """Effects, and what each is simulated with."""
    at_rest: bool
    """Whether the Doppler effect is off."""


@lru_cache(maxsize=16)
def _rules(effects: tuple[Effect, ...], modes: tuple[tuple[str, str], ...]) -> _Rules:
    """What modes say, the same for all blocks of a study."""
    names = tuple(effect.name for effect in effects)
    within = {effect.name: effect.within for effect in effects if effect.within in names}
    decided = _decided(names, dict(modes), within)
    parents = np.full(len(names), -1)
    for child, parent in within.items():
        parents[names.index(child)] = names.index(parent)
    return _Rules(
        names=names,
        free=np.array([effect.stage == "noise" for effect in effects]),
        spreading=frozenset(
            row
            for row, effect in enumerate(effects)
            if effect.stage in ("lines", "record", "spectrum")
        ),
        leakage=names.index("leakage") if "leakage" in names else -1,
        decided=frozenset(map(names.index, decided)),
        on=[names.index(name) for name, mode in decided.items() if mode == "on"],
        off=[names.index(name) for name, mode in decided.items() if mode == "off"],
        parents=parents,
        needs=tuple(
            (row, names.index(need))
            for row, effect in enumerate(effects)
            for need in effect.needs
            if need in names and decided.get(need) != "off"
        ),
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


def _kept(change: np.ndarray, chosen: Sequence[int], rules: _Rules, tolerance: float) -> np.ndarray:
    """Effects to keep, of those to choose from and of all that modes say, (effects, tiles) bool.

    The smallest are left out first, as long as their sum is within what the tolerance leaves; an
    effect never before those within it. Those that cost nothing have a share of it alone.
    """
    kept = np.zeros(change.shape, np.bool_)
    if chosen:
        room = np.full(change.shape[1], tolerance, float)
        if rules.off:
            room = np.maximum(tolerance - change[rules.off].sum(axis=0), 0.0)
        _keep(change, np.array(chosen[::-1]), rules.parents, rules.free, room, kept)
    if rules.on:
        kept[rules.on] = True
    for row, need in rules.needs:
        kept[need] |= kept[row]
    return kept


@njit(cache=True, error_model="numpy")
def _keep(change, rows, parents, free, room, kept):
    """Mark all but the smallest of some rows, last ones first where they are alike, that fit."""
    key, order = np.empty(len(change)), np.empty(len(rows), np.int64)
    for t in range(change.shape[1]):
        key[:] = change[:, t]
        for i in range(len(rows)):
            parent = parents[rows[i]]
            if parent >= 0:
                key[parent] = np.maximum(key[parent], key[rows[i]])
        for i in range(len(rows)):
            place = i
            while place > 0 and _is_less(key[rows[i]], key[order[place - 1]]):
                order[place] = order[place - 1]
                place -= 1
            order[place] = rows[i]
        total, unpaid = 0.0, 0.0
        for row in order:
            if free[row]:
                unpaid += change[row, t]
                if not unpaid <= FREE_SHARE * room[t]:
                    kept[row, t] = True
                    continue
            total += change[row, t]
            kept[row, t] = not total <= room[t]


@njit(cache=True, error_model="numpy")
def _left_out(kept, change):
    """Sum of the changes by what is not kept, (tiles,)."""
    total = np.zeros(change.shape[1])
    for i in range(change.shape[0]):
        for t in range(total.size):
            total[t] += 0.0 if kept[i, t] else change[i, t]
    return total


@njit(cache=True, error_model="numpy")
def _is_less(one, other):
    return one < other or (np.isnan(other) and not np.isnan(one))
