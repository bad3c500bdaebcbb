"""What the shipped scenes are to show, seen by their rays: [T] Figs. 3.8 and 5.1 to 5.7."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from sweep.model.pointcloud.eyepoints import compute_eyepoints
from sweep.spec import SceneSpec, SpecError, load
from sweep.spec.yaml_document import read_document

EXPERIMENTS = Path(__file__).parents[2] / "experiments"
SHIPPED = (
    "expanded_pattern", "forest_scan", "morpheus_three_beam", "oblique_descent",
    "scan_pattern_comparison", "speckled_descent", "square_high_descent", "square_low_descent",
)  # fmt: skip
GALE = EXPERIMENTS / "gale_crater_descent.yaml"


@cache
def flown(name):
    """A study and what each of its scanners sees."""
    spec = load(EXPERIMENTS / f"{name}.yaml")
    world = spec.build_scene()
    return spec, {
        scanner: compute_eyepoints(
            np.arange(spec.number_of_cycles(scanner) * spec.shots_per_cycle(scanner)),
            flight=spec.build_flight(),
            scanner=spec.scan_pattern(scanner),
            caster=world.caster,
            body_motions=world.body_motions,
            beam_divergence=spec.instrument.laser.beam_divergence,
            n_beamlets=spec.footprint.beamlets,
            pattern=spec.beamlet_pattern,
        )
        for scanner in spec.scanners
    }


def only(name):
    spec, eyes = flown(name)
    (scanner,) = spec.scanners
    return spec, eyes[scanner]


def grounded(eyes):
    """Where each shot meets the ground, (n, 3)."""
    return eyes.position + eyes.range[:, None] * eyes.direction


@pytest.mark.parametrize("name", SHIPPED)
def test_every_beam_meets_the_ground(name):
    spec, eyes = flown(name)
    for beam_eyepoints in eyes.values():
        assert beam_eyepoints.has_target.all() and (beam_eyepoints.surface >= 0).mean() > 0.999
        assert 2 * beam_eyepoints.range.max() / 299_792_458 < 0.1 * spec.instrument.chirp.duration
    parameters = spec.parameters()
    reflectances = {surface.reflectance for surface in spec.surface_materials()}
    assert parameters["instrument.telescope.optical_efficiency"] == 1 and reflectances == {0.1}


@pytest.mark.parametrize(
    ("name", "first", "last", "speeds", "cycles"),
    [
        ("morpheus_three_beam", 500, 100, (100, 30), 7),
        ("square_high_descent", 2000, 500, (100, 32), 454),
        ("square_low_descent", 500, 10, (32, 5), 529),
        ("expanded_pattern", 2000, 10, (100, 50), 530),
    ],
)
def test_a_descent_is_that_of_the_thesis(name, first, last, speeds, cycles):
    spec, eyes = only(name)
    flight, (scanner,) = spec.build_flight(), spec.scanners
    assert flight.stop_time == pytest.approx(2 * (first - last) / sum(speeds))
    ends = flight.state(np.array([0.0, flight.stop_time]))
    np.testing.assert_allclose(ends.position, [[0, 0, first], [0, 0, last]], atol=1e-9)
    np.testing.assert_allclose(ends.velocity[:, 2], [-speeds[0], -speeds[1]], rtol=1e-12)
    rate = 1 if scanner == "three" else 20
    assert (
        spec.number_of_cycles(scanner)
        == cycles
        == int(flight.stop_time * rate - 0.7499 * (rate > 1)) + 1
    )
    # v cos(angle from nadir), to the 25 urad by which the reference beamlet may lie off the axis.
    np.testing.assert_allclose(
        eyes.radial_velocity, eyes.velocity[:, 2] * eyes.direction[:, 2], rtol=25e-6
    )


def test_three_beams_make_a_cone_of_45_degrees():
    _, eyes = only("morpheus_three_beam")
    np.testing.assert_allclose(np.degrees(np.arccos(-eyes.direction[:, 2])), 22.5, atol=1e-9)


@pytest.mark.parametrize(
    ("name", "angle"), [("square_high_descent", 22.5), ("square_low_descent", 7.5)]
)
def test_a_square_shrinks_as_the_lidar_comes_down(name, angle):
    _, eyes = only(name)
    ground = grounded(eyes)
    height = eyes.position[:, 2] - ground[:, 2]
    side = np.abs(ground[:, :2]) / height[:, None]
    np.testing.assert_allclose(side, np.tan(np.radians(angle)), rtol=1e-9)
    reach = np.abs(ground[:, :2]).max(axis=1).reshape(-1, 4).mean(axis=1)
    assert reach[-1] < 0.35 * reach[0]
    assert (np.diff(reach[::40]) < 0).all()


def test_a_diagonal_path_shows_three_velocities():
    spec, eyes = only("oblique_descent")
    path = spec.build_flight().state(np.array([0.0, spec.build_flight().stop_time])).position
    way = path[1] - path[0]
    assert np.linalg.norm(way) == pytest.approx(400, abs=1e-3) and path[0, 2] == 500
    np.testing.assert_allclose(way / 400, [0.5, 0.5, -np.sqrt(0.5)], atol=1e-5)
    by_beam = [eyes.radial_velocity[eyes.beam == beam] for beam in range(4)]
    assert max(np.ptp(velocity) for velocity in by_beam) < 1e-3
    # 32 m/s along (1, 1, -sqrt 2) / 2 against (+-t, +-t, -1) with t = tan 7.5 deg.
    t = np.tan(np.radians(7.5))
    speed = 32 / np.sqrt(1 + 2 * t**2)
    expected = [speed * (t + np.sqrt(0.5)), speed * np.sqrt(0.5), speed * (np.sqrt(0.5) - t)]
    means = sorted((velocity.mean() for velocity in by_beam), reverse=True)
    np.testing.assert_allclose(
        means, [expected[0], expected[1], expected[1], expected[2]], rtol=1e-4
    )


def test_the_lines_of_the_wide_and_the_narrow_square_overlap():
    _, eyes = only("expanded_pattern")
    ground = grounded(eyes)
    diagonal = np.isclose(np.abs(eyes.direction[:, 0]), np.abs(eyes.direction[:, 1]))
    wide = diagonal & (eyes.direction[:, 2] > -0.9)
    narrow = diagonal & ~wide
    assert wide.sum() == pytest.approx(len(eyes.time) / 4, abs=4)
    assert narrow.sum() == pytest.approx(len(eyes.time) / 4, abs=4)
    reach = np.linalg.norm(ground[:, :2], axis=1)
    shared = reach[wide].min(), reach[narrow].max()
    assert shared[0] < 10 and shared[1] > 330
    # On the same ground the narrow beam was far higher up: the colour of the line changes there.
    inside = wide & (reach < shared[1])
    assert eyes.range[narrow & (reach > 0.8 * shared[1])].min() > 2 * np.median(eyes.range[inside])


def test_fore_and_aft_beams_see_opposite_velocities_of_two_bins():
    spec, eyes = only("forest_scan")
    expected = np.where(eyes.beam == 0, 1, -1) * 20 * np.sin(250e-6)
    np.testing.assert_allclose(eyes.radial_velocity, expected, rtol=0.06)
    assert (eyes.beam.reshape(-1, 2) == [0, 1]).all()
    laser, processing = spec.instrument.laser, spec.instrument.processing
    velocity_bin = laser.wavelength * processing.sample_rate / (2 * processing.fft_size)
    assert velocity_bin < np.abs(expected).min() < 2 * velocity_bin
    assert spec.scan_pattern("sweep").rate < 1 / (3 * spec.instrument.chirp.duration)


def test_the_scan_covers_hills_with_a_clump_of_trees_in_their_middle():
    spec, eyes = only("forest_scan")
    names = [surface.name for surface in spec.surface_materials()]
    leaf = (eyes.surface == names.index("forest.leaf")).any(axis=1)
    ground = grounded(eyes)
    assert 100 < leaf.sum() < 0.15 * len(leaf)
    assert np.linalg.norm(ground[leaf, :2], axis=1).max() < 20
    assert np.abs(ground[~leaf][:, :2]).max(axis=0) == pytest.approx([30, 30], abs=1)
    assert 2 < np.ptp(ground[~leaf, 2]) < 12 and ground[leaf, 2].max() > 8


def test_the_shot_that_is_drawn_sees_a_leaf_and_the_ground_in_equal_parts():
    spec, eyes = only("forest_scan")
    (figure,) = [figure for figure in spec.figures if figure.kind == "shot_spectra"]
    surface_numbers, offset = eyes.surface[figure.shot], eyes.offset[figure.shot]
    leaf = eyes.weight[surface_numbers == 1].sum()
    assert set(surface_numbers.tolist()) == {0, 1} and 0.25 < leaf < 0.75
    gap = offset[surface_numbers == 0].min() - offset[surface_numbers == 1].max()
    bandwidth, duration = spec.instrument.chirp.bandwidth, spec.instrument.chirp.duration
    range_bin = 299_792_458 * duration * spec.instrument.processing.sample_rate / (
        2 * bandwidth * spec.instrument.processing.fft_size
    )  # fmt: skip
    assert gap > 10 * range_bin


def test_patterns_are_compared_at_like_reach_and_rate_of_shots():
    spec, eyes = flown("scan_pattern_comparison")
    assert [spec.shots_per_cycle(name) for name in spec.scanners] == [3, 4, 16]
    times = {
        name: len(beam_eyepoints.time) / beam_eyepoints.time[-1]
        for name, beam_eyepoints in eyes.items()
    }
    assert times["four"] == pytest.approx(times["sixteen"], rel=0.01)
    angles = np.degrees(np.arctan(eyes["sixteen"].direction[:16, :2]
                                  / -eyes["sixteen"].direction[:16, 2:]))  # fmt: skip
    np.testing.assert_allclose(np.unique(angles.round(9)), [-22.5, -7.5, 7.5, 22.5])
    assert spec.draws.number >= 100 and {f.kind for f in spec.figures} == {
        "navigation", "navigation_table"
    }  # fmt: skip


def test_gale_crater_says_where_its_terrain_is_missing(tmp_path):
    (tmp_path / "instruments").symlink_to(EXPERIMENTS / "instruments")
    (tmp_path / "gale.yaml").write_text(GALE.read_text())
    with pytest.raises(SpecError) as error_info:
        load(tmp_path / "gale.yaml")
    (mistake,) = error_info.value.mistakes
    assert mistake.path == "scene.objects.ground.file" and mistake.line > 5
    assert "gale_crater_hirise_1m.tif" in mistake.value and "does not exist" in mistake.problem


def test_gale_crater_is_real_ground_under_all_beams_where_it_is_there():
    terrain = read_document(GALE).content["scene"]["objects"]["ground"]["file"]
    if not (GALE.parent / terrain).exists():
        pytest.skip("the terrain is no part of the repository")
    spec = load(GALE)
    assert isinstance(spec, SceneSpec)
    spec, eyes = only("gale_crater_descent")
    assert eyes.has_target.all() and (eyes.surface == 0).all()
    assert 10 < eyes.range.min() < 12 and np.abs(grounded(eyes)[:, :2]).max() < 170
    origin = spec.build_scene().origin
    assert np.abs(origin[:2]).max() > 1e5 and -4473 < origin[2] < -4437
