"""The page that `make validation` writes, against what its studies compute."""

import re
from pathlib import Path

import pytest
import validation_page

import sweep
from sweep.model.detection.noise_false_alarms import bin_pfa
from sweep.spec import GridSpec, load

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "validation.md").read_text()
FEW = {"target.range": ["1000 m", "2000 m"], "target.grazing_angle": ["45 deg", "90 deg"]}
FEW_CUTS = {
    "target.range": ["1000 m", "2000 m", "1000 m", "2000 m", "3500 m", "3500 m"],
    "target.grazing_angle": ["15 deg", "15 deg", "85 deg", "85 deg", "40 deg", "60 deg"],
}


def rows(heading, page=PAGE):
    """Cells of a table of a page, row by row."""
    part = page.split(f"## {heading}")[1].split("\n## ")[0]
    lines = [line for line in part.splitlines() if line.startswith("| ")][1:]
    return [
        [cell.strip() for cell in line.strip("|").split("|")] for line in lines if "---" not in line
    ]


@pytest.fixture
def thinned(tmp_path, monkeypatch):
    """A study of an experiment at a few of its points, in the place of the whole."""

    def make(name):
        spec = load(ROOT / "experiments" / f"{name}.yaml")
        mapping = spec.to_yaml_mapping()
        mapping["axes"] |= FEW if name == "threshold" else {"cut": {"zip": [FEW_CUTS]}}
        few = GridSpec.from_mapping(mapping, base=ROOT / "experiments")
        sweep.run(few, store=tmp_path / f"{name}.zarr", scheduler="none", progress=False)

    monkeypatch.setattr(validation_page, "store_path", lambda name: tmp_path / f"{name}.zarr")
    return make


def test_table_4_2_is_what_its_study_computes(thinned):
    thinned("threshold")
    assert rows("Table 4.2", validation_page.table_4_2()) == rows("Table 4.2")
    assert [float(row[3]) for row in rows("Table 4.2")] == [0.8, 0.047, 5.06e-10, 1.17e-21]


@pytest.mark.parametrize(
    "number,name", [("4.3", "transmit_power"), ("4.4", "aperture"), ("4.5", "fft_size")]
)
def test_tables_of_shots_are_what_their_studies_compute(number, name, thinned):
    """All but the last column, leakage, which is a mean over the whole study's points."""
    thinned(name)
    table_rows = rows(f"Table {number}", validation_page.shot_alarm_table(name, number))
    assert len(table_rows) == 9
    assert [row[:-1] for row in table_rows] == [row[:-1] for row in rows(f"Table {number}")]


def test_every_experiment_on_the_page_is_there():
    named = set(re.findall(r"^\| Figs?\. [^|]+ \| ([a-z0-9_]+) \|", PAGE, re.MULTILINE))
    assert len(named) > 10
    assert all((ROOT / "experiments" / f"{name}.yaml").exists() for name in named)


def test_what_explains_a_printed_number_follows_from_it():
    closed = bin_pfa(5.0)
    sentences = {
        float(f"{closed:.2g}"): "the same in 2 digits",
        float(f"{closed:.1g}"): "the same in 1 digit,",
        10 * closed * 1.01: r"a slip of the thesis: 0\.00472\d* is meant, \+1\.0 % from ours",
        1.1 * closed: r"its noise is 1\.81 % above",
    }
    for printed, words in sentences.items():
        assert re.match(words, validation_page.explain_printed_alarm(5.0, printed, closed))
    # TNR is a ratio of magnitudes, whose squares grow with the noise's variance
    assert bin_pfa(5.0 / 1.0181**0.5) == pytest.approx(1.1 * closed, rel=5e-3)


def test_bins_that_verdicts_are_held_against_are_the_published_ones():
    parameters = load(ROOT / "experiments" / "single_shot_2000m.yaml").parameters()
    assert validation_page.range_bin_width(parameters) == pytest.approx(
        0.3431, abs=1e-4
    )  # as the thesis has it
    assert validation_page.velocity_bin_width(parameters) == pytest.approx(3.55e-3, abs=5e-6)
    padded = parameters | {"instrument.processing.fft_size": 2**18}
    assert (
        validation_page.range_bin_width(padded) == validation_page.range_bin_width(parameters) / 2
    )
