import pytest
from small_flights import small_scene_spec
from small_studies import run_serially


@pytest.fixture(scope="session")
def flight(tmp_path_factory):
    """The store of the small scene, beside it its eyepoints; not to be changed."""
    outcome = run_serially(small_scene_spec(), tmp_path_factory.mktemp("flight") / "scene.zarr")
    assert outcome.complete
    return outcome.store
