"""The pages of docs/: what they tell to run runs, what they show is what comes, the site builds."""

import contextlib
import io
import os
import re
import runpy
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

import sweep
from sweep.cli import main
from sweep.model import outputs
from sweep.spec import Spec

REPOSITORY = Path(__file__).parents[2]
DOCS = REPOSITORY / "docs"
RUN = [REPOSITORY / "README.md", DOCS / "tutorial.md", *sorted((DOCS / "howto").glob("*.md"))]
IN_SECONDS = ("README", "read_results", "search_a_band")
"""Pages that the fast suite runs."""

NEEDED = {"keep_stores_in_a_bucket": "moto.server"}
"""What a page has its reader install."""

SETS_UP = "make "
"""Beginning of a block that sets up a copy of the repository: not run by a test in that copy."""

MAKES_A_FILE = ("import trimesh\n", "import numpy as np\n\ntime")
"""Beginnings of blocks that make what a spec reads."""

BLOCK = re.compile(r"^```(\w+)\n(.*?)^```$", re.S | re.M)


def blocks(page):
    """Language and text of every block of a page, in order."""
    found = BLOCK.findall(page.read_text(encoding="utf-8"))
    return [(language, text) for language, text in found if not text.startswith(SETS_UP)]


def lines(text):
    return [line.rstrip() for line in text.strip("\n").splitlines()]


def save(text):
    """A spec under the name that its first line gives."""
    path = Path(re.match(r"# (\S+\.yaml)\n", text).group(1))
    path.write_text(text, encoding="utf-8")
    return path


@pytest.fixture
def here(tmp_path, monkeypatch):
    """A directory of one's own with the experiments in it."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "experiments").symlink_to(REPOSITORY / "experiments")
    monkeypatch.setenv("PATH", f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setenv("PYTHONPATH", str(REPOSITORY))
    return tmp_path


@pytest.mark.parametrize("page", RUN, ids=lambda page: page.stem)
def test_blocks_are_of_kinds_that_can_be_run_and_specs_are_right(page, here):
    found = blocks(page)
    assert {language for language, _ in found} <= {"yaml", "sh", "python", "text"}
    assert {"sh", "python"} & {language for language, _ in found}
    for language, text in found:
        if language == "python" and text.startswith(MAKES_A_FILE):
            exec(compile(text, page.name, "exec"), {})
        elif language == "yaml":
            assert sweep.load(save(text)).title
    for (before, _), (language, _) in zip([("", ""), *found], found, strict=False):
        assert language != "text" or before == "python"


@pytest.mark.parametrize(
    "page",
    [
        pytest.param(p, id=p.stem, marks=[] if p.stem in IN_SECONDS else [pytest.mark.slow])
        for p in RUN
    ],
)
def test_what_a_page_tells_to_run_runs_and_shows_what_comes(page, here):
    if page.stem in NEEDED:
        pytest.importorskip(NEEDED[page.stem])
    names, printed = {}, ""
    for language, text in blocks(page):
        if language == "yaml":
            save(text)
        elif language == "sh":
            ran = subprocess.run(["bash", "-ec", text], capture_output=True, text=True)
            assert ran.returncode == 0, ran.stdout + ran.stderr
        elif language == "python":
            with contextlib.redirect_stdout(io.StringIO()) as out:
                exec(compile(text, page.name, "exec"), names)
            printed = out.getvalue()
        else:
            assert lines(printed) == lines(text)


@pytest.mark.parametrize(
    ("name", "needles"),
    [
        ("field", ["| `wavelength` | Optical wavelength; at least 1 nm", "## scene", "`kind`"]),
        ("variable", ["| `radial_velocity_error` | m s-1 | axes | float64 |", "| `weight` |"]),
    ],
)
def test_a_generated_reference_is_as_the_models_are(name, needles):
    text = runpy.run_path(str(DOCS / f"{name}_reference.py"))["text"]()
    assert (DOCS / f"{name}s.md").read_text(encoding="utf-8") == text, "make fields writes it anew"
    assert [needle for needle in needles if needle not in text] == []


def test_every_table_of_outputs_has_its_variables_in_the_reference():
    tables = [t for t in vars(outputs).values() if isinstance(t, dict)]
    named = {n for t in tables for n, o in t.items() if isinstance(o, outputs.Output)}
    page = (DOCS / "variables.md").read_text(encoding="utf-8")
    assert len(named) > 100
    assert {name for name in named if f"| `{name}` |" not in page} == set()


def test_the_axes_that_the_page_on_specs_shows_can_be_written():
    found = [text for language, text in blocks(DOCS / "specs.md") if language == "yaml"]
    (axes,) = [yaml.load(text, Loader=yaml.BaseLoader) for text in found if "axes:" in text]
    spec = sweep.load(REPOSITORY / "experiments" / "quickstart.yaml")
    mapping = spec.to_yaml_mapping() | axes | {"figures": []}
    names = [axis.name for axis in Spec.from_mapping(mapping, base=Path(".")).axes]
    assert names == ["range", "grazing_angle", "power", "cut"]


def test_every_question_on_the_first_page_leads_to_one_page():
    page = (DOCS / "index.md").read_text(encoding="utf-8").partition("## Ten questions")[2]
    rows = re.findall(r"^\| .*\?.* \| \[[^]]+\]\(([^)#]+\.md)(?:#([-\w]+))?\) \|$", page, re.M)
    assert len(rows) == 10
    for link, part in rows:
        headings = re.findall(r"^#+ (.*)$", (DOCS / link).read_text(encoding="utf-8"), re.M)
        assert not part or part in {h.lower().replace(" ", "-") for h in headings}, part


def test_every_page_is_two_clicks_or_fewer_from_the_first():
    def links(name):
        found = re.findall(r"\]\(([^)#\s:]+\.md)", (DOCS / name).read_text(encoding="utf-8"))
        return {os.path.normpath(Path(name).parent / link) for link in found}

    first = links("index.md")
    second = first.union(*(links(name) for name in first if (DOCS / name).exists()))
    pages = {str(page.relative_to(DOCS)) for page in DOCS.rglob("*.md")} - {"index.md"}
    assert pages - second == set()


@pytest.mark.parametrize(
    "page", sorted([*DOCS.rglob("*.md"), *REPOSITORY.glob("*.md")]), ids=lambda page: page.stem
)
def test_links_lead_to_files_that_are_there(page):
    for link in re.findall(r"\]\(([^)#\s]+)", page.read_text(encoding="utf-8")):
        assert re.match(r"https?:", link) or (page.parent / link).exists(), link


def test_every_module_that_the_architecture_names_is_there():
    page = (DOCS / "architecture.md").read_text(encoding="utf-8")
    named = re.findall(r"\bsweep/[\w/]+\.py", page)
    assert len(set(named)) > 40
    assert not [name for name in named if not (REPOSITORY / name).exists()]
    assert len(re.findall(r"^\d+\. `sweep/", page, re.M)) == 10


def test_the_site_builds_without_a_warning(tmp_path):
    pytest.importorskip("furo")
    pytest.importorskip("myst_parser")
    pytest.importorskip("sphinx_click")
    built = subprocess.run(
        [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", "-b", "html", "-d",
         str(tmp_path / "doctrees"), str(DOCS), str(tmp_path / "site")],
        capture_output=True, text=True,
    )  # fmt: skip
    assert built.returncode == 0, built.stderr
    index = (tmp_path / "site" / "index.html").read_text(encoding="utf-8")
    assert 'href="tutorial.html"' in index and 'href="howto/share_a_study.html"' in index
    commands = (tmp_path / "site" / "cli.html").read_text(encoding="utf-8")
    interface = (tmp_path / "site" / "api.html").read_text(encoding="utf-8")
    assert [name for name in main.commands if f'id="sweep-{name}"' not in commands] == []
    public = {*sweep.__all__} - {"__version__"}
    assert [name for name in public if f'id="sweep.{name}"' not in interface] == []
    assert 'id="sweep.analysis.opening.SweepAccessor.maximum_range"' in interface
