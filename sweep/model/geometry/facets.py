"""Triangles with a surface each, relative to an origin: what every part of a scene is made of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sweep.model.geometry.mesh import Mesh, Report, clean
from sweep.model.geometry.quaternion import rotate


@dataclass(frozen=True, eq=False)
class Facets:
    """A soup of triangles.

    Parameters
    ----------
    vertices : (n, 3) float64 ndarray
        Positions relative to `origin` [m].
    faces : (m, 3) int64 ndarray
        Rows of `vertices`, counter-clockwise as seen from outside (or above).
    surface : (m,) int16 ndarray
        Index of each face's surface in the scene's list.
    origin : (3,) float64 ndarray
        World position of the zero of `vertices` [m]. Terrain lies millions of metres from the
        zero of its map; a vertex that is kept apart from that offset loses no digits to it.
    """

    vertices: np.ndarray
    faces: np.ndarray
    surface: np.ndarray
    origin: np.ndarray

    @classmethod
    def of(
        cls,
        vertices: np.ndarray,
        faces: np.ndarray,
        *,
        surface: int = 0,
        origin: Sequence[float] | np.ndarray = (0.0, 0.0, 0.0),
    ) -> Facets:
        """Facets that share one surface."""
        faces = np.asarray(faces, np.int64).reshape(-1, 3)
        return cls(
            np.asarray(vertices, float).reshape(-1, 3),
            faces,
            np.full(len(faces), surface, np.int16),
            np.asarray(origin, float),
        )

    @property
    def world(self) -> np.ndarray:
        """Vertices in the world frame [m], (n, 3); rounded to a float64 of that size."""
        return self.vertices + self.origin

    def placed(
        self,
        *,
        translation: Sequence[float] | np.ndarray = (0.0, 0.0, 0.0),
        rotation: Sequence[float] | np.ndarray = (1.0, 0.0, 0.0, 0.0),
        scale: float = 1.0,
    ) -> Facets:
        """Facets scaled and turned about their origin, which is then moved.

        Parameters
        ----------
        translation : (3,) array_like
            Added to the origin [m].
        rotation : (4,) array_like
            Unit quaternion (w, x, y, z).
        scale : float
            Size factor, > 0.
        """
        turned = rotate(np.asarray(rotation, float), self.vertices * scale)
        return replace(self, vertices=turned, origin=self.origin + np.asarray(translation, float))

    def mesh(self) -> tuple[Mesh, Report]:
        """Mesh fit to be cast at, in the world frame, and what was done to make it so."""
        mesh, report = clean(self.vertices, self.faces, self.surface)
        return replace(mesh, origin=mesh.origin + self.origin), report


def join(parts: Sequence[Facets]) -> Facets:
    """All parts as one, relative to the first one's origin.

    Raises
    ------
    ValueError
        Where there are no parts.
    """
    if not parts:
        raise ValueError("no facets to join")
    origin = parts[0].origin
    shifts = np.cumsum([0, *(len(part.vertices) for part in parts)])[:-1]
    return Facets(
        np.concatenate([part.vertices + (part.origin - origin) for part in parts]),
        np.concatenate([part.faces + shift for part, shift in zip(parts, shifts, strict=True)]),
        np.concatenate([part.surface for part in parts]),
        origin,
    )
