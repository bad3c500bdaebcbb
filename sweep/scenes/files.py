"""Files of a scene: what is wrong with one, and the digest that tells it from others."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any
from urllib.parse import unquote


class SceneError(Exception):
    """A file that a scene can not be made of.

    Parameters
    ----------
    file : str or Path
        The file.
    rule : str
        The rule broken, as the end of a sentence about the file.
    remedy : str
        What to do about it.
    """

    def __init__(self, file: str | Path, rule: str, remedy: str) -> None:
        super().__init__(f"{file}: {rule}; {remedy}")
        self.file, self.rule, self.remedy = str(file), rule, remedy


def existing(path: str | Path) -> Path:
    """Path of a file that is there.

    Raises
    ------
    SceneError
        Where it is not, or is no plain file: a pipe would be waited for.
    """
    path = Path(path)
    if str(path).startswith("/vsi"):
        raise SceneError(path, "is no file of this machine", "fetch it, and name the file")
    if path.is_dir():
        raise SceneError(path, "is a folder", "name the file in it")
    if not path.exists():
        remedy = "check the path, which is relative to the file that names it"
        if path.parent.is_dir():
            near = sorted(other.name for other in path.parent.glob(f"*{path.suffix}"))[:5]
            remedy += f" (there is: {', '.join(near)})" if near else ""
        raise SceneError(path, "does not exist", remedy)
    if not path.is_file():
        raise SceneError(path, "is a pipe or a device", "name a plain file")
    return path


def file_digest(path: str | Path) -> str:
    """Digest of a file's bytes (BLAKE2b, 128 bits), and of those of the files that it is read with.

    A glTF file keeps its vertices in others. No file's name is part of it but those by which one
    names another.

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
