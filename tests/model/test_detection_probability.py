"""Probabilities of detection from spans of bins: one value, whenever spans are final."""

import numpy as np
import pytest
from shot_helpers import prepare_single_category

from sweep.model.detection.detection_probability import (
    detect_in_spans,
    doppler_pd_given_chirps,
    down_pd_given_up_result,
    segment_strongest_peak_probabilities,
    shot_pd_and_miss,
    shot_strongest_peak_probabilities,
)
from sweep.model.detection.echo_detection import (
    pd_of_any_independent_bin,
    pd_of_one_independent_bin,
    pd_of_one_independent_bin_kernel,
)
from sweep.model.effects.catalogue import DEFAULT_EFFECTS
from sweep.model.effects.circulator_leak import ISOLATION_PATH, LEAK_LENGTH_PATH
from sweep.model.spectrum import strongest_peak
from sweep.model.spectrum.segment_spectra import evaluate_segments, iter_spans
from sweep.model.waveform import SEARCH_BAND_PATHS

RECORD_PATH = "instrument.receiver.record"
SMALL = {
    "fft_size": 1024, "duration": 2e-6, "bandwidth": 100e6, "tnr": 5.0, "power": 0.02,
    "beamlets": 7, "phases": "incoherent", "noise_bins": "correlated",
    "range": np.linspace(120.0, 330.0, 5), "radial_velocity": np.linspace(-3.0, 9.0, 5),
}  # fmt: skip
WHOLE_SPECTRUM = dict(zip(SEARCH_BAND_PATHS, (0.0, 1e5, -300.0, 300.0), strict=True))


def prepare(table_4_1, record, speckle, detection, extra=None):
    """Shots of faint echoes in short records."""
    parameters = table_4_1(**SMALL, detection=detection) | {
        RECORD_PATH: record, "footprint.speckle": speckle,
    }  # fmt: skip
    effects = (*DEFAULT_EFFECTS, "speckle") if speckle == "developed" else DEFAULT_EFFECTS
    return prepare_single_category(parameters | (extra or {}), effects)


def pd_and_miss_of(shots):
    """Probabilities (2, segments, n) of detection and of a miss."""
    result = np.full((2, 3, shots.size), np.nan)
    for spans in iter_spans(shots):
        result[:, :, spans.point_numbers] = spans.pd, spans.miss
    return result


@pytest.mark.parametrize("detection", ["peak_bin", "any_bin"])
@pytest.mark.parametrize(("record", "speckle"), [("real", "none"), ("complex", "developed")])
def test_a_search_band_of_all_bins_gives_the_same_bits(record, speckle, detection, table_4_1):
    shots = prepare(table_4_1, record, speckle, detection)
    searched = prepare(table_4_1, record, speckle, detection, WHOLE_SPECTRUM)
    expected = pd_and_miss_of(shots)
    assert (expected[0, [0, 2]] > 0.01).all() and (expected[0, [0, 2]] < 0.9999).any()
    np.testing.assert_array_equal(pd_and_miss_of(searched), expected)


def test_what_is_not_searched_is_not_detected(table_4_1):
    shots = prepare(table_4_1, "real", "none", "any_bin", WHOLE_SPECTRUM)
    (spans,) = iter_spans(shots)
    is_searched = np.zeros(spans.peak_is_searched.shape, bool)
    is_searched[0] = True
    cleared = detect_in_spans(shots, spans._replace(peak_is_searched=is_searched))
    np.testing.assert_array_equal(cleared.pd[0], spans.pd[0])
    assert (cleared.pd[1:] == 0).all() and (cleared.miss[1:] == 1).all()


def test_pd_and_miss_of_a_shot_without_speckle_are_complements(table_4_1):
    shots = prepare(table_4_1, "real", "none", "any_bin")
    (spans,) = iter_spans(shots)
    pd, miss = shot_pd_and_miss(shots, spans.pd, spans.miss, spans.peak_magnitude)
    np.testing.assert_allclose(pd, spans.pd[0] * spans.pd[2], rtol=1e-14)
    np.testing.assert_allclose(pd + miss, 1.0, rtol=1e-14)


@pytest.mark.parametrize("detection", ["peak_bin", "any_bin"])
def test_a_permanent_line_masks_the_peak_and_pd_is_computed_on_demand(detection, table_4_1):
    """Leaked light over a path of 240 m beats as the echo from 120 m does, of the first point."""
    parameters = table_4_1(**SMALL, detection=detection) | {
        LEAK_LENGTH_PATH: 240.0, ISOLATION_PATH: 1e6,
    }  # fmt: skip
    shots = prepare_single_category(parameters, (*DEFAULT_EFFECTS, "circulator_leak"))
    (spans,) = iter_spans(shots)
    (without_pd,) = iter_spans(shots, computes_pd=False)
    np.testing.assert_array_equal(without_pd.peak_is_masked, spans.peak_is_masked)
    assert np.isnan(without_pd.pd).all() and np.isnan(without_pd.miss).all()
    assert spans.peak_is_masked[[0, 2], 0].all() and not spans.peak_is_masked[[0, 2], 1:].any()
    assert (spans.pd[spans.peak_is_masked] == 0).all()
    assert (spans.miss[spans.peak_is_masked] == 1).all()
    assert (spans.pd[[0, 2], 1:] > 0).all()
    results = evaluate_segments(shots)  # the echo is there, though it is not detected
    assert (results.magnitude[[0, 2], 0] > 0).all() and np.isfinite(results.frequency).all()
    # Nor does it lose to a larger peak what it does not have.
    unmasked = without_pd._replace(peak_is_masked=np.zeros_like(without_pd.peak_is_masked))
    lost = strongest_peak._other_peak_probabilities(shots, without_pd, results.pd).pd_loss
    lost_if_unmasked = strongest_peak._other_peak_probabilities(shots, unmasked, results.pd).pd_loss
    assert (lost_if_unmasked[spans.peak_is_masked] > 0).any()
    np.testing.assert_array_equal(lost, np.where(spans.peak_is_masked, 0.0, lost_if_unmasked))


def test_pd_given_other_segments_adds_up_to_pd():
    """P(B) = P(A) P(B | A) + P(not A) P(B | not A)."""
    pd_up, pd_down = np.array([0.0, 0.2, 0.7, 1.0]), np.array([0.5, 0.6, 0.4, 0.3])
    pd_both = pd_up * pd_down + np.array([0.0, 0.05, 0.1, 0.0])
    down = down_pd_given_up_result(pd_up, pd_down, pd_both)
    np.testing.assert_allclose(
        pd_up * down.pd_if_condition_holds + (1 - pd_up) * down.pd_if_condition_fails, pd_down
    )
    np.testing.assert_allclose(pd_up[1:] * down.pd_if_condition_holds[1:], pd_both[1:])
    one, doppler = pd_up + pd_down - 2 * pd_both, np.array([0.4, 0.5, 0.6, 0.7])
    added = one * np.array([0.5, 0.6, 0.7, 0.8])
    conditional_pd = doppler_pd_given_chirps(
        doppler, one, added, np.array([True, True, True, False])
    )
    np.testing.assert_allclose(conditional_pd.pd_if_condition_holds, [0.5, 0.6, 0.7, 0.7])
    np.testing.assert_allclose(
        one * conditional_pd.pd_if_condition_holds
        + (1 - one) * conditional_pd.pd_if_condition_fails,
        doppler,
    )


def test_a_segment_reports_the_echo_or_another_peak_or_none():
    pd = np.array([[0.3, 0.9], [0.5, 0.5], [0.6, 0.99]])
    loss, alarm = 0.2 * pd, np.array([[0.1, 0.5], [0.2, 0.2], [0.3, 0.0]])
    segments = segment_strongest_peak_probabilities(pd, 1 - pd, loss, alarm)
    none = (1 - alarm) * (1 - pd)
    np.testing.assert_allclose(segments.pd + segments.p_wrong_range + none, 1.0)
    np.testing.assert_allclose(segments.pd + segments.miss, 1.0)
    shot = shot_strongest_peak_probabilities(
        segments,
        alarm,
        shared_speckle_gain=np.zeros(2),
        speckle_covariance=None,
        is_range_misread=np.array([False, True]),
    )
    reported = (1 - none[0]) * (1 - none[2])  # by both chirps
    right = segments.pd[0] * segments.pd[2]
    np.testing.assert_allclose(shot.pd, right)
    np.testing.assert_allclose(shot.miss, 1 - right)
    np.testing.assert_allclose(shot.p_wrong_range, reported - right * np.array([1.0, 0.0]))


@pytest.mark.parametrize("n_bins", [1.0, 1.7, 12.0])
def test_independent_bins_together_are_detected_as_the_echo(n_bins):
    pd = np.array([1e-30, 1e-9, 0.2, 0.999])
    bin_pd = pd_of_one_independent_bin(pd, n_bins)
    np.testing.assert_allclose(bin_pd[2:], 1 - (1 - pd[2:]) ** (1 / n_bins), rtol=1e-12)
    for echo_pd, single in zip(pd, bin_pd, strict=True):
        assert pd_of_one_independent_bin_kernel(echo_pd, n_bins) == pytest.approx(single, rel=1e-14)
        assert pd_of_any_independent_bin(single, n_bins) == pytest.approx(echo_pd, rel=1e-12)
