"""Level plates, straight flights and the instrument of Table 4.1, for tests of scenes."""

import numpy as np

from sweep.model.eyepoints import observe
from sweep.model.geometry.platform import ConstantAcceleration, Fixed, Flight
from sweep.model.geometry.rays import Caster
from sweep.model.geometry.scanner import fixed
from sweep.scenes.meshes import clean

LEVEL = 1.0, 0.0, 0.0, 0.0
DOWN = np.array([[0.0, 0.0, -1.0]])


def plate(x=(-1e5, 1e5), y=(-1e5, 1e5), height=0.0, surface=0):
    """Level rectangle as two triangles."""
    corner = [
        (x[0], y[0], height),
        (x[1], y[0], height),
        (x[1], y[1], height),
        (x[0], y[1], height),
    ]
    return clean(np.array(corner), np.array([[0, 1, 2], [0, 2, 3]]), surface)[0]


def flight(position=(0.0, 0.0, 1000.0), velocity=(0.0, 0.0, 0.0), attitude=None, **keywords):
    """A straight flight of 10 s at constant velocity unless said otherwise."""
    acceleration = keywords.pop("acceleration", (0.0, 0.0, 0.0))
    path = ConstantAcceleration(position, velocity, acceleration, keywords.pop("duration", 10.0))
    return Flight(path, attitude or Fixed(LEVEL), **keywords)


def observed(path, *, bodies=None, beams=DOWN, scanner=None, index=(0,), **keywords):
    """Eyepoints of shots over plates, 19 beamlets of 50 urad unless said otherwise."""
    meshes = [plate()] if bodies is None else bodies
    motion = keywords.pop("motion", None)
    return observe(
        np.asarray(index),
        flight=path,
        scanner=scanner or fixed(beams, rate=1.0),
        caster=Caster(meshes),
        beam_divergence=keywords.pop("beam_divergence", 50e-6),
        number=keywords.pop("number", 19),
        bodies=motion,
        **keywords,
    )


def instrument(table_4_1, **changes):
    """Parameters of a scene study: Table 4.1 without its target."""
    changes = {"phases": "incoherent", "beamlets": 19} | changes
    given = table_4_1(**changes)
    sun = given["target.solar_irradiance"]
    return {p: v for p, v in given.items() if not p.startswith("target.")} | {
        "target.solar_irradiance": sun
    }
