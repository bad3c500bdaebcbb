"""Sections of a spec for scenes: objects, draws, navigation, error floor, interface and storage.

`build_scene` turns the section ``scene`` into bodies at which rays can be cast.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple, Self

import numpy as np
from pydantic import Field, model_validator

import sweep.spec.fields as declare
from sweep.scenes.scene_files import SceneError
from sweep.spec.fields import SpecFiles, SpecSection, Vector
from sweep.spec.flight_sections import Orientation, RigidMotion, TimeSpan
from sweep.spec.ground_sections import (
    ArrayGround,
    Ground,
    HillsGround,
    ImageGround,
    JacksboroGround,
    Material,
    PlacedGround,
    PlaneGround,
    RasterGround,
    ReliefGround,
    random_generator,
)
from sweep.spec.rules import rule_error
from sweep.spec.sections import SPECTRA_METHOD, sunlight_field

if TYPE_CHECKING:
    from sweep.model.geometry.body_motion import MovingBody
    from sweep.model.geometry.mesh import Mesh, SurfaceMaterial
    from sweep.model.geometry.ray_casting import RayCaster
    from sweep.scenes.meshes import CleanedMesh, Facets
    from sweep.scenes.scattered_objects import SizeFrequencyLaw
    from sweep.scenes.terrain import Terrain


WORLD_ORIGIN_KEYWORD = "world"
"""Value of ``scene.origin`` for which the coordinates of objects are used without a shift."""


class SolidObject(Material, ABC):
    """Base of solid objects, at rest or in motion.

    The path of a moving object determines its position; its rotation is relative to the moving
    body's frame.
    """

    position: Vector | None = declare.position_field(
        "Position of the object's own origin; by default its coordinates stay as they are",
        default=None,
    )
    rotation: Orientation = Orientation()
    motion: RigidMotion | None = None

    def build_facets(self, files: SpecFiles) -> Facets:
        """Return the facets of the object after its rotation, relative to its own origin [m].

        Raises
        ------
        SceneError
            If the object's file is unsuitable.
        """
        return self.unrotated_facets(files).transform(rotation=self.rotation.to_quaternion())

    @abstractmethod
    def unrotated_facets(self, files: SpecFiles) -> Facets:
        """Return the facets of the object without its rotation, relative to its own origin [m]."""


class MeshObject(SolidObject):
    """Mesh from a file."""

    kind: Literal["mesh"]
    file: str = declare.file_path_field(
        "The mesh: STL, OBJ, PLY, OFF or glTF; polygons are cut into triangles"
    )
    unit: str | None = declare.text_field(
        "Unit of the file's lengths; by default the unit that the file states, or m", None
    )
    up: str | None = declare.choice_field(
        "Vertical axis of the file; by default y for glTF, else z", ("y", "z"), None
    )
    scale: float = declare.number_field("Factor on all lengths", "2", "1e-9", "1e9", default=1.0)

    def unrotated_facets(self, files: SpecFiles) -> Facets:
        """Return the facets in the file, converted to metres, without the object's rotation."""
        from sweep.scenes.meshes import read_mesh_facets

        return read_mesh_facets(
            files.resolve(self.file), unit=self.unit, up=self.up, scale=self.scale
        )


class Sphere(SolidObject):
    """Sphere of triangles whose vertices lie on its surface."""

    kind: Literal["sphere"]
    radius: float = declare.positive_length_field("Radius", "1 m")
    subdivisions: int = declare.integer_field(
        "Number of times that each face of an icosahedron is divided into four",
        "4",
        "0",
        "8",
        default=4,
    )

    def unrotated_facets(self, files: SpecFiles) -> Facets:
        """Return the facets of the sphere relative to its centre [m]."""
        from sweep.scenes.meshes import sphere_facets

        return sphere_facets(radius=self.radius, subdivisions=self.subdivisions)


class Box(SolidObject):
    """Box with given side lengths."""

    kind: Literal["box"]
    size: Vector = declare.vector_field("Length along x, y and z", "m", "2 m")

    def unrotated_facets(self, files: SpecFiles) -> Facets:
        """Return the facets of the box relative to its centre, without the box's rotation [m]."""
        from sweep.scenes.meshes import box_facets

        return box_facets(size=self.size)


class MartianRocks(SpecSection):
    """Size-frequency law of rocks on the Martian plains (Golombek and Rapp 1997)."""

    kind: Literal["martian_rocks"]
    abundance: float = declare.number_field(
        "Fraction of the ground under rocks", "5 %", "1e-9", "0.9"
    )

    def size_frequency_law(self) -> SizeFrequencyLaw:
        """Return Golombek and Rapp's law (1997) for the number of rocks per area by diameter."""
        from sweep.scenes.scattered_objects import MartianRockLaw

        return MartianRockLaw(self.abundance)


class PowerLaw(SpecSection):
    """Size-frequency law whose number per area falls with a power of the diameter."""

    kind: Literal["power"]
    density: float = declare.quantity_field(
        "Number per area of 1 m or larger", "m^-2", "0.01 m^-2", "1e-12 m^-2", "1e6 m^-2"
    )
    exponent: float = declare.number_field("Exponent", "2.5", "1e-3", "20")

    def size_frequency_law(self) -> SizeFrequencyLaw:
        """Return the power law for the number of boulders per area by diameter."""
        from sweep.scenes.scattered_objects import MinimumOfPowerLaws

        return MinimumOfPowerLaws(((self.density, self.exponent),))


class Boulders(Material):
    """Half-ellipsoids on a ground, with random positions and sizes."""

    kind: Literal["boulders"]
    on: str = declare.object_name_field("Ground on which the boulders lie")
    law: Annotated[MartianRocks | PowerLaw, Field(discriminator="kind")]
    smallest: float = declare.positive_length_field("Smallest diameter", "0.5 m")
    largest: float = declare.positive_length_field("Largest diameter", "3 m")
    centre: Vector = declare.position_field(
        "Middle of the square in which the boulders lie", dimensions=2, default=(0.0, 0.0)
    )
    within: float | None = declare.positive_length_field(
        "Side of that square; all of the ground by default", "200 m", default=None
    )
    height_ratio: float = declare.number_field(
        "Height over diameter", "0.5", "1e-6", "10", default=0.5
    )
    elongation: float = declare.number_field(
        "Largest ratio of long to short axis", "1.5", "1", "10", default=1.5
    )
    subdivisions: int = declare.integer_field(
        "Number of times that the triangles of a boulder are divided into four",
        "2",
        "0",
        "4",
        default=2,
    )
    seed: int = declare.seed_field()

    def build_facets(self, ground: Terrain) -> Facets:
        """Draw boulders at random on a ground; return their facets in the scene's frame.

        Parameters
        ----------
        ground : Terrain
            Ground in the scene's frame.

        Raises
        ------
        ValueError
            If there are too many boulders, or the square contains no ground.
        """
        from sweep.scenes.scattered_objects import draw_boulders
        from sweep.scenes.terrain import clipped_square_bounds

        bounds = None
        if self.within is not None:
            bounds = clipped_square_bounds(ground, centre=self.centre, size=self.within)
        field_names = {"smallest", "largest", "height_ratio", "elongation", "subdivisions"}
        rng, law = random_generator("boulders", self.seed), self.law.size_frequency_law()
        return draw_boulders(
            rng, law, ground, bounds=bounds, **self.model_dump(include=field_names)
        )


class TreeDimensions(SpecSection):
    """Mean dimensions of the trees of a clump."""

    height: float = declare.positive_length_field(
        "Height from the ground to the top", "12 m", default=12.0
    )
    crown_diameter: float = declare.positive_length_field(
        "Diameter of the crown", "7 m", default=7.0
    )
    crown_base: float = declare.length_field(
        "Height of the crown's lower end", "3 m", "0 m", default=3.0
    )
    trunk_diameter: float = declare.positive_length_field(
        "Diameter of the trunk at the ground", "40 cm", default=0.4
    )
    leaf_length: float = declare.positive_length_field(
        "Long diagonal of a leaf", "30 cm", default=0.30
    )
    leaf_width: float = declare.positive_length_field(
        "Short diagonal of a leaf", "20 cm", default=0.20
    )
    leaf_area_index: float = declare.number_field(
        "One-sided leaf area over that of the outline", "2", "0", "20", default=2.0
    )
    variation: float = declare.number_field(
        "Fraction by which sizes vary to either side", "0.25", "0", "0.99", default=0.25
    )


class Trees(SpecSection):
    """Clump of broad-leaved trees on a ground, with materials for leaves and trunks."""

    kind: Literal["trees"]
    on: str = declare.object_name_field("Ground on which the trees grow")
    centre: Vector = declare.position_field("Middle of the clump", dimensions=2, default=(0.0, 0.0))
    radius: float = declare.positive_length_field(
        "Radius of the circle in which trunks stand", "15 m"
    )
    number: int = declare.integer_field("Trees", "7", at_most="10000")
    tree: TreeDimensions = TreeDimensions()
    leaf: Material
    trunk: Material
    seed: int = declare.seed_field()

    def build_facets(self, ground: Terrain) -> Facets:
        """Draw trees at random on a ground; return their facets in the scene's frame.

        Parameters
        ----------
        ground : Terrain
            Ground in the scene's frame.

        Returns
        -------
        Facets
            Facets of the leaves (surface 0) and of the trunks (surface 1).

        Raises
        ------
        ValueError
            If the trees do not fit into the clump, or a tree would stand off the ground.
        """
        from sweep.scenes.scattered_objects import MeanTreeDimensions, draw_tree_clump

        return draw_tree_clump(
            random_generator("trees", self.seed),
            ground,
            centre=(self.centre[0], self.centre[1]),
            radius=self.radius,
            number=self.number,
            tree=MeanTreeDimensions(**self.tree.model_dump()),
        )


AnySceneObject = Annotated[
    JacksboroGround
    | RasterGround
    | ArrayGround
    | ImageGround
    | PlaneGround
    | ReliefGround
    | HillsGround
    | MeshObject
    | Sphere
    | Box
    | Boulders
    | Trees,
    Field(discriminator="kind"),
]


def has_relief(scene_object: SpecSection) -> bool:
    """Return True if a scene's object is boulders, trees, or ground other than a smooth plane."""
    if isinstance(scene_object, PlaneGround):
        return scene_object.relief is not None or scene_object.craters is not None
    return isinstance(scene_object, Ground | Boulders | Trees)


def surface_names_and_materials(name: str, scene_object: SpecSection) -> list[tuple[str, Material]]:
    """Return a pair (name, material) per surface of an object, in the order of surface numbers.

    `name` is the object's name, with which the names of its surfaces begin.
    """
    if isinstance(scene_object, Trees):
        return [(f"{name}.leaf", scene_object.leaf), (f"{name}.trunk", scene_object.trunk)]
    assert isinstance(scene_object, Material)
    return [(name, scene_object)]


class Scene(SpecSection):
    """Objects below the instrument, and the sunlight on them."""

    origin: str = declare.object_name_field(
        "Ground whose middle is the zero of all positions, or 'world'", WORLD_ORIGIN_KEYWORD
    )
    objects: dict[str, AnySceneObject] = Field(description="Objects of the scene, by name")
    solar_irradiance: float = sunlight_field("scene")


class SceneDraws(SpecSection):
    """Random realisations of the flight's radiometry."""

    number: int = declare.integer_field("Draws", "1000", at_most="1e9", default=1)
    method: str = declare.choice_field(
        "Draw against the probabilities, add noise to the bins, or draw whole spectra of each "
        "shot for instrument.processing.detector and .estimator to examine",
        ("probabilities", "noise", SPECTRA_METHOD),
    )
    returns: int = declare.integer_field(
        "Largest number of points kept of a shot", "4", at_most="64", default=4
    )

    @property
    def has_draws(self) -> bool:
        """Always True: a point cloud has at least one draw."""
        return True

    @property
    def draws_whole_spectra(self) -> bool:
        """True if each draw is a whole spectrum, which a detector and an estimator examine."""
        return self.method == SPECTRA_METHOD


class Navigation(SpecSection):
    """Estimation of velocity and altitude from each measurement cycle."""

    test_level: float = declare.number_field(
        "Chance that a test for faulty beams rejects a good cycle; 0 leaves it out",
        "0.001", "0", "0.5", default=0.0,
    )  # fmt: skip
    ground_slope: float = declare.number_field(
        "Prior standard deviation of the ground's slope (height over distance): 0 means that the "
        "ground is level, 10 that only the points tell its slope",
        "0.1", "0", "10", default=10.0,
    )  # fmt: skip
    relief: float = declare.length_field(
        "Standard deviation of the ground's height about a plane; 0 says that it is a plane",
        "1 m", "0 m", default=0.0,
    )  # fmt: skip
    terrain_slope: float = declare.number_field(
        "Standard deviation of the slope of the surface that a single beam meets, as far as it is "
        "known beforehand: it moves the range unseen while the beam slides, and is in the standard "
        "errors of points",
        "0.1", "0", "10", default=0.2,
    )  # fmt: skip
    target_speed: float = declare.quantity_field(
        "Standard deviation of each component of the velocity of what the beams hit, as far as it "
        "is known beforehand; it is in the standard errors of points",
        "m/s", "10 m/s", "0 m/s", "10 km/s", default=0.0,
    )  # fmt: skip
    target_acceleration: float = declare.quantity_field(
        "Standard deviation of the acceleration of what the beams hit, as far as it is known "
        "beforehand; it is in the standard errors of points",
        "m/s^2", "3 m/s^2", "0 m/s^2", "1000 m/s^2", default=0.0,
    )  # fmt: skip


class ErrorFloorSection(SpecSection):
    """Standard deviations of instrument errors that do not decrease with signal strength."""

    pointing_error: float = declare.angle_field(
        "Error of each beam's known direction, on each of two axes; the same all flight long, and "
        "independent from beam to beam. Moves points, and velocities by as much of the velocity "
        "across the beam",
        "0.1 mrad", "0 rad", "10 deg", default=0.0,
    )  # fmt: skip
    clock_error: float = declare.number_field(
        "Relative error of the sampling clock, common to all beams: scales ranges and velocities",
        "1e-6", "0", "0.1", default=0.0,
    )  # fmt: skip
    wavelength_error: float = declare.number_field(
        "Relative error of the known wavelength, common to all beams: scales velocities",
        "1e-7", "0", "0.1", default=0.0,
    )  # fmt: skip
    vibration: float = declare.quantity_field(
        "Velocity of the instrument's vibration along the beam, independent from shot to shot",
        "m/s", "1 cm/s", "0 m/s", "1 km/s", default=0.0,
    )  # fmt: skip
    range_noise: float = declare.length_field(
        "Error of ranges, independent from shot to shot", "1 cm", "0 m", "1 km", default=0.0
    )


_CLIPPING_NOTE = "what lies beyond is clipped and reported as invalid"


class Interface(SpecSection):
    """Reports of the unit according to its interface control document.

    The section is no part of the study's identity.

    ``sweep export --as reports`` makes reports from stored points, without a new simulation.
    """

    range_quantum: float | None = declare.length_field(
        "Step in which ranges are reported", "2 mm", "1 nm", "1 km", default=None
    )
    radial_velocity_quantum: float | None = declare.quantity_field(
        "Step in which radial velocities are reported",
        "m/s", "1 mm/s", "1e-9 m/s", "1 km/s", default=None,
    )  # fmt: skip
    min_range: float | None = declare.length_field(
        f"Smallest range that a report can hold; {_CLIPPING_NOTE}", "10 m", "0 m", default=None
    )
    max_range: float | None = declare.length_field(
        f"Largest range that a report can hold; {_CLIPPING_NOTE}", "5 km", "0 m", default=None
    )
    min_radial_velocity: float | None = declare.quantity_field(
        f"Smallest radial velocity that a report can hold, positive when closing; {_CLIPPING_NOTE}",
        "m/s", "-60 m/s", default=None,
    )  # fmt: skip
    max_radial_velocity: float | None = declare.quantity_field(
        f"Largest radial velocity that a report can hold, positive when closing; {_CLIPPING_NOTE}",
        "m/s", "220 m/s", default=None,
    )  # fmt: skip
    rate: float | None = declare.quantity_field(
        "Reports of each beam per second; without it every shot is a report",
        "Hz", "20 Hz", "1e-6 Hz", "1e9 Hz", default=None,
    )  # fmt: skip
    value: str = declare.choice_field(
        "Value of a report: the mean of the valid shots in its period, or the last of them",
        ("mean", "last"),
    )
    valid_shots: int = declare.integer_field(
        "Valid shots in its period that a report needs to be valid", "3", default=1
    )
    latency: float = declare.duration_field(
        "Age of the measurement at the report's time stamp", "40 ms", "0 s", "1e4 s", default=0.0
    )

    @model_validator(mode="after")
    def _check_limits_and_rate(self) -> Self:
        """Raise a pydantic error if a lower limit is not below its upper one, or a rate is missing.

        A report that needs more than one valid shot needs a rate.
        """
        for name in ("range", "radial_velocity"):
            low, high = getattr(self, f"min_{name}"), getattr(self, f"max_{name}")
            if low is not None and high is not None and low >= high:
                problem = f"has a min_{name} that is not below its max_{name}"
                raise rule_error(problem, f"write a lower min_{name}, or leave it out")
        if self.rate is None and self.valid_shots > 1:
            problem = (
                f"wants {self.valid_shots} valid_shots, and without a rate a report is one shot"
            )
            raise rule_error(problem, "add e.g. 'rate: 20 Hz', or leave valid_shots out")
        return self


class SceneStorage(SpecSection):
    """Division of results into blocks in the store; part of a study's identity."""

    block_shots: int = declare.integer_field(
        "Largest number of shots in a block; blocks have fewer if this and block_draws have their "
        "defaults and so many take long",
        "4096", default=4096,
    )  # fmt: skip
    block_draws: int = declare.integer_field(
        "Largest number of draws in a block; up to 128 if this and block_shots have their defaults",
        "64", default=64,
    )  # fmt: skip


# The built scene: objects as bodies at which rays can be cast


class BuiltScene(NamedTuple):
    """Scene as bodies at which rays can be cast, in the scene's frame."""

    caster: RayCaster
    """Object that computes where rays hit the bodies.

    All objects at rest together are the first body, if there are any. Each moving object is one of
    the following bodies.
    """
    surface_materials: tuple[SurfaceMaterial, ...]
    """Materials of all surfaces; the index is the surface's number."""
    body_motions: tuple[MovingBody | None, ...]
    """Motion of each body of `caster`; None for the body of all objects at rest."""
    mesh_reports: tuple[str, ...]
    """One text per object: the size of its mesh, and repairs that were made when it was loaded."""
    origin: np.ndarray
    """Scene's origin (3,) in the coordinates of its objects, from which it was subtracted [m]."""
    warnings: tuple[str, ...] = ()
    """Warnings for the user about the scene's files, one sentence each."""


def scene_surface_materials(scene: Scene) -> tuple[SurfaceMaterial, ...]:
    """Return the materials of all surfaces of a scene; the index is the surface's number."""
    from sweep.model.geometry.mesh import SurfaceMaterial

    return tuple(
        SurfaceMaterial(name, material.reflectance, material.reflectance_law)
        for key, scene_object in scene.objects.items()
        for name, material in surface_names_and_materials(key, scene_object)
    )


def scene_projection_wkt(scene: Scene, files: SpecFiles) -> str:
    """Return the map projection of a scene's coordinates as well-known text (WKT).

    Parameters
    ----------
    scene : Scene
        Section ``scene`` of the spec.
    files : SpecFiles
        Files that the spec names.

    Returns
    -------
    str
        WKT; empty if the scene's rasters state no projection, or different ones.
    """
    from sweep.scenes.map_projection import metric_projection_wkt
    from sweep.scenes.rasters import raster_digest

    rasters = [
        scene_object
        for scene_object in scene.objects.values()
        if isinstance(scene_object, RasterGround)
    ]
    projections = {
        metric_projection_wkt(
            files.resolve(scene_object.file, raster_digest), scene_object.metres_per_unit
        )
        for scene_object in rasters
    }
    return projections.pop() if len(projections) == 1 else ""


def build_scene(scene: Scene, files: SpecFiles, span: TimeSpan) -> BuiltScene:
    """Return a scene's bodies, at which rays can be cast, with their surfaces and motions.

    Parameters
    ----------
    scene : Scene
        Section ``scene`` of the spec.
    files : SpecFiles
        Files that the spec names.
    span : (float, float)
        Start and stop of the flight [s], for moving objects without a duration.

    Returns
    -------
    BuiltScene
        Bodies, surfaces, motions and reports.

    Raises
    ------
    SceneError
        If a file or an object is unsuitable.
    """
    from sweep.model.geometry.mesh import merge_meshes
    from sweep.model.geometry.ray_casting import RayCaster

    origin, grounds, warnings = _build_grounds(scene, files)
    resting_meshes: list[Mesh] = []
    moving_meshes: list[tuple[Mesh, MovingBody]] = []
    reports = []
    first_surface = 0
    for name, scene_object in scene.objects.items():
        try:
            mesh, report = _build_mesh(
                _build_object_facets(name, scene_object, grounds, origin, files), first_surface
            )
            motion = scene_object.motion if isinstance(scene_object, SolidObject) else None
            if motion is None:
                resting_meshes.append(mesh)
            else:
                moving_meshes.append((mesh, motion.build_moving_body(files, span)))
        except (ValueError, ArithmeticError) as error:
            raise _object_error(name, error) from None
        del mesh
        reports.append(f"{name}: {report.summary()}")
        first_surface += len(surface_names_and_materials(name, scene_object))
    del grounds  # free the grids before the ray caster builds its trees, which need the most memory
    merged_meshes = [merge_meshes(resting_meshes)] if resting_meshes else []
    resting_meshes.clear()
    return BuiltScene(
        RayCaster([*merged_meshes, *(mesh for mesh, _ in moving_meshes)]),
        scene_surface_materials(scene),
        (*(None for _ in merged_meshes), *(flight for _, flight in moving_meshes)),
        tuple(reports),
        origin,
        warnings,
    )


def _build_mesh(facets: Facets, first_surface: int) -> CleanedMesh:
    """Return the mesh of facets with a report of repairs; its surfaces start at `first_surface`."""
    surface = (facets.surface + first_surface).astype(np.int16)
    return replace(facets, surface=surface).to_cleaned_mesh()


def _object_error(name: str, error: Exception) -> SceneError:
    """Return a `SceneError` for the object `name` that can't be built because of `error`."""
    return SceneError(f"scene.objects.{name}", f"can not be made: {error}", "change it")


def _build_grounds(
    scene: Scene, files: SpecFiles
) -> tuple[np.ndarray, dict[str, Terrain], tuple[str, ...]]:
    """Return the scene's origin (3,) [m], terrains in the scene's frame by name, and warnings."""
    from sweep.scenes.map_frames import require_same_map
    from sweep.scenes.tiles import extend_tiles_to_neighbours

    ground_sections = {
        name: ground_section
        for name, ground_section in scene.objects.items()
        if isinstance(ground_section, Ground)
    }
    terrains: dict[str, Terrain] = {}
    for name, ground_section in ground_sections.items():
        try:
            terrains[name] = ground_section.unprocessed_terrain(files)
        except (ValueError, ArithmeticError) as error:
            raise _object_error(name, error) from None
    map_frames = [
        (name, terrain.map_frame)
        for name, terrain in terrains.items()
        if terrain.map_frame is not None
    ]
    require_same_map(map_frames)
    names_without_crs = [name for name, map_frame in map_frames if not map_frame.wkt]
    joined_terrains, warnings = extend_tiles_to_neighbours(
        {name: terrains[name] for name, _ in map_frames}
    )
    if 0 < len(names_without_crs) < len(map_frames):
        warnings += [
            f"scene.objects.{name}: names no coordinate reference system, and is taken to lie on "
            "the map of the other rasters"
            for name in names_without_crs
        ]
    for name, terrain in (terrains | joined_terrains).items():
        warnings += [f"scene.objects.{name}: {warning}" for warning in terrain.warnings]
        try:
            terrains[name] = ground_sections[name].process_terrain(terrain)
        except (ValueError, ArithmeticError) as error:
            raise _object_error(name, error) from None
    origin = np.zeros(3)
    if scene.origin in terrains:
        origin = terrains[scene.origin].centre
        if not np.isfinite(origin).all():
            raise SceneError(
                f"scene.objects.{scene.origin}",
                "has a hole in its middle, which the scene's origin should be",
                "take another origin, or 'world'",
            )
    grounds = {}
    for name, terrain in terrains.items():
        # A ground without coordinates has its position in the scene's frame already.
        is_placed_in_scene = isinstance(scene.objects[name], PlacedGround) and name != scene.origin
        shift = 0.0 if is_placed_in_scene else origin
        grounds[name] = replace(terrain, origin=terrain.origin - shift)
    return origin, grounds, tuple(warnings)


def _build_object_facets(
    name: str,
    scene_object: Any,
    grounds: Mapping[str, Terrain],
    origin: np.ndarray,
    files: SpecFiles,
) -> Facets:
    """Return an object's facets in the scene's frame, or in the object's frame if it moves."""
    if isinstance(scene_object, Ground):
        return grounds[name].to_facets()
    if isinstance(scene_object, Boulders | Trees):
        return scene_object.build_facets(grounds[scene_object.on])
    facets = scene_object.build_facets(files)
    if scene_object.motion is not None:
        return facets
    position = -origin if scene_object.position is None else np.asarray(scene_object.position)
    return replace(facets, origin=facets.origin + position)
