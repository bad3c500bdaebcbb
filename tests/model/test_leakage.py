"""Leakage summed as an integral against every bin looked at by itself, hard cases first."""

import itertools
import math
from dataclasses import replace

import mpmath
import numpy as np
import pytest
from shot_helpers import detected_window, line_shape_of_window, magnitude_error, parametrize_product

from sweep.model import time_domain_truth
from sweep.model.detection.added_crossings import (
    SERIES_TERMS_MAX,
    any_crossing_probability,
    crossing_rate,
    fill_added_crossing_probabilities,
    fill_crossing_series,
)
from sweep.model.detection.marcum import marcum_q1_excess
from sweep.model.evaluation import evaluate_segments, prepare_ray_traced_shots, prepare_shots
from sweep.model.ground import BeamletTable, RayTracedGround
from sweep.model.pointcloud.bin_groups import list_bin_groups
from sweep.model.pointcloud.leaked_peaks import LEAKAGE_PROBABILITY_MIN, iter_leakage_bins
from sweep.model.spectrum.bin_spectrum import (
    FAR_LINE_LOG_ACCURACY,
    LineBundle,
    allocate_workspace,
    compute_end_amplitudes_and_far_lines,
    far_line_weight,
)
from sweep.model.spectrum.segment_spectra import SegmentResults, segment_spectrum
from sweep.model.window import COSINE_SUM_COEFFICIENTS, direct_transform, get_window

ACCURACY = 1e-6
"""What the module states, relative to the leakage."""

DOPPLER_ACCURACY = 1e-3
"""Relative accuracy of the Doppler segment's leakage: all lines may be at DC or Nyquist."""

CLOSED_FORMS = ("hamming", "hann", "rectangular", "flattop")
EVERY_FORM = tuple(COSINE_SUM_COEFFICIENTS)


def compare(shots):
    """Largest relative differences of what is found, fast against bin by bin."""
    fast, slow = evaluate_segments(shots), evaluate_segments(shots, bin_by_bin=True)
    error = {}
    for name in SegmentResults._fields:
        fast_values, slow_values = getattr(fast, name), getattr(slow, name)
        np.testing.assert_array_equal(np.isfinite(fast_values), np.isfinite(slow_values))
        # A tone on a bin leaks nothing but rounding: left out bin by bin, under 1e-12 sigma.
        scale = np.maximum(np.abs(slow_values), 1e-20 if name == "leakage_probability" else 1e-290)
        error[name] = np.nanmax(np.abs(fast_values - slow_values) / scale)
    # Of the Doppler segment only draws need to know what leaks, and whether any bin is raised.
    listed, every = (
        list_bin_groups(shots, groups_max=1, every_bin=k).leakage_probability[:, 1]
        for k in (False, True)
    )
    difference = np.abs(listed - every) / np.maximum(every, LEAKAGE_PROBABILITY_MIN)
    assert np.nanmax(difference, initial=0.0) < DOPPLER_ACCURACY
    return SegmentResults(**error), slow


def held(shots):
    """The module's accuracy, and that of everything else that both report."""
    error, slow = compare(shots)
    assert error.leakage_probability < ACCURACY
    assert error.magnitude < 1e-9 and error.pd < 1e-7
    assert error.frequency == 0 and error.n_exempt == 0
    return slow.leakage_probability


def strengths_without_moments(places, degree, generator):
    """Random strengths whose moments below a degree are nothing: what cancels best from afar."""
    strength = generator.normal(size=places.size) + 1j * generator.normal(size=places.size)
    powers = np.array([places**j for j in range(degree)]).reshape(degree, places.size)
    return strength - np.linalg.pinv(powers) @ (powers @ strength)


@pytest.mark.parametrize(
    ("name", "half"), parametrize_product(3, EVERY_FORM, [0.05, 1.0, 2.5, 6.0, 40.0])
)
def test_no_sum_of_strengths_is_seen_from_afar_as_more_than_it_is_said_to_be(name, half):
    """Against the transforms of all of them, from the table's end to the record's other end."""
    generator, shape = np.random.default_rng(5), get_window(name, 4096)
    prepared = line_shape_of_window(shape, 4096)
    layout, tabulated = prepared.layout, prepared.shape.envelope
    line_spectrum, gained = allocate_workspace(16).line_spectrum, []
    for degree in (0, 1, 2, 4, 6):
        places = np.append(generator.uniform(-half, half, 10), [-half, half])
        s = strengths_without_moments(places / half, degree, generator)
        n, total = places.size, abs(s).sum()
        lines, bundle = line_spectrum.lines, LineBundle(0, n, -half, half, total)
        lines.position[:n], lines.re[:n], lines.im[:n] = places, s.real, s.imag
        clearance = float(layout.clearance_bins)
        n_sources = compute_end_amplitudes_and_far_lines(
            bundle, clearance, FAR_LINE_LOG_ACCURACY, layout, line_spectrum
        )
        bound = far_line_weight(total, n_sources, layout, line_spectrum.far_equivalent_lines)
        distances = np.geomspace(layout.clearance_bins + 1, 2000, 24) + generator.uniform(0, 1)
        y = half + distances[:, None] - places
        kernel = direct_transform(shape, y.ravel()).reshape(y.shape) * np.exp(1j * np.pi * y)
        index = np.searchsorted(tabulated.distance, distances - 1.5, "right") - 1
        envelope = tabulated.magnitude[index]
        assert (abs(kernel @ s) <= bound * envelope * (1 + 1e-9) + 1e-12 * total).all()
        assert bound <= total
        gained.append(bound / total)
    assert min(gained) < {0.05: 0.02}.get(half, 1.1)


@pytest.mark.parametrize(
    ("allowed", "window", "phases"),
    parametrize_product(5, [1e-1, 1e-3, 1e-6], EVERY_FORM, ["coherent", "incoherent"]),
)
def test_leakage_far_from_the_lines_is_left_out_up_to_what_is_allowed(
    table_4_1, window, phases, allowed
):
    generator = np.random.default_rng(13)
    parameters = table_4_1(
        window=window, phases=phases, fft_size=2**14, beamlets=19,
        tnr=generator.uniform(2.0, 12.0, 300), range=10 ** generator.uniform(0.5, 4.0, 300),
        grazing_angle=np.radians(generator.uniform(2.0, 90.0, 300)),
        power=10 ** generator.uniform(-5.0, 1.0, 300),
    )  # fmt: skip
    # Up to Nyquist and beyond: images are as near as the lines at some points, far at others.
    parameters["target.radial_velocity"] = generator.uniform(-470.0, 470.0, 300)
    ((_, shots),) = prepare_shots(parameters)
    assert shots.line_images.are_summed
    spectra = evaluate_segments(shots)
    in_part = evaluate_segments(
        replace(
            shots, tolerances=shots.tolerances._replace(leakage_probability=np.asarray(allowed))
        )
    )
    missed = spectra.leakage_probability - in_part.leakage_probability
    assert (missed <= allowed).all() and (missed >= -1e-6 * spectra.leakage_probability).all()
    for name in ("pd", "miss", "magnitude", "frequency", "n_exempt"):
        np.testing.assert_allclose(
            getattr(in_part, name), getattr(spectra, name), rtol=1e-9, atol=1e-300
        )
    assert (missed > 0).any()


@pytest.mark.parametrize("phases", ["coherent", pytest.param("incoherent", marks=pytest.mark.slow)])
@pytest.mark.parametrize("window", EVERY_FORM)
def test_leakage_over_ranges_and_angles_for_every_window(table_4_1, window, phases):
    generator = np.random.default_rng(3)
    parameters = table_4_1(
        window=window, phases=phases, fft_size=2**14, beamlets=19, leakage_floor=1e-12, tnr=5.0
    ) | {
        "target.range": np.exp(generator.uniform(np.log(1.0), np.log(1.2e4), 150)),
        "target.grazing_angle": np.radians(generator.uniform(1.0, 90.0, 150)),
        "target.radial_velocity": generator.uniform(-400.0, 400.0, 150),
    }
    ((_, shots),) = prepare_shots(parameters)
    leakage = held(shots)
    assert np.nanmax(leakage) > 1e-2 and np.nanmin(leakage) < 1e-3  # of many sizes


@pytest.mark.parametrize("phases", ["coherent", "incoherent"])
def test_leakage_of_near_targets_at_normal_incidence(table_4_1, phases):
    """The strongest signals there are, with all sidelobes far above the noise, and a wide FFT."""
    parameters = table_4_1(phases=phases, leakage_floor=1e-12, beamlets=109) | {
        "target.range": np.array([0.01, 0.3, 2.0, 10.0, 35.0, 80.0])
    }
    ((_, shots),) = prepare_shots(parameters)
    held(shots)


@pytest.mark.parametrize("phases", ["coherent", "incoherent"])
@pytest.mark.parametrize("velocity", [0.0, 0.005, -0.02, 232.5, 232.497, -465.0])
def test_leakage_of_beats_at_dc_at_nyquist_and_where_they_cancel(table_4_1, phases, velocity):
    """232.5 m/s is Nyquist's Doppler shift; the ranges include those where beats meet DC."""
    parameters = table_4_1(phases=phases, leakage_floor=1e-12, beamlets=19, fft_size=2**13)
    meets = abs(velocity) * 2 / 1550e-9 / (2 / 299792458 * 2e12)
    parameters |= {
        "target.radial_velocity": velocity,
        "target.range": np.array([0.02, 1.0, meets + 0.1, meets + 3.0, 22473.0, 22484.4]),
    }
    ((_, shots),) = prepare_shots(parameters)
    held(shots)


RANGE_BIN, DOPPLER_BIN = 149_896_229 * 600e6 / 2e12, 1550e-9 * 600e6 / 299_792_458
"""Offset [m] and change of 2 v_r / c that move a line by one bin, times the FFT's size."""


def drawn_bundles(table_4_1, seed, fft_size, spread):
    """Forty shots of two to three clusters of lines, ``apart`` bins from the beam's centre."""
    rng = np.random.default_rng((61, seed))
    shots, beamlets = 40, int(rng.choice([1, 2, 5, 19]))
    parameters = table_4_1(
        window=CLOSED_FORMS[seed % len(CLOSED_FORMS)],
        phases=str(rng.choice(["coherent", "incoherent"])),
        architecture=str(rng.choice(["homodyne", "heterodyne", "direct"])),
        fft_size=fft_size,
        tnr=float(rng.choice([2.0, 4.0, 10.0])),
        leakage_floor=1e-12,
    )
    ranges = 10 ** rng.uniform(0.0, 3.8, shots)
    clusters = rng.uniform(-spread, spread, (2, shots, 3))
    cluster_index = rng.integers(3, size=(shots, beamlets))
    bins, doppler = (np.take_along_axis(c, cluster_index, axis=1) for c in clusters)
    bins += rng.normal(size=bins.shape) * rng.choice([1e-6, 0.1, 2.0])
    parameters |= {
        "target.range": ranges,
        "target.radial_velocity": rng.uniform(-160.0, 160.0, shots),
        "target.reflectance": 1.0,
    }
    echo = rng.exponential(size=bins.shape) / beamlets / 6
    offset = bins * RANGE_BIN / fft_size / ranges[:, None]
    shift = doppler * DOPPLER_BIN / fft_size
    return prepare_ray_traced_shots(
        parameters, RayTracedGround(BeamletTable(np.arange(shots), offset, shift, echo))
    )


@pytest.mark.parametrize(
    ("fft_size", "image"),
    parametrize_product(3, [64, 100, 255, 512, 1023, 2048, 4099, 8192], [True, False]),
)
def test_leakage_of_bundles_wide_and_narrow_in_ffts_of_any_size(table_4_1, fft_size, image):
    """As wide as the band, or all past DC or Nyquist, where only images make spectra even."""
    for seed, spread in enumerate((0.0, 0.5, 5.0, 50.0, 300.0)):
        shots = drawn_bundles(table_4_1, 10 * fft_size + seed, fft_size, spread)
        held(replace(shots, line_images=shots.line_images._replace(are_summed=image)))


@pytest.mark.parametrize("fft_size", [64, 255, 1023, 5000])
def test_lines_further_apart_than_there_are_bins_fold_into_the_spectrum(table_4_1, fft_size):
    for seed in range(6):
        shots = drawn_bundles(table_4_1, 1000 + seed, fft_size, 2.0 * fft_size)
        for segment in np.flatnonzero(shots.has_segment):
            _, spectrum = segment_spectrum(shots, seed, int(segment))
            exact = time_domain_truth.time_domain_spectrum(
                shots, seed, int(segment), with_range_walk=False
            )
            assert np.abs(spectrum - exact).max() < 1e-8 * exact.max()


@pytest.mark.parametrize("place", [0.0, 300e6])
@pytest.mark.parametrize("past", [-500.0, -148.3, -12.0, -3.0, 0.0, 3.0, 12.0, 148.3, 500.0])
def test_leakage_where_all_lines_lie_past_dc_or_nyquist(table_4_1, place, past):
    """A beam's centre near DC or Nyquist, its lines so many bins away from it."""
    for name in CLOSED_FORMS:
        beamlets, fft_size = 7, 16384
        parameters = table_4_1(window=name, fft_size=fft_size, leakage_floor=1e-12, tnr=5.0)
        velocity = (place + np.array([-1e5, 0.0, 1e4])) * 1550e-9 / 2
        bins = past + 0.1 * np.arange(beamlets) - 0.3
        footprints = BeamletTable(
            np.zeros(3, int), np.zeros((1, beamlets)), bins[None] * DOPPLER_BIN / fft_size,
            np.full((1, beamlets), 0.01),
        )  # fmt: skip
        moving = parameters | {"target.radial_velocity": velocity, "target.range": 300.0}
        shots = prepare_ray_traced_shots(moving, RayTracedGround(footprints))
        held(shots)


@pytest.mark.parametrize("phases", ["coherent", "incoherent"])
@pytest.mark.parametrize("window", EVERY_FORM)
def test_bins_of_the_run_are_those_of_the_record(table_4_1, window, phases):
    """Of the time-domain truth, near the lines and beside them."""
    scene = table_4_1(window=window, phases=phases, fft_size=8192, beamlets=19, power=20.0)
    for r, grazing, v in ((30.0, 1.5, 150.0), (700.0, 0.7, 0.3), (4000.0, 0.1, -90.0)):
        ((_, shots),) = prepare_shots(
            scene
            | {"target.range": r, "target.grazing_angle": grazing, "target.radial_velocity": v}
        )
        for segment in range(3):
            low, magnitudes = detected_window(shots, segment)
            exact = time_domain_truth.time_domain_spectrum(shots, 0, segment, with_range_walk=False)
            assert 5 < magnitudes.size < 4097
            error = magnitude_error(
                shots, magnitudes, exact[low : low + magnitudes.size], exact.max()
            )
            assert error < (1e-9 if shots.footprint.adds_powers else 1e-10)


@pytest.mark.parametrize("spread", [0.5, 50.0])
def test_groups_are_those_of_every_bin(table_4_1, spread):
    """Of the wide run that looks at each bin, the fast one leaves out no group and no neighbour."""
    n_groups = 0
    for seed in range(5):
        shots = drawn_bundles(table_4_1, 900 + seed, 16384, spread)
        fast, slow = (
            list_bin_groups(shots, groups_max=6),
            list_bin_groups(shots, groups_max=6, every_bin=True),
        )
        for name in ("strongest_bin", "first_bin", "last_bin", "n_exempt_bins"):
            np.testing.assert_array_equal(getattr(fast, name), getattr(slow, name))
        np.testing.assert_allclose(
            fast.peak_and_neighbour_magnitudes, slow.peak_and_neighbour_magnitudes, rtol=1e-7
        )
        n_groups += (slow.strongest_bin >= 0).sum(axis=-1).max()
    assert n_groups >= 5 * (2 if spread > 1 else 1)


@pytest.mark.parametrize("spread", [0.5, 50.0])
def test_listed_bins_have_no_larger_rates_than_the_bound(spread, table_4_1):
    """-ln(1 - c) of every listed bin, by Marcum's function, against the sum over all bins."""
    n_bounded = 0
    for seed in range(len(CLOSED_FORMS)):
        shots = drawn_bundles(table_4_1, 1700 + seed, 4096, spread)
        groups = list_bin_groups(shots)
        sigma = np.broadcast_to(shots.bin_noise_sigma, shots.size)
        beta = np.broadcast_to(shots.threshold, shots.size) / sigma
        for points, bins in iter_leakage_bins(shots, groups, np.arange(shots.size)):
            for (row, i), segment in itertools.product(enumerate(points), range(3)):
                listed = slice(bins.bins_begin[row, segment], bins.bins_end[row, segment])
                p_noise_stay = -np.expm1(-(beta[i] ** 2) / 2)
                chances = [
                    min(marcum_q1_excess(math.exp(a), beta[i]) / p_noise_stay, 1.0)
                    for a in bins.log_amplitude[listed]
                ]
                bound = groups.raised_bin_probability_max[i, segment]
                any_raised = -np.expm1(np.log1p(-np.minimum(chances, 1 - 1e-16)).sum())
                assert any_raised <= bound * (1 + 1e-4) + 1e-12
                n_bounded += any_raised > 1e-9 and bound < 1.01 * any_raised
    assert n_bounded > 100


@pytest.mark.parametrize("beta", [0.3, 2.0, 4.5, 6.55, 10.0, 25.0, 29.9])
def test_added_crossings_have_their_digits(beta):
    """(Q_1(a, b) - Q_1(0, b)) / (1 - Q_1(0, b)) against 40 digits, up to the threshold."""
    y = beta**2 / 2
    x = y * np.array([1e-30, 1e-12, 1e-6, 1e-3, 0.03, 0.1, 0.2, 0.35, 0.45])
    series, out = np.zeros(SERIES_TERMS_MAX), np.empty(32)
    fill_crossing_series(beta, series)
    scratch = np.zeros(32)
    scratch[: x.size] = x
    fill_added_crossing_probabilities(scratch, x.size, beta, series, out)
    with mpmath.workdps(40):
        for value, actual in zip(x, out, strict=False):
            xm, ym = mpmath.mpf(value), mpmath.mpf(y)
            term, below, total, n = mpmath.e ** (-xm), mpmath.e ** (-ym), mpmath.mpf(0), 0
            power = below
            poisson = below  # sum_{j<=n} e^-y y^j / j!
            while n < 4000:
                n += 1
                term *= xm / n
                power *= ym / n
                poisson += power
                total += term * (poisson - below)
                if n > 20 and term < total * mpmath.mpf(10) ** -38:
                    break
            exact = total / (1 - below)
            assert (
                abs(actual / float(exact) - 1) < 2e-14 + 3e-16 * y
            )  # e^-y itself is good to y eps


def test_many_small_chances_keep_their_digits():
    chances = np.array([1e-300, 1e-20, 3e-17, 1e-9, 0.2, 0.0, 1e-16, 1e-12, 0.5])
    with mpmath.workdps(60):
        exact = 1 - mpmath.fprod(1 - mpmath.mpf(c) for c in chances)
        assert any_crossing_probability(chances, 0, chances.size) == pytest.approx(
            float(exact), rel=1e-15
        )
        few = 1 - mpmath.fprod(1 - mpmath.mpf(c) for c in chances[:4])
        assert any_crossing_probability(chances, 0, 4) == pytest.approx(float(few), rel=1e-15)
        for c in [*chances, 9.9e-5, 1.01e-4]:
            assert crossing_rate(c) == pytest.approx(
                float(-mpmath.log1p(-mpmath.mpf(c))), rel=1e-15
            )
