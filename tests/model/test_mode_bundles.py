"""Powers of lines whose phase errors are shots' own, against records in the time domain."""

from dataclasses import replace

import pytest
from test_bundles import AGREEMENT, PLACES, WINDOWS, apart, drifting
from test_optional_lines import prepared, scene
from windows import marked

DRIFTS = (1e-3, 0.03, 0.1, 0.3, 1.0, 4.0)


@pytest.mark.parametrize(
    "place, image", [*((place, True) for place in PLACES), ("in the band", False)]
)
@pytest.mark.parametrize("window", marked(WINDOWS))
def test_bins_are_those_of_the_record(window, place, image, table_4_1):
    without = () if image else ("image",)
    parameters = scene(
        table_4_1, window=window, phases="incoherent", power=10.0, tnr=4.0, **PLACES[place]
    )
    shots = replace(prepared(parameters, without=without), alike=False)
    for drift in DRIFTS:
        for segment in (0, 2):
            missed, peak, form = apart(drifting(shots, drift), segment)
            print(window, place, drift, segment, missed / peak, form)
            assert missed < AGREEMENT * peak
            assert form or drift > 0.3
