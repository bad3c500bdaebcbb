"""docs/detectors.md says what is so: its spec, its fields, its arrays."""

import re
from pathlib import Path

import yaml
from drawn_studies import study

from sweep.model.estimators import ESTIMATORS
from sweep.model.outputs import ACCURACY_OUTPUTS, DRAW_OUTPUTS, SPECTRA_OUTPUTS
from sweep.spec import Spec
from sweep.spec.instrument import Detector
from sweep.tasks.spectra_export import TOLD

PAGE = (Path(__file__).parents[2] / "docs" / "detectors.md").read_text(encoding="utf-8")


def named(text):
    """Names in code in the first cells of tables."""
    cells = re.findall(r"^\| ([^|]*)\|", text, re.MULTILINE)
    return [name for cell in cells for name in re.findall(r"`([^`]*)`", cell)]


def test_the_spec_shown_is_one():
    (shown,) = re.findall(r"```yaml\n(.*?)```", PAGE, re.DOTALL)
    written = yaml.load(shown, Loader=yaml.BaseLoader)
    mapping = study({}).to_yaml_mapping()
    mapping["instrument"]["processing"] |= written["instrument"]["processing"]
    mapping |= {"draws": written["draws"], "axes": written["axes"], "figures": []}
    assert Spec.from_mapping(mapping, base=Path(".")).axes[0].name == "detector"


def test_every_field_estimator_and_array_is_listed():
    fields = {name for name in named(PAGE) if name.startswith("detector.")}
    assert fields == {f"detector.{name}" for name in Detector.model_fields}
    assert set(ESTIMATORS) <= set(named(PAGE))
    stored = {*SPECTRA_OUTPUTS, *ACCURACY_OUTPUTS, *DRAW_OUTPUTS}
    about = named(PAGE.partition("## What is drawn")[2].partition("## False alarms")[0])
    assert {name for name in about if name != "array"} <= stored
    exported = named(PAGE.partition("take spectra away")[2])
    assert set(exported) == set(TOLD) - {"draw", "segment", "frequency"}
