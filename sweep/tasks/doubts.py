"""Warnings before a study runs: valid settings that are probably mistakes.

The command prints them; in Python they are warnings of the category `StudyWarning`.
"""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

from sweep.messages import is_command
from sweep.spec import SceneSpec
from sweep.spec.grid_rules import too_narrow
from sweep.spec.noise_alarms import warnings_of_alarms
from sweep.tasks.coverage import coverage, refuse_blind
from sweep.tasks.echoes import warnings_of
from sweep.tasks.eyepoint_study import beneath, world_of

if TYPE_CHECKING:
    from sweep.spec import Spec
    from sweep.tasks.flight_study import FlightStudy
    from sweep.tasks.grid_study import GridStudy

_PACKAGE = os.path.dirname(os.path.dirname(os.path.abspath(__file__))) + os.sep


class StudyWarning(UserWarning):
    """Warning about a study that can be computed, but is probably not what was meant."""


def doubts_of_spec(spec: Spec | SceneSpec) -> Iterator[str]:
    """Yield what is doubtful of a study's beam, scene, path and threshold.

    Raises
    ------
    SceneError
        The flight sees nothing.
    """
    if narrow := too_narrow(spec.parameters_off_axes(), spec.axes):
        yield narrow
    if isinstance(spec, SceneSpec):
        yield from world_of(spec).warnings
        if path := beneath(spec):
            yield path
        refuse_blind(spec)
        yield from coverage(spec).warnings()
    yield from warnings_of_alarms(spec)


def doubts_of_results(study: GridStudy | FlightStudy) -> Iterator[str]:
    """Yield warnings about late or ambiguous echoes, and about disabled effects that matter."""
    yield from warnings_of(study)
    if "off" in study.spec.modes().values():
        from sweep.tasks.plan import effects_table

        yield from effects_table(study, costs=False).warnings()


def tell_doubts(study: GridStudy | FlightStudy, say: Callable[[str], None]) -> None:
    """Tell each doubt of a study, and then errors that it does not state.

    Doubts are a `StudyWarning` each, at the line of the caller's program; the command says them.
    Errors that are not stated are said as notes.
    """
    level, frame = 1, sys._getframe()
    while frame.f_back is not None and frame.f_code.co_filename.startswith(_PACKAGE):
        level, frame = level + 1, frame.f_back
    for doubts in (doubts_of_spec(study.spec), doubts_of_results(study)):
        for doubt in doubts:
            if is_command():
                say(f"warning: {doubt}")
            else:
                issue_warning(doubt, level + 1)
    for sentence in study.spec.unstated_errors():
        say(f"note: {sentence}")


def issue_warning(doubt: str, level: int) -> None:
    """Issue a `StudyWarning` at a frame's line; only a filter of the user's raises it.

    A standard error that is closed or broken ends no computation.
    """
    try:
        warnings.warn(doubt, StudyWarning, stacklevel=level)
    except StudyWarning:
        raise
    except Exception:  # what writing to the user's own `sys.stderr` or `showwarning` raises
        pass
