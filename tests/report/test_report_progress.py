"""The bar of what is read and reduced."""

import io

import dask.array
import pytest
from rich.console import Console

from sweep.cli import stores


@pytest.fixture
def terminal(monkeypatch):
    written = io.StringIO()
    monkeypatch.setattr(
        "rich.console.Console", lambda stderr: Console(file=written, force_terminal=True, width=90)
    )
    return written


def test_the_bar_names_the_step_and_reaches_its_end(terminal):
    array = dask.array.ones((4000,), chunks=(10,))
    with stores.bar("opening the store") as say:
        say("sums")
        assert float(array.sum().compute(scheduler="sync")) == 4000
    assert "making: sums" in terminal.getvalue()
    assert "0:00:00" in terminal.getvalue()  # nothing of the step is left


def test_without_work_no_time_is_made_up(terminal):
    with stores.bar("opening the store") as say:
        say("sums")
        dask.array.ones(10).sum().compute(scheduler="sync")
        terminal.truncate(0)
        say("the page")
    assert "making: the page" in terminal.getvalue()
    assert "0:00:00" not in terminal.getvalue()
