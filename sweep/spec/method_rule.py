"""The rule for detectors and estimators: one of the program's own, or a function of the user's."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

from sweep.spec.mistakes import near_miss
from sweep.spec.rules import Rule
from sweep.units import QuantityError

_FUNCTION = r"[A-Za-z_][A-Za-z0-9_]*(\.[A-Za-z_][A-Za-z0-9_]*)*:[A-Za-z_][A-Za-z0-9_]*"


@dataclass(frozen=True, kw_only=True)
class Method(Rule):
    """One of several words, or ``module:function``, which reading does not import.

    Parameters
    ----------
    options : tuple of str
        The words.
    """

    options: tuple[str, ...]

    def read(self, written: object) -> str:
        """The word or the function's name."""
        if isinstance(written, str) and (written in self.options or is_function(written)):
            return written
        rule = f"must be one of {', '.join(self.options)}, or a function as module:function"
        raise QuantityError(rule, near_miss(str(written), self.options))

    def schema(self) -> dict[str, Any]:
        """JSON Schema: the words, or a function's name."""
        return {
            "description": self.about,
            "anyOf": [
                {"type": "string", "enum": list(self.options)},
                {"type": "string", "pattern": f"^{_FUNCTION}$"},
            ],
        }


def is_function(name: str) -> bool:
    """Whether a method's name is that of a function of the user's."""
    return re.fullmatch(_FUNCTION, name) is not None
