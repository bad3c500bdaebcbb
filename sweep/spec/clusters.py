"""A cluster in one YAML file: where workers run, how many, and who may talk to them.

No study names a cluster and no cluster a study: the same spec runs on any of them, to the same
bytes.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

from pydantic import Field, PrivateAttr, TypeAdapter, ValidationError

import sweep.spec.parts as of
from sweep.spec.parts import Part
from sweep.spec.reading import Document, findings_of, plain, read_document, without_extensions
from sweep.spec.rules import Finding, Numeric, SpecError, Special, Text
from sweep.units import QuantityError

LOOPBACK = "127.0.0.1"
NO_DASHBOARD, DASHBOARD_PORT = "none", 8787
_COUNT = Numeric(about="Workers", example="8", at_least="1", at_most="100000", whole=True)
_BOUNDS = "write e.g. {least: 2, most: 40}"


class Bounds(NamedTuple):
    """Workers at least and at most; the same where their number is fixed."""

    least: int
    most: int


def _read_number(written: object) -> Bounds:
    """Read a number of workers, or bounds that it is kept within."""
    if not isinstance(written, Mapping):
        try:
            return Bounds(_COUNT.read(written), _COUNT.read(written))
        except QuantityError as error:
            raise QuantityError(error.rule, "write e.g. 8 or {least: 2, most: 40}") from None
    if written.keys() != {"least", "most"}:
        raise QuantityError("must have a least and a most", _BOUNDS)
    ends = {}
    for name in ("least", "most"):
        try:
            ends[name] = _COUNT.read(written[name])
        except QuantityError as error:
            raise QuantityError(f"has a {name} that {error.rule}", _BOUNDS) from None
    if ends["least"] > ends["most"]:
        raise QuantityError("has a least above its most", "write the smaller number as least")
    return Bounds(**ends)


def _read_variables(written: object) -> dict[str, str]:
    """Environment variables by name."""
    example = "write e.g. {TMPDIR: /scratch}"
    if not isinstance(written, Mapping):
        raise QuantityError("must be a mapping of names to values", example)
    for name, value in written.items():
        if not re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]*", str(name)):
            raise QuantityError(f"holds '{name}', which is no name of a variable", example)
        if isinstance(value, bool) or not isinstance(value, str | int | float):
            raise QuantityError(f"holds no text for {name}", example)
        if re.search(r"[\n\r\0']", str(value)):
            raise QuantityError(f"holds a quote or more than a line for {name}", example)
    return {str(name): str(value) for name, value in written.items()}


_LINE = {"about": "One line", "pattern": r"[^\n\r\0]{1,2000}", "remedy": "write one line"}
_MOST_TEXTS = 100_000
_MEMORY = ("byte", "4 GB", "64 MB", "100 TB")


class Security(Part):
    """Certificates with which all parts know each other, in PEM: traffic is TLS throughout."""

    ca: str = of.file("Certificate of the authority that signed the others")
    certificate: str = of.file("Certificate of scheduler, workers and client")
    key: str = of.file("Its private key")


class LocalWorker(Part):
    """One worker process of this machine."""

    threads: int = of.count("Threads, each with a block of its own", "1", at_most="1000", default=1)
    memory: float | None = of.quantity(
        "Memory that it may take; without one, its share of 90 % of it", *_MEMORY, default=None
    )


class Worker(LocalWorker):
    """One worker process."""

    memory: float = of.quantity("Memory that it may take", *_MEMORY)


class Scheduler(Part):
    """Address of the scheduler, which listens to this machine alone unless told otherwise."""

    host: str = of.word("Address that workers reach it by", "10.0.0.5", "")
    interface: str = of.word("Or the network interface that it has", "ib0", "")
    port: int = of.count("Port; 0 for any", "8786", "0", "65535", default=0)
    dashboard: str = of.text(
        "Port of Dask's dashboard, 0 for any; none: no dashboard. It has no password, and listens "
        "to this machine alone: all users of this machine can see it",
        NO_DASHBOARD,
        pattern=rf"{NO_DASHBOARD}|((localhost|127\.0\.0\.1):)?[0-9]{{1,5}}",
        remedy=f"write a port, such as {DASHBOARD_PORT}. It listens to this machine alone; "
        f"`ssh -L {DASHBOARD_PORT}:{LOOPBACK}:{DASHBOARD_PORT} HOST` shows it on another",
    )


class Job(Part):
    """One job of a batch system, with one worker or several."""

    workers: int = of.count("Workers of one job", "8", at_most="1000", default=1)
    walltime: float = of.duration(
        "Time that a job may take; workers leave before it", "2 h", "1 min", "365 d"
    )
    queue: str = of.word("Queue or partition", "normal", "")
    account: str = of.word("Account that is charged", "lidar", "")
    directives: tuple[str, ...] = of.several(
        Text(**_LINE, example="--exclusive"), 0, _MOST_TEXTS, (),
        about="Further options of the job", noun="texts",
    )  # fmt: skip
    prologue: tuple[str, ...] = of.several(
        Text(**_LINE, example="module load python/3.12"), 0, _MOST_TEXTS, (),
        about="Shell lines before the worker starts", noun="texts",
    )  # fmt: skip
    logs: str = of.word("Directory for what jobs print", "logs", "logs")


class Cluster(Part):
    """Base of all clusters."""

    security: Security | None = None

    _base: Path = PrivateAttr(default=Path())

    def path(self, name: str) -> str:
        """Path of a file that the cluster's file names."""
        return str(self._base / os.path.expanduser(name))  # an unknown ~user stays as it is

    def certificates(self) -> tuple[str, str, str] | None:
        """Paths of authority, certificate and key; None without security."""
        s = self.security
        if s is None:
            return None
        ca, certificate, key = map(self.path, (s.ca, s.certificate, s.key))
        return ca, certificate, key


class Started(Cluster):
    """Base of clusters whose workers are started here."""

    environment: dict[str, str] = of.field(
        Special(about="Environment variables of workers", reader=_read_variables), {}
    )


class Local(Started):
    """Processes of this machine."""

    kind: Literal["local"]
    workers: Bounds | None = of.field(
        Special(about="Workers; without a number, one a core", reader=_read_number), None
    )
    worker: LocalWorker = LocalWorker()
    scheduler: Scheduler = Scheduler()


class Address(Cluster):
    """A Dask scheduler that runs already."""

    kind: Literal["scheduler"]
    address: str = of.text(
        "Address of the scheduler",
        pattern=r"(tcp|tls|ucx)://\S+:\d+",
        remedy="write e.g. 'tcp://10.0.0.5:8786', or tls:// with a security section",
    )


class SSH(Started):
    """Machines that are reached by SSH."""

    kind: Literal["ssh"]
    hosts: tuple[str, ...] = of.several(
        of.one_word("A host", "node1"), 1, _MOST_TEXTS, about="Machines", noun="texts"
    )
    workers: Bounds = of.field(
        Special(about="Workers, dealt out over the machines", reader=_read_number)
    )
    worker: Worker
    scheduler: Scheduler
    user: str = of.word("User there; without one, as here", "lidar", "")
    port: int = of.count("Port of SSH", "22", at_most="65535", default=22)
    identity: str = of.file("Private key to log in with; without one, as ssh does", "")
    known_hosts: str = of.file("Keys of known machines; without one, as ssh does", "")
    python: str = of.word("Python there; without one, the path of this one", "python", "")


class Batch(Started):
    """Jobs of a batch system."""

    workers: Bounds = of.field(Special(about="Workers, in whole jobs", reader=_read_number))
    worker: Worker
    job: Job
    scheduler: Scheduler
    python: str = of.word("Python of the jobs; without one, the path of this one", "python", "")


class Slurm(Batch):
    """Jobs of SLURM."""

    kind: Literal["slurm"]


class PBS(Batch):
    """Jobs of PBS."""

    kind: Literal["pbs"]


class Volume(Part):
    """A persistent volume that all pods and this machine see, for stores and scenes."""

    claim: str = of.word("Its claim", "studies")
    path: str = of.word("Where it is mounted, the same as here", "/data")


class Kubernetes(Started):
    """Pods that the Dask operator of a Kubernetes cluster starts."""

    kind: Literal["kubernetes"]
    workers: Bounds = of.field(Special(about="Workers, a pod each", reader=_read_number))
    worker: Worker
    image: str = of.word("Image with sweep in it", "registry.example.org/sweep:0.1.0")
    name: str = of.text(
        "Name of the cluster",
        "sweep",
        pattern=r"[a-z]([a-z0-9-]{0,50}[a-z0-9])?",
        remedy="take small letters, digits and '-', such as 'sweep'",
    )
    namespace: str = of.word("Namespace", "lidar", "default")
    volume: Volume | None = None
    secret: str = of.word(
        "Secret with ca.pem, certificate.pem and key.pem, where there is TLS", "sweep-tls", ""
    )


AnyCluster = Annotated[
    Local | Address | SSH | Slurm | PBS | Kubernetes, Field(discriminator="kind")
]
_CLUSTER: TypeAdapter[AnyCluster] = TypeAdapter(AnyCluster)


def load_cluster(path: str | Path) -> AnyCluster:
    """Cluster that a YAML file describes, or a `SpecError` with every mistake in it."""
    return _cluster(read_document(Path(path)), Path(path).absolute().parent)


def cluster_of(mapping: Mapping[str, Any], *, base: Path | str = ".") -> AnyCluster:
    """Cluster from plain data, written as in a file whose folder is `base`."""
    return _cluster(Document(without_extensions(plain(mapping))), Path(base).absolute())


def _cluster(document: Document, base: Path) -> AnyCluster:
    findings = document.findings
    try:
        cluster = _CLUSTER.validate_python(document.value)
    except ValidationError as error:
        findings += findings_of(error, AnyCluster)
    else:
        cluster._base = base
        findings += _together(cluster)
    if findings:
        raise SpecError(document.mistakes(findings))
    return cluster


def _together(cluster: AnyCluster) -> Iterator[Finding]:
    """Mistakes in a cluster beyond its single fields."""
    for name, path in zip(Security.model_fields, cluster.certificates() or (), strict=False):
        if not Path(path).is_file():
            remedy = "make certificates with 'sweep certificates DIRECTORY'"
            yield Finding(("security", name), "names a file that is not there", remedy, path)
    if isinstance(cluster, Local | SSH | Batch):
        yield from _scheduler_findings(cluster.scheduler, far=not isinstance(cluster, Local))
    if isinstance(cluster, Address):
        address, encrypted = cluster.address, cluster.address.startswith("tls://")
        if encrypted and not cluster.security:
            rule = "is encrypted, and no certificates are given"
            yield Finding(("address",), rule, "add a security section", address)
        if cluster.security and not encrypted:
            rule = "is not encrypted, for all that there are certificates"
            yield Finding(("address",), rule, "write 'tls://...'", address)
    if isinstance(cluster, SSH) and cluster.workers.least < cluster.workers.most:
        rule = "must be a number: machines reached by SSH are there or not"
        yield Finding(("workers",), rule, f"write {cluster.workers.most}")
    if isinstance(cluster, Kubernetes) and bool(cluster.secret) != bool(cluster.security):
        rule = "goes with the security section: pods have their certificates from it"
        yield Finding(("secret",), rule, "give both, or none")


def _scheduler_findings(scheduler: Scheduler, *, far: bool) -> Iterator[Finding]:
    if scheduler.host and scheduler.interface:
        yield Finding(("scheduler",), "has both a host and an interface", "keep one of them")
    elif far and not (scheduler.host or scheduler.interface):
        rule = "must say where workers on other machines reach it"
        yield Finding(("scheduler",), rule, "write e.g. 'interface: ib0' or 'host: 10.0.0.5'")
