"""`sweep accuracy` from spec to table, store and figure, and what it refuses."""

import pytest
from test_cli import STUDY, refused, sweep

from sweep.tasks.accuracy import measurement


@pytest.fixture
def working_directory(tmp_path, monkeypatch):
    """A directory of one's own with a spec, small.yaml, in it, and little patience."""
    coherent = STUDY.replace("beamlets: 9", "beamlets: 9, phases: coherent")
    (tmp_path / "small.yaml").write_text(coherent)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(measurement, "ROUNDS_MAX", 1)
    monkeypatch.setattr(measurement, "TRIAL_TIME_FRACTION", 1e-4)
    monkeypatch.setattr(measurement, "TIME_DOMAIN_TIME_FRACTION", 0.0)
    return tmp_path


def test_the_command_prints_tables_and_statements_and_writes_store_figure_and_text(
    working_directory,
):
    result = sweep("accuracy", "small.yaml", "--points", "6")
    assert result.exit_code == 0
    for message in (
        "auto at 1e-06", "all effects on", "thesis 2^12, folded, degree 9", "Cheapest setting",
        "As written:", "thesis's way is compared at its own error", "best single fixed setting",
        "time domain", "small_accuracy.zarr", "small_accuracy.png",
    ):  # fmt: skip
        assert message in result.stdout, message
    assert "6 points" in result.stderr and "trials" in result.stderr
    results = working_directory / "results"
    assert (results / "small_accuracy.png").stat().st_size > 10_000
    assert "Settings" in (results / "small_accuracy.txt").read_text()
    names = {path.name for path in results.iterdir()}
    assert names == {f"small_accuracy.{suffix}" for suffix in ("zarr", "png", "txt")}
    store = results / "small_accuracy.zarr"
    refused(sweep("accuracy", "small.yaml"), "--overwrite")
    refused(sweep("status", store), "holds what accuracy costs")
    refused(sweep("resume", store), "holds what accuracy costs")
    figures_result = sweep("figures", store, "--output", "drawn")
    assert (
        figures_result.exit_code == 0
        and (working_directory / "drawn" / "small_accuracy.png").exists()
    )


def test_mistakes_end_in_plain_words_and_exit_code_2(working_directory):
    refused(sweep("accuracy", "absent.yaml"), "does not exist")
    refused(sweep("accuracy", "small.yaml", "--points", "0"), "--points")
    refused(sweep("accuracy", "small.yaml", "--time-limit", "0"), "--time-limit")
    (working_directory / "wrong.yaml").write_text(STUDY.replace("25 mm", "25"))
    refused(sweep("accuracy", "wrong.yaml"), "telescope")
    (working_directory / "notes").mkdir()
    (working_directory / "notes" / "note.txt").write_text(
        "a note"
    )  # an empty folder can become a store
    refused(sweep("accuracy", "small.yaml", "--store", "notes"), "is not a Zarr store")
    assert not (working_directory / "results").exists()


def test_nothing_is_left_where_it_is_broken_off_at_once(working_directory, monkeypatch):
    def broken(self):
        raise measurement.NoMeasurementError

    monkeypatch.setattr(measurement.AccuracyMeasurement, "run", broken)
    result = sweep("accuracy", "small.yaml")
    assert result.exit_code == 3 and "nothing is kept" in result.stderr
    assert not (working_directory / "results").exists()


def test_an_interrupted_measurement_reports_what_is_kept_and_exits_3(
    working_directory, monkeypatch
):
    run = measurement.AccuracyMeasurement.run

    def cut(self):
        outcome = run(self)
        outcome.stop_reason = measurement.StopReason.INTERRUPTED
        return outcome

    monkeypatch.setattr(measurement.AccuracyMeasurement, "run", cut)
    result = sweep("accuracy", "small.yaml", "--points", "3")
    assert result.exit_code == 3 and "(interrupted): 3 points" in result.stdout
    assert (working_directory / "results" / "small_accuracy.png").exists()


def test_a_study_that_was_run_into_its_place_meanwhile_is_left_alone(
    working_directory, monkeypatch
):
    run, store = measurement.AccuracyMeasurement.run, "results/small_accuracy.zarr"

    def beside_another(self):
        assert sweep("run", "small.yaml", "--scheduler", "none", "--store", store).exit_code == 0
        return run(self)

    monkeypatch.setattr(measurement.AccuracyMeasurement, "run", beside_another)
    refused(sweep("accuracy", "small.yaml", "--points", "3", "--overwrite"), "a study's results")
    assert "complete" in sweep("status", store).stdout
