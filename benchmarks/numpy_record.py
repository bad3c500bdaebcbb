"""Detect the echo of a plane in drawn records of an FMCW lidar, by NumPy alone.

This is the way of hand-written scripts and of radar simulators. Each shot has an up- and a
down-chirp. The beat of every scatterer is synthesised sample by sample from its exact delay. The
records take white noise, a window and an FFT, and the echo's bin is compared with a threshold.
Nothing of sweep is imported.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

SPEED_OF_LIGHT = 299_792_458.0
ELEMENTARY_CHARGE = 1.602176634e-19
BATCH_SAMPLES = 1 << 16
"""Samples of the records that are transformed together: 512 KiB, which a cache holds."""

BEAM_SIGMAS_MAX = 4.0
"""Largest angle of a scatterer off the beam's axis [standard deviations of the beam]."""


@dataclass(frozen=True)
class Lidar:
    """Numbers of a homodyne FMCW lidar above a plane, in SI units."""

    fft_size: int = 1024
    laser_power: float = 30e-3
    wavelength: float = 1550e-9
    beam_divergence: float = 100e-6
    """Full 1/e^2 angle of the beam [rad]."""
    bandwidth: float = 300e6
    sample_rate: float = 200e6
    acquisition_delay: float = 4e-6
    """Time from the start of a chirp to its first sample [s]."""
    aperture: float = 25e-3
    optical_efficiency: float = 0.5
    local_oscillator_power: float = 1e-3
    responsivity: float = 1.0
    receiver_bandwidth: float = 400e6
    """Bandwidth of the two low-passes, and of the noise [Hz]."""
    noise_equivalent_power: float = 5e-12
    amplifier_noise_current: float = 25e-9
    transimpedance: float = 7e3
    threshold_to_noise: float = 10.0
    """Threshold over the standard deviation of the magnitude of a bin of noise alone."""
    reflectance: float = 0.1
    grazing_angle: float = math.pi / 2
    radial_velocity: float = 10.0

    @property
    def chirp_duration(self) -> float:
        """Duration of each chirp [s]: the record ends with it."""
        return self.acquisition_delay + self.fft_size / self.sample_rate

    @property
    def window(self) -> np.ndarray:
        """Hamming window, periodic (N,)."""
        return np.hamming(self.fft_size + 1)[:-1]


class Detections(NamedTuple):
    """Numbers of shots in which the up-chirp, the down-chirp and both are detected."""

    up: int
    down: int
    shot: int


class PlaneRecords:
    """Records of shots at a plane: the beats of its scatterers, noise and threshold.

    Parameters
    ----------
    lidar : Lidar
        Instrument and plane.
    target_range : float
        Range along the beam at the start of a shot [m].
    n_scatterers : int
        Number of scatterers along the slope.
    """

    def __init__(self, lidar: Lidar, target_range: float, n_scatterers: int = 1) -> None:
        self.lidar = lidar
        angles, weights = beam_quadrature(lidar, n_scatterers)
        self._beats, self._echo_bins = [], []
        peak_powers = []
        for segment_start, chirp_sign in ((0.0, 1.0), (lidar.chirp_duration, -1.0)):
            beats = scatterer_beats(lidar, target_range, segment_start, chirp_sign, angles, weights)
            beats *= lidar.window
            quadratures = [np.abs(np.fft.rfft(part)) ** 2 for part in (beats.real, beats.imag)]
            mean_power = np.mean(quadratures, axis=0).sum(axis=0)
            self._beats.append(beats)
            self._echo_bins.append(int(np.argmax(mean_power)))
            peak_powers.append(float(np.max(mean_power)))
        noise_variance = receiver_noise_variance(lidar, target_range)
        bin_sigma = math.sqrt(noise_variance * np.sum(lidar.window**2) / 2)
        self.snr = np.array(peak_powers) / (2 * bin_sigma**2)
        """Mean power of the echo over that of noise in its bin, up- and down-chirp (2,)."""
        self._windowed_noise_sigma = math.sqrt(noise_variance) * lidar.window
        self._threshold = lidar.threshold_to_noise * bin_sigma * math.sqrt(2 - math.pi / 2)

    def count_detections(
        self, n_shots: int, generator: np.random.Generator, *, is_in_speckle: bool
    ) -> Detections:
        """Draw shots and count those that are detected.

        In speckle each scatterer has a circular complex Gaussian amplitude in every shot, common to
        both chirps. Without speckle the echo is the same in all shots.
        """
        batch_shots = max(1, BATCH_SAMPLES // self.lidar.fft_size)
        counts = np.zeros(3, np.int64)
        for first_shot in range(0, n_shots, batch_shots):
            size = min(batch_shots, n_shots - first_shot)
            n_scatterers = len(self._beats[0])
            amplitudes = (
                generator.standard_normal((2, size, n_scatterers)) * math.sqrt(0.5)
                if is_in_speckle
                else None
            )
            up, down = (
                self._detect_segment(segment, size, generator, amplitudes) for segment in (0, 1)
            )
            counts += [np.count_nonzero(up), np.count_nonzero(down), np.count_nonzero(up & down)]
        return Detections(*map(int, counts))

    def _detect_segment(
        self,
        segment: int,
        n_shots: int,
        generator: np.random.Generator,
        amplitudes: np.ndarray | None,
    ) -> np.ndarray:
        """Return whether each of some shots is detected in a segment, (n_shots,) bool."""
        beats = self._beats[segment]
        records = generator.standard_normal((n_shots, self.lidar.fft_size))
        records *= self._windowed_noise_sigma
        if amplitudes is None:
            records += beats.real.sum(axis=0)
        else:
            records += amplitudes[0] @ beats.real
            records -= amplitudes[1] @ beats.imag
        spectra = np.fft.rfft(records, axis=1)
        return np.abs(spectra[:, self._echo_bins[segment]]) >= self._threshold


def beam_quadrature(lidar: Lidar, n_scatterers: int) -> tuple[np.ndarray, np.ndarray]:
    """Return angles off the axis along the slope [rad] and fractions of power, (n_scatterers,)."""
    if n_scatterers == 1:
        return np.zeros(1), np.ones(1)
    sigmas = np.linspace(-BEAM_SIGMAS_MAX, BEAM_SIGMAS_MAX, n_scatterers)
    weights = np.exp(-(sigmas**2) / 2)
    return sigmas * lidar.beam_divergence / 4, weights / weights.sum()


def scatterer_beats(
    lidar: Lidar,
    target_range: float,
    segment_start: float,
    chirp_sign: float,
    angles: np.ndarray,
    weights: np.ndarray,
) -> np.ndarray:
    """Compute the beats of scatterers at the ADC, as analytic signals [V], (scatterers, N).

    The phase is that of the light now less that of the light sent a delay tau(t) earlier.
    """
    time = lidar.acquisition_delay + np.arange(lidar.fft_size) / lidar.sample_rate
    grazing_angle = lidar.grazing_angle
    ranges = target_range * math.sin(grazing_angle) / np.sin(grazing_angle + angles)
    delay = 2 / SPEED_OF_LIGHT * (
        ranges[:, None] - lidar.radial_velocity * (segment_start + time)
    )  # fmt: skip
    chirp_rate = chirp_sign * lidar.bandwidth / lidar.chirp_duration
    carrier = SPEED_OF_LIGHT / lidar.wavelength + (lidar.bandwidth if chirp_sign < 0 else 0.0)
    cycles = carrier * delay + chirp_rate * (time * delay - delay**2 / 2)
    beat_frequency = carrier * 2 * lidar.radial_velocity / SPEED_OF_LIGHT - chirp_rate * delay[:, 0]
    receiver_gain = 1 / (1 + (beat_frequency / lidar.receiver_bandwidth) ** 2)
    amplitudes = beat_amplitude(lidar, ranges, np.sin(grazing_angle + angles) * weights)
    return (amplitudes * receiver_gain)[:, None] * np.exp(2j * np.pi * (cycles - np.rint(cycles)))


def echo_power(lidar: Lidar, ranges: np.ndarray, echo_fraction: np.ndarray) -> np.ndarray:
    """Return the power of echoes of a Lambertian plane [W]."""
    area = math.pi * (lidar.aperture / 2) ** 2
    power = lidar.laser_power * lidar.optical_efficiency * lidar.reflectance * area
    return power / np.pi / ranges**2 * echo_fraction


def beat_amplitude(lidar: Lidar, ranges: np.ndarray, echo_fraction: np.ndarray) -> np.ndarray:
    """Return the amplitudes of beats at the ADC [V]."""
    light = np.sqrt(lidar.local_oscillator_power * echo_power(lidar, ranges, echo_fraction))
    return 2 * lidar.responsivity * lidar.transimpedance * light


def receiver_noise_variance(lidar: Lidar, target_range: float) -> float:
    """Return the variance of the noise of a sample [V^2], all of it white."""
    axis_echo = echo_power(lidar, np.array(target_range), np.sin(np.array(lidar.grazing_angle)))
    light = lidar.local_oscillator_power + float(axis_echo)
    shot_variance = 2 * ELEMENTARY_CHARGE * lidar.responsivity * light * lidar.receiver_bandwidth
    detector_variance = (
        lidar.responsivity * lidar.noise_equivalent_power
    ) ** 2 * lidar.receiver_bandwidth
    variance = shot_variance + detector_variance + lidar.amplifier_noise_current**2
    return variance * lidar.transimpedance**2
