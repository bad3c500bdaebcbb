"""The study in a store, of whatever kind; results of an older one that a larger one has too.

Those are taken from there, bit for bit. A result follows from the parameters at its point, its
draws and the effects that are simulated. Points are looked up axis by axis. The older store is only
read; a block of it that does not match the digest in its receipt counts as absent.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping
from functools import cache, cached_property, lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sweep.messages import NEW, SPEC, command_line, suggestion
from sweep.scenes.files import SceneError
from sweep.spec import SceneSpec, Spec, SpecError, difference, from_stored
from sweep.spec.grid_rules import is_method
from sweep.spec.rules import Mistake
from sweep.spec.sections import parameter_rules
from sweep.storage import opening
from sweep.storage.locations import Location, located, real
from sweep.storage.sound import open_arrays
from sweep.tasks import store
from sweep.tasks.eyepoint_study import EyepointStudy
from sweep.tasks.flight_study import FlightStudy
from sweep.tasks.grid_study import GridStudy, canonical_rows
from sweep.tasks.journal import EXTENDS, committed, digests, read_recipe
from sweep.tasks.progress import StoreError
from sweep.tasks.study import DAMAGED, TOLERANCE, Lattice, Results, Value

Declared = Spec | SceneSpec

ACCURACY = "accuracy"
"""Kind of the stores of `sweep accuracy`, in which there is no study."""

Growing = GridStudy | FlightStudy
AnyStudy = Growing | EyepointStudy


def study_of(spec: Spec | SceneSpec, path: Location, extends: Location | None = None) -> Growing:
    """Return the study that a spec declares, to be stored at a path; it may extend another."""
    study = FlightStudy(spec, path) if isinstance(spec, SceneSpec) else GridStudy(spec)
    if extends:
        study.look_up = partial(_reuse, extends, study)
    return study


def _reuse(path: Location, study: Growing) -> Reuse | None:
    """Results that the store at a path has of a study; None where it is gone, or has none."""
    try:
        attributes = opening.read_attributes(path)
        store.refuse_other_versions(path, attributes, where="this machine")
        spec = _spec(path, read_recipe(path), attributes.get("spec", "{}"))
        if type(spec) is not type(study.spec) or spec.seed != study.spec.seed:
            return None
        if isinstance(study, FlightStudy) and unlike(spec, study.spec):
            return None  # a grid's points are told apart by their parameters
        return Reuse(path, study_of(spec, path), study)
    except (StoreError, SceneError):
        return None


def read(path: Location) -> tuple[dict[str, Any], AnyStudy]:
    """Attributes of a store and the study that it holds; StoreError where it can't be read."""
    attributes = opening.read_attributes(path)
    if attributes["kind"] == ACCURACY:
        draw = command_line("figures", path)
        raise StoreError(f"{path} holds what accuracy costs, no study: `{draw}` draws it")
    return attributes, described(path, attributes)


def described(path: Location, attributes: dict[str, Any]) -> AnyStudy:
    """Read the study of a store from its attributes; StoreError if it can't be read."""
    recipe = read_recipe(path)
    if attributes["kind"] == "eyepoints":
        if "spec" not in recipe:
            raise StoreError(
                f"{path} does not say how its eyepoints were made: run their study again"
            )
        return EyepointStudy(_spec(path, recipe, recipe["spec"]), recipe["scanner"])
    spec = _spec(path, recipe, attributes["spec"])
    extends = located(recipe[EXTENDS]) if EXTENDS in recipe else None
    return study_of(spec, path, extends if extends != real(path) else None)


def _spec(path: Location, recipe: dict[str, Any], text: str) -> Any:
    """Read the spec of a store; StoreError if this program can't read it."""
    try:
        return from_stored(text, base=Path(recipe["base"]) if "base" in recipe else None)
    except (SpecError, ValueError) as error:
        raise StoreError(
            f"{path} holds a spec that this version of sweep can't read:\n{error}"
        ) from error


#: Fields that may grow, and one that may shrink; blocks may be of any size.
GROWING = ("draws.number", "draws.limit")
SHRINKING = (TOLERANCE,)
FREE = ("storage.block_points", "storage.block_shots", "storage.block_draws")

#: Values of an axis that are told where they would be lost.
MOST_TOLD = 5

#: Blocks of the older store that a process keeps in memory.
BLOCKS_KEPT = 2


class Share(NamedTuple):
    """Points of a block that an older block has."""

    block: int  # Of the older store
    points: np.ndarray  # (m,) int64: their numbers in C order over the block
    place: np.ndarray  # (m,) int64: their numbers in the older one


class Reuse:
    """Results that the store of an older study has of a larger one."""

    def __init__(self, path: Location, older: Growing, study: Growing) -> None:
        self._path, self.older, self._study = path, older, study
        self.taken: dict[int, int] = {}  # points of each block that need not be computed
        self.is_whole = are_alike(older.spec, study.spec)
        self.is_begun = not self.is_whole and goes_on(older.spec, study.spec)
        self._other_tolerance = other_tolerance(older.spec, study.spec)
        self._digests = digests(path, older.n_blocks)
        self.read = lru_cache(maxsize=BLOCKS_KEPT)(self._read)
        self._matching = cache(self._match)

    def shares(self, block: int) -> Iterator[Share]:
        """Return the committed older blocks that have points of a block of the larger study."""
        ours, number = self._study.find(block)
        older = {grid.group: grid for grid in self.older.grids}
        if not (self.is_whole or self.is_begun) or ours.group not in older:
            return
        theirs, first = older[ours.group], self.older.first_block(ours.group)
        numbers = self._matching(ours.group).of(ours.block(number))
        there = numbers >= 0
        if self._other_tolerance:
            there = there & ~np.asarray(self._study.follows_tolerance(block))
        points = np.flatnonzero(there)
        blocks, place = theirs.locate(numbers[points])
        for found in np.unique(blocks).tolist():
            if self._digests[first + found] and self._digests[self.older.home(first + found)]:
                own = blocks == found
                yield Share(first + found, points[own], place[own])

    def _match(self, group: str) -> Matching:
        theirs, ours = (
            next(grid for grid in study.grids if grid.group == group)
            for study in (self.older, self._study)
        )
        return Matching(theirs, ours, ignored(self.older.spec, self._study.spec))

    def _read(self, block: int) -> Results | None:
        """Results of an older block, each with its chunk's shape; None where damaged or lost."""
        try:
            objects = store.block_objects(self.older, block)
            digest = opening.digest(self._path, objects, store.chunk_bytes_max(self.older))
            if digest.encode() != self._digests[block]:
                return None
            return {name: self.chunk(name, block) for name in self.older.chunks(block)}
        except DAMAGED:
            return None

    def chunk(self, name: str, block: int) -> np.ndarray:
        """Return an older block's chunk of an array, whether damaged or not."""
        return np.asarray(self._arrays[name].blocks[self.older.chunks(block)[name]])

    @cached_property
    def _arrays(self) -> Any:
        return open_arrays(self._path)

    def remark(self) -> str:
        """Remark on what is not simply taken from it; empty where all of it is."""
        if not (self.is_whole or self.is_begun):
            return "whole spectra are drawn anew"
        said = ["points that are there are drawn further"] if self.is_begun else []
        spec = self._study.spec
        closer = self._other_tolerance and np.any(self._study.follows_tolerance(0))
        if self._other_tolerance and isinstance(spec, SceneSpec) and not closer:
            said.append("shots that call for more effects with the tolerance are computed anew")
        elif self._other_tolerance:
            rays = "footprint.beamlets, " if getattr(spec, "rays_by_tolerance", True) else ""
            said.append(
                "with the tolerance all is computed more closely, and anew, but where "
                f"{rays}accuracy.line_error and accuracy.leakage_error are numbers"
            )
        return "; ".join(said)


def what_is_there(path: Location, study: Growing) -> str:
    """Count the points of a larger study that are done, here or in the store it extends."""
    done = committed(path, study)
    there, remark = study.points_in(done), ""
    if study.earlier is not None:
        there += sum(study.there(int(block)) for block in np.flatnonzero(~done))
        remark = study.earlier.remark()
    told = f"{there:,} of {study.points:,} {study.unit} are there; "
    told += f"{study.points - there:,} to compute"
    return f"{told} ({remark})" if remark else told


def ignored(older: Declared, spec: Declared) -> tuple[str, ...]:
    """Parameters in which points may differ that are to be taken for the same.

    The tolerance, where neither study varies it, and what looks at spectra where none are
    drawn.
    """
    looks = spec.draws.whole_spectra
    ours = [path for path in spec.parameters() if is_method(path) and not looks]
    fixed = _tolerance(older) is not None and _tolerance(spec) is not None
    return (*ours, TOLERANCE) if fixed else tuple(ours)


def other_tolerance(older: Declared, spec: Declared) -> bool:
    """Tell whether all points have another tolerance; one on an axis identifies points."""
    theirs, ours = _tolerance(older), _tolerance(spec)
    return theirs is not None and ours is not None and theirs != ours


def are_alike(older: Declared, spec: Declared) -> bool:
    """Tell whether points of two studies that are computed as finely have the same results."""
    if isinstance(spec, SceneSpec) or isinstance(older, SceneSpec):
        return True
    if not spec.draws.any:
        return not older.draws.any
    return older.draws == spec.draws and _tolerance(older) == _tolerance(spec)


def goes_on(older: Spec, spec: Spec) -> bool:
    """Tell whether the draws of a study, not of whole spectra, are the first ones of another."""
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


def _tolerance(spec: Declared) -> float | None:
    """Return the tolerance of all points; None where an axis varies it."""
    value = spec.parameters_off_axes().get(TOLERANCE)
    return None if value is None else float(value)


def changed(spec: Declared, changes: Mapping[str, Any]) -> Declared:
    """Set values of a study by dotted path: ``{"axes.target.range": ["1 km"]}``; or SpecError."""
    written = spec.to_yaml_mapping()
    for path, value in changes.items():
        first, _, rest = path.partition(".")
        if first == "axes" and rest:
            written[first] = {**written.get(first, {}), rest: value}
            continue
        *sections, last = path.split(".")
        section: Any = written
        for name in sections:
            section = section.setdefault(name, {}) if isinstance(section, dict) else None
        if not isinstance(section, dict):
            parent = ".".join(sections)
            raise SpecError([Mistake(path, f"is no field: {parent} holds none", str(value))])
        section[last] = value
    base = spec.base if isinstance(spec, SceneSpec) else "."
    return type(spec).from_mapping(written, base=base)


def refuse_unlike(path: Location, older: Declared, spec: Declared) -> None:
    """Refuse what is not a larger study than the one in a store, field by field."""
    if type(older) is not type(spec):
        raise StoreError(
            f"{path} can't be extended to this study: a flight over a scene and a study over a "
            "grid have nothing in common. Run it into a store of its own: "
            f"{suggestion('run', SPEC, store=NEW)}"
        )
    lines = unlike(older, spec)
    if lines:
        listed = "\n".join(f"  {line}" for line in lines)
        scanners = " new scanners," if _scanners(spec) else ""
        raise StoreError(
            f"{path} can't be extended to this study (in the store -> asked for):\n{listed}\n"
            f"A store is extended by values on axes, new axes,{scanners} more draws or a tighter "
            "accuracy.tolerance. Any other study needs a store of its own: "
            f"{suggestion('run', SPEC, store=NEW)}"
        )


def unlike(older: Declared, spec: Declared) -> list[str]:
    """Reasons why a study is no larger one than another of its kind, field by field."""
    return [*_altered(older, spec), *_lost(older, spec)]


def _altered(older: Declared, spec: Declared) -> Iterator[str]:
    """Fields that are not as they must be."""
    on_axes = {
        member.path for each in (older, spec) for axis in each.axes for member in axis.members
    }
    for line in difference(older, spec):
        path = line.partition(": ")[0]
        section, _, rest = path.partition(".")
        if path in on_axes or path in FREE or section == "axes":
            continue
        if section == "scanners" and rest.partition(".")[0] not in _scanners(older):
            continue
        growth = _value(spec, path) - _value(older, path) if path in GROWING + SHRINKING else 0
        if path in GROWING and not growth > 0 < _value(older, path):
            yield f"{line}, and may only grow"
        elif path in SHRINKING and not growth < 0:
            yield f"{line}, and may only become tighter"
        elif path not in GROWING + SHRINKING:
            yield f"{line}, and must stay as it is"


def _scanners(spec: Declared) -> Collection[str]:
    """Names of a flight's scanners; a study over a grid has none."""
    return getattr(spec, "scanners", ())


def _value(spec: Declared, path: str) -> float:
    section, _, name = path.partition(".")
    return float(getattr(getattr(spec, section), name))


def _lost(older: Declared, spec: Declared) -> Iterator[str]:
    """Values of the store that the study lacks."""
    had, grid = Lattice(older), Lattice(spec)
    varying = {path for each in (had, grid) for values in each.values for path in values}
    for places in Matching(grid, had, ignored(older, spec)).places:
        if (places.where >= 0).all() or varying.isdisjoint(places.paths):
            continue
        at = np.argwhere(places.where < 0).T
        told = ", ".join(_told(had, path, at) for path in places.paths)
        yield f"{told}: lost, and must stay among the values"


def _told(grid: Lattice, path: str, at: np.ndarray) -> str:
    """Values of a parameter at places of a grid, (axes, places)."""
    values: list[object] = [grid.fixed[path]]
    for own, index in zip(grid.values, at, strict=True):
        if path in own:
            values = own[path][np.unique(index)].tolist()
    shown = [f"{value:g}" if isinstance(value, float) else str(value) for value in values]
    more = ["..."] if len(shown) > MOST_TOLD else []
    units = parameter_rules()[path].units
    return f"{path}: {', '.join(shown[:MOST_TOLD] + more)}{f' {units}' if units else ''}"


class Places(NamedTuple):
    """Places of the values of some parameters of one study along an axis of another."""

    paths: tuple[str, ...]
    axis: int | None  # axis that is looked in; None for parameters that are fixed there
    where: np.ndarray
    """int64, of the shape that is looked from, but 1 along axes without any of these parameters:
    index along the axis, -1 where it lacks the values."""


class Matching:
    """Points along the axes of one study by the points of another.

    Axes may be longer, in another order, new, or zipped otherwise; paths that are ``ignored``
    may differ.
    """

    def __init__(self, other: Lattice, grid: Lattice, ignored: Collection[str] = ()) -> None:
        self._other = other
        self.places = [
            _places(grid, axis, {path: v for path, v in values.items() if path not in ignored})
            for axis, values in _parts(other, grid)
        ]

    def of(self, slices: tuple[slice, ...]) -> np.ndarray:
        """Numbers, in C order over the other axes, of points in slices of its own; -1 for none."""
        numbers = np.zeros((1,) * len(slices), np.int64)
        lacking = np.zeros((1,) * len(slices), bool)
        for places in self.places:
            varies = [size > 1 for size in places.where.shape]
            part = (s if v else slice(None) for s, v in zip(slices, varies, strict=True))
            index = places.where[tuple(part)]
            lacking = lacking | (index < 0)
            if places.axis is not None:
                numbers = numbers + index * math.prod(self._other.shape[places.axis + 1 :])
        numbers = np.where(lacking, -1, numbers)
        return np.broadcast_to(numbers, [s.stop - s.start for s in slices]).ravel()


def _parts(other: Lattice, grid: Lattice) -> Iterator[tuple[int | None, dict[str, np.ndarray]]]:
    """Parameters that are looked up together: those of each axis, and all that are fixed."""
    yield from enumerate(other.values_along())
    on_axes = {path for values in other.values_along() for path in values}
    fixed = {path: np.array([v]) for path, v in other.fixed.items() if path not in on_axes}
    for values in grid.values_along():
        yield None, {path: fixed.pop(path) for path in values if path in fixed}
    yield None, fixed


def _places(grid: Lattice, axis: int | None, values: dict[str, np.ndarray]) -> Places:
    """Places of a grid's values among others of the same parameters, which go together."""
    along = [k for k, own in enumerate(grid.values_along()) if not own.keys().isdisjoint(values)]
    shape = tuple(size if k in along else 1 for k, size in enumerate(grid.shape))
    index = [i.ravel() for i in np.indices([grid.shape[k] for k in along])]
    of_dimensions = grid.values_along()
    wanted: dict[str, Value] = {path: grid.fixed[path] for path in values if path in grid.fixed}
    for k, i in zip(along, index, strict=True):
        wanted |= {path: a[i] for path, a in of_dimensions[k].items() if path in values}
    number = len(next(iter(values.values()))) if values else 1
    rows = canonical_rows(values, number)
    found = _looked_up(rows, canonical_rows(wanted, math.prod(shape)))
    return Places(tuple(values), axis, found.reshape(shape))


def _looked_up(rows: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Index of each wanted row, (m,), among rows (n, columns); -1 of those that are not there."""
    if not rows.shape[1]:
        return np.zeros(len(wanted), np.int64)
    both = np.concatenate([rows, wanted]).view(np.uint64)
    codes = np.unique(both, axis=0, return_inverse=True)[1].ravel()
    place = np.full(len(both), -1)
    place[codes[: len(rows)]] = np.arange(len(rows))
    return place[codes[len(rows) :]]
