"""Stores of flights extended to larger studies: the bytes of these, and no shot drawn twice."""

import csv
import json
import shutil

import pytest
from click.testing import CliRunner
from small_flights import SCENE_MAPPING, small_scene_spec
from small_studies import file_contents, file_digests, run_serially
from test_extend import Interrupting, larger, see_it_refused

from sweep.cli import main
from sweep.model.pointcloud import navigation, point_cloud
from sweep.tasks.driver import extend, resume
from sweep.tasks.engine import worker
from sweep.tasks.engine.journal import read_store_recipe
from sweep.tasks.studies import flight_study
from sweep.tasks.studies.flight_study import FlightStudy
from sweep.tasks.studies.store_verification import verify

POWER, APERTURE = "instrument.laser.power", "instrument.telescope.aperture"
DESCENT = SCENE_MAPPING["platform"]["path"]
SMALLER = {
    "platform": SCENE_MAPPING["platform"] | {"path": DESCENT | {"to": ["0 m", "0 m", "1 km"]}},
    "scanners": {
        "three": SCENE_MAPPING["scanners"]["three"],
        "line": SCENE_MAPPING["scanners"]["line"] | {"rate": "2 Hz"},
    },
    "draws": {"number": 3, "returns": 3},
    "storage": {"block_shots": 48, "block_draws": 2},
}
"""Changes of the small scene: a shorter flight, seen by fewer shots."""


def flight(**changes):
    """The short flight: two scanners, two powers, three draws."""
    return small_scene_spec(**SMALLER | changes)


def shots_of(spec, *names):
    """Shots of some scanners of a study, by default of all."""
    return sum(spec.number_of_cycles(n) * spec.shots_per_cycle(n) for n in names or spec.scanners)


SHOTS, CYCLES = shots_of(flight()), flight().number_of_cycles("three")


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    """The store of the short flight, beside it its eyepoints; not to be changed."""
    return run_serially(flight(), tmp_path_factory.mktemp("flown") / "flight.zarr").store


@pytest.fixture
def working_directory(flown, tmp_path):
    """A copy of the store, beside it its eyepoints."""
    shutil.copytree(flown.parent, tmp_path, dirs_exist_ok=True)
    return tmp_path / flown.name


class Computed:
    """Shots that the model draws, times draws, and cycles that it solves."""

    def __init__(self):
        self.shots = self.cycles = 0


@pytest.fixture
def computed(monkeypatch):
    """What is computed from here on, but for what compiles the model."""
    count, cloud, solve = Computed(), point_cloud.simulate_cloud, navigation.solve_navigation

    def draw_shots(eyepoints, *, draws, **rest):
        count.shots += len(eyepoints.time) * draws
        return cloud(eyepoints, draws=draws, **rest)

    def solved(shots, points, **rest):
        solution = solve(shots, points, **rest)
        count.cycles += solution["altitude"].size
        return solution

    monkeypatch.setattr(point_cloud, "simulate_cloud", draw_shots)
    monkeypatch.setattr(navigation, "solve_navigation", solved)
    monkeypatch.setattr(FlightStudy, "compile_kernels", lambda self: None)
    return count


@pytest.fixture(scope="module")
def drawn_more(flown):
    """Files of the short flight with more draws, run at once."""
    files = at_once(flight(draws=MORE_DRAWS), flown)
    shutil.rmtree(flown.with_name("at_once.zarr"))
    return files


def at_once(spec, store):
    """Files of a study that is run at once, with the eyepoints of another."""
    return file_digests(run_serially(spec, store.with_name("at_once.zarr")).store)


TWO, THREE = ["0.01 W", "1 W"], ["3 W", "1 W", "0.01 W"]
DRAWS = SMALLER["draws"]
MORE_DRAWS = DRAWS | {"number": 6}
LARGE = {"block_shots": 4096, "block_draws": 64}

MORE = {
    "values in another order": ({"axes": {POWER: ["1 W", "0.1 W", "0.01 W"]}}, 3),
    "an axis before": ({"axes": {APERTURE: ["40 mm", "50 mm"], POWER: TWO}}, 6),
    "draws": ({"draws": MORE_DRAWS}, 6),
    "large blocks": ({"storage": LARGE}, 0),
    "draws and values in other blocks": (
        {"storage": {"block_shots": 33, "block_draws": 4}, "draws": MORE_DRAWS,
         "axes": {POWER: THREE}}, 6 + 6,
    ),
}  # fmt: skip
"""What is larger, and draws of every shot that are new, over all places along the axes."""


@pytest.mark.parametrize(
    "changes, new",
    [
        pytest.param(
            *case,
            id=name,
            marks=[pytest.mark.slow] * (name != "draws and values in other blocks"),
        )
        for name, case in MORE.items()
    ],
)
def test_it_ends_as_the_larger_study_run_at_once(working_directory, computed, changes, new):
    spec = flight(**changes)
    outcome = larger(working_directory, spec)
    assert outcome.complete and outcome.store == working_directory
    assert outcome.rays_by_scanner == {"three": 0, "line": 0}
    assert computed.shots == outcome.points_computed == SHOTS * new
    assert computed.cycles == CYCLES * new
    assert sorted(file.name for file in working_directory.parent.iterdir()) == [
        "eyepoints",
        working_directory.name,
    ]
    assert file_digests(working_directory) == at_once(spec, working_directory)


def test_an_axis_may_come_where_there_was_none(working_directory, computed):
    one = run_serially(flight(axes={}), working_directory.with_name("one.zarr")).store
    computed.shots = 0
    assert larger(one, flight()).complete and computed.shots == SHOTS * 3
    assert file_digests(one) == file_digests(working_directory)


def test_a_scanner_may_come_and_nothing_of_the_others_is_computed(working_directory, computed):
    cone = SCENE_MAPPING["scanners"]["three"] | {"beams": 4, "rate": "2 Hz"}
    spec = flight(scanners={"four": cone, **SMALLER["scanners"]})
    outcome = larger(working_directory, spec)
    assert outcome.complete and computed.shots == shots_of(spec, "four") * 3 * 2
    assert (
        outcome.rays_by_scanner["four"]
        > 0
        == outcome.rays_by_scanner["three"]
        == outcome.rays_by_scanner["line"]
    )
    assert file_digests(working_directory) == at_once(spec, working_directory)


def test_by_workers_in_another_place_and_not_a_byte_of_the_store_changes(
    working_directory, computed, drawn_more
):
    before, new = file_contents(working_directory), working_directory.with_name("larger.zarr")
    spec = flight(draws=MORE_DRAWS)
    outcome = extend(working_directory, spec, to=new, workers=2, processes=False, progress=False)
    assert outcome.complete and outcome.store == new and computed.shots == SHOTS * 6
    assert file_contents(working_directory) == before and file_digests(new) == drawn_more


def test_as_it_is_typed(working_directory, monkeypatch):
    monkeypatch.chdir(working_directory.parent)
    change = f"axes.{POWER}=[0.01 W, 1 W, 3 W]"
    result = CliRunner().invoke(
        main, ["extend", working_directory.name, "--set", change, "--scheduler", "none"]
    )
    counts_text, all_text = (f"{SHOTS * 3 * places:,}" for places in (2, 3))
    assert result.exit_code == 0
    assert (
        f"{counts_text} of {all_text} shots are there; {SHOTS * 3:,} to compute\n" in result.stderr
    )
    assert f"{working_directory.name}: {all_text} of {all_text} shots" in result.stdout
    second_result = CliRunner().invoke(main, ["extend", working_directory.name, "--set", change])
    assert second_result.exit_code == 0 and "nothing to extend" in second_result.stderr
    assert all(report.is_undamaged and report.complete for report in verify(working_directory))


#: Errors that are numbers, and do not follow the tolerance.
CLOSE = {"line_error": 1e-5, "leakage_error": 1e-5}


def test_with_a_tighter_tolerance_only_shots_that_call_for_more_are_computed(
    working_directory, computed, monkeypatch, capsys
):
    """Tiles of 16 shots, which neither blocks nor cycles fit: some cycles are known in part."""
    monkeypatch.setattr(flight_study, "SHOTS_PER_TILE", 16)
    axes = {POWER: ["0.03 W", "0.1 W"]}
    coarse, fine = (
        flight(accuracy={"tolerance": tolerance, **CLOSE}, axes=axes) for tolerance in (0.2, 0.02)
    )
    store = run_serially(coarse, working_directory.with_name("coarse.zarr")).store
    shots_cast, solved = computed.shots, computed.cycles
    computed.shots = computed.cycles = 0
    assert extend(store, fine, scheduler="none").complete
    assert 0 < computed.shots < shots_cast and 0 < computed.cycles < solved
    assert "shots that call for more effects with the tolerance" in capsys.readouterr().err
    assert file_digests(store) == at_once(fine, working_directory)


def test_where_the_tolerance_says_how_closely_all_is_computed_again(
    working_directory, computed, capsys
):
    spec = flight(accuracy={"tolerance": 1e-4})
    assert extend(working_directory, spec, scheduler="none").complete
    assert computed.shots == SHOTS * 6
    stderr = capsys.readouterr().err
    assert f"0 of {SHOTS * 6:,} shots are there" in stderr
    assert "computed more closely, and anew, but where accuracy.line_error and" in stderr
    assert file_digests(working_directory) == at_once(spec, working_directory)


def chunk(store, name, part, scanner="three"):
    """File of a block's chunk, by its place on the axis, draws and cycles."""
    study = FlightStudy(flight(), store)
    block = study.first_block_of_group(scanner) + study.scanner_grids[scanner].block_at(part)
    place = study.chunk_positions_of_block(block)[f"{scanner}/{name}"]
    return store.joinpath(scanner, name, "c", *map(str, place))


@pytest.mark.parametrize(
    "name, stretch, lost",
    [
        ("effects", 0, 3),
        *(
            pytest.param(*case, marks=pytest.mark.slow)
            for case in (("flags", 1, 1), ("pd_shot", 0, 3))
        ),
    ],
)
def test_a_damaged_block_is_computed_again(
    working_directory, computed, drawn_more, name, stretch, lost
):
    """In place of its own a block has another's chunk, which any reader takes for sound.

    With the block of a shot's first draws all of its draws are lost: what it was is not known.
    """
    other = chunk(working_directory, name, (1, stretch, 0)).read_bytes()
    damaged = chunk(working_directory, name, (0, stretch, 0))
    assert damaged.read_bytes() != other
    damaged.write_bytes(other)
    assert larger(working_directory, flight(draws=MORE_DRAWS)).complete
    assert computed.shots == SHOTS * 6 + 48 * lost and file_digests(working_directory) == drawn_more


def test_only_what_is_committed_of_an_incomplete_store_is_taken(
    working_directory, computed, capsys
):
    """Without the block of the first draws of some shots, that of their last is of no use."""
    log = working_directory / ".sweep" / "receipts.jsonl"
    lines = log.read_text().splitlines(keepends=True)[1:7]
    log.write_text("".join(lines))
    older = FlightStudy(flight(), working_directory)
    useless = older.first_block_of_group("three") + older.scanner_grids["three"].block_at((0, 1, 0))
    points_by_block = {record["block"]: record["points"] for record in map(json.loads, lines)}
    n_points = sum(points_by_block.values()) - points_by_block[useless]
    spec = flight(axes={POWER: [*TWO, "3 W"]}, storage=LARGE)
    assert extend(working_directory, spec, scheduler="none").complete
    assert computed.shots == SHOTS * 9 - n_points
    assert f"{n_points:,} of {SHOTS * 9:,} shots are there" in capsys.readouterr().err
    assert file_digests(working_directory) == at_once(spec, working_directory)


def test_the_store_still_says_where_the_files_of_its_scene_are(tmp_path, monkeypatch, computed):
    base = tmp_path / "declared"
    base.mkdir()
    with (base / "path.csv").open("w") as file:
        csv.writer(file).writerows(
            [["time [s]", "x [m]", "y [m]", "z [m]"], [0, 0, 0, 900], [3, 90, 0, 750]]
        )
    platform = SCENE_MAPPING["platform"] | {"path": {"kind": "waypoints", "file": "path.csv"}}
    changes = SCENE_MAPPING | SMALLER | {"platform": platform, "draws": {"number": 1}}
    older, spec = (
        type(small_scene_spec()).from_mapping(changes | sections, base=base)
        for sections in ({}, {"draws": {"number": 2}})
    )
    store = run_serially(older, tmp_path / "flight.zarr").store
    other_directory = tmp_path / "elsewhere"
    other_directory.mkdir()
    monkeypatch.chdir(other_directory)
    computed.shots = 0
    assert larger(store, None, changes={"draws.number": 2}).complete
    assert computed.shots == shots_of(spec) * 2
    assert read_store_recipe(store) == {"base": str(base)}
    assert resume(store, progress=False, scheduler="none").complete
    assert file_digests(store) == at_once(spec, store)


def moved(thing, **changes):
    """The scene with one of its objects changed."""
    objects = SCENE_MAPPING["scene"]["objects"]
    return {
        "scene": SCENE_MAPPING["scene"] | {"objects": objects | {thing: objects[thing] | changes}}
    }


REFUSED = {
    "fewer draws": (
        {"draws": DRAWS | {"number": 2}},
        ["draws.number: 3 -> 2, and may only grow"],
    ),
    "other draws": (
        {"draws": DRAWS | {"method": "noise", "returns": 4}},
        ["draws.method: probabilities -> noise, and must stay", "draws.returns: 3 -> 4, and must"],
    ),
    "a value lost": ({"axes": {POWER: ["1 W", "3 W"]}}, [POWER + ": 0.01 W: lost, and must stay"]),
    "an axis lost": ({"axes": {}}, [POWER + ": 0.01 W: lost"]),
    "a looser tolerance": (
        {"accuracy": {"tolerance": 0.1}},
        ["tolerance: 0.001 -> 0.1, and may only become tighter"],
    ),
    "another scene": (
        moved("stone", radius="25 m", reflectance=0.2),
        ["stone.radius: 20 m -> 25 m, and must stay", "stone.reflectance: 0.3 -> 0.2, and must"],
    ),
    "another flight": ({"platform": SCENE_MAPPING["platform"]}, ["path.to: ", ", and must stay"]),
    "a scanner lost": (
        {"scanners": {"three": SMALLER["scanners"]["three"]}},
        ["scanners.line.kind: line -> (none), and must stay"],
    ),
    "another scanner": (
        {
            "scanners": SMALLER["scanners"]
            | {"three": SCENE_MAPPING["scanners"]["three"] | {"beams": 4}}
        },
        ["scanners.three.beams: 3 -> 4, and must stay"],
    ),
    "another test": (
        {"navigation": {"test_level": 0.01}},
        ["navigation.test_level: 0 -> 0.01, and must stay"],
    ),
}


@pytest.mark.parametrize("changes, messages", REFUSED.values(), ids=REFUSED)
def test_what_is_no_larger_study_is_refused_field_by_field(flown, changes, messages):
    words = "new scanners, more draws.* needs a store of its own"
    see_it_refused(flown, flight(**changes), *messages, match=words)


def test_another_study_put_in_the_older_ones_place_is_not_taken_for_it(
    working_directory, computed, monkeypatch, drawn_more
):
    """Between two runs of an extension its store was replaced by that of a darker scene."""
    new = working_directory.with_name("larger.zarr")
    stopped = {"progress": Interrupting(), "scheduler": "none"}
    extend(working_directory, flight(draws=MORE_DRAWS), to=new, **stopped)
    shutil.rmtree(working_directory)
    run_serially(flight(**moved("ground", reflectance=0.01)), working_directory)
    worker._cached_block_writer.cache_clear()
    assert resume(new, progress=False, scheduler="none").complete
    assert file_digests(new) == drawn_more
