"""Specs made small, and plans made quick."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any
from unittest import mock

from spoilt_specs import NOTHING, places, put

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


def shrunk(written: dict[str, Any], fails: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
    """The spec without all that can be left out of it while it still fails alike."""
    smallest = copy.deepcopy(written)
    again = True
    while again:
        again = False
        for path in sorted(places(smallest), key=len):
            try:
                without = put(smallest, path, NOTHING)
            except (KeyError, IndexError, TypeError):
                continue  # what it stood in is gone
            if fails(without):
                smallest, again = without, True
    return smallest
