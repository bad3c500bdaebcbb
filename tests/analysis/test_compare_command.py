from pathlib import Path

import pytest
from click.testing import CliRunner
from stored_studies import INSTRUMENT, run_into_store

from sweep.cli import main

AXES = {"target.range": ["1 km", "5 km", "9 km"]}
WEAK = INSTRUMENT | {"laser": INSTRUMENT["laser"] | {"power": "0.5 W"}}


@pytest.fixture(scope="module")
def stores(tmp_path_factory):
    paths = {}
    for name, axes, sections in (
        ("one", AXES, {}),
        ("finer", {"target.range": {"step": ["1 km", "9 km", "1 km"]}}, {}),
        ("weak", AXES, {"instrument": WEAK}),
        ("far", {"target.range": ["20 km", "30 km"]}, {}),
    ):
        paths[name] = str(run_into_store(tmp_path_factory.mktemp(name), axes, **sections))
    return paths


def compared(*arguments):
    return CliRunner().invoke(main, ["compare", *arguments])


def test_studies_that_agree_where_they_meet_end_with_0(stores):
    result = compared(stores["one"], stores["finer"])
    assert result.exit_code == 0, result.output
    assert "axes.range.target.range: [1000, 5000, 9000] m ->" in result.output
    assert "Probabilities of detection agree at 3 points." in result.output


def test_a_weaker_laser_differs_by_4_and_the_table_says_where(stores, tmp_path):
    figure = tmp_path / "difference.pdf"
    result = compared(stores["one"], stores["weak"], "--figure", str(figure))
    assert result.exit_code == 4, result.output
    assert "instrument.laser.power: 1 W -> 0.5 W" in result.output
    row = next(line for line in result.output.splitlines() if "pd_shot" in line).split()
    assert row[0] == "pd_shot" and row[3].startswith("-")
    assert row[-2:] == ["9", "km"] and row[4:6] != ["100", "%"]
    assert "Probabilities of detection differ at" in result.output
    assert figure.read_bytes().startswith(b"%PDF")


def test_the_same_store_is_the_same_study(stores):
    result = compared(stores["one"], stores["one"])
    assert result.exit_code == 0 and result.stdout.startswith("the same study\n")


def test_what_cannot_be_compared_ends_with_2(stores, tmp_path):
    for arguments, words in (
        ((stores["one"], stores["far"]), "no value in common"),
        ((stores["one"], str(tmp_path / "none.zarr")), "there is no store"),
        ((stores["one"], stores["one"], "--figure", "x.bmp"), "ends in none of png, pdf, svg"),
    ):
        result = compared(*arguments)
        assert result.exit_code == 2 and words in result.output


def test_a_store_of_which_nothing_is_computed_ends_with_3(stores, tmp_path):
    empty = Path(run_into_store(tmp_path, AXES))
    (empty / ".sweep" / "receipts.jsonl").unlink()
    for chunk in empty.glob("*/c/*"):
        if chunk.parent.parent.name not in ("range", "effects"):
            chunk.unlink()
    result = compared(stores["one"], str(empty))
    assert result.exit_code == 3, result.output
    assert "Nothing that both stores have is computed yet." in result.output
