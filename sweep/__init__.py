"""Monte Carlo sweeps of FMCW Doppler lidar performance.

`load` a spec, `run` it into a store, `open` the store as an xarray Dataset; the store of a scene
as a DataTree with `open_scene`; `export` its point clouds, or see what the unit `reports`. `status`
says how far a store is, `verify` checks every byte of it.
"""

from __future__ import annotations

import os
import stat
import sys
from contextlib import suppress
from importlib import import_module
from importlib.metadata import version as _version
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # as checkers of programs that use it see the names below
    from sweep.analysis.export import export
    from sweep.analysis.opening import open, open_scene
    from sweep.analysis.reports import reports
    from sweep.spec import load
    from sweep.tasks.driver import extend, resume, run
    from sweep.tasks.summary import status
    from sweep.tasks.verify import verify

__version__ = _version("sweep")

#: Where each public name comes from; imported on first use, so that `import sweep` stays cheap.
_HOMES = {
    "load": "sweep.spec",
    "run": "sweep.tasks.driver",
    "resume": "sweep.tasks.driver",
    "extend": "sweep.tasks.driver",
    "open": "sweep.analysis.opening",
    "open_scene": "sweep.analysis.opening",
    "export": "sweep.analysis.export",
    "reports": "sweep.analysis.reports",
    "status": "sweep.tasks.summary",
    "verify": "sweep.tasks.verify",
}

__all__ = [
    "__version__", "export", "extend", "load", "open", "open_scene", "reports", "resume", "run",
    "status", "verify",
]  # fmt: skip


def _is_writable(folder: Path) -> bool:
    """Tell whether files can be put into a folder, which may be still to be made."""
    while not folder.exists():
        folder = folder.parent
    return folder.is_dir() and os.access(folder, os.W_OK | os.X_OK)


def _own_folder() -> str:
    """Return a temporary folder that nobody else can write: the kernels in it are run."""
    import tempfile

    folder = Path(tempfile.gettempdir()) / f"sweep-kernels-{os.getuid()}"
    with suppress(FileExistsError):
        folder.mkdir(mode=0o700)
    found = folder.lstat()
    if stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and not found.st_mode & 0o077:
        return str(folder)
    return tempfile.mkdtemp(prefix="sweep-kernels-")


def _keep_kernels() -> None:
    """Have numba cache kernels in a temporary folder if no other is writable.

    Neither the package's folder nor the user's cache is in some containers and shared installs.
    """
    cache = Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"))
    places = Path(__file__).parent / "model" / "__pycache__", cache / "numba"
    if "NUMBA_CACHE_DIR" in os.environ or any(map(_is_writable, places)):
        return
    os.environ["NUMBA_CACHE_DIR"] = _own_folder()
    if "numba" in sys.modules:  # it has read its settings already
        sys.modules["numba"].config.CACHE_DIR = os.environ["NUMBA_CACHE_DIR"]


def _forget_kernels() -> None:
    """Delete kernels in the package that were compiled from other sources than are there now.

    A kernel has those that it calls built in, but numba's cache looks at its own file alone: where
    another has changed it would go on with the old one.
    """
    model = Path(__file__).parent / "model"
    compiled_from = model / "__pycache__" / "compiled_from"
    with suppress(OSError):
        found = sorted((str(path), path.stat()) for path in model.rglob("*.py"))
        sources = "\n".join(f"{path} {seen.st_size} {seen.st_mtime_ns}" for path, seen in found)
        if not compiled_from.exists() or compiled_from.read_text() != sources:
            for kernel in model.rglob("*.nb[ci]"):
                kernel.unlink(missing_ok=True)
            compiled_from.parent.mkdir(exist_ok=True)
            compiled_from.write_text(sources)


_keep_kernels()
_forget_kernels()


def __getattr__(name: str) -> Any:
    """Public names, from where they live."""
    if name in _HOMES:
        return getattr(import_module(_HOMES[name]), name)
    raise AttributeError(f"module 'sweep' has no attribute {name!r}")


def __dir__() -> list[str]:
    """Public names."""
    return sorted([*globals(), *_HOMES])
