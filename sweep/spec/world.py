"""A scene, built: its objects as bodies that rays can be cast at."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from sweep.model.geometry.mesh import Mesh, Surface, merge
from sweep.model.geometry.platform import Flight
from sweep.model.geometry.rays import Caster
from sweep.scenes.files import SceneError
from sweep.scenes.meshes import Facets
from sweep.scenes.terrain import Terrain
from sweep.spec.flight import Span
from sweep.spec.grounds import Ground, PlacedGround
from sweep.spec.parts import Files
from sweep.spec.scene import Boulders, Scene, Solid, Trees, materials


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


def surfaces_of(scene: Scene) -> tuple[Surface, ...]:
    """Surfaces of a scene in the order of their numbers."""
    return tuple(
        Surface(name, material.reflectance, material.reflectance_law)
        for key, thing in scene.objects.items()
        for name, material in materials(key, thing)
    )


def build(scene: Scene, files: Files, span: Span) -> World:
    """Build a scene.

    Parameters
    ----------
    scene : Scene
        Objects, their surfaces and motions.
    files : Files
        Where its files are.
    span : (start, stop) of float
        Time of the flight [s], which the path of an object that stays in place lasts.

    Raises
    ------
    SceneError
        For a file that is missing, changed or unfit; or an object that can not be made.
    """
    origin, grounds = _grounds(scene, files)
    resting: list[Mesh] = []
    moving: list[tuple[Mesh, Flight]] = []
    reports = []
    first = 0
    for name, thing in scene.objects.items():
        try:
            facets = _facets(name, thing, grounds, origin, files)
            surface = (facets.surface + first).astype(np.int16)
            mesh, report = replace(facets, surface=surface).mesh()
            motion = thing.motion if isinstance(thing, Solid) else None
            if motion is None:
                resting.append(mesh)
            else:
                moving.append((mesh, motion.flight(files, span)))
        except (ValueError, ArithmeticError) as error:
            raise _unfit(name, error) from None
        reports.append(f"{name}: {report.text()}")
        first += len(materials(name, thing))
    meshes = [merge(resting)] if resting else []
    return World(
        Caster([*meshes, *(mesh for mesh, _ in moving)]),
        surfaces_of(scene),
        (*(None for _ in meshes), *(flight for _, flight in moving)),
        tuple(reports),
        origin,
    )


def _unfit(name: str, error: Exception) -> SceneError:
    """Mistakes in an object, as users are told it."""
    return SceneError(f"scene.objects.{name}", f"can not be made: {error}", "change it")


def _grounds(scene: Scene, files: Files) -> tuple[np.ndarray, dict[str, Terrain]]:
    """Return the scene's origin, and its grounds in the scene's frame."""
    own: dict[str, Terrain] = {}
    for name, thing in scene.objects.items():
        if isinstance(thing, Ground):
            try:
                own[name] = thing.terrain(files)
            except (ValueError, ArithmeticError) as error:
                raise _unfit(name, error) from None
    origin = np.zeros(3)
    if scene.origin in own:
        origin = _middle(scene.origin, own[scene.origin])
    grounds = {}
    for name, terrain in own.items():
        # One without coordinates of its own stands where its position says, beside the origin.
        beside = isinstance(scene.objects[name], PlacedGround) and name != scene.origin
        shift = 0.0 if beside else origin
        grounds[name] = replace(terrain, origin=terrain.origin - shift)
    return origin, grounds


def _middle(name: str, terrain: Terrain) -> np.ndarray:
    """Middle of a ground, on it."""
    centre = terrain.centre
    if not np.isfinite(centre).all():
        raise SceneError(
            f"scene.objects.{name}",
            "has a hole in its middle, which the scene's origin should be",
            "take another origin, or 'world'",
        )
    return centre


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
