"""Any section that a spec may have: strategies made of the sections' own models."""

from __future__ import annotations

from collections.abc import Mapping, Set
from functools import cache
from typing import Annotated, Any, get_args, get_origin

from hypothesis import strategies as st
from pydantic import BaseModel
from written_values import STYLES, Style, cheaper, values

from sweep.model.threshold import WAYS
from sweep.spec.parts import kind_of, models_at, rule_of, written_name
from sweep.spec.rules import File

THRESHOLDS = tuple(way.rsplit(".", 1)[-1] for way in WAYS)
"""Fields of which a spec has one."""

SPREADS = (0.3, 0.3, 1.0, 1.0, 3.0)
"""Decades about the examples, of most fields of a spec."""


class Parts:
    """Strategies of sections.

    Parameters
    ----------
    cheap : mapping
        Tighter bounds of fields that decide what a study costs, by the name of their model and
        their own: ``{"Footprint.beamlets": {"at_most": "30"}}``. Of a whole field, a strategy that
        takes its place.
    files : mapping
        Paths of files by the model that reads them.
    dear : set
        Fields whose defaults cost much, which are always written.
    """

    def __init__(
        self, cheap: Mapping[str, Any], files: Mapping[str, str], dear: Set[str] = frozenset()
    ) -> None:
        self.cheap, self.files, self.dear = cheap, files, dear

    @cache  # noqa: B019 - one such object a process
    def part(self, model: type[BaseModel], spread: float) -> st.SearchStrategy[dict[str, Any]]:
        """A section of a model: what it needs, and some of what it may have."""
        fields = {
            name: (written_name(name, field), field.is_required() or self._dear(model, name))
            for name, field in model.model_fields.items()
        }

        @st.composite
        def made(draw: st.DrawFn) -> dict[str, Any]:
            style, written = Style(draw(STYLES)), {}
            one = draw(st.sampled_from(THRESHOLDS)) if THRESHOLDS[0] in fields else ""
            for number, (name, (key, needed)) in enumerate(fields.items()):
                if number % 12 == 11:
                    style = Style(draw(STYLES))
                if name in THRESHOLDS and name != one:
                    continue
                if needed or name == one or style.below(4) == 3:
                    written[key] = draw(self.field(model, name, spread))
            return {key: value for key, value in written.items() if value is not ...}

        return made()

    def _dear(self, model: type[BaseModel], name: str) -> bool:
        """Whether a field is to be written, as its default costs too much."""
        return f"{model.__name__}.{name}" in self.dear

    @cache  # noqa: B019
    def field(self, model: type[BaseModel], name: str, spread: float) -> st.SearchStrategy[Any]:
        """A field's value; `...` for one that is better left out."""
        field = model.model_fields[name]
        place, rule = f"{model.__name__}.{name}", rule_of(field)
        cheap = self._cheap(model, name)
        if isinstance(cheap, st.SearchStrategy):
            return cheap
        if isinstance(rule, File):
            if place not in self.files:
                raise KeyError(f"the fuzz has no file for {place}: add one")
            return st.just(self.files[place])
        if rule is not None:
            return values(cheaper(rule, cheap) if cheap else rule, spread)
        if name == "kind":
            return st.just(kind_of(model))
        return self.below(field.annotation, spread)

    def _cheap(self, model: type[BaseModel], name: str) -> Any:
        """Bounds for a field, also where a model that this one extends has them."""
        for base in model.__mro__:
            if (place := f"{base.__name__}.{name}") in self.cheap:
                return self.cheap[place]
        return {}

    def below(self, annotation: Any, spread: float) -> st.SearchStrategy[Any]:
        """What a field holds that is no single value: a section, one of several, or a mapping."""
        if get_origin(annotation) is Annotated:
            return self.below(get_args(annotation)[0], spread)
        if get_origin(annotation) is dict:
            inner = self.below(get_args(annotation)[1], spread)
            names = st.from_regex(r"[a-z][a-z0-9_]{0,8}", fullmatch=True)
            return st.dictionaries(names, inner, min_size=1, max_size=3)
        models = models_at(annotation)
        if not models:
            raise TypeError(f"no strategy for {annotation}: add one in random_parts")
        return st.one_of([self.part(model, spread) for model in models])
