"""Range walk: the target moves while the chirp runs, and the beat drifts.

With tau(t) = tau_0 - beta t, beta = 2 v_r / c, the beat's phase (PHYSICS section 2) has, besides
the terms up to t that make the line, exactly

    psi(t) = s S beta (1 + beta / 2) t^2    [cycles]

a frequency drift of 2 s S (2 v_r / c) over time, of opposite sign in up and down chirp, none in
the Doppler segment. Time runs from the segment's start: the line moves by the drift up to the
middle of the record and spreads over what drifts within it.
"""

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numba import njit

from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.effects.change import Change
from sweep.model.effects.columns import columns, product_of
from sweep.model.effects.effect import Effect, Scene
from sweep.model.effects.phase_bounds import (
    Error,
    by_segment,
    counted,
    error_change,
    over_record,
)
from sweep.model.effects.span import Span
from sweep.model.preparation import PhaseError, Shots

if TYPE_CHECKING:
    from sweep.model.effects.block import Block


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


@counted
def error(block: "Block") -> Error | None:
    """The phase that range walk adds over a block's tiles."""
    if not block.has("target.radial_velocity"):
        return None
    rate, beta = block.chirp_rate, block.beta
    table, shape = columns(rate.low, rate.high, beta.low, beta.high)
    drift = np.empty((2, *shape))
    put_drifts(table, drift.reshape(2, -1))
    terms = {2: Span(drift[0], drift[1])}
    walk = over_record(terms, start=block.start, duration=block.record_duration)
    return by_segment(block, walk, None, walk)


@njit(cache=True, error_model="numpy")
def put_drifts(table, out):
    """Ends of S beta (1 + beta / 2), (2, n), from those of S and beta."""
    for i in range(out.shape[1]):
        beta = table[2, i], table[3, i]
        moved = product_of((table[0, i], table[1, i]), beta)
        out[0, i], out[1, i] = product_of(moved, (1.0 + 0.5 * beta[0], 1.0 + 0.5 * beta[1]))


def bound(block: "Block") -> Change | None:
    """What leaving range walk out can change of the detecting bins, (3, tiles)."""
    return error_change(block, error)


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
    name="range_walk",
    about="drift of the beat as the target moves",
    stage="record",
    bound=bound,
    act=act,
)
