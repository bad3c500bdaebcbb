"""What a scene study's geometry consists of, by content."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pydantic import BaseModel

from sweep.spec.fields import leaves
from sweep.spec.grounds import OPTICAL
from sweep.spec.list_rules import File
from sweep.spec.motion import Platform
from sweep.spec.scene_sections import Scene


def leaf_values(part: BaseModel, digests: Mapping[str, str]) -> dict[str, Any]:
    """SI values of a part by dotted path; of files, their digests."""
    return {
        ".".join(path): digests.get(value, value) if isinstance(rule, File) else value
        for path, rule, value in leaves(part)
    }


def geometry_of(
    scene: Scene, platform: Platform, scanner: BaseModel, digests: Mapping[str, str]
) -> dict[str, Any]:
    """What a flight over a scene sees through one scanner: all but the beams' own shape.

    Objects count by their place in the scene, which is where their surfaces' numbers come from,
    and not by name.
    """
    places = {name: place for place, name in enumerate(scene.objects)}
    return {
        "objects": [
            _object_geometry(leaf_values(thing, digests), places)
            for thing in scene.objects.values()
        ],
        "origin": places.get(scene.origin, -1),
        "platform": leaf_values(platform, digests),
        "scanner": leaf_values(scanner, digests),
    }


def _object_geometry(values: Mapping[str, Any], places: Mapping[str, int]) -> dict[str, Any]:
    """What rays meet of an object: no reflectance, and the ground that it stands on by place."""
    kept = {path: v for path, v in values.items() if path.rsplit(".", 1)[-1] not in OPTICAL}
    return kept | ({"on": places[kept["on"]]} if "on" in kept else {})
