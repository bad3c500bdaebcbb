"""Writes docs/fields.md from the schema of specs, which comes from their models: `make fields`."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from sweep.spec import json_schema

PAGE = Path(__file__).with_name("fields.md")

FIRST = {"GridSpec": "A study of a flat target", "SceneSpec": "A study of a scene"}
"""The two kinds of spec, which hold all others."""

HEAD = """\
# Fields of a spec

Written by `make fields` from the models that read specs, in the order of a spec. `sweep schema`
prints the same for editors. A field without a default has to be given: in the spec, in an
instrument's file or on an axis.
"""


def text() -> str:
    """Return the whole page."""
    definitions = json_schema()["$defs"]
    order: dict[str, None] = {}
    for first in FIRST:
        _reached(first, definitions, order)
    return HEAD + "".join(_model(name, definitions) for name in order)


def _reached(name: str, definitions: dict[str, Any], order: dict[str, None]) -> None:
    """Add a model to the order, then those that its fields refer to, as a spec is written."""
    if name not in order:
        order[name] = None
        for described in definitions[name]["properties"].values():
            for own in _names(described, definitions):
                _reached(own, definitions, order)


def _model(name: str, definitions: dict[str, Any]) -> str:
    """One section: a table of a model's fields."""
    own = definitions[name]
    about = " ".join(own.get("description", "").split("\n\n")[0].split())
    rows = [_row(field, described, definitions) for field, described in own["properties"].items()]
    table = "\n".join(["| field | what it is | default or example |", "| --- | --- | --- |", *rows])
    return f"\n## {FIRST.get(name, _words(name))}\n\n{about}\n\n{table}\n"


def _row(field: str, described: dict[str, Any], definitions: dict[str, Any]) -> str:
    names = dict.fromkeys(_names(described, definitions))
    links = ", ".join(f"[{_words(name)}](#{_words(name).replace(' ', '-')})" for name in names)
    about = described.get("description", "")
    if not about and "const" in described:
        about = f"always `{described['const']}`"
    options = ", ".join(f"`{option}`" for option in described.get("enum", []))
    cells = [about, f"one of {options}" * bool(options), f"see {links}" * bool(links)]
    shown = "; ".join(filter(None, cells)).replace("|", "\\\\|")
    return f"| `{field}` | {shown} | {_value(described)} |"


def _names(node: Any, definitions: dict[str, Any]) -> Iterator[str]:
    """Models that a field may hold."""
    if isinstance(node, dict):
        name = str(node.get("$ref", "")).rsplit("/", 1)[-1]
        if "properties" in definitions.get(name, {}):
            yield name
        for key, part in node.items():
            if key not in ("properties", "discriminator"):
                yield from _names(part, definitions)
    elif isinstance(node, list):
        for part in node:
            yield from _names(part, definitions)


def _value(described: dict[str, Any]) -> str:
    """Return a field's default, else an example of a good value."""
    if described.get("default") not in (None, "", [], {}):
        return f"default `{described['default']}`"
    return f"e.g. `{described['examples'][0]}`" if described.get("examples") else ""


def _words(name: str) -> str:
    """Return a model's name in words, without "section"."""
    name = name.removesuffix("Section")
    return "".join(f" {letter.lower()}" if letter.isupper() else letter for letter in name).strip()


if __name__ == "__main__":
    PAGE.write_text(text(), encoding="utf-8")
