import numpy as np
import pytest
from drawn_files import shows
from drawn_studies import POWERS, SURFACE, stored, study
from matplotlib.text import Text

from sweep.analysis import canvas
from sweep.analysis.figures import default_figures, draw

ASKED = [
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
TOGETHER = {"target.range": ["1 km", "3 km"], "instrument.laser.power": ["1 W", "3 W"]}


@pytest.fixture(scope="module")
def asked(tmp_path_factory):
    return stored(tmp_path_factory.mktemp("asked"), SURFACE, figures=ASKED)


def test_every_figure_and_table_of_the_spec_is_made_beside_the_store(asked):
    files = draw(asked)
    directory = asked.with_name("study-figures")
    names = ["pd_shot_surface.png", "along_range.png", "means.txt", "means.csv"]
    assert files == [directory / name for name in names]
    assert all(map(shows, files))


def test_a_table_averages_over_ranges_from_the_least_on(asked, tmp_path):
    import csv

    import sweep

    draw(asked, tmp_path)
    dataset = sweep.open(asked)
    with (tmp_path / "means.csv").open() as file:
        records = {record["row"]: record for record in csv.DictReader(file)}
    assert set(records) == {f"{angle}°" for angle in range(10, 100, 10)}
    far = dataset.pd_shot.sel(grazing_angle=30).values[dataset.range.values >= 1000]
    assert float(records["30°"]["mean"]) == pytest.approx(far.mean(), rel=1e-12)
    assert float(records["30°"]["median"]) == pytest.approx(np.median(far), rel=1e-12)
    assert int(records["30°"]["points"]) == far.size


def test_a_store_cut_short_is_drawn_with_what_it_has(tmp_path):
    path = stored(tmp_path, SURFACE, figures=ASKED, storage={"block_points": 40})
    log = path / ".sweep" / "receipts.jsonl"
    log.write_text(log.read_text().splitlines(keepends=True)[0])
    for chunk in (path / "pd_shot" / "c").rglob("*"):
        if chunk.is_file() and chunk.parent.name != "0":
            chunk.unlink()
    assert all(map(shows, draw(path)))


def test_a_figure_of_values_that_are_not_in_the_grid_says_so(tmp_path, monkeypatch):
    figure = ASKED[1] | {"where": {"grazing_angle": "17 deg"}}
    path = stored(tmp_path, {"target.range": ["1 km"], **SURFACE}, figures=[figure])
    sheets = []
    monkeypatch.setattr(canvas, "save", lambda sheet, file: sheets.append(sheet) or file)
    draw(path)
    ((words,),) = (sheet.texts for sheet in sheets)
    assert words.get_text().endswith("no point of the study has grazing angle 17 deg")


@pytest.mark.parametrize(
    "axes,kinds",
    [
        (SURFACE, ["surface", "surface"]),
        ({"target.range": ["1 km", "2 km"], "instrument.laser.power": ["1 W"]}, ["slices"] * 2),
        (POWERS, ["slices"] * 2),
        ({"instrument.processing.window": ["hann", "hamming"]}, ["table"] * 2),
        ({}, []),
    ],
)
def test_a_study_that_asks_for_nothing_has_the_figures_that_suit_its_axes(axes, kinds):
    assert [figure.kind for figure in default_figures(study(axes))] == kinds


@pytest.mark.parametrize(
    "axes,number",
    [
        (SURFACE, 2),
        ({}, 2),
        ({"along": {"zip": TOGETHER}}, 2),
    ],
)
def test_the_usual_figures_of_a_study_are_drawn(axes, number, tmp_path):
    files = draw(stored(tmp_path, axes))
    assert len(files) == number and all(map(shows, files))


def test_the_default_surface_has_range_across_and_angle_up():
    turned = dict(reversed(SURFACE.items()))
    assert [(f.x, f.y) for f in default_figures(study(turned))] == [("range", "grazing_angle")] * 2


@pytest.mark.parametrize("text", [r"$\frac{1}{$", "costs $5 or $6"])
def test_a_dollar_in_a_title_is_a_dollar(tmp_path, text):
    sheets = canvas.sheet(4.0, 2.0), canvas.empty(text)
    canvas.title(sheets[0], text)
    canvas.caption(sheets[0], text)
    shown = [found for sheet in sheets for found in sheet.findobj(Text) if found.get_text() == text]
    assert len(shown) == 3 and not any(found.get_parse_math() for found in shown)
    for sheet in sheets:
        canvas.save(sheet, tmp_path / "sheet.png")
