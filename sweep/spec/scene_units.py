"""Units of a scene's fields, by name: one name has one unit wherever it stands."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from types import MappingProxyType

from sweep.spec.fields import rule_of, written_name
from sweep.spec.motion import Platform
from sweep.spec.scanners import AnyScanner
from sweep.spec.scene_sections import Navigation, Scene, SceneDraws, SceneStorage
from sweep.spec.structure import Models, all_parts, models_at

ROOTS: Models = (Scene, Platform, Navigation, SceneDraws, SceneStorage, *models_at(AnyScanner))


def units_by_name() -> Iterator[tuple[str, str]]:
    """Name and SI unit of every field, as often as it is there."""
    for model in all_parts(*ROOTS):
        for name, field in model.model_fields.items():
            rule = rule_of(field)
            if rule is not None:
                yield written_name(name, field), rule.units


@cache
def scene_units() -> MappingProxyType[str, str]:
    """SI unit of every field by its name."""
    return MappingProxyType(dict(units_by_name()))
