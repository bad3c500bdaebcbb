"""Complex records (I and Q) from a spec to answers, beside real ones."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from test_triangle import STREET, instrument

import sweep
from sweep.model import time_domain_truth
from sweep.model.effects.catalogue import DEFAULT_EFFECTS
from sweep.model.evaluation import prepare_shots, shot_statistics
from sweep.model.pointcloud.pairing import MISPAIRED_FLAG, MISREAD_FLAG, TRUE_RETURN_FLAG
from sweep.model.spectrum import segment_spectra
from sweep.model.waveform import resolve_range_velocity
from sweep.model.window import window_samples
from sweep.spec import GridSpec, SceneSpec, SpecError

RECORD = "instrument.receiver.record"
GAIN, PHASE = (f"instrument.receiver.iq_{name}_imbalance" for name in ("gain", "phase"))
CHIRP = {"carrier": np.array(1.93e14), "bandwidth": np.array(1e9), "duration": np.array(10e-6)}


@given(
    st.floats(0.0, 0.49), st.floats(-0.49, 0.49), st.sampled_from([None, 0, 1, -1]),
    st.booleans(),
)  # fmt: skip
def test_signs_tell_range_and_velocity_whichever_is_larger(near, fast, equal, doppler):
    """Range beats up to half the sample rate, Doppler shifts to half of either sign; also alike."""
    rate = 512e6
    f_r = near * rate
    f_d = (fast if equal is None else equal * near) * rate
    beats = [(f + rate / 2) % rate - rate / 2 for f in (f_d - f_r, f_d, f_d + f_r)]
    up, middle, down = (np.array(f) for f in beats)
    resolved = resolve_range_velocity(
        up=up, doppler=middle if doppler else None, down=down, sample_rate=np.array(rate),
        bin_width=np.array(1e5), has_signs=True, **CHIRP,
    )  # fmt: skip
    velocity = f_d * 299792458 / 2 / (1.93e14 + 5e8)
    assert resolved.radial_velocity == pytest.approx(velocity, abs=1e-6)
    delay = (f_r - 5e8 * f_d / (1.93e14 + 5e8)) / 1e14 / (1 + 2 * velocity / 299792458)
    assert resolved.range == pytest.approx(299792458 / 2 * delay, abs=1e-6)


def shots_of(scene, effects=DEFAULT_EFFECTS):
    ((_, shots),) = prepare_shots(scene, effects)
    return shots


@pytest.mark.parametrize("source", ["shot", "amplifier", "intensity"])
def test_noise_is_that_of_two_receivers_with_half_the_light(source, table_4_1):
    """Simulated: a hybrid gives I and Q half of echo and local oscillator, sampled with noise."""
    amplifier_noise = 50e-9 if source == "amplifier" else 0.0
    quiet = table_4_1(fft_size=1024, range=200.0, beamlets=1) | {
        "instrument.receiver.noise_equivalent_power": 0.0,
        "instrument.receiver.amplifier_noise_current": amplifier_noise,
        "instrument.receiver.local_oscillator_power": 1e-9 if source == "amplifier" else 1e-3,
        "target.reflectance": 1.0 if source == "amplifier" else 1e-4,
        "instrument.laser.relative_intensity_noise": 1e-11 if source == "intensity" else 0.0,
    }  # fmt: skip
    effects = (*DEFAULT_EFFECTS, "relative_intensity_noise")
    real, complex_statistics = (
        shot_statistics(shots_of(quiet | {RECORD: kind}, effects)) for kind in ("real", "complex")
    )
    rng, length, trials = np.random.default_rng(3), 1024, 4000
    cycles = np.arange(length) * (100 / length)
    tone, w = np.exp(2j * np.pi * cycles), window_samples("hamming", length)
    # Share of the variance in each receiver; a laser's intensity is the same in both.
    light = {"shot": 0.5, "amplifier": 1.0, "intensity": 0.25}[source]
    noise = rng.normal(size=(2, trials, length))
    if source == "intensity":
        noise[1] = noise[0]
    deviation = 0.7
    of_real = np.fft.fft(w * (tone.real + deviation * noise[0]))[:, 100]
    of_both = np.fft.fft(w * (tone / 2 + deviation * np.sqrt(light) * (noise[0] + 1j * noise[1])))
    snrs = [
        abs(w.sum() / 2) ** 2 / np.var(record) for record in (of_real, of_both[:, 100])
    ]  # the same line over the noise of both quadratures
    ratio = complex_statistics["snr_up"][0] / real["snr_up"][0]
    assert ratio == pytest.approx(snrs[1] / snrs[0], rel=5 * np.sqrt(2 / trials))
    assert ratio == pytest.approx(
        {"shot": 1.0, "amplifier": 0.5, "intensity": 2.0}[source], rel=2e-3
    )
    bins = 10 ** (complex_statistics["log10_pfa_segment"] - real["log10_pfa_segment"])
    assert bins[0] == pytest.approx(1024 / 511, rel=2e-2)


@pytest.mark.parametrize("phases", ["coherent", "incoherent"])
@pytest.mark.parametrize("velocity", [-40.0, 0.02, 90.0])
def test_imbalance_makes_the_image_of_unequal_samples(phases, velocity, table_4_1):
    """0.5 dB and 3 deg: against the record of I and Q that are so unequal, all N bins."""
    scene = table_4_1(
        window="hann", phases=phases, fft_size=4096, beamlets=7, range=30.0,
        radial_velocity=velocity,
    ) | {RECORD: "complex", GAIN: 10**0.05, PHASE: np.deg2rad(3.0)}  # fmt: skip
    shots = shots_of(scene, (*DEFAULT_EFFECTS, "iq_imbalance"))
    shots = replace(shots, echo_record=shots.echo_record._replace(phase_errors=()))
    g = np.sqrt(10**0.05) * np.exp(1j * np.deg2rad(3.0))
    leak = abs(1 - g) / abs(1 + g)
    assert shots.line_images.iq_image_gain == pytest.approx(leak)
    w = window_samples("hann", 4096)
    for segment in range(3):
        exact = time_domain_truth.time_domain_spectrum(shots, 0, segment, with_range_walk=False)
        bins, magnitude = segment_spectra.segment_spectrum(shots, 0, segment)
        accumulated_power = np.zeros(4096)
        accumulated_power[(bins + 2048) % 4096] = magnitude
        assert np.abs(accumulated_power - exact).max() < 1e-9 * exact.max()
        record = time_domain_truth.beamlet_analytic_signal(
            shots, 0, segment, 3, with_range_walk=False
        )
        unequal = record.real + 1j * (g * record / 1j).real  # Q by its own gain and phase
        spectrum = np.abs(np.fft.fft(w * unequal))
        k = spectrum.argmax()
        if min(k, 4096 - k) > 40:  # line and image apart
            image = spectrum[(-k) % 4096] / spectrum[k]
            assert image == pytest.approx(leak, rel=1e-3)


def test_a_grid_of_both_records(tmp_path):
    """Both read range and velocity of a receding and of a closing target."""
    spec = GridSpec.from_mapping({
        "title": "Records", "instrument": instrument(),
        "target": {"range": "100 m", "reflectance": 0.1, "radial_velocity": "-35 m/s",
                   "grazing_angle": "90 deg"},
        "axes": {RECORD: ["real", "complex"], "target.radial_velocity": ["-35 m/s", "60 m/s"]},
    })  # fmt: skip
    assert sweep.run(spec, store=tmp_path / "g.zarr", scheduler="none", progress=False).complete
    dataset = sweep.open(tmp_path / "g.zarr").load()
    assert np.abs(dataset.range_error).max() < 0.3
    assert np.abs(dataset.radial_velocity_error).max() < 0.3
    difference = dataset.log10_pfa_bin.sel(record="complex") - dataset.log10_pfa_bin.sel(
        record="real"
    )
    assert (
        np.abs(difference).max() < 1e-5
    )  # the threshold follows the noise, but for the echo's own


@pytest.mark.parametrize("speed", [pytest.param(15, marks=pytest.mark.slow), 90])
def test_a_street_in_complex_records(speed, tmp_path):
    """Two segments and signs: every return is read right, whichever of its beats is larger."""
    clouds = {}
    for kind in ("real", "complex"):
        mapping = instrument(segments="up down")
        mapping["receiver"] |= {"record": kind}
        spec = SceneSpec.from_mapping({
            "title": "A street", "instrument": mapping,
            "scene": {"origin": "ground", "objects": STREET},
            "platform": {"path": {
                "kind": "straight", "from": ["0 m", "0 m", "90 m"], "to": ["0 m", "0 m", "60 m"],
                "initial_speed": f"{speed} m/s", "final_speed": f"{speed} m/s",
            }},
            "scanners": {"frame": {"kind": "raster", "columns": 16, "rows": 16,
                                   "half_angles": ["12 deg", "12 deg"], "rate": "20 Hz"}},
            "footprint": {"beamlets": 1, "speckle": "none"},
            "draws": {"number": 2, "method": "noise"},
        })  # fmt: skip
        store = tmp_path / f"{kind}.zarr"
        assert sweep.run(spec, store=store, scheduler="none", progress=False).complete
        clouds[kind] = sweep.open_scene(store)["frame"].to_dataset().load()
    real, n_complex = (
        (cloud["flags"] & TRUE_RETURN_FLAG > 0).sum().item() for cloud in clouds.values()
    )
    wrong = (clouds["complex"]["flags"] & (MISREAD_FLAG | MISPAIRED_FLAG) > 0).sum().item()
    assert (real == 0) == (speed == 90)  # |f_d| > f_r: exchanged
    assert n_complex > 1000 and n_complex >= 0.99 * real and wrong <= 1e-3 * n_complex


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"receiver": {"record": "complex", "architecture": "direct"}}, "I and Q"),
        ({"receiver": {"record": "both"}}, "real"),
        ({"receiver": {"iq_gain_imbalance": "0.5 dB"}}, "record: complex"),
    ],
)
def test_what_makes_no_complex_record_is_refused(changes, message):
    mapping = instrument()
    for part, fields in changes.items():
        mapping[part] |= fields
    target = {"range": "100 m", "reflectance": 0.1, "radial_velocity": "5 m/s",
              "grazing_angle": "90 deg"}  # fmt: skip
    with pytest.raises(SpecError, match=message):
        GridSpec.from_mapping({"title": "x", "instrument": mapping, "target": target})
