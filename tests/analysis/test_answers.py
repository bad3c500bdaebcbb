import json

import numpy as np
import pytest
import xarray as xr
from click.testing import CliRunner
from stored_studies import (
    INSTRUMENT,
    POWER_AND_CUT_AXES,
    SURFACE_AXES,
    run_into_store,
    spec_over_axes,
)
from synthetic_datasets import dataset_of_deviates

import sweep
from sweep.cli import main
from sweep.model.detection import estimators
from sweep.model.evaluation import evaluate

PERIODS = 3 * 500e-6
"""Seconds of a shot: three chirps of Table 4.1."""


@pytest.fixture(scope="module")
def surface(tmp_path_factory):
    return sweep.open(run_into_store(tmp_path_factory.mktemp("answers"), SURFACE_AXES))


@pytest.fixture(scope="module")
def speckled(tmp_path_factory):
    return sweep.open(
        run_into_store(
            tmp_path_factory.mktemp("speckled"),
            {"target.range": ["500 m", "3 km", "6 km"]},
            footprint={"beamlets": 1, "speckle": "none"},
            target=spec_over_axes({}).to_yaml_mapping()["target"] | {"roughness": "10 um"},
            draws={"number": 400, "batch": 400},
            seed=5,
        )
    )


def test_a_point_is_selected_by_what_it_is_in_any_unit(tmp_path):
    axes = {"target.range": ["1 km", "2 km"], "target.grazing_angle": ["20 deg", "45 deg"]}
    dataset = sweep.open(run_into_store(tmp_path, axes))
    expected = float(dataset.pd_shot.isel(range=1, grazing_angle=0))
    for distance in ("2 km", "2000 m", 2.0, "2e6 mm"):
        point = dataset.sweep.sel(range=distance, grazing_angle="20 deg")
        assert point.pd_shot.shape == () and float(point.pd_shot) == expected
    radian = f"{float(np.deg2rad(20))!r} rad"
    assert float(dataset.sweep.sel(range="2 km", grazing_angle=radian).pd_shot) == expected
    assert dataset.sweep.sel(range=["2 km", "1000 m"]).range.values.tolist() == [2.0, 1.0]
    assert dataset.sweep.sel(range=slice("1500 m", None)).range.values.tolist() == [2.0]
    assert dataset.sweep.sel(range="1.6 km", method="nearest").range.item() == 2.0


def test_a_value_that_is_not_there_is_refused_with_the_nearest(surface):
    with pytest.raises(ValueError, match="grazing_angle 23 deg is not on the grid: 20 deg is near"):
        surface.sweep.sel(grazing_angle="23 deg")
    with pytest.raises(ValueError, match="needs a unit like m, and 'deg' is none"):
        surface.sweep.sel(range="3 deg")
    with pytest.raises(ValueError, match="there is grazing_angle, range"):
        surface.sweep.sel(rnge="3 km")
    with pytest.raises(ValueError, match="method 'neerest' is unknown"):
        surface.sweep.sel(range="3 km", method="neerest")


def test_one_value_along_a_zipped_axis_keeps_the_points_that_have_it(tmp_path):
    dataset = sweep.open(run_into_store(tmp_path, POWER_AND_CUT_AXES))
    part = dataset.sweep.sel(power="3 W", grazing_angle="85 deg")
    assert part.pd_shot.dims == ("cut",)
    assert (part.grazing_angle == 85).all() and part.power.item() == 3
    assert part.sizes["cut"] == 20  # 19 ranges of the second cut, and 85 deg of the third


def test_words_are_selected_as_they_are_written(tmp_path):
    dataset = sweep.open(
        run_into_store(tmp_path, {"instrument.processing.window": ["hann", "hamming"]})
    )
    assert float(dataset.sweep.sel(window="hamming").pd_shot) == float(dataset.pd_shot[1])
    with pytest.raises(ValueError, match="there is hann, hamming"):
        dataset.sweep.sel(window="blackman")


def test_a_probability_in_closed_form_has_an_interval_without_width(surface):
    probability = surface.sweep.detection_probability()
    assert (probability.low == probability.pd).all() and (probability.high == probability.pd).all()
    assert probability.low.attrs["confidence"] == 1.0


def test_a_drawn_probability_has_its_interval_within_zero_and_one(speckled):
    probability = speckled.sweep.detection_probability("up").compute()
    reach = speckled.pd_up_half_width.compute()
    assert (reach > 0).all() and probability.low.attrs["confidence"] == 0.95
    assert probability.high.values == pytest.approx(np.minimum(probability.pd + reach, 1).values)
    assert probability.low.values == pytest.approx(np.maximum(probability.pd - reach, 0).values)


def test_a_roc_curve_is_the_model_at_each_threshold(surface):
    part = surface.sweep.sel(range="9 km", method="nearest").sweep.sel(grazing_angle="60 deg")
    tnr = np.array([3.0, 6.0, 8.0, 10.0, 13.0])
    base = spec_over_axes(SURFACE_AXES).parameters() | {
        "target.range": part.range.item(), "target.grazing_angle": np.deg2rad(60),
    }  # fmt: skip
    flags = part.effects.attrs
    simulated = [
        name
        for name, mask in zip(flags["flag_meanings"].split(), flags["flag_masks"], strict=True)
        if int(part.effects) & mask
    ]
    expected = evaluate(base | {"instrument.processing.tnr": tnr}, simulated)
    for segment in ("up", "doppler", "shot"):
        curve = part.sweep.roc(expected["pfa_bin"], segment=segment)
        assert not curve.simulated
        assert curve.curve_tnr.values == pytest.approx(tnr, rel=1e-6)
        # lines are as exact as each threshold asks for, to a tolerance of 1e-3
        assert curve.pd.values == pytest.approx(expected[f"pd_{segment}"], abs=1e-5)
    assert 0.001 < expected["pd_shot"][-1] < 0.99


def test_a_study_of_thresholds_has_the_curve_of_its_point_at_each_of_them(tmp_path, surface):
    axes = {"instrument.processing.tnr": [8, 10], "target.range": ["7 km", "9 km"]}
    store = run_into_store(tmp_path, axes)
    dataset = sweep.open(store)
    curves = dataset.sweep.roc([1e-9, 1e-6, 1e-3])
    assert curves.pd.dims == ("pfa_bin", "tnr", "range") and curves.tnr.values.tolist() == [8, 10]
    selected = surface.sweep.sel(range="9 km", grazing_angle="60 deg").sweep.roc([1e-9, 1e-6, 1e-3])
    for threshold in (8, 10):
        point = dataset.sweep.sel(tnr=threshold, range="9 km").sweep.roc([1e-9, 1e-6, 1e-3])
        assert point.curve_tnr.values == pytest.approx(selected.curve_tnr.values, rel=1e-6)
        assert curves.pd.sel(tnr=threshold, range=9).values == pytest.approx(selected.pd, abs=1e-5)
        assert point.pd.values == pytest.approx(selected.pd, abs=1e-5)
    page = CliRunner().invoke(main, ["report", str(store)], catch_exceptions=False)
    assert page.exit_code == 0


def test_the_roc_of_a_speckled_target_is_swerlings(speckled):
    # one beamlet, rough beyond the wavelength: an exponential bin power of the smooth one's mean
    point = speckled.sweep.sel(range="3 km")
    pfa = np.logspace(-14, -2, 5)
    curve = point.sweep.roc(pfa, segment="up", draws=4000)
    smooth = spec_over_axes({}, footprint={"beamlets": 1, "speckle": "none"}).parameters() | {
        "target.range": 3000.0
    }
    snr = evaluate(smooth)["snr_up"].item()
    expected = pfa ** (1 / (1 + snr))
    assert curve.simulated
    assert (np.diff(curve.pd) > 0).all()
    # five standard errors; an echo between two bins loses part of its SNR, here less than 1 dB
    lowest = pfa ** (1 / (1 + 0.79 * snr))
    allowed = 5 / 1.96 * float(curve.half_width.max())
    assert (curve.pd.values >= lowest - allowed).all()
    assert (curve.pd.values <= expected + allowed).all()
    assert float(curve.half_width.max()) < 0.02


def test_a_roc_of_too_much_or_of_nothing_is_refused(surface):
    with pytest.raises(ValueError, match="lie between 0 and 1"):
        surface.sweep.roc([0.0])
    big = surface.isel(range=np.zeros(2500, int))
    with pytest.raises(ValueError, match="22,500 points make too many curves"):
        big.sweep.roc([1e-6])


def test_false_alarms_are_counted_by_time_and_by_way(surface):
    pfa = surface.pfa_both_chirps.compute()
    assert surface.sweep.false_alarms_per_second().values == pytest.approx((pfa / PERIODS).values)
    assert surface.sweep.false_alarms_per_second("20 Hz").values == pytest.approx(20 * pfa.values)
    # 20 shots a second at 180 km/h: one every 2.5 m, 400 a kilometre
    along = surface.sweep.false_alarms_per_flight_kilometre("180 km/h", "20 Hz")
    assert along.values == pytest.approx(400 * pfa.values)
    assert along.attrs["units"] == "km-1"
    with pytest.raises(ValueError, match="the speed needs a unit like m/s"):
        surface.sweep.false_alarms_per_flight_kilometre("50 m")
    with pytest.raises(ValueError, match="positive"):
        surface.sweep.false_alarms_per_second(0)


def test_false_alarms_with_leakage_are_those_of_either_cause(surface):
    """By the chances of none: each segment is clean if neither noise nor leakage raises any."""
    ds = surface.compute()
    up = 1 - (1 - ds.pfa_segment) * (1 - ds.p_leakage_up)
    down = 1 - (1 - ds.pfa_both_chirps / ds.pfa_segment) * (1 - ds.p_leakage_down)
    alarm_rate = ds.sweep.false_alarms_per_second(1.0, leakage=True)
    assert alarm_rate.values == pytest.approx((up * down).values, rel=1e-6)
    assert (alarm_rate > ds.pfa_both_chirps).any()


def test_the_duration_of_a_chirp_may_be_an_axis(tmp_path):
    axes = {"instrument.chirp.duration": ["400 us", "500 us"]}
    dataset = sweep.open(run_into_store(tmp_path, axes))
    rates = dataset.sweep.false_alarms_per_second() / dataset.pfa_both_chirps
    assert rates.values == pytest.approx([1 / 1.2e-3, 1 / 1.5e-3])


def test_a_contour_of_a_plane_is_a_straight_line():
    x, y = np.linspace(1000, 2000, 6), np.linspace(10, 80, 8)
    level = 0.7
    dataset = dataset_of_deviates(
        (1800 - x[:, None]) / 300 + (y - 40) / 20, range=x, grazing_angle=y
    )
    line = dataset.sweep.contour(level)
    from scipy.special import ndtri

    z = (1800 - line.range) / 300 + (line.grazing_angle - 40) / 20
    assert z.values == pytest.approx(ndtri(level), abs=1e-9)
    assert set(line.line.values) == {0} and line.sizes["vertex"] > 5
    assert dataset.sweep.contour(1 - 1e-12).sizes["vertex"] == 0
    with pytest.raises(ValueError, match="select one value along power"):
        dataset.expand_dims(power=[1, 2]).sweep.contour()


def test_the_summary_is_that_of_the_computed_points(surface):
    holed = surface.copy()
    holed["snr_up"] = surface.snr_up.where(surface.range > 3000)
    summary = holed.sweep.summary()
    assert all(a.chunks is not None for a in summary.data_vars.values())
    values = holed.snr_up.values[np.isfinite(holed.snr_up.values)]
    expected = [values.mean(), values.min(), values.max(), values.size]
    assert summary.snr_up.values == pytest.approx(expected)
    assert 0 < values.size < surface.snr_up.size


def test_the_summary_of_a_single_point_is_that_point():
    assert xr.Dataset({"v": 0.25}).sweep.summary().v.values.tolist() == [0.25, 0.25, 0.25, 1.0]


def test_studies_are_compared_where_they_meet_whatever_their_units_and_order(tmp_path):
    (tmp_path / "a").mkdir()
    one = {"target.range": ["1 km", "2 km", "9 km"], "target.grazing_angle": ["30 deg", "60 deg"]}
    two = {
        "instrument.laser.power": ["3 W", "1 W"],
        "target.grazing_angle": [f"{float(np.deg2rad(60))!r} rad"],
        "target.range": ["9000 m", "3000 m", "1000 m"],
    }
    dataset, other = (
        sweep.open(run_into_store(tmp_path, one)),
        sweep.open(run_into_store(tmp_path / "a", two)),
    )
    comparison = dataset.sweep.compare(other).compute()
    assert dict(comparison.sizes) == {"range": 2, "grazing_angle": 1}
    assert comparison.range.values.tolist() == [1.0, 9.0]
    # the same 1 W; what effects are left out may differ, as each is planned for other neighbours
    assert np.abs(comparison.pd_shot).max() < 1e-6
    assert comparison.pd_shot_agrees.all()
    stronger = dataset.sweep.compare(other.sweep.sel(power="3 W")).compute()
    assert (stronger.snr_up > 0).all() and not stronger.pd_shot_agrees.all()
    expected = float(other.sweep.sel(power="3 W", range="9 km").snr_up.squeeze()) - float(
        dataset.sweep.sel(range="9 km", grazing_angle="60 deg").snr_up
    )
    assert stronger.snr_up.sel(range=9.0).squeeze().item() == pytest.approx(expected)


def test_studies_without_a_point_in_common_are_refused(surface, tmp_path):
    other = sweep.open(run_into_store(tmp_path, {"target.range": ["11 km", "12 km"]}))
    with pytest.raises(ValueError, match="along range the two studies have no value in common"):
        surface.sweep.compare(other)


def test_other_draws_agree_within_their_intervals_and_another_laser_does_not(speckled, tmp_path):
    spec = json.loads(speckled.attrs["spec"])
    sections = {name: spec[name] for name in ("target", "draws", "footprint")}
    axes = {"target.range": ["500 m", "3 km", "6 km"]}
    redrawn = sweep.open(run_into_store(tmp_path, axes, seed=6, **sections))
    comparison = speckled.sweep.compare(redrawn).compute()
    assert (comparison.pd_up != 0).all() and comparison.pd_up_agrees.all()
    allowed = (speckled.pd_up_half_width + redrawn.pd_up_half_width).values
    assert (comparison.pd_up_allowed.values >= allowed).all()
    (tmp_path / "weak").mkdir()
    instrument = spec["instrument"] | {"laser": spec["instrument"]["laser"] | {"power": "0.2 W"}}
    weak = run_into_store(tmp_path / "weak", axes, seed=6, instrument=instrument, **sections)
    assert not speckled.sweep.compare(sweep.open(weak)).pd_up_agrees.all()


def test_a_dataset_that_is_none_of_sweeps_says_so():
    with pytest.raises(ValueError, match="lacks the coordinate 'study_id'"):
        _ = xr.Dataset().sweep.spec


def lone_tone_bound(distance, noise_variance):
    """Bounds from the link budget of Table 4.1 by hand: no window, no bins.

    Samples from 0 on, of which those before the echo's delay hold noise alone.
    """
    echo = np.pi * (25e-3 / 2) ** 2 * 0.1 / (2 * np.pi * distance**2)
    size, rate, slope, speed = 2**17, 600e6, 1e9 / 500e-6, 299_792_458.0
    carrier = speed / 1550e-9
    size -= int(np.ceil(2 * distance / speed * rate))
    beats = []
    for sign, start in ((1, carrier), (0, carrier), (-1, carrier + 1e9)):
        beat = 2 * 150 / speed * start - sign * slope * 2 * distance / speed
        gain = 7e3 / (1 + (beat / 400e6) ** 2)  # two poles, detector's and amplifier's
        amplitude = 2 * 1.1 * np.sqrt(1e-3 * echo) * gain
        cnr = amplitude**2 / (2 * noise_variance)
        beats.append(
            estimators.beat_frequency_cramer_rao_bound(cnr=cnr, n_samples=size, sample_rate=rate)
        )
    return estimators.range_velocity_deviation(
        up=beats[0], doppler=beats[1], down=beats[2], carriers=(carrier, carrier, carrier + 1e9),
        chirp_rate=slope, range=distance, radial_velocity=150.0,
    )  # fmt: skip


def test_errors_stand_next_to_the_bound_that_the_link_budget_gives(tmp_path):
    windows = {"instrument.processing.window": ["hann", "hamming"]}
    axes = {"target.range": ["1003 m", "4001 m"], **windows}
    target = spec_over_axes({}).to_yaml_mapping()["target"] | {"grazing_angle": "90 deg"}
    dataset = sweep.open(
        run_into_store(tmp_path, axes, footprint={"beamlets": 1, "speckle": "none"}, target=target)
    )
    place, speed = dataset.sweep.range_error(), dataset.sweep.velocity_error()
    assert place.bound.chunks is not None
    for i, distance in enumerate((1003.0, 4001.0)):
        bound = lone_tone_bound(distance, float(dataset.noise_variance[i, 0]))
        # whatever the window, and wherever in its bin the beat falls
        assert place.bound[i].values == pytest.approx(float(bound.range), rel=1e-3)
        assert speed.bound[i].values == pytest.approx(float(bound.radial_velocity), rel=1e-3)
    # half a sum of two whole bins of 4577.6 Hz, each off by that over the root of 12
    width = 299_792_458 / 2 * 500e-6 / 1e9 * 600e6 / 2**17
    stretch = 1 + 2 * 150 / 299_792_458  # of the beat, by the target's motion
    assert place.resolution.values == pytest.approx(width / np.sqrt(24) / stretch, rel=1e-9)
    assert (abs(place.reported) <= width).all() and place.bound.attrs["units"] == "m"
    assert speed.bound.attrs["units"] == "m s-1"


@pytest.mark.parametrize(
    ("changes", "velocity_max"),
    [
        ({}, 1.0),
        ({"receiver": {"architecture": "direct"}}, 2e4),
        ({"chirp": {"down_slope": -0.6}}, 1.0),
    ],
    ids=["homodyne", "direct", "unequal slopes"],
)
def test_whole_bins_spread_errors_as_the_resolution_says(tmp_path, changes, velocity_max):
    """Errors without noise, over ranges and velocities that put both peaks anywhere in their bins.

    They are 1,600 pairs of nearly uniform errors, whose standard deviation is known to 2 %. A fit
    to three peaks gives less weight to low ones, which lie farthest from their bins.
    """
    generator = np.random.default_rng(5)
    ranges, velocities = (
        np.sort(generator.uniform(low, high, 40)) for low, high in ((140, 156), (0, velocity_max))
    )
    axes = {
        "target.range": [f"{r} m" for r in ranges],
        "target.radial_velocity": [f"{v} m/s" for v in velocities],
    }
    sections = {name: INSTRUMENT[name] | section for name, section in changes.items()}
    dataset = sweep.open(
        run_into_store(
            tmp_path,
            axes,
            footprint={"beamlets": 1, "speckle": "none"},
            target={"grazing_angle": "90 deg", "reflectance": 0.1},
            instrument=INSTRUMENT | sections,
            effects=dict.fromkeys(("segment_motion", "range_walk", "overlap"), "off"),
        )
    )
    for errors in (dataset.sweep.range_error(), dataset.sweep.velocity_error()):
        assert float(errors.reported.std()) == pytest.approx(
            float(errors.resolution.mean()), rel=0.1 if "chirp" in changes else 0.04
        )


def test_a_study_of_whole_spectra_answers_with_what_it_counted(tmp_path):
    small = INSTRUMENT | {"processing": INSTRUMENT["processing"] | {"fft_size": 2048}}
    axes = {"target.range": ["20 m", "60 m"]}
    dataset = sweep.open(
        run_into_store(tmp_path, axes, instrument=small, draws={"method": "spectra", "number": 40})
    ).compute()
    range_error = dataset.sweep.range_error()
    assert set(range_error.data_vars) == {"bias", "rmse", "bound"}
    assert range_error.bound.equals(dataset.range_bound)
    rate = dataset.sweep.false_alarms_per_second("20 Hz").values
    assert rate == pytest.approx(20 * dataset.false_alarms.values)
    assert dataset.sweep.compare(dataset).pd_shot_agrees.all()
    assert "range_rmse" in dataset.sweep.compare(dataset)
    with pytest.raises(ValueError, match="has no closed form"):
        dataset.sweep.roc()


@pytest.mark.parametrize("far", ["1000 km", "1 m", "9.0001 km", float("nan")])
def test_the_nearest_value_is_not_taken_from_outside_the_grid(surface, far):
    """1,000 km of a grid to 9 km used to be 9 km."""
    with pytest.raises(ValueError, match="lies outside the grid, which reaches from 10 to 9000 m"):
        surface.sweep.sel(range=far, method="nearest")
    assert surface.sweep.sel(range="9 km", method="nearest").range.item() == 9000
