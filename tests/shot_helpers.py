"""Shots of one category, keys of points, and bins and lines as detection and leakage see them."""

from itertools import product
from typing import NamedTuple

import numpy as np
import pytest

from sweep.model.effects.catalogue import DEFAULT_EFFECTS
from sweep.model.evaluation import prepare_shots
from sweep.model.sampling import philox
from sweep.model.spectrum import line_shape
from sweep.model.spectrum.lines import (
    REAL_WITH_IMAGES,
    LineArrays,
    SpectrumLayout,
    beat_parameters_at,
    compute_lines,
)
from sweep.model.spectrum.segment_spectra import iter_spans

DRAWS = 10_000
"""5 sigma of a proportion are at most 5 sqrt(1/4 / 10,000) = 0.025: an error of 5 % of pd shows.

A sample variance of as many is known to sqrt(2/10,000) = 1.4 %: at 5 sigma 7 % in a variance show.
"""


def parametrize_product(fast_step, *choice_lists):
    """All combinations of some choices; all but every `step`-th of them are slow.

    With a step that has no divisor in common with their numbers, each choice is taken.
    """
    return [
        pytest.param(*case, marks=[pytest.mark.slow] * (case_number % fast_step > 0))
        for case_number, case in enumerate(product(*choice_lists))
    ]


def prepare_single_category(parameters, effects=DEFAULT_EFFECTS):
    """Shots of parameters that are all of one category."""
    ((_, shots),) = prepare_shots(parameters, effects)
    return shots


def make_point_keys(n, seed=5):
    """Keys of n points."""
    return philox.point_keys(np.arange(float(n))[:, None], domain="tests", seed=seed)


def is_within_5_sigma(counts, probability, extra_allowance=0.0):
    """Counts of as many draws that a chance explains, True for each."""
    count_deviation = np.sqrt(DRAWS * probability * (1 - probability))
    return np.abs(counts - DRAWS * probability) <= 5 * count_deviation + extra_allowance + 1e-9


def intersect_level_plane(axis_range, grazing, pointing_errors):
    """Range and grazing angle of jittered rays that are followed down to the plane z = 0."""
    origin = np.array([0.0, 0.0, axis_range * np.sin(grazing)])
    axis_direction = np.array([np.cos(grazing), 0.0, -np.sin(grazing)])
    up, side_direction = (
        np.array([np.sin(grazing), 0.0, np.cos(grazing)]),
        np.array([0.0, 1.0, 0.0]),
    )
    angle = np.hypot(*pointing_errors.T)[:, None]
    sideways = pointing_errors[:, :1] * up + pointing_errors[:, 1:] * side_direction
    direction = axis_direction * np.cos(angle) + sideways * np.sinc(angle / np.pi)
    ranges = -origin[2] / direction[:, 2]
    return ranges, np.arcsin(-direction[:, 2]), direction


def detected_window(shots, segment):
    """First bin and |X| of those that are looked at one by one, of the first point."""
    (windows,) = iter_spans(shots, points=np.zeros(1, np.int64))
    return int(windows.first_bin[segment, 0]), windows.span_magnitudes(segment, 0).copy()


def magnitude_error(shots, magnitude, exact_magnitude, peak=None):
    """Largest difference of |X|, over the peak.

    Where lines add as powers |X|^2 is the sum, to some roundings of its largest terms: 1e-13 of the
    peak's power count as no more than 1e-9 of the peak, which they exceed where |X| is 86 dB down.
    """
    peak = exact_magnitude.max() if peak is None else peak
    error = np.abs(magnitude - exact_magnitude) / peak
    if shots.footprint.adds_powers:
        error = np.minimum(error, 1e4 * np.abs(magnitude**2 - exact_magnitude**2) / peak**2)
    return error.max()


def segment_lines(shots, i, segment):
    """Origin of a segment's lines, places beside it [bins], weights C_b."""
    n, row = shots.footprint.n_beamlets, int(shots.footprint.row_of_point[i])
    layout = SpectrumLayout(shots.fft_size, shots.window.length, 0, 0, False, False, 0)
    lines = LineArrays(*np.empty((3, n)))
    beat = beat_parameters_at(shots.point_parameters(), shots.segment_parameters(), segment, i)
    origin = compute_lines(
        beat, segment, shots.beamlet_arrays, row, layout, lines, *np.empty((2, n))
    )
    return origin, lines.position, lines.re + 1j * lines.im


class PreparedShape(NamedTuple):
    """Line shape of a window with a phase error."""

    shape: line_shape.LineShape
    layout: SpectrumLayout
    shift: float
    """Shift of the line [bins of fs/N]."""
    n_modes: int
    """Number of modes; 0 if the table holds all bins."""


def line_shape_of_window(window, fft_size, *, power=False, phase=None, view=REAL_WITH_IMAGES):
    """Line shape of a window with a phase error [cycles], a function of x = -1 .. 1."""
    phase, n_modes, shift = phase or np.zeros_like, 0, 0.0
    for tier, (modes_max, _, _) in enumerate(line_shape.LINE_SHAPE_TIERS):
        if not line_shape.window_has_modes(window, fft_size):
            break
        modes = line_shape.zero_phase_error_modes(1, 1, modes_max)
        phase_at_nodes = phase(line_shape.chebyshev_nodes(2 * modes_max))[None, None]
        line_shape.decompose_phase_errors(
            phase_at_nodes,
            np.empty((0, 0, 0)),
            line_shape.chebyshev_coefficient_matrix(2 * modes_max),
            modes,
        )
        n_modes = int(modes.n_modes[0, 0])
        if n_modes:
            tables = line_shape.line_shape_tables(window, fft_size, power, tier)
            shift = modes.line_shift[0, 0] * fft_size / window.length
            break
    if not n_modes:
        x = 2 * np.arange(window.length) / window.length - 1
        tables = line_shape.full_line_shape_tables(window, fft_size, power, phase(x)[None])
        modes = line_shape.zero_phase_error_modes(1, 1, 1)
    shape = line_shape.select_segment(line_shape.allocate_line_shapes(tables, 1), 0)
    line_shape.build_line_shape(0, np.int64(0), np.int64(-1), modes, tables, shape)
    layout = tables.layout._replace(spectrum_type=view)
    return PreparedShape(shape, layout, shift, n_modes)
