"""A triangle waveform from a spec to answers, beside the lander's three segments."""

from pathlib import Path

import numpy as np
import pytest
import yaml

import sweep
from sweep.model.pointcloud.pairing import TRUE_RETURN_FLAG, UNCONFIRMED_FLAG
from sweep.spec import GridSpec, SceneSpec

EXPERIMENTS = Path(__file__).parents[1] / "experiments"
STREET = {
    "ground": {"kind": "plane", "size": "400 m", "reflectance": 0.3},
    **{
        f"house_{side}_{number}": {
            "kind": "box", "size": ["18 m", "9 m", f"{8 + 3 * number} m"], "reflectance": 0.4,
            "position": [f"{25 * number - 50} m", f"{12 * sign} m", f"{4 + 1.5 * number} m"],
        }
        for number in range(4)
        for side, sign in (("left", 1), ("right", -1))
    },
}  # fmt: skip


def instrument(**chirp):
    """Table 4.1's, with a chirp that is steep enough for 15 m/s at 30 m.

    Records begin with the chirp: echoes from 90 m lack the first 6 % of them.
    """
    mapping = yaml.safe_load((EXPERIMENTS / "instruments" / "table_4_1.yaml").read_text())
    mapping["chirp"] |= {"duration": "10 us"} | chirp
    mapping["laser"] |= {"power": "1 W"}
    mapping["processing"] |= {
        "sample_rate": "512 MHz", "fft_size": 4096, "detection": "any_bin",
        "noise_bins": "correlated",
    }  # fmt: skip
    return mapping


def test_a_grid_lists_its_segments_and_may_vary_them(tmp_path):
    spec = GridSpec.from_mapping({
        "title": "Waveforms", "instrument": instrument(),
        "target": {"range": "100 m", "reflectance": 0.1, "radial_velocity": "5 m/s",
                   "grazing_angle": "90 deg"},
        "axes": {"instrument.chirp.segments": ["up doppler down", "up down", "down up"]},
    })  # fmt: skip
    outcome = sweep.run(spec, store=tmp_path / "grid.zarr", scheduler="none", progress=False)
    assert outcome.complete
    dataset = sweep.open(tmp_path / "grid.zarr").load()
    assert np.isnan(dataset.pd_doppler).to_numpy().tolist() == [False, True, True]
    assert dataset.pd_shot.to_numpy() == pytest.approx(np.full(3, dataset.pd_shot[0]), rel=1e-2)
    assert np.abs(dataset.range_error).max() < 0.2
    assert np.abs(dataset.radial_velocity_error).max() < 0.2
    bits = dataset.log10_pfa_shot.to_numpy()  # of two segments for three
    assert 10 ** (bits[0] - bits[1]) == pytest.approx(1.5, rel=1e-2)
    rates = dataset.sweep.false_alarms_per_second()
    assert float(rates[1] / rates[0]) == pytest.approx(1.5, rel=1e-2)


def flown(tmp_path, record="real", **chirp):
    """Point cloud of a street of boxes, from 90 m to 60 m above it at 15 m/s."""
    spec = SceneSpec.from_mapping({
        "title": "A street",
        "instrument": instrument(**chirp) | {"receiver": receiver(record)},
        "scene": {"origin": "ground", "objects": STREET},
        "platform": {"path": {
            "kind": "straight", "from": ["0 m", "0 m", "90 m"], "to": ["0 m", "0 m", "60 m"],
            "initial_speed": "15 m/s", "final_speed": "15 m/s",
        }},
        "scanners": {"frame": {"kind": "raster", "columns": 20, "rows": 20,
                               "half_angles": ["12 deg", "12 deg"], "rate": "20 Hz"}},
        "footprint": {"beamlets": 1, "speckle": "none"}, "draws": {"number": 2},
    })  # fmt: skip
    store = tmp_path / f"{record}_{'_'.join(map(str, chirp.values()))}.zarr".replace(" ", "_")
    assert sweep.run(spec, store=store, scheduler="none", progress=False).complete
    return sweep.open_scene(store)["frame"].to_dataset().load()


def receiver(record):
    mapping = yaml.safe_load((EXPERIMENTS / "instruments" / "table_4_1.yaml").read_text())
    return mapping["receiver"] | {"record": record}


@pytest.fixture(scope="module")
def three(tmp_path_factory):
    """The street by the lander's three segments."""
    return flown(tmp_path_factory.mktemp("three"), segments="up doppler down")


@pytest.mark.parametrize("record, chirp", [
    ("real", {"segments": "up down"}),
    pytest.param("complex", {"segments": "up down", "down_slope": 0.5}, marks=pytest.mark.slow),
    pytest.param(
        "real", {"segments": "up doppler down", "doppler_slope": 0.3, "down_slope": -0.6},
        marks=pytest.mark.slow,
    ),
    ("complex", {"segments": "doppler up down", "doppler_slope": -0.5, "down_slope": 0.25}),
])  # fmt: skip
def test_no_point_of_a_street_is_lost_whatever_the_slopes(tmp_path, three, record, chirp):
    """Range and velocity stray by their standard errors: z-scores within 1 +- 0.1.

    As many true points as by the lander's three segments, but for what three beats tell apart.
    """
    points = flown(tmp_path, record, **chirp)
    n_kept, before = (
        (names["flags"] & TRUE_RETURN_FLAG > 0).sum().item() for names in (points, three)
    )
    assert n_kept >= 0.995 * before > 500
    if "doppler" in chirp["segments"]:  # whose beat, with its sign, confirms what belongs together
        assert (
            points["flags"] & (TRUE_RETURN_FLAG | UNCONFIRMED_FLAG) == TRUE_RETURN_FLAG
        ).sum().item() >= 0.99 * n_kept
    nothing = points["flags"] == 0
    assert nothing.any()
    for name in ("range", "radial_velocity"):
        error = points[f"{name}_interpolated"] - points[f"true_{name}"]
        scores = (error / points[f"{name}_interpolated_standard_error"]).to_numpy()
        scores = scores[np.isfinite(scores)]
        spread = np.diff(np.percentile(scores, [15.865, 84.135]))[0] / 2
        assert abs(spread - 1) < 0.1, (name, spread, scores.std())
        signed_error = points[name] - points[f"true_{name}"]
        scores = (signed_error / points[f"{name}_standard_error"]).to_numpy()
        assert 0.8 < np.nanstd(scores) < 1.2, (name, np.nanstd(scores))
        for error_name in (
            "standard_error",
            "interpolated_standard_error",
        ):  # of no point there is none
            assert (points[f"{name}_{error_name}"].isnull() == nothing).all(), (name, error_name)
