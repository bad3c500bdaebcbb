"""Looks from a spec to answers: grids and flights alike, what is refused, and what answers tell."""

from functools import partial
from pathlib import Path

import numpy as np
import pytest
import yaml
from shot_helpers import parametrize_product

import sweep
from sweep.model.detection.echo_detection import RAYLEIGH_DEVIATION
from sweep.model.detection.looks import Looks
from sweep.spec import GridSpec, SceneSpec, SpecError

EXPERIMENTS = Path(__file__).parents[1] / "experiments"
LEVEL = 5 * RAYLEIGH_DEVIATION


def instrument(looks, power="2 mW", **processing):
    """Table 4.1's in chirps of 10 us."""
    mapping = yaml.safe_load((EXPERIMENTS / "instruments" / "table_4_1.yaml").read_text())
    mapping["chirp"] |= {"duration": "10 us"}
    mapping["laser"] |= {"power": power}
    mapping["processing"] |= {
        "sample_rate": "512 MHz", "fft_size": 4096, "detection": "peak_bin",
        "noise_bins": "correlated", "tnr": 5,
    } | processing  # fmt: skip
    return mapping | {"looks": looks}


TARGET = {"range": "100 m", "reflectance": 0.1, "radial_velocity": "0 m/s",
          "grazing_angle": "90 deg"}  # fmt: skip


def grid(looks, **parts):
    return GridSpec.from_mapping(
        {"title": "Looks", "instrument": instrument(looks), "target": TARGET} | parts
    )


def flight(looks, **parts):
    return SceneSpec.from_mapping({
        "title": "Looks", "instrument": instrument(looks),
        "scene": {"origin": "ground", "objects": {
            "ground": {"kind": "plane", "size": "300 m", "reflectance": 0.1},
        }},
        "platform": {"path": {
            "kind": "still", "position": ["0 m", "0 m", "100 m"], "duration": "1 s",
        }},
        "scanners": {"beam": {"kind": "raster", "columns": 2, "rows": 2, "rate": "2 Hz",
                              "half_angles": ["1 deg", "1 deg"]}},
        "draws": {"number": 500},
    } | parts)  # fmt: skip


def results(spec, path):
    assert sweep.run(spec, store=path, scheduler="none", progress=False).complete
    if isinstance(spec, SceneSpec):
        return sweep.open_scene(path)["beam"].to_dataset().load()
    return sweep.open(path).load()


@pytest.mark.parametrize(
    ("looks", "kind"),
    parametrize_product(3, [{"number": 8, "speckle": "independent"}, {"number": 8}, {"number": 1},
              {"number": 6, "combine": "binary", "votes": 3}, {"number": 8, "combine": "coherent"}],
          [grid, flight]),
)  # fmt: skip
def test_looks_reach_grids_and_flights(kind, looks, tmp_path):
    """Each shot's pd follows from its own SNR, and its draws from that."""
    steady = looks.get("combine") == "binary" and kind is flight
    faint = steady or looks.get("speckle") == "independent"  # which fade less
    spec = kind(
        looks, instrument=instrument(looks, power="0.4 mW" if faint else "2 mW"),
        **({"footprint": {"speckle": "none"}} if steady else {}),
    )  # fmt: skip
    dataset = results(spec, tmp_path / "study.zarr")
    law = Looks.from_parameters(spec.parameters())
    assert law.number == looks["number"]
    signal = np.sqrt(2 * np.ravel(dataset.snr_up))
    expected, _ = (law.pd_and_miss_steady if steady else law.pd_and_miss_in_speckle)(
        signal, np.full(signal.shape, LEVEL)
    )
    # The echo's own shot noise is no part of the noise that the threshold is set on.
    np.testing.assert_allclose(np.ravel(dataset.pd_up), expected, rtol=2e-3)
    assert 0.3 < expected.min() < 1 - 1e-6
    if kind is flight:
        share = (np.ravel((dataset["flags"] > 0).any("return_number").mean("draw"))).mean()
        pd, alarms = (
            dataset.pd_shot.mean().item(),
            (dataset.pfa_up * dataset.pfa_down).mean().item(),
        )
        assert share == pytest.approx(pd + (1 - pd) * alarms, abs=5 * np.sqrt(0.25 / 2000) + 0.02)
        spread = dataset.range_interpolated - dataset.true_range
        scores = np.ravel(spread / dataset.range_interpolated_standard_error)
        scores = scores[np.isfinite(scores)]
        width = np.diff(np.percentile(scores, [15.865, 84.135]))[0] / 2
        assert width == pytest.approx(1.0, abs=0.1)


def test_a_shot_of_looks_lasts_as_many_times_as_long(tmp_path):
    spec = grid({"number": 1, "combine": "coherent"}, axes={"instrument.looks.number": [1, 4]})
    dataset = results(spec, tmp_path / "study.zarr")
    np.testing.assert_allclose(dataset.snr_up[1] / dataset.snr_up[0], 4.0, rtol=1e-6)
    np.testing.assert_allclose(dataset.pfa_bin[1], dataset.pfa_bin[0], rtol=1e-6)
    rates = dataset.sweep.false_alarms_per_second()
    assert float(rates[0] / rates[1]) == pytest.approx(4.0, rel=1e-3)
    bound = dataset.sweep.range_error()["bound"]
    assert float(bound[0] / bound[1]) == pytest.approx(2.0, rel=1e-3)
    with pytest.raises(ValueError, match=r"instrument\.looks\.number varies"):
        dataset.sweep.roc()


def test_curves_of_looks_go_by_their_own_alarms(tmp_path):
    spec = grid({"number": 4}, footprint={"speckle": "none"})
    dataset = results(spec, tmp_path / "study.zarr")
    law, signal = Looks(4), np.sqrt(2 * dataset.snr_up.item())
    chances = np.array([1e-8, 1e-3])
    curve = dataset.sweep.roc(chances, segment="up")
    level = law.threshold_ratio_from_log_pfa(np.log(chances))
    np.testing.assert_allclose(np.ravel(curve["curve_tnr"]), level / RAYLEIGH_DEVIATION, rtol=1e-6)
    np.testing.assert_allclose(
        np.ravel(curve["pd"]), law.pd_and_miss_steady(signal, level)[0], rtol=2e-3
    )


REFUSED = [
    ({"number": 8}, {"instrument": {"detection": "any_bin"}}, "instrument.processing.detection"),
    ({"number": 4, "combine": "binary", "votes": 5}, {}, "instrument.looks.votes"),
    ({"number": 65, "combine": "binary"}, {}, "instrument.looks.number"),
    ({"number": 4, "combine": "coherent", "speckle": "independent"}, {},
     "instrument.looks.speckle"),
    ({"number": 4}, {"draws": {"method": "noise", "number": 100}}, "draws.method"),
    ({"number": 4}, {"draws": {"method": "spectra", "number": 100},
      "instrument": {"detector": {"kind": "ca_cfar"}}}, "instrument.processing.detector.kind"),
    ({"number": 4, "speckle": "independent"}, {"draws": {"number": 100},
      "footprint": {"speckle": "none"}, "target": TARGET | {"roughness": "1 um"}},
     "instrument.looks.speckle"),
]  # fmt: skip


@pytest.mark.parametrize(("looks", "parts", "path"), REFUSED)
def test_looks_that_are_not_known_are_refused(looks, parts, path):
    """Told once, with the field, and accepted with one look."""
    sections = dict(parts)
    make_instrument = partial(instrument, **sections.pop("instrument", {}))
    with pytest.raises(SpecError) as error_info:
        grid(looks, **sections, instrument=make_instrument(looks))
    (mistake,) = error_info.value.mistakes
    assert mistake.path == path
    assert mistake.suggestion
    assert grid({"number": 1}, **sections, instrument=make_instrument({"number": 1})).id


def test_what_flights_of_looks_do_not_draw_is_refused():
    with pytest.raises(SpecError, match=r"instrument\.looks\.combine"):
        flight({"number": 4, "combine": "binary", "votes": 2})
    with pytest.raises(SpecError, match=r"draws\.method"):
        flight({"number": 4}, draws={"number": 5, "method": "noise"})


def test_a_gaussian_line_tells_no_phase_from_look_to_look():
    wide = instrument({"number": 4, "combine": "coherent"})
    wide["laser"] |= {"line_width": "10 kHz", "line_shape": "gaussian"}
    with pytest.raises(SpecError, match=r"instrument\.laser\.line_shape"):
        grid({}, instrument=wide)
