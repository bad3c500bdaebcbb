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

from sweep.model.effects.catalogue import EFFECTS, PARAMETERS
from sweep.model.effects.effect import MODES, Parameter
from sweep.scenes.files import SceneError, file_digest
from sweep.spec.rules import (
    ABSENT,
    Choice,
    File,
    Flag,
    Location,
    Numeric,
    Rule,
    Several,
    SweepError,
    Text,
)

AUTO, ON, OFF = MODES
Models = tuple[type[BaseModel], ...]
Key = tuple[str, ...]
Section = TypeVar("Section", bound=BaseModel)

KIND = Text(about="Which of several a part is")


class Part(BaseModel):
    """A section of a spec: frozen, and with no field but its own."""

    model_config = ConfigDict(frozen=True, extra="forbid")


# Fields, each declared in a line. Bounds are as a user would write them; a field without a default
# is required, but for a choice, which is the first of its words by default.

# Far beyond all that flies, and near enough that squares and products stay within a float.
_EITHER_WAY = {
    "m": "1e9 m",
    "rad": "1e6 deg",
    "m/s": "1000 km/s",
    "m/s^2": "1e6 m/s^2",
    "rad/s": "1e6 deg/s",
    "": "1e12",
}
"""Largest magnitude of a signed quantity, by its SI unit."""


def field(rule: Rule, default: Any = ..., *, alias: str | None = None) -> Any:
    """Field that holds what a rule says; required without a default."""
    info = Field(default, alias=alias)
    info.metadata.append(rule)
    return info


def measure(
    about: str, unit: str, example: str, at_least: str = "", at_most: str = "", **more: Any
) -> Numeric:
    """Rule of a quantity within bounds, wide ones by default."""
    bounds = {"at_least": at_least or f"-{_EITHER_WAY[unit]}"} if "above" not in more else {}
    bounds |= {"at_most": at_most or _EITHER_WAY[unit]} if "below" not in more else {}
    return Numeric(about=about, si_unit=unit, example=example, **bounds, **more)  # type: ignore[arg-type]


def quantity(
    about: str,
    unit: str,
    example: str,
    at_least: str = "",
    at_most: str = "",
    *,
    default: Any = ...,
    word: str = "",
    **more: Any,
) -> Any:
    """Declare a number with a unit; the word, if there is one, stands for the default."""
    more |= {"word": word, "means": more.get("means", default)} if word else {}
    return field(measure(about, unit, example, at_least, at_most, **more), default)


def number(about: str, example: str = "0.5", *bounds: str, **more: Any) -> Any:
    """Pure number."""
    return quantity(about, "", example, *bounds, **more)


def count(
    about: str, example: str = "3", at_least: str = "1", at_most: str = "1e6", **more: Any
) -> Any:
    """Whole number."""
    return quantity(about, "", example, at_least, at_most, whole=True, **more)


def length(about: str, example: str = "10 m", *bounds: str, **more: Any) -> Any:
    """Length of either sign."""
    return quantity(about, "m", example, *bounds, **more)


def size(about: str, example: str = "10 m", **more: Any) -> Any:
    """Length above 0."""
    return length(about, example, "1 um", **more)


def angle(about: str, example: str = "10 deg", *bounds: str, **more: Any) -> Any:
    """Angle of either sign."""
    return quantity(about, "rad", example, *bounds, **more)


def speed(about: str, **more: Any) -> Any:
    """Speed, not signed."""
    return quantity(about, "m/s", "30 m/s", "0 m/s", **more)


def duration(
    about: str, example: str = "10 s", at_least: str = "0 s", at_most: str = "1e8 s", **more: Any
) -> Any:
    """Time, 0 to some years by default."""
    return quantity(about, "s", example, at_least, at_most, **more)


def frequency(about: str, example: str = "20 Hz") -> Any:
    """Rate above 0."""
    return quantity(about, "Hz", example, "1e-6 Hz", "1e9 Hz")


def several(of: Rule, least: int, most: int, default: Any = ..., **more: Any) -> Any:
    """List of values, each held to the same rule, described by `about`."""
    alias = more.pop("alias", None)
    return field(Several(of=of, least=least, most=most, **more), default, alias=alias)


def vector(about: str, unit: str, example: str, *, of: int = 3, **more: Any) -> Any:
    """Components of a vector of so many dimensions."""
    return several(measure("Component", unit, example), of, of, about=about, **more)


def position(about: str, *, of: int = 3, **more: Any) -> Any:
    """Position in so many dimensions."""
    return vector(about, "m", "10 m", of=of, **more)


def seed(about: str = "Seed of its random numbers") -> Any:
    """Seed, 0 by default."""
    return count(about, "1", "0", "2^63", default=0)


def named(about: str, example: str = "ground") -> Text:
    """Rule of the name of an object or a scanner."""
    return Text(
        about=about,
        example=example,
        pattern=r"[a-z][a-z0-9_]{0,59}",
        remedy="take small letters, digits and '_', such as 'ground'",
    )


def name(about: str, default: Any = ...) -> Any:
    """Name of an object or a scanner."""
    return field(named(about), default)


def one_word(about: str, example: str) -> Text:
    """Rule of one word on a command line: no blanks, no quotes, nothing that a shell reads."""
    remedy = f"write one word, such as '{example}'"
    pattern = r"[A-Za-z0-9_.:/@%+=,\[\]~-]{1,500}"
    return Text(about=about, example=example, pattern=pattern, remedy=remedy)


def word(about: str, example: str, default: Any = ...) -> Any:
    """One word on a command line."""
    return field(one_word(about, example), default)


def text(about: str, default: Any = ..., **more: str) -> Any:
    """Text for people, or of a pattern with a remedy."""
    return field(Text(about=about, **more), default)


def choice(about: str, options: tuple[str, ...], default: Any = ABSENT) -> Any:
    """One of several words, the first by default."""
    rule = Choice(about=about, options=options)
    return field(rule, options[0] if default is ABSENT else default)


def flag(about: str, *, default: bool) -> Any:
    """Declare a field that is true or false."""
    return field(Flag(about=about), default)


def file(about: str, default: Any = ..., **more: Any) -> Any:
    """Path of a file."""
    return field(File(about=about, **more), default)


# Fields that physical effects bring into sections, as the model's catalogue declares them


def with_parameters(path: str) -> Callable[[type[Section]], type[Section]]:
    """Return a decorator that adds effects' parameters to the section at a dotted path."""
    fields = {
        parameter.path.removeprefix(f"{path}."): (
            Annotated[str if parameter.options or parameter.table else float, _rule_of(parameter)],
            parameter.default,
        )
        for parameter in PARAMETERS
        if parameter.path.rpartition(".")[0] == path
    }
    return lambda section: _completed(section, fields)


def with_modes(section: type[Section]) -> type[Section]:
    """Add a mode for every effect to the section, `auto` by default."""
    modes = {e.name: Choice(about=e.about[0].upper() + e.about[1:], options=MODES) for e in EFFECTS}
    return _completed(section, {n: (Annotated[str, mode], AUTO) for n, mode in modes.items()})


def _rule_of(parameter: Parameter) -> Rule:
    if parameter.table:
        return SweepError(about=parameter.about)
    if parameter.options:
        return Choice(about=parameter.about, options=parameter.options)
    return Numeric(
        about=parameter.about,
        si_unit=parameter.unit,
        example=parameter.example,
        at_least=parameter.limits[0],
        at_most=parameter.limits[1],
    )


def _completed(section: type[Section], fields: dict[str, Any]) -> type[Section]:
    """Return the section with further fields, by the same name."""
    if taken := sorted(set(fields) & set(section.model_fields)):
        raise TypeError(f"{section.__name__} has {', '.join(taken)} already")
    completed: type[Section] = create_model(
        section.__name__,
        __base__=section,
        __module__=section.__module__,
        __doc__=section.__doc__,
        **fields,
    )
    return completed


# Fields of models


def rule_of(field: Any) -> Rule | None:
    """Return the rule in a field's metadata, if it has one."""
    return next((item for item in field.metadata if isinstance(item, Rule)), None)


def written_name(name: str, field: Any) -> str:
    """Name of a field as users write it: `from` is a word of Python's own."""
    return str(field.alias or name)


def fields_of(model: type[BaseModel]) -> dict[str, Any]:
    """Fields of a model by the names that users write."""
    return {written_name(name, field): field for name, field in model.model_fields.items()}


def rules_of(model: type[BaseModel], prefix: str) -> dict[str, Rule]:
    """Rules of a model's fields and of its sections' fields, by dotted path."""
    rules: dict[str, Rule] = {}
    for name, field in model.model_fields.items():
        path = f"{prefix}.{name}" if prefix else name
        rule = rule_of(field)
        if rule is not None:
            rules[path] = rule
        elif isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel):
            rules |= rules_of(field.annotation, path)
    return rules


def models_at(annotation: Any) -> Models:
    """Models that a value of an annotation is read as: several where its kind tells which."""
    if get_origin(annotation) is Annotated:
        return models_at(get_args(annotation)[0])
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return (annotation,)
    if get_origin(annotation) in (dict, tuple, list):
        return ()
    return tuple(model for inner in get_args(annotation) for model in models_at(inner))


def kind_of(model: type[BaseModel]) -> str:
    """Return the word that a model goes by among others."""
    field = model.model_fields.get("kind")
    return str(get_args(field.annotation)[0]) if field is not None else ""


def _element(annotation: Any) -> Any:
    """Annotation of what a mapping or a list holds."""
    origin, inner = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return _element(inner[0])
    if origin is dict:
        return inner[1]
    return inner[0] if origin in (tuple, list) else None


def all_parts(*roots: type[BaseModel]) -> list[type[BaseModel]]:
    """Every model that values of the roots may consist of, the roots too, each once."""
    found: dict[type[BaseModel], None] = {}
    todo = list(roots)
    while todo:
        model = todo.pop()
        if model not in found:
            found[model] = None
            held = [field.annotation for field in model.model_fields.values()]
            todo += [inner for at in held for inner in models_at(at) or models_at(_element(at))]
    return list(found)


class Place(NamedTuple):
    """A place in a spec."""

    location: Location
    """Keys and indices that lead there, as in the file."""
    models: Models
    """Models as one of which the value there is read; none for a single value."""
    parents: Models
    """Models as one of which the part around it is read."""


def place_of(location: Location, root: Any) -> Place:
    """Place of one of pydantic's locations, which name the kind of a part after its key."""
    at = root
    found: list[str | int] = []
    parents: Models = ()
    for part in location:
        models = models_at(at)
        if len(models) > 1:
            at = next((model for model in models if kind_of(model) == part), None)
            continue
        parents = models
        found.append(part)
        if models:
            field = fields_of(models[0]).get(str(part))
            at = None if field is None else field.annotation
        else:
            at = _element(at)
    return Place(tuple(found), models_at(at), parents)


# Values of sections


def read_as(kind: Any, written: object) -> Any:
    """Read a part by itself as a model or one of several; None where it can't be read."""
    try:
        return _adapter(kind).validate_python(written)
    except ValidationError:
        return None


@cache
def _adapter(kind: Any) -> TypeAdapter[Any]:
    return TypeAdapter(kind)


def leaves(part: BaseModel, path: Key = ()) -> Iterator[tuple[Key, Rule, Any]]:
    """Every value of a part and of the parts in it that is there: its path, rule and SI value."""
    for name, field in type(part).model_fields.items():
        value, key = getattr(part, name), (*path, written_name(name, field))
        rule = KIND if name == "kind" else rule_of(field)
        if rule is not None and value is not None:
            yield key, rule, value
        elif isinstance(value, BaseModel):
            yield from leaves(value, key)
        elif isinstance(value, dict):
            for inner, below in value.items():
                yield from leaves(below, (*key, inner))


def values_of(
    part: BaseModel, path: Key = (), digests: Mapping[str, str] = MappingProxyType({})
) -> dict[str, Any]:
    """SI values of a part at a path by dotted path; of files, their digests where known."""
    return {
        ".".join(key): digests.get(value, value) if isinstance(rule, File) else value
        for key, rule, value in leaves(part, path)
    }


def fill(mapping: dict[str, Any], path: list[str], value: Any) -> bool:
    """Put a value at a path that a mapping lacks; False if it is there."""
    for name in path[:-1]:
        mapping = mapping.setdefault(name, {})
        if not isinstance(mapping, dict):
            return False
    lacking = path[-1] not in mapping
    mapping.setdefault(path[-1], value)
    return lacking


# Identities


def canonical(value: Any) -> Any:
    """Value in the one form that its equals share: whole floats as integers, keys in order."""
    if isinstance(value, Mapping):
        return {str(key): canonical(value[key]) for key in sorted(value)}
    if isinstance(value, list | tuple):
        return [canonical(item) for item in value]
    if isinstance(value, float) and value.is_integer() and abs(value) < 2**53:
        return int(value)
    return value


def digest(identity: Mapping[str, Any]) -> str:
    """Hash of an identity: 128 bits of BLAKE2b over its canonical JSON, in hex."""
    text = json.dumps(
        canonical(identity), separators=(",", ":"), ensure_ascii=True, allow_nan=False
    )
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


# Files that sections name


@dataclass(frozen=True)
class Files:
    """Files named in a spec."""

    base: Path
    """Folder that their paths are relative to; ~ is the user's own."""
    digests: Mapping[str, str] = dataclasses.field(default_factory=dict)
    """Digest of each file by its path as written."""
    time_origin: Decimal = Decimal(0)
    """Time [s] in tables of waypoints that is the flight's 0: the first of the platform's table."""

    def path(self, written: str, digest: Callable[[Path], str] = file_digest) -> Path:
        """Path of a file; a `SceneError` if it has changed since the spec was loaded."""
        path = self.base / os.path.expanduser(written)
        known = self.digests.get(written)
        if known is not None and digest(path) != known:
            raise SceneError(
                path,
                "has changed since the study was declared",
                "bring the old file back, or make another study of the new one",
            )
        return path


def named_files(part: BaseModel) -> Iterator[tuple[Key, File, str]]:
    """Places in a spec that name a file, with their rule and the path written there."""
    for key, rule, value in leaves(part):
        if isinstance(rule, File):
            yield key, rule, value
