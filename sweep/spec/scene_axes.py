"""Axes of a scene study: what may vary while the light falls where it fell."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

from sweep.model import beam
from sweep.model.ground import pattern as pattern_of
from sweep.model.outputs import CYCLES, NAVIGATION, POINTS, SHOTS, STATISTICS
from sweep.model.resolution import PATTERN
from sweep.spec.axes import Axis
from sweep.spec.mistakes import ABSENT, Finding, Location

OF_PLANES = ("line", "square")
"""Patterns of beamlets that stand for a plane's slope."""
SPECKLE = "footprint.speckle"
"""Of the footprint what moves no beamlet."""
STORED = frozenset(
    name
    for table in (SHOTS, CYCLES, STATISTICS, POINTS, NAVIGATION)
    for stored, output in table.items()
    for name in (stored, *output.dims)
)
"""Names of a store's arrays and dimensions."""

_OTHER = "make another study of it"
_SPECTRA = ("looks at whole spectra, which flights do not draw", "study a flat target")
_BEAMS = (beam.DIVERGENCE, beam.WAIST, beam.QUALITY, beam.FOCUS, beam.RECEIVED_WAIST, beam.COUPLING)
_MOVES = ("moves the beamlets, and a study casts its rays once", _OTHER)
_REASONS = {
    "target.": ("is given by the scene, shot by shot", "change the scene or the flight"),
    **dict.fromkeys((*_BEAMS, "footprint."), _MOVES),
    "instrument.processing.detector.": _SPECTRA,
    "instrument.processing.estimator.": _SPECTRA,
    "accuracy.": ("says how closely to compute, the same for a whole study", _OTHER),
}


def why_not(path: str) -> tuple[str, str]:
    """Why an axis can't set a parameter, and a remedy; empty where it can."""
    if path == SPECKLE:
        return "", ""
    return next((why for start, why in _REASONS.items() if path.startswith(start)), ("", ""))


class Arrangement(NamedTuple):
    """Words that say where beamlets go."""

    pattern: str
    phases: str
    architecture: str
    thesis: bool
    """True where they go as far as divergence times range, whatever the wavelength."""

    @property
    def beamlets(self) -> str:
        """Arrangement of the beamlets, as :func:`sweep.model.ground.pattern` has it."""
        words = {PATTERN: self.pattern, "footprint.phases": self.phases}
        return pattern_of(words | {beam.ARCHITECTURE: self.architecture})


def parameter_findings(
    arrangement: Arrangement, path: str, values: Iterable[Any], location: Location
) -> list[Finding]:
    """What is wrong with a parameter taking several values on one geometry.

    Parameters
    ----------
    arrangement : Arrangement
        The study's.
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
    if path == beam.WAVELENGTH and not arrangement.thesis:
        rule = "moves the beamlets, as the beam's radius follows from it, and rays are cast once"
        return [Finding(location, rule, f"{_OTHER}, or take coupling: aperture", ABSENT)]
    if path != beam.ARCHITECTURE:
        return []
    of = [arrangement, *(arrangement._replace(architecture=str(v)) for v in values)]
    modes = {each.architecture == "direct" for each in of}
    if len({each.beamlets for each in of}) > 1 or (len(modes) > 1 and not arrangement.thesis):
        rule = "moves the beamlets between direct detection and the others"
        remedy = f"{_OTHER}, or take coherent phases and coupling: aperture"
        return [Finding(location, rule, remedy, ABSENT)]
    return []


def axis_findings(written: Mapping[str, Any], axes: tuple[Axis, ...]) -> list[Finding]:
    """Axes of what can not vary on one geometry."""
    chosen = str(_at(written, PATTERN, "auto"))
    phases, architecture = (
        str(_at(written, path, otherwise))
        for path, otherwise in (("footprint.phases", "incoherent"), (beam.ARCHITECTURE, "homodyne"))
    )
    thesis = _at(written, beam.COUPLING, beam.SINGLE_MODE) == beam.APERTURE and {
        _at(written, path, "none") for path in (beam.WAIST, beam.FOCUS)
    } == {"none"}
    arrangement = Arrangement(chosen, phases, architecture, thesis)
    findings = []
    if chosen in OF_PLANES:
        rule = "stands for a plane alone, and the ground of a scene is none"
        findings.append(Finding(("footprint", "pattern"), rule, "take hexagonal", chosen))
    for axis in axes:
        for member in axis.members:
            at: Location = ("axes", axis.name if axis.zipped else member.path)
            findings += parameter_findings(arrangement, member.path, member.values, at)
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
