"""A few of the kills that `make chaos` does by the hundred."""

import chaos
import pytest


@pytest.mark.parametrize(
    ("kind", "kills"), [(0, 7), (3, 3), (5, 1)], ids=["plain loop", "workers", "scheduler"]
)
def test_killed_studies_end_as_if_nobody_had_disturbed_them(kind, kills):
    kind = chaos.KINDS[kind]
    (count,) = chaos.campaign(kills, 20, kinds=(kind,), a_study=7).values()
    assert sum(count.kills.values()) >= kills
    assert (count.lost, count.twice, count.different, count.hanging) == (0, 0, 0, 0)
