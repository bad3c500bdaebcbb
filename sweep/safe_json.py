"""JSON of others, read so that nothing in it can break what comes later.

Nesting of any depth is valid JSON, and so is half of a surrogate pair. Python's functions fail at
either, each at another place: what is copied or printed, and what is written as UTF-8.
"""

from __future__ import annotations

import json
from typing import Any

#: Levels of lists and objects within each other. A store's document has ten.
JSON_DEPTH_MAX = 60


def parse_json(content: bytes | str, *, allow_non_utf8: bool = False) -> Any:
    """Parse JSON; ValueError where it is none, nested too deeply, or has text that is no text.

    With ``allow_non_utf8`` text may be anything: names of files need not be UTF-8.
    """
    try:
        parsed = json.loads(content)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None
    _refuse_unsafe_values(parsed, allow_non_utf8)
    return parsed


def _refuse_unsafe_values(parsed: Any, allow_non_utf8: bool) -> None:
    """Refuse deep nesting and lone surrogates, level by level."""
    level, depth = [parsed], 0
    while level:
        depth += 1
        if depth > JSON_DEPTH_MAX:
            raise ValueError("it is nested too deeply")
        next_level: list[Any] = []
        for value in level:
            if isinstance(value, dict):
                next_level += value.keys()
                next_level += value.values()
            elif isinstance(value, list):
                next_level += value
            elif isinstance(value, str) and not (allow_non_utf8 or is_utf8_encodable(value)):
                raise ValueError("it has characters that are no text")
        level = next_level


def is_utf8_encodable(text: str) -> bool:
    """Tell whether a string can be written as UTF-8: it has no half of a surrogate pair.

    >>> is_utf8_encodable("Gale"), is_utf8_encodable("Gale" + chr(0xD800))
    (True, False)
    """
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True
