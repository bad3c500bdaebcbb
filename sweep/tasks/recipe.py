"""What a store's own bytes do not say: the folder that the files of its study lie under.

A study is the same wherever its files are, so their place stands in the journal's directory. It is
written anew by whoever runs the study from its spec.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

from sweep.tasks.store import JOURNAL

RECIPE = "recipe.json"


def write_recipe(store_path: Path, **facts: Any) -> None:
    """Put down where a study's files are, in one step."""
    path = store_path / JOURNAL / RECIPE
    path.parent.mkdir(exist_ok=True)
    draft = path.with_name(f"{RECIPE}.{os.getpid()}")
    draft.write_text(json.dumps(facts))
    os.replace(draft, path)


def read_recipe(store_path: Path) -> dict[str, Any]:
    """What was put down; empty where nothing was."""
    try:
        facts = json.loads((store_path / JOURNAL / RECIPE).read_text())
    except (FileNotFoundError, ValueError):
        return {}
    return facts if isinstance(facts, dict) else {}
