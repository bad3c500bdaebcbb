"""Every module opens stores with the keywords by which their metadata is checked first."""

import ast
from pathlib import Path

PACKAGE = Path(__file__).parents[2] / "sweep"

ZARR_MODULES = {
    "storage/store_format.py",
    "storage/verified_store.py",
    "tasks/studies/store_verification.py",
}
"""Modules that may open groups and arrays of Zarr themselves."""


def test_stores_are_opened_by_their_checked_document_alone():
    modules = sorted(PACKAGE.rglob("*.py"))
    assert len(modules) > 30
    calls = (
        (path, node)
        for path in modules
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Call)
    )
    for path, node in calls:
        called = getattr(node.func, "attr", "")
        if called in {"open_zarr", "open_datatree", "open_dataset", "open_consolidated"}:
            checked = (
                key.arg is None and key.value.id == "OPEN_ZARR_KWARGS" for key in node.keywords
            )
            assert any(checked), path
        if called in {"open_group", "open_array"}:
            assert path.relative_to(PACKAGE).as_posix() in ZARR_MODULES
