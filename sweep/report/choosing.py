"""Which parts of a study a chart offers to choose from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from sweep.analysis.figures import Study
from sweep.analysis.selection import Points, confined, split

MOST_PARTS = 6
"""Values that a chart offers to choose from, at the most."""


def parts(
    study: Study, shown: Sequence[str], where: Mapping[str, object]
) -> tuple[list[tuple[str, Points]], int]:
    """Parts of a study of which a figure shows one at a time, and how many are left out.

    Parameters
    ----------
    study
        The study.
    shown
        Coordinates that a part has many values of: along the figure's sides and lines.
    where
        Values that coordinates are confined to, as written. There is no part where the study has
        none of them.
    """
    found = confined(study.points, study.spec, where)
    return split(found, found.further(shown), MOST_PARTS) if found.size else ([], 0)
