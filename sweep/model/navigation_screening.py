"""Search of measurement cycles for one beam that contradicts the others: a false alarm."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

SOLVED = 0
"""All valid beams are in the solution."""
EXCLUDED = 1
"""All but one, which contradicts the others."""
WITHHELD = 2
"""The beams contradict each other and it can not be told which one is false: no solution."""
UNDETERMINED = 3
"""Too few beams, or too near to a plane or a line of them: no solution."""


class Fit(NamedTuple):
    """Least squares of n cycles."""

    solved: np.ndarray
    """(n,) bool: whether there is a solution."""
    chi_square: np.ndarray
    """(n,): weighted sum of squared residuals."""
    degrees: np.ndarray
    """(n,) int64: observations beyond what the solution needs; its expectation."""
    quantities: tuple[np.ndarray, ...]
    """What is solved for, (n, ...) each."""


def screen(
    fit: Callable[[np.ndarray, np.ndarray], Fit], valid: np.ndarray, level: float | None
) -> tuple[Fit, np.ndarray, np.ndarray]:
    """Solutions of n cycles of b beams, with a beam that contradicts the others left out.

    A cycle is suspect where its chi-square exceeds the value that it exceeds with probability
    `level` when all beams are true. Then each beam is left out in turn. Where exactly one such
    fit passes the same test, that beam is false and that fit is the solution. Where several do,
    the false one can not be told and the solution is withheld, as where none does (two false
    beams, or a true one past the test). With one degree of freedom, as for the velocity from
    four beams, every exclusion leaves an exact fit: a false alarm can be noticed there but
    never found.

    Parameters
    ----------
    fit : callable
        Fit of the cycles of index (k,) by the beams of a mask (k, b).
    valid : (n, b) bool ndarray
        Beams that returned anything.
    level : float or None
        Probability that a cycle of true beams is suspect, 0 < . < 1; None: no test.

    Returns
    -------
    Fit, (n, b) bool ndarray, (n,) int8 ndarray
        The solutions, the beams in them and the status.

    Raises
    ------
    ValueError
        `level` is out of range.
    """
    n, b = valid.shape
    used = valid.copy()
    fitted = fit(np.arange(n), used)
    status = np.where(fitted.solved, SOLVED, UNDETERMINED).astype(np.int8)
    if level is None:
        return fitted, used, status
    if not 0 < level < 1:
        raise ValueError(f"the test's level lies between 0 and 1, not {level}")
    most = np.concatenate([[np.inf], chdtri(np.arange(1, b + 1), level)])
    suspect = np.flatnonzero(fitted.solved & (fitted.chi_square > most[fitted.degrees]))
    passes = np.zeros((suspect.size, b), bool)
    for beam in range(b):
        trial = fit(suspect, _without(used[suspect], beam))
        passes[:, beam] = trial.solved & (trial.chi_square <= most[trial.degrees])
    one = passes.sum(axis=1) == 1
    status[suspect] = np.where(one, EXCLUDED, WITHHELD)
    found, culprit = suspect[one], passes[one].argmax(axis=1)
    used[found, culprit] = False
    _replace(fitted, found, fit(found, used[found]))
    return fitted, used, status


def _without(used: np.ndarray, beam: int) -> np.ndarray:
    used = used.copy()
    used[:, beam] = False
    return used


def _replace(whole: Fit, rows: np.ndarray, part: Fit) -> None:
    """Writes some cycles' fits over those of the whole."""
    for old, new in zip((*whole[:3], *whole[3]), (*part[:3], *part[3]), strict=True):
        old[rows] = new
