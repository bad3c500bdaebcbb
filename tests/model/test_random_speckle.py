"""Random specs in developed speckle, compared with drawn scatterers: a few of the whole table."""

import pytest
from validate_speckle import compare_spec, format_row

AT_DC_BY_ITS_IMAGE = (7, 105)
"""Of a line 0.6 bins from DC, where the bin at DC has more light than the nearest one."""


@pytest.mark.parametrize(("seed", "spec_number"), [*((2, k) for k in range(6)), AT_DC_BY_ITS_IMAGE])
def test_random_specs_detect_as_often_as_drawn_scatterers(seed, spec_number):
    row = compare_spec(seed=seed, spec_number=spec_number)
    assert row.worst.error_over_allowed <= 1, format_row(row)
