"""Ground of a scene that no file holds: planes, and what is drawn at random."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np

import sweep.spec.quantities as of
from sweep.spec.grounds import PlacedGround, Relief
from sweep.spec.streams import generator

if TYPE_CHECKING:
    from sweep.scenes.terrain import Terrain
    from sweep.spec.files import Files

MOST_STEPS = 7000
"""Grid steps along one side."""


def _nodes(side: float, step: float) -> int:
    """Nodes of a grid of at least a side's length."""
    return math.ceil(side / step * (1 - 1e-12)) + 1


class SquareGround(PlacedGround):
    """A square of ground on a grid that is stated."""

    size: Annotated[float, of.size("Side of the square", "3 km")]

    def own_step(self) -> float:
        """Grid step before refining [m]."""
        return float(self.spacing)  # type: ignore[attr-defined]

    def flat(self) -> Terrain:
        """The grid, of heights 0."""
        from sweep.scenes.terrain import Terrain

        self.check()
        step, number = self.own_step(), _nodes(self.size, self.own_step())
        return Terrain(np.zeros((number, number)), (step, step), np.zeros(3))

    def check(self) -> None:
        """Looks at the number of grid steps."""
        steps = _nodes(self.size, self.own_step()) - 1
        if not 1 <= steps <= MOST_STEPS:
            raise ValueError(
                f"a side of {self.size:g} m has {steps} steps of {self.own_step():g} m, "
                f"and takes {MOST_STEPS} at most"
            )

    def step(self) -> float | None:
        """Grid step [m]."""
        return self.own_step() / self.factor


class Plane(SquareGround):
    """A square plane."""

    kind: Literal["plane"]
    height: Annotated[float, of.length("Height of its middle", "0 m")] = 0.0
    slope: Annotated[
        float, of.angle("Angle from the level", "10 deg", at_least="0 deg", at_most="80 deg")
    ] = 0.0
    uphill: Annotated[float, of.angle("Heading in which it rises", "90 deg")] = 0.0
    spacing: Annotated[
        float | None, of.size("Grid step, for relief and craters; one cell by default", "5 m")
    ] = None

    def own_step(self) -> float:
        """Grid step before refining [m]."""
        return self.size if self.spacing is None else self.spacing

    def grid(self, files: Files) -> Terrain:
        """The plane."""
        from sweep.scenes.terrain import Terrain

        grid = self.flat()
        rise, steps = math.tan(self.slope), np.arange(len(grid.heights))
        along = (steps - steps.mean()) * grid.spacing[0] * rise
        tilt = math.cos(self.uphill) * along + math.sin(self.uphill) * along[:, None]
        return Terrain(tilt + self.height, grid.spacing, grid.origin)


class ReliefGround(Relief, SquareGround):
    """Fractal ground, of mean height 0."""

    kind: Literal["relief"]
    spacing: Annotated[float, of.size("Grid step", "5 m")]

    def grid(self, files: Files) -> Terrain:
        """The ground as drawn."""
        from sweep.scenes.terrain import Terrain

        grid = self.flat()
        shape = len(grid.heights), len(grid.heights)
        return Terrain(self.heights(shape, grid.spacing), grid.spacing, grid.origin)


class Hills(SquareGround):
    """Smooth rolling ground, of mean height 0."""

    kind: Literal["hills"]
    spacing: Annotated[float, of.size("Grid step", "1 m")]
    rms_height: Annotated[float, of.length("Standard deviation of the height", at_least="0 m")]
    correlation_length: Annotated[
        float, of.size("Distance at which the correlation of heights is 1/e", "80 m")
    ]
    seed: Annotated[int, of.seed()] = 0

    def check(self) -> None:
        """Looks at the number of grid steps, and at their size."""
        super().check()
        if not self.correlation_length > 3 * self.spacing:
            raise ValueError("hills need a correlation length over three grid steps")

    def grid(self, files: Files) -> Terrain:
        """The ground as drawn."""
        from sweep.scenes.terrain import Terrain, hills

        grid = self.flat()
        heights = hills(
            generator("hills", self.seed),
            shape=(len(grid.heights), len(grid.heights)),
            spacing=grid.spacing,
            rms_height=self.rms_height,
            correlation_length=self.correlation_length,
        )
        return Terrain(heights, grid.spacing, grid.origin)
