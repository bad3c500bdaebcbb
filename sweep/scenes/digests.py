"""Files by their content: what of a scene's file makes it that one."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from sweep.scenes.errors import SceneError, existing


def file_digest(path: str | Path) -> str:
    """Digest of a file's bytes, and of those of the files that it is read with.

    A glTF file keeps its vertices in others. No file's name is part of it but those by which one
    names another.

    Parameters
    ----------
    path : str or Path
        The file.

    Returns
    -------
    str
        BLAKE2b, 128 bits, in hexadecimal digits.

    Raises
    ------
    SceneError
        Where it is missing or can not be read.
    """
    path = existing(path)
    digest = hashlib.blake2b(digest_size=16)
    for part in (path, *_companions(path)):
        try:
            with existing(part).open("rb") as file:
                hashlib.file_digest(file, lambda: digest)
        except OSError as error:
            raise SceneError(part, f"cannot be read ({error.strerror})", "check it") from None
    return digest.hexdigest()


def _companions(path: Path) -> list[Path]:
    """Files whose content belongs to this one's."""
    if path.suffix.lower() != ".gltf":
        return []
    try:
        document = json.loads(path.read_bytes())
    except (OSError, ValueError):
        return []  # what is wrong with it is told where it is read
    buffers: Any = document.get("buffers") if isinstance(document, dict) else None
    names = [b.get("uri", "") for b in buffers or () if isinstance(b, dict)]
    return [path.parent / unquote(name) for name in names if name and not name.startswith("data:")]
