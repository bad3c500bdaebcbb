"""Flights whose tolerance says how many rays they cast: their stores, and what they leave."""

import json
import math
from functools import partial

import numpy as np
import pytest
import xarray as xr
from click.testing import CliRunner
from small_flights import SCENE_MAPPING
from small_studies import file_digests, run_serially

import sweep
from sweep.analysis.answers.comparison import compare_flights as compare
from sweep.analysis.datasets import open_scene
from sweep.cli import main
from sweep.model.beamlet_counts import initial_ray_count
from sweep.model.error_budget import ErrorBudget
from sweep.report.study_report import accuracy_sentences
from sweep.spec import GridSpec, SceneSpec
from sweep.storage.locations import eyepoint_store_location
from sweep.tasks.driver import extend, run
from sweep.tasks.engine.progress import StoreError
from sweep.tasks.studies import eyepoint_study
from sweep.tasks.studies.store_summary import accuracy_rows_of_rays

RAYS = ErrorBudget.ray_counts

LASER = SCENE_MAPPING["instrument"]["laser"] | {"beam_divergence": "4 mrad", "power": "1 mW"}
OVER_FACETS = SCENE_MAPPING | {
    "instrument": SCENE_MAPPING["instrument"] | {"laser": LASER},
    "scene": {"origin": "ground", "objects": {"ground": {
        "kind": "hills", "size": "200 m", "spacing": "1 m", "rms_height": "1 m",
        "correlation_length": "4 m", "seed": 1, "reflectance": 0.1,
    }}},
    "platform": {"path": SCENE_MAPPING["platform"]["path"] | {
        "from": ["0 m", "0 m", "160 m"], "to": ["0 m", "0 m", "100 m"],
        "initial_speed": "30 m/s", "final_speed": "20 m/s",
    }},
    "scanners": {"three": SCENE_MAPPING["scanners"]["three"] | {"rate": "8 Hz"}},
    "draws": {"number": 2, "returns": 2},
    "axes": {"instrument.laser.power": ["40 uW", "1 mW"]},
}  # fmt: skip
"""A wide beam over facets that footprints often lie across; pd between 0 and 1, and 1."""

DETECTED = "pd_up", "pd_doppler", "pd_down"


def facets(tolerance=1e-2, beamlets="auto", **changes):
    """The flight at a tolerance."""
    sections = {
        "footprint": {"beamlets": beamlets, "speckle": "none"},
        "accuracy": {"tolerance": tolerance},
    }
    return SceneSpec.from_mapping(OVER_FACETS | sections | changes, base=".")


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    """Stores of the flight at two tolerances, and with many rays by hand."""
    folder = tmp_path_factory.mktemp("flown")
    specs = {"coarse": facets(1e-2), "fine": facets(1e-3), "by hand": facets(1e-4, 8017)}
    return {name: run_serially(spec, folder / f"{name}.zarr").store for name, spec in specs.items()}


def shots(store):
    return xr.open_datatree(store, engine="zarr")["three"].to_dataset()


# The spec


def test_the_tolerance_is_in_the_geometry_as_far_as_it_changes_the_rays():
    geometries = [facets(t).geometry_id("three") for t in (1e-1, 1e-2, 1e-3)]
    assert geometries[0] == geometries[1] != geometries[2]
    beamlets = [facets(t).parameters()["footprint.beamlets"] for t in (1e-2, 1e-3, 0)]
    assert beamlets == [19, 37, 109] and facets().is_ray_number_set_by_tolerance
    assert len({facets(t).id for t in (1e-2, 2e-2)}) == 2
    assert facets(1e-3).id != facets(1e-3, 37).id, "other effects, and no estimate"
    assert facets(1e-3).geometry_id("three") == facets(1e-3, 37).geometry_id("three")


@pytest.mark.parametrize("tolerance", [1e-1, 1e-5])
def test_numbers_by_hand_and_coherent_flights_do_not_follow_it(tolerance):
    by_hand = facets(tolerance, 7)
    assert (
        by_hand.parameters()["footprint.beamlets"] == 7
        and not by_hand.is_ray_number_set_by_tolerance
    )
    assert by_hand.identity()["parameters"]["footprint.beamlets"] == 7
    coherent = facets(tolerance, footprint={"phases": "coherent"})
    thesis = facets(tolerance, footprint={"phases": "coherent", "beamlets": 109})
    assert not coherent.is_ray_number_set_by_tolerance and coherent.id == thesis.id
    assert coherent.geometry_id("three") == thesis.geometry_id("three")


def test_the_tolerance_is_on_no_axis_of_a_flight():
    assert not SceneSpec.may_be_on_axis("accuracy.tolerance")


# The store


@pytest.mark.parametrize("name, tolerance", [("coarse", 1e-2), ("fine", 1e-3)])
def test_shots_have_the_rays_that_their_tolerance_needs(flown, name, tolerance):
    """Few where that is enough, more where their own tell that they are too few."""
    shot_arrays, many = shots(flown[name]), shots(flown["by hand"])
    real = sum(abs(shot_arrays[pd] - many[pd]) for pd in DETECTED).values
    stated_error, rays = shot_arrays.beamlets_error.values, shot_arrays.beamlets.values
    assert shot_arrays.beamlets_error.dims == shot_arrays.beamlets.dims == ("power", "shot")
    assert (stated_error[rays < 8017] <= tolerance).all() and (real <= tolerance).mean() >= 0.999
    fewest = initial_ray_count(facets().parameters(), ErrorBudget(tolerance))
    assert set(np.unique(rays)) <= set(RAYS) and rays.min() == fewest
    assert (rays[0] > fewest).mean() > 0.3, "of the weak laser, whose pd is undecided"
    is_changed = real > 1e-5
    assert (
        is_changed[0].mean() > 0.5
        and (stated_error[is_changed] >= real[is_changed] / 2).mean() >= 0.99
    )


def test_a_shot_with_more_rays_is_as_if_all_had_so_many(flown, tmp_path):
    """Bit for bit, where the same effects are simulated."""
    shot_arrays = shots(flown["coarse"])
    number = int(np.unique(shot_arrays.beamlets)[-1])
    other = shots(run_serially(facets(1e-2, number), tmp_path / "all.zarr").store)
    is_alike = ((shot_arrays.beamlets == number) & (shot_arrays.effects == other.effects)).values
    assert is_alike.any()
    for name in (*DETECTED, "snr_up", "range_interpolated", "true_range", "surface"):
        np.testing.assert_array_equal(
            shot_arrays[name].values[is_alike], other[name].values[is_alike]
        )


def test_rays_given_by_hand_state_no_error(flown):
    assert shots(flown["by hand"]).beamlets_error.isnull().all()
    assert accuracy_rows_of_rays(flown["by hand"]) == []


def test_a_comparison_allows_the_stated_ray_error(flown):
    comparison = compare(open_scene(flown["coarse"]), open_scene(flown["by hand"]))["three"]
    stated_error = shots(flown["coarse"]).beamlets_error
    assert "beamlets_error" not in comparison and stated_error.max() > 1e-3
    assert (comparison.pd_shot_allowed >= stated_error).all()
    assert comparison.pd_shot_agrees.mean() >= 0.98


def test_the_table_after_a_run_tells_who_misses_the_tolerance(tmp_path, monkeypatch):
    """Where the most that may be cast are too few."""
    few = partial(ErrorBudget.from_parameters, ray_counts=(19, 37))
    monkeypatch.setattr(ErrorBudget, "from_parameters", few)
    spec = facets(1e-3, draws={"number": 1})
    store = run_serially(spec, tmp_path / "most.zarr").store
    (row,) = accuracy_rows_of_rays(store)
    stated_error, rays = shots(store).beamlets_error, shots(store).beamlets
    assert (row.name, row.largest_n_samples, row.tolerance_at_worst_point) == ("three", 37, 1e-3)
    assert row.mean_n_samples == pytest.approx(float(rays.mean())) == 37
    assert (
        row.n_points == stated_error.size
        and row.n_points_within_tolerance == (stated_error <= 1e-3).sum() < row.n_points
    )
    assert row.worst_error == stated_error.max() and row.excess_over_tolerance == pytest.approx(
        row.worst_error - 1e-3
    )
    shot = int(stated_error.values[0].argmax())
    assert row.worst_point_label == f"power 40 uW, time {float(shots(store).time[shot]):.4g} s"
    output = CliRunner().invoke(main, ["status", str(store)]).output
    assert (
        "What more rays may change" in output
        and f"{row.n_points_within_tolerance} of {row.n_points}" in output
    )
    spec_file = tmp_path / "most.yaml"
    spec_file.write_text(json.dumps(spec.to_yaml_mapping()))
    output = CliRunner().invoke(main, ["plan", str(spec_file)]).output
    assert "37 a shot, more where it needs them, at most 37" in output


def test_rays_are_added_until_they_are_enough():
    """The error falls as one over their number: whatever the stretches, none is left above."""
    rng = np.random.default_rng(5)
    rough, ray_counts = 10 ** rng.uniform(-5, 1, 3000), []

    def cast_again(places, rays):
        ray_counts.append((rays, places.size))
        latest[places] = rays
        return rough[places] / rays

    latest = np.full(rough.size, 37)
    eyepoint_study.refine_rays(37, rough / 37, ErrorBudget(1e-4), cast_again)
    error = rough / latest
    assert (error[latest < RAYS[-1]] <= 1e-4).all() and (latest == 37).any()
    assert (latest[error > 1e-4] == RAYS[-1]).all() and (latest < RAYS[-1]).mean() > 0.8
    assert max(rays * number for rays, number in ray_counts) <= eyepoint_study.RAYS_PER_CAST_MAX
    wasted = latest[latest > 37] / (rough[latest > 37] / 1e-4)
    assert wasted.max() <= 60, "no more than a step of the ladder and the least jump call for"


# Extension


def test_a_tighter_tolerance_casts_its_own_rays(flown, tmp_path):
    """Errors that are numbers change nothing: other rays leave nothing to be taken."""
    close = {"line_error": 1e-5, "leakage_error": 1e-5}
    coarse, fine = (facets(accuracy={"tolerance": t, **close}) for t in (1e-2, 1e-3))
    store = run_serially(coarse, tmp_path / "flight.zarr").store
    outcome = extend(store, fine, progress=False, scheduler="none")
    assert outcome.complete and outcome.rays_by_scanner["three"] > 37 * fine.number_of_cycles(
        "three"
    )
    assert eyepoint_store_location(store, fine.geometry_id("three")).exists()
    assert file_digests(store) == file_digests(run_serially(fine, tmp_path / "fine.zarr").store)


def test_rays_by_hand_are_no_tighter_tolerance(flown):
    with pytest.raises(StoreError, match=r"footprint\.beamlets: 0 -> 37, and must stay"):
        extend(flown["coarse"], facets(1e-3, 37), progress=False)


def test_ray_counts_do_not_depend_on_the_division_into_blocks(flown, tmp_path):
    cut = facets(1e-2, storage={"block_shots": 21, "block_draws": 1})
    shot_arrays = shots(run_serially(cut, tmp_path / "cut.zarr").store)
    np.testing.assert_array_equal(shot_arrays.beamlets_error, shots(flown["coarse"]).beamlets_error)


def test_a_report_says_so_too(flown):
    sentences = " ".join(accuracy_sentences(shots(flown["coarse"]), facets(1e-2)))
    worst = float(shots(flown["coarse"]).beamlets_error.max())
    assert f"More beamlets would change one by {worst:.2g} at the most." in sentences
    by_hand = " ".join(accuracy_sentences(shots(flown["by hand"]), facets(1e-4, 8017)))
    assert "What more beamlets would change is not checked." in by_hand


def test_a_flight_has_the_probabilities_of_the_grid_where_footprints_are_wide(tmp_path):
    """Rays that end at three deviations of the beam lose half a per cent of a wide footprint's bin.

    The grid integrates over the whole Gaussian. At 5 degrees grazing lines spread over 1.5 bins.
    """
    instrument = {
        "like": "lander_ndl", "laser": {"power": "0.1 W"}, "processing": {"fft_size": "2^18"},
    }  # fmt: skip
    common = {"title": "Wide", "instrument": instrument, "footprint": {"speckle": "none"}}
    distance, sine, cosine = 1600.0, math.sin(math.radians(5)), math.cos(math.radians(5))
    height = distance * sine
    grid = GridSpec.from_mapping(common | {
        "target": {"reflectance": 0.1, "radial_velocity": "50 m/s", "grazing_angle": "5 deg",
                   "range": f"{distance} m"},
    })  # fmt: skip
    flight = SceneSpec.from_mapping(common | {
        "scene": {"objects": {"ground": {"kind": "plane", "size": "50 km", "reflectance": 0.1}}},
        "platform": {
            "path": {"kind": "straight", "from": ["0 m", "0 m", f"{height!r} m"],
                     "to": [f"{10 * cosine!r} m", "0 m", f"{height - 10 * sine!r} m"],
                     "initial_speed": "50 m/s"},
            "attitude": {"kind": "nadir"},
        },
        "scanners": {"beam": {"kind": "fixed", "beams": [[cosine, 0, -sine]],
                              "rate": "50 Hz"}},
        "draws": {"number": 1},
    })  # fmt: skip
    for study, name in ((grid, "grid"), (flight, "flight")):
        run(study, store=tmp_path / name, scheduler="none", progress=False)
    point = sweep.open(tmp_path / "grid")
    shot = open_scene(tmp_path / "flight")["beam"].to_dataset().isel(shot=0)
    for variable in ("pd_up", "pd_doppler", "pd_down"):
        stated_error = float(shot.beamlets_error) + float(shot.effects_error)
        assert abs(float(shot[variable]) - float(point[variable])) < min(stated_error, 1e-3)
    assert float(shot.snr_up) == pytest.approx(float(point.snr_up), rel=1e-4)
