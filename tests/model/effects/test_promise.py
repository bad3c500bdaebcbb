"""Tolerances are kept of instruments drawn at random, near DC and Nyquist and smeared."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

FILE = Path(__file__).parents[3] / "benchmarks" / "promise_instruments.py"
TOLERANCES = (1e-2, 1e-3, 1e-5)


@pytest.fixture(scope="module")
def promise_instruments():
    found = importlib.util.spec_from_file_location("promise_instruments", FILE)
    module = importlib.util.module_from_spec(found)
    found.loader.exec_module(module)
    return module


@pytest.mark.parametrize("asked", ["nothing", "leakage", "jitter"])
def test_random_instruments_keep_each_tolerance(promise_instruments, asked):
    studies = promise_instruments.studies(240, np.random.default_rng(6))
    chosen = [study for study in studies if study["title"].endswith(asked)]
    for study in chosen:
        for tolerance, off in zip(
            TOLERANCES, promise_instruments.off(study, TOLERANCES), strict=True
        ):
            for errors in (off.pd, off.magnitude, off.leakage):
                there = errors[np.isfinite(errors)]
                assert (there <= tolerance).all(), (study["title"], tolerance, there.max())
            assert (off.told <= tolerance).all()
