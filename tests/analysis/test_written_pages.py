"""The pages on draws, detectors and effects say what is so: their specs, fields, arrays, code."""

import re
from pathlib import Path

import pytest
import yaml
from stored_studies import spec_over_axes

import sweep
from sweep.model.detection.estimators import ESTIMATORS
from sweep.model.effects import noise_sources
from sweep.model.effects.catalogue import EFFECTS
from sweep.model.outputs import (
    ACCURACY_OUTPUTS,
    DRAW_COUNT_OUTPUTS,
    RUNNING_SUM_OUTPUTS,
    SPECTRA_STUDY_OUTPUTS,
    STANDARD_ERROR_OUTPUTS,
)
from sweep.spec import Draws, GridSpec
from sweep.spec.sections import Detector
from sweep.tasks.studies.spectra_export import VARIABLE_ATTRIBUTES

DRAWS_PAGE, DETECTORS, EFFECTS_PAGE = (
    (Path(__file__).parents[2] / "docs" / f"{name}.md").read_text(encoding="utf-8")
    for name in ("draws", "detectors", "effects")
)


def blocks(language, page):
    return re.findall(rf"```{language}\n(.*?)```", page, re.DOTALL)


def spec_on_page(page):
    """The one spec of a page."""
    (text,) = blocks("yaml", page)
    return yaml.load(text, Loader=yaml.BaseLoader)


def rows(page, start="`"):
    """Cells of the rows of tables that begin with some words."""
    lines = [line for line in page.splitlines() if line.startswith(f"| {start}")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


def named(page):
    """Names in code in the first cells of tables."""
    cells = re.findall(r"^\| ([^|]*)\|", page, re.MULTILINE)
    return [name for cell in cells for name in re.findall(r"`([^`]*)`", cell)]


def test_the_spec_of_draws_promises_the_defaults():
    spec = GridSpec.from_mapping(
        spec_over_axes({}).to_yaml_mapping() | spec_on_page(DRAWS_PAGE), base=Path(".")
    )
    assert spec.draws.is_adaptive and spec.accuracy == spec_over_axes({}).accuracy


def test_every_field_and_every_array_of_draws_is_listed():
    fields = [name.strip("`") for name, _ in rows(DRAWS_PAGE, "`draws.")]
    assert sorted(fields) == sorted(f"draws.{name}" for name in Draws.model_fields)
    arrays = {name.split("`")[1] for name, _ in rows(DRAWS_PAGE) if "." not in name}
    assert arrays == {"n_draws", "pd_up_half_width", "accuracy_missed", "pd_up_error",
                      "n_detected_up", "running_sums"}  # fmt: skip
    assert arrays <= {
        *ACCURACY_OUTPUTS,
        *STANDARD_ERROR_OUTPUTS,
        *DRAW_COUNT_OUTPUTS,
        *RUNNING_SUM_OUTPUTS,
    }


def test_the_spec_of_detectors_is_one():
    spec_mapping, mapping = spec_on_page(DETECTORS), spec_over_axes({}).to_yaml_mapping()
    mapping["instrument"]["processing"] |= spec_mapping["instrument"]["processing"]
    mapping |= {"draws": spec_mapping["draws"], "axes": spec_mapping["axes"], "figures": []}
    assert GridSpec.from_mapping(mapping, base=Path(".")).axes[0].name == "detector"


def test_every_field_estimator_and_array_of_detectors_is_listed():
    fields = {name for name in named(DETECTORS) if name.startswith("detector.")}
    assert fields == {f"detector.{name}" for name in Detector.model_fields}
    assert set(ESTIMATORS) <= set(named(DETECTORS))
    stored = {*SPECTRA_STUDY_OUTPUTS, *ACCURACY_OUTPUTS, *DRAW_COUNT_OUTPUTS}
    about = named(DETECTORS.partition("## What is drawn")[2].partition("## False alarms")[0])
    assert {name for name in about if name != "array"} <= stored
    exported = named(DETECTORS.partition("try code outside of a study")[2])
    assert set(exported) == set(VARIABLE_ATTRIBUTES) - {"draw", "segment", "frequency"}


def test_every_effect_is_listed_in_the_order_in_which_it_acts():
    listed = [(name.strip("`"), stage) for name, stage, _, _ in rows(EFFECTS_PAGE)]
    assert listed == [(effect.name, effect.stage) for effect in EFFECTS]


def test_every_field_that_an_effect_brings_is_listed_with_it():
    for (_, _, _, fields), effect in zip(rows(EFFECTS_PAGE), EFFECTS, strict=True):
        names = {name.rsplit(".", 1)[-1] for name in re.findall(r"`([^`]*)`", fields)}
        brought = {parameter.path.rsplit(".", 1)[-1] for parameter in effect.parameters}
        assert brought <= names, effect.name


def test_the_spec_of_effects_is_one_that_can_be_written():
    spec = GridSpec.from_mapping(
        spec_over_axes({}).to_yaml_mapping() | spec_on_page(EFFECTS_PAGE), base=Path(".")
    )
    assert (
        spec.effect_modes()["leakage"] == "on" and spec.effect_modes()["footprint_phase"] == "off"
    )
    assert spec.accuracy.tolerance == 1e-3


def test_the_code_that_reads_flags_runs(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    store = Path("results/quickstart.zarr")
    store.parent.mkdir()
    sweep.run(spec_over_axes({"target.range": ["1 km", "4 km"]}), store=store, scheduler="none",
              progress=False)  # fmt: skip
    (code,) = [block for block in blocks("python", EFFECTS_PAGE) if "flag_masks" in block]
    exec(code, {})
    lines = capsys.readouterr().out.splitlines()
    assert re.fullmatch(r"range walk at \d+ % of the points", lines[0])
    assert float(lines[1].rsplit(" ", 1)[-1]) <= 1e-3


@pytest.mark.parametrize(
    "text", [b for b in blocks("python", EFFECTS_PAGE) if "flag_masks" not in b]
)
def test_the_example_is_the_modules_own_code(text):
    source = Path(noise_sources.__file__).read_text(encoding="utf-8")
    assert text in source
