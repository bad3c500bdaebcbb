"""What a phase error over the record can change at most of the bin that detects a line.

With w real and even about the record's middle, a phase error phi = o(x) + e(x), odd and even part
(a constant does not matter), changes a line's spectrum W(y), real but for the factor
exp(-i pi y) and the unpaired first sample w_0, by A + i B, all relative to sum w:

    |A| <= a = <|o| + e^2 / 2>      |B| <= b = <|e|>      < > the mean weighted with |w| / sum w

The norm is convex, and the largest bin has M >= c: the scalloping loss for one line; for several
that add as powers the root of the largest bin's share of all power, by the triangle inequality of
their bins. So the largest bin keeps

    1 - (a + b |w_0| / c) / c  <=  M' / M  <=  sqrt((1 + a/c)^2 + (2 b |w_0| + b^2) / c^2)

An even error, as a drift has within the record, thus counts in the second order. Where a is
large, two further bounds serve:

- the linear part of o is a mere shift of all lines: with a_r for a without that part and c for
  lines anywhere between bins, M' is above c - a_r - b |w_0| / c and below
  hypot(1 + a_r, b + |w_0|);
- for any h, |sum X' conj(H)| <= max|X'| sum|H|, and by Cauchy and Schwarz's inequality the sum
  of a smooth |H| is bounded by the second moment B^2 of its place: with h a Hann window carrying
  the same phase error, M' >= <h> / sqrt(2 E_h pi B coth(pi B)), B^2 = 1/3 + the variance, under
  h^2, of the error's slope in bins. It falls as the root of the drift, as the peak does. It is
  one line's.

Lines that add as amplitudes, or with their own images, change by <|phi|> of the sum of their
amplitudes, whatever they make together.

An error enters by the largest coefficients that its powers of x can have: the means of their sum
are bounded by sums of their means, which makes a bound for all points of a tile at once.
"""

import math
from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from sweep.model.effects.change import Change
from sweep.model.effects.columns import columns
from sweep.model.effects.line_spread import sizes_of
from sweep.model.effects.phase_formulas import (
    IMAGE,
    put_added,
    put_error_changes,
    put_missed,
    put_over_record,
    put_peaks,
    put_phase_changes,
)
from sweep.model.effects.span import Span
from sweep.model.window import Window, samples

if TYPE_CHECKING:
    from sweep.model.effects.block import Block

DEVIATION_OF_FWHM = 1 / math.sqrt(8 * math.log(2))
"""Standard deviation of a Gaussian over its full width at half maximum."""

_SHAPE_MARGIN = 1e-4
_NODES = 256
_MANY = 10**12
"""Lines of which none is strong enough to be looked at alone."""
_WIDTH = "instrument.laser.line_width"


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
def shape(window: Window) -> Shape:
    """The window at an even number of nodes."""
    x = (2 * np.arange(_NODES) + 1) / _NODES - 1
    w = samples(window.name, window.length)
    place = 2 * np.arange(window.length + 1) / window.length - 1
    at_nodes = np.interp(x, place, np.append(w, w[0]))
    total = at_nodes.sum()
    y = np.linspace(0, 0.5, 65)
    magnitude = np.abs((np.cos(np.pi * np.outer(y, x)) * at_nodes).sum(axis=1)) / total
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


Sizes = np.ndarray | float


class Error(NamedTuple):
    """How large a phase error over the record can be, (n,) each [cycles]."""

    powers: tuple[Sizes, ...]
    """Largest magnitudes of the coefficients of x, x^2, ... up to x^4, x being -1..1."""
    rest: Sizes = 0.0
    """Largest magnitude of all that is no such power."""
    constant: Sizes = 0.0
    """Largest magnitude in the record's middle, which matters to lines beside their images."""

    def __add__(self, other: "Error") -> "Error":  # type: ignore[override]
        """The sum of two errors."""
        if other is NO_ERROR:
            return self
        return Error(
            tuple(np.add(a, b) for a, b in zip(self.powers, other.powers, strict=True)),
            np.add(self.rest, other.rest),
            np.add(self.constant, other.constant),
        )


NO_ERROR = Error((0.0, 0.0, 0.0, 0.0))


class Means(NamedTuple):
    """Means of powers of x under a window's |w| / sum w, by power 1..4."""

    absolute: tuple[float, ...]
    """<|x^k|> of odd powers, <|x^k - <x^k>|> of even ones."""
    bent: tuple[float, ...]
    """The same of what is left of odd powers without their best straight line."""
    square: tuple[float, ...]
    """Root of <(x^k - <x^k>)^2> of even powers, 0 of odd ones."""
    slope: tuple[float, ...]
    """Deviation of the slope 2 k x^(k-1) in bins, under a Hann window's square."""
    steady: tuple[float, ...]
    """Slope of the best straight line of odd powers, 0 of even ones; last, of what is within 1."""
    hann: float
    """<h>."""


@lru_cache(maxsize=16)
def means(window: Window) -> Means:
    """What bounds need of a window."""
    form = shape(window)
    x, weight = form.x, form.weight
    narrow = np.cos(np.pi * x / 2) ** 4
    narrow /= narrow.sum()
    absolute, bent, square, slope, steady = [], [], [], [], []
    straight = float((x * x * weight).sum())
    for k in range(1, 5):
        power = x**k
        steady.append(float((power * x * weight).sum()) / straight if k % 2 else 0.0)
        if k % 2 == 0:
            power = power - (power * weight).sum() / form.absolute
        absolute.append(float((abs(power) * weight).sum()))
        bent.append(float((abs(power - steady[-1] * x) * weight).sum()))
        square.append(float(np.sqrt((power**2 * weight).sum())) if k % 2 == 0 else 0.0)
        bins = 2 * k * x ** (k - 1)
        slope.append(float(np.sqrt(((bins - (bins * narrow).sum()) ** 2 * narrow).sum())))
    hann = float((form.signed * np.cos(np.pi * x / 2) ** 2).sum())
    steady.append(absolute[0] / straight)
    return Means(tuple(absolute), tuple(bent), tuple(square), tuple(slope), tuple(steady), hann)


class Peak(NamedTuple):
    """The largest bin of some lines without the error, (n,) each.

    Relative to the root of (sum |a|^2 / 4) times sum w, of one line or several that add as powers.
    """

    least: ArrayLike
    """Its least magnitude, wherever lines lie between bins."""
    most: ArrayLike
    """Its largest."""
    single: bool = True
    """Whether it is one line's."""


def one_line(window: Window) -> Peak:
    """The peak of a line of which nothing is known."""
    form = shape(window)
    return Peak(form.scalloped, form.top)


def phase_change(
    error: Error, *, window: Window, peak: Peak | None = None, others: Error = NO_ERROR
) -> Change:
    """What a phase error can change of the largest bin's magnitude.

    Parameters
    ----------
    error : Error
        The phase error.
    window : Window
        The record's window.
    peak : Peak, optional
        The largest bin without any; by default that of one line.
    others : Error
        Phase errors that may be there besides: they lower the bin, and turn what changes.
    """
    peak = peak or one_line(window)
    table, found_shape = columns(
        *error.powers, error.rest, *others.powers, others.rest, peak.least, peak.most
    )
    found, flags = np.empty((2, *found_shape)), (others is not NO_ERROR, bool(peak.single))
    put_phase_changes(table, *of_window(window), flags, found.reshape(2, -1))
    return Change(signal=(found[0], found[1]))


@lru_cache(maxsize=16)
def of_window(window: Window) -> tuple[tuple[tuple[float, ...], ...], tuple[float, ...]]:
    """What compiled formulas take of a window."""
    form, known = shape(window), means(window)
    return (
        (known.absolute, known.bent, known.square, known.slope),
        (form.absolute, form.edge, form.top, known.hann),
    )


def missed(error: Error, window: Window) -> np.ndarray:
    """<|phi|>, by which any bin of a line changes at most, relative to its peak."""
    table, found_shape = columns(*error.powers, error.rest)
    found = np.empty(found_shape)
    put_missed(table, means(window).absolute, shape(window).absolute, found.reshape(-1))
    return found


Own = Callable[["Block"], Error | None]
_KNOWN: list[Own] = []


def counted(error: Own) -> Own:
    """A phase error of a block, (3, tiles) by segment, that counts for what others can change."""
    kept = lru_cache(maxsize=2)(error)
    _KNOWN.append(kept)
    return kept


def errors_of(block: "Block", but: Own | None = None) -> Error:
    """All phase errors of a block together, but for one, (3, tiles)."""
    total = NO_ERROR
    for known in _KNOWN:
        if known is not but and (error := known(block)) is not None:
            total = total + error
    return total


def error_change(block: "Block", own: Own) -> Change | None:
    """What one of the phase errors can change in the largest bin of each segment, (3, tiles)."""
    error = own(block)
    if error is None:
        return None
    others = errors_of(block, own)
    width, number = _broadening(block)
    table = np.empty((13, 3, block.size))
    for k, value in enumerate((width, *_parts(error), *_parts(others))):
        table[k] = value
    found = np.empty((4, *table.shape[1:]))
    put_error_changes(
        block.axis, table.reshape(13, -1), number, sizes_of(block.lines.lobe), _record(block),
        (*of_window(block.window), means(block.window).steady),
        (others is not NO_ERROR, block.number == 1, may_add(block)), found.reshape(4, -1),
    )  # fmt: skip
    low, high, lines_added, moved = found
    return Change(signal=(low, high), added=lines_added, shift=moved)


def _parts(error: Error) -> tuple[Sizes, ...]:
    return *error.powers, error.rest, error.constant


def may_add(block: "Block") -> bool:
    """Whether lines add as amplitudes, or may."""
    return block.adds_amplitudes or block.has("target.roughness")


def may_cancel(block: "Block", images: np.ndarray) -> np.ndarray:
    """Where amplitudes, or lines and images that make powers so much larger, may cancel."""
    return may_add(block) & ((images > 1.5) | (block.number > 1))


def added(block: "Block", error: Error, images: np.ndarray) -> np.ndarray:
    """What a phase error adds to sums of amplitudes, lines and images, as of :class:`Change`."""
    table, found_shape = columns(*error.powers, error.rest, error.constant, images)
    found, window = np.empty(found_shape), block.window
    least = block.lines.lobe.worst
    put_added(table, means(window).absolute, shape(window).absolute, least, found.reshape(-1))
    return found


def peak_of(block: "Block", error: Error, *, broadened: bool = True) -> tuple[Peak, np.ndarray]:
    """The largest bin of a block's lines as powers, (3, tiles), whichever effects there are.

    Parameters
    ----------
    block : Block
        The block.
    error : Error
        All phase errors that there may be.
    broadened : bool
        Whether the laser's line may have its width.

    Returns
    -------
    Peak
    (3, tiles) ndarray
        By how much images make powers larger at the most.
    """
    width, number = _broadening(block) if broadened else (0.0, block.number)
    table = np.empty((5, 3, block.size))
    for k, value in enumerate((width, *error.powers)):
        table[k] = value
    found, lobe = np.empty((3, *table.shape[1:])), sizes_of(block.lines.lobe)
    put_peaks(block.axis, table.reshape(5, -1), number, lobe, _record(block), found.reshape(3, -1))
    return Peak(found[0], found[1], block.number == 1), found[2]


def _broadening(block: "Block") -> tuple[Sizes, int]:
    """Width of the laser's line [bins] where it may have one, and lines at the most."""
    if block.word("instrument.laser.line_shape") != "gaussian" or not block.has(_WIDTH):
        return 0.0, block.number
    return block[_WIDTH].high * DEVIATION_OF_FWHM / block.bin_width.low, _MANY


def _record(block: "Block") -> tuple[int, int, float]:
    """Size of the FFT, length of the record, what images leave of the least magnitude."""
    return block.fft_size, block.window.length, IMAGE if block.adds_amplitudes else 1.0


def over_record(terms: Mapping[int, Span], *, start: Span, duration: Span) -> Error:
    """A sum of powers of the time over the record.

    Parameters
    ----------
    terms : mapping
        Coefficients [cycles/s^j] by power j, 2..4, of the time since the segment's start.
    start, duration : Span
        Acquisition delay and length of the record [s].
    """
    ends = (end for c in terms.values() for end in (c.low, c.high))
    table, found_shape = columns(*record_powers(start, duration), *ends)
    found = np.empty((5, *found_shape))
    put_over_record(table, np.array(list(terms)), found.reshape(5, -1))
    return Error(tuple(found[1:]), constant=found[0])


@lru_cache(maxsize=8)
def record_powers(start: Span, duration: Span) -> tuple[Sizes, ...]:
    """Powers 0..4 of half a record's length at the most, and ends of those of its middle."""
    half = 0.5 * duration
    middle = start + half
    spans = [middle**k for k in range(5)]
    return (*(half.high**k for k in range(5)), *(e for s in spans for e in (s.low, s.high)))


def by_segment(block: "Block", *errors: Error | None) -> Error:
    """Errors of up, Doppler and down segment as one, (3, tiles) each."""
    values = np.zeros((6, 3, block.size))
    for segment, error in enumerate(errors):
        if error is not None:
            parts = (*error.powers, error.rest, error.constant)
            for row, value in zip(values, parts, strict=True):
                row[segment] = value
    return Error(tuple(values[:4]), values[4], values[5])
