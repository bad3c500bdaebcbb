"""Declaration of the fields of a spec's sections, and traversal of fields, values and files."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from decimal import Decimal
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, NamedTuple, TypeVar, get_args, get_origin

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError, create_model

from sweep.model.effects.catalogue import EFFECT_PARAMETERS, EFFECTS
from sweep.model.effects.effect import EFFECT_MODES, Parameter
from sweep.scenes.scene_files import SceneError, file_digest
from sweep.spec.rules import (
    MISSING,
    ChoiceRule,
    FilePathRule,
    FlagRule,
    FrequencyErrorTableRule,
    ListRule,
    NumericRule,
    Rule,
    SpecLocation,
    TextRule,
)

AUTO, ON, OFF = EFFECT_MODES
"""Modes of an effect: simulated if the tolerance requires it (auto), always (on), or never
(off)."""
ModelClasses = tuple[type[BaseModel], ...]
"""Pydantic models of sections; a value in a spec is validated as one of them."""
KeyPath = tuple[str, ...]
"""Keys that lead to a value in a spec: names of the enclosing sections, then the field's name."""
Vector = tuple[float, ...]
"""Numbers of one kind in SI units, such as the components of a vector along x, y and z."""
SectionT = TypeVar("SectionT", bound=BaseModel)

KIND_RULE = TextRule(description="Which of several a part is")
"""Rule of the field ``kind``, whose value selects one of several models for a section."""


class SpecSection(BaseModel):
    """A section of a spec: immutable, without fields that it does not declare."""

    model_config = ConfigDict(frozen=True, extra="forbid")


# Declarations of fields, one line for each field. Bounds are written as users write values. A field
# without a default is required, except that a choice has its first option as the default.

# Above any value of a real study, and small enough that squares and products do not overflow.
_DEFAULT_MAGNITUDE_MAX_BY_UNIT = {
    "m": "1e9 m",
    "rad": "1e6 deg",
    "m/s": "1000 km/s",
    "m/s^2": "1e6 m/s^2",
    "rad/s": "1e6 deg/s",
    "": "1e12",
}
"""Largest magnitude of a quantity whose field states no bounds, with its unit, by SI unit."""


def field_with_rule(rule: Rule, default: Any = ..., *, alias: str | None = None) -> Any:
    """Return the declaration of a field whose values obey `rule`.

    Parameters
    ----------
    rule : Rule
        Rule of the field's values.
    default : object
        Value in SI units if the spec states none. Without a default the field is required.
    alias : str, optional
        Name of the field in a spec, if it differs from the attribute's.
    """
    field_info = Field(default, alias=alias)
    field_info.metadata.append(rule)
    return field_info


def quantity_rule(
    description: str,
    unit: str,
    example: str,
    at_least: str = "",
    at_most: str = "",
    **rule_options: Any,
) -> NumericRule:
    """Return the rule of a number with a unit, within bounds.

    Parameters
    ----------
    description : str
        Description for users.
    unit : str
        SI unit; empty for a pure number.
    example : str
        A valid value.
    at_least, at_most : str
        Inclusive bounds with units; wide ones by default (`_DEFAULT_MAGNITUDE_MAX_BY_UNIT`).
    **rule_options
        Fields of `NumericRule` that have no argument here. `at_least` is ignored if `above` is
        given, and `at_most` if `below` is given.
    """
    bounds = (
        {"at_least": at_least or f"-{_DEFAULT_MAGNITUDE_MAX_BY_UNIT[unit]}"}
        if "above" not in rule_options
        else {}
    )
    bounds |= (
        {"at_most": at_most or _DEFAULT_MAGNITUDE_MAX_BY_UNIT[unit]}
        if "below" not in rule_options
        else {}
    )
    return NumericRule(
        description=description,
        si_unit=unit,
        example=example,
        **bounds,  # type: ignore[arg-type]
        **rule_options,
    )


def quantity_field(
    description: str,
    unit: str,
    example: str,
    at_least: str = "",
    at_most: str = "",
    *,
    default: Any = ...,
    keyword: str = "",
    **rule_options: Any,
) -> Any:
    """Return the declaration of a field for a number with a unit.

    Parameters
    ----------
    description, unit, example, at_least, at_most, **rule_options
        As in `quantity_rule`.
    default : object
        Value in SI units if the spec states none. Without a default the field is required.
    keyword : str
        Word that a spec may hold in place of the number. It stands for `keyword_value` if that is
        given, else for the default.
    """
    rule_options |= (
        {"keyword": keyword, "keyword_value": rule_options.get("keyword_value", default)}
        if keyword
        else {}
    )
    return field_with_rule(
        quantity_rule(description, unit, example, at_least, at_most, **rule_options), default
    )


def number_field(description: str, example: str = "0.5", *bounds: str, **rule_options: Any) -> Any:
    """Return the declaration of a field for a number without a unit.

    `bounds` are the least and the greatest value as text; see `quantity_field` for `rule_options`.
    """
    return quantity_field(description, "", example, *bounds, **rule_options)


def integer_field(
    description: str,
    example: str = "3",
    at_least: str = "1",
    at_most: str = "1e6",
    **rule_options: Any,
) -> Any:
    """Return the declaration of a field for an integer, from 1 to 1e6 by default."""
    return quantity_field(
        description, "", example, at_least, at_most, is_integer=True, **rule_options
    )


def length_field(description: str, example: str = "10 m", *bounds: str, **rule_options: Any) -> Any:
    """Return the declaration of a field for a length of either sign, in metres after reading."""
    return quantity_field(description, "m", example, *bounds, **rule_options)


def positive_length_field(description: str, example: str = "10 m", **rule_options: Any) -> Any:
    """Return the declaration of a field for a length of at least 1 um, in metres after reading."""
    return length_field(description, example, "1 um", **rule_options)


def angle_field(
    description: str, example: str = "10 deg", *bounds: str, **rule_options: Any
) -> Any:
    """Return the declaration of a field for an angle of either sign, in radians after reading."""
    return quantity_field(description, "rad", example, *bounds, **rule_options)


def speed_field(description: str, **rule_options: Any) -> Any:
    """Return the declaration of a field for a speed of at least 0, in m/s after reading."""
    return quantity_field(description, "m/s", "30 m/s", "0 m/s", **rule_options)


def duration_field(
    description: str,
    example: str = "10 s",
    at_least: str = "0 s",
    at_most: str = "1e8 s",
    **rule_options: Any,
) -> Any:
    """Return the declaration of a field for a duration in seconds, from 0 to 1e8 s by default."""
    return quantity_field(description, "s", example, at_least, at_most, **rule_options)


def frequency_field(description: str, example: str = "20 Hz") -> Any:
    """Return the declaration of a field for a rate or frequency from 1e-6 to 1e9 Hz."""
    return quantity_field(description, "Hz", example, "1e-6 Hz", "1e9 Hz")


def list_field(
    element_rule: Rule, length_min: int, length_max: int, default: Any = ..., **rule_options: Any
) -> Any:
    """Return the declaration of a field for a list whose values all obey `element_rule`.

    Parameters
    ----------
    element_rule : Rule
        Rule of each value.
    length_min, length_max : int
        Bounds of the number of values.
    default : object
        Tuple of SI values if the spec states no list. Without a default the field is required.
    **rule_options
        Fields of `ListRule` that have no argument here, such as `description`; and `alias`, the
        field's name in a spec.
    """
    alias = rule_options.pop("alias", None)
    return field_with_rule(
        ListRule(
            element_rule=element_rule, length_min=length_min, length_max=length_max, **rule_options
        ),
        default,
        alias=alias,
    )


def vector_field(
    description: str, unit: str, example: str, *, dimensions: int = 3, **rule_options: Any
) -> Any:
    """Return the declaration of a field for a vector of `dimensions` components in `unit`."""
    return list_field(
        quantity_rule("Component", unit, example),
        dimensions,
        dimensions,
        description=description,
        **rule_options,
    )


def position_field(description: str, *, dimensions: int = 3, **rule_options: Any) -> Any:
    """Return the declaration of a field for a position: a list of `dimensions` coordinates [m]."""
    return vector_field(description, "m", "10 m", dimensions=dimensions, **rule_options)


def seed_field(description: str = "Seed of its random numbers") -> Any:
    """Return the declaration of a field for the seed of random numbers, 0 by default."""
    return integer_field(description, "1", "0", "2^63", default=0)


def object_name_rule(description: str, example: str = "ground") -> TextRule:
    """Return the rule for the name of a scene's object or of a scanner, such as ``ground``."""
    return TextRule(
        description=description,
        example=example,
        pattern=r"[a-z][a-z0-9_]{0,59}",
        remedy="take small letters, digits and '_', such as 'ground'",
    )


def object_name_field(description: str, default: Any = ...) -> Any:
    """Return the declaration of a field for the name of a scene's object or of a scanner."""
    return field_with_rule(object_name_rule(description), default)


def command_word_rule(description: str, example: str) -> TextRule:
    """Return the rule for one word of a shell command, without blanks, quotes or shell syntax."""
    remedy = f"write one word, such as '{example}'"
    pattern = r"[A-Za-z0-9_.:/@%+=,\[\]~-]{1,500}"
    return TextRule(description=description, example=example, pattern=pattern, remedy=remedy)


def command_word_field(description: str, example: str, default: Any = ...) -> Any:
    """Return the declaration of a field for one word of a shell command, without shell syntax."""
    return field_with_rule(command_word_rule(description, example), default)


def text_field(description: str, default: Any = ..., **rule_options: str) -> Any:
    """Return the declaration of a field for a text; `rule_options` are fields of `TextRule`."""
    return field_with_rule(TextRule(description=description, **rule_options), default)


def choice_field(description: str, options: tuple[str, ...], default: Any = MISSING) -> Any:
    """Return the declaration of a field for one word of `options`, the first one by default."""
    rule = ChoiceRule(description=description, options=options)
    return field_with_rule(rule, options[0] if default is MISSING else default)


def flag_field(description: str, *, default: bool) -> Any:
    """Return the declaration of a field for a truth value."""
    return field_with_rule(FlagRule(description=description), default)


def file_path_field(description: str, default: Any = ..., **rule_options: Any) -> Any:
    """Return the declaration of a field for the path of a file."""
    return field_with_rule(FilePathRule(description=description, **rule_options), default)


# Fields of physical effects, declared by the model's catalogue


def add_effect_parameter_fields(section_path: str) -> Callable[[type[SectionT]], type[SectionT]]:
    """Return a class decorator that adds fields for effect parameters to a section's model.

    The decorator returns a subclass with a field for each effect parameter in the section at the
    dotted path `section_path`.
    """
    field_definitions = {
        parameter.path.removeprefix(f"{section_path}."): (
            Annotated[
                str if parameter.options or parameter.is_table else float,
                _effect_parameter_rule(parameter),
            ],
            parameter.default,
        )
        for parameter in EFFECT_PARAMETERS
        if parameter.path.rpartition(".")[0] == section_path
    }
    return lambda section: _extend_section(section, field_definitions)


def add_effect_mode_fields(section: type[SectionT]) -> type[SectionT]:
    """Return a subclass of a section's model with one field for the mode of each effect.

    The mode is ``auto`` by default.
    """
    mode_rules = {
        effect.name: ChoiceRule(
            description=effect.description[0].upper() + effect.description[1:], options=EFFECT_MODES
        )
        for effect in EFFECTS
    }
    return _extend_section(
        section, {name: (Annotated[str, mode_rule], AUTO) for name, mode_rule in mode_rules.items()}
    )


def _effect_parameter_rule(parameter: Parameter) -> Rule:
    """Return the rule of an effect's parameter: for a table, one of several words, or a number."""
    if parameter.is_table:
        return FrequencyErrorTableRule(description=parameter.description)
    if parameter.options:
        return ChoiceRule(description=parameter.description, options=parameter.options)
    return NumericRule(
        description=parameter.description,
        si_unit=parameter.unit,
        example=parameter.example,
        at_least=parameter.limits[0],
        at_most=parameter.limits[1],
    )


def _extend_section(section: type[SectionT], field_definitions: dict[str, Any]) -> type[SectionT]:
    """Return a subclass of a section's model with the same name and additional fields.

    Raise `TypeError` if the model has one of the fields already.
    """
    if duplicate_names := sorted(set(field_definitions) & set(section.model_fields)):
        raise TypeError(f"{section.__name__} has {', '.join(duplicate_names)} already")
    extended: type[SectionT] = create_model(
        section.__name__,
        __base__=section,
        __module__=section.__module__,
        __doc__=section.__doc__,
        **field_definitions,
    )
    return extended


# Traversal of the fields of models


def rule_of_field(field: Any) -> Rule | None:
    """Return the rule in the metadata of a pydantic field; None if the field has no rule."""
    return next((item for item in field.metadata if isinstance(item, Rule)), None)


def yaml_name(name: str, field: Any) -> str:
    """Return the name that a pydantic field has in a spec: its alias, else its attribute's name."""
    return str(field.alias or name)


def fields_by_name(model: type[BaseModel]) -> dict[str, Any]:
    """Return the pydantic fields of a section's model, by the names that they have in a spec."""
    return {yaml_name(name, field): field for name, field in model.model_fields.items()}


def rules_by_path(model: type[BaseModel], prefix: str) -> dict[str, Rule]:
    """Return the rules of all fields in a section's model and its nested models, by dotted path.

    Every path begins with `prefix`, the path of the section itself.
    """
    rules: dict[str, Rule] = {}
    for name, field in model.model_fields.items():
        path = f"{prefix}.{name}" if prefix else name
        rule = rule_of_field(field)
        if rule is not None:
            rules[path] = rule
        elif isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel):
            rules |= rules_by_path(field.annotation, path)
    return rules


def models_of_annotation(annotation: Any) -> ModelClasses:
    """Return the pydantic models in a type annotation: one, several (a union), or none."""
    if get_origin(annotation) is Annotated:
        return models_of_annotation(get_args(annotation)[0])
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return (annotation,)
    if get_origin(annotation) in (dict, tuple, list):
        return ()
    return tuple(
        model for argument in get_args(annotation) for model in models_of_annotation(argument)
    )


def kind_of_model(model: type[BaseModel]) -> str:
    """Return the value of the field ``kind`` that selects a model; empty for a model without it."""
    field = model.model_fields.get("kind")
    return str(get_args(field.annotation)[0]) if field is not None else ""


def _element_annotation(annotation: Any) -> Any:
    """Return the type annotation of a dict's values, or of the elements of a list or tuple.

    The result is None if `annotation` is neither a dict nor a list or tuple.
    """
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return _element_annotation(arguments[0])
    if origin is dict:
        return arguments[1]
    return arguments[0] if origin in (tuple, list) else None


def reachable_models(*roots: type[BaseModel]) -> list[type[BaseModel]]:
    """Return the models `roots` and all models nested in them, each once."""
    visited: dict[type[BaseModel], None] = {}
    pending = list(roots)
    while pending:
        model = pending.pop()
        if model not in visited:
            visited[model] = None
            annotations = [field.annotation for field in model.model_fields.values()]
            pending += [
                nested_model
                for annotation in annotations
                for nested_model in models_of_annotation(annotation)
                or models_of_annotation(_element_annotation(annotation))
            ]
    return list(visited)


class ModelLocation(NamedTuple):
    """Location of a value in a spec, with the models of the value and of the section around it."""

    keys: SpecLocation
    """Keys and list indices that lead to the value in the file."""
    value_models: ModelClasses
    """Pydantic models that the value may have, one for each ``kind``; empty if the value is no
    section."""
    enclosing_section_models: ModelClasses
    """Pydantic models that the enclosing section may have, one for each ``kind``."""


def translate_pydantic_location(pydantic_location: SpecLocation, root: Any) -> ModelLocation:
    """Translate a location of a pydantic error to a location in a spec.

    Parameters
    ----------
    pydantic_location : SpecLocation
        Location from pydantic, which contains the kind of a section after the section's key.
    root : type
        Model, or union of models, that was validated.

    Returns
    -------
    ModelLocation
        Location without kinds, with the models of the value and of its enclosing section.
    """
    annotation = root
    keys: list[str | int] = []
    enclosing_section_models: ModelClasses = ()
    for key in pydantic_location:
        models = models_of_annotation(annotation)
        if len(models) > 1:
            annotation = next((model for model in models if kind_of_model(model) == key), None)
            continue
        enclosing_section_models = models
        keys.append(key)
        if models:
            field = fields_by_name(models[0]).get(str(key))
            annotation = None if field is None else field.annotation
        else:
            annotation = _element_annotation(annotation)
    return ModelLocation(tuple(keys), models_of_annotation(annotation), enclosing_section_models)


# Traversal of the values of sections


def validate_or_none(annotation: Any, raw_value: object) -> Any:
    """Validate a part of a spec without the rest; return the model, or None if the part is invalid.

    Parameters
    ----------
    annotation : type
        Model, or union of models, that the part is validated as.
    raw_value : object
        The part as parsed from YAML.
    """
    try:
        return _type_adapter(annotation).validate_python(raw_value)
    except ValidationError:
        return None


@cache
def _type_adapter(annotation: Any) -> TypeAdapter[Any]:
    """Return the pydantic `TypeAdapter` for a type annotation, from a cache."""
    return TypeAdapter(annotation)


class FieldValue(NamedTuple):
    """Value of a field in a section of a spec."""

    key_path: KeyPath
    """Keys that lead to the field in the spec."""
    rule: Rule
    """Rule that the field's values obey."""
    value: Any
    """The field's value after reading, in SI units."""


class FileField(NamedTuple):
    """Field of a section that names a file."""

    key_path: KeyPath
    """Keys that lead to the field from its section."""
    rule: FilePathRule
    """Rule that reads the path and computes the file's digest."""
    raw_path: str
    """Path of the file, as written in the spec."""


def iter_section_values(section: BaseModel, prefix: KeyPath = ()) -> Iterator[FieldValue]:
    """Yield a `FieldValue` for each field of a section and its nested sections, except None values.

    Each key path begins with `prefix`, the keys that lead to the section.
    """
    for name, field in type(section).model_fields.items():
        value, key_path = getattr(section, name), (*prefix, yaml_name(name, field))
        rule = KIND_RULE if name == "kind" else rule_of_field(field)
        if rule is not None and value is not None:
            yield FieldValue(key_path, rule, value)
        elif isinstance(value, BaseModel):
            yield from iter_section_values(value, key_path)
        elif isinstance(value, dict):
            for entry_name, entry in value.items():
                yield from iter_section_values(entry, (*key_path, entry_name))


def values_by_path(
    section: BaseModel, prefix: KeyPath = (), digests: Mapping[str, str] = MappingProxyType({})
) -> dict[str, Any]:
    """Return the SI values of all fields in a section and its nested sections, by dotted path.

    Parameters
    ----------
    section : SpecSection
        Section of a spec.
    prefix : KeyPath
        Path of the section itself, with which the result's keys begin.
    digests : Mapping of str to str
        Digests by path. In the result, a digest replaces the path of its file; a file without a
        digest keeps its path.
    """
    return {
        ".".join(key_path): digests.get(value, value) if isinstance(rule, FilePathRule) else value
        for key_path, rule, value in iter_section_values(section, prefix)
    }


def set_if_absent(mapping: dict[str, Any], path: list[str], value: Any) -> bool:
    """Set a value in nested mappings, in place, unless there is one; return True if it was set.

    `path` lists the keys. Missing mappings on the way are created.
    """
    for name in path[:-1]:
        mapping = mapping.setdefault(name, {})
        if not isinstance(mapping, dict):
            return False
    is_absent = path[-1] not in mapping
    mapping.setdefault(path[-1], value)
    return is_absent


# Identities


def to_canonical_data(value: Any) -> Any:
    """Return a copy of plain data in a form in which equal data has equal JSON text.

    Whole floats below 2**53 become integers, keys are sorted, and tuples become lists.
    """
    if isinstance(value, Mapping):
        return {str(key): to_canonical_data(value[key]) for key in sorted(value)}
    if isinstance(value, list | tuple):
        return [to_canonical_data(item) for item in value]
    if isinstance(value, float) and value.is_integer() and abs(value) < 2**53:
        return int(value)
    return value


def identity_digest(identity: Mapping[str, Any]) -> str:
    """Return the hash of a study's identity, 32 hexadecimal digits.

    Two studies are the same if their identities are equal. The hash is BLAKE2b of the identity's
    canonical JSON text.
    """
    text = json.dumps(
        to_canonical_data(identity), separators=(",", ":"), ensure_ascii=True, allow_nan=False
    )
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


# Files in sections


@dataclass(frozen=True)
class SpecFiles:
    """Files that a spec names, with the digests that they had when it was loaded."""

    base_folder: Path
    """Folder that relative paths in the spec refer to."""
    digests: Mapping[str, str] = dataclasses.field(default_factory=dict)
    """Digest of each file's content when the spec was loaded, by the file's path as written."""
    time_origin: Decimal = Decimal(0)
    """Time at which the flight begins, on the clock of the tables of waypoints [s].

    It is the first time in the platform's table, and 0 without a table.
    """

    def resolve(self, raw_path: str, digest_of: Callable[[Path], str] = file_digest) -> Path:
        """Return the full path of a file; ``~`` stands for the user's home folder.

        Parameters
        ----------
        raw_path : str
            Path as written in the spec.
        digest_of : callable
            Function that computes the digest of the file.

        Raises
        ------
        SceneError
            If the file has changed since the spec was loaded.
        """
        path = self.base_folder / os.path.expanduser(raw_path)
        expected_digest = self.digests.get(raw_path)
        if expected_digest is not None and digest_of(path) != expected_digest:
            raise SceneError(
                path,
                "has changed since the study was declared",
                "bring the old file back, or make another study of the new one",
            )
        return path


def iter_file_fields(section: BaseModel) -> Iterator[FileField]:
    """Yield a `FileField` for each field in a section, or nested in it, that names a file."""
    for key_path, rule, value in iter_section_values(section):
        if isinstance(rule, FilePathRule):
            yield FileField(key_path, rule, value)
