"""Rays at meshes far from the origin, at needles, along facets, through vertices and edges."""

import math
from collections.abc import Callable
from fractions import Fraction

import numpy as np
from exact_rays import error_in_ulps, intersect_triangle, nearest_triangle, to_fractions
from hard_cases import Family

from sweep.model.geometry.ray_casting import RayCaster
from sweep.scenes.meshes import clean_mesh

FAMILY = Family(
    "Meshes",
    "The range of the first hit, against exact fractions, in units of the last place of the "
    "range. Half of one is its own rounding; a miss, or a hit where there is none, counts as "
    "infinite.",
)
RANGE_CASE = {
    "reference": "nearest triangle in exact fractions",
    "measure": "range, last places",
    "limit": 0.5,
    "because": "the range, rounded to the nearest",
}
Scene = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
"""Vertices, faces, origins, directions."""


def unit_vector(v: np.ndarray) -> np.ndarray:
    v = np.asarray(v, float)
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def worst_range_error(scene: Scene) -> float:
    """Worst error of the ranges of a scene's rays [last places]."""
    vertices, faces, origins, directions = scene
    caster = RayCaster(clean_mesh(vertices, faces, np.zeros(len(faces)))[0])
    hits = caster.cast_bundles(origins, np.asarray(directions)[:, None])
    worst = 0.0
    for hit_range, origin, direction in zip(hits.range, origins, directions, strict=True):
        exact = nearest_triangle(np.asarray(vertices, float), np.asarray(faces), origin, direction)
        if exact is None or math.isinf(hit_range):
            worst = max(worst, 0.0 if exact is None and math.isinf(hit_range) else math.inf)
        else:
            worst = max(worst, error_in_ulps(hit_range, exact[0]))
    return worst


def register_scene(difficulty: str) -> Callable[[Callable[[], Scene]], Callable[[], Scene]]:
    """Registers a scene."""

    def register(make_scene: Callable[[], Scene]) -> Callable[[], Scene]:
        FAMILY.case(difficulty, allowed=1.0, **RANGE_CASE)(lambda: worst_range_error(make_scene()))
        return make_scene

    return register


def rough_terrain(n_nodes: int = 13, spacing: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Rough ground of two triangles a cell."""
    z = np.random.default_rng(1).uniform(0, spacing, (n_nodes, n_nodes))
    x, y = np.meshgrid(spacing * np.arange(n_nodes), spacing * np.arange(n_nodes))
    first_corners = (np.arange(n_nodes - 1)[:, None] * n_nodes + np.arange(n_nodes - 1)).ravel()
    lower_triangles = np.stack([first_corners, first_corners + 1, first_corners + n_nodes], axis=1)
    upper_triangles = np.stack(
        [first_corners + 1, first_corners + n_nodes + 1, first_corners + n_nodes], axis=1
    )
    return np.stack([x, y, z], axis=-1).reshape(-1, 3), np.concatenate(
        [lower_triangles, upper_triangles]
    )


def rays_at_targets(
    targets: np.ndarray, back_directions: np.ndarray, distance: float
) -> tuple[np.ndarray, np.ndarray]:
    """Origins and directions of rays at targets."""
    origins = targets + distance * unit_vector(back_directions)
    return origins, unit_vector(targets - origins)


def random_targets(vertices: np.ndarray, faces: np.ndarray, n_targets: int) -> np.ndarray:
    """Points well inside triangles."""
    rng = np.random.default_rng(2)
    barycentric = rng.dirichlet([3, 3, 3], n_targets)
    return np.einsum(
        "ij,ijk->ik", barycentric, vertices[faces[rng.integers(0, len(faces), n_targets)]]
    )


@register_scene("terrain 4e6 m from the origin, from 2 km")
def terrain_far_from_origin() -> Scene:
    vertices, faces = rough_terrain()
    vertices = vertices + np.array([4e6, -3e6, 2e6])
    back_directions = np.random.default_rng(3).normal(size=(60, 3)) * [0.4, 0.4, 0] + [0, 0, 1]
    return (
        vertices,
        faces,
        *rays_at_targets(random_targets(vertices, faces, 60), back_directions, 2000.0),
    )


@register_scene("terrain of 1e-6 m cells, from 1 mm")
def microscopic_terrain() -> Scene:
    vertices, faces = rough_terrain(spacing=1e-6)
    return (
        vertices,
        faces,
        *rays_at_targets(random_targets(vertices, faces, 40), [0.1, 0.2, 1], 1e-3),
    )


@register_scene("terrain of 1e5 m cells, from 1e7 m")
def planetary_terrain() -> Scene:
    vertices, faces = rough_terrain(spacing=1e5)
    return (
        vertices,
        faces,
        *rays_at_targets(random_targets(vertices, faces, 40), [0.1, 0.2, 1], 1e7),
    )


@register_scene("needles 1 km long and 1 um wide, side by side")
def needles() -> Scene:
    y = np.arange(41) * 1e-6
    near, far = (
        np.stack([0 * y, y, 0.3 * y], axis=1),
        np.stack([0 * y + 1e3, y, 7 + 0.1 * y], axis=1),
    )
    k = np.arange(40)
    faces = np.concatenate([np.stack([k, k + 1, 41 + k], 1), np.stack([k + 1, 42 + k, 41 + k], 1)])
    vertices = np.concatenate([near, far])
    return (
        vertices,
        faces,
        *rays_at_targets(random_targets(vertices, faces, 60), [-0.2, 0.1, 1], 500.0),
    )


@register_scene("slivers of 1e-10 m, before a wall 100 m off")
def slivers() -> Scene:
    """Corners about a line, before a wall, seen face on: each is as wide as it is."""
    rng = np.random.default_rng(5)
    start, along = rng.uniform(-1, 1, (30, 3)), unit_vector(rng.normal(size=(30, 3)))
    middle = start + 0.4 * along + 1e-10 * rng.normal(size=(30, 3))
    wall = np.array([[-50, -50, -9], [50, -50, -9.5], [0, 90, -8.7]])
    vertices = np.concatenate([start, middle, start + along, wall])
    k = np.arange(30)
    faces = np.concatenate([np.stack([k, k + 30, k + 60], axis=1), [[90, 91, 92]]])
    across = np.cross(along, middle - start)
    targets = np.concatenate([start + middle + start + along, 3 * rng.uniform(-1, 1, (30, 3))]) / 3
    away = np.concatenate([across * np.sign(across[:, 2:]), across * np.sign(across[:, 2:])])
    return vertices, faces, *rays_at_targets(targets, away, 100.0)


@register_scene("facets that coincide and overlap in one plane")
def coplanar_facets() -> Scene:
    square = np.array([[-9, -9], [9, -9], [9, 9], [-9, 9], [-3, -7], [8, 0.5], [-1, 8]])
    vertices = np.concatenate([square, (0.25 * square[:, :1] - 0.5 * square[:, 1:])], axis=1)
    faces = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [0, 1, 3], [1, 2, 3]])
    targets = np.random.default_rng(6).uniform(-5, 5, (40, 2))
    targets = np.concatenate([targets, 0.25 * targets[:, :1] - 0.5 * targets[:, 1:]], axis=1)
    return vertices, faces, *rays_at_targets(targets, [0.1, -0.2, 1], 300.0)


@register_scene("rays exactly in the planes of facets, a wall behind")
def rays_in_facet_planes() -> Scene:
    """The planes z = 0, z = x and x = y, along directions of equal components."""
    flat = [[-9, -9, 0], [9, -9, 0], [9, 9, 0]]
    tilted = [[-4, -8, -4], [4, -8, 4], [4, 8, 4]]
    upright = [[-4, -4, -8], [4, 4, -8], [4, 4, 8]]
    wall = [[50, -900, -900], [50, 900, -900], [50, 0, 900]]
    root = math.sqrt(0.5)
    rays = [
        ([-20, -3, 0], [1, 0, 0]), ([-20, 0, 0], [1, 0, 0]), ([-8, -1, -8], [root, 0, root]),
        ([-8, 0, -8], [root, 0, root]), ([-6, -6, 1], [root, root, 0]),
        ([-6, -6, 0], [root, root, 0]),
        ([-20, 1, 0], [0.6, 0.8, 0]),
    ]  # fmt: skip
    origins, directions = (np.array(part, float) for part in zip(*rays, strict=True))
    faces = np.arange(12).reshape(4, 3)
    return np.array([*flat, *tilted, *upright, *wall], float), faces, origins, directions


@register_scene("rays through vertices, exactly")
def rays_through_vertices() -> Scene:
    """Ground of dyadic numbers, and directions that reach its vertices without rounding."""
    vertices, faces = rough_terrain(9)
    vertices[:, 2] = np.round(vertices[:, 2] * 8) / 8
    inner = vertices.reshape(9, 9, 3)[1:-1, 1:-1].reshape(-1, 3)
    directions = np.array([[0, 0, -1], [0.6, 0, -0.8], [0, -0.6, -0.8], [0.28, 0, -0.96]])
    d = directions[np.arange(len(inner)) % 4]
    return vertices, faces, inner - 1024.0 * d, d


@register_scene("rays through edges, exactly")
def rays_through_edges() -> Scene:
    vertices, faces = rough_terrain(9)
    vertices[:, 2] = np.round(vertices[:, 2] * 8) / 8
    grid = vertices.reshape(9, 9, 3)[1:-1, 1:-1]
    rng = np.random.default_rng(7)
    pairs = np.concatenate(
        [np.stack([grid[:, :-1], grid[:, 1:]], -2).reshape(-1, 2, 3),
         np.stack([grid[:-1, 1:], grid[1:, :-1]], -2).reshape(-1, 2, 3)]
    )  # fmt: skip
    edge_fraction = rng.choice([0.25, 0.5, 0.875], (len(pairs), 1))
    targets = (1 - edge_fraction) * pairs[:, 0] + edge_fraction * pairs[:, 1]
    d = np.tile([0.0, 0.0, -1.0], (len(targets), 1))
    return vertices, faces, targets - 512.0 * d, d


@register_scene("rays within the last places of vertices and edges, 4e6 m from the origin")
def rays_near_edges() -> Scene:
    vertices, faces = rough_terrain(9)
    vertices = vertices + 4e6
    inner = vertices.reshape(9, 9, 3)[1:-1, 1:-1].reshape(-1, 3)
    targets = np.concatenate([inner, (inner[1:] + inner[:-1]) / 2])
    keep = np.ones(len(targets), bool)
    keep[len(inner) + 6 :: 7] = False  # not from the end of one row to the start of the next
    return vertices, faces, *rays_at_targets(targets[keep], [0.2, -0.1, 1], 3000.0)


@register_scene("a plane at 0.01 deg of grazing angle, from 2 km")
def grazing_plane() -> Scene:
    corners = np.array([[-1e5, -1e5, 3.1], [1.1e5, -1e5, -2.7], [0, 1.2e5, 0.4]])
    targets = np.random.default_rng(8).dirichlet([3, 3, 3], 40) @ corners
    azimuth = np.linspace(0, 6, 40)
    low = math.radians(0.01)
    away = np.stack([np.cos(azimuth), np.sin(azimuth), 0 * azimuth + math.tan(low)], axis=1)
    return corners, np.array([[0, 1, 2]]), *rays_at_targets(targets, away, 2000.0)


@register_scene("two surfaces 1e-11 m apart, from 2 km")
def close_layers() -> Scene:
    """Two parallel facets, the far one first, seen from 2 km before a third."""
    ground = np.array([[-50.0, -50, 0], [50, -50, 0], [0, 90, 0]])
    vertices = np.concatenate([ground - np.array([0, 0, depth]) for depth in (0, 1e-11, 5)])
    targets = np.random.default_rng(9).uniform(-15, 15, (60, 3)) * [1, 1, 0]
    return (
        vertices,
        np.array([[3, 4, 5], [0, 1, 2], [6, 7, 8]]),
        *rays_at_targets(targets, [0.3, 0.1, 1], 2e3),
    )


@FAMILY.case(
    "ranges of beamlets relative to the beam's, at 0.01 to 89 deg, from 10 km",
    reference="differences of exact fractions",
    measure="offset, of itself",
    allowed=3e-15,
    limit=4 * 2.0**-53,
    because="a product and a quotient of sums without cancellation, rounded",
)
def relative_ranges() -> float:
    corners = np.array([[-1e6, -1e6, 3.1], [1.1e6, -1e6, -2.7], [0, 1.2e6, 0.4]])
    caster, worst = RayCaster(clean_mesh(corners, [[0, 1, 2]], [0])[0]), 0.0
    for degrees in (0.01, 0.1, 1.0, 30.0, 89.0):
        grazing_angle = math.radians(degrees)
        centre = np.array([math.cos(grazing_angle), 0.0, -math.sin(grazing_angle)])
        beamlets = unit_vector(
            centre + np.random.default_rng(10).normal(size=(20, 3)) * 2e-5 * grazing_angle
        )
        directions = np.concatenate([centre[None], beamlets])
        origin = np.array([-10e3 * math.cos(grazing_angle), 0.0, 10e3 * math.sin(grazing_angle)])
        hits = caster.cast_bundles(origin[None], directions[None])
        ranges = [intersect_triangle(corners, origin, direction)[0] for direction in directions]
        for b in range(1, 21):
            exact = ranges[b] - ranges[0]
            worst = max(worst, float(abs(Fraction(hits.range_offset[0, b]) / exact - 1)))
    return worst


@FAMILY.case(
    "a vertex 4e6 m from the origin, relative to the mesh's own",
    reference="exact fractions",
    measure="digits lost [m]",
    allowed=0.0,
    limit=0.0,
    because="the mesh's centre is chosen so that taking it off is exact",
)
def vertices_about_origin() -> float:
    vertices, faces = rough_terrain()
    vertices = vertices + np.array([4e6, -3.123e6, 2e6])
    mesh = clean_mesh(vertices, faces, np.zeros(len(faces)))[0]
    return max(
        float(abs(a - (b + c)))
        for given_vertex, kept_vertex in zip(vertices, mesh.vertices, strict=True)
        for a, b, c in zip(
            to_fractions(given_vertex),
            to_fractions(kept_vertex),
            to_fractions(mesh.origin),
            strict=True,
        )
        if isinstance(a, Fraction)
    )
