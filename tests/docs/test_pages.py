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

import sweep

REPOSITORY = Path(__file__).parents[2]
DOCS = REPOSITORY / "docs"
RUN = [DOCS / "tutorial.md", *sorted((DOCS / "howto").glob("*.md"))]
IN_SECONDS = ("read_results", "use_your_own_detector")
"""Pages that the fast suite runs."""

NEEDED = {"keep_stores_in_a_bucket": "moto.server"}
"""What a page has its reader install."""

BLOCK = re.compile(r"^```(\w+)\n(.*?)^```$", re.S | re.M)


def blocks(page):
    """Language and text of every block of a page, in order."""
    return BLOCK.findall(page.read_text(encoding="utf-8"))


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
        if language == "yaml":
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


def test_the_fields_page_is_as_the_models_are():
    text = runpy.run_path(str(DOCS / "field_reference.py"))["text"]()
    assert (DOCS / "fields.md").read_text(encoding="utf-8") == text, "make fields writes it anew"
    for needle in ("| `wavelength` | Optical wavelength; at least 1 nm", "## scene", "`kind`"):
        assert needle in text


@pytest.mark.parametrize("page", sorted(DOCS.rglob("*.md")), ids=lambda page: page.stem)
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
    built = subprocess.run(
        [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", "-b", "html", "-d",
         str(tmp_path / "doctrees"), str(DOCS), str(tmp_path / "site")],
        capture_output=True, text=True,
    )  # fmt: skip
    assert built.returncode == 0, built.stderr
    index = (tmp_path / "site" / "index.html").read_text(encoding="utf-8")
    assert 'href="tutorial.html"' in index and 'href="howto/share_a_study.html"' in index
