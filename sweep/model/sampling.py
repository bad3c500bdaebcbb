"""Points sampled by draws: a fixed number of them, or as many as it takes to keep a promise.

What is promised is how far pd may be off, each segment's and the shot's, with some confidence. What
draws tell of pd depends on what is random. Where effects are, pd is the mean over draws of the
conditional probabilities that each draw has over its noise. Where noise alone is and is drawn, it
is the share of draws with a detection. Where noise alone is and draws are held against known
probabilities, pd is exact, and the counts sample it.

Drawing until the promise is kept goes in rounds over all points that are still open. Who looks
stops sooner, on the average, where the draws happen to vary little, and that costs coverage and
adds bias: :func:`looks` looks seldom enough for both to be small. ``benchmarks/stopping.py``
measures them. Looks come at the same numbers of draws for every point, and what a point has drawn
depends on nothing but its own draws: other points, blocks and workers change no bit of it.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from sweep.model.accuracy import Accuracy
from sweep.model.draws import Rows, count_by_chance, count_in_noise, draw, no_counts
from sweep.model.intervals import COUNTED, bounded_mean, half_width
from sweep.model.outputs import DRAW_OUTPUTS, PROMISED, RUNNING
from sweep.model.preparation import Parameters
from sweep.model.realisations import ROWS, Means, certain, random_effects, realise
from sweep.model.shot import evaluate, statistics

PIECE = 1 << 16
"""Draws of a point that are taken at once where nothing but noise is random."""
LEAST = 16
"""Draws of a point that are taken at once where random effects are simulated, at the least."""

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
    """Sums over the draws of n points so far, to be continued.

    Parameters
    ----------
    size, before
        Number of points; what was drawn of them before.
    """

    def __init__(self, size: int, before: Before | None) -> None:
        self.number = np.zeros(size, np.int64)
        self.counts = np.zeros((len(DRAW_OUTPUTS), size), np.int64)
        if before is not None:
            self.number += before.number
            self.counts += before.counts.sum(axis=-1)

    @abstractmethod
    def at_once(self, points: int) -> int:
        """Draws of each of so many points that one `take` is for: a few seconds at the most."""

    @abstractmethod
    def take(self, points: np.ndarray, first: int, batch_sizes: Sequence[int]) -> np.ndarray:
        """Draw some of the points, from draw `first` on.

        Returns
        -------
        (names, points, batches) int64 ndarray
            Counts of these draws, in the order of DRAW_OUTPUTS.
        """

    @abstractmethod
    def half_widths(self, points: np.ndarray, accuracy: Accuracy) -> np.ndarray:
        """How far pd of some points may be off with the promised confidence, (4, points).

        By the names of PROMISED; nan for what there is not.
        """

    def missed(self, points: np.ndarray, accuracy: Accuracy) -> np.ndarray:
        """By how much the worst half-width of some points exceeds the tolerance; 0 where none."""
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
    first_draw: int = 0,
    batch_sizes: Sequence[int],
    method: str,
    accuracy: Accuracy = Accuracy(),  # noqa: B008  # frozen
    before: Before | None = None,
    stop: Callable[[], bool] = never,
) -> dict[str, np.ndarray]:
    """Outputs, their errors, and counts over batches of draws, with all effects.

    Parameters
    ----------
    parameters, effects
        As for :func:`sweep.model.shot.evaluate`. Where random effects are among them the outputs
        are means over the same draws that are counted.
    keys, first_draw, batch_sizes, method
        As of :func:`sweep.model.draws.draw`.
    accuracy : Accuracy
        What half-widths are held against.
    before : Before, optional
        What was drawn before, from ``first_draw`` on.
    stop : callable
        Asked between draws: whether to return with those taken so far. They make a `before` from
        which another call goes on, and at least some are taken.

    Returns
    -------
    dict of ndarray
        (n,) by the names of OUTPUTS, ERROR_OUTPUTS and ACCURACY_OUTPUTS, (n, batches) int64 by
        those of DRAW_OUTPUTS of :mod:`sweep.model.outputs`; where random effects are simulated
        RUNNING, (n, columns).
    """
    sample = Sample(parameters, effects, keys=keys, method=method, before=before)
    counts = fill(sample, batch_sizes, first_draw=first_draw, before=before, stop=stop)
    return sample.results(accuracy) | dict(zip(DRAW_OUTPUTS, counts, strict=True))


def simulate_until(
    parameters: Parameters,
    effects: Collection[str],
    *,
    keys: np.ndarray,
    batch: int,
    limit: int,
    method: str,
    accuracy: Accuracy,
    before: Before | None = None,
    stop: Callable[[], bool] = never,
) -> dict[str, np.ndarray]:
    """Outputs, their errors, and counts, of as many draws of each point as keep a promise.

    Parameters
    ----------
    parameters, effects, keys, method, accuracy, before, stop
        As of :func:`simulate`; what was drawn before was drawn for the same accuracy or a looser
        one, or up to a lower limit.
    batch : int
        Draws of which a look comes after a whole number.
    limit : int
        Draws of a point at most, where the promise may still be broken.

    Returns
    -------
    dict of (n,) ndarray
        As of :func:`simulate`, with all draws in one count.
    """
    sample = Sample(parameters, effects, keys=keys, method=method, before=before)
    settle(sample, np.arange(len(keys)), looks(batch, limit), accuracy, stop)
    return sample.results(accuracy) | dict(zip(DRAW_OUTPUTS, sample.counts, strict=True))


def fill(
    sample: Drawn,
    batch_sizes: Sequence[int],
    *,
    first_draw: int = 0,
    before: Before | None,
    stop: Callable[[], bool],
) -> np.ndarray:
    """Draw all points as often as batches hold, or until told to stop.

    Returns
    -------
    (names, points, batches) int64 ndarray
        Counts, in the order of DRAW_OUTPUTS.
    """
    number, ends = sample.number.copy(), np.cumsum([0, *batch_sizes])
    room = len(DRAW_OUTPUTS), number.size, len(batch_sizes)
    counts = before.counts.copy() if before else np.zeros(room, np.int64)
    drawn = False
    for done in np.unique(number):
        points = np.flatnonzero(number == done)
        step = sample.at_once(points.size)
        for start in range(done, ends[-1], step):
            if drawn and stop():
                return counts
            last = min(start + step, ends[-1])
            batches = slice(np.searchsorted(ends, start, "right") - 1, np.searchsorted(ends, last))
            sizes = np.diff(ends[batches.start : batches.stop + 1].clip(start, last))
            counts[:, points, batches] += sample.take(points, first_draw + start, sizes.tolist())
            drawn = True
    return counts


def settle(
    sample: Drawn,
    points: np.ndarray,
    ends: Iterable[int],
    accuracy: Accuracy,
    stop: Callable[[], bool] = never,
) -> None:
    """Draw points until the promise is kept of each, numbers to look at end, or told to stop.

    One that has more draws than a look is at was looked at there before, or need not be.
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
                sample.take(alike, start, [min(step, last - start)])
                drawn = True
        looked_at = number <= last
        is_open = ~looked_at
        is_open[looked_at] = sample.missed(points[looked_at], accuracy) > 0
        points = points[is_open]
        if not points.size:
            return


class Sample(Drawn):
    """Draws held against probabilities, or in noise, with or without random effects.

    Parameters
    ----------
    parameters, effects, keys, method, before
        As of :func:`simulate`.
    """

    def __init__(
        self, parameters: Parameters, effects: Collection[str], *, keys: np.ndarray, method: str,
        before: Before | None = None,
    ) -> None:  # fmt: skip
        super().__init__(len(keys), before)
        self._parameters, self._effects = parameters, effects
        self._keys, self._method = keys, method
        self._means = Means(len(keys)) if random_effects(effects) else None
        if self._means is None:
            values = evaluate(parameters, effects)
            self._outputs = {name: np.broadcast_to(v, (len(keys),)) for name, v in values.items()}
        elif before is not None:
            self._means.go_on_from(before.means)

    def at_once(self, points: int) -> int:
        """As of :class:`Drawn`."""
        return PIECE if self._means is None else max(LEAST, 4 * ROWS // points)

    def take(self, points: np.ndarray, first: int, batch_sizes: Sequence[int]) -> np.ndarray:
        """As of :class:`Drawn`."""
        if self._means is None:
            found = draw(
                self._some(points), {name: v[points] for name, v in self._outputs.items()},
                keys=self._keys[points], first_draw=first, batch_sizes=batch_sizes,
                method=self._method, effects=self._effects,
            )  # fmt: skip
            counts = np.stack(list(found.values()))
        else:
            counts = self._realised(self._means, points, first, batch_sizes)
        self.counts[:, points] += counts.sum(axis=-1)
        self.number[points] += sum(batch_sizes)
        return counts

    def _realised(
        self, means: Means, points: np.ndarray, first: int, batch_sizes: Sequence[int]
    ) -> np.ndarray:
        """Draws of random effects: added to the means, and counted."""
        keys, ends = self._keys[points], first + np.cumsum([0, *batch_sizes])
        counts = no_counts(len(points), len(batch_sizes), self._method)
        for point, number, shots in realise(
            self._some(points), self._effects, keys=keys, first_draw=first, draws=ends[-1] - first
        ):
            found = statistics(shots)
            means.add(points[point], found)
            rows = Rows(point, keys[point], number, number + 1)
            if self._method == "probabilities":
                count_by_chance(rows, ends, found, counts)
            else:
                count_in_noise(rows, ends, shots, counts)
        return counts

    def _some(self, points: np.ndarray) -> Parameters:
        """Parameters of some of the points."""
        return {
            path: v[points] if isinstance(v, np.ndarray) and v.ndim else v
            for path, v in self._parameters.items()
        }

    def half_widths(self, points: np.ndarray, accuracy: Accuracy) -> np.ndarray:
        """As of :class:`Drawn`."""
        confidence, n = accuracy.at(points, self.number.size).confidence, self.number[points]
        if self._means is not None:
            mean, variance, number = self._means.moments(PROMISED, points)
            interval = bounded_mean(
                mean=mean, variance=variance, number=np.maximum(number, 1), confidence=confidence
            )
            return half_width(mean, interval)
        exact = np.stack([0.0 * self._outputs[name][points] for name in PROMISED])
        if self._method == "probabilities":
            return exact
        successes = self.counts[COUNT_OF][:, points]
        interval = COUNTED[accuracy.interval](successes=successes, trials=n, confidence=confidence)
        return exact + half_width(successes / n, interval)

    def results(self, accuracy: Accuracy) -> dict[str, np.ndarray]:
        """Outputs, their errors and their accuracy, (n,) each."""
        if self._means is None:
            outputs = self._outputs | certain(self._outputs)
        else:
            outputs = self._means.results() | {RUNNING: self._means.running()}
        return outputs | self.accuracy(accuracy)
