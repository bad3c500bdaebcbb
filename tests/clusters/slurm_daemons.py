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

NODES = ("n1", "n2")
PROGRAMS = ("munged", "slurmctld", "slurmd", "sbatch", "scancel", "squeue", "sinfo")
START_SECONDS = 30

CONFIGURATION = """\
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


def missing() -> str:
    """Why SLURM can't be started here; empty where it can."""
    if os.geteuid() != 0:
        return "SLURM's daemons need root"
    absent = [name for name in PROGRAMS if not program(name)]
    return f"not installed: {', '.join(absent)}" if absent else ""


def program(name: str) -> str | None:
    """Path of a program, also of one that is for administrators."""
    return shutil.which(name, path=f"{os.environ['PATH']}:/usr/sbin:/sbin:/usr/bin")


@contextmanager
def slurm():
    """Environment for SLURM's commands, while its daemons run."""
    with ExitStack() as stack:
        directory = Path(tempfile.mkdtemp(prefix="sweep-slurm-", dir="/tmp"))
        stack.callback(shutil.rmtree, directory, ignore_errors=True)
        configuration = _configure(directory)
        environment = {**os.environ, "SLURM_CONF": str(configuration)}
        stack.enter_context(_daemon(directory, "munged", *_munge(directory)))
        _wait(lambda: (directory / "munge.socket").exists(), directory)
        conf = ("-D", "-f", str(configuration))
        stack.enter_context(_daemon(directory, "slurmctld", *conf, "-i"))
        for node in NODES:
            stack.enter_context(_daemon(directory, "slurmd", *conf, "-N", node))
        stack.callback(_cancel_all, environment)
        _wait(lambda: _idle(environment) == len(NODES), directory)
        yield environment


def _configure(directory: Path) -> Path:
    directory.chmod(0o755)
    for name in ("state", *(f"spool-{node}" for node in NODES)):
        (directory / name).mkdir()
    key = directory / "munge.key"
    key.touch(mode=0o600)
    key.write_bytes(secrets.token_bytes(128))
    with ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket()) for _ in range(3)]
        for each in sockets:
            each.bind(("127.0.0.1", 0))
        ports = [each.getsockname()[1] for each in sockets]
    configuration = directory / "slurm.conf"
    host = socket.gethostname().split(".")[0]
    configuration.write_text(CONFIGURATION.format(directory=directory, host=host, ports=ports))
    return configuration


def _munge(directory: Path) -> list[str]:
    files = {"socket": "socket", "key-file": "key", "pid-file": "pid", "log-file": "log",
             "seed-file": "seed"}  # fmt: skip
    return [
        "--foreground",
        *(f"--{option}={directory}/munge.{end}" for option, end in files.items()),
    ]


@contextmanager
def _daemon(directory: Path, name: str, *options: str):
    """A daemon in the foreground, ended by its process id, its jobs with it."""
    with open(directory / "daemons.out", "a") as out:
        child = subprocess.Popen(
            [program(name), *options],
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


def command(environment, *words: str) -> str:
    """What one of SLURM's commands prints."""
    done = subprocess.run(words, env=environment, capture_output=True, text=True, timeout=30)
    return done.stdout


def jobs(environment) -> list[str]:
    """Ids of the jobs that run."""
    return command(environment, "squeue", "-h", "-t", "R", "-o", "%i").split()


def _idle(environment) -> int:
    return command(environment, "sinfo", "-h", "-N", "-o", "%t").split().count("idle")


def _cancel_all(environment) -> None:
    for signals in ((), ("-s", "KILL")):
        for job in command(environment, "squeue", "-h", "-o", "%i").split():
            command(environment, "scancel", *signals, job)
        deadline = time.monotonic() + 5
        while command(environment, "squeue", "-h", "-o", "%i").split():
            if time.monotonic() > deadline:
                break
            time.sleep(0.2)


def _wait(condition, directory: Path) -> None:
    deadline = time.monotonic() + START_SECONDS
    while not condition():
        if time.monotonic() > deadline:
            logs = [*directory.glob("*.log"), directory / "daemons.out"]
            raise AssertionError("\n".join(log.read_text()[-2000:] for log in logs if log.exists()))
        time.sleep(0.1)
