"""Points of an older store that a larger study has too: taken from there, bit for bit.

What a point comes to follows from its parameters, its draws and the effects that are simulated,
and from nothing else. Effects are planned tile by tile, and a larger grid has other tiles: a point
whose effects are not those of the older store is computed anew.
"""

from __future__ import annotations

from contextlib import suppress
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from sweep.model.resolution import by_tolerance
from sweep.spec import Spec
from sweep.spec.grid_rules import is_method
from sweep.storage import opening
from sweep.storage.locations import Location
from sweep.tasks import identity
from sweep.tasks.calling import EFFECTS, ERROR, TOLERANCE, Called
from sweep.tasks.errors import StoreError
from sweep.tasks.evaluate import no_sums
from sweep.tasks.grid_study import GridStudy
from sweep.tasks.matching import Matching
from sweep.tasks.older_blocks import DAMAGED, OlderBlocks
from sweep.tasks.study import Found, Known, Results, together

if TYPE_CHECKING:
    from sweep.spec import SceneSpec


class Share(NamedTuple):
    """Points of a block that an older block has."""

    block: int
    """Of the older store."""
    points: np.ndarray
    """(m,) int64: their numbers in the block."""
    place: np.ndarray
    """(m,) int64: their numbers in the older one."""


class OlderStore:
    """What a store knows of a larger study.

    Parameters
    ----------
    path, older
        The store, and the study in it.
    study
        The larger one.
    """

    def __init__(self, path: Location, older: GridStudy, study: GridStudy) -> None:
        self._older, self._study = older, study
        self._blocks = OlderBlocks(path, older)
        self.taken: dict[int, int] = {}
        self._is_whole = are_alike(older.spec, study.spec)
        self._is_begun = not self._is_whole and goes_on(older.spec, study.spec)

    @cached_property
    def _matching(self) -> Matching:
        older, study = self._older, self._study
        return Matching(older.grid, study.grid, ignored(older.spec, study.spec))

    def known(self, block: int, called: Called) -> Known:
        """What is there of a block of the larger study."""
        found: list[Found] = []
        for share in self._shares(block):
            if (older := self._read(share.block)) is None:
                continue
            same = older[EFFECTS][share.place] == called.flags[share.points]
            results = {name: values[share.place[same]] for name, values in older.items()}
            found.append(Found(share.points[same], results))
        together = self._together(found)
        self.taken[block] = together.points.size if self._is_whole else 0
        return Known(done=together) if self._is_whole else Known(begun=together)

    def _together(self, found: list[Found]) -> Found:
        """Outputs found in several blocks, as the larger study has them."""
        points, results = together(found)
        outputs = {name: v for name, v in results.items() if name not in (EFFECTS, ERROR)}
        return Found(points, no_sums(self._study.spec, points.size) | outputs)

    def count(self, block: int) -> int:
        """Points of a block of which `known` would tell, if nothing is damaged."""
        called, number = self._study.calling.of_block(block), 0
        for share in self._shares(block):
            with suppress(*DAMAGED):
                flags = self._blocks.chunk(EFFECTS, share.block).ravel()
                number += int(np.sum(flags[share.place] == called.flags[share.points]))
        return number

    def remark(self) -> str:
        """What is not simply taken from it, in words; empty where all of it is."""
        if not (self._is_whole or self._is_begun):
            return "whole spectra are drawn anew"
        said = ["points that are there are drawn further"] if self._is_begun else []
        if self._other_tolerance:
            said.append(
                "with the tolerance all is computed more closely, and anew, but where "
                "footprint.beamlets, accuracy.line_error and accuracy.leakage_error are numbers"
            )
        return "; ".join(said)

    def _shares(self, block: int) -> list[Share]:
        """The committed older blocks that have points of a block."""
        if not (self._is_whole or self._is_begun):
            return []
        grid = self._older.grid
        numbers = self._matching.of(self._study.grid.block(block))
        points = np.flatnonzero((numbers >= 0) & self._same_resolution(block))
        at = np.unravel_index(numbers[points], grid.shape) if grid.shape else ()
        blocks, place = np.zeros((2, points.size), np.int64)
        for k, index in enumerate(at):
            chunk = grid.block_shape[k]
            start = index // chunk * chunk
            blocks = blocks * grid.blocks_along[k] + index // chunk
            place = place * np.minimum(chunk, grid.shape[k] - start) + index - start
        return [
            Share(int(b), points[blocks == b], place[blocks == b])
            for b in np.unique(blocks)
            if self._blocks.has(int(b))
        ]

    @cached_property
    def _other_tolerance(self) -> bool:
        return other_tolerance(self._older.spec, self._study.spec)

    def _same_resolution(self, block: int) -> np.ndarray | bool:
        """Which points of a block are computed as finely here as there, (points,)."""
        if not self._other_tolerance:
            return True
        return ~by_tolerance(self._study.grid.parameters(block))

    def _read(self, block: int) -> Results | None:
        """Results of an older block, (points, ...) each; None where it is damaged or lost."""
        size, rank = self._older.block_size(block), len(self._older.grid.shape)
        found = self._blocks.read(block)
        return found and {n: v.reshape(size, *v.shape[rank:]) for n, v in found.items()}


def older_store(path: Location, study: GridStudy) -> OlderStore | None:
    """What the store at a path knows of a study; None where it is gone, or knows nothing."""
    try:
        attributes = opening.read_attributes(path)
        identity.refuse_other_versions(path, attributes, where="this machine")
        held = identity.read_spec(path, attributes.get("spec", "{}"))
    except StoreError:
        return None
    if not isinstance(held, Spec) or held.seed != study.spec.seed:
        return None
    return OlderStore(path, GridStudy(held), study)


def ignored(older: Spec | SceneSpec, spec: Spec | SceneSpec) -> tuple[str, ...]:
    """Parameters in which points may differ that are to be taken for the same.

    The tolerance, where neither study varies it, and what looks at spectra where none are drawn.
    """
    looks = isinstance(spec, Spec) and spec.draws.whole_spectra
    ours = [path for path in spec.parameters() if is_method(path) and not looks]
    fixed = _tolerance(older) is not None and _tolerance(spec) is not None
    return (*ours, TOLERANCE) if fixed else tuple(ours)


def other_tolerance(older: Spec | SceneSpec, spec: Spec | SceneSpec) -> bool:
    """Whether all points have another tolerance; one on an axis tells points apart."""
    theirs, ours = _tolerance(older), _tolerance(spec)
    return theirs is not None and ours is not None and theirs != ours


def are_alike(older: Spec, spec: Spec) -> bool:
    """Whether points of two studies that are computed as finely have the same results."""
    if not spec.draws.any:
        return not older.draws.any
    return older.draws == spec.draws and _tolerance(older) == _tolerance(spec)


def goes_on(older: Spec, spec: Spec) -> bool:
    """Whether draws of a study are the first ones of another.

    Not of whole spectra: there what a user's own function sees depends on how draws are cut.
    """
    amount = {"number": spec.draws.number, "limit": spec.draws.limit}
    loosened = (_tolerance(older) or 1.0) < (_tolerance(spec) or 0.0)
    return (
        spec.draws.any
        and not spec.draws.whole_spectra
        and older.draws.adaptive == spec.draws.adaptive
        and older.draws.model_copy(update=amount) == spec.draws
        and older.draws.number <= spec.draws.number
        and older.draws.limit <= spec.draws.limit
        and not loosened
    )


def _tolerance(spec: Spec | SceneSpec) -> float | None:
    """The tolerance of all points; None where an axis varies it."""
    value = spec.parameters_off_axes().get(TOLERANCE)
    return None if value is None else float(value)
