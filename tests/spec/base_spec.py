"""Specs as users write them, to be spoilt one field at a time."""

import copy
from typing import Any

import numpy as np

from sweep.model.effects.catalogue import EFFECT_PARAMETERS
from sweep.spec.axes import remove_fields_on_axes
from sweep.spec.sections import default_value, parameter_rules

BASE_SPEC: dict[str, Any] = {
    "title": "A study",
    "instrument": {
        "laser": {"wavelength": "1550 nm", "power": "1 W", "beam_divergence": "50 urad"},
        "chirp": {"bandwidth": "1 GHz", "start_frequency": "5.5 GHz", "duration": "500 us"},
        "telescope": {"aperture": "25 mm", "coupling": "aperture"},
        "receiver": {
            "responsivity": "1.1 A/W",
            "detector_bandwidth": "400 MHz",
            "optical_passband": "25 nm",
            "noise_equivalent_power": "5 pW/rtHz",
            "transimpedance": "7 kohm",
            "amplifier_bandwidth": "400 MHz",
            "amplifier_noise_current": "25 nA",
        },
        "processing": {"sample_rate": "600 MHz", "fft_size": "2^17", "tnr": 10},
    },
    "target": {"range": "2 km", "grazing_angle": "90 deg", "reflectance": 0.1},
    "footprint": {"speckle": "none"},
}


def changed_spec(changes: dict[str, Any] | None = None, **sections: Any) -> dict[str, Any]:
    """The base study with changes by dotted path (`...` removes) and sections added."""
    mapping = copy.deepcopy(BASE_SPEC) | sections
    for path, value in (changes or {}).items():
        *parents, name = path.split(".")
        parent_section = mapping
        for parent in parents:
            parent_section = parent_section.setdefault(parent, {})
        if value is ...:
            parent_section.pop(name)
        else:
            parent_section[name] = value
    return remove_fields_on_axes(mapping)


def required_values(path: str) -> dict[str, Any]:
    """Values of other fields that the requirements of an effect's parameter ask for, by path."""
    values = {}
    for parameter in EFFECT_PARAMETERS:
        for requirement in parameter.requirements if parameter.path == path else ():
            default = default_value(requirement.other_path)
            if default is None or not requirement.is_broken_by(default):
                continue
            rule = parameter_rules()[requirement.other_path]
            values[requirement.other_path] = next(
                value
                for value in (*getattr(rule, "options", ()), rule.example)
                if not requirement.is_broken_by(rule.read(value))
            )
    return values


def axis_member_content(member: Any) -> tuple[Any, ...]:
    """All that a parameter along an axis holds."""
    return (
        member.path, member.coordinate_name, member.units, np.asarray(member.values).tolist(),
        member.display_values.tolist(),
    )  # fmt: skip
