"""Probabilities of detection from spans of bins: one value, whenever spans are final."""

import numpy as np
import pytest
from shot_helpers import prepare_single_category

from sweep.model.detection.detection_probability import (
    detect_in_spans,
    pd_follows_from_computed_spans,
    shot_pd_and_miss,
)
from sweep.model.effects.catalogue import DEFAULT_EFFECTS
from sweep.model.spectrum.segment_spectra import iter_spans
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
    """Without a band pd comes with the spectrum, with a band from the spans that are left."""
    shots = prepare(table_4_1, record, speckle, detection)
    searched = prepare(table_4_1, record, speckle, detection, WHOLE_SPECTRUM)
    assert pd_follows_from_computed_spans(shots)
    assert not pd_follows_from_computed_spans(searched)
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
