"""Any section that a spec may have: strategies made of the sections' own models."""

from __future__ import annotations

from collections.abc import Mapping, Set
from functools import cache
from typing import Annotated, Any, get_args, get_origin

from hypothesis import strategies as st
from pydantic import BaseModel
from value_strategies import CHOICE_NUMBERS, ChoiceSource, value_strategy, with_tighter_bounds

from sweep.model.threshold import THRESHOLD_PATHS
from sweep.spec.fields import kind_of_model, models_of_annotation, rule_of_field, yaml_name
from sweep.spec.rules import FilePathRule

THRESHOLD_FIELDS = tuple(way.rsplit(".", 1)[-1] for way in THRESHOLD_PATHS)
"""Fields of which a spec has one."""

DECADES_OF_SPREAD = (0.3, 0.3, 1.0, 1.0, 3.0)
"""Decades about the examples, of most fields of a spec."""


class SectionStrategies:
    """Strategies of sections.

    Parameters
    ----------
    tighter_bounds : mapping
        Tighter bounds of fields that decide what a study costs, by the name of their model and
        their own: ``{"Footprint.beamlets": {"at_most": "30"}}``. Of a whole field, a strategy that
        takes its place.
    file_by_field : mapping
        Paths of files by the model that reads them.
    costly_defaults : set
        Fields whose defaults cost much, which are always written.
    """

    def __init__(
        self,
        tighter_bounds: Mapping[str, Any],
        file_by_field: Mapping[str, str],
        costly_defaults: Set[str] = frozenset(),
    ) -> None:
        self.tighter_bounds, self.file_by_field, self.costly_defaults = (
            tighter_bounds,
            file_by_field,
            costly_defaults,
        )

    @cache  # noqa: B019 - one such object a process
    def section(self, model: type[BaseModel], decades: float) -> st.SearchStrategy[dict[str, Any]]:
        """A section of a model: what it needs, and some of what it may have."""
        fields = {
            name: (
                yaml_name(name, field),
                field.is_required() or self._is_costly_default(model, name),
            )
            for name, field in model.model_fields.items()
        }

        @st.composite
        def section_strategy(draw: st.DrawFn) -> dict[str, Any]:
            style, section_mapping = ChoiceSource(draw(CHOICE_NUMBERS)), {}
            threshold_field = (
                draw(st.sampled_from(THRESHOLD_FIELDS)) if THRESHOLD_FIELDS[0] in fields else ""
            )
            for number, (name, (key, needed)) in enumerate(fields.items()):
                if number % 12 == 11:
                    style = ChoiceSource(draw(CHOICE_NUMBERS))
                if name in THRESHOLD_FIELDS and name != threshold_field:
                    continue
                if needed or name == threshold_field or style.choose_below(4) == 3:
                    section_mapping[key] = draw(self.field_value(model, name, decades))
            return {key: value for key, value in section_mapping.items() if value is not ...}

        return section_strategy()

    def _is_costly_default(self, model: type[BaseModel], name: str) -> bool:
        """Tell whether a field is to be written, as its default costs too much."""
        return f"{model.__name__}.{name}" in self.costly_defaults

    @cache  # noqa: B019
    def field_value(
        self, model: type[BaseModel], name: str, decades: float
    ) -> st.SearchStrategy[Any]:
        """A field's value; `...` for one that is better left out."""
        field = model.model_fields[name]
        field_path, rule = f"{model.__name__}.{name}", rule_of_field(field)
        bounds = self._tighter_bounds(model, name)
        if isinstance(bounds, st.SearchStrategy):
            return bounds
        if isinstance(rule, FilePathRule):
            if field_path not in self.file_by_field:
                raise KeyError(f"the fuzz has no file for {field_path}: add one")
            return st.just(self.file_by_field[field_path])
        if rule is not None:
            return value_strategy(with_tighter_bounds(rule, bounds) if bounds else rule, decades)
        if name == "kind":
            return st.just(kind_of_model(model))
        return self.annotated_value(field.annotation, decades)

    def _tighter_bounds(self, model: type[BaseModel], name: str) -> Any:
        """Bounds for a field, also where a model that this one extends has them."""
        for base in model.__mro__:
            if (field_path := f"{base.__name__}.{name}") in self.tighter_bounds:
                return self.tighter_bounds[field_path]
        return {}

    def annotated_value(self, annotation: Any, decades: float) -> st.SearchStrategy[Any]:
        """What a field holds that is no single value: a section, one of several, or a mapping."""
        if get_origin(annotation) is Annotated:
            return self.annotated_value(get_args(annotation)[0], decades)
        if get_origin(annotation) is dict:
            inner = self.annotated_value(get_args(annotation)[1], decades)
            names = st.from_regex(r"[a-z][a-z0-9_]{0,8}", fullmatch=True)
            return st.dictionaries(names, inner, min_size=1, max_size=3)
        models = models_of_annotation(annotation)
        if not models:
            raise TypeError(f"no strategy for {annotation}: add one in random_parts")
        return st.one_of([self.section(model, decades) for model in models])
