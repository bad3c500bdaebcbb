import math

import numpy as np
import pytest
from scipy import integrate

from sweep.model.geometry import craters, frequency
from sweep.model.geometry.terrain import Terrain

SQUARE_KILOMETRE = (0.0, 0.0, 1000.0, 1000.0)


def flat(size=201, step=1.0, origin=(0.0, 0.0, 0.0), dy=1.0):
    return Terrain(np.zeros((size, size)), (step, dy * step), np.array(origin))


def one(x, y, diameter, freshness=1.0):
    return craters.Craters(*(np.array([value]) for value in (x, y, diameter, freshness)))


@pytest.mark.parametrize("smallest", [5.0, 20.0, 60.0])
def test_counts_of_craters_follow_trasks_equilibrium(smallest):
    """10^10.9 D^-2 per 10^6 km^2, D in metres, within 5 sigma of a Poisson number."""
    x, y, diameter = frequency.scatter(
        np.random.default_rng(1),
        frequency.lunar_craters(),
        bounds=SQUARE_KILOMETRE,
        smallest=5.0,
        largest=400.0,
    )
    expected = 10**10.9 / 1e6 * (smallest**-2 - 400.0**-2)
    assert abs((diameter >= smallest).sum() - expected) < 5 * math.sqrt(expected)
    assert (np.diff(diameter) <= 0).all()
    assert min(x.min(), y.min()) >= 0 and max(x.max(), y.max()) <= 1000


def test_beyond_equilibrium_counts_fall_as_craters_are_produced():
    law = frequency.lunar_craters(equilibrium_diameter=50.0)
    assert law.cumulative(20.0) == pytest.approx(10**-1.1 / 400)
    assert law.cumulative(50.0) == pytest.approx(frequency.lunar_craters().cumulative(50.0))
    slope = math.log(law.cumulative(400.0) / law.cumulative(100.0)) / math.log(4)
    assert slope == pytest.approx(-2.8)
    diameter = np.geomspace(1, 1000, 50)
    np.testing.assert_allclose(law.diameter(law.cumulative(diameter)), diameter, rtol=1e-12)


def test_a_fresh_crater_is_a_fifth_as_deep_as_it_is_wide():
    """Pike's earlier, rounder statement of 1974: depth about 0.2 of the diameter."""
    diameter = np.array([10.0, 100.0, 1000.0, 10_000.0])
    np.testing.assert_allclose(craters.fresh_depth(diameter) / diameter, 0.2, atol=0.015)
    assert craters.fresh_depth(1000.0) == pytest.approx(196.0)
    assert craters.fresh_rim_height(1000.0) == pytest.approx(36.0)


def test_a_carved_crater_has_its_rim_its_floor_and_its_ejecta_where_they_belong():
    ground = craters.carve(flat(origin=(1e6, 2e6, -50.0)), one(1e6 + 100, 2e6 + 90, 60.0))
    z = ground.heights
    depth, rim = craters.fresh_depth(60.0), craters.fresh_rim_height(60.0)
    assert np.unravel_index(z.argmin(), z.shape) == (90, 100)  # row along y, column along x
    assert z[90, 100] == pytest.approx(rim - depth)
    for place in ((90, 130), (90, 70), (120, 100), (60, 100)):
        assert z[place] == pytest.approx(rim)
    assert z.max() == pytest.approx(rim)
    assert z[90, 160] == pytest.approx(rim * (2**-3 - 4**-3) / (1 - 4**-3))
    assert z[0, 0] == 0.0 and ground.origin[2] == -50.0


def test_a_crater_lies_where_it_should_on_a_grid_that_runs_southwards():
    z = craters.carve(flat(origin=(0.0, 200.0, 0.0), dy=-1.0), one(50.0, 170.0, 30.0)).heights
    assert np.unravel_index(z.argmin(), z.shape) == (30, 50)


def test_the_profile_is_continuous_at_the_rim_and_at_its_end():
    r = np.array([30 - 1e-9, 30 + 1e-9, 120 - 1e-9, 120 + 1e-9])
    z = craters.profile(r, diameter=60.0, freshness=1.0)
    assert z[0] == pytest.approx(z[1], abs=1e-7) and z[2:] == pytest.approx(0, abs=1e-7)


def test_the_volume_dug_is_that_of_a_paraboloid():
    depth, rim = craters.fresh_depth(60.0), craters.fresh_rim_height(60.0)

    def below_the_rim(r):
        return (rim - craters.profile(np.array(r), diameter=60.0, freshness=1.0)) * 2 * math.pi * r

    volume, _ = integrate.quad(below_the_rim, 0, 30)
    assert volume == pytest.approx(math.pi * 30**2 * depth / 2, rel=1e-9)


def test_craters_add_up_and_worn_ones_are_shallower_in_proportion():
    both = craters.Craters(*(np.array(v) for v in ([60, 90], [70, 95], [40, 30], [1.0, 0.3])))
    first, second = (craters.Craters(*(v[i : i + 1] for v in both)) for i in (0, 1))
    expected = craters.carve(flat(), first).heights + craters.carve(flat(), second).heights
    np.testing.assert_allclose(craters.carve(flat(), both).heights, expected, atol=1e-12)
    fresh = craters.carve(flat(), one(90, 95, 30)).heights
    np.testing.assert_allclose(craters.carve(flat(), second).heights, 0.3 * fresh, atol=1e-12)


def test_no_edge_of_the_ground_is_free_of_craters_from_beside_it():
    """A crater centred outside throws its ejecta in: the drawn ones reach over every edge."""
    drawn = craters.draw_craters(
        np.random.default_rng(4),
        frequency.lunar_craters(),
        bounds=(0.0, 0.0, 300.0, 300.0),
        smallest=5.0,
        largest=100.0,
    )
    assert (drawn.x < 0).any() and (drawn.x > 300).any()
    assert (drawn.y < 0).any() and (drawn.y > 300).any()
    assert ((drawn.x > -2 * drawn.diameter) & (drawn.y > -2 * drawn.diameter)).all()
    assert drawn.freshness.min() >= 0.1 and drawn.freshness.max() <= 1
    inside = (drawn.x > 0) & (drawn.x < 300) & (drawn.y > 0) & (drawn.y < 300)
    expected = 10**-1.1 * (5.0**-2 - 100.0**-2) * 300**2
    assert abs(inside.sum() - expected) < 5 * math.sqrt(expected)


def test_a_crater_that_the_grid_can_not_hold_is_refused():
    with pytest.raises(ValueError, match="under three grid steps"):
        craters.carve(flat(), one(50, 50, 2.5))


def test_a_crater_beside_the_ground_changes_nothing():
    assert not craters.carve(flat(), one(-500.0, 900.0, 50.0)).heights.any()
