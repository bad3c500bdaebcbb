"""The command line over scenes: plan, run, run again, export, and what is refused."""

import csv

import pytest
import xarray as xr
from test_cli import STUDY, refused, sweep

from sweep.tasks.studies.eyepoint_study import get_built_scene

SCENE = (
    STUDY.split("target:")[0]
    + """\
scene:
  origin: ground
  objects:
    ground: {kind: plane, size: 3 km, reflectance: 0.1}
platform:
  path: {kind: straight, from: [0 m, 0 m, 500 m], to: [0 m, 0 m, 100 m],
         initial_speed: 100 m/s, final_speed: 30 m/s}
scanners:
  three: {kind: cone, beams: 3, half_angle: 22.5 deg, rate: 4 Hz}
footprint: {beamlets: 7, speckle: none}
draws: {number: 2}
"""
)


@pytest.fixture
def working_directory(tmp_path, monkeypatch):
    """A directory of one's own with a spec, descent.yaml, in it."""
    (tmp_path / "descent.yaml").write_text(SCENE)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_a_scene_is_planned_run_and_exported(working_directory):
    planned = sweep("plan", "descent.yaml")
    assert planned.exit_code == 0 and "550 rays" in planned.stdout
    assert "ground: 2 faces" in planned.stdout and "2, at 1 place" in planned.stdout
    ran = sweep("run", "descent.yaml", "--scheduler", "none")
    assert ran.exit_code == 0
    assert "three: 550 rays cast" in ran.stdout
    assert "150 of 150 shots, computed 1 of 1 block" in ran.stdout
    assert "150 of 150 shots" in sweep("status", "results/descent.zarr").stdout
    result = sweep("export", "results/descent.zarr", "cloud.csv")
    assert result.exit_code == 0
    flags = xr.open_datatree("results/descent.zarr", engine="zarr")["three"].flags.values[:, 0]
    assert result.stdout == f"cloud.csv: {(flags > 0).sum()} points\n"
    with open("cloud.csv") as file:
        assert sum(1 for _ in csv.DictReader(file)) == (flags > 0).sum()


@pytest.mark.parametrize("command", [("plan",), ("run", "--scheduler", "none")])
def test_a_flight_beneath_its_ground_is_warned_of(working_directory, command):
    """From 500 m to 100 m over ground at 300 m; to the ground itself there is nothing to say."""
    sunk = "ground: {kind: plane, size: 3 km, height: 300 m, reflectance: 0.1}"
    scene_text = SCENE.replace("ground: {kind: plane, size: 3 km, reflectance: 0.1}", sunk)
    (working_directory / "sunk.yaml").write_text(
        scene_text.replace("origin: ground", "origin: world")
    )
    stderr = sweep(command[0], "sunk.yaml", *command[1:]).stderr
    assert "warning: the platform is beneath ground from time 2." in stderr and "by 200 m" in stderr
    (working_directory / "landing.yaml").write_text(SCENE.replace("0 m, 100 m]", "0 m, 0 m]"))
    assert "beneath" not in sweep(command[0], "landing.yaml", *command[1:]).stderr


@pytest.mark.parametrize("command", [("plan",), ("run", "--scheduler", "none")])
def test_a_flight_that_sees_nothing_is_refused_with_both_extents(working_directory, command):
    """A path in coordinates of a map, over a scene whose zero is its own middle."""
    (working_directory / "away.yaml").write_text(SCENE.replace("[0 m, 0 m,", "[500 km, 4000 km,"))
    result = sweep(command[0], "away.yaml", *command[1:])
    refused(
        result, "platform.path", "no", "the path spans x 500000, y 4e+06, z 100 to 500 m",
        "the scene x -1500 to 1500, y -1500 to 1500, z 0 m", "origin: world",
    )  # fmt: skip
    assert not (working_directory / "results" / "away.zarr").exists()


@pytest.mark.parametrize("command", [("plan",), ("run", "--scheduler", "none")])
def test_a_flight_that_sees_only_a_part_is_warned_of(working_directory, command):
    (working_directory / "small.yaml").write_text(SCENE.replace("size: 3 km", "size: 250 m"))
    result = sweep(command[0], "small.yaml", *command[1:])
    assert result.exit_code == 0
    (warning,) = [line for line in result.stderr.splitlines() if "of the shots hit" in line]
    assert warning.startswith("warning: scanners.three: only ") and "x -125 to 125" in warning
    whole_flight = sweep(command[0], "descent.yaml", *command[1:])
    assert "of the shots hit" not in whole_flight.stderr
    if command[0] == "plan":
        assert "three: 100 % of the shots hit something" in whole_flight.stdout
        assert (
            "the path spans x 0, y 0, z 100 to 500 m, and the scene x -1500" in whole_flight.stdout
        )


def test_plan_and_run_warn_of_what_is_questionable_in_a_file(working_directory):
    import numpy as np

    heights = np.zeros((40, 40))
    heights[:3] = -9999
    np.save("ground.npy", heights)
    ground = "kind: array, file: ground.npy, spacing: [100 m, 100 m]"
    (working_directory / "array.yaml").write_text(SCENE.replace("kind: plane, size: 3 km", ground))
    for command in (("plan",), ("run", "--scheduler", "none")):
        result = sweep(command[0], "array.yaml", *command[1:])
        assert result.exit_code == 0
        assert "warning: scene.objects.ground: ground.npy: the value -9999" in result.stderr
    (working_directory / "array.yaml").write_text(
        SCENE.replace("kind: plane, size: 3 km", ground + ", no_data: -9999")
    )
    assert "9999" not in sweep("plan", "array.yaml").stderr


def test_a_second_study_of_the_same_geometry_says_that_no_ray_was_cast(working_directory):
    sweep("run", "descent.yaml", "--scheduler", "none")
    (working_directory / "weak.yaml").write_text(SCENE.replace("power: 1 W", "power: 10 mW"))
    assert "eyepoints are there already" in sweep("plan", "weak.yaml").stdout
    second_result = sweep("run", "weak.yaml", "--scheduler", "none")
    assert (
        second_result.exit_code == 0
        and "three: eyepoints were there, no ray cast" in second_result.stdout
    )


def test_mistakes_over_a_scene_end_in_plain_words_and_exit_code_2(working_directory):
    refused(sweep("shot", "descent.yaml"), "shot_spectra")
    missing = SCENE.replace("kind: plane, size: 3 km", "kind: raster, file: none.tif")
    (working_directory / "missing.yaml").write_text(missing)
    refused(sweep("run", "missing.yaml"), "scene.objects.ground.file", "none.tif")
    (working_directory / "low.yaml").write_text(SCENE.replace("kind: cone", "kind: kone"))
    refused(sweep("run", "low.yaml"), "kone", "did you mean 'cone'?")
    refused(sweep("export", "results/none.zarr", "a.las"), "there is no store")
    sweep("run", "descent.yaml", "--scheduler", "none")
    refused(sweep("export", "results/descent.zarr", "a.xyz"), "suffix", ".ply")
    below = "descent.yaml/a.ply"  # a file where a folder should be
    refused(sweep("export", "results/descent.zarr", below), "descent.yaml: ", "name another place")
    refused(sweep("export", "results/descent.zarr", "a.ply", "--draw", "7"), "numbered 0 to 1")
    (eyepoints,) = (working_directory / "results" / "eyepoints").iterdir()
    refused(sweep("resume", eyepoints), "holds eyepoints")
    refused(sweep("figures", eyepoints), "eyepoints")
    (working_directory / "turned.yaml").write_text(SCENE.replace("22.5 deg", "20 deg"))
    result = sweep("run", "turned.yaml", "--store", "results/descent.zarr")
    refused(result, "scanners.three.half_angle: 22.5 deg -> 20 deg")


def test_a_file_that_changes_under_a_study_is_noticed(working_directory):
    import numpy as np

    np.save("ground.npy", np.zeros((20, 20)))
    (working_directory / "array.yaml").write_text(
        SCENE.replace(
            "kind: plane, size: 3 km", "kind: array, file: ground.npy, spacing: [100 m, 100 m]"
        )
    )
    assert sweep("run", "array.yaml", "--scheduler", "none").exit_code == 0
    store = working_directory / "results" / "array.zarr"
    chunk = store / "three" / "range" / "c" / "0" / "0" / "0"
    chunk.unlink()
    np.save("ground.npy", np.ones((20, 20)))
    assert sweep("resume", store, "--scheduler", "none").exit_code == 0  # rays are cast already
    refused(sweep("run", "array.yaml", "--store", store), "another study", "ground")
    (eyepoints,) = (working_directory / "results" / "eyepoints").iterdir()
    (eyepoints / "offset" / "c" / "0" / "0").unlink()
    get_built_scene.cache_clear()  # as in another process
    refused(sweep("resume", store, "--scheduler", "none"), "ground.npy", "changed")
