"""Requirements of the effects' parameters on other parameters of a spec.

A requirement excludes combinations of values that a spec must not state, such as a number of bits
without a full scale. :mod:`sweep.spec.grid_checks` evaluates the requirements of all effects.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

ValueCondition = Callable[[Any], Any]
"""Function that maps a parameter's values (n,) to bool (n,): True where a condition is met."""


class ParameterRequirement(NamedTuple):
    """Requirement of one parameter on another: values of one exclude values of the other."""

    other_path: str
    """Dotted path of the required parameter."""
    is_broken_by: ValueCondition
    """Condition that values of the required parameter meet if they break the requirement."""
    problem: str
    """Text of the finding: the end of a sentence about the parameter that has the requirement."""
    remedy: str
    """Text of the remedy, as an imperative clause."""
    applies_to: ValueCondition | None = None
    """Condition on the values of the parameter for which the requirement applies. None: it applies
    to all values but the default."""
    applies_if_forced_on: bool = False
    """True if the requirement applies, at any value of the parameter, when its effect is ``on``."""


def condition_equal_to(expected: str | float) -> ValueCondition:
    """Return the condition that values equal `expected`."""
    return lambda values: values == expected


def condition_different_from(unwanted: str | float) -> ValueCondition:
    """Return the condition that values differ from `unwanted`."""
    return lambda values: values != unwanted


def is_positive(values: np.ndarray) -> np.ndarray:
    """Return a mask (n,) of values above 0."""
    return values > 0


def is_zero(values: np.ndarray) -> np.ndarray:
    """Return a mask (n,) of values equal to 0."""
    return values == 0


def exceeds_one(values: np.ndarray) -> np.ndarray:
    """Return a mask (n,) of values above 1."""
    return values > 1


def positive_value_requirement(
    other_path: str, applies_to: ValueCondition | None = None
) -> ParameterRequirement:
    """Return the requirement that another parameter is not 0.

    Parameters
    ----------
    other_path : str
        Dotted path of the other parameter.
    applies_to : callable, optional
        Condition on the values (n,) of the parameter that has the requirement, which returns True
        (n,) where the requirement applies. By default it applies to all values but the parameter's
        default.

    Returns
    -------
    ParameterRequirement
    """
    return ParameterRequirement(
        other_path,
        is_zero,
        f"needs {other_path}, which is 0",
        f"set {other_path}",
        applies_to=applies_to,
    )
