"""Which effects are kept: what is left out never adds up to more than the tolerance."""

import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sweep.model.effects.change import Change, pd_change
from sweep.model.effects.planning import pd_change_within, pd_changes, plan
from sweep.model.marcum import marcum_q1


def random_bounds(rng, names, n, follows=True):
    """Intervals around 1 of all widths, on signal and noise."""
    bounds = {}
    for name in names:
        width = 10.0 ** rng.uniform(-9, 0.5, (2, n))
        noise = 10.0 ** rng.uniform(-9, -1, (2, n))
        bounds[name] = Change(
            signal=(np.exp(-width[0]), np.exp(width[1])),
            noise=(np.exp(-noise[0]), np.exp(noise[1])),
            threshold_follows=bool(follows and rng.random() < 0.5),
        )
    return bounds


def inside_of(rng, change):
    """Factors on amplitude and on threshold over sigma from within a change's intervals."""
    u = rng.random((2, *np.shape(change.signal[0])))
    u = np.where(rng.random(u.shape) < 0.3, np.rint(u), u)
    signal = change.signal[0] ** (1 - u[0]) * change.signal[1] ** u[0]
    noise = change.noise[0] ** (1 - u[1]) * change.noise[1] ** u[1]
    return signal / np.sqrt(noise), 1.0 if change.threshold_follows else 1 / np.sqrt(noise)


@given(st.integers(0, 2**32), st.sampled_from([1e-6, 1e-3, 0.02, 0.3]))
def test_what_is_left_out_changes_pd_by_no_more_than_the_tolerance(seed, tolerance):
    rng = np.random.default_rng(seed)
    names = [f"effect {i}" for i in range(5)]
    bounds = random_bounds(rng, names, 40)
    a, b = 10 ** rng.uniform(-1, 2, 40), rng.uniform(0.5, 8, 40)
    made = plan(bounds, amplitude=a, threshold=b, tolerance=tolerance)
    assert made.within and made.error <= tolerance
    assert {*made.kept, *made.left_out} == set(names)
    for _ in range(20):
        # every effect does something within its bound; the truth has all, the plan what it kept
        true_a, true_b, kept_a, kept_b = a, b, a, b
        for name, change in bounds.items():
            f, g = inside_of(rng, change)
            true_a, true_b = true_a * f, true_b * g
            if name in made.kept:
                kept_a, kept_b = kept_a * f, kept_b * g
        error = abs(marcum_q1(true_a, true_b).q - marcum_q1(kept_a, kept_b).q)
        assert error.max() <= tolerance * (1 + 1e-9)


@given(st.integers(0, 2**32))
def test_a_change_from_anywhere_within_intervals_is_bounded(seed):
    rng = np.random.default_rng(seed)
    change = random_bounds(rng, ["one"], 60)["one"]
    a, b = 10 ** rng.uniform(-1, 2, (2, 60)), rng.uniform(0.3, 8, 60)
    a.sort(axis=0)
    wide = np.stack([b, b * np.exp(rng.choice([0.0, 0.1], 60))])
    bound = pd_change_within(change, amplitude=tuple(a), threshold=tuple(wide))
    for _ in range(30):
        u, v = rng.random((2, 60))
        x, y = a[0] ** (1 - u) * a[1] ** u, wide[0] ** (1 - v) * wide[1] ** v
        f, g = inside_of(rng, change)
        moved = abs(marcum_q1(x * f, y * g).q - marcum_q1(x, y).q)
        assert (moved <= bound * (1 + 1e-9) + 1e-15).all()


def test_from_one_amplitude_it_is_the_change_of_pd_itself():
    change = Change(signal=(0.8, 1.1))
    a = np.linspace(0, 20, 50)
    ends = ((a, a), (6.5, 6.5))
    within = pd_change_within(change, amplitude=ends[0], threshold=ends[1])
    assert np.array_equal(within, pd_change(change, amplitude=a, threshold=6.5))


def test_small_changes_cost_little_over_a_wide_interval():
    # The slope of pd over ln a is about b / sqrt(2 pi) at the most
    change = Change(signal=(1 - 1e-4, 1 + 1e-4))
    within = pd_change_within(change, amplitude=(1e-3, 1e5), threshold=(6.55, 6.55))
    assert 6.55e-4 / np.sqrt(2 * np.pi) <= within <= 1.05 * 6.55e-4 / np.sqrt(2 * np.pi) + 1e-5
    loud = pd_change_within(change, amplitude=(20.0, 1e5), threshold=(6.55, 6.55))
    assert loud < 1e-30


def test_where_the_signal_is_drowned_or_overwhelming_anything_may_go():
    bounds = {"phases": Change(signal=(0.5, 10.4))}
    for a in (1e-3, 1e3):
        made = plan(bounds, amplitude=a, threshold=6.55, tolerance=1e-3)
        assert made.kept == () and made.error < 1e-8
    made = plan(bounds, amplitude=np.array([1e-3, 7.0, 1e3]), threshold=6.55, tolerance=1e-3)
    assert made.kept == ("phases",) and made.point == {"phases": 1}


def test_nothing_is_certain_of_a_sum_that_may_cancel():
    made = plan({"phases": Change(signal=(0.0, np.inf))}, amplitude=100.0, threshold=6.55,
                tolerance=0.5)  # fmt: skip
    assert made.kept == ("phases",) and made.needed["phases"] == pytest.approx(1.0)


def test_the_smallest_go_first_and_the_sum_counts():
    bounds = {"c": np.array([0.5, 0.0]), "a": np.array([0.0, 0.4]), "b": np.array([0.45, 0.1])}
    common = {"amplitude": np.ones(2), "threshold": np.ones(2)}
    made = plan(bounds, **common, tolerance=0.5)
    assert list(made.left_out) == ["a", "b"] and made.kept == ("c",)
    assert made.error == pytest.approx(0.5) and made.point == {"c": 0, "a": 1, "b": 0}
    made = plan(bounds, **common, tolerance=0.41)
    assert list(made.left_out) == ["a"] and made.needed == {"c": 0.5, "b": 0.45}


def test_forced_effects_stay_and_go_and_the_error_is_told():
    bounds = {"a": 1e-6, "b": 0.3, "c": 1e-7, "nothing": 0.0}
    modes = {"a": "on", "b": "off"}
    made = plan(bounds, amplitude=1.0, threshold=1.0, tolerance=1e-3, modes=modes)
    assert made.kept == ("a", "c") and list(made.left_out) == ["b", "nothing"]
    assert made.error == pytest.approx(0.3) and not made.within


def test_an_effect_inside_another_goes_before_it():
    bounds = {"footprint": 1e-6, "phases": 0.5, "spread": 1e-4}
    inside = {"footprint": ("phases", "spread")}
    common = {"amplitude": 1.0, "threshold": 1.0, "inside": inside}
    made = plan(bounds, **common, tolerance=1e-3)
    assert made.kept == ("footprint", "phases")
    made = plan(bounds, **common, tolerance=0.6)
    assert made.kept == ()
    made = plan(bounds, **common, tolerance=1e-3, modes={"footprint": "off"})
    assert made.kept == () and made.error == pytest.approx(0.500101) and not made.within
    with pytest.raises(ValueError, match="phases cannot be on"):
        plan(bounds, **common, tolerance=1e-3, modes={"footprint": "off", "phases": "on"})


def test_segments_add_up():
    change = Change(signal=(np.full((2, 3), 0.9), np.full((2, 3), 1.0)))
    a = np.array([[6.0, 7.0, 8.0], [5.0, 6.0, 7.0]])
    both = pd_changes({"one": change}, amplitude=a, threshold=6.5)["one"]
    apart = pd_change(Change(signal=(0.9, 1.0)), amplitude=a, threshold=6.5)
    assert both == pytest.approx(apart.sum(axis=0))


@pytest.mark.parametrize(
    ("bad", "words"),
    [({"modes": {"a": "maybe"}}, "no mode"), ({"modes": {"z": "on"}}, "no bound"),
     ({"inside": {"a": ("z",)}}, "no bound")],
)  # fmt: skip
def test_what_is_not_known_is_refused(bad, words):
    with pytest.raises(ValueError, match=words):
        plan({"a": 0.1}, amplitude=1.0, threshold=1.0, tolerance=0.1, **bad)


def test_the_order_of_points_and_their_blocks_change_no_decision_s_sum():
    rng = np.random.default_rng(3)
    bounds = random_bounds(rng, "abcd", 50)
    a, b = 10 ** rng.uniform(0, 1.5, 50), rng.uniform(4, 8, 50)
    one = plan(bounds, amplitude=a, threshold=b, tolerance=0.01)
    again = plan(bounds, amplitude=a, threshold=b, tolerance=0.01)
    turned = {
        name: Change(
            tuple(v[::-1] for v in c.signal), tuple(v[::-1] for v in c.noise), c.threshold_follows
        )
        for name, c in bounds.items()
    }
    back = plan(turned, amplitude=a[::-1], threshold=b[::-1], tolerance=0.01)
    assert one == again and one.kept == back.kept and one.left_out == back.left_out


@pytest.mark.slow
def test_a_plan_takes_a_microsecond_a_point_and_effect():
    rng = np.random.default_rng(3)
    bounds = random_bounds(rng, "abcdefgh", 20_000)
    a, b = 10 ** rng.uniform(0, 1.5, 20_000), rng.uniform(4, 8, 20_000)
    plan(bounds, amplitude=a, threshold=b, tolerance=0.01)
    least = min(timed(bounds, a, b) for _ in range(5))
    assert least / (8 * 20_000) < 1e-6


def timed(bounds, a, b):
    start = time.perf_counter()
    plan(bounds, amplitude=a, threshold=b, tolerance=0.01)
    return time.perf_counter() - start
