"""The instrument of a study: laser, chirp, telescope, receiver and processing.

Values are SI inside; what users write carries units.
"""

from typing import Annotated, Self

from pydantic import BaseModel, ConfigDict, model_validator
from pydantic_core import PydanticCustomError

from sweep.model.beam import COUPLINGS, SINGLE_MODE
from sweep.model.detectors import DETECTORS, FIXED
from sweep.model.estimators import ESTIMATORS, PEAK_BIN
from sweep.model.threshold import PROCESSING, WAYS
from sweep.spec.effect_fields import with_parameters
from sweep.spec.method_rule import Method
from sweep.spec.rules import BROKEN_RULE, Choice, Numeric
from sweep.spec.window_rule import Window

ARCHITECTURES = ("homodyne", "heterodyne", "direct")


class Part(BaseModel):
    """A section of a spec: frozen, and with no field but its own."""

    model_config = ConfigDict(frozen=True, extra="forbid")


@with_parameters("instrument.laser")
class Laser(Part):
    """Transmitter: wavelength, power and beam."""

    wavelength: Annotated[
        float,
        Numeric(
            about="Optical wavelength",
            si_unit="m",
            example="1550 nm",
            at_least="1 nm",
            at_most="100 m",
        ),
    ]
    power: Annotated[
        float,
        Numeric(
            about="Transmitted optical power",
            si_unit="W",
            example="1 W",
            at_least="1e-18 W",
            at_most="1e9 W",
        ),
    ]
    beam_divergence: Annotated[
        float,
        Numeric(
            about="Full angle of the beam, for a Gaussian beam between its 1/e^2 points; or give "
            "beam_waist",
            si_unit="rad",
            example="50 urad",
            at_least="1e-12 rad",
            at_most="90 deg",
            words=(("none", 0),),
        ),
    ] = 0.0
    beam_waist: Annotated[
        float,
        Numeric(
            about="1/e^2 radius of the beam as it leaves the telescope; or give beam_divergence",
            si_unit="m",
            example="5 mm",
            at_least="100 nm",
            at_most="1 km",
            words=(("none", 0),),
        ),
    ] = 0.0
    beam_quality: Annotated[
        float,
        Numeric(
            about="M^2 of the sent beam; 1 for a beam at the limit of diffraction",
            example="1.2",
            at_least="1",
            at_most="1e6",
        ),
    ] = 1.0
    focus: Annotated[
        float,
        Numeric(
            about="Distance at which the telescope is focused; none: at infinity",
            si_unit="m",
            example="20 m",
            at_least="1 mm",
            at_most="1e15 m",
            words=(("none", 0),),
        ),
    ] = 0.0


@with_parameters("instrument.chirp")
class Chirp(Part):
    """Linear frequency sweep of one segment."""

    bandwidth: Annotated[
        float,
        Numeric(
            about="Frequency swept in one chirp",
            si_unit="Hz",
            example="1 GHz",
            at_least="1 mHz",
            at_most="1e15 Hz",
        ),
    ]
    start_frequency: Annotated[
        float,
        Numeric(
            about="Frequency at which the chirp starts",
            si_unit="Hz",
            example="5.5 GHz",
            at_least="0 Hz",
            at_most="1e15 Hz",
        ),
    ]
    duration: Annotated[
        float,
        Numeric(
            about="Length of one segment",
            si_unit="s",
            example="500 us",
            at_least="1 ps",
            at_most="1e6 s",
        ),
    ]


@with_parameters("instrument.telescope")
class Telescope(Part):
    """Receiving optics."""

    aperture: Annotated[
        float,
        Numeric(
            about="Diameter of the aperture",
            si_unit="m",
            example="25 mm",
            at_least="1 um",
            at_most="1 km",
        ),
    ]
    optical_efficiency: Annotated[
        float,
        Numeric(
            about="Fraction of the collected light that reaches the detector",
            example="0.8",
            at_least="0",
            at_most="1",
        ),
    ] = 1.0
    coupling: Annotated[
        str,
        Choice(
            about="Light that mixes with the local oscillator: that of a single mode, or all in "
            "the aperture, as the thesis has it; direct detection always has all",
            options=COUPLINGS,
        ),
    ] = SINGLE_MODE


@with_parameters("instrument.receiver")
class Receiver(Part):
    """Detector, local oscillator and amplifiers."""

    responsivity: Annotated[
        float,
        Numeric(
            about="Responsivity at unit gain",
            si_unit="A/W",
            example="1.1 A/W",
            at_least="1e-9 A/W",
            at_most="1e3 A/W",
        ),
    ]
    detector_bandwidth: Annotated[
        float,
        Numeric(
            about="Electrical bandwidth of the detector",
            si_unit="Hz",
            example="400 MHz",
            at_least="1 mHz",
            at_most="1e15 Hz",
        ),
    ]
    optical_passband: Annotated[
        float,
        Numeric(
            about="Width of the optical filter",
            si_unit="m",
            example="25 nm",
            at_least="0 m",
            at_most="100 m",
        ),
    ]
    noise_equivalent_power: Annotated[
        float,
        Numeric(
            about="Noise-equivalent power density of the detector",
            si_unit="W/Hz^0.5",
            example="5 pW/rtHz",
            at_least="0 W/Hz^0.5",
            at_most="100 W/Hz^0.5",
        ),
    ]
    transimpedance: Annotated[
        float,
        Numeric(
            about="Gain of the transimpedance amplifier",
            si_unit="ohm",
            example="7 kohm",
            at_least="1 uohm",
            at_most="1e12 ohm",
        ),
    ]
    amplifier_bandwidth: Annotated[
        float,
        Numeric(
            about="Electrical bandwidth of the amplifier",
            si_unit="Hz",
            example="400 MHz",
            at_least="1 mHz",
            at_most="1e15 Hz",
        ),
    ]
    amplifier_noise_current: Annotated[
        float,
        Numeric(
            about="Input-referred noise current of the amplifier, rms over its bandwidth",
            si_unit="A",
            example="25 nA",
            at_least="0 A",
            at_most="1 kA",
        ),
    ]
    noise_shape: Annotated[
        str,
        Choice(
            about="Density of the receiver's noise: shaped by its bandwidths as signals are, or "
            "white over the record",
            options=("receiver", "white"),
        ),
    ] = "receiver"
    architecture: Annotated[
        str, Choice(about="How the echo is detected", options=ARCHITECTURES)
    ] = "homodyne"
    local_oscillator_power: Annotated[
        float,
        Numeric(
            about="Power of the local oscillator; direct detection has none",
            si_unit="W",
            example="1 mW",
            at_least="1e-18 W",
            at_most="1e9 W",
        ),
    ] = 1e-3
    local_oscillator_waist: Annotated[
        float,
        Numeric(
            about="1/e^2 radius at the telescope of the beam that the local oscillator would make; "
            "none: the sent beam's. single_mode only",
            si_unit="m",
            example="5 mm",
            at_least="100 nm",
            at_most="1 km",
            words=(("none", 0),),
        ),
    ] = 0.0
    mixing_efficiency: Annotated[
        float,
        Numeric(
            about="Heterodyne efficiency: share of the echo's power that mixes with the local "
            "oscillator, as which it counts in the SNR",
            example="0.7",
            at_least="1e-9",
            at_most="1",
        ),
    ] = 1.0
    apd_gain: Annotated[
        float,
        Numeric(
            about="Avalanche gain; 1 for a PIN diode", example="10", at_least="1", at_most="1e9"
        ),
    ] = 1.0
    excess_noise_factor: Annotated[
        float,
        Numeric(
            about="Excess noise factor of the avalanche", example="2.5", at_least="1", at_most="1e9"
        ),
    ] = 1.0
    noise_figure: Annotated[
        float,
        Numeric(
            about="Noise figure of the radio-frequency stages; heterodyne only",
            si_unit="dB",
            example="3 dB",
            at_least="0 dB",
            at_most="300 dB",
        ),
    ] = 1.0
    modulation_index: Annotated[
        float,
        Numeric(
            about="Depth of the intensity modulation; direct only",
            example="0.9",
            at_least="1e-9",
            at_most="1",
        ),
    ] = 1.0
    load_resistance: Annotated[
        float,
        Numeric(
            about="Load whose thermal noise limits direct detection; direct only",
            si_unit="ohm",
            example="50 ohm",
            at_least="1 uohm",
            at_most="1e12 ohm",
        ),
    ] = 50.0
    temperature: Annotated[
        float,
        Numeric(
            about="Temperature of the load; direct only",
            si_unit="K",
            example="290 K",
            at_least="1 nK",
            at_most="1e9 K",
        ),
    ] = 290.0


class Detector(Part):
    """What flags bins of a spectrum, where whole spectra are drawn."""

    kind: Annotated[
        str, Method(about="Detector: fixed threshold or CFAR", options=tuple(DETECTORS))
    ] = FIXED
    training: Annotated[
        int,
        Numeric(
            about="Training cells of a CFAR detector, half of them on either side; even",
            example="32",
            at_least="2",
            at_most="100000",
            whole=True,
        ),
    ] = 32
    guard: Annotated[
        int,
        Numeric(
            about="Guard cells on either side of the bin, which train nothing",
            example="4",
            at_least="0",
            at_most="100000",
            whole=True,
        ),
    ] = 4
    rank: Annotated[
        int,
        Numeric(
            about="Rank of OS-CFAR's training cell, 1 for the least; auto: three quarters of them",
            example="24",
            at_least="1",
            at_most="100000",
            whole=True,
            words=(("auto", 0),),
        ),
    ] = 0
    pfa: Annotated[
        float,
        Numeric(
            about="Design probability of a false alarm in a bin of noise, of CFAR detectors",
            example="1e-6",
            at_least="1e-30",
            at_most="0.5",
        ),
    ] = 1e-6


class Estimator(Part):
    """What places a detected peak between bins, where whole spectra are drawn."""

    kind: Annotated[
        str, Method(about="Estimator of the peak's frequency", options=tuple(ESTIMATORS))
    ] = PEAK_BIN


def _design_pfa(where: str) -> Numeric:
    """Rule of a probability of a false alarm that the threshold is set by."""
    return Numeric(
        about=f"Instead of tnr: probability that noise alone raises a false alarm in {where}",
        example="1e-6",
        at_least="1e-300",
        at_most="0.99",
    )


@with_parameters("instrument.processing")
class Processing(Part):
    """Sampling, transform and threshold."""

    sample_rate: Annotated[
        float,
        Numeric(
            about="Rate of the ADC",
            si_unit="Hz",
            example="600 MHz",
            at_least="1 mHz",
            at_most="1e15 Hz",
        ),
    ]
    fft_size: Annotated[
        int,
        Numeric(
            about="Points of the FFT", example="2^17", at_least="2", at_most="2^30", whole=True
        ),
    ]
    tnr: Annotated[
        float | None,
        Numeric(
            about="Threshold over the standard deviation of a noise-only bin's magnitude",
            example="10",
            at_least="1e-6",
            at_most="1e6",
        ),
    ] = None
    threshold_to_mean: Annotated[
        float | None,
        Numeric(
            about="Instead of tnr: threshold over the mean of a noise-only bin's magnitude",
            example="4",
            at_least="1e-6",
            at_most="1e6",
        ),
    ] = None
    design_pfa_bin: Annotated[float | None, _design_pfa("a bin")] = None
    design_pfa_segment: Annotated[float | None, _design_pfa("any bin of a segment")] = None
    design_pfa_shot: Annotated[float | None, _design_pfa("any segment of a shot")] = None
    window: Annotated[
        str, Window(about="Window function, by scipy.signal's name, with its parameters")
    ] = "hamming"
    acquisition_delay: Annotated[
        float,
        Numeric(
            about="Time from the start of a segment to its first sample",
            si_unit="s",
            example="70 us",
            at_least="0 s",
            at_most="1e6 s",
        ),
    ] = 0.0
    bins_counted: Annotated[
        str,
        Choice(
            about="Bins that may raise a false alarm: half the FFT, as a real record has, or all",
            options=("half", "all"),
        ),
    ] = "half"
    detection: Annotated[
        str,
        Choice(
            about="Bins by which an echo is detected: any that it occupies, or the largest alone",
            options=("any_bin", "peak_bin"),
        ),
    ] = "any_bin"
    noise_bins: Annotated[
        str,
        Choice(
            about="Noise of bins: correlated as window and padding make it, and real at DC and "
            "Nyquist; or independent and circular, as the thesis takes it",
            options=("correlated", "independent"),
        ),
    ] = "correlated"
    detector: Detector = Detector()
    estimator: Estimator = Estimator()

    @model_validator(mode="after")
    def _one_threshold(self) -> Self:
        """Refuse a threshold that is not set, or that is set in several ways."""
        ways = [way.removeprefix(PROCESSING) for way in WAYS]
        given = [way for way in ways if getattr(self, way) is not None]
        if len(given) != 1:
            rule = (
                f"sets the threshold by {' and by '.join(given)}" if given else "has no threshold"
            )
            remedy = "keep one of them" if given else f"write 'tnr: 10', or {', '.join(ways[1:])}"
            raise PydanticCustomError(BROKEN_RULE, "{rule}", {"rule": rule, "suggestion": remedy})
        return self


class Instrument(Part):
    """A Doppler lidar."""

    laser: Laser
    chirp: Chirp
    telescope: Telescope
    receiver: Receiver
    processing: Processing
