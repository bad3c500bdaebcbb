"""Footprint phase, image, leakage: true changes within bounds."""

import numpy as np
import pytest
from effect_points import (
    CLOSED,
    found,
    held,
    leakage_bound,
    magnitudes,
    point_block,
    scene,
    shots_of,
    tile_block,
)  # fmt: skip
from pd_changes import pd_change
from windows import marked

from sweep.model.effects import footprint_phase, image, leakage
from sweep.model.effects.catalogue import EFFECTS
from sweep.model.effects.planning import plan
from sweep.model.effects.span import Span
from sweep.model.shot import find
from sweep.model.spectra import segment_spectrum

POWERS = ("footprint", "doppler", "image")


def near_edges(seed):
    """Lines near DC and Nyquist, and elsewhere."""
    return {"range": 10 ** np.random.default_rng(seed).uniform(-1, 2, 30)} if seed % 2 else {}


@pytest.mark.parametrize("tiles", [False, True], ids=["points", "tiles"])
def test_phases_change_no_more_than_bound(table_4_1, tiles):
    for seed in range(16):
        close = {} if seed % 2 else {"range": 3.0, "grazing_angle": np.pi / 2}
        parameters = scene(
            table_4_1, 30, seed, fft_size=2**13, phases="coherent", window=CLOSED[seed % 4],
            across=0.0, **close,
        )  # fmt: skip
        block, inner = tile_block(parameters, seed) if tiles else (point_block(parameters),) * 2
        inner = inner if tiles else parameters
        shots = shots_of(inner, POWERS)
        on, off = found(inner, (*POWERS, "footprint_phase")), find(shots)
        change = footprint_phase.bound(block)
        assert held(change, on[:, 2], off[:, 2])[0].all()
        sigma = shots.bin_deviation
        most = pd_change(change, amplitude=off[:, 2] / sigma, threshold=shots.threshold / sigma)
        assert (abs(on[:, 0] - off[:, 0]) <= most + 1e-9).all()


def test_a_footprint_of_small_phases_adds_up_to_its_gain(table_4_1):
    parameters = scene(
        table_4_1, 40, 4, range=2.0, grazing_angle=np.pi / 2, phases="coherent", beamlets=61,
        beam_divergence=10 ** np.linspace(-5, -3.5, 40), window="hann", radial_velocity=50.0,
        across=0.0, fft_size=2**14,
    )  # fmt: skip
    block = point_block(parameters)
    on, off = (magnitudes(parameters, e) for e in ((*POWERS, "footprint_phase"), POWERS))
    phase = footprint_phase.phase_reach(block, block.ranges, block.spreads.velocities)[2]
    change = footprint_phase.bound(block)
    low, high = change.signal[0][2], change.signal[1][2]
    tight = phase < 0.3
    assert tight.sum() > 10 and (low[tight] > 0.9 * high[tight]).all()
    assert (low[~(phase < 2)] == 0).all()
    assert np.median(held(change, on, off)[1]) <= 30


def test_phases_are_a_matter_of_smooth_ground_and_optical_mixing(table_4_1):
    for scene_of in ({"phases": "incoherent"}, {"architecture": "direct", "phases": "coherent"}):
        assert footprint_phase.bound(point_block(scene(table_4_1, 3, 0, **scene_of))) is None


@pytest.mark.parametrize("tiles", [False, True], ids=["points", "tiles"])
def test_images_change_no_more_than_bound(table_4_1, tiles):
    ratios = []
    for seed in range(20):
        parameters = scene(
            table_4_1, 30, seed, fft_size=2**11, beamlets=7, window=CLOSED[seed % 4],
            beam_divergence=2e-4, grazing_angle=1.2, across=0.0, **near_edges(seed),
        )  # fmt: skip
        block, inner = tile_block(parameters, seed) if tiles else (point_block(parameters),) * 2
        inner = inner if tiles else parameters
        change = image.bound(block)
        on, off = (magnitudes(inner, e) for e in (POWERS, POWERS[:-1]))
        low = np.broadcast_to(change.signal[0], on.shape)
        inside, ratio = held(change._replace(signal=(low, change.signal[1])), on, off)
        assert inside.all()
        ratios.append(ratio)
    if not tiles:
        assert 1 <= np.median(np.concatenate(ratios)) <= 30


@pytest.mark.parametrize("beamlets", [1, 7])
def test_images_add_no_more_to_amplitudes_than_bound(table_4_1, beamlets):
    ratios = []
    for seed in range(20):
        parameters = scene(
            table_4_1, 30, seed, fft_size=2**11, phases="coherent", beamlets=beamlets,
            window=CLOSED[seed % 4], beam_divergence=2e-5, grazing_angle=1.2, across=0.0,
            **near_edges(seed),
        )  # fmt: skip
        block = point_block(parameters)
        change = image.bound(block)
        phased = (*POWERS, "footprint_phase")
        on, off = (magnitudes(parameters, set(phased) - without) for without in (set(), {"image"}))
        shots = shots_of(parameters, phased)
        whole = block.amplitude.high * shots.bin_deviation * block.gain.high
        most = change.added * whole * np.sqrt(block.echo_ratio.high)
        assert (abs(on - off) <= most * (1 + 1e-6) + 1e-12 * whole).all()
        seen = abs(on - off) > 1e-9 * whole
        ratios.append(most[seen] / abs(on - off)[seen])
    assert np.median(np.concatenate(ratios)) <= 30


def test_without_images_the_kernel_is_the_model_s_far_from_the_edges(table_4_1):
    parameters = scene(
        table_4_1, 6, 1, fft_size=2**11, phases="coherent", beamlets=7, window="hann",
        range=np.linspace(3000.0, 3100.0, 6), radial_velocity=0.0, across=0.0,
    )  # fmt: skip
    phased = (*POWERS, "footprint_phase")
    shots, alone = shots_of(parameters, phased), shots_of(parameters, set(phased) - {"image"})
    for i in range(6):
        bins, both = segment_spectrum(shots, i, 2)
        near = bins[both.argmax()] + np.arange(-5, 6)
        kernel = dict(zip(*segment_spectrum(alone, i, 2), strict=True))
        assert [kernel[k] for k in near] == pytest.approx(both[near], abs=1e-5 * both.max())


@pytest.mark.parametrize("tiles", [False, True], ids=["points", "tiles"])
def test_leakage_is_no_more_than_bound_and_nothing_without(table_4_1, tiles):
    bounds, truths = [], []
    whole = ("footprint", "doppler", "image", "leakage")
    for seed in range(24):
        phases = "coherent" if seed % 2 else "incoherent"
        power = 10 ** np.random.default_rng(seed).uniform(-7, 1, 30)
        parameters = scene(
            table_4_1, 30, seed, fft_size=2**13, phases=phases, power=power, across=0.0
        )
        block, inner = tile_block(parameters, seed) if tiles else (point_block(parameters),) * 2
        inner = inner if tiles else parameters
        effects = {*whole, "footprint_phase"} if phases == "coherent" else set(whole)
        seen, silent = (found(inner, e) for e in (effects, effects - {"leakage"}))
        np.testing.assert_allclose(seen[:, :5], silent[:, :5], 1e-9, 1e-300)
        assert not silent[:, 5].any()
        most = leakage_bound(block)
        assert (seen[:, 5] <= most + 1e-12).all()
        bounds.append(most.ravel())
        truths.append(seen[:, 5].ravel())
    bounds, truths = np.concatenate(bounds), np.concatenate(truths)
    assert (truths > 1e-6).sum() > 100 and (bounds < 1e-3).sum() > 100
    assert (bounds[truths < 1e-12] < 0.1).sum() > 100


FLAT = {
    "range": np.linspace(100, 300, 40), "grazing_angle": np.pi / 2,
    "beam_divergence": 10 ** np.linspace(-6, -4.5, 40),
}  # fmt: skip
"""Footprints so flat that their beamlets cannot cancel."""
LINES = (
    {"beamlets": 1},
    {"beamlets": 1, "phases": "coherent"},
    {"beamlets": 19},
    {"beamlets": 19, "phases": "coherent"} | FLAT,
)


@pytest.mark.parametrize("window", marked(("hamming", "hann", "blackman", "kaiser(8.6)")))
@pytest.mark.parametrize("lines", LINES, ids=["line", "coherent line", "powers", "amplitudes"])
def test_the_bound_on_leakage_is_near_what_leaks(table_4_1, window, lines):
    ratios = []
    for seed in range(10):
        power = 10 ** np.random.default_rng((4, seed)).uniform(-7, 1, 40)
        parameters = scene(
            table_4_1, 40, seed, fft_size=2**13, window=window, power=power, across=0.0, **lines
        )
        phased = {"footprint_phase"} if lines.get("phases") else set()
        leaks = found(parameters, {"footprint", "doppler", "image", "leakage"} | phased)[:, 5]
        most = leakage_bound(point_block(parameters))
        noticed = (leaks > 1e-9) & (leaks < 0.5)
        ratios.append(most[noticed] / leaks[noticed])
    ratios = np.concatenate(ratios)
    assert ratios.size > 200 and ratios.min() >= 1 and np.median(ratios) <= 30


@pytest.mark.parametrize("window", marked(("hamming", "hann", "blackman", "kaiser(8.6)")))
def test_the_bound_on_leakage_is_near_what_leaks_of_any_scene(table_4_1, window):
    of_all = {"footprint", "doppler", "image", "leakage"}
    ratios = {"incoherent": [], "coherent": []}
    for seed in range(16):
        power = 10 ** np.random.default_rng((5, seed)).uniform(-7, 1, 40)
        for phases, phased in (("incoherent", set()), ("coherent", {"footprint_phase"})):
            parameters = scene(
                table_4_1, 40, seed, fft_size=2**13, window=window, power=power, across=0.0,
                phases=phases,
            )  # fmt: skip
            leaks = found(parameters, of_all | phased)[:, 5]
            most = leakage_bound(point_block(parameters))
            assert (leaks <= most * (1 + 1e-9) + 1e-12).all()
            noticed = (leaks > 1e-9) & (leaks < 0.5)
            ratios[phases].append(most[noticed] / leaks[noticed])
    powers, amplitudes = (np.concatenate(each) for each in ratios.values())
    assert amplitudes.size > 300 and np.median(amplitudes) <= 200
    assert np.median(np.concatenate([powers, amplitudes])) <= 30 and np.median(powers) <= 10


@pytest.mark.parametrize("phases", ["incoherent", "coherent"])
def test_lines_spread_over_all_bins_and_beyond_may_leak_in_any(table_4_1, phases):
    parameters = scene(
        table_4_1, 30, 2, grazing_angle=np.geomspace(1e-4, 1e-2, 30), beam_divergence=2e-3,
        beamlets=7, phases=phases, power=np.geomspace(1e-2, 1e12, 30), fft_size=2**12, range=50.0,
    )  # fmt: skip
    block = point_block(parameters)
    with np.errstate(all="ignore"):  # other effects' bounds on infinite spreads
        most = leakage_bound(block)
    assert not np.isfinite(block.ranges.extreme[0]) and ((most >= 0) & (most <= 1)).all()
    phased = {"footprint_phase"} if phases == "coherent" else set()
    leaks = found(parameters, {"footprint", "doppler", "image", "leakage"} | phased)[:, 5]
    assert (np.nan_to_num(leaks) <= most * (1 + 1e-9) + 1e-12).all() and np.nanmax(leaks) > 1e-3


@pytest.mark.parametrize("phases", ["incoherent", "coherent"])
@pytest.mark.parametrize("window", marked(("hann", "hamming", "blackman")))
def test_as_many_bins_as_expected_are_moved_across_the_threshold_by_images(
    table_4_1, phases, window
):
    parameters = scene(
        table_4_1, 3000, 3, range=np.geomspace(4, 400, 3000), fft_size=2**12, window=window,
        power=10 ** np.random.default_rng(3).uniform(-3, 1, 3000), beamlets=1, phases=phases,
        radial_velocity=0.0, across=0.0, tnr=6.0,
    )  # fmt: skip
    block = point_block(parameters)
    (expected, taken), said = image.moved_bins(block), image.alarm_change(block)
    names = {*POWERS, *(["footprint_phase"] if phases == "coherent" else [])}
    on, off = (found(parameters, each)[[0, 2], 4] for each in (names, names - {"image"}))
    moved = abs(on - off).sum(axis=0)
    assert moved.sum() > 30 and moved.sum() <= expected.sum() <= 50 * moved.sum()
    assert (off <= taken).all()
    few = expected < 0.03
    assert moved[few].sum() <= expected[few].sum() + 5 * np.sqrt(expected[few].sum())
    assert (said == 0).sum() > 20 and not moved[said == 0].any()
    one = 1 / np.log(10) / 2**11
    assert (said[said > 0] >= one).all()
    np.testing.assert_array_equal(image.bound(block).alarms, said)


@pytest.mark.parametrize("counted", ["half", "all"])
def test_an_image_is_kept_where_a_bin_more_or_less_is_above_the_tolerance(table_4_1, counted):
    block = point_block(
        scene(
            table_4_1, 40, 3, range=np.linspace(118, 124, 40), fft_size=2**13, window="hann",
            beamlets=1, radial_velocity=1.0, across=0.0, power=1.0, tnr=6.0, bins_counted=counted,
            grazing_angle=np.pi / 2, duration=500e-6,
        )
    )  # fmt: skip
    only = [effect for effect in EFFECTS if effect.name == "image"]
    one = 1 / np.log(10) / 2**12
    fine, coarse = (plan(block, {}, share * one, only).kept for share in (0.9, 1.2))
    assert fine.all() == (counted == "half") and not coarse.any()


def test_thresholds_that_effects_raise_leak_more_and_drowned_ones_anything(table_4_1):
    block = point_block(scene(table_4_1, 40, 3, fft_size=2**12, window="hann", beamlets=1))
    level, magnitude = block.threshold.high, block.amplitude

    def leaks(low, high):
        return leakage.probability_bound(block, amplitude=magnitude, threshold=Span(low, high))

    still, higher = leaks(level, level), leaks(level, 1.5 * level)
    some = (still > 1e-9) & (higher < 1)
    assert some.any() and (higher[some] >= 1.2 * still[some]).all()
    assert (leaks(0.0 * level, level) == 1).all()
