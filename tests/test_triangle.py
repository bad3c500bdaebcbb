"""A triangle waveform from a spec to answers, beside the lander's three segments."""

from pathlib import Path

import numpy as np
import pytest
import yaml

import sweep
from sweep.spec import Spec

EXPERIMENTS = Path(__file__).parents[1] / "experiments"


def instrument(**chirp):
    """Table 4.1's, with a chirp that is steep enough for 15 m/s at 30 m."""
    written = yaml.safe_load((EXPERIMENTS / "instruments" / "table_4_1.yaml").read_text())
    written["chirp"] |= {"duration": "10 us"} | chirp
    written["laser"] |= {"power": "1 W"}
    written["processing"] |= {
        "sample_rate": "512 MHz", "fft_size": 4096, "detection": "any_bin",
        "noise_bins": "correlated",
    }  # fmt: skip
    return written


def test_a_grid_lists_its_segments_and_may_vary_them(tmp_path):
    spec = Spec.from_mapping({
        "title": "Waveforms", "instrument": instrument(),
        "target": {"range": "100 m", "reflectance": 0.1, "radial_velocity": "5 m/s",
                   "grazing_angle": "90 deg"},
        "axes": {"instrument.chirp.segments": ["up doppler down", "up down", "down up"]},
    })  # fmt: skip
    done = sweep.run(spec, store=tmp_path / "grid.zarr", scheduler="none", progress=False)
    assert done.complete
    found = sweep.open(tmp_path / "grid.zarr").load()
    assert np.isnan(found.pd_doppler).to_numpy().tolist() == [False, True, True]
    assert found.pd_shot.to_numpy() == pytest.approx(np.full(3, found.pd_shot[0]), rel=1e-2)
    assert np.abs(found.range_error).max() < 0.2
    assert np.abs(found.radial_velocity_error).max() < 0.2
    bits = found.log10_pfa_shot.to_numpy()  # of two segments for three
    assert 10 ** (bits[0] - bits[1]) == pytest.approx(1.5, rel=1e-2)
    rates = found.sweep.false_alarms_per_second()
    assert float(rates[1] / rates[0]) == pytest.approx(1.5, rel=1e-2)
