"""docs/draws.md says what is so: its spec, its fields, its arrays."""

import re
from pathlib import Path

import yaml
from drawn_studies import study

from sweep.model.outputs import ACCURACY_OUTPUTS, DRAW_OUTPUTS, ERROR_OUTPUTS, RUNNING_OUTPUTS
from sweep.spec import Draws, Spec

PAGE = (Path(__file__).parents[2] / "docs" / "draws.md").read_text(encoding="utf-8")


def cells(start):
    """Cells of the rows of tables that begin with some words."""
    lines = [line for line in PAGE.splitlines() if line.startswith(f"| {start}")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


def test_the_spec_shown_promises_the_defaults():
    (shown,) = re.findall(r"```yaml\n(.*?)```", PAGE, re.DOTALL)
    written = yaml.load(shown, Loader=yaml.BaseLoader)
    spec = Spec.from_mapping(study({}).to_yaml_mapping() | written, base=Path("."))
    assert spec.draws.adaptive and spec.accuracy == study({}).accuracy


def test_every_field_and_every_array_is_listed():
    fields = [name.strip("`") for name, _ in cells("`draws.")]
    assert sorted(fields) == sorted(f"draws.{name}" for name in Draws.model_fields)
    arrays = {name.split("`")[1] for name, _ in cells("`") if "." not in name}
    assert arrays == {"n_draws", "pd_up_half_width", "accuracy_missed", "pd_up_error",
                      "n_detected_up", "running_sums"}  # fmt: skip
    assert arrays <= {*ACCURACY_OUTPUTS, *ERROR_OUTPUTS, *DRAW_OUTPUTS, *RUNNING_OUTPUTS}
