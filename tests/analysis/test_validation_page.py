"""The page that `make validation` writes, against the closed form and the specs of experiments."""

import importlib.util
import re
from pathlib import Path

import pytest

from sweep.analysis.noise_only import bin_probability, shot_probability
from sweep.spec import load

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "validation.md").read_text()
SIZES = {"FFT size 2^16": 2**16, "FFT size 2^18": 2**18}


def load_writer():
    path = ROOT / "benchmarks" / "validation.py"
    module = importlib.util.module_from_spec(
        spec := importlib.util.spec_from_file_location("validation", path)
    )
    spec.loader.exec_module(module)
    return module


WRITER = load_writer()


def rows(heading):
    part = PAGE.split(f"## {heading}")[1].split("\n## ")[0]
    lines = [line for line in part.splitlines() if line.startswith("| ")][1:]
    return [
        [cell.strip() for cell in line.strip("|").split("|")] for line in lines if "---" not in line
    ]


def test_table_4_2_stands_beside_its_closed_form():
    found = rows("Table 4.2")
    assert [float(row[3]) for row in found] == [0.8, 0.047, 5.06e-10, 1.17e-21]
    for row in found:
        assert float(row[1]) == pytest.approx(bin_probability(float(row[0])), rel=1e-3)
        assert float(row[2]) == pytest.approx(float(row[1]), rel=1e-3)


@pytest.mark.parametrize(
    "number,name", [("4.3", "transmit_power"), ("4.4", "aperture"), ("4.5", "fft_size")]
)
def test_tables_of_shots_hold_what_is_printed_and_the_closed_form(number, name):
    found = rows(f"Table {number}")
    figures = load(ROOT / "experiments" / f"{name}.yaml").figures
    (printed,) = [f.printed for f in figures if f.kind == "false_alarm_table"]
    assert [float(row[4]) for row in found] == [x for line in printed for x in line]
    for row in found:
        closed = shot_probability(10.0, SIZES.get(row[0], 2**17))
        assert float(row[2]) == pytest.approx(closed, rel=1e-3)
        assert float(row[3]) == pytest.approx(closed, rel=2e-3)


@pytest.mark.parametrize(
    "shown",
    ["3.8(a)", "3.8(b)", "3.8(c)", "4.2", "4.3", "4.4(a)", "4.4(b)",
     *(f"4.5({c})" for c in "abcd"), *(f"4.{k}({c})" for k in (6, 7, 8) for c in "abc"),
     "5.1", "5.3(a-c)", "5.3(d)", "5.4(a-c)", "5.4(d)", "5.5", "5.6, 5.7"],
)  # fmt: skip
def test_every_figure_with_results_has_its_row(shown):
    assert re.search(rf"^\| Figs?\. {re.escape(shown)} \|", PAGE, re.MULTILINE)


def test_every_experiment_on_the_page_is_there():
    named = set(re.findall(r"^\| Figs?\. [^|]+ \| ([a-z0-9_]+) \|", PAGE, re.MULTILINE))
    assert len(named) > 10
    assert all((ROOT / "experiments" / f"{name}.yaml").exists() for name in named)


def test_what_explains_a_printed_number_follows_from_it():
    closed = bin_probability(5.0)
    told = {
        float(f"{closed:.2g}"): "the same in 2 digits",
        float(f"{closed:.1g}"): "the same in 1 digit,",
        10 * closed * 1.01: r"a slip of the thesis: 0\.00472\d* is meant, \+1\.0 % from ours",
        1.1 * closed: r"its noise is 1\.81 % above",
    }
    for printed, words in told.items():
        assert re.match(words, WRITER.why(5.0, printed, closed))
    # TNR is a ratio of magnitudes, whose squares grow with the noise's variance
    assert bin_probability(5.0 / 1.0181**0.5) == pytest.approx(1.1 * closed, rel=5e-3)


def test_bins_that_verdicts_are_held_against_are_the_published_ones():
    parameters = load(ROOT / "experiments" / "single_shot_2000m.yaml").parameters()
    assert WRITER.range_bin(parameters) == pytest.approx(0.3431, abs=1e-4)  # as the thesis has it
    assert WRITER.velocity_bin(parameters) == pytest.approx(3.55e-3, abs=5e-6)
    padded = parameters | {"instrument.processing.fft_size": 2**18}
    assert WRITER.range_bin(padded) == WRITER.range_bin(parameters) / 2


def test_no_verdict_is_a_fixed_word():
    """Every one of the writer's verdicts comes from `agrees`, but for its own two words."""
    text = (ROOT / "benchmarks" / "validation.py").read_text()
    assert len(re.findall(r"\bagrees\b(?!\()", text)) == 1
    assert text.count("does not agree") == 1
