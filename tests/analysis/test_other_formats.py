"""Stores of every kind as netCDF files, tables and xarray's own plots."""

import importlib.util

import matplotlib
import numpy as np
import pytest
import xarray as xr
from stored_studies import spec_over_axes

import sweep
from sweep.storage.store_format import parse_software_versions
from sweep.tasks.accuracy.measurement import measure_accuracy

matplotlib.use("agg")

ENGINES = ["scipy", *(["netcdf4"] if importlib.util.find_spec("netCDF4") else [])]
WINDOWS = {"instrument.processing.window": ["hann", "hamming", "rectangular"]}
RANGES = {"target.range": ["1 km", "2 km", "4 km"]}
GRIDS = {
    "a point": ({}, {}),
    "numbers": (RANGES, {}),
    "words": (WINDOWS, {}),
    "both": (WINDOWS | RANGES, {}),
    "zipped": (
        {"design": {"zip": WINDOWS | {"instrument.laser.power": ["1 W", "2 W", "3 W"]}}},
        {},
    ),
    "drawn": (RANGES, {"draws": {"number": 40, "batch": 20}}),
    "until known": (RANGES, {"draws": {"limit": 200}, "accuracy": {"tolerance": 0.1}}),
    "whole spectra": (RANGES, {"draws": {"number": 4, "method": "spectra"}}),
}


def is_flat(value):
    """Tell whether an attribute goes into any file format."""
    values = value if isinstance(value, list) else [value]
    return all(isinstance(v, str | int | float) and not isinstance(v, bool) for v in values)


def flat(dataset):
    return all(is_flat(v) for a in (dataset, *dataset.variables.values()) for v in a.attrs.values())


@pytest.fixture(scope="module")
def grids(tmp_path_factory):
    directory, stores = tmp_path_factory.mktemp("grids"), {}
    for name, (axes, sections) in GRIDS.items():
        stores[name] = directory / f"{name}.zarr"
        sweep.run(
            spec_over_axes(axes, **sections), store=stores[name], scheduler="none", progress=False
        )
    return stores


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("name", GRIDS)
def test_a_grid_goes_through_netcdf_and_answers_the_same(grids, name, engine, tmp_path):
    dataset = sweep.open(grids[name])
    assert flat(dataset) and flat(xr.open_zarr(grids[name]))
    dataset.to_netcdf(tmp_path / "grid.nc", engine=engine)
    restored = xr.load_dataset(tmp_path / "grid.nc", engine=engine)
    xr.testing.assert_equal(restored, dataset.compute())
    assert restored.sweep.spec == dataset.sweep.spec
    for variable, bound in dataset.sweep.range_error().items():
        np.testing.assert_array_equal(restored.sweep.range_error()[variable], bound)
    xr.open_zarr(grids[name]).to_netcdf(tmp_path / "plain.nc", engine=engine)


@pytest.mark.parametrize("engine", ENGINES)
def test_a_join_goes_through_netcdf_and_answers_per_design(grids, engine, tmp_path):
    joined = sweep.open([grids["numbers"], grids["drawn"]])
    joined.to_netcdf(tmp_path / "joined.nc", engine=engine)
    restored = xr.load_dataset(tmp_path / "joined.nc", engine=engine)
    np.testing.assert_array_equal(
        restored.sweep.range_error().bound, joined.sweep.range_error().bound
    )


@pytest.mark.parametrize("engine", ENGINES)
def test_what_accuracy_costs_goes_into_netcdf(engine, tmp_path):
    store = tmp_path / "cost.zarr"
    assert measure_accuracy(spec_over_axes(RANGES), store_path=store, n_points=3, progress=False)
    dataset = xr.open_zarr(store)
    assert flat(dataset)
    dataset.to_netcdf(tmp_path / "cost.nc", engine=engine)
    restored = xr.load_dataset(tmp_path / "cost.nc", engine=engine)
    np.testing.assert_array_equal(restored.seconds, dataset.seconds)


@pytest.mark.parametrize("engine", ENGINES)
def test_a_flight_goes_into_netcdf_whole_or_by_scanner(scene_store, engine, tmp_path):
    tree = sweep.open_scene(scene_store)
    assert all(flat(node.to_dataset()) for node in tree.subtree)
    for name in ("square", "scene_map"):
        tree[name].to_dataset().to_netcdf(tmp_path / f"{name}.nc", engine=engine)
    (eyepoints, *_) = (scene_store.parent / "eyepoints").glob("*.zarr")
    assert flat(xr.open_zarr(eyepoints))
    xr.open_zarr(eyepoints).to_netcdf(tmp_path / "eyepoints.nc", engine=engine)
    if engine == "scipy":  # its files have no groups
        return
    tree.to_netcdf(tmp_path / "flight.nc", engine=engine)
    with xr.open_datatree(tmp_path / "flight.nc", engine=engine) as restored:
        difference = restored.sweep.compare(tree)["square"]
        assert float(abs(difference.pd_shot).max()) == 0


def test_a_table_of_a_scanner_s_shots_has_no_cell_of_the_map(scene_store):
    for tree in (sweep.open_scene(scene_store), xr.open_datatree(scene_store, engine="zarr")):
        shots = tree["pair"].to_dataset()[["beam_range", "pd_shot"]]
        assert not {"x", "y", "map_x", "map_y"} & {*map(str, shots.sizes), *map(str, shots.coords)}
        assert len(shots.to_dataframe()) == shots.sizes["shot"] * shots.sizes["power"]
    assert tree["scene_map"].height.dims == ("y", "x")


def test_the_map_of_a_store_of_an_earlier_version_gets_its_group(scene_store, monkeypatch):
    full_tree = xr.open_datatree(scene_store, engine="zarr")
    names = {"x": "map_x", "y": "map_y", "height": "map_height"}
    old = xr.DataTree.from_dict({
        "/": xr.merge([full_tree.to_dataset(), full_tree["scene_map"].to_dataset().rename(names)]),
        **{name: full_tree[name].to_dataset() for name in ("square", "pair")},
    })  # fmt: skip
    monkeypatch.setattr(xr, "open_datatree", lambda *_, **__: old)
    tree = sweep.open_scene(scene_store)
    np.testing.assert_array_equal(tree["scene_map"].height, full_tree["scene_map"].height)
    assert "map_x" not in tree["square"].to_dataset().coords


def test_software_is_reported_alike_by_stores_of_this_version_and_of_earlier_ones():
    versions = {"numba": "0.60", "numpy": "2.1.0rc1"}
    assert parse_software_versions({"software": versions}) == versions
    assert parse_software_versions({"software": "numba 0.60, numpy 2.1.0rc1"}) == versions


@pytest.mark.parametrize(
    "draw",
    [
        lambda ds: ds.pd_shot.plot(),
        lambda ds: ds.pd_shot.plot.line(x="window"),
        lambda ds: ds.pd_shot.plot.line(hue="window"),
        lambda ds: ds.pd_shot.plot.pcolormesh(x="window"),
        lambda ds: ds.pd_shot.isel(range=0).plot.step(),
        lambda ds: ds.plot.scatter(x="window", y="pd_shot"),
        lambda ds: ds.pd_shot.isel(range=0).to_series().plot.bar(),
    ],
)
def test_axes_of_words_are_plotted_by_xarray(grids, draw):
    dataset = sweep.open(grids["both"])
    assert dataset.window.dtype.kind == "U"
    assert draw(dataset) is not None
