"""Import and checks of the user's functions that serve as detectors and estimators.

A spec names them as ``module:function``; reading a spec imports nothing. Processes that compute
import only modules that are allowed (:mod:`sweep.tasks.engine.user_code`).
"""

from __future__ import annotations

import sys
import traceback
from collections.abc import Callable, Mapping
from functools import lru_cache
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np

from sweep.messages import option_text
from sweep.model.detection.detectors import DETECTORS, SpectrumSettings
from sweep.model.detection.estimators import ESTIMATORS
from sweep.model.window import get_window
from sweep.tasks.engine import user_code
from sweep.tasks.engine.progress import CodeError
from sweep.tasks.studies.user_function_names import SPECTRUM_METHOD_PARAMETERS, iter_user_functions

if TYPE_CHECKING:
    from sweep.model.sampling.noisy_spectra import SpectrumMethods
    from sweep.spec import GridSpec, SceneSpec

DETECTOR_ROLE, ESTIMATOR_ROLE = SPECTRUM_METHOD_PARAMETERS


def check_user_functions(spec: GridSpec | SceneSpec) -> None:
    """Import the user's functions that a spec names, and test each of them.

    CodeError is raised if a function can't be imported or fails the test.
    """
    for role, name in iter_user_functions(spec):
        _test_user_function(role, name)


def spectrum_methods(parameters: Mapping[str, Any]) -> SpectrumMethods:
    """Return the detectors and estimators that parameters may name: built-in ones and the user's.

    CodeError is raised if a user's function is not allowed, or can't be imported.
    """
    from sweep.model.sampling.noisy_spectra import SpectrumMethods

    user_functions_by_role = {
        role: {
            name: load_checked_function(role, name)
            for name in map(str, np.unique(np.asarray(parameters[path])))
            if ":" in name
        }
        for role, path in SPECTRUM_METHOD_PARAMETERS.items()
    }
    return SpectrumMethods(
        {**DETECTORS, **user_functions_by_role[DETECTOR_ROLE]},
        {**ESTIMATORS, **user_functions_by_role[ESTIMATOR_ROLE]},
    )


@lru_cache(maxsize=64)
def load_checked_function(role: str, name: str) -> Callable[..., np.ndarray]:
    """Return a user's function in a wrapper that passes read-only arrays and checks the results."""
    function = _import_user_function(name)
    definition = f"{name}{_definition_place_text(function)}"

    def detect(power: np.ndarray, setting: SpectrumSettings) -> np.ndarray:
        answer = _call_user_function(name, function, _read_only_view(power), setting)
        return _check_returned_array(definition, answer, power.shape, np.dtype(bool))

    def estimate(
        spectrum: np.ndarray, peak_bins: np.ndarray, setting: SpectrumSettings
    ) -> np.ndarray:
        answer = _call_user_function(
            name, function, _read_only_view(spectrum), _read_only_view(peak_bins), setting
        )
        return _check_returned_array(definition, answer, peak_bins.shape, np.dtype(float))

    return detect if role == DETECTOR_ROLE else estimate


def _call_user_function(name: str, function: Callable[..., Any], *arguments: Any) -> Any:
    """Call a user's function and return its result; raise CodeError if the function fails.

    The message of the error has file and line.
    """
    try:
        return function(*arguments)
    except Exception as error:
        place_text = _error_place_text(error, sys.modules[name.partition(":")[0]])
        raise CodeError(f"{name} fails with {type(error).__name__}: {error}{place_text}") from error


def _definition_place_text(function: Callable[..., Any]) -> str:
    """Return the file and line of a function's definition as text; '' if it is not in Python."""
    code_object = getattr(getattr(function, "py_func", function), "__code__", None)
    return f" ({code_object.co_filename}:{code_object.co_firstlineno})" if code_object else ""


def _error_place_text(error: BaseException, module: ModuleType) -> str:
    """Return file, line and function, as text, of a user's code that raised an error.

    The text is '' if the error was not raised in the user's module.
    """
    frames = traceback.extract_tb(error.__traceback__)
    file = getattr(module, "__file__", None)
    module_frames = [frame for frame in frames if frame.filename == file]
    return (
        f" ({module_frames[-1].filename}:{module_frames[-1].lineno}, in {module_frames[-1].name})"
        if module_frames
        else ""
    )


def _import_user_function(name: str) -> Callable[..., Any]:
    """Import a user's function; raise CodeError if it is not allowed, missing, or no function."""
    module, _, attribute = name.partition(":")
    if module not in user_code.allowed_modules():
        raise CodeError(
            f"{name} is code that this study would run, and its module is not allowed: look at it, "
            f"then say {option_text('allow_code', [module])}"
        )
    try:
        function = getattr(user_code.import_user_module(module), attribute)
    except AttributeError:
        module_file = getattr(sys.modules[module], "__file__", None) or module
        raise CodeError(
            f"{name}: the module has nothing called {attribute}; define it in {module_file}, or "
            "name "
            "another function in the spec"
        ) from None
    if not callable(function):
        raise CodeError(f"{name} is a {type(function).__name__}, and no function")
    user_function: Callable[..., Any] = function
    return user_function


def _read_only_view(array: np.ndarray) -> np.ndarray:
    """Return a read-only view of an array, which shares its memory."""
    view = array.view()
    view.flags.writeable = False
    return view


def _check_returned_array(
    name: str, answer: Any, shape: tuple[int, ...], dtype: np.dtype
) -> np.ndarray:
    """Return the result of a user's function as an array, after a check of type, shape and values.

    CodeError is raised if the check fails.
    """
    if not isinstance(answer, np.ndarray):
        raise CodeError(f"{name} gives a {type(answer).__name__}, and must give a numpy array")
    if answer.shape != shape or answer.dtype != dtype:
        raise CodeError(
            f"{name} gives {answer.dtype} of shape {answer.shape}, and must give {dtype} of {shape}"
        )
    if not np.isfinite(answer).all():
        raise CodeError(f"{name} gives values that are not finite")
    return answer


def _test_user_function(role: str, name: str) -> None:
    """Call a user's function on three test spectra: a tone at bin 40.25 of 128 in weak noise.

    CodeError is raised if the call fails or its result is invalid.
    """
    n_samples, generator = 256, np.random.default_rng(1)
    setting = SpectrumSettings(
        fft_size=n_samples,
        sample_rate=1e6,
        window=get_window("hann", n_samples),
        noise_power=0.375 * n_samples,
        threshold=50.0,
        training=16,
        guard=2,
        rank=12,
        pfa=1e-3,
    )
    record = 20 * np.cos(2 * np.pi * 40.25 * np.arange(n_samples) / n_samples) + generator.normal(
        size=(3, n_samples)
    )
    spectrum, function = np.fft.rfft(record * setting.taper), load_checked_function(role, name)
    try:
        if role == DETECTOR_ROLE:
            function(np.abs(spectrum) ** 2, setting)
        else:
            function(spectrum, np.full(3, 40), setting)
    except CodeError as error:
        raise CodeError(f"on a small known spectrum, {error}") from error
