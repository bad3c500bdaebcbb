"""JSON Schema of what a user writes in a spec, for editors and for `sweep schema`."""

from __future__ import annotations

from typing import Any

from sweep.spec.experiment import Spec
from sweep.spec.fields import parameter_rules
from sweep.spec.rules import Numeric, Rule

DIALECT = "https://json-schema.org/draft/2020-12/schema"

_INSTRUMENT_SECTIONS = ("Laser", "Chirp", "Telescope", "Receiver", "Processing")


def json_schema() -> dict[str, Any]:
    """JSON Schema (2020-12) of a spec file.

    Values of parameters are described by field. Fields that an axis or an instrument file may
    supply are not required by it; `sweep.load` does require them.
    """
    schema = Spec.model_json_schema(mode="validation")
    definitions: dict[str, Any] = schema["$defs"]
    _show_written_defaults(schema)
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
    schema["properties"]["instrument"] = {
        "description": "The instrument: the path of its file, a file with overrides, or all of it",
        "anyOf": [
            {"type": "string", "examples": ["instruments/table_4_1.yaml"]},
            {"$ref": "#/$defs/Instrument"},
        ],
    }
    schema["properties"]["axes"] = _axes_schema(definitions)
    schema["required"] = ["title", "instrument"]
    return schema | {"$schema": DIALECT, "title": "sweep study"}


def _show_written_defaults(schema: dict[str, Any]) -> None:
    """Defaults as a user would write them, in place of SI values."""
    rules = {tuple(path.split(".")): rule for path, rule in parameter_rules().items()}
    for path, rule in rules.items():
        properties = _properties(schema, path[:-1])
        described = properties.get(path[-1], {})
        if "default" in described:
            described["default"] = rule.written(described["default"])


def _properties(schema: dict[str, Any], path: tuple[str, ...]) -> dict[str, Any]:
    """Properties of the section at a path."""
    at = schema
    for name in path:
        described = at["properties"][name]
        reference = described.get("$ref") or described["allOf"][0]["$ref"]
        at = schema["$defs"][reference.rsplit("/", 1)[-1]]
    return dict(at["properties"])


def _axes_schema(definitions: dict[str, Any]) -> dict[str, Any]:
    """Axes by path, each with its own field's values, and zipped axes by any other name.

    What one field may hold goes into the definitions, once.
    """
    rules = parameter_rules()
    for path, rule in rules.items():
        definitions[f"{path}.value"] = rule.schema()
        definitions[f"{path}.values"] = _values_schema(path, rule)
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
