"""The thesis's way on an oversampled grid against the closed form of the same lines."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from sweep.model import time_domain_truth
from sweep.model.evaluation import evaluate, evaluate_segments, prepare_shots
from sweep.model.spectrum import oversampled_grid, segment_spectra

WITHOUT_LEAKAGE = ("footprint", "footprint_phase", "doppler", "signal_shot_noise", "image")

DEPOSIT = {
    "rectangular": (0.05, 1e-10),
    "hamming": (0.03, 1e-12),
    "hann": (0.03, 1e-12),
    "kaiser(8.6)": (0.03, 1e-12),
}
"""Largest error over the lines' summed peaks, of the nearest cell and of ten.

A line moved by 1/32 bin changes |W| by at most that times its steepest slope: 0.6 of the peak a bin
for Hann, 1.4 for a rectangle, whose next sidelobe it meets. Lagrange's remainder with ten cells is
a^10 437^2 / 10! / 218 = 2e-11 for a frequency a = pi/16 a cell, the window's ends; inside it falls
with the tenth power.
"""


def drawn_scene(table_4_1, number=12, **changes):
    rng = np.random.default_rng(5)
    scene = table_4_1(
        range=rng.uniform(10.0, 1e4, number),
        grazing_angle=np.radians(rng.uniform(2.0, 90.0, number)),
        radial_velocity=rng.choice([150.0, -30.0, 0.0], number),
        **changes,
    )
    ((_, shots),) = prepare_shots(scene, WITHOUT_LEAKAGE)
    return shots


def spectrum(shots, i, segment, *, degree=0, real=False, folded=False):
    """Bins around a point's lines, and |X| there, without noise."""
    (cells,) = oversampled_grid.cells_per_point(shots)[[i]].tolist()
    options = oversampled_grid.GridOptions(degree, real, folded)
    low, magnitude = oversampled_grid.grid_magnitudes(
        shots,
        shots.point_parameters(),
        shots.segment_parameters(),
        np.array([i]),
        segment,
        cells,
        options,
    )
    bins = low[0] + np.arange(magnitude.shape[1])
    within = (bins >= 0) & (bins <= shots.fft_size // 2)
    return bins[within], magnitude[0, within]


def error(shots, degree):
    """Largest difference near the lines over the peak of all of them in phase.

    Of |X|; of |X|^2 where powers add, as a root of rounding is much.
    """
    worst, order = 0.0, 2 if shots.footprint.adds_powers else 1
    for i in range(shots.size):
        gain = 1 / (
            1 + (2e8 / shots.receiver_filter.detector_bandwidth) ** 2
        )  # of lines below 200 MHz, at least
        peak = shots.footprint.relative_amplitude[shots.footprint.row_of_point[i]]
        peak = np.sqrt((peak**2).sum()) if shots.footprint.adds_powers else peak.sum()
        peak *= (
            np.broadcast_to(shots.echo_scales.beat_amplitude_scale, shots.size)[i]
            * shots.window.sum
            / 2
            * gain
        )
        for segment in range(3):
            _, exact = segment_spectra.segment_spectrum(shots, i, segment)
            bins, spectrum_values = spectrum(shots, i, segment, degree=degree)
            inner = slice(bins.size // 4, -bins.size // 4)
            errors = np.abs(spectrum_values**order - exact[bins] ** order) / peak**order
            worst = max(worst, errors[inner].max())
    return worst


@pytest.mark.parametrize("phases", ["coherent", "incoherent"])
@pytest.mark.parametrize("window", DEPOSIT)
def test_lines_in_cells_are_as_near_as_cells_can_be(window, phases, table_4_1):
    number = 2 if "kaiser" in window else 12  # whose whole spectrum takes its time
    shots = drawn_scene(table_4_1, number, window=window, phases=phases)
    shots = replace(shots, line_images=shots.line_images._replace(are_summed=False))
    nearest, shared = DEPOSIT[window]
    assert 1e-3 < error(shots, 0) < nearest
    # Powers have twice the bandwidth: 2^10 times the remainder.
    assert error(shots, 9) < (shared if phases == "coherent" else 1024 * shared)


@pytest.mark.parametrize("phases", ["coherent", "incoherent"])
@pytest.mark.parametrize("acquisition_delay", [0.0, 350e-6])
def test_images_about_dc_and_nyquist_are_summed(phases, acquisition_delay, table_4_1):
    """Doppler lines 0.3 bins from DC and from Nyquist; padded records, odd ones too."""
    for fft_size in (8192, 8191, 2**17):
        width = 600e6 / fft_size
        nyquist = (fft_size // 2) * width
        v = (np.array([0.3, nyquist / width - 0.3]) * width) * 1550e-9 / 2
        scene = table_4_1(
            radial_velocity=v, phases=phases, fft_size=fft_size, beamlets=7,
            acquisition_delay=acquisition_delay,
        )  # fmt: skip
        ((_, shots),) = prepare_shots(scene, WITHOUT_LEAKAGE)
        for i in range(2):
            _, exact = segment_spectra.segment_spectrum(shots, i, 1)
            bins, spectrum_values = spectrum(shots, i, 1, degree=9)
            edge = np.abs(bins - (0, fft_size // 2)[i]) < 20
            assert np.abs(spectrum_values - exact[bins])[edge].max() < 1e-8 * exact.max()
            without = segment_spectra.segment_spectrum(
                replace(shots, line_images=shots.line_images._replace(are_summed=False)), i, 1
            )[1]
            assert np.abs(without - exact).max() > 0.01 * exact.max()


@pytest.mark.parametrize("phases", ["coherent", "incoherent"])
def test_the_way_back_to_the_bins_alone_is_the_whole_way_back(phases, table_4_1):
    shots = drawn_scene(table_4_1, 12, phases=phases)
    for i, segment in itertools.product(range(shots.size), range(3)):
        _, magnitudes = spectrum(shots, i, segment)
        _, real = spectrum(shots, i, segment, real=True)
        _, folded = spectrum(shots, i, segment, folded=True)
        _, real_and_folded = spectrum(shots, i, segment, real=True, folded=True)
        order = 2 if shots.footprint.adds_powers else 1  # a root of rounding is much
        for other in (real, folded, real_and_folded):
            assert (
                np.abs(magnitudes**order - other**order).max() < 1e-14 * magnitudes.max() ** order
            )


def test_the_same_detections_come_of_it(table_4_1):
    rng = np.random.default_rng(6)
    scene = table_4_1(
        range=rng.uniform(200.0, 9000.0, 40), grazing_angle=np.radians(rng.uniform(5.0, 90.0, 40))
    )
    exact = evaluate(scene, WITHOUT_LEAKAGE, segment_evaluator=evaluate_segments)
    outputs = evaluate(
        scene,
        WITHOUT_LEAKAGE,
        segment_evaluator=lambda s: oversampled_grid.find_peaks_on_grid(s, degree=9),
    )
    for name in ("pd_up", "pd_doppler", "pd_shot", "snr_up", "range_error", "noise_variance"):
        # Images beyond the grid are left out: 1e-4 of a line at the very most.
        assert outputs[name] == pytest.approx(exact[name], rel=2e-3, abs=1e-3), name
    assert outputs["log10_pfa_both_chirps"] == pytest.approx(
        exact["log10_pfa_both_chirps"], abs=1e-4
    )


def test_a_spread_footprint_gets_a_larger_grid(table_4_1):
    wide = prepare_shots(
        table_4_1(range=9e3, grazing_angle=np.radians([0.5, 60.0])), WITHOUT_LEAKAGE
    )
    ((_, shots),) = wide
    assert list(oversampled_grid.cells_per_point(shots)) == [2**13, 2**12]
    assert list(oversampled_grid.cells_per_point(shots, 2**11)) == [2**13, 2**11]
    bins, spectrum_values = spectrum(shots, 0, 0, degree=9)
    _, exact = segment_spectra.segment_spectrum(shots, 0, 0)
    assert np.abs(spectrum_values - exact[bins]).max() < 1e-3 * exact.max()


def test_detections_in_the_time_domain_are_those_of_the_closed_form(table_4_1):
    scene = table_4_1(
        range=np.array([700.0, 3000.0]), fft_size=4096, beamlets=19, radial_velocity=0.0
    )
    exact = evaluate(scene, WITHOUT_LEAKAGE)
    outputs = evaluate(
        scene, WITHOUT_LEAKAGE, segment_evaluator=time_domain_truth.evaluate_segments_in_time_domain
    )
    for name in ("pd_up", "pd_doppler", "pd_shot", "miss_shot", "snr_up", "range_error"):
        assert outputs[name] == pytest.approx(exact[name], rel=1e-6, abs=1e-9), name
    assert np.array_equal(outputs["pfa_both_chirps"], exact["pfa_both_chirps"])


def test_direct_detection_has_no_doppler_segment(table_4_1):
    scene = table_4_1(architecture="direct", range=np.array([20.0, 30.0]), radial_velocity=0.0)
    for look in (
        oversampled_grid.find_peaks_on_grid,
        time_domain_truth.evaluate_segments_in_time_domain,
    ):
        outputs = evaluate(
            scene | {"instrument.processing.fft_size": 4096}, ("image",), segment_evaluator=look
        )
        assert np.isnan(outputs["pd_doppler"]).all() and (outputs["pd_up"] > 0).all()
