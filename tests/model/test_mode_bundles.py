"""Powers of lines whose phase errors are shots' own, against records in the time domain."""

from dataclasses import replace

import numpy as np
import pytest
from test_bundles import AGREEMENT, PLACES, WINDOWS, allowed, apart, both, drifting
from test_optional_lines import prepared, scene
from windows import marked

from sweep.model import modulation
from sweep.model.preparation import PhaseError
from sweep.model.segments import evaluate_segments, workspace
from sweep.model.shot import find

CASES = [*((place, True) for place in PLACES), ("in the band", False)]


def own(shots):
    """Shots whose phase errors nobody shares."""
    return replace(shots, alike=False)


def walking(shots, drift):
    """Shots that drift by so many bins each, (n,), with a cubic phase besides."""

    def phase(x, sign, drift):
        return (sign + 0.5) * drift[:, None] * (x**2 / 8 + x**3 / 60 + 0.1 * x)

    return own(replace(shots, phase_errors=(PhaseError(phase, {"drift": drift}),)))


@pytest.mark.parametrize("place, image", CASES)
@pytest.mark.parametrize("window", marked(WINDOWS))
def test_bins_are_those_of_the_record(window, place, image, table_4_1):
    """From drifts that show in no bin to those that few modes are not enough for."""
    without = () if image else ("image",)
    parameters = scene(
        table_4_1, window=window, phases="incoherent", power=10.0, tnr=4.0, **PLACES[place]
    )
    shots = own(prepared(parameters, without=without))
    for drift, segment in ((1e-3, 0), (0.1, 2), (0.5, 0), (1.5, 2), (4.0, 0)):
        missed, peak, form = apart(drifting(shots, drift), segment)
        assert missed < AGREEMENT * peak
        assert form == (drift < 4.0)


def test_bins_are_within_what_is_allowed_all_over_the_reach(table_4_1):
    rng, changed = np.random.default_rng(12), 0
    for window in ("hamming", "blackman"):
        for drift in 10 ** rng.uniform(-4, 0.4, 12):
            shots = prepared(
                scene(
                    table_4_1, window=window, phases="incoherent", power=10 ** rng.uniform(-4, 1),
                    grazing_angle=10 ** rng.uniform(-1, 0.1), tnr=4.0,
                )
            )  # fmt: skip
            tolerance = 10 ** rng.uniform(-5, -1)
            loose = own(replace(drifting(shots, drift), line_tolerance=np.asarray(tolerance)))
            found, true, peak, _ = both(loose, 0)
            missed = abs(found - true)
            assert (missed <= allowed(loose, true) + 1e-11 * peak).all()
            changed += missed.max() > AGREEMENT * peak
    assert changed > 3


def test_wide_bundles_stand_side_by_side(table_4_1):
    """Some tens of bins of lines; wider ones are looked at bin by bin."""
    forms = []
    for divergence, grazing_angle in ((50e-6, 0.02), (50e-6, 0.004), (2e-2, 0.2)):
        parameters = scene(
            table_4_1, phases="incoherent", power=10.0, beamlets=37, grazing_angle=grazing_angle,
            beam_divergence=divergence,
        )  # fmt: skip
        missed, peak, form = apart(drifting(own(prepared(parameters)), 0.4), 0)
        assert missed < AGREEMENT * peak
        forms.append(form)
    assert forms == [True, True, False]


def shots_of_a_flight(table_4_1, phases, n=60):
    """Shots of many ranges, angles, drifts, and as exactly as it pleases."""
    rng = np.random.default_rng(75)
    parameters = scene(
        table_4_1, phases=phases, beamlets=19, range=10 ** rng.uniform(1, 4, n),
        grazing_angle=rng.uniform(0.1, 1.5, n), power=10 ** rng.uniform(-1, 1, n),
    )  # fmt: skip
    tolerance = 10 ** rng.uniform(-6, -1, n)
    shots = walking(prepared(parameters), 10 ** rng.uniform(-4, 0.6, n))
    return replace(shots, line_tolerance=tolerance)


@pytest.mark.parametrize("left_out", [0.0, 1e-6])
def test_statistics_are_those_of_every_bin(left_out, table_4_1):
    """Leakage too, whose far bins may be left out by a bound on what modes show beside lines.

    A chance of exp(-b^2 / 2) or so changes by b times the error of its bin over sigma.
    """
    shots = shots_of_a_flight(table_4_1, "incoherent")
    shots = replace(shots, leakage_tolerance=np.asarray(left_out))
    exact = replace(shots, line_tolerance=np.asarray(0.0), leakage_floor=np.asarray(0.0))
    fast, slow = find(shots), find(exact, every_bin=True)
    sigma, tolerance = shots.bin_deviation, shots.line_tolerance
    pd, magnitude, leakage = (abs(fast - slow)[:, k] for k in (0, 2, 5))
    assert (pd <= tolerance + 1e-9).all()
    assert (magnitude <= tolerance * sigma + AGREEMENT * slow[:, 2]).all()
    follows = shots.threshold / sigma * tolerance * slow[:, 5]
    assert (leakage <= follows + left_out + 1e-9).all()


@pytest.mark.parametrize("phases", ["coherent", "incoherent"])
def test_shots_beside_a_shot_change_no_bit_of_it(phases, table_4_1):
    """Kernels serve all shots of a thread; those of one tolerance are not those of another."""
    shots = shots_of_a_flight(table_4_1, phases)
    together = find(shots)
    order, split = np.random.default_rng(3).permutation(shots.size), []
    for i in order[:20]:
        point = modulation.single(shots, int(i))
        split.append(point.scene[1][3].any())
        kernel, chosen = shots.kernel(), modulation.choices(shots)
        out = np.full((3, 6, 1), np.nan)
        evaluate_segments(
            point.points, point.row, point.scene, shots.segments, chosen, kernel,
            workspace(point.lines, shots.fft_size), out,
        )  # fmt: skip
        np.testing.assert_array_equal(out[..., 0], together[..., i])
    assert 0 < sum(split) < 5  # most are in modes, some wander too far


@pytest.mark.parametrize("allowed", [1e-9, 1e-5, 1e-2])
def test_amplitudes_in_modes_are_those_of_the_lines_that_each_line_is_split_into(
    allowed, table_4_1
):
    """As shots of a grid have them, whose kernels are shared."""
    shots = shots_of_a_flight(table_4_1, "coherent")
    shots = replace(shots, line_tolerance=np.asarray(allowed), leakage_tolerance=np.asarray(0.0))
    split = replace(shots, alike=True, line_tolerance=np.asarray(1e-10))
    fast, slow = find(shots), find(split)
    pd, magnitude = (abs(fast - slow)[:, k] for k in (0, 2))
    assert (pd <= allowed).all()
    assert (magnitude <= allowed * shots.bin_deviation + 1e-9 * slow[:, 2]).all()
