"""Evaluation of many shots: the same bits however they come, and what phases do to a footprint."""

import numpy as np
import pytest

from sweep.model import evaluation
from sweep.model.outputs import GRID_OUTPUTS

CATEGORIES = {
    "architecture": ("homodyne", "heterodyne", "direct"),
    "window": ("hamming", "hann", "kaiser(8.6)", "rectangular"),
    "bins_counted": ("half", "all"),
    "fft_size": (1024, 2000, 4096),
    "reflectance_law": ("thesis", "lambert"),
    "phases": ("coherent", "incoherent"),
    "beamlets": (1, 19, 37),
}


def mixed_points(number, seed=0):
    """Values of every kind of parameter for a number of points, by short name."""
    rng = np.random.default_rng((30, seed))
    spread = {
        "range": 10 ** rng.uniform(0, 4, number),
        "grazing_angle": np.radians(rng.choice([1.0, 10.0, 37.5, 85.0, 90.0], number)),
        "radial_velocity": rng.choice([-150.0, 0.0, 12.3, 150.0, 300.0], number),
        "beam_divergence": rng.choice([1e-6, 50e-6, 2e-3], number),
        "power": rng.uniform(1, 100, number),
        "local_oscillator_power": rng.uniform(1e-4, 1e-2, number),
        "aperture": rng.uniform(0.02, 0.2, number),
        "optical_efficiency": rng.uniform(0.1, 1, number),
        "reflectance": rng.uniform(0.01, 1, number),
        "wavelength": rng.choice([905e-9, 1550e-9], number),
        "tnr": rng.uniform(1, 12, number),
        "acquisition_delay": rng.choice([0.0, 70e-6, 498.5e-6], number),
        "duration": rng.choice([500e-6, 700e-6], number),
        "sample_rate": rng.choice([600e6, 900e6], number),
        "bandwidth": rng.choice([1e8, 1e9], number),
        "amplifier_noise_current": rng.uniform(1e-9, 50e-9, number),
        "noise_figure": rng.uniform(1, 3, number),
        "solar_irradiance": rng.choice([0.0, 2.6e8], number),
        "leakage_floor": rng.choice([0.0, 0.1, 1.0], number),
        "transimpedance": rng.uniform(1e3, 1e4, number),
    }
    return spread | {name: rng.choice(values, number) for name, values in CATEGORIES.items()}


def same_bits(one, other):
    """Names of the outputs whose bytes differ."""
    return {name for name in GRID_OUTPUTS if one[name].tobytes() != other[name].tobytes()}


def test_points_together_are_the_same_bits_as_point_by_point(table_4_1):
    points = mixed_points(60)
    together = evaluation.evaluate(table_4_1(**points))
    single = [
        evaluation.evaluate(table_4_1(**{name: v[i].item() for name, v in points.items()}))
        for i in range(60)
    ]
    joined = {name: np.concatenate([s[name] for s in single]) for name in GRID_OUTPUTS}
    assert same_bits(together, joined) == set()


@pytest.mark.parametrize("number", [2, 33])
def test_parameters_may_be_arrays_or_scalars(number, table_4_1):
    scenes = mixed_points(24, seed=1)
    for i in range(24):
        scene = table_4_1(**{name: v[i].item() for name, v in scenes.items()})
        outputs = evaluation.evaluate(scene)
        chosen = np.random.default_rng((32, i)).choice(list(scene), 12, replace=False)
        arrays = scene | {path: np.array([scene[path]] * number) for path in chosen}
        repeated = evaluation.evaluate(arrays)
        for k in range(number):
            assert same_bits({n: v[k : k + 1] for n, v in repeated.items()}, outputs) == set()


def test_reported_range_and_velocity_err_by_the_rounding_to_bins_and_by_no_bias(table_4_1):
    """Half the sum and half the difference of two roundings: 0.204 bins rms, half a bin at most.

    5 sigma of a mean over 2000 shots is 0.023 bins; half a bin of bias would be 0.5.
    """
    rng = np.random.default_rng(33)
    n, bin_width = 2000, 600e6 / 2**14
    ranges, velocities = rng.uniform(100, 6000, n), rng.uniform(-150, 150, n)
    f_d, f_r = 2 * velocities / 1550e-9, 2e12 * 2 * ranges / 299_792_458
    # Beats at DC or Nyquist apart: there the reading itself is at stake (test_waveform).
    clear = np.abs(np.abs(f_d) - f_r) > 5 * bin_width
    clear &= np.abs(np.abs(f_d) + f_r - 300e6) > 66 * bin_width
    results = evaluation.evaluate(
        table_4_1(
            range=ranges[clear], radial_velocity=velocities[clear], beamlets=1, fft_size=2**14
        )
    )
    for name, size in (("range_error", 0.343 * 8), ("radial_velocity_error", 3.55e-3 * 8)):
        bins = results[name] / size
        assert np.abs(bins).max() < 0.502, name
        assert abs(bins.mean()) < 0.023, name
        assert bins.std() == pytest.approx(0.204, rel=0.08), name


# Phases: a departure of the thesis's model that the project names openly. Its beamlets each have
# the full phase of their own range, so a footprint at one range adds up in phase to an amplitude
# sum_b sqrt(w_b), which grows with the number of beamlets although the light does not.


def snr_of(table_4_1, **changes):
    return evaluation.evaluate(table_4_1(range=50.0, **changes))["snr_doppler"][0]


def test_in_phase_coherent_beamlets_raise_the_snr_in_proportion_to_their_number(table_4_1):
    """(sum sqrt w)^2 of a Gaussian pattern cut at 3 sigma: n integral^2 / area, to 5 % from 37 on.

    With w = exp(-r^2/2) da / 2 pi the sum is sqrt(n / (9 pi)) (4 pi / sqrt(2 pi)) (1 - e^{-9/4}),
    squared 8/9 (1 - e^{-9/4})^2 = 0.71 n, over the power inside of 1 - e^{-9/2}: 0.72 n.
    """
    # 50 m, 1 urad: the footprint's ranges differ by 1e-11 m, all in phase.
    changes = {"phases": "coherent", "beam_divergence": 1e-6, "fft_size": 4096}
    one = snr_of(table_4_1, beamlets=1, **changes)
    for number in (37, 109, 397, 1201):
        gain = snr_of(table_4_1, beamlets=number, **changes) / one
        expected = 8 / 9 * (1 - np.exp(-9 / 4)) ** 2 / (1 - np.exp(-9 / 2))
        assert gain / number == pytest.approx(expected, rel=0.05)
