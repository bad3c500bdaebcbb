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
    """Values as a file has them, from the text that would stand there.

    Parameters
    ----------
    fields : mapping
        Text by dotted path: ``{"axes.target.range": "[1 km, 2 km]"}``.

    Raises
    ------
    SpecError
        Where one is no YAML.
    """
    text = "".join(f"{json.dumps(path)}: {value}\n" for path, value in fields.items())
    document = parsed(text, Path("--set"))
    if document.findings:
        raise SpecError(map(document.mistake, document.findings))
    return document.value


def from_stored(text: str, base: Path | str | None = None) -> Spec | SceneSpec:
    """Study from the JSON that its `to_json` gave, the same again but for its execution.

    Parameters
    ----------
    text : str
        The JSON.
    base : path, optional
        Folder that the files of a scene are relative to; the current one by default. They are not
        looked at before the scene is built.

    Raises
    ------
    SpecError
        With every mistake in it.
    """
    written = json.loads(text)
    if isinstance(written, dict) and "scene" in written:
        return SceneSpec.from_stored(text, base=base)
    return Spec.from_stored(text)
