"""Strong phase noise of a laser: the pedestal fades with its line; against random walks of phase.

Each record has its own random walk theta. The beat has the phase theta(t) - theta(t - tau).
"""

import math

import numpy as np
import pytest

from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.detectors import main_lobe
from sweep.model.effects.catalogue import DEFAULTS
from sweep.model.shot import CORE, find, prepare, statistics

DRAWS, FINER = 3_000, 2
WIDTH, SHAPE = (f"instrument.laser.line_{name}" for name in ("width", "shape"))


def shots_of(parameters, effects):
    ((_, shots),) = prepare(parameters, effects)
    return shots


def drawn_pd(shots, plain, rule, seed=1):
    """Share of drawn up-chirps with a detection in the mean echo's bins.

    ``plain`` are the same shots with a laser of no width, whose line is that of each record.
    """
    rng, length, w = np.random.default_rng(seed), shots.window.length, shots.window.samples()
    rate, delay = float(shots.sample_rate[0]), 2 * float(shots.range[0]) / SPEED_OF_LIGHT
    per_step = 2 * np.pi * float(shots.laser_width[0]) / (FINER * rate)
    later = round(delay * rate * FINER)
    place = abs(float(plain.beats[0][0])) / rate * length
    bins = np.arange(round(place) - 12, round(place) + 13)
    tone = np.exp(2j * np.pi * place * np.arange(length) / length)
    amplitude = float(find(plain)[0, 2, 0]) / abs(np.fft.fft(w * tone)[round(place)])
    fades = shots.fading is not None
    turns = np.exp(-2j * np.pi * np.outer(np.arange(length), bins) / length)
    echoes, noises = [], []
    for _ in range(DRAWS // 500):
        theta = np.cumsum(rng.normal(size=(500, FINER * length + later)), axis=1)
        phase = np.sqrt(per_step) * (theta[:, later:] - theta[:, : theta.shape[1] - later])
        speckle = rng.normal(size=(500, 2)) @ [1, 1j] / np.sqrt(2) if fades else np.ones(500)
        beat = amplitude * w * tone * np.exp(1j * phase[:, ::FINER][:, :length])
        echoes.append(speckle[:, None] * (beat @ turns))
        white = rng.normal(size=(500, length, 2)) @ [1, 1j] / np.sqrt(shots.window.energy)
        noises.append(float(shots.bin_deviation[0]) * ((w * white) @ turns))
    echo, noise = np.concatenate(echoes), np.concatenate(noises)
    power = (abs(echo) ** 2).mean(axis=0)
    searched = np.arange(bins.size) == power.argmax()
    if rule == "any_bin":
        strong = np.flatnonzero(power >= power.max() / 4)
        reach = math.ceil(main_lobe(shots.window))
        searched = abs(np.arange(bins.size)[:, None] - strong).min(axis=1) <= reach
    return (abs(echo + noise)[:, searched] >= float(shots.threshold[0])).any(axis=1).mean()


@pytest.mark.parametrize(
    ("width", "distance", "law", "rule", "ratio"),
    [
        (300e3, 150.0, "developed", "peak_bin", 1.5),
        (300e3, 150.0, "developed", "any_bin", 1.5),
        (1e6, 60.0, "developed", "any_bin", 1.2),
        (300e3, 150.0, "none", "any_bin", 1.5),
    ],
)
def test_a_pedestal_fades_with_its_line(width, distance, law, rule, ratio, table_4_1):
    effects = (*CORE, "line_width", "image", *(["fading"] if law == "developed" else []))
    p = DEFAULTS | table_4_1() | {
        "instrument.processing.fft_size": 2048, "instrument.processing.sample_rate": 50e6,
        "instrument.processing.acquisition_delay": 5e-6, "instrument.chirp.duration": 50e-6,
        "instrument.chirp.bandwidth": 1e8, "instrument.processing.noise_bins": "correlated",
        "instrument.receiver.noise_shape": "white", "instrument.processing.detection": rule,
        "instrument.processing.tnr": 6.0, "footprint.phases": "incoherent", WIDTH: width,
        SHAPE: "lorentzian", "footprint.beamlets": 1, "footprint.speckle": law,
        "target.range": distance, "target.radial_velocity": 15.0,
    }  # fmt: skip
    shots = shots_of(p, effects)
    factor = float(shots.threshold[0]) * ratio / float(find(shots)[0, 2, 0])
    p["instrument.laser.power"] *= factor**2
    shots = shots_of(p, effects)
    plain = shots_of(p, [name for name in effects if name != "line_width"])
    drawn, expected = drawn_pd(shots, plain, rule), float(statistics(shots)["pd_up"][0])
    # Without speckle other bins are the stronger, the fainter the line's is.
    tolerance = 0.01 if law == "developed" else 0.02
    assert abs(drawn - expected) < tolerance + 3 * np.sqrt(drawn * (1 - drawn) / DRAWS)
