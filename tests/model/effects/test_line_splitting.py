"""A phase error over the record as a few lines, against the phase itself."""

import os
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sweep.model.effects.line_splitting import TOLERANCE, _decomposed, split_lines

PLACES = np.random.default_rng(3).uniform(-1, 1, 500)


def factor(split, x):
    """What the lines add up to at places x of the record."""
    turns = np.exp(1j * np.pi * split.offset[:, :, None] * x)
    return (split.weight[:, :, None] * turns).sum(axis=1)


def polynomial(*coefficients):
    """Rows of coefficients, lowest power first, as a phase."""
    return lambda x: np.polynomial.polynomial.polyval(x, np.array(coefficients).T)


@settings(max_examples=40)
@given(st.floats(-300, 300), st.floats(-6, 1.2), st.floats(-6, 0.5), st.sampled_from((-1, 1)))
def test_the_lines_are_the_phase_factor_everywhere(shift, drift, cubic, sign):
    phase = polynomial([0.3, shift / 2, sign * 10**drift / 8, 10**cubic / 8])
    split = split_lines(phase)
    missed = factor(split, PLACES) - np.exp(2j * np.pi * phase(PLACES))
    # The checks lie as densely as the nodes; between them it can be somewhat more.
    assert np.abs(missed).max() < 1.5 * TOLERANCE
    assert (split.error <= TOLERANCE).all()


@pytest.mark.parametrize(("periods", "peak"), [(0.3, 1.5), (1, 0.5), (2.5, 0.1), (7, 1e-4)])
def test_a_sinusoidal_error_is_split_as_well(periods, peak):
    def phase(x):
        return peak * np.sin(np.pi * periods * x + 0.4)[None]

    missed = factor(split_lines(phase), PLACES) - np.exp(2j * np.pi * phase(PLACES))
    assert np.abs(missed).max() < 1.5 * TOLERANCE


def test_rows_of_different_widths_keep_their_order():
    drifts = np.array([8.0, 0.0, 1e-3, 60.0, -3.0])
    phase = polynomial(*[[0, 0, d / 8] for d in drifts])
    split = split_lines(phase)
    assert np.abs(factor(split, PLACES) - np.exp(2j * np.pi * phase(PLACES))).max() < 2e-9
    assert split.number.argmin() == 1 and split.number.argmax() == 3
    beyond = np.arange(split.weight.shape[1]) >= split.number[:, None]
    assert not split.weight[beyond].any()


def test_a_mere_shift_is_one_line_elsewhere():
    split = split_lines(polynomial([0.25, 3.5 / 2]))
    assert split.number[0] == 1
    np.testing.assert_allclose(split.offset[0], [3.5])
    np.testing.assert_allclose(split.weight[0], [1j], atol=1e-12)


def test_a_drift_beyond_all_lines_is_refused():
    with pytest.raises(ValueError, match="over 2e\\+03 bins"):
        split_lines(polynomial([0, 0, 2000 / 8]))


def test_no_row_depends_on_the_rows_beside_it():
    drifts = np.array([8.0, 0.0, 1e-3, 60.0, -3.0, 0.4, 1e-5])
    together = split_lines(polynomial(*[[0.1, 2.3, d / 8] for d in drifts]))
    for i, drift in enumerate(drifts):
        alone = split_lines(polynomial([0.1, 2.3, drift / 8]))
        lines = alone.number[0]
        assert lines == together.number[i]
        for name in ("offset", "weight"):
            one, other = getattr(alone, name)[0, :lines], getattr(together, name)[i, :lines]
            assert one.tobytes() == other.tobytes()


THREADS = """
import sys
import numpy as np
from sweep.model.effects.line_splitting import split_lines

drift = np.array([1e-3, 0.1, 3.0, 20.0, 70.0, 150.0, 300.0])
split = split_lines(lambda x: np.outer(drift / 8, x * x))
open(sys.argv[1], "wb").write(split.weight.tobytes() + split.offset.tobytes())
"""


def test_the_number_of_threads_changes_no_bit(tmp_path):
    """Products of matrices and decompositions of a library's would not hold that."""
    for threads in ("1", "2"):
        few = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), threads)
        command = [sys.executable, "-c", THREADS, str(tmp_path / threads)]
        subprocess.run(command, check=True, env=os.environ | few)
    assert (tmp_path / "1").read_bytes() == (tmp_path / "2").read_bytes()


@pytest.mark.parametrize("shape", [(1, 1), (9, 4), (40, 40), (130, 48)])
def test_the_decomposition_is_one_and_its_values_are_lapacks(shape):
    """Of matrices as of lines closer than a bin: values down to the last digit of the largest."""
    turns = np.outer(np.linspace(-1, 1, shape[0]), np.arange(shape[1]))
    matrix = np.cos(0.6 * turns)
    u, s, v = _decomposed(matrix)
    assert np.abs((u * s) @ v - matrix).max() < 1e-13 * s.max()
    np.testing.assert_allclose(v @ v.T, np.eye(s.size), atol=1e-13)
    large = s > 1e-13 * s.max()
    np.testing.assert_allclose(u.T[large] @ u[:, large], np.eye(large.sum()), atol=1e-12)
    expected = np.linalg.svd(matrix, compute_uv=False)
    np.testing.assert_allclose(np.sort(s)[::-1], expected, atol=1e-14 * s.max())
