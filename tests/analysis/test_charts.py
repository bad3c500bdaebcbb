"""Charts of grids: their cells, lines, axes and words, and that sheets draw them."""

import dask.array
import numpy as np
import pytest
import xarray as xr
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.collections import PolyCollection
from matplotlib.colors import LogNorm
from stored_studies import spec_over_axes

from sweep.analysis import canvas, charts
from sweep.analysis.selection import (
    CELL_HIGHEST,
    CELL_LOWEST,
    CELL_MEAN,
    PointSelection,
    SortedCoordinate,
    select_where,
)

BY_HAND = {CELL_MEAN: np.mean, CELL_LOWEST: np.min, CELL_HIGHEST: np.max}

UNITS = {"range": "m", "grazing_angle": "deg", "power": "W"}


def points_of(values, **axes):
    """Points with values over coordinates: each a name, or a zipped axis with several."""
    coordinates = {}
    for dim, along in axes.items():
        members = along if isinstance(along, dict) else {dim: along}
        for name, column in members.items():
            coordinates[name] = (dim, np.asarray(column), {"units": UNITS.get(name, "")})
    variables = {"pd_shot": (list(axes), np.asarray(values, float))}
    return PointSelection.from_dataset(xr.Dataset(variables, coordinates))


def points_on(x, y, values):
    """Points on the grid of x and y, values (len(y), len(x))."""
    return points_of(values, grazing_angle=y, range=x)


def surface(points, **changes):
    options = {"x": "range", "y": "grazing_angle", "variable": "pd_shot", "label": "pd"}
    return charts.surface_chart(points, **(options | changes))


def slices(points, by=""):
    return charts.slice_chart(points, x="range", by=by, variable="pd_shot", label="pd")


def sheet(chart):
    return canvas.draw_chart(chart, "", "")


def map_of(points):
    (panel,) = surface(points).panels
    return panel.heat_map


def painted(chart, value):
    """Number of pixels of the colour of a value between 0 and 1."""
    drawn = sheet(chart)
    drawn.canvas.draw()
    pixels = np.asarray(drawn.canvas.buffer_rgba())[..., :3].astype(int)
    colour = np.round(np.array(canvas.colour_map()(value)[:3]) * 255).astype(int)
    return int((np.abs(pixels - colour).max(axis=-1) <= 2).sum())


def test_a_grid_is_put_together_whatever_the_order_of_its_points():
    order = np.array([2, 0, 1])
    points = points_on(np.array([1.0, 2.0, 4.0])[order], [20.0, 10.0], [[6, 4, 5], [3, 1, 2]])
    assert map_of(points).x.tolist() == [1, 2, 4]
    assert map_of(points).values.tolist() == [[1, 2, 3], [4, 5, 6]]


def test_coordinates_that_vary_together_span_a_plane_with_holes():
    pairs = {"range": [1.0, 2.0, 2.0], "grazing_angle": [10.0, 10.0, 20.0]}
    panel = map_of(points_of([1, 2, 4], pairs=pairs))
    assert (panel.x.tolist(), panel.y.tolist()) == ([1, 2], [10, 20])
    assert np.isnan(panel.values[1, 0]) and panel.values[0].tolist() == [1, 2]
    assert panel.values[1, 1] == 4


@settings(max_examples=40)
@given(
    shape=st.tuples(st.integers(1, 40), st.integers(1, 90)),
    edges=st.tuples(st.integers(1, 50), st.integers(1, 50)),
    chunks=st.integers(1, 30),
    kind=st.sampled_from(list(BY_HAND)),
    seed=st.integers(0, 99),
)
def test_cells_hold_their_points_whatever_the_chunks(shape, edges, chunks, kind, seed):
    rng = np.random.default_rng(seed)
    values = np.where(rng.random(shape) < 0.2, np.nan, rng.random(shape))
    array = xr.DataArray(dask.array.from_array(values, chunks=chunks), dims=["y", "x"])
    sides = [
        SortedCoordinate(d, np.arange(n), np.arange(n) / 7)
        for d, n in zip("yx", shape, strict=True)
    ]
    points = PointSelection.from_dataset(xr.Dataset({"v": array}))
    coarse_values = points.coarsen("v", list(zip(sides, edges, strict=True)), kind).values
    up, across = (side.points_per_cell(number) for side, number in zip(sides, edges, strict=True))
    assert coarse_values.shape == tuple(
        side.cell_means(m).size for side, m in zip(sides, edges, strict=True)
    )
    assert all(size <= number for size, number in zip(coarse_values.shape, edges, strict=True))
    for (i, j), cell in np.ndenumerate(coarse_values):
        cell_values = values[i * up : (i + 1) * up, j * across : (j + 1) * across]
        cell_values = cell_values[np.isfinite(cell_values)]
        assert (
            cell == pytest.approx(BY_HAND[kind](cell_values), rel=1e-14)
            if cell_values.size
            else np.isnan(cell)
        )
    middle = np.mean(sides[1].values[:across])
    assert sides[1].cell_means(edges[1])[0] == pytest.approx(middle, rel=1e-14)


def test_parts_of_zipped_axes_are_distinguished():
    cut = {"zip": [
        {"target.range": ["1 km", "2 km", "3 km"], "target.grazing_angle": "15 deg"},
        {"target.range": ["1 km", "2 km", "3 km"], "target.grazing_angle": "85 deg"},
        {"target.range": "3 km", "target.grazing_angle": ["30 deg", "50 deg", "70 deg"]},
    ]}  # fmt: skip
    spec = spec_over_axes({"instrument.laser.power": ["1 W", "3 W"], "cut": cut})
    coordinates = {
        member.coordinate_name: (axis.name, member.display_values, {"units": member.units})
        for axis in spec.axes
        for member in axis.parameters
    }
    points = PointSelection.from_dataset(
        xr.Dataset({"pd_shot": (("power", "cut"), np.ones((2, 9)))}, coordinates)
    )

    def parts(panel_variables, selection):
        return charts.split_into_parts(select_where(points, spec, selection), panel_variables, 6)

    panel_points, left_out = parts(["range", "power"], {})
    assert left_out == 0
    assert [words for words, _ in panel_points] == ["grazing angle 15°", "grazing angle 85°"]
    assert panel_points[1][1].sorted_coordinate("range").indices.tolist() == [3, 4, 5]
    ((_, held),), _ = parts(["range", "power"], {"grazing_angle": "85 deg"})
    assert held.sorted_coordinate("range").values.tolist() == [1, 2, 3]
    assert parts(["range"], {"grazing_angle": "86 deg"}) == ([], 0)


def test_one_dip_in_ten_thousand_ranges_is_seen_in_the_picture():
    x, y = np.arange(1.0, 10_001.0), np.arange(1.0, 91.0)
    values = np.ones((90, 10_000))
    bar_alone = painted(surface(points_on(x, y, values)), 0.0)
    values[44, 6_173] = 0.0
    assert painted(surface(points_on(x, y, values)), 0.0) >= bar_alone + 4


def test_the_mean_of_a_cell_is_painted_next_to_its_lowest_value():
    x, y = np.arange(1.0, 10_001.0), np.arange(1.0, 91.0)
    values = np.ones((90, 10_000))
    values[:, ::10] = 0.0
    drawn = sheet(surface(points_on(x, y, values)))
    heights = [axes.get_title() for axes in drawn.axes[:2]]
    assert heights == ["mean of each cell", "lowest of each cell"]
    assert "each cell stands for 10 neighbouring points" in drawn.get_supxlabel().lower()


def test_cells_meet_half_way_between_points_and_in_the_logarithm_where_points_do():
    assert canvas.cell_edges(np.array([1.0, 2.0, 4.0]), False).tolist() == [0.5, 1.5, 3.0, 5.0]
    expected = np.array([0.1, 1.0, 10.0, 100.0]) * np.sqrt(10)
    assert canvas.cell_edges(np.array([1.0, 10.0, 100.0]), True) == pytest.approx(expected)
    assert charts.is_log_spaced(np.geomspace(1, 1e4, 30))
    assert not charts.is_log_spaced(np.linspace(1, 1e4, 30))


def test_probabilities_of_detection_span_0_to_1_and_tiny_chances_a_logarithm():
    chance = canvas.colour_norm(charts.fit_colour_scale("pd_shot", "pd", [np.array([0.4, 0.6])]))
    assert (chance.vmin, chance.vmax) == (0.0, 1.0)
    tiny = charts.fit_colour_scale("p_leakage_up", "leakage", [np.geomspace(1e-12, 0.1, 40)])
    assert isinstance(canvas.colour_norm(tiny), LogNorm)


def test_words_stand_one_after_the_other_along_an_axis():
    points = points_of(
        np.linspace(0, 1, 4).reshape(2, 2), grazing_angle=[10.0, 20.0], window=["hann", "hamming"]
    )
    panel = sheet(surface(points, x="window")).axes[0]
    assert [label.get_text() for label in panel.get_xticklabels()] == ["hann", "hamming"]


def test_parameters_that_vary_together_make_no_panels_and_others_do():
    points = points_of(np.ones((2, 2)), tnr=[5, 10], pairs={"range": [1.0, 2.0], "power": [1, 3]})
    assert points.distinguishing_coordinates(["range"]) == ["tnr"]
    assert points.distinguishing_coordinates(["range", "tnr"]) == []
    assert points.distinguishing_coordinates(["tnr"]) == ["range"]


def line_points(values, **by):
    values = np.asarray(values, float)
    return points_of(values, **by, range=np.arange(1.0, values.shape[-1] + 1))


def test_a_line_of_few_points_goes_through_each_of_them():
    (panel,) = sheet(slices(line_points([1.0, 0.2, 0.9]))).axes
    assert panel.lines[0].get_ydata().tolist() == [1.0, 0.2, 0.9]


def test_one_dip_in_ten_thousand_points_of_a_line_reaches_down_in_its_band():
    values = np.ones(10_000)
    values[6_173] = 0.0
    (panel,) = sheet(slices(line_points(values))).axes
    (band,) = [c for c in panel.collections if isinstance(c, PolyCollection)]
    corners = band.get_paths()[0].vertices
    low = corners[corners[:, 1] < 0.5]
    assert corners[:, 1].min() == 0.0
    # 20 points share a stretch, of which range is shown in km
    assert 6.1 < low[:, 0].min() <= low[:, 0].max() < 6.25
    assert panel.lines[0].get_ydata().min() == pytest.approx(0.95)


def test_each_value_of_by_has_its_line_in_the_order_of_the_study():
    three = line_points(np.outer([1.0, 0.5, 0.1], [1.0, 0.5, 0.25]), power=[5, 1, 3])
    drawn = sheet(slices(three, by="power"))
    (legend,) = drawn.legends
    texts = [text.get_text() for text in legend.get_texts()]
    assert texts == ["power 5 W", "power 1 W", "power 3 W"]
    (panel,) = drawn.axes
    assert [line.get_ydata()[0] for line in panel.lines] == [1.0, 0.5, 0.1]
