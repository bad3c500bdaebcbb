"""Spectra of one shot with what is detected in them."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np

from sweep.model import shot as model
from sweep.model import waveform, window
from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.effects.catalogue import CORE
from sweep.model.segments import spectrum as segment_spectrum
from sweep.model.shot import prepare

Parameters = Mapping[str, float | int | str]

NAMES = ("up-chirp", "Doppler", "down-chirp")


@dataclass(frozen=True)
class Group:
    """Adjacent bins above the threshold: the first, the last, and the strongest of them."""

    first: int
    last: int
    peak: int


@dataclass(frozen=True)
class Segment:
    """Spectrum of a segment and what is found in it.

    Attributes
    ----------
    name, sign
        Up-chirp, Doppler or down-chirp; sign of the chirp rate.
    frequency, signal, magnitude : (m,) ndarray
        Of each bin [Hz]; |X| there of the signal alone, and with the noise where it is drawn [V].
    beat : float
        Signed beat frequency [Hz].
    carrier : float
        Optical frequency at the segment's start [Hz].
    groups : tuple of Group
        Bins above the threshold.
    snr, pd : float
        Of the strongest bin without noise; probability of its detection.
    """

    name: str
    sign: int
    frequency: np.ndarray
    signal: np.ndarray
    magnitude: np.ndarray
    beat: float
    carrier: float
    groups: tuple[Group, ...]
    snr: float
    pd: float

    @property
    def peak(self) -> int:
        """Strongest bin."""
        return int(np.argmax(self.magnitude))


@dataclass(frozen=True)
class Shot:
    """One shot: its parameters, levels, spectra, and what it reports."""

    label: str
    parameters: Parameters
    prepared: model.Shots
    outputs: dict[str, float]
    segments: tuple[Segment, ...]
    range: float
    radial_velocity: float

    @property
    def deviation(self) -> float:
        """Noise of a bin, per quadrature [V]."""
        return float(self.prepared.bin_deviation[0])

    @property
    def threshold(self) -> float:
        """Detection threshold on |X| [V]."""
        return float(self.prepared.threshold[0])

    @property
    def noise_level(self) -> float:
        """Root mean square of |X| in a bin of noise [V]."""
        return float(np.sqrt(2)) * self.deviation

    def dbv(self, magnitude: np.ndarray | float) -> np.ndarray:
        """|X| as the amplitude of a tone that would give it, in dB above 1 V."""
        with np.errstate(divide="ignore"):
            return 20 * np.log10(2 * np.asarray(magnitude) / self.prepared.window.sum)

    @property
    def detected(self) -> bool:
        """Tell whether both chirp segments have a group."""
        return all(segment.groups for segment in self.segments if segment.sign)


def simulated(
    parameters: Parameters,
    effects: Collection[str] = CORE,
    *,
    label: str = "",
    seed: int | None = None,
) -> Shot:
    """One shot on a flat plane."""
    ((_, prepared),) = prepare(parameters, effects)
    return simulated_shot(prepared, parameters, label=label, seed=seed)


def simulated_shot(
    prepared: model.Shots, parameters: Parameters, *, label: str = "", seed: int | None = None
) -> Shot:
    """One shot that is prepared already, whatever it looks at."""
    found = model.find(prepared)
    segments = tuple(
        _segment(prepared, found[k, :, 0], k, seed) for k in range(3) if prepared.segments[k]
    )
    seen = found.copy()
    for segment in segments:
        seen[NAMES.index(segment.name), 3, 0] = segment.frequency[segment.peak]
    reported = model.report(prepared, seen)
    return Shot(
        label=label,
        parameters=parameters,
        prepared=prepared,
        outputs={name: float(value[0]) for name, value in model.statistics(prepared).items()},
        segments=segments,
        range=float(reported.range[0]),
        radial_velocity=float(reported.radial_velocity[0]),
    )


def _segment(prepared: model.Shots, found: np.ndarray, k: int, seed: int | None) -> Segment:
    bins, signal = segment_spectrum(prepared, 0, k)
    noise = 0.0 if seed is None else drawn_noise(prepared, seed=seed, segment=k)[bins]
    magnitude = np.abs(signal + noise)
    segment = prepared.waveform[k]
    carrier = np.asarray(segment.carrier).item()
    beat = waveform.beat_frequency(
        segment.sign,
        carrier=carrier,
        chirp_rate=np.asarray(prepared.chirp_rate),
        range=prepared.range[0] - np.ravel(segment.nearer)[0],
        radial_velocity=np.ravel(segment.beta)[0] * SPEED_OF_LIGHT / 2,
    )
    return Segment(
        name=NAMES[k],
        sign=waveform.SIGNS[k],
        frequency=bins * float(prepared.sample_rate[0]) / prepared.fft_size,
        signal=signal,
        magnitude=magnitude,
        beat=np.asarray(beat).item(),
        carrier=carrier,
        groups=groups(magnitude, float(prepared.threshold[0])),
        snr=float(found[2] / prepared.bin_deviation[0]) ** 2 / 2,
        pd=float(found[0]),
    )


def drawn_noise(prepared: model.Shots, *, seed: int, segment: int) -> np.ndarray:
    """Spectrum (N/2 + 1,) of a record of white Gaussian noise, windowed [V].

    The bins' noise is complex Gaussian, and alike in neighbours as far as the window makes it.
    It is added to the signal's |X|: a common phase changes nothing in a bin, and the signal's
    phase from bin to bin is lost.
    """
    shape = prepared.window
    stream = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(segment,)))
    record = stream.normal(0.0, float(np.sqrt(prepared.noise_variance[0])), shape.length)
    return np.fft.rfft(record * window.samples(shape.name, shape.length), prepared.fft_size)


def groups(magnitude: np.ndarray, threshold: float) -> tuple[Group, ...]:
    """Runs of adjacent bins at or above the threshold."""
    above = np.flatnonzero(magnitude >= threshold)
    runs = np.split(above, np.flatnonzero(np.diff(above) > 1) + 1) if above.size else []
    return tuple(
        Group(int(run[0]), int(run[-1]), int(run[np.argmax(magnitude[run])])) for run in runs
    )


def quantity_at(shot: Shot, segment: Segment, frequency: np.ndarray) -> np.ndarray:
    """Range [m] or velocity [m/s] that a frequency seen in a segment stands for near its beat.

    Range is that of a target of the shot's velocity; a fold at DC or Nyquist is undone as for
    the shot's own beat.
    """
    p = shot.prepared
    rate = float(p.sample_rate[0])
    fold = np.rint(segment.beat / rate) * rate
    signed = fold + np.where(segment.beat < fold, -1.0, 1.0) * np.asarray(frequency)
    if segment.sign == 0:
        return signed * SPEED_OF_LIGHT / (2 * segment.carrier)
    beta = float(np.asarray(p.beta).flat[0])
    delay_beat = segment.sign * (segment.carrier * beta - signed)
    return delay_beat * SPEED_OF_LIGHT / (2 * np.asarray(p.chirp_rate).item() * (1 + beta))
