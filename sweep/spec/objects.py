"""Objects of a scene: meshes and solids, and what stands on its ground."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import Field

import sweep.spec.quantities as of
from sweep.spec.drawn_grounds import Hills, Plane, ReliefGround
from sweep.spec.grounds import ArrayGround, ImageGround, Jacksboro, Material, RasterGround
from sweep.spec.instrument import Part
from sweep.spec.list_rules import File
from sweep.spec.motion import Motion, Turn
from sweep.spec.rules import Choice, Numeric, Text
from sweep.spec.streams import generator

if TYPE_CHECKING:
    from sweep.scenes.meshes import Facets
    from sweep.scenes.scattered import Law
    from sweep.scenes.terrain import Terrain
    from sweep.spec.files import Files

Vector = tuple[float, ...]


class Solid(Material, ABC):
    """An object of its own, at rest or moving.

    One that moves is placed by its path; its rotation is that in the moving body's frame.
    """

    position: Annotated[
        Vector | None, of.position("Where its own zero lies; its coordinates as they are")
    ] = None
    rotation: Turn = Turn()
    motion: Motion | None = None

    def facets(self, files: Files) -> Facets:
        """Its facets, turned, about its own zero.

        Raises
        ------
        SceneError
            For a file that is missing or unfit.
        """
        return self.shape(files).placed(rotation=self.rotation.turn())

    @abstractmethod
    def shape(self, files: Files) -> Facets:
        """Its facets before they are turned."""


class MeshObject(Solid):
    """A mesh from a file."""

    kind: Literal["mesh"]
    file: Annotated[str, File(about="The mesh: STL, OBJ, PLY, glTF and whatever trimesh loads")]
    unit: Annotated[str | None, Text(about="Unit of its lengths; the file's own, or m")] = None
    up: Annotated[
        str | None, Choice(about="Its vertical axis; y for glTF, else z", options=("y", "z"))
    ] = None
    scale: Annotated[
        float, of.number("Factor on all lengths", "2", at_least="1e-9", at_most="1e9")
    ] = 1.0

    def shape(self, files: Files) -> Facets:
        """Its facets before they are turned."""
        from sweep.scenes.meshes import read_mesh

        return read_mesh(files.path(self.file), unit=self.unit, up=self.up, scale=self.scale)


class Sphere(Solid):
    """A sphere of triangles whose corners lie on it."""

    kind: Literal["sphere"]
    radius: Annotated[float, of.size("Radius", "1 m")]
    subdivisions: Annotated[
        int, of.count("Times that an icosahedron's faces are cut in four", "4", "0", "8")
    ] = 4

    def shape(self, files: Files) -> Facets:
        """Its facets about its centre."""
        from sweep.scenes.meshes import sphere

        return sphere(radius=self.radius, subdivisions=self.subdivisions)


class Box(Solid):
    """A box."""

    kind: Literal["box"]
    size: Annotated[Vector, of.vector("Length along x, y and z", "m", "2 m")]

    def shape(self, files: Files) -> Facets:
        """Its facets about its middle."""
        from sweep.scenes.meshes import box

        return box(size=self.size)


class MartianRocks(Part):
    """Rocks of the Martian plains (Golombek and Rapp 1997)."""

    kind: Literal["martian_rocks"]
    abundance: Annotated[
        float,
        of.number("Fraction of the ground under rocks", "5 %", at_least="1e-9", at_most="0.9"),
    ]

    def law(self) -> Law:
        """Size-frequency law."""
        from sweep.scenes.scattered import MartianRocks

        return MartianRocks(self.abundance)


class PowerLaw(Part):
    """A number per area that falls with a power of the diameter."""

    kind: Literal["power"]
    density: Annotated[
        float,
        Numeric(about="Number per area of 1 m or larger", si_unit="m^-2", example="0.01 m^-2",
                at_least="1e-12 m^-2", at_most="1e6 m^-2"),
    ]  # fmt: skip
    exponent: Annotated[float, of.number("Exponent", "2.5", at_least="1e-3", at_most="20")]

    def law(self) -> Law:
        """Size-frequency law."""
        from sweep.scenes.scattered import PowerLaws

        return PowerLaws(((self.density, self.exponent),))


class Boulders(Material):
    """Half-ellipsoids on a ground."""

    kind: Literal["boulders"]
    on: Annotated[str, of.name("Ground that they lie on")]
    law: Annotated[MartianRocks | PowerLaw, Field(discriminator="kind")]
    smallest: Annotated[float, of.size("Smallest diameter", "0.5 m")]
    largest: Annotated[float, of.size("Largest diameter", "3 m")]
    centre: Annotated[
        Vector, of.position("Middle of the square that they lie in", 2)
    ] = (0.0, 0.0)  # fmt: skip
    within: Annotated[
        float | None, of.size("Side of that square; all of the ground by default", "200 m")
    ] = None
    height_ratio: Annotated[
        float, of.number("Height over diameter", "0.5", at_least="1e-6", at_most="10")
    ] = 0.5
    elongation: Annotated[
        float, of.number("Largest ratio of long to short axis", "1.5", at_least="1", at_most="10")
    ] = 1.5
    subdivisions: Annotated[int, of.count("Refinement of their shape", "2", "0", "4")] = 2
    seed: Annotated[int, of.seed()] = 0

    def facets(self, ground: Terrain) -> Facets:
        """Their facets on a ground in the scene's frame.

        Raises
        ------
        ValueError
            For too many of them, or none of the ground within the square.
        """
        from sweep.scenes.scattered import draw_boulders
        from sweep.scenes.terrain import square

        bounds = None
        if self.within is not None:
            bounds = square(ground, centre=self.centre, size=self.within)
        return draw_boulders(
            generator("boulders", self.seed),
            self.law.law(),
            ground,
            smallest=self.smallest,
            largest=self.largest,
            bounds=bounds,
            height_ratio=self.height_ratio,
            elongation=self.elongation,
            subdivisions=self.subdivisions,
        )


class TreeMeasures(Part):
    """Mean measures of the trees of a clump."""

    height: Annotated[float, of.size("From the ground to the top", "12 m")] = 12.0
    crown_diameter: Annotated[float, of.size("Across", "7 m")] = 7.0
    crown_base: Annotated[float, of.length("Height of its lower end", "3 m", at_least="0 m")] = 3.0
    trunk_diameter: Annotated[float, of.size("At the ground", "40 cm")] = 0.4
    leaf_length: Annotated[float, of.size("Long diagonal of a leaf", "30 cm")] = 0.30
    leaf_width: Annotated[float, of.size("Short diagonal of a leaf", "20 cm")] = 0.20
    leaf_area_index: Annotated[
        float,
        of.number("One-sided leaf area over that of the outline", "2", at_least="0", at_most="20"),
    ] = 2.0
    variation: Annotated[
        float,
        of.number("Share by which sizes vary to each side", "0.25", at_least="0", at_most="0.99"),
    ] = 0.25


class Trees(Part):
    """A clump of broad-leaved trees on a ground, of two materials."""

    kind: Literal["trees"]
    on: Annotated[str, of.name("Ground that they grow on")]
    centre: Annotated[Vector, of.position("Middle of the clump", 2)] = (0.0, 0.0)
    radius: Annotated[float, of.size("Trunks stand within it", "15 m")]
    number: Annotated[int, of.count("Trees", "7", at_most="10000")]
    tree: TreeMeasures = TreeMeasures()
    leaf: Material
    trunk: Material
    seed: Annotated[int, of.seed()] = 0

    def facets(self, ground: Terrain) -> Facets:
        """Leaves (surface 0) and trunks (1) on a ground in the scene's frame.

        Raises
        ------
        ValueError
            Where they do not find room, or one would stand beside the ground.
        """
        from sweep.scenes.scattered import Tree, clump

        return clump(
            generator("trees", self.seed),
            ground,
            centre=(self.centre[0], self.centre[1]),
            radius=self.radius,
            number=self.number,
            tree=Tree(**{name: getattr(self.tree, name) for name in TreeMeasures.model_fields}),
        )


AnyObject = Annotated[
    Jacksboro
    | RasterGround
    | ArrayGround
    | ImageGround
    | Plane
    | ReliefGround
    | Hills
    | MeshObject
    | Sphere
    | Box
    | Boulders
    | Trees,
    Field(discriminator="kind"),
]


def materials(name: str, thing: Part) -> list[tuple[str, Material]]:
    """Materials of an object with the names of their surfaces, in the order that faces count."""
    if isinstance(thing, Trees):
        return [(f"{name}.leaf", thing.leaf), (f"{name}.trunk", thing.trunk)]
    assert isinstance(thing, Material)
    return [(name, thing)]
