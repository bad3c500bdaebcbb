import sys
from pathlib import Path

import pytest
from drawn_scenes import flown, scene

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))


@pytest.fixture(scope="session")
def scene_store(tmp_path_factory):
    """The store of the small scene; not to be changed."""
    return flown(tmp_path_factory.mktemp("scene"))


@pytest.fixture(scope="session")
def spec(tmp_path_factory):
    """The small scene's spec."""
    return scene(tmp_path_factory.mktemp("spec"))
