"""Two flights compared, held against the arrays of their stores matched by hand."""

import numpy as np
import pytest
import xarray as xr
from click.testing import CliRunner
from stored_scenes import SCENE_MAPPING, copy_without_last_cycles, run_flight_into_store
from stored_studies import run_into_store

import sweep
from sweep.analysis.datasets import open_scene
from sweep.cli import main

SQUARE = SCENE_MAPPING["scanners"]["square"]


@pytest.fixture(scope="module")
def slower(tmp_path_factory):
    """The same flight at half the rate, redrawn, at other powers: every second cycle's first beam.

    Of a cycle at 10 Hz the four beams are at 0, 25, 50, 75 ms; at 5 Hz at 0, 50, 100 and 150 ms.
    """
    return run_flight_into_store(
        tmp_path_factory.mktemp("slower"),
        axes={"instrument.laser.power": ["0.5 mW", "300 uW"]},
        scanners={"square": SQUARE | {"rate": "5 Hz"}},
        draws={"number": 20, "returns": 3},
        storage={"block_draws": 64},
        seed=12,
    )


def compared(*arguments):
    return CliRunner().invoke(main, ["compare", *map(str, arguments)])


def arrays(store):
    return xr.open_zarr(store, group="square", chunks=None).load()


def test_shots_meet_at_the_same_time_and_beam_and_differ_as_their_arrays_do(scene_store, slower):
    comparison = open_scene(scene_store).sweep.compare(open_scene(slower))
    assert list(comparison.children) == ["square"]
    square = comparison["square"].to_dataset().compute()
    first_arrays, other = arrays(scene_store).sel(power=0.3), arrays(slower).sel(power=0.3)
    times_and_beams = [
        [(round(float(t), 6), int(beam)) for t, beam in zip(*columns, strict=True)]
        for columns in ((side.time.values, side.beam.values) for side in (first_arrays, other))
    ]
    pairs = [
        (i, times_and_beams[1].index(shot))
        for i, shot in enumerate(times_and_beams[0])
        if shot in times_and_beams[1]
    ]
    left, right = map(list, zip(*pairs, strict=True))
    assert 30 < len(pairs) == square.sizes["shot"] < first_arrays.sizes["shot"]
    assert np.array_equal(square.time, first_arrays.time[left]) and square.power.values == [0.3]
    assert square.attrs["shots"] == 316 and square.attrs["other_shots"] == 156
    share = [
        ((side.flags.values & 1) > 0).any(axis=-1).mean(axis=-1) for side in (first_arrays, other)
    ]
    assert square.detected.values[0] == pytest.approx(share[1][right] - share[0][left], abs=1e-15)
    for name in ("pd_up", "pd_shot", "snr_up", "pfa_up"):
        expected = other[name].values[right] - first_arrays[name].values[left]
        assert np.array_equal(square[name].values[0], expected, equal_nan=True)
    assert square.pd_shot_agrees.all()


def test_shares_of_draws_agree_within_both_intervals(scene_store, slower):
    comparison = open_scene(scene_store).sweep.compare(open_scene(slower))["square"].compute()
    assert (comparison.detected != 0).any() and comparison.detected_agrees.all()
    # 3 of 3 draws hold a share of 0.025^(1/3) and more with 95 %, 20 of 20 one of 0.025^(1/20)
    always = (1 - 0.025 ** (1 / 3)) + (1 - 0.025 ** (1 / 20))
    excess = comparison.detected_allowed.values[0] - always
    # effects and beamlets of both studies may each be off by the tolerance of 0.001
    assert ((excess >= 0) & (excess <= 4e-3)).any()


def test_more_light_is_reported_with_the_shot_that_gains_most(slower):
    tree = open_scene(slower)
    brighter = tree.copy()
    swapped = tree["square"].to_dataset().isel(power=[1, 0]).assign_coords(power=tree.square.power)
    brighter["square"] = xr.DataTree(swapped)
    comparison = tree.sweep.compare(brighter)["square"].to_dataset().compute()
    # what 0.3 mW gained 0.5 mW lost: the same numbers at the other value
    gain = comparison.pd_shot.sel(power=0.3).values
    assert gain.max() > 0.1
    assert np.array_equal(gain, -comparison.pd_shot.sel(power=0.5).values, equal_nan=True)
    assert not comparison.pd_shot_agrees.all()


def test_the_command_prints_a_table_for_each_scanner_and_draws(scene_store, slower, tmp_path):
    figure = tmp_path / "flights.svg"
    same = compared(scene_store, scene_store, "--figure", figure)
    assert same.exit_code == 0, same.output
    assert "square: all 316 shots" in same.output and "pair: all 318 shots" in same.output
    assert "agree at 1,268 shots, counted at each place along the axes." in same.output
    assert figure.read_text().startswith("<?xml")
    halved = compared(scene_store, slower)
    assert "square: 39 shots that both have, of 316 and 156" in halved.output
    row = next(line for line in halved.output.splitlines() if "detected" in line)
    assert "beam 0" in row and "0.3 mW" in row
    assert halved.exit_code == 0 and "agree at 39 shots." in halved.output


def test_draws_that_are_not_computed_are_not_taken_for_shots_without_a_point(scene_store, tmp_path):
    tree = open_scene(copy_without_last_cycles(scene_store, tmp_path, with_geometry=False))
    tree.attrs["points_committed"] -= 1  # as receipts tell of a store that is cut off
    comparison = tree.sweep.compare(open_scene(scene_store))["square"].to_dataset().compute()
    assert "detected" not in comparison and comparison.sizes["shot"] == 316
    assert (
        comparison.pd_shot[:, :256].notnull().all() and comparison.pd_shot[:, 256:].isnull().all()
    )


def test_flights_that_do_not_meet_and_other_kinds_are_refused(scene_store, slower, tmp_path):
    grid = run_into_store(tmp_path, {"target.range": ["1 km", "5 km"]})
    tree, dataset = open_scene(scene_store), sweep.open(grid)
    for one, two in ((tree, dataset), (dataset, tree)):
        with pytest.raises(ValueError, match="a grid of points and a flight"):
            one.sweep.compare(two)
    result = compared(scene_store, grid)
    assert result.exit_code == 2 and "compare two of a kind" in result.output
    for change, words in (
        (lambda d: d.assign(time=d.time + 0.01), "no shot of one flight is at the time"),
        (lambda d: d.assign(beam=d.beam + 9), "no shot of one flight is at the time"),
        (
            lambda d: d.assign(platform_position=d.platform_position + np.array([3, 4, 0])),
            "they are 5 m apart at the least, their beams 0 deg",
        ),
        (
            lambda d: d.assign(beam_direction=-d.beam_direction),
            "they are 0 m apart at the least, their beams 180 deg",
        ),
    ):
        moved = open_scene(slower)
        moved["square"] = xr.DataTree(change(moved["square"].to_dataset()))
        with pytest.raises(ValueError, match=words):
            tree.sweep.compare(moved)
    with pytest.raises(ValueError, match="square, pair; and other"):
        renamed = open_scene(slower)
        renamed.attrs["scanners"] = ["other"]
        tree.sweep.compare(renamed)
