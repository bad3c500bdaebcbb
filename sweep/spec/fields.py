"""Sections of a spec: how their fields are declared, and walks over fields, values and files."""

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
    Location,
    NumericRule,
    Rule,
    TextRule,
)

AUTO, ON, OFF = EFFECT_MODES
ModelClasses = tuple[type[BaseModel], ...]
KeyPath = tuple[str, ...]
SectionT = TypeVar("SectionT", bound=BaseModel)

KIND_RULE = TextRule(description="Which of several a part is")


class SpecSection(BaseModel):
    """A section of a spec: frozen, and with no field but its own."""

    model_config = ConfigDict(frozen=True, extra="forbid")


# Fields, each declared in a line. Bounds are as a user would write them; a field without a default
# is required, but for a choice, which is the first of its words by default.

# Far beyond all that flies, and near enough that squares and products stay within a float.
_SIGNED_QUANTITY_MAX = {
    "m": "1e9 m",
    "rad": "1e6 deg",
    "m/s": "1000 km/s",
    "m/s^2": "1e6 m/s^2",
    "rad/s": "1e6 deg/s",
    "": "1e12",
}
"""Largest magnitude of a signed quantity, by its SI unit."""


def field_of_rule(rule: Rule, default: Any = ..., *, alias: str | None = None) -> Any:
    """Field that holds what a rule says; required without a default."""
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
    """Rule of a quantity within bounds, wide ones by default."""
    bounds = (
        {"at_least": at_least or f"-{_SIGNED_QUANTITY_MAX[unit]}"}
        if "above" not in rule_options
        else {}
    )
    bounds |= (
        {"at_most": at_most or _SIGNED_QUANTITY_MAX[unit]} if "below" not in rule_options else {}
    )
    return NumericRule(
        description=description,
        si_unit=unit,
        example=example,
        **bounds,  # type: ignore[arg-type]
        **rule_options,
    )


def quantity(
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
    """Declare a number with a unit; the word, if there is one, stands for the default."""
    rule_options |= (
        {"keyword": keyword, "keyword_value": rule_options.get("keyword_value", default)}
        if keyword
        else {}
    )
    return field_of_rule(
        quantity_rule(description, unit, example, at_least, at_most, **rule_options), default
    )


def number(description: str, example: str = "0.5", *bounds: str, **rule_options: Any) -> Any:
    """Pure number."""
    return quantity(description, "", example, *bounds, **rule_options)


def count(
    description: str,
    example: str = "3",
    at_least: str = "1",
    at_most: str = "1e6",
    **rule_options: Any,
) -> Any:
    """Whole number."""
    return quantity(description, "", example, at_least, at_most, is_integer=True, **rule_options)


def length(description: str, example: str = "10 m", *bounds: str, **rule_options: Any) -> Any:
    """Length of either sign."""
    return quantity(description, "m", example, *bounds, **rule_options)


def positive_length(description: str, example: str = "10 m", **rule_options: Any) -> Any:
    """Length above 0."""
    return length(description, example, "1 um", **rule_options)


def angle(description: str, example: str = "10 deg", *bounds: str, **rule_options: Any) -> Any:
    """Angle of either sign."""
    return quantity(description, "rad", example, *bounds, **rule_options)


def speed(description: str, **rule_options: Any) -> Any:
    """Speed, not signed."""
    return quantity(description, "m/s", "30 m/s", "0 m/s", **rule_options)


def duration(
    description: str,
    example: str = "10 s",
    at_least: str = "0 s",
    at_most: str = "1e8 s",
    **rule_options: Any,
) -> Any:
    """Time, 0 to some years by default."""
    return quantity(description, "s", example, at_least, at_most, **rule_options)


def frequency(description: str, example: str = "20 Hz") -> Any:
    """Rate above 0."""
    return quantity(description, "Hz", example, "1e-6 Hz", "1e9 Hz")


def list_of(
    element_rule: Rule, length_min: int, length_max: int, default: Any = ..., **rule_options: Any
) -> Any:
    """List of values, each held to the same rule, described by `description`."""
    alias = rule_options.pop("alias", None)
    return field_of_rule(
        ListRule(
            element_rule=element_rule, length_min=length_min, length_max=length_max, **rule_options
        ),
        default,
        alias=alias,
    )


def vector(
    description: str, unit: str, example: str, *, dimensions: int = 3, **rule_options: Any
) -> Any:
    """Components of a vector of so many dimensions."""
    return list_of(
        quantity_rule("Component", unit, example),
        dimensions,
        dimensions,
        description=description,
        **rule_options,
    )


def position(description: str, *, dimensions: int = 3, **rule_options: Any) -> Any:
    """Position in so many dimensions."""
    return vector(description, "m", "10 m", dimensions=dimensions, **rule_options)


def seed(description: str = "Seed of its random numbers") -> Any:
    """Seed, 0 by default."""
    return count(description, "1", "0", "2^63", default=0)


def name_rule(description: str, example: str = "ground") -> TextRule:
    """Rule of the name of an object or a scanner."""
    return TextRule(
        description=description,
        example=example,
        pattern=r"[a-z][a-z0-9_]{0,59}",
        remedy="take small letters, digits and '_', such as 'ground'",
    )


def name(description: str, default: Any = ...) -> Any:
    """Name of an object or a scanner."""
    return field_of_rule(name_rule(description), default)


def word_rule(description: str, example: str) -> TextRule:
    """Rule of one word on a command line: no blanks, no quotes, nothing that a shell reads."""
    remedy = f"write one word, such as '{example}'"
    pattern = r"[A-Za-z0-9_.:/@%+=,\[\]~-]{1,500}"
    return TextRule(description=description, example=example, pattern=pattern, remedy=remedy)


def word(description: str, example: str, default: Any = ...) -> Any:
    """One word on a command line."""
    return field_of_rule(word_rule(description, example), default)


def text(description: str, default: Any = ..., **rule_options: str) -> Any:
    """Text for people, or of a pattern with a remedy."""
    return field_of_rule(TextRule(description=description, **rule_options), default)


def choice(description: str, options: tuple[str, ...], default: Any = MISSING) -> Any:
    """One of several words, the first by default."""
    rule = ChoiceRule(description=description, options=options)
    return field_of_rule(rule, options[0] if default is MISSING else default)


def flag(description: str, *, default: bool) -> Any:
    """Declare a field that is true or false."""
    return field_of_rule(FlagRule(description=description), default)


def file_path(description: str, default: Any = ..., **rule_options: Any) -> Any:
    """Path of a file."""
    return field_of_rule(FilePathRule(description=description, **rule_options), default)


# Fields that physical effects bring into sections, as the model's catalogue declares them


def add_effect_parameters(section_path: str) -> Callable[[type[SectionT]], type[SectionT]]:
    """Return a decorator that adds effects' parameters to the section at a dotted path."""
    field_definitions = {
        parameter.path.removeprefix(f"{section_path}."): (
            Annotated[
                str if parameter.options or parameter.is_table else float,
                _parameter_rule(parameter),
            ],
            parameter.default,
        )
        for parameter in EFFECT_PARAMETERS
        if parameter.path.rpartition(".")[0] == section_path
    }
    return lambda section: _extend_section(section, field_definitions)


def add_effect_modes(section: type[SectionT]) -> type[SectionT]:
    """Add a mode for every effect to the section, `auto` by default."""
    mode_rules = {
        effect.name: ChoiceRule(
            description=effect.description[0].upper() + effect.description[1:], options=EFFECT_MODES
        )
        for effect in EFFECTS
    }
    return _extend_section(
        section, {name: (Annotated[str, mode_rule], AUTO) for name, mode_rule in mode_rules.items()}
    )


def _parameter_rule(parameter: Parameter) -> Rule:
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
    """Return the section with further fields, by the same name."""
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


# Fields of models


def rule_of_field(field: Any) -> Rule | None:
    """Return the rule in a field's metadata, if it has one."""
    return next((item for item in field.metadata if isinstance(item, Rule)), None)


def yaml_name(name: str, field: Any) -> str:
    """Name of a field as users write it: `from` is a word of Python's own."""
    return str(field.alias or name)


def fields_by_name(model: type[BaseModel]) -> dict[str, Any]:
    """Fields of a model by the names that users write."""
    return {yaml_name(name, field): field for name, field in model.model_fields.items()}


def rules_by_path(model: type[BaseModel], prefix: str) -> dict[str, Rule]:
    """Rules of a model's fields and of its sections' fields, by dotted path."""
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
    """Models that a value of an annotation is read as: several where its kind tells which."""
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
    """Return the word that a model goes by among others."""
    field = model.model_fields.get("kind")
    return str(get_args(field.annotation)[0]) if field is not None else ""


def _element_annotation(annotation: Any) -> Any:
    """Annotation of what a mapping or a list holds."""
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return _element_annotation(arguments[0])
    if origin is dict:
        return arguments[1]
    return arguments[0] if origin in (tuple, list) else None


def reachable_models(*roots: type[BaseModel]) -> list[type[BaseModel]]:
    """Every model that values of the roots may consist of, the roots too, each once."""
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


class ResolvedLocation(NamedTuple):
    """A place in a spec."""

    location: Location
    """Keys and indices that lead there, as in the file."""
    value_models: ModelClasses
    """Models as one of which the value there is read; none for a single value."""
    section_models: ModelClasses
    """Models as one of which the part around it is read."""


def resolve_location(pydantic_location: Location, root: Any) -> ResolvedLocation:
    """Place of one of pydantic's locations, which name the kind of a part after its key."""
    annotation = root
    keys: list[str | int] = []
    section_models: ModelClasses = ()
    for key in pydantic_location:
        models = models_of_annotation(annotation)
        if len(models) > 1:
            annotation = next((model for model in models if kind_of_model(model) == key), None)
            continue
        section_models = models
        keys.append(key)
        if models:
            field = fields_by_name(models[0]).get(str(key))
            annotation = None if field is None else field.annotation
        else:
            annotation = _element_annotation(annotation)
    return ResolvedLocation(tuple(keys), models_of_annotation(annotation), section_models)


# Values of sections


def read_or_none(annotation: Any, raw_value: object) -> Any:
    """Read a part by itself as a model or one of several; None where it can't be read."""
    try:
        return _type_adapter(annotation).validate_python(raw_value)
    except ValidationError:
        return None


@cache
def _type_adapter(annotation: Any) -> TypeAdapter[Any]:
    return TypeAdapter(annotation)


def iter_values(section: BaseModel, prefix: KeyPath = ()) -> Iterator[tuple[KeyPath, Rule, Any]]:
    """Every value of a part and of the parts in it that is there: its path, rule and SI value."""
    for name, field in type(section).model_fields.items():
        value, key_path = getattr(section, name), (*prefix, yaml_name(name, field))
        rule = KIND_RULE if name == "kind" else rule_of_field(field)
        if rule is not None and value is not None:
            yield key_path, rule, value
        elif isinstance(value, BaseModel):
            yield from iter_values(value, key_path)
        elif isinstance(value, dict):
            for entry_name, entry in value.items():
                yield from iter_values(entry, (*key_path, entry_name))


def values_by_path(
    section: BaseModel, prefix: KeyPath = (), digests: Mapping[str, str] = MappingProxyType({})
) -> dict[str, Any]:
    """SI values of a part at a path by dotted path; of files, their digests where known."""
    return {
        ".".join(key_path): digests.get(value, value) if isinstance(rule, FilePathRule) else value
        for key_path, rule, value in iter_values(section, prefix)
    }


def set_if_absent(mapping: dict[str, Any], path: list[str], value: Any) -> bool:
    """Put a value at a path that a mapping lacks; False if it is there."""
    for name in path[:-1]:
        mapping = mapping.setdefault(name, {})
        if not isinstance(mapping, dict):
            return False
    is_absent = path[-1] not in mapping
    mapping.setdefault(path[-1], value)
    return is_absent


# Identities


def to_canonical(value: Any) -> Any:
    """Value in the one form that its equals share: whole floats as integers, keys in order."""
    if isinstance(value, Mapping):
        return {str(key): to_canonical(value[key]) for key in sorted(value)}
    if isinstance(value, list | tuple):
        return [to_canonical(item) for item in value]
    if isinstance(value, float) and value.is_integer() and abs(value) < 2**53:
        return int(value)
    return value


def identity_digest(identity: Mapping[str, Any]) -> str:
    """Hash of an identity: 128 bits of BLAKE2b over its canonical JSON, in hex."""
    text = json.dumps(
        to_canonical(identity), separators=(",", ":"), ensure_ascii=True, allow_nan=False
    )
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


# Files that sections name


@dataclass(frozen=True)
class SpecFiles:
    """Files named in a spec."""

    base: Path
    """Folder that their paths are relative to; ~ is the user's own."""
    digests: Mapping[str, str] = dataclasses.field(default_factory=dict)
    """Digest of each file by its path as written."""
    time_origin: Decimal = Decimal(0)
    """Time [s] in tables of waypoints that is the flight's 0: the first of the platform's table."""

    def resolve(self, raw_path: str, digest_of: Callable[[Path], str] = file_digest) -> Path:
        """Path of a file; a `SceneError` if it has changed since the spec was loaded."""
        path = self.base / os.path.expanduser(raw_path)
        expected_digest = self.digests.get(raw_path)
        if expected_digest is not None and digest_of(path) != expected_digest:
            raise SceneError(
                path,
                "has changed since the study was declared",
                "bring the old file back, or make another study of the new one",
            )
        return path


def iter_file_paths(section: BaseModel) -> Iterator[tuple[KeyPath, FilePathRule, str]]:
    """Places in a spec that name a file, with their rule and the path written there."""
    for key_path, rule, value in iter_values(section):
        if isinstance(rule, FilePathRule):
            yield key_path, rule, value
