"""Beamlets by tolerance: the promise on pd and magnitudes, and what they are where it is open."""

import numpy as np
import pytest
from shot_helpers import parametrize_product

from sweep.model import evaluation
from sweep.model.beamlets import place_beamlets
from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.effects.catalogue import DEFAULT_EFFECTS, PARAMETER_DEFAULTS
from sweep.model.error_budget import ErrorBudget
from sweep.model.evaluation import prepare_shots

NUMBER = 200
FINE = {"footprint.beamlets": 8192, "footprint.pattern": "line", "accuracy.line_error": 1e-9}
AUTO = {"footprint.beamlets": 0}
PDS = ("pd_up", "pd_down", "pd_doppler", "pd_shot")
SNRS = ("snr_up", "snr_down", "snr_doppler")


def scenes(table_4_1, seed, **fixed):
    """Slanted planes near and far, narrow and wide beams, at rest and moving across."""
    rng = np.random.default_rng((55, seed))
    values = {
        "range": 10 ** rng.uniform(0.5, 4, NUMBER),
        "grazing_angle": np.radians(10 ** rng.uniform(0.2, 1.954, NUMBER)),
        "beam_divergence": 10 ** rng.uniform(-5, -3, NUMBER),
        "power": 10 ** rng.uniform(-2, 1, NUMBER),
        "phases": "incoherent",
        "fft_size": 2**12,
    }
    across = rng.normal(0, 50, NUMBER) * (rng.random(NUMBER) < 0.5)
    table = table_4_1(**values | fixed)
    return PARAMETER_DEFAULTS | table | {"target.transverse_velocity": across}


@pytest.mark.parametrize(
    "case",
    parametrize_product(
        3,
        [
            ("rectangular", "thesis"),
            ("hamming", "lambert"),
            ("flattop", "lambert"),
            ("kaiser(8.6)", "lambert"),
            ("blackman", "thesis"),
        ],
    ),
)
def test_pd_and_magnitudes_are_within_the_tolerance_of_a_continuum(table_4_1, case):
    window, law = case
    parameters = scenes(table_4_1, 1, window=window, reflectance_law=law)
    exact = evaluation.evaluate(parameters | FINE)
    for tolerance in (1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6):
        outputs = evaluation.evaluate(parameters | AUTO | {"accuracy.tolerance": tolerance})
        for name in PDS:
            assert (
                abs(outputs[name] - exact[name]).max() <= ErrorBudget.beamlets_fraction * tolerance
            ), name
        for name in SNRS:
            bins, true = np.sqrt(2 * outputs[name]), np.sqrt(2 * exact[name])  # over sigma
            assert (abs(bins - true) / np.maximum(true, 1)).max() <= tolerance, name
        assert (outputs["beamlets_error"] <= ErrorBudget.beamlets_fraction * tolerance).all()
        assert outputs["beamlets"].min() == 2 and np.median(outputs["beamlets"]) <= 9


def test_wide_beams_at_normal_incidence_take_several_lines(table_4_1):
    """Their ranges rise with the angle's square, on both axes alike."""
    parameters = scenes(
        table_4_1, 2, grazing_angle=np.pi / 2, beam_divergence=0.05, window="hann",
        reflectance_law="lambert",
    ) | {"target.transverse_velocity": 0.0}  # fmt: skip
    side = 61
    exact = evaluation.evaluate(
        parameters | {"footprint.beamlets": side * side, "footprint.pattern": "square"}
    )
    outputs = evaluation.evaluate(parameters | AUTO | {"accuracy.tolerance": 1e-3})
    far = parameters["target.range"] > 1000
    assert (outputs["beamlets_error"][far] > 0).all() and outputs["beamlets"][far].min() > 20
    for name in PDS:
        assert abs(outputs[name] - exact[name]).max() <= 1e-3


def steep(table_4_1, **changes):
    """Wide beams that a line shows best, though what it misses across the slope is told too."""
    return PARAMETER_DEFAULTS | table_4_1(**{"phases": "incoherent"} | changes)


@pytest.mark.parametrize(
    "changes",
    [
        {"beam_divergence": 5e-3, "grazing_angle": np.radians(30), "radial_velocity": 10.0,
         "range": np.array([1900.0, 2000.0, 2000.0]), "power": np.array([5.0, 5.0, 0.15])},
        {"beam_divergence": 471e-6, "grazing_angle": np.radians(4.96), "range": 2226.0,
         "window": "hann", "fft_size": 2**16},
    ],
    ids=["5 mrad at 30 deg", "471 urad at 5 deg"],
)  # fmt: skip
def test_a_tighter_tolerance_never_gives_a_worse_answer(table_4_1, changes):
    parameters = steep(table_4_1, **changes)
    line = {"footprint.beamlets": 4001, "footprint.pattern": "line"}
    exact = evaluation.evaluate(parameters | line)
    for tolerance in (1e-1, 1e-2, 1e-3, 1e-5, 1e-7, 0.0):
        outputs = evaluation.evaluate(parameters | AUTO | {"accuracy.tolerance": tolerance})
        assert outputs["snr_up"] == pytest.approx(exact["snr_up"], rel=max(tolerance, 1e-6))
        assert abs(outputs["pd_up"] - exact["pd_up"]).max() <= max(tolerance, 1e-6)
        assert (
            outputs["beamlets_error"] <= max(ErrorBudget.beamlets_fraction * tolerance, 1e-6)
        ).all()


def test_tighter_tolerances_of_random_scenes_come_nearer(table_4_1):
    """Wide beams, steep and straight down, moving in all directions; held against many lines."""
    rng, worst = np.random.default_rng(57), 0.0
    for _ in range(12):
        parameters = steep(
            table_4_1, range=10 ** rng.uniform(1, 3.5),
            grazing_angle=rng.choice([np.pi / 2, rng.uniform(0.3, 1.5)]),
            beam_divergence=10 ** rng.uniform(-4, -2), radial_velocity=rng.normal(0, 100),
            fft_size=2 ** int(rng.integers(10, 17)), window=rng.choice(["hann", "rectangular"]),
        ) | {"target.transverse_velocity": rng.choice([0.0, rng.normal(0, 30)])}  # fmt: skip
        many = {"footprint.beamlets": 32 * 2000, "footprint.pattern": "32 lines"}
        fine = {"accuracy.line_error": 1e-9}
        power = rng.uniform(15, 30) / evaluation.evaluate(parameters | many)["snr_up"]
        fine["instrument.laser.power"] = power  # so that its pd is neither 0 nor 1
        exact, errors = evaluation.evaluate(parameters | many | fine), []
        for tolerance in (1e-1, 1e-3, 1e-5, 1e-7):
            parameters_used = AUTO | fine | {"accuracy.tolerance": tolerance}
            outputs = evaluation.evaluate(parameters | parameters_used)
            errors.append(max(abs(outputs[name][0] - exact[name][0]) for name in PDS))
            assert errors[-1] <= outputs["beamlets_error"][0] + 2e-9
            assert errors[-1] <= max(ErrorBudget.beamlets_fraction * tolerance, 1e-6)
        worst = max(worst, errors[0])
    assert worst > 1e-5


@pytest.mark.parametrize("transverse", [0.0, 1e-9])
def test_a_velocity_along_a_wide_beam_spreads_its_lines_alone(table_4_1, transverse):
    """v (1 - cos theta): straight down nothing else moves the lines of the Doppler segment."""
    scene = steep(table_4_1, range=300.0, grazing_angle=np.pi / 2, beam_divergence=0.02)
    moving = scene | {"target.transverse_velocity": transverse}
    square = {"footprint.beamlets": 61 * 61, "footprint.pattern": "square"}
    exact = evaluation.evaluate(scene | square | {"target.transverse_velocity": 1e-9})
    for scene_parameters_used in (square, AUTO | {"accuracy.tolerance": 1e-5}):
        outputs = evaluation.evaluate(moving | scene_parameters_used)
        for name in SNRS:
            assert outputs[name] == pytest.approx(exact[name], rel=2e-4)
    at_rest = evaluation.evaluate(scene | square | {"target.radial_velocity": 0.0})
    assert outputs["snr_doppler"] < 0.6 * at_rest["snr_doppler"]
    ((_, shots),) = prepare_shots(moving | square)
    (x, y), _ = place_beamlets(61 * 61, "square")
    cosine = 1 / np.sqrt(1 + (x**2 + y**2) * 0.005**2)
    speeds = moving["target.radial_velocity"] * (cosine - 1)
    assert shots.footprint.doppler_ratio_offset[0] * SPEED_OF_LIGHT / 2 == pytest.approx(
        speeds, abs=2e-10
    )


def test_a_lattice_of_many_beamlets_agrees_with_the_line(table_4_1):
    """An arrangement of its own: two-dimensional, of 20,000 beamlets, for narrow spreads."""
    parameters = scenes(table_4_1, 3, beam_divergence=5e-5)
    first_points = {path: v[:40] if np.ndim(v) else v for path, v in parameters.items()}
    lattice = evaluation.evaluate(
        first_points | {"footprint.beamlets": 20_000, "footprint.pattern": "hexagonal"}
    )
    outputs = evaluation.evaluate(first_points | AUTO | {"accuracy.tolerance": 1e-6})
    for name in PDS:
        # the lattice ends at three deviations of the beam: its fourth moment is 5 % short
        assert abs(outputs[name] - lattice[name]).max() <= 2e-3


def test_points_stay_what_they_are_whatever_points_are_next_to_them(table_4_1):
    parameters = scenes(table_4_1, 4) | AUTO | {"accuracy.tolerance": 1e-3}
    at_once = evaluation.evaluate(parameters)
    for chosen in (slice(0, 7), slice(7, None)):
        part = {path: v[chosen] if np.ndim(v) else v for path, v in parameters.items()}
        for name, values in evaluation.evaluate(part).items():
            assert np.array_equal(values, at_once[name][chosen], equal_nan=True), name


@pytest.mark.parametrize(
    "changes", [{"phases": "coherent"}, {"architecture": "direct"}, {}], ids=str
)
def test_where_no_number_is_enough_it_is_the_thesiss(table_4_1, changes):
    """Amplitudes over a smooth plane, and patterns chosen by hand."""
    parameters = table_4_1(**{"phases": "incoherent"} | changes) | AUTO
    by_hand = {} if changes else {"footprint.pattern": "hexagonal"}
    ((_, shots),) = prepare_shots(parameters | {"accuracy.tolerance": 1e-3} | by_hand)
    assert shots.footprint.n_beamlets == 109


def test_without_a_footprint_there_is_one_beamlet(table_4_1):
    parameters = table_4_1(phases="incoherent") | AUTO | {"accuracy.tolerance": 1e-3}
    ((_, shots),) = prepare_shots(
        parameters, [name for name in DEFAULT_EFFECTS if name != "footprint"]
    )
    assert shots.footprint.n_beamlets == 1


def test_numbers_given_by_hand_are_kept(table_4_1):
    for pattern, number in (("line", 5), ("square", 9), ("sunflower", 33), ("hexagonal", 7)):
        parameters = table_4_1(beamlets=number, phases="incoherent")
        ((_, shots),) = prepare_shots(parameters | {"footprint.pattern": pattern})
        assert shots.footprint.n_beamlets == number


def test_where_no_provided_number_is_enough_the_error_says_so(table_4_1):
    """Spread over thousands of bins: a beam of 50 mrad grazing the ground at 10 km."""
    parameters = table_4_1(
        phases="incoherent", range=1e4, grazing_angle=np.radians([0.5, 80.0]), fft_size=2**12,
        beam_divergence=np.array([0.05, 1e-4]), bandwidth=1e9,
    ) | AUTO  # fmt: skip
    outputs = evaluation.evaluate(parameters | {"accuracy.tolerance": 1e-3})
    assert outputs["beamlets_error"][0] > 1e-3 >= outputs["beamlets_error"][1]
    by_hand = evaluation.evaluate(
        parameters | {"footprint.beamlets": 7, "accuracy.tolerance": 1e-3}
    )
    assert np.isnan(by_hand["beamlets_error"]).all()
