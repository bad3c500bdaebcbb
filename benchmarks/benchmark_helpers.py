"""Helpers of the benchmarks: experiments with changed sections, Markdown tables and pages."""

import tempfile
import textwrap
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
DOCS, EXPERIMENTS = ROOT / "docs", ROOT / "experiments"
TABLE_4_1 = EXPERIMENTS / "instruments" / "table_4_1.yaml"


def experiment_spec(name: str, **changes: Any) -> Any:
    """Return the spec of an experiment without figures; `changes` replace whole sections."""
    from sweep.spec import GridSpec, SceneSpec
    from sweep.spec.axes import remove_fields_on_axes
    from sweep.spec.yaml_document import read_document

    mapping = read_document(EXPERIMENTS / f"{name}.yaml").content | {"figures": []} | changes
    spec_class = SceneSpec if "scene" in mapping else GridSpec
    return spec_class.from_mapping(remove_fields_on_axes(mapping), base=EXPERIMENTS)


def experiment_mapping(folder: Path, name: str) -> dict[str, Any]:
    """Read an experiment of a check-out as plain data, without figures.

    The path of an instrument's file becomes absolute. YAML reads the key `on` as true, which is
    undone.
    """
    import yaml

    def restore_on_keys(value: Any) -> Any:
        if isinstance(value, list):
            return [restore_on_keys(item) for item in value]
        if not isinstance(value, dict):
            return value
        return {
            "on" if key is True else key: restore_on_keys(inner) for key, inner in value.items()
        }

    mapping = restore_on_keys(yaml.safe_load((folder / f"{name}.yaml").read_text()))
    instrument = mapping["instrument"]
    instrument = {"file": instrument} if isinstance(instrument, str) else instrument
    if "file" in instrument:
        instrument = instrument | {"file": str(folder / instrument["file"])}
    mapping["instrument"] = instrument
    mapping.pop("figures", None)
    return mapping


def load_mapping(mapping: dict[str, Any]) -> Any:
    """Load a spec from plain data, by any version of sweep; an axis replaces its field."""
    import contextlib

    import yaml

    import sweep

    with contextlib.suppress(ImportError):  # versions that take both have no such function
        from sweep.spec.axes import remove_fields_on_axes

        mapping = remove_fields_on_axes(mapping)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "study.yaml"
        file.write_text(yaml.safe_dump(mapping, sort_keys=False))
        return sweep.load(file)


def markdown_row(cells: Iterable[str]) -> str:
    """Return a row of a Markdown table."""
    return f"| {' | '.join(cells)} |"


def markdown_table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table."""
    return "\n".join(map(markdown_row, [head, ["---"] * len(head), *rows]))


def wrap_page(page: str) -> str:
    """Wrap the paragraphs of a Markdown page to 100 characters; keep tables, lists and headings."""
    parts = page.split("\n\n")
    return "\n\n".join(
        part if part.lstrip().startswith(("|", "-", "#")) else textwrap.fill(part, 100)
        for part in parts
    )


def print_table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Print a table to the terminal."""
    from rich.console import Console
    from rich.table import Table

    rich_table = Table(*head)
    for row in rows:
        rich_table.add_row(*row)
    Console(width=130).print(rich_table)


def replace_page_part(page: str, name: str, content: str) -> None:
    """Replace the text between the marks ``name: begin`` and ``name: end`` in a page of docs/."""
    path, begin_mark, end_mark = DOCS / page, f"<!-- {name}: begin -->", f"<!-- {name}: end -->"
    before, found_begin, after_begin = path.read_text(encoding="utf-8").partition(begin_mark)
    _, found_end, after = after_begin.partition(end_mark)
    if not (found_begin and found_end):
        raise ValueError(f"{path} lacks the marks of {name}")
    path.write_text(f"{before}{begin_mark}\n{content}\n{end_mark}{after}", encoding="utf-8")
