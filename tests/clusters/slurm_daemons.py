"""A SLURM of two nodes on this machine: munge, controller and node daemons of our own.

Everything is in a directory of its own - keys, sockets, configuration - and every daemon stays in
the foreground: nothing of the machine's own SLURM is touched, nothing outlives the test.
"""

import os
import secrets
import shutil
import signal
import socket
import subprocess
import tempfile
import time
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

NODE_NAMES = ("n1", "n2")
PROGRAMS = ("munged", "slurmctld", "slurmd", "sbatch", "scancel", "squeue", "sinfo")
START_SECONDS = 30

CONFIGURATION_TEMPLATE = """\
ClusterName=test
SlurmctldHost={host}(127.0.0.1)
SlurmctldPort={ports[0]}
SlurmUser=root
AuthType=auth/munge
AuthInfo=socket={directory}/munge.socket
CryptoType=crypto/munge
StateSaveLocation={directory}/state
SlurmdSpoolDir={directory}/spool-%n
SlurmctldPidFile={directory}/slurmctld.pid
SlurmdPidFile={directory}/slurmd-%n.pid
SlurmctldLogFile={directory}/slurmctld.log
SlurmdLogFile={directory}/slurmd-%n.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
JobAcctGatherType=jobacct_gather/none
AccountingStorageType=accounting_storage/none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core_Memory
SchedulerParameters=sched_interval=1,batch_sched_delay=0
ReturnToService=2
SlurmdTimeout=10
KillWait=2
MpiDefault=none
SwitchType=switch/none
SlurmdParameters=config_overrides
NodeName=n1 NodeHostname={host} NodeAddr=127.0.0.1 Port={ports[1]} CPUs=4 RealMemory=8000
NodeName=n2 NodeHostname={host} NodeAddr=127.0.0.1 Port={ports[2]} CPUs=4 RealMemory=8000
PartitionName=main Nodes=n1,n2 Default=YES MaxTime=INFINITE State=UP
"""


def reason_slurm_is_missing() -> str:
    """Why SLURM can't be started here; empty where it can."""
    if os.geteuid() != 0:
        return "SLURM's daemons need root"
    absent = [name for name in PROGRAMS if not find_program(name)]
    return f"not installed: {', '.join(absent)}" if absent else ""


def find_program(name: str) -> str | None:
    """Path of a program, also of one that is for administrators."""
    return shutil.which(name, path=f"{os.environ['PATH']}:/usr/sbin:/sbin:/usr/bin")


@contextmanager
def run_slurm_daemons():
    """Environment for SLURM's commands, while its daemons run."""
    with ExitStack() as stack:
        directory = Path(tempfile.mkdtemp(prefix="sweep-slurm-", dir="/tmp"))
        stack.callback(shutil.rmtree, directory, ignore_errors=True)
        configuration = _write_configuration(directory)
        environment = {**os.environ, "SLURM_CONF": str(configuration)}
        stack.enter_context(_run_daemon(directory, "munged", *_munge_options(directory)))
        _wait_until(lambda: (directory / "munge.socket").exists(), directory)
        config_options = ("-D", "-f", str(configuration))
        stack.enter_context(_run_daemon(directory, "slurmctld", *config_options, "-i"))
        for node in NODE_NAMES:
            stack.enter_context(_run_daemon(directory, "slurmd", *config_options, "-N", node))
        stack.callback(_cancel_all, environment)
        _wait_until(lambda: _count_idle_nodes(environment) == len(NODE_NAMES), directory)
        yield environment


def _write_configuration(directory: Path) -> Path:
    directory.chmod(0o755)
    for name in ("state", *(f"spool-{node}" for node in NODE_NAMES)):
        (directory / name).mkdir()
    key = directory / "munge.key"
    key.touch(mode=0o600)
    key.write_bytes(secrets.token_bytes(128))
    with ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket()) for _ in range(3)]
        for bound_socket in sockets:
            bound_socket.bind(("127.0.0.1", 0))
        ports = [bound_socket.getsockname()[1] for bound_socket in sockets]
    configuration = directory / "slurm.conf"
    host = socket.gethostname().split(".")[0]
    configuration.write_text(
        CONFIGURATION_TEMPLATE.format(directory=directory, host=host, ports=ports)
    )
    return configuration


def _munge_options(directory: Path) -> list[str]:
    files = {"socket": "socket", "key-file": "key", "pid-file": "pid", "log-file": "log",
             "seed-file": "seed"}  # fmt: skip
    return [
        "--foreground",
        *(f"--{option}={directory}/munge.{suffix}" for option, suffix in files.items()),
    ]


@contextmanager
def _run_daemon(directory: Path, name: str, *options: str):
    """A daemon in the foreground, ended by its process id, its jobs with it."""
    with open(directory / "daemons.out", "a") as out:
        child = subprocess.Popen(
            [find_program(name), *options],
            stdin=subprocess.DEVNULL,
            stdout=out,
            stderr=out,
            start_new_session=True,
            env={**os.environ, "SLURM_CONF": str(directory / "slurm.conf")},
        )
    try:
        yield
    finally:
        child.terminate()
        try:
            child.wait(timeout=10)
        except subprocess.TimeoutExpired:
            child.kill()
            child.wait()
        with suppress(ProcessLookupError):
            os.killpg(child.pid, signal.SIGKILL)


def run_command(environment, *words: str) -> str:
    """What one of SLURM's commands prints."""
    process = subprocess.run(words, env=environment, capture_output=True, text=True, timeout=30)
    return process.stdout


def running_job_ids(environment) -> list[str]:
    """Ids of the jobs that run."""
    return run_command(environment, "squeue", "-h", "-t", "R", "-o", "%i").split()


def _count_idle_nodes(environment) -> int:
    return run_command(environment, "sinfo", "-h", "-N", "-o", "%t").split().count("idle")


def _cancel_all(environment) -> None:
    for signal_options in ((), ("-s", "KILL")):
        for job in run_command(environment, "squeue", "-h", "-o", "%i").split():
            run_command(environment, "scancel", *signal_options, job)
        deadline = time.monotonic() + 5
        while run_command(environment, "squeue", "-h", "-o", "%i").split():
            if time.monotonic() > deadline:
                break
            time.sleep(0.2)


def _wait_until(condition, directory: Path) -> None:
    deadline = time.monotonic() + START_SECONDS
    while not condition():
        if time.monotonic() > deadline:
            logs = [*directory.glob("*.log"), directory / "daemons.out"]
            raise AssertionError("\n".join(log.read_text()[-2000:] for log in logs if log.exists()))
        time.sleep(0.1)
