"""The least and the largest that each parameter can be: computed without a warning, or refused."""

import pytest
from base_study import base_study_mapping
from corrupted_specs import to_yaml
from study_checks import check_study

from sweep.spec.rules import NumericRule
from sweep.spec.sections import parameter_rules

RULES = {path: rule for path, rule in parameter_rules().items() if isinstance(rule, NumericRule)}


@pytest.mark.parametrize("path", RULES)
def test_a_parameter_is_as_small_or_large_as_numbers_go(path, tmp_path):
    axes = {"target.grazing_angle": ["20 deg", "90 deg"]}
    if path in axes:
        axes = {"target.range": ["10 m", "1 km"]}
    for value in (5e-324, 1e-100, 1e300):
        study = base_study_mapping({path: RULES[path].format(value)}, axes=axes)
        (tmp_path / "study.yaml").write_text(to_yaml(study))
        check_study(tmp_path / "study.yaml")
