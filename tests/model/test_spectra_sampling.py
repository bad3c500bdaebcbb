"""Whole spectra: their noise, what is detected in them, and that order and blocks do not matter."""

import numpy as np
import pytest
from shot_helpers import make_point_keys

from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.detection.estimators import SPECTRUM_METHOD_DEFAULTS
from sweep.model.detection.sub_bin_interpolation import in_phase_noise_correlations
from sweep.model.error_budget import ErrorBudget
from sweep.model.evaluation import evaluate, prepare_shots
from sweep.model.laser_line import beat_phase_noise, n_beat_phase_noise_steps
from sweep.model.outputs import DRAW_COUNT_OUTPUTS, SPECTRA_STUDY_OUTPUTS
from sweep.model.sampling import philox, samplers
from sweep.model.sampling.noisy_spectra import (
    DETECTOR_PREFIX,
    ESTIMATOR_PREFIX,
    SpectrumMethods,
    draw_noise_spectra,
    draw_signal_spectra,
    flag_detected_bins,
    noiseless_signal,
    prepare_point_spectra,
)
from sweep.model.sampling.samplers import PriorDraws, simulate_draws
from sweep.model.time_domain_truth import time_domain_spectrum

EFFECTS = ("doppler",)
WHOLE_SPECTRA = {"method": "spectra"}
RECORD = "instrument.receiver.record"
COMPLEX = {RECORD: "complex"}
BOTH_RECORDS = pytest.mark.parametrize("record", ["real", "complex"])


def _points(table_4_1, **changes):
    parameters = {
        "instrument.processing.fft_size": 2048,
        "instrument.processing.tnr": 6.0,
        "target.range": np.array([1000.0, 2000.0, 3500.0]),
    }
    return table_4_1() | parameters | changes


def _drawn(parameters, number=400, effects=EFFECTS, **place):
    size = np.size(parameters["target.range"])
    return simulate_draws(
        parameters,
        effects,
        keys=make_point_keys(size),
        batch_sizes=[number],
        **place,
        **WHOLE_SPECTRA,
    )


@BOTH_RECORDS
@pytest.mark.parametrize(("window", "duration"), [("rectangular", 5e-4), ("hamming", 2.5e-6)])
def test_noise_has_the_power_and_the_correlation_of_window_and_padding(
    table_4_1, window, duration, record
):
    """2.5 us are 1500 samples in 2048 points. 5 sigma of a mean over 300 spectra of 1000 bins."""
    changes = {"instrument.processing.window": window, "instrument.chirp.duration": duration}
    changes[RECORD] = record
    ((_, shots),) = prepare_shots(_points(table_4_1, **changes) | {"target.range": 100.0}, EFFECTS)
    noise = draw_noise_spectra(shots, 0, 0, key=make_point_keys(1)[0], draws=np.arange(300))[
        :, 8:-8
    ]
    power = 2 * float(shots.bin_noise_sigma[0]) ** 2
    independent = 300 * noise.shape[1] / 2  # tapers and padding leave half of them, or more
    assert np.mean(np.abs(noise) ** 2) == pytest.approx(power, rel=5 / np.sqrt(independent))
    turn = np.exp(1j * np.pi * shots.window.length / shots.fft_size)
    near = np.mean((noise[:, 1:] * noise[:, :-1].conj()).real * turn.real
                   - (noise[:, 1:] * noise[:, :-1].conj()).imag * turn.imag) / power  # fmt: skip
    expected, _ = in_phase_noise_correlations(shots.window, shots.fft_size)
    assert near == pytest.approx(expected, abs=5 / np.sqrt(independent))


@BOTH_RECORDS
def test_the_signal_is_that_of_the_time_domain(table_4_1, record):
    """A lone line: magnitudes of the record's own FFT; its place, but for its image."""
    parameters = _points(table_4_1) | {"target.range": 1000.0, "footprint.beamlets": 1}
    parameters[RECORD] = record
    ((_, shots),) = prepare_shots(parameters, (*EFFECTS, "image"))
    expected = time_domain_spectrum(shots, 0, 2, with_range_walk=False)
    signal = noiseless_signal(shots, 0, 2)
    np.testing.assert_allclose(np.abs(signal.spectrum), expected, atol=1e-8 * expected.max())
    assert signal.strongest_bin == np.argmax(expected)
    up, down = noiseless_signal(shots, 0, 0).frequency_bins, signal.frequency_bins
    assert (up > 0) == (record == "real" or 2 * 150.0 / 1550e-9 > 1000.0 * 2e12 / 1.5e8)
    beat = 2 * 150.0 / 1550e-9 / 600e6 * 2048  # half sum of up and down [bins]
    assert (up + down) / 2 == pytest.approx(beat, abs=5e-3)


@BOTH_RECORDS
def test_a_fixed_threshold_detects_as_the_closed_form_says(table_4_1, record):
    """Tones on bins of an untapered record: nothing beside them, where one more look is taken.

    The Doppler beat is on bin 660, and the range beat 30 bins from it.
    """
    width = 600e6 / 2048
    speed = 660 * width * 1550e-9 / 2
    parameters = _points(
        table_4_1,
        **{
            "instrument.processing.window": "rectangular",
            "instrument.processing.tnr": 6.5,
            "instrument.laser.power": np.array([0.01, 0.02, 0.04]),
            "target.radial_velocity": speed,
            "target.range": np.full(3, 660.0),
            "footprint.beamlets": 1,
            RECORD: record,
        },
    )
    closed, drawn = evaluate(parameters, EFFECTS), _drawn(parameters, 1000)
    pd = closed["pd_doppler"]
    assert ((pd > 0.02) & (pd < 0.98)).sum() >= 2
    sigma = np.sqrt(pd * (1 - pd) / 1000)
    assert (np.abs(drawn["pd_doppler"] - pd) < 5 * sigma + 2.2 * closed["pfa_bin"]).all()
    assert (np.abs(drawn["pfa_bin"] - closed["pfa_bin"]) < 5 * drawn["pfa_bin_error"]).all()
    assert (drawn["pfa_bin_error"] < 0.07 * drawn["pfa_bin"]).all()  # at 5 sigma under sqrt 2


@BOTH_RECORDS
def test_the_most_likely_range_and_velocity_reach_the_bound(table_4_1, record):
    """Within 15 %, of a lone line; 5 standard errors of 600 draws are 14 %."""
    parameters = _points(table_4_1, **{"footprint.beamlets": 1, "target.range": np.array([600.0])})
    parameters |= {ESTIMATOR_PREFIX + "kind": "maximum_likelihood", RECORD: record}
    drawn_outputs = _drawn(parameters, 600)
    for name in ("range", "radial_velocity"):
        assert drawn_outputs[f"{name}_rmse"] == pytest.approx(
            drawn_outputs[f"{name}_bound"], rel=0.15
        )
        assert np.abs(drawn_outputs[f"{name}_bias"]) < 5 * drawn_outputs[f"{name}_bias_error"]
    coarse = _drawn(parameters | {ESTIMATOR_PREFIX + "kind": "peak_bin"}, 100)
    assert coarse["range_rmse"] > 2 * drawn_outputs["range_bound"]


def test_range_is_that_at_the_beginning_though_the_ground_walks(table_4_1):
    """By 41 mm within the record of 137 us at 300 m/s."""
    parameters = _points(
        table_4_1,
        **{
            "instrument.processing.fft_size": 8192, "instrument.laser.power": 30.0,
            "instrument.processing.sample_rate": 60e6, "instrument.laser.wavelength": 1e-4,
            "footprint.beamlets": 1, "target.range": np.array([100.0]),
            "target.radial_velocity": 300.0, ESTIMATOR_PREFIX + "kind": "maximum_likelihood",
        },
    )  # fmt: skip
    drawn_outputs = _drawn(parameters, 300, (*EFFECTS, "range_walk"))
    assert abs(drawn_outputs["range_bias"]) < 5 * drawn_outputs["range_bias_error"] + 1e-3
    assert drawn_outputs["range_bias_error"] < 2e-3


@pytest.mark.parametrize(
    ("effects", "record"), [((*EFFECTS, "speckle"), "real"), (EFFECTS, "complex")]
)
def test_batches_points_and_their_order_change_no_bit(table_4_1, effects, record):
    parameters = _points(table_4_1, **{"target.roughness": 1e-6, "footprint.beamlets": 4})
    parameters |= {RECORD: record}
    parameters |= {DETECTOR_PREFIX + "kind": "os_cfar", ESTIMATOR_PREFIX + "kind": "candan"}
    keys = make_point_keys(3)
    at_once = simulate_draws(parameters, effects, keys=keys, batch_sizes=[40, 30], **WHOLE_SPECTRA)
    other = parameters | {"target.range": parameters["target.range"][::-1].copy()}
    parts = simulate_draws(
        other, effects, keys=keys[::-1], batch_sizes=[13, 7, 50], **WHOLE_SPECTRA
    )
    for name, values in at_once.items():
        if values.ndim == 2:
            np.testing.assert_array_equal(values.sum(axis=1), parts[name][::-1].sum(axis=1))
        else:
            np.testing.assert_array_equal(values, parts[name][::-1], err_msg=name)
    single_point = {path: v[1:2] if np.ndim(v) else v for path, v in parameters.items()}
    one = simulate_draws(single_point, effects, keys=keys[1:2], batch_sizes=[70], **WHOLE_SPECTRA)
    for name in SPECTRA_STUDY_OUTPUTS:
        np.testing.assert_array_equal(one[name], at_once[name][1:2], err_msg=name)


def test_drawing_until_the_tolerance_is_met_stops_where_it_is(table_4_1):
    parameters, accuracy = _points(table_4_1), ErrorBudget(0.1, 0.95, count_interval_name="wilson")
    arguments = {"keys": make_point_keys(3), "error_budget": accuracy} | WHOLE_SPECTRA
    results = simulate_draws(parameters, EFFECTS, batch=20, limit=500, **arguments)
    assert (results["accuracy_missed"] == 0).all() and results["n_draws"].min() < 100
    repeated = simulate_draws(
        parameters, EFFECTS, batch_sizes=[int(results["n_draws"][0])], **arguments
    )  # fmt: skip
    assert repeated["pd_shot"][0] == results["pd_shot"][0]
    assert repeated["n_detected_shot"][0, 0] == results["n_detected_shot"][0]


def _in_pieces(**arguments):
    """Results of draws that are stopped as soon as can be and gone on with, and how often."""
    before, number, pieces = None, -1, 0
    while True:
        results = simulate_draws(prior_draws=before, should_stop=lambda: True, **arguments)
        if results["n_draws"].sum() == number:
            return results, pieces
        number, pieces = results["n_draws"].sum(), pieces + 1
        counts = np.stack(
            [results[name].reshape(len(results["n_draws"]), -1) for name in DRAW_COUNT_OUTPUTS]
        )
        before = PriorDraws(results["n_draws"], counts, results)


@pytest.mark.parametrize("kind", ["ca_cfar", "os_cfar", "goca_cfar"])
def test_cells_of_an_iq_spectrum_have_neighbours_all_round(table_4_1, kind):
    """Of noise alone every bin alarms as often as designed, the first and the last included.

    10,000 spectra of an untapered record, whose bins are independent.
    """
    changes = {"instrument.processing.window": "rectangular", "instrument.processing.fft_size": 64}
    parameters = _points(table_4_1, **changes) | COMPLEX | {"target.range": 1000.0}
    parameters |= SPECTRUM_METHOD_DEFAULTS | {
        DETECTOR_PREFIX + "kind": kind,
        DETECTOR_PREFIX + "pfa": 0.02,
    }
    ((_, shots),) = prepare_shots(parameters, EFFECTS)
    view = prepare_point_spectra(shots, 0, parameters, make_point_keys(1)[0], SpectrumMethods())
    noise = draw_noise_spectra(shots, 0, 0, key=make_point_keys(1)[0], draws=np.arange(10_000))
    _, flags = flag_detected_bins([noise], view, 0)
    assert flags.shape == (10_000, 64)
    np.testing.assert_allclose(flags.mean(axis=0), 0.02, atol=5 * np.sqrt(0.02 * 0.98 / 10_000))


@pytest.mark.parametrize("edge", [0.0, -512.0])
def test_an_iq_echo_on_the_seam_or_at_zero_is_found_as_any_other(table_4_1, edge):
    """A beat walked across 0 and across Nyquist: detected as often, and placed as well.

    5 sigma of two shares of 300 draws, and of a root mean square: 20 %.
    """
    bins = edge + np.array([-0.3, 0.3, 200.3])  # of the Doppler segment's beat
    parameters = COMPLEX | {
        "instrument.processing.fft_size": 1024, "footprint.beamlets": 1,
        "target.radial_velocity": bins * (600e6 / 1024) * 1550e-9 / 2,
        "target.range": np.full(3, 600.0), ESTIMATOR_PREFIX + "kind": "maximum_likelihood",
    }  # fmt: skip
    parameters = _points(table_4_1, **parameters) | {"instrument.laser.power": 0.06}
    snr = evaluate(parameters, EFFECTS)["snr_doppler"]  # of three bins that the receiver passes
    as_loud = {"instrument.laser.power": 0.06 * 5.0 / snr}
    pd = _drawn(parameters | as_loud, 300)["pd_doppler"]
    assert 0.2 < pd[2] < 0.8
    assert np.abs(pd - pd[2]).max() < 5 * np.sqrt(2 * pd[2] * (1 - pd[2]) / 300)
    drawn_outputs = _drawn(parameters | {"instrument.laser.power": 10.0}, 300)
    assert (drawn_outputs["pd_shot"] == 1).all()
    np.testing.assert_allclose(
        drawn_outputs["range_rmse"], drawn_outputs["range_bound"], rtol=5 / np.sqrt(600)
    )


@pytest.mark.parametrize("much", [{"batch_sizes": [40, 30]}, {"batch": 16, "limit": 70}])
def test_a_detector_sees_the_same_draws_together_where_they_are_stopped(
    much, table_4_1, monkeypatch
):
    """A threshold set by all that is seen at once: 5 draws at 2048 points, 10 at 1024."""
    monkeypatch.setattr(samplers, "SPECTRUM_SAMPLES_PER_STEP", 5 * 2048)

    def over_the_median(power, setting):
        return power > 8 * np.median(power)

    sizes = {"instrument.processing.fft_size": np.array([2048, 1024, 2048])}
    parameters = _points(table_4_1, **sizes) | {DETECTOR_PREFIX + "kind": "m:f"}
    arguments = {
        "parameters": parameters,
        "effects": EFFECTS,
        "keys": make_point_keys(3),
        **much,
        **WHOLE_SPECTRA,
    }
    arguments |= {
        "error_budget": ErrorBudget(0.1),
        "methods": SpectrumMethods({"m:f": over_the_median}),
    }
    in_one_call, (at_once, pieces) = simulate_draws(**arguments), _in_pieces(**arguments)
    assert pieces > 3
    for name, values in in_one_call.items():
        np.testing.assert_array_equal(at_once[name], values, err_msg=name)
    monkeypatch.setattr(samplers, "SPECTRUM_SAMPLES_PER_STEP", 3 * 2048)
    assert (simulate_draws(**arguments)["pfa_bin"] != in_one_call["pfa_bin"]).all()


def test_speckle_is_detected_as_often_as_in_closed_form(table_4_1):
    """Against the mean over the same draws of their conditional probabilities.

    Twice a sharp threshold's spread, as single draws are counted here and averaged there.
    """
    from mean_over_draws import mean_statistics as averaged

    parameters = _points(
        table_4_1,
        **{
            "instrument.processing.window": "rectangular",
            "target.roughness": 1e-6,
            "footprint.beamlets": 1,
            "target.range": np.array([800.0]),
        },
    )
    effects = (*EFFECTS, "speckle")
    pd = averaged(parameters, effects, keys=make_point_keys(1), draws=600)["pd_down"]
    drawn_pd = _drawn(parameters, 600, effects)["pd_down"]
    assert 0.1 < pd[0] < 0.95
    assert drawn_pd == pytest.approx(pd, abs=5 * 0.5 / np.sqrt(600))


def test_methods_may_be_ones_own(table_4_1):
    """A detector that flags everything but the signal, and an estimator half a bin too high."""

    def all_but(power, setting):
        flags = np.ones(power.shape, bool)
        flags[:, [0, 1, 2, -2, -1]] = False
        return flags

    methods = SpectrumMethods({"m:f": all_but}, {"m:g": lambda spectrum, peak, setting: peak + 0.5})
    parameters = _points(table_4_1) | {
        DETECTOR_PREFIX + "kind": "m:f",
        ESTIMATOR_PREFIX + "kind": "m:g",
    }
    drawn_outputs = _drawn(parameters, 5, methods=methods)
    assert (drawn_outputs["pd_shot"] == 1).all()
    assert (drawn_outputs["false_alarms"] == 0).all()  # one group, and the signal within it


CHIRP_2_US = {
    "instrument.processing.window": "rectangular", "instrument.processing.sample_rate": 500e6,
    "instrument.chirp.bandwidth": 500e6, "instrument.chirp.duration": 2e-6,
    "target.radial_velocity": 0.0, ESTIMATOR_PREFIX + "kind": "chirp_z",
}  # fmt: skip
WANDERING = {"instrument.laser.line_width": 1e5, "instrument.laser.line_shape": "lorentzian"}


def test_ranges_err_by_the_walk_of_the_lasers_phase(table_4_1):
    """100 kHz, 500 MHz in 2 us: known errors of 4.3 to 30.7 mm, and bounds to 38.8 mm."""
    place = {"target.range": np.array([10.0, 75.0, 100.0])}
    parameters = _points(table_4_1, **CHIRP_2_US) | WANDERING | place
    drawn_outputs = _drawn(parameters, number=600, effects=("doppler", "line_width", "image"))
    known = np.array([4.3e-3, 30.7e-3])
    spread = 5 / np.sqrt(2 * 600)
    np.testing.assert_allclose(drawn_outputs["range_rmse"][:2], known, rtol=0.05 + spread)
    bounds = [4.3e-3, 29.8e-3, 38.8e-3]
    np.testing.assert_allclose(drawn_outputs["range_bound"], bounds, rtol=0.1)


def test_the_laser_turns_the_record_sample_by_sample(table_4_1):
    """As the time domain has it: the same phases in the record of the exact delay."""
    parameters = _points(table_4_1, **CHIRP_2_US) | WANDERING | {"target.range": 50.0}
    parameters |= {"footprint.beamlets": 1}
    ((_, pure),) = prepare_shots(parameters, ("doppler", "image"))
    ((_, shots),) = prepare_shots(parameters, ("doppler", "image", "line_width"))
    key, draws, rate = make_point_keys(1)[0], np.arange(3), 500e6
    delay = 100.0 / SPEED_OF_LIGHT * rate
    spectra = draw_signal_spectra(shots, 0, 2, noiseless_signal(shots, 0, 2), key=key, draws=draws)
    for draw, drawn in zip(draws, spectra, strict=True):
        steps = n_beat_phase_noise_steps(delay=delay, length=shots.window.length)
        numbers = philox.uniforms(key[None], np.array([draw]), philox.STREAM_LASER_PHASE[2], steps)
        phase = beat_phase_noise(
            philox.to_normals_by_row(numbers)[0],
            variance_per_sample=2 * np.pi * 1e5 / rate,
            delay=delay,
        )
        expected = time_domain_spectrum(pure, 0, 2, with_range_walk=False, laser_phase=phase)
        # Magnitudes have the phases of a lone tone at a place that is known to some 1e-4 of a bin.
        np.testing.assert_allclose(np.abs(drawn), expected, atol=0.01 * expected.max())
    without = draw_signal_spectra(pure, 0, 2, noiseless_signal(pure, 0, 2), key=key, draws=draws)
    assert without.shape == (1, 1025)  # nothing is drawn of a pure tone
