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


@pytest.mark.parametrize("title_end", ["nothing", "leakage", "jitter"])
def test_random_instruments_keep_each_tolerance(promise_instruments, title_end):
    studies = promise_instruments.random_study_mappings(36, np.random.default_rng(6))
    chosen = [study for study in studies if study["title"].endswith(title_end)]
    for study in chosen:
        for tolerance, error_of_tolerance in zip(
            TOLERANCES, promise_instruments.errors_at_tolerances(study, TOLERANCES), strict=True
        ):
            for errors in (
                error_of_tolerance.pd,
                error_of_tolerance.magnitude,
                error_of_tolerance.leakage,
            ):
                finite_errors = errors[np.isfinite(errors)]
                assert (finite_errors <= tolerance).all(), (
                    study["title"],
                    tolerance,
                    finite_errors.max(),
                )
            assert (error_of_tolerance.error_bound <= tolerance).all()
