"""Parsing of JSON from untrusted sources, with limits that protect later processing.

JSON may be nested to any depth and may contain half of a surrogate pair. Python's functions fail
on either, but only later: when data is copied, printed or written as UTF-8.
"""

from __future__ import annotations

import json
from typing import Any

JSON_DEPTH_MAX = 60
"""Maximum depth of nested lists and objects in a JSON document; that of a store has ten levels."""


def parse_json(content: bytes | str, *, allow_non_utf8: bool = False) -> Any:
    """Parse a JSON document, and refuse deep nesting and text that UTF-8 can't encode.

    Parameters
    ----------
    content : bytes or str
        JSON document.
    allow_non_utf8 : bool
        True accepts text that UTF-8 can't encode, such as names of files.

    Raises
    ------
    ValueError
        If the content is no JSON, is nested too deeply, or contains half of a surrogate pair.
    """
    try:
        parsed = json.loads(content)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None
    _refuse_unsafe_values(parsed, allow_non_utf8)
    return parsed


def _refuse_unsafe_values(parsed: Any, allow_non_utf8: bool) -> None:
    """Raise `ValueError` if parsed JSON is nested too deeply or contains half of a surrogate pair.

    `allow_non_utf8` accepts halves of surrogate pairs.
    """
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
    """Return True if a text can be encoded as UTF-8, so that it has no half of a surrogate pair.

    Examples
    --------
    >>> is_utf8_encodable("Gale"), is_utf8_encodable("Gale" + chr(0xD800))
    (True, False)
    """
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True
