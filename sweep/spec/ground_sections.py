"""Sections of a spec for the ground of a scene: surveys, files, planes and random terrain."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import replace
from typing import TYPE_CHECKING, Literal

import numpy as np

import sweep.spec.fields as declare
from sweep.model.ground import REFLECTANCE_LAWS
from sweep.scenes.rasters import (
    GRID_CELLS_MAX,
    TRIANGULATION_BYTES_PER_CELL,
    raster_digest,
    read_raster_terrain,
)
from sweep.scenes.scene_files import require_memory
from sweep.spec.fields import SpecFiles, SpecSection, Vector
from sweep.spec.sections import REFLECTANCE_FIELD

if TYPE_CHECKING:
    from sweep.scenes.terrain import Terrain

GRID_STEPS_PER_SIDE_MAX = 7000
"""Largest number of grid steps along a side of a square ground."""
_RANDOM_STREAM_NAMES = ("relief", "hills", "craters", "boulders", "trees")
"""Uses of random numbers; the index in this tuple selects an independent stream."""


def random_generator(purpose: str, seed: int) -> np.random.Generator:
    """Return the random number generator for one use, such as drawing craters or trees.

    Generators of different uses with the same seed are independent.

    Parameters
    ----------
    purpose : str
        One of ``relief``, ``hills``, ``craters``, ``boulders`` and ``trees``.
    seed : int
        Seed of the section, >= 0.
    """
    key = (_RANDOM_STREAM_NAMES.index(purpose),)
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence(seed, spawn_key=key)))


class Material(SpecSection):
    """Optical properties of a surface."""

    reflectance: float = REFLECTANCE_FIELD
    reflectance_law: str = declare.choice_field(
        "Law by which the surface scatters light", REFLECTANCE_LAWS, "lambert"
    )


OPTICAL_FIELDS = tuple(Material.model_fields)
"""Names of the fields of a surface that describe its optics and do not change where rays hit."""


class Relief(SpecSection):
    """Fractal relief at scales that a survey does not resolve."""

    hurst: float = declare.number_field("Hurst exponent", "0.9", "1e-3", "0.999")
    rms_slope: float = declare.number_field(
        "Standard deviation of height differences over the baseline, divided by it",
        "0.1", "0", "10",
    )  # fmt: skip
    baseline: float = declare.positive_length_field("Distance at which the slope is stated", "10 m")
    seed: int = declare.seed_field()

    def draw_heights(self, shape: tuple[int, int], spacing: tuple[float, float]) -> np.ndarray:
        """Draw fractal heights with mean 0 at the nodes of a grid.

        Parameters
        ----------
        shape : (int, int)
            Number of rows and columns.
        spacing : (float, float)
            Grid steps along x and y [m].

        Returns
        -------
        ndarray, shape (rows, columns)
            Heights [m].
        """
        from sweep.scenes.terrain import draw_fractal_relief

        heights = draw_fractal_relief(
            random_generator("relief", self.seed),
            shape=shape,
            spacing=spacing,
            **self.model_dump(include={"hurst", "rms_slope", "baseline"}),
        )
        return np.asarray(heights - heights.mean())


class Craters(SpecSection):
    """Simple craters with the lunar size-frequency law."""

    smallest: float = declare.positive_length_field(
        "Smallest diameter, three grid steps or more", "20 m"
    )
    largest: float = declare.positive_length_field("Largest diameter", "300 m")
    least_fresh: float = declare.number_field(
        "Freshness of the most worn craters; 1 is fresh", "0.1", "0", "1", default=0.1
    )
    equilibrium_diameter: float | None = declare.positive_length_field(
        "Diameter up to which craters have worn each other down; all by default", "100 m",
        default=None,
    )  # fmt: skip
    seed: int = declare.seed_field()

    def carve_into(self, terrain: Terrain) -> Terrain:
        """Return a copy of the terrain with craters, drawn at random, carved into it."""
        from sweep.scenes.scattered_objects import carve_craters, draw_craters, lunar_crater_law

        equilibrium_diameter = (
            math.inf if self.equilibrium_diameter is None else self.equilibrium_diameter
        )
        craters = draw_craters(
            random_generator("craters", self.seed),
            lunar_crater_law(equilibrium_diameter=equilibrium_diameter),
            bounds=terrain.bounds,
            **self.model_dump(include={"smallest", "largest", "least_fresh"}),
        )
        return carve_craters(terrain, craters)


def _require_grid_memory(n_nodes: int) -> None:
    """Raise `SceneError` if the triangles of a grid of `n_nodes` heights exceed the free memory."""
    remedy = "take a coarser grid, or a smaller part of it"
    require_memory(
        f"a ground of {n_nodes:,} heights", TRIANGULATION_BYTES_PER_CELL * n_nodes, remedy
    )


class Ground(Material, ABC):
    """Base of all grounds: heights on a grid, then smoothing, refining, relief and craters."""

    smoothing: float = declare.length_field(
        "Standard deviation of a Gaussian that the heights are blurred by", "10 m", "0 m",
        default=0.0,
    )  # fmt: skip
    factor: int = declare.integer_field(
        "Number of new grid steps for each old one, by a cubic spline", "8", "1", "1000", default=1
    )
    relief: Relief | None = None
    craters: Craters | None = None

    def build_terrain(self, files: SpecFiles) -> Terrain:
        """Return the ground in its own coordinates, with smoothing, refining, relief and craters.

        Raises
        ------
        SceneError
            If the file is unsuitable, or memory does not suffice.
        ValueError
            If the grid is invalid, or can't hold the craters.
        """
        return self.process_terrain(self.unprocessed_terrain(files))

    def process_terrain(self, terrain: Terrain) -> Terrain:
        """Return a terrain after smoothing and refining, with relief and craters added.

        Parameters
        ----------
        terrain : Terrain
            Ground before processing.

        Returns
        -------
        Terrain
            Processed ground in the same coordinates.

        Raises
        ------
        ValueError
            If the refined grid has too many nodes.
        """
        from sweep.scenes.terrain import refine_terrain, smooth_terrain

        if terrain.heights.size * self.factor**2 > GRID_CELLS_MAX:
            raise ValueError(
                f"refined {self.factor} times it has more than {GRID_CELLS_MAX:.0e} nodes"
            )
        _require_grid_memory(terrain.heights.size * self.factor**2)
        if self.smoothing:
            terrain = smooth_terrain(terrain, standard_deviation=self.smoothing)
        if self.factor > 1:
            terrain = refine_terrain(terrain, factor=self.factor)
        if self.relief is not None:
            heights = terrain.heights + self.relief.draw_heights(
                terrain.heights.shape, terrain.spacing
            )
            terrain = replace(terrain, heights=heights)
        return terrain if self.craters is None else self.craters.carve_into(terrain)

    @abstractmethod
    def unprocessed_terrain(self, files: SpecFiles) -> Terrain:
        """Return the ground as terrain, before smoothing, refining, relief and craters."""

    def check_grid(self) -> None:
        """Raise `ValueError` if the section's fields define an invalid grid.

        This base class never raises.
        """

    def grid_step(self) -> float | None:
        """Return the larger of the grid steps along x and y, after refining [m].

        The result is None if the grid step is stated only in a file, as for this base class.
        """
        return None


class PlacedGround(Ground):
    """Base of grounds whose grid has no coordinates: `position` places its middle."""

    position: Vector = declare.position_field(
        "Position of the grid's middle; heights are relative to its z", default=(0.0, 0.0, 0.0)
    )

    def unprocessed_terrain(self, files: SpecFiles) -> Terrain:
        """Return the ground as terrain that is centred at `position`.

        Smoothing, refining, relief and craters are not applied.
        """
        terrain = self.unplaced_terrain(files)
        (rows, columns), (dx, dy) = terrain.heights.shape, terrain.spacing
        corner = np.array([-(columns - 1) / 2 * dx, -(rows - 1) / 2 * dy, 0.0])
        return replace(terrain, origin=corner + self.position)

    @abstractmethod
    def unplaced_terrain(self, files: SpecFiles) -> Terrain:
        """Return the ground as terrain with an arbitrary origin."""


# Ground of surveys and files


class JacksboroGround(PlacedGround):
    """Terrain of the Jacksboro fault, Tennessee, from matplotlib's data: posts of 74 m x 92 m.

    Heights are above sea level.
    """

    kind: Literal["jacksboro"]
    size: float | None = declare.length_field(
        "Side of the square cut from the survey; by default all of the survey",
        "3 km",
        "1 km",
        default=None,
    )
    middle: Vector = declare.position_field(
        "Middle of that square, eastwards and northwards from the middle of the survey",
        dimensions=2, default=(0.0, 0.0),
    )  # fmt: skip

    def unplaced_terrain(self, files: SpecFiles | None) -> Terrain:
        """Return the survey, or the square cut from it, with heights above sea level [m]."""
        from sweep.scenes.rasters import read_jacksboro_terrain
        from sweep.scenes.terrain import crop_to_square

        survey = read_jacksboro_terrain()
        return (
            survey
            if self.size is None
            else crop_to_square(survey, centre=self.middle, size=self.size)
        )  # type: ignore[arg-type]

    def check_grid(self) -> None:
        """Raise `ValueError` if the square is not completely inside the survey."""
        self.unplaced_terrain(None)

    def grid_step(self) -> float | None:
        """Return the larger of the grid steps along x and y, after refining [m]."""
        return max(abs(step) for step in self.unplaced_terrain(None).spacing) / self.factor


_NO_DATA_FIELD = declare.number_field(
    "Value that stands for a missing height, if the file does not declare it",
    "-9999", "-1e39", "1e39", default=None,
)  # fmt: skip
_HEIGHT_SCALE_FIELD = declare.number_field(
    "Metres per unit of the file's heights", "0.5", "1e-9", "1e9", default=1.0
)


class RasterGround(Ground):
    """Heights of a georeferenced raster, such as a GeoTIFF, in its own coordinates."""

    kind: Literal["raster"]
    file: str = declare.file_path_field(
        "The raster: GeoTIFF or another format of GDAL", compute_digest=raster_digest
    )
    band: int = declare.integer_field("Band that holds the heights", "1", default=1)
    scale: float = _HEIGHT_SCALE_FIELD
    window: Vector | None = declare.list_field(
        declare.quantity_rule("Coordinate", "", "500000"), 4, 4, None,
        description="West, south, east and north of the part to read, in the raster's coordinates",
    )  # fmt: skip
    metres_per_degree: Vector | None = declare.list_field(
        declare.quantity_rule("Metres", "", "110900", "1e-6"), 2, 2, None,
        description="Metres of a degree eastwards and northwards, of a raster in degrees",
    )  # fmt: skip
    metres_per_unit: Vector | None = declare.list_field(
        declare.quantity_rule("Metres", "", "0.5", "1e-6"), 2, 2, None,
        description="Metres on the ground to a unit of the raster's coordinates, eastwards and "
        "northwards, of a map whose scale differs from that of the ground",
    )  # fmt: skip
    height_unit: str | None = declare.text_field(
        "Unit of the heights, if the file does not state it: m, ft, sft (US survey foot)", None
    )
    no_data: float | None = _NO_DATA_FIELD
    pixel: float | None = declare.positive_length_field(
        "Size of a pixel, of a raster that states no scale", "1 m", default=None
    )

    def unprocessed_terrain(self, files: SpecFiles) -> Terrain:
        """Return the raster as terrain in its own coordinates, with heights times `scale` [m]."""
        field_names = {"band", "window", "metres_per_degree", "metres_per_unit", "height_unit"}
        terrain = read_raster_terrain(
            files.resolve(self.file, raster_digest),
            **self.model_dump(include={*field_names, "no_data", "pixel"}),
            has_height_scale=self.scale != 1.0,
        )
        return replace(terrain, heights=terrain.heights * self.scale)


class ArrayGround(PlacedGround):
    """Heights from a NumPy file."""

    kind: Literal["array"]
    file: str = declare.file_path_field("The file, .npy or .npz")
    spacing: Vector = declare.vector_field(
        "Step from column to column and from row to row; the second is below 0 where row 0 "
        "is the northern one",
        "m", "5 m", dimensions=2,
    )  # fmt: skip
    name: str | None = declare.text_field("Array of an .npz that holds the heights", None)
    no_data: float | None = _NO_DATA_FIELD
    scale: float = _HEIGHT_SCALE_FIELD

    def unplaced_terrain(self, files: SpecFiles) -> Terrain:
        """Return the array in the NumPy file as terrain, with heights times `scale` [m]."""
        from sweep.scenes.rasters import read_numpy_terrain

        spacing, no_data = (self.spacing[0], self.spacing[1]), self.no_data
        path = files.resolve(self.file)
        terrain = read_numpy_terrain(path, spacing=spacing, name=self.name, no_data=no_data)
        return replace(terrain, heights=terrain.heights * self.scale)


class ImageGround(PlacedGround):
    """Heights from a grey image; row 0 is the northern one."""

    kind: Literal["image"]
    file: str = declare.file_path_field("The image, of 8 or 16 bits")
    pixel: float = declare.positive_length_field("Size of a pixel", "2 m")
    white: float = declare.length_field("Height of full white", "49 m")
    black: float = declare.length_field("Height of black", "0 m", default=0.0)

    def unplaced_terrain(self, files: SpecFiles) -> Terrain:
        """Return the image as terrain: heights linear in grey level, `black` to `white` [m]."""
        from sweep.scenes.rasters import read_image_terrain

        path = files.resolve(self.file)
        return read_image_terrain(path, pixel=self.pixel, black=self.black, white=self.white)


# Ground without a file


def _nodes_per_side(side: float, step: float) -> int:
    """Return the number of grid nodes, `step` [m] apart, that span a side of `side` [m] or more."""
    return math.ceil(side / step * (1 - 1e-12)) + 1


class SquareGround(PlacedGround):
    """Base of square grounds on a regular grid."""

    size: float = declare.positive_length_field("Side of the square", "3 km")

    def unrefined_step(self) -> float:
        """Return the grid step before refining [m]: `spacing`, or the side if `spacing` is None."""
        spacing = self.spacing  # type: ignore[attr-defined]
        return float(self.size if spacing is None else spacing)

    def flat_terrain(self) -> Terrain:
        """Return a terrain on the square grid with all heights 0."""
        from sweep.scenes.terrain import Terrain

        self.check_grid()
        step, n_nodes = self.unrefined_step(), _nodes_per_side(self.size, self.unrefined_step())
        _require_grid_memory(n_nodes * n_nodes)
        return Terrain(np.zeros((n_nodes, n_nodes)), (step, step), np.zeros(3))

    def check_grid(self) -> None:
        """Raise `ValueError` if a side of the square has no grid step or too many."""
        n_steps = _nodes_per_side(self.size, self.unrefined_step()) - 1
        if not 1 <= n_steps <= GRID_STEPS_PER_SIDE_MAX:
            raise ValueError(
                f"a side of {self.size:g} m has {n_steps} steps of {self.unrefined_step():g} m, "
                f"and takes {GRID_STEPS_PER_SIDE_MAX} at most"
            )

    def grid_step(self) -> float | None:
        """Return the grid step after refining [m], which is equal along x and y."""
        return self.unrefined_step() / self.factor


class PlaneGround(SquareGround):
    """Square plane with an optional slope."""

    kind: Literal["plane"]
    height: float = declare.length_field("Height of the plane's middle", "0 m", default=0.0)
    slope: float = declare.angle_field(
        "Angle from the level", "10 deg", "0 deg", "80 deg", default=0.0
    )
    uphill: float = declare.angle_field("Heading in which the plane rises", "90 deg", default=0.0)
    spacing: float | None = declare.positive_length_field(
        "Grid step, for relief and craters; one cell by default", "5 m", default=None
    )

    def unplaced_terrain(self, files: SpecFiles) -> Terrain:
        """Return the plane as terrain; it rises by the angle `slope` in the heading `uphill`."""
        terrain = self.flat_terrain()
        tangent, node_numbers = math.tan(self.slope), np.arange(len(terrain.heights))
        rise_along_side = (node_numbers - node_numbers.mean()) * terrain.spacing[0] * tangent
        heights = (
            math.cos(self.uphill) * rise_along_side
            + math.sin(self.uphill) * rise_along_side[:, None]
        )
        return replace(terrain, heights=heights + self.height)


class ReliefGround(Relief, SquareGround):
    """Fractal ground with mean height 0."""

    kind: Literal["relief"]
    spacing: float = declare.positive_length_field("Grid step", "5 m")

    def unplaced_terrain(self, files: SpecFiles) -> Terrain:
        """Return the fractal ground as terrain, with heights drawn from its seed."""
        terrain = self.flat_terrain()
        shape = len(terrain.heights), len(terrain.heights)
        return replace(terrain, heights=self.draw_heights(shape, terrain.spacing))


class HillsGround(SquareGround):
    """Smooth rolling ground of mean height 0."""

    kind: Literal["hills"]
    spacing: float = declare.positive_length_field("Grid step", "1 m")
    rms_height: float = declare.length_field("Standard deviation of the height", "10 m", "0 m")
    correlation_length: float = declare.positive_length_field(
        "Distance at which the correlation of heights is 1/e", "80 m"
    )
    seed: int = declare.seed_field()

    def check_grid(self) -> None:
        """Raise `ValueError` if the grid has too many steps, or steps too large for the hills."""
        super().check_grid()
        if not self.correlation_length > 3 * self.spacing:
            raise ValueError("hills need a correlation length over three grid steps")

    def unplaced_terrain(self, files: SpecFiles) -> Terrain:
        """Return the hills as terrain, with heights drawn from their seed."""
        from sweep.scenes.terrain import draw_hills

        terrain = self.flat_terrain()
        heights = draw_hills(
            random_generator("hills", self.seed),
            shape=(len(terrain.heights), len(terrain.heights)),
            spacing=terrain.spacing,
            rms_height=self.rms_height,
            correlation_length=self.correlation_length,
        )
        return replace(terrain, heights=heights)
