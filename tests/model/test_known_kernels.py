"""Lines as moments with known kernels, against the same lines one by one and bin by bin."""

from dataclasses import replace
from itertools import pairwise

import engine
import numpy as np
import pytest
from test_bundles import PLACES, WINDOWS
from test_bundles import allowed as powers_allowed
from test_optional_lines import prepared, scene

from sweep.model import modulation, spectra
from sweep.model.chain import prepare
from sweep.model.kernel_rows import HALVES, KEY
from sweep.model.shot import find

ROUNDING = 1e-11
"""Of all lines in phase on the peak."""


def run_of_bins(shots, segment):
    """First bin and |X| of those that are looked at one by one; the level of the moments, or -1."""
    _, row, _, form = engine.lines_of(shots, segment)
    assert not form
    return *engine.run_of_bins(shots, segment), row


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("phases", ["coherent", "incoherent"])
def test_bins_are_those_of_the_lines_one_by_one(phases, place, table_4_1):
    """Every window; images on top of lines, beside them and far away; tables left and not."""
    levels = set()
    for window in WINDOWS:
        parameters = scene(
            table_4_1, window=window, phases=phases, power=10.0, beamlets=37, **PLACES[place]
        )  # fmt: skip
        for grazing_angle in (0.3, 0.06, 0.02):
            exact = prepared(parameters | {"target.grazing_angle": grazing_angle})
            amplitudes = exact.amplitude[exact.row[0]]
            peak = 0.5 * exact.beat_scale * exact.window.sum * amplitudes.sum()
            for tolerance in (1e-9, 1e-2):
                loose = replace(exact, line_tolerance=np.asarray(tolerance))
                low, found, level = run_of_bins(loose, 0)
                _, expected = spectra.segment_spectrum(exact, 0, 0)
                missed = abs(found - expected[low : low + found.size])
                allowed = tolerance * exact.bin_deviation[0] + ROUNDING * peak
                if phases == "incoherent":
                    some = expected[low : low + found.size]
                    allowed = powers_allowed(loose, some) + ROUNDING * peak
                assert (missed <= allowed).all()
                levels.add(level)
    # at DC all lines lie so close together that few of them do
    assert (max(levels) >= 0) == (phases == "incoherent" or place != "at DC")


def test_what_is_known_already_changes_no_bit(table_4_1):
    """Tables are made once for all points of a call, and serve every tolerance."""
    rng = np.random.default_rng(74)
    n = 40
    parameters = scene(
        table_4_1, phases="coherent", beamlets=37, range=10 ** rng.uniform(1, 4, n),
        grazing_angle=rng.uniform(0.02, 1.5, n),
    )  # fmt: skip
    tolerance = 10 ** rng.uniform(-6, -1, n)
    shots = replace(prepared(parameters), line_tolerance=tolerance)
    together = find(shots)
    for i in range(n):
        part = {path: v[i : i + 1] if np.ndim(v) else v for path, v in parameters.items()}
        alone = replace(prepared(part), line_tolerance=tolerance[i : i + 1])
        np.testing.assert_array_equal(find(alone)[..., 0], together[..., i])


def test_the_ladder_holds_wide_bundles_with_few_steps():
    assert HALVES[0] >= 0.5  # of a line anywhere about its bin
    assert all(0 < wide / narrow - 1 < 0.5 for narrow, wide in pairwise(HALVES))


def test_points_that_take_turns_at_every_tolerance_keep_each_others_kernels(table_4_1):
    """Lines are split as finely as each point asks for: no point drives out another's tables."""
    errors = np.tile(np.logspace(-6, 3, 10), 6)
    parameters = scene(table_4_1, phases="coherent", beamlets=37, range=1000.0)
    parameters |= {"target.radial_velocity": 3000.0, "accuracy.line_error": errors}
    ((_, shots),) = prepare(parameters, ("doppler", "footprint", "range_walk"))
    (stretch,) = modulation.stretches(shots)
    wanted = stretch.scene[1][5]
    assert wanted.shape[1] == len(modulation.SPLIT_TOLERANCES)
    assert len(set(wanted[0])) == wanted.shape[1]  # each asks for other lines
    find(shots)
    kept = np.abs(shots.kernel()[5][:, KEY])
    assert np.isin(wanted[[0, 2]], kept).all()
