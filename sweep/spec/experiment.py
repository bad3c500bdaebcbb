"""A study of a flat target: instrument, target, axes and how closely to look."""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import suppress
from functools import cached_property
from pathlib import Path
from typing import Any, Self

from pydantic import Field, ValidationError

from sweep.model import VERSION
from sweep.spec.axes import Axis
from sweep.spec.detector_check import is_method, spectra_findings
from sweep.spec.effect_check import without_draws, written_modes
from sweep.spec.fields import SECTIONS, values_of
from sweep.spec.figure_check import figure_findings
from sweep.spec.figures import Figure
from sweep.spec.identity import axis_identity
from sweep.spec.limits import readable
from sweep.spec.mistakes import Finding
from sweep.spec.sections import Draws, Storage, Target
from sweep.spec.study import Study


class Spec(Study):
    """A study of a flat target over a grid of parameters, every value read and checked.

    Made by `load` from a file and by `from_mapping` from plain data; values are SI.
    """

    target: Target
    draws: Draws = Draws()
    storage: Storage = Storage()
    figures: tuple[Figure, ...] = Field(default=(), description="Figures and tables of the results")

    @classmethod
    def from_stored(cls, text: str) -> Self:
        """Spec from the JSON that `to_json` gave, the same again but for its execution."""
        return cls.from_mapping(json.loads(text))

    @classmethod
    def further_findings(
        cls,
        written: Mapping[str, Any],
        axes: tuple[Axis, ...],
        base: Path | None,
        axes_are_whole: bool,
    ) -> list[Finding]:
        """Figures of what the study lacks, random effects without draws, draws without an end."""
        findings = figure_findings(written, axes) if axes_are_whole else []
        with suppress(ValidationError):
            draws, values = Draws.model_validate(written.get("draws", {})), readable(written, axes)
            findings += spectra_findings(draws, values, axes)
            if not draws.any:
                findings += without_draws(values, axes, written_modes(written))
            if draws.number and draws.adaptive:
                findings.append(_two_numbers(draws))
        return findings

    def parameters(self) -> dict[str, float | int | str]:
        """SI values of all parameters by dotted path; of those on axes, the value off the axis."""
        return {
            path: value
            for section in SECTIONS
            for path, value in values_of(getattr(self, section), section).items()
            if value is not None
        }

    @cached_property
    def has_random_effects(self) -> bool:
        """Whether anything but noise may be random at any point."""
        return any(without_draws(self.parameters(), self.axes, self.modes()))

    def identity(self) -> dict[str, Any]:
        """Content that makes the study this one, in SI values.

        Title, question, figures and execution are no part of it, nor are values that an axis
        overrides, nor is what looks at whole spectra where none are drawn. The order of the axes
        is: it lays out the arrays.
        """
        looked_at = self.draws.whole_spectra
        return {
            "model": VERSION,
            "parameters": {
                path: value
                for path, value in self.parameters_off_axes().items()
                if looked_at or not is_method(path)
            },
            "axes": [axis_identity(axis) for axis in self.axes],
            "draws": values_of(self.draws, ""),
            "effects": self.modes(),
            "seed": self.seed,
            "storage": values_of(self.storage, ""),
        }


def _two_numbers(draws: Draws) -> Finding:
    """A fixed number of draws beside a limit."""
    rule = f"stands beside draws.number, {draws.number}: only one of them can say how much to draw"
    remedy = "keep limit to draw until accuracy.tolerance is met, or number to draw so many times"
    return Finding(("draws", "limit"), rule, remedy, draws.limit)
