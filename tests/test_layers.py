"""Rules of the architecture, checked by walking the imports of every module."""

import ast
import re
from functools import cache
from pathlib import Path

PACKAGE = Path(__file__).parents[1] / "sweep"
MODULES = sorted(PACKAGE.rglob("*.py"))

MAY_IMPORT = {
    "units": {"units"},
    "safe_json": {"safe_json"},
    "regular_files": {"regular_files"},
    "extras": {"extras"},
    "kernel_cache": {"kernel_cache"},
    "messages": {"messages"},
    "storage": {"storage", "safe_json", "messages", "regular_files"},
    "model": {"model", "kernel_cache"},
    "scenes": {"scenes", "messages", "model", "units"},
    "spec": {"spec", "safe_json", "messages", "regular_files", "scenes", "model", "units"},
    "tasks": {
        "tasks",
        "safe_json",
        "extras",
        "kernel_cache",
        "messages",
        "regular_files",
        "storage",
        "spec",
        "scenes",
        "model",
        "units",
    },
    "analysis": {"analysis", "messages", "storage", "spec", "scenes", "model", "units"},
    "report": {"report", "analysis", "messages", "storage", "spec", "scenes", "model", "units"},
    "cli": {
        "cli",
        "extras",
        "messages",
        "regular_files",
        "tasks",
        "report",
        "analysis",
        "storage",
        "spec",
        "scenes",
        "model",
        "units",
    },
    "__init__": {"tasks", "analysis", "spec"},
}
"""Imports run one way; analysis and report read stores, however they were computed."""

NOT_IN_THE_ENGINE = ("sweep.tasks.studies", "sweep.tasks.accuracy", "sweep.model", "sweep.scenes")
"""Packages that `sweep/tasks/engine` imports nothing of: it computes the blocks of any study."""

ENGINE_SPEC_MODULES = {
    "sweep.spec.cluster_config",  # the file that describes a cluster
    "sweep.spec.rules",
    "sweep.spec.sections",  # `execution`: workers, threads, scheduler
}
"""Modules of the spec that the engine may import: what the user says of machines."""

LIDAR_WORDS = re.compile(
    r"(?<![a-z])(lidar|laser|beam|beamlet|chirp|doppler|speckle|shot|scanner|scene|eyepoint"
    r"|telescope|footprint|spectr(um|a)|fft|radial_velocity|ray|pd|snr|look|echo(es)?|tile)s?"
    r"(?![a-z])",
    re.IGNORECASE,
)
"""Words of the field, which the engine knows none of."""

NOT_IN_THE_MODEL = {
    "click",
    "dask",
    "distributed",
    "logging",
    "os",
    "pathlib",
    "pint",
    "pydantic",
    "rasterio",
    "rich",
    "trimesh",
    "xarray",
    "yaml",
    "zarr",
}
"""Pure physics: arrays in, arrays out."""


@cache
def _nodes(path: Path) -> list[ast.AST]:
    """Nodes of the syntax tree of a module."""
    return list(ast.walk(ast.parse(path.read_text())))


@cache
def _imports(path: Path) -> set[str]:
    """Dotted names that a module imports, wherever in it."""
    names = set()
    for node in _nodes(path):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            names |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            raise AssertionError(f"{path}: relative import; write the whole name")
    return names


def _layer(path: Path) -> str:
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def _module_name(path: Path) -> str:
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def test_imports_run_one_way():
    for path in MODULES:
        layers = {name.split(".")[1] for name in _imports(path) if name.startswith("sweep.")}
        assert layers <= MAY_IMPORT[_layer(path)], path


def test_the_model_knows_no_framework():
    for path in (path for path in MODULES if _layer(path) == "model"):
        assert not {name.split(".")[0] for name in _imports(path)} & NOT_IN_THE_MODEL, path


def _engine_modules() -> list[Path]:
    return [path for path in MODULES if path.is_relative_to(PACKAGE / "tasks" / "engine")]


def test_the_engine_imports_no_study_and_no_physics():
    for path in _engine_modules():
        imports = {name for name in _imports(path) if name.startswith("sweep.")}
        assert not [name for name in imports if name.startswith(NOT_IN_THE_ENGINE)], path
        spec_imports = {name for name in imports if f"{name}.".startswith("sweep.spec.")}
        allowed = tuple(ENGINE_SPEC_MODULES)
        assert not [name for name in spec_imports if not name.startswith(allowed)], path


def test_the_engine_has_no_word_of_the_field():
    assert len(_engine_modules()) > 10
    for path in _engine_modules():
        for number, line in enumerate(path.read_text().splitlines(), 1):
            assert not LIDAR_WORDS.search(line), f"{path}:{number}: {line}"


def test_no_import_cycle():
    names = {_module_name(path): path for path in MODULES}
    graph = {name: {i for i in _imports(path) if i in names} for name, path in names.items()}
    visited: set[str] = set()

    def visit(name, trail):
        assert name not in trail, f"cycle: {' -> '.join([*trail, name])}"
        if name not in visited:
            for other in graph[name] - {name}:
                visit(other, [*trail, name])
            visited.add(name)

    for name in names:
        visit(name, [])


def test_the_walk_sees_what_it_must():
    """A rule that looks at nothing would pass: the walk finds the package and its imports."""
    assert len(MODULES) > 30
    assert "sweep.model.preparation" in _imports(PACKAGE / "model" / "evaluation.py")
