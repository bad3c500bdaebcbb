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
    from sweep.analysis.datasets import open, open_scene
    from sweep.analysis.scene_results.interface_reports import reports
    from sweep.analysis.scene_results.point_export import export
    from sweep.spec import load
    from sweep.tasks.driver import extend, resume, run
    from sweep.tasks.studies.store_summary import status
    from sweep.tasks.studies.store_verification import verify
    from sweep.tasks.studies.study_warnings import StudyWarning

__version__ = _version("sweep")

#: Where each public name comes from; imported on first use, so that `import sweep` stays cheap.
_MODULE_BY_NAME = {
    "load": "sweep.spec",
    "run": "sweep.tasks.driver",
    "resume": "sweep.tasks.driver",
    "extend": "sweep.tasks.driver",
    "open": "sweep.analysis.datasets",
    "open_scene": "sweep.analysis.datasets",
    "export": "sweep.analysis.scene_results.point_export",
    "reports": "sweep.analysis.scene_results.interface_reports",
    "status": "sweep.tasks.studies.store_summary",
    "verify": "sweep.tasks.studies.store_verification",
    "StudyWarning": "sweep.tasks.studies.study_warnings",
}

__all__ = [
    "StudyWarning", "__version__", "export", "extend", "load", "open", "open_scene", "reports",
    "resume", "run", "status", "verify",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    """Public names, from where they live."""
    if name in _MODULE_BY_NAME:
        return getattr(import_module(_MODULE_BY_NAME[name]), name)
    raise AttributeError(f"module 'sweep' has no attribute {name!r}")


def __dir__() -> list[str]:
    """Public names."""
    return sorted([*globals(), *_MODULE_BY_NAME])
