from fractions import Fraction

import numpy as np
import pytest
import trimesh
from facet_areas import triangle_areas

from sweep.model.geometry.mesh import Mesh, merge_meshes
from sweep.scenes.meshes import clean_mesh, read_mesh_facets
from sweep.scenes.scene_files import SceneError

BOX = trimesh.creation.box(extents=(1.0, 2.0, 3.0))


@pytest.fixture
def file(tmp_path):
    """A mesh written in the format that the name asks for."""

    def write(mesh, name):
        path = tmp_path / name
        mesh.export(path)
        return path

    return write


def extents(facets):
    return np.ptp(facets.vertices, axis=0)


def volume(facets):
    a, b, c = facets.vertices[facets.faces.T]
    return np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6


@pytest.mark.parametrize("name", ["box.stl", "box.obj", "box.ply", "box.off"])
def test_a_box_is_the_same_box_in_every_format(file, name):
    box = read_mesh_facets(file(BOX, name))
    assert len(box.faces) == 12
    np.testing.assert_allclose(extents(box), (1, 2, 3), rtol=1e-6)
    assert triangle_areas(box.vertices, box.faces).sum() == pytest.approx(22, rel=1e-6)
    assert volume(box) == pytest.approx(6, rel=1e-6)  # positive: facing outwards


@pytest.mark.parametrize(
    ("unit", "metres"), [("mm", 1e-3), ("cm", 1e-2), ("km", 1e3), ("inch", 0.0254), (None, 1.0)]
)
def test_lengths_in_a_stated_unit_become_metres(file, unit, metres):
    for scale in (1.0, 10.0):
        box = read_mesh_facets(file(BOX, "box.ply"), unit=unit, scale=scale)
        np.testing.assert_allclose(extents(box), scale * metres * np.array([1, 2, 3]), rtol=1e-6)


def test_what_was_up_in_gltf_is_up_in_the_scene(file):
    upright = read_mesh_facets(file(BOX, "box.glb"))
    np.testing.assert_allclose(extents(upright), (1, 3, 2), rtol=1e-6)
    as_it_lies = read_mesh_facets(file(BOX, "box.glb"), up="z")
    np.testing.assert_allclose(extents(as_it_lies), (1, 2, 3), rtol=1e-6)
    tall = trimesh.creation.cone(radius=1.0, height=5.0)  # its tip along z of the file
    tall.apply_transform([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])  # now y
    cone = read_mesh_facets(file(tall, "cone.glb"))
    tip = cone.vertices + cone.origin
    assert tip[tip[:, 2].argmax(), 2] == pytest.approx(5.0)


def test_the_parts_of_a_scene_stand_where_its_graph_puts_them(file):
    scene = trimesh.Scene()
    scene.add_geometry(BOX, transform=trimesh.transformations.translation_matrix((10, 0, 0)))
    mirror = np.diag([1.0, 1.0, -1.0, 1.0])
    mirror[:3, 3] = (-10, 0, 0)
    scene.add_geometry(BOX, transform=mirror)
    meshes = read_mesh_facets(file(scene, "two.glb"), up="z")
    assert len(meshes.faces) == 24
    np.testing.assert_allclose(extents(meshes), (21, 2, 3), rtol=1e-6)
    assert volume(meshes) == pytest.approx(12, rel=1e-6)  # the mirrored one is not inside out


def test_faces_without_area_and_double_ones_are_reported_when_the_mesh_is_made(tmp_path):
    path = tmp_path / "dirty.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0\nf 1 2 3\nf 3 2 1\nf 2 2 3\nf 2 4 3\n")
    mesh, report = read_mesh_facets(path).to_cleaned_mesh()
    assert len(mesh.faces) == 2
    assert (report.n_duplicate_faces, report.n_degenerate_faces) == (1, 1)


@pytest.mark.parametrize("unit", ["seconds", "furlonks"])
def test_a_mesh_in_no_unit_of_length_is_refused_with_file_rule_and_remedy(file, unit):
    path = file(BOX, "box.ply")
    with pytest.raises(SceneError, match=unit) as refused:
        read_mesh_facets(path, unit=unit)
    assert str(path) in str(refused.value) and refused.value.remedy


def test_files_that_are_no_mesh_are_refused(tmp_path):
    for name, message in (
        ("a.stl", "no triangles|no mesh"),
        ("a.foo", "no mesh"),
        ("a.xyz", "no triangles|no mesh"),
    ):
        (tmp_path / name).write_text("0 0 0\n1 0 0\n0 1 0\n")
        with pytest.raises(SceneError, match=message):
            read_mesh_facets(tmp_path / name)
    with pytest.raises(SceneError, match="does not exist"):
        read_mesh_facets(tmp_path / "gone.stl")


@pytest.mark.parametrize(
    ("size", "message"),
    [
        (60, "it has 60 bytes, and a binary STL has 84 or more"),
        (84, "counts 12 triangles, which take 684 bytes, and it has 84: it is cut off"),
        (683, "and it has 683: it is cut off"),
        (700, r"which take 684 bytes, and it has 700\)"),
    ],
)
def test_a_binary_stl_of_another_size_than_its_triangles_is_refused(file, size, message):
    path = file(BOX, "box.stl")
    content = path.read_bytes()
    assert len(content) == 684
    path.write_bytes(content[:size] + bytes(max(0, size - 684)))
    with pytest.raises(SceneError, match=message):
        read_mesh_facets(path)


@pytest.mark.parametrize("start", ["solid box\n", "\ufeffsolid\n", "SOLID\n"])
def test_an_stl_of_text_is_read_however_it_begins(tmp_path, start):
    text = trimesh.exchange.stl.export_stl_ascii(BOX)
    path = tmp_path / "box.stl"
    path.write_text(start + text.partition("\n")[2])
    assert len(read_mesh_facets(path).faces) == 12


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.ply", "ply\nformat ascii 1.0\nelement vertex -1\nend_header\n",
         "declares -1 of the element 'vertex'"),
        ("b.ply", "ply\nformat ascii 1.0\nelement vertex 3\nelement face -20\nend_header\n",
         "declares -20 of the element 'face'"),
        ("a.off", "OFF\n-3 1 0\n0 0 0\n", "declares -3 vertices and 1 faces"),
        ("a.gltf", '{"accessors": [{"count": -3}, {"count": 9}]}', "an array of -3 elements"),
    ],
)  # fmt: skip
def test_counts_below_zero_are_reported(tmp_path, name, content, message):
    (tmp_path / name).write_text(content)
    with pytest.raises(SceneError, match=message):
        read_mesh_facets(tmp_path / name)


def test_a_link_that_leads_to_itself_is_reported(tmp_path):
    (tmp_path / "self.stl").symlink_to("self.stl")
    (tmp_path / "there.stl").symlink_to("back.stl")
    (tmp_path / "back.stl").symlink_to("there.stl")
    (tmp_path / "folder").symlink_to("folder")
    for name in ("self.stl", "there.stl", "folder/box.stl"):
        with pytest.raises(SceneError, match="is reached by a link that leads back to itself"):
            read_mesh_facets(tmp_path / name)


CORNERS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=float)
CUBE = np.array(
    [
        [0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
        [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3],
    ]
)  # fmt: skip


def world(mesh):
    """Exact world coordinates of a mesh's triangles."""
    corners = mesh.vertices[mesh.faces]
    return [
        [[Fraction(x) + Fraction(o) for x, o in zip(v, mesh.origin, strict=True)] for v in triangle]
        for triangle in corners.tolist()
    ]


def exact(vertices, faces):
    return [[[Fraction(x) for x in v] for v in triangle] for triangle in vertices[faces].tolist()]


def test_a_clean_closed_mesh_needs_nothing():
    mesh, report = clean_mesh(CORNERS, CUBE, 3)
    assert report.summary() == "12 faces on 8 vertices; nothing to mend"
    assert (mesh.surface_index == 3).all()
    assert world(mesh) == exact(CORNERS, CUBE)


def test_faces_without_data_are_dropped_and_the_rest_kept_in_order():
    vertices = np.vstack([CORNERS, [[np.nan, 0, 0], [0, np.inf, 0]]])
    faces = np.vstack([CUBE[:5], [[0, 1, 8]], CUBE[5:], [[9, 1, 2]]])
    surface = np.arange(14)
    mesh, report = clean_mesh(vertices, faces, surface)
    assert (report.n_non_finite_faces, report.n_unreferenced_vertices) == (2, 2)
    assert mesh.surface_index.tolist() == [0, 1, 2, 3, 4, 6, 7, 8, 9, 10, 11, 12]
    assert world(mesh) == exact(CORNERS, CUBE)


def test_faces_without_area_are_dropped_but_the_thinnest_with_area_is_kept():
    vertices = [[0, 0, 0], [1, 0, 0], [2, 0, 0], [1, 1e-12, 0], [0, 0, 5], [1, 1, 5]]
    faces = [[0, 1, 2], [0, 2, 3], [4, 4, 5], [0, 1, 4]]
    mesh, report = clean_mesh(vertices, faces, [0, 1, 2, 3])
    assert report.n_degenerate_faces == 2
    assert mesh.surface_index.tolist() == [1, 3]


def test_a_face_given_twice_is_kept_once_in_whatever_winding_and_on_whatever_copies():
    vertices = np.vstack([CORNERS, CORNERS, -0.0 * CORNERS[:1]])
    faces = np.vstack([CUBE, CUBE[:4, ::-1], CUBE[3:4] + 8, [[16, 12, 13]]])
    surface = np.r_[np.zeros(12, int), np.ones(6, int)]
    mesh, report = clean_mesh(vertices, faces, surface)
    assert report.n_duplicate_faces == 6
    assert (report.n_merged_vertices, report.n_unreferenced_vertices) == (4, 5)
    assert (mesh.surface_index == 0).all()
    assert world(mesh) == exact(CORNERS, CUBE)


def test_a_soup_of_separate_triangles_becomes_watertight():
    vertices = CORNERS[CUBE].reshape(-1, 3)
    mesh, report = clean_mesh(vertices, np.arange(36).reshape(12, 3), 0)
    assert report.n_merged_vertices == 28
    assert len(mesh.vertices) == 8 and world(mesh) == exact(CORNERS, CUBE)


def test_merged_meshes_keep_every_triangle_where_it_was():
    near, _ = clean_mesh(CORNERS, CUBE, 0)
    far, _ = clean_mesh(CORNERS + np.array([4e6, -3e6, 0.5]), CUBE, 1)
    merged = merge_meshes([near, far])
    assert world(merged) == world(near) + world(far)
    assert merged.surface_index.tolist() == [0] * 12 + [1] * 12


@pytest.mark.parametrize(
    ("vertices", "faces", "surface", "match"),
    [
        (CORNERS, np.empty((0, 3), int), [], "none is left"),
        (CORNERS, [[0, 0, 1]], [0], "none is left"),
        (np.full((3, 3), np.nan), [[0, 1, 2]], [0], "none is left"),
        (CORNERS, [[0, 1, 8]], [0], "outside 0..7"),
        (CORNERS, [[0, 1, -1]], [0], "outside 0..7"),
        (CORNERS, [[0.0, 1.0, 2.0]], [0], "integers"),
        (CORNERS[:, :2], [[0, 1, 2]], [0], "shape"),
        (CORNERS, CUBE, [0, 1], "as many surfaces"),
    ],
)
def test_what_no_ray_could_hit_is_refused(vertices, faces, surface, match):
    with pytest.raises(ValueError, match=match):
        clean_mesh(vertices, faces, surface)


def test_a_mesh_made_by_hand_is_checked_too():
    with pytest.raises(ValueError, match="at least one triangle"):
        Mesh(CORNERS, np.empty((0, 3), np.int32), np.empty(0, np.int16), np.zeros(3))
    with pytest.raises(ValueError, match="finite"):
        Mesh(CORNERS * np.nan, CUBE, np.zeros(12), np.zeros(3))
    with pytest.raises(ValueError, match="origin"):
        Mesh(CORNERS, CUBE, np.zeros(12), np.zeros(2))
