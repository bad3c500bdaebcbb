import numpy as np
import pytest
import xarray as xr
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import brentq
from scipy.special import ndtr, ndtri
from stored_studies import INSTRUMENT, run_into_store, spec_over_axes
from synthetic_datasets import dataset_of_deviates

import sweep
from sweep.model.evaluation import evaluate

LEVEL = float(ndtri(0.9))
RANGES = np.array([100.0, 200.0, 400.0, 700.0, 1100.0])


def answers(z, x=RANGES, **options):
    limit = dataset_of_deviates(z, range=x).sweep.limit("range", 0.9, **options).compute()
    return {
        kind: (float(limit[kind]), limit[f"{kind}_reason"].item())
        for kind in ("unbroken", "farthest")
    }


def test_a_fall_that_is_straight_in_the_normal_deviate_is_placed_exactly():
    z = LEVEL + (640.0 - RANGES) / 100
    assert answers(z)["unbroken"] == (pytest.approx(640.0, rel=1e-12), 0)
    assert answers(z)["farthest"] == (pytest.approx(640.0, rel=1e-12), 0)


def test_a_dip_ends_the_unbroken_range_and_not_the_farthest():
    limit = answers(LEVEL + np.array([3.0, -1.0, 2.0, 1.0, -1.0]))
    assert limit["unbroken"] == (pytest.approx(175.0), 0)
    assert limit["farthest"] == (pytest.approx(900.0), 0)


@pytest.mark.parametrize(
    "z,unbroken,farthest",
    [
        ([-1.0, -1.0, -2.0, -1.0, -1.0], 1, 1),
        ([1.0, 1.0, 2.0, 1.0, 1.0], 2, 2),
        ([-1.0, 1.0, 2.0, 1.0, 1.0], 1, 2),
        ([1.0, -1.0, 2.0, 1.0, 1.0], 0, 2),
        ([np.nan, 1.0, -2.0, 1.0, -1.0], 3, 0),
        ([1.0, -1.0, np.nan, 1.0, -1.0], 0, 0),
        ([1.0, 1.0, np.nan, 1.0, 1.0], 3, 2),
        ([1.0, -1.0, 2.0, -1.0, np.nan], 0, 3),
    ],
)  # fmt: skip
def test_what_is_not_found_says_why(z, unbroken, farthest):
    limit = answers(LEVEL + np.array(z))
    assert (limit["unbroken"][1], limit["farthest"][1]) == (unbroken, farthest)
    for value, reason in limit.values():
        assert np.isnan(value) == (reason != 0)


def walked(z):
    """The same, walked step by step; places counted in steps."""
    if not (known := ~np.isnan(z)).all():
        raise AssertionError("for computed points only")
    assert known.all()
    place = [None, None]
    for i in range(len(z) - 1):
        if z[i] >= 0 > z[i + 1]:
            crossing = i + z[i] / (z[i] - z[i + 1])
            place = [crossing if place[0] is None else place[0], crossing]
    unbroken = place[0] if z[0] >= 0 else None
    return unbroken, None if z[-1] >= 0 else place[1]


@given(
    st.lists(st.floats(-3, 3).filter(lambda v: abs(v) > 1e-3), min_size=2, max_size=12),
    st.booleans(),
)
def test_any_profile_is_walked_as_step_by_step(z, from_highest):
    x = np.arange(len(z), dtype=float)
    limit = answers(LEVEL + np.array(z), x, from_highest=from_highest)
    expected = walked(np.array(z[::-1] if from_highest else z))
    for kind, place in zip(("unbroken", "farthest"), expected, strict=True):
        if place is None:
            assert np.isnan(limit[kind][0])
        else:
            value = len(z) - 1 - place if from_highest else place
            assert limit[kind][0] == pytest.approx(value, abs=1e-9)


def test_intervals_of_pd_make_intervals_of_range():
    z = LEVEL + (640.0 - RANGES) / 1000
    limit = dataset_of_deviates(z, 0.02, range=RANGES).sweep.maximum_range().compute()
    for end, moved in (("low", -0.02), ("high", 0.02)):
        shifted = np.clip(ndtr(z) + moved, 0, 1)
        i = np.flatnonzero(shifted >= 0.9)[-1]
        a, b = ndtri(shifted[i]) - LEVEL, ndtri(shifted[i + 1]) - LEVEL
        value = RANGES[i] + a / (a - b) * (RANGES[i + 1] - RANGES[i])
        assert float(limit[f"unbroken_{end}"]) == pytest.approx(value)
    assert limit.unbroken_low < limit.unbroken < limit.unbroken_high


def test_the_least_angle_is_found_from_the_normal_down_at_every_range():
    angles, ranges = np.arange(5.0, 91.0, 5.0), np.array([1000.0, 2000.0, 4000.0])
    least = np.array([12.5, 31.0, 55.0])
    dataset = dataset_of_deviates(
        LEVEL + (angles - least[:, None]) / 10, range=ranges, grazing_angle=angles
    )
    limit = dataset.sweep.minimum_grazing_angle()
    assert limit.unbroken.values == pytest.approx(least)
    assert limit.unbroken.attrs["units"] == "deg"
    assert limit.range.values == pytest.approx(ranges)


@pytest.mark.parametrize("chunks", [{"range": 7}, {"range": 1, "grazing_angle": 3}])
def test_the_answer_is_lazy_and_the_same_in_any_chunks(chunks):
    rng = np.random.default_rng(3)
    x, y = np.linspace(1, 2, 40), np.linspace(10, 80, 8)
    z = LEVEL + rng.normal(0, 2, (40, 8))
    z[rng.random(z.shape) < 0.05] = np.nan
    unsplit = dataset_of_deviates(z, range=x, grazing_angle=y)
    lazy = unsplit.chunk(chunks).sweep.maximum_range()
    assert all(array.chunks is not None for array in lazy.data_vars.values())
    assert lazy.compute().identical(unsplit.sweep.maximum_range())


@pytest.mark.parametrize("pd", ["90 %", "0.9", "90%", np.float64(0.9), np.float32(0.9)])
def test_a_level_of_pd_is_a_share_or_in_percent(pd):
    angles = np.array([20.0, 40.0])
    z = LEVEL + (640.0 - RANGES[:, None]) / 1000 * [1.0, 2.0]
    dataset = dataset_of_deviates(z, range=RANGES, grazing_angle=angles)
    for ask in ("maximum_range", "contour"):
        expected, actual = (getattr(dataset.sweep, ask)(level) for level in (0.9, pd))
        xr.testing.assert_allclose(actual, expected, rtol=1e-6)


@pytest.mark.parametrize("pd", ["0.9 W", "high", [0.5, 0.9], None, True, "90", 0, 1, "100 %", 1.5])
@pytest.mark.parametrize("ask", ["maximum_range", "contour"])
def test_what_is_no_level_of_pd_is_refused_in_words(ask, pd):
    dataset = dataset_of_deviates(
        np.zeros((5, 2)), range=RANGES, grazing_angle=np.array([20.0, 40.0])
    )
    with pytest.raises(ValueError, match="a level of pd"):
        getattr(dataset.sweep, ask)(pd)


def test_what_cannot_be_walked_is_refused():
    dataset = dataset_of_deviates(np.zeros(2), range=[1.0, 1.0])
    with pytest.raises(ValueError, match="more than once"):
        dataset.sweep.maximum_range()
    with pytest.raises(ValueError, match="single value"):
        dataset_of_deviates(np.zeros(1), range=[1.0]).sweep.maximum_range()
    with pytest.raises(ValueError, match="is no coordinate"):
        dataset.sweep.minimum_grazing_angle()
    with pytest.raises(ValueError, match="between 0 and 1"):
        dataset.sweep.maximum_range(pd=1.0)
    with pytest.raises(ValueError, match="take one of up, doppler, down, shot"):
        dataset.sweep.maximum_range(segment="sideways")


SMOOTH = {**INSTRUMENT, "processing": INSTRUMENT["processing"] | {"window": "flattop"}}
"""A window without scalloping, so that pd falls smoothly and has one root."""


@pytest.mark.parametrize("step,error", [(1000, 40.0), (250, 2.5)])
def test_the_maximum_range_is_the_root_of_the_model_itself(step, error, tmp_path):
    axes = {"target.range": {"step": ["1 km", "9 km", f"{step} m"]}}
    sections = {"instrument": SMOOTH, "footprint": {"beamlets": 1, "speckle": "none"}}
    sections["effects"] = {"overlap": "off"}  # `evaluate` by itself has records filled
    limit = sweep.open(run_into_store(tmp_path, axes, **sections)).sweep.maximum_range().compute()
    parameters = spec_over_axes({}, **sections).parameters()

    def excess(distance):
        return evaluate(parameters | {"target.range": distance})["pd_shot"].item() - 0.9

    root = brentq(excess, 1000, 9000, xtol=1e-3)
    # z falls as 1/R: a straight line through two points is off by h^2 / (4 R) at the most
    assert step**2 / (4 * root) < 1.3 * error
    assert 1000 * float(limit.unbroken) == pytest.approx(root, abs=error)
    assert limit.unbroken.attrs["units"] == "km"


def test_a_zipped_axis_is_walked_after_a_selection(tmp_path):
    axes = {
        "cut": {
            "zip": [
                {"target.range": ["8 km", "2 km", "5 km"], "target.grazing_angle": "15 deg"},
                {"target.range": ["2 km", "5 km", "8 km"], "target.grazing_angle": "85 deg"},
            ]
        }
    }
    dataset = sweep.open(
        run_into_store(
            tmp_path, axes, footprint={"beamlets": 1, "speckle": "none"}, instrument=SMOOTH
        )
    )
    with pytest.raises(ValueError, match="select by the other coordinates along 'cut'"):
        dataset.sweep.maximum_range()
    part = dataset.sweep.sel(grazing_angle="15 deg")
    limit = part.sweep.maximum_range(pd=0.5).compute()
    pd = part.pd_shot.sortby("range").values
    assert pd[0] > pd[1] > 0.5 > pd[2]
    assert 5 < float(limit.unbroken) < 8
