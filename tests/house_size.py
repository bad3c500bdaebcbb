"""Size of the house: lines, modules, and functions that numba compiles. `make size` prints it."""

import ast
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[1]
COMPILING = ("numba", "sweep.kernels")
"""Modules whose names, as decorators, make compiled functions."""
INTERNALS = ("intrinsic(", "register_model", "lower_builtin", "_nrt", "forceinline", "llvmlite.ir")


def modules(folder: str) -> list[Path]:
    """Modules in a folder of the repository."""
    return sorted((ROOT / folder).rglob("*.py"))


@cache
def parsed(path: Path) -> ast.Module:
    """Syntax tree of a module."""
    return ast.parse(path.read_text())


def lines(folder: str) -> int:
    """Lines of all modules in a folder."""
    return sum(path.read_text().count("\n") for path in modules(folder))


def compiled(folder: str) -> int:
    """Functions with a decorator of numba's, by whatever name the module knows it."""
    return sum(compiled_in(parsed(path)) for path in modules(folder))


def compiled_in(tree: ast.Module) -> int:
    """Functions of a module, likewise."""
    return len(_compiled(tree))


def most_arguments(folder: str) -> int:
    """Most arguments that any of them has."""
    functions = [f for path in modules(folder) for f in _compiled(parsed(path))]
    return max(len(function.args.args) for function in functions)


def internals(folder: str) -> set[str]:
    """Names of numba's and llvmlite's inner workings that occur in any module."""
    text = "".join(path.read_text() for path in modules(folder))
    return {name for name in INTERNALS if name in text}


@cache
def _compiled(tree: ast.Module) -> list[ast.FunctionDef]:
    names: set[str] = set()
    for node in tree.body:
        if isinstance(node, ast.Import | ast.ImportFrom):
            of = node.module or "" if isinstance(node, ast.ImportFrom) else ""
            names |= {
                alias.asname or alias.name for alias in node.names
                if f"{of}.{alias.name}".strip(".").startswith(COMPILING)
            }  # fmt: skip
        elif isinstance(node, ast.Assign) and _names(node.value) & names:
            names |= {target.id for target in node.targets if isinstance(target, ast.Name)}
    functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]
    return [f for f in functions if any(_names(d) & names for d in f.decorator_list)]


def _names(node: ast.AST) -> set[str]:
    return {each.id for each in ast.walk(node) if isinstance(each, ast.Name)}


if __name__ == "__main__":
    for folder in ("sweep", "sweep/model", "tests"):
        print(f"{folder:12}{lines(folder):8,} lines {len(modules(folder)):5} modules")
    print(f"compiled    {compiled('sweep'):8,} functions of sweep, by numba")
    print(f"            {most_arguments('sweep'):8,} arguments of one of these, at the most")
    print(f"internals   {', '.join(internals('sweep')) or 'none':>8} of numba or llvmlite")
