"""Pages are made without settings of a user, or of the folder that they are made in."""

import os
import subprocess
import sys

import pytest

UNKNOWN = """
import pwd

def unknown(number):
    raise KeyError(f"getpwuid(): uid not found: {number}")

pwd.getpwuid = unknown
"""


@pytest.mark.parametrize("home", ["nobody's home", "a pipe for settings", "other settings"])
def test_a_page_needs_no_home_and_no_settings(tmp_path, home):
    pytest.importorskip("itables")
    variables = ("HOME", "ITABLES_CONFIG")
    environment = {name: value for name, value in os.environ.items() if name not in variables}
    environment = {n: v for n, v in environment.items() if not n.startswith("XDG_")}
    if home == "a pipe for settings":
        os.mkfifo(tmp_path / "itables.toml")
    elif home == "other settings":
        (tmp_path / "itables.toml").write_text('classes = "theirs"\n')
    code = UNKNOWN if home == "nobody's home" else ""
    code += (
        "import os, sweep.report.html_page, itables.options as options\n"
        "assert 'ITABLES_CONFIG' not in os.environ\n"
        "assert options.classes != 'theirs'\n"
    )
    process = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, env=environment, timeout=120,
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert process.returncode == 0, process.stderr
