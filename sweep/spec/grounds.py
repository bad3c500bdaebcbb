"""Ground of a scene: real terrain, heights from files, planes, and what is drawn at random."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import replace
from typing import TYPE_CHECKING, Literal

import numpy as np

import sweep.spec.parts as of
from sweep.model.ground import LAWS
from sweep.scenes.files import require_memory
from sweep.scenes.rasters import BYTES_A_CELL, MOST_CELLS, raster_digest, read_raster
from sweep.spec.parts import Files, Part
from sweep.spec.sections import SHARE_SCATTERED

if TYPE_CHECKING:
    from sweep.scenes.terrain import Terrain

MOST_STEPS = 7000
"""Grid steps along one side of a square."""
_STREAMS = ("relief", "hills", "craters", "boulders", "trees")

Vector = tuple[float, ...]


def generator(use: str, seed: int) -> np.random.Generator:
    """Random numbers of one use: the same seed gives craters and boulders unlike places."""
    key = (_STREAMS.index(use),)
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence(seed, spawn_key=key)))


class Material(Part):
    """Optical properties of a surface."""

    reflectance: float = SHARE_SCATTERED
    reflectance_law: str = of.choice("How it scatters", LAWS, "lambert")


OPTICAL = tuple(Material.model_fields)
"""Fields that rays know nothing of."""


class Relief(Part):
    """Fractal relief, for what a survey is too coarse to show."""

    hurst: float = of.number("Hurst exponent", "0.9", "1e-3", "0.999")
    rms_slope: float = of.number(
        "Standard deviation of height differences over the baseline, divided by it",
        "0.1", "0", "10",
    )  # fmt: skip
    baseline: float = of.size("Distance at which the slope is stated", "10 m")
    seed: int = of.seed()

    def heights(self, shape: tuple[int, int], spacing: tuple[float, float]) -> np.ndarray:
        """Heights on a grid [m], of mean 0."""
        from sweep.scenes.terrain import fractal

        heights = fractal(
            generator("relief", self.seed),
            shape=shape,
            spacing=spacing,
            **self.model_dump(include={"hurst", "rms_slope", "baseline"}),
        )
        return np.asarray(heights - heights.mean())


class Craters(Part):
    """Simple craters by the lunar size-frequency law."""

    smallest: float = of.size("Smallest diameter, three grid steps or more", "20 m")
    largest: float = of.size("Largest diameter", "300 m")
    least_fresh: float = of.number(
        "Freshness of the most worn, against 1", "0.1", "0", "1", default=0.1
    )
    equilibrium_diameter: float | None = of.size(
        "Diameter up to which craters have worn each other down; all by default", "100 m",
        default=None,
    )  # fmt: skip
    seed: int = of.seed()

    def carved(self, terrain: Terrain) -> Terrain:
        """Terrain with the craters in it."""
        from sweep.scenes.scattered import carve, draw_craters, lunar_craters

        up_to = math.inf if self.equilibrium_diameter is None else self.equilibrium_diameter
        craters = draw_craters(
            generator("craters", self.seed),
            lunar_craters(equilibrium_diameter=up_to),
            bounds=terrain.bounds,
            **self.model_dump(include={"smallest", "largest", "least_fresh"}),
        )
        return carve(terrain, craters)


def _require_memory(nodes: int) -> None:
    """Refuse a grid whose triangles would take more memory than there is."""
    remedy = "take a coarser grid, or a smaller part of it"
    require_memory(f"a ground of {nodes:,} heights", BYTES_A_CELL * nodes, remedy)


class Ground(Material, ABC):
    """A grid of heights and what is done to it, in this order: smooth, refine, relief, craters."""

    smoothing: float = of.length(
        "Standard deviation of a Gaussian that the heights are blurred by", "10 m", "0 m",
        default=0.0,
    )  # fmt: skip
    factor: int = of.count(
        "New grid steps to each old one, by a cubic spline", "8", "1", "1000", default=1
    )
    relief: Relief | None = None
    craters: Craters | None = None

    def terrain(self, files: Files) -> Terrain:
        """Return the ground in its own coordinates.

        A `SceneError` for an unfit file, a ValueError for a grid that can not hold what it should.
        """
        return self.shaped(self.survey(files))

    def shaped(self, terrain: Terrain) -> Terrain:
        """Return the survey smoothed, refined, with its relief and its craters."""
        from sweep.scenes.terrain import refine, smooth

        if terrain.heights.size * self.factor**2 > MOST_CELLS:
            raise ValueError(f"refined {self.factor} times it has more than {MOST_CELLS:.0e} nodes")
        _require_memory(terrain.heights.size * self.factor**2)
        if self.smoothing:
            terrain = smooth(terrain, width=self.smoothing)
        if self.factor > 1:
            terrain = refine(terrain, factor=self.factor)
        if self.relief is not None:
            heights = terrain.heights + self.relief.heights(terrain.heights.shape, terrain.spacing)
            terrain = replace(terrain, heights=heights)
        return terrain if self.craters is None else self.craters.carved(terrain)

    @abstractmethod
    def survey(self, files: Files) -> Terrain:
        """Return the ground before smoothing, refining, relief and craters."""

    def check(self) -> None:
        """Raise a ValueError for a grid that, by its fields alone, can not be."""

    def step(self) -> float | None:
        """Grid step [m], the larger one; None where only a file knows it."""
        return None


class PlacedGround(Ground):
    """Ground without coordinates of its own."""

    position: Vector = of.position(
        "Where the middle of its grid lies, its heights above that", default=(0.0, 0.0, 0.0)
    )

    def survey(self, files: Files) -> Terrain:
        """Return the ground before smoothing, refining, relief and craters."""
        grid = self.grid(files)
        (rows, columns), (dx, dy) = grid.heights.shape, grid.spacing
        corner = np.array([-(columns - 1) / 2 * dx, -(rows - 1) / 2 * dy, 0.0])
        return replace(grid, origin=corner + self.position)

    @abstractmethod
    def grid(self, files: Files) -> Terrain:
        """Heights, wherever they are."""


# Ground of surveys and files


class Jacksboro(PlacedGround):
    """The Jacksboro fault, Tennessee: real terrain that is always there, at posts of 74 m x 92 m.

    Heights are above sea level.
    """

    kind: Literal["jacksboro"]
    size: float | None = of.length(
        "Side of the square cut from it; all of it by default", "3 km", "1 km", default=None
    )
    middle: Vector = of.position(
        "Middle of that square, eastwards and northwards from that of the survey",
        of=2, default=(0.0, 0.0),
    )  # fmt: skip

    def grid(self, files: Files | None) -> Terrain:
        """Heights of the survey."""
        from sweep.scenes.rasters import jacksboro
        from sweep.scenes.terrain import piece

        survey = jacksboro()
        return survey if self.size is None else piece(survey, centre=self.middle, size=self.size)  # type: ignore[arg-type]

    def check(self) -> None:
        """Look for ground where the piece is cut."""
        self.grid(None)

    def step(self) -> float | None:
        """Grid step from south to north [m]."""
        return max(abs(step) for step in self.grid(None).spacing) / self.factor


_NO_DATA = of.number(
    "Value that stands for a missing height, where the file does not declare it",
    "-9999", "-1e39", "1e39", default=None,
)  # fmt: skip
_SCALE = of.number("Metres to a unit of the file's heights", "0.5", "1e-9", "1e9", default=1.0)


class RasterGround(Ground):
    """Heights of a georeferenced raster, such as a GeoTIFF, in its own coordinates."""

    kind: Literal["raster"]
    file: str = of.file("The raster: GeoTIFF or another format of GDAL", digest=raster_digest)
    band: int = of.count("Band that holds the heights", "1", default=1)
    scale: float = _SCALE
    window: Vector | None = of.several(
        of.measure("Coordinate", "", "500000"), 4, 4, None,
        about="West, south, east and north of the part to read, in the raster's coordinates",
    )  # fmt: skip
    metres_per_degree: Vector | None = of.several(
        of.measure("Metres", "", "110900", "1e-6"), 2, 2, None,
        about="Metres of a degree eastwards and northwards, of a raster in degrees",
    )  # fmt: skip
    metres_per_unit: Vector | None = of.several(
        of.measure("Metres", "", "0.5", "1e-6"), 2, 2, None,
        about="Metres on the ground to a unit of the raster's coordinates, eastwards and "
        "northwards, of a map whose scale differs from that of the ground",
    )  # fmt: skip
    height_unit: str | None = of.text(
        "Unit of the heights, where the file does not tell it: m, ft, sft (US survey foot)", None
    )
    no_data: float | None = _NO_DATA
    pixel: float | None = of.size(
        "Size of a pixel, of a raster that states no scale", "1 m", default=None
    )

    def survey(self, files: Files) -> Terrain:
        """Heights of the raster."""
        fields = {"band", "window", "metres_per_degree", "metres_per_unit", "height_unit"}
        terrain = read_raster(
            files.path(self.file, raster_digest),
            **self.model_dump(include={*fields, "no_data", "pixel"}),
            scaled=self.scale != 1.0,
        )
        return replace(terrain, heights=terrain.heights * self.scale)


class ArrayGround(PlacedGround):
    """Heights of a NumPy file."""

    kind: Literal["array"]
    file: str = of.file("The file, .npy or .npz")
    spacing: Vector = of.vector(
        "Step from column to column and from row to row; the second is below 0 where row 0 "
        "is the northern one",
        "m", "5 m", of=2,
    )  # fmt: skip
    name: str | None = of.text("Array of an .npz that holds the heights", None)
    no_data: float | None = _NO_DATA
    scale: float = _SCALE

    def grid(self, files: Files) -> Terrain:
        """Heights of the file."""
        from sweep.scenes.rasters import read_array

        spacing, missing = (self.spacing[0], self.spacing[1]), self.no_data
        path = files.path(self.file)
        terrain = read_array(path, spacing=spacing, name=self.name, no_data=missing)
        return replace(terrain, heights=terrain.heights * self.scale)


class ImageGround(PlacedGround):
    """Heights of a grey image: row 0 is the northern one."""

    kind: Literal["image"]
    file: str = of.file("The image, of 8 or 16 bits")
    pixel: float = of.size("Size of a pixel", "2 m")
    white: float = of.length("Height of full white", "49 m")
    black: float = of.length("Height of black", "0 m", default=0.0)

    def grid(self, files: Files) -> Terrain:
        """Heights of the image."""
        from sweep.scenes.rasters import read_image

        path = files.path(self.file)
        return read_image(path, pixel=self.pixel, black=self.black, white=self.white)


# Ground that no file holds


def _nodes(side: float, step: float) -> int:
    """Nodes of a grid of at least a side's length."""
    return math.ceil(side / step * (1 - 1e-12)) + 1


class SquareGround(PlacedGround):
    """A square of ground on a grid that is stated."""

    size: float = of.size("Side of the square", "3 km")

    def own_step(self) -> float:
        """Grid step before refining [m]; one cell without a spacing."""
        spacing = self.spacing  # type: ignore[attr-defined]
        return float(self.size if spacing is None else spacing)

    def flat(self) -> Terrain:
        """Return the grid, with heights of 0."""
        from sweep.scenes.terrain import Terrain

        self.check()
        step, number = self.own_step(), _nodes(self.size, self.own_step())
        _require_memory(number * number)
        return Terrain(np.zeros((number, number)), (step, step), np.zeros(3))

    def check(self) -> None:
        """Look at the number of grid steps."""
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
    height: float = of.length("Height of its middle", "0 m", default=0.0)
    slope: float = of.angle("Angle from the level", "10 deg", "0 deg", "80 deg", default=0.0)
    uphill: float = of.angle("Heading in which it rises", "90 deg", default=0.0)
    spacing: float | None = of.size(
        "Grid step, for relief and craters; one cell by default", "5 m", default=None
    )

    def grid(self, files: Files) -> Terrain:
        """Return the sloping plane."""
        grid = self.flat()
        rise, steps = math.tan(self.slope), np.arange(len(grid.heights))
        along = (steps - steps.mean()) * grid.spacing[0] * rise
        tilt = math.cos(self.uphill) * along + math.sin(self.uphill) * along[:, None]
        return replace(grid, heights=tilt + self.height)


class ReliefGround(Relief, SquareGround):
    """Fractal ground, of mean height 0."""

    kind: Literal["relief"]
    spacing: float = of.size("Grid step", "5 m")

    def grid(self, files: Files) -> Terrain:
        """Return the fractal ground, drawn by its seed."""
        grid = self.flat()
        shape = len(grid.heights), len(grid.heights)
        return replace(grid, heights=self.heights(shape, grid.spacing))


class Hills(SquareGround):
    """Smooth rolling ground, of mean height 0."""

    kind: Literal["hills"]
    spacing: float = of.size("Grid step", "1 m")
    rms_height: float = of.length("Standard deviation of the height", "10 m", "0 m")
    correlation_length: float = of.size(
        "Distance at which the correlation of heights is 1/e", "80 m"
    )
    seed: int = of.seed()

    def check(self) -> None:
        """Look at the number of grid steps, and at their size."""
        super().check()
        if not self.correlation_length > 3 * self.spacing:
            raise ValueError("hills need a correlation length over three grid steps")

    def grid(self, files: Files) -> Terrain:
        """Return the hills, drawn by their seed."""
        from sweep.scenes.terrain import hills

        grid = self.flat()
        heights = hills(
            generator("hills", self.seed),
            shape=(len(grid.heights), len(grid.heights)),
            spacing=grid.spacing,
            rms_height=self.rms_height,
            correlation_length=self.correlation_length,
        )
        return replace(grid, heights=heights)
