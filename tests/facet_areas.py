"""Areas of triangles, for tests of what is made of them."""

import numpy as np


def triangle_areas(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Areas [m^2], (m,)."""
    a, b, c = vertices[np.asarray(faces).T]
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
