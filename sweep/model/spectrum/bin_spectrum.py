"""Spectrum of a segment's lines in the bins that matter, without the record or its FFT.

With the weights C_b of the lines, their positions nu_b and their shape G
(:mod:`sweep.model.spectrum.line_shape`),

    F(k) = sum_b C_b G(k - nu_b),    X[k] = F(k) + conj F(-k)

for a real record, where the second term is the images. The spectrum of a complex record is F alone
(PHYSICS section 5). The factor e^{-i pi r k}, r = L/N, which all terms share, is dropped. Lines
whose powers add have |C_b|^2 |G|^2 instead.

In bins near the lines F is computed from the table of G. In bins far from all lines it is computed
from a few sources that replace the lines. There the ends of the record determine the shape, and the
sources reproduce the lines as seen from each end.

Only a span of bins is computed. It contains all bins that the lines may lift to a given level, and
is wide enough to contain the largest bin.
"""

import math
import threading
from typing import NamedTuple

import numpy as np

from sweep.kernel_cache import njit
from sweep.model.detection.echo_detection import mark_exempt_bins
from sweep.model.elementary_functions import sincos_cycles
from sweep.model.spectrum.line_shape import (
    CELLS_PER_BIN,
    KERNEL_BASIS,
    KERNEL_CELLS,
    KERNEL_DEGREE,
    N_END_COEFFICIENTS,
    ZERO_WEIGHT_CELLS,
)
from sweep.model.spectrum.lines import (
    BATCH_SCRATCH_SIZE,
    COMPLEX_RECORD,
    REAL_WITH_IMAGES,
    LineArrays,
    LineScratch,
    replace_lines_by_nodes,
)

ZERO = np.int64(0)
"""0 as an argument of kernels. Numba would compile a kernel anew for a literal 0."""

FAR_BINS_PER_BATCH = 128
"""Number of bins far from the lines that are computed together."""

SOURCE_LOG_ACCURACY = 28.0
"""-ln of the relative error of the spectrum of sources, with a margin for the poles of a window."""

END_POLYNOMIAL_EXTRA_LOG_ACCURACY = 11.0
"""Difference between -ln of the error of the polynomials A and B and that of the sources."""

LINE_BATCH_BINS = 8
"""Width [bins] of an interval whose lines are spread over cells together. All of them use the bins
that the table holds for each of them."""

LINE_BATCH_EDGE_BINS = KERNEL_CELLS // 2 // min(CELLS_PER_BIN) + 1
"""Distance [bins] from such an interval up to which its lines are spread over cells."""

LINE_BATCH_CELLS_MAX = LINE_BATCH_BINS * max(CELLS_PER_BIN) + KERNEL_CELLS + ZERO_WEIGHT_CELLS
"""Maximum number of cells of such an interval."""

TABLE_SHORTFALL_BINS = LINE_BATCH_BINS + LINE_BATCH_EDGE_BINS + 1
"""Bins by which the table may reach less far from a line than its half-width."""

_N_SCRATCH_ROWS = 42
"""Number of arrays of floats in :class:`SpectrumWorkspace`."""


class LineBundle(NamedTuple):
    """Number, extent and total weight of the lines from which a spectrum is computed."""

    origin_bin: int
    """Bin from which positions of the lines count."""
    n_lines: int
    """Number of lines."""
    lowest_position: float
    """Lowest position of a line [bins from the origin]."""
    highest_position: float
    """Highest position of a line [bins from the origin]."""
    weight_sum: float
    """Sum of |C_b|, or an upper bound of it; sqrt(sum |C_b|^2) if powers add."""


class SeenLines(NamedTuple):
    """Range of bins in which lines appear in a spectrum; 0 .. N/2 if it folds them."""

    lowest_position: float
    """Lowest position [bins]."""
    highest_position: float
    """Highest position [bins]."""


class BinRange(NamedTuple):
    """First and last bin of a range."""

    first_bin: int
    """First bin."""
    last_bin: int
    """Last bin."""


class DetectedSpan(NamedTuple):
    """A span of bins around the lines of a segment, and the detection in it."""

    first_bin: int
    """First bin of the span."""
    n_bins: int
    """Number of bins."""
    peak_index: int
    """Index in the span of the largest bin."""
    n_exempt: int
    """Number of bins that cannot raise a false alarm."""
    leakage: float
    """Probability that leaked signal raises at least one false alarm; 0 if it is not computed."""


class AveragingShifts(NamedTuple):
    """Shifts of all lines over which |X|^2 is averaged; empty if it is not."""

    offset: np.ndarray
    """(shifts,): shift [bins of fs/N]."""
    weight: np.ndarray
    """(shifts,): weight; the sum is 1."""


class EndStrengths(NamedTuple):
    """Lines, or sources that replace them, with their strengths at the two ends of the record."""

    position: np.ndarray
    """Position [bins from the origin]."""
    start_re: np.ndarray
    """Real part of the strength at the record's start, which multiplies A."""
    start_im: np.ndarray
    """Imaginary part of the strength at the start."""
    end_re: np.ndarray
    """Real part of the strength at the record's end, which multiplies B."""
    end_im: np.ndarray
    """Imaginary part of the strength at the end."""


class FarBins(NamedTuple):
    """Quantities of a batch of bins k far from the lines, one element per bin."""

    tangent: np.ndarray
    """tan(pi k / N)."""
    turn_re: np.ndarray
    """cos(pi r k), r = L/N."""
    turn_im: np.ndarray
    """sin(pi r k)."""
    cotangent: np.ndarray
    """Scratch: cot(pi (k - nu) / N) of the distance from a line at nu."""
    start_re: np.ndarray
    """Scratch: real part of the polynomial A at this cotangent."""
    start_im: np.ndarray
    """Scratch: imaginary part of A."""
    end_re: np.ndarray
    """Scratch: real part of the polynomial B at this cotangent."""
    end_im: np.ndarray
    """Scratch: imaginary part of B."""


class FieldWorkspace(NamedTuple):
    """Lines, their spectrum F, and the scratch arrays by which it is computed."""

    lines: LineArrays
    """Lines of the segment."""
    line_scratch: LineScratch
    """Scratch of sums over lines."""
    cell_re: np.ndarray
    """Real part of the weights in the cells over which lines are spread."""
    cell_im: np.ndarray
    """Imaginary part of the weights in the cells."""
    line_ends: EndStrengths
    """Strengths of the lines at the record's ends."""
    sources: EndStrengths
    """Equivalent lines, which replace the real ones in the spectrum of bins far away."""
    far_bins: FarBins
    """Quantities of a batch of bins far away."""
    re: np.ndarray
    """Real part of F in consecutive bins; F itself if powers add."""
    im: np.ndarray
    """Imaginary part of F; unused if powers add."""


class SpanArrays(NamedTuple):
    """Magnitudes and crossing probabilities in the bins of a span, from its first bin on."""

    magnitude: np.ndarray
    """|X| without noise [V, summed over the record]."""
    is_exempt: np.ndarray
    """True in bins that cannot raise a false alarm, bool."""
    half_square: np.ndarray
    """Scratch: |X|^2 / (2 sigma^2)."""
    crossing_probability: np.ndarray
    """Probability by which the signal raises that of noise alone to cross the threshold."""


class IntegralPoints(NamedTuple):
    """Gauss points of the integral over bins far from the lines."""

    cotangent: np.ndarray
    """cot(pi q / N) of the distance q from the centre of the lines [bins]; later tan(pi q / N)."""
    weight: np.ndarray
    """Weight of the point in a sum over bins."""
    half_square: np.ndarray
    """|X|^2, later |X|^2 / (2 sigma^2)."""
    re: np.ndarray
    """Scratch: real part of X."""
    im: np.ndarray
    """Scratch: imaginary part of X."""


class SpectrumWorkspace(NamedTuple):
    """Arrays in which the spectrum of one segment is computed."""

    field: FieldWorkspace
    """Lines and their spectrum F."""
    inverse_gain_re: np.ndarray
    """Scratch of :func:`sweep.model.spectrum.lines.compute_lines`."""
    inverse_gain_im: np.ndarray
    """Scratch of :func:`sweep.model.spectrum.lines.compute_lines`."""
    nodes: LineArrays
    """Equivalent lines that replace the lines of the segment."""
    imaginary_part: np.ndarray
    """Scratch: imaginary part of X in the bins of the span."""
    mean_square: np.ndarray
    """Scratch: |X|^2 averaged over shifts, in the bins of the span."""
    span: SpanArrays
    """Bins of the span."""
    integral: IntegralPoints
    """Points of the integral over the bins beyond the span."""


_SCRATCH_BYTES_KEPT_MAX = 1 << 26
"""Largest scratch [bytes] that a thread keeps for its next batch."""

_thread_scratch = threading.local()


def _scratch_rows(width: int) -> np.ndarray:
    """Return scratch (rows, width), the same array for each batch of a thread.

    Of a new array the operating system clears every page that a batch touches. With wide spectra
    this takes an eighth of the time of a flight, as few numbers in each row are used.
    """
    rows: np.ndarray | None = getattr(_thread_scratch, "rows", None)
    if rows is None or rows.shape[1] != width:
        rows = np.empty((_N_SCRATCH_ROWS, width))
        _thread_scratch.rows = rows if rows.nbytes <= _SCRATCH_BYTES_KEPT_MAX else None
    return rows


def allocate_workspace(width: int) -> SpectrumWorkspace:
    """Allocate a workspace for up to ``width`` - 16 lines, bins or cells.

    A thread that asks for the same width again has the same arrays again, as a batch of points has
    no use for those of the batch before.
    """
    width = max(width, BATCH_SCRATCH_SIZE, LINE_BATCH_CELLS_MAX)
    rows = iter(_scratch_rows(width))

    def next_rows(n_rows: int) -> list[np.ndarray]:
        return [next(rows) for _ in range(n_rows)]

    lines = LineArrays(*next_rows(3))
    field = FieldWorkspace(
        lines=lines,
        line_scratch=LineScratch(*next_rows(3)),
        cell_re=next(rows),
        cell_im=next(rows),
        line_ends=EndStrengths(lines.position, *next_rows(4)),
        sources=EndStrengths(*next_rows(5)),
        far_bins=FarBins(*next_rows(8)),
        re=next(rows),
        im=next(rows),
    )
    return SpectrumWorkspace(
        field=field,
        inverse_gain_re=next(rows),
        inverse_gain_im=next(rows),
        nodes=LineArrays(*next_rows(3)),
        imaginary_part=next(rows),
        mean_square=next(rows),
        span=SpanArrays(next(rows), np.empty(width, np.bool_), *next_rows(2)),
        integral=IntegralPoints(*next_rows(5)),
    )


@njit(cache=True, error_model="numpy", borrows=True, forceinline=True)
def add_lines_by_table(first_bin, n_bins, bundle, shape, layout, field):
    """Add the lines to F in those of ``n_bins`` bins from ``first_bin`` on that the table holds.

    Each line is spread over cells around its position. The table holds the spectrum of a cell.
    """
    fft_size, cells_per_bin = layout.fft_size, layout.cells_per_bin
    lines, last_line_bin = field.lines, math.floor(bundle.highest_position)
    table_reach = layout.table_bins + LINE_BATCH_BINS
    for batch_bin in range(math.floor(bundle.lowest_position), last_line_bin + 1, LINE_BATCH_BINS):
        lap_min = -((table_reach + batch_bin - first_bin) // fft_size)
        lap_max = (first_bin + n_bins - batch_bin + table_reach) // fft_size
        if lap_min > lap_max:  # the table holds none of these bins
            continue
        n_cells = min(LINE_BATCH_BINS, last_line_bin + 1 - batch_bin) * cells_per_bin + KERNEL_CELLS
        for c in range(n_cells + ZERO_WEIGHT_CELLS):
            field.cell_re[c], field.cell_im[c] = 0.0, 0.0
        for line in range(bundle.n_lines):
            if batch_bin <= lines.position[line] < batch_bin + LINE_BATCH_BINS:
                cell_position = (lines.position[line] - batch_bin) * cells_per_bin
                _spread_line(
                    cell_position, lines.re[line], lines.im[line], field.cell_re, field.cell_im
                )
        for lap in range(lap_min, lap_max + 1):
            _add_cells(first_bin, n_bins, batch_bin, n_cells, lap, shape, layout, field)


@njit(cache=True, error_model="numpy", borrows=True)
def _spread_line(cell_position, re, im, cell_re, cell_im):
    """Spread a line at a position among cells over KERNEL_CELLS of them."""
    cell = np.uint64(math.floor(cell_position))
    cell_coordinate = 2.0 * (cell_position - math.floor(cell_position)) - 1.0
    for j in range(np.uint64(KERNEL_CELLS + ZERO_WEIGHT_CELLS)):
        weight = KERNEL_BASIS[KERNEL_DEGREE, j]
        for d in range(KERNEL_DEGREE):
            weight = weight * cell_coordinate + KERNEL_BASIS[KERNEL_DEGREE - 1 - d, j]
        cell_re[cell + j] += re * weight
        cell_im[cell + j] += im * weight


@njit(cache=True, error_model="numpy", borrows=True, forceinline=True)
def _first_bin_in_table(batch_bin, lap, layout):
    """Return the first bin that the table holds for all lines of the interval at ``batch_bin``.

    ``lap`` is the number of FFT lengths by which the spectrum is repeated.
    """
    return (
        batch_bin + lap * layout.fft_size + LINE_BATCH_BINS + LINE_BATCH_EDGE_BINS
    ) - layout.table_bins


@njit(cache=True, error_model="numpy", borrows=True, forceinline=True)
def _end_bin_in_table(batch_bin, lap, layout):
    """Return the bin after the last one that the table holds for all lines of the interval."""
    return batch_bin + lap * layout.fft_size - LINE_BATCH_EDGE_BINS + layout.table_bins


@njit(cache=True, error_model="numpy", borrows=True, forceinline=True)
def _add_cells(first_bin, n_bins, batch_bin, n_cells, lap, shape, layout, field):
    """Add the cells of one interval of lines to F.

    The first cell lies KERNEL_CELLS / 2 - 1 cells below the interval's first bin.
    """
    cells_per_bin, adds_powers = layout.cells_per_bin, layout.adds_powers
    n_columns = shape.table_re.size // cells_per_bin
    sign = -1.0 if lap & 1 and layout.record_length & 1 and not adds_powers else 1.0
    low = max(first_bin, _first_bin_in_table(batch_bin, lap, layout))
    high = min(first_bin + n_bins, _end_bin_in_table(batch_bin, lap, layout))
    begin_bin = batch_bin + lap * layout.fft_size - layout.table_bins
    if not layout.holds_all_bins and low >= high:
        return
    for c in range(n_cells):
        re, im = sign * field.cell_re[c], sign * field.cell_im[c]
        cell_index = c + 1 - KERNEL_CELLS // 2
        bin_, row = begin_bin + cell_index // cells_per_bin, cell_index % cells_per_bin
        if layout.holds_all_bins:
            low, high = max(first_bin, bin_), min(first_bin + n_bins, bin_ + n_columns)
        if low >= high or (re == 0.0 and im == 0.0):
            continue
        # Unsigned indices need no test for counting from an array's end.
        table_index = np.uint64(row * n_columns + low - bin_)
        field_index = np.uint64(low - first_bin)
        if adds_powers:
            for i in range(np.uint64(high - low)):
                field.re[field_index + i] += re * shape.table_re[table_index + i]
        else:
            for i in range(np.uint64(high - low)):
                g, h = shape.table_re[table_index + i], shape.table_im[table_index + i]
                field.re[field_index + i] += re * g - im * h
                field.im[field_index + i] += re * h + im * g


@njit(cache=True, error_model="numpy", borrows=True)
def compute_sources(bundle, distance_min, log_accuracy, layout, field):
    """Compute the lines' strengths at the record's ends, and sources that replace the lines.

    Parameters
    ----------
    bundle
        :class:`LineBundle` of the lines in ``field.lines``.
    distance_min
        Distance from the lines [bins] from which on the sources replace them.
    log_accuracy
        -ln of the relative error of the sources.
    layout
        :class:`SpectrumLayout`.
    field
        :class:`FieldWorkspace`, whose ``line_ends`` and ``sources`` are results.

    Returns
    -------
    n_sources
        Number of sources.
    """
    adds_powers = layout.adds_powers
    half_record_ratio = 0.5 * layout.record_length / layout.fft_size
    lines, line_ends, sources = field.lines, field.line_ends, field.sources
    for line in range(bundle.n_lines):
        sine, cosine = sincos_cycles(
            (2.0 if adds_powers else 1.0) * half_record_ratio * lines.position[line]
        )
        re, im = lines.re[line], lines.im[line]
        line_ends.start_re[line] = re if adds_powers else re * cosine + im * sine
        line_ends.start_im[line] = 0.0 if adds_powers else im * cosine - re * sine
        line_ends.end_re[line] = re * cosine if adds_powers else re * cosine - im * sine
        line_ends.end_im[line] = -re * sine if adds_powers else im * cosine + re * sine
    middle = 0.5 * (bundle.lowest_position + bundle.highest_position)
    half_width = 0.5 * (bundle.highest_position - bundle.lowest_position)
    n_sources = bundle.n_lines
    if half_width > 0.0:
        z = 1.0 + distance_min / half_width
        n_sources = 1 + int(log_accuracy / math.log(z + math.sqrt(z * z - 1.0)))
    elif bundle.n_lines > 1:
        n_sources = 1
    replace_lines_by_nodes(
        LineArrays(line_ends.position, line_ends.start_re, line_ends.start_im),
        bundle.n_lines,
        n_sources,
        middle,
        half_width,
        field.line_scratch,
        LineArrays(sources.position, sources.start_re, sources.start_im),
    )
    return replace_lines_by_nodes(
        LineArrays(line_ends.position, line_ends.end_re, line_ends.end_im),
        bundle.n_lines,
        n_sources,
        middle,
        half_width,
        field.line_scratch,
        LineArrays(sources.position, sources.end_re, sources.end_im),
    )


@njit(cache=True, error_model="numpy", borrows=True)
def far_line_weight(weight_sum, n_sources, layout, sources):
    """Return the total weight of the lines as seen from bins beyond the table.

    ``weight_sum`` is :attr:`LineBundle.weight_sum`, which the result does not exceed. ``sources``
    are the :class:`EndStrengths` of ``n_sources`` sources.
    """
    start_sum, end_sum = 0.0, 0.0
    for source in range(n_sources):
        start_sum += math.hypot(sources.start_re[source], sources.start_im[source])
        end_sum += math.hypot(sources.end_re[source], sources.end_im[source])
    start_sum = max(start_sum, end_sum)
    return min(weight_sum, math.sqrt(start_sum) if layout.adds_powers else start_sum)


@njit(cache=True, error_model="numpy", borrows=True)
def tangent_at(bin_, fft_size, tangents):
    """Return tan(pi k / N) of any bin k; ``tangents`` holds those of bins 0 .. N/2."""
    bin_ %= fft_size
    return tangents[bin_] if 2 * bin_ <= fft_size else -tangents[fft_size - bin_]


@njit(cache=True, error_model="numpy", borrows=True)
def prepare_far_bins(first_bin, n_bins, layout, tangents, far_bins):
    """Compute tan(pi k / N) and exp(i pi r k) of up to FAR_BINS_PER_BATCH bins into ``far_bins``.

    ``tangents`` holds the tangents of bins 0 .. N/2.
    """
    fft_size = layout.fft_size
    k = first_bin % fft_size
    for i in range(n_bins):
        far_bins.tangent[i] = tangents[k] if 2 * k <= fft_size else -tangents[fft_size - k]
        k = k + 1 if k + 1 < fft_size else 0
    if fft_size == layout.record_length:
        for i in range(n_bins):
            far_bins.turn_re[i], far_bins.turn_im[i] = -1.0 if (first_bin + i) & 1 else 1.0, 0.0
        return
    for i in range(n_bins):
        sine, cosine = sincos_cycles(0.5 * (first_bin + i) * layout.record_length / fft_size)
        far_bins.turn_re[i], far_bins.turn_im[i] = cosine, sine


@njit(cache=True, error_model="numpy", borrows=True, forceinline=True)
def add_line_by_record_ends(
    begin_offset, end_offset, field_offset, strengths, line, log_accuracy, ends, layout, field
):
    """Add one line or source to F in bins far from it.

    Parameters
    ----------
    begin_offset, end_offset
        First bin, and the bin after the last, in the batch ``field.far_bins``.
    field_offset
        Index in F of the first bin.
    strengths
        :class:`EndStrengths` of lines or sources.
    line
        Index of the line or source.
    log_accuracy
        -ln of the relative error of the polynomials, which are truncated accordingly.
    ends
        :class:`sweep.model.spectrum.line_shape.EndPolynomials` A and B.
    layout
        :class:`SpectrumLayout`.
    field
        :class:`FieldWorkspace`.

    Notes
    -----
    With the strengths a and b at the two ends, and c = cot(pi (k - nu) / N),

        F(k) += e^{i pi r k} a A(c) - e^{-i pi r k} b B(c).

    If powers add, F is |A|^2 + |B|^2 - 2 Re(e^{2 i pi r (k - nu)} A conj B), times a = |C|^2.
    """
    far_bins, relative_cut = field.far_bins, math.exp(-log_accuracy)
    a_re, a_im = strengths.start_re[line], strengths.start_im[line]
    b_re, b_im = strengths.end_re[line], strengths.end_im[line]
    line_tangent = math.tan(math.pi * strengths.position[line] / layout.fft_size)
    begin, stop = np.uint64(begin_offset), np.uint64(end_offset)
    shift = np.uint64(field_offset - begin_offset)
    for i in range(begin, stop):
        far_bins.cotangent[i] = (1.0 + far_bins.tangent[i] * line_tangent) / (
            far_bins.tangent[i] - line_tangent
        )
    cotangent_max = 0.0
    for i in range(begin, stop):
        cotangent_max = max(cotangent_max, abs(far_bins.cotangent[i]))
    degree, factor, term_max = 0, 1.0, 0.0
    for d in range(N_END_COEFFICIENTS):
        term = factor * (
            abs(ends.start_re[d])
            + abs(ends.start_im[d])
            + abs(ends.end_re[d])
            + abs(ends.end_im[d])
        )
        term_max = max(term_max, term)
        degree = d if term > relative_cut * term_max else degree
        factor *= cotangent_max
    for i in range(begin, stop):
        far_bins.start_re[i], far_bins.start_im[i] = ends.start_re[degree], ends.start_im[degree]
        far_bins.end_re[i], far_bins.end_im[i] = ends.end_re[degree], ends.end_im[degree]
    for d in range(degree - 1, -1, -1):
        p_re, p_im = ends.start_re[d], ends.start_im[d]
        q_re, q_im = ends.end_re[d], ends.end_im[d]
        for i in range(begin, stop):
            c = far_bins.cotangent[i]
            far_bins.start_re[i] = far_bins.start_re[i] * c + p_re
            far_bins.start_im[i] = far_bins.start_im[i] * c + p_im
            far_bins.end_re[i] = far_bins.end_re[i] * c + q_re
            far_bins.end_im[i] = far_bins.end_im[i] * c + q_im
    if layout.adds_powers:
        for i in range(begin, stop):
            p, q = far_bins.start_re[i], far_bins.start_im[i]
            r, s = far_bins.end_re[i], far_bins.end_im[i]
            u, v = far_bins.turn_re[i], far_bins.turn_im[i]
            u, v = u * u - v * v, 2.0 * u * v
            u, v = u * b_re - v * b_im, u * b_im + v * b_re
            field.re[shift + i] += a_re * (p * p + q * q + r * r + s * s) - 2.0 * (
                u * (p * r + q * s) - v * (q * r - p * s)
            )
        return
    for i in range(begin, stop):
        u_re = a_re * far_bins.start_re[i] - a_im * far_bins.start_im[i]
        u_im = a_re * far_bins.start_im[i] + a_im * far_bins.start_re[i]
        v_re = b_re * far_bins.end_re[i] - b_im * far_bins.end_im[i]
        v_im = b_re * far_bins.end_im[i] + b_im * far_bins.end_re[i]
        c, s = far_bins.turn_re[i], far_bins.turn_im[i]
        field.re[shift + i] += c * (u_re - v_re) - s * (u_im + v_im)
        field.im[shift + i] += c * (u_im - v_im) + s * (u_re + v_re)


@njit(cache=True, error_model="numpy", borrows=True, forceinline=True)
def compute_field(first_bin, n_bins, bundle, negligible_ratio, shape, layout, tangents, field):
    """Compute F in ``n_bins`` bins into ``field.re`` and ``field.im``.

    Parameters
    ----------
    first_bin
        First bin, counted from the lines' origin.
    n_bins
        Number of bins; up to seven more are computed.
    bundle
        :class:`LineBundle` of the lines in ``field.lines``.
    negligible_ratio
        Error of F that is allowed, over the sum of |C_b|.
    shape
        :class:`sweep.model.spectrum.line_shape.LineShape`.
    layout
        :class:`SpectrumLayout`.
    tangents
        tan(pi k / N) of bins 0 .. N/2.
    field
        :class:`FieldWorkspace`.
    """
    lowest_position, highest_position = bundle.lowest_position, bundle.highest_position
    n_bins = (n_bins + 7) // 8 * 8  # whole vectors: a remainder takes as long
    for i in range(n_bins):
        field.re[i], field.im[i] = 0.0, 0.0
    add_lines_by_table(first_bin, n_bins, bundle, shape, layout, field)
    table_reach = layout.table_bins - TABLE_SHORTFALL_BINS  # from any line
    if layout.holds_all_bins or (
        highest_position - first_bin < table_reach
        and first_bin + n_bins - lowest_position < table_reach
    ):
        return
    log_accuracy = SOURCE_LOG_ACCURACY
    source_distance = max(
        bins_to_nearest_line(first_bin, n_bins, lowest_position, highest_position, layout.fft_size),
        float(table_reach),
    )
    if negligible_ratio > 0.0:
        envelope = shape.envelope.magnitude[envelope_index(source_distance, shape.envelope)]
        envelope_log_ratio = math.log(max(envelope / negligible_ratio, 1.0))
        log_accuracy = min(
            log_accuracy,
            4.0 + (2.0 * envelope_log_ratio if layout.adds_powers else envelope_log_ratio),
        )
    n_sources = compute_sources(bundle, source_distance, log_accuracy, layout, field)
    polynomial_log_accuracy = log_accuracy + END_POLYNOMIAL_EXTRA_LOG_ACCURACY
    # In some bins the table holds some lines and not others. Sources serve all bins but these.
    first_batch_bin = math.floor(lowest_position)
    last_batch_bin = (
        first_batch_bin
        + (math.floor(highest_position) - first_batch_bin) // LINE_BATCH_BINS * LINE_BATCH_BINS
    )
    current, end_bin = first_bin, first_bin + n_bins
    while current < end_bin:
        stop, is_in_part_of_table = min(current + FAR_BINS_PER_BATCH, end_bin), False
        for lap in range(-1, 2):
            low = _first_bin_in_table(first_batch_bin, lap, layout)
            high = _end_bin_in_table(last_batch_bin, lap, layout)
            is_in_part_of_table |= low <= current < high
            stop = (
                min(stop, low) if low > current else (min(stop, high) if high > current else stop)
            )
        is_far = not is_in_part_of_table
        if is_far or last_batch_bin > first_batch_bin:
            prepare_far_bins(current, stop - current, layout, tangents, field.far_bins)
        if is_far:
            for source in range(n_sources):
                add_line_by_record_ends(
                    ZERO,
                    stop - current,
                    current - first_bin,
                    field.sources,
                    source,
                    polynomial_log_accuracy,
                    shape.ends,
                    layout,
                    field,
                )
        elif last_batch_bin > first_batch_bin:
            for line in range(bundle.n_lines):  # the bins that the table does not hold for it
                batch_bin = (
                    first_batch_bin
                    + int(field.lines.position[line] - first_batch_bin)
                    // LINE_BATCH_BINS
                    * LINE_BATCH_BINS
                )
                start = current
                for lap in range(-1, 3):
                    table_begin = _first_bin_in_table(batch_bin, lap, layout)
                    until = min(table_begin, stop) if lap < 2 else stop
                    if start < until:
                        add_line_by_record_ends(
                            start - current,
                            until - current,
                            start - first_bin,
                            field.line_ends,
                            line,
                            polynomial_log_accuracy,
                            shape.ends,
                            layout,
                            field,
                        )
                    start = max(start, _end_bin_in_table(batch_bin, lap, layout))
        current = stop


@njit(cache=True, error_model="numpy", borrows=True)
def bins_to_nearest_line(first_bin, n_bins, lowest_position, highest_position, fft_size):
    """Return the least distance [bins] of a range of bins from the lines; 0 between the lines.

    Distances are measured around the circle of all N bins.
    """
    centre_distance = first_bin + 0.5 * (n_bins - 1) - 0.5 * (lowest_position + highest_position)
    centre_distance = abs(centre_distance - fft_size * np.rint(centre_distance / fft_size))
    return max(
        centre_distance - 0.5 * (n_bins - 1) - 0.5 * (highest_position - lowest_position), 0.0
    )


@njit(cache=True, error_model="numpy", borrows=True)
def envelope_index(distance, envelope):
    """Return the index of the largest tabulated distance of a line's envelope up to ``distance``.

    ``envelope`` is a :class:`sweep.model.spectrum.line_shape.LineEnvelope`.
    """
    low, high = 0, envelope.distance.size
    while low < high:
        middle = (low + high) // 2
        if envelope.distance[middle] <= distance:
            low = middle + 1
        else:
            high = middle
    return max(low - 1, 0)


@njit(cache=True, error_model="numpy", borrows=True)
def compute_magnitudes(
    first_bin, n_bins, bundle, negligible_ratio, shifts, shape, layout, tangents, workspace
):
    """Compute |X| in ``n_bins`` bins from ``first_bin`` on into ``workspace.span.magnitude``.

    Parameters are those of :func:`compute_field`, with :class:`AveragingShifts` over which |X|^2 is
    averaged, and a :class:`SpectrumWorkspace`. Bins count from DC.
    """
    field, span = workspace.field, workspace.span
    is_mirror_image = is_mirrored(
        bundle.origin_bin, bundle.lowest_position, bundle.highest_position, layout.spectrum_type
    )
    sign = -1 if is_mirror_image else 1
    is_averaged = shifts.offset.size > 0
    if is_averaged:
        workspace.mean_square[:n_bins] = 0.0
    for m in range(max(shifts.offset.size, 1)):
        shift = shifts.offset[m] if is_averaged else 0.0
        if is_averaged:
            for line in range(bundle.n_lines):
                field.lines.position[line] += shift
        shifted_bundle = LineBundle(
            bundle.origin_bin,
            bundle.n_lines,
            bundle.lowest_position + shift,
            bundle.highest_position + shift,
            bundle.weight_sum,
        )
        for image_pass in range(
            2 if layout.spectrum_type == REAL_WITH_IMAGES else 1
        ):  # the lines, then their images
            direction = sign if image_pass == 0 else -sign
            first_field_bin = (
                first_bin - bundle.origin_bin
                if direction > 0
                else 1 - first_bin - n_bins - bundle.origin_bin
            )
            if image_pass == 1:
                image_distance = bins_to_nearest_line(
                    first_field_bin,
                    n_bins,
                    shifted_bundle.lowest_position,
                    shifted_bundle.highest_position,
                    layout.fft_size,
                )
                image_index = envelope_index(image_distance, shape.envelope)
                if shape.envelope.magnitude[image_index] <= negligible_ratio:
                    continue
            compute_field(
                first_field_bin,
                n_bins,
                shifted_bundle,
                negligible_ratio,
                shape,
                layout,
                tangents,
                field,
            )
            for i in range(n_bins):
                j = i if direction > 0 else n_bins - 1 - i
                re, im = field.re[j], direction * field.im[j]
                span.magnitude[i] = re if image_pass == 0 else span.magnitude[i] + re
                workspace.imaginary_part[i] = (
                    im if image_pass == 0 else workspace.imaginary_part[i] + im
                )
        for i in range(n_bins):
            re, im = span.magnitude[i], workspace.imaginary_part[i]
            span.magnitude[i] = re if layout.adds_powers else re * re + im * im
        if is_averaged:
            for i in range(n_bins):
                workspace.mean_square[i] += shifts.weight[m] * span.magnitude[i]
            for line in range(bundle.n_lines):
                field.lines.position[line] -= shift
    square = workspace.mean_square if is_averaged else span.magnitude
    for i in range(n_bins):
        span.magnitude[i] = math.sqrt(max(square[i], 0.0))


@njit(cache=True, error_model="numpy", borrows=True)
def distance_below_level(level, weight_sum, envelope):
    """Return the distance [bins] from which on lines of a summed weight stay below a level.

    ``envelope`` is a :class:`sweep.model.spectrum.line_shape.LineEnvelope`. The result is infinite
    if the lines exceed the level at any distance.
    """
    if not weight_sum > 0.0:
        return 1.0
    low, high = 0, envelope.distance.size - 1
    if envelope.magnitude[high] * weight_sum > level:
        return np.inf
    while low < high:
        middle = (low + high) // 2
        if envelope.magnitude[middle] * weight_sum > level:
            low = middle + 1
        else:
            high = middle
    return envelope.distance[low]


@njit(cache=True, error_model="numpy", borrows=True)
def is_mirrored(origin_bin, lowest_position, highest_position, spectrum_type):
    """Return true if a real record shows lines of negative frequency at the opposite frequency."""
    return (
        origin_bin + 0.5 * (lowest_position + highest_position) < 0.0
        and spectrum_type != COMPLEX_RECORD
    )


@njit(cache=True, error_model="numpy", borrows=True)
def seen_lines(origin_bin, lowest_position, highest_position, layout):
    """Return the :class:`SeenLines` of lines at positions counted from ``origin_bin``."""
    if is_mirrored(origin_bin, lowest_position, highest_position, layout.spectrum_type):
        return SeenLines(-origin_bin - highest_position, -origin_bin - lowest_position)
    return SeenLines(origin_bin + lowest_position, origin_bin + highest_position)


@njit(cache=True, error_model="numpy", borrows=True)
def bins_around_lines(margin_bins, seen, layout):
    """Return the :class:`BinRange` of the lines with a margin on either side [bins].

    ``seen`` is the :class:`SeenLines`. A margin beyond DC or Nyquist is folded back.
    """
    fft_size, nyquist_bin = layout.fft_size, layout.fft_size // 2
    margin_bins = min(margin_bins, 2.0 * fft_size)
    first_bin = math.floor(seen.lowest_position - margin_bins)
    last_bin = math.ceil(seen.highest_position + margin_bins)
    if layout.spectrum_type == COMPLEX_RECORD:
        if last_bin - first_bin >= fft_size:
            first_bin = (first_bin + last_bin + 1 - fft_size) // 2
        return BinRange(first_bin, min(last_bin, first_bin + fft_size - 1))
    if first_bin < 0:
        last_bin = max(last_bin, -first_bin)
    if last_bin > nyquist_bin:
        first_bin = min(first_bin, fft_size - last_bin)
    return BinRange(min(max(first_bin, ZERO), nyquist_bin), max(min(last_bin, nyquist_bin), ZERO))


@njit(cache=True, error_model="numpy", borrows=True)
def distance_below_level_with_images(level, weight_sum, seen, envelope, layout):
    """Return the distance [bins] from which on lines and their images stay below a level.

    Parameters are those of :func:`distance_below_level`, with the :class:`SeenLines`.
    """
    if layout.spectrum_type == REAL_WITH_IMAGES:
        image_distance = min(
            seen.lowest_position, 0.5 * layout.fft_size - seen.highest_position
        )  # no bin is nearer to an image
        level_fraction = (
            0.5 if image_distance < distance_below_level(0.1 * level, weight_sum, envelope) else 0.9
        )
        return distance_below_level(level_fraction * level, weight_sum, envelope) + 1.0
    return distance_below_level(level, weight_sum, envelope) + 1.0


@njit(cache=True, error_model="numpy", borrows=True, forceinline=True)
def detect_in_span(
    bundle,
    negligible_magnitude,
    threshold,
    lowest_level,
    lobe_half_width,
    shifts,
    shape,
    layout,
    tangents,
    workspace,
):
    """Compute a span of bins around a segment's lines, and detect the echo in it.

    Parameters
    ----------
    bundle
        :class:`LineBundle` of the lines in ``workspace.field.lines``.
    negligible_magnitude
        Largest |X| of images that may be left out [V, summed over the record].
    threshold
        Threshold on |X| [V].
    lowest_level
        |X| [V] below which bins may be left out. If no bin reaches it, bins that are certainly
        smaller than the largest bin are left out.
    lobe_half_width
        Half-width of the echo's main lobe or pedestal [bins], or 0: bins that are exempt with a
        strong bin (:func:`sweep.model.detection.echo_detection.mark_exempt_bins`).
    shifts
        :class:`AveragingShifts`.
    shape
        :class:`sweep.model.spectrum.line_shape.LineShape`.
    layout
        :class:`SpectrumLayout`.
    tangents
        tan(pi k / N) of bins 0 .. N/2.
    workspace
        :class:`SpectrumWorkspace`, whose ``span.magnitude`` and ``span.is_exempt`` are results.

    Returns
    -------
    DetectedSpan
        Without leakage.
    """
    span, weight_sum = workspace.span, bundle.weight_sum
    is_complex = layout.spectrum_type == COMPLEX_RECORD
    n_bins_max = layout.fft_size if is_complex else layout.fft_size // 2 + 1
    shift_min, shift_max = 0.0, 0.0
    for m in range(shifts.offset.size):
        shift_min, shift_max = min(shift_min, shifts.offset[m]), max(shift_max, shifts.offset[m])
    seen = seen_lines(
        bundle.origin_bin,
        bundle.lowest_position + shift_min,
        bundle.highest_position + shift_max,
        layout,
    )
    margin_bins = distance_below_level_with_images(
        lowest_level, weight_sum, seen, shape.envelope, layout
    )
    if not lowest_level > 0.0:
        margin_bins = np.inf
    elif (
        not layout.holds_all_bins
        and margin_bins > 2 * layout.clearance_bins
        and bundle.n_lines > 1
        and shifts.offset.size == 0
    ):
        n_sources = compute_sources(
            bundle, float(layout.clearance_bins), SOURCE_LOG_ACCURACY, layout, workspace.field
        )
        far_weight = far_line_weight(weight_sum, n_sources, layout, workspace.field.sources)
        margin_bins = max(
            distance_below_level_with_images(
                lowest_level, far_weight, seen, shape.envelope, layout
            ),
            2.0 * layout.clearance_bins,
        )
    negligible_ratio = negligible_magnitude / max(weight_sum, 1e-300)
    margin_bins = max(margin_bins, 2.0 * lobe_half_width)  # main lobes of bins of half the largest
    while True:
        bins = bins_around_lines(margin_bins, seen, layout)
        n_bins = bins.last_bin - bins.first_bin + 1
        compute_magnitudes(
            bins.first_bin,
            n_bins,
            bundle,
            negligible_ratio,
            shifts,
            shape,
            layout,
            tangents,
            workspace,
        )
        peak_index, n_exempt = mark_exempt_bins(
            span.magnitude, n_bins, threshold, span.is_exempt, lobe_half_width
        )
        largest = span.magnitude[peak_index]
        if largest >= lowest_level or n_bins >= n_bins_max:
            return DetectedSpan(bins.first_bin, n_bins, peak_index, n_exempt, 0.0)
        margin_needed = distance_below_level_with_images(
            largest, weight_sum, seen, shape.envelope, layout
        )
        if margin_needed <= margin_bins:
            return DetectedSpan(bins.first_bin, n_bins, peak_index, n_exempt, 0.0)
        margin_bins = margin_needed
