"""Memory of a flight's study, ten times as long."""

import os
import subprocess
import sys
import time

import psutil
import pytest

SCRIPT = """
import sys
from small_flights import SCENE_MAPPING, small_scene_spec
from sweep.tasks.driver import run

if __name__ == "__main__":
    path = SCENE_MAPPING["platform"]["path"] | {"initial_speed": "24 m/s", "final_speed": "24 m/s"}
    spec = small_scene_spec(
        platform=SCENE_MAPPING["platform"] | {"path": path},  # 50 s
        scanners={"corners": {"kind": "corners", "angle": "7.5 deg", "rate": sys.argv[1]}},
        draws={"number": 1},
        storage={},
        axes={},
    )
    outcome = run(spec, store=sys.argv[2], workers=2, progress=False)
    assert outcome.complete and outcome.points == int(sys.argv[3]), outcome
"""


def peak_memory(tmp_path, rate: str, shots: int) -> int:
    """Largest memory of any process of a run [bytes]."""
    script = tmp_path / "flight.py"
    script.write_text(SCRIPT)
    command = [sys.executable, str(script), rate, str(tmp_path / f"{shots}.zarr"), str(shots)]
    environment = {**os.environ, "PYTHONPATH": os.path.dirname(__file__)}
    with subprocess.Popen(command, env=environment) as child:
        peak, driver = 0, psutil.Process(child.pid)
        while child.poll() is None:
            for process in [driver, *driver.children(recursive=True)]:
                try:
                    peak = max(peak, process.memory_info().rss)
                except psutil.NoSuchProcess:
                    continue
            time.sleep(0.05)
    assert child.returncode == 0
    return peak


@pytest.mark.slow
def test_a_million_shots_take_no_more_memory_than_a_tenth_of_them(tmp_path):
    few = peak_memory(tmp_path, "500 Hz", 100_000)
    many = peak_memory(tmp_path, "5 kHz", 1_000_000)
    assert many < 1.1 * few, (few, many)
