"""Compiled kernels are cached by the state of all sources of the model, wherever that is."""

import os
import shutil
import stat
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numba
import numpy as np
import pytest
from numba.core.errors import NumbaError, TypingError

import sweep
import sweep.kernel_cache
from sweep.model.detection.echo_detection import detect_in_spectra

PACKAGE = Path(sweep.__file__).parent

CALLED = """
from sweep.kernel_cache import njit
from sweep.model.constants import FACTOR

@njit(cache=True)
def scale(x):
    return FACTOR * x
"""

CALLER = """
from sweep.kernel_cache import njit
from sweep.model.called import scale

@njit(cache=True)
def scale_twice(x):
    return scale(scale(x))
"""

CODE = """
import resource, sys

exec(sys.argv[1])
from sweep.model.caller import scale_twice
print(scale_twice(1.0), sum(scale_twice.stats.cache_hits.values()))
"""


class SmallPackage:
    """The package with two kernels for a model: one calls the other, which reads a constant."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.package = folder, folder / "sweep"
        self.model = self.package / "model"
        self.model.mkdir(parents=True)
        for name in ("__init__.py", "kernel_cache.py"):
            shutil.copy(PACKAGE / name, self.package / name)
        (self.model / "__init__.py").touch()
        (self.model / "called.py").write_text(CALLED)
        (self.model / "caller.py").write_text(CALLER)
        self.set_factor(2.0)

    def set_factor(self, factor: float) -> None:
        (self.model / "constants.py").write_text(f"FACTOR = {factor:03.1f}\n")

    def run(self, first="pass", code=CODE, **variables):
        """Output of a process that imports the package."""
        environment = {name: value for name, value in os.environ.items() if "NUMBA" not in name}
        environment |= {"PYTHONPATH": str(self.folder), "PYTHONDONTWRITEBYTECODE": "1"} | variables
        process = subprocess.run(
            [sys.executable, "-c", code, first], capture_output=True, text=True, cwd=self.folder,
            env=environment, timeout=120,
        )  # fmt: skip
        assert process.returncode == 0, process.stderr
        self.said = process.stderr
        return process.stdout.strip()


@pytest.fixture
def small(tmp_path):
    return SmallPackage(tmp_path / "installed")


def files(folder, pattern="*.nb[ic]"):
    return {path: path.stat().st_mtime_ns for path in Path(folder).rglob(pattern)}


NOWHERE = dict.fromkeys(("HOME", "XDG_CACHE_HOME"), os.devnull)


@pytest.mark.parametrize(
    "place",
    [
        lambda folder: {"NUMBA_CACHE_DIR": str(folder)},
        lambda folder: {"XDG_CACHE_HOME": str(folder)},
        lambda folder: NOWHERE | {"TMPDIR": str(folder)},
    ],
    ids=["named", "user's cache", "temporary"],
)
def test_a_kernel_is_compiled_again_where_a_constant_of_one_that_it_calls_has_changed(
    small, tmp_path, place
):
    """numba's own cache would go on with the old constant: the caller's file is as it was."""
    cache = tmp_path / "cache"
    cache.mkdir()
    assert small.run(**place(cache)) == "4.0 0"
    assert small.run(**place(cache)) == "4.0 1"
    small.set_factor(3.0)
    assert small.run(**place(cache)) == "9.0 0"
    small.set_factor(2.0)  # the older kernels are there still
    assert small.run(**place(cache)) == "4.0 1"
    (root,) = cache.rglob(f"sweep-kernels-{os.getuid()}")
    assert stat.S_IMODE(root.stat().st_mode) == 0o700
    assert len(list(root.iterdir())) == 2


def test_contents_count_and_times_of_files_do_not(small, tmp_path):
    cache = {"NUMBA_CACHE_DIR": str(tmp_path)}
    constants = small.model / "constants.py"
    before = constants.stat()
    assert small.run(**cache) == "4.0 0"
    small.set_factor(3.0)  # as long, and as old by its date
    os.utime(constants, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert small.run(**cache) == "9.0 0"
    os.utime(constants)
    assert small.run(**cache) == "9.0 1"


def test_two_checkouts_share_a_folder(small, tmp_path):
    other = SmallPackage(tmp_path / "other")
    other.set_factor(3.0)
    cache = {"NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    assert [p.run(**cache) for p in (small, other, small, other)] == [
        "4.0 0", "9.0 0", "4.0 1", "9.0 1",
    ]  # fmt: skip


def test_nothing_is_written_into_the_package_nor_removed_from_it(small, tmp_path):
    """What is left there after pip has uninstalled the package would be imported as `sweep`."""
    kernel = small.model / "__pycache__" / "called.scale-5.py311.nbi"
    kernel.parent.mkdir()
    kernel.write_bytes(b"of an earlier version")
    before = files(small.folder, "*")
    link = tmp_path / "link"
    link.symlink_to(small.folder)
    small.run(code="import sweep, sys; assert 'numba' not in sys.modules")
    small.run(NUMBA_CACHE_DIR=str(tmp_path / "cache"), PYTHONPATH=str(link))
    assert files(small.folder, "*") == before


def test_functions_of_others_are_cached_where_numba_has_them(small, tmp_path):
    (small.folder / "mine.py").write_text("import numba\n@numba.njit(cache=True)\ndef f(): pass\n")
    code = "import sweep.kernel_cache, sweep.model.caller, mine, os; print(mine.f.stats.cache_path)"
    cache = tmp_path / "cache"
    compiled = small.run(code=code, NUMBA_CACHE_DIR=str(cache))
    assert Path(compiled).parent == cache and not Path(compiled).name.startswith("sweep-kernels")
    assert "NUMBA_CACHE_DIR" not in small.run(code=CODE + "import os; print(*os.environ)")


FULL = "resource.setrlimit(resource.RLIMIT_FSIZE, (0, resource.RLIM_INFINITY))"


def test_a_disk_without_room_for_kernels_is_reported_once_and_computing_goes_on(small, tmp_path):
    cache = {"NUMBA_CACHE_DIR": str(tmp_path)}
    assert small.run(first=FULL, **cache) == "4.0 0"
    assert small.said.count("can't be written (File too large)") == 1
    assert small.said.count("\n") == 1 and "NUMBA_CACHE_DIR names another folder" in small.said
    assert not files(tmp_path, "*.nbc")


def test_a_folder_that_others_can_write_to_is_not_used(small, tmp_path):
    """They may have put code there."""
    root = tmp_path / f"sweep-kernels-{os.getuid()}"
    root.mkdir()
    root.chmod(0o777)
    place = NOWHERE | {"TMPDIR": str(tmp_path)}
    assert small.run(**place) == small.run(**place) == "4.0 0"
    assert not list(root.iterdir()) and small.said.count("others can write there") == 1
    root.chmod(0o755)
    assert [small.run(**place), small.run(**place)] == ["4.0 0", "4.0 1"]
    root.rename(tmp_path / "elsewhere")
    root.symlink_to(tmp_path / "elsewhere")  # which its owner could change
    assert small.run(**place) == "4.0 0"


@pytest.mark.parametrize(
    "pattern, content",
    [("*.nbi", b""), ("*.nbi", None), ("*.nbc", b"garbage"), ("*.nbc", None)],
    ids=["empty index", "index cut short", "garbage", "kernel cut short"],
)
def test_damaged_kernels_are_compiled_again(small, tmp_path, pattern, content):
    cache = {"NUMBA_CACHE_DIR": str(tmp_path)}
    small.run(**cache)
    for path in files(tmp_path, pattern):
        path.write_bytes(path.read_bytes()[:-9] if content is None else content)
    assert small.run(**cache) == "4.0 0"
    assert small.run(**cache) == "4.0 1"


def test_a_kernel_of_another_signature_in_its_file_is_compiled_again(small, tmp_path):
    """As where two processes have saved two signatures at once, each as the first."""
    cache = {"NUMBA_CACHE_DIR": str(tmp_path)}
    code = CODE.replace("1.0", "1")  # by integers, in the same function
    small.run(code=CODE + "scale_twice(1)", **cache)
    by_float, by_integer = sorted(p for p in files(tmp_path) if "caller" in p.name)[:2]
    assert (by_float.suffix, by_integer.suffix) == (".nbc", ".nbc")
    by_integer.write_bytes(by_float.read_bytes())
    assert small.run(code=code, **cache) == "4.0 0"
    assert small.run(code=code, **cache) == "4.0 1"


def test_the_folder_may_be_removed_while_kernels_are_compiled(small, tmp_path):
    cache = {"NUMBA_CACHE_DIR": str(tmp_path)}
    code = """
import shutil
from sweep.model import called, caller
from sweep.kernel_cache import cache_folder
called.scale(1.0)
shutil.rmtree(cache_folder().path.parent)
print(caller.scale_twice(1.0))
"""
    assert small.run(code=code, **cache) == "4.0" and small.said == ""
    assert small.run(**cache) == "4.0 1"


def test_kernels_that_nobody_has_used_for_a_month_are_removed_as_others_are_compiled(
    small, tmp_path
):
    cache = {"NUMBA_CACHE_DIR": str(tmp_path)}
    small.run(**cache)
    (root,) = tmp_path.glob("sweep-kernels-*")
    (first,) = root.iterdir()
    month_ago = time.time() - sweep.kernel_cache.UNUSED_CACHE_AGE_MAX - 60.0
    (root / "notes").mkdir()  # of somebody's
    os.utime(root / "notes", (month_ago, month_ago))
    os.utime(first, (month_ago, month_ago))
    assert small.run(**cache) == "4.0 1"  # a use, which dates it
    small.set_factor(3.0)
    small.run(**cache)
    assert first.exists()
    os.utime(first, (month_ago, month_ago))
    small.run(**cache)  # which compiles nothing
    assert first.exists()
    small.set_factor(4.0)
    small.run(**cache)
    assert not first.exists() and len(list(root.iterdir())) == 3


def test_kernels_of_a_process_whose_sources_change_meanwhile_are_not_cached(small, tmp_path):
    cache = {"NUMBA_CACHE_DIR": str(tmp_path)}
    code = f"""
import sweep.model.called, pathlib
path = pathlib.Path({str(small.model / "caller.py")!r})
path.write_text(path.read_text().replace("scale(scale(x))", "scale(x)"))
from sweep.model.caller import scale_twice
print(scale_twice(1.0))
"""
    assert small.run(code=code, **cache) == "2.0"
    assert not files(tmp_path)
    (small.model / "caller.py").write_text(CALLER)
    assert small.run(**cache) == "4.0 0"


CHANGED_CONSTANT = """
import os, pathlib
import sweep.kernel_cache
sweep.kernel_cache.cache_folder()  # fingerprints the sources
path = pathlib.Path(sweep.kernel_cache.__file__).parent / "model" / "constants.py"
path.write_text("FACTOR = 5.00")
"""


def test_kernels_with_a_constant_that_changes_meanwhile_are_neither_cached_nor_loaded(
    small, tmp_path
):
    """The file of the kernel is as it was: only that of the constant has changed."""
    cache = {"NUMBA_CACHE_DIR": str(tmp_path)}
    assert small.run(first=CHANGED_CONSTANT, **cache) == "25.0 0"
    assert not files(tmp_path, "*.nbc")
    small.set_factor(2.0)
    assert small.run(**cache) == "4.0 0"
    assert small.run(**cache) == "4.0 1"
    assert small.run(first=CHANGED_CONSTANT, **cache) == "25.0 0"  # not the cached 4.0
    small.set_factor(2.0)
    assert small.run(**cache) == "4.0 1"  # what was cached before is right still


def test_settings_of_the_compiler_count(small, tmp_path):
    cache = {"NUMBA_CACHE_DIR": str(tmp_path)}
    small.run(**cache)
    assert small.run(NUMBA_OPT="0", **cache) == "4.0 0"
    assert small.run(NUMBA_NUM_THREADS="1", **cache) == "4.0 1"
    assert small.run(NUMBA_DISABLE_JIT="1", code=CODE.split("print")[0], **cache) == ""


def test_a_package_without_sources_compiles_uncached(small, tmp_path):
    """As in an archive, or of compiled modules alone."""
    archive = shutil.make_archive(str(tmp_path / "sweep"), "zip", small.folder)
    cache = tmp_path / "cache"
    compiled = small.run(NUMBA_CACHE_DIR=str(cache), PYTHONPATH=archive, code=CODE.replace(
        "import resource", f"import os; os.chdir({str(tmp_path)!r}); sys = __import__('sys'); "
        "sys.path.remove('') if '' in sys.path else None; import resource"
    ))  # fmt: skip
    assert compiled == "4.0 0" and not files(cache)


def test_all_kernels_of_the_package_are_cached_by_the_fingerprint():
    """No module outside the model has kernels."""
    users = {
        path.relative_to(PACKAGE).as_posix()
        for path in PACKAGE.rglob("*.py")
        if "njit" in path.read_text()
    }
    other_users = {name for name in users if not name.startswith("model/")}
    assert other_users == {"kernel_cache.py"} and len(users) > 15
    for name in users - {"kernel_cache.py"}:
        assert "from numba" not in (PACKAGE / name).read_text()


def test_kernels_are_cached_among_temporary_files_where_the_user_has_no_home(monkeypatch, tmp_path):
    def fail():
        raise RuntimeError("could not determine the home directory")

    monkeypatch.setattr(sweep.kernel_cache, "user_cache_dir", fail)
    monkeypatch.setattr(numba.config, "CACHE_DIR", "")
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    folder = sweep.kernel_cache.cache_folder.__wrapped__()
    assert folder.path is not None and folder.path.parent.parent == tmp_path


def test_the_model_is_cached_by_the_fingerprint():
    folder = sweep.kernel_cache.cache_folder()
    assert (
        Path(detect_in_spectra.stats.cache_path).parent == folder.path
        and folder.not_cached_reason == ""
    )


def _sum_of_first_row(table):
    row, total = table[0], 0.0
    for value in row:
        total += value
    return total


def _first_row(table):
    return table[0]


def _first_row_and_sum(table):
    return table[0], table.sum()


def _doubled(table):
    return (2.0 * table).sum()


def test_a_kernel_that_borrows_leaves_counts_of_references_as_they_are():
    table = np.arange(6.0).reshape(2, 3)
    before = sys.getrefcount(table)
    kernel = sweep.kernel_cache.njit(cache=True, borrows=True)(_sum_of_first_row)
    assert [kernel(table) for _ in range(100)] == [3.0] * 100
    assert sys.getrefcount(table) == before


@pytest.mark.parametrize("returns_array", [_first_row, _first_row_and_sum])
def test_a_kernel_that_borrows_returns_no_array(returns_array):
    kernel = sweep.kernel_cache.njit(cache=True, borrows=True)(returns_array)
    # Numba refuses to return an array alone.
    with pytest.raises((TypeError, TypingError), match=r"borrows arrays|returning of array"):
        kernel(np.ones((2, 3)))
    # Uncached, as the cache would hand it to the kernel that borrows.
    assert sweep.kernel_cache.njit()(returns_array)(np.ones((2, 3))) is not None


def test_a_kernel_that_borrows_makes_no_array():
    kernel = sweep.kernel_cache.njit(cache=True, borrows=True)(_doubled)
    # The kind of error depends on what has been compiled before.
    with pytest.raises(NumbaError, match="NRT required"):
        kernel(np.ones((2, 3)))


def test_a_kernel_makes_arrays_though_the_one_that_calls_it_borrows():
    inner = sweep.kernel_cache.njit()(_doubled)

    def call(table):
        return inner(table)

    assert sweep.kernel_cache.njit(borrows=True)(call)(np.ones((2, 3))) == 12.0
