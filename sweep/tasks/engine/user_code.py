"""Python modules of the user's that a run may import: permission, import, and digests.

Processes that compute import code of the user's only from modules allowed by ``--allow-code
MODULE``, by ``allow_code=[...]``, or in the environment variable ``SWEEP_ALLOW_CODE``. A run tells
its workers which modules are allowed, and excludes a worker whose file of a module differs.
"""

from __future__ import annotations

import os
import socket
import sys
import traceback
from collections.abc import Iterable
from functools import lru_cache
from hashlib import blake2b
from importlib import import_module
from pathlib import Path
from types import ModuleType

from sweep.tasks.engine.progress import CodeError

#: Environment variable with the names of the modules that may be imported, separated by commas.
ALLOWED_MODULES_VARIABLE = "SWEEP_ALLOW_CODE"


def allow_modules(modules: Iterable[str]) -> None:
    """Allow this process, and processes that it starts, to import modules of the user's, by name.

    A module's name is the text before the colon in a spec. CodeError is raised for an invalid name.
    """
    for module in (modules := list(modules)):
        if module.endswith(".py") or not all(
            name_part.isidentifier() for name_part in module.split(".")
        ):
            name = module.partition(":")[0].removesuffix(".py").replace("/", ".")
            suggestion_text = f"; write {name!r}" if name.replace(".", "_").isidentifier() else ""
            raise CodeError(
                f"{module!r} is no name of a Python module, as a spec has it before the "
                f"colon{suggestion_text}"
            )
    module_names = {*allowed_modules(), *modules}
    if module_names:
        os.environ[ALLOWED_MODULES_VARIABLE] = ",".join(sorted(module_names))
        _append_working_directory_to_path()  # spawned workers inherit the search path


def _append_working_directory_to_path() -> None:
    """Append the working directory to Python's search path.

    It is searched last, as any user may have put files there.
    """
    if (working_directory := os.getcwd()) not in sys.path:
        sys.path.append(working_directory)


def allowed_modules() -> set[str]:
    """Return the names of the modules that this process may import."""
    return set(filter(None, os.environ.get(ALLOWED_MODULES_VARIABLE, "").split(",")))


def module_digests(modules: Iterable[str]) -> dict[str, str]:
    """Import modules. Return the digests of their files, by module name; '' without a file."""
    return {name: _module_file_digest(import_module(name)) for name in modules}


def _module_file_digest(module: ModuleType) -> str:
    """Return the digest of the file of a module; '' if it has none."""
    source = getattr(module, "__file__", None)
    return blake2b(Path(source).read_bytes(), digest_size=16).hexdigest() if source else ""


@lru_cache(maxsize=64)
def allow_identical_module(module: str, digest: str) -> None:
    """Allow a module in this worker, if the module's file has the given digest.

    The digest is that of the file of the process that started the run. CodeError is raised if the
    file differs. The file is checked once per process, as an imported module does not change with
    its file.
    """
    allow_modules([module])
    imported_module = import_user_module(module)
    local_digest = _module_file_digest(imported_module)
    if digest and local_digest != digest:
        raise CodeError(
            f"the module {module} is not the same file on {socket.gethostname()} "
            f"({getattr(imported_module, '__file__', None)}) as where the run was started: "
            "put the same file on all machines"
        )


def import_user_module(name: str) -> ModuleType:
    """Import and return a module of the user's, given by name.

    CodeError, with the reason, is raised if that fails.
    """
    _append_working_directory_to_path()
    try:
        return import_module(name)
    except (Exception, SystemExit) as error:
        host_text = f" on {socket.gethostname()}"
        if isinstance(error, ModuleNotFoundError) and error.name == name.partition(".")[0]:
            raise CodeError(
                f"there is no module {error.name}{host_text}: put {error.name}.py into the folder "
                f"{os.getcwd()}, or its folder into PYTHONPATH, for workers on other machines in "
                "the section environment of the cluster's file"
            ) from error
        place_text = _import_error_place_text(error)
        raise CodeError(
            f"the module {name} can't be imported{host_text}: {type(error).__name__}: "
            f"{error}{place_text}"
        ) from error


def _import_error_place_text(error: BaseException) -> str:
    """Return file and line where the import of a module failed, as text; '' if unknown."""
    if isinstance(error, SyntaxError):
        return f" ({error.filename}:{error.lineno})"
    frames = traceback.extract_tb(error.__traceback__)
    user_frames = [
        frame
        for frame in frames
        if frame.filename != __file__ and "importlib" not in frame.filename
    ]
    return f" ({user_frames[-1].filename}:{user_frames[-1].lineno})" if user_frames else ""
