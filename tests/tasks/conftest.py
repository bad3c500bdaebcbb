import pytest
from small import quiet, small


@pytest.fixture(scope="session")
def undisturbed(tmp_path_factory):
    """The store of the small study, run as a plain loop; not to be changed."""
    outcome = quiet(small(), tmp_path_factory.mktemp("undisturbed") / "small.zarr")
    assert outcome.complete
    return outcome.store
