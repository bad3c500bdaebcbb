"""Errors over standard errors: which clouds keep what they state, and what is told of others."""

import numpy as np
import pytest
import xarray as xr
from click.testing import CliRunner

from sweep.analysis.scene_results.consistency import (
    check_error_consistency,
    understated_error_messages,
)
from sweep.analysis.scene_results.point_export import export
from sweep.cli import main
from sweep.model.pointcloud.pairing import TRUE_RETURN_FLAG
from sweep.report.study_report import write_report
from sweep.spec import SceneSpec
from sweep.tasks import driver

SHOTS, DRAWS = 90, 20


def cloud(understated=1.0, *, navigated=1.0, shots=SHOTS):
    """A flight of three beams with normal errors, some of them larger than stated."""
    rng = np.random.default_rng(7)
    dims, shape = ("power", "shot", "draw", "return_number"), (2, shots, DRAWS, 1)
    cycle = ("power", "cycle", "draw")
    sizes = 2, shots // 3, DRAWS
    root = rng.normal(size=(3, 3))
    covariance = root @ root.T
    points = {
        "flags": (dims, np.full(shape, TRUE_RETURN_FLAG, np.uint8)),
        "pd_shot": (("power", "shot"), np.ones((2, shots))),
    }
    for name, sigma in (("range", 0.02), ("radial_velocity", 1e-3)):
        truth = rng.uniform(10, 20, shape)
        points |= {
            f"true_{name}": (dims, truth),
            f"{name}_interpolated": (dims, truth + understated * rng.normal(0, sigma, shape)),
            f"{name}_interpolated_standard_error": (dims, np.full(shape, sigma)),
        }
    error = navigated * rng.multivariate_normal(np.zeros(3), covariance, sizes)
    points |= {
        "velocity": ((*cycle, "xyz"), error + 5.0),
        "true_velocity": (("cycle", "xyz"), np.full((sizes[1], 3), 5.0)),
        "velocity_covariance": ((*cycle, "xyz", "xyz_again"),
                                np.broadcast_to(covariance, (*sizes, 3, 3))),
        "velocity_status": (cycle, np.zeros(sizes, np.int8)),
        "altitude": (cycle, 100 + navigated * rng.normal(0, 2.0, sizes)),
        "true_altitude": (("cycle",), np.full(sizes[1], 100.0)),
        "altitude_variance": (cycle, np.full(sizes, 4.0)),
        "altitude_status": (cycle, np.zeros(sizes, np.int8)),
    }  # fmt: skip
    group = xr.Dataset(points, attrs={"shots_a_cycle": 3})
    return xr.DataTree.from_dict({"/": xr.Dataset(attrs={"scanners": ["three"]}), "/three": group})


def test_normal_errors_of_the_stated_size_are_consistent():
    consistency = check_error_consistency(cloud())
    assert [check.quantity for check in consistency] == [
        "range",
        "radial velocity",
        "velocity",
        "altitude",
    ]
    for check in consistency:
        assert check.error_ratio == pytest.approx(1, abs=0.1) and check.is_consistent


def test_errors_are_reported_as_ratios_to_stated_errors():
    ratios = {
        check.quantity: check for check in check_error_consistency(cloud(100.0, navigated=7.0))
    }
    for quantity, ratio in (("range", 100), ("radial velocity", 100), ("velocity", 7),
                            ("altitude", 7)):  # fmt: skip
        assert ratios[quantity].error_ratio == pytest.approx(ratio, rel=0.1)
        assert not ratios[quantity].is_consistent
    assert (
        "residuals are " in ratios["range"].message
        and "times the stated" in ratios["range"].message
    )


def test_few_errors_and_long_flights():
    few = cloud(100.0, shots=3).isel(draw=slice(2), power=slice(1))
    assert [check.n_errors for check in check_error_consistency(few)] == [6, 6, 2, 2]
    assert all(check.is_consistent for check in check_error_consistency(few))
    long = check_error_consistency(cloud(3.0, shots=3 << 14))
    assert long[0].n_errors < 3 << 20 and long[0].error_ratio == pytest.approx(3, rel=0.05)


@pytest.fixture(scope="module")
def over_hills(tmp_path_factory):
    """A flight over hills whose relief nobody stated: its altitudes are off by metres."""
    ground = {"kind": "hills", "size": "2 km", "spacing": "10 m", "rms_height": "10 m",
              "correlation_length": "100 m", "seed": 2, "reflectance": 0.1}  # fmt: skip
    study = {
        "title": "Hills", "instrument": "chester_2017_table_5_1",
        "scene": {"origin": "ground", "objects": {"ground": ground}},
        "platform": {"path": {"kind": "straight", "from": ["0 m", "0 m", "900 m"],
                              "to": ["0 m", "0 m", "500 m"], "initial_speed": "50 m/s"}},
        "scanners": {"four": {"kind": "corners", "angle": "15 deg", "rate": "4 Hz"}},
        "footprint": {"beamlets": 19}, "draws": {"number": 3},
    }  # fmt: skip
    store = tmp_path_factory.mktemp("hills") / "hills.zarr"
    spec = SceneSpec.from_mapping(study, base=store.parent)
    assert driver.run(spec, store=store, scheduler="none").complete
    return store


def test_run_report_and_export_say_what_is_inconsistent(over_hills, tmp_path):
    (message,) = understated_error_messages(over_hills)
    assert message.startswith("four: altitude is inconsistent: residuals are ")
    assert understated_error_messages(over_hills, "none of these") == []
    assert (
        "four: altitude is inconsistent"
        in write_report(over_hills, tmp_path / "p.html").read_text()
    )
    export(over_hills, tmp_path / "cloud.ply", scanner="four")
    header = (tmp_path / "cloud.ply").read_bytes().split(b"end_header")[0]
    assert b"comment four: altitude is inconsistent" in header
    ran = CliRunner().invoke(main, ["export", str(over_hills), str(tmp_path / "cloud.las")])
    assert ran.exit_code == 0
    assert "four: altitude is inconsistent: residuals are" in ran.stderr
