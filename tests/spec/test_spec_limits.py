import itertools

import numpy as np
import pytest
from base_spec import changed_spec
from hypothesis import given, settings
from hypothesis import strategies as st

from sweep.spec import GridSpec, SpecError

DURATION = "instrument.chirp.duration"
DELAY = "instrument.processing.acquisition_delay"
RATE = "instrument.processing.sample_rate"
RANGE = "target.range"
LIGHT = 299_792_458.0


def values_of_zip(value):
    return value["zip"] if isinstance(value, dict) else ()


def refused(changes=None, **sections):
    try:
        GridSpec.from_mapping(changed_spec(changes, **sections))
    except SpecError as error:
        (mistake,) = error.mistakes
        axes = sections.get("axes", {})
        field = DELAY if "last until an echo arrives" in str(mistake) else DURATION
        on = [key for key, values in axes.items() if field in (key, *values_of_zip(values))]
        assert mistake.path == (f"axes.{on[0]}" if on else field)
        return str(mistake)
    return ""


OFF = {"overlap": "off"}


def test_a_chirp_shorter_than_the_echos_delay_is_refused():
    assert not refused({RANGE: "74.9 km"}, effects=OFF)
    assert "echo's delay 2R/c" in refused({RANGE: "75 km"}, effects=OFF)
    assert "falls short by 3.46143e-07 s" in refused({RANGE: "75 km"})


def test_a_record_that_ends_before_its_echo_arrives_is_refused():
    """2^17 samples at 600 MHz are 218.45 us, 32.745 km, from the acquisition delay on."""
    assert not refused({RANGE: "32.7 km"})
    message = refused({RANGE: "32.8 km"})
    assert "end 3.64713e-07 s or more before the echo's delay" in message
    assert not refused({RANGE: "60 km", DELAY: "300 us"})
    assert "raise it to the delay" in refused({RANGE: "60 km", DELAY: "100 us"})


def test_an_echo_that_arrives_within_its_record_is_not_refused():
    """At 300 m it takes 2.001 us: 1.9 us of a record from 2 us to 3.9 us remain."""
    short = {RANGE: "300 m", DURATION: "3.9 us", DELAY: "2 us"}
    assert not refused(short)
    assert not refused(short | {RANGE: "584 m"})
    assert "falls short" in refused(short | {RANGE: "585 m"})


def test_a_grid_is_simulated_if_any_of_its_points_has_an_echo():
    assert not refused(axes={RANGE: ["1 km", "60 km", "90 km"]})
    assert refused(axes={RANGE: ["60 km", "90 km"]})
    assert not refused(axes={RANGE: ["60 km", "90 km"], DELAY: ["0 us", "300 us"]})


def test_a_record_of_fewer_than_two_samples_is_refused():
    assert "2 samples" in refused({RATE: "3 kHz"})
    assert not refused({RATE: "4 kHz"})
    assert "2 samples" in refused({RATE: "4 kHz", DELAY: "1 us"})


def test_a_responsivity_of_more_than_one_electron_a_photon_is_refused():
    """q lambda / (h c) is 0.8065544 A/W a micrometre: 1.2501593 A/W at 1550 nm."""
    path, wavelength = "instrument.receiver.responsivity", "instrument.laser.wavelength"
    GridSpec.from_mapping(changed_spec({path: "1.25015 A/W"}))
    GridSpec.from_mapping(changed_spec(axes={wavelength: ["1.5 um", "2 um"]}))
    for changes, axes, place, over in (
        ({path: "1.25017 A/W"}, {}, path, "1.07e-05 A/W"),
        ({}, {wavelength: ["1 um", "2 um"]}, path, "0.293 A/W"),
        ({}, {path: ["1 A/W", "2 A/W"]}, f"axes.{path}", "0.75 A/W"),
    ):
        with pytest.raises(SpecError) as error_info:
            GridSpec.from_mapping(changed_spec(changes, axes=axes))
        (mistake,) = error_info.value.mistakes
        assert mistake.path == place
        assert over in mistake.problem and "apd_gain" in mistake.suggestion


def test_extremes_of_plain_axes_are_combined():
    far = {RANGE: ["60 km", "61 km"], DURATION: ["390 us", "500 us"]}
    assert not refused(axes=far, effects=OFF)
    assert refused(axes=far | {DURATION: ["390 us", "400 us"]}, effects=OFF)


def test_a_chirp_that_stands_on_an_axis_alone_is_held_to_the_same_rules():
    mapping = {DURATION: ..., RANGE: "60 km"}
    assert not refused(mapping, axes={DURATION: ["300 us", "401 us"]}, effects=OFF)
    message = refused(mapping, axes={DURATION: ["300 us", "400 us"]}, effects=OFF)
    assert "echo's delay 2R/c" in message


def test_zipped_values_are_combined_only_as_they_occur():
    good = {"zip": {RANGE: ["2 km", "60 km"], DURATION: ["10 us", "500 us"]}}
    bad = {"zip": {RANGE: ["80 km", "2 km"], DURATION: ["500 us", "10 us"]}}
    assert not refused(axes={"pair": good}, effects=OFF)
    assert refused(axes={"pair": bad}, effects=OFF)
    rates = {"zip": {RATE: ["100 kHz", "4 kHz"], DURATION: ["20 us", "500 us"]}}
    assert not refused(axes={"pair": rates})


microseconds = st.lists(st.integers(1, 60), min_size=1, max_size=3, unique=True)


@settings(deadline=None, max_examples=60)
@given(microseconds, microseconds, microseconds, microseconds, st.booleans(), st.booleans())
def test_the_grid_is_refused_just_when_a_point_of_it_is(
    durations, delays, rates, ranges, zip_1, zip_2
):
    if zip_1:  # durations with rates
        rates = (rates * 3)[: len(durations)]
    if zip_2:  # delays with ranges
        ranges = (ranges * 3)[: len(delays)]
    d, a = [f"{v} us" for v in durations], [f"{v - 1} us" for v in delays]
    f, r = [f"{40 * v} kHz" for v in rates], [f"{50 * v} m" for v in ranges]
    axes = {"one": {"zip": {DURATION: d, RATE: f}}} if zip_1 else {DURATION: d, RATE: f}
    axes |= {"two": {"zip": {DELAY: a, RANGE: r}}} if zip_2 else {DELAY: a, RANGE: r}
    first = (
        list(zip(durations, rates, strict=True)) if zip_1 else itertools.product(durations, rates)
    )
    second = list(zip(delays, ranges, strict=True)) if zip_2 else itertools.product(delays, ranges)
    points = list(itertools.product(list(first), list(second)))
    bad = all(t * 1e-6 - 2 * 50 * distance / LIGHT <= 0 for (t, _), (_, distance) in points) or any(
        np.floor((t - (delay - 1)) * 1e-6 * 40e3 * rate + 1e-6) < 2
        for (t, rate), (delay, _) in points
    )
    assert bool(refused(axes=axes)) == bad


def test_a_point_asked_for_later_is_held_to_the_same_rules():
    spec = GridSpec.from_mapping(changed_spec())
    with pytest.raises(SpecError, match="echo's delay"):
        spec.parameters_with_overrides({"range": "80 km"})
    with pytest.raises(SpecError) as error_info:
        spec.parameters_with_overrides({"rnge": "2 km", "power": 3})
    assert "did you mean 'target.range'?" in str(error_info.value)
    assert "needs a unit (you wrote 3)" in str(error_info.value)


def test_a_grid_beyond_counting_is_refused():
    steps = {"linear": ["1 m", "10 km"], "number": 10**6}
    axes = {
        RANGE: steps,
        "target.radial_velocity": {"linear": ["1 m/s", "9 m/s"], "number": 10**6},
        "instrument.laser.power": {"linear": ["1 W", "9 W"], "number": 10**4},
    }
    with pytest.raises(SpecError, match="a study has at most 1e"):
        GridSpec.from_mapping(changed_spec(axes=axes))
