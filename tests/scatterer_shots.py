"""Shots of the model drawn as records of scatterers: same echo power, noise, threshold and rule.

Nothing else of the model is used: no lines, spectra or probabilities.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from scatterers import (
    SPEED_OF_LIGHT,
    Facet,
    draw_spectra,
    echo_beat,
    echo_bins,
    scatterer_delays,
)

from sweep.model import beam, receiver_chain, window
from sweep.model.detection.detectors import main_lobe_half_width
from sweep.model.effects.catalogue import DEFAULT_EFFECTS
from sweep.model.evaluation import Shots, evaluate_segments, prepare_shots

COMPARED_EFFECTS = (
    *DEFAULT_EFFECTS,
    "footprint",
    "doppler_spread",
    "segment_motion",
    "range_walk",
    "image",
    "overlap",
    "fading",
)
SEGMENTS = ("up", "doppler", "down")

LANDER_PARAMETERS = {
    "instrument.laser.beam_divergence": 0.0, "instrument.laser.beam_waist": 5e-3,
    "instrument.telescope.coupling": "single_mode", "footprint.phases": "incoherent",
    "footprint.beamlets": 0, "footprint.pattern": "auto", "footprint.speckle": "developed",
    "instrument.receiver.noise_shape": "white", "instrument.processing.noise_bins": "correlated",
    "instrument.processing.fft_size": 8192, "instrument.processing.sample_rate": 200e6,
    "instrument.processing.acquisition_delay": 5e-6, "instrument.chirp.duration": 50e-6,
    "target.radial_velocity": 0.0, "target.reflectance_law": "lambert",
}  # fmt: skip
"""Chirps of 1 GHz in 50 us, a beam of 5 mm, records of 41 us that begin after the echo's delay."""

LOBES_EACH_SIDE = 3
"""Main lobes on either side of an echo's lines that are drawn, and DEVIATIONS of the lines."""
LINE_DEVIATIONS_EACH_SIDE = 4.5
SCATTERERS_MIN = 64
SCATTERERS_PER_BIN = 24


def prepare_single_category(parameters, effects=COMPARED_EFFECTS) -> Shots:
    ((_, shots),) = prepare_shots(parameters, tuple(dict.fromkeys(effects)))
    return shots


def with_signal_over_threshold(parameters, threshold_over_signal):
    """Parameters with a laser power for which the up-chirp's |X| is the threshold over a ratio."""
    shots = prepare_single_category(parameters)
    amplitude_factor = (
        float(shots.threshold[0])
        * threshold_over_signal
        / float(evaluate_segments(shots).magnitude[0, 0])
    )
    return parameters | {
        "instrument.laser.power": parameters["instrument.laser.power"] * amplitude_factor**2
    }


def first_value(value) -> float:
    """First of some numbers that are alike."""
    return float(np.ravel(value)[0])


def point_facet(parameters, shots) -> Facet:
    """Facet that the single point of parameters by path sees, and its records."""
    distance = first_value(parameters["target.range"])
    radius = first_value(beam.transmitted_and_oscillator_beams(parameters)[0].radius(distance))
    return Facet(
        range=distance,
        grazing_angle=first_value(parameters["target.grazing_angle"]),
        beam_deviation=radius / np.sqrt(8),  # of the product of two equal beams
        wavelength=first_value(parameters["instrument.laser.wavelength"]),
        bandwidth=first_value(parameters["instrument.chirp.bandwidth"]),
        duration=first_value(parameters["instrument.chirp.duration"]),
        sample_rate=first_value(parameters["instrument.processing.sample_rate"]),
        fft_size=int(first_value(parameters["instrument.processing.fft_size"])),
        window=window.window_samples(shots.window.name, shots.window.length),
        acquisition_delay=first_value(parameters["instrument.processing.acquisition_delay"]),
        radial_velocity=first_value(parameters["target.radial_velocity"]),
        transverse_velocity=first_value(parameters["target.transverse_velocity"]),
        segments=shots.waveform.segment_order,
        gap=first_value(parameters.get("instrument.chirp.gap", 0.0)),
        complex_record=shots.complex_record,
        looks=shots.looks.number,
        footprint_slide_speed=first_value(
            shots.target.approach_speed - shots.target.radial_velocity
        ),
    )


def segment_amplitudes(facet: Facet, shots) -> dict[str, float]:
    """Root mean square amplitude of each segment's beat, behind the receiver's poles [V]."""
    amplitude_by_segment = {}
    for segment in facet.segments:
        gain = receiver_chain.receiver_transfer_function(
            np.array(echo_beat(facet, segment)),
            detector_bandwidth=shots.receiver_filter.detector_bandwidth,
            amplifier_bandwidth=shots.receiver_filter.amplifier_bandwidth,
        )
        echo_amplitude = (
            shots.echo_scales.beat_amplitude_scale
            * np.sqrt(shots.total_relative_echo)
            * np.abs(gain)
        )
        amplitude_by_segment[segment] = first_value(
            echo_amplitude * shots.whitening_gain[SEGMENTS.index(segment)]
        )
    return amplitude_by_segment


def line_deviation(facet: Facet) -> float:
    """Largest standard deviation of the scatterers' beats in a segment [bins of fs/L]."""
    delay, doppler = scatterer_delays(facet, 256, np.random.default_rng(0))
    carrier = SPEED_OF_LIGHT / facet.wavelength
    rate = facet.bandwidth / facet.duration
    beats = [carrier * doppler + slope * rate * delay for slope in (-1, 0, 1)]
    return max(np.std(beats, axis=1)) * facet.window.size / facet.sample_rate


class SegmentSpectra(NamedTuple):
    """Drawn spectra of a shot by segment."""

    bins: dict[str, np.ndarray]
    """(k,): of complex records signed."""
    values: dict[str, np.ndarray]
    """(draws, looks, k): complex X, noise included."""
    mean_power: dict[str, np.ndarray]
    """(k,): mean of |X|^2 without noise."""


def draw_shots(
    parameters, shots, *, draws: int, seed: int, renewals: int = 4, facet: Facet | None = None
) -> SegmentSpectra:
    """Draw the spectra of a point about its echo, or those of another facet."""
    facet = facet or point_facet(parameters, shots)
    deviation, padding = line_deviation(facet), facet.fft_size / facet.window.size
    lobe = main_lobe_half_width(shots.window)
    half_width_bins = (
        math.ceil((LOBES_EACH_SIDE * lobe + LINE_DEVIATIONS_EACH_SIDE * deviation) * padding) + 2
    )
    bins = {
        segment: echo_bins(facet, segment, min(half_width_bins, facet.fft_size // 2 - 1))
        for segment in facet.segments
    }
    looks = shots.looks
    batches = list(
        draw_spectra(
            facet,
            bins=bins,
            amplitude_by_segment=segment_amplitudes(facet, shots),
            noise_deviation=first_value(np.sqrt(shots.noise_variance)),
            draws=draws,
            seed=seed,
            scatterers=SCATTERERS_MIN + int(SCATTERERS_PER_BIN * deviation),
            n_scatterer_sets=renewals,
            speckle="independent"
            if looks.has_independent_speckle
            else "motion"
            if looks.has_moving_speckle
            else "common",
        )
    )
    return SegmentSpectra(
        bins,
        {s: np.concatenate([batch.values[s] for batch in batches]) for s in facet.segments},
        {s: np.mean([batch.mean_power[s] for batch in batches], axis=0) for s in facet.segments},
    )


FLAT_BINS = 4
"""Bins within a tenth of the largest mean power from which draws do not tell the strongest."""


def strongest_bin(mean_power: np.ndarray) -> int:
    """Index of the strongest bin: that of a parabola where the drawn means have a flat top."""
    top = mean_power.max()
    if (mean_power > 0.9 * top).sum() < FLAT_BINS:
        return int(mean_power.argmax())
    place = np.flatnonzero(mean_power > 0.6 * top)
    middle = place.mean()
    bend, slope, _ = np.polyfit(place - middle, np.log(mean_power[place]), 2)
    vertex = middle - 0.5 * slope / bend if bend < 0 else mean_power.argmax()
    return int(np.clip(round(vertex), place[0], place[-1]))


def searched_bins(mean_power: np.ndarray, shots) -> np.ndarray:
    """Bins (k,) bool that detect an echo of such a mean power.

    The strongest alone; or those within a main lobe of a bin of half the largest magnitude, those
    at or above the threshold, and their neighbours.
    """
    magnitude, positions = np.sqrt(mean_power), np.arange(mean_power.size)
    if shots.detection_settings.echo_bin_rule == "peak_bin":
        return positions == strongest_bin(mean_power)
    half_lobe = math.ceil(main_lobe_half_width(shots.window) * shots.fft_size / shots.window.length)
    searched = np.zeros(positions.size, bool)
    for bins, reach in (
        (np.flatnonzero(magnitude >= magnitude.max() / 2), half_lobe),
        (np.flatnonzero(magnitude >= first_value(shots.threshold)), 1),
    ):
        if bins.size:
            searched |= np.abs(positions[:, None] - bins).min(axis=1) <= reach
    return searched


def segment_detections(spectra: SegmentSpectra, shots) -> dict[str, np.ndarray]:
    """Detection of each drawn shot by segment, (draws,) bool."""
    looks, threshold_power = shots.looks, first_value(shots.threshold) ** 2
    detected_by_segment = {}
    for segment, values in spectra.values.items():
        power = np.abs(values[:, :, searched_bins(spectra.mean_power[segment], shots)]) ** 2
        if looks.combine_kind == "binary":
            is_detected_in_bin = (power >= threshold_power).sum(axis=1) >= looks.votes_needed
        else:
            is_detected_in_bin = power.mean(axis=1) >= threshold_power
        detected_by_segment[segment] = is_detected_in_bin.any(axis=1)
    return detected_by_segment


def shot_detections(detected: dict[str, np.ndarray], shots) -> np.ndarray:
    """Detection of each drawn shot, (draws,) bool: by any two segments, or by both chirps."""
    if shots.detects_by_any_two_segments:
        return np.sum(list(detected.values()), axis=0) >= 2
    return detected["up"] & detected["down"]


def draw_segment_detections(
    parameters: Any, shots, *, draws: int, seed: int
) -> dict[str, np.ndarray]:
    """Detection of each segment of drawn shots, (draws,) bool."""
    return segment_detections(draw_shots(parameters, shots, draws=draws, seed=seed), shots)
