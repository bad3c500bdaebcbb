"""What is wrong with a flight: paths, attitudes, scan patterns, and targets that move."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from sweep.scenes.files import SceneError
from sweep.spec.files import Files
from sweep.spec.mistakes import ABSENT, Finding, Location
from sweep.spec.motion import Motion, Platform, Span, Tracked, WaypointPath
from sweep.spec.scanners import shots_a_cycle

_LOOKS = 257
"""Times at which an attitude is tried."""


def flight_findings(
    platform: Platform | None,
    scanners: Mapping[str, Any],
    objects: Mapping[str, Any],
    base: Path | None,
) -> list[Finding]:
    """What is wrong with platform, scanners and moving objects.

    Parameters
    ----------
    platform : Platform or None
        What carries the instrument; None where it can't be read.
    scanners, objects : mapping
        Those that can be read, by name.
    base : Path or None
        Folder that files are relative to; None leaves alone what depends on files.
    """
    span: Span | None = None
    findings: list[Finding] = []
    if platform is not None and (base is not None or not _on_files(platform)):
        files = Files(base or Path())
        findings += _motion_findings(platform, ("platform",), files, None)
        span = None if findings else _span(platform, files)
    for name, scanner in scanners.items():
        findings += _scanner_findings(scanner, ("scanners", name), span)
    for name, thing in objects.items():
        motion = getattr(thing, "motion", None)
        if motion is not None and span is not None and (base or not _on_files(motion)):
            location = ("scene", "objects", name, "motion")
            findings += _motion_findings(motion, location, Files(base or Path()), span)
    return findings


def _on_files(motion: Motion) -> bool:
    """Whether a movement is that of a table."""
    return isinstance(motion.path, WaypointPath) or isinstance(motion.attitude, Tracked)


def _span(platform: Platform, files: Files) -> Span:
    path = platform.path.path(files)
    return path.start, path.stop


def _motion_findings(
    motion: Motion, location: Location, files: Files, span: Span | None
) -> Iterator[Finding]:
    """A path or an attitude that can not be, or a target's path that is shorter than the flight."""
    section = "path"
    try:
        path = motion.path.path(files, span)
        section = "attitude"
        motion.law(files, path)
        section = "mounting"
        flight = motion.flight(files, span)
        section = "attitude"
        flight.state(np.linspace(path.start, path.stop, _LOOKS))
    except SceneError as error:
        at = (*location, section, "file")
        yield Finding(at, f"names a file that {error.rule}", error.remedy, ABSENT)
        return
    except (ValueError, ArithmeticError) as error:
        yield Finding((*location, section), f"can not be made: {error}", "", ABSENT)
        return
    if span is not None and not (path.start <= span[0] and path.stop >= span[1]):
        rule = (
            f"lasts from {path.start:g} to {path.stop:g} s, and the flight from {span[0]:g} to "
            f"{span[1]:g} s"
        )
        yield Finding((*location, "path"), rule, "make it last throughout the flight", ABSENT)


def _scanner_findings(scanner: Any, location: Location, span: Span | None) -> Iterator[Finding]:
    """A scan pattern that can not be, or that makes no whole cycle in the flight."""
    try:
        pattern = scanner.pattern()
    except (ValueError, ArithmeticError) as error:
        yield Finding(location, f"can not be made: {error}", "", ABSENT)
        return
    each = shots_a_cycle(pattern)
    if span is not None and pattern.number(span[1] - span[0]) < each:
        rule = f"makes no whole cycle of {each} shots in a flight of {span[1] - span[0]:.6g} s"
        yield Finding((*location, "rate"), rule, "raise it, or lengthen the flight", ABSENT)
