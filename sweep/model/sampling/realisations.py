"""Simulation of random effects by draws: each draw is a shot, and results are means over draws.

All combinations of points and draws form one sequence, which is cut into batches that fit the
memory. A batch is prepared as any points are. Random effects change its parameters before all other
effects, and its shots after them. The probabilities of each draw over its noise are closed
forms (docs/draws.md). Their mean over the draws converges far faster than the fraction of
detections would. The random numbers of consecutive draws are spread evenly
(:mod:`sweep.model.sampling.draw_groups`).

Every random number is addressed by point, draw and cause (:mod:`sweep.model.sampling.philox`), and
sums run over a point's draws in their order. So neither the division into batches nor other points
or effects change a single bit.
"""

from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from sweep.kernel_cache import njit
from sweep.model.beamlet_counts import split_by_category_and_beamlet_count
from sweep.model.effects.catalogue import EFFECT_CATEGORY_KEY_PATHS, PARAMETER_DEFAULTS
from sweep.model.effects.effect import DrawAddresses, Effect, EffectContext
from sweep.model.evaluation import apply_effects, effects_use_beamlet_velocities, select_effects
from sweep.model.ground import FlatGround
from sweep.model.outputs import (
    GRID_OUTPUTS,
    OUTPUT_HAS_SQUARED_DEVIATIONS,
    OUTPUT_IS_LOGARITHM,
    RUNNING_SUMS_NAME,
    STANDARD_ERROR_OUTPUTS,
)
from sweep.model.preparation import Parameters, Shots

DRAWS_PER_BATCH = 4096
"""Largest number of draws, summed over points, that are prepared at once."""
BEAMLETS_PER_BATCH = 1 << 19
"""Largest number of beamlets, summed over draws, that are prepared at once. A beamlet takes some
100 bytes of memory."""


class RealisedShots(NamedTuple):
    """Prepared shots of m draws of points, (m,) each.

    Each draw has its own random effects. The draws of a point are in the order of their numbers.
    """

    point_indices: np.ndarray
    """(m,) int64: index of the point that each draw belongs to."""
    draw_numbers: np.ndarray
    """(m,) int64: number of each draw of its point."""
    shots: Shots
    """Prepared shots of the m draws, after their random effects."""


def random_effects(effects: Collection[str]) -> tuple[Effect, ...]:
    """Return those of the named effects that are simulated by random draws."""
    return tuple(effect for effect in select_effects(effects) if effect.is_random)


def iter_realisations(
    parameters: Parameters,
    effects: Collection[str],
    *,
    keys: np.ndarray,
    first_draw: int = 0,
    draws: int,
    draws_are_grouped: bool = True,
) -> Iterator[RealisedShots]:
    """Yield prepared shots of every draw of n points on a flat plane, batch by batch.

    Parameters
    ----------
    parameters
        Parameters of the points by dotted path, (n,) or scalar.
    effects
        Names of the effects to simulate.
    keys
        (n, 2) uint64: random key of each point.
    first_draw
        Number of the first draw. Draws depend only on their number, so any range can be computed
        alone.
    draws
        Number of draws of each point.
    draws_are_grouped
        True to spread random numbers evenly over groups of draws; False for independent draws.
    """
    all_parameters = PARAMETER_DEFAULTS | dict(parameters)
    # One parameter has n values, so that there are n points even if they differ in nothing.
    all_parameters["target.range"] = np.broadcast_to(all_parameters["target.range"], len(keys))
    for indices, category_parameters in split_by_category_and_beamlet_count(
        all_parameters, effects, EFFECT_CATEGORY_KEY_PATHS
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
                    batch_parameters,
                    effects,
                    DrawAddresses(keys[point_indices], draw_numbers, draws_are_grouped),
                ),
            )


def _realise_batch(
    parameters: dict[str, np.ndarray], effects: Collection[str], draw_keys: DrawAddresses
) -> Shots:
    """Return prepared shots, with all effects, for m draws of points that share all settings.

    Settings are parameters that are words or sizes. ``draw_keys`` holds, for each draw, the random
    key of its point and its number.
    """
    n_points, random = draw_keys.draw_numbers.size, random_effects(effects)
    for effect in random:
        if effect.perturb_parameters is not None:
            parameters = effect.perturb_parameters(parameters, draw_keys)
    context = EffectContext(
        parameters,
        FlatGround(parameters, n_points, has_velocities=effects_use_beamlet_velocities(effects)),
    )
    shots = apply_effects(parameters, n_points, context.ground, effects)
    for effect in random:
        if effect.perturb_shots is not None:
            shots = effect.perturb_shots(shots, context, draw_keys)
    return shots


def zero_standard_errors(outputs: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the standard errors of outputs that nothing random affects, by name.

    They are 0, or nan where the output is nan.
    """
    return {name: 0.0 * outputs[name.removesuffix("_error")] for name in STANDARD_ERROR_OUTPUTS}


class RunningMeans:
    """Means of values over the draws of n points, accumulated draw by draw.

    A nan does not count. For log10 outputs the mean is the logarithm of the mean of the numbers.

    Parameters
    ----------
    n_points
        Number of points n.
    names
        Names of the values; by default those of the outputs of grids.
    """

    def __init__(self, n_points: int, names: Sequence[str] = tuple(GRID_OUTPUTS)) -> None:
        self.names, shape = list(names), (len(names), n_points)
        self._is_logarithm = np.array([name.startswith("log10_") for name in names])
        self.n_values = np.zeros(shape, np.int64)
        self.mean = np.where(self._is_logarithm[:, None], -np.inf, np.zeros(shape))
        self.squared_deviations = np.zeros(shape)
        """(names, n): sum over draws of squared deviations from the mean. For logarithms it is the
        sum of the numbers over the largest number."""

    def add(self, point_indices: np.ndarray, values: Mapping[str, np.ndarray]) -> None:
        """Add the values of m draws to the means, in place.

        The draws of one point must be in the order of their numbers.

        Parameters
        ----------
        point_indices
            (m,): index of the point of each draw.
        values
            (m,) by name.
        """
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
        """Return mean, unbiased variance and number of values over draws, for selected points.

        Parameters
        ----------
        names
            Names of values that are not logarithms.
        point_indices
            Selected points.

        Returns
        -------
        tuple of ndarray (names, points)
            Mean, variance and number of draws.
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
        """Return the array (n, columns) that, with the stored means, lets later runs add draws.

        A row holds, for a point: the numbers of values of all outputs, the sums of squared
        deviations of the outputs in OUTPUT_HAS_SQUARED_DEVIATIONS, and the largest logarithms of
        the outputs in OUTPUT_IS_LOGARITHM.
        """
        arrays = (
            self.n_values,
            self.squared_deviations[OUTPUT_HAS_SQUARED_DEVIATIONS],
            self.mean[OUTPUT_IS_LOGARITHM],
        )
        return np.concatenate(arrays).T

    def restore_from_results(self, results: Mapping[str, np.ndarray]) -> None:
        """Set means and sums from the results of earlier draws, so that draws can be added.

        `results` has the names of :meth:`results`, and RUNNING_SUMS_NAME with the array of
        :meth:`running_sums`. Columns of that array beyond those of :meth:`running_sums` are
        ignored. Points without draws have zeros in it.
        """
        sizes = [a.sum() for a in (OUTPUT_HAS_SQUARED_DEVIATIONS, OUTPUT_IS_LOGARITHM)]
        split_rows = np.cumsum([len(self.names), *sizes])
        n_values, squared_deviations, largest_logarithms, _ = np.split(
            results[RUNNING_SUMS_NAME].T, split_rows
        )
        self.n_values[...] = n_values
        self.squared_deviations[OUTPUT_HAS_SQUARED_DEVIATIONS] = squared_deviations
        mean = np.array([results[name] for name in self.names])
        mean[OUTPUT_IS_LOGARITHM] = largest_logarithms
        self.mean[...] = np.where(n_values > 0, mean, self.mean)

    def state(self) -> np.ndarray:
        """Return means, sums and counts as one array (3 * names, n), for :meth:`restore_state`."""
        return np.concatenate([self.n_values, self.mean, self.squared_deviations])

    def restore_state(self, state: np.ndarray) -> None:
        """Set all means, sums and counts from an array that :meth:`state` returned."""
        self.n_values[...], self.mean[...], self.squared_deviations[...] = np.split(state, 3)

    def standard_errors(self) -> np.ndarray:
        """Return the standard errors of the means, (names, n)."""
        n = self.n_values
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.sqrt(self.squared_deviations / (n * (n - 1.0)))

    def results(self) -> dict[str, np.ndarray]:
        """Return means and their standard errors, (n,) by name.

        The names are those of the outputs and of STANDARD_ERROR_OUTPUTS.
        """
        with np.errstate(divide="ignore", invalid="ignore"):
            logarithm = self.mean + np.log10(self.squared_deviations / self.n_values)
        # If all logarithms are -inf, the sum relative to the largest is 0: keep -inf.
        logarithm = np.where(np.isneginf(self.mean), self.mean, logarithm)
        mean = np.where(self._is_logarithm[:, None], logarithm, self.mean)
        means = dict(zip(self.names, np.where(self.n_values > 0, mean, np.nan), strict=True))
        errors = dict(zip(self.names, self.standard_errors(), strict=True))
        return means | {
            name: errors[name.removesuffix("_error")] for name in STANDARD_ERROR_OUTPUTS
        }


@njit(cache=True, nogil=True, error_model="numpy")
def add_to_running_means(point_indices, values, is_logarithm, n_values, mean, squared_deviations):
    """Add values to running means and sums of squared deviations, in place [1].

    Parameters
    ----------
    point_indices
        (m,): index of the point of each column of `values`.
    values
        (names, m): values of draws; nan does not count. An infinite value, such as an error bound
        where there is no echo, makes the mean infinite.
    is_logarithm
        (names,) bool: True for values that are log10 of a number.
    n_values
        (names, n) int64: number of values added so far; updated.
    mean
        (names, n): mean of the values, for logarithms the largest logarithm; updated.
    squared_deviations
        (names, n): sum of squared deviations from the mean, for logarithms the sum of the numbers
        over the largest number; updated.

    References
    ----------
    .. [1] B. P. Welford, Technometrics 4, 1962.
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
