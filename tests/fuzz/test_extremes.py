"""The least and the largest that each parameter can be: computed without a warning, or refused."""

import pytest
from judging import judge
from plain_study import plain
from spoilt_specs import dumped

from sweep.spec.rules import Numeric
from sweep.spec.sections import parameter_rules

RULES = {path: rule for path, rule in parameter_rules().items() if isinstance(rule, Numeric)}


@pytest.mark.parametrize("path", RULES)
def test_a_parameter_is_as_small_or_large_as_numbers_go(path, tmp_path):
    axes = {"target.grazing_angle": ["20 deg", "90 deg"]}
    if path in axes:
        axes = {"target.range": ["10 m", "1 km"]}
    for value in (5e-324, 1e-100, 1e300):
        study = plain({path: RULES[path].written(value)}, axes=axes)
        (tmp_path / "study.yaml").write_text(dumped(study))
        judge(tmp_path / "study.yaml")
