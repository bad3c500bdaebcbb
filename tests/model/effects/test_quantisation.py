"""Rounding: against records quantised sample by sample, and moments summed level by level."""

import numpy as np
import pytest
from adc import truth_quantise
from effect_points import point_block
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import ndtr

from sweep.model import window
from sweep.model.chain import prepare
from sweep.model.effects.block import Block
from sweep.model.effects.catalogue import DEFAULTS
from sweep.model.effects.quantisation import (
    bound,
    rounding_change,
    step,
    variance,
)
from sweep.model.effects.span import Span


def test_levels_fill_the_full_scale_and_hold_at_its_ends():
    ramp = np.linspace(-1.5, 1.5, 3001)
    out = truth_quantise(ramp, full_scale=1.0, bits=3)
    assert np.array_equal(np.unique(out), np.arange(-7, 8, 2) / 8)
    inside = abs(ramp) < 1
    assert step(full_scale=1.0, bits=3) == 0.25
    assert abs(out - ramp)[inside].max() <= 0.125 + 1e-12


@pytest.mark.parametrize("bits", range(4, 15))
def test_rounding_a_tone_with_noise_of_a_step_adds_white_noise(bits):
    """2^17 samples; a mean over M independent bins strays by 1/sqrt(M) of itself, 5 sigma."""
    number, rng = 2**17, np.random.default_rng(bits)
    lsb = float(step(full_scale=1.0, bits=bits))
    noise = lsb * rng.standard_normal(number)
    tone = min(0.7, 1 - 6 * lsb) * np.cos(2 * np.pi * 17321 * np.arange(number) / number + 0.3)
    record = truth_quantise(tone + noise, full_scale=1.0, bits=bits)
    error = abs(np.fft.rfft(record - tone - noise)[1:-1]) ** 2 / number
    white = float(variance(step=lsb))
    assert error.mean() / white == pytest.approx(1, abs=5 / np.sqrt(error.size))
    for band in np.array_split(error, 8):
        assert band.mean() / white == pytest.approx(1, abs=5 / np.sqrt(band.size))
    heard = abs(np.fft.rfft(record - tone)[1:-1]) ** 2 / number
    assert heard.mean() / (lsb**2 + white) == pytest.approx(1, abs=5 / np.sqrt(heard.size))


def moments(x, s, lsb):
    """Mean and variance of x + noise once rounded, by the chance of every level within 10 s."""
    reach = int(np.ceil((abs(x).max() + 10 * s) / lsb)) + 1
    edges = lsb * np.arange(-reach, reach + 1)
    level = (edges[1:] + edges[:-1]) / 2
    below = ndtr((edges - x[:, None]) / s)
    above = ndtr((x[:, None] - edges) / s)
    chance = np.where(edges[:-1] > x[:, None], above[:, :-1] - above[:, 1:], np.diff(below))
    mean = (chance * level).sum(axis=1)
    return mean, (chance * (level - mean[:, None]) ** 2).sum(axis=1)


def scene(s, amplitude, cycles, phase, second, name):
    """True factors on the tone's bin and on its noise, and the bound, for steps of 1."""
    n = np.arange(192)
    w = window.samples(name, n.size)
    x = amplitude * np.cos(2 * np.pi * cycles * n / n.size + phase)
    x += second * amplitude * np.cos(2 * np.pi * (cycles + 1.3) * n / n.size)
    mean, spread = moments(x, s, 1.0)
    turn = w * np.exp(-2j * np.pi * round(cycles) * n / n.size)
    plain = abs((turn * x).sum())
    true = abs((turn * mean).sum()) / plain, (w**2 * spread).sum() / ((w**2).sum() * s**2)
    change = rounding_change(
        step=Span.of(1.0), noise_variance=Span.of(s**2), magnitude=plain, window_sum=w.sum()
    )
    return true, change


@given(
    st.floats(0.02, 4), st.floats(0.05, 20), st.floats(3, 90), st.floats(0, 6.3), st.floats(0, 1),
    st.sampled_from(["rectangular", "hann", "hamming"]),
)  # fmt: skip
def test_no_rounded_record_strays_beyond_the_bound(s, amplitude, cycles, phase, second, name):
    true, change = scene(s, amplitude, cycles, phase, second, name)
    low, high = change.noise
    assert low * (1 - 1e-9) <= true[1] <= high * (1 + 1e-9)
    assert abs(true[0] - 1) <= change.added * (1 + 1e-9) + 1e-9


def test_the_bound_is_near_the_change():
    """Noise of 0.2 to 2 steps: the interval's far end against the true change, in logarithms."""
    rng = np.random.default_rng(3)
    ratios = []
    for _ in range(200):
        true, change = scene(
            10 ** rng.uniform(-0.7, 0.3), 10 ** rng.uniform(0, 1.3), rng.uniform(5, 80),
            rng.uniform(0, 6), 0.0, "hamming",
        )  # fmt: skip
        ends = abs(np.log(np.array(change.noise))).max()
        ratios.append(ends / abs(np.log(true[1])))
    assert np.median(ratios) < 1.5


def rounded(step, magnitude=100.0):
    return rounding_change(
        step=step, noise_variance=Span.of(1.0), magnitude=magnitude, window_sum=200.0
    )


def test_fine_steps_change_nothing_and_any_step_but_the_white_part_once_noise_spans_it():
    fine = rounded(Span.of(1e-9))
    np.testing.assert_allclose(fine.noise, 1, atol=1e-12)
    assert fine.added < 1e-12
    coarse = rounded(Span.of(1.0))
    np.testing.assert_allclose(coarse.noise, 1 + 1 / 12, rtol=3e-8)
    assert rounded(Span.of(0.0)).noise == (1.0, 1.0)
    assert coarse.threshold_follows
    wide = rounded(Span(0.5, 1.0))
    np.testing.assert_allclose(wide.noise, [1 + 1 / 48, 1 + 1 / 12], rtol=3e-8)


def test_the_scene_s_noise_gains_what_the_bound_says(table_4_1):
    bits = np.array([0.0, 3.0, 5.5, 8.0, 12.0])
    scene = DEFAULTS | table_4_1(fft_size=1024) | {
        "instrument.processing.bits": bits, "instrument.processing.full_scale": 10e-3,
    }  # fmt: skip
    change = bound(point_block(scene))
    ((_, shots),), ((_, without),) = (prepare(scene, e) for e in (("quantisation",), ()))
    true = shots.noise_variance / without.noise_variance
    low, high = change.noise
    assert (low <= true * (1 + 1e-12)).all() and (true <= high * (1 + 1e-12)).all()
    assert true[1] > 1.01 and high[3:] == pytest.approx(true[3:], rel=1e-6)
    assert bound(point_block(scene | {"instrument.processing.bits": 0.0})) is None
    mixed = {p: v if isinstance(v, str) else Span.of(v) for p, v in scene.items()}
    mixed |= {"instrument.processing.bits": Span(np.array([0.0]), np.array([12.0]))}
    low, high = bound(Block.of_plane(mixed)).noise
    assert (low <= true).all() and (true <= high).all()
