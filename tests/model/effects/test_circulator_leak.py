"""Light that leaks to the detector: its line and noise against simulated records."""

import numpy as np
import pytest
from random_planner_points import prepare_single_category

from sweep.model import evaluation
from sweep.model.detection.looks import LOOKS_COMBINE_PATH, LOOKS_NUMBER_PATH, LOOKS_VOTES_PATH
from sweep.model.detection.marcum import marcum_q1
from sweep.model.effects import circulator_leak as leak
from sweep.model.effects.catalogue import DEFAULT_EFFECTS, PARAMETER_DEFAULTS
from sweep.model.spectrum import permanent_line
from sweep.model.spectrum.segment_spectra import iter_spans
from sweep.model.waveform import SEARCH_BAND_PATHS

LIGHT, CHARGE = 299792458.0, 1.602176634e-19
PATH, ISOLATION = 3.0, 1e5
WITH = (*DEFAULT_EFFECTS, "circulator_leak")


@pytest.fixture
def leaking(table_4_1):
    """Parameters of Table 4.1 with leaked light."""

    def parameters(path=PATH, isolation=ISOLATION, further_parameters=None, **changes):
        leak_parameters = {leak.LEAK_LENGTH_PATH: path, leak.ISOLATION_PATH: isolation}
        return (
            PARAMETER_DEFAULTS | table_4_1(**changes) | leak_parameters | (further_parameters or {})
        )

    return parameters


@pytest.mark.parametrize("record", ["real", "complex"])
@pytest.mark.parametrize(("segment", "sign"), [(0, 1), (1, 0), (2, -1)])
def test_the_line_is_that_of_simulated_records(leaking, segment, sign, record):
    further_parameters = {"instrument.receiver.record": record}
    shots = prepare_single_category(
        leaking(path=40.0, further_parameters=further_parameters, range=1500.0, fft_size=2**14),
        WITH,
    )
    scale, line = permanent_line.permanent_line_of_point(shots, 0, segment)
    # By hand: 2 Re sqrt(P_lo P_tx / I) [A] by 7 kohm, two poles of 400 MHz, at S d / c.
    beat = -sign * 1e9 / 500e-6 * 40.0 / LIGHT
    amplitude = 2 * 1.1 * np.sqrt(1e-3 * 1.0 / ISOLATION) * 7e3 / (1 + (beat / 4e8) ** 2)
    n, window = np.arange(2**14), 0.54 - 0.46 * np.cos(2 * np.pi * np.arange(2**14) / 2**14)
    powers, magnitude_max = 0.0, 0.0
    for phase in 2 * np.pi * np.arange(64) / 64:
        tone = amplitude * np.exp(1j * (2 * np.pi * beat * n / 6e8 + phase))
        if record == "real":
            spectrum = np.abs(np.fft.rfft(window * tone.real))
        else:
            spectrum = np.abs(np.fft.fft(window * tone / 2))
        powers, magnitude_max = powers + spectrum**2 / 64, np.maximum(magnitude_max, spectrum)
    floor = 1e-9 * amplitude * 2**14
    np.testing.assert_allclose(scale * line.magnitude_rms, np.sqrt(powers), rtol=1e-9, atol=floor)
    assert (scale * line.magnitude_max >= magnitude_max - floor).all()
    np.testing.assert_allclose(scale * line.magnitude_max, magnitude_max, rtol=2e-3, atol=floor)


def test_the_beats_noise_is_that_of_simulated_records():
    """The density near DC of i (1 + dP/P) cos(phi + theta(t) - theta(t - tau))."""
    rng, rate, length, records = np.random.default_rng(5), 1e9, 2**14, 60
    width, rin, steps, beat = 3e4, 1e-12, 2, 0.7
    density = 0.0
    first, last = 40, 300  # where sin(pi f tau) is pi f tau to 0.3 %, off the line at 0
    for k, phase in enumerate(np.repeat(2 * np.pi * rng.random(records // 2), 2)):
        phase += np.pi / 2 * (k % 2)  # in pairs, whose sin^2 and cos^2 have the mean 1/2
        walk = np.cumsum(rng.normal(size=length + steps)) * np.sqrt(2 * np.pi * width / rate)
        theta = walk[steps:] - walk[:-steps]
        power = 1 + rng.normal(size=length) * np.sqrt(rin * rate / 2)
        # dP/P of both beams is a half each of the beat's amplitude: their root is the power.
        record = beat * power * np.cos(phase + theta)
        density += np.abs(np.fft.rfft(record)[first:last]) ** 2 * 2 / (length * rate) / records
    parameters = {
        "laser.power": beat**2 / 4, "laser.line_width": width,
        "laser.relative_intensity_noise": rin, "receiver.common_mode_rejection": 1e30,
        "receiver.local_oscillator_power": 1.0,
        "receiver.mixing_efficiency": 1.0, "receiver.apd_gain": 1.0, "receiver.responsivity": 1.0,
        "receiver.modulation_index": 1.0,
    }  # fmt: skip
    parameters = {f"instrument.{name}": value for name, value in parameters.items()}
    parameters |= {leak.LEAK_LENGTH_PATH: steps / rate * LIGHT, leak.ISOLATION_PATH: 1.0}
    law = leak.leak_beat_current_variance(parameters, "homodyne", "lorentzian", 1.0)
    # A bin's power has a relative variance of 1.
    spread = 1 / np.sqrt(records * (last - first) / 2)  # of records with all of either noise
    assert density.mean() == pytest.approx(law, rel=5 * spread)
    quiet = parameters | {"instrument.laser.relative_intensity_noise": 0.0}
    parts = (
        leak.leak_beat_current_variance(parameters, "homodyne", "gaussian", 1.0),
        leak.leak_beat_current_variance(quiet, "homodyne", "lorentzian", 1.0),
    )
    assert min(parts) > 0.2 * law  # both are seen
    # All the light of a laser fluctuates together, by what a balanced receiver rejects.
    rejecting = parameters | {
        "instrument.receiver.common_mode_rejection": 50.0,
        "instrument.receiver.mixing_efficiency": 0.0,
    }
    leaked = beat**2 / 4
    added_noise = rin * ((1.0 + leaked) ** 2 - 1.0) / 50.0
    assert leak.leak_beat_current_variance(rejecting, "homodyne", "gaussian", 1.0) == pytest.approx(
        added_noise, rel=1e-12
    )


def test_leaked_light_makes_shot_noise_and_the_beats_noise(leaking):
    laser = {
        "instrument.laser.line_width": 1e5, "instrument.laser.line_shape": "lorentzian",
        "instrument.laser.relative_intensity_noise": 1e-15,
        "instrument.receiver.common_mode_rejection": 300.0,
    }  # fmt: skip
    sources = prepare_single_category(leaking(further_parameters=laser), WITH).noise.variances
    light, volts = 1 / ISOLATION, 7e3**2
    assert sources["leak_shot"] == pytest.approx(2 * CHARGE * 1.1 * light * 4e8 * volts)
    power = (2 * 1.1) ** 2 * 1e-3 * light / 2  # of the beat [A^2]
    phase = 4 * np.pi * 1e5 * (PATH / LIGHT) ** 2
    phase = power * min(phase * 4e8, 2 * np.pi * 1e5 * PATH / LIGHT)
    beat = 1e-15 * 4e8 * (power + 1.1**2 * (2e-3 + light) * light / 300)
    assert sources["leak_excess"] == pytest.approx((phase + beat) * volts)


@pytest.mark.parametrize(("echo_level", "line"), [(3.0, 2.0), (8.0, 3.0), (0.5, 3.2), (20.0, 0.1)])
def test_an_echo_that_fades_next_to_a_line_crosses_as_drawn(echo_level, line):
    rng, number, level = np.random.default_rng(int(10 * echo_level)), 400_000, 6.5
    normal = rng.normal(size=(4, number))
    echo = echo_level * np.sqrt(0.5) * (normal[0] + 1j * normal[1])
    phase = np.exp(2j * np.pi * rng.random(number))
    crosses = np.mean(np.abs(echo + line * phase + normal[2] + 1j * normal[3]) >= level)
    m = permanent_line.echo_magnitude_with_line(
        np.array([echo_level]), np.array([line]), noise_sigma=1.0, threshold=level, in_speckle=True
    )[0]
    law = np.exp(-(level**2) / (2 + m**2))
    assert crosses == pytest.approx(law, abs=5 * np.sqrt(law / number))


def test_skirts_raise_alarms_as_often_as_in_simulated_records(leaking, monkeypatch):
    monkeypatch.setattr(
        permanent_line, "MASK_THRESHOLD_FRACTION", 0.8
    )  # for many more alarms than noise makes
    p = leaking(
        path=7.3, isolation=10**9.3, window="rectangular", fft_size=2**12, tnr=8.0,
        reflectance=1e-12, range=2000.0,
    )  # fmt: skip
    shots = prepare_single_category(p, WITH)
    scale, line = permanent_line.permanent_line_of_point(shots, 0, 0)
    level, sigma = float(shots.threshold[0]), float(shots.bin_noise_sigma[0])
    rng, number, size = np.random.default_rng(8), 5_000, 2**12
    (runs,) = iter_spans(shots)
    masked = scale * line.magnitude_max >= 0.8 * level
    looked = ~masked
    looked[[0, -1]] = False
    looked[runs.first_bin[0, 0] + np.flatnonzero(runs.is_exempt[: runs.n_bins[0, 0]])] = False
    beat = 1e9 / 500e-6 * 7.3 / LIGHT
    n, alarms = np.arange(size), 0
    for phase in 2 * np.pi * rng.random(number):
        noise = rng.normal(size=size) * np.sqrt(shots.noise_variance[0])
        tone = 2 * scale * np.cos(2 * np.pi * beat * n / 6e8 + phase)
        alarms += (np.abs(np.fft.rfft(noise + tone))[looked] >= level).any()
    statistics = evaluation.shot_statistics(shots)
    none = 1 - np.exp(-(level**2) / 2 / sigma**2)
    expected = 1 - (1 - statistics["p_leakage_up"][0]) * none ** looked.sum()
    assert 0.02 < expected < 0.9
    assert expected > 10 * (1 - none ** looked.sum())
    assert 10 < masked.sum() < 1000
    assert alarms / number == pytest.approx(expected, abs=5 * np.sqrt(expected / number))


def test_a_steady_echo_next_to_a_line_crosses_nearly_as_drawn():
    rng, number, level, echo_amplitude, line = np.random.default_rng(4), 200_000, 6.5, 6.0, 2.0
    phase = np.exp(2j * np.pi * rng.random(number))
    noise = rng.normal(size=number) + 1j * rng.normal(size=number)
    crosses = np.mean(np.abs(echo_amplitude + line * phase + noise) >= level)
    m = permanent_line.echo_magnitude_with_line(
        np.array([echo_amplitude]),
        np.array([line]),
        noise_sigma=1.0,
        threshold=level,
        in_speckle=False,
    )
    # Powers add, in place of the mean of the crossings over the phase: within 0.03.
    assert crosses == pytest.approx(float(marcum_q1(m, level).q[0]), abs=0.03)
    assert crosses > float(marcum_q1(echo_amplitude, level).q) + 0.05


def test_near_echoes_are_hidden_and_far_ones_are_not(leaking):
    far, near = (
        {"range": r, "radial_velocity": 0.0, "tnr": 8.0, "window": "hann"} for r in (2000.0, 8.0)
    )
    hidden = evaluation.evaluate(leaking(**near), WITH)
    assert hidden["pd_up"] == 0 and hidden["miss_up"] == 1
    assert evaluation.evaluate(leaking(**near), DEFAULT_EFFECTS)["pd_up"] > 0.999
    with_leak, without_leak = (
        evaluation.evaluate(leaking(**far), e) for e in (WITH, DEFAULT_EFFECTS)
    )
    assert with_leak["pd_up"] == pytest.approx(without_leak["pd_up"], abs=1e-3)
    assert with_leak["pd_up"] > 0.9
    # Masked bins are not searched.
    assert with_leak["pfa_segment"] < without_leak["pfa_segment"]


@pytest.mark.parametrize("combine", ["power", "binary"])
def test_several_looks_next_to_a_line_of_no_power_detect_as_without_it(leaking, combine):
    """A line 250 dB down hides nothing, so that the looks' law is left as it is."""
    looks = {LOOKS_NUMBER_PATH: 8, LOOKS_COMBINE_PATH: combine, LOOKS_VOTES_PATH: 2}
    parameters = leaking(isolation=1e25, range=12e3, radial_velocity=0.0, further_parameters=looks)
    with_line, without = (
        evaluation.evaluate(parameters, effects) for effects in (WITH, DEFAULT_EFFECTS)
    )
    one_look = evaluation.evaluate(parameters | {LOOKS_NUMBER_PATH: 1, LOOKS_VOTES_PATH: 1}, WITH)
    assert 0.05 < without["pd_doppler"] < 0.95
    assert abs(without["pd_doppler"] - one_look["pd_doppler"]) > 0.02
    for name in ("pd_up", "pd_doppler", "pd_down"):
        assert with_line[name] == pytest.approx(without[name], rel=1e-6)


def test_a_line_leaves_undetected_an_echo_just_outside_the_search_band(leaking):
    """The echo's strongest bin is outside, and bins of its main lobe are inside."""
    band = dict(zip(SEARCH_BAND_PATHS, (2000.3, 3000.0, -0.001, 0.001), strict=True))
    parameters = leaking(isolation=1e25, range=2000.0, radial_velocity=0.0, further_parameters=band)
    result = evaluation.evaluate(parameters, WITH)
    assert result["pd_up"] == 0 and result["miss_up"] == 1
