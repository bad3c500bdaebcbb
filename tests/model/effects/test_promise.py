"""Tolerances are kept of instruments drawn at random, near DC and Nyquist and smeared."""

from pathlib import Path

import numpy as np
import pytest

BENCHMARKS = Path(__file__).parents[3] / "benchmarks"
TOLERANCES = (1e-2, 1e-3, 1e-5)


@pytest.fixture(scope="module")
def promise_instruments():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(BENCHMARKS)
        import tolerance_of_random_instruments

        yield tolerance_of_random_instruments


@pytest.mark.parametrize("asked", ["nothing", "leakage", "jitter"])
def test_random_instruments_keep_each_tolerance(promise_instruments, asked):
    studies = promise_instruments.random_study_mappings(36, np.random.default_rng(6))
    chosen = [study for study in studies if study["title"].endswith(asked)]
    for study in chosen:
        for tolerance, off in zip(
            TOLERANCES, promise_instruments.errors_at_tolerances(study, TOLERANCES), strict=True
        ):
            for errors in (off.pd, off.magnitude, off.leakage):
                there = errors[np.isfinite(errors)]
                assert (there <= tolerance).all(), (study["title"], tolerance, there.max())
            assert (off.error_bound <= tolerance).all()
