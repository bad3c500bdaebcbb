"""Checks of combinations of fields over the whole grid of a study.

Each check evaluates the extremes of the grid, not each point. Examples of mistakes are a chirp
shorter than the delay of its echo, a responsivity above one electron per photon, a beam that its
aperture can't make, and an effect without a parameter that it needs.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from sweep.model import beam, waveform
from sweep.model.constants import ELEMENTARY_CHARGE, PLANCK, SPEED_OF_LIGHT
from sweep.model.detection import looks
from sweep.model.detection.detectors import FIXED_THRESHOLD_KIND
from sweep.model.detection.estimators import (
    DETECTOR_PREFIX,
    ESTIMATOR_PREFIX,
    SPECTRUM_METHOD_DEFAULTS,
)
from sweep.model.effects import circulator_leak
from sweep.model.effects.catalogue import EFFECTS
from sweep.model.effects.effect import Effect, Parameter
from sweep.model.effects.phase_errors import ERROR_TABLE_PATH, NO_TABLE
from sweep.model.effects.requirements import (
    ValueCondition,
    condition_different_from,
    condition_equal_to,
    exceeds_one,
    is_positive,
    is_zero,
)
from sweep.model.effects.sweep_error_table import fit_sweep_frequency_error
from sweep.model.shot_settings import RECORD_TYPE_PATH
from sweep.model.waveform import (
    SEARCH_BAND_PATHS,
    SEARCH_RANGE_LIMIT_PATHS,
    SEARCH_VELOCITY_LIMIT_PATHS,
)
from sweep.spec.axes import Axis, parameter_location
from sweep.spec.fields import AUTO, OFF, ON, rules_by_path
from sweep.spec.rules import MISSING, Finding
from sweep.spec.sections import SPECTRA_METHOD, Draws, Effects, default_value, parameter_rules
from sweep.units import QuantityError

if TYPE_CHECKING:
    from sweep.spec.scene_sections import SceneDraws

RANGE_PATH = "target.range"
CHIRP_DURATION_PATH = "instrument.chirp.duration"
ACQUISITION_DELAY_PATH = "instrument.processing.acquisition_delay"
SAMPLE_RATE_PATH = "instrument.processing.sample_rate"
FFT_SIZE_PATH = "instrument.processing.fft_size"
WINDOW_PATH = "instrument.processing.window"
RESPONSIVITY_PATH = "instrument.receiver.responsivity"
ANTIALIAS_BANDWIDTH_PATH = "instrument.receiver.antialias_bandwidth"
DETECTION_PATH = "instrument.processing.detection"
BINS_COUNTED_PATH = "instrument.processing.bins_counted"
LINE_WIDTH_PATH, LINE_SHAPE_PATH = "instrument.laser.line_width", "instrument.laser.line_shape"
"""Dotted paths of the parameters for width and shape of the laser's spectral line."""
ROUGHNESS_PATH = "target.roughness"
TRAINING_PATH, GUARD_PATH, RANK_PATH = (
    DETECTOR_PREFIX + name for name in ("training", "guard", "rank")
)
"""Dotted paths of a CFAR detector's parameters: training cells, guard cells and rank.

A CFAR detector compares a bin with the noise in neighbouring bins, its training cells.
"""

_WINDOW_TRIAL_SAMPLES_MAX = 16
"""Largest number of samples with which a window function is computed as a trial.

A window function that exists with this number of samples exists with any larger number.
"""
_SPECTRUM_BINS_MIN = 8
"""Smallest number of bins between DC and Nyquist for a detector that examines whole spectra."""


@dataclass(frozen=True)
class GridValues:
    """Values of the parameters over a study's grid, as far as they can be read from the spec.

    Axes vary independently of each other; the parameters of one axis vary together.
    """

    field_values: Mapping[str, Any]
    """SI values of the parameters' fields, or their defaults, by dotted path.

    The value of a parameter that is on one of the `axes` is not used.
    """
    axes: tuple[Axis, ...] = ()
    """Axes of the study."""
    effect_modes: Mapping[str, str] = field(default_factory=dict)
    """Mode of each effect (auto, on or off), by the effect's name."""

    @classmethod
    def from_raw_spec(cls, raw_spec: Mapping[str, Any], axes: tuple[Axis, ...]) -> GridValues:
        """Return the values of a spec as parsed from YAML, except values that break a rule."""
        values: dict[str, Any] = {}
        for path, rule in parameter_rules().items():
            raw_value = raw_value_at(raw_spec, path)
            with suppress(QuantityError):
                value = default_value(path) if raw_value is MISSING else rule.read(raw_value)
                if value is not None:
                    values[path] = value
        effect_modes: dict[str, str] = {}
        for name, rule in rules_by_path(Effects, "").items():
            with suppress(QuantityError):
                effect_modes[name] = rule.read(raw_value_at(raw_spec, f"effects.{name}", AUTO))
        return cls(values, axes, effect_modes)

    def has_values(self, *paths: str) -> bool:
        """Return True if the spec has readable values for all parameters at the dotted paths."""
        return all(self.parameter_values(path).size for path in paths)

    def parameter_values(self, path: str) -> np.ndarray:
        """Return a parameter's values (n,) along its axis; (1,) for a parameter on no axis.

        The array is empty if the parameter could not be read.
        """
        for axis in self.axes:
            for parameter in axis.parameters:
                if parameter.path == path:
                    return np.asarray(parameter.values)
        return np.asarray([self.field_values[path]] if path in self.field_values else [])

    def make_finding(self, path: str, problem: str, remedy: str) -> Finding:
        """Return a `Finding` about a parameter, located at its axis, if any, or at its field."""
        return Finding(parameter_location(path, self.axes), problem, remedy)

    def any_point_meets(self, conditions: Mapping[str, ValueCondition]) -> bool:
        """Return True if at least one point of the grid meets all conditions.

        Parameters
        ----------
        conditions : Mapping of str to ValueCondition
            Conditions on single parameters, by dotted path.
        """
        paths_on_axes = {parameter.path for axis in self.axes for parameter in axis.parameters}
        for path in set(conditions) - paths_on_axes:
            if path not in self.field_values or not conditions[path](
                np.asarray(self.field_values[path])
            ):
                return False
        return all(_condition_mask(axis, conditions).any() for axis in self.axes)

    def argmin_of_sum(
        self,
        terms: Mapping[str, Callable[[Any], Any]],
        conditions: Mapping[str, ValueCondition] = MappingProxyType({}),
    ) -> dict[str, float]:
        """Return the point of the grid at which a sum of functions of single parameters is least.

        Axes vary independently of each other, so that the sum is minimised axis by axis.

        Parameters
        ----------
        terms : Mapping of str to callable
            Terms of the sum: functions of the values (n,) of one parameter, by dotted path.
        conditions : Mapping of str to ValueCondition
            Conditions on single parameters that the point must meet.

        Returns
        -------
        dict of str to float
            SI values of the parameters in `terms` at the minimum. Empty if no point meets the
            conditions, or if a parameter in `terms` could not be read.
        """
        if not self.has_values(*terms) or not self.any_point_meets(conditions):
            return {}
        minimum = {path: self.field_values[path] for path in terms if path in self.field_values}
        for axis in self.axes:
            axis_values = {
                parameter.path: np.asarray(parameter.values) for parameter in axis.parameters
            }
            axis_sum = sum(
                (term(axis_values[path]) for path, term in terms.items() if path in axis_values),
                np.zeros(axis.size),
            )
            index = np.where(_condition_mask(axis, conditions), axis_sum, np.inf).argmin()
            minimum |= {path: axis_values[path][index] for path in terms if path in axis_values}
        return {path: float(value) for path, value in minimum.items()}


def raw_value_at(raw_spec: Mapping[str, Any], path: str, default: object = MISSING) -> Any:
    """Return the value written at a dotted path of a spec; `default` if there is none."""
    raw_value: Any = raw_spec
    for name in path.split("."):
        raw_value = raw_value.get(name, MISSING) if isinstance(raw_value, Mapping) else MISSING
    return default if raw_value is MISSING else raw_value


def _condition_mask(axis: Axis, conditions: Mapping[str, ValueCondition]) -> np.ndarray:
    """Return a mask (n,) of the values along an axis: True where all conditions are met.

    Conditions on parameters that are not on the axis are ignored.
    """
    is_met = np.ones(axis.size, bool)
    for parameter in axis.parameters:
        if parameter.path in conditions:
            is_met &= conditions[parameter.path](np.asarray(parameter.values))
    return is_met


def grid_findings(grid: GridValues) -> list[Finding]:
    """Return a `Finding` for each invalid combination of values in a study's grid."""
    return [
        *(list(_echo_time_findings(grid)) or _window_findings(grid)),
        *_responsivity_findings(grid),
        *_sweep_error_table_findings(grid),
        *_beam_findings(grid),
        *_parent_effect_findings(grid),
        *_effect_requirement_findings(grid),
        *_record_and_filter_findings(grid),
        *_multiple_looks_findings(grid),
        *_search_band_findings(grid),
    ]


# Times and samples


def _least_weighted_sum(grid: GridValues, weights: Mapping[str, float]) -> float | None:
    """Return the minimum over a grid of a weighted sum of parameters.

    `weights` has the weights by dotted path. The result is None if a parameter could not be read.
    """
    terms = {path: partial(operator.mul, weight) for path, weight in weights.items()}
    minimum = grid.argmin_of_sum(terms)
    return sum(weights[path] * minimum[path] for path in weights) if minimum else None


ECHO_TIME_PATHS = (
    CHIRP_DURATION_PATH,
    ACQUISITION_DELAY_PATH,
    RANGE_PATH,
    SAMPLE_RATE_PATH,
    FFT_SIZE_PATH,
)
"""Dotted paths of the parameters from which the echo's delay and the end of the record follow."""
_ECHO_TIME_CHECK_POINTS_MAX = 10**7
"""Largest number of points of a grid at which the delay of the echo is compared with the record.

Only axes over the parameters `ECHO_TIME_PATHS` count. Larger grids are not checked.
"""


def _echo_time_findings(grid: GridValues) -> Iterator[Finding]:
    """Yield a `Finding` if no record of the grid has an echo, or if a record has under 2 samples.

    A grid in which only some records have an echo is valid. Points without an echo detect nothing.
    """
    lateness = _least_echo_lateness(grid)
    if lateness is not None and lateness.after_chirp_end >= 0:
        problem = "must exceed the echo's delay 2R/c, and falls short by "
        problem += f"{lateness.after_chirp_end:.6g} s at its best"
        yield grid.make_finding(
            CHIRP_DURATION_PATH, problem, "shorten the range or lengthen the chirp"
        )
        return
    if lateness is not None and lateness.after_record_end >= 0:
        problem = (
            "must let records of fft_size samples last until an echo arrives, and the whole grid's "
            f"end {lateness.after_record_end:.6g} s or more before the echo's delay 2R/c"
        )
        yield grid.make_finding(
            ACQUISITION_DELAY_PATH,
            problem,
            "raise it to the delay of the farthest echo, or fft_size",
        )
        return
    samples = _segment_samples_min(grid)
    if samples is not None and np.floor(samples + 1e-6) < 2:
        problem = f"must leave 2 samples after the acquisition delay, and leaves {samples:.3g}"
        yield grid.make_finding(
            CHIRP_DURATION_PATH, problem, "raise the sample rate or lengthen the chirp"
        )


class _EchoLateness(NamedTuple):
    """Smallest times, over a grid, from the end of chirp or record to the echo's arrival [s].

    Negative values mean that the echo arrives before the end.
    """

    after_chirp_end: float
    """Time from the end of the chirp to the arrival of the echo [s]."""
    after_record_end: float
    """Time from the end of the record to the arrival of the echo [s].

    If the effect `overlap` is off, the time starts at the end of the chirp.
    """


def _least_echo_lateness(grid: GridValues) -> _EchoLateness | None:
    """Return the least times, over a grid, from the ends of chirp and record to the echo's arrival.

    The result is None if a parameter could not be read, or if the grid is too large to evaluate.
    """
    if not grid.has_values(*ECHO_TIME_PATHS):
        return None
    values: dict[str, np.ndarray] = {
        path: np.asarray(grid.field_values[path], float)
        for path in ECHO_TIME_PATHS
        if path in grid.field_values
    }
    n_points = 1
    for axis_number, axis in enumerate(grid.axes):
        shape = [-1 if k == axis_number else 1 for k in range(len(grid.axes))]
        echo_parameters = {
            parameter.path: parameter
            for parameter in axis.parameters
            if parameter.path in ECHO_TIME_PATHS
        }
        n_points *= axis.size if echo_parameters else 1
        values |= {
            path: np.asarray(parameter.values, float).reshape(shape)
            for path, parameter in echo_parameters.items()
        }
    if n_points > _ECHO_TIME_CHECK_POINTS_MAX:
        return None
    end, delay = values[CHIRP_DURATION_PATH], 2 / SPEED_OF_LIGHT * values[RANGE_PATH]
    after_chirp = float(np.min(delay - end))
    if grid.effect_modes.get("overlap") != OFF:
        end = np.minimum(
            values[ACQUISITION_DELAY_PATH] + values[FFT_SIZE_PATH] / values[SAMPLE_RATE_PATH], end
        )
    return _EchoLateness(after_chirp, float(np.min(delay - end)))


def _segment_samples_min(grid: GridValues) -> float | None:
    """Return the smallest number of samples of a segment over a grid, as a float.

    The number is (chirp duration - acquisition delay) * sample rate. The result is None if one of
    these three parameters could not be read.
    """
    if not grid.has_values(CHIRP_DURATION_PATH, ACQUISITION_DELAY_PATH, SAMPLE_RATE_PATH):
        return None
    weights = {CHIRP_DURATION_PATH: 1.0, ACQUISITION_DELAY_PATH: -1.0}
    values_on_rate_axis: Mapping[str, Any] = {}
    for axis in grid.axes:
        axis_values = {
            parameter.path: np.asarray(parameter.values) for parameter in axis.parameters
        }
        values_on_rate_axis = (
            axis_values if SAMPLE_RATE_PATH in axis_values else values_on_rate_axis
        )
    span_on_rate_axis = sum(
        (
            weights[path] * values_on_rate_axis[path]
            for path in weights
            if path in values_on_rate_axis
        ),
        0.0,
    )
    span_elsewhere = _least_weighted_sum(
        grid, {path: weight for path, weight in weights.items() if path not in values_on_rate_axis}
    )
    return float(
        np.min(
            ((span_elsewhere or 0.0) + span_on_rate_axis)
            * values_on_rate_axis.get(SAMPLE_RATE_PATH, grid.parameter_values(SAMPLE_RATE_PATH))
        )
    )


def _window_findings(grid: GridValues) -> Iterator[Finding]:
    """Yield a `Finding` if a window function does not exist for the grid's shortest record."""
    samples = _segment_samples_min(grid)
    if samples is None or not grid.has_values(WINDOW_PATH, FFT_SIZE_PATH):
        return
    from sweep.model import window

    length = int(min(grid.parameter_values(FFT_SIZE_PATH).min(), samples + 1e-6))
    for name in dict.fromkeys(grid.parameter_values(WINDOW_PATH).tolist()):
        try:
            window.window_samples(name, min(length, _WINDOW_TRIAL_SAMPLES_MAX))
        except ValueError:
            problem = f"must be one that has {length} samples, as many as the shortest record, and "
            problem += f"{name} has none of so few"
            remedy = "write another one, or raise instrument.processing.fft_size"
            yield grid.make_finding(WINDOW_PATH, problem, remedy)
            return


def _responsivity_findings(grid: GridValues) -> Iterator[Finding]:
    """Yield a `Finding` if the detector's responsivity exceeds one electron per photon.

    One electron per photon is q lambda / (h c) [A/W], with the elementary charge q, the wavelength
    lambda, Planck's constant h and the speed of light c.
    """
    responsivity_per_metre = ELEMENTARY_CHARGE / (PLANCK * SPEED_OF_LIGHT)
    least_margin = _least_weighted_sum(
        grid, {beam.WAVELENGTH_PATH: responsivity_per_metre, RESPONSIVITY_PATH: -1.0}
    )
    if least_margin is not None and least_margin < 0:
        problem = (
            "must not exceed that of one electron a photon, q lambda / (h c), over the whole "
            f"grid, and does so by {-least_margin:.3g} A/W at its worst"
        )
        yield grid.make_finding(
            RESPONSIVITY_PATH, problem, "lower it; the gain of an avalanche is 'apd_gain'"
        )


def _sweep_error_table_findings(grid: GridValues) -> Iterator[Finding]:
    """Yield a `Finding` if the table of the sweep's frequency error ends before the longest chirp.

    The table must also start at the beginning of the chirp.
    """
    table_text = grid.field_values.get(ERROR_TABLE_PATH, NO_TABLE)
    if table_text == NO_TABLE or not grid.has_values(CHIRP_DURATION_PATH):
        return
    table, duration_max = (
        fit_sweep_frequency_error(table_text),
        float(grid.parameter_values(CHIRP_DURATION_PATH).max()),
    )
    if table.first_time > 1e-9 * duration_max or table.last_time < (1 - 1e-9) * duration_max:
        problem = (
            f"must cover the chirp, 0 to {duration_max:g} s: it has {table.first_time:g} to "
            f"{table.last_time:g}"
        )
        yield grid.make_finding(ERROR_TABLE_PATH, f"{problem} s", "add the rows that it lacks")


# Beams

_SINGLE_MODE_CONDITIONS = {
    beam.COUPLING_PATH: condition_equal_to(beam.SINGLE_MODE_COUPLING_LAW),
    beam.ARCHITECTURE_PATH: condition_different_from("direct"),
}
"""Conditions on parameters, by dotted path, under which a coherent receiver mixes one spatial
mode."""


def _beam_findings(grid: GridValues) -> Iterator[Finding]:
    """Yield a `Finding` if the beam's width is stated twice, not at all, or is impossible."""
    if not grid.has_values(
        beam.WAVELENGTH_PATH, beam.APERTURE_DIAMETER_PATH, beam.DIVERGENCE_PATH, beam.WAIST_PATH
    ):
        return
    if grid.any_point_meets({beam.DIVERGENCE_PATH: is_zero, beam.WAIST_PATH: is_zero}):
        problem = "must be given, or beam_waist in its place"
        yield grid.make_finding(beam.DIVERGENCE_PATH, problem, "write e.g. '50 urad'")
    elif grid.any_point_meets({beam.DIVERGENCE_PATH: is_positive, beam.WAIST_PATH: is_positive}):
        problem = "is given in addition to beam_divergence, and each follows from the other"
        yield grid.make_finding(beam.WAIST_PATH, problem, "leave one of them out")
    else:
        yield from _beam_width_findings(grid)


def _beam_width_findings(grid: GridValues) -> Iterator[Finding]:
    """Yield a `Finding` for a beam that is narrower than its aperture can make, or too wide.

    Notes
    -----
    The narrowest full divergence of an aperture of diameter D is 4 M^2 lambda / (pi D), with the
    beam quality M^2 and the wavelength lambda. A waist may be at most the radius of the aperture,
    and must be so wide that the beam spreads by at most 90 deg.
    """
    remedy = "or set instrument.telescope.coupling: aperture, where all light mixes"
    if narrowest := _beam_furthest_below_limit(grid, _SINGLE_MODE_CONDITIONS):
        narrow_beam, limit = narrowest
        problem = (
            f"must be at least {1e6 * limit:.3g} urad, 4 M^2 lambda / (pi D): no narrower beam "
        )
        problem += f"leaves an aperture of {1e3 * narrow_beam[beam.APERTURE_DIAMETER_PATH]:.3g} mm"
        yield grid.make_finding(
            beam.DIVERGENCE_PATH, problem, f"widen the beam or the aperture, {remedy}"
        )
    for path in (beam.WAIST_PATH, beam.OSCILLATOR_WAIST_PATH):
        widest = _argmax_of_product(
            grid,
            {path: 1.0, beam.APERTURE_DIAMETER_PATH: -1.0},
            _SINGLE_MODE_CONDITIONS | {path: is_positive},
        )
        if widest and widest[path] > widest[beam.APERTURE_DIAMETER_PATH] / 2:
            problem = (
                f"must be at most {500 * widest[beam.APERTURE_DIAMETER_PATH]:.3g} mm, the radius "
                "of the aperture"
            )
            yield grid.make_finding(
                path, problem, f"take a smaller one, or a larger aperture, {remedy}"
            )
        powers = {beam.BEAM_QUALITY_PATH: 1.0, beam.WAVELENGTH_PATH: 1.0, path: -1.0}
        narrowest_waist = _argmax_of_product(grid, powers, {path: is_positive})
        if narrowest_waist and narrowest_waist[path] < (
            waist_min := _convert_between_waist_and_divergence(
                narrowest_waist, beam.FOOTPRINT_ANGLE_MAX
            )
        ):
            problem = (
                f"must be at least {1e6 * waist_min:.3g} um, for the beam to spread by 90 deg at "
                "most"
            )
            yield grid.make_finding(path, problem, "take a larger one")


def describe_narrow_beam(values: Mapping[str, Any], axes: tuple[Axis, ...]) -> str:
    """Return a sentence on a beam of the study that its aperture can't make; '' if there is none.

    Only direct detection and receivers with ``coupling: aperture`` are examined. For other
    receivers an impossible beam is a mistake in the spec (`grid_findings`).

    Parameters
    ----------
    values : Mapping
        SI values of the parameters by dotted path.
    axes : tuple of Axis
        Axes of the study.

    Returns
    -------
    str
        Sentence with the beam's divergence and the limit 4 M^2 lambda / (pi D), for beam quality
        M^2, wavelength lambda and aperture diameter D.
    """
    for conditions in (
        {beam.COUPLING_PATH: condition_equal_to(beam.APERTURE_COUPLING_LAW)},
        {beam.ARCHITECTURE_PATH: condition_equal_to("direct")},
    ):
        if narrowest := _beam_furthest_below_limit(GridValues(values, axes), conditions):
            narrow_beam, limit = narrowest
            aperture_text = (
                f"an aperture of {1e3 * narrow_beam[beam.APERTURE_DIAMETER_PATH]:.3g} mm makes"
            )
            beam_text = (
                f"a beam of {1e6 * narrow_beam[beam.DIVERGENCE_PATH]:.3g} urad is narrower than"
            )
            return f"{beam_text} {aperture_text}, 4 M^2 lambda / (pi D) = {1e6 * limit:.3g} urad"
    return ""


def _beam_furthest_below_limit(
    grid: GridValues, conditions: Mapping[str, ValueCondition]
) -> tuple[dict[str, float], float] | None:
    """Return the parameters of the beam that is furthest below its aperture's limit, and the limit.

    The limit is the least full divergence [rad] that the aperture can make. The result is None if
    all beams that meet `conditions` are possible.
    """
    # This product of powers is proportional to the ratio of the waist to the radius of the
    # aperture.
    rising, falling = (
        (beam.BEAM_QUALITY_PATH, beam.WAVELENGTH_PATH),
        (beam.DIVERGENCE_PATH, beam.APERTURE_DIAMETER_PATH),
    )
    powers = dict.fromkeys(rising, 1.0) | dict.fromkeys(falling, -1.0)
    narrowest = _argmax_of_product(grid, powers, {**conditions, beam.DIVERGENCE_PATH: is_positive})
    if narrowest and narrowest[beam.DIVERGENCE_PATH] < (
        limit := _convert_between_waist_and_divergence(
            narrowest, narrowest[beam.APERTURE_DIAMETER_PATH] / 2
        )
    ):
        return narrowest, limit
    return None


def _convert_between_waist_and_divergence(
    parameters: Mapping[str, float], waist_or_divergence: float
) -> float:
    """Convert a beam's waist radius [m] to its full divergence [rad], or the reverse.

    Both conversions are the same formula. `parameters` supplies wavelength and beam quality.
    """
    return float(
        beam.divergence_from_waist(
            waist_or_divergence,
            parameters[beam.WAVELENGTH_PATH],
            parameters[beam.BEAM_QUALITY_PATH],
        )
    )


def _argmax_of_product(
    grid: GridValues, powers: Mapping[str, float], conditions: Mapping[str, ValueCondition]
) -> dict[str, float]:
    """Return the parameters, by dotted path, at which a product of their powers is largest.

    `powers` has the exponents by dotted path. The result is empty if no point of the grid meets
    `conditions`.
    """
    terms = {path: partial(_exponent_times_log, -power) for path, power in powers.items()}
    return grid.argmin_of_sum(terms, conditions)


def _exponent_times_log(power: float, values: np.ndarray) -> np.ndarray:
    """Return ``power * log(values)`` as an array; infinite where a value is 0."""
    with np.errstate(divide="ignore"):
        return np.asarray(power * np.log(values))


# Looks

VOTING_LOOKS_MAX = 64
"""Largest number of looks (records of each segment) of a shot whose detections are counted as
votes."""


def _multiple_looks_findings(grid: GridValues) -> Iterator[Finding]:
    """Yield a `Finding` for each invalid setting of several looks (records of a segment).

    Settings are invalid if they contradict each other, or if their detection probability is
    unknown.
    """
    several_looks: dict[str, ValueCondition] = {looks.LOOKS_NUMBER_PATH: exceeds_one}
    combined_by_bin: dict[str, ValueCondition] = {
        looks.LOOKS_COMBINE_PATH: condition_different_from(looks.COMBINE_COHERENT),
        **several_looks,
    }
    added_in_amplitude: dict[str, ValueCondition] = {
        looks.LOOKS_COMBINE_PATH: condition_equal_to(looks.COMBINE_COHERENT),
        **several_looks,
    }
    voted_on: dict[str, ValueCondition] = {
        looks.LOOKS_COMBINE_PATH: condition_equal_to(looks.COMBINE_BINARY),
        **several_looks,
    }
    if grid.any_point_meets(combined_by_bin | {DETECTION_PATH: condition_equal_to("any_bin")}):
        problem = "detects by the largest bin of an echo where several records are not added in "
        problem += "amplitude: the chance that any of its bins does is known for one record alone"
        yield grid.make_finding(
            DETECTION_PATH, problem, "write 'detection: peak_bin', or combine: coherent"
        )
    if grid.any_point_meets(
        voted_on | {looks.LOOKS_NUMBER_PATH: lambda number: number > VOTING_LOOKS_MAX}
    ):
        problem = f"counts the votes of at most {VOTING_LOOKS_MAX} records"
        yield grid.make_finding(looks.LOOKS_NUMBER_PATH, problem, "take fewer, or combine: power")
    fewest_looks = grid.argmin_of_sum(
        {
            looks.LOOKS_NUMBER_PATH: lambda n: n,
            looks.LOOKS_VOTES_PATH: lambda parameter: -parameter,
        },
        voted_on,
    )
    if (
        fewest_looks
        and fewest_looks[looks.LOOKS_VOTES_PATH] > fewest_looks[looks.LOOKS_NUMBER_PATH]
    ):
        problem = (
            f"asks for more than the {fewest_looks[looks.LOOKS_NUMBER_PATH]:g} records of "
            "instrument.looks.number"
        )
        yield grid.make_finding(looks.LOOKS_VOTES_PATH, problem, "lower it, or take more looks")
    if grid.any_point_meets(
        added_in_amplitude
        | {looks.LOOKS_SPECKLE_PATH: condition_equal_to(looks.SPECKLE_INDEPENDENT)}
    ):
        problem = "gives each record a phase of its own, in which amplitudes do not add up"
        yield grid.make_finding(looks.LOOKS_SPECKLE_PATH, problem, "take common, or combine: power")
    if grid.any_point_meets(
        added_in_amplitude
        | {LINE_WIDTH_PATH: is_positive, LINE_SHAPE_PATH: condition_equal_to("gaussian")}
    ):
        problem = "does not determine the phase from one record to the next, which the sum needs"
        yield grid.make_finding(LINE_SHAPE_PATH, problem, "take lorentzian, or combine: power")
    if grid.any_point_meets(
        combined_by_bin
        | {
            looks.LOOKS_SPECKLE_PATH: condition_equal_to(looks.SPECKLE_INDEPENDENT),
            ROUGHNESS_PATH: is_positive,
        }
    ):
        problem = "is drawn once a shot for a surface of stated roughness, for all its records"
        remedy = "take common, or footprint.speckle: developed without target.roughness"
        yield grid.make_finding(looks.LOOKS_SPECKLE_PATH, problem, remedy)
    if grid.any_point_meets(
        {
            looks.LOOKS_COMBINE_PATH: condition_equal_to(looks.COMBINE_POWER),
            **several_looks,
            DETECTOR_PREFIX + "kind": condition_different_from(FIXED_THRESHOLD_KIND),
        }
    ):
        problem = "sets its threshold by the noise of one record, and here powers are averaged"
        remedy = "take fixed, or combine: binary or coherent"
        yield grid.make_finding(DETECTOR_PREFIX + "kind", problem, remedy)


def _drawn_noise_findings(grid: GridValues, method: str) -> Iterator[Finding]:
    """Yield a `Finding` if noise is drawn where leaked light or several looks forbid it.

    `method` is the value of ``draws.method``. Looks are repeated records of each segment.
    """
    if method != "probabilities" and grid.any_point_meets(
        {circulator_leak.LEAK_LENGTH_PATH: is_positive}
    ):
        problem = "draws noise, and instrument.telescope.leak_path has a line that is not drawn"
        yield Finding(("draws", "method"), problem, "take draws.method: probabilities", method)
    if method == "noise" and grid.any_point_meets(
        {
            looks.LOOKS_NUMBER_PATH: exceeds_one,
            looks.LOOKS_COMBINE_PATH: condition_different_from(looks.COMBINE_COHERENT),
        }
    ):
        problem = (
            "adds noise to the bins of one record, and instrument.looks.number asks for several"
        )
        remedy = "take probabilities or spectra, or combine: coherent"
        yield Finding(("draws", "method"), problem, remedy, method)


def _search_band_findings(grid: GridValues) -> Iterator[Finding]:
    """Yield a `Finding` for each mistake in the search band: the ranges and velocities searched.

    Its four limits must all be given, or none. Each upper limit must exceed the lower one. With a
    search band, false alarms must not be counted in all bins.
    """
    missing_ends = [path for path in SEARCH_BAND_PATHS if not grid.parameter_values(path).size]
    if 0 < len(missing_ends) < len(SEARCH_BAND_PATHS):
        problem = "is missing, and a beat depends on both range and velocity"
        yield Finding(tuple(missing_ends[0].split(".")), problem, "give all four ends, or none")
    for low, high in (SEARCH_RANGE_LIMIT_PATHS, SEARCH_VELOCITY_LIMIT_PATHS):
        least_span = _least_weighted_sum(grid, {high: 1.0, low: -1.0})
        if least_span is not None and least_span <= 0:
            yield grid.make_finding(
                high, f"must exceed {low}, and is {-least_span:.6g} below", "raise it"
            )
    if not missing_ends and grid.any_point_meets({BINS_COUNTED_PATH: condition_equal_to("all")}):
        problem = "counts bins that instrument.processing.search leaves out"
        yield grid.make_finding(
            BINS_COUNTED_PATH, problem, "write 'bins_counted: half', or leave the band out"
        )


# Effects


def _parent_effect_findings(grid: GridValues) -> Iterator[Finding]:
    """Yield a `Finding` for each effect that is on although a parent effect of it is off."""
    outer_of_effect = {effect.name: effect.parent for effect in EFFECTS}
    for name, outer in outer_of_effect.items():
        while outer and grid.effect_modes.get(name) == ON:
            if grid.effect_modes.get(outer) == OFF:
                problem = f"acts within {outer}, which is off"
                yield _effect_mode_finding(name, problem, f"turn {outer} on, or leave {name} out")
            outer = outer_of_effect[outer]


def _effect_requirement_findings(grid: GridValues) -> Iterator[Finding]:
    """Yield a `Finding` for each requirement of an effect that the grid's values break.

    Effects whose mode is ``off`` are not checked.
    """
    for effect in EFFECTS:
        mode = grid.effect_modes.get(effect.name, OFF)
        if mode == OFF:
            continue
        for parameter in effect.parameters:
            for requirement in parameter.requirements:
                applies_to = requirement.applies_to or condition_different_from(parameter.default)
                remedy = f"{requirement.remedy}, or effects.{effect.name}: off"
                if grid.any_point_meets(
                    {parameter.path: applies_to, requirement.other_path: requirement.is_broken_by}
                ):
                    yield grid.make_finding(parameter.path, requirement.problem, remedy)
                elif (
                    requirement.applies_if_forced_on
                    and mode == ON
                    and grid.any_point_meets({requirement.other_path: requirement.is_broken_by})
                ):
                    yield _effect_mode_finding(effect.name, requirement.problem, remedy)


def _record_and_filter_findings(grid: GridValues) -> Iterator[Finding]:
    """Yield a `Finding` for a complex record of direct detection, and for a useless filter.

    The filter is the anti-alias filter. It is useless if it is wider than the sample rate, or if
    ``noise_shape: white`` ignores it.
    """
    if grid.any_point_meets(
        {
            RECORD_TYPE_PATH: condition_equal_to("complex"),
            beam.ARCHITECTURE_PATH: condition_equal_to("direct"),
        }
    ):
        problem = "samples I and Q, and direct detection has only one of them"
        yield grid.make_finding(
            RECORD_TYPE_PATH, problem, "take a coherent receiver, or record: real"
        )
    if (
        _least_weighted_sum(grid, {SAMPLE_RATE_PATH: 1.0, ANTIALIAS_BANDWIDTH_PATH: -1.0}) or 0.0
    ) < 0.0:
        problem = (
            "must be at most the sample rate over the whole grid: a wider filter keeps no alias"
        )
        yield grid.make_finding(
            ANTIALIAS_BANDWIDTH_PATH, f"{problem} out", "lower it, or write 'none'"
        )
    if grid.any_point_meets(
        {
            ANTIALIAS_BANDWIDTH_PATH: is_positive,
            "instrument.receiver.noise_shape": condition_equal_to("white"),
        }
    ):
        problem = "shapes the noise, which noise_shape: white leaves as it is"
        yield grid.make_finding(
            ANTIALIAS_BANDWIDTH_PATH, problem, "take noise_shape: receiver, or write 'none'"
        )


def undrawn_effect_findings(grid: GridValues) -> Iterator[Finding]:
    """Yield a `Finding` for each random effect that is active in a grid without draws."""
    problem = "is simulated by draws, and the study has none"
    for effect in EFFECTS:
        if effect.is_random and grid.effect_modes.get(effect.name) == ON:
            yield _effect_mode_finding(
                effect.name, problem, "set draws.limit or draws.number, or leave it out"
            )
    for effect, parameter in _active_random_parameters(grid):
        remedy = (
            "set draws.limit to draw until accuracy.tolerance is met, draws.number to draw so many "
            f"times, or effects.{effect.name}: off"
        )
        yield grid.make_finding(parameter.path, problem, remedy)


def flight_effect_findings(grid: GridValues, draws: SceneDraws) -> Iterator[Finding]:
    """Yield a `Finding` for each random effect or draw method that flights do not support.

    Parameters of the section ``target`` are not checked: a scene's spec has no such section.

    Parameters
    ----------
    grid : GridValues
        Parameter values of the flight.
    draws : SceneDraws
        The spec's ``draws`` section.
    """
    problem = "is not drawn in flights"
    for effect in EFFECTS:
        is_of_target = any(parameter.path.startswith("target.") for parameter in effect.parameters)
        if (
            (effect.perturb_parameters or is_of_target)
            and effect.is_random
            and grid.effect_modes.get(effect.name) == ON
        ):
            instead_text = (
                ": beams wander by platform.jitter" if effect.perturb_parameters is not None else ""
            )
            yield _effect_mode_finding(effect.name, problem, f"leave it out{instead_text}")
    yield from spectrum_method_findings(draws, grid)
    if grid.any_point_meets({waveform.SHOT_DETECTION_PATH: condition_equal_to(waveform.ANY_TWO)}):
        problem, remedy = "is not known to flights, which pair peaks", "take both_chirps"
        yield grid.make_finding(
            waveform.SHOT_DETECTION_PATH, problem, f"{remedy}, or study a flat target"
        )
    if not draws.draws_whole_spectra and grid.any_point_meets(
        {waveform.REPORTED_PEAKS_PATH: condition_equal_to(waveform.STRONGEST_PEAK)}
    ):
        problem = f"is found in whole spectra, which draws.method {draws.method!r} does not draw"
        yield grid.make_finding(
            waveform.REPORTED_PEAKS_PATH,
            problem,
            f"set draws.method: {SPECTRA_METHOD}, or take all",
        )
    voted_on = {
        looks.LOOKS_NUMBER_PATH: exceeds_one,
        looks.LOOKS_COMBINE_PATH: condition_equal_to(looks.COMBINE_BINARY),
    }
    if grid.any_point_meets(voted_on | {"footprint.speckle": condition_equal_to("developed")}):
        problem = "counts records, and flights draw no powers of echoes that fade in several"
        yield grid.make_finding(
            looks.LOOKS_COMBINE_PATH, problem, "take power, or footprint.speckle: none"
        )


def _effect_mode_finding(effect: str, problem: str, remedy: str) -> Finding:
    """Return a `Finding` about the effect named `effect`, whose mode is ``on``."""
    return Finding(("effects", effect), problem, remedy, ON)


def _active_random_parameters(grid: GridValues) -> Iterator[tuple[Effect, Parameter]]:
    """Yield the pairs of a random effect that is not off and a parameter of it that enables it.

    The parameter's value differs from its default at one point of the grid or more.
    """
    for effect in EFFECTS:
        if effect.is_random and grid.effect_modes.get(effect.name, OFF) != OFF:
            for parameter in effect.parameters:
                # A parameter whose default is not neutral (0, 0 dB, none) configures its effect
                # only.
                is_not_default = condition_different_from(parameter.default)  # type: ignore[arg-type]
                if parameter.enables_effect and grid.any_point_meets(
                    {parameter.path: is_not_default}
                ):
                    yield effect, parameter


# Detectors and estimators


def is_detector_or_estimator_parameter(path: str) -> bool:
    """Return True if a dotted path is a parameter of the detector or estimator of whole spectra."""
    return path.startswith((DETECTOR_PREFIX, ESTIMATOR_PREFIX))


def spectrum_method_findings(draws: Draws | SceneDraws, grid: GridValues) -> Iterator[Finding]:
    """Yield a `Finding` for each mistake in the detector or estimator, which examine whole spectra.

    Both need ``draws.method: spectra`` and a number of draws. The cells of a CFAR detector must fit
    into the spectrum.

    Parameters
    ----------
    draws : Draws or SceneDraws
        The spec's ``draws`` section.
    grid : GridValues
        Parameter values of the study.
    """
    yield from _drawn_noise_findings(grid, draws.method)
    if not draws.draws_whole_spectra:
        remedy = f"set draws: {{method: {SPECTRA_METHOD}, number: 1000}}, or leave it out"
        problem = f"examines whole spectra, which draws.method {draws.method!r} does not draw"
        for path in _changed_spectrum_method_paths(grid):
            yield grid.make_finding(path, problem, remedy)
    elif not draws.has_draws:
        problem, remedy = "draws whole spectra, and draws none", "set draws.number or draws.limit"
        yield Finding(("draws", "method"), problem, remedy, draws.method)
    else:
        yield from _cfar_cell_findings(grid)


def _changed_spectrum_method_paths(grid: GridValues) -> list[str]:
    """Return the dotted paths of the detector's and estimator's parameters that the spec changes.

    A changed parameter is on an axis, or its value differs from the default.
    """
    paths_on_axes = [
        parameter.path
        for axis in grid.axes
        for parameter in axis.parameters
        if is_detector_or_estimator_parameter(parameter.path)
    ]
    values = grid.field_values
    changed_paths = [
        path
        for path in SPECTRUM_METHOD_DEFAULTS
        if values.get(path, SPECTRUM_METHOD_DEFAULTS[path]) != SPECTRUM_METHOD_DEFAULTS[path]
    ]
    return [*paths_on_axes, *(path for path in changed_paths if path not in paths_on_axes)]


def _cfar_cell_findings(grid: GridValues) -> Iterator[Finding]:
    """Yield a `Finding` for each mistake in a CFAR detector's cells.

    The cells are bins next to the tested bin. Training cells measure the noise. Mistakes are an odd
    number of training cells, more cells than the spectrum has bins, and a rank above the number of
    training cells.
    """
    training, guard, rank = (
        grid.parameter_values(path) for path in (TRAINING_PATH, GUARD_PATH, RANK_PATH)
    )
    if (training % 2 == 1).any():
        yield grid.make_finding(TRAINING_PATH, "must be even", "half of them stand on either side")
    if training.size and rank.size and rank.max() > training.min():
        problem = f"must be at most detector.training, {training.min():g}, over the whole grid"
        yield grid.make_finding(RANK_PATH, problem, "lower it, or write 'auto'")
    if not grid.has_values(TRAINING_PATH, GUARD_PATH, FFT_SIZE_PATH):
        return
    n_bins = int(grid.parameter_values(FFT_SIZE_PATH).min()) // 2 - 1
    n_bins_needed = max(int(training.max() + 2 * guard.max()) + 1, _SPECTRUM_BINS_MIN)
    if n_bins < n_bins_needed:
        problem = (
            f"leaves {n_bins} bins between DC and Nyquist, and detectors need {n_bins_needed} over "
            "the "
        )
        yield grid.make_finding(
            FFT_SIZE_PATH, f"{problem}whole grid", "lengthen it, or take fewer training cells"
        )
