"""`sweep spectra`: what it writes is what studies draw, and opens with numpy and xarray."""

import json

import numpy as np
import pytest
import xarray as xr
import yaml
from test_cli import STUDY
from test_cli import sweep as command

import sweep
from sweep.spec import GridSpec

DRAWS = 30


@pytest.fixture
def working_directory(tmp_path, monkeypatch):
    """A directory of one's own with a study of whole spectra in it."""
    mapping = yaml.safe_load(STUDY)
    mapping["instrument"]["processing"] |= {
        "fft_size": "2^10", "tnr": 3.5, "window": "hann",
        "acquisition_delay": "20.1 us",  # the echo of 3 km is there from 20.01 us on
    }  # fmt: skip
    mapping |= {
        "draws": {"method": "spectra", "number": DRAWS},
        "axes": {"target.range": ["1 km", "3 km"]},
    }
    (tmp_path / "small.yaml").write_text(yaml.safe_dump(mapping))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_spectra_are_those_that_the_study_looks_at(working_directory):
    """Detections of the fixed threshold counted by hand, one by one, as the store has them."""
    stores = "a.zarr", "memory://spectra/a.zarr"
    for place in stores:
        assert sweep.run(sweep.load("small.yaml"), store=place, scheduler="none", progress=False)
    store = sweep.open("a.zarr")
    for source in ("small.yaml", *stores):
        result = command("spectra", source, "--at", "range=3km", "--draws", DRAWS, "-o", "s.zarr",
                       "--overwrite")  # fmt: skip
        assert result.exit_code == 0, result.output
        dataset = xr.open_zarr("s.zarr", consolidated=False).load()
        flags = np.abs(dataset.spectrum) >= dataset.threshold
        for segment in ("up", "down", "doppler"):
            at = int(np.argmax(np.abs(dataset.signal.sel(segment=segment).values)))
            counted = int(flags.sel(segment=segment).isel(frequency=at).sum())
            assert 0 < counted < DRAWS
            assert counted == int(store[f"n_detected_{segment}"].sel(range=3))
    assert GridSpec.from_stored(dataset.attrs["spec"]).id == sweep.load("small.yaml").id


@pytest.mark.parametrize("record", ["real", "complex"])
def test_a_file_says_what_is_true(working_directory, record):
    """Levels against the spectra themselves; lines against range and velocity."""
    mapping = yaml.safe_load((working_directory / "small.yaml").read_text())
    mapping["instrument"]["receiver"]["record"] = record
    (working_directory / "small.yaml").write_text(yaml.safe_dump(mapping))
    result = command("spectra", "small.yaml", "--draws", 50, "--first", 7, "-o", "s.npz")
    assert result.exit_code == 0, result.output
    s = np.load("s.npz")
    noise = s["spectrum"] - s["signal"]
    assert s["draw"].tolist() == list(range(7, 57)) and s["segment"].tolist()[1] == "doppler"
    power = np.mean(np.abs(noise[..., 1:-1]) ** 2)
    assert power == pytest.approx(s["noise_power"], rel=5 / np.sqrt(50 * 3 * 511 / 2))
    assert s["true_frequency"][1] == pytest.approx(2 * s["radial_velocity"] / 1550e-9, rel=1e-3)
    spacing = s["line_frequency"][2].mean() - s["line_frequency"][0].mean()
    beat = 2 * s["range"] / 299792458 * 1e9 / 500e-6
    folded = 2 * beat if record == "complex" else min(2 * beat, 2 * s["true_frequency"][1])
    assert abs(spacing) == pytest.approx(folded, rel=2e-3)
    power = np.abs(s["signal"]).argmax(axis=-1)  # of up, Doppler and down
    np.testing.assert_allclose(s["frequency"][power], s["true_frequency"], atol=1e6)
    assert json.loads(str(s["attributes"]))["window_name"] == "hann"
    later = command("spectra", "small.yaml", "--first", 20, "-o", "t.npz")
    assert later.exit_code == 0
    np.testing.assert_array_equal(np.load("t.npz")["spectrum"][0], s["spectrum"][13])


def test_mistakes_are_reported(working_directory):
    assert command("spectra", "small.yaml", "-o", "s.npz").exit_code == 0
    assert "does not exist" in command("spectra", "absent.yaml", "-o", "t.npz").stderr
    for arguments, words in (
        (("-o", "s.npz"), "--overwrite"),
        (("-o", "s.csv"), ".zarr nor .npz"),
        (("--at", "rnge=1km", "-o", "t.npz"), "did you mean 'target.range'"),
    ):
        result = command("spectra", "small.yaml", *arguments)
        assert result.exit_code == 2 and words in result.stderr


def test_code_is_run_with_leave_alone(working_directory, monkeypatch):
    monkeypatch.setenv("SWEEP_ALLOW_CODE", "")
    text = (
        (working_directory / "small.yaml")
        .read_text()
        .replace("    sample_rate:", "    detector: {kind: 'mine_of_cli:detect'}\n    sample_rate:")
    )
    (working_directory / "own.yaml").write_text(text)
    (working_directory / "mine_of_cli.py").write_text(
        "def detect(power, setting):\n    return power > setting.threshold**2\n"
    )
    refused = command("run", "own.yaml", "--scheduler", "none")
    assert refused.exit_code == 2 and "--allow-code mine_of_cli" in refused.stderr
    result = command("run", "own.yaml", "--scheduler", "none", "--allow-code", "mine_of_cli")
    assert result.exit_code == 0, result.output
