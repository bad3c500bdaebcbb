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
from sweep.model.effects.line_spread import Moments, image_factor, power_range
from sweep.model.effects.span import Span, any_holds
from sweep.model.window import Window, samples

if TYPE_CHECKING:
    from sweep.model.effects.block import Block

DEVIATION_OF_FWHM = 1 / math.sqrt(8 * math.log(2))
"""Standard deviation of a Gaussian over its full width at half maximum."""

MARGIN = 1.01
"""What a and b are raised by, for the means being sums over nodes."""

_SHAPE_MARGIN = 1e-4
_NODES = 256
_HUGE = 1e12
_MANY = 10**12
"""Lines of which none is strong enough to be looked at alone."""
_IMAGE = 0.9
"""What an image far away leaves at least of a line whose amplitude it adds to."""
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
    form, peak = shape(window), peak or one_line(window)
    besides, turned = np.zeros(()), np.zeros(())
    if others is not NO_ERROR:
        besides = missed(others, window)
        turned = missed(error, window) * np.minimum(_largest(others), 2.0)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        c = np.asarray(peak.least) - besides
        if peak.single:
            c = np.fmax(c, _matched(others, window))
        c = np.where(c > 0, c, 0.0)
        a, b = _parts(error, window, shifted=False)
        a_rest, _ = _parts(error, window, shifted=True)
        a, b, edge = a + turned, b + turned, form.edge
        most = np.asarray(peak.most) + besides
        low = 1 - (a + b * edge / c) / c
        low = np.fmax(low, (c - a_rest - b * edge / c) / most)
        if peak.single:
            low = np.fmax(low, _matched(error + others, window) / most)
        high = np.sqrt((1 + a / c) ** 2 + (2 * b * edge + b**2) / c**2)
        high = np.fmin(high, (np.hypot(form.top + a_rest, b + edge) + besides) / c)
        high = np.fmin(high, form.absolute / c)
    return _within(low, high)


def missed(error: Error, window: Window) -> np.ndarray:
    """<|phi|>, by which any bin of a line changes at most, relative to its peak."""
    known = means(window)
    turns = [2 * np.pi * np.asarray(v, float) for v in (*error.powers, error.rest)]
    scales = (*known.absolute, shape(window).absolute)
    total = sum(turn * scale for turn, scale in zip(turns, scales, strict=True))
    return np.asarray(MARGIN * np.minimum(total, 2 * shape(window).absolute))


def _largest(error: Error) -> np.ndarray:
    """Largest phase [rad] anywhere in the record."""
    return np.asarray(2 * np.pi * (sum(np.asarray(v) for v in error.powers) + error.rest))


def _within(low: np.ndarray, high: np.ndarray) -> Change:
    low = np.where(np.isnan(low), 0.0, low)
    high = np.where(np.isnan(high), _HUGE, high)
    return Change(signal=(np.clip(low, 0.0, 1.0), np.clip(high, 1.0, _HUGE)))


def _parts(error: Error, window: Window, *, shifted: bool) -> tuple[np.ndarray, np.ndarray]:
    """Bounds a, b [rad], (n,) each; ``shifted`` without the odd part's best line."""
    known, most = means(window), shape(window).absolute
    turns = [2 * np.pi * np.asarray(v, float) for v in error.powers]
    rest = 2 * np.pi * np.asarray(error.rest, float)
    scales = known.bent if shifted else known.absolute
    odd = rest * most + sum(turns[k] * scales[k] for k in (0, 2))
    even = rest * most + sum(turns[k] * known.absolute[k] for k in (1, 3))
    root = rest * np.sqrt(most) + sum(turns[k] * known.square[k] for k in (1, 3))
    a = np.minimum(odd, 2 * most) + np.minimum(root**2 / 2, 2 * most)
    return MARGIN * a, MARGIN * np.minimum(even, most)


def _matched(error: Error, window: Window) -> np.ndarray:
    """Lower bound from a Hann window that carries the same phase error."""
    known = means(window)
    bins = sum(np.multiply(v, s) for v, s in zip(error.powers, known.slope, strict=True))
    reach = np.sqrt(1 / 3 + MARGIN * np.asarray(bins) ** 2)
    room = 2 * (3 / 8) * np.pi * reach / np.tanh(np.pi * reach)
    return np.where(np.asarray(error.rest) > 0, 0.0, known.hann / np.sqrt(room) / MARGIN)


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
    others, window = errors_of(block, own), block.window
    images, cancelling = images_of(block, error + others)
    change = phase_change(error, window=window, peak=peak_of(block, images), others=others)
    steady = zip((*error.powers, error.rest), means(window).steady, strict=True)
    moved = np.asarray(sum(v * slope for v, slope in steady))
    low, high = (np.where(cancelling, 1.0, end) for end in change.signal)
    return Change(
        signal=(low, high),
        added=np.where(cancelling, added(block, error, images), 0.0)
        if any_holds(cancelling)
        else 0.0,
        shift=2 * moved * block.fft_size / window.length,
    )


def images_of(block: "Block", error: Error) -> tuple[np.ndarray, np.ndarray]:
    """By how much images may make powers larger, and where amplitudes may cancel, (3, tiles)."""
    slopes = (k * np.asarray(v, float) for k, v in enumerate(error.powers, 1))
    reach = np.asarray(2 * sum(slopes)) * block.fft_size / block.window.length
    images = image_factor(block.lines, block.spread.extreme + reach)
    amplitudes = block.adds_amplitudes or block.has("target.roughness")
    return images, amplitudes & ((images > 1.5) | (block.number > 1))


def added(block: "Block", error: Error, images: np.ndarray) -> np.ndarray:
    """What a phase error adds to sums of amplitudes, lines and images, as of :class:`Change`."""
    anywhere = _largest(error) + 2 * np.pi * np.asarray(error.constant)
    beside = MARGIN * shape(block.window).absolute * np.minimum(anywhere, 2.0)
    each = np.where(images > 1.5, beside, missed(error, block.window))
    return 2 * each / block.lines.lobe.least(np.asarray(0.5))


def peak_of(block: "Block", images: ArrayLike, *, broadened: bool = True) -> Peak:
    """The largest bin of a block's lines as powers, (3, tiles), whichever effects there are.

    Parameters
    ----------
    block : Block
        The block.
    images : array_like
        By how much images make powers larger at the most.
    broadened : bool
        Whether the laser's line may have its width.
    """
    lines, spread, number = block.lines, block.spread, block.number
    if broadened and block.word("instrument.laser.line_shape") == "gaussian" and block.has(_WIDTH):
        width = block[_WIDTH].high * DEVIATION_OF_FWHM / block.bin_width.low
        spread = Moments(spread.mean, np.hypot(spread.rms, width), spread.extreme + 6 * width)
        number = _MANY
    half, none = np.full_like(lines.edge, 0.5), np.zeros_like(lines.edge)
    anywhere = lines._replace(bin_offset=half, bin_offset_least=none)
    least, most = power_range(anywhere, spread, number)
    uneven = np.asarray(images) * np.exp(np.minimum(lines.tilt * spread.extreme, 50.0))
    c = np.sqrt(least / uneven)
    if block.adds_amplitudes:
        c = _IMAGE * c
    return Peak(c, np.sqrt(most) / _IMAGE, block.number == 1)


def over_record(terms: Mapping[int, Span], *, start: Span, duration: Span) -> Error:
    """A sum of powers of the time over the record.

    Parameters
    ----------
    terms : mapping
        Coefficients [cycles/s^j] by power j, 2..4, of the time since the segment's start.
    start, duration : Span
        Acquisition delay and length of the record [s].
    """
    half = 0.5 * duration
    middle = start + half
    parts = []
    for k in range(5):
        each = [math.comb(j, k) * c * middle ** (j - k) for j, c in terms.items() if j >= k]
        parts.append(sum(each, Span.of(0.0)).magnitude * half.high**k)
    return Error(tuple(parts[1:]), constant=parts[0])


def by_segment(block: "Block", *errors: Error | None) -> Error:
    """Errors of up, Doppler and down segment as one, (3, tiles) each."""
    values = np.zeros((6, 3, block.size))
    for segment, error in enumerate(errors):
        if error is not None:
            parts = (*error.powers, error.rest, error.constant)
            for row, value in zip(values, parts, strict=True):
                row[segment] = value
    return Error(tuple(values[:4]), values[4], values[5])
