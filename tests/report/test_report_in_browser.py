"""Reports in a real browser without a network: they draw, their controls act, they can be read."""

import csv
import re
from itertools import pairwise

import pytest

SHOWN = """(chart) => document.querySelector(chart + " .plot").data
    .filter((trace) => trace.visible === true).map((trace) => trace.name ?? "")"""


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
    return page.evaluate(SHOWN, selector)


def test_a_grid_s_page_draws_and_its_controls_act(opened, grid_page):
    page = opened(grid_page)
    assert page.title() == page.locator("h1").inner_text() == "Power </script><b>& slant</b>"
    surface = chart(page, "probability of detection, shot")
    cells = page.evaluate(f"document.querySelector('{surface} .plot').data[0].z.length")
    assert cells == 3
    before = page.evaluate(f"document.querySelector('{surface} .plot').data[0].visible")
    assert before is True and page.evaluate(SHOWN, surface) == ["power 1 W"]
    power = page.locator(surface).get_by_label("Shown for")
    assert redrawn(page, surface, lambda: power.select_option("power 3 W")) == ["power 3 W"]
    kind = page.locator(surface).get_by_label("Each cell shows the")
    assert redrawn(page, surface, lambda: kind.select_option("lowest")) == ["power 3 W"]
    lowest = page.evaluate(
        f"document.querySelector('{surface} .plot').data.findIndex((t) => t.visible === true)"
    )
    assert lowest == 3


def test_cuts_follow_the_slider_the_keyboard_and_the_side(opened, grid_page):
    page = opened(grid_page)
    surface = page.locator(chart(page, "probability of detection, shot"))
    line = surface.locator(".cut .plot")
    drawn = "(plot) => Array.from(plot.data[0].y)"
    slider = surface.get_by_role("slider")
    assert slider.get_attribute("aria-valuetext") == "50"
    middle = line.evaluate(drawn)
    assert len(middle) == 401
    slider.focus()
    page.keyboard.press("ArrowRight")
    assert slider.get_attribute("aria-valuetext") == "80"
    steep = line.evaluate(drawn)
    assert steep != middle
    rows = surface.locator(".plot").first.evaluate(
        "(plot) => plot.data[0].z.map((row) => Array.from(row))"
    )
    assert middle == rows[1] and steep == rows[2]
    surface.get_by_label("Along").select_option("grazing angle (°)")
    assert line.evaluate(drawn) == [row[200] for row in rows]


def test_tables_sort_search_and_download(opened, grid_page, tmp_path):
    page = opened(grid_page)
    points = page.locator("article", has_text=re.compile("^Points"))
    points.get_by_text("Showing 1 to 10 of").wait_for()
    heading = points.get_by_role("columnheader", name="range [m]")
    heading.press("Enter")
    heading.press("Enter")
    assert heading.get_attribute("aria-sort") == "descending"
    assert float(points.locator("tbody tr").first.locator("td").nth(1).inner_text()) == 12000
    with page.expect_download() as download:
        points.get_by_role("button", name="Download CSV").click()
    assert download.value.suggested_filename == "points.csv"
    download.value.save_as(tmp_path / "points.csv")
    with open(tmp_path / "points.csv", encoding="utf-8-sig") as file:
        rows = list(csv.DictReader(file))
    assert 500 < len(rows) <= 1000
    assert {row["power [W]"] for row in rows} == {"1", "3"}
    effects = page.locator("article", has_text=re.compile("^Effects"))
    effects.get_by_role("searchbox").fill("leakage")
    effects.get_by_text("filtered from").wait_for()
    assert effects.locator("tbody tr").count() == 1


def test_a_chart_is_saved_as_a_picture(opened, grid_page):
    page = opened(grid_page)
    with page.expect_download() as download:
        page.get_by_role("button", name="Save as PNG").first.click()
    with open(download.value.path(), "rb") as file:
        assert file.read(8) == b"\x89PNG\r\n\x1a\n"


def test_a_scene_s_cloud_is_drawn_coloured_and_turned(opened, scene_page):
    page = opened(scene_page)
    cloud = chart(page, "Points, flight path and terrain")
    assert page.locator(f"{cloud} canvas").count() > 0
    kinds = {"terrain", "flight path", "true points"}
    assert kinds <= set(page.evaluate(SHOWN, cloud))
    colour = page.locator(cloud).get_by_label("Colour", exact=True)
    bar = """(chart) => document.querySelector(chart + " .plot").data.find((trace) =>
        trace.visible && trace.name === "true points").marker.colorbar.title.text"""
    for option, title in (("radial velocity", "radial velocity (m/s)"),
                          ("signal-to-noise ratio", "signal-to-noise ratio (dB)")):  # fmt: skip
        assert kinds <= set(redrawn(page, cloud, lambda o=option: colour.select_option(o)))
        assert page.evaluate(bar, cloud).replace("<br>", " ") == title
    eye = f"document.querySelector('{cloud} .plot').layout.scene.camera.eye.z"
    redrawn(
        page, cloud, lambda: page.locator(cloud).get_by_label("View").select_option("from above")
    )
    assert page.evaluate(eye) > 1.5
    terrain = page.locator(cloud).get_by_label("Terrain")
    assert "terrain" not in redrawn(page, cloud, lambda: terrain.select_option("hidden"))
    assert page.evaluate(eye) > 1.5
    place = page.locator(cloud).get_by_label("Shown for")
    assert "true points" in redrawn(
        page, cloud, lambda: place.select_option("optical efficiency 0.01")
    )


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_pages_fit_a_phone_in_both_schemes(opened, grid_page, scene_page, scheme):
    for file in (grid_page, scene_page):
        page = opened(file, width=390, scheme=scheme)
        assert page.evaluate("document.documentElement.scrollWidth") == 390
        wide = page.evaluate("""[...document.querySelectorAll("select, button, .plot, input")]
            .filter((e) => !e.closest(".table") && e.getBoundingClientRect().right > 390).length""")
        assert wide == 0
        ink, paper = page.evaluate("""["color", "backgroundColor"].map((name) =>
            getComputedStyle(document.body)[name].match(/[0-9]+/g).map(Number))""")
        assert (sum(ink) > sum(paper)) == (scheme == "dark")
        cell = page.locator("table tbody td").first
        cell.wait_for()
        colour = cell.evaluate("(e) => getComputedStyle(e).color.match(/[0-9]+/g).map(Number)")
        assert (sum(colour[:3]) > 3 * 128) == (scheme == "dark")


def test_colours_follow_the_scheme_while_the_page_is_open(opened, grid_page):
    page = opened(grid_page)
    lines = chart(page, "power 1 W")
    colour = f"document.querySelector('{lines} .plot').data[0].line?.color"
    template = f"document.querySelector('{lines} .plot')._fullLayout.font.color"
    before = page.evaluate(template)
    page.emulate_media(color_scheme="dark")
    page.wait_for_function(f"{template} !== {before!r}")
    assert page.evaluate("document.documentElement.classList.contains('dark')")
    assert page.evaluate(colour) is None or page.evaluate(colour).startswith("#")


def test_everything_is_named_and_reached_by_keyboard(opened, grid_page, scene_page):
    for file in (grid_page, scene_page):
        page = opened(file)
        page.locator(".dt-search input").first.wait_for()
        nameless = page.evaluate("""[...document.querySelectorAll("select, input, button, a[href]")]
            .filter((e) => !e.closest(".js-plotly-plot") && !(e.labels?.length || e.ariaLabel
                || e.textContent.trim())).map((e) => e.outerHTML)""")
        assert nameless == []
        silent = page.evaluate("""[...document.querySelectorAll("[role=img]")]
            .filter((e) => (e.ariaLabel ?? "").length < 15).length""")
        assert silent == 0 and page.locator("[role=img]").count() >= 5
        levels = page.evaluate("""[...document.querySelectorAll("h1, h2, h3")]
            .map((e) => Number(e.tagName[1]))""")
        assert levels[0] == 1 and levels.count(1) == 1
        assert all(b <= a + 1 for a, b in pairwise(levels))
        page.keyboard.press("Tab")
        assert page.evaluate("document.activeElement.className") == "skip"
        places = []
        for _ in range(25):
            page.keyboard.press("Tab")
            places.append(
                page.evaluate("""(() => { const e = document.activeElement;
                return [...document.querySelectorAll("*")].indexOf(e); })()""")
            )
        assert places == sorted(places) and len(set(places)) == len(places)
        assert page.evaluate("getComputedStyle(document.activeElement).outlineStyle") == "solid"
