"""What a scene does not call for is not computed: nodes of the chain and calls are counted."""

from collections import Counter

import numpy as np
import pytest
from small_studies import STUDY_MAPPING, small_spec

from sweep.model import beamlets
from sweep.model.effects import atmosphere, scintillation
from sweep.model.effects.catalogue import EFFECT_NAMES, EFFECTS, effect_names_in_flags
from sweep.model.evaluation import prepare_shots, select_effects
from sweep.model.spectrum import line_shape
from sweep.tasks.studies.grid_study import GridStudy

AIR = {"extinction", "backscatter", "scintillation"}
MOON = {"instrument.laser.power": ["1 W", "3 W"], "target.range": {"linear": ["1 km", "5 km"],
        "number": 40}, "target.grazing_angle": ["30 deg", "60 deg"]}  # fmt: skip


@pytest.fixture
def calls(monkeypatch):
    """How often effects act and some of their inner functions run, by name."""
    counted = Counter()

    def watch(owner, name, label):
        original = getattr(owner, name)

        def counting(*arguments, **keywords):
            counted[label] += 1
            return original(*arguments, **keywords)

        # effects are frozen: what is compared is their functions, not they themselves
        object.__setattr__(owner, name, counting) if owner in EFFECTS else monkeypatch.setattr(
            owner, name, counting
        )
        return original

    acts = [(effect, watch(effect, "apply", effect.name)) for effect in EFFECTS if effect.apply]
    watch(beamlets, "plane_footprint", "plane_footprint")
    watch(atmosphere, "optical_depth", "optical_depth")
    watch(scintillation, "rytov_variance", "rytov_variance")
    watch(line_shape, "decompose_phase_errors", "decompose_phase_errors")
    yield counted
    for effect, original in acts:
        object.__setattr__(effect, "apply", original)


def evaluated(spec):
    """Effects that any point of a study calls for, by computing all of it."""
    study = GridStudy(spec)
    flags = [study.evaluate(block)["effects"].ravel() for block in range(study.n_blocks)]
    return {
        name
        for flag in np.unique(np.concatenate(flags))
        for name in effect_names_in_flags(int(flag))
    }


def test_over_the_moon_there_is_no_air(calls):
    called = evaluated(small_spec(axes=MOON))
    assert "doppler" in called and not AIR & called
    assert calls["doppler"] > 0 and not any(calls[name] for name in AIR)
    assert calls["optical_depth"] == calls["rytov_variance"] == 0


def test_over_mars_there_is(calls):
    called = evaluated(small_spec(axes=MOON, atmosphere={"profile": "mars_storm"}))
    assert "extinction" in called and "scintillation" not in called
    assert calls["extinction"] > 0 and calls["optical_depth"] > 0 and calls["rytov_variance"] == 0


def test_a_hovering_lidar_sees_no_doppler_shift(calls):
    target = {"range": "2 km", "grazing_angle": "60 deg", "reflectance": 0.02}
    called = evaluated(small_spec(axes=MOON, target=target, effects={"overlap": "off"}))
    assert not {"doppler", "doppler_spread", "range_walk", "acceleration"} & called
    assert calls["doppler"] == calls["range_walk"] == calls["decompose_phase_errors"] == 0


def test_straight_down_from_near_a_footprint_is_one_line_and_not_109(calls):
    near = {"range": "20 m", "grazing_angle": "90 deg", "reflectance": 0.02}
    spec = small_spec(
        axes={"target.range": {"linear": ["15 m", "25 m"], "number": 40}},
        target=near,
        footprint={"beamlets": 109, "speckle": "none"},
    )
    called = evaluated(spec)
    assert "footprint" not in called and calls["plane_footprint"] == 0
    ((_, one),) = prepare_shots(spec.parameters(), called)
    ((_, every),) = prepare_shots(spec.parameters(), {*called, "footprint"})
    assert one.footprint.relative_range_offset.shape == (
        1,
        1,
    ) and every.footprint.relative_range_offset.shape == (
        1,
        109,
    )


def test_nodes_of_a_chain_are_its_effects_and_no_more():
    assert select_effects(()) == ()
    assert [node.name for node in select_effects({"leakage", "footprint"})] == [
        "footprint",
        "leakage",
    ]
    assert tuple(node.name for node in select_effects(EFFECT_NAMES)) == EFFECT_NAMES
    with pytest.raises(ValueError, match="no effect wind: choose from footprint"):
        select_effects({"wind"})


def test_what_spreads_beamlets_does_nothing_where_there_are_none():
    spec = small_spec(
        axes={},
        target={
            "range": "2 km",
            "grazing_angle": "60 deg",
            "reflectance": 0.1,
            "transverse_velocity": "100 m/s",
        },
    )
    ((_, without_footprint),) = prepare_shots(
        spec.parameters(), {"doppler_spread", "several_returns"}
    )
    ((_, with_footprint),) = prepare_shots(spec.parameters(), {"footprint", "doppler_spread"})
    assert (
        without_footprint.footprint.doppler_ratio_offset.shape == (1, 1)
        and not without_footprint.footprint.doppler_ratio_offset.any()
    )
    assert with_footprint.footprint.doppler_ratio_offset.shape == (1, 9)
    assert with_footprint.footprint.doppler_ratio_offset.any()


def test_bare_shots_hold_nothing_of_any_effect():
    spec = small_spec(axes={})
    ((_, bare),) = prepare_shots(spec.parameters(), ())
    assert (
        bare.footprint.relative_range_offset.shape == (1, 1)
        and bare.footprint.phase_cycles.size == 0
        and bare.motion.doppler_ratio == 0.0
    )
    assert bare.echo_record.phase_errors == () and bare.laser_line.gaussian_fwhm is None
    assert (
        not bare.line_images.are_summed
        and not bare.detection_settings.leakage_raises_false_alarms
        and bare.footprint.adds_powers
    )
    assert set(bare.noise.variances) == {"local_oscillator_shot", "detector", "amplifier"}


def test_forced_effects_without_their_parameters_are_not_in_the_graph(calls):
    """Line widths, accelerations and chirp errors of 0: alone, and beside points that have some."""
    names = ("line_width", "acceleration", "chirp_nonlinearity", "quantisation")
    forced = small_spec(axes=MOON, effects=dict.fromkeys(names, "on"))
    assert not evaluated(forced) & set(names)
    assert calls["line_width"] == calls["acceleration"] == calls["chirp_nonlinearity"] == 0
    axes = {"target.acceleration": ["0 m/s^2", "1 m/s^2"]}
    flags = GridStudy(small_spec(axes=axes, effects={"acceleration": "on"})).evaluate(0)["effects"]
    assert [bool(flag >> EFFECT_NAMES.index("acceleration") & 1) for flag in flags] == [False, True]


@pytest.mark.parametrize("tolerance", [0.0, 1e-3])
def test_noise_that_is_there_is_in_the_snr_whatever_pd_is(tolerance):
    laser = STUDY_MAPPING["instrument"]["laser"] | {"relative_intensity_noise": "1e-12 1/Hz"}
    receiver = STUDY_MAPPING["instrument"]["receiver"] | {"common_mode_rejection": "20 dB"}
    instrument = STUDY_MAPPING["instrument"] | {"laser": laser, "receiver": receiver}
    near = {"axes": {}, "target": STUDY_MAPPING["target"] | {"range": "100 m"}}
    near["accuracy"] = {"tolerance": tolerance}
    noisy = GridStudy(small_spec(instrument=instrument, **near)).evaluate(0)
    quiet = GridStudy(small_spec(**near)).evaluate(0)
    assert quiet["pd_up"] == noisy["pd_up"] == 1
    # (Re P_lo)^2 RIN B_e / 100 of current, through the transimpedance
    added = (1.1e-3) ** 2 * 1e-12 / 100 * 7e3**2
    bandwidth = (noisy["noise_variance"] - quiet["noise_variance"]) / added
    assert 1e8 < bandwidth < 1e9
    ratio = quiet["snr_up"] / noisy["snr_up"]
    assert ratio == pytest.approx(noisy["noise_variance"] / quiet["noise_variance"]) and ratio > 5
