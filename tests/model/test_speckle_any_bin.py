"""Echoes in developed speckle that any bin detects, compared with drawn bins.

Bins are drawn as Gaussian numbers with the covariance that a window's transform makes of lines of a
Gaussian density, and of white noise.
"""

import math

import numpy as np
import pytest

from sweep.model.detection.bin_noise import neighbour_noise_correlation
from sweep.model.detection.detectors import main_lobe_half_width
from sweep.model.detection.echo_detection import (
    BinSpeckle,
    BinThreshold,
    DetectionRule,
    EchoBins,
    mark_exempt_bins,
    pd_and_miss,
)
from sweep.model.detection.joint_tail import joint_tail_quadrature
from sweep.model.detection.speckle_modes import mode_table
from sweep.model.window import get_window, window_samples

LENGTH, DRAWS, LEVEL = 256, 20_000, 3.9


def drawn_and_expected(name, padding, spread, place, snr, seed=1):
    """Share of draws in which any bin of an echo crosses, and the probability of the model.

    ``spread`` of the lines in bins of fs/L, ``place`` between bins of fs/N, ``snr`` of the
    strongest bin.
    """
    rng, w, size = np.random.default_rng(seed), window_samples(name, LENGTH), LENGTH * padding
    time = (np.arange(LENGTH) - LENGTH / 2) / LENGTH
    centre, half = 100 * padding, int((10 + 4 * spread) * padding)
    bins = np.arange(centre - half, centre + half + 1)
    node = np.linspace(-5, 5, 401) if spread else np.zeros(1)
    weight = np.exp(-0.5 * node**2)
    weight /= weight.sum()
    lines = (centre + place) / padding + spread * node
    distance = bins[:, None] / padding - lines
    of_lines = (w * np.cos(2 * np.pi * distance[..., None] * time)).sum(axis=-1)
    signal = (of_lines * weight) @ of_lines.T
    signal *= 2 * snr / np.diag(signal).max()
    basis = w * np.exp(-2j * np.pi * np.outer(bins, time) / padding)
    noise = 2 * (basis @ basis.conj().T).real / (w**2).sum()
    magnitude, echo = np.sqrt(np.diag(signal)), np.zeros(bins.size, bool)
    shape = get_window(name, LENGTH)
    half_width = math.ceil(main_lobe_half_width(shape) * padding)
    mark_exempt_bins(magnitude, bins.size, LEVEL, echo, half_width)
    values, vectors = np.linalg.eigh((signal + noise)[np.ix_(echo, echo)])
    factor = vectors * np.sqrt(np.maximum(values, 0) / 2)
    detected = np.zeros(DRAWS, bool)
    for first in range(0, DRAWS, 5000):
        numbers = rng.normal(size=(5000, values.size, 2)) @ [1, 1j]
        detected[first : first + 5000] = (abs(numbers @ factor.T) >= LEVEL).any(axis=1)
    rule = DetectionRule(
        True,
        half_width,
        False,
        size,
        True,
        neighbour_noise_correlation(shape, size),
        False,
        joint_tail_quadrature(0.0),
        np.empty(0),
        mode_table(shape, size),
    )
    levels = BinThreshold(1.0, LEVEL, 1.0, 1.0)
    speckle = BinSpeckle(spread * padding, np.empty(0))
    pd, missed = pd_and_miss(
        EchoBins(magnitude, echo, int(bins[0])), int(magnitude.argmax()), rule, levels, speckle
    )
    assert pd + missed == pytest.approx(1, abs=1e-9)
    return detected.mean(), pd


WINDOWS = [("rectangular", 1), ("rectangular", 2), ("rectangular", 4), ("hann", 1),
           ("hamming", 2), ("flattop", 1), ("blackman", 1)]  # fmt: skip


@pytest.mark.parametrize(("name", "padding"), WINDOWS)
@pytest.mark.parametrize("place", [0.0, 0.4])
@pytest.mark.parametrize("snr", [5.0, 20.0, 200.0])
def test_a_lone_line_fades_as_one(name, padding, place, snr):
    drawn, pd = drawn_and_expected(name, padding, 0.0, place, snr)
    assert abs(drawn - pd) < 0.005 + 3 * np.sqrt(pd * (1 - pd) / DRAWS)


@pytest.mark.parametrize(("name", "padding"), WINDOWS)
@pytest.mark.parametrize(
    ("spread", "snr"),
    [(0.1, 20.0), (0.3, 20.0), (0.6, 20.0), (1.0, 20.0), (2.0, 20.0), (3.0, 5.0), (4.0, 5.0),
     (8.0, 5.0)],
)  # fmt: skip
def test_wider_echoes_fade_in_parts(name, padding, spread, snr):
    drawn, pd = drawn_and_expected(name, padding, spread, 0.3, snr)
    rule = 0.007
    if name == "rectangular":
        rule = 0.017 if padding == 1 else 0.032
    assert abs(drawn - pd) < rule + 3 * np.sqrt(max(pd * (1 - pd), 1e-3) / DRAWS)
