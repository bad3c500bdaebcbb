import pytest
from base_spec import changed_spec

from sweep.spec import GridSpec, SpecError, load
from sweep.spec.rules import NumericRule
from sweep.spec.sections import parameter_rules


def mistakes_of(mapping):
    with pytest.raises(SpecError) as error_info:
        GridSpec.from_mapping(mapping)
    return error_info.value.mistakes


def axes(**kinds):
    return {"axes": {path.replace("__", "."): values for path, values in kinds.items()}}


FIELDS = [
    ("instrument.laser.power", "-1 W", "must be at least 1e-18 W"),
    ("instrument.laser.power", 1, "needs a unit (you wrote 1); write e.g. '1 W'"),
    ("instrument.laser.power", "1 V", "needs a unit like W"),
    ("instrument.laser.power", None, "must be a number"),
    ("instrument.laser.power", ["1 W", "2 W"],
     "takes one value; put several under axes: 'instrument.laser.power: [...]'"),
    ("instrument.processing.window", ["hann"], "put several under axes"),
    ("instrument.laser.power", True, "must be a number"),
    ("instrument.laser.power", "nan W", "must be a finite number"),
    ("instrument.laser.power", ..., "is missing; write e.g. 'power: 1 W'"),
    ("instrument.laser.watts", "1 W", "is no field; the fields here are wavelength"),
    ("instrument.laser.powr", "1 W", "is no field; did you mean 'power'?"),
    ("instrument.laser.aperture", "1 m", "did you mean 'instrument.telescope.aperture'?"),
    ("instrument.laser", "bright", "must be a mapping of fields to values"),
    ("instrument.laser", ..., "is missing; write 'laser:' with wavelength"),
    ("instrument.telescope.aperture", "25 mn", "did you mean 'mm'?"),
    ("instrument.telescope.optical_efficiency", 1.01, "must be at most 1"),
    ("instrument.telescope.optical_efficiency", "3 dB", "must be at most 1 (you wrote '3 dB')"),
    ("instrument.telescope.optical_efficiency", "-1e9 dB", "must be at least 1e-12"),
    ("instrument.telescope.optical_efficiency", 0, "must be at least 1e-12"),
    ("instrument.receiver.mixing_efficiency", "-1e9 dB", "must be at least 1e-9"),
    ("instrument.processing.fft_size", "2^-1", "must be a whole number (you wrote '2^-1')"),
    ("instrument.processing.fft_size", "2^100000000", "has an exponent beyond 999"),
    ("instrument.telescope.optical_efficiency", "0.5 mW",
     "takes no unit: fraction of the collected light that reaches the detector (you wrote "
     "'0.5 mW'); write 0.5"),
    ("instrument.processing.tnr", "20 dB", "write 100 for a ratio of powers, 10 for one of ampl"),
    ("instrument.processing.tnr", "10 sigma",
     "takes no unit: threshold over the standard deviation of a noise-only bin's magnitude (you "
     "wrote '10 sigma'); write 10"),
    ("target.reflectance", "-10 dBm", "(you wrote '-10 dBm'); write e.g. '"),
    ("target.reflectance", "-10 m", "(you wrote '-10 m'); write e.g. '"),
    ("target.reflectance", "0.1 m", "(you wrote '0.1 m'); write 0.1"),
    ("instrument.processing.fft_size", "-8 samples", "(you wrote '-8 samples'); write e.g. '"),
    ("target.reflectance", "1/4", "is a pure number and takes no unit: "),
    ("instrument.processing.fft_size", "1,024", "has a comma; numbers are written like 1234.5"),
    ("instrument.processing.fft_size", "131 072", "write '131072'"),
    ("instrument.laser.power", "1,5 W", "(you wrote '1,5 W'); write '1.5 W'"),
    ("instrument.laser.power", "30 dB", "'dB' is none (you wrote '30 dB'); write e.g. '1 W' or "
     "'30 dBm'"),
    ("instrument.laser.power", "30 dbm", "has an unknown unit 'dbm' (you wrote '30 dbm'); did you "
     "mean 'dBm'?"),
    ("instrument.chirp.bandwidth", "30 dBm", "needs a unit like Hz, and 'dBm' is none"),
    ("instrument.receiver.noise_figure", 2, "write e.g. '3 dB'; a ratio of 2 is 3.01 dB"),
    ("instrument.receiver.noise_figure", "1e400",
     "needs a unit (you wrote '1e400'); write e.g. '3 dB'"),
    ("instrument.receiver.noise_figure", "-1 dB", "must be at least 0 dB"),
    ("instrument.receiver.temperature", "-300 degC", "must be at least 1 nK"),
    ("instrument.processing.fft_size", 100.5, "must be a whole number"),
    ("instrument.processing.window", "haming", "did you mean 'hamming'?"),
    ("instrument.processing.window", "kaiser", "parameters that this window does not take"),
    ("instrument.processing.window", "kaiser(x)", "must be the name of a window"),
    ("instrument.processing.window", 3, "must be the name of a window"),
    ("instrument.processing.window", "kaiser(1000)", "has parameters that make no usable window"),
    ("instrument.receiver.antialias_bandwidth", "601 MHz", "at most the sample rate over the"),
    ("instrument.receiver.antialias_order", 2, "must be at least 3"),
    ("target.grazing_angle", "90.1 deg", "must be at most 90 deg"),
    ("target.range", ..., "write e.g. 'range: 2 km', or put it on an axis"),
    ("footprint.beamlets", 0, "must be at least 1 (you wrote 0); write e.g. '109' or 'auto'"),
    ("footprint.beamlets", "atuo", "must be a number or auto (you wrote 'atuo')"),
    ("accuracy.confidence", 0, "must be greater than 0"),
    ("accuracy.confidence", 1, "must be less than 1"),
    ("atmosphere.extinction", "0.1 dB", "write e.g. '1e-4 1/m'"),
    ("effects.leakge", "on", "is no field; did you mean 'leakage'?"),
    ("effects.leakage", "onn", "must be one of auto, on, off (you wrote 'onn'); did you mean 'on'"),
    ("effects.leakage", 1, "must be one of auto, on, off (you wrote 1); write 'on'"),
    ("effects.leakage", "no", "must be one of auto, on, off (you wrote 'no'); write 'off'"),
    ("effects.leakage", "N", "must be one of auto, on, off (you wrote 'N'); write 'off'"),
    ("effects.leakage", "none", "must be one of auto, on, off (you wrote 'none'); write 'off'"),
    ("effects.leakage", 0, "must be one of auto, on, off (you wrote 0); write 'off'"),
    ("effects.leakage", "enabled", "(you wrote 'enabled'); write 'on'"),
    ("footprint.speckle", False, "must be one of developed, none (you wrote False); write 'none'"),
    ("instrument", ..., "is missing; write e.g. 'instrument: {like: settembrini_2026}' (the "
     "library has automotive_fmcw, chester_2017"),
    ("instrument", None, "write e.g. 'instrument: {like: settembrini_2026}'"),
    ("instrument", 3, "write e.g. 'instrument: {like: settembrini_2026}'"),
    ("instrument", "chester", "is no instrument of the library (you wrote 'chester'); did you mean "
     "'chester_2017_table_4_1' or 'chester_2017_table_5_1'?"),
    ("instrument", "Rogers 2021", "did you mean 'rogers_2021'?"),
    ("execution.scheduler", "tcp://10.0.0.5:8786", "say --scheduler ADDRESS, or --cluster FILE"),
    ("seed", 1.5, "must be a whole number"),
    ("platform", {}, "is no field; it is for studies with a scene, in place of a target"),
    ("title", ["A"], "must be text"),
    ("target", ..., "is missing; write 'target:' with range"),
    ("foorprint", {}, "did you mean 'footprint'?"),
    ("figures", "all", "must be a list"),
    ("axes", ["range"], "must be a mapping"),
]  # fmt: skip


@pytest.mark.parametrize(("path", "value", "words"), FIELDS)
def test_a_wrong_field_is_reported_once_with_path_rule_and_remedy(path, value, words):
    (mistake,) = mistakes_of(changed_spec({path: value}))
    assert mistake.path == path
    assert words in str(mistake)
    for foreign in ("Input should", "pydantic", "type=", "https://", "Extra inputs", "Field "):
        assert foreign not in str(mistake)
    if isinstance(parameter_rules().get(path), NumericRule):
        assert mistake.suggestion


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("settembrini", "(you wrote 'settembrini'); did you mean 'settembrini_2026'?"),
        ("x", "is no instrument of the library (you wrote 'x'); the library has automotive_fmcw, "),
        (None, "must be the name of an instrument of the library (you wrote nothing); the library"),
    ],
)
def test_an_instrument_that_the_library_lacks_is_reported_with_those_that_it_has(name, words):
    (mistake,) = mistakes_of(changed_spec({"instrument": {"like": name}}))
    assert mistake.path == "instrument.like" and words in str(mistake)


LIKE = """\
title: A study
instrument:
  like: automotive_fmcw
  {fields}
target: {{range: {range}, grazing_angle: 30 deg, reflectance: 0.1}}
"""


@pytest.mark.parametrize(
    ("fields", "reach", "line", "path", "words"),
    [
        ("processing: {acquisition_delay: 1 s}", "100 m", 4, "instrument.chirp.duration",
         "(automotive_fmcw has 6.1 us)"),
        ("telescope: {aperture: 30 mm}", "900 km", 5, "instrument.chirp.duration",
         "(automotive_fmcw has 6.1 us)"),
        ("processing: {tnr: 3}\n  chirp: {}", "100 m", None, "", ""),
        ("processing: {tnr: 3, design_pfa_bin: 1e-6}", "100 m", 4, "instrument.processing",
         "sets the threshold by tnr and by design_pfa_bin; keep one of them"),
        ("receiver: {record: complex, architecture: direct}", "100 m", 4,
         "instrument.receiver.record", "samples I and Q"),
    ],
)  # fmt: skip
def test_what_a_field_sets_off_in_the_library_s_instrument_is_reported_at_the_field(
    tmp_path, fields, reach, line, path, words
):
    file = tmp_path / "a.yaml"
    file.write_text(LIKE.format(fields=fields, range=reach))
    if line is None:
        assert load(file).instrument.processing.tnr == 3
        return
    with pytest.raises(SpecError) as error_info:
        load(file)
    mistakes_by_path = {mistake.path: mistake for mistake in error_info.value.mistakes}
    assert (mistakes_by_path[path].file, mistakes_by_path[path].line) == (str(file), line)
    assert words in str(mistakes_by_path[path])
    assert not any("sweep/instruments" in str(mistake) for mistake in error_info.value.mistakes)


def test_in_plain_data_no_file_of_the_library_is_reported():
    mapping = changed_spec({"instrument": {"like": "rogers_2021", "processing": {"tnr": -1}}})
    mapping["target"]["range"] = "900 km"
    mistakes = mistakes_of(mapping)
    assert {(mistake.file, mistake.line) for mistake in mistakes} == {("", None)}
    (threshold,) = (mistake for mistake in mistakes if mistake.path.endswith("tnr"))
    assert threshold.value == "-1" and "rogers_2021" not in str(threshold)


def test_a_filter_before_the_adc_shapes_noise_that_is_to_be_white():
    receiver = "instrument.receiver."
    changes = {f"{receiver}antialias_bandwidth": "200 MHz", f"{receiver}noise_shape": "white"}
    (mistake,) = mistakes_of(changed_spec(changes))
    assert mistake.path == f"{receiver}antialias_bandwidth"
    assert "shapes the noise" in str(mistake) and "noise_shape: receiver" in str(mistake)


AXES = [
    ({"target.rnge": ["1 m"]}, "target.rnge", "did you mean 'target.range'?"),
    ({"range": ["1 m"]}, "range", "did you mean 'target.range'?"),
    ({"seed": [1, 2]}, "seed", "is the same for a whole study: each point and draw has random "
     "numbers of its own already; leave it out, or run a study for each seed"),
    ({"effects.leakge": ["on"]}, "effects.leakge", "is the same for a whole study"),
    ({"draws.number": [1, 2]}, "draws.number", "is the same for a whole study; run a study for "
     "each value; axes take fields of instrument, target, atmosphere, footprint and accuracy"),
    ({"title": ["a", "b"]}, "title", "is the same for a whole study"),
    ({"instrument.like": ["rogers_2021"]}, "instrument.like", "run a study for each, and compare"),
    ({"laser": [1]}, "laser", "is no parameter"),
    ({"target.range": []}, "target.range", "holds no value"),
    ({"target.range": "1 m"}, "target.range", "must be a list or a generator"),
    ({"target.range": ["1 m", "-2 m"]}, "target.range[1]", "must be at least 1 nm"),
    ({"target.range": ["1 m", "100 cm"]}, "target.range", "holds 1.0 m more than once"),
    ({"effects.leakage": ["on"]}, "effects.leakage", "is the same for a whole study; run a study "
     "for each mode, and compare them with sweep compare"),
    ({"instrument.laser.power": {"linear": ["0 dBm", "3 dBW"], "number": 3}},
     "instrument.laser.power.linear", "mixes units of decibels; take dBm for all"),
    ({"instrument.laser.power": {"linear": ["0 dBm", "3 W"], "number": 3}},
     "instrument.laser.power.linear", "mixes decibels with a plain unit"),
    ({"instrument.laser.relative_intensity_noise": {"linear": ["-160 dB/Hz", "1e-15 1/Hz"],
      "number": 3}}, "instrument.laser.relative_intensity_noise.linear", "mixes decibels"),
    ({"target.range": {"linear": ["1 m", "9 m"]}}, "target.range", "lacks the number of values"),
    ({"target.range": {"linear": ["1 m", "9 m"], "number": 1}}, "target.range.number",
     "at least 2"),
    ({"target.range": {"linear": ["1 m", "9 m"], "number": 1e12}}, "target.range.number",
     "must be at most 20000000"),
    ({"target.range": {"linear": ["1 m"], "number": 9}}, "target.range.linear",
     "a list of 2 values"),
    ({"target.range": {"linear": ["1 m", "1 m"], "number": 9}}, "target.range.linear",
     "begins and ends with the same value"),
    ({"target.range": {"linear": ["1 m", "9 m"], "number": 9, "ends": 1}}, "target.range.ends",
     "is no part of 'linear'"),
    ({"target.range": {"linaer": ["1 m", "9 m"], "number": 9}}, "target.range",
     "did you mean 'linear'?"),
    ({"target.range": {"linear": ["1 m", "9 m"], "log": 1, "number": 9}}, "target.range",
     "must have exactly one of linear, log and step"),
    ({"target.range": {"linear": ["0 m", "9 m"], "number": 9}}, "target.range.linear[0]",
     "must be at least 1 nm"),
    ({"target.reflectance": {"log": [0, 1], "number": 9}}, "target.reflectance.log",
     "must begin and end above zero"),
    ({"target.range": {"step": ["1 m", "9 m"]}}, "target.range.step", "a list of 3 values"),
    ({"target.range": {"step": ["1 m", "9 m", "0 m"]}}, "target.range.step", "has a step of zero"),
    ({"target.range": {"step": ["1 m", "9 m", "-1 m"]}}, "target.range.step",
     "leads away from its end"),
    ({"target.range": {"step": ["1 m", "9 km", "1 nm"]}}, "target.range.step",
     "take a larger step"),
    ({"instrument.processing.fft_size": {"linear": [131072, 131077], "number": 3}},
     "instrument.processing.fft_size.linear", "values that are not whole"),
    ({"instrument.processing.fft_size": {"log": [131072, 131077], "number": 3}},
     "instrument.processing.fft_size.log", "values that are not whole"),
    ({"instrument.receiver.noise_figure": {"log": ["1 dB", "5 dB"], "number": 3}},
     "instrument.receiver.noise_figure.log", "logarithms already"),
    ({"footprint.phases": ["coherent", "choerent"]}, "footprint.phases[1]",
     "did you mean 'coherent'?"),
    ({"footprint.phases": {"linear": [1, 2], "number": 2}}, "footprint.phases", "list them"),
    ({"instrument.processing.window": ["boxcar", "rect"]}, "instrument.processing.window",
     "holds rectangular more than once"),
    ({"cut": {"zip": []}}, "cut.zip", "holds no piece"),
    ({"cut": {"zip": [{}]}}, "cut.zip[0]", "must be a mapping of paths to values"),
    ({"cut": {"zip": [{"target.range": "1 m"}], "by": 1}}, "cut.by", "is no part of a zipped axis"),
    ({"a.b": {"zip": [{"target.range": "1 m"}]}}, "a.b", "is no name for an axis"),
    ({"cut": {"zip": [{"target.range": ["1 m", "2 m"], "target.reflectance": [0.1]}]}},
     "cut.zip[0]", "equal numbers of values: target.range has 2, target.reflectance has 1"),
    ({"cut": {"zip": [{"target.range": "1 m"}, {"target.reflectance": 1}]}}, "cut.zip[1]",
     "the same parameters as the first piece"),
    ({"cut": {"zip": {"target.rnge": "1 m"}}}, "cut.zip.target.rnge",
     "did you mean 'target.range'?"),
    ({"cut": {"zip": {"target.range": "1 m", "target.reflectance": 0.1}},
      "target.range": ["1 m", "2 m"]}, "target.range", "which the axis 'cut' sets too"),
    ({"power": {"zip": {"target.range": "1 m", "target.reflectance": 0.1}},
      "instrument.laser.power": ["1 W"]}, "power", "has the name of a coordinate"),
    ({"footprint.beamlets": ["auto", 9]}, "footprint.beamlets[0]",
     "is one value for a whole study, no point of an axis (you wrote 'auto'); leave it out"),
]  # fmt: skip


@pytest.mark.parametrize(("axes", "path", "words"), AXES)
def test_a_wrong_axis_is_reported_once_with_path_rule_and_remedy(axes, path, words):
    (mistake,) = mistakes_of(changed_spec(axes=axes))
    assert mistake.path == f"axes.{path}"
    assert words in str(mistake)


def test_a_generator_that_leaves_the_bounds_says_where():
    step = {"step": ["1 deg", "90 deg", "1 deg"]}
    assert (
        GridSpec.from_mapping(changed_spec(axes={"target.grazing_angle": step})).axes[0].size == 90
    )
    (mistake,) = mistakes_of(
        changed_spec(axes={"instrument.receiver.apd_gain": {"linear": [1, 2e9], "number": 3}})
    )
    assert mistake.path == "axes.instrument.receiver.apd_gain.linear[1]"


FIGURES = [
    ({"kind": "surfce"}, "figures[0].kind", "did you mean 'surface'?"),
    ({"variable": "pd_shot"}, "figures[0]", "lacks its kind"),
    ({"kind": "slices", "variable": "pd_shot"}, "figures[0].x", "is missing"),
    ({"kind": "slices", "variable": "pd_shoot", "x": "range"}, "figures[0].variable",
     "did you mean 'pd_shot'?"),
    ({"kind": "slices", "variable": "n_detected_up", "x": "range"}, "figures[0].variable",
     "this study has none"),
    ({"kind": "slices", "variable": "pd_shot", "x": "range", "where": {"range": "3 W"}},
     "figures[0].where.range", "needs a unit like m"),
    ({"kind": "slices", "variable": "pd_shot", "x": "range", "where": {"tnr": 3}},
     "figures[0].where.tnr", "is no coordinate of this study"),
    ({"kind": "slices", "variable": "pd_shot", "x": "range", "where": 3}, "figures[0].where",
     "must be a mapping of coordinates"),
    ({"kind": "slices", "variable": "pd_shot", "x": "range", "name": "../x"}, "figures[0].name",
     "take letters"),
    ({"kind": "threshold_table"}, "figures[0].by",
     "by: is 'tnr' by default, which is no coordinate of this study; the coordinates are range"),
    ({"kind": "threshold_table", "by": "tnr"}, "figures[0].by",
     "by: is no coordinate of this study (you wrote 'tnr'); the coordinates are range"),
    ({"kind": "threshold_table", "by": "range", "printed": [[1, "x"]]}, "figures[0].printed",
     "must be a number"),
    ("surface", "figures[0]", "must be a mapping"),
]  # fmt: skip


@pytest.mark.parametrize(("figure", "path", "words"), FIGURES)
def test_a_wrong_figure_is_reported_with_path_rule_and_remedy(figure, path, words):
    mapping = changed_spec(axes={"target.range": ["1 m", "2 m"]}, figures=[figure])
    (mistake,) = mistakes_of(mapping)
    assert mistake.path == path
    assert words in str(mistake)


def test_two_figures_of_one_file_are_refused():
    figure = {"kind": "slices", "variable": "pd_shot", "x": "range"}
    (mistake,) = mistakes_of(changed_spec(axes={"target.range": ["1 m"]}, figures=[figure, figure]))
    assert mistake.path == "figures[1]"
    assert "give it a name" in str(mistake)


def test_a_fixed_number_of_draws_and_a_limit_exclude_each_other():
    (mistake,) = mistakes_of(changed_spec({"draws.number": 5000, "draws.limit": "1e6"}))
    assert str(mistake) == (
        "draws.limit: is given in addition to draws.number, 5000: only one of them can set how "
        "much to draw (you wrote 1000000); keep limit to draw until accuracy.tolerance is met, "
        "or number to draw so many times"
    )
    for draws in ({"number": 0, "limit": 5}, {"number": 5, "limit": 0}, {"limit": "1e12"}):
        assert GridSpec.from_mapping(changed_spec(draws=draws)).draws.has_draws


@pytest.mark.parametrize("draws", [{"number": 3}, {"limit": 3}])
@pytest.mark.parametrize("variable", ["n_draws", "pd_up_half_width", "n_detected_up"])
def test_figures_of_what_is_drawn_ask_for_draws(draws, variable):
    figures = [{"kind": "slices", "variable": variable, "x": "range"}]
    mapping = changed_spec(axes={"target.range": ["1 m", "2 m"]}, figures=figures)
    assert GridSpec.from_mapping(mapping | {"draws": draws}).figures
    (mistake,) = mistakes_of(mapping)
    assert "set draws: {number: ...} or {limit: ...}" in str(mistake)


TEN = """\
title: Ten mistakes
instrument:
  laser: {wavelength: 1550, power: -1 W, beam_divergence: 50 urad}
  chirp: {bandwith: 1 GHz, start_frequency: 5.5 ghz, duration: 500 us}
  telescope: {aperture: 25 mn}
  receiver: {responsivity: 1.1 A/W, detector_bandwidth: 400 MHz, optical_passband: 25 nm,
             noise_equivalent_power: 5 pW/rtHz, transimpedance: 7 kohm,
             amplifier_bandwidth: 400 MHz, amplifier_noise_current: 25 nA}
  processing: {sample_rate: 600 MHz, fft_size: 2^17, tnr: 10, window: haming}
target: {range: 2 km, grazing_angle: 95 deg, reflectance: 0.1, reflectance: 0.2}
axes:
  target.rnge: [1 m]
  instrument.laser.power: [1 W, 3 W, 3]
"""


def test_ten_mistakes_in_one_file_are_reported_at_once_with_their_lines(tmp_path):
    path = tmp_path / "ten.yaml"
    path.write_text(TEN)
    with pytest.raises(SpecError) as error_info:
        load(path)
    locations = {(mistake.line, mistake.path) for mistake in error_info.value.mistakes}
    assert locations == {
        (3, "instrument.laser.wavelength"),
        (3, "instrument.laser.power"),
        (4, "instrument.chirp.bandwidth"),
        (4, "instrument.chirp.bandwith"),
        (4, "instrument.chirp.start_frequency"),
        (5, "instrument.telescope.aperture"),
        (9, "instrument.processing.window"),
        (10, "target.grazing_angle"),
        (10, "target.reflectance"),
        (12, "axes.target.rnge"),
        (13, "axes.instrument.laser.power[2]"),
    }
    text = str(error_info.value)
    assert text.startswith("11 mistakes:")
    assert (
        f"{path}:5: instrument.telescope.aperture: has an unknown unit 'mn' (you wrote '25 mn')"
        in text
    )


def test_an_axis_that_stands_in_for_a_field_is_blamed_alone():
    mapping = changed_spec({"target.range": ...}, axes={"target.range": [5, "6 m"]})
    (mistake,) = mistakes_of(mapping)
    assert mistake.path == "axes.target.range[0]"


BAND = {
    "min_range": "10 m", "max_range": "2 km", "min_radial_velocity": "-5 m/s",
    "max_radial_velocity": "40 m/s",
}  # fmt: skip


@pytest.mark.parametrize(
    ("band", "message"),
    [
        ({"min_range": "1 m", "max_range": "9 m"}, "both range and velocity; give all four ends"),
        (BAND | {"max_range": "4 m"}, "must exceed instrument.processing.search.min_range"),
        (BAND, "counts bins that instrument.processing.search leaves out"),
    ],
)
def test_search_bands_have_four_ends_and_count_what_they_search(band, message):
    changes = {f"instrument.processing.search.{name}": value for name, value in band.items()}
    counted = "all" if band == BAND else "half"
    with pytest.raises(SpecError, match=message):
        GridSpec.from_mapping(
            changed_spec(changes | {"instrument.processing.bins_counted": counted})
        )


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"draws.number": 5}, "closed form alone, and the study has draws; take all, or no draws"),
        (
            {"instrument.looks.number": 4, "instrument.processing.detection": "peak_bin"},
            "is that of one record, and instrument.looks.number asks for several",
        ),
        (
            {
                "instrument.telescope.leak_path": "1 m", "instrument.telescope.isolation": "60 dB",
            },
            "may be the line of instrument.telescope.leak_path",
        ),
        (
            {
                "instrument.processing.shot_detection": "any_two",
                "instrument.chirp.doppler_slope": 0.5,
            },
            "any_two cannot show in which; take all, or shot_detection: both_chirps",
        ),
    ],
)  # fmt: skip
def test_the_strongest_peak_alone_is_refused_where_no_law_of_it_is_known(changes, message):
    strongest = {"instrument.processing.peaks": "strongest"}
    with pytest.raises(SpecError, match=message):
        GridSpec.from_mapping(changed_spec(changes | strongest))
    assert not GridSpec.from_mapping(changed_spec(changes)).reports_strongest_peak
    assert GridSpec.from_mapping(changed_spec(strongest)).reports_strongest_peak


@pytest.mark.parametrize("peaks", ["all", "strongest"])
def test_a_figure_of_wrong_ranges_needs_a_study_that_has_some(peaks):
    figure = {"kind": "slices", "variable": "p_wrong_range_shot", "x": "range"}
    mapping = changed_spec(
        {"instrument.processing.peaks": peaks}, axes={"target.range": ["1 m", "2 m"]},
        figures=[figure],
    )  # fmt: skip
    if peaks == "strongest":
        assert GridSpec.from_mapping(mapping).reports_strongest_peak
        return
    with pytest.raises(SpecError, match=r"processing\.peaks: strongest"):
        GridSpec.from_mapping(mapping)
