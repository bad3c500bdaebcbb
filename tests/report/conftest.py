"""Small studies, their pages, and a browser without a network to read them in."""

import shutil

import pytest
from click.testing import CliRunner
from report_specs import EXPERIMENTS, GRID_SPEC, SCENE_SPEC

from sweep.cli import main
from sweep.report.study_report import write_report
from sweep.spec import GridSpec, SceneSpec
from sweep.tasks import driver

CHROMIUM_ARGUMENTS = [
    "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-sync",
    "--disable-background-networking", "--disable-component-update",
]  # fmt: skip


@pytest.fixture(scope="session")
def grid_store(tmp_path_factory):
    """Two powers, 1201 ranges and three angles; not to be changed."""
    store = tmp_path_factory.mktemp("grid") / "grid.zarr"
    spec = GridSpec.from_mapping(GRID_SPEC, base=EXPERIMENTS)
    assert driver.run(spec, store=store, scheduler="none", progress=False).complete
    return store


@pytest.fixture(scope="session")
def scene_store(tmp_path_factory):
    """Four beams over hills, in full light and in dim; not to be changed."""
    store = tmp_path_factory.mktemp("scene") / "scene.zarr"
    spec = SceneSpec.from_mapping(SCENE_SPEC, base=EXPERIMENTS)
    assert driver.run(spec, store=store, scheduler="none", progress=False).complete
    return store


@pytest.fixture(scope="session")
def grid_page(grid_store):
    """The grid's page, which the command writes beside the store."""
    result = CliRunner().invoke(main, ["report", str(grid_store)], catch_exceptions=False)
    page = grid_store.with_name("grid-report.html")
    assert result.exit_code == 0 and result.stdout.startswith(f"{page}: ")
    return page


@pytest.fixture(scope="session")
def scene_page(scene_store):
    return write_report(scene_store, scene_store.with_name("scene.html"))


@pytest.fixture(scope="session")
def chromium():
    """A headless browser; skipped where there is none."""
    path = shutil.which("chromium") or shutil.which("chromium-browser")
    if path is None:
        pytest.skip("no chromium on the path")
    playwright = pytest.importorskip("playwright.sync_api")
    with playwright.sync_playwright() as playwright_session:
        browser = playwright_session.chromium.launch(executable_path=path, args=CHROMIUM_ARGUMENTS)
        yield browser
        browser.close()


@pytest.fixture(scope="module")
def opened(chromium):
    """Opens a page, all charts drawn, in a context of its own: ``opened(file, width=390)``.

    At the end it must have said nothing wrong, and asked nothing of any network.
    """
    page_errors, requested_urls, contexts = [], [], []

    def opened(file, *, width=1200, scheme="light"):
        context = chromium.new_context(
            viewport={"width": width, "height": 900}, color_scheme=scheme, offline=True
        )
        contexts.append(context)
        page = context.new_page()
        page.on("console", lambda m: page_errors.append(m.text) if m.type == "error" else None)
        page.on("pageerror", lambda error: page_errors.append(str(error)))
        page.on("request", lambda request: requested_urls.append(request.url))
        page.goto(file.as_uri())
        page.wait_for_selector("html[data-drawn=all]", timeout=60_000)
        return page

    yield opened
    for context in contexts:
        context.close()
    assert not page_errors
    assert not [url for url in requested_urls if not url.startswith(("file:", "data:", "blob:"))]
