import numpy as np
import pytest
import xarray as xr
from matplotlib.colors import LogNorm

from sweep.analysis import canvas, cells, figures, surface
from sweep.analysis.selection import Points

UNITS = {"range": "m", "grazing_angle": "deg"}


def points_of(values, **axes):
    """Points with values over coordinates: each a name, or a zipped axis with several."""
    coordinates = {}
    for dim, along in axes.items():
        members = along if isinstance(along, dict) else {dim: along}
        for name, column in members.items():
            coordinates[name] = (dim, np.asarray(column), {"units": UNITS.get(name, "")})
    variables = {"pd_shot": (list(axes), np.asarray(values, float))}
    return Points.of(xr.Dataset(variables, coordinates))


def points_on(x, y, values):
    """Points on the grid of x and y, values (len(y), len(x))."""
    return points_of(values, grazing_angle=y, range=x)


def grid_of(found):
    (grid,) = surface.grids([found], "pd_shot", "range", "grazing_angle", ["mean"], (99, 99))
    return grid


def drawn(found, **changes):
    options = {"x": "range", "y": "grazing_angle", "variable": "pd_shot", "long_name": "pd"}
    options |= {"title": "", "note": ""}
    return figures.drawn_surface(found, **(options | changes))


def pixels(sheet):
    sheet.canvas.draw()
    return np.asarray(sheet.canvas.buffer_rgba())[..., :3].astype(int)


def painted(sheet, value):
    """Number of pixels of the colour of a value between 0 and 1."""
    colour = np.round(np.array(surface.colours()(value)[:3]) * 255).astype(int)
    return int((np.abs(pixels(sheet) - colour).max(axis=-1) <= 2).sum())


def test_a_grid_is_put_together_whatever_the_order_of_its_points():
    order = np.array([2, 0, 1])
    found = points_on(np.array([1.0, 2.0, 4.0])[order], [20.0, 10.0], [[6, 4, 5], [3, 1, 2]])
    assert grid_of(found).x.tolist() == [1, 2, 4]
    assert grid_of(found).values.tolist() == [[1, 2, 3], [4, 5, 6]]


def test_coordinates_that_vary_together_span_a_plane_with_holes():
    pairs = {"range": [1.0, 2.0, 2.0], "grazing_angle": [10.0, 10.0, 20.0]}
    grid = grid_of(points_of([1, 2, 4], pairs=pairs))
    assert (grid.x.tolist(), grid.y.tolist()) == ([1, 2], [10, 20])
    assert np.isnan(grid.values[1, 0]) and grid.values[0].tolist() == [1, 2]
    assert grid.values[1, 1] == 4


@pytest.mark.parametrize("kind,expected", [("mean", 0.9), ("lowest", 0.0), ("highest", 1.0)])
def test_points_that_share_a_cell_have_their_mean_lowest_or_highest(kind, expected):
    values = np.ones((1, 1000))
    values[0, 437] = 0.0
    found = points_on(np.arange(1000.0), [10.0], values)
    (grid,) = surface.grids([found], "pd_shot", "range", "grazing_angle", [kind], (100, 10))
    assert grid.values.shape == (1, 100)
    assert grid.values[0, 43] == pytest.approx(expected)
    assert grid.x[43] == pytest.approx(434.5)
    assert np.delete(grid.values[0], 43).tolist() == [1.0] * 99


def along(values, kind, most):
    """Values in cells along an axis."""
    size = len(values)
    side = cells.Side("x", np.arange(size), np.arange(float(size)))
    found = cells.reduced(xr.DataArray(values, dims="x"), [(side, most)], {}, kind)
    return found.values.tolist(), side.middles(most).tolist()


def test_a_last_cell_of_fewer_points_has_the_mean_of_those():
    assert along(np.arange(7.0), "mean", 3) == ([1.0, 4.0, 6.0], [1.0, 4.0, 6.0])


@pytest.mark.parametrize("kind", ["mean", "lowest", "highest"])
def test_a_cell_is_grey_only_where_none_of_its_points_is_computed(kind):
    values, _ = along(np.array([np.nan, np.nan, np.nan, 2.0]), kind, 2)
    assert np.isnan(values[0]) and values[1] == 2.0


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
    both = points_of(np.ones((2, 2, 2)), tnr=[1, 10], grazing_angle=[10.0, 20.0], range=[1.0, 2.0])
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
    found = points_of(
        np.linspace(0, 1, 4).reshape(2, 2), grazing_angle=[10.0, 20.0], window=["hann", "hamming"]
    )
    panel = drawn(found, x="window").axes[0]
    assert [label.get_text() for label in panel.get_xticklabels()] == ["hamming", "hann"]


def test_a_sheet_is_saved_as_a_png(tmp_path):
    path = canvas.save(canvas.empty("nothing here"), tmp_path / "deep" / "sheet.png")
    assert path.read_bytes().startswith(b"\x89PNG")


def test_parameters_that_vary_together_make_no_panels_and_others_do():
    found = points_of(np.ones((2, 2)), tnr=[5, 10], pairs={"range": [1.0, 2.0], "power": [1, 3]})
    assert found.further(["range"]) == ["tnr"]
    assert found.further(["range", "tnr"]) == []
    assert found.further(["tnr"]) == ["range"]
