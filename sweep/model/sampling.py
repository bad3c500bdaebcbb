"""Points sampled by draws: a fixed number of them, or as many as it takes to keep a promise.

Draws are held against probabilities, or noise is added to the bins that matter
(:mod:`sweep.model.draws`), or a detector and an estimator look at whole spectra with noise
(:mod:`sweep.model.noisy_spectra`).

The promise bounds the error of pd, each segment's and the shot's, with some confidence. The
estimate of pd from draws depends on what is random. If effects are random, pd is the mean over
draws of the conditional probabilities that each draw has over its noise. If noise alone is random
and is drawn, it is the share of draws with a detection. If noise alone is random and draws are
compared with known probabilities, pd is exact, and the counts sample it.

Drawing until the promise is kept goes in rounds over all points that are still open. A test stops
sooner, on the average, if the draws happen to vary little. This costs coverage and adds bias:
:func:`looks` looks seldom enough for both to be small. ``benchmarks/stopping_rule.py`` measures
them. Looks come at the same numbers of draws for every point, and what a point has drawn depends on
nothing but its own draws: other points, blocks and workers change no bit of it. A detector sees the
draws of one point and segment together, in pieces that depend on the FFT size and on numbers of
draws alone.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from sweep.model import waveform
from sweep.model.accuracy import COUNTED, Accuracy, bounded_mean, half_width
from sweep.model.draws import Rows, count_by_chance, count_in_noise
from sweep.model.estimators import DEFAULTS
from sweep.model.noisy_spectra import VALUES, Methods, View, counted, view_of
from sweep.model.outputs import DRAW_OUTPUTS, KEPT, PROMISED, RUNNING
from sweep.model.preparation import Parameters, Shots
from sweep.model.realisations import ROWS, Means, certain, random_effects, realise
from sweep.model.shot import evaluate, prepare, statistics

PIECE = 1 << 16
"""Draws of a point that are taken at once where nothing but noise is random."""
LEAST = 16
"""Draws of a point that are taken at once where random effects are simulated, at the least."""

SAMPLES = 1 << 18
"""Samples of whole spectra that are held at once."""

FFT_SIZE = "instrument.processing.fft_size"

SPECTRA = "spectra"
"""Way to draw beside :data:`sweep.model.draws.METHODS`."""

COUNT_OF = [list(DRAW_OUTPUTS).index(name.replace("pd_", "n_detected_")) for name in PROMISED]


class Before(NamedTuple):
    """Draws of n points that were taken before: further ones are added to them, bit for bit."""

    number: np.ndarray
    """(n,) int64: how many, 0 where there are none."""
    counts: np.ndarray
    """(names, n, batches) int64: over the batches that are to be filled, as of DRAW_OUTPUTS."""
    means: Mapping[str, np.ndarray]
    """(n,) by the names of OUTPUTS, and RUNNING; for points with random effects."""


class Drawn(ABC):
    """Sums over the draws of n points so far, to be continued; arguments of :func:`simulate`.

    ``ends`` (batches + 1,) are numbers of draws between batches, from the first draw's on.
    """

    def __init__(
        self, parameters: Parameters, effects: Collection[str], *, keys: np.ndarray,
        ends: np.ndarray, before: Before | None = None,
    ) -> None:  # fmt: skip
        self.parameters: dict[str, Any] = dict(parameters)
        self.effects, self.keys, self.ends = effects, keys, ends
        self.number = np.zeros(len(keys), np.int64)
        self.counts = np.zeros((len(DRAW_OUTPUTS), len(keys), ends.size - 1), np.int64)
        if before is not None:
            self.number += before.number
            self.counts += before.counts

    @abstractmethod
    def at_once(self, points: int) -> int:
        """Draws of each of so many points that one `take` is for: a few seconds at the most."""

    def take(self, points: np.ndarray, number: int) -> None:
        """Draw some points, of which there are equally many draws, so many times more."""
        first = self.ends[0] + self.number[points[0]]
        counts = np.zeros((len(DRAW_OUTPUTS), points.size, self.ends.size - 1), np.int64)
        self.count(points, first, first + number, counts)
        self.counts[:, points] += counts
        self.number[points] += number

    @abstractmethod
    def count(self, points: np.ndarray, first: int, last: int, counts: np.ndarray) -> None:
        """Draws `first` to before `last` of some points into (names, points, batches) counts."""

    @abstractmethod
    def half_widths(self, points: np.ndarray, accuracy: Accuracy) -> np.ndarray:
        """Compute half-widths of pd of some points at the confidence of `accuracy`, (4, points).

        By the names of PROMISED; nan where there is none.
        """

    @abstractmethod
    def results(self, accuracy: Accuracy) -> dict[str, np.ndarray]:
        """Return outputs, errors and accuracy, (n,) each, and the sums for further draws."""

    def some(self, points: np.ndarray | int) -> dict[str, Any]:
        """Parameters of some of the points."""
        return {
            path: v[points] if isinstance(v, np.ndarray) and v.ndim else v
            for path, v in self.parameters.items()
        }

    def found(self) -> np.ndarray:
        """Draws with a detection, (4, n), by the names of PROMISED."""
        return np.asarray(self.counts.sum(axis=-1)[COUNT_OF])

    def counted_widths(self, points: np.ndarray, accuracy: Accuracy) -> np.ndarray:
        """Half-widths of the shares of draws with a detection."""
        counts, n = self.found()[:, points], self.number[points]
        confidence = accuracy.at(points, self.number.size).confidence
        interval = COUNTED[accuracy.interval](successes=counts, trials=n, confidence=confidence)
        return half_width(counts / n, interval)

    def missed(self, points: np.ndarray, accuracy: Accuracy) -> np.ndarray:
        """Compute the excess of the worst half-width over the tolerance; 0 where there is none."""
        widths = self.half_widths(points, accuracy)
        over = widths - accuracy.at(points, self.number.size).tolerance
        return np.fmax.reduce(over, axis=0, initial=0.0)

    def accuracy(self, accuracy: Accuracy) -> dict[str, np.ndarray]:
        """(n,) by the names of ACCURACY_OUTPUTS."""
        points = np.arange(self.number.size)
        widths = zip(PROMISED, self.half_widths(points, accuracy), strict=True)
        return {
            "n_draws": self.number,
            **{f"{name}_half_width": width for name, width in widths},
            "accuracy_missed": self.missed(points, accuracy),
        }


def never() -> bool:
    """Not to stop before all is drawn."""
    return False


def looks(batch: int, limit: int) -> Iterator[int]:
    """Numbers of draws, rising to `limit`, after which half-widths are looked at.

    After each of the first batches, then after a quarter as many again, in whole batches.
    """
    batches = 1
    while batches * batch < limit:
        yield batches * batch
        batches = max(batches + 1, int(batches * Accuracy.growth))
    yield limit


def simulate(
    parameters: Parameters,
    effects: Collection[str],
    *,
    keys: np.ndarray,
    method: str,
    first_draw: int = 0,
    batch_sizes: Sequence[int] = (),
    batch: int = 0,
    limit: int = 0,
    accuracy: Accuracy = Accuracy(),  # noqa: B008  # frozen
    methods: Methods = Methods(),  # noqa: B008  # a tuple
    before: Before | None = None,
    stop: Callable[[], bool] = never,
) -> dict[str, np.ndarray]:
    """Simulate draws with all effects: outputs, their errors, and counts of draws.

    The result has the names of OUTPUTS and ERROR_OUTPUTS, or SPECTRA_OUTPUTS, and ACCURACY_OUTPUTS
    of :mod:`sweep.model.outputs`, (n,), and those of DRAW_OUTPUTS, (n, batches). With random
    effects or whole spectra it also has RUNNING, (n, columns), and outputs are means over the draws
    that are counted.

    `parameters` and `effects` are as for :func:`sweep.model.shot.evaluate`, `keys` (n, 2) random,
    `method` is ``probabilities``, ``noise`` or ``spectra``. A point has as many draws as
    `batch_sizes` say. Without them (then all draws are one count) it has as many as `accuracy`
    needs, which is checked at multiples of `batch` draws, but no more than `limit`. `before` are
    earlier draws, from `first_draw` on, for the same accuracy or a looser one. If `stop`, called
    between draws, returns true, the result holds the draws taken so far, at least some: a `before`
    from which another call continues.
    """
    ends = first_draw + np.cumsum([0, *(batch_sizes or [limit])])
    given: dict[str, Any] = {"keys": keys, "ends": ends, "before": before}
    sample: Drawn
    if method == SPECTRA:
        sample = SpectraSample(parameters, effects, methods=methods, **given)
    else:
        sample = Sample(parameters, effects, method=method, **given)
    points = np.arange(len(keys))
    if batch_sizes:
        settle(sample, points, [sum(batch_sizes)], None, stop)
        counts = sample.counts
    else:
        settle(sample, points, looks(batch, limit), accuracy, stop)
        counts = sample.counts[..., 0]
    return sample.results(accuracy) | dict(zip(DRAW_OUTPUTS, counts, strict=True))


def settle(
    sample: Drawn,
    points: np.ndarray,
    ends: Iterable[int],
    accuracy: Accuracy | None,
    stop: Callable[[], bool] = never,
) -> None:
    """Draw points until the promise is kept of each, numbers to look at end, or told to stop.

    One that has more draws than a look is at was looked at there before, or need not be. Without
    an accuracy nothing is promised.
    """
    drawn = False
    for last in ends:
        number = sample.number[points]
        for done in np.unique(number[number < last]):
            alike = points[number == done]
            step = sample.at_once(alike.size)
            for start in range(done, last, step):
                if drawn and stop():
                    return
                sample.take(alike, min(step, last - start))
                drawn = True
        if accuracy is not None:
            looked_at = number <= last
            is_open = ~looked_at
            is_open[looked_at] = sample.missed(points[looked_at], accuracy) > 0
            points = points[is_open]
            if not points.size:
                return


class Sample(Drawn):
    """Draws held against probabilities, or in noise, with or without random effects."""

    def __init__(
        self, parameters: Parameters, effects: Collection[str], *, method: str,
        before: Before | None = None, **given: Any,
    ) -> None:  # fmt: skip
        super().__init__(parameters, effects, before=before, **given)
        self._noisy, size = method == "noise", self.number.size
        self._means = Means(size) if random_effects(effects) else None
        if self._means is None:
            values = evaluate(parameters, effects)
            self._outputs = {name: np.broadcast_to(v, (size,)) for name, v in values.items()}
        elif before is not None:
            self._means.go_on_from(before.means)

    def at_once(self, points: int) -> int:
        """As of :class:`Drawn`."""
        return PIECE if self._means is None else max(LEAST, 4 * ROWS // points)

    def count(self, points: np.ndarray, first: int, last: int, counts: np.ndarray) -> None:
        """As of :class:`Drawn`: of random effects, draws are added to the means as well."""
        some, keys = self.some(points), self.keys[points]
        if self._means is not None:
            for point, number, shots in realise(
                some, self.effects, keys=keys, first_draw=first, draws=last - first
            ):
                found = statistics(shots)
                self._means.add(points[point], found)
                rows = Rows(point, keys[point], number, number + 1)
                if self._noisy:
                    count_in_noise(rows, self.ends, shots, counts)
                else:
                    count_by_chance(rows, self.ends, found, counts)
            return
        ends = np.full((2, points.size), [[first], [last]])
        rows = Rows(np.arange(points.size), keys, *ends)
        if not self._noisy:
            outputs = {name: v[points] for name, v in self._outputs.items()}
            count_by_chance(rows, self.ends, outputs, counts)
            return
        for index, shots in prepare(some, self.effects):
            count_in_noise(Rows(*(v[index] for v in rows)), self.ends, shots, counts)

    def half_widths(self, points: np.ndarray, accuracy: Accuracy) -> np.ndarray:
        """As of :class:`Drawn`."""
        confidence = accuracy.at(points, self.number.size).confidence
        if self._means is not None:
            mean, variance, number = self._means.moments(PROMISED, points)
            interval = bounded_mean(
                mean=mean, variance=variance, number=np.maximum(number, 1), confidence=confidence
            )
            return half_width(mean, interval)
        exact = np.stack([0.0 * self._outputs[name][points] for name in PROMISED])
        return exact + (self.counted_widths(points, accuracy) if self._noisy else 0.0)

    def results(self, accuracy: Accuracy) -> dict[str, np.ndarray]:
        """As of :class:`Drawn`."""
        if self._means is None:
            outputs = self._outputs | certain(self._outputs)
        else:
            outputs = self._means.results() | {RUNNING: self._means.running()}
        return outputs | self.accuracy(accuracy)


class SpectraSample(Drawn):
    """Draws of whole spectra, looked at by detectors and estimators of given names."""

    def __init__(
        self, parameters: Parameters, effects: Collection[str], *, methods: Methods,
        before: Before | None = None, **given: Any,
    ) -> None:  # fmt: skip
        super().__init__({**DEFAULTS, **parameters}, effects, before=before, **given)
        self._methods, size = methods, self.number.size
        self._values, self._fixed = Means(size, VALUES), Means(size)
        self._prepared: dict[int, tuple[Shots, int]] = {}
        if not random_effects(effects):
            everywhere = np.broadcast_to(np.asarray(parameters["target.range"]), size)
            whole: dict[str, Any] = {**parameters, "target.range": everywhere}
            for index, shots in prepare(whole, effects):
                self._fixed.add(index, statistics(shots))
                self._prepared |= {int(p): (shots, i) for i, p in enumerate(index)}
        if before is not None:
            values, fixed = np.split(before.means[RUNNING].T, [3 * len(VALUES)])
            self._values.restore(values)
            if not self._prepared:
                self._fixed.restore(fixed)

    def at_once(self, points: int) -> int:
        """Draws of each of so many points that one `take` is for: some of :data:`SAMPLES`.

        Whole ones, so that a detector sees the same draws together however they are cut.
        """
        sizes = np.unique(self.parameters[FFT_SIZE])
        return max(1, 4 // points) * math.lcm(*(max(1, SAMPLES // int(n)) for n in sizes))

    def count(self, points: np.ndarray, first: int, last: int, counts: np.ndarray) -> None:
        """As of :class:`Drawn`: and values are added to running means."""
        for place, point in enumerate(points):
            for view, draws in self._views(int(point), int(first), int(last)):
                batch = np.searchsorted(self.ends, draws, "right") - 1
                found, values = counted(view, draws)
                np.add.at(counts[:, place].T, batch, found.T)
                named = dict(zip(VALUES, values, strict=True))
                self._values.add(np.full(draws.size, point), named)

    def _views(self, point: int, first: int, last: int) -> Iterator[tuple[View, np.ndarray]]:
        """Yield views of a point, with the numbers of the draws that each is for."""
        p = self.some(point)
        if self._prepared:
            view = view_of(*self._prepared[point], p, self.keys[point], self._methods)
            step = max(1, SAMPLES // view.setting.fft_size)
            for start in range(first, last, step):
                yield view, np.arange(start, min(start + step, last))
            return
        for stretch in realise(
            p, self.effects, keys=self.keys[[point]], first_draw=first, draws=last - first
        ):
            self._fixed.add(np.full(stretch.draw.size, point), statistics(stretch.shots))
            for i, number in enumerate(stretch.draw):
                view = view_of(stretch.shots, i, p, self.keys[point], self._methods)
                yield view, np.array([number])

    def _there(self) -> np.ndarray:
        """0, but nan for a segment that is not there, (4, n), by the names of PROMISED."""
        direct = np.asarray(self.parameters["instrument.receiver.architecture"]) == "direct"
        order = np.asarray(self.parameters.get(waveform.ORDER, waveform.DEFAULTS[waveform.ORDER]))
        none = direct | (np.char.find(order, "doppler") < 0)
        there = np.zeros((len(PROMISED), self.number.size))
        there[PROMISED.index("pd_doppler"), np.broadcast_to(none, self.number.shape)] = np.nan
        return there

    def half_widths(self, points: np.ndarray, accuracy: Accuracy) -> np.ndarray:
        """As of :class:`Drawn`."""
        return self.counted_widths(points, accuracy) + self._there()[:, points]

    def results(self, accuracy: Accuracy) -> dict[str, np.ndarray]:
        """As of :class:`Drawn`."""
        values, fixed = self._values, self._fixed.results()
        n, mean, square, error = (
            dict(zip(VALUES, part, strict=True))
            for part in (values.count, values.mean, values.spread, values.errors())
        )
        outputs = {name: fixed[name] for name in KEPT}
        shares = self.found() / self.number + self._there()
        outputs |= dict(zip(PROMISED, shares, strict=True))
        with np.errstate(divide="ignore", invalid="ignore"):
            for name in ("pfa_bin", "false_alarms"):
                outputs |= {name: mean[name], f"{name}_error": error[name]}
            for name in ("range", "radial_velocity"):
                some = np.where(n[name] > 0, 0.0, np.nan)
                outputs |= {
                    f"{name}_bias": mean[name] + some,
                    f"{name}_bias_error": error[name] + some,
                    f"{name}_rmse": np.sqrt(mean[name] ** 2 + square[name] / n[name]),
                    f"{name}_bound": np.sqrt(mean[f"{name}_2"])
                    + np.where(n[f"{name}_2"] > 0, 0.0, np.nan),
                }
        running = np.concatenate([values.sums(), self._fixed.sums()]).T
        return outputs | self.accuracy(accuracy) | {RUNNING: running}
