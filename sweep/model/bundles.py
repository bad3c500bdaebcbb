"""Lines of a segment as bundles: moments about few bins, whatever befalls the lines.

Lines close together are one bundle, as narrow as the ladder of :mod:`sweep.model.known_kernels`
has it; lines that spread wider are sorted into bundles of one width side by side. Bins next to
the lines see the moments through known kernels. Bins far from them see each bundle as few sources;
of lines that add as powers and have parts, which add as amplitudes, each bundle is a form of its
sources' kernels K_i:

    sum_ij F_ij K_i K_j + sum_i F_i K_i + F

for images, about mirrored places, with -F_i. That is as smooth a function of the bin as the power
of a line without parts, and costs the same however many lines and parts there are.
"""

import math

from sweep.model.compiling import borrowing
from sweep.model.elementary import fma
from sweep.model.equivalent import chebyshev_moments, nodes_for
from sweep.model.kernel_rows import (
    ASIDE,
    FORM_WIDTH,
    HALF,
    HALVES,
    MOST_MOMENTS,
    MOST_PARTS,
    PLACES,
)
from sweep.model.known_kernels import (
    is_real,
    kernels_beside,
    level_for,
    slot_for,
    total_strength,
)
from sweep.model.known_sources import form_of, sources_of, strengths_afar
from sweep.model.lanes import COLUMNS, combine, dot
from sweep.model.spectrum import fraction

DELTA, STRENGTH_RE, STRENGTH_IM = 19, 20, 21
"""Rows of scratch that hold the lines."""

MOMENTS = 22
"""First of two rows that hold the moments of bundles, real and imaginary."""

FORM = MOMENTS + 2
"""Row of the bundles' forms; the next one holds kernels."""

ROOM = FORM + 2
"""Rows of scratch."""

WIDTH = 8192
"""Numbers that a row must hold."""

LEAST_KNOWN = 6
"""Lines, or nodes that they need, from which on moments are taken of whole lines."""

WIDEST, SIDE_BY_SIDE = (9, 6), (7, 6)
"""Levels: of a bundle by itself at the most, of bundles side by side; of amplitudes, of powers."""


@borrowing()
def as_lines():
    """What stands in a bundle's place where lines are taken one by one."""
    return -1, 0, 0, 1, 0, False, (0.0, 0.0, 0.0)


@borrowing()
def take_bundles(n, power, whose, parts, allowed, kernel, room):
    """Takes n lines in rows DELTA .. as bundles, and puts the sources of these in their place.

    Parameters
    ----------
    n : int
    power : bool
        Whether lines add as powers; weights are then real.
    whose : (int, int, float)
        As the first three of :func:`sweep.model.known_kernels.slot_for`.
    parts : tuple
        Of :class:`sweep.model.modulation.Stretch`.
    allowed
        As of :func:`relative_error`.
    kernel, room
        As of :func:`sweep.model.segments.segment_spectrum`.

    Returns
    -------
    number : int
        Sources; n lines as they were where they are better taken one by one, and 0 where they have
        parts and are too many or too wide apart.
    kind : tuple
        Row of the known kernels, -1 for lines; number of bundles, bin of the first, bins from one
        to the next; moments of each; whether they are forms; sum of the sources' magnitudes, for
        powers squared, and the range that they lie in.
    """
    segment, own, fold = whose
    lowest, highest = extent(room[DELTA], n)
    level, number, first, spacing = side_by_side(lowest, highest, power)
    relative = relative_error(n, power, allowed, kernel, room)
    if own < 0 and _better_alone(n, highest - lowest, level, number, power, relative, kernel):
        return n, as_lines()
    if own >= 0 and parts[3][segment, own] > MOST_PARTS:
        return 0, as_lines()
    slot, row = slot_for(segment, own, fold, (level, number == 1), power, parts, kernel)
    half = slot[HALF] + slot[ASIDE]
    band = math.pi * (2.0 if power else 1.0) * HALVES[level]
    size = nodes_for(band, relative, kernel[3])
    sources, form = sources_of(power, slot, kernel), power and own >= 0
    room_for_one = max(sources.size, size + 1, FORM_WIDTH if form else 0)
    if size > MOST_MOMENTS or number * room_for_one + COLUMNS > room.shape[1]:
        return 0 if own >= 0 else n, as_lines()
    take_moments(n, power, HALVES[level], number, first, spacing, size, room)
    total = 0.0
    for k in range(number):
        one, other = moments_of(k, size, room)
        total += total_strength(one, other, size, power, slot, room[4:6])
        if not form:
            _strengths(one, other, size, power, slot, k * sources.size, room)
        for i in range(sources.size):
            room[DELTA, k * sources.size + i] = first + k * spacing + sources[i]
    spread = total, first - half, first + (number - 1) * spacing + half
    return number * sources.size, (row, number, first, spacing, size, form, spread)


@borrowing(fastmath={"nnan", "nsz"})
def extent(delta, n):
    """Lowest and highest of n positions; whole vectors at a time, which changes no bit of it."""
    lowest, highest = delta[0], delta[0]
    for b in range(n):
        lowest = delta[b] if delta[b] < lowest else lowest
        highest = delta[b] if delta[b] > highest else highest
    return lowest, highest


@borrowing()
def side_by_side(lowest, highest, power):
    """Level of bundles, their number, the bin of the first, bins from one to the next."""
    level = level_for(max(highest, -lowest))
    if 0 <= level <= WIDEST[1 if power else 0]:
        return level, 1, 0, 1
    level = SIDE_BY_SIDE[1 if power else 0]
    spacing = math.floor(2.0 * HALVES[level])
    first = math.floor(lowest / spacing + 0.5)
    last = math.floor(highest / spacing + 0.5)
    return level, last - first + 1, first * spacing, spacing


@borrowing()
def weight(n, power, room):
    """What errors of n lines come to, over that of a line of weight 1.

    Of powers at most the root of n times their squares, some 1.3 times the sum of a beam's profile.
    Amplitudes add as their phases have it: three times the root of their squares is exceeded by one
    random sum of 10^4, and lines in phase stay within a tenth of their sum, or three times as much
    for few.
    """
    re, im = room[STRENGTH_RE], room[STRENGTH_IM]
    squares = dot(re, re, n)
    if not power:
        squares += dot(im, im, n)
    in_phase = math.sqrt(n)
    if squares > 1e-250:
        return math.sqrt(squares) * (in_phase if power else together(in_phase))
    total = 0.0  # too small to be squared
    for b in range(n):
        total += abs(re[b]) + (0.0 if power else abs(im[b]))
    return total


@borrowing()
def relative_error(n, power, allowed, kernel, room):
    """Error that few lines for n may make, over what :func:`weight` says of all on the peak.

    Parameters
    ----------
    allowed : (float, float)
        Error of a bin; threshold. Powers of bins at the threshold, or of half the largest there
        can be where that is less, are as far off as makes this much of the bin: those of larger
        bins may be further off, and in smaller ones nothing is decided.
    """
    error, level = allowed
    if not power:
        return error / max(kernel[2][0] * weight(n, power, room), 1e-300)
    whole = max(kernel[2][0] * kernel[2][0] * weight(n, power, room), 1e-300)
    return error * min(level, 0.5 * math.sqrt(whole)) / whole


@borrowing()
def together(in_phase):
    """Root of n, by which n amplitudes in phase exceed the root of their squares, as it counts."""
    return min(in_phase, max(3.0, 0.1 * in_phase))


@borrowing()
def _better_alone(n, spread, level, number, power, relative, kernel):
    """Whether whole lines are few, close together, or farther apart than moments are worth."""
    band = math.pi * (2.0 if power else 1.0)
    if min(n, nodes_for(band * 0.5 * spread, relative, kernel[3])) < LEAST_KNOWN:
        return True
    return number * nodes_for(band * HALVES[level], relative, kernel[3]) > 3 * n


@borrowing()
def moments_of(k, size, room):
    """Real and imaginary moments of the k-th bundle."""
    stride = size + (size & 1)
    return room[MOMENTS, k * stride : (k + 1) * stride], room[
        MOMENTS + 1, k * stride : (k + 1) * stride
    ]


@borrowing()
def take_moments(n, power, half, number, first, spacing, size, room):
    """Moments of n lines, sorted into bundles."""
    delta, re, im, x = room[DELTA], room[STRENGTH_RE], room[STRENGTH_IM], room[4]
    even, odd = room[5], room[6]
    if number == 1:
        for b in range(n):
            x[b] = (delta[b] - first) / half
        one, other = moments_of(0, size, room)
        chebyshev_moments(x, re, im, n, size, power, even, odd, one, other)
        return
    end, sorted_re, sorted_im = room[7], room[8], room[9]
    end[: number + 1] = 0.0
    for b in range(n):
        k = math.floor((delta[b] - first) / spacing + 0.5)
        end[min(max(k, 0), number - 1) + 1] += 1.0
    for k in range(number):
        end[k + 1] += end[k]
    for b in range(n):
        k = min(max(math.floor((delta[b] - first) / spacing + 0.5), 0), number - 1)
        at = int(end[k])
        end[k] += 1.0  # which leaves what is one past the bundle's last line
        middle = first + k * spacing
        sign = -1.0 if middle & 1 and not power else 1.0  # of sin(pi nu), counted from there
        x[at] = (delta[b] - middle) / half
        sorted_re[at], sorted_im[at] = sign * re[b], sign * im[b]
    start = 0
    for k in range(number):
        one, other = moments_of(k, size, room)
        stop = int(end[k])
        chebyshev_moments(
            x[start:stop], sorted_re[start:stop], sorted_im[start:stop], stop - start, size, power,
            even, odd, one, other,
        )  # fmt: skip
        start = stop


@borrowing()
def _strengths(one, other, size, power, slot, start, room):
    """Strengths of a bundle's sources, from ``start`` on in rows STRENGTH_RE and STRENGTH_IM."""
    re, im = room[STRENGTH_RE, start:], room[STRENGTH_IM, start:]
    im[:COLUMNS] = 0.0
    _sum_moments(one, other, size, power, slot, strengths_afar(power, slot), re, im, room[5])


@borrowing()
def _sum_moments(one, other, size, power, slot, where, re, im, work):
    """Moments times rows of a slot, COLUMNS numbers: real and imaginary, of powers real alone.

    ``where`` is as :func:`sweep.model.known_kernels.kernels_beside` returns it.
    """
    at, imaginary, stride = where
    combine(one, slot, size, at, stride, re)
    if power:
        return
    combine(other, slot, size, at, stride, im)
    if is_real(power, slot):
        return
    combine(other, slot, size, imaginary, stride, work)
    for i in range(COLUMNS):
        re[i] -= work[i]
    combine(one, slot, size, imaginary, stride, work)
    for i in range(COLUMNS):
        im[i] += work[i]


@borrowing()
def add_near(first, image, kind, power, kernel, room, re, im):
    """Adds what bundles, or their images, hold in bins first, first + 1 .. next to them.

    ``first`` counts from where the lines do; of images, from where that is mirrored to.
    """
    row, number, middle, spacing, size, _, _ = kind
    slot, side = kernel[5][row], -1 if image else 1
    for start in range(0, re.size, COLUMNS):
        count = min(COLUMNS, re.size - start)
        for k in range(number):
            one, other = moments_of(k, size, room)
            bin_ = first + start - side * (middle + k * spacing)
            if image:
                bin_ = -(bin_ + COLUMNS - 1)
            where = kernels_beside(bin_, power, slot, kernel)
            _sum_moments(one, other, size, power, slot, where, room[5], room[6], room[8])
            add(re[start : start + count], room[5], image, 1.0 if power else -1.0)
            if not power:
                add(im[start : start + count], room[6], image, 1.0 if image else -1.0)


@borrowing()
def add(out, values, mirrored, sign):
    """Adds values, or the same from the other end of COLUMNS on."""
    if mirrored:
        for i in range(out.size):
            out[i] += sign * values[COLUMNS - 1 - i]
    else:
        for i in range(out.size):
            out[i] += sign * values[i]


@borrowing()
def forms_afar(kind, sources, kernel, room):
    """Forms of bundles into row FORM, or without ``sources`` their constants alone.

    Returns the sum of the constants: what the window's first sample adds to every bin.
    """
    row, number, _, _, size, _, _ = kind
    slot, total = kernel[5][row], 0.0
    each = int(slot[PLACES])
    for k in range(number):
        one, out = moments_of(k, size, room)[0], room[FORM, k * FORM_WIDTH :]
        last = form_of(one, size, each, sources, slot, out)
        total += out[last]
    return total


@borrowing()
def add_forms_afar(t, tangents, n, kind, numerator, poles, side, room, out):
    """Adds the forms of n sources at points where t is tan(pi q / N), but for their constants.

    ``tangents`` are those of the sources' places; ``side`` is -1 for images.
    """
    number = kind[1]
    each = n // number
    rows, inner, sums = room[FORM + 1], room[5], room[6]
    if each == 0:
        return
    for k in range(number):
        form = room[FORM, k * FORM_WIDTH : (k + 1) * FORM_WIDTH]
        for start in range(0, t.size, COLUMNS):
            at = t[start : start + COLUMNS]
            for j in range(each):
                row, tangent = rows[j * COLUMNS : j * COLUMNS + at.size], tangents[k * each + j]
                for i in range(at.size):
                    row[i] = fraction(at[i], tangent, numerator, poles)
            _values(form, rows, each, side, inner, sums)
            for i in range(at.size):
                out[start + i] += sums[i]


@borrowing()
def _values(form, rows, size, side, inner, out):
    """sum_i K_i (sum_j<=i F_ij K_j + side F_i) of rows of kernels, COLUMNS elements each."""
    linear = size * (size + 1) // 2
    out[:COLUMNS] = 0.0
    for i in range(size):
        combine(form[i * (i + 1) // 2 :], rows, i + 1, 0, COLUMNS, inner)
        own, constant = rows[i * COLUMNS : (i + 1) * COLUMNS], side * form[linear + i]
        for k in range(COLUMNS):
            out[k] = fma(inner[k] + constant, own[k], out[k])
