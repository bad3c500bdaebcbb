"""Random studies of a flat target: every section, any axes, few points of little cost."""

from __future__ import annotations

from fractions import Fraction
from functools import cache
from typing import Any

from hypothesis import strategies as st
from section_strategies import DECADES_OF_SPREAD, SectionStrategies
from value_strategies import (
    CHOICE_NUMBERS,
    ChoiceSource,
    is_within_bounds,
    number_strategy,
    parse_unit,
    spell_number,
    value_strategy,
    with_tighter_bounds,
)

from sweep.model import beam
from sweep.spec import GridSpec, SpecError
from sweep.spec.grid_checks import (
    ACQUISITION_DELAY_PATH,
    CHIRP_DURATION_PATH,
    RANGE_PATH,
    SAMPLE_RATE_PATH,
)
from sweep.spec.rules import NumericRule, Rule
from sweep.spec.sections import default_value, parameter_rules
from sweep.units import QuantityError

STUDY_BOUNDS: dict[str, Any] = {
    "Processing.fft_size": {"at_most": "2^12", "example": "2^10"},
    "Detector.training": {"at_most": "40", "example": "16"},
    "Detector.guard": {"at_most": "8", "example": "2"},
    "Detector.rank": {"at_most": "8", "example": "6"},
    "Footprint.beamlets": {"at_most": "12", "example": "7"},
    "Draws.number": {"at_most": "9", "example": "5"},
    "Draws.limit": {"at_most": "40", "example": "20"},
    "Draws.batch": {"at_most": "9", "example": "4"},
    "Storage.block_points": {"at_most": "40", "example": "8"},
    "Execution.workers": {"at_most": "4"},
    "Execution.threads": {"at_most": "4"},
}
"""Tighter bounds of the fields that decide what a study costs; all else is as the spec has it."""

SECTION_STRATEGIES = SectionStrategies(STUDY_BOUNDS, {}, {"Footprint.beamlets"})
SECTION_NAMES = tuple(name for name in GridSpec.model_fields if name not in ("axes", "figures"))


@cache
def axis_rules() -> dict[str, Rule]:
    """Rule of every parameter that an axis may vary, those of costly ones tightened."""
    bounds_by_tail = {
        f"{place.split('.')[0].lower()}.{place.split('.')[1]}": bounds
        for place, bounds in STUDY_BOUNDS.items()
    }
    return {
        path: with_tighter_bounds(rule, bounds_by_tail[tail])
        if (tail := ".".join(path.split(".")[-2:])) in bounds_by_tail
        else rule
        for path, rule in parameter_rules().items()
    }


@st.composite
def studies(draw: st.DrawFn) -> dict[str, Any]:
    """A study, each of whose fields is valid by itself, as written in a file."""
    decades = draw(st.sampled_from(DECADES_OF_SPREAD))
    mapping: dict[str, Any] = {}
    for name in SECTION_NAMES:
        field = GridSpec.model_fields[name]
        if field.is_required() or name == "footprint" or draw(st.booleans()):
            mapping[name] = draw(SECTION_STRATEGIES.field_value(GridSpec, name, decades))
    axes = draw(axes_strategy(axis_rules(), decades))
    if axes or draw(st.booleans()):
        mapping["axes"] = axes
    for path in paths_on_axes(axes):
        if draw(st.integers(0, 4)) < 4:
            remove_field(mapping, path)
    return without_rejected_parts(mapping) if draw(st.integers(0, 4)) < 4 else mapping


QUANTUM_EFFICIENCY_PATHS = ("instrument.receiver.responsivity", "instrument.laser.wavelength")
"""What electrons a photon follow from."""

FFT_SIZE = "instrument.processing.fft_size"
"""Too small for whole spectra, which then are not drawn, or missing."""

BEAM_PATHS = (beam.DIVERGENCE_PATH, beam.WAIST_PATH, beam.OSCILLATOR_WAIST_PATH, beam.COUPLING_PATH)
"""Parameters of which some alone make a beam, such as an aperture can make."""

WORKING_VALUES = {
    beam.DIVERGENCE_PATH: "50 urad", beam.COUPLING_PATH: beam.APERTURE_COUPLING_LAW,
    FFT_SIZE: "2^10",  # the usual size would cost much
    ACQUISITION_DELAY_PATH: "13.4 us",  # the echo of 2 km is there from 13.34 us on
}  # fmt: skip

TIMING_PATHS = (CHIRP_DURATION_PATH, ACQUISITION_DELAY_PATH, RANGE_PATH, SAMPLE_RATE_PATH)
"""Parameters that a record and the echo in it follow from."""


def without_rejected_parts(mapping: dict[str, Any]) -> dict[str, Any]:
    """The study without what its combination of values is refused for, as far as that is known."""
    for _ in range(8):
        try:
            GridSpec.from_mapping(mapping)
        except SpecError as error:
            for mistake in error.mistakes:
                _remove_rejected(mapping, mistake.path)
        else:
            break
    return mapping


def _remove_rejected(mapping: dict[str, Any], path: str) -> None:
    """Take out a field or an axis that is to blame; of a record's length, all that counts."""
    axes = mapping.get("axes", {})
    groups = {
        CHIRP_DURATION_PATH: TIMING_PATHS,
        ACQUISITION_DELAY_PATH: TIMING_PATHS,
        QUANTUM_EFFICIENCY_PATHS[0]: QUANTUM_EFFICIENCY_PATHS,
        FFT_SIZE: ("draws", FFT_SIZE),
        **dict.fromkeys(BEAM_PATHS, BEAM_PATHS),
    }
    blamed_paths = groups.get(path, (path,))
    if path.startswith("axes."):
        axis = path.removeprefix("axes.").split(".zip")[0]
        axes.pop(axis, None)
        blamed_paths = (
            groups.get(axis, (axis,)) if axis in parameter_rules() else (*TIMING_PATHS, *BEAM_PATHS)
        )
    for name in [
        name for name in axes if set(paths_on_axes({name: axes[name]})) & set(blamed_paths)
    ]:
        axes.pop(name)
    for blamed_path in blamed_paths:
        remove_field(mapping, blamed_path)
        rule = parameter_rules().get(blamed_path)
        if rule is not None and (
            default_value(blamed_path) is None or blamed_path in WORKING_VALUES
        ):
            *parents, name = blamed_path.split(".")
            parent_section = mapping
            for parent in parents:
                parent_section = parent_section.setdefault(parent, {})
            parent_section[name] = WORKING_VALUES.get(blamed_path) or rule.example  # type: ignore[attr-defined]


def paths_on_axes(axes: dict[str, Any]) -> list[str]:
    """Parameters that axes set."""
    zipped = [axis["zip"] for axis in axes.values() if isinstance(axis, dict) and "zip" in axis]
    inside_zips = [path for pieces in zipped for path in pieces[0]]
    return [path for path in axes if "." in path] + inside_zips


def remove_field(mapping: dict[str, Any], path: str) -> None:
    """Take a field out of a spec, if it is there."""
    *parents, name = path.split(".")
    parent_section: Any = mapping
    for parent in parents:
        parent_section = parent_section.get(parent) if isinstance(parent_section, dict) else None
    if isinstance(parent_section, dict):
        parent_section.pop(name, None)


@st.composite
def axes_strategy(draw: st.DrawFn, rule_by_path: dict[str, Rule], decades: float) -> dict[str, Any]:
    """A few axes of few values, plain and zipped."""
    paths = draw(st.lists(st.sampled_from(sorted(rule_by_path)), max_size=5, unique=True))
    number = draw(st.integers(1, 3))
    axes: dict[str, Any] = {}
    single_paths, zipped_paths = paths[:number], paths[number:]
    for path in single_paths:
        axes[path] = draw(axis_values(rule_by_path[path], decades))
    if zipped_paths:
        name = draw(st.sampled_from(["cut", "Case_2", "_x", "together"]))
        axes[name] = {"zip": draw(zip_pieces_strategy(zipped_paths, rule_by_path, decades))}
    return axes


@st.composite
def axis_values(draw: st.DrawFn, rule: Rule, decades: float) -> Any:
    """A list of values, a generator, or a list with generators in it; no value twice."""
    if not isinstance(rule, NumericRule) or rule.is_integer:
        return draw(distinct_values(rule, decades))
    kind = draw(st.sampled_from(["list", "list", "linear", "log", "step", "mixed"]))
    if kind == "list":
        return draw(distinct_values(rule, decades))
    if kind == "mixed":
        raw_values = [
            *draw(distinct_values(rule, decades)),
            draw(axis_generator(rule, "linear", decades)),
        ]
        return raw_values if _all_distinct(rule, raw_values) else raw_values[:-1]
    return draw(axis_generator(rule, kind, decades))


@st.composite
def distinct_values(
    draw: st.DrawFn, rule: Rule, decades: float, size: int | None = None
) -> list[Any]:
    """A list of values that differ once they are read; fewer than asked for where they don't."""
    raw_values = draw(
        st.lists(value_strategy(rule, decades), min_size=size or 1, max_size=size or 4)
    )
    raw_by_value: dict[Any, Any] = {}
    for raw_value in raw_values:
        raw_by_value.setdefault(rule.read(raw_value), raw_value)
    return raw_values if size else list(raw_by_value.values())


@st.composite
def axis_generator(draw: st.DrawFn, rule: NumericRule, kind: str, decades: float) -> Any:
    """A linear, log or step generator of two to four values within a rule's bounds."""
    first = draw(number_strategy(rule, decades))
    unit = parse_unit(rule, first.unit)
    number = draw(st.integers(2, 4))
    if kind != "step":
        last = draw(number_strategy(rule, decades, first.unit if unit.is_logarithmic else None))
        ends_si = [
            parse_unit(rule, each_number.unit).to_si(Fraction(each_number.digits))
            for each_number in (first, last)
        ]
        is_decibel = {
            parse_unit(rule, each_number.unit).is_logarithmic for each_number in (first, last)
        }
        if (
            ends_si[0] == ends_si[1]
            or len(is_decibel) > 1
            or min(ends_si) <= 0
            or unit.is_logarithmic
        ):
            return [first.text]
        if kind == "linear" or draw(st.booleans()):
            kind = draw(st.sampled_from(["linear", "log"]))
        style = ChoiceSource(draw(CHOICE_NUMBERS))
        return {kind: [spell_number(first, style), spell_number(last, style)], "number": number}
    start = Fraction(first.digits)
    step = Fraction(f"{float(start) / 8 or 0.25:.3g}") * draw(st.sampled_from([1, -1]))
    last_value = start + step * (number - 1)
    all_si = [unit.to_si(start + step * i) for i in range(number)] + [unit.to_si(last_value)]
    if step == 0 or not is_within_bounds(rule, all_si) or len(set(all_si[:-1])) < number:
        return [first.text]
    texts = [first.digits, repr(float(last_value)), repr(float(step))]
    if any(
        Fraction(each_text) != each_number
        for each_text, each_number in zip(texts, (start, last_value, step), strict=True)
    ):
        return [first.text]
    return {"step": [f"{text} {first.unit}".strip() for text in texts]}


def _all_distinct(rule: NumericRule, raw_values: list[Any]) -> bool:
    """Tell whether a mixed list holds no value twice."""
    from sweep.spec.axes import read_axis_entries
    from sweep.spec.rules import FindingsError

    try:
        si_values = [
            value
            for entry in read_axis_entries(raw_values, rule, ())
            for value in entry.si_values.tolist()
        ]
    except (FindingsError, QuantityError):
        return False
    return len(set(si_values)) == len(si_values)


@st.composite
def zip_pieces_strategy(
    draw: st.DrawFn, paths: list[str], rule_by_path: dict[str, Rule], decades: float
) -> Any:
    """Pieces of a zipped axis: lists of one length, and single values that are repeated."""
    zip_pieces = []
    for _ in range(draw(st.integers(1, 2))):
        size = draw(st.integers(1, 3))
        piece: dict[str, Any] = {}
        for path in paths:
            is_single = draw(st.integers(0, 2)) == 0
            raw_values = draw(
                distinct_values(rule_by_path[path], decades, size=1 if is_single else size)
            )
            piece[path] = raw_values[0] if is_single else raw_values
        zip_pieces.append(piece)
    return zip_pieces
