"""Overlap: echoes that arrive after their record has begun, against the gated time-domain truth."""

import numpy as np
import pytest
from random_planner_points import effects_kept_in_tile, plan_points, planner_inputs

from sweep.model import evaluation, time_domain_truth
from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.effects import overlap
from sweep.model.effects.catalogue import DEFAULT_EFFECTS, PARAMETER_DEFAULTS
from sweep.model.effects.phase_errors import slope_of_squared_time
from sweep.model.sampling import samplers
from sweep.model.sampling.philox import point_keys
from sweep.model.shot_settings import RECORD_TYPE_PATH
from sweep.model.spectrum import segment_spectra
from sweep.model.spectrum.line_shape import COSINE_SUM_COEFFICIENTS
from sweep.model.window import get_window, zero_first_samples

AGREEMENT = 1e-9
"""Largest difference of a bin from the truth, relative to a lone line's peak in a whole record."""
WINDOWS = (*COSINE_SUM_COEFFICIENTS, "kaiser(8.6)", "chebwin(100)", "tukey(0.3)", "bartlett")
WITH_OVERLAP = (*DEFAULT_EFFECTS, "overlap")


def shots_of(parameters, *further_effects):
    ((_, shots),) = evaluation.prepare_shots(
        PARAMETER_DEFAULTS | parameters, (*WITH_OVERLAP, *further_effects)
    )
    return shots


def difference(shots, i, segment, **keywords):
    """Largest difference from the truth of any bin, over the peak of all lines in a record."""
    bins, fast = segment_spectra.segment_spectrum(shots, i, segment)
    exact = time_domain_truth.time_domain_spectrum(shots, i, segment, **keywords)
    if shots.complex_record:
        exact = np.roll(exact, -(shots.fft_size // 2))[bins % shots.fft_size]
    scale = (
        shots.window.sum
        * float(np.broadcast_to(shots.echo_scales.beat_amplitude_scale, shots.size)[i])
        / 2
    )
    return np.abs(fast - exact).max() / (scale * np.sqrt(shots.total_relative_echo[i]))


def drawn_scene(table, number):
    """Scene of this number, whose echo arrives within its record, or not at all."""
    rng = np.random.default_rng((49, number))
    fft_size = int(rng.choice([1000, 2048, 4096, 2**14, 2**15, 2**16]))
    rate = float(rng.choice([250e6, 600e6]))
    duration = float(rng.choice([0.3, 0.7, 1.5])) * fft_size / rate
    late = rng.choice([0.02, 0.3, 0.6, 0.9, 0.999, 1.1]) * rng.uniform(0.9, 1.0)
    start = float(rng.choice([0.0, 0.2, 0.4])) * duration
    record = min(duration - start, fft_size / rate)
    return table(
        architecture=str(rng.choice(["homodyne", "heterodyne", "direct"])),
        window=str(WINDOWS[number % len(WINDOWS)]),
        phases=str(rng.choice(["coherent", "incoherent"])),
        beamlets=int(rng.choice([1, 7])),
        fft_size=fft_size, sample_rate=rate, duration=duration, acquisition_delay=start,
        range=SPEED_OF_LIGHT / 2 * (start + late * record),
        radial_velocity=float(rng.choice([0.0, 30.0, -300.0])),
        bandwidth=1e9 * duration / 500e-6,
    ) | ({RECORD_TYPE_PATH: "complex"} if number % 4 == 1 else {})  # fmt: skip


@pytest.mark.parametrize("number", range(44))
def test_lines_are_those_of_the_samples_that_the_echo_has(table_4_1, number):
    scene = drawn_scene(table_4_1, number)
    if scene.get(RECORD_TYPE_PATH) == "complex":
        scene["instrument.receiver.architecture"] = "homodyne"
    moving = () if number % 3 else ("range_walk", "segment_motion")
    shots = shots_of(scene, *moving)
    assert shots.echo_record.n_samples_before_echo is not None
    for segment in np.flatnonzero(shots.has_segment).tolist():
        error = difference(shots, 0, segment, with_range_walk=bool(moving))
        assert error < (1e-7 if moving else AGREEMENT), scene


@pytest.mark.parametrize("share", [0.0, 1e-4, 0.3, 0.8, 0.97])
@pytest.mark.parametrize("name", ["hann", "flattop", "rectangular"])
def test_lines_with_a_phase_error_are_those_of_the_samples_that_the_echo_has(
    table_4_1, name, share
):
    """A drift by several bins, an acceleration and a bent sweep, in records of 2^16."""
    record = 2**16 / 600e6
    scene = table_4_1(
        window=name, fft_size=2**16, duration=200e-6, beamlets=1, radial_velocity=3e3,
        acquisition_delay=20e-6, range=SPEED_OF_LIGHT / 2 * (20e-6 + share * record),
        wavelength=1e-3,
    ) | {"target.acceleration": 2e6}  # fmt: skip
    shots = shots_of(scene, "doppler", "range_walk", "acceleration", "segment_motion")
    for segment in range(3):
        assert difference(shots, 0, segment, with_acceleration=True) < 1e-7
    bent = scene | {
        "instrument.chirp.quadratic_error": 3e5, "instrument.chirp.sinusoidal_error": 1e5,
    }  # fmt: skip
    complete_shots = shots_of(bent, "chirp_nonlinearity")
    (error,) = complete_shots.echo_record.phase_errors
    first = (
        int(complete_shots.echo_record.n_samples_before_echo[0, 0])
        if complete_shots.echo_record.n_samples_before_echo is not None
        else 0
    )
    length = 2**16 - first
    values = error.select_arguments(0, np.array([0]))
    psi = error.phase_function(2 * np.arange(length) / length - 1, sign=1, **values)[0]
    steady_shots = shots_of(bent)
    record = time_domain_truth.beamlet_analytic_signal(steady_shots, 0, 0, 0, with_range_walk=False)
    record[first:] *= np.exp(2j * np.pi * psi)
    exact = np.abs(np.fft.rfft(get_window(name, 2**16).samples() * record.real))
    _, fast = segment_spectra.segment_spectrum(complete_shots, 0, 0)
    assert np.abs(fast - exact).max() < 1e-9 * 2**16 * np.abs(record).max()


# Examples


def triangle(table, **changes):
    """Short chirps sampled from their start on."""
    parameters = {
        "duration": 10e-6, "fft_size": 2**13, "window": "hann", "phases": "incoherent",
        "beamlets": 1, "radial_velocity": 0.0, "bandwidth": 2e8,
    }  # fmt: skip
    return table(**parameters | changes)


def test_an_echo_in_the_last_part_of_a_record_has_what_is_left_of_the_window(table_4_1):
    """750 m of a chirp of 10 us: Hann's last half has half its sum; at 1,125 m a 25th."""
    ranges = np.array([1.0, 750.0, 1125.0, 1400.0])
    outputs = evaluation.evaluate(triangle(table_4_1, range=ranges), WITH_OVERLAP)
    ignored = evaluation.evaluate(triangle(table_4_1, range=ranges), DEFAULT_EFFECTS)
    loss = 10 * np.log10(outputs["snr_up"] / ignored["snr_up"])
    n = np.arange(6000)
    w = 0.5 - 0.5 * np.cos(2 * np.pi * n / 6000)
    left = [w[n / 600e6 >= 2 * r / SPEED_OF_LIGHT].sum() / w.sum() for r in ranges]
    # Off a bin the shorter echo's wider line loses less by scalloping, up to Hann's 1.42 dB.
    assert loss == pytest.approx(20 * np.log10(left), abs=1.43)
    shots = shots_of(triangle(table_4_1, range=ranges))
    exact = time_domain_truth.evaluate_segments_in_time_domain(shots, with_range_walk=False)
    assert outputs["pd_up"] == pytest.approx(exact.pd[0], abs=1e-9)
    assert outputs["miss_up"] == pytest.approx(exact.miss[0], abs=1e-9)
    assert np.sqrt(2 * outputs["snr_up"]) * shots.bin_noise_sigma == pytest.approx(
        exact.magnitude[0]
    )
    assert loss[1] == pytest.approx(-6.0, abs=1.0) and loss[2] < -18


def test_nothing_is_detected_where_no_echo_arrives_in_time(table_4_1):
    """Neither in probabilities nor in draws, and nothing is nan that should not be."""
    ranges = np.array([300.0, 1490.0, 1501.0, 5000.0])
    scene = triangle(table_4_1, range=ranges, tnr=3.0)
    outputs = evaluation.evaluate(scene, WITH_OVERLAP)
    assert (outputs["pd_shot"][2:] == 0).all() and (outputs["miss_shot"][2:] == 1).all()
    assert (outputs["snr_up"][2:] == 0).all() and (outputs["p_leakage_up"][2:] == 0).all()
    assert np.isnan(outputs["range_error"][2:]).all() and np.isnan(outputs["misread"][2:]).all()
    assert np.isfinite(outputs["range_error"][:2]).all()
    unknown = {"range_error", "radial_velocity_error", "misread", "beamlets_error"}
    rest = [name for name in outputs if name not in unknown]
    assert all(np.isfinite(outputs[name]).all() for name in rest)
    for name in ("pfa_bin", "noise_variance"):
        assert outputs[name] == pytest.approx(np.full(4, outputs[name][0]), rel=1e-3)
    keys = point_keys(ranges[:, None], domain="test", seed=1)
    for method in ("probabilities", "noise"):
        results = samplers.simulate_draws(
            scene, WITH_OVERLAP, keys=keys, method=method, batch_sizes=[500]
        )
        assert (results["n_detected_shot"][2:] == 0).all() and (
            results["n_detected_up"][2:] == 0
        ).all()
        assert results["n_detected_shot"][0, 0] == 500


def test_noise_and_threshold_are_those_of_the_whole_record(table_4_1):
    scene = triangle(table_4_1, range=np.array([10.0, 700.0, 1490.0]))
    with_it, without = (evaluation.evaluate(scene, e) for e in (WITH_OVERLAP, DEFAULT_EFFECTS))
    for name in ("noise_variance", "pfa_bin", "log10_pfa_bin"):
        assert (with_it[name] == without[name]).all()


def test_points_whose_echo_fills_the_record_keep_their_bits(table_4_1):
    """Also where they are computed together with others, phase errors or not."""
    ranges = np.linspace(100.0, 900.0, 40)
    scene = table_4_1(range=ranges, acquisition_delay=3e-6, fft_size=2**14, beamlets=7)
    early = 2 * ranges / SPEED_OF_LIGHT < 3e-6
    assert 5 < early.sum() < 35
    for effects in (DEFAULT_EFFECTS, (*DEFAULT_EFFECTS, "range_walk", "segment_motion")):
        on, without_overlap = (
            evaluation.evaluate(scene, (*effects, "overlap")),
            evaluation.evaluate(scene, effects),
        )
        for name in on:
            assert np.array_equal(on[name][early], without_overlap[name][early], equal_nan=True), (
                name
            )
        assert (on["snr_up"][~early] != without_overlap["snr_up"][~early]).all()


def test_a_points_bits_do_not_depend_on_the_points_next_to_it(table_4_1):
    ranges = np.linspace(100.0, 4000.0, 60)
    scene = table_4_1(range=ranges, fft_size=2**14, beamlets=7, radial_velocity=20.0)
    effects = (*WITH_OVERLAP, "range_walk", "segment_motion")
    together = evaluation.evaluate(scene, effects)
    for i in (3, 30, 59):
        single = evaluation.evaluate(scene | {"target.range": ranges[i : i + 1]}, effects)
        for name in together:
            assert np.array_equal(single[name][0], together[name][i], equal_nan=True), name


# Planning


@pytest.mark.parametrize("tolerance", [1e-2, 1e-3, 1e-5])
def test_plans_of_random_instruments_keep_the_tolerance_of_the_truth(table_4_1, tolerance):
    n_kept = dropped = 0
    for seed in range(6):
        rng = np.random.default_rng((seed, 8))
        number = 8
        start = float(rng.choice([0.0, 1e-6]))
        scene = PARAMETER_DEFAULTS | table_4_1(
            window=str(rng.choice(["hann", "hamming", "rectangular", "flattop"])),
            fft_size=4096, duration=20e-6, acquisition_delay=start, phases="incoherent",
            beamlets=7, grazing_angle=1.4, reflectance_law="lambert",
            range=SPEED_OF_LIGHT / 2 * (start + 10 ** rng.uniform(-9, -5.2, number)),
            radial_velocity=rng.uniform(-50, 50, number), tnr=rng.uniform(3, 9, number),
            power=10 ** rng.uniform(-6, -1, number),
        ) | {"footprint.speckle": "none"}  # fmt: skip
        modes = {"range_walk": "off", "acceleration": "off"}
        plan = plan_points(planner_inputs(scene), modes, tolerance)
        row = plan.effect_names.index("overlap")
        n_kept, dropped = n_kept + plan.is_kept[row].sum(), dropped + (~plan.is_kept[row]).sum()
        for i in range(number):
            one = {path: v[i : i + 1] if np.ndim(v) else v for path, v in scene.items()}
            shots = shots_of(one, "segment_motion")
            exact = time_domain_truth.evaluate_segments_in_time_domain(shots, with_range_walk=False)
            spectra = evaluation.evaluate_segments(
                *(s for _, s in evaluation.prepare_shots(one, effects_kept_in_tile(plan, i)))
            )
            allowed = tolerance + plan.total_error[i]
            assert np.nansum(abs(spectra.pd - exact.pd)) <= allowed + 1e-9
            error = abs(spectra.magnitude - exact.magnitude) / np.maximum(
                exact.magnitude, shots.bin_noise_sigma
            )
            assert np.nanmax(error) <= allowed + 1e-9
    # A sample at the start of the chirp never has an echo: 2e-4 of a rectangular record of 4096.
    assert n_kept > 5 and (dropped > 5 or tolerance < 1e-4)


def test_what_beamlets_at_other_ranges_leave_is_bounded(table_4_1):
    """A beam of 5 mrad on ground at 6 deg, whose echo arrives within 3 us."""
    ranges = np.linspace(200.0, 900.0, 8)
    scene = PARAMETER_DEFAULTS | table_4_1(
        range=ranges, grazing_angle=0.1, beam_divergence=5e-3, fft_size=4096, duration=20e-6,
        phases="incoherent", beamlets=19, bandwidth=1e7, power=1e-3, tnr=5.0, window="hann",
        reflectance_law="lambert", radial_velocity=0.0,
    )  # fmt: skip
    shots = shots_of(scene)
    fast, exact = (
        evaluation.evaluate_segments(shots),
        time_domain_truth.evaluate_segments_in_time_domain(shots, with_range_walk=False),
    )
    plan = plan_points(planner_inputs(scene), {}, 0.0)
    left = overlap.residual_magnitude_bound(planner_inputs(scene))
    assert (left > 0).any() and (plan.total_error > 0).any()
    error = abs(fast.magnitude - exact.magnitude) / np.maximum(
        exact.magnitude, shots.bin_noise_sigma
    )
    assert (np.nanmax(error, axis=0) <= plan.total_error + 1e-9).all()
    assert (np.nansum(abs(fast.pd - exact.pd), axis=0) <= plan.total_error + 1e-9).all()


@pytest.mark.parametrize("number", range(24))
def test_one_number_of_samples_for_all_beamlets_is_within_its_bound(table_4_1, number):
    """Random footprints over relief of up to tens of samples, each beamlet gated by its own delay.

    With looks, the truth of the first one, whose range is that of its time.
    """
    rng = np.random.default_rng((50, number))
    rate, size = float(rng.choice([250e6, 600e6])), int(rng.choice([1024, 4096]))
    duration = float(rng.uniform(0.8, 2.0)) * size / rate
    scene = PARAMETER_DEFAULTS | table_4_1(
        window=str(rng.choice(["hann", "rectangular", "kaiser(8.6)", "flattop"])),
        range=SPEED_OF_LIGHT / 2 * duration * np.sort(rng.uniform(0.05, 0.9, 4)),
        grazing_angle=np.radians(rng.uniform(2, 30)), beam_divergence=10 ** rng.uniform(-3, -2),
        phases=str(rng.choice(["incoherent", "coherent"])), beamlets=19, fft_size=size,
        sample_rate=rate, duration=duration, reflectance_law="lambert",
        bandwidth=10 ** rng.uniform(7, 8), power=1.0, tnr=5.0, radial_velocity=0.0,
    )  # fmt: skip
    shots, bound = (
        shots_of(scene),
        np.atleast_2d(overlap.residual_magnitude_bound(planner_inputs(scene))),
    )
    for i in range(shots.size):
        for row, segment in enumerate(np.flatnonzero(shots.has_segment).tolist()):
            error = difference(shots, i, segment, with_range_walk=False)
            assert error <= np.broadcast_to(bound, (3, shots.size))[row, i] + AGREEMENT


def test_looks_that_begin_before_the_middle_one_are_within_its_bound(table_4_1):
    """16 looks towards a target at 3 km/s, whose first look has its own number of samples."""
    scene = PARAMETER_DEFAULTS | table_4_1(
        range=np.array([400.0]), fft_size=2048, sample_rate=250e6, duration=10e-6,
        window="rectangular", phases="incoherent", beamlets=1, bandwidth=1e7,
        radial_velocity=3000.0,
    ) | {"instrument.looks.number": 16}  # fmt: skip
    ((_, shots),) = evaluation.prepare_shots(scene, (*WITH_OVERLAP, "segment_motion"))
    bound = float(np.ravel(overlap.residual_magnitude_bound(planner_inputs(scene)))[0])
    first = shots.split_by_look()[0]
    assert 0 < bound < 0.05
    assert difference(first, 0, 0, with_range_walk=False) <= bound + AGREEMENT


def test_leakage_of_an_echo_that_begins_with_a_step_is_within_its_size(table_4_1):
    """Its sidelobes fall as 1/y where those of the window do as 1/y^3."""
    rng = np.random.default_rng(5)
    noticed = 0
    for name in ("hann", "hamming", "flattop", "blackman"):
        scene = PARAMETER_DEFAULTS | table_4_1(
            window=name, fft_size=2**13, phases="incoherent", beamlets=1, duration=20e-6,
            range=rng.uniform(30.0, 2000.0, 30), power=10 ** rng.uniform(-6, 1, 30),
            tnr=rng.uniform(3, 9, 30), radial_velocity=0.0,
        )  # fmt: skip
        plan = plan_points(planner_inputs(scene), {}, 0.0)
        leakage_bound = plan.omission_error[plan.effect_names.index("leakage")]
        spectra = evaluation.evaluate_segments(shots_of(scene))
        extra = np.nansum(spectra.leakage_probability, axis=0)
        assert (np.minimum(extra, 1) <= leakage_bound * (1 + 1e-9) + 1e-12).all()
        complete_record = evaluation.evaluate_segments(
            *(s for _, s in evaluation.prepare_shots(scene, DEFAULT_EFFECTS))
        )
        assert np.nansum(spectra.leakage_probability) > np.nansum(
            complete_record.leakage_probability
        )
        noticed += ((leakage_bound < 0.5) & (leakage_bound > 1e-9)).sum()
    assert noticed > 10


# Draws


def test_draws_of_noise_and_of_whole_spectra_detect_as_often_as_pd_says(table_4_1):
    ranges = np.array([400.0, 700.0, 850.0, 950.0])
    scene = triangle(table_4_1, range=ranges, power=2.0, fft_size=4096, tnr=5.0)
    scene |= {"footprint.speckle": "none"}
    pd = evaluation.evaluate(scene, WITH_OVERLAP)["pd_up"]
    assert pd[0] > 0.9 and pd[-1] < 0.5
    keys = point_keys(ranges[:, None], domain="test", seed=2)
    for method, number in (("noise", 4000), (samplers.SPECTRA_METHOD, 400)):
        results = samplers.simulate_draws(
            scene, WITH_OVERLAP, keys=keys, method=method, batch_sizes=[number]
        )
        share = results["n_detected_up"][:, 0] / number
        assert share == pytest.approx(pd, abs=4.5 * np.sqrt(0.25 / number) + 0.01), method


def test_a_lorentzian_line_of_a_late_echo_is_that_of_drawn_phases(table_4_1):
    """|X|^2 of records whose phase walks, in the last 0.4 of a Hann window."""
    width, far = 2e6, 900.0
    scene = triangle(table_4_1, range=far, fft_size=6000) | {
        "instrument.laser.line_width": width, "instrument.laser.line_shape": "lorentzian",
        "footprint.speckle": "none",
    }  # fmt: skip
    shots, steady_shots = shots_of(scene, "line_width"), shots_of(scene)
    first = int(shots.echo_record.n_samples_before_echo[0, 0])
    share = float(
        (shots.echo_scales.beat_amplitude_scale / steady_shots.echo_scales.beat_amplitude_scale)[0]
        ** 2
    )
    rng = np.random.default_rng(3)
    delay, rate = 2 * far / SPEED_OF_LIGHT, 600e6
    w, n = get_window("hann", 6000).samples(), np.arange(6000)
    lag, steps = round(delay * rate), 6000 + round(delay * rate)
    power = []
    for _ in range(3000):
        walk = np.cumsum(rng.normal(0, np.sqrt(2 * np.pi * width / rate), steps))
        phase = walk[lag:] - walk[: steps - lag]
        power.append(abs((w * np.exp(1j * phase) * (n >= first)).sum()) ** 2)
    line = (w * (n >= first)).sum() ** 2
    pedestal = float(np.ravel(shots.laser_line.pedestal_variance_under_line)[0])
    amplitude = (
        float(np.ravel(steady_shots.echo_scales.beat_amplitude_scale)[0]) ** 2
        * steady_shots.total_relative_echo[0]
        / 4
    )
    expected = share + pedestal * get_window("hann", 6000).energy / amplitude / line
    assert np.mean(power) / line == pytest.approx(expected, rel=0.15)
    assert share < 0.9


def test_the_window_with_samples_that_lack_has_their_sums():
    complete_window = get_window("hamming", 6400)
    part = zero_first_samples(complete_window, 3200)
    w = complete_window.samples()
    w[:3200] = 0
    assert np.array_equal(part.samples(), w) and part.length == complete_window.length
    assert part.sum == pytest.approx(w.sum()) and part.energy == pytest.approx((w**2).sum())
    assert (
        zero_first_samples(complete_window, 0) is complete_window
        and zero_first_samples(complete_window, 3200) is part
    )


# What is measured


def test_range_walk_is_put_right_for_the_part_of_the_record_that_the_echo_has(table_4_1):
    """The peak of a drifting line lies where the best straight line through its phase is."""
    velocity = 2e3
    for far in (1000.0, 6000.0, 12000.0):
        scene = table_4_1(
            range=far, radial_velocity=velocity, beamlets=1, fft_size=2**15, duration=110e-6,
            window="hann", sample_rate=300e6, wavelength=1e-3,
        )  # fmt: skip
        ((_, without_walk),) = evaluation.prepare_shots(scene, WITH_OVERLAP)
        ((_, walking),) = evaluation.prepare_shots(scene, (*WITH_OVERLAP, "range_walk"))
        padded = 2**19
        w = get_window("hann", without_walk.window.length).samples()
        place = []
        for walk in (False, True):
            record = time_domain_truth.beamlet_analytic_signal(
                without_walk, 0, 0, 0, with_range_walk=walk
            )
            place.append(np.argmax(abs(np.fft.fft(w * record, padded))) * 300e6 / padded)
        drift = (place[1] - place[0] + 150e6) % 300e6 - 150e6
        per_second = float(without_walk.waveform.chirp_rate) * 2 * velocity / SPEED_OF_LIGHT
        expected = np.ravel(slope_of_squared_time(walking))[0]
        assert drift / per_second == pytest.approx(expected, abs=3 * 300e6 / padded / per_second)


@pytest.mark.parametrize("record", ["real", "complex"])
def test_beats_that_fold_are_flagged_as_misread(table_4_1, record):
    """Beats of Table 4.1 lie within half the sample rate up to 22.5 km."""
    ranges = np.linspace(1e3, 60e3, 60)
    scene = table_4_1(range=ranges, radial_velocity=0.0, beamlets=1, duration=500e-6)
    scene |= {RECORD_TYPE_PATH: record, "footprint.speckle": "none"}
    outputs = evaluation.evaluate(scene, DEFAULT_EFFECTS)
    rate = 1e9 / 500e-6 * 2 / SPEED_OF_LIGHT  # Hz a metre
    wrong = ranges * rate > 300e6
    assert np.array_equal(outputs["misread"] == 1, wrong)
    assert (abs(outputs["range_error"][wrong]) > 1e3).all()
    assert (abs(outputs["range_error"][~wrong]) < 1.0).all()


def test_peaks_of_the_echo_that_are_misread_have_a_wrong_range(table_4_1):
    """Strongest peaks: what both chirps report is wrong where their beats fold."""
    ranges = np.array([5e3, 30e3])
    scene = table_4_1(range=ranges, radial_velocity=0.0, beamlets=1, duration=500e-6, power=100.0)
    scene |= {"footprint.speckle": "none", "instrument.processing.peaks": "strongest"}
    outputs = evaluation.evaluate(scene, DEFAULT_EFFECTS)
    assert outputs["misread"].tolist() == [0.0, 1.0]
    assert outputs["pd_shot"][1] > 0.5
    assert outputs["p_wrong_range_shot"][1] >= outputs["pd_shot"][1]
    assert outputs["p_wrong_range_shot"][0] < 1e-3


def test_a_slope_and_motion_are_no_misreading(table_4_1):
    ranges = np.geomspace(3.0, 9e3, 40)
    scene = PARAMETER_DEFAULTS | table_4_1(
        range=ranges, grazing_angle=np.radians(5.0), beam_divergence=1e-3, phases="incoherent",
        radial_velocity=120.0, fft_size=2**14,
    ) | {"target.acceleration": 100.0, "target.transverse_velocity": 100.0}  # fmt: skip
    outputs = evaluation.evaluate(
        scene, (*DEFAULT_EFFECTS, "range_walk", "acceleration", "segment_motion")
    )
    assert (outputs["misread"] == 0).all()


def test_a_carrier_of_zero_makes_no_velocity_a_misread_one(table_4_1):
    """Direct detection may chirp from 0 Hz, where a beat of any size tells no velocity."""
    scene = table_4_1() | {
        "instrument.receiver.architecture": "direct", "instrument.chirp.start_frequency": 0.0,
        "target.radial_velocity": 0.0,
    }  # fmt: skip
    with np.errstate(divide="raise"):
        outputs = evaluation.evaluate(scene, DEFAULT_EFFECTS)
    assert outputs["misread"] == 0
