"""Plans of grids and flights: the same however a study is cut up, and true to the tolerance."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import zarr
from small_flights import small_scene_spec
from small_studies import STUDY_MAPPING, run_serially, small_spec

from sweep.model.effects.catalogue import (
    EFFECT_NAMES,
    EFFECTS,
    effect_flag_attributes,
    effect_names_in_flags,
    pack_effect_flags,
)
from sweep.tasks.studies import study_plan as planned
from sweep.tasks.studies.flight_study import _find_tile_runs
from sweep.tasks.studies.grid_study import (
    POINTS_PER_TILE_MAX,
    EffectPlanner,
    GridStudy,
    SelectedEffects,
    TileGrid,
    fit_tile_shape,
)
from sweep.tasks.studies.parameter_grid import ParameterBlockGrid
from sweep.tasks.studies.study_loading import make_study
from sweep.tasks.studies.study_plan import effects_table

PROBABILITIES = ("pd_up", "pd_doppler", "pd_down", "pd_shot")
WIDE = {
    "instrument.laser.power": ["1 W", "3 W"],
    "target.range": {"linear": ["10 m", "9 km"], "number": 60},
    "target.grazing_angle": {"linear": ["2 deg", "90 deg"], "number": 35},
}
FORCED = {effect.name: "on" for effect in EFFECTS if not effect.is_random}


def study_arrays(spec):
    """Arrays of a study that have one value a point, over its whole grid, by name."""
    study, out = GridStudy(spec), {}
    for block in range(study.n_blocks):
        slices = study.grid.block_slices(block)
        for name, values in study.evaluate(block).items():
            if values.ndim == len(study.grid.shape):
                out.setdefault(name, np.empty(study.grid.shape, values.dtype))[slices] = values
    return out


@pytest.mark.parametrize("tiles", [[7], [3, 3, 3], [0, 1, 2], [2, 2, 5, 5, 5, 9], [4, 9, 9]])
def test_stretches_of_a_tile_lie_between_their_edges(tiles):
    tiles = np.array(tiles)
    edges, tile = _find_tile_runs(tiles)
    starts = np.flatnonzero(np.diff(tiles, prepend=tiles[0] - 1))
    assert edges.tolist() == [*starts, tiles.size]
    assert (tiles[edges[:-1]][tile] == tiles).all()


def test_tiles_are_alike_on_all_sides_and_hold_no_two_words():
    assert fit_tile_shape((10000, 90), (False, False)) == (32, 32)
    assert fit_tile_shape((10000, 7), (False, False)) == (146, 7)
    assert fit_tile_shape((3, 10000), (True, False)) == (1, POINTS_PER_TILE_MAX)
    assert fit_tile_shape((), ()) == ()


def test_every_point_lies_in_one_tile_that_has_its_parameters():
    axes = {"instrument.processing.window": ["hann", "hamming"], **WIDE}
    grid = ParameterBlockGrid(small_spec(axes=axes, storage={"block_points": 977}))
    tiles = TileGrid(grid)
    for block in range(0, grid.n_blocks, 7):
        numbers, place = tiles.tiles_of_block(block)
        points = grid.parameters_of_block(block)
        assert place.size == grid.count_block_points(block)
        for group in tiles.group_tiles(numbers):
            within = np.flatnonzero(np.isin(place, group.positions_in_request))
            window = group.parameters["instrument.processing.window"]
            assert set(points["instrument.processing.window"][within]) == {window}
            for tile, requested in enumerate(group.positions_in_request):
                own_points = within[place[within] == requested]
                for path in ("target.range", "target.grazing_angle", "instrument.laser.power"):
                    values = np.broadcast_to(
                        group.parameters[path],
                        (len(group.positions_in_request), *tiles.block_shape),
                    )
                    assert np.isin(points[path][own_points], values[tile]).all()


def test_few_points_tell_what_all_of_a_tile_call_for():
    """They settle only tiles that keep all that there is."""
    spec = small_spec(
        axes=WIDE,
        footprint={"phases": "incoherent", "speckle": "none"},
        accuracy={"tolerance": 1e-2},
    )
    selection = EffectPlanner(spec, ParameterBlockGrid(spec))
    tiles = np.arange(selection.tiles.n_blocks)
    is_kept = np.zeros((len(EFFECT_NAMES), tiles.size), bool)
    for chosen, plan in selection.iter_tile_plans(tiles):
        is_kept[:, chosen] = plan.is_kept
    for group in selection.tiles.group_tiles(tiles):
        full_plan = selection._plan_group(group)
        assert (is_kept[:, group.positions_in_request] == full_plan.is_kept).all()
    assert not is_kept.all(axis=1)[is_kept.any(axis=1)].all()


def test_few_points_of_a_tile_hold_the_largest_of_each_parameter():
    velocities = [f"{v} m/s" for v in (0, 1, 2, 3, 4, 70, 6, 7, 8, 9, 10, 11)]
    spec = small_spec(axes={**WIDE, "target.radial_velocity": velocities})
    tiles = TileGrid(ParameterBlockGrid(spec))
    (few,) = tiles.group_tiles(np.arange(tiles.n_blocks), 4)
    tile_velocities = few.parameters["target.radial_velocity"]
    assert (
        tile_velocities.max() == 70
        and tile_velocities.size < len(few.positions_in_request) * tiles.block_shape[-1]
    )


def test_points_are_computed_together_that_differ_in_no_effect_that_keeps_them_apart():
    bit = {name: np.uint32(1 << k) for k, name in enumerate(EFFECT_NAMES)}
    base, image, noise = bit["footprint"] | bit["doppler"], bit["image"], bit["signal_shot_noise"]
    flags = np.array([base, base | noise, base | image, base, base | image | noise], np.uint32)
    effects_by_group = {
        tuple(index): names
        for index, names, flags_of_group in SelectedEffects(
            flags, flags * 0.0
        ).iter_groups_computed_together()
    }
    group_effects = ("footprint", "doppler", "signal_shot_noise")
    assert effects_by_group == {(0, 1, 3): group_effects, (2, 4): (*group_effects, "image")}
    for index, _, flags_of_group in SelectedEffects(
        flags, flags * 0.0
    ).iter_groups_computed_together():
        np.testing.assert_array_equal(flags_of_group, flags[index])


def test_flags_and_names_are_each_other():
    is_kept = np.zeros((len(EFFECT_NAMES), 3), bool)
    is_kept[[0, 3], 0] = is_kept[-1, 1] = True
    flags = pack_effect_flags(is_kept)
    assert effect_names_in_flags(int(flags[0])) == (EFFECT_NAMES[0], EFFECT_NAMES[3])
    assert effect_names_in_flags(int(flags[1])) == (EFFECT_NAMES[-1],)
    assert effect_names_in_flags(int(flags[2])) == ()
    meanings = effect_flag_attributes()["flag_meanings"].split()
    assert [m for m, mask in zip(meanings, effect_flag_attributes()["flag_masks"], strict=True)
            if flags[0] & mask] == [EFFECT_NAMES[0], EFFECT_NAMES[3]]  # fmt: skip


def test_what_is_simulated_does_not_depend_on_blocks():
    """Bit for bit: plans are those of tiles, and a point's result depends on its effects alone."""
    few, many = (
        study_arrays(small_spec(axes=WIDE, storage={"block_points": n})) for n in (333, 65536)
    )
    for name in ("effects", "effects_error", "pd_up", "pd_shot", "p_leakage_up", "snr_down"):
        assert few[name].tobytes() == many[name].tobytes(), name


@pytest.mark.parametrize("phases", ["incoherent", "coherent"])
@pytest.mark.parametrize("tolerance", [1e-1, 1e-3, pytest.param(1e-5, marks=pytest.mark.slow)])
def test_probabilities_differ_from_all_effects_on_by_no_more_than_the_tolerance(tolerance, phases):
    footprint = {"beamlets": 9, "phases": phases, "speckle": "none"}
    sections = {"axes": WIDE, "footprint": footprint, "storage": {"block_points": 65536}}
    instrument = STUDY_MAPPING["instrument"]
    # Records hold all of their echoes: with part of them, overlap leaves more than it is asked to.
    late = instrument["processing"] | {"acquisition_delay": "61 us"}
    sections["instrument"] = instrument | {"processing": late}
    called = GridStudy(small_spec(**sections, accuracy={"tolerance": tolerance})).evaluate(0)
    every = GridStudy(small_spec(**sections, effects=FORCED, accuracy={"tolerance": 0})).evaluate(0)
    for name in PROBABILITIES:
        assert np.abs(called[name] - every[name]).max() <= tolerance, name
    assert called["effects_error"].max() <= tolerance
    if tolerance > 1e-5:
        assert called["effects_error"].max() > 0
        assert (called["effects"] != every["effects"]).any()


def test_less_is_simulated_the_larger_the_tolerance():
    counts = [
        np.bitwise_count(
            GridStudy(
                small_spec(axes=WIDE, accuracy={"tolerance": t}, storage={"block_points": 65536})
            )
            .effect_planner.select_for_block(0)
            .effect_flags
        ).sum()
        for t in (1e-3, 1e-2, 1e-1)
    ]
    assert counts[0] > counts[1] > counts[2]


def test_an_effect_is_simulated_everywhere_or_nowhere_if_the_spec_says_so():
    flags = study_arrays(small_spec(effects={"leakage": "on", "image": "off"}))["effects"]
    assert (flags >> EFFECT_NAMES.index("leakage") & 1).all()
    assert not (flags >> EFFECT_NAMES.index("image") & 1).any()


def test_a_plan_is_made_once_for_a_tile(monkeypatch):
    spec = small_spec(axes=WIDE, storage={"block_points": 100})
    selection, planned = EffectPlanner(spec, ParameterBlockGrid(spec)), []
    plans = selection.iter_tile_plans
    monkeypatch.setattr(
        selection, "iter_tile_plans", lambda tiles: planned.extend(tiles) or plans(tiles)
    )
    for block in range(ParameterBlockGrid(spec).n_blocks):
        selection.select_for_block(block)
    assert sorted(planned) == list(range(selection.tiles.n_blocks))


def test_some_points_of_a_block_have_the_effects_that_they_have_among_all(monkeypatch):
    """And only their tiles are planned: all those of a block of 10^6 points took a minute."""
    spec = small_spec(axes=WIDE, storage={})
    planner, selection, planned = (
        EffectPlanner(spec, ParameterBlockGrid(spec)),
        EffectPlanner(spec, ParameterBlockGrid(spec)),
        [],
    )
    plans = selection.iter_tile_plans
    monkeypatch.setattr(
        selection, "iter_tile_plans", lambda tiles: planned.extend(tiles) or plans(tiles)
    )
    points = np.array([7, 0, 2000, 7, 4199])
    selected, among = (
        selection.select_for_block(0, points),
        planner.select_for_block(0).subset(points),
    )
    np.testing.assert_array_equal(selected.effect_flags, among.effect_flags)
    np.testing.assert_array_equal(selected.error_bound, among.error_bound)
    assert 0 < len(planned) <= 4 < selection.tiles.n_blocks


def test_a_plan_plans_the_effects_of_few_points_of_a_large_block(monkeypatch):
    axes = {
        "target.range": {"linear": ["1 km", "3 km"], "number": 1000},
        "target.grazing_angle": {"linear": ["10 deg", "80 deg"], "number": 1000},
    }
    study, looked = (
        make_study(small_spec(axes=axes, storage={"block_points": 10**6}), Path("no.zarr")),
        [],
    )
    of_block = study.effect_planner.select_for_block

    def noted(block, points=None):
        looked.append(study.grid.count_block_points(block) if points is None else len(points))
        return of_block(block, points)

    monkeypatch.setattr(study.effect_planner, "select_for_block", noted)
    monkeypatch.setattr(planned, "GRID_TIMING_SECONDS", 0.01)
    assert study.n_blocks == 1 and planned.measure_seconds_per_point(study) > 0
    assert max(looked) < 1000


def test_a_smooth_target_has_no_speckle_whatever_targets_are_next_to_it():
    """Its beamlets add as powers; rough ones' at random."""
    axes = {"target.roughness": ["0 um", "10 um"], "target.range": ["1 km", "6 km"]}
    footprint = {"beamlets": 7, "phases": "incoherent", "speckle": "none"}
    draws = {"number": 50, "batch": 50}
    same = {"footprint": footprint, "draws": draws}
    values = study_arrays(small_spec(axes=axes, **same))
    smooth_arrays = study_arrays(small_spec(axes=axes | {"target.roughness": ["0 um"]}, **same))
    bit = np.uint32(1 << EFFECT_NAMES.index("speckle"))
    assert (values["effects"] & bit > 0).tolist() == [[False] * 2, [True] * 2]
    np.testing.assert_allclose(values["pd_shot"][0], smooth_arrays["pd_shot"][0], atol=1e-3, rtol=0)
    assert (values["pd_shot_error"][0] == 0).all() and (values["pd_shot_error"][1] > 0).any()


HALF_ROUGH = {"target.roughness": ["0 um", "10 um"], "target.range": ["1 km", "6 km"]}


@pytest.mark.parametrize("kind", ["grid with absent effects", "flight"])
def test_a_plan_tells_the_shares_of_points_that_the_store_has(kind, flight, tmp_path):
    spec, store = small_scene_spec(), flight
    if kind != "flight":
        spec = small_spec(axes=HALF_ROUGH, draws={"number": 3})
        store = run_serially(spec, tmp_path / "some.zarr").store
    arrays = [zarr.open_array(path, mode="r")[...] for path in store.rglob("effects")]
    flags = np.concatenate([values.ravel() for values in arrays])
    shares = {name: float(np.mean(flags >> k & 1)) for k, name in enumerate(EFFECT_NAMES)}
    table = effects_table(make_study(spec, store), costs=False)
    assert {row.name: row.simulated_fraction for row in table.rows} == pytest.approx(shares)
    assert len(set(shares.values())) > 1 and table.planned_tile_fraction == 1


def test_a_plan_measures_few_points_where_each_takes_long(monkeypatch):
    """Points of a tenth of a second, as those of a measured sweep: 16 of them and 576 an effect."""
    clock = SimpleNamespace(now=0.0, perf_counter=lambda: clock.now, process_time=lambda: clock.now)

    def evaluated(_spec, _parameters, count, _effects):
        clock.now += 0.1 * count
        return {}

    study = make_study(small_spec(axes=WIDE), Path("nowhere.zarr"))
    monkeypatch.setattr(planned, "evaluate_points", evaluated)
    monkeypatch.setattr(planned, "time", clock)
    assert planned.measure_seconds_per_point(study) == pytest.approx(0.1)
    kept_rows = [row for row in effects_table(study).rows if row.simulated_fraction > 0]
    assert len(kept_rows) > 5 and clock.now < 5 + 2 * len(kept_rows)
