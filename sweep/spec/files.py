"""The files that a scene is made of: where they are, and that they are still the same."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from pydantic import BaseModel

from sweep.scenes.files import SceneError, file_digest
from sweep.spec.fields import Key, leaves
from sweep.spec.list_rules import File


@dataclass(frozen=True)
class Files:
    """Files named in a spec.

    Parameters
    ----------
    base : Path
        Folder that their paths are relative to; ~ is the user's own.
    digests : mapping
        Digest of each file by its path as written.
    """

    base: Path
    digests: Mapping[str, str] = field(default_factory=dict)

    def path(self, written: str, digest: Callable[[Path], str] = file_digest) -> Path:
        """Where a file is, whose digest is as its rule says.

        Raises
        ------
        SceneError
            Where it is missing, or has another content than when the spec was loaded.
        """
        path = self.base / os.path.expanduser(written)
        known = self.digests.get(written)
        if known is not None and digest(path) != known:
            raise SceneError(
                path,
                "has changed since the study was declared",
                "bring the old file back, or make another study of the new one",
            )
        return path


def named_files(part: BaseModel) -> Iterator[tuple[Key, File, str]]:
    """Places in a spec that name a file, with their rule and the path written there."""
    for key, rule, value in leaves(part, ()):
        if isinstance(rule, File):
            yield key, rule, value
