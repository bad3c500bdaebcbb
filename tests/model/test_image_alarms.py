"""Images of unequal I and Q raise false alarms, above the threshold too: against drawn bins."""

import numpy as np
import pytest

from sweep.model.effects.catalogue import PARAMETER_DEFAULTS
from sweep.model.evaluation import (
    DEFAULT_EFFECTS,
    evaluate_segments,
    prepare_shots,
    shot_statistics,
)
from sweep.model.pointcloud.bin_groups import list_bin_groups
from sweep.model.spectrum.segment_spectra import segment_spectrum

EFFECTS = (*DEFAULT_EFFECTS, "iq_imbalance", "leakage")
DRAWS = 40_000


def shots_with_image(parameters, ratio):
    """Shots whose image in the up-chirp's spectrum is ``ratio`` times the threshold."""
    for _ in range(2):
        ((_, shots),) = prepare_shots(parameters, EFFECTS)
        image = float(evaluate_segments(shots).magnitude[0, 0] * shots.line_images.iq_image_gain)
        factor = (ratio * float(shots.threshold[0]) / image) ** 2
        parameters = parameters | {
            "instrument.laser.power": parameters["instrument.laser.power"] * factor
        }
    ((_, shots),) = prepare_shots(parameters, EFFECTS)
    return shots


def drawn_alarms(shots, seed):
    """Share of draws in which a bin about the image crosses, over what noise alone makes of it."""
    bins, magnitude = segment_spectrum(shots, 0, 0)
    peak = int(magnitude.argmax())
    size, length = shots.fft_size, shots.window.length
    image = int(np.flatnonzero((bins + bins[peak]) % size == 0)[0])
    places = np.arange(image - 8, image + 9)
    w = shots.window.samples()
    turns = np.exp(-2j * np.pi * np.outer(bins[places], np.arange(length)) / size)
    noise = (turns * w) @ (turns * w).conj().T / shots.window.energy
    # The line's phase in each bin, of a place that |X| tells.
    around = magnitude[places] / magnitude[places].max()
    distance = np.arange(-8, 9) * length / size
    time = np.arange(length) - length / 2
    offsets = np.linspace(-0.5, 0.5, 201) * length / size
    shapes = (
        np.array(
            [
                [(w * np.cos(2 * np.pi * (d - o) * time / length)).sum() for d in distance]
                for o in offsets
            ]
        )
        / w.sum()
    )
    fits = np.abs(shapes) / np.abs(shapes).max(axis=1)[:, None]
    shape = shapes[np.argmin(((fits - around) ** 2).sum(axis=1))]
    phase = np.exp(-1j * np.pi * bins[places] * length / size)
    signal = np.sign(shape) * phase * magnitude[places] / float(shots.bin_noise_sigma[0])
    values, vectors = np.linalg.eigh(noise)
    factor = vectors * np.sqrt(np.maximum(values, 0))
    rng, level = np.random.default_rng(seed), float(shots.threshold[0] / shots.bin_noise_sigma[0])
    numbers = rng.normal(size=(DRAWS, places.size, 2)) @ [1, 1j] @ factor.T
    without_signal, crosses = (
        (abs(numbers + s) >= level).any(axis=1).mean() for s in (0 * signal, signal)
    )
    return (crosses - without_signal) / (1 - without_signal)


@pytest.mark.parametrize("ratio", [0.5, 0.8, 0.95, 1.02, 1.2])
@pytest.mark.parametrize("rule", ["peak_bin", "any_bin"])
def test_an_image_is_the_alarm_that_it_is(ratio, rule, table_4_1):
    p = PARAMETER_DEFAULTS | table_4_1() | {
        "instrument.receiver.record": "complex", "instrument.receiver.iq_gain_imbalance": 10**0.05,
        "instrument.processing.detection": rule, "instrument.processing.noise_bins": "correlated",
        "instrument.receiver.noise_shape": "white", "instrument.processing.fft_size": 8192,
        "target.range": 1500.0, "target.radial_velocity": 3.0, "footprint.beamlets": 1,
    }  # fmt: skip
    shots = shots_with_image(p, ratio)
    drawn, outputs = drawn_alarms(shots, seed=2), shot_statistics(shots)
    error = np.sqrt(drawn * (1 - drawn) / DRAWS)
    assert abs(outputs["p_leakage_up"][0] - drawn) < 0.01 + 3 * error
    assert list_bin_groups(shots).strongest_bin[0, 0, 1] == -1  # nor is it an echo
