"""Shots of an older store's flight that a larger study has too: taken from there, bit for bit.

What a shot comes to follows from the geometry, the parameters at its place along the axes, its
number, its draws and the effects that are simulated, and from nothing else. Effects are planned
for the same shots together whatever the blocks, so that only another tolerance changes them; a shot
whose effects are others is computed anew.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sweep.model.outputs import NAVIGATION, POINTS, STATISTICS
from sweep.model.resolution import by_tolerance
from sweep.scenes.files import SceneError
from sweep.spec import Spec
from sweep.storage import opening
from sweep.storage.locations import Location
from sweep.tasks import identity
from sweep.tasks.calling import EFFECTS, Called
from sweep.tasks.errors import StoreError
from sweep.tasks.extension import unlike
from sweep.tasks.flight_layout import is_radiometric
from sweep.tasks.flight_study import FlightStudy
from sweep.tasks.grid import Lattice
from sweep.tasks.matching import Matching
from sweep.tasks.older_blocks import OlderBlocks
from sweep.tasks.patches import KnownCloud, Patch
from sweep.tasks.recipe import read_recipe
from sweep.tasks.reuse import ignored, other_tolerance
from sweep.tasks.stretches import Part
from sweep.tasks.study import Results


class Overlap(NamedTuple):
    """What a stretch has in common with one of those that an older store was cut into."""

    number: int
    """Of the older stretch."""
    ours: slice
    """Counted from the first of the stretch."""
    theirs: slice
    """Counted from the first of the older one."""

    def times(self, each: int) -> Overlap:
        """The same of what there are so many of in each."""
        ours, theirs = (slice(s.start * each, s.stop * each) for s in self[1:])
        return Overlap(self.number, ours, theirs)


class Share(NamedTuple):
    """What a block has in common with an older block."""

    block: int
    """The older one."""
    first: int
    """The older block of the same shots with their first draws, and what no draw changes."""
    cycles: Overlap
    draws: Overlap


class OlderFlight:
    """What a store knows of a larger study.

    Parameters
    ----------
    path, older
        The store, and the study in it.
    study
        The larger one: nothing in it is other but what may grow.
    """

    def __init__(self, path: Location, older: FlightStudy, study: FlightStudy) -> None:
        self._older, self._study = older, study
        self._blocks = OlderBlocks(path, older)
        self.taken: dict[int, int] = {}
        self._lattice = Lattice(older.spec)

    @cached_property
    def _matching(self) -> Matching:
        older, study = self._older.spec, self._study.spec
        return Matching(self._lattice, Lattice(study), ignored(older, study))

    def known(self, block: int, called: Called) -> KnownCloud:
        """What is there of a block of the larger study."""
        stretches, _ = self._study.part(block)
        points, navigation = [], []
        for share in self._shares(block):
            first, older = self._read(share.first), self._read(share.block)
            if first is None or older is None:
                continue
            each, drawn = stretches.shots_a_cycle, share.draws.theirs
            shots = share.cycles.times(each)
            same = np.flatnonzero(first[EFFECTS][shots.theirs] == called.flags[shots.ours])
            there = shots.theirs.start + same
            results = {name: first[name][there] for name in STATISTICS}
            results |= {name: older[name][there, drawn] for name in POINTS}
            points.append(Patch(shots.ours.start + same, share.draws.ours, results))
            if stretches.navigates:
                whole = np.flatnonzero(np.bincount(same // each) == each)
                there = share.cycles.theirs.start + whole
                results = {name: older[name][there, drawn] for name in NAVIGATION}
                here = share.cycles.ours.start + whole
                navigation.append(Patch(here, share.draws.ours, results))
        self.taken[block] = sum(p.rows.size * (p.draws.stop - p.draws.start) for p in points)
        return KnownCloud(points, navigation)

    def count(self, block: int) -> int:
        """Shots of a block, times draws, that are there, if nothing is damaged.

        With another tolerance some of them may call for other effects.
        """
        stretches, _ = self._study.part(block)
        shares = self._shares(block)
        known = sum(_length(share.cycles) * _length(share.draws) for share in shares)
        return known * stretches.shots_a_cycle

    def remark(self) -> str:
        """What is not simply taken from it, in words; empty where all of it is."""
        if not self._other_tolerance:
            return ""
        if self._is_as_fine:
            return "shots that call for more effects with the tolerance are computed anew"
        rays = "footprint.beamlets, " if self._study.spec.rays_by_tolerance else ""
        return (
            "with the tolerance all is computed more closely, and anew, but where "
            f"{rays}accuracy.line_error and accuracy.leakage_error are numbers"
        )

    def _shares(self, block: int) -> Iterator[Share]:
        """The committed older blocks that have shots and draws of a block."""
        ours, part = self._study.part(block)
        axes = self._place(part)
        if axes is None:
            return
        theirs = self._older.scanners[part.scanner]
        draws = list(_overlaps(ours.draw_range(part), theirs.block_draws, theirs.draws))
        cycles = ours.cycle_range(part)
        for along in _overlaps(cycles, theirs.block_cycles, theirs.total_cycles):
            first = self._older.block(Part(part.scanner, axes, 0, along.number))
            if not self._blocks.has(first):
                continue
            for drawn in draws:
                older = self._older.block(Part(part.scanner, axes, drawn.number, along.number))
                if self._blocks.has(older):
                    yield Share(older, first, along, drawn)

    def _place(self, part: Part) -> tuple[int, ...] | None:
        """Where a block's place along the axes is in the older study; None where it is not."""
        if part.scanner not in self._older.scanners or not self._is_as_fine:
            return None
        number = int(self._matching.of(tuple(slice(i, i + 1) for i in part.axes))[0])
        if number < 0:
            return None
        return tuple(int(i) for i in np.unravel_index(number, self._lattice.shape))

    @property
    def _other_tolerance(self) -> bool:
        return other_tolerance(self._older.spec, self._study.spec)

    @cached_property
    def _is_as_fine(self) -> bool:
        """Whether shots are computed as finely there as here, effects apart."""
        spec = self._study.spec
        follows = spec.rays_by_tolerance or bool(by_tolerance(spec.parameters()))
        return not (self._other_tolerance and follows)

    def _read(self, block: int) -> Results | None:
        """Results of an older block by name, (shots or cycles, ...) each; None where damaged."""
        if (found := self._blocks.read(block)) is None:
            return None
        depth, results = len(self._lattice.shape), {}
        for name, values in found.items():
            own = name.rpartition("/")[2]
            if is_radiometric(own):
                results[own] = values.reshape(values.shape[depth:])
        return results


def older_flight(path: Location, study: FlightStudy) -> OlderFlight | None:
    """What the store at a path knows of a study; None where it is gone, or knows nothing."""
    try:
        attributes = opening.read_attributes(path)
        identity.refuse_other_versions(path, attributes, where="this machine")
        recipe = read_recipe(path)
        base = Path(recipe["base"]) if "base" in recipe else None
        held = identity.read_spec(path, attributes.get("spec", "{}"), base)
        if isinstance(held, Spec) or unlike(held, study.spec):
            return None
        return OlderFlight(path, FlightStudy(held, path), study)
    except (StoreError, SceneError):
        return None


def _overlaps(stretch: tuple[int, int], each: int, total: int) -> Iterator[Overlap]:
    """What a stretch, from its first to before its end, has of a whole cut into stretches."""
    begin, end = stretch[0], min(stretch[1], total)
    for first in range(begin // each * each, end, each):
        low, high = max(begin, first), min(end, first + each)
        ours, theirs = (slice(low - zero, high - zero) for zero in (begin, first))
        if low < high:
            yield Overlap(first // each, ours, theirs)


def _length(overlap: Overlap) -> int:
    return overlap.ours.stop - overlap.ours.start
