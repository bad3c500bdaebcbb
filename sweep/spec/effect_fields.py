"""Fields that physical effects bring into a spec: their parameters, and whether they act.

An effect declares both in the model's catalogue, so that a new one touches no module here.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, create_model

from sweep.model.effects.catalogue import EFFECTS, PARAMETERS
from sweep.model.effects.effect import MODES, Parameter
from sweep.spec.rules import Choice, Numeric, Rule

AUTO, ON, OFF = MODES

Section = TypeVar("Section", bound=BaseModel)


@dataclass(frozen=True, kw_only=True)
class Mode(Choice):
    """Whether an effect is simulated: where the scene calls for it, always or never."""

    options: tuple[str, ...] = MODES

    def read(self, written: object) -> str:
        """The mode; YAML makes truth values of a bare `on` or `off`."""
        if isinstance(written, bool):
            return ON if written else OFF
        return super().read(written)

    def schema(self) -> dict[str, Any]:
        """JSON Schema: the words, and what YAML makes of two of them."""
        return {"description": self.about, "enum": [*self.options, True, False]}


def with_parameters(path: str) -> Callable[[type[Section]], type[Section]]:
    """Decorator that gives a section the parameters that effects bring into it.

    Parameters
    ----------
    path : str
        Dotted path of the section in a spec, such as ``instrument.laser``.
    """
    fields = {
        parameter.path.removeprefix(f"{path}."): _field(parameter)
        for parameter in PARAMETERS
        if parameter.path.rpartition(".")[0] == path
    }
    return lambda section: _completed(section, fields)


def with_modes(section: type[Section]) -> type[Section]:
    """The section with a mode for every effect, `auto` by default."""
    return _completed(
        section,
        {
            effect.name: (Annotated[str, Mode(about=_sentence(effect.about))], AUTO)
            for effect in EFFECTS
        },
    )


def _sentence(about: str) -> str:
    return about[0].upper() + about[1:]


def rule_of_parameter(parameter: Parameter) -> Rule:
    """Rule of a field that an effect brings."""
    if parameter.options:
        return Choice(about=parameter.about, options=parameter.options)
    return Numeric(
        about=parameter.about,
        si_unit=parameter.unit,
        example=parameter.example,
        at_least=parameter.limits[0],
        at_most=parameter.limits[1],
    )


def _field(parameter: Parameter) -> tuple[Any, float | int | str]:
    """Annotation and default of a field, as pydantic takes them."""
    kind = str if parameter.options else float
    return Annotated[kind, rule_of_parameter(parameter)], parameter.default


def _completed(section: type[Section], fields: dict[str, Any]) -> type[Section]:
    """The section with further fields, by the same name."""
    if taken := sorted(set(fields) & set(section.model_fields)):
        raise TypeError(f"{section.__name__} has {', '.join(taken)} already")
    completed: type[Section] = create_model(
        section.__name__,
        __base__=section,
        __module__=section.__module__,
        __doc__=section.__doc__,
        **fields,
    )
    return completed
