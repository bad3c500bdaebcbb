"""Points made ready for the spectrum: link budget, noise and geometry worked out.

Points that share their categories (architecture, window, law, sizes ...) are prepared together; a
footprint's geometry is worked out once and serves every point that has it, whatever its
radiometry.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from sweep.model import detection, footprint, link, noise, receiver, reflectance, waveform
from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.equivalent import AMPLITUDE_TOLERANCE, POWER_TOLERANCE, node_limits
from sweep.model.spectrum import tangents
from sweep.model.window import Window, canonical_name, window

Parameters = Mapping[str, float | int | str | np.ndarray]

LASER, CHIRP, TELESCOPE, RECEIVER, PROCESSING = (
    f"instrument.{part}." for part in ("laser", "chirp", "telescope", "receiver", "processing")
)
CATEGORIES = (
    RECEIVER + "architecture",
    PROCESSING + "window",
    PROCESSING + "bins_counted",
    PROCESSING + "fft_size",
    "target.reflectance_law",
    "footprint.phases",
    "footprint.beamlets",
)


class Footprints(NamedTuple):
    """Where beamlets fall and what they send back, in rows that points share."""

    row: np.ndarray
    """(n,) int64: the row of each point."""
    offset: np.ndarray
    """(rows, beamlets): (R_b - R_0) / R_0."""
    doppler: np.ndarray
    """(rows, beamlets): beta_b - beta_0, beta = 2 v_r / c."""
    echo: np.ndarray
    """(rows, beamlets): power fraction x backscatter [1/sr] x (R_0/R_b)^2, for reflectance 1."""


@dataclass(frozen=True, eq=False)
class Shots:
    """Points of one category, ready for the spectrum: link, noise and geometry worked out.

    Arrays are (n,) unless said otherwise; SI throughout.
    """

    architecture: str
    window: Window
    fft_size: int
    bins_counted: str
    incoherent: bool
    range: np.ndarray
    radial_velocity: np.ndarray
    bandwidth: np.ndarray
    duration: np.ndarray
    carriers: tuple[np.ndarray, np.ndarray, np.ndarray]
    sample_rate: np.ndarray
    acquisition_delay: np.ndarray
    beat_scale: np.ndarray
    detector_bandwidth: np.ndarray
    amplifier_bandwidth: np.ndarray
    noise_sources: dict[str, np.ndarray]
    noise_variance: np.ndarray
    bin_deviation: np.ndarray
    threshold: np.ndarray
    leakage_floor: np.ndarray
    row: np.ndarray
    offset: np.ndarray
    doppler: np.ndarray
    amplitude: np.ndarray

    @property
    def chirp_rate(self) -> np.ndarray:
        """Chirp rate S = B/T [Hz/s]."""
        return self.bandwidth / self.duration

    @property
    def beta(self) -> np.ndarray:
        """Doppler ratio 2 v_r / c."""
        return 2 * self.radial_velocity / SPEED_OF_LIGHT

    @property
    def footprint(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(R_b - R_0)/R_0, beta_b - beta_0, relative amplitude of beamlets, (rows, beamlets)."""
        return self.offset, self.doppler, self.amplitude

    @property
    def segments(self) -> np.ndarray:
        """Which of up, Doppler and down segment exist, (3,) bool."""
        return np.array([True, self.architecture != "direct", True])

    def point_table(self) -> np.ndarray:
        """Columns of :func:`sweep.model.segments.evaluate_segments`, (13, n)."""
        columns = (
            self.range, self.beta, self.chirp_rate, self.beat_scale, self.detector_bandwidth,
            self.amplifier_bandwidth, self.sample_rate, self.acquisition_delay, self.carriers[0],
            self.carriers[2], self.bin_deviation, self.threshold, self.leakage_floor,
        )  # fmt: skip
        return np.array(np.broadcast_arrays(*columns), dtype=float)

    def kernel(self) -> tuple:
        """What the spectrum needs to know of window and FFT, as the compiled code takes it."""
        w = self.window
        return (
            (self.fft_size, w.length),
            (w.coefficients, w.numerator, w.poles, w.edge, w.table),
            (w.sum, w.envelope, w.reach),
            node_limits(POWER_TOLERANCE if self.incoherent else AMPLITUDE_TOLERANCE),
            tangents(self.fft_size),
        )

    def counted_bins(self, exempted: np.ndarray) -> np.ndarray:
        """Bins that can raise a false alarm, given those that the detection occupies."""
        if self.bins_counted == "all":
            return np.full(np.shape(exempted), float(self.fft_size))
        return np.maximum(self.fft_size // 2 - exempted, 0.0)


def prepare(parameters: Parameters) -> Iterator[tuple[np.ndarray, Shots]]:
    """Splits points by category: (indices, :class:`Shots`) for each."""
    arrays = _arrays(parameters)
    size = max((a.size for a in arrays.values() if a.ndim), default=1)
    varying = [path for path in (*CATEGORIES, "record") if arrays[path].ndim]
    if not varying:
        yield np.arange(size), _shots(arrays, size, _plane(arrays, size))
        return
    codes = [np.unique(arrays[path], return_inverse=True)[1] for path in varying]
    _, member = np.unique(np.stack(codes), axis=1, return_inverse=True)
    member = member.ravel()
    for group in range(member.max() + 1):
        index = np.flatnonzero(member == group)
        chosen = {path: a[index] if a.ndim else a for path, a in arrays.items()}
        chosen |= {path: chosen[path][0] for path in varying}
        yield index, _shots(chosen, index.size, _plane(chosen, index.size))


def prepare_footprints(parameters: Parameters, footprints: Footprints) -> Shots:
    """Shots whose footprints are given, all of one category.

    Parameters
    ----------
    parameters : mapping
        As for :func:`sweep.model.shot.evaluate`, scalars or (n,) arrays. Ranges and radial
        velocities are those of the beam's centre; grazing angle and law are not looked at.
    footprints : Footprints
        One row number for each of the n points.
    """
    return _shots(_arrays(parameters), footprints.row.size, footprints)


def _arrays(parameters: Parameters) -> dict[str, np.ndarray]:
    """Parameters as arrays, with the length of the record among them."""
    arrays = {path: np.asarray(value) for path, value in parameters.items()}
    arrays["record"] = waveform.record_length(
        fft_size=arrays[PROCESSING + "fft_size"],
        duration=arrays[CHIRP + "duration"],
        acquisition_delay=arrays[PROCESSING + "acquisition_delay"],
        sample_rate=arrays[PROCESSING + "sample_rate"],
    )
    return arrays


def _shots(p: Mapping[str, np.ndarray], size: int, footprints: Footprints) -> Shots:
    """Link and noise of points that share their categories."""
    architecture = str(p[RECEIVER + "architecture"])
    shape = window(canonical_name(str(p[PROCESSING + "window"])), int(p["record"]))
    row, offset, doppler, echo = footprints
    power_scale, current_scale = _link_scales(architecture, p)
    sources = _noise_sources(architecture, p, power_scale * echo.sum(axis=1)[row])
    without_echo = np.asarray(sum(v for name, v in sources.items() if name != "signal_shot"))
    variance = without_echo + sources["signal_shot"]
    energy = np.asarray(shape.energy)
    quiet = noise.bin_deviation(noise_variance=without_echo, window_energy=energy)
    everywhere = np.zeros(size)
    return Shots(
        architecture=architecture,
        window=shape,
        fft_size=int(p[PROCESSING + "fft_size"]),
        bins_counted=str(p[PROCESSING + "bins_counted"]),
        incoherent=_incoherent(p),
        range=p["target.range"] + everywhere,
        radial_velocity=p["target.radial_velocity"] + everywhere,
        bandwidth=p[CHIRP + "bandwidth"],
        duration=p[CHIRP + "duration"],
        carriers=waveform.carrier_frequencies(
            architecture,
            wavelength=p[LASER + "wavelength"],
            start_frequency=p[CHIRP + "start_frequency"],
            bandwidth=p[CHIRP + "bandwidth"],
        ),
        sample_rate=p[PROCESSING + "sample_rate"] + everywhere,
        acquisition_delay=p[PROCESSING + "acquisition_delay"],
        beat_scale=current_scale * p[RECEIVER + "transimpedance"],
        **_receiver(p, "detector_bandwidth", "amplifier_bandwidth"),
        noise_sources=sources,
        noise_variance=variance + everywhere,
        bin_deviation=noise.bin_deviation(noise_variance=variance, window_energy=energy)
        + everywhere,
        threshold=detection.threshold(tnr=p[PROCESSING + "tnr"], bin_deviation=quiet) + everywhere,
        leakage_floor=p["accuracy.leakage_floor"],
        row=row,
        offset=offset,
        doppler=doppler,
        amplitude=echo if architecture == "direct" else np.sqrt(echo),
    )


def _link_scales(architecture: str, p: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Echo power [W] per backscatter of 1/sr, and the beat photocurrent [A] of that."""
    power_scale = link.echo_power_scale(
        power=p[LASER + "power"],
        aperture=p[TELESCOPE + "aperture"],
        optical_efficiency=p[TELESCOPE + "optical_efficiency"],
        reflectance=p["target.reflectance"],
        range=p["target.range"],
    )
    names = (
        "local_oscillator_power", "mixing_efficiency", "apd_gain", "responsivity",
        "modulation_index",
    )  # fmt: skip
    return power_scale, link.beat_scale(
        architecture, echo_power_scale=power_scale, **_receiver(p, *names)
    )


def _incoherent(p: Mapping[str, np.ndarray]) -> bool:
    """Whether beamlets add as powers; direct detection adds their radio-frequency beats."""
    coherent = str(p["footprint.phases"]) == "coherent"
    return not coherent and str(p[RECEIVER + "architecture"]) != "direct"


def _receiver(p: Mapping[str, np.ndarray], *names: str) -> dict[str, np.ndarray]:
    return {name: p[RECEIVER + name] for name in names}


def _plane(p: Mapping[str, np.ndarray], size: int) -> Footprints:
    """Footprints on a flat plane: one row for each distinct grazing angle and divergence."""
    grazing, divergence = np.broadcast_arrays(
        p["target.grazing_angle"], p[LASER + "beam_divergence"]
    )
    shapes, row = np.unique(
        np.stack([np.atleast_1d(grazing), np.atleast_1d(divergence)]), axis=1, return_inverse=True
    )
    offset, cos_incidence, weights = footprint.plane_footprint(
        grazing_angle=shapes[0],
        beam_divergence=shapes[1],
        number=int(p["footprint.beamlets"]),
        pattern="hexagonal" if _incoherent(p) else "sunflower",
    )
    law = str(p["target.reflectance_law"])
    echo = weights * reflectance.backscatter(law, cos_incidence) / (1 + offset) ** 2
    row = np.broadcast_to(row.ravel(), size).astype(np.int64)
    return Footprints(row, offset, np.zeros_like(offset), echo)


def _noise_sources(
    architecture: str, p: Mapping[str, np.ndarray], echo_power: np.ndarray
) -> dict[str, np.ndarray]:
    """Noise variance of each source at the ADC [V^2]."""
    bandwidth = receiver.electrical_bandwidth(
        **_receiver(p, "detector_bandwidth", "amplifier_bandwidth")
    )
    sun = noise.solar_power(
        solar_irradiance=p["target.solar_irradiance"],
        reflectance=p["target.reflectance"],
        aperture=p[TELESCOPE + "aperture"],
        beam_divergence=p[LASER + "beam_divergence"],
        optical_passband=p[RECEIVER + "optical_passband"],
        optical_efficiency=p[TELESCOPE + "optical_efficiency"],
    )
    currents = noise.current_variances(
        architecture,
        echo_power=echo_power,
        solar_power=sun,
        electrical_bandwidth=bandwidth,
        **_receiver(
            p, "local_oscillator_power", "apd_gain", "excess_noise_factor", "responsivity",
            "noise_equivalent_power", "amplifier_noise_current", "noise_figure",
            "load_resistance", "temperature",
        ),
    )  # fmt: skip
    gain = p[RECEIVER + "transimpedance"] ** 2
    return {source: np.asarray(value * gain) for source, value in currents.items()}
