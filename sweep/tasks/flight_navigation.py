"""Navigation of a flight's cycles, from the points of their shots."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from sweep.model.outputs import POINTS, SHOTS
from sweep.tasks.patches import Patch

if TYPE_CHECKING:
    from sweep.spec import SceneSpec
    from sweep.tasks.stretches import Stretches
    from sweep.tasks.study import Results


def solved(
    spec: SceneSpec,
    stretches: Stretches,
    shots: Results,
    found: Results,
    cycles: np.ndarray,
    draws: slice,
) -> Iterator[Patch]:
    """Navigation of some of the cycles.

    Parameters
    ----------
    spec, stretches
        The study, and a scanner that navigates.
    shots, found
        Geometry and points of whole cycles' shots.
    cycles, draws
        Which of them: numbers of cycles among these, and a run of draws.
    """
    from sweep.model.navigation import solve

    navigation, each = spec.navigation, stretches.shots_a_cycle
    rows = (cycles[:, None] * each + np.arange(each)).ravel()
    some = slice(None) if rows.size == len(found["flags"]) else rows
    results = solve(
        {name: values[some] for name, values in shots.items() if name in SHOTS},
        {name: found[name][some, draws] for name in POINTS},
        shots_a_cycle=each,
        test_level=navigation.test_level,
        ground_slope=navigation.ground_slope,
        relief=navigation.relief,
        jitter=spec.platform.jitter,
    )
    yield Patch(cycles, draws, results)
