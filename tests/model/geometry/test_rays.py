"""Rays and bundles against rational arithmetic, closed forms and each other.

A float64 is a rational number, so the range of a facet's plane along a ray has an exact value;
`exact_rays` computes it in fractions, by another formula than the code's. Tolerances are then
units in the last place of the result: half of one by rounding, the rest of one for its own error;
`tests/stability/hard_meshes.py` holds more of what is hard to them. At 2 km
one such unit is 2.3e-13 m: 1.8e-6 rad of optical phase.
"""

from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from exact_rays import error_in_ulps, intersect_triangle, nearest_triangle, to_fractions

from sweep.model.geometry import quaternion
from sweep.model.geometry.mesh import merge_meshes
from sweep.model.geometry.ray_casting import Pose, RayCaster
from sweep.scenes.meshes import clean_mesh
from sweep.scenes.terrain import Terrain

GALE = Path(__file__).parents[4] / "shared" / "data" / "gale_crater_hirise_1m.tif"
PHASE_PER_METRE = 4.0 * np.pi / 1.55e-6

CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float)
CUBE = np.array(
    [
        [0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
        [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3],
    ]
)  # fmt: skip


def dot(a, b):
    return sum(x * y for x, y in zip(a, b, strict=True))


def unit(v):
    v = np.asarray(v, dtype=float)
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def cast(caster, origins, directions, **poses):
    """First hits of single rays: those of bundles, without the dimension of beamlets."""
    hits = caster.cast_bundles(origins, np.asarray(directions, float)[..., None, :], **poses)
    of_beamlets = (
        "range_offset", "is_hit", "cos_incidence", "surface_index", "face_index", "body_index",
    )  # fmt: skip
    return hits._replace(**{name: getattr(hits, name)[:, 0] for name in of_beamlets})


def bumpy_sphere(subdivisions=3, seed=0, roughness=0.1):
    """A closed rough surface about zero of radius about 1: (vertices, faces)."""
    vertices, faces = icosphere(subdivisions)
    scale = 1.0 + roughness * np.random.default_rng(seed).uniform(-1, 1, len(vertices))
    return vertices * scale[:, None], faces


def icosphere(subdivisions):
    """Unit sphere from an icosahedron, each triangle parted in four so many times."""
    g = (1 + 5**0.5) / 2
    vertices = [[s, t * g, 0] for s in (-1, 1) for t in (-1, 1)]
    vertices = unit(
        vertices + [[z, x, y] for x, y, z in vertices] + [[y, z, x] for x, y, z in vertices]
    )
    distance = np.linalg.norm(vertices[:, None] - vertices, axis=2)
    near = distance < 1.1 * distance[distance > 0.1].min()
    faces = np.array(
        [
            (i, j, k)
            for i in range(12)
            for j in range(i)
            for k in range(j)
            if near[i, j] and near[j, k] and near[k, i]
        ]
    )
    for _ in range(subdivisions):
        edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]], axis=2).reshape(-1, 2)
        kept, index = np.unique(edges, axis=0, return_inverse=True)
        middle = len(vertices) + index.reshape(-1, 3)
        vertices = np.vstack([vertices, unit(vertices[kept].mean(axis=1))])
        a, b, c = faces.T
        p, q, r = middle.T
        parts = [[a, p, r], [p, b, q], [r, q, c], [p, q, r]]
        faces = np.concatenate([np.stack(part, axis=1) for part in parts])
    return vertices, faces


def facets(heights):
    """Vertices and faces of ground of steps of 1 m."""
    ground = Terrain(heights, (1.0, 1.0), np.zeros(3)).to_facets()
    return ground.vertices + ground.origin, ground.faces


@pytest.fixture(scope="module")
def gale():
    """The heights of real terrain (rows, columns) [m]."""
    if not GALE.exists():
        pytest.skip("the shared terrain is not here")
    rasterio = pytest.importorskip("rasterio")
    with rasterio.open(GALE) as raster:
        return raster.read(1).astype(float)


@pytest.fixture(scope="module")
def closed():
    """A bumpy sphere: vertices, faces and caster."""
    vertices, faces = bumpy_sphere(4)
    mesh, _ = clean_mesh(vertices, faces, 0)
    return vertices, faces, RayCaster(mesh)


def test_ranges_on_real_terrain_are_exact_but_for_their_rounding(gale):
    """From 2 km off, steeply and at 20 degrees of grazing angle; worst phase 2e-6 rad."""
    vertices, faces = facets(gale)
    rng, number = np.random.default_rng(2), 18
    target = vertices[rng.integers(0, len(vertices), number)] + [[0.3, 0.2, 0.0]]
    target += rng.uniform(-0.4, 0.4, (number, 3))
    away = unit([[0.02, 0.01, 1.0], [1.0, 0.6, 0.42]])[np.arange(number) % 2]
    origins = target + 2000.0 * away
    directions = unit(target - origins)
    hits = cast(RayCaster(clean_mesh(vertices, faces, 0)[0]), origins, directions)
    worst = 0.0
    for i in range(number):
        truth = nearest_triangle(vertices, faces, origins[i], directions[i])
        if truth is None:  # passes beside the terrain's rim
            assert hits.face_index[i] == -1
            continue
        assert hits.face_index[i] == truth[1]
        assert error_in_ulps(hits.range[i], truth[0]) <= 1.0
        worst = max(worst, abs(float(Fraction(hits.range[i]) - truth[0])) * PHASE_PER_METRE)
    assert (hits.face_index >= 0).sum() > 15
    assert worst < 2e-6


@pytest.mark.parametrize("offset", [0.0, 4e6])
def test_no_ray_leaves_a_closed_surface_through_a_vertex_or_an_edge(closed, offset):
    """Every ray from inside must hit, wherever it is aimed: 100,000 at vertices and edges."""
    vertices, faces = closed[:2]
    caster = RayCaster(clean_mesh(vertices + offset, faces, 0)[0])
    rng = np.random.default_rng(5)
    placed = vertices + offset
    at_vertices = placed[rng.integers(0, len(vertices), 50_000)]
    edges = faces[rng.integers(0, len(faces), 50_000)][:, :2]
    part = rng.choice([0.5, 0.25, 1 / 3, 1e-9], (50_000, 1))
    at_edges = (1 - part) * placed[edges[:, 0]] + part * placed[edges[:, 1]]
    targets = np.concatenate([at_vertices, at_edges])
    origins = offset + rng.uniform(-0.4, 0.4, (100_000, 3))
    origins[:20_000] = offset
    hits = cast(caster, origins, unit(targets - origins))
    assert (hits.face_index >= 0).all()
    assert (hits.range < 3.0).all()


def test_a_cube_is_met_at_its_slabs_from_outside_and_from_inside():
    caster = RayCaster(clean_mesh(CORNERS, CUBE, np.arange(12) // 2)[0])
    rng = np.random.default_rng(9)
    outside = 10.0 * unit(rng.normal(size=(500, 3)))
    origins = np.concatenate([outside, rng.uniform(-0.9, 0.9, (500, 3))])
    directions = unit(np.concatenate([rng.uniform(-1.5, 1.5, (500, 3)) - outside, outside]))
    hits = cast(caster, origins, directions)
    planes = np.sort((np.array([[[-1.0]], [[1.0]]]) - origins) / directions, axis=0)
    enter, leave = planes[0].max(axis=1), planes[1].min(axis=1)
    inside = np.arange(1000) >= 500
    is_hit = inside | (enter < leave)
    assert 100 < (is_hit & ~inside).sum() < 500
    np.testing.assert_array_equal(hits.face_index >= 0, is_hit)
    expected = np.where(inside, leave, enter)
    np.testing.assert_allclose(hits.range[is_hit], expected[is_hit], rtol=1e-15, atol=4e-15)
    axis = np.where(inside, planes[1].argmin(axis=1), planes[0].argmax(axis=1))
    along = directions[np.arange(1000), axis]
    normals = -np.sign(along)[:, None] * np.eye(3)[axis]
    np.testing.assert_array_equal(hits.normal[is_hit], normals[is_hit])
    np.testing.assert_allclose(hits.cos_incidence[is_hit], np.abs(along)[is_hit], rtol=1e-15)
    sides = np.abs(CORNERS[CUBE].sum(axis=1)).argmax(axis=1)
    np.testing.assert_array_equal(sides[hits.face_index[is_hit]], axis[is_hit])
    np.testing.assert_array_equal(hits.surface_index[is_hit], hits.face_index[is_hit] // 2)


def test_a_miss_says_so_everywhere(closed):
    hits = cast(closed[2], [[0, 0, 5.0]], [[0, 0, 1.0]])
    assert (hits.face_index[0], hits.body_index[0], hits.surface_index[0]) == (-1, -1, -1)
    assert hits.range[0] == np.inf
    assert np.isnan(hits.cos_incidence[0])
    assert np.isnan(hits.normal[0]).all()


def test_no_ray_within_a_silhouette_by_a_billionth_of_a_metre_passes_it():
    leaf, _ = clean_mesh([[1, -5, 10], [9, -5, 10], [1, 9, 10.3]], [[0, 1, 2]], 7)
    ground, _ = clean_mesh([[-90, -90, 0], [90, -90, 0], [0, 90, 0]], [[0, 1, 2]], 8)
    y = np.random.default_rng(16).uniform(-4.9, 8.0, 10_000)
    targets = np.stack([np.full_like(y, 1 + 1e-9), y, 10 + 0.3 * (y + 5) / 14], axis=1)
    origins = targets + 2000.0 * unit([0.3, 0.2, 1])
    hits = cast(RayCaster(merge_meshes([leaf, ground])), origins, unit(targets - origins))
    assert (hits.surface_index == 7).all()


def test_the_order_and_the_grouping_of_rays_change_no_bit(closed):
    caster = closed[2]
    rng = np.random.default_rng(11)
    origins = rng.uniform(-2, 2, (5000, 3))
    directions = unit(rng.normal(size=(5000, 3)))
    cast_at_once = cast(caster, origins, directions)
    order = rng.permutation(5000)
    for part in np.array_split(order, [1, 2, 50, 3000]):
        piece = cast(caster, origins[part], directions[part])
        for a, b in zip(cast_at_once, piece, strict=True):
            np.testing.assert_array_equal(a[part], b)


def beam(directions, divergence, b=19):
    """Bundles (n, b, 3) of a centre and rings around it [rad]."""
    across = unit(np.cross(directions, [0.3, 0.5, 0.8]))
    other = np.cross(directions, across)
    radius = np.r_[0.0, np.sqrt(np.arange(1, b) / b)] * divergence / 2
    angle = 2.4 * np.arange(b)
    x, y = radius * np.cos(angle), radius * np.sin(angle)
    return unit(directions[:, None] + x[:, None] * across[:, None] + y[:, None] * other[:, None])


@pytest.mark.parametrize("divergence", [0.0, 50e-6, 5e-3, 0.3])
def test_a_bundle_sees_what_its_rays_see_alone(closed, divergence):
    """Footprints within a facet, over many, past the rim, and wider than one walk takes on."""
    rng = np.random.default_rng(12)
    origins = 20.0 * unit(rng.normal(size=(300, 3)))
    directions = beam(unit(rng.uniform(-0.7, 0.7, (300, 3)) - origins), divergence)
    bundle = closed[2].cast_bundles(origins, directions)
    hits = cast(closed[2], np.repeat(origins, 19, axis=0), directions.reshape(-1, 3))
    shape = (300, 19)
    assert bundle.is_hit.mean() > 0.05
    np.testing.assert_array_equal(bundle.is_hit, (hits.face_index >= 0).reshape(shape))
    np.testing.assert_array_equal(bundle.face_index.ravel(), hits.face_index)
    np.testing.assert_array_equal(bundle.surface_index.ravel(), hits.surface_index)
    np.testing.assert_array_equal(bundle.body_index.ravel(), hits.body_index)
    hits_any = bundle.is_hit.any(axis=1)
    rows, first = np.flatnonzero(hits_any), bundle.reference_beamlet[hits_any]
    np.testing.assert_array_equal(bundle.range[hits_any], hits.range.reshape(shape)[rows, first])
    np.testing.assert_array_equal(
        bundle.normal[hits_any], hits.normal.reshape(300, 19, 3)[rows, first]
    )
    assert (bundle.range_offset[rows, first] == 0.0).all()
    total = (bundle.range[:, None] + bundle.range_offset)[bundle.is_hit]
    np.testing.assert_allclose(total, hits.range.reshape(shape)[bundle.is_hit], rtol=3e-16)
    cosine = hits.cos_incidence.reshape(shape)
    np.testing.assert_allclose(bundle.cos_incidence, cosine, rtol=1e-14, atol=1e-15)
    assert np.isnan(bundle.range_offset[~bundle.is_hit]).all()
    assert (bundle.reference_beamlet[~hits_any] == -1).all()
    assert np.isinf(bundle.range[~hits_any]).all()


@pytest.mark.parametrize("offset", [0.0, 4e6])
def test_ranges_within_a_bundle_keep_digits_that_their_difference_has_lost(offset):
    """At 2 km to 1e-17 m on the centre's facet and to the last place elsewhere.

    Subtracting two ranges of 2 km would leave up to 2e-13 m.
    """
    rng = np.random.default_rng(13)
    vertices, faces = facets(0.3 * rng.normal(size=(30, 30)))
    vertices = vertices + offset
    mesh, _ = clean_mesh(vertices, faces, 0)
    centre = 30 * rng.integers(5, 25, 15) + rng.integers(5, 25, 15)
    origins = vertices[centre] + [[0.1, 0.2, 0.0]] + 2000.0 * unit([0.3, 0.2, 1])
    directions = beam(np.tile(unit([-0.3, -0.2, -1.0]), (15, 1)), 400e-6, 9)
    bundle = RayCaster(mesh).cast_bundles(origins, directions)
    same = bundle.face_index == bundle.face_index[:, :1]
    assert bundle.is_hit.all()
    assert 20 < same[:, 1:].sum() < 100
    for i in range(15):
        exact = [
            intersect_triangle(vertices[faces[face]], origins[i], d)[0]
            for d, face in zip(directions[i], bundle.face_index[i], strict=True)
        ]
        for b in range(9):
            error = float(abs(Fraction(bundle.range_offset[i, b]) - (exact[b] - exact[0])))
            cosine = bundle.cos_incidence[i, b]
            aside = np.linalg.norm(directions[i, b] - directions[i, 0])
            # A few roundings of n.delta, as large as R delta over the cosine.
            bound = 8 * 1.1e-16 * 2000.0 * aside / cosine**2
            assert error <= (bound if same[i, b] else np.spacing(abs(bundle.range_offset[i, b])))


def test_beamlets_of_one_beam_see_several_surfaces_and_may_miss():
    """A leaf above the ground's end: leaf, ground and, at the beam's centre, sky."""
    leaf, _ = clean_mesh([[1, -5, 10], [9, -5, 10], [1, 9, 10]], [[0, 1, 2]], 7)
    ground, _ = clean_mesh(
        [[-9, -9, 0], [0.5, -9, 0], [0.5, 9, 0], [-9, 9, 0]], [[0, 1, 2], [0, 2, 3]], 8
    )
    caster = RayCaster([merge_meshes([leaf, ground])])
    targets = np.array([[0.8, 0, 0], [0.4, 0, 0], [2.0, 0, 10], [0.3, 0.1, 0.0]])
    origin = np.array([[0.8, 0, 2010.0]])
    directions = unit(targets - origin)[None]
    bundle = caster.cast_bundles(origin, directions)
    assert bundle.surface_index.tolist() == [[-1, 8, 7, 8]]
    assert bundle.is_hit.tolist() == [[False, True, True, True]]
    assert bundle.reference_beamlet.tolist() == [1]
    lengths = np.linalg.norm(targets - origin, axis=1)
    np.testing.assert_allclose(bundle.range, lengths[1], rtol=1e-15)
    np.testing.assert_allclose(bundle.range_offset[0, 1:], lengths[1:] - lengths[1], atol=1e-12)
    assert bundle.range_offset[0, 2] < -9.0


def placed(vertices, pose, i):
    """Vertices of a body in the world's frame at the pose of ray i."""
    return pose.position[i] + quaternion.rotate(pose.attitude[i], vertices)


def test_bodies_that_tumble_are_met_where_their_moved_meshes_would_be():
    rng = np.random.default_rng(14)
    shapes = [(CORNERS, CUBE), bumpy_sphere(1), (3 * CORNERS, CUBE)]
    meshes = [clean_mesh(v, f, s)[0] for s, (v, f) in enumerate(shapes)]
    n = 60
    poses = [
        Pose(rng.uniform(-4, 4, (n, 3)), unit(rng.normal(size=(n, 4)))),
        Pose(rng.uniform(-4, 4, (n, 3)), unit(rng.normal(size=(n, 4)))),
        None,
    ]
    origins = 30.0 * unit(rng.normal(size=(n, 3)))
    directions = beam(unit(rng.uniform(-4, 4, (n, 3)) - origins), 0.1)
    caster = RayCaster(meshes)
    hits = cast(caster, origins, directions[:, 0], poses=poses)
    bundle = caster.cast_bundles(origins, directions, poses=poses)
    for i in range(n):
        moved = [placed(shapes[k][0], poses[k], i) for k in range(2)] + [shapes[2][0]]
        world = [
            clean_mesh(v, f, k)[0] for k, (v, (_, f)) in enumerate(zip(moved, shapes, strict=True))
        ]
        unmoved = RayCaster(merge_meshes(world))
        truth = unmoved.cast_bundles(origins[i : i + 1], directions[i : i + 1])
        np.testing.assert_array_equal(bundle.body_index[i], truth.surface_index[0])
        np.testing.assert_array_equal(bundle.surface_index[i], truth.surface_index[0])
        np.testing.assert_allclose(bundle.range[i], truth.range[0], atol=1e-12)
        np.testing.assert_allclose(bundle.range_offset[i], truth.range_offset[0], atol=2e-12)
        np.testing.assert_allclose(bundle.normal[i], truth.normal[0], atol=1e-13)
        np.testing.assert_allclose(bundle.cos_incidence[i], truth.cos_incidence[0], atol=1e-13)
        if truth.is_hit[0, 0]:
            assert hits.range[i] == bundle.range[i]
            np.testing.assert_array_equal(hits.normal[i], bundle.normal[i])
        assert hits.body_index[i] == truth.surface_index[0, 0]
    assert {0, 1, 2} <= set(bundle.body_index.ravel().tolist())


def exact_rotation(q):
    """Rotation matrix of a quaternion of any length, in fractions."""
    w, x, y, z = to_fractions(q)
    scale = w * w + x * x + y * y + z * z
    rows = [
        [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
    ]
    return [[value / scale for value in row] for row in rows]


@pytest.mark.parametrize("offset", [0.0, 4e6])
def test_a_tumbling_body_at_two_kilometres_keeps_its_phase(offset):
    """Rounding the rotation deforms a body of 1 m by 1e-16 m; the range does not enter."""
    rng = np.random.default_rng(15)
    n = 40
    pose = Pose(offset + rng.uniform(-1, 1, (n, 3)), unit(rng.normal(size=(n, 4))))
    origins = pose.position + 2000.0 * unit(rng.normal(size=(n, 3)))
    directions = unit(pose.position + rng.uniform(-0.8, 0.8, (n, 3)) - origins)
    mesh, _ = clean_mesh(CORNERS, CUBE, 0)
    hits = cast(RayCaster(mesh), origins, directions, poses=[pose])
    assert (hits.face_index >= 0).sum() > 25
    for i in np.flatnonzero(hits.face_index >= 0):
        rotation = exact_rotation(pose.attitude[i])
        shift = to_fractions(pose.position[i])
        corners = [
            [dot(row, to_fractions(v)) + s for row, s in zip(rotation, shift, strict=True)]
            for v in CORNERS[CUBE[hits.face_index[i]]]
        ]
        t, _ = intersect_triangle(corners, origins[i], directions[i])
        # The range's rounding, and the body's: 1e-15 m over the cosine of incidence.
        bound = 0.5 * np.spacing(2000.0) + 2e-15 / hits.cos_incidence[i]
        assert float(abs(Fraction(hits.range[i]) - t)) <= bound
        assert bound * PHASE_PER_METRE < 1e-4


def test_of_bodies_one_behind_the_other_the_nearest_is_hit_in_whatever_order_they_come():
    mesh, _ = clean_mesh(CORNERS, CUBE, 0)
    straight = np.array([1.0, 0.0, 0.0, 0.0])
    poses = [Pose(np.array([x, 0.0, 0.0]), straight) for x in (50.0, 10.0, 30.0)]
    for order in ([0, 1, 2], [1, 2, 0], [2, 0, 1]):
        caster = RayCaster([mesh] * 3)
        hits = cast(caster, [[0, 0.2, 0.1]], [[1.0, 0, 0]], poses=[poses[k] for k in order])
        assert hits.range.tolist() == [9.0]
        assert hits.body_index.tolist() == [order.index(1)]


def test_no_rays_give_no_hits(closed):
    assert cast(closed[2], np.empty((0, 3)), np.empty((0, 3))).range.shape == (0,)
    assert closed[2].cast_bundles(np.empty((0, 3)), np.empty((0, 5, 3))).range_offset.shape == (
        0,
        5,
    )
