"""Looks whose speckle motion between them changes, compared with drawn scatterers and amplitudes.

Records of scatterers share the mean echo power, the noise and the threshold with the model.
"""

import numpy as np
import pytest
from scatterer_shots import (
    LANDER_PARAMETERS,
    draw_segment_detections,
    prepare_single_category,
    with_signal_over_threshold,
)

from sweep.model.detection.look_speckle import LookSpeckle
from sweep.model.detection.looks import (
    LOOKS_COMBINE_PATH,
    LOOKS_NUMBER_PATH,
    LOOKS_SPECKLE_PATH,
    LOOKS_VOTES_PATH,
    Looks,
)
from sweep.model.effects.catalogue import PARAMETER_DEFAULTS
from sweep.model.evaluation import evaluate_segments, shot_statistics

TOLERANCE = 0.02
DRAWS = 8000


SLOPE = {
    "target.range": 300.0, "target.grazing_angle": np.radians(25),
    "target.transverse_velocity": 12.0, "target.radial_velocity": 15.0,
    "instrument.chirp.segments": "up down",
    "instrument.processing.detection": "peak_bin",
}  # fmt: skip
ANY_TWO = {
    "instrument.processing.shot_detection": "any_two",
    "instrument.chirp.segments": "up doppler down",
}  # fmt: skip
CASES = {
    "four powers": {LOOKS_NUMBER_PATH: 4},
    "eight powers, slowly": {LOOKS_NUMBER_PATH: 8, "target.transverse_velocity": 4.0},
    "eight powers, fast and down": {
        LOOKS_NUMBER_PATH: 8,
        "target.transverse_velocity": -20.0,
        "target.radial_velocity": 20.0,
    },
    "two thirds of a bin": {
        LOOKS_NUMBER_PATH: 4,
        "target.range": 600.0,
        "target.grazing_angle": np.radians(10),
    },
    "one and a half bins of hann": {
        LOOKS_NUMBER_PATH: 4,
        "target.range": 407.0,
        "target.grazing_angle": np.radians(3),
        "instrument.processing.window": "hann",
        "target.transverse_velocity": 6.0,
    },
    "looks that drift by a bin": {
        LOOKS_NUMBER_PATH: 24,
        "target.radial_velocity": 25.0,
        "target.transverse_velocity": 8.0,
    },
    "three votes of eight": {
        LOOKS_NUMBER_PATH: 8,
        LOOKS_COMBINE_PATH: "binary",
        LOOKS_VOTES_PATH: 3,
    },
    "one vote of four": {LOOKS_NUMBER_PATH: 4, LOOKS_COMBINE_PATH: "binary", LOOKS_VOTES_PATH: 1},
    "six votes of eight, slowly": {
        LOOKS_NUMBER_PATH: 8,
        LOOKS_COMBINE_PATH: "binary",
        LOOKS_VOTES_PATH: 6,
        "target.transverse_velocity": 4.0,
    },
    "any two of powers": {LOOKS_NUMBER_PATH: 4, **ANY_TWO},
    "any two of powers, slowly": {
        LOOKS_NUMBER_PATH: 8,
        **ANY_TWO,
        "target.transverse_velocity": 4.0,
    },
    "any two of votes": {
        LOOKS_NUMBER_PATH: 4,
        LOOKS_COMBINE_PATH: "binary",
        LOOKS_VOTES_PATH: 2,
        **ANY_TWO,
    },
    "any two in one speckle": {
        LOOKS_NUMBER_PATH: 4,
        **ANY_TWO,
        "target.transverse_velocity": 0.0,
    },
}


FAST = ("eight powers, fast and down", "three votes of eight", "any two of powers")


@pytest.mark.parametrize(
    "case", [pytest.param(case, marks=[pytest.mark.slow] * (case not in FAST)) for case in CASES]
)
def test_looks_detect_as_often_as_in_drawn_records(case, table_4_1):
    p = PARAMETER_DEFAULTS | table_4_1() | LANDER_PARAMETERS | SLOPE | CASES[case]
    p = with_signal_over_threshold(
        p | {LOOKS_NUMBER_PATH: 1}, 1.3 if LOOKS_COMBINE_PATH not in p else 1.0
    ) | {LOOKS_NUMBER_PATH: p[LOOKS_NUMBER_PATH]}
    shots = prepare_single_category(p)
    outputs = shot_statistics(shots)
    detections = draw_segment_detections(p, shots, draws=DRAWS, seed=len(case))
    shot = detections["up"] & detections["down"]
    if shots.detects_by_any_two_segments:
        shot = sum(detections[segment].astype(int) for segment in detections) >= 2
    shares = {
        "pd_up": detections["up"].mean(),
        "pd_down": detections["down"].mean(),
        "pd_shot": shot.mean(),
    }
    for name, share in shares.items():
        pd = float(outputs[name][0])
        error = np.sqrt(pd * (1 - pd) / DRAWS)
        assert abs(pd - share) < 4 * error + TOLERANCE, name


def drawn_amplitudes(number, turn, gap, snr, draws, rng):
    """Powers (draws, 3, looks) of segments whose speckle turns by these phases, noise included."""
    times = np.concatenate([np.arange(number) * turn + segment * gap for segment in range(3)])
    values, vectors = np.linalg.eigh(np.exp(-0.5 * (times[:, None] - times) ** 2))
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    echo, noise = (
        (rng.normal(size=(draws, 3 * number)) + 1j * rng.normal(size=(draws, 3 * number)))
        / np.sqrt(2)
        for _ in range(2)
    )
    power = np.abs(echo @ root.T * np.repeat(np.sqrt(snr), number) + noise) ** 2
    return power.reshape(draws, 3, number)


def speckle_of(number, turn, gap):
    lag = np.arange(number)
    by_lag = np.broadcast_to(np.exp(-0.5 * (turn * lag) ** 2).astype(complex), (3, 1, number))
    lags = np.arange(1 - number, number)
    weight = number - np.abs(lags)
    total = (weight * np.exp(-((turn * lags) ** 2))).sum()
    between = [
        np.sqrt((weight * np.exp(-((distance * gap + turn * lags) ** 2))).sum() / total)
        for distance in (1, 2, 1)
    ]
    return LookSpeckle.from_correlations(
        by_lag, np.ones((3, 1, number)), np.array(between)[:, None]
    )


@pytest.mark.parametrize(
    ("number", "combine", "votes"),
    [(2, "power", 1), (8, "power", 1), (100, "power", 1), (2, "binary", 1), (8, "binary", 3)],
)
@pytest.mark.parametrize("turn", [0.03, 0.3, 1.0])
def test_looks_detect_as_often_as_drawn_amplitudes(number, combine, votes, turn):
    rng, draws, snr = np.random.default_rng(number), 20_000 if number < 20 else 4000, (3, 8, 5)
    looks, speckle = (
        Looks(number, combine, votes, has_moving_speckle=True),
        speckle_of(number, turn, turn / 3),
    )
    power = drawn_amplitudes(number, turn, turn / 3, snr, draws, rng)
    tested_power = (
        power.mean(axis=2) if combine == "power" else np.sort(power, axis=2)[:, :, -votes]
    )
    least = np.quantile(tested_power[:, 0], 0.5)
    detected = tested_power >= least
    signals, level = np.sqrt(2 * np.array(snr, float))[:, None], np.sqrt(2 * np.array([least]))
    pd, miss = looks.pd_and_miss_in_speckle(signals, level, speckle)
    np.testing.assert_allclose(pd + miss, 1.0, atol=1e-12)
    joint_pd = looks.joint_pd_in_speckle(
        signals[0], signals[2], level, speckle.segment_correlation[1], speckle
    )
    two = looks.pd_and_miss_any_two(signals, level, speckle.segment_correlation, pd, speckle)[0]
    expected = [*pd[:, 0], joint_pd[0], two[0]]
    drawn = [
        *detected.mean(axis=0), (detected[:, 0] & detected[:, 2]).mean(),
        (detected.sum(axis=1) >= 2).mean(),
    ]  # fmt: skip
    np.testing.assert_allclose(expected, drawn, atol=TOLERANCE + 3 * 0.5 / np.sqrt(draws))


def test_looks_of_one_speckle_and_of_independent_ones_are_swerlings_cases():
    signal = np.array([[0.5, 2.0, 6.0, 20.0]] * 3)
    level = np.full(4, 2.5)
    for turn, law in ((1e-9, Looks(8)), (50.0, Looks(8, has_independent_speckle=True))):
        pd, missed = Looks(8, has_moving_speckle=True).pd_and_miss_in_speckle(
            signal, level, speckle_of(8, turn, 0.0)
        )
        expected, lost = law.pd_and_miss_in_speckle(signal, level)
        np.testing.assert_allclose(pd, expected, rtol=1e-6)
        np.testing.assert_allclose(missed, lost, rtol=1e-6)


def test_tails_keep_their_digits():
    """Partial fractions of four eigenvalues in 60 digits, by mpmath."""
    mpmath = pytest.importorskip("mpmath")
    speckle = speckle_of(4, 0.8, 0.0)
    for signal, level in ((1.0, 6.0), (30.0, 2.0)):
        a, b = np.full((3, 1), signal), np.full((3, 1), level)
        pd, missed = Looks(4, has_moving_speckle=True).pd_and_miss_in_speckle(a, b, speckle)
        with mpmath.workdps(60):
            mean = [1 + mpmath.mpf(float(c)) * signal**2 / 2 for c in speckle.eigenvalue[0, 0]]
            exact = sum(
                mpmath.exp(-2 * mpmath.mpf(level) ** 2 / mean_power)
                * mpmath.fprod(
                    mean_power / (mean_power - other) for other in mean if other != mean_power
                )
                for mean_power in mean
            )
        if exact < 0.5:
            assert float(pd[0, 0]) == pytest.approx(float(exact), rel=1e-6)
        else:
            assert float(missed[0, 0]) == pytest.approx(float(1 - exact), rel=1e-6)


def test_a_target_at_rest_has_one_speckle_in_all_looks(table_4_1):
    p = PARAMETER_DEFAULTS | table_4_1() | LANDER_PARAMETERS | SLOPE | {LOOKS_NUMBER_PATH: 8}
    p |= {"target.radial_velocity": 0.0, "target.transverse_velocity": 0.0}
    shots = prepare_single_category(p)
    assert shots.speckle.look_speckle is None
    common = shot_statistics(prepare_single_category(p | {LOOKS_SPECKLE_PATH: "common"}))
    np.testing.assert_array_equal(shot_statistics(shots)["pd_shot"], common["pd_shot"])


def test_added_amplitudes_of_looks_lose_what_their_speckle_does_not_share(table_4_1):
    """The mean amplitude of N looks: sum of mu over all pairs of looks, over N^2, of the power."""
    p = (
        PARAMETER_DEFAULTS
        | table_4_1()
        | LANDER_PARAMETERS
        | SLOPE
        | {LOOKS_NUMBER_PATH: 6, LOOKS_COMBINE_PATH: "coherent"}
    )
    moving, common = (
        prepare_single_category(p),
        prepare_single_category(p | {LOOKS_SPECKLE_PATH: "common"}),
    )
    powers = prepare_single_category(
        p | {LOOKS_COMBINE_PATH: "power"}
    ).speckle.look_speckle.correlation_by_lag[0, 0]
    lag = np.arange(6) - np.arange(6)[:, None]
    shared = np.abs(powers)[np.abs(lag)].sum() / 36
    assert 0.05 < shared < 0.9
    ratio = (
        evaluate_segments(moving).magnitude[0, 0] / evaluate_segments(common).magnitude[0, 0]
    ) ** 2
    assert ratio == pytest.approx(shared, rel=1e-3)
