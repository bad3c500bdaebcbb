"""Monte Carlo sweeps of FMCW Doppler lidar performance.

`load` a spec, `run` it into a store, `open` the store as an xarray Dataset; the store of a scene
as a DataTree with `open_scene`; `export` its point clouds, or see what the unit `reports`. `status`
says how far a store is, `verify` checks every byte of it.
"""

from __future__ import annotations

from importlib import import_module
from importlib.metadata import version as _version
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # as checkers of programs that use it see the names below
    from sweep.analysis.export import export
    from sweep.analysis.opening import open, open_scene
    from sweep.analysis.reports import reports
    from sweep.spec import load
    from sweep.tasks.doubts import StudyWarning
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
    "StudyWarning": "sweep.tasks.doubts",
}

__all__ = [
    "StudyWarning", "__version__", "export", "extend", "load", "open", "open_scene", "reports",
    "resume", "run", "status", "verify",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    """Public names, from where they live."""
    if name in _HOMES:
        return getattr(import_module(_HOMES[name]), name)
    raise AttributeError(f"module 'sweep' has no attribute {name!r}")


def __dir__() -> list[str]:
    """Public names."""
    return sorted([*globals(), *_HOMES])
