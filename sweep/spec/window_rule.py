"""The rule for names of window functions."""

from __future__ import annotations

import re
import warnings
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from sweep.spec.mistakes import near_miss
from sweep.spec.rules import Rule
from sweep.units import QuantityError

# Windows that need no look at scipy, which is slow to import; all others are put to it.
_WINDOWS = (
    "hamming",
    "hann",
    "blackman",
    "blackmanharris",
    "nuttall",
    "flattop",
    "rectangular",
)
_WINDOW_ALIASES = {"boxcar": "rectangular", "rect": "rectangular", "hanning": "hann"}
_SCIPY_WINDOWS = (
    "barthann",
    "bartlett",
    "bohman",
    "chebwin",
    "cosine",
    "dpss",
    "exponential",
    "gaussian",
    "general_gaussian",
    "general_hamming",
    "kaiser",
    "lanczos",
    "parzen",
    "taylor",
    "triang",
    "tukey",
)
_WINDOW = re.compile(r"(?P<name>[a-z_]{1,40})\s*(?:\((?P<parameters>[-+.,eE\d\s]*)\))?")


@dataclass(frozen=True, kw_only=True)
class Window(Rule):
    """Name of a window function, with its parameters: ``hamming``, ``kaiser(8.6)``."""

    def read(self, written: object) -> str:
        """Window in one spelling."""
        match = _WINDOW.fullmatch(written.strip().lower()) if isinstance(written, str) else None
        if match is None:
            raise QuantityError(
                "must be the name of a window", "write e.g. 'hamming' or 'kaiser(8.6)'"
            )
        name = _WINDOW_ALIASES.get(match["name"], match["name"])
        inside = match["parameters"]
        if name in _WINDOWS and inside is None:
            return name
        try:
            parameters = [float(text) for text in inside.split(",")] if inside else []
        except ValueError:
            raise QuantityError(
                "has parameters that are no numbers", "write e.g. 'kaiser(8.6)'"
            ) from None
        _try_window(name, tuple(parameters))
        return f"{name}({','.join(map(repr, parameters))})" if parameters else name

    def schema(self) -> dict[str, Any]:
        """JSON Schema: a word, parameters in brackets."""
        return {
            "description": self.about,
            "type": "string",
            "pattern": r"^\s*[A-Za-z_]+\s*(\([-+.,eE0-9\s]*\))?\s*$",
            "examples": ["hamming", "hann", "rectangular", "kaiser(8.6)"],
        }


@lru_cache(maxsize=256)
def _try_window(name: str, parameters: tuple[float, ...]) -> None:
    """A try at making the window with scipy.

    Raises
    ------
    QuantityError
        Where scipy knows no such window or refuses its parameters.
    """
    from scipy.signal import get_window  # slow to import, and seldom needed

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            values = get_window((name, *parameters) if parameters else name, 16)
    except UserWarning:
        rule = "has parameters that make it unsuitable for spectral analysis"
        raise QuantityError(rule, "take others, for chebwin 45 or more") from None
    except RuntimeWarning:  # samples beyond what a number can be
        raise QuantityError("has parameters that make no usable window") from None
    except (ValueError, TypeError, ArithmeticError, MemoryError):
        known = name in _WINDOWS or name in _SCIPY_WINDOWS
        if known:
            raise QuantityError(
                "has parameters that this window does not take", "write e.g. 'kaiser(8.6)'"
            ) from None
        suggestion = near_miss(name, _WINDOWS + _SCIPY_WINDOWS, otherwise="write e.g. 'hamming'")
        raise QuantityError("is no periodic window that scipy.signal makes", suggestion) from None
    if not np.all(np.isfinite(values)) or not np.sum(values) > 0:
        raise QuantityError("has parameters that make no usable window")
