"""Differences of two studies, told in words."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from fractions import Fraction
from functools import cache
from types import MappingProxyType
from typing import Any

import sweep.spec.parts as parts
from sweep.spec.flight import AnyScanner, Platform, rule_of_beam
from sweep.spec.rules import Rule
from sweep.spec.scene import ErrorFloor, Navigation, Scene, SceneDraws, SceneStorage
from sweep.spec.sections import SECTIONS
from sweep.units import read_unit

MOST_TOLD = 8
"""Values of an axis that are told one by one."""
LONGEST_TOLD = 200
"""Characters of a word that are told."""
ROOTS: parts.Models = (
    Scene, Platform, ErrorFloor, Navigation, SceneDraws, SceneStorage, *parts.models_at(AnyScanner)
)  # fmt: skip
"""Sections that studies of scenes alone have."""


@cache
def field_rules() -> MappingProxyType[str, Rule]:
    """Rule of every field by its name: one name has one unit wherever it stands."""
    return MappingProxyType({
        name: rule
        for model in parts.all_parts(*SECTIONS.values(), *ROOTS)
        for name, field in parts.fields_of(model).items()
        if (rule := parts.rule_of(field))
    })  # fmt: skip


def difference(a: Any, b: Any) -> list[str]:
    """Lines ``path: value -> value`` for each difference between two specs or their identities."""
    sides = (side if isinstance(side, Mapping) else side.identity() for side in (a, b))
    left, right = (_flat(parts.canonical(side)) for side in sides)
    lines = []
    for path in [*left, *(path for path in right if path not in left)]:
        if left.get(path) != right.get(path):
            old, new = (_told(path, side.get(path)) for side in (left, right))
            lines.append(f"{path}: {old} -> {new}")
    return lines


def _flat(identity: Mapping[str, Any]) -> dict[str, Any]:
    """Leaves of an identity by dotted path; the values of an axis count as one leaf."""
    flat: dict[str, Any] = dict(identity.get("parameters", {}))
    for key, value in identity.items():
        if key == "axes":
            flat["axes"] = [axis["name"] for axis in value]
            for axis in value:
                flat |= {f"axes.{axis['name']}.{path}": m for path, m in axis["members"].items()}
        elif isinstance(value, Mapping) and key != "parameters":
            flat |= {f"{key}.{inner}": leaf for inner, leaf in value.items()}
        elif key != "parameters":
            flat[key] = value
    return flat


def _told(path: str, value: Any) -> str:
    """Format a leaf of an identity in words."""
    rule = field_rules().get(path.rsplit(".", 1)[-1])
    if value is None:
        return "(none)"
    if isinstance(value, str):
        return value if len(value) <= LONGEST_TOLD else f"{value[:LONGEST_TOLD]} ..."
    if path in ("axes", "objects"):
        return ", ".join(value) or "(none)"
    if isinstance(value, list) and path.endswith(".beams"):
        return "[" + ", ".join(_listed(rule_of_beam(beam), beam) for beam in value) + "]"
    if isinstance(value, Mapping) and "values" in value:
        return _listed(rule, value["values"])
    if isinstance(value, Mapping):
        first, last = (_number(rule, value[end]) for end in ("first", "last"))
        ends = f"{first} to {last}{_units(rule)}"
        return f"{value['number']} values from {ends} (digest {value['digest'][:8]})"
    return _listed(rule, value) if isinstance(value, list) else _number(rule, value) + _units(rule)


def _listed(rule: Rule | None, values: Sequence[Any]) -> str:
    """Values of a field in a row, the first and last where they are many."""
    told = [_number(rule, each) for each in values]
    if len(told) > MOST_TOLD:
        told = [*told[:2], "...", told[-1], f"{len(told)} in all"]
    return f"[{', '.join(told)}]{_units(rule)}"


def _units(rule: Rule | None) -> str:
    """Units that a field is told in, behind a space: of angles those of its example, else SI."""
    units = "" if rule is None else rule.units
    if rule is not None and units.startswith("rad"):
        units = rule.example.split(",")[0].split()[-1].strip("]")
    return f" {units}" if units else ""


def _number(rule: Rule | None, value: Any) -> str:
    """Value in SI as it is told: of an angle what reads back as it."""
    units = _units(rule).strip()
    if rule is None or units == rule.units or isinstance(value, str):
        return repr(value) if isinstance(value, float) else str(value)
    unit = read_unit(units, si_unit=rule.units, example=rule.example)
    number = value / float(unit.factor)
    told = f"{number:.15g}"
    return told if unit.to_si(Fraction(told)) == value else repr(number)
