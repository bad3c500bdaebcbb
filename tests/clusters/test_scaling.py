"""Workers between bounds, and a file's options as the command and Python take them."""

import pytest
from click.testing import CliRunner
from small_studies import file_digests, run_serially, small_spec

from sweep.cli import main
from sweep.spec import cluster_config_from_mapping
from sweep.tasks.engine import cluster_connection, session
from sweep.tasks.engine.progress import ClusterError

LOCAL = {"kind": "local", "scheduler": {"dashboard": "127.0.0.1:0"}}


@pytest.mark.slow
def test_a_cluster_between_bounds_grows_with_the_work(serial_store, tmp_path):
    log = tmp_path / "pids"

    def evaluate(study, block):
        import os
        import time

        with open(log, "a") as lines:
            lines.write(f"{os.getpid()}\n")
        deadline = time.monotonic() + 60  # the first waits for the second to come
        while len(set(log.read_text().split())) < 2 and time.monotonic() < deadline:
            time.sleep(0.1)
        return study.evaluate(block)

    described = {**LOCAL, "workers": {"least": 1, "most": 2}}
    outcome = run_serially(
        small_spec(), tmp_path / "grown.zarr", cluster=described, evaluate=evaluate
    )
    assert outcome.complete
    assert file_digests(outcome.store) == file_digests(serial_store)
    assert len(set(log.read_text().split())) >= 2


def test_no_more_workers_are_started_than_there_are_blocks():
    bounds = cluster_connection.WorkerBounds(2, 40)
    described = cluster_config_from_mapping({**LOCAL, "workers": bounds._asdict()})
    assert cluster_connection._worker_bounds(described, 9) == (2, 9)
    assert cluster_connection._worker_bounds(described, 1) == (1, 1)
    assert cluster_connection._worker_bounds(cluster_config_from_mapping(LOCAL), 10**6) == (
        cluster_connection.cpu_count(),
        cluster_connection.cpu_count(),
    )


def test_a_number_of_workers_fixes_those_of_a_file_and_none_are_started_elsewhere():
    described = cluster_config_from_mapping({**LOCAL, "workers": {"least": 2, "most": 40}})
    assert session._with_worker_count(described, 7).workers == (7, 7)
    assert session._with_worker_count(described, None) is described
    with pytest.raises(ClusterError, match="there already"):
        session._with_worker_count(
            cluster_config_from_mapping({"kind": "scheduler", "address": "tcp://a:1"}), 3
        )


def test_the_command_tells_what_is_wrong_with_a_clusters_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    from pathlib import Path

    import sweep

    spec = Path(sweep.__file__).parents[1] / "experiments" / "quickstart.yaml"
    (tmp_path / "bad.yaml").write_text("kind: slurm\nworkers: none\n")
    result = CliRunner().invoke(main, ["run", str(spec), "--cluster", "bad.yaml"])
    assert result.exit_code == 2
    assert "bad.yaml:2: workers: must be a number" in result.output
    assert not (tmp_path / "results").exists()
    (tmp_path / "local.yaml").write_text("kind: local\n")
    arguments = ["run", str(spec), "--cluster", "local.yaml", "--scheduler", "none"]
    result = CliRunner().invoke(main, arguments)
    assert result.exit_code == 2
    assert "both named" in result.output
    assert not (tmp_path / "results").exists()
