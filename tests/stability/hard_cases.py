"""Registry of what is numerically hard: each case, what it is held against and how close it comes.

A family is a module of cases. A case is a function that returns the worst error it finds; its
decorator says what is hard about it, against what the error is taken, what is allowed, and where
float64's own limit lies. `test_stability.py` holds every case to what it allows, and
`stability_table.py` writes docs/stability.md from the same registry.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

EPS = sys.float_info.epsilon
"""Distance from 1 to the next float64; half of it is the error of one rounding."""

FAMILY_MODULES = (
    "hard_marcum", "hard_probabilities", "hard_beats", "hard_sidelobes", "hard_geometry",
    "hard_radiometry", "hard_sizes", "hard_units", "hard_meshes", "hard_statistics",
)  # fmt: skip
"""Families in the order in which the page shows them."""


@dataclass(frozen=True)
class Case:
    """One hard case."""

    difficulty: str
    reference: str
    """Against what the error is taken."""
    measure: str
    """Of what it is an error."""
    allowed: float
    """Largest error with which the case is met."""
    limit: float
    """Error that float64 alone can make, estimated as `because` says."""
    because: str
    is_slow: bool
    """Longer than the fast suite allows."""
    reference_file: Path | None
    """File with reference values, without which the case cannot be looked at."""
    worst_error: Callable[[], float]
    """Gives the worst error."""


@dataclass
class Family:
    """Cases about one part of the model."""

    title: str
    description: str
    cases: list[Case] = field(default_factory=list)

    def case(
        self,
        difficulty: str,
        *,
        is_slow: bool = False,
        reference_file: Path | None = None,
        **fields: Any,
    ) -> Callable[[Callable[[], float]], Callable[[], float]]:
        """Decorator that registers a function that returns its worst error."""

        def register(worst_error: Callable[[], float]) -> Callable[[], float]:
            self.cases.append(
                Case(
                    difficulty,
                    is_slow=is_slow,
                    reference_file=reference_file,
                    worst_error=worst_error,
                    **fields,
                )
            )
            return worst_error

        return register


def families() -> list[Family]:
    """Every family with its cases."""
    return [importlib.import_module(name).FAMILY for name in FAMILY_MODULES]
