"""Tables of docs/scale.md, put between their marks by what measures them."""

from pathlib import Path

PAGE = Path(__file__).parents[1] / "docs" / "scale.md"


def put(name: str, head: list[str], rows: list[list[str]], said: str = "") -> None:
    """Put a table in the place of the one of its name."""
    begin, end = f"<!-- {name}: begin -->", f"<!-- {name}: end -->"
    lines = [head, ["---"] * len(head), *rows]
    table = "\n".join("| " + " | ".join(cells) + " |" for cells in lines)
    text = PAGE.read_text(encoding="utf-8")
    before, mark, rest = text.partition(begin)
    _, other, after = rest.partition(end)
    if not (mark and other):
        raise ValueError(f"{PAGE} lacks the marks of {name}")
    content = "\n\n".join(part for part in (table, said) if part)
    PAGE.write_text(f"{before}{begin}\n{content}\n{end}{after}", encoding="utf-8")
