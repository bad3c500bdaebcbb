"""Point clouds: their truth, the chances of points and dropouts, independence of batches."""

import numpy as np
import pytest
from shot_helpers import DRAWS, is_within_5_sigma
from small_scenes import level_plate, observe_shots, scene_parameters, straight_flight

from sweep.model import beam
from sweep.model.effects.catalogue import (
    DEFAULT_EFFECTS,
    EFFECT_NAMES,
    EFFECTS,
    PARAMETER_DEFAULTS,
    effect_names_in_flags,
    pack_effect_flags,
)
from sweep.model.effects.scintillation import turbulence_profile, two_way_log_variances
from sweep.model.evaluation import evaluate
from sweep.model.geometry.mesh import SurfaceMaterial
from sweep.model.geometry.scanner import LineScan, PointingJitter, cone_directions
from sweep.model.outputs import POINT_CLOUD_VARIABLES, SHOT_STATISTIC_VARIABLES
from sweep.model.pointcloud import point_cloud
from sweep.model.pointcloud.bin_groups import list_bin_groups
from sweep.model.pointcloud.eyepoints import Eyepoints, prepare_eyepoint_shots
from sweep.model.pointcloud.pairing import (
    FALSE_ALARM_FLAG,
    MISPAIRED_FLAG,
    MISREAD_FLAG,
    SIDELOBE_FLAG,
    TRUE_RETURN_FLAG,
    UNCONFIRMED_FLAG,
)
from sweep.model.pointcloud.point_cloud import simulate_cloud
from sweep.model.sampling import philox

METHODS = pytest.mark.parametrize("method", ["probabilities", "noise"])
RANGE_BIN, VELOCITY_BIN = 299792458.0 * 600e6 / (4e12 * 2**16), 1550e-9 * 600e6 / 2**17
GROUND, TABLE = SurfaceMaterial("ground", 0.1), SurfaceMaterial("table", 0.08)
TABLE_HEIGHT, HEIGHT = 12.0, 412.0


def _keys(index, seed=5):
    return philox.point_keys(np.asarray(index, float)[:, None], domain="clouds", seed=seed)


def _edge(places, *, lift=0.0, velocity=(0.0, 0.0, -20.0)):
    """Nadir shots at places x [m] over ground to x = 30 m and a table, which may rise, from 0."""
    bodies = [
        level_plate(x=(-1e3, 30.0)),
        level_plate(x=(0.0, 30.0), surface=1, height=TABLE_HEIGHT),
    ]
    eyepoint_list = [
        observe_shots(
            straight_flight(position=(x, 0.0, HEIGHT), velocity=velocity),
            bodies=bodies,
            body_motion=[
                None,
                straight_flight(position=(0.0, 0.0, 0.0), velocity=(0.0, 0.0, lift)),
            ],
        )
        for x in places
    ]
    fields = [
        np.concatenate(values) for values in zip(*(s[:-1] for s in eyepoint_list), strict=True)
    ]
    return Eyepoints._make([*fields, eyepoint_list[0].weight])


def _cloud(shot_eyepoints, parameters, **keywords):
    keys = keywords.pop("keys", _keys(np.arange(len(shot_eyepoints.time))))
    return simulate_cloud(
        shot_eyepoints, parameters=parameters, surfaces=[GROUND, TABLE], keys=keys, **keywords
    )


def _strong(table_4_1, **changes):
    return scene_parameters(table_4_1, **({"fft_size": 2**16} | changes))


def _weak(table_4_1, tnr, power=1.6e-3):
    """Light that leaves pd between 0 and 1, and a threshold in so many deviations of noise."""
    return scene_parameters(table_4_1, fft_size=2**16, power=power, tnr=tnr)


KIND = TRUE_RETURN_FLAG | FALSE_ALARM_FLAG | MISPAIRED_FLAG | MISREAD_FLAG | SIDELOBE_FLAG
ON_GROUND, ON_TABLE, BOTH, BLIND = -1.0, 1.0, 1e-4, 60.0


# Without chance


def test_arrays_are_those_of_the_table(table_4_1):
    cloud = _cloud(_edge([ON_GROUND, BLIND]), _strong(table_4_1), draws=3, returns_max=2)
    sizes = {"shot": 2, "draw": 3, "return_number": 2, "xyz": 3}
    assert cloud.keys() == SHOT_STATISTIC_VARIABLES.keys() | POINT_CLOUD_VARIABLES.keys()
    for name, output in (SHOT_STATISTIC_VARIABLES | POINT_CLOUD_VARIABLES).items():
        assert cloud[name].dtype == output.dtype, name
        assert cloud[name].shape == tuple(sizes[d] for d in output.dims), name


@METHODS
def test_each_surface_in_a_footprint_gives_its_point(table_4_1, method):
    """The table rises by 5 m/s: a range and a velocity of its own, half a bin off at the most."""
    shot_eyepoints = _edge([ON_GROUND, BOTH, ON_TABLE], lift=5.0)
    cloud = _cloud(shot_eyepoints, _strong(table_4_1), draws=20, method=method)
    np.testing.assert_array_equal(cloud["surfaces_seen"], [1, 2, 1])
    truth = {0: (HEIGHT, 20.0), 1: (HEIGHT - TABLE_HEIGHT, 25.0)}
    for shot, expected in ((0, {0}), (1, {0, 1}), (2, {1})):
        is_point = cloud["flags"][shot] > 0
        assert (is_point.sum(axis=1) == len(expected)).all()
        assert (cloud["flags"][shot][is_point] == TRUE_RETURN_FLAG).all()
        surface = cloud["surface"][shot]
        assert all(set(row[row >= 0]) == expected for row in surface)
        for number in expected:
            on_surface, (far, closing) = surface == number, truth[number]
            names = "true_range", "range_interpolated", "range"
            for name, bins in zip(names, (1e-6, 0.2, 1.2), strict=True):
                np.testing.assert_allclose(
                    cloud[name][shot][on_surface], far, atol=bins * RANGE_BIN
                )
            names = "true_radial_velocity", "radial_velocity_interpolated", "radial_velocity"
            for name, bins in zip(names, (0.1, 0.3, 1.2), strict=True):
                np.testing.assert_allclose(
                    cloud[name][shot][on_surface], closing, atol=bins * VELOCITY_BIN
                )


@METHODS
def test_without_the_platforms_motion_a_target_at_rest_stands_still(table_4_1, method):
    """An oblique flight: what is left is the table's own 5 m/s, and 0 for the ground."""
    shot_eyepoints = _edge([ON_GROUND, ON_TABLE], lift=5.0, velocity=(70.0, -30.0, -20.0))
    cloud = _cloud(
        shot_eyepoints, _strong(table_4_1, power=1e-2), draws=DRAWS, method=method, returns_max=1
    )
    left, stated_error = (
        cloud[f"radial_velocity_{name}"][..., 0]
        for name in ("compensated", "interpolated_standard_error")
    )
    assert np.isfinite(left).all()
    error = left - [[0.0], [5.0]]
    assert np.abs(error.mean(axis=1)).max() < 0.02 * VELOCITY_BIN
    # What is stated counts the spread of the footprint's lines, which all draws share, as well.
    spread = error.std(axis=1) / stated_error.mean(axis=1)
    assert (spread > 0.9).all() and (spread < 1 + 5 / np.sqrt(2 * DRAWS)).all()


@pytest.mark.parametrize("phases", ["coherent", "incoherent"])
def test_shots_that_are_computed_together_are_as_alone_whatever_effects_each_has(table_4_1, phases):
    """Bit for bit, all combinations of effects that shots are not kept apart for."""
    free = [k for k, effect in enumerate(EFFECTS) if not effect.needs_separate_batches]
    assert {EFFECT_NAMES[k] for k in free} == {
        "several_returns", "doppler_spread", "signal_shot_noise", "solar_background",
    }  # fmt: skip
    every = pack_effect_flags(np.array([[name in DEFAULT_EFFECTS] for name in EFFECT_NAMES]))[0]
    effect_masks = [sum(1 << free[i] for i in range(4) if n >> i & 1) for n in range(16)]
    flags = np.array([int(every) & ~bits for bits in effect_masks], np.uint32)
    shot_eyepoints = _edge([BOTH] * 16, lift=5.0, velocity=(3.0, 0.0, -20.0))
    parameters = _strong(table_4_1, power=1e-2, phases=phases)
    parameters["target.solar_irradiance"] = 1e9
    cloud = _cloud(shot_eyepoints, parameters, effects=DEFAULT_EFFECTS, effect_flags=flags, draws=3)
    for shot in range(16):
        shot_effects = effect_names_in_flags(int(flags[shot]))
        key, one = _keys([shot]), np.array([shot])
        single = _cloud(
            shot_eyepoints.select(one), parameters, effects=shot_effects, draws=3, keys=key
        )
        for name, values in single.items():
            np.testing.assert_array_equal(
                cloud[name][shot], values[0], err_msg=f"{name} {shot_effects}"
            )
    for i in range(4):  # each of them makes a difference
        other = 1 << i
        differs = [
            name
            for name in SHOT_STATISTIC_VARIABLES
            if (cloud[name][0] != cloud[name][other]).any()
        ]
        assert differs, EFFECT_NAMES[free[i]]


def test_points_lie_along_the_beam_as_commanded(table_4_1):
    shot_eyepoints = observe_shots(
        straight_flight(),
        beams=cone_directions(4, half_angle=0.4),
        index=np.arange(8),
        jitter=PointingJitter(1e-3, 1),
    )
    cloud = _cloud(shot_eyepoints, _strong(table_4_1))
    offset = cloud["position"][:, 0, 0] - shot_eyepoints.position
    np.testing.assert_allclose(
        offset, cloud["range_interpolated"][:, 0, :1] * shot_eyepoints.direction, rtol=1e-12
    )
    assert np.isnan(cloud["position"][:, 0, 1:]).all()
    assert np.abs(cloud["position"][:, 0, 0, 2]).max() > 0.1


def test_two_laws_in_one_footprint_scatter_each_their_own(table_4_1):
    """Equal parts of a tilted beam on two plates at one height: the powers' ratio is cos(i)."""
    bodies = [level_plate(y=(-1e4, 0.0)), level_plate(y=(0.0, 1e4), surface=1)]
    beams = cone_directions(1, half_angle=np.radians(60.0))
    shot_eyepoints = observe_shots(straight_flight(), bodies=bodies, beams=beams)
    shots = prepare_eyepoint_shots(
        shot_eyepoints,
        _strong(table_4_1),
        [SurfaceMaterial("a", 0.1, "lommel_seeliger"), SurfaceMaterial("b", 0.1)],
    )
    power = (
        shots.footprint.relative_amplitude[0] ** 2
        / shot_eyepoints.weight
        * (1 + shots.footprint.relative_range_offset[0]) ** 2
    )
    first, second = (power[shot_eyepoints.surface[0] == s] for s in (0, 1))
    assert min(first.size, second.size) > 5
    np.testing.assert_allclose(first, 0.1 / np.pi, rtol=1e-12)
    np.testing.assert_allclose(second, 0.05 / np.pi, rtol=1e-3)


# Chance


@METHODS
def test_a_shot_that_sees_nothing_has_the_false_alarms_of_noise_alone(table_4_1, method):
    """A point wants a false peak in the up and in the down-chirp, of N/2 bins each."""
    eyepoints = _edge([BLIND] * 4)
    cloud = _cloud(eyepoints, _strong(table_4_1, tnr=7.4), draws=DRAWS, method=method)
    one = np.exp(-(4 - np.pi) / 4 * 7.4**2)
    chance = 1 - (1 - one) ** 2**15
    assert 0.1 < chance < 0.5
    known = {"surfaces_seen": 0, "beamlets": eyepoints.weight.size}
    for name in SHOT_STATISTIC_VARIABLES:
        if name.startswith("pfa"):
            np.testing.assert_allclose(cloud[name], chance, rtol=1e-9)
        else:
            np.testing.assert_array_equal(cloud[name], known.get(name, np.nan))
    assert (cloud["flags"][:, :, 1:] == 0).all()
    is_point = cloud["flags"][:, :, 0] > 0
    assert (cloud["flags"][:, :, 0][is_point] & KIND == FALSE_ALARM_FLAG).all()
    assert is_within_5_sigma(is_point.sum(axis=1), chance**2).all()
    assert (cloud["surface"] == -1).all()
    for name in ("true_range", "true_radial_velocity", "pd"):
        assert np.isnan(cloud[name]).all(), name
    assert np.isfinite(cloud["position"][:, :, 0][is_point]).all()


@METHODS
def test_dropouts_of_two_surfaces_have_their_probabilities(table_4_1, method):
    """Each has a point when its up and its down peak are found, and the shared Doppler peak.

    Without that, pairs go by strength; those draws are few and stand as slack.
    """
    shot_eyepoints, parameters = _edge([BOTH, -BOTH]), _weak(table_4_1, 10.0, power=2.3e-3)
    cloud = _cloud(shot_eyepoints, parameters, draws=DRAWS, method=method)
    groups = list_bin_groups(prepare_eyepoint_shots(shot_eyepoints, parameters, [GROUND, TABLE]))
    slack = DRAWS * (1 - cloud["pd_doppler"] + 1e-4)
    assert (slack < 0.002 * DRAWS).all()
    np.testing.assert_array_equal(cloud["surfaces_seen"], 2)
    joint_pd = groups.pd[:, 0, :2] * groups.pd[:, 2, :2]
    assert ((joint_pd > 0.05) & (joint_pd < 0.999)).all()
    np.testing.assert_array_equal(joint_pd[:, 0], cloud["pd_shot"])
    right = (cloud["flags"] & (TRUE_RETURN_FLAG | MISREAD_FLAG)) > 0
    counts = np.array([(right & (cloud["surface"] == s)).any(axis=2).sum(axis=1) for s in (0, 1)])
    # which is the stronger differs between the shots: the ground in one, the table in the other
    stronger = counts.argmax(axis=0)
    assert set(stronger) == {0, 1}
    for place, surface in ((0, stronger), (1, 1 - stronger)):
        assert is_within_5_sigma(counts[surface, [0, 1]], joint_pd[:, place], slack).all()


@METHODS
@pytest.mark.parametrize("place", [ON_GROUND, BOTH])
def test_points_are_as_many_as_peaks_and_false_alarms_make_them(table_4_1, method, place):
    """Peaks pair one to one: k points or more where up and down have k peaks or more.

    Peaks are independent chances, of groups pd and of one false peak pfa, so the numbers of both
    lists are sums of such chances, whatever pairs with what.
    """
    power = {ON_GROUND: 6e-4, BOTH: 1.6e-3}[place]
    shot_eyepoints, parameters = _edge([place]), _weak(table_4_1, 7.6, power=power)
    cloud = _cloud(shot_eyepoints, parameters, draws=DRAWS, method=method)
    groups = list_bin_groups(prepare_eyepoint_shots(shot_eyepoints, parameters, [GROUND, TABLE]))
    pfa = cloud["pfa_up"][0], cloud["pfa_down"][0]
    assert all(0.03 < chance < 0.5 for chance in pfa)
    tails = []
    for segment, alarm in zip((0, 2), pfa, strict=True):
        number = np.ones(1)
        for chance in (*groups.pd[0, segment][groups.strongest_bin[0, segment] >= 0], alarm):
            number = np.convolve(number, [1 - chance, chance])
        tails.append(np.cumsum(number[::-1])[::-1])
    points = (cloud["flags"][0] > 0).sum(axis=1)
    expected = tails[0] * tails[1]
    for k in range(1, min(4, len(expected)) + 1):
        assert is_within_5_sigma((points >= k).sum(), expected[k] if k < len(expected) else 0.0)
    assert expected[2] > 0.01
    if place == ON_GROUND:
        # what is neither the true pair nor missing holds a false peak; a false peak takes a true
        # one from its partner by chance, once in some 300
        mean = expected[1:].sum()
        false = (cloud["flags"][0] & FALSE_ALARM_FLAG > 0).sum()
        slack = DRAWS * pfa[0] / 300
        assert abs(false - DRAWS * (mean - cloud["pd_shot"][0])) < 5 * np.sqrt(DRAWS * mean) + slack


@METHODS
def test_leaked_signal_raises_the_false_alarms_stated(table_4_1, method):
    """A rectangular window; both true peaks are always there, so a second point is a false one."""
    parameters = _strong(
        table_4_1, window="rectangular", power=3.0, fft_size=2**12, leakage_floor=2.0
    )
    shot_eyepoints, spectra = _edge([ON_GROUND, ON_TABLE]), 3000
    drawn_cloud = _cloud(shot_eyepoints, parameters, draws=DRAWS, method=method)
    np.testing.assert_allclose(drawn_cloud["pd_shot"], 1.0, rtol=1e-12)
    chance = drawn_cloud["pfa_up"] * drawn_cloud["pfa_down"]
    assert ((chance > 0.01) & (chance < 0.1)).all()
    cloud = _cloud(shot_eyepoints, parameters, draws=spectra, method="spectra")
    for points, draws in ((drawn_cloud, DRAWS), (cloud, spectra)):
        second = (points["flags"][:, :, 1] & FALSE_ALARM_FLAG) > 0
        deviation = np.sqrt(chance * (1 - chance) / draws)
        leaked_share = second.mean(axis=1)
        assert (abs(leaked_share - chance) < 5 * deviation).all(), (leaked_share, chance)
    target = table_4_1(range=HEIGHT, radial_velocity=20.0, reflectance_law="lambert")
    plane = evaluate(target | parameters)
    expected = 1 - (1 - plane["pfa_segment"]) * (1 - plane["p_leakage_up"])
    np.testing.assert_allclose(drawn_cloud["pfa_up"][0], expected, rtol=1e-3)


@METHODS
def test_flags_tell_what_a_point_is(table_4_1, method):
    shot_eyepoints = _edge([ON_GROUND, BOTH, -BOTH, BLIND], velocity=(0.0, 0.0, -60.0))
    # by little light the Doppler peak is often lost, and with it the reading of a fast mover
    parts = [
        _cloud(shot_eyepoints, _weak(table_4_1, 7.6, power=power), draws=5000, method=method)
        for power in (5e-4, 1.35e-3)
    ]
    cloud = {name: np.concatenate([part[name] for part in parts]) for name in POINT_CLOUD_VARIABLES}
    kinds, is_point = cloud["flags"] & KIND, cloud["flags"] > 0
    known = [TRUE_RETURN_FLAG, FALSE_ALARM_FLAG, MISPAIRED_FLAG, MISREAD_FLAG, SIDELOBE_FLAG]
    assert np.isin(kinds[is_point], known).all()
    assert all(
        (kinds == kind).sum() > 20
        for kind in (TRUE_RETURN_FLAG, FALSE_ALARM_FLAG, MISPAIRED_FLAG, MISREAD_FLAG)
    )
    truthful = np.isin(kinds, [TRUE_RETURN_FLAG, MISREAD_FLAG])
    np.testing.assert_array_equal(cloud["surface"] >= 0, truthful)
    for name in ("true_range", "true_radial_velocity"):
        np.testing.assert_array_equal(np.isfinite(cloud[name]), truthful)
    np.testing.assert_array_equal(np.isfinite(cloud["range"]), is_point)
    np.testing.assert_array_equal(np.isfinite(cloud["pd"]), is_point & (kinds != FALSE_ALARM_FLAG))
    true = kinds == TRUE_RETURN_FLAG
    assert np.abs(cloud["range"] - cloud["true_range"])[true].max() < 4 * RANGE_BIN
    assert np.abs(cloud["radial_velocity"] - cloud["true_radial_velocity"])[true].max() < (
        4 * VELOCITY_BIN
    )
    above = cloud["true_range"] < HEIGHT - TABLE_HEIGHT / 2
    np.testing.assert_array_equal(cloud["surface"][truthful] == 1, above[truthful])
    misread = kinds == MISREAD_FLAG
    assert np.abs(cloud["range"] - cloud["true_range"])[misread].min() > 4 * RANGE_BIN
    assert (cloud["flags"][misread] & UNCONFIRMED_FLAG > 0).mean() > 0.9


# Invariance


@METHODS
def test_any_split_of_shots_and_of_draws_gives_the_same_bytes(table_4_1, method, monkeypatch):
    shot_eyepoints = _edge([ON_GROUND, BOTH, BLIND, -BOTH, ON_TABLE, BLIND, 30.0 - 1e-5], lift=5.0)
    assert (
        0 < (shot_eyepoints.surface[-1] < 0).sum() < shot_eyepoints.weight.size
    )  # in part past the edge
    parameters = _weak(table_4_1, 7.6) | {"target.solar_irradiance": 1e9}
    keys = _keys(np.arange(7))
    cloud = _cloud(shot_eyepoints, parameters, keys=keys, draws=40, method=method)
    assert len(np.unique(cloud["flags"])) > 3
    for shots in (np.arange(7)[::-1], [2], [0], [1, 6], [5, 2, 3]):
        cloud_part = _cloud(
            shot_eyepoints.select(shots), parameters, keys=keys[shots], draws=40, method=method
        )
        for name, values in cloud_part.items():
            assert values.tobytes() == cloud[name][shots].tobytes(), (name, shots)
    for first, number in ((0, 1), (1, 25), (26, 14)):
        cloud_part = _cloud(
            shot_eyepoints, parameters, keys=keys, first_draw=first, draws=number, method=method
        )
        for name in POINT_CLOUD_VARIABLES:
            part = cloud[name][:, first : first + number]
            assert cloud_part[name].tobytes() == part.tobytes(), (name, first)
        for name in SHOT_STATISTIC_VARIABLES:
            assert cloud_part[name].tobytes() == cloud[name].tobytes(), name
    monkeypatch.setattr(point_cloud, "VALUES_PER_BATCH", 1)
    for name, values in _cloud(
        shot_eyepoints, parameters, keys=keys, draws=40, method=method
    ).items():
        assert values.tobytes() == cloud[name].tobytes(), name


def test_no_shots_give_no_points(table_4_1):
    shot_eyepoints = _edge([ON_GROUND]).select(slice(0, 0))
    cloud = _cloud(shot_eyepoints, _strong(table_4_1), draws=2)
    assert all(len(values) == 0 for values in cloud.values())


@pytest.mark.parametrize("law", ["log_normal", "gamma_gamma"])
def test_each_shot_has_air_of_its_own_that_all_of_its_draws_see(table_4_1, law):
    """Power factors of mean 1 and the variance (1 + I_out) (1 + I_back) - 1 of both ways."""
    number = 3000
    air = {"atmosphere.turbulence": "uniform", "atmosphere.structure_constant": 3e-14,
           "atmosphere.scintillation_law": law, "atmosphere.path": "level"}  # fmt: skip
    p = scene_parameters(table_4_1, fft_size=2**12) | air
    shot_eyepoints = observe_shots(straight_flight(position=(0.0, 0.0, 300.0)), number=1).select(
        np.zeros(number, int)
    )
    effects = set(DEFAULT_EFFECTS) - {"signal_shot_noise"}
    without_turbulence = _cloud(shot_eyepoints.select([0]), p, effects=effects)["snr_up"][0]
    cloud = _cloud(shot_eyepoints, p, effects=effects | {"scintillation"}, draws=2)
    factor = cloud["snr_up"] / without_turbulence
    shots = prepare_eyepoint_shots(shot_eyepoints.select([0]), p, [GROUND, TABLE])
    legs = two_way_log_variances(
        turbulence_profile(PARAMETER_DEFAULTS | p),
        PARAMETER_DEFAULTS | p,
        np.array([shots.range[0]]),
    )
    variance = np.exp(sum(v[0] for leg in legs for v in leg)) - 1
    assert 0.02 < variance < 1
    assert abs(factor.mean() - 1) < 5 * np.sqrt(variance / number)
    spread = np.var((factor - 1) ** 2)
    assert abs(factor.var() - variance) < 5 * np.sqrt(spread / number)
    single = _cloud(
        shot_eyepoints.select([7]), p, effects=effects | {"scintillation"}, keys=_keys([7])
    )
    assert single["snr_up"][0] == cloud["snr_up"][7]


def test_a_turning_beam_is_received_next_to_where_it_was_sent(table_4_1):
    """Of the echo exp(-2 d^2 / (w_T^2 + w_L^2)) is left, d what the axis moves by meanwhile."""
    p = PARAMETER_DEFAULTS | scene_parameters(table_4_1, fft_size=2**12, coupling="single_mode")
    p["instrument.laser.beam_waist"] = 5e-3
    scanner = LineScan(0.4, 40.0, 1e4)
    shot_eyepoints = observe_shots(
        straight_flight(position=(0.0, 0.0, HEIGHT)), scanner=scanner, index=[300], number=1
    )
    rate, far = shot_eyepoints.turn_rate[0], shot_eyepoints.range[0]
    turning, straight = (
        _cloud(
            shot_eyepoints,
            p,
            effects=(*set(DEFAULT_EFFECTS) - {"signal_shot_noise"}, *further_effects),
        )["snr_up"][0]
        for further_effects in (["lag"], [])
    )
    (waist, _), separation = (
        beam.transmitted_and_oscillator_beams(p),
        2 * rate * far**2 / 299792458.0,
    )
    expected = np.exp(-2 * separation**2 / (2 * waist.radius(far) ** 2))
    assert 0.1 < expected < 0.95
    assert turning / straight == pytest.approx(expected, rel=1e-6)
