"""What every study has, however it is declared: reading, identity, and text for a store."""

from __future__ import annotations

import copy
import json
from abc import ABC, abstractmethod
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np
from pydantic import ConfigDict, PrivateAttr, ValidationError

from sweep.model.threshold import WAYS
from sweep.spec.axes import Axis, Member
from sweep.spec.axis_reading import paths_on_axes, read_axes
from sweep.spec.beam_check import beam_findings
from sweep.spec.effect_check import effect_findings, written_modes
from sweep.spec.fields import (
    UNSTORED,
    fill,
    leaves,
    parameter_rules,
    parameter_suggestion,
    short_name,
    values_of,
)
from sweep.spec.identity import digest
from sweep.spec.instrument import Instrument, Part
from sweep.spec.limits import grid_findings, readable
from sweep.spec.mistakes import ABSENT, Finding, Location, Mistake, SpecError, dotted, shown
from sweep.spec.progressions import values_in
from sweep.spec.reading import Document, plain, resolve_instrument
from sweep.spec.rules import Numeric, Rule, Text
from sweep.spec.sections import Accuracy, Atmosphere, Effects, Execution, Footprint
from sweep.spec.translation import findings_of
from sweep.units import QuantityError

LARGEST_GRID = 10**15

_SEED = Numeric(
    about="Seed of all random draws", example="1", at_least="0", at_most="2^63", whole=True
)


class _ReadAxes(Rule):
    """Axes, which `read_axes` has read before pydantic sees them."""

    def read(self, written: object) -> object:
        """The axes as they are."""
        return written


class Study(Part, ABC):
    """A study as its user declared it, every value read and checked.

    Made by `load` from a file and by `from_mapping` from plain data; values are SI.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", ignored_types=(cached_property,))

    title: Annotated[str, Text(about="What the study is called")]
    question: Annotated[str, Text(about="The question that the study answers")] = ""
    instrument: Instrument
    atmosphere: Atmosphere = Atmosphere()
    footprint: Footprint = Footprint()
    effects: Effects = Effects()
    accuracy: Accuracy = Accuracy()
    seed: Annotated[int, _SEED] = 0
    execution: Execution = Execution()
    axes: Annotated[tuple[Axis, ...], _ReadAxes(about="What varies")] = ()

    _written: dict[str, Any] = PrivateAttr(default_factory=dict)

    @classmethod
    def from_mapping(cls, mapping: Mapping[str, Any], *, base: Path | str = ".") -> Self:
        """Spec from plain data, written as in a file.

        Parameters
        ----------
        mapping : mapping
            What a spec file holds; left as it is.
        base : path
            Folder that the files which it names are relative to.

        Raises
        ------
        SpecError
            With every mistake in it.
        """
        if not isinstance(mapping, Mapping):
            raise SpecError([Mistake("", "must be a mapping", shown(mapping))])
        return cls.from_document(Document(plain(mapping)), Path(base))

    @classmethod
    def from_document(cls, document: Document, base: Path | None) -> Self:
        """Spec from a document, which is changed, or all of its mistakes at once.

        Parameters
        ----------
        document : Document
            The spec as written.
        base : Path or None
            Folder that the files which it names are relative to; None leaves them alone.

        Raises
        ------
        SpecError
            With every mistake in it.
        """
        has_instrument = resolve_instrument(document, base or Path())
        written = document.value
        filled = [
            path
            for path, first in paths_on_axes(written.get("axes")).items()
            if cls.may_vary(path) and fill(written, path.split("."), first)
        ]
        axes, findings = read_axes(written.get("axes", {}))
        axes_are_whole = not findings
        spec: Self | None = None
        try:
            spec = cls.model_validate({**written, "axes": axes})
        except ValidationError as error:
            findings += findings_of(error, cls)
        values = readable(written, axes)
        findings += grid_findings(values, axes)
        findings += beam_findings(values, axes)
        findings += effect_findings(values, axes, written_modes(written))
        findings += _size_finding(axes)
        findings += cls.further_findings(written, axes, base, axes_are_whole)
        # What is wrong with an axis or an instrument's file is told there, and there alone.
        findings = [
            finding
            for finding in findings
            if dotted(finding.location) not in filled
            and (has_instrument or finding.location[0] != "instrument")
        ]
        findings = document.findings + findings
        if findings or spec is None:
            raise SpecError(_in_order(document, findings))
        spec._written = spec._completed(written)
        return spec

    @classmethod
    def may_vary(cls, path: str) -> bool:
        """Whether the parameter at a path is one of this kind of study."""
        return True

    @classmethod
    def further_findings(
        cls,
        written: Mapping[str, Any],
        axes: tuple[Axis, ...],
        base: Path | None,
        axes_are_whole: bool,
    ) -> list[Finding]:
        """What is wrong with a spec beyond its single fields.

        Parameters
        ----------
        written : mapping
            The spec as written.
        axes : tuple of Axis
            The axes that could be read.
        base : Path or None
            Folder that the files which it names are relative to; None leaves them alone.
        axes_are_whole : bool
            Whether all of the axes could be read.
        """
        return []

    @abstractmethod
    def parameters(self) -> dict[str, float | int | str]:
        """SI values of all parameters by dotted path; of those on axes, the value off the axis."""

    def modes(self) -> dict[str, str]:
        """Whether each effect, by its name, is simulated: `auto`, `on` or `off`."""
        return values_of(self.effects, "")

    def parameters_at(self, at: Mapping[str, object]) -> dict[str, float | int | str]:
        """Parameters with some set anew, written as in a spec.

        Parameters
        ----------
        at : mapping
            Values by dotted path or its last part: ``{"range": "2 km"}``.

        Raises
        ------
        SpecError
            With every mistake in it, the combination's included.
        """
        parameters = self.parameters()
        findings = []
        for name, written in at.items():
            path, rule = _parameter(name, parameters | dict.fromkeys(WAYS))
            if rule is None:
                suggestion = parameter_suggestion(name, parameters)
                findings.append(Finding((name,), "is no parameter", suggestion, ABSENT))
                continue
            try:
                if path in WAYS:  # one takes another's place
                    parameters = {p: v for p, v in parameters.items() if p not in WAYS}
                parameters[path] = rule.read(written)
            except QuantityError as error:
                findings.append(Finding((name,), error.rule, error.suggestion, written))
            findings += self.unvaried(path, parameters[path], (name,))
        if not findings:
            findings = grid_findings(parameters, ())
            findings += beam_findings(parameters, ())
            findings += effect_findings(parameters, (), self.modes())
        if findings:
            raise SpecError(Document({}).mistake(finding) for finding in findings)
        return parameters

    def unvaried(self, path: str, value: object, location: Location) -> list[Finding]:
        """What is wrong with a parameter taking a value in this kind of study: nothing."""
        return []

    def member(self, name: str) -> Member:
        """Parameter on an axis, by its coordinate's name or dotted path.

        Raises
        ------
        KeyError
            Where no axis has it.
        """
        for axis in self.axes:
            for member in axis.members:
                if name in (member.name, member.path):
                    return member
        raise KeyError(name)

    def coordinate_value(self, name: str, written: object) -> float | int | str:
        """Written value of a coordinate, in the unit that the coordinate is displayed in.

        Raises
        ------
        KeyError
            Where no axis has the coordinate.
        QuantityError
            Where the value cannot be read.
        """
        member = self.member(name)
        rule = parameter_rules()[member.path]
        if not isinstance(rule, Numeric):
            return str(rule.read(written))
        number, unit = rule.exact(written)
        display = rule.exact(f"1 {member.units}" if member.units else 1)[1]
        if unit.decibel != display.decibel:
            return float(values_in(display, np.array([unit.to_si(number)]))[0])
        if unit.decibel:
            return float(number)
        return float((unit.factor * number + unit.offset - display.offset) / display.factor)

    @abstractmethod
    def identity(self) -> dict[str, Any]:
        """Content that makes the study this one, in SI values."""

    def parameters_off_axes(self) -> dict[str, float | int | str]:
        """SI values of the parameters that no axis overrides, by dotted path."""
        on_axes = {member.path for axis in self.axes for member in axis.members}
        return {path: v for path, v in self.parameters().items() if path not in on_axes}

    @cached_property
    def id(self) -> str:
        """Hash of the identity, 32 hexadecimal digits."""
        return digest(self.identity())

    def __hash__(self) -> int:
        return hash(self.id)

    def to_yaml_mapping(self) -> dict[str, Any]:
        """The spec as a user would write it whole: no instrument's file, no default left out.

        Execution is left out, as it is no part of what a study is.
        """
        return copy.deepcopy(self._written)

    def _completed(self, written: dict[str, Any]) -> dict[str, Any]:
        """The spec as written, with its defaults written out and its execution left out."""
        mapping = {key: value for key, value in written.items() if key != "execution"}
        for path, rule, value in leaves(self):
            if path[0] not in UNSTORED:
                fill(mapping, list(path), rule.written(value))
        return mapping

    def to_json(self) -> str:
        """The spec as JSON text, for a store to hold."""
        return json.dumps(self.to_yaml_mapping(), ensure_ascii=False, allow_nan=False)


def _parameter(name: str, known: Mapping[str, object]) -> tuple[str, Rule | None]:
    """Dotted path and rule of a parameter, by its path or its last part."""
    rules = parameter_rules()
    paths = [path for path in known if name in (path, short_name(path))]
    return (paths[0], rules[paths[0]]) if len(paths) == 1 else (name, None)


def _size_finding(axes: tuple[Axis, ...]) -> list[Finding]:
    """A grid too large to count."""
    points = 1
    for axis in axes:
        points *= axis.size
    if points <= LARGEST_GRID:
        return []
    return [
        Finding(
            ("axes",),
            f"make {points:.3g} points, and a study has at most {LARGEST_GRID:.0e}",
            "take fewer values",
            ABSENT,
        )
    ]


def _in_order(document: Document, findings: list[Finding]) -> list[Mistake]:
    """Mistakes as they stand in the file, each once."""
    mistakes = dict.fromkeys(document.mistake(finding) for finding in findings)
    return sorted(mistakes, key=lambda m: (m.file != document.file, m.file, m.line or 0))
