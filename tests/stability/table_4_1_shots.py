"""Shots of the instrument of Table 4.1, any of its parameters changed by name."""

from collections.abc import Collection, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.effects.catalogue import DEFAULT_EFFECTS, PARAMETER_DEFAULTS
from sweep.model.evaluation import prepare_shots
from sweep.model.preparation import Shots
from sweep.spec import GridSpec

ROOT = Path(__file__).parents[2]


def study_mapping(changes: Mapping[str, Any]) -> dict[str, Any]:
    """A spec of one shot as it is written, with values changed by their dotted path."""
    target = {"range": "2 km", "grazing_angle": "90 deg", "reflectance": 0.1}
    mapping: dict[str, Any] = {
        "title": "Table 4.1",
        "instrument": {"file": "experiments/instruments/table_4_1.yaml"},
        "target": target | {"radial_velocity": "150 m/s", "reflectance_law": "thesis"},
        "footprint": {"beamlets": 1, "phases": "coherent"},
        "accuracy": {"tolerance": 0},
    }
    for path, value in changes.items():
        *sections, name = path.split(".")
        parent_section = mapping
        for section in sections:
            parent_section = parent_section.setdefault(section, {})
        parent_section[name] = value
    return mapping


@cache
def _table_4_1() -> dict[str, Any]:
    return PARAMETER_DEFAULTS | GridSpec.from_mapping(
        study_mapping({}), base=ROOT
    ).parameters_with_overrides({})


def table_4_1_parameters(**changes: Any) -> dict[str, Any]:
    """Parameters of Table 4.1, SI, with one beamlet: ``parameters(range=3500.0, power=3.0)``."""
    path_by_name = {path.rsplit(".", 1)[-1]: path for path in _table_4_1()}
    return _table_4_1() | {path_by_name[name]: value for name, value in changes.items()}


def prepare_shot(effects: Collection[str] = DEFAULT_EFFECTS, **changes: Any) -> Shots:
    """One shot of one category."""
    ((_, prepared),) = prepare_shots(table_4_1_parameters(**changes), effects)
    return prepared


def velocity_for(frequency: float, segment: int, **changes: Any) -> float:
    """Radial velocity that puts a segment's beat on a frequency, within rounding."""
    values = table_4_1_parameters(**changes)
    sign = (1, 0, -1)[segment]
    bandwidth = values["instrument.chirp.bandwidth"]
    carrier = SPEED_OF_LIGHT / values["instrument.laser.wavelength"] + bandwidth * (sign < 0)
    delay = 2 * values["target.range"] / SPEED_OF_LIGHT
    range_beat = sign * bandwidth / values["instrument.chirp.duration"] * delay
    return float(np.float64((frequency + range_beat) / (carrier - range_beat) * SPEED_OF_LIGHT / 2))
