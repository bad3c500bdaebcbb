"""Which effects are simulated: those whose bounds, taken together, pass the tolerance on pd.

The bounds are intervals on one magnitude; when several effects are left out and others kept, the
magnitude from which one of them counts lies anywhere in the product of all the others' intervals.
:func:`pd_change_within` is the largest change of pd from there. With x = ln a it is

    max_x  Q_1(e^{x + s}, b) - Q_1(e^x, b)  <=  s max g,
    g = dQ_1/dx = a b I_1(a b) e^{-(a^2 + b^2)/2}

with g <= sqrt(a b / (2 pi)) e^{-(a - b)^2 / 2}, which has one maximum, at a (a - b) = 1/2; or the
change from one end of the interval to the other. What is left out then changes pd by no more than
the sum of these changes, whichever of the others are there.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from sweep.model.effects.change import Change, pd_change
from sweep.model.marcum import marcum_q1

MODES = ("auto", "on", "off")
_HUGE = 1e12


class Plan(NamedTuple):
    """What is simulated and what is not."""

    kept: tuple[str, ...]
    """Effects that are simulated, in the order given."""
    left_out: dict[str, float]
    """Effects that are not, and the largest change of pd that each may make."""
    needed: dict[str, float]
    """Effects that are, and the same."""
    point: dict[str, int]
    """Number of the point at which an effect may change most, for kept and left out."""
    error: float
    """Largest sum, over the points, of what is left out may change."""
    within: bool
    """Whether that is within the tolerance: always, unless effects were forced off."""


def plan(
    bounds: Mapping[str, Change | ArrayLike],
    *,
    amplitude: ArrayLike,
    threshold: ArrayLike,
    tolerance: float,
    modes: Mapping[str, str] | None = None,
    inside: Mapping[str, tuple[str, ...]] | None = None,
) -> Plan:
    """Effects to be simulated for a block of points.

    Parameters
    ----------
    bounds : mapping
        Name to what the effect can change, (n,) or scalars, or (segments, n): then the sum of the
        segments' changes counts, which bounds that of their product. An array stands for itself:
        a bound on the change of a probability.
    amplitude, threshold : array_like
        Magnitude of the detecting bin without any of the effects, and the threshold, over sigma;
        of the same shapes.
    tolerance : float
        On pd, 0..1, for the sum of all that is left out, at every point.
    modes : mapping, optional
        Name to ``auto`` (by default), ``on`` or ``off``.
    inside : mapping, optional
        Name to effects that are nothing without it: it is left out only where they are too.

    Raises
    ------
    ValueError
        For a mode that is none of these, an effect that is not among the bounds, or one that is
        on inside one that is off.
    """
    modes, inside = dict(modes or {}), dict(inside or {})
    _check(bounds, modes, inside)
    changes = pd_changes(bounds, amplitude=amplitude, threshold=threshold)
    largest = {name: float(values.max(initial=0.0)) for name, values in changes.items()}
    size = max((values.size for values in changes.values()), default=1)
    total = np.zeros(size)
    out = _forced(bounds, modes, inside)
    for name in out:
        total += changes[name]
    candidates = [n for n in bounds if modes.get(n, "auto") == "auto" and n not in out]
    order = sorted(candidates, key=lambda name: largest[name])  # equals in the order given
    settled = False
    while not settled:
        settled = True
        for name in order:
            missing = name not in out and all(part in out for part in inside.get(name, ()))
            if missing and (total + changes[name]).max(initial=0.0) <= max(tolerance, 0.0):
                total += changes[name]
                out.append(name)
                settled = False
    # what was forced off may pass the tolerance alone; what changes nothing goes all the same
    out += [name for name in order if name not in out and largest[name] == 0.0
            and all(part in out for part in inside.get(name, ()))]  # fmt: skip
    error = float(total.max(initial=0.0))
    kept = tuple(name for name in bounds if name not in out)
    return Plan(
        kept=kept,
        left_out={name: largest[name] for name in bounds if name in out},
        needed={name: largest[name] for name in kept},
        point={name: int(changes[name].argmax()) if size else 0 for name in bounds},
        error=error,
        within=error <= tolerance,
    )


def _forced(
    bounds: Mapping[str, object], modes: Mapping[str, str], inside: Mapping[str, tuple[str, ...]]
) -> list[str]:
    """Effects that are off, and with them what is nothing without them."""
    out = {name for name, mode in modes.items() if mode == "off"}
    grown = True
    while grown:
        parts = {part for name in out for part in inside.get(name, ())} - out
        grown = bool(parts)
        out |= parts
    for name in bounds:
        if name in out and modes.get(name) == "on":
            raise ValueError(f"{name} cannot be on inside an effect that is off")
    return [name for name in bounds if name in out]


def _check(
    bounds: Mapping[str, object], modes: Mapping[str, str], inside: Mapping[str, tuple[str, ...]]
) -> None:
    parts = {part for parts in inside.values() for part in parts}
    unknown = (set(modes) | set(inside) | parts) - set(bounds)
    if unknown:
        raise ValueError(f"no bound is given for {', '.join(sorted(unknown))}")
    for name, mode in modes.items():
        if mode not in MODES:
            raise ValueError(f"{name}: no mode {mode!r}: choose from {', '.join(MODES)}")


def pd_changes(
    bounds: Mapping[str, Change | ArrayLike], *, amplitude: ArrayLike, threshold: ArrayLike
) -> dict[str, np.ndarray]:
    """Largest change of pd by each effect, whichever of the others there are, (n,) each, 0..1.

    Parameters are those of :func:`plan`.
    """
    shape = np.broadcast_shapes(
        np.shape(amplitude), np.shape(threshold), (1,),
        *(np.shape(v) for bound in bounds.values() for v in _arrays(bound)),
    )  # fmt: skip
    a, b = (np.broadcast_to(np.asarray(v, float), shape) for v in (amplitude, threshold))
    changes = {name: v for name, v in bounds.items() if isinstance(v, Change)}
    ends = {name: _ends(change) for name, change in changes.items()}
    result = {}
    for name, bound in bounds.items():
        if not isinstance(bound, Change):
            values = np.broadcast_to(np.asarray(bound, float), shape)
        else:
            low, high, lower, upper = a, a, b, b
            for other, (weak, strong, down, up) in ends.items():
                if other != name:
                    low, high, lower, upper = low * weak, high * strong, lower * down, upper * up
            values = pd_change_within(bound, amplitude=(low, high), threshold=(lower, upper))
            values = np.broadcast_to(values, shape)
        result[name] = np.minimum(values.sum(axis=0), 1.0) if values.ndim > 1 else values
    return result


def _arrays(bound: Change | ArrayLike) -> tuple[ArrayLike, ...]:
    return (*bound.signal, *bound.noise) if isinstance(bound, Change) else (bound,)


def _ends(change: Change) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Least and largest factor on amplitude and threshold over sigma."""
    weak, strong = (np.minimum(np.asarray(v, float), _HUGE) for v in change.signal)
    quiet, loud = (1 / np.sqrt(np.asarray(v, float)) for v in change.noise)
    if change.threshold_follows:
        return weak * loud, strong * quiet, np.asarray(1.0), np.asarray(1.0)
    return weak * loud, strong * quiet, loud, quiet


def pd_change_within(
    change: Change,
    *,
    amplitude: tuple[ArrayLike, ArrayLike],
    threshold: tuple[ArrayLike, ArrayLike],
) -> np.ndarray:
    """Largest change of the probability of detection, starting anywhere within intervals, 0..1.

    Parameters
    ----------
    change : Change
        What the effect can change.
    amplitude, threshold : (array_like, array_like)
        Least and largest magnitude and threshold, over sigma, without it.
    """
    low, high = (np.minimum(np.asarray(v, float), _HUGE) for v in amplitude)
    lower, upper = (np.asarray(v, float) for v in threshold)
    weak, strong, down, up = _ends(change)
    if np.all(low == high) and np.all(lower == upper):
        ends = (np.minimum(change.signal[0], _HUGE), np.minimum(change.signal[1], _HUGE))
        return pd_change(change._replace(signal=ends), amplitude=low, threshold=lower)
    from_end_to_end = marcum_q1(high * np.maximum(strong, 1), lower * np.minimum(down, 1)).q
    from_end_to_end = (
        from_end_to_end - marcum_q1(low * np.minimum(weak, 1), upper * np.maximum(up, 1)).q
    )
    below, above = low * np.minimum(weak, 1), high * np.maximum(strong, 1)
    smallest, biggest = lower * np.minimum(down, 1), upper * np.maximum(up, 1)
    with np.errstate(divide="ignore"):
        steps = np.maximum(np.log(np.maximum(strong, 1)), -np.log(np.minimum(weak, 1)))
        turns = np.maximum(np.log(np.maximum(up, 1)), -np.log(np.minimum(down, 1)))
    with np.errstate(invalid="ignore"):
        slopes = steps * _steepest(below, above, smallest, biggest)
        slopes = slopes + turns * _steepest_threshold(below, above, smallest, biggest)
    return np.asarray(np.fmin(np.maximum(from_end_to_end, 0.0), slopes))


def _steepest(
    low: np.ndarray, high: np.ndarray, smallest: np.ndarray, biggest: np.ndarray
) -> np.ndarray:
    """Bound on dQ_1/d ln a over a box of amplitudes and thresholds."""
    peak_low = (smallest + np.sqrt(smallest**2 + 2)) / 2
    peak_high = (biggest + np.sqrt(biggest**2 + 2)) / 2
    a = np.minimum(np.where(high < peak_low, high, np.maximum(low, peak_high)), peak_high * 1e6)
    apart = np.maximum(np.maximum(smallest - a, a - biggest), 0.0)
    beyond = (high < peak_low) | (low > peak_high)
    exponential = np.exp(-(np.where(beyond, apart, 0.0) ** 2) / 2)
    return np.asarray(np.sqrt(a * biggest / (2 * np.pi)) * exponential)


def _steepest_threshold(
    low: np.ndarray, high: np.ndarray, smallest: np.ndarray, biggest: np.ndarray
) -> np.ndarray:
    """Bound on -dQ_1/d ln b = b^2 I_0(a b) e^{-(a^2 + b^2)/2} over the box.

    I_0(z) e^{-z} is at most 1 and 1/sqrt(1 + 2 z): the one for a below b/2, the other above.
    """
    half = smallest / 2
    weak = biggest**2 * np.exp(-(np.maximum(smallest - np.minimum(high, half), 0.0) ** 2) / 2)
    apart = np.maximum(np.maximum(low - biggest, smallest - high), 0.0)
    strong = biggest**2 / np.sqrt(1 + smallest**2) * np.exp(-(apart**2) / 2)
    return np.asarray(
        np.maximum(np.where(low < half, weak, 0.0), np.where(high >= half, strong, 0.0))
    )
