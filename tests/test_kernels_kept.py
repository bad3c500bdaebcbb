"""Kernels are kept somewhere, however little of a machine can be written."""

import os
import shutil
import stat
import subprocess
import sys
from pathlib import Path

import pytest

import sweep

CODE = """
import numba, numpy, os, numba.core.config
from sweep.model.geometry.bvh import build
build(numpy.eye(3), numpy.array([[0, 1, 2]]))
assert os.environ["NUMBA_CACHE_DIR"] == numba.core.config.CACHE_DIR
print(numba.core.config.CACHE_DIR)
"""


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """The package where nothing can be written beside it, by root neither."""
    folder = tmp_path_factory.mktemp("installed")
    shutil.copytree(
        Path(sweep.__file__).parent, folder / "sweep", ignore=shutil.ignore_patterns("__pycache__")
    )
    for package in [path for path in (folder / "sweep").rglob("*") if path.is_dir()]:
        (package / "__pycache__").touch()
    return folder


def kept(installed, temporary):
    """Places of compiled kernels, without a home."""
    nowhere = dict.fromkeys(("HOME", "XDG_CACHE_HOME"), os.devnull)
    environment = {name: value for name, value in os.environ.items() if "NUMBA" not in name}
    done = subprocess.run(
        [sys.executable, "-c", CODE], capture_output=True, text=True, cwd=installed,
        env=environment | nowhere | {"TMPDIR": str(temporary), "PYTHONPATH": str(installed)},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    folder = Path(done.stdout.strip())
    assert any(folder.rglob("*.nbi"))
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700 and folder.parent == temporary
    return folder.name


def test_without_a_folder_of_its_own_kernels_are_kept_in_a_temporary_one(installed, tmp_path):
    mine = f"sweep-kernels-{os.getuid()}"
    assert kept(installed, tmp_path) == kept(installed, tmp_path) == mine
    (tmp_path / mine).chmod(0o777)  # others may have put code there
    another = kept(installed, tmp_path)
    assert another != mine and another.startswith("sweep-kernels-")


def test_kernels_of_other_sources_are_forgotten(tmp_path):
    """One that calls a changed one too, whose own file is as it was."""
    package = tmp_path / "sweep"
    shutil.copytree(
        Path(sweep.__file__).parent, package, ignore=shutil.ignore_patterns("__pycache__")
    )
    environment = {name: value for name, value in os.environ.items() if "NUMBA" not in name}

    def kernels(code):
        command = [sys.executable, "-c", code]
        subprocess.run(
            command, check=True, cwd=tmp_path, env=environment | {"PYTHONPATH": str(tmp_path)}
        )
        return {path.name: path.stat().st_mtime_ns for path in package.rglob("*.nbi")}

    compiled = kernels(CODE.replace("assert", "#").replace("print", "#"))
    assert any(name.startswith("bvh.") for name in compiled)
    assert kernels("import sweep") == compiled
    with (package / "model" / "elementary.py").open("a") as changed:
        changed.write("\n")
    assert kernels("import sweep") == {}
