"""Which parts of a study a chart offers to choose from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from sweep.analysis.figures import Study
from sweep.analysis.selection import Points, confined, split, spread

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
        none of them. Parts with a single value of a coordinate that is shown are none where
        others have several, as along zipped axes.
    """
    found = confined(study.points, study.spec, where)
    if not found.size:
        return [], 0
    every, _ = split(found, found.further(shown), found.size)
    several = [
        (words, part) for words, part in every if all(len(part.distinct(n)) > 1 for n in shown)
    ]
    return spread(several or every, MOST_PARTS)
