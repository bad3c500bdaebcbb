"""Shots of the model drawn as records of scatterers: same echo power, noise, threshold and rule.

Nothing else of the model is used: no lines, spectra or probabilities.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from scatterers import (
    SPEED_OF_LIGHT,
    Facet,
    draw_records,
    echo_beat,
    echo_bins,
    scatterer_delays,
)

from sweep.model import beam, link, window
from sweep.model.detectors import main_lobe
from sweep.model.effects.catalogue import CORE
from sweep.model.shot import Shots, find, prepare

EFFECTS = (
    *CORE, "footprint", "doppler_spread", "segment_motion", "range_walk", "image", "overlap",
    "fading",
)  # fmt: skip
SEGMENTS = ("up", "doppler", "down")

LANDER = {
    "instrument.laser.beam_divergence": 0.0, "instrument.laser.beam_waist": 5e-3,
    "instrument.telescope.coupling": "single_mode", "footprint.phases": "incoherent",
    "footprint.beamlets": 0, "footprint.pattern": "auto", "footprint.speckle": "developed",
    "instrument.receiver.noise_shape": "white", "instrument.processing.noise_bins": "correlated",
    "instrument.processing.fft_size": 8192, "instrument.processing.sample_rate": 200e6,
    "instrument.processing.acquisition_delay": 5e-6, "instrument.chirp.duration": 50e-6,
    "target.radial_velocity": 0.0, "target.reflectance_law": "lambert",
}  # fmt: skip
"""Chirps of 1 GHz in 50 us, a beam of 5 mm, records of 41 us that begin after the echo's delay."""

LOBES_BESIDE = 3
"""Main lobes on either side of an echo's lines that are drawn, and DEVIATIONS of the lines."""
DEVIATIONS = 4.5
SCATTERERS = 64
SCATTERERS_PER_BIN = 24


def shots_of(parameters, effects=EFFECTS) -> Shots:
    ((_, shots),) = prepare(parameters, tuple(dict.fromkeys(effects)))
    return shots


def with_threshold(parameters, ratio):
    """Parameters with a laser power for which the up-chirp's |X| is the threshold over a ratio."""
    shots = shots_of(parameters)
    factor = float(shots.threshold[0]) * ratio / float(find(shots)[0, 2, 0])
    return parameters | {"instrument.laser.power": parameters["instrument.laser.power"] * factor**2}


def number(value) -> float:
    """First of some numbers that are alike."""
    return float(np.ravel(value)[0])


def facet_of(p, shots) -> Facet:
    """Facet that the single point of parameters by path sees, and its records."""
    distance = number(p["target.range"])
    radius = number(beam.beams(p)[0].radius(distance))
    return Facet(
        range=distance,
        grazing_angle=number(p["target.grazing_angle"]),
        beam_deviation=radius / np.sqrt(8),  # of the product of two equal beams
        wavelength=number(p["instrument.laser.wavelength"]),
        bandwidth=number(p["instrument.chirp.bandwidth"]),
        duration=number(p["instrument.chirp.duration"]),
        sample_rate=number(p["instrument.processing.sample_rate"]),
        fft_size=int(number(p["instrument.processing.fft_size"])),
        window=window.samples(shots.window.name, shots.window.length),
        acquisition_delay=number(p["instrument.processing.acquisition_delay"]),
        radial_velocity=number(p["target.radial_velocity"]),
        transverse_velocity=number(p["target.transverse_velocity"]),
        segments=shots.order,
        gap=number(p.get("instrument.chirp.gap", 0.0)),
        complex_record=shots.complex_record,
        looks=shots.looks.number,
        slide=number(shots.approach - shots.radial_velocity),
    )


def amplitudes_of(facet: Facet, shots) -> dict[str, float]:
    """Root mean square amplitude of each segment's beat, behind the receiver's poles [V]."""
    amplitude = {}
    for segment in facet.segments:
        gain = link.transfer(
            np.array(echo_beat(facet, segment)),
            detector_bandwidth=shots.detector_bandwidth,
            amplifier_bandwidth=shots.amplifier_bandwidth,
        )
        echo = shots.beat_scale * np.sqrt(shots.relative_echo) * np.abs(gain)
        amplitude[segment] = number(echo * shots.whitening[SEGMENTS.index(segment)])
    return amplitude


def line_deviation(facet: Facet) -> float:
    """Largest standard deviation of the scatterers' beats in a segment [bins of fs/L]."""
    delay, doppler = scatterer_delays(facet, 256, np.random.default_rng(0))
    carrier = SPEED_OF_LIGHT / facet.wavelength
    rate = facet.bandwidth / facet.duration
    beats = [carrier * doppler + slope * rate * delay for slope in (-1, 0, 1)]
    return max(np.std(beats, axis=1)) * facet.window.size / facet.sample_rate


class DrawnShots(NamedTuple):
    """Drawn spectra of a shot by segment."""

    bins: dict[str, np.ndarray]
    """(k,): of complex records signed."""
    values: dict[str, np.ndarray]
    """(draws, looks, k): complex X, noise included."""
    mean_power: dict[str, np.ndarray]
    """(k,): mean of |X|^2 without noise."""


def draw_shots(
    p, shots, *, draws: int, seed: int, renewals: int = 4, facet: Facet | None = None
) -> DrawnShots:
    """Draw the spectra of a point about its echo, or those of another facet."""
    facet = facet or facet_of(p, shots)
    deviation, padding = line_deviation(facet), facet.fft_size / facet.window.size
    lobe = main_lobe(shots.window)
    reach = math.ceil((LOBES_BESIDE * lobe + DEVIATIONS * deviation) * padding) + 2
    bins = {
        segment: echo_bins(facet, segment, min(reach, facet.fft_size // 2 - 1))
        for segment in facet.segments
    }
    looks = shots.looks
    batches = list(
        draw_records(
            facet, bins=bins, amplitude=amplitudes_of(facet, shots),
            noise_deviation=number(np.sqrt(shots.noise_variance)), draws=draws, seed=seed,
            scatterers=SCATTERERS + int(SCATTERERS_PER_BIN * deviation), renewals=renewals,
            speckle="independent" if looks.independent else "motion" if looks.moving else "common",
        )
    )  # fmt: skip
    return DrawnShots(
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
    magnitude, place = np.sqrt(mean_power), np.arange(mean_power.size)
    if shots.detection == "peak_bin":
        return place == strongest_bin(mean_power)
    half_lobe = math.ceil(main_lobe(shots.window) * shots.fft_size / shots.window.length)
    searched = np.zeros(place.size, bool)
    for bins, beside in (
        (np.flatnonzero(magnitude >= magnitude.max() / 2), half_lobe),
        (np.flatnonzero(magnitude >= number(shots.threshold)), 1),
    ):
        if bins.size:
            searched |= np.abs(place[:, None] - bins).min(axis=1) <= beside
    return searched


def detections(drawn: DrawnShots, shots) -> dict[str, np.ndarray]:
    """Detection of each drawn shot by segment, (draws,) bool."""
    looks, level = shots.looks, number(shots.threshold) ** 2
    detected = {}
    for segment, values in drawn.values.items():
        power = np.abs(values[:, :, searched_bins(drawn.mean_power[segment], shots)]) ** 2
        if looks.combine == "binary":
            in_bins = (power >= level).sum(axis=1) >= looks.votes
        else:
            in_bins = power.mean(axis=1) >= level
        detected[segment] = in_bins.any(axis=1)
    return detected


def shot_detections(detected: dict[str, np.ndarray], shots) -> np.ndarray:
    """Detection of each drawn shot, (draws,) bool: by any two segments, or by both chirps."""
    if shots.any_two:
        return np.sum(list(detected.values()), axis=0) >= 2
    return detected["up"] & detected["down"]


def drawn_detections(p: Any, shots, *, draws: int, seed: int) -> dict[str, np.ndarray]:
    """Detection of each segment of drawn shots, (draws,) bool."""
    return detections(draw_shots(p, shots, draws=draws, seed=seed), shots)
