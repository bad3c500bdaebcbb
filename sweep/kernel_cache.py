"""Compilation of numba kernels, and the folder in which compiled kernels are cached.

The code of a compiled kernel contains the kernels that it calls and the constants that it reads.
Numba's cache checks only the file of the kernel itself. After a change of another file it would
continue with outdated code. Kernels are therefore cached in a folder named by a fingerprint. The
fingerprint covers all files of the model, and the libraries and settings that compile them:

    BASE/sweep-kernels-UID/FINGERPRINT

BASE is `NUMBA_CACHE_DIR` if it is set, else the user's cache directory, else the directory for
temporary files. Compiled kernels are executable code, so the folder is used only if no other user
can write to it.

Anyone may delete the folder at any time: kernels are then compiled again. Folders of other
fingerprints are deleted once no process has used them for a month.
"""

from __future__ import annotations

import errno
import hashlib
import logging
import os
import re
import shutil
import stat
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import llvmlite
import numba
import numpy as np
from numba import types
from numba.core.caching import FunctionCache
from numba.core.dispatcher import Dispatcher
from numba.core.sigutils import normalize_signature
from numba.extending import intrinsic
from platformdirs import user_cache_dir

UNUSED_CACHE_AGE_MAX = 30 * 86400.0
"""Time without use [s] after which another fingerprint's folder of compiled kernels is deleted."""

USE_DATE_RENEWAL_INTERVAL = 86400.0
"""Age [s] of a cache folder's modification time above which a process that uses it renews the time.
"""

NUMBA_SETTINGS_OUTSIDE_FINGERPRINT = ("NUMBA_CACHE_DIR", "NUMBA_NUM_THREADS")
"""Names of numba settings that do not change compiled code. The cache's fingerprint omits them."""

DEFAULT_NJIT_OPTIONS = {"nogil": True, "no_cfunc_wrapper": True}
"""Default options of `numba.njit` for all kernels; a kernel's own options override them."""

_numba_settings: Any = numba.config
_MODEL_DIR = Path(__file__).parent / "model"
_FINGERPRINT_PATTERN = re.compile("[0-9a-f]{32}")

_log = logging.getLogger("sweep")
_declaration_lock = threading.RLock()


class CacheFolder(NamedTuple):
    """Folder in which this process caches compiled kernels."""

    path: Path | None
    """Folder of compiled kernels; None if kernels are not cached."""
    not_cached_reason: str = ""
    """Why kernels are not cached; empty if they are."""


class _CacheState:
    """Flags of this process: whether it may still read and write the kernel cache."""

    can_read = True
    """True until a model file changes after the fingerprint was computed."""
    can_write = True
    """True until a model file changes, or writing to the cache folder fails."""


def njit(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Compile a function as `numba.njit` does, and cache it by the fingerprint of the model.

    A kernel may read only constants, and call only kernels, of its own file and of the model: the
    cache does not notice changes of other files. A kernel releases the global interpreter lock, so
    that signals are handled and workers respond while it runs.

    Parameters
    ----------
    **options
        Options of `numba.njit`, and `borrows`. `borrows=True` declares that the kernel neither
        creates nor returns arrays. The kernel then skips reference counting of the arrays in its
        arguments. Counting takes most of the time of a short kernel that receives records of
        arrays. Creating or returning an array in such a kernel is a compilation error.
        `forceinline=True`, numba's own, compiles a kernel into those that call it. A call copies
        every array of its records to the stack, which takes most of the time of a loop over draws.

    Returns
    -------
    callable
        Decorator that returns the compiled kernel.

    Examples
    --------
    >>> @njit(cache=True, error_model="numpy")
    ... def halve(x):
    ...     return x / 2
    >>> halve(3)
    1.5
    """
    is_cached, borrows = options.pop("cache", False), options.pop("borrows", False)
    # Reference counting (NRT) has no public option in numba. A kernel without an explicit value
    # inherits that of the kernel that calls it.
    options["_nrt"] = not borrows
    options.setdefault("forceinline", False)  # likewise

    def declare(function: Callable[..., Any]) -> Any:
        kernel = numba.njit(**(DEFAULT_NJIT_OPTIONS | options))(function)
        if is_cached and isinstance(kernel, Dispatcher):  # no Dispatcher: NUMBA_DISABLE_JIT is set
            _enable_cache(kernel, borrows)
        return kernel

    return declare


class KernelCache(FunctionCache):
    """Cache of one kernel's compiled code; its failures never stop a computation.

    A file that is damaged, truncated or unreadable counts as absent.
    """

    borrows_arrays = False
    """True if the kernel was declared, by `njit`, to neither create nor return arrays."""

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return the kernel compiled for the signature `sig`, or None if the cache has none."""
        if not _CacheState.can_read:
            return None
        if _had_changed_at_first_load():
            _CacheState.can_read = _CacheState.can_write = False
            return None
        try:
            result = super().load_overload(sig, target_context)
        except Exception:  # unpickling damaged bytes may raise any exception
            return None
        # Two processes that save different signatures at once may use the same file name.
        if result is None or tuple(result.signature.args) != tuple(normalize_signature(sig)[0]):
            return None
        _renew_use_date(Path(self.cache_path).parent)
        return result

    def save_overload(self, sig: Any, data: Any) -> None:
        """Save the compiled kernel `data` of the signature `sig`; log one warning if that fails."""
        if self.borrows_arrays and _holds_arrays(data.signature.return_type):
            name = data.fndesc.qualname
            raise TypeError(f"{name} borrows arrays, and returns {data.signature.return_type}")
        if not _CacheState.can_write:
            return
        if _any_file_has_changed():  # compiled-in constants may come from another file version
            _CacheState.can_write = False
            return
        folder = Path(self.cache_path).parent
        try:
            try:
                super().save_overload(sig, data)
            except FileNotFoundError:  # the folder was deleted meanwhile: numba creates it again
                super().save_overload(sig, data)
            except OSError:
                raise
            except Exception:  # unpickling a damaged index may raise any exception
                self.flush()
                super().save_overload(sig, data)
        except OSError as error:
            _CacheState.can_write = False
            _warn_not_cached(f"{folder} can't be written ({error.strerror or error})")
        else:
            _renew_use_date(folder)
            _remove_unused_caches(folder)


def is_compiled(kernel: Any) -> bool:
    """Return True if a kernel is compiled for at least one signature, in memory or in the cache."""
    if not isinstance(kernel, Dispatcher) or kernel.signatures:
        return True  # no Dispatcher: NUMBA_DISABLE_JIT is set, and nothing is compiled
    cache_path, name = kernel.stats.cache_path, kernel.py_func.__name__
    return cache_path is not None and any(Path(cache_path).glob(f"*.{name}-*.nbi"))


def _holds_arrays(kind: Any) -> bool:
    """Return True if a numba type is an array type, or a tuple type that contains an array type."""
    parts = getattr(kind, "types", ())  # member types of a tuple
    return isinstance(kind, types.Array) or any(map(_holds_arrays, parts))


def _enable_cache(kernel: Any, borrows: bool) -> None:
    """Let numba cache a kernel in this process's cache folder; do nothing if no folder can be used.

    `borrows` declares that the kernel neither creates nor returns arrays.
    """
    folder = cache_folder()
    if folder.path is None:
        _warn_not_cached(folder.not_cached_reason)
        return
    if _file_has_changed(kernel.py_func.__code__.co_filename):
        # This process has loaded modules of different versions: no fingerprint describes them.
        _CacheState.can_read = _CacheState.can_write = False
    with _declaration_lock, _numba_cache_dir(str(folder.path)):
        try:
            kernel_cache = KernelCache(kernel.py_func)
        except RuntimeError:  # numba found no writable cache folder for this file
            return
    kernel_cache.borrows_arrays = borrows
    if folder.path in Path(kernel_cache.cache_path).parents:
        # Numba's `enable_caching` sets the same attribute to its own cache class. Numba has no
        # public way to set another class. Its own class raises on a damaged file, and may load
        # a file that was compiled for another signature.
        kernel._cache = kernel_cache


@contextmanager
def _numba_cache_dir(path: str) -> Iterator[None]:
    """Context manager that sets numba's cache folder to `path`, and restores the former at its end.

    A kernel that is declared inside is cached in `path`.
    """
    previous_dir = _numba_settings.CACHE_DIR
    _numba_settings.CACHE_DIR = path
    try:
        yield
    finally:
        _numba_settings.CACHE_DIR = previous_dir


@cache
def cache_folder() -> CacheFolder:
    """Return the folder in which this process caches compiled kernels, as a :class:`CacheFolder`.

    Three base directories are tried: `NUMBA_CACHE_DIR`, the user's cache directory, and the
    directory for temporary files. The first one that can hold a private folder is used. If none
    can, `path` is None and `not_cached_reason` says why.
    """
    with _declaration_lock:
        if not (fingerprint := _model_fingerprint()):
            return CacheFolder(None, "the sources of the model are not files")
        reasons = []
        for find_base in (_configured_cache_base, user_cache_dir, tempfile.gettempdir):
            try:
                base = find_base()
                if os.path.isabs(base):  # without a home directory, user_cache_dir is relative
                    root = Path(base) / f"sweep-kernels-{os.getuid()}"
                    create_private_folder(root)
                    _log.info("compiled kernels are kept in %s", root / fingerprint)
                    return CacheFolder(root / fingerprint)
            except OSError as error:
                reasons.append(
                    f"{error.filename}: {error.strerror}"
                    if error.filename
                    else error.strerror or str(error)
                )
            except RuntimeError as error:  # no home directory: neither $HOME nor the uid has one
                reasons.append(str(error))
        return CacheFolder(None, "; ".join(reasons))


def _configured_cache_base() -> str:
    """Return the setting `NUMBA_CACHE_DIR` as an absolute path; '' if it is not set."""
    cache_dir = _numba_settings.CACHE_DIR
    return os.path.abspath(cache_dir) if cache_dir else ""


def create_private_folder(root: Path) -> None:
    """Create a folder that no other user can write to; raise OSError if that is impossible.

    An existing folder is accepted if no other user can write to it.
    """
    root.parent.mkdir(parents=True, exist_ok=True)
    with suppress(FileExistsError):
        root.mkdir(mode=0o700)
    status = root.lstat()
    if (
        not stat.S_ISDIR(status.st_mode)
        or status.st_uid != os.getuid()
        or status.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
    ):
        raise PermissionError(errno.EPERM, "others can write there", str(root))
    tempfile.TemporaryFile(dir=root).close()


@cache
def _model_file_stats() -> dict[str, tuple[str, int, int]]:
    """Return (name, size [bytes], modification time [ns]) of each model file, by its full path."""
    return {
        str(path): (path.relative_to(_MODEL_DIR).as_posix(), status.st_size, status.st_mtime_ns)
        for path in sorted(_MODEL_DIR.rglob("*.py"))
        for status in [path.stat()]
    }


@cache
def _model_fingerprint() -> str:
    """Return a digest of all that determines compiled kernels: model files, libraries and settings.

    The digest is '' if the model has no source files.
    """
    digest = hashlib.sha256()
    parts = [numba.__version__, llvmlite.__version__, np.__version__, repr(DEFAULT_NJIT_OPTIONS)]
    parts += [
        f"{name}={value}"
        for name, value in sorted(os.environ.items())
        if name.startswith("NUMBA_") and name not in NUMBA_SETTINGS_OUTSIDE_FINGERPRINT
    ]
    digest.update(repr(parts).encode())
    for path, (name, *_) in _model_file_stats().items():
        content = Path(path).read_bytes()
        digest.update(f"{name}\0{len(content)}\0".encode())
        digest.update(content)
    return digest.hexdigest()[:32] if _model_file_stats() else ""


def _file_has_changed(path: str) -> bool:
    """Return True if the model file at `path` has changed since the fingerprint was computed.

    The result is False for a file outside the model.
    """
    if (fingerprinted := _model_file_stats().get(path)) is None:
        return False
    try:
        status = os.stat(path)
    except OSError:
        return True
    return fingerprinted[1:] != (status.st_size, status.st_mtime_ns)


def _any_file_has_changed() -> bool:
    """Return True if at least one model file has changed since the fingerprint was computed."""
    return any(map(_file_has_changed, _model_file_stats()))


@cache
def _had_changed_at_first_load() -> bool:
    """Return whether a model file had changed by the time this process first loaded a kernel.

    The files are checked once; later calls repeat the first result.
    """
    return _any_file_has_changed()


@cache
def _renew_use_date(folder: Path) -> None:
    """Set a cache folder's modification time to now, so that no process deletes it as unused.

    A process does this once for each folder.
    """
    with suppress(OSError):
        if time.time() - folder.stat().st_mtime > USE_DATE_RENEWAL_INTERVAL:
            os.utime(folder)


@cache
def _remove_unused_caches(used_folder: Path) -> None:
    """Delete cache folders of other fingerprints that were not used for a month; once per process.

    `used_folder` is this process's cache folder, which is kept. A process that still uses a deleted
    folder has its kernels in memory, or compiles them again.
    """
    with suppress(OSError):
        folders = {
            path
            for path in used_folder.parent.iterdir()
            if _FINGERPRINT_PATTERN.fullmatch(path.name)
        }
        for folder in folders - {used_folder}:
            if time.time() - folder.stat().st_mtime > UNUSED_CACHE_AGE_MAX:
                shutil.rmtree(folder, ignore_errors=True)


@cache
def _warn_not_cached(reason: str) -> None:
    """Log a warning, with `reason` and remedy, that every process compiles its kernels anew."""
    _log.warning(
        "compiled kernels are not cached, so that each start takes a minute more: %s. "
        "NUMBA_CACHE_DIR names another folder for them, of your own and with room",
        reason,
    )


@intrinsic
def multiply_high(typing_context, a, b):
    """Return the upper 64 bits of the 128-bit product of two unsigned 64-bit integers.

    The product compiles to one machine instruction.
    """

    def generate(context, builder, signature, factors):
        from llvmlite import ir

        wide, word = ir.IntType(128), ir.IntType(64)
        one, other = (builder.zext(factor, wide) for factor in factors)
        shifted = builder.lshr(builder.mul(one, other), ir.Constant(wide, 64))
        return builder.trunc(shifted, word)

    return types.uint64(types.uint64, types.uint64), generate
