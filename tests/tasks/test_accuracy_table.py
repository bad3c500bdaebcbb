"""What is told of a study's draws: tolerances along an axis, studies half done, what would help."""

import math

import numpy as np
import pytest
import xarray as xr
from click.testing import CliRunner
from small_studies import STUDY_MAPPING, run_serially, small_spec

from sweep.cli import main
from sweep.tasks.studies.store_summary import accuracy_rows_of_draws, accuracy_rows_of_rays

ROUGH = {
    "target": STUDY_MAPPING["target"] | {"roughness": "10 um"},
    "footprint": {"beamlets": 1, "speckle": "none"},
    "draws": {"limit": 400, "batch": 20},
}


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    axes = {
        "target.range": ["1 km", "2 km", "4 km"],
        "accuracy.tolerance": [0.1, 0.04, 0.0],
        "accuracy.confidence": [0.8, 0.99],
    }
    return run_serially(
        small_spec(**ROUGH, axes=axes), tmp_path_factory.mktemp("a") / "a.zarr"
    ).store


def test_each_point_keeps_the_promise_that_is_made_of_it(store):
    dataset = xr.open_zarr(store)
    numbers, widths = dataset.n_draws.values, dataset.pd_shot_half_width.values
    tolerance = dataset.tolerance.values[:, None]
    settled = numbers < 400
    assert (widths <= tolerance)[settled].all() and settled.any()
    assert (numbers[:, 0] <= numbers[:, 1]).all() and (numbers[:, 2] == 400).all()
    assert (numbers[..., 0] <= numbers[..., 1]).all()
    assert (widths[:, 2, 0] < widths[:, 2, 1]).all()
    # All of them are looks at the same draws.
    same = dataset.pd_shot.values[:, 2]
    np.testing.assert_array_equal(same[:, 0], same[:, 1])
    assert "tolerance" not in dataset.pd_shot_half_width.attrs


def test_the_worst_point_is_reported_with_its_own_tolerance(store):
    dataset = xr.open_zarr(store)
    over = {name: dataset[f"{name}_half_width"] - dataset.tolerance
            for name in ("pd_up", "pd_doppler", "pd_down", "pd_shot")}  # fmt: skip
    for row in accuracy_rows_of_draws(store):
        assert row.excess_over_tolerance == pytest.approx(float(over[row.name].max()), rel=1e-12)
        assert (
            row.tolerance_at_worst_point == 0
            and row.n_draws_needed == math.inf
            and row.n_samples_at_worst_point == 400
        )
        assert (
            row.n_points_within_tolerance == int((over[row.name] <= 0).sum()) and row.n_points == 18
        )
        assert names_the_place(row.worst_point_label, dataset, over[row.name])


def names_the_place(place_name, dataset, over):
    """Tell whether some words name the place of the largest excess."""
    i, _, k = np.unravel_index(np.argmax(over.values), over.shape)
    expected = f"range {dataset.range.values[i]:.4g} km, tolerance 0, "
    return place_name == expected + f"confidence {dataset.confidence.values[k]:.4g}"


def test_draws_that_are_said_to_do_about_do(tmp_path):
    """A fixed number is told as well, and as many again as are said to be needed meet it."""
    axes, accuracy = {"target.range": ["2 km"]}, {"tolerance": 0.02}
    few = small_spec(**ROUGH | {"draws": {"number": 300}}, axes=axes, accuracy=accuracy)
    rows = accuracy_rows_of_draws(run_serially(few, tmp_path / "few.zarr").store)
    assert [row.n_points_within_tolerance for row in rows] == [0, 0, 0, 0] and {
        row.n_samples_at_worst_point for row in rows
    } == {300}
    needed = int(max(row.n_draws_needed for row in rows))
    enough = small_spec(**ROUGH | {"draws": {"number": needed}}, axes=axes, accuracy=accuracy)
    for row in accuracy_rows_of_draws(run_serially(enough, tmp_path / "enough.zarr").store):
        assert row.worst_error < 0.022


def test_blocks_that_are_not_computed_are_not_in_the_table(tmp_path):
    from sweep.tasks.driver import run

    def broken(study, block):
        if block:
            raise ValueError("not today")
        return study.evaluate(block)

    spec = small_spec(**ROUGH, axes={"target.range": ["1 km", "2 km"]}, storage={"block_points": 1})
    outcome = run(spec, store=tmp_path / "half.zarr", scheduler="none", progress=False,
                  evaluate=broken)  # fmt: skip
    assert outcome.blocks_done == 1
    assert {row.n_points for row in accuracy_rows_of_draws(outcome.store)} == {1}
    assert xr.open_zarr(outcome.store).n_draws.values[1] == -1


def test_a_study_without_draws_has_none(tmp_path):
    assert (
        accuracy_rows_of_draws(run_serially(small_spec(axes={}), tmp_path / "none.zarr").store)
        == []
    )


def test_the_table_after_a_run_tells_where_the_most_beamlets_are_too_few(tmp_path):
    """Over thousands of bins: a beam of 50 mrad that grazes the ground."""
    laser = {"wavelength": "1550 nm", "power": "1 W", "beam_divergence": "50 mrad"}
    processing = STUDY_MAPPING["instrument"]["processing"] | {"acquisition_delay": "67 us"}
    spec = small_spec(
        instrument=STUDY_MAPPING["instrument"] | {"laser": laser, "processing": processing},
        footprint={"beamlets": "auto", "phases": "incoherent", "speckle": "none"},
        axes={"target.grazing_angle": ["0.5 deg", "89 deg", "90 deg"]},
        target=STUDY_MAPPING["target"] | {"range": "10 km"},
    )
    store = run_serially(spec, tmp_path / "wide.zarr").store
    (row,) = accuracy_rows_of_rays(store)
    assert (
        row.n_points,
        row.n_points_within_tolerance,
        row.largest_n_samples,
        row.worst_error,
    ) == (
        3,
        2,
        4096,
        1.0,
    )
    assert row.worst_point_label == "grazing_angle 0.5 deg"
    output = CliRunner().invoke(main, ["status", str(store)]).output
    assert "What more beamlets may change" in output and "2 of 3" in output
    met = small_spec(
        footprint={"beamlets": "auto", "phases": "incoherent", "speckle": "none"}, axes={}
    )
    assert accuracy_rows_of_rays(run_serially(met, tmp_path / "met.zarr").store) == []


def test_a_large_study_is_reported_by_some_of_its_blocks(tmp_path, monkeypatch):
    """Each block is a file or two: `sweep status` would wait for all of them."""
    from sweep.tasks.studies import store_summary

    axes = {"target.range": [f"{k} km" for k in range(1, 9)]}
    draws = {"draws": {"number": 20}}
    store = run_serially(
        small_spec(**ROUGH | draws, axes=axes, storage={"block_points": 1}), tmp_path / "l"
    )
    all_rows = accuracy_rows_of_draws(store.store)
    assert {row.sampled_block_fraction for row in all_rows} == {1.0} and {
        row.n_points for row in all_rows
    } == {8}
    monkeypatch.setattr(store_summary, "SAMPLED_BLOCKS_MAX", 2)
    rows = accuracy_rows_of_draws(store.store)
    assert {row.sampled_block_fraction for row in rows} == {2 / 8} and {
        row.n_points for row in rows
    } == {2}
    assert all(
        row.worst_error <= all_.worst_error for row, all_ in zip(rows, all_rows, strict=True)
    )
    output = CliRunner().invoke(main, ["status", str(store.store)]).output
    assert "by 25 % of" in " ".join(output.split())
