"""Leakage by drawn spectra: how often a line in noise raises groups that are none of its own."""

import numpy as np

from sweep.model.detection.echo_detection import mark_exempt_bins
from sweep.model.spectrum.search_restriction import axis_line_positions
from sweep.model.spectrum.segment_spectra import segment_spectrum


def drawn_leakage(shots, i, *, draws, looks=1, seed=1, fades=True, per_line=True):
    """Draw whole spectra of a line in noise; the probability of a further group by its signal.

    ``own``: looks have independent speckle; else they share it. A further group is a run of bins
    over the threshold, of which none is exempt. What noise alone raises is taken out.
    """
    rng, size = np.random.default_rng(seed), shots.fft_size
    window, time = shots.window.samples(), np.arange(size)
    bins, magnitude = segment_spectrum(shots, i, 0)
    sigma, level = float(shots.bin_noise_sigma[i]), float(shots.threshold[i])
    exempt = np.zeros(magnitude.size, bool)
    mark_exempt_bins(magnitude, magnitude.size, level, exempt, shots.detection_rule.lobe_half_width)
    place = axis_line_positions(shots)[0, i]
    turn = np.exp(2j * np.pi * place * time / size)
    lines = np.fft.rfft(window * turn.real)[bins], np.fft.rfft(window * turn.imag)[bins]
    peak = magnitude.argmax()
    lines = np.array(lines) * (magnitude[peak] / sigma / abs(lines[0][peak]))
    raised = np.zeros(2)
    for _ in range(draws // 500):
        power = np.zeros((2, 500, bins.size))
        amplitude = rng.normal(size=(looks, 2, 500)) / np.sqrt(2)
        amplitude = amplitude if per_line else amplitude[:1] + 0 * amplitude
        for look in range(looks):
            scale = np.sqrt(2 / (window**2).sum())
            noise = np.fft.rfft(window * rng.normal(size=(500, size)))[:, bins] * scale
            cos, sin = amplitude[look]
            if not fades:
                phase = rng.uniform(0, 2 * np.pi, 500)
                cos, sin = np.cos(phase), np.sin(phase)
            signal = np.multiply.outer(cos, lines[0]) - np.multiply.outer(sin, lines[1])
            power[0] += abs(noise) ** 2 / looks
            power[1] += abs(noise + signal) ** 2 / looks
        for k in range(2):
            crosses = power[k] >= (level / sigma) ** 2
            crosses[:, bins == 0] = False
            run = np.cumsum(np.diff(crosses, axis=1, prepend=False) & crosses, axis=1)
            for row in range(500):
                groups = set(run[row][crosses[row] & ~exempt])
                raised[k] += bool(groups - set(run[row][crosses[row] & exempt]))
    noisy, either = raised / draws
    return (either - noisy) / (1 - noisy), np.sqrt(2 * either * (1 - either) / draws)
