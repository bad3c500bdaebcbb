"""Spectra of what shots carry only where an effect asks for it: images, leakage, phases, widths."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from shot_helpers import magnitude_error, parametrize_product, segment_lines
from test_leakage import EVERY_FORM
from test_leakage import drawn_bundles as bundles

from sweep.model import time_domain_truth
from sweep.model.effects.catalogue import DEFAULT_EFFECTS
from sweep.model.effects.line_width import DEVIATION_PER_FWHM
from sweep.model.evaluation import evaluate, evaluate_segments, prepare_shots
from sweep.model.pointcloud import returns
from sweep.model.pointcloud.bin_groups import list_bin_groups
from sweep.model.sampling import philox
from sweep.model.sampling.samplers import simulate_draws
from sweep.model.spectrum import segment_spectra
from sweep.model.spectrum.segment_spectra import POINTS_PER_BATCH
from sweep.model.waveform import DEFAULT_CHIRP_RATE_RATIOS
from sweep.model.window import direct_transform, window_samples

AGREEMENT = 1e-9
"""Largest difference of |X| from the truth, relative to the peak of lines without the effect."""

WINDOWS = ("hamming", "rectangular", "flattop", "kaiser(8.6)")
PHASES = ("coherent", "incoherent")
DRIFTING = "range_walk", "acceleration", "chirp_nonlinearity"
DRIFTS = {
    "target.acceleration": 300.0,
    "instrument.chirp.quadratic_error": 1e5,
    "instrument.chirp.sinusoidal_error": 3e4,
    "instrument.chirp.error_periods": 3.0,
    "instrument.laser.line_width": 2e4,
}


def prepared(parameters, *further_effects, without=()):
    effects = [name for name in (*DEFAULT_EFFECTS, *further_effects) if name not in without]
    ((_, shots),) = prepare_shots(parameters | (DRIFTS if further_effects else {}), effects)
    return shots


def scene(table_4_1, **changes):
    """Small and quick; 7 beamlets a few bins wide."""
    small = {
        "fft_size": 4096, "sample_rate": 60e6, "beamlets": 7, "range": 1000.0,
        "grazing_angle": 0.5, "radial_velocity": 150.0,
    }  # fmt: skip
    return table_4_1(**small | changes)


# Images


def plain_sum(shots, i, segment, bins):
    """|X| of some bins with the folded lines' own kernels only: plain sums over the window."""
    origin, delta, weight = segment_lines(shots, i, segment)
    way = -1 if origin < 0 else 1
    total = np.zeros(len(bins), complex)
    for place, c in zip(delta, weight, strict=True):
        y = (way * bins - origin - place) * shots.window.length / shots.fft_size
        # C_b counts its phase from the middle of the record, the transform from its beginning
        line = direct_transform(shots.window, y) * c * np.exp(1j * np.pi * y)
        total += abs(line) ** 2 if shots.footprint.adds_powers else line
    return np.sqrt(total.real) if shots.footprint.adds_powers else abs(total)


@pytest.mark.parametrize(
    ("fft_size", "window", "phases"), parametrize_product(5, [512, 801], WINDOWS, PHASES)
)
def test_without_images_only_the_folded_lines_themselves_are_summed(
    window, phases, fft_size, table_4_1
):
    for distance, velocity in ((1000.0, 150.0), (1500.0, 0.0), (0.3, 0.02), (1499.0, 100.0)):
        shots = prepared(
            scene(table_4_1, window=window, phases=phases, fft_size=fft_size, sample_rate=40e6,
                  range=distance, radial_velocity=velocity, duration=15e-6),
            without=("image",),
        )  # fmt: skip
        for segment in range(3):
            bins, fast = segment_spectra.segment_spectrum(shots, 0, segment)
            slow = plain_sum(shots, 0, segment, bins)
            assert magnitude_error(shots, fast, slow) < (
                AGREEMENT if shots.footprint.adds_powers else 1e-11
            )
        if distance < 1:  # beats next to DC: images are there, and were left out
            summed = evaluate_segments(
                replace(shots, line_images=shots.line_images._replace(are_summed=True))
            )
            assert abs(summed.magnitude[1] / evaluate_segments(shots).magnitude[1] - 1) > 1e-3


# Leakage


def same_detections(shots):
    """Largest relative change of a magnitude, and change of a pd, by leaving leakage out."""
    with_all_bins = evaluate_segments(shots)
    worst = np.zeros(2)
    for every_bin in (False, True):
        spectra = evaluate_segments(
            replace(
                shots,
                detection_settings=shots.detection_settings._replace(
                    leakage_raises_false_alarms=False
                ),
            ),
            bin_by_bin=every_bin,
        )
        assert not np.nan_to_num(spectra.leakage_probability).any()
        np.testing.assert_array_equal(spectra.frequency, with_all_bins.frequency)
        np.testing.assert_array_equal(spectra.n_exempt, with_all_bins.n_exempt)
        with np.errstate(invalid="ignore"):
            change = abs(spectra.magnitude - with_all_bins.magnitude) / with_all_bins.magnitude
        moved = [abs(spectra.pd - with_all_bins.pd), abs(spectra.miss - with_all_bins.miss)]
        worst = np.maximum(worst, [np.nanmax(change, initial=0.0), np.nanmax(moved)])
    return worst


@pytest.mark.parametrize("image", [True, False])
@pytest.mark.parametrize("fft_size", [64, 255, 512, 1023, 4099, 8192])
def test_without_leakage_detections_stay_what_they_are(table_4_1, fft_size, image):
    """Bundles wide and narrow, weak and strong, on DC and Nyquist and beyond."""
    for seed, spread in enumerate((0.0, 0.5, 5.0, 50.0, 300.0)):
        shots = bundles(table_4_1, 10 * fft_size + seed, fft_size, spread)
        magnitude, pd = same_detections(
            replace(shots, line_images=shots.line_images._replace(are_summed=image))
        )
        assert magnitude < 1e-11 and pd < 1e-12


@pytest.mark.parametrize(
    ("sizes", "window", "phases"),
    parametrize_product(3, [(2**13, 600e6), (5000, 6e6)],
          [*EVERY_FORM, "kaiser(8.6)", "dpss(3)", "bartlett"], PHASES),
)  # fmt: skip
def test_without_leakage_every_window_detects_the_same(window, phases, sizes, table_4_1):
    """The second record is padded. Down to 1e-8 of the noise, and phases that cancel."""
    rng, (fft_size, sample_rate) = np.random.default_rng(5), sizes
    parameters = table_4_1(
        window=window, phases=phases, fft_size=fft_size, sample_rate=sample_rate, beamlets=19,
        tnr=4.0, leakage_floor=1e-12,
    ) | {
        "target.range": np.r_[0.3, 22484.4, 10 ** rng.uniform(0, 4, 58)],
        "target.grazing_angle": np.radians(rng.uniform(1, 90, 60)),
        "target.radial_velocity": rng.choice([0.0, 0.005, 232.5, -90.0, 150.0], 60),
        "instrument.laser.power": 10 ** rng.uniform(-16, 1, 60),
    }  # fmt: skip
    magnitude, pd = same_detections(prepared(parameters))
    assert magnitude < 1e-11 and pd < 1e-12


def test_without_leakage_only_noise_raises_false_peaks(table_4_1):
    """Where leaked signal all but surely crosses, draws without it have the alarms of noise."""
    parameters = scene(table_4_1, range=20.0, tnr=7.0, fft_size=8192, power=30.0)
    keys = philox.point_keys(np.zeros((1, 1)), domain="tests", seed=1)
    shares = {}
    for name, effects in (
        ("with", DEFAULT_EFFECTS),
        ("without", set(DEFAULT_EFFECTS) - {"leakage"}),
    ):
        outputs = evaluate(parameters, effects)
        counts = simulate_draws(parameters, effects, keys=keys, batch_sizes=[4000], method="noise")
        shares[name] = counts["n_false_alarm_up"][0, 0] / 4000, outputs["pfa_segment"][0]
    assert shares["with"][0] > 0.5
    without_leakage, expected = shares["without"]
    assert abs(without_leakage - expected) < 5 * np.sqrt(expected * (1 - expected) / 4000)


# Phase errors and widths


def exact(shots, i, segment, shifts):
    """|X| from time-domain records with their exact phases, averaged over shifts (bins, weights).

    Records of beamlets add, or the powers of their spectra, lines' and images' apart: what is
    left of random phases in the mean.
    """
    window, length = window_samples(shots.window.name, shots.window.length), shots.window.length
    x, half = 2 * np.arange(length) / length - 1, shots.fft_size // 2 + 1
    cycles = np.zeros(length)
    for error in shots.echo_record.phase_errors:
        values = error.select_arguments(segment, np.array([i]))
        cycles = (
            cycles + error.phase_function(x, sign=DEFAULT_CHIRP_RATE_RATIOS[segment], **values)[0]
        )
    records = [
        time_domain_truth.beamlet_analytic_signal(shots, i, segment, b, with_range_walk=False)
        for b in range(shots.footprint.n_beamlets)
    ]
    total = np.zeros(half)
    for shift, weight in zip(*shifts, strict=True):
        turn = window * np.exp(2j * np.pi * (cycles + shift * x / 2))
        for record in records if shots.footprint.adds_powers else [sum(records)]:
            spectrum = np.fft.fft(turn * record, shots.fft_size) / 2
            line, image = (
                spectrum[:half],
                spectrum[-np.arange(half)].conj() * shots.line_images.are_summed,
            )
            power = (
                abs(line) ** 2 + abs(image) ** 2
                if shots.footprint.adds_powers
                else abs(line + image) ** 2
            )
            total += weight * power
    return np.sqrt(total)


def width_by_hermite(shots, i):
    """Shifts [bins of fs/L] of a Gaussian line, by a rule of its own: Gauss and Hermite's."""
    if shots.laser_line.gaussian_fwhm is None:
        return np.zeros(1), np.ones(1)
    place, weight = np.polynomial.hermite_e.hermegauss(61)
    bins = shots.laser_line.gaussian_fwhm[i] * np.broadcast_to(shots.record.duration, shots.size)[i]
    return DEVIATION_PER_FWHM * bins * place, weight / weight.sum()


CASES = {
    "one sign": {},
    "folded": {"range": 9000.0, "radial_velocity": -400.0, "duration": 700e-6},
    "at DC": {"range": 3.0, "radial_velocity": 0.0},
    "padded": {"fft_size": 8000, "duration": 75e-6, "range": 500.0, "radial_velocity": 2.0},
    "wide": {"beam_divergence": 5e-3, "beamlets": 19, "grazing_angle": 0.2, "range": 4000.0},
}


SMEARING = DRIFTING[:1], DRIFTING, ("line_width",), (*DRIFTING[:1], "line_width")


def smeared():
    """All of effects, cases, windows and phases; the fast suite has every two of them together."""
    every = product(enumerate(SMEARING), enumerate(CASES), enumerate(WINDOWS), PHASES)
    for (i, effects), (j, case), (k, window), phases in every:
        other = (i + j + k) % len(WINDOWS) or phases != PHASES[(i + j) % 2]
        marks = [pytest.mark.slow] if other else []
        yield pytest.param(effects, case, window, phases, marks=marks)


@pytest.mark.parametrize("effects, case, window, phases", list(smeared()))
def test_phase_errors_and_widths_are_those_of_the_record(effects, case, window, phases, table_4_1):
    parameters = scene(table_4_1, window=window, phases=phases, **CASES[case])
    shots, unperturbed = prepared(parameters, *effects), prepared(parameters)
    for segment in range(3):
        bins, fast = segment_spectra.segment_spectrum(shots, 0, segment)
        slow = exact(shots, 0, segment, width_by_hermite(shots, 0))
        peak = segment_spectra.segment_spectrum(unperturbed, 0, segment)[1].max()
        assert np.array_equal(bins, np.arange(shots.fft_size // 2 + 1))
        assert magnitude_error(shots, fast, slow, peak) < AGREEMENT


@pytest.mark.parametrize(
    ("effects", "leakage", "phases"),
    parametrize_product(
        5, [DRIFTING, ("line_width",), (*DRIFTING, "line_width")], [True, False], PHASES
    ),
)
def test_what_is_found_is_found_in_the_whole_spectrum(effects, leakage, phases, table_4_1):
    """Peak, exempt bins and groups of 40 points against all bins of their spectra."""
    rng = np.random.default_rng(6)
    parameters = scene(table_4_1, phases=phases, tnr=4.0) | {
        "target.range": 10 ** rng.uniform(0.5, 3.5, 40),
        "instrument.laser.power": 10 ** rng.uniform(-6, 0, 40),
        "accuracy.leakage_floor": 1e-12,
    }
    shots = prepared(parameters, *effects, without=() if leakage else ("leakage",))
    spectra, listed = evaluate_segments(shots), list_bin_groups(shots)
    slow = evaluate_segments(shots, bin_by_bin=True)
    np.testing.assert_allclose(
        spectra.leakage_probability, slow.leakage_probability, rtol=1e-6, atol=1e-20
    )
    above = 0
    for i in range(40):
        for segment in range(3):
            bins, magnitude = segment_spectra.segment_spectrum(shots, i, segment)
            level = shots.threshold[i]
            best = magnitude.argmax()
            assert spectra.magnitude[segment, i] == pytest.approx(magnitude[best], rel=1e-9)
            assert spectra.frequency[segment, i] == best * shots.sample_rate[i] / 4096
            assert listed.strongest_bin[i, segment, 0] == best
            neighbours = magnitude[np.clip([best - 1, best, best + 1], 0, bins[-1])]
            inside = 0 < best < bins[-1]
            if inside:
                np.testing.assert_allclose(
                    listed.peak_and_neighbour_magnitudes[i, segment, 0], neighbours, rtol=1e-7
                )
            crossing = magnitude >= level
            crossing[best] = True
            wide = np.convolve(crossing, np.ones(3), "same") > 0
            assert spectra.n_exempt[segment, i] == wide.sum()
            above += crossing.sum() > 1
    assert above > 20


@pytest.mark.parametrize("effects", [DRIFTING[:1], ("line_width",)])
def test_draws_and_returns_see_what_the_spectrum_shows(effects, table_4_1):
    """Detections in noise have the pd of the smeared line, not that of a pure one; 5 sigma."""
    number = 20_000
    effects = [*(name for name in DEFAULT_EFFECTS if name != "leakage"), *effects]
    parameters = scene(
        table_4_1, radial_velocity=-3e3, tnr=4.0, power=12.0, duration=70e-6,
        phases="incoherent", grazing_angle=np.pi / 2,
    ) | {"instrument.laser.line_width": 3e4, "target.range": np.array([300.0, 400.0])}  # fmt: skip
    outputs = evaluate(parameters, effects)
    keys = philox.point_keys(np.arange(2.0)[:, None], domain="tests", seed=2)
    counts = simulate_draws(parameters, effects, keys=keys, batch_sizes=[number], method="noise")
    pd = outputs["pd_up"]
    sigma = np.sqrt(pd * (1 - pd) / number)
    assert (abs(counts["n_detected_up"][:, 0] / number - pd) < 5 * sigma).all()
    assert (abs(evaluate(parameters)["pd_up"] - pd) > 10 * sigma).any()
    ((_, shots),) = prepare_shots(parameters, effects)
    for method in ("probabilities", "noise"):
        drawn = returns.draw_returns(
            shots, list_bin_groups(shots), keys=keys, draws=4000, method=method
        ).group[..., 0]  # fmt: skip
        missed_share = (drawn == 0).any(axis=-1).mean(axis=1)
        # An up peak makes a return where there is a down peak, or a false one, to go with it.
        assert (missed_share < pd + 5 * sigma * np.sqrt(number / 4000)).all() and (
            missed_share > 0
        ).all()


# What is not there, and company


@pytest.mark.parametrize(
    ("left_out", "phases"), parametrize_product(3, [("image", "leakage"), ()], PHASES)
)
def test_the_company_of_points_changes_no_bit(phases, left_out, table_4_1):
    """Of points in several stretches; of their order; of one alone. All kinds of drift at once."""
    number = 2 * POINTS_PER_BATCH + 40
    rng = np.random.default_rng(7)
    parameters = scene(table_4_1, phases=phases, fft_size=512) | {
        "target.range": 10 ** rng.uniform(0, 4, number),
        "target.radial_velocity": rng.choice([0.0, 30.0, -400.0, 3e3], number),
        "target.acceleration": rng.choice([0.0, 300.0, 3e4], number),
        "instrument.chirp.quadratic_error": rng.choice([0.0, 1e5], number),
        "instrument.chirp.sinusoidal_error": rng.choice([0.0, 1e5], number),
        "instrument.laser.line_width": rng.choice([0.0, 1e3, 3e5], number),
    }
    chosen = [n for n in (*DEFAULT_EFFECTS, *DRIFTING, "line_width") if n not in left_out]

    def spectra_of(index):
        part = {k: v[index] if np.ndim(v) else v for k, v in parameters.items()}
        ((_, shots),) = prepare_shots(part, chosen)
        return evaluate_segments(shots)

    all_points = spectra_of(np.arange(number))
    point_index = rng.permutation(number)[: number // 2]
    for index in (point_index, point_index[:1], np.array([number - 1])):
        expected = np.ascontiguousarray(np.array(all_points)[..., index])
        assert expected.tobytes() == np.array(spectra_of(index)).tobytes()
