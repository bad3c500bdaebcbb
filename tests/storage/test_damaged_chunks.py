"""A chunk that is damaged or missing is told by its block and name, whoever reads it."""

import pickle
import shutil
import subprocess
import sys
from contextlib import nullcontext

import numpy as np
import pytest
from click.testing import CliRunner
from small_flights import small_scene_spec
from small_studies import run_serially, small_spec

import sweep
from sweep.cli import main
from sweep.messages import suggest_shell_commands
from sweep.regular_files import RefusedFileError
from sweep.report import study_report
from sweep.storage.locations import eyepoint_store_location, parse_location
from sweep.storage.verified_store import (
    ChunkBlockMap,
    DamagedChunkError,
    open_verified_group,
    open_verified_store,
)
from sweep.tasks.engine.study_store import chunk_names_of_block
from sweep.tasks.studies import study_loading
from sweep.tasks.studies.store_verification import pack_store


def flip(path):
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


def make_folder(path):
    path.unlink()
    path.mkdir()


DAMAGES = {
    "flipped": (flip, "fails its checksum"),
    "cut": (lambda path: path.write_bytes(path.read_bytes()[:-7]), "fails its checksum"),
    "longer": (lambda path: path.write_bytes(path.read_bytes() + b"0"), "fails its checksum"),
    "garbage": (lambda path: path.write_bytes(b"garbage!"), "fails its checksum"),
    "few bytes": (lambda path: path.write_bytes(b"a"), "fails its checksum"),
    "empty": (lambda path: path.write_bytes(b""), "is empty"),
    "missing": (lambda path: path.unlink(), "is missing"),
    "folder": (make_folder, "is missing"),
}


@pytest.fixture(scope="module")
def grid(tmp_path_factory):
    return run_serially(small_spec(), tmp_path_factory.mktemp("grid") / "grid.zarr").store


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    store = tmp_path_factory.mktemp("flight") / "flight.zarr"
    return run_serially(small_scene_spec(), store).store


@pytest.fixture(scope="module")
def drawn_store(tmp_path_factory):
    """A grid with blocks along all axes, and counts of draws by batch."""
    spec = small_spec(draws={"number": 20}, storage={"block_points": 2})
    return run_serially(spec, tmp_path_factory.mktemp("drawn") / "drawn.zarr").store


@pytest.fixture
def copy(grid, tmp_path):
    return shutil.copytree(grid, tmp_path / "grid.zarr")


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_chunk_is_reported_as_it_is_read(copy, damage):
    harm, words = DAMAGES[damage]
    harm(copy / "pd_shot/c/0/0/0")
    dataset = sweep.open(copy)
    with pytest.raises(DamagedChunkError) as raised:
        dataset.pd_shot.compute()
    assert str(raised.value) == (
        f"{copy}: block 0: pd_shot/c/0/0/0 {words}: `sweep.verify('{copy}')` marks what is "
        f"damaged, and `sweep.resume('{copy}')` computes it again"
    )
    assert np.isfinite(dataset.pd_up.compute()).all()


@pytest.mark.parametrize("as_what", ["command", "program"])
def test_remedies_are_quoted_as_they_are_to_be_typed(grid, tmp_path, as_what):
    copy = shutil.copytree(grid, tmp_path / "q p" / "grid.zarr")
    flip(copy / "pd_shot/c/0/0/0")
    (copy / "pd_up/c/0/0/0").write_bytes(bytes(10**6))  # larger than it can be
    dataset = sweep.open(copy)
    with suggest_shell_commands() if as_what == "command" else nullcontext():
        with pytest.raises(DamagedChunkError) as damaged:
            dataset.pd_shot.compute()
        with pytest.raises(RefusedFileError) as unfit:
            dataset.pd_up.compute()
    if as_what == "command":
        verify, resume = f"`sweep verify '{copy}'`", f"`sweep resume '{copy}'`"
    else:
        verify, resume = f"`sweep.verify('{copy}')`", f"`sweep.resume('{copy}')`"
    assert f"{verify} marks what is damaged" in str(damaged.value)
    assert f"{resume} computes it again" in str(damaged.value)
    assert f"{verify} names what is damaged" in str(unfit.value)


COMMANDS = [
    ("report", "{}"), ("figures", "{}"), ("finalize", "{}"), ("compare", "{}", "{}"),
]  # fmt: skip


@pytest.mark.parametrize("damage", ["flipped", "cut", "missing"])
@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: command[0])
def test_commands_tell_of_a_damaged_chunk_in_words(copy, command, damage):
    harm, words = DAMAGES[damage]
    for name in ("pd_shot", "pd_up"):
        harm(copy / f"{name}/c/0/1/0")
    result = CliRunner().invoke(main, [word.format(copy) for word in command])
    assert result.exit_code == 2, result.output
    if (command[0], damage) == ("finalize", "missing"):
        assert "lacks 1 block: resume it" in result.output  # it counts chunks before it copies
    else:
        assert "block 1: pd_" in result.output and f"/c/0/1/0 {words}: `sweep ver" in result.output
    assert "Traceback" not in result.output


def test_status_tells_the_progress_and_then_of_a_damaged_chunk(copy):
    flip(copy / "beamlets_error/c/0/1/0")
    result = CliRunner().invoke(main, ["status", str(copy)])
    assert "72 of 72 points" in result.output and "block 1: beamlets_error/c/0/1/0" in result.output
    assert result.exit_code == 2


def test_a_chunk_that_is_not_computed_yet_is_none_that_is_missing(tmp_path):
    def evaluate(study, block):
        if block == 5:
            raise ValueError("no")
        return study.evaluate(block)

    store = tmp_path / "grid.zarr"
    assert not run_serially(small_spec(), store, evaluate=evaluate).complete
    assert int(sweep.open(store).pd_shot.isnull().sum()) > 0
    (store / "pd_shot/c/0/0/0").unlink()
    with pytest.raises(DamagedChunkError, match="block 0: pd_shot/c/0/0/0 is missing"):
        sweep.open(store).pd_shot.compute()


def test_a_chunk_whose_receipt_is_withdrawn_is_not_computed_yet(copy):
    dataset = sweep.open(copy)
    flip(copy / "pd_shot/c/0/1/0")
    with pytest.raises(DamagedChunkError):
        dataset.pd_shot.compute()
    assert CliRunner().invoke(main, ["verify", str(copy)]).exit_code == 1
    (copy / "pd_shot/c/0/1/0").unlink()
    assert int(sweep.open(copy).pd_shot.isnull().sum()) > 0
    assert sweep.resume(copy, progress=False, scheduler="none").blocks_computed == 1
    assert np.isfinite(dataset.pd_shot.compute()).all()


@pytest.mark.parametrize("kind", ["grid", "drawn_store", "flight", "eyepoints"])
def test_each_chunk_has_the_block_that_writes_it(request, kind):
    path = request.getfixturevalue("flight" if kind == "eyepoints" else kind)
    if kind == "eyepoints":
        path = next(path.parent.glob("eyepoints/*.zarr"))
    _, study = study_loading.read_study(path)
    owners = ChunkBlockMap(parse_location(path))
    assert owners.n_blocks == study.n_blocks
    for block in range(study.n_blocks):
        assert {owners.block_of_chunk(name) for name in chunk_names_of_block(study, block)} == {
            block
        }
    assert all(owners.block_of_chunk(name) == -1 for name in owners.template_objects)


def test_eyepoints_are_reported_with_the_study_that_has_them(flight, tmp_path):
    place = shutil.copytree(flight.parent, tmp_path / "flight")
    attributes = sweep.open_scene(place / flight.name)["three"].attrs
    path = eyepoint_store_location(place / flight.name, attributes["geometry_id"])
    flip(path / "time/c/0")
    with pytest.raises(DamagedChunkError, match=r"block 0: time/c/0 .*study that uses them"):
        open_verified_group(path)["time"][...]


def test_a_packed_copy_tells_of_a_chunk_in_a_file_of_several(grid, tmp_path):
    copy = pack_store(grid, tmp_path / "packed.zarr", progress=False)
    pd_values = sweep.open(copy).pd_shot.compute()
    assert np.array_equal(pd_values, sweep.open(grid).pd_shot)
    (file,) = (path for path in (copy / "pd_shot/c").rglob("*") if path.is_file())
    sound = file.read_bytes()
    for position in (3, len(sound) // 2, len(sound) - 10, len(sound) - 2):
        content = bytearray(sound)
        content[position] ^= 1
        file.write_bytes(content)
        for values in (lambda s: s.pd_shot.compute(), lambda s: s.pd_shot[0, 0, 0].compute()):
            try:
                values(sweep.open(copy))
            except DamagedChunkError as error:
                assert f"{copy}: pd_shot/c/0/0/0 fails" in str(error)
            else:  # what is read is not what is damaged
                assert values(sweep.open(copy)).ndim == 0
    file.unlink()
    with pytest.raises(DamagedChunkError, match=r"pd_shot/c/0/0/0 is missing: .* copy the store"):
        sweep.open(copy).pd_shot.compute()


def test_a_store_that_is_opened_goes_to_other_processes(grid):
    store = pickle.loads(
        pickle.dumps(
            open_verified_store(parse_location(grid), study_loading.read_study(grid)[1].id)
        )
    )
    assert store.read_only


READER = """
import sys
from contextlib import nullcontext
import sweep
from sweep.storage.store_format import StoreReplacedError
from sweep.storage.verified_store import DamagedChunkError

dataset = sweep.open(sys.argv[1])
if len(sys.argv) > 2:
    import shutil
    shutil.rmtree(sys.argv[1])
    shutil.copytree(sys.argv[2], sys.argv[1])
try:
    dataset.pd_shot.compute()
except (DamagedChunkError, StoreReplacedError) as error:
    print(type(error).__name__)
"""


@pytest.mark.parametrize("happens", ["DamagedChunkError", "StoreReplacedError"])
def test_a_reader_that_meets_an_error_ends_without_further_words(copy, drawn_store, happens):
    """Zarr leaves reads that nobody waits for, of which asyncio would print a traceback each."""
    for chunk in (copy / "pd_shot/c/0").glob("*/0"):
        flip(chunk)
    words = [str(copy)] if happens == "DamagedChunkError" else [str(copy), str(drawn_store)]
    command = [sys.executable, "-c", READER, *words]
    process = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (process.returncode, process.stdout, process.stderr) == (0, f"{happens}\n", "")


@pytest.mark.parametrize(
    "error, words",
    [
        (OSError(24, "Too many open files"), "Too many open files: raise their limit, `ulimit -n`"),
        (OSError(28, "No space left on device"), "No space left on device: make room where the"),
    ],
)
def test_a_report_that_can_not_be_written_is_reported_in_words(
    grid, tmp_path, monkeypatch, error, words
):
    def fail(store, file):
        raise error

    monkeypatch.setattr(study_report, "write_report", fail)
    arguments = ["report", str(grid), "-o", str(tmp_path / "page.html")]
    result = CliRunner().invoke(main, arguments)
    assert result.exit_code == 2 and words in result.output and "Traceback" not in result.output
