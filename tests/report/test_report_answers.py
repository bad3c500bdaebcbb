"""Charts of the report hold what the answers from a store say: one truth."""

import numpy as np
import pytest
from report_specs import EXPERIMENTS, GRID_SPEC

from sweep.analysis import labels
from sweep.analysis.charts import SHEET_CHART_SIZE_LIMITS
from sweep.analysis.study_figures import GridResults
from sweep.report import detector_charts
from sweep.report.html_page import HtmlTable
from sweep.spec import GridSpec, SlicesFigure
from sweep.tasks import driver

SPECKLED = GRID_SPEC | {
    "target": {"radial_velocity": "150 m/s", "reflectance": 0.1, "roughness": "1 um"},
    "footprint": {"beamlets": 1, "speckle": "none"},
    "draws": {"number": 60},
    "axes": {"target.range": {"step": ["500 m", "6 km", "500 m"]},
             "target.grazing_angle": ["30 deg", "90 deg"]},
    "figures": [],
}  # fmt: skip


def run_study(directory, mapping):
    """The study of a mapping, computed."""
    spec = GridSpec.from_mapping(mapping, base=EXPERIMENTS)
    driver.run(spec, store=directory / "made.zarr", scheduler="none", progress=False)
    return GridResults.from_store(directory / "made.zarr")


@pytest.fixture(scope="module")
def drawn_study(tmp_path_factory):
    """A study that draws, and so has intervals."""
    return run_study(tmp_path_factory.mktemp("drawn"), SPECKLED)


def drawn_lines(chart, **choices):
    """Lines of a chart that are shown at some choices, by name."""
    (panel, *_) = (p for p in chart.panels if choices.items() <= p.facet_choices.items())
    return {line.name: line for line in panel.lines}


@pytest.mark.parametrize("choice,answer", detector_charts.LIMIT_VARIABLE_BY_LABEL.items())
def test_the_maximum_range_is_the_answer_s_in_the_units_of_the_page(grid_store, choice, answer):
    study = GridResults.from_store(grid_store)
    chart = detector_charts.maximum_range_chart_or_table(study)
    expected = (
        study.dataset.sweep.maximum_range(detector_charts.REPORTED_PD_LEVEL)[answer].compute()
        / 1000
    )
    assert expected.notnull().any()
    for power in (1, 3):
        line = drawn_lines(chart, answer=choice)[f"power {power} W"]
        assert list(line.x) == [20, 50, 80]
        np.testing.assert_allclose(line.y, expected.sel(power=power), rtol=1e-6)
    assert {panel.y_axis.label for panel in chart.panels} == {"maximum range (km)"}
    assert f"pd of {detector_charts.REPORTED_PD_LEVEL:g}" in chart.heading


def test_a_study_of_range_alone_has_its_maximum_range_in_a_table(tmp_path):
    axes = {"target.range": {"step": ["500 m", "12 km", "500 m"]}}
    target = GRID_SPEC["target"] | {"grazing_angle": "50 deg"}
    study = run_study(tmp_path, GRID_SPEC | {"axes": axes, "target": target, "figures": []})
    table = detector_charts.maximum_range_chart_or_table(study)
    assert isinstance(table, HtmlTable)
    answer = study.dataset.sweep.maximum_range(detector_charts.REPORTED_PD_LEVEL).compute()
    assert list(table.frame["maximum range (km)"] * 1000) == [
        pytest.approx(float(answer[name]))
        for name in detector_charts.LIMIT_VARIABLE_BY_LABEL.values()
    ]
    assert set(table.frame["which is"]) == {"found"}


def test_cuts_along_a_zipped_axis_have_a_maximum_range_each_and_no_range_none(tmp_path):
    angles = ["20 deg", "40 deg", "60 deg"]
    cut = {"zip": [
        {"target.range": {"step": ["500 m", "9 km", "500 m"]}, "target.grazing_angle": "30 deg"},
        {"target.range": "3 km", "target.grazing_angle": angles},
        {"target.range": {"step": ["500 m", "9 km", "500 m"]}, "target.grazing_angle": "85 deg"},
    ]}  # fmt: skip
    axes = {"instrument.laser.power": ["1 W", "3 W"], "cut": cut}
    study = run_study(tmp_path, GRID_SPEC | {"axes": axes, "figures": []})
    chart = detector_charts.maximum_range_chart_or_table(study)
    parts = list(dict.fromkeys(panel.facet_choices["part"] for panel in chart.panels))
    assert parts == ["grazing angle 30°", "grazing angle 85°"]
    steep = study.dataset.isel(cut=study.dataset.grazing_angle.values == 85)
    expected = steep.sweep.maximum_range(detector_charts.REPORTED_PD_LEVEL).unbroken / 1000
    (line,) = drawn_lines(
        chart, part="grazing angle 85°", answer=detector_charts.UNBROKEN_RANGE_LABEL
    ).values()
    np.testing.assert_allclose(line.y, expected, rtol=1e-6)
    target = GRID_SPEC["target"] | {"range": "1 km", "grazing_angle": "50 deg"}
    power = {"instrument.laser.power": ["1 W", "3 W"]}
    (tmp_path / "powers").mkdir()
    powers = run_study(
        tmp_path / "powers", GRID_SPEC | {"axes": power, "target": target, "figures": []}
    )
    assert detector_charts.maximum_range_chart_or_table(powers) is None
    near = {"target.range": ["50 m", "60 m"], "target.grazing_angle": ["50 deg", "60 deg"]}
    (tmp_path / "near").mkdir()
    sure = detector_charts.maximum_range_chart_or_table(
        run_study(tmp_path / "near", GRID_SPEC | {"axes": near, "figures": []})
    )
    assert detector_charts.is_chart_without_values(
        sure
    ) and not detector_charts.is_chart_without_values(chart)
    (sentence,) = detector_charts.maximum_range_sentences(sure)
    assert sentence.startswith("No maximum range at 2 of 2 places") and "up to the last" in sentence


def test_where_a_study_draws_lines_have_the_intervals_of_their_points(drawn_study):
    figure = SlicesFigure(kind="slices", variable="pd_shot", x="range", by="grazing_angle")
    chart = drawn_study.make_chart(figure, SHEET_CHART_SIZE_LIMITS)
    probability = drawn_study.dataset.sweep.detection_probability("shot").compute()
    for angle in (30, 90):
        line = drawn_lines(chart)[f"grazing angle {labels.format_quantity(angle, 'deg')}"]
        interval = probability.sel(grazing_angle=angle)
        assert (interval.high - interval.low).max() > 0.05
        np.testing.assert_allclose(line.y, interval.pd, atol=1e-6)
        np.testing.assert_allclose(line.low, interval.low, atol=1e-6)
        np.testing.assert_allclose(line.high, interval.high, atol=1e-6)
    assert "95 % confidence interval of each point" in " ".join(chart.caption)


def test_the_maximum_range_has_an_interval_where_pd_has(drawn_study):
    chart = detector_charts.maximum_range_chart_or_table(drawn_study)
    expected = (
        drawn_study.dataset.sweep.maximum_range(detector_charts.REPORTED_PD_LEVEL).compute() / 1000
    )
    (line,) = drawn_lines(chart, answer=detector_charts.UNBROKEN_RANGE_LABEL).values()
    known = np.isfinite(expected.unbroken_low + expected.unbroken_high)
    assert known.any()
    np.testing.assert_allclose(line.low[known], expected.unbroken_low[known], rtol=1e-6)
    np.testing.assert_allclose(line.high[known], expected.unbroken_high[known], rtol=1e-6)
    assert "95 % confidence interval" in " ".join(chart.caption)


def test_false_alarms_per_shot_agree_with_those_per_second(grid_store):
    study = GridResults.from_store(grid_store)
    profiles, fewer = detector_charts.grid_profiles(study)
    chart = detector_charts.false_alarm_chart(study, profiles, fewer)
    at = profiles[0].points.first_indices(profiles[0].coordinate)
    lines = drawn_lines(chart, part=profiles[0].label)
    for name, leakage in (("noise, both", False), ("either, both", True)):
        a_second = study.dataset.isel(at).sweep.false_alarms_per_second("1 Hz", leakage=leakage)
        together = -(-a_second.size // len(lines[name].y))
        means = np.add.reduceat(a_second.values, np.arange(0, a_second.size, together))
        first = means[:-1] / together
        np.testing.assert_allclose(lines[name].y[:-1], first, rtol=1e-6)
        assert (lines[name].low <= lines[name].y * (1 + 1e-6)).all()
        assert lines[name].high.max() == pytest.approx(a_second.values.max(), rel=1e-6)
