"""Test tolerances with random instruments, whose smeared lines lie near DC or Nyquist.

Every run draws other instruments. Their lines are smeared by range walk, acceleration, a nonlinear
sweep, line width and jitter of the beam. At each tolerance they are compared with all effects on at
the tightest tolerance. Each point is planned by itself, so that it has only the effects that it
needs.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from benchmark_helpers import TABLE_4_1, load_mapping, markdown_table

from sweep.model.beamlet_counts import effects_tolerance
from sweep.model.effects.catalogue import EFFECTS, effect_names_in_flags, pack_effect_flags
from sweep.model.effects.planner_inputs import PlannerInputs
from sweep.model.effects.planning import plan_effects
from sweep.model.evaluation import PARAMETER_DEFAULTS
from sweep.tasks.studies.grid_study import evaluate_points, select_parameters_of_points
from sweep.tasks.studies.parameter_grid import ParameterBlockGrid

TOLERANCES = (1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6)
WINDOWS = ("rectangular", "hann", "hamming", "blackman", "kaiser(8)")
FOOTPRINTS = (("coherent", 1), ("incoherent", 1), ("coherent", 37), ("incoherent", 37))
REFERENCE_TOLERANCE = 1e-9
BINS_FROM_END_MAX, N_DRAWS = 40.0, 4
"""Largest distance of lines from DC or Nyquist [bins], and draws of a jittering beam."""
SAMPLE_RATE, SPEED_OF_LIGHT = 100e6, 299792458.0
SHARE_WITHIN_MIN = 0.999
"""Share of the points that must keep a tolerance."""
ERROR_QUANTITIES = ("pd", "magnitude", "leakage")
COMPARED_OUTPUTS = (
    "pd_up", "pd_doppler", "pd_down", "pd_shot", "snr_up", "snr_doppler", "snr_down",
    "p_leakage_up", "p_leakage_down",
)  # fmt: skip


class ToleranceErrors(NamedTuple):
    """Errors of points at a tolerance, (n,) each, and their bound."""

    pd: np.ndarray
    """Error of pd: the largest of the segments and the shot."""
    magnitude: np.ndarray
    """Error of |X| in the largest bins, relative to |X|, or to sigma if that is larger."""
    leakage: np.ndarray
    """Error of the leakage probability of either chirp; nan if leakage is not requested."""
    error_bound: np.ndarray
    """Bound on the change of results by omitted effects."""


def random_study_mappings(n_points: int, rng: np.random.Generator) -> Iterator[dict[str, Any]]:
    """Yield specs of random points, about `n_points` in all, by window, footprint and request."""
    kinds = [
        (window, *footprint, requested)
        for window in WINDOWS
        for footprint in FOOTPRINTS
        for requested in ("nothing", "leakage", "jitter")
        if requested != "jitter" or footprint[1] == 1
    ]
    sizes = {window: f"2^{rng.integers(10, 15)}" for window in WINDOWS}
    for window, phases, beamlets, requested in kinds:
        fft_size = 2 ** int(sizes[window].removeprefix("2^"))
        points = [
            _random_point(rng, requested, fft_size) for _ in range(-(-n_points // len(kinds)))
        ]
        yield {
            "title": f"{window} {phases} {beamlets} {requested}",
            "instrument": {
                "file": str(TABLE_4_1),
                "processing": {"window": window, "fft_size": sizes[window],
                               "sample_rate": f"{SAMPLE_RATE!r} Hz"},
            },
            "target": {"reflectance": 0.1},
            "footprint": {"phases": phases, "beamlets": beamlets},
            "effects": {"leakage": "on"} if requested == "leakage" else {},
            "axes": {"sample": {"zip": points}},
            **({"draws": {"number": N_DRAWS}, "seed": int(rng.integers(1 << 30))}
               if requested == "jitter" else {}),
        }  # fmt: skip


def _random_point(rng: np.random.Generator, requested: str, fft_size: int) -> dict[str, str]:
    """Return an instrument and a target as values by path, with effects of very different sizes.

    Echoes arrive before the record, within it, or rarely after it.
    """

    def signed_log_uniform(low: float, high: float) -> float:
        """Draw a number between two powers of ten, of either sign, or 0."""
        return float(rng.choice([-1, 0, 1], p=(0.4, 0.2, 0.4)) * 10 ** rng.uniform(low, high))

    duration = 2**14 / SAMPLE_RATE * rng.uniform(1.0, 1.5)
    bandwidth, wavelength = 10 ** rng.uniform(8, 9.3), 1.55e-6
    slope, sign = bandwidth / duration, rng.choice([1, -1])
    velocity = signed_log_uniform(-2, 1.5)
    band_end = SAMPLE_RATE / 2 * rng.integers(0, 2)
    beat_frequency = abs(band_end + rng.uniform(-1, 1) * BINS_FROM_END_MAX * SAMPLE_RATE / 2**13)
    target_range = (
        (beat_frequency + sign * 2 * velocity / wavelength) * SPEED_OF_LIGHT / (2 * slope)
    )
    target_range = max(abs(float(target_range)), 2.0)
    delay, record = 2 * target_range / SPEED_OF_LIGHT, fft_size / SAMPLE_RATE
    record_part_missed = record * rng.choice([0.0, 10 ** rng.uniform(-5, 0), rng.uniform(0, 1)])
    start = float(np.clip(delay - record_part_missed, 0.0, duration - record))
    values = {
        "instrument.processing.acquisition_delay": f"{start!r} s",
        "instrument.chirp.bandwidth": f"{bandwidth!r} Hz",
        "instrument.chirp.duration": f"{duration!r} s",
        "instrument.laser.power": f"{10 ** rng.uniform(-4.5, 0)!r} W",
        "instrument.laser.line_width": f"{abs(signed_log_uniform(0, 4.5))!r} Hz",
        "instrument.chirp.quadratic_error": f"{signed_log_uniform(-6, 1) / delay!r} Hz",
        "instrument.chirp.cubic_error": f"{signed_log_uniform(-6, 1) / delay!r} Hz",
        "instrument.chirp.sinusoidal_error": f"{signed_log_uniform(-6, 0.5) / delay!r} Hz",
        "instrument.chirp.error_periods": f"{10 ** rng.uniform(-0.5, 1)!r}",
        "instrument.processing.tnr": f"{rng.uniform(2, 10)!r}",
        "target.range": f"{target_range!r} m",
        "target.grazing_angle": f"{rng.uniform(30, 90)!r} deg",
        "target.radial_velocity": f"{velocity!r} m/s",
        "target.acceleration": f"{signed_log_uniform(-1, 3)!r} m/s^2",
    }
    if requested == "jitter":
        values["target.pointing_jitter"] = f"{10 ** rng.uniform(-3, 2)!r} urad"
    return values


def errors_at_tolerances(
    mapping: dict[str, Any], tolerances: tuple[float, ...] = TOLERANCES
) -> list[ToleranceErrors]:
    """Compute the errors of a study's points at each tolerance."""
    spec = load_mapping(mapping)
    grid = ParameterBlockGrid(spec)
    parameters = PARAMETER_DEFAULTS | grid.parameters_at(np.arange(grid.n_points))
    points = PlannerInputs(parameters)

    def at_every_point(values: np.ndarray) -> np.ndarray:
        return np.broadcast_to(values, (grid.n_points,))

    def evaluate_with_flags(tolerance: float, flags: np.ndarray) -> dict[str, np.ndarray]:
        parameters_at_tolerance = parameters | {"accuracy.tolerance": tolerance}
        outputs: dict[str, np.ndarray] = {}
        for flag in np.unique(flags):
            index = np.flatnonzero(flags == flag)
            part = evaluate_points(
                spec,
                select_parameters_of_points(parameters_at_tolerance, index),
                index.size,
                effect_names_in_flags(int(flag)),
            )
            for name in set(part) & set(COMPARED_OUTPUTS):
                outputs.setdefault(name, np.empty(grid.n_points))[index] = part[name]
        return outputs

    n_beamlets = int(parameters["footprint.beamlets"])
    usable_effects = np.array([not effect.is_random or spec.draws.has_draws for effect in EFFECTS])
    absent_effects = [
        effect.is_absent(parameters) | np.zeros(grid.n_points, bool) for effect in EFFECTS
    ]
    is_present = ~np.array(absent_effects)
    exact = evaluate_with_flags(
        REFERENCE_TOLERANCE, pack_effect_flags(usable_effects[:, None] & is_present)
    )
    rows = []
    for tolerance in tolerances:
        effects_error_max = effects_tolerance(
            parameters | {"accuracy.tolerance": tolerance}, n_beamlets
        )
        effect_plan = plan_effects(points, at_every_point, spec.effect_modes(), effects_error_max)
        planned_outputs = evaluate_with_flags(
            tolerance, pack_effect_flags(effect_plan.is_kept & is_present)
        )
        error_bound = effect_plan.total_error - effect_plan.residual_error
        rows.append(
            _compare_outputs(planned_outputs, exact, error_bound, "leakage" in mapping["effects"])
        )
    return rows


def _compare_outputs(
    planned_outputs: dict[str, Any],
    exact: dict[str, Any],
    error_bound: np.ndarray,
    has_leakage: bool,
) -> ToleranceErrors:
    pd = [
        abs(planned_outputs[f"pd_{name}"] - exact[f"pd_{name}"])
        for name in ("up", "doppler", "down", "shot")
    ]
    magnitude_errors = []
    for name in ("up", "doppler", "down"):
        # over sigma: snr is |X|^2 over 2 sigma^2
        planned_magnitude, exact_magnitude = (
            np.sqrt(2 * outputs[f"snr_{name}"]) for outputs in (planned_outputs, exact)
        )
        magnitude_errors.append(
            abs(planned_magnitude - exact_magnitude) / np.maximum(exact_magnitude, 1.0)
        )
    leakage_errors = [
        abs(planned_outputs[f"p_leakage_{name}"] - exact[f"p_leakage_{name}"])
        for name in ("up", "down")
    ]
    leakage = np.fmax.reduce(leakage_errors) if has_leakage else np.full(error_bound.shape, np.nan)
    return ToleranceErrors(
        np.fmax.reduce(pd), np.fmax.reduce(magnitude_errors), leakage, error_bound
    )


SECTION_HEAD = """
## Instruments drawn at random

The test draws {number:,} new instruments each time. Their lines lie within {near:g} bins of DC or
Nyquist. Range walk, acceleration, a nonlinear sweep, line width and jitter smear them, each over
many decades. Every point is planned by itself. A cell has the share of the points within the
tolerance, and the worst error. The errors are those of pd, of |X| (and so of the root of `snr_*`)
over itself or sigma, and of leakage if the spec requests it.
"""


def instruments_section(n_points: int, rng: np.random.Generator) -> tuple[list[str], str]:
    """Return lines of text on tolerances that are not kept, and the section of the page."""
    errors_by_study = [
        errors_at_tolerances(mapping) for mapping in random_study_mappings(n_points, rng)
    ]
    missed, rows = [], []
    for k, tolerance in enumerate(TOLERANCES):
        all_errors = ToleranceErrors(
            *map(
                np.concatenate,
                zip(*(study_errors[k] for study_errors in errors_by_study), strict=True),
            )
        )
        cells = []
        for quantity, errors in zip(ERROR_QUANTITIES, all_errors, strict=False):
            known_errors = errors[np.isfinite(errors)]
            share_within = float((known_errors <= tolerance).mean())
            cells.append(f"{100 * share_within:.2f} %, {known_errors.max():.1e}")
            if share_within < SHARE_WITHIN_MIN:
                missed.append(
                    f"- random instruments at {tolerance:g}: {quantity} of {1 - share_within:.2%}"
                )
        rows.append([f"{tolerance:g}", f"{all_errors.pd.size:,}", *cells])
    head = SECTION_HEAD.strip().format(number=n_points, near=BINS_FROM_END_MAX)
    return missed, head + "\n\n" + markdown_table(["tolerance", "points", *ERROR_QUANTITIES], rows)
