"""Spectrum of a segment's lines at the bins that matter, without the record or its FFT.

With C_b the lines, nu_b their places and G their shape (:mod:`sweep.model.line_shape`),

    F(k) = sum_b C_b G(k - nu_b),    X[k] = F(k) + conj F(-k)

for a real record, whose second term are the images; a complex record shows F alone (PHYSICS
section 5). The factor e^{-i pi r k} that all terms share is dropped. Lines that add as powers have
|C_b|^2 |G|^2 instead.

Bins near the lines take each from the table of G; bins far from all of them take few sources that
stand for the lines, by what the ends of the record make of them. Only a run of bins is looked at:
all that lines can lift to a level, and what it takes to be sure of the largest.
"""

import math

import numpy as np

from sweep.kernel_cache import njit
from sweep.model.detection import mark
from sweep.model.elementary import sincos_cycles
from sweep.model.line_shape import CELLS, KERNEL_BASIS, KERNEL_DEGREE, POINTS, SPARE_CELLS
from sweep.model.lines import IM, PLACE, RE, X, put_on_nodes

CELL_RE, CELL_IM, A_RE, A_IM, B_RE, B_IM = np.arange(7, 13)
"""Rows of scratch: cells; strengths of lines as the record's two ends see them."""

S_PLACE, S_A_RE, S_A_IM, S_B_RE, S_B_IM = np.arange(13, 18)
"""The same of sources, and their places."""

LINES, SOURCES = (PLACE, A_RE), (S_PLACE, S_A_RE)
"""Rows of places and first rows of strengths."""

F_RE, F_IM, OUT, OUT_IM = np.arange(18, 22)
"""F in a run of bins that rise; |X| of the run."""

TAN, TURN_RE, TURN_IM, COT, P_RE, P_IM, Q_RE, Q_IM = np.arange(22, 30)
"""Of bins far away: tan(pi k / N), exp(i pi r k), and scratch."""

SUM, HALF_SQUARE, CHANCE, POINT, WEIGHT, AFAR = np.arange(30, 36)
"""Of averages; of leakage."""

ROOM = 36
"""Rows in all."""

ZERO = np.int64(0)
"""0 as an argument, of NumPy for the same reason as the rows."""

STRIP = 128
"""Bins far away that are done together."""

FOLDED, IMAGED, COMPLEX = range(3)
"""Views of a spectrum: bins 0 .. N/2 of a real record, without images and with them; all N bins
of a complex record, numbered on past 0 and N."""

SOURCE_DIGITS = 28.0
"""-ln of the error of sources, and a little for the poles of a window on either side."""

FINER = 11.0
"""Digits, as of e, by which polynomials of the record's ends are told more closely."""

WINDOW = 8
"""Bins within which lines are shared out together; these share the bins that tables hold."""

EDGE = POINTS // 2 // CELLS[0] + 1
"""Bins beside a window in which its lines have cells."""

MOST_CELLS = WINDOW * CELLS[1] + POINTS + SPARE_CELLS

BESIDE = WINDOW + EDGE + 1
"""Bins by which tables may hold less about a line than on either side of a cell."""


@njit(cache=True, error_model="numpy", borrows=True)
def add_near(first, count, lines, table, sizes, room):
    """Add n lines to F in bins ``first`` .. where their shape's table holds these.

    Each line is shared out among cells; each of these has a row of the table.
    """
    n, lowest, highest, _ = lines
    cells, last = sizes[3], math.floor(highest)
    for start in range(math.floor(lowest), last + 1, WINDOW):
        near = sizes[2] + WINDOW
        least = -((near + start - first) // sizes[0])
        most = (first + count - start + near) // sizes[0]
        if least > most:  # tables hold nothing of these lines there
            continue
        number = min(WINDOW, last + 1 - start) * cells + POINTS
        for c in range(number + SPARE_CELLS):
            room[CELL_RE, c], room[CELL_IM, c] = 0.0, 0.0
        for b in range(n):
            if start <= room[PLACE, b] < start + WINDOW:
                place = (room[PLACE, b] - start) * cells
                _share_out(place, room[RE, b], room[IM, b], room)
        for lap in range(least, most + 1):
            _add_cells(first, count, (start, number, lap), table, sizes, room)


@njit(cache=True, error_model="numpy", borrows=True)
def _share_out(place, re, im, room):
    """Share a line at a place among cells out among POINTS of them."""
    cell = np.uint64(math.floor(place))
    part = 2.0 * (place - math.floor(place)) - 1.0
    for j in range(np.uint64(POINTS + SPARE_CELLS)):
        weight = KERNEL_BASIS[KERNEL_DEGREE, j]
        for d in range(KERNEL_DEGREE):
            weight = weight * part + KERNEL_BASIS[KERNEL_DEGREE - 1 - d, j]
        room[CELL_RE, cell + j] += re * weight
        room[CELL_IM, cell + j] += im * weight


@njit(cache=True, error_model="numpy", borrows=True)
def held_of(start, lap, sizes):
    """First bin, and one past the last, that tables hold of all lines of a window."""
    beside, start = sizes[2], start + lap * sizes[0]
    return start + WINDOW + EDGE - beside, start - EDGE + beside


@njit(cache=True, error_model="numpy", borrows=True)
def _add_cells(first, count, window, table, sizes, room):
    """Add a window's cells, which begin six before it, to F; arguments as of :func:`add_near`."""
    start, number, lap = window
    cells, power = sizes[3], sizes[4]
    columns = table.shape[1] // cells
    turned = -1.0 if lap & 1 and sizes[1] & 1 and not power else 1.0
    low, high = held_of(start, lap, sizes)
    low, high = max(first, low), min(first + count, high)
    begin = start + lap * sizes[0] - sizes[2]
    if not sizes[5] and low >= high:
        return
    for c in range(number):
        re, im = turned * room[CELL_RE, c], turned * room[CELL_IM, c]
        at = c + 1 - POINTS // 2
        bin_, row = begin + at // cells, at % cells
        if sizes[5]:
            low, high = max(first, bin_), min(first + count, bin_ + columns)
        if low >= high or (re == 0.0 and im == 0.0):
            continue
        # unsigned, for else each index is looked at whether it counts from an array's end
        at, to = np.uint64(row * columns + low - bin_), np.uint64(low - first)
        if power:
            for i in range(np.uint64(high - low)):
                room[F_RE, to + i] += re * table[0, at + i]
        else:
            for i in range(np.uint64(high - low)):
                g, h = table[0, at + i], table[1, at + i]
                room[F_RE, to + i] += re * g - im * h
                room[F_IM, to + i] += re * h + im * g


@njit(cache=True, error_model="numpy", borrows=True)
def take_sources(n, lowest, highest, distance, digits, sizes, room):
    """Strengths of n lines as the record's ends see them, and sources that stand for them.

    Sources serve bins from some ``distance`` on, to e^-digits. Returns their number.
    """
    power, half_ratio = sizes[4] != 0, 0.5 * sizes[1] / sizes[0]
    for b in range(n):
        sine, cosine = sincos_cycles((2.0 if power else 1.0) * half_ratio * room[PLACE, b])
        re, im = room[RE, b], room[IM, b]
        room[A_RE, b] = re if power else re * cosine + im * sine
        room[A_IM, b] = 0.0 if power else im * cosine - re * sine
        room[B_RE, b] = re * cosine if power else re * cosine - im * sine
        room[B_IM, b] = -re * sine if power else im * cosine + re * sine
    middle, half = 0.5 * (lowest + highest), 0.5 * (highest - lowest)
    number = n
    if half > 0.0:
        z = 1.0 + distance / half
        number = 1 + int(digits / math.log(z + math.sqrt(z * z - 1.0)))
    elif n > 1:
        number = 1
    put_on_nodes(room, A_RE, A_IM, n, number, (middle, half), S_A_RE, S_A_IM)
    number = put_on_nodes(room, B_RE, B_IM, n, number, (middle, half), S_B_RE, S_B_IM)
    for j in range(number):
        room[S_PLACE, j] = room[X, j]
    return number


@njit(cache=True, error_model="numpy", borrows=True)
def weight_afar(total, sources, sizes, room):
    """Sum the weight of lines as bins beyond the table see them; for powers, take its root."""
    first, last = 0.0, 0.0
    for b in range(sources):
        first += math.hypot(room[S_A_RE, b], room[S_A_IM, b])
        last += math.hypot(room[S_B_RE, b], room[S_B_IM, b])
    first = max(first, last)
    return min(total, math.sqrt(first) if sizes[4] else first)


@njit(cache=True, error_model="numpy", borrows=True)
def tangent_of(k, fft_size, tangent):
    """tan(pi k / N) for any whole k; ``tangent`` holds those of 0 .. N/2."""
    k %= fft_size
    return tangent[k] if 2 * k <= fft_size else -tangent[fft_size - k]


@njit(cache=True, error_model="numpy", borrows=True)
def prepare_far(first, count, sizes, tangent, room):
    """Tangents and turns of bins ``first`` .., count <= STRIP, into rows TAN and TURN."""
    fft_size = sizes[0]
    k = first % fft_size
    for i in range(count):
        room[TAN, i] = tangent[k] if 2 * k <= fft_size else -tangent[fft_size - k]
        k = k + 1 if k + 1 < fft_size else 0
    if fft_size == sizes[1]:
        for i in range(count):
            room[TURN_RE, i], room[TURN_IM, i] = -1.0 if (first + i) & 1 else 1.0, 0.0
        return
    for i in range(count):
        turn = sincos_cycles(0.5 * (first + i) * sizes[1] / fft_size)
        room[TURN_RE, i], room[TURN_IM, i] = turn[1], turn[0]


@njit(cache=True, error_model="numpy", borrows=True)
def add_far(start, end, at, rows, b, digits, form, sizes, room):
    """Add line or source b to F, from ``at`` on, in prepared bins start .. end - 1, to e^-digits.

    ``rows`` are those of places and strengths: LINES or SOURCES.
    """
    power = sizes[4] != 0
    strength, cut = rows[1], math.exp(-digits)
    a_re, a_im = room[strength, b], room[strength + 1, b]
    b_re, b_im = room[strength + 2, b], room[strength + 3, b]
    t, nearest = math.tan(math.pi * room[rows[0], b] / sizes[0]), 0.0
    begin, stop, to = np.uint64(start), np.uint64(end), np.uint64(at - start)
    for i in range(begin, stop):
        room[COT, i] = (1.0 + room[TAN, i] * t) / (room[TAN, i] - t)
    for i in range(begin, stop):
        nearest = max(nearest, abs(room[COT, i]))
    degree, factor, most = 0, 1.0, 0.0
    for d in range(14):
        size = factor * (abs(form[3, d]) + abs(form[4, d]) + abs(form[5, d]) + abs(form[6, d]))
        most = max(most, size)
        degree = d if size > cut * most else degree
        factor *= nearest
    for i in range(begin, stop):
        room[P_RE, i], room[P_IM, i] = form[3, degree], form[4, degree]
        room[Q_RE, i], room[Q_IM, i] = form[5, degree], form[6, degree]
    for d in range(degree - 1, -1, -1):
        one, other, three, four = form[3, d], form[4, d], form[5, d], form[6, d]
        for i in range(begin, stop):
            c = room[COT, i]
            room[P_RE, i] = room[P_RE, i] * c + one
            room[P_IM, i] = room[P_IM, i] * c + other
            room[Q_RE, i] = room[Q_RE, i] * c + three
            room[Q_IM, i] = room[Q_IM, i] * c + four
    if power:
        for i in range(begin, stop):
            p, q, r, s = room[P_RE, i], room[P_IM, i], room[Q_RE, i], room[Q_IM, i]
            u, v = room[TURN_RE, i], room[TURN_IM, i]
            u, v = u * u - v * v, 2.0 * u * v
            u, v = u * b_re - v * b_im, u * b_im + v * b_re
            room[F_RE, to + i] += a_re * (p * p + q * q + r * r + s * s) - 2.0 * (
                u * (p * r + q * s) - v * (q * r - p * s)
            )
        return
    for i in range(begin, stop):
        u_re = a_re * room[P_RE, i] - a_im * room[P_IM, i]
        u_im = a_re * room[P_IM, i] + a_im * room[P_RE, i]
        v_re = b_re * room[Q_RE, i] - b_im * room[Q_IM, i]
        v_im = b_re * room[Q_IM, i] + b_im * room[Q_RE, i]
        c, s = room[TURN_RE, i], room[TURN_IM, i]
        room[F_RE, to + i] += c * (u_re - v_re) - s * (u_im + v_im)
        room[F_IM, to + i] += c * (u_im - v_im) + s * (u_re + v_re)


@njit(cache=True, error_model="numpy", borrows=True)
def field(first, count, lines, table, form, sizes, tangent, room):
    """F in bins ``first`` .., counted from the lines' origin, into rows F_RE and F_IM.

    ``lines``: their number, lowest and highest place, and what may be left out of the shape.
    """
    n, lowest, highest, faint = lines
    whole = sizes[5] != 0
    count = (count + 7) // 8 * 8  # whole vectors: a rest takes as long
    for i in range(count):
        room[F_RE, i], room[F_IM, i] = 0.0, 0.0
    add_near(first, count, lines, table, sizes, room)
    reach = sizes[2] - BESIDE  # of tables from any line
    if whole or (highest - first < reach and first + count - lowest < reach):
        return
    digits = SOURCE_DIGITS
    distance = max(gap_of(first, count, lowest, highest, sizes[0]), float(reach))
    if faint > 0.0:
        part = math.log(max(form[1, envelope_from(distance, form)] / faint, 1.0))
        digits = min(digits, 4.0 + (2.0 * part if sizes[4] else part))
    sources = take_sources(n, lowest, highest, distance, digits, sizes, room)
    # Bins of which tables hold some lines, if not all; but for these, sources do.
    begun = math.floor(lowest)
    last = begun + (math.floor(highest) - begun) // WINDOW * WINDOW
    at, end = first, first + count
    while at < end:
        stop, amid = min(at + STRIP, end), False
        for lap in range(-1, 2):
            low, _ = held_of(begun, lap, sizes)
            _, high = held_of(last, lap, sizes)
            amid |= low <= at < high
            stop = min(stop, low) if low > at else (min(stop, high) if high > at else stop)
        if not amid:
            prepare_far(at, stop - at, sizes, tangent, room)
            for b in range(sources):
                add_far(ZERO, stop - at, at - first, SOURCES, b, digits + FINER, form, sizes, room)
        elif last > begun:
            prepare_far(at, stop - at, sizes, tangent, room)
            for b in range(n):  # what the table does not hold of each line
                window = begun + int(room[PLACE, b] - begun) // WINDOW * WINDOW
                start = at
                for lap in range(-1, 3):
                    held, past = held_of(window, lap, sizes)
                    until = min(held, stop) if lap < 2 else stop
                    if start < until:
                        add_far(
                            start - at, until - at, start - first, LINES, b, digits + FINER, form,
                            sizes, room,
                        )  # fmt: skip
                    start = max(start, past)
        at = stop


@njit(cache=True, error_model="numpy", borrows=True)
def gap_of(first, count, lowest, highest, fft_size):
    """Least distance of some bins from lines, around the circle of all bins; 0 between them."""
    apart = first + 0.5 * (count - 1) - 0.5 * (lowest + highest)
    apart = abs(apart - fft_size * np.rint(apart / fft_size))
    return max(apart - 0.5 * (count - 1) - 0.5 * (highest - lowest), 0.0)


@njit(cache=True, error_model="numpy", borrows=True)
def envelope_from(distance, form):
    """Index of what is known of envelopes from a distance on."""
    low, high = 0, form.shape[1]
    while low < high:
        middle = (low + high) // 2
        if form[0, middle] <= distance:
            low = middle + 1
        else:
            high = middle
    return max(low - 1, 0)


@njit(cache=True, error_model="numpy", borrows=True)
def magnitudes(low, count, origin, lines, shifts, table, form, sizes, tangent, room):
    """|X| of bins ``low`` .. of what is seen, into row OUT; as of :func:`field`.

    ``shifts`` (2, m): places [bins] and weights over which |X|^2 is averaged; m may be 0.
    """
    power, view = sizes[4] != 0, sizes[7]
    n, lowest, highest, faint = lines
    sign = -1 if is_turned(origin, lowest, highest, view) else 1
    many = shifts.shape[1] > 0
    if many:
        room[SUM, :count] = 0.0
    for m in range(max(shifts.shape[1], 1)):
        apart = shifts[0, m] if many else 0.0
        if many:
            for b in range(n):
                room[PLACE, b] += apart
        for turn in range(2 if view == IMAGED else 1):  # the lines, then their images
            way = sign if turn == 0 else -sign
            first = low - origin if way > 0 else 1 - low - count - origin
            if turn == 1:
                gap = gap_of(first, count, lowest + apart, highest + apart, sizes[0])
                if form[1, envelope_from(gap, form)] <= faint:
                    continue
            moved = n, lowest + apart, highest + apart, faint
            field(first, count, moved, table, form, sizes, tangent, room)
            for i in range(count):
                j = i if way > 0 else count - 1 - i
                re, im = room[F_RE, j], way * room[F_IM, j]
                room[OUT, i] = re if turn == 0 else room[OUT, i] + re
                room[OUT_IM, i] = im if turn == 0 else room[OUT_IM, i] + im
        for i in range(count):
            re, im = room[OUT, i], room[OUT_IM, i]
            room[OUT, i] = re if power else re * re + im * im
        if many:
            for i in range(count):
                room[SUM, i] += shifts[1, m] * room[OUT, i]
            for b in range(n):
                room[PLACE, b] -= apart
    row = SUM if many else OUT
    for i in range(count):
        room[OUT, i] = math.sqrt(max(room[row, i], 0.0))


@njit(cache=True, error_model="numpy", borrows=True)
def reach_of(level, weight, form):
    """Bins beyond which lines of the given summed weight stay below ``level``."""
    if not weight > 0.0:
        return 1.0
    low, high = 0, form.shape[1] - 1
    if form[1, high] * weight > level:
        return np.inf
    while low < high:
        middle = (low + high) // 2
        if form[1, middle] * weight > level:
            low = middle + 1
        else:
            high = middle
    return form[0, low]


@njit(cache=True, error_model="numpy", borrows=True)
def is_turned(origin, lowest, highest, view):
    """Return true where lines appear at the bins of their negative frequencies."""
    return origin + 0.5 * (lowest + highest) < 0.0 and view != COMPLEX


@njit(cache=True, error_model="numpy", borrows=True)
def seen(origin, lowest, highest, sizes):
    """Lowest and highest place at which lines are seen, in bins; 0 .. N/2 where they fold."""
    if is_turned(origin, lowest, highest, sizes[7]):
        return -origin - highest, -origin - lowest
    return origin + lowest, origin + highest


@njit(cache=True, error_model="numpy", borrows=True)
def run_of(beyond, place, sizes):
    """First and last bin ``beyond`` the places of lines, folded back at DC and Nyquist."""
    half = sizes[0] // 2
    beyond = min(beyond, 2.0 * sizes[0])
    low, high = math.floor(place[0] - beyond), math.ceil(place[1] + beyond)
    if sizes[7] == COMPLEX:
        if high - low >= sizes[0]:
            low = (low + high + 1 - sizes[0]) // 2
        return low, min(high, low + sizes[0] - 1)
    if low < 0:
        high = max(high, -low)
    if high > half:
        low = min(low, sizes[0] - high)
    return min(max(low, 0), half), max(min(high, half), 0)


@njit(cache=True, error_model="numpy", borrows=True)
def stays_below(level, weight, place, form, sizes):
    """Bins beyond which lines and images of a summed weight stay below a level."""
    if sizes[7] == IMAGED:
        edge = min(place[0], 0.5 * sizes[0] - place[1])  # no bin is nearer to an image
        share = 0.5 if edge < reach_of(0.1 * level, weight, form) else 0.9
        return reach_of(share * level, weight, form) + 1.0
    return reach_of(level, weight, form) + 1.0


@njit(cache=True, error_model="numpy", borrows=True)
def detect(origin, lines, levels, shifts, table, form, sizes, tangent, room, exempt):
    """Run of bins around a segment's lines, and the detection in it.

    ``origin``: bin from which lines count. ``lines``: their number, lowest and highest place, their
    summed weight, and the most that an image may come to that is left out. ``levels``: threshold;
    level below which bins may be left out; if none is above it, bins that the largest is known to
    exceed are. ``exempt``: result, bins of the run that can't raise a false alarm.

    Returns first bin of the run, number of bins, index of the largest, number of exempt ones; |X|
    in row OUT.
    """
    n, lowest, highest, total, least = lines
    room_for = sizes[0] if sizes[7] == COMPLEX else sizes[0] // 2 + 1
    before, after = 0.0, 0.0
    for m in range(shifts.shape[1]):
        before, after = min(before, shifts[0, m]), max(after, shifts[0, m])
    place = seen(origin, lowest + before, highest + after, sizes)
    level, weight = levels[1], total
    beyond = stays_below(level, weight, place, form, sizes)
    if not level > 0.0:
        beyond = np.inf
    elif not sizes[5] and beyond > 2 * sizes[6] and n > 1 and shifts.shape[1] == 0:
        sources = take_sources(n, lowest, highest, float(sizes[6]), SOURCE_DIGITS, sizes, room)
        weight = weight_afar(total, sources, sizes, room)
        beyond = max(stays_below(level, weight, place, form, sizes), 2.0 * sizes[6])
    known = n, lowest, highest, least / max(total, 1e-300)
    beyond = max(beyond, 2.0 * sizes[8])  # main lobes beside bins of half the largest
    while True:
        low, high = run_of(beyond, place, sizes)
        count = high - low + 1
        magnitudes(low, count, origin, known, shifts, table, form, sizes, tangent, room)
        peak, exempted = mark(room[OUT], count, levels[0], exempt, sizes[8])
        most = room[OUT, peak]
        if most >= level or count >= room_for:
            return low, count, peak, exempted
        needed = stays_below(most, total, place, form, sizes)
        if needed <= beyond:
            return low, count, peak, exempted
        beyond = needed
