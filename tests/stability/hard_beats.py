"""Beats where signs, images and folds meet, and what three peaks say."""

import itertools
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
from exact_spectrum import error_over_peak, peak_magnitude
from hard_cases import EPS, Family
from table_4_1_shots import prepare_shot, velocity_for

from sweep.model import time_domain_truth
from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.preparation import Shots
from sweep.model.spectrum import segment_spectra
from sweep.model.waveform import beat_frequency, resolve_range_velocity
from sweep.model.window import COSINE_SUM_COEFFICIENTS

FFT_SIZE, SAMPLE_RATE = 4096, 600e6
NYQUIST = SAMPLE_RATE / 2

FAMILY = Family(
    "Beats",
    "Magnitudes of bins at and near lines, to DC and to Nyquist, 4096 samples, against the exact "
    "delay's phase and the window's transform in 40 digits; range and velocity are taken as "
    "exact. A beat at bin nu before it is folded is known to nu eps / 2 bins, and next to a line "
    "|X| changes by about pi/2 of the peak a bin. If a line meets its image, its phase counts as "
    "well, in which S tau^2 / 2 is rounded. The closed form adds some roundings of the peak. (The "
    "rounding of R alone, not counted here, turns the optical phase at 2 km by 1e-6 rad.)",
)
WINDOWS = ("rectangular", "hann", "hamming", "flattop")


def case_fields(
    frequency: float, allowed: float, chirp_phase_cycles: float = 0.0
) -> dict[str, Any]:
    """Arguments of cases, given their largest beat [Hz] and, where it counts, S tau^2 / 2."""
    line_position_bins = frequency / SAMPLE_RATE * FFT_SIZE * np.pi / 2
    phase = f"; chirp phase of {chirp_phase_cycles:.0f} cycles" if chirp_phase_cycles else ""
    return {
        "reference": "exact delay and transform, 40 digits",
        "measure": "abs(X), of the peak",
        "allowed": allowed,
        "limit": (line_position_bins + 4 * np.pi * chirp_phase_cycles + 4) * EPS / 2,
        "because": f"beats to {frequency:.1e} Hz{phase}, rounded",
    }


def bins_to_check(single_shot: Shots, segment: int) -> list[int]:
    """Bins about the line, at both ends of the spectrum and in between."""
    _, magnitude = segment_spectra.segment_spectrum(single_shot, 0, segment)
    centre, half = int(np.argmax(magnitude)), single_shot.fft_size // 2
    near = range(centre - 4, centre + 5)
    return sorted({k for k in (0, 1, 2, *near, half - 1, half, 77, 1234) if 0 <= k <= half})


def error_of_all_segments(single_shot: Shots) -> float:
    """Largest error of the fast path's bins over the peak, all segments."""
    worst = 0.0
    for segment in np.flatnonzero(single_shot.has_segment).tolist():
        bins = bins_to_check(single_shot, segment)
        _, magnitude = segment_spectra.segment_spectrum(single_shot, 0, segment)
        worst = max(worst, error_over_peak(single_shot, segment, bins, magnitude[bins]))
    return worst


def shots_on_frequency(
    frequencies: Iterable[float], segments: Iterable[int] = (0, 1, 2), **changes: Any
) -> Iterator[Shots]:
    """Shots whose velocity puts a segment's beat on a frequency, in several windows."""
    for number, frequency in enumerate(frequencies):
        for segment in segments:
            radial_velocity = velocity_for(frequency, segment, range=3210.0)
            window = WINDOWS[(number + segment) % len(WINDOWS)]
            scene = {
                "range": 3210.0,
                "radial_velocity": radial_velocity,
                "window": window,
                "fft_size": FFT_SIZE,
            }
            yield prepare_shot(**scene | changes)


@FAMILY.case("each segment's beat at DC", **case_fields(1e8, 2e-12, 459))
def at_dc() -> float:
    return max(error_of_all_segments(one) for one in shots_on_frequency([0.0] * 2))


@FAMILY.case("beats 1e-18 to 1e-6 bins off DC", is_slow=True, **case_fields(1e8, 1e-12))
def next_to_dc() -> float:
    return max(
        error_of_all_segments(
            prepare_shot(
                radial_velocity=bins * SAMPLE_RATE / FFT_SIZE * 1550e-9 / 2,
                window=window,
                fft_size=FFT_SIZE,
            )
        )
        for bins in (1e-18, -1e-12, 1e-6)
        for window in WINDOWS
    )


@FAMILY.case("each segment's beat at Nyquist, of either sign", **case_fields(4e8, 2e-12, 459))
def at_nyquist() -> float:
    return max(error_of_all_segments(one) for one in shots_on_frequency([NYQUIST, -NYQUIST]))


@FAMILY.case(
    "beats folded onto DC, Nyquist and between, up to 4 GHz", **case_fields(4e9, 5e-11, 459)
)
def folded() -> float:
    frequencies = [SAMPLE_RATE, 1.5 * SAMPLE_RATE, -2 * SAMPLE_RATE, 3.9e9, -3.3e9 - 12345.678]
    return max(
        error_of_all_segments(one) for one in shots_on_frequency(frequencies, segments=(1, 2))
    )


@FAMILY.case("10 km/s, closing and receding", is_slow=True, **case_fields(1.3e10, 3e-11))
def ten_kilometres_a_second() -> float:
    return max(
        error_of_all_segments(prepare_shot(radial_velocity=v, window=window, fft_size=FFT_SIZE))
        for v in (1e4, -1e4)
        for window in WINDOWS
    )


@FAMILY.case("receding faster than the range beat", **case_fields(3e8, 1e-12))
def receding() -> float:
    return max(
        error_of_all_segments(
            prepare_shot(radial_velocity=v, window="hann", fft_size=FFT_SIZE, range=r)
        )
        for v in (-0.001, -50.0, -150.0)
        for r in (1.0, 500.0)
    )


def doppler_tones(bins: float, **changes: Any) -> Iterator[Shots]:
    """Shots whose Doppler line lies on a place of the spectrum, every cosine sum."""
    for window in COSINE_SUM_COEFFICIENTS:
        radial_velocity = velocity_for(bins * SAMPLE_RATE / FFT_SIZE, 1)
        yield prepare_shot(
            radial_velocity=radial_velocity, window=window, fft_size=FFT_SIZE, **changes
        )


@FAMILY.case("tones exactly on bins: nulls beside them", **case_fields(1.5e8, 1e-12))
def on_bins() -> float:
    return max(error_of_all_segments(one) for bins in (1.0, 777.0) for one in doppler_tones(bins))


@FAMILY.case("tones half-way between bins", is_slow=True, **case_fields(3e8, 1e-12))
def between_bins() -> float:
    return max(error_of_all_segments(one) for bins in (0.5, 2047.5) for one in doppler_tones(bins))


@FAMILY.case(
    "every window, closed form or table, at DC, on a bin, half-way and folded",
    reference="time-domain record and its FFT",
    measure="abs(X), of the peak",
    allowed=1e-11,
    limit=2 * np.pi * 3456 * EPS / 2,
    because="phases f t of the record of up to 3456 cycles, rounded",
)
def time_domain() -> float:
    tabulated_windows = (
        "kaiser(8.6)",
        "chebwin(100)",
        "dpss(3)",
        "gaussian(600)",
        "tukey(0.3)",
        "bohman",
    )
    worst = 0.0
    for window in (*COSINE_SUM_COEFFICIENTS, *tabulated_windows):
        for bins in (0.0, 0.5, 300.0, 511.5, 3456.789):
            radial_velocity = velocity_for(bins * SAMPLE_RATE / 1024, 1)
            single_shot = prepare_shot(
                radial_velocity=radial_velocity, window=window, fft_size=1024
            )
            for segment in range(3):
                _, magnitude = segment_spectra.segment_spectrum(single_shot, 0, segment)
                exact_magnitude = time_domain_truth.time_domain_spectrum(
                    single_shot, 0, segment, with_range_walk=False
                )
                worst = max(
                    worst,
                    float(np.abs(magnitude - exact_magnitude).max())
                    / peak_magnitude(single_shot, 0, segment),
                )
    return worst


RANGES = (1e-3, 1.0, 2e3, 1e6)
BANDWIDTH, DURATION = 1e9, 500e-6


def iter_reading_errors(*velocities: float) -> Iterator[tuple[float, float, float]]:
    """Errors of range [m] and velocity [m/s] read from exact beats, and the largest beat [Hz].

    Not where a receding target's three unsigned beats are in the order of a closing one's.
    """
    carrier = SPEED_OF_LIGHT / 1550e-9
    for true_range, true_velocity in itertools.product(RANGES, velocities):
        if true_velocity < 0 and true_range <= -true_velocity * DURATION:
            continue
        up, doppler, down = (
            np.abs(
                beat_frequency(
                    sign,
                    carrier=np.float64(carrier + BANDWIDTH * (sign < 0)),
                    chirp_rate=np.float64(BANDWIDTH / DURATION),
                    range=np.float64(true_range),
                    radial_velocity=np.float64(true_velocity),
                )
            )
            for sign in (1, 0, -1)
        )
        reading = resolve_range_velocity(
            up=up, doppler=doppler, down=down, carrier=np.float64(carrier),
            bandwidth=np.float64(BANDWIDTH), duration=np.float64(DURATION),
            sample_rate=np.float64(1e12), bin_width=np.float64(4577.6),
        )  # fmt: skip
        errors = (
            abs(float(reading.range) - true_range),
            abs(float(reading.radial_velocity) - true_velocity),
        )
        yield *errors, max(float(beat) for beat in (up, doppler, down))


@FAMILY.case(
    "ranges from 1 mm to 1e6 m out of three beats, up to 10 km/s",
    reference="the range that was put in",
    measure="range, over the rounding of the largest beat",
    allowed=6.0,
    limit=4.0,
    because="differences of beats of up to 2.7e10 Hz, each the sum of two, rounded",
)
def range_out_of_beats() -> float:
    metres = SPEED_OF_LIGHT / 2 * DURATION / BANDWIDTH
    reading_errors = iter_reading_errors(0.0, 1e-3, 150.0, -150.0, 1e4, -1e4)
    return max(error / (largest * EPS / 2 * metres) for error, _, largest in reading_errors)


@FAMILY.case(
    "velocities from 1 um/s to 10 km/s out of three beats, to 1e6 m",
    reference="the velocity that was put in",
    measure="velocity, over the rounding of the largest beat",
    allowed=6.0,
    limit=4.0,
    because="sums and differences of beats, each the sum of two, rounded",
)
def velocity_out_of_beats() -> float:
    reading_errors = iter_reading_errors(1e-6, -1e-3, 150.0, -150.0, 1e4)
    return max(error / (largest * EPS / 2 * 1550e-9 / 2) for _, error, largest in reading_errors)
