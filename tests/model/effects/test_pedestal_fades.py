"""Strong phase noise of a laser: its pedestal fades with the line and detects beside it.

Each record has its own random walk theta. The beat has the phase theta(t) - theta(t - tau).
"""

import numpy as np
import pytest
from shot_helpers import make_point_keys

from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.detection.detectors import main_lobe_half_width
from sweep.model.effects.catalogue import PARAMETER_DEFAULTS
from sweep.model.evaluation import (
    DEFAULT_EFFECTS,
    evaluate,
    evaluate_segments,
    prepare_shots,
    shot_statistics,
)
from sweep.model.sampling.samplers import simulate_draws

DRAWS, FINER = 3_000, 2
WIDTH, SHAPE = (f"instrument.laser.line_{name}" for name in ("width", "shape"))
PROCESSING = "instrument.processing."


def shots_of(parameters, effects):
    ((_, shots),) = prepare_shots(parameters, effects)
    return shots


def effects_of(law):
    return (*DEFAULT_EFFECTS, "line_width", "image", *(["fading"] if law == "developed" else []))


def parameters_of(table_4_1, width, distance, law, rule, ratio, **changes):
    """A scene in which the power of the line's bin, pedestal included, is Th^2 ratio^2."""
    delay = 2 * distance / SPEED_OF_LIGHT
    p = PARAMETER_DEFAULTS | table_4_1() | {
        PROCESSING + "fft_size": 2048, PROCESSING + "sample_rate": 50e6,
        PROCESSING + "acquisition_delay": delay + 2e-6, "instrument.chirp.duration": 50e-6 + delay,
        "instrument.chirp.bandwidth": 1e8, PROCESSING + "noise_bins": "correlated",
        "instrument.receiver.noise_shape": "white", PROCESSING + "detection": rule,
        PROCESSING + "tnr": 6.0, "footprint.phases": "incoherent", WIDTH: width,
        SHAPE: "lorentzian", "footprint.beamlets": 1, "footprint.speckle": law,
        "target.range": distance, "target.radial_velocity": 15.0,
    } | changes  # fmt: skip
    for _ in range(3):
        shots = shots_of(p, effects_of(law))
        power = float(evaluate_segments(shots).magnitude[0, 0]) ** 2
        power += 2 * float(shots.line_noise_sigma[0] ** 2 - shots.bin_noise_sigma[0] ** 2)
        p["instrument.laser.power"] *= (float(shots.threshold[0]) * ratio) ** 2 / power
    return p


def drawn_spectra(shots, steady_shots, draws=DRAWS, seed=1):
    """Spectra of drawn up-chirps without and with noise, and the bin of their line.

    ``plain`` are the same shots with a laser of no width, whose line is that of each record.
    """
    rng, length, w = np.random.default_rng(seed), shots.window.length, shots.window.samples()
    rate, delay = float(shots.sample_rate[0]), 2 * float(shots.range[0]) / SPEED_OF_LIGHT
    per_step = 2 * np.pi * float(shots.laser_line.lorentzian_fwhm[0]) / (FINER * rate)
    later, size = round(delay * rate * FINER), shots.fft_size
    beat = float(steady_shots.beat_frequencies[0][0]) / rate
    beat = beat if shots.complex_record else abs(beat)
    tone, line = np.exp(2j * np.pi * beat * np.arange(length)), round(beat * size) % size
    amplitude = float(evaluate_segments(steady_shots).magnitude[0, 0]) / abs(
        np.fft.fft(w * tone, size)[line]
    )
    fades = shots.speckle.segment_correlations is not None
    deviation = float(shots.bin_noise_sigma[0]) / np.sqrt(shots.window.energy)
    echoes, noisy = [], []
    for _ in range(draws // 250):
        theta = np.cumsum(rng.normal(size=(250, FINER * length + later)), axis=1)
        phase = np.sqrt(per_step) * (theta[:, later:] - theta[:, : theta.shape[1] - later])
        speckle = rng.normal(size=(250, 2)) @ [1, 1j] / np.sqrt(2) if fades else np.ones(250)
        record = speckle[:, None] * tone * np.exp(1j * phase[:, ::FINER][:, :length])
        echo = np.fft.fft(amplitude * w * record, size)
        white = rng.normal(size=(250, length, 2)) @ [1, 1j]
        echoes.append(echo.astype(np.complex64))
        noisy.append((echo + np.fft.fft(deviation * w * white, size)).astype(np.complex64))
    return np.concatenate(echoes), np.concatenate(noisy), line


def echo_bins(shots, echo, line):
    """Bins of drawn echoes: of a quarter of the largest power, and a main lobe about them; and
    those up to the last in which the mean power is at least the noise's."""
    size = shots.fft_size
    power = np.roll((abs(echo) ** 2).mean(axis=0), size // 2 - line)  # the line in the middle
    bins, middle = np.arange(size), size // 2
    lobe = np.ceil(main_lobe_half_width(shots.window) * size / shots.window.length)
    strong = np.flatnonzero(power >= power.max() / 4)
    near = np.abs(bins[:, None] - strong).min(axis=1) <= lobe
    clearance = 4 * lobe  # where no sidelobe is
    smooth = np.convolve(power, np.ones(5) / 5, "same")
    above = np.flatnonzero(smooth >= 2 * float(shots.bin_noise_sigma[0]) ** 2)
    reach = np.abs(above - middle).max(initial=0)
    if reach > clearance:
        near |= np.abs(bins - middle) <= reach
    return np.roll(near, line - size // 2)


def drawn_pd(shots, steady_shots, rule, draws=DRAWS):
    """Share of drawn up-chirps with a detection in their echo's bins."""
    echo, noisy, line = drawn_spectra(shots, steady_shots, draws)
    bins = np.arange(shots.fft_size) == line
    if rule == "any_bin":
        bins = echo_bins(shots, echo, line)
    if not shots.complex_record:
        bins[shots.fft_size // 2 + 1 :] = False
    return (abs(noisy)[:, bins] >= float(shots.threshold[0])).any(axis=1).mean()


@pytest.mark.parametrize(
    ("width", "distance", "law", "rule", "ratio", "changes"),
    [
        (300e3, 150.0, "developed", "peak_bin", 1.6, {}),
        (300e3, 150.0, "developed", "any_bin", 1.6, {}),
        (300e3, 150.0, "none", "any_bin", 1.6, {}),
        (300e3, 150.0, "none", "any_bin", 1.2, {}),
        (1e6, 60.0, "developed", "any_bin", 1.3, {}),
        (1e6, 60.0, "none", "any_bin", 1.0, {}),
        (3e6, 30.0, "developed", "any_bin", 1.5, {}),
        (100e3, 300.0, "none", "any_bin", 1.4, {PROCESSING + "window": "rectangular"}),
        (200e3, 200.0, "developed", "any_bin", 1.4, {PROCESSING + "window": "flattop"}),
        (300e3, 150.0, "developed", "any_bin", 1.4, {PROCESSING + "fft_size": 4096}),
        (300e3, 150.0, "none", "any_bin", 1.4, {"instrument.receiver.record": "complex"}),
        (10e3, 150.0, "developed", "any_bin", 1.4, {}),
    ],
)
def test_a_pedestal_fades_with_its_line_and_detects(
    width, distance, law, rule, ratio, changes, table_4_1
):
    effects = effects_of(law)
    p = parameters_of(table_4_1, width, distance, law, rule, ratio, **changes)
    shots = shots_of(p, effects)
    steady_shots = shots_of(p, [name for name in effects if name != "line_width"])
    drawn, expected = drawn_pd(shots, steady_shots, rule), float(shot_statistics(shots)["pd_up"][0])
    assert abs(drawn - expected) < 0.02 + 3 * np.sqrt(drawn * (1 - drawn) / DRAWS)


@pytest.mark.parametrize("law", ["none", "developed"])
def test_draws_detect_by_the_pedestal_as_probabilities_say(law, table_4_1):
    p = parameters_of(table_4_1, 300e3, 150.0, law, "any_bin", 1.3)
    chosen, arguments = effects_of(law), {"keys": make_point_keys(1)}
    expected = float(evaluate(p, chosen)["pd_up"][0])
    for method, draws, slack in (
        ("probabilities", 20_000, 0.0), ("noise", 20_000, 0.02), ("spectra", 1000, 0.02)
    ):  # fmt: skip
        results = simulate_draws(p, chosen, batch_sizes=[draws], method=method, **arguments)
        share = results["n_detected_up"].sum() / draws
        error = np.sqrt(expected * (1 - expected) / draws)
        assert abs(share - expected) < 4 * error + slack, method


def test_weak_phase_noise_gives_an_echo_no_more_bins(table_4_1):
    for width, rule in ((1e3, "any_bin"), (300e3, "peak_bin")):
        p = parameters_of(table_4_1, width, 150.0, "none", rule, 1.5)
        assert shots_of(p, effects_of("none")).bin_thresholds.pedestal_reach_bins == 0
    p = parameters_of(table_4_1, 300e3, 150.0, "none", "any_bin", 1.5)
    wide = shots_of(p, effects_of("none"))
    assert wide.bin_thresholds.pedestal_reach_bins > 10
    narrow = [name for name in effects_of("none") if name != "line_width"]
    assert (
        evaluate_segments(wide).n_exempt[0, 0]
        > evaluate_segments(shots_of(p, narrow)).n_exempt[0, 0] + 10
    )
