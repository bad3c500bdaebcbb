"""A small study of a scene: a descent over a plain with a ball on it, seen by two scanners."""

from pathlib import Path

from small_studies import STUDY_MAPPING

from sweep.spec import SceneSpec
from sweep.spec.axes import remove_fields_on_axes

SCENE_MAPPING = {
    "title": "Small scene",
    "question": "Does it fly?",
    "instrument": STUDY_MAPPING["instrument"]
    | {"telescope": {"aperture": "50 mm", "coupling": "aperture"}},
    "scene": {
        "origin": "ground",
        "objects": {
            "ground": {"kind": "plane", "size": "3 km", "reflectance": 0.1},
            "stone": {
                "kind": "sphere",
                "radius": "20 m",
                "position": ["150 m", "0 m", "5 m"],
                "reflectance": 0.3,
            },
        },
    },
    "platform": {
        "path": {
            "kind": "straight",
            "from": ["0 m", "0 m", "1500 m"],
            "to": ["0 m", "0 m", "300 m"],
            "initial_speed": "100 m/s",
            "final_speed": "30 m/s",
        },
        "attitude": {"kind": "nadir"},
    },
    "scanners": {
        "three": {"kind": "cone", "beams": 3, "half_angle": "22.5 deg", "rate": "4 Hz"},
        "line": {"kind": "line", "half_angle": "10 deg", "line_rate": "1 Hz", "rate": "8 Hz"},
    },
    "footprint": {"beamlets": 7, "speckle": "none"},
    "draws": {"number": 5, "returns": 3},
    "seed": 3,
    "storage": {"block_shots": 120, "block_draws": 3},
    "axes": {"instrument.laser.power": ["0.01 W", "1 W"]},
}


def small_scene_spec(**changes) -> SceneSpec:
    """The small study of a scene with some of its sections replaced."""
    return SceneSpec.from_mapping(
        remove_fields_on_axes({**SCENE_MAPPING, **changes}), base=Path(".")
    )
