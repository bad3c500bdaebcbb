"""Figures held against the study that they draw: its coordinates and its stored quantities."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import suppress
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
from sweep.spec.figures import Figure
from sweep.spec.mistakes import ABSENT, Finding, Location, near_miss
from sweep.spec.sections import SPECTRA
from sweep.units import QuantityError

_FIGURE: TypeAdapter[Figure] = TypeAdapter(Figure)


def figure_findings(written: Mapping[str, Any], axes: tuple[Axis, ...]) -> list[Finding]:
    """Figures of what the study lacks, and figures that share a file.

    Parameters
    ----------
    written : mapping
        The spec as written; figures that cannot be read are passed over.
    axes : tuple of Axis
        The study's axes.
    """
    with_draws = _has_draws(written.get("draws"))
    findings: list[Finding] = []
    stems: set[str] = set()
    for i, figure in _readable(written.get("figures")):
        findings += _coordinate_findings(figure, axes, i)
        if _has_spectra(written.get("draws")):
            findings += _spectra_findings(figure, i)
        else:
            findings += _variable_findings(figure, with_draws, i)
        if figure.stem in stems:
            rule = f"makes the same picture file as another, {figure.stem}"
            findings.append(Finding(("figures", i), rule, "give it a name", ABSENT))
        stems.add(figure.stem)
    return findings


def _has_draws(draws: object) -> bool:
    """Whether a section of draws, as written, asks for any."""
    asked = ("number", "limit") if isinstance(draws, Mapping) else ()
    return any(draws.get(name, 0) not in (0, "0") for name in asked)  # type: ignore[attr-defined]


def _has_spectra(draws: object) -> bool:
    """Whether a section of draws, as written, asks for whole spectra."""
    return isinstance(draws, Mapping) and draws.get("method") == SPECTRA


def _readable(written: object) -> Iterator[tuple[int, Figure]]:
    """Figures that can be read, each with its index."""
    for i, figure in enumerate(written if isinstance(written, list | tuple) else ()):
        with suppress(ValidationError):
            yield i, _FIGURE.validate_python(figure)


def _coordinate_findings(figure: Figure, axes: tuple[Axis, ...], index: int) -> list[Finding]:
    """Coordinates that no axis has, and values that are none of a coordinate."""
    members = {member.name: member for axis in axes for member in axis.members}
    known = list(dict.fromkeys([*members, *(axis.name for axis in axes)]))
    remedy = f"the coordinates are {', '.join(known)}" if known else "this study has no axes"
    findings = []
    for field, name in figure.coordinates.items():
        location: Location = ("figures", index, *field.split("."))
        if name not in known:
            suggestion = near_miss(name, known, otherwise=remedy)
            findings.append(Finding(location, "is no coordinate of this study", suggestion, name))
        elif field.startswith("where.") and name in members:
            values = figure.where[name]  # type: ignore[union-attr]
            for value in values if isinstance(values, tuple) else (values,):
                try:
                    parameter_rules()[members[name].path].read(value)
                except QuantityError as error:
                    findings.append(Finding(location, error.rule, error.suggestion, value))
    return findings


def _variable_findings(figure: Figure, with_draws: bool, index: int) -> list[Finding]:
    """A variable that the study does not store."""
    variable = getattr(figure, "variable", None)
    drawn = DRAW_OUTPUTS | ERROR_OUTPUTS | ACCURACY_OUTPUTS
    if variable is None or variable in OUTPUTS or (with_draws and variable in drawn):
        return []
    location: Location = ("figures", index, "variable")
    if variable in drawn:
        return [
            Finding(
                location,
                "is found over draws, and this study has none",
                "set draws: {number: ...} or {limit: ...}",
                variable,
            )
        ]
    stored = [*OUTPUTS, *drawn]
    return [Finding(location, "is no stored quantity", near_miss(variable, stored), variable)]


def _spectra_findings(figure: Figure, index: int) -> list[Finding]:
    """Closed forms that a study of whole spectra does not store."""
    stored = SPECTRA_OUTPUTS | ACCURACY_OUTPUTS | DRAW_OUTPUTS
    variable = getattr(figure, "variable", None)
    if variable is None:
        rule = "shows closed forms, which a study of whole spectra does not store"
        remedy = "take surface, slices or table"
        return [Finding(("figures", index, "kind"), rule, remedy, figure.kind)]
    if variable in stored:
        return []
    location: Location = ("figures", index, "variable")
    rule = "is nothing that a study of whole spectra stores"
    return [Finding(location, rule, near_miss(variable, list(stored)), variable)]
