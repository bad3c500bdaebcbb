"""What the fuzz has found, one test each."""

import re

import numpy as np
import pytest
from base_study import base_study_mapping
from click.testing import CliRunner
from corrupted_specs import to_yaml
from fast_plans import fast_planning
from flight_checks import check_flight
from study_checks import check_study, warnings_as_errors

from sweep.cli import main
from sweep.model.effects.noise_sources import SUN_RADIUS, solar_irradiance
from sweep.model.effects.saturation import FULL_SCALE_EXCESS_MAX
from sweep.model.laser_line import LINE_DEVIATION_MAX_WINDOW_BINS, gaussian_frequency_shifts
from sweep.model.unsupported_shot import UnsupportedShotError
from sweep.scenes.eyepoint_arrays import eyepoints_from_arrays
from sweep.scenes.terrain import Terrain, smooth_terrain
from sweep.spec import GridSpec, SceneSpec, SpecError, load
from sweep.tasks.studies.flight_study import FlightStudy
from sweep.tasks.studies.grid_study import GridStudy
from sweep.tasks.studies.study_plan import plan_study


@pytest.fixture(autouse=True)
def quick():
    with fast_planning():
        yield


def judged(tmp_path, mapping):
    """A verdict over a study as written."""
    (tmp_path / "found.yaml").write_text(to_yaml(mapping))
    return check_study(tmp_path / "found.yaml")


def refused(mapping):
    """The words that a study is refused with."""
    with pytest.raises(SpecError) as error_info:
        GridSpec.from_mapping(mapping)
    return str(error_info.value)


def planned(tmp_path, mapping):
    """`sweep plan` over a study."""
    (tmp_path / "found.yaml").write_text(to_yaml(mapping))
    return CliRunner().invoke(main, ["plan", str(tmp_path / "found.yaml")], catch_exceptions=False)


def test_direct_detection_with_draws_is_planned_though_it_knows_no_speckle(tmp_path):
    direct = base_study_mapping({"instrument.receiver.architecture": "direct", "draws.number": 3})
    assert plan_study(GridSpec.from_mapping(direct)).n_points == 1
    assert not judged(tmp_path, direct).refusals
    assert "averages an unknown number" in refused(direct | {"effects": {"speckle": "on"}})


BEYOND = {
    "line": {"instrument.laser.line_width": "1 THz"},
    "clipped": {"instrument.processing.full_scale": "1e-15 V"},
}


@pytest.mark.parametrize("name", BEYOND)
def test_a_shot_beyond_the_model_is_refused_with_field_limit_value_and_remedy(name, tmp_path):
    result = planned(tmp_path, base_study_mapping(BEYOND[name]))
    assert result.exit_code == 2 and result.stdout == ""
    assert re.search(r"(instrument|target)\.\w+", result.stderr)
    assert "can be simulated: " in result.stderr and re.search(r"\d", result.stderr)


def test_the_limits_of_the_model_are_where_they_are_said_to_be():
    width = np.array(
        [LINE_DEVIATION_MAX_WINDOW_BINS / 0.4246609 * 0.99]
    )  # of a record of 1 s, a bin is 1 Hz
    assert gaussian_frequency_shifts(fwhm=width, duration=np.ones(1)).weight.sum() == pytest.approx(
        1
    )
    with pytest.raises(UnsupportedShotError, match="line_width"):
        gaussian_frequency_shifts(fwhm=width * 1.02, duration=np.ones(1))
    assert FULL_SCALE_EXCESS_MAX**2 < 1e15  # what is left of 16 digits by variances that cancel


def test_nothing_that_comes_back_has_no_range_error_with_draws_or_without(tmp_path):
    for draws in ({}, {"draws.number": 3}, {"draws.number": 3, "target.roughness": "1 mm"}):
        dark = base_study_mapping({"target.reflectance": 0} | draws)
        results = GridStudy(GridSpec.from_mapping(dark)).evaluate(0)
        assert np.isnan(results["range_error"]) and np.isnan(results["radial_velocity_error"])
        assert not judged(tmp_path, dark).refusals


def test_sunlight_of_the_far_ultraviolet_fades_to_nothing_in_silence():
    with warnings_as_errors():
        light = solar_irradiance(
            wavelength=[1e-9, 30e-9, 500e-9], distance=1.496e11, elevation=1.57
        )
    assert light[0] == 0 and 0 < light[1] < 1e-3 * light[2]
    # Wien's limit, where e^u exceeds what 1 could matter to: u = 16.6 at 150 nm.
    wien = solar_irradiance(wavelength=[150e-9, 151e-9], distance=1.496e11, elevation=1.57)
    u = 6.62607015e-34 * 299792458 / (1.380649e-23 * 5772.0) / np.array([150e-9, 151e-9])
    ratio = (151 / 150) ** 5 * np.exp(u[1] - u[0])
    assert wien[0] / wien[1] == pytest.approx(ratio, rel=1e-6)


def test_nobody_can_be_inside_the_sun():
    near = f"{0.99 * SUN_RADIUS} m"
    assert "target.sun_distance: must be 0" in refused(
        base_study_mapping({"target.sun_distance": near})
    )
    GridSpec.from_mapping(base_study_mapping({"target.sun_distance": f"{1.01 * SUN_RADIUS} m"}))


@pytest.mark.parametrize("text", ["1e400 m", "-1e9999 W", "9e300 m"])
def test_a_pure_number_with_a_unit_is_refused_however_large(text):
    words = refused(base_study_mapping({"instrument.processing.tnr": text}))
    assert "is a pure number and takes no unit" in words


@pytest.mark.parametrize("unit", ["m*", "m/", "m//", "*m", "m*/s", "m * ", "W/m^2/nm/", "/"])
def test_an_operator_without_a_unit_to_it_is_no_unit(unit):
    field = "target.solar_irradiance" if "W" in unit else "target.range"
    assert f"{field}: " in refused(base_study_mapping({field: f"5 {unit}"}))


def test_a_window_that_scipy_warns_of_or_can_not_make_is_refused():
    for window in ("chebwin(30)", "kaiser_bessel_derived(4)"):
        assert "instrument.processing.window" in refused(
            base_study_mapping({"instrument.processing.window": window})
        )
    with warnings_as_errors():
        GridSpec.from_mapping(base_study_mapping({"instrument.processing.window": "chebwin(60)"}))


EXTREME = {
    "all light lost in one bin": {
        "instrument.receiver.detector_bandwidth": "1 mHz", "target.transverse_velocity": "1e6 m/s",
        "instrument.processing.fft_size": 6,
    },
    "a spread of 1e160 bins": {
        "instrument.laser.beam_divergence": "90 deg", "target.grazing_angle": "1e-6 deg",
        "instrument.laser.wavelength": "1 nm", "target.transverse_velocity": "1000 km/s",
    },
    "no gain at all": {"instrument.receiver.transimpedance": "1 uohm",
                       "instrument.laser.power": "1e-18 W"},
    "shot noise that drowns the threshold, over nearly no other": {
        "instrument.laser.power": "1 kW", "instrument.laser.beam_divergence": "170 arcmin",
        "instrument.telescope.aperture": "1 um", "instrument.processing.tnr": 7600,
        "instrument.receiver.amplifier_bandwidth": "1 mHz", "instrument.processing.fft_size": 23,
        "instrument.receiver.detector_bandwidth": "565 kHz", "footprint.beamlets": 109,
        "target.grazing_angle": "6e-5 arcmin", "target.pointing_jitter": "75.1 arcsec",
        "target.reflectance": 1.0, "draws.limit": 40,
    },
    "a window with all weight on one of its two samples": {
        "instrument.processing.fft_size": 2, "instrument.processing.tnr": 10,
        "footprint.speckle": "developed", "target.grazing_angle": "15 deg",
        "instrument.laser.wavelength": "15 um", "instrument.laser.beam_divergence": "50 urad",
        "instrument.laser.focus": "4 m", "instrument.receiver.optical_passband": "2.5 um",
        "instrument.chirp.bandwidth": "100 GHz",
    },
    "whole spectra of nothing": {
        "draws.method": "spectra", "draws.number": 3, "target.reflectance": 0.0,
    },
    "whole spectra of nothing, directly detected": {
        "draws.method": "spectra", "draws.number": 3, "target.reflectance": 0.0,
        "instrument.receiver.architecture": "direct",
    },
}  # fmt: skip
"""Ends of the fields' bounds at which bounds on effects overflowed or divided by nothing."""


@pytest.mark.parametrize("name", EXTREME)
def test_the_ends_of_the_bounds_are_computed_without_a_warning(name, tmp_path):
    is_beyond_limit = name == "a spread of 1e160 bins"
    assert planned(tmp_path, base_study_mapping(EXTREME[name])).exit_code == 2 * is_beyond_limit
    assert bool(judged(tmp_path, base_study_mapping(EXTREME[name])).refusals) == is_beyond_limit


def test_boulders_lie_within_their_square_on_a_ground_of_one_cell():
    from sweep.spec.fields import SpecFiles

    rocks = {
        "kind": "boulders", "on": "ground", "law": {"kind": "power", "density": "0.1 m^-2",
        "exponent": 2}, "smallest": "1 m", "largest": "3 m", "within": "60 m",
        "centre": ["500 m", "-300 m"], "reflectance": 0.2,
    }  # fmt: skip
    thing = SceneSpec.model_fields["scene"].annotation.model_validate(
        {"objects": {"ground": {"kind": "plane", "size": "4 km", "reflectance": 0.1},
                     "rocks": rocks}}
    ).objects  # fmt: skip
    facets = thing["rocks"].build_facets(thing["ground"].build_terrain(SpecFiles(".")))
    corners = facets.vertices + facets.origin
    corners = corners.reshape(len(facets.faces) // 96, -1, 3)  # 96 faces each
    middles = corners.mean(axis=1)
    # 0.1 (1 - 1/9) 60^2 = 320 of them, 5 sigma to each side; each reaches 2 m beyond its middle.
    assert abs(len(middles) - 320) < 5 * 320**0.5
    assert (np.abs(middles[:, :2] - [500, -300]) < 30.5).all()
    assert np.ptp(middles[:, :2], axis=0).min() > 55


def test_boulders_next_to_the_ground_are_refused():
    from sweep.scenes.terrain import clipped_square_bounds
    from sweep.spec.fields import SpecFiles
    from sweep.spec.ground_sections import PlaneGround

    ground = PlaneGround(kind="plane", size="100 m", reflectance=0.1).build_terrain(SpecFiles("."))
    assert clipped_square_bounds(ground, centre=(45.0, 0.0), size=20.0) == (35.0, -10.0, 50.0, 10.0)
    with pytest.raises(ValueError, match="there is no ground within 10 m"):
        clipped_square_bounds(ground, centre=(90.0, 0.0), size=20.0)


def test_a_ground_is_not_blurred_by_more_than_its_own_size():
    """The filter's memory goes by its width: 1e9 m over steps of 6 m took all that there was."""
    ground = Terrain(np.arange(12.0).reshape(3, 4), (10.0, 10.0), np.zeros(3))
    assert np.ptp(smooth_terrain(ground, standard_deviation=30.0).heights) < np.ptp(ground.heights)
    for width in (31.0, 1e9):
        with pytest.raises(ValueError, match="the ground's 30 m"):
            smooth_terrain(ground, standard_deviation=width)


def test_a_plan_measures_once_however_late_it_is(monkeypatch):
    """As of a process that is held up between two looks at the clock."""
    monkeypatch.setattr("sweep.tasks.studies.study_plan.GRID_TIMING_SECONDS", 0.0)
    plan = plan_study(GridSpec.from_mapping(base_study_mapping({})))
    assert np.isfinite(plan.wall_seconds) and plan.wall_seconds > 0


@pytest.mark.parametrize("window", ["hann", "rectangular", "tukey(0.6)"])
@pytest.mark.parametrize("width", ["1e-290 Hz", "1e-200 Hz", "1e-100 Hz", "1e-40 Hz"])
def test_lines_that_lie_next_to_nothing_off_a_bin_are_on_it(window, width):
    """Kernels beside a bin divided by their distance from it, and by its square.

    A target at rest has its Doppler line on bin 0, and shifts of a narrow Gaussian line about it.
    """
    with_width, without = (
        GridStudy(
            GridSpec.from_mapping(base_study_mapping(instrument_with(window) | mapping))
        ).evaluate(0)
        for mapping in (
            {"instrument.laser.line_width": width, "effects": {"line_width": "on"}},
            {"effects": {"line_width": "off"}},
        )
    )
    for name in ("snr_up", "snr_doppler", "snr_down"):
        assert with_width[name] == pytest.approx(without[name], rel=1e-9), name


def instrument_with(window):
    """A plain study's, at rest, with a window, its lines as exact as they can be."""
    return {
        "instrument.processing.window": window, "target.radial_velocity": "0 m/s",
        "accuracy.line_error": 1e-9,
    }  # fmt: skip


LATE = {"instrument.processing.acquisition_delay": "2 us"}  # 6.8 us of record, an echo at 13.3 us
ELSEWHERE = {
    f"instrument.processing.search.{name}": value
    for name, value in {
        "min_range": "100 m", "max_range": "400 m",
        "min_radial_velocity": "-1 m/s", "max_radial_velocity": "1 m/s",
    }.items()
}  # fmt: skip
FOUR_LOOKS = {"instrument.looks.number": 4, "instrument.processing.detection": "peak_bin"}
WITHOUT_GROUP = {
    "late": LATE,
    "late peak bin": LATE | {"instrument.processing.detection": "peak_bin"},
    "late looks": LATE | FOUR_LOOKS,
    "late complex": LATE | FOUR_LOOKS | {"instrument.receiver.record": "complex"},
    "late smooth": LATE | {"footprint.speckle": "none"},
    "late direct": LATE | {"instrument.receiver.architecture": "direct"},
    "late line": LATE | {"instrument.laser.line_width": "100 kHz"},
    "elsewhere": ELSEWHERE,
    "elsewhere in looks": ELSEWHERE | FOUR_LOOKS,
    "elsewhere complex": ELSEWHERE | {"instrument.receiver.record": "complex"},
    "elsewhere smooth": ELSEWHERE | {"footprint.speckle": "none"},
}


def flight_mapping(changes):
    """A flight of two shots at 2 km over a plain, by the instrument of the plain study."""
    mapping = base_study_mapping(changes)
    mapping.pop("target")
    if "footprint.speckle" not in changes:
        mapping["footprint"].pop("speckle")
    path = {"kind": "still", "position": ["0 m", "0 m", "2000 m"], "duration": "1.5 s"}
    scene = {"kind": "plane", "size": "8 km", "reflectance": 0.3}
    return mapping | {
        "platform": {"path": path},
        "scanners": {"down": {"kind": "fixed", "beams": [[0, 0, -1]], "rate": "1 Hz"}},
        "draws": mapping.get("draws", {}) | {"number": 3},
        "scene": {"objects": {"plain": scene}, "origin": "plain"},
    }


WITHOUT_GROUP_BY_METHOD = [
    (name, method)
    for name, changes in WITHOUT_GROUP.items()
    for method in ("probabilities", "noise", "spectra")
    if method != "noise" or "instrument.looks.number" not in changes  # noise is of one look
]


@pytest.mark.parametrize(("name", "method"), WITHOUT_GROUP_BY_METHOD)
def test_a_flight_whose_echoes_are_late_or_elsewhere_has_no_nan(tmp_path, name, method):
    mapping = flight_mapping(WITHOUT_GROUP[name] | {"draws.method": method})
    (tmp_path / "flight.yaml").write_text(to_yaml(mapping))
    assert not check_flight(tmp_path / "flight.yaml").refusals
    statistics = statistics_of(tmp_path / "flight.yaml")
    for probability in ("pd_up", "pd_down", "pd_shot", "surfaces_seen"):
        assert (statistics[probability] == 0).all()
    if name.startswith("late"):
        assert (statistics["snr_up"] == 0).all()
    else:  # the signal is there, as that of grids, though not searched for
        visible_changes = {k: v for k, v in WITHOUT_GROUP[name].items() if k not in ELSEWHERE}
        (tmp_path / "flight.yaml").write_text(to_yaml(flight_mapping(visible_changes)))
        snr = statistics_of(tmp_path / "flight.yaml")["snr_up"]
        np.testing.assert_allclose(statistics["snr_up"], snr, rtol=1e-9)


def statistics_of(file):
    """Statistics of the shots of a flight's only part."""
    study = FlightStudy(load(file), file.with_suffix(".zarr"))
    (eyepoints,) = study.eyepoint_studies()
    shot_numbers = np.arange(eyepoints.n_points)
    eyepoint_results = eyepoints.cast_cycles(shot_numbers)
    shots = eyepoints_from_arrays(eyepoint_results, eyepoints.beamlet_weights)
    flight_block = study.scanner_grids[eyepoints.scanner].flight_block(0)
    selected = study.select_effects(flight_block, shots, shot_numbers)
    return study.simulate_shots(flight_block, eyepoint_results, shots, selected, shot_numbers)
