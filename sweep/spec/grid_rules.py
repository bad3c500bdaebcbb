"""Rules that join several fields, held against the whole grid of a study by its extremes.

A chirp longer than its echo's delay, samples to transform, no more electrons than photons; beams
that an aperture can make; effects with what they need; detectors that fit their spectra.
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

from sweep.model import beam, looks, waveform
from sweep.model.constants import ELEMENTARY_CHARGE, PLANCK, SPEED_OF_LIGHT
from sweep.model.detectors import FIXED
from sweep.model.effects import circulator_leak, iq_imbalance
from sweep.model.effects.catalogue import EFFECTS
from sweep.model.effects.effect import Effect, Parameter
from sweep.model.effects.noise_sources import SUN_RADIUS
from sweep.model.effects.phase_errors import ERROR_TABLE, NO_TABLE
from sweep.model.effects.sweep_table import sweep_table
from sweep.model.estimators import DEFAULTS, DETECTOR, ESTIMATOR
from sweep.model.preparation import RECORD
from sweep.model.waveform import ENDS, RANGES, VELOCITIES
from sweep.spec.axes import Axis, place_on_grid
from sweep.spec.parts import AUTO, OFF, ON, rules_of
from sweep.spec.rules import ABSENT, Finding
from sweep.spec.sections import SPECTRA, Draws, Effects, default_of, parameter_rules
from sweep.units import QuantityError

if TYPE_CHECKING:
    from sweep.spec.scene import SceneDraws

RANGE = "target.range"
DURATION = "instrument.chirp.duration"
DELAY = "instrument.processing.acquisition_delay"
SAMPLE_RATE = "instrument.processing.sample_rate"
FFT_SIZE = "instrument.processing.fft_size"
WINDOW = "instrument.processing.window"
RESPONSIVITY = "instrument.receiver.responsivity"
ANTIALIAS = "instrument.receiver.antialias_bandwidth"
EXTINCTION = "atmosphere.extinction"
FULL_SCALE = "instrument.processing.full_scale"
DETECTION = "instrument.processing.detection"
BINS_COUNTED = "instrument.processing.bins_counted"
LINE_WIDTH, LINE_SHAPE = "instrument.laser.line_width", "instrument.laser.line_shape"
ROUGHNESS = "target.roughness"
TRAINING, GUARD, RANK = (DETECTOR + name for name in ("training", "guard", "rank"))

_TRIED = 16
"""Samples with which windows are tried as they are read: with more they can be had."""
_FEWEST_BINS = 8
"""Bins of a spectrum that is looked at whole."""

Condition = Callable[[Any], Any]
"""Condition on each of several values."""


@dataclass(frozen=True)
class Grid:
    """Values of a study's parameters, as far as they can be read.

    Axes vary apart, and the members of one together.
    """

    values: Mapping[str, Any]
    """SI values of the parameters by dotted path; of those on axes, the value off the axis."""
    axes: tuple[Axis, ...] = ()
    modes: Mapping[str, str] = field(default_factory=dict)
    """Mode of each effect by its name."""

    @classmethod
    def of(cls, written: Mapping[str, Any], axes: tuple[Axis, ...]) -> Grid:
        """Grid of a spec as written."""
        values: dict[str, Any] = {}
        for path, rule in parameter_rules().items():
            found = at(written, path)
            with suppress(QuantityError):
                value = default_of(path) if found is ABSENT else rule.read(found)
                if value is not None:
                    values[path] = value
        modes: dict[str, str] = {}
        for name, rule in rules_of(Effects, "").items():
            with suppress(QuantityError):
                modes[name] = rule.read(at(written, f"effects.{name}", AUTO))
        return cls(values, axes, modes)

    def knows(self, *paths: str) -> bool:
        """Return true if all parameters could be read."""
        return all(self.span(path).size for path in paths)

    def span(self, path: str) -> np.ndarray:
        """Values (n,) that a parameter takes; none where it could not be read."""
        for axis in self.axes:
            for member in axis.members:
                if member.path == path:
                    return np.asarray(member.values)
        return np.asarray([self.values[path]] if path in self.values else [])

    def finding(self, path: str, rule: str, remedy: str) -> Finding:
        """Mistake in a parameter, told where its values stand."""
        return Finding(place_on_grid(path, self.axes), rule, remedy)

    def has_point(self, conditions: Mapping[str, Condition]) -> bool:
        """Return true if some point meets all conditions on parameters by path."""
        on_axes = {member.path for axis in self.axes for member in axis.members}
        for path in set(conditions) - on_axes:
            if path not in self.values or not conditions[path](np.asarray(self.values[path])):
                return False
        return all(_met(axis, conditions).any() for axis in self.axes)

    def least(
        self,
        terms: Mapping[str, Callable[[Any], Any]],
        conditions: Mapping[str, Condition] = MappingProxyType({}),
    ) -> dict[str, float]:
        """Parameters where the sum of a term of each is least, of points that meet conditions.

        Each axis adds its own least part. Empty where no point meets the conditions, or not all
        of the terms' parameters could be read.
        """
        if not self.knows(*terms) or not self.has_point(conditions):
            return {}
        found = {path: self.values[path] for path in terms if path in self.values}
        for axis in self.axes:
            own = {member.path: np.asarray(member.values) for member in axis.members}
            size = sum((term(own[p]) for p, term in terms.items() if p in own), np.zeros(axis.size))
            place = np.where(_met(axis, conditions), size, np.inf).argmin()
            found |= {path: own[path][place] for path in terms if path in own}
        return {path: float(value) for path, value in found.items()}


def at(written: Mapping[str, Any], path: str, otherwise: object = ABSENT) -> Any:
    """Value written at a dotted path."""
    found: Any = written
    for name in path.split("."):
        found = found.get(name, ABSENT) if isinstance(found, Mapping) else ABSENT
    return otherwise if found is ABSENT else found


def _met(axis: Axis, conditions: Mapping[str, Condition]) -> np.ndarray:
    """Return true for places along an axis (n,) that meet the conditions on its own parameters."""
    met = np.ones(axis.size, bool)
    for member in axis.members:
        if member.path in conditions:
            met &= conditions[member.path](np.asarray(member.values))
    return met


def _is(word: str | float) -> Condition:
    return lambda values: values == word


def _is_not(word: str | float) -> Condition:
    return lambda values: values != word


def _given(values: np.ndarray) -> np.ndarray:
    return values > 0


def _missing(values: np.ndarray) -> np.ndarray:
    return values == 0


def grid_findings(grid: Grid) -> list[Finding]:
    """Mistakes in the combinations of values in a study's grid."""
    return [
        *(list(_time_findings(grid)) or _window_findings(grid)),
        *_photon_findings(grid),
        *_table_findings(grid),
        *_beam_findings(grid),
        *_nesting_findings(grid),
        *_need_findings(grid),
        *_record_findings(grid),
        *_looks_findings(grid),
        *_search_findings(grid),
    ]


# Times and samples


def _spare(grid: Grid, weights: Mapping[str, float]) -> float | None:
    """Least weighted sum of parameters over a grid; None where not all could be read."""
    terms = {path: partial(operator.mul, weight) for path, weight in weights.items()}
    found = grid.least(terms)
    return sum(weights[path] * found[path] for path in weights) if found else None


ECHO_TIMES = (DURATION, DELAY, RANGE, SAMPLE_RATE, FFT_SIZE)
_POINTS_MAX = 10**7
"""Points of the grid of these parameters up to which all are looked at."""


def _time_findings(grid: Grid) -> Iterator[Finding]:
    """Grids in which no echo arrives before its record ends, or records of less than two samples.

    A grid some points of which have no echo is simulated: nothing is detected there.
    """
    late = _least_late(grid)
    if late is not None and late.chirp >= 0:
        rule = "must exceed the echo's delay 2R/c, and falls short by "
        rule += f"{late.chirp:.6g} s at its best"
        yield grid.finding(DURATION, rule, "shorten the range or lengthen the chirp")
        return
    if late is not None and late.record >= 0:
        rule = (
            "must let records of fft_size samples last until an echo arrives, and the whole grid's "
            f"end {late.record:.6g} s or more before the echo's delay 2R/c"
        )
        yield grid.finding(DELAY, rule, "raise it to the delay of the farthest echo, or fft_size")
        return
    samples = _fewest_samples(grid)
    if samples is not None and np.floor(samples + 1e-6) < 2:
        rule = f"must leave 2 samples after the acquisition delay, and leaves {samples:.3g}"
        yield grid.finding(DURATION, rule, "raise the sample rate or lengthen the chirp")


class _Late(NamedTuple):
    """Least time [s] over a grid from an end to the echo's arrival; negative if that is before."""

    chirp: float
    """From the chirp's end."""
    record: float
    """From the record's end, where that matters; else from the chirp's."""


def _least_late(grid: Grid) -> _Late | None:
    """Find how late the earliest echo arrives; None where it can't be told."""
    if not grid.knows(*ECHO_TIMES):
        return None
    values: dict[str, np.ndarray] = {
        path: np.asarray(grid.values[path], float) for path in ECHO_TIMES if path in grid.values
    }
    size = 1
    for number, axis in enumerate(grid.axes):
        shape = [-1 if k == number else 1 for k in range(len(grid.axes))]
        own = {m.path: m for m in axis.members if m.path in ECHO_TIMES}
        size *= axis.size if own else 1
        values |= {p: np.asarray(m.values, float).reshape(shape) for p, m in own.items()}
    if size > _POINTS_MAX:
        return None
    end, delay = values[DURATION], 2 / SPEED_OF_LIGHT * values[RANGE]
    of_chirp = float(np.min(delay - end))
    if grid.modes.get("overlap") != OFF:
        end = np.minimum(values[DELAY] + values[FFT_SIZE] / values[SAMPLE_RATE], end)
    return _Late(of_chirp, float(np.min(delay - end)))


def _fewest_samples(grid: Grid) -> float | None:
    """Fewest samples of one segment over the grid; None where it can't be told."""
    if not grid.knows(DURATION, DELAY, SAMPLE_RATE):
        return None
    weights = {DURATION: 1.0, DELAY: -1.0}
    shared: Mapping[str, Any] = {}
    for axis in grid.axes:
        own = {member.path: np.asarray(member.values) for member in axis.members}
        shared = own if SAMPLE_RATE in own else shared
    along = sum((weights[path] * shared[path] for path in weights if path in shared), 0.0)
    rest = _spare(grid, {path: weight for path, weight in weights.items() if path not in shared})
    return float(np.min(((rest or 0.0) + along) * shared.get(SAMPLE_RATE, grid.span(SAMPLE_RATE))))


def _window_findings(grid: Grid) -> Iterator[Finding]:
    """Report a window that does not exist at the length of the shortest record."""
    samples = _fewest_samples(grid)
    if samples is None or not grid.knows(WINDOW, FFT_SIZE):
        return
    from sweep.model import window

    length = int(min(grid.span(FFT_SIZE).min(), samples + 1e-6))
    for name in dict.fromkeys(grid.span(WINDOW).tolist()):
        try:
            window.samples(name, min(length, _TRIED))
        except ValueError:
            rule = f"must be one that has {length} samples, as many as the shortest record, and "
            rule += f"{name} has none of so few"
            remedy = "write another one, or raise instrument.processing.fft_size"
            yield grid.finding(WINDOW, rule, remedy)
            return


def _photon_findings(grid: Grid) -> Iterator[Finding]:
    """More electrons than photons."""
    per_metre = ELEMENTARY_CHARGE / (PLANCK * SPEED_OF_LIGHT)
    spare = _spare(grid, {beam.WAVELENGTH: per_metre, RESPONSIVITY: -1.0})
    if spare is not None and spare < 0:
        rule = (
            "must not exceed that of one electron a photon, q lambda / (h c), over the whole "
            f"grid, and does so by {-spare:.3g} A/W at its worst"
        )
        yield grid.finding(RESPONSIVITY, rule, "lower it; the gain of an avalanche is 'apd_gain'")


def _table_findings(grid: Grid) -> Iterator[Finding]:
    """Report a table of the sweep's error that does not cover the chirp."""
    text = grid.values.get(ERROR_TABLE, NO_TABLE)
    if text == NO_TABLE or not grid.knows(DURATION):
        return
    table, longest = sweep_table(text), float(grid.span(DURATION).max())
    if table.first > 1e-9 * longest or table.last < (1 - 1e-9) * longest:
        rule = f"must cover the chirp, 0 to {longest:g} s: it has {table.first:g} to {table.last:g}"
        yield grid.finding(ERROR_TABLE, f"{rule} s", "add the rows that it lacks")


# Beams

_ONE_MODE = {beam.COUPLING: _is(beam.SINGLE_MODE), beam.ARCHITECTURE: _is_not("direct")}


def _beam_findings(grid: Grid) -> Iterator[Finding]:
    """Beams that are given twice or not at all, too wide for their aperture, or too narrow."""
    if not grid.knows(beam.WAVELENGTH, beam.DIAMETER, beam.DIVERGENCE, beam.WAIST):
        return
    if grid.has_point({beam.DIVERGENCE: _missing, beam.WAIST: _missing}):
        rule = "must be given, or beam_waist in its place"
        yield grid.finding(beam.DIVERGENCE, rule, "write e.g. '50 urad'")
    elif grid.has_point({beam.DIVERGENCE: _given, beam.WAIST: _given}):
        rule = "stands beside beam_divergence, and each follows from the other"
        yield grid.finding(beam.WAIST, rule, "leave one of them out")
    else:
        yield from _width_findings(grid)


def _width_findings(grid: Grid) -> Iterator[Finding]:
    """Beams that are too wide for their aperture, or too narrow for the paraxial approximation."""
    remedy = "or set instrument.telescope.coupling: aperture, where all light mixes"
    if told := _too_narrow(grid, _ONE_MODE):
        narrow, limit = told
        rule = f"must be at least {1e6 * limit:.3g} urad, 4 M^2 lambda / (pi D): no narrower beam "
        rule += f"leaves an aperture of {1e3 * narrow[beam.DIAMETER]:.3g} mm"
        yield grid.finding(beam.DIVERGENCE, rule, f"widen the beam or the aperture, {remedy}")
    for path in (beam.WAIST, beam.RECEIVED_WAIST):
        wide = _worst(grid, {path: 1.0, beam.DIAMETER: -1.0}, _ONE_MODE | {path: _given})
        if wide and wide[path] > wide[beam.DIAMETER] / 2:
            rule = f"must be at most {500 * wide[beam.DIAMETER]:.3g} mm, the radius of the aperture"
            yield grid.finding(path, rule, f"take a smaller one, or a larger aperture, {remedy}")
        powers = {beam.QUALITY: 1.0, beam.WAVELENGTH: 1.0, path: -1.0}
        thin = _worst(grid, powers, {path: _given})
        if thin and thin[path] < (least := _fitting(thin, beam.WIDEST)):
            rule = (
                f"must be at least {1e6 * least:.3g} um, for the beam to spread by 90 deg at most"
            )
            yield grid.finding(path, rule, "take a larger one")


def too_narrow(values: Mapping[str, Any], axes: tuple[Axis, ...]) -> str:
    """Beam of a study that its aperture cannot make, in words; empty where there is none.

    Only where all light in the aperture mixes: elsewhere such a beam is refused.
    """
    for law in ({beam.COUPLING: _is(beam.APERTURE)}, {beam.ARCHITECTURE: _is("direct")}):
        if told := _too_narrow(Grid(values, axes), law):
            narrow, limit = told
            made = f"an aperture of {1e3 * narrow[beam.DIAMETER]:.3g} mm makes"
            given = f"a beam of {1e6 * narrow[beam.DIVERGENCE]:.3g} urad is narrower than"
            return f"{given} {made}, 4 M^2 lambda / (pi D) = {1e6 * limit:.3g} urad"
    return ""


def _too_narrow(grid: Grid, law: Mapping[str, Condition]) -> tuple[dict[str, float], float] | None:
    """Parameters of the narrowest beam that no aperture under a law makes, and its limit [rad]."""
    # The product of these powers is the waist over the aperture's radius, but for 4 / pi.
    rising, falling = (beam.QUALITY, beam.WAVELENGTH), (beam.DIVERGENCE, beam.DIAMETER)
    powers = dict.fromkeys(rising, 1.0) | dict.fromkeys(falling, -1.0)
    found = _worst(grid, powers, {**law, beam.DIVERGENCE: _given})
    if found and found[beam.DIVERGENCE] < (limit := _fitting(found, found[beam.DIAMETER] / 2)):
        return found, limit
    return None


def _fitting(found: Mapping[str, float], width: float) -> float:
    """Divergence [rad] of a beam with a waist [m], or waist of one with a divergence."""
    return float(beam.divergence_of(width, found[beam.WAVELENGTH], found[beam.QUALITY]))


def _worst(
    grid: Grid, powers: Mapping[str, float], conditions: Mapping[str, Condition]
) -> dict[str, float]:
    """Parameters where a product of powers of them is largest; empty where there are none."""
    terms = {path: partial(_log_power, -power) for path, power in powers.items()}
    return grid.least(terms, conditions)


def _log_power(power: float, values: np.ndarray) -> np.ndarray:
    with np.errstate(divide="ignore"):
        return np.asarray(power * np.log(values))


# Looks

MOST_VOTES = 64


def _several(number: np.ndarray) -> np.ndarray:
    return number > 1


def _looks_findings(grid: Grid) -> Iterator[Finding]:
    """Report looks whose probabilities are not known, or that contradict each other."""
    several: dict[str, Condition] = {looks.NUMBER: _several}
    by_bin: dict[str, Condition] = {looks.COMBINE: _is_not(looks.COHERENT), **several}
    added: dict[str, Condition] = {looks.COMBINE: _is(looks.COHERENT), **several}
    voted: dict[str, Condition] = {looks.COMBINE: _is(looks.BINARY), **several}
    if grid.has_point(by_bin | {DETECTION: _is("any_bin")}):
        rule = "detects by the largest bin of an echo where several records are not added in "
        rule += "amplitude: the chance that any of its bins does is known for one record alone"
        yield grid.finding(DETECTION, rule, "write 'detection: peak_bin', or combine: coherent")
    if grid.has_point(voted | {looks.NUMBER: lambda number: number > MOST_VOTES}):
        rule = f"counts the votes of at most {MOST_VOTES} records"
        yield grid.finding(looks.NUMBER, rule, "take fewer, or combine: power")
    least = grid.least({looks.NUMBER: lambda n: n, looks.VOTES: lambda m: -m}, voted)
    if least and least[looks.VOTES] > least[looks.NUMBER]:
        rule = f"asks for more than the {least[looks.NUMBER]:g} records of instrument.looks.number"
        yield grid.finding(looks.VOTES, rule, "lower it, or take more looks")
    if grid.has_point(added | {looks.SPECKLE: _is(looks.INDEPENDENT)}):
        rule = "gives each record a phase of its own, in which amplitudes do not add up"
        yield grid.finding(looks.SPECKLE, rule, "take common, or combine: power")
    if grid.has_point(added | {LINE_WIDTH: _given, LINE_SHAPE: _is("gaussian")}):
        rule = "tells nothing of the phase from one record to the next, of which the sum is made"
        yield grid.finding(LINE_SHAPE, rule, "take lorentzian, or combine: power")
    if grid.has_point(by_bin | {looks.SPECKLE: _is(looks.INDEPENDENT), ROUGHNESS: _given}):
        rule = "is drawn once a shot for a surface of stated roughness, for all its records"
        remedy = "take common, or footprint.speckle: developed without target.roughness"
        yield grid.finding(looks.SPECKLE, rule, remedy)
    if grid.has_point(
        {looks.COMBINE: _is(looks.POWER), **several, DETECTOR + "kind": _is_not(FIXED)}
    ):
        rule = "sets its threshold by the noise of one record, and here powers are averaged"
        remedy = "take fixed, or combine: binary or coherent"
        yield grid.finding(DETECTOR + "kind", rule, remedy)


def _drawn_noise(grid: Grid, method: str) -> Iterator[Finding]:
    """Noise drawn where a line of leaked light stands, or in the bins of several records."""
    if method != "probabilities" and grid.has_point({circulator_leak.PATH: _given}):
        rule = "draws noise, and instrument.telescope.leak_path has a line that is not drawn"
        yield Finding(("draws", "method"), rule, "take draws.method: probabilities", method)
    if method == "noise" and grid.has_point(
        {looks.NUMBER: _several, looks.COMBINE: _is_not(looks.COHERENT)}
    ):
        rule = "adds noise to the bins of one record, and instrument.looks.number asks for several"
        remedy = "take probabilities or spectra, or combine: coherent"
        yield Finding(("draws", "method"), rule, remedy, method)


def _search_findings(grid: Grid) -> Iterator[Finding]:
    """Search bands that lack an end, are upside down, or count bins that are not searched."""
    lacking = [path for path in ENDS if not grid.span(path).size]
    if 0 < len(lacking) < len(ENDS):
        rule = "is left out, and a beat tells of range and velocity both"
        yield Finding(tuple(lacking[0].split(".")), rule, "give all four ends, or none")
    for low, high in (RANGES, VELOCITIES):
        apart = _spare(grid, {high: 1.0, low: -1.0})
        if apart is not None and apart <= 0:
            yield grid.finding(high, f"must exceed {low}, and is {-apart:.6g} below", "raise it")
    if not lacking and grid.has_point({BINS_COUNTED: _is("all")}):
        rule = "counts bins that instrument.processing.search leaves out"
        yield grid.finding(BINS_COUNTED, rule, "write 'bins_counted: half', or leave the band out")


# Effects


class Need(NamedTuple):
    """A parameter that has no meaning with some values of another."""

    path: str
    asks: Condition
    """True if values of it need the other."""
    other: str
    """Parameter that must then have another value."""
    lacks: Condition
    """True if values of that one will not do."""
    rule: str
    remedy: str
    if_on: bool = False
    """True if the parameter's effect has the same need wherever it is forced on."""


def _above_zero(path: str, asks: Condition, other: str) -> Need:
    return Need(path, asks, other, _missing, f"needs {other}, which is 0", f"set {other}")


_OF_ONE_MODE = (
    "counts by the mode that a coherent receiver sees, and here all light in the aperture does",
    "take a coherent receiver of coupling: single_mode",
)
NEEDS = (
    *(
        Need(path, lambda value: value != 0, other, _is(word), *_OF_ONE_MODE)
        for path in (beam.SCAN_RATE, beam.SEPARATION, beam.MISALIGNMENT)
        for other, word in ((beam.COUPLING, beam.APERTURE), (beam.ARCHITECTURE, "direct"))
    ),
    *(
        Need(
            path, _is_not(default), RECORD, _is("real"),
            "is one of I and Q, and the record is real", "set instrument.receiver.record: complex",
        )
        for path, default in ((iq_imbalance.GAIN, 1.0), (iq_imbalance.PHASE, 0.0))
    ),
    _above_zero("instrument.processing.bits", _given, FULL_SCALE),
    Need(
        circulator_leak.PATH, _given, circulator_leak.ISOLATION, lambda ratio: ratio >= 1e30,
        "is that of light which leaks, and none does at an isolation of 300 dB",
        "set instrument.telescope.isolation",
    ),
    Need(
        circulator_leak.PATH, _given, looks.NUMBER, _several,
        "is that of a line which is known in one record of each segment alone",
        "take instrument.looks.number: 1",
    ),
    Need(
        circulator_leak.PATH, _given, RANGES[0], _given,
        "is that of a line which masks bins, and no law joins that with a search band",
        "leave instrument.processing.search out",
    ),
    _above_zero("atmosphere.profile", lambda p: np.isin(p, ("exponential", "layer")), EXTINCTION),
    Need(
        "target.roughness", _given, beam.ARCHITECTURE, _is("direct"),
        "makes speckle, of which direct detection averages over an unknown number",
        "take a coherent receiver", if_on=True,
    ),
    Need(
        "target.roughness", _given, "footprint.speckle", _is("developed"),
        "says how rough the target is, which developed speckle takes to be without limit",
        "set footprint.speckle: none",
    ),
    Need(
        "target.sun_distance", lambda distance: (distance > 0) & (distance < SUN_RADIUS),
        beam.WAVELENGTH, _given,
        f"must be 0, for no sun, or at least the sun's radius, {SUN_RADIUS:g} m",
        "set it to 1 au or so",
    ),
)  # fmt: skip


def _nesting_findings(grid: Grid) -> Iterator[Finding]:
    """Effects that are on within others that are off."""
    within = {effect.name: effect.within for effect in EFFECTS}
    for name, outer in within.items():
        while outer and grid.modes.get(name) == ON:
            if grid.modes.get(outer) == OFF:
                rule = f"acts within {outer}, which is off"
                yield _of_mode(name, rule, f"turn {outer} on, or leave {name} out")
            outer = within[outer]


def _need_findings(grid: Grid) -> Iterator[Finding]:
    """Parameters of effects without others that they need."""
    for need in NEEDS:
        owner = next(e for e in EFFECTS if any(p.path == need.path for p in e.parameters))
        mode = grid.modes.get(owner.name, OFF)
        remedy = f"{need.remedy}, or effects.{owner.name}: off"
        if mode != OFF and grid.has_point({need.path: need.asks, need.other: need.lacks}):
            yield grid.finding(need.path, need.rule, remedy)
        elif need.if_on and mode == ON and grid.has_point({need.other: need.lacks}):
            yield _of_mode(owner.name, need.rule, remedy)


def _record_findings(grid: Grid) -> Iterator[Finding]:
    """Complex records of direct detection; filters before the ADC that let noise fold, or stay."""
    if grid.has_point({RECORD: _is("complex"), beam.ARCHITECTURE: _is("direct")}):
        rule = "samples I and Q, of which direct detection has one"
        yield grid.finding(RECORD, rule, "take a coherent receiver, or record: real")
    if (_spare(grid, {SAMPLE_RATE: 1.0, ANTIALIAS: -1.0}) or 0.0) < 0.0:
        rule = "must be at most the sample rate over the whole grid: a wider filter keeps no alias"
        yield grid.finding(ANTIALIAS, f"{rule} out", "lower it, or write 'none'")
    if grid.has_point({ANTIALIAS: _given, "instrument.receiver.noise_shape": _is("white")}):
        rule = "shapes the noise, which noise_shape: white leaves as it is"
        yield grid.finding(ANTIALIAS, rule, "take noise_shape: receiver, or write 'none'")


def without_draws(grid: Grid) -> Iterator[Finding]:
    """Random effects that a grid has and, without draws, can't simulate."""
    rule = "is simulated by draws, and the study has none"
    for effect in EFFECTS:
        if effect.is_random and grid.modes.get(effect.name) == ON:
            yield _of_mode(effect.name, rule, "set draws.limit or draws.number, or leave it out")
    for effect, parameter in _random_and_there(grid):
        remedy = (
            "set draws.limit to draw until accuracy.tolerance is met, draws.number to draw so many "
            f"times, or effects.{effect.name}: off"
        )
        yield grid.finding(parameter.path, rule, remedy)


def not_in_flights(grid: Grid, draws: SceneDraws) -> Iterator[Finding]:
    """Random effects and methods that are asked for in a flight, and that only grids draw.

    All other random effects are drawn; a target's own parameters are told where they stand.
    """
    rule = "is not drawn in flights"
    for effect in EFFECTS:
        of_target = any(parameter.path.startswith("target.") for parameter in effect.parameters)
        if (effect.turn or of_target) and effect.is_random and grid.modes.get(effect.name) == ON:
            instead = ": beams wander by platform.jitter" if effect.turn is not None else ""
            yield _of_mode(effect.name, rule, f"leave it out{instead}")
    yield from spectra_findings(draws, grid)
    if grid.has_point({waveform.SHOT_DETECTION: _is(waveform.ANY_TWO)}):
        rule, remedy = "is not known to flights, which pair peaks", "take both_chirps"
        yield grid.finding(waveform.SHOT_DETECTION, rule, f"{remedy}, or study a flat target")
    if not draws.whole_spectra and grid.has_point({waveform.PEAKS: _is(waveform.STRONGEST)}):
        rule = f"is found in whole spectra, which draws.method {draws.method!r} does not draw"
        yield grid.finding(waveform.PEAKS, rule, f"set draws.method: {SPECTRA}, or take all")
    voted = {looks.NUMBER: _several, looks.COMBINE: _is(looks.BINARY)}
    if grid.has_point(voted | {"footprint.speckle": _is("developed")}):
        rule = "counts records, and flights draw no powers of echoes that fade in several"
        yield grid.finding(looks.COMBINE, rule, "take power, or footprint.speckle: none")


def _of_mode(effect: str, rule: str, remedy: str) -> Finding:
    """Mistakes in an effect that is on."""
    return Finding(("effects", effect), rule, remedy, ON)


def _random_and_there(grid: Grid) -> Iterator[tuple[Effect, Parameter]]:
    """Random effects that are not off, each with a parameter by which the scene has it."""
    for effect in EFFECTS:
        if effect.is_random and grid.modes.get(effect.name, OFF) != OFF:
            for parameter in effect.parameters:
                # One that is something by default only says how an effect acts.
                unlike = _is_not(parameter.default)  # type: ignore[arg-type]
                if parameter.brings and grid.has_point({parameter.path: unlike}):
                    yield effect, parameter


# Detectors and estimators


def is_method(path: str) -> bool:
    """Return true if a parameter sets the detector or estimator for whole spectra."""
    return path.startswith((DETECTOR, ESTIMATOR))


def spectra_findings(draws: Draws | SceneDraws, grid: Grid) -> Iterator[Finding]:
    """Methods without spectra to look at, spectra without draws, CFAR windows that do not fit."""
    yield from _drawn_noise(grid, draws.method)
    if not draws.whole_spectra:
        remedy = f"set draws: {{method: {SPECTRA}, number: 1000}}, or leave it out"
        rule = f"looks at whole spectra, which draws.method {draws.method!r} does not draw"
        for path in _methods(grid):
            yield grid.finding(path, rule, remedy)
    elif not draws.any:
        rule, remedy = "draws whole spectra, and draws none", "set draws.number or draws.limit"
        yield Finding(("draws", "method"), rule, remedy, draws.method)
    else:
        yield from _misfits(grid)


def _methods(grid: Grid) -> list[str]:
    """Methods' parameters that are not at their defaults."""
    on_axes = [m.path for axis in grid.axes for m in axis.members if is_method(m.path)]
    values = grid.values
    changed = [path for path in DEFAULTS if values.get(path, DEFAULTS[path]) != DEFAULTS[path]]
    return [*on_axes, *(path for path in changed if path not in on_axes)]


def _misfits(grid: Grid) -> Iterator[Finding]:
    """CFAR windows that are odd or too wide, and ranks beyond them, by the grid's extremes."""
    training, guard, rank = (grid.span(path) for path in (TRAINING, GUARD, RANK))
    if (training % 2 == 1).any():
        yield grid.finding(TRAINING, "must be even", "half of them stand on either side")
    if training.size and rank.size and rank.max() > training.min():
        rule = f"must be at most detector.training, {training.min():g}, over the whole grid"
        yield grid.finding(RANK, rule, "lower it, or write 'auto'")
    if not grid.knows(TRAINING, GUARD, FFT_SIZE):
        return
    bins = int(grid.span(FFT_SIZE).min()) // 2 - 1
    needed = max(int(training.max() + 2 * guard.max()) + 1, _FEWEST_BINS)
    if bins < needed:
        rule = f"leaves {bins} bins between DC and Nyquist, and detectors need {needed} over the "
        yield grid.finding(
            FFT_SIZE, f"{rule}whole grid", "lengthen it, or take fewer training cells"
        )
