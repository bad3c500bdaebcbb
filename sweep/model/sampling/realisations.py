"""Random effects, draw by draw: each draw is a shot of its own, and what counts is their mean.

Points times draws are laid out in a row, cut into parts that fit the memory, and each part is
prepared as any other points are. Random effects turn its parameters before, and change its shots
after, all the others. Over the noise every draw has closed forms (PHYSICS section 6), whose mean
over the draws converges far faster than a count of detections would.

Every random number is addressed by point, draw and cause (:mod:`sweep.model.sampling.philox`), and
sums run
over a point's draws in their order. So the cut of draws into parts, and other points or effects,
make no difference to a single bit.
"""

from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from sweep.kernel_cache import njit
from sweep.model.beamlet_counts import split_with_beamlet_counts
from sweep.model.effects.catalogue import EFFECT_CATEGORY_PATHS, PARAMETER_DEFAULTS
from sweep.model.effects.effect import DrawAddresses, Effect, EffectContext
from sweep.model.evaluation import apply_effects, select_effects
from sweep.model.ground import FlatGround
from sweep.model.outputs import (
    GRID_OUTPUTS,
    IS_LOGARITHM,
    KEEPS_SPREAD,
    RUNNING_SUMS,
    STANDARD_ERROR_OUTPUTS,
)
from sweep.model.preparation import Parameters, Shots

DRAWS_PER_BATCH = 4096
"""Draws that are prepared at once, of all points together."""
BEAMLETS_PER_BATCH = 1 << 19
"""Beamlets of all these draws, of some 100 bytes each."""


class RealisedShots(NamedTuple):
    """Some draws of some points, (m,) each, a point's draws in their order."""

    point_indices: np.ndarray
    """int64: which point."""
    draw_numbers: np.ndarray
    """int64: number of the draw."""
    shots: Shots


def random_effects(effects: Collection[str]) -> tuple[Effect, ...]:
    """Those of the effects, by name, that are simulated by draws."""
    return tuple(effect for effect in select_effects(effects) if effect.is_random)


def iter_realisations(
    parameters: Parameters,
    effects: Collection[str],
    *,
    keys: np.ndarray,
    first_draw: int = 0,
    draws: int,
) -> Iterator[RealisedShots]:
    """Shots of every draw of n points, with random `keys` (n, 2), on a flat plane.

    Any part of the draws, from `first_draw` on, can be had alone.
    """
    all_parameters = PARAMETER_DEFAULTS | dict(parameters)
    # So that there are n points even where they differ in nothing.
    all_parameters["target.range"] = np.broadcast_to(all_parameters["target.range"], len(keys))
    for indices, category_parameters in split_with_beamlet_counts(
        all_parameters, effects, EFFECT_CATEGORY_PATHS
    ):
        batch_size = min(
            DRAWS_PER_BATCH,
            max(1, BEAMLETS_PER_BATCH // int(category_parameters["footprint.beamlets"])),
        )
        for start in range(0, indices.size * draws, batch_size):
            flat_index = np.arange(start, min(start + batch_size, indices.size * draws))
            member, draw_numbers = flat_index // draws, first_draw + flat_index % draws
            point_indices = indices[member]
            batch_parameters = {
                path: a[member] if a.ndim else a for path, a in category_parameters.items()
            }
            yield RealisedShots(
                point_indices,
                draw_numbers,
                _realise_batch(
                    batch_parameters, effects, DrawAddresses(keys[point_indices], draw_numbers)
                ),
            )


def _realise_batch(
    parameters: dict[str, np.ndarray], effects: Collection[str], draw_keys: DrawAddresses
) -> Shots:
    """One draw of each of some points of one category."""
    n_points, random = draw_keys.draw_numbers.size, random_effects(effects)
    for effect in random:
        if effect.perturb_parameters is not None:
            parameters = effect.perturb_parameters(parameters, draw_keys)
    context = EffectContext(
        parameters, FlatGround(parameters, n_points, has_velocities="doppler_spread" in effects)
    )
    shots = apply_effects(parameters, n_points, context.ground, effects)
    for effect in random:
        if effect.perturb_shots is not None:
            shots = effect.perturb_shots(shots, context, draw_keys)
    return shots


def zero_standard_errors(outputs: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return standard errors where nothing is random: 0, but nan for outputs that are nan."""
    return {name: 0.0 * outputs[name.removesuffix("_error")] for name in STANDARD_ERROR_OUTPUTS}


class RunningMeans:
    """Means of values over the draws of n points, added up draw after draw.

    By default of the outputs. A draw in which a value is nan is no draw of that value. Logarithms
    are those of the mean.
    """

    def __init__(self, n_points: int, names: Sequence[str] = tuple(GRID_OUTPUTS)) -> None:
        self.names, shape = list(names), (len(names), n_points)
        self._is_logarithm = np.array([name.startswith("log10_") for name in names])
        self.n_values = np.zeros(shape, np.int64)
        self.mean = np.where(self._is_logarithm[:, None], -np.inf, np.zeros(shape))
        self.squared_deviations = np.zeros(shape)
        """Sums of squares about the means."""

    def add(self, point_indices: np.ndarray, values: Mapping[str, np.ndarray]) -> None:
        """Add draws, (m,) each, in the order of their numbers for each point."""
        rows = np.array([values[name] for name in self.names])
        add_to_running_means(
            point_indices,
            rows,
            self._is_logarithm,
            self.n_values,
            self.mean,
            self.squared_deviations,
        )

    def moments(
        self, names: Sequence[str], point_indices: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Means, variances of a single draw (unbiased) and numbers of draws, (names, points) each.

        Of outputs other than logarithms.
        """
        rows = np.ix_(np.array([self.names.index(name) for name in names]), point_indices)
        n = self.n_values[rows]
        with np.errstate(invalid="ignore"):
            return (
                np.where(n > 0, self.mean[rows], np.nan),
                self.squared_deviations[rows] / (n - 1.0),
                n,
            )

    def running_sums(self) -> np.ndarray:
        """Return the sums that further draws are added to, besides means, (n, RUNNING_COLUMNS)."""
        arrays = self.n_values, self.squared_deviations[KEEPS_SPREAD], self.mean[IS_LOGARITHM]
        return np.concatenate(arrays).T

    def resume(self, results: Mapping[str, np.ndarray]) -> None:
        """Resume from earlier `results` and `running_sums`; zeros where nothing was drawn."""
        split_rows = np.cumsum([len(self.names), KEEPS_SPREAD.sum()])
        n_values, squared_deviations, largest_logarithms = np.split(
            results[RUNNING_SUMS].T, split_rows
        )
        self.n_values[...] = n_values
        self.squared_deviations[KEEPS_SPREAD] = squared_deviations
        mean = np.array([results[name] for name in self.names])
        mean[IS_LOGARITHM] = largest_logarithms
        self.mean[...] = np.where(n_values > 0, mean, self.mean)

    def state(self) -> np.ndarray:
        """All that draws have come to, (3 * names, n); :meth:`restore_state` goes on from there."""
        return np.concatenate([self.n_values, self.mean, self.squared_deviations])

    def restore_state(self, state: np.ndarray) -> None:
        """Go on from what :meth:`state` gave before."""
        self.n_values[...], self.mean[...], self.squared_deviations[...] = np.split(state, 3)

    def standard_errors(self) -> np.ndarray:
        """Compute standard errors of the means, (names, n)."""
        n = self.n_values
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.sqrt(self.squared_deviations / (n * (n - 1.0)))

    def results(self) -> dict[str, np.ndarray]:
        """Return means by the names of OUTPUTS, standard errors by ERROR_OUTPUTS, (n,)."""
        with np.errstate(divide="ignore", invalid="ignore"):
            logarithm = self.mean + np.log10(self.squared_deviations / self.n_values)
        # The running maximum of logarithms that are all -inf has nothing to add to it.
        logarithm = np.where(np.isneginf(self.mean), self.mean, logarithm)
        mean = np.where(self._is_logarithm[:, None], logarithm, self.mean)
        means = dict(zip(self.names, np.where(self.n_values > 0, mean, np.nan), strict=True))
        errors = dict(zip(self.names, self.standard_errors(), strict=True))
        return means | {
            name: errors[name.removesuffix("_error")] for name in STANDARD_ERROR_OUTPUTS
        }


@njit(cache=True, nogil=True, error_model="numpy")
def add_to_running_means(point_indices, values, is_logarithm, n_values, mean, squared_deviations):
    """Draws into running means and sums of squared deviations [Welford, Technometrics 4, 1962].

    (names, m) values of points (m,), nan where a draw is none; what is infinite in one of them, as
    bounds without an echo are, is so in the mean. For logarithms instead the largest, and the sum
    of the numbers over its number.
    """
    for k in range(values.shape[0]):
        for j in range(point_indices.size):
            i, x = point_indices[j], values[k, j]
            if np.isnan(x):
                continue
            n_values[k, i] += 1
            if not is_logarithm[k]:
                if np.isinf(x) or np.isinf(mean[k, i]):
                    mean[k, i] = np.inf
                    continue
                deviation = x - mean[k, i]
                mean[k, i] += deviation / n_values[k, i]
                squared_deviations[k, i] += deviation * (x - mean[k, i])
            elif x > mean[k, i]:
                squared_deviations[k, i] = squared_deviations[k, i] * 10.0 ** (mean[k, i] - x) + 1.0
                mean[k, i] = x
            elif x > -np.inf:
                squared_deviations[k, i] += 10.0 ** (x - mean[k, i])
