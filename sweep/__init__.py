"""Monte Carlo simulation of the performance of FMCW Doppler lidars.

`load` a spec and `run` it into a store. `open` the store of a grid as an xarray Dataset, or the
store of a scene as a DataTree with `open_scene`. `export` writes point clouds, and `reports`
returns the unit's reports. `status` returns the progress of a store, and `verify` checks all of its
bytes.
"""

from __future__ import annotations

from importlib import import_module
from importlib.metadata import version as _version
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # type checkers see the public names by these imports
    from sweep.analysis.datasets import open, open_scene
    from sweep.analysis.scene_results.interface_reports import reports
    from sweep.analysis.scene_results.point_export import export
    from sweep.spec import load
    from sweep.tasks.driver import extend, resume, run
    from sweep.tasks.studies.store_summary import status
    from sweep.tasks.studies.store_verification import verify
    from sweep.tasks.studies.study_warnings import StudyWarning

__version__ = _version("sweep")

# Imported on first use, so that `import sweep` stays fast.
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
"""Module that defines each public name of `sweep`, by that name."""

__all__ = [
    "StudyWarning", "__version__", "export", "extend", "load", "open", "open_scene", "reports",
    "resume", "run", "status", "verify",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    """Import a public name on first use."""
    if name in _MODULE_BY_NAME:
        return getattr(import_module(_MODULE_BY_NAME[name]), name)
    raise AttributeError(f"module 'sweep' has no attribute {name!r}")


def __dir__() -> list[str]:
    """Return the names of the module, including public names that are not yet imported."""
    return sorted([*globals(), *_MODULE_BY_NAME])
