"""What a larger study has in common with the one in a store, and whether it is one at all."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from sweep.spec import SpecError, difference
from sweep.spec.fields import parameter_rules
from sweep.spec.mistakes import Mistake
from sweep.storage.locations import Location
from sweep.tasks.errors import StoreError
from sweep.tasks.flight_study import FlightStudy
from sweep.tasks.grid import Lattice
from sweep.tasks.grid_study import GridStudy
from sweep.tasks.journal import committed
from sweep.tasks.matching import Matching
from sweep.tasks.reuse import ignored

if TYPE_CHECKING:
    from sweep.spec import SceneSpec, Spec

#: Fields that may grow, and one that may shrink; blocks may be of any size.
GROWING = ("draws.number", "draws.limit")
SHRINKING = ("accuracy.tolerance",)
FREE = ("storage.block_points", "storage.block_shots", "storage.block_draws")

#: Values of an axis that are told where they would be lost.
MOST_TOLD = 5


def changed(spec: Spec | SceneSpec, changes: Mapping[str, Any]) -> Spec | SceneSpec:
    """A study with some of its fields written anew.

    Parameters
    ----------
    spec
        The study.
    changes
        What stands at dotted paths, as in a file: ``{"axes.target.range": ["1 km", "2 km"]}``.

    Raises
    ------
    SpecError
        With every mistake in what comes out; where a path goes through a single value.
    """
    written = spec.to_yaml_mapping()
    for path, value in changes.items():
        first, _, rest = path.partition(".")
        if first == "axes":
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
    return type(spec).from_mapping(written, base=getattr(spec, "base", "."))


def refuse_unlike(path: Location, older: Spec | SceneSpec, spec: Spec | SceneSpec) -> None:
    """Refuse what is not a larger study than the one in a store.

    Raises
    ------
    StoreError
        With each field, its rule, its values, and what to do.
    """
    if type(older) is not type(spec):
        raise StoreError(
            f"{path} can't be extended to this study: a flight over a scene and a study over a "
            "grid have nothing in common. Run it into a store of its own: "
            "sweep run SPEC --store NEW"
        )
    lines = unlike(older, spec)
    if lines:
        listed = "\n".join(f"  {line}" for line in lines)
        scanners = " new scanners," if _scanners(spec) else ""
        raise StoreError(
            f"{path} can't be extended to this study (in the store -> asked for):\n{listed}\n"
            f"A store is extended by values on axes, new axes,{scanners} more draws or a tighter "
            "accuracy.tolerance. Any other study needs a store of its own: "
            "sweep run SPEC --store NEW"
        )


def unlike(older: Spec | SceneSpec, spec: Spec | SceneSpec) -> list[str]:
    """Why a study is no larger one than another of its kind, field by field; empty where it is."""
    return [*_altered(older, spec), *_lost(older, spec)]


def what_is_there(path: Location, study: GridStudy | FlightStudy) -> str:
    """How many points of a larger study there are, here and in the store that it extends."""
    done = committed(path, study)
    there, remark = study.points_in(done), ""
    if study.earlier is not None:
        there += sum(study.earlier.count(int(block)) for block in np.flatnonzero(~done))
        remark = study.earlier.remark()
    told = f"{there:,} of {study.points:,} {study.unit} are there; "
    told += f"{study.points - there:,} to compute"
    return f"{told} ({remark})" if remark else told


def _altered(older: Spec | SceneSpec, spec: Spec | SceneSpec) -> Iterator[str]:
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


def _scanners(spec: Spec | SceneSpec) -> Collection[str]:
    """Names of a flight's scanners; a study over a grid has none."""
    return getattr(spec, "scanners", ())


def _value(spec: Spec | SceneSpec, path: str) -> float:
    section, _, name = path.partition(".")
    return float(getattr(getattr(spec, section), name))


def _lost(older: Spec | SceneSpec, spec: Spec | SceneSpec) -> Iterator[str]:
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
