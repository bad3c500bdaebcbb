"""What is wrong with an object of a scene beyond its single fields."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from sweep.spec.grounds import Craters, Ground, Jacksboro
from sweep.spec.mistakes import ABSENT, Finding, Location
from sweep.spec.objects import Boulders, Box, MeshObject, Solid, Sphere, Trees
from sweep.units import QuantityError, read_unit


def object_findings(thing: Any, location: Location) -> list[Finding]:
    """What is wrong with an object at a location, its references and files apart."""
    findings: list[Finding] = []
    if isinstance(thing, Ground):
        findings += _ground_findings(thing, location)
    if isinstance(thing, Solid):
        findings += _solid_findings(thing, location)
    if isinstance(thing, Boulders):
        findings += _size_findings(thing, location)
    if isinstance(thing, Trees) and not thing.tree.crown_base < thing.tree.height:
        rule = f"must lie below the top, {thing.tree.height:g} m"
        base = f"{thing.tree.crown_base:g} m"
        findings.append(Finding((*location, "tree", "crown_base"), rule, "lower it", base))
    return findings


def refused(make: Callable[[], object], location: Location) -> Iterator[Finding]:
    """What the model says against a part that it is asked to make."""
    try:
        make()
    except (ValueError, ArithmeticError) as error:
        yield Finding(location, f"can not be made: {error}", "", ABSENT)


def _size_findings(thing: Boulders | Craters, location: Location) -> Iterator[Finding]:
    """Diameters without a range."""
    if not thing.smallest < thing.largest:
        rule = f"must exceed the smallest diameter, {thing.smallest:g} m"
        yield Finding((*location, "largest"), rule, "", f"{thing.largest:g} m")


def _ground_findings(ground: Ground, location: Location) -> Iterator[Finding]:
    """A grid that can not be, or that can not hold its craters."""
    section = "middle" if isinstance(ground, Jacksboro) else "spacing"
    unfit = list(refused(ground.check, (*location, section)))
    yield from unfit
    if ground.craters is None:
        return
    inside = (*location, "craters")
    yield from _size_findings(ground.craters, inside)
    step = None if unfit else ground.step()
    if step is not None and ground.craters.smallest < 3 * step:
        yield Finding(
            (*inside, "smallest"),
            f"must be three grid steps of {step:.3g} m or more",
            "raise it, or make the grid finer",
            f"{ground.craters.smallest:g} m",
        )


def _solid_findings(thing: Solid, location: Location) -> Iterator[Finding]:
    """A solid that is placed twice or nowhere, or whose lengths have no unit."""
    place = (*location, "position")
    if thing.motion is not None and thing.position is not None:
        rule = "stands beside a motion, whose path places the object"
        yield Finding(place, rule, "leave one of them out", ABSENT)
    if isinstance(thing, Sphere | Box) and thing.motion is None and thing.position is None:
        yield Finding(place, "is missing", "write e.g. 'position: [0 m, 0 m, 10 m]'", ABSENT)
    yield from refused(thing.rotation.turn, (*location, "rotation"))
    if isinstance(thing, MeshObject) and thing.unit is not None:
        try:
            read_unit(thing.unit, si_unit="m", example="mm")
        except QuantityError as error:
            yield Finding((*location, "unit"), error.rule, error.suggestion, thing.unit)
