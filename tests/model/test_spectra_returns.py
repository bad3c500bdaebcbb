"""Detectors and estimators in flights: what grids have of a shot, and of several surfaces."""

import numpy as np
import pytest
from shot_helpers import make_point_keys, parametrize_product
from small_scenes import level_plate, observe_shots, scene_parameters, straight_flight

from sweep.model.detection.estimators import DETECTOR_PREFIX, ESTIMATOR_PREFIX
from sweep.model.evaluation import evaluate
from sweep.model.geometry.mesh import SurfaceMaterial
from sweep.model.pointcloud.pairing import (
    FALSE_ALARM_FLAG,
    MISREAD_FLAG,
    TRUE_RETURN_FLAG,
    UNCONFIRMED_FLAG,
)
from sweep.model.pointcloud.point_cloud import simulate_cloud
from sweep.model.sampling.noisy_spectra import SpectrumMethods
from sweep.model.sampling.samplers import simulate_draws
from sweep.model.waveform import REPORTED_PEAKS_PATH, STRONGEST_PEAK

EFFECTS = ("footprint", "doppler")
RECORD = "instrument.receiver.record"
HEIGHT, CLOSING = 412.0, 20.0
NUMBER = 400
"""5 sigma of a root mean square are 5 / sqrt(2 * 400) = 18 %: a factor of sqrt 2 shows."""
TARGET = {
    "target.range": np.array([HEIGHT]), "target.radial_velocity": CLOSING,
    "target.grazing_angle": np.pi / 2, "target.reflectance": 0.1,
    "target.reflectance_law": "lambert",
}  # fmt: skip


def _given(table_4_1, tnr=10.0, power=1.6e-3, **methods):
    parameters = scene_parameters(
        table_4_1, fft_size=2**11, power=power, tnr=tnr, beamlets=7, detection="any_bin",
        noise_bins="correlated",
    )  # fmt: skip
    return parameters | methods


def _flown(parameters, *, first=1000, draws=NUMBER, bodies=None, x=0.0, **arguments):
    arguments = {"effects": EFFECTS} | arguments
    path = straight_flight(position=(x, 0.0, HEIGHT), velocity=(0.0, 0.0, -CLOSING))
    shot_eyepoints = observe_shots(path, bodies=bodies, number=7)
    return simulate_cloud(
        shot_eyepoints,
        parameters=parameters,
        surfaces=[SurfaceMaterial("ground", 0.1), SurfaceMaterial("table", 0.1)],
        keys=make_point_keys(1),
        first_draw=first,
        draws=draws,
        method="spectra",
        **arguments,
    )


def _grid(parameters, methods=None):
    """A flat target of the same range, velocity and reflectance, with other draws."""
    return simulate_draws(
        parameters | TARGET,
        EFFECTS,
        keys=make_point_keys(1),
        batch_sizes=[NUMBER],
        method="spectra",
        **({} if methods is None else {"methods": methods}),
    )


@pytest.mark.parametrize(
    "way",
    parametrize_product(2, [
        ("jacobsen", "complex"), ("peak_bin", "real"), ("maximum_likelihood", "real"),
        ("jacobsen", "real"), ("centroid", "real"),
    ]),
)  # fmt: skip
def test_an_estimators_bias_and_scatter_are_those_of_a_grid(table_4_1, way):
    """The same shot, seen in other draws: 5 sigma of means and of root mean squares."""
    kind, record = way
    changes = {ESTIMATOR_PREFIX + "kind": kind, RECORD: record}
    parameters = _given(table_4_1, power=1.0, **changes)
    cloud, grid = _flown(parameters), _grid(parameters)
    assert cloud["snr_up"][0] == pytest.approx(grid["snr_up"][0], rel=1e-9)
    for name in ("range", "radial_velocity"):
        error = (cloud[f"{name}_interpolated"] - cloud[f"true_{name}"])[0, :, 0]
        assert np.isfinite(error).all() and (cloud["flags"][0, :, 0] == TRUE_RETURN_FLAG).all()
        bias, rmse = grid[f"{name}_bias"][0], grid[f"{name}_rmse"][0]
        scatter = np.sqrt(max(rmse**2 - bias**2, 0.0))
        allowed = 5 * scatter * np.sqrt(2 / NUMBER)
        assert error.mean() == pytest.approx(bias, abs=allowed + 1e-6)
        assert error.std() == pytest.approx(scatter, rel=5 / np.sqrt(NUMBER), abs=1e-6)


@pytest.mark.parametrize(
    "way",
    parametrize_product(2, [
        ("fixed", "real"), ("ca_cfar", "real"), ("ca_cfar", "complex"), ("os_cfar", "real"),
        ("goca_cfar", "real"), ("fixed", "complex"),
    ]),
)  # fmt: skip
def test_a_detector_detects_as_often_as_in_a_grid(table_4_1, way):
    kind, record = way
    chosen = {DETECTOR_PREFIX + "kind": kind, DETECTOR_PREFIX + "pfa": 1e-4, RECORD: record}
    parameters = _given(table_4_1, tnr=6.0, power=1e-2, **chosen)
    cloud, grid = _flown(parameters), _grid(parameters)
    detected_share = (
        np.isin(cloud["flags"], (TRUE_RETURN_FLAG, TRUE_RETURN_FLAG | UNCONFIRMED_FLAG))
        .any(axis=2)
        .mean()
    )
    pd = grid["pd_shot"][0]
    assert 0.1 < pd < 0.95
    assert detected_share == pytest.approx(pd, abs=5 * np.sqrt(2 * pd * (1 - pd) / NUMBER))
    # Closed forms know the fixed threshold alone.
    assert np.isfinite(cloud["pd_shot"]).all() == (kind == "fixed")
    if kind == "fixed":
        assert cloud["pd_shot"][0] == pytest.approx(pd, abs=5 * np.sqrt(pd * (1 - pd) / NUMBER))


@pytest.mark.parametrize("record", [pytest.param("real", marks=pytest.mark.slow), "complex"])
def test_the_strongest_peak_is_as_often_wrong_as_the_closed_form_of_a_grid_says(table_4_1, record):
    """A return of both right peaks may be misread for want of a Doppler peak."""
    changes = {REPORTED_PEAKS_PATH: STRONGEST_PEAK, RECORD: record}
    parameters = _given(table_4_1, tnr=3.0, power=1e-2, **changes)
    cloud = _flown(parameters, draws=2000)
    grid = evaluate(parameters | TARGET, EFFECTS)
    flags = cloud["flags"][0]
    assert not flags[:, 1:].any()  # a shot has one return
    right = ((flags[:, 0] & (TRUE_RETURN_FLAG | MISREAD_FLAG)) > 0).mean()
    pd, wrong = grid["pd_shot"][0], grid["p_wrong_range_shot"][0]
    assert 0.2 < pd < 0.8 and wrong > 0.05
    for share, expected in ((right, pd), ((flags[:, 0] > 0).mean() - right, wrong)):
        assert share == pytest.approx(
            expected, abs=0.006 + 5 * np.sqrt(expected * (1 - expected) / 2000)
        )
    assert np.isnan(cloud["pd_shot"]).all()


def test_functions_of_ones_own_see_every_draw_alone(table_4_1):
    """A detector that flags one bin off the echo, and an estimator that says so."""

    def first_module_method(power, setting):
        return np.arange(power.shape[1])[None] == 300

    def second_module_method(spectrum, peak, setting):
        assert spectrum.shape == (1, setting.fft_size // 2 + 1) and (peak == 300).all()
        return peak + 0.25

    methods = SpectrumMethods(
        {"mine:here": first_module_method}, {"mine:there": second_module_method}
    )
    chosen = {DETECTOR_PREFIX + "kind": "mine:here", ESTIMATOR_PREFIX + "kind": "mine:there"}
    cloud = _flown(_given(table_4_1, **chosen), draws=3, methods=methods)
    assert (cloud["flags"][0, :, 0] & FALSE_ALARM_FLAG).all() and not cloud["flags"][0, :, 1:].any()
    # Up and down beat alike: no range, and a velocity of 300.25 bins; or the reverse.
    bins = 299792458.0 * 600e6 / (4 * 2**11 * 2e12), 1550e-9 * 600e6 / 2**12
    far, closing = (
        np.abs(cloud[f"{n}_interpolated"][0, :, 0]) for n in ("range", "radial_velocity")
    )
    read = far / bins[0] + closing / bins[1]
    np.testing.assert_allclose(read, 300.25, rtol=1e-3)


def test_both_surfaces_of_a_footprint_are_seen_and_fade_each_for_itself(table_4_1):
    """Both are seen as often as by chance, and their strengths are not correlated; 5 sigma."""
    bodies = [level_plate(x=(-1e3, 30.0)), level_plate(x=(0.0, 30.0), surface=1, height=120.0)]
    changes = {ESTIMATOR_PREFIX + "kind": "candan", "footprint.speckle": "developed"}
    parameters = _given(table_4_1, power=0.3, **changes)
    effects = (*EFFECTS, "several_returns", "fading")
    cloud = _flown(parameters, bodies=bodies, x=1e-4, effects=effects, draws=2000)
    is_surface_seen = [(cloud["surface"] == number).any(axis=2)[0] for number in (0, 1)]
    one, other = (is_seen.mean() for is_seen in is_surface_seen)
    allowed = 5 * np.sqrt(one * other * (1 - one * other) / 2000)
    assert (is_surface_seen[0] & is_surface_seen[1]).mean() == pytest.approx(
        one * other, abs=allowed
    )
    both_seen = is_surface_seen[0] & is_surface_seen[1]
    snr = [
        np.where(cloud["surface"][0] == k, cloud["snr"][0], 0.0).max(axis=1)[both_seen]
        for k in (0, 1)
    ]
    # One fading of both would have them rise and fall as one.
    assert abs(np.corrcoef(*snr)[0, 1]) < 5 / np.sqrt(both_seen.sum()) < 0.2
    true = cloud["flags"] == TRUE_RETURN_FLAG
    errors = np.abs(cloud["range_interpolated"] - cloud["true_range"])[true]
    assert np.median(errors) < 0.5 * 299792458.0 * 600e6 / (4 * 2**11 * 2e12)


def test_any_split_of_draws_gives_the_same_bytes(table_4_1):
    parameters = _given(table_4_1, **{ESTIMATOR_PREFIX + "kind": "chirp_z"})
    at_once = _flown(parameters, draws=6)
    part = _flown(parameters, first=1002, draws=3)
    for name, values in part.items():
        expected = at_once[name][:, 2:5] if values.ndim > 1 else at_once[name]
        np.testing.assert_array_equal(values, expected, err_msg=name)
