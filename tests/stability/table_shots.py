"""Shots of the instrument of Table 4.1, any of its parameters changed by name."""

from collections.abc import Collection, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.effects.catalogue import CORE, DEFAULTS
from sweep.model.preparation import Shots
from sweep.model.shot import prepare
from sweep.spec import Spec

ROOT = Path(__file__).parents[2]


def study(changes: Mapping[str, Any]) -> dict[str, Any]:
    """A spec of one shot as it is written, with values changed by their dotted path."""
    target = {"range": "2 km", "grazing_angle": "90 deg", "reflectance": 0.1}
    written: dict[str, Any] = {
        "title": "Table 4.1",
        "instrument": {"file": "experiments/instruments/table_4_1.yaml"},
        "target": target | {"radial_velocity": "150 m/s", "reflectance_law": "thesis"},
        "footprint": {"beamlets": 1, "phases": "coherent"},
        "accuracy": {"tolerance": 0},
    }
    for path, value in changes.items():
        *sections, name = path.split(".")
        part = written
        for section in sections:
            part = part.setdefault(section, {})
        part[name] = value
    return written


@cache
def _table_4_1() -> dict[str, Any]:
    return DEFAULTS | Spec.from_mapping(study({}), base=ROOT).parameters_at({})


def parameters(**changes: Any) -> dict[str, Any]:
    """Parameters of Table 4.1, SI, with one beamlet: ``parameters(range=3500.0, power=3.0)``."""
    by_name = {path.rsplit(".", 1)[-1]: path for path in _table_4_1()}
    return _table_4_1() | {by_name[name]: value for name, value in changes.items()}


def shots(effects: Collection[str] = CORE, **changes: Any) -> Shots:
    """One shot of one category."""
    ((_, prepared),) = prepare(parameters(**changes), effects)
    return prepared


def velocity_for(frequency: float, segment: int, **changes: Any) -> float:
    """Radial velocity that puts a segment's beat on a frequency, within rounding."""
    p = parameters(**changes)
    sign = (1, 0, -1)[segment]
    bandwidth = p["instrument.chirp.bandwidth"]
    carrier = SPEED_OF_LIGHT / p["instrument.laser.wavelength"] + bandwidth * (sign < 0)
    delay = 2 * p["target.range"] / SPEED_OF_LIGHT
    range_beat = sign * bandwidth / p["instrument.chirp.duration"] * delay
    return float(np.float64((frequency + range_beat) / (carrier - range_beat) * SPEED_OF_LIGHT / 2))
