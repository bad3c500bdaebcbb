"""The tree of sections and fields that a spec may have, walked along a mistake's location."""

from __future__ import annotations

from typing import Annotated, Any, NamedTuple, get_args, get_origin

from pydantic import BaseModel

from sweep.spec.fields import written_name
from sweep.spec.mistakes import Location

Models = tuple[type[BaseModel], ...]


class Place(NamedTuple):
    """A place in a spec."""

    location: Location
    """Keys and indices that lead there, as in the file."""
    models: Models
    """What stands there is read as one of these; none for a single value."""
    parents: Models
    """What it stands in is read as one of these."""


def place_of(location: Location, root: type[BaseModel]) -> Place:
    """Place of one of pydantic's locations, which name the kind of a part after its key."""
    at: Any = root
    found: list[str | int] = []
    parents: Models = ()
    for part in location:
        models = models_at(at)
        if len(models) > 1:
            at = next((model for model in models if kind_of(model) == part), None)
            continue
        parents = models
        found.append(part)
        at = _field(models[0], part) if models else _element(at)
    return Place(tuple(found), models_at(at), parents)


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
    """The word that a model goes by among others."""
    field = model.model_fields.get("kind")
    return str(get_args(field.annotation)[0]) if field is not None else ""


def fields_of(model: type[BaseModel]) -> list[str]:
    """Names of a model's fields, as users write them."""
    return [written_name(name, field) for name, field in model.model_fields.items()]


def field_named(model: type[BaseModel], name: str | int) -> Any:
    """Field that users call by a name; None where there is none."""
    for own, field in model.model_fields.items():
        if written_name(own, field) == name:
            return field
    return None


def _field(model: type[BaseModel], name: str | int) -> Any:
    """Annotation of the field that users call by a name."""
    field = field_named(model, name)
    return None if field is None else field.annotation


def _element(annotation: Any) -> Any:
    """Annotation of what a mapping or a list holds."""
    origin, inner = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return _element(inner[0])
    if origin is dict:
        return inner[1]
    return inner[0] if origin in (tuple, list) else None


def below(field: Any) -> Models:
    """Models of which a field's value consists: one, one of several, or those it holds."""
    return models_at(field.annotation) or models_at(_element(field.annotation))


def all_parts(*roots: type[BaseModel]) -> list[type[BaseModel]]:
    """Every model that values of the roots may consist of, the roots too, each once."""
    found: dict[type[BaseModel], None] = {}
    todo = list(roots)
    while todo:
        model = todo.pop()
        if model not in found:
            found[model] = None
            todo += [inner for field in model.model_fields.values() for inner in below(field)]
    return list(found)
