"""Valid specs, spoilt: by one change to what is written in them, or to the text of the file."""

from __future__ import annotations

import copy
from typing import Any, NamedTuple

import yaml
from hypothesis import strategies as st

from sweep.spec.rules import Numeric
from sweep.spec.sections import parameter_rules


class Spoilt(NamedTuple):
    """A spec as text, after a change."""

    text: str
    change: str
    """What was done to it, in words."""
    place: str = ""
    """Dotted path of what was changed; empty where the text itself was."""
    wrong: bool = False
    """Whether it is surely invalid now; else it may still be valid."""


Path = tuple[str | int, ...]
NOTHING = object()


def places(written: Any, path: Path = ()) -> list[Path]:
    """Every place of a mapping, sections and lists too."""
    inner = written.items() if isinstance(written, dict) else enumerate(written)
    found = []
    for key, value in inner:
        found.append((*path, key))
        if isinstance(value, dict | list):
            found += places(value, (*path, key))
    return found


def at(written: Any, path: Path) -> Any:
    """What stands at a place."""
    for key in path:
        written = written[key]
    return written


def put(written: dict[str, Any], path: Path, value: Any) -> dict[str, Any]:
    """A copy with a value at a place; NOTHING takes it out."""
    changed = copy.deepcopy(written)
    part = at(changed, path[:-1])
    if value is NOTHING:
        del part[path[-1]]
    else:
        part[path[-1]] = value
    return changed


def dotted(path: Path) -> str:
    """A place as messages have it."""
    text = ""
    for part in path:
        text += f"[{part}]" if isinstance(part, int) else f".{part}" if text else part
    return text


def dumped(written: Any) -> str:
    """A mapping as YAML."""
    return yaml.safe_dump(written, allow_unicode=True, sort_keys=False)


ODD = (
    None, True, [], {}, [[]], [None], {"a": 1}, "", " ", "nan", ".nan", "inf", "-inf m", "1e400 m",
    "-1e400", 10**30, -(10**30), "1e5000", "9" * 150, "5 5 m", "m", "5 m/0", "5 m^9999", "1_000 m",
    "0x10", "1:30", "½ m", "٣ m", "５ m", "5 mm mm", "five", "\u202e5 m", "5\u00a0m", "a" * 6000,
    "💥", "\x7f", "5 μμm", "--5 m", "5e m", "2^", "2^999", "2^-3", "%", "100 %%", "1/0", [1, [2]],
    "2020-01-01", "~", "null", "yes",
)  # fmt: skip
"""What somebody may write by mistake, nearly nowhere of use."""

WRONG_UNITS = ("5 furlongz", "5 m*", "5 kg", "5 W/m^2/nm/", "5 ghz", "5 m s kg A", "5 (m)", "5 €")
NUMERIC = {
    tail for path, rule in parameter_rules().items() if isinstance(rule, Numeric)
    for tail in [path.rsplit(".", 1)[-1]] if rule.si_unit
}  # fmt: skip


@st.composite
def _odd_value(draw: st.DrawFn, written: dict[str, Any]) -> Spoilt:
    path = draw(st.sampled_from(places(written)))
    value = draw(st.sampled_from(ODD))
    return Spoilt(dumped(put(written, path, value)), f"{value!r:.30} written", dotted(path))


@st.composite
def _wrong_unit(draw: st.DrawFn, written: dict[str, Any]) -> Spoilt:
    measured = [
        p for p in places(written) if p[-1] in NUMERIC and p[0] not in ("axes", "title", "question")
        and not isinstance(at(written, p), dict | list)
    ]  # fmt: skip
    path = draw(st.sampled_from(measured))
    value = draw(st.sampled_from(WRONG_UNITS))
    return Spoilt(dumped(put(written, path, value)), "a wrong unit", dotted(path), wrong=True)


@st.composite
def _out_of_bounds(draw: st.DrawFn, written: dict[str, Any]) -> Spoilt:
    bounded = [
        p for p in places(written)
        if isinstance(parameter_rules().get(dotted(p)), Numeric)
        and parameter_rules()[dotted(p)].si_unit != "rad"  # type: ignore[attr-defined]
    ]  # fmt: skip
    path = draw(st.sampled_from(bounded))
    rule = parameter_rules()[dotted(path)]
    assert isinstance(rule, Numeric)
    unit = f" {rule.si_unit}" if rule.si_unit else ""
    value = draw(st.sampled_from(["1e299", "-1e299"])) + unit
    return Spoilt(dumped(put(written, path, value)), "out of bounds", dotted(path), wrong=True)


@st.composite
def _misspelt(draw: st.DrawFn, written: dict[str, Any]) -> Spoilt:
    named = [
        p for p in places(written)
        if isinstance(p[-1], str) and p[:1] != ("axes",) and p[:2] != ("scene", "objects")
        and not (p[0] == "scanners" and len(p) == 2)
    ]  # fmt: skip
    path = draw(st.sampled_from(named))
    key = str(path[-1])
    other = draw(
        st.sampled_from([key + "s_", key[:-1] + "q_", key.upper(), f" {key}x", "", "é" + key])
    )
    if other == key:
        other = key + "_"
    part = at(written, path[:-1])
    renamed = {other if k == key else k: v for k, v in part.items()}
    whole = put(written, path[:-1], renamed) if path[:-1] else renamed
    return Spoilt(
        dumped(whole), f"{key!r} misspelt {other!r}", dotted((*path[:-1], other)), wrong=True
    )


@st.composite
def _taken_out(draw: st.DrawFn, written: dict[str, Any]) -> Spoilt:
    path = draw(st.sampled_from(places(written)))
    return Spoilt(dumped(put(written, path, NOTHING)), "taken out", dotted(path))


@st.composite
def _twice(draw: st.DrawFn, written: dict[str, Any]) -> Spoilt:
    top = [key for key in written if isinstance(key, str)]
    key = draw(st.sampled_from(top))
    text = dumped(written) + dumped({key: written[key]})
    return Spoilt(text, "given twice", key, wrong=True)


@st.composite
def _word(draw: st.DrawFn, written: dict[str, Any]) -> Spoilt:
    text = dumped(written)
    key = draw(st.sampled_from(["phases", "architecture", "reflectance_law", "bins_counted"]))
    section = {
        "phases": ("footprint",), "architecture": ("instrument", "receiver"),
        "reflectance_law": ("scene", "objects", "plain") if "scene" in written else ("target",),
        "bins_counted": ("instrument", "processing"),
    }[key]  # fmt: skip
    try:
        whole = put(written, (*section, key), draw(st.sampled_from(["homodin", "Lambert", "x", 5])))
    except (KeyError, TypeError):
        return Spoilt("[" + text, "a bracket before it", wrong=True)
    return Spoilt(
        dumped(whole), "a word that is none of a choice", dotted((*section, key)), wrong=True
    )


@st.composite
def _swapped(draw: st.DrawFn, written: dict[str, Any]) -> Spoilt:
    path, other = draw(st.lists(st.sampled_from(places(written)), min_size=2, max_size=2))
    value = copy.deepcopy(at(written, other))
    return Spoilt(
        dumped(put(written, path, value)), f"holds what {dotted(other)} does", dotted(path)
    )


AXES = (
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
def _wrong_axes(draw: st.DrawFn, written: dict[str, Any]) -> Spoilt:
    axes = draw(st.sampled_from(AXES))
    return Spoilt(dumped(written | {"axes": axes}), f"axes {axes!r:.60}", "axes", wrong=True)


@st.composite
def _nested(draw: st.DrawFn, written: dict[str, Any]) -> Spoilt:
    deep = draw(st.sampled_from([31, 100, 5000]))
    opening, closing = draw(st.sampled_from(["[]", "{}"]))
    inner = "a: " if opening == "{" else ""
    key = draw(st.sampled_from(["axes", "title", "deep", "instrument"]))
    whole = {k: v for k, v in written.items() if k != key}
    value = (opening + inner) * deep + "1" + closing * deep
    return Spoilt(f"{dumped(whole)}{key}: {value}\n", f"nested {deep} deep", wrong=True)


GARBAGE = (
    "", "\n", "---", "title", "- a\n- b", "5", "null", "{", "[", "}", "a: b: c", "\t", "a:\n\t- b",
    "title: 'x", "&a [*a]", "&a {b: *a}", "*nothing", "!!python/object:os.system {}", "? [a]\n: b",
    "title: !!int x", "%YAML 9.9\n---\na: 1", "a: |\n  x\n y", "\ufeff", "a: 1\n---\nb: 2",
    "title: \u2028x", "{title: x, title: y}", "<<: {title: x}", "a: &b {c: 1}\n<<: *b", "🎉", "\\",
)  # fmt: skip


@st.composite
def _garbage(draw: st.DrawFn, written: dict[str, Any]) -> Spoilt:
    text = draw(st.one_of(st.sampled_from(GARBAGE), st.text(max_size=40)))
    return Spoilt(text, "another text in its place")


@st.composite
def _cut(draw: st.DrawFn, written: dict[str, Any]) -> Spoilt:
    text = dumped(written)
    first = draw(st.integers(0, len(text)))
    length = draw(st.integers(1, 60))
    return Spoilt(text[:first] + text[first + length :], f"{length} characters cut out")


@st.composite
def _stray(draw: st.DrawFn, written: dict[str, Any]) -> Spoilt:
    text = dumped(written)
    first = draw(st.integers(0, len(text)))
    stray = draw(st.sampled_from([*"\t:{}[]'\"&*!|>%@`#,-?é\u2029\x00\x85", "\r", "- ", ": "]))
    return Spoilt(text[:first] + stray + text[first:], f"a stray {stray!r}")


WAYS = (
    _odd_value, _wrong_unit, _out_of_bounds, _misspelt, _taken_out, _twice, _word, _swapped,
    _wrong_axes, _nested, _garbage, _cut, _stray,
)  # fmt: skip


@st.composite
def spoilt(draw: st.DrawFn, specs: st.SearchStrategy[dict[str, Any]]) -> Spoilt:
    """A valid spec with something wrong with it."""
    written = draw(specs)
    way = draw(st.sampled_from(WAYS))
    return draw(way(written))
