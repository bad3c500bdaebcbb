"""Receipts of blocks that a study does not have."""

import pytest

from sweep.storage.locations import JOURNAL
from sweep.storage.receipts import RECEIPTS, read_receipts
from sweep.storage.sealing import sealed


@pytest.mark.parametrize(("n_blocks", "points"), [(2, [5, 0]), (3, [5, 0, 7]), (4, [5, 0, 7, 0])])
def test_receipts_of_other_blocks_count_for_nothing(tmp_path, n_blocks, points):
    (tmp_path / JOURNAL).mkdir()
    lines = [sealed({"block": b, "points": p, "time": 1.5}) for b, p in ((0, 5), (2, 7))]
    (tmp_path / JOURNAL / RECEIPTS).write_bytes(b"".join(lines))
    assert read_receipts(tmp_path, n_blocks).points.tolist() == points
