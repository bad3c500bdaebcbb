"""Polygons of mesh files: cut into triangles that cover just them, or refused by number."""

import base64
import json
import os
import struct

import numpy as np
import pytest
import trimesh
from facet_areas import triangle_areas
from matplotlib.path import Path as Outline

from sweep.scenes.meshes import MESH_FACES_MAX, read_mesh_facets
from sweep.scenes.polygons import PolygonError, Polygons, triangulate_polygons
from sweep.scenes.scene_files import SceneError

U = np.array([[0, 0], [3, 0], [3, 3], [2, 3], [2, 1], [1, 1], [1, 3], [0, 3]], float)
"""A U of eight corners: 3 x 3 with a notch of 1 x 2, an area of 7."""


def flat(outline, height=0.0):
    return np.column_stack([outline, np.broadcast_to(height, len(outline))])


def cut(points, *counts):
    return triangulate_polygons(
        Polygons(
            np.asarray(points, float), np.arange(len(points)), np.array(counts or [len(points)])
        )
    )


def write_obj(path, vertices, faces):
    lines = [f"v {x} {y} {z}" for x, y, z in vertices]
    lines += ["f " + " ".join(str(k + 1) for k in face) for face in faces]
    path.write_text("\n".join(lines) + "\n")


def write_off(path, vertices, faces):
    lines = ["OFF # a comment", f"{len(vertices)} {len(faces)} 0"]
    lines += [f"{x} {y} {z}" for x, y, z in vertices]
    lines += [" ".join(map(str, [len(face), *face])) + " 255 0 0" for face in faces]
    path.write_text("\n".join(lines) + "\n")


def write_ply(path, vertices, faces, order):
    kind = {"": "ascii", "<": "binary_little_endian", ">": "binary_big_endian"}[order]
    header = (
        f"ply\nformat {kind} 1.0\nelement vertex {len(vertices)}\nproperty double x\n"
        "property double y\nproperty double z\n"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\n"
        "property uchar red\nend_header\n"
    )
    if order:
        body = b"".join(struct.pack(f"{order}3d", *vertex) for vertex in vertices)
        body += b"".join(
            struct.pack(f"{order}B{len(face)}iB", len(face), *face, 9) for face in faces
        )
    else:
        lines = [" ".join(map(repr, map(float, vertex))) for vertex in vertices]
        lines += [" ".join(map(str, [len(face), *face, 9])) for face in faces]
        body = "".join(f"{line}\n" for line in lines).encode()
    path.write_bytes(header.encode() + body)


WRITERS = {
    "a.obj": write_obj,
    "a.off": write_off,
    "ascii.ply": lambda *mesh: write_ply(*mesh, ""),
    "little.ply": lambda *mesh: write_ply(*mesh, "<"),
    "big.ply": lambda *mesh: write_ply(*mesh, ">"),
}


@pytest.mark.parametrize("name", WRITERS)
def test_a_polygon_that_is_not_convex_covers_itself_and_not_its_notch(tmp_path, name):
    WRITERS[name](tmp_path / name, flat(U, 5.0), [list(range(8))])
    facets = read_mesh_facets(tmp_path / name)
    assert triangle_areas(facets.vertices, facets.faces).sum() == pytest.approx(7.0, rel=1e-12)
    corners = facets.vertices[facets.faces]
    inside = [Outline(corner[:, :2]).contains_point((1.5, 2.0)) for corner in corners]
    assert not any(inside)  # the middle of the notch
    up = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (up[:, 2] > 0).all()  # wound as the polygon is
    _, report = facets.to_cleaned_mesh()
    assert "1 polygon cut into triangles, 1 of them not convex" in report.summary()


@pytest.mark.parametrize("name", WRITERS)
def test_triangles_and_quads_mixed_read_the_same_in_every_format(tmp_path, name):
    box = trimesh.creation.box(extents=(1.0, 2.0, 3.0))
    corners = np.array(box.vertices)
    faces = [[0, 1, 3], [0, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4]]
    faces += [[1, 5, 7], [1, 7, 3]]
    WRITERS[name](tmp_path / name, corners, faces)
    facets = read_mesh_facets(tmp_path / name)
    expected = [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7]]
    expected += [[2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]
    assert facets.faces.tolist() == expected
    np.testing.assert_array_equal(facets.vertices, corners)
    assert "4 polygons cut into triangles; nothing to mend" in facets.to_cleaned_mesh()[1].summary()


@pytest.mark.parametrize("name", WRITERS)
def test_a_polygon_that_crosses_itself_is_refused_with_its_number(tmp_path, name):
    bow_tie = [[0, 0, 0], [2, 2, 0], [2, 0, 0], [0, 1, 0]]
    square = [[0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]]
    WRITERS[name](tmp_path / name, bow_tie + square, [[4, 5, 6, 7], [0, 1, 2, 3]])
    with pytest.raises(
        SceneError, match=r"face 2 of 4 corners crosses itself.*check it"
    ) as refused:
        read_mesh_facets(tmp_path / name)
    assert str(tmp_path / name) in str(refused.value)


@pytest.mark.parametrize(
    ("outline", "message"),
    [
        ([[0, 0], [1, 1], [1, 0], [0, 1]], "crosses itself"),  # the two lobes cancel
        ([[np.cos(0.8 * np.pi * k), np.sin(0.8 * np.pi * k)] for k in range(5)], "crosses itself"),
    ],
)
def test_stars_and_bow_ties_are_refused(outline, message):
    with pytest.raises(PolygonError, match=f"face 1 .*{message}"):
        cut(flat(outline))


def test_a_hole_has_to_be_gone_round_against_its_outline():
    """A square of 4 x 4 with a hole of 2 x 2, reached by a bridge."""
    outline = [[0, 0], [4, 0], [4, 4], [0, 4], [0, 0]]
    hole = [[1, 1], [1, 3], [3, 3], [3, 1], [1, 1]]
    points = flat(outline + hole)
    assert triangle_areas(points, cut(points).faces).sum() == pytest.approx(12.0, rel=1e-12)
    with pytest.raises(PolygonError, match="face 1 of 10 corners covers a part of its plane twice"):
        cut(flat(outline + hole[::-1]))
    turn = np.arange(40) * np.pi / 10
    spiral = np.column_stack([np.cos(turn), np.sin(turn)]) * (1 + turn / 100)[:, None]
    with pytest.raises(PolygonError, match="covers a part of its plane twice"):
        cut(flat(spiral))


def test_a_face_that_names_a_vertex_that_does_not_exist_is_refused_with_its_number(tmp_path):
    write_obj(tmp_path / "a.obj", flat(U), [[0, 1, 2], [0, 1, 2, 98]])
    with pytest.raises(SceneError, match="face 2 names the vertex 99 of 8"):
        read_mesh_facets(tmp_path / "a.obj")


def test_polygons_at_random_are_covered_once_and_nowhere_else():
    """Stars about a point are simple; points at random tell where their triangles lie."""
    random = np.random.default_rng(7)
    for _ in range(200):
        n = int(random.integers(4, 14))
        angle = np.sort(random.uniform(0, 2 * np.pi, n))
        if np.diff([*angle, angle[0] + 2 * np.pi]).max() > 3:
            continue
        radius = random.uniform(0.2, 1, n)
        outline = np.column_stack([radius * np.cos(angle), radius * np.sin(angle)])
        turn = np.linalg.qr(random.standard_normal((3, 3)))[0]
        result = cut(flat(outline) @ turn.T + random.uniform(-50, 50, 3))
        assert len(result.faces) == n - 2
        points = random.uniform(-1, 1, (200, 2))
        hits = sum(
            Outline(outline[face]).contains_points(points).astype(int) for face in result.faces
        )
        np.testing.assert_array_equal(hits, Outline(outline).contains_points(points))


def test_corners_in_line_stay_corners_so_that_neighbours_share_their_edges():
    outline = [[0, 0], [1, 0], [2, 0], [2, 1], [2, 2], [1, 2], [0, 2], [0, 1]]
    result = cut(flat(outline))
    assert sorted(set(result.faces.ravel().tolist())) == list(range(8))
    assert triangle_areas(flat(outline), result.faces).sum() == pytest.approx(4.0)
    edges = {tuple(edge) for face in result.faces for edge in (face[:2], face[1:], face[[2, 0]])}
    assert {(k, (k + 1) % 8) for k in range(8)} <= edges


def test_thousands_of_corners_in_line_are_cut_in_no_time():
    angle = np.linspace(0, 2 * np.pi, 10_000, endpoint=False)
    star = np.column_stack([np.cos(angle), np.sin(angle)]) * np.resize([1.0, 0.9], 10_000)[:, None]
    halved = np.empty((20_000, 2))
    halved[::2], halved[1::2] = star, (star + np.roll(star, -1, axis=0)) / 2
    result = cut(flat(halved))
    x, y = halved.T
    area = 0.5 * (x * np.roll(y, -1) - y * np.roll(x, -1)).sum()
    assert triangle_areas(flat(halved), result.faces).sum() == pytest.approx(area)
    assert len(result.faces) > 15_000


def test_corners_given_twice_spikes_and_bridged_holes_are_cut_as_they_should():
    twice = flat([[0, 0], [0, 0], [2, 0], [2, 0], [2, 2], [0, 2]])
    assert triangle_areas(twice, cut(twice).faces).sum() == pytest.approx(4.0)
    spike = flat([[0, 0], [2, 0], [2, 2], [3, 3], [2, 2], [0, 2]])
    assert triangle_areas(spike, cut(spike).faces).sum() == pytest.approx(4.0)
    hole = [[0, 0], [4, 0], [4, 4], [0, 4], [0, 0], [1, 1], [1, 2], [2, 2], [2, 1], [1, 1]]
    assert triangle_areas(flat(hole), cut(flat(hole)).faces).sum() == pytest.approx(15.0)


def test_polygons_without_area_or_data_are_dropped_and_counted(tmp_path):
    points = [*flat([[0, 0], [1, 0], [2, 0], [3, 0]]), *flat([[0, 0], [1, 0], [1, 1], [0, 1]], 1.0)]
    faces = [[0, 1, 2, 3], [4, 5, 6, 7], [0, 0, 1, 1], [4, 5]]
    write_obj(tmp_path / "a.obj", points, faces)
    mesh, report = read_mesh_facets(tmp_path / "a.obj").to_cleaned_mesh()
    assert len(mesh.faces) == 2 and report.n_degenerate_faces == 5
    points[0][0] = np.nan
    write_obj(tmp_path / "b.obj", points, faces[:2])
    mesh, report = read_mesh_facets(tmp_path / "b.obj").to_cleaned_mesh()
    assert (
        len(mesh.faces) == 2 and report.n_non_finite_faces == 2 and report.n_degenerate_faces == 0
    )


def test_bent_polygons_are_reported_and_those_bent_too_far_refused(tmp_path):
    quad = flat([[0, 0], [1, 0], [1, 1], [0, 1]], [0, 0.04, 0, 0.04])
    write_obj(tmp_path / "a.obj", quad, [[0, 1, 2, 3]])
    assert (
        "1 polygon departs from a plane by up to 0.02 units"
        in read_mesh_facets(tmp_path / "a.obj").to_cleaned_mesh()[1].summary()
    )
    with pytest.raises(PolygonError, match="face 1 is bent by 35 % of its size"):
        cut(flat([[0, 0], [1, 0], [1, 1], [0, 1]], [0, 0.7, 0, 0.7]))


def test_a_mesh_of_polygons_alone_needs_no_materials_and_opens_no_pipe(tmp_path):
    os.mkfifo(tmp_path / "pipe.mtl")
    path = tmp_path / "a.obj"
    path.write_text(
        "mtllib pipe.mtl\nusemtl red\nv 0 0 0\nv 1 0 0 # corner\nv 1 1 0\nv 0 1 0\n"
        "f -4 -3/1/1 \\\n-2//3 -1\n"
    )
    assert read_mesh_facets(path).faces.tolist() == [[0, 1, 2], [0, 2, 3]]


def gltf(path, *, uri=None, accessor=None, nodes=None, images=()):
    """A triangle as a glTF; its buffer, accessor of positions, nodes and images as given."""
    content = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "<f4").tobytes()
    data = "data:application/octet-stream;base64," + base64.b64encode(content).decode()
    position = {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}
    document = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": nodes or [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "material": 0}]}],
        "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
        "textures": [{"source": 0}],
        "images": [{"uri": image} for image in images],
        "accessors": [accessor or position],
        "bufferViews": [{"buffer": 0, "byteLength": len(content)}],
        "buffers": [{"byteLength": len(content), "uri": uri or data}],
    }
    path.write_text(json.dumps(document))
    return path


def test_a_gltf_reads_plain_files_alone_and_no_pictures(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    path = tmp_path / "a.gltf"
    assert len(read_mesh_facets(gltf(path, images=["pipe"])).faces) == 1
    for uri, message in (("pipe", "pipe or a device"), ("/dev/zero", "pipe or a device")):
        with pytest.raises(SceneError, match=message):
            read_mesh_facets(gltf(path, uri=uri))


def test_declared_sizes_are_looked_at_before_anything_is_read(tmp_path, monkeypatch):
    huge = {"componentType": 5126, "count": 10**11, "type": "VEC3"}
    with pytest.raises(SceneError, match="100,000,000,000 elements in 36 bytes"):
        read_mesh_facets(gltf(tmp_path / "a.gltf", accessor=huge))
    header = "ply\nformat binary_little_endian 1.0\nelement vertex 1000000000000\n"
    (tmp_path / "a.ply").write_text(header + "property float x\nend_header\n")
    with pytest.raises(SceneError, match="declares 1,000,000,000,000 vertices"):
        read_mesh_facets(tmp_path / "a.ply")
    (tmp_path / "a.off").write_text("OFF\n1000000000000 1 0\n0 0 0\n")
    with pytest.raises(SceneError, match="ends after 1 of 1,000,000,000,000 vertices"):
        read_mesh_facets(tmp_path / "a.off")
    monkeypatch.setattr("sweep.scenes.meshes.MESH_FACES_MAX", 10)
    assert MESH_FACES_MAX == 100_000_000
    nodes = [{"children": list(range(1, 21))}, *[{"mesh": 0}] * 20]
    with pytest.raises(SceneError, match="make 20 triangles"):
        read_mesh_facets(gltf(tmp_path / "many.gltf", nodes=nodes))


@pytest.mark.parametrize("name", ["a.zip", "a.tar.gz", "a.bz2", "a.3mf", "a.dae", "a.dxf", "a"])
def test_archives_and_formats_that_are_not_read_are_refused_unread(tmp_path, name):
    (tmp_path / name).write_bytes(b"PK\3\4")
    with pytest.raises(SceneError, match=r"no mesh of a format that is read \(.stl, .obj"):
        read_mesh_facets(tmp_path / name)


def test_a_mesh_larger_than_the_memory_is_refused_before_it_is_read(tmp_path, monkeypatch):
    write_obj(tmp_path / "a.obj", flat(U), [list(range(8))])
    monkeypatch.setattr("psutil.virtual_memory", lambda: type("M", (), {"available": 100}))
    with pytest.raises(SceneError, match=r"GB of memory, of which .* free; reduce the mesh"):
        read_mesh_facets(tmp_path / "a.obj")


@pytest.mark.parametrize("place", [-3.4e38, 1e30, 2e9])
def test_a_vertex_too_far_off_to_compute_with_is_refused(tmp_path, place):
    write_obj(tmp_path / "a.obj", [[0, 0, 0], [1, 0, 0], [0, 1, place]], [[0, 1, 2]])
    with pytest.raises(ValueError, match="farther than 1e"):
        read_mesh_facets(tmp_path / "a.obj").to_cleaned_mesh()
