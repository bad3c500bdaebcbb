"""Plans on the model itself: no effect changes more than its size, what is left out no more than
the tolerance."""

from functools import partial

import numpy as np
import pytest
from random_planner_points import (
    effects_kept_in_tile,
    find_spectra,
    plan_points,
    planner_inputs,
    prepare_single_category,
    random_parameters,
)

from sweep.model import evaluation
from sweep.model.effects.catalogue import DEFAULT_EFFECTS, EFFECTS, PARAMETER_DEFAULTS
from sweep.model.evaluation import evaluate_segments, prepare_ray_traced_shots
from sweep.model.ground import BeamletTable, RayTracedGround, ray_traced_footprint_extent
from sweep.spec.sections import parameter_rules

POINTS = 30
CHOICE = [effect for effect in EFFECTS if effect.name in DEFAULT_EFFECTS]
WITHIN = {effect.name: effect.parent for effect in CHOICE}
KINDS = (
    {"phases": "incoherent"},
    {"phases": "coherent"},
    {"phases": "coherent", "range": np.linspace(0.5, 9.0, POINTS), "beam_divergence": 2e-5},
    {"phases": "coherent", "beamlets": 1},
    {"architecture": "direct", "power": np.geomspace(1, 1e5, POINTS)},
    {"architecture": "direct", "range": np.linspace(1, 30, POINTS), "power": 1e-2},
    {"architecture": "heterodyne", "phases": "coherent"},
    {"range": np.geomspace(0.3, 8.0, POINTS), "grazing_angle": 1.2},
    {"beamlets": 0},
    {"coupling": "single_mode", "range": np.geomspace(3.0, 3000.0, POINTS)},
)
ROUNDING = 1e-8
STILL = {"doppler": "off"}
"""Without it lines lie elsewhere: near DC for the Doppler segment."""


def random_effects(rng, name):
    """Any of the other effects, with what they need, but for those within this one."""
    chosen = {n for n in DEFAULT_EFFECTS if n != name and rng.random() < 0.6}
    chosen -= {n for n in DEFAULT_EFFECTS if name and WITHIN[n] == name}
    return {n for n in chosen if not WITHIN[n] or WITHIN[n] in chosen} | {WITHIN.get(name, "")} - {
        ""
    }


def counted(parameters, seed):
    """Some number of beamlets where it is left open, one for all points: plans hold for any."""
    if parameters["footprint.beamlets"] > 0:
        return parameters
    return parameters | {
        "footprint.beamlets": [2, 5, 33, 163][seed % 4], "footprint.pattern": "line",
    }  # fmt: skip


def pd_change(on, without_effect):
    """Sum over segments of what pd changes by; direct detection has two of them."""
    return np.nansum(abs(on.pd - without_effect.pd), axis=0)


def magnitudes_moved(on, without_effect, sigma):
    """Largest change of a segment's |X|, in relation to it or to sigma if that is larger."""
    return np.nanmax(
        abs(on.magnitude - without_effect.magnitude) / np.maximum(without_effect.magnitude, sigma),
        axis=0,
    )


@pytest.mark.parametrize(
    "kind",
    [pytest.param(k, marks=[pytest.mark.slow] * (k in (2, 5, 7))) for k in range(len(KINDS))],
)
def test_no_effect_changes_more_than_its_size_whatever_else_there_is(table_4_1, kind):
    noticed = 0
    for seed in range(3):
        rng = np.random.default_rng((seed, kind))
        parameters = random_parameters(
            table_4_1, POINTS, seed, fft_size=2**13, bins_counted="all",
            **{"beamlets": 7} | KINDS[kind],
        )  # fmt: skip
        inner = counted(parameters, seed)
        moving, at_rest = (
            plan_points(planner_inputs(parameters), modes, 1.0, CHOICE).omission_error
            for modes in ({}, STILL)
        )
        for name in DEFAULT_EFFECTS:
            other_effects = random_effects(rng, name)
            changes = moving if "doppler" in other_effects | {name} else at_rest
            bounds = dict(zip(DEFAULT_EFFECTS, changes, strict=True))
            on, without_effect = (
                find_spectra(inner, other_effects | {name}),
                find_spectra(inner, other_effects),
            )
            assert (
                np.minimum(pd_change(on, without_effect), 1) <= bounds[name] + ROUNDING
            ).all(), (name, other_effects)
            moved = magnitudes_moved(
                on, without_effect, prepare_single_category(inner, other_effects).bin_noise_sigma
            )
            assert (np.minimum(moved, 1) <= bounds[name] + ROUNDING).all(), (name, other_effects)
            if name == "leakage":
                extra = np.nansum(on.leakage_probability, axis=0)
                assert (np.minimum(extra, 1) <= bounds[name] * (1 + 1e-9) + 1e-12).all()
            if name == "signal_shot_noise":
                statistics = [
                    evaluation.shot_statistics(prepare_single_category(inner, e))
                    for e in (other_effects | {name}, other_effects)
                ]
                for alarm in ("pfa_segment", "log10_pfa_segment", "log10_pfa_shot"):
                    moved = abs(statistics[0][alarm] - statistics[1][alarm])
                    assert (np.minimum(moved, 1) <= bounds[name] + ROUNDING).all()
            noticed += (bounds[name] < 1).sum()
    assert noticed > 250


def sizes_of_many(rng, low, high):
    return rng.choice([-1, 1], POINTS) * 10 ** rng.uniform(low, high, POINTS)


def values_of_parameters(effect, rng=None):
    """Values that bring an effect, from its parameters: the last option, or the example.

    With random numbers an example is scaled by 1e-3 to 10 at each point, with both signs where
    the limits have them.
    """
    values = {}
    for parameter in effect.parameters:
        rule = parameter_rules()[parameter.path]
        if parameter.options or parameter.is_table:
            values[parameter.path] = [parameter.default, *parameter.options][-1]
            continue
        value = float(rule.read(parameter.example))
        if rng is not None and parameter.enables_effect:
            low, high = (
                float(rule.read(limit)) if limit else default
                for limit, default in zip(parameter.limits, (0.0, np.inf), strict=True)
            )
            n_values = 1 if parameter.is_category_key else POINTS
            scale = 10 ** rng.uniform(-3, 1, n_values)
            if low < 0:
                scale *= rng.choice([-1, 1], n_values)
            value = np.clip(scale * value, low, high)
            value = float(value[0]) if parameter.is_category_key else value
        values[parameter.path] = value
    return values


FURTHER_OVERRIDES = {
    "segment_motion": lambda rng: {
        "target.acceleration": sizes_of_many(rng, -9, 2),
        "target.radial_velocity": sizes_of_many(rng, -9, 1),
        "target.transverse_velocity": sizes_of_many(rng, -9, 1),
    },
    "acceleration": lambda rng: {"target.acceleration": sizes_of_many(rng, -3, 3)},
    "chirp_nonlinearity": lambda rng: {
        "instrument.chirp.quadratic_error": sizes_of_many(rng, 1, 5),
        "instrument.chirp.cubic_error": sizes_of_many(rng, 1, 5),
        "instrument.chirp.sinusoidal_error": sizes_of_many(rng, 1, 4.5),
        "instrument.chirp.error_periods": 10 ** rng.uniform(-0.5, 1, POINTS),
    },
    "line_width": lambda rng: {
        "instrument.laser.line_width": 10 ** rng.uniform(0, 4.5, POINTS),
        "instrument.laser.line_shape": str(rng.choice(["gaussian", "lorentzian"])),
    },
    "extinction": lambda rng: {
        "atmosphere.profile": "exponential",
        "atmosphere.extinction": float(10 ** rng.uniform(-8, -3)),
    },
    "lag": lambda rng: {
        "instrument.telescope.coupling": "single_mode",
        "instrument.telescope.misalignment": sizes_of_many(rng, -7, -4),
    },
    "saturation": lambda rng: {
        "instrument.processing.full_scale": 10 ** rng.uniform(-3, 0, POINTS)
    },
}
"""Parameters of effects that bring them better than the examples in their own parameters do."""

OF_OTHER_SCENES = {"rotation", "iq_imbalance", "fading"}
"""Effects that need a turning body, a complex record or developed speckle, with tests of their
own."""
FURTHER = [
    effect for effect in EFFECTS
    if not effect.is_random and effect.stage != "noise"
    and effect.name not in OF_OTHER_SCENES.union(DEFAULT_EFFECTS)
]  # fmt: skip
"""Effects that are not at hand in every scene."""


@pytest.mark.parametrize("kind", [0, 1, 3, 4])
@pytest.mark.parametrize("effect", FURTHER, ids=lambda effect: effect.name)
def test_no_further_effect_changes_more_than_its_size(table_4_1, kind, effect):
    noticed, name = 0, effect.name
    override = FURTHER_OVERRIDES.get(name, partial(values_of_parameters, effect))
    for seed in range(4):
        rng = np.random.default_rng((seed, kind, 5))
        slow = rng.choice([-1, 1], POINTS) * 10 ** rng.uniform(-2, 2.5, POINTS)
        parameters = random_parameters(
            table_4_1, POINTS, seed, fft_size=2**13, bins_counted="all",
            **{"beamlets": 7, "radial_velocity": slow} | KINDS[kind],
        ) | override(rng)  # fmt: skip
        other_effects = (
            random_effects(rng, "") | {"doppler"} | ({"range_walk"} if seed % 2 else set())
        )
        other_effects = (other_effects | ({"overlap"} if seed > 1 else set())) - {name}
        plan = plan_points(planner_inputs(parameters), {}, 1.0)
        bound = plan.omission_error[plan.effect_names.index(name)]
        on, without_effect = (
            find_spectra(parameters, other_effects | {name}),
            find_spectra(parameters, other_effects),
        )
        assert (np.minimum(pd_change(on, without_effect), 1) <= bound + ROUNDING).all()
        moved = magnitudes_moved(
            on, without_effect, prepare_single_category(parameters, other_effects).bin_noise_sigma
        )
        assert (np.minimum(moved, 1) <= bound + ROUNDING).all()
        noticed += (bound < 1).sum()
    assert noticed > 10


@pytest.mark.parametrize("kind", range(len(KINDS)))
def test_a_large_loss_changes_pd_no_more_than_its_size(table_4_1, kind):
    """The size is the threshold's slope times the change of ln |X|, which exceeds that of |X|."""
    noticed = 0
    for extinction in np.geomspace(1e-6, 1e-3, 12).tolist():
        parameters = random_parameters(
            table_4_1, POINTS, 3, fft_size=2**13, bins_counted="all",
            **{"beamlets": 7} | KINDS[kind],
        )  # fmt: skip
        parameters |= {"atmosphere.profile": "exponential", "atmosphere.extinction": extinction}
        plan = plan_points(planner_inputs(parameters), {}, 1.0)
        bound = plan.omission_error[plan.effect_names.index("extinction")]
        on, without_effect = (
            find_spectra(parameters, {"doppler"} | also) for also in ({"extinction"}, set())
        )
        assert (np.minimum(pd_change(on, without_effect), 1) <= bound + ROUNDING).all()
        noticed += (bound < 1).sum()
    assert noticed > 10


@pytest.mark.parametrize("kind", range(len(KINDS)))
@pytest.mark.parametrize("tolerance", [1e-4, 1e-2, 0.3])
def test_pd_of_what_is_kept_is_within_the_tolerance(table_4_1, kind, tolerance):
    n_kept = dropped = 0
    for seed in range(2):
        parameters = random_parameters(
            table_4_1, POINTS, seed, fft_size=2**13, **{"beamlets": 19} | KINDS[kind]
        )
        plan = plan_points(planner_inputs(parameters), {}, tolerance, CHOICE)
        inner = counted(parameters, seed)
        truth = evaluation.evaluate(inner)
        assert (plan.total_error <= tolerance).all()
        for column in np.unique(plan.is_kept, axis=1).T:
            names = [
                name for name, is_kept in zip(plan.effect_names, column, strict=True) if is_kept
            ]
            points = (plan.is_kept == column[:, None]).all(axis=0)
            of_kept = evaluation.evaluate(inner, names)
            error = abs(of_kept["pd_shot"] - truth["pd_shot"])[points]
            assert (error <= tolerance + ROUNDING).all(), names
            complete, part = (
                prepare_single_category(inner, DEFAULT_EFFECTS),
                prepare_single_category(inner, names),
            )
            moved = magnitudes_moved(
                evaluate_segments(complete), evaluate_segments(part), part.bin_noise_sigma
            )
            assert (moved[points] <= np.expm1(tolerance) + ROUNDING).all(), names
            if "leakage" not in names:
                extra = truth["p_leakage_up"] + truth["p_leakage_down"]
                assert (extra[points] <= tolerance).all()
        n_kept, dropped = n_kept + plan.is_kept.sum(), dropped + (~plan.is_kept).sum()
    assert n_kept > 30 and dropped > 30


def cast_scene(rng, shots, beamlets, beside_chance):
    """Footprints on steps: offsets, closing speeds and echoes as rays might find them."""
    surface = rng.random((shots, beamlets)) < beside_chance * rng.random((shots, 1))
    surface[:, 0] = False
    spread = 10 ** rng.uniform(-7, -3, (shots, 1))
    offset = rng.normal(0, 1, (shots, beamlets)) * spread
    offset += np.where(surface, 10 ** rng.uniform(-4, -1, (shots, 1)), 0.0)
    offset[:, 0] = 0.0
    doppler = rng.normal(0, 1, (shots, beamlets)) * 10 ** rng.uniform(-12, -8, (shots, 1))
    doppler[:, 0] = 0.0
    echo = rng.random((shots, beamlets)) / beamlets / 6
    footprints = BeamletTable(np.arange(shots), offset, doppler, echo)
    return footprints, surface if beside_chance else None


@pytest.mark.parametrize("phases", ["incoherent", "coherent"])
@pytest.mark.parametrize("stretch", [1, 5])
def test_sizes_and_plans_hold_for_footprints_that_rays_find(table_4_1, phases, stretch):
    n_kept = dropped = 0
    for seed in range(4):
        rng = np.random.default_rng((seed, stretch))
        chance = [0.0, 0.3][seed % 2]
        footprints, other_footprints = cast_scene(rng, POINTS, 7, chance)
        order = np.sort(10 ** rng.uniform(0.5, 3, POINTS))
        parameters = PARAMETER_DEFAULTS | table_4_1(
            range=order, radial_velocity=np.sort(rng.normal(0, 30, POINTS)), beamlets=7,
            fft_size=2**13, phases=phases, power=10 ** rng.uniform(-3, 0), window="hann",
        )  # fmt: skip
        edges = np.arange(0, POINTS + 1, stretch)
        tile = np.repeat(np.arange(len(edges) - 1), stretch)
        ground = RayTracedGround(footprints, other_footprints)
        plan, at_rest = (
            plan_points(
                planner_inputs(parameters, ray_traced_footprint_extent(ground)),
                modes,
                0.05,
                CHOICE,
                edges,
            )
            for modes in ({}, STILL)
        )
        for place, name in enumerate(DEFAULT_EFFECTS):
            other_effects = random_effects(rng, name)
            changes = (plan if "doppler" in other_effects | {name} else at_rest).omission_error
            bound = changes[place, tile]
            on, without_effect = (
                evaluate_segments(prepare_ray_traced_shots(parameters, ground, e))
                for e in (other_effects | {name}, other_effects)
            )
            assert (np.minimum(pd_change(on, without_effect), 1) <= bound + ROUNDING).all(), (
                name,
                other_effects,
            )
        truth = evaluate_segments(prepare_ray_traced_shots(parameters, ground))
        for i in range(len(edges) - 1):
            of_kept = evaluate_segments(
                prepare_ray_traced_shots(parameters, ground, effects_kept_in_tile(plan, i))
            )
            error = abs(of_kept.pd[0] * of_kept.pd[2] - truth.pd[0] * truth.pd[2])
            assert (error[tile == i] <= 0.05 + ROUNDING).all()
        has_beside = plan.omission_error[DEFAULT_EFFECTS.index("several_returns")].any()
        assert has_beside == (other_footprints is not None)
        n_kept, dropped = n_kept + plan.is_kept.sum(), dropped + (~plan.is_kept).sum()
    assert n_kept > 30 and dropped > 30


def test_a_scene_calls_for_rotation_where_bodies_turn(table_4_1):
    footprints, _ = cast_scene(np.random.default_rng(1), 4, 7, 0.0)
    parameters = PARAMETER_DEFAULTS | table_4_1(beamlets=7, range=np.full(4, 100.0))
    extent = ray_traced_footprint_extent(RayTracedGround(footprints))
    turning, at_rest = (
        plan_points(planner_inputs(parameters, extent, has_rotating_body=turns), {}, 0.5,
                [effect for effect in EFFECTS if effect.name == "rotation"])
        for turns in (True, False)
    )  # fmt: skip
    assert turning.is_kept.all() and not at_rest.is_kept.any() and not at_rest.total_error.any()


STRONG_NOISE = {
    effect.name: values_of_parameters(effect) for effect in EFFECTS if effect.stage == "noise"
} | {
    "solar_background": {
        "target.solar_irradiance": 1e13, "instrument.receiver.optical_passband": 1e-8,
        "instrument.receiver.field_of_view": 1e-2,
    },
    "backscatter": {"atmosphere.extinction": 1e-3, "atmosphere.lidar_ratio": 30.0},
    "relative_intensity_noise": {"instrument.laser.relative_intensity_noise": 1e-12},
    "spontaneous_emission": {
        "instrument.laser.spontaneous_emission": 100.0, "instrument.telescope.isolation": 1e2,
    },
    "circulator_leak": {
        "instrument.telescope.leak_path": 2.0, "instrument.telescope.isolation": 1e3,
        "instrument.laser.relative_intensity_noise": 1e-13,
    },
    "quantisation": {"instrument.processing.bits": 2.0},
}  # fmt: skip
"""Parameters of each effect that adds noise, so that it has much of it; else its examples."""


def test_effects_with_parameters_of_their_own_are_there():
    names = {effect.name for effect in EFFECTS}
    assert set(STRONG_NOISE) == {effect.name for effect in EFFECTS if effect.stage == "noise"}
    assert set(FURTHER_OVERRIDES) <= {effect.name for effect in FURTHER}
    assert names >= OF_OTHER_SCENES


@pytest.mark.parametrize("name", STRONG_NOISE)
def test_noise_of_any_source_that_saturates_an_adc_is_in_the_bound_of_saturation(table_4_1, name):
    """Full scale is 1.5 to 5 deviations of all noise: what it clips, it clips by that source."""
    parameters = random_parameters(
        table_4_1, POINTS, 3, fft_size=2**13, bins_counted="all", beamlets=7,
        range=np.geomspace(100.0, 5000.0, POINTS), window="hann",
    ) | STRONG_NOISE[name]  # fmt: skip
    parameters["instrument.processing.full_scale"] = 1.0
    for _ in range(3):  # the steps of an ADC follow its full scale
        deviation = np.sqrt(prepare_single_category(parameters, {name}).noise_variance)
        parameters["instrument.processing.full_scale"] = deviation * np.geomspace(1.5, 5, POINTS)
    plan = plan_points(planner_inputs(parameters), {}, 1.0)
    bound = plan.omission_error[plan.effect_names.index("saturation")]
    on, without_effect = (
        find_spectra(parameters, {name, "saturation"}),
        find_spectra(parameters, {name}),
    )
    moved = magnitudes_moved(
        on, without_effect, prepare_single_category(parameters, {name}).bin_noise_sigma
    )
    assert (np.minimum(moved, 1) <= bound + ROUNDING).all()
    assert (np.minimum(pd_change(on, without_effect), 1) <= bound + ROUNDING).all()
    assert moved.max() > 1e-3


@pytest.mark.parametrize("antialias", [0.0, 60e6])
def test_steps_of_an_adc_are_compared_with_the_noise_that_filters_leave_at_the_line(
    table_4_1, antialias
):
    """Lines lie at up to half the sample rate, far beyond the poles of the receiver."""
    parameters = random_parameters(
        table_4_1, POINTS, 5, fft_size=2**13, bins_counted="all", beamlets=1, window="hann",
        range=np.linspace(300.0, 20e3, POINTS), power=np.geomspace(1e-2, 1e4, POINTS),
        sample_rate=600e6, duration=500e-6,
    ) | {
        "instrument.receiver.noise_shape": "receiver",
        "instrument.receiver.detector_bandwidth": 20e6,
        "instrument.receiver.amplifier_bandwidth": 20e6,
        "instrument.receiver.antialias_bandwidth": antialias,
        "instrument.processing.bits": 6.0, "instrument.processing.full_scale": 1.0,
    }  # fmt: skip
    other_effects = {"doppler"}
    deviation = np.sqrt(prepare_single_category(parameters, other_effects).noise_variance)
    parameters["instrument.processing.full_scale"] = deviation * np.geomspace(1, 100, POINTS)
    plan = plan_points(planner_inputs(parameters), {}, 1.0)
    bound = plan.omission_error[plan.effect_names.index("quantisation")]
    on, without_effect = (
        find_spectra(parameters, other_effects | {"quantisation"}),
        find_spectra(parameters, other_effects),
    )
    assert (np.minimum(pd_change(on, without_effect), 1) <= bound + ROUNDING).all()
    moved = magnitudes_moved(
        on, without_effect, prepare_single_category(parameters, other_effects).bin_noise_sigma
    )
    assert (np.minimum(moved, 1) <= bound + ROUNDING).all()
    assert (bound < 1).any() and pd_change(on, without_effect).max() > 1e-3 and moved.max() > 1e-3
