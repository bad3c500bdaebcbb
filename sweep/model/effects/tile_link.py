"""A block's instrument as spans: its parameters, its link budget and its receiver's noise."""

from collections.abc import Mapping
from functools import cached_property
from typing import Any

import numpy as np

from sweep.model import detection, ground, link, noise, receiver, resolution, waveform
from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.effects.columns import columns
from sweep.model.effects.line_spread import instrument_ends
from sweep.model.effects.span import Span, monotone
from sweep.model.preparation import CHIRP, LASER, PROCESSING, RECEIVER, TELESCOPE
from sweep.model.window import Window, canonical_name, window

Parameters = Mapping[str, Span | str]

_INSTRUMENT = (
    "architecture", "fft_size", "window", "carriers", "chirp_rate", "bin_width", "record_duration",
    "electrical_bandwidth", "noise_scale", "shot_noise_scale", "noise_variance", "deviation",
    "threshold", "beamlets", "words", "most_turns", "instrument_ends", "turn_of_bin",
)  # fmt: skip
"""What the instrument alone makes, whatever the beams meet."""


class TileLink:
    """Link budget of tiles whose points are all of one category, by the formulas of bare shots.

    Parameters
    ----------
    parameters : mapping
        Dotted path to a span over each tile, or to the word that all share: every parameter,
        those that effects bring among them.
    instrument : TileLink, optional
        Another whose instrument is the same: what follows from it alone is taken from there.
    """

    def __init__(self, parameters: Parameters, instrument: "TileLink | None" = None) -> None:
        self._parameters = parameters
        if instrument is not None:
            self.__dict__.update(instrument._of_instrument)
            return
        self.architecture = self.word(RECEIVER + "architecture")
        self.fft_size = self.whole(PROCESSING + "fft_size")

    def __getitem__(self, path: str) -> Span:
        """A parameter that is a number."""
        value = self._parameters[path]
        if isinstance(value, str):
            raise TypeError(f"{path} is a word: {value}")
        return value

    def word(self, path: str) -> str:
        """A parameter that is a word."""
        return str(self._parameters[path])

    @property
    def parameters(self) -> Parameters:
        """All parameters."""
        return self._parameters

    @cached_property
    def words(self) -> dict[str, str]:
        """Parameters that are words."""
        return {path: v for path, v in self._parameters.items() if isinstance(v, str)}

    @cached_property
    def beamlets(self) -> tuple[int, str]:
        """Beamlets and their pattern; the most there may be where they follow from the tolerance.

        Raises
        ------
        ValueError
            As of :meth:`whole`.
        """
        number = self.whole(resolution.BEAMLETS)
        return (number, ground.pattern(self.words)) if number else resolution.finest(self.words)

    def whole(self, path: str) -> int:
        """A parameter that is a number shared by all points.

        Raises
        ------
        ValueError
            They do not share it.
        """
        return int(shared(self[path], path))

    def has(self, *paths: str) -> bool:
        """Whether any of some parameters that are numbers is other than 0 in any tile."""
        for path in paths:  # noqa: SIM110 - a generator takes longer than most parameters
            if not self[path].is_zero:
                return True
        return False

    @cached_property
    def window(self) -> Window:
        """Window of the record; a block's points share its length."""
        record = monotone(
            waveform.record_length,
            falling=("acquisition_delay",),
            fft_size=self[PROCESSING + "fft_size"],
            duration=self[CHIRP + "duration"],
            acquisition_delay=self.start,
            sample_rate=self.sample_rate,
        )
        length = int(shared(record, "record"))
        return window(canonical_name(self.word(PROCESSING + "window")), length)

    @property
    def range(self) -> Span:
        """Range on the beam's axis [m]."""
        return self["target.range"]

    @property
    def radial_velocity(self) -> Span:
        """Radial velocity on the beam's axis [m/s], positive when closing."""
        return self["target.radial_velocity"]

    @property
    def sample_rate(self) -> Span:
        """Sample rate [Hz]."""
        return self[PROCESSING + "sample_rate"]

    @property
    def start(self) -> Span:
        """Acquisition delay t_0 [s]."""
        return self[PROCESSING + "acquisition_delay"]

    @cached_property
    def beta(self) -> Span:
        """Doppler ratio 2 v_r / c."""
        return 2 * self.radial_velocity / SPEED_OF_LIGHT

    def carrier(self, segment: int) -> Span:
        """Frequency that the delay turns into phase, in a segment [Hz]."""
        return self.carriers[segment]

    @cached_property
    def carriers(self) -> tuple[Span, Span, Span]:
        """The same of up, Doppler and down segment."""
        if self.architecture == "direct":
            start = self[CHIRP + "start_frequency"]
        else:
            start = SPEED_OF_LIGHT / self[LASER + "wavelength"]
        return start, start, start + self[CHIRP + "bandwidth"]

    @cached_property
    def most_turns(self) -> np.ndarray:
        """Phase [rad] of 1 m further off at a carrier and two bandwidths, (3, tiles) or (3, 1)."""
        bandwidth = self[CHIRP + "bandwidth"].high
        highest, _ = columns(*(carrier.high + 2 * bandwidth for carrier in self.carriers))
        return np.asarray(4 * np.pi * highest / SPEED_OF_LIGHT)

    @cached_property
    def turn_of_bin(self) -> np.ndarray | float:
        """Most phase [rad] at the record's middle of a line one bin away: pi for L = N, t_0 = 0."""
        middle = self.start.high + 0.5 * self.record_duration.high
        return 2 * np.pi * middle * self.bin_width.high

    @cached_property
    def chirp_rate(self) -> Span:
        """Chirp rate S = B/T [Hz/s]."""
        return self[CHIRP + "bandwidth"] / self[CHIRP + "duration"]

    @cached_property
    def bin_width(self) -> Span:
        """Width of a bin fs/N [Hz]."""
        return self.sample_rate / self.fft_size

    @cached_property
    def instrument_ends(self) -> np.ndarray:
        """What lines on the axis follow from, but for their ranges and velocities."""
        return instrument_ends(
            chirp_rate=self.chirp_rate,
            carriers=self.carriers,
            bin_width=self.bin_width,
            **self._receiver("detector_bandwidth", "amplifier_bandwidth"),
        )

    @cached_property
    def record_duration(self) -> Span:
        """Length of the record L/fs [s]."""
        return self.window.length / self.sample_rate

    @cached_property
    def electrical_bandwidth(self) -> Span:
        """Bandwidth B_e over which noise is counted [Hz]."""
        return monotone(
            receiver.electrical_bandwidth,
            **self._receiver("detector_bandwidth", "amplifier_bandwidth"),
        )

    @cached_property
    def echo_scale(self) -> Span:
        """Echo power [W] for a relative echo of 1/sr."""
        return monotone(
            link.echo_power_scale,
            falling=("range",),
            power=self[LASER + "power"],
            aperture=self[TELESCOPE + "aperture"],
            optical_efficiency=self[TELESCOPE + "optical_efficiency"],
            reflectance=self["target.reflectance"],
            range=self.range,
        )

    @cached_property
    def beat_scale(self) -> Span:
        """Amplitude of the beat [V] for a relative amplitude of 1."""
        names = (
            "local_oscillator_power", "mixing_efficiency", "apd_gain", "responsivity",
            "modulation_index",
        )  # fmt: skip
        current = monotone(
            lambda **values: link.beat_scale(self.architecture, **values),
            echo_power_scale=self.echo_scale,
            **self._receiver(*names),
        )
        return current.times(self[RECEIVER + "transimpedance"])

    @cached_property
    def noise_scale(self) -> Span:
        """Noise variance at the ADC [V^2] that 1 A^2 of current makes."""
        factor = monotone(
            lambda noise_figure: noise.current_scale(self.architecture, noise_figure=noise_figure),
            noise_figure=self[RECEIVER + "noise_figure"],
        )
        return factor * self[RECEIVER + "transimpedance"] ** 2

    @cached_property
    def shot_noise_scale(self) -> Span:
        """Noise variance at the ADC [V^2] that 1 W of light makes."""
        current = monotone(
            noise.shot_noise,
            power=1.0,
            electrical_bandwidth=self.electrical_bandwidth,
            **self._receiver("apd_gain", "excess_noise_factor", "responsivity"),
        )
        return current * self.noise_scale

    @cached_property
    def noise_variance(self) -> Span:
        """Noise variance of the receiver alone at the ADC [V^2]."""
        names = (
            "local_oscillator_power", "apd_gain", "excess_noise_factor", "responsivity",
            "noise_equivalent_power", "amplifier_noise_current", "load_resistance", "temperature",
        )  # fmt: skip

        def current(**values: np.ndarray) -> np.ndarray:
            return np.asarray(sum(noise.receiver_currents(self.architecture, **values).values()))

        return self.noise_scale * monotone(
            current,
            falling=("load_resistance",),
            electrical_bandwidth=self.electrical_bandwidth,
            **self._receiver(*names),
        )

    @cached_property
    def deviation(self) -> Span:
        """Noise sigma of a bin, per quadrature [V]."""
        energy = np.asarray(self.window.energy)
        return monotone(
            noise.bin_deviation, noise_variance=self.noise_variance, window_energy=energy
        )

    @cached_property
    def threshold(self) -> Span:
        """Threshold over sigma."""
        return monotone(detection.threshold, tnr=self[PROCESSING + "tnr"], bin_deviation=1.0)

    @cached_property
    def _of_instrument(self) -> dict[str, Any]:
        return {name: getattr(self, name) for name in _INSTRUMENT}

    def _receiver(self, *names: str) -> dict[str, Span]:
        return {name: self[RECEIVER + name] for name in names}


def shared(span: Span, path: str) -> float:
    """The one value of a span that all points share; ValueError where they do not."""
    if not span.is_one:
        raise ValueError(f"points of one block must share {path}")
    return float(np.asarray(span.low).flat[0])
