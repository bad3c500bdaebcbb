"""Range walk: the target moves while the chirp runs, and the beat drifts.

With tau(t) = tau_0 - beta t, beta = 2 v_r / c, the beat's phase (PHYSICS section 2) has, besides
the terms up to t that make the line, exactly

    psi(t) = s S beta (1 + beta / 2) t^2    [cycles]

a frequency drift of 2 s S (2 v_r / c) over time, of opposite sign in up and down chirp, none in
the Doppler segment. Time runs from the segment's start: the line moves by the drift up to the
middle of the record and spreads over what drifts within it.
"""

from dataclasses import replace

import numpy as np

from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.effects.effect import Effect, Scene, Size
from sweep.model.effects.phase_sizes import over_record, phase_size
from sweep.model.effects.points import Points, Smear
from sweep.model.preparation import PhaseError, Shots

NAME = "range_walk"


def phase(
    x: np.ndarray,
    *,
    sign: int,
    chirp_rate: np.ndarray,
    radial_velocity: np.ndarray,
    start: np.ndarray,
    duration: np.ndarray,
) -> np.ndarray:
    """Phase [cycles] that the terms in t^2 add to the line's, (n, m).

    Parameters
    ----------
    x : (m,) ndarray
        Places in the record, -1 at its first sample, 1 one sample past its last.
    sign : int
        Sign of the chirp: +1 up, 0 Doppler, -1 down.
    chirp_rate, radial_velocity : (n,) ndarray
        Chirp rate B/T [Hz/s]; radial velocity at the segment's start [m/s], positive closing.
    start, duration : (n,) ndarray
        Acquisition delay t_0 and length L/fs of the record [s].
    """
    beta = 2 * np.asarray(radial_velocity, float) / SPEED_OF_LIGHT
    drift = sign * chirp_rate * beta * (1 + beta / 2)
    return np.atleast_1d(drift)[:, None] * record_times(x, start=start, duration=duration) ** 2


def record_times(x: np.ndarray, *, start: np.ndarray, duration: np.ndarray) -> np.ndarray:
    """Time since the segment's start [s] at places x of the record, (n, m)."""
    start, duration = np.atleast_1d(start), np.atleast_1d(duration)
    return start[:, None] + duration[:, None] * (np.asarray(x) + 1) / 2


def smear(points: Points) -> Smear | None:
    """The phase that range walk adds."""
    if not points.has("target.radial_velocity"):
        return None
    drift = points.signs * points.chirp_rate * points.beta * (1 + points.beta / 2)
    return over_record(points, {2: drift})


def size(points: Points) -> Size | None:
    """What leaving range walk out changes of the detecting bins."""
    return phase_size(points, NAME)


def act(shots: Shots, scene: Scene) -> Shots:
    """The drift of the beat, in the record of the two chirps: at t that of R - 2 v_r t."""
    values = {
        "chirp_rate": shots.chirp_rate,
        "radial_velocity": shots.radial_velocity,
        "start": shots.acquisition_delay,
        "duration": shots.record_duration,
    }
    return replace(
        shots,
        phase_errors=(*shots.phase_errors, PhaseError(phase, values)),
        walk=2 * shots.acquisition_delay + shots.record_duration,
    )


EFFECT = Effect(
    name=NAME,
    about="drift of the beat as the target moves",
    stage="record",
    size=size,
    smear=smear,
    act=act,
)
