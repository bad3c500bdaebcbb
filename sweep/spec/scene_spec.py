"""A study of a flight over a scene: instrument, scene, platform, scanners, axes and draws."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from pydantic import Field, ValidationError

from sweep.model import VERSION, beam
from sweep.model.accuracy import Accuracy
from sweep.model.ground import pattern as pattern_of
from sweep.model.resolution import BEAMLETS, is_open, rays_needed
from sweep.spec.figures import SceneFigure, scene_figure_findings
from sweep.spec.flight import AnyScanner, Platform, shots_a_cycle
from sweep.spec.grid_rules import Grid, is_method, not_in_flights
from sweep.spec.identity import digest, geometry_of
from sweep.spec.mistakes import Finding, Location, SpecError
from sweep.spec.parts import Files, leaves, named_files, read_as, values_of
from sweep.spec.reading import Document, findings_of
from sweep.spec.scene import ErrorFloor, Interface, Navigation, Scene, SceneDraws, SceneStorage
from sweep.spec.scene_check import (
    axis_findings,
    parameter_findings,
    scene_findings,
    why_not,
)
from sweep.spec.study import Study

if TYPE_CHECKING:
    from sweep.model.geometry.mesh import Surface
    from sweep.model.geometry.platform import Flight
    from sweep.model.geometry.scanner import PointingJitter, Scanner
    from sweep.spec.world import World


class SceneSpec(Study):
    """A study of a flight over a scene, every value read and checked.

    Made by `load` from a file and by `from_mapping` from plain data; values are SI.
    """

    scene: Scene
    platform: Platform
    scanners: dict[str, AnyScanner] = Field(description="Scan patterns by name")
    draws: SceneDraws = SceneDraws()
    error_floor: ErrorFloor = ErrorFloor()
    navigation: Navigation = Navigation()
    interface: Interface = Interface()
    storage: SceneStorage = SceneStorage()
    figures: tuple[SceneFigure, ...] = Field(
        default=(), description="Figures and tables of the results"
    )

    @classmethod
    def from_document(cls, document: Document, base: Path | None) -> Self:
        """Spec from a document, which is changed, or all of its mistakes at once."""
        spec = super().from_document(document, base)
        if base is not None:
            files = Files(base)
            spec._base = base
            named = [(file, rule) for _, rule, file in named_files(spec)]
            spec._digests = {file: rule.digest(files.path(file)) for file, rule in named}
        return spec

    @classmethod
    def further_findings(
        cls, written: Mapping[str, Any], grid: Grid, base: Path | None, axes_are_whole: bool
    ) -> list[Finding]:
        """Mistakes in scene, flight, files, random effects and figures."""
        draws = read_as(SceneDraws, written.get("draws", {})) or SceneDraws()
        return [
            *scene_findings(written, base),
            *axis_findings(grid),
            *not_in_flights(grid, draws),
            *scene_figure_findings(written, grid.axes if axes_are_whole else None),
        ]

    @classmethod
    def may_vary(cls, path: str) -> bool:
        """Return true if an axis of this kind of study may set the parameter at a path."""
        return not why_not(path)[0]

    def unvaried(self, path: str, value: object, location: Location) -> list[Finding]:
        """Mistakes in a parameter taking a value without the geometry changing."""
        return parameter_findings(self.parameters(), path, [value], location)

    @property
    def base(self) -> Path:
        """Folder that the scene's files are relative to."""
        return self._base

    @property
    def files(self) -> Files:
        """The scene's files."""
        return Files(self._base, self._digests)

    def parameters(self) -> dict[str, float | int | str]:
        """SI values of all parameters by dotted path; of those on axes, the value off the axis."""
        parameters = super().parameters()
        if not self.draws.whole_spectra:
            parameters = {p: v for p, v in parameters.items() if not is_method(p)}
        rays = rays_needed(parameters, Accuracy.of(parameters))
        return parameters | {
            "target.solar_irradiance": self.scene.solar_irradiance,
            BEAMLETS: self.footprint.beamlets or rays,
        }

    @property
    def rays_by_tolerance(self) -> bool:
        """True if the tolerance says how many rays there are of each shot."""
        return self.footprint.beamlets == 0 and is_open(self.parameters())

    def surfaces(self) -> tuple[Surface, ...]:
        """Surfaces by their numbers; no file is looked at."""
        from sweep.spec.world import surfaces_of

        return surfaces_of(self.scene)

    def world(self) -> World:
        """Build the scene.

        Raises
        ------
        SceneError
            For a file that is missing, changed or unfit; or an object that can not be made.
        """
        from sweep.spec.world import build

        flight = self.flight()
        return build(self.scene, self.files, (flight.start, flight.stop))

    def flight(self) -> Flight:
        """Movement of the instrument in the scene's frame.

        Raises
        ------
        SceneError
            For a table that is missing, changed or unfit.
        """
        return self.platform.flight(self.files)

    def scan(self, name: str) -> Scanner:
        """Return the scan pattern of a scanner."""
        return self.scanners[name].pattern()

    def shots_a_cycle(self, name: str) -> int:
        """Shots of a measurement cycle of a scanner."""
        return shots_a_cycle(self.scan(name))

    def cycles(self, name: str) -> int:
        """Whole measurement cycles of a scanner, all of whose shots begin during the flight."""
        flight, scan = self.flight(), self.scan(name)
        return scan.number(flight.stop - flight.start) // shots_a_cycle(scan)

    @property
    def pattern(self) -> str:
        """Arrangement of the beamlets, `sweep.model.footprint.beamlets`'s word."""
        return pattern_of(self.parameters())

    def footprint_angles(self) -> Callable[[np.ndarray], beam.Angles] | None:
        """Angles of the beam's footprint by range; None where its divergence says all."""
        p = self.parameters()
        return None if beam.is_thesis(p) else partial(beam.angles, p)

    def interface_with(self, fields: Mapping[str, object]) -> Interface:
        """Return the unit's interface with some fields set anew, written as in a spec.

        Raises
        ------
        SpecError
            With every mistake in them.
        """
        written = {path[-1]: rule.written(v) for path, rule, v in leaves(self.interface)}
        try:
            return Interface.model_validate({**written, **fields})
        except ValidationError as error:
            findings = findings_of(error, Interface)
        placed = [replace(each, location=("interface", *each.location)) for each in findings]
        raise SpecError(map(Document({}).mistake, placed))

    def pointing_jitter(self) -> PointingJitter | None:
        """Random turns of the beams; None where there are none."""
        from sweep.model.geometry.scanner import PointingJitter

        sigma = self.platform.jitter
        return PointingJitter(sigma, self.seed) if sigma else None

    @property
    def rotating(self) -> bool:
        """True if any body of the scene turns."""
        moving = (getattr(thing, "motion", None) for thing in self.scene.objects.values())
        return any(motion is not None and motion.attitude.kind != "fixed" for motion in moving)

    def geometry(self, name: str) -> dict[str, Any]:
        """Content of what is seen through one scanner: all that rays depend on, and no more.

        Names are no part of it, nor are reflectances, nor where files are: they count by content.
        """
        p = self.parameters()
        seen = geometry_of(self.scene, self.platform, self.scanners[name], self._digests)
        return seen | {
            "model": VERSION,
            "beamlets": p[BEAMLETS],
            "pattern": self.pattern,
            "beam": {beam.DIVERGENCE: p[beam.DIVERGENCE]} if beam.is_thesis(p) else beam.shape(p),
            "seed": self.seed if self.platform.jitter else 0,
            "rotation": self.modes()["rotation"] != "off",
        }

    def geometry_id(self, name: str) -> str:
        """Hash of the geometry, 32 hexadecimal digits."""
        return digest(self.geometry(name))

    def identity(self) -> dict[str, Any]:
        """Content that makes the study this one, in SI values.

        Files count by content, and not by where they are. The order of objects is part of it: it
        numbers the surfaces. A number of rays that follows from the tolerance counts as 0.
        """
        digests, counted = self._digests, {BEAMLETS: 0} if self.rays_by_tolerance else {}
        return super().identity() | {
            "parameters": self.parameters_off_axes() | counted,
            "objects": list(self.scene.objects),
            "scene": values_of(self.scene, digests=digests),
            "platform": values_of(self.platform, digests=digests),
            "scanners": {
                path: value
                for name, scanner in self.scanners.items()
                for path, value in values_of(scanner, (name,), digests).items()
            },
        }
