"""Plans made quick."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from unittest import mock

from sweep.tasks.studies import eyepoint_study, study_plan


@contextmanager
def fast_planning() -> Iterator[None]:
    """Context in which plans measure each thing once, and maps of scenes are coarse."""
    with (
        mock.patch.object(study_plan, "GRID_TIMING_SECONDS", 1e-3),
        mock.patch.object(study_plan, "FLIGHT_TIMING_SECONDS", 1e-3),
        mock.patch.object(eyepoint_study, "TERRAIN_MAP_LONG_SIDE_NODES", 24),
        mock.patch.object(study_plan, "EFFECT_COST_POINTS_MAX", 1),
        mock.patch.object(study_plan, "EFFECT_COST_TILES_MAX", 1),
        mock.patch.object(study_plan, "EFFECT_COST_ROUNDS_MAX", 1),
    ):
        yield
