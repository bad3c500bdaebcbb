"""Knobs of accuracy: all told, the same as a spec's, and the tolerance shared out."""

import ast
import dataclasses
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from sweep.model import error_budget
from sweep.model.error_budget import AUTOMATIC, ErrorBudget
from sweep.spec.sections import Accuracy as Section

KNOBS = {field.name: field.default for field in dataclasses.fields(ErrorBudget)}


def test_every_knob_has_a_paragraph():
    tree = ast.parse(Path(error_budget.__file__).read_text())
    (body,) = (node.body for node in tree.body if getattr(node, "name", "") == "ErrorBudget")
    told = {
        knob.target.id
        for knob, text in pairwise(body)
        if isinstance(knob, ast.AnnAssign) and isinstance(getattr(text, "value", 0), ast.Constant)
    }
    assert told == set(KNOBS)


def test_what_a_spec_may_set_is_a_knob_with_the_same_default():
    assert {name: KNOBS[name] for name in Section.model_fields} == Section().model_dump()


def test_errors_follow_from_the_tolerance_unless_they_are_given():
    points = ErrorBudget(np.array([1e-1, 1e-3]), line_error=np.array([AUTOMATIC, 1e-5]))
    assert points.allowed_line_error.tolist() == [1e-1, 1e-5]
    assert points.allowed_leakage.tolist() == [0.05, 5e-4]
    assert points.has_automatic_errors.all()
    given = ErrorBudget(1e-3, line_error=1e-5, leakage_error=np.array([1e-6, AUTOMATIC]))
    assert given.has_automatic_errors.tolist() == [False, True]


@pytest.mark.parametrize("tolerance", [1e-1, 1e-6])
def test_effects_and_beamlets_together_leave_something_for_the_lines(tolerance):
    by_tolerance = ErrorBudget(tolerance)
    both = (
        by_tolerance.allowed_effects_error(counts_beamlets=True)
        + by_tolerance.allowed_beamlets_error
    )
    assert both == pytest.approx(by_tolerance.allowed_effects_error(counts_beamlets=False))
    assert both < tolerance
