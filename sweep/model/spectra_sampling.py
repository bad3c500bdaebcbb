"""Points sampled by whole spectra: a detector and an estimator of frequency at work in noise.

What is looked at in each draw says :mod:`sweep.model.spectra_look`.

Draws are addressed, and added up one after the other: blocks, workers and how draws are cut into
pieces change no bit. A detector sees the draws of one point and segment together, in pieces that
depend on the FFT size and on numbers of draws alone.
"""

import math
from collections.abc import Callable, Collection, Iterator, Sequence
from typing import Any

import numpy as np
from numba import njit

from sweep.model.accuracy import Accuracy
from sweep.model.chain import prepare
from sweep.model.intervals import COUNTED, half_width
from sweep.model.outputs import DRAW_OUTPUTS, PROMISED, RUNNING
from sweep.model.preparation import Parameters, Shots
from sweep.model.realisations import Means, random_effects, realise
from sweep.model.sampling import COUNT_OF, Before, Drawn, fill, looks, never, settle
from sweep.model.shot import statistics
from sweep.model.spectra_look import DEFAULTS, VALUES, Methods, View, counted, view_of
from sweep.model.spectra_outputs import KEPT

SAMPLES = 1 << 18
"""Samples of the spectra that are held at once."""

FFT_SIZE = "instrument.processing.fft_size"


def simulate_spectra(
    parameters: Parameters,
    effects: Collection[str],
    *,
    keys: np.ndarray,
    batch_sizes: Sequence[int],
    accuracy: Accuracy = Accuracy(),  # noqa: B008  # frozen
    methods: Methods = Methods(),  # noqa: B008  # a tuple
    before: Before | None = None,
    stop: Callable[[], bool] = never,
) -> dict[str, np.ndarray]:
    """Outputs of n points, each drawn so many times.

    Parameters
    ----------
    parameters, effects, keys, batch_sizes, accuracy, before, stop
        As of :func:`sweep.model.sampling.simulate`; among the parameters those of :data:`DEFAULTS`.
        What was drawn before was drawn by this function, and stopped.
    methods : Methods
        What the names in the parameters mean.

    Returns
    -------
    dict of ndarray
        (n,) by the names of SPECTRA_OUTPUTS and ACCURACY_OUTPUTS, (n, batches) int64 by those of
        DRAW_OUTPUTS, and (n, ...) RUNNING, what further draws are added to.
    """
    sample = SpectraSample(parameters, effects, keys=keys, methods=methods, before=before)
    counts = fill(sample, batch_sizes, before=before, stop=stop)
    return sample.results(accuracy) | dict(zip(DRAW_OUTPUTS, counts, strict=True))


def simulate_spectra_until(
    parameters: Parameters,
    effects: Collection[str],
    *,
    keys: np.ndarray,
    batch: int,
    limit: int,
    accuracy: Accuracy,
    methods: Methods = Methods(),  # noqa: B008  # a tuple
    before: Before | None = None,
    stop: Callable[[], bool] = never,
) -> dict[str, np.ndarray]:
    """The same with as many draws as keep a promise on pd, or ``limit``; looks by ``batch``."""
    sample = SpectraSample(parameters, effects, keys=keys, methods=methods, before=before)
    settle(sample, np.arange(len(keys)), looks(batch, limit), accuracy, stop)
    return sample.results(accuracy) | dict(zip(DRAW_OUTPUTS, sample.counts, strict=True))


class SpectraSample(Drawn):
    """Draws of whole spectra.

    Parameters
    ----------
    parameters, effects, keys, methods, before
        As of :func:`simulate_spectra`.
    """

    def __init__(
        self, parameters: Parameters, effects: Collection[str], *, keys: np.ndarray,
        methods: Methods, before: Before | None,
    ) -> None:  # fmt: skip
        size = len(keys)
        super().__init__(size, before)
        self._parameters: dict[str, Any] = {**DEFAULTS, **parameters}
        self._effects = effects
        self._keys, self._methods = keys, methods
        self._moments = np.zeros((3, len(VALUES), size))  # number, mean, sum of squares about it
        self._fixed = Means(size)
        self._prepared: dict[int, tuple[Shots, int]] = {}
        if not random_effects(effects):
            everywhere = np.broadcast_to(np.asarray(parameters["target.range"]), size)
            whole: dict[str, Any] = {**parameters, "target.range": everywhere}
            for index, shots in prepare(whole, effects):
                self._fixed.add(index, statistics(shots))
                self._prepared |= {int(p): (shots, i) for i, p in enumerate(index)}
        if before is not None:
            moments, sums = np.split(before.means[RUNNING].T, [self._moments[..., 0].size])
            self._moments[...] = moments.reshape(self._moments.shape)
            if not self._prepared:
                self._fixed.restore(sums)

    def at_once(self, points: int) -> int:
        """Draws of each of so many points that one `take` is for: some of :data:`SAMPLES`.

        Whole ones, so that a detector sees the same draws together however they are cut.
        """
        sizes = np.unique(self._parameters[FFT_SIZE])
        return max(1, 4 // points) * math.lcm(*(max(1, SAMPLES // int(n)) for n in sizes))

    def take(self, points: np.ndarray, first: int, batch_sizes: Sequence[int]) -> np.ndarray:
        """As of :class:`Drawn`."""
        ends = first + np.cumsum([0, *batch_sizes])
        counts = np.zeros((len(DRAW_OUTPUTS), points.size, len(batch_sizes)), np.int64)
        for place, point in enumerate(points):
            for view, draws in self._views(int(point), int(ends[0]), int(ends[-1])):
                batch = np.searchsorted(ends, draws, "right") - 1
                found, values = counted(view, draws)
                np.add.at(counts[:, place].T, batch, found.T)
                _add(values, self._moments[:, :, point])
        self.counts[:, points] += counts.sum(axis=-1)
        self.number[points] += ends[-1] - ends[0]
        return counts

    def _views(self, point: int, first: int, last: int) -> Iterator[tuple[View, np.ndarray]]:
        """What is looked at of a point, with the numbers of draws that are looked at together."""
        p = self._at(point)
        if self._prepared:
            view = view_of(*self._prepared[point], p, self._keys[point], self._methods)
            step = max(1, SAMPLES // view.setting.fft_size)
            for start in range(first, last, step):
                yield view, np.arange(start, min(start + step, last))
            return
        for stretch in realise(
            p, self._effects, keys=self._keys[[point]], first_draw=first, draws=last - first
        ):
            self._fixed.add(np.full(stretch.draw.size, point), statistics(stretch.shots))
            for i, draw in enumerate(stretch.draw):
                view = view_of(stretch.shots, i, p, self._keys[point], self._methods)
                yield view, np.array([draw])

    def _at(self, point: int) -> dict[str, float | int | str | np.ndarray]:
        """Parameters of a point."""
        return {
            path: v[point] if isinstance(v, np.ndarray) and v.ndim else v
            for path, v in self._parameters.items()
        }

    def _shares(self, points: np.ndarray) -> np.ndarray:
        """Shares of draws with a detection, (4, points), by the names of PROMISED."""
        shares = self.counts[COUNT_OF][:, points] / self.number[points]
        segments = np.asarray(self._parameters["instrument.receiver.architecture"]) != "direct"
        there = np.broadcast_to(segments, self.number.shape)[points]
        shares[PROMISED.index("pd_doppler")] += np.where(there, 0.0, np.nan)
        return shares

    def half_widths(self, points: np.ndarray, accuracy: Accuracy) -> np.ndarray:
        """Those of the shares' intervals, as of :class:`Drawn`."""
        confidence = accuracy.at(points, self.number.size).confidence
        interval = COUNTED[accuracy.interval](
            successes=self.counts[COUNT_OF][:, points], trials=self.number[points],
            confidence=confidence,
        )  # fmt: skip
        return half_width(self._shares(points), interval)

    def results(self, accuracy: Accuracy) -> dict[str, np.ndarray]:
        """Outputs, their accuracy and RUNNING."""
        points = np.arange(self.number.size)
        n, mean, square = (dict(zip(VALUES, part, strict=True)) for part in self._moments)
        fixed = self._fixed.results()
        outputs = {name: fixed[name] for name in KEPT}
        outputs |= dict(zip(PROMISED, self._shares(points), strict=True))
        with np.errstate(divide="ignore", invalid="ignore"):
            error = {name: np.sqrt(square[name] / (n[name] * (n[name] - 1))) for name in VALUES}
            for name in ("pfa_bin", "false_alarms"):
                outputs |= {name: mean[name], f"{name}_error": error[name]}
            for name in ("range", "radial_velocity"):
                some = np.where(n[name] > 0, 0.0, np.nan)
                outputs |= {
                    f"{name}_bias": mean[name] + some,
                    f"{name}_bias_error": error[name] + some,
                    f"{name}_rmse": np.sqrt(mean[name] ** 2 + square[name] / n[name]),
                    f"{name}_bound": np.sqrt(mean[f"{name}_2"]),
                }
        running = np.concatenate([*self._moments, self._fixed.sums()]).T
        return outputs | self.accuracy(accuracy) | {RUNNING: running}


@njit(cache=True, nogil=True, error_model="numpy")
def _add(values, moments):
    """Draws into running numbers, means and sums of squared deviations; nan is no draw.

    What is infinite in one of them, as bounds without an echo are, is so in the mean.
    """
    for name in range(values.shape[0]):
        for x in values[name]:
            if np.isnan(x):
                continue
            moments[0, name] += 1.0
            if np.isinf(x) or np.isinf(moments[1, name]):
                moments[1, name] = np.inf
                continue
            apart = x - moments[1, name]
            moments[1, name] += apart / moments[0, name]
            moments[2, name] += apart * (x - moments[1, name])
