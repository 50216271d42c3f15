"""A real Slurm of two nodes on loopback, its daemons children of the test, its files in one folder.

Without accounting, cgroups and systemd. Each node has four CPUs and a GPU, as far as Slurm believes.
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
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

DAEMONS = ("munged", "slurmctld", "slurmd")
COMMANDS = ("sbatch", "srun", "squeue", "scancel", "scontrol", "sinfo", "sacct")
NODES = ("n1", "n2")

CONFIGURATION = """\
ClusterName=loopback
SlurmctldHost={host}(127.0.0.1)
SlurmUser={user}
SlurmdUser={user}
AuthType=auth/munge
# Requeued jobs wait until their credentials are void: 5 seconds, the least there is, instead of two minutes.
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
KillWait=1
MinJobAge=300
GresTypes=gpu
NodeName=n1 NodeHostname={host} NodeAddr=127.0.0.1 Port={ports[1]} CPUs=4 RealMemory=32000 Gres=gpu:1
NodeName=n2 NodeHostname={host} NodeAddr=127.0.0.1 Port={ports[2]} CPUs=4 RealMemory=32000 Gres=gpu:1
PartitionName=all Nodes=n1,n2 Default=YES MaxTime=INFINITE State=UP
"""


def missing_daemon() -> str | None:
    """The first part of Slurm that is not installed; None where it is complete."""
    return next((name for name in DAEMONS if _program(name) is None), None)


@dataclass(frozen=True)
class Slurm:
    """A running cluster."""

    folder: Path
    daemons: ExitStack

    def __call__(self, command: str, *arguments: str) -> str:
        """Output of a command of Slurm."""
        done = subprocess.run(
            [str(self.folder / "bin" / command), *arguments], capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, f"{command} {' '.join(arguments)}: {done.stderr}"
        return done.stdout

    def wait_until(self, question: str, answer: str, seconds: float = 60.0) -> None:
        """Until ``scontrol show QUESTION`` holds ``answer``."""
        deadline = time.monotonic() + seconds
        while answer not in (said := self("scontrol", "show", *question.split())):
            assert time.monotonic() < deadline, f"never {answer}: {said}"
            time.sleep(0.2)

    def clear(self) -> None:
        """Cancel every job and take every node back, whatever a test left behind."""
        self("scancel", "--user", getpass.getuser())
        _until(lambda: not self("squeue", "--noheader"), self.folder)
        for node in NODES:
            if "idle" not in self("sinfo", "--noheader", "--nodes", node, "--format", "%T"):
                self("scontrol", "update", f"NodeName={node}", "State=RESUME")
        _until(lambda: _idle_nodes(self) == len(NODES), self.folder)

    def start_controller(self) -> None:
        """Start slurmctld."""
        _start(self.daemons, self.folder, "slurmctld", "-D", "-f", str(self.folder / "slurm.conf"))

    def restart_controller(self) -> None:
        """Kill slurmctld with SIGKILL and start it again, as when its machine dies and comes back.

        It is killed once its state is on the disk: what it had not saved it would learn from the nodes, but
        asks them a hundred seconds later.
        """
        before = time.time()
        for job in self("squeue", "--noheader", "--format", "%i").split():
            self("scontrol", "update", f"JobId={job}", "AdminComment=changed")  # makes it save
        _until(lambda: (self.folder / "state" / "job_state").stat().st_mtime > before, self.folder)
        os.kill(int((self.folder / "slurmctld.pid").read_text()), signal.SIGKILL)
        self.start_controller()
        # A step that ends before the nodes have answered stays "running" to it, and its job gets no other.
        _until(self._knows_the_nodes, self.folder)

    def _knows_the_nodes(self) -> bool:
        try:
            return "unk" not in self("sinfo", "--noheader", "--Node")
        except AssertionError:
            return False  # it does not answer yet


@contextmanager
def running_slurm(folder: Path) -> Iterator[Slurm]:
    """A cluster that lives as long as the block, its commands first on the PATH."""
    for name in ("munge", "state", "bin", "log"):
        (folder / name).mkdir(parents=True)
    (folder / "munge").chmod(0o711)
    key = folder / "munge" / "key"
    key.write_bytes(secrets.token_bytes(1024))
    key.chmod(0o400)
    configuration = folder / "slurm.conf"
    host = socket.gethostname().partition(".")[0]
    configuration.write_text(
        CONFIGURATION.format(folder=folder, host=host, user=getpass.getuser(), ports=_free_ports(3))
    )
    # Slurm counts device files and looks at no GPU.
    (folder / "gres.conf").write_text(
        "NodeName=n1 Name=gpu File=/dev/null\nNodeName=n2 Name=gpu File=/dev/zero\n"
    )
    for name in COMMANDS:
        # Snakemake's plugin takes SLURM_* out of the environment, the place of slurm.conf included.
        script = folder / "bin" / name
        script.write_text(f'#!/bin/sh\nSLURM_CONF={configuration} exec {_program(name)} "$@"\n')
        script.chmod(0o755)
    munge = [f"--{name}={folder}/munge/{file}" for name, file in MUNGE_FILES.items()]
    with ExitStack() as daemons:
        before = os.environ["PATH"]
        os.environ["PATH"] = f"{folder / 'bin'}:{before}"
        daemons.callback(os.environ.__setitem__, "PATH", before)
        _start(daemons, folder, "munged", "--foreground", "--force", *munge)
        _until(lambda: (folder / "munge" / "socket").exists(), folder)
        slurm = Slurm(folder, daemons)
        slurm.start_controller()
        for node in NODES:
            (folder / f"spool.{node}").mkdir()
            _start(daemons, folder, "slurmd", "-D", "-N", node, "-f", str(configuration))
        _until(lambda: _idle_nodes(slurm) == len(NODES), folder)
        try:
            yield slurm
        finally:
            _kill_leftovers(folder)


MUNGE_FILES = {
    "key-file": "key",
    "socket": "socket",
    "pid-file": "pid",
    "log-file": "log",
    "seed-file": "seed",
}


def _start(daemons: ExitStack, folder: Path, name: str, *arguments: str) -> None:
    with (folder / "log" / f"{name}.log").open("ab") as log:
        process = subprocess.Popen([str(_program(name)), *arguments], stdout=log, stderr=log)
    daemons.callback(process.wait)
    daemons.callback(process.terminate)


def _kill_leftovers(folder: Path) -> None:
    """Kill what jobs of this cluster left behind: where a node is set down, Snakemake waits for its step
    for ever, and Slurm forgets it."""
    for process in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            begun_here = "SLURM_JOB_ID=" in (environment := (process / "environ").read_text(errors="replace"))
            if begun_here and str(folder / "bin") in environment:
                os.kill(int(process.name), signal.SIGKILL)


def _idle_nodes(slurm: Slurm) -> int:
    try:
        return slurm("sinfo", "--noheader", "--Node", "--states", "idle").count("\n")
    except AssertionError:
        return 0  # the controller does not answer yet


def _until(ready: object, folder: Path, seconds: float = 30.0) -> None:
    assert callable(ready)
    deadline = time.monotonic() + seconds
    while not ready():
        if time.monotonic() > deadline:
            logs = "\n".join(f"{log.name}: {log.read_text()[-1500:]}" for log in (folder / "log").iterdir())
            raise AssertionError(f"Slurm did not come up\n{logs}")
        time.sleep(0.1)


def _program(name: str) -> str | None:
    return shutil.which(name) or shutil.which(name, path="/usr/sbin:/sbin")


def _free_ports(count: int) -> list[int]:
    with ExitStack() as sockets:
        taken = [sockets.enter_context(socket.socket()) for _ in range(count)]
        for each in taken:
            each.bind(("127.0.0.1", 0))
        return [each.getsockname()[1] for each in taken]
