"""Draws of random effects: their bits, their means, and quadratures over what is random."""

import numpy as np
import pytest
from mean_over_draws import mean_statistics
from scipy import special
from shot_helpers import intersect_level_plane, make_point_keys, parametrize_product

from sweep.model.detection.marcum import marcum_q1
from sweep.model.effects import pointing_jitter, scintillation
from sweep.model.effects.catalogue import DEFAULT_EFFECTS, PARAMETER_DEFAULTS
from sweep.model.evaluation import evaluate as evaluate_without
from sweep.model.evaluation import shot_statistics
from sweep.model.outputs import DRAW_COUNT_OUTPUTS, GRID_OUTPUTS, STANDARD_ERROR_OUTPUTS
from sweep.model.sampling import realisations
from sweep.model.sampling.realisations import iter_realisations
from sweep.model.sampling.samplers import simulate_draws

DRAWS = 20_000
RANDOM = ("pointing_jitter", "speckle", "scintillation")
AIR = {
    "atmosphere.turbulence": "uniform",
    "atmosphere.structure_constant": 1e-14,
    "atmosphere.scintillation_law": "log_normal",
}
ALL = (*DEFAULT_EFFECTS, *RANDOM)


def index(legs):
    """Variance of the whole factor of unit mean, exp(sum of log variances) - 1, for either law."""
    return np.expm1(sum(leg.large_eddies + leg.small_eddies for leg in legs))


def scene(table_4_1, **changes):
    """Points of different FFTs in turbulent air, the beam unsteady over a rough surface."""
    varied = {
        "range": np.array([2000.0, 3000.0, 4000.0, 5000.0]),
        "fft_size": np.array([4096, 8192, 4096, 4096]),
        "beamlets": 7,
        "phases": "incoherent",
        "grazing_angle": 0.5,
    }
    rough = AIR | {"target.roughness": 1e-5, "target.pointing_jitter": 2e-5}
    return table_4_1(**varied | changes) | rough


def per_draw(parameters, effects, n, draws, first_draw=0, seeded=None):
    """Outputs of every draw by name, (n, draws)."""
    names = {name: np.full((n, draws), np.nan) for name in GRID_OUTPUTS}
    chosen = make_point_keys(n) if seeded is None else seeded
    for point, draw, shots in iter_realisations(
        parameters, effects, keys=chosen, first_draw=first_draw, draws=draws
    ):
        for name, values in shot_statistics(shots).items():
            names[name][point, draw - first_draw] = values
    return names


def test_any_stretch_of_points_or_draws_has_the_same_bits(table_4_1, monkeypatch):
    at_once = per_draw(scene(table_4_1), ALL, 4, 60)
    means = mean_statistics(scene(table_4_1), ALL, keys=make_point_keys(4), draws=60)
    assert np.unique(at_once["snr_up"]).size == 240
    late = per_draw(scene(table_4_1), ALL, 4, 20, first_draw=30)
    single_point = scene(table_4_1, range=np.array([5000.0]), fft_size=4096)
    single = per_draw(single_point, ALL, 1, 60, seeded=make_point_keys(4)[3:])
    monkeypatch.setattr(realisations, "DRAWS_PER_BATCH", 7)
    pieces = per_draw(scene(table_4_1), ALL, 4, 60)
    summed = mean_statistics(scene(table_4_1), ALL, keys=make_point_keys(4), draws=60)
    for name in GRID_OUTPUTS:
        np.testing.assert_array_equal(at_once[name][:, 30:50], late[name], err_msg=name)
        np.testing.assert_array_equal(at_once[name][3:], single[name], err_msg=name)
        np.testing.assert_array_equal(at_once[name], pieces[name], err_msg=name)
    for name, values in means.items():
        np.testing.assert_array_equal(values, summed[name], err_msg=name)


def test_wide_footprints_are_cut_into_shorter_stretches(table_4_1, monkeypatch):
    monkeypatch.setattr(realisations, "BEAMLETS_PER_BATCH", 70)
    sizes = [
        s.point_indices.size
        for s in iter_realisations(scene(table_4_1), ALL, keys=make_point_keys(4), draws=25)
    ]
    assert max(sizes) == 10 and sum(sizes) == 100


STILL = [effect for effect in DEFAULT_EFFECTS if effect != "doppler_spread"]
"""Beamlets with one velocity: their own turn speckles as jitter moves them."""


def drawn_shots(parameters, effects):
    (stretch,) = iter_realisations(
        parameters, [*STILL, *effects], keys=make_point_keys(2), draws=50
    )
    return stretch.shots


def test_random_effects_come_and_go_without_moving_each_others_numbers(table_4_1):
    parameters = scene(table_4_1, range=np.array([2000.0, 5000.0]), fft_size=4096)
    both = drawn_shots(parameters, ["speckle", "scintillation"])
    speckled, twinkling = (drawn_shots(parameters, [e]) for e in ("speckle", "scintillation"))
    np.testing.assert_array_equal(
        both.footprint.relative_amplitude, speckled.footprint.relative_amplitude
    )
    np.testing.assert_array_equal(both.footprint.phase_cycles, speckled.footprint.phase_cycles)
    np.testing.assert_array_equal(
        both.echo_scales.beat_amplitude_scale, twinkling.echo_scales.beat_amplitude_scale
    )
    shaken, every = (drawn_shots(parameters, e) for e in (["pointing_jitter"], RANDOM))
    np.testing.assert_array_equal(every.range, shaken.range)
    # Beamlets are elsewhere, and the factors on them are what they were.
    unperturbed = drawn_shots(parameters, [])
    np.testing.assert_allclose(
        every.footprint.relative_amplitude
        / shaken.footprint.relative_amplitude[shaken.footprint.row_of_point],
        speckled.footprint.relative_amplitude
        / unperturbed.footprint.relative_amplitude[unperturbed.footprint.row_of_point],
        rtol=1e-12,
    )
    np.testing.assert_array_equal(every.footprint.phase_cycles, speckled.footprint.phase_cycles)


@pytest.mark.parametrize("method", ["probabilities", "noise"])
def test_a_random_effect_that_does_nothing_leaves_every_count_as_it_is(method, table_4_1):
    """Air without turbulence multiplies by exactly 1: not a number of the noise's has moved."""
    parameters = scene(table_4_1) | {"atmosphere.structure_constant": 0.0}
    parameters["instrument.processing.tnr"] = 5.0
    chosen = {"keys": make_point_keys(4), "batch_sizes": [40, 70], "method": method}
    without_effect = simulate_draws(parameters, DEFAULT_EFFECTS, **chosen)
    with_effect = simulate_draws(parameters, [*DEFAULT_EFFECTS, "scintillation"], **chosen)
    for name in DRAW_COUNT_OUTPUTS:
        np.testing.assert_array_equal(without_effect[name], with_effect[name], err_msg=name)
    for name in GRID_OUTPUTS:
        np.testing.assert_allclose(
            without_effect[name], with_effect[name], rtol=1e-12, err_msg=name
        )
    assert (
        without_effect["n_detected_up"].sum() > 0 and without_effect["n_false_alarm_up"].sum() > 0
    )
    for name in STANDARD_ERROR_OUTPUTS:
        assert (without_effect[name] == 0).all()


def test_means_are_means_of_the_draws_with_their_standard_errors(table_4_1):
    parameters = scene(table_4_1)
    drawn = per_draw(parameters, ALL, 4, 300)
    means = mean_statistics(parameters, ALL, keys=make_point_keys(4), draws=300)
    assert list(means) == [*GRID_OUTPUTS, *STANDARD_ERROR_OUTPUTS]
    for name, values in drawn.items():
        if not name.startswith("log10"):
            np.testing.assert_allclose(means[name], values.mean(axis=1), rtol=1e-11, err_msg=name)
    for name in ("pd_up", "pd_down", "pd_doppler", "pd_shot"):
        error = drawn[name].std(axis=1, ddof=1) / np.sqrt(300)
        np.testing.assert_allclose(means[name + "_error"], error, rtol=1e-9)
        first_draw = mean_statistics(parameters, ALL, keys=make_point_keys(4), draws=1)
        assert np.isnan(first_draw[name + "_error"]).all()
    np.testing.assert_allclose(drawn["pd_up"] * drawn["pd_down"], drawn["pd_shot"], rtol=1e-15)


@pytest.mark.parametrize("tnr", [5.0, 60.0])
def test_logarithms_are_those_of_the_mean_even_where_it_underflows(tnr, table_4_1):
    """Close to a loud target, whose own shot noise twinkles with it."""
    parameters = table_4_1(range=np.array([1.0, 2.0]), tnr=tnr, fft_size=4096, beamlets=7) | AIR
    parameters |= {"atmosphere.structure_constant": 1e-8, "target.radial_velocity": 20.0}
    effects = (*DEFAULT_EFFECTS, "scintillation")
    drawn = per_draw(parameters, effects, 2, 200)
    means = mean_statistics(parameters, effects, keys=make_point_keys(2), draws=200)
    assert (np.ptp(drawn["log10_pfa_bin"], axis=1) > 1e-3).all()
    for name in ("pfa_bin", "pfa_segment", "pfa_shot"):
        logs = np.log(10) * drawn["log10_" + name]
        exact = (special.logsumexp(logs, axis=1) - np.log(200)) / np.log(10)
        np.testing.assert_allclose(means["log10_" + name], exact, rtol=1e-12, atol=1e-14)
        assert np.isfinite(means["log10_" + name]).all()
    assert (means["pfa_shot"] == 0).all() == (tnr == 60)


@pytest.mark.parametrize(
    ("architecture", "law"),
    parametrize_product(3, ["homodyne", "direct"], ["log_normal", "gamma_gamma"]),
)
def test_twinkling_keeps_the_mean_echo_and_has_its_index(law, architecture, table_4_1):
    """Power of mean 1 on the echo and its shot noise, and on the SNR its square if direct."""
    parameters = scene(table_4_1, range=np.full(4, 3000.0), fft_size=4096) | AIR
    parameters |= {
        "atmosphere.scintillation_law": law,
        "instrument.receiver.architecture": architecture,
    }
    effects = (*DEFAULT_EFFECTS, "scintillation")
    stretches = list(iter_realisations(parameters, effects, keys=make_point_keys(4), draws=DRAWS))
    (realisation,) = iter_realisations(
        parameters, DEFAULT_EFFECTS, keys=make_point_keys(4), draws=1
    )
    power = (
        np.concatenate([s.shots.echo_power for s in stretches]) / realisation.shots.echo_power[0]
    )
    even = scintillation.TurbulenceProfile(uniform_strength=1e-14)
    legs = scintillation.two_way_log_variances(
        even, PARAMETER_DEFAULTS | parameters, np.array(3000.0)
    )
    root = np.sqrt(power.size)
    assert power.mean() == pytest.approx(1, abs=5 * power.std() / root)
    square = (power - 1) ** 2
    assert square.mean() == pytest.approx(index(legs), abs=5 * square.std() / root)
    for stretch in stretches[:2]:
        shots, outputs = stretch.shots, shot_statistics(stretch.shots)
        share = shots.echo_power / realisation.shots.echo_power[0]
        quiet = realisation.shots.noise.variances["signal_shot"][0]
        np.testing.assert_allclose(shots.noise.variances["signal_shot"], share * quiet, rtol=1e-12)
        by_light = 2 if architecture == "direct" else 1
        signal = outputs["snr_up"] * shots.noise_variance
        unperturbed = evaluate_without(parameters, DEFAULT_EFFECTS)
        np.testing.assert_allclose(
            signal,
            share**by_light * unperturbed["snr_up"][0] * unperturbed["noise_variance"][0],
            rtol=1e-9,
        )


def test_the_mean_over_a_log_normal_echo_is_gauss_and_hermites(table_4_1):
    parameters = table_4_1(range=4000.0, beamlets=1, tnr=8.0, power=0.1) | AIR
    means = mean_statistics(
        parameters, (*DEFAULT_EFFECTS, "scintillation"), keys=make_point_keys(1), draws=50_000
    )
    even = scintillation.TurbulenceProfile(uniform_strength=1e-14)
    legs = scintillation.two_way_log_variances(
        even, PARAMETER_DEFAULTS | parameters, np.array(4000.0)
    )
    variance = np.log1p(index(legs))
    x, weight = np.polynomial.hermite_e.hermegauss(100)
    root = np.exp(0.5 * (np.sqrt(variance) * x - variance / 2))
    outputs = evaluate_without(parameters)
    beta = 8.0 * np.sqrt(2 - np.pi / 2)
    pd = {s: marcum_q1(np.sqrt(2 * outputs[f"snr_{s}"]) * root, beta).q for s in ("up", "down")}
    for name, values in {"up": pd["up"], "shot": pd["up"] * pd["down"]}.items():
        exact = (weight * values).sum() / np.sqrt(2 * np.pi)
        assert 0.05 < exact < 0.95
        error = means[f"pd_{name}_error"][0]
        assert abs(means[f"pd_{name}"][0] - exact) <= 5 * error
        assert error < 0.002
    product = means["pd_up"] * means["pd_down"]
    assert (means["pd_shot"] > product + 20 * means["pd_shot_error"]).all()


@pytest.mark.parametrize(
    "changes, sigma",
    [
        ({"grazing_angle": 0.6, "phases": "incoherent", "beamlets": 7}, 4e-6),
        pytest.param(
            {"grazing_angle": 0.2, "reflectance_law": "lambert", "beamlets": 1, "power": 0.3},
            2e-6,
            marks=pytest.mark.slow,
        ),
        ({"grazing_angle": np.pi / 2, "beamlets": 1}, 3e-3),
    ],
)
def test_the_mean_over_jitter_is_a_quadrature_over_both_angles(changes, sigma, table_4_1):
    parameters = table_4_1(**{"range": 5000.0, "tnr": 8.0, "power": 0.15} | changes)
    a, b = (v.ravel() for v in np.mgrid[-6:6.05:0.1, -6:6.05:0.1])
    share = np.exp(-(a**2 + b**2) / 2) * 0.1**2 / (2 * np.pi)
    angles = sigma * np.stack([a, b], axis=1)
    steepness = parameters["target.grazing_angle"]
    far, grazing, direction = intersect_level_plane(5000.0, steepness, angles)
    along = direction @ [np.cos(steepness), 0.0, -np.sin(steepness)]
    outputs = evaluate_without(
        parameters
        | {"target.range": far, "target.grazing_angle": grazing}
        | {"target.radial_velocity": 150.0 * along}
    )
    means = mean_statistics(
        parameters | {"target.pointing_jitter": sigma}, (*DEFAULT_EFFECTS, "pointing_jitter"),
        keys=make_point_keys(1), draws=DRAWS,
    )  # fmt: skip
    for name in ("pd_up", "pd_down", "pd_shot"):
        exact = (share * outputs[name]).sum()
        assert 0.01 < exact < 0.99
        error = means[name + "_error"][0]
        assert 1e-5 < error < 0.004
        assert abs(means[name][0] - exact) <= 5 * error


def test_a_moving_instrument_sees_what_its_jitter_turns_into_the_beam(table_4_1):
    """Towards the near side, tilting up by a takes a of the speed away: v_r' = v_r - a v."""
    parameters = table_4_1(beamlets=1, radial_velocity=50.0, grazing_angle=0.5)
    parameters |= {"target.pointing_jitter": 1e-4, "target.transverse_velocity": 80.0}
    (stretch,) = iter_realisations(
        parameters, (*DEFAULT_EFFECTS, "pointing_jitter"), keys=make_point_keys(1), draws=2000
    )
    upwards = np.arcsin(2000.0 * np.sin(0.5) / stretch.shots.range) - 0.5  # -a
    velocity_shift = stretch.shots.target.radial_velocity - 50.0
    np.testing.assert_allclose(velocity_shift, 80.0 * upwards, atol=3 * 130.0 * 1e-4**2 * 10)
    assert velocity_shift.std() == pytest.approx(80.0 * 1e-4, rel=5 / np.sqrt(4000))


def test_a_beam_over_the_horizon_is_a_draw_without_an_echo(table_4_1):
    """a > 0.02, of deviation 0.02: 15.9 % of draws; noise alone may still cross the threshold."""
    parameters = table_4_1(grazing_angle=0.02, beamlets=1, range=50.0, tnr=3.0)
    parameters |= {"target.pointing_jitter": 0.02}
    effects = (*DEFAULT_EFFECTS, "pointing_jitter")
    drawn = per_draw(parameters, effects, 1, 2000)
    missed = drawn["snr_up"][0] == 0
    assert missed.mean() == pytest.approx(0.1587, abs=5 * np.sqrt(0.1587 * 0.8413 / 2000))
    noise = np.exp(-(4 - np.pi) / 4 * 9)
    np.testing.assert_allclose(drawn["pd_up"][0, missed], noise, rtol=1e-9)
    np.testing.assert_array_equal(np.isnan(drawn["range_error"][0]), missed)
    means = mean_statistics(parameters, effects, keys=make_point_keys(1), draws=2000)
    assert means["range_error"] == pytest.approx(drawn["range_error"][0, ~missed].mean(), rel=1e-9)
    assert means["pd_up"] == pytest.approx(drawn["pd_up"].mean(), rel=1e-12)


def test_a_steady_beam_is_the_shot_as_it_is(table_4_1):
    parameters = table_4_1(range=np.array([2000.0, 4000.0]), grazing_angle=0.5, beamlets=7)
    angles = pointing_jitter.draw_jitter_angles(
        pointing_jitter.DrawAddresses(make_point_keys(2), np.zeros(2, np.int64)),
        np.array([0.0, 1.0]),
    )
    assert (angles[0] == 0).all() and (angles[1] != 0).all()
    unperturbed = mean_statistics(
        parameters, (*DEFAULT_EFFECTS, "pointing_jitter"), keys=make_point_keys(2), draws=3
    )
    outputs = evaluate_without(parameters)
    for name in ("pd_up", "pd_doppler", "pd_shot", "snr_down"):
        np.testing.assert_allclose(unperturbed[name], outputs[name], rtol=1e-6)
