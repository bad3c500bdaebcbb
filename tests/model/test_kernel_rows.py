"""Scratch for known kernels: so much is kept, and less where addresses run out."""

import numpy as np
import pytest

from sweep.model import kernel_rows
from sweep.model.kernel_rows import MOST_KEPT, ROWS, WIDTH, kernels_of


@pytest.fixture
def scratch(monkeypatch):
    """A thread's scratch that nothing is on, of small rows."""
    monkeypatch.setattr(kernel_rows, "_SCRATCH", type("Scratch", (), {})())
    return kernel_rows._SCRATCH


def test_a_thread_keeps_the_last_kinds(scratch):
    rows = [kernels_of("kind", k) for k in range(MOST_KEPT + 2)]
    assert rows[0].shape == (ROWS, WIDTH) and not rows[-1][::50].any()
    assert list(scratch.kept) == [("kind", k) for k in range(2, MOST_KEPT + 2)]
    assert kernels_of("kind", 2) is rows[2] and kernels_of("kind", 0) is not rows[0]


def test_where_addresses_run_out_what_is_kept_is_forgotten(scratch, monkeypatch):
    """As under `ulimit -v`: there is never more than the number kept, and one is enough."""
    there, most = [], []

    def untouched(shape):
        most.append(len(scratch.kept))
        if len(scratch.kept) > 1:
            raise OSError(12, "Cannot allocate memory")
        there.append(shape)
        return np.zeros(1)

    monkeypatch.setattr(kernel_rows, "_untouched", untouched)
    for k in range(9):
        assert kernels_of("kind", k, further=2).size == 1
    assert len(there) == 9 and max(most) < MOST_KEPT and set(there) == {(ROWS + 2, WIDTH)}
