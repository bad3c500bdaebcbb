"""A cluster in one YAML file: where workers run, how many, and who may talk to them.

No study names a cluster and no cluster a study: the same spec runs on any of them, to the same
bytes.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from pydantic import PrivateAttr, ValidationError

import sweep.spec.cluster_fields as of
from sweep.spec.cluster_fields import Bounds, Texts, Variables, WorkerNumber, word
from sweep.spec.instrument import Part
from sweep.spec.list_rules import File
from sweep.spec.mistakes import ABSENT, Finding, SpecError, near_miss
from sweep.spec.quantities import count
from sweep.spec.reading import Document, plain, read_document
from sweep.spec.rules import Text
from sweep.spec.translation import findings_of

LOOPBACK = "127.0.0.1"


class Security(Part):
    """Certificates with which all parts know each other, in PEM: traffic is TLS throughout."""

    ca: Annotated[str, File(about="Certificate of the authority that signed the others")]
    certificate: Annotated[str, File(about="Certificate of scheduler, workers and client")]
    key: Annotated[str, File(about="Its private key")]


class Worker(Part):
    """One worker process."""

    threads: Annotated[int, count("Threads, each with a block of its own", "1", at_most="1000")] = 1
    memory: Annotated[float, of.memory("Memory that it may take")]


class LocalWorker(Part):
    """One worker process of this machine."""

    threads: Annotated[int, count("Threads, each with a block of its own", "1", at_most="1000")] = 1
    memory: Annotated[
        float | None, of.memory("Memory that it may take; without one, its share of 90 % of it")
    ] = None


class Scheduler(Part):
    """Where the scheduler listens: to this machine alone unless told otherwise."""

    host: Annotated[str, word("Address that workers reach it by", "10.0.0.5")] = ""
    interface: Annotated[str, word("Or the network interface that it has", "ib0")] = ""
    port: Annotated[int, count("Port; 0 for any", "8786", at_least="0", at_most="65535")] = 0
    dashboard: Annotated[
        str, word("Address of the dashboard; port 0 for any", f"{LOOPBACK}:8787")
    ] = f"{LOOPBACK}:8787"


class Job(Part):
    """One job of a batch system, with one worker or several."""

    workers: Annotated[int, count("Workers of one job", "8", at_most="1000")] = 1
    walltime: Annotated[float, of.walltime("Time that a job may take; workers leave before it")]
    queue: Annotated[str, word("Queue or partition", "normal")] = ""
    account: Annotated[str, word("Account that is charged", "lidar")] = ""
    directives: Annotated[
        tuple[str, ...], Texts(about="Further options of the job", example="--exclusive")
    ] = ()
    prologue: Annotated[
        tuple[str, ...],
        Texts(about="Shell lines before the worker starts", example="module load python/3.12"),
    ] = ()
    logs: Annotated[str, word("Directory for what jobs print", "logs")] = "logs"


class Cluster(Part):
    """What every cluster has."""

    security: Security | None = None

    _base: Path = PrivateAttr(default=Path())

    def path(self, name: str) -> str:
        """Path of a file that the cluster's file names."""
        return str(self._base / Path(name).expanduser())

    def certificates(self) -> tuple[str, str, str] | None:
        """Paths of authority, certificate and key; None without security."""
        s = self.security
        if s is None:
            return None
        ca, certificate, key = map(self.path, (s.ca, s.certificate, s.key))
        return ca, certificate, key


class Started(Cluster):
    """What clusters have whose workers are started here."""

    environment: Annotated[dict[str, str], Variables(about="Environment variables of workers")] = {}  # noqa: RUF012


class Local(Started):
    """Processes of this machine."""

    kind: Literal["local"]
    workers: Annotated[
        Bounds | None, WorkerNumber(about="Workers; without a number, one a core")
    ] = None
    worker: LocalWorker = LocalWorker()
    scheduler: Scheduler = Scheduler()


class Address(Cluster):
    """A Dask scheduler that runs already."""

    kind: Literal["scheduler"]
    address: Annotated[
        str,
        Text(
            about="Address of the scheduler",
            pattern=r"(tcp|tls|ucx)://\S+:\d+",
            remedy="write e.g. 'tcp://10.0.0.5:8786', or tls:// with a security section",
        ),
    ]


class SSH(Started):
    """Machines that are reached by SSH."""

    kind: Literal["ssh"]
    hosts: Annotated[
        tuple[str, ...],
        Texts(about="Machines", example="node1, node2", of=word("A host", "node1"), least=1),
    ]
    workers: Annotated[Bounds, WorkerNumber(about="Workers, dealt out over the machines")]
    worker: Worker
    scheduler: Scheduler
    user: Annotated[str, word("User there; without one, as here", "lidar")] = ""
    port: Annotated[int, count("Port of SSH", "22", at_most="65535")] = 22
    identity: Annotated[str, File(about="Private key to log in with; without one, as ssh does")] = (
        ""
    )
    known_hosts: Annotated[str, File(about="Keys of known machines; without one, as ssh does")] = ""
    python: Annotated[str, word("Python there; without one, the path of this one", "python")] = ""


class Batch(Started):
    """Jobs of a batch system."""

    workers: Annotated[Bounds, WorkerNumber(about="Workers, in whole jobs")]
    worker: Worker
    job: Job
    scheduler: Scheduler
    python: Annotated[
        str, word("Python of the jobs; without one, the path of this one", "python")
    ] = ""


class Slurm(Batch):
    """Jobs of SLURM."""

    kind: Literal["slurm"]


class PBS(Batch):
    """Jobs of PBS."""

    kind: Literal["pbs"]


class Volume(Part):
    """A persistent volume that all pods and this machine see, for stores and scenes."""

    claim: Annotated[str, word("Its claim", "studies")]
    path: Annotated[str, word("Where it is mounted, the same as here", "/data")]


class Kubernetes(Started):
    """Pods that the Dask operator of a Kubernetes cluster starts."""

    kind: Literal["kubernetes"]
    workers: Annotated[Bounds, WorkerNumber(about="Workers, a pod each")]
    worker: Worker
    image: Annotated[str, word("Image with sweep in it", "registry.example.org/sweep:0.1.0")]
    name: Annotated[
        str,
        Text(
            about="Name of the cluster",
            pattern=r"[a-z]([a-z0-9-]{0,50}[a-z0-9])?",
            remedy="take small letters, digits and '-', such as 'sweep'",
        ),
    ] = "sweep"
    namespace: Annotated[str, word("Namespace", "lidar")] = "default"
    volume: Volume | None = None
    secret: Annotated[
        str,
        word("Secret with ca.pem, certificate.pem and key.pem, where there is TLS", "sweep-tls"),
    ] = ""


AnyCluster = Local | Address | SSH | Slurm | PBS | Kubernetes

KINDS: dict[str, type[Cluster]] = {
    get_args(model.model_fields["kind"].annotation)[0]: model for model in get_args(AnyCluster)
}


def load_cluster(path: str | Path) -> AnyCluster:
    """Cluster that a YAML file describes.

    Raises
    ------
    SpecError
        With every mistake in it, each with its path, its line and a remedy.
    """
    return _cluster(read_document(Path(path)), Path(path).absolute().parent)


def cluster_of(mapping: Mapping[str, Any], *, base: Path | str = ".") -> AnyCluster:
    """Cluster from plain data, written as in a file.

    Parameters
    ----------
    mapping : mapping
        What a cluster's file holds.
    base : path
        Folder that the files which it names are relative to.

    Raises
    ------
    SpecError
        With every mistake in it.
    """
    return _cluster(Document(plain(mapping)), Path(base).absolute())


def _cluster(document: Document, base: Path) -> AnyCluster:
    kind = document.value.get("kind", ABSENT)
    model = KINDS.get(kind) if isinstance(kind, str) else None
    findings = document.findings
    if model is None:
        raise SpecError([document.mistake(f) for f in (*findings, _no_kind(kind))])
    cluster: Any = None
    try:
        cluster = model.model_validate(document.value)
    except ValidationError as error:
        findings += findings_of(error, model)
    else:
        cluster._base = base
        findings += _together(cluster)
    if findings:
        mistakes = dict.fromkeys(document.mistake(finding) for finding in findings)
        raise SpecError(sorted(mistakes, key=lambda mistake: mistake.line or 0))
    found: AnyCluster = cluster
    return found


def _no_kind(kind: object) -> Finding:
    names = ", ".join(KINDS)
    if kind is ABSENT:
        return Finding(("kind",), "is missing", f"write 'kind:' and one of {names}", ABSENT)
    return Finding(("kind",), f"must be one of {names}", near_miss(str(kind), KINDS), kind)


def _together(cluster: AnyCluster) -> list[Finding]:
    """What is wrong with a cluster beyond its single fields."""
    findings = _missing_files(cluster)
    if isinstance(cluster, Local | SSH | Batch):
        findings += _scheduler_findings(cluster.scheduler, far=not isinstance(cluster, Local))
    if isinstance(cluster, Address):
        findings += _address_findings(cluster)
    if isinstance(cluster, SSH) and cluster.workers.least < cluster.workers.most:
        rule = "must be a number: machines reached by SSH are there or not"
        findings.append(Finding(("workers",), rule, f"write {cluster.workers.most}", ABSENT))
    if isinstance(cluster, Kubernetes) and bool(cluster.secret) != bool(cluster.security):
        rule = "goes with the security section: pods have their certificates from it"
        findings.append(Finding(("secret",), rule, "give both, or none", ABSENT))
    return findings


def _scheduler_findings(scheduler: Scheduler, *, far: bool) -> list[Finding]:
    if scheduler.host and scheduler.interface:
        rule, remedy = "has both a host and an interface", "keep one of them"
    elif far and not (scheduler.host or scheduler.interface):
        rule = "must say where workers on other machines reach it"
        remedy = "write e.g. 'interface: ib0' or 'host: 10.0.0.5'"
    else:
        return []
    return [Finding(("scheduler",), rule, remedy, ABSENT)]


def _address_findings(cluster: Address) -> list[Finding]:
    encrypted = cluster.address.startswith("tls://")
    if encrypted == (cluster.security is not None):
        return []
    rule, remedy = (
        ("is encrypted, and no certificates are given", "add a security section")
        if encrypted
        else ("is not encrypted, for all that there are certificates", "write 'tls://...'")
    )
    return [Finding(("address",), rule, remedy, cluster.address)]


def _missing_files(cluster: Cluster) -> list[Finding]:
    paths = cluster.certificates() or ()
    names = ("ca", "certificate", "key")
    remedy = "make certificates with 'sweep certificates DIRECTORY'"
    return [
        Finding(("security", name), "names a file that is not there", remedy, path)
        for name, path in zip(names, paths, strict=False)
        if not Path(path).is_file()
    ]
