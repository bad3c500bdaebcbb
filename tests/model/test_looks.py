"""Looks: closed forms against draws and outside values; whole spectra, motion, exact records."""

from functools import partial

import numpy as np
import pytest
from drawn_leakage import drawn_leakage
from scipy import special, stats
from shot_helpers import make_point_keys, parametrize_product

from sweep.analysis.shot_spectra import simulate_shot
from sweep.model import time_domain_truth, window
from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.detection import bin_noise
from sweep.model.detection.added_crossings import exclude_crossings_joining_echo
from sweep.model.detection.echo_detection import RAYLEIGH_DEVIATION
from sweep.model.detection.estimators import ESTIMATOR_PREFIX
from sweep.model.detection.looks import (
    LOOKS_COMBINE_PATH,
    LOOKS_NUMBER_PATH,
    LOOKS_SPECKLE_PATH,
    LOOKS_VOTES_PATH,
    Looks,
    coherent_amplitude_factor,
)
from sweep.model.detection.marcum import at_least_one_probability, marcum_q1
from sweep.model.evaluation import evaluate, evaluate_segments, prepare_shots
from sweep.model.laser_line import apparent_line_and_pedestal_power, pure_line_power_fraction
from sweep.model.sampling.samplers import simulate_draws
from sweep.model.spectrum.segment_spectra import segment_spectrum
from sweep.model.threshold import DESIGN_PFA_BIN_PATH, DESIGN_PFA_SEGMENT_PATH, tnr_from_parameters
from sweep.model.unsupported_shot import UnsupportedShotError

DRAWS, PIECE = 200_000, 50_000
BIN = 0.5e6
ON_A_BIN = 100 * BIN / 1e14 * SPEED_OF_LIGHT / 2
"""Range [m] whose beat is bin 100 of a chirp of 1 GHz in 10 us."""


def amplitudes(rng, *size):
    """Standard circular complex normal numbers."""
    return (rng.normal(size=size) + 1j * rng.normal(size=size)) / np.sqrt(2)


def drawn_detections(looks, speckle, signals, level, correlation=1.0):
    """Share of draws in which each of two segments is detected, and both are."""
    rng, magnitudes = (
        np.random.default_rng([looks.number, len(looks.combine_kind), len(speckle)]),
        [],
    )
    n_speckles = looks.number if looks.has_independent_speckle else 1
    for _ in range(DRAWS // PIECE):
        first = amplitudes(rng, PIECE, n_speckles)
        second = correlation * first + np.sqrt(1 - correlation**2) * amplitudes(
            rng, PIECE, n_speckles
        )
        pair = (1.0, 1.0) if speckle == "steady" else (first, second)
        power = [
            np.abs(a * z + np.sqrt(2) * amplitudes(rng, PIECE, looks.number)) ** 2
            for a, z in zip(signals, pair, strict=True)
        ]
        if looks.combine_kind == "binary":
            magnitudes.append([(p >= level**2).sum(axis=1) >= looks.votes_needed for p in power])
        else:
            magnitudes.append([p.mean(axis=1) >= level**2 for p in power])
    up, down = np.concatenate(magnitudes, axis=1)
    return up.mean(), down.mean(), (up & down).mean()


@pytest.mark.parametrize("speckle", ["steady", "independent", "common"])
@pytest.mark.parametrize(
    ("number", "combine", "votes"),
    [(2, "power", 1), (8, "power", 1), (2, "binary", 1), (8, "binary", 3),
     pytest.param(32, "power", 1, marks=pytest.mark.slow),
     pytest.param(32, "binary", 12, marks=pytest.mark.slow)],
)  # fmt: skip
def test_closed_forms_are_the_mean_over_draws(number, combine, votes, speckle):
    looks = Looks(number, combine, votes, speckle == "independent")
    one, other = signals = (1.6, 1.3)
    level = np.array(2.0)
    law = looks.pd_and_miss_steady if speckle == "steady" else looks.pd_and_miss_in_speckle
    expected = [float(law(np.array(a), level)[0]) for a in signals]
    together = expected[0] * expected[1]
    if speckle != "steady":
        together = float(looks.joint_pd_in_speckle(one, other, level, np.array(1.0)))
    for share, chance in zip(
        drawn_detections(looks, speckle, signals, level), [*expected, together], strict=True
    ):
        assert abs(share - chance) < 5 * np.sqrt(chance * (1 - chance) / DRAWS)
    for a in signals:
        pd, missed = law(np.array(a), level)
        assert pd + missed == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize("is_independent", [True, False])
def test_segments_that_share_part_of_their_speckle(is_independent):
    """Exact where looks fade apart; else within 0.01, between what is shared wholly and not."""
    looks, level, signals = (
        Looks(8, has_independent_speckle=is_independent),
        np.array(2.6),
        (2.0, 1.6),
    )
    expected = float(looks.joint_pd_in_speckle(*signals, level, np.array(0.8)))
    share = drawn_detections(looks, "part", signals, level, correlation=0.8)[2]
    assert abs(share - expected) < 5 * np.sqrt(expected / DRAWS) + (0.0 if is_independent else 0.01)
    up, down = (looks.pd_and_miss_in_speckle(np.array(a), level)[0] for a in signals)
    product = looks.joint_pd_in_speckle(*signals, level, np.array(0.0))
    assert float(product) == pytest.approx(float(up * down), rel=1e-6)


def test_one_look_is_marcums_q_and_swerlings_first_case():
    signal, level = np.linspace(0, 8, 9), np.full(9, 4.0)
    for looks in (Looks(), Looks(9, "coherent")):
        np.testing.assert_array_equal(
            looks.pd_and_miss_steady(signal, level), marcum_q1(signal, level)
        )
        np.testing.assert_array_equal(
            looks.pd_and_miss_in_speckle(signal, level)[0], np.exp(-(level**2) / (2 + signal**2))
        )
        np.testing.assert_array_equal(looks.log_pfa(level), -(level**2) / 2)


@pytest.mark.parametrize(
    ("number", "signal", "level"), [(2, 0.0, 6.0), (8, 1.5, 6.0), (32, 3.0, 6.5), (8, 9.0, 4.0)]
)
def test_deep_tails_keep_their_digits(number, signal, level):
    """Poisson's mixture of incomplete Gamma functions in 60 digits, by mpmath."""
    mpmath = pytest.importorskip("mpmath")
    with mpmath.workdps(120):
        x, y = number * mpmath.mpf(signal) ** 2 / 2, number * mpmath.mpf(level) ** 2 / 2
        exact = sum(
            mpmath.exp(-x) * x**j / mpmath.factorial(j)
            * mpmath.gammainc(number + j, y, mpmath.inf, regularized=True)
            for j in range(900)
        )  # fmt: skip
    pd, missed = Looks(number).pd_and_miss_steady(np.array(signal), np.array(level))
    if exact < 0.5:
        assert float(pd) == pytest.approx(float(exact), rel=1e-10)
    else:
        assert float(missed) == pytest.approx(float(1 - exact), rel=1e-10)


def test_alarms_and_thresholds_are_those_of_gamma_and_binomial_laws():
    level = np.array([0.3, 1.2, 1.5, 3.0, 5.0])
    power = special.gammaincc(8, 4 * level**2)
    np.testing.assert_allclose(np.exp(Looks(8).log_pfa(level)), power, rtol=1e-12)
    votes = stats.binom.sf(2, 8, np.exp(-(level**2) / 2))
    binary = Looks(8, "binary", 3)
    np.testing.assert_allclose(np.exp(binary.log_pfa(level)), votes, rtol=1e-12)
    far = Looks(32).log_pfa(np.array(20.0))  # ln (6400^31 / 31! (1 + 31 / 6400 + ..)) - 6400
    terms = np.cumsum([0.0, *(np.log((32 - k) / 6400) for k in range(1, 32))])
    expected = 31 * np.log(6400) - special.gammaln(32) + np.log(np.exp(terms).sum()) - 6400
    assert float(far) == pytest.approx(expected, rel=1e-13)
    for chance in (0.3, 1e-6, 1e-200):
        for looks in (Looks(8), Looks(200)):
            y = looks.threshold_ratio_from_log_pfa(np.log(chance)) ** 2 / 2 * looks.number
            assert float(y) == pytest.approx(special.gammainccinv(looks.number, chance), rel=1e-12)
    for chance in (0.3, 1e-6, 1e-100):
        p = special.betaincinv(3, 6, chance)
        assert float(binary.threshold_ratio_from_log_pfa(np.log(chance))) == pytest.approx(
            np.sqrt(-2 * np.log(p))
        )


@pytest.mark.parametrize("looks", [Looks(8), Looks(8, "binary", 3)], ids=lambda it: it.combine_kind)
def test_alarms_of_correlated_bins_are_those_of_drawn_records(looks):
    """Hamming, 1024 bins, twice padded: 5 sigma of 4000 segments, and the 3 % of one look."""
    rng, length, level = (
        np.random.default_rng(7),
        512,
        looks.threshold_ratio_from_log_pfa(np.log(2e-3)),
    )
    taper = window.window_samples("hamming", length)
    sigma = np.sqrt((taper**2).sum() / 2)
    n_alarms, number = 0, 4000
    for _ in range(number):
        records = rng.normal(size=(looks.number, length)) * taper
        power = np.abs(np.fft.rfft(records, 1024)[:, 16:496]) ** 2
        if looks.combine_kind == "binary":
            n_alarms += ((power >= (level * sigma) ** 2).sum(axis=0) >= looks.votes_needed).any()
        else:
            n_alarms += (power.mean(axis=0) >= (level * sigma) ** 2).any()
    correlation = bin_noise.neighbour_noise_correlation(window.get_window("hamming", length), 1024)
    bins = bin_noise.n_alarm_equivalent_bins(
        480, threshold_ratio=level, correlation=correlation, looks=looks
    )
    expected = float(at_least_one_probability(2e-3, bins))
    assert bins < 400
    error = 5 * np.sqrt(expected * (1 - expected) / number)
    assert n_alarms / number == pytest.approx(expected, abs=error + 0.03 * expected)


def instrument(**changes):
    """Table 4.1 in chirps of 10 us with a lone line on a bin, which no neighbour shows."""
    return {
        "instrument.chirp.duration": 10e-6, "instrument.chirp.segments": "up down",
        "instrument.processing.sample_rate": 512e6, "instrument.processing.fft_size": 1024,
        "instrument.processing.window": "rectangular",
        "instrument.processing.noise_bins": "correlated",
        "target.range": np.array([ON_A_BIN]), "target.radial_velocity": 0.0,
        "footprint.beamlets": 1, "footprint.phases": "incoherent", DESIGN_PFA_BIN_PATH: 1e-5,
    } | changes  # fmt: skip


@pytest.fixture
def scene(table_4_1):
    base = {path: v for path, v in table_4_1().items() if path != "instrument.processing.tnr"}
    return lambda **changes: base | instrument() | changes


def dimmed(parameters, effects, pd):
    """The same with as little light as gives about a probability of detection."""
    powers = np.geomspace(1e-7, 1e2, 300)
    tried = parameters | {"instrument.laser.power": powers, "target.range": ON_A_BIN}
    dimmed_pd = evaluate(tried, effects)["pd_up"]
    return parameters | {"instrument.laser.power": float(np.interp(pd, dimmed_pd, powers))}


LOOKS = {
    "steady powers": ({LOOKS_NUMBER_PATH: 4}, ()),
    "common speckle": ({LOOKS_NUMBER_PATH: 4}, ("fading",)),
    "speckle apart": ({LOOKS_NUMBER_PATH: 4, LOOKS_SPECKLE_PATH: "independent"}, ("fading",)),
    "speckle in part": (
        {LOOKS_NUMBER_PATH: 4, "target.transverse_velocity": 300.0},
        ("doppler_spread", "fading"),
    ),
    "votes": ({LOOKS_NUMBER_PATH: 5, LOOKS_COMBINE_PATH: "binary", LOOKS_VOTES_PATH: 2}, ()),
    "votes apart": (
        {
            LOOKS_NUMBER_PATH: 5,
            LOOKS_COMBINE_PATH: "binary",
            LOOKS_VOTES_PATH: 2,
            LOOKS_SPECKLE_PATH: "independent",
        },
        ("fading",),
    ),
    "votes together": (
        {LOOKS_NUMBER_PATH: 5, LOOKS_COMBINE_PATH: "binary", LOOKS_VOTES_PATH: 2},
        ("fading",),
    ),
    "amplitudes": ({LOOKS_NUMBER_PATH: 8, LOOKS_COMBINE_PATH: "coherent"}, ("fading",)),
}


@pytest.mark.parametrize("name", parametrize_product(3, LOOKS))
def test_whole_spectra_are_detected_as_often_as_the_closed_form_says(scene, name):
    changes, effects = LOOKS[name]
    parameters = dimmed(scene(**changes), ("image", *effects), 0.6)
    expected, number = evaluate(parameters, ("image", *effects)), 600
    results = simulate_draws(
        parameters,
        ("image", *effects),
        keys=make_point_keys(1),
        batch_sizes=[number],
        method="spectra",
    )
    for output_name in ("pd_up", "pd_down", "pd_shot"):
        p = expected[output_name][0]
        assert 0.2 < p < 0.9
        assert results[output_name][0] == pytest.approx(p, abs=5 * np.sqrt(p * (1 - p) / number))
    searched = 2 * 509 * number  # bins of both segments
    assert results["pfa_bin"][0] == pytest.approx(1e-5, abs=5 * np.sqrt(1e-5 / searched))
    np.testing.assert_allclose(expected["pfa_bin"], 1e-5, rtol=1e-9)


def test_the_threshold_of_a_segment_holds_its_alarms(scene):
    base = {path: v for path, v in scene().items() if path != DESIGN_PFA_BIN_PATH}
    for changes in (
        {LOOKS_NUMBER_PATH: 8},
        {LOOKS_NUMBER_PATH: 8, LOOKS_COMBINE_PATH: "binary", LOOKS_VOTES_PATH: 4},
    ):
        parameters = (
            base
            | changes
            | {DESIGN_PFA_SEGMENT_PATH: 0.2, "instrument.processing.window": "hamming"}
        )
        parameters |= {"target.reflectance": 1e-12}
        results = simulate_draws(
            parameters, (), keys=make_point_keys(1), batch_sizes=[600], method="spectra"
        )
        share = results["n_false_alarm_up"].sum() / 600
        assert share == pytest.approx(0.2, abs=5 * np.sqrt(0.16 / 600) + 0.03 * 0.2)


def test_estimates_err_by_the_root_of_the_number_of_looks_less(scene):
    quiet = scene(**{ESTIMATOR_PREFIX + "kind": "chirp_z", "instrument.laser.power": 1e-3})
    deviations = {}
    for number in (1, 16):
        parameters = quiet | {LOOKS_NUMBER_PATH: number}
        deviations[number] = simulate_draws(
            parameters, ("image",), keys=make_point_keys(1), batch_sizes=[250], method="spectra"
        )
    one, many = (deviations[number] for number in (1, 16))
    assert one["range_bound"] == pytest.approx(4 * many["range_bound"], rel=1e-12)
    for deviation in (one, many):
        ratio = deviation["range_rmse"] / deviation["range_bound"]
        assert ratio == pytest.approx(1.0, abs=5 / np.sqrt(2 * 250) + 0.02)


def test_acceleration_costs_coherent_looks_what_exact_records_lose(scene):
    """Records by the exact delay, look by look, their phases' best straight line taken off."""
    parameters = scene(
        **{LOOKS_NUMBER_PATH: 8, LOOKS_COMBINE_PATH: "coherent", "target.acceleration": 80.0}
    )
    ((_, shots),) = prepare_shots(parameters, ("segment_motion", "image"))
    bins = np.exp(-2j * np.pi * 100 * np.arange(1024) / 1024)
    record = partial(
        time_domain_truth.beamlet_analytic_signal,
        point=0,
        segment=0,
        beamlet=0,
        with_acceleration=True,
    )
    sums = np.array([(record(look) * bins).sum() for look in shots.split_by_look()])
    place = np.arange(8) - 3.5
    phase = np.unwrap(np.angle(sums))
    turned = sums * np.exp(-1j * np.polyfit(place, phase, 1)[0] * place)
    lost = np.abs(turned.mean()) / np.abs(sums).mean()
    expected = coherent_amplitude_factor(
        Looks(8, "coherent"), acceleration=np.array(80.0),
        carrier=np.asarray(shots.waveform.carriers[0]), look_period=np.array(20e-6),
    )  # fmt: skip
    assert 0.5 < expected < 0.9
    assert float(expected) == pytest.approx(lost, rel=2e-3)
    magnitude = {
        effects: evaluate_segments(next(prepare_shots(parameters, effects))[1]).magnitude[0, 0]
        for effects in (("image",), ("image", "acceleration"))
    }
    ratio = magnitude["image", "acceleration"] / magnitude[("image",)]
    assert ratio == pytest.approx(lost, rel=2e-3)


def test_a_lasers_line_width_costs_coherent_looks_their_share(scene):
    """exp(-2 pi dnu tau) of the power adds up; what walks is noise, and new in each record."""
    laser = {"instrument.laser.line_width": 1e5, "instrument.laser.line_shape": "lorentzian"}
    effects = ("image", "line_width")
    parameters = scene(**{LOOKS_NUMBER_PATH: 4, LOOKS_COMBINE_PATH: "coherent"}, **laser)
    ((_, pure),) = prepare_shots(parameters, ("image",))
    ((_, shots),) = prepare_shots(parameters, effects)
    delay = 2 * ON_A_BIN / SPEED_OF_LIGHT
    share = np.exp(-2 * np.pi * 1e5 * delay)
    left = (evaluate_segments(shots).magnitude[0, 0] / evaluate_segments(pure).magnitude[0, 0]) ** 2
    assert left == pytest.approx(share, rel=1e-9)
    parameters = dimmed(parameters, effects, 0.6)
    expected, number = evaluate(parameters, effects)["pd_up"][0], 800
    results = simulate_draws(
        parameters, effects, keys=make_point_keys(1), batch_sizes=[number], method="spectra"
    )
    error = 5 * np.sqrt(expected * (1 - expected) / number)
    assert results["pd_up"][0] == pytest.approx(expected, abs=error + 0.02)
    without = evaluate(parameters, ("image",))["pd_up"][0]
    assert without > expected + 0.1
    timing = {"line_width": np.array([1e5]), "delay": np.array([delay])}
    line = {"duration": np.array([2e-6]), "window": shots.window}
    assert apparent_line_and_pedestal_power(**timing, **line)[0] > pure_line_power_fraction(
        **timing, duration=line["duration"]
    )


@pytest.mark.parametrize("combine", ["power", "binary"])
def test_a_moving_target_spreads_the_mean_power_of_its_looks(scene, combine):
    """0.9 bins from first to last: the mean of each look's own spectrum, by any route."""
    moving = scene(
        **{LOOKS_NUMBER_PATH: 32, LOOKS_COMBINE_PATH: combine, "target.radial_velocity": 1000.0}
    )
    effects = ("segment_motion", "image")
    if combine == "binary":
        with pytest.raises(UnsupportedShotError, match=r"instrument\.looks\.number takes 32 looks"):
            next(prepare_shots(moving, effects))
        return
    ((_, shots),) = prepare_shots(moving, effects)
    bins, magnitude = segment_spectrum(shots, 0, 0)
    spectra = [
        dict(zip(*segment_spectrum(look, 0, 0), strict=True)) for look in shots.split_by_look()
    ]
    for k in range(95, 105):
        expected = np.sqrt(np.mean([look[k] ** 2 for look in spectra]))
        # The receiver's poles are those of the middle look's line.
        assert magnitude[list(bins).index(k)] == pytest.approx(expected, rel=1e-4)
    in_time = time_domain_truth.evaluate_segments_in_time_domain(shots, with_range_walk=False)
    np.testing.assert_allclose(
        evaluate_segments(shots).magnitude[::2], in_time.magnitude[::2], rtol=1e-4
    )
    look_magnitudes = [look[100] for look in spectra]
    assert max(look_magnitudes) > 1.2 * min(look_magnitudes)


def test_leakage_is_that_of_all_bins_by_the_law_of_the_looks(scene):
    parameters = scene(**{LOOKS_NUMBER_PATH: 4, "accuracy.leakage_floor": -1.0})
    parameters |= {"target.range": np.array([ON_A_BIN + 0.3]), "instrument.laser.power": 4e-3}
    outputs = evaluate(parameters, ("image", "leakage"))
    ((_, shots),) = prepare_shots(parameters, ("image",))
    bins, magnitude = segment_spectrum(shots, 0, 0)
    sigma, level = float(shots.bin_noise_sigma[0]), float(shots.threshold[0])
    is_echo = magnitude >= level
    is_echo |= np.convolve(is_echo, np.ones(3), "same") > 0
    counts = ~is_echo & (bins > 0) & (bins < 512)
    crosses = stats.ncx2.sf(4 * (level / sigma) ** 2, 8, 4 * (magnitude / sigma) ** 2)
    quiet = special.gammaincc(4, 2 * (level / sigma) ** 2)
    chances = np.where(counts, (crosses - quiet) / (1 - quiet), 0.0)
    # By one record that detects as often: groups that join the echo are no further ones.
    scaled = sigma * np.sqrt((level / sigma) ** 2 - 2 * 3 / 4)
    near = shots.detection_rule.sidelobe_neighbour_noise_correlation
    product = 1 - np.prod(1 - chances)
    exclude_crossings_joining_echo(
        chances, 0, chances.size, magnitude, is_echo, sigma / 2, scaled, near
    )
    expected = 1 - np.prod(1 - chances)
    assert 1e-3 < expected < product < 0.9
    assert outputs["p_leakage_up"][0] == pytest.approx(expected, rel=1e-2)


@pytest.mark.parametrize("speckle", ["common", "independent"])
def test_leakage_of_fading_looks_is_that_of_drawn_spectra(scene, speckle):
    """The mean over the fade of further groups in averaged spectra."""
    parameters = scene(
        **{LOOKS_NUMBER_PATH: 4, LOOKS_SPECKLE_PATH: speckle, "accuracy.leakage_floor": -1.0}
    )
    parameters |= {
        "target.range": np.array([ON_A_BIN + 0.5]), "instrument.laser.power": 16e-3,
        "footprint.speckle": "developed", "footprint.phases": "incoherent",
    }  # fmt: skip
    expected = evaluate(parameters, ("image", "leakage", "fading"))["p_leakage_up"][0]
    ((_, shots),) = prepare_shots(parameters, ("image", "fading"))
    drawn, deviation = drawn_leakage(
        shots, 0, draws=12000, looks=4, per_line=speckle == "independent"
    )
    steady = evaluate(parameters, ("image", "leakage"))["p_leakage_up"][0]
    assert expected > 1.3 * steady
    assert expected == pytest.approx(drawn, abs=4 * deviation)


def test_votes_of_one_and_of_all_are_any_and_every_record():
    level, signal = np.array(2.0), np.array(1.5)
    pd_of_look = marcum_q1(signal, level)
    assert Looks(6, "binary", 1).pd_and_miss_steady(signal, level)[1] == pytest.approx(
        pd_of_look.p**6
    )
    assert Looks(6, "binary", 6).pd_and_miss_steady(signal, level)[0] == pytest.approx(
        pd_of_look.q**6
    )


def test_a_threshold_over_the_noise_is_that_of_one_record(scene):
    parameters = {path: v for path, v in scene().items() if path != DESIGN_PFA_BIN_PATH}
    parameters |= {LOOKS_NUMBER_PATH: 4, "instrument.processing.tnr": 6.0}
    level = 6.0 * RAYLEIGH_DEVIATION
    assert float(tnr_from_parameters(parameters)) == 6.0
    log_pfa = evaluate(parameters, ())["log10_pfa_bin"][0]
    assert log_pfa == pytest.approx(np.log10(special.gammaincc(4, 2 * level**2)), rel=1e-9)


def test_drawn_rough_surfaces_fade_in_looks_as_the_closed_form_says(scene):
    """Speckle of beamlets, drawn once a shot for all its looks: 5 sigma of 6000 draws."""
    rough = scene(**{LOOKS_NUMBER_PATH: 8, "footprint.beamlets": 19, "target.roughness": 1e-3})
    smooth = {path: v for path, v in rough.items() if path != "target.roughness"}
    light = dimmed(smooth, ("image", "fading"), 0.6)["instrument.laser.power"]
    expected = evaluate(smooth | {"instrument.laser.power": light}, ("image", "fading"))
    results = simulate_draws(
        rough | {"instrument.laser.power": light}, ("image", "speckle"), keys=make_point_keys(1),
        batch_sizes=[6000], method="probabilities",
    )  # fmt: skip
    for name in ("pd_up", "pd_shot"):
        error = results[f"{name}_error"][0]
        assert results[name][0] == pytest.approx(expected[name][0], abs=5 * error)
        assert 0.4 < expected[name][0] < 0.8


@pytest.mark.parametrize("combine", ["power", "binary", "coherent"])
def test_pictures_show_what_is_held_against_the_threshold(scene, combine):
    """Noise: mean power within 5 sigma, a spread less by the root of 16; or any bin's votes."""
    parameters = scene(
        **{
            LOOKS_NUMBER_PATH: 16,
            LOOKS_COMBINE_PATH: combine,
            LOOKS_VOTES_PATH: 4,
            "target.reflectance": 1e-12,
        }
    )
    shot = simulate_shot(parameters, ("image",), seed=3)
    power = (shot.segments[0].magnitude[8:-8] / shot.noise_sigma) ** 2 / 2
    looks = shot.prepared_shot.looks
    if combine == "binary":  # the fourth largest of 16
        levels = np.array([0.8, 1.4, 2.0])
        alarm_probability = looks.pd_and_miss_steady(np.zeros(3), np.sqrt(2 * levels))[0]
        shares = (power[:, None] >= levels).mean(axis=0)
        assert np.abs(shares - alarm_probability).max() < 5 * 0.5 / np.sqrt(power.size)
        return
    spread = 1 / np.sqrt(looks.n_power_averaged)
    assert power.mean() == pytest.approx(1.0, abs=5 * spread / np.sqrt(power.size))
    assert power.std() == pytest.approx(spread, rel=5 * np.sqrt(8 / 4 / power.size))
