"""What figures can show of shots and of points: names in words, units, and how to colour them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sweep.analysis import labels
from sweep.model.outputs import CYCLES, POINTS, SHOTS, STATISTICS, XYZ
from sweep.model.pairing import FLAGS

QUANTISED, INTERPOLATED = "quantised", "interpolated"

_BY_RANGES = {
    name: f"{name}_interpolated"
    for name in ("range", "radial_velocity", "range_standard_error",
                 "radial_velocity_standard_error")
}  # fmt: skip
_BY_RANGES |= {
    f"{name}_standard_error": f"{name}_interpolated_standard_error"
    for name in ("range", "radial_velocity")
}

CATEGORIES = ("beam", "surface", "flags")
"""Quantities whose values are names rather than amounts."""

SIGNED = ("radial_velocity", "beam_radial_velocity", "true_radial_velocity")
"""Velocities, whose sign is shown."""

DECIBELS = ("snr", "snr_up")
"""Ratios of powers, which are shown in decibels."""

WIDE = ("pfa_up", "pfa_down")
"""Quantities that go over orders of magnitude, and are above 0."""

KINDS = {name: bit for name, bit in FLAGS.items() if name != "unconfirmed"}
"""Flags of which a point has exactly one."""


@dataclass(frozen=True)
class Quantity:
    """A quantity of each shot or of each point."""

    name: str
    words: str
    units: str
    of_points: bool


def _listed() -> dict[str, Quantity]:
    found = {}
    for table, of_points in ((SHOTS, False), (STATISTICS, False), (POINTS, True)):
        for name, output in table.items():
            if XYZ not in output.dims:
                found[name] = Quantity(name, output.long_name, output.units, of_points)
    plain = {
        "range": "range", "radial_velocity": "radial velocity", "snr": "signal-to-noise ratio",
        "pd": "probability of detection", "time": "time", "beam": "beam", "surface": "surface",
    }  # fmt: skip
    for name, words in plain.items():
        found[name] = Quantity(name, words, found[name].units, found[name].of_points)
    altitude = CYCLES["true_altitude"]
    derived = [Quantity("altitude", "altitude above ground", altitude.units, False)]
    derived += [Quantity(axis, axis, "m", True) for axis in "xyz"]
    derived += [Quantity("shot", "number of the shot", "1", False)]
    return found | {quantity.name: quantity for quantity in derived}


QUANTITIES = _listed()
"""Every quantity by its name."""


def stored_name(name: str, ranges: str) -> str:
    """Array that holds a quantity by whole bins, or interpolated between them."""
    return _BY_RANGES.get(name, name) if ranges == INTERPOLATED else name


def label(name: str) -> str:
    """A quantity in words with the units in which it is shown."""
    about = QUANTITIES[name]
    return labels.with_units(about.words, "dB" if name in DECIBELS else about.units)


def shown(name: str, values: np.ndarray) -> np.ndarray:
    """Values as they are shown: decibels of ratios, and of flags which kind of point they say."""
    values = np.asarray(values)
    if name == "flags":
        return np.asarray(kinds(values.astype(int)), float)
    if name in DECIBELS:
        known = values > 0
        return np.where(known, 10 * np.log10(np.where(known, values, 1.0)), np.nan)
    return values.astype(float)


def kinds(flags: np.ndarray) -> np.ndarray:
    """Which of KINDS each point's flags say, as an index; -1 where there is no point."""
    found = np.full(np.shape(flags), -1)
    for i, bit in enumerate(KINDS.values()):
        found[(flags & bit) > 0] = i
    return found
