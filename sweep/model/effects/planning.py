"""Effects to be simulated in each tile: those that any of its points needs.

The change by leaving an effect out is estimated at each point, and is a tile's largest. The
smallest are left out as long as their sum is within the tolerance: a tighter one keeps all that a
looser one does.

With x = ln a, a and the threshold b over sigma, dQ_1/dx = a b I_1(a b) e^{-(a^2 + b^2)/2} is at
most sqrt(a b / (2 pi)) e^{-(a - b)^2 / 2}. This has one maximum, at a (a - b) = 1/2. It is taken
at its largest between the least and the largest a that all effects together may leave. An addition
to a magnitude counts by dQ_1/da <= 1/2 e^{-(a - b)^2 / 2}, noise that the threshold does not follow
by -dQ_1/d ln b <= b^2 e^{-(a - b)^2 / 2} / sqrt(1 + 2 a b), and

    |d log10 P^2| <= |d b^2| / ln 10

for the probability P^2 of a false alarm in a shot. If pd is 1 whatever happens bins still have
magnitudes: |X| counts by its change over itself, or over sigma where it is below that.

If segments report their strongest peak alone an echo has to exceed the largest noise too: b is
the level at which pd is steepest, of those between the threshold and that.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from sweep.model.effects.catalogue import EFFECTS
from sweep.model.effects.effect import Effect, Size
from sweep.model.effects.points import Points

_LN_10 = math.log(10.0)
_HUGE = 1e12
_MOVING = ("lines", "record", "spectrum")
"""Stages of effects that move light from bins to others."""


class Plan(NamedTuple):
    """Plan of the effects that are simulated in each tile."""

    names: tuple[str, ...]
    """Effects in the order in which they act."""
    kept: np.ndarray
    """(effects, tiles) bool: whether it is simulated."""
    change: np.ndarray
    """(effects, tiles): largest change that it may make, 0..1."""
    error: np.ndarray
    """(tiles,): sum of what is left out may change, and :attr:`left`; above the tolerance only by
    this, and by what is off."""
    left: np.ndarray
    """(tiles,): change by what effects that are simulated leave out."""
    all_kept: np.ndarray
    """(tiles,) bool: whether nothing is left out that any mode leaves a choice about."""

    def some(self, tiles: np.ndarray) -> "Plan":
        """Of some of the tiles, by a mask."""
        kept, change = self.kept[:, tiles], self.change[:, tiles]
        error, left = self.error[tiles], self.left[tiles]
        return Plan(self.names, kept, change, error, left, self.all_kept[tiles])


def plan(
    points: Points,
    tiles: Callable[[np.ndarray], np.ndarray],
    modes: Mapping[str, str] | None = None,
    tolerance: float = 0.0,
    effects: Sequence[Effect] = EFFECTS,
) -> Plan:
    """Effects to be simulated in each tile of some points.

    ``tiles`` gives the largest value in each tile, (tiles,), of values that broadcast over the
    points. ``modes`` are ``auto`` (by default), ``on`` or ``off`` by name. An effect that the scene
    has nothing of is left out, even if it is on. With one that is off go those that are within it;
    a ValueError where one of these is on. ``tolerance`` is on the sum of the changes by all that is
    left out, 0..1: of pd in the three segments together, of log10 of a false alarm's probability,
    of a relative magnitude.
    """
    names = tuple(effect.name for effect in effects)
    decided = _decided(effects, modes or {})
    points.at_rest = decided.get("doppler") == "off"
    points.at_one_range = decided.get("segment_motion") == "off"
    points.fills_records = decided.get("overlap") == "off"
    with np.errstate(all="ignore"):  # of what exceeds all numbers nothing is known: it is kept
        sizes = sizes_of(points, effects)
        leaking = None
        if decided.get("leakage") == "on" and "leakage" in sizes:
            leaking = {effect.name: effect.stage in _MOVING for effect in effects}
        found = {name: tiles(change) for name, change in changes(sizes, points, leaking).items()}
        remain = {name: tiles(change) for name, change in remainders(sizes, points).items()}
    there = np.array([name in found for name in names])
    number = max((value.size for value in found.values()), default=1)
    change = np.array([found.get(name, np.zeros(number)) for name in names])
    kept = _kept(change, there, effects, decided, tolerance)
    error, left = np.where(kept, 0.0, change).sum(axis=0), np.zeros(number)
    for name, value in remain.items():
        left = left + np.where(kept[names.index(name)], value, 0.0)
    choice = there & np.array([name not in decided for name in names])
    return Plan(names, kept, change, error + left, left, kept[choice].all(axis=0))


def sizes_of(points: Points, effects: Sequence[Effect] = EFFECTS) -> dict[str, Size]:
    """Sizes of the effects that some points have, by name."""
    smears = ((effect.name, effect.smear(points)) for effect in effects if effect.smear)
    points.smears = {name: smear for name, smear in smears if smear is not None}
    sizes = ((effect.name, effect.size(points)) for effect in effects)
    return {name: size for name, size in sizes if size is not None}


def _decided(effects: Sequence[Effect], modes: Mapping[str, str]) -> dict[str, str]:
    """Effects that are on or off whatever their sizes, and what these take with them."""
    decided = {name: mode for name, mode in modes.items() if mode != "auto"}
    for name, parent in _within(effects):
        if decided.get(parent) == "off":
            if decided.get(name) == "on":
                raise ValueError(f"{name} cannot be on within {parent}, which is off")
            decided[name] = "off"
    for name, parent in reversed(_within(effects)):
        if decided.get(name) == "on":
            decided[parent] = "on"
    return decided


def _within(effects: Sequence[Effect]) -> list[tuple[str, str]]:
    """Effects that are part of others, and these, which stand before them in the list."""
    names = {effect.name for effect in effects}
    return [(effect.name, effect.within) for effect in effects if effect.within in names]


def _kept(
    change: np.ndarray,
    there: np.ndarray,
    effects: Sequence[Effect],
    decided: Mapping[str, str],
    tolerance: float,
) -> np.ndarray:
    """Effects to keep, (effects, tiles) bool, of those that the scene has anything of, `there`.

    The smallest are left out first, as long as their sum is within what the tolerance leaves; an
    effect never before those within it, last ones first where they are alike. Those that cost
    nothing, as a number added to the noise does, are never left out.
    """
    place = {effect.name: row for row, effect in enumerate(effects)}
    mode = np.array([decided.get(name, "") for name in place])
    free = np.array([effect.stage == "noise" for effect in effects])
    room = np.maximum(tolerance - change[mode == "off"].sum(axis=0), 0.0)
    choice = there & (mode == "")
    key = change.copy()
    for name, within in reversed(_within(effects)):
        child, parent = place[name], place[within]
        if choice[child]:
            key[parent] = np.maximum(key[parent], key[child])
    backwards = np.flatnonzero(choice)[::-1]
    order = backwards[np.argsort(key[backwards], axis=0, kind="stable")]
    cost = np.where(free[:, None], 0.0, change)
    total = np.cumsum(np.take_along_axis(cost, order, axis=0), axis=0)
    kept = np.zeros(change.shape, np.bool_)
    np.put_along_axis(kept, order, ~(total <= room), axis=0)
    kept[choice & free] = True
    kept[mode == "on"] = there[mode == "on", None]
    for row, effect in enumerate(effects):
        for need in effect.needs:
            if need in place and decided.get(need) != "off":
                kept[place[need]] |= kept[row] & there[place[need]]
    return kept


def changes(
    sizes: Mapping[str, Size], points: Points, leaking: Mapping[str, bool] | None = None
) -> dict[str, np.ndarray]:
    """Change of pd, log10 pfa or |X| by each effect, whichever is most, 0..1, over the points.

    Of pd it is the sum of the changes in all segments, which bounds that of their product. If
    leakage is asked for, `leaking` tells of each effect whether it moves light from bins to others.
    Bins that leak are then taken to be off by as many sigmas as the largest; that counts up to the
    leakage's own size.
    """
    low, high = plausible(sizes, points)
    threshold = points.threshold
    if points.largest_noise is not None:  # which an echo has to exceed as well
        threshold = np.maximum(threshold, np.minimum(high, points.largest_noise))
    b = points.looks.scaled(threshold)
    steepest = 0.5 * (b + np.sqrt(b * b + 2))
    at = np.minimum(np.maximum(steepest, low), high)
    near = np.exp(-0.5 * (at - b) ** 2)
    b = points.looks.sharper * threshold
    slope, small = np.sqrt(at * b / (2 * math.pi)) * near, np.minimum(high, 1.0)
    found = {}
    for name, size in sizes.items():
        total, most = 0.0, np.maximum(size.shift, size.alarms)
        if _is_there(size.magnitude):
            share = np.minimum(size.magnitude, _HUGE)
            total, most = total + share * slope, np.maximum(most, share * small)
        if _is_there(size.added):
            more = size.added * high
            total = total + 0.5 * near * more
            most = np.maximum(most, more / np.maximum(low, 1.0))
        if _is_there(size.noise):
            louder = np.abs(size.noise)
            total = total + 0.5 * louder * slope
            most = np.maximum(most, 0.5 * louder * small)
            if not size.threshold_follows:
                total = total + 0.5 * louder * b * b * near / np.sqrt(1 + 2 * at * b)
                most = np.maximum(most, b * b * louder / _LN_10)
        if leaking and leaking[name]:
            moved = (np.minimum(size.magnitude, _HUGE) + size.added) * high + size.beside
            most = np.maximum(most, np.minimum(moved, sizes["leakage"].chance))
        change = np.maximum(_sum(total, points), _most(most, points))
        found[name] = np.fmin(np.maximum(change, size.chance), 1.0)
    return found


def remainders(sizes: Mapping[str, Size], points: Points) -> dict[str, np.ndarray]:
    """Change of pd or |X| that each effect leaves where it is simulated, as of :func:`changes`."""
    left = {name: size.left for name, size in sizes.items() if _is_there(size.left)}
    if not left:
        return {}
    low, high = plausible(sizes, points)
    b = points.looks.scaled(points.threshold)
    at = np.minimum(np.maximum(0.5 * (b + np.sqrt(b * b + 2)), low), high)
    steep = np.sqrt(at * points.looks.sharper * points.threshold / (2 * math.pi))
    near = np.exp(-0.5 * (at - b) ** 2)
    found = {}
    for name, share in left.items():
        # of itself, and of the magnitude that all lines make together in a whole record
        more = sizes[name].left_of_all * points.level * points.looks.sharper
        total = np.minimum(share * steep, 0.5 * more) * near
        most = np.minimum(share * np.minimum(high, 1.0), more / np.maximum(low, 1.0))
        found[name] = np.minimum(np.maximum(_sum(total, points), _most(most, points)), 1.0)
    return found


def plausible(sizes: Mapping[str, Size], points: Points) -> tuple[np.ndarray, np.ndarray]:
    """Least and largest magnitude of the largest bin over sigma that all effects may leave."""
    low = high = points.amplitude * points.looks.sharper
    added: np.ndarray | float = 0.0
    for size in sizes.values():
        if _is_there(size.magnitude):
            share = np.minimum(size.magnitude, _HUGE)
            low, high = low * np.maximum(1 - share, 0.0), high * (1 + share)
        if _is_there(size.noise):
            factor = np.sqrt(1 + np.maximum(size.noise, -1 + 1e-9))
            low, high = low / np.maximum(factor, 1.0), high / np.minimum(factor, 1.0)
        added = added + size.added
    high = np.minimum(high, _HUGE)
    return np.maximum(low - high * added, 0.0), high * (1 + added)


def _is_there(value: np.ndarray | float) -> bool:
    return isinstance(value, np.ndarray) or value != 0.0


def _sum(value: np.ndarray | float, points: Points) -> np.ndarray | float:
    """Over the segments."""
    if np.ndim(value) <= points.ndim:
        return value * (len(points.signs) if np.ndim(value) else 1)
    return np.asarray(value).sum(axis=0)


def _most(value: np.ndarray | float, points: Points) -> np.ndarray | float:
    """In any segment."""
    return np.asarray(value).max(axis=0) if np.ndim(value) > points.ndim else value
