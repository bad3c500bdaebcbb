"""Statistics of shots averaged over draws, all at once."""

from collections.abc import Collection

import numpy as np

from sweep.model.evaluation import shot_statistics
from sweep.model.preparation import Parameters
from sweep.model.sampling.realisations import RunningMeans, iter_realisations


def mean_statistics(
    parameters: Parameters,
    effects: Collection[str],
    *,
    keys: np.ndarray,
    first_draw: int = 0,
    draws: int,
) -> dict[str, np.ndarray]:
    """Statistics of n shots, (n,) by name, means over draws of random effects as realised."""
    means = RunningMeans(len(keys))
    for batch in iter_realisations(
        parameters, effects, keys=keys, first_draw=first_draw, draws=draws
    ):
        means.add(batch.point_indices, shot_statistics(batch.shots))
    return means.results()
