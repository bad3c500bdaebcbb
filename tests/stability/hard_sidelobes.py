"""Sidelobes far below the peak, of every window, and what they do to the detection."""

import math
from collections.abc import Iterable, Iterator
from itertools import product
from typing import Any

import mpmath as mp
import numpy as np
from exact_spectrum import exact_magnitudes, window_transform
from hard_cases import EPS, Family
from hard_marcum import excess_by_poisson_mixture
from shot_helpers import detected_window, line_shape_of_window
from table_4_1_shots import prepare_shot

from sweep.model.evaluation import evaluate_segments
from sweep.model.spectrum.bin_spectrum import (
    LineBundle,
    allocate_workspace,
    compute_line_spectrum,
)
from sweep.model.spectrum.line_shape import SHARED_TABLE_HALF_WIDTH_BINS
from sweep.model.spectrum.segment_spectra import bin_tangents
from sweep.model.window import COSINE_SUM_COEFFICIENTS, get_window, window_samples

FAMILY = Family(
    "Sidelobes",
    "The window's transform W near its line, without the image. Cosine sums of m terms fall as "
    "the distance's power 1 to 2m - 1. Bins near a line come from a table, and their error is "
    "relative to the peak. Those far from it come from the record's two ends, and their error is "
    "relative to themselves, however small. Windows that are no sum of cosines, and short "
    "records, have a table of all bins.",
)
FFT_SIZES = (2**12, 2**14, 2**17, 2**20, 2**24)
LINE_OFFSETS_BINS = (0.4061, -0.49999, 0.5)
PEAK_CASE = {"measure": "abs(X), of the peak", "reference": "sum over all samples, exactly rounded"}


def window_magnitudes(
    window_name: str, size: int, line_offset: float, bins: Iterable[int]
) -> Iterator[float]:
    """|W| of single bins, unpadded, for a line `delta` bins off bin 0."""
    prepared = line_shape_of_window(get_window(window_name, size), size)
    line_spectrum = allocate_workspace(16).line_spectrum
    line_spectrum.lines.position[0], line_spectrum.lines.re[0], line_spectrum.lines.im[0] = (
        line_offset,
        1.0,
        0.0,
    )
    bundle = LineBundle(0, 1, line_offset, line_offset, 1.0)
    for k in bins:
        compute_line_spectrum(
            k,
            1,
            bundle,
            0.0,
            prepared.shape,
            prepared.layout,
            bin_tangents(size),
            line_spectrum,
        )
        yield float(np.hypot(line_spectrum.re[0], line_spectrum.im[0]))


def far_bins(size: int) -> list[int]:
    """Bins from beyond the table to well before Nyquist."""
    return [
        SHARED_TABLE_HALF_WIDTH_BINS + 9,
        SHARED_TABLE_HALF_WIDTH_BINS + 123,
        size // 8,
        size // 4,
        size // 3,
    ]


def far_sidelobe_error(window_name: str) -> float:
    """Worst error of far sidelobes, relative to themselves."""
    worst = 0.0
    with mp.workdps(100):
        for size in FFT_SIZES:
            for delta in LINE_OFFSETS_BINS:
                bins = far_bins(size)
                for k, magnitude in zip(
                    bins, window_magnitudes(window_name, size, delta, bins), strict=True
                ):
                    exact = abs(window_transform(window_name, size, k - mp.mpf(delta)))
                    worst = max(worst, float(abs(magnitude / exact - 1)))
    return worst


def add_closed_form_cases() -> None:
    """A case for each sum of cosines."""
    for name in COSINE_SUM_COEFFICIENTS:
        FAMILY.case(
            f"{name}, 2^12 to 2^24 points, bins to N/3",
            reference="sum of the terms, 100 digits",
            measure="abs(W), of itself",
            allowed=1e-12,
            limit=4 * EPS,
            because="the record's ends have twelve derivatives",
        )(lambda name=name: far_sidelobe_error(name))


add_closed_form_cases()


@FAMILY.case(
    "the last bins before Nyquist, 2^12 to 2^24 points, where Hann's sidelobes go through zero",
    reference="sum of the terms, 100 digits",
    measure="abs(W), of itself over N",
    allowed=4 * EPS,
    limit=EPS,
    because="a place of N/2 bins, rounded, a bin from where W is 0",
)
def last_bins() -> float:
    worst = 0.0
    with mp.workdps(100):
        for name in COSINE_SUM_COEFFICIENTS:
            for size in (2**12, 2**17, 2**24):
                bins = [size // 2 - 3, size // 2 - 1]
                for k, magnitude in zip(
                    bins, window_magnitudes(name, size, 0.4061, bins), strict=True
                ):
                    exact = abs(window_transform(name, size, k - mp.mpf(0.4061)))
                    worst = max(worst, float(abs(magnitude / exact - 1)) / size)
    return worst


@FAMILY.case(
    "main lobes and nulls of all closed forms, lines 1e-9 of a bin off their bin",
    reference="sum of the terms, 100 digits",
    measure="abs(W), of the peak",
    allowed=1e-12,
    limit=4 * EPS,
    because="lines are shared out by a kernel that is right to 1e-13",
)
def main_lobes() -> float:
    worst, bins = 0.0, [*range(9), 40, 123, 240, 511, 512]
    with mp.workdps(100):
        for name, size in product(COSINE_SUM_COEFFICIENTS, (1024, 4096)):
            for delta in (0.0, 1e-300, 1e-9, 0.25, 0.5):
                peak = get_window(name, size).sum
                for k, magnitude in zip(
                    bins, window_magnitudes(name, size, delta, bins), strict=True
                ):
                    exact = abs(window_transform(name, size, k - mp.mpf(delta)))
                    worst = max(worst, float(abs(magnitude - exact)) / peak)
    return worst


def window_magnitude_by_samples(name: str, size: int, delta: float, k: int) -> float:
    """|W| by the plain sum: phases of whole cycles taken off exactly, sums rounded once."""
    weights, sample_numbers = window_samples(name, size), np.arange(size)
    turns = (sample_numbers * k % size) / size - sample_numbers * (delta / size)
    real, imaginary = weights * np.cos(2 * np.pi * turns), weights * np.sin(2 * np.pi * turns)
    return math.hypot(math.fsum(real), math.fsum(imaginary))


def tabulated_error(names: Iterable[str], sizes: Iterable[int], bins: Iterable[int]) -> float:
    """Worst error of windows without a closed form, over the peak."""
    worst = 0.0
    for name in names:
        for size in sizes:
            for delta in (0.4061, 0.5, 1e-9):
                all_bins = [*bins, size // 3, size // 2]
                for k, magnitude in zip(
                    all_bins, window_magnitudes(name, size, delta, all_bins), strict=True
                ):
                    exact = window_magnitude_by_samples(name, size, delta, k)
                    worst = max(worst, abs(magnitude - exact) / get_window(name, size).sum)
    return worst


TAPERED_WINDOWS = ("kaiser(14)", "chebwin(100)", "dpss(3)", "bohman", "parzen", "barthann")


@FAMILY.case(
    "tabulated windows that end near zero, 2^8 to 2^14 points",
    allowed=1e-13, limit=EPS, because="one rounding of the peak", **PEAK_CASE,
)  # fmt: skip
def tapered_windows() -> float:
    return tabulated_error(TAPERED_WINDOWS, (2**8, 2**11, 2**14), (0, 1, 2, 7, 33))


@FAMILY.case(
    "tabulated windows that end near zero, 2^18 to 2^20 points",
    allowed=3e-13, limit=EPS, because="one rounding of the peak", is_slow=True, **PEAK_CASE,
)  # fmt: skip
def long_tapered_windows() -> float:
    return tabulated_error(TAPERED_WINDOWS[:2], (2**18, 2**20), (1, 33))


@FAMILY.case(
    "tabulated windows with a step at their ends",
    allowed=2e-13, limit=EPS, because="one rounding; a kernel that is right to 1e-13", **PEAK_CASE,
)  # fmt: skip
def stepped_windows() -> float:
    return tabulated_error(
        ("gaussian(300)", "kaiser(1)", "tukey(0.05)"), (2**10,), (0, 1, 2, 7, 33)
    )


LEAKAGE_EFFECTS = ("footprint", "footprint_phase", "doppler", "leakage")
STRONG_SCENE = {
    "fft_size": 4096, "range": 3000.0, "power": 1e3, "tnr": 5.0, "beamlets": 19,
    "phases": "incoherent", "grazing_angle": 0.05, "beam_divergence": 1e-3,
}  # fmt: skip
"""19 beamlets over some bins, so far above the noise that bins far off cross the threshold."""


@FAMILY.case(
    "sidelobes of 19 beamlets, powers, where detection and leakage look at them",
    reference="exact delay and transform, 40 digits",
    measure="abs(X), of the peak",
    allowed=1e-9,
    limit=EPS**0.5,
    because="a rounding of the peak's power, in a null",
    is_slow=True,
)
def sidelobes_of_many() -> float:
    worst = 0.0
    for name in ("hann", "hamming", "blackman", "rectangular"):
        single_shot = prepare_shot(LEAKAGE_EFFECTS, **STRONG_SCENE, window=name)
        first_bin, magnitude = detected_window(single_shot, 0)
        count = magnitude.size
        peak_bin = int(np.argmax(magnitude))
        near_bins = {
            0,
            peak_bin - 30,
            peak_bin - 9,
            peak_bin - 3,
            peak_bin - 1,
            peak_bin,
            peak_bin + 2,
            peak_bin + 17,
            count - 1,
        }
        checked_bins = sorted({k for k in near_bins if 0 <= k < count})
        with mp.workdps(40):
            exact = exact_magnitudes(
                single_shot, 0, 0, [first_bin + int(k) for k in checked_bins], image=False
            )
            errors = [
                abs(float(magnitude[k]) - x) for k, x in zip(checked_bins, exact, strict=True)
            ]
        worst = max(worst, float(max(errors) / magnitude.max()))
    return worst


LEAKAGE_CASE = {
    "reference": "every bin in 30 digits, chances as mixtures of chi-square tails",
    "measure": "leakage",
    "allowed": 1e-6,
    "limit": 1e-10,
    "because": "magnitudes to 1e-11, times threshold over noise; the integral is meant to 1e-6",
}


@FAMILY.case("leakage of 600 bins, from 1e-12 to 1, many of each far below it", **LEAKAGE_CASE)
def leakage_of_600_bins() -> float:
    return max(leakage_error("hann", 1280, 100.0), leakage_error("hamming", 1280, 1500.0))


@FAMILY.case(
    "leakage of 2000 bins, most of them summed as an integral", is_slow=True, **LEAKAGE_CASE
)
def leakage_of_2000_bins() -> float:
    return leakage_error("hamming", 2**12, 1000.0)


def leakage_error(window_name: str, size: int, range_m: float) -> float:
    """Relative error of the leakage of a shot's up segment."""
    single_shot = prepare_shot(LEAKAGE_EFFECTS, window=window_name, fft_size=size, range=range_m)
    results = evaluate_segments(single_shot)
    n_exempt, leakage = int(results.n_exempt[0, 0]), results.leakage_probability[0, 0]
    return abs(leakage / exact_leakage(single_shot, n_exempt) - 1)


def exact_leakage(single_shot: Any, n_exempted: int) -> float:
    """Chance that a bin of the up segment but those about the peak crosses, over noise alone."""
    sigma, threshold = float(single_shot.bin_noise_sigma[0]), float(single_shot.threshold[0])
    with mp.workdps(30):
        bins = exact_magnitudes(
            single_shot, 0, 0, range(single_shot.fft_size // 2 + 1), image=False
        )
        crossing = [k for k, x in enumerate(bins) if x >= min(threshold, max(bins))]
        exempt = {k + offset for k in crossing for offset in (-1, 0, 1)}
        assert len(exempt) == n_exempted
        beta = mp.mpf(threshold) / sigma
        below = -mp.expm1(-(beta**2) / 2)
        logs = [
            mp.log1p(-excess_by_poisson_mixture(x / sigma, beta) / below)
            for k, x in enumerate(bins)
            if k not in exempt
        ]
        return float(-mp.expm1(mp.fsum(logs)))
