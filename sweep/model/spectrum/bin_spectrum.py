"""Spectrum of a segment's lines at the bins that matter, without the record or its FFT.

With C_b the lines, nu_b their places and G their shape (:mod:`sweep.model.spectrum.line_shape`),

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
from sweep.model.detection.echo_detection import mark_exempt_bins
from sweep.model.elementary_functions import sincos_cycles
from sweep.model.spectrum.line_shape import (
    CELLS_PER_BIN,
    KERNEL_BASIS,
    KERNEL_CELLS,
    KERNEL_DEGREE,
    ZERO_WEIGHT_CELLS,
)
from sweep.model.spectrum.lines import IM, PLACE, RE, X, replace_lines_by_nodes

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

N_SCRATCH_ROWS = 36
"""Rows in all."""

ZERO = np.int64(0)
"""0 as an argument, of NumPy for the same reason as the rows."""

FAR_BINS_PER_BATCH = 128
"""Bins far away that are done together."""

REAL_WITHOUT_IMAGES, REAL_WITH_IMAGES, COMPLEX_RECORD = range(3)
"""Views of a spectrum: bins 0 .. N/2 of a real record, without images and with them; all N bins
of a complex record, numbered on past 0 and N."""

SOURCE_LOG_ACCURACY = 28.0
"""-ln of the error of sources, and a little for the poles of a window on either side."""

END_POLYNOMIAL_EXTRA_LOG_ACCURACY = 11.0
"""Digits, as of e, by which polynomials of the record's ends are told more closely."""

LINE_BATCH_BINS = 8
"""Bins within which lines are shared out together; these share the bins that tables hold."""

LINE_BATCH_EDGE_BINS = KERNEL_CELLS // 2 // CELLS_PER_BIN[0] + 1
"""Bins beside a window in which its lines have cells."""

LINE_BATCH_CELLS_MAX = LINE_BATCH_BINS * CELLS_PER_BIN[1] + KERNEL_CELLS + ZERO_WEIGHT_CELLS

TABLE_SHORTFALL_BINS = LINE_BATCH_BINS + LINE_BATCH_EDGE_BINS + 1
"""Bins by which tables may hold less about a line than on either side of a cell."""


@njit(cache=True, error_model="numpy", borrows=True)
def add_lines_by_table(first_bin, n_bins, lines, table, layout, scratch):
    """Add n lines to F in bins ``first_bin`` .. where their shape's table holds these.

    Each line is shared out among cells; each of these has a row of the table.
    """
    n_lines, lowest_position, highest_position, _ = lines
    cells_per_bin, last_line_bin = layout[3], math.floor(highest_position)
    for batch_bin in range(math.floor(lowest_position), last_line_bin + 1, LINE_BATCH_BINS):
        table_reach = layout[2] + LINE_BATCH_BINS
        lap_min = -((table_reach + batch_bin - first_bin) // layout[0])
        lap_max = (first_bin + n_bins - batch_bin + table_reach) // layout[0]
        if lap_min > lap_max:  # tables hold nothing of these lines there
            continue
        n_cells = min(LINE_BATCH_BINS, last_line_bin + 1 - batch_bin) * cells_per_bin + KERNEL_CELLS
        for c in range(n_cells + ZERO_WEIGHT_CELLS):
            scratch[CELL_RE, c], scratch[CELL_IM, c] = 0.0, 0.0
        for line in range(n_lines):
            if batch_bin <= scratch[PLACE, line] < batch_bin + LINE_BATCH_BINS:
                cell_position = (scratch[PLACE, line] - batch_bin) * cells_per_bin
                _spread_line(cell_position, scratch[RE, line], scratch[IM, line], scratch)
        for lap in range(lap_min, lap_max + 1):
            _add_cells(first_bin, n_bins, (batch_bin, n_cells, lap), table, layout, scratch)


@njit(cache=True, error_model="numpy", borrows=True)
def _spread_line(cell_position, re, im, scratch):
    """Share a line at a place among cells out among POINTS of them."""
    cell = np.uint64(math.floor(cell_position))
    cell_coordinate = 2.0 * (cell_position - math.floor(cell_position)) - 1.0
    for j in range(np.uint64(KERNEL_CELLS + ZERO_WEIGHT_CELLS)):
        weight = KERNEL_BASIS[KERNEL_DEGREE, j]
        for d in range(KERNEL_DEGREE):
            weight = weight * cell_coordinate + KERNEL_BASIS[KERNEL_DEGREE - 1 - d, j]
        scratch[CELL_RE, cell + j] += re * weight
        scratch[CELL_IM, cell + j] += im * weight


@njit(cache=True, error_model="numpy", borrows=True)
def bins_in_table(batch_bin, lap, layout):
    """First bin, and one past the last, that tables hold of all lines of a window."""
    table_bins, batch_bin = layout[2], batch_bin + lap * layout[0]
    return (
        batch_bin + LINE_BATCH_BINS + LINE_BATCH_EDGE_BINS - table_bins,
        batch_bin - LINE_BATCH_EDGE_BINS + table_bins,
    )


@njit(cache=True, error_model="numpy", borrows=True)
def _add_cells(first_bin, n_bins, batch, table, layout, scratch):
    """Add a window's cells, which begin six before it, to F."""
    batch_bin, n_cells, lap = batch
    cells_per_bin, adds_powers = layout[3], layout[4]
    n_columns = table.shape[1] // cells_per_bin
    sign = -1.0 if lap & 1 and layout[1] & 1 and not adds_powers else 1.0
    low, high = bins_in_table(batch_bin, lap, layout)
    low, high = max(first_bin, low), min(first_bin + n_bins, high)
    begin_bin = batch_bin + lap * layout[0] - layout[2]
    if not layout[5] and low >= high:
        return
    for c in range(n_cells):
        re, im = sign * scratch[CELL_RE, c], sign * scratch[CELL_IM, c]
        cell_index = c + 1 - KERNEL_CELLS // 2
        bin_, row = begin_bin + cell_index // cells_per_bin, cell_index % cells_per_bin
        if layout[5]:
            low, high = max(first_bin, bin_), min(first_bin + n_bins, bin_ + n_columns)
        if low >= high or (re == 0.0 and im == 0.0):
            continue
        # unsigned, for else each index is looked at whether it counts from an array's end
        cell_index, field_index = (
            np.uint64(row * n_columns + low - bin_),
            np.uint64(low - first_bin),
        )
        if adds_powers:
            for i in range(np.uint64(high - low)):
                scratch[F_RE, field_index + i] += re * table[0, cell_index + i]
        else:
            for i in range(np.uint64(high - low)):
                g, h = table[0, cell_index + i], table[1, cell_index + i]
                scratch[F_RE, field_index + i] += re * g - im * h
                scratch[F_IM, field_index + i] += re * h + im * g


@njit(cache=True, error_model="numpy", borrows=True)
def compute_sources(
    n_lines, lowest_position, highest_position, distance_min, log_accuracy, layout, scratch
):
    """Strengths of n lines as the record's ends see them, and sources that stand for them.

    Sources serve bins from some ``distance_min`` on, to e^-digits. Returns their number.
    """
    adds_powers, half_record_ratio = layout[4] != 0, 0.5 * layout[1] / layout[0]
    for line in range(n_lines):
        sine, cosine = sincos_cycles(
            (2.0 if adds_powers else 1.0) * half_record_ratio * scratch[PLACE, line]
        )
        re, im = scratch[RE, line], scratch[IM, line]
        scratch[A_RE, line] = re if adds_powers else re * cosine + im * sine
        scratch[A_IM, line] = 0.0 if adds_powers else im * cosine - re * sine
        scratch[B_RE, line] = re * cosine if adds_powers else re * cosine - im * sine
        scratch[B_IM, line] = -re * sine if adds_powers else im * cosine + re * sine
    middle, half_width = (
        0.5 * (lowest_position + highest_position),
        0.5 * (highest_position - lowest_position),
    )
    n_sources = n_lines
    if half_width > 0.0:
        z = 1.0 + distance_min / half_width
        n_sources = 1 + int(log_accuracy / math.log(z + math.sqrt(z * z - 1.0)))
    elif n_lines > 1:
        n_sources = 1
    replace_lines_by_nodes(
        scratch, A_RE, A_IM, n_lines, n_sources, (middle, half_width), S_A_RE, S_A_IM
    )
    n_sources = replace_lines_by_nodes(
        scratch, B_RE, B_IM, n_lines, n_sources, (middle, half_width), S_B_RE, S_B_IM
    )
    for j in range(n_sources):
        scratch[S_PLACE, j] = scratch[X, j]
    return n_sources


@njit(cache=True, error_model="numpy", borrows=True)
def far_line_weight(weight_sum, n_sources, layout, scratch):
    """Sum the weight of lines as bins beyond the table see them; for powers, take its root."""
    start_sum, end_sum = 0.0, 0.0
    for source in range(n_sources):
        start_sum += math.hypot(scratch[S_A_RE, source], scratch[S_A_IM, source])
        end_sum += math.hypot(scratch[S_B_RE, source], scratch[S_B_IM, source])
    start_sum = max(start_sum, end_sum)
    return min(weight_sum, math.sqrt(start_sum) if layout[4] else start_sum)


@njit(cache=True, error_model="numpy", borrows=True)
def tangent_at(bin_, fft_size, tangents):
    """tan(pi k / N) for any whole k; ``tangents`` holds those of 0 .. N/2."""
    bin_ %= fft_size
    return tangents[bin_] if 2 * bin_ <= fft_size else -tangents[fft_size - bin_]


@njit(cache=True, error_model="numpy", borrows=True)
def prepare_far_bins(first_bin, n_bins, layout, tangents, scratch):
    """Tangents and turns of bins ``first_bin`` .., count <= STRIP, into rows TAN and TURN."""
    fft_size = layout[0]
    k = first_bin % fft_size
    for i in range(n_bins):
        scratch[TAN, i] = tangents[k] if 2 * k <= fft_size else -tangents[fft_size - k]
        k = k + 1 if k + 1 < fft_size else 0
    if fft_size == layout[1]:
        for i in range(n_bins):
            scratch[TURN_RE, i], scratch[TURN_IM, i] = -1.0 if (first_bin + i) & 1 else 1.0, 0.0
        return
    for i in range(n_bins):
        sine_and_cosine = sincos_cycles(0.5 * (first_bin + i) * layout[1] / fft_size)
        scratch[TURN_RE, i], scratch[TURN_IM, i] = sine_and_cosine[1], sine_and_cosine[0]


@njit(cache=True, error_model="numpy", borrows=True)
def add_line_by_record_ends(
    begin_offset, end_offset, field_offset, rows, line, log_accuracy, outline, layout, scratch
):
    """Add line or source b to F in prepared bins start .. end - 1, to e^-digits.

    ``rows`` are those of places and strengths: LINES or SOURCES.
    """
    adds_powers = layout[4] != 0
    strength_row, relative_cut = rows[1], math.exp(-log_accuracy)
    a_re, a_im = scratch[strength_row, line], scratch[strength_row + 1, line]
    b_re, b_im = scratch[strength_row + 2, line], scratch[strength_row + 3, line]
    line_tangent, cotangent_max = math.tan(math.pi * scratch[rows[0], line] / layout[0]), 0.0
    begin, stop, shift = (
        np.uint64(begin_offset),
        np.uint64(end_offset),
        np.uint64(field_offset - begin_offset),
    )
    for i in range(begin, stop):
        scratch[COT, i] = (1.0 + scratch[TAN, i] * line_tangent) / (scratch[TAN, i] - line_tangent)
    for i in range(begin, stop):
        cotangent_max = max(cotangent_max, abs(scratch[COT, i]))
    degree, factor, term_max = 0, 1.0, 0.0
    for d in range(14):
        term = factor * (
            abs(outline[3, d]) + abs(outline[4, d]) + abs(outline[5, d]) + abs(outline[6, d])
        )
        term_max = max(term_max, term)
        degree = d if term > relative_cut * term_max else degree
        factor *= cotangent_max
    for i in range(begin, stop):
        scratch[P_RE, i], scratch[P_IM, i] = outline[3, degree], outline[4, degree]
        scratch[Q_RE, i], scratch[Q_IM, i] = outline[5, degree], outline[6, degree]
    for d in range(degree - 1, -1, -1):
        p_re, p_im, q_re, q_im = outline[3, d], outline[4, d], outline[5, d], outline[6, d]
        for i in range(begin, stop):
            c = scratch[COT, i]
            scratch[P_RE, i] = scratch[P_RE, i] * c + p_re
            scratch[P_IM, i] = scratch[P_IM, i] * c + p_im
            scratch[Q_RE, i] = scratch[Q_RE, i] * c + q_re
            scratch[Q_IM, i] = scratch[Q_IM, i] * c + q_im
    if adds_powers:
        for i in range(begin, stop):
            p, q, r, s = scratch[P_RE, i], scratch[P_IM, i], scratch[Q_RE, i], scratch[Q_IM, i]
            u, v = scratch[TURN_RE, i], scratch[TURN_IM, i]
            u, v = u * u - v * v, 2.0 * u * v
            u, v = u * b_re - v * b_im, u * b_im + v * b_re
            scratch[F_RE, shift + i] += a_re * (p * p + q * q + r * r + s * s) - 2.0 * (
                u * (p * r + q * s) - v * (q * r - p * s)
            )
        return
    for i in range(begin, stop):
        u_re = a_re * scratch[P_RE, i] - a_im * scratch[P_IM, i]
        u_im = a_re * scratch[P_IM, i] + a_im * scratch[P_RE, i]
        v_re = b_re * scratch[Q_RE, i] - b_im * scratch[Q_IM, i]
        v_im = b_re * scratch[Q_IM, i] + b_im * scratch[Q_RE, i]
        c, s = scratch[TURN_RE, i], scratch[TURN_IM, i]
        scratch[F_RE, shift + i] += c * (u_re - v_re) - s * (u_im + v_im)
        scratch[F_IM, shift + i] += c * (u_im - v_im) + s * (u_re + v_re)


@njit(cache=True, error_model="numpy", borrows=True)
def compute_field(first_bin, n_bins, lines, table, outline, layout, tangents, scratch):
    """F in bins ``first_bin`` .., counted from the lines' origin, into rows F_RE and F_IM.

    ``lines``: their number, lowest and highest place, and what may be left out of the shape.
    """
    n_lines, lowest_position, highest_position, negligible = lines
    holds_all_bins = layout[5] != 0
    n_bins = (n_bins + 7) // 8 * 8  # whole vectors: a rest takes as long
    for i in range(n_bins):
        scratch[F_RE, i], scratch[F_IM, i] = 0.0, 0.0
    add_lines_by_table(first_bin, n_bins, lines, table, layout, scratch)
    table_reach = layout[2] - TABLE_SHORTFALL_BINS  # of tables from any line
    if holds_all_bins or (
        highest_position - first_bin < table_reach
        and first_bin + n_bins - lowest_position < table_reach
    ):
        return
    log_accuracy = SOURCE_LOG_ACCURACY
    source_distance = max(
        bins_to_nearest_line(first_bin, n_bins, lowest_position, highest_position, layout[0]),
        float(table_reach),
    )
    if negligible > 0.0:
        envelope_log_ratio = math.log(
            max(outline[1, envelope_index(source_distance, outline)] / negligible, 1.0)
        )
        log_accuracy = min(
            log_accuracy, 4.0 + (2.0 * envelope_log_ratio if layout[4] else envelope_log_ratio)
        )
    n_sources = compute_sources(
        n_lines, lowest_position, highest_position, source_distance, log_accuracy, layout, scratch
    )
    # Bins of which tables hold some lines, if not all; but for these, sources do.
    first_batch_bin = math.floor(lowest_position)
    last_batch_bin = (
        first_batch_bin
        + (math.floor(highest_position) - first_batch_bin) // LINE_BATCH_BINS * LINE_BATCH_BINS
    )
    current, end_bin = first_bin, first_bin + n_bins
    while current < end_bin:
        stop, is_in_part_of_table = min(current + FAR_BINS_PER_BATCH, end_bin), False
        for lap in range(-1, 2):
            low, _ = bins_in_table(first_batch_bin, lap, layout)
            _, high = bins_in_table(last_batch_bin, lap, layout)
            is_in_part_of_table |= low <= current < high
            stop = (
                min(stop, low) if low > current else (min(stop, high) if high > current else stop)
            )
        if not is_in_part_of_table:
            prepare_far_bins(current, stop - current, layout, tangents, scratch)
            for line in range(n_sources):
                add_line_by_record_ends(
                    ZERO,
                    stop - current,
                    current - first_bin,
                    SOURCES,
                    line,
                    log_accuracy + END_POLYNOMIAL_EXTRA_LOG_ACCURACY,
                    outline,
                    layout,
                    scratch,
                )
        elif last_batch_bin > first_batch_bin:
            prepare_far_bins(current, stop - current, layout, tangents, scratch)
            for line in range(n_lines):  # what the table does not hold of each line
                batch_bin = (
                    first_batch_bin
                    + int(scratch[PLACE, line] - first_batch_bin)
                    // LINE_BATCH_BINS
                    * LINE_BATCH_BINS
                )
                start = current
                for lap in range(-1, 3):
                    held_from, held_to = bins_in_table(batch_bin, lap, layout)
                    until = min(held_from, stop) if lap < 2 else stop
                    if start < until:
                        add_line_by_record_ends(
                            start - current,
                            until - current,
                            start - first_bin,
                            LINES,
                            line,
                            log_accuracy + END_POLYNOMIAL_EXTRA_LOG_ACCURACY,
                            outline,
                            layout,
                            scratch,
                        )
                    start = max(start, held_to)
        current = stop


@njit(cache=True, error_model="numpy", borrows=True)
def bins_to_nearest_line(first_bin, n_bins, lowest_position, highest_position, fft_size):
    """Least distance of some bins from lines, around the circle of all bins; 0 between them."""
    centre_distance = first_bin + 0.5 * (n_bins - 1) - 0.5 * (lowest_position + highest_position)
    centre_distance = abs(centre_distance - fft_size * np.rint(centre_distance / fft_size))
    return max(
        centre_distance - 0.5 * (n_bins - 1) - 0.5 * (highest_position - lowest_position), 0.0
    )


@njit(cache=True, error_model="numpy", borrows=True)
def envelope_index(distance, outline):
    """Index of what is known of envelopes from a distance on."""
    low, high = 0, outline.shape[1]
    while low < high:
        middle = (low + high) // 2
        if outline[0, middle] <= distance:
            low = middle + 1
        else:
            high = middle
    return max(low - 1, 0)


@njit(cache=True, error_model="numpy", borrows=True)
def compute_magnitudes(
    first_bin, n_bins, origin_bin, lines, shifts, table, outline, layout, tangents, scratch
):
    """|X| of bins ``first_bin`` .. of what is seen, into row OUT; as of :func:`compute_field`.

    ``shifts`` (2, m): places [bins] and weights over which |X|^2 is averaged; m may be 0.
    """
    adds_powers, spectrum_type = layout[4] != 0, layout[7]
    n_lines, lowest_position, highest_position, negligible = lines
    sign = -1 if is_mirrored(origin_bin, lowest_position, highest_position, spectrum_type) else 1
    is_averaged = shifts.shape[1] > 0
    if is_averaged:
        scratch[SUM, :n_bins] = 0.0
    for m in range(max(shifts.shape[1], 1)):
        shift = shifts[0, m] if is_averaged else 0.0
        if is_averaged:
            for line in range(n_lines):
                scratch[PLACE, line] += shift
        for image_pass in range(
            2 if spectrum_type == REAL_WITH_IMAGES else 1
        ):  # the lines, then their images
            direction = sign if image_pass == 0 else -sign
            first_field_bin = (
                first_bin - origin_bin if direction > 0 else 1 - first_bin - n_bins - origin_bin
            )
            if image_pass == 1:
                image_distance = bins_to_nearest_line(
                    first_field_bin,
                    n_bins,
                    lowest_position + shift,
                    highest_position + shift,
                    layout[0],
                )
                if outline[1, envelope_index(image_distance, outline)] <= negligible:
                    continue
            shifted_lines = n_lines, lowest_position + shift, highest_position + shift, negligible
            compute_field(
                first_field_bin, n_bins, shifted_lines, table, outline, layout, tangents, scratch
            )
            for i in range(n_bins):
                j = i if direction > 0 else n_bins - 1 - i
                re, im = scratch[F_RE, j], direction * scratch[F_IM, j]
                scratch[OUT, i] = re if image_pass == 0 else scratch[OUT, i] + re
                scratch[OUT_IM, i] = im if image_pass == 0 else scratch[OUT_IM, i] + im
        for i in range(n_bins):
            re, im = scratch[OUT, i], scratch[OUT_IM, i]
            scratch[OUT, i] = re if adds_powers else re * re + im * im
        if is_averaged:
            for i in range(n_bins):
                scratch[SUM, i] += shifts[1, m] * scratch[OUT, i]
            for line in range(n_lines):
                scratch[PLACE, line] -= shift
    result_row = SUM if is_averaged else OUT
    for i in range(n_bins):
        scratch[OUT, i] = math.sqrt(max(scratch[result_row, i], 0.0))


@njit(cache=True, error_model="numpy", borrows=True)
def distance_below_level(level, weight_sum, outline):
    """Bins beyond which lines of the given summed weight stay below ``level``."""
    if not weight_sum > 0.0:
        return 1.0
    low, high = 0, outline.shape[1] - 1
    if outline[1, high] * weight_sum > level:
        return np.inf
    while low < high:
        middle = (low + high) // 2
        if outline[1, middle] * weight_sum > level:
            low = middle + 1
        else:
            high = middle
    return outline[0, low]


@njit(cache=True, error_model="numpy", borrows=True)
def is_mirrored(origin_bin, lowest_position, highest_position, spectrum_type):
    """Return true where lines appear at the bins of their negative frequencies."""
    return (
        origin_bin + 0.5 * (lowest_position + highest_position) < 0.0
        and spectrum_type != COMPLEX_RECORD
    )


@njit(cache=True, error_model="numpy", borrows=True)
def seen_positions(origin_bin, lowest_position, highest_position, layout):
    """Lowest and highest place at which lines are seen, in bins; 0 .. N/2 where they fold."""
    if is_mirrored(origin_bin, lowest_position, highest_position, layout[7]):
        return -origin_bin - highest_position, -origin_bin - lowest_position
    return origin_bin + lowest_position, origin_bin + highest_position


@njit(cache=True, error_model="numpy", borrows=True)
def span_around_lines(margin_bins, line_positions, layout):
    """First and last bin ``margin_bins`` the places of lines, folded back at DC and Nyquist."""
    nyquist_bin = layout[0] // 2
    margin_bins = min(margin_bins, 2.0 * layout[0])
    first_bin, last_bin = (
        math.floor(line_positions[0] - margin_bins),
        math.ceil(line_positions[1] + margin_bins),
    )
    if layout[7] == COMPLEX_RECORD:
        if last_bin - first_bin >= layout[0]:
            first_bin = (first_bin + last_bin + 1 - layout[0]) // 2
        return first_bin, min(last_bin, first_bin + layout[0] - 1)
    if first_bin < 0:
        last_bin = max(last_bin, -first_bin)
    if last_bin > nyquist_bin:
        first_bin = min(first_bin, layout[0] - last_bin)
    return min(max(first_bin, 0), nyquist_bin), max(min(last_bin, nyquist_bin), 0)


@njit(cache=True, error_model="numpy", borrows=True)
def distance_below_level_with_images(level, weight_sum, line_positions, outline, layout):
    """Bins beyond which lines and images of a summed weight stay below a level."""
    if layout[7] == REAL_WITH_IMAGES:
        image_distance = min(
            line_positions[0], 0.5 * layout[0] - line_positions[1]
        )  # no bin is nearer to an image
        level_fraction = (
            0.5 if image_distance < distance_below_level(0.1 * level, weight_sum, outline) else 0.9
        )
        return distance_below_level(level_fraction * level, weight_sum, outline) + 1.0
    return distance_below_level(level, weight_sum, outline) + 1.0


@njit(cache=True, error_model="numpy", borrows=True)
def detect_in_span(
    origin_bin,
    lines,
    threshold_and_level,
    shifts,
    table,
    outline,
    layout,
    tangents,
    scratch,
    is_exempt,
):
    """Run of bins around a segment's lines, and the detection in it.

    ``origin_bin``: bin from which lines count. ``lines``: their number, lowest and highest place,
    their
    summed weight, and the most that an image may come to that is left out. ``threshold_and_level``:
    threshold;
    level below which bins may be left out; if none is above it, bins that the largest is known to
    exceed are. ``is_exempt``: result, bins of the run that can't raise a false alarm.

    Returns first bin of the run, number of bins, index of the largest, number of exempt ones; |X|
    in row OUT.
    """
    n_lines, lowest_position, highest_position, weight_sum, image_negligible = lines
    n_bins_max = layout[0] if layout[7] == COMPLEX_RECORD else layout[0] // 2 + 1
    shift_min, shift_max = 0.0, 0.0
    for m in range(shifts.shape[1]):
        shift_min, shift_max = min(shift_min, shifts[0, m]), max(shift_max, shifts[0, m])
    line_positions = seen_positions(
        origin_bin, lowest_position + shift_min, highest_position + shift_max, layout
    )
    evaluated_level, weight = threshold_and_level[1], weight_sum
    margin_bins = distance_below_level_with_images(
        evaluated_level, weight, line_positions, outline, layout
    )
    if not evaluated_level > 0.0:
        margin_bins = np.inf
    elif not layout[5] and margin_bins > 2 * layout[6] and n_lines > 1 and shifts.shape[1] == 0:
        n_sources = compute_sources(
            n_lines,
            lowest_position,
            highest_position,
            float(layout[6]),
            SOURCE_LOG_ACCURACY,
            layout,
            scratch,
        )
        weight = far_line_weight(weight_sum, n_sources, layout, scratch)
        margin_bins = max(
            distance_below_level_with_images(
                evaluated_level, weight, line_positions, outline, layout
            ),
            2.0 * layout[6],
        )
    bundle = n_lines, lowest_position, highest_position, image_negligible / max(weight_sum, 1e-300)
    margin_bins = max(margin_bins, 2.0 * layout[8])  # main lobes beside bins of half the largest
    while True:
        first_bin, last_bin = span_around_lines(margin_bins, line_positions, layout)
        n_bins = last_bin - first_bin + 1
        compute_magnitudes(
            first_bin, n_bins, origin_bin, bundle, shifts, table, outline, layout, tangents, scratch
        )
        peak_index, n_exempt = mark_exempt_bins(
            scratch[OUT], n_bins, threshold_and_level[0], is_exempt, layout[8]
        )
        largest = scratch[OUT, peak_index]
        if largest >= evaluated_level or n_bins >= n_bins_max:
            return first_bin, n_bins, peak_index, n_exempt
        margin_needed = distance_below_level_with_images(
            largest, weight_sum, line_positions, outline, layout
        )
        if margin_needed <= margin_bins:
            return first_bin, n_bins, peak_index, n_exempt
        margin_bins = margin_needed
