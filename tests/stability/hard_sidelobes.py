"""Sidelobes far below the peak, of every window, and what they do to the detection."""

import math
from collections.abc import Iterable, Iterator
from itertools import product
from typing import Any

import mpmath as mp
import numpy as np
from cases import EPS, Family
from engine import run_of_bins, shape_of
from exact_spectrum import magnitudes, transform
from hard_marcum import mixture
from table_shots import shots

from sweep.model.line_shape import SHARED
from sweep.model.lines import IM, LEAST_WIDTH, PLACE, RE
from sweep.model.segments import tangents
from sweep.model.shot import find
from sweep.model.spectrum import F_IM, F_RE, MOST_CELLS, ROOM, field
from sweep.model.window import COSINE_SUMS, samples, window

FAMILY = Family(
    "Sidelobes",
    "The window's transform W near its line, without the image. Cosine sums of m terms fall as "
    "the distance's power 1 to 2m - 1. Bins near a line come from a table, and their error is "
    "relative to the peak. Those far from it come from the record's two ends, and their error is "
    "relative to themselves, however small. Windows that are no sum of cosines, and short "
    "records, have a table of all bins.",
)
SIZES = (2**12, 2**14, 2**17, 2**20, 2**24)
OFFSETS = (0.4061, -0.49999, 0.5)
PEAK = {"measure": "abs(X), of the peak", "reference": "sum over all samples, exactly rounded"}


def kernel(name: str, size: int, delta: float, bins: Iterable[int]) -> Iterator[float]:
    """|W| of single bins, unpadded, for a line `delta` bins off bin 0."""
    table, form, sizes, _, _ = shape_of(window(name, size), size)
    room = np.empty((ROOM, max(LEAST_WIDTH, MOST_CELLS) + 16))
    room[PLACE, 0], room[RE, 0], room[IM, 0] = delta, 1.0, 0.0
    for k in bins:
        field(k, 1, (1, delta, delta, 0.0), table, form, sizes, tangents(size), room)
        yield float(np.hypot(room[F_RE, 0], room[F_IM, 0]))


def far(size: int) -> list[int]:
    """Bins from beyond the table to well before Nyquist."""
    return [SHARED + 9, SHARED + 123, size // 8, size // 4, size // 3]


def relative_error(name: str) -> float:
    """Worst error of far sidelobes, relative to themselves."""
    worst = 0.0
    with mp.workdps(100):
        for size in SIZES:
            for delta in OFFSETS:
                bins = far(size)
                for k, found in zip(bins, kernel(name, size, delta, bins), strict=True):
                    exact = abs(transform(name, size, k - mp.mpf(delta)))
                    worst = max(worst, float(abs(found / exact - 1)))
    return worst


def closed_forms() -> None:
    """A case for each sum of cosines."""
    for name in COSINE_SUMS:
        FAMILY.case(
            f"{name}, 2^12 to 2^24 points, bins to N/3",
            reference="sum of the terms, 100 digits",
            measure="abs(W), of itself",
            allowed=1e-12,
            limit=4 * EPS,
            because="the record's ends have twelve derivatives",
        )(lambda name=name: relative_error(name))


closed_forms()


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
        for name in COSINE_SUMS:
            for size in (2**12, 2**17, 2**24):
                bins = [size // 2 - 3, size // 2 - 1]
                for k, found in zip(bins, kernel(name, size, 0.4061, bins), strict=True):
                    exact = abs(transform(name, size, k - mp.mpf(0.4061)))
                    worst = max(worst, float(abs(found / exact - 1)) / size)
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
        for name, size in product(COSINE_SUMS, (1024, 4096)):
            for delta in (0.0, 1e-300, 1e-9, 0.25, 0.5):
                unit = window(name, size).sum
                for k, found in zip(bins, kernel(name, size, delta, bins), strict=True):
                    exact = abs(transform(name, size, k - mp.mpf(delta)))
                    worst = max(worst, float(abs(found - exact)) / unit)
    return worst


def by_samples(name: str, size: int, delta: float, k: int) -> float:
    """|W| by the plain sum: phases of whole cycles taken off exactly, sums rounded once."""
    w, n = samples(name, size), np.arange(size)
    turns = (n * k % size) / size - n * (delta / size)
    real, imaginary = w * np.cos(2 * np.pi * turns), w * np.sin(2 * np.pi * turns)
    return math.hypot(math.fsum(real), math.fsum(imaginary))


def tabulated_error(names: Iterable[str], sizes: Iterable[int], bins: Iterable[int]) -> float:
    """Worst error of windows without a closed form, over the peak."""
    worst = 0.0
    for name in names:
        for size in sizes:
            for delta in (0.4061, 0.5, 1e-9):
                chosen = [*bins, size // 3, size // 2]
                for k, found in zip(chosen, kernel(name, size, delta, chosen), strict=True):
                    exact = by_samples(name, size, delta, k)
                    worst = max(worst, abs(found - exact) / window(name, size).sum)
    return worst


TAPERED = ("kaiser(14)", "chebwin(100)", "dpss(3)", "bohman", "parzen", "barthann")


@FAMILY.case(
    "tabulated windows that end near zero, 2^8 to 2^14 points",
    allowed=1e-13, limit=EPS, because="one rounding of the peak", **PEAK,
)  # fmt: skip
def tapered() -> float:
    return tabulated_error(TAPERED, (2**8, 2**11, 2**14), (0, 1, 2, 7, 33))


@FAMILY.case(
    "tabulated windows that end near zero, 2^18 to 2^20 points",
    allowed=3e-13, limit=EPS, because="one rounding of the peak", slow=True, **PEAK,
)  # fmt: skip
def tapered_long() -> float:
    return tabulated_error(TAPERED[:2], (2**18, 2**20), (1, 33))


@FAMILY.case(
    "tabulated windows with a step at their ends",
    allowed=2e-13, limit=EPS, because="one rounding; a kernel that is right to 1e-13", **PEAK,
)  # fmt: skip
def stepped() -> float:
    return tabulated_error(
        ("gaussian(300)", "kaiser(1)", "tukey(0.05)"), (2**10,), (0, 1, 2, 7, 33)
    )


LEAKING = ("footprint", "footprint_phase", "doppler", "leakage")
STRONG = {
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
    slow=True,
)
def sidelobes_of_many() -> float:
    worst = 0.0
    for name in ("hann", "hamming", "blackman", "rectangular"):
        one = shots(LEAKING, **STRONG, window=name)
        low, found = run_of_bins(one, 0)
        count = found.size
        top = int(np.argmax(found))
        near = {0, top - 30, top - 9, top - 3, top - 1, top, top + 2, top + 17, count - 1}
        chosen = sorted({k for k in near if 0 <= k < count})
        with mp.workdps(40):
            exact = magnitudes(one, 0, 0, [low + int(k) for k in chosen], image=False)
            errors = [abs(float(found[k]) - x) for k, x in zip(chosen, exact, strict=True)]
        worst = max(worst, float(max(errors) / found.max()))
    return worst


LEAKAGE = {
    "reference": "every bin in 30 digits, chances as mixtures of chi-square tails",
    "measure": "leakage",
    "allowed": 1e-6,
    "limit": 1e-10,
    "because": "magnitudes to 1e-11, times threshold over noise; the integral is meant to 1e-6",
}


@FAMILY.case("leakage of 600 bins, from 1e-12 to 1, many of each far below it", **LEAKAGE)
def leakage() -> float:
    return max(leakage_error("hann", 1280, 100.0), leakage_error("hamming", 1280, 1500.0))


@FAMILY.case("leakage of 2000 bins, most of them summed as an integral", slow=True, **LEAKAGE)
def leakage_far_off() -> float:
    return leakage_error("hamming", 2**12, 1000.0)


def leakage_error(name: str, size: int, metres: float) -> float:
    """Relative error of the leakage of a shot's up segment."""
    one = shots(LEAKING, window=name, fft_size=size, range=metres)
    found = find(one)[0]
    return abs(found[5, 0] / exact_leakage(one, int(found[4, 0])) - 1)


def exact_leakage(one: Any, exempted: int) -> float:
    """Chance that a bin of the up segment but those about the peak crosses, over noise alone."""
    sigma, level = float(one.bin_deviation[0]), float(one.threshold[0])
    with mp.workdps(30):
        bins = magnitudes(one, 0, 0, range(one.fft_size // 2 + 1), image=False)
        crossing = [k for k, x in enumerate(bins) if x >= min(level, max(bins))]
        exempt = {k + j for k in crossing for j in (-1, 0, 1)}
        assert len(exempt) == exempted
        beta = mp.mpf(level) / sigma
        below = -mp.expm1(-(beta**2) / 2)
        logs = [
            mp.log1p(-mixture(x / sigma, beta) / below)
            for k, x in enumerate(bins)
            if k not in exempt
        ]
        return float(-mp.expm1(mp.fsum(logs)))
