"""Configuration of a cluster, from one YAML file: how its workers are started, and their number.

A spec names no cluster and a cluster's file names no study. The same spec gives the same bytes on
every cluster.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

from pydantic import Field, PrivateAttr, TypeAdapter, ValidationError

import sweep.spec.fields as declare
from sweep.spec.fields import SpecSection
from sweep.spec.rules import CustomRule, Finding, NumericRule, SpecError, TextRule
from sweep.spec.yaml_document import (
    Document,
    drop_anchor_sections,
    read_document,
    to_plain_data,
    validation_findings,
)
from sweep.units import QuantityError

LOOPBACK_ADDRESS = "127.0.0.1"
"""IP address at which a service accepts connections from its own machine only."""
NO_DASHBOARD, DASHBOARD_PORT = "none", 8787
"""Value of a spec's field ``dashboard`` that means no dashboard, and the default port of Dask's
dashboard."""
_WORKER_COUNT_RULE = NumericRule(
    description="Workers", example="8", at_least="1", at_most="100000", is_integer=True
)
_WORKER_BOUNDS_REMEDY = "write e.g. {least: 2, most: 40}"


class CertificatePaths(NamedTuple):
    """Paths of the files with which the processes of a cluster identify themselves by TLS."""

    ca: str
    """Path of the certificate of the authority that signed `certificate`."""
    certificate: str
    """Path of the certificate that all processes of the cluster share."""
    key: str
    """Path of the private key of `certificate`."""


class WorkerBounds(NamedTuple):
    """Minimum and maximum number of workers, equal if the number is fixed."""

    least: int
    """Minimum number of workers."""
    most: int
    """Maximum number of workers."""


def _read_worker_bounds(raw_value: object) -> WorkerBounds:
    """Return the `WorkerBounds` of a number of workers, or of ``{least: 2, most: 40}``.

    Raise `QuantityError` if the value is invalid.
    """
    if not isinstance(raw_value, Mapping):
        try:
            return WorkerBounds(
                _WORKER_COUNT_RULE.read(raw_value), _WORKER_COUNT_RULE.read(raw_value)
            )
        except QuantityError as error:
            raise QuantityError(error.rule, "write e.g. 8 or {least: 2, most: 40}") from None
    if raw_value.keys() != {"least", "most"}:
        raise QuantityError("must have a least and a most", _WORKER_BOUNDS_REMEDY)
    bounds = {}
    for name in ("least", "most"):
        try:
            bounds[name] = _WORKER_COUNT_RULE.read(raw_value[name])
        except QuantityError as error:
            raise QuantityError(f"has a {name} that {error.rule}", _WORKER_BOUNDS_REMEDY) from None
    if bounds["least"] > bounds["most"]:
        raise QuantityError("has a least above its most", "write the smaller number as least")
    return WorkerBounds(**bounds)


def _read_environment_mapping(raw_value: object) -> dict[str, str]:
    """Check environment variables, such as ``{TMPDIR: /scratch}``; return a dict of texts.

    Raise `QuantityError` if a name is invalid, or if a value has a quote or more than one line.
    """
    remedy = "write e.g. {TMPDIR: /scratch}"
    if not isinstance(raw_value, Mapping):
        raise QuantityError("must be a mapping of names to values", remedy)
    for name, value in raw_value.items():
        if not re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]*", str(name)):
            raise QuantityError(f"holds '{name}', which is no name of a variable", remedy)
        if isinstance(value, bool) or not isinstance(value, str | int | float):
            raise QuantityError(f"holds no text for {name}", remedy)
        if re.search(r"[\n\r\0']", str(value)):
            raise QuantityError(f"holds a quote or more than a line for {name}", remedy)
    return {str(name): str(value) for name, value in raw_value.items()}


_SINGLE_LINE_RULE_ARGUMENTS = {
    "description": "One line",
    "pattern": r"[^\n\r\0]{1,2000}",
    "remedy": "write one line",
}
"""Keyword arguments of `TextRule` for a text that must be a single line."""
_TEXTS_PER_LIST_MAX = 100_000
"""Largest number of texts in a list-valued field of a cluster's configuration."""
_MEMORY_FIELD_ARGUMENTS = ("byte", "4 GB", "64 MB", "100 TB")
"""Arguments of `declare.quantity_field` for an amount of memory: unit, example, lower bound and
upper bound."""


class Security(SpecSection):
    """TLS certificates in PEM, by which scheduler, workers and client authenticate each other.

    With this section all traffic of the cluster is encrypted.
    """

    ca: str = declare.file_path_field("Certificate of the authority that signed the others")
    certificate: str = declare.file_path_field("Certificate of scheduler, workers and client")
    key: str = declare.file_path_field("Private key of that certificate")


class LocalWorkerConfig(SpecSection):
    """Threads and memory of a worker process on this machine."""

    threads: int = declare.integer_field(
        "Threads of a worker; each computes a block of its own", "1", at_most="1000", default=1
    )
    memory: float | None = declare.quantity_field(
        "Memory of a worker at most; by default its share of 90 % of the machine's memory",
        *_MEMORY_FIELD_ARGUMENTS,
        default=None,
    )


class WorkerConfig(LocalWorkerConfig):
    """Threads and memory of a worker process; the memory is required."""

    memory: float = declare.quantity_field("Memory of a worker at most", *_MEMORY_FIELD_ARGUMENTS)


class SchedulerConfig(SpecSection):
    """Address and ports of the scheduler.

    Without a host or an interface the scheduler accepts connections from this machine alone.
    """

    host: str = declare.command_word_field(
        "Address at which workers reach the scheduler", "10.0.0.5", ""
    )
    interface: str = declare.command_word_field(
        "Network interface of the scheduler, in place of its address", "ib0", ""
    )
    port: int = declare.integer_field(
        "Port of the scheduler; 0 for any free port", "8786", "0", "65535", default=0
    )
    dashboard: str = declare.text_field(
        "Port of Dask's dashboard, 0 for any; none: no dashboard. It has no password, and listens "
        "to this machine alone: all users of this machine can see it",
        NO_DASHBOARD,
        pattern=rf"{NO_DASHBOARD}|((localhost|127\.0\.0\.1):)?[0-9]{{1,5}}",
        remedy=f"write a port, such as {DASHBOARD_PORT}. It listens to this machine alone; "
        f"`ssh -L {DASHBOARD_PORT}:{LOOPBACK_ADDRESS}:{DASHBOARD_PORT} HOST` shows it on another",
    )


class BatchJobConfig(SpecSection):
    """Resources and options of one job of a batch system, which holds one worker or several."""

    workers: int = declare.integer_field("Workers of one job", "8", at_most="1000", default=1)
    walltime: float = declare.duration_field(
        "Longest time of a job; workers leave before it ends", "2 h", "1 min", "365 d"
    )
    queue: str = declare.command_word_field("Queue or partition", "normal", "")
    account: str = declare.command_word_field("Account that is charged", "lidar", "")
    directives: tuple[str, ...] = declare.list_field(
        TextRule(**_SINGLE_LINE_RULE_ARGUMENTS, example="--exclusive"), 0, _TEXTS_PER_LIST_MAX, (),
        description="Further options of the job", element_noun="texts",
    )  # fmt: skip
    prologue: tuple[str, ...] = declare.list_field(
        TextRule(**_SINGLE_LINE_RULE_ARGUMENTS, example="module load python/3.12"),
        0, _TEXTS_PER_LIST_MAX, (),
        description="Shell lines before the worker starts", element_noun="texts",
    )  # fmt: skip
    logs: str = declare.command_word_field("Directory for the output of jobs", "logs", "logs")


class ClusterConfig(SpecSection):
    """Base of the configurations of all clusters."""

    security: Security | None = None

    _base_folder: Path = PrivateAttr(default=Path())
    """Folder of the cluster's file, to which relative paths in the configuration refer."""

    def resolve_path(self, raw_path: str) -> str:
        """Return a path as text; a relative path is joined to the cluster file's folder."""
        return str(
            self._base_folder / os.path.expanduser(raw_path)
        )  # an unknown ~user is left as it is

    def certificate_paths(self) -> CertificatePaths | None:
        """Return the paths of TLS certificates and private key; None without ``security``."""
        security = self.security
        if security is None:
            return None
        return CertificatePaths(
            *map(self.resolve_path, (security.ca, security.certificate, security.key))
        )


class SessionStartedClusterConfig(ClusterConfig):
    """Base of the configurations of clusters whose workers the session starts."""

    environment: dict[str, str] = declare.field_with_rule(
        CustomRule(
            description="Environment variables of workers", reader=_read_environment_mapping
        ),
        {},
    )


class LocalClusterConfig(SessionStartedClusterConfig):
    """Cluster of worker processes on this machine."""

    kind: Literal["local"]
    workers: WorkerBounds | None = declare.field_with_rule(
        CustomRule(
            description="Number of workers; by default one for each core",
            reader=_read_worker_bounds,
        ),
        None,
    )
    worker: LocalWorkerConfig = LocalWorkerConfig()
    scheduler: SchedulerConfig = SchedulerConfig()


class ExistingSchedulerConfig(ClusterConfig):
    """Cluster of a Dask scheduler that is already running, with the workers that connect to it."""

    kind: Literal["scheduler"]
    address: str = declare.text_field(
        "Address of the scheduler",
        pattern=r"(tcp|tls|ucx)://\S+:\d+",
        remedy="write e.g. 'tcp://10.0.0.5:8786', or tls:// with a security section",
    )


class SSHClusterConfig(SessionStartedClusterConfig):
    """Cluster of machines on which workers are started over SSH."""

    kind: Literal["ssh"]
    hosts: tuple[str, ...] = declare.list_field(
        declare.command_word_rule("A host", "node1"),
        1,
        _TEXTS_PER_LIST_MAX,
        description="Machines",
        element_noun="texts",
    )
    workers: WorkerBounds = declare.field_with_rule(
        CustomRule(
            description="Number of workers, distributed over the machines",
            reader=_read_worker_bounds,
        )
    )
    worker: WorkerConfig
    scheduler: SchedulerConfig
    user: str = declare.command_word_field(
        "User on the machines; by default the name of the user here", "lidar", ""
    )
    port: int = declare.integer_field("Port of SSH", "22", at_most="65535", default=22)
    identity: str = declare.file_path_field(
        "Private key for the login; by default the one that ssh takes", ""
    )
    known_hosts: str = declare.file_path_field(
        "File of the keys of known machines; by default the one that ssh takes", ""
    )
    python: str = declare.command_word_field(
        "Python on the machines; by default the path of this Python", "python", ""
    )


class BatchClusterConfig(SessionStartedClusterConfig):
    """Base of the configurations of clusters whose workers are jobs of a batch system."""

    workers: WorkerBounds = declare.field_with_rule(
        CustomRule(description="Workers, in whole jobs", reader=_read_worker_bounds)
    )
    worker: WorkerConfig
    job: BatchJobConfig
    scheduler: SchedulerConfig
    python: str = declare.command_word_field(
        "Python of the jobs; by default the path of this Python", "python", ""
    )


class SlurmClusterConfig(BatchClusterConfig):
    """Cluster of SLURM jobs."""

    kind: Literal["slurm"]


class PBSClusterConfig(BatchClusterConfig):
    """Cluster of PBS jobs."""

    kind: Literal["pbs"]


class PersistentVolume(SpecSection):
    """Persistent volume for stores and scenes, mounted at one path in all pods and here."""

    claim: str = declare.command_word_field("Claim of the persistent volume", "studies")
    path: str = declare.command_word_field(
        "Path at which the volume is mounted, in the pods and here", "/data"
    )


class KubernetesClusterConfig(SessionStartedClusterConfig):
    """Cluster of pods that the Dask operator of a Kubernetes cluster starts."""

    kind: Literal["kubernetes"]
    workers: WorkerBounds = declare.field_with_rule(
        CustomRule(
            description="Number of workers, each in a pod of its own", reader=_read_worker_bounds
        )
    )
    worker: WorkerConfig
    image: str = declare.command_word_field(
        "Image with sweep in it", "registry.example.org/sweep:0.1.0"
    )
    name: str = declare.text_field(
        "Name of the cluster",
        "sweep",
        pattern=r"[a-z]([a-z0-9-]{0,50}[a-z0-9])?",
        remedy="take small letters, digits and '-', such as 'sweep'",
    )
    namespace: str = declare.command_word_field("Namespace", "lidar", "default")
    volume: PersistentVolume | None = None
    secret: str = declare.command_word_field(
        "Secret with ca.pem, certificate.pem and key.pem, if TLS is used", "sweep-tls", ""
    )


AnyClusterConfig = Annotated[
    LocalClusterConfig
    | ExistingSchedulerConfig
    | SSHClusterConfig
    | SlurmClusterConfig
    | PBSClusterConfig
    | KubernetesClusterConfig,
    Field(discriminator="kind"),
]
_CLUSTER_CONFIG_ADAPTER: TypeAdapter[AnyClusterConfig] = TypeAdapter(AnyClusterConfig)


def load_cluster_config(path: str | Path) -> AnyClusterConfig:
    """Read the configuration of a cluster from a YAML file.

    Parameters
    ----------
    path : str or Path
        YAML file. Paths in it are relative to its folder.

    Returns
    -------
    AnyClusterConfig
        Validated configuration.

    Raises
    ------
    SpecError
        The error holds every mistake in the file.
    """
    return _read_cluster_config(read_document(Path(path)), Path(path).absolute().parent)


def cluster_config_from_mapping(
    mapping: Mapping[str, Any], *, base: Path | str = "."
) -> AnyClusterConfig:
    """Read the configuration of a cluster from plain data.

    Parameters
    ----------
    mapping : Mapping
        Data, written as in a YAML file.
    base : str or Path
        Folder that paths in `mapping` are relative to.

    Returns
    -------
    AnyClusterConfig
        Validated configuration.

    Raises
    ------
    SpecError
        The error holds every mistake in the data.
    """
    return _read_cluster_config(
        Document(drop_anchor_sections(to_plain_data(mapping))), Path(base).absolute()
    )


def _read_cluster_config(document: Document, base: Path) -> AnyClusterConfig:
    """Return the validated configuration in a document; raise `SpecError` with every mistake in it.

    `base` is the folder that paths in the document are relative to.
    """
    findings = document.findings
    try:
        cluster = _CLUSTER_CONFIG_ADAPTER.validate_python(document.content)
    except ValidationError as error:
        findings += validation_findings(error, AnyClusterConfig)
    else:
        cluster._base_folder = base
        findings += _cluster_findings(cluster)
    if findings:
        raise SpecError(document.mistakes_from_findings(findings))
    return cluster


def _cluster_findings(cluster: AnyClusterConfig) -> Iterator[Finding]:
    """Yield a `Finding` for each missing file and for fields that contradict each other."""
    for name, path in zip(Security.model_fields, cluster.certificate_paths() or (), strict=False):
        if not Path(path).is_file():
            remedy = "make certificates with 'sweep certificates DIRECTORY'"
            yield Finding(("security", name), "names a file that does not exist", remedy, path)
    if isinstance(cluster, LocalClusterConfig | SSHClusterConfig | BatchClusterConfig):
        yield from _scheduler_findings(
            cluster.scheduler, is_remote=not isinstance(cluster, LocalClusterConfig)
        )
    if isinstance(cluster, ExistingSchedulerConfig):
        address, is_encrypted = cluster.address, cluster.address.startswith("tls://")
        if is_encrypted and not cluster.security:
            problem = "is encrypted, and no certificates are given"
            yield Finding(("address",), problem, "add a security section", address)
        if cluster.security and not is_encrypted:
            problem = "is not encrypted, although certificates are given"
            yield Finding(("address",), problem, "write 'tls://...'", address)
    if isinstance(cluster, SSHClusterConfig) and cluster.workers.least < cluster.workers.most:
        problem = "must be a number: machines reached by SSH are there or not"
        yield Finding(("workers",), problem, f"write {cluster.workers.most}")
    if isinstance(cluster, KubernetesClusterConfig) and bool(cluster.secret) != bool(
        cluster.security
    ):
        problem = "goes with the security section: pods have their certificates from it"
        yield Finding(("secret",), problem, "give both, or none")


def _scheduler_findings(scheduler: SchedulerConfig, *, is_remote: bool) -> Iterator[Finding]:
    """Yield a `Finding` if the scheduler has two addresses, or none although it needs one.

    The scheduler needs an address if `is_remote` is True: workers are on other machines.
    """
    if scheduler.host and scheduler.interface:
        yield Finding(("scheduler",), "has both a host and an interface", "keep one of them")
    elif is_remote and not (scheduler.host or scheduler.interface):
        problem = "must state where workers on other machines reach it"
        yield Finding(("scheduler",), problem, "write e.g. 'interface: ib0' or 'host: 10.0.0.5'")
