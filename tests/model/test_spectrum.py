"""Lines and their spectrum: exact sums over samples, nothing left out.

Places, phases and far sidelobes in many digits are cases of `tests/stability`.
"""

import numpy as np
import pytest
from shot_helpers import line_shape_of_window, parametrize_product

from sweep.model.evaluation import prepare_shots
from sweep.model.spectrum.bin_spectrum import AveragingShifts, LineBundle, allocate_workspace
from sweep.model.spectrum.bin_spectrum import compute_magnitudes as magnitudes_of
from sweep.model.spectrum.lines import (
    AMPLITUDE_TOLERANCES,
    NODES_MAX,
    n_required_nodes,
    phase_span_max_table,
    replace_lines_by_nodes,
)
from sweep.model.spectrum.segment_spectra import bin_tangents
from sweep.model.spectrum.segment_spectra import segment_spectrum as segment_spectrum
from sweep.model.window import COSINE_SUM_COEFFICIENTS, get_window, window_samples

AT_THE_ENDS = 0.0, 1.0
"""Weights of a band that may be all at its ends: of windows of which nothing is known."""

TABULATED = ("kaiser(8.6)", "chebwin(100)", "dpss(3)", "tukey(0.3)", "gaussian(300)")


def magnitudes(name, sizes, origin, delta, weights, *, power=False, low=0, high=None):
    """|X| of bins low .. high from lines of weights C_b at delta bins from the origin."""
    fft_size, length = sizes
    high = fft_size // 2 if high is None else high
    n, count, delta = len(delta), high - low + 1, np.asarray(delta, float)
    prepared = line_shape_of_window(get_window(name, length), fft_size, power=power)
    workspace = allocate_workspace(max(count, n) + 16)
    lines = workspace.line_spectrum.lines
    lines.position[:n], lines.im[:n] = delta, 0.0 if power else np.imag(weights)
    lines.re[:n] = np.abs(weights) ** 2 if power else np.real(weights)
    magnitudes_of(
        low, count, LineBundle(origin, n, delta.min(), delta.max(), 0.0), 0.0,
        AveragingShifts(np.empty(0), np.empty(0)), prepared.shape, prepared.layout,
        bin_tangents(fft_size), workspace,
    )  # fmt: skip
    return workspace.span.magnitude[:count].copy()


def record_of(sizes, origin, delta, weights):
    """Records of the tones that those weights stand for, complex, (lines, L).

    C = a/2 e^{i (phi + pi nu r)}: the phase is that at mid-record. Whole bins turn by whole
    multiples of 1/N, taken exactly.
    """
    fft_size, length = sizes
    n = np.arange(length)
    cycles = (n * origin) % fft_size / fft_size - (length * origin) % (2 * fft_size) / fft_size / 2
    part = np.outer(delta, n - length / 2) / fft_size
    return 2 * np.asarray(weights)[:, None] * np.exp(2j * np.pi * (cycles + part))


def bundle(rng, number, spread):
    delta = rng.uniform(-spread, spread, number)
    weights = (rng.normal(size=number) + 1j * rng.normal(size=number)) * rng.uniform(0, 1, number)
    return delta, weights


SIZES = [(256, 256), (255, 255), (256, 200), (255, 201), (2000, 77), (4096, 4096), (5000, 4097)]


@pytest.mark.parametrize(
    ("name", "sizes"), parametrize_product(5, [*COSINE_SUM_COEFFICIENTS, *TABULATED], SIZES)
)
def test_bins_are_those_of_the_discrete_fourier_transform(name, sizes):
    """Lines anywhere, near DC and Nyquist and beyond them, and their images."""
    fft_size, length = sizes
    rng = np.random.default_rng((40, fft_size, length))
    w = window_samples(name, length)
    # A table's polynomial misses e^{i pi y}, the ends of the record, by some 1e-12 of their weight.
    accuracy = 1e-12 + 3e-12 * w[0]
    for spread in (1e-9, 0.7, 12.0, fft_size / 2):
        for origin in (0, 1, fft_size // 5, fft_size // 2):
            delta, weights = bundle(rng, 5, spread)
            record = record_of(sizes, origin, delta, weights)
            unit = np.abs(weights).sum() * w.sum()
            exact = np.abs(np.fft.rfft(w * record.sum(axis=0).real, fft_size))
            fast = magnitudes(name, sizes, origin, delta, weights)
            assert np.abs(fast - exact).max() < accuracy * unit
            halves = np.fft.fft(w * record, fft_size) / 2
            mirrored = halves[:, -np.arange(fft_size // 2 + 1)]
            exact = (np.abs(halves[:, : fft_size // 2 + 1]) ** 2 + np.abs(mirrored) ** 2).sum(
                axis=0
            )
            fast = magnitudes(name, sizes, origin, delta, weights, power=True)
            assert np.abs(fast**2 - exact).max() < accuracy * unit**2


# Few lines for many


def few_for(delta, weights, tolerance, limits):
    """Places and weights of as few lines as stand for many."""
    n, middle, half = delta.size, (delta.max() + delta.min()) / 2, np.ptp(delta) / 2
    workspace = allocate_workspace(n + 16)
    lines, nodes = workspace.line_spectrum.lines, workspace.nodes
    lines.position[:n], lines.re[:n], lines.im[:n] = delta, np.real(weights), np.imag(weights)
    n_nodes = n_required_nodes(np.pi * half, tolerance, limits)
    number = replace_lines_by_nodes(
        lines, n, n_nodes, middle, half, workspace.line_spectrum.line_scratch, nodes
    )
    return nodes.position[:number].copy(), nodes.re[:number] + 1j * nodes.im[:number]


@pytest.mark.parametrize("tolerance", [0.0, 3e-9, 1e-5])
@pytest.mark.parametrize("centre", [0.0, -0.31, 0.49])
def test_few_lines_have_the_same_spectrum_for_bundles_of_any_width(centre, tolerance):
    """Sum of C e^{i u delta} for |u| <= pi, to what is allowed of the summed amplitudes."""
    rng = np.random.default_rng(43)
    limits, u = (
        phase_span_max_table(AT_THE_ENDS, AMPLITUDE_TOLERANCES),
        np.linspace(-np.pi, np.pi, 41),
    )
    allowed = max(tolerance, 1e-13) + 109 * 2.3e-16 + np.pi * np.spacing(abs(centre))
    for spread in 10 ** np.linspace(-16, 2, 60):
        delta, weights = bundle(rng, 109, spread)
        delta += centre
        few, strength = few_for(delta, weights, tolerance, limits)
        assert few.size <= 109
        many_sum = np.exp(1j * u[:, None] * (delta - centre)) @ weights
        few_sum = np.exp(1j * u[:, None] * (few - centre)) @ strength
        assert np.abs(few_sum - many_sum).max() < 2 * allowed * np.abs(weights).sum(), spread


def test_a_tight_bundle_takes_few_lines_and_a_wide_one_stays_as_it_is():
    limits, counts = phase_span_max_table(AT_THE_ENDS, AMPLITUDE_TOLERANCES), []
    for spread in (0.0, 0.1, 1.0, 5.0, 200.0):
        delta = np.linspace(-spread, spread, 109)
        few, _ = few_for(delta, np.ones(109), 0.0, limits)
        counts.append(few.size)
    assert counts[0] == 1
    assert counts[1] <= 10
    assert counts == sorted(counts)
    assert counts[-1] == 109 and np.array_equal(few, delta)
    assert limits.shape == (len(AMPLITUDE_TOLERANCES), NODES_MAX + 1)


@pytest.mark.parametrize("name", ["rectangular", "hann", "hamming", "flattop"])
@pytest.mark.parametrize("tolerance", [1e-2, 1e-6, 1e-10])
def test_few_lines_are_as_good_in_every_bin_as_the_window_lets_them(name, tolerance):
    """Lines in phase at the ends of their bundle, the worst there are: by direct sums."""
    limits = get_window(name, 256).phase_span_max_table(False)
    record = window_samples(name, 256) * np.exp(
        2j * np.pi * np.outer(np.arange(-20, 21), np.arange(256)) / 256
    )
    t = np.arange(256) / 128 - 1
    for half in (0.3, 1.0, 3.0, 8.0):
        delta = np.repeat([-half, 0.9 * half, half], 36)
        few, strength = few_for(delta, np.ones(108), tolerance, limits)
        assert few.size < 108
        many = record @ np.exp(1j * np.pi * np.outer(t, delta)).sum(axis=1)
        spectrum = record @ (np.exp(1j * np.pi * np.outer(t, few)) @ strength)
        # What nodes alias onto the terms that are there is as much again.
        scale = 108 * np.abs(window_samples(name, 256)).sum()
        assert np.abs(many - spectrum).max() <= 2 * tolerance * scale + 1e-12 * scale


# What is left out


@pytest.mark.parametrize(
    ("name", "fft_size"),
    parametrize_product(
        7, ["rectangular", "hann", "hamming", "chebwin(60)", "kaiser(4)"], [2047, 2048, 4096]
    ),
)
def test_bins_that_a_level_leaves_out_hold_less_and_the_others_are_unchanged(
    name, fft_size, table_4_1
):
    for number, (r, grazing, phases, delay) in enumerate(
        (
            (500.0, 90.0, "coherent", 0.0), (5000.0, 20.0, "incoherent", 0.0),
            (8000.0, 2.0, "coherent", 0.0), (60.0, 40.0, "incoherent", 497e-6),
            (3000.0, 90.0, "coherent", 496e-6),
        )
    ):  # fmt: skip
        scene = table_4_1(
            range=r, grazing_angle=np.radians(grazing), phases=phases, window=name,
            fft_size=fft_size, acquisition_delay=delay, beamlets=19 + number,
        )  # fmt: skip
        ((_, shots),) = prepare_shots(scene)
        for segment in range(3):
            _, spectrum = segment_spectrum(shots, 0, segment)
            for fraction in (0.3, 1e-2, 1e-3, 1e-5):
                level = fraction * spectrum.max()
                bins, part = segment_spectrum(shots, 0, segment, level_min=level)
                assert part == pytest.approx(spectrum[bins], rel=1e-9, abs=1e-13 * spectrum.max())
                left_out = np.delete(spectrum, bins)
                # Line and image are each below the level.
                factor = np.sqrt(2) if phases == "incoherent" else 2.0
                assert left_out.size == 0 or left_out.max() < factor * level
