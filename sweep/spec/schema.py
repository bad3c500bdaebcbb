"""JSON Schema of what a user writes in a spec, for editors and for `sweep schema`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from pydantic import BaseModel
from pydantic.json_schema import models_json_schema

from sweep.spec.parts import all_parts, fields_of, rule_of
from sweep.spec.reading import library
from sweep.spec.rules import Json, Numeric, Rule
from sweep.spec.sections import parameter_rules
from sweep.spec.study import SceneSpec, Spec

DIALECT = "https://json-schema.org/draft/2020-12/schema"

_INSTRUMENT_SECTIONS = ("Laser", "Chirp", "Telescope", "Receiver", "Processing")


def json_schema() -> Json:
    """JSON Schema (2020-12) of a spec file, of a flat target or of a scene.

    Values of parameters are described by field. Fields that an axis or an instrument file may
    supply are not required by it; `sweep.load` does require them.
    """
    _, schema = models_json_schema([(Spec, "validation"), (SceneSpec, "validation")])
    definitions: Json = schema["$defs"]
    for model in all_parts(Spec, SceneSpec):
        _show_written_defaults(definitions[model.__name__]["properties"], model)
    for name in (*_INSTRUMENT_SECTIONS, "Instrument", "Target"):
        definitions[name].pop("required", None)
    instrument, file = (
        definitions["Instrument"],
        "YAML file of the instrument, relative to this one",
    )
    instrument["description"] = "A Doppler lidar: in whole, or fields set anew of a known one"
    instrument["properties"] = {
        "like": {
            "enum": list(library()),
            "description": "Instrument of the library, which has all fields that are not given "
            "here; sweep instruments tells of each",
        },
        "file": {"type": "string", "description": file},
        **instrument["properties"],
    }
    rules = parameter_rules()
    for path, rule in rules.items():
        definitions[f"{path}.value"] = rule.schema()
        definitions[f"{path}.values"] = _values_schema(path, rule)
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


def _complete(study: Json, rules: Mapping[str, Rule], required: tuple[str, ...]) -> None:
    """Describe a study's instrument and axes, and name what it can't do without."""
    study["properties"]["instrument"] = {
        "description": "The instrument: its name in the library (sweep instruments), the path of "
        "its file, one of these with fields set anew, or all of it",
        "anyOf": [
            {"type": "string", "examples": ["settembrini_2026", "instruments/table_4_1.yaml"]},
            {"$ref": "#/$defs/Instrument"},
        ],
    }
    study["properties"]["axes"] = _axes_schema(rules)
    study["patternProperties"] = {"^x-": {"description": "Anchors for other sections; not read"}}
    study["required"] = ["title", "instrument", *required]


def _show_written_defaults(properties: Json, model: type[BaseModel]) -> None:
    """Defaults as a user would write them, in place of SI values; of single fields only."""
    for name, field in fields_of(model).items():
        described, rule = properties[name], rule_of(field)
        if rule is not None and described.get("default") not in (None, "", [], {}):
            described["default"] = rule.written(field.default)
        else:
            described.pop("default", None)


def _reference(path: str, part: str) -> Json:
    """Return a reference to what a field may hold."""
    return {"$ref": f"#/$defs/{path}.{part}"}


def _object(properties: Json, *required: str, **more: Any) -> Json:
    """Return the schema of a mapping with properties of its own and no other ones."""
    needed = {"required": list(required)} if required else {}
    return (
        {"type": "object", "properties": properties, "additionalProperties": False} | needed | more
    )


def _list(items: Json, least: int = 1, **more: Any) -> Json:
    return {"type": "array", "items": items, "minItems": least} | more


def _values_schema(path: str, rule: Rule) -> Json:
    """Return the schema of a list of values and generators, or of one generator."""
    single = _reference(path, "value")
    generators = list(_generators(single)) if isinstance(rule, Numeric) else []
    pieces = _list({"anyOf": [single, *generators]})
    return {"description": rule.schema()["description"], "anyOf": [pieces, *generators]}


def _generators(single: Json) -> Iterator[Json]:
    """Yield the schemas of the three generators."""
    number = {"anyOf": [{"type": "integer", "minimum": 2}, {"type": "string"}]}
    for kind in ("linear", "log"):
        bounds = _list(single, 2, maxItems=2)
        yield _object({kind: bounds, "number": number}, kind, "number")
    steps = _list({"type": ["string", "number"]}, 3, maxItems=3)
    yield _object({"step": steps}, "step")


def _axes_schema(rules: Mapping[str, Rule]) -> Json:
    """Axes by path, each with its own field's values, and zipped axes by any other name."""
    either = {
        path: {"anyOf": [_reference(path, "value"), _reference(path, "values")]} for path in rules
    }
    piece = _object(either, minProperties=1)
    return {
        "type": "object",
        "description": "Parameters that vary: a list, a generator, or a zipped axis by any name",
        "properties": {path: _reference(path, "values") for path in rules},
        "additionalProperties": _object({"zip": {"anyOf": [piece, _list(piece)]}}, "zip"),
    }
