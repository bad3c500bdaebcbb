"""What is wrong with a scene study beyond its single fields: names, references, files, flights."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

import sweep.spec.quantities as of
from sweep.spec.files import Files, named_files
from sweep.spec.flight_check import flight_findings
from sweep.spec.grounds import Ground
from sweep.spec.mistakes import ABSENT, Finding, Location, near_miss
from sweep.spec.motion import Platform
from sweep.spec.object_check import object_findings
from sweep.spec.objects import AnyObject
from sweep.spec.scanners import AnyScanner
from sweep.spec.scene_sections import WORLD
from sweep.units import QuantityError

RESERVED = ("map_height", "map_x", "map_y")
"""Names that arrays of a store have beside its scanners."""

OBJECTS: Location = ("scene", "objects")


@dataclass(frozen=True)
class Parts:
    """Parts of a scene study, as far as they can be read."""

    objects: dict[str, Any] = field(default_factory=dict)
    scanners: dict[str, Any] = field(default_factory=dict)
    platform: Platform | None = None

    @classmethod
    def of(cls, written: Mapping[str, Any]) -> Parts:
        """Parts of a spec as written; those that cannot be read are passed over."""
        platform: Platform | None = None
        with suppress(ValidationError):
            platform = Platform.model_validate(written.get("platform"))
        return cls(
            dict(_read(_section(written, *OBJECTS), _objects())),
            dict(_read(_section(written, "scanners"), _scanners())),
            platform,
        )


@cache
def _objects() -> TypeAdapter[Any]:
    return TypeAdapter(AnyObject)


@cache
def _scanners() -> TypeAdapter[Any]:
    return TypeAdapter(AnyScanner)


def _section(written: Mapping[str, Any], *path: str | int) -> dict[str, Any]:
    """A mapping in a spec; empty where there is none."""
    found: Any = written
    for name in path:
        found = found.get(name) if isinstance(found, Mapping) else None
    return dict(found) if isinstance(found, Mapping) else {}


def _read(section: Mapping[str, Any], adapter: TypeAdapter[Any]) -> Iterator[tuple[str, Any]]:
    for name, value in section.items():
        with suppress(ValidationError):
            yield name, adapter.validate_python(value)


def scene_findings(written: Mapping[str, Any], base: Path | None) -> list[Finding]:
    """What is wrong with scene, platform and scanners beyond their single fields.

    Parameters
    ----------
    written : mapping
        The spec as written; what cannot be read is passed over.
    base : Path or None
        Folder that files are relative to; None leaves them alone.
    """
    parts = Parts.of(written)
    findings = [
        *_name_findings(written, OBJECTS, lambda name: name == WORLD, "scene"),
        *_name_findings(written, ("scanners",), lambda name: name in RESERVED, "store"),
        *_reference_findings(written, parts),
    ]
    for name, thing in parts.objects.items():
        findings += object_findings(thing, (*OBJECTS, name))
    files = [] if base is None else list(_file_findings(parts, base))
    flights = flight_findings(parts.platform, parts.scanners, parts.objects, base)
    known = {finding.location for finding in files}
    return findings + files + [f for f in flights if f.location not in known]


def _name_findings(
    written: Mapping[str, Any], section: Location, taken: Callable[[str], bool], by: str
) -> Iterator[Finding]:
    """Names of objects or scanners that can't be, and a section without any."""
    named = _section(written, *section)
    rule = of.name("Name")
    for name in named:
        try:
            rule.read(name)
        except QuantityError as error:
            yield Finding((*section, name), "is no name", error.suggestion, ABSENT)
        if taken(name):
            yield Finding((*section, name), f"is a name that the {by} has taken", "", ABSENT)
    if not named and isinstance(_parent(written, section), Mapping):
        yield Finding(section, "holds nothing", "name at least one", ABSENT)


def _parent(written: Mapping[str, Any], section: Location) -> object:
    """The section itself where it is written; None where pydantic tells that it is missing."""
    found: Any = written
    for name in section:
        found = found.get(name) if isinstance(found, Mapping) else None
    return found


def _reference_findings(written: Mapping[str, Any], parts: Parts) -> Iterator[Finding]:
    """References to objects that are not there, or no ground."""
    named = _section(written, *OBJECTS)
    if not named:
        return
    origin = _section(written, "scene").get("origin", WORLD)
    if isinstance(origin, str) and origin != WORLD:
        yield from _reference(origin, ("scene", "origin"), named, parts, "or 'world'")
        yield from _placed_origin(origin, parts)
    for name, thing in named.items():
        on = thing.get("on") if isinstance(thing, Mapping) else None
        if isinstance(on, str):
            yield from _reference(on, (*OBJECTS, name, "on"), named, parts, "")


def _reference(
    name: str, location: Location, named: Mapping[str, Any], parts: Parts, otherwise: str
) -> Iterator[Finding]:
    """One reference to a ground."""
    grounds = [key for key, thing in parts.objects.items() if isinstance(thing, Ground)]
    remedy = f"the grounds are {', '.join(grounds)}" if grounds else "add a ground"
    remedy += f", {otherwise}" if otherwise else ""
    if name not in named:
        rule = "is no object of the scene"
        yield Finding(location, rule, near_miss(name, named, otherwise=remedy), name)
    elif name in parts.objects and name not in grounds:
        yield Finding(location, "is no ground", remedy, name)


def _placed_origin(name: str, parts: Parts) -> Iterator[Finding]:
    """A position of the object that all positions are relative to."""
    if any(getattr(parts.objects.get(name), "position", None) or ()):
        yield Finding(
            (*OBJECTS, name, "position"),
            "places the scene's origin, which lies at zero",
            "leave it out, or take another origin",
            ABSENT,
        )


def _file_findings(parts: Parts, base: Path) -> Iterator[Finding]:
    """Files that are missing or can not be read."""
    from sweep.scenes.files import SceneError

    things = [((*OBJECTS, name), thing) for name, thing in parts.objects.items()]
    if parts.platform is not None:
        things.append((("platform",), parts.platform))
    for location, thing in things:
        for key, rule, file in named_files(thing):
            try:
                rule.digest(Files(base).path(file))
            except SceneError as error:
                broken = f"names a file that {error.rule}"
                yield Finding((*location, *key), broken, error.remedy, file)
