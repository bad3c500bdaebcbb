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
CHIRP_SLOPE_SIGNS = {"up": 1.0, "doppler": 0.0, "down": -1.0}
FFT_FROM_BINS = 5
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
    footprint_slide_speed: float = 0.0
    """Speed at which the range falls beyond the scatterers' radial velocity [m/s].

    The beam slides over the ground, and other scatterers of the same mean power take the places of
    those that leave it."""


def scatterer_delays(
    facet: Facet, n_scatterers: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Delay at the shot's start [s] and Doppler ratio 2 v / c of scatterers, (number,) each.

    Along the slope there is one scatterer in each of as many strata of equal echo power; across it
    they are random. All have the same mean power.
    """
    along_slope = facet.beam_deviation * ndtri(
        (np.arange(n_scatterers) + rng.random(n_scatterers)) / n_scatterers
    )
    across_slope = facet.beam_deviation * rng.normal(size=n_scatterers)
    # The facet contains the point R on the axis; positive `along` is towards the far side.
    range_on_axis = facet.range + along_slope / np.tan(facet.grazing_angle)
    distance = np.hypot(range_on_axis, np.hypot(along_slope, across_slope))
    closing_speed_times_range = (
        facet.radial_velocity * range_on_axis - facet.transverse_velocity * along_slope
    )
    return 2 * distance / SPEED_OF_LIGHT, 2 * closing_speed_times_range / distance / SPEED_OF_LIGHT


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
    chirp_rate = CHIRP_SLOPE_SIGNS[segment] * facet.bandwidth / facet.duration
    carrier = carrier_frequency(facet, segment)
    tau_0, beta = delay[:, None], doppler[:, None]
    tau = tau_0 - (beta + 2 * facet.footprint_slide_speed / SPEED_OF_LIGHT) * (start + time)
    # Whole cycles go first: float64 cannot hold them together with their fraction.
    cycles = -np.mod(carrier * tau_0, 1.0) + carrier * beta * (start + time)
    cycles += chirp_rate * tau * (tau / 2 - time)
    echo_exists = (time >= tau) & (time <= facet.duration)
    record = facet.window * echo_exists * np.exp(2j * np.pi * np.mod(cycles, 1.0))
    if bins.size < FFT_FROM_BINS:
        transform = np.exp(
            -2j * np.pi * (np.outer(samples, bins) % facet.fft_size) / facet.fft_size
        )
        return record @ transform, record @ transform.conj()
    spectrum = np.fft.fft(record, facet.fft_size)
    return spectrum[:, bins % facet.fft_size], spectrum[:, -bins % facet.fft_size]


def noise_covariance_root(facet: Facet, bins: np.ndarray) -> np.ndarray:
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


class SpectrumDraws(NamedTuple):
    """Draws of the spectra of several looks of a shot, by segment."""

    values: dict[str, np.ndarray]
    """(draws, looks, k): complex X of some bins, noise included."""
    mean_power: dict[str, np.ndarray]
    """(k,): mean of |X|^2 over speckle and looks, without noise."""


def draw_spectra(
    facet: Facet,
    *,
    bins: Mapping[str, np.ndarray],
    amplitude_by_segment: Mapping[str, float],
    noise_deviation: float,
    draws: int,
    seed: int,
    speckle: str = "motion",
    scatterers: int = 96,
    n_scatterer_sets: int = 8,
) -> Iterator[SpectrumDraws]:
    """Yield batches of drawn shots.

    Parameters
    ----------
    bins
        By segment, (k,); of complex records signed.
    amplitude_by_segment
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
    draws_per_set = draws // n_scatterer_sets
    for _ in range(n_scatterer_sets):
        delay, doppler = scatterer_delays(facet, scatterers, rng)
        shape = (facet.looks if speckle == "independent" else 1, draws_per_set, scatterers)
        scatterer_amplitudes = rng.normal(size=shape) + 1j * rng.normal(size=shape)
        scatterer_amplitudes /= np.sqrt(2 * scatterers)
        values, mean_power = {}, {}
        for segment in facet.segments:
            noise_root = noise_deviation * noise_covariance_root(facet, bins[segment])
            spectra_by_look, power = [], np.zeros(bins[segment].size)
            for look in range(facet.looks):
                if look == 0 or speckle == "motion":
                    at_bins, at_negatives = scatterer_spectra(
                        facet, segment, bins[segment], delay, doppler, look
                    )
                power += (np.abs(at_bins) ** 2).mean(axis=0)
                if not facet.complex_record:
                    power += (np.abs(at_negatives) ** 2).mean(axis=0)
                look_amplitudes = scatterer_amplitudes[look if speckle == "independent" else 0]
                echo = look_amplitudes @ at_bins
                if not facet.complex_record:
                    echo += np.conj(look_amplitudes @ at_negatives)
                noise_parts = rng.normal(size=(draws_per_set, noise_root.shape[1])) @ noise_root.T
                noise = (
                    noise_parts[:, : bins[segment].size] + 1j * noise_parts[:, bins[segment].size :]
                )
                spectra_by_look.append(amplitude_by_segment[segment] / 2 * echo + noise)
            mean_power[segment] = amplitude_by_segment[segment] ** 2 / 4 * power / facet.looks
            values[segment] = np.stack(spectra_by_look, axis=1)
        yield SpectrumDraws(values, mean_power)


def carrier_frequency(facet: Facet, segment: str) -> float:
    """Optical frequency at the start of a segment [Hz]."""
    return SPEED_OF_LIGHT / facet.wavelength + (
        facet.bandwidth if CHIRP_SLOPE_SIGNS[segment] < 0 else 0.0
    )


def echo_beat(facet: Facet, segment: str) -> float:
    """Beat frequency of a scatterer on the beam's axis in the middle of the record [Hz]."""
    tau = 2 * facet.range / SPEED_OF_LIGHT
    beta = 2 * facet.radial_velocity / SPEED_OF_LIGHT
    chirp_rate = CHIRP_SLOPE_SIGNS[segment] * facet.bandwidth / facet.duration
    start = facet.segments.index(segment) * (facet.duration + facet.gap)
    middle = facet.acquisition_delay + facet.window.size / facet.sample_rate / 2
    beat = carrier_frequency(facet, segment) * beta - chirp_rate * (tau - beta * start) * (1 + beta)
    return beat + chirp_rate * 2 * beta * middle


def echo_bins(facet: Facet, segment: str, half_width_bins: int) -> np.ndarray:
    """Bins within ``half_width_bins`` of the middle of the echo, if the spectrum has them, (k,)."""
    cycles_per_sample = echo_beat(facet, segment) / facet.sample_rate
    size = facet.fft_size
    if facet.complex_record:
        centre = round((cycles_per_sample - np.rint(cycles_per_sample)) * size)
        return np.arange(centre - half_width_bins, centre + half_width_bins + 1)
    centre = round(abs(cycles_per_sample - np.rint(cycles_per_sample)) * size)
    return np.arange(max(centre - half_width_bins, 0), min(centre + half_width_bins, size // 2) + 1)
