"""What a phase error over the record can change at most of the bin that detects a line.

With w real and even about the record's middle, a phase error phi = o(x) + e(x), odd and even part
(a constant does not matter), changes a line's spectrum W(y), real but for the factor
exp(-i pi y) and the unpaired first sample w_0, by A + i B, all relative to sum w:

    |A| <= a = <|o| + e^2 / 2>      |B| <= b = <|e|>      < > the mean weighted with |w| / sum w

The norm is convex, and the nearest bin has M >= c, the scalloping loss; so the largest bin keeps

    1 - (a + b |w_0| / c) / c  <=  M' / M  <=  sqrt((1 + a/c)^2 + (2 b |w_0| + b^2) / c^2)

An even error, as a drift has within the record, thus counts in the second order. Where a is
large, two further bounds serve:

- the linear part of o is a mere shift, which costs the scalloping loss at most: with a_r for a
  without that part, M' lies between c - a_r - b |w_0| and hypot(1 + a_r, b + |w_0|);
- for any h, |sum X' conj(H)| <= max|X'| sum|H|, and by Cauchy and Schwarz's inequality the sum
  of a smooth |H| is bounded by the second moment B^2 of its place: with h a Hann window carrying
  the same phase error, M' >= <h> / sqrt(2 E_h pi B coth(pi B)), B^2 = 1/3 + the variance, under
  h^2, of the error's slope in bins. It falls as the root of the drift, as the peak does.

Lines near DC or Nyquist, where images interfere, are not what this speaks of.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from sweep.model.effects.change import Change
from sweep.model.effects.line_splitting import Phase
from sweep.model.window import Window, samples

MARGIN = 1.01
"""What a and b are raised by, for the means being sums over nodes."""

_SHAPE_MARGIN = 1e-4


class Shape(NamedTuple):
    """A window at nodes over the record, and what of it bounds need; relative to sum w."""

    x: np.ndarray
    """(m,): nodes, symmetric about 0, in (-1, 1)."""
    weight: np.ndarray
    """(m,): |w| so that its sum is that of |w| over sum w."""
    signed: np.ndarray
    """(m,): w so that its sum is 1."""
    absolute: float
    """Sum |w| over sum w, >= 1."""
    edge: float
    """|w_0| over sum w."""
    scalloped: float
    """Least |W| within half a bin of a line."""
    top: float
    """Largest |W|, 1 but for windows with ripple."""


@lru_cache(maxsize=16)
def shape(window: Window, nodes: int = 256) -> Shape:
    """The window at an even number of nodes."""
    x = (2 * np.arange(nodes) + 1) / nodes - 1
    w = samples(window.name, window.length)
    place = 2 * np.arange(window.length + 1) / window.length - 1
    at_nodes = np.interp(x, place, np.append(w, w[0]))
    total = at_nodes.sum()
    y = np.linspace(0, 0.5, 65)
    magnitude = np.abs(np.cos(np.pi * np.outer(y, x)) @ at_nodes) / total
    absolute = np.abs(at_nodes) / total
    slack = 1 + _SHAPE_MARGIN + 1 / window.length**2
    return Shape(
        x=x,
        weight=absolute,
        signed=at_nodes / total,
        absolute=float(absolute.sum()),
        edge=abs(window.edge) / window.sum,
        scalloped=float(magnitude.min()) / slack,
        top=max(1.0, float(magnitude.max())) * slack,
    )


def phase_change(
    phase: Phase,
    *,
    window: Window,
    concentration: np.ndarray | None = None,
    periods: float = 0.0,
) -> Change:
    """What a phase error can change of the largest bin's magnitude.

    Parameters
    ----------
    phase : callable
        Phase errors [cycles] of n points, (n, m) at m places of the record.
    window : Window
        The record's window.
    concentration : (n,) ndarray, optional
        For several lines that share the phase error (a resolved footprint): magnitude of the
        largest bin without the effect over (sum |a| / 2) sum w, for powers over the root of
        (sum |a|^2 / 4) times sum w; or less. Without it the beam is one line.
    periods : float
        Periods that the error may have over the record; sets the number of nodes.
    """
    form = shape(window, 256 + 16 * int(np.ceil(max(periods, 0.0))))
    turn = 2 * np.pi * phase(form.x)
    if concentration is not None:
        turn = turn - _mean(turn, form.weight)[:, None] / form.absolute
        missed = MARGIN * _mean(2 * np.abs(np.sin(np.clip(turn, -np.pi, np.pi) / 2)), form.weight)
        share = missed / concentration
        return Change(signal=(np.maximum(1 - share, 0.0), 1 + share))
    c, edge = form.scalloped, form.edge
    a, b = _parts(turn, form, shifted=False)
    a_rest, b_rest = _parts(turn, form, shifted=True)
    least = np.maximum(1 - (a + b * edge / c) / c, (c - a_rest - b_rest * edge) / form.top)
    least = np.maximum(least, _matched(turn, form))
    most = np.sqrt((1 + a / c) ** 2 + (2 * b * edge + b**2) / c**2)
    most = np.minimum(most, np.hypot(form.top + a_rest, b_rest + edge) / c)
    return Change(signal=(np.minimum(least, 1.0), np.minimum(most, form.absolute / c)))


def _mean(values: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Weighted sums over the nodes, in an order that does not depend on the number of threads."""
    return np.asarray((values * weight).sum(axis=1))


def _parts(turn: np.ndarray, form: Shape, *, shifted: bool) -> tuple[np.ndarray, np.ndarray]:
    """Bounds a, b of the phase [rad], (n,) each; ``shifted`` without the odd part's best line."""
    odd, even = (turn - turn[:, ::-1]) / 2, (turn + turn[:, ::-1]) / 2
    even = even - _mean(even, form.weight)[:, None] / form.absolute
    if shifted:
        slope = _mean(odd * form.x, form.weight) / (form.x**2 * form.weight).sum()
        odd = odd - slope[:, None] * form.x
    a = _mean(np.minimum(np.abs(odd), 2.0) + np.minimum(even**2 / 2, 2.0), form.weight)
    b = _mean(np.minimum(np.abs(even), 1.0), form.weight)
    return MARGIN * a, MARGIN * b


def _matched(turn: np.ndarray, form: Shape) -> np.ndarray:
    """Lower bound from a Hann window that carries the same phase error."""
    step = form.x[1] - form.x[0]
    bins = np.gradient(turn, step, axis=1) / np.pi
    weight = np.cos(np.pi * form.x / 2) ** 4
    weight = weight / weight.sum()
    spread = _mean((bins - _mean(bins, weight)[:, None]) ** 2, weight)
    reach = np.sqrt(1 / 3 + MARGIN * spread)
    room = 2 * (3 / 8) * np.pi * reach / np.tanh(np.pi * reach)
    mean = (form.signed * np.cos(np.pi * form.x / 2) ** 2).sum()
    return np.asarray(mean / np.sqrt(room) / (MARGIN * form.top))
