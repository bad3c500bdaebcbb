"""Studies from files and from what a store holds, whichever their kind."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sweep.spec.mistakes import SpecError
from sweep.spec.reading import parsed, read_document
from sweep.spec.scene_spec import SceneSpec
from sweep.spec.study import Spec


def load(path: str | Path) -> Spec | SceneSpec:
    """Study in a YAML file: one of a flat target, or of a scene where it has a ``scene``.

    Raises
    ------
    SpecError
        With every mistake in it, each with its path, its line and a remedy.
    """
    document = read_document(Path(path))
    kind = SceneSpec if "scene" in document.value else Spec
    return kind.from_document(document, Path(path).parent)


def written(fields: Mapping[str, str]) -> dict[str, Any]:
    """Values as a file has them, from text by path: ``{"axes.target.range": "[1 km, 2 km]"}``."""
    text = "".join(f"{json.dumps(path)}: {value}\n" for path, value in fields.items())
    document = parsed(text, Path("--set"))
    if document.findings:
        raise SpecError(map(document.mistake, document.findings))
    return document.value


def from_stored(text: str, base: Path | str | None = None) -> Spec | SceneSpec:
    """Study from the JSON that its `to_json` gave, the same again but for its execution.

    The files of a scene, relative to `base`, are not looked at before it is built.
    """
    written = json.loads(text)
    kind = SceneSpec if isinstance(written, dict) and "scene" in written else Spec
    return kind.from_stored(text, base)
