"""Stores of strangers: metadata with which Zarr would decode what sweep never writes."""

import copy
import json
import os
import pickle
import random
import shutil

import numpy as np
import pytest
from click.testing import CliRunner
from small_studies import small_spec

import sweep
from sweep.cli import main
from sweep.storage.store_format import NotAStoreError, log_line_with_digest
from sweep.tasks.engine import study_store
from sweep.tasks.engine.progress import StoreError
from sweep.tasks.studies.grid_study import GridStudy
from sweep.tasks.studies.store_summary import status


class Payload:
    """An object that leaves a file where it is unpickled."""

    def __init__(self, mark):
        self.mark = mark

    def __reduce__(self):
        return os.mkdir, (str(self.mark),)


@pytest.fixture(scope="module")
def empty_store(tmp_path_factory):
    """A store without results, with a text coordinate."""
    study = small_spec(
        axes={"instrument.processing.window": ["hann", "hamming"], "target.range": ["9 m", "8 m"]}
    )
    return study_store.create_store(tmp_path_factory.mktemp("made") / "made.zarr", GridStudy(study))


@pytest.fixture
def store_copy(empty_store, tmp_path):
    """A copy that a test may spoil."""
    return shutil.copytree(empty_store, tmp_path / "theirs.zarr")


def spoil(path, change):
    """Change the document of a store's root."""
    document = json.loads((path / "zarr.json").read_text())
    change(document, document["consolidated_metadata"]["metadata"])
    (path / "zarr.json").write_text(json.dumps(document))


OBJECTS = {
    "zarr_format": 2, "node_type": "array", "shape": [2], "chunks": [2], "dtype": "|O",
    "order": "C", "filters": [{"id": "pickle"}], "compressor": None, "fill_value": None,
    "dimension_separator": ".", "attributes": {"_ARRAY_DIMENSIONS": ["range"]},
}  # fmt: skip


def put(name, **changes):
    """A change of an array's metadata."""
    return lambda document, arrays: arrays[name].update(changes)


SPOILT = {
    "pickled objects": lambda document, arrays: arrays.update({"range": OBJECTS}),
    "text that is unpickled": lambda document, arrays: arrays.update(
        {"range": {**OBJECTS, "filters": [{"id": "vlen-utf8"}, {"id": "pickle"}]}}
    ),
    "a Zarr array of format 2": put("range", zarr_format=2),
    "an unknown codec": put("pd_up", codecs=[{"name": "numcodecs.pickle", "configuration": {}}]),
    "a further codec": lambda document, arrays: arrays["pd_up"]["codecs"].append(
        {"name": "gzip", "configuration": {"level": 1}}
    ),
    "another type": put("pd_up", data_type="complex128"),
    "a type that Zarr's plug-ins know": put(
        "pd_up", data_type={"name": "numpy.datetime64", "configuration": {}}
    ),
    "keys that lead elsewhere": put(
        "pd_up", chunk_key_encoding={"name": "v2", "configuration": {"separator": "/"}}
    ),
    "a chunk of a petabyte": put(
        "pd_up", chunk_grid={"name": "regular", "configuration": {"chunk_shape": [2, 2**47]}}
    ),
    "chunks without number": put("pd_up", shape=[2, 2**60]),
    "a length that is none": put("pd_up", shape=[2, True]),
    "lengths that don't agree": put("pd_up", shape=[2, 5]),
    "a name that leads out": lambda document, arrays: arrays.update(
        {"../../etc/passwd": arrays["pd_up"]}
    ),
    "a dimension too many": put("pd_up", dimension_names=["window", "range", "range2"]),
    "an attribute that xarray obeys": put("pd_up", attributes={"scale_factor": 2.0}),
    "storage transformers": put("pd_up", storage_transformers=[{"name": "x"}]),
    "no metadata of arrays": lambda document, arrays: document.pop("consolidated_metadata"),
    "a root that is an array": lambda document, arrays: document.update(node_type="array"),
    "another layout": lambda document, arrays: document["attributes"].update(layout=4),
    "a title that is none": lambda document, arrays: document["attributes"].update(title=[1]),
    "a kind that is none": lambda document, arrays: document["attributes"].update(kind="x"),
}


@pytest.mark.parametrize("change", SPOILT.values(), ids=SPOILT)
def test_a_store_with_metadata_that_sweep_never_writes_is_refused_unread(
    store_copy, tmp_path, change
):
    (store_copy / "range" / "0").write_bytes(pickle.dumps(Payload(tmp_path / "ran")))
    spoil(store_copy, change)
    with pytest.raises(NotAStoreError) as refusal:
        sweep.open(store_copy)
    with pytest.raises(StoreError, match="(?s)^" + str(store_copy)):
        status(store_copy)
    assert "\n" not in str(refusal.value) and str(store_copy) in str(refusal.value)
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize(
    "command",
    [
        "status S ", "report S ", "compare S S ", "figures S ", "resume S ", "export S x.csv",
        "finalize S there.zarr", "extend S --set seed=5",
    ],
)  # fmt: skip
def test_every_command_refuses_a_hostile_store_in_one_line(
    store_copy, tmp_path, monkeypatch, command
):
    monkeypatch.chdir(tmp_path)
    spoil(store_copy, SPOILT["pickled objects"])
    words = command.replace("S ", f"{store_copy.name} ").split()
    result = CliRunner().invoke(main, words, catch_exceptions=False)
    assert result.exit_code == 2, result.output
    assert result.output.count("\n") == 1 and "range" in result.output
    assert sorted(os.listdir(tmp_path)) == ["theirs.zarr"]


@pytest.mark.parametrize("study_id", ["\x1b[31mred", "", "a study", "0" * 33])
def test_an_id_that_is_no_digest_is_reported_by_every_command_that_reads(store_copy, study_id):
    path = store_copy / "zarr.json"
    document = json.loads(path.read_text())
    document["attributes"]["study_id"] = study_id
    path.write_text(json.dumps(document))
    with pytest.raises(NotAStoreError, match=r"its study_id is .*, and no digest"):
        sweep.open(store_copy)
    for command in ("status", "report", "figures"):
        result = CliRunner().invoke(main, [command, str(store_copy)], catch_exceptions=False)
        assert (
            result.exit_code == 2 and "no digest" in result.output and "\x1b" not in result.output
        )


def test_metadata_of_single_arrays_are_not_read(store_copy):
    """Those of the root's document are, which are checked."""
    (store_copy / ".sweep" / "template.jsonl").unlink()  # has digests of them, which they can forge
    for name in ("range", "pd_up", "window"):
        (store_copy / name / "zarr.json").write_text(json.dumps(OBJECTS))
        (store_copy / name / ".zarray").write_text(json.dumps(OBJECTS))
    dataset = sweep.open(store_copy)
    assert dataset.range.values.tolist() == [9, 8]
    assert dataset.window.values.tolist() == ["hann", "hamming"]
    assert np.isnan(dataset.pd_up.values).all()
    assert status(store_copy).points == 4


def leaves(value, place=()):
    """Places of everything in a JSON document."""
    parts = value.items() if isinstance(value, dict) else enumerate(value)
    for key, part in parts:
        yield (*place, key)
        if isinstance(part, dict | list):
            yield from leaves(part, (*place, key))


ODD = [
    None, True, -1, 0, 2**70, 1e308, float("nan"), "", "|O", "../x", "\x1b[2J", "object", [], {},
    [[]], ["x"], {"name": "pickle"}, {"id": "pickle"}, {"name": "numcodecs.pickle"}, "é" * 5000,
]  # fmt: skip


@pytest.mark.parametrize(
    "seed", [0, 1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(2, 10))]
)
def test_random_changes_of_metadata_end_in_words_or_change_nothing(store_copy, seed):
    chance, text = random.Random(seed), (store_copy / "zarr.json").read_text()
    original = json.loads(text)
    places = list(leaves(original))
    places += [place for place in places if place[0] == "attributes"] * 10
    for _ in range(60):
        document = copy.deepcopy(original)
        place = chance.choice(places)
        parent = document
        for key in place[:-1]:
            parent = parent[key]
        if chance.random() < 0.2:
            del parent[place[-1]]
        else:
            parent[place[-1]] = chance.choice(ODD)
        (store_copy / "zarr.json").write_text(json.dumps(document))
        for read, error in ((sweep.open, NotAStoreError), (status, StoreError)):
            try:
                read(store_copy)
            except error as refusal:
                assert "\n" not in str(refusal) or place == ("attributes", "spec"), place
                assert "\x1b" not in str(refusal)


def test_bytes_in_place_of_a_document_end_in_words(store_copy):
    for text in (b"[" * 10**5, b'{"attributes": ' + b"9" * 5000 + b"}", b"\xff", b"null", b"[1]"):
        (store_copy / "zarr.json").write_bytes(text)
        with pytest.raises(NotAStoreError, match="damaged"):
            sweep.open(store_copy)


@pytest.mark.parametrize("kind", ["link", "pipe"])
def test_a_journal_that_leads_out_of_a_store_is_not_read_or_written(store_copy, tmp_path, kind):
    outside = tmp_path / "outside"
    outside.write_text("mine\n")
    receipts = store_copy / ".sweep" / "receipts.jsonl"
    receipts.unlink(missing_ok=True)
    if kind == "link":
        receipts.symlink_to(outside)
    else:
        os.mkfifo(receipts)
    result = CliRunner().invoke(main, ["resume", str(store_copy)], catch_exceptions=False)
    assert result.exit_code == 2 and "receipts.jsonl is a " in result.output
    assert outside.read_text() == "mine\n"


@pytest.mark.parametrize("place", ["pd_up", "pd_up/c", "effects/c/0"])
def test_resuming_writes_through_no_link_out_of_a_store(store_copy, tmp_path, place):
    outside = tmp_path / "outside"
    outside.mkdir()
    linked = store_copy / place
    shutil.rmtree(linked, ignore_errors=True)
    linked.parent.mkdir(parents=True, exist_ok=True)
    linked.symlink_to(outside)
    if place == "pd_up":
        shutil.copy(store_copy / "pd_down" / "zarr.json", outside)
    before = os.listdir(outside)
    command = ["resume", str(store_copy), "--scheduler", "none"]
    result = CliRunner().invoke(main, command, catch_exceptions=False)
    assert result.exit_code == 2 and "\n" not in result.output.strip()
    assert os.listdir(outside) == before


@pytest.mark.parametrize("body", [b"[1", b'{"block":', b'{"a":' + b"[" * 10**5, b'"x'])
def test_a_log_whose_lines_have_digests_but_no_records_is_read_as_damaged(store_copy, body):
    for name in ("receipts.jsonl", "sessions.jsonl"):
        (store_copy / ".sweep" / name).write_bytes(log_line_with_digest(body))
    assert sweep.open(store_copy).attrs["blocks_committed"] == 0
    assert status(store_copy).blocks_done == 0
