"""Table of random specs in developed speckle, compared with drawn scatterers.

``make validate-speckle`` prints a row for every spec: probabilities of detection that a study
stores, those of drawn records (:mod:`scatterer_shots`), and the difference over what is allowed,
five standard deviations of the drawn share, the spec's tolerance, and the error that
docs/physics.md states for the law of this kind. The exit status is 1 if any spec is beyond.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
import time
from collections import defaultdict
from collections.abc import Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from scatterer_shots import (
    COMPARED_EFFECTS,
    SEGMENTS,
    draw_shots,
    first_value,
    line_deviation,
    point_facet,
    prepare_single_category,
    segment_detections,
    shot_detections,
)
from scatterers import SPEED_OF_LIGHT, Facet, echo_beat

from sweep.model.evaluation import Shots, evaluate_segments
from sweep.model.unsupported_shot import UnsupportedShotError
from sweep.spec import GridSpec, SpecError
from sweep.tasks.studies.grid_study import GridStudy

WAVELENGTH = 1550e-9
ALLOWED_SIGMAS = 5.0
DRAWS = 24_000
WINDOWS = ("rectangular", "hann", "hamming", "blackman", "flattop")
TOLERANCE = 1e-3
"""``accuracy.tolerance`` of the specs, its default."""
PD_RANGE = (0.02, 0.985)
"""Probabilities of the up- or down-chirp from which a comparison says something."""


# Random specs


def random_mapping(rng: np.random.Generator) -> dict[str, Any]:
    """A spec of one point, which may be refused."""
    rule = str(rng.choice(["any_bin", "peak_bin", "looks"], p=[0.55, 0.25, 0.2]))
    padding_factor = int(rng.choice([1, 2, 4], p=[0.6, 0.25, 0.15]))
    fft_size = int(2 ** rng.integers(8, 13 if rule != "looks" else 11))
    record_length = max(fft_size // padding_factor, 64)
    fft_size, rate = record_length * padding_factor, float(rng.choice([100e6, 200e6, 400e6]))
    record_duration = record_length / rate
    beam_waist, bandwidth = (
        np.exp(rng.uniform(np.log(7e-4), np.log(8e-3))),
        10 ** rng.uniform(8.7, 9.6),
    )
    acquisition_delay = rng.uniform(0.05, 0.4) * record_duration
    duration = acquisition_delay + record_duration * (
        1.0 if padding_factor > 1 else rng.uniform(1.0, 1.1)
    )
    range_beat = rng.uniform(0.04, 0.42) * rate
    target_range = range_beat * SPEED_OF_LIGHT * duration / (2 * bandwidth)
    grazing_angle_deg = float(
        rng.choice([90.0, np.exp(rng.uniform(0.0, np.log(90)))], p=[0.1, 0.9])
    )
    bin_width = rate / record_length
    line_position = str(rng.choice(["doppler at dc", "up at dc", "far"], p=[0.25, 0.08, 0.67]))
    doppler_frequency = {
        "doppler at dc": rng.uniform(-2.5, 2.5) * bin_width * rng.integers(0, 2),
        "up at dc": range_beat + rng.uniform(-2.5, 2.5) * bin_width,
        "far": rng.choice([-1, 1]) * rng.uniform(0.0, 0.45 * rate - range_beat),
    }[line_position]
    far_field = target_range > 4 * np.pi * beam_waist**2 / WAVELENGTH
    transverse_velocity = rng.uniform(-30, 30) if far_field and rng.random() < 0.6 else 0.0
    segments = str(rng.choice(
        ["up doppler down", "up down", "down up", "up down doppler"], p=[0.6, 0.2, 0.1, 0.1]
    ))  # fmt: skip
    any_two = "doppler" in segments and rng.random() < 0.3
    record_kind = str(rng.choice(["real", "complex"], p=[0.7, 0.3]))
    instrument = {
        "laser": {"wavelength": WAVELENGTH, "power": 1.0, "beam_waist": beam_waist},
        "chirp": {
            "bandwidth": bandwidth, "start_frequency": 5.5e9, "duration": duration,
            "segments": segments, "gap": float(rng.choice([0.0, rng.uniform(0, 5e-6)])),
        },
        "telescope": {"aperture": 25e-3},
        "receiver": {
            "responsivity": 1.1, "detector_bandwidth": 2e9, "optical_passband": 25e-9,
            "noise_equivalent_power": 5e-12, "transimpedance": 7e3, "amplifier_bandwidth": 2e9,
            "amplifier_noise_current": 25e-9, "record": record_kind,
            "noise_shape": str(rng.choice(["white", "receiver"], p=[0.7, 0.3])),
        },
        "processing": {
            "sample_rate": rate, "fft_size": fft_size, "window": str(rng.choice(WINDOWS)),
            "tnr": rng.uniform(5.5, 12.0), "acquisition_delay": acquisition_delay,
            "detection": "peak_bin" if rule == "looks" else rule,
            "shot_detection": "any_two" if any_two else "both_chirps",
        },
    }  # fmt: skip
    if rule == "looks":
        n_looks = int(rng.integers(2, 9))
        instrument["looks"] = {
            "number": n_looks, "combine": str(rng.choice(["power", "binary"])),
            "votes": int(rng.integers(1, n_looks + 1)),
            "speckle": str(rng.choice(["motion", "common", "independent"], p=[0.6, 0.2, 0.2])),
        }  # fmt: skip
    return {
        "title": "Speckle at random",
        "instrument": instrument,
        "target": {
            "range": target_range,
            "reflectance": 0.1,
            "reflectance_law": "lambert",
            "grazing_angle": math.radians(grazing_angle_deg),
            "radial_velocity": doppler_frequency * WAVELENGTH / 2,
            "transverse_velocity": transverse_velocity,
        },
    }


class RandomSpec(NamedTuple):
    """A valid spec of one point, with what its study stores."""

    mapping: dict[str, Any]
    spec: GridSpec
    parameters: Mapping[str, Any]
    shots: Shots
    stored_pd: dict[str, float]
    """pd_up, pd_doppler (nan if there is none), pd_down and pd_shot."""


def random_valid_spec(seed: int, spec_number: int) -> RandomSpec:
    """The spec of a number in the table: random ones until one is valid and says something."""
    rng = np.random.default_rng([seed, spec_number])
    while True:
        mapping = random_mapping(rng)
        signal_over_threshold = np.exp(rng.uniform(np.log(0.8), np.log(5.0)))
        try:
            random_spec = spec_of_ratio(mapping, signal_over_threshold)
        except (SpecError, UnsupportedShotError):
            continue
        chirp_pd = [random_spec.stored_pd["pd_up"], random_spec.stored_pd["pd_down"]]
        if PD_RANGE[0] < min(chirp_pd) and max(chirp_pd) < PD_RANGE[1]:
            return random_spec


def spec_of_ratio(mapping: dict[str, Any], ratio: float) -> RandomSpec:
    """The spec with the laser power for which a chirp's |X| is so many times the threshold."""
    study = GridStudy(GridSpec.from_mapping(with_units(mapping)))
    shots = prepare_single_category(study.grid.parameters_of_block(0), COMPARED_EFFECTS)
    magnitude = np.nanmax(evaluate_segments(shots).magnitude[[0, 2], 0])
    mapping["instrument"]["laser"]["power"] = (
        ratio * first_value(shots.threshold) / magnitude
    ) ** 2
    spec = GridSpec.from_mapping(with_units(mapping))
    study = GridStudy(spec)
    results = study.evaluate(0)
    stored = {
        name: first_value(results[name]) for name in (*(f"pd_{s}" for s in SEGMENTS), "pd_shot")
    }
    if np.isnan(stored["pd_shot"]):
        raise UnsupportedShotError("beyond the model")
    parameters = study.grid.parameters_of_block(0)
    return RandomSpec(
        mapping, spec, parameters, prepare_single_category(parameters, COMPARED_EFFECTS), stored
    )


UNIT_BY_FIELD = {
    "wavelength": "m", "power": "W", "beam_waist": "m", "bandwidth": "Hz", "start_frequency": "Hz",
    "duration": "s", "gap": "s", "aperture": "m", "responsivity": "A/W",
    "detector_bandwidth": "Hz", "optical_passband": "m", "noise_equivalent_power": "W/Hz^0.5",
    "transimpedance": "ohm", "amplifier_bandwidth": "Hz", "amplifier_noise_current": "A",
    "sample_rate": "Hz", "acquisition_delay": "s", "range": "m", "grazing_angle": "rad",
    "radial_velocity": "m/s", "transverse_velocity": "m/s",
}  # fmt: skip


def with_units(section: Any, name: str = "") -> Any:
    """A section of a spec whose numbers in SI have their units written out."""
    if isinstance(section, dict):
        return {key: with_units(value, key) for key, value in section.items()}
    return f"{float(section)!r} {UNIT_BY_FIELD[name]}" if name in UNIT_BY_FIELD else section


# Comparison


class Comparison(NamedTuple):
    """Stored and drawn probability of one segment or of the shot."""

    quantity: str
    stored: float
    drawn: float
    drawn_deviation: float
    """Standard deviation of the drawn share."""
    stated_error: float
    """Largest error that docs/physics.md states for the law of this kind."""
    tolerance: float

    @property
    def difference(self) -> float:
        return self.stored - self.drawn

    @property
    def error_over_allowed(self) -> float:
        """Difference over that which is allowed; beyond it above 1."""
        return abs(self.difference) / (
            ALLOWED_SIGMAS * self.drawn_deviation + self.tolerance + self.stated_error
        )


class ComparisonRow(NamedTuple):
    """A spec of the table with its comparisons."""

    spec_number: int
    rule: str
    window: str
    padding: int
    fft_size: int
    record: str
    segments: str
    grazing_angle_deg: float
    """Grazing angle [deg]."""
    line_deviation_bins: float
    """Deviation of the lines [bins of fs/L]."""
    bins_from_end: float
    """Distance of the nearest segment's line from DC or Nyquist [bins of fs/L]."""
    threshold_over_noise: float
    """[sigma]"""
    comparisons: tuple[Comparison, ...]

    @property
    def worst(self) -> Comparison:
        return max(self.comparisons, key=lambda comparison: comparison.error_over_allowed)

    @property
    def is_near_end(self) -> bool:
        return (
            self.bins_from_end < NEAR_END_BINS + NEAR_END_LINE_DEVIATIONS * self.line_deviation_bins
        )

    def error_group(self, comparison: Comparison) -> tuple[str, ...]:
        """Kind by which errors are summed up."""
        quantity = "shot" if comparison.quantity == "shot" else "segment"
        rule_words = self.rule.split()
        rule = (
            rule_words[0]
            if len(rule_words) < 3
            else f"looks {'power' if 'mean' in rule_words else 'votes'}"
        )
        any_two = " any_two" if quantity == "shot" and "any_two" in rule_words else ""
        slope_class = (
            "below 5 deg"
            if self.grazing_angle_deg < 5
            else "to 30 deg"
            if self.grazing_angle_deg < 30
            else "steeper"
        )
        return (
            quantity,
            rule + any_two,
            self.window,
            "DC" if self.is_near_end else "",
            slope_class,
        )


NEAR_END_BINS, NEAR_END_LINE_DEVIATIONS = 4.0, 3.0
NARROW_LINE_BINS = 0.2
"""Deviation [bins of fs/L] up to which lines near DC are taken for one."""


class StatedErrors(NamedTuple):
    """Largest errors that docs/physics.md states for the laws of developed speckle."""

    peak_bin: float = 0.002
    peak_bin_any_two: float = 0.01
    """Any two segments, by ``peak_bin``."""
    any_bin: float = 0.01
    rectangular: float = 0.02
    """``any_bin`` of the rectangular window; of one that is padded :attr:`padded`."""
    padded: float = 0.035
    wide: float = 0.03
    """``any_bin`` of a padded record, of lines that spread over more than WIDE bins."""
    near_end: float = 0.03
    """``any_bin`` of a line within a main lobe of DC or Nyquist."""
    across_end: float = 0.06
    """``any_bin`` of lines that spread across DC or Nyquist."""
    joint_segments: float = 0.01
    """Further error of the law of several segments with ``any_bin``."""
    moving_looks: float = 0.025
    """Shots of several looks whose speckle motion changes; segments have the half."""
    alike_looks: float = 0.015
    """Shots of several looks in common or independent speckle."""


STATED_ERRORS = StatedErrors()
WIDE_LINE_BINS = 4.0


def stated_error(quantity: str, shots: Shots, facet: Facet) -> float:
    """Largest error that docs/physics.md states for the law of a segment or of the shot."""
    if shots.looks.is_noncoherent:
        if not shots.looks.has_moving_speckle:
            return STATED_ERRORS.alike_looks if quantity == "shot" else STATED_ERRORS.peak_bin
        return STATED_ERRORS.moving_looks if quantity == "shot" else STATED_ERRORS.moving_looks / 2
    if shots.detection_settings.echo_bin_rule == "peak_bin":
        is_any_two_shot = quantity == "shot" and shots.detects_by_any_two_segments
        return STATED_ERRORS.peak_bin_any_two if is_any_two_shot else STATED_ERRORS.peak_bin
    line_deviation_bins, is_padded = line_deviation(facet), shots.fft_size > shots.window.length
    errors = [STATED_ERRORS.any_bin]
    if shots.window.name == "rectangular":
        errors.append(STATED_ERRORS.padded if is_padded else STATED_ERRORS.rectangular)
    if is_padded and line_deviation_bins > WIDE_LINE_BINS:
        errors.append(STATED_ERRORS.wide)
    if is_near_end(facet, line_deviation_bins):
        errors.append(
            STATED_ERRORS.across_end
            if line_deviation_bins > NARROW_LINE_BINS
            else STATED_ERRORS.near_end
        )
    return max(errors) + (STATED_ERRORS.joint_segments if quantity == "shot" else 0.0)


def is_near_end(facet: Facet, line_deviation_bins: float) -> bool:
    """True where lines or the main lobe of a segment lie across DC or Nyquist."""
    return distance_from_end(facet) < NEAR_END_BINS + NEAR_END_LINE_DEVIATIONS * line_deviation_bins


def detection_rule_text(shots: Shots) -> str:
    """Rule of detection in a few words."""
    looks, rule = shots.looks, shots.detection_settings.echo_bin_rule
    if looks.is_noncoherent:
        speckle = (
            "independent"
            if looks.has_independent_speckle
            else "motion"
            if looks.has_moving_speckle
            else "common"
        )
        votes = f"{looks.votes_needed} of" if looks.combine_kind == "binary" else "mean of"
        rule = f"{votes} {looks.number} {speckle}"
    return rule + (" any_two" if shots.detects_by_any_two_segments else "")


def distance_from_end(facet: Facet) -> float:
    """Distance of the nearest segment's line from DC or Nyquist [bins of fs/L]."""
    nearest_bins = math.inf
    for segment in () if facet.complex_record else facet.segments:
        cycles_per_sample = echo_beat(facet, segment) / facet.sample_rate
        bins_from_dc = abs(cycles_per_sample - round(cycles_per_sample)) * facet.window.size
        nearest_bins = min(nearest_bins, bins_from_dc, facet.window.size / 2 - bins_from_dc)
    return nearest_bins


def compare_spec(seed: int, spec_number: int, draws: int = DRAWS) -> ComparisonRow:
    """Draw a random spec's shots, and compare how often they are detected with what is stored."""
    random_spec = random_valid_spec(seed, spec_number)
    shots = random_spec.shots
    drawn_shots = draw_shots(random_spec.parameters, shots, draws=draws, seed=spec_number)
    detected_by_quantity = segment_detections(drawn_shots, shots)
    detected_by_quantity["shot"] = shot_detections(detected_by_quantity, shots)
    facet = point_facet(random_spec.parameters, shots)
    comparisons = []
    for quantity, values in detected_by_quantity.items():
        detected_share, stored_pd = float(values.mean()), random_spec.stored_pd[f"pd_{quantity}"]
        pd_bounds = np.clip([detected_share, stored_pd], 1 / draws, 1 - 1 / draws)
        share_deviation = float(np.sqrt(pd_bounds * (1 - pd_bounds) / values.size).max())
        stated_sigma = stated_error(quantity, shots, facet)
        comparisons.append(
            Comparison(
                quantity, stored_pd, detected_share, share_deviation, stated_sigma, TOLERANCE
            )
        )
    return ComparisonRow(
        spec_number=spec_number,
        rule=detection_rule_text(shots),
        window=shots.window.name,
        padding=shots.fft_size // shots.window.length,
        fft_size=shots.fft_size,
        record="I/Q" if shots.complex_record else "real",
        segments=" ".join(facet.segments),
        grazing_angle_deg=math.degrees(facet.grazing_angle),
        line_deviation_bins=line_deviation(facet),
        bins_from_end=distance_from_end(facet),
        threshold_over_noise=first_value(shots.threshold / shots.bin_noise_sigma),
        comparisons=tuple(comparisons),
    )


TABLE_HEADER = (
    f"{'no':>4} {'rule':22} {'window':>12} {'N':>5} {'rec':>4} {'waveform':16} {'slope':>6} "
    f"{'spread':>6} {'to DC':>6} {'Th':>5} | {'worst':8} {'stored':>7} {'drawn':>7} {'sigma':>6} "
    f"{'differs':>8} {'stated':>6} {'ratio':>6}"
)


def format_row(row: ComparisonRow) -> str:
    """A row of the table, by the comparison that is worst."""
    worst = row.worst
    window = f"{row.window} x{row.padding}"
    bins_from_end_text = f"{row.bins_from_end:6.1f}" if row.bins_from_end < 100 else "   far"
    return (
        f"{row.spec_number:4} {row.rule:22} {window:>12.12} {row.fft_size:5} {row.record:>4} "
        f"{row.segments:16} {row.grazing_angle_deg:6.1f} {row.line_deviation_bins:6.2f} "
        f"{bins_from_end_text} {row.threshold_over_noise:5.2f} | "
        f"{worst.quantity:8} {worst.stored:7.4f} {worst.drawn:7.4f} {worst.drawn_deviation:6.4f} "
        f"{worst.difference:+8.4f} {worst.stated_error:6.3f} {worst.error_over_allowed:6.2f}"
        + (" BEYOND" if worst.error_over_allowed > 1 else "")
    )


def iter_rows(seed: int, n_specs: int, draws: int, processes: int) -> Iterator[ComparisonRow]:
    """Compare specs 0 .. specs - 1 of a seed, in their order."""
    if processes == 1:
        yield from (compare_spec(seed, spec_number, draws) for spec_number in range(n_specs))
        return
    with ProcessPoolExecutor(processes) as pool:
        yield from pool.map(partial(compare_spec, seed, draws=draws), range(n_specs))


def error_summary(rows: list[ComparisonRow]) -> str:
    """Largest errors by kind, and how many specs are beyond what is allowed."""
    by_kind: dict[tuple[str, ...], list[Comparison]] = defaultdict(list)
    for row in rows:
        for comparison in row.comparisons:
            by_kind[row.error_group(comparison)].append(comparison)
    lines = [
        f"{'pd of':8} {'rule':18} {'window':12} {'':3} {'slope':12} {'n':>4} {'largest error':>14} "
        f"{'sigmas':>7} {'stated':>7}"
    ]
    for group, comparisons in sorted(by_kind.items()):
        largest = max(comparisons, key=lambda candidate: abs(candidate.difference))
        lines.append(
            f"{group[0]:8} {group[1]:18} {group[2]:12} {group[3]:3} {group[4]:12} "
            f"{len(comparisons):4} "
            f"{largest.difference:+14.4f} {abs(largest.difference) / largest.drawn_deviation:7.1f} "
            f"{largest.stated_error:7.3f}"
        )
    specs_beyond = [row.spec_number for row in rows if row.worst.error_over_allowed > 1]
    numbers_text = f": {', '.join(map(str, specs_beyond))}" if specs_beyond else ""
    lines.append(
        f"{len(specs_beyond)} of {len(rows)} specs are beyond what is allowed{numbers_text}"
    )
    return "\n".join(lines)


def main() -> int:
    """Print the table. The exit status is 1 if a spec is beyond what is allowed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--specs", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--draws", type=int, default=DRAWS)
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1)
    options = parser.parse_args()
    start_time, rows = time.perf_counter(), []
    print(TABLE_HEADER)
    for row in iter_rows(options.seed, options.specs, options.draws, options.processes):
        rows.append(row)
        print(format_row(row), flush=True)
    print(error_summary(rows))
    print(f"{options.draws} draws a spec, {time.perf_counter() - start_time:.0f} s")
    return int(any(row.worst.error_over_allowed > 1 for row in rows))


if __name__ == "__main__":
    sys.exit(main())
