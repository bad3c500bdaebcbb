"""Ground of a scene: real terrain, heights from files, and what is drawn at random."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

import numpy as np

import sweep.spec.quantities as of
from sweep.model.ground import LAWS
from sweep.scenes.rasters import MOST_CELLS, raster_digest, read_raster
from sweep.spec.instrument import Part
from sweep.spec.list_rules import File, Several
from sweep.spec.rules import Choice, Numeric, Text
from sweep.spec.streams import generator

if TYPE_CHECKING:
    from sweep.scenes.terrain import Terrain
    from sweep.spec.files import Files


class Material(Part):
    """Optical properties of a surface."""

    reflectance: Annotated[
        float,
        Numeric(about="Fraction of light scattered back", example="0.1", at_least="0", at_most="1"),
    ]
    reflectance_law: Annotated[str, Choice(about="How it scatters", options=LAWS)] = "lambert"


OPTICAL = tuple(Material.model_fields)
"""Fields that rays know nothing of."""

_SCALE = of.number("Metres to a unit of the file's heights", "0.5", at_least="1e-9", at_most="1e9")

_RELIEF_SLOPE = of.number(
    "Standard deviation of height differences over the baseline, divided by it",
    "0.1",
    at_least="0",
    at_most="10",
)


class Relief(Part):
    """Fractal relief, for what a survey is too coarse to show."""

    hurst: Annotated[float, of.number("Hurst exponent", "0.9", at_least="1e-3", at_most="0.999")]
    rms_slope: Annotated[float, _RELIEF_SLOPE]
    baseline: Annotated[float, of.size("Distance at which the slope is stated", "10 m")]
    seed: Annotated[int, of.seed()] = 0

    def heights(self, shape: tuple[int, int], spacing: tuple[float, float]) -> np.ndarray:
        """Heights on a grid [m], of mean 0."""
        from sweep.scenes.terrain import fractal

        heights = fractal(
            generator("relief", self.seed),
            shape=shape,
            spacing=spacing,
            hurst=self.hurst,
            rms_slope=self.rms_slope,
            baseline=self.baseline,
        )
        return np.asarray(heights - heights.mean())


class Craters(Part):
    """Simple craters by the lunar size-frequency law."""

    smallest: Annotated[float, of.size("Smallest diameter, three grid steps or more", "20 m")]
    largest: Annotated[float, of.size("Largest diameter", "300 m")]
    least_fresh: Annotated[
        float,
        of.number("Freshness of the most worn, against 1", "0.1", at_least="0", at_most="1"),
    ] = 0.1
    equilibrium_diameter: Annotated[
        float | None,
        of.size("Diameter up to which craters have worn each other down; all by default", "100 m"),
    ] = None
    seed: Annotated[int, of.seed()] = 0

    def carved(self, terrain: Terrain) -> Terrain:
        """Terrain with the craters in it."""
        from sweep.scenes.scattered import carve, draw_craters, lunar_craters

        up_to = math.inf if self.equilibrium_diameter is None else self.equilibrium_diameter
        craters = draw_craters(
            generator("craters", self.seed),
            lunar_craters(equilibrium_diameter=up_to),
            bounds=terrain.bounds,
            smallest=self.smallest,
            largest=self.largest,
            least_fresh=self.least_fresh,
        )
        return carve(terrain, craters)


class Ground(Material, ABC):
    """A grid of heights and what is done to it, in this order: smooth, refine, relief, craters."""

    owns_coordinates: ClassVar[bool] = False
    """Whether its coordinates are its own, and not relative to the scene's origin."""

    smoothing: Annotated[
        float,
        of.length(
            "Standard deviation of a Gaussian that the heights are blurred by", at_least="0 m"
        ),
    ] = 0.0
    factor: Annotated[
        int, of.count("New grid steps to each old one, by a cubic spline", "8", at_most="1000")
    ] = 1
    relief: Relief | None = None
    craters: Craters | None = None

    def terrain(self, files: Files) -> Terrain:
        """The ground in its own coordinates; files are found by `files`.

        Raises
        ------
        SceneError
            For a file that is missing or unfit.
        ValueError
            For a grid that can not hold what it should.
        """
        from sweep.scenes.terrain import Terrain, refine, smooth

        terrain = self.survey(files)
        if terrain.heights.size * self.factor**2 > MOST_CELLS:
            raise ValueError(f"refined {self.factor} times it has more than {MOST_CELLS:.0e} nodes")
        if self.smoothing:
            terrain = smooth(terrain, width=self.smoothing)
        if self.factor > 1:
            terrain = refine(terrain, factor=self.factor)
        if self.relief is not None:
            heights = terrain.heights + self.relief.heights(terrain.heights.shape, terrain.spacing)
            terrain = Terrain(heights, terrain.spacing, terrain.origin)
        return terrain if self.craters is None else self.craters.carved(terrain)

    @abstractmethod
    def survey(self, files: Files) -> Terrain:
        """The ground before anything is done to it."""

    def check(self) -> None:
        """Looks at what can be seen without making the ground.

        Raises
        ------
        ValueError
            For a grid that can not be.
        """

    def step(self) -> float | None:
        """Grid step [m], the larger one; None where only a file knows it."""
        return None


class PlacedGround(Ground):
    """Ground without coordinates of its own."""

    position: Annotated[
        tuple[float, ...],
        of.position("Where the middle of its grid lies, its heights above that"),
    ] = (0.0, 0.0, 0.0)

    def survey(self, files: Files) -> Terrain:
        """The ground before anything is done to it."""
        from sweep.scenes.terrain import Terrain

        grid = self.grid(files)
        (rows, columns), (dx, dy) = grid.heights.shape, grid.spacing
        corner = np.array([-(columns - 1) / 2 * dx, -(rows - 1) / 2 * dy, 0.0])
        return Terrain(grid.heights, grid.spacing, corner + self.position)

    @abstractmethod
    def grid(self, files: Files) -> Terrain:
        """Heights, wherever they are."""


class Jacksboro(PlacedGround):
    """The Jacksboro fault, Tennessee: real terrain that is always there, at posts of 74 m x 92 m.

    Heights are above sea level.
    """

    kind: Literal["jacksboro"]
    size: Annotated[
        float | None,
        of.length("Side of the square cut from it; all of it by default", "3 km", at_least="1 km"),
    ] = None
    middle: Annotated[
        tuple[float, ...],
        of.position("Middle of that square, eastwards and northwards from that of the survey", 2),
    ] = (0.0, 0.0)

    def grid(self, files: Files | None) -> Terrain:
        """Heights of the survey."""
        from sweep.scenes.rasters import jacksboro
        from sweep.scenes.terrain import piece

        survey = jacksboro()
        if self.size is None:
            return survey
        return piece(survey, centre=self.middle, size=self.size)

    def check(self) -> None:
        """Looks for ground where the piece is cut."""
        self.grid(None)

    def step(self) -> float | None:
        """Grid step from south to north [m]."""
        return max(abs(step) for step in self.grid(None).spacing) / self.factor


class RasterGround(Ground):
    """Heights of a georeferenced raster, such as a GeoTIFF, in its own coordinates."""

    owns_coordinates = True

    kind: Literal["raster"]
    file: Annotated[str, File(about="The raster, whatever rasterio reads", digest=raster_digest)]
    band: Annotated[int, of.count("Band that holds the heights", "1")] = 1
    scale: Annotated[float, _SCALE] = 1.0
    window: Annotated[
        tuple[float, ...] | None,
        Several(
            about="West, south, east and north of the part to read, in the raster's coordinates",
            of=of.number("Coordinate", "500000"),
            least=4,
            most=4,
        ),
    ] = None
    metres_per_degree: Annotated[
        tuple[float, ...] | None,
        Several(
            about="Metres of a degree eastwards and northwards, of a raster in degrees",
            of=of.number("Metres", "110900", at_least="1e-6"),
            least=2,
            most=2,
        ),
    ] = None
    pixel: Annotated[
        float | None, of.size("Size of a pixel, of a raster that states no scale", "1 m")
    ] = None

    def survey(self, files: Files) -> Terrain:
        """Heights of the raster."""
        terrain = read_raster(
            files.path(self.file, raster_digest),
            band=self.band,
            window=self.window,  # type: ignore[arg-type]
            metres_per_degree=self.metres_per_degree,  # type: ignore[arg-type]
            pixel=self.pixel,
        )
        return replace(terrain, heights=terrain.heights * self.scale)


class ArrayGround(PlacedGround):
    """Heights of a NumPy file."""

    kind: Literal["array"]
    file: Annotated[str, File(about="The file, .npy or .npz")]
    spacing: Annotated[
        tuple[float, ...],
        of.vector(
            "Step from column to column and from row to row; the second is below 0 where row 0 "
            "is the northern one",
            "m",
            "5 m",
            2,
        ),
    ]
    name: Annotated[str | None, Text(about="Array of an .npz that holds the heights")] = None
    no_data: Annotated[float | None, of.number("Value for a missing height", "-9999")] = None
    scale: Annotated[float, _SCALE] = 1.0

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
    file: Annotated[str, File(about="The image, of 8 or 16 bits")]
    pixel: Annotated[float, of.size("Size of a pixel", "2 m")]
    white: Annotated[float, of.length("Height of full white", "49 m")]
    black: Annotated[float, of.length("Height of black", "0 m")] = 0.0

    def grid(self, files: Files) -> Terrain:
        """Heights of the image."""
        from sweep.scenes.rasters import read_image

        path = files.path(self.file)
        return read_image(path, pixel=self.pixel, black=self.black, white=self.white)
