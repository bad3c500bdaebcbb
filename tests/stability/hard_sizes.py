"""The smallest and largest of everything: FFTs, records, footprints."""

import math
from collections.abc import Iterable
from typing import Any

import numpy as np
from cases import EPS, Family
from exact_spectrum import departure_of, peak
from hard_beats import departure
from table_shots import shots, velocity_for

from sweep.model import segments, truth
from sweep.model.preparation import Shots

FAMILY = Family(
    "Sizes",
    "Records and FFTs of 2 to 2^24 samples, prime or padded, and 1 to 100,000 beamlets. As with "
    "beats, a line at bin nu is known to nu eps / 2 bins, which is what long FFTs cost; short ones "
    "cost nothing.",
)
EXACT = {"reference": "exact delay and transform, 40 digits", "measure": "abs(X), of the peak"}
RATE = 600e6


def place(frequency: float, size: int, rate: float = RATE) -> float:
    """Cost of a beat's rounding over the peak."""
    return (frequency / rate * size * math.pi / 2 + 4) * EPS / 2


def few_bins(one: Shots, segment: int, level: float) -> float:
    """Worst error over the peak of the bins next to a line."""
    height = peak(one, 0, segment)
    bins, found = segments.spectrum(one, 0, segment, level=level * height)
    top = int(np.argmax(found))
    chosen = sorted({0, len(bins) - 1, *range(max(top - 4, 0), min(top + 5, len(bins)))})
    return departure_of(one, segment, bins[chosen].tolist(), found[chosen])


def long_fft(size: int, **changes: Any) -> float:
    """The same of three segments of an FFT whose record is as long."""
    one = shots(fft_size=size, duration=2 * size / RATE, window="hann", **changes)
    return max(few_bins(one, segment, 1e-3) for segment in range(3))


@FAMILY.case("FFTs of 2 to 9 points", allowed=1e-12, limit=place(2e8, 9),
             because="beats of 2e8 Hz, rounded; windows below 64 samples come from the table",
             **EXACT)  # fmt: skip
def shortest() -> float:
    return max(
        departure(shots(fft_size=size, window=window, range=r))
        for size in (2, 3, 4, 5, 7, 9)
        for window in ("rectangular", "hann", "flattop")
        for r in (1.0, 77.7)
    )


@FAMILY.case("FFTs of 63, 64, 1009, 2187 and 4095 points", allowed=1e-12, limit=place(2e8, 4095),
             because="beats of 2e8 Hz, rounded; 63 samples come from the table",
             **EXACT)  # fmt: skip
def odd_sizes() -> float:
    return max(
        departure(shots(fft_size=size, window=window))
        for size in (63, 64, 1009, 2187, 4095)
        for window in ("rectangular", "blackman")
    )


@FAMILY.case("an FFT of 2^24 points", allowed=3e-9, limit=place(2e8, 2**24),
             because="beats of 2e8 Hz, rounded", **EXACT)  # fmt: skip
def sixteen_million() -> float:
    return long_fft(2**24)


def padded(length: int, size: int, **changes: Any) -> Shots:
    """A shot whose record ends after some samples, where the chirp does."""
    delay = (300e-6 * RATE - length) / RATE
    one = shots(fft_size=size, duration=300e-6, acquisition_delay=delay, **changes)
    assert one.window.length == length
    return one


@FAMILY.case("records that end with the chirp: 2 to 997 samples of an FFT of 1024 or 1000",
             allowed=2e-10, limit=place(2e8, 1024) + 2 * math.pi * 2e8 * 300e-6 * EPS,
             because="beats, and 6e4 cycles of them until the record begins, rounded",
             slow=True, **EXACT)  # fmt: skip
def short_records() -> float:
    return max(
        departure(padded(length, size, window=window, range=500.0))
        for length in (2, 3, 65, 700, 997)
        for size in (1000, 1024)
        for window in ("rectangular", "hann", "nuttall")
    )


@FAMILY.case("a record of a single sample", allowed=2e-10, limit=2 * math.pi * 2e8 * 300e-6 * EPS,
             because="6e4 cycles until the record begins, rounded", **EXACT)  # fmt: skip
def one_sample() -> float:
    return max(
        departure(padded(1, size, window="rectangular", range=500.0)) for size in (2, 64, 1000)
    )


@FAMILY.case("the time-domain record itself, 2^20 samples", allowed=1e-11,
             limit=2 * math.pi * 2e8 / RATE * 2**20 * EPS / 2,
             because="phases f t of up to 3e5 cycles, each sample's rounded", **EXACT)  # fmt: skip
def floor_of_a_long_record() -> float:
    """Of bins next to the lines and far off."""
    size, worst = 2**20, 0.0
    one = shots(fft_size=size, window="hann", duration=2 * size / RATE)
    for segment in range(3):
        found = truth.spectrum(one, 0, segment, range_walk=False)
        top = int(np.argmax(found))
        chosen = [1, size // 5, *range(top - 4, top + 5)]
        worst = max(worst, departure_of(one, segment, chosen, found[chosen]))
    return worst


def of_one(phases: str, number: int) -> float:
    """A footprint so small that all of it is one line, over that line and its amplitudes' sum."""
    scene = {"fft_size": 4096, "beam_divergence": 1e-9, "window": "hann", "phases": phases}
    many, one = shots(**scene, beamlets=number), shots(**scene)
    weights = many.amplitude[0] / one.amplitude[0, 0]
    whole = math.fsum(weights) if phases == "coherent" else math.sqrt(math.fsum(weights**2))
    worst = 0.0
    for segment in range(3):
        _, single = segments.spectrum(one, 0, segment)
        _, found = segments.spectrum(many, 0, segment)
        worst = max(worst, float(np.abs(found / whole - single).max() / single.max()))
    return worst


@FAMILY.case(
    "1 to 100,000 beamlets on one spot, as powers",
    reference="a single beamlet",
    measure="abs(X), of the peak",
    allowed=2e-13,
    limit=1e5**0.5 * EPS,
    because="1e5 additions, rounded",
)
def many_powers() -> float:
    return max(of_one("incoherent", number) for number in (1, 2, 3, 109, 100_000))


@FAMILY.case(
    "1 to 100,000 beamlets on one spot, as amplitudes",
    reference="a single beamlet, times the exactly rounded sum of the amplitudes",
    measure="abs(X), of the peak",
    allowed=1e-13,
    limit=1e5**0.5 * EPS,
    because="1e5 additions, rounded; many lines as few are meant to 1e-13",
)
def many_amplitudes() -> float:
    return max(of_one("coherent", number) for number in (1, 2, 3, 109, 100_000))


def against_the_record(
    numbers: Iterable[int], those: Iterable[int] = (0, 1, 2), **changes: Any
) -> float:
    """Fast path against the time domain, over the peak."""
    worst = 0.0
    for number in numbers:
        one = shots(beamlets=number, fft_size=512, window="hann", **changes)
        for segment in those:
            _, found = segments.spectrum(one, 0, segment)
            exact = truth.spectrum(one, 0, segment, range_walk=False)
            worst = max(worst, float(np.abs(found - exact).max() / exact.max()))
    return worst


SPREAD = {
    "reference": "time-domain records of every beamlet",
    "measure": "abs(X), of the largest",
    "allowed": 1e-11,
    "limit": 2 * math.pi * 512 * EPS / 2,
    "because": "phases f t of the record of up to 512 cycles, rounded",
}
SLANT = {"grazing_angle": 0.01, "beam_divergence": 3e-3, "range": 3000.0}


@FAMILY.case("2 to 1000 beamlets over tens of bins, as amplitudes", **SPREAD)
def wide_footprints() -> float:
    return against_the_record((2, 19, 1000), phases="coherent", **SLANT)


@FAMILY.case(
    "2 to 1000 beamlets over tens of bins, as powers",
    **SPREAD | {
        "allowed": 1e-9, "limit": EPS**0.5, "because": "a rounding of the peak's power, in a null"
    },
)  # fmt: skip
def wide_powers() -> float:
    return against_the_record((2, 19, 1000), phases="incoherent", **SLANT)


@FAMILY.case("100,000 beamlets over tens of bins", slow=True, **SPREAD)
def widest_footprint() -> float:
    return against_the_record((100_000,), (2,), phases="coherent", **SLANT)


@FAMILY.case(
    "a line at the last bin of 2^17, its image beside it",
    allowed=2e-10, limit=place(9e8, 2**17) + 4 * math.pi * 178 * EPS,
    because="beats to 9e8 Hz and a chirp phase of 178 cycles, rounded", **EXACT,
)  # fmt: skip
def last_bin() -> float:
    worst = 0.0
    for bins in (2**16 - 0.25, 2**16, 2**16 + 0.25, 2**17 + 0.25):
        v = velocity_for(bins * RATE / 2**17, 2)
        one = shots(radial_velocity=v, window="hann")
        worst = max(worst, few_bins(one, 2, 1e-3))
    return worst
