import pytest
from small_studies import file_digests, run_serially, small_spec


@pytest.fixture(scope="session")
def serial_digests(tmp_path_factory):
    """Files of the small study, run as a plain loop."""
    return file_digests(
        run_serially(small_spec(), tmp_path_factory.mktemp("undisturbed") / "small.zarr").store
    )
