"""Tiles planned from rays in one pass against those of footprints that were put together first."""

from dataclasses import fields

import numpy as np
import pytest
from cast_blocks import block_of_cast
from small_scenes import flight, instrument, observed, plate

from sweep.model.effects.catalogue import DEFAULTS, EFFECTS
from sweep.model.effects.planning import plan
from sweep.model.effects.span import Span
from sweep.model.effects.tile_link import TileLink
from sweep.model.eyepoints import seen_ground
from sweep.model.geometry.mesh import Surface
from sweep.model.seen_tiles import block_of

SURFACES = [Surface("ground", 0.1), Surface("table", 0.7, "lommel_seeliger")]
EDGES = np.array([0, 5, 18, 40, 41, 77])
"""Of tiles of all sizes, one shot among them; 77 shots are no whole number of fours."""


def _seen(number):
    """Shots on their way over a table's edge, and past where the ground ends."""
    path = flight(position=(-0.1, -0.1, 1000.0), velocity=(0.0014, 0.001, 0.0), duration=1e4)
    bodies = [plate(y=(-1e3, 0.0)), plate(x=(0.0, 1e3), y=(-1e3, 0.0), surface=1, height=7.0)]
    seen = observed(path, bodies=bodies, number=number, index=np.arange(120))
    return seen.some(np.flatnonzero(seen.seen)[-77:])


@pytest.mark.parametrize("number", [1, 7, 109, 1015])
@pytest.mark.parametrize("architecture", ["homodyne", "direct"])
@pytest.mark.parametrize("sun", [0.0, 0.3])
def test_the_block_is_that_of_the_footprints(table_4_1, number, architecture, sun):
    """All of its geometry and its parameters, bit for bit, and so its plan."""
    seen = _seen(number)
    parameters = DEFAULTS | instrument(table_4_1, architecture=architecture)
    parameters |= {"target.solar_irradiance": sun, "footprint.beamlets": number}
    assert len(seen.time) == EDGES[-1] and {*seen.surface.ravel()} >= {0, 1}
    assert number == 1 or (seen.surface < 0).any()
    shots, ground = seen_ground(seen, parameters, SURFACES)
    slow = block_of_cast(dict(shots), ground.beamlets, ground.beside, EDGES, rotating=True)
    own = {
        path: value if isinstance(value, str) else Span.of(np.asarray(value)[()])
        for path, value in parameters.items()
    }
    fast = block_of(seen, TileLink(own), SURFACES, EDGES, True)
    assert fast.size == slow.size
    for field in fields(slow.geometry):
        one, other = (getattr(block.geometry, field.name) for block in (fast, slow))
        np.testing.assert_array_equal(_numbers(one), _numbers(other), field.name)
    assert fast.parameters.keys() == slow.parameters.keys()
    for path, value in slow.parameters.items():
        np.testing.assert_array_equal(_numbers(fast.parameters[path]), _numbers(value), path)
    modes = {effect.name: "off" if effect.is_random else "auto" for effect in EFFECTS}
    plans = [plan(block, modes=modes, tolerance=1e-3) for block in (fast, slow)]
    np.testing.assert_array_equal(plans[0].kept, plans[1].kept)
    np.testing.assert_array_equal(plans[0].error, plans[1].error)


def _numbers(value):
    """What a span, moments, a number or a word are made of, one for each tile."""
    if isinstance(value, str):
        return value
    parts = (value.low, value.high) if isinstance(value, Span) else np.atleast_1d(value)
    return np.array([np.broadcast_to(part, EDGES.size - 1) for part in parts])
