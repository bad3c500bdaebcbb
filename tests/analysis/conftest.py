import pytest
from drawn_scenes import flown


@pytest.fixture(scope="session")
def scene_store(tmp_path_factory):
    """The store of the small scene; not to be changed."""
    return flown(tmp_path_factory.mktemp("scene"))
