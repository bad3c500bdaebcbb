"""Detectors and estimators that are functions of the user's: allowed, imported, checked.

A spec names them as ``module:function``; reading it imports nothing. Processes that compute import
them only from modules allowed by ``--allow-code MODULE``, or in the environment variable
``SWEEP_ALLOW_CODE``, which workers on this machine inherit and others need set.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterable, Mapping
from functools import lru_cache
from hashlib import blake2b
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

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
    sources = {module: getattr(import_module(module), "__file__", None) for module in modules}
    return {
        module: blake2b(Path(source).read_bytes(), digest_size=16).hexdigest()
        for module, source in sources.items()
        if source
    }


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

    def detect(power: np.ndarray, setting: Setting) -> np.ndarray:
        answer = function(_read_only(power), setting)
        return _whole(name, answer, power.shape, np.dtype(bool))

    def estimate(spectrum: np.ndarray, peak: np.ndarray, setting: Setting) -> np.ndarray:
        answer = function(_read_only(spectrum), _read_only(peak), setting)
        return _whole(name, answer, peak.shape, np.dtype(float))

    return detect if role == DETECTOR else estimate


def _imported(name: str) -> Callable[..., Any]:
    module, _, attribute = name.partition(":")
    if module not in _allowed():
        raise CodeError(
            f"{name} is code that this study would run, and its module is not allowed: look at it, "
            f"then say --allow-code {module} (or put it into {ALLOWED} where workers start)"
        )
    _reach_here()
    try:
        function = getattr(import_module(module), attribute)
    except ImportError as error:
        raise CodeError(f"{name}: its module can't be imported: {error}") from error
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
    except CodeError:
        raise
    except Exception as error:
        told = f"{type(error).__name__}: {error}"
        raise CodeError(f"{name} fails on a small known spectrum with {told}") from error
