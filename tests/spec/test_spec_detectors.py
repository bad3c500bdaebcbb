"""Detectors and estimators in a spec: what may be written, what needs what, what changes an id."""

import jsonschema
import pytest
from base_scene_spec import changed_scene as flight
from base_spec import changed_spec

from sweep.spec import GridSpec, SceneSpec, SpecError, json_schema

PROCESSING = "instrument.processing."
SPECTRA = {"method": "spectra", "number": 10}


def spec(changes=None, **sections):
    return GridSpec.from_mapping(changed_spec(changes, **sections))


def test_they_may_vary_and_their_coordinates_bear_their_names():
    axes = {
        PROCESSING + "detector.kind": ["fixed", "os_cfar", "my.module:detect"],
        PROCESSING + "estimator.kind": ["candan", "chirp_z"],
        PROCESSING + "detector.training": [16, 32],
    }
    study = spec(axes=axes, draws=SPECTRA)
    assert [axis.name for axis in study.axes] == ["detector", "estimator", "training"]
    assert (
        study.parameters_with_overrides({"detector": "ca_cfar"})[PROCESSING + "detector.kind"]
        == "ca_cfar"
    )
    jsonschema.validate(study.to_yaml_mapping(), json_schema())
    assert GridSpec.from_stored(study.to_json()).id == study.id


@pytest.mark.parametrize(
    ("changes", "draws", "words"),
    [
        ({"detector.kind": "os_cfr"}, SPECTRA, "did you mean 'os_cfar'"),
        ({"detector.kind": "os.system('ls')"}, SPECTRA, "or a function as module:function"),
        ({"estimator.kind": "candan"}, {}, "which draws.method 'probabilities' does not draw"),
        ({"detector.pfa": 1e-3}, {"number": 5}, "set draws: {method: spectra"),
        ({}, {"method": "spectra"}, "set draws.number or draws.limit"),
        ({"detector.training": 33}, SPECTRA, "must be even"),
        ({"detector.rank": 40}, SPECTRA, "at most detector.training, 32"),
        (
            {"fft_size": 64, "acquisition_delay": "14 us"},
            SPECTRA,
            "leaves 31 bins between DC and Nyquist",
        ),
        ({"detector": "os_cfar"}, SPECTRA, "must be a mapping"),
    ],
)
def test_what_does_not_fit_is_reported(changes, draws, words):
    with pytest.raises(SpecError, match=r"instrument\.processing|draws") as raised:
        spec({PROCESSING + path: value for path, value in changes.items()}, draws=draws)
    assert words in str(raised.value)
    assert len(raised.value.mistakes) == 1


def test_closed_forms_make_no_figures_of_whole_spectra():
    figures = [
        {"kind": "table", "variable": "pfa_both_chirps", "rows": "range"},
        {"kind": "threshold_table", "by": "range"},
        {"kind": "slices", "variable": "false_alarms", "x": "range"},
    ]
    with pytest.raises(SpecError) as raised:
        spec(axes={"target.range": ["1 km", "2 km"]}, draws=SPECTRA, figures=figures)
    assert sorted(m.path for m in raised.value.mistakes) == [
        "figures[0].variable",
        "figures[1].kind",
    ]


def test_they_are_no_part_of_studies_that_draw_no_spectra():
    assert not [p for p in spec().identity()["parameters"] if "detector.k" in p or "estim" in p]
    specs = [
        spec({PROCESSING + "detector.kind": kind}, draws=SPECTRA) for kind in ("fixed", "ca_cfar")
    ]
    assert specs[0].id != specs[1].id


def test_flights_have_them_where_they_draw_whole_spectra():
    mapping = flight()
    mapping["instrument"]["processing"]["estimator"] = {"kind": "candan"}
    with pytest.raises(SpecError, match=r"which draws.method 'probabilities' does not draw"):
        SceneSpec.from_mapping(mapping)
    mapping["draws"] = {"method": "spectra", "number": 2}
    path = "instrument.processing.estimator.kind"
    assert SceneSpec.from_mapping(mapping).parameters()[path] == "candan"
    mapping["instrument"]["receiver"]["record"] = "complex"
    assert SceneSpec.from_mapping(mapping).parameters()[path] == "candan"
