"""Figures for print: vector formats, the same bytes every time, whatever the user's own style."""

import matplotlib
import pytest
from stored_studies import SURFACE_AXES, run_into_store

from sweep.analysis import canvas
from sweep.analysis.study_figures import draw_figures

FIGURE_MAPPINGS = [
    {"kind": "surface", "name": "surface", "variable": "pd_shot", "x": "range",
     "y": "grazing_angle"},
    {"kind": "slices", "name": "slices", "variable": "snr_up", "x": "range", "by": "grazing_angle",
     "where": {"grazing_angle": ["10 deg", "90 deg"]}},
]  # fmt: skip

BEGINNINGS = {"png": b"\x89PNG", "pdf": b"%PDF", "svg": b"<?xml"}


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return run_into_store(tmp_path_factory.mktemp("paper"), SURFACE_AXES, figures=FIGURE_MAPPINGS)


@pytest.fixture(scope="module")
def figure_files(store, tmp_path_factory):
    """Surface and slices as files by form."""
    folder = tmp_path_factory.mktemp("drawn")
    return {form: draw_figures(store, folder, form) for form in canvas.PICTURE_FORMATS}


@pytest.mark.parametrize("form", canvas.PICTURE_FORMATS)
def test_the_same_store_gives_the_same_bytes_whatever_the_day_and_the_style(
    form, store, figure_files, tmp_path, monkeypatch
):
    first = figure_files[form]
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "86400")
    with matplotlib.rc_context({"font.size": 20, "lines.linewidth": 5, "svg.hashsalt": "other"}):
        second_files = draw_figures(store, tmp_path / "again", form)
    assert [file.name for file in first] == [f"surface.{form}", f"slices.{form}"]
    for a, b in zip(first, second_files, strict=True):
        assert a.read_bytes() == b.read_bytes()
        assert a.read_bytes().startswith(BEGINNINGS[form])


def test_vector_files_hold_no_date_and_no_program(figure_files):
    pdf, svg = figure_files["pdf"][1].read_bytes(), figure_files["svg"][1].read_text()
    assert not any(word in pdf for word in (b"CreationDate", b"Matplotlib", b"Producer"))
    assert "<dc:date>" not in svg and "Matplotlib v" not in svg


def test_lines_stay_lines_and_surfaces_are_one_picture(figure_files):
    surface, slices = (file.read_text() for file in figure_files["svg"])
    assert "<image" not in slices
    assert 1 <= surface.count("<image") <= 3  # the panel, and the colour bar


def test_pdf_holds_whole_fonts(figure_files):
    assert b"/Type3" not in figure_files["pdf"][1].read_bytes()


def test_another_suffix_is_refused(tmp_path):
    with pytest.raises(KeyError):
        canvas.save_sheet(canvas.message_sheet("x"), tmp_path / "x.bmp")
