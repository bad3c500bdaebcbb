"""Axes of a scene study: what may vary while the light falls where it fell."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from sweep.model.ground import pattern as pattern_of
from sweep.model.outputs import CYCLES, NAVIGATION, POINTS, SHOTS, STATISTICS
from sweep.model.resolution import PATTERN
from sweep.spec.axes import Axis
from sweep.spec.mistakes import ABSENT, Finding, Location

ARCHITECTURE = "instrument.receiver.architecture"
OF_PLANES = ("line", "square")
"""Patterns of beamlets that stand for a plane's slope."""
DIVERGENCE = "instrument.laser.beam_divergence"
STORED = frozenset(
    name
    for table in (SHOTS, CYCLES, STATISTICS, POINTS, NAVIGATION)
    for stored, output in table.items()
    for name in (stored, *output.dims)
)
"""Names of a store's arrays and dimensions."""

_OTHER = "make another study of it"
_SPECTRA = ("looks at whole spectra, which flights do not draw", "study a flat target")
_REASONS = {
    "target.": ("is given by the scene, shot by shot", "change the scene or the flight"),
    DIVERGENCE: ("moves the beamlets, and a study casts its rays once", _OTHER),
    "footprint.": ("moves the beamlets, and a study casts its rays once", _OTHER),
    "instrument.processing.detector.": _SPECTRA,
    "instrument.processing.estimator.": _SPECTRA,
    "accuracy.": ("says how closely to compute, the same for a whole study", _OTHER),
}


def why_not(path: str) -> tuple[str, str]:
    """Why an axis can't set a parameter, and a remedy; empty where it can."""
    return next((why for start, why in _REASONS.items() if path.startswith(start)), ("", ""))


def beamlet_pattern(chosen: str, phases: str, architecture: str) -> str:
    """Arrangement of the beamlets, as :func:`sweep.model.ground.pattern` has it."""
    words = {PATTERN: chosen, "footprint.phases": phases, ARCHITECTURE: architecture}
    return pattern_of(words)


def parameter_findings(
    footprint: tuple[str, str],
    architecture: str,
    path: str,
    values: Iterable[Any],
    location: Location,
) -> list[Finding]:
    """What is wrong with a parameter taking several values on one geometry.

    Parameters
    ----------
    footprint : (str, str)
        The study's ``footprint.pattern`` and ``footprint.phases``.
    architecture : str
        Its receiver's.
    path : str
        Dotted path of the parameter.
    values : iterable
        The values.
    location : tuple
        Where they stand.
    """
    rule, remedy = why_not(path)
    if rule:
        return [Finding(location, rule, remedy, ABSENT)]
    taken = {beamlet_pattern(*footprint, str(v)) for v in (architecture, *values)}
    if path == ARCHITECTURE and len(taken) > 1:
        rule = "moves the beamlets between direct detection and the others"
        return [Finding(location, rule, f"{_OTHER}, or take coherent phases", ABSENT)]
    return []


def axis_findings(written: Mapping[str, Any], axes: tuple[Axis, ...]) -> list[Finding]:
    """Axes of what can not vary on one geometry."""
    chosen, phases = _at(written, PATTERN, "auto"), _at(written, "footprint.phases", "incoherent")
    architecture = str(_at(written, ARCHITECTURE, "homodyne"))
    findings = []
    if chosen in OF_PLANES:
        rule = "stands for a plane alone, and the ground of a scene is none"
        findings.append(Finding(("footprint", "pattern"), rule, "take hexagonal", str(chosen)))
    for axis in axes:
        for member in axis.members:
            at: Location = ("axes", axis.name if axis.zipped else member.path)
            footprint = str(chosen), str(phases)
            findings += parameter_findings(footprint, architecture, member.path, member.values, at)
        if axis.zipped and axis.name in STORED:
            rule = "bears the name of something stored"
            findings.append(Finding(("axes", axis.name), rule, "take a word such as 'cut'", ABSENT))
    return findings


def _at(written: Mapping[str, Any], path: str, otherwise: str) -> object:
    """What is written at a dotted path."""
    found: Any = written
    for name in path.split("."):
        found = found.get(name) if isinstance(found, Mapping) else None
    return otherwise if found is None else found
