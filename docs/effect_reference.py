"""Writes the table of docs/effects.md from the catalogue of effects: `make fields`."""

from __future__ import annotations

from pathlib import Path

from sweep.model.effects.catalogue import EFFECTS
from sweep.model.effects.effect import Effect

PAGE = Path(__file__).with_name("effects.md")

HEAD = "| effect | acts on | what it is | fields |\n| --- | --- | --- | --- |\n"
"""First two lines of the table, which the script finds in the page."""


def text() -> str:
    """Return the whole page with a new table."""
    before, head, after = PAGE.read_text(encoding="utf-8").partition(HEAD)
    if not head:
        raise ValueError(f"{PAGE.name} has no table that begins with {HEAD!r}")
    rest = after.partition("\n\n")[2]
    return before + head + "\n".join(map(_row, EFFECTS)) + "\n\n" + rest


def _row(effect: Effect) -> str:
    """Return an effect's row of the table."""
    fields = ", ".join(f"`{parameter.path}`" for parameter in effect.parameters)
    return f"| `{effect.name}` | {effect.stage} | {effect.description} | {fields} |"


if __name__ == "__main__":
    PAGE.write_text(text(), encoding="utf-8")
