"""docs/effects.md says what is so: its list, its spec, its code."""

import re
from pathlib import Path

import pytest
import yaml
from drawn_studies import study

import sweep
from sweep.model.effects import noise_sources
from sweep.model.effects.catalogue import EFFECTS
from sweep.spec import Spec

PAGE = (Path(__file__).parents[2] / "docs" / "effects.md").read_text(encoding="utf-8")


def blocks(language):
    return re.findall(rf"```{language}\n(.*?)```", PAGE, re.DOTALL)


def rows():
    """Rows of the table of effects: name, stage, fields."""
    lines = [line for line in PAGE.splitlines() if line.startswith("| `")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


def test_every_effect_is_listed_in_the_order_in_which_it_acts():
    listed = [(name.strip("`"), stage) for name, stage, _ in rows()]
    assert listed == [(effect.name, effect.stage) for effect in EFFECTS]


def test_every_field_that_an_effect_brings_is_listed_with_it():
    for (_, _, told), effect in zip(rows(), EFFECTS, strict=True):
        names = {name.rsplit(".", 1)[-1] for name in re.findall(r"`([^`]*)`", told)}
        brought = {parameter.path.rsplit(".", 1)[-1] for parameter in effect.parameters}
        assert brought <= names, effect.name


def test_the_spec_shown_is_one_that_can_be_written():
    (shown,) = blocks("yaml")
    written = yaml.load(shown, Loader=yaml.BaseLoader)
    spec = Spec.from_mapping(study({}).to_yaml_mapping() | written, base=Path("."))
    assert spec.modes()["leakage"] == "on" and spec.modes()["footprint_phase"] == "off"
    assert spec.accuracy.tolerance == 1e-3


def test_the_code_that_reads_flags_runs(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    store = Path("results/quickstart.zarr")
    store.parent.mkdir()
    sweep.run(study({"target.range": ["1 km", "4 km"]}), store=store, scheduler="none",
              progress=False)  # fmt: skip
    (code,) = [block for block in blocks("python") if "flag_masks" in block]
    exec(code, {})
    told = capsys.readouterr().out.splitlines()
    assert re.fullmatch(r"range walk at \d+ % of the points", told[0])
    assert float(told[1].rsplit(" ", 1)[-1]) <= 1e-3


@pytest.mark.parametrize("shown", [b for b in blocks("python") if "flag_masks" not in b])
def test_the_example_is_the_modules_own_code(shown):
    source = Path(noise_sources.__file__).read_text(encoding="utf-8")
    assert shown in source
