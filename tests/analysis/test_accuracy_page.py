"""docs/accuracy.md is what its maker writes, and has the figures that it shows."""

import importlib.util
import re
from pathlib import Path

import pytest

from sweep.spec import SceneSpec, load
from sweep.tasks.accuracy.rungs import WRITTEN, Rung

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "accuracy.md").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def maker():
    found = importlib.util.spec_from_file_location("maker", ROOT / "benchmarks" / "accuracy.py")
    module = importlib.util.module_from_spec(found)
    found.loader.exec_module(module)
    return module


def test_the_page_is_of_the_text_and_the_studies_that_its_maker_has(maker):
    assert PAGE.startswith(maker.HEAD) and PAGE.endswith(maker.TAIL)
    headings = re.findall(r"^## (.*)$", PAGE, re.MULTILINE)
    assert headings[1:-1] == [study.heading for study in maker.STUDIES.values()]


def test_every_figure_shown_is_there(maker):
    shown = re.findall(r"!\[.*?\]\((.*?)\)", PAGE)
    assert shown == [f"accuracy_{name}.png" for name in maker.STUDIES]
    assert all((ROOT / "docs" / name).stat().st_size > 10_000 for name in shown)


def test_every_study_can_be_written_and_is_told_with_both_statements(maker):
    for study in maker.STUDIES.values():
        spec = load(ROOT / "experiments" / f"{study.experiment}.yaml")
        written = Rung(name="", kind=WRITTEN, overrides=study.overrides).of(spec)
        assert written.title == study.overrides.get("title", spec.title)
        section = PAGE.split(f"## {study.heading}\n")[1].split("\n## ")[0]
        assert "As written: " in section and "Reference: " in section
        if isinstance(written, SceneSpec) or not written.draws.any:
            assert "best single fixed setting" in section and "Against the thesis's way" in section
