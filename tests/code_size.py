"""Size of the house: lines, modules, and functions that numba compiles. `make size` prints it."""

import ast
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[1]
COMPILER_MODULES = ("numba", "sweep.kernel_cache")
"""Modules whose names, as decorators, make compiled functions."""
COMPILER_INTERNALS = (
    "intrinsic(",
    "register_model",
    "lower_builtin",
    "_nrt",
    "forceinline",
    "llvmlite.ir",
)


def module_paths(folder: str) -> list[Path]:
    """Modules in a folder of the repository."""
    return sorted((ROOT / folder).rglob("*.py"))


@cache
def parse_module(path: Path) -> ast.Module:
    """Syntax tree of a module."""
    return ast.parse(path.read_text())


def count_lines(folder: str) -> int:
    """Lines of all modules in a folder."""
    return sum(path.read_text().count("\n") for path in module_paths(folder))


def count_compiled_functions(folder: str) -> int:
    """Functions with a decorator of numba's, by whatever name the module knows it."""
    return sum(count_compiled_in_module(parse_module(path)) for path in module_paths(folder))


def count_compiled_in_module(tree: ast.Module) -> int:
    """Functions of a module, likewise."""
    return len(_compiled_functions(tree))


def compiled_arguments_max(folder: str) -> int:
    """Most arguments that any of them has."""
    functions = [
        compiled_function
        for path in module_paths(folder)
        for compiled_function in _compiled_functions(parse_module(path))
    ]
    return max(len(function.args.args) for function in functions)


def used_compiler_internals(folder: str) -> set[str]:
    """Names of numba's and llvmlite's inner workings that occur in any module."""
    text = "".join(path.read_text() for path in module_paths(folder))
    return {name for name in COMPILER_INTERNALS if name in text}


@cache
def _compiled_functions(tree: ast.Module) -> list[ast.FunctionDef]:
    names: set[str] = set()
    for node in tree.body:
        if isinstance(node, ast.Import | ast.ImportFrom):
            package = node.module or "" if isinstance(node, ast.ImportFrom) else ""
            names |= {
                alias.asname or alias.name for alias in node.names
                if f"{package}.{alias.name}".strip(".").startswith(COMPILER_MODULES)
            }  # fmt: skip
        elif isinstance(node, ast.Assign) and _used_names(node.value) & names:
            names |= {target.id for target in node.targets if isinstance(target, ast.Name)}
    functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]
    return [
        function
        for function in functions
        if any(_used_names(decorator) & names for decorator in function.decorator_list)
    ]


def _used_names(node: ast.AST) -> set[str]:
    return {name_node.id for name_node in ast.walk(node) if isinstance(name_node, ast.Name)}


if __name__ == "__main__":
    for folder in ("sweep", "sweep/model", "tests"):
        print(f"{folder:12}{count_lines(folder):8,} lines {len(module_paths(folder)):5} modules")
    print(f"compiled    {count_compiled_functions('sweep'):8,} functions of sweep, by numba")
    print(
        f"            {compiled_arguments_max('sweep'):8,} arguments of one of these, at the most"
    )
    print(
        f"internals   {', '.join(used_compiler_internals('sweep')) or 'none':>8} of numba or "
        "llvmlite"
    )
