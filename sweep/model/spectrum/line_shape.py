"""Line shape: the spectrum of one line of amplitude 1 in the bins around it.

All lines of a segment share the window and the phase error psi(t) of the record, so they share one
shape. Let x = -1 .. 1 be the position in the record of L samples, w the window, N the FFT size and
fs the sample rate. With r = L/N and a distance of y bins of fs/N,

    G(y) = sum_n w(x_n) exp(2 pi i psi(x_n)) exp(-i pi r y x_n)

whose phase counts from the middle of the record. G has three representations:

- **A table** of G, or of |G|^2 if powers of lines add, at cells of 1/2 (1/4) bin, out to some bins
  on either side. Each line is spread over the fourteen cells around it by a Kaiser-Bessel kernel,
  as in non-uniform FFTs [Fessler and Sutton 2003]. The table is divided by the kernel's transform.
  The error is 1e-12 of the peak.
- **Beyond the table** the two ends of the record alone determine G. With c = cot(pi y / N),

      G(y) = e^{i pi r y} A(c) - e^{-i pi r y} B(c)

  where the polynomials A and B follow from the derivatives of w exp(2 pi i psi) at the start and at
  the end, because sum_n n^j e^{-i theta n} is a polynomial in cot(theta / 2).
- **An envelope**: the largest |G| from each distance on.

A phase error is the sum of a shift of the line, by its mean slope, and of a few Chebyshev modes:
exp(2 pi i psi) = sum_j a_j T_j(x). All of the above is linear in a_j, so each shape is a sum over
modes of tables that are computed once for a window. Phase errors with too many modes, windows that
are no sum of cosines, and short or heavily padded records have a table of all bins, by one FFT.

An echo that arrives after the start of the record (a late echo) has only the last L' samples. They
form a record of their own, whose window is the end of the full window. With the position x' = -1 ..
1 in this record, w exp(2 pi i psi) is smooth and has few Chebyshev modes. The transform of a mode
depends on the product of y and L' alone. It is tabulated once for all windows and lengths, and
interpolated. The far sidelobes fall as 1/y, as the window begins with a step
(:func:`build_late_line_shape`).
"""

import math
from fractions import Fraction
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.polynomial.chebyshev import cheb2poly, chebfit
from scipy.special import i0, roots_legendre

from sweep.kernel_cache import njit
from sweep.model.elementary_functions import sincos_cycles
from sweep.model.spectrum.lines import SpectrumLayout
from sweep.model.window import COSINE_SUM_COEFFICIENTS, Window, window_samples

TABLE_CELLS_PER_BIN = (2, 4)
"""Numbers of table cells per bin of width fs/N, with the sample rate fs and the FFT size N. The
first is for lines whose amplitudes add, the second for lines whose powers add."""

N_KERNEL_CELLS = 14
"""Number of table cells over which a line is spread: cells -6 .. 7 for a line between cells 0 and
1."""

KERNEL_BETA = 32.32432
"""Parameter b of the Kaiser-Bessel kernel that spreads a line over table cells. At a distance of z
cells it is I_0(b sqrt(1 - (2 z / N_KERNEL_CELLS)^2)) / I_0(b)."""

DECONVOLUTION_TAPS = np.array([
    27.059814524108916, -24.069297462538476, 18.21886188994693, -12.301303141361002,
    7.584228285544723, -4.313600790782408, 2.270108868623467, -1.1041027145184494,
    0.49429836881691397, -0.2024309201966936, 0.07519960545439297, -0.025063737807734597,
    0.007388544649665242, -0.0018900276225103194, 0.0004085782830266439, -7.179287548481712e-05,
    9.634021822884657e-06, -8.798393952475983e-07, 4.1136322681806606e-08,
])  # fmt: skip
"""Coefficients of a symmetric filter over table cells that divides a table by the kernel's
transform. Its relative error is 1e-13 below a phase of pi / 2 per cell."""


class LineShapeTier(NamedTuple):
    """Sizes of line-shape tables, for phase errors of up to ``n_modes_max`` Chebyshev modes.

    Distances are in bins of fs/L, with the sample rate fs and L samples in the record.
    """

    n_modes_max: int
    """Maximum number of Chebyshev modes of exp(2 pi i psi), with the phase error psi [cycles]."""
    clearance_bins: int
    """Distance from the line beyond which the record's ends alone determine the shape."""
    table_half_width_bins: int
    """Distance from the line up to which a table holds the shape, if few points share it."""


LINE_SHAPE_TIERS = (
    LineShapeTier(24, 20, 64),
    LineShapeTier(48, 56, 96),
    LineShapeTier(128, 200, 256),
)
"""Sizes of line-shape tables, from few modes to many. A line shape uses the first tier with enough
modes."""

SHARED_TABLE_HALF_WIDTH_BINS = 256
"""Half-width of a line-shape table that many points share, enough for wide footprints. The unit is
fs/L, with the sample rate fs and L samples in the record."""

END_DERIVATIVE_ORDER_MAX = 12
"""Highest order of the derivatives at the record's ends from which a line's spectrum far from the
line is computed."""

N_END_POLYNOMIAL_COEFFICIENTS = END_DERIVATIVE_ORDER_MAX + 2
"""Number of coefficients of each of two polynomials that give a line's spectrum far from the line.
One follows from the start of the record, the other from its end (:class:`EndPolynomials`)."""

MODE_COEFFICIENT_MIN = 1e-13
"""Smallest Chebyshev coefficient of a phase error's phasor that counts as a mode. The last modes
with smaller coefficients are left out. The phasor has magnitude 1."""

_RECORD_LENGTH_MIN, _PADDING_MAX = 4096, 8
"""Least number of samples, and largest padding (FFT size over samples), for which a sum over the
samples is computed as an integral."""

_N_FAR_DISTANCES = 48
"""Number of distances beyond a line-shape table, up to half the FFT size, at which the envelope of
the line's spectrum is stored."""

_ENVELOPE_MARGIN = 1.05
"""Safety factor on the envelope of a line's spectrum. It covers maxima between table cells."""

_TAP_REACH_CELLS = DECONVOLUTION_TAPS.size - 1
"""Number of extra cells on each side of a table that DECONVOLUTION_TAPS needs."""

KERNEL_POLYNOMIAL_DEGREE = 13
"""Degree of the polynomials that approximate the spreading kernel within a cell."""

N_ZERO_WEIGHT_CELLS = 2
"""Number of cells of weight 0 after the N_KERNEL_CELLS cells of a line, which fill the processor's
vectors."""

ECHO_LENGTH_CLASS_RATIO = math.sqrt(2.0)
"""Largest ratio between the numbers of samples of two late echoes that share a line-shape table. A
late echo fills only the last samples of its record."""

_LATE_ECHO_SAMPLES_PER_BIN_MIN = 16
"""Least number of samples of a late echo per bin of its table, whose bins are fs/L' wide for the
echo's L' samples. With so many samples, a sum over samples is an integral with six Euler-Maclaurin
corrections."""

_LATE_ECHO_TABLE_MARGIN_BINS = 16
"""Number of extra bins in the table of a late echo, for lines that are spread together. The bins
are fs/L' wide for the echo's L' samples. The extra bins follow the distance beyond which the
record's ends determine the shape."""

_LATE_ECHO_PADDING_FACTOR_MAX = 16
"""Largest ratio of FFT size to a late echo's samples at which its line shape is a sum of modes."""

_LATE_ECHO_TABLE_VALUES_PER_BIN = 2
"""Number of tabulated values of a late echo's line shape per bin. Bins are fs/L' wide for the
echo's L' samples."""

EULER_MACLAURIN_COEFFICIENTS = {
    1: 1 / 12, 3: -1 / 720, 5: 1 / 30240, 7: -1 / 1209600, 9: 1 / 47900160,
    11: -691 / 1307674368000,
}  # fmt: skip
"""Coefficients B_(m+1) / (m+1)! of the Euler-Maclaurin formula, by the order m of the derivative at
the ends. B are the Bernoulli numbers."""

_EULER_MACLAURIN_ORDER_MAX = max(EULER_MACLAURIN_COEFFICIENTS)


class EndPolynomials(NamedTuple):
    """Coefficients of two polynomials that give a line's spectrum far from the line.

    A is of the record's start, B of its end. Their variable is cot(pi y / N) at y bins from the
    line, N being the FFT size. The lowest power is first.
    """

    start_re: np.ndarray
    """(..., N_END_POLYNOMIAL_COEFFICIENTS): real part of the coefficients of A, of the record's
    start."""
    start_im: np.ndarray
    """(..., N_END_POLYNOMIAL_COEFFICIENTS): imaginary part of the coefficients of A, of the
    record's start."""
    end_re: np.ndarray
    """(..., N_END_POLYNOMIAL_COEFFICIENTS): real part of the coefficients of B, of the record's
    end."""
    end_im: np.ndarray
    """(..., N_END_POLYNOMIAL_COEFFICIENTS): imaginary part of the coefficients of B, of the
    record's end."""


class LineEnvelope(NamedTuple):
    """Upper envelope of the spectrum of a line of amplitude 1, at m distances from the line."""

    distance: np.ndarray
    """(m,): distance from the line [bins of width fs/N]; the same for all segments."""
    magnitude: np.ndarray
    """(..., m): largest magnitude of the line's spectrum at ``distance`` or farther."""
    square_integral: np.ndarray
    """(..., m): upper bound of the integral of the squared magnitude from ``distance`` on [bins].
    """


class LineShape(NamedTuple):
    """Spectrum of a line of amplitude 1, for one segment, or for all with a leading dimension."""

    table_re: np.ndarray
    """(..., cells * columns): real part of the line's spectrum by cell within a bin, then by bin.
    It is divided by the transform of the spreading kernel. If powers add, it is the squared
    magnitude.
    """
    table_im: np.ndarray
    """(..., cells * columns): imaginary part of the line's spectrum; 0 if powers add."""
    envelope: LineEnvelope
    """Upper envelope of the magnitude of the line's spectrum."""
    end_polynomials: EndPolynomials
    """Polynomials for the spectrum far from the line; unused if the table holds all bins."""


class PhaseErrorModes(NamedTuple):
    """Chebyshev coefficients of exp(2 pi i psi), for the phase error psi [cycles] of each shape."""

    line_shift: np.ndarray
    """(segments, shapes): frequency shift of the line by the mean phase slope [bins of fs/L]."""
    re: np.ndarray
    """(segments, shapes, modes): real part of the Chebyshev coefficients."""
    im: np.ndarray
    """(segments, shapes, modes): imaginary part of the Chebyshev coefficients."""
    n_modes: np.ndarray
    """(segments, shapes) int64: number of coefficients that are not negligible; 0 if the arrays are
    too short for them."""

    def select(self, is_selected: np.ndarray) -> "PhaseErrorModes":
        """Return the modes of the shapes for which ``is_selected`` is true."""
        return PhaseErrorModes(*(np.ascontiguousarray(values[:, is_selected]) for values in self))


def zero_phase_error_modes(segments: int, n_shapes: int, n_modes_max: int) -> PhaseErrorModes:
    """Allocate :class:`PhaseErrorModes` with all values 0.

    Parameters
    ----------
    segments : int
        Number of segments.
    n_shapes : int
        Number of line shapes of each segment.
    n_modes_max : int
        Number of Chebyshev modes for which there is room.
    """
    shape = segments, n_shapes
    return PhaseErrorModes(
        np.zeros(shape),
        np.zeros((*shape, n_modes_max)),
        np.zeros((*shape, n_modes_max)),
        np.zeros(shape, np.int64),
    )


class LineShapeTables(NamedTuple):
    """Tables of one window and FFT size from which the line shapes of segments are computed."""

    layout: SpectrumLayout
    """Sizes of the spectrum and of a line-shape table."""
    chebyshev_transforms: np.ndarray
    """(modes, places): Fourier transform of each Chebyshev mode times the window, in which both
    ends of the record count half. It is real for even modes; for odd modes it is the imaginary
    part.

    Places are the table's cells, at :func:`_table_cell_distances`. If amplitudes add, additional
    places hold each mode's part of :attr:`LineShape.table_re`. For late echoes, the array is that
    of :class:`LateModeTransforms`."""
    first_sample_cosine: np.ndarray
    """(places,): the window's first sample times cos(pi L y / N) at y bins from the line. L is the
    number of samples, N the FFT size. The array is empty for late echoes.
    """
    first_sample_sine: np.ndarray
    """(places,): the window's first sample times sin(pi L y / N) at y bins from the line. L is the
    number of samples, N the FFT size. The array is empty for late echoes.
    """
    mode_end_polynomials: EndPolynomials
    """(modes, N_END_POLYNOMIAL_COEFFICIENTS) in each field: for each Chebyshev mode, the
    coefficients of the polynomials that give its spectrum far from the line."""
    envelope_distance: np.ndarray
    """(m,): distances from the line at which envelopes are tabulated [bins of fs/N]."""
    cotangent_at_envelope_distance: np.ndarray
    """(m,): cot(pi d / N) of each ``envelope_distance`` d, with the FFT size N."""
    full_table_re: np.ndarray
    """(segments, cells * columns): :attr:`LineShape.table_re` of each segment's line shape, if the
    tables hold all bins; otherwise empty.
    """
    full_table_im: np.ndarray
    """(segments, cells * columns): :attr:`LineShape.table_im` of each segment's line shape, if the
    tables hold all bins; otherwise empty.
    """
    full_envelope: LineEnvelope
    """(segments, m): envelope of each segment's line shape, if the tables hold all bins; otherwise
    empty."""
    echo_lengths: np.ndarray
    """(segments, shapes) int64: number of samples of the echo, for late echoes with mode sums. The
    array is empty for other tables. A late echo fills only the last samples of its record.
    """
    taylor_coefficients: np.ndarray
    """(modes, END_DERIVATIVE_ORDER_MAX + 1): Taylor coefficients, about the time at which the
    record ends, of each mode of late echoes times the window. The array is empty for other tables.
    """


_NO_END_POLYNOMIALS = EndPolynomials(*(np.empty((0, 1)) for _ in EndPolynomials._fields))
_NO_LINE_SHAPE_TABLE = np.empty((0, 0))
_NO_ECHO_LENGTHS = np.empty((0, 0), np.int64)


def _empty_full_envelope(distance: np.ndarray) -> LineEnvelope:
    """Return an empty :class:`LineEnvelope` for tables that do not hold all bins."""
    return LineEnvelope(distance, _NO_LINE_SHAPE_TABLE, _NO_LINE_SHAPE_TABLE)


_gauss_legendre = lru_cache(maxsize=8)(roots_legendre)


@lru_cache(maxsize=24)
def line_shape_tables(
    window: Window, fft_size: int, adds_powers: bool, tier: int, *, shared: bool = True
) -> LineShapeTables:
    """Prepare the tables for line shapes that are sums of Chebyshev modes.

    Parameters
    ----------
    window
        Window of the record.
    fft_size
        FFT size N.
    adds_powers
        True if the powers of lines add, False if their amplitudes do.
    tier
        Index in :data:`LINE_SHAPE_TIERS`.
    shared
        True if many points share a shape, which then has a wide table.
    """
    n_modes, clearance_bins, table_half_width = LINE_SHAPE_TIERS[tier]
    table_half_width = SHARED_TABLE_HALF_WIDTH_BINS if shared else table_half_width
    ratio, length = window.length / fft_size, window.length
    table_half_width_bins = math.ceil(table_half_width / ratio)
    cell_density, cell_distances = (
        TABLE_CELLS_PER_BIN[adds_powers],
        _table_cell_distances(table_half_width_bins, adds_powers),
    )
    n_nodes = 4 * ((math.ceil(math.pi * table_half_width) + n_modes) // 4) + 64
    node, weight = _gauss_legendre(n_nodes)
    cosine_coefficients = np.array(
        [float(coefficient) for coefficient in COSINE_SUM_COEFFICIENTS[window.name]]
    )
    w = np.cos(np.pi * np.outer(node, np.arange(cosine_coefficients.size))) @ np.diag(
        cosine_coefficients
    )
    weighted_modes = np.cos(np.outer(np.arange(n_modes), np.arccos(node))) * (
        w.sum(axis=1) * weight * length / 2
    )
    chebyshev_transforms = _chebyshev_fourier_integrals(
        weighted_modes, node, ratio * cell_distances
    )
    taylor_coefficients = _taylor_coefficients(COSINE_SUM_COEFFICIENTS[window.name], n_modes)
    chebyshev_transforms += _euler_maclaurin_corrections(
        taylor_coefficients, ratio * cell_distances, length
    )
    first_sample_cosine, first_sample_sine = (
        taylor_coefficients[0, 0] * circular_function(np.pi * ratio * cell_distances)
        for circular_function in (np.cos, np.sin)
    )
    if not adds_powers:
        chebyshev_transforms, first_sample_cosine, first_sample_sine = (
            np.concatenate([values, _deconvolve_and_sort_by_cell(values, cell_density)], axis=-1)
            for values in (chebyshev_transforms, first_sample_cosine, first_sample_sine)
        )
    distance = _envelope_distances(table_half_width_bins, fft_size)
    return LineShapeTables(
        layout=SpectrumLayout(
            fft_size=fft_size,
            record_length=length,
            table_half_width_bins=table_half_width_bins,
            cells_per_bin=cell_density,
            adds_powers=adds_powers,
            holds_all_bins=False,
            clearance_bins=math.ceil(clearance_bins / ratio),
        ),
        chebyshev_transforms=chebyshev_transforms,
        first_sample_cosine=first_sample_cosine,
        first_sample_sine=first_sample_sine,
        mode_end_polynomials=_end_polynomials(taylor_coefficients, length),
        envelope_distance=distance,
        cotangent_at_envelope_distance=_cotangents(distance, fft_size),
        full_table_re=_NO_LINE_SHAPE_TABLE,
        full_table_im=_NO_LINE_SHAPE_TABLE,
        full_envelope=_empty_full_envelope(distance),
        echo_lengths=_NO_ECHO_LENGTHS,
        taylor_coefficients=_NO_LINE_SHAPE_TABLE,
    )


def late_echo_length_classes(window: Window, length_min: np.ndarray) -> np.ndarray:
    """Return the length classes of late echoes, which fill only the last samples of their records.

    Late echoes of one class share a table. With a record of L samples, an echo of L' samples has
    the class ceil(ln(L / L') / ln(:data:`ECHO_LENGTH_CLASS_RATIO`)). Echoes of class c have at most
    L / :data:`ECHO_LENGTH_CLASS_RATIO` ** (c - 1) samples.

    Parameters
    ----------
    window : Window
        Window of the record (:class:`sweep.model.window.Window`).
    length_min : ndarray (n,) int64
        Number L' of samples of each echo, the least of its segments. Numbers below 1 count as 1.

    Returns
    -------
    ndarray (n,) int64
        Length class, 0 for an echo that fills the record.
    """
    ratio = window.length / np.maximum(length_min, 1)
    return np.ceil(np.log(ratio) / math.log(ECHO_LENGTH_CLASS_RATIO) - 1e-9).astype(np.int64)


def late_echo_has_modes(
    window: Window, fft_size: int, tier: int, length_min: np.ndarray, length_max: np.ndarray
) -> np.ndarray:
    """Return true for late echoes whose line shapes may be sums of Chebyshev modes.

    Parameters
    ----------
    window : Window
        Window of the record; only sums of cosines qualify.
    fft_size : int
        FFT size.
    tier : int
        Index in :data:`LINE_SHAPE_TIERS`.
    length_min, length_max : ndarray (n,)
        Least and largest number of samples of each echo in any segment.

    Returns
    -------
    ndarray (n,) bool
        True if the echo is long enough, and of one length class in all segments
        (:func:`late_echo_length_classes`).
    """
    if window.name not in COSINE_SUM_COEFFICIENTS:
        return np.zeros(length_min.shape, np.bool_)
    table_half_width = LINE_SHAPE_TIERS[tier].clearance_bins + _LATE_ECHO_TABLE_MARGIN_BINS
    is_long_enough = (length_min >= _LATE_ECHO_SAMPLES_PER_BIN_MIN * table_half_width) & (
        length_min * _LATE_ECHO_PADDING_FACTOR_MAX >= fft_size
    )
    class_length_max = window.length * ECHO_LENGTH_CLASS_RATIO ** (
        1.0 - late_echo_length_classes(window, length_min)
    )
    return np.asarray(is_long_enough & (length_max <= 1.01 * class_length_max))


def window_over_last_samples(
    window: Window, late_position: np.ndarray, n_samples: np.ndarray
) -> np.ndarray:
    """Return the window's values over the last samples of a record.

    Parameters
    ----------
    window : Window
        Window of the record, a sum of cosines.
    late_position : ndarray (positions)
        Position in the last samples, from -1 at the first of them to 1 at the record's end.
    n_samples : ndarray (lengths)
        Number of last samples.

    Returns
    -------
    ndarray (lengths, positions)
        Values of the window.
    """
    fraction = np.asarray(n_samples)[..., None] / window.length
    record_position = 1.0 - fraction * (1.0 - late_position)
    coefficients = [float(coefficient) for coefficient in COSINE_SUM_COEFFICIENTS[window.name]]
    return np.ascontiguousarray(  # kernels are compiled anew for other orders of dimensions
        sum(
            coefficient * np.cos(np.pi * m * record_position)
            for m, coefficient in enumerate(coefficients)
        )
    )


@lru_cache(maxsize=48)
def late_line_shape_tables(
    window: Window, fft_size: int, adds_powers: bool, tier: int, length_class: int
) -> LineShapeTables:
    """Prepare the tables for late echoes of one length class whose shapes are sums of modes.

    Parameters
    ----------
    window : Window
        Window of the record.
    fft_size : int
        FFT size N.
    adds_powers : bool
        True if the powers of lines add, False if their amplitudes do.
    tier : int
        Index in :data:`LINE_SHAPE_TIERS`.
    length_class : int
        Class of the echo's number of samples (:func:`late_echo_length_classes`).
    """
    clearance_bins = LINE_SHAPE_TIERS[tier].clearance_bins
    table_half_width = clearance_bins + _LATE_ECHO_TABLE_MARGIN_BINS
    filled_fraction = window.length * ECHO_LENGTH_CLASS_RATIO ** (-float(length_class)) / fft_size
    table_half_width_bins = math.ceil(table_half_width / filled_fraction)
    transforms = _late_mode_transforms(tier)
    distance = _envelope_distances(table_half_width_bins, fft_size)
    return LineShapeTables(
        layout=SpectrumLayout(
            fft_size=fft_size,
            record_length=window.length,
            table_half_width_bins=table_half_width_bins,
            cells_per_bin=TABLE_CELLS_PER_BIN[adds_powers],
            adds_powers=adds_powers,
            holds_all_bins=False,
            clearance_bins=math.ceil(clearance_bins / filled_fraction),
        ),
        chebyshev_transforms=transforms.chebyshev_transforms,
        first_sample_cosine=np.empty(0),
        first_sample_sine=np.empty(0),
        mode_end_polynomials=_NO_END_POLYNOMIALS,
        envelope_distance=distance,
        cotangent_at_envelope_distance=_cotangents(distance, fft_size),
        full_table_re=_NO_LINE_SHAPE_TABLE,
        full_table_im=_NO_LINE_SHAPE_TABLE,
        full_envelope=_empty_full_envelope(distance),
        echo_lengths=_NO_ECHO_LENGTHS,
        taylor_coefficients=transforms.taylor_coefficients,
    )


class LateModeTransforms(NamedTuple):
    """Fourier transforms and Taylor coefficients of the Chebyshev modes of late echoes."""

    chebyshev_transforms: np.ndarray
    """(modes, distances): half the integral of T_j(x) exp(-i pi u x) / K(x) over x = -1 .. 1. T_j
    is the Chebyshev polynomial of mode j, K the spreading kernel's transform, and u the distance
    from the line [bins of fs/L'], with the echo's L' samples. u has a step of half a bin, and 0 in
    the middle."""
    taylor_coefficients: np.ndarray
    """(modes, END_DERIVATIVE_ORDER_MAX + 1): Taylor coefficients of the modes at the record's end.
    """


@lru_cache(maxsize=len(LINE_SHAPE_TIERS))
def _late_mode_transforms(tier: int) -> LateModeTransforms:
    """Compute the :class:`LateModeTransforms` of a tier, an index in :data:`LINE_SHAPE_TIERS`."""
    n_modes, clearance_bins, _ = LINE_SHAPE_TIERS[tier]
    half_count = math.ceil(
        (1.02 * ECHO_LENGTH_CLASS_RATIO * (clearance_bins + _LATE_ECHO_TABLE_MARGIN_BINS) + 14)
        * _LATE_ECHO_TABLE_VALUES_PER_BIN
        + N_KERNEL_CELLS
    )
    frequency = np.arange(-half_count, half_count + 1) / _LATE_ECHO_TABLE_VALUES_PER_BIN
    n_nodes = 4 * ((math.ceil(math.pi * frequency[-1]) + n_modes) // 4) + 96
    node, weight = _gauss_legendre(n_nodes)
    weighted_modes = np.cos(np.outer(np.arange(n_modes), np.arccos(node))) * weight / 2
    return LateModeTransforms(
        _chebyshev_fourier_integrals(
            weighted_modes
            / spreading_kernel_transform(np.pi / _LATE_ECHO_TABLE_VALUES_PER_BIN * node),
            node,
            frequency,
        ),
        _taylor_coefficients(("1",), n_modes),
    )


def window_has_modes(window: Window, fft_size: int) -> bool:
    """Return True if line shapes of this window may be sums of Chebyshev modes.

    The window has to be a sum of cosines, the record long enough, and the padding small enough. If
    any of these fails, line-shape tables hold all bins.

    Parameters
    ----------
    window : Window
        Window of the record (:class:`sweep.model.window.Window`).
    fft_size : int
        FFT size N.

    Returns
    -------
    bool
        True for sums of modes.
    """
    is_long_enough = (
        window.length >= _RECORD_LENGTH_MIN and window.length * _PADDING_MAX >= fft_size
    )
    return is_long_enough and window.name in COSINE_SUM_COEFFICIENTS


def full_line_shape_tables(
    window: Window,
    fft_size: int,
    adds_powers: bool,
    phase: np.ndarray,
    first_sample: np.ndarray | None = None,
) -> LineShapeTables:
    """Compute line shapes whose tables hold all bins of the spectrum, one per segment.

    Parameters
    ----------
    window
        Window of the record.
    fft_size
        FFT size N.
    adds_powers
        True if the powers of lines add, False if their amplitudes do.
    phase
        (segments, L): phase error of each sample [cycles].
    first_sample
        (segments,): index of the first sample with the echo, by default 0.
    """
    cells_per_bin, nyquist_bin, length = (
        TABLE_CELLS_PER_BIN[adds_powers],
        fft_size // 2,
        window.length,
    )
    n_cells = cells_per_bin * fft_size
    cell_index = (np.arange(fft_size) - nyquist_bin) * cells_per_bin - np.arange(cells_per_bin)[
        :, None
    ]
    phase_factor = np.exp(1j * np.pi * (length / fft_size / cells_per_bin) * cell_index)
    distance, segments = _envelope_distances(nyquist_bin, fft_size), len(phase)
    table_re, table_im = np.empty((segments, n_cells)), np.zeros((segments, n_cells))
    envelope = LineEnvelope(
        distance, np.zeros((segments, distance.size)), np.zeros((segments, distance.size))
    )
    w, record_position = window_samples(window.name, length), 2 * np.arange(length) / length - 1
    first_samples = np.zeros(segments, np.int64) if first_sample is None else first_sample
    for s, psi in enumerate(phase):
        record = w * np.exp(2j * np.pi * (psi - np.rint(psi)))
        record[: first_samples[s]] = 0.0
        squared_magnitude = np.abs(np.fft.fft(record, n_cells)) ** 2
        _fill_full_line_envelope(
            squared_magnitude, cells_per_bin, envelope.magnitude[s], envelope.square_integral[s]
        )
        if adds_powers:
            deconvolved = DECONVOLUTION_TAPS[0] * squared_magnitude
            for k in range(1, DECONVOLUTION_TAPS.size):
                deconvolved += DECONVOLUTION_TAPS[k] * (
                    np.roll(squared_magnitude, k) + np.roll(squared_magnitude, -k)
                )
            table_re[s] = deconvolved[cell_index % n_cells].ravel()
        else:
            record /= spreading_kernel_transform(
                np.pi * (length / fft_size / cells_per_bin) * record_position
            )
            deconvolved = (np.fft.fft(record, n_cells)[cell_index % n_cells] * phase_factor).ravel()
            table_re[s], table_im[s] = deconvolved.real, deconvolved.imag
    return LineShapeTables(
        layout=SpectrumLayout(
            fft_size=fft_size,
            record_length=length,
            table_half_width_bins=nyquist_bin,
            cells_per_bin=cells_per_bin,
            adds_powers=adds_powers,
            holds_all_bins=True,
            clearance_bins=nyquist_bin,
        ),
        chebyshev_transforms=_NO_LINE_SHAPE_TABLE,
        first_sample_cosine=np.empty(0),
        first_sample_sine=np.empty(0),
        mode_end_polynomials=_NO_END_POLYNOMIALS,
        envelope_distance=distance,
        cotangent_at_envelope_distance=_cotangents(distance, fft_size),
        full_table_re=table_re,
        full_table_im=table_im,
        full_envelope=envelope,
        echo_lengths=_NO_ECHO_LENGTHS,
        taylor_coefficients=_NO_LINE_SHAPE_TABLE,
    )


def _fill_full_line_envelope(
    squared_magnitude: np.ndarray,
    cells_per_bin: int,
    envelope_magnitude: np.ndarray,
    square_integral: np.ndarray,
) -> None:
    """Fill two arrays (m,) of a :class:`LineEnvelope` from a line's squared magnitudes.

    ``squared_magnitude`` holds those of all cells of the periodic spectrum.
    """
    paired = squared_magnitude + np.maximum(
        np.roll(squared_magnitude, cells_per_bin // 2),
        np.roll(squared_magnitude, -(cells_per_bin // 2)),
    )
    half_count = squared_magnitude.size // 2
    folded = np.maximum(paired[: half_count + 1], paired[-np.arange(half_count + 1)])
    maximum_beyond = np.maximum.accumulate(folded[::-1])[::-1]
    maximum_beyond = maximum_beyond[
        np.maximum(np.arange(0, half_count + 1, cells_per_bin) - 1, 0)
    ]  # from the cell before on
    maximum_beyond *= _ENVELOPE_MARGIN**2
    envelope_magnitude[: maximum_beyond.size] = np.sqrt(maximum_beyond)
    step_areas = 0.5 * (maximum_beyond + np.append(maximum_beyond[1:], 0.0))
    square_integral[: maximum_beyond.size] = np.cumsum(step_areas[::-1])[::-1]


def spreading_kernel(cell_distance: np.ndarray) -> np.ndarray:
    """Evaluate the kernel that spreads lines over table cells.

    ``cell_distance`` is the distance from the line [cells], at most N_KERNEL_CELLS / 2.
    """
    root = np.sqrt(np.maximum(1 - (2 * cell_distance / N_KERNEL_CELLS) ** 2, 0.0))
    return np.asarray(i0(KERNEL_BETA * root) / i0(KERNEL_BETA))


_kernel_coordinate = np.cos(
    np.pi * (np.arange(KERNEL_POLYNOMIAL_DEGREE + 1) + 0.5) / (KERNEL_POLYNOMIAL_DEGREE + 1)
)
KERNEL_POLYNOMIALS = np.zeros((KERNEL_POLYNOMIAL_DEGREE + 1, N_KERNEL_CELLS + N_ZERO_WEIGHT_CELLS))
"""Polynomial coefficients of the spreading kernel, (powers, cells), from power 0 up. Their variable
runs from -1 to 1 across a cell. The last N_ZERO_WEIGHT_CELLS columns are 0."""

for _j in range(N_KERNEL_CELLS):
    KERNEL_POLYNOMIALS[:, _j] = cheb2poly(
        chebfit(
            _kernel_coordinate,
            spreading_kernel((_kernel_coordinate + 1) / 2 - _j + N_KERNEL_CELLS // 2 - 1),
            KERNEL_POLYNOMIAL_DEGREE,
        )
    )


def spreading_kernel_transform(theta: np.ndarray) -> np.ndarray:
    """Evaluate the Fourier transform of the spreading kernel at ``theta`` [rad/cell], up to pi."""
    root = np.sqrt(KERNEL_BETA**2 - (N_KERNEL_CELLS * theta / 2) ** 2)
    return np.asarray(N_KERNEL_CELLS * np.sinh(root) / root / i0(KERNEL_BETA))


def n_line_shape_table_values(layout: SpectrumLayout) -> int:
    """Return the number of values in the table of a line shape, cells per bin times columns."""
    columns = layout.fft_size if layout.holds_all_bins else 2 * layout.table_half_width_bins + 1
    return layout.cells_per_bin * columns


def allocate_line_shapes(tables: LineShapeTables, segments: int) -> LineShape:
    """Allocate the line shapes of all segments of a point.

    Parameters
    ----------
    tables : LineShapeTables
        Tables of the window, for the sizes and the envelope's distances (:class:`LineShapeTables`).
    segments : int
        Number of segments.

    Returns
    -------
    LineShape
        Arrays with a leading dimension of segments. The values of the tables are undefined. The
        envelopes' magnitudes and integrals, and the end polynomials, are 0.
    """
    distance, n_cells = tables.envelope_distance, n_line_shape_table_values(tables.layout)
    return LineShape(
        np.empty((segments, n_cells)),
        np.empty((segments, n_cells)),
        LineEnvelope(
            distance, np.zeros((segments, distance.size)), np.zeros((segments, distance.size))
        ),
        EndPolynomials(
            *(np.zeros((segments, N_END_POLYNOMIAL_COEFFICIENTS)) for _ in EndPolynomials._fields)
        ),
    )


@njit(cache=True, error_model="numpy", forceinline=True)
def select_segment(shapes, segment):
    """Return the line shape of one segment.

    Parameters
    ----------
    shapes : LineShape
        Line shapes of all segments, with a leading dimension (:class:`LineShape`).
    segment : int
        Index of the segment: 0 up, 1 Doppler, 2 down.

    Returns
    -------
    LineShape
        Line shape whose arrays are views of those of ``shapes``.
    """
    envelope, ends = shapes.envelope, shapes.end_polynomials
    return LineShape(
        shapes.table_re[segment],
        shapes.table_im[segment],
        LineEnvelope(
            envelope.distance, envelope.magnitude[segment], envelope.square_integral[segment]
        ),
        EndPolynomials(
            ends.start_re[segment],
            ends.start_im[segment],
            ends.end_re[segment],
            ends.end_im[segment],
        ),
    )


@njit(cache=True, error_model="numpy", inline="always")
def _copy_values(source, target):
    """Copy an array (n,) into another one.

    An assignment to ``target[:]`` would compile the text of its error message into each kernel.
    """
    for i in range(target.size):
        target[i] = source[i]


@njit(cache=True, error_model="numpy", inline="always")
def copy_line_shape(shapes, from_segment, to_segment):
    """Copy the line shape of one segment to another segment.

    Parameters
    ----------
    shapes : LineShape
        Line shapes (segments, ...), changed in place.
    from_segment, to_segment : int
        Indices of the segments.
    """
    source, target = select_segment(shapes, from_segment), select_segment(shapes, to_segment)
    _copy_values(source.table_re, target.table_re)
    _copy_values(source.table_im, target.table_im)
    _copy_values(source.envelope.magnitude, target.envelope.magnitude)
    _copy_values(source.envelope.square_integral, target.envelope.square_integral)
    _copy_values(source.end_polynomials.start_re, target.end_polynomials.start_re)
    _copy_values(source.end_polynomials.start_im, target.end_polynomials.start_im)
    _copy_values(source.end_polynomials.end_re, target.end_polynomials.end_re)
    _copy_values(source.end_polynomials.end_im, target.end_polynomials.end_im)


def chebyshev_nodes(n_nodes: int) -> np.ndarray:
    """Return the Chebyshev nodes at which phase errors are sampled, (nodes,).

    A node is a time within the record, from -1 at the start to 1 at the end.
    """
    return np.cos(np.pi * (np.arange(n_nodes) + 0.5) / n_nodes)


@lru_cache(maxsize=8)
def chebyshev_coefficient_matrix(n_nodes: int) -> np.ndarray:
    """Return the matrix (nodes, coefficients) from values to Chebyshev coefficients.

    The values are at :func:`chebyshev_nodes`.
    """
    matrix = 2 / n_nodes * np.cos(np.outer(np.arccos(chebyshev_nodes(n_nodes)), np.arange(n_nodes)))
    matrix[:, 0] /= 2
    return matrix


def _table_cell_distances(table_half_width_bins: int, adds_powers: bool) -> np.ndarray:
    """Return the distances of a table's cells from the line [bins of fs/N], in rising order.

    They include those of the extra cells on each side that the filter DECONVOLUTION_TAPS needs.
    """
    cells_per_bin = TABLE_CELLS_PER_BIN[adds_powers]
    return (
        np.arange(
            -table_half_width_bins * cells_per_bin - cells_per_bin + 1 - _TAP_REACH_CELLS,
            table_half_width_bins * cells_per_bin + _TAP_REACH_CELLS + 1,
        )
        / cells_per_bin
    )


def _deconvolve_and_sort_by_cell(values: np.ndarray, cells_per_bin: int) -> np.ndarray:
    """Return a line's table divided by the transform of the spreading kernel, and sorted.

    ``values`` (..., places) is the table at the distances of :func:`_table_cell_distances`. The
    result, (..., cells * columns), is sorted by cell within a bin, then by bin.
    """
    n_inner = values.shape[-1] - 2 * _TAP_REACH_CELLS
    filtered = DECONVOLUTION_TAPS[0] * values[..., _TAP_REACH_CELLS : _TAP_REACH_CELLS + n_inner]
    for k in range(1, DECONVOLUTION_TAPS.size):
        for start in (_TAP_REACH_CELLS - k, _TAP_REACH_CELLS + k):
            filtered += DECONVOLUTION_TAPS[k] * values[..., start : start + n_inner]
    rows = [filtered[..., cells_per_bin - 1 - m :: cells_per_bin] for m in range(cells_per_bin)]
    return np.concatenate(rows, axis=-1)


def _envelope_distances(table_half_width_bins: int, fft_size: int) -> np.ndarray:
    """Return the distances from the line at which envelopes are tabulated [bins of fs/N].

    The distances are one per bin of the table, followed by a geometric progression up to N/2. N is
    the FFT size.
    """
    far_distances = np.geomspace(
        table_half_width_bins + 1, max(fft_size / 2, table_half_width_bins + 2), _N_FAR_DISTANCES
    )
    return np.append(np.arange(table_half_width_bins + 1.0), far_distances)


def _cotangents(distance: np.ndarray, fft_size: int) -> np.ndarray:
    """Return cot(pi d / N) of distances d [bins of fs/N], with the FFT size N."""
    with np.errstate(divide="ignore"):
        return np.asarray(1 / np.tan(np.pi * distance / fft_size))


@njit(cache=True, error_model="numpy")
def _chebyshev_fourier_integrals(weighted_modes, node, distance):
    """Integrate Chebyshev modes times exp(-i pi y x) over x by a quadrature, (modes, places).

    ``weighted_modes`` (modes, nodes) are the modes' values times quadrature weights at the
    positions x, given by ``node``. ``distance`` (places,) is y [bins of fs/L]. Even modes have real
    integrals, odd modes imaginary ones.
    """
    integrals = np.zeros((weighted_modes.shape[0], distance.size))
    cosine, sine = np.empty(distance.size), np.empty(distance.size)
    for k in range(node.size):
        for i in range(distance.size):
            sine[i], cosine[i] = sincos_cycles(-0.5 * distance[i] * node[k])
        for j in range(weighted_modes.shape[0]):
            factor = weighted_modes[j, k]
            sine_or_cosine = sine if j & 1 else cosine
            for i in range(distance.size):
                integrals[j, i] += factor * sine_or_cosine[i]
    return integrals


def _taylor_coefficients(coefficient_texts: tuple[str, ...], n_modes: int) -> np.ndarray:
    """Compute the Taylor coefficients of each Chebyshev mode times the window, at the record's end.

    The window is the sum of cosines with the coefficients ``coefficient_texts``. The cosines may
    almost cancel at the record's end, so their sums are exact fractions. The result is (modes,
    END_DERIVATIVE_ORDER_MAX + 1).
    """
    order = np.arange(END_DERIVATIVE_ORDER_MAX + 1)
    even = np.where(order % 2 == 0, (-1.0) ** (order // 2), 0.0)
    exact_sums = [
        sum(
            (-1) ** m * m**i * Fraction(coefficient_text)
            for m, coefficient_text in enumerate(coefficient_texts)
        )
        for i in order.tolist()
    ]
    window_coefficients = (
        even
        * np.array([float(exact_sum) / math.factorial(i) for i, exact_sum in enumerate(exact_sums)])
        * np.pi**order
    )
    j = np.arange(n_modes, dtype=float)[:, None]
    ratio = (j * j - order[:-1] ** 2) / (2 * order[:-1] + 1) / (order[:-1] + 1)
    mode_coefficients = np.cumprod(np.hstack([np.ones((n_modes, 1)), ratio]), axis=1)
    coefficients = np.zeros((n_modes, END_DERIVATIVE_ORDER_MAX + 1))
    for i in range(END_DERIVATIVE_ORDER_MAX + 1):
        coefficients[:, i:] += (
            window_coefficients[i] * mode_coefficients[:, : END_DERIVATIVE_ORDER_MAX + 1 - i]
        )
    return coefficients


def _euler_maclaurin_corrections(
    taylor_coefficients: np.ndarray, distance: np.ndarray, length: int
) -> np.ndarray:
    """Compute sums over samples minus integrals over the record, for each mode, (modes, places).

    The differences follow from the Euler-Maclaurin formula and the Taylor coefficients of modes at
    the record's end. ``distance`` is from the line [bins of fs/L]. ``length`` is the number L of
    samples.
    """
    bernoulli = {1: 1 / 12, 3: -1 / 720, 5: 1 / 30240}
    phase_factor = np.exp(-1j * np.pi * distance)
    parity = (-1.0) ** np.arange(len(taylor_coefficients))[:, None]
    corrections = np.zeros((len(taylor_coefficients), distance.size), complex)
    for m, coefficient in bernoulli.items():
        for i in range(m + 1):
            # d^m/dx^m of w T_j e^{-i pi y x}, at x = 1 less that at x = -1
            derivative_factor = (
                math.comb(m, i) * math.factorial(i) * (-1j * np.pi * distance) ** (m - i)
            )
            end_difference = phase_factor - (-1) ** i * parity * np.conj(phase_factor)
            corrections += (
                coefficient
                * (2 / length) ** m
                * taylor_coefficients[:, i : i + 1]
                * derivative_factor
                * end_difference
            )
    return np.where(parity > 0, corrections.real, corrections.imag)


def _power_sum_polynomials() -> np.ndarray:
    """Return sum_n n^j e^{-i theta n} over n = 0, 1, 2, .. as polynomials in cot(theta / 2).

    The result holds coefficients, (END_DERIVATIVE_ORDER_MAX + 1, N_END_POLYNOMIAL_COEFFICIENTS), by
    j and by power of the cotangent.
    """
    n_coefficients = N_END_POLYNOMIAL_COEFFICIENTS
    sums = np.zeros((END_DERIVATIVE_ORDER_MAX + 1, n_coefficients), complex)
    sums[0, :2] = 0.5, -0.5j
    for j in range(END_DERIVATIVE_ORDER_MAX):
        derivative = sums[j, 1:] * np.arange(1, n_coefficients)
        sums[j + 1, : n_coefficients - 1] -= 0.5j * derivative
        sums[j + 1, 2:] -= 0.5j * derivative[: n_coefficients - 2]
    return sums


_POWER_SUM_POLYNOMIALS = _power_sum_polynomials()
_POWER_SUM_POLYNOMIALS_RE, _POWER_SUM_POLYNOMIALS_IM = (
    np.ascontiguousarray(_POWER_SUM_POLYNOMIALS.real),
    np.ascontiguousarray(_POWER_SUM_POLYNOMIALS.imag),
)

_EULER_MACLAURIN_FACTORS = np.zeros(
    (_EULER_MACLAURIN_ORDER_MAX + 1, _EULER_MACLAURIN_ORDER_MAX + 1)
)
"""Matrix of the Euler-Maclaurin correction for one end of the record. Column i is for the Taylor
coefficient i of the phasor at this end. Row d is for the coefficient d of the correction, a
polynomial in -i theta with the phase theta per sample [rad]."""

for _m, _coefficient in EULER_MACLAURIN_COEFFICIENTS.items():
    for _i in range(_m + 1):
        _EULER_MACLAURIN_FACTORS[_m - _i, _i] += (
            _coefficient * math.comb(_m, _i) * math.factorial(_i)
        )


def _end_polynomials(taylor_coefficients: np.ndarray, length: int) -> EndPolynomials:
    """Compute the :class:`EndPolynomials` of Chebyshev modes.

    ``taylor_coefficients`` are those of the modes at the record's end; ``length`` is the number of
    samples. Arrays of the result are (modes, N_END_POLYNOMIAL_COEFFICIENTS).
    """
    power_sums = _POWER_SUM_POLYNOMIALS
    step_powers = (2 / length) ** np.arange(END_DERIVATIVE_ORDER_MAX + 1)
    polynomial_last = ((taylor_coefficients * step_powers)[:, :, None] * power_sums).sum(axis=1)
    parity = (-1.0) ** (
        np.arange(len(taylor_coefficients))[:, None] + np.arange(END_DERIVATIVE_ORDER_MAX + 1)
    )
    polynomial_first = ((taylor_coefficients * step_powers * parity)[:, :, None] * power_sums).sum(
        axis=1
    )
    return EndPolynomials(
        *map(
            np.ascontiguousarray,
            (
                polynomial_first.real,
                polynomial_first.imag,
                polynomial_last.real,
                polynomial_last.imag,
            ),
        )
    )


@njit(cache=True, error_model="numpy")
def decompose_phase_errors(phase, window_values, coefficient_matrix, modes):
    """Decompose phase errors into a frequency shift of the line and Chebyshev modes.

    Parameters
    ----------
    phase
        (segments, n, nodes): phase error at :func:`chebyshev_nodes` [cycles].
    window_values
        (segments, n, nodes): window at the same positions, by which the modes are multiplied; empty
        if the modes do not include the window.
    coefficient_matrix
        :func:`chebyshev_coefficient_matrix`.
    modes
        Output, :class:`PhaseErrorModes` for up to nodes / 2 modes. ``n_modes`` is 0 if more are
        needed.
    """
    n_nodes = coefficient_matrix.shape[0]
    coefficients_re, coefficients_im = np.empty(n_nodes), np.empty(n_nodes)
    for s in range(phase.shape[0]):
        for i in range(phase.shape[1]):
            slope = 0.0
            for k in range(n_nodes):
                slope += coefficient_matrix[k, 1] * phase[s, i, k]
            modes.line_shift[s, i] = 2.0 * slope
            coefficients_re[:] = 0.0
            coefficients_im[:] = 0.0
            for k in range(n_nodes):
                node = 0.5 * n_nodes * coefficient_matrix[k, 1]
                sine, cosine = sincos_cycles(phase[s, i, k] - slope * node)
                if window_values.size:
                    sine, cosine = sine * window_values[s, i, k], cosine * window_values[s, i, k]
                for j in range(n_nodes):
                    coefficients_re[j] += coefficient_matrix[k, j] * cosine
                    coefficients_im[j] += coefficient_matrix[k, j] * sine
            count = n_nodes
            while (
                count > 1
                and abs(coefficients_re[count - 1]) + abs(coefficients_im[count - 1])
                < MODE_COEFFICIENT_MIN
            ):
                count -= 1
            modes.n_modes[s, i] = count if count <= n_nodes // 2 else 0
            for j in range(min(count, n_nodes // 2)):
                modes.re[s, i, j], modes.im[s, i, j] = coefficients_re[j], coefficients_im[j]


@njit(cache=True, error_model="numpy", inline="always")
def build_line_shape(segment, line_shape_index, previous_index, modes, tables, shape):
    """Compute one segment's line shape, the spectrum of a line of amplitude 1.

    The line shape is a sum of Chebyshev modes, or a copy of a table of all bins.

    Parameters
    ----------
    segment
        Index of the segment: 0 up, 1 Doppler, 2 down.
    line_shape_index
        Index of the shape in ``modes``.
    previous_index
        Index of the shape that is in ``shape`` already, or -1. If both are equal, ``shape`` stays.
    modes
        :class:`PhaseErrorModes`.
    tables
        :class:`LineShapeTables`.
    shape
        Output, :class:`LineShape` of the segment.

    Notes
    -----
    G is the line's spectrum at y bins from the line, w the window, psi the phase error [cycles] and
    r the number of samples over the FFT size. With f = w exp(2 pi i psi), the mode coefficients a_j
    and their tabulated transforms M_j,

        G(y) = sum_j a_j M_j(y) + (f(-1) e^{i pi r y} - f(1) e^{-i pi r y}) / 2.

    In the transforms both ends of the record count half. The last term corrects this: the record
    has a sample at its start and none at its end.
    """
    layout, chebyshev_transforms, mode_end_polynomials = (
        tables.layout,
        tables.chebyshev_transforms,
        tables.mode_end_polynomials,
    )
    mode_re, mode_im = modes.re[segment, line_shape_index], modes.im[segment, line_shape_index]
    n_modes = modes.n_modes[segment, line_shape_index]
    if (
        previous_index >= 0
        and n_modes == 1
        and modes.n_modes[segment, previous_index] == 1
        and modes.re[segment, previous_index, 0] == mode_re[0]
        and modes.im[segment, previous_index, 0] == mode_im[0]
    ):
        return
    if layout.holds_all_bins:
        envelope = tables.full_envelope
        _copy_values(tables.full_table_re[segment], shape.table_re)
        _copy_values(tables.full_table_im[segment], shape.table_im)
        _copy_values(envelope.magnitude[segment], shape.envelope.magnitude)
        _copy_values(envelope.square_integral[segment], shape.envelope.square_integral)
        return
    even_re, even_im, odd_re, odd_im = 0.0, 0.0, 0.0, 0.0  # T_j is 1 at the end, +-1 at the start
    n_values, ends = chebyshev_transforms.shape[1], shape.end_polynomials
    transform_re, transform_im = np.zeros(n_values), np.zeros(n_values)
    _zero_end_polynomials(ends)
    for j in range(n_modes):
        a, b = mode_re[j], mode_im[j]
        if j & 1:
            odd_re, odd_im = odd_re + a, odd_im + b
            a, b = -b, a
        else:
            even_re, even_im = even_re + a, even_im + b
        for i in range(n_values):
            transform_re[i] += a * chebyshev_transforms[j, i]
            transform_im[i] += b * chebyshev_transforms[j, i]
        for d in range(N_END_POLYNOMIAL_COEFFICIENTS):
            re, im = mode_end_polynomials.start_re[j, d], mode_end_polynomials.start_im[j, d]
            ends.start_re[d] += mode_re[j] * re - mode_im[j] * im
            ends.start_im[d] += mode_re[j] * im + mode_im[j] * re
        for d in range(N_END_POLYNOMIAL_COEFFICIENTS):
            re, im = mode_end_polynomials.end_re[j, d], mode_end_polynomials.end_im[j, d]
            ends.end_re[d] += mode_re[j] * re - mode_im[j] * im
            ends.end_im[d] += mode_re[j] * im + mode_im[j] * re
    # The record's first sample counts whole, its end not at all.
    for i in range(n_values):
        cosine, sine = tables.first_sample_cosine[i], tables.first_sample_sine[i]
        transform_re[i] -= odd_re * cosine + even_im * sine
        transform_im[i] += even_re * sine - odd_im * cosine
    n_table = shape.table_re.size
    n_cells = n_values if layout.adds_powers else n_values - n_table  # on both sides of the line
    if not layout.adds_powers:
        for i in range(n_table):
            shape.table_re[i], shape.table_im[i] = (
                transform_re[n_cells + i],
                transform_im[n_cells + i],
            )
    squared_magnitude = transform_re[:n_cells]
    for i in range(n_cells):
        squared_magnitude[i] = transform_re[i] * transform_re[i] + transform_im[i] * transform_im[i]
    if layout.adds_powers:
        _fill_line_shape_table(squared_magnitude, layout, shape.table_re)
    _fill_line_envelope(squared_magnitude, layout, tables.cotangent_at_envelope_distance, shape)


@njit(cache=True, error_model="numpy", borrows=True)
def _zero_end_polynomials(ends):
    """Set all coefficients of an :class:`EndPolynomials` to 0."""
    for d in range(N_END_POLYNOMIAL_COEFFICIENTS):
        ends.start_re[d], ends.start_im[d], ends.end_re[d], ends.end_im[d] = 0.0, 0.0, 0.0, 0.0


@njit(cache=True, error_model="numpy", borrows=True)
def first_segment_of_same_line_shape(
    segment, line_shape_index, modes, echo_lengths, segment_exists
):
    """Return the index of the first earlier segment that has the line shape of a given segment.

    Two shapes are the same if their modes and their numbers of samples are equal. The result is -1
    without an earlier segment of the same shape.

    Parameters
    ----------
    segment : int
        Index of the given segment.
    line_shape_index : int
        Index of the line shape in ``modes``.
    modes : PhaseErrorModes
        Chebyshev coefficients of the phase errors of all shapes, by segment.
    echo_lengths : ndarray (segments, shapes)
        Number of samples of the echo; empty if echoes fill the record.
    segment_exists : ndarray (segments,) bool
        True for existing segments.

    Returns
    -------
    int
        Index of the segment, or -1.
    """
    n_modes = modes.n_modes[segment, line_shape_index]
    for s in range(segment):
        if (
            not segment_exists[s]
            or echo_lengths[s, line_shape_index] != echo_lengths[segment, line_shape_index]
        ):
            continue
        is_same = modes.n_modes[s, line_shape_index] == n_modes
        for j in range(n_modes):
            is_same &= modes.re[s, line_shape_index, j] == modes.re[segment, line_shape_index, j]
            is_same &= modes.im[s, line_shape_index, j] == modes.im[segment, line_shape_index, j]
        if is_same:
            return s
    return -1


@njit(cache=True, error_model="numpy", inline="always")
def build_late_line_shape(segment, line_shape_index, modes, tables, shape):
    """Compute the line shape of an echo that arrives after its record has begun.

    The line shape is the spectrum of a line of amplitude 1.

    Parameters
    ----------
    segment : int
        Index of the segment: 0 up, 1 Doppler, 2 down.
    line_shape_index : int
        Index of the shape in ``modes``.
    modes : PhaseErrorModes
        Chebyshev coefficients of the phase errors.
    tables : LineShapeTables
        Tables of the window; ``echo_lengths`` are the numbers L' of samples with the echo.
    shape : LineShape
        Result: line shape of the segment.

    Notes
    -----
    G is the line's spectrum at y bins from the line, w the window, psi the phase error [cycles], N
    the FFT size and B the Bernoulli numbers. With f = w exp(2 pi i psi) over the echo's samples,
    r' = L'/N and theta = 2 pi y / N,

        G(y) = L'/2 int f(x) e^{-i pi r' y x} dx + (f(-1) e^{i pi r' y} - f(1) e^{-i pi r' y}) / 2
               + sum_m B_{m+1} / (m+1)! [ d^m / dn^m (f e^{-i theta n}) ] at the ends,

    whose derivatives are polynomials in theta.
    """
    layout, chebyshev_transforms = tables.layout, tables.chebyshev_transforms
    taylor_coefficients = tables.taylor_coefficients
    record_length = tables.echo_lengths[segment, line_shape_index]
    mode_re, mode_im = modes.re[segment, line_shape_index], modes.im[segment, line_shape_index]
    n_modes, ends = modes.n_modes[segment, line_shape_index], shape.end_polynomials
    half_length, sample_step = 0.5 * record_length, 2.0 / record_length
    length_ratio = record_length / layout.fft_size
    n_values, n_derivatives = chebyshev_transforms.shape[1], END_DERIVATIVE_ORDER_MAX + 1
    mode_sum_re, mode_sum_im = np.zeros(n_values), np.zeros(n_values)
    # Taylor coefficients of f at the start and at the end, by order of the derivative.
    start_re, start_im = np.zeros(n_derivatives), np.zeros(n_derivatives)
    end_re, end_im = np.zeros(n_derivatives), np.zeros(n_derivatives)
    for j in range(n_modes):
        a, b = mode_re[j], mode_im[j]
        for i in range(n_derivatives):
            value = taylor_coefficients[j, i]
            sign = -1.0 if (i + j) & 1 else 1.0
            end_re[i], end_im[i] = end_re[i] + a * value, end_im[i] + b * value
            start_re[i] += sign * a * value
            start_im[i] += sign * b * value
        if j & 1:
            a, b = -b, a
        for i in range(n_values):
            mode_sum_re[i] += a * chebyshev_transforms[j, i]
            mode_sum_im[i] += b * chebyshev_transforms[j, i]
    scale = 1.0
    for i in range(n_derivatives):
        start_re[i], end_re[i] = start_re[i] * scale, end_re[i] * scale
        start_im[i], end_im[i] = start_im[i] * scale, end_im[i] * scale
        scale *= sample_step
    _zero_end_polynomials(ends)
    for i in range(n_derivatives):
        for d in range(N_END_POLYNOMIAL_COEFFICIENTS):
            p, q = _POWER_SUM_POLYNOMIALS_RE[i, d], _POWER_SUM_POLYNOMIALS_IM[i, d]
            ends.start_re[d] += start_re[i] * p - start_im[i] * q
            ends.start_im[d] += start_re[i] * q + start_im[i] * p
            ends.end_re[d] += end_re[i] * p - end_im[i] * q
            ends.end_im[d] += end_re[i] * q + end_im[i] * p
    # Corrections of the two ends, by power of theta. (-i)^d exchanges real and imaginary parts.
    n_corrections = _EULER_MACLAURIN_ORDER_MAX + 1
    start_correction_re, start_correction_im = np.zeros(n_corrections), np.zeros(n_corrections)
    end_correction_re, end_correction_im = np.zeros(n_corrections), np.zeros(n_corrections)
    for d in range(n_corrections):
        a, b, c, e = 0.0, 0.0, 0.0, 0.0
        for i in range(n_corrections - d):
            factor = _EULER_MACLAURIN_FACTORS[d, i]
            a, b = a - factor * start_re[i], b - factor * start_im[i]
            c, e = c + factor * end_re[i], e + factor * end_im[i]
        if d == 0:  # the first sample counts whole, the end not at all
            a, b = a + 0.5 * start_re[0], b + 0.5 * start_im[0]
            c, e = c - 0.5 * end_re[0], e - 0.5 * end_im[0]
        for _ in range(d % 4):
            a, b, c, e = b, -a, e, -c
        start_correction_re[d], start_correction_im[d] = a, b
        end_correction_re[d], end_correction_im[d] = c, e
    cells_per_bin, table_half_width_bins = layout.cells_per_bin, layout.table_half_width_bins
    n_cells = 2 * table_half_width_bins * cells_per_bin + cells_per_bin + 2 * _TAP_REACH_CELLS
    first_cell = -table_half_width_bins * cells_per_bin - cells_per_bin + 1 - _TAP_REACH_CELLS
    transform_re, transform_im = np.empty(n_cells), np.empty(n_cells)
    kernel_weights = np.empty(N_KERNEL_CELLS + N_ZERO_WEIGHT_CELLS)
    middle = n_values // 2
    for i in range(n_cells):
        y = (first_cell + i) / cells_per_bin
        u = length_ratio * y
        value_position = u * _LATE_ECHO_TABLE_VALUES_PER_BIN + middle
        cell = math.floor(value_position)
        kernel_coordinate = 2.0 * (value_position - cell) - 1.0
        _copy_values(KERNEL_POLYNOMIALS[KERNEL_POLYNOMIAL_DEGREE], kernel_weights)
        for d in range(KERNEL_POLYNOMIAL_DEGREE - 1, -1, -1):
            for j in range(N_KERNEL_CELLS + N_ZERO_WEIGHT_CELLS):
                kernel_weights[j] = kernel_weights[j] * kernel_coordinate + KERNEL_POLYNOMIALS[d, j]
        sum_re, sum_im = 0.0, 0.0
        first_value = np.uint64(cell - N_KERNEL_CELLS // 2 + 1)
        for j in range(np.uint64(N_KERNEL_CELLS)):
            sum_re += kernel_weights[j] * mode_sum_re[first_value + j]
            sum_im += kernel_weights[j] * mode_sum_im[first_value + j]
        theta = 2.0 * np.pi * y / layout.fft_size
        a, b, c, e = 0.0, 0.0, 0.0, 0.0
        for d in range(_EULER_MACLAURIN_ORDER_MAX, -1, -1):
            a, b = a * theta + start_correction_re[d], b * theta + start_correction_im[d]
            c, e = c * theta + end_correction_re[d], e * theta + end_correction_im[d]
        sine, cosine = sincos_cycles(0.5 * u)
        transform_re[i] = (
            2.0 * half_length * sum_re + (a * cosine - b * sine) + (c * cosine + e * sine)
        )
        transform_im[i] = (
            2.0 * half_length * sum_im + (a * sine + b * cosine) + (e * cosine - c * sine)
        )
    if not layout.adds_powers:
        _fill_line_shape_table(transform_re, layout, shape.table_re)
        _fill_line_shape_table(transform_im, layout, shape.table_im)
    squared_magnitude = transform_re
    for i in range(n_cells):
        squared_magnitude[i] = transform_re[i] * transform_re[i] + transform_im[i] * transform_im[i]
    if layout.adds_powers:
        _fill_line_shape_table(squared_magnitude, layout, shape.table_re)
    _fill_line_envelope(squared_magnitude, layout, tables.cotangent_at_envelope_distance, shape)


@njit(cache=True, error_model="numpy")
def _fill_line_shape_table(values, layout, table):
    """Fill ``table`` with values divided by the transform of the spreading kernel, and sorted.

    ``values`` are at the distances of :func:`_table_cell_distances`. The table is sorted by cell
    within a bin, then by bin.
    """
    cells_per_bin, columns = layout.cells_per_bin, 2 * layout.table_half_width_bins + 1
    n_values = np.uint64(cells_per_bin * columns)
    filtered = np.empty(cells_per_bin * columns)
    for i in range(n_values):
        filtered[i] = DECONVOLUTION_TAPS[0] * values[i + np.uint64(_TAP_REACH_CELLS)]
    for k in range(1, DECONVOLUTION_TAPS.size):
        low, high = np.uint64(_TAP_REACH_CELLS - k), np.uint64(_TAP_REACH_CELLS + k)
        for i in range(n_values):
            filtered[i] += DECONVOLUTION_TAPS[k] * (values[i + low] + values[i + high])
    for m in range(cells_per_bin):
        for q in range(columns):
            table[m * columns + q] = filtered[q * cells_per_bin + cells_per_bin - 1 - m]


@njit(cache=True, error_model="numpy")
def _fill_line_envelope(squared_magnitude, layout, cotangent_at_envelope_distance, shape):
    """Fill the envelope of a shape from squared magnitudes at cells and from its end polynomials.

    The polynomials are used at distances outside the table. The squared magnitude varies over
    distance as a sine with a period of one bin. The sum of two values half a bin apart is therefore
    an upper bound.
    """
    table_half_width_bins, cells_per_bin = layout.table_half_width_bins, layout.cells_per_bin
    distance, ends = shape.envelope.distance, shape.end_polynomials
    magnitude, square_integral = shape.envelope.magnitude, shape.envelope.square_integral
    line_cell = table_half_width_bins * cells_per_bin + cells_per_bin - 1 + _TAP_REACH_CELLS
    half_bin_cells = cells_per_bin // 2
    for i in range(np.uint64(table_half_width_bins + 1), np.uint64(distance.size)):
        c, a, b, p, q = cotangent_at_envelope_distance[i], 0.0, 0.0, 0.0, 0.0
        for k in range(N_END_POLYNOMIAL_COEFFICIENTS):
            d = N_END_POLYNOMIAL_COEFFICIENTS - 1 - k
            a, b = a * c + ends.start_re[d], b * c + ends.start_im[d]
            p, q = p * c + ends.end_re[d], q * c + ends.end_im[d]
        squared_first, squared_last = a * a + b * b, p * p + q * q
        magnitude[i] = squared_first + squared_last + 2.0 * math.sqrt(squared_first * squared_last)
    # Sums of two values half a bin apart, from the cell before the line on.
    half_bin_sums = np.empty(table_half_width_bins * cells_per_bin + cells_per_bin + 1)
    for i in range(half_bin_sums.size):
        cell_above, cell_below = np.uint64(line_cell - 1 + i), np.uint64(line_cell + 1 - i)
        sum_above = (
            squared_magnitude[cell_above]
            + squared_magnitude[cell_above + np.uint64(half_bin_cells)]
        )
        sum_below = (
            squared_magnitude[cell_below]
            + squared_magnitude[cell_below - np.uint64(half_bin_cells)]
        )
        half_bin_sums[i] = _ENVELOPE_MARGIN * _ENVELOPE_MARGIN * max(sum_above, sum_below)
    maximum_beyond, area, previous_maximum = 0.0, 0.0, 0.0  # of |G|^2
    for i in range(distance.size - 1, -1, -1):
        if i > table_half_width_bins:
            maximum_beyond = max(maximum_beyond, magnitude[i])
        else:
            for k in range(i * cells_per_bin, (i + 1) * cells_per_bin + 1):
                maximum_beyond = max(maximum_beyond, half_bin_sums[k])
        width = distance[i + 1] - distance[i] if i + 1 < distance.size else 0.0
        # An upper sum, where |G|^2 falls ever more slowly.
        area += width * 0.5 * (maximum_beyond + previous_maximum)
        previous_maximum = maximum_beyond
        magnitude[i], square_integral[i] = maximum_beyond, area
    for i in range(distance.size):
        magnitude[i] = math.sqrt(magnitude[i])
