"""Draws of speckle against the time-domain truth, Swerling's and Rice's laws, and integrals."""

import numpy as np
import pytest
from mean_over_draws import mean_statistics
from scipy.integrate import quad
from shot_helpers import make_point_keys, prepare_single_category

from sweep.model import time_domain_truth, window
from sweep.model.detection.marcum import marcum_q1
from sweep.model.effects import speckle
from sweep.model.effects.catalogue import DEFAULT_EFFECTS
from sweep.model.effects.effect import DrawAddresses
from sweep.model.evaluation import evaluate as evaluate_without
from sweep.model.evaluation import evaluate_segments, shot_statistics
from sweep.model.sampling.realisations import iter_realisations

AGREEMENT = 1e-9
"""Largest difference from the truth over the peak: the truth's own floor is 1e-11."""

SPECKLED = (*DEFAULT_EFFECTS, "speckle")
STILL = tuple(effect for effect in SPECKLED if effect != "doppler_spread")
"""Beamlets with one velocity: their own turn speckles apart."""
ROUGH = {"target.roughness": 1e-5}
ONE_BIN = {"range": 2000.0, "grazing_angle": np.pi / 2, "beamlets": 3, "phases": "incoherent"}
"""Ranges 3 um apart in bins of 0.34 m."""


def with_share(parameters, share):
    """A surface of which this share of the power stays coherent."""
    wavelength = parameters["instrument.laser.wavelength"]
    roughness = np.sqrt(-np.log(share)) * wavelength / (4 * np.pi)
    return parameters | {"target.roughness": roughness}


def factors(draws, beamlets, share=0.0, random_phases=False, seeded=None):
    """Factors g of draws of a point, (draws, beamlets)."""
    chosen = np.repeat(make_point_keys(1) if seeded is None else seeded, draws, axis=0)
    magnitude, cycles = speckle.draw_speckle_factors(
        DrawAddresses(chosen, np.arange(draws), draws_are_grouped=True), n_beamlets=beamlets,
        coherent_fraction=np.full(draws, share), random_phases=random_phases,
    )  # fmt: skip
    return magnitude * np.exp(2j * np.pi * cycles)


def true_spectra(shots, segment):
    """Analytic spectra at k and -k, k = 0..N/2, (2, beamlets, bins), of each beamlet alone."""
    w = window.window_samples(shots.window.name, shots.window.length)
    half = np.arange(shots.fft_size // 2 + 1)
    both = [
        np.fft.fft(
            w
            * time_domain_truth.beamlet_analytic_signal(
                shots, 0, segment, b, with_range_walk=False
            ),
            shots.fft_size,
        )
        for b in range(shots.footprint.n_beamlets)
    ]
    return np.array([[x[half] / 2 for x in both], [x[-half].conj() / 2 for x in both]])


def true_magnitudes(spectra, g):
    """|X[k]| for the factors of draws (draws, beamlets), by plain sums over beamlets."""
    return abs(g @ spectra[0] + (g @ spectra[1].conj()).conj())


SCENES = {
    "spread": {"range": 3000.0, "grazing_angle": 0.3, "beam_divergence": 5e-4, "beamlets": 19},
    "at DC": {"range": 1.0, "grazing_angle": 0.3, "radial_velocity": 0.0, "beamlets": 5},
    "padded, tabulated": {
        "window": "kaiser(8.6)", "acquisition_delay": 495e-6, "grazing_angle": 0.3, "beamlets": 5
    },
    "receding, odd": {
        "fft_size": 3125, "window": "hann", "radial_velocity": -300.0, "phases": "incoherent",
        "beamlets": 7, "grazing_angle": 0.3,
    },
}  # fmt: skip


@pytest.mark.parametrize("scene", SCENES.values(), ids=SCENES)
def test_a_draws_peak_is_that_of_its_record(scene, table_4_1):
    """The same factors for all segments, conjugated where the beat folds."""
    parameters = table_4_1(**{"fft_size": 4096} | scene)
    shots, share = prepare_single_category(parameters, STILL[:-1]), 0.2
    number = shots.footprint.n_beamlets
    g = factors(20, number, share, random_phases=shots.footprint.adds_powers)
    (drawn,) = iter_realisations(
        with_share(parameters, share), STILL, keys=make_point_keys(1), draws=20
    )
    spectra = evaluate_segments(drawn.shots)
    for segment in range(3):
        exact = true_magnitudes(true_spectra(shots, segment), g).max(axis=1)
        np.testing.assert_allclose(spectra.magnitude[segment], exact, rtol=AGREEMENT)


def test_detection_over_several_bins_is_that_of_plain_sums(table_4_1):
    """Each draw's strongest bin by sums of the same factors over whole spectra."""
    parameters = table_4_1(
        fft_size=2**14, range=3000.0, grazing_angle=0.2, beam_divergence=3e-3, beamlets=19,
        tnr=7.0, phases="incoherent", power=1.0,
    )  # fmt: skip
    shots, draws = prepare_single_category(parameters, STILL[:-1]), 400
    g = factors(draws, 19)
    means = mean_statistics(parameters | ROUGH, STILL, keys=make_point_keys(1), draws=draws)
    beta, pd = shots.threshold[0] / shots.bin_noise_sigma[0], {}
    spectra = {name: true_spectra(shots, s) for s, name in ((0, "up"), (2, "down"))}
    lines = (abs(spectra["up"]) ** 2).sum(axis=(0, 1))
    assert (lines > lines.max() / 4).sum() > 5
    for name, values in spectra.items():
        peaks = true_magnitudes(values, g).max(axis=1)
        pd[name] = marcum_q1(peaks / shots.bin_noise_sigma[0], beta).q
        assert 0.05 < pd[name].mean() < 0.95
        assert means[f"pd_{name}"][0] == pytest.approx(pd[name].mean(), rel=1e-7)
    joint_pd = pd["up"] * pd["down"]
    assert means["pd_shot"][0] == pytest.approx(joint_pd.mean(), rel=1e-7)
    error = joint_pd.std(ddof=1) / np.sqrt(draws)
    assert means["pd_shot_error"][0] == pytest.approx(error, rel=1e-5)


SNRS = np.array([10.0, 30.0, 200.0])
"""After the FFT, in the mean over speckle; pd 0.02 to 0.8 at Table 4.1's threshold."""


def at_snrs(table_4_1, snrs, **changes):
    """Points whose mean power in the up segment's bin is so many times the noise's."""
    parameters = table_4_1(**ONE_BIN | {"fft_size": 4096} | changes) | ROUGH
    snr = evaluate_without(parameters)["snr_up"]
    # The echo's shot noise moves the SNR by some 1e-7 of itself.
    return parameters | {"instrument.laser.power": np.asarray(snrs) / snr}


def in_one_bin(parameters, steady=0.0, diffuse=1.0):
    """Closed form of each segment: shares of the steady amplitude's square and diffuse power."""
    shots, outputs = prepare_single_category(parameters), evaluate_without(parameters)
    powers = evaluate_without(parameters | {"footprint.phases": "incoherent"})
    return {
        s: marcum_q1(
            np.sqrt(2 * steady * outputs[f"snr_{s}"]) / deviation,
            shots.threshold / shots.bin_noise_sigma / deviation,
        ).q
        for s in ("up", "doppler", "down")
        for deviation in [np.sqrt(1 + diffuse * powers[f"snr_{s}"])]
    }


def test_speckled_beamlets_in_a_bin_are_a_swerling_1_target(table_4_1):
    parameters, draws = at_snrs(table_4_1, SNRS), 10_000
    means = mean_statistics(parameters, SPECKLED, keys=make_point_keys(3), draws=draws)
    shots = prepare_single_category(parameters)
    swerling = np.exp(-0.5 * (shots.threshold / shots.bin_noise_sigma) ** 2 / (1 + SNRS))
    closed = in_one_bin(parameters)
    np.testing.assert_allclose(closed["up"], swerling, rtol=1e-5)
    for segment, exact in closed.items():
        assert ((exact > 0.01) & (exact < 0.99)).all()
        error = means[f"pd_{segment}_error"]
        assert (abs(means[f"pd_{segment}"] - exact) <= 5 * error + 1e-6).all(), segment
        assert (error < 0.51 / np.sqrt(draws)).all()


def joint_detection(powers, covariance, level):
    """Chance that bins of two segments both cross: given the first, the second is Rice's.

    Mean powers of the diffuse signal, its covariance, and the threshold, in noise of sigma 1.
    """

    def both(first, second, shared, level):
        first, second = first + 2.0, second + 2.0
        sigma = np.sqrt((second - shared**2 / first) / 2)

        def rice(t):
            return np.exp(-t) * marcum_q1(shared * np.sqrt(t / first) / sigma, level / sigma).q

        return quad(rice, level**2 / first, 60.0, epsabs=1e-13, limit=200)[0]

    return np.vectorize(both)(*powers, covariance, level)


def test_one_beamlet_fades_alike_in_up_and_down(table_4_1):
    """All that parts the two segments is noise: the bivariate Rayleigh law of one amplitude."""
    parameters = at_snrs(table_4_1, SNRS, beamlets=1)
    shots, outputs = prepare_single_category(parameters), evaluate_without(parameters)
    powers = 2 * outputs["snr_up"], 2 * outputs["snr_down"]
    exact = joint_detection(
        powers, np.sqrt(powers[0] * powers[1]), shots.threshold / shots.bin_noise_sigma
    )
    means = mean_statistics(parameters, SPECKLED, keys=make_point_keys(3), draws=10_000)
    assert (abs(means["pd_shot"] - exact) <= 5 * means["pd_shot_error"] + 1e-6).all()
    product = means["pd_up"] * means["pd_down"]
    assert (means["pd_shot"] > product + 10 * means["pd_shot_error"]).all()


@pytest.mark.parametrize(
    ("share", "beamlets"), [pytest.param(0.05, 7, marks=pytest.mark.slow), (0.99, 1), (0.5, 7)]
)
def test_partly_rough_surfaces_are_ricean(share, beamlets, table_4_1):
    parameters = at_snrs(
        table_4_1, [15.0, 60.0], phases="coherent", beam_divergence=5e-6, beamlets=beamlets
    )
    means = mean_statistics(
        with_share(parameters, share), SPECKLED, keys=make_point_keys(2), draws=10_000
    )
    for segment, exact in in_one_bin(parameters, share, 1 - share).items():
        error = means[f"pd_{segment}_error"]
        assert (abs(means[f"pd_{segment}"] - exact) <= 5 * error + 1e-6).all(), segment
        assert (error > 1e-7).all()


def test_the_coherent_share_is_that_of_a_sum_over_random_heights():
    rng = np.random.default_rng(3)
    wavelength, number = 1550e-9, 400_000
    for roughness in (0.02, 0.08, 0.15):
        heights = rng.normal(scale=roughness * wavelength, size=number)
        mean = np.exp(4j * np.pi * heights / wavelength).mean()
        share = speckle.coherent_echo_fraction(
            roughness=roughness * wavelength, wavelength=wavelength
        )
        assert abs(abs(mean) - np.sqrt(share)) < 5 / np.sqrt(number)
    assert speckle.coherent_echo_fraction(roughness=np.inf, wavelength=wavelength) == 0
    assert speckle.coherent_echo_fraction(roughness=0.0, wavelength=wavelength) == 1


@pytest.mark.parametrize("share", [0.0, 0.3, 0.9])
def test_factors_are_a_steady_and_a_normal_part(share):
    """Their moments, 5 sigma of 2e5 factors: of mean power 1, all their beamlets apart."""
    g = factors(50_000, 4, share)
    root = np.sqrt(g.size)
    assert abs(g.mean() - np.sqrt(share)) < 5 / root
    assert (abs(g) ** 2).mean() == pytest.approx(1, abs=5 * np.sqrt(1 - share**2) / root)
    diffuse = (g - np.sqrt(share)) / np.sqrt(1 - share)
    assert abs((diffuse**2).mean()) < 5 * np.sqrt(2) / root
    assert (abs(diffuse) ** 4).mean() == pytest.approx(2, abs=5 * np.sqrt(20) / root)
    assert abs((diffuse[:, :-1] * diffuse[:, 1:].conj()).mean()) < 5 / np.sqrt(150_000)
    turned = factors(50_000, 4, share, random_phases=True)
    assert abs(turned.mean()) < 5 / root
    assert (abs(turned) ** 2).mean() == pytest.approx(1, abs=5 * np.sqrt(1 - share**2) / root)


def test_up_and_down_speckles_part_as_depth_and_frequency_make_them(table_4_1):
    """A short record sees both ends of the chirp, df = B - S (T_w - 2 tau) apart on average.

    That is between the echoes in mid-record, which left tau earlier. Ranges normal by sigma_R, far
    within a bin, make the correlation exp(-(4 pi df sigma_R / c)^2 / 2), and 109 beamlets a
    quadrature of it: to 0.003 at 0.71 and 0.01 at 0.05, where it matters little.
    """
    gains = []
    for grazing_angle in (1.5, 1.2, 0.9, 0.4):
        parameters = at_snrs(
            table_4_1, [40.0], fft_size=2048, grazing_angle=grazing_angle, beamlets=109
        )
        between = 1e9 - 2e12 * (2048 / 600e6 - 2 * 2 * 2000.0 / 299792458.0)
        depth = 2000.0 * 50e-6 / 4 / np.tan(grazing_angle)
        exact = joint(parameters, 4 * np.pi * between * depth / 299792458.0)
        means = mean_statistics(parameters, SPECKLED, keys=make_point_keys(1), draws=5_000)
        assert abs(means["pd_shot"] - exact) <= 5 * means["pd_shot_error"] + 1.5e-3
        gains.append((means["pd_shot"] / (means["pd_up"] * means["pd_down"]))[0])
    assert gains[0] > 1.5 > 1.02 > gains[-1] > 0.98


def joint(parameters, phase):
    """Chance of both chirps where beamlets part by normal phases [rad] of this deviation."""
    shots, outputs = prepare_single_category(parameters), evaluate_without(parameters)
    powers = 2 * outputs["snr_up"], 2 * outputs["snr_down"]
    return joint_detection(
        powers,
        np.exp(-0.5 * phase**2) * np.sqrt(powers[0] * powers[1]),
        shots.threshold / shots.bin_noise_sigma,
    )


def test_what_moves_across_the_beam_turns_speckles_apart_between_segments(table_4_1):
    """Tilts normal by div/4: 2 T 2 v div/4 / lambda cycles between the starts of up and down."""
    parameters = at_snrs(table_4_1, [40.0], fft_size=2048, beamlets=109)
    gains = []
    for speed in (0.0, 6.0, 15.0, 100.0):
        moving = parameters | {"target.transverse_velocity": speed}
        means = mean_statistics(moving, SPECKLED, keys=make_point_keys(1), draws=5_000)
        exact = joint(moving, 2 * np.pi * 2 * 500e-6 * 2 * speed * 12.5e-6 / 1550e-9)
        assert abs(means["pd_shot"] - exact) <= 5 * means["pd_shot_error"] + 2e-3
        gains.append((means["pd_shot"] / (means["pd_up"] * means["pd_down"]))[0])
    assert gains[0] > 1.5 > 1.05 > gains[-1]
    without_motion = mean_statistics(moving, STILL, keys=make_point_keys(1), draws=100)
    at_rest = mean_statistics(parameters, STILL, keys=make_point_keys(1), draws=100)
    np.testing.assert_allclose(without_motion["pd_shot"], at_rest["pd_shot"], rtol=1e-9)


@pytest.mark.parametrize("radial_velocity", [150.0, 0.0])
def test_turning_adds_to_what_depth_does_or_takes_it_back(radial_velocity, table_4_1):
    """Moving so that far beamlets close faster offsets that they are further in the down chirp.

    2 T f 2 v t / c cycles against B 2 R t cot(grazing) / c, for a tilt t. Moving towards the near
    side, near ones close faster. At rest the up beat folds and the down beat does not.
    """
    parameters = at_snrs(
        table_4_1, [40.0], fft_size=2048, grazing_angle=0.9, radial_velocity=radial_velocity,
        beamlets=109,
    )  # fmt: skip
    carrier = 299792458.0 / 1550e-9
    speed = 1e9 * 2000.0 / np.tan(0.9) / (2 * 500e-6 * carrier)
    gains = {}
    for sense in (-1, 1):
        moving = parameters | {"target.transverse_velocity": sense * speed}
        means = mean_statistics(moving, SPECKLED, keys=make_point_keys(1), draws=5_000)
        gains[sense] = (means["pd_shot"] / (means["pd_up"] * means["pd_down"]))[0]
    assert gains[-1] > 1.5 > 1.1 > gains[1]


@pytest.mark.parametrize("across", [0.0, 50.0])
def test_a_smooth_surface_is_what_the_shot_is_without(across, table_4_1):
    parameters = table_4_1(grazing_angle=0.3, range=np.array([2500.0, 4000.0]), beamlets=19)
    parameters |= {"target.roughness": 0.0, "target.transverse_velocity": across}
    outputs = evaluate_without(parameters)
    means = mean_statistics(parameters, SPECKLED, keys=make_point_keys(2), draws=2)
    for name in ("pd_up", "pd_doppler", "pd_down", "pd_shot", "snr_doppler", "pfa_segment"):
        np.testing.assert_allclose(means[name], outputs[name], rtol=1e-7)


def test_what_stands_under_a_line_fades_with_it(table_4_1):
    """One beamlet's pedestal of phase noise has the power of its line, draw by draw."""
    parameters = table_4_1(range=4000.0, beamlets=1) | ROUGH
    parameters |= {
        "instrument.laser.line_width": 20e3, "instrument.laser.line_shape": "lorentzian"
    }  # fmt: skip
    effects = (*SPECKLED, "line_width")
    (stretch,) = iter_realisations(parameters, effects, keys=make_point_keys(1), draws=50)
    ratio = (
        stretch.shots.laser_line.pedestal_variance_under_line
        / shot_statistics(stretch.shots)["snr_up"]
    )
    np.testing.assert_allclose(ratio, ratio[0], rtol=1e-4)  # the image's phase moves with it
    assert (
        np.ptp(stretch.shots.laser_line.pedestal_variance_under_line)
        > 0.5 * stretch.shots.laser_line.pedestal_variance_under_line.mean()
    )


def test_direct_detection_is_refused(table_4_1):
    with pytest.raises(ValueError, match="direct detection"):
        mean_statistics(
            table_4_1(architecture="direct") | ROUGH, SPECKLED, keys=make_point_keys(1), draws=1
        )
