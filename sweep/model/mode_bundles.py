"""Powers of lines whose phase error is a shot's own, as bundles in modes.

What :mod:`sweep.model.bundles` is to lines with parts that many shots share. A bundle's moments say
how strong lines at few nodes are (:mod:`sweep.model.mode_kernels`), and a_k how modes add up at
each: bins next to the lines see the sum of the nodes' powers; bins far from them the same form of
sources as of shared parts.
"""

from sweep.model.bundles import (
    DELTA,
    FORM,
    STRENGTH_IM,
    STRENGTH_RE,
    add,
    as_lines,
    extent,
    moments_of,
    relative_error,
    side_by_side,
    take_moments,
)
from sweep.model.compiling import borrowing, owning
from sweep.model.effects.line_modes import CENTRE, EVENS, IM, MODES, NUMBER, RE
from sweep.model.kernel_rows import FORM_WIDTH, HALVES, MOST_MOMENTS, ROWS
from sweep.model.lanes import COLUMNS, LANES, combine, combine_both, dot
from sweep.model.mode_kernels import (
    ASIDE,
    BOUND,
    PLACES,
    SEEN,
    SIZE,
    SOURCES,
    SQUARES,
    SUMS,
    TO_NODES,
    columns_beside,
    modes_row,
    slot_of,
)

SHARE = STRENGTH_IM
"""Row of scratch for S at the nodes, real and imaginary, and a_k, once lines are in moments."""

_A = 2 * MOST_MOMENTS


@borrowing()
def take_modes(n, whose, modes, allowed, kernel, room):
    """Takes n lines in rows DELTA .. as bundles in modes; 0 where they spread too wide for that.

    Parameters
    ----------
    n : int
    whose : (int, int, float)
        Segment; place in ``modes``; -1 where the lines are seen as their images, else 1.
    modes : (3, u, >= NUMBERS) float64
        Of :func:`sweep.model.effects.line_modes.in_modes`.
    allowed
        As of :func:`sweep.model.bundles.relative_error`.
    kernel, room
        As of :func:`sweep.model.segments.segment_spectrum`.

    Returns
    -------
    number, kind
        As of :func:`sweep.model.bundles.take_bundles`; the row counts from ROWS on.
    """
    segment, own, fold = whose
    numbers = modes[segment, own]
    for b in range(n):
        room[DELTA, b] += fold * numbers[CENTRE]
    lowest, highest = extent(room[DELTA], n)
    level, number, first, spacing = side_by_side(lowest, highest, True)
    relative = relative_error(n, True, allowed, kernel, room)
    row = modes_row(level, number == 1, relative, kernel)
    slot = slot_of(row, kernel)
    size, places = int(slot[SIZE]), int(slot[PLACES])
    if size > MOST_MOMENTS or number * FORM_WIDTH + COLUMNS > room.shape[1]:
        return 0, as_lines()
    take_moments(n, True, HALVES[level], number, first, spacing, size, room)
    _take_shares(numbers, fold, size, slot, room)
    factor, summand = _bounds(slot, room)
    total = 0.0
    for k in range(number):
        strong = room[STRENGTH_RE, k * MOST_MOMENTS : (k + 1) * MOST_MOMENTS]
        moments = moments_of(k, size, room)[0]
        for j in range(0, size, COLUMNS):
            combine(moments, slot, size, TO_NODES + j, MOST_MOMENTS, strong[j:])
        total += factor * max(dot(strong, slot[SQUARES:], size), 0.0) + summand * moments[0]
        for i in range(places):
            room[DELTA, k * places + i] = first + k * spacing + slot[SOURCES + i]
    half = HALVES[level] + ASIDE
    spread = total, first - half, first + (number - 1) * spacing + half
    return number * places, (ROWS + row, number, first, spacing, size, True, spread)


@borrowing()
def _take_shares(numbers, fold, size, slot, room):
    """a_k, of odd modes times i, and S of each node, into row SHARE."""
    own = room[SHARE, _A:]
    own[0], own[1] = numbers[NUMBER], numbers[NUMBER + 1]
    re, im = own[COLUMNS:], own[2 * COLUMNS :]
    for k in range(MODES):
        a, b = numbers[RE + k], fold * numbers[IM + k]
        re[k], im[k] = (a, b) if k < EVENS else (-b, a)
    for j in range(0, size, COLUMNS):
        _mix(own, slot, SUMS + j, MOST_MOMENTS, room[SHARE, j:], room[SHARE, MOST_MOMENTS + j :],
             room[5])  # fmt: skip


@borrowing()
def _mix(own, slot, at, stride, re, im, work):
    """Sum over modes of a_k times rows of a slot, COLUMNS numbers."""
    evens, odds = int(own[0]), int(own[1])
    one, other = own[COLUMNS:], own[2 * COLUMNS :]
    combine_both((one, other), slot, evens, at, stride, (re, im))
    if odds:
        more, further = work, work[COLUMNS:]
        combine_both(
            (one[EVENS:], other[EVENS:]), slot, odds, at + EVENS * stride, stride, (more, further)
        )
        for i in range(COLUMNS):
            re[i] += more[i]
            im[i] += further[i]


@borrowing()
def modes_afar(kind, sources, kernel, room):
    """Forms of bundles in modes, or without ``sources`` their constants alone.

    Returns the sum of the constants, as of :func:`sweep.model.bundles.forms_afar`.
    """
    row, number, _, _, size, _, _ = kind
    slot, total, edge = slot_of(row - ROWS, kernel), 0.0, kernel[1][3]
    places, whole = int(slot[PLACES]), 0
    if sources:
        whole = _see_from_afar(size, places, slot, room)
    for k in range(number):
        strong = room[STRENGTH_RE, k * MOST_MOMENTS : (k + 1) * MOST_MOMENTS]
        if sources:
            _form(strong, size, places, whole, edge, room, room[FORM, k * FORM_WIDTH :])
        total += edge * edge * _constant(strong, size, room)
    return total


@borrowing()
def _constant(strong, size, room):
    """Sum over nodes of |S|^2."""
    sum_re, sum_im = room[SHARE], room[SHARE, MOST_MOMENTS:]
    total = 0.0
    for j in range(size):
        a, b = sum_re[j], sum_im[j]
        total += strong[j] * (a * a + b * b)
    return total


@owning()
def _see_from_afar(size, places, slot, room):
    """Amplitudes of the sources that each node is seen as, into the row of kernels.

    Of each source the real, then the imaginary ones, in whole vectors; how long each half is.
    """
    whole, own = (size + LANES - 1) // LANES * LANES, room[SHARE, _A:]
    for i in range(places):
        row = room[FORM + 1, 2 * i * whole :]
        for j in range(0, size, COLUMNS):
            at = SEEN + i * MODES * MOST_MOMENTS + j
            _mix(own, slot, at, MOST_MOMENTS, row[j:], room[8, j:], room[5])
        row[whole : 2 * whole] = room[8, :whole]
    return whole


@borrowing()
def _bounds(slot, room):
    """Bound on the power that a line's sidelobes show: a factor of sin^2(pi nu), and a summand.

    Of (a s + b)^2 <= a^2 s^2 (1 + b / a) + b^2 (1 + a / b), for real and imaginary amplitudes.
    """
    own = room[SHARE, _A:]
    factor, summand = 0.0, 0.0
    for half in (own[COLUMNS:], own[2 * COLUMNS :]):
        line, beside = abs(half[0]), 0.0
        for k in range(1, MODES):
            beside += abs(half[k]) * slot[BOUND + k]
        factor += line * (line + beside)
        summand += beside * (line + beside)
    return factor, summand


@borrowing()
def _form(strong, size, places, whole, edge, room, out):
    """The form of one bundle's sources, as :func:`sweep.model.bundles.add_forms_afar` has it.

    But for its constant.
    """
    rows, scaled, turned = room[FORM + 1], room[5], room[6]
    sum_re, sum_im = room[SHARE], room[SHARE, MOST_MOMENTS:]
    for j in range(size):
        a, b = sum_re[j], sum_im[j]
        turned[j], turned[whole + j] = -2.0 * edge * strong[j] * b, 2.0 * edge * strong[j] * a
    for j in range(size, whole):
        turned[j], turned[whole + j] = 0.0, 0.0
    linear, k = places * (places + 1) // 2, 0
    for i in range(places):
        row = rows[2 * i * whole : 2 * (i + 1) * whole]
        for j in range(whole):
            scaled[j] = 2.0 * strong[j] * row[j]
            scaled[whole + j] = 2.0 * strong[j] * row[whole + j]
        for other in range(i):
            out[k] = dot(scaled, rows[2 * other * whole : 2 * (other + 1) * whole], 2 * whole)
            k += 1
        out[k] = 0.5 * dot(scaled, row, 2 * whole)
        k += 1
        out[linear + i] = dot(turned, row, 2 * whole)


@borrowing()
def add_modes_near(first, image, kind, kernel, room, out):
    """Adds what bundles in modes, or their images, hold in bins next to them.

    As :func:`sweep.model.bundles.add_near`.
    """
    row, number, middle, spacing, size, _, _ = kind
    slot, side, edge = slot_of(row - ROWS, kernel), -1 if image else 1, kernel[1][3]
    sums, re, im = room[6], room[5], room[8]
    for start in range(0, out.size, COLUMNS):
        count = min(COLUMNS, out.size - start)
        for k in range(number):
            bin_ = first + start - side * (middle + k * spacing)
            if image:
                bin_ = -(bin_ + COLUMNS - 1)
            at, stride = columns_beside(bin_, slot, kernel)
            sums[:COLUMNS] = 0.0
            for j in range(size):
                _mix(room[SHARE, _A:], slot, at + j * MODES * stride, stride, re, im, room[7])
                strong = room[STRENGTH_RE, k * MOST_MOMENTS + j]
                c = 2.0 * edge * room[SHARE, j]
                d = 2.0 * edge * room[SHARE, MOST_MOMENTS + j]
                for i in range(COLUMNS):
                    sums[i] += strong * (re[i] * (re[i] - d) + im[i] * (im[i] + c))
            add(out[start : start + count], sums, image, 1.0)
