"""Share of a flight's shots that hit something, and the extents of its path and its scene."""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from sweep.messages import counted
from sweep.scenes.files import SceneError
from sweep.tasks.eyepoint_study import EyepointStudy, world_of

if TYPE_CHECKING:
    from sweep.spec import SceneSpec
    from sweep.spec.scene import World

SAMPLE_RAYS = 1 << 17
"""Rays of each scanner that tell what it sees, spread over the flight."""

MISSED_SHARE = 0.01
"""Share of a scanner's shots that hit nothing, above which it is warned of."""

_TIMES = 65
"""Times at which the places of the platform and of moving objects are looked at."""


class ScannerCoverage(NamedTuple):
    """Share of a scanner's shots that hit something, of a sample."""

    name: str
    shots: int
    """Shots looked at."""
    seen: float
    """Share of them of which any beamlet hits something."""
    partly: float
    """Share of them of which some beamlets hit, and others do not."""
    blind: tuple[int, ...]
    """Beams of which no shot hits anything."""

    def text(self) -> str:
        """Sentence for people."""
        sentence = f"{_percent(self.seen)} of the shots hit something"
        if self.partly:
            sentence += f", {_percent(self.partly)} with a part of their light"
        if self.blind and self.seen:
            beams = ", ".join(map(str, self.blind[:8])) + ", ..." * (len(self.blind) > 8)
            sentence += f"; beam{'s' * (len(self.blind) > 1)} {beams} never"
        return sentence


class Coverage(NamedTuple):
    """Shots of a flight that hit something, by scanner, and the extents of path and scene."""

    scanners: tuple[ScannerCoverage, ...]
    path: np.ndarray
    """(2, 3): least and largest coordinates of the platform [m]."""
    scene: np.ndarray
    """(2, 3): the same of the scene."""

    def extents(self) -> str:
        """Extents of path and scene, for people."""
        return f"the path spans {_span(self.path)}, and the scene {_span(self.scene)}"

    def warnings(self) -> Iterator[str]:
        """Sentences on scanners of which more than `MISSED_SHARE` of the shots hit nothing."""
        missed = [scanner for scanner in self.scanners if scanner.seen < 1 - MISSED_SHARE]
        for scanner in missed:
            yield f"scanners.{scanner.name}: only {scanner.text()}: {self.extents()}"


@lru_cache(maxsize=1)
def coverage(spec: SceneSpec) -> Coverage:
    """Cast a sample of the shots of each scanner; the last result is cached."""
    world, flight = world_of(spec), spec.flight()
    time = np.linspace(flight.start, flight.stop, _TIMES)
    position = flight.state(time).position
    scanners = tuple(_scanner(spec, name) for name in spec.scanners)
    return Coverage(scanners, _ends(position), _ends(_corners(world, time)))


def refuse_blind(spec: SceneSpec) -> None:
    """Refuse a flight of which no beam of the sample hits anything: a SceneError that says why."""
    seen = coverage(spec)
    if any(scanner.seen for scanner in seen.scanners):
        return
    shots = sum(scanner.shots for scanner in seen.scanners)
    rule = f"leads nowhere that a beam hits anything, of {counted(shots, 'shot')}: {seen.extents()}"
    remedy = (
        "give the path in the scene's coordinates, whose zero is the middle of scene.origin, or "
        "take 'origin: world' for those of the map; or turn the beams towards the scene"
    )
    raise SceneError("platform.path", rule, remedy)


def _scanner(spec: SceneSpec, name: str) -> ScannerCoverage:
    study = EyepointStudy(spec, name)
    number, each = max(1, SAMPLE_RAYS // study.beamlets), study.shots_a_cycle
    cycles = min(study.cycles, -(-number // each))
    first = np.unique(np.linspace(0, study.cycles - 1, cycles).astype(np.int64)) * each
    index = (first[:, None] + np.arange(each)).ravel()  # whole cycles hold all beams
    if index.size > number:
        index = index[np.linspace(0, index.size - 1, number).astype(np.int64)]
    eyes = study.observe(index)
    hit = eyes.surface >= 0
    seen, whole = hit.any(axis=1), hit.all(axis=1)
    beams = np.unique(eyes.beam)
    lit = np.unique(eyes.beam[seen])
    return ScannerCoverage(
        name=name,
        shots=int(index.size),
        seen=float(seen.mean()),
        partly=float((seen & ~whole).mean()),
        blind=tuple(np.setdiff1d(beams, lit).tolist()),
    )


def _corners(world: World, time: np.ndarray) -> np.ndarray:
    """Corners of all bodies, (n, 3); of one that moves, of a ball about it all along its way."""
    corners = []
    for mesh, body in zip(world.caster.meshes, world.bodies, strict=True):
        ends = _ends(mesh.vertices) + mesh.origin
        if body is not None:
            radius = np.sqrt((np.abs(ends).max(axis=0) ** 2).sum())
            way = body.state(time).position
            ends = np.concatenate([way - radius, way + radius])
        corners.append(ends)
    return np.concatenate(corners)


def _ends(points: np.ndarray) -> np.ndarray:
    return np.stack([points.min(axis=0), points.max(axis=0)])


def _span(ends: np.ndarray) -> str:
    spans = (
        f"{axis} {low:.6g}" + (f" to {high:.6g}" if high != low else "")
        for axis, low, high in zip("xyz", *ends, strict=True)
    )
    return ", ".join(spans) + " m"


def _percent(share: float) -> str:
    """Share in per cent, never rounded to all or nothing."""
    if 0.0 < share < 0.001:
        return "under 0.1 %"
    return "over 99.9 %" if 0.999 < share < 1.0 else f"{100 * share:.3g} %"
