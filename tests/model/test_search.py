"""The search band: which bins it has, and what is detected, alarms and is reported in it."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from shot_helpers import (
    DRAWS,
    is_within_5_sigma,
    make_point_keys,
    parametrize_product,
    prepare_single_category,
)

from sweep.model import time_domain_truth
from sweep.model.effects.catalogue import DEFAULT_EFFECTS
from sweep.model.evaluation import evaluate
from sweep.model.link_budget import LinkBudget
from sweep.model.pointcloud.bin_groups import list_bin_groups
from sweep.model.pointcloud.pairing import UNCONFIRMED_FLAG
from sweep.model.pointcloud.returns import draw_false_peak_bin, draw_returns
from sweep.model.sampling.samplers import simulate_draws
from sweep.model.spectrum.search_band import search_band_of_points
from sweep.model.threshold import DESIGN_PFA_SEGMENT_PATH, DESIGN_PFA_SHOT_PATH, TNR_PATH
from sweep.model.waveform import SEARCH_BAND_PATHS
from sweep.model.window import window_samples

RECORD = "instrument.receiver.record"
SIZE = 1024
SMALL = {
    "fft_size": SIZE, "duration": 2e-6, "bandwidth": 100e6, "tnr": 6.0, "power": 0.01,
    "range": 220.0, "radial_velocity": 3.0, "beamlets": 1, "detection": "any_bin",
    "noise_bins": "correlated",
}  # fmt: skip


def scene_of(table_4_1, band=None, record="real", **changes):
    """A short record, whose bins are 0.98 m wide at 600 MHz, in which the echo is faint."""
    scene = table_4_1(**(SMALL | changes)) | {RECORD: record, "footprint.speckle": "none"}
    return scene | ({} if band is None else dict(zip(SEARCH_BAND_PATHS, band, strict=True)))


@given(
    st.floats(0, 2000), st.floats(0.1, 1500), st.floats(-400, 400), st.floats(0.1, 500),
    st.sampled_from(["real", "complex"]),
)  # fmt: skip
def test_bins_are_those_nearest_to_any_beat(table_4_1, near, deep, slow, spread, record):
    scene = table_4_1() | {
        RECORD: record, "instrument.processing.fft_size": SIZE,
        "instrument.chirp.duration": 20e-6,
        **dict(zip(SEARCH_BAND_PATHS, (near, near + deep, slow, slow + spread), strict=True)),
    }  # fmt: skip
    # Twice as close as bins, in range and in velocity; from edge to edge.
    far, fast = np.linspace(near, near + deep, 6000), np.linspace(slow, slow + spread, 2000)
    beta, budget = 2 * fast / 299792458, LinkBudget(scene)
    searched = search_band_of_points(scene, budget.waveform, budget.record)
    for first_bin, n_bins, sign, extra in zip(
        searched.first_bin, searched.n_bins, (1, 0, -1), (0, 0, 1e9), strict=True
    ):
        carrier = 299792458 / 1550e-9 + extra
        beats = [
            carrier * b - sign * 5e13 * 2 * r / 299792458 * (1 + b)
            for r, b in ((far, beta[0]), (far, beta[-1]), (far[0], beta), (far[-1], beta))
        ]
        place = np.concatenate(beats) / 600e6 * SIZE
        place = [*np.arange(place.min(), place.max(), 0.05), place.min(), place.max()]
        turns = np.array(place) / SIZE
        turns = turns - np.rint(turns)
        expected = np.unique(np.floor((turns if record == "complex" else abs(turns)) * SIZE + 0.5))
        bins = first_bin + np.arange(n_bins)
        if record == "complex":
            bins, expected = bins % SIZE, expected % SIZE
        assert np.array_equal(np.unique(bins), np.unique(expected))
        assert np.unique(bins).size == n_bins


def noisy_spectra(shots, segment, rng):
    """|X| of DRAWS records: the echo's exact one, and white noise sampled with it."""
    length, shape = shots.window.length, (DRAWS, shots.window.length)
    taper, sigma = window_samples(shots.window.name, length), np.sqrt(shots.noise_variance[0])
    signal = time_domain_truth.beamlet_analytic_signal(shots, 0, segment, 0, with_range_walk=False)
    if shots.complex_record:
        noise = rng.normal(size=shape) + 1j * rng.normal(size=shape)
        spectrum = np.fft.fft(taper * (signal / 2 + sigma * np.sqrt(0.5) * noise), SIZE)
        return np.abs(spectrum)
    return np.abs(np.fft.rfft(taper * (signal.real + sigma * rng.normal(size=shape)), SIZE))


@pytest.mark.parametrize(
    ("record", "offset"), parametrize_product(4, ["real", "complex"], [-40, -1, 0, 1, 40])
)
def test_drawn_records_that_are_searched_in_the_band_alone(record, offset, table_4_1):
    """The strongest bin of the up beat lies some bins within the band's far end, or beyond it."""
    all_bins = prepare_single_category(scene_of(table_4_1, record=record))
    place = time_domain_truth.evaluate_segments_in_time_domain(all_bins).frequency[0, 0] / (
        600e6 / SIZE
    )  # of the echo [bins]
    metre = 299792458 * 600e6 / SIZE / (2 * 50e12)
    end = 220.0 + offset * metre
    scene = scene_of(table_4_1, (end - 60 * metre, end, 3.0, 3.0), record)
    shots, outputs = prepare_single_category(scene), evaluate(scene)
    band = shots.detection_settings.search_band
    first, number = band.first_bin[0, 0], band.n_bins[0, 0]
    inside = np.isin(place % SIZE, (first + np.arange(number)) % SIZE)
    assert inside == (offset >= 0) and abs(number - 61) <= 1
    magnitude = noisy_spectra(shots, 0, np.random.default_rng(50 + offset))
    searched = (first + np.arange(number)) % SIZE
    crosses = magnitude[:, searched] >= shots.threshold[0]
    near = np.abs((searched - place + SIZE / 2) % SIZE - SIZE / 2) <= 2.01 * inside  # a main lobe
    near &= bool(inside)
    hits, alarms = crosses[:, near].any(axis=1).sum(), crosses[:, ~near].any(axis=1).sum()
    assert 0.2 < evaluate(scene_of(table_4_1, record=record))["pd_up"][0] < 0.98
    assert is_within_5_sigma(hits, outputs["pd_up"][0], 0.005 * DRAWS)
    assert outputs["pd_up"][0] + outputs["miss_up"][0] == pytest.approx(1)
    if not inside:
        assert outputs["pd_up"][0] == outputs["pd_shot"][0] == 0 and np.isnan(
            outputs["range_error"][0]
        )
    chance = outputs["pfa_segment"][0]
    if inside:
        assert is_within_5_sigma(alarms, chance, 0.03 * chance * DRAWS)
        assert chance < evaluate(scene_of(table_4_1, record=record))["pfa_segment"][0] / 3
    else:
        leaking = outputs["p_leakage_up"][0]  # of the main lobe's half that is in the band
        assert (leaking > 0.02) == (offset == -1)
        either = 1 - (1 - chance) * (1 - leaking)
        assert is_within_5_sigma(alarms, either, 0.03 * either * DRAWS)


def test_a_band_of_all_bins_is_the_whole_record(table_4_1):
    ranges = np.array([20.0, 75.0, 300.0])
    for record in ("real", "complex"):
        unlimited, wide = (
            evaluate(scene_of(table_4_1, band, record, range=ranges), ("leakage",))
            for band in (None, (0.0, 1e5, -1000.0, 1000.0))
        )
        for name, values in unlimited.items():
            if "leakage" not in name:
                assert np.array_equal(values, wide[name], equal_nan=True), (record, name)


@pytest.mark.parametrize("record", ["real", "complex"])
@pytest.mark.parametrize("noise", ["correlated", "independent"])
def test_thresholds_keep_the_rate_of_alarms_in_the_band(noise, record, table_4_1):
    band = (np.array([10.0, 40.0]), 150.0, -2.0, 5.0)
    target = {"range": 500.0, "radial_velocity": -60.0}  # where no bins are taken away
    dark = scene_of(table_4_1, band, record, reflectance=0.0, noise_bins=noise, **target)
    dark = {path: value for path, value in dark.items() if path != TNR_PATH}
    outputs = evaluate(dark | {DESIGN_PFA_SEGMENT_PATH: 1e-5})
    assert outputs["pfa_segment"] == pytest.approx([1e-5, 1e-5], rel=1e-9)
    assert outputs["pfa_bin"][1] > outputs["pfa_bin"][0]  # in fewer bins
    assert evaluate(dark | {DESIGN_PFA_SHOT_PATH: 1e-5})["pfa_shot"] == pytest.approx(
        [1e-5, 1e-5], rel=1e-9
    )


@pytest.mark.parametrize("record", ["real", "complex"])
@pytest.mark.parametrize("method", ["probabilities", "noise"])
def test_draws_and_points_keep_to_the_band(method, record, table_4_1):
    """Two bands: the echo is in one. False peaks of noise lie in the bands, and evenly."""
    band = (np.array([150.0, 60.0]), np.array([260.0, 140.0]), 0.0, 5.0)
    scene = scene_of(table_4_1, band, record, range=np.full(2, 220.0), tnr=4.5)
    outputs, draws = evaluate(scene), 1000
    counts = simulate_draws(
        scene,
        DEFAULT_EFFECTS,
        keys=make_point_keys(2),
        method=method,
        batch_sizes=[draws],
        first_draw=0,
    )
    spread = 5 * np.sqrt(draws * 0.25)
    assert counts["n_detected_up"][:, 0] == pytest.approx(draws * outputs["pd_up"], abs=spread)
    assert counts["n_detected_up"][1, 0] == 0
    assert counts["n_false_alarm_up"][:, 0] == pytest.approx(
        draws * (1 - (1 - outputs["pfa_segment"]) * (1 - outputs["p_leakage_up"])), abs=spread
    )
    shots = prepare_single_category(scene)
    listed = list_bin_groups(shots)
    assert (listed.strongest_bin[:, 0, 0] >= 0).tolist() == [True, False] and listed.pd[
        1, 0, 0
    ] == 0
    points = draw_returns(shots, listed, keys=make_point_keys(2), draws=draws, method=method)
    assert (points.group[1][..., [0, 2]] < 0).all()
    is_confirmed = np.isfinite(points.range) & (points.flags & UNCONFIRMED_FLAG == 0)
    # In one band the echo, in the other noise: of signed beats Doppler's seldom confirms that.
    for i in range(1 if record == "complex" else 2):
        far = points.range[i][is_confirmed[i]]
        assert far.size > 10
        assert band[0][i] - 10 < far.min() and far.max() < band[1][i] + 10


NONE = np.empty(0, np.int64)


@pytest.mark.parametrize("signed", [False, True])
def test_false_peaks_fall_on_every_free_bin_of_the_band_alike(signed):
    strongest, lowest, highest = bins = np.full((3, 2), -1)
    bins[:, 0] = 20, 19, 22  # the bins beside a group are not free either
    first, last = (-30, 40) if signed else (5, 40)
    expected = [k for k in range(first, last + 1) if not 18 <= k <= 23]
    chances = (np.arange(100 * len(expected)) + 0.5) / (100 * len(expected))
    if signed:
        bins[:, 0] += 2 * 512  # runs of complex records count from further on
    drawn_bins = [
        draw_false_peak_bin(u, strongest, lowest, highest, NONE, first, last, 512, signed)
        for u in chances
    ]
    assert drawn_bins == np.repeat(expected, 100).tolist()
