import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "tasks"))


@pytest.fixture(scope="session")
def undisturbed(tmp_path_factory):
    """The store of the small study, run as a plain loop; not to be changed."""
    from small import quiet, small

    outcome = quiet(small(), tmp_path_factory.mktemp("undisturbed") / "small.zarr")
    assert outcome.complete
    return outcome.store
