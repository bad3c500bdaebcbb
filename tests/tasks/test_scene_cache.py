"""Cache of built scenes: the same arrays, whatever becomes of its files."""

import os
import time

import numpy as np
import pytest
from small_flights import small_scene_spec

from sweep.tasks.studies import scene_cache
from sweep.tasks.studies.scene_cache import load_or_build_scene


@pytest.fixture
def root(tmp_path, monkeypatch):
    monkeypatch.setattr(scene_cache, "_cache_root", lambda: tmp_path)
    monkeypatch.setattr(scene_cache, "CACHED_BUILD_SECONDS_MIN", 0.0)
    return tmp_path


class CountedBuild:
    """Function that builds the scene of a spec, and counts how often."""

    def __init__(self, spec):
        self.spec, self.count = spec, 0

    def __call__(self):
        self.count += 1
        return self.spec.build_scene()


def scene_arrays(scene):
    rays = np.random.default_rng(1).normal(size=(200, 1, 3)) * [0.3, 0.3, 0.0] + [0, 0, -1.0]
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    hits = scene.caster.cast_bundles(np.full((200, 3), [0.0, 0.0, 500.0]), rays)
    meshes = [
        values
        for mesh in scene.caster.meshes
        for values in (mesh.vertices, mesh.faces, mesh.origin)
    ]
    return [*meshes, scene.origin, hits.range, hits.face_index]


def assert_same_scene(scene, other):
    for values, other_values in zip(scene_arrays(scene), scene_arrays(other), strict=True):
        assert values.dtype == other_values.dtype
        for flag in ("C_CONTIGUOUS", "WRITEABLE", "ALIGNED"):  # what kernels are compiled for
            assert values.flags[flag] == other_values.flags[flag]
        np.testing.assert_array_equal(values, other_values)
    assert (
        scene.mesh_reports == other.mesh_reports
        and scene.surface_materials == other.surface_materials
    )


def test_a_cached_scene_has_the_arrays_of_a_built_one(root):
    spec = small_scene_spec()
    build = CountedBuild(spec)
    built, read = load_or_build_scene(spec, build), load_or_build_scene(spec, build)
    assert build.count == 1 and len(list(root.iterdir())) == 1
    assert_same_scene(built, read)


@pytest.mark.parametrize(
    "damage",
    [
        lambda data: b"",
        lambda data: data[: len(data) // 2],
        lambda data: data[:3000] + bytes([data[3000] ^ 1]) + data[3001:],
        lambda data: b"no header" + data,
    ],
)
def test_a_damaged_file_is_built_again(root, damage):
    spec = small_scene_spec()
    build = CountedBuild(spec)
    built = load_or_build_scene(spec, build)
    (path,) = root.iterdir()
    content = path.read_bytes()
    path.write_bytes(damage(content))
    assert_same_scene(built, load_or_build_scene(spec, build))
    assert build.count == 2 and path.read_bytes() == content
    load_or_build_scene(spec, build)
    assert build.count == 2


def test_another_scene_or_other_sources_have_another_file(root, monkeypatch):
    spec = small_scene_spec()
    build = CountedBuild(spec)
    load_or_build_scene(spec, build)
    monkeypatch.setattr(scene_cache, "_source_digest", lambda: "other sources")
    load_or_build_scene(spec, build)
    assert build.count == 2 and len(list(root.iterdir())) == 2


def test_a_scene_that_is_built_at_once_is_not_cached(root, monkeypatch):
    monkeypatch.setattr(scene_cache, "CACHED_BUILD_SECONDS_MIN", 60.0)
    spec = small_scene_spec()
    load_or_build_scene(spec, spec.build_scene)
    assert not list(root.iterdir())


def test_scenes_unused_for_longest_go_first_and_so_do_drafts_of_the_dead(root, monkeypatch):
    spec = small_scene_spec()
    now = time.time()
    for name, age in (("old", 300), ("older", 400), ("draft-dead", 2 * 86400), ("draft-live", 5)):
        (root / name).write_bytes(bytes(1000))
        os.utime(root / name, (now - age, now - age))
    load_or_build_scene(spec, spec.build_scene)
    names = {path.name for path in root.iterdir()}
    assert {"old", "older", "draft-live"} < names and "draft-dead" not in names
    (new_name,) = names - {"old", "older", "draft-live"}
    monkeypatch.setattr(scene_cache, "CACHE_BYTES_MAX", (root / new_name).stat().st_size + 1500)
    scene_cache._delete_least_recently_used(root)
    assert {path.name for path in root.iterdir()} == {new_name, "old", "draft-live"}


def test_a_scene_beyond_the_limit_is_not_written_and_deletes_no_other(root, monkeypatch):
    spec = small_scene_spec()
    (root / "other").write_bytes(b"x" * 100)
    monkeypatch.setattr(scene_cache, "CACHE_BYTES_MAX", 1000)
    build = CountedBuild(spec)
    load_or_build_scene(spec, build)
    assert build.count == 1 and [path.name for path in root.iterdir()] == ["other"]
    (root / "new").write_bytes(b"x" * 2000)
    scene_cache._delete_least_recently_used(root)
    assert [path.name for path in root.iterdir()] == ["other"]


def test_sources_that_can_not_be_read_only_cost_time(root, monkeypatch):
    monkeypatch.setattr(scene_cache, "_source_digest", lambda: None)
    build = CountedBuild(small_scene_spec())
    load_or_build_scene(build.spec, build)
    assert build.count == 1 and not list(root.iterdir())


def test_other_versions_of_libraries_build_again(root, monkeypatch):
    build = CountedBuild(small_scene_spec())
    load_or_build_scene(build.spec, build)
    monkeypatch.setattr(scene_cache, "_library_versions", lambda: ("0",))
    load_or_build_scene(build.spec, build)
    assert build.count == 2


def test_a_folder_that_can_not_be_written_only_costs_time(root, monkeypatch):
    def refuse(*arguments, **named):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(scene_cache.pickle, "dump", refuse)
    spec = small_scene_spec()
    build = CountedBuild(spec)
    load_or_build_scene(spec, build)
    load_or_build_scene(spec, build)
    assert build.count == 2 and not list(root.iterdir())
