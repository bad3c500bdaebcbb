import time
from fractions import Fraction

import numpy as np
import pytest
from base_spec import axis_member_content, changed_spec
from hypothesis import given
from hypothesis import strategies as st

from sweep.analysis.tables import noise_false_alarm_reference
from sweep.model.threshold import DESIGN_PFA_SHOT_PATH, TNR_PATH, tnr_from_parameters
from sweep.spec import GridSpec, SpecError
from sweep.tasks.studies.grid_study import GridStudy


def axes_of(**kinds):
    return GridSpec.from_mapping(changed_spec(axes=kinds)).axes


def member(path, values):
    return GridSpec.from_mapping(changed_spec(axes={path: values})).axes[0].parameters[0]


def test_a_list_keeps_the_users_unit_next_to_si():
    power = member("instrument.laser.power", ["1 W", "3000 mW", "5 W"])
    assert (power.coordinate_name, power.units) == ("power", "W")
    assert power.values.tolist() == power.display_values.tolist() == [1.0, 3.0, 5.0]


def test_display_values_are_in_the_unit_of_the_first_value():
    angle = member("target.grazing_angle", ["15 deg", "0.5 rad", "90 deg"])
    assert angle.units == "deg"
    assert angle.display_values[[0, 2]].tolist() == [15.0, 90.0]
    assert angle.display_values[1] == pytest.approx(np.degrees(0.5), rel=1e-15)
    assert angle.values[1] == 0.5


def test_units_have_one_plain_spelling():
    path = "instrument.receiver.noise_equivalent_power"
    for spelling in ("5 pW/rtHz", "5 pW/√Hz", "5 pW/sqrt(Hz)", "5 pW/Hz^0.5"):
        assert member(path, [spelling]).units == "pW/Hz^0.5"
    assert member("target.grazing_angle", ["15°"]).units == "deg"
    assert member("instrument.laser.beam_divergence", ["50 µrad"]).units == "urad"


def test_decibels_are_shown_as_such_and_spaced_as_such():
    figure = member("instrument.receiver.noise_figure", {"linear": ["0 dB", "20 dB"], "number": 3})
    assert figure.units == "dB"
    assert figure.display_values.tolist() == [0.0, 10.0, 20.0]
    assert figure.values.tolist() == [1.0, 10.0, 100.0]


def test_temperatures_step_in_celsius():
    step = {"step": ["-10 degC", "20 degC", "10 degC"]}
    temperature = member("instrument.receiver.temperature", step)
    assert temperature.values.tolist() == [263.15, 273.15, 283.15, 293.15]
    assert temperature.display_values.tolist() == [-10.0, 0.0, 10.0, 20.0]


@given(
    st.integers(1, 200), st.integers(1, 50), st.integers(1, 60),
    st.sampled_from(["mm", "m", "um", "ft"]), st.sampled_from([1, 10, 1000]),
)  # fmt: skip
def test_a_step_gives_the_floats_of_its_values_written_out(start, step, number, unit, parts):
    def text(value):
        return f"{value}e-{len(str(parts)) - 1} {unit}"

    numbers = [start + step * i for i in range(number)]
    generated = member("target.range", {"step": [text(start), text(numbers[-1]), text(step)]})
    listed = member("target.range", [text(value) for value in numbers])
    assert axis_member_content(generated) == axis_member_content(listed)
    assert generated.display_values.tolist() == [float(Fraction(value, parts)) for value in numbers]


def test_degrees_stepped_are_the_floats_of_degrees_written_out():
    generated = member("target.grazing_angle", {"step": ["1 deg", "90 deg", "0.1 deg"]})
    listed = member("target.grazing_angle", [f"{i / 10} deg" for i in range(10, 901)])
    assert axis_member_content(generated) == axis_member_content(listed)
    assert len(generated.values) == 891


def test_a_step_ends_on_its_last_value_and_never_past_it():
    assert member("target.range", {"step": ["0.1 m", "1 m", "0.1 m"]}).values[-1] == 1.0
    assert member("target.range", {"step": ["1 m", "10 m", "4 m"]}).values.tolist() == [1, 5, 9]
    assert member("target.range", {"step": ["9 m", "1 m", "-4 m"]}).values.tolist() == [9, 5, 1]


def test_linear_values_are_evenly_spaced_with_exact_ends():
    values = member("target.range", {"linear": ["1 m", "10 km"], "number": 10000}).values
    assert values.tolist() == np.arange(1.0, 10001.0).tolist()


def test_ends_of_a_generator_may_differ_in_unit():
    mixed = member("target.range", {"linear": ["1 m", "10 km"], "number": 4})
    member_values = member("target.range", {"linear": ["1 m", "10000 m"], "number": 4})
    assert axis_member_content(mixed) == axis_member_content(member_values)


def test_log_values_have_one_ratio_and_exact_ends_in_whatever_unit():
    metres = member("target.range", {"log": ["3 m", "10 km"], "number": 50})
    millimetres = member("target.range", {"log": ["3000 mm", "10000000 mm"], "number": 50})
    ratios = metres.values[1:] / metres.values[:-1]
    assert np.ptp(ratios) < 1e-13
    assert metres.values[[0, -1]].tolist() == [3.0, 10000.0]
    assert metres.values.tolist() == millimetres.values.tolist()
    assert millimetres.display_values[[0, -1]].tolist() == [3000.0, 1e7]


def test_decades_come_out_clean():
    decades = member("target.range", {"log": ["1 mm", "1 km"], "number": 7})
    assert decades.values.tolist() == [0.001, 0.01, 0.1, 1.0, 10.0, 100.0, 1000.0]
    assert decades.display_values.tolist() == [1.0, 10.0, 100.0, 1e3, 1e4, 1e5, 1e6]


def test_whole_fields_take_whole_values_only_and_stay_whole():
    for written_values in (["2^16", "2^17", "2^18"], {"log": ["2^16", "2^18"], "number": 3},
                           [65536, 131072.0, "262144"]):  # fmt: skip
        sizes = member("instrument.processing.fft_size", written_values)
        assert sizes.values.dtype == np.int64
        assert sizes.values.tolist() == sizes.display_values.tolist() == [65536, 131072, 262144]
        assert sizes.units == ""


def test_a_list_may_hold_generators():
    values = member("target.range", ["1 m", {"step": ["5 m", "7 m", "1 m"]}, "1 km"]).values
    assert values.tolist() == [1.0, 5.0, 6.0, 7.0, 1000.0]


def test_words_make_an_axis():
    window = member("instrument.processing.window", ["hann", "kaiser( 8.6 )"])
    assert window.values == ("hann", "kaiser(8.6)")
    assert window.display_values.tolist() == ["hann", "kaiser(8.6)"]
    assert window.units == ""


def test_zipped_pieces_are_laid_end_to_end_with_single_values_repeated():
    (cut,) = axes_of(
        cut={
            "zip": [
                {"target.range": {"step": ["5 m", "7 m", "1 m"]}, "target.grazing_angle": "15 deg"},
                {"target.range": "3.5 km", "target.grazing_angle": ["1 deg", "2 deg"]},
                {"target.range": "9 m", "target.grazing_angle": "90 deg"},
            ]
        }
    )
    assert (cut.name, cut.size, cut.is_zipped) == ("cut", 6, True)
    distance, angle = cut.parameters
    assert (distance.coordinate_name, distance.units) == ("range", "m")
    assert distance.values.tolist() == [5.0, 6.0, 7.0, 3500.0, 3500.0, 9.0]
    assert angle.display_values.tolist() == [15.0, 15.0, 15.0, 1.0, 2.0, 90.0]


def test_a_zipped_axis_may_hold_words_and_repeat_points():
    (pair,) = axes_of(
        pair={"zip": {"instrument.processing.window": ["hann", "hann", "hamming"],
                      "footprint.phases": "coherent", "target.range": "1 m"}}
    )  # fmt: skip
    assert pair.parameters[0].values == ("hann", "hann", "hamming")
    assert pair.parameters[1].values == ("coherent",) * 3
    assert pair.parameters[2].values.tolist() == [1.0, 1.0, 1.0]


def test_axes_keep_the_order_of_the_file_and_their_plain_names():
    axes = axes_of(**{"target.range": ["1 m"], "instrument.processing.tnr": [1, 5]})
    assert [(axis.name, axis.size) for axis in axes] == [("range", 1), ("tnr", 2)]
    assert not axes[0].is_zipped


def test_a_field_on_an_axis_need_not_be_written_twice():
    spec = GridSpec.from_mapping(
        changed_spec({"target.range": ...}, axes={"target.range": {"step": ["5 m", "9 m", "1 m"]}})
    )
    assert spec.parameters()["target.range"] == 5.0


def test_arrays_of_an_axis_are_read_only():
    with pytest.raises(ValueError, match="read-only"):
        member("target.range", ["1 m", "2 m"]).values[0] = 3.0


@pytest.mark.parametrize(
    "values",
    [
        {"step": ["1 mm", "10 km", "1 mm"]},
        pytest.param({"log": ["1 m", "10 km"], "number": 10**7}, marks=pytest.mark.slow),
    ],
)
def test_ten_million_values_take_seconds(values):
    start = time.perf_counter()
    spec = GridSpec.from_mapping(changed_spec(axes={"target.range": values}))
    assert (spec.axes[0].size, len(spec.id)) == (10**7, 32)
    assert time.perf_counter() - start < 30.0  # one by one in Python it would be minutes
    assert len(spec.to_json()) < 5000


def test_a_threshold_is_set_in_one_way_on_an_axis_or_off():
    axes = {DESIGN_PFA_SHOT_PATH: {"log": [1e-9, 1e-3], "number": 3}}
    spec = GridSpec.from_mapping(
        changed_spec({TNR_PATH: ..., DESIGN_PFA_SHOT_PATH: 1e-6}, axes=axes)
    )
    assert spec.parameters()[DESIGN_PFA_SHOT_PATH] == 1e-9 and TNR_PATH not in spec.parameters()
    assert GridSpec.from_mapping(spec.to_yaml_mapping()).id == spec.id
    outputs = GridStudy(spec).evaluate(0)
    # all but the few bins that the target takes
    assert outputs["pfa_shot"].ravel() == pytest.approx([1e-9, 1e-6, 1e-3], rel=5e-3)
    at = spec.parameters_with_overrides({"tnr": 10})
    assert at[TNR_PATH] == 10 and DESIGN_PFA_SHOT_PATH not in at
    first = tnr_from_parameters(spec.parameters() | {DESIGN_PFA_SHOT_PATH: 1e-9})
    assert noise_false_alarm_reference(spec, {})[0]["tnr"] == pytest.approx(float(first))
    with pytest.raises(SpecError, match=r"has no threshold; write 'tnr: 10', or threshold_to_mean"):
        GridSpec.from_mapping(changed_spec({TNR_PATH: ...}))
    with pytest.raises(SpecError, match=r"by tnr and by design_pfa_shot; keep one of them"):
        GridSpec.from_mapping(changed_spec({DESIGN_PFA_SHOT_PATH: 1e-6}, axes={TNR_PATH: [5, 10]}))


def test_a_field_and_its_axis_must_agree_and_a_store_keeps_the_axis_alone():
    """Whether typed in a file or given as a mapping, told with every other mistake."""
    axes = {"target.range": ["1 km", "3 km"]}
    mapping = changed_spec(axes=axes)
    mapping_with_both = {**mapping, "target": {**mapping["target"], "range": "2 km"}}
    with pytest.raises(SpecError, match=r"range: is on the axis range too.*\(you wrote '2 km'\)"):
        GridSpec.from_mapping(mapping_with_both)
    with pytest.raises(SpecError) as refusal:
        GridSpec.from_mapping({**mapping_with_both, "seed": -1})
    assert {mistake.path for mistake in refusal.value.mistakes} == {"target.range", "seed"}
    agreeing = {**mapping, "target": {**mapping["target"], "range": "3000 m"}}
    assert GridSpec.from_mapping(agreeing).to_json() == GridSpec.from_mapping(mapping).to_json()
    assert "range" not in GridSpec.from_mapping(agreeing).to_yaml_mapping()["target"]


def test_no_coordinate_bears_the_name_of_a_variable(tmp_path):
    beamlets = member("footprint.beamlets", [19, 37])
    assert beamlets.coordinate_name == "footprint_beamlets"
    pieces = [{"target.range": f"{r} km", "target.grazing_angle": "45 deg"} for r in (1, 2)]
    for name in ("pd_shot", "range_error", "effects", "n_draws", "range_bias"):
        with pytest.raises(SpecError, match=f"axes.{name}: has the name of a variable"):
            GridSpec.from_mapping(changed_spec(axes={name: {"zip": pieces}}))
