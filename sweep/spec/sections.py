"""Sections of a spec that grids and scenes share, such as the instrument, and those of grids.

Values are in SI units after reading; users write values with units.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from types import MappingProxyType
from typing import Any, Self

from pydantic import BaseModel, model_validator

import sweep.spec.fields as declare
from sweep.model import waveform
from sweep.model.beam import COUPLING_LAWS
from sweep.model.detection.detectors import DETECTORS, FIXED_THRESHOLD_KIND
from sweep.model.detection.estimators import ESTIMATORS, PEAK_BIN
from sweep.model.detection.looks import COMBINE_KINDS, SPECKLE_KINDS
from sweep.model.error_budget import COUNT_INTERVAL_FUNCTIONS, SET_BY_TOLERANCE
from sweep.model.ground import REFLECTANCE_LAWS
from sweep.model.threshold import PROCESSING_PREFIX, THRESHOLD_PATHS
from sweep.spec.fields import (
    SpecSection,
    add_effect_mode_fields,
    add_effect_parameter_fields,
    rules_by_path,
)
from sweep.spec.rules import (
    ChoiceOrFunctionRule,
    Rule,
    WindowFunctionRule,
    rule_error,
    suggest_similar_name,
)

ARCHITECTURES = ("homodyne", "heterodyne", "direct")
"""Names of receiver architectures: two kinds of coherent detection, and direct detection."""
_POWER_BOUNDS = ("1e-18 W", "1e9 W")
"""Least and greatest optical power that a field takes, with units."""
_FREQUENCY_BOUNDS = ("1 mHz", "1e15 Hz")
"""Least and greatest frequency or bandwidth that a field takes, with units."""
_RESISTANCE_BOUNDS = ("1 uohm", "1e12 ohm")
"""Least and greatest resistance that a field takes, with units."""
_WAIST_EXAMPLE_AND_BOUNDS = ("5 mm", "100 nm", "1 km")
"""Example, least value and greatest value for the waist radius of a beam, with units."""


@add_effect_parameter_fields("instrument.laser")
class Laser(SpecSection):
    """Transmitter: wavelength, power and beam."""

    wavelength: float = declare.length_field("Optical wavelength", "1550 nm", "1 nm", "100 m")
    power: float = declare.quantity_field("Transmitted optical power", "W", "1 W", *_POWER_BOUNDS)
    beam_divergence: float = declare.angle_field(
        "Full angle of the beam, for a Gaussian beam between its 1/e^2 points; or give beam_waist",
        "50 urad", "1e-12 rad", "90 deg", default=0.0, keyword="none",
    )  # fmt: skip
    beam_waist: float = declare.length_field(
        "1/e^2 radius of the beam as it leaves the telescope; or give beam_divergence",
        *_WAIST_EXAMPLE_AND_BOUNDS, default=0.0, keyword="none",
    )  # fmt: skip
    beam_quality: float = declare.number_field(
        "M^2 of the sent beam; 1 for a beam at the limit of diffraction",
        "1.2", "1", "1e6", default=1.0,
    )  # fmt: skip
    focus: float = declare.length_field(
        "Distance at which the telescope is focused; none: at infinity",
        "20 m", "1 mm", "1e15 m", default=0.0, keyword="none",
    )  # fmt: skip


@add_effect_parameter_fields("instrument.chirp")
class Chirp(SpecSection):
    """Segments of a shot: linear frequency sweeps, and the segment without a sweep."""

    bandwidth: float = declare.quantity_field(
        "Frequency swept in one chirp", "Hz", "1 GHz", *_FREQUENCY_BOUNDS
    )
    start_frequency: float = declare.quantity_field(
        "Frequency at which the chirp starts", "Hz", "5.5 GHz", "0 Hz", "1e15 Hz"
    )
    duration: float = declare.duration_field("Length of one segment", "500 us", "1 ps", "1e6 s")
    segments: str = declare.choice_field(
        "Segments of a shot in the order of time: up- and down-chirp, and the light without a "
        "chirp, which measures the Doppler shift alone. 'up down' is the triangle of automotive "
        "lidars, whose beats are read as |f_d| < f_r. Direct detection has none without a chirp",
        waveform.SEGMENT_ORDERS,
    )
    doppler_slope: float = declare.number_field(
        "Chirp rate of the segment 'doppler' over that of the segment 'up', with its sign: 0 for "
        "light without a chirp",
        "0.5", "-1000", "1000", default=0.0,
    )  # fmt: skip
    down_slope: float = declare.number_field(
        "Chirp rate of the segment 'down' over that of the segment 'up', with its sign: -1 for a "
        "down-chirp as steep, 0.5 for a second up-chirp half as steep. With slopes other than 0 "
        "and -1 range and velocity are a weighted least-squares fit to the beats of all segments "
        "that are detected",
        "-0.5", "-1000", "1000", default=-1.0,
    )  # fmt: skip
    gap: float = declare.duration_field(
        "Time from the end of a segment to the start of the next", "5 us", "0 s", "1e6 s",
        default=0.0,
    )  # fmt: skip


@add_effect_parameter_fields("instrument.telescope")
class Telescope(SpecSection):
    """Receiving optics."""

    aperture: float = declare.length_field("Diameter of the aperture", "25 mm", "1 um", "1 km")
    optical_efficiency: float = declare.number_field(
        "Fraction of the collected light that reaches the detector", "0.8", "1e-12", "1",
        default=1.0, is_power_ratio=True,
    )  # fmt: skip
    coupling: str = declare.choice_field(
        "Light that mixes with the local oscillator: that of a single mode, or all in "
        "the aperture, as in the thesis; direct detection always has all",
        COUPLING_LAWS,
    )


@add_effect_parameter_fields("instrument.receiver")
class Receiver(SpecSection):
    """Detector, local oscillator and amplifiers."""

    responsivity: float = declare.quantity_field(
        "Responsivity at unit gain", "A/W", "1.1 A/W", "1e-9 A/W", "1e3 A/W"
    )
    detector_bandwidth: float = declare.quantity_field(
        "Electrical bandwidth of the detector", "Hz", "400 MHz", *_FREQUENCY_BOUNDS
    )
    optical_passband: float = declare.length_field(
        "Width of the optical filter", "25 nm", "0 m", "100 m"
    )
    noise_equivalent_power: float = declare.quantity_field(
        "Noise-equivalent power density of the detector",
        "W/Hz^0.5", "5 pW/rtHz", "0 W/Hz^0.5", "100 W/Hz^0.5",
    )  # fmt: skip
    transimpedance: float = declare.quantity_field(
        "Gain of the transimpedance amplifier", "ohm", "7 kohm", *_RESISTANCE_BOUNDS
    )
    amplifier_bandwidth: float = declare.quantity_field(
        "Electrical bandwidth of the amplifier", "Hz", "400 MHz", *_FREQUENCY_BOUNDS
    )
    amplifier_noise_current: float = declare.quantity_field(
        "Input-referred noise current of the amplifier, rms over its bandwidth",
        "A", "25 nA", "0 A", "1 kA",
    )  # fmt: skip
    antialias_bandwidth: float = declare.quantity_field(
        "Bandwidth of a Butterworth low-pass between amplifier and ADC, 3 dB down there; none: no "
        "filter but the poles of detector and amplifier. At most the sample rate",
        "Hz", "250 MHz", *_FREQUENCY_BOUNDS, default=0.0, keyword="none",
    )  # fmt: skip
    antialias_order: int = declare.integer_field(
        "Order of the anti-alias filter; its stop band falls by 6 dB per octave and order",
        "6", "3", "12", default=6,
    )  # fmt: skip
    noise_shape: str = declare.choice_field(
        "Density of the receiver's noise: shaped by its bandwidths as signals are, or "
        "white over the record",
        ("receiver", "white"),
    )
    architecture: str = declare.choice_field(
        "Detection architecture of the receiver", ARCHITECTURES
    )
    record: str = declare.choice_field(
        "Samples of a record: real, or complex from I and Q behind a 90 deg hybrid, which keep the "
        "beat's sign: no folding, twice as many bins, and the noise of two receivers in each; "
        "coherent receivers only",
        ("real", "complex"),
    )
    local_oscillator_power: float = declare.quantity_field(
        "Power of the local oscillator; direct detection has none", "W", "1 mW", *_POWER_BOUNDS,
        default=1e-3,
    )  # fmt: skip
    local_oscillator_waist: float = declare.length_field(
        "1/e^2 radius at the telescope of the beam that the local oscillator would make; "
        "none: the sent beam's. single_mode only",
        *_WAIST_EXAMPLE_AND_BOUNDS, default=0.0, keyword="none",
    )  # fmt: skip
    mixing_efficiency: float = declare.number_field(
        "Heterodyne efficiency: share of the echo's power that mixes with the local "
        "oscillator and counts in the SNR",
        "0.7", "1e-9", "1", default=1.0, is_power_ratio=True,
    )  # fmt: skip
    apd_gain: float = declare.number_field(
        "Avalanche gain; 1 for a PIN diode", "10", "1", "1e9", default=1.0
    )
    excess_noise_factor: float = declare.number_field(
        "Excess noise factor of the avalanche", "2.5", "1", "1e9", default=1.0
    )
    noise_figure: float = declare.quantity_field(
        "Noise figure of the radio-frequency stages; heterodyne only",
        "dB", "3 dB", "0 dB", "300 dB", default=1.0,
    )  # fmt: skip
    modulation_index: float = declare.number_field(
        "Depth of the intensity modulation; direct only", "0.9", "1e-9", "1", default=1.0
    )
    load_resistance: float = declare.quantity_field(
        "Load whose thermal noise limits direct detection; direct only",
        "ohm", "50 ohm", *_RESISTANCE_BOUNDS, default=50.0,
    )  # fmt: skip
    temperature: float = declare.quantity_field(
        "Temperature of the load; direct only", "K", "290 K", "1 nK", "1e9 K", default=290.0
    )


class Detector(SpecSection):
    """Detector applied to the bins of drawn spectra."""

    kind: str = declare.field_with_rule(
        ChoiceOrFunctionRule(
            description="Detector: fixed threshold or CFAR", options=tuple(DETECTORS)
        ),
        FIXED_THRESHOLD_KIND,
    )
    training: int = declare.integer_field(
        "Training cells of a CFAR detector, half of them on either side; even",
        "32", "2", "100000", default=32,
    )  # fmt: skip
    guard: int = declare.integer_field(
        "Guard cells on either side of the bin, which train nothing", "4", "0", "100000", default=4
    )
    rank: int = declare.integer_field(
        "Rank of OS-CFAR's training cell, 1 for the least; auto: three quarters of them",
        "24", "1", "100000", default=0, keyword="auto",
    )  # fmt: skip
    pfa: float = declare.number_field(
        "Design probability of a false alarm in a bin of noise, of CFAR detectors",
        "1e-6", "1e-30", "0.5", default=1e-6,
    )  # fmt: skip


class Estimator(SpecSection):
    """Estimator of the frequency of a detected peak between bins of drawn spectra."""

    kind: str = declare.field_with_rule(
        ChoiceOrFunctionRule(
            description="Estimator of the peak's frequency", options=tuple(ESTIMATORS)
        ),
        PEAK_BIN,
    )


def _search_band_limit_field(description: str, *rule_arguments: str) -> Any:
    """Return the declaration of a field for one limit of the search band.

    The search band is the range and the velocity in which echoes are searched.
    """
    full_description = (
        f"{description}, as a segment starts; a search band has all four ends, and without them "
        "the "
    )
    full_description += (
        "whole record is searched. What lies outside is neither detected nor a false alarm"
    )
    return declare.quantity_field(full_description, *rule_arguments, default=None)


class SearchBandSection(SpecSection):
    """Band of ranges and radial velocities in which echoes are searched.

    It selects bins by their beats.
    """

    min_range: float | None = _search_band_limit_field(
        "Smallest range searched", "m", "10 m", "0 m"
    )
    max_range: float | None = _search_band_limit_field("Largest range searched", "m", "2 km", "0 m")
    min_radial_velocity: float | None = _search_band_limit_field(
        "Smallest radial velocity searched, positive when closing", "m/s", "-5 m/s"
    )
    max_radial_velocity: float | None = _search_band_limit_field(
        "Largest radial velocity searched, positive when closing", "m/s", "40 m/s"
    )


def _design_pfa_field(noise_scope: str) -> Any:
    """Return the declaration of a field for a false-alarm probability that sets the threshold.

    `noise_scope` says in words what the probability refers to, such as ``a bin``.
    """
    description = (
        f"Instead of tnr: probability that noise alone raises a false alarm in {noise_scope}"
    )
    return declare.number_field(description, "1e-6", "1e-300", "0.99", default=None)


@add_effect_parameter_fields("instrument.processing")
class Processing(SpecSection):
    """Sampling, transform and threshold."""

    sample_rate: float = declare.quantity_field(
        "Rate of the ADC", "Hz", "600 MHz", *_FREQUENCY_BOUNDS
    )
    fft_size: int = declare.integer_field("Points of the FFT", "2^17", "2", "2^30")
    tnr: float | None = declare.number_field(
        "Threshold over the standard deviation of a noise-only bin's magnitude",
        "10", "1e-6", "1e6", default=None,
    )  # fmt: skip
    threshold_to_mean: float | None = declare.number_field(
        "Instead of tnr: threshold over the mean of a noise-only bin's magnitude",
        "4", "1e-6", "1e6", default=None,
    )  # fmt: skip
    design_pfa_bin: float | None = _design_pfa_field("a bin")
    design_pfa_segment: float | None = _design_pfa_field("any bin of a segment, the up-chirp's")
    design_pfa_shot: float | None = _design_pfa_field("any segment of a shot")
    window: str = declare.field_with_rule(
        WindowFunctionRule(
            description="Window function, by scipy.signal's name, with its parameters"
        ),
        "hamming",
    )
    acquisition_delay: float = declare.duration_field(
        "Time from the start of a segment to its first sample", "70 us", "0 s", "1e6 s", default=0.0
    )
    bins_counted: str = declare.choice_field(
        "Bins that may raise a false alarm: half the FFT, as a real record has, or all",
        ("half", "all"),
    )
    detection: str = declare.choice_field(
        "Bins by which an echo is detected: any bin that it occupies, or the largest alone",
        ("any_bin", "peak_bin"),
    )
    shot_detection: str = declare.choice_field(
        "Segments in which a shot is detected: both chirps; or any two of three, which still give "
        "range and velocity if the third is missed",
        waveform.SHOT_DETECTION_OPTIONS,
    )
    peaks: str = declare.choice_field(
        "Peaks of a segment that are reported: all that cross the threshold; or the strongest "
        "alone, which may be another than the echo's (p_wrong_range); in grids without draws, and "
        "in flights that draw whole spectra",
        waveform.REPORTED_PEAKS_OPTIONS,
    )
    two_beats: str = declare.choice_field(
        "Assumption by which two beats of a real record give range and velocity: far, "
        "the range beat of a chirp exceeds the Doppler shift (and where one of them is of the "
        "light without a chirp, the target is closing); fast, the Doppler shift exceeds them",
        waveform.TWO_BEAT_ASSUMPTIONS,
    )
    noise_bins: str = declare.choice_field(
        "Noise of bins: correlated as window and padding make it, and real at DC and "
        "Nyquist; or independent and circular, as the thesis takes it",
        ("correlated", "independent"),
    )
    search: SearchBandSection = SearchBandSection()
    detector: Detector = Detector()
    estimator: Estimator = Estimator()

    @model_validator(mode="after")
    def _check_single_threshold(self) -> Self:
        """Raise a pydantic error unless exactly one field sets the threshold."""
        threshold_fields = [
            field_name.removeprefix(PROCESSING_PREFIX) for field_name in THRESHOLD_PATHS
        ]
        given_fields = [
            field_name for field_name in threshold_fields if getattr(self, field_name) is not None
        ]
        if len(given_fields) != 1:
            problem = (
                f"sets the threshold by {' and by '.join(given_fields)}"
                if given_fields
                else "has no threshold"
            )
            remedy = (
                "keep one of them"
                if given_fields
                else f"write 'tnr: 10', or {', '.join(threshold_fields[1:])}"
            )
            raise rule_error(problem, remedy)
        return self


class LooksOfShot(SpecSection):
    """Combination of several looks (records of each segment) into one detection of a shot."""

    number: int = declare.integer_field(
        "Records of each segment. A shot lasts so many times as long, and false alarms are those "
        "of all its records together",
        "8", "1", "256", default=1,
    )  # fmt: skip
    combine: str = declare.choice_field(
        "Detection from several records: by their mean power, by the number of those that cross, "
        "or by their sum in amplitude, with the phases that a steady velocity makes put right. "
        "tnr and threshold_to_mean are over the noise of one record, or of the mean of a sum",
        COMBINE_KINDS,
    )
    votes: int = declare.integer_field(
        "Records that must cross in a bin; binary only", "3", "1", "256", default=1
    )
    speckle: str = declare.choice_field(
        "Speckle of the records: as the motion from one to the next changes it; common to all; or "
        "independent, where the beam moves on by its own width. Surfaces of a stated "
        "target.roughness have one speckle for all records of a shot",
        SPECKLE_KINDS,
    )


class Instrument(SpecSection):
    """Instrument: an FMCW Doppler lidar."""

    laser: Laser
    chirp: Chirp
    telescope: Telescope
    receiver: Receiver
    processing: Processing
    looks: LooksOfShot = LooksOfShot()


# Target, footprint, atmosphere and effects; accuracy, draws, storage and execution of a study


def sunlight_field(illuminated: str) -> Any:
    """Return the declaration of a field for the spectral irradiance of sunlight [W/m^3].

    `illuminated` names in words what is lit: a target or a scene.
    """
    description = f"Spectral irradiance of sunlight on the {illuminated}"
    return declare.quantity_field(
        description, "W/m^3", "0.5 W/m^2/nm", "0 W/m^3", "1e18 W/m^3", default=0.0
    )  # fmt: skip


REFLECTANCE_FIELD = declare.number_field("Fraction of light scattered back", "0.1", "0", "1")
"""Declaration of a field for a reflectance from 0 to 1."""


@add_effect_parameter_fields("target")
class Target(SpecSection):
    """Flat target, seen at a grazing angle."""

    range: float = declare.length_field("Distance to the target", "2 km", "1 nm", "1e15 m")
    grazing_angle: float = declare.angle_field(
        "Angle between beam and surface, 90 deg along the normal", "15 deg", "1e-6 deg", "90 deg"
    )
    reflectance: float = REFLECTANCE_FIELD
    reflectance_law: str = declare.choice_field(
        "Law of reflection: Lambertian, that of regolith, or that of the thesis",
        REFLECTANCE_LAWS,
        "lambert",
    )
    radial_velocity: float = declare.quantity_field(
        "Speed along the line of sight, positive when closing", "m/s", "150 m/s", default=0.0
    )
    solar_irradiance: float = sunlight_field("target")


@add_effect_parameter_fields("footprint")
class Footprint(SpecSection):
    """Sampling of the illuminated spot by beamlets."""

    beamlets: int = declare.integer_field(
        "Number of beamlets; auto: as many as accuracy.tolerance needs where powers add "
        "(each point of a plane and each shot of a flight as many as it needs), else 109",
        "109", "1", "100000", default=0, keyword="auto",
    )  # fmt: skip
    phases: str = declare.choice_field(
        "Whether the beamlets' optical phases follow the surface or average out",
        ("coherent", "incoherent"),
        "incoherent",
    )


@add_effect_parameter_fields("atmosphere")
class Atmosphere(SpecSection):
    """Atmosphere between instrument and target."""


@add_effect_mode_fields
class Effects(SpecSection):
    """Modes of physical effects: simulated if the tolerance requires it, always or never."""


def _tolerance_share_field(description: str) -> Any:
    """Return the declaration of a field for the part of the tolerance that one error may use.

    The field takes a number, or ``auto``: the part follows from the tolerance.
    """
    description += "; auto: as accuracy.tolerance needs"
    return declare.number_field(
        description, "1e-6", "0", "1", default=SET_BY_TOLERANCE, keyword="auto"
    )


class Accuracy(SpecSection):
    """Accuracy of the computation; part of a study's identity."""

    tolerance: float = declare.number_field(
        "Largest error of a probability of detection, of log10 of a false-alarm probability and of "
        "a relative magnitude by all omitted effects together; also the largest half-width of the "
        "interval of a drawn probability. 0 simulates every effect that the scene has",
        "1e-3", "0", "1", default=1e-3,
    )  # fmt: skip
    confidence: float = declare.number_field(
        "Confidence of the intervals of probabilities of detection that a grid draws",
        "0.95", above="0", below="1", default=0.95,
    )  # fmt: skip
    line_error: float = _tolerance_share_field(
        "Error of a bin, in noise sigmas, by few lines for many"
    )
    leakage_error: float = _tolerance_share_field(
        "Chance of leakage far from the lines that is not looked for"
    )
    leakage_floor: float = declare.number_field(
        "Bins with less leaked signal than so many noise sigmas count as noise alone, "
        "where bins are taken one by one: in draws, padded FFTs, tabulated windows, under a "
        "Gaussian line; auto: as accuracy.leakage_error allows",
        "0.1", "1e-9", "1000", default=SET_BY_TOLERANCE, keyword="auto",
    )  # fmt: skip


SPECTRA_METHOD = "spectra"
"""Value of ``draws.method`` for which a draw is a spectrum with noise in every bin."""


class Draws(SpecSection):
    """Random realisations of each point."""

    number: int = declare.integer_field(
        "Number of draws of a point; 0 computes probabilities alone",
        "10000",
        "0",
        "1e12",
        default=0,
    )
    limit: int = declare.integer_field(
        "Draws of a point at most, where it draws until accuracy.tolerance is met; 0 draws "
        "draws.number instead",
        "1e5", "0", "1e12", default=0,
    )  # fmt: skip
    batch: int = declare.integer_field(
        "Draws that are counted together", "100", "1", "1e9", default=100
    )
    method: str = declare.choice_field(
        "Draw against the probabilities, add noise to the bins that matter, or draw "
        "whole spectra for instrument.processing.detector and .estimator to examine",
        ("probabilities", "noise", SPECTRA_METHOD),
    )
    interval: str = declare.choice_field(
        "Interval of the share of draws with a detection, where noise alone is drawn: "
        "with at least the stated confidence everywhere, or on average",
        tuple(COUNT_INTERVAL_FUNCTIONS),
    )

    @property
    def has_draws(self) -> bool:
        """True if the study has draws, random realisations of each point."""
        return self.number > 0 or self.is_adaptive

    @property
    def draws_whole_spectra(self) -> bool:
        """True if each draw is a whole spectrum, which a detector and an estimator examine."""
        return self.method == SPECTRA_METHOD

    @property
    def is_adaptive(self) -> bool:
        """True if a point has draws until the tolerance is met or their number is `limit`."""
        return self.limit > 0


class Storage(SpecSection):
    """Division of results into blocks in the store; part of a study's identity."""

    block_points: int = declare.integer_field(
        "Points that one block holds at most; 0 for 65536, fewer where so many take long, and more "
        "in studies so large that their files would be too many to handle",
        "65536", "0", "1e9", default=0,
    )  # fmt: skip


class Execution(SpecSection):
    """Execution of a study; no part of its identity, because it changes no result."""

    workers: int = declare.integer_field(
        "Worker processes; 0 for threads of the command on all cores, unless something needs "
        "processes",
        "4",
        "0",
        "100000",
        default=0,
    )
    threads: int = declare.integer_field("Threads of one worker", "1", "1", "10000", default=1)
    scheduler: str = declare.text_field(
        "'none' for a plain loop on one core; empty for threads or workers on this machine",
        "",
        pattern="(none)?",
        remedy="an address is no part of a spec, which a stranger may have written: "
        "say --scheduler ADDRESS, or --cluster FILE",
    )


# Fields by dotted path: the parameters that an axis may vary

MODEL_BY_SECTION: dict[str, type[BaseModel]] = {
    "instrument": Instrument,
    "target": Target,
    "atmosphere": Atmosphere,
    "footprint": Footprint,
    "accuracy": Accuracy,
}
"""Pydantic models of the sections whose fields an axis may set, by the name of the section."""


AXES_REMEDY = (
    f"axes take fields of {', '.join([*MODEL_BY_SECTION][:-1])} and {[*MODEL_BY_SECTION][-1]}"
)
SECTIONS_NOT_ON_AXES = (
    "draws", "effects", "error_floor", "execution", "figures", "interface",
    "navigation", "platform", "question", "scanners", "scene", "seed", "storage", "title",
)  # fmt: skip
"""Names of the sections, and of fields outside sections, that no axis may set."""


@cache
def parameter_rules() -> MappingProxyType[str, Rule]:
    """Return the rules of all parameters (fields that an axis may set) by dotted path."""
    rules: dict[str, Rule] = {}
    for section, model in MODEL_BY_SECTION.items():
        rules |= rules_by_path(model, section)
    return MappingProxyType(rules)


def default_value(path: str) -> Any:
    """Return a parameter's default in SI units; None if a spec must state the parameter."""
    section, *names = path.split(".")
    model: Any = MODEL_BY_SECTION[section]
    for name in names[:-1]:
        model = model.model_fields[name].annotation
    field = model.model_fields[names[-1]]
    return None if field.is_required() else field.default


def parameter_short_name(path: str) -> str:
    """Return the last part of a parameter's dotted path; if it is ``kind``, the part before it."""
    *parent_names, last_name = path.split(".")
    return parent_names[-1] if last_name == "kind" and parent_names else last_name


def suggest_parameter(path: str, known_paths: Iterable[str] | None = None) -> str:
    """Return advice on a dotted path that names no parameter, such as a similar path.

    Parameters
    ----------
    path : str
        Path that names no parameter.
    known_paths : Iterable of str, optional
        Paths to choose from; all parameters by default.

    Returns
    -------
    str
        Suggestion, or advice on the sections that axes take.
    """
    paths = list(parameter_rules() if known_paths is None else known_paths)
    tail = parameter_short_name(path)
    same_tail = [known_path for known_path in paths if parameter_short_name(known_path) == tail]
    if len(same_tail) == 1:
        return f"did you mean '{same_tail[0]}'?"
    path_by_tail = {parameter_short_name(known_path): known_path for known_path in paths}
    suggestion = suggest_similar_name(path, paths) or suggest_similar_name(tail, path_by_tail)
    for tail_of_path, known_path in path_by_tail.items():
        suggestion = suggestion.replace(f"'{tail_of_path}'", f"'{known_path}'")
    return suggestion or AXES_REMEDY
