"""Lines with phase errors as bundles with known kernels, against records in the time domain."""

from dataclasses import replace

import numpy as np
import pytest
from engine import lines_of, run_of_bins
from test_optional_lines import exact, prepared, scene
from windows import marked

from sweep.model.kernel_rows import digests
from sweep.model.preparation import PhaseError

WINDOWS = ("hamming", "hann", "rectangular", "blackman", "flattop")
AGREEMENT = 1e-9
"""Largest difference of |X|, relative to all lines in phase on the peak."""

PLACES = {
    "in the band": {},
    "folded": {"range": 9000.0, "radial_velocity": -400.0, "duration": 700e-6},
    "at DC": {"range": 0.5, "radial_velocity": 0.0},
    "near DC": {"range": 8.0, "radial_velocity": 0.0},
    "at Nyquist": {"range": 2249.0, "radial_velocity": 0.0},
}
NO_WIDTH = np.zeros(1), np.ones(1)


def drifting(shots, drift):
    """Shots with a frequency drift of so many bins within the record, and a cubic phase."""

    def phase(x, sign, drift):
        return (sign + 0.5) * drift[:, None] * (x**2 / 8 + x**3 / 60 + 0.1 * x)

    return replace(shots, phase_errors=(PhaseError(phase, {"drift": np.array([drift])}),))


def apart(shots, segment):
    """Largest difference of a bin from the time domain's, and the peak of all lines in phase."""
    found, true, peak, form = both(shots, segment)
    return abs(found - true).max(), peak, form


def allowed(shots, true):
    """Errors of bins whose powers are as far off as is allowed of those at the threshold."""
    smaller = np.maximum(shots.threshold[0] / np.maximum(2 * true, 1e-300), 1.0)
    return shots.line_tolerance * shots.bin_deviation[0] * smaller


def both(shots, segment):
    """|X| of bins, the same from the time domain; the peak of all lines in phase."""
    low, fast = run_of_bins(shots, segment)
    number, _, _, form = lines_of(shots, segment)
    bins = np.arange(low, low + fast.size)
    slow = exact(shots, 0, segment, NO_WIDTH)
    assert slow.argmax() in bins
    amplitudes = shots.amplitude[shots.row[0]]
    peak = 0.5 * shots.beat_scale * shots.window.sum * np.sqrt((amplitudes**2).sum())
    return fast, slow[bins], float(peak), form and number > 0


@pytest.mark.parametrize(
    "place, image", [*((place, True) for place in PLACES), ("in the band", False)]
)
@pytest.mark.parametrize("window", marked(WINDOWS))
def test_bins_are_those_of_the_record(window, place, image, table_4_1):
    """From gentle drifts to those over ten bins; bright, so that runs are wide."""
    without = () if image else ("image",)
    parameters = scene(
        table_4_1, window=window, phases="incoherent", power=10.0, tnr=4.0, **PLACES[place]
    )
    shots = prepared(parameters, without=without)
    for drift in (1e-3, 0.1, 1.0, 4.0, 10.0):
        for segment in (0, 2):
            missed, peak, form = apart(drifting(shots, drift), segment)
            assert missed < AGREEMENT * peak
            assert form or drift > 0.1


@pytest.mark.parametrize("window", marked(WINDOWS))
def test_bins_are_within_what_is_allowed(window, table_4_1):
    changed = 0
    for drift in (1e-3, 0.1, 1.0, 4.0):
        for power in (1e-2, 1.0):
            shots = drifting(
                prepared(scene(table_4_1, window=window, phases="incoherent", power=power)), drift
            )
            for tolerance in (1e-1, 1e-3, 1e-5):
                loose = replace(shots, line_tolerance=np.asarray(tolerance))
                found, true, peak, form = both(loose, 0)
                assert form or drift > 0.1
                missed = abs(found - true)
                assert (missed <= allowed(loose, true) + 1e-11 * peak).all()
                changed += missed.max() > AGREEMENT * peak
    assert changed > 3


def test_bundles_too_wide_for_a_form_are_looked_at_bin_by_bin(table_4_1):
    parameters = scene(
        table_4_1, phases="incoherent", beam_divergence=2e-2, beamlets=61, grazing_angle=0.2,
        range=4000.0,
    )  # fmt: skip
    missed, peak, form = apart(drifting(prepared(parameters), 1.0), 0)
    assert not form
    assert missed < AGREEMENT * peak


@pytest.mark.parametrize("phases", ["coherent", "incoherent"])
def test_wide_bundles_stand_side_by_side(phases, table_4_1):
    """Some tens of bins of lines, each in parts; bins between bundles as those on them."""
    numbers = set()
    for place in PLACES:
        for grazing_angle in (0.06, 0.02, 0.004):
            parameters = scene(
                table_4_1, phases=phases, power=10.0, tnr=4.0, beamlets=37,
                grazing_angle=grazing_angle, **PLACES[place],
            )  # fmt: skip
            shots = drifting(prepared(parameters), 1.5)
            _, _, number, _ = lines_of(shots, 0)
            low, found = run_of_bins(shots, 0)
            slow = exact(shots, 0, 0, NO_WIDTH)
            peak = 0.5 * shots.beat_scale * shots.window.sum * shots.amplitude.sum()
            assert abs(found - slow[low : low + found.size]).max() < AGREEMENT * peak
            numbers.add(number)
    assert max(numbers) > 5 and 1 in numbers


def test_parts_are_known_by_what_they_are():
    rng = np.random.default_rng(4)
    place, re, im = rng.normal(size=(3, 2, 5))
    known = digests(place, re, im)
    wider = [np.pad(one, ((0, 0), (0, 3))) for one in (place, re, im)]
    assert np.array_equal(digests(*wider), known)  # parts of no weight are none
    assert (known >= 2).all() and (known == np.floor(known)).all()
    seen = {*known}
    for values in (place, re, im):
        for k in range(5):
            kept = values[0, k]
            for other in (np.nextafter(kept, 9), -kept):
                values[0, k] = other
                seen.add(digests(place, re, im)[0])
            values[0, k] = kept
    assert len(seen) == 2 + 3 * 5 * 2
