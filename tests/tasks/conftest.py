import pytest
from small import quiet
from small_flights import small_scene


@pytest.fixture(scope="session")
def flight(tmp_path_factory):
    """The store of the small scene, beside it its eyepoints; not to be changed."""
    outcome = quiet(small_scene(), tmp_path_factory.mktemp("flight") / "scene.zarr")
    assert outcome.complete
    return outcome.store
