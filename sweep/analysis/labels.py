"""Words and units for axes, legends and captions."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from sweep.messages import counted as counted

LONG_RANGE = 1000.0
"""Median of distances [m] from which on they are shown in km."""

_SYMBOLS = {"deg": "°", "urad": "µrad", "um": "µm", "us": "µs", "uW": "µW", "m s-1": "m/s"}
_UNITLESS = ("", "1")
_PREFIXES = {-12: "p", -9: "n", -6: "µ", -3: "m", 0: "", 3: "k", 6: "M", 9: "G", 12: "T"}
_TAKE_PREFIXES = ("m", "s", "Hz", "W", "rad", "A", "ohm")


def shown_in(values: np.ndarray, units: str) -> tuple[float, str]:
    """Factor and units in which a reader wants values: long distances in km, angles in degrees."""
    if units == "m" and values.size and np.median(np.abs(values)) > LONG_RANGE:
        return 1e-3, "km"
    if units == "rad":
        return math.degrees(1.0), "deg"
    return 1.0, units


def with_units(name: str, units: str) -> str:
    """Name of an axis with its units: ``range (km)``."""
    return name if units in _UNITLESS else f"{name} ({_SYMBOLS.get(units, units)})"


def with_brackets(name: str, units: str) -> str:
    """Name of a column with its units as stores have them: ``range [m]``."""
    return name if units in _UNITLESS else f"{name} [{units}]"


def quantity(value: object, units: str = "") -> str:
    """Return a value with its unit: ``3.5 km``, ``15°``, ``2^17``."""
    text = str(value) if isinstance(value, str | np.str_) else number(float(value))  # type: ignore[arg-type]
    symbol = _SYMBOLS.get(units, units)
    if units in _UNITLESS:
        return text
    return text + symbol if symbol == "°" else f"{text} {symbol}"


def valued(name: str, value: object, units: str = "") -> str:
    """Return a coordinate with a value of it: ``grazing angle 15°``."""
    return f"{coordinate(name)} {quantity(value, units)}"


def prefixed(value: float, units: str) -> str:
    """Format a value in SI units with a prefix: ``25 mm``, ``50 µrad``, ``2 km``."""
    if units in _UNITLESS or units not in _TAKE_PREFIXES or value == 0:
        return quantity(value, units)
    power = min(max(3 * math.floor(math.log10(abs(value)) / 3 + 1e-12), -12), 12)
    return f"{value / 10.0**power:.6g} {_PREFIXES[power]}{units}"


def number(value: float) -> str:
    """Return a number in few digits; large powers of two as such."""
    if value >= 1024 and value == int(value) and int(value).bit_count() == 1:
        return f"2^{int(math.log2(value))}"
    return f"{value:.6g}"


def coordinate(name: str) -> str:
    """Return a coordinate's name in words."""
    return {"tnr": "TNR", "fft_size": "FFT size"}.get(name, name.replace("_", " "))


def joined(parts: list[str]) -> str:
    """Parts of a caption as sentences, empty ones left out."""
    return " ".join(part[0].upper() + part[1:].rstrip(".") + "." for part in parts if part)


def is_words(values: np.ndarray) -> bool:
    """Tell whether a coordinate's values are words."""
    return values.dtype.kind not in "fiu"


def extent(values: np.ndarray) -> str:
    """Lowest, median and highest of values."""
    finite = values[np.isfinite(values)]
    if not finite.size:
        return "no value is known"
    low, middle, high = (f"{q:.3g}" for q in np.quantile(finite, [0, 0.5, 1]))
    return f"lowest {low}, median {middle}, highest {high}"


def source(attributes: Mapping[Any, Any], unit: str) -> str:
    """Words at a picture's foot: its study, and how much of that is computed."""
    note = (
        f"study '{attributes['title']}', {attributes['study_id'][:8]}, "
        f"model {attributes['model_version']}"
    )
    done, number = attributes[f"{unit}_committed"], attributes[unit]
    return note if done >= number else f"{note}: {done:,} of {number:,} {unit} computed"
