import numpy as np
import pytest
from stored_studies import INSTRUMENT, SURFACE_AXES, TARGET, spec_over_axes

from sweep.analysis import shot_spectra
from sweep.model import evaluation as shot_model
from sweep.spec import SpecError


@pytest.fixture(scope="module")
def one():
    return shot_spectra.simulate_shot(spec_over_axes({}).parameters())


def test_the_text_tells_noise_segments_range_velocity_and_false_alarms(tmp_path):
    text, files = shot_spectra.write_shot_report(spec_over_axes({}), {}, tmp_path)
    for word in (
        "local oscillator shot",
        "up-chirp",
        "Doppler",
        "down-chirp",
        "range (m)",
        "leakage",
    ):
        assert word in text
    assert [file.name for file in files] == ["shot.png", "shot.txt"]
    assert files[0].stat().st_size > 10_000 and files[1].read_text() == text


def test_the_only_axis_of_few_values_has_a_shot_for_each(tmp_path):
    spec = spec_over_axes({"target.grazing_angle": ["90 deg", "45 deg"]})
    shots = shot_spectra.select_shot_parameters(spec, {})
    assert [label for label, _ in shots] == ["grazing angle 90°", "grazing angle 45°"]
    assert [p["target.grazing_angle"] for _, p in shots] == pytest.approx([np.pi / 2, np.pi / 4])
    text, _ = shot_spectra.write_shot_report(spec, {}, tmp_path)
    assert "grazing angle 45°: Noise at the ADC" in text


def test_axes_take_their_first_values_unless_set_by_name_or_path():
    spec = spec_over_axes(SURFACE_AXES)
    ((_, first),) = shot_spectra.select_shot_parameters(spec, {})
    assert first["target.range"] == 10.0
    ((_, p),) = shot_spectra.select_shot_parameters(
        spec, {"range": "3 km", "target.grazing_angle": "45 deg", "instrument.laser.power": "2 W"}
    )
    assert p["target.range"] == 3000.0 and p["instrument.laser.power"] == 2.0
    assert p["target.grazing_angle"] == pytest.approx(np.pi / 4)


def test_mistakes_in_what_is_set_are_reported_together_with_near_misses():
    with pytest.raises(SpecError) as error_info:
        shot_spectra.select_shot_parameters(
            spec_over_axes(SURFACE_AXES), {"rnage": "3 km", "grazing_angle": "45"}
        )
    text = str(error_info.value)
    assert "did you mean 'target.range'?" in text and "needs a unit" in text


def test_a_coordinate_named_by_a_longer_tail_is_known():
    spec = spec_over_axes(
        {"instrument.receiver.detector_bandwidth": ["300 MHz", "400 MHz"], "target.range": ["1 km"]}
    )
    name = spec.axes[0].name
    ((_, p),) = shot_spectra.select_shot_parameters(spec, {name: "350 MHz"})
    assert p["instrument.receiver.detector_bandwidth"] == 350e6


def test_peaks_stand_where_the_beats_are_and_as_high_as_the_statistics_say(one):
    width = 600e6 / 2**17
    for segment in one.segments:
        assert abs(segment.frequency[segment.peak_index] - abs(segment.beat_frequency)) < 3 * width
    up = one.segments[0]
    snr = (up.magnitude.max() / one.noise_sigma) ** 2 / 2
    assert snr == pytest.approx(up.snr, rel=1e-9)
    assert up.snr == pytest.approx(one.outputs["snr_up"], rel=1e-12)


@pytest.mark.parametrize("velocity", [32.0, -32.0])
def test_bins_of_complex_records_have_the_signs_and_the_places_of_their_frequencies(
    velocity,
):
    """Beats by hand: f_d = 2 v / lambda and f_r = (B/T) 2R/c, folded into -fs/2 .. fs/2."""
    parameters = spec_over_axes({}).parameters() | {
        "instrument.receiver.record": "complex", "instrument.processing.fft_size": 2**14,
        "instrument.processing.bins_counted": "half", "target.range": 6000.0, 
        "target.radial_velocity": velocity, "instrument.laser.power": 100.0,
    }  # fmt: skip
    shot = shot_spectra.simulate_shot(parameters)
    width, half = 600e6 / 2**14, 2**13
    doppler, far = 2 * velocity / 1550e-9, 2e12 * 2 * 6000.0 / 299792458.0
    for segment, beat in zip(shot.segments, (doppler - far, doppler, doppler + far), strict=True):
        expected = (beat / width + half) % 2**14 - half
        peak_bins = segment.bin_numbers[segment.peak_index]
        assert peak_bins == pytest.approx(expected, abs=3)
        assert segment.frequency[segment.peak_index] == peak_bins * width
        assert segment.bin_numbers[0] == -half and segment.bin_numbers[-1] == half - 1
        assert segment.bin_numbers[[g.peak_index for g in segment.bin_groups]].tolist() == [
            peak_bins
        ]
    rows = shot_spectra._segment_table(shot).rows
    assert [row[3] for row in rows] == [s.bin_numbers[s.peak_index] for s in shot.segments]
    assert [float(row[2]) for row in rows] == pytest.approx(
        [row[3] * width / 1e6 for row in rows], abs=1e-6
    )


def test_drawn_noise_has_the_noise_level_and_crosses_the_threshold_as_rarely_as_it_should():
    parameters = spec_over_axes({}).parameters() | {
        "instrument.processing.tnr": 4.0,
        "target.reflectance": 0.0,
    }
    shot = shot_spectra.simulate_shot(parameters, seed=5)
    inner = np.concatenate([segment.magnitude[1:-1] for segment in shot.segments])
    # 3 x 65,535 exponential powers; a Hamming window correlates neighbours: half as many count
    independent = inner.size / 2
    power = np.mean(inner**2) / shot.noise_rms**2
    assert abs(power - 1) < 5 / np.sqrt(independent)
    chance = np.exp(-(4 - np.pi) / 4 * 16)
    crossed = np.mean(inner >= shot.threshold)
    assert abs(crossed - chance) < 5 * np.sqrt(chance / independent)


def test_noise_is_the_seeds_alone():
    parameters = spec_over_axes({}).parameters()
    a, b, c = (shot_spectra.simulate_shot(parameters, seed=seed).segments[0] for seed in (1, 1, 2))
    assert np.array_equal(a.magnitude, b.magnitude)
    assert not np.array_equal(a.magnitude, c.magnitude)
    assert np.array_equal(a.signal_magnitude, c.signal_magnitude)


def test_groups_are_runs_of_bins_above_threshold_with_their_highest():
    magnitude = np.array([5.0, 1.0, 6.0, 7.0, 6.5, 1.0, 1.0, 5.0])
    groups = shot_spectra.find_bin_groups(magnitude, 5.0)
    assert [(g.first_index, g.last_index, g.peak_index) for g in groups] == [
        (0, 0, 0),
        (2, 4, 3),
        (7, 7, 7),
    ]
    assert shot_spectra.find_bin_groups(magnitude, 8.0) == ()


@pytest.mark.parametrize("distance", [500.0, 9500.0])
@pytest.mark.parametrize("velocity", [150.0, -40.0])
def test_the_upper_axis_reads_true_range_and_velocity_at_the_beats_folded_or_not(
    distance, velocity
):
    parameters = spec_over_axes({}).parameters() | {
        "target.range": distance,
        "target.radial_velocity": velocity,
        "target.grazing_angle": np.pi / 2,
    }
    shot = shot_spectra.simulate_shot(parameters)
    for segment in shot.segments:
        at_peak = segment.frequency[segment.peak_index]
        axis_value = float(
            shot_spectra.range_or_velocity_from_frequency(shot, segment, np.array(at_peak))
        )
        # a bin is 0.343 m of range and 3.55 mm/s of velocity; the peak is within one
        if segment.chirp_rate_ratio:
            assert axis_value == pytest.approx(distance, abs=0.35)
        else:
            assert axis_value == pytest.approx(velocity, abs=0.0036)


def test_what_the_shot_reports_is_what_the_model_reports_without_noise(one):
    outputs = shot_model.evaluate(spec_over_axes({}).parameters())
    assert one.reported_range - 2000.0 == pytest.approx(outputs["range_error"][0], abs=1e-9)
    error = outputs["radial_velocity_error"][0]
    assert one.reported_radial_velocity - 150.0 == pytest.approx(error, abs=1e-12)


def test_the_view_around_the_peak_holds_all_that_the_footprint_spreads():
    magnitude = np.full(4000, 1e-6)
    magnitude[2000:2100] = 1.0
    view = shot_spectra.peak_bin_slice(magnitude)
    assert view.start < 2000 and view.stop > 2100
    assert shot_spectra.peak_bin_slice(np.eye(1, 4000, 3)[0]).start == 0


def test_a_shot_too_weak_is_reported_as_not_detected(tmp_path):
    text, files = shot_spectra.write_shot_report(
        spec_over_axes({}), {"reflectance": "1e-6"}, tmp_path, draws_noise=True, seed=3
    )
    assert "NOT detected" in text
    assert files[0].name == "shot_reflectance1e-6.png"


def test_direct_detection_has_no_doppler_segment(tmp_path):
    receiver = INSTRUMENT["receiver"] | {"architecture": "direct"}
    spec = spec_over_axes({}, instrument=INSTRUMENT | {"receiver": receiver}, target=TARGET)
    text, _ = shot_spectra.write_shot_report(spec, {"range": "20 m"}, tmp_path)
    assert "Doppler" not in text and "thermal" in text


def test_a_parameter_set_by_name_and_by_path_is_refused():
    with pytest.raises(SpecError, match=r"given twice, as range and as target\.range"):
        shot_spectra.select_shot_parameters(
            spec_over_axes(SURFACE_AXES), {"range": "3 km", "target.range": "2 km"}
        )


def test_a_beam_stated_by_its_waist_shows_the_waist(tmp_path):
    instrument = spec_over_axes(SURFACE_AXES).to_yaml_mapping()["instrument"]
    laser = {k: v for k, v in instrument["laser"].items() if k != "beam_divergence"}
    spec = spec_over_axes(
        SURFACE_AXES, instrument=instrument | {"laser": laser | {"beam_waist": "20 mm"}}
    )
    text, _ = shot_spectra.write_shot_report(spec, {}, tmp_path)
    assert "beam waist" in text and "beam divergence" not in text
