"""Pairing of peaks: against plain arrays, constructed scenes and a search of all pairings."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from shot_helpers import prepare_single_category

from sweep.model import waveform
from sweep.model.pointcloud.pairing import (
    CONFIRMATION_TOLERANCE_BINS,
    DopplerPrediction,
    PeakPairs,
    find_confirming_peak,
    pair_peaks,
)
from sweep.model.pointcloud.returns import DrawConfig, _doppler_prediction

N, FS = 2**17, 600e6
WIDTH = FS / N
OPTICS = {"carrier": 299792458.0 / 1550e-9, "bandwidth": 1e9, "duration": 500e-6}
_SHARE = 0.5 * OPTICS["carrier"] / (OPTICS["carrier"] + OPTICS["bandwidth"] / 2)
AT_START = DopplerPrediction(_SHARE, _SHARE, 0.0)


def _beats(target_range, radial_velocity):
    """Folded peaks [bins] of a target in the up, Doppler and down segment."""
    carriers = OPTICS["carrier"] + np.array([0.0, 0.0, OPTICS["bandwidth"]])
    signed = [
        waveform.beat_frequency(
            sign,
            carrier=carrier,
            chirp_rate=OPTICS["bandwidth"] / OPTICS["duration"],
            range=target_range,
            radial_velocity=radial_velocity,
        )
        for sign, carrier in zip((1, 0, -1), carriers, strict=True)
    ]
    return [waveform.fold_frequency(np.array(f), np.array(FS)) / WIDTH for f in signed]


def _pair(
    up, doppler, down, tolerance=CONFIRMATION_TOLERANCE_BINS, assumed=waveform.FAR_TARGET_READING
):
    """(confirmed, [(up, doppler, down, code)])."""
    lists = [np.array(x, float).ravel() for x in (up, doppler, down)]
    size = max(lists[0].size, lists[2].size, 1)
    pairs = PeakPairs.allocate(size)
    confirmed, number = pair_peaks(*lists, AT_START, float(N), 0.0, assumed, tolerance, pairs)
    return confirmed, [tuple(map(int, p)) for p in zip(*pairs, strict=True)][:number]


def _reported(up, down, code):
    beats = waveform.doppler_and_range_beat(code, up * WIDTH, down * WIDTH, FS)
    return waveform.range_velocity_of_beats(*beats, *OPTICS.values())


def _confirmed(up, doppler, down, tolerance):
    """(reading, cost) of one triple [bins]."""
    cost, _, code = find_confirming_peak(
        up, np.array([doppler]), down, AT_START, float(N), 0.0, tolerance
    )
    return code, cost


def _scene(*targets):
    """Peaks of targets by segment, (3, targets)."""
    return np.round(np.transpose([_beats(*t) for t in targets]))


def _agrees(reported, target):
    """Half a bin in each of two peaks: 0.343 m and 3.55 mm/s at most; leading order as much."""
    return abs(reported[0] - target[0]) < 0.7 and abs(reported[1] - target[1]) < 0.0071


# One triple


@pytest.mark.parametrize("down_slope", [-1.0, 0.25, 3.0])
@pytest.mark.parametrize("far", [0.02, 0.15, 0.24])
def test_signed_beats_of_any_slope_confirm_each_other_at_any_range(table_4_1, down_slope, far):
    """Beats f_d - slope f_r of complex records wrap; f_r is such a share of the sample rate."""
    scene = table_4_1(fft_size=4096) | {
        "instrument.receiver.record": "complex", "instrument.chirp.down_slope": down_slope,
    }  # fmt: skip
    shots = prepare_single_category(scene)
    signed, third = (
        DrawConfig.from_shots(shots, 0, False).down_beat_sign,
        DopplerPrediction(*map(float, _doppler_prediction(shots))),
    )
    f_r, f_d, size = far * 4096.0, 700.0, 4096.0
    # carriers differ by 5e-6, and Doppler shifts with them by less than a hundredth of a bin
    up, doppler, down = (
        (beat + size / 2) % size - size / 2 for beat in (f_d - f_r, f_d, f_d - down_slope * f_r)
    )
    cost, peak, _ = find_confirming_peak(
        up, np.array([doppler]), down, third, size, signed, CONFIRMATION_TOLERANCE_BINS
    )
    assert peak == 0 and cost < 0.05


def test_a_tolerance_takes_the_cheapest_reading_among_those_within_it():
    up, doppler, down = _beats(9000.0, 170.0)  # the down beat lies past Nyquist
    up, doppler, down = float(up), float(doppler), float(down)
    code, cost = _confirmed(up, doppler, down, 3.0)
    assert code & 0b1110 == 0b0010
    assert waveform.FOLD_PENALTY_BINS <= cost < waveform.FOLD_PENALTY_BINS + 0.5
    assert _confirmed(up, doppler + 4000.0, down, 3.0) == (-1, np.inf)
    assert _confirmed(up, doppler + 4000.0, down, np.inf)[0] >= 0


def test_a_peak_confirms_others_by_chance_as_rarely_as_stated():
    """1.5e-3 at most for peaks anywhere: below it by 5 sigma of 40,000 triples, and not nothing."""
    generator = np.random.default_rng(2)
    triples = generator.uniform(0, N / 2, (40_000, 3))
    hits = sum(_confirmed(*t, CONFIRMATION_TOLERANCE_BINS)[0] >= 0 for t in triples)
    chance = 16 * 2 * CONFIRMATION_TOLERANCE_BINS / (N / 2)
    assert chance == pytest.approx(1.5e-3, rel=0.03)
    assert 0.1 * chance < hits / 40_000 <= chance + 5 * np.sqrt(chance / 40_000)


# Scenes


SCENES = {
    "common velocity": [(2000.0, 12.0), (2009.0, 12.0)],
    "different velocities": [(1500.0, 40.0), (1700.0, -25.0)],
    "equal ranges": [(800.0, 30.0), (800.0, 31.0)],
    "opposite velocities": [(800.0, 30.0), (800.0, -30.0)],
    "past Nyquist": [(9000.0, 170.0), (9100.0, 170.0)],
    "range beat above and below the Doppler shift": [(400.0, 60.0), (6000.0, 2.0)],
    "four layers": [(250.0, 5.0), (254.0, 5.0), (259.0, 5.0), (262.0, 5.0)],
}


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("order", [1, -1])
def test_every_surface_is_found_whatever_the_order_of_its_peaks(name, order):
    targets = SCENES[name]
    up, doppler, down = _scene(*targets)
    doppler = np.unique(doppler)
    confirmed, pairs = _pair(up, doppler, down[::order])
    assert confirmed == len(pairs) == len(targets)
    for i, (u, k, d, code) in enumerate(pairs):
        assert u == i
        assert k >= 0
        assert _agrees(_reported(up[u], down[::order][d], code), targets[i])


def test_false_peaks_among_true_ones_are_paired_last_and_unconfirmed():
    up, doppler, down = _scene(*SCENES["different velocities"])
    confirmed, pairs = _pair([*up, 20011.0], doppler, [31000.0, *down])
    assert confirmed == 2
    assert [(u, d) for u, _, d, _ in pairs] == [(0, 1), (1, 2), (2, 0)]
    assert pairs[2][1] == -1


def test_a_false_peak_alone_leaves_the_true_pair_as_it_was():
    up, doppler, down = _scene((2000.0, 12.0))
    confirmed, pairs = _pair([5000.0, *up], [*doppler, 61000.0], down)
    assert confirmed == 1
    assert [p[:3] for p in pairs] == [(1, 0, 0)]


@pytest.mark.parametrize("assumed", [waveform.FAR_TARGET_READING, waveform.FAST_TARGET_READING])
@pytest.mark.parametrize(
    ("doppler", "target"),
    [
        ([], (500.0, 60.0)),
        ([], (500.0, 2.0)),
        ([41234.0], (500.0, 60.0)),
        ([41234.0], (500.0, 2.0)),
    ],
)
def test_without_a_doppler_peak_of_its_own_a_pair_is_read_as_assumed(assumed, doppler, target):
    """Right for a far target, or a fast one; range and velocity are exchanged for another."""
    up, _, down = _scene(target)
    confirmed, pairs = _pair(up, doppler, down, assumed=assumed)
    assert confirmed == 0
    assert pairs == [(0, -1, 0, assumed)]
    right = (target[1] == 60.0) == (assumed == waveform.FAST_TARGET_READING)
    assert _agrees(_reported(up[0], down[0], assumed), target) == right
    f_r = 2e12 * 2 * target[0] / 299792458.0
    f_d = 2 * target[1] / 1550e-9
    other = _reported(up[0], down[0], assumed ^ 1 if right else assumed)
    assert other[1] == pytest.approx(f_r * 1550e-9 / 2, rel=1e-3)
    assert other[0] == pytest.approx(f_d * 299792458.0 / 4e12, rel=1e-3)


def test_a_doppler_peak_out_of_tolerance_still_decides_the_order():
    up, doppler, down = _scene((500.0, 2.0))
    confirmed, pairs = _pair(up, doppler + 10.0, down)
    assert confirmed == 0
    assert _agrees(_reported(up[0], down[0], pairs[0][3]), (500.0, 2.0))
    assert _pair(up, doppler + 10.0, down, tolerance=11.0)[0] == 1


def test_missing_peaks_leave_fewer_returns():
    up, doppler, down = _scene(*SCENES["different velocities"])
    assert _pair([], doppler, down) == (0, [])
    assert _pair(up, doppler, []) == (0, [])
    confirmed, pairs = _pair(up[1:], doppler, down)
    assert confirmed == 1
    assert [p[:3] for p in pairs] == [(0, 1, 1)]


@given(st.integers(0, 2**32 - 1), st.integers(1, 4), st.integers(1, 4), st.integers(1, 3))
def test_no_other_pairing_has_more_confirmed_pairs_or_less_mismatch(seed, ups, downs, dopplers):
    """Crowded lists with a wide tolerance, against every one-to-one pairing there is."""
    generator = np.random.default_rng(seed)
    up, down = generator.uniform(0, 400, ups), generator.uniform(0, 400, downs)
    doppler = generator.uniform(0, 400, dopplers)
    tolerance = 60.0

    def mismatch(u, d):
        return min(_confirmed(u, p, d, tolerance)[1] for p in doppler)

    cost = np.array([[mismatch(u, d) for d in down] for u in up])
    best = (0, 0.0)
    places = [*range(downs), *[None] * ups]
    for choice in set(itertools.permutations(places, ups)):
        chosen = [cost[i, j] for i, j in enumerate(choice) if j is not None]
        if np.isfinite(chosen).all():
            best = min(best, (-len(chosen), sum(chosen)))
    confirmed, pairs = _pair(up, doppler, down, tolerance)
    assert confirmed == -best[0]
    assert sum(cost[u, d] for u, _, d, _ in pairs[:confirmed]) == pytest.approx(best[1])
    assert len(pairs) == min(ups, downs)
    assert len({p[0] for p in pairs}) == len({p[2] for p in pairs}) == len(pairs)
