import numpy as np
import pytest
from matplotlib.colors import LogNorm

from sweep.analysis import canvas, surface, surface_figure
from sweep.analysis.selection import Column, Points


def points_on(x, y, values, **others):
    """Points on the grid of x and y, values (len(y), len(x))."""
    across, up = np.meshgrid(x, y)
    coordinates = {"range": Column(across.ravel(), "m"), "grazing_angle": Column(up.ravel(), "deg")}
    coordinates |= {name: Column(column, "") for name, column in others.items()}
    return Points({"pd_shot": np.asarray(values, float).ravel()}, coordinates)


def drawn(found, **changes):
    options = {"x": "range", "y": "grazing_angle", "variable": "pd_shot", "long_name": "pd"}
    options |= {"title": "", "note": ""}
    return surface_figure.draw(found, **(options | changes))


def pixels(sheet):
    sheet.canvas.draw()
    return np.asarray(sheet.canvas.buffer_rgba())[..., :3].astype(int)


def painted(sheet, value):
    """Number of pixels of the colour of a value between 0 and 1."""
    colour = np.round(np.array(surface.colours()(value)[:3]) * 255).astype(int)
    return int((np.abs(pixels(sheet) - colour).max(axis=-1) <= 2).sum())


def test_a_grid_is_put_together_whatever_the_order_of_its_points():
    found = points_on([1.0, 2.0, 4.0], [10.0, 20.0], [[1, 2, 3], [4, 5, 6]])
    shuffled = found.at(np.random.default_rng(1).permutation(6))
    grid = surface.gridded(shuffled, "range", "grazing_angle", "pd_shot")
    assert grid.x.tolist() == [1, 2, 4]
    assert grid.values.tolist() == [[1, 2, 3], [4, 5, 6]]


def test_a_point_that_is_not_there_is_nan_in_the_grid():
    found = points_on([1.0, 2.0], [10.0, 20.0], [[1, 2], [3, 4]]).at(np.array([0, 1, 3]))
    grid = surface.gridded(found, "range", "grazing_angle", "pd_shot")
    assert np.isnan(grid.values[1, 0]) and np.isfinite(grid.values).sum() == 3


@pytest.mark.parametrize("kind,expected", [("mean", 0.9), ("lowest", 0.0), ("highest", 1.0)])
def test_points_that_share_a_cell_have_their_mean_lowest_or_highest(kind, expected):
    values = np.ones((1, 1000))
    values[0, 437] = 0.0
    grid = surface.Grid(np.arange(1000.0), np.zeros(1), values)
    cells = surface.reduced(grid, kind, 100, 10)
    assert cells.values.shape == (1, 100)
    assert cells.values[0, 43] == pytest.approx(expected)
    assert cells.x[43] == pytest.approx(434.5)
    assert np.delete(cells.values[0], 43).tolist() == [1.0] * 99


def test_a_last_cell_of_fewer_points_has_the_mean_of_those():
    grid = surface.Grid(np.arange(7.0), np.zeros(1), np.arange(7.0)[np.newaxis])
    cells = surface.reduced(grid, "mean", 3, 1)
    assert cells.values[0].tolist() == cells.x.tolist() == [1.0, 4.0, 6.0]


def test_a_cell_is_grey_only_where_none_of_its_points_is_computed():
    values = np.array([[np.nan, np.nan, np.nan, 2.0]])
    for kind in ("mean", "lowest", "highest"):
        cells = surface.reduced(surface.Grid(np.arange(4.0), np.zeros(1), values), kind, 2, 1)
        assert np.isnan(cells.values[0, 0]) and cells.values[0, 1] == 2.0


def test_one_dip_in_ten_thousand_ranges_is_seen_in_the_picture():
    x, y = np.arange(1.0, 10_001.0), np.arange(1.0, 91.0)
    values = np.ones((90, 10_000))
    bar_alone = painted(drawn(points_on(x, y, values)), 0.0)
    values[44, 6_173] = 0.0
    assert painted(drawn(points_on(x, y, values)), 0.0) >= bar_alone + 4


def test_the_mean_of_a_cell_is_painted_beside_its_lowest_value():
    x, y = np.arange(1.0, 10_001.0), np.arange(1.0, 91.0)
    values = np.ones((90, 10_000))
    values[:, ::10] = 0.0
    sheet = drawn(points_on(x, y, values))
    heights = [axes.get_title() for axes in sheet.axes[:2]]
    assert heights == ["mean of each cell", "lowest of each cell"]
    assert "each cell stands for 10 neighbouring points" in sheet._supxlabel.get_text().lower()


def test_what_else_varies_has_a_panel_for_each_value():
    found = points_on([1.0, 2.0], [10.0, 20.0], [[1, 2], [3, 4]])
    both = Points(
        {"pd_shot": np.tile(found.variables["pd_shot"], 2)},
        {n: Column(np.tile(c.values, 2), c.units) for n, c in found.coordinates.items()}
        | {"tnr": Column(np.repeat([1, 10], 4), "")},
    )
    titles = [axes.get_title() for axes in drawn(both).axes]
    assert titles[:2] == ["TNR 1", "TNR 10"]


def test_long_ranges_are_in_kilometres_and_angles_in_degrees():
    found = points_on([1000.0, 9000.0], [10.0, 20.0], [[1, 2], [3, 4]])
    panel = drawn(found).axes[0]
    assert panel.get_xlabel() == "range (km)" and panel.get_ylabel() == "grazing angle (°)"
    assert panel.get_xlim() == (-3.0, 13.0)


def test_cells_meet_half_way_between_points_and_in_the_logarithm_where_points_do():
    assert surface.edges(np.array([1.0, 2.0, 4.0]), False).tolist() == [0.5, 1.5, 3.0, 5.0]
    expected = np.array([0.1, 1.0, 10.0, 100.0]) * np.sqrt(10)
    assert surface.edges(np.array([1.0, 10.0, 100.0]), True) == pytest.approx(expected)
    assert surface.is_geometric(np.geomspace(1, 1e4, 30))
    assert not surface.is_geometric(np.linspace(1, 1e4, 30))


def test_probabilities_of_detection_span_0_to_1_and_tiny_chances_a_logarithm():
    norm = surface.scale("pd_shot", np.array([0.4, 0.6]))
    assert (norm.vmin, norm.vmax) == (0.0, 1.0)
    assert isinstance(surface.scale("p_leakage_up", np.geomspace(1e-12, 0.1, 40)), LogNorm)


def test_words_stand_one_after_the_other_along_an_axis():
    coordinates = {
        "window": Column(np.array(["hann", "hamming"] * 2), ""),
        "grazing_angle": Column(np.repeat([10.0, 20.0], 2), "deg"),
    }
    panel = drawn(Points({"pd_shot": np.linspace(0, 1, 4)}, coordinates), x="window").axes[0]
    assert [label.get_text() for label in panel.get_xticklabels()] == ["hamming", "hann"]


def test_a_sheet_is_saved_as_a_png(tmp_path):
    path = canvas.save(canvas.empty("nothing here"), tmp_path / "deep" / "sheet.png")
    assert path.read_bytes().startswith(b"\x89PNG")


def test_parameters_that_vary_together_make_no_panels_and_others_do():
    coordinates = {
        "range": Column(np.array([1.0, 2.0, 1.0, 2.0]), "m"),
        "power": Column(np.array([1.0, 3.0, 1.0, 3.0]), "W"),
        "tnr": Column(np.array([5, 5, 10, 10]), ""),
        "place": Column(np.array([0, 1, 0, 1]), "", index=True),
    }
    found = Points({"pd_shot": np.arange(4.0)}, coordinates)
    assert found.further(["range"]) == ["tnr"]
    assert found.further(["range", "tnr"]) == []
    assert found.further(["tnr"]) == ["range"]
