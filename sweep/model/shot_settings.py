"""Waveform and record of a shot, and state and motion of its target, from parameters.

The link budget (:mod:`sweep.model.link_budget`), the threshold (:mod:`sweep.model.threshold`) and
the search band (:mod:`sweep.model.spectrum.search_band`) all read these records.

Values are arrays that broadcast over points, in SI units. Tuples by segment are in the order up,
Doppler, down. All points share text parameters and integers that size an array.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from sweep.model import receiver_chain, waveform
from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.detection.looks import Looks
from sweep.model.waveform import WaveformSegment
from sweep.model.window import Window, canonical_window_name, get_window

LASER_PREFIX, CHIRP_PREFIX, TELESCOPE_PREFIX, RECEIVER_PREFIX, PROCESSING_PREFIX = (
    f"instrument.{section}."
    for section in ("laser", "chirp", "telescope", "receiver", "processing")
)
RECORD_TYPE_PATH = RECEIVER_PREFIX + "record"
"""Parameter path of the type of the record's samples: ``real``, or ``complex`` from I and Q."""

APPROACH_SPEED_PATH = "target.approach"
"""Parameter path of the speed [m/s] at which the range along the beam decreases. Only ray-traced
shots have it."""


@dataclass(frozen=True, eq=False, kw_only=True)
class TargetState:
    """Range, velocity and acceleration of the target on the beam's axis at the start of a shot."""

    range: np.ndarray
    """Range along the beam [m]."""
    radial_velocity: np.ndarray
    """Radial velocity [m/s], positive when closing."""
    acceleration: np.ndarray
    """Rate of change of the radial velocity [m/s^2]."""
    approach_speed: np.ndarray
    """Speed [m/s] at which the range along the beam decreases (:func:`approach_speed`)."""

    @classmethod
    def from_parameters(cls, parameters: Mapping[str, np.ndarray]) -> "TargetState":
        """Return the target's range, velocity and acceleration from parameters by dotted path."""
        return cls(
            range=parameters["target.range"],
            radial_velocity=parameters["target.radial_velocity"],
            acceleration=parameters["target.acceleration"],
            approach_speed=approach_speed(parameters),
        )

    @property
    def delay(self) -> np.ndarray:
        """Delay of the echo [s], twice the range divided by the speed of light."""
        return 2 / SPEED_OF_LIGHT * self.range

    @property
    def doppler_ratio(self) -> np.ndarray:
        """Doppler ratio 2 v_r / c, with the radial velocity v_r and the speed of light c."""
        return doppler_ratio(self.radial_velocity)


class LineMotion(NamedTuple):
    """Motion of the target during a shot that affects spectral lines and measured values.

    Fields are (n,) or scalars. By default there is no motion.
    """

    doppler_ratio: np.ndarray | float = 0.0
    """Doppler ratio 2 v_r / c of the line on the beam's axis at the start of the shot, with the
    radial velocity v_r."""
    segment_starts: tuple[np.ndarray | float, ...] = (0.0, 0.0, 0.0)
    """Time [s] from the shot's start to each segment's start, in the order up, Doppler, down. All
    are 0 if motion between segments is not simulated."""
    line_drift_per_look: np.ndarray | float = 0.0
    """(3, n): frequency shift of each segment's lines from one look to the next [bins of fs/N,
    sample rate over FFT size]. A look is one of several records of the same segment."""
    range_reference_time: np.ndarray | float = 0.0
    """Time [s] from the start of the shot to the instant whose range the beats measure; 0 if motion
    is not simulated."""
    velocity_drift_time: np.ndarray | float = 0.0
    """Time [s] from the start of a segment to the instant whose velocity its beat measures; 0 if
    acceleration is not simulated."""
    velocity_bias_fraction: np.ndarray | float = 0.0
    """Fraction of the radial velocity by which the velocity from the beats is too low."""


@dataclass(frozen=True, eq=False, kw_only=True)
class WaveformSettings:
    """Waveform of a shot: chirp rates, frequencies and times of its segments."""

    architecture: str
    """Receiver architecture: ``homodyne``, ``heterodyne`` or ``direct``."""
    segment_order: tuple[str, ...]
    """Names of the existing segments, in the order of time."""
    chirp_rate_ratios: tuple[Any, ...]
    """Signed chirp rates of up, Doppler and down segment, divided by the up-chirp's
    :attr:`chirp_rate`: numbers, or arrays if points differ."""
    carriers: tuple[np.ndarray, np.ndarray, np.ndarray]
    """Frequency at the start of the up, Doppler and down segment [Hz]. Times the echo's delay, it
    gives a phase [cycles]."""
    chirp_bandwidth: np.ndarray
    """Bandwidth of the up-chirp [Hz]."""
    chirp_duration: np.ndarray
    """Duration of each segment [s]."""
    segment_gap: np.ndarray
    """Time from the end of a segment to the start of the next one [s]."""

    @classmethod
    def from_parameters(cls, parameters: Mapping[str, Any]) -> "WaveformSettings":
        """Return the waveform from parameters by dotted path.

        Chirp rate ratios may differ by point. Segments, gap and ratios that are not stated have the
        values of :data:`sweep.model.waveform.WAVEFORM_DEFAULTS`.
        """
        parameters = waveform.WAVEFORM_DEFAULTS | dict(parameters)
        architecture = str(parameters[RECEIVER_PREFIX + "architecture"])
        chirp_rate_ratios: tuple[Any, ...] = (
            1.0,
            *(
                np.asarray(parameters[path], float)
                for path in (
                    waveform.DOPPLER_CHIRP_RATE_RATIO_PATH,
                    waveform.DOWN_CHIRP_RATE_RATIO_PATH,
                )
            ),
        )
        chirp_bandwidth = parameters[CHIRP_PREFIX + "bandwidth"]
        return cls(
            architecture=architecture,
            segment_order=waveform.existing_segments(
                architecture, str(parameters[waveform.SEGMENT_ORDER_PATH])
            ),
            chirp_rate_ratios=chirp_rate_ratios,
            carriers=waveform.carrier_frequencies(
                architecture,
                wavelength=parameters[LASER_PREFIX + "wavelength"],
                start_frequency=parameters[CHIRP_PREFIX + "start_frequency"],
                bandwidth=chirp_bandwidth,
                chirp_rate_ratios=chirp_rate_ratios,
            ),
            chirp_bandwidth=chirp_bandwidth,
            chirp_duration=parameters[CHIRP_PREFIX + "duration"],
            segment_gap=parameters[waveform.SEGMENT_GAP_PATH],
        )

    @property
    def chirp_rate(self) -> np.ndarray:
        """Chirp rate of the up-chirp [Hz/s], bandwidth divided by duration."""
        return self.chirp_bandwidth / self.chirp_duration

    @property
    def has_segment(self) -> np.ndarray:
        """(3,) bool: True for segments that exist, in the order up, Doppler, down."""
        return np.array([name in self.segment_order for name in waveform.SEGMENT_NAMES])

    @property
    def segment_starts(self) -> tuple[np.ndarray, ...]:
        """Times [s] from the start of a look to the start of its up, Doppler and down segment.

        A look is one pass through all segments of the shot.
        """
        return waveform.segment_starts(
            self.segment_order, duration=self.chirp_duration, gap=self.segment_gap
        )

    @property
    def look_period(self) -> np.ndarray:
        """Time [s] from the start of one look to the start of the next.

        A look is one pass through all segments of the shot, with the gaps between them.
        """
        return len(self.segment_order) * (self.chirp_duration + self.segment_gap)

    def middle_look_delay(self, looks: Looks) -> np.ndarray | float:
        """Return the time [s] from the start of the first look to the start of the middle look.

        A look is one pass through all segments of the shot. With an even number of looks, the
        middle lies between two of them.
        """
        return 0.5 * (looks.number - 1) * self.look_period if looks.number > 1 else 0.0

    def middle_look_starts(self, looks: Looks) -> tuple[np.ndarray, ...]:
        """Return the times [s] from the shot's start to the segments of the middle look.

        A look is one pass through all segments of the shot. The tuple is in the order up, Doppler,
        down.
        """
        delay = self.middle_look_delay(looks)
        return tuple(start + delay for start in self.segment_starts)

    def segments(self, target: TargetState, motion: LineMotion) -> tuple[WaveformSegment, ...]:
        """Return the three segments, with the target's range and velocity at their starts.

        The tuple is in the order up, Doppler, down.

        Parameters
        ----------
        target : TargetState
            Target at the start of the shot.
        motion : LineMotion
            Motion during the shot that is simulated.

        Notes
        -----
        With the approach speed u and the acceleration a, a segment that starts at t finds the range
        lower by u t + a t^2 / 2, and the Doppler ratio higher by 2 a t / c. Leakage is evaluated in
        up- and down-chirp only, as no output reports that of the Doppler segment.
        """
        return tuple(
            WaveformSegment(
                name,
                slope,
                slope * self.chirp_rate,
                carrier,
                name != waveform.SEGMENT_NAMES[1],
                target.approach_speed * start + 0.5 * target.acceleration * start * start,
                motion.doppler_ratio + doppler_ratio(target.acceleration * start),
                start,
            )
            for name, slope, carrier, start in zip(
                waveform.SEGMENT_NAMES,
                self.chirp_rate_ratios,
                self.carriers,
                motion.segment_starts,
                strict=True,
            )
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class RecordSettings:
    """Recorded samples of a segment: window, FFT size, sample rate and start of the record."""

    window: Window
    """Window that is applied to the samples of the record."""
    fft_size: int
    """FFT size N, the number of samples after zero padding."""
    sample_rate: np.ndarray
    """Sample rate f_s of the record [Hz]."""
    acquisition_delay: np.ndarray
    """Time from a segment's start to the start of its record [s]."""
    is_complex: bool
    """True if the record consists of complex samples I + iQ. Its spectrum has bins of signed
    frequency, and no images of lines."""

    @classmethod
    def from_parameters(cls, parameters: Mapping[str, Any]) -> "RecordSettings":
        """Return the record's settings from parameters by dotted path.

        All points must share the number of samples and the FFT size.
        """
        length = waveform.n_record_samples(parameters)
        window_name = canonical_window_name(str(parameters[PROCESSING_PREFIX + "window"]))
        return cls(
            window=get_window(window_name, int(np.ravel(length)[0])),
            fft_size=int(np.ravel(parameters[PROCESSING_PREFIX + "fft_size"])[0]),
            sample_rate=parameters[PROCESSING_PREFIX + "sample_rate"],
            acquisition_delay=parameters[PROCESSING_PREFIX + "acquisition_delay"],
            is_complex=is_iq_sampled(parameters),
        )

    @property
    def bin_width(self) -> np.ndarray:
        """Width of an FFT bin [Hz], sample rate divided by FFT size."""
        return self.sample_rate / self.fft_size

    @property
    def duration(self) -> np.ndarray:
        """Duration of the record [s], number of samples divided by sample rate."""
        return self.window.length / self.sample_rate

    def bin_noise_sigma(self, noise_variance: np.ndarray, looks: Looks) -> np.ndarray:
        """Return the noise standard deviation per quadrature of an FFT bin [V], [T 3.2].

        Parameters
        ----------
        noise_variance : ndarray
            Variance sigma_x^2 of a sample at the ADC [V^2].
        looks : Looks
            Number of records of each segment, and how they are combined
            (:class:`sweep.model.detection.looks.Looks`).

        Returns
        -------
        ndarray
            sqrt(E_w sigma_x^2 / (2 n)) [V, summed over the record], with the sum E_w of the squared
            window. n is the number of looks that are averaged in amplitude (``coherent``), else 1.
        """
        return receiver_chain.bin_noise_sigma(
            noise_variance=noise_variance / looks.n_coherent,
            window_energy=np.asarray(self.window.energy),
        )

    def count_samples_before_echo(
        self, segment: WaveformSegment, range: np.ndarray | float
    ) -> np.ndarray:
        """Return the number of samples in a segment's record that precede the echo, int64.

        Parameters
        ----------
        segment : WaveformSegment
            Segment of the waveform.
        range : ndarray or float
            Range of the target at the shot's start [m].
        """
        return waveform.count_samples_before_echo(
            delay=segment.echo_delay(range),
            doppler_ratio=segment.doppler_ratio,
            record_start=self.acquisition_delay,
            sample_rate=self.sample_rate,
            length=self.window.length,
        )


def approach_speed(parameters: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return the speed [m/s] at which the range along the beam decreases, (n,) or a scalar.

    The speed differs from the radial velocity if the beam slides over sloping ground.

    Notes
    -----
    Let the velocity be V = v d + u e, with the unit vector d along the beam and e across it,
    towards the near side. The range of a plane of normal n at the grazing angle g decreases at V.n
    / d.n = v + u cot g.
    """
    if APPROACH_SPEED_PATH in parameters:
        return parameters[APPROACH_SPEED_PATH]
    transverse_velocity = parameters["target.transverse_velocity"]
    if not np.any(transverse_velocity):
        return parameters["target.radial_velocity"]
    return np.asarray(
        parameters["target.radial_velocity"]
        + transverse_velocity / np.tan(parameters["target.grazing_angle"])
    )


def doppler_ratio(radial_velocity: np.ndarray) -> np.ndarray:
    """Return the Doppler ratio 2 v_r / c of a radial velocity v_r [m/s].

    c is the speed of light.
    """
    return 2 * radial_velocity / SPEED_OF_LIGHT


def is_iq_sampled(parameters: Mapping[str, Any]) -> bool:
    """Return True if the record is complex, sampled by two receivers for I and Q."""
    return str(parameters.get(RECORD_TYPE_PATH, "real")) == "complex"
