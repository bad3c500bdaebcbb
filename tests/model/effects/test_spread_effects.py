"""Footprint, Doppler, Doppler spread, rotation, several returns: true changes within bounds."""

from dataclasses import replace

import numpy as np
import pytest
from effect_points import (
    drawn,
    held,
    magnitudes,
    moving_across,
    own_rows,
    range_moments,
    velocity_moments,
)

from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.effects import (
    doppler,
    doppler_spread,
    footprint,
    line_spread,
    rotation,
    several_returns,
)
from sweep.model.effects.change import pd_change
from sweep.model.footprint import beamlets as pattern_of
from sweep.model.geometry.platform import State
from sweep.model.shot import find

SEEDS = 12
CLOSED = ("hamming", "hann", "rectangular", "blackman", "flattop")


def small(seed):
    """Sizes that many spectra can be had of."""
    return 2 ** int(np.random.default_rng(seed).integers(12, 16))


def pd_held(change, with_effect, without, segment):
    """Whether the change of pd is within what the bound makes of it, (n,)."""
    sigma = without.bin_deviation
    on, off = find(with_effect)[segment, :3:2], find(without)[segment, :3:2]
    most = pd_change(change, amplitude=off[1] / sigma, threshold=without.threshold / sigma)
    return abs(on[0] - off[0]) <= most + 1e-9


def crossing(seed, number=30, **fixed):
    shots, values = drawn(fixed.pop("table"), number, seed, fft_size=small(seed), **fixed)
    across = 10 ** np.random.default_rng(seed).uniform(-1, 3, number)
    return moving_across(shots, values, across), values, across


def test_footprint_and_doppler_spread_change_no_more_than_bound(table_4_1):
    ratios = {"ranges": [], "velocities": []}
    for seed in range(SEEDS):
        shots, values, across = crossing(seed, table=table_4_1)
        level, together = footprint.without(shots), doppler_spread.without(shots)
        on, no_ranges, no_velocities = map(magnitudes, (shots, level, together))
        for s in range(3):
            line, n = line_spread.line_of(shots, s), values["beamlets"]
            ranges = range_moments(shots, values, s)
            velocities = velocity_moments(shots, values, s, across)
            change = footprint.bound(line, ranges=ranges, velocities=velocities, beamlets=n)
            inside, ratio = held(change, on[s], no_ranges[s])
            assert inside.all() and pd_held(change, shots, level, s).all()
            ratios["ranges"].append(ratio)
            change = doppler_spread.bound(line, velocities=velocities, ranges=ranges, beamlets=n)
            inside, ratio = held(change, on[s], no_velocities[s])
            assert inside.all() and pd_held(change, shots, together, s).all()
            ratios["velocities"].append(ratio)
    assert all(1 <= np.median(np.concatenate(r)) <= 30 for r in ratios.values())


@pytest.mark.parametrize("law", ["thesis", "lambert", "lommel_seeliger"])
def test_moments_bound_those_of_the_beamlets(table_4_1, law):
    for seed in range(20):
        shots, values = drawn(table_4_1, 60, seed, fft_size=4096, reflectance_law=law)
        velocity = 10 ** np.random.default_rng(seed).uniform(0, 3, (2, 60))
        shots = moving_across(shots, values, velocity[0], velocity[1])
        power = shots.amplitude**2 / (shots.amplitude**2).sum(axis=1, keepdims=True)
        for segment in (0, 2):
            ranges = range_moments(shots, values, segment)
            scale = shots.chirp_rate * shots.fft_size / shots.sample_rate * 2 / SPEED_OF_LIGHT
            bins = shots.offset * (scale * shots.range * (1 + abs(shots.beta)))[:, None]
            moments_are_bounds(ranges, power, bins)
        speeds = line_spread.plane_velocity_moments(
            across=velocity[0],
            along=velocity[1],
            grazing_angle=values["grazing_angle"],
            beam_divergence=values["beam_divergence"],
            number=values["beamlets"],
            pattern="hexagonal",
        )
        moments_are_bounds(speeds, power, shots.doppler * SPEED_OF_LIGHT / 2)


def moments_are_bounds(bounds, power, values):
    rounding = 1 + 1e-9
    mean, rms = abs((power * values).sum(axis=1)), np.sqrt((power * values**2).sum(axis=1))
    assert (mean <= bounds.mean * rounding + 1e-12).all()
    assert (rms <= bounds.rms * rounding + 1e-12).all()
    assert (abs(values).max(axis=1) <= bounds.extreme * rounding + 1e-12).all()
    assert np.median(bounds.rms / rms) < 1.5


def test_the_axis_amplitude_is_the_model_s_with_one_beamlet(table_4_1):
    for seed in range(6):
        shots, _ = drawn(table_4_1, 40, seed, fft_size=small(seed), beamlets=1)
        found = magnitudes(shots) / shots.bin_deviation
        for s in range(3):
            line = line_spread.line_of(shots, s)
            alone = line.edge > 200 * line.lobe.margin
            expected = line_spread.axis_amplitude(shots, s)
            assert found[s][alone] == pytest.approx(expected[alone], rel=3e-5)


def test_doppler_changes_no_more_than_bound(table_4_1):
    ratios = []
    for seed in range(SEEDS):
        window = CLOSED[seed % len(CLOSED)]
        shots, values, across = crossing(seed, table=table_4_1, window=window)
        still = doppler.without(shots)
        on, off = magnitudes(shots), magnitudes(still)
        for s in range(3):
            change = doppler.bound(
                line_spread.line_of(shots, s),
                line_spread.line_of(still, s),
                shift=shift_of(shots, s, shots.radial_velocity),
                spread=summed(
                    range_moments(shots, values, s), velocity_moments(shots, values, s, across)
                ),
                beamlets=values["beamlets"],
            )
            inside, ratio = held(change, on[s], off[s])
            assert inside.all() and pd_held(change, shots, still, s).all()
            ratios.append(ratio)
    assert np.median(np.concatenate(ratios)) <= 30


def shift_of(shots, segment, velocity):
    return doppler.shift(
        radial_velocity=velocity,
        range=shots.range,
        carrier=shots.carriers[segment],
        chirp_rate=shots.chirp_rate,
        bin_width=shots.sample_rate / shots.fft_size,
    )


def summed(*moments):
    columns = zip(*moments, strict=True)
    return line_spread.Moments(*(np.sum(np.broadcast_arrays(*m), axis=0) for m in columns))


def test_nothing_moves_nothing_changes(table_4_1):
    shots, values = drawn(table_4_1, 20, 3, radial_velocity=0.0, window="hann")
    line = line_spread.line_of(shots, 0)
    shift = shift_of(shots, 0, shots.radial_velocity)
    change = doppler.bound(
        line, line, shift=shift, spread=range_moments(shots, values, 0), beamlets=9
    )
    assert np.array_equal(change.signal, np.ones((2, 20)))
    change = doppler_spread.bound(line, velocities=line_spread.NO_SPREAD, beamlets=9)
    assert np.array_equal(change.signal, np.ones((2, 20)))


def test_rotation_is_a_velocity_of_the_instrument():
    # a ball of radius 3 that turns about a point off its centre, seen by beamlets all over it
    rng = np.random.default_rng(9)
    centre, pivot, rate = np.array([100.0, 5.0, -2.0]), rng.normal(size=3), rng.normal(size=3)
    rays = centre + rng.uniform(-1.5, 1.5, (200, 3))
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    along = rays @ centre
    far = along - np.sqrt(along**2 - centre @ centre + 9.0)
    surface = np.cross(rate, far[:, None] * rays - pivot)
    closing = -(surface * rays).sum(axis=1)
    velocity = rotation.equivalent_velocity(
        rate=rate[None], instrument=np.zeros((1, 3)), pivot=pivot[None]
    )
    assert closing == pytest.approx((velocity * rays).sum(axis=1), rel=1e-11)


def test_without_rotation_a_body_keeps_its_path_and_attitude():
    state = State(*(np.random.default_rng(1).normal(size=(5, k)) for k in (3, 3, 4, 3)))
    still = rotation.without(state)
    assert all(a is b for a, b in zip(state[:3], still[:3], strict=True)) and not still.rate.any()


def test_rotation_changes_no_more_than_bound(table_4_1):
    ratios = []
    for seed in range(SEEDS):
        shots, values, across = crossing(seed, table=table_4_1, window=CLOSED[seed % 5])
        rng = np.random.default_rng(seed)
        along = rng.normal(size=30) * 10 ** rng.uniform(-4, 1, 30)
        still = replace(
            shots,
            doppler=np.zeros_like(shots.doppler),
            radial_velocity=shots.radial_velocity - along,
        )
        on, off = magnitudes(shots), magnitudes(still)
        for s in range(3):
            change = rotation.bound(
                line_spread.line_of(shots, s),
                line_spread.line_of(still, s),
                shift=shift_of(shots, s, along),
                velocities=velocity_moments(shots, values, s, across),
                present=range_moments(shots, values, s),
                beamlets=values["beamlets"],
            )
            inside, ratio = held(change, on[s], off[s])
            assert inside.all() and pd_held(change, shots, still, s).all()
            ratios.append(ratio)
    assert np.median(np.concatenate(ratios)) <= 30


def test_several_returns_change_no_more_than_bound(table_4_1):
    ratios = []
    for seed in range(SEEDS):
        shots, values = drawn(
            table_4_1, 30, seed, fft_size=small(seed), beamlets=37, beam_divergence=200e-6
        )
        shots = own_rows(shots)
        rng = np.random.default_rng(seed)
        x = pattern_of(37)[0][0]
        others = x[None] > rng.uniform(0.0, 3.0, 30)[:, None]
        step = 10 ** rng.uniform(-1, 1.5, 30) * rng.choice([-0.3, 1], 30)
        further = np.where(others, (step / shots.range).clip(-0.5)[:, None], 0.0)
        shots = replace(shots, offset=shots.offset + further)
        single = several_returns.without(shots, others)
        power = shots.amplitude**2 / (shots.amplitude**2).sum(axis=1, keepdims=True)
        share = (power * others).sum(axis=1)
        on, off = magnitudes(shots), magnitudes(single)
        for s in range(3):
            apart = 0.0
            spread = range_moments(shots, values, s)
            if s != 1:
                scale = shots.chirp_rate * shots.fft_size / shots.sample_rate * 2 / SPEED_OF_LIGHT
                bins = shots.offset * (scale * shots.range * (1 + abs(shots.beta)))[:, None]
                apart = np.where(others, abs(bins), 0.0).max(axis=1)
                spread = own_moments(bins, power * ~others)
            change = several_returns.bound(
                line_spread.line_of(shots, s), share=share, apart=apart, spread=spread, beamlets=37
            )
            inside, ratio = held(change, on[s], off[s])
            assert inside.all() and pd_held(change, shots, single, s).all()
            ratios.append(ratio)
    assert 1 <= np.median(np.concatenate(ratios)) <= 30


def own_moments(bins, power):
    """Moments of the lines on the axis's surface, as a scene has them."""
    with np.errstate(invalid="ignore"):
        weight = np.nan_to_num(power / power.sum(axis=1, keepdims=True))
    return line_spread.Moments(
        abs((weight * bins).sum(axis=1)),
        np.sqrt((weight * bins**2).sum(axis=1)),
        np.where(weight > 0, abs(bins), 0.0).max(axis=1),
    )


def test_direct_beats_of_a_level_footprint_add_in_phase(table_4_1):
    shots, _ = drawn(table_4_1, 10, 2, beamlets=19, architecture="direct")
    alone = footprint.without(shots)
    assert alone.amplitude[:, 0] == pytest.approx(shots.amplitude.sum(axis=1))


def test_phases_go_before_the_footprint(table_4_1):
    shots, _ = drawn(table_4_1, 10, 2, beamlets=19, phases="coherent")
    with pytest.raises(ValueError, match="phases"):
        footprint.without(shots)
