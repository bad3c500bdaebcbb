"""Axes of a scene study: what may vary while the light falls where it fell."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from sweep.model.scene_outputs import CYCLES, NAVIGATION, POINTS, SHOTS, STATISTICS
from sweep.spec.axes import Axis
from sweep.spec.mistakes import ABSENT, Finding, Location

ARCHITECTURE = "instrument.receiver.architecture"
DIVERGENCE = "instrument.laser.beam_divergence"
STORED = frozenset(
    name
    for table in (SHOTS, CYCLES, STATISTICS, POINTS, NAVIGATION)
    for stored, output in table.items()
    for name in (stored, *output.dims)
)
"""Names of a store's arrays and dimensions."""

_OTHER = "make another study of it"
_REASONS = {
    "target.": ("is given by the scene, shot by shot", "change the scene or the flight"),
    DIVERGENCE: ("moves the beamlets, and a study casts its rays once", _OTHER),
    "footprint.": ("moves the beamlets, and a study casts its rays once", _OTHER),
    "accuracy.": ("says how closely to compute, the same for a whole study", _OTHER),
}


def why_not(path: str) -> tuple[str, str]:
    """Why an axis can't set a parameter, and a remedy; empty where it can."""
    return next((why for start, why in _REASONS.items() if path.startswith(start)), ("", ""))


def beamlet_pattern(phases: str, architecture: str) -> str:
    """Arrangement of the beamlets: hexagonal where their powers add, else without symmetry."""
    return "hexagonal" if phases == "incoherent" and architecture != "direct" else "sunflower"


def parameter_findings(
    pattern: str, phases: str, path: str, values: Iterable[Any], location: Location
) -> list[Finding]:
    """What is wrong with a parameter taking several values on one geometry.

    Parameters
    ----------
    pattern : str
        Arrangement of the study's beamlets.
    phases : str
        How they add.
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
    if path == ARCHITECTURE and {beamlet_pattern(phases, str(v)) for v in values} != {pattern}:
        rule = "moves the beamlets between direct detection and the others"
        return [Finding(location, rule, f"{_OTHER}, or take coherent phases", ABSENT)]
    return []


def axis_findings(written: Mapping[str, Any], axes: tuple[Axis, ...]) -> list[Finding]:
    """Axes of what can not vary on one geometry."""
    phases = str(_at(written, "footprint.phases", "incoherent"))
    pattern = beamlet_pattern(phases, str(_at(written, ARCHITECTURE, "homodyne")))
    findings = []
    for axis in axes:
        for member in axis.members:
            at: Location = ("axes", axis.name if axis.zipped else member.path)
            findings += parameter_findings(pattern, phases, member.path, member.values, at)
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
