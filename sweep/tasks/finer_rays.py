"""Shots of a flight that are cast again, with more rays, as their own tell that they are too few.

The eyepoints of a flight hold as many rays of each shot as most of its shots need; those of which
the tolerance calls for more (:func:`sweep.model.resolution.more_rays`) are few, and are cast where
they are looked at. How many that are follows from the shot alone.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from sweep.model.accuracy import Accuracy
from sweep.model.resolution import more_rays
from sweep.tasks.eyepoint_study import CAST_BEAMLETS, EyepointStudy

if TYPE_CHECKING:
    from sweep.model.eyepoints import Eyepoints
    from sweep.spec import SceneSpec


class FinerRays:
    """Casts shots with any number of rays.

    Parameters
    ----------
    spec
        A study of the scene.
    make
        Makes the study of what is seen with so many rays.
    """

    def __init__(self, spec: SceneSpec, make: Callable[..., EyepointStudy] = EyepointStudy) -> None:
        self._spec, self._make = spec, make
        self._known: dict[tuple[str, int], EyepointStudy] = {}

    def see(self, scanner: str, shots: np.ndarray, rays: int) -> Eyepoints:
        """What shots see, by number (n,)."""
        if (scanner, rays) not in self._known:
            self._known[scanner, rays] = self._make(self._spec, scanner, beamlets=rays)
        return self._known[scanner, rays].observe(shots)


def refine(
    rays: int,
    error: np.ndarray,
    accuracy: Accuracy,
    again: Callable[[np.ndarray, int], np.ndarray],
) -> None:
    """Look at shots again, with more rays, until what these leave is within the tolerance.

    Parameters
    ----------
    rays
        Of each shot so far.
    error
        (n,): what they leave.
    accuracy
        Of the study.
    again
        Looks at some shots, by their places (m,), with so many rays; says what these leave, (m,).
    """
    needed = more_rays(rays, error, accuracy)
    for number in accuracy.rays:  # rising, and so are the needs of each shot
        places = np.flatnonzero(needed == number)
        step = max(1, CAST_BEAMLETS // number)
        for start in range(0, len(places), step):
            some = places[start : start + step]
            needed[some] = more_rays(number, again(some, number), accuracy)
