"""What physics promises of any study at all: monotonic, symmetric, the same in other words.

Effects are simulated wherever they change anything (tolerance 0), so that no two points of a study
differ by what was left out.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from base_study import INSTRUMENT
from hypothesis import HealthCheck, Phase, assume, given, reject, settings
from hypothesis import strategies as st
from study_strategies import remove_field, studies, without_rejected_parts

from sweep.model.effects.catalogue import EFFECTS
from sweep.model.threshold import THRESHOLD_PATHS, TNR_PATH
from sweep.scenes.eyepoint_arrays import eyepoints_from_arrays
from sweep.spec import GridSpec, SceneSpec, SpecError, from_stored
from sweep.tasks.studies.flight_study import FlightStudy
from sweep.tasks.studies.grid_study import GridStudy

PROPERTY_TEST_SETTINGS = settings(
    derandomize=True, deadline=None, database=None, suppress_health_check=list(HealthCheck),
    phases=[Phase.generate], max_examples=8,
)  # fmt: skip

SIGNAL = ("snr_up", "snr_down", "snr_doppler", "pd_up", "pd_down", "pd_doppler", "pd_shot")
ROUNDING = 1e-9
"""Relative error of closed-form sums over some ten lines, 1e-13 seen, and of probabilities."""
SHOT_ROUNDING = 1e-6
"""Relative error of pd_shot in shared speckle."""
SHOT_LEAST = 1e-14
"""Value of pd_shot below which nothing is told of its relative error; 1e-2 was seen at 2e-16."""

RANDOM = tuple(p.path for effect in EFFECTS if effect.is_random for p in effect.parameters)
CLIPPING = ("instrument.processing.full_scale", "instrument.processing.bits")
MOVING = (
    "target.radial_velocity", "target.transverse_velocity", "target.acceleration",
    "instrument.chirp.quadratic_error", "instrument.chirp.cubic_error",
    "instrument.chirp.sinusoidal_error", "instrument.chirp.error_table",
    "instrument.chirp.down_slope", "instrument.chirp.doppler_slope",
    "instrument.processing.search",
)  # fmt: skip
MASKING = "instrument.telescope.leak_path"
"""Its line masks bins by the threshold, and grows with the light: more of either may hide more."""
PEAKS = "instrument.processing.peaks"
"""The strongest peak alone may be one of leaked signal, which grows with the light."""


def steady(mapping, *paths):
    """The study of one point, without draws, with all effects that it has, and without paths."""
    for section in ("axes", "draws", "effects", "accuracy"):
        mapping.pop(section, None)
    mapping["accuracy"] = {"tolerance": 0}
    mapping["storage"] = {"block_points": 1000}
    for path in (*RANDOM, MASKING, PEAKS, *paths):
        remove_field(mapping, path)
    return without_rejected_parts(mapping)


def spec_of(mapping):
    """The study; those that are refused are passed over."""
    try:
        return GridSpec.from_mapping(mapping)
    except SpecError:
        assume(False)


def results_of(mapping):
    """Results of a study of one block."""
    results = GridStudy(spec_of(mapping)).evaluate(0)
    assume(not np.isnan(results["pd_shot"]).any())  # what is beyond the model
    return results


def falls(values, rounding=ROUNDING):
    """Tell whether values fall anywhere by more than rounding."""
    low, high = values[:-1], values[1:]
    return bool((high < low * (1 - rounding) - 1e-300).any())


def rounded(name, values):
    """Values of a variable as far as they are known, and their relative error."""
    if name == "pd_shot":
        return np.maximum(values, SHOT_LEAST), SHOT_ROUNDING
    return values, ROUNDING


@pytest.mark.parametrize(
    ("path", "factors"),
    [
        ("instrument.laser.power", (0.1, 1, 1.5, 40)),
        ("instrument.telescope.aperture", (0.3, 1, 1.2, 5)),
        ("target.reflectance", (0.01, 0.4, 0.41, 1)),
    ],
)
@settings(PROPERTY_TEST_SETTINGS)
@given(mapping=studies())
def test_more_light_is_never_worse(path, factors, mapping):
    """SNR and pd of a segment rise with the echo E: SNR goes as E / (a + b E), as E^2 / (a + b E)
    of direct detection, where light that is noise (echo, sun, air) grows with the aperture or the
    power at the most as the echo does; and the threshold over the noise does not rise. Clipping
    breaks it, which so is left out; and so does a focus, which a smaller aperture moves nearer to a
    target beyond it. A waist is left out of the aperture's case: near the telescope the rim's
    diffraction adds to some apertures' echo, and the table of truncated beams errs by up to 1e-4
    (4e-7 about 1 where 3.7 waists fit in: SNR falls by as much as the aperture grows by a fifth).
    """
    mapping = steady(mapping, *CLIPPING)
    mapping["instrument"]["laser"].pop("focus", None)
    if "aperture" in path:
        remove_field(mapping, "instrument.laser.beam_waist")
    base = spec_of(mapping).parameters()[path] if path != "target.reflectance" else 1
    unit = {"power": " W", "aperture": " m"}.get(path.rsplit(".", 1)[-1], "")
    results = results_of(mapping | {"axes": {path: [f"{base * f!r}{unit}" for f in factors]}})
    for name in SIGNAL:
        assert not falls(*rounded(name, results[name])), (name, results[name])


@settings(PROPERTY_TEST_SETTINGS)
@given(mapping=studies())
def test_a_higher_threshold_detects_less_and_alarms_less(mapping):
    mapping = steady(mapping)
    for way in THRESHOLD_PATHS:  # that of the axis alone is left
        remove_field(mapping, way)
    axes = {TNR_PATH: [0.01, 1, 5, 5.1, 30]}
    results = results_of(mapping | {"axes": axes})
    for name in ("pd_up", "pd_down", "pd_doppler", "pd_shot", "pfa_bin", "log10_pfa_bin"):
        values = results[name][::-1]
        values = values - values.min() if name.startswith("log10") else values
        assert not falls(*rounded(name, values)), name


@settings(PROPERTY_TEST_SETTINGS)
@given(mapping=studies())
def test_without_movement_up_and_down_chirp_are_alike(mapping):
    """Their beats then are range beats of either sign. Phases differ by the carriers, so that it
    holds where these play no part: beamlets that add as powers, which those of direct detection
    do not, and no images. At DC there is no echo without its image: a bin off it at the least."""
    mapping = steady(mapping, *MOVING)
    mapping["effects"] = {"image": "off"}
    mapping["footprint"]["phases"] = "incoherent"
    assume(mapping["instrument"]["receiver"].get("architecture") != "direct")
    parameters = spec_of(mapping).parameters()
    assume(parameters["target.range"] * parameters["instrument.chirp.bandwidth"] >= 299792458 / 2)
    results = results_of(mapping)
    for name in ("snr", "pd", "miss", "p_leakage"):
        up, down = results[f"{name}_up"], results[f"{name}_down"]
        # Bins at the threshold, or half way to another, may count in one and not in the other.
        least = 1e-9 if name == "p_leakage" else 1e-12
        assert np.allclose(up, down, rtol=1e-6, atol=least), name
    error = results["radial_velocity_error"]
    assert np.isnan(error) or abs(error) < 1e-9  # rounding, where three beats are fitted


@settings(PROPERTY_TEST_SETTINGS)
@given(mapping=studies())
def test_the_same_values_in_other_units_are_the_same_study_bit_for_bit(mapping):
    mapping = without_rejected_parts(mapping)
    try:
        spec = GridSpec.from_mapping(mapping)
    except SpecError:  # mended as far as that is known
        reject()
    restored = from_stored(spec.to_json())
    assert restored.id == spec.id
    results, restored_results = GridStudy(spec).evaluate(0), GridStudy(restored).evaluate(0)
    for name, values in results.items():
        assert np.array_equal(values, restored_results[name], equal_nan=values.dtype.kind == "f"), (
            name
        )


@settings(PROPERTY_TEST_SETTINGS)
@given(mapping=studies(), seed=st.integers(0, 2**63), blocks=st.integers(1, 7))
def test_neither_seed_nor_blocks_change_what_is_not_random(mapping, seed, blocks):
    mapping = without_rejected_parts(mapping)
    mapping.pop("draws", None)
    other = mapping | {"seed": seed, "storage": {"block_points": blocks}}
    results, other_study = (
        results_of(mapping | {"storage": {}}),
        GridStudy(GridSpec.from_mapping(other)),
    )
    block = other_study.grid.block_slices(other_study.n_blocks - 1)
    for name, values in other_study.evaluate(other_study.n_blocks - 1).items():
        assert np.array_equal(values, results[name][block], equal_nan=values.dtype.kind == "f"), (
            name
        )


def turned(x, y, z, *, turn, shift):
    """A place after a turn about z and a shift, as written."""
    c, s = math.cos(turn), math.sin(turn)
    moved = np.array([c * x - s * y, s * x + c * y, z]) + shift
    return [f"{value!r} m" for value in moved.tolist()]


def flight_in(instrument, turn, shift):
    """A descent over a slope with a box and a ball on it, in a frame that is turned and shifted."""
    place = {"turn": turn, "shift": np.asarray(shift, float)}
    heading = f"{turn!r} rad"
    slope = {"kind": "plane", "size": "9 km", "slope": "7 deg", "uphill": heading}
    return {
        "title": "Frames",
        "instrument": instrument,
        "scene": {
            "objects": {
                "slope": slope | {"reflectance": 0.1, "position": turned(0, 0, 0, **place)},
                "box": {
                    "kind": "box", "size": ["60 m", "90 m", "50 m"], "reflectance": 0.5,
                    "position": turned(100, 20, 20, **place), "rotation": {"heading": heading},
                },
                "ball": {
                    "kind": "sphere", "radius": "40 m", "subdivisions": 2, "reflectance": 0.3,
                    "position": turned(-80, 60, 5, **place), "rotation": {"heading": heading},
                },
            }
        },
        "platform": {
            "path": {
                "kind": "straight", "initial_speed": "80 m/s", "final_speed": "60 m/s",
                "from": turned(-90, 0, 700, **place), "to": turned(130, 50, 500, **place),
            },
            "attitude": {"kind": "nadir", "heading": heading},
        },
        "scanners": {"cone": {"kind": "cone", "beams": 5, "half_angle": "9 deg", "rate": "5 Hz"}},
        "footprint": {"beamlets": 7, "speckle": "none"},
        "accuracy": {"tolerance": 0},
    }  # fmt: skip


def seen_in(instrument, turn=0.0, shift=(0.0, 0.0, 0.0)):
    """What all shots of that flight see, and its statistics."""
    spec = SceneSpec.from_mapping(flight_in(instrument, turn, shift))
    study = FlightStudy(spec, Path("nowhere.zarr"))
    (eyepoints,) = study.eyepoint_studies()
    numbers = np.arange(eyepoints.n_points)
    cast_eyepoints = eyepoints.cast_cycles(numbers)
    shots, part = (
        eyepoints_from_arrays(cast_eyepoints, eyepoints.beamlet_weights),
        study.scanner_grids["cone"].flight_block(0),
    )
    return cast_eyepoints, study.simulate_shots(
        part, cast_eyepoints, shots, study.select_effects(part, shots, numbers), numbers
    )


@settings(PROPERTY_TEST_SETTINGS, max_examples=6)
@given(
    turn=st.floats(-4, 4).map(lambda x: round(x, 3)),
    shift=st.tuples(*[st.integers(-100_000, 100_000)] * 3),
)
def test_a_flight_is_the_same_in_any_frame(turn, shift):
    """Places of up to 1e5 m are rounded to 1e-11 m, and a beam at 9 deg + 7 deg of incidence, or
    the edge of a facet, makes less than ten times that of it; as much of 1e3 m is 1e-13 rad, and
    of 80 m/s 1e-11 m/s. A range bin is 0.3 m: 1e-10 of a bin is 1e-9 of a bin's magnitude.
    """
    expected, actual = seen_in(INSTRUMENT)
    other, same = seen_in(INSTRUMENT, turn, shift)
    assert np.isfinite(expected["beam_range"]).all()
    assert len(set(expected["beam_surface"].tolist())) > 1, "nothing but the slope is seen"
    assert np.array_equal(expected["beam_surface"], other["beam_surface"])
    assert np.allclose(expected["beam_range"], other["beam_range"], rtol=0, atol=1e-9)
    speed = "beam_radial_velocity"
    assert np.allclose(expected[speed], other[speed], rtol=0, atol=1e-9)
    for name in ("snr_up", "pd_up", "pd_down", "pd_shot", "pfa_up"):
        assert np.allclose(actual[name], same[name], rtol=1e-6, atol=1e-12), name
