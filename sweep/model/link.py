"""Receiver: its poles and filter, and the noise in the photocurrent and at the ADC."""

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from sweep.model.constants import BOLTZMANN, ELEMENTARY_CHARGE

RECEIVER = "instrument.receiver."
ARCHITECTURES = ("homodyne", "heterodyne", "direct")


def aperture_area(aperture: np.ndarray) -> np.ndarray:
    """Area of a circular aperture [m^2] from its diameter [m], [T 4.3]."""
    return math.pi * (np.asarray(aperture) / 2) ** 2


def shot_noise(
    *,
    power: np.ndarray | float,
    apd_gain: np.ndarray,
    excess_noise_factor: np.ndarray,
    responsivity: np.ndarray,
    electrical_bandwidth: np.ndarray,
) -> np.ndarray:
    """Compute current variance 2 q M^2 F Re P B_e [A^2] of light of power P [W] on the detector."""
    gain = np.asarray(apd_gain) ** 2 * excess_noise_factor
    return 2 * ELEMENTARY_CHARGE * gain * responsivity * power * electrical_bandwidth


class ReceiverNoise(NamedTuple):
    """Variances at the ADC [V^2]."""

    per_ampere: np.ndarray
    """Of 1 A^2 of current."""
    per_watt: np.ndarray
    """Of the shot noise of 1 W of light."""
    sources: dict[str, np.ndarray]
    """Of the receiver's own, by source."""


ANTIALIAS = {"antialias_bandwidth": 0.0, "antialias_order": 6.0}
"""Parameters of the filter before the ADC, none by default, which points need not have."""

_FOLDS = 32
"""Aliases on either side that pass an anti-alias filter: of order 3 and a bandwidth of the whole
sample rate those beyond have 1e-8 of the density."""

_STOPPED = 345.0
"""Natural logarithm of the most that such a filter takes from a power: nothing becomes 0."""


def receiver_noise(
    architecture: str, v: Mapping[str, np.ndarray], in_quadrature: bool = False
) -> ReceiverNoise:
    """Noise of receivers of an architecture, from :func:`receiver_values`, (n,) or scalars.

    The local oscillator's shot noise, the detector's own (M Re NEP)^2 B_e, the amplifier's rms
    current squared. Direct detection has no local oscillator and adds its load's thermal noise,
    4 k T B_e / R_L [T 2.22]. A heterodyne receiver mixes an IF down: noise from both sides of the
    IF lands in the record, which makes the shot-limited SNR Re P / (2 q B_e) [T 2.23], half the
    homodyne's. Its RF noise figure multiplies all of it.

    ``in_quadrature``: of two receivers that sample I and Q, as the noise of a bin of a real record.
    A 90 degree hybrid gives each of them half of echo and local oscillator, and the bins of I + iQ
    show a line as those of a real record do. Shot noise is the same altogether, each one's own
    noise twice as much; that of currents which go with the light, a quarter of the variance each,
    is half.
    """
    bandwidth = electrical_bandwidth(v)
    light = {name: v[name] for name in ("apd_gain", "excess_noise_factor", "responsivity")}
    detector = (v["apd_gain"] * v["responsivity"] * v["noise_equivalent_power"]) ** 2 * bandwidth
    # what the anti-alias filter leaves of the rms
    passed = bandwidth / np.minimum(v["detector_bandwidth"], v["amplifier_bandwidth"])
    own = {"detector": detector, "amplifier": v["amplifier_noise_current"] ** 2 * passed}
    if architecture == "direct":
        thermal = 4 * BOLTZMANN * v["temperature"] * bandwidth / v["load_resistance"]
        own = own | {"thermal": thermal}
    else:
        power = v["local_oscillator_power"]
        oscillator = shot_noise(power=power, electrical_bandwidth=bandwidth, **light)
        own = {"local_oscillator_shot": oscillator} | own
    both_sides = 2.0 * v["noise_figure"] if architecture == "heterodyne" else 1.0
    scale = np.asarray(both_sides * v["transimpedance"] ** 2)
    per_watt = shot_noise(power=1.0, electrical_bandwidth=bandwidth, **light)
    sources = {source: np.asarray(value * scale) for source, value in own.items()}
    if in_quadrature:
        for name in sources.keys() - {"local_oscillator_shot"}:
            sources[name] = 2 * sources[name]
    per_ampere = scale / 2 if in_quadrature else scale
    return ReceiverNoise(per_ampere, np.asarray(per_watt * scale), sources)


def rounding_variance(
    *, full_scale: ArrayLike, bits: ArrayLike, in_quadrature: bool = False
) -> np.ndarray:
    """Variance lsb^2/12 [V^2] that rounding adds at the ADC, lsb = 2 V / 2^bits; 0 for 0 bits.

    If the noise's deviation s spans a step or so the error is white and independent of the signal
    [Widrow and Kollar, Quantization Noise, 2008, ch. 4, 9]: it departs from that by exp(-2 pi^2 s^2
    / lsb^2), 2.7e-9 for s = lsb and 0.7 % for s = lsb/2. Neither the receiver's gain nor its noise
    figure acts on it. ``full_scale`` is the largest voltage V [V] to either side; the effective
    number of bits, which need not be whole, makes the noise of a real ADC. Two ADCs sample I and Q.
    """
    bits = np.asarray(bits, float)
    step = 2 * np.asarray(full_scale, float) * 2.0**-bits
    return np.where(bits > 0, (2 if in_quadrature else 1) * (step**2 / 12), 0.0)


def bin_deviation(*, noise_variance: np.ndarray, window_energy: np.ndarray) -> np.ndarray:
    """Noise sigma of a bin, per quadrature: sqrt(E_w sigma_x^2 / 2), [T 3.2]."""
    return np.sqrt(window_energy * noise_variance / 2)


def transfer(
    frequency: np.ndarray,
    *,
    detector_bandwidth: np.ndarray,
    amplifier_bandwidth: np.ndarray,
) -> np.ndarray:
    """Complex transfer of the receiver at a signed frequency [Hz], over that at DC.

    Two single-pole low-passes, each 3 dB down at its stated bandwidth. Lines are taken at the
    frequency they have before the ADC folds them.
    """
    poles = (1 + 1j * frequency / detector_bandwidth) * (1 + 1j * frequency / amplifier_bandwidth)
    return 1 / poles


def electrical_bandwidth(values: Mapping[str, np.ndarray]) -> np.ndarray:
    """Bandwidth B_e [Hz] over which noise is counted: the narrowest of all stages.

    [T] states one figure for detector and amplifier and uses it as the noise bandwidth; so does
    this. An anti-alias filter counts as a further stage.
    """
    narrower = np.minimum(values["detector_bandwidth"], values["amplifier_bandwidth"])
    antialias = antialias_of(values)
    return np.minimum(narrower, antialias["antialias_bandwidth"]) if antialias else narrower


def receiver_values(p: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Parameters of the receiver, by their names alone."""
    return {
        path.removeprefix(RECEIVER): value for path, value in p.items() if path.startswith(RECEIVER)
    }


def antialias_of(values: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Parameters of the filter before the ADC, of the receiver's; empty without one."""
    found = {name: np.asarray(values.get(name, v)) for name, v in ANTIALIAS.items()}
    return found if np.any(found["antialias_bandwidth"]) else {}


def antialias_power(
    frequency: np.ndarray, *, antialias_bandwidth: np.ndarray, antialias_order: np.ndarray
) -> np.ndarray:
    """Power that passes the anti-alias filter at a signed frequency [Hz], before it folds.

    A Butterworth low-pass of order n, 3 dB down at its bandwidth B [Hz]: 1 / (1 + (f / B)^(2 n)).

    >>> given = {"antialias_bandwidth": np.array(1e8), "antialias_order": np.array(6)}
    >>> [round(10 * float(np.log10(antialias_power(f, **given))), 1) for f in (5e7, 1e8, 2e8)]
    [-0.0, -3.0, -36.1]
    """
    with np.errstate(divide="ignore"):  # ln 0 at DC
        steepness = np.log(np.abs(frequency) / antialias_bandwidth)
    return np.asarray(1 / (1 + np.exp(np.minimum(2 * antialias_order * steepness, _STOPPED))))


def noise_density(
    frequency: np.ndarray, *, sample_rate: np.ndarray, **filters: np.ndarray
) -> np.ndarray:
    """Density of the noise in a record, over that of white noise of the same sources.

    The sources' noise passes |H|^2 and folds: f_s / (2 B_e) sum_m |H(f + m f_s)|^2 at a frequency f
    [Hz] of any sign, folded or not. With a = 2 pi B / f_s a single pole's sum is

        sum_m 1 / (1 + (f + m f_s)^2 / B^2) = (a / 2) sinh a / (cosh a - cos(2 pi f / f_s))

    and that of two poles follows by partial fractions, or by the derivative where they are equal.
    Behind an anti-alias filter |H|^2 has its power too, and aliases are summed one by one.
    """
    poles = {
        name: np.asarray(filters[name], float)
        for name in ("detector_bandwidth", "amplifier_bandwidth")
    }
    if antialias := antialias_of(filters):
        folded = frequency - sample_rate * np.rint(frequency / sample_rate)
        total = np.zeros(())
        for fold in range(-_FOLDS, _FOLDS + 1):
            alias = folded + fold * sample_rate
            passed = transfer(alias, **poles)
            total = total + np.abs(passed) ** 2 * antialias_power(alias, **antialias)
        return total * sample_rate / (2 * electrical_bandwidth(filters))
    one, other = poles.values()
    cosine = np.cos(2 * np.pi * (np.asarray(frequency) / sample_rate))
    alike = np.abs(one - other) <= 1e-4 * np.minimum(one, other)
    first, slope = _pole(2 * np.pi * np.where(alike, (one + other) / 2, one) / sample_rate, cosine)
    second, _ = _pole(2 * np.pi * other / sample_rate, cosine)
    ratio = np.where(alike, 0.5, np.square(other / one))
    with np.errstate(over="ignore", invalid="ignore"):
        apart = np.where(np.isinf(ratio), first, (ratio * first - second) / (ratio - 1))
    total = np.where(alike, first - slope, apart)
    folded = np.arccos(np.clip(cosine, -1, 1)) * sample_rate / (2 * np.pi)
    direct = 1 / ((1 + (folded / one) ** 2) * (1 + (folded / other) ** 2))  # where all else rounds
    return np.asarray(np.maximum(total, direct) * sample_rate / (2 * np.minimum(one, other)))


def _pole(a: np.ndarray, cosine: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sum s over the aliases of a single pole, a > 0, and (a / 2) ds/da."""
    q, rest = np.exp(-a), -np.expm1(-a)
    below = rest * rest + 2 * q * (1 - cosine)
    tangent = rest * (2 - rest) / below
    change = 2 * q * (2 * q - cosine * (1 + q * q)) / below**2
    return a / 2 * tangent, a / 4 * (tangent + a * change)
