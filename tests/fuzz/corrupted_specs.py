"""Valid specs, spoilt: by one change to what is written in them, or to the text of the file."""

from __future__ import annotations

import copy
from typing import Any, NamedTuple

import yaml
from hypothesis import strategies as st

from sweep.spec.rules import NumericRule
from sweep.spec.sections import parameter_rules


class CorruptedSpec(NamedTuple):
    """A spec as text, after a change."""

    text: str
    change: str
    """What was done to it, in words."""
    changed_path: str = ""
    """Dotted path of what was changed; empty where the text itself was."""
    is_surely_invalid: bool = False
    """True where it is surely invalid; else it may still be valid."""


FieldPath = tuple[str | int, ...]
REMOVED = object()


def field_paths(mapping: Any, path: FieldPath = ()) -> list[FieldPath]:
    """Every place of a mapping, sections and lists too."""
    items = mapping.items() if isinstance(mapping, dict) else enumerate(mapping)
    paths = []
    for key, value in items:
        paths.append((*path, key))
        if isinstance(value, dict | list):
            paths += field_paths(value, (*path, key))
    return paths


def value_at(mapping: Any, path: FieldPath) -> Any:
    """What stands at a place."""
    for key in path:
        mapping = mapping[key]
    return mapping


def with_value(mapping: dict[str, Any], path: FieldPath, value: Any) -> dict[str, Any]:
    """A copy with a value at a place; NOTHING takes it out."""
    copied = copy.deepcopy(mapping)
    parent = value_at(copied, path[:-1])
    if value is REMOVED:
        del parent[path[-1]]
    else:
        parent[path[-1]] = value
    return copied


def dotted_path(path: FieldPath) -> str:
    """A place as messages have it."""
    text = ""
    for key in path:
        text += f"[{key}]" if isinstance(key, int) else f".{key}" if text else key
    return text


def to_yaml(mapping: Any) -> str:
    """A mapping as YAML."""
    return yaml.safe_dump(mapping, allow_unicode=True, sort_keys=False)


ODD_VALUES = (
    None, True, [], {}, [[]], [None], {"a": 1}, "", " ", "nan", ".nan", "inf", "-inf m", "1e400 m",
    "-1e400", 10**30, -(10**30), "1e5000", "9" * 150, "5 5 m", "m", "5 m/0", "5 m^9999", "1_000 m",
    "0x10", "1:30", "½ m", "٣ m", "５ m", "5 mm mm", "five", "\u202e5 m", "5\u00a0m", "a" * 6000,
    "💥", "\x7f", "5 μμm", "--5 m", "5e m", "2^", "2^999", "2^-3", "%", "100 %%", "1/0", [1, [2]],
    "2020-01-01", "~", "null", "yes",
)  # fmt: skip
"""What somebody may write by mistake, nearly nowhere of use."""

WRONG_UNITS = ("5 furlongz", "5 m*", "5 kg", "5 W/m^2/nm/", "5 ghz", "5 m s kg A", "5 (m)", "5 €")
NUMERIC_FIELDS = {
    tail for path, rule in parameter_rules().items() if isinstance(rule, NumericRule)
    for tail in [path.rsplit(".", 1)[-1]] if rule.si_unit
}  # fmt: skip


@st.composite
def _with_odd_value(draw: st.DrawFn, mapping: dict[str, Any]) -> CorruptedSpec:
    path = draw(st.sampled_from(field_paths(mapping)))
    value = draw(st.sampled_from(ODD_VALUES))
    return CorruptedSpec(
        to_yaml(with_value(mapping, path, value)), f"{value!r:.30} written", dotted_path(path)
    )


@st.composite
def _with_wrong_unit(draw: st.DrawFn, mapping: dict[str, Any]) -> CorruptedSpec:
    candidates = [
        candidate
        for candidate in field_paths(mapping)
        if candidate[-1] in NUMERIC_FIELDS
        and candidate[0] not in ("axes", "title", "question")
        and not isinstance(value_at(mapping, candidate), dict | list)
    ]
    path = draw(st.sampled_from(candidates))
    value = draw(st.sampled_from(WRONG_UNITS))
    return CorruptedSpec(
        to_yaml(with_value(mapping, path, value)),
        "a wrong unit",
        dotted_path(path),
        is_surely_invalid=True,
    )


@st.composite
def _with_value_out_of_bounds(draw: st.DrawFn, mapping: dict[str, Any]) -> CorruptedSpec:
    candidates = [
        candidate for candidate in field_paths(mapping)
        if isinstance(parameter_rules().get(dotted_path(candidate)), NumericRule)
        and parameter_rules()[dotted_path(candidate)].si_unit != "rad"  # type: ignore[attr-defined]
    ]  # fmt: skip
    path = draw(st.sampled_from(candidates))
    rule = parameter_rules()[dotted_path(path)]
    assert isinstance(rule, NumericRule)
    unit = f" {rule.si_unit}" if rule.si_unit else ""
    value = draw(st.sampled_from(["1e299", "-1e299"])) + unit
    return CorruptedSpec(
        to_yaml(with_value(mapping, path, value)),
        "out of bounds",
        dotted_path(path),
        is_surely_invalid=True,
    )


@st.composite
def _with_misspelt_key(draw: st.DrawFn, mapping: dict[str, Any]) -> CorruptedSpec:
    candidates = [
        candidate
        for candidate in field_paths(mapping)
        if isinstance(candidate[-1], str)
        and candidate[:1] != ("axes",)
        and candidate[:2] != ("scene", "objects")
        and not (candidate[0] == "scanners" and len(candidate) == 2)
    ]
    path = draw(st.sampled_from(candidates))
    key = str(path[-1])
    misspelling = draw(
        st.sampled_from([key + "s_", key[:-1] + "q_", key.upper(), f" {key}x", "", "é" + key])
    )
    if misspelling == key:
        misspelling = key + "_"
    parent = value_at(mapping, path[:-1])
    renamed = {misspelling if k == key else k: v for k, v in parent.items()}
    changed_mapping = with_value(mapping, path[:-1], renamed) if path[:-1] else renamed
    return CorruptedSpec(
        to_yaml(changed_mapping),
        f"{key!r} misspelt {misspelling!r}",
        dotted_path((*path[:-1], misspelling)),
        is_surely_invalid=True,
    )


@st.composite
def _with_field_removed(draw: st.DrawFn, mapping: dict[str, Any]) -> CorruptedSpec:
    path = draw(st.sampled_from(field_paths(mapping)))
    return CorruptedSpec(
        to_yaml(with_value(mapping, path, REMOVED)), "taken out", dotted_path(path)
    )


@st.composite
def _with_key_twice(draw: st.DrawFn, mapping: dict[str, Any]) -> CorruptedSpec:
    top_keys = [key for key in mapping if isinstance(key, str)]
    key = draw(st.sampled_from(top_keys))
    text = to_yaml(mapping) + to_yaml({key: mapping[key]})
    return CorruptedSpec(text, "given twice", key, is_surely_invalid=True)


@st.composite
def _with_wrong_choice(draw: st.DrawFn, mapping: dict[str, Any]) -> CorruptedSpec:
    text = to_yaml(mapping)
    key = draw(st.sampled_from(["phases", "architecture", "reflectance_law", "bins_counted"]))
    section = {
        "phases": ("footprint",), "architecture": ("instrument", "receiver"),
        "reflectance_law": ("scene", "objects", "plain") if "scene" in mapping else ("target",),
        "bins_counted": ("instrument", "processing"),
    }[key]  # fmt: skip
    try:
        changed_mapping = with_value(
            mapping, (*section, key), draw(st.sampled_from(["homodin", "Lambert", "x", 5]))
        )
    except (KeyError, TypeError):
        return CorruptedSpec("[" + text, "a bracket before it", is_surely_invalid=True)
    return CorruptedSpec(
        to_yaml(changed_mapping),
        "a word that is none of a choice",
        dotted_path((*section, key)),
        is_surely_invalid=True,
    )


@st.composite
def _with_value_of_other_field(draw: st.DrawFn, mapping: dict[str, Any]) -> CorruptedSpec:
    path, other_path = draw(st.lists(st.sampled_from(field_paths(mapping)), min_size=2, max_size=2))
    value = copy.deepcopy(value_at(mapping, other_path))
    return CorruptedSpec(
        to_yaml(with_value(mapping, path, value)),
        f"holds what {dotted_path(other_path)} does",
        dotted_path(path),
    )


INVALID_AXES = (
    {"target.rnge": ["1 m"]}, {"range": ["1 m"]}, {"seed": [1, 2]}, {"": ["1 m"]},
    {"target.range": []}, {"target.range": "1 m"}, {"target.range": None},
    {"target.range": ["1 m", "1 m"]}, {"target.range": {"linear": ["1 m"], "number": 3}},
    {"target.range": {"linear": ["1 m", "9 m"], "number": "many"}},
    {"target.range": {"log": ["-1 m", "9 m"], "number": 3}},
    {"target.range": {"step": ["1 m", "9 m", "0 m"]}},
    {"target.range": {"step": ["1 m", "9 km", "1e-300 m"]}},
    {"target.range": {"step": ["1 m", "9 m", "-1 m"]}}, {"target.range": {"stop": ["1 m"]}},
    {"target.range": {"linear": ["1 m", "9 m"], "number": 3, "also": 1}},
    {"target.range": {}}, {"target.range": [{}]}, {"target.range": [["1 m"]]},
    {"cut": {"zip": []}}, {"cut": {"zip": [{"target.range": ["1 m"]}, {"target.range": "x"}]}},
    {"cut": {"zip": {"target.range": ["1 m", "2 m"], "instrument.laser.power": ["1 W"]}}},
    {"batch": {"zip": {"target.range": ["1 m", "2 m"]}}}, {"cut": {"zip": "zip"}},
    {"instrument.laser": ["1 W"]}, {"instrument.laser.power.watts": ["1 W"]},
    {"axes.target.range": ["1 m"]}, 
    {"instrument.laser.power": {"linear": ["1 W", "1 m"], "number": 2}},
    {"effects.leakage": ["on"]}, {"footprint.phases": {"linear": [1, 2], "number": 2}},
    {"instrument.processing.fft_size": {"linear": [2, 5], "number": 3}},
    {"instrument.receiver.noise_figure": {"log": ["1 dB", "5 dB"], "number": 3}},
    ["target.range"], "target.range", 5,
)  # fmt: skip
"""Axes that are none."""


@st.composite
def _with_invalid_axes(draw: st.DrawFn, mapping: dict[str, Any]) -> CorruptedSpec:
    axes = draw(st.sampled_from(INVALID_AXES))
    return CorruptedSpec(
        to_yaml(mapping | {"axes": axes}), f"axes {axes!r:.60}", "axes", is_surely_invalid=True
    )


@st.composite
def _with_deep_nesting(draw: st.DrawFn, mapping: dict[str, Any]) -> CorruptedSpec:
    depth = draw(st.sampled_from([31, 100, 5000]))
    opening, closing = draw(st.sampled_from(["[]", "{}"]))
    inner = "a: " if opening == "{" else ""
    key = draw(st.sampled_from(["axes", "title", "deep", "instrument"]))
    other_sections = {k: v for k, v in mapping.items() if k != key}
    value = (opening + inner) * depth + "1" + closing * depth
    return CorruptedSpec(
        f"{to_yaml(other_sections)}{key}: {value}\n", f"nested {depth} deep", is_surely_invalid=True
    )


GARBAGE_TEXTS = (
    "", "\n", "---", "title", "- a\n- b", "5", "null", "{", "[", "}", "a: b: c", "\t", "a:\n\t- b",
    "title: 'x", "&a [*a]", "&a {b: *a}", "*nothing", "!!python/object:os.system {}", "? [a]\n: b",
    "title: !!int x", "%YAML 9.9\n---\na: 1", "a: |\n  x\n y", "\ufeff", "a: 1\n---\nb: 2",
    "title: \u2028x", "{title: x, title: y}", "<<: {title: x}", "a: &b {c: 1}\n<<: *b", "🎉", "\\",
)  # fmt: skip


@st.composite
def _replaced_by_garbage(draw: st.DrawFn, mapping: dict[str, Any]) -> CorruptedSpec:
    text = draw(st.one_of(st.sampled_from(GARBAGE_TEXTS), st.text(max_size=40)))
    return CorruptedSpec(text, "another text in its place")


@st.composite
def _with_characters_cut(draw: st.DrawFn, mapping: dict[str, Any]) -> CorruptedSpec:
    text = to_yaml(mapping)
    start = draw(st.integers(0, len(text)))
    length = draw(st.integers(1, 60))
    return CorruptedSpec(text[:start] + text[start + length :], f"{length} characters cut out")


@st.composite
def _with_inserted_character(draw: st.DrawFn, mapping: dict[str, Any]) -> CorruptedSpec:
    text = to_yaml(mapping)
    position = draw(st.integers(0, len(text)))
    character = draw(st.sampled_from([*"\t:{}[]'\"&*!|>%@`#,-?é\u2029\x00\x85", "\r", "- ", ": "]))
    return CorruptedSpec(text[:position] + character + text[position:], f"a stray {character!r}")


CORRUPTIONS = (
    _with_odd_value,
    _with_wrong_unit,
    _with_value_out_of_bounds,
    _with_misspelt_key,
    _with_field_removed,
    _with_key_twice,
    _with_wrong_choice,
    _with_value_of_other_field,
    _with_invalid_axes,
    _with_deep_nesting,
    _replaced_by_garbage,
    _with_characters_cut,
    _with_inserted_character,
)


@st.composite
def corrupted_specs(draw: st.DrawFn, specs: st.SearchStrategy[dict[str, Any]]) -> CorruptedSpec:
    """A valid spec with something wrong with it."""
    mapping = draw(specs)
    corruption = draw(st.sampled_from(CORRUPTIONS))
    return draw(corruption(mapping))
