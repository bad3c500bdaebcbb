"""Text for axes, legends, tables and captions: names, numbers, and units."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from sweep.messages import number_with_noun as number_with_noun

KILOMETRE_DISPLAY_MEDIAN_MIN = 1000.0
"""Least median of the distances on an axis for which the axis is in km [m]."""

_SYMBOL_BY_UNIT = {"deg": "°", "urad": "µrad", "um": "µm", "us": "µs", "uW": "µW", "m s-1": "m/s"}
"""Symbol in labels of each unit that stores write in another way."""

_DIMENSIONLESS_UNITS = ("", "1")
"""Values of the attribute `units` that stand for pure numbers or for words."""

_SI_PREFIX_BY_EXPONENT = {
    -12: "p",
    -9: "n",
    -6: "µ",
    -3: "m",
    0: "",
    3: "k",
    6: "M",
    9: "G",
    12: "T",
}
"""SI prefix for each exponent of ten."""

_PREFIXABLE_UNITS = ("m", "s", "Hz", "W", "rad", "A", "ohm")
"""Units before which an SI prefix may stand, as in mm."""


class DisplayUnits(NamedTuple):
    """Units in which values are shown."""

    factor: float
    """Factor by which values in stored units are multiplied to give values in displayed units."""
    units: str
    """Name of the displayed units."""


def display_factor_and_units(values: np.ndarray, units: str) -> DisplayUnits:
    """Return the display units for values, and the factor that converts the values to these units.

    Long distances are shown in km, and angles in degrees.
    """
    if units == "m" and values.size and np.median(np.abs(values)) > KILOMETRE_DISPLAY_MEDIAN_MIN:
        return DisplayUnits(1e-3, "km")
    if units == "rad":
        return DisplayUnits(math.degrees(1.0), "deg")
    return DisplayUnits(1.0, units)


def axis_label(name: str, units: str) -> str:
    """Return the label of an axis: its name with units, ``range (km)``."""
    return (
        name if units in _DIMENSIONLESS_UNITS else f"{name} ({_SYMBOL_BY_UNIT.get(units, units)})"
    )


def column_label(name: str, units: str) -> str:
    """Return the label of a table column: its name with units as in stores, ``range [m]``."""
    return name if units in _DIMENSIONLESS_UNITS else f"{name} [{units}]"


def format_quantity(value: object, units: str = "") -> str:
    """Return the text of a value with its unit: ``3.5 km``, ``15°``, ``2^17``."""
    text = str(value) if isinstance(value, str | np.str_) else format_number(float(value))  # type: ignore[arg-type]
    symbol = _SYMBOL_BY_UNIT.get(units, units)
    if units in _DIMENSIONLESS_UNITS:
        return text
    return text + symbol if symbol == "°" else f"{text} {symbol}"


def format_coordinate_value(name: str, value: object, units: str = "") -> str:
    """Return a text with the name and the value of a coordinate: ``grazing angle 15°``."""
    return f"{coordinate_label(name)} {format_quantity(value, units)}"


def format_with_si_prefix(value: float, units: str) -> str:
    """Return a value in SI units as text with an SI prefix: ``25 mm``, ``50 µrad``, ``2 km``."""
    if units in _DIMENSIONLESS_UNITS or units not in _PREFIXABLE_UNITS or value == 0:
        return format_quantity(value, units)
    prefix_exponent = min(max(3 * math.floor(math.log10(abs(value)) / 3 + 1e-12), -12), 12)
    return f"{value / 10.0**prefix_exponent:.6g} {_SI_PREFIX_BY_EXPONENT[prefix_exponent]}{units}"


def format_number(value: float) -> str:
    """Return a number as text with up to six digits; powers of two from 1024 become ``2^n``."""
    if value >= 1024 and value == int(value) and int(value).bit_count() == 1:
        return f"2^{int(math.log2(value))}"
    return f"{value:.6g}"


def coordinate_label(name: str) -> str:
    """Return the name of a coordinate in words: ``grazing angle`` for ``grazing_angle``."""
    return {"tnr": "TNR", "fft_size": "FFT size"}.get(name, name.replace("_", " "))


def join_sentences(phrases: list[str]) -> str:
    """Return a text in which each phrase has become a sentence; empty phrases are skipped."""
    return " ".join(part[0].upper() + part[1:].rstrip(".") + "." for part in phrases if part)


def is_categorical(values: np.ndarray) -> bool:
    """Return True if the values of a coordinate are words, not numbers."""
    return values.dtype.kind not in "fiu"


def describe_value_extent(values: np.ndarray) -> str:
    """Return a text with the lowest, the median and the highest finite value of an array.

    Without finite values the text says that no value is known.
    """
    finite_values = values[np.isfinite(values)]
    if not finite_values.size:
        return "no value is known"
    low, median, high = (f"{q:.3g}" for q in np.quantile(finite_values, [0, 0.5, 1]))
    return f"lowest {low}, median {median}, highest {high}"


def source_note(attributes: Mapping[Any, Any], counted_unit: str) -> str:
    """Return a text on a picture's origin: study, model version, and progress if not complete.

    `attributes` are those of the store. `counted_unit` is the unit of progress: ``points`` or
    ``blocks``.
    """
    note = (
        f"study '{attributes['title']}', {attributes['study_id'][:8]}, "
        f"model {attributes['model_version']}"
    )
    n_done, n_total = attributes[f"{counted_unit}_committed"], attributes[counted_unit]
    return (
        note if n_done >= n_total else f"{note}: {n_done:,} of {n_total:,} {counted_unit} computed"
    )
