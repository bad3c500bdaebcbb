"""Scenes over the whole reachable range, as points, and their plans."""

import numpy as np

from sweep.model.effects.catalogue import EFFECTS, PARAMETER_DEFAULTS
from sweep.model.effects.planner_inputs import PlannerInputs
from sweep.model.effects.planning import plan_effects
from sweep.model.evaluation import evaluate_segments, prepare_shots

FFT_SIZES = (2**12, 2**13, 2**14, 2**15, 2**16, 2**17, 2**18)
CLOSED_FORM_WINDOWS = ("hamming", "hann", "rectangular", "flattop")
WINDOWS = (*CLOSED_FORM_WINDOWS, "kaiser(8.6)")

TRANSVERSE_VELOCITY = "target.transverse_velocity"


def random_parameters(table_4_1, n_points, seed, **fixed):
    """Random points of one category: parameters by path."""
    rng = np.random.default_rng((71, seed))
    values = {
        "range": 10 ** rng.uniform(0, 4, n_points),
        "grazing_angle": np.radians(rng.choice([1, 90], n_points) * 1.0),
        "beam_divergence": 10 ** rng.uniform(-5, np.log10(2e-3), n_points),
        "radial_velocity": rng.choice([-1, 1], n_points) * 10 ** rng.uniform(-3, 3, n_points),
        "power": 10 ** rng.uniform(-4, 1, n_points),
        "tnr": rng.uniform(2, 12, n_points),
        "fft_size": int(rng.choice(FFT_SIZES)),
        "window": str(rng.choice(WINDOWS)),
        "reflectance_law": str(rng.choice(["thesis", "lambert", "lommel_seeliger"])),
        "phases": "incoherent",
        "beamlets": int(rng.choice([3, 7, 19, 61, 109])),
        "duration": float(rng.choice([500e-6, 200e-6])),
    }
    transverse_velocity = 10 ** rng.uniform(-1, 3, n_points)
    is_slanted = rng.random(n_points) < 0.8
    values["grazing_angle"] = np.where(
        is_slanted, np.radians(rng.uniform(1, 90, n_points)), values["grazing_angle"]
    )
    transverse_velocity = fixed.pop("across", transverse_velocity)
    return (
        PARAMETER_DEFAULTS
        | table_4_1(**values | fixed)
        | {TRANSVERSE_VELOCITY: transverse_velocity}
    )


def planner_inputs(parameters, footprint=None, **options):
    """Points as the planner looks at them."""
    texts = {path: str(v) for path, v in parameters.items() if np.asarray(v).dtype.kind in "UO"}
    return PlannerInputs(PARAMETER_DEFAULTS | dict(parameters) | texts, footprint, **options)


def plan_points(points, modes, tolerance, effects=EFFECTS, tile_edges=None):
    """The plan of points, each by itself or in stretches between edges."""
    n_points = max(np.size(value) for value in points.parameters.values())

    def maximum_by_tile(values):
        value_by_point = np.broadcast_to(values, (n_points,))
        return (
            value_by_point
            if tile_edges is None
            else np.maximum.reduceat(value_by_point, tile_edges[:-1])
        )

    return plan_effects(points, maximum_by_tile, modes, tolerance, effects)


def effects_kept_in_tile(effect_plan, tile):
    """Effects that are simulated in a tile."""
    return tuple(
        n
        for n, is_kept in zip(effect_plan.effect_names, effect_plan.is_kept[:, tile], strict=True)
        if is_kept
    )


def prepare_single_category(parameters, effects):
    """Shots of points of one category."""
    ((_, shots),) = prepare_shots(parameters, effects)
    return shots


def find_spectra(parameters, effects):
    """Detection and false alarms in the spectra of the points, as SegmentResults."""
    return evaluate_segments(prepare_single_category(parameters, effects))
