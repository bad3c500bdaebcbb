"""JSON Schema of spec files as users write them, for editors and for `sweep schema`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from pydantic import BaseModel
from pydantic.json_schema import models_json_schema

from sweep.spec.fields import fields_by_name, reachable_models, rule_of_field
from sweep.spec.rules import JsonObject, NumericRule, Rule
from sweep.spec.sections import parameter_rules
from sweep.spec.specs import GridSpec, SceneSpec
from sweep.spec.yaml_document import library_instrument_files

JSON_SCHEMA_DIALECT = "https://json-schema.org/draft/2020-12/schema"
"""URI of the dialect in which the JSON Schema of specs is written."""

_INSTRUMENT_SECTION_MODEL_NAMES = ("Laser", "Chirp", "Telescope", "Receiver", "Processing")
"""Names of the pydantic models for the sections of an instrument."""


def json_schema() -> JsonObject:
    """Return the JSON Schema (2020-12) of spec files, for studies of a flat target and of a scene.

    Values of parameters are described field by field. A field that may come from an axis or an
    instrument's file is not required by the schema; `sweep.load` requires it.
    """
    _, schema = models_json_schema([(GridSpec, "validation"), (SceneSpec, "validation")])
    definitions: JsonObject = schema["$defs"]
    for model in reachable_models(GridSpec, SceneSpec):
        _format_schema_defaults(definitions[model.__name__]["properties"], model)
    for name in (*_INSTRUMENT_SECTION_MODEL_NAMES, "Instrument", "Target"):
        definitions[name].pop("required", None)
    instrument, file_description = (
        definitions["Instrument"],
        "YAML file of the instrument, relative to this one",
    )
    instrument["description"] = (
        "A Doppler lidar: all of its fields, or changes to a known instrument"
    )
    instrument["properties"] = {
        "like": {
            "enum": list(library_instrument_files()),
            "description": "Instrument of the library that supplies all fields not given "
            "here; sweep instruments describes each",
        },
        "file": {"type": "string", "description": file_description},
        **instrument["properties"],
    }
    rules = parameter_rules()
    for path, rule in rules.items():
        definitions[f"{path}.value"] = rule.schema()
        definitions[f"{path}.values"] = _values_schema(path, rule)
    scene_rules = {path: rule for path, rule in rules.items() if SceneSpec.may_be_on_axis(path)}
    _add_study_sections(definitions["GridSpec"], rules, ())
    _add_study_sections(definitions["SceneSpec"], scene_rules, ("scene", "platform", "scanners"))
    return {
        "$schema": JSON_SCHEMA_DIALECT,
        "title": "sweep study",
        "if": {"required": ["scene"]},
        "then": {"$ref": "#/$defs/SceneSpec"},
        "else": {"$ref": "#/$defs/GridSpec"},
        "$defs": definitions,
    }


def _add_study_sections(
    study_schema: JsonObject, rules: Mapping[str, Rule], required: tuple[str, ...]
) -> None:
    """Add instrument, axes and required sections to the schema of a study, in place.

    `rules` are those of the parameters that an axis may set, by dotted path.
    """
    study_schema["properties"]["instrument"] = {
        "description": "The instrument: its name in the library (sweep instruments), the path of "
        "its file, one of these with changed fields, or all of its fields",
        "anyOf": [
            {"type": "string", "examples": ["settembrini_2026", "instruments/table_4_1.yaml"]},
            {"$ref": "#/$defs/Instrument"},
        ],
    }
    study_schema["properties"]["axes"] = _axes_schema(rules)
    study_schema["patternProperties"] = {
        "^x-": {"description": "Anchors for other sections; not read"}
    }
    study_schema["required"] = ["title", "instrument", *required]


def _format_schema_defaults(properties: JsonObject, model: type[BaseModel]) -> None:
    """Replace defaults in SI units by values as users write them, in place in a JSON Schema.

    `properties` has the schema of each field of `model`, by the field's name.
    """
    for name, field in fields_by_name(model).items():
        field_schema, rule = properties[name], rule_of_field(field)
        if rule is not None and field_schema.get("default") not in (None, "", [], {}):
            field_schema["default"] = rule.format(field.default)
        else:
            field_schema.pop("default", None)


def _definition_reference(path: str, suffix: str) -> JsonObject:
    """Return a reference to the JSON Schema of a field's value, or of its values on an axis.

    `suffix` is ``value`` or ``values``.
    """
    return {"$ref": f"#/$defs/{path}.{suffix}"}


def _mapping_schema(properties: JsonObject, *required: str, **keywords: Any) -> JsonObject:
    """Return the JSON Schema of a mapping that has no other keys than those of `properties`.

    `required` lists the mandatory keys. `keywords` are added to the schema.
    """
    required_keyword = {"required": list(required)} if required else {}
    return (
        {"type": "object", "properties": properties, "additionalProperties": False}
        | required_keyword
        | keywords
    )


def _list_schema(items: JsonObject, length_min: int = 1, **keywords: Any) -> JsonObject:
    """Return the JSON Schema of a list with at least `length_min` values of the schema `items`.

    `keywords` are added to the schema of the list.
    """
    return {"type": "array", "items": items, "minItems": length_min} | keywords


def _values_schema(path: str, rule: Rule) -> JsonObject:
    """Return the JSON Schema of a parameter's values on an axis.

    The values are a list of values and generators, or one generator.
    """
    value_schema = _definition_reference(path, "value")
    generator_schemas = (
        list(_generator_schemas(value_schema)) if isinstance(rule, NumericRule) else []
    )
    list_schema = _list_schema({"anyOf": [value_schema, *generator_schemas]})
    return {"description": rule.schema()["description"], "anyOf": [list_schema, *generator_schemas]}


def _generator_schemas(value_schema: JsonObject) -> Iterator[JsonObject]:
    """Yield the JSON Schema of each generator of an axis's values: linear, log and step."""
    number_schema = {"anyOf": [{"type": "integer", "minimum": 2}, {"type": "string"}]}
    for form in ("linear", "log"):
        bounds_schema = _list_schema(value_schema, 2, maxItems=2)
        yield _mapping_schema({form: bounds_schema, "number": number_schema}, form, "number")
    steps_schema = _list_schema({"type": ["string", "number"]}, 3, maxItems=3)
    yield _mapping_schema({"step": steps_schema}, "step")


def _axes_schema(rules: Mapping[str, Rule]) -> JsonObject:
    """Return the JSON Schema of the section ``axes``.

    The key of an axis is the dotted path of its parameter. The key of a zipped axis is any other
    name.
    """
    value_schemas = {
        path: {
            "anyOf": [_definition_reference(path, "value"), _definition_reference(path, "values")]
        }
        for path in rules
    }
    piece_schema = _mapping_schema(value_schemas, minProperties=1)
    return {
        "type": "object",
        "description": "Parameters that vary: a list, a generator, or a zipped axis by any name",
        "properties": {path: _definition_reference(path, "values") for path in rules},
        "additionalProperties": _mapping_schema(
            {"zip": {"anyOf": [piece_schema, _list_schema(piece_schema)]}}, "zip"
        ),
    }
