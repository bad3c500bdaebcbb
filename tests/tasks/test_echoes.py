"""Echoes that arrive after their record, or are read as others: told in plan and run, flagged."""

from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from small_flights import SCENE_MAPPING, small_scene_spec
from small_studies import STUDY_MAPPING, run_serially, small_spec

import sweep
from sweep.cli import main
from sweep.model.pointcloud.pairing import FLAG_BITS
from sweep.tasks.studies.echo_warnings import echo_warnings
from sweep.tasks.studies.study_loading import make_study

WITHIN = {"range": "1 km", "grazing_angle": "90 deg", "radial_velocity": "0 m/s",
          "reflectance": 0.1}  # fmt: skip


def warnings_of(spec):
    return list(echo_warnings(make_study(spec, Path("nowhere.zarr").absolute())))


def along(*ranges, **sections):
    """The small study, of records of 27.3 us from 0 on, over some ranges."""
    return small_spec(target=WITHIN, axes={"target.range": list(ranges)}, **sections)


def record(**processing):
    """Instrument of the small study with other records."""
    return {
        **STUDY_MAPPING["instrument"],
        "processing": STUDY_MAPPING["instrument"]["processing"] | processing,
    }


def test_records_that_hold_all_of_their_echoes_raise_no_warning():
    assert warnings_of(along("1 km", "2 km", instrument=record(acquisition_delay="14 us"))) == []
    assert warnings_of(along("1 m", "100 m")) == []


def test_no_echo_and_half_an_echo_are_reported_with_the_range_from_which_on():
    ranges = [f"{r} m" for r in (500, 1000, 2000, 3000, 4000, 4200, 5000)]
    none, weak = warnings_of(along(*ranges))
    assert none.startswith("no echo arrives") and "28.6 % of the points" in none
    assert "from 4,200 m on" in none and "nothing is detected" in none
    # Hamming's window of 4,093 m has lost 3 dB of its sum where 0.29 of its power is missing
    assert "more than 3 dB at 42.9 % of the points, from 2,000 m on" in weak
    assert "processing.acquisition_delay" in weak


def test_no_overlap_warning_where_overlap_is_off():
    assert warnings_of(along("1 km", "5 km", effects={"overlap": "off"})) == []


def test_axes_that_change_no_echo_do_not_change_the_warnings():
    ranges, wide = ["1 km", "5 km"], {"linear": ["1 W", "5 W"], "number": 5000}
    one = warnings_of(along(*ranges))
    axes = {"target.range": ranges, "instrument.laser.power": wide}
    assert warnings_of(small_spec(target=WITHIN, axes=axes)) == one


@pytest.mark.parametrize("kind", ["real", "complex"])
def test_beats_that_fold_are_reported_with_the_range_from_which_on(kind):
    """1 GHz in 500 us are 13.34 kHz a metre: 300 MHz, half the sample rate, at 22.48 km."""
    instrument = record(fft_size="2^17", acquisition_delay="0 us")
    instrument["receiver"] = instrument["receiver"] | {"record": kind}
    ranges = [f"{km} km" for km in range(1, 61)]
    switched_off = {"effects": {"overlap": "off"}, "instrument": instrument}
    (wrong,) = warnings_of(along(*ranges, **switched_off))
    assert "read as another range or velocity" in wrong
    assert "from 23,000 m on" in wrong


def test_points_that_fold_are_flagged_in_the_store(tmp_path):
    spec = along(
        "20 km", "22 km", "23 km", "30 km", instrument=record(fft_size="2^17", tnr=5),
        effects={"overlap": "off"},
    )  # fmt: skip
    assert run_serially(spec, tmp_path / "far.zarr").complete
    dataset = sweep.open(tmp_path / "far.zarr")
    assert dataset.misread.values.tolist() == [0, 0, 1, 1]
    assert (np.abs(dataset.range_error.values[2:]) > 1e3).all()


def test_plan_and_run_warn_in_the_same_words(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    spec = along("1 km", "4 km", "5 km")
    Path("late.yaml").write_text(spec.to_yaml() if hasattr(spec, "to_yaml") else spec.to_json())
    runner = CliRunner()
    for command in (["plan", "late.yaml"], ["run", "late.yaml", "--scheduler", "none"]):
        result = runner.invoke(main, command)
        assert result.exit_code == 0, result.output
        words = " ".join(result.stderr.split())
        assert "warning: no echo arrives before its record ends at 33.3 % of the points" in words
        assert "from 5,000 m on" in words and "more than 3 dB" in words


# Flights


def hover(height, **processing):
    """A lidar that hovers above a plain, in dim light so that noise decides nothing."""
    instrument = SCENE_MAPPING["instrument"] | {
        "chirp": STUDY_MAPPING["instrument"]["chirp"]
        | {"duration": "20 us", "bandwidth": "40 MHz"},
        "processing": STUDY_MAPPING["instrument"]["processing"]
        | {"fft_size": "2^12", "acquisition_delay": "2 us"}
        | processing,
    }
    return small_scene_spec(
        instrument=instrument,
        scene={"objects": {"ground": {"kind": "plane", "size": "8 km", "reflectance": 0.1}}},
        platform={
            "path": {
                "kind": "straight", "from": ["0 m", "0 m", height], "to": ["9 m", "0 m", height],
                "initial_speed": "10 m/s",
            },
            "attitude": {"kind": "nadir"},
        },
        scanners={"down": {"kind": "line", "half_angle": "0.5 deg", "line_rate": "1 Hz",
                           "rate": "10 Hz"}},
        axes={},
    )  # fmt: skip


@pytest.mark.parametrize("height, is_seen", [("290 m", True), ("1400 m", False)])
def test_a_flight_sees_nothing_where_echoes_arrive_after_the_record(tmp_path, height, is_seen):
    """Records last from 2 us to 8.83 us: 1,323 m."""
    spec = hover(height)
    words = warnings_of(spec)
    assert bool(words) != is_seen
    if not is_seen:
        assert "100 % of the shots, at all ranges" in words[0]
    assert run_serially(spec, tmp_path / "hover.zarr").complete
    dataset = sweep.open_scene(tmp_path / "hover.zarr")["down"].to_dataset()
    assert bool((dataset.pd_shot.fillna(0) > 0.5).all()) == is_seen
    assert bool((dataset.flags.values & FLAG_BITS["true"] > 0).any()) == is_seen
    if not is_seen:
        assert (dataset.pd_up.fillna(0) == 0).all() and (dataset.snr_up.fillna(0) == 0).all()
        assert not (dataset.flags.values & FLAG_BITS["misread"]).any()
        assert (dataset.surfaces_seen == 0).all()


def test_a_flight_in_which_beats_fold_is_warned_of_and_flags_its_points(tmp_path):
    """40 MHz in 20 us, 2 THz/s: a beat of 3 MHz, half the sample rate, is 225 m."""
    spec = hover("400 m", sample_rate="6 MHz", fft_size="2^6", acquisition_delay="3 us", tnr=5)
    words = warnings_of(spec)
    assert any("read as another range or velocity at 100 % of the shots" in w for w in words)
    assert run_serially(spec, tmp_path / "fold.zarr").complete
    dataset = sweep.open_scene(tmp_path / "fold.zarr")["down"].to_dataset()
    flags = dataset.flags.values
    assert (flags & FLAG_BITS["misread"]).any() and not (flags & FLAG_BITS["true"]).any()


def test_a_phase_that_walks_far_within_a_delay_is_warned_of_except_for_drawn_spectra():
    laser = {"line_width": "30 kHz", "line_shape": "lorentzian"}
    noisy = {**STUDY_MAPPING["instrument"], "laser": STUDY_MAPPING["instrument"]["laser"] | laser}
    ranges = [f"{r} m" for r in (100, 400, 700, 1000)]
    (words,) = warnings_of(along(*ranges, instrument=noisy))
    assert "the laser's phase walks" in words and "50 % of the points, from 700 m on" in words
    assert "draws.method: spectra" in words
    narrow = {**noisy, "laser": noisy["laser"] | {"line_width": "1 kHz"}}
    assert warnings_of(along(*ranges, instrument=narrow)) == []
    assert warnings_of(along(*ranges, instrument=noisy, effects={"line_width": "off"})) == []
    draws_section = {"number": 100, "method": "spectra"}
    assert warnings_of(along(*ranges, instrument=noisy, draws=draws_section)) == []


# Pairs that no Doppler beat confirms


def flown(heights, speeds, record_kind="real", **processing):
    """A descent of the small scene between heights at speeds, without its ball."""
    instrument = record(acquisition_delay="8 us", **processing)
    instrument["receiver"] = instrument["receiver"] | {"record": record_kind}
    start, end = (["0 m", "0 m", height] for height in heights)
    path = {"kind": "straight", "from": start, "to": end, "initial_speed": speeds[0],
            "final_speed": speeds[1]}  # fmt: skip
    ground = {"plane": {"kind": "plane", "size": "9 km", "reflectance": 0.1}}
    return small_scene_spec(
        instrument=instrument,
        scene={"origin": "plane", "objects": ground},
        platform={"path": path, "attitude": {"kind": "nadir"}}, axes={},
        scanners={"line": {"kind": "line", "half_angle": "1 deg", "line_rate": "1 Hz",
                           "rate": "8 Hz"}},
    )  # fmt: skip


def exchanged(spec):
    return [words for words in warnings_of(spec) if "exchanged" in words]


@pytest.mark.parametrize(
    ("heights", "speeds", "set_to", "share", "remedy"),
    [
        # The small study's chirp has the beat of 96.7 m/s at 9.3 km, 1.04e-2 m/s for a metre.
        (("1500 m", "300 m"), ("100 m/s", "30 m/s"), "far", "at 100 % of", "two_beats: fast"),
        (("1500 m", "300 m"), ("100 m/s", "30 m/s"), "fast", None, None),
        (("1500 m", "1400 m"), ("5 m/s", "5 m/s"), "far", None, None),
        (("1500 m", "1400 m"), ("5 m/s", "5 m/s"), "fast", "at 100 % of", "two_beats: far"),
        (("1500 m", "1000 m"), ("40 m/s", "3 m/s"), "fast", None, None),
    ],
)
def test_a_flight_is_warned_where_its_pairs_are_read_wrong(heights, speeds, set_to, share, remedy):
    words = exchanged(flown(heights, speeds, two_beats=set_to))
    assert len(words) == (share is not None)
    if share:
        assert share in words[0] and remedy in words[0] and "misread" in words[0]


@pytest.mark.parametrize(
    ("speeds", "remedy"),
    [(("40 m/s", "3 m/s"), "write processing.two_beats: fast, which is wrong at"),
     (("20 m/s", "3 m/s"), "fast would be wrong at more of the shots")],
)  # fmt: skip
def test_a_flight_fast_in_part_gets_the_assumption_that_is_right_more_often(speeds, remedy):
    (words,) = exchanged(flown(("1500 m", "1000 m"), speeds))
    assert remedy in words and "the Doppler shift exceeds the beat of the range at" in words


@pytest.mark.parametrize(
    ("changes", "number"),
    [
        ({}, 0),  # of both chirps and the Doppler segment all beats are known
        ({"shot_detection": "any_two"}, 1),
        ({"shot_detection": "any_two", "two_beats": "fast"}, 0),
    ],
)
def test_a_grid_is_warned_where_two_beats_decide(changes, number):
    fast = WITHIN | {"radial_velocity": "60 m/s"}
    spec = small_spec(
        target=fast, instrument=record(acquisition_delay="7 us", **changes),
        axes={"target.range": ["1 km", "2 km"]},
    )  # fmt: skip
    words = exchanged(spec)
    assert len(words) == number
    if number:
        assert "at 100 % of the points, at all ranges" in words[0]


def test_two_chirps_without_a_doppler_segment_get_the_same_remedy():
    chirp = STUDY_MAPPING["instrument"]["chirp"] | {"segments": "up down"}
    instrument = record(acquisition_delay="7 us") | {"chirp": chirp}
    fast = WITHIN | {"radial_velocity": "60 m/s"}
    words = warnings_of(
        small_spec(target=fast, instrument=instrument, axes={"target.range": ["1 km", "9 km"]})
    )
    assert ["two_beats: fast" in text for text in words if "misread" in text] == [True]


def test_records_of_i_and_q_have_signs_and_no_assumption():
    assert exchanged(flown(("1500 m", "300 m"), ("100 m/s", "30 m/s")))
    spec = flown(("1500 m", "300 m"), ("100 m/s", "30 m/s"), record_kind="complex")
    assert not exchanged(spec)


def test_exchanged_pairs_are_warned_of_in_plan_and_in_python(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    spec = flown(("1500 m", "300 m"), ("100 m/s", "30 m/s"))
    Path("fast.yaml").write_text(spec.to_yaml() if hasattr(spec, "to_yaml") else spec.to_json())
    planned = CliRunner().invoke(main, ["plan", "fast.yaml"])
    assert planned.exit_code == 0, planned.output
    assert "write processing.two_beats: fast" in " ".join(planned.stderr.split())
    with pytest.warns(sweep.StudyWarning, match="two_beats: fast"):
        sweep.run(spec, store=tmp_path / "fast.zarr", scheduler="none", progress=False)


@pytest.mark.parametrize("name", ["lander_ndl", "chester_2017_table_5_1"])
def test_instruments_of_landers_read_two_beats_as_of_a_fast_target(name):
    spec = small_scene_spec(instrument=name, axes={})
    assert spec.parameters()["instrument.processing.two_beats"] == "fast"
    assert not exchanged(spec)


SLIDING = {
    "range": "300 m", "grazing_angle": "60 deg", "radial_velocity": "0 m/s",
    "transverse_velocity": "60 m/s", "reflectance": 0.1,
}  # fmt: skip
ACROSS = "both sides of DC"


def sliding(target, draws=None, **processing):
    """What is told of an instrument with a beam of 5 mrad that slides over the ground."""
    instrument = record(fft_size="2^13", acquisition_delay="3 us", **processing)
    instrument["laser"] = instrument["laser"] | {"beam_divergence": "2 mrad"}
    draws_section = {} if draws is None else {"draws": {"method": draws, "number": 8}}
    footprint = {"speckle": "developed", "phases": "incoherent"}
    spec = small_spec(
        target=SLIDING | target,
        axes={},
        instrument=instrument,
        footprint=footprint,
        **draws_section,
    )
    return [sentence for sentence in warnings_of(spec) if ACROSS in sentence]


def test_speckle_that_spreads_over_bins_across_dc_is_warned_of():
    """60 m/s across half a mrad are 3 cm/s, 40 kHz, and a bin has 73 kHz: the Doppler segment's."""
    (sentence,) = sliding({}, detection="any_bin")
    assert "at 100 % of the points" in sentence and "0.06 too high" in sentence


@pytest.mark.parametrize(
    ("target", "draws", "processing"),
    [
        ({"transverse_velocity": "0 m/s"}, None, {"detection": "any_bin"}),
        ({"radial_velocity": "20 m/s"}, None, {"detection": "any_bin"}),
        ({}, "noise", {"detection": "any_bin"}),
        ({}, "spectra", {"detection": "any_bin"}),
        ({}, None, {"detection": "peak_bin"}),
    ],
)
def test_other_echoes_near_dc_raise_no_warning(target, draws, processing):
    assert sliding(target, draws, **processing) == []
