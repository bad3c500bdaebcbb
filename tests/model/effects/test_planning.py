"""Which effects are kept where: what is left out never adds up to more than the tolerance."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from random_planner_points import (
    effects_kept_in_tile,
    plan_points,
    planner_inputs,
    random_parameters,
)

from sweep.model.detection.looks import SINGLE_LOOK
from sweep.model.detection.marcum import log_at_least_one_probability, marcum_q1
from sweep.model.effects.catalogue import EFFECTS
from sweep.model.effects.effect import Effect
from sweep.model.effects.error_bounds import ErrorBound
from sweep.model.effects.planning import omission_errors, plan_effects

TILES = 40


class GivenInputs:
    """What criteria need of points, given outright."""

    ndim, existing_chirp_slopes, looks = 1, np.array([[1.0], [0.0], [-1.0]]), SINGLE_LOOK
    noise_maximum_over_sigma = None

    def __init__(self, peak_magnitude_over_sigma, threshold_ratio):
        self.peak_magnitude_over_sigma = np.broadcast_to(
            peak_magnitude_over_sigma, (3, np.shape(peak_magnitude_over_sigma)[-1])
        )
        self.threshold_ratio = np.asarray(threshold_ratio, float)
        self.number = self.peak_magnitude_over_sigma.shape[1]


def plan_of_tiles(points, modes, tolerance, effects):
    """A plan with every point a tile."""
    return plan_effects(
        points, lambda v: np.broadcast_to(v, (points.number,)), modes, tolerance, effects
    )


def catalogue(sizes, within=None, stages=None):
    """Effects of given sizes, on lines unless told otherwise; arrays are chances."""

    def size_of(value):
        return (
            value
            if value is None or isinstance(value, ErrorBound)
            else ErrorBound(probability_change=value)
        )

    return [
        Effect(
            name=name, description=name, stage=(stages or {}).get(name, "lines"),
            parent=(within or {}).get(name, ""), error_bound=lambda _, value=value: size_of(value),
        )
        for name, value in sizes.items()
    ]  # fmt: skip


def random_sizes(rng, names):
    """Of all sorts, from next to nothing to more than all."""
    return {
        name: ErrorBound(
            magnitude_change=10.0 ** rng.uniform(-9, 0, (3, TILES)),
            noise_variance_change=10.0 ** rng.uniform(-9, -0.5, TILES) * rng.choice([-1, 1], TILES),
            threshold_follows_noise=bool(rng.random() < 0.5),
        )
        for name in names
    }


def acting(rng, size):
    """Factors on amplitude and threshold over sigma of what is no more than a size."""
    u, v = rng.uniform(-1, 1, (3, TILES)), rng.random(TILES)
    loud = np.sqrt(1 + v * size.noise_variance_change)
    return (1 + u * size.magnitude_change) / loud, 1.0 if size.threshold_follows_noise else 1 / loud


@given(st.integers(0, 2**32), st.sampled_from([1e-6, 1e-3, 0.02]))
def test_what_is_left_out_changes_pd_by_no_more_than_the_tolerance(seed, tolerance):
    rng = np.random.default_rng(seed)
    sizes = random_sizes(rng, [f"effect {i}" for i in range(5)])
    a, b = 10 ** rng.uniform(-1, 2, (3, TILES)), rng.uniform(0.5, 8, TILES)
    plan = plan_of_tiles(GivenInputs(a, b), {}, tolerance, catalogue(sizes))
    assert (plan.total_error <= tolerance).all()
    for _ in range(10):
        # every effect does something within its size; the truth has all, the plan what it kept
        true_a, true_b, kept_a, kept_b = a, b, a, b
        for size, is_kept in zip(sizes.values(), plan.is_kept, strict=True):
            f, g = acting(rng, size)
            true_a, true_b = true_a * f, true_b * g
            kept_a, kept_b = kept_a * np.where(is_kept, f, 1), kept_b * np.where(is_kept, g, 1)
        error = abs(marcum_q1(true_a, true_b).q - marcum_q1(kept_a, kept_b).q)
        assert (error.sum(axis=0) <= 1.2 * plan.total_error + 1e-10).all()


def test_where_the_signal_is_drowned_anything_may_go():
    phases = catalogue({"phases": ErrorBound(magnitude_change=0.5)})
    plan = plan_of_tiles(GivenInputs(np.array([1e-4, 7.0, 1e3]), 6.55), {}, 1e-3, phases)
    assert plan.is_kept.tolist() == [[False, True, True]] and plan.total_error.max() < 1e-3
    assert effects_kept_in_tile(plan, 1) == ("phases",) and effects_kept_in_tile(plan, 0) == ()
    # pd is 1 there all the same, which is what the noise's side of it tells
    cancel = catalogue({"phases": ErrorBound(coherent_sum_change=1e-2)})
    plan = plan_of_tiles(GivenInputs(np.array([1e-4, 1e3]), 6.55), {}, 1e-3, cancel)
    assert plan.is_kept.tolist() == [[False, True]]


def test_the_smallest_go_first_tile_by_tile_and_the_sum_counts():
    sizes = {"c": np.array([0.5, 0.0]), "a": np.array([0.0, 0.4]), "b": np.array([0.45, 0.1])}
    plan = plan_of_tiles(GivenInputs(np.ones(2), 1.0), {}, 0.46, catalogue(sizes))
    assert plan.is_kept.tolist() == [[True, False], [False, True], [False, False]]
    assert plan.total_error == pytest.approx([0.45, 0.1])
    assert np.array_equal(plan.omission_error, np.array(list(sizes.values())))


def test_of_effects_that_are_alike_the_last_goes_first():
    sizes = {name: np.full(2, 0.4) for name in "abc"}
    plan = plan_of_tiles(GivenInputs(np.ones(2), 1.0), {}, 0.5, catalogue(sizes))
    assert plan.is_kept.tolist() == [[True, True], [True, True], [False, False]]


def test_forced_effects_stay_and_go_and_the_error_is_reported():
    sizes = {"a": 1e-6, "b": 0.3, "c": 1e-7, "nothing": 0.0, "absent": None, "far": None}
    sizes = {n: None if v is None else np.full(2, v) for n, v in sizes.items()}
    modes = {"a": "on", "b": "off", "far": "on"}
    plan = plan_of_tiles(GivenInputs(np.ones(2), 1.0), modes, 1e-3, catalogue(sizes))
    assert effects_kept_in_tile(plan, 0) == (
        "a",
        "c",
    )  # of what is absent there is nothing to force on
    assert plan.total_error == pytest.approx(0.3)


def test_what_adds_to_the_noise_is_never_left_out_but_off():
    """It costs nothing to simulate, and pd does not tell what it does to the SNR."""
    sizes = {"sun": np.array([0.0, 1e-9]), "walk": np.full(2, 1e-9), "dark": None}
    effects = catalogue(sizes, stages={"sun": "noise", "dark": "noise"})
    plan = plan_of_tiles(GivenInputs(np.ones(2), 1.0), {}, 1e-2, effects)
    assert plan.is_kept.tolist() == [[True, True], [False, False], [False, False]]
    assert plan.total_error == pytest.approx([1e-9, 1e-9])
    assert not plan_of_tiles(
        GivenInputs(np.ones(2), 1.0), {"sun": "off"}, 1e-2, effects
    ).is_kept.any()


def test_who_asks_for_leakage_has_bins_counted_as_far_off_as_the_largest():
    """A ten thousandth of 1,000 sigmas is a tenth of one, more than may leak in the last tile."""
    leaks = np.array([0.3, 0.3, 0.02])
    sizes = {
        "walk": ErrorBound(magnitude_change=1e-4),
        "sun": ErrorBound(noise_variance_change=1e-4),
        "leakage": leaks,
    }
    effects = catalogue(sizes, stages={"sun": "noise", "leakage": "detection"})
    points = GivenInputs(np.array([1e3, 10.0, 1e3]), 4.0)
    walk, sun, leakage = plan_of_tiles(points, {"leakage": "on"}, 1e-2, effects).omission_error
    assert walk == pytest.approx([0.1, 1e-3, 0.02], rel=0.01) and leakage == pytest.approx(leaks)
    for mode in ("auto", "off"):
        other = plan_of_tiles(points, {"leakage": mode}, 1e-2, effects).omission_error
        assert other[0] == pytest.approx([1e-4] * 3, rel=0.01)
        assert np.array_equal(other[1], sun)


def test_an_effect_within_another_needs_it():
    sizes = {"footprint": 1e-6, "phases": 0.5, "spread": 1e-4, "turn": 1e-7}
    sizes = {n: np.array([v, 0.0]) for n, v in sizes.items()}
    within = {"phases": "footprint", "spread": "footprint", "turn": "phases"}
    points, effects = GivenInputs(np.ones(2), 1.0), catalogue(sizes, within)
    plan = plan_of_tiles(points, {}, 1e-3, effects)
    assert (
        effects_kept_in_tile(plan, 0) == ("footprint", "phases")
        and effects_kept_in_tile(plan, 1) == ()
    )
    assert effects_kept_in_tile(plan_of_tiles(points, {}, 0.6, effects), 0) == ()
    plan = plan_of_tiles(points, {"footprint": "off"}, 1e-3, effects)
    assert effects_kept_in_tile(plan, 0) == () and plan.total_error[0] == pytest.approx(0.5001011)
    all_three = ("footprint", "phases", "turn")
    assert effects_kept_in_tile(plan_of_tiles(points, {"turn": "on"}, 1.0, effects), 1) == all_three
    with pytest.raises(ValueError, match="phases cannot be on"):
        plan_of_tiles(points, {"footprint": "off", "phases": "on"}, 1e-3, effects)


@given(st.integers(0, 2**32), st.sampled_from([0.0, 1e-3, 0.3]))
def test_no_plan_keeps_an_effect_without_what_it_is_within(seed, tolerance):
    rng = np.random.default_rng(seed)
    names = "abcdefg"
    sizes = {n: 10 ** rng.uniform(-8, 0, TILES) * rng.integers(0, 2, TILES) for n in names}
    within = {n: str(rng.choice(list(names[:i]))) for i, n in enumerate(names) if i % 2}
    modes = {n: "on" for n in names if rng.random() < 0.1}
    points = GivenInputs(np.ones(TILES), 1.0)
    plan = plan_of_tiles(points, modes, tolerance, catalogue(sizes, within))
    assert (plan.total_error <= tolerance).all()
    for child, parent in within.items():
        assert (plan.is_kept[names.index(child)] <= plan.is_kept[names.index(parent)]).all()


def test_noise_that_the_threshold_does_not_follow_changes_false_alarms():
    b, bins = np.array([5.0, 6.0, 20.0]), 1024
    size = ErrorBound(noise_variance_change=3e-3, threshold_follows_noise=False)
    error = omission_errors({"one": size}, GivenInputs(np.full(3, 1e-6), b))["one"]
    log_p = -(b**2) / 2 / np.array([[1.0], [1.003]])
    segment = log_at_least_one_probability(log_p, np.full_like(log_p, bins))
    moved = 2 * np.diff(segment, axis=0)[0] / np.log(10)
    assert error == pytest.approx(moved, rel=0.01)


def test_effects_come_after_those_they_are_within():
    names = [effect.name for effect in EFFECTS]
    for effect in EFFECTS:
        assert not effect.parent or names.index(effect.parent) < names.index(effect.name)


@given(st.integers(0, 2**32), st.lists(st.floats(-8, -1), min_size=2, max_size=5))
def test_a_tighter_tolerance_keeps_all_that_a_looser_one_does(table_4_1, seed, exponents):
    rng = np.random.default_rng(seed)
    further_parameters = {
        "phases": str(rng.choice(["coherent", "incoherent"])),
        "architecture": str(rng.choice(["homodyne", "heterodyne", "direct"])),
        "beamlets": int(rng.choice([0, 1, 19])),
    }
    parameters = random_parameters(table_4_1, 12, seed, **further_parameters) | {
        "target.acceleration": rng.choice([0.0, 1.0]) * 10 ** rng.uniform(-4, 3, 12),
        "instrument.laser.line_width": rng.choice([0.0, 1.0]) * 10 ** rng.uniform(0, 5, 12),
        "instrument.chirp.quadratic_error": rng.choice([0.0, 1.0]) * 10 ** rng.uniform(0, 6, 12),
    }
    modes = {"leakage": str(rng.choice(["auto", "on"]))}
    kept_sets = [
        plan_points(planner_inputs(parameters), modes, 10.0**exponent).is_kept
        for exponent in sorted(exponents)
    ]
    for tighter, looser in pairwise(kept_sets):
        assert (tighter >= looser).all()


@given(st.floats(0.5, 12), st.floats(0.1, 9), st.floats(-4, -2))
def test_an_echo_that_has_to_be_the_strongest_counts_at_any_level_of_noise(signal, least, decades):
    """Its pd is a mean of chances to cross levels from the threshold up to the largest noise."""
    points, share = GivenInputs([[signal]], [least]), 10.0**decades
    points.noise_maximum_over_sigma = 6.0
    (change,) = omission_errors(
        {"one": ErrorBound(magnitude_change=np.array([share]))}, points
    ).values()
    level = np.linspace(least, max(least, 6.0), 200)
    pd_change = np.abs(marcum_q1(signal * (1 + share), level).q - marcum_q1(signal, level).q)
    assert change[0] >= min(3 * pd_change.max(), 1) * (1 - 0.05)
