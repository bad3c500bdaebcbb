"""Chirp nonlinearity: the sweep's residual frequency error, seen through its delayed self.

The error e(x) [Hz] is what the sweep's optical frequency departs from a straight line, as a
property of the laser's tuning: a function of the place u along the sweep, -1 at the lowest and 1
at the highest frequency, so that the down-chirp runs through it backwards:

    e = q T_2(u) + k T_3(u) + p sin(pi m u),    u = s (2 t / T - 1)

T_2 = 2 u^2 - 1 and T_3 = 4 u^3 - 3 u are what is left of a square and a cube beside the best
straight line, with peak 1; m is the number of periods over the sweep. With E the integral of e
over time, the beat (delayed wave less local oscillator, PHYSICS section 2) gains exactly

    psi(t) = E(t - tau(t)) - E(t)    [cycles],    tau(t) = tau_0 - beta t

about -tau e(t): nothing at no range, and the more the farther. The Doppler segment has no sweep.
"""

import numpy as np

from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.effects.change import Change
from sweep.model.effects.phase_bounds import phase_change
from sweep.model.effects.range_walk import record_times
from sweep.model.window import Window


def frequency_error(
    u: np.ndarray,
    *,
    quadratic: np.ndarray,
    cubic: np.ndarray,
    sinusoidal: np.ndarray,
    periods: np.ndarray,
) -> np.ndarray:
    """Frequency error e [Hz] at place u along the sweep, -1..1 from lowest to highest frequency.

    Parameters
    ----------
    u : ndarray
        Place along the sweep; arrays broadcast.
    quadratic, cubic, sinusoidal : ndarray
        Peaks [Hz] of the errors, either sign.
    periods : ndarray
        Periods of the sinusoidal error over the sweep, > 0.
    """
    return (
        quadratic * (2 * u**2 - 1)
        + cubic * (4 * u**3 - 3 * u)
        + sinusoidal * np.sin(np.pi * periods * u)
    )


def phase(
    x: np.ndarray,
    *,
    sign: int,
    chirp_duration: np.ndarray,
    range: np.ndarray,
    radial_velocity: np.ndarray,
    quadratic: np.ndarray,
    cubic: np.ndarray,
    sinusoidal: np.ndarray,
    periods: np.ndarray,
    start: np.ndarray,
    duration: np.ndarray,
) -> np.ndarray:
    """Phase [cycles] that the sweep's error adds to the beat, (n, m).

    Parameters
    ----------
    x : (m,) ndarray
        Places in the record, -1 at its first sample, 1 one sample past its last.
    sign : int
        Sign of the chirp: +1 up, 0 Doppler, -1 down.
    chirp_duration : (n,) ndarray
        Length T of the chirp [s].
    range, radial_velocity : (n,) ndarray
        Of the target at the segment's start [m, m/s], positive closing.
    quadratic, cubic, sinusoidal, periods : (n,) ndarray
        As of :func:`frequency_error`.
    start, duration : (n,) ndarray
        Acquisition delay t_0 and length L/fs of the record [s].
    """
    t = record_times(x, start=start, duration=duration)
    if sign == 0:
        return np.zeros((np.size(range), np.size(x)))
    beta, delay, length = (
        np.atleast_1d(np.asarray(v, float))[:, None]
        for v in (
            2 * np.asarray(radial_velocity) / SPEED_OF_LIGHT,
            2 * np.asarray(range) / SPEED_OF_LIGHT,
            chirp_duration,
        )
    )
    peaks = [
        np.atleast_1d(np.asarray(v, float))[:, None]
        for v in (quadratic, cubic, sinusoidal, periods)
    ]
    u = sign * (2 * t / length - 1)
    step = -sign * 2 * (delay - beta * t) / length
    return np.asarray(sign * length / 2 * _integral_over_step(u, step, *peaks))


def _integral_over_step(
    u: np.ndarray,
    h: np.ndarray,
    quadratic: np.ndarray,
    cubic: np.ndarray,
    sinusoidal: np.ndarray,
    periods: np.ndarray,
) -> np.ndarray:
    """Integral of e over u from u to u + h, in forms whose terms do not cancel for small h."""
    middle, square = u + h / 2, h * h
    # The mean of T_2 and T_3 over a step about its middle; that of a sine is sinc times it.
    mean = quadratic * (2 * middle**2 - 1 + square / 6)
    mean = mean + cubic * middle * (4 * middle**2 - 3 + square)
    mean = mean + sinusoidal * np.sinc(periods * h / 2) * np.sin(np.pi * periods * middle)
    return np.asarray(h * mean)


def bound(
    *,
    sign: int,
    chirp_duration: np.ndarray,
    range: np.ndarray,
    radial_velocity: np.ndarray,
    quadratic: np.ndarray,
    cubic: np.ndarray,
    sinusoidal: np.ndarray,
    periods: np.ndarray,
    start: np.ndarray,
    duration: np.ndarray,
    window: Window,
    concentration: np.ndarray | None = None,
) -> Change:
    """What leaving the sweep's error out can change of a segment's detecting bin.

    Parameters as of :func:`phase` and :func:`sweep.model.effects.phase_bounds.phase_change`.
    """
    return phase_change(
        lambda x: phase(
            x,
            sign=sign,
            chirp_duration=chirp_duration,
            range=range,
            radial_velocity=radial_velocity,
            quadratic=quadratic,
            cubic=cubic,
            sinusoidal=sinusoidal,
            periods=periods,
            start=start,
            duration=duration,
        ),
        window=window,
        concentration=concentration,
        periods=float(np.max(periods)) if np.any(sinusoidal) else 0.0,
    )
