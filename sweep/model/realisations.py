"""Random effects, draw by draw: each draw is a shot of its own, and what counts is their mean.

Points times draws are laid out in a row, cut into parts that fit the memory, and each part is
prepared as any other points are. Random effects turn its parameters before, and change its shots
after, all the others. Over the noise every draw has closed forms (PHYSICS section 6), whose mean
over the draws converges far faster than a count of detections would.

Every random number is addressed by point, draw and cause (:mod:`sweep.model.philox`), and sums run
over a point's draws in their order. So the cut of draws into parts, and other points or effects,
make no difference to a single bit.
"""

from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from sweep.kernel_cache import njit
from sweep.model.effects.catalogue import DEFAULTS, SHARED
from sweep.model.effects.effect import Effect, Realisation, Scene
from sweep.model.ground import Plane
from sweep.model.outputs import ERROR_OUTPUTS, LOGARITHMS, OUTPUTS, RUNNING, SPREAD_OF
from sweep.model.preparation import Parameters, Shots
from sweep.model.resolution import resolved_categories
from sweep.model.shot import assembled, nodes

ROWS = 4096
"""Draws that are prepared at once, of all points together."""
BEAMLETS = 1 << 19
"""Beamlets of all these draws, of some 100 bytes each."""


class Stretch(NamedTuple):
    """Some draws of some points, (m,) each, a point's draws in their order."""

    point: np.ndarray
    """int64: which point."""
    draw: np.ndarray
    """int64: number of the draw."""
    shots: Shots


def random_effects(effects: Collection[str]) -> tuple[Effect, ...]:
    """Those of the effects, by name, that are simulated by draws."""
    return tuple(effect for effect in nodes(effects) if effect.is_random)


def realise(
    parameters: Parameters,
    effects: Collection[str],
    *,
    keys: np.ndarray,
    first_draw: int = 0,
    draws: int,
) -> Iterator[Stretch]:
    """Shots of every draw of n points, with random `keys` (n, 2), on a flat plane.

    Any part of the draws, from `first_draw` on, can be had alone.
    """
    everything = DEFAULTS | dict(parameters)
    # So that there are n points even where they differ in nothing.
    everything["target.range"] = np.broadcast_to(everything["target.range"], len(keys))
    for index, p in resolved_categories(everything, effects, SHARED):
        rows = min(ROWS, max(1, BEAMLETS // int(p["footprint.beamlets"])))
        for start in range(0, index.size * draws, rows):
            place = np.arange(start, min(start + rows, index.size * draws))
            of_group, number = place // draws, first_draw + place % draws
            point = index[of_group]
            chosen = {path: a[of_group] if a.ndim else a for path, a in p.items()}
            yield Stretch(point, number, _drawn(chosen, effects, Realisation(keys[point], number)))


def _drawn(p: dict[str, np.ndarray], effects: Collection[str], realisation: Realisation) -> Shots:
    """One draw of each of some points of one category."""
    size, chosen = realisation.draw.size, random_effects(effects)
    for effect in chosen:
        if effect.turn is not None:
            p = effect.turn(p, realisation)
    scene = Scene(p, Plane(p, size, moving="doppler_spread" in effects))
    shots = assembled(p, size, scene.ground, effects)
    for effect in chosen:
        if effect.draw is not None:
            shots = effect.draw(shots, scene, realisation)
    return shots


def certain(outputs: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return standard errors where nothing is random: 0, but nan for outputs that are nan."""
    return {name: 0.0 * outputs[name.removesuffix("_error")] for name in ERROR_OUTPUTS}


class Means:
    """Means of values over the draws of n points, added up draw after draw.

    By default of the outputs. A draw in which a value is nan is no draw of that value. Logarithms
    are those of the mean.
    """

    def __init__(self, size: int, names: Sequence[str] = tuple(OUTPUTS)) -> None:
        self.names, shape = list(names), (len(names), size)
        self._logarithms = np.array([name.startswith("log10_") for name in names])
        self.count = np.zeros(shape, np.int64)
        self.mean = np.where(self._logarithms[:, None], -np.inf, np.zeros(shape))
        self.spread = np.zeros(shape)
        """Sums of squares about the means."""

    def add(self, point: np.ndarray, values: Mapping[str, np.ndarray]) -> None:
        """Add draws, (m,) each, in the order of their numbers for each point."""
        rows = np.array([values[name] for name in self.names])
        add(point, rows, self._logarithms, self.count, self.mean, self.spread)

    def moments(
        self, names: Sequence[str], points: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Means, variances of a single draw (unbiased) and numbers of draws, (names, points) each.

        Of outputs other than logarithms.
        """
        rows = np.ix_(np.array([self.names.index(name) for name in names]), points)
        n = self.count[rows]
        with np.errstate(invalid="ignore"):
            return np.where(n > 0, self.mean[rows], np.nan), self.spread[rows] / (n - 1.0), n

    def running(self) -> np.ndarray:
        """Return the sums that further draws are added to, besides means, (n, RUNNING_COLUMNS)."""
        kept = self.count, self.spread[SPREAD_OF], self.mean[LOGARITHMS]
        return np.concatenate(kept).T

    def go_on_from(self, means: Mapping[str, np.ndarray]) -> None:
        """Go on from what `results` and `running` gave before; zeros where nothing was drawn."""
        columns = np.cumsum([len(self.names), SPREAD_OF.sum()])
        count, spread, largest = np.split(means[RUNNING].T, columns)
        self.count[...] = count
        self.spread[SPREAD_OF] = spread
        mean = np.array([means[name] for name in self.names])
        mean[LOGARITHMS] = largest
        self.mean[...] = np.where(count > 0, mean, self.mean)

    def sums(self) -> np.ndarray:
        """All that draws have come to, (3 * names, n); :meth:`restore` goes on from there."""
        return np.concatenate([self.count, self.mean, self.spread])

    def restore(self, sums: np.ndarray) -> None:
        """Go on from what :meth:`sums` gave before."""
        self.count[...], self.mean[...], self.spread[...] = np.split(sums, 3)

    def errors(self) -> np.ndarray:
        """Compute standard errors of the means, (names, n)."""
        n = self.count
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.sqrt(self.spread / (n * (n - 1.0)))

    def results(self) -> dict[str, np.ndarray]:
        """Return means by the names of OUTPUTS, standard errors by ERROR_OUTPUTS, (n,)."""
        with np.errstate(divide="ignore", invalid="ignore"):
            logarithm = self.mean + np.log10(self.spread / self.count)
        # The running maximum of logarithms that are all -inf has nothing to add to it.
        logarithm = np.where(np.isneginf(self.mean), self.mean, logarithm)
        mean = np.where(self._logarithms[:, None], logarithm, self.mean)
        means = dict(zip(self.names, np.where(self.count > 0, mean, np.nan), strict=True))
        errors = dict(zip(self.names, self.errors(), strict=True))
        return means | {name: errors[name.removesuffix("_error")] for name in ERROR_OUTPUTS}


@njit(cache=True, nogil=True, error_model="numpy")
def add(point, values, logarithms, count, mean, spread):
    """Draws into running means and sums of squared deviations [Welford, Technometrics 4, 1962].

    (names, m) values of points (m,), nan where a draw is none; what is infinite in one of them, as
    bounds without an echo are, is so in the mean. For logarithms instead the largest, and the sum
    of the numbers over its number.
    """
    for k in range(values.shape[0]):
        for j in range(point.size):
            i, x = point[j], values[k, j]
            if np.isnan(x):
                continue
            count[k, i] += 1
            if not logarithms[k]:
                if np.isinf(x) or np.isinf(mean[k, i]):
                    mean[k, i] = np.inf
                    continue
                apart = x - mean[k, i]
                mean[k, i] += apart / count[k, i]
                spread[k, i] += apart * (x - mean[k, i])
            elif x > mean[k, i]:
                spread[k, i] = spread[k, i] * 10.0 ** (mean[k, i] - x) + 1.0
                mean[k, i] = x
            elif x > -np.inf:
                spread[k, i] += 10.0 ** (x - mean[k, i])
