"""Beams by a route of their own: fields on a grid, propagated by FFT, and the echo they make."""

import math
from functools import partial

import numpy as np
import pytest
from scipy.special import j0
from small_scenes import level_plate, straight_flight

from sweep.model import beam, evaluation
from sweep.model.beam import GaussianBeam
from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.effects.catalogue import DEFAULT_EFFECTS, PARAMETER_DEFAULTS
from sweep.model.geometry.mesh import SurfaceMaterial
from sweep.model.geometry.ray_casting import RayCaster
from sweep.model.geometry.scanner import fixed_beams
from sweep.model.ground import FlatGround
from sweep.model.pointcloud.eyepoints import compute_eyepoints, prepare_eyepoint_shots

WAVELENGTH = 1550e-9
SIDE, NUMBER = 0.12, 512
PLACES = (np.arange(NUMBER) - NUMBER // 2) * (SIDE / NUMBER)


def propagated(waist, range, *, focus=0.0, centre=0.0):
    """Field at a range of a Gaussian beam of unit power, by Fresnel's transfer function."""
    x, y = PLACES[:, None] - centre, PLACES
    square = x**2 + y**2
    lens = -np.pi / (WAVELENGTH * focus) * square if focus else 0.0
    field = np.sqrt(2 / np.pi) / waist * np.exp(-square / waist**2 + 1j * lens)
    f = np.fft.fftfreq(NUMBER, SIDE / NUMBER)
    turn = np.exp(-1j * np.pi * WAVELENGTH * range * (f[:, None] ** 2 + f**2))
    return np.fft.ifft2(np.fft.fft2(field) * turn)


CASES = {
    "alike": (6e-3, 6e-3, 60.0, 0.0, 0.0),
    "apart": (5e-3, 5e-3, 50.0, 0.0, 7e-3),
    "unequal": (4e-3, 7e-3, 40.0, 0.0, 0.0),
    "focused": (8e-3, 8e-3, 30.0, 45.0, 0.0),
    "in the focus": (8e-3, 8e-3, 40.0, 40.0, 2e-3),
    "all": (6e-3, 9e-3, 35.0, 70.0, 4e-3),
}


def overlap(sent, received, range, offset=0.0):
    """Integral of I_T I_L over a plane across two beams whose axes are apart [1/m^2]."""
    squared_radius = sent.radius(range) ** 2 + received.radius(range) ** 2
    return 2 / (math.pi * squared_radius) * np.exp(-2 * offset**2 / squared_radius)


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_the_overlap_is_that_of_two_propagated_fields(case):
    sent, received, range, focus, separation = case
    one = propagated(sent, range, focus=focus)
    other = propagated(received, range, focus=focus, centre=separation)
    overlap_area = (np.abs(one * other) ** 2).sum() * (SIDE / NUMBER) ** 2
    beams = [
        GaussianBeam.from_waist(waist=w, wavelength=WAVELENGTH, focus=focus)
        for w in (sent, received)
    ]
    assert overlap(*beams, range, separation) == pytest.approx(overlap_area, rel=1e-6)


def test_light_moves_as_the_moving_product_of_both_fields_says():
    """The Doppler spread of a scan is the spread of wave numbers in U_T U_L over twice the light's.

    Next to the telescope that is far less than the angle under which the footprint is seen.
    """
    p = PARAMETERS | {beam.WAIST_PATH: 6e-3, "target.range": 8.0}
    spectrum = np.abs(np.fft.fft2(propagated(6e-3, 8.0) ** 2)) ** 2
    f = np.fft.fftfreq(NUMBER, SIDE / NUMBER)
    rms = np.sqrt((spectrum.sum(axis=1) * f**2).sum() / spectrum.sum()) * WAVELENGTH / 2
    places, directions = beam.footprint_full_angles(p)
    assert directions / 4 == pytest.approx(rms, rel=1e-6) and places > 9 * directions
    plane = FlatGround(p | {"target.transverse_velocity": np.array(100.0)}, 1)
    _, _, doppler, echo = plane.beamlet_table
    share = echo / echo.sum()
    spread = np.sqrt((share * doppler**2).sum()) * SPEED_OF_LIGHT / 2
    assert spread == pytest.approx(100 * rms, rel=1e-3)


PARAMETERS = PARAMETER_DEFAULTS | {
    "instrument.laser.wavelength": WAVELENGTH,
    "instrument.telescope.aperture": 0.1,
    "instrument.receiver.architecture": "homodyne",
    "target.range": 40.0,
    "target.grazing_angle": np.radians(30),
    "target.reflectance_law": "lambert",
    "target.radial_velocity": 0.0,
    "target.transverse_velocity": 0.0,
    "footprint.beamlets": 271,
    "footprint.phases": "incoherent",
    "footprint.pattern": "hexagonal",
}


@pytest.mark.parametrize("focus", [0.0, 30.0, 60.0])
@pytest.mark.parametrize("angle", [90.0, 30.0, 8.0])
def test_beamlets_on_a_plane_come_to_the_integral_over_it(focus, angle):
    """I_T I_L over the plane, point by point: its whole, and the spread of ranges in it."""
    grazing, near = (
        np.radians(angle),
        {beam.WAIST_PATH: 6e-3, beam.FOCUS_PATH: focus, beam.OSCILLATOR_WAIST_PATH: 9e-3},
    )
    p = PARAMETERS | near | {"target.grazing_angle": grazing}
    across, along = np.linspace(-0.04, 0.04, 401), np.linspace(-0.04, 0.04, 401) / np.sin(grazing)
    x, s = np.meshgrid(across, along)
    depth, height = 40.0 + s * np.cos(grazing), s * np.sin(grazing)
    antenna_pattern = 1.0
    for waist in (6e-3, 9e-3):
        width = GaussianBeam.from_waist(waist=waist, wavelength=WAVELENGTH, focus=focus).radius(
            depth
        )
        antenna_pattern = (
            antenna_pattern * 2 / (np.pi * width**2) * np.exp(-2 * (x**2 + height**2) / width**2)
        )
    # A patch of the plane catches its sine of the light, and Lambert's law sends sine / pi back.
    cell = (across[1] - across[0]) * (along[1] - along[0]) * np.sin(grazing)
    received_share = WAVELENGTH**2 * antenna_pattern.sum() * cell * np.sin(grazing) / np.pi
    area = beam.effective_collecting_area(p)
    _, offset, _, echo = FlatGround(p, 1).beamlet_table
    assert area / 40.0**2 * echo.sum() == pytest.approx(received_share, rel=2e-5)
    if angle < 90:
        spread = np.sqrt((antenna_pattern * (depth - 40) ** 2).sum() / antenna_pattern.sum()) / 40
        assert np.sqrt((echo * offset**2).sum() / echo.sum()) == pytest.approx(spread, rel=2e-4)


def test_both_laws_are_the_same_where_the_aperture_is_two_waists_wide():
    one = GaussianBeam.from_waist(waist=12.5e-3, wavelength=WAVELENGTH)
    effective_area = WAVELENGTH**2 * 1e14 * overlap(one, one, 1e7)
    near = 1 + (np.pi * 12.5e-3**2 / WAVELENGTH / 1e7) ** 2  # 1 + 1e-9 of Rayleigh's range
    assert effective_area * near == pytest.approx(np.pi * 12.5e-3**2, rel=1e-14)


def test_beyond_the_limit_of_diffraction_a_decade_of_divergence_costs_20_db(table_4_1):
    def snr(divergence):
        scene = table_4_1(
            coupling="single_mode", beam_divergence=divergence, range=3000.0, beamlets=1
        )
        return 10 * np.log10(evaluation.evaluate(scene)["snr_up"][0])

    angles = np.array([3e-4, 1e-3, 3e-3, 1e-2])
    lost = np.diff([snr(angle) for angle in angles]) / np.diff(np.log10(angles))
    assert lost == pytest.approx(-20.0, abs=0.02)
    # -8.1 dB at 200 urad for 25 mm, and -22.1 dB at 1 mrad, against all light in the aperture
    snr_db = 10 * np.log10(evaluation.evaluate(table_4_1(range=3000.0, beamlets=1))["snr_up"][0])
    assert snr(2e-4) - snr_db == pytest.approx(-8.1, abs=0.1)
    assert snr(1e-3) - snr_db == pytest.approx(-22.06, abs=0.01)


def test_a_focused_beam_of_settembrini_and_others():
    """w_0 1.31 mm in the focus at 11.1 m and 1310 nm: z_R 4.1 m, at 27.1 m 3 dB less than here."""
    length = GaussianBeam.from_waist(waist=1.31e-3, wavelength=1310e-9).rayleigh_range
    assert length == pytest.approx(4.1, abs=0.05)
    waist = 1.31e-3 * np.hypot(1, 11.1 / length)  # of the beam that narrows to w_0 at 11.1 m
    sent = GaussianBeam.from_waist(waist=waist, wavelength=1310e-9, focus=11.1 + length**2 / 11.1)
    far = np.linspace(1e-3, 40.0, 400001)
    power = overlap(sent, sent, far)
    assert far[power.argmax()] == pytest.approx(11.1, abs=1e-3)
    assert sent.radius(11.1) == pytest.approx(1.31e-3, rel=1e-9)
    assert far[power > power[0] / 2].max() == pytest.approx(27.1, rel=0.01)


def cut_off(fill, defocus):
    """A_eff / A of a beam that is cut off, sent and received, by an FFT of the aperture's field."""
    n, radius = 2048, 200.0
    grid = np.arange(n) - n // 2
    square = (grid[:, None] ** 2 + grid**2) / radius**2
    inside = np.clip((1 - np.sqrt(square)) * radius + 0.5, 0, 1)  # a smooth rim
    field = inside * np.exp(-square / fill**2 + 1j * defocus * square)
    power = np.pi * (fill * radius) ** 2 / 2  # of the whole beam
    spectrum = np.abs(np.fft.fft2(field)) ** 2 / power
    return (spectrum**2).sum() / n**2 / (np.pi * radius**2)


def test_no_beam_that_its_aperture_cuts_off_does_better_than_0_40():
    fills = np.linspace(0.5, 1.0, 51)
    best = fills**2 * beam.truncation_efficiency(fills)
    assert best.max() == pytest.approx(0.40, abs=0.01)
    assert fills[best.argmax()] == pytest.approx(0.8, abs=0.02)
    for fill, defocus in ((0.4, 0.0), (0.8, 0.0), (0.8, 2.5), (1.0, 0.7), (0.6, 9.0)):
        near = np.hypot(1, fill**2 * defocus)  # w(R) over its far-field law
        efficiency_limit = fill**2 / near**2
        efficiency = efficiency_limit * beam.truncation_efficiency(fill, defocus)
        assert efficiency == pytest.approx(cut_off(fill, defocus), rel=3e-3)


def test_what_an_aperture_cuts_off_is_tabulated_to_1e_4():
    """Against the Hankel transform of each field by a finer quadrature, to higher frequencies."""
    rng = np.random.default_rng(52)
    radii, radius_weights = np.polynomial.legendre.leggauss(200)
    radii, radius_weights = (radii + 1) / 2, radius_weights / 2
    nodes, weights = np.polynomial.legendre.leggauss(16)
    q = (np.arange(0.0, 260, 3.0)[:, None] + 1.5 * (nodes + 1)).ravel()
    kernel = j0(q[:, None] * radii) * (radii * radius_weights)
    fills = np.concatenate([rng.uniform(0.3, 1, 60), [1.0, 1.0, 0.8]])
    phases = np.concatenate([60 * rng.uniform(0, 1, 40) ** 3, rng.uniform(0, 3, 20), [0, 60, 0]])
    for fill, phase in zip(fills, phases, strict=True):
        c = 1 / fill**2 - 1j * phase
        power = np.abs(kernel @ np.exp(-c * radii**2)) ** 2
        echo = (power**2 * q * np.tile(1.5 * weights, q.size // 16)).sum()
        expected = 32 * abs(c) ** 2 * c.real * echo
        assert beam.truncation_efficiency(fill, phase) == pytest.approx(expected, rel=1e-4)
        assert beam.truncation_efficiency(fill, -phase) == beam.truncation_efficiency(fill, phase)


def test_a_flight_sees_a_plane_as_a_grid_does(table_4_1):
    """Grazing 53 deg next to a focus: places, directions, area and dimming by both ways."""
    one = PARAMETER_DEFAULTS | table_4_1(
        coupling="single_mode", beam_divergence=0.0, phases="incoherent", beamlets=37, range=50.0,
        grazing_angle=np.arctan2(4, 3), reflectance=1.0, reflectance_law="lambert",
        radial_velocity=60.0,
    ) | {beam.WAIST_PATH: 5e-3, beam.FOCUS_PATH: 70.0}  # fmt: skip
    path = straight_flight(position=(0.0, 0.0, 40.0), velocity=(36.0, 0.0, -48.0))
    eyepoints = compute_eyepoints(
        np.array([0]),
        flight=path,
        scanner=fixed_beams(np.array([[0.6, 0.0, -0.8]]), rate=1.0),
        caster=RayCaster([level_plate()]),
        beam_divergence=0.0,
        n_beamlets=37,
        footprint_full_angles=partial(beam.footprint_full_angles, one),
    )
    statistics = evaluation.shot_statistics(
        prepare_eyepoint_shots(eyepoints, one, [SurfaceMaterial("ground", 1.0, "lambert")])
    )
    grid = evaluation.evaluate(one)
    for name in ("snr_up", "snr_doppler", "snr_down"):
        assert statistics[name] == pytest.approx(grid[name], rel=2e-4)
    assert grid["snr_up"] != pytest.approx(
        evaluation.evaluate(one | {beam.FOCUS_PATH: 0.0})["snr_up"], rel=0.1
    )


def test_leaves_before_the_focus_dim_and_shine_as_the_overlap_says(table_4_1):
    """A leaf at 11 m in half of a footprint on the ground at 50 m, focused at 50 m."""
    one = (
        PARAMETER_DEFAULTS
        | table_4_1(coupling="single_mode", beam_divergence=0.0, phases="incoherent")
        | {beam.WAIST_PATH: 8e-3, beam.FOCUS_PATH: 50.0}
    )
    leaf = level_plate(x=(0.0, 10.0), height=39.0, surface=1)
    eyepoints = compute_eyepoints(
        np.array([0]),
        flight=straight_flight(position=(-1e-4, 0.0, 50.0)),
        scanner=fixed_beams(np.array([[0.0, 0.0, -1.0]]), rate=1.0),
        caster=RayCaster([level_plate(), leaf]),
        beam_divergence=0.0,
        n_beamlets=109,
        footprint_full_angles=partial(beam.footprint_full_angles, one),
    )
    surfaces = [SurfaceMaterial(name, 1.0, "thesis") for name in ("ground", "leaf")]
    shots = prepare_eyepoint_shots(eyepoints, one, surfaces, DEFAULT_EFFECTS)
    echo = (shots.footprint.relative_amplitude**2)[0] / eyepoints.weight
    near = eyepoints.surface[0] == 1
    sent = GaussianBeam.from_waist(waist=8e-3, wavelength=WAVELENGTH, focus=50.0)
    ratio = overlap(sent, sent, 11.0) / overlap(sent, sent, 50.0)
    assert near.any() and not near.all()
    assert echo[near].mean() / echo[~near].mean() == pytest.approx(ratio, rel=1e-4)
    assert ratio < 0.25  # where (R_0 / R)^2, of all light in the aperture, makes it 21


LAGS = {
    "scan": (
        {beam.SCAN_RATE_PATH: np.radians(300.0)},
        np.radians(300.0) * 2 * 3000 / 299792458 * 3000,
    ),
    "parallax": ({beam.SEPARATION_PATH: 0.05}, 0.05),
    "misalignment": ({beam.MISALIGNMENT_PATH: -30e-6}, 0.09),
    "toed in": ({beam.MISALIGNMENT_PATH: -30e-6, beam.SEPARATION_PATH: 0.09}, 0.0),
}


@pytest.mark.parametrize("case", LAGS.values(), ids=LAGS)
def test_axes_apart_cost_what_the_overlap_loses(case, table_4_1):
    changes, separation = case
    scene = PARAMETER_DEFAULTS | table_4_1(
        coupling="single_mode", beam_divergence=1e-4, range=3000.0
    )
    waist = 2 * WAVELENGTH / (np.pi * 1e-4)
    radius = np.hypot(waist, WAVELENGTH * 3000.0 / (np.pi * waist))
    effects = (*DEFAULT_EFFECTS, "lag")
    quiet, parted = (evaluation.evaluate(p, effects)["snr_up"][0] for p in (scene, scene | changes))
    assert parted / quiet == pytest.approx(np.exp(-(separation**2) / radius**2), rel=2e-3)
    for law in ({beam.COUPLING_PATH: "aperture"}, {"instrument.receiver.architecture": "direct"}):
        with_loss, without_loss = (
            evaluation.evaluate(p | law, effects) for p in (scene | changes, scene)
        )
        np.testing.assert_equal(with_loss, without_loss)


def test_light_from_elsewhere_passes_one_mode(table_4_1):
    p = PARAMETER_DEFAULTS | table_4_1(coupling="single_mode", beam_divergence=2e-4)
    diameter, angle = beam.receiver_diameter_and_view_angle(p)
    assert (np.pi / 4 * diameter * angle) ** 2 == pytest.approx(WAVELENGTH**2, rel=1e-12)
