"""Compilation of kernels by numba, and the folder in which compiled kernels are cached.

A compiled kernel has the kernels that it calls built in, and the constants that it reads. The cache
of numba looks at the file of the kernel alone, and would go on with old code after a change of
another file. Kernels are therefore cached in a folder named by a fingerprint of all files of the
model, and of the libraries and settings that compile them:

    BASE/sweep-kernels-UID/FINGERPRINT

BASE is `NUMBA_CACHE_DIR` if it is set, else the user's cache, else the folder for temporary files.
Compiled kernels are code that is run: the folder is used only if nobody else can write to it.

The folder may be removed at any time, by whomever: kernels are compiled again. Folders of other
fingerprints are removed once no process has used them for a month.
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

#: Time without any use after which the kernels of another fingerprint are removed [s].
UNUSED_CACHE_AGE_MAX = 30 * 86400.0

#: Time after which the date of use of a folder is renewed [s].
USE_DATE_RENEWAL_INTERVAL = 86400.0

#: Settings of numba that have no part in the code that it compiles.
NUMBA_SETTINGS_WITHOUT_EFFECT = ("NUMBA_CACHE_DIR", "NUMBA_NUM_THREADS")

#: Options of numba that kernels have unless they say otherwise.
DEFAULT_NJIT_OPTIONS = {"nogil": True}

_numba_settings: Any = numba.config
_MODEL_DIR = Path(__file__).parent / "model"
_FINGERPRINT_PATTERN = re.compile("[0-9a-f]{32}")

_log = logging.getLogger("sweep")
_declaration_lock = threading.RLock()


class CacheFolder(NamedTuple):
    """Folder in which this process caches kernels."""

    path: Path | None  # None where kernels are not cached
    reason: str = ""  # why they are not cached


class _CacheState:
    """State of the kernel cache of this process."""

    can_read = True  # False once a file of the model has changed since it was fingerprinted
    can_write = True


def njit(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Compile a function as `numba.njit` does, and cache it by the fingerprint of the model.

    A kernel may read constants and call kernels of its own file and of the model, and no others:
    the cache does not notice changes of other files. A kernel releases the interpreter's lock, so
    that signals are seen and workers answer while it runs.

    Parameters
    ----------
    **options
        Those of `numba.njit`, and `borrows`: true of a kernel that neither makes arrays nor returns
        any. It then counts no references to the arrays of its arguments, which else takes most of
        the time of a short kernel that is handed records of arrays. An array that is made in it
        or returned is an error of compilation.

    Examples
    --------
    >>> @njit(cache=True, error_model="numpy")
    ... def halve(x):
    ...     return x / 2
    >>> halve(3)
    1.5
    """
    is_cached, borrows = options.pop("cache", False), options.pop("borrows", False)
    # Numba has no public name for it. Unless it is said, a kernel has it from the one that calls.
    options["_nrt"] = not borrows

    def declare(function: Callable[..., Any]) -> Any:
        kernel = numba.njit(**(DEFAULT_NJIT_OPTIONS | options))(function)
        if is_cached and isinstance(kernel, Dispatcher):  # else compilation is disabled
            _enable_cache(kernel, borrows)
        return kernel

    return declare


class KernelCache(FunctionCache):
    """Cache of a kernel, without which computing goes on.

    A file that is damaged, cut short or out of reach counts as absent.
    """

    borrows = False

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return the kernel compiled for a signature, or None."""
        if not _CacheState.can_read:
            return None
        if _had_changed_at_first_load():
            _CacheState.can_read = _CacheState.can_write = False
            return None
        try:
            result = super().load_overload(sig, target_context)
        except Exception:  # whatever unpickling of damaged bytes raises
            return None
        # Two processes that save different signatures at once may take the same file for them.
        if result is None or tuple(result.signature.args) != tuple(normalize_signature(sig)[0]):
            return None
        _renew_use_date(Path(self.cache_path).parent)
        return result

    def save_overload(self, sig: Any, data: Any) -> None:
        """Save a compiled kernel; log once where that can't be done."""
        if self.borrows and _holds_arrays(data.signature.return_type):
            name = data.fndesc.qualname
            raise TypeError(f"{name} borrows arrays, and returns {data.signature.return_type}")
        if not _CacheState.can_write:
            return
        if _any_file_has_changed():  # a constant that is built in may be of another state
            _CacheState.can_write = False
            return
        folder = Path(self.cache_path).parent
        try:
            try:
                super().save_overload(sig, data)
            except FileNotFoundError:  # the folder was removed meanwhile: it is made again
                super().save_overload(sig, data)
            except OSError:
                raise
            except Exception:  # the index is damaged, which unpickling can raise anything of
                self.flush()
                super().save_overload(sig, data)
        except OSError as error:
            _CacheState.can_write = False
            _log_uncached(f"{folder} can't be written ({error.strerror or error})")
        else:
            _renew_use_date(folder)
            _remove_unused_caches(folder)


def _holds_arrays(kind: Any) -> bool:
    """Tell whether a type of numba's is that of an array, or of a tuple with one."""
    parts = getattr(kind, "types", ())  # of a tuple
    return isinstance(kind, types.Array) or any(map(_holds_arrays, parts))


def _enable_cache(kernel: Any, borrows: bool) -> None:
    """Have a kernel cached in the folder of the fingerprint, if there is one.

    ``borrows``: as of :func:`njit`.
    """
    folder = cache_folder()
    if folder.path is None:
        _log_uncached(folder.reason)
        return
    if _file_has_changed(kernel.py_func.__code__.co_filename):
        # The modules of this process are of different states: no fingerprint is theirs.
        _CacheState.can_read = _CacheState.can_write = False
    with _declaration_lock, _numba_cache_dir(str(folder.path)):
        try:
            kernel_cache = KernelCache(kernel.py_func)
        except RuntimeError:  # numba has no place to cache it in
            return
    kernel_cache.borrows = borrows
    if folder.path in Path(kernel_cache.cache_path).parents:
        # As numba's `enable_caching` does with its own class. There is no public way to another
        # one, and that one ends a program on a damaged file, and takes those of other signatures.
        kernel._cache = kernel_cache


@contextmanager
def _numba_cache_dir(path: str) -> Iterator[None]:
    """Set numba's cache folder while a kernel is declared; that of other functions stays."""
    previous_dir = _numba_settings.CACHE_DIR
    _numba_settings.CACHE_DIR = path
    try:
        yield
    finally:
        _numba_settings.CACHE_DIR = previous_dir


@cache
def cache_folder() -> CacheFolder:
    """Return the folder in which this process caches compiled kernels."""
    with _declaration_lock:
        if not (fingerprint := _fingerprint()):
            return CacheFolder(None, "the sources of the model are not files")
        reasons = []
        for find_base in (_configured_cache_base, user_cache_dir, tempfile.gettempdir):
            try:
                base = find_base()
                if os.path.isabs(base):  # the user's is not without a home
                    root = Path(base) / f"sweep-kernels-{os.getuid()}"
                    _make_private(root)
                    _log.info("compiled kernels are kept in %s", root / fingerprint)
                    return CacheFolder(root / fingerprint)
            except OSError as error:
                reasons.append(
                    f"{error.filename}: {error.strerror}"
                    if error.filename
                    else error.strerror or str(error)
                )
            except RuntimeError as error:  # no home: neither $HOME nor the uid has one
                reasons.append(str(error))
        return CacheFolder(None, "; ".join(reasons))


def _configured_cache_base() -> str:
    """Folder that numba is told to cache in; empty where it is told none."""
    cache_dir = _numba_settings.CACHE_DIR
    return os.path.abspath(cache_dir) if cache_dir else ""


def _make_private(root: Path) -> None:
    """Make a folder that nobody else can write to; OSError where that can't be had."""
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
def _sources() -> dict[str, tuple[str, int, int]]:
    """Name, size and time of change of each file of the model, by its path."""
    return {
        str(path): (path.relative_to(_MODEL_DIR).as_posix(), status.st_size, status.st_mtime_ns)
        for path in sorted(_MODEL_DIR.rglob("*.py"))
        for status in [path.stat()]
    }


@cache
def _fingerprint() -> str:
    """Digest of all that compiled kernels follow from; empty where sources are not files."""
    digest = hashlib.sha256()
    parts = [numba.__version__, llvmlite.__version__, np.__version__, repr(DEFAULT_NJIT_OPTIONS)]
    parts += [
        f"{name}={value}"
        for name, value in sorted(os.environ.items())
        if name.startswith("NUMBA_") and name not in NUMBA_SETTINGS_WITHOUT_EFFECT
    ]
    digest.update(repr(parts).encode())
    for path, (name, *_) in _sources().items():
        content = Path(path).read_bytes()
        digest.update(f"{name}\0{len(content)}\0".encode())
        digest.update(content)
    return digest.hexdigest()[:32] if _sources() else ""


def _file_has_changed(path: str) -> bool:
    """Tell whether a file of the model is another than when it was fingerprinted."""
    if (fingerprinted := _sources().get(path)) is None:
        return False
    try:
        status = os.stat(path)
    except OSError:
        return True
    return fingerprinted[1:] != (status.st_size, status.st_mtime_ns)


def _any_file_has_changed() -> bool:
    """Tell whether any file of the model is another than when it was fingerprinted."""
    return any(map(_file_has_changed, _sources()))


@cache
def _had_changed_at_first_load() -> bool:
    """Tell whether any had changed when the first kernel was looked for; once a process."""
    return _any_file_has_changed()


@cache
def _renew_use_date(folder: Path) -> None:
    """Date the use of a folder of kernels, so that others let it be; once a process."""
    with suppress(OSError):
        if time.time() - folder.stat().st_mtime > USE_DATE_RENEWAL_INTERVAL:
            os.utime(folder)


@cache
def _remove_unused_caches(used_folder: Path) -> None:
    """Remove the folders of other fingerprints that nobody has used for a month; once a process.

    Where one is in use all the same, its process has its kernels in memory, or compiles them anew.
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
def _log_uncached(reason: str) -> None:
    """Log that each process has to compile anew, and the remedy."""
    _log.warning(
        "compiled kernels are not cached, so that each start takes a minute more: %s. "
        "NUMBA_CACHE_DIR names another folder for them, of your own and with room",
        reason,
    )


@intrinsic
def high_word(typing_context, a, b):
    """Return the upper 64 bits of the product of two 64-bit numbers, one instruction."""

    def generate(context, builder, signature, factors):
        from llvmlite import ir

        wide, word = ir.IntType(128), ir.IntType(64)
        one, other = (builder.zext(factor, wide) for factor in factors)
        shifted = builder.lshr(builder.mul(one, other), ir.Constant(wide, 64))
        return builder.trunc(shifted, word)

    return types.uint64(types.uint64, types.uint64), generate
