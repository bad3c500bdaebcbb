import pytest
from small import quiet, small, tree


@pytest.fixture(scope="session")
def undisturbed(tmp_path_factory):
    """Files of the small study, run as a plain loop."""
    return tree(quiet(small(), tmp_path_factory.mktemp("undisturbed") / "small.zarr").store)
