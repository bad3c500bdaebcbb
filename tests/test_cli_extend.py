"""`sweep extend` as it is typed."""

from pathlib import Path

import pytest
from small_studies import file_digests, run_serially, small_spec
from test_cli import sweep

POWER = "axes.instrument.laser.power"


@pytest.fixture
def store(tmp_path, monkeypatch):
    """The store of a study of four points, in the folder that one is in."""
    monkeypatch.chdir(tmp_path)
    return run_serially(four("[1 W, 3 W]"), tmp_path / "four.zarr").store.name


def four(powers):
    """A study of two ranges and some powers."""
    axes = {"target.range": ["1 km", "2 km"], "instrument.laser.power": powers[1:-1].split(", ")}
    return small_spec(axes=axes)


def test_it_says_what_there_is_and_ends_with_the_larger_study(store):
    result = sweep("extend", store, "--set", f"{POWER}=[1 W, 2 W, 3 W]", "--scheduler", "none")
    assert result.exit_code == 0
    assert "4 of 6 points are there; 2 to compute" in result.stderr
    assert "four.zarr: 6 of 6 points, computed 1 of 1 block" in result.stdout
    assert file_digests(Path(store)) == file_digests(
        run_serially(four("[1 W, 2 W, 3 W]"), Path("again.zarr")).store
    )
    second_result = sweep(
        "extend", store, "--set", f"{POWER}=[1 W, 2 W, 3 W]", "--scheduler", "none"
    )
    assert second_result.exit_code == 0 and "nothing to extend" in second_result.stderr


@pytest.mark.parametrize(
    "arguments, message",
    [
        ([], "name the larger study, or what is to change in it with --set"),
        (["--set", "draws.limit"], "is not NAME=VALUE, as in draws.limit=1e6"),
        (["--set", f"{POWER}=[1 W"], "--set:2: is no valid YAML"),
        (["--set", f"{POWER}=[1 W, 2 parsecs]"], "parsecs"),
        (["--set", f"{POWER}=[1 W, 2 W]"], "instrument.laser.power: 3 W: lost, and must stay"),
        (
            ["--set", "target.reflectance.x=5"],
            "target.reflectance.x: is no field: target.reflectance",
        ),
        (["--set", "target.range.x=5"], "target.range: takes one value; put several"),
        (["--set", "seed=4"], "seed: 3 -> 4, and must stay as it is"),
    ],
)
def test_mistakes_are_reported_in_words_and_nothing_changes(store, arguments, message):
    before = file_digests(Path(store))
    result = sweep("extend", store, *arguments)
    assert result.exit_code == 2 and message in result.stderr and "Traceback" not in result.stderr
    assert file_digests(Path(store)) == before and [p.name for p in Path().iterdir()] == [store]
