"""Fraction of a flight's shots that hit something, and the extents of its path and scene."""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from sweep.messages import number_with_noun
from sweep.scenes.scene_files import SceneError
from sweep.tasks.studies.eyepoint_study import EyepointStudy, get_built_scene

if TYPE_CHECKING:
    from sweep.spec import SceneSpec
    from sweep.spec.scene_sections import BuiltScene

SAMPLED_RAYS_PER_SCANNER = 1 << 17
"""Largest number of rays, spread over the flight, that sample what a scanner hits."""

MISSED_SHOTS_FRACTION_MAX = 0.01
"""Largest fraction of a scanner's shots that may hit nothing without a warning."""

_N_SAMPLED_TIMES = 65
"""Number of instants in a flight at which platform and moving bodies are located."""


class ScannerHits(NamedTuple):
    """Numbers of hits and misses among sampled shots of one scanner."""

    name: str
    """Name of the scanner."""
    n_shots: int
    """Number of shots in the sample."""
    hit_fraction: float
    """Fraction of the sampled shots with at least one beamlet that hits something."""
    partial_hit_fraction: float
    """Fraction of the sampled shots of which some beamlets hit something and some hit nothing."""
    beams_without_hits: tuple[int, ...]
    """Numbers of the beams whose sampled shots all hit nothing."""

    def hits_text(self) -> str:
        """Return a sentence on the fraction of shots with hits, and on beams without hits."""
        sentence = f"{_percent_text(self.hit_fraction)} of the shots hit something"
        if self.partial_hit_fraction:
            sentence += f", {_percent_text(self.partial_hit_fraction)} with a part of their light"
        if self.beams_without_hits and self.hit_fraction:
            beams = ", ".join(map(str, self.beams_without_hits[:8])) + ", ..." * (
                len(self.beams_without_hits) > 8
            )
            sentence += f"; beam{'s' * (len(self.beams_without_hits) > 1)} {beams} never"
        return sentence


class FlightCoverage(NamedTuple):
    """Sampled hits of each scanner of a flight, and the bounding boxes of path and scene."""

    scanner_hits: tuple[ScannerHits, ...]
    """Hits of sampled shots, one record for each scanner."""
    path_bounding_box: np.ndarray
    """Smallest and largest coordinates of the platform along its path, (2, 3) [m]."""
    scene_bounding_box: np.ndarray
    """Smallest and largest coordinates of the scene's bodies, (2, 3) [m]."""

    def extents_text(self) -> str:
        """Return a text with the ranges of x, y and z that the path and the scene span."""
        return (
            f"the path spans {_box_text(self.path_bounding_box)}, "
            f"and the scene {_box_text(self.scene_bounding_box)}"
        )

    def warnings(self) -> Iterator[str]:
        """Yield a warning for each scanner with too many shots that hit nothing.

        More than `MISSED_SHOTS_FRACTION_MAX` of a scanner's sampled shots are too many.
        """
        mostly_missing = [
            scanner
            for scanner in self.scanner_hits
            if scanner.hit_fraction < 1 - MISSED_SHOTS_FRACTION_MAX
        ]
        for scanner in mostly_missing:
            yield f"scanners.{scanner.name}: only {scanner.hits_text()}: {self.extents_text()}"


@lru_cache(maxsize=1)
def sample_coverage(spec: SceneSpec) -> FlightCoverage:
    """Cast sampled shots of each scanner of a flight. Return hits, and extents of path and scene.

    The result of the last call is cached.
    """
    built_scene, flight = get_built_scene(spec), spec.build_flight()
    times = np.linspace(flight.start_time, flight.stop_time, _N_SAMPLED_TIMES)
    positions = flight.state(times).position
    scanners = tuple(_sample_scanner_hits(spec, scanner) for scanner in spec.scanners)
    return FlightCoverage(
        scanners, _bounding_box(positions), _bounding_box(_body_corners(built_scene, times))
    )


def refuse_flight_without_hits(spec: SceneSpec) -> None:
    """Raise a SceneError with reason and remedy if no sampled beam of a flight hits anything."""
    flight_coverage = sample_coverage(spec)
    if any(scanner.hit_fraction for scanner in flight_coverage.scanner_hits):
        return
    n_shots = sum(scanner.n_shots for scanner in flight_coverage.scanner_hits)
    rule = (
        f"leads nowhere that a beam hits anything, of {number_with_noun(n_shots, 'shot')}: "
        f"{flight_coverage.extents_text()}"
    )
    remedy = (
        "give the path in the scene's coordinates, whose zero is the middle of scene.origin, or "
        "take 'origin: world' for those of the map; or turn the beams towards the scene"
    )
    raise SceneError("platform.path", rule, remedy)


def _sample_scanner_hits(spec: SceneSpec, name: str) -> ScannerHits:
    """Cast a sample of the shots of one scanner. Return the scanner's hits."""
    study = EyepointStudy(spec, name)
    n_shots_max, shots_per_cycle = (
        max(1, SAMPLED_RAYS_PER_SCANNER // study.n_beamlets),
        study.shots_per_cycle,
    )
    n_cycles = min(study.n_cycles, -(-n_shots_max // shots_per_cycle))
    first_shots = (
        np.unique(np.linspace(0, study.n_cycles - 1, n_cycles).astype(np.int64)) * shots_per_cycle
    )
    shot_numbers = (
        first_shots[:, None] + np.arange(shots_per_cycle)
    ).ravel()  # complete cycles contain all beams
    if shot_numbers.size > n_shots_max:
        shot_numbers = shot_numbers[
            np.linspace(0, shot_numbers.size - 1, n_shots_max).astype(np.int64)
        ]
    eyepoints = study.cast_eyepoints(shot_numbers)
    is_hit = eyepoints.surface >= 0
    has_hit, is_full_hit = is_hit.any(axis=1), is_hit.all(axis=1)
    beams = np.unique(eyepoints.beam)
    beams_with_hits = np.unique(eyepoints.beam[has_hit])
    return ScannerHits(
        name=name,
        n_shots=int(shot_numbers.size),
        hit_fraction=float(has_hit.mean()),
        partial_hit_fraction=float((has_hit & ~is_full_hit).mean()),
        beams_without_hits=tuple(np.setdiff1d(beams, beams_with_hits).tolist()),
    )


def _body_corners(built_scene: BuiltScene, times: np.ndarray) -> np.ndarray:
    """Return opposite corners (n, 3) [m] of boxes that contain the bodies of a scene.

    A moving body has a box at each of the given times (k,) [s]; a body at rest has one box.
    """
    corners = []
    for mesh, body in zip(built_scene.caster.meshes, built_scene.body_motions, strict=True):
        box = _bounding_box(mesh.vertices) + mesh.origin
        if body is not None:
            radius = np.sqrt((np.abs(box).max(axis=0) ** 2).sum())
            body_positions = body.state(times).position
            box = np.concatenate([body_positions - radius, body_positions + radius])
        corners.append(box)
    return np.concatenate(corners)


def _bounding_box(points: np.ndarray) -> np.ndarray:
    """Return the smallest and the largest coordinates of points (n, 3), as an array (2, 3)."""
    return np.stack([points.min(axis=0), points.max(axis=0)])


def _box_text(box: np.ndarray) -> str:
    """Return the ranges of x, y and z of a box as text."""
    axis_texts = (
        f"{axis} {low:.6g}" + (f" to {high:.6g}" if high != low else "")
        for axis, low, high in zip("xyz", *box, strict=True)
    )
    return ", ".join(axis_texts) + " m"


def _percent_text(fraction: float) -> str:
    """Return a fraction as text in per cent, such as '12 %'.

    Fractions near 0 or 1 give 'under 0.1 %' or 'over 99.9 %', unless they are exactly 0 or 1.
    """
    if 0.0 < fraction < 0.001:
        return "under 0.1 %"
    return "over 99.9 %" if 0.999 < fraction < 1.0 else f"{100 * fraction:.3g} %"
