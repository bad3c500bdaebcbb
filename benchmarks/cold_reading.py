"""Draw names and docstrings of the package, for a reader who has not seen the code.

    python benchmarks/cold_reading.py            # 100 names and 60 docstrings
    python benchmarks/cold_reading.py --seed 7 --names 50 --docstrings 30
    python benchmarks/cold_reading.py --answers  # the same, with files and sources

The reader says what each name is, having seen no more than its module's path and the name, and only
then looks it up with ``--answers``. A docstring counts as read twice where its first reading left
open what goes in, what comes out, or what a word refers to. The shares of misread names and of
docstrings read twice are the result.
"""

import argparse
import ast
import random
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

REPOSITORY = Path(__file__).parents[1]
PACKAGE = REPOSITORY / "sweep"


class Definition(NamedTuple):
    """A function, class, constant or method of the package."""

    path: Path
    """Of its module, from the repository's root on."""
    name: str
    """With that of its class, joined by a dot."""
    line: int
    docstring: str
    """Empty if it has none."""
    source: str


def iter_definitions(package: Path) -> Iterator[Definition]:
    """Definitions at the level of modules and classes, in the order of their files."""
    for path in sorted(package.rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        yield from _iter_body(
            ast.parse(text).body, path.relative_to(package.parent), text.splitlines(), ""
        )


def _iter_body(
    body: list[ast.stmt], path: Path, lines: list[str], prefix: str
) -> Iterator[Definition]:
    for statement, following in zip(body, [*body[1:], None], strict=True):
        source = "\n".join(lines[statement.lineno - 1 : statement.end_lineno])
        if isinstance(statement, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            if statement.name.startswith("__"):
                continue
            name, docstring = prefix + statement.name, ast.get_docstring(statement) or ""
            yield Definition(path, name, statement.lineno, docstring, source)
            if isinstance(statement, ast.ClassDef):
                yield from _iter_body(statement.body, path, lines, f"{statement.name}.")
        elif isinstance(statement, ast.Assign | ast.AnnAssign):
            targets = statement.targets if isinstance(statement, ast.Assign) else [statement.target]
            docstring = _attribute_docstring(following)
            for target in targets:
                if isinstance(target, ast.Name) and not target.id.startswith("__"):
                    yield Definition(path, prefix + target.id, target.lineno, docstring, source)


def _attribute_docstring(following: ast.stmt | None) -> str:
    """Docstring of an assignment: a text that follows it."""
    if isinstance(following, ast.Expr) and isinstance(following.value, ast.Constant):
        return str(following.value.value)
    return ""


def draw_sample(
    definitions: list[Definition], n_names: int, n_docstrings: int, seed: int
) -> tuple[list[Definition], list[Definition]]:
    """Names, and definitions with docstrings, each drawn without replacement."""
    generator = random.Random(seed)
    names = generator.sample(definitions, n_names)
    documented = [d for d in definitions if d.docstring and not d.source.startswith("class ")]
    return names, generator.sample(documented, n_docstrings)


def main() -> None:
    """Print the sample."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--names", type=int, default=100, help="how many names (100)")
    parser.add_argument("--docstrings", type=int, default=60, help="how many docstrings (60)")
    parser.add_argument("--answers", action="store_true", help="show files and sources as well")
    options = parser.parse_args()
    names, documented = draw_sample(
        list(iter_definitions(PACKAGE)), options.names, options.docstrings, options.seed
    )
    print(f"{len(names)} names, seed {options.seed}\n")
    for number, definition in enumerate(names, 1):
        print(f"{number}. {definition.path.with_suffix('')} : {definition.name}")
        if options.answers:
            print(f"   line {definition.line}: {definition.docstring or '(no docstring)'}\n")
    print(f"\n{len(documented)} docstrings, seed {options.seed}")
    for number, definition in enumerate(documented, 1):
        print(f"\n{number}. {definition.path} : {definition.name}\n")
        print("\n".join(f"    {line}" for line in definition.docstring.splitlines()))
        if options.answers:
            print(f"\n    line {definition.line}:\n{definition.source}")


if __name__ == "__main__":
    main()
