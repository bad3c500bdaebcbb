"""The fields of instrument and scene by dotted path: what an axis may vary."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from functools import cache
from types import MappingProxyType
from typing import Any

from pydantic import BaseModel

from sweep.spec.instrument import Instrument
from sweep.spec.mistakes import near_miss
from sweep.spec.rules import Rule, Text
from sweep.spec.sections import Accuracy, Atmosphere, Footprint, Target

SECTIONS: dict[str, type[BaseModel]] = {
    "instrument": Instrument,
    "target": Target,
    "atmosphere": Atmosphere,
    "footprint": Footprint,
    "accuracy": Accuracy,
}


@cache
def parameter_rules() -> MappingProxyType[str, Rule]:
    """Rule of every parameter that an axis may vary, by dotted path."""
    rules: dict[str, Rule] = {}
    for section, model in SECTIONS.items():
        rules |= rules_of(model, section)
    return MappingProxyType(rules)


def rules_of(model: type[BaseModel], prefix: str) -> dict[str, Rule]:
    """Rules of a model's fields and of its sections' fields, by dotted path."""
    rules: dict[str, Rule] = {}
    for name, field in model.model_fields.items():
        path = f"{prefix}.{name}" if prefix else name
        rule = rule_of(field)
        if rule is not None:
            rules[path] = rule
        elif isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel):
            rules |= rules_of(field.annotation, path)
    return rules


def rule_of(field: Any) -> Rule | None:
    """The rule in a field's annotation, if it has one."""
    return next((item for item in field.metadata if isinstance(item, Rule)), None)


def default_of(path: str) -> Any:
    """Default of a parameter, SI; None where it has none."""
    section, *rest = path.split(".")
    model: Any = SECTIONS[section]
    for name in rest[:-1]:
        model = model.model_fields[name].annotation
    field = model.model_fields[rest[-1]]
    return None if field.is_required() else field.default


def values_of(part: BaseModel, prefix: str) -> dict[str, Any]:
    """Values of a model's fields and of its sections' fields, by dotted path."""
    values: dict[str, Any] = {}
    for name in type(part).model_fields:
        value = getattr(part, name)
        path = f"{prefix}.{name}" if prefix else name
        values |= values_of(value, path) if isinstance(value, BaseModel) else {path: value}
    return values


def written_name(name: str, field: Any) -> str:
    """Name of a field as users write it: `from` is a word of Python's own."""
    return str(field.alias or name)


UNSTORED = ("question", "execution", "axes", "figures")
"""Sections of a study of which no default is written out."""

Key = tuple[str, ...]

KIND = Text(about="Which of several a part is")


def leaves(part: BaseModel, path: Key = ()) -> Iterator[tuple[Key, Rule, Any]]:
    """Every value of a part and of the parts in it that is there: its path, rule and SI value."""
    for name, field in type(part).model_fields.items():
        value, key = getattr(part, name), (*path, written_name(name, field))
        rule = KIND if name == "kind" else rule_of(field)
        if rule is not None and value is not None:
            yield key, rule, value
        elif isinstance(value, BaseModel):
            yield from leaves(value, key)
        elif isinstance(value, dict):
            for inner, below in value.items():
                yield from leaves(below, (*key, inner))


def fill(mapping: dict[str, Any], path: list[str], value: Any) -> bool:
    """Whether the mapping lacked the path, where the value then is put."""
    for name in path[:-1]:
        mapping = mapping.setdefault(name, {})
        if not isinstance(mapping, dict):
            return False
    lacking = path[-1] not in mapping
    mapping.setdefault(path[-1], value)
    return lacking


def short_name(path: str) -> str:
    """Last part of a parameter's path; of what a part is, the part's own name."""
    *parts, last = path.split(".")
    return parts[-1] if last == "kind" and parts else last


def parameter_suggestion(path: str, known: Iterable[str] | None = None) -> str:
    """Suggestion for a path that names no parameter; of those known, all by default."""
    rules = list(parameter_rules() if known is None else known)
    tail = short_name(path)
    same_tail = [known for known in rules if short_name(known) == tail]
    if len(same_tail) == 1:
        return f"did you mean '{same_tail[0]}'?"
    by_tail = {short_name(known): known for known in rules}
    suggestion = near_miss(path, rules) or near_miss(tail, by_tail)
    for short, known in by_tail.items():
        suggestion = suggestion.replace(f"'{short}'", f"'{known}'")
    *others, last = SECTIONS
    return suggestion or f"axes take fields of {', '.join(others)} and {last}"
