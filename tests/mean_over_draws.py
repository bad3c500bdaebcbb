"""Statistics of shots averaged over draws, all at once."""

from collections.abc import Collection

import numpy as np

from sweep.model.preparation import Parameters
from sweep.model.realisations import Means, realise
from sweep.model.shot import statistics


def mean_statistics(
    parameters: Parameters,
    effects: Collection[str],
    *,
    keys: np.ndarray,
    first_draw: int = 0,
    draws: int,
) -> dict[str, np.ndarray]:
    """Statistics of n shots, (n,) by name, means over draws of random effects as realised."""
    means = Means(len(keys))
    for batch in realise(parameters, effects, keys=keys, first_draw=first_draw, draws=draws):
        means.add(batch.point, statistics(batch.shots))
    return means.results()
