"""The fields of instrument and scene by dotted path: what an axis may vary."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from types import MappingProxyType
from typing import Any

from pydantic import BaseModel

from sweep.spec.instrument import Instrument
from sweep.spec.mistakes import near_miss
from sweep.spec.parts import rules_of
from sweep.spec.rules import Rule
from sweep.spec.sections import Accuracy, Atmosphere, Footprint, Target

SECTIONS: dict[str, type[BaseModel]] = {
    "instrument": Instrument,
    "target": Target,
    "atmosphere": Atmosphere,
    "footprint": Footprint,
    "accuracy": Accuracy,
}


@cache
def parameter_rules() -> MappingProxyType[str, Rule]:
    """Rule of every parameter that an axis may vary, by dotted path."""
    rules: dict[str, Rule] = {}
    for section, model in SECTIONS.items():
        rules |= rules_of(model, section)
    return MappingProxyType(rules)


def default_of(path: str) -> Any:
    """Default of a parameter, SI; None where it has none."""
    section, *rest = path.split(".")
    model: Any = SECTIONS[section]
    for name in rest[:-1]:
        model = model.model_fields[name].annotation
    field = model.model_fields[rest[-1]]
    return None if field.is_required() else field.default


def short_name(path: str) -> str:
    """Last part of a parameter's path; of what a part is, the part's own name."""
    *parts, last = path.split(".")
    return parts[-1] if last == "kind" and parts else last


def parameter_suggestion(path: str, known: Iterable[str] | None = None) -> str:
    """Suggestion for a path that names no parameter; of those known, all by default."""
    rules = list(parameter_rules() if known is None else known)
    tail = short_name(path)
    same_tail = [known for known in rules if short_name(known) == tail]
    if len(same_tail) == 1:
        return f"did you mean '{same_tail[0]}'?"
    by_tail = {short_name(known): known for known in rules}
    suggestion = near_miss(path, rules) or near_miss(tail, by_tail)
    for short, known in by_tail.items():
        suggestion = suggestion.replace(f"'{short}'", f"'{known}'")
    *others, last = SECTIONS
    return suggestion or f"axes take fields of {', '.join(others)} and {last}"
