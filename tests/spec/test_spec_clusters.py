"""Files of clusters: what they hold, and every mistake in one at once, with its line."""

from pathlib import Path

import pytest

from sweep.spec import SpecError, cluster_config_from_mapping, load_cluster_config

DEPLOY = Path(__file__).parents[2] / "deploy"

SLURM = {
    "kind": "slurm",
    "workers": 8,
    "worker": {"memory": "4 GB"},
    "job": {"walltime": "2 h"},
    "scheduler": {"interface": "ib0"},
}


def slurm(**changes):
    return {name: v for name, v in (SLURM | changes).items() if v is not ...}


@pytest.mark.parametrize(
    ("mapping", "message"),
    [
        ({}, "lacks its kind; write kind: and one of local, scheduler, ssh"),
        (slurm(kind="slrum"), "kind: must be one of local"),
        (slurm(kind="slrum"), "did you mean 'slurm'?"),
        (slurm(kind=3), "kind: must be one of local"),
        (slurm(workers=...), "workers: is missing"),
        (slurm(workers=0), "workers: must be at least 1 (you wrote 0); write e.g. 8 or {least"),
        (slurm(workers="4 m"), "workers: is a pure number and takes no unit"),
        (slurm(workers={"least": 9, "most": 2}), "workers: has a least above its most"),
        (slurm(workers={"least": 1}), "workers: must have a least and a most"),
        (slurm(workers={"least": 1, "most": 1.5}), "a most that must be a whole number"),
        (slurm(worker={}), "worker.memory: is missing; write e.g. 'memory: 4 GB'"),
        (slurm(worker={"memory": 4}), "worker.memory: needs a unit (you wrote 4)"),
        (slurm(worker={"memory": "4 gb"}), "did you mean 'GB'?"),
        (slurm(worker={"memory": "4 m"}), "worker.memory: needs a unit like byte"),
        (slurm(worker={"memory": "1 MB"}), "worker.memory: must be at least 64 MB"),
        (slurm(worker={"memory": "4 GB", "thread": 2}), "did you mean 'threads'?"),
        (slurm(job={"walltime": "2 GB"}), "job.walltime: needs a unit like s"),
        (slurm(job={"walltime": "5 s"}), "job.walltime: must be at least 1 min"),
        (slurm(job={"walltime": "1 h", "queue": "a; rm"}), "job.queue: is no valid text"),
        (slurm(job={"walltime": "1 h", "prologue": "ls"}), "prologue: must be a list of texts"),
        (slurm(scheduler={}), "scheduler: must state where workers on other machines reach it"),
        (slurm(scheduler={"host": "a", "interface": "b"}), "both a host and an interface"),
        (slurm(scheduler={"host": "a", "prt": 1}), "scheduler.prt: is no field"),
        (slurm(environment={"A B": "1"}), "environment: holds 'A B', which is no name"),
        (slurm(environment={"A": "it's"}), "environment: holds a quote"),
        (slurm(security={"ca": "/no/ca"}), "security.certificate: is missing"),
        (slurm(hosts=["a"]), "hosts: is no field; the fields here are security, environment"),
        (slurm(walltime="1 h"), "walltime: is no field; did you mean 'job.walltime'?"),
        ({"kind": "scheduler", "address": "10.0.0.5"}, "write e.g. 'tcp://10.0.0.5:8786'"),
        ({"kind": "scheduler", "address": "tls://a:1"}, "address: is encrypted, and no certif"),
        ({"kind": "local", "worker": {"memory": "lots"}}, "worker.memory: must be a number"),
    ],
)  # fmt: skip
def test_a_mistake_is_reported_with_its_place_and_a_remedy(mapping, message):
    with pytest.raises(SpecError) as error_info:
        cluster_config_from_mapping(mapping)
    assert message in str(error_info.value)


def test_certificates_must_be_there(tmp_path):
    security = {name: f"{name}.pem" for name in ("ca", "certificate", "key")}
    with pytest.raises(SpecError) as error_info:
        cluster_config_from_mapping(slurm(security=security), base=tmp_path)
    assert [mistake.path for mistake in error_info.value.mistakes] == [
        "security.ca", "security.certificate", "security.key",
    ]  # fmt: skip
    assert "sweep certificates" in str(error_info.value)
    for name in security.values():
        (tmp_path / name).touch()
    cluster = cluster_config_from_mapping(slurm(security=security), base=tmp_path)
    assert cluster.certificate_paths() == tuple(str(tmp_path / name) for name in security.values())
    plain_mapping = {"kind": "scheduler", "address": "tcp://a:1", "security": security}
    with pytest.raises(SpecError, match="is not encrypted"):
        cluster_config_from_mapping(plain_mapping, base=tmp_path)


def test_mistakes_come_together_each_with_its_line(tmp_path):
    file = tmp_path / "slurm.yaml"
    file.write_text("kind: slurm\nworkers: 0\nworker: {memory: 4}\nscheduler: {interface: ib0}\n")
    with pytest.raises(SpecError) as error_info:
        load_cluster_config(file)
    assert [(m.path, m.line) for m in error_info.value.mistakes] == [
        ("job", 1), ("workers", 2), ("worker.memory", 3),
    ]  # fmt: skip


def test_values_are_bytes_seconds_and_bounds():
    cluster = cluster_config_from_mapping(slurm(workers={"least": 2, "most": 40}))
    assert cluster.worker.memory == 4e9
    assert cluster.job.walltime == 7200
    assert cluster.workers == (2, 40)
    assert cluster_config_from_mapping(SLURM).workers == (8, 8)


@pytest.mark.parametrize("name", ["local", "scheduler", "ssh", "slurm", "pbs", "kubernetes"])
def test_the_files_that_come_along_can_be_read(name):
    assert load_cluster_config(DEPLOY / f"{name}.yaml").kind == name


def test_each_kind_has_its_file():
    assert {file.stem for file in DEPLOY.glob("*.yaml")} == {
        "local", "scheduler", "ssh", "slurm", "pbs", "kubernetes",
    }  # fmt: skip


def test_a_file_of_an_unknown_user_is_reported_as_missing():
    mapping = {
        "kind": "scheduler", "address": "tls://127.0.0.1:8786",
        "security": dict.fromkeys(("ca", "certificate", "key"), "~nobody-here/key.pem"),
    }  # fmt: skip
    with pytest.raises(
        SpecError, match=r"security.ca: names a file that does not exist .*~nobody-h"
    ):
        cluster_config_from_mapping(mapping)
    mapping = {
        "kind": "ssh", "workers": 1, "hosts": ["node1"], "worker": {"memory": "1 GB"},
        "scheduler": {"host": "localhost"}, "identity": "~nobody-here/id",
    }  # fmt: skip
    cluster = cluster_config_from_mapping(mapping)
    assert cluster.resolve_path(cluster.identity).endswith("~nobody-here/id")
