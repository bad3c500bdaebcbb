"""Pydantic's errors in plain words."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, ValidationError

from sweep.spec.fields import parameter_rules, rule_of, rules_of
from sweep.spec.figures import FIGURE_KINDS
from sweep.spec.mistakes import ABSENT, Finding, dotted, near_miss
from sweep.spec.rules import BROKEN_RULE, Numeric
from sweep.spec.scene_figures import SCENE_FIGURE_KINDS
from sweep.spec.structure import Models, Place, field_named, fields_of, kind_of, place_of

_PLAIN = {
    "model_type": ("must be a mapping of fields to values", ""),
    "model_attributes_type": ("must be a mapping of fields to values", ""),
    "dict_type": ("must be a mapping", ""),
    "list_type": ("must be a list", ""),
    "tuple_type": ("must be a list", ""),
    "invalid_key": ("must be a word", ""),
}
_FLIES = "it is for studies with a scene, in place of a target"
_OTHER_STUDYS = {
    **dict.fromkeys(("scene", "target"), "a study has a scene or a target, not both"),
    **dict.fromkeys(("platform", "scanners", "navigation"), _FLIES),
}
"""Remedy for a section that only the other kind of study has."""

_DRAWN_BY = dict.fromkeys(FIGURE_KINDS, "a target") | dict.fromkeys(SCENE_FIGURE_KINDS, "a scene")


def findings_of(error: ValidationError, root: type[BaseModel]) -> list[Finding]:
    """Everything pydantic found wrong with a mapping read as `root`."""
    return [_finding(dict(detail), root) for detail in error.errors(include_url=False)]


def _finding(detail: dict[str, Any], root: type[BaseModel]) -> Finding:
    """One error of pydantic's."""
    kind, written = detail["type"], detail["input"]
    place = place_of(detail["loc"], root)
    location = place.location
    if kind == BROKEN_RULE:
        context, path = detail["ctx"], dotted(location)
        if isinstance(written, list) and path in parameter_rules():
            remedy = f"put several under axes: '{path}: [...]'"
            return Finding(location, "takes one value", remedy, written)
        shown = ABSENT if isinstance(written, dict) else written
        return Finding(location, context["rule"], context["suggestion"], shown)
    if kind == "missing":
        return Finding(location, "is missing", _remedy(place), ABSENT)
    if kind == "extra_forbidden":
        return Finding(location, "is no field", _sibling(place, root), ABSENT)
    if kind == "union_tag_invalid":
        tag, kinds = detail["ctx"]["tag"], [kind_of(model) for model in place.models]
        rule = f"must be one of {', '.join(kinds)}"
        return Finding((*location, "kind"), rule, _other_kind(str(tag), kinds), tag)
    if kind == "union_tag_not_found":
        return Finding(location, "lacks its kind", f"write {_with_kind(place.models)}", written)
    rule, suggestion = _PLAIN.get(kind, ("has a value that cannot stand here", ""))
    return Finding(location, rule, suggestion, written)


def _with_kind(models: Models) -> str:
    """What a part of several kinds is written with."""
    return f"kind: and one of {', '.join(kind_of(model) for model in models)}"


def _other_kind(tag: str, kinds: list[str]) -> str:
    """Suggestion for a kind that is none of those here."""
    if tag in _DRAWN_BY and kinds[0] in _DRAWN_BY:
        return f"{tag} is for studies of {_DRAWN_BY[tag]}"
    return near_miss(tag, kinds)


def _remedy(place: Place) -> str:
    """What to write for a missing field or section."""
    name = place.location[-1]
    field = field_named(place.parents[0], name) if place.parents else None
    rule = rule_of(field) if field is not None else None
    example = getattr(rule, "example", "")
    if example:
        varies = isinstance(rule, Numeric) and dotted(place.location) in parameter_rules()
        return f"write e.g. '{name}: {example}'" + (", or put it on an axis" if varies else "")
    if len(place.models) > 1:
        return f"write '{name}:' with {_with_kind(place.models)}"
    if place.models:
        return f"write '{name}:' with {', '.join(fields_of(place.models[0]))}"
    return f"write '{name}: ...'"


def _sibling(place: Place, root: type[BaseModel]) -> str:
    """Field that an unknown one resembles: beside it, else anywhere."""
    name = str(place.location[-1])
    beside = [field for model in place.parents for field in fields_of(model)]
    if name in _OTHER_STUDYS and place.parents == (root,):
        return _OTHER_STUDYS[name]
    suggestion = near_miss(name, beside)
    if suggestion:
        return suggestion
    elsewhere = [
        p for p in (*parameter_rules(), *rules_of(root, "")) if p.rsplit(".", 1)[-1] == name
    ]
    if elsewhere:
        return f"did you mean '{elsewhere[0]}'?"
    return f"the fields here are {', '.join(beside)}" if beside else ""
