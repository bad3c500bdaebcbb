"""Stores extended to larger studies: the bytes of these run at once, and nothing computed twice."""

import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import zarr
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st
from shot_helpers import parametrize_product
from small_flights import small_scene_spec
from small_studies import (
    STUDY_MAPPING,
    copy_store,
    file_contents,
    file_digests,
    make_failing_evaluate,
    run_serially,
    small_spec,
)

from sweep.cli import main
from sweep.model.sampling import samplers
from sweep.storage.locations import staging_path_for
from sweep.tasks.driver import extend, resume
from sweep.tasks.engine.progress import Progress, StoreError
from sweep.tasks.studies import grid_study
from sweep.tasks.studies.grid_study import GridStudy
from sweep.tasks.studies.store_summary import status
from sweep.tasks.studies.store_verification import verify

AXES = STUDY_MAPPING["axes"]
POWER, RANGE, ANGLE = AXES
REFLECTANCE = "target.reflectance"


@pytest.fixture
def computed(monkeypatch):
    """Points that the model is given, call by call; not those that compile it."""
    calls: list[int] = []
    real = grid_study.evaluate_points

    def counted(spec, parameters, count, *rest):
        calls.append(count)
        return real(spec, parameters, count, *rest)

    monkeypatch.setattr(grid_study, "evaluate_points", counted)
    monkeypatch.setattr(GridStudy, "compile_kernels", lambda self: None)
    return calls


def larger(store, spec, **options):
    """A store extended as a plain loop, without progress."""
    return extend(store, spec, progress=False, scheduler="none", **options)


RUN: dict[str, dict[str, str]] = {}


def at_once(spec, tmp_path):
    """Files of a study that is run at once, each study once."""
    text = repr(spec.to_yaml_mapping())
    if text not in RUN:
        RUN[text] = file_digests(run_serially(spec, tmp_path / "at_once.zarr").store)
        shutil.rmtree(tmp_path / "at_once.zarr")
    return RUN[text]


MORE = {
    "on two axes": (
        {**AXES, POWER: ["1 W", "2 W", "3 W"], ANGLE: ["20 deg", "50 deg", "90 deg", "9 deg"]},
        72,
    ),
    "new axis and values": (
        {REFLECTANCE: [0.01, 0.02], **AXES, POWER: ["1 W", "2 W", "3 W"]},
        144,
    ),
    "in another order": (dict(reversed(AXES.items())), 0),
    "axes zipped with a new one": (
        {RANGE: AXES[RANGE], ANGLE: AXES[ANGLE],
         "bright": {"zip": {POWER: ["1 W", "3 W", "5 W"], REFLECTANCE: [0.02, 0.02, 0.1]}}},
        36,
    ),
}  # fmt: skip
APPENDED, NEW_AXIS = ({**AXES, POWER: ["1 W", "3 W", "5 W"]}, {**AXES, REFLECTANCE: [0.01, 0.02]})


@pytest.mark.parametrize("name", parametrize_product(3, MORE))
def test_more_values_and_axes_end_as_the_larger_study_run_at_once(
    serial_store, tmp_path, computed, name
):
    axes, new = MORE[name]
    store, spec = copy_store(serial_store, tmp_path), small_spec(axes=axes)
    outcome = larger(store, spec)
    assert outcome.complete and outcome.store == store and sum(computed) == new
    assert not [file.name for file in tmp_path.iterdir() if file.name != store.name]
    assert not (store / ".sweep" / "recipe.json").exists()
    assert file_digests(store) == at_once(spec, tmp_path)
    assert all(report.is_undamaged and report.complete for report in verify(store))


few = st.lists(st.sampled_from([0.05, 0.25, 0.5, 0.75, 1.0]), min_size=1, max_size=3, unique=True)


@st.composite
def studies(draw):
    """Axes of a study and of a larger one, and points of a block of each."""
    paths = {POWER: "W", RANGE: "km", "target.radial_velocity": "m/s", REFLECTANCE: ""}
    names = draw(st.permutations(list(paths)))
    n_changes = draw(st.integers(0, 3))
    older = {path: draw(few) for path in names[:n_changes]}
    larger_axes = {}
    for path in draw(st.permutations(names[: draw(st.integers(n_changes, 4))])):
        old_values = older.get(path, [FIXED[path]])
        new_values = [value for value in draw(few) if value not in old_values]
        larger_axes[path] = draw(st.permutations(old_values + new_values))

    def axis_text(axes):
        return {p: [f"{v} {paths[p]}".strip() for v in values] for p, values in axes.items()}

    blocks = st.integers(1, 40)
    return (axis_text(older), draw(blocks)), (axis_text(larger_axes), draw(blocks))


FIXED = {POWER: 1.0, RANGE: 2.0, "target.radial_velocity": 3.0, REFLECTANCE: 0.5}
"""Values that parameters have where no axis has them, in the units of the test."""


def of(axes, block_points, **changes):
    """The small study with its fixed values, other axes and blocks."""
    target = STUDY_MAPPING["target"] | {
        "range": "2.0 km",
        "radial_velocity": "3.0 m/s",
        "reflectance": 0.5,
    }
    return small_spec(axes=axes, target=target, storage={"block_points": block_points}, **changes)


def see_that_it_extends(directory, pair):
    """The one study is extended to the other, to the bytes of the other run at once."""
    older, spec = (of(*result) for result in pair)
    store = run_serially(older, directory / "store.zarr").store
    assert larger(store, spec).complete
    assert file_digests(store) == at_once(spec, directory)
    shutil.rmtree(directory)


@settings(max_examples=4, deadline=None)
@given(pair=studies())
def test_any_grid_extended_to_any_larger_one(tmp_path_factory, pair):
    """Values before, after and between those that there are, and further axes, among others."""
    see_that_it_extends(tmp_path_factory.mktemp("any"), pair)


@pytest.mark.slow
@settings(max_examples=150, deadline=None)
@given(pair=studies())
def test_many_grids_extended_to_larger_ones(tmp_path_factory, pair):
    see_that_it_extends(tmp_path_factory.mktemp("many"), pair)


#: Effects on demand: which ones a point is simulated with depends on the points around it.
ON_DEMAND = {
    "footprint": {},
    "axes": {
        RANGE: {"linear": ["100 m", "9 km"], "number": 40},
        ANGLE: {"linear": ["2 deg", "90 deg"], "number": 30},
    },
    "storage": {"block_points": 500},
}


def test_points_whose_effects_are_others_in_the_larger_grid_are_computed_again(tmp_path, computed):
    store = run_serially(small_spec(**ON_DEMAND), tmp_path / "store.zarr").store
    axes = {**ON_DEMAND["axes"], ANGLE: {"linear": ["2 deg", "178/2 deg"], "number": 30}}
    axes[RANGE] = {"linear": ["100 m", "17.9 km"], "number": 79}
    axes[ANGLE] = ON_DEMAND["axes"][ANGLE]
    spec = small_spec(**ON_DEMAND | {"axes": axes})
    computed.clear()
    assert larger(store, spec).complete
    new = sum(computed)
    assert 39 * 30 <= new < 79 * 30
    assert file_digests(store) == at_once(spec, tmp_path)


COARSE = {**AXES, RANGE: ["1 km", "3 km"]}
ROUGH = {
    "target": STUDY_MAPPING["target"] | {"roughness": "10 um"},
    "footprint": {"beamlets": 1, "speckle": "none"},
}
CLOSE = {"line_error": 1e-5, "leakage_error": 1e-5}
"""Errors that are numbers, and do not follow the tolerance."""


@pytest.fixture
def draw_calls(monkeypatch, computed):
    """Draws that the model takes, call by call."""
    calls: list[int] = []
    real = samplers.Sampler.draw

    def counted(self, points, number):
        calls.append(len(points) * number)
        real(self, points, number)

    monkeypatch.setattr(samplers.Sampler, "draw", counted)
    return calls


CALLED_FOR = ("footprint", "doppler", "doppler_spread", "range_walk", "image", "leakage")
"""What points of the small study call for, whatever is random and however wide its grid."""


def number_of_draws(store):
    return int(zarr.open_array(store / "n_draws", mode="r")[...].sum())


MORE_DRAWS = {
    "a fixed number": ({"number": 70, "batch": 30}, {"number": 200, "batch": 30}, {}, {}),
    "a limit": ({"limit": 70, "batch": 20}, {"limit": 300, "batch": 20}, {"tolerance": 0.05}, {}),
    "a tolerance": (
        {"limit": 300, "batch": 20},
        {"limit": 300, "batch": 20},
        {"tolerance": 0.2, **CLOSE},
        {"tolerance": 0.06},
    ),
}


@pytest.mark.parametrize(
    "drawn_as, case_name",
    parametrize_product(4, [("probabilities", ROUGH), ("noise", {}), ("noise", ROUGH)], MORE_DRAWS),
)
def test_more_draws_go_on_from_those_that_are_there(tmp_path, draw_calls, drawn_as, case_name):
    method, scene = drawn_as
    before, after, accuracy, tighter = MORE_DRAWS[case_name]
    older = small_spec(axes=COARSE, draws=before | {"method": method}, accuracy=accuracy, **scene)
    spec = small_spec(
        axes=COARSE, draws=after | {"method": method}, accuracy=accuracy | tighter, **scene
    )
    store = run_serially(older, tmp_path / "store.zarr").store
    n_draws = number_of_draws(store)
    draw_calls.clear()
    assert larger(store, spec).complete
    assert sum(draw_calls) == number_of_draws(store) - n_draws
    assert file_digests(store) == at_once(spec, tmp_path)


def test_more_draws_and_more_values_together(tmp_path, draw_calls):
    draws = {"limit": 60, "batch": 20}
    same = {"accuracy": {"tolerance": 0.09}, "effects": dict.fromkeys(CALLED_FOR, "on")}
    store = run_serially(
        small_spec(axes=COARSE, draws=draws, **same), tmp_path / "store.zarr"
    ).store
    spec = small_spec(
        axes={**COARSE, "target.roughness": ["0 m", "10 um"], ANGLE: ["9 deg", *AXES[ANGLE]]},
        draws=draws | {"limit": 100},
        **same,
    )
    n_draws = number_of_draws(store)
    draw_calls.clear()
    assert larger(store, spec).complete
    assert sum(draw_calls) == number_of_draws(store) - n_draws
    assert file_digests(store) == at_once(spec, tmp_path)


def test_an_axis_of_effects_that_are_drawn_takes_the_points_without_them(tmp_path, computed):
    modes = dict.fromkeys(("doppler_spread", "range_walk"), "on")
    same = {"draws": {"number": 30}, "effects": modes}
    store = run_serially(small_spec(axes=COARSE, **same), tmp_path / "store.zarr").store
    spec = small_spec(axes={**COARSE, "target.roughness": ["0 m", "10 um"]}, **same)
    computed.clear()
    assert larger(store, spec).complete and sum(computed) == 12
    assert file_digests(store) == at_once(spec, tmp_path)


def test_whole_spectra_are_drawn_again_and_reported(tmp_path, capsys):
    changes = {
        "axes": {RANGE: ["1 km"]},
        "target": STUDY_MAPPING["target"] | {"radial_velocity": "0 m/s"},
    }
    draws = {"method": "spectra", "number": 10}
    store = run_serially(small_spec(draws=draws, **changes), tmp_path / "store.zarr").store
    spec = small_spec(draws=draws | {"number": 20}, **changes)
    assert extend(store, spec, scheduler="none").complete
    assert "0 of 1 points are there; 1 to compute (whole spectra are" in capsys.readouterr().err
    assert file_digests(store) == at_once(spec, tmp_path)


def test_spectra_of_random_effects_are_taken_where_points_are_added(tmp_path, computed):
    same = {
        "target": {**STUDY_MAPPING["target"], "roughness": "10 um"},
        "draws": {"method": "spectra", "number": 4},
        "accuracy": {"tolerance": 0},  # else effects follow from the points that are there
    }
    store = run_serially(small_spec(axes={RANGE: ["1 km"]}, **same), tmp_path / "store.zarr").store
    spec = small_spec(axes={RANGE: ["1 km", "2 km"]}, **same)
    computed.clear()
    assert larger(store, spec).complete and computed == [1]
    assert file_digests(store) == at_once(spec, tmp_path)


@pytest.mark.parametrize("errors, new", [({}, 12), (CLOSE, 0)], ids=["by tolerance", "given"])
def test_a_tighter_tolerance_computes_what_follows_from_it(tmp_path, computed, errors, new):
    older = small_spec(axes=COARSE, accuracy={"tolerance": 1e-2, **errors})
    store = run_serially(older, tmp_path / "store.zarr").store
    spec = small_spec(axes=COARSE, accuracy={"tolerance": 9e-3, **errors})
    computed.clear()
    assert larger(store, spec).complete and sum(computed) == new
    assert file_digests(store) == at_once(spec, tmp_path)


def test_only_what_is_committed_of_an_incomplete_store_is_taken(tmp_path, serial_store, computed):
    store, spec = copy_store(serial_store, tmp_path), small_spec(axes=APPENDED)
    log = store / ".sweep" / "receipts.jsonl"
    log.write_text("".join(log.read_text().splitlines(keepends=True)[:5]))
    assert larger(store, spec, to=store, overwrite=True).complete  # its own place, though named
    assert sum(computed) == 108 - sum(
        GridStudy(small_spec()).count_block_points(b) for b in range(5)
    )
    assert file_digests(store) == at_once(spec, tmp_path)


@pytest.mark.parametrize("name", ["pd_shot", "effects"])
def test_a_damaged_block_is_computed_again(tmp_path, serial_store, computed, name):
    store, spec = copy_store(serial_store, tmp_path), small_spec(axes=NEW_AXIS)
    chunk = store / name / "c" / "0" / "1" / "0"
    content = bytearray(chunk.read_bytes())
    content[len(content) // 2] ^= 4
    chunk.write_bytes(content)
    outcome = larger(store, spec)
    assert outcome.complete
    size = next(
        GridStudy(small_spec()).count_block_points(b)
        for b in range(12)
        if GridStudy(small_spec()).chunk_positions_of_block(b)[name] == (0, 1, 0)
    )
    assert sum(computed) == outcome.points_computed == 72 + size
    assert file_digests(store) == at_once(spec, tmp_path)


def test_in_another_place_not_a_byte_of_the_store_changes(tmp_path, serial_store):
    store, new = copy_store(serial_store, tmp_path), tmp_path / "elsewhere" / "larger.zarr"
    before, spec = file_contents(store), small_spec(axes=APPENDED)
    for file in [store, *store.rglob("*")]:
        file.chmod(0o555 if file.is_dir() else 0o444)
    outcome = larger(store, spec, to=new)
    assert outcome.complete and outcome.store == new
    assert file_contents(store) == before
    assert file_digests(new) == at_once(spec, tmp_path)


def test_the_same_study_is_nothing_to_extend(tmp_path, serial_store, computed, capsys):
    store = copy_store(serial_store, tmp_path)
    assert extend(store, small_spec(title="Again"), scheduler="none").blocks_computed == 0
    assert "nothing to extend" in capsys.readouterr().err and not computed
    assert file_digests(store) == file_digests(serial_store)


REFUSED = {
    "another instrument": (
        {"seed": 4, "target": STUDY_MAPPING["target"] | {"reflectance": 0.03}},
        ["target.reflectance: 0.02 -> 0.03, and must stay", "seed: 3 -> 4, and must stay"],
    ),
    "an effect": ({"effects": {"leakage": "on"}}, ["effects.leakage: auto -> on, and must stay"]),
    "fewer values": ({"axes": {**AXES, POWER: ["1 W", "2 W"]}}, [POWER + ": 3 W: lost"]),
    "an axis less": ({"axes": {RANGE: AXES[RANGE], ANGLE: AXES[ANGLE]}}, [POWER + ": 3 W: lost"]),
    "another axis": ({"axes": {**AXES, REFLECTANCE: [0.5]}}, [REFLECTANCE + ": 0.02: lost"]),
    "draws where there were none": (
        {"draws": {"number": 10}}, ["draws.number: 0 -> 10, and may only grow"],
    ),
    "a looser tolerance": (
        {"accuracy": {"tolerance": 0.1}},
        ["accuracy.tolerance: 0.001 -> 0.1, and may only become tighter"],
    ),
}  # fmt: skip


def see_it_refused(store, spec, *messages, match="needs a store of its own"):
    """An extension that is refused in words, and of which nothing is left."""
    before = file_contents(store)
    with pytest.raises(StoreError, match=match) as error:
        larger(store, spec)
    assert all(line in str(error.value) for line in messages)
    assert file_contents(store) == before and not staging_path_for(store).exists()


@pytest.mark.parametrize("changes, messages", REFUSED.values(), ids=REFUSED)
def test_what_is_no_larger_study_is_refused_field_by_field(serial_store, changes, messages):
    see_it_refused(serial_store, small_spec(**changes), *messages)


def test_a_flight_is_no_larger_grid(serial_store):
    see_it_refused(serial_store, small_scene_spec(), match="have nothing in common")


def test_another_extension_in_progress_is_not_mixed_up(tmp_path, serial_store):
    path = copy_store(serial_store, tmp_path)
    first_spec, other = (
        small_spec(axes={**AXES, POWER: ["1 W", "3 W", p]}) for p in ("5 W", "7 W")
    )
    assert (
        larger(
            path, first_spec, evaluate=make_failing_evaluate(set(range(99)), tmp_path / "log")
        ).blocks_done
        == 0
    )
    output = CliRunner().invoke(main, ["status", str(path)]).output
    assert "complete" in output and "being extended: sweep status" in output
    with pytest.raises(StoreError, match=r"\[1, 3, 5\] W -> \[1, 3, 7\] W"):
        larger(path, other)
    assert file_digests(path) == file_digests(serial_store)
    assert larger(path, other, overwrite=True).complete
    assert file_digests(path) == at_once(other, tmp_path)


class Interrupting(Progress):
    """Progress that presses Ctrl-C as the first points are done."""

    def advance(self, *, points, failed):
        if points:
            os.kill(os.getpid(), signal.SIGINT)


def test_ctrl_c_leaves_the_store_and_both_commands_go_on(tmp_path, serial_store, computed):
    path, spec = copy_store(serial_store, tmp_path), small_spec(axes=APPENDED)
    for _ in range(2):
        outcome = extend(path, spec, progress=Interrupting(), scheduler="none")
        assert outcome.stop_reason == "interrupted" and outcome.store == staging_path_for(path)
        assert file_digests(path) == file_digests(serial_store)
    result = CliRunner().invoke(main, ["resume", str(path), "--scheduler", "none"])
    assert result.exit_code == 0 and f"{path}: 108 of 108 points" in result.stdout
    assert sum(computed) == 36 and file_digests(path) == at_once(spec, tmp_path)


#: A client of its own, which dies of SIGKILL at a moment of an extension.
CLIENT = """
import os, signal, sys
sys.path.insert(0, sys.argv[1])
from pathlib import Path
from small_studies import STUDY_MAPPING, small_spec
from sweep.storage import locations
from sweep.tasks import driver
from sweep.tasks.engine.journal import Journal

store, moment = Path(sys.argv[2]), sys.argv[3]
die = lambda *_: os.kill(os.getpid(), signal.SIGKILL)
rename, commit = os.rename, Journal.commit
blocks = []

def committing(self, *receipts):
    commit(self, *receipts)
    blocks.extend(receipts)
    if len(blocks) >= 3:
        die()

def renaming(old, new):
    ahead = {"old": store, "new": locations.staging_path_for(store)}
    if moment == f"before the {''.join(k for k, v in ahead.items() if v == Path(old))} one moves":
        die()
    rename(old, new)

if moment == "three blocks":
    Journal.commit = committing
elif moment == "as the old one is removed":
    locations.shutil.rmtree = lambda path, **_: Path(path).exists() and die()
else:
    os.rename = renaming
spec = small_spec(axes={**STUDY_MAPPING["axes"], "instrument.laser.power": ["1 W", "2 W", "3 W"]})
if sys.argv[4] == "overwrite":
    driver.run(spec, store=store, overwrite=True, progress=False, scheduler="none")
else:
    driver.extend(store, spec, progress=False, scheduler="none")
"""

MOMENTS = (
    "three blocks", "before the old one moves", "before the new one moves",
    "as the old one is removed",
)  # fmt: skip


@pytest.mark.parametrize(
    "moment, command, resumes",
    [
        (MOMENTS[0], "extend", "extend"),
        pytest.param(MOMENTS[1], "extend", "resume", marks=pytest.mark.slow),
        pytest.param(MOMENTS[2], "overwrite", "resume", marks=pytest.mark.slow),
        pytest.param(MOMENTS[3], "extend", "extend", marks=pytest.mark.slow),
    ],
)
def test_killed_at_any_moment_a_whole_store_is_there_and_it_goes_on(
    tmp_path, serial_store, computed, moment, command, resumes
):
    path, spec = (
        copy_store(serial_store, tmp_path),
        small_spec(axes={**AXES, POWER: ["1 W", "2 W", "3 W"]}),
    )
    larger_tree = at_once(spec, tmp_path)
    test_directory = str(Path(__file__).parent)
    ended = subprocess.run(
        [sys.executable, "-c", CLIENT, test_directory, str(path), moment, command], check=False
    )
    assert ended.returncode == -signal.SIGKILL
    grid = GridStudy(spec).grid
    run_status = status(path)  # the next command
    assert run_status.complete and file_digests(path) in (file_digests(serial_store), larger_tree)
    computed.clear()
    if resumes == "extend":
        assert larger(path, spec).complete
    else:
        assert resume(path, progress=False, scheduler="none").complete
    assert file_digests(path) == larger_tree
    assert list(tmp_path.iterdir()) == [path]
    n_reused = 72 if command == "extend" else 0
    n_points = (
        sum(map(grid.count_block_points, range(3))) * (1 - n_reused / 108)
        if moment == "three blocks"
        else 108 - n_reused
    )
    assert sum(computed) == 108 - n_reused - n_points
