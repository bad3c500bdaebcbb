"""Warnings before a study runs: valid settings that are probably mistakes.

The command prints them; in Python they are warnings of the category `StudyWarning`.
"""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

from sweep.messages import is_run_as_command
from sweep.spec import SceneSpec
from sweep.spec.grid_checks import describe_narrow_beam
from sweep.spec.noise_alarms import iter_false_alarm_warnings
from sweep.tasks.studies.echo_warnings import echo_warnings
from sweep.tasks.studies.eyepoint_study import below_surface_warning, get_built_scene
from sweep.tasks.studies.flight_coverage import refuse_flight_without_hits, sample_coverage

if TYPE_CHECKING:
    from sweep.spec import GridSpec
    from sweep.tasks.studies.flight_study import FlightStudy
    from sweep.tasks.studies.grid_study import GridStudy

_TASKS_PACKAGE_FOLDER = os.path.dirname(os.path.dirname(os.path.abspath(__file__))) + os.sep
"""Folder of `sweep.tasks`. Call frames in it are skipped to find the line of the user's program."""


class StudyWarning(UserWarning):
    """Warning about a study that can be computed, but is probably not what was meant."""


def iter_spec_warnings(spec: GridSpec | SceneSpec) -> Iterator[str]:
    """Yield warnings about a study's beam, scene, flight path and threshold, given its spec.

    Raises
    ------
    SceneError
        If none of the flight's sampled beams hits anything.
    """
    if beam_warning := describe_narrow_beam(spec.parameters_off_axes(), spec.axes):
        yield beam_warning
    if isinstance(spec, SceneSpec):
        yield from get_built_scene(spec).warnings
        if path_warning := below_surface_warning(spec):
            yield path_warning
        refuse_flight_without_hits(spec)
        yield from sample_coverage(spec).warnings()
    yield from iter_false_alarm_warnings(spec)


def iter_result_warnings(study: GridStudy | FlightStudy) -> Iterator[str]:
    """Yield warnings about late or ambiguous echoes, and about effects that are off but matter."""
    yield from echo_warnings(study)
    if "off" in study.spec.effect_modes().values():
        from sweep.tasks.studies.study_plan import effects_table

        yield from effects_table(study, costs=False).warnings()


def issue_study_warnings(study: GridStudy | FlightStudy, say: Callable[[str], None]) -> None:
    """Issue the warnings about a study, and pass notes on errors of unstated size to `say`.

    Each warning is a `StudyWarning` at the line of the caller's program. If the command runs, it is
    passed to `say` instead.
    """
    stack_level, frame = 1, sys._getframe()
    while frame.f_back is not None and frame.f_code.co_filename.startswith(_TASKS_PACKAGE_FOLDER):
        stack_level, frame = stack_level + 1, frame.f_back
    for sentences in (iter_spec_warnings(study.spec), iter_result_warnings(study)):
        for sentence in sentences:
            if is_run_as_command():
                say(f"warning: {sentence}")
            else:
                issue_study_warning(sentence, stack_level + 1)
    for unstated_error in study.spec.unstated_error_sentences():
        say(f"note: {unstated_error}")


def issue_study_warning(sentence: str, stack_level: int) -> None:
    """Issue a `StudyWarning` at the line of the frame with a given level of the call stack.

    An exception is raised only if a warning filter of the user turns the warning into one. A closed
    or broken standard error does not end the computation.
    """
    try:
        warnings.warn(sentence, StudyWarning, stacklevel=stack_level)
    except StudyWarning:
        raise
    except Exception:  # a user's own `sys.stderr` or `showwarning` may raise anything
        pass
