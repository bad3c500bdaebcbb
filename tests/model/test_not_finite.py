"""Numbers that are not finite: every loop ends on them, and the shot that has one is named."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from small_scenes import (
    DOWNWARD_BEAM,
    level_plate,
    observe_shots,
    scene_parameters,
    straight_flight,
)

from sweep.model.detection.looks import Looks
from sweep.model.geometry.mesh import SurfaceMaterial
from sweep.model.geometry.ray_casting import RayCaster
from sweep.model.pointcloud.bin_groups import GroupBinIndices, _list_strongest_groups
from sweep.model.pointcloud.eyepoints import HIT_RANGE_MIN, prepare_eyepoint_shots
from sweep.model.preparation import require_finite
from sweep.model.spectrum.search_band import SearchBand
from sweep.model.spectrum.search_restriction import _mark_searched_echoes
from sweep.model.unsupported_shot import UnsupportedShotError
from sweep.scenes.meshes import clean_mesh

NOT_FINITE = [np.nan, np.inf, -np.inf]


@pytest.mark.parametrize("value", NOT_FINITE)
@pytest.mark.parametrize("level", [2.0, np.nan])
def test_lists_of_groups_end_wherever_a_magnitude_is_not_finite(value, level):
    for place in range(6):
        magnitude = np.array([1.0, 3.0, 4.0, 1.0, 5.0, 1.0])
        magnitude[place] = value
        bounds = GroupBinIndices(*np.full((3, 4), -1))
        peak = int(np.nanargmax(magnitude))
        exempt = np.zeros(6, np.bool_)
        assert _list_strongest_groups(magnitude, exempt, peak, level, bounds) <= 4
        _mark_searched_echoes(magnitude, exempt, 0, level, 0, SearchBand(0, 6, 0), np.array([2.0]))


def test_probabilities_of_several_records_end_for_levels_that_are_not_finite():
    several = Looks(4)
    for level in (np.nan, np.inf):
        with np.errstate(all="ignore"):
            several.p_stay_given_neighbour_crosses(np.array([level, 3.0]), 0.4)


def shots(table_4_1):
    eyes = observe_shots(straight_flight(), index=range(3))
    return prepare_eyepoint_shots(
        eyes, scene_parameters(table_4_1), [SurfaceMaterial("plate", 0.1)]
    )


@pytest.mark.parametrize("value", NOT_FINITE)
@pytest.mark.parametrize(
    ("record_name", "name", "words"),
    [("target", "range", "the range"),
     ("footprint", "relative_amplitude", "beamlets' echoes"),
     ("footprint", "relative_range_offset", "beamlets' ranges"),
     ("echo_scales", "echo_power_scale", "echo's power")],
)  # fmt: skip
def test_a_shot_with_a_number_that_is_not_finite_is_named(
    table_4_1, record_name, name, words, value
):
    prepared = shots(table_4_1)
    require_finite(prepared)
    record = getattr(prepared, record_name)
    values = np.array(getattr(record, name))
    if values.ndim:
        values[1 if values.shape[0] > 1 else 0] = value
    else:
        values = np.asarray(value)
    change = record._replace if hasattr(record, "_replace") else partial(replace, record)
    spoilt = replace(prepared, **{record_name: change(**{name: values})})
    with pytest.raises(UnsupportedShotError, match=words) as refused:
        require_finite(spoilt)
    assert refused.value.point_index in (0, 1)


def test_a_path_that_leaves_the_numbers_is_refused_with_the_shot_and_its_time():
    away = straight_flight(velocity=(1e308, 0.0, 0.0), duration=1e3)
    with (
        np.errstate(all="ignore"),
        pytest.raises(
            UnsupportedShotError, match=r"shot 4, at time 4 s, has a position that is not"
        ),
    ):
        observe_shots(away, index=(0, 1, 4))


WALL = clean_mesh(
    np.array([[0.0, -50, -50], [0, 50, -50], [0, 50, 50], [0, -50, 50]]),
    np.array([[0, 1, 2], [0, 2, 3]]),
    0,
)[0]
FORWARD = np.array([[1.0, 0.0, 0.0]])


@pytest.mark.parametrize("x", [0.0, -1e-12, -0.5 * HIT_RANGE_MIN])
def test_an_instrument_in_the_plane_of_a_wall_sees_what_is_beyond_it(table_4_1, x):
    far = replace(WALL, origin=WALL.origin + np.array([200.0, 0.0, 0.0]))
    eyes = observe_shots(straight_flight((x, 0.0, 0.0)), bodies=[WALL, far], beams=FORWARD)
    np.testing.assert_allclose(eyes.range, 200.0, rtol=1e-4)
    prepare_eyepoint_shots(eyes, scene_parameters(table_4_1), [SurfaceMaterial("wall", 0.1)])
    eyepoints = observe_shots(straight_flight((x, 0.0, 0.0)), bodies=[WALL], beams=FORWARD)
    assert not eyepoints.has_target.any()


def test_a_surface_farther_than_the_least_range_is_hit():
    eyes = observe_shots(
        straight_flight((-2 * HIT_RANGE_MIN, 0.0, 0.0)), bodies=[WALL], beams=FORWARD
    )
    np.testing.assert_allclose(eyes.range, 2 * HIT_RANGE_MIN)
    low = observe_shots(straight_flight((0.0, 0.0, 0.1)), beams=DOWNWARD_BEAM)
    np.testing.assert_allclose(low.range, 0.1)


def test_the_least_range_is_the_callers():
    caster, origin = RayCaster(level_plate()), np.array([[0.0, 0.0, 0.5]])
    for least, range_ in ((0.0, 0.5), (0.4, 0.5), (0.6, np.inf)):
        assert caster.cast_bundles(origin, DOWNWARD_BEAM[:, None], range_min=least).range == range_
