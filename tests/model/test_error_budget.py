"""The error budget: documented fields, those of a spec, and shares of the tolerance."""

import ast
import dataclasses
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from sweep.model import error_budget
from sweep.model.error_budget import SET_BY_TOLERANCE, ErrorBudget
from sweep.spec.sections import Accuracy as Section

ERROR_BUDGET_DEFAULTS = {field.name: field.default for field in dataclasses.fields(ErrorBudget)}


def test_every_error_budget_field_has_a_paragraph():
    tree = ast.parse(Path(error_budget.__file__).read_text())
    (body,) = (node.body for node in tree.body if getattr(node, "name", "") == "ErrorBudget")
    documented = {
        field.target.id
        for field, text in pairwise(body)
        if isinstance(field, ast.AnnAssign) and isinstance(getattr(text, "value", 0), ast.Constant)
    }
    assert documented == set(ERROR_BUDGET_DEFAULTS)


def test_accuracy_fields_of_a_spec_are_error_budget_fields_with_the_same_default():
    assert {
        name: ERROR_BUDGET_DEFAULTS[name] for name in Section.model_fields
    } == Section().model_dump()


def test_errors_follow_from_the_tolerance_unless_they_are_given():
    points = ErrorBudget(np.array([1e-1, 1e-3]), line_error=np.array([SET_BY_TOLERANCE, 1e-5]))
    assert points.allowed_line_error.tolist() == [1e-1, 1e-5]
    assert points.allowed_leakage_error.tolist() == [0.05, 5e-4]
    assert points.has_errors_set_by_tolerance.all()
    error_budget = ErrorBudget(
        1e-3, line_error=1e-5, leakage_error=np.array([1e-6, SET_BY_TOLERANCE])
    )
    assert error_budget.has_errors_set_by_tolerance.tolist() == [False, True]


@pytest.mark.parametrize("tolerance", [1e-1, 1e-6])
def test_effects_and_beamlets_together_leave_something_for_the_lines(tolerance):
    by_tolerance = ErrorBudget(tolerance)
    joint_budget = (
        by_tolerance.allowed_effects_error(counts_beamlets=True)
        + by_tolerance.allowed_beamlets_error
    )
    assert joint_budget == pytest.approx(by_tolerance.allowed_effects_error(counts_beamlets=False))
    assert joint_budget < tolerance
