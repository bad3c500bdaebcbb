"""Phase errors over the record: the target moves, its velocity drifts, the sweep is not straight.

Each has a phase psi(t) [cycles], added to the beat of every line (PHYSICS section 2), and a smear,
its polynomial in the place x in the record, from which its size follows.

Range walk and acceleration are all terms in t^2 and beyond of a target whose delay is
tau(t) = tau_0 - beta t - alpha t^2, beta = 2 v_r / c, alpha = a / c:

    psi(t) = s S beta (1 + beta / 2) t^2                                                range walk
    psi(t) = f_seg alpha t^2 + s S [ -tau_0 alpha t^2 + alpha (1 + beta) t^3 + alpha^2 t^4 / 2 ]

the first a frequency drift of 2 s S (2 v_r / c), of opposite sign in up and down chirp, none in the
Doppler segment. The second is mostly one of 2 a / lambda, positive when the radial velocity grows.
Half of the first comes from the range, half from the chirp's rising Doppler shift. If the range
along the beam falls at another speed u than v_r, as the beam slides over slanting ground, its own
half follows u: s S (u - v_r) / c t^2 more. Time runs from the segment's start: the line moves by
the drift up to the middle of the record and spreads over what drifts within it.

A sweep departs from a straight line by e(x) [Hz], a property of the laser's tuning. It is a
function of the place u along the sweep, -1 at the lowest and 1 at the highest frequency, so that
the down-chirp runs through it backwards:

    e = q T_2(u) + k T_3(u) + p sin(pi m u),    u = s (2 t / T - 1)

T_2 = 2 u^2 - 1 and T_3 = 4 u^3 - 3 u are a square and a cube less the best straight line, with peak
1. The number m is the number of periods over the sweep. With E the integral of e over time, the
beat (delayed wave less local oscillator) gains exactly

    psi(t) = E(t - tau(t)) - E(t),    tau(t) = tau_0 - beta t

about -tau e(t): nothing at no range, and the more the farther. The Doppler segment has no sweep.
An error that was measured comes as a table, of frequency errors by the time in the up-chirp. It is
fitted once by a Chebyshev series (:mod:`sweep.model.effects.sweep_table`), whose integral over the
delay is exact.

Sizes: w is real and even about the record's middle. A phase error has an odd and an even part, phi
= o(x) + e(x); a constant does not matter. It changes a line's spectrum W(y), real but for the
factor exp(-i pi y) and the unpaired first sample w_0, by A + i B, all relative to sum w:

    |A| <= a = <|o| + e^2 / 2>      |B| <= b = <|e|>      < > the mean weighted with |w| / sum w

The largest bin has M >= c: the scalloping loss for one line; for several that add as powers the
root of the largest bin's share of all power, by the triangle inequality of their bins. So

    1 - (a + b |w_0| / c) / c  <=  M' / M  <=  sqrt((1 + a/c)^2 + (2 b |w_0| + b^2) / c^2)

An even error, as a drift has within the record, thus counts in the second order. Lines that add as
amplitudes, or with their own images, change by <|phi|> of the sum of their amplitudes, whatever
they make together.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from typing import Any, NamedTuple

import numpy as np

from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.effects.effect import Effect, Parameter, Scene, Size, Sized
from sweep.model.effects.points import NO_SMEAR, Points, Smear
from sweep.model.effects.sweep_table import SweepTable, sweep_table
from sweep.model.looks import coherent_gain
from sweep.model.preparation import CHIRP, PhaseError, Shots
from sweep.model.window import Window, samples

_NODES = 256
_TURN = 2 * math.pi
_IMAGE = 0.9
"""Least that an image far away leaves of a line whose amplitude it adds to."""


class Means(NamedTuple):
    """Means of powers of x over a window's |w| / sum w, by power 1..4, and what else is needed."""

    absolute: tuple[float, ...]
    """<|x^k|> of odd powers, <|x^k - <x^k>|> of even ones."""
    square: tuple[float, ...]
    """Root of <(x^k - <x^k>)^2> of even powers, 0 of odd ones."""
    steady: tuple[float, ...]
    """Slope of the best straight line of odd powers, 0 of even ones; last, of what is within 1."""
    most: float
    """Sum |w| over sum w, >= 1."""
    edge: float
    """|w_0| over sum w."""
    variance: float
    """Of the place in the record, in records, under |w|."""


@lru_cache(maxsize=16)
def means(window: Window) -> Means:
    """Means that sizes of phase errors need of a window."""
    x = (2 * np.arange(_NODES) + 1) / _NODES - 1
    w = samples(window.name, window.length)
    place = 2 * np.arange(window.length + 1) / window.length - 1
    at_nodes = np.interp(x, place, np.append(w, w[0]))
    weight = np.abs(at_nodes) / at_nodes.sum()
    most, straight = float(weight.sum()), float((x * x * weight).sum())
    absolute, square, steady = [], [], []
    for k in range(1, 5):
        power = x**k
        steady.append(float((power * x * weight).sum()) / straight if k % 2 else 0.0)
        if k % 2 == 0:
            power = power - (power * weight).sum() / most
        absolute.append(float((abs(power) * weight).sum()))
        square.append(float(np.sqrt((power**2 * weight).sum())) if k % 2 == 0 else 0.0)
    steady.append(absolute[0] / straight)
    edge = abs(window.edge) / window.sum
    variance = straight / 4 / most
    return Means(tuple(absolute), tuple(square), tuple(steady), most, edge, variance)


def over_record(points: Points, terms: Mapping[int, np.ndarray]) -> Smear:
    """Polynomial in the place in the record of a phase sum_j c_j t^j, c_j [cycles/s^j] by j."""
    half = 0.5 * points.record_duration
    middle = points.start + half
    found: list[np.ndarray | float] = [0.0] * 5
    for j, coefficient in terms.items():
        for k in range(j + 1):
            found[k] = found[k] + math.comb(j, k) * middle ** (j - k) * half**k * coefficient
    return Smear(tuple(np.abs(c) for c in found[1:]), constant=np.abs(found[0]))


def missed(smear: Smear, window: Window) -> np.ndarray:
    """<|phi|>, by which any bin of a line changes at most, relative to its peak."""
    known = means(window)
    total = smear.rest * known.most
    for value, mean in zip(smear.powers, known.absolute, strict=True):
        total = total + value * mean
    return np.minimum(_TURN * total, 2 * known.most)


def added(points: Points, smear: Smear) -> np.ndarray:
    """Part of a phase error in sums of amplitudes, lines and images, as of :class:`Size`.

    Lines next to their images change by the phase in the record's middle too, and so does a line by
    what an image far away adds to it.
    """
    known = means(points.window)
    anywhere = np.minimum(_TURN * (sum(smear.powers) + smear.rest + smear.constant), 2.0)
    each = np.where(points.near_image, known.most * anywhere, missed(smear, points.window))
    whole = 2 * each / points.lobe.worst
    return np.where(points.may_cancel, whole, points.image * anywhere)


def phase_size(points: Points, name: str) -> Size | None:
    """Size of one of the phase errors, whichever of the others are there."""
    own = points.smears.get(name)
    if own is None:
        return None
    known, others = means(points.window), NO_SMEAR
    for other, smear in points.smears.items():
        others = others if other == name else others.plus(smear)
    one, two, three, four = own.powers
    rest = _TURN * own.rest
    odd = rest * known.most
    odd = odd + _TURN * (one * known.absolute[0] + three * known.absolute[2])
    even = rest * known.most
    even = even + _TURN * (two * known.absolute[1] + four * known.absolute[3])
    root = rest * math.sqrt(known.most)
    root = root + _TURN * (two * known.square[1] + four * known.square[3])
    turned: np.ndarray | float = 0.0
    besides: np.ndarray | float = 0.0
    if len(points.smears) > 1:
        besides = missed(others, points.window)
        far = _TURN * (sum(others.powers) + others.rest)
        turned = missed(own, points.window) * np.minimum(far, 2.0)
    late = points.missing
    if late is not None:  # what lacks of the record is not turned; the rest has another middle
        besides = besides + late.lost
        turned = turned + late.lost * np.minimum(_TURN * (sum(own.powers) + own.rest), 2.0)
    a = np.minimum(odd, 2 * known.most) + np.minimum(root * root / 2, 2 * known.most) + turned
    b = np.minimum(even, known.most) + turned
    least = points.powers[0] / np.where(points.near_image, 2.0, 1.01) / (1 + others.reach)
    c = _IMAGE * np.sqrt(least) - besides
    magnitude = np.where(c > 0, (a + b * known.edge / c) / c + 0.5 * (b / c) ** 2, np.inf)
    moved = rest / _TURN * known.steady[4]
    for value, steady in zip(own.powers, known.steady, strict=False):
        moved = moved + value * steady
    if late is not None:
        moved = moved + late.middle * (2 * two + 3 * three + 4 * four)
    shift = 2 * moved * points.margin
    if not points.may_add:
        return Size(magnitude=magnitude, shift=shift)
    alone = np.where(points.may_cancel, 0.0, magnitude)
    return Size(magnitude=alone, added=added(points, own), shift=shift)


def _with_phase(shots: Shots, phase: Callable[..., np.ndarray], **values: Any) -> Shots:
    """Shots with a further phase error."""
    error = PhaseError(phase, values | shots.echo_record)
    return replace(shots, phase_errors=(*shots.phase_errors, error))


def record_times(x: np.ndarray, *, start: np.ndarray, duration: np.ndarray) -> np.ndarray:
    """Time since the segment's start [s] at places x of the record, (n, m)."""
    start, duration = np.atleast_1d(start), np.atleast_1d(duration)
    return start[:, None] + duration[:, None] * (np.asarray(x) + 1) / 2


def _column(value: np.ndarray) -> np.ndarray:
    return np.atleast_1d(np.asarray(value, float))[:, None]


def walk_phase(
    x: np.ndarray,
    *,
    sign: int,
    chirp_rate: np.ndarray,
    radial_velocity: np.ndarray,
    start: np.ndarray,
    duration: np.ndarray,
    slide: np.ndarray | float = 0.0,
) -> np.ndarray:
    """Phase [cycles] that range walk adds to the line's, (n, m), at places x (m,) of the record.

    ``slide`` is the speed [m/s] by which the range along the beam falls faster than at the radial
    velocity at the segment's start.
    """
    beta = 2 * np.asarray(radial_velocity, float) / SPEED_OF_LIGHT
    drift = sign * chirp_rate * (beta * (1 + beta / 2) + slide / SPEED_OF_LIGHT)
    return np.atleast_1d(drift)[:, None] * record_times(x, start=start, duration=duration) ** 2


def walk_smear(points: Points) -> Smear | None:
    """Return the phase that range walk adds over the record; None where there is none."""
    slide = points.approach - points.radial_velocity
    beta = points.beta + points.faster
    each = beta * (1 + beta / 2) + slide / SPEED_OF_LIGHT
    if not each.any():
        return None
    return over_record(points, {2: points.signs * points.chirp_rate * each})


def walk(shots: Shots, scene: Scene) -> Shots:
    """Let the beats of the two chirps drift over the record: at t, to that of R - 2 v_r t."""
    velocity, slide = shots.motion["radial_velocity"], shots.approach - shots.radial_velocity
    shots = _with_phase(
        shots, walk_phase, chirp_rate=shots.chirp_rate, radial_velocity=velocity, slide=slide
    )
    return replace(shots, walk=shots.walk + drift_time(shots))


def drift_time(shots: Shots) -> np.ndarray:
    """Slope of t^2 over the records that the echo has of both chirps [s], (n,) or scalar.

    That of the best straight line under the window: twice the time of the middle of a whole record.
    """
    within = 2 * shots.acquisition_delay + shots.record_duration
    if shots.first_sample is None:
        return np.asarray(within)
    slope = _slope_of_square(shots.window)[shots.first_sample[::2]].mean(axis=0)
    return np.asarray(within + 0.5 * shots.record_duration * slope)


@lru_cache(maxsize=8)
def _slope_of_square(window: Window) -> np.ndarray:
    """Slope of the best line to x^2 over the samples from each on, (L + 1,), under the window.

    The places x of all samples are -1..1, whose slope is 0.
    """
    x = 2 * np.arange(window.length) / window.length - 1
    powers = (window.samples() * x**k for k in range(4))
    zero, one, two, three = (np.cumsum(v[::-1])[::-1] for v in powers)
    with np.errstate(divide="ignore", invalid="ignore"):
        one, two, three = one / zero, two / zero, three / zero
        slope = (three - one * two) / (two - one * one)
    slope = np.clip(np.where(np.isfinite(slope), slope, 2 * x), np.minimum(2 * x, 0.0), 2.0)
    slope[0] = 0.0
    return np.append(slope, 2.0)


RANGE_WALK = Effect(
    name="range_walk",
    about="drift of the beat as the target moves",
    stage="record",
    size=partial(phase_size, name="range_walk"),
    smear=walk_smear,
    act=walk,
)


_ACCELERATION = "target.acceleration"


def acceleration_phase(
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
    """Phase [cycles] that acceleration adds to the beat, (n, m); values at the segment's start."""
    alpha = _column(np.asarray(acceleration) / SPEED_OF_LIGHT)
    beta = _column(2 * np.asarray(radial_velocity) / SPEED_OF_LIGHT)
    delay = _column(2 * np.asarray(range) / SPEED_OF_LIGHT)
    t = record_times(x, start=start, duration=duration)
    chirped = -delay + (1 + beta) * t + alpha * t**2 / 2
    slope = _column(sign * np.asarray(chirp_rate))
    return np.asarray(alpha * t**2 * (_column(carrier) + slope * chirped))


def acceleration_smear(points: Points) -> Smear | None:
    """Return the phase that acceleration adds over the record; None where there is none."""
    if not points.has(_ACCELERATION):
        return None
    alpha = points[_ACCELERATION] / SPEED_OF_LIGHT
    slope = points.signs * points.chirp_rate
    terms = {
        2: alpha * (points.carriers - slope * points.delay),
        3: alpha * slope * (1 + points.beta),
        4: alpha**2 * slope * 0.5,
    }
    return over_record(points, terms)


def acceleration_size(points: Points) -> Size | None:
    """Change of the largest bin by its drift, in a record and over looks that are added."""
    found = phase_size(points, "acceleration")
    if found is None or points.looks.added == 1:
        return found
    left = coherent_gain(
        points.looks, acceleration=points.acceleration, carrier=points.carriers[0],
        period=points.look_period,
    )  # fmt: skip
    return found._replace(magnitude=found.magnitude + 1 - left)


def accelerate(shots: Shots, scene: Scene) -> Shots:
    """Let the Doppler frequency drift over the record of every segment.

    The loss that it causes in looks that are added in amplitude is included.
    """
    if shots.looks.added > 1:
        left = coherent_gain(
            shots.looks, acceleration=shots.acceleration, carrier=shots.carriers[0],
            period=shots.look_period,
        )  # fmt: skip
        shots = replace(shots, beat_scale=shots.beat_scale * left)
    shots = replace(shots, speeding=shots.acquisition_delay + shots.record_duration / 2)
    return _with_phase(
        shots,
        acceleration_phase,
        carrier=shots.carriers,
        chirp_rate=shots.chirp_rate,
        acceleration=shots.acceleration,
        **shots.motion,
    )


ACCELERATION = Effect(
    name="acceleration",
    about="drift of the Doppler frequency",
    stage="record",
    size=acceleration_size,
    smear=acceleration_smear,
    act=accelerate,
    parameters=(
        Parameter(
            path=_ACCELERATION,
            about="Rate at which the radial velocity grows",
            example="10 m/s^2",
            limits=("-1e6 m/s^2", "1e6 m/s^2"),
        ),
    ),
)


_SHAPES = ("quadratic", "cubic", "sinusoidal")
_PEAKS = tuple(f"{CHIRP}{shape}_error" for shape in _SHAPES)
_PERIODS = CHIRP + "error_periods"
ERROR_TABLE, NO_TABLE = CHIRP + "error_table", "none"


def table_phase(
    x: np.ndarray,
    *,
    table: SweepTable,
    sign: int,
    chirp_duration: np.ndarray,
    range: np.ndarray,
    radial_velocity: np.ndarray,
    start: np.ndarray,
    duration: np.ndarray,
) -> np.ndarray:
    """Phase [cycles] that a measured error of the sweep adds to the beat, (n, m).

    The down-chirp runs through the table backwards. Before its first row and after its last the
    error stays what it is there.
    """
    if sign == 0:
        return np.zeros((np.size(range), np.size(x)))
    t = record_times(x, start=start, duration=duration)
    beta = _column(2 * np.asarray(radial_velocity) / SPEED_OF_LIGHT)
    delay = _column(2 * np.asarray(range) / SPEED_OF_LIGHT) - beta * t
    at = t if sign > 0 else _column(chirp_duration) - t  # in the up-chirp
    return -sign * table.integral(at - sign * delay, at)


def sweep_phase(
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

    Peaks q, k and p [Hz], either sign, and periods m > 0 of the last over a sweep of length T [s].
    """
    if sign == 0:
        return np.zeros((np.size(range), np.size(x)))
    t = record_times(x, start=start, duration=duration)
    beta = _column(2 * np.asarray(radial_velocity) / SPEED_OF_LIGHT)
    delay = _column(2 * np.asarray(range) / SPEED_OF_LIGHT)
    length, periods = _column(chirp_duration), _column(periods)
    u = sign * (2 * t / length - 1)
    h = -sign * 2 * (delay - beta * t) / length
    # The integral of e over u from u to u + h, in forms whose terms do not cancel for small h: the
    # mean of T_2 and T_3 over a step about its middle; that of a sine is sinc times it.
    middle, square = u + h / 2, h * h
    mean = _column(quadratic) * (2 * middle**2 - 1 + square / 6)
    mean = mean + _column(cubic) * middle * (4 * middle**2 - 3 + square)
    sine = np.sin(np.pi * periods * middle)
    mean = mean + _column(sinusoidal) * np.sinc(periods * h / 2) * sine
    return np.asarray(sign * length / 2 * (h * mean))


def sweep_smear(points: Points) -> Smear | None:
    """Return the phase that the sweep's error adds over the record; None where there is none.

    Square and cube are polynomials in the place in the record; the sine and what a table departs
    from the middle of its span are taken at their largest.
    """
    text = points.word(ERROR_TABLE)
    if not points.has(*_PEAKS):
        return None if text == NO_TABLE else _table_smear(points, sweep_table(text))
    quadratic, cubic, sinusoidal = (points[path] for path in _PEAKS)
    half, signs = 0.5 * points.record_duration, points.signs
    middle, per_length = points.start + half, 2 / points[CHIRP + "duration"]
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
    turns = 2 * np.pi * points[_PERIODS] * per_length * half
    smear = Smear(tuple(powers), rest, constant, rest * turns)
    return smear if text == NO_TABLE else smear.plus(_table_smear(points, sweep_table(text)))


def _table_smear(points: Points, table: SweepTable) -> Smear:
    """Phase of a table's error e, about -tau e, by the middle of its span, the rest and e'."""
    place = np.cos(np.linspace(0, np.pi, 16 * table.series.size + 1))
    error, slope = table.error(place), np.polynomial.chebyshev.chebder(table.series)
    middle, swing = (error.max() + error.min()) / 2, np.ptp(error) / 2
    steep = np.abs(np.polynomial.chebyshev.chebval(place, slope)).max()
    steep = steep * 2 / (table.last - table.first)
    length, walk, chirped = points.record_duration, np.abs(points.beta), np.abs(points.signs)
    delay = points.delay + walk * (points.start + length)
    linear = 0.5 * walk * length * abs(middle)
    reach = (delay * steep + walk * swing) * length
    powers = (chirped * linear, 0.0, 0.0, 0.0)
    return Smear(powers, chirped * delay * swing, chirped * delay * abs(middle), chirped * reach)


def _product(one: Sequence[Sized], other: Sequence[Sized]) -> list[Sized]:
    """Coefficients of a product of polynomials, lowest power first."""
    product: list[Sized] = [0.0] * (len(one) + len(other) - 1)
    for i, a in enumerate(one):
        for j, b in enumerate(other):
            product[i + j] = product[i + j] + a * b
    return product


def bend_sweep(shots: Shots, scene: Scene) -> Shots:
    """Add the sweep's error to the record of the two chirps."""
    p, own = scene.parameters, {"chirp_duration": shots.duration, **shots.motion}
    if (text := str(p[ERROR_TABLE])) != NO_TABLE:
        shots = _with_phase(shots, partial(table_phase, table=sweep_table(text)), **own)
    return _with_phase(
        shots,
        sweep_phase,
        **own,
        **{shape: p[path] for shape, path in zip(_SHAPES, _PEAKS, strict=True)},
        periods=p[_PERIODS],
    )


CHIRP_NONLINEARITY = Effect(
    name="chirp_nonlinearity",
    about="departure of the sweep from a straight line",
    stage="record",
    size=partial(phase_size, name="chirp_nonlinearity"),
    smear=sweep_smear,
    act=bend_sweep,
    parameters=(
        *(
            Parameter(
                path=path,
                about=f"Peak of the sweep's frequency error that goes as a {form}",
                example="100 kHz",
                limits=("-1e15 Hz", "1e15 Hz"),
            )
            for path, form in zip(_PEAKS, ("square", "cube", "sine"), strict=True)
        ),
        Parameter(
            path=_PERIODS,
            about="Periods of the sinusoidal error over the sweep",
            default=1.0,
            example="5",
            limits=("1e-6", "1000"),
        ),
        Parameter(
            path=ERROR_TABLE,
            about="Measured frequency error of the sweep over the up-chirp, which the down-chirp "
            "runs through backwards: a list of times and errors, [[0 us, 0 Hz], [10 us, 2 kHz], "
            "...], or a CSV file with the columns 'time [us], error [kHz]'; none for no table. It "
            "must cover the chirp from 0 to duration, and be smooth: a Chebyshev series of degree "
            "64 at the most stands for it, to 1e-3 of its span. Echoes that arrive after the "
            "record begins (acquisition_delay) see its ends held, and take longer to compute",
            default=NO_TABLE,
            table=True,
        ),
    ),
)
