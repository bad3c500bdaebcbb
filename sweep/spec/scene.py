"""A scene: meshes and solids, objects on its ground, and the other parts of a study."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple, Self

import numpy as np
from pydantic import Field, model_validator

import sweep.spec.parts as of
from sweep.scenes.files import SceneError
from sweep.spec.flight import Motion, Span, Turn
from sweep.spec.grounds import (
    ArrayGround,
    Ground,
    Hills,
    ImageGround,
    Jacksboro,
    Material,
    PlacedGround,
    Plane,
    RasterGround,
    ReliefGround,
    generator,
)
from sweep.spec.parts import Files, Part
from sweep.spec.rules import broken
from sweep.spec.sections import SPECTRA, sunlight

if TYPE_CHECKING:
    from sweep.model.geometry.mesh import Mesh, Surface
    from sweep.model.geometry.platform import Flight
    from sweep.model.geometry.rays import Caster
    from sweep.scenes.meshes import Facets, Report
    from sweep.scenes.scattered import Law
    from sweep.scenes.terrain import Terrain


Vector = tuple[float, ...]

WORLD = "world"
"""The origin of a scene whose coordinates are as they are."""


class Solid(Material, ABC):
    """An object of its own, at rest or moving.

    One that moves is placed by its path; its rotation is that in the moving body's frame.
    """

    position: Vector | None = of.position(
        "Where its own zero lies; its coordinates as they are", default=None
    )
    rotation: Turn = Turn()
    motion: Motion | None = None

    def facets(self, files: Files) -> Facets:
        """Its facets, turned, about its own zero; a `SceneError` for an unfit file."""
        return self.shape(files).placed(rotation=self.rotation.turn())

    @abstractmethod
    def shape(self, files: Files) -> Facets:
        """Its facets before they are turned."""


class MeshObject(Solid):
    """A mesh from a file."""

    kind: Literal["mesh"]
    file: str = of.file("The mesh: STL, OBJ, PLY, OFF or glTF; polygons are cut into triangles")
    unit: str | None = of.text("Unit of its lengths; the file's own, or m", None)
    up: str | None = of.choice("Its vertical axis; y for glTF, else z", ("y", "z"), None)
    scale: float = of.number("Factor on all lengths", "2", "1e-9", "1e9", default=1.0)

    def shape(self, files: Files) -> Facets:
        """Its facets before they are turned."""
        from sweep.scenes.meshes import read_mesh

        return read_mesh(files.path(self.file), unit=self.unit, up=self.up, scale=self.scale)


class Sphere(Solid):
    """A sphere of triangles whose corners lie on it."""

    kind: Literal["sphere"]
    radius: float = of.size("Radius", "1 m")
    subdivisions: int = of.count(
        "Times that an icosahedron's faces are cut in four", "4", "0", "8", default=4
    )

    def shape(self, files: Files) -> Facets:
        """Its facets about its centre."""
        from sweep.scenes.meshes import sphere

        return sphere(radius=self.radius, subdivisions=self.subdivisions)


class Box(Solid):
    """A box."""

    kind: Literal["box"]
    size: Vector = of.vector("Length along x, y and z", "m", "2 m")

    def shape(self, files: Files) -> Facets:
        """Its facets about its middle."""
        from sweep.scenes.meshes import box

        return box(size=self.size)


class MartianRocks(Part):
    """Rocks of the Martian plains (Golombek and Rapp 1997)."""

    kind: Literal["martian_rocks"]
    abundance: float = of.number("Fraction of the ground under rocks", "5 %", "1e-9", "0.9")

    def law(self) -> Law:
        """Size-frequency law."""
        from sweep.scenes.scattered import MartianRocks

        return MartianRocks(self.abundance)


class PowerLaw(Part):
    """A number per area that falls with a power of the diameter."""

    kind: Literal["power"]
    density: float = of.quantity(
        "Number per area of 1 m or larger", "m^-2", "0.01 m^-2", "1e-12 m^-2", "1e6 m^-2"
    )
    exponent: float = of.number("Exponent", "2.5", "1e-3", "20")

    def law(self) -> Law:
        """Size-frequency law."""
        from sweep.scenes.scattered import PowerLaws

        return PowerLaws(((self.density, self.exponent),))


class Boulders(Material):
    """Half-ellipsoids on a ground."""

    kind: Literal["boulders"]
    on: str = of.name("Ground that they lie on")
    law: Annotated[MartianRocks | PowerLaw, Field(discriminator="kind")]
    smallest: float = of.size("Smallest diameter", "0.5 m")
    largest: float = of.size("Largest diameter", "3 m")
    centre: Vector = of.position("Middle of the square that they lie in", of=2, default=(0.0, 0.0))
    within: float | None = of.size(
        "Side of that square; all of the ground by default", "200 m", default=None
    )
    height_ratio: float = of.number("Height over diameter", "0.5", "1e-6", "10", default=0.5)
    elongation: float = of.number(
        "Largest ratio of long to short axis", "1.5", "1", "10", default=1.5
    )
    subdivisions: int = of.count("Refinement of their shape", "2", "0", "4", default=2)
    seed: int = of.seed()

    def facets(self, ground: Terrain) -> Facets:
        """Their facets on a ground in the scene's frame.

        A ValueError for too many of them, or none of the ground within the square.
        """
        from sweep.scenes.scattered import draw_boulders
        from sweep.scenes.terrain import square

        bounds = None
        if self.within is not None:
            bounds = square(ground, centre=self.centre, size=self.within)
        shape = {"smallest", "largest", "height_ratio", "elongation", "subdivisions"}
        random, law = generator("boulders", self.seed), self.law.law()
        return draw_boulders(random, law, ground, bounds=bounds, **self.model_dump(include=shape))


class TreeMeasures(Part):
    """Mean measures of the trees of a clump."""

    height: float = of.size("From the ground to the top", "12 m", default=12.0)
    crown_diameter: float = of.size("Across", "7 m", default=7.0)
    crown_base: float = of.length("Height of its lower end", "3 m", "0 m", default=3.0)
    trunk_diameter: float = of.size("At the ground", "40 cm", default=0.4)
    leaf_length: float = of.size("Long diagonal of a leaf", "30 cm", default=0.30)
    leaf_width: float = of.size("Short diagonal of a leaf", "20 cm", default=0.20)
    leaf_area_index: float = of.number(
        "One-sided leaf area over that of the outline", "2", "0", "20", default=2.0
    )
    variation: float = of.number(
        "Share by which sizes vary to each side", "0.25", "0", "0.99", default=0.25
    )


class Trees(Part):
    """A clump of broad-leaved trees on a ground, of two materials."""

    kind: Literal["trees"]
    on: str = of.name("Ground that they grow on")
    centre: Vector = of.position("Middle of the clump", of=2, default=(0.0, 0.0))
    radius: float = of.size("Trunks stand within it", "15 m")
    number: int = of.count("Trees", "7", at_most="10000")
    tree: TreeMeasures = TreeMeasures()
    leaf: Material
    trunk: Material
    seed: int = of.seed()

    def facets(self, ground: Terrain) -> Facets:
        """Leaves (surface 0) and trunks (1) on a ground in the scene's frame.

        A ValueError if there is no room for them, or one would stand off the ground.
        """
        from sweep.scenes.scattered import Tree, clump

        return clump(
            generator("trees", self.seed),
            ground,
            centre=(self.centre[0], self.centre[1]),
            radius=self.radius,
            number=self.number,
            tree=Tree(**self.tree.model_dump()),
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


def has_relief(thing: Part) -> bool:
    """Return true for ground that is no plane, and for what stands on it in numbers."""
    if isinstance(thing, Plane):
        return thing.relief is not None or thing.craters is not None
    return isinstance(thing, Ground | Boulders | Trees)


def materials(name: str, thing: Part) -> list[tuple[str, Material]]:
    """Materials of an object with the names of their surfaces, in the order that faces count."""
    if isinstance(thing, Trees):
        return [(f"{name}.leaf", thing.leaf), (f"{name}.trunk", thing.trunk)]
    assert isinstance(thing, Material)
    return [(name, thing)]


class Scene(Part):
    """Scene that the instrument flies over."""

    origin: str = of.name("Ground whose middle is the zero of all positions, or 'world'", WORLD)
    objects: dict[str, AnyObject] = Field(description="What there is, by name")
    solar_irradiance: float = sunlight("scene")


class SceneDraws(Part):
    """Random realisations of the flight's radiometry."""

    number: int = of.count("Draws", "1000", at_most="1e9", default=1)
    method: str = of.choice(
        "Draw against the probabilities, add noise to the bins, or draw whole spectra of each "
        "shot for instrument.processing.detector and .estimator to look at",
        ("probabilities", "noise", SPECTRA),
    )
    returns: int = of.count("Points kept of a shot at most", "4", at_most="64", default=4)

    @property
    def any(self) -> bool:
        """True, as a point cloud has one draw at the least."""
        return True

    @property
    def whole_spectra(self) -> bool:
        """True if a detector and an estimator look at whole spectra."""
        return self.method == SPECTRA


class Navigation(Part):
    """Velocity and altitude from each measurement cycle."""

    test_level: float = of.number(
        "Chance that a test for faulty beams rejects a good cycle; 0 leaves it out",
        "0.001", "0", "0.5", default=0.0,
    )  # fmt: skip
    ground_slope: float = of.number(
        "Standard deviation of the ground's slope, as far as it is known beforehand; 10 leaves "
        "the slope to the points, 0 says that the ground is level",
        "0.1", "0", "10", default=10.0,
    )  # fmt: skip
    relief: float = of.length(
        "Standard deviation of the ground's height about a plane; 0 says that it is a plane",
        "1 m", "0 m", default=0.0,
    )  # fmt: skip
    terrain_slope: float = of.number(
        "Standard deviation of the slope of the surface that a single beam meets, as far as it is "
        "known beforehand: it moves the range unseen while the beam slides, and is in the standard "
        "errors of points",
        "0.1", "0", "10", default=0.2,
    )  # fmt: skip
    target_speed: float = of.quantity(
        "Standard deviation of each component of the velocity of what the beams hit, as far as it "
        "is known beforehand; it is in the standard errors of points",
        "m/s", "10 m/s", "0 m/s", "10 km/s", default=0.0,
    )  # fmt: skip
    target_acceleration: float = of.quantity(
        "Standard deviation of the acceleration of what the beams hit, as far as it is known "
        "beforehand; it is in the standard errors of points",
        "m/s^2", "3 m/s^2", "0 m/s^2", "1000 m/s^2", default=0.0,
    )  # fmt: skip


class ErrorFloor(Part):
    """Standard deviations of an instrument's errors that no echo is strong enough to lower."""

    pointing_error: float = of.angle(
        "Error of each beam's known direction, on each of two axes; the same all flight long, and "
        "independent from beam to beam. Moves points, and velocities by as much of the velocity "
        "across the beam",
        "0.1 mrad", "0 rad", "10 deg", default=0.0,
    )  # fmt: skip
    clock_error: float = of.number(
        "Relative error of the sampling clock, common to all beams: scales ranges and velocities",
        "1e-6", "0", "0.1", default=0.0,
    )  # fmt: skip
    wavelength_error: float = of.number(
        "Relative error of the known wavelength, common to all beams: scales velocities",
        "1e-7", "0", "0.1", default=0.0,
    )  # fmt: skip
    vibration: float = of.quantity(
        "Velocity of the instrument's vibration along the beam, independent from shot to shot",
        "m/s", "1 cm/s", "0 m/s", "1 km/s", default=0.0,
    )  # fmt: skip
    range_noise: float = of.length(
        "Error of ranges, independent from shot to shot", "1 cm", "0 m", "1 km", default=0.0
    )


_CLIPPED = "what lies beyond is clipped and reported as invalid"


class Interface(Part):
    """Reports of the unit as its interface control document states them; no part of the study's id.

    ``sweep export --as reports`` makes them of stored points: nothing is computed anew.
    """

    range_quantum: float | None = of.length(
        "Step in which ranges are reported", "2 mm", "1 nm", "1 km", default=None
    )
    radial_velocity_quantum: float | None = of.quantity(
        "Step in which radial velocities are reported",
        "m/s", "1 mm/s", "1e-9 m/s", "1 km/s", default=None,
    )  # fmt: skip
    min_range: float | None = of.length(
        f"Least range that a report can hold; {_CLIPPED}", "10 m", "0 m", default=None
    )
    max_range: float | None = of.length(
        f"Largest range that a report can hold; {_CLIPPED}", "5 km", "0 m", default=None
    )
    min_radial_velocity: float | None = of.quantity(
        f"Least radial velocity that a report can hold, positive when closing; {_CLIPPED}",
        "m/s", "-60 m/s", default=None,
    )  # fmt: skip
    max_radial_velocity: float | None = of.quantity(
        f"Largest radial velocity that a report can hold, positive when closing; {_CLIPPED}",
        "m/s", "220 m/s", default=None,
    )  # fmt: skip
    rate: float | None = of.quantity(
        "Reports of each beam per second; without it every shot is a report",
        "Hz", "20 Hz", "1e-6 Hz", "1e9 Hz", default=None,
    )  # fmt: skip
    value: str = of.choice(
        "What a report holds of the valid shots in its period: their mean, or the last",
        ("mean", "last"),
    )
    valid_shots: int = of.count(
        "Valid shots in its period that a report needs to be valid", "3", default=1
    )
    latency: float = of.duration(
        "Age of the measurement at the report's time stamp", "40 ms", "0 s", "1e4 s", default=0.0
    )

    @model_validator(mode="after")
    def _whole(self) -> Self:
        """Refuse limits that leave nothing between them, and numbers of shots without a period."""
        for name in ("range", "radial_velocity"):
            low, high = getattr(self, f"min_{name}"), getattr(self, f"max_{name}")
            if low is not None and high is not None and low >= high:
                rule = f"has a min_{name} that is not below its max_{name}"
                raise broken(rule, f"write a lower min_{name}, or leave it out")
        if self.rate is None and self.valid_shots > 1:
            rule = f"wants {self.valid_shots} valid_shots, and without a rate a report is one shot"
            raise broken(rule, "add e.g. 'rate: 20 Hz', or leave valid_shots out")
        return self


class SceneStorage(Part):
    """Division of results in the store; part of a study's identity."""

    block_shots: int = of.count("Shots that one block holds at most", "4096", default=4096)
    block_draws: int = of.count("Draws that one block holds at most", "64", default=64)


# The scene, built: its objects as bodies that rays can be cast at


class World(NamedTuple):
    """Bodies that rays are cast at, in the scene's frame."""

    caster: Caster
    """The bodies: all that rests is the first, if there is any, and each that moves another."""
    surfaces: tuple[Surface, ...]
    """Surfaces by their numbers."""
    bodies: tuple[Flight | None, ...]
    """Motion of each of the caster's bodies; None for one at rest."""
    reports: tuple[str, ...]
    """Report of what loading found and mended, a line an object."""
    origin: np.ndarray
    """(3,): what was subtracted from the objects' own coordinates [m]."""
    warnings: tuple[str, ...] = ()
    """What is doubtful about the scene's files."""


def surfaces_of(scene: Scene) -> tuple[Surface, ...]:
    """Surfaces of a scene in the order of their numbers."""
    from sweep.model.geometry.mesh import Surface

    return tuple(
        Surface(name, material.reflectance, material.reflectance_law)
        for key, thing in scene.objects.items()
        for name, material in materials(key, thing)
    )


def projection_of(scene: Scene, files: Files) -> str:
    """WKT of the map projection of a scene's coordinates [m], or ''.

    It is empty where rasters state none, or several. The scene's origin has to be added to
    coordinates in a store.
    """
    from sweep.scenes.map_projection import projection_in_metres
    from sweep.scenes.rasters import raster_digest

    rasters = [thing for thing in scene.objects.values() if isinstance(thing, RasterGround)]
    projections = {
        projection_in_metres(files.path(thing.file, raster_digest), thing.metres_per_unit)
        for thing in rasters
    }
    return projections.pop() if len(projections) == 1 else ""


def build(scene: Scene, files: Files, span: Span) -> World:
    """Build a scene; a `SceneError` for an unfit file or object.

    An object that stays in place does so for the `span` of the flight [s].
    """
    from sweep.model.geometry.mesh import merge
    from sweep.model.geometry.rays import Caster

    origin, grounds, warnings = _grounds(scene, files)
    resting: list[Mesh] = []
    moving: list[tuple[Mesh, Flight]] = []
    reports = []
    first = 0
    for name, thing in scene.objects.items():
        try:
            mesh, report = _mesh(_facets(name, thing, grounds, origin, files), first)
            motion = thing.motion if isinstance(thing, Solid) else None
            if motion is None:
                resting.append(mesh)
            else:
                moving.append((mesh, motion.flight(files, span)))
        except (ValueError, ArithmeticError) as error:
            raise _unfit(name, error) from None
        del mesh
        reports.append(f"{name}: {report.text()}")
        first += len(materials(name, thing))
    del grounds  # before the trees are built, which take the most memory
    meshes = [merge(resting)] if resting else []
    resting.clear()
    return World(
        Caster([*meshes, *(mesh for mesh, _ in moving)]),
        surfaces_of(scene),
        (*(None for _ in meshes), *(flight for _, flight in moving)),
        tuple(reports),
        origin,
        warnings,
    )


def _mesh(facets: Facets, first: int) -> tuple[Mesh, Report]:
    """Mesh of facets whose surfaces are numbered from `first`, and its report."""
    surface = (facets.surface + first).astype(np.int16)
    return replace(facets, surface=surface).mesh()


def _unfit(name: str, error: Exception) -> SceneError:
    """Mistakes in an object, as users are told it."""
    return SceneError(f"scene.objects.{name}", f"can not be made: {error}", "change it")


def _grounds(scene: Scene, files: Files) -> tuple[np.ndarray, dict[str, Terrain], tuple[str, ...]]:
    """Return the scene's origin, its grounds in the scene's frame, and what is doubtful of them."""
    from sweep.scenes.maps import require_one_map
    from sweep.scenes.tiles import join_tiles

    things = {name: thing for name, thing in scene.objects.items() if isinstance(thing, Ground)}
    own: dict[str, Terrain] = {}
    for name, thing in things.items():
        try:
            own[name] = thing.survey(files)
        except (ValueError, ArithmeticError) as error:
            raise _unfit(name, error) from None
    map_frames = [
        (name, terrain.map_frame) for name, terrain in own.items() if terrain.map_frame is not None
    ]
    require_one_map(map_frames)
    unnamed = [name for name, map_frame in map_frames if not map_frame.wkt]
    joined, warnings = join_tiles({name: own[name] for name, _ in map_frames})
    if 0 < len(unnamed) < len(map_frames):
        warnings += [
            f"scene.objects.{name}: names no coordinate reference system, and is taken to lie on "
            "the map of the other rasters"
            for name in unnamed
        ]
    for name, terrain in (own | joined).items():
        warnings += [f"scene.objects.{name}: {warning}" for warning in terrain.warnings]
        try:
            own[name] = things[name].shaped(terrain)
        except (ValueError, ArithmeticError) as error:
            raise _unfit(name, error) from None
    origin = np.zeros(3)
    if scene.origin in own:
        origin = own[scene.origin].centre
        if not np.isfinite(origin).all():
            raise SceneError(
                f"scene.objects.{scene.origin}",
                "has a hole in its middle, which the scene's origin should be",
                "take another origin, or 'world'",
            )
    grounds = {}
    for name, terrain in own.items():
        # One without coordinates of its own stands where its position says, beside the origin.
        beside = isinstance(scene.objects[name], PlacedGround) and name != scene.origin
        shift = 0.0 if beside else origin
        grounds[name] = replace(terrain, origin=terrain.origin - shift)
    return origin, grounds, tuple(warnings)


def _facets(
    name: str, thing: Any, grounds: Mapping[str, Terrain], origin: np.ndarray, files: Files
) -> Facets:
    """Facets of an object in the scene's frame; of one that moves, in its own."""
    if isinstance(thing, Ground):
        return grounds[name].facets()
    if isinstance(thing, Boulders | Trees):
        return thing.facets(grounds[thing.on])
    facets = thing.facets(files)
    if thing.motion is not None:
        return facets
    place = -origin if thing.position is None else np.asarray(thing.position)
    return replace(facets, origin=facets.origin + place)
