"""Names of the user's functions in a spec, found without importing the model or any user code."""

from collections.abc import Iterator
from typing import Any

SPECTRUM_METHOD_PARAMETERS = {
    "detector": "instrument.processing.detector.kind",
    "estimator": "instrument.processing.estimator.kind",
}
"""Dotted paths of the parameters that name the detector and the estimator for whole spectra.

A parameter's value is the name of a built-in method or of a user's function.
"""


def iter_user_functions(spec: Any) -> Iterator[tuple[str, str]]:
    """Yield the role (detector or estimator) and the name of each user's function in a spec."""
    draws = getattr(spec, "draws", None)
    if not getattr(draws, "draws_whole_spectra", False):
        return
    for role, path in SPECTRUM_METHOD_PARAMETERS.items():
        axis_values = [
            member.values for axis in spec.axes for member in axis.parameters if member.path == path
        ]
        names = axis_values[0] if axis_values else [spec.parameters()[path]]
        yield from ((role, name) for name in dict.fromkeys(map(str, names)) if ":" in name)


def user_module_names(spec: Any) -> tuple[str, ...]:
    """Return the names of the modules of the user's functions in a spec, without duplicates."""
    return tuple(dict.fromkeys(name.partition(":")[0] for _, name in iter_user_functions(spec)))
