"""Cache of built scenes: a large elevation model takes longer to build than to read.

A file holds the bodies of a scene with their box trees. Its name is a digest of everything that
determines them: the spec's scene and platform, the content of the files that these name, the
sources of this package, and the versions of the libraries that build scenes.

    BASE/sweep-scenes-UID/DIGEST

BASE is the folder that holds the compiled kernels (:mod:`sweep.kernel_cache`). A file is read by
`pickle`, which can execute code, so the folder is used only if no other user can write to it. A
file that is damaged counts as absent. Anyone may delete the files at any time.
"""

from __future__ import annotations

import hashlib
import logging
import os
import pickle
import platform
import tempfile
import time
import zlib
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from sweep.spec.fields import identity_digest

if TYPE_CHECKING:
    from sweep.spec import SceneSpec
    from sweep.spec.scene_sections import BuiltScene

CACHED_BUILD_SECONDS_MIN = 1.0
"""Processor time that building a scene must take at least for the scene to be cached [s]."""

CACHE_BYTES_MAX = 2 << 30
"""Largest size of all cached scenes together [bytes].

Beyond this size the least recently used scenes are deleted.
"""

DRAFT_AGE_MAX = 86400.0
"""Largest age of an unfinished file in the cache [s].

An older file is deleted, because the process that wrote it must have died.
"""

SCENE_BUILDING_LIBRARIES = (
    "numpy", "scipy", "trimesh", "rasterio", "pyproj", "pillow", "matplotlib", "pint",
)  # fmt: skip
"""Names of the libraries whose version may change the arrays of a scene."""

_DRAFT_PREFIX = "draft-"
"""Beginning of the names of unfinished files."""
_HEADER_BYTES = 8
"""Size of the header of a cached file [bytes].

The header is the CRC-32 of the rest of the file, as hexadecimal digits.
"""
_READ_BUFFER_BYTES = 1 << 20
"""Number of bytes of a file that are read at once."""

_log = logging.getLogger("sweep")


def load_or_build_scene(spec: SceneSpec, build: Callable[[], BuiltScene]) -> BuiltScene:
    """Return the scene of a spec: read it from the cache, or build it.

    A newly built scene is cached if building took `CACHED_BUILD_SECONDS_MIN` or longer.

    Parameters
    ----------
    spec
        Spec of a flight.
    build
        Function that builds the scene.

    Returns
    -------
    BuiltScene
        The scene. Its arrays have the same bits, whether it was built or read.
    """
    root, digest = _cache_root(), _scene_digest(spec)
    path = None if root is None or digest is None else root / digest
    if path is not None and (cached_scene := _read_scene(path)) is not None:
        return cached_scene
    start = time.thread_time()
    scene = build()
    if path is not None and time.thread_time() - start >= CACHED_BUILD_SECONDS_MIN:
        _write_scene(path, scene)
    return scene


@cache
def _cache_root() -> Path | None:
    """Return the folder of cached scenes, which lies beside the folder of compiled kernels.

    The result is None if no such folder can be made.
    """
    from sweep.kernel_cache import cache_folder, create_private_folder  # imports the compiler

    kernel_folder = cache_folder().path
    if kernel_folder is None:
        return None
    root = kernel_folder.parent.with_name(f"sweep-scenes-{os.getuid()}")
    try:
        create_private_folder(root)
    except OSError as error:
        _log.info("built scenes are not cached: %s", error)
        return None
    return root


def _scene_digest(spec: SceneSpec) -> str | None:
    """Return a digest of everything that determines the arrays and reports of a scene.

    The result is None if the sources can't be read.
    """
    source_digest = _source_digest()
    if source_digest is None:
        return None
    identity = spec.identity()
    parts = {name: identity[name] for name in ("objects", "scene", "platform")}
    versions = [source_digest, *_library_versions(), platform.python_version()]
    return identity_digest(parts | {"versions": versions})


@cache
def _source_digest() -> str | None:
    """Return a digest of the package's source files; None if a file can't be read."""
    package_dir = Path(__file__).parents[2]
    digest = hashlib.sha256()
    try:
        for path in sorted(package_dir.rglob("*.py")):
            content = path.read_bytes()
            digest.update(f"{path.relative_to(package_dir)}\0{len(content)}\0".encode())
            digest.update(content)
    except OSError as error:
        _log.info("built scenes are not cached: %s", error)
        return None
    return digest.hexdigest()


@cache
def _library_versions() -> tuple[str, ...]:
    """Return the versions of the libraries that read and build scenes; "" for a missing library."""
    versions = []
    for name in SCENE_BUILDING_LIBRARIES:
        try:
            versions.append(version(name))
        except PackageNotFoundError:
            versions.append("")
    return tuple(versions)


class _ChecksumWriter:
    """Binary file that computes the CRC-32 of what is written to it."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file, self.checksum = file, 0

    def write(self, data: Any) -> int:
        """Write bytes, or an object with a buffer of bytes. Return the number of bytes written."""
        self.checksum = zlib.crc32(data, self.checksum)
        return self._file.write(data)


def _read_scene(path: Path) -> BuiltScene | None:
    """Return the scene in a cached file; None if the file is absent, damaged or unreadable."""
    try:
        with path.open("rb") as file:
            expected_checksum, checksum = int(file.read(_HEADER_BYTES), 16), 0
            while data := file.read(_READ_BUFFER_BYTES):
                checksum = zlib.crc32(data, checksum)
            if checksum != expected_checksum:
                return None
            file.seek(_HEADER_BYTES)
            scene: BuiltScene = pickle.load(file)
    except Exception:  # unpickling bytes of another version may raise any exception
        return None
    with suppress(OSError):
        os.utime(path)  # the least recently used files are deleted first
    return scene


def _write_scene(path: Path, scene: BuiltScene) -> None:
    """Write a scene to a cache file at `path`: first to a draft, which is renamed when complete.

    A failure leaves no file behind. A scene larger than CACHE_BYTES_MAX is not written.
    """
    draft = None
    if scene.caster.nbytes > CACHE_BYTES_MAX:
        return
    try:
        with tempfile.NamedTemporaryFile(
            dir=path.parent, prefix=_DRAFT_PREFIX, delete=False
        ) as file:
            draft = Path(file.name)
            file.write(b"0" * _HEADER_BYTES)
            writer = _ChecksumWriter(file)
            pickle.dump(scene, writer, protocol=5)
            file.seek(0)
            file.write(f"{writer.checksum:0{_HEADER_BYTES}x}".encode())
        os.replace(draft, path)
    except BaseException as error:  # a full disk, an object that can't be pickled, or Ctrl-C
        if draft is not None:
            draft.unlink(missing_ok=True)
        if not isinstance(error, Exception):
            raise
        _log.info("a built scene is not cached: %s", error)
    else:
        _delete_least_recently_used(path.parent)


def _delete_least_recently_used(root: Path) -> None:
    """Delete old drafts, and the least recently used scenes beyond the size limit.

    The limits are `DRAFT_AGE_MAX` and `CACHE_BYTES_MAX`.
    """
    with suppress(OSError):
        statuses = sorted(
            ((path.stat(), path) for path in root.iterdir()), key=lambda pair: -pair[0].st_mtime
        )
        total_bytes = 0
        for status, path in statuses:
            is_draft = path.name.startswith(_DRAFT_PREFIX)
            is_abandoned = is_draft and time.time() - status.st_mtime > DRAFT_AGE_MAX
            is_beyond_limit = not is_draft and total_bytes + status.st_size > CACHE_BYTES_MAX
            if is_abandoned or is_beyond_limit:
                path.unlink(missing_ok=True)
            elif not is_draft:
                total_bytes += status.st_size
