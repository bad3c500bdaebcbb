"""Figures of a scene held against the study that they draw: scanners, coordinates and draws."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import suppress
from functools import cache
from typing import Any

from pydantic import TypeAdapter, ValidationError

from sweep.spec.axes import Axis
from sweep.spec.fields import parameter_rules
from sweep.spec.mistakes import ABSENT, Finding, near_miss
from sweep.spec.scanners import AnyScanner, shots_a_cycle
from sweep.spec.scene_figures import NavigationFigure, NavigationTable, SceneFigure
from sweep.spec.scene_sections import SceneDraws
from sweep.units import QuantityError

LEAST_BEAMS = 3
"""Shots of a cycle from which on there is navigation."""


@cache
def _adapters() -> tuple[TypeAdapter[Any], TypeAdapter[Any]]:
    return TypeAdapter(SceneFigure), TypeAdapter(AnyScanner)


def scene_figure_findings(
    written: Mapping[str, Any], axes: tuple[Axis, ...] | None
) -> list[Finding]:
    """Figures of what the study lacks, and figures that share a file.

    Parameters
    ----------
    written : mapping
        The spec as written; figures that cannot be read are passed over.
    axes : tuple of Axis or None
        The study's axes; None where they could not all be read.
    """
    figures, scanners = written.get("figures"), written.get("scanners")
    known = scanners if isinstance(scanners, Mapping) else {}
    draws = _draws(written.get("draws"))
    findings: list[Finding] = []
    stems: set[str] = set()
    for i, value in enumerate(figures if isinstance(figures, list | tuple) else ()):
        with suppress(ValidationError):
            figure = _adapters()[0].validate_python(value)
            findings += _scanner_findings(figure, known, i)
            findings += [] if axes is None else _where_findings(figure, axes, i)
            findings += _draw_findings(figure, draws, i)
            if figure.stem in stems:
                rule = f"makes the same file as another, {figure.stem}"
                findings.append(Finding(("figures", i), rule, "give it a name", ABSENT))
            stems.add(figure.stem)
    return findings


def _draws(written: object) -> int | None:
    """Number of draws; None where it can't be read."""
    with suppress(ValidationError):
        return SceneDraws.model_validate(written or {}).number
    return None


def _scanner_findings(figure: Any, scanners: Mapping[str, Any], index: int) -> Iterator[Finding]:
    """Scanners that the study lacks, or of too few beams for navigation."""
    for place, name in figure.named_scanners.items():
        if name not in scanners:
            remedy = near_miss(name, scanners, otherwise=f"it has {', '.join(scanners)}")
            rule = "is no scanner of this study"
            yield Finding(("figures", index, *place), rule, remedy, name)
    if isinstance(figure, NavigationFigure | NavigationTable):
        asked = figure.scanners or ()
        able = {name: _navigates(scanner) for name, scanner in scanners.items()}
        for i, name in enumerate(asked):
            if able.get(name, True) is False:
                rule = f"has fewer than {LEAST_BEAMS} shots a cycle, and no navigation"
                yield Finding(("figures", index, "scanners", i), rule, "leave it out", name)
        if not asked and able and not any(able.values()):
            rule = f"needs a scanner of {LEAST_BEAMS} shots a cycle or more"
            yield Finding(("figures", index), rule, "leave it out", ABSENT)


def _navigates(written: object) -> bool:
    """Whether a scanner has shots enough in a cycle; so it seems, where it can't be read."""
    with suppress(ValidationError, ValueError):
        pattern = _adapters()[1].validate_python(written).pattern()
        return shots_a_cycle(pattern) >= LEAST_BEAMS
    return True


def _where_findings(figure: Any, axes: tuple[Axis, ...], index: int) -> Iterator[Finding]:
    """Coordinates that no axis has, and values that are none of a coordinate."""
    members = {member.name: member for axis in axes for member in axis.members}
    remedy = f"the coordinates are {', '.join(members)}" if members else "this study has no axes"
    for name, value in figure.where.items():
        location = ("figures", index, "where", name)
        if name not in members:
            suggestion = near_miss(name, members, otherwise=remedy)
            yield Finding(location, "is no coordinate of this study", suggestion, name)
            continue
        if isinstance(value, tuple):
            yield Finding(location, "must be one value", "make a figure for each", ABSENT)
            continue
        try:
            parameter_rules()[members[name].path].read(value)
        except QuantityError as error:
            yield Finding(location, error.rule, error.suggestion, value)


def _draw_findings(figure: Any, draws: int | None, index: int) -> Iterator[Finding]:
    """A draw that the study does not make."""
    draw = getattr(figure, "draw", 0)
    if draws is not None and draw >= draws:
        rule = f"is beyond the study's draws, 0 to {draws - 1}"
        yield Finding(("figures", index, "draw"), rule, "take one of them", draw)
