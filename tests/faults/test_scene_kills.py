"""A client killed in the midst of a scene's study, while it casts and while it looks."""

import os
import signal
import sys

import pytest
from small_flights import small_scene_spec
from small_studies import file_digests, receipt_blocks
from test_kills import process, wait_for

from sweep.storage.locations import eyepoint_store_location
from sweep.tasks.driver import resume, run

CLIENT = """
import sys, time
from small_flights import small_scene_spec
from sweep.tasks.studies import eyepoint_study
from sweep.tasks.driver import run

eyepoint_study.SHOTS_PER_BLOCK_MAX = 24

def slowly(study, block):
    time.sleep(0.1)
    return study.evaluate(block)

run(small_scene_spec(), store=sys.argv[1], scheduler="none", evaluate=slowly, progress=False)
"""


@pytest.fixture(scope="module")
def serial_digests(tmp_path_factory):
    """Files of the study and of its eyepoints, run as a plain loop."""
    store = tmp_path_factory.mktemp("plain") / "scene.zarr"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sweep.tasks.studies.eyepoint_study.SHOTS_PER_BLOCK_MAX", 24)
        run(small_scene_spec(), store=store, scheduler="none", progress=False)
    return file_digests(store.parent)


@pytest.mark.slow
@pytest.mark.parametrize("stage", ["casting", "looking"])
def test_a_scenes_client_killed_with_kill_9(tmp_path, monkeypatch, serial_digests, stage):
    store = tmp_path / "killed" / "scene.zarr"
    store.parent.mkdir()
    eyepoints = eyepoint_store_location(store, small_scene_spec().geometry_id("three"))
    watched = eyepoints if stage == "casting" else store
    script = tmp_path / "client.py"
    script.write_text(CLIENT)
    with process(sys.executable, str(script), str(store)) as client:
        wait_for(lambda: len(receipt_blocks(watched)) >= 3)
        os.kill(client.pid, signal.SIGKILL)
        client.wait()
    before = {path: receipt_blocks(path) for path in (eyepoints, store)}
    assert before[store] == [] if stage == "casting" else len(before[store]) >= 3
    monkeypatch.setattr("sweep.tasks.studies.eyepoint_study.SHOTS_PER_BLOCK_MAX", 24)
    outcome = resume(store, progress=False, scheduler="none")
    assert outcome.complete and (outcome.rays_by_scanner["three"] == 0) == (stage == "looking")
    for path, committed in before.items():
        after = receipt_blocks(path)
        assert after[: len(committed)] == committed and len(set(after)) == len(after)
    assert file_digests(store.parent) == serial_digests
