"""Requirements of a spec on the machines: workers, estimated time, and the user's modules."""

from __future__ import annotations

import math
from dataclasses import dataclass

from sweep.spec import GridSpec, SceneSpec
from sweep.spec.sections import Execution
from sweep.tasks.engine.block_study import StudyReader
from sweep.tasks.studies import study_loading, user_function_names
from sweep.tasks.studies.parameter_grid import worst_cpu_seconds_per_point

#: Upper estimates of the time of a ray, and of one draw of a shot, on one core [s].
CPU_SECONDS_PER_RAY, CPU_SECONDS_PER_SHOT_DRAW = 5e-6, 4e-4


@dataclass(frozen=True)
class SpecWorkload:
    """Requirements of a spec's study on machines, as `block_study.Workload` declares them."""

    spec: GridSpec | SceneSpec

    @property
    def execution(self) -> Execution:
        """Section `execution` of the spec."""
        return self.spec.execution

    @property
    def cpu_seconds(self) -> float:
        """Estimated time of all blocks on one core [s]."""
        return estimate_cpu_seconds(self.spec)

    @property
    def user_module_names(self) -> tuple[str, ...]:
        """Names of the modules of the user's detectors and estimators."""
        return user_function_names.user_module_names(self.spec)

    @property
    def read_study(self) -> StudyReader:
        """Function that reads the study of a store."""
        return study_loading.read_study


def estimate_cpu_seconds(spec: GridSpec | SceneSpec) -> float:
    """Return the approximate time of a study on one core [s].

    It is infinite if a tolerance sets the number of rays.
    """
    n_axis_points = math.prod(int(axis.size) for axis in spec.axes)
    if isinstance(spec, GridSpec):
        return n_axis_points * worst_cpu_seconds_per_point(spec)
    if spec.is_ray_number_set_by_tolerance:
        return math.inf
    n_shots = sum(
        spec.number_of_cycles(scanner) * spec.shots_per_cycle(scanner) for scanner in spec.scanners
    )
    rays_per_shot = float(spec.parameters()["footprint.beamlets"])
    return n_shots * (
        rays_per_shot * CPU_SECONDS_PER_RAY
        + n_axis_points * int(spec.draws.number) * CPU_SECONDS_PER_SHOT_DRAW
    )
