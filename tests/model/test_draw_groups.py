"""Draws in groups: where their numbers lie, the law of a single draw, and how sure their means are.

A mean is as sure as stated if its exact value, found without draws, is within the half-width as
often. Functions of one and of two numbers with known integrals are the hardest: steps, of which a
group sees the place in one cell only.
"""

from itertools import pairwise

import numpy as np
import pytest
from scipy import stats

from sweep.model.error_budget import (
    bounded_mean_interval,
    grouped_mean_half_width,
    two_sided_normal_quantile,
    variance_of_grouped_draws,
)
from sweep.model.sampling import philox
from sweep.model.sampling.draw_groups import (
    DRAWS_PER_GROUP,
    GROUPED_NUMBERS_MAX,
    GroupMeans,
    grouped_uniforms,
)
from sweep.model.sampling.samplers import stopping_check_draws

CONFIDENCE = 0.95
STREAM = 14


def keys(n, seed=3):
    return philox.point_keys(np.arange(float(n))[:, None], domain="groups", seed=seed)


def numbers(n_points, draws, count=2, **options):
    """Uniform numbers (points, draws, count) of draws 0, 1, ..."""
    uniform_numbers = grouped_uniforms(
        np.repeat(keys(n_points), draws, axis=0), np.tile(np.arange(draws), n_points), STREAM,
        count, **options,
    )  # fmt: skip
    return uniform_numbers.reshape(n_points, draws, count)


def halves(uniform_numbers):
    """Pairs of which the second is an angle, as a distance from 0 that goes from 0 to 1."""
    distance = 1 - abs(2 * uniform_numbers[..., 1] - 1)
    return np.stack([uniform_numbers[..., 0], distance], axis=-1)


@pytest.mark.parametrize("are_polar", [False, True])
def test_each_pair_of_a_group_visits_every_cell_of_every_shape_once(are_polar):
    pairs = numbers(5, 3 * DRAWS_PER_GROUP, 6, are_polar=are_polar)
    pairs = pairs.reshape(-1, DRAWS_PER_GROUP, 3, 2)
    if are_polar:
        pairs = halves(pairs)
    for along in 2 ** np.arange(int(np.log2(DRAWS_PER_GROUP)) + 1):
        across = DRAWS_PER_GROUP // along
        cell = np.floor(pairs[..., 0] * along) * across + np.floor(pairs[..., 1] * across)
        np.testing.assert_array_equal(
            np.sort(cell, axis=1), np.arange(DRAWS_PER_GROUP)[None, :, None] + 0 * cell
        )


def test_a_number_depends_on_nothing_but_its_address():
    all_numbers = numbers(4, 200, 6)
    point, draw = np.array([3, 0, 2, 2, 1]), np.array([199, 64, 63, 5, 128])
    numbers_of_draw = grouped_uniforms(keys(4)[point], draw, STREAM, 2)
    np.testing.assert_array_equal(numbers_of_draw, all_numbers[point, draw, :2])
    other = grouped_uniforms(keys(4)[point], draw, STREAM + 1, 2)
    assert (other != numbers_of_draw).all()


@pytest.mark.parametrize("are_polar", [False, True])
@pytest.mark.parametrize("draw", [0, 1, 40, 63, 64])
def test_a_draw_alone_is_uniform_and_its_numbers_independent(draw, are_polar):
    n = 20_000
    first, second, third, fourth = grouped_uniforms(
        keys(n), np.full(n, draw), STREAM, 4, are_polar=are_polar
    ).T
    for values in (first, second, third, fourth):
        assert stats.kstest(values, "uniform").pvalue > 1e-4
    for values, other_numbers in ((first, second), (first, third), (second, fourth)):
        table = np.histogram2d(values, other_numbers, bins=16, range=[[0, 1], [0, 1]])[0]
        assert stats.chisquare(table.ravel()).pvalue > 1e-4


def test_numbers_beyond_the_first_are_independent_of_groups():
    count = GROUPED_NUMBERS_MAX + 2
    uniform_numbers = numbers(2, 2 * DRAWS_PER_GROUP, count)
    independent = philox.uniforms(
        np.repeat(keys(2), 2 * DRAWS_PER_GROUP, axis=0), np.tile(np.arange(2 * DRAWS_PER_GROUP), 2),
        STREAM, count,
    ).reshape(uniform_numbers.shape)  # fmt: skip
    grouped = uniform_numbers == independent
    assert grouped[..., GROUPED_NUMBERS_MAX:].all()
    assert not grouped[..., :GROUPED_NUMBERS_MAX].all(axis=(0, 1)).any()


def test_means_of_groups_are_numpys_however_draws_are_divided():
    random = np.random.default_rng(1)
    n_points, draws = 3, 5 * DRAWS_PER_GROUP + 17
    values = random.random((2, n_points, draws))
    values[1, 2] = np.nan
    all_means, parts = GroupMeans(n_points, ("a", "b")), GroupMeans(n_points, ("a", "b"))
    for means, edges in ((all_means, [0, draws]), (parts, [0, 1, 30, 64, 200, 201, draws])):
        for start, end in pairwise(edges):
            point = np.repeat(np.arange(n_points), end - start)
            number = np.tile(np.arange(start, end), n_points)
            columns = values[:, :, start:end].reshape(2, -1)
            means.add(point, number, dict(zip(("a", "b"), columns, strict=True)))
            restored = GroupMeans(n_points, ("a", "b"))
            restored.restore_state(means.state())
            means = restored  # goes on from what is stored
        group_means = (
            values[:, :, : 5 * DRAWS_PER_GROUP].reshape(2, n_points, 5, DRAWS_PER_GROUP).mean(-1)
        )
        n_values = np.isfinite(values).sum(axis=-1)
        statistics = means.statistics(np.arange(n_points), n_values)
        np.testing.assert_array_equal(statistics.n_groups, np.where(n_values, 5, 0))
        expected = np.where(n_values, group_means.var(axis=-1, ddof=1), np.nan)
        np.testing.assert_allclose(statistics.group_variance, expected, rtol=1e-12)


def half_widths(values):
    """Half-widths of trials (trials, draws), of whole groups and the rest."""
    trials, n = values.shape
    n_groups = n // DRAWS_PER_GROUP
    group_means = (
        values[:, : n_groups * DRAWS_PER_GROUP].reshape(trials, n_groups, -1).mean(axis=-1)
    )
    return grouped_mean_half_width(
        variance=values.var(axis=1, ddof=1),
        n_values=n,
        group_variance=group_means.var(axis=1, ddof=1),
        n_groups=n_groups,
        group_size=DRAWS_PER_GROUP,
        confidence=CONFIDENCE,
    )


def step(pd):
    return lambda u: (u[..., 0] < pd).astype(float)


def corner(pd):
    """A step along a diagonal, which no shape of cells follows."""
    return lambda u: (u.sum(axis=-1) < np.sqrt(2 * pd)).astype(float)


def power(pd):
    return lambda u: u[..., 0] ** (1 / pd - 1)


def product(pd):
    return lambda u: (u[..., 0] * u[..., 1]) ** (1 / np.sqrt(pd) - 1)


@pytest.mark.parametrize("draws", [128, 200, 448, 1024])
@pytest.mark.parametrize("function", [step, corner, power, product])
def test_means_over_groups_are_as_sure_as_promised(function, draws):
    """5 sigma of 1500 trials are 2.8 %. The mean of all trials is unbiased within 5 sigma."""
    trials = 1500
    uniform_numbers = numbers(trials, draws)
    for pd in (1e-3, 0.01, 1 / 64, 0.03, 0.1, 0.3, 0.4999, 0.5):
        values = function(pd)(uniform_numbers)
        mean = values.mean(axis=1)
        within = (abs(mean - pd) <= half_widths(values)).mean()
        assert within >= CONFIDENCE - 5 * np.sqrt(CONFIDENCE * (1 - CONFIDENCE) / trials), pd
        assert abs(mean.mean() - pd) <= 5 * mean.std(ddof=1) / np.sqrt(trials) + 1e-12, pd


@pytest.mark.parametrize("function", [step, corner, power, product])
def test_the_mean_of_a_group_varies_no_more_than_that_of_independent_draws(function):
    """Of powers u^p the variance in a cell of width h is h^2 s / 12, with s = p^2 / (2 p - 1).

    5 sigma of a variance of 4000 groups are 11 % of normal means, and more of others.
    """
    uniform_numbers = numbers(1, 4000 * DRAWS_PER_GROUP)[0]
    for pd in (0.03, 0.1, 0.3, 0.5):
        values = function(pd)(uniform_numbers)
        group_means = values.reshape(-1, DRAWS_PER_GROUP).mean(axis=1)
        assert DRAWS_PER_GROUP * group_means.var() < 0.5 * values.var()
        if function is power:
            exponent = 1 / pd - 1
            mean_squared_slope = exponent**2 / (2 * exponent - 1)
            in_cells = mean_squared_slope / (12 * DRAWS_PER_GROUP**2)
            assert DRAWS_PER_GROUP * group_means.var() == pytest.approx(in_cells, rel=0.3)


def test_half_widths_of_equal_values_are_what_so_many_draws_can_miss():
    z = two_sided_normal_quantile(CONFIDENCE)
    half_width = grouped_mean_half_width(
        variance=0.0, n_values=640, group_variance=0.0, n_groups=10, group_size=64,
        confidence=CONFIDENCE,
    )  # fmt: skip
    assert half_width == pytest.approx(z**2 / 640, rel=1e-12)


def test_half_widths_fall_to_students_and_those_of_independent_draws_bound_them():
    variance, n_groups = 0.09, 12
    n = DRAWS_PER_GROUP * n_groups
    arguments = {
        "variance": variance, "n_values": n, "n_groups": n_groups, "group_size": DRAWS_PER_GROUP,
        "confidence": CONFIDENCE,
    }  # fmt: skip
    spread = 1e-5
    half_width = grouped_mean_half_width(group_variance=spread, **arguments)
    student = stats.t.ppf(0.975, n_groups - 1) * np.sqrt(spread / n_groups)
    unseen = stats.norm.ppf(0.975) ** 2 / n
    # The root of d^2 = student^2 + unseen d.
    assert half_width == pytest.approx(unseen / 2 + np.hypot(student, unseen / 2), rel=1e-9)
    wide = grouped_mean_half_width(group_variance=1.0, **arguments)
    interval = bounded_mean_interval(mean=0.0, variance=variance, n_values=n, confidence=CONFIDENCE)
    assert wide == pytest.approx(float(interval.high), rel=1e-9)


@pytest.mark.parametrize(("batch", "limit"), [(100, 20_000), (7, 3000), (128, 1000), (64, 100)])
def test_tests_come_after_whole_groups(batch, limit):
    ends = np.array(list(stopping_check_draws(batch, limit, DRAWS_PER_GROUP)))
    assert ends[-1] == limit and (np.diff(ends) > 0).all()
    late = ends[(ends >= 2 * DRAWS_PER_GROUP) & (ends < limit)]
    assert (late % DRAWS_PER_GROUP == 0).all()
    early = ends[(ends < 2 * DRAWS_PER_GROUP) & (ends < limit)]
    assert (early % batch == 0).all()


@pytest.mark.parametrize("n_groups", [4, 6, 10, 20])
@pytest.mark.parametrize("ratio", [1.0, 0.3, 0.01])
def test_standard_errors_of_few_groups_are_not_too_small(n_groups, ratio):
    """Means of groups with `ratio` times the variance of independent draws, 20,000 times.

    A normal mean is beyond 1.96 of its standard errors in 5 % of the cases, and beyond 5 of them in
    none. Student's law for four groups has 0.4 % there.
    """
    rng = np.random.default_rng([n_groups, int(100 * ratio)])
    variance = 0.04
    means = rng.normal(0.0, np.sqrt(ratio * variance / DRAWS_PER_GROUP), (20_000, n_groups))
    counted = variance_of_grouped_draws(
        variance=variance, group_variance=means.var(axis=1, ddof=1), n_groups=n_groups,
        group_size=DRAWS_PER_GROUP, confidence=CONFIDENCE,
    )  # fmt: skip
    errors = np.abs(means.mean(axis=1)) / np.sqrt(counted / (n_groups * DRAWS_PER_GROUP))
    assert (errors > 1.96).mean() < 0.07
    assert (errors > 5).mean() < 0.006


@pytest.mark.parametrize(("pd", "tolerance"), [(0.5, 0.05), (0.5, 0.03), (0.2, 0.03)])
def test_stopping_is_as_sure_as_promised_where_groups_do_not_help(pd, tolerance):
    """Draws of 0 and 1 that are independent in spite of their groups, until accurate, 4,000 times.

    Three sigma of 4,000 trials are 1 %.
    """
    rng, n_trials, draws_max = np.random.default_rng(int(1000 * tolerance)), 4000, 3200
    values = rng.random((n_trials, draws_max)) < pd
    sums = np.cumsum(values, axis=1, dtype=np.int32)
    group_means = values.reshape(n_trials, -1, DRAWS_PER_GROUP).mean(axis=2)
    is_open, is_covered = np.ones(n_trials, bool), np.zeros(n_trials, bool)
    for n in stopping_check_draws(100, draws_max, DRAWS_PER_GROUP):
        n_groups = n // DRAWS_PER_GROUP
        if n_groups < 2:
            continue
        mean = sums[:, n - 1] / n
        half_width = grouped_mean_half_width(
            variance=mean * (1 - mean) * n / (n - 1), n_values=n,
            group_variance=group_means[:, :n_groups].var(axis=1, ddof=1), n_groups=n_groups,
            group_size=DRAWS_PER_GROUP, confidence=CONFIDENCE,
        )  # fmt: skip
        stops = is_open & (half_width <= tolerance)
        is_covered[stops] = np.abs(mean - pd)[stops] <= half_width[stops]
        is_open &= ~stops
    assert not is_open.any()
    assert is_covered.mean() > 0.94
