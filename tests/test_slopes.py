"""Segments of any slopes, and shots of which one segment is missed: from beats to answers."""

from pathlib import Path

import numpy as np
import pytest
import yaml

import sweep
from sweep.model import time_domain_truth, waveform
from sweep.model.detection.echo_detection import (
    RAYLEIGH_DEVIATION,
    SegmentCorrelations,
    speckle_mixing_of_point,
)
from sweep.model.detection.estimators import range_velocity_deviation
from sweep.model.detection.looks import pd_and_miss_any_two_in_speckle
from sweep.model.evaluation import evaluate_segments, prepare_shots, shot_statistics
from sweep.model.outputs import DRAW_COUNT_OUTPUTS
from sweep.model.sampling import philox
from sweep.model.sampling.draws import (
    PD_BOTH_CHIRPS_NAME,
    DrawRanges,
    count_by_probability,
    count_in_noise,
    speckle_factors,
)
from sweep.model.waveform import (
    ANY_TWO,
    DOPPLER_CHIRP_RATE_RATIO_PATH,
    DOWN_CHIRP_RATE_RATIO_PATH,
    SHOT_DETECTION_PATH,
)
from sweep.spec import GridSpec, SpecError

EXPERIMENTS = Path(__file__).parents[1] / "experiments"
CARRIER, BANDWIDTH, RATE = 193.4e12, 1e9, 1e14
SAMPLES, SAMPLE_RATE = 4096, 1e9


def prepared(p, effects):
    """Shots of one category."""
    ((_, shots),) = prepare_shots(p, effects)
    return shots


def beats_of(slopes, far, speed):
    """Carriers, chirp rates and signed beats of segments of such slopes, (k, n) each."""
    carriers = np.array(waveform.carrier_frequencies(
        "homodyne", wavelength=waveform.SPEED_OF_LIGHT / CARRIER, start_frequency=0.0,
        bandwidth=BANDWIDTH, chirp_rate_ratios=slopes,
    ))[:, None]  # fmt: skip
    rates = RATE * np.array(slopes)[:, None]
    tau, beta = 2 * far / waveform.SPEED_OF_LIGHT, 2 * speed / waveform.SPEED_OF_LIGHT
    return carriers + 0 * far, rates + 0 * far, carriers * beta - rates * tau * (1 + beta)


def fitted(slopes, used, far, speed, *, signed, assumed="far", noise=0.0):
    carriers, rates, beats = beats_of(slopes, far, speed)
    beats = beats + noise
    turns = np.rint(beats / SAMPLE_RATE)
    peaks = beats - SAMPLE_RATE * turns
    return waveform.fit_range_velocity(
        peaks if signed else np.abs(peaks), carriers=carriers, chirp_rates=rates,
        weights=np.array(used, float)[:, None] + 0 * far, sample_rate=SAMPLE_RATE,
        bin_width=SAMPLE_RATE / SAMPLES, has_signs=signed, two_beat_assumption=assumed,
    )  # fmt: skip


PAIRS = [(1, 1, 0), (1, 0, 1), (0, 1, 1)]
LISTS = [(1, 0, -1), (1, 0.5, -1), (1, 0, 0.5), (1, 0.4, -0.3), (1, -0.6, 0.5), (1, 2, 0.25)]


@pytest.mark.parametrize("slopes", LISTS)
@pytest.mark.parametrize("signed", [False, True])
def test_all_segments_tell_range_and_velocity_and_their_signs(slopes, signed):
    """Targets near and far, closing and opening; peaks that fold at Nyquist where three tell."""
    far = np.repeat([20.0, 75.0, 240.0], 4)
    speed = np.tile([-60.0, -7.0, 11.0, 90.0], 3)
    fit = fitted(slopes, (1, 1, 1), far, speed, signed=signed)
    assert fit.range == pytest.approx(far, rel=1e-9)
    assert fit.radial_velocity == pytest.approx(speed, rel=1e-7)


@pytest.mark.parametrize("used", PAIRS)
@pytest.mark.parametrize("slopes", LISTS)
def test_two_segments_tell_as_much_under_what_is_assumed(slopes, used):
    """Far: closing and opening, but closing beside the light without a chirp. Fast: either."""
    without = any(slope == 0 and is_used for slope, is_used in zip(slopes, used, strict=True))
    far, speed = np.full(2, 300.0), np.array([5.0, 5.0 if without else -5.0])
    cases = [(far, speed, "far"), (np.full(2, 15.0), np.array([80.0, -80.0]), "fast")]
    for metres, closing, assumed in cases:
        for signed in (False, True):
            fit = fitted(slopes, used, metres, closing, signed=signed, assumed=assumed)
            assert fit.range == pytest.approx(metres, rel=1e-9), (assumed, signed)
            assert fit.radial_velocity == pytest.approx(closing, rel=1e-7), (assumed, signed)


def test_what_is_assumed_decides():
    """An opening target beside the light without a chirp is taken for a closing one."""
    far, speed = np.array([300.0]), np.array([-5.0])
    fit = fitted((1, 0, -1), (1, 1, 0), far, speed, signed=False)
    assert fit.radial_velocity == pytest.approx(-speed)
    shift = 2 * 5.0 * CARRIER / waveform.SPEED_OF_LIGHT
    assert fit.range - far == pytest.approx(shift * waveform.SPEED_OF_LIGHT / RATE, rel=1e-3)


@pytest.mark.parametrize(("slopes", "used"), [((1, 0.5, 1), (1, 0, 1)), ((1, 0, -1), (0, 1, 0))])
def test_one_slope_tells_nothing(slopes, used):
    fit = fitted(slopes, used, np.array([100.0]), np.array([1.0]), signed=False)
    assert np.isnan(fit.range).all() and np.isnan(fit.radial_velocity).all()


@pytest.mark.parametrize("slopes", [(1, 0, -1), (1, 0.4, -0.3), (1, 0, 0.5)])
@pytest.mark.parametrize("used", [*PAIRS, (1, 1, 1)])
def test_standard_errors_are_those_of_drawn_beats(slopes, used):
    number, deviations = 40_000, np.array([2e4, 3e4, 5e4])
    rng = np.random.default_rng(11)
    noise = deviations[:, None] * rng.normal(size=(3, number))
    far, speed = np.full(number, 300.0), np.full(number, 5.0)
    carriers, rates, beats = beats_of(slopes, far, speed)
    peaks = beats + noise
    fit = waveform.fit_range_velocity(
        np.abs(peaks),
        carriers=carriers,
        chirp_rates=rates,
        sample_rate=SAMPLE_RATE,
        bin_width=2.5e5,
        weights=np.array(used)[:, None] / deviations[:, None] ** 2 + 0 * far,
    )
    up, doppler, down = np.where(used, deviations, np.inf)
    expected = range_velocity_deviation(
        up=up, doppler=doppler, down=down, carriers=tuple(carriers[:, 0]), chirp_rate=RATE,
        range=300.0, radial_velocity=5.0, slopes=slopes,
    )  # fmt: skip
    for name in ("range", "radial_velocity"):
        spread = getattr(fit, name).std(ddof=1)
        assert spread == pytest.approx(float(getattr(expected, name)), rel=5 / np.sqrt(2 * number))


@pytest.mark.parametrize("snr", [(3.0, 3.0, 3.0), (20.0, 30.0, 25.0), (100.0, 5.0, 100.0)])
@pytest.mark.parametrize("near", [0.0, 0.5, 0.9, 0.99, 1.0])
def test_any_two_of_three_that_fade(snr, near):
    """Against drawn amplitudes: of their own, in one speckle, and as it moves on."""
    number, level, snr = 200_000, 4.0, np.array(snr)
    over = near**4  # of Gaussian footprints
    fading = SegmentCorrelations(*np.array([[near + 0j], [over + 0j], [near + 0j]]))
    key, mixing = (np.uint64(3), np.uint64(5)), speckle_mixing_of_point(fading.speckle_mixing(), 0)
    factors = np.array(
        [speckle_factors(philox.DrawAddress(*key, draw), 0, mixing) for draw in np.arange(number)]
    ).T
    rng = np.random.default_rng(5)
    real, imaginary = rng.normal(size=(2, 3, number))
    hit = np.hypot(np.sqrt(2 * snr)[:, None] * factors + real, imaginary) >= level
    y = level**2 / (2 * (1 + snr))[:, None]
    pd, miss = pd_and_miss_any_two_in_speckle(
        np.exp(-y), -np.expm1(-y), np.array([level]), np.abs(np.array(fading))
    )
    share = (hit.sum(axis=0) >= 2).mean()
    assert abs(share - pd[0]) < 5 * np.sqrt(pd[0] * miss[0] / number)
    assert pd[0] + miss[0] == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize("chance", [1e-300, 0.05, 0.4, 0.9])
@pytest.mark.parametrize("decorrelation", [1e-6, 1e-9, 1e-12])
def test_any_two_of_three_of_which_two_are_all_but_one(chance, decorrelation):
    """These two are detected together, and a third adds next to nothing: the series' 0.002."""
    pd = np.full((3, 1), chance)
    correlations = np.array([[1 - decorrelation], [0.84], [0.8394]])
    pd_any_two, missed = pd_and_miss_any_two_in_speckle(pd, 1 - pd, np.array([1e6]), correlations)
    assert pd_any_two[0] == pytest.approx(chance, rel=2e-3, abs=2e-3)
    assert pd_any_two[0] + missed[0] == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize("noisy", [False, True])
@pytest.mark.parametrize("speckle", ["none", "developed"])
def test_draws_count_the_shots_that_the_closed_form_tells(table_4_1, noisy, speckle):
    number, key = 20_000, philox.point_keys(np.zeros((1, 1)), domain="tests", seed=7)
    rule = {SHOT_DETECTION_PATH: ANY_TWO, "footprint.speckle": speckle}
    rule |= {"target.range": 4000.0, "instrument.processing.detection": "peak_bin"}
    effects = ("doppler", "footprint", "doppler_spread", "fading")
    if speckle == "none":  # a threshold at the up-chirp's own magnitude
        snr = shot_statistics(prepared(table_4_1() | rule, effects))["snr_up"][0]
        rule["instrument.processing.tnr"] = np.sqrt(2 * snr) / RAYLEIGH_DEVIATION
    shots = prepared(table_4_1() | rule, effects)
    outputs = shot_statistics(shots)
    counts = np.zeros((len(DRAW_COUNT_OUTPUTS), 1, 1), np.int64)
    rows = DrawRanges(np.zeros(1, np.int64), key, np.array([0]), np.array([number]))
    if noisy:
        count_in_noise(rows, np.array([0, number]), shots, counts)
    else:
        count_by_probability(rows, np.array([0, number]), outputs, counts)
    expected = np.array([outputs[f"pd_{name}"][0] for name in ("up", "down", "doppler", "shot")])
    share = counts[:4, 0, 0] / number
    assert np.all(np.abs(share - expected) < 5 * np.sqrt(expected * (1 - expected) / number)), (
        share,
        expected,
    )
    assert expected[3] > outputs[PD_BOTH_CHIRPS_NAME][0] + 0.02
    assert outputs["miss_shot"][0] == pytest.approx(1 - expected[3], abs=1e-12)
    statistics = shot_statistics(
        prepared(table_4_1() | rule | {SHOT_DETECTION_PATH: "both_chirps"}, effects)
    )
    assert outputs[PD_BOTH_CHIRPS_NAME] == statistics["pd_shot"]


FLAT = {
    "title": "Slopes", "target": {"range": "200 m", "reflectance": 0.1, "radial_velocity": "5 m/s",
                                  "grazing_angle": "90 deg"},
}  # fmt: skip


def instrument(chirp, processing=None, receiver=None, power="1 W"):
    mapping = yaml.safe_load((EXPERIMENTS / "instruments" / "table_4_1.yaml").read_text())
    mapping["chirp"] |= {"duration": "10 us"} | chirp
    mapping["laser"] |= {"power": power}
    mapping["receiver"] |= receiver or {}
    mapping["processing"] |= {
        "sample_rate": "512 MHz", "fft_size": 4096, "detection": "any_bin",
        "noise_bins": "correlated",
    } | (processing or {})  # fmt: skip
    return mapping


@pytest.mark.parametrize("record", ["real", "complex"])
def test_a_grid_has_segments_of_any_slope(tmp_path, record):
    """Two up-chirps; up- and down-chirp of unequal bandwidths; three slopes."""
    chirp = {"segments": "up doppler down", "doppler_slope": 0.25}
    axes = {"instrument.chirp.down_slope": [0.5, -0.5, -1.0],
            "instrument.chirp.segments": ["up down", "up doppler down"]}  # fmt: skip
    if record == "real":  # without the light that has no chirp
        chirp["doppler_slope"] = -0.25
    del chirp["segments"]
    spec = GridSpec.from_mapping(
        FLAT | {"instrument": instrument(chirp, receiver={"record": record}), "axes": axes}
    )
    outcome = sweep.run(spec, store=tmp_path / "grid.zarr", scheduler="none", progress=False)
    assert outcome.complete
    dataset = sweep.open(tmp_path / "grid.zarr").load()
    bin_width = 512e6 / 4096
    # Peaks by whole bins: half a bin each, over the least difference of two slopes, a half.
    metre = 0.5 * 299792458 / 2 * bin_width / 1e14 * 2 / 0.5
    assert np.abs(dataset.range_error).max() < metre
    speed = 0.5 * 1550e-9 / 2 * bin_width * (1.5 / 0.5)
    assert np.abs(dataset.radial_velocity_error).max() < speed
    assert (dataset.pd_shot > 0.99).all()
    bounds = dataset.sweep.range_error().bound.sel(segments="up down").to_numpy()
    if record == "real":  # as 1 over the difference of slopes; beats of errors alike
        assert bounds[0] / bounds[2] == pytest.approx(2 / 0.5, rel=0.1)


def test_drawn_spectra_of_which_one_segment_is_missed(tmp_path):
    """Errors are those of the bounds of the two that are left; more shots than by both chirps."""
    chosen = {
        "shot_detection": "any_two", "estimator": {"kind": "maximum_likelihood"},
        "acquisition_delay": "1.4 us",  # the echo fills records
    }  # fmt: skip
    stores = {}
    for rule, number in (("both_chirps", 50), ("any_two", 1200)):
        spec = GridSpec.from_mapping(FLAT | {
            "instrument": instrument({}, chosen | {"shot_detection": rule}, power="4 mW"),
            "footprint": {"speckle": "none"},
            "draws": {"number": number, "method": "spectra"},
        })  # fmt: skip
        store = tmp_path / f"{rule}.zarr"
        assert sweep.run(spec, store=store, scheduler="none", progress=False).complete
        stores[rule] = sweep.open(store).load()
    both_store, two = stores.values()
    up, doppler, down = (float(two[f"pd_{name}"]) for name in ("up", "doppler", "down"))
    chance = up * down + doppler * (up + down - 2 * up * down)
    assert abs(two.pd_shot - chance) < 5 * np.sqrt(chance * (1 - chance) / 1200)
    assert two.pd_shot > both_store.pd_shot + 0.1
    # Beside the light without a chirp a beat tells range with twice the standard error.
    lone = doppler * (up + down - 2 * up * down) / chance
    mixed = both_store.range_bound * np.sqrt(1 - lone + 4 * lone)
    assert float(two.range_bound) == pytest.approx(float(mixed), rel=0.05)
    for name in ("range", "radial_velocity"):  # near the threshold estimates stray a little more
        assert 0.95 < two[f"{name}_rmse"] / two[f"{name}_bound"] < 1.2
        assert abs(two[f"{name}_bias"]) < 5 * two[f"{name}_bias_error"]


@pytest.mark.parametrize(("chirp", "processing", "words"), [
    ({"down_slope": 1}, {}, "range and velocity need two slopes"),
    ({"doppler_slope": -1}, {"shot_detection": "any_two"}, "neither range nor velocity"),
])  # fmt: skip
def test_lists_that_do_not_tell_range_and_velocity_are_refused(chirp, processing, words):
    with pytest.raises(SpecError, match=words):
        GridSpec.from_mapping(FLAT | {"instrument": instrument(chirp, processing)})


def test_lines_of_any_slope_are_those_of_the_record(table_4_1):
    """Sampled in time, and transformed: |X| of the peak, of every segment."""
    p = table_4_1() | {
        DOPPLER_CHIRP_RATE_RATIO_PATH: 0.3,
        DOWN_CHIRP_RATE_RATIO_PATH: 0.75,
        "target.range": 411.0,
    }
    p |= {"instrument.processing.fft_size": 4096, "instrument.chirp.duration": 1e-4}
    shots = prepared(p, ("doppler", "footprint"))
    spectra, true = (
        evaluate_segments(shots),
        time_domain_truth.evaluate_segments_in_time_domain(shots, with_range_walk=False),
    )
    assert spectra.magnitude == pytest.approx(true.magnitude, rel=1e-9)
    assert spectra.frequency == pytest.approx(true.frequency, rel=1e-9)


def test_segments_of_which_two_are_never_detected_are_no_shot():
    pd = np.array([[0.0, 0.0, 0.5], [0.0, 0.3, 0.0], [0.0, 0.0, 0.5]])
    correlations = np.full((3, 3), 0.9)
    for level in (np.full(3, 5.0), np.full(3, 1e100)):
        pd_any_two, missed = pd_and_miss_any_two_in_speckle(pd, 1 - pd, level, correlations)
        assert (pd_any_two[:2] == 0.0).all() and (missed[:2] == 1.0).all() and pd_any_two[2] > 0.1
