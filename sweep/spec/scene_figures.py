"""The figures and tables that a study of a scene makes of its results."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, Literal

from pydantic import Field

import sweep.spec.quantities as of
from sweep.model.outputs import POINTS, SHOTS, STATISTICS, XYZ
from sweep.spec.figures import STEM, TITLE, WHERE, Selection
from sweep.spec.instrument import Part
from sweep.spec.list_rules import Either, Flag, Interval, Names
from sweep.spec.rules import Choice, Numeric, Rule
from sweep.units import QuantityError

Crop = tuple[float, ...]

QUANTITIES = (
    *(name for table in (SHOTS, STATISTICS, POINTS) for name, output in table.items()
      if XYZ not in output.dims),
    "altitude", "x", "y", "z", "shot",
)  # fmt: skip
"""What a figure can show of shots and of points."""

VIEWS = ("oblique", "above", "side", "front")
SEVERAL_SURFACES = "several_surfaces"


@dataclass(frozen=True, kw_only=True)
class View(Rule):
    """Where a cloud is looked at from: a word, or azimuth and elevation of the eye."""

    words: tuple[str, ...] = VIEWS
    _azimuth = of.angle("Of the eye, from x towards y", "-60 deg")
    _elevation = of.angle("Above the horizon", "30 deg", at_least="-90 deg", at_most="90 deg")

    def read(self, written: object) -> Any:
        """A word, or a mapping of azimuth and elevation [rad]."""
        if not isinstance(written, dict):
            return Choice(about=self.about, options=self.words).read(written)
        if set(written) != {"azimuth", "elevation"}:
            raise QuantityError(
                "must be a word or have an azimuth and an elevation",
                "write e.g. {azimuth: -60 deg, elevation: 30 deg}",
            )
        return {
            "azimuth": self._azimuth.read(written["azimuth"]),
            "elevation": self._elevation.read(written["elevation"]),
        }

    def schema(self) -> dict[str, Any]:
        """JSON Schema: a word, or two angles."""
        angles = {"azimuth": self._azimuth.schema(), "elevation": self._elevation.schema()}
        mapping = {
            "type": "object",
            "properties": angles,
            "required": list(angles),
            "additionalProperties": False,
        }
        words = {"type": "string", "enum": list(self.words)}
        return {"description": self.about, "anyOf": [words, mapping]}


@dataclass(frozen=True, kw_only=True)
class Quantity(Choice):
    """A quantity of shots or points."""

    options: tuple[str, ...] = QUANTITIES

    def read(self, written: object) -> str:
        """The quantity's name."""
        try:
            return super().read(written)
        except QuantityError as error:
            usual = "take range, radial_velocity, snr, pd, surface, beam, time or altitude"
            rule = "is no quantity of shots or points"
            raise QuantityError(rule, error.suggestion or usual) from None


_SCANNER = of.name("Scanner; the first by default")
_RANGES = Choice(
    about="By whole bins, or interpolated between them", options=("quantised", "interpolated")
)
_DRAW = of.count("Number of the draw, from 0", "0", at_least="0", at_most="1e9")


def _span(about: str) -> Interval:
    return Interval(about=about, of=of.length("Coordinate", "100 m"))


_TIME = Interval(about="Part of the flight's time", of=of.duration("Time", "10 s"))


class SceneDrawing(Part):
    """What all figures of scenes have."""

    name: Annotated[str, STEM] = ""
    title: Annotated[str, TITLE] = ""
    where: Annotated[dict[str, Selection], WHERE] = Field(default_factory=dict)

    @property
    def stem(self) -> str:
        """Stem of the picture's file name."""
        if self.name:
            return self.name
        parts = [part for part in (getattr(self, "scanner", None), self._shown) if part]
        return "_".join([*parts, self.kind])  # type: ignore[attr-defined]

    @property
    def _shown(self) -> str:
        """What the figure shows, as part of a file's name."""
        return ""

    @property
    def named_scanners(self) -> dict[tuple[str | int, ...], str]:
        """Scanners named, by where in the figure."""
        scanner = getattr(self, "scanner", None)
        listed = getattr(self, "scanners", None) or ()
        named: dict[tuple[str | int, ...], str] = {("scanner",): scanner} if scanner else {}
        return named | {("scanners", i): name for i, name in enumerate(listed)}


class CloudFigure(SceneDrawing):
    """A point cloud."""

    kind: Literal["cloud"]
    scanner: Annotated[str | None, _SCANNER] = None
    colour: Annotated[str, Quantity(about="What colours the points")] = "range"
    ranges: Annotated[str, _RANGES] = "quantised"
    view: Annotated[str | dict[str, float], View(about="Where from")] = "oblique"
    x: Annotated[Crop | None, _span("Part along x")] = None
    y: Annotated[Crop | None, _span("Part along y")] = None
    z: Annotated[Crop | None, _span("Part along z")] = None
    time: Annotated[Crop | None, _TIME] = None
    terrain: Annotated[bool, Flag(about="Whether to draw the ground")] = True
    path: Annotated[bool, Flag(about="Whether to draw the flight path")] = False
    dropouts: Annotated[bool, Flag(about="Whether to mark shots without a point")] = False
    draw: Annotated[int, _DRAW] = 0

    @property
    def _shown(self) -> str:
        return self.colour


class Scatter(SceneDrawing):
    """A quantity of shots or points over another."""

    kind: Literal["scatter"]
    scanner: Annotated[str | None, _SCANNER] = None
    x: Annotated[str, Quantity(about="Quantity along x")] = "time"
    y: Annotated[str, Quantity(about="Quantity along y")]
    colour: Annotated[str, Quantity(about="What colours the points")] = "beam"
    ranges: Annotated[str, _RANGES] = "quantised"
    time: Annotated[Crop | None, _TIME] = None
    draw: Annotated[int, _DRAW] = 0

    @property
    def _shown(self) -> str:
        return f"{self.y}_over_{self.x}"


class ShotSpectra(SceneDrawing):
    """The three spectra of one shot, with threshold, noise and detections."""

    kind: Literal["shot_spectra"]
    scanner: Annotated[str | None, _SCANNER] = None
    shot: Annotated[
        int | str,
        Either(
            about="Number of the shot, from 0, or the first whose footprint has several surfaces",
            words=(SEVERAL_SURFACES,),
            of=of.count("Shot", "0", at_least="0", at_most="1e15"),
        ),
    ] = SEVERAL_SURFACES
    draw: Annotated[int, _DRAW] = 0

    @property
    def _shown(self) -> str:
        return str(self.shot)


class _OfNavigation(SceneDrawing):
    """What navigation is shown."""

    scanners: Annotated[
        tuple[str, ...] | None, Names(about="Scanners; all by default", of=of.name("Scanner"))
    ] = None
    quantity: Annotated[
        str, Choice(about="Velocity vector or altitude", options=("velocity", "altitude"))
    ] = "velocity"
    show: Annotated[
        str, Choice(about="Which statistics", options=("all", "availability", "bias", "rmse"))
    ] = "all"
    bins: Annotated[
        int,
        Numeric(about="Bins of altitude", example="12", at_least="1", at_most="1000", whole=True),
    ] = 12

    @property
    def _shown(self) -> str:
        return f"{self.quantity}_{self.show}"


class NavigationFigure(_OfNavigation):
    """Statistics of navigation over altitude, a line a scanner."""

    kind: Literal["navigation"]


class NavigationTable(_OfNavigation):
    """The same as a table."""

    kind: Literal["navigation_table"]


SceneFigure = Annotated[
    CloudFigure | Scatter | ShotSpectra | NavigationFigure | NavigationTable,
    Field(discriminator="kind"),
]
SCENE_FIGURE_KINDS = ("cloud", "scatter", "shot_spectra", "navigation", "navigation_table")
