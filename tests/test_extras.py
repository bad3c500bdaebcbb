"""Packages that only some studies need: each has an extra, and a missing one is one line."""

import re
import sys
import tomllib
from pathlib import Path

import pytest
from click.testing import CliRunner

from sweep.cli import main
from sweep.extras import EXTRA_BY_MODULE, install_hint

ROOT = Path(__file__).parents[1]
OPTIONAL = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]


def imported(extra):
    """Modules of an extra's own packages."""
    names = {re.match(r"[\w-]+", package)[0] for package in OPTIONAL[extra]}
    return {name.replace("-", "_").lower() for name in names}


@pytest.mark.parametrize("module", EXTRA_BY_MODULE)
def test_every_optional_module_is_brought_by_its_extra(module):
    brought = imported(EXTRA_BY_MODULE[module])
    assert (
        module in brought or EXTRA_BY_MODULE[module] == "kubernetes"
    )  # its own packages' dependencies
    assert EXTRA_BY_MODULE[module] in OPTIONAL["all"][0]


def test_a_missing_package_is_one_line_that_tells_what_installs_it(monkeypatch):
    for name in {"obstore", *(name for name in sys.modules if name.startswith("obstore."))}:
        monkeypatch.setitem(sys.modules, name, None)  # those too that another test has imported
    result = CliRunner().invoke(main, ["status", "s3://bucket/study.zarr"], catch_exceptions=False)
    assert result.exit_code == 2
    assert result.output == "obstore is not installed: pip install 'sweep[cloud]'\n"


def test_other_errors_have_no_remedy():
    assert install_hint(ModuleNotFoundError("No module named 'mine'", name="mine")) == ""
    assert install_hint(ValueError("trimesh")) == ""
