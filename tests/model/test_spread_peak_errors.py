"""Errors of peak positions by speckle, against drawn lines of Gaussian footprints.

Each draw has lines of circular complex Gaussian amplitude, a Gaussian density of places, and white
noise of the window's correlation. Up and down chirp see the same lines, mirrored and turned in
phase, at places between the bins that are drawn anew. Of the package only the estimate by three
bins and the stated moments are used.
"""

from types import SimpleNamespace

import numpy as np
import pytest

from sweep.model.detection.sub_bin_interpolation import (
    estimate_sub_bin_offset,
    interpolator,
    sub_bin_standard_error,
)
from sweep.model.sampling.speckle_lines import (
    CHIRP_PAIRS_WITH_SELF,
    LineGradients,
    SpecklePeaks,
    position_error_moments,
)
from sweep.model.window import get_window, window_samples

LENGTH, HALF_WIDTH = 1024, 9
SNR, THRESHOLD = 1800.0, 6.0
"""SNR of the mean echo on a bin, and the threshold over the noise per quadrature. |X| is ten times
the threshold."""
SPREAD_AT_5_DEG, TURN_PER_SPREAD = 0.66, 0.46
"""Deviation of the lines [bins] from 300 m on a slope of 5 degrees, of a beam of 5 mm and 1 GHz in
50 us, and the phase [rad] per bin by which up and down chirp turn against each other."""

FINE_LINES = np.linspace(-5, 5, 81)
FINE_WEIGHTS = np.exp(-0.5 * FINE_LINES**2) / np.exp(-0.5 * FINE_LINES**2).sum()


def window_transform(window, distance):
    """Real transform about the middle of the record, over that of a tone on a bin."""
    middle = 2 * np.pi * (np.arange(LENGTH) / LENGTH - 0.5)
    return np.cos(np.multiply.outer(distance, middle)) @ window / window.sum()


def drawn_segment(window, spread, turn, middle, amplitudes, lines, rng):
    """Bins about the echo over the noise per quadrature, (draws, k), and mean powers of echoes."""
    bins = np.arange(-HALF_WIDTH, HALF_WIDTH + 1)
    transform = window_transform(window, bins - middle - spread * lines[:, None])
    transform *= np.sqrt(2 * SNR)
    squared = window**2 / (window**2).sum()
    middle_phase = 2 * np.pi * (np.arange(LENGTH) / LENGTH - 0.5)
    covariance = np.cos(np.subtract.outer(bins, bins)[..., None] * middle_phase) @ squared
    values, vectors = np.linalg.eigh(covariance)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    noise = rng.normal(size=(2, len(amplitudes), bins.size)) @ root.T
    echo = (amplitudes * np.exp(1j * turn * lines)) @ transform
    fine_transform = window_transform(window, bins - middle - spread * FINE_LINES[:, None])
    mean_power = 2 * SNR * (FINE_WEIGHTS @ fine_transform**2)
    return bins, echo + noise[0] + 1j * noise[1], mean_power


def detected_peak(spectrum, mean_power, rule, tables):
    """Index of the bin about which a peak is placed, three magnitudes, and what is detected."""
    power, strongest = np.abs(spectrum) ** 2, int(mean_power.argmax())
    if rule == "peak_bin":
        index = np.full(len(power), strongest)
    else:
        above_half = np.flatnonzero(mean_power >= mean_power.max() / 4)
        first, last = max(above_half[0] - 2, 1), min(above_half[-1] + 2, 2 * HALF_WIDTH - 1)
        index = first + power[:, first : last + 1].argmax(axis=1)
    rows = np.arange(len(power))
    three = np.sqrt(np.stack([power[rows, index + k] for k in (-1, 0, 1)], axis=1))
    offset = np.array([estimate_sub_bin_offset(*row, tables) for row in three])
    return index, three, offset, three[:, 1] >= THRESHOLD


def scores(shape, rule, angle, draws=4000, places=20):
    """Root mean square scores of differences (range) and sums (velocity) of the two places."""
    rng, window = np.random.default_rng(1), window_samples(shape, LENGTH)
    tables = interpolator(get_window(shape, LENGTH), LENGTH)
    spread = SPREAD_AT_5_DEG * np.tan(np.radians(5)) / np.tan(np.radians(angle))
    lines, weights = np.polynomial.hermite_e.hermegauss(31)
    weights, turn = np.sqrt(weights / weights.sum()), TURN_PER_SPREAD * spread
    columns = []
    for _ in range(places):
        number = draws // places
        normal = rng.normal(size=(2, number, lines.size))
        amplitudes = (normal[0] + 1j * normal[1]) * weights / np.sqrt(2)
        by_segment, detected = [], np.ones(number, bool)
        for sign, phase in ((1.0, 0.0), (-1.0, turn)):
            middle = rng.uniform(-0.5, 0.5)
            bins, spectrum, mean = drawn_segment(
                window, sign * spread, phase, middle, amplitudes, lines, rng
            )
            index, three, offset, estimate = detected_peak(spectrum, mean, rule, tables)
            mean_power = mean.max() + 2
            noise_error = [
                sub_bin_standard_error(o, m, tables)
                for o, m in zip(offset, three[:, 1], strict=True)
            ]
            by_segment.append(
                (bins[index] + offset - middle, offset, three.max(axis=1) ** 2 / mean_power,
                 np.full(number, mean.max() / mean_power), np.array(noise_error))
            )  # fmt: skip
            detected &= estimate
        columns.append(np.array(by_segment)[:, :, detected])
    (up, down) = np.concatenate(columns, axis=2)
    count = up.shape[1]
    gradients = LineGradients(np.zeros((count, 3, 2)), np.zeros((count, 3, 2)))
    gradients.line_shift[:, [0, 2], 0] = spread, -spread
    gradients.phase_gradient[:, 2, 0] = turn
    by_segment = np.full((5, count, 3), np.nan)
    by_segment[:, :, 0], by_segment[:, :, 2] = up, down
    error, offset, power, fraction, noise = by_segment
    shots = SimpleNamespace(
        window=get_window(shape, LENGTH), fft_size=LENGTH,
        detection_settings=SimpleNamespace(echo_bin_rule=rule),
        looks=SimpleNamespace(number=1, is_noncoherent=False, has_independent_speckle=False),
    )  # fmt: skip
    peaks = SpecklePeaks(offset, np.ones((count, 3)), power, fraction)
    moments = position_error_moments(gradients, peaks, shots, CHIRP_PAIRS_WITH_SELF)
    variance = moments[:, 0, 0] + moments[:, 2, 2] + noise[:, 0] ** 2 + noise[:, 2] ** 2
    result = []
    for sign in (-1, 1):
        squared = (error[:, 0] + sign * error[:, 2]) ** 2
        result.append(np.sqrt((squared / (variance + 2 * sign * moments[:, 0, 2])).mean()))
    return result


@pytest.mark.parametrize("angle", [5, 7, 10, 20, 30, 60, 90])
@pytest.mark.parametrize("rule", ["any_bin", "peak_bin"])
@pytest.mark.parametrize("shape", ["hann", "hamming"])
def test_places_of_spread_peaks_err_as_stated(shape, rule, angle):
    """Hamming's sidelobes make stated errors of sums up to a fifth too large below 10 degrees."""
    of_range, of_velocity = scores(shape, rule, angle)
    assert of_range == pytest.approx(1.0, abs=0.1)
    lowest = {5: 0.82, 7: 0.87}.get(angle, 0.9) if shape == "hamming" else 0.9
    assert lowest < of_velocity < 1.1


@pytest.mark.parametrize("angle", [5, 7, 10, 20, 30, 60, 90])
@pytest.mark.parametrize("rule", ["any_bin", "peak_bin"])
def test_places_by_two_bins_err_as_stated(rule, angle):
    """Noise and speckle decide on the side of a peak in the rectangular window, and move it less.

    With the linear wander of other windows, scores of velocities were up to 1.42, and of ranges
    down to 0.83.
    """
    of_range, of_velocity = scores("rectangular", rule, angle, draws=8000, places=40)
    assert of_range == pytest.approx(1.0, abs=0.1)
    assert of_velocity == pytest.approx(1.0, abs=0.15)
