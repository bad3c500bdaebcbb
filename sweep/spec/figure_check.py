"""Figures held against their study: coordinates, stored quantities, scanners and draws."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import suppress
from functools import cache
from typing import Any

from pydantic import TypeAdapter, ValidationError

from sweep.model.outputs import (
    ACCURACY_OUTPUTS,
    DRAW_OUTPUTS,
    ERROR_OUTPUTS,
    OUTPUTS,
    SPECTRA_OUTPUTS,
)
from sweep.spec.axes import Axis
from sweep.spec.fields import parameter_rules
from sweep.spec.figures import Figure, NavigationFigure, NavigationTable, SceneFigure
from sweep.spec.mistakes import Finding, Location, near_miss
from sweep.spec.scanners import AnyScanner, shots_a_cycle
from sweep.spec.scene import SceneDraws
from sweep.spec.sections import SPECTRA
from sweep.units import QuantityError

LEAST_BEAMS = 3
"""Shots of a cycle from which on there is navigation."""


@cache
def _adapter(kind: Any) -> TypeAdapter[Any]:
    return TypeAdapter(kind)


def figure_findings(written: Mapping[str, Any], axes: tuple[Axis, ...]) -> Iterator[Finding]:
    """What is wrong with the figures of a grid's study, as written."""
    draws = written.get("draws")
    for at, figure in _readable(written, Figure):
        yield from _coordinate_findings(figure, axes, at)
        if isinstance(draws, Mapping) and draws.get("method") == SPECTRA:
            yield from _spectra_findings(figure, at)
        else:
            yield from _variable_findings(figure, draws, at)
    yield from _name_findings(written, Figure, "makes the same picture file as another")


def scene_figure_findings(
    written: Mapping[str, Any], axes: tuple[Axis, ...] | None
) -> Iterator[Finding]:
    """What is wrong with the figures of a scene's study, as written; axes None where unreadable."""
    scanners = written.get("scanners")
    scanners = scanners if isinstance(scanners, Mapping) else {}
    for at, figure in _readable(written, SceneFigure):
        yield from _scanner_findings(figure, scanners, at)
        yield from () if axes is None else _where_findings(figure, axes, at)
        yield from _draw_findings(figure, written.get("draws"), at)
    yield from _name_findings(written, SceneFigure, "makes the same file as another")


def _readable(written: Mapping[str, Any], kind: Any) -> Iterator[tuple[Location, Any]]:
    """Figures that can be read, each with its location."""
    figures = written.get("figures")
    for i, figure in enumerate(figures if isinstance(figures, list | tuple) else ()):
        with suppress(ValidationError):
            yield ("figures", i), _adapter(kind).validate_python(figure)


def _name_findings(written: Mapping[str, Any], kind: Any, rule: str) -> Iterator[Finding]:
    """Figures that share a file."""
    stems: set[str] = set()
    for at, figure in _readable(written, kind):
        if figure.stem in stems:
            yield Finding(at, f"{rule}, {figure.stem}", "give it a name")
        stems.add(figure.stem)


def _no_coordinate(name: str, known: list[str], at: Location) -> Finding:
    remedy = f"the coordinates are {', '.join(known)}" if known else "this study has no axes"
    suggestion = near_miss(name, known, otherwise=remedy)
    return Finding(at, "is no coordinate of this study", suggestion, name)


def _value_findings(path: str, values: Any, at: Location) -> Iterator[Finding]:
    """Values that are none of a coordinate."""
    for value in values if isinstance(values, tuple) else (values,):
        try:
            parameter_rules()[path].read(value)
        except QuantityError as error:
            yield Finding(at, error.rule, error.suggestion, value)


def _coordinate_findings(figure: Any, axes: tuple[Axis, ...], at: Location) -> Iterator[Finding]:
    """Coordinates that no axis has, and values that are none of a coordinate."""
    paths = {member.name: member.path for axis in axes for member in axis.members}
    known = list(dict.fromkeys([*paths, *(axis.name for axis in axes)]))
    for field, name in figure.coordinates.items():
        location: Location = (*at, *field.split("."))
        if name not in known:
            yield _no_coordinate(name, known, location)
        elif field.startswith("where.") and name in paths:
            yield from _value_findings(paths[name], figure.where[name], location)


def _variable_findings(figure: Any, draws: object, at: Location) -> Iterator[Finding]:
    """A variable that the study does not store."""
    variable = getattr(figure, "variable", None)
    asked = ("number", "limit") if isinstance(draws, Mapping) else ()
    with_draws = any(draws.get(name, 0) not in (0, "0") for name in asked)  # type: ignore[attr-defined]
    drawn = DRAW_OUTPUTS | ERROR_OUTPUTS | ACCURACY_OUTPUTS
    if variable is None or variable in OUTPUTS or (with_draws and variable in drawn):
        return
    rule, remedy = "is no stored quantity", near_miss(variable, [*OUTPUTS, *drawn])
    if variable in drawn:
        rule = "is found over draws, and this study has none"
        remedy = "set draws: {number: ...} or {limit: ...}"
    yield Finding((*at, "variable"), rule, remedy, variable)


def _spectra_findings(figure: Any, at: Location) -> Iterator[Finding]:
    """Closed forms that a study of whole spectra does not store."""
    stored = SPECTRA_OUTPUTS | ACCURACY_OUTPUTS | DRAW_OUTPUTS
    variable = getattr(figure, "variable", None)
    if variable is None:
        rule = "shows closed forms, which a study of whole spectra does not store"
        yield Finding((*at, "kind"), rule, "take surface, slices or table", figure.kind)
    elif variable not in stored:
        rule = "is nothing that a study of whole spectra stores"
        yield Finding((*at, "variable"), rule, near_miss(variable, list(stored)), variable)


def _scanner_findings(figure: Any, scanners: Mapping[str, Any], at: Location) -> Iterator[Finding]:
    """Scanners that the study lacks, or of too few beams for navigation."""
    for place, name in figure.named_scanners.items():
        if name not in scanners:
            remedy = near_miss(name, scanners, otherwise=f"it has {', '.join(scanners)}")
            yield Finding((*at, *place), "is no scanner of this study", remedy, name)
    if isinstance(figure, NavigationFigure | NavigationTable):
        able = {name: _navigates(scanner) for name, scanner in scanners.items()}
        for i, name in enumerate(figure.scanners or ()):
            if able.get(name, True) is False:
                rule = f"has fewer than {LEAST_BEAMS} shots a cycle, and no navigation"
                yield Finding((*at, "scanners", i), rule, "leave it out", name)
        if not figure.scanners and able and not any(able.values()):
            rule = f"needs a scanner of {LEAST_BEAMS} shots a cycle or more"
            yield Finding(at, rule, "leave it out")


def _navigates(written: object) -> bool:
    """Whether a scanner has shots enough in a cycle; so it seems, where it can't be read."""
    with suppress(ValidationError, ValueError):
        pattern = _adapter(AnyScanner).validate_python(written).pattern()
        return shots_a_cycle(pattern) >= LEAST_BEAMS
    return True


def _where_findings(figure: Any, axes: tuple[Axis, ...], at: Location) -> Iterator[Finding]:
    """Coordinates that no axis has, and values that are none, or not one, of a coordinate."""
    paths = {member.name: member.path for axis in axes for member in axis.members}
    for name, value in figure.where.items():
        location = (*at, "where", name)
        if name not in paths:
            yield _no_coordinate(name, list(paths), location)
        elif isinstance(value, tuple):
            yield Finding(location, "must be one value", "make a figure for each")
        else:
            yield from _value_findings(paths[name], value, location)


def _draw_findings(figure: Any, written: object, at: Location) -> Iterator[Finding]:
    """A draw that the study does not make; none where its draws can't be read."""
    draw = getattr(figure, "draw", 0)
    with suppress(ValidationError):
        draws = SceneDraws.model_validate(written or {}).number
        if draw >= draws:
            rule = f"is beyond the study's draws, 0 to {draws - 1}"
            yield Finding((*at, "draw"), rule, "take one of them", draw)
