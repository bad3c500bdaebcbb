"""Footprint phase, image, leakage: true changes within bounds."""

import numpy as np
import pytest
from effect_points import drawn, held, magnitudes, range_moments

from sweep.model.effects import footprint_phase, image, leakage, line_spread
from sweep.model.effects.change import pd_change
from sweep.model.shot import find
from sweep.model.spectra import segment_spectrum

CLOSED = ("hamming", "hann", "rectangular", "blackman", "flattop")


def phase_bound(shots, values, segment):
    flat = line_spread.plane_range_moments(
        grazing_angle=values["grazing_angle"],
        beam_divergence=values["beam_divergence"],
        number=values["beamlets"],
        pattern="sunflower",
    )
    phase = footprint_phase.phase_reach(
        carrier=shots.carriers[segment],
        bandwidth=shots.bandwidth,
        range=shots.range,
        ranges=flat,
        velocity_bins=line_spread.NO_SPREAD,
        record_ratio=0.5,
    )
    return phase, footprint_phase.bound(
        line_spread.line_of(shots, segment),
        phase=phase,
        gain=footprint_phase.gain(shots),
        spread=range_moments(shots, values, segment),
        beamlets=values["beamlets"],
    )


def test_phases_change_no_more_than_bound(table_4_1):
    for seed in range(16):
        small = {} if seed % 2 else {"range": 3.0, "grazing_angle": np.pi / 2}
        shots, values = drawn(
            table_4_1, 30, seed, fft_size=2**13, phases="coherent", window=CLOSED[seed % 5], **small
        )
        powers = footprint_phase.without(shots)
        on, off = find(shots), find(powers)
        sigma = shots.bin_deviation
        for s in range(3):
            _, change = phase_bound(shots, values, s)
            assert held(change, on[s, 2], off[s, 2])[0].all()
            most = pd_change(change, amplitude=off[s, 2] / sigma, threshold=shots.threshold / sigma)
            assert (abs(on[s, 0] - off[s, 0]) <= most + 1e-9).all()


def test_a_footprint_of_small_phases_adds_up_to_its_gain(table_4_1):
    shots, values = drawn(
        table_4_1, 40, 4, range=2.0, grazing_angle=np.pi / 2, phases="coherent", beamlets=61,
        beam_divergence=10 ** np.linspace(-5, -3.5, 40), window="hann", radial_velocity=50.0,
    )  # fmt: skip
    on, off = magnitudes(shots), magnitudes(footprint_phase.without(shots))
    phase, change = phase_bound(shots, values, 2)
    low, high = change.signal
    tight = phase < 0.3
    assert tight.sum() > 10 and (low[tight] > 0.9 * high[tight]).all()
    assert (low[~(phase < 2)] == 0).all()
    assert np.median(held(change, on[2], off[2])[1]) <= 30


def test_direct_beats_have_no_powers(table_4_1):
    shots, _ = drawn(table_4_1, 3, 0, architecture="direct")
    with pytest.raises(ValueError, match="direct"):
        footprint_phase.without(shots)


def images_seen(shots, i, segment):
    """Largest bin with images, by the model, and without, and their bins."""
    bins, both = segment_spectrum(shots, i, segment)
    near = np.unique((bins[both.argmax()] + np.arange(-8, 9)).clip(0, shots.fft_size // 2))
    return both.max(), image.without(shots, i, segment, near).max()


@pytest.mark.parametrize("phases", ["incoherent", "coherent"])
def test_images_change_no_more_than_bound(table_4_1, phases):
    ratios = []
    for seed in range(10):
        beamlets = 1 if phases == "coherent" else 7
        shots, values = drawn(
            table_4_1, 12, seed, fft_size=2**11, phases=phases, beamlets=beamlets,
            window=CLOSED[seed % 5], beam_divergence=2e-4, grazing_angle=1.2,
        )  # fmt: skip
        for s in (0, 2):
            change = image.bound(
                line_spread.line_of(shots, s),
                spread=range_moments(shots, values, s),
                beamlets=beamlets,
                powers=phases == "incoherent",
            )
            pairs = np.array([images_seen(shots, i, s) for i in range(12)]).T
            inside, ratio = held(change, *pairs)
            assert inside.all()
            ratios.append(ratio)
    assert 1 <= np.median(np.concatenate(ratios)) <= 30


def test_without_images_the_kernel_is_the_model_s_far_from_the_edges(table_4_1):
    shots, _ = drawn(
        table_4_1, 6, 1, fft_size=2**11, phases="coherent", beamlets=7, window="blackman",
        range=np.linspace(3000.0, 3100.0, 6), radial_velocity=0.0,
    )  # fmt: skip
    for i in range(6):
        bins, both = segment_spectrum(shots, i, 2)
        near = bins[both.argmax()] + np.arange(-5, 6)
        assert image.without(shots, i, 2, near) == pytest.approx(both[near], abs=1e-5 * both.max())


def test_nothing_is_said_of_images_where_phases_may_cancel(table_4_1):
    shots, values = drawn(table_4_1, 8, 1, phases="coherent")
    change = image.bound(
        line_spread.line_of(shots, 0),
        spread=range_moments(shots, values, 0), beamlets=values["beamlets"], powers=False,
        least=0.0,
    )  # fmt: skip
    assert (change.signal[0] == 0).all() and np.isinf(change.signal[1]).all()


def test_leakage_is_no_more_than_bound_and_nothing_without(table_4_1):
    bounds, truths = [], []
    for seed in range(24):
        phases = "coherent" if seed % 2 else "incoherent"
        power = 10 ** np.random.default_rng(seed).uniform(-7, 1, 30)
        shots, values = drawn(table_4_1, 30, seed, fft_size=2**13, phases=phases, power=power)
        found = find(shots)
        silent = leakage.without(found)
        assert np.array_equal(found[:, :5], silent[:, :5]) and not silent[:, 5].any()
        whole = shots.amplitude.sum(axis=1)
        if shots.incoherent:
            whole = np.sqrt((shots.amplitude**2).sum(axis=1))
        peak = 0.5 * shots.beat_scale * whole[shots.row] * shots.window.sum
        for s in range(3):
            most = leakage.probability_bound(
                line_spread.line_of(shots, s),
                amplitude=peak / shots.bin_deviation,
                threshold=shots.threshold / shots.bin_deviation,
                extreme=range_moments(shots, values, s).extreme,
                fft_size=shots.fft_size,
                powers=shots.incoherent,
            )
            assert (found[s, 5] <= most + 1e-12).all()
            bounds.append(most)
            truths.append(found[s, 5])
    bounds, truths = np.concatenate(bounds), np.concatenate(truths)
    assert (truths > 1e-6).sum() > 100 and (bounds < 1e-3).sum() > 100
    assert (bounds[truths < 1e-12] < 0.1).sum() > 100
