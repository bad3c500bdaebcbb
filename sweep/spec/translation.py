"""Pydantic's errors in plain words."""

from __future__ import annotations

from typing import Any, get_args

from pydantic import BaseModel, ValidationError

from sweep.spec.fields import parameter_rules, rule_of, rules_of
from sweep.spec.figures import FIGURE_KINDS, Figure
from sweep.spec.mistakes import ABSENT, Finding, Location, near_miss
from sweep.spec.rules import BROKEN_RULE, Numeric

_FIGURE_MODELS = {
    get_args(model.model_fields["kind"].annotation)[0]: model
    for model in get_args(get_args(Figure)[0])
}
_PLAIN = {
    "model_type": ("must be a mapping of fields to values", ""),
    "model_attributes_type": ("must be a mapping of fields to values", ""),
    "dict_type": ("must be a mapping", ""),
    "list_type": ("must be a list", ""),
    "tuple_type": ("must be a list", ""),
    "invalid_key": ("must be a word", ""),
    "union_tag_not_found": ("lacks its kind", f"write kind: and one of {', '.join(FIGURE_KINDS)}"),
}


def findings_of(error: ValidationError, root: type[BaseModel]) -> list[Finding]:
    """Everything pydantic found wrong with a mapping read as `root`."""
    return [_finding(dict(detail), root) for detail in error.errors(include_url=False)]


def _finding(detail: dict[str, Any], root: type[BaseModel]) -> Finding:
    """One error of pydantic's."""
    kind, written = detail["type"], detail["input"]
    location = _without_tags(detail["loc"])
    if kind == BROKEN_RULE:
        context = detail["ctx"]
        return Finding(location, context["rule"], context["suggestion"], written)
    if kind == "missing":
        return Finding(location, "is missing", _remedy(location, root), ABSENT)
    if kind == "extra_forbidden":
        return Finding(location, "is no field", _sibling(location, root), ABSENT)
    if kind == "union_tag_invalid":
        tag = detail["ctx"]["tag"]
        rule = f"must be one of {', '.join(FIGURE_KINDS)}"
        return Finding((*location, "kind"), rule, near_miss(str(tag), FIGURE_KINDS), tag)
    rule, suggestion = _PLAIN.get(kind, ("has a value that cannot stand here", ""))
    return Finding(location, rule, suggestion, written)


def _without_tags(location: Location) -> Location:
    """Location without the figure's kind, which pydantic puts after its index."""
    if len(location) > 2 and location[0] == "figures":
        return (*location[:2], *location[3:])
    return location


def _model_at(location: Location, root: type[BaseModel]) -> type[BaseModel] | None:
    """Model that the location's value is read as."""
    model: Any = root
    for name in location:
        field = model.model_fields.get(name) if isinstance(name, str) else None
        model = field.annotation if field is not None else None
        if not (isinstance(model, type) and issubclass(model, BaseModel)):
            return None
    return model


def _remedy(location: Location, root: type[BaseModel]) -> str:
    """What to write for a missing field or section."""
    name = location[-1]
    parent = _model_at(location[:-1], root)
    field = parent.model_fields.get(str(name)) if parent else None
    rule = rule_of(field) if field is not None else None
    if isinstance(rule, Numeric):
        return f"write e.g. '{name}: {rule.example}', or put it on an axis"
    section = _model_at(location, root)
    if section is not None:
        return f"write '{name}:' with {', '.join(section.model_fields)}"
    return f"write '{name}: ...'"


def _sibling(location: Location, root: type[BaseModel]) -> str:
    """Field that an unknown one resembles: beside it, else anywhere."""
    name = str(location[-1])
    model = _model_at(location[:-1], root)
    if location[0] == "figures" and len(location) == 3:
        known = {key for figure in _FIGURE_MODELS.values() for key in figure.model_fields}
        return near_miss(name, sorted(known))
    beside = list(model.model_fields) if model else []
    suggestion = near_miss(name, beside)
    if suggestion:
        return suggestion
    elsewhere = [
        p for p in (*parameter_rules(), *rules_of(root, "")) if p.rsplit(".", 1)[-1] == name
    ]
    if elsewhere:
        return f"did you mean '{elsewhere[0]}'?"
    return f"the fields here are {', '.join(beside)}" if beside else ""
