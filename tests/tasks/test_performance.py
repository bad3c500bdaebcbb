from small_studies import RecordingProgress, file_digests, small_spec

from sweep.tasks.driver import run


def test_dasks_own_account_of_a_run_is_a_page_and_changes_no_result(serial_store, tmp_path):
    file, progress = tmp_path / "new" / "report.html", RecordingProgress()
    outcome = run(
        small_spec(), store=tmp_path / "small.zarr", workers=2, processes=False, progress=progress,
        performance_report=file,
    )  # fmt: skip
    assert outcome.complete and f"performance report: {file}" in progress
    page = file.read_text()
    assert "<html" in page and "Dask Performance Report" in page and "blocks-" in page
    assert file_digests(outcome.store) == file_digests(serial_store)


def test_what_cannot_be_reported_is_said_and_fails_no_run(tmp_path):
    progress = RecordingProgress()
    options = {"store": tmp_path / "plain.zarr", "scheduler": "none", "progress": progress}
    assert run(small_spec(), performance_report=tmp_path / "no.html", **options).complete
    assert any("a plain loop has no scheduler" in text for text in progress)
    assert not (tmp_path / "no.html").exists()
    (tmp_path / "file").write_text("")
    outcome = run(
        small_spec(), store=tmp_path / "small.zarr", workers=1, processes=False, progress=progress,
        performance_report=tmp_path / "file" / "no.html",
    )  # fmt: skip
    assert outcome.complete and progress[-1].startswith("no performance report: ")
