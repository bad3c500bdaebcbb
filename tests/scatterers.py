"""Monte Carlo of scatterers on a tilted facet, an independent truth for speckle on slopes.

The facet is covered with scatterers of circular complex Gaussian reflectance. Each has its exact
delay in every sample of every segment. Records are windowed and transformed by FFT; noise has the
exact covariance that white noise has in windowed bins. Nothing of the package is imported.

The echo is linear in the scatterers' amplitudes. So the spectrum of each scatterer alone is
computed once, by the FFT of its record, and a draw is a sum of these with new amplitudes.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import ndtri

SPEED_OF_LIGHT = 299_792_458.0
SEGMENTS = ("up", "doppler", "down")
SLOPES = {"up": 1.0, "doppler": 0.0, "down": -1.0}
FFT_BINS_MIN = 5
"""Bins from which an FFT is faster than a sum for every bin."""


@dataclass(frozen=True, kw_only=True)
class Facet:
    """A beam on a tilted plane, and the waveform and records of the lidar that sends it; SI."""

    range: float
    """Of the facet on the beam's axis at the start of the shot [m]."""
    grazing_angle: float
    """Between beam and facet [rad]."""
    beam_deviation: float
    """Standard deviation, on each axis, of the two-way beam on a plane across it [m]."""
    wavelength: float
    bandwidth: float
    duration: float
    """Of a segment [s]."""
    sample_rate: float
    fft_size: int
    window: np.ndarray
    """(L,): weights of the record's samples."""
    acquisition_delay: float = 0.0
    """Start of the record in its segment [s]."""
    radial_velocity: float = 0.0
    """Closing speed on the beam's axis [m/s]."""
    transverse_velocity: float = 0.0
    """Speed of the instrument towards the near side of the facet [m/s]."""
    segments: tuple[str, ...] = SEGMENTS
    """In the order of time."""
    gap: float = 0.0
    complex_record: bool = False
    looks: int = 1
    """Waveforms that follow one another."""
    slide: float = 0.0
    """Speed at which the range falls beyond the scatterers' radial velocity [m/s].

    The beam slides over the ground, and other scatterers of the same mean power take the places of
    those that leave it."""


def scatterer_delays(
    facet: Facet, number: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Delay at the shot's start [s] and Doppler ratio 2 v / c of scatterers, (number,) each.

    Along the slope there is one scatterer in each of as many strata of equal echo power; across it
    they are random. All have the same mean power.
    """
    along = facet.beam_deviation * ndtri((np.arange(number) + rng.random(number)) / number)
    across = facet.beam_deviation * rng.normal(size=number)
    # The facet contains the point R on the axis; positive `along` is towards the far side.
    depth = facet.range + along / np.tan(facet.grazing_angle)
    distance = np.hypot(depth, np.hypot(along, across))
    closing = facet.radial_velocity * depth - facet.transverse_velocity * along
    return 2 * distance / SPEED_OF_LIGHT, 2 * closing / distance / SPEED_OF_LIGHT


def scatterer_spectra(
    facet: Facet,
    segment: str,
    bins: np.ndarray,
    delay: np.ndarray,
    doppler: np.ndarray,
    look: int = 0,
) -> tuple[np.ndarray, np.ndarray]:
    """Windowed transforms of each scatterer's analytic beat at the bins and at their negatives.

    Returns two arrays (scatterers, k): ``sum_n w e^{i psi} e^{-2 pi i k n / N}`` and the same with
    +k. An echo exists from its own delay on, and while the segment lasts.
    """
    samples = np.arange(facet.window.size)
    time = facet.acquisition_delay + samples / facet.sample_rate
    start = facet.segments.index(segment) + look * len(facet.segments)
    start *= facet.duration + facet.gap
    slope = SLOPES[segment] * facet.bandwidth / facet.duration
    carrier = carrier_frequency(facet, segment)
    tau_0, beta = delay[:, None], doppler[:, None]
    tau = tau_0 - (beta + 2 * facet.slide / SPEED_OF_LIGHT) * (start + time)
    # Whole cycles go first: float64 cannot hold them together with their fraction.
    cycles = -np.mod(carrier * tau_0, 1.0) + carrier * beta * (start + time)
    cycles += slope * tau * (tau / 2 - time)
    exists = (time >= tau) & (time <= facet.duration)
    record = facet.window * exists * np.exp(2j * np.pi * np.mod(cycles, 1.0))
    if bins.size < FFT_BINS_MIN:
        turned = np.exp(-2j * np.pi * (np.outer(samples, bins) % facet.fft_size) / facet.fft_size)
        return record @ turned, record @ turned.conj()
    spectrum = np.fft.fft(record, facet.fft_size)
    return spectrum[:, bins % facet.fft_size], spectrum[:, -bins % facet.fft_size]


def noise_factor(facet: Facet, bins: np.ndarray) -> np.ndarray:
    """Matrix (2 k, r) that makes real and imaginary parts of bins from unit normal numbers.

    Of white noise of unit variance in each sample, real, or in I and Q each half.
    """
    angle = 2 * np.pi * np.outer(bins, np.arange(facet.window.size)) / facet.fft_size
    cosine, sine = facet.window * np.cos(angle), facet.window * np.sin(angle)
    if facet.complex_record:
        basis = np.block([[cosine, sine], [-sine, cosine]]) / np.sqrt(2)
    else:
        basis = np.vstack([cosine, -sine])
    values, vectors = np.linalg.eigh(basis @ basis.T)
    return vectors * np.sqrt(np.maximum(values, 0.0))


class Records(NamedTuple):
    """Draws of the spectra of several looks of a shot, by segment."""

    values: dict[str, np.ndarray]
    """(draws, looks, k): complex X of some bins, noise included."""
    mean_power: dict[str, np.ndarray]
    """(k,): mean of |X|^2 over speckle and looks, without noise."""


def draw_records(
    facet: Facet,
    *,
    bins: Mapping[str, np.ndarray],
    amplitude: Mapping[str, float],
    noise_deviation: float,
    draws: int,
    seed: int,
    speckle: str = "motion",
    scatterers: int = 96,
    renewals: int = 8,
) -> Iterator[Records]:
    """Yield batches of drawn shots.

    Parameters
    ----------
    bins
        By segment, (k,); of complex records signed.
    amplitude
        By segment, root of the mean square amplitude of the beat [V]: the record is ``amplitude
        cos(psi)`` of a single line whose power is that of the whole echo.
    noise_deviation
        Of white noise in a sample of a real record, or of I and Q together [V].
    draws
        Shots in all, divided among the renewals of the scatterers' places.
    speckle
        Speckle of looks: as the ``motion`` from one to the next changes it, ``common`` to all, or
        ``independent``.
    """
    rng = np.random.default_rng(seed)
    number = draws // renewals
    for _ in range(renewals):
        delay, doppler = scatterer_delays(facet, scatterers, rng)
        shape = (facet.looks if speckle == "independent" else 1, number, scatterers)
        waves = rng.normal(size=shape) + 1j * rng.normal(size=shape)
        waves /= np.sqrt(2 * scatterers)
        values, mean_power = {}, {}
        for segment in facet.segments:
            factor = noise_deviation * noise_factor(facet, bins[segment])
            records, power = [], np.zeros(bins[segment].size)
            for look in range(facet.looks):
                if look == 0 or speckle == "motion":
                    at_bins, at_negatives = scatterer_spectra(
                        facet, segment, bins[segment], delay, doppler, look
                    )
                power += (np.abs(at_bins) ** 2).mean(axis=0)
                if not facet.complex_record:
                    power += (np.abs(at_negatives) ** 2).mean(axis=0)
                wave = waves[look if speckle == "independent" else 0]
                echo = wave @ at_bins
                if not facet.complex_record:
                    echo += np.conj(wave @ at_negatives)
                parts = rng.normal(size=(number, factor.shape[1])) @ factor.T
                noise = parts[:, : bins[segment].size] + 1j * parts[:, bins[segment].size :]
                records.append(amplitude[segment] / 2 * echo + noise)
            mean_power[segment] = amplitude[segment] ** 2 / 4 * power / facet.looks
            values[segment] = np.stack(records, axis=1)
        yield Records(values, mean_power)


def carrier_frequency(facet: Facet, segment: str) -> float:
    """Optical frequency at the start of a segment [Hz]."""
    return SPEED_OF_LIGHT / facet.wavelength + (facet.bandwidth if SLOPES[segment] < 0 else 0.0)


def echo_beat(facet: Facet, segment: str) -> float:
    """Beat frequency of a scatterer on the beam's axis in the middle of the record [Hz]."""
    tau = 2 * facet.range / SPEED_OF_LIGHT
    beta = 2 * facet.radial_velocity / SPEED_OF_LIGHT
    slope = SLOPES[segment] * facet.bandwidth / facet.duration
    start = facet.segments.index(segment) * (facet.duration + facet.gap)
    middle = facet.acquisition_delay + facet.window.size / facet.sample_rate / 2
    beat = carrier_frequency(facet, segment) * beta - slope * (tau - beta * start) * (1 + beta)
    return beat + slope * 2 * beta * middle


def echo_bins(facet: Facet, segment: str, reach: int) -> np.ndarray:
    """Bins within ``reach`` of the middle of the echo, as far as the spectrum has them, (k,)."""
    cycles = echo_beat(facet, segment) / facet.sample_rate
    size = facet.fft_size
    if facet.complex_record:
        centre = round((cycles - np.rint(cycles)) * size)
        return np.arange(centre - reach, centre + reach + 1)
    centre = round(abs(cycles - np.rint(cycles)) * size)
    return np.arange(max(centre - reach, 0), min(centre + reach, size // 2) + 1)
