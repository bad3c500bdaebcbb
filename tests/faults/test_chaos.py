"""A few of the kills that `make chaos` does by the hundred."""

import os
import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.slow
@pytest.mark.parametrize(
    "kills, kinds",
    [("10", ""), ("1", "scheduler|power, run")],
    ids=["of all kinds", "of kinds that no other test has"],
)
def test_killed_studies_end_as_if_nobody_had_disturbed_them(kills, kinds):
    script = Path(__file__).with_name("chaos.py")  # forks, which a process with threads should not
    command = [sys.executable, str(script), "--kills", kills, "--seed", "20", "--only", kinds]
    environment = {**os.environ, "COLUMNS": "200"}
    process = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert process.returncode == 0, process.stdout + process.stderr
    assert "nothing lost, nothing twice, every store identical" in process.stdout
