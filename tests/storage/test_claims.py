"""Claims that nobody holds, and heartbeats that can be told apart."""

import errno
import os

import pytest

from sweep.storage.claims import claim
from sweep.storage.locations import located


@pytest.mark.parametrize("kind", ["file", "object"])
def test_a_claim_that_nobody_holds_never_beat(kind, tmp_path, memory):
    free = claim(tmp_path / "lock" if kind == "file" else located(memory) / "lock")
    assert free.read() is None and free.age() == float("inf")
    free.take("me", lambda: None)
    assert free.read() == "me" and free.age() < 60
    free.leave()
    assert free.read() is None


def test_a_claim_on_a_read_only_disk_has_an_age(tmp_path, monkeypatch):
    held = claim(tmp_path / "lock")
    held.take("me", lambda: None)

    def refuse(*_, **__):
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    monkeypatch.setattr("pathlib.Path.touch", refuse)
    assert held.age() < 60


def test_no_two_heartbeats_of_an_object_are_alike(memory):
    """Its tag may be a digest: one who saw it before a beat must not replace it after."""
    path = located(memory) / "lock"
    mine, states = claim(path), []
    mine.take("me", lambda: None)
    for _ in range(3):
        states.append(path.read_bytes())
        mine.beat()
        assert mine.read() == "me"
    assert len(set(states)) == 3
