"""Helpers of the benchmarks: experiments with changes, tables, and pages to put them into."""

import tempfile
import textwrap
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
DOCS, EXPERIMENTS = ROOT / "docs", ROOT / "experiments"
TABLE_4_1 = EXPERIMENTS / "instruments" / "table_4_1.yaml"


def experiment(name: str, **changes: Any) -> Any:
    """An experiment with sections put in the place of its own, and no figures."""
    from sweep.spec import SceneSpec, Spec
    from sweep.spec.axes import without_fields_on_axes
    from sweep.spec.reading import read_document

    mapping = read_document(EXPERIMENTS / f"{name}.yaml").value | {"figures": []} | changes
    kind = SceneSpec if "scene" in mapping else Spec
    return kind.from_mapping(without_fields_on_axes(mapping), base=EXPERIMENTS)


def plain(folder: Path, name: str) -> dict[str, Any]:
    """Read an experiment of a check-out as plain data, without figures.

    The path of an instrument's file is absolute. YAML reads some keys (`on`) as true: they are as
    they were written.
    """
    import yaml

    def named(value: Any) -> Any:
        if isinstance(value, list):
            return [named(each) for each in value]
        if not isinstance(value, dict):
            return value
        return {"on" if key is True else key: named(inner) for key, inner in value.items()}

    written = named(yaml.safe_load((folder / f"{name}.yaml").read_text()))
    instrument = written["instrument"]
    instrument = {"file": instrument} if isinstance(instrument, str) else instrument
    if "file" in instrument:
        instrument = instrument | {"file": str(folder / instrument["file"])}
    written["instrument"] = instrument
    written.pop("figures", None)
    return written


def loaded(written: dict[str, Any]) -> Any:
    """Load a study from plain data; an axis replaces the field of its name, in any version."""
    import contextlib

    import yaml

    import sweep

    with contextlib.suppress(ImportError):  # versions that take both have no such function
        from sweep.spec.axes import without_fields_on_axes

        written = without_fields_on_axes(written)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "study.yaml"
        file.write_text(yaml.safe_dump(written, sort_keys=False))
        return sweep.load(file)


def line(cells: Iterable[str]) -> str:
    """A row of a table in Markdown."""
    return f"| {' | '.join(cells)} |"


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table in Markdown."""
    return "\n".join(map(line, [head, ["---"] * len(head), *rows]))


def wrapped(page: str) -> str:
    """A page whose paragraphs have lines of 100 characters; tables, lists and heads stay."""
    parts = page.split("\n\n")
    return "\n\n".join(
        part if part.lstrip().startswith(("|", "-", "#")) else textwrap.fill(part, 100)
        for part in parts
    )


def show(head: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Print a table."""
    from rich.console import Console
    from rich.table import Table

    shown = Table(*head)
    for row in rows:
        shown.add_row(*row)
    Console(width=130).print(shown)


def put(page: str, name: str, content: str) -> None:
    """Put text between the marks of that name in a page of docs."""
    path, begin, end = DOCS / page, f"<!-- {name}: begin -->", f"<!-- {name}: end -->"
    before, mark, rest = path.read_text(encoding="utf-8").partition(begin)
    _, other, after = rest.partition(end)
    if not (mark and other):
        raise ValueError(f"{path} lacks the marks of {name}")
    path.write_text(f"{before}{begin}\n{content}\n{end}{after}", encoding="utf-8")
