"""Random studies of a flat target: every section, any axes, few points of little cost."""

from __future__ import annotations

from fractions import Fraction
from functools import cache
from typing import Any

from hypothesis import strategies as st
from random_parts import SPREADS, Parts
from written_values import STYLES, Style, cheaper, inside, numbers, spelled, unit_of, values

from sweep.model import beam
from sweep.spec import Spec, SpecError
from sweep.spec.grid_rules import DELAY, DURATION, RANGE, SAMPLE_RATE
from sweep.spec.rules import Numeric, Rule
from sweep.spec.sections import default_of, parameter_rules
from sweep.units import QuantityError

CHEAP: dict[str, Any] = {
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

PARTS = Parts(CHEAP, {}, {"Footprint.beamlets"})
SECTIONS = tuple(name for name in Spec.model_fields if name not in ("axes", "figures"))


@cache
def rules() -> dict[str, Rule]:
    """Rule of every parameter that an axis may vary, those of costly ones tightened."""
    by_tail = {
        f"{place.split('.')[0].lower()}.{place.split('.')[1]}": b for place, b in CHEAP.items()
    }
    return {
        path: cheaper(rule, by_tail[tail])
        if (tail := ".".join(path.split(".")[-2:])) in by_tail
        else rule
        for path, rule in parameter_rules().items()
    }


@st.composite
def studies(draw: st.DrawFn) -> dict[str, Any]:
    """A study, each of whose fields is valid by itself, as written in a file."""
    spread = draw(st.sampled_from(SPREADS))
    written: dict[str, Any] = {}
    for name in SECTIONS:
        field = Spec.model_fields[name]
        if field.is_required() or name == "footprint" or draw(st.booleans()):
            written[name] = draw(PARTS.field(Spec, name, spread))
    axes = draw(axes_of(rules(), spread))
    if axes or draw(st.booleans()):
        written["axes"] = axes
    for path in plain_paths(axes):
        if draw(st.integers(0, 4)) < 4:
            drop(written, path)
    return mended(written) if draw(st.integers(0, 4)) < 4 else written


QUANTA = ("instrument.receiver.responsivity", "instrument.laser.wavelength")
"""What electrons a photon follow from."""

FFT_SIZE = "instrument.processing.fft_size"
"""Too small for whole spectra, which then are not drawn, or missing."""

BEAM = (beam.DIVERGENCE, beam.WAIST, beam.RECEIVED_WAIST, beam.COUPLING)
"""Parameters of which some alone make a beam, such as an aperture can make."""

GOOD = {
    beam.DIVERGENCE: "50 urad", beam.COUPLING: beam.APERTURE,
    FFT_SIZE: "2^10",  # the usual size would cost much
    DELAY: "13.4 us",  # the echo of 2 km is there from 13.34 us on
}  # fmt: skip

TIMING = (DURATION, DELAY, RANGE, SAMPLE_RATE)
"""Parameters that a record and the echo in it follow from."""


def mended(written: dict[str, Any]) -> dict[str, Any]:
    """The study without what its combination of values is refused for, as far as that is known."""
    for _ in range(8):
        try:
            Spec.from_mapping(written)
        except SpecError as error:
            for mistake in error.mistakes:
                _mend(written, mistake.path)
        else:
            break
    return written


def _mend(written: dict[str, Any], path: str) -> None:
    """Take out a field or an axis that is to blame; of a record's length, all that counts."""
    axes = written.get("axes", {})
    groups = {
        DURATION: TIMING,
        DELAY: TIMING,
        QUANTA[0]: QUANTA,
        FFT_SIZE: ("draws", FFT_SIZE),
        **dict.fromkeys(BEAM, BEAM),
    }
    blamed = groups.get(path, (path,))
    if path.startswith("axes."):
        axis = path.removeprefix("axes.").split(".zip")[0]
        axes.pop(axis, None)
        blamed = groups.get(axis, (axis,)) if axis in parameter_rules() else (*TIMING, *BEAM)
    for name in [name for name in axes if set(plain_paths({name: axes[name]})) & set(blamed)]:
        axes.pop(name)
    for each in blamed:
        drop(written, each)
        rule = parameter_rules().get(each)
        if rule is not None and (default_of(each) is None or each in GOOD):
            *parents, name = each.split(".")
            part = written
            for parent in parents:
                part = part.setdefault(parent, {})
            part[name] = GOOD.get(each) or rule.example  # type: ignore[attr-defined]


def plain_paths(axes: dict[str, Any]) -> list[str]:
    """Parameters that axes set."""
    zipped = [a["zip"] for a in axes.values() if isinstance(a, dict) and "zip" in a]
    inside_zips = [path for pieces in zipped for path in pieces[0]]
    return [path for path in axes if "." in path] + inside_zips


def drop(written: dict[str, Any], path: str) -> None:
    """Take a field out of a spec, if it is there."""
    *parents, name = path.split(".")
    part: Any = written
    for parent in parents:
        part = part.get(parent) if isinstance(part, dict) else None
    if isinstance(part, dict):
        part.pop(name, None)


@st.composite
def axes_of(draw: st.DrawFn, known: dict[str, Rule], spread: float) -> dict[str, Any]:
    """A few axes of few values, plain and zipped."""
    paths = draw(st.lists(st.sampled_from(sorted(known)), max_size=5, unique=True))
    number = draw(st.integers(1, 3))
    axes: dict[str, Any] = {}
    plain, zipped = paths[:number], paths[number:]
    for path in plain:
        axes[path] = draw(axis_values(known[path], spread))
    if zipped:
        name = draw(st.sampled_from(["cut", "Case_2", "_x", "together"]))
        axes[name] = {"zip": draw(pieces(zipped, known, spread))}
    return axes


@st.composite
def axis_values(draw: st.DrawFn, rule: Rule, spread: float) -> Any:
    """A list of values, a generator, or a list with generators in it; no value twice."""
    if not isinstance(rule, Numeric) or rule.whole:
        return draw(distinct(rule, spread))
    kind = draw(st.sampled_from(["list", "list", "linear", "log", "step", "mixed"]))
    if kind == "list":
        return draw(distinct(rule, spread))
    if kind == "mixed":
        listed = [*draw(distinct(rule, spread)), draw(generator(rule, "linear", spread))]
        return listed if _all_distinct(rule, listed) else listed[:-1]
    return draw(generator(rule, kind, spread))


@st.composite
def distinct(draw: st.DrawFn, rule: Rule, spread: float, size: int | None = None) -> list[Any]:
    """A list of values that differ once they are read; fewer than asked for where they don't."""
    listed = draw(st.lists(values(rule, spread), min_size=size or 1, max_size=size or 4))
    found: dict[Any, Any] = {}
    for written in listed:
        found.setdefault(rule.read(written), written)
    return listed if size else list(found.values())


@st.composite
def generator(draw: st.DrawFn, rule: Numeric, kind: str, spread: float) -> Any:
    """A linear, log or step generator of two to four values within a rule's bounds."""
    first = draw(numbers(rule, spread))
    unit = unit_of(rule, first.unit)
    number = draw(st.integers(2, 4))
    if kind != "step":
        last = draw(numbers(rule, spread, first.unit if unit.decibel else None))
        ends = [unit_of(rule, n.unit).to_si(Fraction(n.digits)) for n in (first, last)]
        decibels = {unit_of(rule, n.unit).decibel for n in (first, last)}
        if ends[0] == ends[1] or len(decibels) > 1 or min(ends) <= 0 or unit.decibel:
            return [first.text]
        if kind == "linear" or draw(st.booleans()):
            kind = draw(st.sampled_from(["linear", "log"]))
        style = Style(draw(STYLES))
        return {kind: [spelled(first, style), spelled(last, style)], "number": number}
    start = Fraction(first.digits)
    step = Fraction(f"{float(start) / 8 or 0.25:.3g}") * draw(st.sampled_from([1, -1]))
    last_number = start + step * (number - 1)
    all_si = [unit.to_si(start + step * i) for i in range(number)] + [unit.to_si(last_number)]
    if step == 0 or not inside(rule, all_si) or len(set(all_si[:-1])) < number:
        return [first.text]
    texts = [first.digits, repr(float(last_number)), repr(float(step))]
    if any(Fraction(t) != n for t, n in zip(texts, (start, last_number, step), strict=True)):
        return [first.text]
    return {"step": [f"{text} {first.unit}".strip() for text in texts]}


def _all_distinct(rule: Numeric, listed: list[Any]) -> bool:
    """Whether a mixed list holds no value twice."""
    from sweep.spec.axes import read_pieces
    from sweep.spec.rules import Rejected

    try:
        found = [value for piece in read_pieces(listed, rule, ()) for value in piece.si.tolist()]
    except (Rejected, QuantityError):
        return False
    return len(set(found)) == len(found)


@st.composite
def pieces(draw: st.DrawFn, paths: list[str], known: dict[str, Rule], spread: float) -> Any:
    """Pieces of a zipped axis: lists of one length, and single values that are repeated."""
    made = []
    for _ in range(draw(st.integers(1, 2))):
        size = draw(st.integers(1, 3))
        piece: dict[str, Any] = {}
        for path in paths:
            single = draw(st.integers(0, 2)) == 0
            listed = draw(distinct(known[path], spread, size=1 if single else size))
            piece[path] = listed[0] if single else listed
        made.append(piece)
    return made
