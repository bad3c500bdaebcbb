"""Spectrum of a segment's lines in the bins that matter, without the record or its FFT.

Line b has the complex weight C_b and the position nu_b [bins]. All lines have the shape G
(:mod:`sweep.model.spectrum.line_shape`). In bin k their spectrum F and the record's spectrum X are

    F(k) = sum_b C_b G(k - nu_b),    X[k] = F(k) + conj F(-k)

for a real record, where the second term is the images. The spectrum of a complex record is F alone
(PHYSICS section 5). All terms share the factor e^{-i pi r k}, which is dropped; r is the
number L of samples over the FFT size N. Lines whose powers add have |C_b|^2 |G|^2 instead.

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
from sweep.model.kernel_integers import INTEGER_ZERO
from sweep.model.spectrum.line_shape import (
    KERNEL_POLYNOMIAL_DEGREE,
    KERNEL_POLYNOMIALS,
    N_END_POLYNOMIAL_COEFFICIENTS,
    N_KERNEL_CELLS,
    N_ZERO_WEIGHT_CELLS,
    TABLE_CELLS_PER_BIN,
)
from sweep.model.spectrum.lines import (
    BATCH_SCRATCH_SIZE,
    COMPLEX_RECORD,
    REAL_WITH_IMAGES,
    LineArrays,
    LineScratch,
    replace_lines_by_nodes,
)

FAR_BINS_PER_BATCH = 128
"""Number of frequency bins per pass of the calculation far from the lines."""

FAR_LINE_LOG_ACCURACY = 28.0
"""Accuracy of the far spectrum of lines that equivalent lines replace: -ln of its largest relative
error. The value includes a margin for windows with poles."""

FAR_LINE_EXTRA_LOG_ACCURACY = 11.0
"""Extra accuracy of the polynomials A and B, added to -ln of the equivalent lines' relative error.
A and B give a line's spectrum far from it (:mod:`sweep.model.spectrum.line_shape`)."""

LINE_BATCH_WIDTH_BINS = 8
"""Width [bins] of a frequency interval whose lines are spread over table cells in one pass. A bin
is computed from the table only if the table of every line in the interval contains it."""

LINE_BATCH_EDGE_BINS = N_KERNEL_CELLS // 2 // min(TABLE_CELLS_PER_BIN) + 1
"""Greatest distance [bins] from an interval of LINE_BATCH_WIDTH_BINS at which the interval's lines
occupy table cells."""

LINE_BATCH_CELLS_MAX = (
    LINE_BATCH_WIDTH_BINS * max(TABLE_CELLS_PER_BIN) + N_KERNEL_CELLS + N_ZERO_WEIGHT_CELLS
)
"""Maximum number of table cells over which the lines of one interval of LINE_BATCH_WIDTH_BINS are
spread."""

TABLE_SHORTFALL_BINS = LINE_BATCH_WIDTH_BINS + LINE_BATCH_EDGE_BINS + 1
"""Margin [bins] by which the usable half-width of a line's table is below its stored half-width.
Lines are processed in intervals, so a line may not use the table's outermost bins."""

_N_SCRATCH_ROWS = 42
"""Number of float arrays of equal length in :class:`SpectrumWorkspace`."""


class LineBundle(NamedTuple):
    """Number, frequency range and total weight of the lines from which a spectrum is computed."""

    origin_bin: int
    """FFT bin number of the frequency from which line positions are counted."""
    n_lines: int
    """Number of lines from which the spectrum is computed."""
    lowest_position: float
    """Lowest line frequency [bins from ``origin_bin``]."""
    highest_position: float
    """Highest line frequency [bins from ``origin_bin``]."""
    weight_sum: float
    """Sum of the magnitudes of the lines' complex weights [V], or an upper bound of it. If powers
    add, the square root of the sum of squared magnitudes."""


class FoldedLineRange(NamedTuple):
    """Lowest and highest frequency of lines [bins], after negative ones are folded at DC.

    In a spectrum that is not folded, negative frequencies remain negative.
    """

    lowest_position: float
    """Lowest frequency at which a line appears [bins from DC]."""
    highest_position: float
    """Highest frequency at which a line appears [bins from DC]."""


class BinRange(NamedTuple):
    """Range of FFT bins, first and last bin included."""

    first_bin: int
    """FFT bin number of the first bin."""
    last_bin: int
    """FFT bin number of the last bin, included."""


class DetectedSpan(NamedTuple):
    """Adjacent FFT bins around the lines of a segment (a span), and the detection in them."""

    first_bin: int
    """FFT bin number of the first bin of the span."""
    n_bins: int
    """Number of bins of the span."""
    peak_index: int
    """Index of the bin with the largest magnitude, counted from the first bin of the span."""
    n_exempt: int
    """Number of bins of the span that belong to the echo and so cannot raise a false alarm."""
    leakage_probability: float
    """Probability that the echo's signal far from its lines raises at least one false alarm. The
    value is 0 if it is not computed.
    """
    raised_bin_probability_max: float
    """Upper bound on the probability that the echo's signal far from its lines raises any bin above
    the threshold, including bins that join the echo. The value is 1 if it is not computed.
    """


class AveragingShifts(NamedTuple):
    """Frequency shifts of all lines, with weights, over which |X|^2 is averaged.

    The shifts stand for the laser's line width, and for the drift of lines over looks. X is the
    spectrum. The arrays are empty if |X|^2 is not averaged.
    """

    offset: np.ndarray
    """(shifts,): frequency shift [bins of width fs/N, sample rate over FFT size]."""
    weight: np.ndarray
    """(shifts,): weight of each shift in the average; the sum is 1."""


class RecordEndAmplitudes(NamedTuple):
    """Lines, or equivalent lines, with their complex amplitudes at both ends of the record."""

    position: np.ndarray
    """Frequency of each line [bins from the origin bin]."""
    start_re: np.ndarray
    """Real part of the amplitude at the record's start, which multiplies the polynomial A."""
    start_im: np.ndarray
    """Imaginary part of the amplitude at the record's start."""
    end_re: np.ndarray
    """Real part of the amplitude at the record's end, which multiplies the polynomial B."""
    end_im: np.ndarray
    """Imaginary part of the amplitude at the record's end."""


class FarBins(NamedTuple):
    """Trigonometric values and scratch arrays for a batch of bins k far from the lines.

    Arrays have one element per bin. N is the FFT size, L the number of samples. A and B are the
    polynomials that give a line's far spectrum, from the start and from the end of the record
    (:mod:`sweep.model.spectrum.line_shape`).
    """

    tangent: np.ndarray
    """tan(pi k / N) of each bin k, with the FFT size N."""
    phasor_re: np.ndarray
    """cos(pi k L / N) of each bin k, with L samples and the FFT size N."""
    phasor_im: np.ndarray
    """sin(pi k L / N) of each bin k, with L samples and the FFT size N."""
    cotangent: np.ndarray
    """Scratch: cot(pi (k - nu) / N) for a line at nu bins, with the FFT size N."""
    start_re: np.ndarray
    """Scratch: real part of the polynomial A of the record's start, evaluated at ``cotangent``."""
    start_im: np.ndarray
    """Scratch: imaginary part of the polynomial A of the record's start, evaluated at
    ``cotangent``.
    """
    end_re: np.ndarray
    """Scratch: real part of the polynomial B of the record's end, evaluated at ``cotangent``."""
    end_im: np.ndarray
    """Scratch: imaginary part of the polynomial B of the record's end, evaluated at ``cotangent``.
    """


class LineSpectrumWorkspace(NamedTuple):
    """Lines, their spectrum without images, and the scratch arrays for computing it."""

    lines: LineArrays
    """Positions and weights of the segment's lines."""
    line_scratch: LineScratch
    """Scratch arrays for sums over lines."""
    cell_re: np.ndarray
    """Real part of the sum of line weights in each table cell, after the lines are spread over
    cells."""
    cell_im: np.ndarray
    """Imaginary part of the sum of line weights in each table cell, after the lines are spread over
    cells."""
    record_end_amplitudes: RecordEndAmplitudes
    """Amplitudes of the segment's lines at the record's start and end."""
    far_equivalent_lines: RecordEndAmplitudes
    """Equivalent lines (sources), which replace the segment's lines in bins far away."""
    far_bins: FarBins
    """Trigonometric values and scratch arrays for a batch of bins far from the lines."""
    re: np.ndarray
    """Real part of the lines' spectrum in consecutive bins; the power spectrum if powers add."""
    im: np.ndarray
    """Imaginary part of the lines' spectrum in consecutive bins; unused if powers add."""


class SpanArrays(NamedTuple):
    """Magnitudes and crossing probabilities in consecutive bins around the lines (a span)."""

    magnitude: np.ndarray
    """Magnitude of the spectrum without noise [V, summed over the record]."""
    is_exempt: np.ndarray
    """True in bins that belong to the echo and so cannot raise a false alarm, bool."""
    half_square: np.ndarray
    """Scratch: squared magnitude over twice the noise variance per quadrature."""
    crossing_probability: np.ndarray
    """Probability that a bin crosses the threshold with signal, minus that with noise alone."""


class LeakageQuadrature(NamedTuple):
    """Quadrature points of the integral over bins far from the lines that gives leakage.

    Leakage is the probability of false alarms due to the echo's signal.
    """

    cotangent: np.ndarray
    """cot(pi q / N) at q bins from the centre of the lines, with the FFT size N. A later step
    replaces the values by tan(pi q / N).
    """
    weight: np.ndarray
    """Quadrature weight of the point in a sum over bins."""
    half_square: np.ndarray
    """Squared magnitude of the spectrum. A later step divides it by twice the noise variance per
    quadrature.
    """
    re: np.ndarray
    """Scratch: real part of the spectrum at the points."""
    im: np.ndarray
    """Scratch: imaginary part of the spectrum at the points."""


class SpectrumWorkspace(NamedTuple):
    """Arrays for computing the spectrum of one segment of one point."""

    line_spectrum: LineSpectrumWorkspace
    """Lines of the segment, and their spectrum without images (mirrors at negative frequency)."""
    inverse_gain_re: np.ndarray
    """Scratch of :func:`sweep.model.spectrum.lines.compute_lines`: real part of 1 over the gain."""
    inverse_gain_im: np.ndarray
    """Scratch of :func:`sweep.model.spectrum.lines.compute_lines`: imaginary part of 1 over the
    gain.
    """
    nodes: LineArrays
    """Equivalent lines at Chebyshev nodes, which replace the segment's lines."""
    imaginary_part: np.ndarray
    """Scratch: imaginary part of the spectrum in the computed bins around the lines."""
    mean_square: np.ndarray
    """Scratch: squared magnitude in the computed bins around the lines, averaged over frequency
    shifts (:class:`AveragingShifts`)."""
    span: SpanArrays
    """Magnitudes and crossing probabilities in the computed bins around the lines."""
    leakage_quadrature: LeakageQuadrature
    """Quadrature points of the integral that gives the leakage of bins outside ``span``."""


_SCRATCH_BYTES_KEPT_MAX = 1 << 28
"""Largest scratch array [bytes] that a thread keeps for its next batch of points."""

_thread_scratch = threading.local()


def _reused_scratch_array(width: int) -> np.ndarray:
    """Return a scratch array (_N_SCRATCH_ROWS, width), reused in all batches of a thread.

    For a new array, the operating system would clear every page that a batch writes. With wide
    spectra this would take an eighth of a flight's run time, because each row uses few elements.
    """
    rows: np.ndarray | None = getattr(_thread_scratch, "rows", None)
    if rows is None or rows.shape[1] != width:
        rows = np.empty((_N_SCRATCH_ROWS, width))
        _thread_scratch.rows = rows if rows.nbytes <= _SCRATCH_BYTES_KEPT_MAX else None
    return rows


def allocate_workspace(width: int) -> SpectrumWorkspace:
    """Allocate a workspace for up to ``width`` - 16 lines, bins or cells.

    A second call in the same thread with the same width returns the same arrays. A batch of points
    does not need the values of the batch before.
    """
    width = max(width, BATCH_SCRATCH_SIZE, LINE_BATCH_CELLS_MAX)
    rows = iter(_reused_scratch_array(width))

    def next_rows(n_rows: int) -> list[np.ndarray]:
        return [next(rows) for _ in range(n_rows)]

    lines = LineArrays(*next_rows(3))
    line_spectrum = LineSpectrumWorkspace(
        lines=lines,
        line_scratch=LineScratch(*next_rows(3)),
        cell_re=next(rows),
        cell_im=next(rows),
        record_end_amplitudes=RecordEndAmplitudes(lines.position, *next_rows(4)),
        far_equivalent_lines=RecordEndAmplitudes(*next_rows(5)),
        far_bins=FarBins(*next_rows(8)),
        re=next(rows),
        im=next(rows),
    )
    return SpectrumWorkspace(
        line_spectrum=line_spectrum,
        inverse_gain_re=next(rows),
        inverse_gain_im=next(rows),
        nodes=LineArrays(*next_rows(3)),
        imaginary_part=next(rows),
        mean_square=next(rows),
        span=SpanArrays(next(rows), np.empty(width, np.bool_), *next_rows(2)),
        leakage_quadrature=LeakageQuadrature(*next_rows(5)),
    )


@njit(cache=True, error_model="numpy", borrows=True, inline="always")
def add_lines_by_table(first_bin, n_bins, bundle, shape, layout, line_spectrum):
    """Add the lines' spectrum in bins of the line-shape table to ``line_spectrum``.

    Each line is spread over cells around its position. The table holds the spectrum of a line in a
    cell.

    Parameters
    ----------
    first_bin : int
        First bin, counted from the lines' origin.
    n_bins : int
        Number of bins.
    bundle : LineBundle
        Number and range of the lines in ``line_spectrum.lines``.
    shape : LineShape
        Shape of the lines, with its table (:class:`sweep.model.spectrum.line_shape.LineShape`).
    layout : SpectrumLayout
        Sizes of spectrum and tables (:class:`sweep.model.spectrum.lines.SpectrumLayout`).
    line_spectrum : LineSpectrumWorkspace
        Lines and scratch arrays. The spectrum is added to ``re`` and ``im`` [V].
    """
    fft_size, cells_per_bin = layout.fft_size, layout.cells_per_bin
    lines, last_line_bin = line_spectrum.lines, math.floor(bundle.highest_position)
    table_reach = layout.table_half_width_bins + LINE_BATCH_WIDTH_BINS
    for batch_bin in range(
        math.floor(bundle.lowest_position), last_line_bin + 1, LINE_BATCH_WIDTH_BINS
    ):
        n_periods_min = -((table_reach + batch_bin - first_bin) // fft_size)
        n_periods_max = (first_bin + n_bins - batch_bin + table_reach) // fft_size
        if n_periods_min > n_periods_max:  # the table holds none of these bins
            continue
        n_cells = (
            min(LINE_BATCH_WIDTH_BINS, last_line_bin + 1 - batch_bin) * cells_per_bin
            + N_KERNEL_CELLS
        )
        for c in range(n_cells + N_ZERO_WEIGHT_CELLS):
            line_spectrum.cell_re[c], line_spectrum.cell_im[c] = 0.0, 0.0
        for line in range(bundle.n_lines):
            if batch_bin <= lines.position[line] < batch_bin + LINE_BATCH_WIDTH_BINS:
                cell_position = (lines.position[line] - batch_bin) * cells_per_bin
                _spread_line_over_cells(
                    cell_position,
                    lines.re[line],
                    lines.im[line],
                    line_spectrum.cell_re,
                    line_spectrum.cell_im,
                )
        for n_periods in range(n_periods_min, n_periods_max + 1):
            _add_spectrum_of_cells(
                first_bin, n_bins, batch_bin, n_cells, n_periods, shape, layout, line_spectrum
            )


@njit(cache=True, error_model="numpy", borrows=True)
def _spread_line_over_cells(cell_position, re, im, cell_re, cell_im):
    """Add a line to the N_KERNEL_CELLS table cells around its position.

    At a distance of z cells the weight is I_0(b sqrt(1 - (2 z / N_KERNEL_CELLS)^2)) / I_0(b), with
    b = KERNEL_BETA (Kaiser-Bessel kernel [Fessler and Sutton 2003]). A polynomial approximates this
    weight.

    Parameters
    ----------
    cell_position : float
        Position of the line [cells] from the first bin of its interval, not negative. A line at 0
        is centred on the array element N_KERNEL_CELLS / 2 - 1.
    re, im : float
        Complex weight of the line [V]; squared magnitude and 0 if powers add.
    cell_re, cell_im : ndarray (cells,)
        Results: complex weights of the cells, to which those of the line are added. The next
        N_ZERO_WEIGHT_CELLS cells receive 0.
    """
    cell = np.uint64(math.floor(cell_position))
    cell_coordinate = 2.0 * (cell_position - math.floor(cell_position)) - 1.0
    for j in range(np.uint64(N_KERNEL_CELLS + N_ZERO_WEIGHT_CELLS)):
        weight = KERNEL_POLYNOMIALS[KERNEL_POLYNOMIAL_DEGREE, j]
        for d in range(KERNEL_POLYNOMIAL_DEGREE):
            weight = (
                weight * cell_coordinate + KERNEL_POLYNOMIALS[KERNEL_POLYNOMIAL_DEGREE - 1 - d, j]
            )
        cell_re[cell + j] += re * weight
        cell_im[cell + j] += im * weight


@njit(cache=True, error_model="numpy", borrows=True, forceinline=True)
def _first_bin_in_table(batch_bin, n_periods, layout):
    """Return the first bin that the tables of all lines in an interval contain.

    ``batch_bin`` is the first bin of the interval. ``n_periods`` is the number of FFT lengths by
    which the periodic spectrum is shifted.
    """
    return (
        batch_bin + n_periods * layout.fft_size + LINE_BATCH_WIDTH_BINS + LINE_BATCH_EDGE_BINS
    ) - layout.table_half_width_bins


@njit(cache=True, error_model="numpy", borrows=True, forceinline=True)
def _end_bin_in_table(batch_bin, n_periods, layout):
    """Return the bin after the last one that the tables of all lines in an interval contain.

    ``batch_bin`` is the first bin of the interval. ``n_periods`` is the number of FFT lengths by
    which the periodic spectrum is shifted.
    """
    return (
        batch_bin
        + n_periods * layout.fft_size
        - LINE_BATCH_EDGE_BINS
        + layout.table_half_width_bins
    )


@njit(cache=True, error_model="numpy", borrows=True, forceinline=True)
def _add_spectrum_of_cells(
    first_bin, n_bins, batch_bin, n_cells, n_periods, shape, layout, line_spectrum
):
    """Add the spectrum of the cells of one interval of lines to ``line_spectrum``.

    The spectrum in bin k is (-1)^(p L) sum_c w_c G(k - p N - x_c). Cell c has the weight w_c and
    the position x_c, and G is the line-shape table. N is the FFT size, L the number of samples. The
    spectrum is shifted by p FFT lengths. If powers add, the sign is always positive.

    Parameters
    ----------
    first_bin, n_bins : int
        First bin of the result, counted from the lines' origin, and number of bins.
    batch_bin : int
        First bin of the interval, counted from the lines' origin. The first cell lies
        N_KERNEL_CELLS / 2 - 1 cells below it.
    n_cells : int
        Number of cells with weights.
    n_periods : int
        Number p of FFT lengths by which the periodic spectrum is shifted.
    shape : LineShape
        Shape of the lines, with its table (:class:`sweep.model.spectrum.line_shape.LineShape`).
    layout : SpectrumLayout
        Sizes of spectrum and tables (:class:`sweep.model.spectrum.lines.SpectrumLayout`).
    line_spectrum : LineSpectrumWorkspace
        Weights of the cells in ``cell_re`` and ``cell_im``. The spectrum is added to ``re`` and
        ``im`` [V], or ``re`` [V^2] if powers add (:class:`LineSpectrumWorkspace`).
    """
    cells_per_bin, adds_powers = layout.cells_per_bin, layout.adds_powers
    n_columns = shape.table_re.size // cells_per_bin
    sign = -1.0 if n_periods & 1 and layout.record_length & 1 and not adds_powers else 1.0
    low = max(first_bin, _first_bin_in_table(batch_bin, n_periods, layout))
    high = min(first_bin + n_bins, _end_bin_in_table(batch_bin, n_periods, layout))
    begin_bin = batch_bin + n_periods * layout.fft_size - layout.table_half_width_bins
    if not layout.holds_all_bins and low >= high:
        return
    for c in range(n_cells):
        re, im = sign * line_spectrum.cell_re[c], sign * line_spectrum.cell_im[c]
        cell_index = c + 1 - N_KERNEL_CELLS // 2
        bin_, row = begin_bin + cell_index // cells_per_bin, cell_index % cells_per_bin
        if layout.holds_all_bins:
            low, high = max(first_bin, bin_), min(first_bin + n_bins, bin_ + n_columns)
        if low >= high or (re == 0.0 and im == 0.0):
            continue
        # Unsigned indices need no test for counting from an array's end.
        table_index = np.uint64(row * n_columns + low - bin_)
        spectrum_index = np.uint64(low - first_bin)
        if adds_powers:
            for i in range(np.uint64(high - low)):
                line_spectrum.re[spectrum_index + i] += re * shape.table_re[table_index + i]
        else:
            for i in range(np.uint64(high - low)):
                g, h = shape.table_re[table_index + i], shape.table_im[table_index + i]
                line_spectrum.re[spectrum_index + i] += re * g - im * h
                line_spectrum.im[spectrum_index + i] += re * h + im * g


@njit(cache=True, error_model="numpy", borrows=True)
def compute_end_amplitudes_and_far_lines(bundle, distance_min, log_accuracy, layout, line_spectrum):
    """Compute the lines' amplitudes at the record's ends, and equivalent lines for far bins.

    Far from the lines, a few equivalent lines (sources) give the same spectrum.

    Parameters
    ----------
    bundle
        :class:`LineBundle` of the lines in ``line_spectrum.lines``.
    distance_min
        Distance from the lines [bins] from which on the sources replace them.
    log_accuracy
        -ln of the relative error of the sources.
    layout
        :class:`SpectrumLayout`.
    line_spectrum
        :class:`LineSpectrumWorkspace`. Results are ``record_end_amplitudes``, and the sources in
        ``far_equivalent_lines``.

    Returns
    -------
    n_sources
        Number of sources.
    """
    adds_powers = layout.adds_powers
    half_record_ratio = 0.5 * layout.record_length / layout.fft_size
    lines, record_end_amplitudes, sources = (
        line_spectrum.lines,
        line_spectrum.record_end_amplitudes,
        line_spectrum.far_equivalent_lines,
    )
    for line in range(bundle.n_lines):
        sine, cosine = sincos_cycles(
            (2.0 if adds_powers else 1.0) * half_record_ratio * lines.position[line]
        )
        re, im = lines.re[line], lines.im[line]
        record_end_amplitudes.start_re[line] = re if adds_powers else re * cosine + im * sine
        record_end_amplitudes.start_im[line] = 0.0 if adds_powers else im * cosine - re * sine
        record_end_amplitudes.end_re[line] = re * cosine if adds_powers else re * cosine - im * sine
        record_end_amplitudes.end_im[line] = -re * sine if adds_powers else im * cosine + re * sine
    middle = 0.5 * (bundle.lowest_position + bundle.highest_position)
    half_width = 0.5 * (bundle.highest_position - bundle.lowest_position)
    n_sources = bundle.n_lines
    if half_width > 0.0:
        z = 1.0 + distance_min / half_width
        n_sources = 1 + int(log_accuracy / math.log(z + math.sqrt(z * z - 1.0)))
    elif bundle.n_lines > 1:
        n_sources = 1
    replace_lines_by_nodes(
        LineArrays(
            record_end_amplitudes.position,
            record_end_amplitudes.start_re,
            record_end_amplitudes.start_im,
        ),
        bundle.n_lines,
        n_sources,
        middle,
        half_width,
        line_spectrum.line_scratch,
        LineArrays(sources.position, sources.start_re, sources.start_im),
    )
    return replace_lines_by_nodes(
        LineArrays(
            record_end_amplitudes.position,
            record_end_amplitudes.end_re,
            record_end_amplitudes.end_im,
        ),
        bundle.n_lines,
        n_sources,
        middle,
        half_width,
        line_spectrum.line_scratch,
        LineArrays(sources.position, sources.end_re, sources.end_im),
    )


@njit(cache=True, error_model="numpy", borrows=True)
def far_line_weight(weight_sum, n_sources, layout, sources):
    """Return the total weight [V] of the lines as seen from bins far away.

    Parameters
    ----------
    weight_sum : float
        Sum of the magnitudes of the lines' weights [V], an upper limit of the result.
    n_sources : int
        Number of equivalent lines.
    layout : SpectrumLayout
        Sizes and type of the spectrum.
    sources : RecordEndAmplitudes
        Equivalent lines, with their amplitudes at both ends of the record.
    """
    start_sum, end_sum = 0.0, 0.0
    for source in range(n_sources):
        start_sum += math.hypot(sources.start_re[source], sources.start_im[source])
        end_sum += math.hypot(sources.end_re[source], sources.end_im[source])
    start_sum = max(start_sum, end_sum)
    return min(weight_sum, math.sqrt(start_sum) if layout.adds_powers else start_sum)


@njit(cache=True, error_model="numpy", borrows=True)
def tangent_of_bin(bin_, fft_size, bin_tangents):
    """Return tan(pi k / N) of any bin k, for the FFT size N.

    Parameters
    ----------
    bin_ : int
        Bin k, of either sign.
    fft_size : int
        FFT size N.
    bin_tangents : ndarray (N/2 + 1,)
        tan(pi k / N) of bins k = 0 .. N/2.
    """
    bin_ %= fft_size
    return bin_tangents[bin_] if 2 * bin_ <= fft_size else -bin_tangents[fft_size - bin_]


@njit(cache=True, error_model="numpy", borrows=True)
def prepare_far_bins(first_bin, n_bins, layout, bin_tangents, far_bins):
    """Compute tan(pi k / N) and exp(i pi k L / N) of a batch of bins k.

    N is the FFT size, L the number of samples.

    Parameters
    ----------
    first_bin : int
        First bin k.
    n_bins : int
        Number of bins, at most FAR_BINS_PER_BATCH.
    layout : SpectrumLayout
        Sizes of spectrum and tables (:class:`sweep.model.spectrum.lines.SpectrumLayout`).
    bin_tangents : ndarray (N/2 + 1,)
        tan(pi k / N) of bins k = 0 .. N/2, with the FFT size N.
    far_bins : FarBins
        Results are ``tangent``, ``phasor_re`` and ``phasor_im``.
    """
    fft_size = layout.fft_size
    k = first_bin % fft_size
    for i in range(n_bins):
        far_bins.tangent[i] = bin_tangents[k] if 2 * k <= fft_size else -bin_tangents[fft_size - k]
        k = k + 1 if k + 1 < fft_size else 0
    if fft_size == layout.record_length:
        for i in range(n_bins):
            far_bins.phasor_re[i], far_bins.phasor_im[i] = -1.0 if (first_bin + i) & 1 else 1.0, 0.0
        return
    for i in range(n_bins):
        sine, cosine = sincos_cycles(0.5 * (first_bin + i) * layout.record_length / fft_size)
        far_bins.phasor_re[i], far_bins.phasor_im[i] = cosine, sine


@njit(cache=True, error_model="numpy", borrows=True, forceinline=True)
def add_line_by_record_ends(
    begin_offset,
    end_offset,
    spectrum_offset,
    strengths,
    line,
    log_accuracy,
    ends,
    layout,
    line_spectrum,
):
    """Add the spectrum of one line in bins far from this line to ``line_spectrum``.

    The line may be an equivalent line.

    Parameters
    ----------
    begin_offset, end_offset
        First bin, and the bin after the last, in the batch ``line_spectrum.far_bins``.
    spectrum_offset
        Index of the first bin in ``re`` and ``im`` of ``line_spectrum``, the spectrum F.
    strengths
        :class:`RecordEndAmplitudes` of lines or sources.
    line
        Index of the line or source.
    log_accuracy
        -ln of the relative error of the polynomials, which are truncated accordingly.
    ends
        :class:`sweep.model.spectrum.line_shape.EndPolynomials` A and B.
    layout
        :class:`SpectrumLayout`.
    line_spectrum
        :class:`LineSpectrumWorkspace`.

    Notes
    -----
    The line at nu bins has the amplitudes a and b at the two ends of the record. r is the number
    of samples over the FFT size N. In bin k, with c = cot(pi (k - nu) / N),

        F(k) += e^{i pi r k} a A(c) - e^{-i pi r k} b B(c).

    If powers add, F is |A|^2 + |B|^2 - 2 Re(e^{2 i pi r (k - nu)} A conj B), times a = |C|^2.
    """
    far_bins, relative_cut = line_spectrum.far_bins, math.exp(-log_accuracy)
    a_re, a_im = strengths.start_re[line], strengths.start_im[line]
    b_re, b_im = strengths.end_re[line], strengths.end_im[line]
    line_tangent = math.tan(math.pi * strengths.position[line] / layout.fft_size)
    begin, stop = np.uint64(begin_offset), np.uint64(end_offset)
    shift = np.uint64(spectrum_offset - begin_offset)
    for i in range(begin, stop):
        far_bins.cotangent[i] = (1.0 + far_bins.tangent[i] * line_tangent) / (
            far_bins.tangent[i] - line_tangent
        )
    cotangent_max = 0.0
    for i in range(begin, stop):
        cotangent_max = max(cotangent_max, abs(far_bins.cotangent[i]))
    degree, factor, term_max = 0, 1.0, 0.0
    for d in range(N_END_POLYNOMIAL_COEFFICIENTS):
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
            u, v = far_bins.phasor_re[i], far_bins.phasor_im[i]
            u, v = u * u - v * v, 2.0 * u * v
            u, v = u * b_re - v * b_im, u * b_im + v * b_re
            line_spectrum.re[shift + i] += a_re * (p * p + q * q + r * r + s * s) - 2.0 * (
                u * (p * r + q * s) - v * (q * r - p * s)
            )
        return
    for i in range(begin, stop):
        u_re = a_re * far_bins.start_re[i] - a_im * far_bins.start_im[i]
        u_im = a_re * far_bins.start_im[i] + a_im * far_bins.start_re[i]
        v_re = b_re * far_bins.end_re[i] - b_im * far_bins.end_im[i]
        v_im = b_re * far_bins.end_im[i] + b_im * far_bins.end_re[i]
        c, s = far_bins.phasor_re[i], far_bins.phasor_im[i]
        line_spectrum.re[shift + i] += c * (u_re - v_re) - s * (u_im + v_im)
        line_spectrum.im[shift + i] += c * (u_im - v_im) + s * (u_re + v_re)


@njit(cache=True, error_model="numpy", borrows=True, inline="always")
def compute_line_spectrum(
    first_bin, n_bins, bundle, negligible_ratio, shape, layout, bin_tangents, line_spectrum
):
    """Fill ``re`` and ``im`` of ``line_spectrum`` with the lines' spectrum F in ``n_bins`` bins.

    Parameters
    ----------
    first_bin
        First bin, counted from the lines' origin.
    n_bins
        Number of bins; up to seven more are computed.
    bundle
        :class:`LineBundle` of the lines in ``line_spectrum.lines``.
    negligible_ratio
        Allowed error of F over the sum of the lines' amplitudes.
    shape
        :class:`sweep.model.spectrum.line_shape.LineShape`.
    layout
        :class:`SpectrumLayout`.
    bin_tangents
        tan(pi k / N) of bins k = 0 .. N/2, with the FFT size N.
    line_spectrum
        :class:`LineSpectrumWorkspace`.
    """
    lowest_position, highest_position = bundle.lowest_position, bundle.highest_position
    n_bins = (n_bins + 7) // 8 * 8  # whole vectors: a remainder takes as long
    for i in range(n_bins):
        line_spectrum.re[i], line_spectrum.im[i] = 0.0, 0.0
    add_lines_by_table(first_bin, n_bins, bundle, shape, layout, line_spectrum)
    table_reach = layout.table_half_width_bins - TABLE_SHORTFALL_BINS  # from any line
    if layout.holds_all_bins or (
        highest_position - first_bin < table_reach
        and first_bin + n_bins - lowest_position < table_reach
    ):
        return
    log_accuracy = FAR_LINE_LOG_ACCURACY
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
    n_sources = compute_end_amplitudes_and_far_lines(
        bundle, source_distance, log_accuracy, layout, line_spectrum
    )
    polynomial_log_accuracy = log_accuracy + FAR_LINE_EXTRA_LOG_ACCURACY
    # In some bins the table holds some lines and not others. Sources serve all bins but these.
    first_batch_bin = math.floor(lowest_position)
    last_batch_bin = (
        first_batch_bin
        + (math.floor(highest_position) - first_batch_bin)
        // LINE_BATCH_WIDTH_BINS
        * LINE_BATCH_WIDTH_BINS
    )
    current, end_bin = first_bin, first_bin + n_bins
    while current < end_bin:
        stop, is_in_part_of_table = min(current + FAR_BINS_PER_BATCH, end_bin), False
        for n_periods in range(-1, 2):
            low = _first_bin_in_table(first_batch_bin, n_periods, layout)
            high = _end_bin_in_table(last_batch_bin, n_periods, layout)
            is_in_part_of_table |= low <= current < high
            stop = (
                min(stop, low) if low > current else (min(stop, high) if high > current else stop)
            )
        is_far = not is_in_part_of_table
        if is_far or last_batch_bin > first_batch_bin:
            prepare_far_bins(current, stop - current, layout, bin_tangents, line_spectrum.far_bins)
        if is_far:
            for source in range(n_sources):
                add_line_by_record_ends(
                    INTEGER_ZERO,
                    stop - current,
                    current - first_bin,
                    line_spectrum.far_equivalent_lines,
                    source,
                    polynomial_log_accuracy,
                    shape.end_polynomials,
                    layout,
                    line_spectrum,
                )
        elif last_batch_bin > first_batch_bin:
            for line in range(bundle.n_lines):  # the bins that the table does not hold for it
                batch_bin = (
                    first_batch_bin
                    + int(line_spectrum.lines.position[line] - first_batch_bin)
                    // LINE_BATCH_WIDTH_BINS
                    * LINE_BATCH_WIDTH_BINS
                )
                start = current
                for n_periods in range(-1, 3):
                    table_begin = _first_bin_in_table(batch_bin, n_periods, layout)
                    until = min(table_begin, stop) if n_periods < 2 else stop
                    if start < until:
                        add_line_by_record_ends(
                            start - current,
                            until - current,
                            start - first_bin,
                            line_spectrum.record_end_amplitudes,
                            line,
                            polynomial_log_accuracy,
                            shape.end_polynomials,
                            layout,
                            line_spectrum,
                        )
                    start = max(start, _end_bin_in_table(batch_bin, n_periods, layout))
        current = stop


@njit(cache=True, error_model="numpy", borrows=True)
def bins_to_nearest_line(first_bin, n_bins, lowest_position, highest_position, fft_size):
    """Return the smallest distance [bins] between a range of bins and the lines.

    The result is 0 if the range reaches between the lines. Distances are measured around the circle
    of all bins.

    Parameters
    ----------
    first_bin : int
        First bin, counted from the lines' origin.
    n_bins : int
        Number of bins.
    lowest_position, highest_position : float
        Lowest and highest line [bins from the lines' origin].
    fft_size : int
        FFT size N, the number of bins on the circle.
    """
    centre_distance = first_bin + 0.5 * (n_bins - 1) - 0.5 * (lowest_position + highest_position)
    centre_distance = abs(centre_distance - fft_size * np.rint(centre_distance / fft_size))
    return max(
        centre_distance - 0.5 * (n_bins - 1) - 0.5 * (highest_position - lowest_position), 0.0
    )


@njit(cache=True, error_model="numpy", borrows=True)
def envelope_index(distance, envelope):
    """Return the index of the largest tabulated distance that does not exceed a given one.

    Parameters
    ----------
    distance : float
        Distance from a line [bins of fs/N], with the sample rate fs and the FFT size N.
    envelope : LineEnvelope
        Envelope with m tabulated distances in rising order
        (:class:`sweep.model.spectrum.line_shape.LineEnvelope`).

    Returns
    -------
    int
        Index, 0 .. m - 1; 0 also for a distance below all of them.
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
    first_bin, n_bins, bundle, negligible_ratio, shifts, shape, layout, bin_tangents, workspace
):
    """Compute the magnitude of the spectrum in ``n_bins`` bins, into ``workspace.span.magnitude``.

    Parameters
    ----------
    first_bin : int
        First bin, counted from DC.
    n_bins : int
        Number of bins.
    bundle : LineBundle
        Number, range and total weight of the lines, which are in ``workspace.line_spectrum.lines``.
    negligible_ratio : float
        Allowed error of |X| over the sum of the lines' amplitudes.
    shifts : AveragingShifts
        Frequency shifts over which |X|^2 is averaged; empty for no average.
    shape : LineShape
        Shape of the lines (:class:`sweep.model.spectrum.line_shape.LineShape`).
    layout : SpectrumLayout
        Sizes of spectrum and tables (:class:`sweep.model.spectrum.lines.SpectrumLayout`).
    bin_tangents : ndarray (N/2 + 1,)
        tan(pi k / N) of bins k = 0 .. N/2, with the FFT size N.
    workspace : SpectrumWorkspace
        Lines and scratch arrays. The result is ``span.magnitude``, |X| [V, summed over the record]
        of each bin without noise.
    """
    line_spectrum, span = workspace.line_spectrum, workspace.span
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
                line_spectrum.lines.position[line] += shift
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
            first_spectrum_bin = (
                first_bin - bundle.origin_bin
                if direction > 0
                else 1 - first_bin - n_bins - bundle.origin_bin
            )
            if image_pass == 1:
                image_distance = bins_to_nearest_line(
                    first_spectrum_bin,
                    n_bins,
                    shifted_bundle.lowest_position,
                    shifted_bundle.highest_position,
                    layout.fft_size,
                )
                image_index = envelope_index(image_distance, shape.envelope)
                if shape.envelope.magnitude[image_index] <= negligible_ratio:
                    continue
            compute_line_spectrum(
                first_spectrum_bin,
                n_bins,
                shifted_bundle,
                negligible_ratio,
                shape,
                layout,
                bin_tangents,
                line_spectrum,
            )
            for i in range(n_bins):
                j = i if direction > 0 else n_bins - 1 - i
                re, im = line_spectrum.re[j], direction * line_spectrum.im[j]
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
                line_spectrum.lines.position[line] -= shift
    square = workspace.mean_square if is_averaged else span.magnitude
    for i in range(n_bins):
        span.magnitude[i] = math.sqrt(max(square[i], 0.0))


@njit(cache=True, error_model="numpy", borrows=True)
def falloff_distance(level, weight_sum, envelope):
    """Return the distance [bins] from the lines beyond which their spectrum stays below a level.

    The result is infinite if the lines exceed the level at any distance.

    Parameters
    ----------
    level : float
        Magnitude |X| [V].
    weight_sum : float
        Sum of the magnitudes of the lines' weights [V].
    envelope : LineEnvelope
        Upper envelope of a line's spectrum
        (:class:`sweep.model.spectrum.line_shape.LineEnvelope`).
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
    """Return true if a real record shows lines of negative frequency at the opposite frequency.

    The middle of the lines' range decides.

    Parameters
    ----------
    origin_bin : int
        Bin from which positions of lines count.
    lowest_position, highest_position : float
        Lowest and highest line [bins from ``origin_bin``].
    spectrum_type : int
        Type of the spectrum, such as COMPLEX_RECORD, whose lines are never mirrored.
    """
    return (
        origin_bin + 0.5 * (lowest_position + highest_position) < 0.0
        and spectrum_type != COMPLEX_RECORD
    )


@njit(cache=True, error_model="numpy", borrows=True)
def folded_line_range(origin_bin, lowest_position, highest_position, layout):
    """Return the :class:`FoldedLineRange` of lines, in bins from DC.

    Parameters
    ----------
    origin_bin : int
        Bin from which positions of lines count.
    lowest_position, highest_position : float
        Lowest and highest line [bins from ``origin_bin``].
    layout : SpectrumLayout
        Sizes and type of the spectrum.
    """
    if is_mirrored(origin_bin, lowest_position, highest_position, layout.spectrum_type):
        return FoldedLineRange(-origin_bin - highest_position, -origin_bin - lowest_position)
    return FoldedLineRange(origin_bin + lowest_position, origin_bin + highest_position)


@njit(cache=True, error_model="numpy", borrows=True)
def bins_around_lines(margin_bins, folded_range, layout):
    """Return the :class:`BinRange` around lines, with a margin of bins below and above them.

    If the margin extends beyond DC or Nyquist, the part beyond is folded back.

    Parameters
    ----------
    margin_bins : float
        Number of bins below the lowest line, and above the highest one.
    folded_range : FoldedLineRange
        Range of the lines after negative frequencies are folded at DC [bins].
    layout : SpectrumLayout
        Sizes and type of the spectrum.
    """
    fft_size, nyquist_bin = layout.fft_size, layout.fft_size // 2
    margin_bins = min(margin_bins, 2.0 * fft_size)
    first_bin = math.floor(folded_range.lowest_position - margin_bins)
    last_bin = math.ceil(folded_range.highest_position + margin_bins)
    if layout.spectrum_type == COMPLEX_RECORD:
        if last_bin - first_bin >= fft_size:
            first_bin = (first_bin + last_bin + 1 - fft_size) // 2
        return BinRange(first_bin, min(last_bin, first_bin + fft_size - 1))
    if first_bin < 0:
        last_bin = max(last_bin, -first_bin)
    if last_bin > nyquist_bin:
        first_bin = min(first_bin, fft_size - last_bin)
    return BinRange(
        min(max(first_bin, INTEGER_ZERO), nyquist_bin),
        max(min(last_bin, nyquist_bin), INTEGER_ZERO),
    )


@njit(cache=True, error_model="numpy", borrows=True)
def falloff_distance_with_images(level, weight_sum, folded_range, envelope, layout):
    """Return the distance [bins] beyond which the spectrum of lines and images is below a level.

    Parameters
    ----------
    level : float
        Magnitude |X| [V].
    weight_sum : float
        Sum of the magnitudes of the lines' weights [V].
    folded_range : FoldedLineRange
        Range of the lines after negative frequencies are folded at DC [bins].
    envelope : LineEnvelope
        Upper envelope of a line's spectrum.
    layout : SpectrumLayout
        Sizes and type of the spectrum.
    """
    if layout.spectrum_type == REAL_WITH_IMAGES:
        image_distance = min(
            folded_range.lowest_position, 0.5 * layout.fft_size - folded_range.highest_position
        )  # no bin is nearer to an image
        level_fraction = (
            0.5 if image_distance < falloff_distance(0.1 * level, weight_sum, envelope) else 0.9
        )
        return falloff_distance(level_fraction * level, weight_sum, envelope) + 1.0
    return falloff_distance(level, weight_sum, envelope) + 1.0


@njit(cache=True, error_model="numpy", borrows=True, inline="always")
def detect_in_span(
    bundle,
    negligible_magnitude,
    threshold,
    lowest_level,
    lobe_half_width,
    shifts,
    shape,
    layout,
    bin_tangents,
    workspace,
):
    """Compute the spectrum in the bins around a segment's lines, and detect the echo in these bins.

    Parameters
    ----------
    bundle
        :class:`LineBundle` of the lines in ``workspace.line_spectrum.lines``.
    negligible_magnitude
        Largest |X| of images that may be left out [V, summed over the record].
    threshold
        Threshold on |X| [V].
    lowest_level
        |X| [V] below which bins may be left out. If no bin reaches this level, only bins that are
        certainly smaller than the largest one are left out.
    lobe_half_width
        Half-width of the echo's main lobe or pedestal [bins]. Bins within this distance of a strong
        bin are exempt (:func:`sweep.model.detection.echo_detection.mark_exempt_bins`). 0 if only
        the strongest bin may detect the echo.
    shifts
        :class:`AveragingShifts`.
    shape
        :class:`sweep.model.spectrum.line_shape.LineShape`.
    layout
        :class:`SpectrumLayout`.
    bin_tangents
        tan(pi k / N) of bins k = 0 .. N/2, with the FFT size N.
    workspace
        :class:`SpectrumWorkspace`, whose ``span.magnitude`` and ``span.is_exempt`` are results.

    Returns
    -------
    DetectedSpan
        Bins around the lines, and the detection in them. No leakage is computed:
        ``raised_bin_probability_max`` is 1, and ``leakage_probability`` 0.
    """
    span, weight_sum = workspace.span, bundle.weight_sum
    is_complex = layout.spectrum_type == COMPLEX_RECORD
    n_bins_max = layout.fft_size if is_complex else layout.fft_size // 2 + 1
    shift_min, shift_max = 0.0, 0.0
    for m in range(shifts.offset.size):
        shift_min, shift_max = min(shift_min, shifts.offset[m]), max(shift_max, shifts.offset[m])
    folded_range = folded_line_range(
        bundle.origin_bin,
        bundle.lowest_position + shift_min,
        bundle.highest_position + shift_max,
        layout,
    )
    margin_bins = falloff_distance_with_images(
        lowest_level, weight_sum, folded_range, shape.envelope, layout
    )
    if not lowest_level > 0.0:
        margin_bins = np.inf
    elif (
        not layout.holds_all_bins
        and margin_bins > 2 * layout.clearance_bins
        and bundle.n_lines > 1
        and shifts.offset.size == 0
    ):
        n_sources = compute_end_amplitudes_and_far_lines(
            bundle,
            float(layout.clearance_bins),
            FAR_LINE_LOG_ACCURACY,
            layout,
            workspace.line_spectrum,
        )
        far_weight = far_line_weight(
            weight_sum, n_sources, layout, workspace.line_spectrum.far_equivalent_lines
        )
        margin_bins = max(
            falloff_distance_with_images(
                lowest_level, far_weight, folded_range, shape.envelope, layout
            ),
            2.0 * layout.clearance_bins,
        )
    negligible_ratio = negligible_magnitude / max(weight_sum, 1e-300)
    margin_bins = max(margin_bins, 2.0 * lobe_half_width)  # main lobes of bins of half the largest
    while True:
        bins = bins_around_lines(margin_bins, folded_range, layout)
        n_bins = bins.last_bin - bins.first_bin + 1
        compute_magnitudes(
            bins.first_bin,
            n_bins,
            bundle,
            negligible_ratio,
            shifts,
            shape,
            layout,
            bin_tangents,
            workspace,
        )
        peak_index, n_exempt = mark_exempt_bins(
            span.magnitude, n_bins, threshold, span.is_exempt, lobe_half_width
        )
        largest = span.magnitude[peak_index]
        if largest >= lowest_level or n_bins >= n_bins_max:
            return DetectedSpan(bins.first_bin, n_bins, peak_index, n_exempt, 0.0, 1.0)
        margin_needed = falloff_distance_with_images(
            largest, weight_sum, folded_range, shape.envelope, layout
        )
        if margin_needed <= margin_bins:
            return DetectedSpan(bins.first_bin, n_bins, peak_index, n_exempt, 0.0, 1.0)
        margin_bins = margin_needed
