"""Plans made quick."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from unittest import mock

from sweep.tasks import eyepoint_study, plan


@contextmanager
def swiftly() -> Iterator[None]:
    """Context in which plans measure each thing once, and maps of scenes are coarse."""
    with (
        mock.patch.object(plan, "MEASURING", 1e-3),
        mock.patch.object(plan, "MEASURING_SCANNER", 1e-3),
        mock.patch.object(eyepoint_study, "NODES", 24),
        mock.patch.object(plan, "COST_POINTS", 1),
        mock.patch.object(plan, "COST_TILES", 1),
        mock.patch.object(plan, "ROUNDS", 1),
    ):
        yield
