import math

import numpy as np
import pytest
import trimesh
from facet_areas import areas

from sweep.model.geometry.mesh import Surface
from sweep.model.geometry.quaternion import about
from sweep.scenes.errors import SceneError
from sweep.scenes.meshes import Placement, read_mesh

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
    box = read_mesh(file(BOX, name))
    assert len(box.faces) == 12
    np.testing.assert_allclose(extents(box), (1, 2, 3), rtol=1e-6)
    assert areas(box.vertices, box.faces).sum() == pytest.approx(22, rel=1e-6)
    assert volume(box) == pytest.approx(6, rel=1e-6)  # positive: facing outwards


@pytest.mark.parametrize(
    ("unit", "metres"), [("mm", 1e-3), ("cm", 1e-2), ("km", 1e3), ("inch", 0.0254), (None, 1.0)]
)
def test_lengths_in_a_stated_unit_become_metres(file, unit, metres):
    box = read_mesh(file(BOX, "box.ply"), unit=unit)
    np.testing.assert_allclose(extents(box), metres * np.array([1, 2, 3]), rtol=1e-6)


def test_what_was_up_in_gltf_is_up_in_the_scene(file):
    upright = read_mesh(file(BOX, "box.glb"))
    np.testing.assert_allclose(extents(upright), (1, 3, 2), rtol=1e-6)
    as_it_lies = read_mesh(file(BOX, "box.glb"), up="z")
    np.testing.assert_allclose(extents(as_it_lies), (1, 2, 3), rtol=1e-6)
    tall = trimesh.creation.cone(radius=1.0, height=5.0)  # its tip along z of the file
    tall.apply_transform([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])  # now y
    cone = read_mesh(file(tall, "cone.glb"))
    tip = cone.vertices + cone.origin
    assert tip[tip[:, 2].argmax(), 2] == pytest.approx(5.0)


def test_an_object_is_scaled_turned_and_set_where_it_is_placed(file):
    path = file(BOX, "box.ply")
    placement = Placement((100.0, 200.0, 4e6), tuple(3 * about(2, math.pi / 2)), scale=10.0)
    box = read_mesh(path, unit="cm", placement=placement)
    np.testing.assert_allclose(extents(box), (0.2, 0.1, 0.3), rtol=1e-6)
    np.testing.assert_allclose(box.origin, (100, 200, 4e6))
    np.testing.assert_allclose(box.vertices.mean(axis=0), 0, atol=1e-9)


def test_the_parts_of_a_scene_stand_where_its_graph_puts_them(file):
    scene = trimesh.Scene()
    scene.add_geometry(BOX, transform=trimesh.transformations.translation_matrix((10, 0, 0)))
    mirror = np.diag([1.0, 1.0, -1.0, 1.0])
    mirror[:3, 3] = (-10, 0, 0)
    scene.add_geometry(BOX, transform=mirror)
    both = read_mesh(file(scene, "two.glb"), up="z")
    assert len(both.faces) == 24
    np.testing.assert_allclose(extents(both), (21, 2, 3), rtol=1e-6)
    assert volume(both) == pytest.approx(12, rel=1e-6)  # the mirrored one is not inside out


def test_faces_without_area_and_double_ones_are_reported_when_the_mesh_is_made(tmp_path):
    path = tmp_path / "dirty.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0\nf 1 2 3\nf 3 2 1\nf 2 2 3\nf 2 4 3\n")
    mesh, report = read_mesh(path).mesh()
    assert len(mesh.faces) == 2
    assert (report.duplicate, report.degenerate) == (1, 1)


def test_surfaces_that_cannot_be_are_refused():
    with pytest.raises(ValueError, match="reflectance"):
        Surface("shiny", 1.5)
    with pytest.raises(ValueError, match="roughness"):
        Surface("odd", 0.5, roughness=-1.0)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"unit": "seconds"}, "seconds"),
        ({"unit": "furlonks"}, "furlonks"),
        ({"up": "x"}, "vertical axis"),
        ({"placement": Placement(scale=0.0)}, "scaled by 0"),
        ({"placement": Placement(rotation=(0, 0, 0, 0))}, "no rotation"),
        ({"placement": Placement(translation=(0, math.nan, 0))}, "placed nowhere"),
    ],
)
def test_a_mesh_that_is_oddly_placed_is_refused_with_file_rule_and_remedy(file, options, said):
    path = file(BOX, "box.ply")
    with pytest.raises(SceneError, match=said) as refused:
        read_mesh(path, **options)
    assert str(path) in str(refused.value) and refused.value.remedy


def test_files_that_are_no_mesh_are_refused(tmp_path):
    for name, said in (
        ("a.stl", "no triangles|no mesh"),
        ("a.foo", "no mesh"),
        ("a.xyz", "no triangles|no mesh"),
    ):
        (tmp_path / name).write_text("0 0 0\n1 0 0\n0 1 0\n")
        with pytest.raises(SceneError, match=said):
            read_mesh(tmp_path / name)
    with pytest.raises(SceneError, match="does not exist"):
        read_mesh(tmp_path / "gone.stl")
