import json
import pickle
import subprocess
import sys

import pytest
from base_spec import axis_member_content, changed_spec, required_values
from hypothesis import given, settings
from hypothesis import strategies as st

import sweep.spec.specs
from sweep.model.threshold import (
    DESIGN_PFA_BIN_PATH,
    DESIGN_PFA_SEGMENT_PATH,
    DESIGN_PFA_SHOT_PATH,
    THRESHOLD_PATHS,
    TNR_PATH,
)
from sweep.model.waveform import REPORTED_PEAKS_PATH, SEARCH_BAND_PATHS
from sweep.spec import GridSpec, describe_differences
from sweep.spec.grid_checks import is_detector_or_estimator_parameter
from sweep.spec.rules import ChoiceRule
from sweep.spec.sections import MODEL_BY_SECTION, default_value, parameter_rules
from sweep.units import QuantityError

AXES = {"target.range": {"step": ["1 m", "100 m", "1 m"]}, "instrument.laser.power": ["1 W", "3 W"]}

OTHER_WAYS = set(THRESHOLD_PATHS) - {TNR_PATH} | set(SEARCH_BAND_PATHS)
"""Of setting the threshold, of which a spec has one; and a search band, which none need have."""
BAND = dict(zip(SEARCH_BAND_PATHS, ("10 m", "2 km", "-5 m/s", "95 m/s"), strict=True))

CUT = {"zip": [{"target.grazing_angle": ["1 deg", "2 deg"], "footprint.beamlets": 7}]}


def spec(changes=None, **sections):
    return GridSpec.from_mapping(changed_spec(changes, **sections))


@pytest.mark.parametrize(
    ("path", "spellings"),
    [
        ("instrument.telescope.aperture", ["25 mm", "0.025 m", "2.5 cm", "2.5e1 mm", "25000 µm"]),
        ("instrument.laser.beam_divergence", ["50 urad", "0.05 mrad", "5e-5 rad"]),
        ("instrument.chirp.bandwidth", ["1 GHz", "1000 MHz", "10^9 Hz", "1e9 Hz"]),
        ("instrument.processing.fft_size", ["2^17", 131072, "131072", 131072.0, "2**17"]),
        ("instrument.processing.tnr", [10, 10.0, "10", "1e1"]),
        ("instrument.processing.window", ["rectangular", "boxcar", "rect", " Rectangular "]),
        ("instrument.receiver.noise_equivalent_power", ["5 pW/rtHz", "5e-12 W/sqrt(Hz)"]),
        ("target.reflectance", [0.1, "0.1", "10 %"]),
        ("target.radial_velocity", ["10 m/s", "36 km/h", "0.01 km/s"]),
        ("instrument.receiver.temperature", ["293.15 K", "20 degC"]),
    ],
)
def test_the_spelling_of_a_value_leaves_the_id_alone(path, spellings):
    assert len({spec({path: spelling}).id for spelling in spellings}) == 1


def test_the_way_an_axis_is_written_leaves_the_id_alone():
    ways = [
        {"step": ["1 m", "100 m", "1 m"]},
        {"linear": ["1 m", "0.1 km"], "number": 100},
        [f"{i} m" for i in range(1, 101)],
        ["100 cm", {"step": ["2 m", "100 m", "100 cm"]}],
    ]
    assert len({spec(axes={"target.range": way}).id for way in ways}) == 1


def shuffled(mapping, random):
    """The mapping with every mapping in it but its axes in another order."""
    keys = list(mapping)
    random.shuffle(keys)
    return {
        key: shuffled(mapping[key], random)
        if isinstance(mapping[key], dict) and key != "axes"
        else mapping[key]
        for key in keys
    }


@settings(deadline=None)
@given(st.randoms(use_true_random=False))
def test_the_order_of_keys_leaves_the_id_alone(random):
    mapping = changed_spec(axes=AXES, seed=3)
    assert GridSpec.from_mapping(shuffled(mapping, random)).id == GridSpec.from_mapping(mapping).id


def test_the_order_of_axes_is_part_of_the_id_as_it_lays_out_the_arrays():
    assert spec(axes=AXES).id != spec(axes=dict(reversed(AXES.items()))).id


@pytest.mark.parametrize(
    "changes",
    [
        {"title": "Another"},
        {"question": "Why?"},
        {"execution": {"workers": 7, "threads": 2, "scheduler": "none"}},
        {"figures": [{"kind": "slices", "variable": "pd_shot", "x": "range"}]},
        {"target.range": "77 m"},  # an axis overrides it
    ],
)
def test_what_changes_no_result_leaves_the_id_alone(changes):
    assert spec(changes, axes=AXES).id == spec(axes=AXES).id


EVERY = {
    "target.roughness": "1 um", "target.pointing_jitter": "1 urad",
    "atmosphere.turbulence": "uniform", "atmosphere.extinction": "0.1 1/km",
    "instrument.processing.full_scale": "1 V", "draws.number": 1,
    "instrument.telescope.coupling": "single_mode", "instrument.laser.beam_divergence": "100 urad",
}  # fmt: skip
"""What other parameters need or are shown by: the base study of those that an effect brings."""


def other_value(path):
    """A good value of a parameter that is not the one of the base study."""
    special = {
        "instrument.receiver.architecture": "heterodyne",
        "instrument.chirp.error_table": [
            ["0 us", "0 Hz"],
            ["250 us", "1 kHz"],
            ["500 us", "2 kHz"],
        ],
        "instrument.processing.window": "hann",
        "instrument.processing.bins_counted": "all",
        "target.reflectance_law": "thesis",
        "footprint.phases": "coherent",
        "footprint.speckle": "developed",
        "target.grazing_angle": "14 deg",
        "instrument.laser.beam_divergence": "101 urad",
        "instrument.laser.wavelength": "1551 nm",
        "instrument.laser.beam_waist": "5 mm",
        "instrument.laser.beam_quality": 1.1,
        "instrument.receiver.local_oscillator_waist": "5 mm",
        "instrument.telescope.misalignment": "1 urad",
        "instrument.receiver.antialias_order": 4,
        "instrument.processing.sample_rate": "601 MHz",
        "instrument.chirp.duration": "501 us",
        "instrument.receiver.mixing_efficiency": 0.3,
        "instrument.receiver.responsivity": "1 A/W",
        "instrument.telescope.optical_efficiency": 0.3,
        "instrument.receiver.modulation_index": 0.3,
        "target.reflectance": 0.3,
        "instrument.processing.acquisition_delay": "1 us",
        "accuracy.leakage_floor": 0.2,
        "accuracy.line_error": 0.2,
        "accuracy.leakage_error": 0.2,
        "accuracy.tolerance": 0.2,
        "accuracy.confidence": 0.9,
        "instrument.processing.bits": 12,
        "instrument.processing.fft_size": "2^16",
        **dict.fromkeys((DESIGN_PFA_BIN_PATH, DESIGN_PFA_SEGMENT_PATH, DESIGN_PFA_SHOT_PATH), 0.01),
        "instrument.receiver.field_of_view": "1 mrad",
        "instrument.receiver.iq_gain_imbalance": "0.5 dB",
        "instrument.receiver.iq_phase_imbalance": "3 deg",
        "target.pointing_jitter": "1 mrad",
        "target.sun_elevation": "1 rad",
        "target.sun_distance": "1.5 au",
        "atmosphere.profile": "layer",
        "instrument.processing.detector.kind": "os_cfar",
        "instrument.processing.detector.training": 16,
        "instrument.processing.detector.rank": 7,
        "instrument.processing.detector.pfa": 0.01,
        "instrument.processing.estimator.kind": "candan",
    }
    rule = parameter_rules()[path]
    if type(rule) is ChoiceRule and path not in special:
        return next(
            word for word in rule.options if word not in (default_value(path), EVERY.get(path))
        )
    if path in special:
        return special[path]
    value = f"77 {rule.si_unit}".strip()
    try:
        rule.read(value)
    except QuantityError:  # beyond the limits
        return rule.example
    return value


@pytest.mark.parametrize("path", sorted(parameter_rules()))
def test_every_parameter_is_part_of_the_id(path):
    # What looks at whole spectra is one of studies that draw some.
    spectra = (
        {"draws.method": "spectra", "draws.number": 5}
        if is_detector_or_estimator_parameter(path)
        else {}
    )
    every = EVERY | spectra
    if path == "instrument.laser.beam_waist":  # one of the two that say how wide a beam is
        every |= {"instrument.laser.beam_divergence": "none", path: "4 mm"}
    if path == "instrument.looks.number":  # several records detect by the largest bin
        every |= {"instrument.processing.detection": "peak_bin"}
    if path == "footprint.speckle":
        every |= {"target.roughness": "0 um"}  # a stated one asks for no developed speckle
    every |= required_values(path)
    if path in SEARCH_BAND_PATHS:
        every |= BAND
    if path == REPORTED_PEAKS_PATH:  # of closed forms, without draws
        every = {}
    instead = {TNR_PATH: ...} if path in THRESHOLD_PATHS and path != TNR_PATH else {}
    base, changed_spec = spec(every), spec(every | instead | {path: other_value(path)})
    assert changed_spec.id != base.id
    lines = describe_differences(base, changed_spec)
    assert len(lines) == 1 + len(instead)
    assert any(line.startswith(f"{path}: ") for line in lines)


@pytest.mark.parametrize(
    "changes", [{"seed": 1}, {"draws.number": 5}, {"draws.batch": 5}, {"draws.method": "noise"},
                {"draws.limit": 5}, {"draws.interval": "wilson"}, {"storage.block_points": 5}]
)  # fmt: skip
def test_draws_seed_and_blocks_are_part_of_the_id(changes):
    assert spec(changes).id != spec().id


def test_the_models_version_is_part_of_the_id(monkeypatch):
    before, id_before = spec().identity(), spec().id
    monkeypatch.setattr(sweep.spec.specs, "MODEL_VERSION", "another")
    assert spec().id != id_before
    (line,) = describe_differences(before, spec())
    assert line.startswith("model: ") and line.endswith("-> another")


def test_the_id_is_the_same_in_another_process():
    code = (
        "import json, sys; from sweep.spec import GridSpec;"
        "print(GridSpec.from_mapping(json.load(sys.stdin)).id)"
    )
    mapping = changed_spec(axes=AXES)
    run = subprocess.run(
        [sys.executable, "-c", code],
        input=json.dumps(mapping),
        capture_output=True,
        text=True,
        check=True,
    )
    assert run.stdout.strip() == GridSpec.from_mapping(mapping).id


def test_difference_tells_each_change_with_its_unit():
    a = spec(axes=AXES)
    b = spec(
        {"target.reflectance": 0.2, "seed": 4, "instrument.telescope.aperture": "50 mm"},
        axes={
            "instrument.laser.power": ["1 W", "5 W"],
            "target.range": {"step": ["1 m", "99 m", "1 m"]},
        },
    )
    lines = describe_differences(a, json.loads(json.dumps(b.identity())))
    assert "instrument.telescope.aperture: 0.025 m -> 0.05 m" in lines
    assert "target.reflectance: 0.1 -> 0.2" in lines
    assert "seed: 0 -> 4" in lines
    assert "axes: range, power -> power, range" in lines
    assert "axes.power.instrument.laser.power: [1, 3] W -> [1, 5] W" in lines
    (ranges,) = [line for line in lines if line.startswith("axes.range")]
    assert "100 values from 1 to 100 m" in ranges and "99 values from 1 to 99 m" in ranges
    assert len(lines) == 6
    assert describe_differences(a, a.identity()) == []


def test_differences_tell_angles_as_users_write_them():
    angle, divergence = "target.grazing_angle", "instrument.laser.beam_divergence"
    a = spec({angle: "7.3 deg", divergence: "50 urad"})
    assert describe_differences(a, spec({angle: "11.25 deg", divergence: "0.3 mrad"})) == [
        f"{divergence}: 50 urad -> 300 urad", f"{angle}: 7.3 deg -> 11.25 deg",
    ]  # fmt: skip
    turned = spec({divergence: "50 urad"}, axes={angle: ["22.5 deg", "45 deg"]})
    assert f"axes.grazing_angle.{angle}: (none) -> [22.5, 45] deg" in describe_differences(
        a, turned
    )


def test_an_axis_added_is_reported():
    lines = describe_differences(spec(), spec(axes={"target.range": ["1 m"]}))
    assert lines == ["target.range: 2000 m -> (none)", "axes: (none) -> range",
                     "axes.range.target.range: (none) -> [1] m"]  # fmt: skip


def test_a_stored_spec_comes_back_the_same():
    original = spec(
        {"target.range": ..., "instrument.receiver.noise_figure": "3 dB"},
        axes=AXES | {"cut": CUT},
        figures=[{"kind": "surface", "variable": "pd_shot", "x": "range", "y": "power",
                  "where": {"grazing_angle": ["1 deg"]}}],
        question="Ψ?", seed=5, draws={"number": "1e3"},
    )  # fmt: skip
    text = original.to_json()
    restored = GridSpec.from_stored(text)
    assert restored == original and hash(restored) == hash(original)
    assert restored.id == original.id
    for one, other in zip(restored.axes, original.axes, strict=True):
        assert one.name == other.name
        assert list(map(axis_member_content, one.parameters)) == list(
            map(axis_member_content, other.parameters)
        )
    assert restored.figures == original.figures
    assert restored.parameters() == original.parameters()
    assert restored.to_json() == text
    assert pickle.loads(pickle.dumps(original)) == original


def test_a_stored_spec_says_everything_itself():
    mapping = spec().to_yaml_mapping()
    for path in set(parameter_rules()) - OTHER_WAYS:
        part = mapping
        for name in path.split("."):
            part = part[name]
    assert {"draws", "seed", "storage"} <= set(mapping)
    assert "execution" not in spec({"execution.workers": 3}).to_yaml_mapping()


def test_parameters_are_all_there_in_si():
    parameters = spec(
        {"target.grazing_angle": "15 deg", "instrument.receiver.noise_figure": "10 dB"}
    ).parameters()
    assert set(parameters) == set(parameter_rules()) - OTHER_WAYS
    assert {path.split(".")[0] for path in parameters} == set(MODEL_BY_SECTION)
    assert parameters["instrument.receiver.noise_equivalent_power"] == 5e-12
    assert parameters["instrument.receiver.noise_figure"] == 10.0
    assert parameters["instrument.receiver.local_oscillator_power"] == 1e-3
    assert parameters["instrument.processing.fft_size"] == 131072
    assert isinstance(parameters["instrument.processing.fft_size"], int)
    assert parameters["instrument.processing.window"] == "hamming"


def test_parameters_at_another_point_are_read_like_a_spec():
    base = spec()
    at = base.parameters_with_overrides(
        {"range": "3 km", "instrument.laser.power": "5 W", "window": "hann"}
    )
    assert (at["target.range"], at["instrument.laser.power"]) == (3000.0, 5.0)
    assert at["instrument.processing.window"] == "hann"
    assert base.parameters()["target.range"] == 2000.0


def test_a_written_coordinate_is_found_in_the_unit_of_its_axis():
    cut = {"zip": {"target.grazing_angle": ["15 deg", "85 deg"], "target.range": "3.5 km"}}
    study = spec(axes={"cut": cut, "footprint.phases": ["coherent"]})
    assert (
        study.read_coordinate_value("grazing_angle", "15 deg")
        == study.axis_parameter("grazing_angle").display_values[0]
    )
    assert study.read_coordinate_value("range", "3500 m") == 3.5
    assert study.read_coordinate_value("phases", "coherent") == "coherent"
    with pytest.raises(KeyError):
        study.read_coordinate_value("power", "1 W")
