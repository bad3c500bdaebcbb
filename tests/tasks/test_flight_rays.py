"""Flights whose tolerance says how many rays they cast: their stores, and what they leave."""

import json

import numpy as np
import pytest
import xarray as xr
from click.testing import CliRunner
from small import quiet, tree
from small_flights import SCENE

from sweep.analysis.answers.flight_comparison import compare
from sweep.analysis.scenes.opening import open_scene
from sweep.cli import main
from sweep.model import resolution
from sweep.report.asked import accuracy
from sweep.spec import SceneSpec
from sweep.tasks.accuracy_table import rays_table
from sweep.tasks.driver import extend
from sweep.tasks.errors import StoreError
from sweep.tasks.eyepoint_study import eyepoints_path

LASER = SCENE["instrument"]["laser"] | {"beam_divergence": "4 mrad"}
OVER_FACETS = SCENE | {
    "instrument": SCENE["instrument"] | {"laser": LASER},
    "scene": {"origin": "ground", "objects": {"ground": {
        "kind": "hills", "size": "200 m", "spacing": "1 m", "rms_height": "1 m",
        "correlation_length": "4 m", "seed": 1, "reflectance": 0.1,
    }}},
    "platform": {"path": SCENE["platform"]["path"] | {
        "from": ["0 m", "0 m", "160 m"], "to": ["0 m", "0 m", "100 m"],
        "initial_speed": "30 m/s", "final_speed": "20 m/s",
    }},
    "scanners": {"three": SCENE["scanners"]["three"] | {"rate": "8 Hz"}},
    "draws": {"number": 2, "returns": 2},
    "axes": {"instrument.laser.power": ["40 uW", "1 mW"]},
}  # fmt: skip
"""A wide beam over facets that footprints often lie across; pd between 0 and 1, and 1."""

DETECTED = "pd_up", "pd_doppler", "pd_down"


def facets(tolerance=1e-2, beamlets="auto", **changes):
    """The flight at a tolerance."""
    own = {"footprint": {"beamlets": beamlets}, "accuracy": {"tolerance": tolerance}}
    return SceneSpec.from_mapping(OVER_FACETS | own | changes, base=".")


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    """Stores of the flight at two tolerances, and with many rays by hand."""
    folder = tmp_path_factory.mktemp("flown")
    specs = {"coarse": facets(1e-2), "fine": facets(1e-3), "by hand": facets(1e-4, 4009)}
    return {name: quiet(spec, folder / f"{name}.zarr").store for name, spec in specs.items()}


def shots(store):
    return xr.open_datatree(store, engine="zarr")["three"].to_dataset()


# The spec


def test_the_tolerance_is_in_the_geometry_as_far_as_it_changes_the_rays():
    geometries = [facets(t).geometry_id("three") for t in (1e-2, 8e-3, 1e-3)]
    assert geometries[0] == geometries[1] != geometries[2]
    beamlets = [facets(t).parameters()["footprint.beamlets"] for t in (1e-2, 1e-3, 0)]
    assert beamlets == [19, 109, 4009] and facets().rays_by_tolerance
    assert len({facets(t).id for t in (1e-2, 8e-3)}) == 2
    assert facets(1e-3).id != facets(1e-3, 109).id, "other effects, and no estimate"
    assert facets(1e-3).geometry_id("three") == facets(1e-3, 109).geometry_id("three")


@pytest.mark.parametrize("tolerance", [1e-1, 1e-5])
def test_numbers_by_hand_and_coherent_flights_do_not_follow_it(tolerance):
    by_hand = facets(tolerance, 7)
    assert by_hand.parameters()["footprint.beamlets"] == 7 and not by_hand.rays_by_tolerance
    assert by_hand.identity()["parameters"]["footprint.beamlets"] == 7
    coherent = facets(tolerance, footprint={"phases": "coherent"})
    thesis = facets(tolerance, footprint={"phases": "coherent", "beamlets": 109})
    assert not coherent.rays_by_tolerance and coherent.id == thesis.id
    assert coherent.geometry_id("three") == thesis.geometry_id("three")


def test_the_tolerance_is_on_no_axis_of_a_flight():
    assert not SceneSpec.may_vary("accuracy.tolerance")


# The store


@pytest.mark.parametrize("name, tolerance", [("coarse", 1e-2), ("fine", 1e-3)])
def test_a_store_tells_what_its_rays_leave(flown, name, tolerance):
    """Of all shots at least half of it, and of the strong laser's, whose pd is 1, nothing."""
    found, many = shots(flown[name]), shots(flown["by hand"])
    real = sum(abs(found[pd] - many[pd]) for pd in DETECTED).values
    told = found.beamlets_error.values
    assert found.beamlets_error.dims == ("power", "shot") and (told >= 0).all()
    off = real > 1e-5
    assert off[0].mean() > 0.8 and (told[off] >= real[off] / 2).all()
    assert real.max() > tolerance / 10 and (real <= tolerance).mean() >= 0.8
    assert told[1].max() < 1e-6


def test_rays_given_by_hand_leave_nothing_that_is_told(flown):
    assert (shots(flown["by hand"]).beamlets_error == 0).all()
    assert rays_table(flown["by hand"]) == []


def test_a_comparison_allows_what_is_told(flown):
    both = compare(open_scene(flown["coarse"]), open_scene(flown["by hand"]))["three"]
    without = abs(both.pd_shot) > both.pd_shot_allowed - shots(flown["coarse"]).beamlets_error
    assert "beamlets_error" not in both and without.any()
    assert both.pd_shot_agrees.mean() >= 0.98


def test_the_table_after_a_run_tells_who_misses_the_tolerance(flown):
    (row,) = rays_table(flown["coarse"])
    told = shots(flown["coarse"]).beamlets_error
    assert (row.scanner, row.rays, row.most, row.tolerance) == ("three", 19, False, 1e-2)
    assert row.shots == told.size and row.met == (told <= 1e-2).sum() < row.shots
    assert row.error == told.max() and row.missed == pytest.approx(row.error - 1e-2)
    shot = int(told.values[0].argmax())
    time = float(shots(flown["coarse"]).time[shot])
    assert row.where == f"power 40 uW, time {time:.4g} s"
    said = CliRunner().invoke(main, ["status", str(flown["coarse"])]).output
    assert "What more rays may change of pd" in said and f"{row.met} of {row.shots}" in said


def test_where_no_tolerance_calls_for_more_it_is_said(tmp_path, monkeypatch):
    monkeypatch.setattr(resolution, "RAYS", (19, 37))
    spec = facets(1e-6, draws={"number": 1})
    (row,) = rays_table(quiet(spec, tmp_path / "most.zarr").store)
    assert row.rays == 37 and row.most and row.met < row.shots
    spec_file = tmp_path / "most.yaml"
    spec_file.write_text(json.dumps(spec.to_yaml_mapping()))
    said = CliRunner().invoke(main, ["plan", str(spec_file)]).output
    assert "37 a shot, by accuracy.tolerance, the most that any gets" in said


# Extension


def test_a_tighter_tolerance_casts_its_own_rays(flown, tmp_path):
    """Errors that are numbers change nothing: other rays leave nothing to be taken."""
    close = {"line_error": 1e-5, "leakage_error": 1e-5}
    coarse, fine = (facets(accuracy={"tolerance": t, **close}) for t in (1e-2, 1e-3))
    store = quiet(coarse, tmp_path / "flight.zarr").store
    outcome = extend(store, fine, progress=False, scheduler="none")
    assert outcome.complete and outcome.rays["three"] > 100 * fine.cycles("three")
    assert eyepoints_path(store, fine.geometry_id("three")).exists()
    assert tree(store) == tree(quiet(fine, tmp_path / "fine.zarr").store)


def test_rays_by_hand_are_no_tighter_tolerance(flown):
    with pytest.raises(StoreError, match=r"footprint\.beamlets: 0 -> 109, and must stay"):
        extend(flown["coarse"], facets(1e-3, 109), progress=False)


def test_it_is_the_same_however_it_is_cut(flown, tmp_path):
    cut = facets(1e-2, storage={"block_shots": 7, "block_draws": 1})
    found = shots(quiet(cut, tmp_path / "cut.zarr").store)
    np.testing.assert_array_equal(found.beamlets_error, shots(flown["coarse"]).beamlets_error)


def test_a_report_says_so_too(flown):
    told = " ".join(accuracy(shots(flown["coarse"]), facets(1e-2)))
    worst = float(shots(flown["coarse"]).beamlets_error.max())
    assert f"More beamlets would change one by {worst:.2g} at the most." in told
    assert "beamlets" not in " ".join(accuracy(shots(flown["by hand"]), facets(1e-4, 4009)))
