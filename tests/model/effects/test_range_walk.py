"""Range walk: its phase, its lines against the time-domain truth, its bound against spectra."""

import numpy as np
import pytest
from effect_points import point_block, scene
from phase_error_checks import (
    WINDOWS,
    check_blocks,
    check_bound,
    lines_spectrum,
    peak_ratio,
)

from sweep.model import truth
from sweep.model.chain import prepare
from sweep.model.effects import range_walk
from sweep.model.effects.line_splitting import split_lines
from sweep.model.effects.phase_bounds import Error, Peak, over_record, phase_change
from sweep.model.effects.phase_bounds import shape as shape_of
from sweep.model.effects.span import Span
from sweep.model.waveform import SIGNS, beat_frequency
from sweep.model.window import window

AGREEMENT = 1e-8
"""Of a bin with the truth, relative to the line's peak without the effect."""


def prepared(parameters):
    ((_, shots),) = prepare(parameters)
    return shots


def motion(shots, segment):
    """What range walk needs to know of point 0."""
    rate = float(shots.sample_rate[0])
    return {
        "sign": SIGNS[segment],
        "chirp_rate": np.array([float(shots.chirp_rate)]),
        "radial_velocity": shots.radial_velocity[:1],
        "start": np.array([float(shots.acquisition_delay)]),
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
    kept, dropped = (
        truth.analytic_record(shots, 0, segment, 0, range_walk=walk) for walk in (True, False)
    )
    x = 2 * np.arange(kept.size) / kept.size - 1
    walk = range_walk.phase(x, **motion(shots, segment))[0]
    # The truth rounds f tau: 1e10 cycles of 1e-16 at 10 km/s.
    assert np.abs(kept / dropped - np.exp(2j * np.pi * walk)).max() < 2e-5 * abs(velocity) / 1e4


def split_spectrum(shots, segment, bins):
    """Spectrum of point 0's one beamlet, its line split for range walk."""
    sign = SIGNS[segment]
    beat = beat_frequency(
        sign,
        carrier=float(shots.carriers[segment]),
        chirp_rate=float(shots.chirp_rate),
        range=shots.range[0],
        radial_velocity=shots.radial_velocity[0],
    )
    record = truth.analytic_record(shots, 0, segment, 0, range_walk=False)
    split = split_lines(lambda x: range_walk.phase(x, **motion(shots, segment)))
    offset, weight = split.offset[0], split.weight[0]
    length = shots.window.length
    position = beat * length / shots.sample_rate[0] + offset
    # From the record's middle, which weights are referred to, back to its first sample.
    at_start = record[0] * weight * np.exp(-1j * np.pi * offset)
    spectrum = lines_spectrum(position, at_start, shots.window, bins * length / shots.fft_size)
    return spectrum, abs(record[0]) / 2 * shots.window.sum


@pytest.mark.parametrize("name", WINDOWS)
def test_split_lines_are_the_truth_for_two_milliseconds_at_up_to_ten_kilometres_a_second(
    name, table_4_1
):
    """At 1 mm: at 1550 nm the truth's own floor, f beta t to 3e7 cycles, is 2e-8 of the peak."""
    fastest = 1e4 if name == "hamming" else 2e3
    for segment, velocity in ((0, fastest), (2, 300.0)):
        shots = prepared(
            table_4_1(
                window=name, fft_size=2048, sample_rate=2048 / 2e-3, duration=2.1e-3, beamlets=1,
                radial_velocity=velocity, acquisition_delay=20e-6, range=1500.0,
                wavelength=1e-3,
            )
        )  # fmt: skip
        exact = truth.spectrum(shots, 0, segment)
        bins = np.unique([int(exact.argmax()), 3, 1024, *np.linspace(5, 1020, 12, dtype=int)])
        fast, peak = split_spectrum(shots, segment, bins)
        assert np.abs(fast - exact[bins]).max() < AGREEMENT * peak


def test_a_zero_padded_short_record_is_split_as_well(table_4_1):
    shots = prepared(
        table_4_1(
            fft_size=16384, sample_rate=20e6, beamlets=1, radial_velocity=3e3,
            acquisition_delay=100e-6, range=500.0,
        )
    )  # fmt: skip
    assert shots.window.length < shots.fft_size
    exact = truth.spectrum(shots, 0, 2)
    bins = exact.argmax() + np.arange(-3, 4)
    fast, peak = split_spectrum(shots, 2, bins)
    assert np.abs(fast - exact[bins]).max() < AGREEMENT * peak


def test_the_lines_of_the_beams_axis_serve_all_beamlets(table_4_1):
    """All beamlets share the phase error when they move alike: the kernel is what changes."""
    shots = prepared(
        table_4_1(
            fft_size=4096, sample_rate=20e6, radial_velocity=2e3, grazing_angle=np.radians(10.0),
            beam_divergence=1e-3, phases="incoherent",
        )
    )  # fmt: skip
    split = split_lines(lambda x: range_walk.phase(x, **motion(shots, 0)))
    x = 2 * np.arange(shots.window.length) / shots.window.length - 1
    factor = split.weight[0] @ np.exp(1j * np.pi * np.outer(split.offset[0], x))
    for beamlet in (0, 50, 108):
        kept, dropped = (
            truth.analytic_record(shots, 0, 0, beamlet, range_walk=walk) for walk in (True, False)
        )
        assert np.abs(kept - dropped * factor).max() < 5e-6 * np.abs(kept).max()


def test_drift_counts_bins_and_has_the_chirps_sign():
    motion = {"chirp_rate": 2e12, "radial_velocity": np.array([150.0]), "duration": 2**17 / 6e8}
    bins = 2 * 2e12 * 300 / 299792458 * (2**17 / 6e8) ** 2
    x = np.array([-1.0, -0.999, 0.999, 1.0])
    for sign in (1, -1):
        cycles = range_walk.phase(x, sign=sign, start=0.0, **motion)[0]
        slope = (np.diff(cycles)[[0, 2]] / 0.001) * 2  # bins at the record's ends
        np.testing.assert_allclose(np.diff(slope), sign * bins, rtol=1e-3)


def powers_of(chirp):
    """The error as powers of the place in the record, of the effect's own formula."""
    beta = 2 * chirp["radial_velocity"] / 299792458
    drift = chirp["chirp_rate"] * beta * (1 + beta / 2)
    start, duration = Span.of(chirp["start"]), Span.of(chirp["duration"])
    return over_record({2: Span.of(drift)}, start=start, duration=duration)


@pytest.mark.parametrize("name", WINDOWS)
def test_the_bound_holds_and_is_not_idle(name):
    rng = np.random.default_rng(11)
    n, length = 120, 512
    drift = 10 ** rng.uniform(-3, 2, n) * rng.choice([-1, 1], n)
    chirp = {
        "sign": 1,
        "chirp_rate": 1e12,
        "radial_velocity": drift / (2e12 * 1e-8) * 299792458 / 2,
        "start": np.where(rng.random(n) < 0.5, 0.0, rng.uniform(0, 1e-4, n)),
        "duration": 1e-4,
    }
    bins = 200 + rng.uniform(-0.5, 0.5, n)
    ratio = peak_ratio(lambda x: range_walk.phase(x, **chirp), name, length, bins)
    idle = check_bound(phase_change(powers_of(chirp), window=window(name, length)), ratio)
    assert np.median(idle) < 30


def test_the_bound_holds_for_lines_that_add_as_powers():
    """Lines over many bins, with the share of the largest bin in all their power."""
    rng = np.random.default_rng(12)
    length, lines = 512, 40
    shape, n = window("hamming", length), np.arange(length)
    w = np.hamming(length + 1)[:-1]
    for drift in 10 ** rng.uniform(-3, 1.5, 60):
        chirp = {
            "sign": -1,
            "chirp_rate": 1e12,
            "radial_velocity": np.array([drift / (2e12 * 1e-8) * 299792458 / 2]),
            "start": 0.0,
            "duration": 1e-4,
        }
        weight = rng.exponential(size=lines)
        tones = np.exp(2j * np.pi * np.outer(200 + rng.uniform(-3, 3, lines), n) / length)
        error = np.exp(2j * np.pi * range_walk.phase(2 * n / length - 1, **chirp)[0])
        found, without = (
            np.sqrt((weight @ np.abs(np.fft.fft(w * v, 8 * length)) ** 2)[::8].max())
            for v in (tones * error, tones)
        )
        everywhere = np.sqrt((weight @ np.abs(np.fft.fft(w * tones, 8 * length)) ** 2).max())
        total = np.sqrt(weight.sum()) * shape.sum
        # Anywhere between bins: the bin's own least is not known, its peak is at most that here.
        worst = shape_of(shape).scalloped * without / total
        peak = Peak(np.array([worst]), np.array([everywhere / total * 1.01]), single=False)
        low, high = phase_change(powers_of(chirp), window=shape, peak=peak).signal
        assert low[0] <= found / without <= high[0]


def test_others_turn_what_changes_and_lower_the_bin():
    """Two opposite errors: leaving one out undoes what the other makes up for."""
    rng = np.random.default_rng(13)
    shape, n, length = window("hann", 512), 200, 512
    x = 2 * np.arange(length) / length - 1
    own, other = (10 ** rng.uniform(-3, 0.5, (n, 4)) * rng.choice([-1, 1], (n, 4)) for _ in "ab")
    powers = x ** np.arange(1, 5)[:, None]
    tone = np.hanning(length + 1)[:-1] * np.exp(
        2j * np.pi * (200 + rng.uniform(-0.5, 0.5, n))[:, None] * np.arange(length) / length
    )
    first = tone * np.exp(2j * np.pi * (other @ powers))
    without, found = (
        np.abs(np.fft.fft(v, axis=1)).max(axis=1)
        for v in (first, first * np.exp(2j * np.pi * (own @ powers)))
    )
    errors = [Error(tuple(abs(v).T)) for v in (own, other)]
    low, high = phase_change(errors[0], window=shape, others=errors[1]).signal
    assert (low <= found / without).all() and (found / without <= high).all()
    assert (low > 0).any() and (high < 2).any()


@pytest.mark.parametrize("phases", ["incoherent", "coherent"])
@pytest.mark.parametrize("beamlets", [1, 7])
def test_blocks_bound_what_is_simulated(table_4_1, phases, beamlets):
    idle = check_blocks(
        "range_walk", table_4_1, lambda rng, n: {}, phases=phases, beamlets=beamlets
    )
    if phases == "incoherent" or beamlets == 1:
        assert np.median(idle) < 30


def test_blocks_bound_it_beside_other_errors(table_4_1):
    def further(rng, n):
        return {
            "target.acceleration": 10 ** rng.uniform(-2, 2, n),
            "instrument.chirp.cubic_error": 10 ** rng.uniform(3, 5, n),
        }

    check_blocks(
        "range_walk", table_4_1, further, others=("acceleration", "chirp_nonlinearity"), seeds=4
    )


def test_nothing_that_moves_walks(table_4_1):
    still = point_block(scene(table_4_1, 5, 1, radial_velocity=0.0))
    assert range_walk.bound(still) is None
