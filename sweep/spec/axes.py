"""Axes of a study: the parameters that vary, and their values.

`read_axes` reads the ``axes`` section of a spec. A plain axis varies one parameter; a zipped axis
varies several parameters together. The grid of a study has every combination of values of its axes.
"""

from __future__ import annotations

import copy
import hashlib
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

import numpy as np

from sweep.model.outputs import DRAW_BATCH_DIM, GRID_VARIABLE_NAMES
from sweep.spec.rules import (
    Finding,
    Findings,
    FrequencyErrorTableRule,
    NumericRule,
    Rule,
    SpecLocation,
    single_finding_error,
    suggest_similar_name,
)
from sweep.spec.sections import (
    AXES_REMEDY,
    MODEL_BY_SECTION,
    SECTIONS_NOT_ON_AXES,
    parameter_rules,
    parameter_short_name,
    suggest_parameter,
)
from sweep.units import ExactQuantity, QuantityError, Unit

RESERVED_DIMENSION_NAMES = (DRAW_BATCH_DIM, "draw", "point", "spec", "study_id")
"""Names that no axis may have, because a store uses them for dimensions besides its axes."""

STUDY_MARKER_NAME_PATTERN = re.compile("study_[0-9a-f]{16}")
"""Regular expression for the name of a study marker: ``study_`` and 16 hexadecimal digits.

A study marker is a coordinate that marks the study from which the points of a dataset come. No
zipped axis may have a name of this pattern.
"""

_AXIS_NAME_PATTERN = re.compile(r"[A-Za-z_][A-Za-z0-9_]{0,60}")
"""Regular expression for the name of a zipped axis, along which several parameters vary
together."""
_VALUES_LISTED_IN_IDENTITY_MAX = 64
"""Largest number of values of an axis that a study's identity lists one by one.

For a longer axis the identity holds a digest of the values.
"""
_AXIS_NAME_REMEDY = "take a word such as 'cut'"


@dataclass(frozen=True, eq=False)
class AxisParameter:
    """One parameter that varies along an axis, with its values along the axis."""

    path: str
    """Dotted path of the parameter, such as ``target.range``."""
    coordinate_name: str
    """Name of the parameter's coordinate in the store."""
    values: np.ndarray | tuple[str, ...]
    """Values (n,) along the axis: an array of float64 or int64 in SI units, or a tuple of n words
    if the parameter takes words."""
    display_values: np.ndarray
    """Values (n,) along the axis as an array in the unit `units`, or of words if the parameter
    takes words."""
    units: str
    """Unit in which the user wrote the values; empty if the parameter has no unit."""


@dataclass(frozen=True)
class Axis:
    """One dimension of a study's grid, along which one parameter or several vary."""

    name: str
    """Name of the dimension in the store."""
    parameters: tuple[AxisParameter, ...]
    """Parameters along the axis: one, or several that vary together."""

    @property
    def size(self) -> int:
        """Number of values along the axis."""
        return len(self.parameters[0].values)

    @property
    def is_zipped(self) -> bool:
        """True if several parameters vary along the axis, or the axis has a name of its own."""
        return len(self.parameters) > 1 or self.parameters[0].coordinate_name != self.name


def axis_identity(axis: Axis) -> dict[str, Any]:
    """Return the part of a study's identity that describes an axis.

    Two studies are the same if their identities are equal. An axis of at most 64 values is listed
    value by value. A longer axis is given by the number of its values, the first and last value,
    and a digest of all values.

    Parameters
    ----------
    axis : Axis
        Axis to identify.

    Returns
    -------
    dict
        Data for JSON with the keys ``name`` and ``members`` (content of each parameter by path).
    """
    return {
        "name": axis.name,
        "members": {
            parameter.path: _parameter_identity(parameter) for parameter in axis.parameters
        },
    }


def _parameter_identity(parameter: AxisParameter) -> dict[str, Any]:
    """Return a dict that identifies the values of one parameter along an axis.

    Up to 64 values are listed. For more values the dict holds their number, the first value, the
    last value, and a digest of all values.
    """
    n_values, has_words = len(parameter.values), isinstance(parameter.values, tuple)
    if n_values <= _VALUES_LISTED_IN_IDENTITY_MAX:
        return {
            "values": list(parameter.values) if has_words else np.asarray(parameter.values).tolist()
        }
    if has_words:
        content = "\0".join(map(str, parameter.values)).encode()
    else:
        content = (np.asarray(parameter.values, dtype="<f8") + 0.0).tobytes()  # no -0.0
    first, last = np.asarray(parameter.values)[[0, -1]].tolist()
    digest = hashlib.blake2b(content, digest_size=16).hexdigest()
    return {"number": n_values, "first": first, "last": last, "digest": digest}


def parameter_location(path: str, axes: tuple[Axis, ...]) -> SpecLocation:
    """Return the keys that lead to a parameter's values in a spec.

    The values are on the axis over the parameter, if there is one, else in the parameter's field.
    """
    for axis in axes:
        if any(parameter.path == path for parameter in axis.parameters):
            return ("axes", axis.name if axis.is_zipped else path)
    return tuple(path.split("."))


def read_axes(raw_axes: object) -> tuple[tuple[Axis, ...], list[Finding]]:
    """Read the ``axes`` section of a spec.

    Parameters
    ----------
    raw_axes : object
        The section as parsed from YAML.

    Returns
    -------
    axes : tuple of Axis
        Axes that can be read, in the order of the spec.
    findings : list of Finding
        Every mistake in the section.
    """
    if not isinstance(raw_axes, dict):
        remedy = "write e.g. 'target.range: [1 km, 2 km]' below it, or leave it out"
        return (), [Finding(("axes",), "must be a mapping of paths to values", remedy, raw_axes)]
    axes: list[Axis] = []
    findings = Findings()
    for key, value in raw_axes.items():
        with findings.collect_errors():
            axes.append(_read_axis(str(key), value, ("axes", str(key))))
    findings += _duplicate_path_findings(raw_axes)
    return (tuple(_assign_coordinate_names(axes)), findings + _name_clash_findings(axes))


def first_values_on_axes(raw_axes: object) -> dict[str, object]:
    """Return the first value of each parameter on a spec's axes, as written, by dotted path.

    `raw_axes` is the section ``axes`` as parsed from YAML. Paths that name no parameter are left
    out. The result is empty if the section is no mapping.
    """
    first_values: dict[str, object] = {}
    for key, value in raw_axes.items() if isinstance(raw_axes, dict) else ():
        for path, values in _paths_with_raw_values(str(key), value):
            first_values.setdefault(path, _first_raw_value(values))
    return {path: value for path, value in first_values.items() if path in parameter_rules()}


def remove_fields_on_axes(raw_spec: Mapping[str, Any]) -> dict[str, Any]:
    """Return a copy of a written spec without the fields that its axes also set.

    A spec may not set a field and an axis over the same field. With this function a program can add
    an axis to a spec that already sets the field.

    Parameters
    ----------
    raw_spec : Mapping
        Spec as parsed from YAML.

    Returns
    -------
    dict
        Deep copy of the spec.

    Examples
    --------
    >>> study = {"target": {"range": "2 km", "reflectance": 0.1}}
    >>> remove_fields_on_axes({**study, "axes": {"target.range": ["1 km", "3 km"]}})
    {'target': {'reflectance': 0.1}, 'axes': {'target.range': ['1 km', '3 km']}}
    """
    result = copy.deepcopy(dict(raw_spec))
    for path in first_values_on_axes(result.get("axes")):
        *parents, name = path.split(".")
        section: Any = result
        for parent in parents:
            section = section.get(parent) if isinstance(section, dict) else None
        if isinstance(section, dict):
            section.pop(name, None)
    return result


def _paths_with_raw_values(key: str, raw_axis: object) -> list[tuple[str, object]]:
    """Return a pair (dotted path, values as written) for each parameter of an axis.

    For a zipped axis, a list of pieces, the result has one pair for each parameter of each piece.
    """
    if not isinstance(raw_axis, dict) or "zip" not in raw_axis:
        return [(key, raw_axis)]
    pieces = raw_axis["zip"] if isinstance(raw_axis["zip"], list) else [raw_axis["zip"]]
    mappings = [piece for piece in pieces if isinstance(piece, dict)]
    return [(str(path), value) for piece in mappings for path, value in piece.items()]


def _first_raw_value(values: object) -> object:
    """Return the first value of a list or generator as written in a spec; None for an empty one."""
    while isinstance(values, dict | list) and values:
        values = next(iter(values.values())) if isinstance(values, dict) else values[0]
    return None if isinstance(values, dict | list) else values


def _read_axis(key: str, raw_axis: object, location: SpecLocation) -> Axis:
    """Convert one entry of the section ``axes`` to an `Axis`.

    Raise `FindingsError` if the entry is invalid. `location` holds the keys that lead to the entry.
    """
    if isinstance(raw_axis, dict) and "zip" in raw_axis:
        return _read_zipped_axis(key, raw_axis, location)
    if key in MODEL_BY_SECTION and isinstance(raw_axis, dict):
        path, values_hint = _first_field_path_and_values_hint(key, raw_axis)
        problem = "is a section, and an axis is named by the whole path of a field"
        raise single_finding_error(location, problem, f"write '{path}: {values_hint}'")
    parameter = _make_axis_parameter(
        key, read_axis_entries(raw_axis, _axis_parameter_rule(key, location), location), location
    )
    _check_values_distinct(parameter, location)
    return Axis(parameter.coordinate_name, (parameter,))


def _first_field_path_and_values_hint(path: str, raw_section: object) -> tuple[str, str]:
    """Return the dotted path of a section's first field, and a text on how to write its values.

    The remedy for a section that a user writes under ``axes`` shows this path and this text.
    """
    while (
        isinstance(raw_section, dict)
        and raw_section
        and not set(raw_section) & set(_VALUE_GENERATOR_EXAMPLES)
    ):
        name = next(iter(raw_section))
        path, raw_section = f"{path}.{name}", raw_section[name]
    return path, "[...]" if isinstance(raw_section, list) else "{linear: [...], number: ...}"


def _axis_parameter_rule(path: str, location: SpecLocation) -> Rule:
    """Return the rule of the parameter at a dotted path.

    Raise `FindingsError` if no axis may set the parameter.
    """
    rule = parameter_rules().get(path)
    if rule is None:
        raise single_finding_error(location, *_axis_path_problem_and_remedy(path))
    if isinstance(rule, FrequencyErrorTableRule):
        raise single_finding_error(
            location, "is one table for a whole study", "put it into the instrument"
        )
    return rule


_NOT_ON_AXES_PROBLEM = "is the same for a whole study"
"""Words of the error message for a parameter that no axis may set."""


def _axis_path_problem_and_remedy(path: str) -> tuple[str, str]:
    """Return two texts, problem and remedy, on a dotted path that no axis may set."""
    section, _, name = path.partition(".")
    if path == "seed":
        problem = (
            f"{_NOT_ON_AXES_PROBLEM}: each point and draw has random numbers of its own already"
        )
        return problem, "leave it out, or run a study for each seed"
    if section == "effects" and name:
        return (
            _NOT_ON_AXES_PROBLEM,
            "run a study for each mode, and compare them with sweep compare",
        )
    if path in ("instrument", "instrument.like", "instrument.file"):
        return _NOT_ON_AXES_PROBLEM, "run a study for each, and compare them with sweep compare"
    if section in SECTIONS_NOT_ON_AXES:
        return _NOT_ON_AXES_PROBLEM, f"run a study for each value; {AXES_REMEDY}"
    return "is no parameter", suggest_parameter(path)


def _make_axis_parameter(
    path: str, entries: list[AxisEntry], location: SpecLocation
) -> AxisParameter:
    """Return the `AxisParameter` whose values are those of all entries, one after the other."""
    name = parameter_short_name(path)
    n_values = _number_of_values(entries)
    if n_values > AXIS_VALUES_MAX:
        raise single_finding_error(
            location, f"has {n_values} values, and an axis takes at most {AXIS_VALUES_MAX}"
        )
    # Use a linear unit if any entry has one: a value of zero can't be shown in decibels.
    unit = next((entry.unit for entry in entries if not entry.unit.is_logarithmic), entries[0].unit)
    values = np.concatenate([entry.si_values for entry in entries])
    if values.dtype.kind == "U":
        return AxisParameter(path, name, tuple(values.tolist()), values, "")
    display_values = np.concatenate([entry.values_in_unit(unit) for entry in entries])
    if values.dtype == np.int64 and unit.symbol == "":
        display_values = values.copy()
    values.flags.writeable = display_values.flags.writeable = False
    return AxisParameter(path, name, values, display_values, unit.symbol)


def _check_values_distinct(parameter: AxisParameter, location: SpecLocation) -> None:
    """Raise `FindingsError` if a parameter has the same value twice along its axis."""
    values = np.asarray(parameter.values)
    if values.dtype.kind != "U" and (
        np.all(values[1:] > values[:-1]) or np.all(values[1:] < values[:-1])
    ):
        return
    unique, counts = np.unique(values, return_counts=True)
    if counts.max(initial=1) > 1:
        repeated_value = parameter.display_values[
            np.argmax(values == unique[np.argmax(counts > 1)])
        ]
        value_text = f"{repeated_value} {parameter.units}".strip()
        raise single_finding_error(location, f"holds {value_text} more than once", "list it once")


# Zipped axes: several parameters that vary together, written in pieces that are concatenated


def _read_zipped_axis(key: str, raw_axis: dict[str, Any], location: SpecLocation) -> Axis:
    """Convert an entry of the section ``axes`` to a zipped `Axis`, whose parameters vary together.

    The entry is a list of pieces, whose values are joined. Every piece must set the same
    parameters. Raise `FindingsError` if the entry is invalid.
    """
    findings = Findings(
        Finding((*location, str(other)), "is no part of a zipped axis", "write {zip: [...]}")
        for other in raw_axis
        if other != "zip"
    )
    if (
        _AXIS_NAME_PATTERN.fullmatch(key) is None
        or key in RESERVED_DIMENSION_NAMES
        or STUDY_MARKER_NAME_PATTERN.fullmatch(key)
    ):
        findings.append(Finding(location, "is no name for an axis", _AXIS_NAME_REMEDY))
    raw_pieces: dict[SpecLocation, object] = {(*location, "zip"): raw_axis["zip"]}
    if raw_axis["zip"] in ([], {}, None):
        findings.append(Finding((*location, "zip"), "holds no piece", "list at least one"))
        raw_pieces = {}
    elif isinstance(raw_axis["zip"], list):
        raw_pieces = {
            (*location, "zip", i): raw_piece for i, raw_piece in enumerate(raw_axis["zip"])
        }
    pieces: list[dict[str, list[AxisEntry]]] = []
    for piece_location, raw_piece in raw_pieces.items():
        with findings.collect_errors():
            pieces.append(_read_zipped_piece(raw_piece, piece_location))
            if differing_paths := ", ".join(sorted(set(pieces[0]) ^ set(pieces[-1]))):
                problem = "must set the same parameters as the first piece"
                raise single_finding_error(piece_location, problem, f"mind {differing_paths}")
    findings.raise_if_any()
    joined_entries = {
        path: [entry for piece in pieces for entry in piece[path]] for path in pieces[0]
    }
    return Axis(
        key,
        tuple(
            _make_axis_parameter(path, entries, location)
            for path, entries in joined_entries.items()
        ),
    )


def _read_zipped_piece(raw_piece: object, location: SpecLocation) -> dict[str, list[AxisEntry]]:
    """Return the `AxisEntry` objects of one piece of a zipped axis, by the parameter's path.

    All parameters of the piece have equally many values: a single value is repeated as often as
    needed. Raise `FindingsError` if the piece is invalid.
    """
    if not isinstance(raw_piece, dict) or not raw_piece:
        raise single_finding_error(location, "must be a mapping of paths to values", "", raw_piece)
    findings = Findings()
    entries_by_path: dict[str, list[AxisEntry]] = {}
    for path, raw_value in raw_piece.items():
        value_location = (*location, str(path))
        with findings.collect_errors():
            rule = _axis_parameter_rule(str(path), value_location)
            if isinstance(raw_value, dict | list):
                entries_by_path[path] = read_axis_entries(raw_value, rule, value_location)
            else:
                entries_by_path[path] = [read_single_value(raw_value, rule, value_location)]
    lengths = {
        path: _number_of_values(entries_by_path[path])
        for path in entries_by_path
        if isinstance(raw_piece[path], dict | list)
    }
    if len(set(lengths.values())) > 1:
        lengths_text = ", ".join(f"{path} has {n}" for path, n in lengths.items())
        findings.append(Finding(location, f"must give equal numbers of values: {lengths_text}"))
    findings.raise_if_any()
    length = max(lengths.values(), default=1)
    return {
        path: entries if path in lengths else [entries[0].repeat(length)]
        for path, entries in entries_by_path.items()
    }


def _number_of_values(entries: list[AxisEntry]) -> int:
    """Return the total number of values in a list of `AxisEntry`."""
    return sum(len(entry.si_values) for entry in entries)


# Names of coordinates


def _assign_coordinate_names(axes: list[Axis]) -> list[Axis]:
    """Return copies of the axes whose parameters have the coordinate names of the store.

    A coordinate's name is the shortest end of its parameter's path that no other parameter shares.
    """
    paths = [parameter.path for axis in axes for parameter in axis.parameters]
    named_axes = []
    for axis in axes:
        parameters = tuple(
            replace(parameter, coordinate_name=_coordinate_name(parameter.path, paths))
            for parameter in axis.parameters
        )
        is_plain = len(axis.parameters) == 1 and axis.name == axis.parameters[0].coordinate_name
        named_axes.append(
            Axis(parameters[0].coordinate_name if is_plain else axis.name, parameters)
        )
    return named_axes


def _coordinate_name(path: str, paths: list[str]) -> str:
    """Return the coordinate name of the parameter at `path`: the path's shortest unambiguous end.

    Underscores replace dots. No other path in `paths` has the same end, and no variable of a store
    has the same name.
    """
    keys, *other_keys = (
        parameter_path.removesuffix(".kind").split(".")
        for parameter_path in (path, *set(paths) - {path})
    )
    for length in range(1, len(keys) + 1):
        name = "_".join(keys[-length:])
        is_shared = any(other[-length:] == keys[-length:] for other in other_keys)
        if not is_shared and name not in GRID_VARIABLE_NAMES:
            break
    return name


def _duplicate_path_findings(raw_axes: dict[Any, Any]) -> list[Finding]:
    """Return a `Finding` for each parameter that is set by two axes."""
    keys_by_path: dict[str, list[str]] = {}
    for key, value in raw_axes.items():
        for path in sorted({path for path, _ in _paths_with_raw_values(str(key), value)}):
            keys_by_path.setdefault(path, []).append(str(key))
    return [
        Finding(("axes", keys[1]), f"sets {path}, which the axis '{keys[0]}' sets too")
        for path, keys in keys_by_path.items()
        if len(keys) > 1
    ]


def _name_clash_findings(axes: list[Axis]) -> list[Finding]:
    """Return a `Finding` for each zipped axis named like a store's coordinate or variable."""
    findings = []
    for axis in axes:
        other_coordinates = {
            parameter.coordinate_name
            for other in axes
            if other is not axis
            for parameter in other.parameters
        }
        own_coordinates = (
            {parameter.coordinate_name for parameter in axis.parameters}
            if len(axis.parameters) > 1
            else set()
        )
        if axis.is_zipped and axis.name in other_coordinates | own_coordinates:
            findings.append(
                Finding(("axes", axis.name), "has the name of a coordinate", _AXIS_NAME_REMEDY)
            )
        elif axis.is_zipped and axis.name in GRID_VARIABLE_NAMES:
            problem = "has the name of a variable of the store"
            findings.append(Finding(("axes", axis.name), problem, _AXIS_NAME_REMEDY))
    return findings


# Written values as arrays: single values, and linear, log or step generators. The values of a
# progression are exact fractions that are rounded once, so that a generator gives the same floats
# as a list of the same values.

AXIS_VALUES_MAX = 20_000_000
"""Maximum number of values along an axis."""
_VALUE_GENERATOR_EXAMPLES = {
    "linear": "{linear: [first, last], number: 10}",
    "log": "{log: [first, last], number: 10}",
    "step": "{step: [first, last, step]}",
}
"""Example text of each generator of values along an axis, by its keyword: linear, log or step."""
_GENERATOR_KEYWORD_BY_NUMPY_NAME = {
    "linspace": "linear",
    "geomspace": "log",
    "logspace": "log",
    "arange": "step",
}
"""Keyword of a generator of axis values (linear, log, step), by the name of the NumPy function that
it replaces."""
_NUMBER_OF_VALUES_RULE = NumericRule(
    description="", example="10", at_least="2", at_most=str(AXIS_VALUES_MAX), is_integer=True
)


# Regular values in exact arithmetic


@dataclass(frozen=True)
class Progression:
    """Arithmetic progression ``start + increment * i``, i = 0 to n_values - 1, in exact numbers."""

    start: Fraction
    """First value."""
    increment: Fraction = Fraction(0)
    """Difference of successive values."""
    n_values: int = 1
    """Number of values."""

    def apply_affine_transform(self, factor: Fraction, offset: Fraction) -> Progression:
        """Return the `Progression` whose values are ``factor * value + offset``."""
        return Progression(self.start * factor + offset, self.increment * factor, self.n_values)

    def values(self) -> np.ndarray:
        """Return the values as a float array (n_values,); each is rounded from its exact value."""
        denominator = math.lcm(self.start.denominator, self.increment.denominator)
        first, step = int(self.start * denominator), int(self.increment * denominator)
        return np.array([(first + step * i) / denominator for i in range(self.n_values)])


def _round_to_15_digits(values: np.ndarray) -> np.ndarray:
    """Return values (n,) rounded to 15 significant digits.

    Powers and logarithms may differ in the last bit between machines. Rounding to 15 digits makes
    the values equal on all machines.
    """
    magnitude = np.abs(values)
    np.floor(np.log10(magnitude, where=magnitude > 0, out=np.zeros(values.shape)), out=magnitude)
    exponent = 14 - magnitude.astype(np.int64)
    has_exact_scale = np.abs(exponent) <= 22  # powers of ten up to 1e22 are exact floats
    scale = 10.0 ** np.where(has_exact_scale, np.abs(exponent), 0)
    scaled_up, scaled_down = np.rint(values * scale) / scale, np.rint(values / scale) * scale
    return np.where(has_exact_scale, np.where(exponent >= 0, scaled_up, scaled_down), values)


def convert_from_si(unit: Unit, si_values: np.ndarray) -> np.ndarray:
    """Convert SI values to a unit; round the result to 15 significant digits.

    Parameters
    ----------
    unit : Unit
        Unit of the result; may have an offset (temperature) or be logarithmic (decibels).
    si_values : ndarray, shape (n,)
        Values in SI units.

    Returns
    -------
    ndarray, shape (n,)
        Values in `unit`.
    """
    if unit.is_logarithmic:
        return _round_to_15_digits(10.0 * np.log10(si_values / float(unit.factor)))
    if (unit.factor, unit.offset) == (1, 0):
        return _round_to_15_digits(si_values.astype(float))
    (p, q), (a, b) = unit.offset.as_integer_ratio(), unit.factor.as_integer_ratio()
    ratios = (value.as_integer_ratio() for value in si_values.tolist())
    return _round_to_15_digits(np.array([(n * q - p * d) * b / (d * q * a) for n, d in ratios]))


def read_in_unit(rule: NumericRule, raw_value: object, unit_name: str) -> float:
    """Convert a value as written in a spec to a number in a unit.

    Parameters
    ----------
    rule : NumericRule
        Rule of the field that the value belongs to.
    raw_value : object
        Value as the user wrote it, with its unit.
    unit_name : str
        Unit of the result; empty for a pure number.

    Returns
    -------
    float
        The value in `unit_name`.
    """
    quantity = rule.read_exact_number(raw_value)
    single_value = AxisEntry(
        np.array([quantity.to_si()]), quantity.unit, Progression(quantity.number)
    )
    target_unit = rule.read_exact_number(f"1 {unit_name}" if unit_name else 1).unit
    return float(single_value.values_in_unit(target_unit)[0])


# Written values


@dataclass(frozen=True)
class AxisEntry:
    """Entry in the list of values along an axis: a single value, or the values of a generator."""

    si_values: np.ndarray
    """Values (n,) in SI units; an array of words for a parameter that takes words."""
    unit: Unit
    """Unit in which the values were written; ``Unit("")`` for words."""
    progression: Progression | None = None
    """The values in `unit` as exact numbers; None for words, and for values without a constant
    difference."""

    def values_in_unit(self, unit: Unit) -> np.ndarray:
        """Return the entry's values as an array (n,), converted to `unit`."""
        if self.progression is not None and unit == self.unit:
            return self.progression.values()
        if self.progression is None or unit.is_logarithmic or self.unit.is_logarithmic:
            return convert_from_si(unit, self.si_values)
        offset = (self.unit.offset - unit.offset) / unit.factor
        return self.progression.apply_affine_transform(
            self.unit.factor / unit.factor, offset
        ).values()

    def repeat(self, n_repeats: int) -> AxisEntry:
        """Return a copy of a single-valued entry in which the value occurs `n_repeats` times."""
        progression = self.progression and replace(self.progression, n_values=n_repeats)
        return replace(
            self, si_values=np.repeat(self.si_values, n_repeats), progression=progression
        )


def read_axis_entries(raw_value: object, rule: Rule, location: SpecLocation) -> list[AxisEntry]:
    """Convert the values of one axis parameter, as written in a spec, to `AxisEntry` objects.

    Parameters
    ----------
    raw_value : object
        A list of values and generators, or one generator, as parsed from YAML.
    rule : Rule
        Rule of the field.
    location : SpecLocation
        Location of the values in the spec, for findings.

    Returns
    -------
    list of AxisEntry
        One entry for each element of the list.

    Raises
    ------
    FindingsError
        The error holds every mistake in the values.
    """
    if isinstance(raw_value, dict):
        return [_read_value_generator(raw_value, rule, location)]
    if not isinstance(raw_value, list):
        example = getattr(rule, "example", "") if raw_value is None else raw_value
        remedy = f"write e.g. [{example}] or {_VALUE_GENERATOR_EXAMPLES['linear']}"
        raise single_finding_error(location, "must be a list or a generator", remedy, raw_value)
    if not raw_value:
        raise single_finding_error(location, "holds no value", "list at least one")
    entries: list[AxisEntry] = []
    findings = Findings()
    for i, raw_entry in enumerate(raw_value):
        read_entry = _read_value_generator if isinstance(raw_entry, dict) else read_single_value
        with findings.collect_errors():
            entries.append(read_entry(raw_entry, rule, (*location, i)))
    findings.raise_if_any()
    return entries


def read_single_value(raw_value: object, rule: Rule, location: SpecLocation) -> AxisEntry:
    """Return the `AxisEntry` of one value as written: a number with its unit, or a word.

    Raises
    ------
    FindingsError
        If the value breaks the field's rule.
    """
    try:
        value = rule.read(raw_value)
        if not isinstance(rule, NumericRule):
            return AxisEntry(np.array([str(value)]), Unit(""))
        quantity = rule.read_exact_number(raw_value)
    except QuantityError as error:
        raise single_finding_error(location, error.rule, error.suggestion, raw_value) from None
    dtype = np.int64 if rule.is_integer else np.float64
    return AxisEntry(np.array([value], dtype=dtype), quantity.unit, Progression(quantity.number))


def _read_value_generator(
    raw_generator: dict[Any, Any], rule: Rule, location: SpecLocation
) -> AxisEntry:
    """Return the `AxisEntry` of a generator ``{linear: ...}``, ``{log: ...}`` or ``{step: ...}``.

    Raise `FindingsError` if the generator is invalid, or if a value is outside the bounds of the
    field that `rule` belongs to.
    """
    given_forms = [key for key in raw_generator if key in _VALUE_GENERATOR_EXAMPLES]
    if len(given_forms) != 1:
        name, value = next(iter(raw_generator.items()), ("", None))
        remedy = suggest_similar_name(
            _GENERATOR_KEYWORD_BY_NUMPY_NAME.get(str(name), str(name)), _VALUE_GENERATOR_EXAMPLES
        )
        if (
            isinstance(value, list)
            and name not in _GENERATOR_KEYWORD_BY_NUMPY_NAME
            and len(raw_generator) == 1
        ):
            remedy = remedy or f"write the list alone, without '{name}:'"
        remedy = remedy or f"write e.g. {_VALUE_GENERATOR_EXAMPLES['linear']}"
        raise single_finding_error(
            location, "must have exactly one of linear, log and step", remedy
        )
    if not isinstance(rule, NumericRule):
        raise single_finding_error(location, "takes words, which have no steps", "list them")
    form, findings = given_forms[0], Findings()
    allowed_keys = {form} if form == "step" else {form, "number"}
    remedy = f"write {_VALUE_GENERATOR_EXAMPLES[form]}"
    for key, value in raw_generator.items():
        if key not in allowed_keys:
            key_location = (*location, str(key))
            findings.append(Finding(key_location, f"is no part of '{form}'", remedy, value))
    number = 0
    if form != "step" and "number" not in raw_generator:
        findings.append(Finding(location, "lacks the number of values", remedy))
    elif form != "step":
        with findings.collect_errors((*location, "number"), raw_generator["number"]):
            number = int(_NUMBER_OF_VALUES_RULE.read(raw_generator["number"]))
    values: AxisEntry | None = None
    with findings.collect_errors():
        # Read the bounds even if the number of values can't be read, to report all mistakes at
        # once.
        values = _generate_values(form, raw_generator[form], number or 2, rule, (*location, form))
        if number or form == "step":
            _check_within_field_bounds(values, rule, location)
    findings.raise_if_any()
    assert values is not None
    return values


def _generate_values(
    form: str, raw_bounds: object, number: int, rule: NumericRule, location: SpecLocation
) -> AxisEntry:
    """Return the `AxisEntry` of a generator with the keyword `form` and the bounds `raw_bounds`.

    `number` is the number of values of a linear or log generator. Raise `FindingsError` if the
    bounds, as written in the spec, are invalid.
    """
    bounds, unit = _read_generator_bounds(form, raw_bounds, rule, location)
    if form == "step":
        return _arithmetic_values(_progression_from_bounds(bounds, location), unit, rule, location)
    if bounds[0] == bounds[1]:
        raise single_finding_error(
            location, "begins and ends with the same value", "write it as a list of one"
        )
    if form == "log":
        return _geometric_values(bounds, unit, number, rule, location)
    progression = Progression(bounds[0], (bounds[1] - bounds[0]) / (number - 1), number)
    return _arithmetic_values(progression, unit, rule, location)


def _read_generator_bounds(
    form: str, raw_bounds: object, rule: NumericRule, location: SpecLocation
) -> tuple[list[Fraction], Unit]:
    """Return the exact numbers that define a generator's values, and their common unit.

    The numbers are the first value, the last value and, if `form` is ``step``, the increment. The
    unit is that of the first value as written. Raise `FindingsError` if a number is invalid.
    """
    count = 3 if form == "step" else 2
    if not isinstance(raw_bounds, list) or len(raw_bounds) != count:
        raise single_finding_error(
            location,
            f"must be a list of {count} values",
            f"write {_VALUE_GENERATOR_EXAMPLES[form]}",
            raw_bounds,
        )
    exact_values: list[ExactQuantity] = []
    findings = Findings()
    for i, raw_bound in enumerate(raw_bounds):
        with findings.collect_errors((*location, i), raw_bound):
            exact_values.append(rule.read_exact_number(raw_bound))
            if i < 2:
                rule.read(raw_bound)
    findings.raise_if_any()
    first_unit = exact_values[0].unit
    if any(value.unit.is_logarithmic != first_unit.is_logarithmic for value in exact_values):
        raise single_finding_error(location, "mixes decibels with a plain unit", "take one of them")
    if first_unit.is_logarithmic and any(
        value.unit.factor != first_unit.factor for value in exact_values
    ):
        raise single_finding_error(
            location, "mixes units of decibels", f"take {first_unit.symbol} for all"
        )
    # An increment is a difference of values, so that the unit's offset cancels.
    offsets = [*(value.unit.offset - first_unit.offset for value in exact_values[:2]), Fraction(0)]
    return [
        (value.number * value.unit.factor + offset) / first_unit.factor
        for value, offset in zip(exact_values, offsets, strict=False)
    ], first_unit


def _progression_from_bounds(bounds: list[Fraction], location: SpecLocation) -> Progression:
    """Return the `Progression` of a step generator with the bounds [first value, last value, step].

    The last value is included if a whole number of steps leads from the first value to it. Raise
    `FindingsError` if the step is 0 or has the wrong sign.
    """
    first, last, step = bounds
    if step == 0:
        raise single_finding_error(location, "has a step of zero", "list the values")
    if (last - first) / step < 0:
        remedy = "turn its sign, or swap first and last"
        raise single_finding_error(location, "has a step that leads away from its end", remedy)
    number = math.floor((last - first) / step) + 1
    if number > AXIS_VALUES_MAX:
        problem = f"gives {number} values, and an axis has at most {AXIS_VALUES_MAX}"
        raise single_finding_error(location, problem, "take a larger step")
    return Progression(first, step, number)


def _arithmetic_values(
    progression: Progression, unit: Unit, rule: NumericRule, location: SpecLocation
) -> AxisEntry:
    """Return the `AxisEntry` of an arithmetic progression whose numbers are in `unit`.

    The values are integers if the field takes integers. Raise `FindingsError` if they are not
    whole.
    """
    if unit.is_logarithmic:
        si_values = np.array([unit.to_si(Fraction(x)) for x in progression.values().tolist()])
        return AxisEntry(si_values, unit, progression)
    si_progression = progression.apply_affine_transform(unit.factor, unit.offset)
    if not rule.is_integer:
        return AxisEntry(si_progression.values(), unit, progression)
    if si_progression.start.denominator != 1 or si_progression.increment.denominator != 1:
        raise single_finding_error(location, "gives values that are not whole", "list them")
    steps = np.arange(progression.n_values, dtype=np.int64)
    return AxisEntry(
        int(si_progression.start) + int(si_progression.increment) * steps, unit, progression
    )


def _geometric_values(
    bounds: list[Fraction], unit: Unit, number: int, rule: NumericRule, location: SpecLocation
) -> AxisEntry:
    """Return an `AxisEntry` of `number` values with a constant ratio, including both bounds.

    The ratio is constant in SI units, whatever the unit of the bounds as written. Raise
    `FindingsError` if a bound is not positive, or if the unit is decibels.
    """
    if unit.is_logarithmic:
        remedy = f"write {_VALUE_GENERATOR_EXAMPLES['linear']}"
        raise single_finding_error(
            location, "steps in decibels, which are logarithms already", remedy
        )
    first, last = (unit.to_si(bound) for bound in bounds)
    if first <= 0 or last <= 0:
        raise single_finding_error(location, "must begin and end above zero")
    si_values = _round_to_15_digits(np.geomspace(first, last, number))
    si_values[0], si_values[-1] = first, last
    if not rule.is_integer:
        return AxisEntry(si_values, unit)
    rounded = np.rint(si_values)
    if np.any(np.abs(si_values - rounded) > 1e-9 * rounded):
        raise single_finding_error(location, "gives values that are not whole", "list them")
    return AxisEntry(rounded.astype(np.int64), unit)


def _check_within_field_bounds(
    values: AxisEntry, rule: NumericRule, location: SpecLocation
) -> None:
    """Raise `FindingsError` if a value of a generator is outside the bounds of the field's rule."""
    violation = rule.first_bound_violation(values.si_values)
    if violation is not None:
        value = values.values_in_unit(values.unit)[violation.value_index]
        value_text = f"{value:.12g} {values.unit.symbol}".rstrip()
        raise single_finding_error(
            location,
            f"{violation.broken_bound_text}, and value {violation.value_index + 1} of the "
            f"generator is {value_text}",
        )
