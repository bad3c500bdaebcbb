"""Sampling of points by draws: a fixed number, or as many as an error tolerance needs.

Draws are compared with probabilities, or noise is added to the bins that matter
(:mod:`sweep.model.sampling.draws`), or a detector and an estimator process full spectra with noise
(:mod:`sweep.model.sampling.noisy_spectra`).

The tolerance bounds the half-width of the confidence interval of pd, for each segment and the shot.
The estimate of pd from draws depends on what is random. If effects are random, pd is the mean over
draws of the conditional probabilities that each draw has over its noise. If noise alone is random
and is drawn, pd is the fraction of draws with a detection. If noise alone is random and draws are
compared with known probabilities, pd is exact, and the counts sample it.

Drawing until the tolerance is met goes in rounds over all points that do not meet it yet. A
sequential test stops sooner, on average, if the draws happen to vary little. This reduces coverage
and adds bias. Tests at the numbers of :func:`stopping_check_draws` are rare enough to keep both
small; ``benchmarks/stopping_rule.py`` measures them. Tests come at the same numbers of draws for
every point. With random effects these are whole groups of draws, over which random numbers are
spread evenly (:mod:`sweep.model.sampling.draw_groups`). The half-width then follows from the
variance of the groups' means.

The draws of a point depend on nothing but the point: other points, blocks and workers change no bit
of the result. A detector processes the draws of one point and segment together, in parts that
depend on the FFT size and on numbers of draws alone.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from sweep.model import waveform
from sweep.model.detection.estimators import SPECTRUM_METHOD_DEFAULTS
from sweep.model.error_budget import (
    COUNT_INTERVAL_FUNCTIONS,
    ErrorBudget,
    bounded_mean_interval,
    grouped_mean_half_width,
    interval_half_width,
    two_sided_normal_quantile,
    variance_of_grouped_draws,
)
from sweep.model.evaluation import evaluate, prepare_shots, shot_statistics
from sweep.model.outputs import (
    DETECTOR_INDEPENDENT_OUTPUTS,
    DRAW_COUNT_OUTPUTS,
    N_GROUP_SUM_COLUMNS,
    PD_OUTPUT_NAMES,
    RUNNING_SUMS_NAME,
)
from sweep.model.preparation import Parameters, Shots
from sweep.model.sampling.draw_groups import DRAWS_PER_GROUP, GroupMeans
from sweep.model.sampling.draws import DrawRanges, count_by_probability, count_in_noise
from sweep.model.sampling.noisy_spectra import (
    AVERAGED_VALUE_NAMES,
    PointSpectra,
    SpectrumMethods,
    detections_by_draw,
    prepare_point_spectra,
)
from sweep.model.sampling.realisations import (
    DRAWS_PER_BATCH,
    RunningMeans,
    iter_realisations,
    random_effects,
    zero_standard_errors,
)

NOISE_DRAWS_PER_STEP = 1 << 16
"""Number of draws of each point that are made in one step if only noise is random."""
RANDOM_EFFECT_DRAWS_PER_STEP_MIN = 16
"""Smallest number of draws of each point that are made in one step if random effects are simulated.
"""

SPECTRUM_SAMPLES_PER_STEP = 1 << 18
"""Largest number of samples of full spectra, summed over draws, that are processed in one step."""

FFT_SIZE_PATH = "instrument.processing.fft_size"
"""Dotted path of the parameter for the FFT size."""

SPECTRA_METHOD = "spectra"
"""Name of the method that draws full spectra with noise in every bin. The other methods are
``probabilities`` and ``noise``."""

PD_COUNT_ROWS = [
    list(DRAW_COUNT_OUTPUTS).index(name.replace("pd_", "n_detected_")) for name in PD_OUTPUT_NAMES
]
"""Indices of the rows, in an array of counts ordered as ``DRAW_COUNT_OUTPUTS``, that hold numbers
of detections. They are in the order of ``PD_OUTPUT_NAMES``."""


STANDARD_ERROR_GROUPS_MIN = 4
"""Smallest number of groups of draws from whose means a standard error is computed. The variance of
fewer means is too uncertain: with two groups, one error in fifty would exceed five standard errors.
With four groups it is one in 250."""

STANDARD_ERROR_CONFIDENCE = 0.95
"""Confidence of Student's quantile, by which a standard error that follows from the means of few
groups of draws is widened."""


class PriorDraws(NamedTuple):
    """Results of earlier draws of n points, to which further draws are added.

    Earlier and further draws give the same bits as one run of all draws.
    """

    n_draws: np.ndarray
    """(n,) int64: number of draws made so far for each point."""
    counts: np.ndarray
    """(names, n, batches) int64: number of draws with each event, by point and batch of draws.
    Events are in the order of DRAW_COUNT_OUTPUTS."""
    means: Mapping[str, np.ndarray]
    """Arrays by name: means (n,) by the names of outputs, and RUNNING_SUMS_NAME (n, columns). They
    are used for points with random effects or full spectra only."""


class Sampler(ABC):
    """Counts and sums over the draws of n points made so far, to which further draws are added.

    Parameters
    ----------
    parameters
        Parameters of the points by dotted path, (n,) or scalar.
    effects
        Names of the effects to simulate.
    keys
        (n, 2) uint64: random key of each point.
    batch_edges
        (batches + 1,) int64: numbers of the draws at which batches begin, and the number after the
        last draw.
    prior_draws
        Earlier draws, from the first of `batch_edges` on.
    """

    def __init__(
        self, parameters: Parameters, effects: Collection[str], *, keys: np.ndarray,
        batch_edges: np.ndarray, prior_draws: PriorDraws | None = None,
    ) -> None:  # fmt: skip
        self.parameters: dict[str, Any] = dict(parameters)
        self.effects, self.keys, self.batch_edges = effects, keys, batch_edges
        self.n_draws = np.zeros(len(keys), np.int64)
        self.counts = np.zeros((len(DRAW_COUNT_OUTPUTS), len(keys), batch_edges.size - 1), np.int64)
        if prior_draws is not None:
            self.n_draws += prior_draws.n_draws
            self.counts += prior_draws.counts

    @abstractmethod
    def draws_per_step(self, n_points: int) -> int:
        """Return the number of draws of each of ``n_points`` points that are made in one step.

        A step takes a few seconds.
        """

    def draw(self, point_indices: np.ndarray, n_draws: int) -> None:
        """Make draws of selected points, and add them to the sampler's counts and means.

        Parameters
        ----------
        point_indices : ndarray (m,) int64
            Indices of the points, at least one. All must have the same number of draws so far.
        n_draws : int
            Number of draws that are added to each point.
        """
        first_draw = self.batch_edges[0] + self.n_draws[point_indices[0]]
        counts = np.zeros(
            (len(DRAW_COUNT_OUTPUTS), point_indices.size, self.batch_edges.size - 1), np.int64
        )
        self.draw_and_count_events(point_indices, first_draw, first_draw + n_draws, counts)
        self.counts[:, point_indices] += counts
        self.n_draws[point_indices] += n_draws

    @abstractmethod
    def draw_and_count_events(
        self, point_indices: np.ndarray, first_draw: int, end_draw: int, counts: np.ndarray
    ) -> None:
        """Make draws of points, and add the numbers of their events to ``counts`` in place.

        Parameters
        ----------
        point_indices : ndarray (m,) int64
            Indices of the points.
        first_draw, end_draw : int
            Number of the first draw, and number after the last one.
        counts : ndarray (names, points, batches) int64
            Numbers of events, in the order of DRAW_COUNT_OUTPUTS, to which is added.
        """

    @abstractmethod
    def pd_half_widths(self, point_indices: np.ndarray, error_budget: ErrorBudget) -> np.ndarray:
        """Return the half-widths of the confidence intervals of detection probabilities.

        A half-width is the distance from the estimate to the farther end of its interval.

        Parameters
        ----------
        point_indices : ndarray (m,) int64
            Indices of the points.
        error_budget : ErrorBudget
            Confidence (:class:`sweep.model.error_budget.ErrorBudget`).

        Returns
        -------
        ndarray (4, m)
            Half-widths in the order of PD_OUTPUT_NAMES; nan for a segment that does not exist.
        """

    @abstractmethod
    def results(self, error_budget: ErrorBudget) -> dict[str, np.ndarray]:
        """Return the results of all draws: outputs, standard errors and half-widths, (n,) by name.

        Half-widths belong to the confidence intervals of detection probabilities. RUNNING_SUMS_NAME
        (n, columns), from which draws can be added later, is included if effects are random or
        spectra are drawn.
        """

    def select_parameters(self, point_indices: np.ndarray | int) -> dict[str, Any]:
        """Return a mapping of all parameters, by dotted path, for selected points."""
        return {
            path: v[point_indices] if isinstance(v, np.ndarray) and v.ndim else v
            for path, v in self.parameters.items()
        }

    def n_detected(self) -> np.ndarray:
        """Return the numbers of draws with a detection, (4, n), in the order of PD_OUTPUT_NAMES."""
        return np.asarray(self.counts.sum(axis=-1)[PD_COUNT_ROWS])

    def pd_half_widths_from_counts(
        self, point_indices: np.ndarray, error_budget: ErrorBudget
    ) -> np.ndarray:
        """Return half-widths of confidence intervals that follow from counted detections alone.

        The intervals are for detection probabilities, and of the kind
        ``error_budget.count_interval_name``.

        Parameters
        ----------
        point_indices : ndarray (m,) int64
            Indices of the points.
        error_budget : ErrorBudget
            Confidence and kind of interval (:class:`sweep.model.error_budget.ErrorBudget`).

        Returns
        -------
        ndarray (4, m)
            Half-widths in the order of PD_OUTPUT_NAMES.
        """
        counts, n = self.n_detected()[:, point_indices], self.n_draws[point_indices]
        confidence = error_budget.select_points(point_indices, self.n_draws.size).confidence
        interval = COUNT_INTERVAL_FUNCTIONS[error_budget.count_interval_name](
            successes=counts, trials=n, confidence=confidence
        )
        return interval_half_width(counts / n, interval)

    def pd_half_width_excess(
        self, point_indices: np.ndarray, error_budget: ErrorBudget
    ) -> np.ndarray:
        """Return each point's largest half-width minus the tolerance, but at least 0.

        Half-widths belong to the confidence intervals of detection probabilities.

        Parameters
        ----------
        point_indices : ndarray (m,) int64
            Indices of the points.
        error_budget : ErrorBudget
            Tolerance and confidence (:class:`sweep.model.error_budget.ErrorBudget`).

        Returns
        -------
        ndarray (m,)
            Excess of the largest half-width. Segments that do not exist are left out.
        """
        widths = self.pd_half_widths(point_indices, error_budget)
        excess = widths - error_budget.select_points(point_indices, self.n_draws.size).tolerance
        return np.fmax.reduce(excess, axis=0, initial=0.0)

    def accuracy_arrays(self, error_budget: ErrorBudget) -> dict[str, np.ndarray]:
        """Return numbers of draws, half-widths and their excess over the tolerance, (n,) by name.

        The names are in ACCURACY_OUTPUTS. Half-widths belong to the confidence intervals of
        detection probabilities.
        """
        point_indices = np.arange(self.n_draws.size)
        widths = zip(PD_OUTPUT_NAMES, self.pd_half_widths(point_indices, error_budget), strict=True)
        return {
            "n_draws": self.n_draws,
            **{f"{name}_half_width": width for name, width in widths},
            "accuracy_missed": self.pd_half_width_excess(point_indices, error_budget),
        }


def never_stop() -> bool:
    """Return False. As the default of ``should_stop`` it lets all draws be made."""
    return False


def stopping_check_draws(batch_size: int, draws_max: int, group_size: int = 1) -> Iterator[int]:
    """Yield, in rising order, the numbers of draws after which sampling may stop.

    At each number, half-widths of the confidence intervals of detection probabilities are compared
    with the tolerance.

    Parameters
    ----------
    batch_size
        Number of draws in a batch. Yielded numbers below two groups are whole batches.
    draws_max
        Largest number of draws, which is yielded last.
    group_size
        Number of draws in a group. Numbers of at least two groups are rounded up to whole groups.

    Notes
    -----
    The first numbers are one batch apart. Later numbers grow by the factor
    `ErrorBudget.stopping_check_growth`, 1.25.
    """
    n_batches, previous = 1, 0
    while n_batches * batch_size < draws_max:
        n_draws = n_batches * batch_size
        if n_draws >= 2 * group_size:
            n_draws = min(-(-n_draws // group_size) * group_size, draws_max)
        if previous < n_draws < draws_max:
            yield n_draws
        previous = n_draws
        n_batches = max(n_batches + 1, int(n_batches * ErrorBudget.stopping_check_growth))
    yield draws_max


def simulate_draws(
    parameters: Parameters,
    effects: Collection[str],
    *,
    keys: np.ndarray,
    method: str,
    first_draw: int = 0,
    batch_sizes: Sequence[int] = (),
    batch: int = 0,
    limit: int = 0,
    error_budget: ErrorBudget = ErrorBudget(),  # noqa: B008  # frozen
    methods: SpectrumMethods = SpectrumMethods(),  # noqa: B008  # a tuple
    prior_draws: PriorDraws | None = None,
    should_stop: Callable[[], bool] = never_stop,
) -> dict[str, np.ndarray]:
    """Simulate draws of points with all effects; return outputs, their errors and counts.

    Parameters
    ----------
    parameters, effects
        Parameters by dotted path and names of effects, as for
        :func:`sweep.model.evaluation.evaluate`.
    keys
        (n, 2) uint64: random key of each point.
    method
        ``probabilities``, ``noise`` or ``spectra``.
    first_draw
        Number of the first draw.
    batch_sizes
        Numbers of draws in batches that are counted separately; a point has the sum of these
        numbers as its draws. If empty, a point has as many draws as `error_budget` needs, counted
        together.
    batch
        Number of draws in a batch. Whole batches are made between tests against `error_budget`,
        with random effects rounded up to whole groups of draws.
    limit
        Largest number of draws of a point without `batch_sizes`.
    error_budget
        Tolerance and confidence.
    methods
        Detectors and estimators for ``spectra``.
    prior_draws
        Earlier draws from `first_draw` on, for the same tolerance or a looser one.
    should_stop
        Function that is called between steps. If it returns True, no more draws are made; a later
        call can continue with the results as `prior_draws`. At least one step is made.

    Returns
    -------
    dict of str to ndarray
        Arrays by the names in :mod:`sweep.model.outputs`. Outputs of GRID_OUTPUTS and
        STANDARD_ERROR_OUTPUTS (for ``spectra`` of SPECTRA_STUDY_OUTPUTS), and of ACCURACY_OUTPUTS,
        are (n,). Outputs of DRAW_COUNT_OUTPUTS are (n, batches) with `batch_sizes`, else (n,).
        With random effects or full spectra, outputs are means over the draws, and
        RUNNING_SUMS_NAME (n, columns) is included.
    """
    batch_edges = first_draw + np.cumsum([0, *(batch_sizes or [limit])])
    sampler_arguments: dict[str, Any] = {
        "keys": keys,
        "batch_edges": batch_edges,
        "prior_draws": prior_draws,
    }
    sampler: Sampler
    if method == SPECTRA_METHOD:
        sampler = SpectraSampler(parameters, effects, methods=methods, **sampler_arguments)
    else:
        sampler = DetectionSampler(parameters, effects, method=method, **sampler_arguments)
    point_indices = np.arange(len(keys))
    if batch_sizes:
        draw_until_accurate(sampler, point_indices, [sum(batch_sizes)], None, should_stop)
        counts = sampler.counts
    else:
        group_size = DRAWS_PER_GROUP if random_effects(effects) and method != SPECTRA_METHOD else 1
        check_draws = [
            n_draws
            for n_draws in stopping_check_draws(batch, limit, group_size)
            if n_draws == limit or group_size == 1 or _can_be_accurate(n_draws, error_budget)
        ]
        draw_until_accurate(sampler, point_indices, check_draws, error_budget, should_stop)
        counts = sampler.counts[..., 0]
    return sampler.results(error_budget) | dict(zip(DRAW_COUNT_OUTPUTS, counts, strict=True))


def draw_until_accurate(
    sampler: Sampler,
    point_indices: np.ndarray,
    check_draws: Iterable[int],
    error_budget: ErrorBudget | None,
    should_stop: Callable[[], bool] = never_stop,
) -> None:
    """Add draws to points until each meets the tolerance, or has the largest number of draws.

    Parameters
    ----------
    sampler
        Sampler; it is changed.
    point_indices
        Points to draw.
    check_draws
        Rising numbers of draws after which half-widths are compared with the tolerance. A point
        that already has more draws is skipped at that number.
    error_budget
        Tolerance and confidence; None to draw up to the last of `check_draws` without a test.
    should_stop
        Function that is called between steps and returns True to stop earlier.
    """
    has_drawn = False
    for check_at in check_draws:
        n_draws = sampler.n_draws[point_indices]
        for n_done in np.unique(n_draws[n_draws < check_at]):
            equal_points = point_indices[n_draws == n_done]
            step = sampler.draws_per_step(equal_points.size)
            for start in range(n_done, check_at, step):
                if has_drawn and should_stop():
                    return
                sampler.draw(equal_points, min(step, check_at - start))
                has_drawn = True
        if error_budget is not None:
            is_checked = n_draws <= check_at
            is_open = ~is_checked
            is_open[is_checked] = (
                sampler.pd_half_width_excess(point_indices[is_checked], error_budget) > 0
            )
            point_indices = point_indices[is_open]
            if not point_indices.size:
                return


def _can_be_accurate(n_draws: int, error_budget: ErrorBudget) -> bool:
    """Return False if points with random effects need more than ``n_draws`` draws to be accurate.

    A point is accurate if its half-widths are within the tolerance. With n draws in at least two
    whole groups, half-widths are at least z^2 / n, with the normal quantile z. With fewer draws
    they are at least half of z^2 / n (:mod:`sweep.model.error_budget`).
    """
    least_width = two_sided_normal_quantile(error_budget.confidence) ** 2 / n_draws
    if n_draws < 2 * DRAWS_PER_GROUP:
        least_width = least_width / 2
    return bool((least_width <= np.asarray(error_budget.tolerance)).any())


class DetectionSampler(Sampler):
    """Sampler of detections in draws, by probabilities or by noise in the bins of echoes."""

    draws_are_grouped = True
    """True if random effects are spread evenly over groups of draws; False for independent draws,
    with which benchmarks compare."""

    def __init__(
        self, parameters: Parameters, effects: Collection[str], *, method: str,
        prior_draws: PriorDraws | None = None, **base_arguments: Any,
    ) -> None:  # fmt: skip
        super().__init__(parameters, effects, prior_draws=prior_draws, **base_arguments)
        self._draws_noise, n_points = method == "noise", self.n_draws.size
        self._running_means = RunningMeans(n_points) if random_effects(effects) else None
        self._group_means = GroupMeans(n_points, PD_OUTPUT_NAMES)
        if self._running_means is None:
            values = evaluate(parameters, effects)
            self._outputs = {name: np.broadcast_to(v, (n_points,)) for name, v in values.items()}
        elif prior_draws is not None:
            self._running_means.restore_from_results(prior_draws.means)
            self._group_means.restore_state(
                prior_draws.means[RUNNING_SUMS_NAME][:, -N_GROUP_SUM_COLUMNS:].T
            )

    def draws_per_step(self, n_points: int) -> int:
        """Return the number of draws of each of ``n_points`` points that are made in one step."""
        return (
            NOISE_DRAWS_PER_STEP
            if self._running_means is None
            else max(RANDOM_EFFECT_DRAWS_PER_STEP_MIN, 4 * DRAWS_PER_BATCH // n_points)
        )

    def draw_and_count_events(
        self, point_indices: np.ndarray, first_draw: int, end_draw: int, counts: np.ndarray
    ) -> None:
        """Make draws of points, and add the numbers of their events to ``counts`` in place.

        If effects are random, the outputs of each draw are also added to running means.

        Parameters
        ----------
        point_indices : ndarray (m,) int64
            Indices of the points.
        first_draw, end_draw : int
            Number of the first draw, and number after the last one.
        counts : ndarray (names, m, batches) int64
            Numbers of events, in the order of DRAW_COUNT_OUTPUTS. Those of the new draws are added.
        """
        point_parameters, keys = self.select_parameters(point_indices), self.keys[point_indices]
        if self._running_means is not None:
            for members, draw_numbers, shots in iter_realisations(
                point_parameters,
                self.effects,
                keys=keys,
                first_draw=first_draw,
                draws=end_draw - first_draw,
                draws_are_grouped=self.draws_are_grouped,
            ):
                draw_statistics = shot_statistics(shots)
                self._running_means.add(point_indices[members], draw_statistics)
                self._group_means.add(
                    point_indices[members], draw_numbers - self.batch_edges[0], draw_statistics
                )
                draw_ranges = DrawRanges(members, keys[members], draw_numbers, draw_numbers + 1)
                if self._draws_noise:
                    count_in_noise(draw_ranges, self.batch_edges, shots, counts)
                else:
                    count_by_probability(draw_ranges, self.batch_edges, draw_statistics, counts)
            return
        first_and_end = np.full((2, point_indices.size), [[first_draw], [end_draw]])
        draw_ranges = DrawRanges(np.arange(point_indices.size), keys, *first_and_end)
        if not self._draws_noise:
            outputs = {name: v[point_indices] for name, v in self._outputs.items()}
            count_by_probability(draw_ranges, self.batch_edges, outputs, counts)
            return
        for indices, shots in prepare_shots(point_parameters, self.effects):
            count_in_noise(
                DrawRanges(*(v[indices] for v in draw_ranges)), self.batch_edges, shots, counts
            )

    def pd_half_widths(self, point_indices: np.ndarray, error_budget: ErrorBudget) -> np.ndarray:
        """Return the half-widths of the confidence intervals of detection probabilities.

        With random effects they are intervals of means over the draws. Without random effects they
        are intervals of counted detections if noise is drawn, and 0 if not, because probabilities
        are then exact.

        Parameters
        ----------
        point_indices : ndarray (m,) int64
            Indices of the points.
        error_budget : ErrorBudget
            Confidence (:class:`sweep.model.error_budget.ErrorBudget`).

        Returns
        -------
        ndarray (4, m)
            Half-widths in the order of PD_OUTPUT_NAMES; nan for a segment that does not exist.
        """
        confidence = error_budget.select_points(point_indices, self.n_draws.size).confidence
        if self._running_means is not None:
            mean, variance, n_values = self._running_means.moments(PD_OUTPUT_NAMES, point_indices)
            groups = self._group_means.statistics(point_indices, n_values)
            common_inputs: dict[str, Any] = {
                "variance": variance,
                "n_values": np.maximum(n_values, 1),
                "confidence": confidence,
            }
            independent_width = interval_half_width(
                mean, bounded_mean_interval(mean=mean, **common_inputs)
            )
            grouped_width = grouped_mean_half_width(
                group_variance=groups.group_variance,
                n_groups=groups.n_groups,
                group_size=DRAWS_PER_GROUP,
                **common_inputs,
            )
            has_groups = (groups.n_groups > 1) & self.draws_are_grouped
            return np.where(has_groups, grouped_width, independent_width)
        zero_or_nan = np.stack(
            [0.0 * self._outputs[name][point_indices] for name in PD_OUTPUT_NAMES]
        )
        return zero_or_nan + (
            self.pd_half_widths_from_counts(point_indices, error_budget)
            if self._draws_noise
            else 0.0
        )

    def results(self, error_budget: ErrorBudget) -> dict[str, np.ndarray]:
        """Return the results of all draws by name, as in :meth:`Sampler.results`."""
        if self._running_means is None:
            outputs = self._outputs | zero_standard_errors(self._outputs)
        else:
            group_sums = self._group_means.state().T
            running_sums = np.concatenate([self._running_means.running_sums(), group_sums], axis=1)
            outputs = self._running_means.results() | self._standard_errors()
            outputs[RUNNING_SUMS_NAME] = running_sums
        return outputs | self.accuracy_arrays(error_budget)

    def _standard_errors(self) -> dict[str, np.ndarray]:
        """Return the standard errors of mean detection probabilities, (n,) by name.

        They follow from the means of complete groups of draws, if there are at least
        :data:`STANDARD_ERROR_GROUPS_MIN` groups. Otherwise, and for draws in an incomplete group,
        draws count as independent.
        """
        assert self._running_means is not None
        point_indices = np.arange(self.n_draws.size)
        _, variance, n = self._running_means.moments(PD_OUTPUT_NAMES, point_indices)
        n_groups, group_variance = self._group_means.statistics(point_indices, n)
        grouped_variance = variance_of_grouped_draws(
            variance=variance,
            group_variance=group_variance,
            n_groups=n_groups,
            group_size=DRAWS_PER_GROUP,
            confidence=STANDARD_ERROR_CONFIDENCE,
        )
        n_grouped = DRAWS_PER_GROUP * np.where(n_groups >= STANDARD_ERROR_GROUPS_MIN, n_groups, 0)
        squared_sum_error = n_grouped * grouped_variance + (n - n_grouped) * variance
        errors = np.sqrt(squared_sum_error) / np.where(n > 0, n, np.nan)
        return {f"{name}_error": row for name, row in zip(PD_OUTPUT_NAMES, errors, strict=True)}


class SpectraSampler(Sampler):
    """Sampler whose draws are full noisy spectra, processed by a detector and an estimator."""

    def __init__(
        self, parameters: Parameters, effects: Collection[str], *, methods: SpectrumMethods,
        prior_draws: PriorDraws | None = None, **base_arguments: Any,
    ) -> None:  # fmt: skip
        super().__init__(
            {**SPECTRUM_METHOD_DEFAULTS, **parameters},
            effects,
            prior_draws=prior_draws,
            **base_arguments,
        )
        self._methods, n_points = methods, self.n_draws.size
        self._value_means, self._statistic_means = (
            RunningMeans(n_points, AVERAGED_VALUE_NAMES),
            RunningMeans(n_points),
        )
        self._shot_of_point: dict[int, tuple[Shots, int]] = {}
        if not random_effects(effects):
            ranges = np.broadcast_to(np.asarray(parameters["target.range"]), n_points)
            all_parameters: dict[str, Any] = {**parameters, "target.range": ranges}
            for indices, shots in prepare_shots(all_parameters, effects):
                self._statistic_means.add(indices, shot_statistics(shots))
                self._shot_of_point |= {int(p): (shots, i) for i, p in enumerate(indices)}
        if prior_draws is not None:
            value_sums, statistic_sums = np.split(
                prior_draws.means[RUNNING_SUMS_NAME].T, [3 * len(AVERAGED_VALUE_NAMES)]
            )
            self._value_means.restore_state(value_sums)
            if not self._shot_of_point:
                self._statistic_means.restore_state(statistic_sums)

    def draws_per_step(self, n_points: int) -> int:
        """Return the number of draws of each point that are made in one step.

        It is a multiple of the number of draws that a detector processes together. So the division
        into steps does not change which draws a detector processes together.
        """
        fft_sizes = np.unique(self.parameters[FFT_SIZE_PATH])
        return max(1, 4 // n_points) * math.lcm(
            *(max(1, SPECTRUM_SAMPLES_PER_STEP // int(n)) for n in fft_sizes)
        )

    def draw_and_count_events(
        self, point_indices: np.ndarray, first_draw: int, end_draw: int, counts: np.ndarray
    ) -> None:
        """Make draws of points, and add the numbers of their events to ``counts`` in place.

        Measured values of each draw are also added to running means.

        Parameters
        ----------
        point_indices : ndarray (m,) int64
            Indices of the points.
        first_draw, end_draw : int
            Number of the first draw, and number after the last one.
        counts : ndarray (names, m, batches) int64
            Numbers of events, in the order of DRAW_COUNT_OUTPUTS. Those of the new draws are added.
        """
        for column, point in enumerate(point_indices):
            for point_spectra, draws in self._iter_noiseless_signals_of_point(
                int(point), int(first_draw), int(end_draw)
            ):
                batch_index = np.searchsorted(self.batch_edges, draws, "right") - 1
                draw_counts, values = detections_by_draw(point_spectra, draws)
                np.add.at(counts[:, column].T, batch_index, draw_counts.T)
                values_by_name = dict(zip(AVERAGED_VALUE_NAMES, values, strict=True))
                self._value_means.add(np.full(draws.size, point), values_by_name)

    def _iter_noiseless_signals_of_point(
        self, point: int, first_draw: int, end_draw: int
    ) -> Iterator[tuple[PointSpectra, np.ndarray]]:
        """Yield the noiseless spectra of a point, with the numbers (m,) of the draws they serve.

        With random effects each draw has its own spectra.
        """
        point_parameters = self.select_parameters(point)
        if self._shot_of_point:
            point_spectra = prepare_point_spectra(
                *self._shot_of_point[point], point_parameters, self.keys[point], self._methods
            )
            step = max(1, SPECTRUM_SAMPLES_PER_STEP // point_spectra.settings.fft_size)
            for start in range(first_draw, end_draw, step):
                yield point_spectra, np.arange(start, min(start + step, end_draw))
            return
        for realised in iter_realisations(
            point_parameters,
            self.effects,
            keys=self.keys[[point]],
            first_draw=first_draw,
            draws=end_draw - first_draw,
        ):
            self._statistic_means.add(
                np.full(realised.draw_numbers.size, point), shot_statistics(realised.shots)
            )
            for i, draw_number in enumerate(realised.draw_numbers):
                point_spectra = prepare_point_spectra(
                    realised.shots, i, point_parameters, self.keys[point], self._methods
                )
                yield point_spectra, np.array([draw_number])

    def _nan_for_missing_segments(self) -> np.ndarray:
        """Return an array (4, n): nan for a segment that does not exist, else 0.

        Rows are in the order of PD_OUTPUT_NAMES. Added to outputs, the array sets outputs of
        missing segments to nan.
        """
        is_direct = np.asarray(self.parameters["instrument.receiver.architecture"]) == "direct"
        segment_orders = np.asarray(
            self.parameters.get(
                waveform.SEGMENT_ORDER_PATH, waveform.WAVEFORM_DEFAULTS[waveform.SEGMENT_ORDER_PATH]
            )
        )
        lacks_doppler = is_direct | (np.char.find(segment_orders, "doppler") < 0)
        zero_or_nan = np.zeros((len(PD_OUTPUT_NAMES), self.n_draws.size))
        zero_or_nan[
            PD_OUTPUT_NAMES.index("pd_doppler"), np.broadcast_to(lacks_doppler, self.n_draws.shape)
        ] = np.nan
        return zero_or_nan

    def pd_half_widths(self, point_indices: np.ndarray, error_budget: ErrorBudget) -> np.ndarray:
        """Return the half-widths of the confidence intervals of detection probabilities.

        The intervals follow from counted detections.

        Parameters
        ----------
        point_indices : ndarray (m,) int64
            Indices of the points.
        error_budget : ErrorBudget
            Confidence (:class:`sweep.model.error_budget.ErrorBudget`).

        Returns
        -------
        ndarray (4, m)
            Half-widths in the order of PD_OUTPUT_NAMES; nan for a segment that does not exist.
        """
        return (
            self.pd_half_widths_from_counts(point_indices, error_budget)
            + self._nan_for_missing_segments()[:, point_indices]
        )

    def results(self, error_budget: ErrorBudget) -> dict[str, np.ndarray]:
        """Return the results of all draws by name, as in :meth:`Sampler.results`."""
        values, statistics = self._value_means, self._statistic_means.results()
        n, mean, squared_deviations, error = (
            dict(zip(AVERAGED_VALUE_NAMES, part, strict=True))
            for part in (
                values.n_values,
                values.mean,
                values.squared_deviations,
                values.standard_errors(),
            )
        )
        outputs = {name: statistics[name] for name in DETECTOR_INDEPENDENT_OUTPUTS}
        detected_fractions = self.n_detected() / self.n_draws + self._nan_for_missing_segments()
        outputs |= dict(zip(PD_OUTPUT_NAMES, detected_fractions, strict=True))
        with np.errstate(divide="ignore", invalid="ignore"):
            for name in ("pfa_bin", "false_alarms"):
                outputs |= {name: mean[name], f"{name}_error": error[name]}
            for name in ("range", "radial_velocity"):
                error_name, bound_name = f"{name}_error", f"squared_{name}_bound"
                bias, squared_bound = mean[error_name], mean[bound_name]
                zero_or_nan = np.where(n[error_name] > 0, 0.0, np.nan)
                mean_squared_deviation = squared_deviations[error_name] / n[error_name]
                outputs |= {
                    f"{name}_bias": bias + zero_or_nan,
                    f"{name}_bias_error": error[error_name] + zero_or_nan,
                    f"{name}_rmse": np.sqrt(bias**2 + mean_squared_deviation),
                    f"{name}_bound": np.sqrt(squared_bound)
                    + np.where(n[bound_name] > 0, 0.0, np.nan),
                }
        running_sums = np.concatenate([values.state(), self._statistic_means.state()]).T
        return outputs | self.accuracy_arrays(error_budget) | {RUNNING_SUMS_NAME: running_sums}
