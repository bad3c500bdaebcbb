"""JSON Schema of what a user writes in a spec, for editors and for `sweep schema`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pydantic import BaseModel
from pydantic.json_schema import models_json_schema

from sweep.spec.fields import parameter_rules
from sweep.spec.parts import all_parts, fields_of, rule_of
from sweep.spec.rules import Numeric, Rule
from sweep.spec.scene_spec import SceneSpec
from sweep.spec.study import Spec

DIALECT = "https://json-schema.org/draft/2020-12/schema"

_INSTRUMENT_SECTIONS = ("Laser", "Chirp", "Telescope", "Receiver", "Processing")


def json_schema() -> dict[str, Any]:
    """JSON Schema (2020-12) of a spec file, of a flat target or of a scene.

    Values of parameters are described by field. Fields that an axis or an instrument file may
    supply are not required by it; `sweep.load` does require them.
    """
    _, schema = models_json_schema([(Spec, "validation"), (SceneSpec, "validation")])
    definitions: dict[str, Any] = schema["$defs"]
    for model in all_parts(Spec, SceneSpec):
        _show_written_defaults(definitions[model.__name__]["properties"], model)
    for name in (*_INSTRUMENT_SECTIONS, "Instrument", "Target"):
        definitions[name].pop("required", None)
    definitions["Instrument"]["description"] = (
        "A Doppler lidar, in whole or in overrides of a file's"
    )
    definitions["Instrument"]["properties"] = {
        "file": {
            "type": "string",
            "description": "YAML file of the instrument, relative to this one",
        },
        **definitions["Instrument"]["properties"],
    }
    rules = parameter_rules()
    _define_values(definitions, rules)
    scene = {path: rule for path, rule in rules.items() if SceneSpec.may_vary(path)}
    _complete(definitions["Spec"], rules, ())
    _complete(definitions["SceneSpec"], scene, ("scene", "platform", "scanners"))
    return {
        "$schema": DIALECT,
        "title": "sweep study",
        "if": {"required": ["scene"]},
        "then": {"$ref": "#/$defs/SceneSpec"},
        "else": {"$ref": "#/$defs/Spec"},
        "$defs": definitions,
    }


def _complete(study: dict[str, Any], rules: Mapping[str, Rule], required: tuple[str, ...]) -> None:
    """Describe a study's instrument and axes, and name what it can't do without."""
    study["properties"]["instrument"] = {
        "description": "The instrument: the path of its file, a file with overrides, or all of it",
        "anyOf": [
            {"type": "string", "examples": ["instruments/table_4_1.yaml"]},
            {"$ref": "#/$defs/Instrument"},
        ],
    }
    study["properties"]["axes"] = _axes_schema(rules)
    study["required"] = ["title", "instrument", *required]


def _show_written_defaults(properties: dict[str, Any], model: type[BaseModel]) -> None:
    """Defaults as a user would write them, in place of SI values; of single fields only."""
    for name, field in fields_of(model).items():
        described, rule = properties[name], rule_of(field)
        if rule is not None and described.get("default") not in (None, "", [], {}):
            described["default"] = rule.written(field.default)
        else:
            described.pop("default", None)


def _define_values(definitions: dict[str, Any], rules: Mapping[str, Rule]) -> None:
    """Put what each parameter may hold into the definitions, once."""
    for path, rule in rules.items():
        definitions[f"{path}.value"] = rule.schema()
        definitions[f"{path}.values"] = _values_schema(path, rule)


def _axes_schema(rules: Mapping[str, Rule]) -> dict[str, Any]:
    """Axes by path, each with its own field's values, and zipped axes by any other name."""
    return {
        "type": "object",
        "description": "Parameters that vary: a list, a generator, or a zipped axis by any name",
        "properties": {path: _reference(path, "values") for path in rules},
        "additionalProperties": _zip_schema(list(rules)),
    }


def _reference(path: str, part: str) -> dict[str, str]:
    """Reference to what a field may hold."""
    return {"$ref": f"#/$defs/{path}.{part}"}


def _values_schema(path: str, rule: Rule) -> dict[str, Any]:
    """A list of values and generators, or one generator."""
    single = _reference(path, "value")
    generators = _generators_schema(single) if isinstance(rule, Numeric) else []
    pieces = {"type": "array", "items": {"anyOf": [single, *generators]}, "minItems": 1}
    return {"description": rule.schema()["description"], "anyOf": [pieces, *generators]}


def _generators_schema(single: dict[str, Any]) -> list[dict[str, Any]]:
    """The three generators."""
    plain = {"type": ["string", "number"]}
    number = {"anyOf": [{"type": "integer", "minimum": 2}, {"type": "string"}]}
    schemas = []
    for kind in ("linear", "log", "step"):
        counted = kind != "step"
        length = 2 if counted else 3
        bounds = {
            "type": "array",
            "items": single if counted else plain,
            "minItems": length,
            "maxItems": length,
        }
        schema = {
            "type": "object",
            "properties": {kind: bounds} | ({"number": number} if counted else {}),
            "required": [kind, "number"] if counted else [kind],
            "additionalProperties": False,
        }
        schemas.append(schema)
    return schemas


def _zip_schema(paths: list[str]) -> dict[str, Any]:
    """A zipped axis: pieces laid end to end."""
    piece = {
        "type": "object",
        "properties": {
            path: {"anyOf": [_reference(path, "value"), _reference(path, "values")]}
            for path in paths
        },
        "additionalProperties": False,
        "minProperties": 1,
    }
    return {
        "type": "object",
        "properties": {"zip": {"anyOf": [piece, {"type": "array", "items": piece, "minItems": 1}]}},
        "required": ["zip"],
        "additionalProperties": False,
    }
