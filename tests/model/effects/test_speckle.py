"""Speckle against the time-domain truth, Swerling's and Rice's laws, and sums of scatterers."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad

from sweep.model import philox, truth, window
from sweep.model.effects import speckle
from sweep.model.effects.change import pd_change
from sweep.model.effects.speckle_bins import margin, response
from sweep.model.effects.speckle_draws import (
    conditional_detection,
    mean_and_error,
    mean_detection,
    sampled_detection,
)
from sweep.model.marcum import marcum_q1
from sweep.model.preparation import prepare
from sweep.model.shot import evaluate

AGREEMENT = 1e-9
"""Largest difference from the truth over the peak: the truth's own floor is 1e-11."""

ONE_BIN = {"range": 2000.0, "grazing_angle": np.pi / 2, "beamlets": 19, "phases": "incoherent"}
"""Ranges 3 um apart in bins of 0.34 m."""


def prepared(parameters):
    ((_, shots),) = prepare(parameters)
    return shots


def keys(n, seed=5):
    return philox.point_keys(np.arange(float(n))[:, None], domain="tests", seed=seed)


def true_spectra(shots, segment, factors):
    """Complex spectrum 0..N/2 by the record, one row a beamlet, each with its factor."""
    w = window.samples(shots.window.name, shots.window.length)
    records = [
        f * truth.analytic_record(shots, 0, segment, b, range_walk=False)
        for b, f in enumerate(factors)
    ]
    return np.array([np.fft.rfft(w * record.real, shots.fft_size) for record in records])


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
def test_a_draws_bins_are_those_of_its_record(scene, table_4_1):
    """The same factors for all segments, conjugated where the beat folds."""
    shots = prepared(table_4_1(**{"fft_size": 4096} | scene))
    g = speckle.amplitudes(
        keys=keys(1), first_draw=0, draws=1, beamlets=shots.offset.shape[1], coherent_share=0.2
    )[0, 0]
    for segment in range(3):
        found = response(shots, 0, segment, margin_bins=margin(shots.window))
        exact = abs(true_spectra(shots, segment, g).sum(axis=0))
        assert abs(abs(found.spectrum(g)) - exact[found.bins]).max() < AGREEMENT * exact.max()
        outside = np.delete(exact, found.bins).max()
        assert outside <= found.outside * (found.strength * abs(g)).sum() * (1 + 1e-9)


@pytest.mark.parametrize("segment", [0, 1, 2])
def test_the_covariance_of_bins_is_that_of_the_records_and_of_the_draws(segment, table_4_1):
    shots = prepared(table_4_1(**{"fft_size": 4096} | SCENES["spread"]))
    found = response(shots, 0, segment, margin_bins=margin(shots.window))
    w = window.samples(shots.window.name, shots.window.length)
    exact = np.zeros((found.bins.size, found.bins.size), complex)
    for b in range(19):
        record = truth.analytic_record(shots, 0, segment, b, range_walk=False)
        both = np.fft.fft(w * record) / 2
        # The half at -k is what a real record folds onto k; a random phase parts the two.
        for half in (both[found.bins], both[-found.bins].conj()):
            turned = half * (-1.0) ** found.bins
            exact += np.outer(turned, turned.conj())
    covariance = found.covariance()
    assert abs(covariance - exact).max() < AGREEMENT * abs(exact).max()
    draws = 20_000
    g = speckle.amplitudes(keys=keys(1), first_draw=0, draws=draws, beamlets=19)[0]
    x = found.spectrum(g)
    sampled = np.einsum("dk,dl->kl", x, x.conj()) / draws
    power = covariance.diagonal().real
    assert (abs(sampled - covariance) <= 5 * np.sqrt(np.outer(power, power) / draws)).all()


def at_snrs(table_4_1, mean_snrs, **changes):
    """Shots of one kind whose mean power in the detecting bin is so many times the noise's."""
    parameters = table_4_1(**ONE_BIN | changes)
    plain = evaluate(parameters)["snr_up"]
    power = 1.0 * np.asarray(mean_snrs) / plain
    # The echo's shot noise moves the SNR by some 1e-7 of itself; what is drawn takes it in.
    return prepared(parameters | {"instrument.laser.power": power})


def swerling_1(shots, snr):
    return np.exp(-0.5 * (shots.threshold / shots.bin_deviation) ** 2 / (1 + snr))


def holds_swerlings_law(shots, parameters_snr, draws):
    drawn = conditional_detection(shots, keys=keys(len(parameters_snr)), draws=draws)
    for segment in ("up", "down"):
        mean, error = mean_and_error(drawn[f"pd_{segment}"])
        snr = parameters_snr if segment == "up" else parameters_snr * down_over_up(shots)
        exact = swerling_1(shots, snr)
        assert ((exact > 0.01) & (exact < 0.99)).all()
        assert (abs(mean - exact) <= 5 * error + 1e-6).all(), segment
        assert (error < 0.51 / np.sqrt(draws)).all()


def down_over_up(shots):
    """Ratio of mean powers of the strongest down to up bin, by the whole spectrum."""
    small = [truth.spectrum(shots, 0, s, range_walk=False).max() for s in (0, 2)]
    return (small[1] / small[0]) ** 2


SNRS = np.array([10.0, 30.0, 200.0])


def test_one_speckled_beamlet_is_a_swerling_1_target(table_4_1):
    shots = at_snrs(table_4_1, SNRS, beamlets=1, fft_size=8192)
    holds_swerlings_law(shots, SNRS, 1_000_000)


@pytest.mark.parametrize(
    "draws", [100_000, pytest.param(1_000_000, marks=pytest.mark.slow)], ids=["some", "many"]
)
def test_many_speckled_beamlets_in_a_bin_are_a_swerling_1_target(draws, table_4_1):
    holds_swerlings_law(at_snrs(table_4_1, SNRS, fft_size=8192), SNRS, draws)


def test_the_closed_form_is_swerlings_law_too(table_4_1):
    shots = at_snrs(table_4_1, SNRS, fft_size=8192)
    found = mean_detection(shots)
    assert found.spread.max() < 1e-8  # the images' power, the same share of it in no two bins
    np.testing.assert_allclose(found.pd[0], swerling_1(shots, SNRS), rtol=1e-5)


FEW_BINS = {"fft_size": 256, "tnr": 5.0}
"""Where the signal's own bins are no small part of all."""


@pytest.mark.parametrize("scene", [{}, {"beam_divergence": 2e-3, "grazing_angle": 0.2}, FEW_BINS])
def test_drawing_the_noise_too_gives_the_same_means(scene, table_4_1):
    draws = 20_000
    changes = {"fft_size": 8192, "tnr": 7.0, "window": "rectangular"} | scene
    shots = at_snrs(table_4_1, [20.0, 60.0], **changes)
    over_noise = conditional_detection(shots, keys=keys(2), draws=draws)
    drawn = sampled_detection(shots, keys=keys(2), draws=draws)
    for segment in ("up", "doppler", "down", "shot"):
        exact, by_count = over_noise[f"pd_{segment}"], drawn[f"found_{segment}"]
        # The same speckle in both: what is left is the noise's Bernoulli variance.
        sigma = np.sqrt((exact * (1 - exact)).mean(axis=1) / draws)
        assert (abs(exact.mean(axis=1) - by_count.mean(axis=1)) <= 5 * sigma).all(), segment
    for segment in ("up", "down"):
        leaks = over_noise[f"p_leakage_{segment}"]
        exact = 1 - (1 - over_noise[f"pfa_{segment}"]) * (1 - leaks)
        assert exact.mean() > 1e-3
        sigma = np.sqrt((exact * (1 - exact)).mean(axis=1) / draws)
        by_count = drawn[f"alarm_{segment}"].mean(axis=1)
        assert (abs(exact.mean(axis=1) - by_count) <= 5 * sigma).all(), segment


def test_up_and_down_speckles_part_as_depth_and_frequency_make_them(table_4_1):
    """A short record sees both ends of the chirp, df = B - S (T_w - 2 tau) apart on average.

    That is between the echoes in mid-record, which left tau earlier. Ranges normal by sigma_R, far
    within a bin, make the correlation exp(-(4 pi df sigma_R / c)^2 / 2), and 109 beamlets a
    quadrature of it: to 0.003 at 0.71 and 0.01 at 0.05, where it matters little.
    """
    gains = []
    for grazing_angle in (1.5, 1.2, 0.9, 0.4):
        shots = at_snrs(
            table_4_1, [40.0], fft_size=2048, grazing_angle=grazing_angle, beamlets=109
        )  # fmt: skip
        closed = mean_detection(shots)
        assert closed.spread.max() < 1e-3
        drawn = conditional_detection(shots, keys=keys(1), draws=25_000)["pd_shot"]
        mean, error = mean_and_error(drawn)
        assert abs(mean - closed.pd_shot) <= 5 * error + closed.spread.max()
        between = 1e9 - 2e12 * (2048 / 600e6 - 2 * 2 * 2000.0 / 299792458.0)
        depth = 2000.0 * 50e-6 / 4 / np.tan(grazing_angle)
        correlation = np.exp(-0.5 * (4 * np.pi * between * depth / 299792458.0) ** 2)
        powers = [_mean_power(shots, s) for s in (0, 2)]
        exact = speckle.joint_detection(
            powers=tuple(powers), covariance=correlation * np.sqrt(powers[0] * powers[1]),
            bin_deviation=shots.bin_deviation, threshold=shots.threshold,
        )  # fmt: skip
        assert closed.pd_shot == pytest.approx(exact, abs=1.5e-3)
        gains.append(closed.pd_shot[0] / (closed.pd[0] * closed.pd[2])[0])
    assert gains[0] > 1.5 > 1.01 > gains[-1] > 0.99


def _mean_power(shots, segment):
    found = response(shots, 0, segment, margin_bins=margin(shots.window))
    return found.covariance().diagonal().real.max()


def test_what_moves_across_the_beam_turns_speckles_apart_between_segments(table_4_1):
    shots = at_snrs(table_4_1, [40.0], fft_size=2048)
    across = np.linspace(-2.0, 2.0, 19)[None] / float(shots.carriers[0]) / 500e-6
    moving = replace(shots, doppler=across)
    still, apart = (
        conditional_detection(moving, keys=keys(1), draws=20_000, interval=v) for v in (0.0, None)
    )
    np.testing.assert_array_equal(still["pd_up"], apart["pd_up"])
    both = {"still": still["pd_shot"].mean(), "apart": apart["pd_shot"].mean()}
    alone = apart["pd_up"].mean() * apart["pd_down"].mean()
    _, error = mean_and_error(apart["pd_shot"])
    closed = mean_detection(moving)
    assert abs(both["apart"] - closed.pd_shot[0]) <= 5 * error[0] + closed.spread.max()
    assert both["still"] > 1.5 * alone
    assert both["apart"] < 1.1 * alone


@pytest.mark.parametrize("radial_velocity", [150.0, 0.0])
def test_turning_adds_to_what_depth_does_or_takes_it_back(radial_velocity, table_4_1):
    """Doppler shifts in proportion to depth, so that both turn a beamlet by as many cycles.

    At rest the up beat folds and the down beat does not.
    """
    shots = at_snrs(
        table_4_1, [40.0], fft_size=2048, grazing_angle=0.9, radial_velocity=radial_velocity
    )
    cycles = 2 * 2000.0 * shots.offset / 299792458.0 * 1e9
    gains = {}
    for sense in (-1, 1):
        moving = replace(shots, doppler=sense * cycles / (2 * 500e-6 * shots.carriers[0]))
        closed = mean_detection(moving)
        drawn = conditional_detection(moving, keys=keys(1), draws=20_000)["pd_shot"]
        mean, error = mean_and_error(drawn)
        assert abs(mean - closed.pd_shot) <= 5 * error + closed.spread.max()
        gains[sense] = float(closed.pd_shot[0] / (closed.pd[0] * closed.pd[2])[0])
    assert gains[1] > 1.5 > 1.1 > gains[-1]


def test_both_cross_as_an_integral_over_one_of_the_two_says():
    """Given the first, the second is a Rice variable: integrated over the first's power."""
    for correlation in (0.0, 0.3, 0.9, 0.999):
        for powers in ((30.0, 30.0), (5.0, 80.0)):
            covariance = correlation * np.sqrt(powers[0] * powers[1])
            first, second = powers[0] + 2.0, powers[1] + 2.0
            rest = second - covariance**2 / first

            def rice(t, first=first, rest=rest, covariance=covariance):
                mean = covariance / first * np.sqrt(first * t)
                return np.exp(-t) * marcum_q1(mean / np.sqrt(rest / 2), 6 / np.sqrt(rest / 2)).q

            exact, _ = quad(rice, 36.0 / first, 60.0, epsabs=1e-13, limit=200)
            found = speckle.joint_detection(
                powers=powers, covariance=covariance, bin_deviation=1.0, threshold=6.0
            )
            assert found == pytest.approx(exact, rel=1e-8)


@pytest.mark.parametrize("share", [0.05, 0.5, 0.99])
def test_partly_rough_surfaces_are_ricean(share, table_4_1):
    shots = at_snrs(table_4_1, [15.0, 60.0], fft_size=8192, phases="coherent", beam_divergence=5e-6)
    closed = mean_detection(shots, coherent_share=share)
    drawn = conditional_detection(shots, keys=keys(2), draws=50_000, coherent_share=share)
    for s, segment in enumerate(("up", "doppler", "down")):
        mean, error = mean_and_error(drawn[f"pd_{segment}"])
        assert (abs(mean - closed.pd[s]) <= 5 * error + 1e-9).all()


@pytest.mark.parametrize("phases", ["coherent", "incoherent"])
def test_random_phases_keep_the_mean_power_of_incoherent_footprints(phases, table_4_1):
    shots = prepared(table_4_1(**ONE_BIN | {"phases": phases, "fft_size": 8192}))
    g = speckle.amplitudes(
        keys=keys(1), first_draw=0, draws=100_000, beamlets=19, coherent_share=0.6,
        random_phases=shots.incoherent,
    )[0]  # fmt: skip
    found = response(shots, 0, 0, margin_bins=margin(shots.window))
    power = (abs(found.spectrum(g)) ** 2).mean(axis=0).max()
    steady = 0.6 * abs(found.real.sum(axis=0)) ** 2 if phases == "coherent" else None
    independent = found.covariance().diagonal().real
    exact = independent.max() if steady is None else (steady + 0.4 * independent).max()
    # No power of a sum of random amplitudes spreads more than an exponential's mean.
    assert abs(power / exact - 1) < 5 / np.sqrt(100_000)


def test_a_smooth_surface_is_what_the_shot_is_without(table_4_1):
    parameters = table_4_1(grazing_angle=0.3, range=np.array([2500.0, 4000.0]))
    shots = prepared(parameters)
    plain = evaluate(parameters)
    drawn = conditional_detection(shots, keys=keys(2), draws=2, coherent_share=1.0)
    for name in ("pd_up", "pd_doppler", "pd_down", "pd_shot"):
        np.testing.assert_allclose(drawn[name], plain[name][:, None] * [1, 1], rtol=1e-7)
    alarm = plain["pfa_segment"][:, None] * [1, 1]  # one bin more or less is 1.5e-5 of it
    np.testing.assert_allclose(drawn["pfa_up"], alarm, rtol=1e-7)


def test_the_coherent_share_is_that_of_a_sum_over_random_heights():
    rng = np.random.default_rng(3)
    wavelength, number = 1550e-9, 400_000
    for roughness in (0.02, 0.08, 0.15):
        heights = rng.normal(scale=roughness * wavelength, size=number)
        mean = np.exp(4j * np.pi * heights / wavelength).mean()
        share = speckle.coherent_share(roughness=roughness * wavelength, wavelength=wavelength)
        assert abs(abs(mean) - np.sqrt(share)) < 5 / np.sqrt(number)
    assert speckle.coherent_share(roughness=np.inf, wavelength=wavelength) == 0
    assert speckle.coherent_share(roughness=0.0, wavelength=wavelength) == 1


def test_segments_speckle_alike_as_far_as_their_frequencies_do():
    rng = np.random.default_rng(4)
    number, light, wavelength = 200, 299792458.0, 1550e-9
    for roughness in (0.01, 0.03):
        heights = rng.normal(scale=roughness, size=(4000, number))
        first = np.exp(4j * np.pi * heights / wavelength).sum(axis=1)
        second = np.exp(4j * np.pi * heights * (1 / wavelength + 1e9 / light)).sum(axis=1)
        correlation = abs((first.conj() * second).mean()) / number
        exact = speckle.segment_coherence(roughness=roughness, bandwidth=1e9)
        assert abs(correlation - exact) < 5 / np.sqrt(4000)
    assert speckle.segment_coherence(roughness=10e-6, bandwidth=1e9) > 1 - 1e-6


def test_draws_do_not_depend_on_neighbours_stretches_or_other_points(table_4_1):
    shots = prepared(table_4_1(grazing_angle=0.5, range=np.array([2000.0, 5000.0]), beamlets=7))
    alone = prepared(table_4_1(grazing_angle=0.5, range=np.array([5000.0]), beamlets=7))
    for method in (conditional_detection, sampled_detection):
        whole = method(shots, keys=keys(2), draws=5000)
        late = method(shots, keys=keys(2), first_draw=4000, draws=300)
        single = method(alone, keys=keys(2)[1:], first_draw=4000, draws=300)
        for name, values in whole.items():
            np.testing.assert_array_equal(values[:, 4000:4300], late[name])
            np.testing.assert_array_equal(late[name][1:], single[name])


def test_what_is_neglected_bounds_what_the_other_bins_would_add(table_4_1):
    """Every bin of every draw's spectrum; with fewer bins, more may be neglected."""
    shots = at_snrs(
        table_4_1, [60.0], fft_size=2048, beamlets=7, grazing_angle=0.2, beam_divergence=2e-2,
        window="rectangular",
    )  # fmt: skip
    g = speckle.amplitudes(keys=keys(1), first_draw=0, draws=2000, beamlets=7)[0]
    full = speckle_free_pd(shots, g, shots.threshold[0] / shots.bin_deviation[0])
    neglected = []
    for sidelobe in (0.9, 0.2, 0.01):
        drawn = conditional_detection(shots, keys=keys(1), draws=2000, sidelobe=sidelobe)
        missing = full - drawn["pd_up"][0]
        assert missing.min() > -1e-9
        assert (missing <= drawn["neglected"][0] + 1e-9).all()
        neglected.append(drawn["neglected"].mean())
        found = response(shots, 0, 0, margin_bins=margin(shots.window, sidelobe))
        outside = found.outside * (found.strength * abs(g)).sum(axis=1) / shots.bin_deviation
        least = marcum_q1(outside, shots.threshold / shots.bin_deviation).q - drawn["pd_up"][0]
        assert (drawn["neglected"][0] >= least - 1e-12).all()
    assert neglected[0] > neglected[1] > neglected[2]
    assert neglected[2] < 1e-4


def speckle_free_pd(shots, g, beta):
    """pd of the up segment by all bins of each draw's spectrum."""
    everywhere = response(shots, 0, 0, margin_bins=shots.fft_size / 2)
    peaks = abs(everywhere.spectrum(g)).max(axis=1)
    return marcum_q1(peaks / shots.bin_deviation[0], beta).q


def test_direct_detection_is_refused(table_4_1):
    shots = prepared(table_4_1(architecture="direct"))
    with pytest.raises(ValueError, match="direct detection"):
        conditional_detection(shots, keys=keys(1), draws=1)


def drawn_scene(number, table_4_1):
    rng = np.random.default_rng((21, number))
    return table_4_1(
        fft_size=4096,
        beamlets=int(rng.choice([1, 7, 19])),
        phases=str(rng.choice(["coherent", "incoherent"])),
        window=str(rng.choice(["rectangular", "hann", "hamming"])),
        range=rng.uniform(100, 5000),
        grazing_angle=rng.uniform(0.1, np.pi / 2),
        beam_divergence=10 ** rng.uniform(-6, -3),
        power=10 ** rng.uniform(-3, 0),
    )


def test_no_draw_leaves_the_bound_and_the_bound_is_not_idle(table_4_1):
    """A draw in a million may: of 40 scenes x 400 draws, 0.016 are expected to."""
    ratios = []
    for number in range(40):
        shots = prepared(drawn_scene(number, table_4_1))
        found = response(shots, 0, 0, margin_bins=margin(shots.window))
        roughness = 10 ** np.random.default_rng(number).uniform(-3, 0) * 1550e-9
        share = speckle.coherent_share(roughness=roughness, wavelength=1550e-9)
        power = found.covariance().diagonal().real.max()
        plain = abs(found.real.sum(axis=0)).max() if not shots.incoherent else np.sqrt(power)
        random = shots.incoherent and shots.offset.shape[1] > 1
        change = speckle.bound(
            coherent_share=0.0 if random else share,
            diffuse_over_found=power / plain**2,
            bins=found.bins.size,
        )
        g = speckle.amplitudes(
            keys=keys(1, number), first_draw=0, draws=400, beamlets=shots.offset.shape[1],
            coherent_share=share, random_phases=random,
        )[0]  # fmt: skip
        factor = abs(found.spectrum(g)).max(axis=1) / plain
        low, high = change.signal
        assert (low <= factor).all() and (factor <= high).all(), number
        reach = np.log(high) if low == 0 else 0.5 * np.log(high / low)
        ratios.append(reach / np.median(abs(np.log(factor))))
    assert 1 < np.median(ratios) < 15


def test_the_bound_holds_for_the_mean_detection(table_4_1):
    for roughness in (1e-9, 1e-8, 3e-8, 1e-6):
        share = speckle.coherent_share(roughness=roughness, wavelength=1550e-9)
        shots = at_snrs(table_4_1, [40.0, 80.0], beamlets=1, fft_size=4096)
        found = response(shots, 0, 0, margin_bins=margin(shots.window))
        change = speckle.bound(coherent_share=share, diffuse_over_found=1.0, bins=found.bins.size)
        plain = np.sqrt(2 * np.array([40.0, 80.0]))
        beta = shots.threshold / shots.bin_deviation
        most = pd_change(change, amplitude=plain, threshold=beta)
        moved = abs(mean_detection(shots, coherent_share=share).pd[0] - marcum_q1(plain, beta).q)
        assert (moved <= most + speckle.RARE).all()
        assert (moved > 0).all()
