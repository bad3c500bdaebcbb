"""Scene studies as users write them, to be spoilt one field at a time."""

import copy
from typing import Any

from base_spec import BASE_SPEC as GRID_SPEC

from sweep.spec.axes import remove_fields_on_axes

PLANE_OBJECT: dict[str, Any] = {"kind": "plane", "size": "2 km", "reflectance": 0.1}
BASE_SCENE: dict[str, Any] = {
    "title": "A flight",
    "instrument": GRID_SPEC["instrument"],
    "scene": {"origin": "ground", "objects": {"ground": PLANE_OBJECT}},
    "platform": {
        "path": {
            "kind": "straight",
            "from": ["0 m", "0 m", "500 m"],
            "to": ["0 m", "0 m", "100 m"],
            "initial_speed": "60 m/s",
            "final_speed": "20 m/s",
        }
    },
    "scanners": {"three": {"kind": "cone", "beams": 3, "half_angle": "20 deg", "rate": "2 Hz"}},
    "footprint": {"beamlets": 7, "speckle": "none"},
}
"""A plane under a lidar that descends for 10 s."""

BOX_OBJECT: dict[str, Any] = {"kind": "box", "size": ["2 m", "4 m", "6 m"], "reflectance": 0.5}
SPHERE_OBJECT: dict[str, Any] = {
    "kind": "sphere",
    "radius": "1 m",
    "reflectance": 1,
    "position": ["0 m", "9 m", "3 m"],
}
TREES_OBJECT: dict[str, Any] = {
    "kind": "trees",
    "on": "ground",
    "radius": "10 m",
    "number": 2,
    "leaf": {"reflectance": 0.4},
    "trunk": {"reflectance": 0.2},
}
BOULDERS_OBJECT: dict[str, Any] = {
    "kind": "boulders",
    "on": "ground",
    "law": {"kind": "martian_rocks", "abundance": "5 %"},
    "smallest": "0.5 m",
    "largest": "2 m",
    "within": "50 m",
    "reflectance": 0.2,
}
HILLS_OBJECT: dict[str, Any] = {
    "kind": "hills",
    "size": "100 m",
    "spacing": "2 m",
    "rms_height": "1 m",
    "correlation_length": "20 m",
    "reflectance": 0.1,
}
RELIEF_OBJECT: dict[str, Any] = {
    "kind": "relief",
    "size": "100 m",
    "spacing": "2 m",
    "hurst": 0.8,
    "rms_slope": 0.1,
    "baseline": "10 m",
    "reflectance": 0.1,
}


def changed_scene(changes: dict[str, Any] | None = None, **sections: Any) -> dict[str, Any]:
    """The flight with changes by dotted path (`...` removes) and sections added."""
    mapping = copy.deepcopy(BASE_SCENE) | copy.deepcopy(sections)
    for path, value in (changes or {}).items():
        *parents, name = path.split(".")
        parent_section: Any = mapping
        for parent in parents:
            parent_section = parent_section.setdefault(parent, {})
        if value is ...:
            parent_section.pop(name)
        else:
            parent_section[name] = copy.deepcopy(value)
    return remove_fields_on_axes(mapping)


def scene_with_object(
    scene_object: dict[str, Any], name: str = "thing", **fields: Any
) -> dict[str, Any]:
    """The flight with one object more."""
    return changed_scene({f"scene.objects.{name}": scene_object | fields})


SPIN_MOTION = {
    "path": {"kind": "still", "position": ["0 m", "0 m", "9 m"]},
    "attitude": {"kind": "spin", "angular_velocity": ["1 deg/s", "0 deg/s", "0 deg/s"]},
}
SCENE_WITH_EVERYTHING = changed_scene(
    {
        "scene.objects.ground": RELIEF_OBJECT
        | {
            "relief": {"hurst": 0.5, "rms_slope": 0.1, "baseline": "5 m"},
            "craters": {"smallest": "9 m", "largest": "30 m", "equilibrium_diameter": "20 m"},
            "smoothing": "3 m",
            "factor": 2,
        },
        "scene.objects.forest": TREES_OBJECT,
        "scene.objects.rocks": BOULDERS_OBJECT | {"within": "20 m"},
        "scene.objects.ball": SPHERE_OBJECT | {"rotation": {"quaternion": [1, 0, 0, 0.5]}},
        "scene.objects.crate": BOX_OBJECT | {"motion": SPIN_MOTION},
        "platform.jitter": "10 urad",
        "platform.mounting": {"pitch": "1 deg"},
        "platform.lever_arm": ["1 m", "0 m", "0 m"],
    },
    axes={"instrument.laser.power": ["0.1 W", "1 W"]},
)
"""A study with something of everything that names no file."""
