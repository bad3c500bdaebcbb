"""Speckle drawn over footprints: detections together, places that wander, and what errors state.

Points of flights by all methods, and a Monte Carlo simulation of scatterers that shares the mean
echo power, the noise and the threshold with the model, and the interpolation between three bins.
"""

from dataclasses import replace

import numpy as np
import pytest
from scatterer_shots import (
    COMPARED_EFFECTS,
    LANDER_PARAMETERS,
    draw_shots,
    point_facet,
    prepare_single_category,
    searched_bins,
    with_signal_over_threshold,
)
from shot_helpers import make_point_keys, parametrize_product
from small_scenes import observe_shots, straight_flight

from sweep.model import beam
from sweep.model.detection.speckle_correlation import (
    TRANSFORM_REACH_CELLS,
    LinePairGradients,
    peak_bin_correlation,
    window_transform,
)
from sweep.model.detection.sub_bin_interpolation import estimate_sub_bin_offset, interpolator
from sweep.model.effects.catalogue import PARAMETER_DEFAULTS
from sweep.model.geometry.mesh import SurfaceMaterial
from sweep.model.pointcloud.pairing import UNCONFIRMED_FLAG
from sweep.model.pointcloud.point_cloud import simulate_cloud
from sweep.model.sampling import speckle_lines
from sweep.model.waveform import FAR_TARGET_READING, doppler_and_range_beat, range_velocity_of_beats
from sweep.model.window import get_window

PROCESSING = "instrument.processing."
ESTIMATOR = {PROCESSING + "estimator.kind": "maximum_likelihood"}


def slope(table_4_1, angle, *, ratio, **changes):
    """Parameters of a shot on a slope whose up-chirp has so many times the threshold."""
    parameters = {
        "target.range": 300.0, "target.grazing_angle": np.radians(angle),
        "target.radial_velocity": 6.0, "target.reflectance_law": "thesis",
        PROCESSING + "window": "hann", PROCESSING + "tnr": 10.0,
    }  # fmt: skip
    return with_signal_over_threshold(
        PARAMETER_DEFAULTS | table_4_1() | LANDER_PARAMETERS | parameters | changes, ratio
    )


def flown(p, method, draws):
    """Points of a shot that meets a level plane as the facet of the parameters is met."""
    angle, distance = p["target.grazing_angle"], p["target.range"]
    along = np.array([np.cos(angle), 0.0, -np.sin(angle)])
    nearer = np.array([-np.sin(angle), 0.0, -np.cos(angle)])  # towards the facet's near side
    velocity = p["target.radial_velocity"] * along + p["target.transverse_velocity"] * nearer
    shot_eyepoints = observe_shots(
        straight_flight(position=tuple(-distance * along), velocity=tuple(velocity)),
        beams=along[None],
        footprint_full_angles=lambda far: beam.footprint_full_angles(
            p, np.where(np.isfinite(far), far, 1.0)
        ),
    )
    instrument = {path: value for path, value in p.items() if not path.startswith("target.")}
    sun = "target.solar_irradiance"
    return simulate_cloud(
        shot_eyepoints,
        parameters=PARAMETER_DEFAULTS
        | instrument
        | {sun: p[sun], "footprint.speckle": "developed"},
        surfaces=[SurfaceMaterial("ground", p["target.reflectance"], p["target.reflectance_law"])],
        keys=make_point_keys(1),
        draws=draws,
        method=method,
        effects=COMPARED_EFFECTS,
        returns_max=1,
    )


def scatterers_reported(p, draws, seed):
    """Detection of all segments of drawn shots of scatterers, and range and velocity reported."""
    shots = prepare_single_category(p)
    # Points are reported for the start of the shot: what the beam slides until then is corrected.
    resting = replace(point_facet(p, shots), footprint_slide_speed=0.0)
    drawn = draw_shots(p, shots, draws=draws, seed=seed, facet=resting)
    tables = interpolator(shots.window, shots.fft_size)
    places, detected = {}, np.ones(draws, bool)
    for segment, values in drawn.values.items():
        magnitude = np.abs(values[:, 0])
        searched = np.flatnonzero(searched_bins(drawn.mean_power[segment], shots))
        best = searched[magnitude[:, searched].argmax(axis=1)]
        row = np.arange(draws)
        detected &= magnitude[row, best] >= float(shots.threshold[0])
        three = np.stack([magnitude[row, best + k] for k in (-1, 0, 1)], axis=1)
        delta = np.array(
            [
                estimate_sub_bin_offset(below, middle, above, tables)
                for below, middle, above in three
            ]
        )
        places[segment] = drawn.bins[segment][best] + delta
    width = float(np.ravel(shots.sample_rate)[0]) / shots.fft_size
    up, down = (places[segment] * width for segment in ("up", "down"))
    beats = doppler_and_range_beat(FAR_TARGET_READING, up, down, 200e6)
    carrier = 299792458.0 / p["instrument.laser.wavelength"]
    chirp = (p["instrument.chirp.bandwidth"], p["instrument.chirp.duration"])
    distance, velocity = range_velocity_of_beats(*beats, carrier, *chirp)
    return detected, distance[detected], velocity[detected]


# Amplitudes of bins


def fan_of(spread, turn, shape="hann"):
    """Lines of one footprint, and the window, of records as long as their FFT."""
    size = 1024
    transform = speckle_lines.window_transform_table(get_window(shape, size))[1]
    node, weight = speckle_lines._quadrature_tables()
    rule = np.array([[3, 3]])  # of 15 lines along either coordinate
    return speckle_lines.SpeckleLineGrid(
        np.array([spread]), np.array([turn]), rule, np.ones(1, np.int64), node, weight,
        speckle_lines.QUADRATURE_NODE_COUNTS, transform,
        float(speckle_lines.TRANSFORM_SAMPLES_PER_CELL), 6.0, 0,
    )  # fmt: skip


@pytest.mark.parametrize("shape", ["hann", "rectangular", "blackman"])
@pytest.mark.parametrize(
    ("spread", "turn"), [((0.3, -0.3), 0.0), ((0.5, -0.4), 1.2), ((0.0, 0.0), 0.8)]
)
def test_drawn_bins_have_the_mean_power_and_the_correlation_of_the_closed_form(shape, spread, turn):
    number, distance = 20_000, (0.3, -0.2)
    a, b = spread
    fan = fan_of([(a, 0.0), (0.0, 0.0), (b, 0.0)], [(0.0, 0.0), (0.0, 0.0), (turn, 0.0)], shape)
    powers = []
    for segment, expected_beat in ((0, distance[0]), (2, distance[1])):
        middle = np.full(3, np.nan)
        middle[segment] = -expected_beat
        powers.append(
            speckle_lines.draw_segment_bin_amplitudes(
                fan, 0, middle, 0, 1, key=make_point_keys(1)[0], draws=np.arange(number)
            )[:, 0]
        )
    one, other = powers
    for amplitude in powers:
        assert np.mean(np.abs(amplitude) ** 2) == pytest.approx(1.0, abs=5 / np.sqrt(number))
    lines = LinePairGradients(
        tuple(np.array([d]) for d in distance), tuple(np.array([s]) for s in spread),
        np.array([turn]), np.zeros(1),
    )  # fmt: skip
    expected = peak_bin_correlation(get_window(shape, 1024), lines)[0]
    assert abs(np.mean(one * other.conj()).conj() - expected) < 5 / np.sqrt(number)


@pytest.mark.parametrize("shape", ["hann", "rectangular"])
def test_correlations_of_bins_are_the_sums_of_a_fine_grid_of_scatterers(shape):
    """Equation (3) for 60 random footprints at once, up to the last in one call of the kernel.

    One by one they are the same bits, whatever the interval of the one before.
    """
    rng, w = np.random.default_rng(3), get_window(shape, 1024)
    n = 60
    distance, spread = rng.uniform(-0.6, 0.6, (2, n)), rng.uniform(-3, 3, (2, n))
    spread[:, ::2] *= 0.05
    lines = LinePairGradients(
        tuple(distance), tuple(spread), rng.uniform(-2, 2, n), rng.uniform(0, 0.1, n)
    )
    reach = np.minimum(
        5, TRANSFORM_REACH_CELLS / lines.line_shift_max
    )  # no scatterer beyond counts
    y = reach[:, None] * np.linspace(-1, 1, 20_001)
    first, second = (
        window_transform(w, d[:, None] - s[:, None] * y)
        for d, s in zip(distance, spread, strict=True)
    )
    power = np.exp(-0.5 * y * y) * np.maximum(1 + lines.relative_power_gradient[:, None] * y, 0.0)
    shared = (power * first * second * np.exp(1j * lines.phase_difference[:, None] * y)).sum(axis=1)
    strength = (power * first**2).sum(axis=1) * (power * second**2).sum(axis=1)
    together = peak_bin_correlation(w, lines)
    np.testing.assert_allclose(together, shared / np.sqrt(strength), rtol=0, atol=2e-4)
    single = [peak_bin_correlation(w, lines.select(np.array([i])))[0] for i in range(n)]
    np.testing.assert_array_equal(together, single)


@pytest.mark.parametrize("turn", [0.0, 0.4, 1.5])
@pytest.mark.parametrize("share", [1.0, 0.6])
def test_places_of_two_segments_wander_together_as_their_closed_form_says(turn, share):
    """Mean products of drawn ratios over those that are stated by amplitudes' sizes."""
    rng, number, level = np.random.default_rng(7), 400_000, 0.2
    lines, weight = np.polynomial.hermite_e.hermegauss(21)
    weight = np.sqrt(weight / weight.sum())
    b = np.array([0.1, -0.07])

    def normal(*shape):
        return (rng.normal(size=shape) + 1j * rng.normal(size=shape)) / np.sqrt(2)

    amplitude = normal(number, 21) * weight
    phases = np.exp(1j * np.array([0.0, turn])[:, None] * lines)
    echo = np.sqrt(share) * (amplitude @ phases.T)
    moment = np.sqrt(share) * (amplitude @ (phases * lines).T)
    total = echo + np.sqrt(1 - share) * normal(number, 2)
    power = np.abs(total) ** 2
    both_detected = (power > level).all(axis=1)
    wander = (b * (moment / total).real)[both_detected]
    footprints = speckle_lines.LineGradients(
        np.tile([[b[0], 0.0], [0.0, 0.0], [b[1], 0.0]], (both_detected.sum(), 1, 1)),
        np.tile([[0.0, 0.0], [0.0, 0.0], [turn, 0.0]], (both_detected.sum(), 1, 1)),
    )
    shares = np.full((2, both_detected.sum()), share)
    stated_covariance = speckle_lines.wander_covariance(
        footprints, (0, 2), power[both_detected].T, shares
    )
    product = wander[:, 0] * wander[:, 1]
    error = product.std() / np.sqrt(product.size)
    assert abs(product.mean() - stated_covariance.mean()) < 5 * error
    for k in range(2):  # of one segment alone, whatever the other's amplitude
        is_detected = power[:, k] > level
        offsets = b[k] * (moment[is_detected, k] / total[is_detected, k]).real
        stated_alone = b[k] ** 2 * share / (2 * power[is_detected, k])
        assert (offsets**2).mean() == pytest.approx(stated_alone.mean(), rel=0.02)


# Points


CASES = {
    "steep": (5, {}),
    "slope": (10, {}),
    "half way": (30, {}),
    "sliding": (30, {"target.transverse_velocity": 30.0}),
    "from above, sliding": (90, {"target.transverse_velocity": 60.0}),
}


@pytest.mark.parametrize(("case", "rule"), parametrize_product(3, CASES, ["peak_bin", "any_bin"]))
def test_places_wander_as_those_of_scatterers(case, rule, table_4_1):
    angle, changes = CASES[case]
    p = slope(table_4_1, angle, ratio=10.0, **{PROCESSING + "detection": rule}, **changes)
    draws = 5000
    _, *truth = scatterers_reported(p, draws, seed=angle)
    for method in ("probabilities", "noise"):
        cloud = flown(p, method, draws)
        true = cloud["flags"][0, :, 0] == 1
        for name, drawn in zip(("range", "radial_velocity"), truth, strict=True):
            points = cloud[f"{name}_interpolated"][0, true, 0]
            # Of middle halves, which few large excursions do not move.
            one, other = (np.subtract(*np.quantile(x, [0.84, 0.16])) for x in (points, drawn))
            assert one / other == pytest.approx(1.0, abs=0.12), (method, name)
            assert abs(np.median(points) - np.median(drawn)) < 0.15 * abs(other)


@pytest.mark.parametrize(
    ("angle", "rule", "method"),
    parametrize_product(
        5, [5, 7, 10, 20, 30, 60, 90], ["peak_bin", "any_bin"], ["probabilities", "noise"]
    ),
)
def test_points_on_slopes_are_as_good_as_they_say(angle, rule, method, table_4_1):
    """Standard deviations of scores over draws of detected, confirmed points.

    Errors of velocity are stated some 17 % too large for any bin at 5 degrees.
    """
    p = slope(table_4_1, angle, ratio=10.0, **{PROCESSING + "detection": rule})
    points = flown(p, method, 3000)
    true = points["flags"][0, :, 0] == 1
    most_of_velocity = 0.2 if (angle, rule) == (5, "any_bin") else 0.13
    for name, deviation_max in (("range", 0.1), ("radial_velocity", most_of_velocity)):
        error = (points[f"{name}_interpolated"] - points[f"true_{name}"])[0, true, 0]
        scores = error / points[f"{name}_interpolated_standard_error"][0, true, 0]
        assert scores.std() == pytest.approx(1.0, abs=deviation_max), name


def test_errors_of_whole_spectra_on_slopes_are_those_of_the_other_methods(table_4_1):
    """By three bins' error; an estimator that sees all samples is better without a slope.

    It takes the window's effect on the record back, and so sees the speckle in all bins.
    """
    p = slope(table_4_1, 10, ratio=10.0, **ESTIMATOR, **{PROCESSING + "detection": "any_bin"})
    points = flown(p, "spectra", 500)
    true = points["flags"][0, :, 0] == 1
    for name in ("range", "radial_velocity"):
        error = (points[f"{name}_interpolated"] - points[f"true_{name}"])[0, true, 0]
        scores = error / points[f"{name}_interpolated_standard_error"][0, true, 0]
        assert scores.std() == pytest.approx(1.0, abs=0.1 + 5 / np.sqrt(2 * true.sum())), name
        assert abs(scores.mean()) < 0.25, name


def test_three_segments_of_a_shot_are_detected_together(table_4_1):
    """Up and down without Doppler are rare, as all see much the same speckle."""
    p = slope(table_4_1, 60, ratio=1.3, **{PROCESSING + "tnr": 10.0})
    shots, draws = prepare_single_category(p), 8000
    detected, _, _ = scatterers_reported(p, draws, seed=3)
    error = np.sqrt(detected.mean() * (1 - detected.mean()) / draws)
    assert shots.detection_settings.echo_bin_rule == "peak_bin"
    for method in ("probabilities", "noise"):
        points = flown(p, method, draws)
        flags = points["flags"][0, :, 0]
        confirmed = (flags > 0) & (flags & UNCONFIRMED_FLAG == 0)
        assert abs(confirmed.mean() - detected.mean()) < 4 * np.sqrt(2) * error
        unconfirmed = (flags > 0) & (flags & UNCONFIRMED_FLAG > 0)
        pair = float(points["pd_shot"][0])
        assert abs((confirmed | unconfirmed).mean() - pair) < 4 * np.sqrt(pair * (1 - pair) / draws)
        assert unconfirmed.mean() < 0.3 * (pair * (1 - float(points["pd_doppler"][0])))
        # Read as a far target, and not as a fast one.
        assert np.nanmax(np.abs(points["range_interpolated"][0, :, 0] - 300.0)) < 1.0


def shot_at_random(table_4_1, number):
    rng = np.random.default_rng(1000 + number)
    changes = {
        PROCESSING + "window": str(rng.choice(["hann", "hamming", "blackman"])),
        PROCESSING + "detection": str(rng.choice(["peak_bin", "any_bin"])),
        "target.range": float(rng.uniform(100, 500)),
        "target.radial_velocity": float(rng.uniform(4, 12)),
        "target.transverse_velocity": float(rng.uniform(-20, 20)),
        "instrument.chirp.bandwidth": float(rng.uniform(0.5e9, 2e9)),
        PROCESSING + "tnr": float(rng.uniform(7, 12)),
        **(
            {"instrument.looks.number": int(rng.choice([2, 4])),
             "instrument.looks.speckle": str(rng.choice(["common", "independent"]))}
            if number % 4 == 3 else {}
        ),
    }  # fmt: skip
    return slope(table_4_1, rng.uniform(12, 90), ratio=float(rng.uniform(0.8, 3.0)), **changes)


@pytest.mark.parametrize("number", parametrize_product(5, range(24)))
def test_methods_agree_on_how_often_what_is_detected(number, table_4_1):
    p, draws = shot_at_random(table_4_1, number), 6000
    shares = {}
    methods = ["probabilities", "noise", "spectra"]
    several = p.get("instrument.looks.number", 1) > 1
    for method in methods:
        if (several and method == "noise") or (method == "spectra" and number % 3):
            continue
        points = flown(p, method, draws if method != "spectra" else 400)
        flags = points["flags"][0, :, 0]
        is_point = flags > 0
        confirmed = is_point & (flags & UNCONFIRMED_FLAG == 0)
        shares[method] = np.array([is_point.mean(), confirmed.mean(), (flags == 1).mean()])
        pair, count = float(points["pd_shot"][0]), is_point.size
        # any_bin has no closed form of both chirps; spectra find a neighbour of the peak as well.
        slack = 0.012 if p[PROCESSING + "detection"] == "any_bin" else 0.0
        slack = max(slack, 0.03) if method == "spectra" else slack
        alarms = float(points["pfa_up"][0] + points["pfa_down"][0])
        assert abs(is_point.mean() - pair) < 5 * np.sqrt(pair * (1 - pair) / count) + slack + alarms
    one = shares["probabilities"]
    for method, other in shares.items():
        count = draws if method != "spectra" else 400
        allowed = 5 * np.sqrt(one * (1 - one) * (1 / draws + 1 / count) + 1e-9)
        slack = 0.012 if method != "spectra" else 0.03
        assert (np.abs(one - other) < allowed + slack).all(), (method, one, other)
