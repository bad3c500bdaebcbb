"""Triangle meshes: whatever trimesh loads, in metres, placed in the scene."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sweep.model.geometry.quaternion import about, multiply, normalise
from sweep.scenes.errors import SceneError, existing
from sweep.scenes.facets import Facets, join
from sweep.units import QuantityError, read_unit

_Y_UP_FORMATS = {".glb", ".gltf"}
"""Formats whose specification makes y the vertical; for the others z is taken to be it."""


@dataclass(frozen=True)
class Placement:
    """Where an object stands.

    Parameters
    ----------
    translation : (3,) sequence of float
        World position of the object's own origin [m].
    rotation : (4,) sequence of float
        Quaternion (w, x, y, z), object to world; scaled to length 1.
    scale : float
        Size factor, > 0, on top of the units.
    """

    translation: Sequence[float] = (0.0, 0.0, 0.0)
    rotation: Sequence[float] = (1.0, 0.0, 0.0, 0.0)
    scale: float = 1.0


IN_PLACE = Placement()


def read_mesh(
    path: str | Path,
    *,
    unit: str | None = None,
    up: str | None = None,
    placement: Placement = IN_PLACE,
) -> Facets:
    """Facets of a mesh file, all its parts.

    Nothing is mended here: degenerate and duplicate faces are dropped, and reported, when the
    scene is put together.

    Parameters
    ----------
    path : str or Path
        The file: STL, OBJ, PLY, glTF and more.
    unit : str, optional
        Unit of its lengths, such as ``mm``; by default the one the file states, or else metres.
    up : str, optional
        Its vertical axis, ``y`` or ``z``; by default y for glTF, as its specification says, and
        z for all else.
    placement : Placement
        Where it stands.

    Raises
    ------
    SceneError
        For a file that is missing, can not be loaded or holds no triangles; or a unit, an axis or
        a placement that is none.
    """
    path = existing(path)
    upwards = up or ("y" if path.suffix.lower() in _Y_UP_FORMATS else "z")
    if upwards not in ("y", "z"):
        raise SceneError(path, f"has '{up}' for its vertical axis", "write 'y' or 'z'")
    scene = _loaded(path)
    parts = [_part(mesh, matrix) for mesh, matrix in _meshes(scene)]
    parts = [part for part in parts if len(part.faces)]
    if not parts:
        raise SceneError(path, "holds no triangles", "export a triangle mesh, not points or curves")
    rotation, scale = _checked(path, placement)
    if upwards == "y":
        rotation = multiply(rotation, about(0, math.pi / 2))
    return join(parts).placed(
        translation=placement.translation,
        rotation=rotation,
        scale=scale * _metres(path, unit or scene.units),
    )


def _loaded(path: Path) -> Any:
    """Scene of a mesh file, nothing merged or mended."""
    import trimesh

    try:
        return trimesh.load_scene(str(path), process=False)
    except ImportError as error:
        remedy = "install what it asks for, or export to OBJ, PLY, STL or glTF"
        raise SceneError(path, f"needs another package ({error})", remedy) from None
    except Exception as error:  # parsers of dozens of formats fail in as many ways
        known = ", ".join(sorted(trimesh.available_formats()))
        raise SceneError(path, f"is no mesh that can be read ({error})", f"use {known}") from None


def _meshes(scene: Any) -> list[tuple[Any, np.ndarray]]:
    """Meshes of a scene with their transforms to its frame; points and curves are passed over."""
    placed = (scene.graph[node] for node in sorted(scene.graph.nodes_geometry))
    named = ((scene.geometry[name], matrix) for matrix, name in placed)
    return [(geometry, matrix) for geometry, matrix in named if hasattr(geometry, "faces")]


def _part(mesh: Any, matrix: np.ndarray) -> Facets:
    """Facets of one mesh of a file, in the file's frame."""
    vertices = np.asarray(mesh.vertices, float) @ matrix[:3, :3].T + matrix[:3, 3]
    faces = np.asarray(mesh.faces, np.int64)
    if np.linalg.det(matrix[:3, :3]) < 0:
        faces = faces[:, ::-1]  # a mirrored part is inside out
    return Facets.of(vertices, faces)


def _checked(path: Path, placement: Placement) -> tuple[np.ndarray, float]:
    """Rotation and scale of a placement, if they are such."""
    try:
        rotation = normalise(np.asarray(placement.rotation, float))
    except ValueError as error:
        raise SceneError(path, f"is turned by no rotation ({error})", "give (w, x, y, z)") from None
    if not (placement.scale > 0 and math.isfinite(placement.scale)):
        raise SceneError(path, f"is scaled by {placement.scale}", "make it a positive number")
    if np.shape(placement.translation) != (3,) or not np.isfinite(placement.translation).all():
        raise SceneError(path, "is placed nowhere", "give three coordinates in metres")
    return rotation, placement.scale


def _metres(path: Path, unit: str | None) -> float:
    """Metres of a unit of length; 1 where none is stated."""
    if unit is None:
        return 1.0
    try:
        return read_unit(unit, si_unit="m", example="mm").to_si(1)  # type: ignore[arg-type]
    except QuantityError as error:
        raise SceneError(path, f"has lengths in '{unit}' ({error})", "state a unit") from None
