"""Returns of footprints with one and several surfaces: truth, statistics, flags."""

import dataclasses

import numpy as np
import pytest
from scipy import ndimage, stats
from shot_helpers import DRAWS, is_within_5_sigma, make_point_keys, prepare_single_category

from sweep.model import time_domain_truth, waveform
from sweep.model.detection.echo_detection import BinThresholds, SpeckleMixing
from sweep.model.detection.sub_bin_interpolation import interpolator
from sweep.model.effects.catalogue import DEFAULT_EFFECTS
from sweep.model.evaluation import (
    evaluate,
    evaluate_segments,
    measure_range_velocity,
    prepare_shots,
)
from sweep.model.pointcloud.bin_groups import list_bin_groups
from sweep.model.pointcloud.leaked_peaks import LeakageBins
from sweep.model.pointcloud.pairing import (
    FALSE_ALARM_FLAG,
    MISPAIRED_FLAG,
    MISREAD_FLAG,
    SIDELOBE_FLAG,
    TRUE_RETURN_FLAG,
    UNCONFIRMED_FLAG,
    DopplerPrediction,
)
from sweep.model.pointcloud.returns import (
    DrawConfig,
    DrawInputs,
    DrawWorkspace,
    Peak,
    PeakLists,
    beamlet_line_positions,
    compare_return_with_truth,
    draw_false_peak_bin,
    draw_returns,
    draw_segment_peaks,
    empty_group_speckle,
    noise_maximum_at_probability,
)
from sweep.model.sampling.draws import NoiseFilter, NoiselessSpectra
from sweep.model.sampling.philox import DrawAddress
from sweep.model.sampling.samplers import simulate_draws
from sweep.model.sampling.speckle_lines import SpeckleLineGrid
from sweep.model.window import get_window, window_samples

METHODS = ["probabilities", "noise"]
LIGHT = 299792458.0
RANGE_BIN, VELOCITY_BIN = LIGHT * 600e6 / (4e12 * 2**17), 1550e-9 * 600e6 / 2**18


def _surfaces(table_4_1, ranges, velocities, *, shares=None, spread=0.02, beamlets=12, **changes):
    """One shot over surfaces at these ranges [m] and velocities, spread [m] within each.

    The first is the reference; beamlets are dealt out in turn, their power by ``shares``.
    """
    ranges, velocities = np.array(ranges), np.array(velocities)
    changes = {"phases": "incoherent"} | changes
    shots = prepare_single_category(
        table_4_1(range=ranges[0], radial_velocity=velocities[0], beamlets=beamlets, **changes)
    )
    surface_index = np.arange(beamlets) % len(ranges)
    member = np.arange(beamlets) // len(ranges)
    offset = ranges[surface_index] / ranges[0] - 1 + spread / ranges[0] * (member / beamlets)
    share = np.ones(len(ranges)) if shares is None else np.array(shares)
    return dataclasses.replace(
        shots,
        footprint=shots.footprint._replace(
            relative_range_offset=offset[None],
            doppler_ratio_offset=(2 / LIGHT * (velocities[surface_index] - velocities[0]))[None],
            relative_amplitude=shots.footprint.relative_amplitude[:1]
            * np.sqrt(share[surface_index])[None],
        ),
    )


def _certain(groups, sure=1.0):
    return groups._replace(pd=np.where(np.isnan(groups.pd), np.nan, sure))


def _drawn(shots, groups=None, **keywords):
    groups = list_bin_groups(shots) if groups is None else groups
    return draw_returns(shots, groups, keys=make_point_keys(shots.range.size), **keywords)


# Groups


def test_groups_are_runs_of_bins_above_the_threshold_in_the_true_spectrum(table_4_1):
    """Against the time-domain record, labelled by scipy; a hole of a bin parts two groups."""
    shots = _surfaces(
        table_4_1, [300.0, 420.0, 330.0], [20.0, 20.0, 21.0], shares=[1.0, 0.3, 0.1],
        fft_size=4096, beamlets=6, tnr=4.0,
    )  # fmt: skip
    groups = list_bin_groups(shots, groups_max=8)
    for segment in range(3):
        spectrum = time_domain_truth.time_domain_spectrum(shots, 0, segment, with_range_walk=False)
        label, number = ndimage.label(spectrum >= shots.threshold[0])
        assert number >= (1 if segment == 1 else 2)
        order = np.argsort(-ndimage.maximum(spectrum, label, range(1, number + 1)), kind="stable")
        slices = ndimage.find_objects(label)
        listed = groups.strongest_bin[0, segment] >= 0
        assert listed.sum() == min(number, 8)
        for g, group_index in enumerate(order[:8]):
            run = slices[group_index][0]
            assert groups.first_bin[0, segment, g] == run.start
            assert groups.last_bin[0, segment, g] == run.stop - 1
            peak = run.start + spectrum[run].argmax()
            assert groups.strongest_bin[0, segment, g] == peak
            np.testing.assert_allclose(
                groups.peak_and_neighbour_magnitudes[0, segment, g],
                spectrum[peak - 1 : peak + 2],
                rtol=1e-5,
            )


def test_the_strongest_group_is_what_a_single_detection_finds(table_4_1):
    shots = prepare_single_category(table_4_1(range=np.linspace(500.0, 9000.0, 7), beamlets=19))
    groups, expected = list_bin_groups(shots), evaluate_segments(shots)
    np.testing.assert_array_equal(groups.pd[:, :, 0].T, expected.pd)
    np.testing.assert_array_equal(groups.magnitude[:, :, 0].T, expected.magnitude)
    np.testing.assert_array_equal(
        groups.strongest_bin[:, :, 0].T, np.rint(expected.frequency * 2**17 / 600e6)
    )
    np.testing.assert_array_equal(groups.n_exempt_bins.T, expected.n_exempt)
    np.testing.assert_array_equal(
        groups.leakage_probability.T[[0, 2]], expected.leakage_probability[[0, 2]]
    )
    assert not expected.leakage_probability[
        1
    ].any()  # of the Doppler segment only draws need to know


def test_fewer_groups_listed_are_the_strongest_of_all(table_4_1):
    shots = _surfaces(table_4_1, [300.0, 330.0, 345.0, 360.0], [20.0] * 4, shares=[0.1, 1, 0.3, 2])
    few, many = list_bin_groups(shots, groups_max=2), list_bin_groups(shots, groups_max=12)
    np.testing.assert_array_equal(few.strongest_bin, many.strongest_bin[..., :2])
    strength = many.magnitude[0, 0][many.strongest_bin[0, 0] >= 0]
    assert (np.diff(strength) <= 0).all()


def test_below_the_threshold_the_strongest_bin_is_listed(table_4_1):
    groups = list_bin_groups(
        prepare_single_category(table_4_1(range=9900.0, power=0.001, grazing_angle=0.3))
    )
    assert (groups.strongest_bin[0, :, 0] >= 0).all()
    assert (groups.strongest_bin[0, :, 1:] == -1).all()
    assert (groups.pd[0, :, 0] < 0.1).all()
    np.testing.assert_array_equal(groups.first_bin[..., 0], groups.last_bin[..., 0])


# Without chance


def test_a_flat_plane_reports_what_its_peaks_report(table_4_1):
    shots = prepare_single_category(table_4_1(range=np.linspace(300.0, 3000.0, 50), beamlets=19))
    groups = _certain(list_bin_groups(shots))
    returns, expected = (
        _drawn(shots, groups),
        measure_range_velocity(shots, evaluate_segments(shots)),
    )
    np.testing.assert_array_equal(returns.range[:, 0, 0], expected.range)
    np.testing.assert_array_equal(returns.radial_velocity[:, 0, 0], expected.radial_velocity)
    assert (returns.flags[:, 0, 0] == TRUE_RETURN_FLAG).all()


def test_direct_detection_gives_ranges_without_a_doppler_segment(table_4_1):
    shots = prepare_single_category(
        table_4_1(architecture="direct", range=200.0, power=200.0, radial_velocity=3.0)
    )
    returns = _drawn(shots)
    assert returns.flags[0, 0].tolist() == [TRUE_RETURN_FLAG, 0, 0, 0]
    assert returns.range_interpolated[0, 0, 0] == pytest.approx(200.0, abs=0.5 * RANGE_BIN)
    assert returns.group[0, 0, 0].tolist() == [0, -1, 0]


@pytest.mark.parametrize("order", ["up down", "down up"])
def test_a_triangle_loses_no_return_for_want_of_a_third_segment(order, table_4_1):
    """Two surfaces: the stronger up peak with the stronger down peak, and none unconfirmed."""
    shots = _surfaces(table_4_1, (300.0, 320.0), (1.0, 1.0), shares=(0.8, 0.2), power=0.5)
    shots = dataclasses.replace(
        shots,
        waveform=dataclasses.replace(shots.waveform, segment_order=tuple(order.split())),
    )
    returns = _drawn(shots)
    assert returns.flags[0, 0].tolist() == [TRUE_RETURN_FLAG, TRUE_RETURN_FLAG, 0, 0]
    np.testing.assert_allclose(returns.range[0, 0, :2], [300.0, 320.0], atol=2 * RANGE_BIN)
    np.testing.assert_allclose(returns.radial_velocity[0, 0, :2], 1.0, atol=2 * VELOCITY_BIN)


# Chance


def _weak(table_4_1, n=4, **changes):
    """Points of the middle of pd, in whose segments false alarms are common."""
    return table_4_1(
        range=np.linspace(4000.0, 6500.0, n), beamlets=5, power=0.08, tnr=7.6, grazing_angle=1.2,
        radial_velocity=31.0, phases="incoherent", **changes,
    )  # fmt: skip


@pytest.mark.parametrize("method", METHODS)
def test_true_returns_are_the_very_draws_that_are_counted_as_detected(table_4_1, method):
    """The same random numbers as sweep.model.sampling.draws, and so the same counts exactly.

    A true pair, both peaks found, is lost only where a false peak takes one of them: rarely.
    """
    parameters = _weak(table_4_1) | {"instrument.processing.tnr": 9.0}
    shots = prepare_single_category(parameters)
    counts = simulate_draws(
        parameters,
        DEFAULT_EFFECTS,
        keys=make_point_keys(4),
        first_draw=3,
        batch_sizes=[2000],
        method=method,
    )
    returns = _drawn(shots, first_draw=3, draws=2000, method=method)
    both_detected = (returns.group[..., 0] == 0) & (returns.group[..., 2] == 0)
    np.testing.assert_array_equal(both_detected.any(2).sum(1), counts["n_detected_shot"][:, 0])
    out = evaluate(parameters)
    expected = np.broadcast_to((out["pd_up"] * out["pd_down"])[:, None, None], both_detected.shape)
    np.testing.assert_allclose(returns.pd[both_detected], expected[both_detected])
    assert (np.abs(out["pd_up"] - out["pd_down"]) > 1e-3).any()
    middling = counts["n_detected_shot"]
    assert ((middling > 200) & (middling < 1800)).sum() >= 2


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("law", [{}, {"detection": "any_bin", "noise_bins": "correlated"}])
def test_dropouts_and_false_alarms_have_their_probabilities(table_4_1, method, law):
    """Peaks pair one to one, so there are min(up, down) returns, of 0..2 peaks in each list.

    With chances p of the true and a of the false peak, both in up and down and independent:
    returns 2 in p a p a, and so on; confirmed by the true Doppler peak where that is there.
    """
    parameters = _weak(table_4_1, **law)
    shots = prepare_single_category(parameters)
    out = evaluate(parameters)
    returns = _drawn(shots, draws=DRAWS, method=method)
    alarm = [
        1 - (1 - out["pfa_segment"]) * (1 - out["p_leakage_up"]),
        1 - (1 - 10 ** (out["log10_pfa_both_chirps"] - out["log10_pfa_segment"]))
        * (1 - out["p_leakage_down"]),
    ]  # fmt: skip
    assert ((alarm[0] > 0.02) & (alarm[0] < 0.5)).all()
    none, two = [], []
    for pd, a in zip((out["pd_up"], out["pd_down"]), alarm, strict=True):
        none.append((1 - pd) * (1 - a))
        two.append(pd * a)
    number = (returns.flags > 0).sum(2)
    assert is_within_5_sigma((number >= 1).sum(1), (1 - none[0]) * (1 - none[1])).all()
    assert is_within_5_sigma((number == 2).sum(1), two[0] * two[1]).all()
    # readings by chance (1e-3 of the false peaks) take a true peak from its partner
    both_detected = ((returns.group[..., 0] == 0) & (returns.group[..., 2] == 0)).any(2)
    slack = 3e-3 * DRAWS * alarm[0]
    expected = DRAWS * out["pd_up"] * out["pd_down"]
    spread = np.sqrt(expected * (1 - expected / DRAWS))
    assert (np.abs(both_detected.sum(1) - expected) < 5 * spread + slack).all()
    confirmed = (returns.flags == TRUE_RETURN_FLAG).any(2).sum(1)
    expected = expected * out["pd_doppler"]
    assert (np.abs(confirmed - expected) < 5 * np.sqrt(expected) + slack).all()
    false = (returns.flags & FALSE_ALARM_FLAG > 0).any(2).sum(1)
    expected = DRAWS * ((1 - none[0]) * (1 - none[1]) - out["pd_up"] * out["pd_down"])
    expected = expected + DRAWS * two[0] * two[1]
    assert (np.abs(false - expected) < 5 * np.sqrt(expected) + slack).all()


BARRED = np.array([7, 8, 9, 12, 20, 40, 41, 63, 64, 70])


def test_false_peaks_fall_on_every_free_bin_alike():
    """All chances of a fine comb: each free bin as often as any, groups and barred bins never."""
    half = 64
    for spans in ([(10, 14), (16, 17), (0, 1)], [(62, 64)], [(1, 1), (3, 3), (5, 5), (63, 63)]):
        bins = np.full((3, 4), -1)
        for g, (first, last) in enumerate(spans):
            bins[:, g] = first, first, last
        occupied_bins = {k for first, last in spans for k in range(first - 1, last + 2)}
        free = sorted(set(range(1, half + 1)) - occupied_bins - set(BARRED.tolist()))
        chances = (np.arange(20 * len(free)) + 0.5) / (20 * len(free))
        places, counts = np.unique(
            [draw_false_peak_bin(u, *bins, BARRED, 1, half, 2 * half, False) for u in chances],
            return_counts=True,
        )
        assert places.tolist() == free
        assert (counts == 20).all()


def test_the_largest_of_many_noise_bins_has_its_order_statistic():
    """P(max > x) = 1 - (1 - exp(-x^2/2))^n, by scipy's Rayleigh distribution; Gamma's in looks."""
    for chance in (1e-9, 0.01, 0.7):
        for n in (1.0, 100.0, 65000.0):
            x = noise_maximum_at_probability(n, chance, 1)
            assert -np.expm1(n * stats.rayleigh.logcdf(x)) == pytest.approx(chance, rel=1e-9)
            below = stats.gamma.logcdf(4 * noise_maximum_at_probability(n, chance, 8) ** 2, 8)
            assert -np.expm1(n * below) == pytest.approx(chance, rel=1e-9)


NO_LINES = SpeckleLineGrid(
    *np.zeros((2, 0, 3, 2)), np.zeros((0, 2), np.int64), np.zeros(0, np.int64), np.ones((1, 1)),
    np.ones((1, 1)), np.ones(1, np.int64), np.ones(2), 1.0, 1.0, 0,
)  # fmt: skip
"""Lines of points whose echoes do not fade."""


def _up_in_noise(centre, magnitude, levels, tables, half, *, low=0, n_noise_bins=0.0, alarm=0.0):
    """Draws of the up-chirp segment of one point: from number to strongest peak, or None.

    `magnitude` is |X| of the bin below the strongest, of the strongest, and of that above.
    """
    rule = NoiseFilter(np.empty((0, 17)), np.empty(0, np.int64), 0)
    config = DrawConfig(
        0,
        True,
        True,
        True,
        half,
        0.0,
        0,
        0,
        0,
        rule,
        np.zeros((0, 0)),
        rule,
        np.empty(0),
        1,
        False,
        0,
    )
    noise_sigma, threshold_ratio, line_noise_ratio = np.array(levels)[:, None]
    below, strongest, above = magnitude
    known = DrawInputs(
        strongest_bin=np.full((1, 3, 1), centre),
        first_bin=np.full((1, 3, 1), centre),
        last_bin=np.full((1, 3, 1), centre),
        pd=np.ones((1, 3, 1)),
        magnitude_below=np.full((1, 3, 1), below),
        magnitude=np.full((1, 3, 1), strongest),
        magnitude_above=np.full((1, 3, 1), above),
        line_deviation_bins=np.zeros((1, 3, 1)),
        line_positions=np.zeros((1, 3, 1)),
        beamlet_amplitude=np.ones((1, 1)),
        noise_sigma=noise_sigma,
        threshold_ratio=threshold_ratio,
        line_noise_ratio=line_noise_ratio,
        bin_thresholds=BinThresholds(*np.zeros((7, 1))),
        pfa_noise=np.full((1, 3), alarm),
        doppler_prediction=DopplerPrediction(*np.ones((3, 1))),
        down_pd_if_up_missed=np.ones((1, 1)),
        down_pd_if_up_detected=np.ones((1, 1)),
        first_searched_bin=np.full((1, 3), 1),
        last_searched_bin=np.full((1, 3), half),
        line_grid=NO_LINES,
        line_centre=np.zeros((1, 3, 1)),
        echo_fraction=np.zeros((1, 3, 1)),
        n_independent_bins=np.ones((1, 3, 1)),
        speckle_mixing=SpeckleMixing(*np.zeros((6, 1))),
        look_covariance_root=np.zeros((1, 3, 1, 0), complex),
    )
    spectra = NoiselessSpectra.empty(1)._replace(
        first_bin=np.full((1, 3), low), n_noise_bins=np.full((1, 3), n_noise_bins)
    )
    lists = PeakLists.allocate(2)
    (key,) = make_point_keys(1)

    def draw_peak(number):
        draw_segment_peaks(
            DrawAddress(*key, number),
            0,
            0,
            config,
            known,
            spectra,
            LeakageBins.empty(1),
            np.ones((1, 3)),
            empty_group_speckle(1),
            tables,
            DrawWorkspace.allocate(3, 1),
            lists,
            np.zeros(1, bool),
        )
        return Peak(*(values[0, 0] for values in lists.peaks)) if lists.n_peaks[0] else None

    return draw_peak


def test_noise_alone_has_its_largest_peak_where_and_as_large_as_it_should():
    """Kolmogorov and Smirnov against the order statistic and the uniform distribution.

    A true hypothesis gives a p-value below 1e-6 once in a million seeds.
    """
    beta, half, n = 3.0, 2000, 1900.0
    one = np.exp(-(beta**2) / 2)
    noise = _up_in_noise(
        -1,
        np.full(3, np.nan),
        (1.0, beta, 1.0),
        interpolator(get_window("hann", 4000), 4000),
        half,
        n_noise_bins=n,
        alarm=-np.expm1(n * np.log1p(-one)),
    )
    drawn = [peak for peak in map(noise, range(4000)) if peak is not None]
    quiet = stats.rayleigh.cdf(beta) ** n
    assert abs(len(drawn) - 4000 * (1 - quiet)) < 5 * np.sqrt(4000 * quiet) + 1

    def largest(x):
        return (stats.rayleigh.cdf(x) ** n - quiet) / (1 - quiet)

    ratios, bins = [peak.magnitude_ratio for peak in drawn], [peak.bin for peak in drawn]
    assert stats.kstest(ratios, largest).pvalue > 1e-6
    assert stats.kstest(bins, stats.uniform(0.5, half).cdf).pvalue > 1e-6


def test_noise_moves_the_largest_bin_as_often_as_in_the_time_domain():
    """A tone 0.47 bins past its bin, in white noise of a twentieth, Hann window of 64 samples."""
    length, delta, ratio = 64, 0.47, 20.0
    shape = get_window("hann", length)
    n = np.arange(length)
    basis = (
        window_samples("hann", length) * np.exp(-2j * np.pi * np.outer([15, 16, 17], n) / length)
    ).T
    tone = np.exp(2j * np.pi * (16 + delta) * n / length)
    sigma = shape.sum / ratio
    noise = np.random.default_rng(4).standard_normal((DRAWS, 2 * length)).view(complex)
    bins = np.abs((tone + sigma / np.sqrt(shape.energy) * noise) @ basis)
    expected = np.mean(bins.argmax(axis=1) == 2)
    noise = _up_in_noise(
        16, np.abs(tone @ basis), (sigma, 5.0, 1.0), interpolator(shape, length), 32, low=14
    )
    moved = sum(noise(d).bin == 17 for d in range(DRAWS))
    assert 0.1 < expected < 0.4
    assert abs(moved / DRAWS - expected) < 5 * np.sqrt(2 * expected * (1 - expected) / DRAWS)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("name", ["hann", "hamming"])
def test_interpolated_errors_are_those_reported(table_4_1, method, name):
    """Normal to first order at 33 dB: 5 sigma of a deviation of 20,000 is 2.5 %; and 1/64 more.

    Ranges run through the bin, so that the errors are of all places between bins.
    """
    shots = prepare_single_category(
        table_4_1(
            range=1000 + RANGE_BIN * np.linspace(0, 1, 20, endpoint=False), window=name,
            radial_velocity=9.0, beamlets=1, power=0.5, phases="incoherent",
        )
    )  # fmt: skip
    returns = _drawn(shots, draws=1000, method=method)
    assert (returns.flags[..., 0] == TRUE_RETURN_FLAG).all()
    assert 2 * returns.snr[..., 0].mean() == pytest.approx(64**2, rel=0.4)
    for quantity, expected in (
        ("range", shots.range),
        ("radial_velocity", shots.target.radial_velocity),
    ):
        interpolated = getattr(returns, f"{quantity}_interpolated")[..., 0]
        reported = getattr(returns, f"{quantity}_interpolated_standard_error")[..., 0]
        deviation = (interpolated - expected[:, None]) / reported
        assert np.sqrt(np.mean(deviation**2)) == pytest.approx(1.0, abs=0.041)
        whole_bins = getattr(returns, quantity)[..., 0]
        coarse = getattr(returns, f"{quantity}_standard_error")[..., 0]
        width = RANGE_BIN if quantity == "range" else VELOCITY_BIN
        assert (coarse > reported).all()
        assert coarse.min() >= 0.999 * width / np.sqrt(24)
        assert (np.abs(whole_bins - expected[:, None]) < 1.1 * width).all()


@pytest.mark.parametrize(("velocity", "delay"), [(55.0, 0.0), (-55.0, 0.0), (30.0, 1e-4)])
def test_interpolated_ranges_of_moving_ground_are_those_at_the_beginning(
    table_4_1, velocity, delay
):
    """The record's middle shows 12 mm less at 55 m/s closing, and more after a delay."""
    parameters = table_4_1(
        range=1000 + RANGE_BIN * np.linspace(0, 1, 20, endpoint=False), window="hann",
        radial_velocity=velocity, beamlets=1, power=5.0, phases="incoherent",
        acquisition_delay=delay,
    )  # fmt: skip
    walking, steady_effects = (*DEFAULT_EFFECTS, "range_walk"), DEFAULT_EFFECTS
    for effects in (walking, steady_effects):
        ((_, shots),) = prepare_shots(parameters, effects)
        returns = _drawn(shots, draws=200, method="noise")
        assert (returns.flags[..., 0] == TRUE_RETURN_FLAG).all()
        errors = returns.range_interpolated[..., 0] - shots.range[:, None]
        stated_error = returns.range_interpolated_standard_error[..., 0]
        assert abs(errors.mean()) < 5 * stated_error.mean() / np.sqrt(errors.size) + 5e-5
    uncorrected = abs(velocity) * (2 * delay + 2**17 / 600e6)
    assert uncorrected > 0.01 > 20 * stated_error.mean() / np.sqrt(errors.size)


@pytest.mark.parametrize("phases", ["incoherent", "coherent"])
def test_reported_errors_hold_for_a_footprint_that_spreads(table_4_1, phases):
    """A slope of 20 deg: a tenth of a bin of spread, against noise of a few thousandths.

    Places between bins are moved by an amount that the place decides on: the stated error is
    its size, so the mean square of errors over stated ones is near 1 over all places. Lines that
    add as amplitudes may cancel, and then lie anywhere: about 1 again, with larger outliers.
    """
    shots = prepare_single_category(
        table_4_1(
            range=1000 + RANGE_BIN * np.linspace(0, 1, 200, endpoint=False), window="hann",
            radial_velocity=9.0, beamlets=61, power=50.0, grazing_angle=np.radians(20.0),
            phases=phases,
        )
    )  # fmt: skip
    returns = _drawn(shots, draws=1)
    good = returns.flags[..., 0] == TRUE_RETURN_FLAG
    error = (returns.range_interpolated[..., 0] - shots.range[:, None])[good]
    stated_error = returns.range_interpolated_standard_error[..., 0][good]
    assert good.mean() > 0.9
    high = 1.5 if phases == "incoherent" else 2.5
    assert 0.5 < np.sqrt(np.mean((error / stated_error) ** 2)) < high
    noise_alone = RANGE_BIN / np.sqrt(2 * np.median(returns.snr[..., 0][good]))
    assert np.median(stated_error) > 2 * noise_alone / np.sqrt(2)


def test_beamlets_appear_where_their_beats_fold_to(table_4_1):
    shots = prepare_single_category(
        table_4_1(range=8000.0, radial_velocity=-170.0, beamlets=7, grazing_angle=0.3)
    )
    shots = dataclasses.replace(
        shots,
        footprint=shots.footprint._replace(doppler_ratio_offset=np.linspace(-1e-9, 1e-9, 7)[None]),
    )
    velocity = -170.0 + shots.footprint.doppler_ratio_offset[0] * LIGHT / 2
    lines = beamlet_line_positions(shots)[0]
    for s, (sign, carrier) in enumerate(zip((1, 0, -1), shots.waveform.carriers, strict=True)):
        beats = waveform.beat_frequency(
            sign,
            carrier=carrier,
            chirp_rate=2e12,
            range=8000.0 * (1 + shots.footprint.relative_range_offset[0]),
            radial_velocity=velocity,
        )
        expected = waveform.fold_frequency(beats, np.array(600e6)) / 600e6 * 2**17
        np.testing.assert_allclose(lines[s], expected, atol=1e-6)
    assert np.ptp(lines[0]) > 0.1


# Flags


def test_the_common_beamlet_lies_in_all_groups_and_nearest_to_the_peaks():
    lines = np.array([[10.0, 11.0, 50.0], [5.0, 5.0, 5.0], [30.0, 31.0, 70.0]])
    # First and last bin of two groups in each segment.
    bins = np.array([[[9, 9], [4, 4], [29, 69]], [[12, 12], [6, 6], [32, 71]]])
    nowhere = bins + np.array([0, 0, 20])[:, None]
    centres, all_three = np.array([10.9, 5.0, 31.2]), np.zeros(3, np.int8)
    lit, dim = np.ones(3), np.array([1.0, 0.0, 1.0])
    assert compare_return_with_truth(all_three, centres, *bins, lines, lit) == (TRUE_RETURN_FLAG, 1)
    assert compare_return_with_truth(all_three, centres, *bins, lines, dim) == (TRUE_RETURN_FLAG, 0)
    separate = np.array([0, 0, 1], np.int8)
    assert compare_return_with_truth(separate, centres, *bins, lines, lit) == (MISPAIRED_FLAG, -1)
    assert compare_return_with_truth(all_three, centres, *nowhere, lines, lit) == (
        SIDELOBE_FLAG,
        -1,
    )
    no_doppler, noise = np.array([0, -2, 0], np.int8), np.array([0, 0, -1], np.int8)
    assert compare_return_with_truth(no_doppler, centres, *bins, lines, lit) == (
        TRUE_RETURN_FLAG,
        1,
    )
    assert compare_return_with_truth(noise, centres, *bins, lines, lit) == (FALSE_ALARM_FLAG, -1)


def _only(groups, present):
    """Groups detected or not by hand: {(segment, group): pd}."""
    pd = groups.pd.copy()
    for (segment, g), chance in present.items():
        pd[:, segment, g] = chance
    return groups._replace(pd=pd)


def test_peaks_of_two_surfaces_make_a_mispaired_return(table_4_1):
    shots = _surfaces(table_4_1, [400.0, 412.0], [12.0, 12.0], shares=[1.0, 0.6])
    groups = _only(_certain(list_bin_groups(shots)), {(0, 1): 0.0, (2, 0): 0.0})
    returns = _drawn(shots, groups)
    assert returns.flags[0, 0].tolist() == [MISPAIRED_FLAG | UNCONFIRMED_FLAG, 0, 0, 0]
    assert returns.group[0, 0, 0].tolist() == [0, -1, 1]
    assert returns.beamlet[0, 0, 0] == -1


@pytest.mark.parametrize("two_beats", [waveform.FAR_TARGET, waveform.FAST_TARGET])
def test_a_pair_without_its_doppler_peak_is_read_as_two_beats_are(table_4_1, two_beats):
    """Range and velocity of the other target are exchanged, and flagged."""
    for velocity, kind in ((2.0, waveform.FAR_TARGET), (60.0, waveform.FAST_TARGET)):
        shots = _surfaces(table_4_1, [400.0], [velocity])
        shots = dataclasses.replace(
            shots,
            detection_settings=shots.detection_settings._replace(two_beat_assumption=two_beats),
        )
        kind = TRUE_RETURN_FLAG if kind == two_beats else MISREAD_FLAG
        groups = _only(_certain(list_bin_groups(shots)), {(1, g): 0.0 for g in range(4)})
        returns = _drawn(shots, groups)
        assert returns.flags[0, 0, 0] == kind | UNCONFIRMED_FLAG
        assert returns.beamlet[0, 0, 0] >= 0


def test_sidelobes_above_the_threshold_are_flagged(table_4_1):
    """A rectangular window half-way between bins: sidelobes every bin, cut by the bright target.

    Nulls part the sidelobes of a tone in a padded FFT into groups of their own.
    """
    shots = _surfaces(
        table_4_1, [400.0], [12.0], window="rectangular", beamlets=1, sample_rate=200e6,
        detector_bandwidth=4e8,
    )  # fmt: skip
    assert shots.window.length < shots.fft_size
    shots = dataclasses.replace(  # false peaks may pair with the true ones
        shots,
        detection_settings=shots.detection_settings._replace(leakage_raises_false_alarms=False),
    )
    returns = _drawn(shots, _certain(list_bin_groups(shots)))
    assert returns.flags[0, 0, 0] == TRUE_RETURN_FLAG
    assert (returns.flags[0, 0, 1:] & SIDELOBE_FLAG > 0).all()


def test_surfaces_merged_in_one_group_are_one_true_return(table_4_1):
    shots = _surfaces(table_4_1, [400.0, 400.3], [12.0, 12.0])
    returns = _drawn(shots)
    assert returns.flags[0, 0].tolist() == [TRUE_RETURN_FLAG, 0, 0, 0]
    assert 399.8 < returns.range[0, 0, 0] < 400.5
