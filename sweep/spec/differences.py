"""Description of the differences between two studies, as lines of text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from decimal import Context, Decimal
from fractions import Fraction
from functools import cache
from types import MappingProxyType
from typing import Any

import sweep.spec.fields as spec_fields
from sweep.spec.flight_sections import AnyScanner, Platform, beam_direction_rule
from sweep.spec.rules import Rule
from sweep.spec.scene_sections import ErrorFloorSection, Navigation, Scene, SceneDraws, SceneStorage
from sweep.spec.sections import MODEL_BY_SECTION
from sweep.units import read_unit

LISTED_VALUES_MAX = 8
"""Largest length of a list that is shown in full where two studies differ."""
SHOWN_CHARACTERS_MAX = 200
"""Largest number of characters of a text that is shown where two studies differ."""
_DECIMAL_CONTEXT = Context(prec=20)
"""Decimal arithmetic with 20 digits, more than a float has."""
SCENE_SECTION_MODELS: spec_fields.ModelClasses = (
    Scene,
    Platform,
    ErrorFloorSection,
    Navigation,
    SceneDraws,
    SceneStorage,
    *spec_fields.models_of_annotation(AnyScanner),
)
"""Models of the sections that only specs of scenes have."""


@cache
def rules_by_field_name() -> MappingProxyType[str, Rule]:
    """Return the rule of every field of a spec, by the name of the field.

    A name that occurs in several sections has the same unit in all of them.
    """
    return MappingProxyType({
        name: rule
        for model in spec_fields.reachable_models(*MODEL_BY_SECTION.values(), *SCENE_SECTION_MODELS)
        for name, field in spec_fields.fields_by_name(model).items()
        if (rule := spec_fields.rule_of_field(field))
    })  # fmt: skip


def describe_differences(a: Any, b: Any) -> list[str]:
    """Return a text ``path: value of a -> value of b`` for each difference between two specs.

    Parameters
    ----------
    a, b : GridSpec, SceneSpec or Mapping
        Specs, or their identities as plain data.

    Returns
    -------
    list of str
        Lines in the order of the fields of `a`, then fields that only `b` has.
    """
    identities = (
        identity if isinstance(identity, Mapping) else identity.identity() for identity in (a, b)
    )
    identity_a, identity_b = (
        _flatten_identity(spec_fields.to_canonical_data(identity)) for identity in identities
    )
    lines = []
    for path in [*identity_a, *(path for path in identity_b if path not in identity_a)]:
        if identity_a.get(path) != identity_b.get(path):
            old_text, new_text = (
                _format_identity_entry(path, identity.get(path))
                for identity in (identity_a, identity_b)
            )
            lines.append(f"{path}: {old_text} -> {new_text}")
    return lines


def _flatten_identity(identity: Mapping[str, Any]) -> dict[str, Any]:
    """Return the entries of a study's identity in one dict, by dotted path.

    The identity is nested data that is equal for equal studies. All values of a parameter along an
    axis are one entry.
    """
    leaves: dict[str, Any] = dict(identity.get("parameters", {}))
    for key, value in identity.items():
        if key == "axes":
            leaves["axes"] = [axis["name"] for axis in value]
            for axis in value:
                leaves |= {
                    f"axes.{axis['name']}.{path}": parameter_content
                    for path, parameter_content in axis["members"].items()
                }
        elif isinstance(value, Mapping) and key != "parameters":
            leaves |= {f"{key}.{inner_name}": leaf for inner_name, leaf in value.items()}
        elif key != "parameters":
            leaves[key] = value
    return leaves


def _format_identity_entry(path: str, value: Any) -> str:
    """Return the value at the dotted path `path` of a study's identity as text with its unit."""
    rule = rules_by_field_name().get(path.rsplit(".", 1)[-1])
    if value is None:
        return "(none)"
    if isinstance(value, str):
        return (
            value if len(value) <= SHOWN_CHARACTERS_MAX else f"{value[:SHOWN_CHARACTERS_MAX]} ..."
        )
    if path in ("axes", "objects"):
        return ", ".join(value) or "(none)"
    if isinstance(value, list) and path.endswith(".beams"):
        return (
            "[" + ", ".join(_format_list(beam_direction_rule(beam), beam) for beam in value) + "]"
        )
    if isinstance(value, Mapping) and "values" in value:
        return _format_list(rule, value["values"])
    if isinstance(value, Mapping):
        first, last = (_format_number(rule, value[end]) for end in ("first", "last"))
        ends_text = f"{first} to {last}{_unit_suffix(rule)}"
        return f"{value['number']} values from {ends_text} (digest {value['digest'][:8]})"
    return (
        _format_list(rule, value)
        if isinstance(value, list)
        else _format_number(rule, value) + _unit_suffix(rule)
    )


def _format_list(rule: Rule | None, values: Sequence[Any]) -> str:
    """Return the SI values of a field as text ``[1, 2, 3] m``; more than 8 values are shortened."""
    texts = [_format_number(rule, value) for value in values]
    if len(texts) > LISTED_VALUES_MAX:
        texts = [*texts[:2], "...", texts[-1], f"{len(texts)} in all"]
    return f"[{', '.join(texts)}]{_unit_suffix(rule)}"


def _unit_suffix(rule: Rule | None) -> str:
    """Return a blank and the unit in which a field's values are shown; empty for a pure number.

    The unit of an angle is that of the example in the field's rule. All other units are SI units.
    """
    unit_name = "" if rule is None else rule.value_unit
    if rule is not None and unit_name.startswith("rad"):
        unit_name = rule.example.split(",")[0].split()[-1].strip("]")
    return f" {unit_name}" if unit_name else ""


def _format_number(rule: Rule | None, value: Any) -> str:
    """Return an SI value as text: a number in the unit that `_unit_suffix` names, without the unit.

    For an angle, the text has enough digits to read back as exactly the same SI value.
    """
    unit_name = _unit_suffix(rule).strip()
    if rule is None or unit_name == rule.value_unit or isinstance(value, str):
        return repr(value) if isinstance(value, float) else str(value)
    unit = read_unit(unit_name, si_unit=rule.value_unit, example=rule.example)
    text = f"{value / float(unit.factor):.15g}"
    if unit.to_si(Fraction(text)) != value:
        exact_number = Fraction(value) / unit.factor
        numerator, denominator = map(Decimal, exact_number.as_integer_ratio())
        text = str(_DECIMAL_CONTEXT.divide(numerator, denominator))
    return text
