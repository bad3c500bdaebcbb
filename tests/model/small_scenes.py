"""Level plates, straight flights and the instrument of Table 4.1, for tests of scenes."""

import numpy as np

from sweep.model.geometry.body_motion import ConstantAcceleration, FixedAttitude, MovingBody
from sweep.model.geometry.ray_casting import RayCaster
from sweep.model.geometry.scanner import fixed_beams
from sweep.model.pointcloud.eyepoints import compute_eyepoints
from sweep.scenes.meshes import clean_mesh

LEVEL_ATTITUDE = 1.0, 0.0, 0.0, 0.0
DOWNWARD_BEAM = np.array([[0.0, 0.0, -1.0]])


def level_plate(x=(-1e5, 1e5), y=(-1e5, 1e5), height=0.0, surface=0):
    """Level rectangle as two triangles."""
    corner = [
        (x[0], y[0], height),
        (x[1], y[0], height),
        (x[1], y[1], height),
        (x[0], y[1], height),
    ]
    return clean_mesh(np.array(corner), np.array([[0, 1, 2], [0, 2, 3]]), surface)[0]


def straight_flight(
    position=(0.0, 0.0, 1000.0), velocity=(0.0, 0.0, 0.0), attitude=None, **keywords
):
    """A straight flight of 10 s at constant velocity unless said otherwise."""
    acceleration = keywords.pop("acceleration", (0.0, 0.0, 0.0))
    path = ConstantAcceleration(position, velocity, acceleration, keywords.pop("duration", 10.0))
    return MovingBody(path, attitude or FixedAttitude(LEVEL_ATTITUDE), **keywords)


def observe_shots(
    flight, *, bodies=None, beams=DOWNWARD_BEAM, scanner=None, index=(0,), **keywords
):
    """Eyepoints of shots over plates, 19 beamlets of 50 urad unless said otherwise."""
    meshes = [level_plate()] if bodies is None else bodies
    body_motion = keywords.pop("body_motion", None)
    return compute_eyepoints(
        np.asarray(index),
        flight=flight,
        scanner=scanner or fixed_beams(beams, rate=1.0),
        caster=RayCaster(meshes),
        beam_divergence=keywords.pop("beam_divergence", 50e-6),
        n_beamlets=keywords.pop("number", 19),
        body_motions=body_motion,
        **keywords,
    )


def scene_parameters(table_4_1, **changes):
    """Parameters of a scene study: Table 4.1 without its target."""
    changes = {"phases": "incoherent", "beamlets": 19} | changes
    parameters = table_4_1(**changes)
    solar_irradiance = parameters["target.solar_irradiance"]
    return {p: v for p, v in parameters.items() if not p.startswith("target.")} | {
        "target.solar_irradiance": solar_irradiance
    }
