"""The signal-to-noise ratio that is stored: the one from which pd follows where one bin detects."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats
from shot_helpers import make_point_keys, prepare_single_category

from sweep.model.detection import looks
from sweep.model.effects.catalogue import DEFAULT_EFFECTS, PARAMETER_DEFAULTS
from sweep.model.evaluation import evaluate, shot_statistics
from sweep.model.sampling.noisy_spectra import (
    draw_signal_spectra,
    noiseless_signal,
    zero_frequency_index,
)

WIDTH, SHAPE = "instrument.laser.line_width", "instrument.laser.line_shape"
NARROW, WIDE = {SHAPE: "lorentzian", WIDTH: 2e3}, {SHAPE: "lorentzian", WIDTH: 3e6}
CHANGES = {
    "a line on its bin": {},
    "a line between bins": {"target.range": 1000.171},
    "a wide footprint": {"target.grazing_angle": 0.2, "instrument.laser.beam_divergence": 1e-3},
    "an uneven chirp": {"instrument.chirp.quadratic_error": 2e5},
    "a Gaussian line": {SHAPE: "gaussian", WIDTH: 3e4},
    "a Lorentzian line": NARROW,
    "a Lorentzian line that is all pedestal": WIDE,
    "a padded record": {"instrument.processing.sample_rate": 25e6},
    "a complex record": {"instrument.receiver.record": "complex"},
    "averaged powers": {looks.LOOKS_NUMBER_PATH: 4, looks.LOOKS_COMBINE_PATH: "power"},
    "added records": {looks.LOOKS_NUMBER_PATH: 4, looks.LOOKS_COMBINE_PATH: "coherent"},
}
EFFECTS = (*DEFAULT_EFFECTS, "fading", "chirp_nonlinearity", "line_width")


def _parameters(table_4_1, changes, speckle, power):
    parameters = table_4_1(
        fft_size=2**14, detection="peak_bin", beamlets=19, phases="incoherent", range=1000.0,
        radial_velocity=20.0, tnr=5.0, power=power,
    )  # fmt: skip
    return PARAMETER_DEFAULTS | parameters | {"footprint.speckle": speckle} | changes


@given(
    case=st.sampled_from(sorted(CHANGES)),
    speckle=st.sampled_from(["developed", "none"]),
    power=st.floats(-40.0, 0.0),
)
def test_pd_follows_from_the_ratio_by_swerlings_law_or_marcums(table_4_1, case, speckle, power):
    """exp(-y / (1 + SNR)), or a noncentral chi square; n periodograms have 2 n degrees of freedom.

    A pedestal is noise that comes with the light, so that a line on it has neither law: steady, or
    developed but for 1e-3, as its pedestal is weak here. One that is all pedestal is circular, and
    fades with the light: the mean of exp(-y / (1 + SNR e)) over an exponential e.
    """
    changes = CHANGES[case]
    out = evaluate(_parameters(table_4_1, changes, speckle, 10 ** (power / 10)), EFFECTS)
    number = 4 if case == "averaged powers" else 1
    y = stats.gamma.isf(10.0 ** out["log10_pfa_bin"], number)
    for name in ("up", "doppler", "down"):
        pd, snr = out[f"pd_{name}"], out[f"snr_{name}"]
        if speckle == "developed" and number > 1:
            speckles = stats.expon.ppf((np.arange(4000) + 0.5) / 4000)
            expected = stats.ncx2.sf(2 * y, 2 * number, 2 * number * snr * speckles).mean()
        elif speckle == "developed" and changes is WIDE:
            node, weight = np.polynomial.laguerre.laggauss(60)
            expected = (weight * np.exp(-y / (1 + snr * node))).sum()
        elif speckle == "developed" or changes is WIDE:
            expected = np.exp(-y / (1 + snr))
        elif changes is NARROW:
            continue
        else:
            expected = stats.ncx2.sf(2 * y, 2 * number, 2 * number * snr)
        rough = speckle == "developed" and changes in (NARROW, WIDE)
        loose = 1e-3 if rough else 3e-4 if number > 1 else 1e-12
        assert pd == pytest.approx(expected, rel=1e-6, abs=loose)


@pytest.mark.parametrize("width", [2e4, 1e5, 3e6])
def test_the_power_of_a_lorentzian_line_is_that_of_records_whose_phase_walks(width, table_4_1):
    """Mean |X|^2 of the strongest bin over 600 drawn phases, to 5 standard errors and 3 %."""
    parameters = _parameters(table_4_1, {SHAPE: "lorentzian", WIDTH: width}, "none", 0.1)
    parameters |= {"instrument.processing.fft_size": 2**12}
    shots = prepare_single_category(parameters, EFFECTS)
    out = shot_statistics(shots)
    signal = noiseless_signal(shots, 0, 0)
    spectra = draw_signal_spectra(
        shots, 0, 0, signal, key=make_point_keys(1)[0], draws=np.arange(600)
    )
    power = np.abs(spectra[:, signal.strongest_bin]) ** 2 / (2 * shots.bin_noise_sigma[0] ** 2)
    error = 5 * power.std() / np.sqrt(600) + 0.03 * power.mean()
    assert out["snr_up"][0] == pytest.approx(power.mean(), abs=error)
    assert signal.strongest_bin - zero_frequency_index(shots) > 0
    line = np.square(np.abs(signal.spectrum).max() / shots.bin_noise_sigma[0]) / 2
    assert out["snr_up"][0] < 1.01 * line  # the walk adds no light
