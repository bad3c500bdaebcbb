"""Specs as a user writes them, made of others."""

import copy
from typing import Any

from sweep.spec.axes import paths_on_axes


def without_axes(study: dict[str, Any]) -> dict[str, Any]:
    """A study in whose sections no field is that an axis sets."""
    written = copy.deepcopy(study)
    for path in paths_on_axes(written.get("axes")):
        *parents, name = path.split(".")
        section: Any = written
        for parent in parents:
            section = section.get(parent) if isinstance(section, dict) else None
        if isinstance(section, dict):
            section.pop(name, None)
    return written
