"""What one line shows: its table, ends and envelope against direct sums, with any phase error."""

from functools import partial

import numpy as np
import pytest
from shot_helpers import line_shape_of_window, parametrize_product

from sweep.model.spectrum.bin_spectrum import (
    LineBundle,
    allocate_workspace,
    compute_line_spectrum,
    falloff_distance,
)
from sweep.model.spectrum.segment_spectra import bin_tangents
from sweep.model.window import COSINE_SUM_COEFFICIENTS, get_window, window_samples

WINDOWS = (*COSINE_SUM_COEFFICIENTS, "kaiser(8)")

SIZES = (4096, 4096), (4099, 4099), (8195, 4097), (8192, 5003), (512, 500), (301, 77)
"""FFT and record: even and odd, with padding and without; the last two have no modes."""

ACCURACY = 1e-11
"""Largest error, relative to the peak of all lines in phase and without a phase error."""


def wandering(bins, x):
    """A phase error [cycles] whose slope covers some bins; with a cubic part, beside the middle."""
    return bins * x * x / 8 + bins * x**3 / 60 + 0.2 * bins**0.5 * x + 0.13 * bool(bins)


def transform(name, sizes, phase, y):
    """Direct sums over the record, its middle the phase's origin, (n,)."""
    fft_size, length = sizes
    x = 2 * np.arange(length) / length - 1
    record = window_samples(name, length) * np.exp(2j * np.pi * phase(x))
    return np.exp(-1j * np.pi * length / fft_size * np.outer(y, x)) @ record


def model_spectrum(sizes, power, places, weights, first, count, shape):
    """F of some bins as the model has it, (count,)."""
    n, places = places.size, places + shape.shift
    line_spectrum = allocate_workspace(count + 16).line_spectrum
    line_spectrum.lines.position[:n] = places
    line_spectrum.lines.re[:n], line_spectrum.lines.im[:n] = weights.real, weights.imag
    bundle = LineBundle(0, n, places.min(), places.max(), 0.0)
    tangents = bin_tangents(sizes[0])
    compute_line_spectrum(
        first, count, bundle, 0.0, shape.shape, shape.layout, tangents, line_spectrum
    )
    return line_spectrum.re[:count] + (0 if power else 1j * line_spectrum.im[:count])


@pytest.mark.parametrize(
    ("name", "sizes", "power"), parametrize_product(7, WINDOWS, SIZES, [False, True])
)
def test_lines_show_what_direct_sums_over_the_record_show(name, sizes, power):
    """Near the lines and far from them, on either side; no line exceeds its envelope."""
    fft_size = sizes[0]
    rng = np.random.default_rng((90, *sizes))
    bins = np.unique([*range(-28, 29, 3), *rng.integers(-fft_size // 2, fft_size // 2, 9)])
    for drift in (0.0, 0.7, 4.0, 30.0):
        phase = partial(wandering, drift)
        shape = line_shape_of_window(get_window(name, sizes[1]), fft_size, power=power, phase=phase)
        places = rng.uniform(-3, 3, 2)
        weights = rng.normal(size=2) + 1j * rng.normal(size=2)
        weights = abs(weights) + 0j if power else weights
        peak_power = abs(transform(name, sizes, np.zeros_like, np.zeros(1))[0]) ** (1 + power)
        lines = transform(name, sizes, phase, np.ravel(bins[:, None] - places))
        lines = lines.reshape(bins.size, 2)
        exact = (abs(lines) ** 2 if power else lines) @ weights
        first = -(fft_size // 2)
        spectrum = model_spectrum(sizes, power, places, weights, first, fft_size, shape)[
            bins - first
        ]
        assert abs(spectrum - exact).max() < ACCURACY * peak_power * abs(weights).sum(), drift
        offsets = (bins[:, None] - places - shape.shift + fft_size / 2) % fft_size - fft_size / 2
        tabulated = shape.shape.envelope
        index = np.searchsorted(tabulated.distance, abs(offsets), "right").clip(1) - 1
        envelope = tabulated.magnitude[index]
        assert (abs(lines) <= envelope * (1 + 1e-9) + 1e-12 * peak_power ** (1 / (1 + power))).all()


@pytest.mark.parametrize("name", ["rectangular", "hann", "flattop", "kaiser(8)"])
@pytest.mark.parametrize("drift", [0.0, 2.0, 30.0])
def test_no_bin_beyond_a_lines_reach_is_above_the_level(name, drift):
    size = 4096
    phase = partial(wandering, drift)
    shape = line_shape_of_window(get_window(name, size), size, phase=phase)
    y = np.linspace(-2048, 2048, 2 * 4096 + 1)
    exact = abs(
        np.fft.fft(
            window_samples(name, size) * np.exp(2j * np.pi * phase(2 * np.arange(size) / size - 1)),
            2 * size,
        )
    )
    magnitude = exact[np.rint(2 * y).astype(int) % (2 * size)]
    for level in 10.0 ** np.arange(-1, -8, -0.5) * magnitude.max():
        reach = falloff_distance(level, 1.0, shape.shape.envelope)
        assert magnitude[abs(y - shape.shift) >= reach].max(initial=0.0) <= level
