"""The least and the largest that each parameter can be: computed without a warning, or refused."""

import sys
from copy import deepcopy
from pathlib import Path

import pytest
import yaml
from judging import judge

from sweep.spec.fields import parameter_rules
from sweep.spec.rules import Numeric

sys.path.insert(0, str(Path(__file__).parents[1] / "tasks"))
from small import STUDY

RULES = {path: rule for path, rule in parameter_rules().items() if isinstance(rule, Numeric)}


@pytest.mark.parametrize("path", RULES)
def test_a_parameter_is_as_small_or_large_as_numbers_go(path, tmp_path):
    other = "target.range" if path == "target.grazing_angle" else "target.grazing_angle"
    *sections, name = path.split(".")
    for value in (5e-324, 1e-310, 1e-100, 1e100, 1e300):
        study = deepcopy({**STUDY, "axes": {}})
        section = study
        for each in sections:
            section = section.setdefault(each, {})
        section[name] = RULES[path].written(value)
        study["axes"] = {
            other: ["10 m", "1 km"] if other == "target.range" else ["20 deg", "90 deg"]
        }
        (tmp_path / "study.yaml").write_text(yaml.safe_dump(study))
        judge(tmp_path / "study.yaml")
