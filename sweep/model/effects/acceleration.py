"""Radial acceleration: the Doppler frequency itself drifts, in every segment.

With tau(t) = tau_0 - beta t - alpha t^2, alpha = a / c, the beat's phase (PHYSICS section 2) has
exactly these terms besides those without acceleration:

    psi(t) = f_seg alpha t^2 + s S [ -tau_0 alpha t^2 + alpha (1 + beta) t^3 + alpha^2 t^4 / 2 ]

in cycles. The first is the drift of 2 a / lambda per second; the others, by S t / f_seg smaller,
are kept. Acceleration is positive when it makes the radial velocity grow (PHYSICS section 1).
"""

from dataclasses import replace

import numpy as np

from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.effects.effect import Effect, Parameter, Scene, Size
from sweep.model.effects.phase_sizes import over_record, phase_size
from sweep.model.effects.points import Points, Smear
from sweep.model.effects.range_walk import record_times
from sweep.model.preparation import PhaseError, Shots

NAME = "acceleration"


def phase(
    x: np.ndarray,
    *,
    sign: int,
    carrier: np.ndarray,
    chirp_rate: np.ndarray,
    range: np.ndarray,
    radial_velocity: np.ndarray,
    acceleration: np.ndarray,
    start: np.ndarray,
    duration: np.ndarray,
) -> np.ndarray:
    """Phase [cycles] that acceleration adds to the beat, (n, m).

    Parameters
    ----------
    x : (m,) ndarray
        Places in the record, -1 at its first sample, 1 one sample past its last.
    sign : int
        Sign of the chirp: +1 up, 0 Doppler, -1 down.
    carrier, chirp_rate : (n,) ndarray
        Frequency f_seg at the segment's start [Hz]; chirp rate B/T [Hz/s].
    range, radial_velocity, acceleration : (n,) ndarray
        Of the target at the segment's start [m, m/s, m/s^2], positive closing.
    start, duration : (n,) ndarray
        Acquisition delay t_0 and length L/fs of the record [s].
    """
    alpha, beta, delay, slope, frequency = (
        np.atleast_1d(np.asarray(v, float))[:, None]
        for v in (
            np.asarray(acceleration) / SPEED_OF_LIGHT,
            2 * np.asarray(radial_velocity) / SPEED_OF_LIGHT,
            2 * np.asarray(range) / SPEED_OF_LIGHT,
            sign * np.asarray(chirp_rate),
            carrier,
        )
    )
    t = record_times(x, start=start, duration=duration)
    chirped = -delay + (1 + beta) * t + alpha * t**2 / 2
    return np.asarray(alpha * t**2 * (frequency + slope * chirped))


def smear(points: Points) -> Smear | None:
    """The phase that acceleration adds."""
    if not points.has("target.acceleration"):
        return None
    alpha = points["target.acceleration"] / SPEED_OF_LIGHT
    slope = points.signs * points.chirp_rate
    terms = {
        2: alpha * (points.carriers - slope * points.delay),
        3: alpha * slope * (1 + points.beta),
        4: alpha**2 * slope * 0.5,
    }
    return over_record(points, terms)


def size(points: Points) -> Size | None:
    """What leaving acceleration out changes of the detecting bins."""
    return phase_size(points, NAME)


def act(shots: Shots, scene: Scene) -> Shots:
    """The drift of the Doppler frequency, in the record of every segment."""
    values = {
        "carrier": shots.carriers,
        "chirp_rate": shots.chirp_rate,
        "range": shots.range,
        "radial_velocity": shots.radial_velocity,
        "acceleration": scene.parameters["target.acceleration"],
        "start": shots.acquisition_delay,
        "duration": shots.record_duration,
    }
    return replace(shots, phase_errors=(*shots.phase_errors, PhaseError(phase, values)))


EFFECT = Effect(
    name=NAME,
    about="drift of the Doppler frequency",
    stage="record",
    size=size,
    smear=smear,
    act=act,
    parameters=(
        Parameter(
            path="target.acceleration",
            about="Rate at which the radial velocity grows",
            si_unit="m/s^2",
            default=0.0,
            example="10 m/s^2",
            at_least="-1e6 m/s^2",
            at_most="1e6 m/s^2",
        ),
    ),
)
