"""Plans on the model itself: what they leave out changes pd by no more than the tolerance."""

from dataclasses import replace

import numpy as np
import pytest
from effect_points import drawn, moving_across, range_moments, velocity_moments

from sweep.model.effects import doppler_spread, footprint, footprint_phase, line_spread
from sweep.model.effects.change import Change
from sweep.model.effects.planning import plan
from sweep.model.shot import find

INSIDE = {"footprint": ("phases",), "velocities": ("phases",)}
"""Ranges and velocities make a coherent footprint's phases: they go after them."""


def changes(shots, values, across, segment):
    """Bounds of one segment by name."""
    line, n = line_spread.line_of(shots, segment), values["beamlets"]
    ranges = range_moments(shots, values, segment)
    velocities = velocity_moments(shots, values, segment, across)
    both = line_spread.Moments(*(a + b for a, b in zip(ranges, velocities, strict=True)))
    bounds = {
        "footprint": footprint.bound(line, ranges=ranges, velocities=velocities, beamlets=n),
        "velocities": doppler_spread.bound(line, velocities=velocities, ranges=ranges, beamlets=n),
    }
    if shots.incoherent:
        return bounds
    phase = footprint_phase.phase_reach(
        carrier=shots.carriers[segment],
        bandwidth=shots.bandwidth,
        range=shots.range,
        ranges=line_spread.plane_range_moments(
            grazing_angle=values["grazing_angle"],
            beam_divergence=values["beam_divergence"],
            number=n,
            pattern="sunflower",
        ),
        velocity_bins=velocities,
        record_ratio=0.5,
    )
    gain = footprint_phase.gain(shots)
    return bounds | {
        "phases": footprint_phase.bound(line, phase=phase, gain=gain, spread=both, beamlets=n)
    }


def up_and_down(shots, values, across):
    """Bounds of the up and the down segment, stacked."""
    up, down = (changes(shots, values, across, s) for s in (0, 2))
    columns = {
        name: [
            np.stack(np.broadcast_arrays(up[name].signal[end], down[name].signal[end]))
            for end in (0, 1)
        ]
        for name in up
    }
    return {name: Change(signal=tuple(ends)) for name, ends in columns.items()}


def left_out(shots, names):
    """The shots that a plan asks for."""
    for name, without in (
        ("phases", footprint_phase.without),
        ("velocities", doppler_spread.without),
        ("footprint", footprint.without),
    ):
        if name in names:
            shots = without(shots)
    return shots


def only(shots, i):
    """One of points with a row each."""
    per_point = {
        name: value[i : i + 1]
        for name in shots.__dataclass_fields__
        if isinstance(value := getattr(shots, name), np.ndarray) and value.shape[:1] == (30,)
    }
    return replace(shots, **per_point | {"row": np.zeros(1, np.int64)})


@pytest.mark.parametrize("phases", ["incoherent", "coherent"])
@pytest.mark.parametrize("tolerance", [1e-4, 1e-2, 0.3])
def test_pd_of_what_is_kept_is_within_the_tolerance(table_4_1, phases, tolerance):
    kept = dropped = 0
    widest = -2.7 if phases == "incoherent" else -3.5
    for seed in range(6):
        shots, values = drawn(
            table_4_1, 30, seed, fft_size=2**15, phases=phases, beamlets=19,
            power=10 ** np.random.default_rng(seed).uniform(-4, 0, 30),
            beam_divergence=10 ** np.random.default_rng(seed).uniform(-5, widest, 30),
        )  # fmt: skip
        across = 10 ** np.random.default_rng(seed).uniform(-2, 3, 30)
        shots = moving_across(shots, values, across)
        bounds = up_and_down(shots, values, across)
        a = np.stack([line_spread.axis_amplitude(shots, s) for s in (0, 2)])
        b = shots.threshold / shots.bin_deviation
        truth = find(shots)
        for i in range(30):
            each = {n: Change(signal=tuple(v[:, i : i + 1] for v in c.signal))
                    for n, c in bounds.items()}  # fmt: skip
            made = plan(
                each, amplitude=a[:, i : i + 1], threshold=b[i], tolerance=tolerance,
                inside=INSIDE if phases == "coherent" else None,
            )  # fmt: skip
            found = find(left_out(only(shots, i), made.left_out))
            error = abs(found[0, 0, 0] * found[2, 0, 0] - truth[0, 0, i] * truth[2, 0, i])
            assert made.within and error <= tolerance
            kept, dropped = kept + len(made.kept), dropped + len(made.left_out)
    assert kept > 20 and dropped > 20
