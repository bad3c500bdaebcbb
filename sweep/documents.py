"""JSON of others, read so that nothing in it can break what comes later.

Nesting of any depth is valid JSON, and so is half of a surrogate pair. Python's functions fail at
either, each at another place: what is copied or printed, and what is written as UTF-8.
"""

from __future__ import annotations

import json
from typing import Any

#: Levels of lists and objects within each other. A store's document has ten.
DEPTH_MAX = 60


def parse_json(content: bytes | str, *, has_paths: bool = False) -> Any:
    """Parse JSON; ValueError where it is none, nested too deeply, or has text that is no text.

    With ``has_paths`` text may be anything: names of files need not be UTF-8.
    """
    try:
        parsed = json.loads(content)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None
    _check(parsed, has_paths)
    return parsed


def _check(parsed: Any, has_paths: bool) -> None:
    """Refuse deep nesting and lone surrogates, level by level."""
    level, depth = [parsed], 0
    while level:
        depth += 1
        if depth > DEPTH_MAX:
            raise ValueError("it is nested too deeply")
        below: list[Any] = []
        for value in level:
            if isinstance(value, dict):
                below += value.keys()
                below += value.values()
            elif isinstance(value, list):
                below += value
            elif isinstance(value, str) and not (has_paths or is_text(value)):
                raise ValueError("it has characters that are no text")
        level = below


def is_text(text: str) -> bool:
    """Tell whether a string can be written as UTF-8: it has no half of a surrogate pair.

    >>> is_text("Gale"), is_text("Gale" + chr(0xD800))
    (True, False)
    """
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True
