import sys
from pathlib import Path

import pytest
from stored_scenes import run_flight_into_store, small_scene_spec

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))


@pytest.fixture(scope="session")
def scene_store(tmp_path_factory):
    """The store of the small scene; not to be changed."""
    return run_flight_into_store(tmp_path_factory.mktemp("scene"))


@pytest.fixture(scope="session")
def spec(tmp_path_factory):
    """The small scene's spec."""
    return small_scene_spec(tmp_path_factory.mktemp("spec"))
