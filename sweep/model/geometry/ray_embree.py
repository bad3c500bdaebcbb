"""Embree's guess at the triangle each ray hits: fast, and right but for float32.

A guess off by a facet shows in float64 (`ray_triangle.check_guesses`). What cannot show is a
surface that Embree passed by: where a silhouette stands within float32's resolution of the ray
(1e-7 of the mesh's size), the surface behind it may be what is found.
"""

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from sweep.model.geometry.mesh import Mesh


class Guesser:
    """Embree's scene of one mesh, in robust mode (the default one loses rays at vertices)."""

    def __init__(self, mesh: Mesh):
        self._scene = EmbreeScene(robust=True)
        TriangleMesh(self._scene, mesh.vertices.astype(np.float32), mesh.faces)
        self._radius = float(np.linalg.norm(mesh.vertices, axis=1).max())

    def guess(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Triangle that each ray may hit nearest, (n,) int32; -1 for none.

        Parameters
        ----------
        origins, directions : (n, 3) float64
            In the mesh's frame.
        """
        # From far away float32 has no digits left: first go along the ray to the mesh's sphere.
        ahead = -np.einsum("ij,ij->i", origins, directions) - 1.01 * self._radius
        near = origins + np.maximum(ahead, 0.0)[:, None] * directions
        return np.asarray(self._scene.run(near.astype(np.float32), directions.astype(np.float32)))
