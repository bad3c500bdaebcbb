import numpy as np
import pytest
from figure_files import has_content
from matplotlib.text import Text
from PIL import Image
from stored_studies import POWER_AND_CUT_AXES, SURFACE_AXES, run_into_store, spec_over_axes

from sweep.analysis import canvas
from sweep.analysis.charts import SHEET_CHART_SIZE_LIMITS
from sweep.analysis.study_figures import (
    GridResults,
    default_grid_figures,
    draw_figures,
    picture_source_text,
)
from sweep.report.html_page import make_interactive_plot
from sweep.report.study_report import write_report

FIGURE_MAPPINGS = [
    {"kind": "surface", "variable": "pd_shot", "x": "range", "y": "grazing_angle"},
    {
        "kind": "slices",
        "name": "along_range",
        "variable": "snr_up",
        "x": "range",
        "by": "grazing_angle",
        "where": {"grazing_angle": ["10 deg", "90 deg"]},
    },
    {
        "kind": "table",
        "name": "means",
        "variable": "pd_shot",
        "rows": "grazing_angle",
        "minimum_range": "1 km",
    },
]
WINDOWS = {"instrument.processing.window": ["rectangular", "hann", "blackman"]}
SPECKLE = {"footprint.speckle": ["none", "developed"]}
TOGETHER = {"target.range": ["1 km", "3 km"], "instrument.laser.power": ["1 W", "3 W"]}


@pytest.fixture(scope="module")
def figure_store(tmp_path_factory):
    return run_into_store(tmp_path_factory.mktemp("asked"), SURFACE_AXES, figures=FIGURE_MAPPINGS)


def test_every_figure_and_table_of_the_spec_is_made_next_to_the_store(figure_store):
    files = draw_figures(figure_store)
    directory = figure_store.with_name("study-figures")
    names = ["pd_shot_surface.png", "along_range.png", "means.txt", "means.csv"]
    assert files == [directory / name for name in names]
    assert all(map(has_content, files))


def test_a_table_averages_over_ranges_from_the_least_on(figure_store, tmp_path):
    import csv

    import sweep

    draw_figures(figure_store, tmp_path)
    dataset = sweep.open(figure_store)
    with (tmp_path / "means.csv").open() as file:
        records = {record["row"]: record for record in csv.DictReader(file)}
    assert set(records) == {f"{angle}°" for angle in range(10, 100, 10)}
    far = dataset.pd_shot.sel(grazing_angle=30).values[dataset.range.values >= 1000]
    assert float(records["30°"]["mean"]) == pytest.approx(far.mean(), rel=1e-12)
    assert float(records["30°"]["median"]) == pytest.approx(np.median(far), rel=1e-12)
    assert int(records["30°"]["points"]) == far.size


def test_a_store_cut_short_is_drawn_with_what_it_has(tmp_path):
    path = run_into_store(
        tmp_path, SURFACE_AXES, figures=FIGURE_MAPPINGS, storage={"block_points": 40}
    )
    log = path / ".sweep" / "receipts.jsonl"
    log.write_text(log.read_text().splitlines(keepends=True)[0])
    for chunk in (path / "pd_shot" / "c").rglob("*"):
        if chunk.is_file() and chunk.parent.name != "0":
            chunk.unlink()
    assert all(map(has_content, draw_figures(path)))


def test_a_figure_of_values_that_are_not_in_the_grid_says_so(tmp_path, monkeypatch):
    figure = FIGURE_MAPPINGS[1] | {"where": {"grazing_angle": "17 deg"}}
    path = run_into_store(tmp_path, {"target.range": ["1 km"], **SURFACE_AXES}, figures=[figure])
    sheets = []
    monkeypatch.setattr(
        canvas, "save_sheet", lambda sheet, file, source="": sheets.append(sheet) or file
    )
    draw_figures(path)
    ((words,),) = (sheet.texts for sheet in sheets)
    assert words.get_text().endswith("no point of the study has grazing angle 17 deg")


@pytest.mark.parametrize(
    "axes,kinds",
    [
        (SURFACE_AXES, ["surface", "surface"]),
        ({"target.range": ["1 km", "2 km"], "instrument.laser.power": ["1 W"]}, ["slices"] * 2),
        (POWER_AND_CUT_AXES, ["slices"] * 2),
        (WINDOWS, ["slices"] * 2 + ["table"] * 2),
        ({}, []),
    ],
)
def test_a_study_that_asks_for_nothing_has_the_figures_that_suit_its_axes(axes, kinds):
    assert [figure.kind for figure in default_grid_figures(spec_over_axes(axes))] == kinds


@pytest.mark.parametrize(
    "axes,number",
    [
        (SURFACE_AXES, 2),
        ({}, 2),
        ({"along": {"zip": TOGETHER}}, 2),
        (WINDOWS, 6),
        (WINDOWS | SPECKLE, 6),
    ],
)
def test_the_usual_figures_of_a_study_are_drawn(axes, number, tmp_path):
    files = draw_figures(run_into_store(tmp_path, axes))
    assert len(files) == number and all(map(has_content, files))


def test_the_default_surface_has_range_across_and_angle_up():
    turned = dict(reversed(SURFACE_AXES.items()))
    assert [(f.x, f.y) for f in default_grid_figures(spec_over_axes(turned))] == [
        ("range", "grazing_angle")
    ] * 2


@pytest.mark.parametrize("text", [r"$\frac{1}{$", "costs $5 or $6"])
def test_a_dollar_in_a_title_is_a_dollar(tmp_path, text):
    sheets = canvas.blank_sheet(4.0, 2.0), canvas.message_sheet(text)
    canvas.set_title(sheets[0], text)
    canvas.set_caption(sheets[0], text)
    artists = [
        text_artist
        for sheet in sheets
        for text_artist in sheet.findobj(Text)
        if text_artist.get_text() == text
    ]
    assert len(artists) == 3 and not any(text_artist.get_parse_math() for text_artist in artists)
    for sheet in sheets:
        canvas.save_sheet(sheet, tmp_path / "sheet.png")


WORDS = [
    {"kind": "slices", "name": "by_number", "variable": "pd_shot", "x": "window", "by": "range"},
    {"kind": "slices", "name": "by_words", "variable": "pd_shot", "x": "range", "by": "window"},
    {"kind": "surface", "name": "across", "variable": "pd_shot", "x": "window", "y": "range"},
    {"kind": "surface", "name": "up", "variable": "pd_shot", "x": "range", "y": "window"},
]


@pytest.mark.parametrize("draws", [{}, {"number": 20}])
def test_axes_of_words_are_drawn_by_category_in_files_and_pages(draws, tmp_path):
    axes = WINDOWS | {"target.range": ["1 km", "4 km", "9 km"]}
    path = run_into_store(tmp_path, axes, figures=WORDS, draws=draws)
    for form in ("png", "svg"):
        files = draw_figures(path, picture_format=form)
        assert len(files) == len(WORDS)
    assert all(map(has_content, draw_figures(path)))
    figures = GridResults.from_store(path)
    for figure in figures.figure_specs[:1]:
        (panel,) = figures.make_chart(figure, SHEET_CHART_SIZE_LIMITS).panels
        assert panel.x_axis.scale == "category"
        for line in panel.lines:  # in the order of the study, not of the alphabet
            assert line.x.tolist() == ["rectangular", "hann", "blackman"]
    values = figures.dataset.pd_shot
    for figure, words in zip(figures.figure_specs[2:], ("x", "y"), strict=True):
        (panel,) = figures.make_chart(figure, SHEET_CHART_SIZE_LIMITS).panels
        assert getattr(panel, f"{words}_axis").scale == "category"
        sheet_values = (
            values.transpose("range", "window") if words == "x" else values.transpose("window", ...)
        )
        np.testing.assert_allclose(panel.heat_map.values, sheet_values)
        assert getattr(panel.heat_map, words).tolist() == ["rectangular", "hann", "blackman"]
        (trace,) = make_interactive_plot(
            figures.make_chart(figure, SHEET_CHART_SIZE_LIMITS)
        ).figure.data
        assert getattr(trace, words).tolist() == ["rectangular", "hann", "blackman"]
    assert write_report(path, tmp_path / "page.html").stat().st_size > 1e6


def test_levels_are_contours_of_maps_and_lines_across_slices(tmp_path):
    levels = {"levels": [0.5, 0.9]}
    figures = [FIGURE_MAPPINGS[0] | levels, FIGURE_MAPPINGS[1] | levels | {"variable": "pd_shot"}]
    path = run_into_store(tmp_path, SURFACE_AXES, figures=figures)
    assert all(map(has_content, draw_figures(path)))
    surface, slices = (
        GridResults.from_store(path).make_chart(f, SHEET_CHART_SIZE_LIMITS)
        for f in GridResults.from_store(path).figure_specs
    )
    assert surface.panels[0].heat_map.contour_levels == (0.5, 0.9) and "0.5 and 0.9" in " ".join(
        surface.caption
    )
    levels = [line for line in slices.panels[0].lines if line.style == "level"]
    assert [line.y[0] for line in levels] == [0.5, 0.9]
    with canvas.uniform_style():
        sheet = canvas.draw_chart(surface, "", "")
    texts = {text.get_text() for axes in sheet.axes for text in axes.texts}
    assert texts == {"0.5", "0.9"}
    contours = [
        trace for trace in make_interactive_plot(surface).figure.data if trace.type == "contour"
    ]
    assert [trace.contours.start for trace in contours] == [0.5, 0.9]


@pytest.mark.parametrize("levels", [[2.0], [0.5, 0.9]])
@pytest.mark.parametrize("x", ["range", "window"])
def test_levels_that_nothing_reaches_or_across_words_leave_the_map(levels, x, tmp_path):
    other = {"range": "window", "window": "range"}[x]
    figure = {"kind": "surface", "variable": "pd_shot", "x": x, "y": other, "levels": levels}
    axes = WINDOWS | {"target.range": ["1 km", "4 km", "9 km"]}
    assert all(map(has_content, draw_figures(run_into_store(tmp_path, axes, figures=[figure]))))


def test_a_picture_says_what_it_was_drawn_from(figure_store, tmp_path):
    png, pdf, svg = (
        draw_figures(figure_store, tmp_path, form)[0] for form in ("png", "pdf", "svg")
    )
    spec = GridResults.from_store(figure_store).spec
    source_text = picture_source_text(spec.id, spec.figures[0])
    with Image.open(png) as image:
        assert image.info[canvas.PNG_SOURCE_FIELD] == source_text
    assert source_text in svg.read_text() and source_text.encode() in pdf.read_bytes()
