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

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.effects.effect import Effect, Parameter, Scene, Size, Sized
from sweep.model.effects.phase_sizes import phase_size
from sweep.model.effects.points import Points, Smear
from sweep.model.effects.range_walk import record_times
from sweep.model.preparation import PhaseError, Shots

NAME = "chirp_nonlinearity"

_SHAPES = ("quadratic", "cubic", "sinusoidal")
_PEAKS = tuple(f"instrument.chirp.{shape}_error" for shape in _SHAPES)


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
        Peaks [Hz], either sign, of a frequency error quadratic (2 u^2 - 1) + cubic (4 u^3 - 3 u)
        + sinusoidal sin(pi periods u) at place u along the sweep, -1..1 from lowest to highest
        frequency; periods of the last over the sweep, > 0.
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


def smear(points: Points) -> Smear | None:
    """The phase that the sweep's error adds.

    That of square and cube is a polynomial in the place in the record; the sine's is taken at its
    largest.
    """
    if not points.has(*_PEAKS):
        return None
    quadratic, cubic, sinusoidal = (points[path] for path in _PEAKS)
    half, signs = 0.5 * points.record_duration, points.signs
    middle, per_length = points.start + half, 2 / points["instrument.chirp.duration"]
    delay = [points.delay - points.beta * middle, -points.beta * half]
    step = [-signs * per_length * part for part in delay]
    place = [
        signs * (per_length * middle - 1) + 0.5 * step[0],
        signs * per_length * half + 0.5 * step[1],
    ]
    square, small = _product(place, place), _product(step, step)
    mean = [quadratic * (2 * a + b / 6) for a, b in zip(square, small, strict=True)]
    mean[0] = mean[0] - quadratic
    factor = [4 * a + b for a, b in zip(square, small, strict=True)]
    factor[0] = factor[0] - 3
    cube = [cubic * part for part in _product(place, factor)]
    mean = [a + b for a, b in zip([*mean, np.zeros(())], cube, strict=True)]
    chirped = np.abs(signs)
    constant, *powers = (chirped * np.abs(part) for part in _product(delay, mean))
    rest = chirped * (np.abs(delay[0]) + np.abs(delay[1])) * np.abs(sinusoidal)
    turns = 2 * np.pi * points["instrument.chirp.error_periods"] * per_length * half
    return Smear(tuple(powers), rest, constant, rest * turns)


def _product(one: Sequence[Sized], other: Sequence[Sized]) -> list[Sized]:
    """Coefficients of a product of polynomials, lowest power first."""
    product: list[Sized] = [0.0] * (len(one) + len(other) - 1)
    for i, a in enumerate(one):
        for j, b in enumerate(other):
            product[i + j] = product[i + j] + a * b
    return product


def size(points: Points) -> Size | None:
    """What leaving the sweep's error out changes of the detecting bins."""
    return phase_size(points, NAME)


def act(shots: Shots, scene: Scene) -> Shots:
    """The sweep's error in the record of the two chirps."""
    p = scene.parameters
    values = {
        "chirp_duration": shots.duration,
        "range": shots.range,
        "radial_velocity": shots.radial_velocity,
        **{shape: p[path] for shape, path in zip(_SHAPES, _PEAKS, strict=True)},
        "periods": p["instrument.chirp.error_periods"],
        "start": shots.acquisition_delay,
        "duration": shots.record_duration,
    }
    return replace(shots, phase_errors=(*shots.phase_errors, PhaseError(phase, values)))


def _error(shape: str, about: str) -> Parameter:
    return Parameter(
        path=f"instrument.chirp.{shape}_error",
        about=about,
        si_unit="Hz",
        default=0.0,
        example="100 kHz",
        at_least="-1e15 Hz",
        at_most="1e15 Hz",
    )


EFFECT = Effect(
    name=NAME,
    about="departure of the sweep from a straight line",
    stage="record",
    size=size,
    smear=smear,
    act=act,
    parameters=(
        _error("quadratic", "Peak of the sweep's frequency error that goes as a square"),
        _error("cubic", "Peak of the sweep's frequency error that goes as a cube"),
        _error("sinusoidal", "Peak of the sweep's frequency error that goes as a sine"),
        Parameter(
            path="instrument.chirp.error_periods",
            about="Periods of the sinusoidal error over the sweep",
            default=1.0,
            example="5",
            at_least="1e-6",
            at_most="1000",
        ),
    ),
)
