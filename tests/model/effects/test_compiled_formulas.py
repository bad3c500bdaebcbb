"""What compiled formulas take and give back: shapes that broadcast, ends that are no numbers."""

import numpy as np
import pytest

from sweep.model.effects.change import Change
from sweep.model.effects.columns import columns
from sweep.model.effects.line_spread import (
    NO_SPREAD,
    Line,
    Moments,
    axis_ends,
    image_factor,
    instrument_ends,
    moved_change,
    power_range,
    range_to_bins,
    spreads,
    velocity_to_bins,
)
from sweep.model.effects.lobes import lobe
from sweep.model.effects.phase_bounds import Error, Peak, phase_change
from sweep.model.effects.probability_bounds import within_changes
from sweep.model.effects.span import Span
from sweep.model.window import window

LOBE = lobe("hann", 400, 512)
HANN = window("hann", 400)


def a_line(shape, seed=1):
    rng = np.random.default_rng(seed)
    offset = rng.uniform(0, 0.5, shape)
    transfer = rng.uniform(0.5, 1, shape)
    return Line(
        offset, offset * rng.uniform(0, 1, shape), rng.uniform(0, 200, shape), transfer,
        transfer * 0.9, rng.uniform(0, 0.01, shape), LOBE,
    )  # fmt: skip


def at(line, place):
    return Line(*(np.asarray(value[place]) for value in line[:-1]), LOBE)


@pytest.mark.parametrize("number", [1, 3, 32, 33, 100])
def test_columns_hold_what_broadcasting_would_make_of_any_number_of_values(number):
    values = [k * np.ones([(), (4,), (3, 1), (3, 4)][k % 4]) for k in range(number)]
    table, shape = columns(*values)
    assert shape == np.broadcast_shapes(*(value.shape for value in values))
    for row, value in zip(table, values, strict=True):
        np.testing.assert_array_equal(row.reshape(shape), np.broadcast_to(value, shape))


def test_a_lobes_tail_and_reach_are_each_others_inverse_at_all_ends():
    beyond = np.array([-np.inf, -1.0, 0.0, np.nan])
    np.testing.assert_array_equal(LOBE.tail(beyond), LOBE.envelope[0])
    assert LOBE.tail(np.array(np.inf)) == LOBE.envelope[-1]
    sizes = np.array([np.inf, LOBE.envelope[0], 0.0, -1.0, np.nan])
    away = LOBE.within(sizes)
    assert away[:2].tolist() == [0, 0] and np.isinf(away[3:]).all()
    for size in np.geomspace(LOBE.envelope[-1] * 1.01, LOBE.envelope[0], 50):
        away = LOBE.within(np.array(size))
        assert LOBE.tail(away) <= size < LOBE.tail(np.nextafter(away, 0)) or away == 0


def test_factors_and_powers_of_many_lines_are_those_of_each_alone():
    moved, still = a_line((3, 5)), a_line((3, 5), seed=2)
    added, present = (
        Moments(*(np.random.default_rng(k).uniform(0, 3, (3, n)) for _ in range(3)))
        for k, n in ((3, 5), (4, 1))
    )
    together = moved_change(moved, still, np.linspace(0, 0.1, 5), added, present, 7)
    powers, images = power_range(still, present, 7), image_factor(still, 1.0)
    assert np.shape(together.signal[0]) == powers[0].shape == images.shape == (3, 5)
    for s, t in np.ndindex(3, 5):
        own = Moments(*(value[s, t] for value in added))
        there = Moments(*(value[s, 0] for value in present))
        line = at(still, (s, t))
        alone = moved_change(at(moved, (s, t)), line, np.linspace(0, 0.1, 5)[t], own, there, 7)
        for many, one in zip(together.signal, alone.signal, strict=True):
            assert np.shape(one) == () and many[s, t] == one
        assert [p[s, t] for p in powers] == [*power_range(line, there, 7)]
        assert images[s, t] == image_factor(line, 1.0)


def test_lines_that_nothing_moves_are_not_changed_and_boundless_spreads_are_boundless():
    line = a_line((3, 4))
    low, high = moved_change(line, line, 0.0, NO_SPREAD, Moments(*[np.inf] * 3), 3).signal
    assert (low == 1).all() and (high == 1).all()
    low, high = moved_change(line, line, 0.0, Moments(*[np.inf] * 3), NO_SPREAD, 3).signal
    assert not np.isnan(low).any() and (low < 1).all() and (high >= 1).all()


def ends_of(rng, tiles):
    """Ends of a line's spans, and by name those that spreads follow from."""

    def span(scale):
        low = rng.uniform(-1, 1, tiles) * scale if scale < 1 else rng.uniform(0.5, 1, tiles) * scale
        return Span(low, low + rng.uniform(0, 0.2, tiles) * abs(scale))

    given = {"chirp_rate": span(1e13), "bin_width": span(1e5)}
    carriers, beta, far = (span(2e14), span(2e14), span(2.1e14)), span(1e-6), span(1e3)
    bandwidths = {"detector_bandwidth": span(1e9), "amplifier_bandwidth": span(2e9)}
    instrument = instrument_ends(carriers=carriers, **given, **bandwidths)
    ends = axis_ends(tiles, instrument, range=far, beta=beta)
    return ends, {"range": far, **given}, carriers, beta


def test_spreads_are_what_ranges_and_velocities_make_at_the_ends():
    rng = np.random.default_rng(5)
    ends, given, carriers, beta = ends_of(rng, 40)
    far, rate, width = given["range"].high, given["chirp_rate"].high, given["bin_width"].low
    sizes = [Moments(*rng.uniform(0, 1e-3, (3, 40))) for _ in range(3)]
    found = spreads(ends, ranges=sizes[0], own_ranges=sizes[1], velocities=sizes[2])
    per_range = range_to_bins(range=far, beta=beta.magnitude, chirp_rate=rate, bin_width=width)
    per_speed = [
        velocity_to_bins(range=far, carrier=carrier.high, chirp_rate=rate, bin_width=width)
        for carrier in carriers
    ]
    chirped = np.array([1.0, 0.0, 1.0])[:, None]
    for k in range(3):
        wide, own = (each[k] * per_range * chirped for each in sizes[:2])
        np.testing.assert_allclose(found.ranges[k], wide, rtol=1e-15)
        np.testing.assert_allclose(found.own_ranges[k], own, rtol=1e-15)
        np.testing.assert_allclose(found.velocities[k], sizes[2][k] * per_speed, rtol=2e-15)
        np.testing.assert_array_equal(found.both[k], found.ranges[k] + found.velocities[k])


def test_boundless_ranges_make_no_line_of_the_doppler_segment_wide():
    ends, *_ = ends_of(np.random.default_rng(5), 3)
    ends[4, :, 0] = 0.0  # no chirp
    boundless = Moments(1e-3, np.array([1.0, 2, 3]), np.inf)
    found = spreads(ends, ranges=boundless, own_ranges=boundless, velocities=NO_SPREAD)
    np.testing.assert_array_equal(np.array(found.ranges), np.array(found.own_ranges))
    extreme = found.ranges.extreme
    assert (extreme[:, 0] == 0).all() and (extreme[1] == 0).all()
    assert np.isfinite(extreme).all() and (extreme[[0, 2], 1:] > 1e199).all()
    np.testing.assert_array_equal(found.both.extreme, extreme)


def test_a_phase_error_of_unknown_size_may_do_anything_and_none_does_nothing():
    none = phase_change(Error((0.0,) * 4), window=HANN, peak=Peak(0.9, 1.0))
    assert none.signal[0] > 0.8 and none.signal[1] < 1.2
    for size in (np.nan, np.inf):
        low, high = phase_change(Error((size, 0.0, 0.0, 0.0), size), window=HANN).signal
        assert low < 0.1 and high >= 1 and not np.isnan(high)
    low, high = phase_change(Error((0.1,) * 4), window=HANN, peak=Peak(0.0, 1.0, False)).signal
    assert low == 0 and high >= 1


def test_phase_errors_broadcast_against_peaks_and_other_errors():
    rng = np.random.default_rng(5)
    error = Error(tuple(rng.uniform(0, 0.2, (3, 4)) for _ in range(4)), rng.uniform(0, 0.01, 4))
    others = Error((0.01, 0.0, 0.02, rng.uniform(0, 0.1, (3, 1))))
    low, high = phase_change(error, window=HANN, peak=Peak(0.85, 1.0), others=others).signal
    for s, t in np.ndindex(3, 4):
        own = Error(tuple(power[s, t] for power in error.powers), error.rest[t])
        there = Error((0.01, 0.0, 0.02, others.powers[3][s, 0]))
        one = phase_change(own, window=HANN, peak=Peak(0.85, 1.0), others=there).signal
        assert (low[s, t], high[s, t]) == one


def test_any_number_of_changes_leaves_what_they_leave_one_by_one():
    changes = [
        Change(signal=(0.99, 1 + 0.001 * k), noise=(1.0, np.linspace(1, 1.1, 4)), added=1e-4)
        for k in range(20)
    ]
    amplitude, threshold = Span.of(np.full((3, 4), 10.0)), Span.of(3.0)
    found, same = within_changes(changes, amplitude=amplitude, threshold=threshold)
    low, high = 10.0 * np.ones(4), 10.0
    for change in changes:
        low = low * 0.99 / np.sqrt(change.noise[1])
        high *= change.signal[1]
    np.testing.assert_allclose(found.low, np.tile(low - high * 0.002, (3, 1)), rtol=1e-12)
    np.testing.assert_allclose(found.high, high * 1.002, rtol=1e-12)
    assert (same.low == 3).all() and (same.high == 3).all()


def test_nothing_changes_magnitudes_and_thresholds_of_no_effects():
    one = np.ones((3, 1))
    for changes in ([Change()], []):
        found, same = within_changes(
            changes, amplitude=Span(one, 2 * one), threshold=Span(3.0, 4.0)
        )
        ends = np.array([found.low, found.high, same.low, same.high])
        assert (ends == np.arange(1.0, 5.0)[:, None, None]).all()
