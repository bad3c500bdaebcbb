"""The smallest and largest of everything: FFTs, records, footprints."""

import math
from collections.abc import Iterable
from typing import Any

import numpy as np
from exact_spectrum import error_over_peak, peak_magnitude
from hard_beats import error_of_all_segments
from hard_cases import EPS, Family
from table_4_1_shots import prepare_shot, velocity_for

from sweep.model import time_domain_truth
from sweep.model.preparation import Shots
from sweep.model.spectrum import segment_spectra

FAMILY = Family(
    "Sizes",
    "Records and FFTs of 2 to 2^24 samples, prime or padded, and 1 to 100,000 beamlets. As with "
    "beats, a line at bin nu is known to nu eps / 2 bins, which is what long FFTs cost; short ones "
    "cost nothing.",
)
EXACT_REFERENCE = {
    "reference": "exact delay and transform, 40 digits",
    "measure": "abs(X), of the peak",
}
SAMPLE_RATE = 600e6


def position_rounding(frequency: float, size: int, rate: float = SAMPLE_RATE) -> float:
    """Cost of a beat's rounding over the peak."""
    return (frequency / rate * size * math.pi / 2 + 4) * EPS / 2


def error_next_to_line(single_shot: Shots, segment: int, relative_level: float) -> float:
    """Worst error over the peak of the bins next to a line."""
    peak_height = peak_magnitude(single_shot, 0, segment)
    bins, magnitude = segment_spectra.segment_spectrum(
        single_shot, 0, segment, level_min=relative_level * peak_height
    )
    peak_index = int(np.argmax(magnitude))
    checked = sorted(
        {0, len(bins) - 1, *range(max(peak_index - 4, 0), min(peak_index + 5, len(bins)))}
    )
    return error_over_peak(single_shot, segment, bins[checked].tolist(), magnitude[checked])


def error_of_long_fft(size: int, **changes: Any) -> float:
    """The same of three segments of an FFT whose record is as long."""
    single_shot = prepare_shot(
        fft_size=size, duration=2 * size / SAMPLE_RATE, window="hann", **changes
    )
    return max(error_next_to_line(single_shot, segment, 1e-3) for segment in range(3))


@FAMILY.case("FFTs of 2 to 9 points", allowed=1e-12, limit=position_rounding(2e8, 9),
             because="beats of 2e8 Hz, rounded; windows below 64 samples come from the table",
             **EXACT_REFERENCE)  # fmt: skip
def shortest_ffts() -> float:
    return max(
        error_of_all_segments(prepare_shot(fft_size=size, window=window, range=r))
        for size in (2, 3, 4, 5, 7, 9)
        for window in ("rectangular", "hann", "flattop")
        for r in (1.0, 77.7)
    )


@FAMILY.case(
    "FFTs of 63, 64, 1009, 2187 and 4095 points",
    allowed=1e-12,
    limit=position_rounding(2e8, 4095),
    because="beats of 2e8 Hz, rounded; 63 samples come from the table",
    **EXACT_REFERENCE,
)
def odd_fft_sizes() -> float:
    return max(
        error_of_all_segments(prepare_shot(fft_size=size, window=window))
        for size in (63, 64, 1009, 2187, 4095)
        for window in ("rectangular", "blackman")
    )


@FAMILY.case("an FFT of 2^24 points", allowed=3e-9, limit=position_rounding(2e8, 2**24),
             because="beats of 2e8 Hz, rounded", **EXACT_REFERENCE)  # fmt: skip
def largest_fft() -> float:
    return error_of_long_fft(2**24)


def shot_of_padded_record(length: int, size: int, **changes: Any) -> Shots:
    """A shot whose record ends after some samples, where the chirp does."""
    delay = (300e-6 * SAMPLE_RATE - length) / SAMPLE_RATE
    single_shot = prepare_shot(fft_size=size, duration=300e-6, acquisition_delay=delay, **changes)
    assert single_shot.window.length == length
    return single_shot


@FAMILY.case("records that end with the chirp: 2 to 997 samples of an FFT of 1024 or 1000",
             allowed=2e-10, limit=position_rounding(2e8, 1024) + 2 * math.pi * 2e8 * 300e-6 * EPS,
             because="beats, and 6e4 cycles of them until the record begins, rounded",
             is_slow=True, **EXACT_REFERENCE)  # fmt: skip
def short_records() -> float:
    return max(
        error_of_all_segments(shot_of_padded_record(length, size, window=window, range=500.0))
        for length in (2, 3, 65, 700, 997)
        for size in (1000, 1024)
        for window in ("rectangular", "hann", "nuttall")
    )


@FAMILY.case("a record of a single sample", allowed=2e-10, limit=2 * math.pi * 2e8 * 300e-6 * EPS,
             because="6e4 cycles until the record begins, rounded", **EXACT_REFERENCE)  # fmt: skip
def single_sample_record() -> float:
    return max(
        error_of_all_segments(shot_of_padded_record(1, size, window="rectangular", range=500.0))
        for size in (2, 64, 1000)
    )


@FAMILY.case("the time-domain record itself, 2^20 samples", allowed=1e-11,
             limit=2 * math.pi * 2e8 / SAMPLE_RATE * 2**20 * EPS / 2,
             because="phases f t of up to 3e5 cycles, each sample's "
             "rounded", **EXACT_REFERENCE)  # fmt: skip
def error_of_long_time_record() -> float:
    """Of bins next to the lines and far off."""
    size, worst = 2**20, 0.0
    single_shot = prepare_shot(fft_size=size, window="hann", duration=2 * size / SAMPLE_RATE)
    for segment in range(3):
        magnitude = time_domain_truth.time_domain_spectrum(
            single_shot, 0, segment, with_range_walk=False
        )
        peak_bin = int(np.argmax(magnitude))
        checked_bins = [1, size // 5, *range(peak_bin - 4, peak_bin + 5)]
        worst = max(
            worst, error_over_peak(single_shot, segment, checked_bins, magnitude[checked_bins])
        )
    return worst


def error_of_coincident_beamlets(phases: str, n_beamlets: int) -> float:
    """A footprint so small that all of it is one line, over that line and its amplitudes' sum."""
    scene = {"fft_size": 4096, "beam_divergence": 1e-9, "window": "hann", "phases": phases}
    shots_of_many, shots_of_one = prepare_shot(**scene, beamlets=n_beamlets), prepare_shot(**scene)
    weights = (
        shots_of_many.footprint.relative_amplitude[0]
        / shots_of_one.footprint.relative_amplitude[0, 0]
    )
    amplitude_sum = math.fsum(weights) if phases == "coherent" else math.sqrt(math.fsum(weights**2))
    worst = 0.0
    for segment in range(3):
        _, magnitude_of_one = segment_spectra.segment_spectrum(shots_of_one, 0, segment)
        _, magnitude_of_many = segment_spectra.segment_spectrum(shots_of_many, 0, segment)
        worst = max(
            worst,
            float(
                np.abs(magnitude_of_many / amplitude_sum - magnitude_of_one).max()
                / magnitude_of_one.max()
            ),
        )
    return worst


@FAMILY.case(
    "1 to 100,000 beamlets on one spot, as powers",
    reference="a single beamlet",
    measure="abs(X), of the peak",
    allowed=2e-13,
    limit=1e5**0.5 * EPS,
    because="1e5 additions, rounded",
)
def many_beamlet_powers() -> float:
    return max(
        error_of_coincident_beamlets("incoherent", number) for number in (1, 2, 3, 109, 100_000)
    )


@FAMILY.case(
    "1 to 100,000 beamlets on one spot, as amplitudes",
    reference="a single beamlet, times the exactly rounded sum of the amplitudes",
    measure="abs(X), of the peak",
    allowed=1e-13,
    limit=1e5**0.5 * EPS,
    because="1e5 additions, rounded; many lines as few are meant to 1e-13",
)
def many_beamlet_amplitudes() -> float:
    return max(
        error_of_coincident_beamlets("coherent", number) for number in (1, 2, 3, 109, 100_000)
    )


def error_against_time_domain(
    beamlet_numbers: Iterable[int], segments_checked: Iterable[int] = (0, 1, 2), **changes: Any
) -> float:
    """Fast path against the time domain, over the peak."""
    worst = 0.0
    for n_beamlets in beamlet_numbers:
        single_shot = prepare_shot(beamlets=n_beamlets, fft_size=512, window="hann", **changes)
        for segment in segments_checked:
            _, magnitude = segment_spectra.segment_spectrum(single_shot, 0, segment)
            exact = time_domain_truth.time_domain_spectrum(
                single_shot, 0, segment, with_range_walk=False
            )
            worst = max(worst, float(np.abs(magnitude - exact).max() / exact.max()))
    return worst


TIME_DOMAIN_CASE = {
    "reference": "time-domain records of every beamlet",
    "measure": "abs(X), of the largest",
    "allowed": 1e-11,
    "limit": 2 * math.pi * 512 * EPS / 2,
    "because": "phases f t of the record of up to 512 cycles, rounded",
}
SLANT_SCENE = {"grazing_angle": 0.01, "beam_divergence": 3e-3, "range": 3000.0}


@FAMILY.case("2 to 1000 beamlets over tens of bins, as amplitudes", **TIME_DOMAIN_CASE)
def wide_footprints() -> float:
    return error_against_time_domain((2, 19, 1000), phases="coherent", **SLANT_SCENE)


@FAMILY.case(
    "2 to 1000 beamlets over tens of bins, as powers",
    **TIME_DOMAIN_CASE | {
        "allowed": 1e-9, "limit": EPS**0.5, "because": "a rounding of the peak's power, in a null"
    },
)  # fmt: skip
def wide_powers() -> float:
    return error_against_time_domain((2, 19, 1000), phases="incoherent", **SLANT_SCENE)


@FAMILY.case("100,000 beamlets over tens of bins", is_slow=True, **TIME_DOMAIN_CASE)
def widest_footprint() -> float:
    return error_against_time_domain((100_000,), (2,), phases="coherent", **SLANT_SCENE)


@FAMILY.case(
    "a line at the last bin of 2^17, its image beside it",
    allowed=2e-10, limit=position_rounding(9e8, 2**17) + 4 * math.pi * 178 * EPS,
    because="beats to 9e8 Hz and a chirp phase of 178 cycles, rounded", **EXACT_REFERENCE,
)  # fmt: skip
def line_at_last_bin() -> float:
    worst = 0.0
    for bins in (2**16 - 0.25, 2**16, 2**16 + 0.25, 2**17 + 0.25):
        radial_velocity = velocity_for(bins * SAMPLE_RATE / 2**17, 2)
        single_shot = prepare_shot(radial_velocity=radial_velocity, window="hann")
        worst = max(worst, error_next_to_line(single_shot, 2, 1e-3))
    return worst
