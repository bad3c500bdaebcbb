"""Dask's dashboard: there when it is asked for, and listening to this machine alone."""

import socket
import urllib.error
import urllib.request

import psutil
import pytest
from small_studies import RecordingProgress, small_spec

from sweep.spec import SpecError, cluster_config_from_mapping, load_cluster_config
from sweep.spec.cluster_config import WorkerBounds
from sweep.tasks.driver import run
from sweep.tasks.engine import cluster_connection as clusters
from sweep.tasks.engine.deploy import local_ssh
from sweep.tasks.engine.progress import ClusterError
from sweep.tasks.engine.session import RunOptions
from sweep.tasks.studies.workload import SpecWorkload

PAGES = ("status", "info/main/workers.html", "json/counts.json", "metrics", "statics/", "health")
"""Pages of a scheduler or a worker of Dask."""


def reached(**section):
    """Cluster of one worker in this process, with a section `scheduler`, and what is said."""
    progress = RecordingProgress()
    described = cluster_config_from_mapping({"kind": "local", "workers": 1, "scheduler": section})
    return clusters.connect_cluster(
        described, max_workers=1, processes=False, say=progress.say
    ), progress


def pages_by_port():
    """HTTP status of each page at each port that this process or its children listen at."""
    processes = [psutil.Process(), *psutil.Process().children(recursive=True)]
    answers = {}
    for process in processes:
        for connection in process.net_connections():
            if connection.status == psutil.CONN_LISTEN:
                answers[connection.laddr] = [status(connection.laddr, page) for page in PAGES]
    return answers


def status(address, page):
    """HTTP status of a page; 0 where no web server answers."""
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{address.port}/{page}", timeout=5) as answer:
            return answer.status
    except urllib.error.HTTPError as error:
        return error.code
    except (OSError, ValueError):
        return 0


def test_no_page_is_shown_unless_a_dashboard_is_asked_for():
    connected, progress = reached()
    before = set(pages_by_port())
    with connected:
        opened = {a: s for a, s in pages_by_port().items() if a not in before}
    assert opened and not any("dashboard" in line for line in progress)
    assert not any(code == 200 for codes in opened.values() for code in codes)


@pytest.mark.parametrize("setting", [0, "0", "127.0.0.1:0", "localhost:0"])
def test_a_dashboard_that_is_asked_for_listens_to_this_machine_alone(setting):
    connected, progress = reached(dashboard=setting)
    before = set(pages_by_port())
    with connected:
        opened = {a: s for a, s in pages_by_port().items() if a not in before}
    assert any("dashboard http://127.0.0.1:" in line for line in progress)
    reachable = {address for address, codes in opened.items() if 200 in codes}
    assert reachable and {address.ip for address in reachable} == {"127.0.0.1"}


@pytest.mark.parametrize(
    "address", [":8787", "0.0.0.0:8787", "10.0.0.5:8787", "[::]:8787", "node1:8787", "yes", True]
)
def test_a_dashboard_for_other_machines_is_refused(address):
    with pytest.raises(SpecError, match=r"scheduler\.dashboard: .*write a port, such as 8787"):
        cluster_config_from_mapping({"kind": "local", "scheduler": {"dashboard": address}})


def test_a_dashboard_has_the_port_asked_for_or_any_where_that_is_taken():
    with socket.socket() as occupied:
        occupied.bind(("127.0.0.1", 0))
        port = occupied.getsockname()[1]
        scheduler_config = cluster_config_from_mapping(
            {"kind": "local", "scheduler": {"dashboard": port}}
        ).scheduler
        assert local_ssh.dashboard_address(scheduler_config) == "127.0.0.1:0"
    assert local_ssh.dashboard_address(scheduler_config) == f"127.0.0.1:{port}"


def test_schedulers_of_jobs_and_of_ssh_have_none_either():
    section = {"host": "10.0.0.5"}
    mapping = {"kind": "slurm", "workers": 2, "worker": {"memory": "4 GB"},
             "job": {"walltime": "1 h"}, "scheduler": section}  # fmt: skip
    options = local_ssh.scheduler_options(cluster_config_from_mapping(mapping).scheduler)
    assert options["dashboard"] is False and options["dashboard_address"] == "127.0.0.1:0"
    mapping["scheduler"] = section | {"dashboard": 0}
    options = local_ssh.scheduler_options(cluster_config_from_mapping(mapping).scheduler)
    assert options["dashboard"] is True and options["dashboard_address"] == "127.0.0.1:0"


def test_a_run_asks_for_a_dashboard_by_an_option(tmp_path):
    place = RunOptions(workers=1, dashboard=True).resolve_cluster(SpecWorkload(small_spec()))
    assert place.scheduler.dashboard == "8787"
    assert RunOptions(dashboard=True).resolve_cluster(SpecWorkload(small_spec())).workers is None
    assert (
        RunOptions(workers=1).resolve_cluster(SpecWorkload(small_spec())).scheduler.dashboard
        == "none"
    )
    cluster = {"kind": "local", "workers": 2, "scheduler": {"dashboard": "9000"}}
    resolved = RunOptions(cluster=cluster, dashboard=True).resolve_cluster(
        SpecWorkload(small_spec())
    )
    assert resolved.scheduler.dashboard == "9000" and resolved.workers == WorkerBounds(2, 2)
    for scheduler in ("none", "tcp://10.0.0.5:8786"):
        with pytest.raises(ClusterError, match="leave out dashboard=True"):
            run(small_spec(), store=tmp_path / "a.zarr", scheduler=scheduler, dashboard=True)


def test_the_example_of_a_local_cluster_has_no_dashboard():
    from pathlib import Path

    described = load_cluster_config(Path(__file__).parents[2] / "deploy" / "local.yaml")
    assert not local_ssh.shows_dashboard(described.scheduler)
