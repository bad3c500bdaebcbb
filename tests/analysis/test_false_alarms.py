import csv

import numpy as np
import pytest
import xarray as xr
from stored_studies import (
    CUT_AXIS,
    INSTRUMENT,
    POWER_AND_CUT_AXES,
    SURFACE_AXES,
    run_into_store,
    spec_over_axes,
)

from sweep.analysis import tables
from sweep.analysis.datasets import open as open_store
from sweep.analysis.selection import PointSelection, select_beyond_range, study_cuts

PRINTED = ((4.45e-9, 4.31e-9, 4.25e-9), (4.88e-9, 4.48e-9, 4.37e-9), (5.34e-9, 4.62e-9, 4.45e-9))


@pytest.fixture(scope="module")
def power(tmp_path_factory):
    path = run_into_store(tmp_path_factory.mktemp("power"), POWER_AND_CUT_AXES)
    return (
        PointSelection.from_dataset(open_store(path)),
        spec_over_axes(POWER_AND_CUT_AXES),
        open_store(path),
    )


@pytest.fixture(scope="module")
def entries(power):
    records, spec, _ = power
    return tables.false_alarm_records(records, spec, by="power", printed=PRINTED)


def test_rows_are_the_settings_and_columns_the_three_cuts(entries):
    assert [(e["setting"], e["cut"]) for e in entries[:4]] == [
        ("power 1 W", "15 deg"),
        ("power 1 W", "85 deg"),
        ("power 1 W", "3500 m"),
        ("power 3 W", "15 deg"),
    ]
    assert [e["printed"] for e in entries] == [figure for row in PRINTED for figure in row]


def test_noise_alone_is_the_closed_form_and_knows_nothing_of_power(entries):
    for entry in entries:
        assert entry["bins"] == 2**17
        assert entry["noise_only"] == pytest.approx(entry["closed_form"], rel=1e-9)
    assert len({entry["noise_only"] for entry in entries}) == 1


def test_noise_alone_follows_the_setting_of_its_row():
    spec = spec_over_axes({"instrument.processing.fft_size": ["2^16", "2^18"], "cut": CUT_AXIS})
    settings = ({"instrument.processing.fft_size": n} for n in (2**16, 2**18))
    sizes = [tables.noise_false_alarm_reference(spec, setting)[0] for setting in settings]
    assert [size["bins"] for size in sizes] == [2**16, 2**18]
    # 16 times the pairs of bins, to first order in N p = 1e-4
    assert sizes[1]["noise_only"] / sizes[0]["noise_only"] == pytest.approx(16.0, rel=2e-4)


def test_half_the_bins_give_a_quarter_of_the_alarms():
    processing = INSTRUMENT["processing"] | {"bins_counted": "half"}
    spec = spec_over_axes({}, instrument=INSTRUMENT | {"processing": processing})
    records, _ = tables.noise_false_alarm_reference(spec, {})
    assert records["bins"] == 2**16
    # the model leaves out the bins of the strongest line and its neighbours: 3 of 65,536
    assert records["noise_only"] == pytest.approx(records["closed_form"], rel=2 * 3 / 2**16)


def test_means_leave_out_ranges_up_to_5_m_and_count_no_point_twice(power, entries):
    _, _, dataset = power
    at_1_w = dataset.isel(power=0)
    chosen = (at_1_w.grazing_angle == 15) & (at_1_w.range > 5)
    pfa = at_1_w.pfa_both_chirps.values[chosen.values]
    ranges_at_1_w = at_1_w.range.values[chosen.values]
    # 3500 m at 15 deg lies on two cuts
    assert ranges_at_1_w.size == 19 and entries[0]["points"] == 18
    _, first = np.unique(ranges_at_1_w, return_index=True)
    assert entries[0]["study_mean"] == pytest.approx(pfa[first].mean(), rel=1e-14)


def test_the_echos_own_shot_noise_grows_with_power_and_is_all_that_the_mean_has_over_noise(entries):
    excesses = [e["study_variance_excess"] for e in entries if e["cut"] == "85 deg"]
    assert 0 < excesses[0] < excesses[1] < excesses[2]
    # shot noise is proportional to the light collected
    assert excesses[2] / excesses[0] == pytest.approx(5.0, rel=1e-3)


def test_the_printed_figures_imply_an_excess_between_a_tenth_and_one_percent(entries):
    assert all(0.001 < entry["printed_variance_excess"] < 0.01 for entry in entries)
    assert entries[0]["printed_variance_excess"] == pytest.approx(0.0029, abs=1e-4)


def leaked(ranges, up, down):
    """The leakage of made points along range."""
    noise = np.full(np.shape(up), 1e-4)
    values = {"p_leakage_up": up, "p_leakage_down": down, "pfa_segment": noise,
              "pfa_both_chirps": noise * 2e-4}  # fmt: skip
    variables = {name: (["range"], np.asarray(v, float)) for name, v in values.items()}
    dataset = xr.Dataset(variables, {"range": ("range", ranges, {"units": "m"})})
    (record,) = tables.leakage_records([PointSelection.from_dataset(dataset)])
    return record


def test_leakage_is_reported_as_mean_and_median():
    result = leaked([5.0, 20.0, 300.0, 4000.0], [0.0, 0.0, 0.06, 0.02], [0.0, 0.0, 0.03, 0.0])
    assert result["p_leakage_up_mean"] == pytest.approx(0.02)
    assert result["p_leakage_up_median"] == pytest.approx(0.01)
    assert result["p_leakage_down_mean"] == pytest.approx(0.0075)
    assert result["p_leakage_down_median"] == 0.0


def test_a_shot_counts_noise_or_leakage_in_each_of_both_segments():
    result = leaked([5.0, 20.0], [0.5, 0.0], [0.1, 0.0])
    up, down = 1 - 0.5 * (1 - 1e-4), 1 - 0.9 * (1 - 2e-4)
    assert result["shot_with_leakage_mean"] == pytest.approx(
        (up * down + 1e-4 * 2e-4) / 2, rel=1e-12
    )


def test_points_not_computed_have_no_leakage_to_tell():
    nothing = [np.nan, np.nan]
    result = leaked([5.0, 20.0], nothing, nothing)
    assert len(result) == 6 and np.isnan(list(result.values())).all()


def test_a_grid_is_cut_where_the_thesis_cuts_it_and_left_whole_without_range_and_angle():
    grid = spec_over_axes(
        {"target.range": ["1 km", "3.5 km"], "target.grazing_angle": ["15 deg", "30 deg"]}
    )
    assert [(c.name, c.varying_coordinate) for c in study_cuts(grid)] == [
        ("15 deg", "range"),
        ("3.5 km", "grazing_angle"),
    ]
    assert [c.name for c in study_cuts(spec_over_axes({"instrument.laser.power": ["1 W"]}))] == [
        "all"
    ]


def test_the_page_holds_every_figure_in_text_and_csv(power, tmp_path):
    power_records, spec, _ = power
    page = tables.false_alarm_page(
        power_records, spec, by="power", printed=PRINTED, title="Table 4.3"
    )
    text, table = page.save_files(tmp_path, "table_4_3")
    table_text = text.read_text()
    assert table_text.startswith("Table 4.3\n=========")
    assert "3.934721e-09" in table_text and "4.450e-09" in table_text and "1.131" in table_text
    with table.open() as file:
        records = list(csv.DictReader(file))
    assert len(records) == 9
    assert float(records[0]["printed_over_closed_form"]) == pytest.approx(4.45 / 3.934721, rel=1e-6)


def test_the_page_of_a_study_that_nobody_printed_has_no_column_for_it(power):
    records, spec, _ = power
    assert (
        "printed/closed"
        not in tables.false_alarm_page(records, spec, by="power", title="T").to_text()
    )


def test_thresholds_have_the_chances_of_table_4_2(tmp_path):
    axes = {"instrument.processing.tnr": [1, 5, 10, 15], "target.range": ["1 km", "3 km"]}
    points = PointSelection.from_dataset(open_store(run_into_store(tmp_path, axes)))
    printed = (0.8, 0.047, 5.06e-10, 1.17e-21)
    page = tables.threshold_page(
        points, spec_over_axes(axes), by="tnr", printed=printed, title="Table 4.2"
    )
    for record, expected in zip(page.records, (0.807, 4.68e-3, 4.79e-10, 1.07e-21), strict=True):
        assert record["closed_form"] == pytest.approx(expected, rel=2e-3)
        assert record["noise_only"] == pytest.approx(record["closed_form"], rel=1e-12)
    assert page.records[2]["printed_variance_excess"] == pytest.approx(0.0026, abs=1e-4)
    assert [float(r["study_mean"]) >= float(r["noise_only"]) for r in page.records] == [True] * 4


def test_other_axes_than_range_and_angle_make_rows_of_their_own(tmp_path):
    axes = {
        "instrument.laser.power": ["1 W", "5 W"],
        "instrument.processing.fft_size": ["2^16", "2^17"],
        "target.range": {"log": ["10 m", "1 km"], "number": 3},
    }
    points = PointSelection.from_dataset(open_store(run_into_store(tmp_path, axes)))
    result = tables.false_alarm_records(points, spec_over_axes(axes), by="power")
    assert [e["setting"] for e in result][:2] == [
        "power 1 W, FFT size 2^16",
        "power 1 W, FFT size 2^17",
    ]
    assert [e["bins"] for e in result] == [2**16, 2**17] * 2


def test_surfaces_of_the_same_study_agree_with_the_whole(tmp_path):
    dataset = open_store(run_into_store(tmp_path, SURFACE_AXES))
    points = PointSelection.from_dataset(dataset)
    near = select_beyond_range(points, spec_over_axes(SURFACE_AXES), "10 m")
    assert near.n_points == 23 * 9
    assert (
        select_beyond_range(points, spec_over_axes(SURFACE_AXES), "10 m", inclusive=True).n_points
        == 24 * 9
    )
