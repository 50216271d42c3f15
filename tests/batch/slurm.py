"""A real Slurm with two nodes on the loopback interface.

Its daemons are children of the test, and its files are in one folder. It has no accounting, no cgroups and no
systemd. Each node has four CPUs.
"""

from __future__ import annotations

import getpass
import os
import secrets
import shutil
import signal
import socket
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

DAEMONS = ("munged", "slurmctld", "slurmd")
COMMANDS = ("sbatch", "srun", "squeue", "scancel", "scontrol", "sinfo", "sacct")

CONFIGURATION = """\
ClusterName=loopback
SlurmctldHost={host}(127.0.0.1)
SlurmUser={user}
SlurmdUser={user}
AuthType=auth/munge
# Requeued jobs wait until their credentials expire: 5 seconds, which is the minimum, instead of two minutes.
AuthInfo=socket={folder}/munge/socket,cred_expire=5
CredType=cred/munge
CommunicationParameters=NoCtldInAddrAny,NoInAddrAny
SlurmctldPort={ports[0]}
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool.%n
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.%n.pid
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SwitchType=switch/none
MpiDefault=none
JobAcctGatherType=jobacct_gather/none
AccountingStorageType=accounting_storage/none
MailProg=/bin/true
SchedulerType=sched/backfill
SchedulerParameters=sched_interval=2,bf_interval=2,batch_sched_delay=0,defer_batch=0
SelectType=select/cons_tres
SelectTypeParameters=CR_Core_Memory
SlurmdParameters=config_overrides
ReturnToService=1
KillWait=30
MinJobAge=300
NodeName=n1 NodeHostname={host} NodeAddr=127.0.0.1 Port={ports[1]} CPUs=4 RealMemory=32000
NodeName=n2 NodeHostname={host} NodeAddr=127.0.0.1 Port={ports[2]} CPUs=4 RealMemory=32000
PartitionName=all Nodes=n1,n2 Default=YES MaxTime=INFINITE State=UP
"""

MUNGE_FILES = {
    "key-file": "key",
    "socket": "socket",
    "pid-file": "pid",
    "log-file": "log",
    "seed-file": "seed",
}


def program(name: str) -> str | None:
    """Return the path of the program ``name``, or None if it is not installed."""
    return shutil.which(name) or shutil.which(name, path="/usr/sbin:/sbin")


@dataclass(frozen=True)
class Slurm:
    """A running cluster."""

    folder: Path

    def __call__(self, command: str, *arguments: str) -> str:
        """Return the output of a command of Slurm."""
        done = subprocess.run(
            [str(self.folder / "bin" / command), *arguments], capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, f"{command} {' '.join(arguments)}: {done.stderr}"
        return done.stdout

    def jobs(self) -> dict[str, str]:
        """Return job -> state of all jobs that Slurm remembers."""
        lines = self("squeue", "--noheader", "--states", "all", "--Format", "JobID,State").splitlines()
        return dict(line.split() for line in lines)

    def node_of(self, job: str) -> str:
        """Return the node on which ``job`` runs."""
        return self("squeue", "--noheader", "--jobs", job, "--format", "%N").strip()

    def idle(self) -> bool:
        """Return True if both nodes are idle."""
        try:
            return self("sinfo", "--noheader", "--Node", "--states", "idle").count("\n") == 2
        except AssertionError:  # the controller does not answer yet
            return False

    def clear(self) -> None:
        """Cancel all jobs and resume all nodes that a test left in another state."""
        self("scancel", "--user", getpass.getuser())
        _until(lambda: not self("squeue", "--noheader"), self.folder)
        for node in ("n1", "n2"):
            if "idle" not in self("sinfo", "--noheader", "--nodes", node, "--format", "%T"):
                self("scontrol", "update", f"NodeName={node}", "State=RESUME")
        _until(self.idle, self.folder)


@contextmanager
def running_slurm(folder: Path) -> Iterator[Slurm]:
    """Yield a cluster that ends with the block. Its commands come first on the PATH."""
    for name in ("munge", "state", "bin", "log", "spool.n1", "spool.n2"):
        (folder / name).mkdir(parents=True)
    (folder / "munge").chmod(0o711)
    key = folder / "munge" / "key"
    key.write_bytes(secrets.token_bytes(1024))
    key.chmod(0o400)
    conf = folder / "slurm.conf"
    host = socket.gethostname().partition(".")[0]
    conf.write_text(
        CONFIGURATION.format(folder=folder, host=host, user=getpass.getuser(), ports=_free_ports(3))
    )
    for name in COMMANDS:
        # Snakemake's plugin removes SLURM_* from the environment, and with it the path of slurm.conf.
        script = folder / "bin" / name
        script.write_text(f'#!/bin/sh\nSLURM_CONF={conf} exec {program(name)} "$@"\n')
        script.chmod(0o755)
    slurm = Slurm(folder)
    before = os.environ["PATH"]
    with ExitStack() as stack:
        stack.callback(os.environ.__setitem__, "PATH", before)
        os.environ["PATH"] = f"{folder / 'bin'}:{before}"

        def start(name: str, *arguments: str) -> None:
            with (folder / "log" / f"{name}.log").open("ab") as log:
                process = subprocess.Popen([str(program(name)), *arguments], stdout=log, stderr=log)
            stack.callback(process.wait)
            stack.callback(process.terminate)

        munge = [f"--{name}={folder}/munge/{file}" for name, file in MUNGE_FILES.items()]
        start("munged", "--foreground", "--force", *munge)
        _until((folder / "munge" / "socket").exists, folder)
        start("slurmctld", "-D", "-f", str(conf))
        for node in ("n1", "n2"):
            start("slurmd", "-D", "-N", node, "-f", str(conf))
        stack.callback(_kill_leftovers, folder)
        _until(slurm.idle, folder)
        yield slurm


def _kill_leftovers(folder: Path) -> None:
    """Kill processes of jobs on this cluster. Slurm forgets the processes of a node that was set down."""
    for process in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            is_job = "SLURM_JOB_ID=" in (environment := (process / "environ").read_text(errors="replace"))
            if is_job and str(folder / "bin") in environment:
                os.kill(int(process.name), signal.SIGKILL)


def _until(ready: Callable[[], object], folder: Path, seconds: float = 60.0) -> None:
    deadline = time.monotonic() + seconds
    while not ready():
        if time.monotonic() > deadline:
            logs = "\n".join(f"{log.name}: {log.read_text()[-1500:]}" for log in (folder / "log").iterdir())
            raise AssertionError(f"Slurm did not start\n{logs}")
        time.sleep(0.1)


def _free_ports(count: int) -> list[int]:
    with ExitStack() as stack:
        taken = [stack.enter_context(socket.socket()) for _ in range(count)]
        for each in taken:
            each.bind(("127.0.0.1", 0))
        return [each.getsockname()[1] for each in taken]
