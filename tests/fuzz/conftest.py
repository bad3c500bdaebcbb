"""The files that random scenes name, once for all fuzz tests."""

import pytest
from flight_strategies import write_files


@pytest.fixture(scope="session")
def folder(tmp_path_factory):
    """A folder with the small files that random scenes name, and room for a spec."""
    place = tmp_path_factory.mktemp("fuzz")
    write_files(place)
    return place
