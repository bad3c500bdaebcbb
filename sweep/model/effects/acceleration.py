"""Radial acceleration: the Doppler frequency itself drifts, in every segment.

With tau(t) = tau_0 - beta t - alpha t^2, alpha = a / c, the beat's phase (PHYSICS section 2) has
exactly these terms besides those without acceleration:

    psi(t) = f_seg alpha t^2 + s S [ -tau_0 alpha t^2 + alpha (1 + beta) t^3 + alpha^2 t^4 / 2 ]

in cycles. The first is the drift of 2 a / lambda per second; the others, by S t / f_seg smaller,
are kept. Acceleration is positive when it makes the radial velocity grow (PHYSICS section 1).
"""

import numpy as np

from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.effects.change import Change
from sweep.model.effects.phase_bounds import phase_change
from sweep.model.effects.range_walk import record_times
from sweep.model.window import Window


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


def drift_bins(
    *, carrier: np.ndarray, acceleration: np.ndarray, duration: np.ndarray
) -> np.ndarray:
    """Bins of fs/L over which the beat drifts within the record, 2 f_seg (a / c) T_w^2, (n,)."""
    return 2 * np.asarray(carrier) * acceleration / SPEED_OF_LIGHT * np.asarray(duration) ** 2


def bound(
    *,
    sign: int,
    carrier: np.ndarray,
    chirp_rate: np.ndarray,
    range: np.ndarray,
    radial_velocity: np.ndarray,
    acceleration: np.ndarray,
    start: np.ndarray,
    duration: np.ndarray,
    window: Window,
    concentration: np.ndarray | None = None,
) -> Change:
    """What leaving acceleration out can change of a segment's detecting bin.

    Parameters as of :func:`phase` and :func:`sweep.model.effects.phase_bounds.phase_change`.
    """
    return phase_change(
        lambda x: phase(
            x,
            sign=sign,
            carrier=carrier,
            chirp_rate=chirp_rate,
            range=range,
            radial_velocity=radial_velocity,
            acceleration=acceleration,
            start=start,
            duration=duration,
        ),
        window=window,
        concentration=concentration,
    )
