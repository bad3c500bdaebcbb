"""The hierarchy against testing every triangle, and its walks against each other."""

import tracemalloc

import numpy as np
import pytest

from sweep.model.geometry import bvh
from sweep.model.geometry.bvh import LEAF_TRIANGLES_MAX, build_tree, find_nearest_triangles
from sweep.scenes.rasters import TRIANGULATION_BYTES_PER_CELL
from sweep.scenes.terrain import Terrain


def soup(rng, n, kind):
    """Random triangles (vertices, faces) within some 10 m of zero."""
    centre = rng.uniform(-10, 10, (n, 1, 3))
    corners = centre + rng.normal(size=(n, 3, 3))
    if kind == "needles":
        long = rng.normal(size=(n, 1, 3))
        corners = centre + long * [[-5.0], [5.0], [4.9]] + 1e-2 * rng.normal(size=(n, 3, 3))
    if kind == "coplanar":
        corners[..., 2] = np.round(corners[..., 2, None, 0][:, :1])
    if kind == "sizes":
        corners = centre + (corners - centre) * 10.0 ** rng.uniform(-4, 1.5, (n, 1, 1))
    return corners.reshape(-1, 3), np.arange(3 * n, dtype=np.int32).reshape(n, 3)


def every_triangle(vertices, faces, origins, directions):
    """Distances (rays, triangles) by solving o + t d = a + p (b - a) + q (c - a) for each pair.

    Cramer's rule in extended precision: another formula than the walks', at 11 more bits. nan
    where the ray passes within 1e-9 of an edge, so that rounding may decide.
    """
    a, b, c = (vertices[faces[:, k]].astype(np.longdouble) for k in range(3))
    result = np.full((len(origins), len(faces)), np.inf)
    for i, (o, d) in enumerate(zip(origins, directions.astype(np.longdouble), strict=True)):
        e, f, s = b - a, c - a, o - a
        with np.errstate(divide="ignore", invalid="ignore"):  # parallel to a triangle
            det = np.einsum("ij,ij->i", np.cross(d, f), e)
            p = np.einsum("ij,ij->i", np.cross(d, f), s) / det
            q = np.einsum("ij,j->i", np.cross(s, e), d) / det
            t = np.einsum("ij,ij->i", np.cross(s, e), f) / det
            margin = np.minimum(np.minimum(p, q), 1 - p - q)
        hit = (det != 0) & (margin >= 0) & (t > 0)
        result[i] = np.where(hit, t, np.inf)
        result[i, (det != 0) & (np.abs(margin) < 1e-9)] = np.nan
    return result


def inside_points(rng, vertices, faces, n):
    """Points inside random triangles, so that thin ones are hit as well."""
    weights = rng.dirichlet([1.0, 1.0, 1.0], n)
    return np.einsum("nk,nki->ni", weights, vertices[faces[rng.integers(0, len(faces), n)]])


def unit(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def walk(tree, origins, directions):
    """Nearest distances and faces of bundles, nothing known before."""
    shape = directions.shape[:2]
    distance, face = np.full(shape, np.inf), np.full(shape, -1)
    find_nearest_triangles(tree, origins, directions, distance, face)
    return distance, face


def walk_alone(tree, origins, directions):
    """The same of single rays."""
    return (hit_leaf[:, 0] for hit_leaf in walk(tree, origins, directions[:, None]))


def fan(rng, towards, b, spread):
    """Bundles of b directions (n, b, 3) around given ones."""
    return unit(unit(towards)[:, None] + spread * rng.normal(size=(len(towards), b, 3)))


@pytest.mark.parametrize("kind", ["plain", "needles", "coplanar", "sizes"])
def test_walks_find_what_testing_every_triangle_finds(kind):
    rng = np.random.default_rng(7)
    vertices, faces = soup(rng, 400, kind)
    tree = build_tree(vertices, faces)
    origins = rng.uniform(-14, 14, (300, 3))
    directions = unit(inside_points(rng, vertices, faces, 300) - origins)
    directions[:30] = np.eye(3)[rng.integers(0, 3, 30)] * rng.choice([-1.0, 1.0], (30, 1))
    table = every_triangle(vertices, faces, origins, directions)
    sure = ~np.isnan(table).any(axis=1)
    distance, face = walk_alone(tree, origins, directions)
    truth = table.min(axis=1)
    assert sure.sum() > 250
    assert np.isfinite(truth[sure]).sum() > 30
    np.testing.assert_allclose(distance[sure], truth[sure], rtol=1e-10)
    hit = sure & np.isfinite(truth)
    assert (face[sure & ~hit] == -1).all()
    np.testing.assert_allclose(table[hit, face[hit]], truth[hit], rtol=1e-10)


@pytest.mark.parametrize("spread", [0.0, 1e-6, 1e-3, 0.1, 1.0])
@pytest.mark.parametrize("kind", ["plain", "needles", "sizes"])
def test_a_bundle_finds_what_its_rays_find_alone_bit_for_bit(kind, spread):
    """Narrow, wider than what one walk takes on, and about every axis at once."""
    rng = np.random.default_rng(11)
    vertices, faces = soup(rng, 3000, kind)
    tree = build_tree(vertices, faces)
    origins = rng.uniform(-12, 12, (60, 3))
    directions = fan(rng, inside_points(rng, vertices, faces, 60) - origins, 19, spread)
    directions[0] = np.eye(3)[0]
    together = walk(tree, origins, directions)
    single = walk_alone(tree, np.repeat(origins, 19, axis=0), directions.reshape(-1, 3))
    assert (together[1] >= 0).mean() > 0.1
    for bundle, ray in zip(together, single, strict=True):
        np.testing.assert_array_equal(bundle.ravel(), ray)


def test_what_is_known_to_lie_nearer_stays():
    vertices = np.array([[-1, -1, 5], [3, -1, 5], [-1, 3, 5]], dtype=float)
    tree = build_tree(vertices, np.array([[0, 1, 2]], np.int32))
    origins, directions = np.zeros((3, 3)), np.tile([0.0, 0.0, 1.0], (3, 1))
    distance, face = np.array([4.0, 5.0, 6.0]), np.array([-1, -1, -1])
    find_nearest_triangles(tree, origins, directions[:, None], distance[:, None], face[:, None])
    assert distance.tolist() == [4.0, 5.0, 5.0]
    assert face.tolist() == [-1, -1, 0]


def test_of_equally_near_triangles_the_first_in_the_mesh_counts():
    triangle = np.array([[-1, -1, 5], [3, -1, 5], [-1, 3, 5]], dtype=float)
    vertices = np.tile(triangle, (50, 1))
    tree = build_tree(vertices, np.arange(150, dtype=np.int32).reshape(50, 3))
    _, face = walk_alone(tree, np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]]))
    assert face[0] == 0


def leaves(tree):
    """(box, triangles) of every child of every node that is a leaf."""
    for node, c in np.argwhere(tree.children < 0):
        start, count = divmod(-1 - int(tree.children[node, c]), 8)
        yield tree.bounds[node, :, c], slice(start, start + count)


def test_every_triangle_lies_in_just_one_leaf_and_inside_its_box():
    rng = np.random.default_rng(3)
    vertices, faces = soup(rng, 5000, "sizes")
    tree = build_tree(vertices, faces)
    np.testing.assert_array_equal(np.sort(tree.mesh_face_index), np.arange(5000))
    np.testing.assert_array_equal(tree.vertices[tree.faces], vertices[faces[tree.mesh_face_index]])
    n_triangles = 0
    for box, triangles in leaves(tree):
        corners = tree.vertices[tree.faces[triangles]].reshape(-1, 3)
        assert corners.size <= 9 * LEAF_TRIANGLES_MAX
        assert (box[:3] < corners).all() and (box[3:] > corners).all()
        n_triangles += triangles.stop - triangles.start
    assert n_triangles == 5000


def test_triangles_that_no_plane_can_part_are_still_divided():
    """Thousands about one centre, and a cascade of sizes over twelve decades."""
    ring = np.exp(2j * np.pi * np.arange(3) / 3)
    turn = np.exp(1j * np.linspace(0, 1, 3000))[:, None] * ring
    concentric = np.stack([turn.real, turn.imag, np.zeros_like(turn.real)], axis=-1)
    size = 10.0 ** -np.linspace(0, 12, 3000)[:, None, None]
    cascade = size * np.array([[1, 0, 0], [1, 1, 0], [1, 0, 1]])
    for corners in (concentric, cascade):
        tree = build_tree(corners.reshape(-1, 3), np.arange(9000).reshape(3000, 3))
        np.testing.assert_array_equal(np.sort(tree.mesh_face_index), np.arange(3000))
        origin = corners[1234].mean(axis=0) + np.array([2.0, 0.01, 0.02])
        towards = unit(corners[1234].mean(axis=0) - origin)
        distance, _ = walk_alone(tree, origin[None], towards[None])
        assert 0.0 < distance[0] < np.inf


@pytest.mark.parametrize("n", [300, 363])
def test_a_tree_is_built_in_little_memory(n, monkeypatch):
    """Grids of 4.9e7 heights took 18 GB: 360 bytes a height, where the tree itself has 90 to 120.

    363^2 heights have twice as many triangles, just above a power of two: the emptiest leaves.
    """
    monkeypatch.setattr(bvh, "_TRIANGLES_PER_BATCH", 4096)
    terrain = Terrain(np.random.default_rng(3).random((n, n)), (1.0, 1.0), np.zeros(3))
    mesh, _ = terrain.to_facets().to_cleaned_mesh()
    build_tree(mesh.vertices, mesh.faces)
    tracemalloc.start()
    tree = build_tree(mesh.vertices, mesh.faces)
    peak = tracemalloc.get_traced_memory()[1] / n**2
    tracemalloc.stop()
    of_mesh = sum(array.nbytes for array in (mesh.vertices, mesh.faces, mesh.surface_index)) / n**2
    assert peak + of_mesh < TRIANGULATION_BYTES_PER_CELL
    assert sum(array.nbytes for array in tree) / n**2 < 125
