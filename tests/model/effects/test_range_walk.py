"""Range walk: its phase, its lines against the time-domain truth."""

import numpy as np
import pytest
from random_planner_points import planner_inputs

from sweep.model import evaluation, time_domain_truth
from sweep.model.effects import phase_errors
from sweep.model.effects.catalogue import DEFAULT_EFFECTS
from sweep.model.evaluation import prepare_shots
from sweep.model.spectrum.segment_spectra import segment_spectrum
from sweep.model.waveform import DEFAULT_CHIRP_RATE_RATIOS

WINDOWS = (
    "rectangular", "hann", "hamming", "blackman", "nuttall", "blackmanharris", "flattop",
    "kaiser(8.6)", "chebwin(100)", "tukey(0.3)", "bartlett",
)  # fmt: skip

AGREEMENT = 1e-8
"""Of a bin with the truth, relative to the line's peak without the effect."""


def prepared(parameters, *, walks=False):
    ((_, shots),) = prepare_shots(
        parameters, (*DEFAULT_EFFECTS, "range_walk") if walks else DEFAULT_EFFECTS
    )
    return shots


def motion(shots, segment):
    """What range walk needs to know of point 0."""
    rate = float(shots.sample_rate[0])
    return {
        "sign": DEFAULT_CHIRP_RATE_RATIOS[segment],
        "chirp_rate": np.array([float(shots.waveform.chirp_rate)]),
        "radial_velocity": shots.target.radial_velocity[:1],
        "start": np.array([float(shots.record.acquisition_delay)]),
        "duration": np.array([shots.window.length / rate]),
    }


@pytest.mark.parametrize("segment", [0, 1, 2])
@pytest.mark.parametrize("velocity", [-300.0, 20.0, 1e4])
@pytest.mark.parametrize("delay", [0.0, 70e-6])
def test_the_phase_is_what_the_truth_keeps_beyond_the_line(table_4_1, segment, velocity, delay):
    shots = prepared(
        table_4_1(
            fft_size=4096, sample_rate=20e6, beamlets=1, radial_velocity=velocity,
            acquisition_delay=delay,
        )
    )  # fmt: skip
    with_walk, dropped = (
        time_domain_truth.beamlet_analytic_signal(shots, 0, segment, 0, with_range_walk=walk)
        for walk in (True, False)
    )
    x = 2 * np.arange(with_walk.size) / with_walk.size - 1
    walk = phase_errors.range_walk_phase(x, **motion(shots, segment))[0]
    # The truth rounds f tau: 1e10 cycles of 1e-16 at 10 km/s.
    assert (
        np.abs(with_walk / dropped - np.exp(2j * np.pi * walk)).max() < 2e-5 * abs(velocity) / 1e4
    )


@pytest.mark.parametrize("name", WINDOWS)
def test_lines_are_the_truth_for_two_milliseconds_at_up_to_ten_kilometres_a_second(name, table_4_1):
    """At 1 mm: at 1550 nm the truth's own floor, f beta t to 3e7 cycles, is 2e-8 of the peak."""
    fastest = 1e4 if name == "hamming" else 2e3
    for segment, velocity in ((0, fastest), (2, 300.0)):
        shots = prepared(
            table_4_1(
                window=name, fft_size=2048, sample_rate=2048 / 2e-3, duration=2.1e-3, beamlets=1,
                radial_velocity=velocity, acquisition_delay=20e-6, range=1500.0,
                wavelength=1e-3,
            ), walks=True,
        )  # fmt: skip
        exact = time_domain_truth.time_domain_spectrum(shots, 0, segment)
        _, fast = segment_spectrum(shots, 0, segment)
        peak = time_domain_truth.time_domain_spectrum(
            shots, 0, segment, with_range_walk=False
        ).max()
        assert np.abs(fast - exact).max() < AGREEMENT * peak


def test_the_phase_of_the_beams_axis_serves_all_beamlets(table_4_1):
    """All beamlets share the phase error when they move alike: the kernel is what changes."""
    shots = prepared(
        table_4_1(
            fft_size=4096, sample_rate=20e6, radial_velocity=2e3, grazing_angle=np.radians(10.0),
            beam_divergence=1e-3, phases="incoherent",
        )
    )  # fmt: skip
    x = 2 * np.arange(shots.window.length) / shots.window.length - 1
    factor = np.exp(2j * np.pi * phase_errors.range_walk_phase(x, **motion(shots, 0))[0])
    for beamlet in (0, 50, 108):
        with_walk, dropped = (
            time_domain_truth.beamlet_analytic_signal(shots, 0, 0, beamlet, with_range_walk=walk)
            for walk in (True, False)
        )
        assert np.abs(with_walk - dropped * factor).max() < 5e-6 * np.abs(with_walk).max()


@pytest.mark.parametrize("acceleration", [50.0, -400.0])
def test_a_target_that_starts_from_rest_walks_in_the_down_segment(table_4_1, acceleration):
    """By a velocity of a t there; the size is no less than what leaving it out changes."""
    parameters = table_4_1(fft_size=2**14, sample_rate=100e6, beamlets=1, radial_velocity=0.0)
    parameters |= {"target.acceleration": acceleration, "target.range": 50.0}
    effects = *DEFAULT_EFFECTS, "segment_motion", "acceleration"
    magnitudes = [
        evaluation.evaluate_segments(
            *(shots for _, shots in prepare_shots(parameters, chosen_effects))
        ).magnitude[:, 0]
        for chosen_effects in (effects, (*effects, "range_walk"))
    ]
    relative_change = np.abs(magnitudes[0] / magnitudes[1] - 1)
    points = planner_inputs(parameters)
    points.phase_error_bounds["range_walk"] = phase_errors.range_walk_phase_bound(points)
    size = phase_errors.RANGE_WALK.error_bound(points)
    bound = np.broadcast_to(np.ravel(size.magnitude_change + size.coherent_sum_change), 3)
    assert relative_change[0] < 1e-9 and relative_change[2] > 1e-7
    assert (relative_change <= bound + 1e-9).all()
