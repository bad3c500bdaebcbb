import math
import tracemalloc

import numpy as np
import pytest
from small_flights import small_scene_spec
from small_studies import STUDY_MAPPING, small_spec

from sweep.storage.locations import parse_location
from sweep.tasks.studies.flight_study import FlightStudy
from sweep.tasks.studies.grid_study import canonical_point_rows
from sweep.tasks.studies.parameter_grid import (
    BLOCKS_OF_DEFAULT_SIZE_MAX,
    DEFAULT_BLOCK_POINTS,
    ParameterBlockGrid,
    default_block_points,
    fit_block_shape,
    worst_cpu_seconds_per_draw,
    worst_cpu_seconds_per_point,
)


def points_of(grid: ParameterBlockGrid) -> np.ndarray:
    """Numbers of the points of every block, laid end to end."""
    numbers = np.arange(grid.n_points).reshape(grid.shape)
    return np.concatenate([numbers[grid.block_slices(i)].ravel() for i in range(grid.n_blocks)])


@pytest.mark.parametrize("block_points", [1, 5, 7, 36, 1000])
def test_blocks_hold_every_point_once(block_points):
    grid = ParameterBlockGrid(small_spec(storage={"block_points": block_points}))
    assert sorted(points_of(grid)) == list(range(grid.n_points)) == list(range(72))
    assert max(grid.count_block_points(i) for i in range(grid.n_blocks)) <= block_points
    assert sum(grid.count_block_points(i) for i in range(grid.n_blocks)) == grid.n_points
    marked = np.zeros(grid.n_blocks, bool)
    marked[::2] = True
    assert grid.count_points_in_blocks(marked) == sum(
        grid.count_block_points(i) for i in range(0, grid.n_blocks, 2)
    )


def test_a_block_keeps_radiometric_axes_whole_before_geometric_ones():
    assert fit_block_shape((3, 10_000, 90), (False, True, True), 32768) == (3, 121, 90)
    assert fit_block_shape((10_000, 90, 3, 3), (True, True, False, False), 32768) == (40, 90, 3, 3)
    assert fit_block_shape((50_000, 4), (False, True), 32768) == (32768, 1)
    assert fit_block_shape((), (), 10) == ()
    assert ParameterBlockGrid(small_spec()).block_shape == (2, 1, 3)


def test_parameters_of_a_block_are_those_of_its_points_in_c_order():
    spec = small_spec()
    grid = ParameterBlockGrid(spec)
    by_name = {m.path: np.asarray(m.values) for axis in spec.axes for m in axis.parameters}
    all_values = np.meshgrid(*by_name.values(), indexing="ij")
    for i in range(grid.n_blocks):
        parameters = grid.parameters_of_block(i)
        for path, values in zip(by_name, all_values, strict=True):
            np.testing.assert_array_equal(parameters[path], values[grid.block_slices(i)].ravel())
        assert parameters["target.reflectance"] == 0.02


def test_members_of_a_zipped_axis_run_together():
    axes = {
        "cut": {
            "zip": [
                {"target.range": ["1 km", "2 km"], "target.grazing_angle": "15 deg"},
                {"target.range": "3 km", "target.grazing_angle": ["30 deg", "60 deg", "90 deg"]},
            ]
        }
    }
    grid = ParameterBlockGrid(small_spec(axes=axes, storage={"block_points": 5}))
    assert grid.dims == ("cut",)
    parameters = grid.parameters_of_block(0)
    np.testing.assert_allclose(parameters["target.range"], [1e3, 2e3, 3e3, 3e3, 3e3])
    degrees = np.degrees(parameters["target.grazing_angle"])
    np.testing.assert_allclose(degrees, [15, 15, 30, 60, 90])


def test_a_study_without_axes_is_one_point_in_one_block():
    grid = ParameterBlockGrid(small_spec(axes={}))
    assert (grid.n_points, grid.n_blocks, grid.block_slices(0), grid.count_block_points(0)) == (
        1,
        1,
        (),
        1,
    )
    assert canonical_point_rows(grid.parameters_of_block(0), 1).shape[0] == 1


def test_geometry_order_brings_equal_geometry_together_and_drops_nothing():
    grid = ParameterBlockGrid(small_spec(storage={"block_points": 36}))
    order, parameters = grid.point_order_by_geometry(0), grid.parameters_of_block(0)
    assert sorted(order) == list(range(grid.count_block_points(0)))
    ranges = parameters["target.range"][order]
    angles = parameters["target.grazing_angle"][order]
    changes = np.count_nonzero((np.diff(ranges) != 0) | (np.diff(angles) != 0))
    assert changes + 1 == len(set(zip(ranges, angles, strict=True)))


def rows_by_point(grid: ParameterBlockGrid) -> dict[tuple, bytes]:
    """Canonical row of each point, by range, angle and power."""
    rows = {}
    for i in range(grid.n_blocks):
        p, n = grid.parameters_of_block(i), grid.count_block_points(i)
        names = ("target.range", "target.grazing_angle", "instrument.laser.power")
        columns = [np.broadcast_to(p[name], (n,)) for name in names]
        for key, row in zip(zip(*columns, strict=True), canonical_point_rows(p, n), strict=True):
            rows[key] = row.tobytes()
    return rows


def test_a_points_row_follows_from_its_values_not_from_axes_order_or_blocks():
    all_rows = rows_by_point(ParameterBlockGrid(small_spec()))
    axes = dict(reversed(list(STUDY_MAPPING["axes"].items())))
    turned = rows_by_point(ParameterBlockGrid(small_spec(axes=axes, storage={"block_points": 5})))
    assert all_rows == turned
    assert len(set(all_rows.values())) == 72
    del axes["instrument.laser.power"]
    one_watt = rows_by_point(
        ParameterBlockGrid(small_spec(axes=axes))
    )  # 1 W is now a parameter, not an axis
    assert len(one_watt) == 36
    assert all(all_rows[point] == row for point, row in one_watt.items())


def test_words_and_signed_zeros_are_canonical():
    one = canonical_point_rows({"a": "hamming", "b": 0.0}, 2)
    other = canonical_point_rows(
        {"b": np.array([-0.0, 0.0]), "a": np.array(["hamming", "hann"])}, 2
    )
    assert one[0].tobytes() == other[0].tobytes()
    assert one[1].tobytes() != other[1].tobytes()


def test_no_text_makes_a_row_that_holds_nan():
    texts = np.array([f"kaiser({i / 100})" for i in range(20_000)])
    assert not np.isnan(canonical_point_rows({"window": texts}, texts.size)).any()


def test_a_grid_of_ten_million_blocks_costs_the_length_of_its_axes():
    axes = {
        "target.range": {"linear": ["1 m", "10 km"], "number": 10_000},
        "target.radial_velocity": {"linear": ["0 m/s", "100 m/s"], "number": 1000},
    }
    spec = small_spec(axes=axes, storage={"block_points": 1})
    tracemalloc.start()
    grid = ParameterBlockGrid(spec)
    assert math.prod(grid.shape) == grid.n_blocks == 10_000_000
    last = grid.parameters_of_block(grid.n_blocks - 1)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert last["target.range"] == pytest.approx(10e3)
    assert last["target.radial_velocity"] == pytest.approx(100.0)
    assert peak < 1_000_000
    with pytest.raises(IndexError):
        grid.block_slices(grid.n_blocks)


@pytest.mark.parametrize("seconds_per_point", [1e-6, 4e-5, 0.1, 100.0])
@pytest.mark.parametrize("points", [1, 32, 1000, 10**6, 10**9, 10**10, 10**12])
def test_files_stay_countable_and_all_cores_have_blocks(points, seconds_per_point):
    """Blocks of a single axis: 25 arrays of them are less than half a million files."""
    (size,) = fit_block_shape((points,), (False,), default_block_points(points, seconds_per_point))
    n_blocks = -(-points // size)
    assert n_blocks <= BLOCKS_OF_DEFAULT_SIZE_MAX
    assert (
        points > DEFAULT_BLOCK_POINTS * BLOCKS_OF_DEFAULT_SIZE_MAX or size <= DEFAULT_BLOCK_POINTS
    )
    study_seconds = points * seconds_per_point
    if study_seconds > 32 and points >= 32:  # blocks of a second and more
        assert n_blocks >= 24  # of whole points, hence not always 32
    assert n_blocks == 1 or (size + 1) * seconds_per_point > 0.5 or size == DEFAULT_BLOCK_POINTS


@pytest.mark.parametrize("draws", [1, 20, 64, 10**4])
@pytest.mark.parametrize("rate", ["0.1 Hz", "10 Hz", "1 kHz"])
def test_a_flights_blocks_are_cut_for_all_cores(draws, rate):
    """Of 3 to 30,000 shots: small flights are one block, large ones have work for many cores."""
    scanners = {"three": {"kind": "cone", "beams": 3, "half_angle": "22.5 deg", "rate": rate}}
    spec = small_scene_spec(scanners=scanners, draws={"number": draws}, storage={}, axes={})
    (grid,) = FlightStudy(spec, parse_location("none.zarr")).grids
    seconds = grid.n_points * worst_cpu_seconds_per_draw(spec)
    assert (grid.n_blocks == 1) == (seconds < 0.5) or grid.n_points // draws <= 256
    if seconds > 60:
        assert grid.n_blocks >= 32 or grid.count_block_points(0) // grid.block_shape[-2] >= 4000
    largest = max(grid.count_block_points(block) for block in range(min(grid.n_blocks, 50)))
    assert largest * worst_cpu_seconds_per_draw(spec) < max(1.2 * seconds / 32, 1.0)


SPECTRA = {"number": 1000, "method": "spectra"}


@pytest.mark.parametrize(
    ("changes", "block_points"),
    [
        ({}, 50_000),
        ({"draws": {"number": 10}}, 50_000),
        ({"draws": {"number": 1000}}, 1435),
        ({"draws": {"number": 1000, "batch": 10}}, 1435),
        ({"draws": {"limit": 1000}}, 1435),
        ({"draws": {"number": 10**9}}, 1),
        ({"footprint": STUDY_MAPPING["footprint"] | {"beamlets": 100_000}}, 2994),
        ({"draws": SPECTRA}, 18),
    ],
)
def test_a_block_of_points_that_take_long_holds_fewer(changes, block_points):
    """So that no block takes more than a minute or so: (40 us + 0.2 us a beamlet) a draw."""
    axes = {"target.range": {"linear": ["1 km", "2 km"], "number": 100_000}}
    spec = small_spec(axes=axes, storage={"block_points": 50_000}, **changes)
    assert ParameterBlockGrid(spec).block_shape == (block_points,)


def test_points_in_speckle_are_cut_into_smaller_blocks_than_smooth_ones():
    """A quick start of 13,500 points has work for several threads, of half a second and more."""
    axes = {"target.range": {"linear": ["1 km", "2 km"], "number": 13_500}}
    grids = {
        speckle: ParameterBlockGrid(
            small_spec(
                axes=axes,
                storage={},
                footprint=STUDY_MAPPING["footprint"] | {"phases": "incoherent", "speckle": speckle},
            )
        )
        for speckle in ("developed", "none")
    }
    assert 6 <= grids["developed"].n_blocks <= 8
    assert grids["none"].n_blocks <= 2


def test_the_dearest_value_of_an_axis_decides_how_large_blocks_are():
    sizes = {"instrument.processing.fft_size": [2**12, 2**16, 2**14]}
    spec = small_spec(axes=STUDY_MAPPING["axes"] | sizes, draws=SPECTRA)
    assert 1.1 > worst_cpu_seconds_per_point(spec) / (1000 * 2e-7 * 2**16) > 1


def test_what_runs_along_each_dimension_is_known_as_a_grid_is_made():
    """Threads share a grid: what filled in later could be seen half filled."""
    for grid in FlightStudy(small_scene_spec(), parse_location("none.zarr")).grids:
        sizes = [len(next(iter(values.values()))) for values in grid.values_by_dim()]
        assert sizes == list(grid.shape)
