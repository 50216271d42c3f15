"""One job of a batch: run ``cleargs stage`` and note what becomes of it. ::

python -m cleargs.batch.job BATCH SCENE STAGE -- cleargs stage STAGE BATCH/scenes/SCENE ...
"""

from __future__ import annotations

import json
import os
import signal
import socket
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from cleargs.batch.folder import BatchFolder, Doing, Handle, Status
from cleargs.batch.slurm_watch import SlurmJob, run_watched

PARTIAL, INTERRUPTED = 3, 130
TOO_EARLY = -signal.SIGINT
"""Exit code of a stage that was interrupted before it could answer signals."""


def main(arguments: Sequence[str]) -> int:
    """Run the job; returns the exit code of the stage (0 for one done in part with ``--allow-partial``)."""
    divider = list(arguments).index("--")
    root, scene, stage = arguments[:divider]
    command = list(arguments[divider + 1 :])
    folder = BatchFolder(Path(root))
    plan = folder.read_plan()
    if plan is not None and plan.report and stage == plan.until:
        command.append("--report")
    job, begin = SlurmJob.mine(), time.time()

    def note(state: Doing, code: int | None = None, cause: str = "") -> None:
        seconds = 0.0 if state == "running" else round(time.time() - begin, 3)
        status = Status(
            state=state,
            node=os.environ.get("SLURMD_NODENAME") or socket.gethostname(),
            job=job.number if job else "",
            started=begin,
            seconds=seconds,
            exit_code=code,
            cause=cause,
        )
        folder.write_status(scene, stage, status)

    note("running")
    log = folder.log(scene, stage)
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("a", encoding="utf-8") as file:
        file.write(f"== {time.strftime('%Y-%m-%d %H:%M:%S')} {' '.join(command)}\n")
        file.flush()
        said_before = file.tell()
        code, output, again = run_watched([*command, "--json"], file.fileno(), folder.store, job)
    if code in (0, PARTIAL):
        outcome = json.loads(output)
        if code == PARTIAL and "--allow-partial" not in command:
            note("partial", code, "; ".join(outcome["missing"]))
            return code
        folder.write_handle(scene, stage, Handle(digest=outcome["digest"], status=outcome["status"]))
        note("done" if code == 0 else "partial", code, "; ".join(outcome["missing"]))
        return 0
    if code in (INTERRUPTED, TOO_EARLY):
        note("requeued" if again else "interrupted", code)
        if again and job is not None and not job.requeue():
            note("interrupted", code, "Slurm did not take the job back")
        return INTERRUPTED
    note("failed", code, _cause(log, said_before, code))
    return code


def _cause(log: Path, begin: int, code: int) -> str:
    """The last line of cause in what this try wrote into ``log``."""
    with log.open("rb") as file:
        file.seek(begin)
        lines = file.read().decode("utf-8", "replace").splitlines()
    for line in reversed(lines):
        if line.startswith("error: "):
            return line.removeprefix("error: ")
    return f"ended by signal {-code}" if code < 0 else f"ended with exit code {code}"


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
