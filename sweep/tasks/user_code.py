"""Detectors and estimators that are functions of the user's: allowed, imported, checked.

A spec names them as ``module:function``; reading it imports nothing. Processes that compute import
them only from modules allowed by ``--allow-code MODULE``, by ``allow_code=[...]``, or in the
environment variable ``SWEEP_ALLOW_CODE``. A run tells its workers, wherever they are, which modules
are allowed, and refuses a worker that has another file of that name.
"""

from __future__ import annotations

import os
import socket
import sys
import traceback
from collections.abc import Callable, Iterable, Mapping
from functools import lru_cache
from hashlib import blake2b
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np

from sweep.messages import option
from sweep.model.detectors import DETECTORS, Setting
from sweep.model.estimators import ESTIMATORS
from sweep.model.window import window
from sweep.tasks.progress import CodeError
from sweep.tasks.study import METHODS, own_functions

if TYPE_CHECKING:
    from sweep.model.noisy_spectra import Methods
    from sweep.spec import SceneSpec, Spec

ALLOWED = "SWEEP_ALLOW_CODE"

DETECTOR, ESTIMATOR = METHODS


def allow(modules: Iterable[str]) -> None:
    """Allow this process and its workers to import modules, named as before a spec's colon."""
    for module in (modules := list(modules)):
        if module.endswith(".py") or not all(part.isidentifier() for part in module.split(".")):
            name = module.partition(":")[0].removesuffix(".py").replace("/", ".")
            near = f"; write {name!r}" if name.replace(".", "_").isidentifier() else ""
            raise CodeError(
                f"{module!r} is no name of a Python module, as a spec has it before the colon{near}"
            )
    allowed = {*_allowed(), *modules}
    if allowed:
        os.environ[ALLOWED] = ",".join(sorted(allowed))
        _reach_here()  # handed on to workers that are spawned


def _reach_here() -> None:
    """Import from the working directory too, and what is found nowhere else: it may be anyone's."""
    if (here := os.getcwd()) not in sys.path:
        sys.path.append(here)


def _allowed() -> set[str]:
    return set(filter(None, os.environ.get(ALLOWED, "").split(",")))


def check(spec: Spec | SceneSpec) -> None:
    """Import the functions that a study names, and try each; CodeError where one fails."""
    for role, name in own_functions(spec):
        _try(role, name)


def digests(spec: Spec | SceneSpec) -> dict[str, str]:
    """Digest of each module, as it is imported here, whose functions a study names."""
    modules = {name.partition(":")[0] for _, name in own_functions(spec)}
    found = {module: _digest(import_module(module)) for module in modules}
    return {module: digest for module, digest in found.items() if digest}


def _digest(module: ModuleType) -> str:
    """Digest of the file of a module; empty where it has none."""
    source = getattr(module, "__file__", None)
    return blake2b(Path(source).read_bytes(), digest_size=16).hexdigest() if source else ""


def allowed_code(spec: Spec | SceneSpec) -> dict[str, str]:
    """Modules, allowed here, whose functions a study names; digest of each that has a file."""
    known = digests(spec)
    return {name.partition(":")[0]: known.get(name.partition(":")[0], "")
            for _, name in own_functions(spec)}  # fmt: skip


@lru_cache(maxsize=64)
def admit(module: str, digest: str) -> None:
    """Allow a module in this worker, as the run's driver has done; CodeError for another file.

    Once a process: what is imported stays as it is, whatever becomes of its file.
    """
    allow([module])
    imported = _module(module)
    here = _digest(imported)
    if digest and here != digest:
        raise CodeError(
            f"the module {module} is not the same file on {socket.gethostname()} "
            f"({getattr(imported, '__file__', None)}) as where the run was started: "
            "put the same file on all machines"
        )


def methods(parameters: Mapping[str, Any]) -> Methods:
    """Detectors and estimators by the names in the parameters of some points; as :func:`check`."""
    from sweep.model.noisy_spectra import Methods

    own = {
        role: {
            name: guarded(role, name)
            for name in map(str, np.unique(np.asarray(parameters[path])))
            if ":" in name
        }
        for role, path in METHODS.items()
    }
    return Methods({**DETECTORS, **own[DETECTOR]}, {**ESTIMATORS, **own[ESTIMATOR]})


@lru_cache(maxsize=64)
def guarded(role: str, name: str) -> Callable[..., np.ndarray]:
    """Wrap a function of the user: read-only arrays, checked answers."""
    function = _imported(name)
    defined = f"{name}{_definition(function)}"

    def detect(power: np.ndarray, setting: Setting) -> np.ndarray:
        answer = _call(name, function, _read_only(power), setting)
        return _whole(defined, answer, power.shape, np.dtype(bool))

    def estimate(spectrum: np.ndarray, peak: np.ndarray, setting: Setting) -> np.ndarray:
        answer = _call(name, function, _read_only(spectrum), _read_only(peak), setting)
        return _whole(defined, answer, peak.shape, np.dtype(float))

    return detect if role == DETECTOR else estimate


def _call(name: str, function: Callable[..., Any], *arguments: Any) -> Any:
    """Answer of a function of the user's; a CodeError with its file and line where it fails."""
    try:
        return function(*arguments)
    except Exception as error:
        place = _place(error, sys.modules[name.partition(":")[0]])
        raise CodeError(f"{name} fails with {type(error).__name__}: {error}{place}") from error


def _definition(function: Callable[..., Any]) -> str:
    """File and line at which a function is defined; empty for one that is not in Python."""
    code = getattr(getattr(function, "py_func", function), "__code__", None)
    return f" ({code.co_filename}:{code.co_firstlineno})" if code else ""


def _place(error: BaseException, module: ModuleType) -> str:
    """File, line and function of the user's in which an error arose; empty where unknown."""
    frames = traceback.extract_tb(error.__traceback__)
    file = getattr(module, "__file__", None)
    own = [frame for frame in frames if frame.filename == file]
    return f" ({own[-1].filename}:{own[-1].lineno}, in {own[-1].name})" if own else ""


def _module(name: str) -> ModuleType:
    """Import a module of the user's; a CodeError that says why it can't be."""
    _reach_here()
    try:
        return import_module(name)
    except (Exception, SystemExit) as error:
        where = f" on {socket.gethostname()}"
        if isinstance(error, ModuleNotFoundError) and error.name == name.partition(".")[0]:
            raise CodeError(
                f"there is no module {error.name}{where}: put {error.name}.py into the folder "
                f"{os.getcwd()}, or its folder into PYTHONPATH, for workers on other machines in "
                "the section environment of the cluster's file"
            ) from error
        place = _place_of_import(error)
        raise CodeError(
            f"the module {name} can't be imported{where}: {type(error).__name__}: {error}{place}"
        ) from error


def _place_of_import(error: BaseException) -> str:
    """File and line at which importing a module failed."""
    if isinstance(error, SyntaxError):
        return f" ({error.filename}:{error.lineno})"
    frames = traceback.extract_tb(error.__traceback__)
    outside = [f for f in frames if f.filename != __file__ and "importlib" not in f.filename]
    return f" ({outside[-1].filename}:{outside[-1].lineno})" if outside else ""


def _imported(name: str) -> Callable[..., Any]:
    module, _, attribute = name.partition(":")
    if module not in _allowed():
        raise CodeError(
            f"{name} is code that this study would run, and its module is not allowed: look at it, "
            f"then say {option('allow_code', [module])}"
        )
    try:
        function = getattr(_module(module), attribute)
    except AttributeError:
        where = getattr(sys.modules[module], "__file__", None) or module
        raise CodeError(
            f"{name}: the module has nothing called {attribute}; define it in {where}, or name "
            "another function in the spec"
        ) from None
    if not callable(function):
        raise CodeError(f"{name} is a {type(function).__name__}, and no function")
    found: Callable[..., Any] = function
    return found


def _read_only(array: np.ndarray) -> np.ndarray:
    view = array.view()
    view.flags.writeable = False
    return view


def _whole(name: str, answer: Any, shape: tuple[int, ...], dtype: np.dtype) -> np.ndarray:
    """Return an answer of the right kind."""
    if not isinstance(answer, np.ndarray):
        raise CodeError(f"{name} gives a {type(answer).__name__}, and must give a numpy array")
    if answer.shape != shape or answer.dtype != dtype:
        raise CodeError(
            f"{name} gives {answer.dtype} of shape {answer.shape}, and must give {dtype} of {shape}"
        )
    if not np.isfinite(answer).all():
        raise CodeError(f"{name} gives values that are not finite")
    return answer


def _try(role: str, name: str) -> None:
    """One call on three spectra of a tone at bin 40.25 of 128, in a little noise."""
    size, rng = 256, np.random.default_rng(1)
    setting = Setting(
        fft_size=size, sample_rate=1e6, window=window("hann", size), noise_power=0.375 * size,
        threshold=50.0, training=16, guard=2, rank=12, pfa=1e-3,
    )  # fmt: skip
    record = 20 * np.cos(2 * np.pi * 40.25 * np.arange(size) / size) + rng.normal(size=(3, size))
    spectrum, function = np.fft.rfft(record * setting.taper), guarded(role, name)
    try:
        if role == DETECTOR:
            function(np.abs(spectrum) ** 2, setting)
        else:
            function(spectrum, np.full(3, 40), setting)
    except CodeError as error:
        raise CodeError(f"on a small known spectrum, {error}") from error
