"""Plans of plain scenes in one pass against those that the effects' own modules make."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from small_scenes import instrument

from sweep.model.effects import tile_geometry
from sweep.model.effects.block import Block
from sweep.model.effects.catalogue import DEFAULTS, EFFECTS, NAMES
from sweep.model.effects.footprint_fields import (
    APART,
    BESIDE,
    FIELDS,
    GAIN,
    OWN_RANGES,
    RANGES,
    VELOCITIES,
    WHOLE,
)
from sweep.model.effects.plain_plan import (
    DISTANCE,
    VARYING,
    VELOCITY,
    PlainFlight,
    PlainPlanes,
)
from sweep.model.effects.plain_scene import PLAIN, is_plain
from sweep.model.effects.planning import plan, rules_of
from sweep.model.effects.span import Span
from sweep.model.effects.tile_link import TileLink

EDGES = np.array([0, 1, 4, 9, 10, 30, 31])
"""Of tiles of several sizes, some of one shot."""
LARGEST = {
    "target.grazing_angle": np.pi / 2, "target.reflectance": 1.0,
    "instrument.telescope.optical_efficiency": 1.0,
}  # fmt: skip
ARCHITECTURE = "instrument.receiver.architecture"
MODES = st.fixed_dictionaries(
    {}, optional={n: st.sampled_from(["on", "off"]) for n in NAMES if n != "doppler"}
)


def link(table_4_1, **other):
    """An instrument as flights have it."""
    parameters = DEFAULTS | instrument(table_4_1) | other
    return TileLink(
        {
            path: value if isinstance(value, str) else Span.of(np.asarray(value)[()])
            for path, value in parameters.items()
        }
    )


def found_in(rng, number):
    """Fields of footprints of shots of all kinds: near, far, at rest, fast, of several surfaces."""
    n = EDGES[-1]
    found = np.empty((FIELDS + 2, n))
    found[WHOLE] = 10 ** rng.uniform(-8, 0, n)
    found[GAIN] = 1 + rng.random(n) * (np.sqrt(number) - 1)
    for rows, scale in (
        (RANGES, 10 ** rng.uniform(-9, -1)),
        (VELOCITIES, 10 ** rng.uniform(-15, -6)),
    ):
        extreme = scale * 10 ** rng.uniform(-2, 0, n) * (number > 1)
        found[rows : rows + 3] = extreme * np.array([0.1, 0.5, 1.0])[:, None]
    found[OWN_RANGES : OWN_RANGES + 3] = found[RANGES : RANGES + 3] * rng.choice([1.0, 0.3])
    several = (rng.random(n) < rng.choice([0.0, 0.3])) * (number > 1)
    found[BESIDE], found[APART] = rng.random(n) * several, several * rng.random(n) * 0.1
    found[DISTANCE] = 10 ** (rng.uniform(0, 6) + rng.choice([0.0, 1e-6, 0.1]) * rng.random(n))
    fast = rng.choice([0.0, 1e-6, 1e-3, 1.0, 300.0, 1e4])
    found[VELOCITY] = fast * (1 + rng.choice([0.0, 0.01, 2.0]) * rng.uniform(-1, 1, n))
    return found


def block_of(scene, found):
    """The block of tiles in which that was found."""
    spans = tile_geometry.over(found, EDGES)
    seen = {
        "target.range": Span(spans.low[DISTANCE], spans.high[DISTANCE]),
        "target.radial_velocity": Span(spans.low[VELOCITY], spans.high[VELOCITY]),
        "target.reflectance": Span.of(1.0),
    }
    geometry = tile_geometry.of_fields(Span(spans.low[:FIELDS], spans.high[:FIELDS]))
    return Block({**scene.parameters, **seen}, EDGES.size - 1, geometry, instrument=scene)


@pytest.mark.parametrize("phases", ["coherent", "incoherent"])
@pytest.mark.parametrize("number", [1, 19, 109])
@given(st.integers(0, 2**32), MODES, st.sampled_from([0.0, 1e-9, 1e-6, 1e-3, 0.1, 1.0]))
def test_in_one_pass_a_plan_is_the_same_bit_for_bit(
    table_4_1, number, phases, seed, modes, tolerance
):
    rng = np.random.default_rng(seed)
    scene = link(
        table_4_1,
        **{
            ARCHITECTURE: str(rng.choice(["homodyne", "heterodyne"])),
            "footprint.beamlets": number, "footprint.phases": phases,
            "instrument.processing.bins_counted": str(rng.choice(["all", "half"])),
            "instrument.laser.power": 10 ** rng.uniform(-6, 3),
        },
    )  # fmt: skip
    assert is_plain(scene, rotating=False)
    modes = modes | {e.name: "off" for e in EFFECTS if e.is_random}
    if any(modes.get(e.name) == "on" and modes.get(e.within) == "off" for e in EFFECTS):
        modes = {}
    found, rules = found_in(rng, number), rules_of(EFFECTS, tuple(modes.items()))
    slow = plan(block_of(scene, found), modes, tolerance)
    fast = PlainFlight.of(scene).plan(found, EDGES, rules, tolerance)
    assert fast.names == slow.names
    np.testing.assert_array_equal(fast.change, slow.change)
    np.testing.assert_array_equal(fast.kept, slow.kept)
    np.testing.assert_array_equal(fast.error, slow.error)


def planes(parameters, rng):
    """Tiles of points on planes: as wide as chance has it, some of one point."""
    number, found = 30, {}
    wide = 10 ** rng.uniform(-9, 0, number) * rng.choice([0, 1], number)
    varying = [path for path in sorted(VARYING) if rng.random() < 0.6]
    for path, value in parameters.items():
        if isinstance(value, str):
            found[path] = value
        elif path not in varying:
            found[path] = Span.of(float(value))
        else:
            middle = float(value) * 10 ** rng.uniform(-1, 1, number)
            top = LARGEST.get(path, np.inf)
            low = np.minimum(middle, top)
            found[path] = Span(low, np.minimum(low + wide * abs(low), top))
    return found, max((span.low.size for path in varying for span in [found[path]]), default=1)


@pytest.mark.parametrize("phases", ["coherent", "incoherent"])
@pytest.mark.parametrize("law", ["thesis", "lambert", "lommel_seeliger"])
@given(st.integers(0, 2**32), MODES, st.sampled_from([0.0, 1e-6, 1e-3, 0.1]))
def test_on_planes_too(table_4_1, law, phases, seed, modes, tolerance):
    rng = np.random.default_rng(seed)
    parameters = DEFAULTS | table_4_1(
        range=10 ** rng.uniform(0, 5), radial_velocity=float(rng.choice([0.0, -1e-4, 1.0, 3e3])),
        grazing_angle=float(rng.choice([np.pi / 2, 1.0, 0.3, 1e-3])), reflectance_law=law,
        beam_divergence=10 ** rng.uniform(-5, -2), phases=phases,
        beamlets=int(rng.choice([1, 3, 19, 109])), duration=float(rng.choice([500e-6, 200e-6])),
    ) | {"target.transverse_velocity": float(rng.choice([0.0, 30.0, -3e3]))}  # fmt: skip
    tiles, size = planes(parameters, rng)
    modes = modes | {e.name: "off" for e in EFFECTS if e.is_random}
    if any(modes.get(e.name) == "on" and modes.get(e.within) == "off" for e in EFFECTS):
        modes = {}
    slow = plan(Block.of_plane(tiles), modes, tolerance)
    rules = rules_of(EFFECTS, tuple(modes.items()))
    fast = PlainPlanes.of(tiles).plan(tiles, size, rules, tolerance)
    np.testing.assert_array_equal(fast.change, slow.change)
    np.testing.assert_array_equal(fast.kept, slow.kept)
    np.testing.assert_array_equal(fast.error, slow.error)


def test_planes_are_planned_together_only_where_the_receiver_is_the_same(table_4_1):
    tiles, _ = planes(DEFAULTS | table_4_1(), np.random.default_rng(1))
    assert PlainPlanes.of(tiles) is not None
    for path in ("instrument.processing.tnr", "instrument.receiver.responsivity"):
        varied = Span(np.array([0.5, 6.0]), np.array([0.6, 7.0]))
        assert PlainPlanes.of(tiles | {path: varied}) is None
    assert PlainPlanes.of(tiles | {"target.acceleration": Span.of(1.0)}) is None
    assert PlainPlanes.of(tiles | {ARCHITECTURE: "direct"}) is None


def test_what_any_other_effect_brings_makes_a_scene_no_plain_one(table_4_1):
    """Each of the parameters of effects that are not plain, and what turns or lights a scene."""
    assert is_plain(link(table_4_1), rotating=False)
    assert not is_plain(link(table_4_1), rotating=True)
    assert not is_plain(link(table_4_1, **{ARCHITECTURE: "direct"}), rotating=False)
    others = [e for e in EFFECTS if e.name not in PLAIN]
    changed = {p.path: (p.default, *p.options) for e in others for p in e.parameters}
    changed["target.solar_irradiance"] = (0.0,)
    assert len(others) == len(EFFECTS) - len(PLAIN) and len(changed) > 15
    for path, (default, *options) in changed.items():
        other = next((word for word in options if word != default), 2.5)
        # without a sun it is all one how much of the ground is seen, and how high one stands
        if path not in ("instrument.receiver.field_of_view", "target.sun_elevation"):
            assert not is_plain(link(table_4_1, **{path: other}), rotating=False), path


def test_a_plain_scene_has_no_bound_of_any_other_effect(table_4_1):
    scene, rng = link(table_4_1), np.random.default_rng(0)
    names = []
    for effect in EFFECTS:
        if effect.name not in PLAIN:
            assert effect.bound(block_of(scene, found_in(rng, 19))) is None, effect.name
        else:
            names.append(effect.name)
    assert tuple(names) == PLAIN
