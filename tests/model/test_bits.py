"""The same bits from code just compiled and from code read back from its cache."""

import os
import subprocess
import sys

import pytest

SCRIPT = """
import sys
import numpy as np
from conftest import TABLE_4_1
from sweep.model.evaluation import evaluate

found = b""
for phases in ("coherent", "incoherent"):
    point = dict(TABLE_4_1) | {"footprint.phases": phases, "footprint.beamlets": 9}
    point["target.range"] = np.linspace(3.0, 9000.0, 40)
    point["target.grazing_angle"] = np.linspace(0.05, np.pi / 2, 40)
    found += b"".join(values.tobytes() for values in evaluate(point).values())
open(sys.argv[1], "wb").write(found)
"""


@pytest.mark.slow
def test_a_cached_kernel_has_the_bits_of_one_just_compiled(tmp_path):
    tests = os.path.dirname(os.path.dirname(__file__))
    cache = {"NUMBA_CACHE_DIR": str(tmp_path / "cache"), "PYTHONPATH": tests}
    for name in ("compiled", "cached"):
        command = [sys.executable, "-c", SCRIPT, str(tmp_path / name)]
        subprocess.run(command, check=True, env=os.environ | cache)
    assert (tmp_path / "compiled").read_bytes() == (tmp_path / "cached").read_bytes()
