"""The fields of instrument and scene by dotted path: what an axis may vary."""

from __future__ import annotations

from functools import cache
from types import MappingProxyType
from typing import Any

from pydantic import BaseModel

from sweep.spec.instrument import Instrument
from sweep.spec.mistakes import near_miss
from sweep.spec.rules import Rule
from sweep.spec.scene import Accuracy, Footprint, Target

SECTIONS: dict[str, type[BaseModel]] = {
    "instrument": Instrument,
    "target": Target,
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


def parameter_suggestion(path: str) -> str:
    """Suggestion for a path that names no parameter."""
    rules = parameter_rules()
    tail = path.rsplit(".", 1)[-1]
    same_tail = [known for known in rules if known.rsplit(".", 1)[-1] == tail]
    if len(same_tail) == 1:
        return f"did you mean '{same_tail[0]}'?"
    by_tail = {known.rsplit(".", 1)[-1]: known for known in rules}
    suggestion = near_miss(path, rules) or near_miss(tail, by_tail)
    for short, known in by_tail.items():
        suggestion = suggestion.replace(f"'{short}'", f"'{known}'")
    return suggestion or "axes take fields of instrument, target, footprint and accuracy"
