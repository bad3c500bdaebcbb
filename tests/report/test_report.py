"""What a report holds: reduced figures against whole ones, the spec again, and what is refused."""

import base64
import gzip
import json
import re
import shutil
import subprocess
import sys

import numpy as np
import pandas
import pytest
import yaml
from click.testing import CliRunner
from report_specs import EXPERIMENTS, GRID_SPEC

import sweep
from sweep.analysis.datasets import NotAStoreError
from sweep.analysis.study_figures import GridResults, SceneResults
from sweep.cli import main
from sweep.model.evaluation import evaluate
from sweep.model.pointcloud.pairing import TRUE_RETURN_FLAG
from sweep.model.threshold import TNR_PATH
from sweep.report import detector_charts, flight_charts
from sweep.report.html_page import PlotControl
from sweep.report.study_report import write_report
from sweep.spec import GridSpec
from sweep.tasks import driver


def _spec_in(page):
    text = re.search(r"<pre[^>]*>(title:.*?)</pre>", page.read_text(), re.S).group(1)
    for escaped, meant in (("&lt;", "<"), ("&gt;", ">"), ("&#39;", "'"), ("&#34;", '"')):
        text = text.replace(escaped, meant)
    return yaml.safe_load(text.replace("&amp;", "&"))


def test_the_spec_on_the_page_is_the_study_s_own(grid_page, grid_store):
    spec = GridSpec.from_mapping(_spec_in(grid_page))
    assert spec.id == json.loads((grid_store / "zarr.json").read_text())["attributes"]["study_id"]
    assert spec.id in grid_page.read_text()


def test_the_page_says_that_it_is_reduced_and_asks_nothing_of_a_network(grid_page):
    text = grid_page.read_text()
    assert "each cell stands for 3 neighbouring points of 3,603" in text
    assert re.search(r"[0-9]+ of 7,206 points, spread over all: reduced for this page", text)
    page_text = re.sub(r"<script>.*?</script>", "", text, flags=re.S)
    assert not re.findall(r"(?:src|href)=[\"']?(?:https?:)?//(?!itables\.org)", page_text)
    assert "default-src 'none'" in page_text
    assert 1e6 < grid_page.stat().st_size < 3e6
    libraries = r'<script type="application/gzip" id="(?:plotly|tables-library)">.*?</script>'
    assert len(re.sub(libraries, "", text, flags=re.S)) < 0.5e6


def test_the_options_of_a_table_are_in_one_order_from_run_to_run(grid_page):
    packed = r'compact"></table><script type="application/gzip">(.*?)</script>'
    for table_options in re.findall(packed, grid_page.read_text()):
        options = json.loads(gzip.decompress(base64.b64decode(table_options)))
        assert list(options) == sorted(options) and len(options) > 5


def test_figures_without_points_are_reported_and_whole_spectra_have_no_threshold_to_move(tmp_path):
    figures = [{"kind": "slices", "variable": "pd_shot", "x": "range", "title": "Elsewhere",
                "where": {"range": "7 km"}}]  # fmt: skip
    kinds = {"instrument.processing.detector.kind": ["fixed", "ca_cfar"]}
    spec = GridSpec.from_mapping(
        GRID_SPEC
        | {
            "instrument": {"file": GRID_SPEC["instrument"], "processing": {"fft_size": "2^12"}},
            "axes": {"target.range": ["1 km", "2 km"], "target.grazing_angle": ["45 deg"]} | kinds,
            "draws": {"method": "spectra", "number": 3},
            "figures": figures,
        },
        base=EXPERIMENTS,
    )
    store = tmp_path / "spectra.zarr"
    driver.run(spec, store=store, scheduler="none", progress=False)
    text = write_report(store, tmp_path / "spectra.html").read_text()
    assert "No point of the study is within its limits." in text
    assert "Receiver operating characteristic" not in text and "Noise by source" in text


def test_an_incomplete_store_says_so(tmp_path):
    axes = {"target.range": ["1 km", "2 km"], "target.grazing_angle": ["45 deg"]}
    spec = GridSpec.from_mapping(
        GRID_SPEC | {"axes": axes, "figures": [], "storage": {"block_points": 1}}, base=EXPERIMENTS
    )
    store = tmp_path / "half.zarr"
    driver.run(spec, store=store, scheduler="none", progress=False)
    receipts = store / ".sweep" / "receipts.jsonl"
    receipts.write_text(receipts.read_text().splitlines(keepends=True)[0])
    page = write_report(store, tmp_path / "half.html")
    assert "The study is not complete: 1 of 2 points are computed." in page.read_text()


@pytest.mark.parametrize("axes", [{}, {"instrument.processing.window": ["hann", "hamming"]}])
def test_studies_without_a_numeric_axis_have_a_page(tmp_path, axes):
    target = GRID_SPEC["target"] | {"range": "2 km", "grazing_angle": "60 deg"}
    spec = GridSpec.from_mapping(GRID_SPEC | {"axes": axes, "target": target, "figures": []},
                             base=EXPERIMENTS)  # fmt: skip
    store = tmp_path / "point.zarr"
    driver.run(spec, store=store, scheduler="none", progress=False)
    text = write_report(store, tmp_path / "point.html").read_text()
    assert "Receiver operating characteristic" in text and "Noise by source" in text


def test_characteristics_are_those_of_the_answers_and_alarms_those_of_the_model(grid_store):
    study = GridResults.from_store(grid_store)
    (track, *_), _ = detector_charts.grid_profiles(study)
    chart = detector_charts.roc_chart(study, [track], 0)
    (place, *_) = detector_charts._roc_point_indices(track)
    point = study.dataset.isel(track.axis_indices(place))
    curve = point.sweep.roc(detector_charts.ROC_PFA_BIN_VALUES)
    by_alarm = {panel.facet_choices["alarm"]: panel.lines[0] for panel in chart.panels}
    for line in by_alarm.values():
        np.testing.assert_allclose(line.y, curve["pd"], rtol=1e-6)
    position = track.axis_indices(place)
    at = {
        m.path: m.values[position[axis.name]] for axis in study.spec.axes for m in axis.parameters
    }
    of_model = evaluate(study.spec.parameters() | at | {TNR_PATH: curve["curve_tnr"].values}, [])
    for alarm, name in (("in a bin", "pfa_bin"), ("in a segment", "pfa_segment"),
                        ("in both chirps", "pfa_both_chirps")):  # fmt: skip
        # the model leaves out the few bins in which the target lies
        np.testing.assert_allclose(by_alarm[alarm].x, of_model[name], rtol=2e-2, atol=1e-30)


def test_a_flight_s_page_names_the_floor_of_its_errors(scene_page):
    """Under the chart of navigation, and field by field."""
    page = scene_page.read_text()
    held = " ".join(
        gzip.decompress(base64.b64decode(table)).decode()
        for table in re.findall('</table><script type="application/gzip">(.*?)</script>', page)
    )
    assert "rrors that no echo lowers: clock error 1e-06, vibration 1 cm/s." in page
    assert all(f"error_floor.{name}" in held for name in ("pointing_error", "wavelength_error"))


def _answer(page):
    """The paragraphs that open a page."""
    (text,) = re.findall('<section id="answer".*?</section>', page.read_text(), re.DOTALL)
    return re.findall("<p>(.*?)</p>", text)


def test_a_grid_s_page_opens_with_reach_alarms_and_tolerance(grid_page, grid_store):
    dataset = sweep.open(grid_store)
    pd, reach = dataset["pd_shot"], dataset.sweep.maximum_range(0.9)["unbroken"] / 1000
    lacking = int(reach.isnull().sum())
    assert 0 < lacking < reach.size
    answer = _answer(grid_page)
    alarm, of_noise = (
        answer.pop(3),
        "Noise alone raises a false alarm in either chirp with probability ",
    )
    pfa_both = (
        1 - (1 - float(dataset["pfa_segment"].max())) ** 2
    )  # but for the few bins of the echo
    assert float(alarm.removeprefix(of_noise).rstrip(".")) == pytest.approx(pfa_both, rel=1e-2)
    assert answer == [
        "The probability of detection of a shot is 0.9 or more at "
        f"{int((pd >= 0.9).sum()):,} of {pd.size:,} points; its mean is {float(pd.mean()):.3g}, "
        f"its lowest {float(pd.min()):.3g}.",
        "Maximum range with a probability of 0.9 or more all the way: "
        f"{float(reach.min()):.3g} to {float(reach.max()):.3g} km.",
        f"No maximum range at {lacking} of {reach.size} places: there the probability is below 0.9 "
        "from the first range on, or 0.9 or more up to the last.",
        "The tolerance of 0.001 is kept at all of these points.",
        "Whether the number of beamlets keeps it is not checked at 7,206 of them: their number is "
        "given, or their amplitudes add.",
    ]


def test_a_flight_s_page_opens_with_its_points_and_velocities(scene_page, scene_store):
    group = sweep.open_scene(scene_store)["four"].to_dataset()
    flags, status = group["flags"].values, group["velocity_status"]
    true = int(((flags & TRUE_RETURN_FLAG) > 0).sum())
    shots = flags[..., 0].size
    answer = _answer(scene_page)
    assert answer[1] == (
        f"{shots:,} shots brought back {true:,} true points and {int((flags > 0).sum()) - true:,} "
        "false ones; a shot counts once a draw."
    )
    assert answer[2].startswith(
        f"Velocity was solved in {int((status <= 1).sum())} of {status.size}"
    )


def test_an_answer_from_the_parts_that_a_page_shows_says_so():
    counts = pandas.DataFrame([{"what": "four", "shots": 20, "true": 18, "false alarm": 1}] * 2)
    assert flight_charts.point_count_sentences(counts, [], 3) == [
        "In the 2 of 5 parts of the study shown here, 40 shots brought back 36 true points and 2 "
        "false ones; a shot counts once a draw."
    ]


def test_errors_of_a_flight_are_measured_less_true(scene_store):
    study = SceneResults.from_store(scene_store)
    recordings, _ = flight_charts.select_recordings(study)
    chart = flight_charts.measurement_error_chart(recordings)
    group = study.tree["four"].to_dataset().isel(draw=0, optical_efficiency=0)
    true = (group["flags"].values & TRUE_RETURN_FLAG) > 0
    expected = (group["range_interpolated"] - group["true_range"]).values[true]
    values = np.concatenate([line.y for line in chart.panels[0].lines])
    np.testing.assert_array_equal(np.sort(values), np.sort(expected))
    assert f"rms {np.sqrt(np.mean(expected**2)):.3g}" in chart.panels[0].facet_choices["quantity"]


def test_parts_of_a_study_open_in_their_middle():
    assert [
        PlotControl("part", "", list("abcdef")[:n]).initial_option_index for n in (1, 2, 3, 6)
    ] == [
        0,
        0,
        1,
        2,
    ]
    assert PlotControl("answer", "", list("abc")).initial_option_index == 0


def test_what_is_no_study_is_refused_in_words(tmp_path, scene_store):
    missing = CliRunner().invoke(main, ["report", str(tmp_path / "none.zarr")])
    assert missing.exit_code == 2 and "there is no store at" in missing.stderr
    (eyepoints,) = (scene_store.parent / "eyepoints").glob("*.zarr")
    with pytest.raises(NotAStoreError, match="holds the eyepoints of a flight"):
        write_report(eyepoints, tmp_path / "page.html")
    assert not list(tmp_path.glob("*.html"))


MEMORY = """
import resource, sys
from sweep.report.study_report import write_report
from sweep.spec import GridSpec
from sweep.tasks.studies.grid_study import GridStudy
from sweep.tasks.engine.study_store import create_store

spec = GridSpec.from_mapping({mapping!r}, base={base!r})
create_store(sys.argv[1], GridStudy(spec))
write_report(sys.argv[1], sys.argv[1] + ".html")
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
"""


@pytest.mark.slow
def test_a_hundred_million_points_take_little_more_memory_than_a_million(tmp_path):
    peaks = []
    for number in (10_000, 1_000_000):
        axes = {
            "target.range": {"linear": ["1 m", "12 km"], "number": number},
            "target.grazing_angle": {"linear": ["1 deg", "90 deg"], "number": 100},
        }
        mapping = GRID_SPEC | {"axes": axes, "figures": GRID_SPEC["figures"][:1]}
        code = MEMORY.format(mapping=mapping, base=str(EXPERIMENTS))
        store = tmp_path / f"{number}.zarr"
        ran = subprocess.run(
            [sys.executable, "-c", code, str(store)], check=True, capture_output=True, text=True
        )
        peaks.append(int(ran.stdout))
    assert peaks[1] < peaks[0] + 300_000, peaks  # an array of all points alone has 800 MB


def test_a_place_of_a_flight_without_computed_shots_has_no_panel_over_time(scene_store, tmp_path):
    store = tmp_path / "scene.zarr"
    shutil.copytree(scene_store, store)
    shutil.rmtree(store / "four" / "flags" / "c" / "0")  # of the first of two places
    (store / ".sweep" / "receipts.jsonl").unlink()  # what is committed has to be there
    recordings, _ = flight_charts.select_recordings(SceneResults.from_store(store))
    for chart in (
        flight_charts.shots_over_time_chart(recordings),
        flight_charts.measurement_error_chart(recordings),
    ):
        assert {panel.facet_choices["cloud"] for panel in chart.panels} == {recordings[1].label}
        assert all(panel.lines for panel in chart.panels)
