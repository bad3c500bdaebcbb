"""Beats of the three segments, their folding, and what three peaks say of range and velocity."""

import mpmath
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.constants import c as speed_of_light

from sweep.model import waveform
from sweep.model.waveform import (
    FOLD_PENALTY_BINS,
    beat_frequency,
    fold_frequency,
    n_record_samples,
    resolve_range_velocity,
)

CARRIER, BANDWIDTH, DURATION = speed_of_light / 1550e-9, 1e9, 500e-6
RATE = BANDWIDTH / DURATION
BIN = 600e6 / 2**17
RANGE_BIN, VELOCITY_BIN = 0.343, 3.55e-3  # of Table 4.1, PHYSICS section 2


def beats(target_range, velocity):
    """Signed beats of up, Doppler and down segment for Table 4.1."""
    return [
        beat_frequency(
            sign, carrier=CARRIER + BANDWIDTH * (sign < 0), chirp_rate=RATE, range=target_range,
            radial_velocity=velocity,
        )
        for sign in (1, 0, -1)
    ]  # fmt: skip


def resolved(up, doppler, down, sample_rate=600e6):
    """Range and velocity from three peaks, as floats."""
    report = resolve_range_velocity(
        up=np.array([up]), doppler=np.array([doppler]), down=np.array([down]), carrier=CARRIER,
        bandwidth=BANDWIDTH, duration=DURATION, sample_rate=sample_rate, bin_width=BIN,
    )  # fmt: skip
    return report.range[0], report.radial_velocity[0]


@pytest.mark.parametrize("sign", [1, 0, -1])
@pytest.mark.parametrize("target_range", [1.0, 2000.0, 1e4])
@pytest.mark.parametrize("v", [150.0, 0.3, 0.0, -150.0])
def test_the_beat_is_the_derivative_of_the_phase_that_the_delay_makes(sign, target_range, v):
    f = CARRIER + BANDWIDTH * (sign < 0)
    with mpmath.workdps(50):
        tau_0, beta = 2 * mpmath.mpf(target_range) / speed_of_light, 2 * mpmath.mpf(v) / 299792458

        def cycles(t):
            tau = tau_0 - beta * t
            return -f * tau + sign * RATE * (tau**2 / 2 - t * tau)

        expected = float(mpmath.diff(cycles, 0))
    assert beats(target_range, v)[1 - sign] == pytest.approx(expected, rel=1e-13, abs=1e-7)


@pytest.mark.parametrize("fft_size", [512, 511])
def test_a_folded_frequency_is_where_the_samples_of_a_tone_have_their_peak(fft_size):
    for k in range(-3 * fft_size, 3 * fft_size, 7):
        tone = np.cos(2 * np.pi * k * np.arange(fft_size) / fft_size + 0.3)
        peak = np.abs(np.fft.rfft(tone)).argmax()
        assert fold_frequency(k * 600e6 / fft_size, 600e6) == pytest.approx(
            peak * 600e6 / fft_size, abs=1.0
        )


@pytest.mark.parametrize(
    "architecture, start",
    [("homodyne", 193.414489032e12), ("heterodyne", 193.414489032e12), ("direct", 5.5e9)],
)
def test_the_delay_turns_the_optical_frequency_into_phase_or_the_radio_frequency(
    architecture, start
):
    carriers = waveform.carrier_frequencies(
        architecture, wavelength=1550e-9, start_frequency=5.5e9, bandwidth=1e9
    )
    assert carriers[0] == carriers[1] == pytest.approx(start, rel=1e-11)
    assert carriers[2] - carriers[0] == pytest.approx(1e9, rel=1e-4)


def test_the_record_ends_with_the_chirp():
    def length(fft_size, delay, rate=600e6, duration=500e-6):
        parameters = {"fft_size": fft_size, "acquisition_delay": delay, "sample_rate": rate}
        parameters = {f"instrument.processing.{name}": value for name, value in parameters.items()}
        return n_record_samples(parameters | {"instrument.chirp.duration": duration})

    assert length(2**17, 0.0) == 2**17
    assert length(2**18, 0.0) == 2**18
    assert length(2**19, 0.0) == 300_000
    assert length(2**18, 100e-6) == 240_000
    assert length(2**17, 499e-6) == 600
    # Whole numbers of samples stay whole however their factors round.
    for microseconds in range(1, 500):
        assert length(2**19, microseconds * 1e-6) == 600 * (500 - microseconds)


# Resolution


def other_readings(peaks, truth, sample_rate):
    """Signed (f_d, f_r) that explain three peaks otherwise than the truth does, with mismatch.

    Every sign and fold of the up and the down peak is a candidate; the Doppler peak must agree.
    Yields (mismatch in bins, folds).
    """
    u, p, d = peaks
    for up_folds, ups in enumerate(((u, -u), (sample_rate - u, u - sample_rate))):
        for down_folds, downs in enumerate(((d, -d), (sample_rate - d, d - sample_rate))):
            for up in ups:
                for down in downs:
                    f_d, f_r = (up + down) / 2, (down - up) / 2
                    if f_r < 0 or max(abs(f_d - truth[0]), abs(f_r - truth[1])) < 3 * BIN:
                        continue
                    for p_folds, peak in enumerate((p, sample_rate - p)):
                        mismatch = abs(abs(f_d) - peak) / BIN
                        yield mismatch, up_folds + down_folds + p_folds


def scene_beats(target_range, velocity, sample_rate):
    """Signed beats and peaks of a scene whose three peaks tell it from every other scene."""
    signed = beats(target_range, velocity)
    assume(max(abs(b) for b in signed) < sample_rate - 100 * BIN)  # one fold, not two
    folds = sum(abs(b) > sample_rate / 2 for b in signed)
    peaks = [fold_frequency(b, sample_rate) for b in signed]
    truth = (signed[0] + signed[2]) / 2, (signed[2] - signed[0]) / 2
    for mismatch, other in other_readings(peaks, truth, sample_rate):
        assume(mismatch > 4 + FOLD_PENALTY_BINS * (folds - other))
    return signed, peaks


ranges = st.floats(1.0, 12e3)
velocities = st.floats(-250.0, 250.0)
sample_rates = st.sampled_from([600e6, 450e6, 333e6])


@given(ranges, velocities, sample_rates)
def test_exact_peaks_give_range_and_velocity_to_rounding(target_range, velocity, sample_rate):
    _, peaks = scene_beats(target_range, velocity, sample_rate)
    r, v = resolved(*peaks, sample_rate)
    # Beats round to 1e-7 Hz: 1e-11 m and 1e-13 m/s, and the sign of a velocity near 0 is lost.
    assert r == pytest.approx(target_range, abs=1e-9)
    assert v == pytest.approx(velocity, abs=1e-11)


@given(ranges, velocities, sample_rates)
def test_peaks_on_whole_bins_give_range_and_velocity_to_half_a_bin(
    target_range, velocity, sample_rate
):
    signed, peaks = scene_beats(target_range, velocity, sample_rate)
    # Where up or down beat lies at DC the order of the two readings is lost: tested below.
    assume(min(abs(signed[0]), abs(signed[2])) > 4 * BIN)
    assume(all(abs(x - sample_rate / 2) > BIN for x in peaks))
    r, v = resolved(*[BIN * round(x / BIN) for x in peaks], sample_rate)
    assert abs(r - target_range) <= 0.501 * RANGE_BIN
    assert abs(v - velocity) <= 0.501 * VELOCITY_BIN


@pytest.mark.parametrize("sense", [1, -1])
def test_equal_doppler_and_range_frequencies_cost_bins_and_no_more(sense):
    """|f_d| ~ f_r puts a beat at DC: which half is which is lost, but the halves are equal too."""
    for offset in np.linspace(-6, 6, 241):
        f_r = RATE * 2 * 2500.0 / speed_of_light
        velocity = sense * (f_r + offset * BIN) * 1550e-9 / 2
        peaks = [BIN * round(fold_frequency(b, 600e6) / BIN) for b in beats(2500.0, velocity)]
        r, v = resolved(*peaks)
        assert abs(r - 2500.0) < 2.6 * RANGE_BIN
        assert abs(v - velocity) < 2.6 * VELOCITY_BIN


@pytest.mark.parametrize("sense", [1, -1])
@pytest.mark.parametrize("offset_bins", [-100.3, -3.3, 6.3, 66.3, 1000.3])
def test_a_peak_near_nyquist_is_read_right_outside_the_bins_that_a_fold_costs(offset_bins, sense):
    velocity = (
        sense * (300e6 + offset_bins * BIN - beats(9000.0, 0.0)[2]) / CARRIER * speed_of_light / 2
    )
    r, v = resolved(*[fold_frequency(b, 600e6) for b in beats(9000.0, velocity)])
    assert (r, v) == pytest.approx((9000.0, velocity), abs=1e-8)


@pytest.mark.parametrize("offset_bins", [1.3, 2.3, 3.3])
def test_a_peak_just_past_nyquist_is_misread_by_no_more_than_it_lies_past_it(offset_bins):
    """A fold counts as FOLD_PENALTY bins of mismatch, so the nearest bins past it look unfolded."""
    velocity = (300e6 + offset_bins * BIN - beats(9000.0, 0.0)[2]) / CARRIER * speed_of_light / 2
    past = (beats(9000.0, velocity)[2] - 300e6) / BIN
    r, v = resolved(*[fold_frequency(b, 600e6) for b in beats(9000.0, velocity)])
    assert 0 < past < FOLD_PENALTY_BINS
    assert abs(r - 9000.0) < past * RANGE_BIN * 1.001
    assert abs(v - velocity) < past * VELOCITY_BIN * 1.001


def test_one_bin_is_0_343_metres_and_3_55_millimetres_a_second():
    assert pytest.approx(4577.6, abs=0.05) == BIN
    peaks = np.array([100e6, 20e6, 140e6])  # f_r = 120 MHz, f_d = 20 MHz
    one = resolved(*peaks)
    farther = resolved(*(peaks + BIN * np.array([1, 0, 1])))
    faster = resolved(*(peaks + BIN * np.array([-1, 1, 1])))
    assert farther[0] - one[0] == pytest.approx(0.343, abs=0.0005)
    assert farther[1] == pytest.approx(one[1], abs=1e-9)
    assert faster[1] - one[1] == pytest.approx(3.55e-3, abs=0.005e-3)
    # A bin of velocity moves the range by half a bandwidth of Doppler ratio: 2e-6 of a bin.
    assert faster[0] == pytest.approx(one[0], abs=1e-4)


def test_direct_detection_resolves_without_a_doppler_peak():
    """Its Doppler frequency is that of the radio carrier, far below the range beat."""
    for target_range, velocity in ((300.0, 150.0), (2000.0, -150.0), (9000.0, 0.0)):
        up, _, down = (
            beat_frequency(
                sign, carrier=5.5e9 + 1e9 * (sign < 0), chirp_rate=RATE, range=target_range,
                radial_velocity=velocity,
            )
            for sign in (1, 0, -1)
        )  # fmt: skip
        report = resolve_range_velocity(
            up=np.array([abs(up)]), doppler=None, down=np.array([abs(down)]),
            carrier=5.5e9, bandwidth=BANDWIDTH, duration=DURATION, sample_rate=600e6,
            bin_width=BIN,
        )  # fmt: skip
        assert report.range[0] == pytest.approx(target_range, abs=1e-9)
        assert report.radial_velocity[0] == pytest.approx(velocity, abs=1e-6)


@given(far=st.floats(0.0, 1.0), velocity=st.floats(-80.0, 80.0), rate=st.sampled_from([256e6, 1e9]))
def test_a_triangle_tells_range_and_velocity_of_what_is_far_enough(far, velocity, rate):
    """Settembrini's chirp: 6 GHz in 32 us at 1310 nm. Beyond |f_d| = f_r, below Nyquist."""
    carrier, slope = speed_of_light / 1310e-9, 6e9 / 32e-6
    nearest = abs(velocity) * speed_of_light / (1310e-9 * slope) * (1 + 1e-4)
    folds = (rate / 2 - 2 * abs(velocity) / 1310e-9) * speed_of_light / (2 * slope) * (1 - 1e-4)
    assume(folds > nearest)
    target = nearest + far * (folds - nearest)
    up, down = (
        beat_frequency(
            sign, carrier=carrier + 6e9 * (sign < 0), chirp_rate=slope, range=target,
            radial_velocity=velocity,
        )
        for sign in (1, -1)
    )  # fmt: skip
    assert up <= 0 <= down
    report = resolve_range_velocity(
        up=fold_frequency(up, rate),
        doppler=None,
        down=fold_frequency(down, rate),
        carrier=carrier,
        bandwidth=6e9,
        duration=32e-6,
        sample_rate=rate,
        bin_width=rate / 2**13,
    )
    assert report.range == pytest.approx(target, abs=1e-7)
    assert report.radial_velocity == pytest.approx(velocity, abs=1e-7)
