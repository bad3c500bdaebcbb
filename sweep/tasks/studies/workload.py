"""Requirements of a spec's study on machines: workers, and the user's Python modules."""

from __future__ import annotations

from dataclasses import dataclass

from sweep.spec import GridSpec, SceneSpec
from sweep.spec.sections import Execution
from sweep.tasks.engine.block_study import StudyReader
from sweep.tasks.studies import study_loading, user_function_names


@dataclass(frozen=True)
class SpecWorkload:
    """Requirements of a spec's study on machines, as `block_study.Workload` declares them."""

    spec: GridSpec | SceneSpec

    @property
    def execution(self) -> Execution:
        """Section `execution` of the spec: workers, threads and scheduler."""
        return self.spec.execution

    @property
    def user_module_names(self) -> tuple[str, ...]:
        """Names of the modules of the user's detectors and estimators."""
        return user_function_names.user_module_names(self.spec)

    @property
    def read_study(self) -> StudyReader:
        """Function with which a worker reads the study from its store."""
        return study_loading.read_study
