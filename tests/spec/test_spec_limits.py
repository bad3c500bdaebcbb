import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from written_specs import written

from sweep.spec import Spec, SpecError

DURATION = "instrument.chirp.duration"
DELAY = "instrument.processing.acquisition_delay"
RATE = "instrument.processing.sample_rate"
RANGE = "target.range"
LIGHT = 299_792_458.0


def values_of_zip(written):
    return written["zip"] if isinstance(written, dict) else ()


def refused(changes=None, **sections):
    try:
        Spec.from_mapping(written(changes, **sections))
    except SpecError as error:
        (mistake,) = error.mistakes
        axes = sections.get("axes", {})
        on = [key for key, values in axes.items() if DURATION in (key, *values_of_zip(values))]
        assert mistake.path == (f"axes.{on[0]}" if on else DURATION)
        return str(mistake)
    return ""


def test_a_chirp_shorter_than_the_echos_delay_is_refused():
    assert not refused({RANGE: "74.9 km"})
    assert "echo's delay 2R/c" in refused({RANGE: "75 km"})
    assert "falls short" in refused({RANGE: "60 km", DELAY: "100 us"})


def test_a_record_of_fewer_than_two_samples_is_refused():
    assert "2 samples" in refused({RATE: "3 kHz"})
    assert not refused({RATE: "4 kHz"})
    assert "2 samples" in refused({RATE: "4 kHz", DELAY: "1 us"})


def test_a_responsivity_of_more_than_one_electron_a_photon_is_refused():
    """q lambda / (h c) is 0.8065544 A/W a micrometre: 1.2501593 A/W at 1550 nm."""
    path, wavelength = "instrument.receiver.responsivity", "instrument.laser.wavelength"
    Spec.from_mapping(written({path: "1.25015 A/W"}))
    Spec.from_mapping(written(axes={wavelength: ["1.5 um", "2 um"]}))
    for changes, axes, place, over in (
        ({path: "1.25017 A/W"}, {}, path, "1.07e-05 A/W"),
        ({}, {wavelength: ["1 um", "2 um"]}, path, "0.293 A/W"),
        ({}, {path: ["1 A/W", "2 A/W"]}, f"axes.{path}", "0.75 A/W"),
    ):
        with pytest.raises(SpecError) as caught:
            Spec.from_mapping(written(changes, axes=axes))
        (mistake,) = caught.value.mistakes
        assert mistake.path == place
        assert over in mistake.rule and "apd_gain" in mistake.suggestion


def test_extremes_of_plain_axes_are_combined():
    assert not refused(axes={RANGE: ["1 km", "60 km"], DURATION: ["420 us", "500 us"]})
    assert refused(axes={RANGE: ["1 km", "60 km"], DURATION: ["390 us", "500 us"]})


def test_a_chirp_that_stands_on_an_axis_alone_is_held_to_the_same_rules():
    mapping = {DURATION: ..., RANGE: "60 km"}
    assert not refused(mapping, axes={DURATION: ["401 us", "500 us"]})
    assert "echo's delay 2R/c" in refused(mapping, axes={DURATION: ["400 us", "500 us"]})


def test_zipped_values_are_combined_only_as_they_occur():
    good = {"zip": {RANGE: ["1 km", "60 km"], DURATION: ["10 us", "500 us"]}}
    bad = {"zip": {RANGE: ["60 km", "1 km"], DURATION: ["10 us", "500 us"]}}
    assert not refused(axes={"pair": good})
    assert refused(axes={"pair": bad})
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
    bad = any(
        (t - (delay - 1)) * 1e-6 - 2 * 50 * distance / LIGHT <= 0
        or np.floor((t - (delay - 1)) * 1e-6 * 40e3 * rate + 1e-6) < 2
        for (t, rate), (delay, distance) in itertools.product(list(first), list(second))
    )
    assert bool(refused(axes=axes)) == bad


def test_a_point_asked_for_later_is_held_to_the_same_rules():
    spec = Spec.from_mapping(written())
    with pytest.raises(SpecError, match="echo's delay"):
        spec.parameters_at({"range": "80 km"})
    with pytest.raises(SpecError) as caught:
        spec.parameters_at({"rnge": "2 km", "power": 3})
    assert "did you mean 'target.range'?" in str(caught.value)
    assert "needs a unit (you wrote 3)" in str(caught.value)


def test_a_grid_beyond_counting_is_refused():
    steps = {"linear": ["1 m", "10 km"], "number": 10**6}
    axes = {
        RANGE: steps,
        "target.radial_velocity": {"linear": ["1 m/s", "9 m/s"], "number": 10**6},
        "instrument.laser.power": {"linear": ["1 W", "9 W"], "number": 10**4},
    }
    with pytest.raises(SpecError, match="a study has at most 1e"):
        Spec.from_mapping(written(axes=axes))
