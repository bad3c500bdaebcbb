"""Reports in a real browser without a network: they draw, their controls act, they can be read."""

import csv
from itertools import pairwise

import pytest

playwright = pytest.importorskip("playwright.sync_api")

VISIBLE_TRACES = """(chart) => document.querySelector(chart + " .plot").data
    .filter((trace) => trace.visible === true).map((trace) => trace.name ?? "")"""


def table(page, heading):
    """The table with a heading."""
    return page.locator("article", has=page.get_by_role("heading", name=heading, exact=True))


def chart(page, heading):
    """Selector of the chart with a heading."""
    return "#" + page.locator("figure.chart", has_text=heading).first.get_attribute("id")


def redrawn(page, selector, act):
    """What a chart shows once an act has made it draw anew."""
    page.evaluate(
        """(chart) => { window.again = new Promise((done) =>
            document.querySelector(chart + " .plot").once("plotly_afterplot", done)); }""",
        selector,
    )
    act()
    page.evaluate("window.again.then(() => true)")
    return page.evaluate(VISIBLE_TRACES, selector)


@pytest.fixture(scope="module")
def grid(opened, grid_page):
    """The grid's page on a desk; tests set the controls that they look at."""
    return opened(grid_page)


def test_a_grid_s_page_draws_and_its_controls_act(grid):
    assert grid.title() == grid.locator("h1").inner_text() == "Power </script><b>& slant</b>"
    surface = chart(grid, "probability of detection, shot")
    assert grid.evaluate(f"document.querySelector('{surface} .plot').data[0].z.length") == 3
    assert grid.evaluate(VISIBLE_TRACES, surface) == ["power 1 W"]
    power = grid.locator(surface).get_by_label("Shown for")
    assert redrawn(grid, surface, lambda: power.select_option("power 3 W")) == ["power 3 W"]
    kind = grid.locator(surface).get_by_label("Each cell shows the")
    assert redrawn(grid, surface, lambda: kind.select_option("lowest of each cell")) == [
        "power 3 W"
    ]
    visible_trace = "document.querySelector('{} .plot').data.findIndex((t) => t.visible === true)"
    assert grid.evaluate(visible_trace.format(surface)) == 3


def test_cuts_follow_the_slider_the_keyboard_and_the_side(grid):
    surface = grid.locator(chart(grid, "probability of detection, shot"))
    line = surface.locator(".cut .plot")
    drawn_values = "(plot) => Array.from(plot.data[0].y)"
    slider = surface.get_by_role("slider")
    assert slider.get_attribute("aria-valuetext") == "50"
    middle = line.evaluate(drawn_values)
    assert len(middle) == 401
    slider.focus()
    grid.keyboard.press("ArrowRight")
    assert slider.get_attribute("aria-valuetext") == "80"
    steep = line.evaluate(drawn_values)
    assert steep != middle
    rows = surface.locator(".plot").first.evaluate(
        "(plot) => plot.data.find((t) => t.visible === true).z.map((row) => Array.from(row))"
    )
    assert middle == rows[1] and steep == rows[2]
    surface.get_by_label("Along").select_option("grazing angle (°)")
    assert line.evaluate(drawn_values) == [row[200] for row in rows]


def test_tables_sort_search_and_download(grid, tmp_path):
    points = table(grid, "Points")
    points.get_by_text("Showing 1 to 10 of").wait_for()
    heading = points.get_by_role("columnheader", name="range [m]")
    for order in ("ascending", "descending"):
        heading.get_by_role("button").press("Enter")
        playwright.expect(heading).to_have_attribute("aria-sort", order)
    assert float(points.locator("tbody tr").first.locator("td").nth(1).inner_text()) == 12000
    with grid.expect_download() as download:
        points.get_by_role("button", name="Download CSV").click()
    assert download.value.suggested_filename == "points.csv"
    download.value.save_as(tmp_path / "points.csv")
    with open(tmp_path / "points.csv", encoding="utf-8-sig") as file:
        rows = list(csv.DictReader(file))
    assert 500 < len(rows) <= 1000
    assert {row["power [W]"] for row in rows} == {"1", "3"}
    effects = table(grid, "Effects")
    effects.get_by_role("searchbox").fill("sidelobes")
    effects.get_by_text("filtered from").wait_for()
    assert effects.locator(".dt-container tbody tr").count() == 1


def test_a_chart_is_saved_as_a_picture(grid):
    with grid.expect_download() as download:
        grid.get_by_role("button", name="Save as PNG").first.click()
    with open(download.value.path(), "rb") as file:
        assert file.read(8) == b"\x89PNG\r\n\x1a\n"


def test_colours_follow_the_scheme_while_the_page_is_open(grid):
    ink = "document.querySelector('figure.chart .plot')._fullLayout.font.color"
    before = grid.evaluate(ink)
    grid.emulate_media(color_scheme="dark")
    grid.wait_for_function(f"{ink} !== {before!r}")
    assert grid.evaluate("document.documentElement.classList.contains('dark')")
    grid.emulate_media(color_scheme="light")
    grid.wait_for_function(f"{ink} === {before!r}")


def named(page):
    """Whether every control and picture says what it is, and headings go down step by step."""
    page.locator(".dt-search input").first.wait_for()
    nameless = page.evaluate("""[...document.querySelectorAll("select, input, button, a[href]")]
        .filter((e) => !e.closest(".js-plotly-plot") && !(e.labels?.length || e.ariaLabel
            || e.textContent.trim())).map((e) => e.outerHTML)""")
    assert nameless == []
    labels = page.evaluate("[...document.querySelectorAll('[role=img]')].map((e) => e.ariaLabel)")
    assert len(labels) >= 4 and all(len(words or "") > 15 for words in labels)
    levels = page.evaluate("""[...document.querySelectorAll("h1, h2, h3")]
        .map((e) => Number(e.tagName[1]))""")
    assert levels[0] == 1 and levels.count(1) == 1
    assert all(b <= a + 1 for a, b in pairwise(levels))


def test_everything_is_named_and_reached_by_keyboard(grid):
    named(grid)
    grid.evaluate("document.activeElement.blur(); getSelection().removeAllRanges(); scrollTo(0, 0)")
    grid.locator("h1").click()
    grid.evaluate("document.querySelector('.skip').focus()")
    assert grid.evaluate("document.activeElement.getBoundingClientRect().left") >= 0
    places, outlined = [], set()
    for _ in range(25):
        grid.keyboard.press("Tab")
        place, outline = grid.evaluate("""(() => { const e = document.activeElement;
            return [[...document.querySelectorAll("*")].indexOf(e),
                    getComputedStyle(e).outlineStyle]; })()""")
        places.append(place)
        outlined.add(outline)
    assert places == sorted(places) and len(set(places)) == len(places)
    assert outlined == {"solid"}


def test_a_scene_s_cloud_is_drawn_coloured_and_turned(opened, scene_page):
    page = opened(scene_page)
    named(page)
    cloud = chart(page, "Points, flight path and terrain")
    assert page.locator(f"{cloud} canvas").count() > 0
    kinds = {"terrain", "flight path", "true points"}
    assert kinds <= set(page.evaluate(VISIBLE_TRACES, cloud))
    choose = page.locator(f"{cloud} .controls").get_by_label
    over = f"document.querySelector('{cloud} .plot').layout.title.text"
    for option, title in (("radial velocity", "radial velocity (m/s)"),
                          ("signal-to-noise ratio", "signal-to-noise ratio (dB)")):  # fmt: skip
        redrawn(page, cloud, lambda o=option: choose("Colour").select_option(o))
        assert page.evaluate(over) == title
    eye = f"document.querySelector('{cloud} .plot').layout.scene.camera.eye.z"
    redrawn(page, cloud, lambda: choose("View").select_option("from above"))
    assert page.evaluate(eye) > 1.5
    redrawn_cloud = redrawn(page, cloud, lambda: choose("Terrain").select_option("hidden"))
    assert "terrain" not in redrawn_cloud and page.evaluate(eye) > 1.5
    dim = redrawn(page, cloud, lambda: choose("Shown for").select_option("optical efficiency 0.01"))
    assert "flight path" in dim


@pytest.mark.parametrize(
    ("file", "scheme"),
    [
        ("grid_page", "dark"),
        pytest.param("scene_page", "light", marks=pytest.mark.slow),
    ],
)
def test_pages_fit_a_phone_in_both_schemes(opened, request, file, scheme):
    page = opened(request.getfixturevalue(file), width=390, scheme=scheme)
    assert page.evaluate("document.documentElement.scrollWidth") == 390
    wide = page.evaluate("""[...document.querySelectorAll("select, button, .plot, input")]
        .filter((e) => !e.closest(".table") && e.getBoundingClientRect().right > 390).length""")
    assert wide == 0
    page.get_by_text("Scroll the table sideways").first.wait_for(state="visible")
    ink, paper = page.evaluate("""["color", "backgroundColor"].map((name) =>
        getComputedStyle(document.body)[name].match(/[0-9]+/g).map(Number))""")
    assert (sum(ink) > sum(paper)) == (scheme == "dark")
    page.locator(".dt-search input").first.wait_for()
    colour = page.locator("table tbody td").first.evaluate(
        "(e) => getComputedStyle(e).color.match(/[0-9]+/g).map(Number)"
    )
    assert (sum(colour[:3]) > 3 * 128) == (scheme == "dark")
