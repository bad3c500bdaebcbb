"""Platforms, paths, attitudes and scanners as specs declare them, against closed forms."""

import math
from decimal import Decimal

import numpy as np
import pytest
from base_scene_spec import changed_scene

from sweep.model.geometry.quaternion import rotate
from sweep.spec import SceneSpec, from_stored, load


def spec_of(changes=None, *, base=".", **sections):
    return SceneSpec.from_mapping(changed_scene(changes, **sections), base=base)


def with_path(**path):
    return spec_of({"platform.path": path})


def beams_of(**scanner):
    """Direction of every shot of the first two cycles, and their times."""
    spec = spec_of(scanners={"one": scanner})
    shots = spec.scan_pattern("one").shots(np.arange(2 * spec.shots_per_cycle("one")))
    return shots


def test_a_straight_path_covers_its_distance_at_its_speeds():
    flight = spec_of().build_flight()
    assert flight.stop_time == pytest.approx(2 * 400 / (60 + 20), rel=1e-15)
    t = np.array([0.0, 2.5, 10.0])
    fallen = 60 * t - 0.5 * 4 * t**2
    state = flight.state(t)
    np.testing.assert_allclose(state.position[:, 2], 500 - fallen, rtol=1e-14)
    np.testing.assert_allclose(state.velocity[:, 2], -(60 - 4 * t), rtol=1e-14)


def test_a_straight_path_keeps_its_speed_where_no_other_is_stated():
    assert spec_of({"platform.path.final_speed": ...}).build_flight().stop_time == pytest.approx(
        400 / 60
    )


@pytest.mark.parametrize(("rate", "cycles"), [("2 Hz", 21), ("1 Hz", 11), ("0.15 Hz", 2)])
def test_cycles_are_those_whose_shots_all_begin_in_the_flight(rate, cycles):
    spec = spec_of({"scanners.three.rate": rate})
    assert (spec.number_of_cycles("three"), spec.shots_per_cycle("three")) == (cycles, 3)
    last = spec.scan_pattern("three").shots(np.array([cycles * 3 - 1, cycles * 3])).time
    assert last[0] <= 10.0 < last[1]


def test_a_cycle_that_the_flight_cuts_short_does_not_count():
    spec = spec_of(scanners={"one": {"kind": "corners", "angle": "5 deg", "rate": "2 Hz"}})
    assert spec.number_of_cycles("one") == 20  # the 21st begins at the end, and lasts 3/8 s more


def test_paths_are_those_of_the_model(tmp_path):
    thrown = with_path(
        kind="acceleration", position=["1 km", "0 m", "2 m"], velocity=["3 m/s", "0 m/s", "4 m/s"],
        acceleration=["0 m/s^2", "0 m/s^2", "-2 m/s^2"], duration="5 s",
    ).build_flight()  # fmt: skip
    np.testing.assert_allclose(thrown.state(np.array([3.0])).position[0], [1009, 0, 2 + 12 - 9])
    static_flight = with_path(
        kind="still", position=["1 m", "2 m", "300 m"], duration="7 s"
    ).build_flight()
    assert static_flight.stop_time == 7
    np.testing.assert_array_equal(static_flight.state(np.array([6.0])).velocity, 0)
    table = "time [s], x [m], y [m], z [km]\n0, 0, 0, 0.5\n5, 10, 0, 0.4\n10, 20, 0, 0.3\n"
    (tmp_path / "path.csv").write_text(table)
    path = {"kind": "waypoints", "file": "path.csv"}
    flown = spec_of({"platform.path": path}, base=tmp_path).build_flight()
    np.testing.assert_allclose(flown.state(np.array([2.5])).position[0], [5, 0, 450])


def forward(changes, t=0.0, base="."):
    state = spec_of(changes, base=base).build_flight().state(np.array([t]))
    return rotate(state.attitude, np.array([1.0, 0, 0]))[0], state


SLANTED = {"platform.path.to": ["0 m", "400 m", "100 m"]}


@pytest.mark.parametrize(
    ("attitude", "expected"),
    [
        ({"kind": "nadir"}, [1, 0, 0]),
        ({"kind": "nadir", "heading": "90 deg"}, [0, 1, 0]),
        ({"kind": "nadir", "heading": "track"}, [0, 1, 0]),
        ({"kind": "along_track", "roll": "20 deg"}, [0, math.sqrt(0.5), -math.sqrt(0.5)]),
        ({"kind": "fixed", "heading": "180 deg", "pitch": "30 deg"},
         [-math.cos(math.pi / 6), 0, 0.5]),
        ({"kind": "fixed", "quaternion": [1, 0, 0, 1]}, [0, 1, 0]),
    ],
)  # fmt: skip
def test_attitudes_point_forward_where_they_say(attitude, expected):
    ahead, _ = forward(SLANTED | {"platform.attitude": attitude})
    np.testing.assert_allclose(ahead, expected, atol=1e-15)


def test_a_spinning_platform_turns_at_its_rate_from_where_it_began():
    spin = {
        "kind": "spin", "heading": "10 deg", "angular_velocity": ["0 deg/s", "0 deg/s", "20 deg/s"]
    }  # fmt: skip
    ahead, state = forward({"platform.attitude": spin}, t=4.0)
    np.testing.assert_allclose(ahead, [0, 1, 0], atol=1e-15)
    np.testing.assert_allclose(state.angular_velocity[0], [0, 0, math.radians(20)])


def test_a_track_follows_the_table_of_the_path_and_of_another_file(tmp_path):
    (tmp_path / "path.csv").write_text(
        "time [s], x [m], y [m], z [m], heading [deg]\n0, 0, 0, 500, 0\n10, 10, 0, 500, 90\n"
    )
    (tmp_path / "turn.csv").write_text(
        "time [s], x [m], y [m], z [m], heading [deg]\n0, 0, 0, 0, 90\n10, 0, 0, 0, 90\n"
    )
    path = {"platform.path": {"kind": "waypoints", "file": "path.csv"}}
    track, _ = forward(path | {"platform.attitude": {"kind": "track"}}, 5.0, tmp_path)
    np.testing.assert_allclose(track, [math.sqrt(0.5), math.sqrt(0.5), 0], atol=1e-15)
    other = {"platform.attitude": {"kind": "track", "file": "turn.csv"}}
    for changes in (other, path | other):
        ahead, _ = forward(changes, 5.0, tmp_path)
        np.testing.assert_allclose(ahead, [0, 1, 0], atol=1e-15)


def test_lever_arm_is_in_the_body_and_mounting_turns_the_instrument_alone():
    changes = {
        "platform.attitude": {"kind": "fixed", "heading": "90 deg"},
        "platform.lever_arm": ["2 m", "0 m", "1 m"],
        "platform.mounting": {"heading": "30 deg", "pitch": "-10 deg"},
    }
    ahead, state = forward(changes)
    np.testing.assert_allclose(state.position[0], [0, 2, 501], atol=1e-13)
    level, down = math.cos(math.radians(10)), -math.sin(math.radians(10))
    turned = [level * math.cos(math.radians(120)), level * math.sin(math.radians(120)), down]
    np.testing.assert_allclose(ahead, turned, atol=1e-15)


def test_a_turning_body_carries_its_instrument_along():
    spin = {"kind": "spin", "angular_velocity": ["0 rad/s", "0 rad/s", "0.5 rad/s"]}
    changes = {"platform.attitude": spin, "platform.lever_arm": ["2 m", "0 m", "0 m"],
               "platform.mounting": {"heading": "70 deg"}}  # fmt: skip
    _, state = forward(changes)
    np.testing.assert_allclose(state.velocity[0], [0, 1, -60], atol=1e-13)


def angle_from_nadir(directions):
    return np.degrees(np.arccos(-directions[:, 2]))


def test_a_cone_has_its_beams_evenly_about_nadir_all_at_once():
    shots = beams_of(kind="cone", beams=3, half_angle="22.5 deg", azimuth="10 deg", rate="2 Hz")
    np.testing.assert_allclose(angle_from_nadir(shots.direction), 22.5)
    azimuth = np.degrees(np.arctan2(shots.direction[:, 1], shots.direction[:, 0])) % 360
    np.testing.assert_allclose(azimuth, [10, 130, 250] * 2)
    np.testing.assert_allclose(shots.time, [0, 0, 0, 0.5, 0.5, 0.5])


def test_corners_are_visited_one_after_the_other():
    shots = beams_of(kind="corners", angle="22.5 deg", rate="5 Hz")
    tangents = shots.direction[:4, :2] / -shots.direction[:4, 2:]
    np.testing.assert_allclose(np.abs(tangents), math.tan(math.radians(22.5)))
    assert len({tuple(np.sign(t)) for t in tangents}) == 4
    np.testing.assert_allclose(shots.time, np.arange(8) / 20)


def test_fixed_beams_are_angles_of_two_axes_or_vectors():
    shots = beams_of(
        kind="fixed", beams=[["10 deg", "-5 deg"], [0, 3, -4], ["0 deg", "0 deg"]], rate="1 Hz",
        interval="10 ms",
    )  # fmt: skip
    first = [math.tan(math.radians(10)), math.tan(math.radians(-5))]
    np.testing.assert_allclose(shots.direction[0, :2] / -shots.direction[0, 2], first)
    np.testing.assert_allclose(shots.direction[1:3], [[0, 0.6, -0.8], [0, 0, -1]], atol=1e-15)
    np.testing.assert_allclose(shots.time[:3], [0, 0.01, 0.02])


def test_squares_take_turns_from_the_widest_to_the_narrowest():
    spec = spec_of(
        scanners={"one": {"kind": "squares", "elements": ["15 deg", "7.5 deg"], "rate": "4 Hz"}}
    )
    assert spec.shots_per_cycle("one") == 4
    shots = spec.scan_pattern("one").shots(np.arange(16))
    assert len(set(shots.beam_number)) == 16
    angles = angle_from_nadir(shots.direction).reshape(4, 4)
    assert (np.diff(angles.mean(axis=1)) <= 1e-9).all() and np.ptp(angles, axis=1).max() < 1e-9


def test_a_raster_is_one_cycle_and_reaches_its_half_angles():
    shots = beams_of(
        kind="raster", columns=5, rows=3, half_angles=["10 deg", "4 deg"], rate="1 Hz",
        both_ways=False,
    )  # fmt: skip
    along, across = np.degrees(np.arctan(shots.direction[:15, :2] / -shots.direction[:15, 2:])).T
    np.testing.assert_allclose(across.reshape(3, 5), [[-10, -5, 0, 5, 10]] * 3, atol=1e-12)
    np.testing.assert_allclose(along.reshape(3, 5)[:, 0], [-4, 0, 4], atol=1e-12)


def test_a_line_sweeps_its_fan_from_side_to_side():
    spec = spec_of(
        scanners={"one": {
            "kind": "line", "half_angle": "5 deg", "line_rate": "2 Hz", "rate": "8 Hz",
            "along": ["250 urad", "-250 urad"], "wave": "sine",
        }}
    )  # fmt: skip
    assert spec.shots_per_cycle("one") == 2
    shots = spec.scan_pattern("one").shots(np.arange(10))
    across = np.degrees(np.arctan2(shots.direction[:, 1], -shots.direction[:, 2]))[::2]
    np.testing.assert_allclose(across, -5 * np.cos(np.pi * np.arange(5) / 4), atol=1e-12)
    np.testing.assert_allclose(shots.direction[:2, 0], [np.sin(250e-6), -np.sin(250e-6)])


def test_defaults_are_those_that_the_specs_promise():
    spec = spec_of()
    assert (spec.draws.number, spec.draws.method, spec.draws.returns) == (1, "probabilities", 4)
    assert (spec.storage.block_shots, spec.storage.block_draws) == (4096, 64)
    assert spec.pointing_jitter() is None and spec.beamlet_pattern == "hexagonal"
    assert spec.parameters()["target.solar_irradiance"] == 0.0
    assert not any(p.startswith("target.") for p in spec.parameters() if "solar" not in p)


@pytest.mark.parametrize(
    ("phases", "architecture", "pattern"),
    [
        ("incoherent", "homodyne", "hexagonal"),
        ("incoherent", "direct", "sunflower"),
        ("coherent", "heterodyne", "sunflower"),
    ],
)
def test_beamlets_are_laid_out_as_the_model_lays_them_out(phases, architecture, pattern):
    changes = {"footprint.phases": phases, "instrument.receiver.architecture": architecture}
    assert spec_of(changes).beamlet_pattern == pattern


def test_jitter_and_sunlight_are_handed_on():
    spec = spec_of(
        {"platform.jitter": "20 urad", "scene.solar_irradiance": "0.5 W/m^2/nm", "seed": 3}
    )
    assert spec.pointing_jitter() == (pytest.approx(20e-6), 3)
    assert spec.parameters()["target.solar_irradiance"] == pytest.approx(5e8)


def test_parameters_are_set_again_where_the_rays_stay_the_same():
    spec = spec_of()
    assert spec.parameters_with_overrides({"power": "3 W"})["instrument.laser.power"] == 3.0
    for at, words in (
        ({"beam_divergence": "1 mrad"}, "moves the beamlets"),
        ({"architecture": "direct"}, "moves the beamlets"),
        ({"focus": "30 m"}, "moves the beamlets"),
        ({"target.range": "1 m"}, "is no parameter"),
        ({"power": "3 s"}, "needs a unit like W"),
    ):
        with pytest.raises(Exception, match=words):
            spec.parameters_with_overrides(at)


def test_a_scene_is_distinguished_from_a_target_by_the_content_of_the_file(tmp_path):
    import yaml
    from base_spec import changed_spec as grid

    (tmp_path / "scene.yaml").write_text(yaml.safe_dump(changed_scene()))
    (tmp_path / "grid.yaml").write_text(yaml.safe_dump(grid()))
    scene, target = load(tmp_path / "scene.yaml"), load(tmp_path / "grid.yaml")
    assert isinstance(scene, SceneSpec) and not isinstance(target, SceneSpec)
    for spec in (scene, target):
        restored = from_stored(spec.to_json())
        assert (type(restored), restored.id, restored) == (type(spec), spec.id, spec)


def test_tables_of_gps_seconds_share_the_origin_of_the_platforms_first_time(tmp_path):
    """At 1.35e9 s float64 is good to 1e-7 s, by which a spline makes 0.07 m/s^2 of rest."""
    first, header = Decimal("1350000000.1234567"), "time [s], x [m], y [m], z [m]\n"
    rows = [f"{first + Decimal(i) / 100}, {i}, 0, 500\n" for i in range(101)]
    (tmp_path / "path.csv").write_text(header + "".join(rows))
    late = [f"{first + second}, {10 * second}, 0, 5\n" for second in (-1, 0, 1, 2)]
    (tmp_path / "target.csv").write_text(header + "".join(late))
    mapping = changed_scene(
        platform={"path": {"kind": "waypoints", "file": "path.csv"}},
        scene={"origin": "world", "objects": {
            "ball": {"kind": "sphere", "radius": "20 m", "reflectance": 0.1,
                     "motion": {"path": {"kind": "waypoints", "file": "target.csv"}}},
        }},
    )  # fmt: skip
    spec = SceneSpec.from_mapping(mapping, base=tmp_path)
    assert spec.files.time_origin == first
    flight, (ball,) = spec.build_flight(), spec.build_scene().body_motions
    assert (flight.start_time, flight.stop_time) == (0, 1)
    state = flight.state(np.linspace(0, 1, 333))
    assert np.abs(state.acceleration).max() < 1e-8
    np.testing.assert_allclose(state.velocity[:, 0], 100, atol=1e-9)
    assert ball.state(np.array([0.5])).position[0, 0] == pytest.approx(5, abs=1e-12)
