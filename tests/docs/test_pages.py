"""The pages of docs/: what they tell to run runs, what they show is what comes, the site builds."""

import contextlib
import io
import os
import re
import runpy
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

import sweep
from sweep.cli import main
from sweep.model import outputs
from sweep.spec import load_cluster_config

REPOSITORY = Path(__file__).parents[2]
DOCS = REPOSITORY / "docs"
CHANGES = REPOSITORY / "CHANGELOG.md"
"""Names what is gone too."""

PAGES = sorted([*REPOSITORY.glob("*.md"), *REPOSITORY.glob("*/*.md"), *DOCS.glob("howto/*.md")])
PAGES.remove(CHANGES)
IN_SECONDS = ("README.md", "docs/howto/read_results.md")
"""Pages that the fast suite runs."""

NEEDED = {"keep_stores_in_a_bucket": "moto.server", "variables": "pint_xarray"}
"""Modules that a page has its reader install."""

ELSEWHERE = re.compile(r"^(make|pip|helm|kubectl) |--cluster deploy/", re.M)
"""Commands that set up a copy of the repository or need a cluster: they are named, and not run."""

LAID_OVER = "laid_over.yaml"


class Words(yaml.SafeLoader):
    """Loader of YAML's scalars as they are written, and of its merge keys."""

    yaml_implicit_resolvers = {"<": yaml.SafeLoader.yaml_implicit_resolvers["<"]}  # noqa: RUF012


COMPLETE_SPEC = {
    "title": "What a fragment of a spec is laid over",
    "instrument": "chester_2017_table_4_1",
    "target": {"range": "20 m", "grazing_angle": "60 deg", "radial_velocity": "1 m/s",
               "reflectance": "0.1"},
}  # fmt: skip

SOURCES = sorted((REPOSITORY / "sweep").rglob("*.py"))

MAKES_A_FILE = (
    "import trimesh\n", "import numpy as np\n\ntime", "from pathlib import Path\n\n_ = Path("
)  # fmt: skip
"""Beginnings of blocks that make what a spec reads."""

BLOCK = re.compile(r"^```(\w+)\n(.*?)^```$", re.S | re.M)


def blocks(page):
    """Language and text of every block of a page, in order, but for those that run elsewhere."""
    matches = BLOCK.findall(page.read_text(encoding="utf-8"))
    return [(language, text) for language, text in matches if not ELSEWHERE.search(text)]


def name(page):
    return str(page.relative_to(REPOSITORY))


WITH_BLOCKS = [page for page in PAGES if blocks(page)]


def lines(text):
    return [line.rstrip() for line in text.strip("\n").splitlines()]


def save(text, over=COMPLETE_SPEC):
    """A spec under the name that its first line gives; one without is laid over a whole spec."""
    match = re.match(r"# (\S+\.yaml)\n", text)
    path = Path(match.group(1) if match else LAID_OVER)
    laid = text if match else yaml.dump(over | yaml.load(text, Words))
    path.write_text(laid, encoding="utf-8")
    return path


def is_quoted(code):
    """Tell whether code is a part of the source, shown to its first colon or comma."""
    return code.rstrip()[-1] in ":,"


@pytest.fixture
def working_directory(tmp_path, monkeypatch):
    """A directory of one's own with the experiments in it."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "experiments").symlink_to(REPOSITORY / "experiments")
    monkeypatch.setenv("PATH", f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setenv("PYTHONPATH", str(REPOSITORY))
    return tmp_path


@pytest.mark.parametrize("page", WITH_BLOCKS, ids=name)
def test_blocks_are_of_kinds_that_can_be_run_and_specs_are_right(page, working_directory):
    page_blocks = blocks(page)
    assert {language for language, _ in page_blocks} <= {"yaml", "sh", "python", "text"}
    over = COMPLETE_SPEC
    for (before, _), (language, text) in zip([("", ""), *page_blocks], page_blocks, strict=False):
        if language == "python" and text.startswith(MAKES_A_FILE):
            exec(compile(text, page.name, "exec"), {})
        elif language == "python" and is_quoted(text):
            assert any(text in module.read_text("utf-8") for module in SOURCES)
        elif language == "yaml" and page.parent.name != "deploy":
            path = save(text, over)
            assert sweep.load(path).title
            if path.name != LAID_OVER:
                over = yaml.load(text, Words)
        assert language != "text" or before in {"python", "sh"}


@pytest.mark.parametrize(
    "page",
    [
        pytest.param(p, id=name(p), marks=[] if name(p) in IN_SECONDS else [pytest.mark.slow])
        for p in WITH_BLOCKS
        if {"sh", "python"} & {language for language, _ in blocks(p)}
    ],
)
def test_what_a_page_tells_to_run_runs_and_shows_what_comes(page, working_directory):
    if page.stem in NEEDED:
        pytest.importorskip(NEEDED[page.stem])
    names, printed = {}, []
    for language, text in blocks(page):
        if language == "yaml" and page.parent.name == "deploy":
            over = page.with_name("kubernetes.yaml" if "secret:" in text else "slurm.yaml")
            assert load_cluster_config(save(text, yaml.safe_load(over.read_text("utf-8")))).security
        elif language == "yaml":
            save(text)
        elif language == "sh":
            ran = subprocess.run(
                ["bash", "-ec", text], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
            )
            assert ran.returncode == 0, ran.stdout
            printed = lines(ran.stdout)
        elif language == "python" and not is_quoted(text):
            with contextlib.redirect_stdout(io.StringIO()) as out:
                exec(compile(text, page.name, "exec"), names)
            printed = lines(out.getvalue())
        elif language == "text":  # what a command prints tells more, such as how far it is
            expected_lines = lines(text)
            assert [line for line in printed if line in expected_lines] == expected_lines, printed


def commands(page):
    """Commands that a page names, in its blocks and within its lines, a list of words each."""
    text = page.read_text(encoding="utf-8").replace("\\\n", " ")
    indented = re.findall(r"^    ((?:sweep|make) .*)", text, re.M)
    quoted = [" ".join(code.split()) for code in re.findall(r"`((?:sweep|make) [^`]+)`", text)]
    blocks = [line for block in re.findall(r"^```sh\n(.*?)^```$", text, re.S | re.M)
              for line in block.splitlines() if line.startswith(("sweep ", "make "))]  # fmt: skip
    return [shlex.split(line, comments=True) for line in [*indented, *quoted, *blocks]]


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_commands_and_their_options_are_there(page):
    for program, word, *arguments in commands(page):
        if program == "sweep" and word in main.commands:
            known = {option for p in main.commands[word].params for option in p.opts}
            options = {other.partition("=")[0] for other in arguments if other.startswith("-")}
            assert options <= known | {"--help", "-h"}, (word, options)
        elif program == "sweep":
            assert word in {"--help", "COMMAND"}, word


TARGETS = sorted(
    {word for page in PAGES for program, word, *_ in commands(page) if program == "make"}
)


@pytest.mark.parametrize("target", TARGETS)
def test_a_target_of_make_starts_programs_that_are_there(target, monkeypatch):
    monkeypatch.delenv("TIMES", raising=False)  # a file that even a dry run of parts would add to
    process = subprocess.run(
        ["make", "--dry-run", "--old-file", ".venv/.core", "--old-file", ".venv/.ready", target],
        cwd=REPOSITORY, capture_output=True, text=True,
    )  # fmt: skip
    assert process.returncode == 0 and process.stdout, process.stderr
    for path in {REPOSITORY / script for script in re.findall(r"\S+\.py\b", process.stdout)}:
        monkeypatch.syspath_prepend(str(path.parent))
        runpy.run_path(str(path), run_name="imported")


@pytest.mark.parametrize(
    ("name", "needles"),
    [
        ("field", ["| `wavelength` | Optical wavelength; at least 1 nm", "## scene", "`kind`"]),
        ("variable", ["| `radial_velocity_error` | m s-1 | axes | float64 |", "| `weight` |"]),
        ("effect", ["| `backscatter` | noise | shot noise of light that the air sends back |"]),
    ],
)
def test_a_generated_reference_is_as_the_models_are(name, needles):
    text = runpy.run_path(str(DOCS / f"{name}_reference.py"))["text"]()
    assert (DOCS / f"{name}s.md").read_text(encoding="utf-8") == text, "make fields writes it anew"
    assert [needle for needle in needles if needle not in text] == []


def test_every_table_of_outputs_has_its_variables_in_the_reference():
    tables = [t for t in vars(outputs).values() if isinstance(t, dict)]
    named = {n for t in tables for n, o in t.items() if isinstance(o, outputs.OutputVariable)}
    page = (DOCS / "variables.md").read_text(encoding="utf-8")
    assert len(named) > 100
    assert {name for name in named if f"| `{name}` |" not in page} == set()


def test_every_question_on_the_first_page_leads_to_one_page():
    page = (DOCS / "index.md").read_text(encoding="utf-8").partition("## Ten questions")[2]
    rows = re.findall(r"^\| .*\?.* \| \[[^]]+\]\(([^)#]+\.md)(?:#([-\w]+))?\) \|$", page, re.M)
    assert len(rows) == 10
    for link, part in rows:
        headings = re.findall(r"^#+ (.*)$", (DOCS / link).read_text(encoding="utf-8"), re.M)
        assert not part or part in {h.lower().replace(" ", "-") for h in headings}, part


def test_every_page_is_two_clicks_or_fewer_from_the_first():
    def links(name):
        page_links = re.findall(r"\]\(([^)#\s:]+\.md)", (DOCS / name).read_text(encoding="utf-8"))
        return {os.path.normpath(Path(name).parent / link) for link in page_links}

    first = links("index.md")
    second = first.union(*(links(name) for name in first if (DOCS / name).exists()))
    pages = {str(page.relative_to(DOCS)) for page in DOCS.rglob("*.md")} - {"index.md"}
    assert pages - second == set()


@pytest.mark.parametrize("page", [*PAGES, CHANGES], ids=name)
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
    assert 'id="sweep.analysis.datasets.SweepAccessor.maximum_range"' in interface
