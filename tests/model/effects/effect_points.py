"""Scenes over the whole reachable range, as points, and their plans."""

import numpy as np

from sweep.model.effects.catalogue import DEFAULTS, EFFECTS
from sweep.model.effects.planning import plan
from sweep.model.effects.points import Points
from sweep.model.shot import find, prepare

SIZES = (2**12, 2**13, 2**14, 2**15, 2**16, 2**17, 2**18)
CLOSED = ("hamming", "hann", "rectangular", "flattop")
WINDOWS = (*CLOSED, "kaiser(8.6)")

ACROSS = "target.transverse_velocity"


def scene(table, number, seed, **fixed):
    """Random points of one category: parameters by path."""
    rng = np.random.default_rng((71, seed))
    values = {
        "range": 10 ** rng.uniform(0, 4, number),
        "grazing_angle": np.radians(rng.choice([1, 90], number) * 1.0),
        "beam_divergence": 10 ** rng.uniform(-5, np.log10(2e-3), number),
        "radial_velocity": rng.choice([-1, 1], number) * 10 ** rng.uniform(-3, 3, number),
        "power": 10 ** rng.uniform(-4, 1, number),
        "tnr": rng.uniform(2, 12, number),
        "fft_size": int(rng.choice(SIZES)),
        "window": str(rng.choice(WINDOWS)),
        "reflectance_law": str(rng.choice(["thesis", "lambert", "lommel_seeliger"])),
        "phases": "incoherent",
        "beamlets": int(rng.choice([3, 7, 19, 61, 109])),
        "duration": float(rng.choice([500e-6, 200e-6])),
    }
    across = 10 ** rng.uniform(-1, 3, number)
    slanted = rng.random(number) < 0.8
    values["grazing_angle"] = np.where(
        slanted, np.radians(rng.uniform(1, 90, number)), values["grazing_angle"]
    )
    across = fixed.pop("across", across)
    return DEFAULTS | table(**values | fixed) | {ACROSS: across}


def points_of(parameters, footprint=None, **further):
    """Points as the planner looks at them."""
    words = {path: str(v) for path, v in parameters.items() if np.asarray(v).dtype.kind in "UO"}
    return Points(DEFAULTS | dict(parameters) | words, footprint, **further)


def planned(points, modes, tolerance, effects=EFFECTS, edges=None):
    """The plan of points, each by itself or in stretches between edges."""
    number = max(np.size(value) for value in points.parameters.values())

    def tiles(values):
        each = np.broadcast_to(values, (number,))
        return each if edges is None else np.maximum.reduceat(each, edges[:-1])

    return plan(points, tiles, modes, tolerance, effects)


def kept_in(made, tile):
    """Effects that are simulated in a tile."""
    return tuple(n for n, each in zip(made.names, made.kept[:, tile], strict=True) if each)


def shots_of(parameters, effects):
    """Shots of points of one category."""
    ((_, shots),) = prepare(parameters, effects)
    return shots


def found(parameters, effects):
    """What the spectra of the points hold, :func:`sweep.model.shot.find`."""
    return find(shots_of(parameters, effects))
